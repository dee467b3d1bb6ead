"""lanelet2: real maps round-trip, lanelets become a network, and other networks become lanelets."""

from __future__ import annotations

import json
import math
import shutil
import subprocess
from collections import Counter
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from lxml import etree

from app import formats
from app.convert.files import offline
from app.errors import BadUpload, MissingDatum, TooLarge, UnreadableFile
from app.formats import FileGroup, ReadContext, WriteContext, get_format
from app.formats.lanelet2 import detect
from app.formats.lanelet2.new_lanelets import WriteOptions
from app.formats.lanelet2.tags import MAIN, PROJECTOR, is_two_way, parse_speed
from app.formats.osm.scanning import scan
from app.formats.osm.strict import read_events
from app.limits import Limits
from app.model.features import Features, features
from app.model.frame import Datum
from app.model.layers import Layers, PartKey
from app.model.notes import Dropped, Filled
from app.upload_reader import EnvironmentContext, UploadHints
from app.upload_reader import read as read_bundle

FORMAT = get_format("lanelet2")
SAMPLES = Path(__file__).resolve().parents[1] / "samples" / "lanelet2"
FACTS: dict[str, Any] = json.loads((SAMPLES / "facts.json").read_text())
JUNCTION = (SAMPLES / "junction.osm").read_bytes()
AUTOWARE = {p.name: p.read_bytes() for p in (SAMPLES / "local").iterdir()}
NETWORK = PartKey("topology", "ground", "network")
OBJECTS = PartKey("objects", "ground", "lanelet2")
HERE = Datum(53.2686, -0.5245, heading=20.0)


def read(files: bytes | dict[str, bytes], **context: Any) -> tuple[Layers, ReadContext]:
    contents = {"map.osm": files} if isinstance(files, bytes) else files
    main = next(n for n in contents if n.endswith(".osm"))
    read_context = ReadContext(main=main, **context)
    return formats.read(FileGroup(FORMAT, main, contents), read_context), read_context


def write(layers: Layers, **context: Any) -> tuple[dict[str, bytes], WriteContext]:
    write_context = WriteContext(**context)
    return formats.write(FORMAT, layers, write_context), write_context


def edited(layers: Layers, key: PartKey, change: Callable[[str, dict[str, Any]], dict[str, Any] | None]) -> Layers:
    """Replace properties of one part's items; None deletes an item."""
    part = layers.parts[key]
    assert isinstance(part, Features)
    properties = [change(i, dict(p)) for i, p in zip(part.ids, part.properties, strict=True)]
    keep = [k for k, p in enumerate(properties) if p is not None]
    left = part.select(keep)
    new = Features(left.ids, left.geometry, tuple(p for p in properties if p is not None), left.local, left.document)
    return Layers({**layers.parts, key: new}, layers.datum, layers.levels)


def part(layers: Layers, key: PartKey = NETWORK) -> Features:
    content = layers.parts[key]
    assert isinstance(content, Features)
    return content


def items(layers: Layers) -> dict[str, tuple[dict[str, Any], Any]]:
    net = part(layers)
    return {i: (dict(p), g) for i, p, g in zip(net.ids, net.properties, net.geometry, strict=True)}


# --- a comparator of our own: it reads the XML and nothing else ----------------------------------------------------


def elements(data: bytes) -> dict[tuple[str, int], dict[str, Any]]:
    """Return each element by type and id: attributes as values, tags, nodes and members in order."""
    out: dict[tuple[str, int], dict[str, Any]] = {}
    for e in etree.fromstring(data):
        if e.tag not in ("node", "way", "relation"):
            continue
        attributes = {k: v for k, v in e.attrib.items() if k != "id" and v != ""}
        place = tuple(float(attributes.pop(k)) if k in attributes else None for k in ("lat", "lon"))
        out[e.tag, int(e.get("id"))] = {
            "place": place,
            "attributes": attributes,
            "tags": {t.get("k"): t.get("v") for t in e.iter("tag")},
            "refs": [int(n.get("ref")) for n in e.iter("nd")],
            "members": [(m.get("type"), int(m.get("ref")), m.get("role")) for m in e.iter("member")],
        }
    return out


def further(data: bytes) -> list[tuple[str, dict[str, str]]]:
    root = etree.fromstring(data)
    attributes = {k: v for k, v in root.attrib.items() if k != "version"}
    others = [(e.tag, dict(e.attrib)) for e in root if e.tag not in ("node", "way", "relation")]
    return [("osm", attributes), *others]


def assert_same(a: bytes, b: bytes) -> None:
    one, two = elements(a), elements(b)
    assert one.keys() == two.keys()
    for key in one:
        assert one[key] == two[key], key
    assert further(a) == further(b)


