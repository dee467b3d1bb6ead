"""Georeferenced images: samples against gdalinfo, real maps, world files, corners, floor plans, limits."""

from __future__ import annotations

import io
import json
import math
import shutil
import struct
import subprocess
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from app import formats, upload_reader
from app.errors import Ambiguous, Invalid, MissingDatum, MissingLayer, NotFound, TooLarge, UnreadableFile
from app.formats import FileGroup, ReadContext, WriteContext, get_format
from app.formats.satellite import ReadOptions, WriteOptions, detect, options_from_filename
from app.limits import Limits
from app.model.frame import Datum
from app.model.geodesy import crs_bounds, local_frame
from app.model.imagery import GeoImage, pixel_positions
from app.model.layers import Layers, PartKey
from app.model.resampling import resample
from app.syntax import geotiff
from app.upload_reader import EnvironmentContext, UploadHints

SAMPLES = Path(__file__).resolve().parents[1] / "samples" / "satellite"
FACTS: dict[str, Any] = json.loads((SAMPLES / "facts.json").read_text())
Same = Callable[[str, dict[str, bytes], dict[str, bytes]], list[str]]
LIMITS = Limits()
UTM = "EPSG:32630"
HERE = Datum(53.2686, -0.5245)


def read(files: dict[str, bytes], main: str | None = None, **more: Any) -> tuple[GeoImage, ReadContext]:
    options = more.pop("options", {})
    context = ReadContext(options=ReadOptions(**options), **more)
    main = main or next(iter(files))
    layers = formats.read(FileGroup(get_format("satellite"), main, files), context)
    (part,) = layers.parts.values()
    assert isinstance(part, GeoImage)
    return part, context


def written(picture: GeoImage, datum: Datum | None = None, **options: Any) -> tuple[dict[str, bytes], WriteContext]:
    context = WriteContext(options=WriteOptions(**options))
    layers = Layers({PartKey("imagery", name="a"): picture}, datum)
    return formats.write(get_format("satellite"), layers, context), context


def tif(picture: GeoImage, **options: Any) -> bytes:
    return written(picture, **options)[0]["satellite.tif"]


def image(shape: tuple[int, ...] = (3, 4, 3), kind: str = "PNG", seed: int = 1) -> bytes:
    pixels = np.random.default_rng(seed).integers(0, 255, shape, dtype=np.uint8)
    out = io.BytesIO()
    Image.fromarray(pixels).save(out, kind)
    return out.getvalue()


def utm(shape: tuple[int, ...] = (3, 4, 3), kind: Any = np.uint8, **properties: Any) -> GeoImage:
    values = np.arange(math.prod(shape)).reshape(shape) % 250
    return GeoImage(values.astype(kind), (0.5, 0.0, 665000.0, 0.0, -0.5, 5905000.0), UTM, properties)


def sample(name: str) -> dict[str, bytes]:
    path = SAMPLES / name
    folder = [path] if path.parent == SAMPLES else sorted(path.parent.iterdir())
    return {p.name: p.read_bytes() for p in sorted(folder, key=lambda p: p != path)}


def same_properties(a: GeoImage, b: GeoImage) -> bool:
    return json.dumps(dict(a.properties), sort_keys=True) == json.dumps(dict(b.properties), sort_keys=True)


def gdalinfo(path: Path) -> dict[str, Any]:
    if shutil.which("gdalinfo") is None:
        pytest.skip("gdalinfo is not installed")
    done = subprocess.run(["gdalinfo", "-json", str(path)], capture_output=True, check=True, timeout=60)
    assert b"rror" not in done.stderr, done.stderr
    answer: dict[str, Any] = json.loads(done.stdout)
    return answer


# --- samples and real maps ----------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", [n for n in FACTS if n != "made"])
def test_samples_match_gdalinfo(name: str) -> None:
    facts = FACTS[name]
    files = sample(name)
    groups, rest = formats.group(files)
    assert [g.format.name for g in groups] == ["satellite"]
    assert rest == []
    picture, _ = read(files, groups[0].main)
    height, width, bands = picture.pixels.shape
    assert [width, height] == facts["size"]
    assert (bands, picture.pixels.dtype.name, picture.crs) == (facts["bands"], facts["type"], facts["crs"])
    corners = pixel_positions(picture.transform, np.array([0.0, width]), np.array([0.0, height]))
    assert np.abs(corners - [facts["upper_left"], facts["lower_right"]]).max() < 5.1e-4
    if "nodata" in facts:
        assert picture.nodata == facts["nodata"]
    if "rows" in facts:
        assert picture.pixels[..., 0].tolist() == facts["rows"]
    if "pixel_row_2_column_3" in facts:
        assert picture.pixels[2, 3].tolist() == facts["pixel_row_2_column_3"]


def real(shared: Path, name: str) -> dict[str, bytes]:
    path = shared / "data" / "geotiff" / name
    return {path.name: path.read_bytes()}


REAL = ("opengeos_dtm/dtm.tif", "rasterio/RGB.byte.tif", "rasterio/rgb-byte-tenth.tif", "rasterio/rotated.tif")


