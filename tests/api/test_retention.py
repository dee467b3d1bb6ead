"""Tags, thinned versions and the report of retention over HTTP, and the daily run of a server."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from sqlalchemy import text

from app.errors import NoRoom, Unavailable
from app.housekeeping import _Housekeeping
from app.store.retention_rule import Rule
from app.store.store import Store
from tests.api import samples
from tests.api.conftest import Api, running, settings_for

PREFIX = "environments/farm/versions"
RULE = Rule(all_days=30, daily_days=0, last=2)


@pytest.fixture(scope="module")
def api(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Api]:
    """Server with a rule, and an environment whose versions 0 to 6 are older than it keeps."""
    settings = settings_for(tmp_path_factory.mktemp("retention"), retention_all_days=30, retention_daily_days=0)
    with running(settings.model_copy(update={"retention_last": 2})) as api:
        api.post("environments", {"name": "farm"})
        for k in range(6):
            api.upload("farm", {"n.tmap2.yaml": samples.tmap2({n: (x + k, y) for n, (x, y) in samples.NODES.items()})})
        with store_of(api)._database.write() as connection:
            connection.execute(text("UPDATE version SET time = :old"), {"old": "2020-01-01 00:00:00.000000"})
            connection.execute(text("DELETE FROM idempotency"))
        yield api


def store_of(api: Api) -> Store:
    store: Store = api.app.state.services.store
    return store


def test_daily_run_is_due_a_day_after_the_last_one_of_any_process(api: Api, monkeypatch: pytest.MonkeyPatch) -> None:
    """So it also happens on a server that is restarted every day."""
    housekeeping, store = _Housekeeping(api.app.state.services), store_of(api)
    now, last, runs, fails = store.now(), [store.now()], [], [True]
    assert housekeeping._collect_at - now <= timedelta(hours=1, minutes=1)
    monkeypatch.setattr(store.garbage, "last_run", lambda: last[0])

    def collect(grace: timedelta) -> None:
        if fails:
            raise Unavailable("the database is away")
        runs.append(grace)

    monkeypatch.setattr(store.garbage, "collect", collect)
    last[0] = now - timedelta(hours=20)
    housekeeping._collect_daily()
    assert (runs, housekeeping._collect_at) == ([], now + timedelta(hours=4))
    last[0] = now - timedelta(hours=25)
    with pytest.raises(Unavailable):
        housekeeping._collect_daily()
    assert timedelta(minutes=50) < housekeeping._collect_at - now < timedelta(hours=2), "it is tried again soon"
    fails.clear()
    housekeeping._collect_daily()
    assert len(runs) == 1
    for strange in (None, now + timedelta(days=9)):
        last[0] = strange
        housekeeping._collect_daily()
    assert len(runs) == 3, "without a run before, or after a leap of the clock"


def test_environment_that_is_busy_delays_no_other(api: Api, monkeypatch: pytest.MonkeyPatch) -> None:
    housekeeping, store = _Housekeeping(api.app.state.services), store_of(api)
    (plan,) = store.retention.plan(RULE)
    plans = [replace(plan, environment=name) for name in ("busy", "farm", "full", "other")]
    thinned = []

    def apply(plan: Any, rule: Rule) -> Iterator[Any]:
        thinned.append(plan.environment)
        if plan.environment in ("busy", "full"):
            raise {"busy": Unavailable, "full": NoRoom}[plan.environment]("not now")
        yield from ()

    monkeypatch.setattr(store.retention, "plan", lambda *_: plans)
    monkeypatch.setattr(store.retention, "apply", apply)
    with pytest.raises(NoRoom):
        list(housekeeping._thin(store.now()))
    assert thinned == ["busy", "farm", "full"]


def test_thinning_over_http(api: Api) -> None:
    map_path = f"{PREFIX}/2/maps/tmap2/network.tmap2.yaml"
    served = api("GET", map_path, 200)
    for path in (f"{PREFIX}/2", f"{PREFIX}/2/layers/topology", f"{PREFIX}/2/sources/n.tmap2.yaml"):
        api("GET", path, 200)

    tagged = api("PUT", f"{PREFIX}/3/tags/season-2026", 200).json()
    assert (tagged["version"], tagged["tags"]) == (3, ["season-2026"])
    assert api("PUT", f"{PREFIX}/2/tags/season-2026", 409).json()["type"].endswith(":conflict")
    api("PUT", f"{PREFIX}/2/tags/a,b", 422)
    api("PUT", f"{PREFIX}/dry:{'0' * 32}/tags/x", 422)
    api("PUT", f"{PREFIX}/9/tags/x", 404)
    api.post(f"{PREFIX}/4/links", {"format": "tmap2", "seconds": 3600}, 201)

    report = api("GET", "retention?space=true", 200).json()
    assert report["rule"] == "all of 30 days, the last 2"
    (farm,) = report["environments"]
    assert farm["thinned"] == [2, 1]
    assert farm["kept"] == {"head": 1, "last": 1, "link": 1, "tag": 1, "first": 1}
    assert 0 < report["removable_bytes"] < report["stored_bytes"]

    housekeeping = _Housekeeping(api.app.state.services)
    now = datetime.now(UTC)
    for wrong in (None, now - timedelta(days=4), now + timedelta(days=1)):
        assert list(housekeeping._thin(wrong)) == [], "the clock may have leapt"
        api("GET", f"{PREFIX}/2", 200)
    housekeeping._thinning = housekeeping._thin(now - timedelta(days=1))
    housekeeping._continue_thinning()

    history = {v["version"]: v for v in api("GET", PREFIX, 200).json()}
    assert [n for n, v in history.items() if v.get("thinned")] == [2, 1]
    assert history[3]["tags"] == ["season-2026"]
    assert history[2]["thinned"]["rule"] == report["rule"]
    assert history[2]["sources"][0]["removed"] == history[2]["thinned"]["time"]
    etag = {"if-none-match": served.headers["etag"]}
    dictionary = {"accept-encoding": "dcz", "available-dictionary": f":{'A' * 43}=:"}
    reads = (
        "layers/topology",
        "sources/n.tmap2.yaml",
        "maps",
        "maps/tmap2",
        "manifest?formats=tmap2",
        "reports/tmap2",
        "checks",
    )
    for path in ("2", *(f"2/{read}" for read in reads)):
        problem = api("GET", f"{PREFIX}/{path}", 410, headers=etag | dictionary).json()
        assert problem["type"] == "urn:fleetmap:problem:thinned"
        assert "version 2 of farm was thinned on " in problem["detail"]
        assert "0 and 3" in problem["detail"]
    api("GET", map_path, 410)
    api("GET", "environments/farm/diff?from=2&to=4", 410)
    api("GET", f"{PREFIX}/4/delta?since=2", 410)
    api.post(PREFIX, {"revert_to": 2, "message": "back"}, 410)
    api("PUT", "environments/farm/channels/production", 410, json={"version": 2})
    api("PUT", f"{PREFIX}/2/tags/late", 410)
    api("GET", "/ogc/farm/versions/2/collections", 410)
    api("GET", f"{PREFIX}/3/maps/tmap2/network.tmap2.yaml", 200)
    api("DELETE", f"{PREFIX}/2/tags/season-2026", 404)
    api("DELETE", f"{PREFIX}/3/tags/season-2026", 204)


def test_file_that_was_removed_answers_410(api: Api) -> None:
    with store_of(api)._database.write() as connection:
        connection.execute(text("UPDATE source SET removed = '2026-05-01 00:00:00.000000' WHERE number = 6"))
    (source,) = api("GET", f"{PREFIX}/6/sources", 200).json()
    assert source["removed"] == "2026-05-01T00:00:00.000000Z"
    problem = api("GET", f"{PREFIX}/6/sources/n.tmap2.yaml", 410).json()
    assert "2026-05-01" in problem["detail"]
    assert "tmap2" in problem["detail"], "what to use instead"
