"""A network as a grid: free along its edges."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from app import derive
from app.derive import DerivationNotes
from app.derive.topology_to_occupancy import Parameters, topology_to_occupancy
from app.errors import CannotConvert, MissingDatum, MissingLayer
from app.formats import ReadContext, group, read
from app.model.features import features
from app.model.frame import Datum
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from app.model.layers import MAP, NETWORK, SITE, Layers, PartKey

TOPOLOGY = PartKey("topology", "ground", NETWORK)
OBJECTS = PartKey("objects", "ground", "geojson")


def edge(i: str, line: list[tuple[float, float]], **more: Any) -> tuple[str, Any, dict[str, Any]]:
    return i, shapely.LineString(line), {"kind": "edge", "source": "a", "target": "b", **more}


def grid(layers: Layers, notes: DerivationNotes | None = None, **options: Any) -> OccupancyGrid:
    derived_layers = topology_to_occupancy(layers, Parameters(**options), notes or DerivationNotes())
    part = derived_layers.parts[PartKey("occupancy", "ground", MAP)]
    assert isinstance(part, OccupancyGrid)
    return part


def at(g: OccupancyGrid, x: float, y: float) -> int:
    return int(g.cells[int((y - g.origin[1]) / g.resolution), int((x - g.origin[0]) / g.resolution)])


def layers(*rows: Any, objects: Any = (), fence: Any = None) -> Layers:
    parts: dict[PartKey, Any] = {TOPOLOGY: features(rows, "local")}
    if objects:
        parts[OBJECTS] = features(objects, "local")
    if fence is not None:
        parts[PartKey("location", "ground", SITE)] = features([("fence", fence, {"kind": "fence"})], "local")
    return Layers(parts)


def test_free_space_is_as_wide_as_edges() -> None:
    notes = DerivationNotes()
    network = layers(edge("wide", [(0, 0), (10, 0)], width=4), edge("thin", [(10, 0), (10, 9)]))
    g = grid(network, notes, resolution=0.1)
    assert at(g, 5, 1.9) == at(g, 5, -1.9) == FREE
    assert at(g, 5, 2.2) == UNKNOWN
    assert at(g, 10.4, 6) == FREE
    assert at(g, 10.6, 6) == UNKNOWN
    assert g.counts()["free"] * 0.01 == pytest.approx(shapely.union_all([
        shapely.LineString([(0, 0), (10, 0)]).buffer(2), shapely.LineString([(10, 0), (10, 9)]).buffer(0.5)
    ]).area, rel=0.02)  # fmt: skip
    assert notes.template[0].why.startswith("1 edges state no width")
    assert at(grid(network, edge_width=3.0), 11.4, 6) == FREE
    assert at(grid(network, edge_width=3.0), 5, 2.2) == UNKNOWN, "an edge keeps its own width"


def test_edge_narrower_than_cell_has_no_gaps() -> None:
    g = grid(layers(edge("e", [(0, 0), (37, 23)], width=0.1)), resolution=1.0)
    import cv2

    count, _ = cv2.connectedComponents((g.cells == FREE).astype(np.uint8), connectivity=4)
    assert count == 2, "the background and one piece"


def test_objects_occupy_edges_except_in_passages() -> None:
    house = ("house", shapely.box(4, -3, 6, 3), {"kind": "building"})
    passage = {"osm": {"tags": {"tunnel": "building_passage"}}}
    blocked = grid(layers(edge("e", [(0, 0), (10, 0)], width=2), objects=[house]), resolution=0.1)
    assert at(blocked, 5, 0) == OCCUPIED
    assert at(blocked, 2, 0) == FREE
    free = grid(layers(edge("e", [(0, 0), (10, 0)], width=2, **passage), objects=[house]), resolution=0.1)
    assert at(free, 5, 0) == FREE
    # As far as the network reaches with its margin: x from -2, y from -2.
    assert at(free, 5, 1.5) == OCCUPIED
    without = grid(layers(edge("e", [(0, 0), (10, 0)], width=2), objects=[house]), obstacles=False, resolution=0.1)
    assert at(without, 5, 0) == FREE


def test_stairs_and_fences_limit_free_space() -> None:
    notes = DerivationNotes()
    both = layers(
        edge("way", [(0, 0), (10, 0)]), edge("steps", [(10, 0), (10, 10)], stairs=True), fence=shapely.box(-1, -5, 5, 5)
    )
    g = grid(both, notes, resolution=0.1)
    assert at(g, 3, 0) == FREE
    assert at(g, 7, 0) == UNKNOWN, "outside the fence"
    assert (notes.dropped[0].subject, notes.dropped[0].count) == ("edges over stairs", 1)
    assert g.height < 40
    only = layers(edge("steps", [(0, 0), (10, 10)], stairs=True))
    with pytest.raises(MissingLayer, match="stairs=true"):
        grid(only)
    assert at(grid(only, stairs=True), 5, 5) == FREE


def test_undrawable_networks_raise_missing_layer() -> None:
    with pytest.raises(MissingLayer, match="edges"):
        grid(layers(("a", shapely.Point(0, 0), {"kind": "node"})))
    earth = Layers({TOPOLOGY: features([edge("e", [(10, 52), (10.001, 52)])], "wgs84")})
    with pytest.raises(MissingDatum):
        grid(earth)
    assert at(grid(Layers(earth.parts, Datum(52.0, 10.0))), 30, 0) == FREE
    with pytest.raises(CannotConvert):
        grid(Layers(earth.parts, Datum(-52.0, 100.0)))
    with pytest.raises(CannotConvert):
        grid(layers(edge("e", [(-9e6, -9e6), (9e6, 9e6)])))
    odd = grid(layers(edge("e", [(0, 0), (9, 0)], width=-3), edge("f", [(0, 0), (0, 9)], width="x", osm=7)))
    assert at(odd, 4, 0.4) == FREE


def test_planner_derives_grid_from_bare_network() -> None:
    plan = derive.plan(frozenset({"topology"}), frozenset({"occupancy"}))
    assert plan is not None
    assert [s.name for s in plan.steps] == ["topology_to_occupancy"]
    plan = derive.plan(frozenset({"topology", "objects"}), frozenset({"occupancy"}))
    assert plan is not None
    assert [s.name for s in plan.steps] == ["objects_to_occupancy"]


@pytest.mark.parametrize("name", ["urban-netherlands-subburbs", "urban-usa-fl-miami-subberbs"])
def test_real_towns_have_free_roads_between_occupied_houses(name: str, shared: Path) -> None:
    data = (shared / "data/osm" / name / "osm.xml").read_bytes()
    osm_layers = read(group({"osm.xml": data})[0][0], ReadContext())
    network = osm_layers.parts[TOPOLOGY]
    west, south, _, _ = network.document["bounds"]  # type: ignore[union-attr]
    town = Layers(osm_layers.parts, Datum(south, west))
    g = grid(town)
    rows = [
        k
        for k, p in enumerate(network.properties)  # type: ignore[union-attr, arg-type]
        if p.get("kind") == "edge" and p["osm"]["tags"].get("highway") == "residential"
    ]
    lines = network.select(rows).in_local(town.frame)  # type: ignore[union-attr]
    middle = shapely.get_coordinates(shapely.line_interpolate_point(lines, 0.5, normalized=True))
    values = np.array([at(g, x, y) for x, y in middle])
    assert len(values) > 50
    assert (values == FREE).mean() > 0.995
    houses = osm_layers.parts[PartKey("objects", "ground", "osm")].select_kinds("building")  # type: ignore[union-attr]
    inner = shapely.get_coordinates(shapely.point_on_surface(houses.in_local(town.frame)))
    high = np.array(g.origin[:2]) + np.array([g.width, g.height]) * g.resolution
    inside = [(x, y) for x, y in inner if g.origin[0] <= x < high[0] and g.origin[1] <= y < high[1]]
    assert len(inside) > 100
    assert np.mean([at(g, x, y) == OCCUPIED for x, y in inside]) > 0.95
