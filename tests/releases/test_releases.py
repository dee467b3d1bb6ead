"""Data of every release is read for ever, and its agents and servers go on understanding this one's."""

from __future__ import annotations

import base64
import hashlib
import json
import sqlite3
import threading
from collections.abc import Iterator
from contextlib import closing
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from alembic import command
from sqlalchemy import Connection, inspect, text

from app import __version__
from app.agent.agent import Agent, AgentOptions
from app.errors import Unavailable
from app.store import schema, tables
from app.store.database import Database
from app.store.store import Store
from tests.agent.conftest import whole
from tests.api.conftest import ADMIN, Api, running, settings_for
from tests.postgres import Cluster
from tests.releases.sample import MAX_BYTES, Exchange, ReleaseSample, all_samples, read_facts
from tests.releases.write import AGENT_FORMATS

SAMPLES = all_samples()
each_release = pytest.mark.parametrize("release", SAMPLES, ids=[sample.version for sample in SAMPLES], scope="module")
UNRELEASED = "is 0.1.0 released? If not, write its sample again: python -m tests.releases.write"


@pytest.fixture(scope="module")
def server(release: ReleaseSample, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Api]:
    """This release's server on the data of another one."""
    folder = tmp_path_factory.mktemp("upgraded")
    release.unpack(folder)
    with running(settings_for(folder, job_seconds=60)) as api:
        yield api


def migrate_to(database_url: str, revision: str, *, down: bool = False) -> None:
    """Migrate to another revision than the newest, as other releases do."""
    settings = schema.config()
    database = Database(database_url, readonly=False)
    try:
        with database.connection() as connection:
            connection.execution_options(write=True)
            with connection.begin():
                settings.attributes["connection"] = connection
                (command.downgrade if down else command.upgrade)(settings, revision)
    finally:
        database.close()


def copy_rows(source: Path, target: Connection) -> None:
    """Copy a release's SQLite rows into PostgreSQL with the same schema: rows of all tables, but of indexes."""
    target.execute(text("SET session_replication_role = replica"))
    for table in tables.metadata.sorted_tables:
        target.execute(table.delete())
    present = inspect(target)
    origin = Database(f"sqlite:///{source}", readonly=True)
    try:
        with origin.read() as connection:
            for table in tables.metadata.sorted_tables:
                if table.name in ("place", "area", "search_item", "robot_tally") or not present.has_table(table.name):
                    continue  # not used, built again twice, and filled by triggers
                columns = {c["name"] for c in inspect(connection).get_columns(table.name)}
                chosen = [c for c in table.c if c.name in columns and c.computed is None]
                names = ", ".join(f'"{c.name}"' for c in chosen)
                rows = connection.execute(text(f"SELECT {names} FROM {table.name}").columns(*chosen))
                values = [dict(row._mapping) for row in rows]
                if values:
                    target.execute(table.insert(), values)
    finally:
        origin.close()
    target.execute(text("UPDATE environment SET search_version = -1, area_stale = true"))


@each_release
def test_sample_is_small_and_whole(release: ReleaseSample) -> None:
    assert sum(file.stat().st_size for file in release.folder.iterdir()) <= MAX_BYTES
    maps = [
        m for e in release.facts["environments"].values() for v in e["versions"].values() for m in v["maps"].values()
    ]
    assert len([m for m in maps if len(m) == 64]) > 40
    assert release.facts["schema"] <= schema.newest()


@each_release
def test_server_answers_as_the_release_did(release: ReleaseSample, server: Api) -> None:
    now = read_facts(server)
    for name, facts in release.facts["environments"].items():
        for number, version in facts["versions"].items():
            assert now[name]["versions"][number] == version, f"{name} {number}: {UNRELEASED}"
        assert now[name] == facts, UNRELEASED
    store = server.app.state.services.store
    assert store.verifier().run().findings == []


@pytest.mark.postgres
@each_release
def test_release_on_postgresql_has_the_same_content(
    release: ReleaseSample, postgres_cluster: Cluster, tmp_path: Path
) -> None:
    release.unpack(tmp_path)
    name = postgres_cluster.create_database()
    url = postgres_cluster.url(name)
    migrate_to(url, release.facts["schema"])
    database = Database(url, readonly=False)
    with database.write(upkeep=True) as connection:
        copy_rows(tmp_path / "fleetmap.sqlite3", connection)
    database.close()
    store = Store(url, tmp_path / "blobs")
    try:
        store.migrate()
        store.check()
        assert store.verifier().run().findings == []
        for environment, facts in release.facts["environments"].items():
            for version in store.versions.page(environment, limit=1000):
                expected = facts["versions"][str(version.number)]
                assert (version.root, version.message, list(version.tags)) == (
                    expected["root"],
                    expected["message"],
                    expected["tags"],
                )
                assert version.as_dict().get("thinned") == expected["thinned"]
                for part, content in store.content.load(version).parts.items():
                    assert content is not None, part
            channels = [(c.name, c.version) for c in store.channels.all(environment)]
            assert channels == [(c["channel"], c["version"]) for c in facts["channels"]]
    finally:
        store.close()
        postgres_cluster.drop_database(name)


