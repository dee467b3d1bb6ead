"""Signed manifests, and file deltas."""

from __future__ import annotations

import asyncio
import base64
import hashlib
import re
import threading
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import httpx
import pytest
from backports import zstd
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

from app.api.http.deltas import Deltas
from app.convert import maps as map_service
from app.convert.maps import Maps
from app.errors import CannotConvert
from tests.api import samples
from tests.api.conftest import Api, running, settings_for


def keys(api: Api) -> dict[str, Ed25519PublicKey]:
    return {
        k["id"]: Ed25519PublicKey.from_public_bytes(base64.b64decode(k["public_key"])) for k in api.get("keys").json()
    }


def check(api: Api, answer: Any) -> dict[str, Any]:
    """Fetch a manifest and verify its signature."""
    key, _, signature = answer.headers["fleetmap-signature"].partition(":")
    public_key = keys(api)[key]
    public_key.verify(base64.b64decode(signature), answer.content)
    with pytest.raises(InvalidSignature):
        public_key.verify(base64.b64decode(signature), answer.content + b" ")
    body: dict[str, Any] = answer.json()
    return body


def manifest(api: Api, env: str, version: str, formats: str) -> dict[str, Any]:
    return check(api, api.get(f"environments/{env}/versions/{version}/manifest?formats={formats}"))


def test_manifest_lists_served_files(api: Api, farm: str) -> None:
    body = manifest(api, farm, "latest", "tmap2,occupancy_grid,kml")
    assert (body["environment"], body["channel"], body["version"]) == (farm, "latest", 3)
    assert body["root"] == api.get(f"environments/{farm}").json()["root"]
    assert datetime.fromisoformat(body["expires"]) > datetime.now(UTC)
    assert [f["name"] for f in body["files"]] == ["map.kml", "map.pgm", "map.yaml", "network.tmap2.yaml"]
    for file in body["files"]:
        got = api.get(f"environments/{farm}/versions/latest/maps/{file['format']}/{file['name']}").content
        assert (file["size"], file["sha256"]) == (len(got), hashlib.sha256(got).hexdigest())


def test_manifest_lists_all_grids(api: Api, farm: str) -> None:
    api.upload(farm, samples.grid(), grid="keepout")
    names = [f["name"] for f in manifest(api, farm, "latest", "occupancy_grid")["files"]]
    assert {"map.yaml", "map.pgm", "keepout.yaml", "keepout.pgm"} <= set(names)


def test_manifest_has_variables_of_the_site(api: Api, farm: str) -> None:
    assert "variables" not in manifest(api, farm, "latest", "tmap2")
    properties = b"export FIELD_ID=p1\nexport FARM_NAME='north farm'\nexport DATUM_FILE=/x\nexport PATH=/x\n"
    api.upload(farm, {"config/properties.sh": properties})
    assert manifest(api, farm, "latest", "tmap2")["variables"] == {"FARM_NAME": "north farm", "FIELD_ID": "p1"}


def test_layer_hashes_differ_with_content(api: Api, farm: str) -> None:
    def layers(version: str = "latest") -> dict[str, str]:
        hashes: dict[str, str] = manifest(api, farm, version, "tmap2")["layers"]
        return hashes

    def changed(before: dict[str, str]) -> set[str]:
        now = layers()
        return {name for name in {*before, *now} if before.get(name) != now.get(name)}

    first = layers()
    assert {"location", "occupancy", "topology"} <= set(first)
    api.upload(farm, samples.grid(), grid="keepout")
    assert changed(first) == {"occupancy"}
    second = layers()
    api("PATCH", f"environments/{farm}", 200, json={"datum": {"latitude": 53.2, "longitude": -0.5}})
    assert changed(second) == {"location"}, "everything anchored in WGS 84 has moved"
    api.post(f"environments/{farm}/versions", {"revert_to": 3})
    assert layers() == first == layers("3")


