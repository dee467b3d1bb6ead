"""Closures in maps: in force on every channel at once, removed at their end, never part of a version."""

from __future__ import annotations

import json
import zipfile
from io import BytesIO
from typing import Any

import numpy as np
import pytest
import yaml

from app import formats
from app.model.closures import closures_digest
from tests.api import samples
from tests.api.conftest import Api

SQUARE = {"type": "Polygon", "coordinates": [[[4, -1], [6, -1], [6, 1], [4, 1], [4, -1]]]}
"""Polygon across the lane between gate and barn, in metres."""

KEEPOUT_FILTER = (
    b"costmap_filter_info_server:\n  ros__parameters:\n    type: 0\n    filter_info_topic: /wet_info\n"
    b"    mask_topic: /wet_mask\n    base: 0.0\n    multiplier: 1.0\n"
)
"""Parameters of a costmap filter whose mask marks where robots must not drive."""

NO_CLOSURES = closures_digest([])


def close(api: Api, env: str, **fields: Any) -> dict[str, Any]:
    overlay: dict[str, Any] = api.post(
        f"environments/{env}/overlays", {"kind": "blocked", "state": "accepted", **fields}
    ).json()
    return overlay


def end(api: Api, env: str, overlay: dict[str, Any]) -> None:
    api.post(f"environments/{env}/overlays/{overlay['id']}/end", expect=200)


def edges(text: str) -> set[str]:
    return {e["edge_id"] for n in yaml.safe_load(text)["nodes"] for e in n["node"]["edges"]}


def promote(api: Api, env: str, version: int, channel: str = "production") -> None:
    api("PUT", f"environments/{env}/channels/{channel}", 200, json={"version": version})


def test_closed_edge_leaves_every_channel_and_comes_back(api: Api, farm: str) -> None:
    promote(api, farm, 2)
    promote(api, farm, 3, "staging")
    short = f"/maps/{farm}/tmap2"
    before = api.get(short)
    assert before.headers["fleetmap-overlays"] == NO_CLOSURES
    closure = close(api, farm, edge="gate_barn")
    places = [short, *(f"environments/{farm}/versions/{v}/maps/tmap2" for v in ("production", "staging", "latest"))]
    for place in places:
        answer = api.get(place)
        assert edges(answer.text) == {"barn_gate", "barn_field"}, place
        assert answer.headers["fleetmap-overlays"] != NO_CLOSURES
    assert api.get(short).headers["etag"] != before.headers["etag"]
    history = api.get(f"environments/{farm}/versions/2/maps/tmap2")
    assert edges(history.text) == {"gate_barn", "barn_gate", "barn_field"}
    assert "fleetmap-overlays" not in history.headers
    assert history.headers["etag"] == before.headers["etag"], "equal content has an equal tag"
    assert edges(api.get(f"environments/{farm}/versions/2/maps/tmap2?closures=apply").text) == {
        "barn_gate", "barn_field"
    }  # fmt: skip
    assert "gate_barn" in edges(api.get(f"{short}?closures=ignore").text)
    assert "gate_barn" in edges(api.get(f"{short}?closures=mark").text)
    assert "closures must be one of" in api.problem("GET", f"{short}?closures=odd", 422)["detail"]
    end(api, farm, closure)
    after = api.get(short)
    assert (after.content, after.headers["etag"]) == (before.content, before.headers["etag"])


def test_manifest_lists_closures_and_a_higher_sequence(api: Api, farm: str) -> None:
    promote(api, farm, 3)
    place = f"environments/{farm}/versions/production/manifest?formats=tmap2"
    before = api.get(place).json()
    assert before["overlays_digest"] == NO_CLOSURES
    assert not {"overlays", "epoch", "missing"} & before.keys(), "empty members are omitted"
    one = close(api, farm, edge="gate_barn", detail="a tree")
    two = close(api, farm, edge="barn_field")
    now = api.get(place).json()
    listed = [
        {"id": o["id"], "kind": "blocked", "level": "ground", "edge": o["edge"], "expires": o["expires"]}
        | ({"detail": o["detail"]} if "detail" in o else {})
        for o in sorted((one, two), key=lambda o: str(o["id"]))
    ]
    assert now["overlays"] == listed
    assert (
        now["overlays_digest"] == closures_digest(listed) == api.get(f"/maps/{farm}/tmap2").headers["fleetmap-overlays"]
    )
    assert now["sequence"] == before["sequence"] + 2
    assert (now["version"], now["root"]) == (before["version"], before["root"])
    assert now["files"] != before["files"]
    number = f"environments/{farm}/versions/3/manifest?formats=tmap2"
    assert "overlays" not in api.get(number).json()
    applied = api.get(f"{number}&closures=apply").json()
    assert (applied["files"], applied["overlays"]) == (now["files"], now["overlays"])
    for overlay in (one, two):
        end(api, farm, overlay)
    again = api.get(place).json()
    assert (again["files"], again["sequence"]) == (before["files"], before["sequence"] + 4)
    assert "overlays" not in again


