"""The consumers' loader rules: each rule finds what breaks it, in files on disk and in what is served.

The bad files are written by hand after the loaders' sources; what is asserted is the level and the place.
"""

from __future__ import annotations

import gzip
import io
import json
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import yaml

from app import formats
from app.convert import worker
from app.convert.files import offline
from app.convert.recipe import DerivationChain
from app.errors import Problem, UnreadableFile
from app.formats import Files, Format, LayerRequirements, WriteContext
from app.limits import Limits
from app.model.grid import OccupancyGrid
from app.model.layers import Layers, PartKey
from app.upload_reader import UploadHints, unpack
from tests.formats.test_every_format import CASES, HERE, mutations

ERROR, WARNING = "error", "warning"
Found = set[tuple[str | None, str | None]]


def findings_of(name: str, files: dict[str, bytes]) -> Found:
    """Return (level, location) of each finding."""
    return {(p.level, p.where) for p in formats.check(formats.get_format(name), files)}


WRITTEN = [case for case in CASES if formats.get_format(str(case.values[0])).write]


@pytest.mark.parametrize(("name", "files"), WRITTEN)
def test_exported_map_passes_checks_of_its_sample(name: str, files: dict[str, bytes]) -> None:
    """Samples with dangling edges and the like, which round-trip with an error."""
    served = offline(files, name, hints=UploadHints(name), datum=HERE)
    groups, _ = formats.group(files, name)
    if formats.get_format(name).traits.is_container:  # its parts are checked by their own formats' rules
        inside, _ = formats.group(unpack(files, Limits()))
        groups += inside
    bad = any(p.level == ERROR for g in groups for p in formats.check(g.format, g.files))
    refused = [w for w in served.report.as_dict()["warnings"] if w.get("level") == ERROR]
    assert bad or not refused


# --- the runner ---------------------------------------------------------------------------------------------------
def with_check(check: Any) -> Format:
    return Format("x", "X", {"x": "text/plain"}, frozenset(), lambda n, d: True, check=check)


def test_check_lists_distinct_errors_first_and_counts_others() -> None:
    def check(files: Files) -> Iterator[Problem]:
        yield Problem("doubt", level="warning")
        yield Problem("doubt", level="warning")
        yield from (Problem(f"wrong {k}") for k in range(formats.MAX_FINDINGS + 7))

    findings = formats.check(with_check(check), {"main": b""})
    assert [p.level for p in findings] == [ERROR] * (formats.MAX_FINDINGS + 1) + [WARNING]
    assert findings[0] == Problem("wrong 0", "main", level="error")
    assert "7 more" in findings[formats.MAX_FINDINGS].problem
    assert formats.check(with_check(None), {"main": b""}) == []


@pytest.mark.parametrize(
    ("raised", "line", "text"),
    [
        (KeyError("nodes"), None, "'nodes' is missing"),
        (UnreadableFile("bad", [Problem("bad here", line=7)]), 7, "bad here"),
    ],
)
def test_unparsable_file_is_an_error(raised: Exception, line: int | None, text: str) -> None:
    def check(files: Files) -> Iterator[Problem]:
        yield Problem("before", level="warning")
        raise raised

    first, before = formats.check(with_check(check), {"main": b""})
    assert (first.level, first.line, first.file) == (ERROR, line, "main")
    assert text in first.problem
    assert before.problem == "before"


def test_assertion_error_in_check_is_raised() -> None:
    def check(files: Files) -> Iterator[Problem]:
        raise AssertionError
        yield

    with pytest.raises(AssertionError):
        formats.check(with_check(check), {"main": b""})


def test_findings_appear_once_in_report() -> None:
    def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
        context.warn("ask for y=1", file="main", where="y")
        context.warn("reported by both", file="main")
        return {"main": b"x"}

    def check(files: Files) -> Iterator[Problem]:
        yield Problem("y is not 1", "main", None, "y", "error")
        yield Problem("reported by both", "main", None, None, "warning")
        yield Problem("new", "main", None, None, "warning")

    fmt = replace(with_check(check), write=write, needs=LayerRequirements((frozenset(),)))
    context = WriteContext()
    formats.write(fmt, Layers(), context)
    assert [(p.problem, p.level) for p in context.warnings] == [
        ("ask for y=1", "error"),
        ("reported by both", None),
        ("new", "warning"),
    ]


# --- Nav2's map_server --------------------------------------------------------------------------------------------
MAP = {
    "image": "map.pgm",
    "mode": "trinary",
    "resolution": "0.05",
    "origin": "[-1.0, 2, 0]",
    "negate": "0",
    "occupied_thresh": "0.65",
    "free_thresh": "0.196",
}
PGM = b"P5\n3 2\n255\n" + bytes([0, 205, 254, 254, 205, 0])


