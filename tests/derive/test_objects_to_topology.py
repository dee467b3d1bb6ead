"""Derivation of networks from objects: which lines count, on which level, and the error without any."""

from __future__ import annotations

from typing import Any

import pytest
import shapely

from app import derive, parameters
from app.derive.objects_to_topology import Parameters, objects_to_topology
from app.errors import Invalid, MissingLayer
from app.model.features import Features, features
from app.model.frame import Level
from app.model.layers import NETWORK, Layers, PartKey

PATH = shapely.LineString([(0, 0), (5, 0)])


def objects(geometry: Any, kind: str = "path", name: str = "a") -> Features:
    return features([(name, geometry, {"kind": kind})], "local")


def network(layers: Layers, **options: Any) -> dict[str, Features]:
    derived_layers = objects_to_topology(layers, Parameters(**options), derive.DerivationNotes())
    assert {k.layer for k in derived_layers.parts} == {"topology"}
    assert {k.name for k in derived_layers.parts} == {NETWORK}
    return {k.level: p for k, p in derived_layers.parts.items() if isinstance(p, Features)}


def test_each_level_gets_one_network() -> None:
    parts = {
        PartKey("objects", "ground", "kml"): objects(PATH),
        PartKey("objects", "ground", "geojson"): objects(shapely.LineString([(5, 0.05), (9, 9)])),
        PartKey("objects", "L2", "kml"): objects(PATH),
    }
    networks = network(Layers(parts, levels=(Level(), Level("L2", 4.0))))
    assert set(networks) == {"ground", "L2"}
    assert len(networks["ground"]) == 3 + 4, "two drawings meet at a node"
    assert {p["drawn_from"] for p in networks["ground"].properties} == {"a"}, "ids as the drawings have them"


def test_only_drawings_and_paths_count() -> None:
    parts = {
        PartKey("objects", "ground", "osm"): objects(PATH, "highway"),
        PartKey("objects", "ground", "openrmf"): objects(PATH, "wall"),
        PartKey("objects", "ground", "geojson"): objects(shapely.Polygon([(0, 0), (1, 0), (1, 1)]), "region"),
    }
    with pytest.raises(MissingLayer, match="drawn lines"):
        network(Layers(parts))
    assert len(network(Layers(parts), outlines=True)["ground"]) == 3 + 6
    parts[PartKey("objects", "ground", "openrmf")] = objects(PATH, "path")
    assert len(network(Layers(parts))["ground"]) == 2 + 2


def test_network_derivation_is_planned_and_validates_parameters() -> None:
    plan = derive.plan(frozenset({"objects"}), frozenset({"topology"}))
    assert plan is not None
    assert [s.name for s in plan.steps] == ["objects_to_topology"]
    derived_layers = derive.run(plan.steps, Layers({PartKey("objects", "ground", "kml"): objects(PATH)}))
    assert derived_layers.layers == {"objects", "topology"}
    with pytest.raises(Invalid, match="at most 100"):
        parameters.parse(Parameters, {"join": "1e9"})
