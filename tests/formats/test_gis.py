"""Shapefile, GML, FlatGeobuf and DXF: facts worked out by hand or by GDAL's tools, and files that attack GDAL."""

from __future__ import annotations

import re
import shutil
import subprocess
import zipfile
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest
import shapely

from app import formats
from app.errors import BadUpload, Invalid, TooLarge, UnreadableFile
from app.formats import FileGroup, ReadContext, WriteContext
from app.formats.gis.dxf import check_blocks
from app.limits import Limits
from app.model.features import Features, features
from app.model.frame import Datum
from app.model.geodesy import local_frame
from app.model.layers import NETWORK, SITE, Layers, PartKey
from app.parameters import parse
from app.syntax import ogr
from app.upload_reader import EnvironmentContext, UploadHints, unpack
from app.upload_reader import read as read_upload

SAMPLES = Path(__file__).parents[1] / "samples"
SHAPEFILE = {p.name: p.read_bytes() for p in sorted((SAMPLES / "shapefile" / "field").iterdir())}
GML = (SAMPLES / "gml" / "plots.gml").read_bytes()
FGB = (SAMPLES / "flatgeobuf" / "plots.fgb").read_bytes()
DXF = (SAMPLES / "dxf" / "plan.dxf").read_bytes()


def read(name: str, files: dict[str, bytes] | bytes, context: ReadContext | None = None, **options: Any) -> Layers:
    fmt = formats.get_format(name)
    files = {f"a.{name}": files} if isinstance(files, bytes) else files
    main = next(n for n in files if fmt.detect(n, files[n]))
    context = context or ReadContext()
    if options:
        context.options = parse(fmt.read_options, options)
    return formats.read(FileGroup(fmt, main, files), context)


def objects(name: str, files: dict[str, bytes] | bytes, context: ReadContext | None = None, **options: Any) -> Features:
    part = read(name, files, context, **options).parts[PartKey("objects", "ground", name)]
    assert isinstance(part, Features)
    return part


# --- facts ------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("name", "files"), [("shapefile", SHAPEFILE), ("flatgeobuf", FGB)])
def test_british_grid_becomes_degrees(name: str, files: Any) -> None:
    """EPSG:27700 500100, 370100 is 53.21853° N, 0.50230° W by Debian's cs2cs."""
    part = objects(name, files)
    assert sorted(part.ids) == ["7", "7#2", "fence"]
    oats = next(f for f in part if f.properties.get("name") == 'Oat "field"')
    assert oats.properties["kind"] == "field"
    assert (oats.properties["area"], oats.properties["size m"]) == (0.5, 12)
    assert oats.properties["when"].startswith("2024-05-01")
    west, south, _, _ = oats.geometry.bounds
    assert (west, south) == pytest.approx((-0.50230, 53.21852), abs=2e-5)
    assert {f.properties.get("name") for f in part} == {'Oat "field"', "Größe", "fence"}
    assert not part.local.any()


def test_zipped_boundary_becomes_the_fence() -> None:
    packed = BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for file, data in SHAPEFILE.items():
            archive.writestr(f"field/{file}", data)
    files = unpack({"field.zip": packed.getvalue()}, Limits())
    bundle = read_upload(files, UploadHints(layer="location"), EnvironmentContext(), Limits())
    fence = bundle.parts[PartKey("location", "ground", SITE)]
    assert isinstance(fence, Features)
    assert fence.ids == ("fence",)
    assert fence.properties[0]["kind"] == "fence"
    assert not any("no format can read" in w.problem for w in bundle.warnings)


def test_gml_has_latitude_first_and_arcs() -> None:
    context = ReadContext()
    part = objects("gml", GML, context)
    by_id = {f.id: f for f in part}
    assert set(by_id) == {"plot.1", "track.1"}
    plot = by_id["plot.1"]
    assert plot.geometry.bounds == (-0.525, 53.268, -0.523, 53.269)
    assert len(plot.geometry.interiors) == 1
    assert dict(plot.properties) == {"kind": "region", "name": 'Oat "field" & Größe', "area": 0.75, "crop": "oat"}
    track = by_id["track.1"]
    assert len(track.geometry.coords) > 10, "the arc is a line of short pieces"
    assert track.properties["class"] == 2
    assert any("schemas are not followed" in w.problem for w in context.warnings)