def grid(members: dict[str, str | None], picture: bytes = PGM, stem: str = "map") -> dict[str, bytes]:
    text = "".join(f"{k}: {v}\n" for k, v in {**MAP, **members}.items() if v is not None)
    return {f"{stem}.yaml": text.encode(), "map.pgm": picture}


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ({}, set()),
        ({"negate": "false", "mode": None}, set()),
        ({"resolution": '"0.05"'}, set()),
        ({"image": None}, {(ERROR, "image")}),
        ({"negate": None, "free_thresh": None}, {(ERROR, "negate"), (ERROR, "free_thresh")}),
        ({"resolution": "1e-7"}, {(ERROR, "resolution"), (WARNING, "resolution")}),
        ({"resolution": "5e-2"}, {(WARNING, "resolution")}),
        ({"resolution": "0,05"}, {(ERROR, "resolution")}),
        ({"resolution": ".nan"}, {(ERROR, "resolution")}),
        ({"origin": "[0, 0]"}, {(ERROR, "origin")}),
        ({"origin": "[0, 0, -nan]"}, {(ERROR, "origin")}),
        ({"origin": "[0, 0, .inf]"}, {(ERROR, "origin")}),
        ({"origin": "[0, 0, 0.1]"}, {(WARNING, "origin")}),
        ({"mode": "Trinary"}, {(ERROR, "mode")}),
        ({"negate": "maybe"}, {(ERROR, "negate")}),
        ({"free_thresh": "0.25"}, {(WARNING, "free_thresh")}),
        ({"free_thresh": "0.7"}, {(WARNING, "free_thresh")}),
        ({"occupied_thresh": "65"}, {(WARNING, "occupied_thresh")}),
        ({"image": "/home/me/map.pgm"}, {(WARNING, "image")}),
        ({"image": "sub/map.pgm"}, {(ERROR, "image")}),
        ({"image": "./map.pgm"}, set()),
    ],
)
def test_map_server_rules(keys: dict[str, str | None], expected: Found) -> None:
    assert findings_of("occupancy_grid", grid(keys)) == expected


def test_map_server_image_path_is_relative_to_yaml() -> None:
    files = {"maps/a.yaml": grid({"image": "../pictures/map.pgm"})["map.yaml"], "pictures/map.pgm": PGM}
    assert findings_of("occupancy_grid", files) == set()


def png(width: int, height: int) -> bytes:
    """Return a PNG's first chunks: everything that the size check reads."""
    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    body = zlib.compress(b"\0")
    chunks = [(b"IHDR", head), (b"IDAT", body), (b"IEND", b"")]
    parts = [struct.pack(">I", len(b)) + k + b + struct.pack(">I", zlib.crc32(k + b)) for k, b in chunks]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


@pytest.mark.parametrize(("width", "level"), [(32767, None), (32768, ERROR)])
def test_nav2_limits_grid_to_32767_cells_per_side(width: int, level: str | None) -> None:
    for picture in (png(width, 2), b"P5 %d 2 255\n" % width + bytes(2 * width)):
        findings = formats.check(formats.get_format("occupancy_grid"), grid({}, picture))
        assert [p.level for p in findings] == ([level] if level else [])
        assert all(p.file == "map.pgm" for p in findings)


def test_grid_larger_than_default_limit_of_uploads_has_no_error() -> None:
    """Nav2 loads 32767 cells each way; FLEETMAP_MAX_PIXELS says what a server takes."""
    width, height = 20_768, 13_612
    assert width * height > Limits().pixels
    assert findings_of("occupancy_grid", grid({}, png(width, height))) == set()


def test_damaged_and_missing_images_are_errors() -> None:
    assert findings_of("occupancy_grid", grid({}, PGM[:-1])) == {(ERROR, None)}
    assert findings_of("occupancy_grid", grid({}, b"GIF89a")) == {(WARNING, None)}


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ({"mode": "trinary"}, {(WARNING, "mode"), (WARNING, None)}),
        ({"mode": "scale"}, set()),
        ({"mode": "raw"}, {(WARNING, None)}),
    ],
)
def test_speed_mask_with_unknown_cells_is_warned_about(keys: dict[str, str | None], expected: Found) -> None:
    assert findings_of("occupancy_grid", grid(keys, stem="speed_mask")) == expected


def test_wide_grid_is_reported() -> None:
    cells = np.zeros((1, 32768), np.uint8)
    layers = Layers({PartKey("occupancy", "ground", "map"): OccupancyGrid(cells, 0.05, (0.0, 0.0, 0.5))})
    chain = DerivationChain((), tuple(layers.parts))
    report = worker.write(formats.get_format("occupancy_grid"), layers, {}, chain).report.as_dict()
    warnings = {(w["level"], w["file"], w.get("where")) for w in report["warnings"]}
    assert warnings == {(ERROR, "map.pgm", None), (WARNING, "map.yaml", "origin")}
    assert any("normalize=true" in w["problem"] for w in report["warnings"]), "the writer's own words stay"


# --- the route server ---------------------------------------------------------------------------------------------
def graph(node: dict[str, Any] | None = None, edge: dict[str, Any] | None = None, **top: Any) -> dict[str, bytes]:
    """Build two nodes and an edge with these further properties."""
    rows: list[dict[str, Any]] = [
        {
            "type": "Feature",
            "properties": {"id": k, **(node or {})},
            "geometry": {"type": "Point", "coordinates": [k, 2.5]},
        }
        for k in (0, 1)
    ]
    ends = {"id": 2, "startid": 0, "endid": 1, **(edge or {})}
    rows.append({"type": "Feature", "properties": ends, "geometry": {"type": "MultiLineString"}})
    return {"g.geojson": json.dumps({"type": "FeatureCollection", "features": rows, **top}).encode()}


