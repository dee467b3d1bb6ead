"""GeoPackage: whole round trips, facts by GDAL and QGIS, edited files, and files that attack SQLite."""

from __future__ import annotations

import json
import shutil
import sqlite3
import struct
import subprocess
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from app import formats
from app.errors import BadUpload, TooLarge, UnreadableFile
from app.formats import FileGroup, ReadContext, WriteContext
from app.limits import Limits
from app.model.features import NO_GEOMETRY, Features, features
from app.model.frame import Datum, Level
from app.model.layers import NETWORK, SITE, ZONES, Layers, PartKey
from app.parameters import parse
from tests import qgis

FMT = formats.get_format("gpkg")
SAMPLE = Path(__file__).parents[1] / "samples" / "gpkg" / "field.gpkg"
HOME = PartKey("objects", "ground", "gpkg")
TOPOLOGY = PartKey("topology", "ground", NETWORK)
DATUM = Datum(53.2686, -0.5245, heading=30.0)


def read(data: bytes, context: ReadContext | None = None, **options: Any) -> Layers:
    return formats.read(FileGroup(FMT, "a.gpkg", {"a.gpkg": data}), context or ReadContext(**options))


def write(layers: Layers, context: WriteContext | None = None) -> bytes:
    (data,) = formats.write(FMT, layers, context or WriteContext()).values()
    return data


def part(layers: Layers, key: PartKey) -> Features:
    content = layers.parts[key]
    assert isinstance(content, Features)
    return content


def as_rows(layers: Layers) -> dict[PartKey, list[tuple[Any, ...]]]:
    """Return all features sorted by id, with exact coordinates and types of values."""
    out = {}
    for key, content in layers.parts.items():
        assert isinstance(content, Features)
        rows = [
            (f.id, f.anchor, shapely.to_wkb(f.geometry, output_dimension=3), json.dumps(f.properties, sort_keys=True))
            for f in content
        ]
        out[key] = sorted(rows)
    return out


def site() -> dict[PartKey, Features]:
    network = [
        ("gate", shapely.Point(0, 0), {"kind": "node", "name": "Gate", "orientation": [0.0, 0.0, 0.0, 1.0]}),
        ("barn", shapely.Point(100, 50, 2), {"kind": "node", "name": "Bärn", "tags": {"a": [1, None]}}),
        ("e1", shapely.LineString([(0, 0), (100, 50)]),
         {"kind": "edge", "source": "gate", "target": "barn", "speed_limit": 1.5, "width": 2, "blocked": True}),
        ("e2", shapely.LineString([(100, 50), (0, 0)]),
         {"kind": "edge", "source": "barn", "target": "gate", "speed_limit": 2, "width": 3, "Width": "wide"}),
    ]  # fmt: skip
    zone = ("z", shapely.box(10, 10, 20, 20), {"kind": "keepout", "value": -0.0, "note": None})
    fence = ("fence", shapely.box(-0.53, 53.26, -0.52, 53.27), {"kind": "fence"})
    things = [
        ("t1", shapely.MultiPoint([(1, 2), (3, 4)]), {"kind": "tree", "more": "x", "layer": "y", "big": 2**62}),
        ("t2", NO_GEOMETRY, {"kind": "note", "text": 'nul\0 and "quotes"'}),
        ("t3", shapely.GeometryCollection([shapely.Point(1, 2), shapely.LineString([(0, 0), (1, 1)])]), {"kind": "x"}),
        ("t4", shapely.box(0, 0, 1, 1), {"kind": "wall", "height": 2.5, "size": [1.0, 1.0, 2.5]}),
    ]
    return {
        TOPOLOGY: features(network, "local", {"lif": {"a": 1}}),
        PartKey("zones", "upper", ZONES): features([zone], "local"),
        PartKey("location", "ground", SITE): features([fence], "wgs84"),
        PartKey("objects", "ground", "kml"): features(things, "local"),
    }


def site_layers(datum: Datum | None) -> Layers:
    return Layers(site(), datum, (Level(), Level("upper", 3.5)))


# --- round trips ------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("datum", [None, Datum(53.2686, -0.5245), DATUM])
def test_everything_comes_back(datum: Datum | None) -> None:
    layers = site_layers(datum)
    data = write(layers)
    again = read(data)
    assert as_rows(again) == as_rows(layers)
    assert again.datum == datum
    assert again.levels == layers.levels
    assert {k: p.document for k, p in again.vector("topology").items()} == {TOPOLOGY: {"lif": {"a": 1}}}
    assert write(again) == data
    assert write(site_layers(datum)) == data, "the same layers give the same bytes"


values = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(st.characters(exclude_categories=("Cs",)), max_size=6),
    lambda inner: st.lists(inner, max_size=2) | st.dictionaries(st.text("ab", max_size=2), inner, max_size=2),
    max_leaves=4,
)  # fmt: skip
names = st.sampled_from(["kind", "name", "fid", "geom", "id", "layer", "more", "Name", "", "a b", '"', "é", "x" * 80])


@given(st.lists(st.dictionaries(names | st.text("ab", min_size=1, max_size=3), values, max_size=5), max_size=6))
def test_any_properties_come_back(rows: list[dict[str, Any]]) -> None:
    items = features([(f"i{k}", shapely.Point(k, -k), row) for k, row in enumerate(rows)], "local")
    layers = Layers({PartKey("objects", "ground", "kml"): items})
    again = read(write(layers))
    if rows:
        assert as_rows(again) == as_rows(layers)


def test_heading_is_turned_within_a_nanometre() -> None:
    """30° clockwise: local +y points 30° east of north."""
    layers = Layers({TOPOLOGY: features([("n", shapely.Point(0, 100), {"kind": "node"})], "local")}, DATUM)
    data = write(layers)
    with closing(sqlite3.connect(":memory:")) as database:
        database.deserialize(data)
        (blob,) = database.execute("SELECT geom FROM nodes").fetchone()
    east, north = struct.unpack("<2d", blob[-16:])
    assert (east, north) == pytest.approx((50.0, 86.602540378), abs=1e-9)
    back = part(read(data), TOPOLOGY).geometry[0]
    assert (back.x, back.y) == (0.0, 100.0)


# --- other programs ---------------------------------------------------------------------------------------------------
def lonlat_by_gdal(path: Path, table: str) -> list[float]:
    """Convert the only point of a table to longitude and latitude with Debian's GDAL."""
    if shutil.which("ogr2ogr") is None:
        pytest.skip("ogr2ogr is missing")
    out = subprocess.run(
        ["ogr2ogr", "-f", "GeoJSON", "-t_srs", "EPSG:4326", "-lco", "COORDINATE_PRECISION=12", "/vsistdout/",
         path, table],
        check=True, capture_output=True,
    )  # fmt: skip
    coordinates: list[float] = json.loads(out.stdout)["features"][0]["geometry"]["coordinates"]
    return coordinates


def test_gdal_places_metres_within_a_millimetre(tmp_path: Path) -> None:
    layers = Layers({TOPOLOGY: features([("n", shapely.Point(1234.5, -678.25), {"kind": "node"})], "local")}, DATUM)
    path = tmp_path / "a.gpkg"
    path.write_bytes(write(layers))
    longitude, latitude = lonlat_by_gdal(path, "nodes")
    frame = layers.frame
    assert frame is not None
    x, y = frame.to_local(np.array([[longitude, latitude]]))[0]
    assert (x, y) == pytest.approx((1234.5, -678.25), abs=1e-3)


_LOOK = """
rows = []
for table in sys.argv[2:]:
    layer = QgsVectorLayer(f"{sys.argv[1]}|layername={table}", table, "ogr")
    _, ok = layer.loadDefaultStyle()
    symbol = layer.renderer().symbols(QgsRenderContext())[-1].symbolLayer(0).layerType()
    to = QgsCoordinateTransform(layer.crs(), QgsCoordinateReferenceSystem("EPSG:4326"), QgsProject.instance())
    corner = next(layer.getFeatures()).geometry().vertexAt(0)
    point = to.transform(corner.x(), corner.y())
    rows.append([table, layer.isValid(), layer.featureCount(), ok, symbol, point.x(), point.y()])
answer(rows)
"""


def test_qgis_shows_arrows_at_the_right_place(tmp_path: Path) -> None:
    path = tmp_path / "a.gpkg"
    path.write_bytes(write(site_layers(DATUM)))
    lines = qgis.run(_LOOK, path, "edges", "nodes", "zones", "fence_wgs84", folder=tmp_path)
    assert [line[:5] for line in lines] == [
        ["edges", True, 2, True, "ArrowLine"],
        ["nodes", True, 2, True, "SimpleMarker"],
        ["zones", True, 1, True, "SimpleFill"],
        ["fence_wgs84", True, 1, True, "SimpleFill"],
    ]
    assert lines[1][5:] == pytest.approx([DATUM.longitude, DATUM.latitude], abs=1e-8)


