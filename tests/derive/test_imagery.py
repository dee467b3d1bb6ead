"""Objects and grids from images: drawn images with known content, and plans of real buildings."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import shapely

from app import derive, upload_reader
from app.derive import DerivationNotes, run
from app.derive.imagery_to_objects import Parameters as ObjectParameters
from app.derive.imagery_to_objects import imagery_to_objects
from app.derive.imagery_to_occupancy import Parameters, imagery_to_occupancy
from app.derive.objects_to_occupancy import Parameters as Rasterised
from app.derive.objects_to_occupancy import objects_to_occupancy
from app.derive.resources_to_imagery import Parameters as Drawings
from app.derive.resources_to_imagery import resources_to_imagery
from app.errors import Ambiguous, CannotConvert, Invalid, MissingDatum, MissingLayer, NotFound
from app.limits import Limits
from app.model import geodesy
from app.model.features import Features, features
from app.model.frame import Datum
from app.model.geodesy import local_frame
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from app.model.imagery import GeoImage
from app.model.layers import MAP, Layers, PartKey, Resources
from app.upload_reader import EnvironmentContext, UploadHints
from tests.derive.pictures import BRANCH, BUILDING, CROWN, HEIGHT, PATH, PATH_WIDTH, SIZE, TREES, farm, local, plan

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
DATUM = Datum(53.0, -0.5)


def layers(picture: GeoImage, *, name: str = "satellite", datum: Datum | None = None, **more: GeoImage) -> Layers:
    images = {PartKey("imagery", "ground", n): p for n, p in {name: picture, **more}.items()}
    return Layers(dict(images), datum)


def objects(content: Layers, notes: DerivationNotes | None = None, **options: Any) -> Features:
    derived_layers = imagery_to_objects(
        content, ObjectParameters(**options), notes if notes is not None else DerivationNotes()
    )
    (part,) = derived_layers.parts.values()
    assert isinstance(part, Features)
    return part


def grid(content: Layers, notes: DerivationNotes | None = None, level: str = "ground", **options: Any) -> OccupancyGrid:
    derived_layers = imagery_to_occupancy(
        content, Parameters(**options), notes if notes is not None else DerivationNotes()
    )
    part = derived_layers.parts[PartKey("occupancy", level, MAP)]
    assert isinstance(part, OccupancyGrid)
    return part


def at(g: OccupancyGrid, x: float, y: float) -> int:
    return int(g.cells[int((y - g.origin[1]) // g.resolution), int((x - g.origin[0]) // g.resolution)])


def of(part: Features, kind: str) -> list[Any]:
    return [f.geometry for f in part if f.properties["kind"] == kind]


def overlap(a: Any, b: Any) -> float:
    """Intersection over union."""
    return float(shapely.intersection(a, b).area / shapely.union(a, b).area)


@pytest.mark.parametrize("offset", [-30.0, -10.0])
def test_image_on_the_antimeridian_needs_no_datum(offset: float) -> None:
    """Its middle is there, not at the mean of longitudes of both signs. offset: of its left side, in metres."""
    pixels = farm()
    easting, northing = geodesy.between("EPSG:4326", "EPSG:32760", np.array([[180.0, -16.8]]))[0].tolist()
    picture = GeoImage(pixels, (SIZE, 0.0, easting + offset, 0.0, -SIZE, northing + HEIGHT / 2), "EPSG:32760")
    trees = of(objects(layers(picture)), "tree")
    assert len(trees) == len(TREES)
    placed = geodesy.geometries_from_wgs84("EPSG:32760", np.array([tree.centroid for tree in trees], object))
    for x, y in TREES:
        at_place = shapely.Point(easting + offset + x, northing - HEIGHT / 2 + y)
        assert min(at_place.distance(tree) for tree in placed) < 0.5


def test_farm_image_gives_objects_of_each_kind() -> None:
    notes = DerivationNotes()
    part = objects(layers(local(farm())), notes)
    assert part.local.all()
    trees = of(part, "tree")
    assert len(trees) == len(TREES)
    for x, y in TREES:
        crown = shapely.Point(x, y).buffer(CROWN)
        assert max(overlap(tree, crown) for tree in trees) > 0.85
    (house,) = of(part, "building")
    assert overlap(house, shapely.box(*BUILDING)) > 0.93
    paths = [shapely.LineString(line).buffer(PATH_WIDTH / 2, cap_style="flat") for line in (PATH, BRANCH)]
    paved = [g for g in of(part, "path") if g.geom_type != "LineString"]
    assert overlap(shapely.union_all(paved), shapely.union_all(paths)) > 0.9
    fields = shapely.union_all(of(part, "field"))
    grass = shapely.box(0, 0, 60, 40).difference(shapely.union_all([*paths, house, *trees]))
    assert overlap(fields, grass) > 0.93
    assert not of(part, "vegetation")
    confidences = [f.properties["confidence"] for f in part if "confidence" in f.properties]
    assert all(0.5 < c <= 1 for c in confidences)
    assert len(confidences) == Counter(f.geometry.geom_type for f in part)["Polygon"]
    assert any("detected automatically" in w.problem for w in notes.warnings)


def test_centrelines_give_network() -> None:
    part = objects(layers(local(farm())))
    lines = of(part, "path")
    lines = [line for line in lines if line.geom_type == "LineString"]
    true = shapely.union_all([shapely.LineString(PATH), shapely.LineString(BRANCH)])
    assert shapely.union_all(lines).hausdorff_distance(true) < 1.2, "ends and the junction are off by half a width"
    assert sum(line.length for line in lines) == pytest.approx(true.length, rel=0.06)
    widths = [f.properties["width"] for f in part if f.properties.get("middle_line")]
    assert all(1.5 <= w <= 2.3 for w in widths)
    plan = derive.plan(frozenset({"imagery"}), frozenset({"topology"}))
    assert plan is not None
    assert [step.name for step in plan.steps] == ["imagery_to_objects", "objects_to_topology"]
    derived_layers = run(plan.steps, layers(local(farm())))
    (network,) = derived_layers.vector("topology").values()
    ends = {p["source"] for p in network.properties if p["kind"] == "edge"}
    assert len(ends) >= 4
    nodes = shapely.get_coordinates(
        [g for g, p in zip(network.geometry, network.properties, strict=True) if p["kind"] == "node"]
    )
    assert np.abs(nodes - [30.0, 20.0]).sum(axis=1).min() < 1.0, "where the branch leaves"


def test_farm_image_gives_grid() -> None:
    content = layers(local(farm()))
    g = grid(content)
    assert (g.resolution, g.origin, g.width, g.height) == (0.1, (0.0, 0.0, 0.0), 600, 400)
    assert all(at(g, x, y) == OCCUPIED for x, y in TREES)
    assert at(g, 41, 29) == OCCUPIED
    assert at(g, 50, 20) == at(g, 30, 35) == at(g, 50, 5) == FREE
    true = len(TREES) * np.pi * CROWN**2 + 80.0
    assert (g.cells == OCCUPIED).sum() * 0.01 == pytest.approx(true, rel=0.08)
    coarse = grid(content, resolution=0.5)
    assert (coarse.resolution, coarse.width) == (0.5, 120)
    assert at(coarse, 41, 29) == OCCUPIED
    # The same through objects.
    notes = DerivationNotes()
    both = Layers({**content.parts, **imagery_to_objects(content, ObjectParameters(), notes).parts})
    derived_layers = objects_to_occupancy(both, Rasterised(resolution=0.1, padding=0.0), notes)
    (rasterised,) = derived_layers.grids().values()
    assert (rasterised.cells == OCCUPIED).sum() * 0.01 == pytest.approx(true, rel=0.1)


def test_segmentation_is_repeatable_and_seeded() -> None:
    content = layers(local(farm()))
    first, again = grid(content), grid(content)
    assert np.array_equal(first.cells, again.cells)
    patches = np.random.default_rng(3).integers(0, 255, (12, 12, 3), np.uint8)
    noisy = layers(local(np.kron(patches, np.ones((40, 40, 1), np.uint8))))

    def ids_of(**options: Any) -> list[Any]:
        return [(f.id, f.geometry.wkt) for f in objects(noisy, minimum_area=0.1, **options)]

    first_ids = ids_of(clusters=12)
    assert first_ids == ids_of(clusters=12)
    assert any(first_ids != ids_of(clusters=12, cluster_seed=seed) for seed in (1, 2, 3))
    assert first_ids != ids_of(clusters=3)


def test_small_regions_are_dropped() -> None:
    notes = DerivationNotes()
    part = objects(layers(local(farm())), notes, minimum_area=15.0)
    assert not of(part, "tree")
    assert len(of(part, "building")) == 1
    assert any(d.subject == "small regions" and d.count >= len(TREES) for d in notes.dropped)


def on_earth() -> GeoImage:
    frame = local_frame(DATUM)
    corner, far = frame.to_wgs84(np.array([[0.0, 40.0], [60.0, 0.0]]))
    a, e = (far - corner) / [600, 400]
    return GeoImage(farm(), (float(a), 0.0, float(corner[0]), 0.0, float(e), float(corner[1])), "EPSG:4326")


def test_wgs84_image_gives_wgs84_objects() -> None:
    with_datum = objects(layers(on_earth(), datum=DATUM))
    without = objects(layers(on_earth()))
    for part in (with_datum, without):
        assert not part.local.any()
        house = local_frame(DATUM).geometries_to_local(np.array(of(part, "building"), object))[0]
        assert overlap(house, shapely.box(*BUILDING)) > 0.9
    g = grid(layers(on_earth(), datum=DATUM))
    assert at(g, 41, 29) == OCCUPIED
    with pytest.raises(MissingDatum):
        grid(layers(on_earth()))


def test_vegetation_by_index() -> None:
    notes = DerivationNotes()
    part = objects(layers(local(farm())), notes, segmentation="index")
    assert set(Counter(f.properties["kind"] for f in part)) == {"tree", "field"}
    assert len(of(part, "tree")) == len(TREES)
    assert notes.template[0].subject == "threshold"
    g = grid(layers(local(farm())), segmentation="index")
    assert (at(g, *TREES[0]), at(g, 50, 5)) == (OCCUPIED, FREE)
    assert at(g, 41, 29) == UNKNOWN, "a roof does not grow, but is no ground"


def test_near_infrared_band_gives_ndvi() -> None:
    """Painted turf is green but no vegetation: only near infrared shows that."""
    rgb = farm()
    nir = np.where(rgb[..., 1] > rgb[..., 0] + 15, 220, 60).astype(np.uint8)
    nir[:, 300:] = 60
    pixels = np.concatenate([rgb, nir[..., None]], axis=2)
    bands = [{"colour": c} for c in ("red", "green", "blue")]
    labelled = local(pixels, bands=[*bands, {"colour": "undefined", "description": "NIR"}])
    unsaid = local(pixels, bands=[*bands, {"colour": "undefined"}])
    for content, options in ((layers(labelled), {}), (layers(unsaid), {"near_infrared": 4})):
        notes = DerivationNotes()
        part = objects(content, notes, segmentation="index", **options)
        assert "NDVI" in notes.template[0].why
        reach = shapely.total_bounds(part.geometry)
        assert reach[2] == pytest.approx(30.0, abs=0.5)
    notes = DerivationNotes()
    green = objects(layers(unsaid), notes, segmentation="index")
    assert shapely.total_bounds(green.geometry)[2] == pytest.approx(60.0, abs=0.5)
    untagged = local(pixels, bands=[{"colour": c} for c in ("grey", *["undefined"] * 3)])
    assert len(objects(layers(untagged), segmentation="index", near_infrared=4))
    with pytest.raises(CannotConvert, match="does not state which of its bands are red, green and blue: tag them"):
        objects(layers(untagged), segmentation="colour")
    with pytest.raises(CannotConvert, match="no band 9"):
        objects(layers(unsaid), segmentation="index", near_infrared=9)


def lake() -> np.ndarray[Any, Any]:
    """Turf with a dark smooth lake of 30 × 30 m, and grey ground without a shape: uint8 [400, 600, 3]."""
    image = np.full((400, 600, 3), (110, 150, 80), np.uint8)
    image[50:350, 50:350] = (30, 45, 60)
    cv2.fillPoly(image, [np.array([[400, 60], [590, 200], [400, 340]])], (150,) * 3)
    shaken = image + np.random.default_rng(4).normal(0.0, 2.0, image.shape)
    return np.clip(np.round(shaken), 0, 255).astype(np.uint8)


def test_lake_is_occupied_and_what_colour_does_not_tell_is_unknown() -> None:
    notes = DerivationNotes()
    content = layers(local(lake()))
    g = grid(content, notes)
    assert (at(g, 20, 20), at(g, 3, 3)) == (OCCUPIED, FREE)
    assert at(g, 45, 20) == UNKNOWN, "a roof, or a car park"
    (warning,) = [w.problem for w in notes.warnings if "is unknown" in w.problem]
    share = float((g.cells == UNKNOWN).mean())
    assert warning.startswith(f"{share:.0%} of the image 'satellite'")
    (water,) = of(objects(content), "water")
    assert overlap(water, shapely.box(5, 5, 35, 35)) > 0.9
    guessed = [f.properties for f in objects(content) if f.properties["kind"] == "area"]
    assert guessed
    assert all(p["confidence"] < 0.5 and p["guess"] in ("field", "path", "road", "building") for p in guessed)


def test_confidence_decides_what_is_unknown() -> None:
    content = layers(local(lake()))
    counts = [int((grid(content, confidence=c).cells == UNKNOWN).sum()) for c in (0.05, 0.5, 0.95)]
    assert counts[0] < counts[1] < counts[2]


def test_probabilities_are_a_second_grid() -> None:
    content = layers(local(lake()))
    parts = imagery_to_occupancy(content, Parameters(probabilities=True), DerivationNotes()).grids()
    assert {key.name for key in parts} == {MAP, "probability"}
    chance, g = (parts[PartKey("occupancy", "ground", name)] for name in ("probability", MAP))
    assert at(chance, 20, 20) > 50 > at(chance, 3, 3)
    assert 50 < at(chance, 45, 20) < 100, "probably no ground"
    assert (g.origin, g.resolution, g.cells.shape) == (chance.origin, chance.resolution, chance.cells.shape)


def test_near_infrared_tells_water_from_bare_ground() -> None:
    """Muddy water and bare ground of one colour: only near infrared tells them apart."""
    rgb = np.full((300, 300, 3), (90, 80, 70), np.uint8)
    rgb[:40] = (110, 150, 80)
    nir = np.full((300, 300, 1), 100, np.uint8)
    nir[:40] = 220
    nir[150:] = 15
    bands = [*({"colour": c} for c in ("red", "green", "blue")), {"colour": "undefined", "description": "nir"}]
    shaken = np.concatenate([rgb, nir], axis=2) + np.random.default_rng(5).normal(0.0, 2.0, (300, 300, 4))
    g = grid(layers(local(np.clip(shaken, 0, 255).astype(np.uint8), 2.0, bands=bands)))
    assert (at(g, 300, 150), at(g, 300, 400), at(g, 300, 560)) == (OCCUPIED, FREE, FREE)


def test_floor_plan_gives_walls_rooms_and_outside() -> None:
    notes = DerivationNotes()
    g = grid(layers(local(plan(), 0.02), name="house"), notes)
    assert (g.resolution, g.origin) == (0.05, (0.0, 0.0, 0.0))
    assert (at(g, 2.1, 6), at(g, 7.05, 3), at(g, 7.05, 9)) == (OCCUPIED, OCCUPIED, OCCUPIED)
    assert (at(g, 4, 6), at(g, 10, 6), at(g, 7.05, 5.5)) == (FREE, FREE, FREE), "two rooms and the door between them"
    assert (at(g, 1, 6), at(g, 13, 11), at(g, 1, 11.2)) == (UNKNOWN, UNKNOWN, UNKNOWN), "outside, and the title"
    rooms = 9.6 * 7.6 - 0.1 * 6.6
    assert (g.cells == FREE).sum() * 0.0025 == pytest.approx(rooms, rel=0.03)
    assert any(d.subject == "symbols" for d in notes.dropped), "the letters of the title"
    part = objects(layers(local(plan(), 0.02)))
    walls, floors = shapely.union_all(of(part, "wall")), shapely.union_all(of(part, "floor"))
    assert walls.area == pytest.approx(10 * 8 - 9.6 * 7.6 - 0.2 + 0.66, rel=0.1)
    assert floors.area == pytest.approx(rooms, rel=0.03)
    with pytest.raises(CannotConvert, match="encloses no room"):
        grid(layers(local(plan(), 0.02)), gap=0.5)
    free = grid(layers(local(plan(), 0.02)), gap=0.5, outside_free=True)
    assert (at(free, 1, 6), at(free, 2.1, 6)) == (FREE, OCCUPIED)


def test_rotated_plan_follows_its_transform() -> None:
    c, s = 0.02 * np.cos(0.5), 0.02 * np.sin(0.5)
    turned = GeoImage(plan()[..., None], (c, s, 100.0, s, -c, 50.0))
    g = grid(layers(turned))

    def cell_at(x: float, y: float) -> int:
        u, v = x / 0.02, (12 - y) / 0.02
        return at(g, c * u + s * v + 100.0, s * u - c * v + 50.0)

    assert (cell_at(2.1, 6), cell_at(7.05, 3), cell_at(4, 6), cell_at(7.05, 5.5), cell_at(1, 6)) == (
        100,
        100,
        0,
        0,
        255,
    )
    assert g.origin[2] == 0.0
    for k in (0, 1):
        assert g.origin[k] / 0.05 == pytest.approx(round(g.origin[k] / 0.05), abs=1e-6)


@pytest.mark.parametrize(
    ("pixels", "options", "expected"),
    [
        (np.full((50, 50, 3), (120, 130, 140), np.uint8), {}, "a single colour"),
        (np.full((50, 50, 1), 250, np.uint8), {"segmentation": "plan"}, "a single shade"),
        (np.full((50, 50, 1), 100, np.uint8), {}, "no colours"),
        (np.zeros((50, 50, 4), np.uint8), {}, "is empty"),
        (
            np.full((50, 50, 3), (160, 120, 110), np.uint8),
            {"segmentation": "index"},
            "no vegetation, the vegetation index is at most",
        ),
        (farm()[:, :, :], {"resolution": 0.001}, "coarser resolution"),
        (np.full((1, 1, 3), 7, np.uint8), {}, "a single colour"),
    ],
)
def test_empty_image_raises_cannot_convert(pixels: Any, options: dict[str, Any], expected: str) -> None:
    content = layers(local(pixels))
    for make in (grid, objects):
        with pytest.raises(CannotConvert, match=expected):
            make(content, **options)


def test_plan_with_more_ink_than_paper_raises_cannot_convert() -> None:
    dark = np.full((100, 100, 1), 30, np.uint8)
    dark[:30, :30] = 240
    with pytest.raises(CannotConvert, match="dark overall"):
        grid(layers(local(dark)), segmentation="plan")


def test_image_selection_and_parameters_of_another_method() -> None:
    a, b = local(farm()), local(plan(), 0.02)
    with pytest.raises(Ambiguous, match="picture="):
        grid(layers(a, name="a", b=b))
    assert at(grid(layers(a, name="a", b=b), picture="b"), 2.1, 6) == OCCUPIED
    assert at(grid(layers(a, b=b)), 41, 29) == OCCUPIED, "satellite is the usual one"
    with pytest.raises(NotFound, match="available: satellite"):
        grid(layers(a), picture="other")
    with pytest.raises(Invalid, match="applies only to segmentation=plan"):
        grid(layers(a), gap=2.0)
    with pytest.raises(Invalid, match="applies only to segmentation=colour"):
        grid(layers(b), clusters=4)


def test_planner_prefers_other_layers_to_images() -> None:
    """Other stored layers are preferred to an image; an image is preferred to an empty grid."""
    for better in ("objects", "voxels"):
        plan = derive.plan(frozenset({"imagery", better}), frozenset({"occupancy"}))
        assert plan is not None
        assert [step.needs for step in plan.steps] == [(better,)]
    plan = derive.plan(frozenset({"imagery", "location"}), frozenset({"occupancy"}))
    assert plan is not None
    assert [step.name for step in plan.steps] == ["imagery_to_occupancy"]


# --- a building's drawings ------------------------------------------------------------------------------------------
def building(files: dict[str, bytes], drawing: str = "plan.png", turn: tuple[float, ...] = (0.02, 0, 0, 12)) -> Layers:
    wall = [("wall/0", shapely.LineString([(2, 6), (12, 6)]), {"kind": "wall"})]
    document = {"openrmf": {"level": {"drawing": {"filename": drawing}}, "transform": list(turn)}}
    return Layers(
        {
            PartKey("objects", "L1", "openrmf"): features(wall, "local", document),
            PartKey("resources", "ground", "openrmf"): Resources(files),
        }
    )


def png(pixels: Any) -> bytes:
    ok, data = cv2.imencode(".png", pixels)
    assert ok
    return data.tobytes()


def test_building_drawing_gives_image() -> None:
    notes = DerivationNotes()
    derived_layers = resources_to_imagery(building({"plan.png": png(plan())}), Drawings(), notes)
    g = grid(derived_layers, level="L1")
    assert (at(g, 2.1, 6), at(g, 4, 6), at(g, 1, 6)) == (OCCUPIED, FREE, UNKNOWN)
    assert not notes.warnings


def test_unreadable_drawings_are_warned_of() -> None:
    for files, expected in (
        ({}, "was not uploaded"),
        ({"plan.png": b"GIF89a"}, "cannot be read"),
        ({"plan.png": png(plan())[:200]}, "cannot be read"),
        ({"plan.png": png(np.zeros((9000, 8000), np.uint8))}, "the limit is"),
    ):
        notes = DerivationNotes()
        with pytest.raises(MissingLayer, match="floor plan"):
            resources_to_imagery(building(files), Drawings(), notes)
        assert expected in notes.warnings[0].problem


def covered(walls: list[Any], g: OccupancyGrid, reach: float = 0.2) -> float:
    """The share of the walls' length with an occupied cell within reach."""
    away = cv2.distanceTransform((g.cells != OCCUPIED).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    points = [shapely.line_interpolate_point(w, np.arange(0.025, w.length, 0.05)) for w in walls]
    index = np.floor((shapely.get_coordinates(np.concatenate(points)) - g.origin[:2]) / g.resolution).astype(int)
    inside = (index >= 0).all(axis=1) & (index[:, 0] < g.width) & (index[:, 1] < g.height)
    near = np.zeros(len(index), bool)
    near[inside] = away[index[inside, 1], index[inside, 0]] * g.resolution <= reach
    return float(near.mean())


@pytest.mark.parametrize(
    ("folder", "levels"), [("hotel", 3), ("office", 1), ("triple_H", 1), ("free_fleet_turtlebot3_world", 1)]
)
def test_plans_of_real_buildings_have_their_walls(folder: str, levels: int) -> None:
    """Walls as people drew them over the plan: at least nine tenths of their length are ink within 20 cm."""
    if not (DATA / "openrmf_building" / folder).is_dir():
        pytest.skip("the real maps are missing")
    content = real(folder)
    derived_layers = resources_to_imagery(content, Drawings(), DerivationNotes())
    assert len(derived_layers.parts) == levels
    for key in derived_layers.parts:
        g = grid(Layers({key: derived_layers.parts[key]}), level=key.level)
        (part,) = content.vector("objects", key.level).values()
        walls = of(part, "wall")
        assert covered(walls, g) >= 0.9
        assert 0.2 <= (g.cells == FREE).mean() + (g.cells == UNKNOWN).mean() <= 0.995
        floors = shapely.union_all([shapely.make_valid(f) for f in of(part, "floor")])
        if folder in ("hotel", "office"):
            free = np.argwhere(g.cells == FREE)[::97, ::-1] * g.resolution + g.origin[:2] + g.resolution / 2
            within = shapely.contains_xy(floors.buffer(0.5), free[:, 0], free[:, 1]).mean()
            # ground enclosed by the office's dimension lines counts as inside, too
            assert within >= (0.95 if folder == "hotel" else 0.8)


def real(folder: str) -> Layers:
    root = DATA / "openrmf_building" / folder
    files = {p.name: p.read_bytes() for p in root.iterdir() if p.name.endswith((".building.yaml", ".png"))}
    return upload_reader.read(files, UploadHints(format="openrmf"), EnvironmentContext(), Limits()).layers(None)


def test_plan_of_robot_map_agrees_with_the_map() -> None:
    """robast_sim: the plan is an older picture of the same storey as the ROS map, here compared cell by cell."""
    folder = DATA / "openrmf_building" / "robast_sim"
    if not folder.is_dir():
        pytest.skip("the real maps are missing")
    files = {p.name: p.read_bytes() for p in (folder / "ros_map").iterdir()}
    map_layers = upload_reader.read(files, UploadHints(format="occupancy_grid"), EnvironmentContext(), Limits()).layers(
        None
    )
    (true,) = map_layers.grids().values()
    pixels = cv2.imread(str(folder / "small_sim_map.png"), cv2.IMREAD_GRAYSCALE)
    assert pixels is not None
    assert pixels.shape == true.cells.shape
    x, y, _ = true.origin
    size = true.resolution
    lain = GeoImage(pixels[..., None], (size, 0.0, x, 0.0, -size, y + len(pixels) * size))
    notes = DerivationNotes()
    derived_grid = grid(layers(lain), notes, minimum_area=0.0)
    assert any("205" in w.problem for w in notes.warnings)
    near = (
        cv2.distanceTransform((derived_grid.cells != OCCUPIED).astype(np.uint8), cv2.DIST_L2, 5)
        * derived_grid.resolution
        <= 0.1
    )
    rows, columns = np.nonzero(true.cells == OCCUPIED)
    at_x, at_y = (columns + 0.5) * size + x, (rows + 0.5) * size + y
    j, i = ((v - o) / derived_grid.resolution for v, o in zip((at_x, at_y), derived_grid.origin, strict=False))
    assert near[i.astype(int), j.astype(int)].mean() >= 0.98
    free = true.cells[(derived_grid.cells == FREE)[: len(true.cells), : true.cells.shape[1]]]
    assert (free == OCCUPIED).mean() < 0.02
    assert (derived_grid.cells == FREE).sum() == pytest.approx(
        (pixels > 230).sum(), rel=0.02
    )  # its grey is not free here


def test_strawberry_farm_image_gives_objects() -> None:
    """The large white hall is a building; the image is placed by the corners given with its upload."""
    file = DATA / "environment_template/riseholme_park_farm_strawberry_polytunnels/config/location/satellite-auto.png"
    if not file.is_file():
        pytest.skip("the real maps are missing")
    hints = UploadHints(
        format="satellite", options={"corners": "53.2694,-0.5262,53.2682,-0.5224", "picture": "satellite"}
    )
    upload_bundle = upload_reader.read({"satellite-auto.png": file.read_bytes()}, hints, EnvironmentContext(), Limits())
    content = upload_bundle.layers(Datum(53.268642038, -0.524509505881))
    part = objects(content)
    assert not part.local.any()
    frame = local_frame(Datum(53.268642038, -0.524509505881))
    houses = frame.geometries_to_local(np.array(of(part, "building"), object))
    corners = np.array([(593, 320), (888, 250), (945, 735), (660, 805)])  # of the hall, in the picture's pixels
    west, east, north, south = -0.5262, -0.5224, 53.2694, 53.2682
    places = np.column_stack(
        [west + (east - west) * corners[:, 0] / 2560, north + (south - north) * corners[:, 1] / 1350]
    )
    hall = shapely.Polygon(frame.to_local(places))
    assert max(overlap(h, hall) for h in houses) > 0.85
    assert of(part, "vegetation")
    assert of(part, "field")