def in_edge(word: str) -> str:
    return f"features[2].properties.{word}"


OPERATION = {"type": "Speed", "trigger": "ON_ENTER"}


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        (graph(), set()),
        (graph(edge={"metadata": {"speed_limit": 85.0, "class": "x", "n": 3, "list": [1, "a"]}}), set()),
        (graph(edge={"metadata": {"speed_limit": 85}}), {(ERROR, in_edge("metadata.speed_limit"))}),
        (graph(edge={"metadata": {"a": {"penalty": 1}}}), {(ERROR, in_edge("metadata.a.penalty"))}),
        (graph(edge={"metadata": {"a": None}}), {(ERROR, in_edge("metadata.a"))}),
        (graph(edge={"metadata": [1]}), {(ERROR, in_edge("metadata"))}),
        (graph(edge={"cost": "1"}), {(ERROR, in_edge("cost"))}),
        (graph(edge={"overridable": 1}), {(ERROR, in_edge("overridable"))}),
        (graph(edge={"operations": {"slow": OPERATION}}), set()),
        (
            graph(edge={"operations": {"slow": {**OPERATION, "trigger": "LATER"}}}),
            {(ERROR, in_edge("operations.slow"))},
        ),
        (graph(edge={"operations": {"slow": {"trigger": "NODE"}}}), {(ERROR, in_edge("operations.slow"))}),
        (
            graph(edge={"operations": {"slow": {**OPERATION, "metadata": {"speed_limit": 5}}}}),
            {(ERROR, in_edge("operations.slow.metadata.speed_limit"))},
        ),
        (graph(edge={"operations": "stop"}), {(ERROR, in_edge("operations"))}),
        (graph(edge={"endid": 9}), {(ERROR, None)}),
        (graph(edge={"endid": None}), {(ERROR, None)}),
        (graph(edge={"id": "2"}), {(ERROR, in_edge("id")), (ERROR, "features")}),
        (graph(edge={"id": 2**32}), {(ERROR, in_edge("id")), (ERROR, "features")}),
        (graph(edge={"id": 65536}), {(WARNING, None)}),
        (graph(node={"id": 0}, edge={"endid": 0}), {(WARNING, None)}),
        (graph(node={"frame": 3}), {(ERROR, f"features[{k}].properties.frame") for k in (0, 1)}),
        (graph(crs={"type": "name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}}), {(WARNING, "crs")}),
        (graph(crs={"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::3857"}}), set()),
        ({"g.geojson": b'{"features": []}'}, {(ERROR, "features")}),
        ({"g.geojson": b"[]"}, {(ERROR, "features")}),
        ({"g.geojson": b'{"features": ['}, {(ERROR, None)}),
    ],
)
def test_route_server_rules(files: dict[str, bytes], expected: Found) -> None:
    assert findings_of("nav2_route", files) == expected


def test_far_nodes_lose_millimetres() -> None:
    files = {"g.geojson": graph()["g.geojson"].replace(b"[0, 2.5]", b"[16385, 2.5]")}
    findings = formats.check(formats.get_format("nav2_route"), files)
    assert [(p.level, "2 mm" in p.problem) for p in findings] == [(WARNING, True)]


# --- topological_navigation ---------------------------------------------------------------------------------------
def tmap2(change: Callable[[dict[str, Any]], object] = lambda top: None) -> dict[str, Any]:
    """Build a node A with an edge to B according to the schema, then changed."""
    pose = {"orientation": {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0}, "position": {"x": 0.0, "y": 0.0, "z": 0.0}}
    edge = {"action": "move_base", "edge_id": "A_B", "node": "B"}
    nodes = [
        {
            "meta": {"map": "farm", "node": name, "pointset": "farm"},
            "node": {"edges": edges, "name": name, "parent_frame": "map", "pose": pose},
        }
        for name, edges in (("A", [edge]), ("B", []))
    ]
    top: dict[str, Any] = {"meta": {"last_updated": "2024-05-01_10-00-00"}}
    top |= {"metric_map": "farm", "name": "farm", "nodes": nodes, "pointset": "farm"}
    top = json.loads(json.dumps(top))
    change(top)
    return top


def first(top: dict[str, Any]) -> Any:
    return top["nodes"][0]["node"]


def newest(top: dict[str, Any], **members: Any) -> None:
    """Give the file the newest map manager's form of time."""
    top["meta"]["last_updated"] = "31-05-2026_10-00-00"
    top.update(members)


