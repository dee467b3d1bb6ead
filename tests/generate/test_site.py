"""Rules of all sites: grid, network, zones and image agree with one world."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import shapely

from app import formats
from app.derive import DerivationNotes
from app.derive.objects_to_occupancy import Parameters, objects_to_occupancy
from app.errors import CannotGenerate, Invalid
from app.formats import FileGroup, ReadContext, WriteContext
from app.generate import _reach, _shapes, _site
from app.generate._site import COLOURS, Site, SiteOptions
from app.generate._trees import crown_mesh
from app.model import solids
from app.model.features import Features, features
from app.model.frame import GROUND, Datum, Level
from app.model.geodesy import local_frame
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from app.model.imagery import GeoImage
from app.model.layers import Layers, PartKey

HERE = Datum(53.2686, -0.5245, heading=20.0)
GRID = PartKey("occupancy", GROUND, "map")


def yard(notes: DerivationNotes | None = None, given: Layers | None = None, **options: Any) -> Site:
    """Twenty by ten metres with a shed of 4 × 2 m in the middle of its upper half."""
    site = Site(given or Layers(), SiteOptions(**options), notes or DerivationNotes())
    site.set_fence(shapely.box(0, 0, 20, 10))
    site.box("shed", "building", (10, 7), (4, 2, 3), colour="roof", name="Shed")
    return site


def grid_of(layers: Layers) -> OccupancyGrid:
    grid = layers.parts[GRID]
    assert isinstance(grid, OccupancyGrid)
    return grid


def at(grid: OccupancyGrid, x: float, y: float) -> int:
    column, row = (int((v - o) / grid.resolution) for v, o in zip((x, y), grid.origin, strict=False))
    return int(grid.cells[row, column])


def test_grid_is_slice_of_written_world() -> None:
    site = yard()
    site.post("mast", "pole", (3, 3), 0.2, 4.0)
    site.box("bridge", "building", (17, 5), (1, 8, 0.5), base=2.0)
    layers = site.finish()
    grid = grid_of(layers)
    assert (grid.resolution, grid.width, grid.height) == (0.05, 400, 200)
    assert at(grid, 10, 7) == OCCUPIED
    assert at(grid, 3, 3) == OCCUPIED
    assert at(grid, 17, 5) == FREE, "the bridge is above the slice"
    assert grid.counts()["occupied"] == pytest.approx((8 + 0.04 * np.pi) / 0.05**2, rel=0.02)
    files = formats.write(formats.get_format("gazebo"), layers, WriteContext(title="yard"))
    assert b"walls_map" not in files["world.sdf"], "the objects are the walls"
    world = formats.read(FileGroup(formats.get_format("gazebo"), "world.sdf", files), ReadContext())
    fence = {k: p for k, p in layers.parts.items() if k.layer == "location"}
    again = objects_to_occupancy(
        Layers({**world.parts, **fence}, layers.datum), Parameters(height=0.2, resolution=0.05), DerivationNotes()
    )
    assert (grid_of(again).cells == grid.cells).mean() >= 0.99


def test_solids_outside_the_slice_are_skipped() -> None:
    upright = [0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    cylinder = {"type": "cylinder", "radius": 0.3, "length": 1.0, "pose": upright}
    for shape, low, high in (
        ({"type": "box", "size": [2.0, 2.0, 1.0], "pose": upright}, 0.5, 1.5),
        (cylinder, 0.5, 1.5),
        ({**cylinder, "type": "capsule"}, 0.2, 1.8),
        ({"type": "mesh", "file": "crown.stl", "scale": [0.5, 0.5, 0.8], "pose": upright}, 0.2, 1.8),
    ):
        reader = solids.Solids({"crown.stl": crown_mesh()})
        triangles = reader.triangles({"shapes": [shape]})
        assert triangles[:, :, 2].min() == pytest.approx(low, abs=0.15)
        assert all(_site._reaches(shape, z, reader, {}) for z in np.linspace(low, high, 9))
        assert not _site._reaches(shape, -1.0, reader, {})
        assert not _site._reaches(shape, 3.0, reader, {})
    assert _site._reaches({"type": "sphere", "radius": 1.0}, 99.0, solids.Solids({}), {}), "others are always read"


def test_free_space_is_one_piece_and_the_rest_is_noted() -> None:
    notes = DerivationNotes()
    site = yard(notes)
    for k, (x, y, w, h) in enumerate(((3, 2, 2, 0.2), (3, 4, 2, 0.2), (2, 3, 0.2, 2.2), (4, 3, 0.2, 2.2))):
        site.box(f"wall{k}", "wall", (x, y), (w, h, 1))
    grid = grid_of(site.finish())
    assert at(grid, 3, 3) == UNKNOWN
    assert at(grid, 1, 3) == FREE
    (entry,) = notes.dropped
    assert entry.subject == "free cells"
    assert entry.count == pytest.approx(1.8 * 1.8 / 0.05**2, rel=0.05)
    cells, closed = _reach.keep_largest_space(np.zeros((3, 3), np.uint8))
    assert (closed, cells.tolist()) == (0, [[0] * 3] * 3)


def test_edges_have_width_and_avoid_obstacles() -> None:
    site = yard()
    for name, place in (("a", (3, 2)), ("b", (17, 2)), ("c", (17, 7))):
        site.node(name, place)
    site.add_edges("a", "b", speed=1.0)
    site.add_edges("b", "c", action="row_change")
    network = site.finish().vector("topology")[PartKey("topology", GROUND, "network")]
    edge = network.properties[network.index()["a_b"]]
    assert edge["width"] == 4.0, "2 m to the fence below, 4 m to the shed"
    assert (edge["source"], edge["target"], edge["action"], edge["speed_limit"]) == ("a", "b", "move_base", 1.0)
    assert network.properties[network.index()["c_b"]]["width"] == 4.0, "its end is the nearest to the fence"
    site = yard()
    for name, place in (("a", (1, 7)), ("b", (19, 7))):
        site.node(name, place)
    site.add_edges("a", "b")
    with pytest.raises(RuntimeError, match=r"the edge a_b is nearer to an obstacle than 0\.3 m"):
        site.finish()
    site = yard()
    site.node("a", (10, 5.8))
    with pytest.raises(RuntimeError, match="a node is nearer"):
        site.finish()


def test_passable_is_the_grid_inflated_by_the_radius() -> None:
    cells = np.zeros((40, 40), np.uint8)
    cells[20, 20] = OCCUPIED
    grid = OccupancyGrid(cells, 0.1)
    line = [shapely.LineString([(0.5, y), (3.5, y)]) for y in (2.05, 2.31, 2.41, 3.8, 4.2)]
    assert _reach.passable(grid, line, 0.3).tolist() == [False, False, True, False, False]
    assert _reach.passable(grid, line, 0.19).tolist() == [False, True, True, True, False]
    point = [shapely.Point(2.05, 2.31), shapely.Point(1.0, 1.0)]
    assert _reach.passable(grid, point, 0.3).tolist() == [False, True]
    assert _reach.clearance(grid, line[:3]).tolist() == [0.0, 0.42, 0.62]
    assert _reach.clearance(grid, []).tolist() == []


def test_undrivable_edges_raise_runtime_error() -> None:
    site = yard()
    for name, place in (("a", (1, 2)), ("b", (5, 2)), ("c", (9, 2))):
        site.node(name, place)
    site.add_edges("a", "b")
    with pytest.raises(RuntimeError, match="no path to 1 of the nodes, such as c"):
        site.finish()
    site.add_edges("b", "c", both=False)
    with pytest.raises(RuntimeError, match="no path from 1 of the nodes, such as c"):
        site.finish()
    site.add_edges("c", "b", both=False)
    site.finish()
    site.zone("wet", "keepout", shapely.box(6, 1, 7, 3))
    with pytest.raises(RuntimeError, match="through a keep-out zone"):
        site.finish()
    with pytest.raises(ValueError, match="duplicate node name"):
        site.node("a", (1, 1))
    with pytest.raises(ValueError, match="duplicate edge id"):
        site.add_edges("a", "b")


def test_site_uses_fence_and_datum_of_environment() -> None:
    ring = local_frame(HERE).geometries_to_wgs84(
        np.array([shapely.box(-30, -30, -28, -29), shapely.box(0, 0, 30, 12)], object)
    )
    fence = features([("small", ring[0], {"kind": "fence"}), ("big", ring[1], {"kind": "fence"})], "wgs84")
    key = PartKey("location", GROUND, "site")
    notes = DerivationNotes()
    given = Layers({key: fence}, HERE)
    site = yard(notes, given)
    assert site.is_given
    assert site.fence.bounds == pytest.approx((0, 0, 30, 12), abs=1e-6)
    layers = site.finish()
    assert layers.datum == HERE
    assert layers.parts[key] is fence, "passed on as it was given"
    assert at(grid_of(layers), 29, 11) == FREE
    assert [d.subject for d in notes.dropped] == ["polygons of the fence"]
    assert notes.template == []
    with pytest.raises(Invalid, match="already has a datum"):
        yard(given=given, datum=(52.0, 5.0))
    notes = DerivationNotes()
    assert yard(notes).finish().datum == _site.DATUM
    assert [t.subject for t in notes.template] == ["datum"]
    assert yard(datum=(52.0, 5.0)).finish().datum == Datum(52.0, 5.0)
    default_fence = yard().finish().parts[key]
    assert isinstance(default_fence, Features)
    assert default_fence.properties[0] == {"kind": "fence"}


def test_site_sizes_are_checked_before_work() -> None:
    site = Site(Layers(), SiteOptions(resolution=0.01), DerivationNotes())
    with pytest.raises(CannotGenerate, match="resolution: 100 × 100 m on 1 levels would be more than"):
        site.set_fence(shapely.box(0, 0, 100, 100))
    site = Site(Layers(), SiteOptions(), DerivationNotes())
    with pytest.raises(CannotGenerate, match="coarser"):
        site.set_fence(shapely.box(0, 0, 1e6, 1e6))
    notes = DerivationNotes()
    site = Site(Layers(), SiteOptions(datum=(52.0, 5.0)), notes)
    site.set_fence(shapely.box(0, 0, 300, 200))
    site.box("shed", "building", (10, 10), (4, 4, 3))
    assert grid_of(site.finish()).resolution == 0.2
    assert [t.subject for t in notes.template] == ["resolution"]
    site = Site(Layers(), SiteOptions(height=2.9), DerivationNotes())
    site.set_fence(shapely.box(0, 0, 20, 10))
    site.box("kerb", "wall", (10, 7), (4, 2, 1))
    with pytest.raises(CannotGenerate, match="no stored object is an obstacle at 2"):
        site.finish()


def test_image_shows_objects_at_their_positions() -> None:
    site = yard()
    site.draw(shapely.box(0, 0, 20, 3), "path")
    site.post("tree", "tree", (4, 6), 0.2, 4.0, colour="crown", seen=_shapes.disc(4, 6, 1.5))
    layers = site.finish(ground="meadow")
    picture = layers.parts[PartKey("imagery", GROUND, "satellite")]
    assert isinstance(picture, GeoImage)
    a, b, left, d, e, top = picture.transform
    assert (a, b, left, d, e, top) == (0.05, 0.0, 0.0, 0.0, -0.05, 10.0)
    for x, y, colour in ((10, 7, "roof"), (4, 6, "crown"), (4, 7.3, "crown"), (10, 1, "path"), (1, 9, "meadow")):
        assert tuple(picture.pixels[int((top - y) / 0.05), int(x / 0.05)]) == COLOURS[colour], (x, y)
    grid = grid_of(layers)
    assert at(grid, 4, 7.3) == FREE, "below the crown"


def test_each_level_has_its_own_grid_and_image() -> None:
    levels = (Level(), Level("L2", 4.0))
    site = Site(Layers(), SiteOptions(), DerivationNotes(), levels=levels)
    site.set_fence(shapely.box(0, 0, 20, 10))
    site.box("desk", "furniture", (5, 5), (2, 1, 0.8))
    site.box("desk2", "furniture", (15, 5), (2, 1, 0.8), level="L2")
    site.node("lift", (2, 2))
    site.node("lift2", (2, 2), level="L2")
    site.add_edges("lift", "lift2", action="lift")
    layers = site.finish(ground="floor")
    for level, x in (("ground", 5), ("L2", 15)):
        grid = layers.parts[PartKey("occupancy", level, "map")]
        assert isinstance(grid, OccupancyGrid)
        assert at(grid, x, 5) == OCCUPIED
        assert at(grid, 20 - x, 5) == FREE
        assert PartKey("imagery", level, "satellite") in layers.parts
        assert len(layers.vector("topology", level)) == 1
    lifted = layers.vector("objects", "L2")[PartKey("objects", "L2", _site.NAME)]
    assert lifted.properties[0]["pose"][2] == 4.0
    up = layers.vector("topology", GROUND)[PartKey("topology", GROUND, "network")]
    assert "width" not in up.properties[up.index()["lift_lift2"]]
