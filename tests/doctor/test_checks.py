"""``fleetmap doctor``: each check with a case that is good and one that is bad."""

from __future__ import annotations

import json
import os
import resource
import socket
import sqlite3
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from datetime import UTC, datetime, timedelta
from email.utils import format_datetime
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from app import __version__, doctor
from app.doctor import CHECKS, Finding, Site, all_checks, database, examine, registry, workers
from app.events import bus
from app.events.router import Router
from app.events.security import RouterSecurity
from app.main import open_store
from app.pool import Pool
from app.store.backups import BackupRecord
from app.store.webhooks import Attempts
from tests.api.conftest import Api, empty_database, settings_for
from tests.certificates import Authority
from tests.mosquitto import Broker
from tests.ports import free_port
from tests.postgres import Cluster

USERS = "tractor-7:a-long-random-password\n"


def now() -> datetime:
    """Return the time, when a case is made: a long run reaches it a quarter of an hour after it reads this file."""
    return datetime.now(UTC)


class StubServer:
    """An HTTP server with an answer for each path. date: of its clock."""

    def __init__(self, answers: dict[str, tuple[int, Any]], date: datetime | None = None) -> None:
        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                status, body = answers.get(self.path, (404, {}))
                data = json.dumps(body).encode()
                self.send_response_only(status)
                self.send_header("date", format_datetime(date or datetime.now(UTC), usegmt=True))
                self.send_header("content-type", "application/json")
                self.send_header("content-length", str(len(data)))
                self.end_headers()
                self.wfile.write(data)

            def log_message(self, *_: Any) -> None:
                """Print nothing."""

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.port = self._server.server_address[1]
        self.url = f"http://127.0.0.1:{self.port}"
        threading.Thread(target=self._server.serve_forever, args=(0.01,), daemon=True).start()

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()


class Place:
    """An installation in a folder: a database, a folder of files, and settings that a case changes."""

    def __init__(self, folder: Path, request: pytest.FixtureRequest) -> None:
        self.folder, self.request = folder, request
        self.patch: pytest.MonkeyPatch = request.getfixturevalue("monkeypatch")
        self.data = folder / "data"
        (self.data / "blobs").mkdir(parents=True)
        self.database = self.data / "fleetmap.sqlite3"
        self.database.write_bytes(empty_database())
        self.database.chmod(0o600)
        self.data.chmod(0o700)

    def site(self, *, unknown: tuple[str, ...] = (), server: str | None = None, **more: Any) -> Site:
        machine = {name: more.pop(name) for name in list(more) if name in Site.__dataclass_fields__}
        more.setdefault("port", 0)
        site = Site(settings_for(self.data, **more), unknown, server, **{"clock_state": lambda: True, **machine})
        self.request.addfinalizer(site.close)
        return site

    def authority(self) -> Authority:
        return Authority(self.folder / "authority", days=90)

    def stub(self, answers: dict[str, tuple[int, Any]], date: datetime | None = None) -> StubServer:
        server = StubServer(answers, date)
        self.request.addfinalizer(server.close)
        return server

    def secret(self, name: str, mode: int, text: str = "secret") -> Path:
        path = self.data / name
        path.parent.mkdir(exist_ok=True, mode=0o700)
        path.write_text(text)
        path.chmod(mode)
        return path

    def sqlite(self, statement: str) -> None:
        with closing(sqlite3.connect(self.database)) as connection, connection:
            connection.execute(statement)

    def scrub(self, **state: Any) -> None:
        (self.data / "blobs" / ".scrub.json").write_text(json.dumps(state))


def disk(free: int, size: int = 100 * 2**30, free_inodes: int = 900) -> Callable[[Path], Any]:
    """Return a statvfs of a disk: sizes in bytes, of 1000 inodes."""
    blocks = SimpleNamespace(f_blocks=size, f_frsize=1, f_bavail=free, f_files=1000, f_favail=free_inodes)
    return lambda _: blocks