def test_manifest_signs_what_was_requested(api: Api, farm: str) -> None:
    """Otherwise a proxy could request a map without closures in the robot's name."""
    close(api, farm, edge="gate_barn")
    place = f"environments/{farm}/versions/latest/manifest?formats="
    assert not {"closures", "parameters"} & api.get(f"{place}tmap2").json().keys()
    assert api.get(f"{place}tmap2&closures=ignore").json()["closures"] == "ignore"
    assert api.get(f"environments/{farm}/versions/3/manifest?formats=tmap2").json()["closures"] == "ignore"
    assert "closures" not in api.get(f"environments/{farm}/versions/3/manifest?formats=tmap2&closures=apply").json()
    body = api.get(f"{place}tmap2%3Fclosures%3Dmark,geojson,occupancy_grid%3Fgrid%3Dmap%26derive%3Dfalse").json()
    assert body["parameters"] == {
        "tmap2": {"closures": "mark"}, "occupancy_grid": {"grid": "map", "derive": "false"}
    }  # fmt: skip


def test_area_closes_masks_and_the_edges_that_cross_it(api: Api, farm: str) -> None:
    promote(api, farm, 3)
    mask = f"/maps/{farm}/occupancy_grid/keepout.pgm"
    api.problem("GET", mask, 404)
    closure = close(api, farm, polygon={"type": "Polygon", "coordinates": [[[0, -1], [2, -1], [2, 0.5], [0, -1]]]},
                    crs="local")  # fmt: skip
    cells = pgm(api.get(mask).content)
    assert 3 < (cells == 0).sum() < 20, "black is keepout, in the frame of the map"
    assert edges(api.get(f"/maps/{farm}/tmap2").text) == {"barn_field"}, "both directions of the lane are closed"
    report = api.get(f"environments/{farm}/versions/production/reports/tmap2").json()
    (line,) = report["closures"]
    assert (line["id"], line["effect"], line["edges"]) == (
        closure["id"],
        "left out 2 edges",
        ["barn_gate", "gate_barn"],
    )
    assert {"what": "blocked edges", "count": 2} in [
        {k: d[k] for k in ("what", "count")} for d in report["dropped"]
    ]  # fmt: skip
    (zone,) = [f for f in api.get(f"/maps/{farm}/geojson").json()["features"] if f["id"] == f"overlay-{closure['id']}"]
    assert (zone["properties"]["kind"], zone["properties"]["expires"]) == ("keepout", closure["expires"])
    end(api, farm, closure)
    api.problem("GET", mask, 404)


@pytest.mark.parametrize("name", ["keepout", "nogo", "depot_keepout", "wet_floor"])
def test_stored_mask_gets_closed_areas_and_grows_where_they_reach_beyond_it(api: Api, farm: str, name: str) -> None:
    """Robots are told to use the mask nogo if there is one; the filter of another mask says what it is."""
    filter_info = {} if name != "wet_floor" else {f"{name}_filter_info.yaml": KEEPOUT_FILTER}
    api.upload(farm, {**samples.grid(name), **filter_info}, grid=name)
    place = f"/maps/{farm}/occupancy_grid/{name}.pgm"
    tag = api.get(place).headers["etag"]
    before, size = pgm(api.get(place).content), yaml.safe_load(api.get(place.replace("pgm", "yaml")).content)
    close(api, farm, polygon=SQUARE, crs="local")
    after, grown = pgm(api.get(place).content), yaml.safe_load(api.get(place.replace("pgm", "yaml")).content)
    assert api.get(place).headers["etag"] != tag
    assert grown["origin"] == size["origin"]
    assert after.shape == (6, 14), "from x = -1 to x = 6, cells of half a metre"
    assert np.array_equal(after[:, :8], before)
    free = 254
    assert (after[:4, 10:] == 0).all(), "from y = -1 to y = 1, the upper edge of the grid"
    assert (after[5, 10:] == free).all()
    assert (after[:, 8:9] == free).all()
    (line,) = api.get(f"environments/{farm}/versions/latest/reports/occupancy_grid?grid={name}").json()["closures"]
    assert line["effect"] == "keepout cells"


