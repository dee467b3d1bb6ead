"""Single flight: concurrent requests share one call, and no response is older than a commit that the client knows."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import pytest

from app.api import channels, maps
from app.api.http.auth import Authenticator, Credentials
from app.api.http.single_flight import SingleFlight
from app.errors import NotFound, Unavailable
from app.store.channels import Channels
from app.store.database import Database
from app.store.tokens import Tokens
from tests.api import samples
from tests.api.conftest import Api


def network(name: str) -> dict[str, bytes]:
    return {"n.tmap2.yaml": samples.tmap2({name: (0.5, 1.0), "there": (2.5, 1.0)}, ((name, "there"),))}


class Gate:
    """Gate that blocks calls until it is opened, and counts them."""

    def __init__(self) -> None:
        self.calls = 0
        self.reached, self.open = threading.Event(), threading.Event()

    def __call__(self) -> None:
        self.calls += 1
        self.reached.set()
        assert self.open.wait(20)


@contextmanager
def at_once(count: int) -> Iterator[Callable[..., Any]]:
    """Start calls in threads; the block's end waits for them."""
    with ThreadPoolExecutor(count) as pool:
        yield pool.submit


# --- class SingleFlight ---


def test_single_flight_shares_one_call() -> None:
    async def run() -> None:
        flight: SingleFlight[str, int] = SingleFlight()
        gate = Gate()

        def call(number: int) -> int:
            gate()
            return number

        tasks = [asyncio.create_task(flight.run("a", call, k)) for k in range(5)]
        other = asyncio.create_task(flight.run("b", call, 7))
        await asyncio.sleep(0.05)
        gate.open.set()
        assert await asyncio.gather(*tasks) == [0] * 5
        assert await other == 7
        assert gate.calls == 2
        assert await flight.run("a", call, 9) == 9, "finished calls are not shared"

    asyncio.run(run())


def test_cancelled_caller_does_not_stop_the_call() -> None:
    async def run() -> None:
        flight: SingleFlight[str, int] = SingleFlight()
        gate = Gate()

        def call() -> int:
            gate()
            return 1

        first, second = (asyncio.create_task(flight.run("a", call)) for _ in range(2))
        await asyncio.sleep(0.05)
        first.cancel()
        with pytest.raises(asyncio.CancelledError):
            await first
        third = asyncio.create_task(flight.run("a", call))
        await asyncio.sleep(0.05)
        gate.open.set()
        assert (await second, await third, gate.calls) == (1, 1, 1)

    asyncio.run(run())


@pytest.mark.filterwarnings("error")
def test_error_goes_to_all_callers_and_is_not_cached(caplog: pytest.LogCaptureFixture) -> None:
    async def run() -> None:
        flight: SingleFlight[str, int] = SingleFlight()
        gate = Gate()

        def fail() -> int:
            gate()
            raise NotFound("it is not here")

        tasks = [asyncio.create_task(flight.run("a", fail)) for _ in range(3)]
        alone = asyncio.create_task(flight.run("b", fail))
        await asyncio.sleep(0.05)
        alone.cancel()  # no caller is left to receive its error
        gate.open.set()
        errors = await asyncio.gather(*tasks, return_exceptions=True)
        assert [type(error) for error in errors] == [NotFound] * 3
        assert await flight.run("a", lambda: 5) == 5
        await asyncio.sleep(0.05)

    asyncio.run(run())
    assert not caplog.records


# --- maps, manifests, channels ---


