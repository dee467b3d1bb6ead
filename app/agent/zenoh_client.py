"""Zenoh session of the robot: receives events and publishes the robot's status and liveliness token.

Events only trigger a sync; the signed manifest over HTTP decides. So a forged event causes a request and no change.
"""

from __future__ import annotations

import contextlib
import json
import random
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import zenoh
from zenoh import ext

from app.errors import FleetMapError
from app.events import messages
from app.events.credentials import ZenohCredentials, describe_connection_failure

CONNECTION_POLL_SECONDS = 0.5
"""Interval between two checks of the connection."""

CONNECT_MS = 5000
RETRY = {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2}
"""Pauses between attempts to reconnect; Zenoh's own grow to 4 s, at the same times for a whole fleet."""

MAX_PAUSE_SECONDS = 30.0
MAX_EVENT_BYTES = 2**18


class ZenohClient:
    """Zenoh session that a thread opens and keeps open. Thread-safe.

    Args:
        on_event: called with each event of the environment.
        on_connected: called after each connection to a router.
        on_lost: called with the reason if there is no connection, once per reason.
    """

    def __init__(
        self,
        environment: str,
        robot: str,
        *,
        on_event: Callable[[messages.Event], None],
        on_connected: Callable[[], None],
        on_lost: Callable[[str], None] = lambda _: None,
        config: Path | None = None,
        login: ZenohCredentials | None = None,
    ) -> None:
        self._environment, self._robot, self._on_event, self._on_connected, self._on_lost = (
            environment,
            robot,
            on_event,
            on_connected,
            on_lost,
        )
        self._config, self._login = config, login or ZenohCredentials()
        self._endpoint: tuple[str, str] | None = None
        self._session: zenoh.Session | None = None
        self._declared: list[Any] = []
        self._lock = threading.Lock()
        self._stopping = threading.Event()
        self._aimed = threading.Event()
        self._thread: threading.Thread | None = None
        self.problem: str | None = None

    def set_endpoint(self, connect: str, prefix: str) -> None:
        """Set the address of the router. The first call starts the thread; another address reopens the session."""
        if self._endpoint == (connect, prefix):
            return
        self._endpoint = (connect, prefix)
        self._aimed.set()
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="fleetmap-ear", daemon=True)
            self._thread.start()

    @property
    def has_endpoint(self) -> bool:
        """Whether a router address is set."""
        return self._endpoint is not None

    @property
    def connected(self) -> bool:
        """Whether the session is connected to a router."""
        session = self._session
        try:
            return session is not None and bool(session.info.routers_zid())
        except zenoh.ZError:
            return False

    def put_status(self, status: messages.RobotStatus) -> bool:
        """Publish the robot's status. Return whether it was handed to a router."""
        with self._lock:
            if self._session is None or self._endpoint is None or not self.connected:
                return False
            key = messages.status_key(self._endpoint[1], self._environment, self._robot)
            try:
                self._session.put(
                    key,
                    messages.dumps(status.as_dict()),
                    encoding=messages.JSON,
                    congestion_control=zenoh.CongestionControl.DROP,
                    express=True,
                )
            except zenoh.ZError:
                return False
            return True

    def close(self) -> None:
        """Close the session, which withdraws the robot's liveliness token."""
        self._stopping.set()
        self._aimed.set()
        if self._thread is not None:
            self._thread.join(CONNECT_MS / 1000 + 5)
        self._close_session()

    # --- thread ---

    def _run(self) -> None:
        pause = 1.0
        was_connected = False
        last_problem: str | None = None
        while not self._stopping.is_set():
            if self._aimed.is_set():
                self._aimed.clear()
                self._close_session()
                was_connected = False
            if self._session is None:
                if not self._open():
                    if self.problem is not None and self.problem != last_problem:
                        self._on_lost(self.problem)
                        last_problem = self.problem
                    self._aimed.wait(pause * random.uniform(0.5, 1.5))  # noqa: S311  jitter is no secret
                    pause = min(MAX_PAUSE_SECONDS, pause * 2)
                    continue
                pause = 1.0
            now = self.connected
            if now and not was_connected:
                last_problem = None
                self._on_connected()
            elif was_connected and not now:
                self._on_lost(f"lost the connection to the router at {self._endpoint[0] if self._endpoint else ''}")
            was_connected = now
            self._aimed.wait(CONNECTION_POLL_SECONDS)

    def _open(self) -> bool:
        assert self._endpoint is not None
        connect, prefix = self._endpoint
        try:
            session = zenoh.open(configuration(connect, self._config, self._login))
        except Exception as error:  # noqa: BLE001  zenoh raises one class for everything
            self.problem = describe_connection_failure(connect, error, self._login)
            return False
        try:
            declarations = [
                session.liveliness().declare_token(messages.robot_key(prefix, self._robot)),
                ext.declare_advanced_subscriber(
                    session,
                    messages.events_key(prefix, self._environment),
                    self._on_sample,
                    history=ext.HistoryConfig(detect_late_publishers=True),
                    recovery=ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
                ),
            ]
        except Exception as error:  # noqa: BLE001
            self.problem = f"the router at {connect} refuses the subscription: {error}"
            with contextlib.suppress(Exception):
                _close(session)
            return False
        with self._lock:
            self._session, self._declared = session, declarations
        self.problem = None
        return True

    def _on_sample(self, sample: zenoh.Sample) -> None:
        if sample.kind != zenoh.SampleKind.PUT or len(sample.payload) > MAX_EVENT_BYTES:
            return
        try:
            event = messages.Event.from_json(bytes(sample.payload))
        except FleetMapError:
            return
        self._on_event(event)

    def _close_session(self) -> None:
        with self._lock:
            session, declarations = self._session, self._declared
            self._session, self._declared = None, []
        for declaration in declarations:
            with contextlib.suppress(Exception):
                declaration.undeclare()
        if session is not None:
            with contextlib.suppress(Exception):
                _close(session)


def configuration(connect: str, file: Path | None = None, login: ZenohCredentials | None = None) -> zenoh.Config:
    """Return the configuration of a Zenoh client.

    Args:
        connect: router addresses, comma-separated.
        file: JSON5 file with further settings of Zenoh.

    Raises Invalid if a file of ``login`` is missing.
    """
    config: zenoh.Config = zenoh.Config.from_file(str(file)) if file is not None else zenoh.Config()
    values: Mapping[str, Any] = {
        "mode": "client",
        "connect/endpoints": [part.strip() for part in connect.split(",") if part.strip()],
        "connect/timeout_ms": CONNECT_MS,
        "connect/exit_on_failure": True,
        **({} if file is not None else {"connect/retry": RETRY}),
        "listen/endpoints": [],
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
        **(login or ZenohCredentials()).values(),
    }
    for key, value in values.items():
        config.insert_json5(key, json.dumps(value))
    return config


def _close(session: Any) -> None:
    session.close()