@pytest.mark.parametrize("name", REAL)
def test_real_maps_match_facts_and_round_trip(
    shared: Path, same: Same, facts_json: dict[str, Any], name: str, tmp_path: Path
) -> None:
    facts = facts_json[f"geotiff/{name}"]["facts"]
    files = real(shared, name)
    picture, context = read(files)
    height, width, _ = picture.pixels.shape
    assert [width, height] == facts["size"]
    a, b, c, d, e, f = picture.transform
    assert np.abs(np.array([c, a, b, f, d, e]) - facts["geoTransform"]).max() < 1e-9
    if facts["epsg"]:
        assert picture.crs == f"EPSG:{facts['epsg']}"
    if facts["wgs84Extent"]:
        box = crs_bounds(picture.crs, picture.outline())
        ring = np.array(facts["wgs84Extent"][0])
        assert box is not None
        assert np.abs(np.array(box) - [*ring.min(axis=0), *ring.max(axis=0)]).max() < 2e-7
    else:
        assert picture.crs == "local"
        assert "no CRS" in context.warnings[0].problem
    back, _ = written(picture)
    assert same("satellite", files, back) == []
    (tmp_path / "satellite.tif").write_bytes(back["satellite.tif"])
    info = gdalinfo(tmp_path / "satellite.tif")
    assert info["size"] == facts["size"]
    assert np.abs(np.array(info["geoTransform"]) - facts["geoTransform"]).max() < 1e-9
    assert info["metadata"]["IMAGE_STRUCTURE"]["LAYOUT"] == "COG"
    again, _ = read(back)
    assert again.transform == picture.transform
    assert again.crs == picture.crs
    assert same_properties(again, picture)


def test_damaged_tiles_are_refused_with_the_reason(shared: Path) -> None:
    with pytest.raises(UnreadableFile, match=r"corrupt\.tif: .*row 512, col 0, tile 3") as caught:
        read(real(shared, "rasterio/corrupt.tif"))
    assert "vsimem" not in caught.value.detail
    assert caught.value.problems[0].file == "corrupt.tif"


def test_images_of_all_kinds_match_facts(shared: Path, facts_json: dict[str, Any]) -> None:
    """The real PNGs as floor plans: size, bands and transparency as counted by another tool."""
    plans = [n for n, e in facts_json.items() if e["kind"] == "image" and n.endswith((".png", ".bmp"))]
    assert len(plans) > 10
    for name in plans:
        facts = facts_json[name]["facts"]
        if facts["width"] * facts["height"] > 5_000_000:
            continue
        data = (shared / "data" / name).read_bytes()
        picture, _ = read({"plan.png": data}, options={"metres_per_pixel": 0.05})
        assert picture.pixels.shape[:2] == (facts["height"], facts["width"])
        assert picture.pixels.shape[2] == {"L": 1, "RGB": 3, "RGBA": 4}[facts["mode"]]
        if "transparent_pixels" in facts and facts["has_alpha"]:
            assert int((picture.pixels[..., 3] == 0).sum()) == facts["transparent_pixels"]


# --- GeoTIFF ------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    "kind", ["uint8", "int8", "uint16", "int16", "uint32", "int32", "uint64", "int64", "float32", "float64"]
)
@pytest.mark.parametrize("bands", [1, 2, 3, 4, 5])
def test_every_pixel_type_round_trips(kind: str, bands: int) -> None:
    picture = utm((7, 5, bands), kind)
    back, _ = read({"a.tif": tif(picture)})
    assert back.pixels.dtype == kind
    assert np.array_equal(back.pixels, picture.pixels)
    assert back.colours == picture.colours
    assert tif(back) == tif(picture)


def test_tiff_metadata_round_trips() -> None:
    bands = [
        {"colour": "gray", "description": "height", "unit": "m", "scale": 0.01, "offset": 100.0},
        {"colour": "undefined", "satellite": {"tags": {"SENSOR": "a"}}},
        {"colour": "mask"},
    ]
    tags = {"TIFFTAG_COPYRIGHT": "© A. Survey", "TIFFTAG_DATETIME": "2024:05:01 10:00:00", "AREA_OR_POINT": "Point"}
    values = np.arange(24, dtype=np.int16).reshape(2, 4, 3)
    values[..., 2] = [[255, 0, 255, 255], [0, 255, 255, 255]]
    picture = GeoImage(
        values,
        (2.0, 0.0, 500000.0, 0.0, -2.0, 370000.0),
        "EPSG:27700",
        {"bands": bands, "attribution": ["© A. Survey"], "satellite": {"tags": tags}},
    )
    back, _ = read({"a.tif": tif(picture)})
    assert np.array_equal(back.pixels, picture.pixels)
    assert back.transform == picture.transform
    assert same_properties(back, picture)
    assert back.attribution == ("© A. Survey",)


@pytest.mark.parametrize("value", [0, 255, 7])
def test_integer_nodata_round_trips(value: int) -> None:
    back, _ = read({"a.tif": tif(utm(nodata=value))})
    assert back.nodata == value
    assert isinstance(back.properties["nodata"], int)