def test_comparator_detects_differences() -> None:
    for old, new in [
        (b"lat='0.00005'", b"lat='0.00006'"),
        (b"k='one_way' v='yes'", b"k='one_way' v='no'"),
        (b"role='ref_line'", b"role='refers'"),
        (b"<nd ref='3' />\n    <nd ref='2' />", b"<nd ref='2' />\n    <nd ref='3' />"),
        (b"version='2'", b"version='3'"),
        (b"generator='JOSM'", b"generator='josm'"),
    ]:
        assert old in JUNCTION
        with pytest.raises(AssertionError):
            assert_same(JUNCTION, JUNCTION.replace(old, new, 1))


# --- real maps -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["fzi_mapping_example/mapping_example.osm", "autoware_mgrs_mini/lanelet2_map.osm"])
def test_real_maps_round_trip(shared: Path, facts_json: dict[str, Any], name: str) -> None:
    path = shared / "data" / "lanelet2" / name
    files = {p.name: p.read_bytes() for p in path.parent.iterdir()}
    back = offline(files, "lanelet2").files
    assert_same(files[path.name], back[MAIN])
    assert back.get(PROJECTOR) == files.get(PROJECTOR)
    facts = facts_json[f"lanelet2/{name}"]["facts"]
    layers, context = read(files)
    assert not context.warnings
    objects = part(layers, OBJECTS)
    kinds = Counter(p["kind"] for p in objects.properties)
    assert kinds["lanelet"] == facts["lanelets"]
    assert kinds["area"] == facts["relations_by_type"].get("multipolygon", 0)
    assert kinds["regulatory_element"] == facts["relations_by_type"].get("regulatory_element", 0)
    ways = Counter(p["lanelet2"]["tags"].get("type", "None") for p in objects.properties if "refs" in p["lanelet2"])
    assert ways == facts["ways_by_type"]
    edges = [p for p in part(layers).properties if p["kind"] == "edge"]
    lanelets = {p["lanelet2"]["lanelet"]: p["lanelet2"]["tags"]["subtype"] for p in edges}
    assert Counter(lanelets.values()) == facts["lanelet_subtypes"]
    west, south, east, north = (facts["node_bbox"][k] for k in ("minlon", "minlat", "maxlon", "maxlat"))
    box = shapely.total_bounds(part(layers).geometry)
    assert (box[:2] >= [west, south]).all()
    assert (box[2:] <= [east, north]).all()


def test_real_lanelets_follow_one_way_tags(shared: Path) -> None:
    data = (shared / "data/lanelet2/fzi_mapping_example/mapping_example.osm").read_bytes()
    stated = {
        i: e["tags"] for (kind, i), e in elements(data).items() if kind == "relation" and e["tags"]["type"] == "lanelet"
    }
    layers, _ = read(data)
    times = Counter(p["lanelet2"]["lanelet"] for p in part(layers).properties if p["kind"] == "edge")
    for i, tags in stated.items():
        assert times[i] == (2 if tags.get("one_way") in ("no", "false") else 1), tags


