"""Rows in pictures and grids, and the network of their aisles: drawn rows with known truth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import pytest
import shapely
from numpy.typing import NDArray

from app.derive import DerivationNotes, all_derivations, run
from app.derive._rows import find_fields
from app.errors import CannotConvert, CannotDerive, MissingLayer
from app.model.aisles import stop_positions
from app.model.features import Features, features
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from app.model.imagery import GeoImage
from app.model.layers import MAP, Layers, Part, PartKey
from tests.derive.pictures import local

SIZE = 0.1


def lines(yaw: float, count: int = 5, spacing: float = 2.5, length: float = 16.0, step: float = 0.0) -> list[Any]:
    """Return rows around (12, 12), as lines or, with a step, as points."""
    c, s = math.cos(yaw), math.sin(yaw)
    out = []
    for k in range(count):
        v = (k - (count - 1) / 2) * spacing
        ends = [(12 + c * u - s * v, 12 + s * u + c * v) for u in (-length / 2, length / 2)]
        line = shapely.LineString(ends)
        out.append(line if not step else shapely.MultiPoint([line.interpolate(d) for d in np.arange(0, length, step)]))
    return out


def drawn(rows: list[Any], radius: float = 0.15) -> NDArray[np.bool_]:
    """Draw rows on 24 × 24 m, row 0 at the bottom."""
    ys, xs = np.indices((240, 240))
    where = shapely.points((xs.ravel() + 0.5) * SIZE, (ys.ravel() + 0.5) * SIZE)
    shape = shapely.union_all(rows).buffer(radius)
    shapely.prepare(shape)
    return np.asarray(shapely.contains(shape, where)).reshape(240, 240)


def grid(mask: NDArray[np.bool_]) -> Layers:
    cells = np.where(mask, OCCUPIED, FREE).astype(np.uint8)
    return Layers({PartKey("occupancy", "ground", MAP): OccupancyGrid(cells, SIZE)})


def derived(name: str, layers: Layers) -> Layers:
    return run([all_derivations()[name].step()], layers, DerivationNotes())


def of(layers: Layers, layer: str, kind: str) -> list[tuple[Any, Any]]:
    (part,) = layers.vector(layer).values()  # type: ignore[arg-type]
    return [(g, p) for g, p in zip(part.geometry, part.properties, strict=True) if p["kind"] == kind]


@pytest.mark.parametrize(("yaw", "step"), [(0.0, 0.0), (0.35, 0.0), (1.9, 3.0)])
def test_rows_of_lines_and_posts_are_found_in_grid(yaw: float, step: float) -> None:
    rows = lines(yaw, step=step)
    found = of(derived("occupancy_to_rows", grid(drawn(rows))), "objects", "row")
    assert len(found) == 5
    for line in lines(yaw):
        assert min(line.interpolate(0.5, normalized=True).distance(g) for g, _ in found) < 0.15
    assert all(p["row_spacing"] == pytest.approx(2.5, abs=0.05) for _, p in found)
    turn = (np.array([p["direction"] for _, p in found]) - math.degrees(yaw) + 90) % 180 - 90
    assert np.abs(turn).max() < 1.0
    assert all(0.5 <= p["confidence"] < 1.0 for _, p in found)


def test_bent_rows_are_found_and_network_follows_them() -> None:
    def bend(xy: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.column_stack([xy[:, 0], xy[:, 1] + 0.005 * (xy[:, 0] - 12) ** 2])

    rows = [shapely.transform(shapely.segmentize(line, 0.5), bend) for line in lines(0.0, spacing=2.0, length=20.0)]
    site = derived("occupancy_to_rows", grid(drawn(rows, 0.1)))
    found = [g for g, _ in of(site, "objects", "row")]
    assert len(found) == 5
    assert max(max(shapely.hausdorff_distance(line, g) for line in rows if line.distance(g) < 0.3) for g in found) < 0.5
    edges = [g for g, p in of(derived("rows_to_topology", site), "topology", "edge") if p["action"] == "row_traversal"]
    assert edges
    assert min(shapely.union_all(rows).distance(g) for g in edges) > 0.7


def test_aisle_across_divides_rows() -> None:
    mask = drawn(lines(0.0, spacing=2.5, length=20.0))
    mask[:, 105:135] = False
    ends = [g.bounds for g, _ in of(derived("occupancy_to_rows", grid(mask)), "objects", "row")]
    assert len(ends) == 10
    assert all(high < 10.6 or low > 13.4 for low, _, high, _ in ends)


@pytest.mark.parametrize(("rows_beyond", "found"), [((0, 1, 2, 3, 4, 5), 12), ((0, 2, 5), 6)])
def test_beyond_an_aisle_only_lines_at_the_distances_of_the_rows_are_rows(
    rows_beyond: tuple[int, ...], found: int
) -> None:
    rows = lines(0.0, count=6, spacing=2.5, length=24.0)
    mask = drawn(rows)
    mask[:, 135:172] = False
    for k, row in enumerate(rows):
        if k not in rows_beyond:
            y = round(row.centroid.y / SIZE)
            mask[y - 10 : y + 10, 135:] = False
    assert len(of(derived("occupancy_to_rows", grid(mask)), "objects", "row")) == found


def test_rows_in_beds_are_found_and_not_the_beds() -> None:
    beds = [
        shapely.transform(row, lambda xy, v=v: xy + np.array([0.0, v])) for row in lines(0.0, 6) for v in (-0.25, 0.25)
    ]
    found = of(derived("occupancy_to_rows", grid(drawn(beds, 0.1))), "objects", "row")
    assert len(found) == 12


def test_edge_of_meadow_is_no_row() -> None:
    image = np.full((240, 240, 3), (190, 170, 140), np.uint8)
    image[:35] = image[-35:] = (90, 120, 60)
    for line in lines(0.0, count=4, spacing=4.0):
        y = 240 - round(line.centroid.y / SIZE)
        image[y - 4 : y + 4, 40:200] = (90, 120, 60)
    site = derived("imagery_to_rows", Layers({PartKey("imagery", "ground", "satellite"): local(image)}))
    assert len(of(site, "objects", "row")) == 4


def test_walls_of_a_room_are_no_rows() -> None:
    room = [shapely.box(3, 3, 20, 15).exterior, shapely.LineString([(9, 3), (9, 15)])]
    with pytest.raises(CannotDerive, match="no parallel rows"):
        derived("occupancy_to_rows", grid(drawn(room)))
    assert find_fields(np.zeros((50, 50), bool), 0.1, 0.0, 0.0) == []


def test_scattered_cells_and_full_ground_are_no_rows() -> None:
    noise = np.random.default_rng(0).random((400, 400))
    for mask in (noise < 0.02, noise < 0.2, np.ones((100, 100), bool)):
        assert find_fields(mask, 0.05, 0.0, 0.0) == []


def test_strange_input_gives_clear_problem() -> None:
    unknown = OccupancyGrid(np.full((50, 50), UNKNOWN, np.uint8), SIZE)
    with pytest.raises(CannotDerive, match="no parallel rows"):
        derived("occupancy_to_rows", Layers({PartKey("occupancy", "ground", MAP): unknown}))
    for pixels in (np.full((1, 1, 3), 7, np.uint8), np.full((60, 60, 1), 120, np.uint8)):
        with pytest.raises(CannotDerive, match="no parallel rows"):
            derived("imagery_to_rows", Layers({PartKey("imagery", "ground", "satellite"): local(pixels)}))
    long = [(f"r{k}", shapely.LineString([(0, k * 2), (9e5, k * 2)]), {"kind": "row"}) for k in range(2)]
    with pytest.raises(CannotDerive, match="more than 200000 nodes"):
        derived("rows_to_topology", Layers({PartKey("objects", "ground", "drawn"): features(long, "local")}))
    odd = [shapely.Point(1, 1), shapely.LineString(), shapely.LineString([(0, 0, 1), (9, 0, 2)])]
    rows = [(f"r{k}", g, {"kind": "row", "field": [], "row_width": "wide"}) for k, g in enumerate(odd)]
    with pytest.raises(CannotDerive, match="no two rows are parallel"):
        derived("rows_to_topology", Layers({PartKey("objects", "ground", "drawn"): features(rows, "local")}))


def test_network_of_aisles_follows_rows() -> None:
    site = derived("rows_to_topology", derived("occupancy_to_rows", grid(drawn(lines(0.0)))))
    nodes = {p["name"]: g for g, p in of(site, "topology", "node")}
    assert {name.split("-")[0] for name in nodes} == {"r1.5", "r2.5", "r3.5", "r4.5"}
    for number, y in enumerate((8.25, 10.75, 13.25, 15.75), 1):
        assert all(abs(g.y - y) < 0.3 for name, g in nodes.items() if name.startswith(f"r{number}.5"))
    assert nodes["r1.5-ca"].x == pytest.approx(4 - 2.25, abs=0.3)
    assert nodes["r1.5-cz"].x == pytest.approx(20 + 2.25, abs=0.3)
    edges = of(site, "topology", "edge")
    assert {p["action"] for _, p in edges} == {"row_traversal", "row_change"}
    assert sum(p["action"] == "row_change" for _, p in edges) == 2 * 2 * 3
    ends = {(p["source"], p["target"]) for _, p in edges}
    assert ends == {(b, a) for a, b in ends}
    rows = shapely.union_all([g for g, _ in of(site, "objects", "row")])
    assert min(rows.distance(g) for g, _ in edges) > 0.6


def test_edges_through_occupied_cells_are_left_out() -> None:
    mask = drawn(lines(0.0))
    mask[120:130, 15:20] = True  # a box in the headland before the third aisle
    notes = DerivationNotes()
    rows = derived("occupancy_to_rows", grid(drawn(lines(0.0))))
    blocked = Layers({**rows.parts, **grid(mask).parts})
    site = run([all_derivations()["rows_to_topology"].step()], blocked, notes)
    assert any(d.subject == "edges" and d.count > 0 for d in notes.dropped)
    box = shapely.box(1.5, 12.0, 2.0, 13.0)
    assert min(g.distance(box) for g, _ in of(site, "topology", "edge")) > 0.2


def test_cells_above_the_threshold_of_their_grid_are_obstacles_and_plants() -> None:
    """In a grid of mode scale, 80 and 90 of 100 are occupied from 0.65 on, as for all other derivations."""
    mask = drawn(lines(0.0))
    plants = OccupancyGrid(np.where(mask, 90, FREE).astype(np.uint8), SIZE, mode="scale")
    rows = derived("occupancy_to_rows", Layers({PartKey("occupancy", "ground", MAP): plants}))
    assert len(of(rows, "objects", "row")) == 5
    for value, blocked in ((80, True), (60, False)):
        cells = np.where(mask, 90, FREE).astype(np.uint8)
        cells[120:130, 15:20] = value
        box = OccupancyGrid(cells, SIZE, mode="scale")
        notes = DerivationNotes()
        site = Layers({**rows.parts, PartKey("occupancy", "ground", MAP): box})
        run([all_derivations()["rows_to_topology"].step()], site, notes)
        assert any(d.subject == "edges" for d in notes.dropped) == blocked


def test_drawn_rows_give_network_and_narrow_ones_none() -> None:
    def site(kind: str, spacing: float) -> Layers:
        rows = [(f"r{k}", line, {"kind": kind}) for k, line in enumerate(lines(0.3, spacing=spacing))]
        parts: dict[PartKey, Part] = {PartKey("objects", "ground", "drawn"): features(rows, "local")}
        return Layers(parts)

    assert len(of(derived("rows_to_topology", site("tree_row", 3.0)), "topology", "node")) > 8
    with pytest.raises(CannotDerive, match="fits between no two rows"):
        derived("rows_to_topology", site("row", 0.5))
    with pytest.raises(CannotDerive, match="have no rows"):
        derived("rows_to_topology", site("wall", 3.0))
    assert issubclass(MissingLayer, CannotConvert)


@pytest.mark.parametrize("anchor", ["local", "EPSG:4326"])
def test_rows_of_trees_are_found_in_picture(anchor: str) -> None:
    image = np.full((240, 240, 3), (120, 150, 90), np.uint8)
    for row in lines(0.2, count=4, spacing=4.0, step=1.8):
        for point in row.geoms:
            cv2.circle(image, (round(point.x / SIZE), 240 - round(point.y / SIZE)), 7, (45, 80, 40), -1)
    shaken = np.random.default_rng(2).normal(0, 4, image.shape)
    image = np.clip(image + shaken, 0, 255).astype(np.uint8)
    picture = local(image)
    if anchor != "local":
        picture = GeoImage(image, (1.5e-6, 0.0, 0.5, 0.0, -0.9e-6, 53.0), anchor)
    site = derived("imagery_to_rows", Layers({PartKey("imagery", "ground", "satellite"): picture}))
    (part,) = site.vector("objects").values()
    assert isinstance(part, Features)
    assert len(of(site, "objects", "row")) == 4
    assert len(of(site, "objects", "headland")) == 2
    assert bool(part.local.all()) == (anchor == "local")


def test_picture_without_rows_raises() -> None:
    noise = np.random.default_rng(1).integers(90, 110, (200, 200, 3)).astype(np.uint8)
    with pytest.raises(CannotDerive, match="no parallel rows"):
        derived("imagery_to_rows", Layers({PartKey("imagery", "ground", "satellite"): local(noise)}))


def test_stop_positions_name_the_nodes_of_an_aisle() -> None:
    assert stop_positions(0.0, 14.0, 2.0, 5.0) == [("ca", 0.0), ("cb", 2.0), ("c0", 7.0), ("cy", 12.0), ("cz", 14.0)]


def test_rows_of_a_rotated_grid_are_where_they_are() -> None:
    yaw, corner = 0.6, (100.0, -40.0)
    cells = np.where(drawn(lines(0.2)), OCCUPIED, FREE).astype(np.uint8)
    turned = OccupancyGrid(cells, SIZE, (*corner, yaw))
    site = derived("occupancy_to_rows", Layers({PartKey("occupancy", "ground", MAP): turned}))
    rows = [g for g, _ in of(site, "objects", "row")]
    assert len(rows) == 5
    for line in lines(0.2):
        moved = shapely.affinity.translate(shapely.affinity.rotate(line, yaw, origin=(0, 0), use_radians=True), *corner)
        assert min(moved.interpolate(0.5, normalized=True).distance(row) for row in rows) < 0.15


def test_cells_that_show_no_row_are_refused_at_once() -> None:
    cells = np.where(np.indices((300, 300))[0] % 3 == 0, OCCUPIED, FREE).astype(np.uint8)
    coarse = OccupancyGrid(cells, 100.0)
    with pytest.raises(CannotDerive, match="cells of 100 m, too coarse for rows"):
        derived("occupancy_to_rows", Layers({PartKey("occupancy", "ground", MAP): coarse}))
    long = np.zeros((1, 200_000), bool)
    long[0, ::7] = True
    assert find_fields(long, 0.05, 0.0, 0.0) == []


def test_single_row_has_no_network() -> None:
    row = features([("r1", shapely.LineString([(0, 0), (9, 0)]), {"kind": "row"})], "local")
    with pytest.raises(CannotDerive, match="no two rows are parallel"):
        derived("rows_to_topology", Layers({PartKey("objects", "ground", "drawn"): row}))


@pytest.mark.parametrize("thick", [1, 2])
def test_rows_one_cell_thick_are_found(thick: int) -> None:
    mask = np.zeros((150, 200), bool)
    for k in range(5):
        mask[20 + 25 * k : 20 + 25 * k + thick, 20:180] = True
    (field,) = find_fields(mask, 0.1, 0.0, 0.0)
    assert [row.v for row in field.rows] == pytest.approx([2.0 + 2.5 * k + 0.05 * thick for k in range(5)], abs=0.1)


def test_fields_end_to_end_each_have_their_aisles() -> None:
    """Two blocks of four rows, 3 m apart, with 10 m between their ends: each has three aisles."""
    ends = ((0, 30), (40, 70))
    rows = [(f"r{a}-{v}", shapely.LineString([(a, v), (b, v)]), {"kind": "row"}) for v in (0, 3, 6, 9) for a, b in ends]
    network = derived("rows_to_topology", Layers({PartKey("objects", "ground", "drawn"): features(rows, "local")}))
    nodes = {p["name"]: g for g, p in of(network, "topology", "node")}
    aisles = {name.split("-c")[0] for name in nodes}
    assert aisles == {f"f{field}-r{number}.5" for field in (1, 2) for number in (1, 2, 3)}
    assert all((g.x < 35) == name.startswith("f1-") for name, g in nodes.items())
    lines_of_rows = shapely.union_all([line for _, line, _ in rows])
    assert not any(
        g.crosses(lines_of_rows) for g, p in of(network, "topology", "edge") if p["action"] == "row_traversal"
    )


def test_row_in_two_pieces_divides_no_field() -> None:
    """The aisles on both sides of it stay connected, whether its pieces are two lines or one geometry."""
    pieces = [[(0, 3), (14, 3)], [(16, 3), (30, 3)]]
    full = [[(0, v), (30, v)] for v in (0, 6)]
    for middle in ([shapely.LineString(piece) for piece in pieces], [shapely.MultiLineString(pieces)]):
        drawings = [*map(shapely.LineString, full), *middle]
        rows = [(f"r{k}", line, {"kind": "row"}) for k, line in enumerate(drawings)]
        notes = DerivationNotes()
        site = Layers({PartKey("objects", "ground", "drawn"): features(rows, "local")})
        network = run([all_derivations()["rows_to_topology"].step()], site, notes)
        assert {g.y for g, _ in of(network, "topology", "node")} == {1.5, 4.5}
        assert sum(p["action"] == "row_change" for _, p in of(network, "topology", "edge")) == 4
        assert not notes.dropped


@pytest.mark.parametrize("gaps", [(1, 2), (2, 3), (0, 1), (1, 2, 3), (4, 5), range(6)])
def test_neighbouring_rows_with_a_gap_at_the_same_place_divide_no_field(gaps: Sequence[int]) -> None:
    """Six rows 3 m apart: all five aisles are connected, and no edge crosses a row."""
    spans = {v: ((0, 14), (16, 30)) if v in gaps else ((0, 30),) for v in range(6)}
    drawings = [shapely.LineString([(a, 3 * v), (b, 3 * v)]) for v, pieces in spans.items() for a, b in pieces]
    rows = [(f"r{k}", line, {"kind": "row"}) for k, line in enumerate(drawings)]
    notes = DerivationNotes()
    site = Layers({PartKey("objects", "ground", "drawn"): features(rows, "local")})
    network = run([all_derivations()["rows_to_topology"].step()], site, notes)
    edges = of(network, "topology", "edge")
    reached = {edges[0][1]["source"]}
    for _ in edges:
        reached |= {p["target"] for _, p in edges if p["source"] in reached}
    assert reached == {p["name"] for _, p in of(network, "topology", "node")}
    assert {g.y for g, _ in of(network, "topology", "node")} == {1.5, 4.5, 7.5, 10.5, 13.5}
    assert not any(g.intersects(shapely.union_all(drawings)) for g, _ in edges)
    assert not notes.dropped
    assert not notes.warnings


def test_fields_with_a_row_beside_both_that_are_not_connected_are_reported() -> None:
    """A hedge lies beside two fields end to end, whose rows are not on the same lines."""
    ends = [(0, 0, 70), *((v, 0, 30) for v in (3, 6, 9)), *((v, 40, 70) for v in (4.5, 7.5, 10.5))]
    rows = [(f"r{k}", shapely.LineString([(a, v), (b, v)]), {"kind": "row"}) for k, (v, a, b) in enumerate(ends)]
    notes = DerivationNotes()
    site = Layers({PartKey("objects", "ground", "drawn"): features(rows, "local")})
    network = run([all_derivations()["rows_to_topology"].step()], site, notes)
    assert {g.y for g, _ in of(network, "topology", "node")} == {1.5, 4.5, 7.5, 6.0, 9.0}
    assert len(notes.warnings) == 1
    assert "not connected" in str(notes.warnings[0])


def test_fields_beside_one_hedge_that_are_far_apart_stay_fields() -> None:
    """The rows of both are on the same lines, but what lies between them is no gap in a row."""
    ends = [(0, 0, 560), *((v, a, a + 80) for v in (4, 8, 12) for a in (0, 480))]
    rows = [(f"r{k}", shapely.LineString([(a, v), (b, v)]), {"kind": "row"}) for k, (v, a, b) in enumerate(ends)]
    network = derived("rows_to_topology", Layers({PartKey("objects", "ground", "drawn"): features(rows, "local")}))
    aisles = [g for g, p in of(network, "topology", "edge") if p["action"] == "row_traversal" and g.bounds[1] > 3]
    between = shapely.box(90, 3, 470, 20)
    assert aisles
    assert not any(g.intersects(between) for g in aisles)
    assert {name.split("-")[0] for name in (p["name"] for _, p in of(network, "topology", "node"))} == {"f1", "f2"}


def test_rows_and_aisles_without_a_way_are_reported() -> None:
    spans = {"a": (0, 0, 30), "b": (0.5, 0, 30), "c": (3, 40, 70), "d": (6, 0, 30)}
    rows = [(name, shapely.LineString([(a, v), (b, v)]), {"kind": "row"}) for name, (v, a, b) in spans.items()]
    notes = DerivationNotes()
    site = Layers({PartKey("objects", "ground", "drawn"): features(rows, "local")})
    network = run([all_derivations()["rows_to_topology"].step()], site, notes)
    assert {g.y for g, _ in of(network, "topology", "node")} == {3.25}
    assert {(d.subject, d.count) for d in notes.dropped} == {("rows", 1), ("aisles", 1)}
