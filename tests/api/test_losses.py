"""What a format loses of a version: worked out from maps that are read back."""

from __future__ import annotations

import json
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from app.convert.losses import losses_recipe
from tests.api import samples
from tests.api.conftest import Api, running, settings_for

LOCAL = "urn:fleetmap:crs:local"


def losses(api: Api, env: str, fmt: str, query: str = "") -> dict[str, Any]:
    body: dict[str, Any] = api.get(f"environments/{env}/versions/latest/losses?format={fmt}{query}").json()
    assert body["report"]["format"] == fmt
    return body


def by_id(body: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return {item["id"]: item["properties"] for item in body["features"]}


@pytest.fixture
def site(api: Api, farm: str) -> str:
    """Add to the farm: a speed limit, a zone, an object, and a bend."""
    network = api.get(f"environments/{farm}/versions/3/layers/topology?crs=local").json()["features"]
    slower = next(item for item in network if item["id"] == "barn_field")
    slower |= {"coordRefSys": LOCAL}
    slower["properties"]["surface"] = "gravel"
    zone = feature("no_go", "Polygon", [[[1, 1], [2, 1], [2, 2], [1, 1]]], kind="keepout", name="No go")
    hut = feature("hut", "Polygon", [[[5, 5], [6, 5], [6, 6], [5, 5]]], kind="building", name="Hut", height=3.5)
    puts = [("topology", slower), ("zones", zone), ("objects", hut)]
    changes = [{"op": "put", "layer": layer, "feature": item} for layer, item in puts]
    api.post(f"environments/{farm}/edits", {"changes": changes})
    return farm


def feature(item: str, kind_of_shape: str, coordinates: Any, **properties: Any) -> dict[str, Any]:
    place = {"type": kind_of_shape, "coordinates": coordinates}
    return {"type": "Feature", "id": item, "geometry": None, "place": place, "properties": properties,
            "coordRefSys": LOCAL}  # fmt: skip


def test_geojson_loses_nothing(api: Api, site: str) -> None:
    body = losses(api, site, "geojson")
    assert body["features"] == []
    assert body["report"]["read"] is True
    assert [line["what"] for line in body["report"]["dropped"]] == ["occupancy"]


def test_features_that_do_not_come_back_are_deleted(api: Api, site: str) -> None:
    body = losses(api, site, "tmap2", "&crs=local")
    assert body["coordRefSys"] == LOCAL
    lost = by_id(body)
    assert {item: p["layer"] for item, p in lost.items() if p["change"] == "deleted"} == {
        "fence": "location", "hut": "objects", "no_go": "zones",
    }  # fmt: skip
    assert lost["hut"]["before"]["height"] == 3.5
    assert lost["hut"]["after"] is None
    assert lost["hut"]["fields"] == []
    place = next(item["place"] for item in body["features"] if item["id"] == "hut")
    assert place["coordinates"] == [[[5, 5], [6, 5], [6, 6], [5, 5]]]


def test_properties_that_do_not_come_back_are_fields(api: Api, site: str) -> None:
    stored = {f["id"]: f for f in api.get(f"environments/{site}/versions/4/layers/topology").json()["features"]}
    changed = {item: p for item, p in by_id(losses(api, site, "nav2_route")).items() if p["change"] == "changed"}
    assert {item for item, p in changed.items() if p["kind"] == "edge"} == {"barn_field"}
    edge = changed["barn_field"]
    assert edge["fields"] == ["surface"]
    assert edge["before"] == stored["barn_field"]["properties"]
    assert "surface" not in edge["after"]
    assert edge["before_geometry"] is None
    # an independent look at the maps themselves
    assert "gravel" not in api.get(f"environments/{site}/versions/4/maps/nav2_route").text
    assert "gravel" in api.get(f"environments/{site}/versions/4/maps/tmap2").text
    assert "changed" not in {p["change"] for p in by_id(losses(api, site, "tmap2")).values()}


def test_raster_format_loses_all_features(api: Api, site: str) -> None:
    body = losses(api, site, "occupancy_grid")
    layers = {layer: len(api.get(f"environments/{site}/versions/4/layers/{layer}").json()["features"])
              for layer in ("topology", "zones", "objects", "location")}  # fmt: skip
    assert len(body["features"]) == sum(layers.values())
    assert {item["properties"]["change"] for item in body["features"]} == {"deleted"}


def test_pages_level_and_condition(api: Api, site: str) -> None:
    whole = losses(api, site, "occupancy_grid")["features"]
    seen, cursor = [], ""
    while True:
        body = losses(api, site, "occupancy_grid", f"&limit=4{cursor}")
        assert body["numberMatched"] == len(whole)
        seen += body["features"]
        if "next" not in body:
            break
        cursor = f"&cursor={body['next']}"
    assert seen == whole
    assert losses(api, site, "occupancy_grid", "&level=ground")["features"] == whole
    path = f"environments/{site}/versions/4/losses?format=tmap2"
    api.get(path, 304, headers={"If-None-Match": api.get(path).headers["etag"]})
    tags = {api.get(f"{path}&crs={crs}").headers["etag"] for crs in ("local", "wgs84")}
    assert len(tags) == 2


def test_problems_say_what_to_do(api: Api, site: str, bare: str) -> None:
    path = f"environments/{site}/versions/4/losses"
    assert "format" in json.dumps(api.problem("GET", path, 422))
    assert "did you mean geojson" in api.problem("GET", f"{path}?format=geojsno", 422)["detail"]
    assert "available: ground" in api.problem("GET", f"{path}?format=kml&level=roof", 404)["detail"]
    assert "needs limit" in api.problem("GET", f"{path}?format=kml&cursor=x", 422)["detail"]
    api.upload(bare, {"n.tmap2.yaml": samples.tmap2()})
    assert "datum" in api.problem("GET", f"environments/{bare}/versions/1/losses?format=kml", 422)["detail"]
    assert losses(api, bare, "tmap2")["features"] == []


def test_long_comparison_is_a_job(tmp_path: Path) -> None:
    with running(settings_for(tmp_path, job_seconds=0.001)) as api:
        api.post("environments", {"name": "farm"})
        api.upload("farm", {"n.tmap2.yaml": samples.tmap2()})
        path = "environments/farm/versions/1/losses?format=geojson"
        answer = api.get(path, None)
        deadline = time.monotonic() + 60
        while answer.status_code == 202:
            job = api.get(answer.headers["location"]).json()
            assert job["state"] in ("queued", "running", "done"), job
            assert time.monotonic() < deadline
            time.sleep(0.05)
            answer = api.get(path, None)
        assert answer.json()["features"] == []
        while (done := api.get(f"jobs/{job['id']}").json())["state"] == "running":
            assert time.monotonic() < deadline
            time.sleep(0.05)
        assert (done["state"], done["result"]["location"]) == ("done", f"/api/v1/{path}")


def test_losses_may_share_a_lock_file_with_the_map(api: Api, farm: str) -> None:
    """The comparison waited for the map, and the map for the comparison."""
    maps, version = api.app.state.services.maps, api.app.state.services.store.versions.get(farm)
    recipe = maps.recipe(version, "geojson")
    compared = replace(losses_recipe(recipe), key=recipe.key[:2] + losses_recipe(recipe).key[2:])
    comparison = threading.Thread(target=maps.get_or_convert, args=[compared], daemon=True)
    comparison.start()
    comparison.join(120)
    assert not comparison.is_alive()
    assert maps.get_cached(compared) is not None


@pytest.mark.parametrize("fmt", ["geojson", "kml"])
def test_real_site_loses_nothing_in_drawings(api: Api, bare: str, shared: Path, fmt: str) -> None:
    folder = shared / "data/environment_template/riseholme_park_farm_strawberry_polytunnels"
    files = {str(p.relative_to(folder.parent)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}
    api.upload(bare, files)
    assert losses(api, bare, fmt)["features"] == []


def test_real_building_loses_what_the_report_counts(api: Api, bare: str, shared: Path) -> None:
    folder = shared / "data/openrmf_building/office"
    api.upload(bare, {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()})
    body = losses(api, bare, "rmf_nav_graph")
    dropped = {line["what"]: line["count"] for line in body["report"]["dropped"]}
    deleted = [p for p in by_id(body).values() if p["change"] == "deleted"]
    assert sum(p["layer"] == "topology" for p in deleted) == dropped["nodes without lanes"]
    assert sum(p["layer"] == "objects" for p in deleted) == dropped["objects that are neither doors nor lifts"]
