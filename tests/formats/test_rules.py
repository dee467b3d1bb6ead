"""The consumers' loader rules: each rule finds what breaks it, in files on disk and in what is served.

The bad files are written by hand after the loaders' sources; what is asserted is the level and the place.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from app import formats
from app.convert import make, offline
from app.convert.recipe import Chain
from app.errors import Problem, UnreadableFile
from app.formats import Files, Format, Needs, WriteContext
from app.model.grid import OccupancyGrid
from app.model.layers import Layers, PartKey
from tests.formats.test_every_format import CASES

ERROR, WARNING = "error", "warning"
Found = set[tuple[str | None, str | None]]


def found(name: str, files: dict[str, bytes]) -> Found:
    """(level, place) of each finding."""
    return {(p.level, p.where) for p in formats.check(formats.get_format(name), files)}


@pytest.mark.parametrize(("name", "files"), CASES)
def test_what_is_served_of_a_good_sample_would_be_loaded(name: str, files: dict[str, bytes]) -> None:
    from app.bundle import Hints
    from tests.formats.test_every_format import HERE

    made = offline(files, name, hints=Hints(name), datum=HERE)
    refused = [w for w in made.report["warnings"] if w.get("level") == ERROR]
    assert refused == []


# --- the runner ---------------------------------------------------------------------------------------------------
def with_check(check: Any) -> Format:
    return Format("x", "X", ("x",), ("text/plain",), frozenset(), lambda n, d: True, check=check)


def test_a_check_tells_errors_first_each_once_and_how_many_more() -> None:
    def check(files: Files) -> Iterator[Problem]:
        yield Problem("doubt", level="warning")
        yield Problem("doubt", level="warning")
        yield from (Problem(f"wrong {k}") for k in range(formats.LISTED + 7))

    told = formats.check(with_check(check), {"main": b""})
    assert [p.level for p in told] == [ERROR] * (formats.LISTED + 1) + [WARNING]
    assert told[0] == Problem("wrong 0", "main", level="error")
    assert "7 more" in told[formats.LISTED].problem
    assert formats.check(with_check(None), {"main": b""}) == []


@pytest.mark.parametrize(
    ("raised", "line", "text"),
    [
        (KeyError("nodes"), None, "'nodes' is missing"),
        (UnreadableFile("bad", [Problem("bad here", line=7)]), 7, "bad here"),
    ],
)
def test_a_file_that_does_not_parse_is_an_error(raised: Exception, line: int | None, text: str) -> None:
    def check(files: Files) -> Iterator[Problem]:
        yield Problem("before", level="warning")
        raise raised

    first, before = formats.check(with_check(check), {"main": b""})
    assert (first.level, first.line, first.file) == (ERROR, line, "main")
    assert text in first.problem
    assert before.problem == "before"


def test_a_mistake_of_ours_in_a_check_is_not_hidden() -> None:
    def check(files: Files) -> Iterator[Problem]:
        raise AssertionError
        yield

    with pytest.raises(AssertionError):
        formats.check(with_check(check), {"main": b""})


def test_findings_stand_in_the_report_once_at_their_level() -> None:
    def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
        context.warn("ask for y=1", file="main", where="y")
        context.warn("told by both", file="main")
        return {"main": b"x"}

    def check(files: Files) -> Iterator[Problem]:
        yield Problem("y is not 1", "main", None, "y", "error")
        yield Problem("told by both", "main", None, None, "warning")
        yield Problem("new", "main", None, None, "warning")

    known = replace(with_check(check), write=write, needs=Needs((frozenset(),)))
    context = WriteContext()
    formats.write(known, Layers(), context)
    assert [(p.problem, p.level) for p in context.warnings] == [
        ("ask for y=1", "error"),
        ("told by both", None),
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


def grid(said: dict[str, str | None], picture: bytes = PGM, stem: str = "map") -> dict[str, bytes]:
    text = "".join(f"{k}: {v}\n" for k, v in {**MAP, **said}.items() if v is not None)
    return {f"{stem}.yaml": text.encode(), "map.pgm": picture}


@pytest.mark.parametrize(
    ("said", "expected"),
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
def test_map_server(said: dict[str, str | None], expected: Found) -> None:
    assert found("occupancy_grid", grid(said)) == expected


def test_map_server_finds_the_picture_from_the_yamls_folder() -> None:
    files = {"maps/a.yaml": grid({"image": "../pictures/map.pgm"})["map.yaml"], "pictures/map.pgm": PGM}
    assert found("occupancy_grid", files) == set()


def png(width: int, height: int) -> bytes:
    """A PNG's first chunks: all that a look at the size reads."""
    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    body = zlib.compress(b"\0")
    chunks = [(b"IHDR", head), (b"IDAT", body), (b"IEND", b"")]
    parts = [struct.pack(">I", len(b)) + k + b + struct.pack(">I", zlib.crc32(k + b)) for k, b in chunks]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


@pytest.mark.parametrize(("width", "level"), [(32767, None), (32768, ERROR)])
def test_nav2_takes_32767_cells_each_way(width: int, level: str | None) -> None:
    for picture in (png(width, 2), b"P5 %d 2 255\n" % width + bytes(2 * width)):
        told = formats.check(formats.get_format("occupancy_grid"), grid({}, picture))
        assert [p.level for p in told] == ([level] if level else [])
        assert all(p.file == "map.pgm" for p in told)


def test_damaged_and_missing_pictures_are_errors() -> None:
    assert found("occupancy_grid", grid({}, PGM[:-1])) == {(ERROR, None)}
    assert found("occupancy_grid", grid({}, b"GIF89a")) == {(WARNING, None)}


@pytest.mark.parametrize(
    ("said", "expected"),
    [
        ({"mode": "trinary"}, {(WARNING, "mode"), (WARNING, None)}),
        ({"mode": "scale"}, set()),
        ({"mode": "raw"}, {(WARNING, None)}),
    ],
)
def test_a_speed_mask_has_no_unknown_cells(said: dict[str, str | None], expected: Found) -> None:
    assert found("occupancy_grid", grid(said, stem="speed_mask")) == expected


def test_a_wide_grid_is_told_in_its_report() -> None:
    cells = np.zeros((1, 32768), np.uint8)
    layers = Layers({PartKey("occupancy", "ground", "map"): OccupancyGrid(cells, 0.05, (0.0, 0.0, 0.5))})
    way = Chain((), tuple(layers.parts))
    report = make.write(formats.get_format("occupancy_grid"), layers, {}, way).report
    told = {(w["level"], w["file"], w.get("where")) for w in report["warnings"]}
    assert told == {(ERROR, "map.pgm", None), (WARNING, "map.yaml", "origin")}
    assert any("normalize=true" in w["problem"] for w in report["warnings"]), "the writer's own words stay"


# --- the route server ---------------------------------------------------------------------------------------------
def graph(node: dict[str, Any] | None = None, edge: dict[str, Any] | None = None, **top: Any) -> dict[str, bytes]:
    """Two nodes and an edge, with these further properties."""
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
def test_route_server(files: dict[str, bytes], expected: Found) -> None:
    assert found("nav2_route", files) == expected


def test_far_nodes_lose_millimetres() -> None:
    files = {"g.geojson": graph()["g.geojson"].replace(b"[0, 2.5]", b"[16385, 2.5]")}
    told = formats.check(formats.get_format("nav2_route"), files)
    assert [(p.level, "2 mm" in p.problem) for p in told] == [(WARNING, True)]