def test_dxf_is_in_metres_with_resolved_blocks() -> None:
    context = ReadContext()
    part = objects("dxf", DXF, context)
    assert part.local.all()
    rows = [(f.geometry.geom_type, f.properties["dxf"]["layer"]) for f in part]
    assert rows == [
        ("Polygon", "WALLS"), ("LineString", "WALLS"), ("LineString", "WALLS"), ("LineString", "WALLS"),
        ("MultiPolygon", "Möbel"), ("Point", "Möbel"),
    ]  # fmt: skip
    room, _, _, arc, legs, label = part
    assert room.geometry.bounds == (0.0, 0.0, 10.0, 5.0), "millimetres"
    assert arc.geometry.coords[0] in ((5.0, 3.5), (6.0, 2.5))
    centres = sorted((round(p.centroid.x, 6), round(p.centroid.y, 6)) for p in legs.geometry.geoms)
    assert centres == [(7.0, 1.0), (7.0, 2.0)], "the table is turned by 90 degrees"
    assert label.properties["name"] == 'Room "A"'
    assert any("paper space" in w.problem for w in context.warnings)


def test_dxf_unit_is_never_guessed() -> None:
    for data in (DXF.replace(b"$INSUNITS", b"$OTHER"), DXF.replace(b" 70\n4\n", b" 70\n0\n", 1)):
        with pytest.raises(UnreadableFile, match="set metres_per_unit"):
            read("dxf", data)
        room = next(iter(objects("dxf", data, metres_per_unit="0.01")))
        assert room.geometry.bounds == (0.0, 0.0, 100.0, 50.0)


def test_dxf_layers_are_selected_by_name() -> None:
    assert {f.properties["dxf"]["layer"] for f in objects("dxf", DXF, layers="Möbel")} == {"Möbel"}
    with pytest.raises(UnreadableFile, match=r"unknown layer 'WALL' \(did you mean WALLS\?\); available: "):
        read("dxf", DXF, layers="WALL")


def test_surveyed_dxf_has_a_crs() -> None:
    part = objects("dxf", DXF, crs="EPSG:27700")
    assert not part.local.any()
    assert part.geometry[0].bounds[:2] == pytest.approx((-7.5571, 49.7668), abs=1e-3), "the grid's false origin"


def point_dxf(code: int, x: float, y: float, z: float) -> bytes:
    """Return a drawing of one point, with the code of its unit in ``$INSUNITS``."""
    lines = ["0", "SECTION", "2", "HEADER", "9", "$INSUNITS", "70", str(code), "0", "ENDSEC", "0", "SECTION", "2"]
    lines += ["ENTITIES", "0", "POINT", "8", "0", "10", str(x), "20", str(y), "30", str(z), "0", "ENDSEC", "0", "EOF"]
    return "\n".join([*lines, ""]).encode()


FOOT = 1200 / 3937
PLACES = {
    "EPSG:2263": (21, (982_000.0, 200_000.0, 100.0), (-74.008116, 40.715630, 100 * FOOT)),
    "EPSG:2263+6360": (21, (982_000.0, 200_000.0, 100.0), (-74.008116, 40.715630, 100 * FOOT)),
    "EPSG:32618": (21, (583_760.0 / FOOT, 4_507_600.0 / FOOT, 100.0), (-74.00833, 40.71506, 100 * FOOT)),
    "EPSG:27700": (4, (500_100_000.0, 370_100_000.0, 2000.0), (-0.50230, 53.21853, 2.0)),
}
"""Code of the unit, coordinates in it, and longitude, latitude and metres by Debian's cs2cs."""