TMAP2: list[Any] = [
    (lambda top: None, set()),
    (lambda top: top.pop("pointset"), {(ERROR, "pointset")}),
    (lambda top: top["meta"].update(last_updated=0), {(ERROR, "meta.last_updated")}),
    (lambda top: top["meta"].update(last_updated="2024-05-01"), {(ERROR, "meta.last_updated")}),
    (lambda top: top["meta"].update(last_updated="31-05-2026_10-00-00"), set()),
    (lambda top: newest(top, nodes=[*top["nodes"], top["nodes"][1]]), {(ERROR, "nodes")}),
    (lambda top: newest(top) or top["nodes"][0]["meta"].update(pointset="field"), {(ERROR, "nodes")}),
    (lambda top: top["nodes"][0]["meta"].update(pointset="field"), set()),
    (lambda top: top.update(name=7), {(ERROR, "name")}),
    (lambda top: top["nodes"][0]["meta"].pop("map"), {(ERROR, "nodes[0].meta")}),
    (lambda top: top["nodes"][0]["meta"].update(node="C"), {(WARNING, "nodes[0].meta.node")}),
    (lambda top: first(top).pop("parent_frame"), {(ERROR, "nodes[0].node")}),
    (lambda top: first(top).update(nav_frame=first(top).pop("parent_frame")), set()),
    (lambda top: top.update(transformation={"topo_frame_id": first(top).pop("parent_frame")}), set()),
    (lambda top: first(top).pop("pose"), {(ERROR, "nodes[0].node.pose")}),
    (lambda top: first(top)["edges"][0].pop("edge_id"), {(ERROR, "nodes[0].node.edges[0]")}),
    (lambda top: first(top)["edges"][0].update(node="C", edge_id="A_C"), {(ERROR, "nodes")}),
    (lambda top: first(top)["edges"][0].update(edge_id="e1"), {(WARNING, "nodes")}),
    (lambda top: first(top)["edges"].append(first(top)["edges"][0]), {(WARNING, "nodes")}),
    (lambda top: top["nodes"].append(top["nodes"][1]), {(WARNING, "nodes")}),
    (lambda top: top["nodes"][0]["meta"].update(node=3) or first(top).update(name=3), {
        (ERROR, "nodes[0].node.name"), (WARNING, "nodes")}),
    (lambda top: top.update(nodes={}), {(ERROR, "nodes")}),
]  # fmt: skip


@pytest.mark.parametrize(("change", "expected"), TMAP2)
def test_topological_navigation_rules(change: Callable[[dict[str, Any]], object], expected: Found) -> None:
    """Equal results for a file in PyYAML's layout, which is counted, and for one that is parsed."""
    top = tmap2(change)
    assert findings_of("tmap2", {"a.tmap2.yaml": json.dumps(top).encode()}) == expected, "parsed"
    block = yaml.dump(json.loads(json.dumps(top)), default_flow_style=False).encode()
    assert findings_of("tmap2", {"a.tmap2.yaml": block}) == expected, "counted"


def test_regular_network_is_not_parsed(monkeypatch: pytest.MonkeyPatch) -> None:
    from app.formats.tmap import rules

    def parse(*_: Any) -> Any:
        raise AssertionError

    monkeypatch.setattr(rules.yaml, "load", parse)
    block = yaml.dump(tmap2(), default_flow_style=False).encode()
    assert findings_of("tmap2", {"a.tmap2.yaml": block}) == set()


def test_only_head_of_large_written_network_is_checked() -> None:
    text = yaml.dump(tmap2(lambda top: top["meta"].update(last_updated=0)), default_flow_style=False).encode()
    files = {"a.tmap2.yaml": text + b"# " + bytes([120]) * 2**20 + b"\n"}
    token = formats.JUST_WRITTEN.set(True)
    try:
        assert findings_of("tmap2", files) == {(ERROR, "meta.last_updated")}
    finally:
        formats.JUST_WRITTEN.reset(token)


# --- Open-RMF -----------------------------------------------------------------------------------------------------
def building(change: Callable[[dict[str, Any]], object] = lambda top: None) -> dict[str, bytes]:
    level = {
        "vertices": [[0, 0, 0, "a"], [10, 0, 0, "b", {"is_charger": [4, True]}], [10, 9, 0, ""]],
        "lanes": [[0, 1, {"graph_idx": [2, 0], "bidirectional": [4, True], "speed_limit": [3, 0]}]],
        "measurements": [[0, 1, {"distance": [3, 5.0]}]],
        "doors": [[0, 2, {"name": [1, "d"], "type": [1, "hinged"]}]],
        "floors": [{"vertices": [0, 1, 2], "parameters": {}}],
        "fiducials": [[1, 2, "f"], [3, 4, "g"]],
        "elevation": 0.0,
    }
    lift = {"depth": 1.0, "width": 1.0, "yaw": 0.0, "x": 1.0, "y": 1.0, "reference_floor_name": "L1"}
    door = {"door_type": 2, "x": 0.0, "y": 1.0, "motion_axis_orientation": 0.0, "width": 1.0}
    lift |= {"doors": {"d1": door}, "level_doors": {"L1": ["d1"]}}
    top: dict[str, Any] = {"name": "b", "coordinate_system": "reference_image", "levels": {"L1": level, "L2": level}}
    top["lifts"] = {"lift": lift}
    top = json.loads(json.dumps(top))
    change(top)
    return {"building.yaml": json.dumps(top).encode()}


