"""Leads: one process at a time has one, another gets it when that one ends, and a former leader cannot write."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from sqlalchemy import Connection

from app.backends.lead import LEASE_SECONDS, Lead, LeadLostError, Leads, SharedLead, SharedLeads, Term
from app.errors import Unavailable
from app.store.store import Store
from tests.events.conftest import eventually
from tests.postgres import Cluster
from tests.scale.proxy import Proxy

HOLDER = """
import sys
from pathlib import Path
from app.backends.lead import open_leads
leads = open_leads(sys.argv[1], Path(sys.argv[2]))
leads.start()
lead = leads.lead("task")
while not lead.try_acquire():
    pass
print("leads", flush=True)
sys.stdin.read()
"""


@contextlib.contextmanager
def other_process(url: str, folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Another process, of the same data folder or on the same database, that has the lead ``task``."""
    command = [sys.executable, "-c", HOLDER, url, str(folder)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == b"leads\n"
        yield process
    finally:
        process.kill()
        process.communicate()


@contextlib.contextmanager
def leading(leads: SharedLeads) -> Iterator[tuple[SharedLead, Term]]:
    """The lead ``task`` and its term, without the thread that holds elections."""
    try:
        lead = leads.lead("task")
        lead.try_acquire()
        leads._hold_elections()
        assert lead.term is not None
        yield lead, lead.term
    finally:
        leads._disconnect()


def write_after_release(store: Store, lead: Lead) -> None:
    with lead.fenced():
        lead.release()
        store.environments.create("barn")


def takeover_seconds(lead: Lead) -> float:
    """Wait until this process has a lead; return the seconds that it took."""
    start = time.monotonic()
    while not lead.try_acquire():
        assert time.monotonic() - start < 60
        time.sleep(0.01)
    return time.monotonic() - start


def test_one_process_has_the_lead(open_process: Callable[[], Leads]) -> None:
    first, second = open_process(), open_process()
    one, two = first.lead("task"), second.lead("task")
    eventually(one.try_acquire)
    assert not any(two.try_acquire() or time.sleep(0.05) for _ in range(12))
    assert one.is_held
    assert first.lead("task") is one
    eventually(second.lead("another").try_acquire)
    one.release()
    assert not one.is_held
    eventually(two.try_acquire)
    assert not one.try_acquire()
    second.close()
    eventually(one.try_acquire)


def test_lead_is_waited_for(open_process: Callable[[], Leads]) -> None:
    one, two = open_process().lead("task"), open_process().lead("task")
    term = one.acquire(60)
    assert term is not None
    assert term.goes_on
    assert two.acquire(0) is None
    one.release()
    assert two.acquire(60) is not None, "the first one takes part no more"
    assert one.acquire(0) is None


def test_host_lead_is_independent_of_other_servers(open_process: Callable[[], Leads]) -> None:
    leads = open_process()
    assert leads.host_lead("task").try_acquire()
    eventually(leads.lead("task").try_acquire)
    assert leads.roles() == {"task": True}


def test_lead_of_killed_process_is_free_at_once(
    database_url: str, tmp_path: Path, open_process: Callable[[], Leads]
) -> None:
    lead = open_process().lead("task")
    lead.release()
    folder = tmp_path if database_url.startswith("sqlite") else tmp_path / "other"
    folder.mkdir(exist_ok=True)
    with other_process(database_url, folder) as process:
        assert not lead.try_acquire()
        process.send_signal(signal.SIGKILL)
        assert takeover_seconds(lead) < 3


def test_former_leader_cannot_write(store: Store, open_process: Callable[[], Leads]) -> None:
    lead = open_process().lead("task")
    with pytest.raises(LeadLostError, match="another server has taken over"), lead.fenced():
        pass
    eventually(lead.try_acquire)
    with lead.fenced():
        store.environments.create("farm")
    with pytest.raises(LeadLostError):
        write_after_release(store, lead)
    store.environments.create("unfenced")
    assert [e.name for e in store.environments.page()[0]] == ["farm", "unfenced"]


def test_work_of_an_earlier_term_is_not_stored_in_a_later_one(store: Store, open_process: Callable[[], Leads]) -> None:
    lead, successor = open_process().lead("task"), open_process().lead("task")
    eventually(lead.try_acquire)
    earlier = lead.term
    assert earlier is not None
    assert earlier.goes_on

    def write_late() -> None:
        with earlier.fenced():
            lead.release()
            eventually(successor.try_acquire)
            successor.release()
            eventually(lead.try_acquire)
            store.environments.create("stale")

    with pytest.raises(LeadLostError):
        write_late()
    assert lead.is_held
    assert not earlier.goes_on
    with pytest.raises(LeadLostError), earlier.fenced():
        pass
    with lead.fenced():
        store.environments.create("fresh")
    assert [e.name for e in store.environments.page()[0]] == ["fresh"]


@pytest.mark.postgres
@pytest.mark.parametrize("database_url", ["postgres"], indirect=True)
class TestShared:
    """What only a lease can do."""

    def test_transaction_of_a_former_term_fails(
        self, store: Store, open_process: Callable[[], Leads], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        first, second = open_process(), open_process()
        lead, successor = first.lead("task"), second.lead("task")
        eventually(lead.try_acquire)
        assert isinstance(lead, SharedLead)
        term = lead.won
        first.close()
        eventually(successor.try_acquire)
        lead.won = term
        monkeypatch.setattr(SharedLeads, "has_lease", True)  # a clock that stood still
        assert lead.is_held
        with pytest.raises(LeadLostError), lead.fenced():
            store.environments.create("stale")
        with successor.fenced():
            store.environments.create("fresh")
        assert [e.name for e in store.environments.page()[0]] == ["fresh"]

    def test_lease_ends_while_the_host_is_suspended(self, database_url: str, tmp_path: Path) -> None:
        """A leader that wakes up asks the database first: the clock jumps, and its thread has not run again yet."""
        clock = [1000.0]
        with leading(SharedLeads(database_url, tmp_path, lambda: clock[0])) as (lead, term):
            clock[0] += LEASE_SECONDS
            assert not lead.is_held
            assert not term.goes_on
            with pytest.raises(LeadLostError), term.fenced():
                pass

    def test_process_knows_whether_another_one_led_meanwhile(
        self, database_url: str, tmp_path: Path, open_process: Callable[[], Leads]
    ) -> None:
        leads = SharedLeads(database_url, tmp_path)
        with leading(leads) as (lead, first):
            leads._lease_until = 0.0
            assert not first.goes_on
            leads._hold_elections()
            assert first.goes_on, "PostgreSQL has not ended the session"
            for _ in range(2):
                leads._disconnect()
                leads._hold_elections()
            assert lead.term is not None
            assert lead.term.number == first.number + 2
            assert lead.unbroken_since == first.number
            leads._disconnect()
            successor = open_process().lead("task")
            assert successor.acquire(60) is not None
            successor.release()
            eventually(lambda: leads._hold_elections() or lead.is_held)
            assert lead.term.number == lead.unbroken_since == first.number + 4

    def test_stopped_process_loses_the_lead(
        self, database_url: str, tmp_path: Path, open_process: Callable[[], Leads]
    ) -> None:
        lead = open_process().lead("task")
        (tmp_path / "other").mkdir()
        with other_process(database_url, tmp_path / "other") as process:
            process.send_signal(signal.SIGSTOP)
            assert takeover_seconds(lead) < LEASE_SECONDS + 1

    def test_leader_behind_a_silent_network_loses_the_lead(
        self, database_url: str, postgres_cluster: Cluster, tmp_path: Path, open_process: Callable[[], Leads]
    ) -> None:
        proxy = Proxy(postgres_cluster.port)
        (tmp_path / "far").mkdir()
        far = SharedLeads(database_url.replace(f":{postgres_cluster.port}/", f":{proxy.port}/"), tmp_path / "far")
        far.start()
        try:
            lead, successor = far.lead("task"), open_process().lead("task")
            eventually(lead.try_acquire)
            proxy.is_silent = True
            overlap, stop = [], threading.Event()

            def watch() -> None:
                while not stop.wait(0.005):
                    overlap.append(lead.is_held and successor.is_held)

            watcher = threading.Thread(target=watch)
            watcher.start()
            seconds = takeover_seconds(successor)
            stop.set()
            watcher.join()
            assert seconds < LEASE_SECONDS + 1
            assert not any(overlap), "it gives up before PostgreSQL frees the lead"
            proxy.is_silent = False
            successor.release()
            eventually(lead.try_acquire)
        finally:
            far.close()
            proxy.close()

    def test_relay_that_stands_still_in_a_transaction_does_not_stop_its_successor(
        self, store: Store, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """It has stored its position and not committed yet: PostgreSQL ends the transaction, which frees the row."""
        stored, goes_on = threading.Event(), threading.Event()
        store.events.set_relayed(1)

        def stand_still(_: Connection) -> None:
            if threading.current_thread() is former:
                stored.set()
                goes_on.wait(120)

        def store_late() -> None:
            with contextlib.suppress(Unavailable):
                store.events.set_relayed(2)

        monkeypatch.setattr("app.store.database.check_fences", stand_still)
        former = threading.Thread(target=store_late)
        successor = threading.Thread(target=store.events.set_relayed, args=(3,), daemon=True)
        former.start()
        try:
            assert stored.wait(60)
            successor.start()
            successor.join(60)
            assert not successor.is_alive(), "it waits for the row"
        finally:
            goes_on.set()
            former.join()
        assert store.events.relay_position() == 3

    def test_lead_returns_after_restart_of_the_database(
        self, postgres_cluster: Cluster, open_process: Callable[[], Leads], caplog: pytest.LogCaptureFixture
    ) -> None:
        lead = open_process().lead("task")
        eventually(lead.try_acquire)
        postgres_cluster.kill()
        eventually(lambda: not lead.is_held)
        postgres_cluster.restart()
        eventually(lead.try_acquire)
        assert caplog.text.count("leads: lost the connection") == 1
