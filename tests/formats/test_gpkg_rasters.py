"""Grids and images in GeoPackages: whole round trips, positions by GDAL and QGIS, tiles of others, hostile tiles."""

from __future__ import annotations

import io
import math
import sqlite3
import subprocess
import zlib
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from PIL import Image

from app import formats
from app.errors import TooLarge, UnreadableFile
from app.formats import FileGroup, ReadContext, WriteContext
from app.formats.gis.gpkg.writing import WriteOptions
from app.limits import Limits
from app.model.features import features
from app.model.frame import Datum, Level
from app.model.geodesy import local_frame
from app.model.grid import OccupancyGrid
from app.model.imagery import Affine, GeoImage
from app.model.layers import NETWORK, Layers, PartKey
from tests import qgis

FMT = formats.get_format("gpkg")
DATUM = Datum(53.2686, -0.5245, heading=30.0)
MAP = PartKey("occupancy", "ground", "map")
PLAN = PartKey("imagery", "ground", "plan")
RANDOM = np.random.default_rng(1)


def read(data: bytes, context: ReadContext | None = None, **options: Any) -> Layers:
    return formats.read(FileGroup(FMT, "a.gpkg", {"a.gpkg": data}), context or ReadContext(**options))


def write(layers: Layers, context: WriteContext | None = None) -> bytes:
    (data,) = formats.write(FMT, layers, context or WriteContext()).values()
    return data


def turned(angle: float, size: float, x: float, y: float) -> Affine:
    c, s = math.cos(angle) * size, math.sin(angle) * size
    return (c, s, x, s, -c, y)


def grid(yaw: float = 0.3, shape: tuple[int, int] = (700, 1300)) -> OccupancyGrid:
    """Free, with 20 rows of occupied cells below, and one cell of 37 near the upper right corner."""
    cells = np.zeros(shape, np.uint8)
    cells[:20] = 100
    cells[100:200, 300:400] = 255
    cells[-5, -8] = 37
    keys: dict[str, Any] = {"mode": "scale", "free_thresh": 0.2, "properties": {"nav2": {"a": [1, None]}}}
    return OccupancyGrid(cells, 0.05, (3.0, -7.0, yaw), **keys)


def image(count: int, **properties: Any) -> GeoImage:
    pixels = RANDOM.integers(0, 255, (300, 800, count), dtype=np.uint8)
    return GeoImage(pixels, turned(0.5, 0.1, 10.0, 20.0), "local", properties)


def assert_same_grid(a: Any, b: OccupancyGrid) -> None:
    assert isinstance(a, OccupancyGrid)
    assert np.array_equal(a.cells, b.cells)
    for name in ("resolution", "origin", "mode", "free_thresh", "occupied_thresh", "negate", "properties"):
        assert getattr(a, name) == getattr(b, name), name


def assert_same_image(a: Any, b: GeoImage) -> None:
    assert isinstance(a, GeoImage)
    assert np.array_equal(a.pixels, b.pixels)
    assert (a.transform, a.crs, a.properties) == (b.transform, b.crs, b.properties)


@pytest.mark.parametrize("datum", [DATUM, None])
def test_grids_come_back_whole_with_equal_bytes(datum: Datum | None) -> None:
    upstairs = PartKey("occupancy", "Étage 2", "map")
    small = OccupancyGrid(np.full((3, 5), 255, np.uint8), 0.5)  # no cell of it is seen
    parts = {MAP: grid(0.3 if datum else 0.0), upstairs: small, PartKey("occupancy", "ground", "Map!"): small}
    context = WriteContext()
    layers = Layers(parts, datum, (Level(), Level("Étage 2", 3.0)))
    data = write(layers, context)
    assert context.dropped == []
    assert write(layers) == data
    back = read(data)
    assert back.datum == datum
    assert back.parts.keys() == parts.keys()
    for key, part in parts.items():
        assert_same_grid(back.parts[key], part)


PALETTE = [[k, 255 - k, 7, 255] for k in range(256)]


