"""Semantic deltas: applied to the old version, they give the new one."""

from __future__ import annotations

import copy
import io
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from PIL import Image

from app.store.store import Store
from tests.api import samples
from tests.api.conftest import Api, running, settings_for

VECTORS = ("location", "objects", "topology", "zones")


@pytest.fixture(scope="module", params=["sqlite", pytest.param("postgres", marks=pytest.mark.postgres)])
def api(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Api]:
    """Run a server on each database."""
    more: dict[str, Any] = {}
    folder = tmp_path_factory.mktemp("delta")
    if request.param == "postgres":
        cluster = request.getfixturevalue("postgres_cluster")
        more["database_url"] = cluster.url(cluster.create_database())
        settings = settings_for(folder, **more)
        settings.blob_dir.mkdir(parents=True)
        store = Store(settings.database, settings.blob_dir)
        store.migrate()
        store.close()
    with running(settings_for(folder, **more)) as api:
        yield api


_cache: dict[Any, Any] = {}
"""Content of versions, which never changes."""


def features_of(api: Api, env: str, version: int, crs: str) -> dict[Any, Any]:
    key = api.url, env, version, crs
    if key not in _cache:
        _cache[key] = download_features(api, env, version, crs)
    return dict(_cache[key])


def download_features(api: Api, env: str, version: int, crs: str) -> dict[Any, Any]:
    out = {}
    for layer in VECTORS:
        for f in api.get(f"environments/{env}/versions/{version}/layers/{layer}?crs={crs}").json()["features"]:
            if f["properties"].get("kind") != "datum":
                out[layer, f["level"], f["part"], f["id"]] = f
    return out


def cells_of(api: Api, env: str, version: int, name: str) -> Any:
    """Return cells as Nav2 has them, row 0 at the bottom; None if there is no such grid."""
    key = api.url, env, version, name
    if key not in _cache:
        _cache[key] = download_cells(api, env, version, name)
    return copy.copy(_cache[key])


def download_cells(api: Api, env: str, version: int, name: str) -> Any:
    answer = api.get(f"environments/{env}/versions/{version}/layers/occupancy?name={name}", expect=None)
    if answer.status_code == 404:
        return None
    cells = np.flipud(np.array(Image.open(io.BytesIO(answer.content)))).astype(np.int16)
    cells[cells == 255] = -1
    return cells


def check(api: Api, env: str, since: int, to: int, crs: str, grids: tuple[str, ...] = ("map", "keepout")) -> Any:
    """Apply the delta like a robot."""
    delta = api.get(f"environments/{env}/versions/{to}/delta?since={since}&crs={crs}").json()
    have = features_of(api, env, since, crs) if not (crs == "wgs84" and since == 0) else {}
    for layer, change in delta["layers"].items():
        for item in change["deleted"]:
            del have[layer, item["level"], item["part"], item["id"]]
        for f in change["put"]["features"]:
            have[layer, f["level"], f["part"], f["id"]] = f
    assert have == features_of(api, env, to, crs)
    changed = {g["name"]: g for g in delta["grids"]}
    for name in grids:
        cells, target, change = cells_of(api, env, since, name), cells_of(api, env, to, name), changed.get(name)
        if change is None:
            assert cells is None or np.array_equal(cells, target)
        elif change["deleted"]:
            assert target is None
        elif change["whole"]:
            assert change["updates"] == []
            assert [change["frame"]["height"], change["frame"]["width"]] == list(target.shape)
        else:
            assert change["updates"]
            for u in change["updates"]:
                block = np.array(u["data"]).reshape(u["height"], u["width"])
                cells[u["y"] : u["y"] + u["height"], u["x"] : u["x"] + u["width"]] = block
            assert np.array_equal(cells, target)
    return delta


def edit(api: Api, env: str, *changes: dict[str, Any]) -> int:
    return int(api.post(f"environments/{env}/edits", {"changes": list(changes)}).json()["version"])


def square(x: float, y: float, side: float) -> dict[str, Any]:
    ring = [[x, y], [x + side, y], [x + side, y + side], [x, y + side], [x, y]]
    return {"type": "Polygon", "coordinates": [ring]}