@pytest.mark.parametrize("value", ["nan", "inf", "-inf", -32768.5])
def test_float_nodata_round_trips(value: Any) -> None:
    back, _ = read({"a.tif": tif(utm(kind=np.float32, nodata=value))})
    assert back.properties["nodata"] == value


def test_nodata_outside_pixel_range_is_skipped() -> None:
    assert read({"a.tif": tif(utm(nodata=-9999))})[0].nodata is None


def test_palette_round_trips_and_is_displayed_in_colour() -> None:
    palette = [[k, 255 - k, 7, 255] for k in range(256)]
    picture = utm((3, 4, 1), bands=[{"colour": "palette"}], palette=palette)
    back, _ = read({"a.tif": tif(picture)})
    assert back.properties["palette"] == palette
    shown = Image.open(io.BytesIO(written(back, file_type="png")[0]["satellite.png"])).convert("RGBA")
    value = int(picture.pixels[2, 3, 0])
    assert shown.getpixel((3, 2)) == (value, 255 - value, 7, 255)


@pytest.mark.parametrize(
    "crs",
    [
        "EPSG:4326",
        "EPSG:3857",
        "EPSG:27700",
        'PROJCRS["mine",BASEGEOGCRS["WGS 84",DATUM["World Geodetic System 1984",ELLIPSOID["WGS 84",6378137,'
        '298.257223563]]],CONVERSION["x",METHOD["Transverse Mercator",ID["EPSG",9807]],PARAMETER["Latitude of natural '
        'origin",53.2,ANGLEUNIT["degree",0.0174532925199433]],PARAMETER["Longitude of natural origin",-0.5,ANGLEUNIT['
        '"degree",0.0174532925199433]],PARAMETER["Scale factor at natural origin",1,SCALEUNIT["unity",1]],PARAMETER['
        '"False easting",0,LENGTHUNIT["metre",1]],PARAMETER["False northing",0,LENGTHUNIT["metre",1]]],CS[Cartesian,2],'
        'AXIS["e",east],AXIS["n",north],LENGTHUNIT["metre",1]]',
    ],
    ids=["degrees", "mercator", "british", "own"],
)
def test_crs_round_trips(crs: str) -> None:
    picture = GeoImage(np.zeros((2, 2, 1), np.uint8), (1e-5, 0.0, -0.5, 0.0, -1e-5, 53.2), crs)
    back, context = read({"a.tif": tif(picture)})
    assert crs_bounds(back.crs, back.outline()) == pytest.approx(crs_bounds(crs, picture.outline()), abs=1e-11)
    assert context.warnings == []
    if crs.startswith("EPSG"):
        assert back.crs == crs
    assert tif(back) == tif(picture)


@pytest.mark.parametrize(
    "transform",
    [(0.05, 0.0, -3.0, 0.0, -0.05, 7.0), (1.0, 0.0, 0.0, 0.0, 1.0, 0.0), (0.04, 0.03, 1.0, 0.03, -0.04, 2.0)],
)
def test_local_metres_round_trip_without_warning(transform: Any) -> None:
    picture = GeoImage(np.ones((2, 3, 1), np.uint8), transform)
    data = tif(picture)
    assert detect("a.tif", data)
    back, context = read({"a.tif": data})
    assert (back.crs, back.transform, context.warnings) == ("local", transform, [])


def test_local_metres_are_an_engineering_crs() -> None:
    import rasterio
    from rasterio.io import MemoryFile

    data = tif(GeoImage(np.ones((2, 3, 1), np.uint8), (0.04, 0.03, 1.0, 0.03, -0.04, 2.0)))
    with MemoryFile(data) as file, file.open() as dataset:
        assert dataset.crs.to_wkt().startswith('LOCAL_CS["local frame",UNIT["metre",1')
        assert dataset.transform[:6] == (0.04, 0.03, 1.0, 0.03, -0.04, 2.0)
        assert dataset.crs != rasterio.crs.CRS.from_epsg(32630)
    picture, context = read({"a.tif": without_tag(data)})
    assert (picture.crs, context.warnings) == ("local", [])


def tiff_without_crs() -> bytes:
    import rasterio
    from rasterio.io import MemoryFile

    with MemoryFile() as file:
        size = {"width": 3, "height": 2, "count": 1, "dtype": "uint8"}
        with file.open(driver="GTiff", transform=rasterio.Affine(2.0, 0.0, 5e5, 0.0, -2.0, 4e5), **size) as dataset:
            dataset.write(np.ones((1, 2, 3), np.uint8))
        return bytes(file.read())


def test_tiff_without_crs_uses_option() -> None:
    data = tiff_without_crs()
    assert read({"a.tif": data})[0].crs == "local"
    picture, context = read({"a.tif": data}, options={"crs": "epsg:27700"})
    assert picture.crs == "EPSG:27700"
    assert context.warnings == []
    with pytest.raises(UnreadableFile, match="outside the area of"):
        read({"a.tif": data}, options={"crs": "EPSG:99999"})