def test_closed_areas_in_degrees_and_without_a_place(api: Api, farm: str, bare: str) -> None:
    lon, lat = samples.LONGITUDE + 5 / 66700, samples.LATITUDE
    d = 1e-5
    ring = [[lon - d, lat - d], [lon + d, lat - d], [lon + d, lat + d], [lon - d, lat + d], [lon - d, lat - d]]
    close(api, farm, polygon={"type": "Polygon", "coordinates": [ring]})
    assert edges(api.get(f"/maps/{farm}/tmap2").text) == {"barn_field"}
    # An older version without a datum, on a channel: the area cannot be placed, but its maps are served.
    api.upload(bare, {"network.tmap2.yaml": samples.tmap2()})
    promote(api, bare, 1)
    api.upload(bare, {"datum.yaml": samples.DATUM})
    close(api, bare, polygon={"type": "Polygon", "coordinates": [ring]})
    assert len(edges(api.get(f"/maps/{bare}/tmap2").text)) == 3
    (line,) = api.get(f"environments/{bare}/versions/production/reports/tmap2").json()["closures"]
    assert line["effect"] == "none"


def test_edge_is_closed_until_the_last_of_overlapping_closures_ends(api: Api, farm: str) -> None:
    first, second = close(api, farm, edge="gate_barn"), close(api, farm, edge="gate_barn", ttl_seconds=60)
    third = close(api, farm, polygon=SQUARE, crs="local")
    for overlay in (third, first):
        end(api, farm, overlay)
        assert "gate_barn" not in edges(api.get(f"/maps/{farm}/tmap2").text)
    end(api, farm, second)
    assert "gate_barn" in edges(api.get(f"/maps/{farm}/tmap2").text)


def test_marked_edges_say_until_when(api: Api, farm: str) -> None:
    closure = close(api, farm, edge="gate_barn")
    (feature,) = [f for f in api.get(f"/maps/{farm}/geojson").json()["features"] if f["id"] == "gate_barn"]
    assert (feature["properties"]["blocked"], feature["properties"]["blocked_until"]) == (True, closure["expires"])
    assert "blocked_until" in api.get(f"/maps/{farm}/kml").text
    graph = api.get(f"/maps/{farm}/nav2_route?closures=mark").json()
    assert sum((f["properties"].get("metadata") or {}).get("blocked") is True for f in graph["features"]) == 1
    report = api.get(f"environments/{farm}/versions/latest/reports/nav2_route?closures=mark").json()
    assert any("closures=mark" in w["problem"] for w in report["warnings"])


NETWORKS = sorted(
    f.name for f in formats.all_formats().values() if f.write and "topology" in f.layers and not f.traits.marks_blocked
)


@pytest.mark.parametrize("name", [n for n in NETWORKS if n != "environment"])
def test_closing_an_edge_gives_the_map_that_deleting_it_gives(api: Api, farm: str, fresh: Any, name: str) -> None:
    other = fresh()
    api.post("environments", {"name": other, "clone": {"environment": farm, "version": 3}})
    close(api, farm, edge="gate_barn")
    deletion = {"op": "delete", "layer": "topology", "id": "gate_barn"}
    api.post(f"environments/{other}/edits", {"changes": [deletion]})
    ours, theirs = (api.get(f"/maps/{env}/{name}").content for env in (farm, other))
    assert ours.replace(farm.encode(), b"NAME") == theirs.replace(other.encode(), b"NAME")


