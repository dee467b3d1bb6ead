"""Grid alignment over HTTP."""

from __future__ import annotations

import io
import math
from typing import Any

import numpy as np
import pytest
from PIL import Image

from app.model.grid import OccupancyGrid
from tests.api.conftest import Api
from tests.model.test_alignment import hall
from tests.model.test_stitching import piece


def files(name: str, origin: list[float]) -> dict[str, bytes]:
    grid = hall(0.1)
    out = io.BytesIO()
    Image.fromarray(np.where(grid.cells[::-1] == 100, 0, 254).astype(np.uint8)).save(out, "PNG")
    text = (
        f"image: {name}.png\nresolution: 0.1\norigin: {origin}\noccupied_thresh: 0.65\nfree_thresh: 0.196\nnegate: 0\n"
    )
    return {f"{name}.yaml": text.encode(), f"{name}.png": out.getvalue()}


@pytest.fixture
def env(api: Api, request: pytest.FixtureRequest) -> str:
    name = f"al-{abs(hash(request.node.name)) % 10**9}"
    api.post("environments", {"name": name})
    api.upload(name, files("map", [-3.0, 2.0, 0.0]))
    api.upload(name, files("other", [4.0, -1.0, 0.3]), grid="other")
    return name


def origin(api: Api, env: str, grid: str) -> list[float]:
    text = api.get(f"environments/{env}/versions/latest/maps/occupancy_grid/{grid}.yaml").text
    line = next(row for row in text.splitlines() if row.startswith("origin:"))
    return [float(v) for v in line.removeprefix("origin:").strip(" []").split(",")]


def align(api: Api, env: str, expect: int = 201, **body: Any) -> Any:
    return api.post(f"environments/{env}/alignments", {"grid": "other", **body}, expect=expect).json()


def test_alignment_with_another_grid_keeps_cells(api: Api, env: str) -> None:
    preview = align(api, env, 200, onto={"name": "map"}, dry_run=True)
    assert preview["version"] is None
    assert origin(api, env, "other") == [4.0, -1.0, 0.3], "a dry run changes nothing"
    before = api.get(f"environments/{env}/versions/latest/maps/occupancy_grid/other.pgm").content
    result = align(api, env, onto={"name": "map"}, message="by its walls")
    alignment = result["alignment"]
    assert alignment == preview["alignment"]
    assert result["version"]["message"] == "by its walls"
    assert alignment["yaw"] == pytest.approx(-0.3, abs=math.radians(0.2))
    assert (alignment["agreement"], alignment["overlap"]) == (1.0, pytest.approx(1.0, abs=0.02))
    assert alignment["before"] == [4.0, -1.0, 0.3]
    assert origin(api, env, "other") == pytest.approx([-3.0, 2.0, 0.0], abs=0.05)
    assert api.get(f"environments/{env}/versions/latest/maps/occupancy_grid/other.pgm").content == before
    assert any("only the grid moves" in w["problem"] for w in result["warnings"])
    layers = api.get(f"environments/{env}/versions/latest/layers").json()
    assert next(row for row in layers if row["name"] == "other")["information"] == "raw"
    report = api.get(f"environments/{env}/versions/latest/reports/occupancy_grid?grid=other").json()
    assert report["layers"][0]["steps"][-1]["step"] == "aligned"


def test_alignment_by_points_is_idempotent(api: Api, env: str) -> None:
    pairs = [[[4, -1], [0, 0]], [[5, -1], [1, 0]], [[4, 3], [0, 4]], [[0, 0], [9, 9]]]
    key = {"idempotency-key": "twice"}
    body = {"grid": "other", "pairs": pairs}
    first = api("POST", f"environments/{env}/alignments", 201, json=body, headers=key).json()
    assert (first["alignment"]["x"], first["alignment"]["y"]) == pytest.approx((-4, 1))
    assert first["alignment"]["disagreeing"] == [3]
    assert origin(api, env, "other") == pytest.approx([0, 0, 0.3], abs=1e-9)
    again = api("POST", f"environments/{env}/alignments", 201, json=body, headers=key).json()
    assert again["version"]["version"] == first["version"]["version"]
    assert again["alignment"] == first["alignment"]
    same = align(api, env, 200, pairs=[[[0, 0], [0, 0]], [[1, 0], [1, 0]]])
    assert same["version"]["version"] == first["version"]["version"], "nothing moved"


