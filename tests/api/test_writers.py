"""Concurrent writers: with ``If-Match`` one of them succeeds, without it all do, one after the other."""

from __future__ import annotations

import json
import threading
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from typing import Any

import httpx
import pytest

from tests.api.conftest import Api

WRITERS = 6


def at_once(api: Api, env: str, headers: dict[str, str]) -> list[tuple[int, Any]]:
    """Put one zone per writer at the same time; return the statuses and bodies."""
    start = threading.Barrier(WRITERS)

    def write(k: int) -> tuple[int, Any]:
        corners = [[k, 0], [k + 0.5, 0], [k + 0.5, 1], [k, 0]]
        shape = {"type": "Polygon", "coordinates": [corners]}
        feature = {"type": "Feature", "id": f"z{k}", "geometry": shape, "properties": {"kind": "keepout"}}
        body = {
            "message": f"by writer {k}",
            "changes": [{"op": "put", "layer": "zones", "crs": "local", "feature": feature}],
        }
        with httpx.Client(
            base_url=api.url, headers={**api.http.headers, **headers}, timeout=60, verify=False
        ) as client:
            start.wait(60)
            answer = client.post(f"/api/v1/environments/{env}/edits", json=body)
            return answer.status_code, answer.json()

    with ThreadPoolExecutor(WRITERS) as pool:
        return list(pool.map(write, range(WRITERS)))


def races(api: Api, env: str) -> None:
    """Run both races, and check the result."""
    head = api.get(f"environments/{env}").json()["version"]
    answers = at_once(api, env, {"If-Match": f'"{head}"'})
    assert sorted(status for status, _ in answers) == [201] + [412] * (WRITERS - 1)
    assert api.get(f"environments/{env}").json()["version"] == head + 1
    answers = at_once(api, env, {})
    won = {body["version"] for status, body in answers if status == 201}
    same = [body["version"] for status, body in answers if status == 200]  # the zone of the first race
    assert len(won) == WRITERS - 1
    assert len(same) == 1
    last = head + WRITERS
    assert won == set(range(head + 2, last + 1))
    listed = api.get(f"environments/{env}/versions?limit=100").json()
    assert [v["version"] for v in listed] == list(range(last, -1, -1))
    assert [v["parent"] for v in listed] == [*range(last - 1, -1, -1), None]
    messages = {v["version"]: v["message"] for v in listed}
    for k, (status, body) in enumerate(answers):
        assert status == 200 or messages[body["version"]] == f"by writer {k}"
    zones = api.get(f"environments/{env}/versions/latest/layers/zones?crs=local").json()["features"]
    assert {z["id"] for z in zones} == {f"z{k}" for k in range(WRITERS)}, "no writer has overwritten another"
    lines = api.get(f"events?environment={env}&since=0&follow=false").text.splitlines()
    events = [json.loads(line[5:]) for line in lines if line.startswith("data:")]
    assert [e["sequence"] for e in events] == list(range(1, len(events) + 1))
    assert [e["version"] for e in events if e["type"] == "version.created"] == list(range(1, last + 1))


def test_concurrent_writers_lose_no_update(api: Api, farm: str) -> None:
    races(api, farm)


def test_version_order_is_independent_of_clocks(api: Api, farm: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The server's clock goes back by a minute between commits, and forward by two."""
    database = api.app.state.services.store._database
    for shift in (60, -60, 0):
        monkeypatch.setattr(database, "now", lambda s=shift: datetime.now(UTC) + timedelta(seconds=s))
        edit = {"op": "put", "layer": "zones", "crs": "local", "feature": _zone(shift)}
        api.post(f"environments/{farm}/edits", {"message": f"{shift:+d}", "changes": [edit]})
        head = api.get(f"environments/{farm}").json()["version"]
        moved = api("PUT", f"environments/{farm}/channels/production", 200, json={"version": head}).json()
        assert moved["version"] == head
    listed = api.get(f"environments/{farm}/versions").json()
    assert [v["version"] for v in listed] == list(range(6, -1, -1))
    assert [v["message"] for v in listed[:3]] == ["+0", "-60", "+60"]
    assert listed[1]["time"] < listed[2]["time"], "this clock went back"
    lines = api.get(f"events?environment={farm}&since=4&follow=false").text.splitlines()
    events = [json.loads(line[5:]) for line in lines if line.startswith("data:")]
    assert [(e["sequence"], e["version"]) for e in events] == [(5, 4), (6, 4), (7, 5), (8, 5), (9, 6), (10, 6)]
    manifest = api.get(f"environments/{farm}/versions/production/manifest?formats=tmap2").json()
    assert (manifest["sequence"], manifest["version"]) == (10, 6)


def _zone(k: int) -> dict[str, Any]:
    shape = {"type": "Polygon", "coordinates": [[[k, 0], [k + 1, 0], [k + 1, 1], [k, 0]]]}
    return {"type": "Feature", "id": f"zone{k}", "geometry": shape, "properties": {"kind": "keepout"}}
