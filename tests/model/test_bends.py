"""Splitting bent edges into straight ones with nodes at the bends, and joining them again."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import shapely

from app import formats
from app.formats import FileGroup, ReadContext, WriteContext
from app.model import bends
from app.model.features import Features, features
from app.model.frame import GROUND, Datum
from app.model.layers import NETWORK, Layers, PartKey

KEY = PartKey("topology", GROUND, NETWORK)
AT = {"a": (0.0, 0.0), "b": (10.0, 0.0), "c": (10.0, 8.0)}
DETOUR = [(2.0, 0.0), (2.0, 6.0), (7.0, 6.0), (10.0, 0.0)]
HOUSE = shapely.box(3, -2, 6, 5)
STRAIGHT = sorted(name for name, fmt in formats.all_formats().items() if fmt.traits.keeps_bends != "shape")


def network(*edges: tuple[str, str, str, list[tuple[float, float]]], **properties: Any) -> Layers:
    rows: list[tuple[str, Any, dict[str, Any]]] = [
        (i, shapely.Point(at), {"kind": "node", "name": i}) for i, at in AT.items()
    ]
    for i, a, b, between in edges:
        line = shapely.LineString([AT[a], *between, AT[b]])
        rows.append((i, line, {"kind": "edge", "source": a, "target": b, **properties}))
    return Layers({KEY: features(rows, "local")})


def part_of(layers: Layers) -> Features:
    (part,) = layers.vector("topology").values()
    return part


def edges(layers: Layers) -> dict[str, tuple[str, str, str]]:
    """Return id -> source, target, shape."""
    part = part_of(layers)
    rows = zip(part.ids, part.properties, part.geometry, strict=True)
    return {i: (p["source"], p["target"], g.wkt) for i, p, g in rows if p["kind"] == "edge"}


def both() -> Layers:
    return network(("a_b", "a", "b", DETOUR[:3]), ("b_a", "b", "a", DETOUR[2::-1]), ("b_c", "b", "c", []))


def test_both_directions_share_nodes_at_their_bends() -> None:
    straight, count = bends.split(both())
    assert count == bends.Split(edges=2, nodes=3)
    assert list(edges(straight).items()) == [
        ("b_c", ("b", "c", "LINESTRING (10 0, 10 8)")),
        ("a_b~1", ("a", "a~b~1", "LINESTRING (0 0, 2 0)")),
        ("a_b~2", ("a~b~1", "a~b~2", "LINESTRING (2 0, 2 6)")),
        ("a_b~3", ("a~b~2", "a~b~3", "LINESTRING (2 6, 7 6)")),
        ("a_b~4", ("a~b~3", "b", "LINESTRING (7 6, 10 0)")),
        ("b_a~1", ("b", "a~b~3", "LINESTRING (10 0, 7 6)")),
        ("b_a~2", ("a~b~3", "a~b~2", "LINESTRING (7 6, 2 6)")),
        ("b_a~3", ("a~b~2", "a~b~1", "LINESTRING (2 6, 2 0)")),
        ("b_a~4", ("a~b~1", "a", "LINESTRING (2 0, 0 0)")),
    ]
    assert edges(bends.join(straight)) == edges(both())


def test_split_returns_straight_networks_unchanged() -> None:
    plain = network(("a_b", "a", "b", []), ("b_c", "b", "c", []))
    assert bends.split(plain)[0] is plain
    assert bends.join(plain) is plain
    nearly = network(("a_b", "a", "b", [(5.0, 0.04)]))
    assert bends.split(nearly) == (nearly, bends.Split())


def test_pieces_keep_properties_but_not_their_identity() -> None:
    properties = {"speed_limit": 1.5, "tmap2": {"edge_id": "old", "fail_policy": "retry"}}
    straight = part_of(bends.split(network(("e", "b", "a", [(5.0, 5.0)]), **properties))[0])
    rest = {"kind": "edge", "speed_limit": 1.5, "tmap2": {"fail_policy": "retry"}}
    assert straight.properties[-2:] == (
        {**rest, "source": "b", "target": "a~b~1"},
        {**rest, "source": "a~b~1", "target": "a"},
    )


def test_bend_names_stay_when_other_edges_are_closed() -> None:
    """A robot at a bend finds its node in a map without the other direction."""
    one_way = network(("b_a", "b", "a", DETOUR[2::-1]))
    nodes = {i for i, p in zip(part_of(one_way).ids, part_of(one_way).properties, strict=True) if p["kind"] == "node"}
    split = part_of(bends.split(one_way)[0])
    at = {i: g.wkt for i, g, p in zip(split.ids, split.geometry, split.properties, strict=True) if p["kind"] == "node"}
    assert {i: at[i] for i in at if i not in nodes} == {
        "a~b~1": "POINT (2 0)",
        "a~b~2": "POINT (2 6)",
        "a~b~3": "POINT (7 6)",
    }


def test_parallel_edges_get_nodes_of_their_own() -> None:
    layers = network(("north", "a", "b", [(5.0, 5.0)]), ("south", "a", "b", [(5.0, -5.0)]), ("loop", "c", "c", DETOUR))
    straight, count = bends.split(layers)
    assert count.nodes == 1 + 1 + 4
    assert len({(s, t) for s, t, _ in edges(straight).values()}) == len(edges(straight)) == 2 + 2 + 5
    assert edges(bends.join(straight)) == edges(layers)


def test_edges_without_both_nodes_in_network_stay_unsplit() -> None:
    lost = network(("a_b", "a", "b", [(5.0, 5.0)]))
    part = part_of(lost)
    incomplete = Layers({KEY: part.select([k for k, i in enumerate(part.ids) if i != "b"])})
    assert bends.split(incomplete)[0] is incomplete


def test_bends_on_earth_are_measured_in_metres() -> None:
    datum = Datum(53.2, -0.5)
    frame = Layers({}, datum).frame
    assert frame is not None
    local = part_of(both())
    earth = Features(local.ids, frame.geometries_to_wgs84(local.geometry), local.properties, ~local.local)
    straight = part_of(bends.split(Layers({KEY: earth}, datum))[0])
    assert not straight.local.any()
    index = straight.index()
    positions = shapely.get_coordinates(straight.select([index["a~b~2"]]).in_local(frame))
    assert positions == pytest.approx(np.array([[2.0, 6.0]]), abs=1e-6)
    assert edges(bends.split(Layers({KEY: earth}))[0]) == edges(Layers({KEY: straight})), "without a datum, too"


def test_edited_pieces_stay_pieces() -> None:
    straight = part_of(bends.split(both())[0])
    rows = straight.index()
    properties = list(straight.properties)
    properties[rows["a_b~2"]] = {**properties[rows["a_b~2"]], "speed_limit": 0.3}
    slower = Features(straight.ids, straight.geometry, tuple(properties), straight.local)
    assert bends.join(Layers({KEY: slower})).parts[KEY] is slower
    extra = features(
        [("x", shapely.LineString([(2, 6), AT["c"]]), {"kind": "edge", "source": "a~b~2", "target": "c"})], "local"
    )
    joined = Features(
        (*straight.ids, *extra.ids),
        np.concatenate([straight.geometry, extra.geometry]),
        (*straight.properties, *extra.properties),
        np.concatenate([straight.local, extra.local]),
    )
    assert bends.join(Layers({KEY: joined})).parts[KEY] is joined


def test_formats_with_straight_edges_are_listed() -> None:
    expected = ["ffr_network", "nav2_route", "navgraph", "openrmf", "prm", "rmf_nav_graph", "rmf_site"]
    expected += ["tmap", "tmap2"]
    assert expected == STRAIGHT


@pytest.mark.parametrize("name", STRAIGHT)
def test_written_edges_avoid_house(name: str) -> None:
    """Straight edges from node to node lead around the house, and an upload restores the bent edge."""
    fmt = formats.get_format(name)
    context = WriteContext()
    files = formats.write(fmt, both(), context)
    assert ("nodes at bends", 3) in [(t.subject, t.value) for t in context.template]
    assert fmt.read is not None
    reading = ReadContext(main=next(iter(files)), options=fmt.read_options())
    driven = fmt.read(files, reading)
    part = part_of(driven)
    at = {
        i: shapely.get_coordinates(g)[0] for i, g in zip(part.ids, part.geometry, strict=True) if g.geom_type == "Point"
    }
    lines = [shapely.LineString([at[p["source"]], at[p["target"]]]) for p in part.properties if p["kind"] == "edge"]
    assert len(lines) == 9 if name not in ("openrmf", "prm", "ffr_network") else len(lines) >= 9
    assert not shapely.intersects(lines, HOUSE).any()
    again = formats.read(FileGroup(fmt, next(iter(files)), files), ReadContext())
    assert formats.write(fmt, again, WriteContext()) == files


NAMED = [name for name in STRAIGHT if name != "prm" and formats.get_format(name).traits.keeps_bends == "nodes"]
"""Formats with node names, by which bends are recognised; prm has none."""


@pytest.mark.parametrize("name", NAMED)
def test_upload_of_written_map_restores_bends(name: str) -> None:
    fmt = formats.get_format(name)
    files = formats.write(fmt, both(), WriteContext())
    again = part_of(formats.read(FileGroup(fmt, next(iter(files)), files), ReadContext()))
    lines = [g for g, p in zip(again.geometry, again.properties, strict=True) if p["kind"] == "edge"]
    assert sorted(map(shapely.get_num_coordinates, lines)) == [2, 5, 5]
    assert len(again) == len(part_of(both()))
