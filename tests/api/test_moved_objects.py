"""Objects that were moved in a file and uploaded again are moved in every map, also where a pose places them."""

from __future__ import annotations

import contextlib
import json
import re
import shutil
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from app.cli import run
from tests.api.conftest import Api, running, settings_for

DATUM = {"latitude": 53.2690, "longitude": -0.5240}
WORLD = b"""<?xml version="1.0"?><sdf version="1.7"><world name="w">
<model name="crate"><static>true</static><pose>2 3 0.5 0 0 0</pose><link name="l"><collision name="c"><geometry>
<box><size>1 1 1</size></box></geometry></collision></link></model>
<model name="post"><static>true</static><pose>8 3 0.5 0 0 0</pose><link name="l"><collision name="c"><geometry>
<box><size>1 1 1</size></box></geometry></collision></link></model></world></sdf>"""

Change = Callable[[dict[str, Any]], None]


@pytest.fixture
def env(api: Api, request: pytest.FixtureRequest) -> str:
    name = re.sub(r"\W|_", "-", request.node.name.lower())[-60:].strip("-")
    api.post("environments", {"name": name, "datum": DATUM})
    api.upload(name, {"w.sdf": WORLD})
    return name


def changed_file(api: Api, env: str, change: Change) -> bytes:
    """Return the environment's GeoJSON with a changed crate."""
    collection = api.get(f"/maps/{env}/geojson").json()
    (crate,) = (f for f in collection["features"] if f["properties"].get("name") == "crate")
    change(crate)
    return json.dumps(collection).encode()


def upload_again(api: Api, env: str, change: Change, **fields: str) -> list[str]:
    """Upload the environment's GeoJSON with a changed crate; returns the warnings."""
    answer = api.upload(env, {"map.geojson": changed_file(api, env, change)}, **fields).json()
    assert {warning["file"] for warning in answer["warnings"]} <= {"map.geojson"}
    return [warning["problem"] for warning in answer["warnings"]]


def shifted(crate: dict[str, Any]) -> None:
    """Move the outline by a ten-thousandth of a degree of longitude, and drop what only GeoJSON of ours has."""
    crate.pop("place", None)
    crate["geometry"]["coordinates"] = [[[x + 1e-4, *rest] for x, *rest in crate["geometry"]["coordinates"][0]]]


def poses(api: Api, env: str) -> list[list[float]]:
    world = api.get(f"/maps/{env}/gazebo").text
    return sorted([float(word) for word in text.split("<")[0].split()] for text in world.split("<pose>")[1:])


MOVED = "the outline was moved, but not 'pose': the pose was moved with it, of crate"
SHIFTED = [[2 + 6.6721, 3, 0.5, 0, 0, 0], [8, 3, 0.5, 0, 0, 0]]


@pytest.mark.parametrize("mode", ["replace", "merge"])
def test_pose_follows_an_outline_that_was_moved_in_a_file(api: Api, env: str, mode: str) -> None:
    assert upload_again(api, env, shifted, mode=mode) == [MOVED]
    for pose, expected in zip(poses(api, env), SHIFTED[::-1], strict=True):
        assert pose == pytest.approx(expected, abs=1e-3)


def test_geometry_that_was_edited_beside_its_place_is_named(api: Api, env: str) -> None:
    def shifted_beside_place(crate: dict[str, Any]) -> None:
        place = crate["place"]
        shifted(crate)
        crate["place"] = place

    data = changed_file(api, env, shifted_beside_place)
    (warning,) = api.upload(env, {"map.geojson": data}, expect=None).json()["warnings"]
    assert "`geometry` is elsewhere than `place`, which is used" in warning["problem"]
    assert warning["where"] == "feature 'crate'"
    assert poses(api, env) == [[2, 3, 0.5, 0, 0, 0], [8, 3, 0.5, 0, 0, 0]]