def level1(top: dict[str, Any]) -> Any:
    return top["levels"]["L1"]


RMF: list[Any] = [
    (lambda top: None, set()),
    (lambda top: top.pop("name"), {(ERROR, "name")}),
    (lambda top: top.update(coordinate_system="metres"), {(ERROR, "coordinate_system")}),
    (lambda top: top.pop("levels"), {(ERROR, "levels")}),
    (lambda top: top.update(reference_level_name="L9"), {(ERROR, "reference_level_name")}),
    (lambda top: top.update(parameters={"p": 3}), {(ERROR, "parameters.p")}),
    (lambda top: top.update(parameters={"p": [2, 1.5]}), {(ERROR, "parameters.p")}),
    (lambda top: top.update(parameters={"p": [4, 1]}), {(ERROR, "parameters.p")}),
    (lambda top: level1(top)["vertices"][0].pop(), {(ERROR, "levels.L1.vertices[0]")}),
    (lambda top: level1(top)["vertices"][2].__setitem__(3, "a"), {(WARNING, "levels.L1.vertices")}),
    (lambda top: level1(top)["lanes"][0].__setitem__(1, 3), {(ERROR, "levels.L1.lanes[0]")}),
    (lambda top: level1(top)["lanes"][0].__setitem__(0, -1), {(ERROR, "levels.L1.lanes[0]")}),
    (lambda top: level1(top)["lanes"][0][2].update(graph_idx=[2, 9]), {(WARNING, "levels.L1.lanes[0]")}),
    (lambda top: level1(top).update(measurements=[]), {(WARNING, "levels.L1.measurements")}),
    (lambda top: level1(top)["measurements"][0].__setitem__(2, {}), {(ERROR, "levels.L1.measurements[0]")}),
    (lambda top: level1(top)["measurements"][0].__setitem__(1, 0), {(ERROR, "levels.L1.measurements[0]")}),
    (lambda top: level1(top)["doors"][0][2].pop("type"), {(ERROR, "levels.L1.doors[0]")}),
    (lambda top: level1(top)["doors"][0][2].update(type=[1, "swing"]), {(WARNING, "levels.L1.doors[0]")}),
    (lambda top: level1(top)["floors"][0].update(vertices=[0, 1, 7]), {(ERROR, "levels.L1.floors[0]")}),
    (lambda top: level1(top).update(fiducials=[]), {(WARNING, "levels.L2.fiducials")}),
    (lambda top: level1(top)["fiducials"].append([1]), {(ERROR, "levels.L1.fiducials[2]")}),
    (lambda top: level1(top).update(drawing={}), {(ERROR, "levels.L1.drawing")}),
    (lambda top: level1(top).update(drawing={"filename": "x.png"}), {(WARNING, "levels.L1.drawing.filename")}),
    (lambda top: top["lifts"]["lift"].pop("yaw"), {(ERROR, "lifts.lift")}),
    (lambda top: top["lifts"]["lift"].update(reference_floor_name="X"), {(ERROR, "lifts.lift.reference_floor_name")}),
    (lambda top: top["lifts"]["lift"]["level_doors"].update(X=[]), {(ERROR, "lifts.lift.level_doors")}),
    (lambda top: top["lifts"]["lift"]["doors"]["d1"].pop("width"), {(ERROR, "lifts.lift.doors.d1")}),
    (lambda top: top.update(coordinate_system="web_mercator"), {
        (ERROR, "parameters.generate_crs"), (WARNING, "parameters.generate_origin_vertex")}),
    (lambda top: top.update(coordinate_system="wgs84", parameters={
        "generate_crs": [1, "EPSG:32630"], "suggested_offset_x": [3, 1.0], "suggested_offset_y": [3, 1.0]}),
        {(WARNING, "parameters.generate_crs")}),
    (lambda top: top.update(coordinate_system="wgs84", parameters={"generate_crs": [1, "EPSG:3414"]}), {
        (ERROR, "parameters.suggested_offset_x"), (ERROR, "parameters.suggested_offset_y")}),
]  # fmt: skip


@pytest.mark.parametrize(("change", "expected"), RMF)
def test_building_map_generator_rules(change: Callable[[dict[str, Any]], object], expected: Found) -> None:
    assert findings_of("openrmf", building(change)) == expected


def nav(change: Callable[[dict[str, Any]], object] = lambda top: None) -> dict[str, bytes]:
    level = {"vertices": [[0, 0, {"name": "a"}], [1.5, 0, {"name": ""}]], "lanes": [[0, 1, {}], [1, 0, {}]]}
    top: dict[str, Any] = {"building_name": "b", "levels": {"L1": level, "L2": {"vertices": [], "lanes": []}}}
    top |= {"doors": {"d": {"endpoints": [[0, 0], [1, 1]], "map": "L1"}}}
    top |= {"lifts": {"l": {"position": [0, 0, 0], "dims": [1, 1]}}}
    top = json.loads(json.dumps(top))
    change(top)
    return {"0.yaml": json.dumps(top).encode()}