def without_tag(data: bytes) -> bytes:
    """Rename our own tag, which marks local coordinates, to another name of the same length."""
    assert geotiff.OWN_TAG.encode() in data
    return data.replace(geotiff.OWN_TAG.encode(), b"X" * len(geotiff.OWN_TAG))


def test_ground_control_points_georeference_tiff() -> None:
    import rasterio
    from rasterio.control import GroundControlPoint
    from rasterio.io import MemoryFile

    points = [
        GroundControlPoint(row=r, col=c, x=1000.0 + 2 * c, y=500.0 - 2 * r) for r, c in ((0, 0), (0, 4), (3, 0), (3, 4))
    ]
    with MemoryFile() as file:
        with file.open("GTiff", 4, 3, 1, dtype="uint8", gcps=points, crs="EPSG:27700") as out:
            out.write(np.ones((1, 3, 4), np.uint8))
        data = bytes(file.getbuffer())
    assert rasterio.__version__
    picture, _ = read({"a.tif": data})
    assert picture.transform == pytest.approx((2.0, 0.0, 1000.0, 0.0, -2.0, 500.0))
    assert picture.crs == "EPSG:27700"


def test_first_of_several_pages_is_read_with_warning() -> None:
    frames = [Image.new("L", (4, 3), shade) for shade in (10, 20, 30)]
    out = io.BytesIO()
    frames[0].save(out, "TIFF", save_all=True, append_images=frames[1:])
    picture, context = read({"a.tif": out.getvalue(), "a.tfw": b"1 0 0 -1 1000 2000"})
    assert set(picture.pixels.ravel().tolist()) == {10}
    assert "3 pages" in context.warnings[0].problem


# --- world files --------------------------------------------------------------------------------------------------
def test_world_file_refers_to_centre_of_first_pixel() -> None:
    world = b"2\n0.5\n0.25\n-3\n100\n200\n"
    picture, _ = read({"a.pgw": world, "a.png": image()}, options={"crs": "local"})
    assert picture.transform == (2.0, 0.25, 98.875, 0.5, -3.0, 201.25)


def test_coordinates_without_crs_are_degrees_if_plausible_else_metres() -> None:
    degrees, context = read({"a.pgw": b"1e-5 0 0 -1e-5 -0.5 53.2", "a.png": image()})
    assert degrees.crs == "EPSG:4326"
    assert "read as degrees" in context.warnings[0].problem
    metres, context = read({"a.pgw": b"0.05 0 0 -0.05 -0.5 53.2", "a.png": image()})
    assert metres.crs == "local"
    assert "read as metres of the local frame" in context.warnings[0].problem
    assert read({"a.pgw": b"0.05 0 0 -0.05 -0.5 53.2", "a.png": image()}, options={"crs": UTM})[0].crs == UTM


@pytest.mark.parametrize(
    ("world", "picture"),
    [
        ("a.pgw", "a.png"),
        ("a.jgw", "a.jpg"),
        ("a.jgw", "a.jpeg"),
        ("a.wld", "a.png"),
        ("A.TFW", "a.TIF"),
        ("x/a.pgw", "x/a.png"),
    ],
)
def test_world_file_is_matched_to_image(world: str, picture: str) -> None:
    kind = {"png": "PNG", "tif": "TIFF"}.get(picture[-3:].lower(), "JPEG")
    files = {picture: image(kind=kind), world: b"2\n0\n0\n-2\n665000\n5905000\n", "else.txt": b"?"}
    upload_bundle = upload_reader.read(files, UploadHints(options={"crs": UTM}), EnvironmentContext(), LIMITS)
    assert [k.name for k in upload_bundle.parts] == ["a"]
    assert {n for n, use in upload_bundle.files.items() if use.used} == {world, picture}


def test_geotiff_takes_precedence_over_world_file() -> None:
    files = {"a.tif": tif(utm()), "a.tfw": b"9 0 0 -9 9 9"}
    upload_bundle = upload_reader.read(files, UploadHints(), EnvironmentContext(), LIMITS)
    (picture,) = upload_bundle.parts.values()
    assert isinstance(picture, GeoImage)
    assert picture.transform == utm().transform
    assert [w.file for w in upload_bundle.warnings] == ["a.tfw"]
    assert upload_bundle.files["a.tfw"].used


@pytest.mark.parametrize(
    ("world", "line", "reason"),
    [
        (b"1\n0\n0\nnan\n0\n0\n", 4, "finite"),
        (b"1\n0\n0\n-1\ninf\n0\n", 5, "finite"),
        (b"1\n0\n0\n-1e999\n0\n0\n", 4, "finite"),
        (b"1,5\n0\n0\n-1\n0\n0\n", 1, "with a point"),
        (b"1\n0\n0\n-1\n0\n", None, "six lines"),
        (b"1\n0\n0\n-1\n0\n0\n7\n", None, "six lines"),
        (b"0\n0\n0\n0\n0\n0\n", None, "singular"),
        (b"1\n1\n1\n1\n0\n0\n", None, "singular"),
        (b"1\n0\n0\n-1\n1e12\n0\n", None, "beyond"),
    ],
)
def test_wrong_world_files_are_refused(world: bytes, line: int | None, reason: str) -> None:
    with pytest.raises(UnreadableFile, match=reason) as caught:
        read({"a.pgw": world, "a.png": image()})
    assert caught.value.problems[0].line == line


