"""Choice of derivations: parameters come from the request, and a derivation that fails is replaced by another one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from app import derive
from app.convert.files import offline
from app.derive import DerivationNotes, derives
from app.errors import CannotConvert, CannotDerive, Invalid, MissingLayer
from app.model.grid import FREE, OCCUPIED, OccupancyGrid
from app.model.layers import Layers, PartKey
from app.parameters import parameter
from app.upload_reader import UploadHints
from tests.api.conftest import Api

SQUARE = b"""{"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {"name": "bed"},
"geometry": {"type": "Polygon", "coordinates":
[[[0.001, 0], [0.002, 0], [0.002, 0.001], [0.001, 0.001], [0.001, 0]]]}}]}
"""


@dataclass(frozen=True, slots=True)
class Blank:
    """Parameters of a test derivation."""

    side: int = parameter(4, "cells a side", minimum=1, maximum=100)


@dataclass(frozen=True, slots=True)
class Nothing:
    """Empty parameters."""


@pytest.fixture
def blank(monkeypatch: pytest.MonkeyPatch) -> None:
    """Add two derivations of a grid, of which the cheaper one always fails."""
    derivations = dict(derive.all_derivations())
    monkeypatch.setattr(derive._registry, "entries", {k: d for k, d in derivations.items() if d.gives != "occupancy"})

    @derives(gives="occupancy", needs={"objects"}, parameters=Blank, cost=5.0)
    def blank_grid(layers: Layers, parameters: Blank, notes: DerivationNotes) -> Layers:
        """Return a free square."""
        notes.warn("it is blank")
        notes.drop("objects", 1, "a blank grid shows none")
        cells = np.full((parameters.side, parameters.side), FREE, np.uint8)
        cells[0, 0] = OCCUPIED
        return Layers({PartKey("occupancy"): OccupancyGrid(cells, 0.5)}, layers.datum, layers.levels)

    @derives(gives="occupancy", needs={"objects"}, parameters=Nothing, cost=1.0)
    def never(layers: Layers, parameters: Nothing, notes: DerivationNotes) -> Layers:
        """Fail, like a derivation that finds nothing."""
        raise CannotConvert("there is nothing red among the objects")


def test_failed_derivation_falls_back_with_warnings(blank: None) -> None:
    converted = offline({"a.geojson": SQUARE}, "occupancy_grid", options={"side": "7"})
    assert b"7 7" in converted.files["map.pgm"][:20]
    line = next(line for line in converted.report.as_dict()["layers"] if line["layer"] == "occupancy")
    assert line["information"] == "derived"
    assert line["sources"] == ["a.geojson"]
    assert line["steps"] == [{"step": "blank_grid", "from": ["objects"], "to": "occupancy", "parameters": {"side": 7}}]
    assert {"problem": "it is blank"} in converted.report.as_dict()["warnings"]
    assert {"what": "objects", "count": 1, "why": "a blank grid shows none"} in converted.report.as_dict()["dropped"]


def test_failure_of_all_derivations_lists_every_reason(blank: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(derive._registry.entries, "blank_grid")
    with pytest.raises(MissingLayer, match="nothing red") as caught:
        offline({"a.geojson": SQUARE}, "occupancy_grid")
    assert "supply an occupancy grid" in caught.value.detail


def test_parameter_derives_a_stored_layer_again(blank: None) -> None:
    yaml = b"image: map.pgm\nresolution: 0.5\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    files = {"map.yaml": yaml, "map.pgm": b"P5 2 1 255\n\0\xfe", "a.geojson": SQUARE}
    stored = offline(files, "occupancy_grid")
    assert [entry["information"] for entry in stored.report.as_dict()["layers"] if entry["layer"] == "occupancy"] == [
        "raw"
    ]
    converted = offline(files, "occupancy_grid", options={"side": "3"})
    assert b"3 3" in converted.files["map.pgm"][:20]
    assert [
        entry["information"] for entry in converted.report.as_dict()["layers"] if entry["layer"] == "occupancy"
    ] == ["derived"]
    with pytest.raises(Invalid, match="side"):
        offline(files, "occupancy_grid", options={"side": "3"}, derived=False)


def test_invalid_parameters_are_named(blank: None) -> None:
    with pytest.raises(Invalid, match="at least 1"):
        offline({"a.geojson": SQUARE}, "occupancy_grid", options={"side": "0"})
    with pytest.raises(Invalid, match="colour") as caught:
        offline({"a.geojson": SQUARE}, "occupancy_grid", options={"colour": "red"})
    assert [p.where for p in caught.value.problems] == ["colour"]
    with pytest.raises(Invalid, match="outlines"):  # a parameter of a derivation, but of none in this chain
        offline({"a.geojson": SQUARE}, "datum", options={"outlines": "true"}, hints=UploadHints(layer="location"))


def test_failing_step_is_named() -> None:
    step = derive.plan(frozenset({"objects"}), frozenset({"topology"}))
    assert step is not None
    with pytest.raises(CannotDerive) as caught:
        derive.run([s for s in step.steps if s.name == "objects_to_topology"], Layers())
    assert caught.value.step == "objects_to_topology"


def test_derivation_parameters_are_read_from_the_query(api: Api) -> None:
    api.post("environments", {"name": "beds"})
    api.upload("beds", {"a.geojson": SQUARE})
    refused: Any = api.get("/maps/beds/tmap2?join=0.5", expect=None)
    assert refused.status_code == 422
    assert "outlines=true" in refused.json()["detail"]
    again: Any = api.get("/maps/beds/tmap2?join=0.5", expect=None)
    assert again.status_code == 422, "the failed attempt is cached"
    got = api.get("/maps/beds/tmap2?outlines=true")
    assert got.content.count(b"- meta:") == 4
    report = api.get("environments/beds/versions/1/reports/tmap2?outlines=true").json()
    line = next(line for line in report["layers"] if line["layer"] == "topology")
    assert line["steps"][0]["parameters"] == {"join": 0.1, "outlines": True}
    assert api.get("/maps/beds/tmap2?outlines=perhaps", expect=None).status_code == 422
    report = api.get("environments/beds/versions/1/reports/kml").json()
    assert "topology" not in {line["layer"] for line in report["layers"]}
    report = api.get("environments/beds/versions/1/reports/kml?outlines=true").json()
    assert {"objects", "topology"} <= {line["layer"] for line in report["layers"]}, "the request was for a network"
    assert api.get("/maps/beds/datum?outlines=true", expect=None).status_code == 422, (
        "no step of the chain has the parameter"
    )
    table = {row["format"]: row for row in api.get("environments/beds/versions/1/maps").json()}
    assert table["tmap2"]["state"] in ("missing", "derivable")


ROOM = b"P5\n40 40\n255\n" + b"".join(
    bytes(0 if r in (0, 39) or c in (0, 39) else 254 for c in range(40)) for r in range(40)
)


def test_several_grids_require_a_name(api: Api) -> None:
    api.post("environments", {"name": "two-grids"})
    for name in ("coarse", "fine"):
        size = b"0.2" if name == "coarse" else b"0.1"
        map_yaml = b"image: %s.pgm\nresolution: %s\norigin: [0, 0, 0]\nnegate: 0\n" % (name.encode(), size)
        more = b"occupied_thresh: 0.65\nfree_thresh: 0.196\n"
        api.upload("two-grids", {f"{name}.yaml": map_yaml + more, f"{name}.pgm": ROOM}, grid=name)
    rows = {row["format"]: row for row in api.get("environments/two-grids/versions/latest/maps").json()}
    assert rows["tmap2"]["state"] == "derivable"
    assert rows["tmap2"]["chain"][0]["step"] == "occupancy_to_topology"
    assert rows["tmap2"]["choose"].endswith("(coarse, fine): name one with grid=…")
    refused = api.get("/maps/two-grids/tmap2", 409)
    assert refused.json()["detail"] == rows["tmap2"]["choose"]
    assert b"- meta:" in api.get("/maps/two-grids/tmap2?grid=fine").content


def test_grid_becomes_a_world_of_objects_with_context(api: Api) -> None:
    """Its cells become walls by default, without a derivation; a parameter of a derivation requests that one."""
    cells = np.full((60, 80), 254, np.uint8)
    y, x = np.mgrid[:60, :80]
    for cx, cy in ((20, 20), (60, 30)):
        cells[(x - cx) ** 2 + (y - cy) ** 2 <= 16] = 0
    described = b"image: map.pgm\nresolution: 0.05\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\n"
    api.post("environments", {"name": "copse"})
    grid = {"map.yaml": described + b"free_thresh: 0.196\n", "map.pgm": b"P5 80 60 255\n" + cells.tobytes()}
    api.upload("copse", grid)
    row = next(r for r in api.get("environments/copse/versions/1/maps").json() if r["format"] == "gazebo")
    assert (row["state"], row["chain"]) == ("direct", [])
    assert b"<cylinder>" not in api.get("environments/copse/versions/1/maps/gazebo/world.sdf").content
    world = api.get("environments/copse/versions/1/maps/gazebo/world.sdf?context=forest").content
    assert world.count(b"<model name='tree") + world.count(b'<model name="tree') == 2, world.decode()[:2000]
    assert b"<cylinder>" in world
    assert b"<mesh>" not in world, "otherwise the walls of the cells would be duplicated"
    report = api.get("environments/copse/versions/1/reports/gazebo?context=forest").json()
    (line,) = [entry for entry in report["layers"] if entry["layer"] == "objects"]
    assert line["steps"][0]["step"] == "occupancy_to_objects"
    assert line["steps"][0]["parameters"]["context"] == "forest"
    wrong = api.problem("GET", "environments/copse/versions/1/maps/gazebo?context=moon", 422)
    assert "forest" in wrong["detail"]
    wrong = api.problem("GET", "environments/copse/versions/1/maps/gazebo?contexts=forest", 422)
    assert "context" in wrong["detail"], "the accepted values are listed"