def test_delta_turns_any_version_into_any_other(api: Api) -> None:
    env = "field"
    api.post("environments", {"name": env})
    api.upload(env, {"datum.yaml": samples.DATUM, "network.tmap2.yaml": samples.tmap2(), **samples.grid()})
    frame = api.get(f"environments/{env}/versions/1/layers/occupancy", headers={"accept": "application/json"}).json()
    (x, y, _), r = frame["origin"], frame["resolution"]
    cells = {"op": "cells", "crs": "local", "grid": "map"}
    edit(api, env, {**cells, "polygon": square(x, y, 3 * r), "value": 255})
    edit(
        api, env,
        {**cells, "polygon": square(x + r, y + r, 4 * r), "value": 37},
        {"op": "put", "layer": "zones", "crs": "local", "feature": {
            "type": "Feature", "id": "wet", "geometry": square(1, 1, 2), "properties": {"kind": "keepout"}}},
    )  # fmt: skip
    node = {"type": "Point", "coordinates": [1.25, -2.5]}
    last = edit(
        api, env,
        {"op": "delete", "layer": "zones", "id": "wet"},
        {"op": "put", "layer": "topology", "crs": "local", "feature": {
            "type": "Feature", "id": "dock", "geometry": node, "properties": {"kind": "node", "n": 1}}},
    )  # fmt: skip
    for since in range(last + 1):
        for to in range(1, last + 1):
            for crs in ("local", "wgs84"):
                check(api, env, since, to, crs)
    delta = check(api, env, 1, 2, "local")
    (grid,) = delta["grids"]
    (update,) = grid["updates"]
    assert (update["x"], update["y"], update["width"], update["height"]) == (0, 0, 3, 3)
    assert set(update["data"]) == {-1}
    assert grid["frame"] == {k: frame[k] for k in ("width", "height", "resolution", "origin")}
    assert delta["layers"] == {}
    assert delta["datum"]["changed"] is False
    assert delta["since"]["version"] == 1
    back = check(api, env, 3, 4, "wgs84")
    assert back["layers"]["zones"]["deleted"] == [{"id": "wet", "level": "ground", "part": "zones"}]
    assert [f["id"] for f in back["layers"]["topology"]["put"]["features"]] == ["dock"]
    same = api.get(f"environments/{env}/versions/latest/delta?since={last}").json()
    assert (same["layers"], same["grids"], same["other"]) == ({}, [], [])
    assert same["since"]["root"] == same["root"]


def test_delta_with_new_grid_frame_is_whole(api: Api) -> None:
    api.post("environments", {"name": "yard"})
    api.upload("yard", samples.grid())
    grown = {k: v.replace(b"resolution: 0.", b"resolution: 1.") for k, v in samples.grid().items()}
    api.upload("yard", grown)
    delta = check(api, "yard", 1, 2, "local")
    assert delta["grids"][0]["whole"] is True
    check(api, "yard", 2, 1, "local")
    frame_delta = check(api, "yard", 2, 0, "local")
    assert frame_delta["grids"] == [
        {"name": "map", "level": "ground", "deleted": True, "whole": False, "frame": None, "updates": []}
    ]


def test_delta_with_moved_datum_puts_all_features(api: Api) -> None:
    api.post("environments", {"name": "moved"})
    api.upload("moved", {"datum.yaml": samples.DATUM, "network.tmap2.yaml": samples.tmap2()})
    datum = api.get("environments/moved").json()["datum"]
    api("PATCH", "environments/moved", 200, json={"datum": {**datum, "latitude": datum["latitude"] + 0.01}})
    delta = check(api, "moved", 1, 2, "wgs84")
    assert delta["datum"]["changed"] is True
    nodes = api.get("environments/moved/versions/2/layers/topology").json()["features"]
    assert len(delta["layers"]["topology"]["put"]["features"]) == len(nodes)
    check(api, "moved", 1, 2, "local")
    check(api, "moved", 2, 1, "wgs84")


def test_delta_limits_size_and_refuses_bad_requests(api: Api, monkeypatch: pytest.MonkeyPatch) -> None:
    api.post("environments", {"name": "lawn"})
    api.upload("lawn", samples.grid())
    frame = api.get("environments/lawn/versions/1/layers/occupancy", headers={"accept": "application/json"}).json()
    (x, y, _), r = frame["origin"], frame["resolution"]
    edit(api, "lawn", {"op": "cells", "polygon": square(x, y, 3 * r), "value": 9, "crs": "local"})
    monkeypatch.setattr("app.api.changes.MAX_CELLS", 8)
    assert check(api, "lawn", 1, 2, "local")["grids"][0]["whole"] is True
    first = api.get("environments/lawn/versions/2/delta?since=1")
    tag = {"if-none-match": first.headers["etag"]}
    assert api.get("environments/lawn/versions/2/delta?since=1", 304, headers=tag).content == b""
    api.get("environments/lawn/versions/2/delta?since=0", 200, headers=tag)
    api.upload("lawn", {"network.tmap2.yaml": samples.tmap2()})
    api.problem("GET", "environments/lawn/versions/3/delta?since=1&crs=wgs84", 422)
    api.problem("GET", "environments/lawn/versions/3/delta", 422)
    api.problem("GET", "environments/lawn/versions/3/delta?since=77", 404)
    api.problem("GET", "environments/lawn/versions/3/delta?since=-1", 422)
