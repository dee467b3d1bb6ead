"""Values that are not set are drawn from the seed, within ranges; ``like`` measures them in another environment."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import shapely

from app import generate
from app.derive import DerivationNotes
from app.errors import CannotGenerate
from app.generate import RandomSource, _likeness, _variety
from app.model.features import Features, features
from app.model.frame import GROUND, Datum
from app.model.grid import FREE, OCCUPIED, OccupancyGrid
from app.model.layers import Layers, PartKey
from tests.api.conftest import Api
from tests.generate import site_checks
from tests.generate.test_fields import SMALL

NETWORK, OBJECTS = PartKey("topology", GROUND, "network"), PartKey("objects", GROUND, "generated")
NAMES = {"rows", "row_spacing", "row_length", "angle", "plant_spacing", "aisle", "rack_depth"}


def drawn(name: str, seed: int, values: dict[str, Any], fenced: bool = False) -> dict[str, float]:
    """The drawn parameters of a generator, without running it."""
    _, options = generate.check(name, seed, values)
    stream = RandomSource(seed, name).stream
    return dict(_variety.draw(options, stream, {}, fenced=fenced, why="").values)


@pytest.mark.parametrize("name", sorted(SMALL))
def test_ten_seeds_differ_within_the_ranges_and_what_is_set_stays(name: str) -> None:
    ranges = _variety.spans(generate.get_generator(name).parameters)
    rows = [drawn(name, seed, {"headland": 4.25}) for seed in range(10)]
    assert rows == [drawn(name, seed, {"headland": 4.25}) for seed in range(10)]
    assert all("headland" not in row for row in rows)
    for key in rows[0]:
        values = [row[key] for row in rows]
        assert len(set(values)) > 1, key
        assert all(ranges[key].low <= v <= ranges[key].high for v in values), key
    assert not {"row_length", "angle"} & drawn(name, 1, {}, fenced=True).keys(), "the fence decides"


def test_setting_a_parameter_does_not_change_the_others() -> None:
    free, some = drawn("orchard", 3, {}), drawn("orchard", 3, {"rows": 7, "docks": 1})
    assert {k: v for k, v in free.items() if k not in ("rows", "docks")} == some


def test_drawn_values_give_way_to_a_wide_robot_and_set_ones_do_not() -> None:
    layers, notes = site_checks.make("vineyard", 4, rows=3, row_length=24, robot_radius=1.2, shed=0, docks=1)
    site_checks.agrees_with_itself(layers, 1.2)
    assert notes.template[0].value["row_spacing"] > 3.0
    with pytest.raises(CannotGenerate, match=r"row_spacing: rows 2\.20 m apart"):
        site_checks.make("vineyard", 4, rows=3, row_length=24, robot_radius=1.2, row_spacing=2.2)


def test_rows_curve_lean_and_have_gaps_and_aisles_across() -> None:
    shape = {"angle": 30, "skew": 10, "taper": -0.2, "curve": 2, "missing": 0.2, "cross_aisles": 1, "cross_width": 4}
    size = {"rows": 5, "row_length": 30, "row_spacing": 4, "tree_spacing": 1, "jitter": 0, "shed": 0}
    values: dict[str, Any] = {**size, **shape}
    layers, _ = site_checks.make("orchard", 5, **values)
    site_checks.agrees_with_itself(layers, 0.3)
    part, topology = layers.parts[OBJECTS], layers.parts[NETWORK]
    assert isinstance(part, Features)
    assert isinstance(topology, Features)
    lines = {p["name"]: g for g, p in zip(part.geometry, part.properties, strict=True) if p["kind"] == "tree_row"}
    assert set(lines) == {f"Row {k}{piece}" for k in range(1, 6) for piece in "ab"}
    ends = {name: shapely.get_coordinates(line) for name, line in lines.items()}
    gap = np.linalg.norm(ends["Row 3a"][-1] - ends["Row 3b"][0])
    assert gap == pytest.approx(4.0, abs=0.1)
    lengths = [lines[f"Row {k}a"].length + lines[f"Row {k}b"].length for k in range(1, 6)]
    assert lengths[0] == pytest.approx(26, abs=1.5)
    assert lengths[-1] < lengths[0] - 3
    whole = np.vstack([ends["Row 3a"], ends["Row 3b"]])
    step = (whole[-1] - whole[0]) / np.linalg.norm(whole[-1] - whole[0])
    bow = np.abs((whole - whole[0]) @ [-step[1], step[0]]).max()
    assert 1.2 < bow < 2.2, "2 m for rows that do not lean"
    direction = np.degrees(np.arctan2(step[1], step[0]))
    assert direction == pytest.approx(30, abs=3)
    trees = sum(p["kind"] == "tree" for p in part.properties)
    assert trees < 0.9 * sum(lengths), "a tree a metre, but for the missing ones"
    edges = {p["source"] + " " + p["target"] for p in topology.properties if p["kind"] == "edge"}
    assert "r2.5-x1 r3.5-x1" in edges
    assert "LaneX1 r1.5-x1" in edges


def test_staging_needs_docks_and_skew_no_fence() -> None:
    with pytest.raises(CannotGenerate, match="staging: must be at most the number of docks, 1"):
        site_checks.make("warehouse", docks=1, staging=2)
    with pytest.raises(CannotGenerate, match="taper: rows of 900 m would change"):
        site_checks.make("orchard", rows=3, row_length=900, taper=0.5, resolution=1)
    with pytest.raises(CannotGenerate, match="curve: 30 m is too much for rows"):
        site_checks.make("orchard", rows=3, row_length=20, curve=30)
    fence = features([("f", shapely.box(0, 0, 60, 60), {"kind": "fence"})], "local")
    given = Layers({PartKey("location", GROUND, "site"): fence}, Datum(53.0, -0.5))
    with pytest.raises(CannotGenerate, match="skew: the environment's fence decides"):
        site_checks.make("orchard", given=given, skew=5)


# --- like ---


def ways(count: int, spacing: float, length: float, turn: float) -> Layers:
    """A network of parallel edges, and one across them."""
    c, s = math.cos(turn), math.sin(turn)
    rows: list[tuple[str, Any, dict[str, Any]]] = []
    for k in range(count):
        ends = [(c * u - s * k * spacing, s * u + c * k * spacing) for u in (0.0, length)]
        for end, at in zip("ab", ends, strict=True):
            rows.append((f"{k}{end}", shapely.Point(at), {"kind": "node", "name": f"{k}{end}"}))
        edge = {"kind": "edge", "source": f"{k}a", "target": f"{k}b", "action": "move_base"}
        rows.append((f"e{k}", shapely.LineString(ends), edge))
    return Layers({NETWORK: features(rows, "local")})


def test_network_gives_spacing_length_count_and_angle() -> None:
    ranges = _likeness.measure(ways(8, 2.5, 23.0, 0.3), NAMES, "farm")
    assert ranges["row_spacing"] == pytest.approx((2.5, 2.5))
    assert ranges["row_length"] == pytest.approx((23.0, 23.0))
    assert ranges["rows"] == pytest.approx((7, 11)), "nine rows beside eight ways, and a fifth of it"
    assert ranges["angle"] == pytest.approx((17.2, 17.2), abs=0.1)


def test_grid_gives_racks_and_aisles() -> None:
    cells = np.full((300, 400), FREE, np.uint8)
    for k in range(4):
        cells[20 + 60 * k : 40 + 60 * k, 50:350] = OCCUPIED
    ranges = _likeness.measure(Layers({PartKey("occupancy", GROUND, "map"): OccupancyGrid(cells, 0.05)}), NAMES, "hall")
    assert ranges["aisle"] == pytest.approx((2.0, 2.0), abs=0.06)
    assert ranges["rack_depth"] == pytest.approx((0.5, 0.5), abs=0.06)
    assert ranges["row_length"] == pytest.approx((15.0, 15.0), abs=0.1)


def test_generated_site_is_measured_as_it_was_made() -> None:
    made, _ = site_checks.make(
        "orchard", 2, **{**SMALL["orchard"], "row_spacing": 4.4, "tree_spacing": 1.3, "curve": 0}
    )
    ranges = _likeness.measure(made, NAMES, "orchard")
    assert ranges["row_spacing"] == pytest.approx((4.4, 4.4), abs=0.02)
    assert ranges["plant_spacing"][0] <= 1.3 <= ranges["plant_spacing"][1]
    again, notes = site_checks.make("vineyard", 1, rows=3, row_length=20, shed=0)
    assert site_checks.digest(again) == site_checks.digest(
        site_checks.make("vineyard", 1, rows=3, row_length=20, shed=0)[0]
    )
    assert "drawn from the seed" in notes.template[0].why


@pytest.mark.parametrize("layers", [Layers(), ways(2, 2.5, 20.0, 0.0)])
def test_environment_without_rows_is_refused(layers: Layers) -> None:
    with pytest.raises(CannotGenerate, match="like: farm has nothing to measure: it needs a network"):
        _likeness.measure(layers, NAMES, "farm")
    with pytest.raises(CannotGenerate, match="can be read only by a server"):
        generate.run("orchard", 1, {"like": "farm"}, Layers(), DerivationNotes())


def test_objects_without_a_shape_are_no_rows() -> None:
    shapes = [shapely.LineString(), shapely.Polygon(), shapely.Point(1, 1), shapely.LineString([(0, 0), (0, 0)])]
    rows = [(f"r{k}", shape, {"kind": "row"}) for k, shape in enumerate(shapes)]
    with pytest.raises(CannotGenerate, match="nothing to measure"):
        _likeness.measure(Layers({OBJECTS: features(rows, "local")}), NAMES, "farm")


def test_like_over_http_reads_only_what_the_caller_may_read(api: Api) -> None:
    for name in ("like-model", "like-copy", "like-empty"):
        api.post("environments", {"name": name})
    model = {"generator": "orchard", "parameters": {**SMALL["orchard"], "row_spacing": 4.8, "curve": 0}}
    api.post("environments/like-model/generations", model)
    path = "environments/like-copy/generations"
    body = {"generator": "orchard", "seed": 3, "parameters": {"rows": 3, "row_length": 20, "like": "like-model"}}
    version = api.post(path, body).json()
    assert any("measured in like-model" in w["problem"] for w in version["warnings"])
    assert any("row_spacing 4." in w["problem"] for w in version["warnings"])
    unknown = {**body, "parameters": {"like": "nowhere"}}
    assert "nowhere" in api.problem("POST", path, 404, json=unknown)["detail"]
    empty = {**body, "parameters": {"like": "like-empty"}}
    assert "like-empty has nothing to measure" in api.problem("POST", path, 422, json=empty)["detail"]
    limited = api.token_for("editor", environments="like-c*")
    for name in ("like-model", "nowhere"):
        other = {**body, "parameters": {"like": name}}
        assert "limited to the environments" in limited.problem("POST", path, 403, json=other)["detail"]
