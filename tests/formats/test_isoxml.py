"""ISOXML: facts of the sample, fences among obstacles, and damaged files."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import shapely
from lxml import etree

from app import formats
from app.errors import UnreadableFile
from app.formats import FileGroup, ReadContext, WriteContext
from app.limits import Limits
from app.model.features import Features, features
from app.model.frame import Datum
from app.model.geodesy import local_frame
from app.model.layers import NETWORK, SITE, ZONES, Layers, PartKey
from app.upload_reader import EnvironmentContext, UploadHints
from app.upload_reader import read as read_upload

FILES = {p.name: p.read_bytes() for p in (Path(__file__).parents[1] / "samples" / "isoxml" / "task").iterdir()}
MAIN = "TASKDATA.XML"


def objects(files: dict[str, bytes], context: ReadContext | None = None) -> Features:
    group = FileGroup(formats.get_format("isoxml"), MAIN, files)
    part = formats.read(group, context or ReadContext()).parts[PartKey("objects", "ground", "isoxml")]
    assert isinstance(part, Features)
    return part


def test_sample_matches_facts() -> None:
    part = {f.id: f for f in objects(FILES)}
    assert set(part) == {"PFD1/PLN1", "PLN9", "PFD1/PNT3", "GPN1", "PFD2/LSG5"}
    boundary = part["PFD1/PLN1"]
    assert boundary.geometry.exterior.bounds == (-0.525, 53.268, -0.523, 53.269), "longitude, latitude"
    assert len(boundary.geometry.interiors) == 1
    assert dict(boundary.properties) == {
        "kind": "region", "name": 'Oat "Größe" boundary', "isoxml": {"field": 'Oat "Größe"', "type": "boundary"},
    }  # fmt: skip
    assert part["PLN9"].properties["isoxml"]["type"] == "obstacle"
    assert list(part["PFD1/PNT3"].geometry.coords) == [(-0.524, 53.268, 31.5)]
    assert part["GPN1"].properties["isoxml"] == {"field": 'Oat "Größe"', "type": "guidance line", "group": "Rows"}
    assert list(part["GPN1"].geometry.coords) == [(-0.5249, 53.2681), (-0.5249, 53.2689)]
    assert part["PFD2/LSG5"].properties["isoxml"] == {"field": "Hay", "type": "fence"}


def test_boundary_becomes_the_fence_beside_obstacles() -> None:
    bundle = read_upload(FILES, UploadHints(layer="location"), EnvironmentContext(), Limits())
    fence = bundle.parts[PartKey("location", "ground", SITE)]
    assert isinstance(fence, Features)
    assert [p["kind"] for p in fence.properties] == ["fence"]
    assert fence.ids == ("PFD1/PLN1",)


def test_missing_file_of_a_field_is_reported() -> None:
    context = ReadContext()
    assert len(objects({MAIN: FILES[MAIN]}, context)) == 4
    assert context.warnings[0].problem == "PFD00002 is not in the upload"


def test_elements_without_a_shape_are_counted() -> None:
    context = ReadContext()
    objects(FILES, context)
    assert [w.problem for w in context.warnings] == [
        "not read: CTR (1); only the shapes and guidance lines of fields (PFD) are"
    ]


def test_a_type_with_leading_zeros_is_no_error() -> None:
    data = FILES[MAIN].replace(b'<PLN A="1"', b'<PLN A="0001999"', 1)
    assert objects({MAIN: data}).properties[0]["isoxml"]["type"] == "other"


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ('C="53.268"', 'C="91"', "must be a number within ±90"),
        ('D="-0.525"', 'D="nan"', "must be a number within ±180"),
        ('D="-0.525"', "", "must be a number within ±180"),
        ('E="31500"', 'E="1e99"', "must be a number"),
        ("<ISO", '<!DOCTYPE a [<!ENTITY b "c">]><ISO', "DOCTYPE"),
    ],
)
def test_wrong_values_are_refused(old: str, new: str, reason: str) -> None:
    data = FILES[MAIN].decode().replace(old, new, 1).encode()
    with pytest.raises(UnreadableFile, match=reason) as caught:
        objects({MAIN: data})
    assert caught.value.problems[0].line


# --- writing ----------------------------------------------------------------------------------------------------------
DATUM = Datum(53.2686, -0.5245, heading=30.0)
FORMAT = formats.get_format("isoxml")

TEXT, NUMBER, COUNT = r".{1,32}", r"-?[0-9]+(\.[0-9]{1,15})?", r"[0-9]{1,10}"
SCHEMA = {
    "ISO11783_TaskData": (
        {"VersionMajor": "4", "VersionMinor": "[0-3]", "DataTransferOrigin": "[12]",
         "ManagementSoftwareManufacturer": TEXT, "ManagementSoftwareVersion": TEXT}, {}, {"PFD"}),
    "PFD": ({"A": r"PFD-?[0-9]{1,11}", "C": TEXT, "D": COUNT}, {}, {"PLN", "LSG", "PNT", "GGP"}),
    "PLN": ({"A": "[1-9]|1[0-2]"}, {"B": TEXT, "C": COUNT, "E": r"PLN-?[0-9]{1,11}"}, {"LSG"}),
    "LSG": ({"A": "[1-9]"}, {"B": TEXT, "C": COUNT, "F": r"LSG-?[0-9]{1,11}"}, {"PNT"}),
    "PNT": ({"A": "[1-9]|1[01]", "C": NUMBER, "D": NUMBER},
            {"B": TEXT, "E": r"-?[0-9]{1,10}", "G": r"PNT-?[0-9]{1,11}"}, set()),
    "GGP": ({"A": r"GGP-?[0-9]{1,11}"}, {"B": TEXT}, {"GPN"}),
    "GPN": ({"A": r"GPN-?[0-9]{1,11}", "C": "[1-5]"},
            {"B": TEXT, **dict.fromkeys("DEF", "[1-4]"), "G": NUMBER, **dict.fromkeys("HNO", COUNT)}, {"LSG"}),
}  # fmt: skip
"""Required attributes, optional ones and children of each element, by the public schema of ISO 11783-10, version 4."""


def check_schema(root: etree._Element) -> None:
    identifiers: list[str] = []
    for element in root.iter():
        required, optional, children = SCHEMA[str(element.tag)]
        assert set(required) <= set(element.attrib) <= {*required, *optional}, element.attrib
        for name, value in element.attrib.items():
            assert re.fullmatch({**required, **optional}[str(name)], str(value)), (element.tag, name, value)
        assert {child.tag for child in element} <= children
        identifiers += [str(v) for v in element.attrib.values() if re.fullmatch(r"[A-Z]{3}-?[0-9]+", str(v))]
    assert len(identifiers) == len(set(identifiers))
    for polygon in root.iter("PLN"):
        kinds = [line.get("A") for line in polygon]
        assert kinds.count("1") == 1, "one exterior"
        assert set(kinds) <= {"1", "2"}
    for pattern in root.iter("GPN"):
        (line,) = pattern
        assert line.get("A") == "5"
        ends = [point.get("A") for point in line]
        if pattern.get("C") in ("1", "3"):
            assert ends == ["6", *["9"] * (len(ends) - 2), "7"]


def layers() -> Layers:
    pair = shapely.LineString([(0, 0), (100, 0)])
    network = [
        ("a", shapely.Point(0, 0), {"kind": "node"}), ("b", shapely.Point(100, 0), {"kind": "node"}),
        ("e1", pair, {"kind": "edge", "source": "a", "target": "b", "name": "Row 1", "width": 1.5}),
        ("e2", shapely.reverse(pair), {"kind": "edge", "source": "b", "target": "a"}),
        ("e3", shapely.LineString([(0, 0), (50, 9), (100, 0)]), {"kind": "edge", "source": "a", "target": "b"}),
    ]  # fmt: skip
    two = shapely.MultiPolygon([shapely.box(20, 20, 30, 30), shapely.box(40, 20, 50, 30)])
    zones = [("k", shapely.box(5, 5, 9, 9), {"kind": "keepout"}), ("s", two, {"kind": "speed", "name": "s" * 40})]
    things = [
        ("h", shapely.box(60, 20, 70, 30), {"kind": "building", "name": "Bärn\x00", "height": 4.0}),
        ("t", shapely.Point(80, 20, 2.5), {"kind": "tree"}),
        ("p", shapely.LineString([(0, 40), (9, 40)]), {"kind": "path"}),
    ]  # fmt: skip
    fence = [("f", shapely.box(-10, -10, 110, 60), {"kind": "fence"})]
    return Layers({
        PartKey("topology", "ground", NETWORK): features(network, "local"),
        PartKey("zones", "ground", ZONES): features(zones, "local"),
        PartKey("objects", "ground", "kml"): features(things, "local"),
        PartKey("location", "ground", SITE): features(fence, "local"),
    }, DATUM)  # fmt: skip


def test_site_becomes_a_valid_field() -> None:
    context = WriteContext(title="Home")
    data = formats.write(FORMAT, layers(), context)
    assert formats.write(FORMAT, layers(), WriteContext(title="Home")) == data
    root = etree.fromstring(data[MAIN])
    check_schema(root)
    (field,) = root
    assert (field.get("C"), int(field.get("D"))) == ("Home", pytest.approx(120 * 70, abs=1)), "square metres"
    assert [p.get("A") for p in field.iter("PLN")] == ["1", "4", "6", "2", "2"]
    assert [(p.get("C"), p[0].get("C")) for p in field.iter("GPN")] == [("1", "1500"), ("3", None)]
    assert {d.subject: d.count for d in context.dropped} == {
        "lines": 1, "nodes": 2, "further properties": 1, "ends of long names": 2, "joins of several shapes": 1,
        "properties of edges": 4,
    }  # fmt: skip
    back = {f.properties["isoxml"]["type"]: f for f in objects(data)}
    assert back["boundary"].properties["name"] == "Home boundary"
    metres = local_frame(DATUM).geometries_to_local(np.array([back["boundary"].geometry, back["other"].geometry]))
    assert shapely.hausdorff_distance(metres[0], shapely.box(-10, -10, 110, 60)) < 2e-4
    assert shapely.distance(metres[1], shapely.Point(80, 20)) < 2e-4
    assert shapely.get_z(metres[1]) == 2.5


def test_fields_that_were_read_come_back_whole() -> None:
    first = objects(FILES)
    context = WriteContext()
    data = formats.write(FORMAT, Layers({PartKey("objects", "ground", "isoxml"): first}), context)
    assert context.dropped == []
    check_schema(etree.fromstring(data[MAIN]))
    again = objects(data)
    assert again.ids == first.ids
    assert again.properties == first.properties
    assert shapely.equals_exact(again.geometry, first.geometry).all()


PATTERNS = b"""<?xml version="1.0"?>
<ISO11783_TaskData VersionMajor="4" VersionMinor="3"><PFD A="PFD1" C="Oats" D="0">
  <LSG A="6" C="300" F="LSG4"><PNT A="2" C="53.1" D="-0.5"/><PNT A="2" C="53.2" D="-0.5"/></LSG>
  <GGP A="GGP1" B="Ways">
    <GPN A="GPN7" B="circle" C="4" D="3" H="400000"><LSG A="5" C="6000"><PNT A="8" C="53.1" D="-0.5"/></LSG></GPN>
    <GPN A="GPN2" C="4" D="1" H="445000"><LSG A="5" C="6000"><PNT A="8" C="53.1" D="-0.5"/>
      <PNT A="6" C="53.104" D="-0.5"/><PNT A="7" C="53.1" D="-0.51"/></LSG></GPN>
    <GPN A="GPN3" C="2" G="45"><LSG A="5"><PNT A="6" C="53.1" D="-0.5"/></LSG></GPN>
    <GPN A="GPN4" C="1" E="2" G="0" N="3" O="4"><LSG A="5"><PNT A="6" C="53.1" D="-0.5"/>
      <PNT A="7" C="53.2" D="-0.5"/></LSG></GPN>
    <GPN A="GPN5" C="3"><LSG A="5"><PNT A="6" C="53.1" D="-0.5"/><PNT A="7" C="53.2" D="-0.5"/></LSG></GPN>
  </GGP>