def test_alignment_with_a_slice_of_objects(api: Api, env: str) -> None:
    wall = '{"type":"Feature","properties":{"kind":"wall"},"geometry":null,"place":{"type":"LineString",'
    wall += '"coordinates":[%s]}}'
    # Walls of the hall by their centre lines, in local metres.
    lines = ["[-3,2.05],[9,2.05]", "[-3,9.95],[9,9.95]", "[-2.95,2],[-2.95,10]", "[8.95,2],[8.95,10]",
             "[1.05,2],[1.05,7]", "[1,7.05],[4,7.05]"]  # fmt: skip
    crs = "http://www.opengis.net/def/crs/OGC/0/Engineering2D"
    body = ",".join(wall % line for line in lines)
    text = f'{{"type":"FeatureCollection","coordRefSys":"{crs}","features":[{body}]}}'
    api.upload(env, {"walls.geojson": text.encode()})
    result = align(api, env, onto={"layer": "objects", "parameters": {"resolution": 0.1}}, near=0.15)
    assert result["alignment"]["origin"] == pytest.approx([-3.0, 2.0, 0.0], abs=0.1)
    refused = align(api, env, 422, onto={"layer": "objects", "parameters": {"colour": 1}})
    assert refused["errors"][0]["where"] == "body.onto.parameters.colour"


def test_impossible_alignments_are_refused(api: Api, env: str) -> None:
    align(api, env, 422)
    align(api, env, 422, onto={}, pairs=[[[0, 0], [0, 0]], [[1, 0], [1, 0]]])
    align(api, env, 422, onto={"name": "other"})
    assert "other" in align(api, env, 404, grid="moon", onto={})["detail"]
    align(api, env, 404, onto={"name": "moon"})
    align(api, env, 422, onto={"layer": "voxels"})
    align(api, env, 422, pairs=[[[0, 0], [0, 0]], [[0, 0], [0, 0]]])
    align(api, env, 422, pairs=[[[0, 0], [0, 0]]])
    align(api, env, 422, onto={}, near=-1)
    assert align(api, env, 422, onto={}, angle=1, reach=0)["detail"]
    pairs = [[[4, -1], [0, 0]], [[5, -1], [1, 0]], [[4, 3], [0, 4]], [[0, 0], [9, 9]]]
    assert "do not fit" in align(api, env, 422, pairs=pairs, least=0.9)["detail"]
    preview = align(api, env, 200, pairs=pairs, least=0.9, dry_run=True)
    assert any("do not fit" in w["problem"] for w in preview["warnings"])


def elsewhere() -> OccupancyGrid:
    """Return a grid of another place: blocks of 0.3 m in an open field."""
    cells = np.zeros((60, 60), np.uint8)
    for row, column in np.random.default_rng(2).integers(2, 56, (25, 2)):
        cells[row : row + 3, column : column + 3] = 100
    return OccupancyGrid(cells, 0.1, (-3.0, -3.0, 0.0))


def piece_files(name: str, view: tuple[float, float, float] | None) -> dict[str, bytes]:
    """Return what a robot saw of the hall between two x, turned by degrees, or elsewhere."""
    grid = elsewhere() if view is None else piece(hall(0.1), *view)
    shades = np.select([grid.cells == 100, grid.cells == 0], [0, 254], 205).astype(np.uint8)
    out = io.BytesIO()
    Image.fromarray(shades[::-1]).save(out, "PNG")
    lines = f"image: {name}.png\nresolution: 0.1\norigin: {list(grid.origin)}\nnegate: 0\n"
    return {
        f"{name}.yaml": f"{lines}occupied_thresh: 0.65\nfree_thresh: 0.196\n".encode(),
        f"{name}.png": out.getvalue(),
    }


