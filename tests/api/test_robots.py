"""Robots over HTTP: permissions, active maps, lag."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from app.errors import Unavailable
from tests.api.conftest import Api, running, settings_for


def status(env: str, root: str, state: str = "active", **more: Any) -> dict[str, Any]:
    return {"environment": env, "channel": "production", "version": 2, "root": root, "state": state, **more}


def root_of(api: Api, env: str, version: int) -> str:
    return str(api.get(f"environments/{env}/versions/{version}").json()["root"])


def test_robot_reports_its_status(api: Api, farm: str) -> None:
    api("PUT", f"environments/{farm}/channels/production", 200, json={"version": 2})
    robot = api.token_for("robot", robot="mower-1", environments=farm)
    root = root_of(api, farm, 2)
    report = status(farm, root, detail="fine", sequence=5, time="2031-01-01T00:00:00+01:00")
    body = robot("PUT", "robots/mower-1/status", 200, json=report).json()
    assert {k: body[k] for k in ("robot", "environment", "channel", "version", "root", "state", "detail")} == {
        "robot": "mower-1", "environment": farm, "channel": "production", "version": 2, "root": root,
        "state": "active", "detail": "fine",
    }  # fmt: skip
    assert body["time"] == "2030-12-31T23:00:00.000000Z"
    assert body["online"] is True
    assert body["vouched"] is True
    assert body["lag"] == {"events": 0, "differs": False, "since": None}
    assert body["holds"] == {"version": 2, "root": root, "since": body["received"]}
    assert robot.get(f"robots?environment={farm}").json() == [body]
    moved = api("PUT", f"environments/{farm}/channels/production", 200, json={"version": 3}).json()
    (now,) = api.get(f"robots?environment={farm}&channel=production").json()
    assert now["lag"] == {"events": 1, "differs": True, "since": moved["time"]}
    assert api.get(f"robots?environment={farm}&channel=staging").json() == []
    api("PUT", f"environments/{farm}/channels/production", 200, json={"version": 2})
    assert api.get(f"robots/mower-1?environment={farm}").json()["lag"]["events"] == 0


def test_operator_limits_the_robots_of_an_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FLEETMAP_MAX_ROBOTS", "2")
    with running(settings_for(tmp_path)) as api:
        for name in ("farm", "garden"):
            api.post("environments", {"name": name})
        body = status("farm", "a" * 64)
        for robot in ("r1", "r2", "r1"):
            api("PUT", f"robots/{robot}/status", 200, json=body)
        problem = api("PUT", "robots/r3/status", 409, json=body).json()
        assert problem["type"].endswith("conflict")
        assert problem["detail"] == "farm has 2 robots: remove robots that no longer exist, or raise the limit"
        assert {robot["robot"] for robot in api.get("robots?environment=farm").json()} == {"r1", "r2"}
        api("PUT", "robots/r3/status", 200, json={**body, "environment": "garden"})
        api("DELETE", "robots/r2?environment=farm", 204)
        api("PUT", "robots/r3/status", 200, json=body)


def test_concurrent_reports_share_transactions(api: Api, farm: str, monkeypatch: pytest.MonkeyPatch) -> None:
    robots, sizes = type(api.app.state.services.store.robots), []
    original = robots.note_reports

    def counted(self: Any, reports: Any) -> Any:
        sizes.append(len(reports))
        time.sleep(0.2)
        return original(self, reports)

    monkeypatch.setattr(robots, "note_reports", counted)

    def report(k: int) -> int:
        body = status(farm if k else "nowhere", "a" * 64)
        answer = api("PUT", f"robots/many-{k}/status", None, json=body, headers={"Prefer": "return=minimal"})
        return answer.status_code

    with ThreadPoolExecutor(24) as pool:
        assert sorted(pool.map(report, range(24))) == [204] * 23 + [404], "each caller gets its own robot"
    assert sum(sizes) == 24
    assert len(sizes) <= 12
    assert len([r for r in api.get(f"robots?environment={farm}").json() if r["robot"].startswith("many-")]) == 23


def test_unstored_report_returns_503(api: Api, farm: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def away(*_: Any) -> Any:
        raise Unavailable("the database is away")

    with monkeypatch.context() as patch:
        patch.setattr(type(api.app.state.services.store.robots), "note_reports", away)
        api.problem("PUT", "robots/late/status", 503, json=status(farm, "a" * 64))
    api("PUT", "robots/late/status", 200, json=status(farm, "a" * 64))


def test_failed_report_does_not_affect_others(
    api: Api, farm: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    robots = type(api.app.state.services.store.robots)
    original = robots.note_reports

    def failing(self: Any, reports: Any) -> Any:
        time.sleep(0.1)
        if any(report.robot == "odd-3" for report in reports):
            raise ValueError("a mistake")
        return original(self, reports)

    monkeypatch.setattr(robots, "note_reports", failing)

    def report(k: int) -> int:
        return api("PUT", f"robots/odd-{k}/status", None, json=status(farm, "a" * 64)).status_code

    with ThreadPoolExecutor(8) as pool:
        assert list(pool.map(report, range(8))) == [200] * 3 + [503] + [200] * 4


def test_list_is_paginated(api: Api, farm: str, bare: str) -> None:
    for env, names in ((farm, ("a", "B", "c", "d.1", "e")), (bare, ("a", "z"))):
        for name in names:
            api("PUT", f"robots/{name}/status", 200, json=status(env, "a" * 64))
    api("PUT", "robots/c/status", 200, json={**status(farm, "a" * 64), "channel": "staging"})

    def walk(caller: Api, path: str) -> list[tuple[str, str]]:
        out: list[tuple[str, str]] = []
        while path:
            answer = caller.get(path)
            assert 0 < len(answer.json()) <= 2
            out += [(r["environment"], r["robot"]) for r in answer.json()]
            path = answer.links["next"]["url"] if "next" in answer.links else ""
        return out

    all_pairs = [(r["environment"], r["robot"]) for r in api.get("robots?limit=1000").json()]
    assert walk(api, "robots?limit=2") == all_pairs
    assert {r for e, r in all_pairs if e == farm} == {"a", "B", "c", "d.1", "e"}
    farm_pairs = [pair for pair in all_pairs if pair[0] == farm]
    assert walk(api, f"robots?environment={farm}&limit=2") == farm_pairs
    assert walk(api, f"robots?environment={farm}&limit=2&channel=production") == [p for p in farm_pairs if p[1] != "c"]
    limited = api.token_for("viewer", environments=bare)
    assert walk(limited, "robots?limit=1") == [(bare, "a"), (bare, "z")]
    api.problem("GET", "robots?cursor=x", 422)
    api.problem("GET", "robots?limit=0", 422)


def test_robots_of_a_deleted_environment_are_skipped(
    api: Api, farm: str, bare: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = root_of(api, farm, 2)
    for env in (farm, bare):
        api("PUT", "robots/goer/status", 200, json=status(env, root))
    store = api.app.state.services.store
    original = store.channels.all

    def delete_first(environment: str) -> Any:
        if environment == farm and store.environments.get(farm, deleted=True).deleted is None:
            store.environments.delete(farm)
        return original(environment)

    monkeypatch.setattr(store.channels, "all", delete_first)
    assert farm not in {r["environment"] for r in api.get("robots?limit=1000").json()}
    for method, path in (("GET", f"robots/goer?environment={farm}"), ("PUT", "robots/goer/status")):
        api("POST", f"environments/{farm}/restore", 200)
        assert api(method, path, None, json=status(farm, root) if method == "PUT" else None).status_code in (404, 410)
    assert api.get("robots/goer").json()["environment"] == bare


def test_history_lists_changed_reports(api: Api, farm: str) -> None:
    for state in ("downloading", "downloading", "ready", "active"):
        api("PUT", "robots/digger/status", 200, json=status(farm, "a" * 64, state))
    body = api.get("robots/digger").json()
    assert [h["state"] for h in body["history"]] == ["active", "ready", "downloading"]
    assert body["environments"] == [farm]
    assert body["lag"] is None, "the channel has no version"
    assert len(api.get("robots/digger?limit=1").json()["history"]) == 1
    api("DELETE", f"robots/digger?environment={farm}", 204)
    api.problem("GET", "robots/digger", 404)
    api.problem("DELETE", f"robots/digger?environment={farm}", 404)


def test_report_needs_the_robots_token_or_an_editor(api: Api, farm: str, bare: str) -> None:
    report = status(farm, "a" * 64)
    robot_client = api.token_for("robot", robot="r-1", environments=farm)
    for caller in (robot_client, api.token_for("editor"), api):
        caller("PUT", "robots/r-1/status", 200, json=report)
    assert "names the robot r-1" in robot_client.problem("PUT", "robots/r-2/status", 403, json=report)["detail"]
    robot_client.problem("PUT", "robots/r-1/status", 403, json=status(bare, "a" * 64))
    assert "the robot a-robot" in api.token_for("robot").problem("PUT", "robots/r-1/status", 403, json=report)["detail"]
    api.token_for("viewer").problem("PUT", "robots/r-1/status", 403, json=report)
    robot_client.problem("DELETE", f"robots/r-1?environment={farm}", 403)
    other = api.token_for("viewer", environments=bare)
    assert other.get("robots").json() == []
    other.problem("GET", f"robots?environment={farm}", 403)
    other.problem("GET", "robots/r-1", 404)
    other.problem("GET", f"robots/r-1?environment={farm}", 403)


def test_bad_statuses_are_refused(api: Api, farm: str) -> None:
    good = status(farm, "a" * 64)
    for bad in (
        {"root": "A" * 64}, {"state": "happy"}, {"version": -1}, {"channel": "No"},
        {"detail": "x" * 2001}, {"time": "tomorrow"}, {"time": "2031-01-01T00:00:00"},
        {"sequence": -1}, {"more": 1}, {"environment": "../x"},
    ):  # fmt: skip
        api.problem("PUT", "robots/r/status", 422, json={**good, **bad})
    api.problem("PUT", "robots/-r/status", 422, json=good)
    api.problem("PUT", "robots/r/status", 404, json={**good, "environment": "nowhere"})
    api.problem("GET", "robots?environment=nowhere", 404)


def test_since_is_set_if_all_robots_run_the_root(api: Api, farm: str) -> None:
    def stand() -> Any:
        channels = {c["channel"]: c for c in api.get(f"environments/{farm}/channels").json()}
        return channels["production"]["robots"]

    moved = api("PUT", f"environments/{farm}/channels/production", 200, json={"version": 2}).json()
    assert moved["robots"]["total"] == 0
    roots = {v: root_of(api, farm, v) for v in (2, 3)}
    for k in range(3):
        api("PUT", f"robots/fleet-{k}/status", 200, json=status(farm, roots[2 + (k > 1)]))
    assert {k: stand()[k] for k in ("total", "holding", "lagging", "since")} == {
        "total": 3, "holding": 2, "lagging": 1, "since": None,
    }  # fmt: skip
    last = api("PUT", "robots/fleet-2/status", 200, json=status(farm, roots[2])).json()
    assert stand() == {
        "total": 3, "online": 3, "holding": 3, "lagging": 0, "failed": 0, "ready": 0,
        "since": last["holds"]["since"],
    }  # fmt: skip


def test_channel_counts_active_maps(api: Api, farm: str) -> None:
    url = f"environments/{farm}/channels"

    def stand() -> tuple[int, int, int]:
        robots = next(c for c in api.get(url).json() if c["channel"] == "production")["robots"]
        return robots["holding"], robots["lagging"], robots["failed"]

    roots = {v: root_of(api, farm, v) for v in (1, 2, 3)}
    active_maps = {v: {"version": v, "root": roots[v]} for v in roots}
    api("PUT", f"{url}/production", 200, json={"version": 2})
    api("PUT", "robots/k/status", 200, json={**status(farm, roots[1]), "version": 1})
    assert stand() == (0, 1, 0)
    failed = {**status(farm, roots[3], "failed", holds=active_maps[2]), "version": 3}
    body = api("PUT", "robots/k/status", 200, json=failed).json()
    assert (body["version"], body["state"], body["holds"]["version"]) == (3, "failed", 2)
    assert stand() == (1, 0, 0), "it runs the channel's version, and refused the next one"
    api("PUT", "robots/k/status", 200, json={**failed, "holds": active_maps[1]})
    assert stand() == (0, 0, 1)
    api("PUT", "robots/k/status", 200, json={**failed, "holds": {"version": 0, "root": "0" * 64}})
    assert api.get(f"robots/k?environment={farm}").json()["holds"] is None
    for bad in ({"version": 1}, {"version": -1, "root": "0" * 64}, {"version": 1, "root": "x"}, 1):
        api.problem("PUT", "robots/k/status", 422, json={**failed, "holds": bad})


def test_rollout_moves_and_reverts_a_channel(api: Api, farm: str) -> None:
    url = f"environments/{farm}/channels/production"

    def channel() -> Any:
        return next(c for c in api.get(f"environments/{farm}/channels").json() if c["channel"] == "production")

    def until(state: str) -> Any:
        deadline = time.monotonic() + 20
        while (now := channel())["rollout"]["state"] != state:
            assert time.monotonic() < deadline, now
            time.sleep(0.05)
        return now

    api("PUT", url, 200, json={"version": 2})
    old, new = root_of(api, farm, 2), root_of(api, farm, 3)
    for robot in ("two-1", "two-2"):
        api("PUT", f"robots/{robot}/status", 200, json=status(farm, old))
    planned = api("PUT", url, 200, json={"version": 3, "rollout": {"ready": 1, "failed": 0.5, "window": 60}}).json()
    assert (planned["version"], planned["planned"]["version"], planned["planned"]["activate_at"]) == (2, 3, None)
    assert planned["rollout"]["state"] == "waiting"
    api("PUT", "robots/two-1/status", 200, json=status(farm, new, "ready"))
    assert channel()["robots"]["ready"] == 1
    assert channel()["version"] == 2
    api("PUT", "robots/two-2/status", 200, json=status(farm, new, "ready"))
    moved = until("watching")
    assert (moved["version"], moved["robots"]["lagging"]) == (3, 2)
    api("PUT", "robots/two-1/status", 200, json=status(farm, new))
    api("PUT", "robots/two-2/status", 200, json=status(farm, new, "failed", detail="the costmap did not load"))
    back = until("rolled_back")
    assert (back["version"], back["rollout"]["detail"]) == (2, "1 of 2 robots failed")
    assert back["sequence"] > moved["sequence"]
    for bad in (
        {}, {"ready": 0}, {"ready": 1.1}, {"failed": -1}, {"ready": 1, "window": 0}, {"more": 1},
        {"failed": 0.5, "deadline": "2099-01-01T00:00:00Z"}, {"ready": 1, "deadline": "2020-01-01T00:00:00Z"},
        {"ready": 1, "deadline": "2099-01-01T00:00:00"},
    ):  # fmt: skip
        api.problem("PUT", url, 422, json={"version": 3, "rollout": bad})
    late = {"ready": 1, "deadline": "2098-01-01T00:00:00Z"}
    api.problem("PUT", url, 422, json={"version": 3, "activate_at": "2099-01-01T00:00:00Z", "rollout": late})
    api.token_for("robot", robot="two-1").problem("PUT", url, 403, json={"version": 3})


def test_planned_move_tolerates_a_slow_clock(api: Api, farm: str) -> None:
    """The move is planned for 30 s ahead by a clock that is 60 s behind: it is accepted and due."""
    channel = f"environments/{farm}/channels/production"
    at = datetime.now(UTC) - timedelta(seconds=30)
    planned = api("PUT", channel, 200, json={"version": 2, "activate_at": at.isoformat()}).json()
    assert (planned["version"], planned["planned"]["version"]) == (None, 2)
    deadline = time.monotonic() + 20
    while (now := api.get(f"environments/{farm}/channels").json()[-1])["version"] is None:
        assert time.monotonic() < deadline
        time.sleep(0.1)
    assert (now["version"], now["planned"]) == (2, None)
    at -= timedelta(seconds=40)
    api.problem("PUT", channel, 422, json={"version": 3, "activate_at": at.isoformat()})
    api.problem("PUT", channel, 422, json={"version": True})