@each_release
def test_schema_goes_back_by_one_release_and_forward_again(release: ReleaseSample, tmp_path: Path) -> None:
    """Down to the schema before, which this release refuses with what to do; up again without a loss."""
    release.unpack(tmp_path)
    url = f"sqlite:///{tmp_path / 'fleetmap.sqlite3'}"

    def content() -> dict[str, Any]:
        with closing(sqlite3.connect(tmp_path / "fleetmap.sqlite3")) as database:
            kept = ("version", "source", "channel", "event", "overlay", "draft", "chunk", "blob", "robot")
            columns = {"version": "number, root, author, message, time, sequence, manifest"}
            return {t: database.execute(f"SELECT {columns.get(t, 'count(*)')} FROM {t}").fetchall() for t in kept}

    store = Store(url, tmp_path / "blobs")
    store.migrate()
    before = content()
    store.close()
    migrate_to(url, "-1", down=True)
    store = Store(url, tmp_path / "blobs")
    with pytest.raises(Unavailable, match="run fleetmap migrate"):
        store.check()
    assert content() == before
    store.migrate()
    store.check()
    assert content() == before
    assert [f for f in store.verifier().run().findings if f.versions != (("farm", 4),)] == []
    store.close()


# --- agents ---


@each_release
def test_agent_of_the_release_understands_this_server(release: ReleaseSample, server: Api) -> None:
    """Its requests are answered with the same status and bytes, and with all members that it may read."""
    phases = {"first map": 3, "new version": 8}
    phase, deltas = "", 0
    for old in release.exchanges:
        if old.phase != phase:
            phase = old.phase
            version = {"version": phases[phase]}
            server("PUT", "environments/farm/channels/production", 200, json=version)
        headers = {name: value for name, value in old.headers.items() if name != "if-none-match"}
        if "available-dictionary" not in headers:
            headers["accept-encoding"] = "identity"
        new = server(old.method, old.path, None, headers=headers, content=base64.b64decode(old.content) or None)
        assert new.status_code == old.status, (old.path, new.text)
        wanted = {"etag", "fleetmap-root", "fleetmap-version", "fleetmap-signature", "content-type", "accept-ranges"}
        assert wanted & old.answer_headers.keys() <= new.headers.keys(), old.path
        if old.answer_headers.get("content-type", "").startswith("application/json"):
            _assert_members(json.loads(old.data), new.json(), old.path)
        elif old.status == 200:
            encoding = old.answer_headers.get("content-encoding")
            assert new.headers.get("content-encoding") == encoding, old.path
            deltas += encoding == "dcz"
            assert encoding is not None or new.content == old.data, old.path
    assert deltas, "the session has a delta"
    server("PUT", "environments/farm/channels/production", 200, json={"version": 8})


def _assert_members(old: Any, new: Any, path: str) -> None:
    """Check that new JSON has each member of the old one, with a value of the same type; items of lists likewise."""
    if isinstance(old, dict):
        assert isinstance(new, dict), path
        for name, value in old.items():
            assert name in new, f"{path}: {name} is gone"
            if value is not None:
                _assert_members(value, new[name], f"{path} {name}")
    elif isinstance(old, list):
        assert isinstance(new, list), path
        assert len(new) >= len(old), path
        for one, other in zip(old, new, strict=False):
            _assert_members(one, other, path)
    else:
        kinds = (int, float) if isinstance(old, int | float) and not isinstance(old, bool) else type(old)
        assert isinstance(new, kinds), f"{path}: {old!r} was {new!r}"


class Replay:
    """Server that answers as a released one did: to each address what was recorded in the phase; else 404."""

    def __init__(self, exchanges: list[Exchange]) -> None:
        self.phase = exchanges[0].phase
        self.unknown: list[str] = []
        self.statuses: list[dict[str, Any]] = []
        replay = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_GET(self) -> None:
                self._answer(b"")

            def do_PUT(self) -> None:
                content = self.rfile.read(int(self.headers.get("content-length") or 0))
                replay.statuses.append(json.loads(content))
                self._answer(content)

            def _answer(self, _: bytes) -> None:
                fitting = [e for e in exchanges if (e.method, e.path) == (self.command, self.path)]
                now = [e for e in fitting if e.phase == replay.phase] or fitting
                if not now:
                    replay.unknown.append(f"{self.command} {self.path}")
                status, headers, body = (now[0].status, now[0].answer_headers, now[0].data) if now else (404, {}, b"{}")
                self.send_response(status)
                for name, value in headers.items():
                    self.send_header(name, value)
                self.send_header("content-length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, *_: Any) -> None:
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self.url = f"http://127.0.0.1:{self._server.server_port}"
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.05,), daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(60)


@each_release
def test_this_agent_understands_the_released_server(release: ReleaseSample, tmp_path: Path) -> None:
    exchanges = release.exchanges
    replay = Replay(exchanges)
    options = AgentOptions(replay.url, "farm", AGENT_FORMATS, tmp_path / "robot", token=ADMIN, robot="r1")
    agent = Agent(options, lambda *_, **__: None, clock=lambda: float(release.facts["time"]))
    agent.open()
    try:
        for phase, version in (("first map", 3), ("new version", 8)):
            replay.phase = phase
            assert agent.run_once(), phase
            manifest = whole(tmp_path / "robot")
            assert manifest["version"] == version
            assert {"state": "active", "version": version}.items() <= replay.statuses[-1].items()
        files = {
            Path(e.path.partition("?")[0]).name: hashlib.sha256(e.data).hexdigest()
            for e in exchanges
            if e.phase == "new version" and "/maps/" in e.path and "content-encoding" not in e.answer_headers
        }
        assert len(files) >= 3
        got = {Path(f["name"]).name: f["sha256"] for f in manifest["files"]}
        assert files.items() <= got.items()
    finally:
        agent.close()
        replay.close()


def test_every_release_up_to_this_one_may_have_a_sample() -> None:
    assert SAMPLES, "no sample"
    newest = tuple(map(int, SAMPLES[-1].version.split(".")))
    assert newest <= tuple(map(int, __version__.split(".")[:3]))