def test_world_file_without_image_reports_missing_image() -> None:
    with pytest.raises(UnreadableFile, match=r"add a\.png beside it"):
        upload_reader.read({"a.pgw": b"1 0 0 -1 0 0"}, UploadHints(), EnvironmentContext(), LIMITS)


def test_crs_is_read_from_sidecar_file() -> None:
    wkt = geotiff.crs_to_wkt(UTM).encode()
    world = b"2 0 0 -2 665000 5905000"
    for name, body in (("a.prj", wkt), ("a.png.aux.xml", b"<PAMDataset><SRS>" + wkt + b"</SRS></PAMDataset>")):
        files = {"a.png": image(), "a.pgw": world, name: body}
        upload_bundle = upload_reader.read(files, UploadHints(), EnvironmentContext(), LIMITS)
        (picture,) = upload_bundle.parts.values()
        assert isinstance(picture, GeoImage)
        assert picture.crs == UTM
        assert upload_bundle.warnings == []
        assert all(use.used for use in upload_bundle.files.values())


@pytest.mark.parametrize(
    ("name", "body"),
    [
        ("a.prj", b"not a CRS"),
        ("a.prj", b"\xff\xfe\0"),
        ("a.prj", b'PROJCS["x' + b"[" * 5000),
        ("a.prj", b"x" * 2**17),
        ("a.prj", b'GEOGCS["x",EXTENSION["PROJ4","+proj=longlat +nadgrids=/etc/passwd"]]'),
        ("a.png.aux.xml", b"<!DOCTYPE a><PAMDataset><SRS>x</SRS></PAMDataset>"),
        ("a.png.aux.xml", b"<PAMDataset><SRS>/etc/passwd</SRS></PAMDataset>"),
    ],
)
def test_wrong_crs_files_are_refused_by_name(name: str, body: bytes) -> None:
    with pytest.raises(UnreadableFile) as caught:
        read({"a.pgw": b"2 0 0 -2 665000 5905000", "a.png": image(), name: body})
    assert caught.value.problems[0].file == name


# --- options ------------------------------------------------------------------------------------------------------
def test_two_opposite_corners_georeference_image() -> None:
    for corners in ((53.2, -0.6, 53.1, -0.5), (53.1, -0.6, 53.2, -0.5)):
        picture, _ = read({"a.png": image((50, 100, 3))}, options={"corners": corners})
        assert picture.transform == pytest.approx((0.001, 0.0, -0.6, 0.0, -0.002, 53.2), abs=1e-15)
        assert picture.crs == "EPSG:4326"


def test_four_corners_georeference_rotated_image() -> None:
    ends = np.array([[-0.5, 53.2], [-0.4992, 53.2003], [-0.4994, 53.1999], [-0.5002, 53.1996]])
    picture, context = read({"a.png": image((40, 80, 3))}, options={"corners": tuple(ends[:, ::-1].ravel().tolist())})
    corners = pixel_positions(picture.transform, np.array([0.0, 80.0, 80.0, 0.0]), np.array([0.0, 0.0, 40.0, 40.0]))
    assert np.abs(corners - ends).max() < 1e-12
    assert context.warnings == []


def test_corners_that_are_not_parallelogram_are_refused() -> None:
    nearly = (53.2, -0.5, 53.2, -0.49, 53.19, -0.49, 53.1904, -0.5)
    _, context = read({"a.png": image((100, 100, 3))}, options={"corners": nearly})
    assert "1.0 pixels off" in context.warnings[0].problem
    crossed = (53.2, -0.5, 53.2, -0.49, 53.19, -0.5, 53.19, -0.49)
    with pytest.raises(UnreadableFile, match="upper left, upper right, lower right, lower left"):
        read({"a.png": image((100, 100, 3))}, options={"corners": crossed})


def test_floor_plan_is_georeferenced_by_scale() -> None:
    picture, _ = read(
        {"plan.png": image((30, 40, 3))}, options={"metres_per_pixel": 0.1, "origin": (5.0, 6.0), "yaw": math.pi / 2}
    )
    assert picture.crs == "local"
    # Turned a quarter to the left round its lower left corner: its right side points north, its upper side west.
    corners = pixel_positions(picture.transform, np.array([0.0, 40.0, 0.0]), np.array([30.0, 30.0, 0.0]))
    assert np.abs(corners - [[5.0, 6.0], [5.0, 10.0], [2.0, 6.0]]).max() < 1e-12


@pytest.mark.parametrize(
    ("options", "where"),
    [
        ({"corners": (1.0, 2.0, 3.0)}, "corners"),
        ({"corners": (91.0, 0.0, 1.0, 1.0)}, "corners"),
        ({"corners": (1.0, 0.0, 0.0, 1.0), "metres_per_pixel": 1.0}, "metres_per_pixel"),
        ({"crs": "/etc/passwd"}, "crs"),
        ({"crs": "+proj=longlat +nadgrids=/etc/passwd"}, "crs"),
        ({"crs": "http://example.org/x"}, "crs"),
        ({"metres_per_pixel": 1.0, "origin": (1e9, 0.0)}, "origin"),
    ],
)
def test_wrong_options_are_refused_by_name(options: dict[str, Any], where: str) -> None:
    with pytest.raises(UnreadableFile) as caught:
        read({"a.png": image()}, options=options)
    assert caught.value.problems[0].where == where


