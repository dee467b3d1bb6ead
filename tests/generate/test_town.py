"""Towns by a grammar: rules, streets and lanes, buildings, and impossible requests."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from app.convert.files import write_layers
from app.errors import CannotGenerate, Invalid
from app.generate import RandomSource, _blocks, _streets
from app.model.features import features
from app.model.frame import GROUND, Datum
from app.model.layers import Layers, PartKey
from tests.api.conftest import Api
from tests.generate import site_checks

DIGEST = "4661eac93fc20d758d5ef2fd36e3e9ea1a91f56766f932c27a9853edf9130c35"
SQUARE = shapely.box(0, 0, 100, 60)


def grown(rules: str, area: Any = SQUARE, seed: int = 7, **constants: float) -> _blocks.Town:
    return _blocks.grow(_blocks.parse(rules, constants), area, RandomSource(seed, "town").stream("rules"))


def test_town_is_consistent_in_every_format(tmp_path: Path) -> None:
    layers, _ = site_checks.make("town", width=110, depth=80, block=2500, resolution=0.2)
    site_checks.agrees_with_itself(layers, 0.3)
    site_checks.sound_sdf(layers, tmp_path)
    site_checks.serves(layers)
    assert site_checks.digest(layers) == DIGEST


def test_rules_give_hand_computed_shapes() -> None:
    """100 × 60 m with a ring of 10 m: 80 × 40 m in it, cut in the middle by a street of 6 m: two blocks of 37 × 40."""
    town = grown(
        """
        town -> ring(ring) inner      # a comment
        inner -> cut(0.5, 6) block block
        block : area > 1000 -> cut(0.25, 0) lot lot
        lot : length > 28 & width >= 28 -> inset(3) house
        lot : length <= 28 | width < 28 -> garden
        house -> flat(2)
        """,
        ring=10,
    )
    assert [s.width for s in town.streets] == [10, 6]
    assert town.streets[0].line.length == 2 * (90 + 50)
    assert town.streets[1].line.equals(shapely.LineString([(50, 5), (50, 55)]))
    assert [b.area for b in town.blocks] == [37 * 40, 37 * 40]
    assert [(round(lot.area.area, 3), lot.use, lot.storeys) for lot in town.lots] == [
        (370, "garden", 0),
        (31 * 24, "flat", 2),
        (370, "garden", 0),
        (31 * 24, "flat", 2),
    ]


def test_frontage_is_edge_on_street() -> None:
    """Three lots in a row of 60 × 20 m: the middle one has 2 × 20 m of street, the others 20 + 2 × 20 m."""
    row = shapely.box(0, 0, 60, 20)
    rules = "a -> cut(0.3333333333, 0) end b; b -> cut(0.5, 0) mid end; mid : frontage > 39 & frontage < 41 -> flat(1)"
    town = grown(rules + "; end : frontage > 59 & frontage < 61 -> gable(1)", row)
    assert Counter(lot.use for lot in town.lots) == {"flat": 1, "gable": 2}


def test_random_rules_follow_weights_and_seed() -> None:
    rules = "a : area > 4 -> cut(0.5, 0) a a; a : area <= 4 @ 3 -> flat(1); a : area <= 4 @ 1 -> park; x -> a"
    town = grown(rules, shapely.box(0, 0, 40, 40))
    uses = Counter(lot.use for lot in town.lots)
    assert 0.66 < uses["flat"] / sum(uses.values()) < 0.84
    assert [lot.use for lot in town.lots] == [lot.use for lot in grown(rules, shapely.box(0, 0, 40, 40)).lots]
    assert [lot.use for lot in town.lots] != [lot.use for lot in grown(rules, shapely.box(0, 0, 40, 40), 8).lots]


@pytest.mark.parametrize(
    ("rules", "why"),
    [
        ("", "1 to 200 rules, got 0"),
        ("town", "is not a rule"),
        ("town -> explode(3) a", "unknown action 'explode'"),
        ("town -> house", "no rule for 'house'"),
        ("town -> ring(5)", "takes 1 values and 1 shapes"),
        ("town -> cut(0.5) a b", "takes 2 values"),
        ("town -> ring(__import__) town", "unknown name"),
        ("town : -> park", "missing condition"),
        ("town -> park extra", "unknown action 'park'"),
        ("T O W N -> park", "is not a rule"),
        ("town -> park\n" * 201, "1 to 200"),
    ],
)
def test_invalid_town_rules_raise(rules: str, why: str) -> None:
    with pytest.raises(Invalid, match=why):
        _blocks.parse(rules, {})


@pytest.mark.parametrize(
    ("rules", "why"),
    [
        ("a -> a", "more than 48 levels deep"),
        ("a -> inset(0) a", "more than 48 levels deep"),
        ("a -> ring(90) a", "no room for a ring of 90 m"),
        ("a -> cut(5, 0) a a", "a share must be from"),
        ("a -> cut(0.5, 900) a a", "1 to 200 m wide"),
        ("a -> inset(0 - 1) a", "must not be negative"),
        ("a -> flat(0)", "1 to 100 storeys"),
        ("a -> cut(0.5, 0) b b; b -> cut(0.5, 6) b b", "land that has been cut into lots"),
        ("a -> cut(1 / 0, 6) a a", "cannot be computed"),
        ("a @ 0 -> park; a @ 0 -> garden", "weights"),
    ],
)
def test_rules_without_result_raise(rules: str, why: str) -> None:
    with pytest.raises(CannotGenerate, match=why):
        grown(rules)


def test_exploding_grammar_raises(monkeypatch: pytest.MonkeyPatch) -> None:
    assert _blocks.MAX_SHAPES == 30_000
    monkeypatch.setattr(_blocks, "MAX_SHAPES", 500)
    with pytest.raises(CannotGenerate, match="the rules create more than 500 shapes"):
        grown("a -> cut(0.5, 0) a a", shapely.box(0, 0, 3000, 3000))


def test_crossing_streets_have_lanes_on_the_right() -> None:
    """A cross of two streets of 12 m: four links, four lanes in, four out, and no lane turns round at the middle."""
    lines = [shapely.LineString([(0, 50), (100, 50)]), shapely.LineString([(50, 0), (50, 100)])]
    streets = _streets.build_streets([_blocks.Street(line, 12.0) for line in lines], 2.0)
    assert len(streets.links) == 4
    assert sorted(streets.junctions)[2] == (50, 50)
    assert (streets.walk, streets.carriage(streets.links[0])) == (2.0, 8.0)
    middle = streets.junctions.index((50, 50))
    assert len(streets.links_at(middle)) == 4
    end = streets.junctions.index((0, 50))
    lane = _streets._lane(streets, shapely.LineString([(0, 50), (50, 50)]), end, middle, 2)
    at = shapely.get_coordinates(lane)
    assert at.tolist() == [[3, 48], [41.5, 48]], "on the right, 4 + 2 + 0.5 + 2 m before the junction"


def test_town_has_lanes_sidewalks_and_crossings() -> None:
    layers, notes = site_checks.make("town", width=160, depth=120, trees=False, resolution=0.2)
    network = layers.vector("topology")[PartKey("topology", GROUND, "network")]
    edges = [p for p in network.properties if p["kind"] == "edge"]
    pairs = {(p["source"], p["target"]) for p in edges}
    lanes = [p for p in edges if p["speed_limit"] == 5.0]
    assert len(lanes) >= 8
    assert not any((p["target"], p["source"]) in pairs for p in lanes), "lanes are one-way"
    walks = [p for p in edges if p.get("surface") == "paving_stones"]
    assert all((p["target"], p["source"]) in pairs for p in walks), "sidewalks are not"
    assert sum(p["action"] == "cross" for p in edges) >= 8
    assert not any(d.subject == "sidewalks" for d in notes.dropped)
    objects = layers.vector("objects")[PartKey("objects", GROUND, "generated")]
    roads = objects.select_kinds("road")
    buildings = objects.select_kinds("building")
    for road, p in zip(roads.geometry, roads.properties, strict=True):
        assert not shapely.intersects(shapely.buffer(road, p["width"] / 2), buildings.geometry).any()
    area = shapely.union_all(buildings.geometry).area
    assert area == pytest.approx(shapely.area(buildings.geometry).sum()), "no two buildings overlap"
    for p in buildings.properties:
        assert p["height"] >= p["levels"] * 2.9
        assert p["osm"]["tags"]["building:levels"] == str(p["levels"])
    lamps = objects.select_kinds("pole")
    assert len(lamps) > 5
    assert b'k="roof:shape"' in write_layers(layers, "osm", {}, site_checks.CAME).files["map.osm"]


def test_boundary_is_parameter_or_fence() -> None:
    ring = shapely.Polygon([(0, 0), (120, 20), (100, 110), (10, 90)])
    boundary = ",".join(f"{v:g}" for point in ring.exterior.coords[:-1] for v in point)
    layers, _ = site_checks.make("town", boundary=boundary, resolution=0.2)
    site_checks.agrees_with_itself(layers, 0.3)
    buildings = layers.vector("objects")[PartKey("objects", GROUND, "generated")].select_kinds("building")
    assert len(buildings) > 4
    assert shapely.contains(ring, buildings.geometry).all()
    fence = features([("f", ring, {"kind": "fence"})], "local")
    given = Layers({PartKey("location", GROUND, "site"): fence}, Datum(53.0, -0.5))
    layers, _ = site_checks.make("town", given=given, resolution=0.2)
    for part in (*layers.vector("objects").values(), *layers.vector("topology").values()):
        assert shapely.contains(shapely.buffer(ring, 1e-6), part.geometry).all()
    with pytest.raises(CannotGenerate, match="boundary: extends beyond the fence"):
        site_checks.make("town", given=given, boundary="0,0,500,0,500,500")


@pytest.mark.parametrize(
    ("values", "why"),
    [
        ({"boundary": "0,0,10,0"}, "3 to 1000 corners"),
        ({"boundary": "0,0,10,0,20,0"}, "not a valid polygon|got 0 m²"),
        ({"boundary": "0,0,10,10,10,0,0,10"}, "is not a valid polygon: Self-intersection"),
        ({"boundary": "0,0,1,0,1,1"}, r"area of at least 100 m², got 0\.5 m²"),
        ({"boundary": "0,0,1e9,0,1e9,1e9"}, "within ±1e6 m"),
        ({"boundary": "0,0,9e5,0,9e5,9e5"}, "km²; the limit is 25"),
        ({"boundary": "a,b"}, "must be a number"),
        ({"width": 0}, "at least 30"),
        ({"width": 1e9}, "at most 5000"),
        ({"width": 5000, "depth": 5000, "resolution": 0.1}, "coarser resolution"),
        ({"rules": "town -> park"}, "the rules create no street"),
        ({"rules": "town -> nothing"}, "no rule for 'nothing'"),
        ({"sidewalk": 1, "robot_radius": 0.6}, "too narrow for the robot"),
        ({"main": 100, "width": 60, "depth": 60}, "no room for a ring of 100 m"),
    ],
)
def test_invalid_town_parameters_raise(values: dict[str, Any], why: str) -> None:
    with pytest.raises((CannotGenerate, Invalid), match=why):
        site_checks.make("town", **values)


def test_custom_rules_may_leave_streets_open() -> None:
    rules = "town -> cut(0.5, street) half half; half -> cut(0.5, street) use use; use -> inset(setback) house"
    rules += "; house -> hip(2)"
    layers, _ = site_checks.make("town", width=80, depth=60, rules=rules, resolution=0.1)
    site_checks.agrees_with_itself(layers, 0.3)
    objects = layers.vector("objects")[PartKey("objects", GROUND, "generated")]
    assert Counter(p["kind"] for p in objects.properties)["building"] == 4
    assert {p["roof"] for p in objects.select_kinds("building").properties} == {"hip"}
    assert np.isfinite(shapely.bounds(objects.geometry)).all()


def test_town_is_generated_over_http(api: Api) -> None:
    format_names = ("osm", "gazebo", "tmap2", "geojson", "occupancy_grid")
    version = site_checks.over_http(api, "town", format_names, width=70, depth=60, trees=False, resolution=0.2)
    assert version["information"]["objects"] == "generated"