def everyone_may_pass(place: Place) -> None:
    """Let all users reach the data folder: pytest's own folders are closed to them."""
    from app.doctor import secret_files

    place.patch.setattr(secret_files, "_is_reachable", lambda _: True)


def ready(**state: Any) -> dict[str, tuple[int, Any]]:
    version = state.pop("version", __version__)
    return {"/readyz": (200, {"status": "ready", **state}), "/openapi.json": (200, {"info": {"version": version}})}


def tls_site(place: Place, days: int, **more: Any) -> Site:
    authority = place.authority()
    certificate, key = authority.sign("server", days)
    environment = {"FLEETMAP_CA": str(authority.pem)}
    return place.site(tls_certificate=certificate, tls_key=key, environment=environment, **more)


def zenoh_site(place: Place, days: int, *, other_authority: bool = False) -> Site:
    authority = place.authority()
    certificate, key = authority.sign("router", days)
    ca = Authority(place.folder / "other").pem if other_authority else authority.pem
    listen = f"tls/127.0.0.1:{free_port()}"
    return place.site(
        zenoh_mode="router", zenoh_listen=listen, zenoh_certificate=certificate, zenoh_key=key, zenoh_ca=ca
    )


def swapped_keys(place: Place) -> Site:
    authority = place.authority()
    (certificate, _), (_, key) = authority.sign("one", 90), authority.sign("two", 90)
    return place.site(tls_certificate=certificate, tls_key=key)


def broken_database(place: Place) -> Site:
    data = bytearray(place.database.read_bytes())
    data[4096 * 3 : 4096 * 3 + 64] = b"\xff" * 64
    place.database.write_bytes(data)
    return place.site()


def old_schema(place: Place) -> Site:
    place.sqlite("UPDATE alembic_version SET version_num = '0015'")
    return place.site()


def newer_schema(place: Place) -> Site:
    place.sqlite("UPDATE alembic_version SET version_num = '9999'")
    place.sqlite(
        "INSERT INTO server (id, epoch, min_compatible) SELECT 1, 0, '9999' WHERE NOT EXISTS (SELECT 1 FROM server)"
    )
    place.sqlite("UPDATE server SET min_compatible = '9999'")
    return place.site()


def with_backup(place: Place, age: timedelta | None) -> Site:
    site = place.site()
    with closing(open_store(site.settings)) as store:
        if age is not None:
            store.backups.note_success(BackupRecord(now() - age, "s3://backups", "1", 1, 1, 1.0))
    return site


def with_failed_backup(place: Place) -> Site:
    site = with_backup(place, timedelta(hours=1))
    with closing(open_store(site.settings)) as store:
        store.backups.note_failure(now(), "disk full")
    return site


def with_webhook(place: Place, failing: timedelta) -> Site:
    """A webhook whose receiver has failed for a time, and an event that waits for it."""
    site = place.site()
    with closing(open_store(site.settings)) as store:
        webhook = store.webhooks.create("https://user:password@hooks.example.org/path-with-a-secret")
        store.environments.create("farm")
        store.webhooks.note_failure(webhook.id, 0, Attempts(3, now() - failing, now(), "no answer"))
    return site


def with_broker(place: Place) -> Site:
    broker = Broker(place.folder / "broker")
    place.request.addfinalizer(broker.kill)
    return place.site(mqtt_url=f"mqtt://127.0.0.1:{broker.port}")


def postgres(place: Place) -> Site:
    cluster: Cluster = place.request.getfixturevalue("postgres_cluster")
    return place.site(database_url=cluster.url(cluster.create_database()), blob_url=str(place.data / "blobs"))


def skewed_database(place: Place, seconds: float) -> Site:
    site = place.site()
    place.patch.setattr(site.store, "clock_offset", lambda: seconds)
    return site


def running_server(place: Place) -> Site:
    api: Api = place.request.getfixturevalue("api")
    return place.site(port=int(api.url.rpartition(":")[2]), server=api.url)


def taken_port(place: Place) -> Site:
    return place.site(port=place.stub({"/": (200, "another program")}).port)