def test_real_lanelets_connect_as_in_lanelet2(shared: Path) -> None:
    """Compute the connections independently, lanelet by lanelet, from the XML alone."""
    data = (shared / "data/lanelet2/fzi_mapping_example/mapping_example.osm").read_bytes()
    osm_elements = elements(data)
    rad = math.radians(49.0)
    place = {
        i: (e["place"][1] * math.cos(rad), e["place"][0]) for (kind, i), e in osm_elements.items() if kind == "node"
    }

    def side(line: list[int], at: tuple[float, float]) -> float:
        points = [place[r] for r in line]
        best, sign = math.inf, 0.0
        for (ax, ay), (bx, by) in pairwise(points):
            dx, dy = bx - ax, by - ay
            t = max(0.0, min(1.0, ((at[0] - ax) * dx + (at[1] - ay) * dy) / (dx * dx + dy * dy)))
            away = math.hypot(at[0] - ax - t * dx, at[1] - ay - t * dy)
            if away < best:
                best, sign = away, dx * (at[1] - ay) - dy * (at[0] - ax)
        return sign

    def middle(line: list[int]) -> tuple[float, float]:
        a, b = place[line[0]], place[line[-1]]
        return place[line[len(line) // 2]] if len(line) > 2 else ((a[0] + b[0]) / 2, (a[1] + b[1]) / 2)

    starts: dict[str, tuple[int, int]] = {}
    ends: dict[str, tuple[int, int]] = {}
    for (kind, i), e in osm_elements.items():
        if kind != "relation" or e["tags"]["type"] != "lanelet":
            continue
        left, right = (
            next(osm_elements["way", r]["refs"] for _, r, role in e["members"] if role == w) for w in ("left", "right")
        )
        left = left[::-1] if side(left, middle(right)) >= 0 else left
        right = right[::-1] if side(right, middle(left)) <= 0 else right
        starts[f"l{i}"], ends[f"l{i}"] = (left[0], right[0]), (left[-1], right[-1])
        if e["tags"].get("one_way") in ("no", "false"):
            starts[f"l{i}:back"], ends[f"l{i}:back"] = (right[-1], left[-1]), (right[0], left[0])
    layers, _ = read(data)
    edges = {i: p for i, (p, _) in items(layers).items() if p["kind"] == "edge"}
    assert edges.keys() == starts.keys()
    follow = {(a, b) for a in edges for b in edges if ends[a] == starts[b]}
    ours = {(a, b) for a in edges for b in edges if edges[a]["target"] == edges[b]["source"]}
    assert follow <= ours, "every allowed continuation is connected"
    # Beyond Lanelet2's own rule: where a lane for both ways ends, one may turn.
    turning = {p[w] for i, p in edges.items() if i.endswith(":back") for w in ("source", "target")}
    assert {edges[a]["target"] for a, _ in ours - follow} <= turning


# --- our own samples, with facts worked out by hand ----------------------------------------------------------------


def test_junction_matches_expected_facts() -> None:
    layers, context = read(JUNCTION)
    facts = FACTS["junction.osm"]
    network_items = items(layers)
    assert network_items.keys() == facts["nodes"].keys() | facts["edges"].keys()
    for i, place in facts["nodes"].items():
        p, g = network_items[i]
        assert p["kind"] == "node"
        np.testing.assert_allclose(shapely.get_coordinates(g, include_z=len(place) > 2)[0], place, atol=1e-12)
        assert g.has_z == (len(place) > 2)
    for i, (source, target, width, speed) in facts["edges"].items():
        p, g = network_items[i]
        assert (p["source"], p["target"]) == (source, target)
        assert p["width"] == pytest.approx(width, abs=1e-3)
        assert p.get("speed_limit") == speed
        ends = [facts["nodes"][n][:2] for n in (source, target)]
        np.testing.assert_allclose(shapely.get_coordinates(g)[[0, -1]], ends, atol=1e-12)
    assert network_items["l102"][0]["name"] == "Short Street"
    assert network_items["l103"][0]["lanelet2"]["tags"]["subtype"] == "crosswalk"
    assert [w.where for w in context.warnings] == ["relation 106"], "the deleted lanelet is no road"
    objects = dict(zip(part(layers, OBJECTS).ids, part(layers, OBJECTS).properties, strict=True))
    assert objects["r105"]["kind"] == "area"
    assert objects["w29"]["kind"] == "wall"
    assert objects["w30"]["name"] == 'Höfe <2> & "3"'
    assert objects["n11"]["kind"] == "start"
    assert {i for i in objects if i.startswith("n")} == {"n11", "n50"}, "mere bends are no objects"
    assert_same(JUNCTION, offline({"a.osm": JUNCTION}, "lanelet2").files[MAIN])


def test_local_map_matches_expected_facts() -> None:
    layers, context = read(AUTOWARE)
    assert not context.warnings
    facts = FACTS["local"]
    net = part(layers)
    assert net.local.all(), "the projector is Local, so metres count"
    network_items = items(layers)
    assert network_items.keys() == {*facts["nodes"], "l8", "l8:back"}
    for i, place in facts["nodes"].items():
        np.testing.assert_allclose(shapely.get_coordinates(network_items[i][1], include_z=True)[0], place, atol=1e-9)
    p, g = network_items["l8"]
    np.testing.assert_allclose(shapely.get_coordinates(g, include_z=True)[1], facts["bend"], atol=1e-6)
    assert (p["width"], p["speed_limit"]) == (facts["width"], facts["speed_limit"])
    back = offline(AUTOWARE, "lanelet2").files
    assert_same(AUTOWARE["lanelet2_map.osm"], back[MAIN])
    assert back[PROJECTOR] == AUTOWARE[PROJECTOR]
    alone, _ = read(AUTOWARE["lanelet2_map.osm"])
    assert part(alone).local.all(), "and without that file, since no point stands on earth"


def test_metres_of_another_frame_are_not_mixed_with_local() -> None:
    """An MGRS map has positions on earth; its local_x and local_y are stored while its points are unchanged."""
    node = "<node id='{}' lat='{}' lon='{}'><tag k='local_x' v='{}'/><tag k='local_y' v='5'/></node>"
    at = [(1, 0.0001, 0.0, 7), (2, 0.0001, 0.0001, 8), (3, 0.0, 0.0, 9), (4, 0.0, 0.0001, 10)]
    body = "".join(node.format(*row) for row in at) + (
        "<way id='5'><nd ref='1'/><nd ref='2'/></way><way id='6'><nd ref='3'/><nd ref='4'/></way><relation id='7'>"
        "<member type='way' ref='5' role='left'/><member type='way' ref='6' role='right'/>"
        "<tag k='type' v='lanelet'/></relation>"
    )
    data = f"<osm version='0.6'>{body}</osm>".encode()
    layers, _ = read({"map.osm": data, PROJECTOR: b"projector_type: MGRS\nmgrs_grid: 54SUE\n"})
    assert not part(layers).local.any()
    files, context = write(layers, options=WriteOptions())
    assert_same(data, files[MAIN].replace(b' generator="Fleet Map Server"', b""))
    assert not context.dropped
    objects = part(layers, OBJECTS)
    moved = objects.geometry.copy()
    k = objects.ids.index("w5")
    moved[k] = shapely.LineString([(0.0, 0.0001), (0.0001, 0.00012)])
    other = Features(objects.ids, moved, objects.properties, objects.local.copy(), objects.document)
    files, context = write(Layers({OBJECTS: other}), options=WriteOptions())
    tags = elements(files[MAIN])["node", 2]["tags"]
    assert tags == {}, "metres that are no longer true are left out"
    assert elements(files[MAIN])["node", 1]["tags"] == {"local_x": "7", "local_y": "5"}
    assert context.dropped == [Dropped("local_x and local_y of moved points", 1, "Lanelet2 maps cannot express them")]


# --- what is detected ----------------------------------------------------------------------------------------------


def test_osm_without_lanelets_is_detected_as_osm(shared: Path) -> None:
    quarter = (SAMPLES.parent / "osm" / "quarter.osm").read_bytes()
    assert not detect("a.osm", quarter)
    for path in sorted((shared / "data/osm").rglob("*.osm")) + sorted((shared / "data/osm").rglob("osm.xml")):
        assert not detect(path.name, path.read_bytes()), path
    fmt = formats.detect("a.osm", quarter)
    assert fmt is not None
    assert fmt.name == "osm"
    near = quarter.replace(b"</osm>", b'<way id="1"><tag k="name" v="lanelet"/></way></osm>')
    assert near != quarter
    assert not detect("a.osm", near)


def test_lanelets_are_detected_with_any_quotes() -> None:
    for data in (JUNCTION, JUNCTION.replace(b"k='type' v='lanelet'", b'v = "lanelet"\n k = "type"')):
        fmt = formats.detect("map.osm", data)
        assert fmt is not None
        assert fmt.name == "lanelet2"
    assert not detect("a.kml", b"<kml><tag k='type' v='lanelet'/></kml>")


# --- words ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "speed"),
    [
        ("36", 10.0),
        ("36 km/h", 10.0),
        ("36kmh", 10.0),
        ("10 m/s", 10.0),
        ("10 mps", 10.0),
        ("10 mph", 4.4704),
        ("0", 0.0),
        ("fast", None),
        ("10 knots", None),
        ("-5", None),
        ("nan", None),
        ("", None),
        (None, None),
    ],
)
def test_speed_texts_are_parsed(text: str | None, speed: float | None) -> None:
    assert parse_speed(text) == (None if speed is None else pytest.approx(speed, abs=1e-9))


@pytest.mark.parametrize(
    ("tags", "both"),
    [
        ({}, False),
        ({"subtype": "road"}, False),
        ({"subtype": "walkway"}, True),
        ({"subtype": "crosswalk", "one_way": "yes"}, False),
        ({"subtype": "road", "one_way": "no"}, True),
        ({"subtype": "road", "one_way": "false"}, True),
        ({"subtype": "road", "one_way:bicycle": "no"}, False),
        ({"subtype": "road", "participant:bicycle": "yes", "one_way:bicycle": "no"}, True),
        ({"subtype": "road", "participant:pedestrian": "yes"}, True),
        ({"subtype": "walkway", "participant:vehicle": "yes", "participant:pedestrian": "yes"}, False),
        ({"subtype": "stairs", "one_way:pedestrian": "yes"}, False),
        ({"subtype": "shared_walkway"}, False),
    ],
)
def test_lanelet_direction_follows_tags(tags: dict[str, str], both: bool) -> None:
    assert is_two_way(tags) is both


# --- edits ---------------------------------------------------------------------------------------------------------


def test_edge_speed_is_written_to_lanelet() -> None:
    layers, _ = read(JUNCTION)
    new = edited(layers, NETWORK, lambda i, p: {**p, "speed_limit": 0.55, "name": "A"} if i == "l101" else p)
    files, _ = write(new)
    tags = elements(files[MAIN])["relation", 101]["tags"]
    assert (tags["speed_limit"], tags["name"]) == ("1.98", "A")
    again, _ = read(files[MAIN])
    assert items(again)["l101"][0]["speed_limit"] == 0.55


@pytest.mark.parametrize(("gone", "turned"), [("l103:back", False), ("l103", True)])
def test_deleted_direction_makes_lanelet_one_way(gone: str, turned: bool) -> None:
    layers, _ = read(JUNCTION)
    files, context = write(edited(layers, NETWORK, lambda i, p: None if i == gone else p))
    lanelet = elements(files[MAIN])["relation", 103]
    assert lanelet["tags"]["one_way"] == "yes"
    assert lanelet["members"] == [
        ("way", 25, "right" if turned else "left"),
        ("way", 26, "left" if turned else "right"),
    ]
    again, _ = read(files[MAIN])
    left = items(layers).keys() - {gone}
    ends = {(p["source"], p["target"]) for i, (p, _) in items(layers).items() if i in left and p["kind"] == "edge"}
    place = {i: g.coords[0][:2] for i, (p, g) in items(layers).items() if p["kind"] == "node"}
    now = {i: g.coords[0][:2] for i, (p, g) in items(again).items() if p["kind"] == "node"}
    pairs = {(now[p["source"]], now[p["target"]]) for p, _ in items(again).values() if p["kind"] == "edge"}
    assert pairs == {(place[a], place[b]) for a, b in ends}
    assert not context.warnings


def test_lanelet_without_edges_is_dropped_but_bounds_stay() -> None:
    layers, _ = read(JUNCTION)
    files, context = write(edited(layers, NETWORK, lambda i, p: None if i == "l102" else p))
    osm_elements = elements(files[MAIN])
    assert ("relation", 102) not in osm_elements
    assert {("way", 23), ("way", 24)} <= osm_elements.keys()
    why = "Lanelet2 maps cannot express them"
    assert context.dropped == [Dropped("lanelets whose edges are no longer in the network", 1, why)]


def test_redrawn_bound_is_written_with_lanelet() -> None:
    layers, _ = read(JUNCTION)
    objects = part(layers, OBJECTS)
    shapes = objects.geometry.copy()
    shapes[objects.ids.index("w22")] = shapely.LineString([(0.0, 0.0), (0.00005, -0.00001), (0.0001, 0.0)])
    new = Features(objects.ids, shapes, objects.properties, objects.local.copy(), objects.document)
    files, _ = write(Layers({**layers.parts, OBJECTS: new}, Datum(0.0, 0.0)))
    osm_elements = elements(files[MAIN])
    assert [kind for kind, _ in osm_elements].count("relation") == 7, "no lanelet beside it and none lost"
    refs = osm_elements["way", 22]["refs"]
    assert (refs[0], refs[-1], len(refs)) == (11, 12, 3)
    again, _ = read(files[MAIN])
    assert items(again).keys() == items(layers).keys()
    assert len(items(again)["l101"][1].coords) == 3


def test_new_edge_connects_to_existing_lanelets() -> None:
    layers, _ = read(JUNCTION)
    net = part(layers)
    line = shapely.LineString([(0.0002, 0.000015, 3.0), (0.0003, 0.000015, 3.0)])
    rows = [(f.id, f.geometry, f.properties) for f in net]
    rows += [("end", shapely.Point(0.0003, 0.000015, 3.0), {"kind": "node", "name": "Gate"})]
    rows += [("more", line, {"kind": "edge", "source": "n3:13", "target": "end", "width": 3.0})]
    new = Layers({**layers.parts, NETWORK: features(rows, "wgs84")}, Datum(0.0, 0.0))
    files, context = write(new)
    osm_elements = elements(files[MAIN])
    before = elements(JUNCTION)
    assert all(osm_elements[key] == before[key] for key in before), "what was there stays as it was"
    lanelet = next(
        e for (kind, i), e in osm_elements.items() if kind == "relation" and e["tags"].get("fleetmap:edge") == "more"
    )
    sides = {role: osm_elements["way", i]["refs"] for _, i, role in lanelet["members"]}
    assert (sides["left"][0], sides["right"][0]) == (3, 13), "its bounds begin where those of the one before end"
    again, _ = read(files[MAIN])
    ids = items(again)
    assert {"more", "end"} <= ids.keys()
    assert ids["end"][0]["name"] == "Gate"
    assert ids["more"][0]["width"] == 3.0
    assert not context.warnings


# --- networks from elsewhere ---------------------------------------------------------------------------------------


def net(edges: list[tuple[str, str]], places: dict[str, tuple[float, ...]], **edge_properties: Any) -> Features:
    rows: list[tuple[str, Any, dict[str, Any]]] = []
    rows += [(i, shapely.Point(*at), {"kind": "node", "name": i}) for i, at in places.items()]
    for a, b in edges:
        line = shapely.LineString([places[a], places[b]])
        rows.append((f"{a}_{b}", line, {"kind": "edge", "source": a, "target": b, **edge_properties}))
    return features(rows, "local")


def lanelets(data: bytes) -> dict[str, tuple[dict[str, str], dict[str, list[int]], dict[int, tuple[float, float]]]]:
    """Return lanelets by edge: tags, refs by role, and the metres of each point."""
    osm_elements = elements(data)
    metres = {
        i: (float(e["tags"]["local_x"]), float(e["tags"]["local_y"]))
        for (kind, i), e in osm_elements.items()
        if kind == "node"
    }
    return {
        e["tags"]["fleetmap:edge"]: (e["tags"], {r: osm_elements["way", i]["refs"] for _, i, r in e["members"]}, metres)
        for (kind, _), e in osm_elements.items()
        if kind == "relation"
    }


def valid(data: bytes) -> None:
    """Check Lanelet2's rules: bounds of at least two points, the left one on the left, neither crossing."""
    for name, (tags, sides, at) in lanelets(data).items():
        left, right = ([at[r] for r in sides[w]] for w in ("left", "right"))
        assert min(len(left), len(right)) > 1
        assert shapely.LinearRing([*left, *right[::-1]]).is_simple, name
        assert shapely.Polygon([*right, *left[::-1]]).exterior.is_ccw, f"{name}: the left bound is not on the left"
        assert tags["one_way"] in ("yes", "no")


def test_straight_road_matches_hand_computed_bounds() -> None:
    places = {"a": (0.0, 0.0), "b": (10.0, 0.0), "c": (20.0, 10.0)}
    two = net([("a", "b"), ("b", "a"), ("b", "c")], places, width=2.0, speed_limit=1.5)
    files, context = write(Layers({NETWORK: two}, HERE))
    assert list(files) == [MAIN]
    by_edge = lanelets(files[MAIN])
    assert by_edge.keys() == {"a_b", "b_c"}
    tags, sides, at = by_edge["a_b"]
    assert (tags["one_way"], tags["fleetmap:back"], tags["speed_limit"], tags["subtype"]) == (
        "no",
        "b_a",
        "5.4",
        "road",
    )
    assert by_edge["b_c"][0]["one_way"] == "yes"
    # At b the border stands on the bisector: tan(22.5°) = 0.414214 back on the left, as far ahead on the right.
    corner = math.tan(math.radians(22.5))
    np.testing.assert_allclose([at[r] for r in sides["left"]], [(0, 1), (10 - corner, 1)], atol=1e-6)
    np.testing.assert_allclose([at[r] for r in sides["right"]], [(0, -1), (10 + corner, -1)], atol=1e-6)
    assert sides["left"][-1] == by_edge["b_c"][1]["left"][0], "lanelets that follow each other share their points"
    assert sides["right"][-1] == by_edge["b_c"][1]["right"][0]
    valid(files[MAIN])
    frame = Layers({}, HERE).frame
    assert frame is not None
    for (kind, i), e in elements(files[MAIN]).items():
        if kind == "node":
            lat, lon = e["place"]
            np.testing.assert_allclose(frame.to_local(np.array([[lon, lat]]))[0], at[i], atol=1e-6)
    assert not context.warnings
    assert {f.subject for f in context.template} == {"type of bounds", "location of lanelets", "subtype of lanelets"}


@pytest.mark.parametrize("arms", [3, 4, 5, 6])
def test_crossing_reports_connections_it_cannot_make(arms: int) -> None:
    places = {"m": (0.0, 0.0)}
    for k in range(arms):
        places[f"p{k}"] = (20 * math.cos(k * math.tau / arms), 20 * math.sin(k * math.tau / arms))
    edges = [pair for k in range(arms) for pair in (("m", f"p{k}"), (f"p{k}", "m"))]
    files, context = write(Layers({NETWORK: net(edges, places)}, HERE))
    valid(files[MAIN])
    assert files == write(Layers({NETWORK: net(edges, places)}, HERE))[0]
    ends = []
    for tags, sides, _ in lanelets(files[MAIN]).values():
        far = tags["fleetmap:target"] == "m"
        k = -1 if far else 0
        pair = (sides["left"][k], sides["right"][k])
        ends.append(pair if far else pair[::-1])  # looking towards the crossing
    connected = sum(a == b[::-1] for a in ends for b in ends)
    warning = next(w.problem for w in context.warnings)
    possible = arms * (arms - 1)
    assert warning.startswith(f"{possible - connected} of {possible} pairs")
    assert connected >= possible / 2
    again, _ = read(files[MAIN])
    assert {(p["source"], p["target"]) for p, _ in items(again).values() if p["kind"] == "edge"} == set(edges)


@pytest.mark.parametrize("to", ["tmap2", "osm"])
def test_real_networks_become_valid_lanelets_and_round_trip(shared: Path, tmp_path: Path, to: str) -> None:
    farm = "environment_template/riseholme_park_farm_strawberry_polytunnels/config/topological"
    name = {
        "tmap2": f"{farm}/network.tmap2.yaml",
        "osm": "osm/urban-usa-mn-minnesota-zoo/osm.xml",
    }[to]
    path = shared / "data" / name
    files = {path.name: path.read_bytes()}
    datum = Datum(53.268642038, -0.524509505881) if to == "tmap2" else Datum(44.7644, -93.2073)
    converted = offline(files, "lanelet2", datum=datum)
    valid(converted.files[MAIN])
    before = read_bundle(files, UploadHints(), EnvironmentContext(datum), Limits()).layers(datum)
    after = read_bundle(converted.files, UploadHints(), EnvironmentContext(datum), Limits()).layers(datum)
    one, two = part(before), part(after)
    places = dict(zip(two.ids, two.in_local(after.frame), strict=True))
    assert set(one.ids) == set(two.ids)
    for i, p, g in zip(one.ids, one.properties, one.in_local(before.frame), strict=True):
        q = two.properties[two.index()[i]] if len(one) < 1000 else None
        assert shapely.hausdorff_distance(g, places[i]) < 1e-6
        if q is not None:
            assert [p.get(w) for w in ("kind", "source", "target", "width")] == [
                q.get(w) for w in ("kind", "source", "target", "width")
            ]
    assert offline(converted.files, "lanelet2", datum=datum).files == converted.files
    if shutil.which("osmium"):
        (tmp_path / MAIN).write_bytes(converted.files[MAIN])
        process = subprocess.run(
            ["osmium", "fileinfo", "-e", "-j", str(tmp_path / MAIN)], capture_output=True, check=True, timeout=60
        )
        data = json.loads(process.stdout)["data"]
        assert data["objects_ordered"]
        assert data["count"]["relations"] == len(lanelets(converted.files[MAIN]))


@pytest.mark.skipif(not shutil.which("osmium"), reason="osmium is not installed")
def test_written_map_is_read_by_osmium(shared: Path, facts_json: dict[str, Any], tmp_path: Path) -> None:
    name = "lanelet2/fzi_mapping_example/mapping_example.osm"
    content = offline({"a.osm": (shared / "data" / name).read_bytes()}, "lanelet2").files[MAIN]
    (tmp_path / MAIN).write_bytes(content)
    process = subprocess.run(
        ["osmium", "fileinfo", "-e", "-j", str(tmp_path / MAIN)], capture_output=True, check=True, timeout=60
    )
    data = json.loads(process.stdout)["data"]
    facts = facts_json[name]["facts"]["osmium"]
    assert {k: data["count"][k] for k in ("nodes", "ways", "relations")} == {
        k: facts[k] for k in ("nodes", "ways", "relations")
    }
    assert data["bbox"] == facts["bbox"]
    assert data["objects_ordered"]


def test_write_options_are_applied() -> None:
    one = net([("a", "b")], {"a": (0.0, 0.0, 1.0), "b": (10.0, 0.0, 2.0)})
    options = WriteOptions(width=3.0, subtype="walkway", location="nonurban", bounds="curbstone", projector_info=True)
    files, context = write(Layers({NETWORK: one}, HERE), options=options)
    tags, sides, at = lanelets(files[MAIN])["a_b"]
    assert (tags["subtype"], tags["location"], "width" in tags) == ("walkway", "nonurban", False)
    assert {at[r][1] for r in sides["left"]} == {1.5}
    assert files[PROJECTOR].startswith(b"projector_type: Local")
    assert Filled("width of lanes", 3.0, "1 edges have no width", "width") in context.template
    assert [e["tags"]["type"] for (kind, _), e in elements(files[MAIN]).items() if kind == "way"].count(
        "curbstone"
    ) == 2
    assert [elements(files[MAIN])["node", r]["tags"]["ele"] for r in sides["right"]] == ["1.0", "2.0"]
    layers, _ = read(files)
    assert part(layers).local.all()
    assert "width" not in items(layers)["a_b"][0], "what was filled in is no information"


def test_sharp_bends_and_narrow_lanes_give_valid_bounds() -> None:
    points = [(0, 0), (4, 0), (4.2, 0.3), (0, 0.6), (0, 5)]
    line = shapely.LineString(points)
    rows: list[tuple[str, Any, dict[str, Any]]] = [
        ("a", shapely.Point(0, 0), {"kind": "node"}),
        ("b", shapely.Point(0, 5), {"kind": "node"}),
        ("e", line, {"kind": "edge", "source": "a", "target": "b", "width": 4.0}),
        (
            "loop",
            shapely.LineString([(0, 0), (-9, 0), (-9, 9), (0, 0)]),
            {"kind": "edge", "source": "a", "target": "a"},
        ),
        ("c", shapely.Point(0, 5), {"kind": "node"}),
        ("nothing", shapely.LineString([(0, 5), (0, 5)]), {"kind": "edge", "source": "b", "target": "c"}),
    ]
    files, context = write(Layers({NETWORK: features(rows, "local")}, HERE))
    valid(files[MAIN])
    assert lanelets(files[MAIN]).keys() == {"e"}
    assert any("narrower" in w.problem for w in context.warnings)
    assert {"edges without length", "edges from a node to itself"} <= {d.subject for d in context.dropped}


def test_write_without_datum_reports_what_to_supply() -> None:
    one = net([("a", "b")], {"a": (0.0, 0.0), "b": (10.0, 0.0)})
    with pytest.raises(MissingDatum, match="datum"):
        write(Layers({NETWORK: one}))


# --- bad input -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        (b"lat='0.00003' lon='0.0'", b"lat='91' lon='0.0'", "invalid position"),
        (b"<nd ref='1' />", b"<nd ref='x' />", "integer"),
        (b"<osm ", b"<!DOCTYPE osm><osm ", "DOCTYPE"),
        (b"lon='0.0002'", b"lon='170'", "too far|too large"),
    ],
)
def test_bad_files_are_refused_with_the_reason(old: bytes, new: bytes, reason: str) -> None:
    assert old in JUNCTION
    with pytest.raises(BadUpload, match=reason) as caught:
        read(JUNCTION.replace(old, new, 1))
    assert caught.value.problems[0].file == "map.osm"


