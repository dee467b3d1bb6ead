"""A real MQTT broker: Debian's mosquitto, on a loopback port, with or without TLS, users and rules."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from paho.mqtt.client import Client, MQTTMessage
from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion

from tests.certificates import Authority
from tests.ports import free_port

USER, PASSWORD = "fleet", "correct horse: battery@staple/ü"


class Broker:
    """mosquitto, which can be killed and started again. rules: lines of its access control list.

    It keeps nothing on disk: after a kill its retained messages are gone.
    """

    def __init__(self, folder: Path, *, authority: Authority | None = None, rules: str | None = None) -> None:
        program = shutil.which("mosquitto", path=f"{os.environ.get('PATH', '')}:/usr/sbin")
        if program is None:
            pytest.skip("mosquitto is missing: apt-get install mosquitto")
        self._program, self._config = program, folder / "mosquitto.conf"
        self.port = free_port()
        self.authority = authority
        folder.mkdir(parents=True, exist_ok=True)
        lines = [f"listener {self.port} 127.0.0.1", "persistence false", "log_dest stderr"]
        if os.getuid() == 0:
            lines.append("user root")  # otherwise it changes its user, who cannot read the files of tests
        if authority is not None:
            certificate, key = authority.sign("broker")
            passwords = folder / "passwords"
            subprocess.run(["mosquitto_passwd", "-c", "-b", str(passwords), USER, PASSWORD], check=True)
            lines += [f"certfile {certificate}", f"keyfile {key}", f"password_file {passwords}"]
        lines.append(f"allow_anonymous {'true' if authority is None else 'false'}")
        if rules is not None:
            (folder / "rules").write_text(rules)
            lines.append(f"acl_file {folder / 'rules'}")
        self._config.write_text("\n".join(lines) + "\n")
        self._process: subprocess.Popen[bytes] | None = None
        self.start()

    def start(self) -> None:
        self._process = subprocess.Popen(
            [self._program, "-c", str(self._config)], stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL
        )
        deadline = time.monotonic() + 60
        while True:
            try:
                socket.create_connection(("127.0.0.1", self.port)).close()
            except OSError:
                assert self._process.poll() is None, "mosquitto has ended"
                assert time.monotonic() < deadline, "mosquitto does not listen"
                time.sleep(0.02)
            else:
                return

    def kill(self) -> None:
        assert self._process is not None
        self._process.kill()
        self._process.wait()


class Subscriber:
    """A client that collects the messages of a topic. messages: (topic, event, QoS, whether it was retained)."""

    def __init__(self, broker: Broker, topic: str = "fleetmap/+/events") -> None:
        self.messages: list[tuple[str, dict[str, Any], int, bool]] = []
        self._subscribed = threading.Event()
        self._client = Client(CallbackAPIVersion.VERSION2, protocol=MQTTProtocolVersion.MQTTv5)
        if broker.authority is not None:
            self._client.username_pw_set(USER, PASSWORD)
            self._client.tls_set(ca_certs=str(broker.authority.pem))
        self._client.on_connect = lambda client, *_: client.subscribe(topic, qos=1)
        self._client.on_subscribe = lambda *_: self._subscribed.set()
        self._client.on_message = self._take
        self._client.connect("localhost" if broker.authority else "127.0.0.1", broker.port)
        self._client.loop_start()
        assert self._subscribed.wait(60), "the broker did not accept the subscription"

    def _take(self, _: Client, __: Any, message: MQTTMessage) -> None:
        self.messages.append((message.topic, json.loads(message.payload), message.qos, message.retain))

    def sequences(self, environment: str) -> list[int]:
        """Sequences of an environment, each once, in the order they first came."""
        listed = list(self.messages)
        return list(
            dict.fromkeys(event["sequence"] for _, event, _, _ in listed if event["environment"] == environment)
        )

    def close(self) -> None:
        self._client.disconnect()
        self._client.loop_stop()