def taken_tls_port(place: Place) -> Site:
    """A program without TLS has the port of a server with TLS."""
    return tls_site(place, 90, port=place.stub({"/": (200, "another program")}).port)


def reserved_port(place: Place) -> Site:
    """A program has the port, and does not listen yet."""
    holder = socket.socket()
    place.request.addfinalizer(holder.close)
    holder.bind(("127.0.0.1", 0))
    return place.site(port=holder.getsockname()[1])


def zenoh_client(place: Place, password: str) -> Site:
    port = place.request.getfixturevalue("zenoh_port")
    endpoint = f"tcp/127.0.0.1:{port}"
    return place.site(zenoh_mode="client", zenoh_connect=endpoint, zenoh_user="server", zenoh_password=password)


def another_router(place: Place) -> Site:
    place.patch.setattr("app.doctor.network.probe_router", lambda *_: "0.9.1")
    return place.site(zenoh_mode="client", zenoh_connect="tcp/127.0.0.1:1")


def foreign_router(place: Place) -> Site:
    """A router runs on the server's port, but its data folder has no password for it."""
    users = place.secret("users", 0o600, USERS)
    listen = f"tcp/127.0.0.1:{place.request.getfixturevalue('zenoh_port')}"
    return place.site(zenoh_mode="router", zenoh_listen=listen, zenoh_users=users)


def closed(place: Place, name: str, mode: int) -> Site:
    """A file or folder that this user cannot write, which tests by root cannot have."""
    path = place.data / name
    if not path.exists():
        path.mkdir()
    path.chmod(mode)
    is_accessible = os.access
    place.patch.setattr(os, "access", lambda p, how: Path(p) != path and is_accessible(p, how))
    return place.site()


def read_only(place: Place) -> Site:
    place.patch.setattr(os, "statvfs", lambda _: SimpleNamespace(f_flag=os.ST_RDONLY))
    return closed(place, "blobs", 0o700)


def few_files(place: Place) -> Site:
    place.patch.setattr(resource, "getrlimit", lambda _: (1024, 1024))
    return place.site()


def dying_workers(place: Place) -> Site:
    def refuse(*_: Any) -> Any:
        raise OSError("no processes left")

    place.patch.setattr("app.pool._start", refuse)
    return place.site()


def unconfined_workers(place: Place) -> Site:
    place.patch.setattr(Pool, "run", lambda *_: (True, True, place.site().settings.max_memory_bytes))
    return place.site()


def old_python(place: Place) -> Site:
    place.patch.setattr("app.doctor.configuration.MIN_PYTHON", (99, 0))
    return place.site()


Case = tuple[str, str, str, Callable[[Place], Site]]
"""Check, worst level, part of its detail, the installation."""