def test_rows_added_by_gdal_belong_to_their_table(tmp_path: Path) -> None:
    """Edit as QGIS does: GDAL keeps the spatial index, the metadata and the other tables."""
    if shutil.which("ogrinfo") is None:
        pytest.skip("ogrinfo is missing")
    path = tmp_path / "a.gpkg"
    path.write_bytes(write(site_layers(Datum(53.2686, -0.5245))))
    sql = (
        "INSERT INTO nodes (geom, kind, name) SELECT geom, 'node', 'New' FROM nodes WHERE id = 'gate'",
        "UPDATE edges SET width = 7.5 WHERE id = 'e1'",
        "DELETE FROM zones",
    )
    for statement in sql:
        subprocess.run(
            ["ogrinfo", "-q", path, "-dialect", "SQLITE", "-sql", statement], check=True, capture_output=True
        )
    again = read(path.read_bytes())
    network = part(again, TOPOLOGY)
    assert sorted(network.ids) == ["barn", "e1", "e2", "gate", "nodes/3"]
    new = next(f for f in network if f.id == "nodes/3")
    assert new.properties == {"kind": "node", "name": "New"}
    assert new.geometry.equals(shapely.Point(0, 0))
    edited = {f.id: f.properties.get("width") for f in network}
    assert (edited["e1"], edited["e2"]) == (7.5, 3)
    assert not again.parts.get(PartKey("zones", "upper", ZONES))


def test_foreign_tables_become_objects_with_facts() -> None:
    """Facts worked out with Debian's cs2cs: EPSG:27700 to WGS 84."""
    context = ReadContext()
    objects = part(read(SAMPLE.read_bytes(), context), HOME)
    by_id = {f.id: f for f in objects}
    assert set(by_id) == {"a", "b", "desk", "empty", "7", "7#2", "fence", "tracks/1", "tracks/2"}
    oats = by_id["7"]
    assert dict(oats.properties) == {
        "kind": "field", "name": 'Oat "field"', "area": 0.5, "size m": 12, "when": "2024-05-01", "organic": True,
    }  # fmt: skip
    assert oats.anchor == "wgs84"
    assert len(oats.geometry.interiors) == 1
    assert oats.geometry.exterior.coords[0] == pytest.approx((-0.5023005, 53.2185348), abs=2e-5)
    assert by_id["desk"].anchor == "local"
    assert by_id["desk"].geometry.coords[0] == pytest.approx((0.9144, 1.2192), abs=1e-9), "feet"
    assert by_id["tracks/1"].geometry.coords[1] == (-0.521, 53.261, 13.0)
    assert not shapely.has_m(by_id["tracks/1"].geometry)
    assert dict(by_id["tracks/1"].properties) == {"kind": "path", "width": 2.5, "class": 3}
    assert by_id["b"].geometry.is_empty
    assert any("duplicate ids" in w.problem for w in context.warnings)


# --- files that attack ------------------------------------------------------------------------------------------------
def changed(*statements: str) -> bytes:
    """Return the sample after these statements."""
    with closing(sqlite3.connect(":memory:", isolation_level=None)) as database:
        database.deserialize(SAMPLE.read_bytes())
        database.execute("PRAGMA writable_schema = ON")
        for name in ("ST_IsEmpty", "ST_MinX", "ST_MaxX", "ST_MinY", "ST_MaxY"):
            database.create_function(name, 1, lambda geometry: 1)  # GDAL's, which the file's triggers call
        for statement in statements:
            database.execute(statement)
        return database.serialize()


def test_views_and_virtual_tables_are_not_run() -> None:
    endless = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT i AS fid, NULL AS geom FROM n"
    data = changed(
        "DROP TABLE tracks",
        f"CREATE VIEW tracks AS {endless}",
        "CREATE VIRTUAL TABLE texts USING fts5(a)",
        "INSERT INTO gpkg_contents (table_name, data_type) VALUES ('texts', 'attributes')",
    )
    context = ReadContext()
    objects = part(read(data, context), HOME)
    assert {w.where for w in context.warnings if "not views" in w.problem} == {"tracks", "texts"}
    assert "desk" in objects.ids


def test_a_contents_table_that_is_a_view_is_refused() -> None:
    data = changed("ALTER TABLE gpkg_contents RENAME TO c", "CREATE VIEW gpkg_contents AS SELECT * FROM c")
    with pytest.raises(UnreadableFile, match="no table gpkg_contents"):
        read(data)


def test_generated_columns_are_not_evaluated() -> None:
    data = changed("ALTER TABLE machines ADD COLUMN bomb AS (hex(zeroblob(1000000000)))")
    objects = part(read(data), HOME)
    assert all("bomb" not in p for p in objects.properties)