def _in_lift(top: dict[str, Any]) -> None:
    level1(top)["vertices"][1][2].update(lift="l")


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda top: None, set()),
        (lambda top: top.pop("levels"), {(ERROR, "levels")}),
        (lambda top: level1(top).pop("lanes"), {(ERROR, "levels.L1")}),
        (lambda top: level1(top)["vertices"][0].pop(), {(ERROR, "levels.L1.vertices[0]")}),
        (lambda top: level1(top)["vertices"][1][2].update(name="a"), {(ERROR, "levels")}),
        (lambda top: level1(top)["vertices"][1][2].update(lift="x"), {(ERROR, "levels.L1.vertices[1]")}),
        (lambda top: (_in_lift(top), top.update(lifts={})), {(ERROR, "levels.L1.vertices[1]")}),
        (lambda top: (_in_lift(top), top.pop("lifts")), set()),
        (lambda top: level1(top)["lanes"][0].__setitem__(1, 2), {(ERROR, "levels.L1.lanes[0]")}),
        (lambda top: level1(top)["lanes"][0].pop(), {(ERROR, "levels.L1.lanes[0]")}),
        (
            lambda top: level1(top)["lanes"][0][2].update(orientation_constraint="sideways"),
            {(ERROR, "levels.L1.lanes[0].orientation_constraint")},
        ),
        (lambda top: level1(top)["lanes"][0][2].update(speed_limit="1"), {(ERROR, "levels.L1.lanes[0].speed_limit")}),
        (lambda top: top["doors"]["d"].pop("map"), {(ERROR, "doors.d")}),
        (lambda top: top["lifts"]["l"].update(dims=[1]), {(ERROR, "lifts.l")}),
    ],
)
def test_fleet_adapter_rules(change: Callable[[dict[str, Any]], object], expected: Found) -> None:
    assert findings_of("rmf_nav_graph", nav(change)) == expected


# --- Fawkes -------------------------------------------------------------------------------------------------------
FAWKES = """%YAML 1.2
%TAG ! tag:fawkesrobotics.org,navgraph/
---
graph-name: g
nodes:
  - {name: A, pos: [0.0, 1]}
  - {name: B, pos: [2, 1], properties: [home, {width: 3}]}
  - !unconnected {name: C, pos: [5, 5]}
connections:
  - !dir [A, B]
"""


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("", "", set()),
        ("graph-name: g\n", "", {(ERROR, "graph-name")}),
        ("name: A, ", "", {(ERROR, "nodes[0]"), (ERROR, "connections")}),
        ("[0.0, 1]", "[0.0, 1, 2]", {(ERROR, "nodes[0].pos")}),
        ("[0.0, 1]", "[0.0, east]", {(ERROR, "nodes[0].pos")}),
        ("name: C", "name: A", {(ERROR, "nodes")}),
        ("!unconnected ", "", {(ERROR, "nodes")}),
        ("[A, B]", "[A, D]", {(ERROR, "connections"), (ERROR, "nodes")}),
        ("[A, B]", "[A]", {(ERROR, "connections[0]"), (ERROR, "nodes")}),
        ("!dir", "!sometimes", {(WARNING, "connections[0]")}),
        ("[home, {width: 3}]", "{width: 3}", {(ERROR, "nodes[1].properties")}),
        ("{width: 3}", "{width: [3]}", {(ERROR, "nodes[1].properties[1]")}),
        ("%TAG ! tag:fawkesrobotics.org,navgraph/\n", "", {(ERROR, None), (ERROR, "nodes")}),
        ("  - !dir [A, B]\n", "  - [A, B]\n  - [A, B]\n", {(WARNING, "connections")}),
    ],
)
def test_fawkes_rules(old: str, new: str, expected: Found) -> None:
    assert old in FAWKES
    assert findings_of("navgraph", {"g.yaml": FAWKES.replace(old, new, 1).encode()}) == expected


# --- OctoMap ------------------------------------------------------------------------------------------------------
def octree(head: str = "# Octomap OcTree binary file", tree: str = "OcTree", size: int = 3, res: str = "0.1",
           body: bytes = b"\x07\x00\x02\x00") -> dict[str, bytes]:  # fmt: skip
    """A root with a free child and an inner one, which has one occupied child: 4 nodes with the root."""
    return {"a.bt": f"{head}\n#\nid {tree}\nsize {size}\nres {res}\ndata\n".encode() + body}