@pytest.mark.parametrize("crs", PLACES)
def test_the_unit_of_a_drawing_becomes_that_of_its_crs(crs: str) -> None:
    code, coordinates, expected = PLACES[crs]
    context = ReadContext()
    (point,) = objects("dxf", point_dxf(code, *coordinates), context, crs=crs)
    assert shapely.get_coordinates(point.geometry, include_z=True)[0] == pytest.approx(expected, abs=2e-5)
    assert not context.warnings


def test_feet_of_other_length_than_those_of_the_crs_are_reported() -> None:
    context = ReadContext()
    (point,) = objects(
        "dxf", point_dxf(2, 982_000 / 0.3048 * FOOT, 200_000 / 0.3048 * FOOT, 0.0), context, crs="EPSG:2263"
    )
    assert point.geometry.coords[0][:2] == pytest.approx((-74.008116, 40.715630), abs=2e-6)
    assert ["metres_per_unit=0.3048006096" in w.problem for w in context.warnings] == [True]


def test_dxf_in_degrees_has_no_length_unit() -> None:
    with pytest.raises(UnreadableFile, match="metres_per_unit=1 if its coordinates are degrees"):
        read("dxf", point_dxf(4, -0.5, 53.2, 0.0), crs="wgs84")
    (point,) = objects("dxf", point_dxf(4, -0.5, 53.2, 0.0), crs="wgs84", metres_per_unit="1")
    assert point.geometry.coords[0][:2] == (-0.5, 53.2)


def test_shapefile_without_crs_or_index_is_refused() -> None:
    without = {name: data for name, data in SHAPEFILE.items() if not name.endswith(".prj")}
    with pytest.raises(UnreadableFile, match=r"names no CRS .*set crs=EPSG:<number>"):
        read("shapefile", without)
    placed, plain = objects("shapefile", without, crs="EPSG:27700"), objects("shapefile", SHAPEFILE)
    assert shapely.equals_exact(placed.geometry, plain.geometry, 1e-9).all()
    assert objects("shapefile", without, crs="local").local.all()
    with pytest.raises(UnreadableFile, match="outside"):
        read("shapefile", without, crs="wgs84")
    with pytest.raises(UnreadableFile, match="unknown CRS"):
        read("shapefile", without, crs="EPSG:0")
    with pytest.raises(UnreadableFile, match="upload all files"):
        read("shapefile", {name: data for name, data in SHAPEFILE.items() if not name.endswith(".shx")})


def test_flatgeobuf_comes_back(tmp_path: Path) -> None:
    rows = [
        ("a", shapely.Point(0, 0), {"kind": "node", "name": "Ä"}),
        ("b", shapely.Point(30, 40), {"kind": "node", "tags": {"x": [1]}}),
        ("e", shapely.LineString([(0, 0), (30, 40)]), {"kind": "edge", "source": "a", "target": "b", "width": 2}),
    ]
    key = PartKey("topology", "upper", NETWORK)
    fmt = formats.get_format("flatgeobuf")
    for datum in (None, Datum(53.2686, -0.5245, heading=30.0)):
        layers = Layers({key: features(rows, "local")}, datum)
        context = WriteContext()
        data = formats.write(fmt, layers, context)["map.fgb"]
        assert formats.write(fmt, layers, WriteContext())["map.fgb"] == data, "the same layers give the same bytes"
        again = read("flatgeobuf", data)
        part = again.parts[key]
        assert isinstance(part, Features)
        assert {f.id: dict(f.properties) for f in part} == {i: p for i, _, p in rows}
        assert bool(part.local.all()) == (datum is None)
        if layers.frame is not None:
            back = {f.id: g for f, g in zip(part, part.in_local(layers.frame), strict=True)}
            assert all(shapely.equals_exact(back[i], g, 1e-6) for i, g, _ in rows)
            assert [(d.subject, d.count) for d in context.dropped] == [("anchors of items in metres", 3)]
        if shutil.which("ogrinfo"):
            path = tmp_path / "a.fgb"
            path.write_bytes(data)
            out = subprocess.run(["ogrinfo", "-al", "-so", path], capture_output=True, text=True, check=True).stdout
            assert "Feature Count: 3" in out


