"""The property ``area`` of nodes: written where a format has a place for it, else reported as lost."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import shapely

from app import formats
from app.formats import FileGroup, ReadContext, WriteContext
from app.limits import Limits
from app.model.features import Features, features
from app.model.frame import Datum
from app.model.layers import NETWORK, Layers, PartKey
from app.syntax import yaml

TOPOLOGY = PartKey("topology", "ground", NETWORK)


def network() -> Layers:
    edge = {"kind": "edge", "source": "aisle-2", "target": "b"}
    rows = [
        ("aisle-2", shapely.Point(0, 0), {"kind": "node", "name": "aisle-2", "area": "aisle-2"}),
        ("b", shapely.Point(5, 0), {"kind": "node", "name": "b", "area": "Kitchen: wet floor"}),
        ("c", shapely.Point(5, 5), {"kind": "node", "name": "c"}),
        ("e", shapely.LineString([(0, 0), (5, 0)]), edge),
        ("f", shapely.LineString([(5, 0), (5, 5)]), {**edge, "source": "b", "target": "c"}),
    ]
    return Layers({TOPOLOGY: features(rows, "local")}, Datum(53.0, -0.5))


def written(name: str, layers: Layers) -> tuple[dict[str, bytes], WriteContext]:
    context = WriteContext()
    return formats.write(formats.get_format(name), layers, context), context


def read(name: str, files: dict[str, bytes]) -> Layers:
    return formats.read(FileGroup(formats.get_format(name), next(iter(files)), files), ReadContext())


def areas(layers: Layers) -> dict[str, object]:
    (part,) = layers.vector("topology").values()
    return {str(p.get("name")): p.get("area") for p in part.properties if p["kind"] == "node"}


@pytest.mark.parametrize("name", ["openrmf", "rmf_nav_graph", "nav2_route"])
def test_area_comes_back(name: str) -> None:
    files, context = written(name, network())
    assert not [one for one in context.dropped if "area" in one.subject]
    again = read(name, files)
    assert areas(again) == {"aisle-2": "aisle-2", "b": "Kitchen: wet floor", "c": None}


def test_building_has_it_as_a_typed_parameter_and_follows_edits() -> None:
    files, _ = written("openrmf", network())
    (level,) = yaml.load(next(iter(files.values())), Limits())["levels"].values()
    assert {row[3]: row[4]["area"] for row in level["vertices"] if len(row) > 4} == {
        "aisle-2": [1, "aisle-2"],
        "b": [1, "Kitchen: wet floor"],
    }
    before = read("openrmf", files)
    ((key, part),) = before.vector("topology").items()
    edited = [
        {k: v for k, v in p.items() if k != "area"} if p.get("name") == "b" else {**p, "area": "Hall"}
        for p in part.properties
        if p["kind"] == "node"
    ] + [p for p in part.properties if p["kind"] == "edge"]
    assert isinstance(part, Features)
    assert np.array_equal([p["kind"] for p in edited], [p["kind"] for p in part.properties])
    for name in ("openrmf", "rmf_nav_graph"):
        files, _ = written(
            name, Layers({**before.parts, key: replace(part, properties=tuple(edited))}, before.datum, before.levels)
        )
        again = read(name, files)
        assert areas(again) == {"aisle-2": "Hall", "b": None, "c": "Hall"}


@pytest.mark.parametrize(("name", "subject"), [("lif", "areas of nodes"), ("rmf_site", "vertices' area")])
def test_report_names_the_areas_that_are_lost(name: str, subject: str) -> None:
    _, context = written(name, network())
    assert {one.subject: one.count for one in context.dropped}[subject] == 2
    plain = network()
    part = plain.vector("topology")[TOPOLOGY]
    bare = [{k: v for k, v in p.items() if k != "area"} for p in part.properties]
    _, context = written(name, Layers({TOPOLOGY: replace(part, properties=tuple(bare))}, plain.datum))
    assert subject not in {one.subject for one in context.dropped}