def test_environment_package_applies_closures_to_its_maps(api: Api, farm: str) -> None:
    close(api, farm, edge="gate_barn")
    archive = zipfile.ZipFile(BytesIO(api.get(f"/maps/{farm}/environment").content))
    (network,) = [n for n in archive.namelist() if n.endswith(".tmap2.yaml")]
    assert edges(archive.read(network).decode()) == {"barn_gate", "barn_field"}


def test_channels_count_root_and_closures(api: Api, farm: str) -> None:
    promote(api, farm, 3)
    robot = api.token_for("robot", robot="mower-8")
    manifest = api.get(f"environments/{farm}/versions/production/manifest?formats=tmap2").json()

    def report(overlays: str | None) -> None:
        body = {"environment": farm, "channel": "production", "version": 3, "root": manifest["root"], "state": "active",
                "overlays": overlays}  # fmt: skip
        robot("PUT", "robots/mower-8/status", 200, json={k: v for k, v in body.items() if v is not None})

    def production() -> dict[str, Any]:
        listed = api.get(f"environments/{farm}/channels").json()
        channel: dict[str, Any] = next(c for c in listed if c["channel"] == "production")
        return channel

    report(None)
    assert production()["robots"]["holding"] == 1, "a robot that reports no closures runs the map without any"
    close(api, farm, edge="gate_barn")
    now = production()
    assert (now["robots"]["holding"], now["robots"]["lagging"], now["overlays"]["count"]) == (0, 1, 1)
    lag = api.get(f"robots/mower-8?environment={farm}").json()["lag"]
    assert (lag["events"], lag["differs"]) == (1, True)
    report(now["overlays"]["digest"])
    assert production()["robots"]["holding"] == 1
    assert api.get(f"robots/mower-8?environment={farm}").json()["holds"]["overlays"] == now["overlays"]["digest"]


def test_planner_requests_contain_closed_edges(api: Api, farm: str) -> None:
    promote(api, farm, 3)
    url = f"environments/{farm}/overlays"
    closure = close(api, farm, edge="gate_barn")
    area = close(api, farm, polygon=SQUARE, crs="local")
    graph = api.get(f"environments/{farm}/versions/production/maps/nav2_route?closures=mark").json()["features"]
    marked = api.get(f"{url}/nav2").json()
    assert len(marked["closed_edges"]) == 2
    assert marked["opened_edges"] == []
    assert set(marked["closed_edges"]) <= {f["properties"]["id"] for f in graph if "startid" in f["properties"]}
    lanes = api.get(f"{url}/rmf?fleet=mowers").json()["requests"]
    assert lanes == [
        {"graph": "0.yaml", "message": {"fleet_name": "mowers", "open_lanes": [], "close_lanes": lanes[0]["message"][
            "close_lanes"]}}
    ]  # fmt: skip
    levels = yaml.safe_load(api.get(f"/maps/{farm}/rmf_nav_graph?closures=mark").text)["levels"]
    (level,) = levels.values()
    ends = [level["lanes"][k][:2] for k in lanes[0]["message"]["close_lanes"]]
    named = [[level["vertices"][v][2]["name"] for v in pair] for pair in ends]
    assert sorted(named) == [["barn", "gate"], ["gate", "barn"]]
    zones = api.get(f"{url}/vda5050").json()
    (zone_set,) = zones["zoneSets"]
    (zone,) = zone_set["zoneSet"]["zones"]
    assert (zone["zoneType"], zone["zoneId"]) == ("BLOCKED", area["id"])
    ring = [(v["x"], v["y"]) for v in zone["vertices"]]
    assert len(ring) == 4
    doubled = sum(x0 * y1 - x1 * y0 for (x0, y0), (x1, y1) in zip(ring, ring[1:] + ring[:1], strict=True))
    assert doubled > 0, "counter-clockwise"
    assert [e["edgeId"] for e in zones["closedEdges"]] == ["gate_barn"]
    for overlay in (closure, area):
        end(api, farm, overlay)
    again = api.get(f"{url}/nav2").json()
    assert (again["closed_edges"], again["opened_edges"]) == ([], marked["closed_edges"])
    opened = api.get(f"{url}/rmf").json()["requests"][0]["message"]
    assert (opened["close_lanes"], opened["open_lanes"]) == ([], lanes[0]["message"]["close_lanes"])


