"""Stands of plants: consistency, exported formats, and custom rules."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import shapely

from app.convert.files import write_layers
from app.errors import CannotGenerate, Invalid
from app.model.features import features
from app.model.frame import GROUND, Datum
from app.model.layers import Layers, PartKey
from tests.api.conftest import Api
from tests.generate import site_checks

DIGEST = "87eeff483ded9d36ca488e3f8bf9f2aadc1dce9c523b322939c9189a799e715d"


def test_plant_stand_is_consistent_in_every_format(tmp_path: Path) -> None:
    layers, _ = site_checks.make("plants", variants=2, columns=4)
    site_checks.agrees_with_itself(layers, 0.3)
    site_checks.sound_sdf(layers, tmp_path)
    site_checks.serves(layers)
    assert site_checks.digest(layers) == DIGEST
    assert site_checks.digest(site_checks.make("plants", 8, variants=2, columns=4)[0]) != DIGEST


@pytest.mark.parametrize("species", ["vine", "bush", "pine"])
def test_each_species_gives_a_stand(species: str) -> None:
    layers, _ = site_checks.make("plants", species=species, rows=2, columns=2, variants=1)
    site_checks.agrees_with_itself(layers, 0.3)
    objects = layers.vector("objects")[PartKey("objects", GROUND, "generated")]
    assert len(objects) == 4
    files = write_layers(layers, "gazebo", {}, site_checks.CAME).files
    assert {f for f in files if f.endswith(".obj")} == set(layers.resources()), "the meshes go along"


def test_custom_rules_give_a_stand() -> None:
    rules = "axiom: !(0.05) F(0.5) A(1); A(l) : l > 0.3 -> F(l) [ +(30) A(l * 0.7) ] [ -(30) A(l * 0.7) ] L(0.2)"
    layers, _ = site_checks.make("plants", rules=rules, rows=1, columns=2, variants=1, body="crown", jitter=0)
    site_checks.agrees_with_itself(layers, 0.3)
    assert set(layers.resources()) == {"models/own_1/meshes/wood.obj", "models/own_1/meshes/leaves.obj"}
    (first, _) = layers.vector("objects")[PartKey("objects", GROUND, "generated")].properties
    assert first["shapes"][0]["type"] == "cylinder"
    assert first["shapes"][0]["radius"] > 0.3, "a crown, not the trunk of 0.05 m"


def test_plant_stand_stays_inside_fence() -> None:
    fence = features([("f", shapely.Polygon([(0, 0), (60, 60), (40, 80), (-20, 20)]), {"kind": "fence"})], "local")
    given = Layers({PartKey("location", GROUND, "site"): fence}, Datum(53.0, -0.5))
    layers, _ = site_checks.make("plants", given=given, rows=3, columns=4, variants=1)
    assert layers.datum == given.datum
    for part in (*layers.vector("objects").values(), *layers.vector("topology").values()):
        assert shapely.contains(fence.geometry[0], part.geometry).all()
    with pytest.raises(CannotGenerate, match="the fence has no room for the site, which needs"):
        site_checks.make("plants", given=given, rows=50)


@pytest.mark.parametrize(
    ("values", "why"),
    [
        ({"rules": "axiom: F; F -> FFFFFFFFFFFFFFFFFFFF", "iterations": 40}, "more than 100000 symbols after 3 of 40"),
        ({"rules": "axiom: A; A -> B; B -> A"}, "draws no branch"),
        ({"rules": "axiom: Q"}, "no rule for Q"),
        ({"rules": " "}, "missing"),
        ({"species": "oak"}, "must be one of apple, vine, bush, pine"),
        ({"rows": 0}, "at least 1"),
        ({"columns": 10**9}, "at most 200"),
        ({"iterations": 10**9}, "at most 40"),
        ({"row_spacing": 0.2}, r"row_spacing: must be at least 1\.\d\d m"),
        ({"rows": 200, "columns": 200, "spacing": 100, "row_spacing": 100, "resolution": 0.01}, "coarser resolution"),
    ],
)
def test_invalid_plant_parameters_raise(values: dict[str, Any], why: str) -> None:
    with pytest.raises((CannotGenerate, Invalid), match=why):
        site_checks.make("plants", **values)


def test_plant_stand_is_generated_over_http(api: Api) -> None:
    format_names = ("gazebo", "occupancy_grid", "tmap2", "kml", "osm", "geojson", "octomap")
    version = site_checks.over_http(api, "plants", format_names, rows=2, columns=3, variants=1)
    assert version["information"]["objects"] == "generated"
    detail = api.problem(
        "POST", "environments/made-plants/generations", 422,
        json={"generator": "plants", "seed": 1, "parameters": {"rules": "axiom: F; F -> FF", "iterations": 40}},
    )  # fmt: skip
    assert "the L-system has more than 100000 symbols" in detail["detail"]
    assert detail["errors"][0]["where"] == "rules"