@pytest.fixture
def robots(api: Api, request: pytest.FixtureRequest) -> str:
    """Return an environment with the grids of two robots, and one of another place."""
    name = f"mg-{abs(hash(request.node.name)) % 10**9}"
    api.post("environments", {"name": name})
    api.upload(name, piece_files("one", (-3.0, 3.5, 10.0)), grid="one")
    api.upload(name, piece_files("two", (0.5, 9.0, 80.0)), grid="two")
    api.upload(name, piece_files("apart", None), grid="apart")
    return name


def merge(api: Api, env: str, expect: int = 201, headers: dict[str, str] | None = None, **body: Any) -> Any:
    body = {"merge": {"grids": ["one", "two"], **body.pop("merge", {})}, **body}
    return api("POST", f"environments/{env}/alignments", expect, json=body, headers=headers).json()


def grid_names(api: Api, env: str) -> set[str]:
    rows = api.get(f"environments/{env}/versions/latest/layers").json()
    return {row["name"] for row in rows if row["layer"] == "occupancy"}


def test_merge_lays_grids_of_robots_into_one(api: Api, robots: str) -> None:
    preview = merge(api, robots, 200, merge={"name": "site"}, dry_run=True)
    assert preview["version"] is None
    assert preview["alignment"] is None
    assert grid_names(api, robots) == {"one", "two", "apart"}, "a dry run changes nothing"
    tried = f"environments/{robots}/versions/{preview['dry_run']['id']}"
    assert api.get(f"{tried}/preview.png").content.startswith(b"\x89PNG"), "a dry run can be looked at"
    result = merge(api, robots, merge={"name": "site"}, message="two robots")
    report = result["merge"]
    assert report == preview["merge"]
    assert grid_names(api, robots) == {"one", "two", "apart", "site"}
    two = report["grids"][1]
    assert math.degrees(two["yaw"]) == pytest.approx(70.0, abs=0.5)
    # 4.5 m along the hall's x, seen in the first robot's frame, which is turned by 10 degrees
    assert (two["x"], two["y"]) == pytest.approx(
        (4.5 * math.cos(math.radians(10)), -4.5 * math.sin(math.radians(10))), abs=0.1
    )
    assert two["agreement"] > 0.9
    assert 0 < two["residual"] < 0.1
    assert (report["resolution"], report["freed"]) == (0.1, 0)
    known = report["cells"]["occupied"] + report["cells"]["free"]
    assert known * 0.01 == pytest.approx(96.0, rel=0.05), "all of the hall, and nothing else"
    layers = api.get(f"environments/{robots}/versions/latest/layers").json()
    assert next(row for row in layers if row["name"] == "site")["information"] == "raw"
    steps = api.get(f"environments/{robots}/versions/latest/reports/occupancy_grid?grid=site").json()["layers"][0][
        "steps"
    ]
    assert steps[-1]["step"] == "merged"
    again = merge(api, robots, 200, merge={"name": "site"})
    assert again["version"]["version"] == result["version"]["version"], "nothing changed"


def test_merge_replaces_first_grid_and_is_undone_by_a_revert(api: Api, robots: str) -> None:
    before = api.get(f"environments/{robots}/versions/latest").json()
    pgm = api.get(f"environments/{robots}/versions/latest/maps/occupancy_grid/one.pgm").content
    key = {"idempotency-key": "merge-once"}
    result = merge(api, robots, headers=key, merge={"drop": True, "seam": "newest"})
    assert result["version"]["message"] == "Merged the grids one, two of ground"
    assert grid_names(api, robots) == {"one", "apart"}
    assert merge(api, robots, headers=key, merge={"drop": True, "seam": "newest"})["merge"] == result["merge"]
    merge(api, robots, 412, headers={"if-match": f'"{before["version"]}"'}, merge={"grids": ["one", "apart"]})
    api.post(f"environments/{robots}/versions", {"revert_to": before["version"]}, expect=201)
    assert grid_names(api, robots) == {"one", "two", "apart"}
    assert api.get(f"environments/{robots}/versions/latest/maps/occupancy_grid/one.pgm").content == pgm