def pgm(data: bytes) -> np.ndarray[Any, Any]:
    """Read the pixels of a binary PGM, row 0 at the top."""
    magic, width, height, maximum, rest = data.split(maxsplit=4)
    assert (magic, maximum) == (b"P5", b"255")
    count = int(width) * int(height)
    return np.frombuffer(rest[-count:] if len(rest) >= count else data[-count:], np.uint8).reshape(
        int(height), int(width)
    )


def test_closures_are_listed_with_their_ends_as_signed(api: Api, farm: str) -> None:
    close(api, farm, polygon=SQUARE, crs="local", detail="ä trailer")
    body = api.get(f"environments/{farm}/versions/latest/manifest?formats=geojson").content
    listed = json.loads(body)
    assert listed["overlays_digest"] == closures_digest(listed["overlays"])
    assert listed["overlays"][0]["polygon"] == json.loads(json.dumps(SQUARE))


def test_closing_the_last_edge_marks_it_where_a_graph_must_have_one(api: Api, fresh: Any) -> None:
    """A manifest that cannot be converted would leave robots on the open network."""
    env = fresh()
    api.post("environments", {"name": env})
    api.upload(env, {"n.tmap2.yaml": samples.tmap2(edges=(("gate", "barn"),))})
    close(api, env, edge="gate_barn")
    assert edges(api.get(f"/maps/{env}/tmap2").text) == set()
    graph = api.get(f"/maps/{env}/nav2_route").json()["features"]
    (only,) = [f["properties"] for f in graph if "startid" in f["properties"]]
    assert only["metadata"]["blocked"] is True
    report = api.get(f"environments/{env}/versions/latest/reports/nav2_route").json()
    assert any("no edge would be left" in w["problem"] for w in report["warnings"])
    api.get(f"environments/{env}/versions/latest/manifest?formats=nav2_route,tmap2,rmf_nav_graph")


def test_closed_area_leaves_a_stored_derived_network_as_it_is(api: Api, fresh: Any) -> None:
    """Zones are among its inputs, and closed areas are zones of maps; it is not derived again for them."""
    env = fresh()
    api.post("environments", {"name": env})
    api.upload(env, samples.grid(width=40, height=40))
    api.post(f"environments/{env}/derivations", {"method": "occupancy_to_topology"})
    place = f"environments/{env}/versions/latest/maps/tmap2?derive=false"
    before = api.get(place).text
    assert edges(before)
    ring = [[900, 900], [901, 900], [901, 901], [900, 900]]
    close(api, env, polygon={"type": "Polygon", "coordinates": [ring]}, crs="local")
    assert api.get(place).text == before
    report = api.get(f"environments/{env}/versions/latest/reports/tmap2").json()
    assert [line["information"] for line in report["layers"] if line["layer"] == "topology"] == ["derived"]
    assert api.get(f"/maps/{env}/tmap2").text == before


def test_stored_derived_mask_gets_closed_areas(api: Api, farm: str) -> None:
    zone = {"type": "Feature", "id": "z", "properties": {"kind": "keepout"},
            "geometry": {"type": "Polygon", "coordinates": [[[0, 0], [1, 0], [1, 1], [0, 0]]]}}  # fmt: skip
    put = {"op": "put", "layer": "zones", "crs": "local", "feature": zone}
    api.post(f"environments/{farm}/edits", {"changes": [put]})
    api.post(f"environments/{farm}/derivations", {"method": "zones_to_occupancy"})
    mask = f"/maps/{farm}/occupancy_grid/keepout.pgm"
    before = pgm(api.get(mask).content)
    ring = [[0, -1], [2, -1], [2, -0.5], [0, -1]]
    close(api, farm, polygon={"type": "Polygon", "coordinates": [ring]}, crs="local")
    after = pgm(api.get(mask).content)
    assert after.shape == before.shape
    assert (after[before == 0] == 0).all()
    assert (after == 0).sum() > (before == 0).sum()