# --- files that attack ------------------------------------------------------------------------------------------------
def test_gdal_has_no_other_drivers() -> None:
    assert set(ogr._pyogrio().list_drivers()) <= {"DXF", "ESRI Shapefile", "FlatGeobuf", "GML", "MEM", "Memory"}


@pytest.mark.parametrize("driver", ["DXF", "FlatGeobuf", "GML", "ESRI Shapefile"])
def test_vrt_that_names_a_file_is_refused(driver: Any, tmp_path: Path) -> None:
    secret = tmp_path / "secret.csv"
    secret.write_text("a\nsecret\n")
    layer = f'<OGRVRTLayer name="secret"><SrcDataSource>{secret}</SrcDataSource></OGRVRTLayer>'
    with pytest.raises(UnreadableFile):
        ogr.read_layers(f"<OGRVRTDataSource>{layer}</OGRVRTDataSource>".encode(), driver, Limits())


def test_gml_follows_no_reference(tmp_path: Path) -> None:
    other = tmp_path / "other.gml"
    other.write_bytes(GML.replace(b"Oat", b"SECRET"))
    member = f'<wfs:member xlink:href="file://{other}#plot.1"/></wfs:FeatureCollection>'.encode()
    data = GML.replace(b"</wfs:FeatureCollection>", member)
    data = data.replace(b"urn:farm https", f"urn:farm {other} https".encode())
    part = objects("gml", data)
    assert "SECRET" not in str([dict(f.properties) for f in part])
    assert len(part) == 2


@pytest.mark.parametrize(
    "prolog",
    [
        '<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]>',
        '<!DOCTYPE x [<!ENTITY a SYSTEM "file:///etc/passwd">]>',
    ],
)
def test_gml_with_entities_is_refused(prolog: str) -> None:
    data = GML.replace(b"<wfs:Fea", prolog.encode() + b"<wfs:Fea", 1)
    with pytest.raises(UnreadableFile, match="DOCTYPE"):
        read("gml", data)


def bomb(depth: int, width: int) -> bytes:
    """Return a drawing whose blocks each insert the one before ``width`` times."""
    blocks = "  0\nBLOCK\n  8\n0\n  2\nB0\n  0\nPOINT\n  8\n0\n 10\n0.0\n 20\n0.0\n  0\nENDBLK\n"
    for k in range(1, depth):
        insert = f"  0\nINSERT\n  8\n0\n  2\nB{k - 1}\n 10\n0.0\n 20\n0.0\n"
        blocks += f"  0\nBLOCK\n  8\n0\n  2\nB{k}\n{insert * width}  0\nENDBLK\n"
    entities = f"  0\nINSERT\n  8\n0\n  2\nB{depth - 1}\n 10\n0.0\n 20\n0.0\n"
    head = "  0\nSECTION\n  2\nHEADER\n  9\n$INSUNITS\n 70\n6\n  0\nENDSEC\n"
    sections = f"  0\nSECTION\n  2\nBLOCKS\n{blocks}  0\nENDSEC\n  0\nSECTION\n  2\nENTITIES\n{entities}  0\nENDSEC\n"
    return f"{head}{sections}  0\nEOF\n".encode()


def test_nested_blocks_are_counted_before_they_are_resolved() -> None:
    check_blocks(bomb(4, 10), 2000)
    with pytest.raises(TooLarge, match="entities with all blocks resolved; the limit is 5000000"):
        read("dxf", bomb(12, 10))
    with pytest.raises(UnreadableFile, match="nested deeper than 32"):
        read("dxf", bomb(40, 1))
    loop = bomb(3, 2).replace(b"BLOCK\n  8\n0\n  2\nB0\n", b"BLOCK\n  8\n0\n  2\nB0\n  0\nINSERT\n  2\nB2\n")
    with pytest.raises(UnreadableFile, match="nested deeper"):
        read("dxf", loop)
    rows = bomb(2, 1).replace(b"INSERT\n  8\n0\n  2\nB1\n", b"INSERT\n  8\n0\n  2\nB1\n 70\n9999\n 71\n9999\n")
    with pytest.raises(TooLarge):
        read("dxf", rows)