FULL = "# Octomap OcTree file"


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        (octree(size=4, body=b"\x0d\x00\x02\x00"), set()),  # codes 1 (free), 3 (inner); then 2 (occupied)
        (octree(size=5, body=b"\x0d\x00\x02\x00"), {(WARNING, "size")}),
        (octree(size=4, body=b"\x0d\x00"), {(ERROR, None)}),
        (octree(size=4, body=b"\x0d\x00\x02\x00\x00\x00"), {(WARNING, None)}),
        (octree(size=0, body=b""), set()),
        (octree(head="# Octomap"), {(ERROR, None)}),
        (octree(tree="MyTree", size=4, body=b"\x0d\x00\x02\x00"), {(ERROR, "id")}),
        (octree(res="0", size=4, body=b"\x0d\x00\x02\x00"), {(ERROR, "res")}),
        (octree(res="x", size=4, body=b"\x0d\x00\x02\x00"), {(ERROR, "res")}),
        (octree(FULL, size=2, body=bytes(10)), set()),
        (octree(FULL, size=2, body=bytes(9)), {(ERROR, "size")}),
        (octree(FULL, size=2, body=bytes(11)), {(WARNING, "size")}),
        (octree(FULL, "ColorOcTree", size=2, body=bytes(16)), set()),
    ],
)
def test_octomap_rules(files: dict[str, bytes], expected: Found) -> None:
    assert findings_of("octomap", files) == expected


# --- LIF ----------------------------------------------------------------------------------------------------------
def lif(change: Callable[[dict[str, Any]], object] = lambda top: None) -> dict[str, bytes]:
    meta = {
        "projectIdentification": "p",
        "creator": "c",
        "exportTimestamp": "2024-05-01T00:00:00Z",
        "lifVersion": "1.0.0",
    }
    nodes = [
        {
            "nodeId": i,
            "nodePosition": {"x": 0.0, "y": 1},
            "vehicleTypeNodeProperties": [{"vehicleTypeId": "v", "theta": 3.14159265}],
        }
        for i in ("n1", "n2")
    ]
    edge = {
        "edgeId": "e1",
        "startNodeId": "n1",
        "endNodeId": "n2",
        "vehicleTypeEdgeProperties": [{"vehicleTypeId": "v"}],
    }
    layout: dict[str, Any] = {"layoutId": "l", "layoutVersion": "1", "nodes": nodes, "edges": [edge]}
    layout["stations"] = [{"stationId": "s", "interactionNodeIds": ["n1"]}]
    top = json.loads(json.dumps({"metaInformation": meta, "layouts": [layout]}))
    change(top)
    return {"a.lif.json": json.dumps(top).encode()}


def lay(top: dict[str, Any]) -> Any:
    return top["layouts"][0]


THETA = "layouts[0].nodes[0].vehicleTypeNodeProperties[0].theta"


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda top: None, set()),
        (lambda top: top["metaInformation"].pop("creator"), {(ERROR, "metaInformation")}),
        (lambda top: top.pop("layouts"), {(ERROR, "layouts")}),
        (lambda top: lay(top).pop("layoutId"), {(ERROR, "layouts[0].layoutId")}),
        (lambda top: lay(top).pop("stations"), set()),
        (lambda top: lay(top).pop("edges"), {(WARNING, "layouts[0].edges")}),
        (lambda top: lay(top)["nodes"][0].pop("nodePosition"), {(ERROR, "layouts[0].nodes[0]")}),
        (lambda top: lay(top)["nodes"].append(lay(top)["nodes"][0]), {(ERROR, "nodeId")}),
        (lambda top: lay(top)["edges"][0].update(endNodeId="n9"), {(ERROR, "layouts")}),
        (lambda top: lay(top)["edges"][0].pop("edgeId"), {(ERROR, "layouts[0].edges[0]")}),
        (
            lambda top: lay(top)["edges"][0].update(vehicleTypeEdgeProperties=[]),
            {(ERROR, "layouts[0].edges[0].vehicleTypeEdgeProperties")},
        ),
        (lambda top: lay(top)["nodes"][0]["vehicleTypeNodeProperties"][0].update(theta=90), {(WARNING, THETA)}),
        (lambda top: lay(top)["nodes"][0]["vehicleTypeNodeProperties"][0].update(theta="1"), {(ERROR, THETA)}),
        (lambda top: lay(top)["stations"][0].update(interactionNodeIds=["x"]), {(ERROR, "layouts")}),
    ],
)
def test_lif_rules(change: Callable[[dict[str, Any]], object], expected: Found) -> None:
    assert findings_of("lif", lif(change)) == expected


# --- KML, KMZ, OSM ------------------------------------------------------------------------------------------------
KML = """<kml xmlns="http://www.opengis.net/kml/2.2"><Document><Style id="s"/>
<Placemark id="p"><styleUrl>#s</styleUrl><Point><coordinates>
 -0.5,53.2,1 </coordinates></Point></Placemark>
<GroundOverlay><Icon><href>files/a.png</href></Icon></GroundOverlay></Document></kml>"""


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("", "", set()),
        ("kml", "gpx", {(ERROR, None)}),
        (' xmlns="http://www.opengis.net/kml/2.2"', "", {(WARNING, None)}),
        ('id="p"', 'id="s"', {(WARNING, None)}),
        ("#s", "#t", {(WARNING, None)}),
        ("-0.5,53.2,1", "53.2,-180.5", {(ERROR, None)}),
        ("-0.5,53.2,1", "here", {(ERROR, None)}),
        ("-0.5,53.2,1", "", set()),
        ("</Document>", "", {(ERROR, None)}),
    ],
)
def test_kml_rules(old: str, new: str, expected: Found) -> None:
    assert findings_of("kml", {"a.kml": KML.replace(old, new).encode() if old else KML.encode()}) == expected