CASES: list[Case] = [
    ("backup", "ok", "last backup", lambda p: with_backup(p, timedelta(hours=3))),
    ("backup", "warning", "3 days old", lambda p: with_backup(p, timedelta(days=3, hours=1))),
    ("backup", "warning", "no backup", lambda p: with_backup(p, None)),
    ("backup", "warning", "1 backups failed since: disk full", with_failed_backup),
    ("certificate-https", "ok", "trusted authority", lambda p: tls_site(p, 90, public_url="https://localhost/maps")),
    ("certificate-https", "warning", "20 days", lambda p: tls_site(p, 21)),
    ("certificate-https", "error", "1 days", lambda p: tls_site(p, 2)),
    ("certificate-https", "error", "expired", lambda p: tls_site(p, -1)),
    ("certificate-https", "error", "not valid for maps.example.org", lambda p: tls_site(
        p, 90, public_url="https://maps.example.org"
    )),
    ("certificate-https", "error", "cannot be used", swapped_keys),
    ("certificate-https", "warning", "not trusted by this machine", lambda p: Site(
        tls_site(p, 90).settings, now=now
    )),
    ("certificate-https", "error", "not valid before", lambda p: tls_site(
        p, 90, now=lambda: now() - timedelta(days=30)
    )),
    ("certificate-zenoh", "ok", "trusted authority", lambda p: zenoh_site(p, 90)),
    ("certificate-zenoh", "error", "not signed by", lambda p: zenoh_site(p, 90, other_authority=True)),
    ("certificate-zenoh", "error", "expired", lambda p: zenoh_site(p, -2)),
    ("clock", "ok", "keeps this machine's clock right", lambda p: p.site()),
    ("clock", "ok", "database's clock", lambda p: skewed_database(p, 0.2)),
    ("clock", "ok", "server's clock", lambda p: p.site(server=p.stub({"/healthz": (200, {})}).url)),
    ("clock", "warning", "no time service", lambda p: p.site(clock_state=lambda: False)),
    ("clock", "warning", "database's clock is 10.0 s ahead", lambda p: skewed_database(p, 10)),
    ("clock", "error", "database's clock is 100.0 s behind", lambda p: skewed_database(p, -100)),
    ("clock", "error", "server's clock", lambda p: p.site(
        server=p.stub({"/healthz": (200, {})}, now() + timedelta(hours=1)).url
    )),
    ("database", "ok", "SQLite 3", lambda p: p.site()),
    ("database", "error", "schema is missing", postgres),
    ("database", "warning", "no database yet", lambda p: p.site(database_url=f"sqlite:///{p.data}/none.sqlite3")),
    ("database", "error", "0015", old_schema),
    ("database", "error", "newer release", newer_schema),
    ("database", "error", "is damaged", lambda p: (p.database.write_text("no database"), p.site())[-1]),
    ("database", "error", "unavailable", lambda p: p.site(
        database_url=f"postgresql+psycopg://fleetmap:pw@127.0.0.1:{free_port()}/x", blob_url=str(p.data)
    )),
    ("database-pages", "ok", "intact", lambda p: p.site()),
    ("database-pages", "error", "", broken_database),
    ("disk-limits", "ok", "fit", lambda p: p.site(statvfs=disk(50 * 2**30))),
    ("disk-limits", "warning", "larger than the disk", lambda p: p.site(statvfs=disk(2**30, 2 * 2**30))),
    ("disk-space", "ok", "are free", lambda p: p.site(statvfs=disk(50 * 2**30))),
    ("disk-space", "warning", "nearly full", lambda p: p.site(statvfs=disk(4 * 2**30))),
    ("disk-space", "error", "disk is full", lambda p: p.site(statvfs=disk(2**20))),
    ("disk-space", "warning", "few further files", lambda p: p.site(statvfs=disk(50 * 2**30, free_inodes=40))),
    ("disk-space", "error", "no further files", lambda p: p.site(statvfs=disk(50 * 2**30, free_inodes=4))),
    ("folders", "ok", "can be written", lambda p: p.site()),
    ("folders", "ok", "will be created", lambda p: p.site(blob_url=str(p.folder / "new" / "blobs"))),
    ("folders", "error", "no folder", lambda p: p.site(blob_url=str(p.database))),
    ("folders", "error", "by this user (mode 0400", lambda p: closed(p, "fleetmap.sqlite3", 0o400)),
    ("folders", "error", "by this user (mode 0500", lambda p: closed(p, "keys", 0o500)),
    ("folders", "error", "file system is read-only", read_only),
    ("folders", "warning", "runs as root", lambda p: (
        p.patch.setattr("app.doctor.disks._users", lambda _: (0, 1000)), p.site()
    )[-1]),
    ("http-port", "ok", "free", lambda p: p.site(port=free_port())),
    ("http-port", "ok", "a server answers", running_server),
    ("http-port", "error", "another program", taken_port),
    ("http-port", "error", "another program", taken_tls_port),
    ("http-port", "error", "cannot listen", reserved_port),
    ("http-port", "error", "cannot listen", lambda p: p.site(host="192.0.2.1", port=free_port())),
    ("memory", "ok", "need", lambda p: p.site(memory=lambda: 64 * 2**30)),
    ("memory", "warning", "address space", lambda p: p.site(memory=lambda: 2 * 2**30)),
    ("memory", "error", "4 server processes", lambda p: p.site(memory=lambda: 2**30, workers=4)),
    ("mqtt", "ok", "no MQTT broker", lambda p: p.site()),
    ("mqtt", "ok", "accepts", with_broker),
    ("mqtt", "error", "refused", lambda p: p.site(mqtt_url=f"mqtt://127.0.0.1:{free_port()}")),
    ("open-files", "ok", "allowed", lambda p: p.site(max_connections=16)),
    ("open-files", "warning", "1024 open files", few_files),
    ("program", "ok", __version__, lambda p: p.site()),
    ("program", "error", "Python", old_python),
    ("secret-files", "ok", "2 files", lambda p: (
        p.secret("keys/a.pem", 0o600), p.secret("zenoh-password", 0o400), p.site()
    )[-1]),
    ("secret-files", "error", "every user", lambda p: (
        everyone_may_pass(p), p.secret("keys/a.pem", 0o644), p.site()
    )[-1]),
    ("secret-files", "error", "others can change", lambda p: p.site(signing_key=p.secret("signing.pem", 0o620))),
    ("secret-files", "error", "cannot be read", lambda p: p.site(signing_key=p.data / "missing.pem")),
    ("secret-files", "error", "every user", lambda p: (everyone_may_pass(p), p.site(
        environment={"FLEETMAP_SECRETS_DIR": str(p.secret("s/fleetmap_admin_token", 0o444).parent)}
    ))[-1]),
    ("secret-files", "ok", "0 files", lambda p: (everyone_may_pass(p), p.database.chmod(0o660), p.site())[-1]),
    ("secret-files", "warning", "can read the database", lambda p: (
        everyone_may_pass(p), p.database.chmod(0o644), p.site()
    )[-1]),
    ("server", "ok", "answers", running_server),
    ("server", "ok", "not asked", lambda p: p.site()),
    ("server", "error", "does not answer", lambda p: p.site(server=f"http://127.0.0.1:{free_port()}")),
    ("server", "error", "the database is away", lambda p: p.site(
        server=p.stub({"/readyz": (503, {"detail": "the database is away"})}).url
    )),
    ("server", "error", "read-only: full", lambda p: p.site(
        server=p.stub(ready(status="read-only", writes="full")).url
    )),
    ("server", "warning", "version 0.0.1", lambda p: p.site(server=p.stub(ready(version="0.0.1")).url)),
    ("server", "warning", "publishes no events", lambda p: p.site(
        server=p.stub(ready(events={"state": "down", "detail": "no router"})).url
    )),
    ("settings", "ok", "consistent", lambda p: p.site(admin_token="x" * 32)),
    ("settings", "warning", "unknown setting FLEETMAP_FOO", lambda p: p.site(
        unknown=("unknown setting FLEETMAP_FOO",), admin_token="x" * 32
    )),
    ("settings", "warning", "clear text", lambda p: p.site(host="0.0.0.0")),
    ("settings", "warning", "without a token", lambda p: p.site(anonymous_networks="0.0.0.0/0")),
    ("settings", "warning", "publish everything", lambda p: p.site(
        zenoh_mode="router", zenoh_listen="tcp/0.0.0.0:7447"
    )),
    ("settings", "error", "can be guessed", lambda p: p.site(admin_token="short")),
    ("stored-data", "ok", "no damage", lambda p: p.site()),
    ("stored-data", "ok", "2.0 days ago", lambda p: (
        p.scrub(completed=(now() - timedelta(days=2)).timestamp()), p.site()
    )[-1]),
    ("stored-data", "warning", "20 days ago", lambda p: (
        p.scrub(completed=(now() - timedelta(days=20)).timestamp()), p.site()
    )[-1]),
    ("stored-data", "warning", "never checked", lambda p: p.site(scrub_hours=0)),
    ("stored-data", "error", "3 blobs", lambda p: (p.scrub(completed=1.0, findings={"blob": 3}), p.site())[-1]),
    ("stored-files", "ok", "can be written", lambda p: p.site()),
    ("stored-files", "warning", "does not exist yet", lambda p: p.site(blob_url=str(p.folder / "none"))),
    ("stored-files", "error", "it does not answer", lambda p: (
        p.patch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{free_port()}"),
        p.site(blob_url="s3://maps", blob_access_key="a", blob_secret_key="b"),
    )[-1]),
    ("webhooks", "ok", "1 webhooks", lambda p: with_webhook(p, timedelta(minutes=5))),
    ("webhooks", "warning", "1 events wait", lambda p: with_webhook(p, timedelta(hours=2))),
    ("workers", "ok", "starts", lambda p: p.site()),
    ("workers", "error", "does not start", dying_workers),
    ("workers", "error", "not confined", unconfined_workers),
    ("zenoh-router", "ok", "connected", lambda p: zenoh_client(p, "the-servers-password")),
    ("zenoh-router", "ok", "off", lambda p: p.site()),
    ("zenoh-router", "ok", "not running", lambda p: p.site(
        zenoh_mode="router", zenoh_listen=f"tcp/127.0.0.1:{free_port()}"
    )),
    ("zenoh-router", "error", "no router at", lambda p: zenoh_client(p, "a-wrong-password")),
    ("zenoh-router", "error", "has not started", foreign_router),
    ("zenoh-router", "error", "no router at", lambda p: p.site(
        zenoh_mode="router", zenoh_listen=f"tcp/127.0.0.1:{p.stub({}).port}"
    )),
    ("zenoh-router", "error", "NAME:PASSWORD", lambda p: p.site(
        zenoh_mode="router", zenoh_listen=f"tcp/127.0.0.1:{free_port()}", zenoh_users=p.secret("users", 0o600, "x")
    )),
    ("zenoh-router", "warning", "version 0.9.1", another_router),
]  # fmt: skip