def test_merged_grid_keeps_the_steps_of_its_sources(api: Api, env: str) -> None:
    """A part that a generator made up stays visible as such."""
    size = {"width": 8.0, "depth": 8.0, "resolution": 0.1}
    hall = {"generator": "cluttered_hall", "seed": 7, "parameters": size, "replace": True}
    api.post(f"environments/{env}/generations", hall)
    align(api, env, pairs=[[[4, -1], [0, 0]], [[5, -1], [1, 0]]])
    stays = [[[0, 0], [0, 0]], [[1, 0], [1, 0]]]
    result = merge(api, env, merge={"grids": ["map", "other"], "name": "site", "pairs": {"other": stays}})
    (warning,) = [w["problem"] for w in result["warnings"] if "information" in w["problem"]]
    assert "map: generated, other: raw" in warning
    assert steps_of(api, env, "site") == ["cluttered_hall", "aligned", "merged"]
    merge(api, env, merge={"grids": ["site", "map"], "name": "all", "pairs": {"map": stays}})
    assert steps_of(api, env, "all") == ["cluttered_hall", "aligned", "merged", "merged"]


def steps_of(api: Api, env: str, grid: str) -> list[str]:
    lines = api.get(f"environments/{env}/versions/latest/reports/occupancy_grid?grid={grid}").json()["layers"]
    return [step["step"] for line in lines if line["layer"] == "occupancy" for step in line["steps"]]


def test_merge_refuses_what_it_cannot_decide(api: Api, robots: str) -> None:
    apart = {"grids": ["one", "apart"]}
    refused = merge(api, robots, 422, merge=apart)
    assert "apart: " in refused["detail"]
    assert "give pairs" in refused["detail"]
    assert refused["errors"][0]["where"] == "body.merge.grids.1"
    preview = merge(api, robots, 200, merge=apart, dry_run=True)
    assert preview["version"] is None
    assert "problem" in preview["merge"]["grids"][1]
    assert any("apart: " in w["problem"] for w in preview["warnings"])
    # a place 6 m to the right of the hall's middle, in a frame that is turned by 10 degrees
    c, s = math.cos(math.radians(10)), math.sin(math.radians(10))
    pairs = [[[0, 0], [6.25 * c, -6.25 * s]], [[1, 0], [7.25 * c, -7.25 * s]]]
    placed = merge(api, robots, merge={**apart, "pairs": {"apart": pairs}, "name": "both"})
    assert math.degrees(placed["merge"]["grids"][1]["yaw"]) == pytest.approx(-10.0, abs=1e-3)
    assert any("do not confirm" in w["problem"] for w in placed["warnings"])
    assert grid_names(api, robots) == {"one", "two", "apart", "both"}


def test_merge_with_bad_members_is_refused(api: Api, robots: str) -> None:
    wrong: list[tuple[int, dict[str, Any], str]] = [
        (422, {"grids": ["one", "one"]}, "named twice"),
        (422, {"grids": ["one"]}, "at least 2"),
        (404, {"grids": ["one", "moon"]}, "available: ground/apart"),
        (409, {"name": "apart"}, "another grid has the name"),
        (422, {"name": "a/b"}, "slash"),
        (422, {"poses": {"one": [0, 0, 0]}}, "stays where it is"),
        (422, {"poses": {"apart": [0, 0, 0]}}, "not one of the grids"),
        (422, {"pairs": {"two": [[[0, 0], [0, 0]], [[0, 0], [0, 0]]]}}, "same position"),
        (422, {"pairs": {"two": [[[0, 0], [9e6, 0]], [[1, 0], [9e6, 1]]]}}, "the limit is"),
        (422, {"poses": {"two": [0, 0, 1e9]}}, "360"),
        (422, {"seam": "best"}, "evidence"),
    ]
    for status, members, expected in wrong:
        detail = merge(api, robots, status, merge=members)
        assert expected in str(detail), members
    excluded: list[dict[str, Any]] = [
        {"grid": "two"},
        {"onto": {}},
        {"pairs": [[[0, 0], [0, 0]], [[1, 0], [1, 0]]]},
    ]
    for words in excluded:
        assert "cannot be combined with merge" in merge(api, robots, 422, **words)["detail"]
    assert "Grids of one level are merged" in merge(api, robots, 404, level="L2")["detail"]
    assert merge(api, robots, 422, merge={"poses": {"two": [0, 0, 0]}}, angle=1, reach=0.1)["detail"]
    assert grid_names(api, robots) == {"one", "two", "apart"}