@pytest.mark.parametrize(
    ("members", "expected"),
    [
        ({"doc.kml": KML, "files/a.png": "x"}, set()),
        ({"doc.kml": KML}, {(WARNING, None)}),
        ({"in/doc.kml": KML, "in/files/a.png": "x"}, set()),
        ({"doc.kml": KML, "b.kml": KML, "files/a.png": "x"}, {(WARNING, None)}),
        ({"files/a.png": "x"}, {(ERROR, None)}),
    ],
)
def test_kmz_rules(members: dict[str, str], expected: Found) -> None:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as z:
        for name, text in members.items():
            z.writestr(name, text)
    assert findings_of("kmz", {"a.kmz": data.getvalue()}) == expected


OSM = """<osm version="0.6"><bounds/>
<node id="1" version="1" lat="53" lon="-0.5"/><node id="2" version="1" lat="53" lon="-0.6"/>
<way id="1" version="1"><nd ref="1"/><nd ref="2"/></way>
<relation id="1" version="1"/></osm>"""


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("", "", set()),
        ('"0.6"', '"0.5"', {(ERROR, "version")}),
        ("<osm", "<gpx", {(ERROR, None)}),
        ('<node id="1"', "<node", {(ERROR, None)}),
        ('<node id="1"', '<node id="x"', {(ERROR, None)}),
        (' lat="53" lon="-0.5"', "", {(ERROR, None)}),
        (' lat="53" lon="-0.5"', ' action="delete"', set()),
        ('<node id="1" version="1"', '<node id="1"', {(WARNING, None)}),
        ('ref="2"', 'ref="3"', {(WARNING, None)}),
        ('<way id="1" version="1"', '<way id="-1"', {(WARNING, None)}),
        ('<node id="2"', '<node id="1"', {(WARNING, None)}),
        ("<bounds/>", '<way id="9" version="1"/>', {(WARNING, None)}),
        (
            '<node id="2" version="1"',
            '<node id="2" version="1" lat="1" lon="1"/><node id="1" version="1"',
            {(WARNING, None)},
        ),
    ],
)
def test_osm_rules(old: str, new: str, expected: Found) -> None:
    text = OSM.replace(old, new, 1) if old else OSM
    text = text.replace("</osm>", "</gpx>") if "gpx" in new else text
    assert findings_of("osm", {"a.osm": text.encode()}) == expected
    assert findings_of("osm", {"a.osm.gz": gzip.compress(text.encode())}) == expected


# --- datum.yaml ---------------------------------------------------------------------------------------------------
DATUM = """datum_latitude: 53.25
datum_longitude: -0.5
gnss_fence: {gnss_fence_coords: [[53.1, -0.5], [53.2, -0.5], [53.2, -0.4]]}
gmapping: {xmin: -1, xmax: 1, ymin: 1, ymax: -1}
navsat_transform_node: {wait_for_datum: true, datum: [53.25, -0.5, 0.0]}
"""


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("", "", set()),
        ("datum_latitude: 53.25", "", {(ERROR, "datum_latitude")}),
        ("datum_latitude: 53.25", "datum_latitude: 153.25", {(ERROR, "datum_latitude")}),
        ("[53.1, -0.5], ", "", {(ERROR, "gnss_fence.gnss_fence_coords")}),
        ("[53.1, -0.5]", "[-0.5, 253.1]", {(ERROR, "gnss_fence.gnss_fence_coords")}),
        ("gnss_fence: ", "fence: ", {(WARNING, "gnss_fence")}),
        ("xmin: -1, ", "", {(ERROR, "gmapping")}),
        ("datum: [53.25, -0.5, 0.0]", "datum: [53.25, -0.5]", {(ERROR, "navsat_transform_node.datum")}),
        ("datum: [53.25, -0.5, 0.0]", "datum: [53.25, -0.5, 0]", {(WARNING, "navsat_transform_node.datum")}),
        ("datum: [53.25, -0.5, 0.0]", "datum: [53.26, -0.5, 0.0]", {(WARNING, "navsat_transform_node.datum")}),
        (", datum: [53.25, -0.5, 0.0]", "", {(WARNING, "navsat_transform_node.datum")}),
    ],
)
def test_datum_rules(old: str, new: str, expected: Found) -> None:
    assert findings_of("datum", {"datum.yaml": DATUM.replace(old, new, 1).encode()}) == expected


# --- all of them --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("name", "files"), [case for case in CASES if formats.get_format(str(case.values[0])).check is not None]
)
def test_check_of_damaged_files_returns_findings(name: str, files: dict[str, bytes]) -> None:
    """Arbitrary bytes cause no crash; unparsable content is an error."""
    fmt = formats.get_format(name)
    for victim, data in files.items():
        for damaged in mutations(data, seed=len(victim)):
            for problem in formats.check(fmt, {**files, victim: damaged}):
                assert problem.level in (ERROR, WARNING)
                assert problem.file
