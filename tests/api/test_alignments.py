"""Grid alignment over HTTP."""

from __future__ import annotations

import io
import math
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.api.conftest import Api
from tests.model.test_alignment import hall


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