def test_image_without_position_reports_what_to_supply() -> None:
    for hints in (UploadHints(), UploadHints("satellite")):
        with pytest.raises(UnreadableFile, match=r"world file .*corners=.*metres_per_pixel") as caught:
            upload_reader.read({"a.png": image()}, hints, EnvironmentContext(), LIMITS)
        assert caught.value.problems[0].file == "a.png"
        assert "corners=" in caught.value.problems[0].problem


ROOM = (
    b"image: map.png\nresolution: 0.5\norigin: [0.0, 0.0, 0.0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
)


def test_image_without_position_in_folder_is_stored_as_source() -> None:
    files = {
        "config/location/satellite-auto.png": image(),
        "config/metric/map/map.yaml": ROOM,
        "config/metric/map/map.png": image((5, 5)),
    }
    upload_bundle = upload_reader.read(files, UploadHints(), EnvironmentContext(), LIMITS)
    assert [k.layer for k in upload_bundle.parts] == ["occupancy"]
    (warning,) = upload_bundle.warnings
    assert warning.file == "config/location/satellite-auto.png"
    assert "stored as a source" in warning.problem
    assert "corners=" in warning.problem
    upload_bundle = upload_reader.read(
        files, UploadHints(options={"corners": "53.2,-0.6,53.1,-0.5"}), EnvironmentContext(), LIMITS
    )
    assert sorted(k.layer for k in upload_bundle.parts) == ["imagery", "occupancy"]
    assert upload_bundle.files["config/location/satellite-auto.png"].format == "satellite"


def test_options_apply_to_named_file_of_several_images() -> None:
    files = {"a.png": image(), "b.png": image(seed=2)}
    options = {"metres_per_pixel": "0.5"}
    for hints in (UploadHints(options=options), UploadHints("satellite", options=options)):
        with pytest.raises(Invalid, match=r"file=….*a\.png, b\.png"):
            upload_reader.read(files, hints, EnvironmentContext(), LIMITS)
    upload_bundle = upload_reader.read(
        files, UploadHints(options={**options, "file": "b.png", "picture": "roof"}), EnvironmentContext(), LIMITS
    )
    assert [k.name for k in upload_bundle.parts] == ["roof"]
    assert {n for n, use in upload_bundle.files.items() if use.used} == {"b.png"}
    with pytest.raises(Invalid, match="no file"):
        upload_reader.read(files, UploadHints(options={**options, "file": "c.png"}), EnvironmentContext(), LIMITS)


def test_georeferenced_image_ignores_position_options() -> None:
    picture, context = read({"a.tif": tif(utm())}, options={"metres_per_pixel": 1.0, "crs": "local"})
    assert picture.transform == utm().transform
    assert picture.crs == UTM
    assert {w.where for w in context.warnings} == {"metres_per_pixel", "crs"}


# --- writing ------------------------------------------------------------------------------------------------------
def test_cog_has_tiles_and_overviews_and_is_read_by_gdal(tmp_path: Path) -> None:
    pixels = np.random.default_rng(3).integers(0, 255, (1500, 1100, 3), dtype=np.uint8)
    picture = GeoImage(pixels, (0.25, 0.0, 665000.0, 0.0, -0.25, 5905000.0), UTM)
    data = tif(picture)
    assert data == tif(picture), "no clock in it"
    (tmp_path / "a.tif").write_bytes(data)
    info = gdalinfo(tmp_path / "a.tif")
    assert info["size"] == [1100, 1500]
    assert info["geoTransform"] == [665000.0, 0.25, 0.0, 5905000.0, 0.0, -0.25]
    assert 'ID["EPSG",32630]' in info["coordinateSystem"]["wkt"]
    assert (
        info["metadata"]["IMAGE_STRUCTURE"] | {"COMPRESSION": "DEFLATE", "PREDICTOR": "2", "LAYOUT": "COG"}
        == (info["metadata"]["IMAGE_STRUCTURE"])
    )
    assert info["bands"][0]["block"] == [512, 512]
    assert [o["size"] for o in info["bands"][0]["overviews"]] == [[550, 750], [275, 375]]
    assert np.array_equal(read({"a.tif": data})[0].pixels, pixels)


def test_credits_are_written_and_read() -> None:
    context = WriteContext(attribution=("© Aerial Ltd", "CC BY 4.0"))
    layers = Layers({PartKey("imagery"): utm()})
    data = formats.write(get_format("satellite"), layers, context)["satellite.tif"]
    assert read({"a.tif": data})[0].attribution == ("© Aerial Ltd; CC BY 4.0",)