def test_reports_name_the_closures_of_their_own_environment(api: Api, farm: str, fresh: Any) -> None:
    """Maps are cached by content, and closures often change none of their bytes."""
    other = fresh()
    api.post("environments", {"name": other, "clone": {"environment": farm, "version": 3}})
    closure = close(api, farm, edge="gate_barn")
    place = "environments/{}/versions/latest/reports/occupancy_grid"
    (line,) = api.get(place.format(farm)).json()["closures"]
    assert (line["id"], line["effect"], line["why"]) == (closure["id"], "none", "this map has no such edge")
    assert api.get(place.format(other)).json()["closures"] == []
    end(api, farm, closure)
    assert api.get(place.format(farm)).json()["closures"] == []


def test_reupload_of_a_map_with_closures_makes_none_permanent(api: Api, farm: str) -> None:
    promote(api, farm, 3)
    closures = [close(api, farm, edge="barn_field"), close(api, farm, polygon=SQUARE, crs="local")]
    exported = api.get(f"/maps/{farm}/geojson").content
    api.upload(farm, {"map.geojson": exported}, layer="topology")
    for closure in closures:
        end(api, farm, closure)
    for name in ("geojson", "kml", "tmap2"):
        text = api.get(f"environments/{farm}/versions/latest/maps/{name}").text
        assert "overlay-" not in text, name
        assert "blocked_until" not in text, name
    assert len(edges(api.get(f"environments/{farm}/versions/latest/maps/tmap2").text)) == 3


def test_zones_may_be_called_like_the_closed_areas(api: Api, farm: str) -> None:
    ring = [[1, 1], [2, 1], [2, 2], [1, 1]]
    zone = {"type": "Feature", "id": "z", "properties": {"kind": "keepout"},
            "geometry": {"type": "Polygon", "coordinates": [ring]}}  # fmt: skip
    put = {"op": "put", "layer": "zones", "name": "closures in force", "crs": "local", "feature": zone}
    api.post(f"environments/{farm}/edits", {"changes": [put]})
    closure = close(api, farm, polygon=SQUARE, crs="local")
    listed = {f["id"] for f in api.get(f"/maps/{farm}/geojson").json()["features"]}
    assert {"z", f"overlay-{closure['id']}"} <= listed
    assert "z" in api.get(f"/maps/{farm}/geojson?closures=ignore").text


def test_kept_area_is_one_zone_while_its_closure_is_in_force(api: Api, farm: str) -> None:
    area = {"polygon": {"type": "Polygon", "coordinates": [[[0, -1], [2, -1], [2, 0.5], [0, -1]]]}, "crs": "local"}
    closure, other = (close(api, farm, **area) for _ in range(2))
    api.post(f"environments/{farm}/overlays/{closure['id']}/keep", expect=200)
    listed = [f["id"] for f in api.get(f"/maps/{farm}/geojson").json()["features"]]
    assert listed.count(f"overlay-{closure['id']}") == listed.count(f"overlay-{other['id']}") == 1
    lines = api.get(f"environments/{farm}/versions/latest/reports/geojson").json()["closures"]
    assert all("zone" in line["effect"].split(", ") for line in lines)
    end(api, farm, other)
    listed = [f["id"] for f in api.get(f"/maps/{farm}/geojson").json()["features"]]
    assert listed.count(f"overlay-{closure['id']}") == 1, "no other closed area is left"
    assert (pgm(api.get(f"/maps/{farm}/occupancy_grid/keepout.pgm").content) == 0).any()


def test_robots_get_the_mask_of_a_closed_area_with_the_whole_site(api: Api, fresh: Any) -> None:
    """This includes a level without a mask of its own, beside a stored mask on another level."""
    env = fresh()
    api.post("environments", {"name": env})
    for level in ("ground", "L2"):
        api.upload(env, samples.grid(), level=level)
    api.upload(env, samples.grid("keepout"), level="ground", grid="keepout")
    place = f"environments/{env}/versions/latest/manifest?formats=occupancy_grid"
    before = {f["name"]: f["sha256"] for f in api.get(place).json()["files"]}
    ring = [[0, -1], [1, -1], [1, 0], [0, -1]]
    area = {"polygon": {"type": "Polygon", "coordinates": [ring]}, "crs": "local"}
    close(api, env, level="L2", **area)
    after = {f["name"]: f["sha256"] for f in api.get(place).json()["files"]}
    assert {name for name in after if name not in before} == {"L2/keepout.yaml", "L2/keepout.pgm",
                                                              "L2/keepout_filter_info.yaml"}  # fmt: skip
    assert {name: after[name] for name in before} == before
    assert (pgm(api.get(f"/maps/{env}/occupancy_grid/L2/keepout.pgm").content) == 0).any()
    close(api, env, level="ground", **area)
    last = {f["name"]: f["sha256"] for f in api.get(place).json()["files"]}
    assert {name for name in last if last[name] != after[name]} == {"keepout.pgm"}