def test_a_schema_that_hides_code_in_a_table_is_refused_or_harmless() -> None:
    texts = (
        "CREATE TABLE machines (fid INTEGER PRIMARY KEY, name AS (load_extension('/tmp/x')))",
        "CREATE /* */ VIRTUAL TABLE machines USING fts5(a)",
        "CREATE VIEW machines AS SELECT 1",
    )
    for text in texts:
        data = changed(f"UPDATE sqlite_master SET sql = '{text.replace(chr(39), chr(39) * 2)}' WHERE name = 'machines'")
        try:
            objects = part(read(data), HOME)
            assert all(not str(i).startswith("Robot") for i in objects.ids)
        except BadUpload as error:
            assert error.problems


def test_triggers_do_not_run() -> None:
    data = changed("CREATE TRIGGER t AFTER INSERT ON machines BEGIN SELECT randomblob(1000000000); END")
    assert "desk" in part(read(data), HOME).ids


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        (b"\x01\x07\x00\x00\x00\x01\x00\x00\x00" * 1_000_000 + b"\x01\x01\x00\x00\x00", "more than 10000 parts"),
        (b"\x00\x00\x00\x00\x04\x00\x00\x00\x01" * 1_000_000, "more than 10000 parts"),
        (b"\x01\xbf\x0b\x00\x00\x01\x00\x00\x00" * 1_000_000, "more than 10000 parts"),
        (b"\x01\x02\x00\x00\x00\xff\xff\xff\x7f" + bytes(32), "invalid geometry"),
        (b"\x01\x08\x00\x00\x00\x02\x00\x00\x00" + bytes(32), "curves|invalid"),
        (b"\x01\x01\x00\x00\x00" + struct.pack("<2d", 1e300, 0.0), "position"),
        (b"\x01\x01\x00\x00\x00" + struct.pack("<2d", float("inf"), 0.0), "position"),
        (b"", "invalid geometry"),
    ],
    ids=["nested", "nested big endian", "nested zm", "points", "curve", "far", "infinite", "empty"],
)  # fmt: skip
def test_hostile_geometries_are_refused(code: bytes, reason: str) -> None:
    blob = (b"GP\x00\x01" + struct.pack("<i", 27700) + code).hex()
    with pytest.raises(UnreadableFile, match=reason) as caught:
        read(changed(f'UPDATE "plots ""east""" SET WKT = x\'{blob}\' WHERE fid = 1'))
    assert caught.value.problems[0].file == "a.gpkg"


@pytest.mark.parametrize(
    ("statement", "reason"),
    [
        ("UPDATE gpkg_geometry_columns SET srs_id = 99", "unknown srs_id 99"),
        (
            "UPDATE gpkg_spatial_ref_sys SET organization = 'x', definition = 'PROJCS[' WHERE srs_id = 27700",
            "unknown CRS",
        ),
        (f"UPDATE gpkg_spatial_ref_sys SET organization = 'x', definition = '{'x' * 70_000}'", "the limit is 65536"),
        ("UPDATE gpkg_geometry_columns SET srs_id = 0", "names no CRS .*crs=EPSG"),
        ("UPDATE gpkg_spatial_ref_sys SET organization_coordsys_id = '999999' WHERE srs_id = 27700", "unknown CRS"),
        ("UPDATE gpkg_geometry_columns SET column_name = 'shape'", "no column 'shape'"),
        ("UPDATE gpkg_geometry_columns SET srs_id = 4326", "outside"),
    ],
)
def test_wrong_references_are_refused(statement: str, reason: str) -> None:
    with pytest.raises(UnreadableFile, match=reason):
        read(changed(statement))


def test_option_crs_places_a_table_without_one() -> None:
    data = changed("UPDATE gpkg_geometry_columns SET srs_id = 0 WHERE table_name LIKE 'plots%'")
    options = parse(FMT.read_options, {"crs": "EPSG:27700"})
    plain, placed = read(SAMPLE.read_bytes()), read(data, ReadContext(options=options))
    assert as_rows(placed) == as_rows(plain)


def test_limits_hold() -> None:
    with pytest.raises(TooLarge, match="more than 3 features"):
        read(SAMPLE.read_bytes(), ReadContext(limits=Limits(features=3)))


def test_write_ahead_log_header_is_read() -> None:
    data = SAMPLE.read_bytes()
    assert as_rows(read(data[:18] + b"\x02\x02" + data[20:])) == as_rows(read(data))


def test_tiles_without_a_table_are_warned_of() -> None:
    context = ReadContext()
    read(changed("INSERT INTO gpkg_contents (table_name, data_type) VALUES ('photo', 'tiles')"), context)
    assert "photo" in str(context.warnings)
