"""Networks from lines: joins, directions, and names of nodes and edges."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from app.errors import Invalid, MissingDatum
from app.model.features import Features, concatenate, features
from app.model.frame import Datum
from app.model.geodesy import local_frame
from app.model.network import direction, from_drawing


def line(*at: tuple[float, ...]) -> shapely.LineString:
    return shapely.LineString(at)


def drawing(**items: Any) -> Features:
    rows = []
    for name, value in items.items():
        geometry, properties = value if isinstance(value, tuple) else (value, {})
        kind = "poi" if geometry.geom_type == "Point" else "path"
        rows.append((name, geometry, {"kind": kind, **properties}))
    return features(rows, "local")


def nodes(network: Features) -> dict[str, tuple[float, ...]]:
    return {f.id: f.geometry.coords[0] for f in network if f.properties["kind"] == "node"}


def edges(network: Features) -> set[tuple[str, str]]:
    return {(f.properties["source"], f.properties["target"]) for f in network if f.properties["kind"] == "edge"}


def both(*pairs: tuple[str, str]) -> set[tuple[str, str]]:
    return {*pairs, *((b, a) for a, b in pairs)}


def test_segment_becomes_two_edges_and_two_nodes() -> None:
    network = from_drawing(drawing(a=line((0, 0), (3, 4), (6, 4))))
    assert nodes(network) == {"a/0": (0, 0), "a/1": (3, 4), "a/2": (6, 4)}
    assert edges(network) == both(("a/0", "a/1"), ("a/1", "a/2"))
    by = {f.id: f for f in network}
    assert by["a/0_a/1"].geometry.equals(line((0, 0), (3, 4)))
    assert by["a/1_a/0"].geometry.equals(line((3, 4), (0, 0)))
    assert all(f.properties["drawn_from"] == "a" for f in network)


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ("yes", "forward"),
        ("TRUE", "forward"),
        (1, "forward"),
        (True, "forward"),
        ("-1", "backward"),
        (-1, "backward"),
        ("no", "both"),
        (False, "both"),
        (0, "both"),
        (None, "both"),
    ],
)
def test_oneway_is_found_at_any_depth(value: Any, expected: str) -> None:
    assert direction({"oneway": value}) == expected
    assert direction({"kml": {"data": {"oneway": value}}}) == expected
    assert direction({"kml": {"data": [{"name": "oneway", "value": value}]}}) == expected


def test_oneway_line_has_edges_in_one_direction() -> None:
    network = from_drawing(
        drawing(a=(line((0, 0), (1, 0)), {"oneway": "yes"}), b=(line((5, 0), (6, 0)), {"oneway": "-1"}))
    )
    assert edges(network) == {("a/0", "a/1"), ("b/1", "b/0")}


def test_near_vertices_join_at_first_position() -> None:
    network = from_drawing(
        drawing(a=line((0, 0), (10, 0)), b=line((10.06, 0.05), (20, 0)), c=line((10.2, 0), (10.2, 5)))
    )
    assert nodes(network) == {"a/0": (0, 0), "a/1": (10, 0), "b/1": (20, 0), "c/0": (10.2, 0), "c/1": (10.2, 5)}
    assert ("a/1", "c/0") in edges(network), "c starts on b's segment"


@pytest.mark.parametrize("join", [0.0, 1e-300, 5e-324, 1e-7])
def test_tiny_join_distance_joins_equal_vertices_only(join: float) -> None:
    """Cells of such a size have no number; all vertices were in one of them, and each was compared with all others."""
    far = drawing(a=line((0, 0), (1000, 0)), b=line((1000, 0), (1000, 5)), c=line((1000, 7), (1000.001, 5)))
    assert set(nodes(from_drawing(far, join=join))) == {"a/0", "a/1", "b/1", "c/0", "c/1"}


def test_dense_line_does_not_shrink_to_node() -> None:
    x = np.arange(0, 10, 0.01)
    network = from_drawing(drawing(a=shapely.linestrings(np.column_stack([x, 0 * x]))))
    at = sorted(p[0] for p in nodes(network).values())
    assert len(at) >= 90
    assert min(np.diff(at)) >= 0.1 - 1e-9
    assert shapely.union_all([f.geometry for f in network]).length == pytest.approx(9.99, abs=0.11)


def test_lines_join_at_end_on_line_but_not_at_crossing() -> None:
    network = from_drawing(drawing(a=line((0, 0), (10, 0)), bridge=line((5, -5), (5, 5)), t=line((2, 0.05), (2, 9))))
    assert edges(network) == both(("a/0", "t/0"), ("t/0", "a/1"), ("bridge/0", "bridge/1"), ("t/0", "t/1"))


def test_ring_becomes_closed_path() -> None:
    network = from_drawing(drawing(r=line((0, 0), (1, 0), (1, 1), (0, 0))))
    assert edges(network) == both(("r/0", "r/1"), ("r/1", "r/2"), ("r/2", "r/0"))


def test_collections_and_outlines_become_edges() -> None:
    square = shapely.Polygon([(0, 0), (4, 0), (4, 4), (0, 4)], [[(1, 1), (2, 1), (2, 2)]])
    mixed = shapely.GeometryCollection([shapely.MultiLineString([line((9, 9), (9, 8)), line((9, 8), (7, 7))]), square])
    assert len(edges(from_drawing(drawing(m=mixed)))) == 4
    network = from_drawing(drawing(m=mixed), outlines=True)
    assert len(edges(network)) == 4 + 2 * (4 + 3)
    assert len(set(network.ids)) == len(network)
    assert not len(from_drawing(drawing(p=square)))


def test_points_of_interest_become_nodes_with_their_properties() -> None:
    properties = {"name": "Dock", "orientation": [0, 0, 0, 1], "tmap2": {"verts": []}}
    network = from_drawing(
        drawing(
            a=line((0, 0), (10, 0), (20, 0)),
            dock=(shapely.Point(10.04, 0), properties),
            gate=shapely.Point(15, 0.02),
            far=shapely.Point(99, 99),
        )
    )
    assert nodes(network) == {"dock": (10.04, 0), "gate": (15, 0.02), "far": (99, 99), "a/0": (0, 0), "a/2": (20, 0)}
    assert edges(network) == both(("a/0", "dock"), ("dock", "gate"), ("gate", "a/2"))
    dock = next(f for f in network if f.id == "dock")
    assert dock.properties == {**properties, "kind": "node", "drawn_from": "dock"}


def test_points_of_interest_never_join() -> None:
    network = from_drawing(drawing(p=shapely.Point(0, 0), q=shapely.Point(0.01, 0), a=line((0.02, 0), (5, 0))))
    assert set(nodes(network)) == {"p", "q", "a/1"}


def test_edges_inherit_properties_for_robots() -> None:
    network = from_drawing(drawing(a=(line((0, 0), (1, 0)), {"speed_limit": 0.5, "action": "row", "colour": "red"})))
    edge = next(f for f in network if f.properties["kind"] == "edge")
    assert edge.properties["speed_limit"] == 0.5
    assert edge.properties["action"] == "row"
    assert "colour" not in edge.properties


def test_network_ids_stay_unique_and_short() -> None:
    long = "ä" * 512
    rows = [("a", line((0, 0), (1, 0)), {}), (long, line((5, 0), (6, 0)), {}), ("a/0", line((8, 8), (9, 9)), {})]
    poi = ("a/0_a/1", shapely.Point(50, 50), {"kind": "poi"})
    network = from_drawing(features([*rows, poi], "local"))
    assert len(set(network.ids)) == len(network)
    assert max(map(len, network.ids)) <= 512
    assert edges(network) <= {(a, b) for a in nodes(network) for b in nodes(network)}


def test_network_keeps_altitudes() -> None:
    network = from_drawing(drawing(a=line((0, 0, 3), (1, 0, 4)), b=line((5, 5), (6, 6))))
    assert nodes(network) == {"a/0": (0, 0, 3), "a/1": (1, 0, 4), "b/0": (5, 5), "b/1": (6, 6)}
    assert next(f for f in network if f.id == "a/0_a/1").geometry.has_z


@pytest.mark.parametrize("longitude", [5.0, 179.99999, -180.0])
def test_join_distance_is_in_metres_on_earth_without_datum(longitude: float) -> None:
    lat, lon = 53.0, longitude
    metre = 1 / 67_138.0  # degrees of longitude at 53° N

    def at(metres: float, north: float = 0.0) -> tuple[float, float]:
        east = lon + metres * metre
        return (east - 360.0 if east > 180 else east, lat + north)

    rows = [
        ("a", line(at(0), at(10)), {}),
        ("b", line(at(10.05), at(20)), {}),
        ("c", line(at(10.3), at(10.3, 1e-4)), {}),
    ]
    network = from_drawing(features(rows, "wgs84"))
    assert set(nodes(network)) == {"a/0", "a/1", "b/1", "c/0", "c/1"}
    assert not network.local.any()
    assert nodes(network)["a/0"] == at(0)


def test_network_of_mixed_anchors_uses_datum() -> None:
    earth = features([("w", line((5.0, 52.0), (5.001, 52.0)), {})], "wgs84")
    both_kinds = concatenate([drawing(a=line((500, 500), (510, 500))), earth])
    with pytest.raises(MissingDatum):
        from_drawing(both_kinds)
    network = from_drawing(both_kinds, frame=local_frame(Datum(52.0, 5.0)))
    assert network.local.tolist() == [True, True, False, False] * 2


def test_drawing_of_whole_earth_is_rejected() -> None:
    rows = [("a", line((-170, 0), (0, 0)), {}), ("b", line((90, 80), (150, -80)), {})]
    with pytest.raises(Invalid, match="too much of the earth"):
        from_drawing(features(rows, "wgs84"))


def test_overlapping_lines_are_rejected_in_time() -> None:
    n = 20_000
    rng = np.random.default_rng(5)
    heap = shapely.linestrings(np.stack([rng.random((n, 2)) * [100, 1e-3], rng.random((n, 2)) * [100, 1e-3]], axis=1))
    started = time.process_time()
    with pytest.raises(Invalid, match="overlapping lines"):
        from_drawing(features([(str(k), g, {}) for k, g in enumerate(heap)], "local"))
    assert time.process_time() - started < 20
    dense = rng.random((20_000, 2)) * 0.05
    assert len(nodes(from_drawing(features([("d", shapely.linestrings(dense), {})], "local")))) == 1


def test_network_of_empty_drawing_is_empty() -> None:
    assert not len(from_drawing(features([], "local")))
    assert not len(from_drawing(features([("n", None, {"kind": "note"})], "wgs84")))


coordinate = st.integers(0, 12).map(lambda v: v / 10)
lines = st.lists(st.lists(st.tuples(coordinate, coordinate), min_size=2, max_size=5), min_size=1, max_size=6)


@given(lines)
def test_network_invariants_hold_for_any_drawing(drawn: list[list[tuple[float, float]]]) -> None:
    """Every vertex is within ``join`` of a node, nodes are apart, edges join nodes, and the result is reproducible."""
    objects = features([(str(k), shapely.LineString(c), {"kind": "path"}) for k, c in enumerate(drawn)], "local")
    network = from_drawing(objects, join=0.25)
    positions = nodes(network)
    at = np.array(list(positions.values()))
    for vertex in (v for c in drawn for v in c):
        assert np.hypot(*(at - vertex).T).min() < 0.25
    gaps = np.hypot(*(at[:, None] - at[None]).transpose(2, 0, 1)) + np.eye(len(at))
    assert gaps.min() >= 0.25
    for f in network:
        if f.properties["kind"] == "edge":
            a, b = f.properties["source"], f.properties["target"]
            assert a != b
            assert list(f.geometry.coords) == [positions[a], positions[b]]
            assert (b, a) in edges(network)
    again = from_drawing(objects, join=0.25)
    assert again.ids == network.ids
    assert again.properties == network.properties