def test_read_enforces_limits() -> None:
    with pytest.raises(TooLarge):
        read(JUNCTION, limits=Limits(features=20))
    with pytest.raises(TooLarge):
        read({**AUTOWARE, PROJECTOR: b"#" * 70_000})
    with pytest.raises(UnreadableFile) as caught:
        read({**AUTOWARE, PROJECTOR: b"projector_type: [Local"})
    assert caught.value.problems[0].file == PROJECTOR


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"<nd ref='3' />\n    <nd ref='2' />", b"<nd ref='777' />\n    <nd ref='2' />"),
        (b"ref='24' role='right'", b"ref='24' role='left'"),
        (b"ref='24' role='right'", b"ref='2400' role='right'"),
        (b"<member type='way' ref='23' role='left' />", b""),
    ],
)
def test_broken_lanelets_are_stored_with_warning(old: bytes, new: bytes) -> None:
    data = JUNCTION.replace(old, new, 1)
    assert data != JUNCTION
    layers, context = read(data)
    assert "l102" not in items(layers)
    assert any(w.where == "relation 102" for w in context.warnings)
    files, _ = write(layers)
    assert_same(data, files[MAIN])


def test_invalid_stored_values_are_written_safely() -> None:
    layers, _ = read(JUNCTION)
    odd: list[Any] = [
        None,
        5,
        "x",
        [1, "a"],
        {"refs": "x"},
        {"refs": [1, 2], "vertices": 3, "missing": "q"},
        {"members": [1]},
    ]
    for value in odd:
        for key in (OBJECTS, NETWORK):
            changed = edited(layers, key, lambda i, p, value=value: {**p, "lanelet2": value})  # type: ignore[misc]
            files, _ = write(Layers(changed.parts, Datum(0.0, 0.0)))
            etree.fromstring(files[MAIN])


def test_autoware_member_order_uses_fast_parser() -> None:
    """Members with type, role, ref in any order: the fast parser reads them as the strict parser does."""
    head = '<?xml version="1.0"?>\n<osm version="0.6">\n  <node id="1" lat="35.2" lon="138.8"/>\n'
    rows = [
        'type="way" role="left" ref="-5"',
        'type="way" ref="6" role="right &amp; more"',
        'type="node" role="" ref="1"',
    ]
    members = "".join(f"    <member {row}/>\n" for row in rows)
    data = f'{head}  <relation id="7">\n{members}    <tag k="type" v="lanelet"/>\n  </relation>\n</osm>\n'.encode()
    quick, careful = scan(data, Limits(), False), read_events(data, Limits())
    assert quick is not None
    assert quick.relations == careful.relations
    assert quick.relations[0].members == [("way", -5, "left"), ("way", 6, "right & more"), ("node", 1, "")]