def test_sequence_is_that_of_the_channel_move(api: Api, farm: str) -> None:
    sequences = [manifest(api, farm, v, "tmap2")["sequence"] for v in ("2", "latest")]
    assert sequences == [3, 4]
    api("PUT", f"environments/{farm}/channels/production", 200, json={"version": 3})
    assert manifest(api, farm, "production", "tmap2")["sequence"] == 5
    api("PUT", f"environments/{farm}/channels/production", 200, json={"version": 2})
    back = manifest(api, farm, "production", "tmap2")
    assert (back["sequence"], back["version"], back["channel"]) == (6, 2, "production")
    assert "channel" not in manifest(api, farm, "2", "tmap2")


def test_repeated_request_is_served_from_memory(api: Api, farm: str) -> None:
    path = f"environments/{farm}/versions/latest/manifest?formats=tmap2"
    first = api.get(path)
    again = api.get(path, expect=None, headers={"if-none-match": first.headers["etag"]})
    assert again.status_code in (304, 200)  # 200 if the clock has just stepped
    if again.status_code == 200:
        assert again.json()["expires"] > first.json()["expires"]


@pytest.mark.parametrize("formats", ["", "nothing", "tmap2,nothing"])
def test_unknown_formats_are_refused(api: Api, unchanged_farm: str, formats: str) -> None:
    api.problem("GET", f"environments/{unchanged_farm}/versions/latest/manifest?formats={formats}", 422)


def test_unavailable_format_reports_missing_inputs(api: Api, bare: str) -> None:
    problem = api.problem("GET", f"environments/{bare}/versions/latest/manifest?formats=tmap2", 422)
    assert "supply" in problem["detail"]


