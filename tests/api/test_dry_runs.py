"""Dry runs of every kind of change: read by id, compared, committed exactly as tried."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from tests.api import samples
from tests.api.conftest import Api, parts, problem

Json = dict[str, Any]

POLE = {"type": "Feature", "id": "pole", "place": {"type": "Point", "coordinates": [1, 2]}, "geometry": None}
PUT = {"op": "put", "layer": "objects", "feature": {**POLE, "properties": {"kind": "pole"}}, "crs": "local"}
CELLS = {
    "op": "cells",
    "polygon": {"type": "Polygon", "coordinates": [[[0, 0], [2, 0], [2, 1], [0, 1], [0, 0]]]},
    "crs": "local",
    "value": 100,
}
TURN = [[[0, 0], [1, 2]], [[10, 0], [11, 2]]]

CHANGES: dict[str, tuple[str, str, Json]] = {
    "edit": ("POST", "edits", {"changes": [PUT, CELLS], "message": "a pole"}),
    "derivation": ("POST", "derivations", {"method": "occupancy_to_objects"}),
    "generation": ("POST", "generations", {"generator": "orchard", "seed": 7, "replace": True, "message": "trees"}),
    "revert": ("POST", "versions", {"revert_to": 1}),
    "template": ("PUT", "templates/tmap2", {"values": {"xy_goal_tolerance": 0.4}}),
    "alignment": ("POST", "alignments", {"pairs": TURN, "message": "measured"}),
}


@pytest.fixture
def twin(api: Api, farm: str, fresh: Callable[[], str]) -> str:
    """Create another environment with the history of ``farm``."""
    name = fresh()
    api.post("environments", {"name": name})
    api.upload(name, {"datum.yaml": samples.DATUM}, message="measured")
    api.upload(name, {"network.tmap2.yaml": samples.tmap2()}, message="driven")
    api.upload(name, samples.grid(), message="mapped")
    return name


def commit(api: Api, env: str, dry: Json, expect: int = 201, headers: Any = None, **body: Any) -> Json:
    answer = api("POST", f"environments/{env}/versions", expect, json={"commit": dry["id"], **body}, headers=headers)
    return dict(answer.json())


def check_committed(api: Api, env: str, dry: Json, direct: Json) -> None:
    """Commit a dry run and compare it with the version that the direct way made elsewhere."""
    assert (dry["version"], dry["time"], dry["parent"]) == (None, None, 3)
    assert api.get(f"environments/{env}").json()["version"] == 3
    version = commit(api, env, dry)
    same = ("root", "parent", "author", "message", "changes", "sources", "warnings", "information", "stale", "version")
    assert {name: version[name] for name in same} == {name: direct[name] for name in same}
    assert version["version"] == 4
    assert dry["root"] == direct["root"]
    assert dry["changes"] == direct["changes"]
    assert dry["warnings"] == direct["warnings"]
    assert api.get(f"environments/{env}/diff?from=3&to=4").json()["layers"] == dry["diff"]["layers"] != {}


@pytest.mark.parametrize("kind", CHANGES)
def test_committed_dry_run_equals_the_direct_change(api: Api, farm: str, twin: str, kind: str) -> None:
    method, path, body = CHANGES[kind]
    direct = api(method, f"environments/{twin}/{path}", 201, json=body).json()
    dry = api(method, f"environments/{farm}/{path}", 200, json={**body, "dry_run": True}).json()
    if kind == "alignment":
        assert dry["alignment"] == direct["alignment"]
        assert dry["version"] is None
        dry, direct = dry["dry_run"], direct["version"]
    check_committed(api, farm, dry, direct)
    at = "versions/4/provenance"
    answers = [api.get(f"environments/{env}/{at}", headers={"accept": "application/json"}) for env in (farm, twin)]
    assert answers[0].json()["parts"] == answers[1].json()["parts"]


def test_committed_dry_run_of_an_upload_keeps_its_sources(api: Api, farm: str, twin: str) -> None:
    files = {"lane.kml": samples.KML, "notes.txt": b"by hand"}
    direct = api.upload(twin, files, layer="topology", message="drawn").json()
    dry = api.upload(farm, files, 200, layer="topology", message="drawn", dry_run="true").json()
    source = api.get(f"environments/{farm}/versions/{dry['id']}/sources/lane.kml")
    assert source.content == samples.KML
    check_committed(api, farm, dry, direct)
    assert api.get(f"environments/{farm}/versions/4/sources/notes.txt").content == b"by hand"


def test_dry_run_is_read_like_a_version(api: Api, farm: str) -> None:
    dry = api.post(f"environments/{farm}/edits", {"changes": [PUT], "dry_run": True}, 200).json()
    at = f"environments/{farm}/versions/{dry['id']}"
    answer = api.get(at)
    assert answer.json() == dry
    assert answer.headers["fleetmap-version"] == dry["id"]
    assert answer.headers["etag"] == f'"{dry["id"]}"'
    assert {(row["layer"], row["count"]) for row in api.get(f"{at}/layers").json()} > {("objects", 1), ("topology", 6)}
    layer = api.get(f"{at}/layers/objects?crs=local")
    assert [(f["id"], f["place"]["coordinates"]) for f in layer.json()["features"]] == [("pole", [1.0, 2.0])]
    assert (layer.headers["fleetmap-version"], layer.headers["fleetmap-root"]) == (dry["id"], dry["root"])
    assert layer.headers["etag"] != api.get(f"environments/{farm}/versions/3/layers/topology").headers["etag"]
    assert api.get(f"{at}/layers/occupancy").content.startswith(b"\x89PNG")
    assert {row["format"]: row["state"] for row in api.get(f"{at}/maps").json()}["tmap2"] == "direct"
    diff = api.get(f"environments/{farm}/diff", params={"to": dry["id"]}).json()
    assert diff == dry["diff"]
    assert diff == {"from": 3, "to": dry["id"], "layers": diff["layers"]}
    assert diff["layers"]["objects"]["added"] == ["pole"]
    back = api.get(f"environments/{farm}/diff", params={"from": dry["id"], "to": "3"}).json()
    assert back["layers"]["objects"]["deleted"] == ["pole"]
    assert api.get(f"environments/{farm}/diff", params={"to": dry["id"], "render": "png"}).content[1:4] == b"PNG"
    place = api.get(f"environments/{farm}/transform", params={"xy": "1,2", "version": dry["id"]}).json()
    assert place["xy"] == [1.0, 2.0]
    missing = api.problem("GET", f"{at}/layers/zones?name=moon", 404)
    assert dry["id"] in missing["detail"]


def test_dry_run_is_visible_by_its_id_only(api: Api, farm: str) -> None:
    store = api.app.state.services.store
    sequence = store.environments.get(farm).sequence
    before = [api.get(f"environments/{farm}{path}").json() for path in ("", "/versions", "/channels")]
    audit = api.get(f"audit?environment={farm}").json()
    dry = api.post(f"environments/{farm}/edits", {"changes": [PUT], "dry_run": True}, 200).json()
    assert [api.get(f"environments/{farm}{path}").json() for path in ("", "/versions", "/channels")] == before
    assert api.get(f"audit?environment={farm}").json() == audit
    assert api.get(f"environments/{farm}/versions/{dry['id']}").json() == dry
    assert "pole" not in api.get(f"environments/{farm}/versions/latest/layers/objects?crs=local").text
    assert store.environments.get(farm).sequence == sequence, "no event"


def test_robots_cannot_get_a_dry_run(api: Api, farm: str, fresh: Callable[[], str]) -> None:
    dry = api.post(f"environments/{farm}/edits", {"changes": [PUT], "dry_run": True}, 200).json()["id"]
    at = f"environments/{farm}/versions/{dry}"
    clone = {"name": fresh(), "clone": {"environment": farm, "version": dry}}
    refused = [
        api("PUT", f"environments/{farm}/channels/production", 422, json={"version": dry}),
        api("POST", "environments", 422, json=clone),
        api("POST", f"{at}/links", 422, json={"format": "tmap2"}),
        *(
            api.get(f"{at}/{path}", 422)
            for path in ("manifest?formats=tmap2", "maps/tmap2", "reports/tmap2", "delta?since=1", "vda5050/actions")
        ),
    ]
    for answer in refused:
        assert "commit it first" in problem(answer)["detail"], answer.url
    api.problem("GET", f"environments/{farm}/versions/3/delta?since={dry}", 422)
    assert "production" not in api.get(f"environments/{farm}/channels").text


def test_dry_run_honours_if_match_and_uses_up_no_key(api: Api, farm: str) -> None:
    at, body = f"environments/{farm}/edits", {"changes": [PUT]}
    key = {"idempotency-key": "once"}
    api("POST", at, 412, json={**body, "dry_run": True}, headers={"if-match": '"2"'})
    first = api("POST", at, 200, json={**body, "dry_run": True}, headers={"if-match": '"3"', **key}).json()
    second = api("POST", at, 200, json={**body, "dry_run": True}, headers=key).json()
    assert first["id"] != second["id"], "each is a dry run of its own"
    version = api("POST", at, 201, json=body, headers=key).json()
    assert (version["version"], version["root"]) == (4, first["root"])
    dry = api("POST", at, 200, json={**body, "dry_run": True}, headers=key).json()
    assert (dry["version"], dry["changes"], dry["diff"]["layers"]) == (None, {}, {})
    assert (dry["root"], dry["parent"]) == (version["root"], 4)
    assert api.get(f"environments/{farm}/versions/{dry['id']}").json() == dry
    assert commit(api, farm, dry, 200)["version"] == 4, "nothing changed"
    bad = {"idempotency-key": "x" * 300}
    api("POST", at, 422, json={**body, "dry_run": True}, headers=bad)


def test_commit_of_a_dry_run_honours_if_match_key_and_message(api: Api, farm: str) -> None:
    at = f"environments/{farm}/edits"
    dry = api.post(at, {"changes": [PUT], "message": "a pole", "dry_run": True}, 200).json()
    late = api.post(at, {"changes": [CELLS], "dry_run": True}, 200).json()
    commit(api, farm, dry, 412, {"if-match": '"2"'})
    headers = {"if-match": '"3"', "idempotency-key": "k"}
    version = commit(api, farm, dry, 201, headers, message="by the gate")
    assert (version["version"], version["message"]) == (4, "by the gate")
    assert commit(api, farm, dry, 201, {"idempotency-key": "k"}, message="by the gate") == version
    commit(api, farm, late, 409, {"idempotency-key": "k"})
    refused = problem(api("POST", f"environments/{farm}/versions", 412, json={"commit": late["id"]}))
    assert "run it again" in refused["detail"]
    commit(api, farm, dry, 412)
    assert api.get(f"environments/{farm}").json()["version"] == 4


@pytest.mark.parametrize(
    ("body", "status", "text"),
    [
        ({"commit": "dry:" + "0" * 32}, 404, "run it again"),
        ({"commit": "7"}, 422, ""),
        ({"commit": "dry:" + "0" * 32, "revert_to": 1}, 422, "exclude each other"),
        ({"commit": "dry:" + "0" * 32, "dry_run": True}, 422, ""),
        ({"message": "neither"}, 422, ""),
    ],
)
def test_impossible_commits_are_refused(api: Api, farm: str, body: Json, status: int, text: str) -> None:
    assert text in api.problem("POST", f"environments/{farm}/versions", status, json=body)["detail"]


@pytest.mark.parametrize("name", ["dry:", "dry:0", "dry:" + "0" * 31, "dry:" + "G" * 32, "dry:" + "0" * 33])
def test_malformed_ids_of_dry_runs_are_refused(api: Api, farm: str, name: str) -> None:
    api.problem("GET", f"environments/{farm}/versions/{name}", 422)
    api.problem("GET", f"environments/{farm}/diff?to={name}", 422)


def test_dry_run_is_limited_to_its_environment_and_its_readers(api: Api, farm: str, twin: str) -> None:
    body = {"changes": [PUT], "dry_run": True}
    viewer, stranger = api.token_for("viewer"), api.token_for("editor", environments=f"{twin}*")
    assert viewer("POST", f"environments/{farm}/edits", json=body).status_code == 403
    dry = api.post(f"environments/{farm}/edits", body, 200).json()
    at = f"environments/{farm}/versions/{dry['id']}"
    assert viewer.get(f"{at}/layers/objects?crs=local").json()["features"]
    assert viewer("POST", f"environments/{farm}/versions", json={"commit": dry["id"]}).status_code == 403
    assert stranger.get(at, 403)
    elsewhere = stranger.get(f"environments/{twin}/versions/{dry['id']}", 404)
    assert "run it again" in problem(elsewhere)["detail"]
    stranger("POST", f"environments/{twin}/versions", 404, json={"commit": dry["id"]})
    api.problem("GET", f"environments/{twin}/diff?to={dry['id']}", 404)


def test_unsuitable_dry_run_stores_nothing(api: Api, farm: str) -> None:
    api.post(f"environments/{farm}/edits", {"changes": [{"op": "delete", "layer": "topology", "id": "barn"}],
                                            "dry_run": True}, 422)  # fmt: skip
    api.post(f"environments/{farm}/versions", {"revert_to": 9, "dry_run": True}, 404)
    api.post(f"environments/{farm}/derivations", {"method": "moon", "dry_run": True}, 422)
    broken = api("POST", f"environments/{farm}/versions?dry_run=true", 422, files=parts({"map.yaml": b"image: ["}))
    assert problem(broken)["errors"]


def test_kept_overlay_can_be_tried(api: Api, farm: str) -> None:
    edge = {"kind": "blocked", "edge": "gate_barn", "state": "accepted", "ttl_seconds": 600}
    overlay = api.post(f"environments/{farm}/overlays", edge).json()
    at = f"environments/{farm}/overlays/{overlay['id']}/keep"
    dry = api.post(f"{at}?dry_run=true", expect=200).json()
    assert [item["id"] for item in dry["diff"]["layers"]["topology"]["changed"]] == ["gate_barn"]
    listed = api.get(f"environments/{farm}/overlays").json()
    assert (listed[0].get("version"), api.get(f"environments/{farm}").json()["version"]) == (None, 3)
    kept = api.post(at, expect=200).json()
    assert api.get(f"environments/{farm}/versions/{kept['version']}").json()["root"] == dry["root"]
    unchanged = api.post(f"{at}?dry_run=true", expect=200).json()
    assert (unchanged["version"], unchanged["changes"]) == (None, {})
