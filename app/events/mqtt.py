"""Connection to an MQTT broker that gets the events: QoS 1, the last event of each environment retained.

Each connection is a new session: the outbox remembers what the broker has accepted, not the broker or this client.
Without a broker nothing is queued here, and commits go on.
"""

from __future__ import annotations

import contextlib
import logging
import ssl
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final
from urllib.parse import unquote, urlsplit

from paho.mqtt.client import Client, ConnectFlags, DisconnectFlags, MQTTMessageInfo
from paho.mqtt.enums import CallbackAPIVersion, MQTTErrorCode, MQTTProtocolVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from paho.mqtt.reasoncodes import ReasonCode

from app.errors import Unavailable
from app.events import messages
from app.setting_values import BROKER_PORTS, check_broker
from app.store.outbox import RelayName

log = logging.getLogger(__name__)

CONNECT_SECONDS: Final = 10.0
"""Maximum duration of an attempt to connect, with TLS and login."""

RETRY_SECONDS: Final = 2.0
"""Interval between attempts to connect."""

ACCEPT_SECONDS: Final = 30.0
"""Time within which the broker must accept an event; after that the connection counts as lost."""

KEEP_ALIVE_SECONDS: Final = 20


@dataclass(frozen=True, slots=True)
class MqttOptions:
    """Where the broker is and how to log in. prefix: of all topics. ca: certification authority (PEM) for ``mqtts``.

    password_file: file with the password, read at each attempt to connect, so that it can be changed.
    """

    host: str
    port: int
    tls: bool
    prefix: str = messages.PREFIX
    user: str | None = None
    password: str | None = field(default=None, repr=False)
    password_file: Path | None = None
    ca: Path | None = None

    @classmethod
    def from_url(
        cls, url: str, prefix: str = messages.PREFIX, password_file: Path | None = None, ca: Path | None = None
    ) -> MqttOptions:
        """Read ``mqtt://`` or ``mqtts://[user[:password]@]host[:port]``. Raises ValueError."""
        check_broker(url, password_file, ca)
        parts = urlsplit(url)
        user, password = (None if text is None else unquote(text) for text in (parts.username, parts.password))
        port = parts.port or BROKER_PORTS[parts.scheme]
        return cls(parts.hostname or "", port, parts.scheme == "mqtts", prefix, user, password, password_file, ca)

    def read_password(self) -> str | None:
        """Return the password. Raises OSError."""
        return self.password if self.password_file is None else self.password_file.read_text().rstrip("\r\n")


