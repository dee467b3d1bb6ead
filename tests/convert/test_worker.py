"""Reports of maps converted from layers."""

from __future__ import annotations

from collections.abc import Mapping

import pytest
import shapely

from app import formats
from app.convert import worker
from app.formats import ReadContext
from app.model.closures import ClosureMode, Closures
from app.model.features import features
from app.model.frame import Datum
from app.model.layers import NETWORK, Layers, PartKey

PLANNED = ("tmap2", "nav2_route", "rmf_nav_graph", "openrmf", "lif", "navgraph", "osm", "lanelet2")


def network(**edge_properties: object) -> Layers:
    rows = [
        ("a", shapely.Point(0, 0), {"kind": "node", "name": "a"}),
        ("b", shapely.Point(5, 0), {"kind": "node", "name": "b"}),
        (
            "a_b",
            shapely.LineString([(0, 0), (5, 0)]),
            {"kind": "edge", "source": "a", "target": "b", **edge_properties},
        ),
        ("b_a", shapely.LineString([(5, 0), (0, 0)]), {"kind": "edge", "source": "b", "target": "a"}),
    ]
    return Layers({PartKey("topology", "ground", NETWORK): features(rows, "local")}, Datum(53.2, -0.5))


def write_map(name: str, layers: Layers, mode: ClosureMode = "apply") -> worker.WrittenMap:
    closures = Closures(mode=mode)
    return worker.from_layers(formats.get_format(name), layers, {}, derived=False, closures=closures)


def edges_in(name: str, files: Mapping[str, bytes]) -> set[tuple[str, str]]:
    """Read the edges of a map with our own reader; a node is a or b by its position, west or east."""
    (group,), _ = formats.group(files, name)
    out = set()
    for part in formats.read(group, ReadContext()).vector("topology").values():
        place = {i: shapely.get_coordinates(g)[0, 0] for i, g in zip(part.ids, part.geometry, strict=True)}
        for p in part.properties:
            if p.get("kind") == "edge":
                start, end = place[str(p["source"])], place[str(p["target"])]
                out.add(("a", "b") if start < end else ("b", "a"))
    return out


@pytest.mark.parametrize("name", PLANNED)
def test_blocked_edge_is_omitted_and_reported(name: str) -> None:
    written = write_map(name, network(blocked=True))
    assert edges_in(name, written.files) == {("b", "a")}
    assert [d["count"] for d in written.report.as_dict()["dropped"] if d["what"] == "blocked edges"] == [1]
    for free in (network(), network(blocked=False)):
        written = write_map(name, free)
        assert edges_in(name, written.files) == {("a", "b"), ("b", "a")}
        assert not [d for d in written.report.as_dict()["dropped"] if d["what"] == "blocked edges"]


@pytest.mark.parametrize("name", PLANNED)
def test_blocked_edge_stays_with_a_warning_when_marked(name: str) -> None:
    written = write_map(name, network(blocked=True), "mark")
    assert edges_in(name, written.files) == {("a", "b"), ("b", "a")}
    (warning,) = [w["problem"] for w in written.report.as_dict()["warnings"] if "blocked" in w["problem"]]
    assert warning.startswith("1 blocked edge stays")
    assert name in warning


def test_formats_without_planners_mark_blocked_edges() -> None:
    written = write_map("geojson", network(blocked=True))
    assert not written.report.as_dict()["warnings"]
    assert b'"blocked":true' in b"".join(written.files.values())
