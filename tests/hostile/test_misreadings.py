"""Values out of range are rejected with their location; unknown content is reported by name. Nothing is misread."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from app import upload_reader
from app.errors import BadUpload, Problem
from app.formats import group_warnings
from app.limits import Limits
from app.model.frame import Datum
from app.upload_reader import EnvironmentContext, UploadHints
from tests.hostile.corpus import KML, SAMPLES

HERE = EnvironmentContext(Datum(50.0, 7.0))


@dataclass(frozen=True)
class Row:
    """Sample with one change. sample: folder and main file; its companions are included. old: pattern, replaced once.

    refused, warned: a text of the problem (one of the two).
    """

    sample: str
    old: str
    new: str
    refused: str = ""
    warned: str = ""
    where: str = ""


CODE = "\"__import__('os').system('true')\""
INCLUDE = "<i:include xmlns:i='http://www.w3.org/2001/XInclude'/><Point>"

ROWS = [
    Row("datum/datum.yaml", r"heading: 0\.?\d*", "heading: 500", refused="from -360 to 360"),
    Row("datum/datum.yaml", r"depot, latitude: [-\d.]+", "depot, latitude: 200", refused="from -90 to 90", where="lat"),
    Row("datum/datum.yaml", r"frequency: \S+", "frequency: 0", refused="above 0"),
    Row("datum/datum.yaml", r"xmin: [-\d.]+", "xmin: east", refused="must be a number"),
    Row("datum/datum.yaml", "gmapping:", "gmaping:", warned="unknown keys, kept without effect: gmaping"),
    Row("datum/datum.yaml", r"yaw_offset: \S+", "yaw_offset: 90.0", warned="is it in radians?"),
    Row("datum/datum.yaml", r"coords: \[\[", "coords: [[7.0, 50.0], [", warned="are latitude and longitude swapped?"),
    Row("tmap2/orchard.tmap2.yaml", r"xy_goal_tolerance: \S+", "xy_goal_tolerance: -1", refused="from 0 to"),
    Row("tmap2/orchard.tmap2.yaml", r"yaw_goal_tolerance: \S+", "yaw_goal_tolerance: 360", warned="is it in radians?"),
    Row("tmap2/orchard.tmap2.yaml", r"restrictions_planning: .*", f"restrictions_planning: {CODE}", warned="as code"),
    Row("tmap2/orchard.tmap2.yaml", r"restrictions_runtime: .*", f"restrictions_runtime: {CODE}", warned="as code"),
    Row("tmap2/orchard.tmap2.yaml", "fail_policy:", "failpolicy:", warned="nodes[].node.edges[].failpolicy"),
    Row("tmap2/orchard.tmap2.yaml", r"speed_limit: [\d.]+", "speed_limit: -2", warned="m/s"),
    Row("tmap2/orchard.tmap2.yaml", r"speed_limit: [\d.]+", "speed_limit: slow", warned="must be a number of m/s"),
    Row("tmap2/orchard.tmap2.yaml", r"surface: gravel", "width: narrow", warned="must be a number of metres"),
    Row("tmap2/orchard.tmap2.yaml", r"surface: gravel", "width: 0", warned="should be above 0"),
    Row("tmap2/orchard.tmap2.yaml", r"orientation: \{w: [\d.]+", "orientation: {w: 25.0", warned="must be 1"),
    Row("tmap2/orchard.tmap2.yaml", r"- x: [-\d.]+", "- x: 1.0e+12", refused="metres", where="verts"),
    Row("tmap/old.tmap", r"top_vel: \S+", "top_vel: -0.5", refused="m/s"),
    Row("tmap/old.tmap", r"inflation_radius: \S+", "inflation_radius: -1", refused="from 0 to"),
    Row("ffr_network/yard.ffr.yaml", r"width: \S+", "width: 0", warned="should be above 0"),
    Row("ffr_network/yard.ffr.yaml", r"width: \S+", "width: -1", refused="from 0 to"),
    Row("ffr_network/yard.ffr.yaml", "surface:", "surfacing:", warned="network_lines[].surfacing"),
    Row("prm/meadow/prm.yaml", r"weight: 3\.0", "weight: -3.0", refused="from 0 to"),
    Row("prm/meadow/prm.yaml", "surface:", "surfacing:", warned="edges[].surfacing"),
    Row("openrmf/yard/yard.building.yaml", "EPSG:", "EPSG:9", refused="unknown CRS", where="generate_crs"),
    Row("openrmf/clinic/clinic.building.yaml", r"alpha: \[3, [\d.]+", "alpha: [3, 200", refused="from 0 to 1"),
    Row("openrmf/clinic/clinic.building.yaml", r"speed_limit: \[3, [\d.]+", "speed_limit: [3, -1.0", refused="m/s"),
    Row("openrmf/clinic/clinic.building.yaml", r"type: \[1, \w+", "type: [1, portcullis", warned="'portcullis'"),
    Row(
        "openrmf/clinic/clinic.building.yaml", r"motion_degrees: \[3, [\d.]+", "motion_degrees: [3, 4000", refused="360"
    ),
    Row("openrmf/clinic/clinic.building.yaml", r"depth: [\d.]+", "depth: 0", refused="above 0", where="lifts."),
    Row("openrmf/clinic/clinic.building.yaml", r"scale: [\d.]+", "scale: -1", refused="metres per pixel"),
    Row("openrmf/clinic/clinic.building.yaml", "reference_floor_name:", "reference_flor_name:", warned="unknown keys"),
    Row("openrmf/clinic/clinic.building.yaml", r"bidirectional: \[4, true", "bidirectional: [4, both", warned="'both'"),
    Row("rmf_nav_graph/clinic/0.yaml", r"speed_limit: [\d.]+", "speed_limit: -1", refused="m/s"),
    Row("rmf_nav_graph/clinic/0.yaml", "orientation_constraint: forward", "orientation_constraint: up", warned="'up'"),
    Row("rmf_nav_graph/clinic/0.yaml", r"dims: \[[-\d.]+", "dims: [0", warned="should be above 0"),
    Row("rmf_nav_graph/clinic/0.yaml", "is_charger:", "is_chargr:", warned="vertices[][].is_chargr"),
    Row("navgraph/depot.yaml", r"travel_tolerance: [\d.]+", "travel_tolerance: -1", refused="from 0 to"),
    Row("navgraph/depot.yaml", r"orientation: 4\.71", "orientation: 270", warned="is it in radians?"),
    Row("navgraph/depot.yaml", r"orientation: 4\.71", "orientation: north", refused="must be a number"),
    Row("lif/plant.lif.json", r'"maxSpeed": [\d.]+', '"maxSpeed": -1', refused="m/s"),
    Row("lif/plant.lif.json", r'"degree": \d+', '"degree": 0', refused="from 1 to"),
    Row("lif/plant.lif.json", r'"weight": [\d.]+', '"weight": 0', refused="above 0"),
    Row("lif/plant.lif.json", r'"stationHeight": [\d.]+', '"stationHeight": -3', refused="from 0 to"),
    Row("lif/plant.lif.json", '"blockingType": "[A-Z]+"', '"blockingType": "MAYBE"', warned="'MAYBE'"),
    Row("lif/plant.lif.json", '"rotationAllowed"', '"rotationAlowed"', warned="rotationAlowed"),
    Row("nav2_route/hall.geojson", r'"speed_limit": [\d.]+', '"speed_limit": -5.0', refused="m/s"),
    Row("nav2_route/hall.geojson", r'"cost": [\d.]+', '"cost": -1.0', refused="from 0 to"),
    Row("occupancy_grid/room/room.yaml", r"negate: \d", "negate: 200", refused="negate must be 0, 1"),
    Row("occupancy_grid/room/room.yaml", r"resolution: [\d.]+", "resolution: 200", warned="is it in metres?"),
    Row("occupancy_grid/room/room.yaml", "note:", "mod:", warned="unknown keys, kept without effect: mod"),
    Row("occupancy_grid/turned/turned.yaml", r", [-\d.]+\]", ", 90.0]", warned="is it in radians?"),
    Row("geojson/field.geojson", '"crs": ', '"crs": "EPSG:25832", "crs2": ', refused="GeoJSON uses degrees"),
    Row("geojson/field.geojson", r'"bbox": \[[\d.]+', '"bbox": [1e9', warned="not a box", where="bbox"),
    Row("geojson/field.geojson", '"geometry": ', '"geometri": ', warned="lack the mandatory member 'geometry'"),
    Row("kml/orchard.kml", r"<heading>[\d.]+", "<heading>1e6", warned="degrees", where="heading"),
    Row("kml/orchard.kml", r"<heading>[\d.]+", "<heading>nan", warned="must be a number", where="heading"),
    Row("kml/orchard.kml", r"<rotation>[\d.]+", "<rotation>720", refused="degrees", where="rotation"),
    Row("kml/orchard.kml", r"<Point>", "<Camera><altitude>12e6</altitude></Camera><Point>", warned="metres"),
    Row("kml/orchard.kml", r"<tilt>[\d.]+", "<tilt>steep", warned="must be a number", where="tilt"),
    Row("kml/orchard.kml", r"<altitudeMode>\w+", "<altitudeMode>low", warned="'low'"),
    Row("kml/orchard.kml", r"<north>[\d.]+", "<north>-80", refused="is south of south"),
    Row("kml/orchard.kml", r"<width>\d+", "<width>2px", warned="must be a number", where="width"),
    Row("kml/orchard.kml", r"<kml ", "<?xml-stylesheet href='x.xsl'?><kml ", warned="'<?xml-stylesheet'"),
    Row("kml/orchard.kml", "<Point>", "<x:script xmlns:x='urn:x'>x</x:script><Point>", warned="a script"),
    Row("kml/orchard.kml", "<Point>", INCLUDE, warned="XInclude"),
    Row("osm/quarter.osm", "<osm ", "<?xml-stylesheet href='x.xsl'?><osm ", warned="'<?xml-stylesheet'"),
    Row("gazebo/cart/cart/model.sdf", r"<radius>[\d.]+", "<radius>0", warned="the shape has no extent"),
    Row("gazebo/yard/worlds/yard.world", r"<static>\w+", "<static>maybe", warned="it is read as false"),
    Row("gazebo/cart/cart/model.sdf", r"<pose>(\S+ \S+ \S+) \S+", r"<pose>\1 90", warned="angles must be in radians"),
    Row(
        "lanelet2/local/lanelet2_map.osm",
        r'k="speed_limit" v="[^"]*',
        'k="speed_limit" v="nan',
        warned="invalid speed limit",
    ),
    Row(
        "lanelet2/junction.osm", r"k='speed_limit' v='[^']*", "k='speed_limit' v='1000000", warned="invalid speed limit"
    ),
]


def upload(row: Row) -> dict[str, bytes]:
    main = SAMPLES / row.sample
    top = SAMPLES / Path(row.sample).parts[0] / (Path(row.sample).parts[1] if row.sample.count("/") > 1 else "")
    beside = [p for p in (top.rglob("*") if top.is_dir() else [main]) if p.is_file() and p.name != "facts.json"]
    return {str(p.relative_to(SAMPLES)): p.read_bytes() for p in (beside if row.sample.count("/") > 1 else [main])}


def changed(row: Row) -> dict[str, bytes]:
    files = upload(row)
    text, count = re.subn(row.old, row.new, files[row.sample].decode(), count=1)
    assert count == 1, f"{row.old} is not in {row.sample}"
    return {**files, row.sample: text.encode()}


def read(files: dict[str, bytes]) -> list[Problem]:
    return upload_reader.read(files, UploadHints(), HERE, Limits()).warnings


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row.sample.partition('/')[0]}: {row.new[:40]}")
def test_changed_sample_is_rejected_or_reported(row: Row) -> None:
    plain = {w.problem for w in read(upload(row))}
    files = changed(row)
    if row.refused:
        with pytest.raises(BadUpload) as caught:
            read(files)
        findings = [p for p in caught.value.problems if row.refused in p.problem]
        assert findings, [p.problem for p in caught.value.problems]
        assert findings[0].file == row.sample
    else:
        warnings = read(files)
        findings = [w for w in warnings if row.warned in w.problem and w.problem not in plain]
        assert findings, [w.problem for w in warnings]
    assert row.where in (findings[0].where or "")


def bad_binaries() -> list[tuple[str, Callable[[bytes], bytes], str]]:
    """List binary samples with a change, and the reason of their rejection."""

    def infinite(data: bytes) -> bytes:
        body = data.index(b"data\n") + 5
        return data[:body] + struct.pack("<f", float("nan")) + data[body + 4 :]

    def unknown_code(data: bytes) -> bytes:
        key = struct.pack("<HHH", 3072, 0, 1)
        at = data.index(key) + len(key)
        return data[:at] + struct.pack("<H", 9999) + data[at + 2 :]

    def many_bands(data: bytes) -> bytes:
        tag = struct.pack("<HHI", 277, 3, 1)
        at = data.index(tag) + len(tag)
        return data[:at] + struct.pack("<H", 65281) + data[at + 2 :]

    return [
        ("octomap/shelf.ot", infinite, "must be a finite number"),
        ("satellite/heights.tif", many_bands, "the limit is 1024"),
        ("satellite/orchard.tif", unknown_code, "EPSG:9999"),
    ]


@pytest.mark.parametrize(("sample", "change", "reason"), bad_binaries(), ids=lambda v: v if isinstance(v, str) else "")
def test_changed_binary_sample_is_rejected(sample: str, change: Callable[[bytes], bytes], reason: str) -> None:
    data = (SAMPLES / sample).read_bytes()
    read({sample: data})
    with pytest.raises(BadUpload, match=reason) as caught:
        read({sample: change(data)})
    assert caught.value.problems[0].file == sample


def test_utf16_stylesheet_is_reported() -> None:
    text = '<?xml version="1.0" encoding="UTF-16"?><?xml-stylesheet href="x"?>' + KML.format(name="x", at="7,50")
    assert any("xml-stylesheet" in w.problem for w in read({"a.kml": text.encode("utf-16")}))


def test_repeated_warnings_are_merged() -> None:
    same = [Problem(f"the edge 'e{k}' leads to 'x{k}', which is no node", "a.yaml", where=f"n{k}") for k in range(41)]
    other = Problem("no list of nodes", "a.yaml")
    warnings = group_warnings([*same, other, other], 1000)
    assert [w.problem for w in warnings] == [
        "the edge 'e0' leads to 'x0', which is no node (and 40 more like it: n1; n2)",
        "no list of nodes",
    ]
    assert group_warnings(same[:3], 1000) == same[:3]
    many = [Problem(word * 9, "a") for word in "abcdef"]
    assert [w.problem for w in group_warnings(many, 5)][5:] == ["and 1 more warnings"]


def test_unknown_key_in_several_nodes_gives_one_warning() -> None:
    sample = (SAMPLES / "tmap2" / "orchard.tmap2.yaml").read_text()
    count = sample.count("    parent_frame:")
    assert count > 3
    text = sample.replace("    parent_frame:", "    colour: red\n    parent_frame:")
    warnings = [w.problem for w in read({"a.tmap2.yaml": text.encode()}) if "colour" in w.problem]
    assert len(warnings) == 1
    assert f"nodes[].node.colour ({count} times)" in warnings[0]