def test_optional_formats_that_fail_slowly_are_missing(api: Api, farm: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each was tried again before the other had failed, and the manifest was never signed."""
    clock, tried, convert = [1000.0], [], Maps._run_conversion

    def fail_slowly(maps: Maps, recipe: Any, stop: Any) -> Any:
        if recipe.format.name == "tmap2":
            return convert(maps, recipe, stop)
        tried.append(recipe.format.name)
        assert len(tried) < 10
        clock[0] += 70.0
        raise CannotConvert("the time limit was exceeded")

    monkeypatch.setattr(Maps, "_run_conversion", fail_slowly)
    monkeypatch.setattr(map_service, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    api.upload(farm, {"n.tmap2.yaml": samples.tmap2({"slow": (3.5, 0.25), **samples.NODES})})  # in no test's cache
    place = f"environments/{farm}/versions/latest/manifest?formats=tmap2&optional=kml,geojson,lanelet2"
    missing = {"geojson", "kml", "lanelet2"}
    assert {line["format"] for line in api.get(place).json()["missing"]} == missing
    assert sorted(tried) == sorted(missing)
    clock[0] += 2 * 4 * 70.0
    assert {line["format"] for line in api.get(f"{place}&closures=mark").json()["missing"]} == missing
    assert len(tried) == 6, "each is tried again later"


def test_rotated_key_is_endorsed(api: Api, farm: str) -> None:
    before = keys(api)
    viewer = api.token_for("viewer")
    assert viewer("POST", "keys").status_code == 403
    new_key = api.post("keys").json()
    old = before[new_key["endorsed_by"]]
    old.verify(base64.b64decode(new_key["endorsement"]), base64.b64decode(new_key["public_key"]))
    assert api.get("keys").json()[0]["id"] == new_key["id"]
    answer = api.get(f"environments/{farm}/versions/latest/manifest?formats=tmap2")
    assert answer.headers["fleetmap-signature"].startswith(new_key["id"])
    check(api, answer)


def offered(data: bytes) -> dict[str, str]:
    digest = base64.b64encode(hashlib.sha256(data).digest()).decode()
    return {"available-dictionary": f":{digest}:", "accept-encoding": "gzip, dcz"}


def unpack(dcz: bytes, before: bytes) -> bytes:
    assert dcz[:8] == bytes.fromhex("5e2a4d1820000000")
    assert dcz[8:40] == hashlib.sha256(before).digest()
    return zstd.decompress(dcz[40:], zstd_dict=zstd.ZstdDict(before, is_raw=True).as_prefix)


def raw(api: Api, path: str, headers: dict[str, str]) -> tuple[Any, bytes]:
    """Return a response with its raw body."""
    with api.http.stream("GET", path, headers=headers) as answer:
        return answer, b"".join(answer.iter_raw())


def many(moved: float = 0.0) -> bytes:
    nodes = {f"n{k}": (float(k % 50), k / 50.0) for k in range(600)} | {"n300": (7.0 + moved, 6.0)}
    return samples.tmap2(nodes, tuple((f"n{k}", f"n{k + 1}") for k in range(599)))


def test_delta_is_small_and_exact(api: Api, bare: str) -> None:
    path = f"/maps/{bare}/tmap2/network.tmap2.yaml"
    api.upload(bare, {"n.tmap2.yaml": many()})
    first = api.get(path)
    assert first.headers["use-as-dictionary"] == f'match="{path}"'
    assert first.headers["vary"] == "accept-encoding, available-dictionary"
    for _ in range(2):  # on the slow path, and from memory
        same = api.get(path, 304, headers={"If-None-Match": first.headers["etag"]})
        assert same.headers["vary"] == first.headers["vary"], (
            "a shared cache must know that there are several representations"
        )
    api.upload(bare, {"n.tmap2.yaml": many(0.25)})
    answer, body = raw(api, path, offered(first.content))
    assert answer.headers["content-encoding"] == "dcz"
    response = api.get(path)
    assert response.content != first.content
    assert unpack(body, first.content) == response.content
    assert len(body) < 500 < len(response.content)
    assert answer.headers["etag"] != response.headers["etag"]
    again, second = raw(api, path, offered(first.content))
    assert second == body
    assert again.headers["etag"] == answer.headers["etag"]


def test_delta_skips_dictionaries_below_minimum_size(api: Api, bare: str) -> None:
    mesh = "<geometry><mesh><uri>model://shelf/note.stl</uri></mesh></geometry>"
    model = (
        f'<sdf version="1.9"><model name="shelf"><link name="l"><visual name="v">{mesh}</visual></link></model></sdf>'
    )
    config = "<model><name>shelf</name><version>1</version><sdf>model.sdf</sdf></model>"
    world = '<sdf version="1.9"><world name="w"><include><uri>model://shelf</uri></include></world></sdf>'
    folder = "models/shelf"

    def upload(note: bytes) -> None:
        files = {"world.sdf": world, f"{folder}/model.sdf": model, f"{folder}/model.config": config}
        api.upload(bare, {**{name: text.encode() for name, text in files.items()}, f"{folder}/note.stl": note})

    path = f"/maps/{bare}/gazebo/{folder}/note.stl"
    for number, old in enumerate((b"abc", b"7 bytes")):
        upload(old)
        assert api.get(path).content == old
        new = b"a note of more bytes than that, and more, and more, and more " * 3 + str(number).encode()
        upload(new)
        answer, body = raw(api, path, offered(old))
        assert answer.status_code == 200, body
        assert "content-encoding" not in answer.headers
        assert body == new


@pytest.mark.parametrize(
    "headers",
    [
        {"accept-encoding": "gzip, dcz", "available-dictionary": ":AAAA:"},
        {"accept-encoding": "gzip, dcz", "available-dictionary": "x"},
        {"accept-encoding": "gzip, dcz", "available-dictionary": f":{base64.b64encode(bytes(32)).decode()}:"},
        {"accept-encoding": "gzip, dcz;q=0"},
        {"accept-encoding": "gzip"},
    ],
)
def test_unknown_dictionary_gives_the_complete_file(api: Api, unchanged_farm: str, headers: dict[str, str]) -> None:
    path = f"/maps/{unchanged_farm}/tmap2/network.tmap2.yaml"
    content = api.get(path).content
    answer, body = raw(api, path, {**offered(content), **headers} if "available-dictionary" not in headers else headers)
    assert answer.status_code == 200
    assert "content-encoding" not in answer.headers
    assert body == content


def test_dictionary_is_used_once_converted() -> None:
    """A robot offers a file that this server has not converted yet; the next request finds it."""
    old, new = many(), many(0.25)
    names = [hashlib.sha256(data).hexdigest() for data in (old, new)]
    shelf: dict[str, bytes] = {}

    class Shelf:
        def find_by_hash(self, sha256: str, limit: int) -> bytes | None:
            return shelf.get(sha256)

    async def ask() -> bytes | None:
        return await deltas.between(names[0], names[1], new)

    deltas = Deltas(cast(Any, Shelf()))
    assert asyncio.run(ask()) is None
    shelf[names[0]] = old
    delta = asyncio.run(ask())
    assert delta is not None
    assert unpack(delta, old) == new


def test_fleet_requests_cause_one_conversion(api: Api, bare: str) -> None:
    """40 robots request manifest and file at the same time."""
    api.upload(bare, {"n.tmap2.yaml": samples.tmap2({"here": (0.5, 1.0), "there": (2.5, 1.0)}, (("here", "there"),))})

    def conversion_count() -> float:
        match = re.search(r'conversions_total\{format="tmap2",result="made"\} (\S+)', api.get("/metrics").text)
        return float(match[1]) if match else 0.0

    before = conversion_count()
    start = threading.Barrier(40)

    def ask(_: int) -> str:
        start.wait(60)
        with httpx.Client(base_url=api.url, headers=api.http.headers, timeout=60, verify=False) as client:
            place = f"/api/v1/environments/{bare}/versions"
            (file,) = client.get(f"{place}/latest/manifest?formats=tmap2").json()["files"]
            data = client.get(f"{place}/1/maps/tmap2/{file['name']}").content
            assert hashlib.sha256(data).hexdigest() == file["sha256"]
            return str(file["sha256"])

    with ThreadPoolExecutor(40) as pool:
        assert len(set(pool.map(ask, range(40)))) == 1
    assert conversion_count() - before == 1


def test_concurrent_manifests_come_from_memory_and_are_current(api: Api, farm: str) -> None:
    place = f"environments/{farm}"
    paths = (f"{place}/versions/latest/manifest?formats=tmap2", f"{place}/channels?robots=false")
    hot = api.app.state.services.response_cache

    def is_cached(path: str) -> bool:
        full_path, _, query = f"/api/v1/{path}".partition("?")
        return hot.get_fresh((full_path.encode(), query.encode())) is not None

    for path in paths:
        first = api.get(path)
        again = api.get(path)
        assert is_cached(path)
        assert again.content == first.content
        assert {k: v for k, v in again.headers.items() if k != "date"}.items() >= {
            "etag": first.headers["etag"], "content-type": "application/json", "cache-control": "no-cache",
        }.items()  # fmt: skip
        assert again.headers.get("fleetmap-signature") == first.headers.get("fleetmap-signature")
        assert api.get(path, 304, headers={"If-None-Match": first.headers["etag"]}).content == b""
        api.as_("none").problem("GET", path, 401)
        api.token_for("viewer", environments="other-*").problem("GET", path, 403)
    check(api, api.get(paths[0]))
    api("PUT", f"{place}/channels/production", 200, json={"version": 2})
    assert not is_cached(paths[1])
    assert {c["channel"]: c["version"] for c in api.get(paths[1]).json()} == {"latest": 3, "production": 2}
    api.upload(farm, {"n.tmap2.yaml": samples.tmap2({"a": (0.0, 1.0), "b": (5.0, 1.0)}, (("a", "b"),))})
    assert check(api, api.get(paths[0]))["version"] == 4
    old = api.get(paths[0]).headers["fleetmap-signature"].partition(":")[0]
    new = api.post("keys", expect=201).json()["id"]
    assert api.get(paths[0]).headers["fleetmap-signature"].partition(":")[0] == new != old
    assert "robots" in api.get(f"{place}/channels").json()[0]


def test_manifest_lists_more_maps_than_the_cache_holds(tmp_path: Path) -> None:
    with running(settings_for(tmp_path, cache_bytes=0)) as api:
        api.post("environments", {"name": "small"})
        api.upload("small", {"n.tmap2.yaml": many()})
        body = api.get("environments/small/versions/latest/manifest?formats=tmap2,geojson").json()
        assert {file["format"] for file in body["files"]} == {"tmap2", "geojson"}
        for file in body["files"]:
            data = api.get(f"/maps/small/{file['format']}/{file['name']}").content
            assert hashlib.sha256(data).hexdigest() == file["sha256"]