</PFD></ISO11783_TaskData>"""


def written(part: Features, context: WriteContext) -> etree._Element:
    data = formats.write(FORMAT, Layers({PartKey("objects", "ground", "isoxml"): part}), context)
    root = etree.fromstring(data[MAIN])
    check_schema(root)
    return root


def test_guidance_patterns_come_back_whole() -> None:
    reading, writing = ReadContext(), WriteContext()
    part = objects({MAIN: PATTERNS}, reading)
    assert [w.problem.partition(":")[0] for w in reading.warnings] == [
        "3 guidance patterns are neither straight lines (AB) nor curves"
    ]
    assert {f.id: f.properties.get("width") for f in part} == {
        "LSG4": 0.3, "GPN7": 6.0, "GPN2": 6.0, "GPN3": None, "GPN4": None, "GPN5": None,
    }  # fmt: skip
    root, source = written(part, writing), etree.fromstring(PATTERNS)
    for tag in ("GPN", "LSG", "PNT"):
        assert [dict(e.attrib) for e in root.iter(tag)] == [dict(e.attrib) for e in source.iter(tag)]
    assert writing.dropped == []


def test_headings_and_radii_of_moved_points_are_reported() -> None:
    part = objects({MAIN: PATTERNS})
    moved = features(
        [(f.id, shapely.transform(f.geometry, lambda points: points + 1e-4), f.properties) for f in part], "wgs84"
    )
    context = WriteContext()
    patterns = {p.get("A"): dict(p.attrib) for p in written(moved, context).iter("GPN")}
    assert patterns["GPN2"] == {"A": "GPN2", "C": "4", "D": "1"}, "its points say the radius"
    assert patterns["GPN4"] == {"A": "GPN4", "C": "1", "E": "2", "N": "3", "O": "4"}
    assert (patterns["GPN7"]["H"], patterns["GPN3"]["G"]) == ("400000", "45"), "they do not depend on the place"
    assert {d.subject: d.count for d in context.dropped} == {"headings and radii": 2}


def test_a_pivot_that_became_another_line_is_no_straight_line() -> None:
    line = shapely.LineString([(-0.5, 53.1), (-0.5, 53.2), (-0.4, 53.2), (-0.4, 53.1)])
    changed = features([(f.id, line, f.properties) for f in objects({MAIN: PATTERNS})], "wgs84")
    context = WriteContext()
    assert [(p.get("A"), p.get("C")) for p in written(changed, context).iter("GPN")] == [("GPN4", "3"), ("GPN5", "3")]
    assert {d.subject: d.count for d in context.dropped} == {
        "guidance patterns": 3, "properties of guidance lines": 4
    }  # fmt: skip
