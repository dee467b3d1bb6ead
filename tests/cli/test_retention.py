"""``fleetmap retention`` on a data folder: dry run, the run itself, what it refuses; and ``fleetmap tag``."""

from __future__ import annotations

import json
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import psycopg
import pytest

from app.backends.lead import SharedLeads, open_leads
from app.cli import run
from app.store.changes import Replace
from app.store.store import Store
from tests.api.conftest import ADMIN, create_farm, empty_database, running, settings_for
from tests.store.samples import TOPOLOGY, network, save


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Data folder with an environment whose versions are two years old and more."""
    (tmp_path / "fleetmap.sqlite3").write_bytes(empty_database())
    clock = datetime.now(UTC) - timedelta(days=800)
    store = Store(f"sqlite:///{tmp_path / 'fleetmap.sqlite3'}", tmp_path / "blobs", clock=lambda: clock)
    store.blobs.prepare()
    store.environments.create("farm")
    for k in range(12):
        clock += timedelta(days=1)
        save(store, "farm", Replace(TOPOLOGY, network(40, seed=k)))
    store.close()
    return tmp_path


def retention(folder: Path, capfd: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, Any]:
    status = run(["retention", "--data-dir", str(folder), "--json", *arguments])
    out, err = capfd.readouterr()
    return status, json.loads(out) if out else err


def test_dry_run_then_removal(folder: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.cli.retention.ALONE_SECONDS", 0.5)  # file locks need no connection
    status, body = retention(folder, capfd)
    assert status != 0
    assert "there is no rule, so everything stays" in body
    for unsafe in (("--all-days", "0"), ("--all-days", "30", "--last", "0"), ("--all-days", "30", "--daily-days", "3")):
        status, body = retention(folder, capfd, *unsafe)
        assert status != 0
        assert "could remove everything" in body or "less than all" in body
    rule = ("--all-days", "30", "--last", "3")
    status, plan = retention(folder, capfd, "--dry-run", *rule)
    assert status == 0
    (farm,) = plan["environments"]
    assert farm["thinned"] == list(range(9, 0, -1))
    assert farm["kept"] == {"head": 1, "last": 2, "first": 1}
    assert 0 < plan["removable_bytes"] < plan["stored_bytes"]
    assert retention(folder, capfd, "--dry-run", *rule)[1] == plan, "a dry run changes nothing"

    status, done = retention(folder, capfd, *rule)
    assert (status, done["environments"]) == (0, plan["environments"])
    assert done["stored_bytes_after"] == done["stored_bytes"] == plan["stored_bytes"]
    assert done["removable_bytes"] == plan["removable_bytes"]
    leads = open_leads(f"sqlite:///{folder / 'fleetmap.sqlite3'}", folder)
    lead = leads.lead("housekeeping")
    assert lead.try_acquire()
    status, body = retention(folder, capfd, *rule, "--now")
    assert status != 0
    assert "a server uses this data" in body
    leads.close()
    status, done = retention(folder, capfd, *rule, "--now")
    assert status == 0
    assert done["environments"][0]["thinned"] == []
    assert done["stored_bytes_after"] == plan["stored_bytes"] - plan["removable_bytes"]
    assert run(["verify", "--data-dir", str(folder)]) == 0


@pytest.mark.postgres
def test_removal_at_once_on_postgresql(
    postgres_url: str, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with closing(Store(postgres_url, tmp_path / "blobs")) as store:
        store.migrate()
        store.blobs.prepare()
        store.environments.create("farm")
    arguments = ("--database-url", postgres_url, "--all-days", "30", "--now")
    monkeypatch.setattr("app.cli.retention.ALONE_SECONDS", 60)
    status, done = retention(tmp_path, capfd, *arguments)
    assert (status, done["environments"][0]["thinned"]) == (0, [])
    lead = SharedLeads(postgres_url, tmp_path).lead("housekeeping")
    with psycopg.connect(postgres_url.replace("+psycopg", "")) as server:  # a session that may be silent
        server.execute("SELECT pg_advisory_lock(%s)", (lead.key,))
        monkeypatch.setattr("app.cli.retention.ALONE_SECONDS", 0.5)
        status, body = retention(tmp_path, capfd, *arguments)
        assert status != 0
        assert "a server uses this data" in body


def test_text_tells_space_before_and_after(folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert run(["retention", "--data-dir", str(folder), "--all-days", "30", "--now"]) == 0
    out = capfd.readouterr().out
    assert "rule: all of 30 days, one a day for 365 days, the last 10" in out
    assert "farm: 2 versions thinned; stay: 1 first, 1 head, 9 last" in out
    assert "stored: " in out
    assert "stored now: " in out


def test_tags(tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    with running(settings_for(tmp_path)) as api:
        create_farm(api, "farm")
        monkeypatch.setenv("FLEETMAP_SERVER", api.url)
        monkeypatch.setenv("FLEETMAP_TOKEN", ADMIN)
        assert run(["tag", "farm", "1", "season-2026"]) == 0
        assert run(["tag", "farm", "1", "season-2026"]) == 0
        assert capfd.readouterr().out.splitlines()[-1] == "farm: version 1 has the tags season-2026"
        assert run(["versions", "farm"]) == 0
        assert "season-2026" in capfd.readouterr().out
        assert run(["tag", "farm", "2", "season-2026"]) != 0
        assert run(["tag", "farm", "1", "season-2026", "--remove"]) == 0