def test_report_of_the_whole_site_says_what_any_of_its_maps_shows(api: Api, farm: str) -> None:
    """The area is in the masks, not in the grid map, whose report says so by itself."""
    for name in ("keepout", "nogo"):
        api.upload(farm, samples.grid(name), grid=name)
    close(api, farm, polygon=SQUARE, crs="local")
    close(api, farm, edge="gate_barn")
    place = f"environments/{farm}/versions/latest/reports/occupancy_grid"
    area, edge = sorted(api.get(f"{place}?level=*&grid=*").json()["closures"], key=lambda line: "edge" in line)
    assert (area["effect"], area.get("why")) == ("keepout cells", None)
    assert (edge["effect"], edge["why"]) == ("none", "this map has no such edge")
    (alone, _) = sorted(api.get(f"{place}?grid=map").json()["closures"], key=lambda line: "edge" in line)
    assert (alone["effect"], alone["why"]) == ("none", "this map contains nothing inside the area")


def test_environment_package_report_lists_effects_of_closures(api: Api, farm: str) -> None:
    closure = close(api, farm, edge="gate_barn")
    (line,) = api.get(f"environments/{farm}/versions/latest/reports/environment").json()["closures"]
    assert (line["id"], line["edges"]) == (closure["id"], ["gate_barn"])


@pytest.mark.parametrize("name", ["keepout", "nogo"])
def test_environment_package_has_closed_areas_in_its_masks(api: Api, farm: str, name: str) -> None:
    api.upload(farm, samples.grid(name), grid=name)
    before = package(api, farm)[f"config/metric/{name}/map.pgm"]
    closure = close(api, farm, polygon=SQUARE, crs="local")
    after = package(api, farm)[f"config/metric/{name}/map.pgm"]
    assert after == api.get(f"/maps/{farm}/occupancy_grid/{name}.pgm").content
    assert (pgm(after) == 0).sum() > (pgm(before) == 0).sum()
    report = api.get(f"environments/{farm}/versions/latest/reports/environment").json()
    (line,) = report["closures"]
    assert line["id"] == closure["id"]
    assert "keepout cells" in line["effect"].split(", ")
    assert not [w for w in report["warnings"] if "keepout" in w["problem"]]


def test_environment_package_without_a_mask_says_so(api: Api, farm: str) -> None:
    place = f"environments/{farm}/versions/latest/reports/environment"
    before = api.get(place).json()["warnings"]
    close(api, farm, polygon=SQUARE, crs="local")
    (warning,) = [w for w in api.get(place).json()["warnings"] if w not in before]
    assert "no grid of this package contains the closed areas of the level 'ground'" in warning["problem"]


def package(api: Api, env: str) -> dict[str, bytes]:
    """Return the files of the environment package."""
    archive = zipfile.ZipFile(BytesIO(api.get(f"/maps/{env}/environment").content))
    return {name: archive.read(name) for name in archive.namelist()}


def test_large_area_keeps_the_mask_of_a_site_without_a_map(api: Api, bare: str) -> None:
    ring = [[0, 0], [2, 0], [2, 2], [0, 2], [0, 0]]
    zone = {"type": "Feature", "id": "z", "properties": {"kind": "keepout"},
            "geometry": {"type": "Polygon", "coordinates": [ring]}}  # fmt: skip
    put = {"op": "put", "layer": "zones", "crs": "local", "feature": zone}
    api.post(f"environments/{bare}/edits", {"changes": [put]})
    wide = [[0, 0], [1500, 0], [1500, 1500], [0, 1500], [0, 0]]
    close(api, bare, polygon={"type": "Polygon", "coordinates": [wide]}, crs="local")
    size = yaml.safe_load(api.get(f"/maps/{bare}/occupancy_grid/keepout.yaml").content)["resolution"]
    assert 0.05 < size < 1.0