def test_binary_dxf_is_refused_with_a_reason() -> None:
    with pytest.raises(UnreadableFile, match="save it as text"):
        read("dxf", b"AutoCAD Binary DXF\r\n\x1a\0" + bytes(100))


def test_limits_hold() -> None:
    for name, files in (("shapefile", SHAPEFILE), ("flatgeobuf", FGB), ("gml", GML), ("dxf", DXF)):
        with pytest.raises((TooLarge, BadUpload), match=r"more than|the limit"):
            read(name, files, ReadContext(limits=Limits(features=1)))


def test_features_that_a_header_invents_are_refused() -> None:
    """A count of features is in the header as a 64-bit number: replace it."""
    count = (3).to_bytes(8, "little")
    at = [m.start() for m in re.finditer(re.escape(count), FGB[:2000])]
    assert at
    for k in at:
        data = FGB[:k] + (2**40).to_bytes(8, "little") + FGB[k + 8 :]
        try:
            read("flatgeobuf", data)
        except (BadUpload, Invalid) as error:
            assert error.detail


def metres_dxf(*squares: tuple[str, float], unit: int = 6) -> bytes:
    """Return a drawing of squares (layer, side in units) with a corner at (10, 20)."""
    rows = [
        "0",
        "SECTION",
        "2",
        "HEADER",
        "9",
        "$INSUNITS",
        "70",
        str(unit),
        "0",
        "ENDSEC",
        "0",
        "SECTION",
        "2",
        "ENTITIES",
    ]
    for layer, side in squares:
        rows += ["0", "LWPOLYLINE", "8", layer, "100", "AcDbEntity", "100", "AcDbPolyline", "90", "4", "70", "1"]
        for x, y in ((10, 20), (10 + side, 20), (10 + side, 20 + side), (10, 20 + side)):
            rows += ["10", f"{x:.1f}", "20", f"{y:.1f}"]
    return "\n".join([*rows, "0", "ENDSEC", "0", "EOF", ""]).encode()


def test_local_dxf_is_the_fence_at_its_place_on_earth() -> None:
    data = metres_dxf(("WALLS", 5.0), ("SITE_BOUNDARY", 100.0))
    datum = Datum(53.2686, -0.5245, heading=90.0)
    bundle = read_upload({"a.dxf": data}, UploadHints(layer="location"), EnvironmentContext(datum), Limits())
    fence = bundle.parts[PartKey("location", "ground", SITE)]
    assert isinstance(fence, Features)
    assert [p["kind"] for p in fence.properties] == ["fence"]
    # A heading of 90 degrees: x points south, y east. A degree of latitude is 111.3 km here, of longitude 66.7 km.
    (polygon,) = fence.in_wgs84(local_frame(datum))
    west, south, east, north = polygon.bounds
    assert (west - datum.longitude, east - datum.longitude) == pytest.approx((20 / 66_720, 120 / 66_720), rel=2e-3)
    assert (north - datum.latitude, south - datum.latitude) == pytest.approx((-10 / 111_300, -110 / 111_300), rel=2e-3)
    rest = bundle.parts[PartKey("objects", "ground", "dxf")]
    assert isinstance(rest, Features)
    assert [p["dxf"]["layer"] for p in rest.properties] == ["WALLS"]


@pytest.mark.parametrize("layer", ["location", "zones", "topology", "objects"])
def test_local_dxf_is_any_layer_without_a_datum(layer: Any) -> None:
    data = metres_dxf(("A", 100.0), unit=0)
    hints = UploadHints(layer=layer, options={"metres_per_unit": "2"})
    bundle = read_upload({"a.dxf": data}, hints, EnvironmentContext(), Limits())
    (part,) = [p for key, p in bundle.parts.items() if key.layer == layer and isinstance(p, Features)]
    assert part.local.all()
    assert shapely.total_bounds(part.geometry).tolist() == [20.0, 40.0, 220.0, 240.0]