RANK = ("ok", "warning", "error")


@pytest.fixture(scope="module")
def zenoh_port(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """Port of a router that requires users, among them the server."""
    folder, port = tmp_path_factory.mktemp("router"), free_port()
    (folder / "users").write_text(USERS)
    (folder / "zenoh-password").write_text("the-servers-password")
    security = RouterSecurity(users=folder / "users", folder=folder)
    options = bus.BusOptions("router", f"tcp/127.0.0.1:{port}", security=security)
    router = Router(bus.router_configuration(options))
    assert router.problem is None
    yield port
    router.close()


@pytest.mark.parametrize(("name", "level", "detail", "make"), CASES, ids=[f"{c[0]}-{c[1]}-{c[2]}" for c in CASES])
def test_check(
    name: str,
    level: str,
    detail: str,
    make: Callable[[Place], Site],
    tmp_path: Path,
    request: pytest.FixtureRequest,
) -> None:
    site = make(Place(tmp_path, request))
    results = list(examine(site, [name]))
    assert {result.check for result in results} == {name}
    worst = max((result.finding.level for result in results), key=RANK.index)
    listed = "\n".join(f"{r.finding.level}: {r.finding.detail} ({r.finding.place})" for r in results)
    assert worst == level, listed
    chosen = [r.finding for r in results if r.finding.level == level and detail in r.finding.detail]
    assert chosen, listed
    assert all(finding.advice for finding in chosen if finding.level == "error" and name != "zenoh-router"), listed


def test_check_that_could_not_be_made_is_an_error_unless_the_cause_is_listed(
    tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    site = Place(tmp_path, request).site(
        database_url=f"postgresql+psycopg://fleetmap:pw@127.0.0.1:{free_port()}/x", blob_url=str(tmp_path / "blobs")
    )
    (alone,) = examine(site, ["backup"])
    assert (alone.finding.level, "database" in alone.finding.detail) == ("error", True)
    levels = {result.check: result.finding.level for result in examine(site, ["backup", "database"])}
    assert levels == {"backup": "ok", "database": "error"}


def test_every_check_has_a_good_and_a_bad_case() -> None:
    bad = {case[0] for case in CASES if case[1] != "ok"}
    assert bad == {case[0] for case in CASES if case[1] == "ok"} == set(all_checks())


def test_one_more_check_is_one_function(tmp_path: Path, request: pytest.FixtureRequest) -> None:
    def barn_door(site: Site) -> Iterator[Finding]:
        yield registry.warning("open", str(site.settings.data_dir), "close it")

    registry.check(barn_door)
    try:
        place = Place(tmp_path, request)
        (result,) = examine(place.site(), ["barn-door"])
        expected = {"check": "barn-door", "level": "warning", "detail": "open", "place": str(place.data)}
        assert result.as_dict() == {**expected, "advice": "close it"}
    finally:
        del CHECKS["barn-door"]


def test_defect_in_a_check_is_reported_and_hides_no_other(
    tmp_path: Path, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_: Site) -> Iterator[Finding]:
        raise ZeroDivisionError("oh")

    all_checks()
    monkeypatch.setitem(CHECKS, "memory", fail)
    results = list(examine(Place(tmp_path, request).site(), ["memory", "program"]))
    assert [(r.check, r.finding.level) for r in results] == [("memory", "error"), ("program", "ok")]
    assert "ZeroDivisionError" in results[0].finding.detail


def test_confinement_is_judged_by_what_a_worker_can_do() -> None:
    def level(version: int, writes: bool, listens: bool) -> str:
        return "".join(f.level for f in workers._confinement(version, writes=writes, listens=listens))

    assert level(0, True, True) == "warning"
    assert level(3, False, True) == "warning"
    assert level(3, True, True) == "error"
    assert level(7, False, True) == "error"
    assert level(7, False, False) == "ok"


@pytest.mark.parametrize("name", ["backup", "webhooks"])
def test_broken_database_is_one_error(name: str, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    place = Place(tmp_path, request)
    place.database.write_text("no database")
    results = list(examine(place.site(), [name, "database"]))
    assert {r.check: r.finding.level for r in results} == {name: "ok", "database": "error"}
    (finding,) = [r.finding for r in results if r.check == name]
    assert "see the check database" in finding.detail


def test_secrets_of_addresses_are_not_shown(tmp_path: Path, request: pytest.FixtureRequest) -> None:
    site = with_webhook(Place(tmp_path, request), timedelta(hours=2))
    (result,) = examine(site, ["webhooks"])
    assert result.finding.place.endswith("https://hooks.example.org")
    assert "secret" not in str(result.as_dict())


def test_large_files_are_left_to_verify(tmp_path: Path, request: pytest.FixtureRequest) -> None:
    place = Place(tmp_path, request)
    place.patch.setattr(database, "MAX_PAGES_BYTES", 100)
    (result,) = examine(place.site(), ["database-pages"])
    assert "fleetmap verify" in result.finding.detail


def test_examination_leaves_no_trace(tmp_path: Path, request: pytest.FixtureRequest) -> None:
    """A server may run on the folder: nothing in it may change but locks, and SQLite's files beside the database."""
    place = Place(tmp_path, request)
    place.secret("keys/a.pem", 0o600)

    def listing() -> dict[str, tuple[int, int]]:
        paths = [
            path
            for path in sorted(place.data.rglob("*"))
            if path.is_file() and "-" not in path.name and path.name != ".lock"
        ]
        return {str(path): (path.stat().st_size, path.stat().st_mtime_ns) for path in paths}

    before = listing()
    with socket.socket() as bound:
        bound.bind(("127.0.0.1", 0))
        list(examine(place.site(port=bound.getsockname()[1]), set(all_checks()) - {"workers"}))
    assert listing() == before
    assert list(place.folder.iterdir()) == [place.data]
    assert doctor.CHECKS is CHECKS