def test_file_that_is_uploaded_twice_changes_nothing(api: Api, env: str) -> None:
    data = changed_file(api, env, shifted)
    first = api.upload(env, {"map.geojson": data}).json()
    again = api.upload(env, {"map.geojson": data}, expect=200).json()
    assert again["version"] == first["version"]
    assert poses(api, env)[1] == pytest.approx(SHIFTED[0], abs=1e-3)


def test_file_that_is_edited_further_moves_its_objects_further(api: Api, env: str) -> None:
    collection = json.loads(changed_file(api, env, shifted))
    api.upload(env, {"map.geojson": json.dumps(collection).encode()})
    for feature in collection["features"]:
        if feature["properties"].get("name") == "crate":
            shifted(feature)
    api.upload(env, {"map.geojson": json.dumps(collection).encode()})
    assert poses(api, env)[1] == pytest.approx([2 + 2 * 6.6721, *SHIFTED[0][1:]], abs=1e-3)


@pytest.mark.parametrize("has_place", [True, False])
def test_rounded_outlines_were_not_moved(api: Api, env: str, *, has_place: bool) -> None:
    def rounded(crate: dict[str, Any]) -> None:
        if not has_place:
            del crate["place"]
        (ring,) = crate["geometry"]["coordinates"]
        crate["geometry"]["coordinates"] = [[[round(value, 7) for value in point] for point in reversed(ring)]]

    data = changed_file(api, env, rounded)
    assert api.upload(env, {"map.geojson": data}, expect=None).json().get("warnings", []) == []
    assert poses(api, env) == [[2, 3, 0.5, 0, 0, 0], [8, 3, 0.5, 0, 0, 0]]


def test_pose_of_the_file_wins(api: Api, env: str) -> None:
    def move(crate: dict[str, Any]) -> None:
        shifted(crate)
        crate["properties"]["pose"] = [4, 5, 0.5, 0, 0, 0]

    assert upload_again(api, env, move) == []
    assert [4, 5, 0.5, 0, 0, 0] in poses(api, env)


def test_solids_that_stay_are_named(api: Api, env: str) -> None:
    def widen(crate: dict[str, Any]) -> None:
        del crate["place"]
        (ring,) = crate["geometry"]["coordinates"]
        west = min(x for x, *_ in ring)
        crate["geometry"]["coordinates"] = [[[west + 2 * (x - west), *rest] for x, *rest in ring]]

    (warning,) = upload_again(api, env, widen)
    assert "solids stay where 'pose' places them" in warning
    assert warning.endswith("of crate")
    assert poses(api, env) == [[2, 3, 0.5, 0, 0, 0], [8, 3, 0.5, 0, 0, 0]]


@pytest.mark.parametrize("kind", ["geojson", "kml", "gpkg"])
def test_file_that_is_uploaded_as_it_was_served_moves_nothing(api: Api, env: str, kind: str) -> None:
    answer = api.upload(env, {f"map.{kind}": api.get(f"/maps/{env}/{kind}").content}, expect=None)
    assert answer.status_code in (200, 201), answer.text
    assert "pose" not in json.dumps(answer.json().get("warnings", []))
    assert poses(api, env) == [[2, 3, 0.5, 0, 0, 0], [8, 3, 0.5, 0, 0, 0]]


def test_lost_pose_is_repaired_from_the_upload_that_it_followed(tmp_path: Path) -> None:
    with running(settings_for(tmp_path, memory_cache_bytes=0, scrub_hours=0)) as api:
        api.post("environments", {"name": "farm", "datum": DATUM})
        api.upload("farm", {"w.sdf": WORLD})
        upload_again(api, "farm", shifted)
        before = poses(api, "farm")
        with contextlib.closing(sqlite3.connect(tmp_path / "fleetmap.sqlite3", timeout=30)) as database, database:
            database.execute("DELETE FROM chunk")
        assert run(["verify", "--data-dir", str(tmp_path), "--repair"]) == 0
        shutil.rmtree(tmp_path / "cache")
        api.app.state.services.response_cache._entries.clear()
        assert poses(api, "farm") == before