@pytest.mark.parametrize(
    "picture",
    [
        image(1),
        image(3, attribution=["© somebody"]),
        image(4),
        image(1, nodata=7),
        image(1, bands=[{"colour": "palette"}], palette=PALETTE),
        image(1, bands=[{"colour": "palette"}], palette=PALETTE[:255]),
        GeoImage(image(3).pixels, (0.5, 0.0, 600000.0, 0.0, -0.25, 5900000.0), "EPSG:32630"),
        GeoImage(image(2).pixels, (1e-6, 0.0, -0.52, 0.0, -1e-6, 53.27), "EPSG:4326"),
    ],
)  # fmt: skip
def test_images_come_back_whole(picture: GeoImage) -> None:
    context = WriteContext()
    back = read(write(Layers({PLAN: picture}, DATUM), context))
    assert context.dropped == []
    assert_same_image(back.parts[PLAN], picture)


def test_deep_images_are_written_as_shown_and_reported() -> None:
    pixels = (np.arange(300 * 800) // 4).astype(np.uint16).reshape(300, 800, 1)
    context = WriteContext()
    back = read(write(Layers({PLAN: GeoImage(pixels, turned(0.5, 0.1, 10.0, 20.0))}, DATUM), context))
    assert [d.subject for d in context.dropped] == ["pixel values"]
    picture = back.parts[PLAN]
    assert isinstance(picture, GeoImage)
    assert picture.pixels[-1, -1].tolist() == [255] * 3
    assert picture.pixels[0, 0].tolist() == [0] * 3


def test_turned_rasters_without_a_datum_are_dropped() -> None:
    context = WriteContext()
    back = read(write(Layers({MAP: grid(0.3), PLAN: image(3)}), context))
    assert not back.parts
    assert [(d.subject, "set a datum" in d.why) for d in context.dropped] == [
        ("turned grids", True),
        ("turned images", True),
    ]


def test_rasters_can_be_left_out() -> None:
    context = WriteContext(options=WriteOptions(rasters=False))
    node = features([("a", shapely.Point(1, 2), {"kind": "node"})], "local")
    layers = Layers({MAP: grid(), PartKey("topology", "ground", NETWORK): node}, DATUM)
    data = write(layers, context)
    assert [d.subject for d in context.dropped] == ["occupancy"]
    with closing(sqlite3.connect(":memory:")) as database:
        database.deserialize(data)
        assert not database.execute("SELECT 1 FROM sqlite_master WHERE name LIKE 'gpkg_tile%'").fetchall()


def test_grid_that_moved_has_the_position_of_its_tiles() -> None:
    moved = changed(
        write(Layers({MAP: grid(0.0)})),
        "UPDATE gpkg_contents SET min_x = min_x + 1, max_x = max_x + 1 WHERE table_name = 'occupancy_map'",
        "UPDATE gpkg_tile_matrix_set SET min_x = min_x + 1, max_x = max_x + 1",
    )
    context = ReadContext()
    back = read(moved, context).parts[MAP]
    assert isinstance(back, OccupancyGrid)
    assert back.origin == (4.0, -7.0, 0.0)
    assert back.mode == "scale"
    assert any("their position is used" in w.problem for w in context.warnings)


# --- other programs ---------------------------------------------------------------------------------------------------
def positions(of: OccupancyGrid) -> list[tuple[float, float, list[int]]]:
    """Return (longitude, latitude, colour) a third of a cell inside of corners of the grid, by its definition."""
    x, y, yaw = of.origin
    cells = [(0.33, 0.33, [0, 0, 0, 255]), (1299.67, 19.67, [0, 0, 0, 255]), (0.33, 20.33, [254, 254, 254, 255])]
    shade = round(254 * 0.63)
    cells += [(1292.33, 695.67, [shade, shade, shade, 255]), (1292.67, 695.33, [shade, shade, shade, 255])]
    cells += [(1291.67, 695.5, [254, 254, 254, 255]), (1299.67, 699.67, [254, 254, 254, 255]), (350, 150, [])]
    out = []
    for u, v, colour in cells:
        u, v = u * of.resolution, v * of.resolution
        xy = [x + math.cos(yaw) * u - math.sin(yaw) * v, y + math.sin(yaw) * u + math.cos(yaw) * v]
        longitude, latitude = local_frame(DATUM).to_wgs84(np.array([xy]))[0].tolist()
        out.append((longitude, latitude, colour))
    return out


def test_gdal_places_every_corner_within_a_third_of_a_cell(tmp_path: Path, gdal: None) -> None:
    path = tmp_path / "a.gpkg"
    path.write_bytes(write(Layers({MAP: grid(), PLAN: image(3)}, DATUM)))
    for longitude, latitude, colour in positions(grid()):
        command = ["gdallocationinfo", "-valonly", "-wgs84", f"GPKG:{path}:occupancy_map"]
        run = subprocess.run(
            [*command, repr(longitude), repr(latitude)], capture_output=True, text=True, check=True, timeout=60
        )
        values = [int(v) for v in run.stdout.split()]
        assert values == colour if colour else values[3] == 0


@pytest.fixture
def gdal() -> None:
    try:
        subprocess.run(["gdalinfo", "--version"], capture_output=True, check=True)
    except OSError:
        pytest.skip("gdal-bin is missing")


_LOOK = """
layer = QgsRasterLayer(f"GPKG:{sys.argv[1]}:occupancy_map", "map", "gdal")
to = QgsCoordinateTransform(QgsCoordinateReferenceSystem("EPSG:4326"), layer.crs(), QgsProject.instance())
cells = []
for text in sys.argv[2:]:
    point = to.transform(QgsPointXY(*map(float, text.split())))
    values = layer.dataProvider().identify(point, QgsRaster.IdentifyFormatValue).results()
    cells.append([int(values[k]) for k in sorted(values)])
answer([layer.isValid(), layer.width(), layer.height(), cells])
"""


def test_qgis_places_every_corner_within_a_third_of_a_cell(tmp_path: Path) -> None:
    path = tmp_path / "a.gpkg"
    path.write_bytes(write(Layers({MAP: grid()}, DATUM)))
    points = positions(grid())
    *layer, cells = qgis.run(_LOOK, path, *(f"{x!r} {y!r}" for x, y, _ in points), folder=tmp_path)
    assert layer == [True, 1300, 700]
    for values, (_, _, colour) in zip(cells, points, strict=True):
        assert values == colour if colour else values[3] == 0


@pytest.mark.parametrize("kind", ["PNG", "JPEG"])
def test_gdal_tiles_are_read_as_image_or_grid(kind: str, tmp_path: Path, gdal: None) -> None:
    """A picture in UTM: dark below, light above; GDAL pads it to tiles of 256 pixels."""
    source, path = tmp_path / "a.png", tmp_path / "photo.gpkg"
    shades = np.full((300, 500), 250, np.uint8)
    shades[200:] = 10
    Image.fromarray(shades).save(source)
    options = ["-of", "GPKG", "-a_srs", "EPSG:32630", "-a_ullr", "665000", "5905030", "665050", "5905000"]
    command = ["gdal_translate", "-q", *options, "-co", f"TILE_FORMAT={kind}", source, path]
    subprocess.run(command, check=True, capture_output=True, timeout=60)
    (picture,) = read(path.read_bytes()).parts.values()
    assert isinstance(picture, GeoImage)
    assert (picture.transform, picture.crs) == ((0.1, 0.0, 665000.0, 0.0, -0.1, 5905030.0), "EPSG:32630")
    assert picture.pixels.shape == (300, 500, 3)
    assert np.abs(picture.pixels.astype(int)[[0, 190, 210, 299]].mean(axis=(1, 2)) - [250, 250, 10, 10]).max() < 3
    cells = read(path.read_bytes(), layer="occupancy", frame=local_frame(DATUM), grid="yard").parts
    (key,) = cells
    assert key == PartKey("occupancy", "ground", "yard")
    yard = cells[key]
    assert isinstance(yard, OccupancyGrid)
    assert set(yard.cells[:95].ravel().tolist()) == {100}
    assert set(yard.cells[110:].ravel().tolist()) == {0}
    with pytest.raises(UnreadableFile, match="the environment has no datum"):
        read(path.read_bytes(), layer="occupancy")


def changed(data: bytes, *statements: str | tuple[str, tuple[Any, ...]]) -> bytes:
    with closing(sqlite3.connect(":memory:")) as database:
        database.deserialize(data)
        for statement in statements:
            text, values = (statement, ()) if isinstance(statement, str) else statement
            database.execute(text, values)
        database.commit()
        return database.serialize()


def png(pixels: np.ndarray[Any, Any]) -> bytes:
    out = io.BytesIO()
    Image.fromarray(pixels).save(out, "PNG")
    return out.getvalue()


def coverage(values: np.ndarray[Any, Any], kind: str = "integer", tile: bytes | None = None) -> bytes:
    """Return a GeoPackage with one tile of a gridded coverage, by the text of OGC 17-066r1."""
    height, width = values.shape
    data = write(Layers({PLAN: GeoImage(np.zeros((2, 2, 1), np.uint8), (1.0, 0.0, 0.0, 0.0, -1.0, 2.0))}))
    box = (0.0, 0.0, float(width), float(height))
    return changed(
        data,
        "DELETE FROM gpkg_contents WHERE table_name = 'imagery_plan'",
        "DELETE FROM gpkg_tile_matrix_set",
        "DELETE FROM gpkg_tile_matrix",
        "CREATE TABLE gpkg_2d_gridded_coverage_ancillary (id INTEGER PRIMARY KEY, tile_matrix_set_name TEXT,"
        " datatype TEXT, scale REAL, offset REAL, precision REAL, data_null REAL, grid_cell_encoding TEXT, uom TEXT)",
        "CREATE TABLE gpkg_2d_gridded_tile_ancillary (id INTEGER PRIMARY KEY, tpudt_name TEXT, tpudt_id INTEGER,"
        " scale REAL, offset REAL, min REAL, max REAL, mean REAL, std_dev REAL)",
        "CREATE TABLE dem (id INTEGER PRIMARY KEY, zoom_level INTEGER, tile_column INTEGER, tile_row INTEGER,"
        " tile_data BLOB)",
        ("INSERT INTO gpkg_contents VALUES ('dem', '2d-gridded-coverage', 'dem', '', '', ?, ?, ?, ?, -1)", box),
        ("INSERT INTO gpkg_tile_matrix_set VALUES ('dem', -1, ?, ?, ?, ?)", box),
        ("INSERT INTO gpkg_tile_matrix VALUES ('dem', 0, 1, 1, ?, ?, 1.0, 1.0)", (width, height)),
        ("INSERT INTO gpkg_2d_gridded_coverage_ancillary VALUES (1, 'dem', ?, 0.5, 100, 1, 65535, '', 'm')", (kind,)),
        "INSERT INTO gpkg_2d_gridded_tile_ancillary VALUES (1, 'dem', 1, 2, -10, 0, 0, 0, 0)",
        ("INSERT INTO dem VALUES (1, 0, 0, 0, ?)", (png(values) if tile is None else tile,)),
    )


def test_coverage_has_scaled_values_with_gaps() -> None:
    picture = read(coverage(np.array([[0, 10, 65535]], np.uint16))).parts[PartKey("imagery", "ground", "dem")]
    assert isinstance(picture, GeoImage)
    assert picture.properties == {"bands": [{"colour": "gray", "unit": "m"}], "nodata": "nan"}
    # (0 · 2 - 10) · 0.5 + 100 = 95; (10 · 2 - 10) · 0.5 + 100 = 105
    assert np.array_equal(picture.pixels[0, :, 0], np.array([95, 105, np.nan], np.float32), equal_nan=True)


def test_coverage_of_cells_is_a_grid_and_of_other_values_is_not() -> None:
    back = read(coverage(np.array([[0, 65535]], np.uint16)), layer="occupancy").parts
    (cells,) = back.values()
    assert isinstance(cells, OccupancyGrid)
    assert cells.cells.tolist() == [[95, 255]]
    with pytest.raises(UnreadableFile, match="dem: cells must be 0"):
        read(coverage(np.array([[10]], np.uint16)), layer="occupancy")


# --- hostile tiles ----------------------------------------------------------------------------------------------------
def bomb() -> bytes:
    """Return a PNG that declares 512 × 512 pixels, and unpacks to far more bytes than these."""
    body = zlib.compress(bytes(2**26), 9)
    start = png(np.zeros((512, 512), np.uint8))
    at = start.index(b"IDAT") - 4
    chunk = len(body).to_bytes(4, "big") + b"IDAT" + body
    return start[:at] + chunk + zlib.crc32(chunk[4:]).to_bytes(4, "big") + start[-12:]


TILE = "UPDATE imagery_plan SET tile_data = ? WHERE zoom_level = 1 AND tile_column = 0"


@pytest.mark.parametrize(
    ("statement", "reason"),
    [
        ((TILE, (b"\x89PNG\r\n\x1a\n",)), "imagery_plan, zoom 1, column 0, row 0: "),
        ((TILE, (png(np.zeros((256, 512, 3), np.uint8)),)), "a tile of 512 × 256 pixels; gpkg_tile_matrix says 512"),
        ((TILE, ("text",)), "a tile must be an image"),
        ((TILE, (b"RIFF1234WEBP",)), "WebP tiles are unsupported"),
        ((TILE, (png(np.zeros((512, 512), np.uint16)),)), "16-bit tiles|bands"),
        ((TILE, (bomb(),)), "column 0, row 0: "),
        ("DROP TABLE gpkg_tile_matrix", "it has no table gpkg_tile_matrix"),
        ("DELETE FROM gpkg_tile_matrix", "not described"),
        ("UPDATE gpkg_tile_matrix SET tile_width = -1", "must be positive integers"),
        ("UPDATE gpkg_tile_matrix SET pixel_x_size = 0", "must be numbers"),
        ("UPDATE gpkg_tile_matrix SET matrix_width = 1 WHERE zoom_level = 1", "outside the matrix"),
        ("UPDATE gpkg_tile_matrix_set SET min_x = 9e999", "must be numbers"),
        ("UPDATE gpkg_contents SET srs_id = 77 WHERE data_type = 'tiles'", "unknown srs_id 77"),
    ],
)  # fmt: skip
def test_hostile_tiles_are_refused_with_a_reason(statement: Any, reason: str) -> None:
    data = changed(write(Layers({PLAN: image(3)}, DATUM)), statement)
    with pytest.raises(UnreadableFile, match=reason):
        read(data)


def test_sizes_are_refused_before_memory_is_allocated() -> None:
    data = changed(
        write(Layers({PLAN: image(3)}, DATUM)),
        "UPDATE gpkg_tile_matrix SET matrix_width = 1000000, matrix_height = 1000000",
        "UPDATE gpkg_contents SET max_x = min_x + 1e7, min_y = max_y - 1e7 WHERE data_type = 'tiles'",
    )
    with pytest.raises(TooLarge, match="FLEETMAP_MAX_PIXELS"):
        read(data)
    with pytest.raises(TooLarge, match="the limit is 1000 "):
        read(write(Layers({PLAN: image(3)}, DATUM)), limits=Limits(pixels=1000))


def test_missing_tiles_are_clear_and_views_are_not_run() -> None:
    data = write(Layers({PLAN: image(4)}, DATUM))
    holes = read(changed(data, "DELETE FROM imagery_plan WHERE tile_column = 0 AND zoom_level = 1")).parts[PLAN]
    assert isinstance(holes, GeoImage)
    assert not holes.pixels[:, :512].any()
    assert holes.pixels[:, 512:].any()
    context = ReadContext()
    view = changed(
        data,
        "ALTER TABLE imagery_plan RENAME TO other",
        "CREATE VIEW imagery_plan AS SELECT * FROM other",
    )
    assert not read(view, context).parts
    assert any("not views" in w.problem for w in context.warnings)