def test_png_with_world_file_matches_gdal(tmp_path: Path) -> None:
    turned = GeoImage(utm().pixels, (0.4, 0.3, 665000.0, 0.3, -0.4, 5905000.0), UTM)
    files, context = written(turned, file_type="png")
    assert sorted(files) == ["satellite.pgw", "satellite.png", "satellite.png.aux.xml"]
    assert context.dropped == []
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
    info = gdalinfo(tmp_path / "satellite.png")
    assert info["geoTransform"] == pytest.approx([665000.0, 0.4, 0.3, 5905000.0, 0.3, -0.4])
    assert 'ID["EPSG",32630]' in info["coordinateSystem"]["wkt"]
    back, _ = read(files, "satellite.pgw")
    assert np.array_equal(back.pixels, turned.pixels)
    assert back.crs == UTM
    assert back.transform == pytest.approx(turned.transform, abs=2e-9)
    assert written(back, file_type="png")[0] == files


def test_png_of_floats_reports_loss() -> None:
    values = np.array([[[10.0], [20.0]], [[15.0], [-9999.0]]], np.float32)
    picture = GeoImage(values, utm().transform, UTM, {"nodata": -9999.0})
    files, context = written(picture, file_type="png")
    shown = np.asarray(Image.open(io.BytesIO(files["satellite.png"])))
    assert shown.tolist() == [[[0, 255], [255, 255]], [[128, 255], [0, 0]]]
    (drop,) = context.dropped
    assert (drop.subject, drop.count) == ("pixel values", 4)
    assert "file_type=tif" in drop.why
    _, context = written(utm((3, 4, 6)), file_type="png")
    assert [(d.subject, d.count) for d in context.dropped] == [("bands", 5)]


def test_crs_option_resamples_image(tmp_path: Path) -> None:
    picture = utm((40, 60, 3))
    (tmp_path / "a.tif").write_bytes(written(picture, HERE, crs="local")[0]["satellite.tif"])
    info = gdalinfo(tmp_path / "a.tif")
    assert "Transverse Mercator" in info["coordinateSystem"]["wkt"]
    (tmp_path / "b.tif").write_bytes(tif(picture, crs="wgs84"))
    box = crs_bounds(UTM, picture.outline(32))
    assert box is not None
    for name in ("a.tif", "b.tif"):
        extent = np.array(gdalinfo(tmp_path / name)["wgs84Extent"]["coordinates"][0])
        assert extent.min(axis=0) == pytest.approx(box[:2], abs=1e-5)
        assert extent.max(axis=0) == pytest.approx(box[2:], abs=1e-5)
    with pytest.raises(MissingDatum, match="datum"):
        written(picture, crs="local")
    with pytest.raises(Invalid, match="set one of them"):
        written(picture, resampling="nearest")


TURNED = Datum(53.2686123456, -0.5245123456, heading=37.5)


@pytest.mark.parametrize("crs", ["source", "local"])
@pytest.mark.parametrize("kind", ["tif", "png"])
def test_local_image_is_placed_on_earth_with_the_heading(kind: str, crs: str, tmp_path: Path) -> None:
    """Corners as GDAL computes them from the file are those of the local frame to 1 mm, and come back unchanged."""
    transform = (0.04, 0.03, 812.25, 0.03, -0.04, -1500.5) if crs == "source" else (0.05, 0.0, 812.25, 0.0, -0.05, 9.5)
    picture = GeoImage(np.arange(60, dtype=np.uint8).reshape(4, 5, 3), transform)
    files, context = written(picture, TURNED, file_type=kind, crs=crs)
    assert context.warnings == []
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
    frame = local_frame(TURNED)
    corners = np.array([[0.0, 0.0], [5.0, 0.0], [5.0, 4.0], [0.0, 4.0]])
    degrees = gdaltransform(tmp_path / f"satellite.{kind}", corners)
    off = frame.to_local(degrees) - pixel_positions(transform, corners[:, 0], corners[:, 1])
    assert np.abs(off).max() < 1e-3
    back, context = read(files, f"satellite.{kind}", frame=frame)
    assert (back.crs, back.transform, context.warnings) == ("local", transform, [])
    elsewhere, _ = read(files, f"satellite.{kind}", frame=local_frame(HERE))
    assert elsewhere.crs != "local"
    box = crs_bounds(elsewhere.crs, elsewhere.outline())
    assert box is not None
    assert np.abs(np.array(box) - [*degrees.min(axis=0), *degrees.max(axis=0)]).max() < 1e-8


def gdaltransform(path: Path, pixels: Any) -> Any:
    """Convert (column, row) of a file to (longitude, latitude) with GDAL's own program."""
    program = shutil.which("gdaltransform")
    if program is None:
        pytest.skip("gdaltransform is not installed")
    lines = "\n".join(f"{u} {v}" for u, v in pixels.tolist())
    done = subprocess.run(
        [program, "-output_xy", "-t_srs", "EPSG:4326", path], input=lines, capture_output=True, text=True, check=True
    )
    return np.array([[float(word) for word in line.split()] for line in done.stdout.splitlines()])


