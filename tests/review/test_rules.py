"""Rules of the check: each finds its mistake, is silent on sound networks, and its fix makes the finding vanish."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pytest
import shapely

from app.model.features import Properties, features
from app.model.grid import UNKNOWN, OccupancyGrid
from app.model.layers import Layers, Part, PartKey
from app.review.findings import Finding
from app.review.rules import MAX_FINDINGS, RULES, check_layers

Edge = tuple[str, str]
SQUARE = {"a": (0.0, 0.0), "b": (10.0, 0.0), "c": (10.0, 10.0), "d": (0.0, 10.0)}


def both(*edges: Edge) -> list[Edge]:
    """Return edges in both directions."""
    return [way for a, b in edges for way in ((a, b), (b, a))]


AROUND = both(("a", "b"), ("b", "c"), ("c", "d"), ("d", "a"))


def network(
    nodes: Mapping[str, tuple[float, float]] = SQUARE,
    edges: Sequence[Edge] = AROUND,
    level: str = "ground",
    names: Mapping[str, str] | None = None,
    **properties: Any,
) -> dict[PartKey, Part]:
    rows: list[tuple[str, Any, Properties]] = [
        (i, shapely.Point(xy), {"kind": "node", "name": (names or {}).get(i, i)}) for i, xy in nodes.items()
    ]
    for a, b in edges:
        line = shapely.LineString([nodes.get(a, (0, 0)), nodes.get(b, (0, 0))])
        rows.append((f"{a}-{b}", line, {"kind": "edge", "source": a, "target": b, **properties}))
    return {PartKey("topology", level, "network"): features(rows, "local")}


def part(layer: Any, level: str, name: str, *rows: tuple[str, Any, Properties]) -> dict[PartKey, Part]:
    return {PartKey(layer, level, name): features(rows, "local")}


def grid(*occupied: tuple[float, float], yaw: float = 0.0, fill: int = 0) -> OccupancyGrid:
    """Return a grid of 20 × 20 m around (-5, -5), turned by yaw, with these points occupied."""
    cells = np.full((200, 200), fill, np.uint8)
    c, s = math.cos(yaw), math.sin(yaw)
    for x, y in occupied:
        dx, dy = x + 5, y + 5
        cells[int((dy * c - dx * s) / 0.1), int((dx * c + dy * s) / 0.1)] = 100
    return OccupancyGrid(cells, 0.1, (-5.0, -5.0, yaw))


def found(*parts: Mapping[PartKey, Part], level: str | None = None) -> dict[str, list[Finding]]:
    out: dict[str, list[Finding]] = {}
    for rule, finding in check_layers(Layers({k: v for p in parts for k, v in p.items()}), level).findings:
        out.setdefault(rule.name, []).append(finding)
    return out


def test_a_sound_network_has_no_findings() -> None:
    zone = part("zones", "ground", "zones", ("z", shapely.box(20, 20, 30, 30), {"kind": "keepout"}))
    assert found(network(), {PartKey("occupancy"): grid((5, 5))}, zone) == {}


@pytest.mark.parametrize("yaw", [0.0, 0.3])
def test_edge_through_occupied_cells(yaw: float) -> None:
    (finding,) = found(network(), {PartKey("occupancy"): grid((4.0, 0.02), yaw=yaw)})["edge-through-obstacle"]
    assert set(finding.ids) == {"a-b", "b-a"}
    assert finding.position is not None
    assert math.dist(finding.position, (4.0, 0.0)) < 0.2


def test_unknown_cells_and_other_levels_are_no_obstacle() -> None:
    assert found(network(), {PartKey("occupancy"): grid(fill=UNKNOWN)}) == {}
    assert found(network(), {PartKey("occupancy", "L2"): grid((4.0, 0.02))}) == {}


def test_edge_through_a_building_in_unknown_ground() -> None:
    house = part("objects", "ground", "site", ("house", shapely.box(4, -1, 6, 1), {"kind": "building"}))
    (finding,) = found(network(), house)["edge-through-obstacle"]
    assert "house" in finding.detail
    assert found(network(), house, {PartKey("occupancy"): grid()}) == {}, "the cells are known to be free"


def test_edge_through_keepout() -> None:
    zone = part("zones", "ground", "zones", ("z", shapely.box(4, -1, 6, 1), {"kind": "keepout"}))
    (finding,) = found(network(), zone)["edge-through-keepout"]
    assert finding.position is not None
    assert shapely.box(4, -1, 6, 1).covers(shapely.Point(finding.position))
    speed = part("zones", "ground", "zones", ("z", shapely.box(4, -1, 6, 1), {"kind": "speed"}))
    assert found(network(), speed) == {}
    mask = {PartKey("occupancy", "ground", "keepout"): grid((4.0, 0.02))}
    assert list(found(network(), mask)) == ["edge-through-keepout"], "a mask is no grid of obstacles"
    assert found(network(), {PartKey("occupancy", "ground", "speed"): grid((4.0, 0.02))}) == {}


def test_object_on_edge() -> None:
    box = part("objects", "ground", "site", ("crate", shapely.Point(5, 0), {"kind": "crate"}))
    (finding,) = found(network(), box)["object-on-edge"]
    assert finding.ids[-1] == "crate"
    for kind in ("region", "light", "floor"):
        assert found(network(), part("objects", "ground", "site", ("o", shapely.Point(5, 0), {"kind": kind}))) == {}


def test_near_misses() -> None:
    nodes = {**SQUARE, "e": (5.0, 0.3), "f": (5.0, 5.0)}
    (finding,) = found(network(nodes, [*AROUND, *both(("e", "f"))]))["near-miss"]
    assert finding.ids[0] == "e"
    assert set(finding.ids[1:]) == {"a-b", "b-a"}
    nodes = {**SQUARE, "e": (0.2, -0.2), "f": (-8.0, -8.0)}
    (finding,) = found(network(nodes, [*AROUND, *both(("e", "f"))]))["near-miss"]
    assert set(finding.ids) == {"a", "e"}


def test_dense_networks_have_no_near_misses() -> None:
    nodes = {f"n{x}-{y}": (x * 0.3, y * 0.3) for x in range(8) for y in range(8)}
    edges = both(*[(f"n{x}-{y}", f"n{x + 1}-{y}") for x in range(7) for y in range(8)])
    edges += both(*[(f"n{x}-{y}", f"n{x}-{y + 1}") for x in range(8) for y in range(7)])
    assert found(network(nodes, edges)) == {}


def test_names_and_duplicates() -> None:
    (finding,) = found(network(names={"a": "dock", "c": "dock"}))["duplicate-name"]
    assert finding.ids == ("a", "c")
    parts = network()
    key = PartKey("topology", "ground", "network")
    (base,) = parts.values()
    rows = [(f.id, f.geometry, f.properties) for f in base]  # type: ignore[union-attr]
    again = ("again", shapely.LineString([(0, 0), (10, 0)]), {"kind": "edge", "source": "a", "target": "b"})
    (finding,) = found({key: features([*rows, again], "local")})["duplicate-edge"]
    assert set(finding.ids) == {"a-b", "again"}
    detour = ("detour", shapely.LineString([(0, 0), (5, -5), (10, 0)]), again[2])
    assert found({key: features([*rows, detour], "local")}) == {}


def test_dead_ends_and_unreachable_parts() -> None:
    nodes = {**SQUARE, "e": (20.0, 0.0), "f": (30.0, 0.0), "g": (40.0, 0.0)}
    (finding,) = found(network(nodes, [*AROUND, ("b", "e"), *both(("f", "g"), ("e", "f"))]))["unreachable-part"]
    assert set(finding.ids) == {"e", "f", "g"}
    assert "not left" in finding.detail
    result = found(network({**SQUARE, "e": (20.0, 0.0)}, [*AROUND, ("b", "e")]))
    assert set(result) == {"dead-end"}
    assert result["dead-end"][0].ids == ("e",)
    result = found(network({**SQUARE, "e": (20.0, 0.0), "f": (30.0, 0.0)}, [*AROUND, *both(("e", "f"))]))
    assert "no connection" in result["unreachable-part"][0].detail


def test_blocked_edges_do_not_connect() -> None:
    rows = [*AROUND]
    nodes = {**SQUARE, "e": (20.0, 0.0), "f": (30.0, 0.0)}
    parts = network(nodes, [*rows, *both(("e", "f"))])
    closed = network({"b": nodes["b"], "e": nodes["e"]}, both(("b", "e")), blocked=True)
    (key,) = parts
    joined = {f.id: (f.id, f.geometry, f.properties) for p in (parts, closed) for f in p[key]}  # type: ignore[union-attr]
    assert set(found({key: features(joined.values(), "local")})) == {"unreachable-part"}


def test_isolated_nodes_and_zero_lengths() -> None:
    assert found(network({**SQUARE, "e": (20.0, 0.0)}))["isolated-node"][0].ids == ("e",)
    unnamed = {"kind": "node"}
    drawn = part("topology", "ground", "drawn", ("f", shapely.Point(20, 0), unnamed))
    assert found(network(), drawn)["isolated-node"][0].ids == ("f",)
    corner = part("topology", "ground", "building", ("f", shapely.Point(20, 0), {**unnamed, "openrmf": {"index": 3}}))
    assert found(network(), corner) == {}, "a corner of a wall in an Open-RMF building has no name"
    result = found(network(edges=[*AROUND, ("a", "a")]))
    assert result["zero-length-edge"][0].ids == ("a-a",)


def test_crossing_edges() -> None:
    result = found(network(edges=[*AROUND, *both(("a", "c"), ("b", "d"))]))
    (finding,) = result["crossing-edges-without-node"]
    assert finding.position == (5.0, 5.0)
    bridge = {"osm": {"tags": {"bridge": "yes", "layer": "1"}}}
    key = PartKey("topology", "ground", "network")
    plain, above = network(edges=[*AROUND, *both(("a", "c"))]), network(edges=both(("b", "d")), **bridge)
    joined = {f.id: (f.id, f.geometry, f.properties) for p in (plain, above) for f in p[key]}  # type: ignore[union-attr]
    assert found({key: features(joined.values(), "local")}) == {}


def test_lifts() -> None:
    lift = {"nav_graph": {"parameters": {"lift": "L"}}}

    def storey(level: str, prefix: str, x: float) -> dict[PartKey, Part]:
        stop, far = f"{prefix}stop", f"{prefix}far"
        rows: list[tuple[str, Any, Properties]] = [
            (stop, shapely.Point(x, 0), {"kind": "node", "name": stop, **lift}),
            (far, shapely.Point(x, 9), {"kind": "node", "name": far}),
        ]
        for a, b in both((stop, far)):
            rows.append((f"{a}-{b}", shapely.LineString([(x, 0), (x, 9)]), {"kind": "edge", "source": a, "target": b}))
        return part("topology", level, "network", *rows)

    assert found(storey("L1", "p", 0.0), storey("L2", "q", 0.0)) == {}, "a lift connects levels without edges"
    (finding,) = found(storey("L1", "p", 0.0), storey("L2", "q", 3.0))["lifts-do-not-stack"]
    assert finding.ids == ("qstop", "pstop")


def test_outside_fence() -> None:
    fence = part("location", "ground", "site", ("fence", shapely.box(-1, -1, 11, 5), {}))
    (finding,) = found(network(), fence)["outside-fence"]
    assert set(finding.ids) == {"c", "d"}


def test_level_and_limit() -> None:
    upper = network({"e": (20.0, 0.0)}, [], level="L2")
    assert found(network(), upper, level="ground") == {}
    assert set(found(network(), upper, level="L2")) == {"isolated-node"}
    many = check_layers(Layers(network({f"n{k}": (float(k), 0.0) for k in range(1500)}, [])))
    assert len(many.findings) == MAX_FINDINGS
    assert many.truncated


def test_hostile_network_is_checked_in_bounded_time() -> None:
    nodes = {f"n{k}": (1e-4 * (k % 7), 0.0) for k in range(20_000)}
    edges = [(f"n{k}", f"n{k + 1}") for k in range(19_999)]
    result = check_layers(Layers(network({**nodes, "far": (100.0, 0.0)}, [*edges, ("n0", "far")])))
    assert result.truncated


def test_content_without_a_datum_is_checked_as_far_as_possible() -> None:
    rows = [
        ("a", shapely.Point(5, 52), {"kind": "node", "name": "x"}),
        ("b", shapely.Point(5, 53), {"kind": "node", "name": "x"}),
    ]
    key = PartKey("topology", "ground", "network")
    result = found({key: features(rows, "wgs84")})
    assert result["duplicate-name"][0].position is None


def test_rules_are_described() -> None:
    for rule in RULES:
        assert rule.find.__doc__, rule.name
        assert rule.severity in ("error", "warning", "info")