def test_map_is_not_older_than_a_known_commit(api: Api, bare: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A slow call that read the old version does not answer a client that knows of the new one."""
    api.upload(bare, network("old"))
    path = f"/maps/{bare}/tmap2/network.tmap2.yaml"
    api.get(path)
    api.upload(bare, network("mid"))  # the cached response is not this one; its map is cached
    api.get(f"environments/{bare}/versions/2/maps/tmap2/network.tmap2.yaml")
    services = api.app.state.services
    gate, began = Gate(), threading.Event()
    find, ready = maps.resolve_recipe, services.maps.get_cached

    def resolve(*args: Any) -> Any:
        result = find(*args)
        if not began.is_set():
            began.set()
            api.upload(bare, network("new"))  # a commit between this call and the next
            time.sleep(0.3)
        return result

    def slow(recipe: Any) -> Any:
        if recipe.version.number == 2:
            gate()
        return ready(recipe)

    monkeypatch.setattr(maps, "resolve_recipe", resolve)
    monkeypatch.setattr(services.maps, "get_cached", slow)
    with at_once(2) as start:
        first = start(api.get, path)
        assert gate.reached.wait(20)
        second = start(api.as_(api.token).get, path)
        time.sleep(0.2)
        gate.open.set()
        assert b"new" in second.result(20).content
        assert second.result().headers["fleetmap-version"] == "3"
        assert b"mid" in first.result(20).content
    assert b"new" in api.get(path).content


def test_stored_report_is_in_the_next_response(api: Api, farm: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports of robots do not change the commit counter, but a client that stored one must see it."""
    root = api.get(f"environments/{farm}/versions/3").json()["root"]
    gate, original = Gate(), channels._list_response
    first_only = iter([True])

    def slow(*args: Any) -> Any:
        result = original(*args)
        if next(first_only, False):
            gate()
        return result

    monkeypatch.setattr(channels, "_list_response", slow)
    with at_once(2) as start:
        first = start(api.get, f"environments/{farm}/channels")
        assert gate.reached.wait(20)
        status = {"environment": farm, "channel": "latest", "version": 3, "root": root, "state": "active"}
        other = api.as_(api.token)
        other("PUT", "robots/mower/status", 200, json=status)
        second = start(other.get, f"environments/{farm}/channels")
        time.sleep(0.2)
        gate.open.set()
        assert second.result(20).json()[0]["robots"]["holding"] == 1
        assert first.result(20).json()[0]["robots"]["total"] == 0


def test_manifest_requests_share_a_call_but_check_access(api: Api, farm: str, monkeypatch: pytest.MonkeyPatch) -> None:
    gate, original = Gate(), Channels.target

    def slow(self: Channels, *args: Any) -> Any:
        gate()
        return original(self, *args)

    path = f"environments/{farm}/versions/latest/manifest?formats=tmap2"
    api.get(path)
    api.upload(farm, network("next"))
    robots = [api.token_for("robot", robot=f"r{k}", environments=farm) for k in range(6)]
    outsider = api.token_for("viewer", environments="other-*")
    monkeypatch.setattr(Channels, "target", slow)
    with at_once(8) as start:
        futures = [start(robot.get, path) for robot in robots]
        assert gate.reached.wait(20)
        assert start(outsider.get, path, None).result(20).status_code == 403
        assert start(api.as_("none").get, path, None).result(20).status_code == 401
        time.sleep(0.2)
        gate.open.set()
        answers = [one.result(20) for one in futures]
    assert {a.json()["version"] for a in answers} == {4}
    assert len({a.content for a in answers}) == 1
    assert gate.calls < 4, "at most one call before and one after the response is cached"


def test_missing_environment_returns_404_to_each_caller(
    api: Api, fresh: Callable[[], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    gate, original = Gate(), channels._list_response

    def slow(*args: Any) -> Any:
        gate()
        return original(*args)

    monkeypatch.setattr(channels, "_list_response", slow)
    path = f"environments/{fresh()}/channels?robots=false"
    clients = [api.as_(api.token) for _ in range(3)]
    with at_once(3) as start:
        futures = [start(client.problem, "GET", path, 404) for client in clients]
        assert gate.reached.wait(20)
        time.sleep(0.2)
        gate.open.set()
        assert [one.result(20)["status"] for one in futures] == [404] * 3


# --- tokens ---


def test_concurrent_requests_look_up_each_token_once(api: Api, farm: str, monkeypatch: pytest.MonkeyPatch) -> None:
    gate, original = Gate(), Tokens.find
    lookups: list[str] = []

    def slow(self: Tokens, text: str) -> Any:
        lookups.append(text)
        gate()
        return original(self, text)

    tokens = [api.token_for("viewer").token, api.token_for("viewer", environments="other-*").token, "x" * 40]
    access = api.app.state.services.access
    access.invalidate()
    monkeypatch.setattr(access, "_find_token", lambda text: slow(api.app.state.services.store.tokens, text))
    clients = [api.as_(token) for token in tokens for _ in range(3)]
    with at_once(len(clients)) as start:
        futures = [start(client.get, f"environments/{farm}", None) for client in clients]
        time.sleep(0.4)
        gate.open.set()
        statuses = [one.result(20).status_code for one in futures]
    assert statuses == [200] * 3 + [403] * 3 + [401] * 3
    assert sorted(lookups) == sorted(tokens), "one lookup per token"


def test_token_revoked_during_lookup_is_not_cached() -> None:
    gate = Gate()
    store = {"t"}

    class Found:
        id, name, role, environments, robot, expires = "1", "n", "viewer", None, None, None

    def find(text: str) -> Any:
        entry = Found() if text in store else None
        gate()
        return entry

    access = Authenticator(find, failures=10)
    with at_once(1) as start:
        pending = start(access.authenticate, Credentials(b"Bearer t", client="1.2.3.4"))
        assert gate.reached.wait(20)
        store.clear()
        access.invalidate()
        gate.open.set()
        pending.result(20)  # it was valid when it was looked up
    assert access.cached_principal(Credentials(b"Bearer t")) is None


# --- writers ---


def test_database_serialises_writers(tmp_path: Any) -> None:
    """A slow writer makes others wait, not fail; a failed writer releases the lock; readers never wait."""
    notifications: list[int] = []
    database = Database(
        f"sqlite:///{tmp_path}/turns.sqlite3", readonly=False, written=lambda _: notifications.append(1)
    )
    with database.write() as connection:
        connection.exec_driver_sql("CREATE TABLE t (n INTEGER)")
    gate = Gate()

    def write(n: int, before: Callable[[], None] = lambda: None) -> None:
        with database.write() as connection:
            connection.exec_driver_sql(f"INSERT INTO t VALUES ({n})")
            before()

    def read() -> int:
        with database.read() as connection:
            return int(connection.exec_driver_sql("SELECT count(*) FROM t").scalar_one())

    def broken() -> None:
        raise RuntimeError("on the way")

    with at_once(12) as start:
        long = start(write, 0, gate)
        assert gate.reached.wait(20)
        others = [start(write, k) for k in range(1, 9)]
        bad = start(write, 99, broken)
        assert start(read).result(5) == 0
        time.sleep(0.1)
        assert not any(one.done() for one in (*others, bad))
        gate.open.set()
        for one in (long, *others):
            one.result(20)
        with pytest.raises(RuntimeError):
            bad.result(20)
    assert read() == 9
    assert len(notifications) == 10, "the failed commit has no event"
    database.close()


def test_blocked_writer_raises_unavailable(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.store.database.TURN_SECONDS", 0.05)
    database = Database(f"sqlite:///{tmp_path}/turns.sqlite3", readonly=False)
    with database.write(), at_once(1) as start:

        def second() -> None:
            with database.write():
                raise AssertionError("two write at once")

        with pytest.raises(Unavailable, match="try again"):
            start(second).result(20)
    with database.write():
        pass
    database.close()