def test_resolution_option_resamples_image() -> None:
    back, _ = read({"a.tif": tif(utm((40, 60, 3)), resolution=2.0)})
    assert back.pixels.shape[:2] == (10, 15)
    assert back.transform == (2.0, 0.0, 665000.0, 0.0, -2.0, 5905000.0)
    with pytest.raises(Invalid, match="coarser resolution"):
        tif(utm(), resolution=1e-6)


def test_image_is_selected_by_name_and_level() -> None:
    fmt = get_format("satellite")
    keys = [PartKey("imagery", name="a"), PartKey("imagery", name="b")]
    with pytest.raises(MissingLayer, match="GeoTIFF"):
        fmt.selection.choose([], WriteOptions())
    with pytest.raises(Ambiguous, match=r"\(a, b\): name one with picture=…"):
        fmt.selection.choose(keys, WriteOptions())
    assert fmt.selection.choose(keys, WriteOptions(picture="b")) == keys[1:]
    usual = PartKey("imagery", name="satellite")
    assert fmt.selection.choose([*keys, usual], WriteOptions()) == [usual]
    with pytest.raises(NotFound):
        fmt.selection.choose(keys, WriteOptions(picture="c"))
    assert options_from_filename("satellite.tif") == {"file_type": "tif"}
    assert (
        options_from_filename("satellite.pgw") == options_from_filename("satellite.png.aux.xml") == {"file_type": "png"}
    )
    assert options_from_filename("plan.png") == {"file_type": "png", "picture": "plan"}
    assert options_from_filename("plan.txt") == {}


# --- limits -------------------------------------------------------------------------------------------------------
def test_limits_are_checked_before_anything_is_decoded() -> None:
    data = tif(utm((100, 100, 4), np.float64))
    for limits in (Limits(pixels=9_999), Limits(memory_bytes=800_000)):
        with pytest.raises(TooLarge, match="limit"):
            read({"a.tif": data}, limits=limits)
    read({"a.tif": data}, limits=Limits(pixels=10_000, memory_bytes=1_000_000))
    with pytest.raises(TooLarge, match="limit"):
        read({"a.png": image((100, 100, 3))}, limits=Limits(pixels=9_999), options={"metres_per_pixel": 1.0})


def test_reader_opens_only_given_bytes(tmp_path: Path) -> None:
    """A VRT, and a TIFF with false first bytes, are refused without opening the files that they refer to."""
    secret = tmp_path / "secret.tif"
    secret.write_bytes(tif(utm()))
    vrt = (
        f'<VRTDataset rasterXSize="4" rasterYSize="3"><VRTRasterBand dataType="Byte" band="1"><SimpleSource>'
        f"<SourceFilename>{secret}</SourceFilename></SimpleSource></VRTRasterBand></VRTDataset>"
    ).encode()
    for body in (vrt, b"II*\0" + vrt, b"GTIFF_DIR:1:" + str(secret).encode(), str(secret).encode()):
        with pytest.raises(UnreadableFile):
            read({"a.tif": body})


def bigger(data: bytes, tag: int, value: int) -> bytes:
    """Replace the value of a tag of the first page of a little-endian classic TIFF."""
    (at,) = struct.unpack_from("<I", data, 4)
    (count,) = struct.unpack_from("<H", data, at)
    for k in range(count):
        place = at + 2 + 12 * k
        if struct.unpack_from("<H", data, place)[0] == tag:
            return data[: place + 2] + struct.pack("<HII", 4, 1, value) + data[place + 12 :]
    raise AssertionError(f"no tag {tag}")


@pytest.mark.parametrize(("width", "height"), [(2**31 - 1, 2**31 - 1), (100_000, 100_000), (0, 3), (2**32 - 1, 1)])
def test_false_tiff_sizes_are_refused(width: int, height: int) -> None:
    data = (SAMPLES / "orchard.tif").read_bytes()
    false_size = bigger(bigger(data, 256, width), 257, height)
    tracemalloc.start()
    try:
        with pytest.raises((UnreadableFile, TooLarge)):
            read({"a.tif": false_size})
        assert tracemalloc.get_traced_memory()[1] < 2**24  # of gigabytes; servers of other tests allocate, too
    finally:
        tracemalloc.stop()


def test_crs_option_gives_same_pixels_as_resample() -> None:
    data = written(utm((8, 8, 1)), crs="wgs84")[0]["satellite.tif"]
    direct = resample(utm((8, 8, 1)), crs="EPSG:4326")
    assert np.array_equal(read({"a.tif": data})[0].pixels, direct.pixels)


def test_many_images_of_upload_are_grouped_in_time() -> None:
    lone, placed_itself = image(), (SAMPLES / "orchard.tif").read_bytes()
    files: dict[str, bytes] = {}
    for k in range(2000):
        files |= {
            f"{k}.png": lone,
            f"{k}.pgw": b"1 0 0 -1 0 0",
            f"t{k}.tif": placed_itself,
            f"t{k}.tfw": b"1 0 0 -1 0 0",
        }
    start = time.process_time()
    groups, rest = formats.group(files)
    assert time.process_time() - start < 60
    assert len(groups) == 4000
    assert rest == []
    assert all(len(g.files) == 2 for g in groups)