class MqttBroker:
    """Connection to a broker that the relay publishes to. For one thread."""

    relay: RelayName = "mqtt"
    history = 1

    def __init__(self, options: MqttOptions) -> None:
        self.options = options
        self.opened = 0
        self._client: Client | None = None
        self._problem = "not connected yet"
        self._answered, self._is_accepted = threading.Event(), False
        self._accepting: list[MQTTMessageInfo] = []
        self._refused: str | None = None
        self._next_try = 0.0

    @property
    def title(self) -> str:
        """Where it is connected to, for the log."""
        return f"MQTT at {self._address}"

    @property
    def state(self) -> dict[str, str]:
        """``{state: connected | down, detail?}`` for /readyz."""
        return {"state": "connected"} if self.connected else {"state": "down", "detail": self._problem}

    @property
    def connected(self) -> bool:
        """Whether the broker has accepted the session, and neither side has ended it."""
        return self._client is not None and self._client.is_connected()

    def ensure_connected(self) -> bool:
        """Connect if there is no session, at most every RETRY_SECONDS; return whether there is one."""
        if self.connected:
            return True
        self._disconnect()
        if time.monotonic() < self._next_try:
            return False
        try:
            self._connect()
        except Unavailable:
            self._disconnect()
            return False
        except (OSError, ValueError) as error:  # ValueError: a text that MQTT cannot transfer
            self._problem = f"no connection to {self._address}: {_reason(error)}"
            self._disconnect()
            return False
        finally:
            self._next_try = time.monotonic() + RETRY_SECONDS
        self.opened += 1
        return True

    def publish(self, environment: str, body: Mapping[str, Any]) -> None:
        """Send an event. Raises Unavailable without a session."""
        if self._client is None:
            raise Unavailable(self._problem)
        topic = messages.events_key(self.options.prefix, environment)
        properties = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
        properties.ContentType = messages.JSON
        sent = self._client.publish(topic, messages.dumps(body), qos=1, retain=True, properties=properties)
        if sent.rc != MQTTErrorCode.MQTT_ERR_SUCCESS:
            raise Unavailable(
                f"could not publish to {self._address}: {sent.rc.name}" if self.connected else self._problem
            )
        self._accepting.append(sent)

    def flush(self) -> None:
        """Wait until the broker has accepted all events. Raises Unavailable; then they are to be sent again."""
        deadline = time.monotonic() + ACCEPT_SECONDS
        accepting, self._accepting = self._accepting, []
        for sent in accepting:
            while not sent.is_published():
                if not self.connected:
                    raise Unavailable(self._problem)
                if time.monotonic() > deadline:
                    self._problem = f"{self._address} has not accepted an event within {ACCEPT_SECONDS:g} seconds"
                    self._disconnect()
                    raise Unavailable(self._problem)
                sent.wait_for_publish(0.1)
        refused, self._refused = self._refused, None
        if refused is not None:
            raise Unavailable(f"{self._address} refuses events: {refused}")

    def close_publishers(self) -> None:
        """Do nothing: what is retained belongs to the broker."""

    def close(self) -> None:
        """Disconnect."""
        self._disconnect()

    @property
    def _address(self) -> str:
        return f"{self.options.host}, port {self.options.port}"

    def _connect(self) -> None:
        options = self.options
        client = Client(CallbackAPIVersion.VERSION2, protocol=MQTTProtocolVersion.MQTTv5, reconnect_on_failure=False)
        client.connect_timeout = CONNECT_SECONDS
        client.on_connect, client.on_disconnect = self._on_connect, self._on_disconnect
        client.on_publish = self._on_publish
        if options.user is not None:
            client.username_pw_set(options.user, options.read_password())
        if options.tls:
            client.tls_set_context(ssl.create_default_context(cafile=options.ca))
        self._answered.clear()
        self._is_accepted = False
        self._refused, self._accepting = None, []
        self._problem = f"{self._address} does not answer"
        self._client = client
        client.connect(options.host, options.port, keepalive=KEEP_ALIVE_SECONDS, clean_start=True)
        client.loop_start()
        self._answered.wait(CONNECT_SECONDS)
        if not client.is_connected():
            raise Unavailable(self._problem)

    def _disconnect(self) -> None:
        client, self._client = self._client, None
        self._accepting = []
        if client is not None:
            with contextlib.suppress(OSError, ValueError):
                client.disconnect()
            client.loop_stop()

    def _on_connect(self, _: Client, __: Any, ___: ConnectFlags, code: ReasonCode, ____: Properties | None) -> None:
        self._is_accepted = not code.is_failure
        if code.is_failure:
            self._problem = f"{self._address} refuses the connection: {code}"
        self._answered.set()

    def _on_disconnect(
        self, _: Client, __: Any, flags: DisconnectFlags, code: ReasonCode, ___: Properties | None
    ) -> None:
        if self._is_accepted and code.is_failure:
            side = "the broker" if flags.is_disconnect_packet_from_server else "the connection"
            self._problem = f"lost {self._address}: {side} ended ({code}); reconnecting"
        self._answered.set()

    def _on_publish(self, _: Client, __: Any, ___: int, code: ReasonCode, ____: Properties | None) -> None:
        if code.is_failure:
            self._refused = str(code)


def _reason(error: Exception) -> str:
    if isinstance(error, ssl.SSLCertVerificationError):
        return f"its certificate is not trusted: {error.verify_message}"
    return str(error) or type(error).__name__
