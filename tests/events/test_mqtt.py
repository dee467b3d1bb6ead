"""MQTT: each event reaches a real broker, in order and at least once, and the last one stays there."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

import pytest

from app.backends.lead import LocalLeads
from app.errors import Unavailable
from app.events.mqtt import MqttBroker, MqttOptions
from app.events.relay import Relay
from app.store.store import Store
from tests.api.conftest import Api, empty_database, running, settings_for
from tests.certificates import Authority
from tests.events.conftest import eventually
from tests.mosquitto import PASSWORD, USER, Broker, Subscriber
from tests.ports import free_port


@pytest.fixture(scope="module")
def authority(tmp_path_factory: pytest.TempPathFactory) -> Authority:
    return Authority(tmp_path_factory.mktemp("authority"))


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Broker]:
    """A broker that everybody on this machine may use."""
    broker = Broker(tmp_path / "broker")
    yield broker
    broker.kill()


@pytest.fixture
def secured(tmp_path: Path, authority: Authority) -> Iterator[Broker]:
    """A broker with TLS and users."""
    broker = Broker(tmp_path / "secured", authority=authority)
    yield broker
    broker.kill()


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    (tmp_path / "store.sqlite").write_bytes(empty_database())
    store = Store(f"sqlite:///{tmp_path / 'store.sqlite'}", tmp_path / "blobs")
    yield store
    store.close()


def state_of(api: Api) -> str:
    return str(api.get("/readyz").json()["mqtt"]["state"])


def test_events_survive_a_killed_broker(secured: Broker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert secured.authority is not None
    (tmp_path / "password").write_text(PASSWORD + "\n")
    settings = settings_for(
        tmp_path / "data",
        mqtt_url=f"mqtts://{USER}@localhost:{secured.port}",
        mqtt_password_file=tmp_path / "password",
        mqtt_ca=secured.authority.pem,
    )
    is_allowed, connect = threading.Event(), MqttBroker.ensure_connected
    is_allowed.set()
    monkeypatch.setattr(MqttBroker, "ensure_connected", lambda self: is_allowed.is_set() and connect(self))
    monkeypatch.setattr("app.events.mqtt.RETRY_SECONDS", 0.1)
    with running(settings) as api:
        eventually(lambda: state_of(api) == "connected")
        subscriber = Subscriber(secured)
        for name in ("farm", "street"):
            api.post("environments", {"name": name})
        for k in range(3):
            api("PUT", f"environments/farm/channels/c{k}", 200, json={"version": 0})
        eventually(lambda: subscriber.sequences("farm") == [1, 2, 3, 4])
        assert {(topic, qos) for topic, _, qos, _ in subscriber.messages} == {
            ("fleetmap/farm/events", 1),
            ("fleetmap/street/events", 1),
        }
        late = Subscriber(secured)
        eventually(lambda: len(late.messages) == 2)
        assert sorted((event["environment"], event["sequence"]) for _, event, _, _ in late.messages) == [
            ("farm", 4),
            ("street", 1),
        ]
        assert all(retained for _, _, _, retained in late.messages)
        subscriber.close()
        late.close()

        is_allowed.clear()
        secured.kill()
        for k in range(3, 6):
            api("PUT", f"environments/farm/channels/c{k}", 200, json={"version": 0})
        state = eventually(lambda: (s := api.get("/readyz").json()["mqtt"])["state"] == "down" and s)
        assert f"localhost, port {secured.port}" in state["detail"]
        secured.start()
        subscriber = Subscriber(secured)
        is_allowed.set()
        eventually(lambda: subscriber.sequences("farm") == [5, 6, 7])
        eventually(lambda: subscriber.sequences("street") == [1])  # the broker has lost what it retained
        late = Subscriber(secured)
        eventually(lambda: late.sequences("farm") == [7] and late.sequences("street") == [1])
        subscriber.close()
        late.close()


def test_broker_gets_the_last_events_at_first(broker: Broker, store: Store, tmp_path: Path) -> None:
    """Not a log of years."""
    for name in ("farm", "street"):
        store.environments.create(name)
        for k in range(3):
            store.channels.move(name, f"c{k}", 0, author="test")
    subscriber = Subscriber(broker)
    relay = start(store, broker, tmp_path)
    eventually(lambda: subscriber.sequences("farm") == [4] and subscriber.sequences("street") == [4])
    store.channels.move("farm", "c3", 0, author="test")
    eventually(lambda: subscriber.sequences("farm") == [4, 5])
    relay.close()
    subscriber.close()


def start(store: Store, broker: Broker, folder: Path) -> Relay:
    relay = Relay(store, MqttBroker(options(broker)), folder, LocalLeads(folder))
    relay.start()
    return relay


def options(broker: Broker) -> MqttOptions:
    return MqttOptions.from_url(f"mqtt://127.0.0.1:{broker.port}")


def test_another_server_takes_over(broker: Broker, store: Store, tmp_path: Path) -> None:
    store.environments.create("farm")
    subscriber = Subscriber(broker)
    relays = [start(store, broker, tmp_path), start(store, broker, tmp_path)]
    eventually(lambda: subscriber.sequences("farm") == [1])
    for k in range(40):
        store.channels.move("farm", f"c{k}", 0, author="test")
        if k == 20:
            relays[0].close()
    eventually(lambda: subscriber.sequences("farm") == list(range(1, 42)))
    relays[1].close()
    subscriber.close()


def test_refused_events_are_reported(tmp_path: Path) -> None:
    broker = Broker(tmp_path / "broker", rules="topic read #\n")
    connection = MqttBroker(options(broker))
    try:
        assert connection.ensure_connected()
        connection.publish("farm", {"sequence": 1})
        with pytest.raises(Unavailable, match="refuses events: Not authorized"):
            connection.flush()
    finally:
        connection.close()
        broker.kill()


def test_broker_that_is_lost_between_two_events_is_unavailable(tmp_path: Path) -> None:
    broker = Broker(tmp_path / "broker")
    connection = MqttBroker(options(broker))
    try:
        assert connection.ensure_connected()
        broker.kill()
        eventually(lambda: not connection.connected)
        with pytest.raises(Unavailable, match="lost "):
            connection.publish("farm", {"sequence": 1})
        connection.flush()
    finally:
        connection.close()


@pytest.mark.filterwarnings("ignore:.*SSLSocket:pytest.PytestUnraisableExceptionWarning")  # paho drops it unclosed
def test_failed_logins_are_reported(secured: Broker, tmp_path: Path) -> None:
    assert secured.authority is not None
    stranger = Authority(tmp_path / "stranger").pem
    address, pem = f"localhost:{secured.port}", secured.authority.pem
    (tmp_path / "unreadable").mkdir()
    for given, word in (
        (MqttOptions.from_url(f"mqtts://{USER}:wrong@{address}", ca=pem), "Not authorized"),
        (MqttOptions.from_url(f"mqtts://{address}", ca=pem), "Not authorized"),
        (MqttOptions.from_url(f"mqtts://{address}", ca=stranger), "its certificate is not trusted"),
        (MqttOptions.from_url(f"mqtts://{address}"), "its certificate is not trusted"),
        (MqttOptions.from_url(f"mqtts://{USER}@{address}", ca=pem, password_file=tmp_path / "unreadable"), "directory"),
        (MqttOptions.from_url(f"mqtt://127.0.0.1:{free_port()}"), "refused"),
    ):
        connection = MqttBroker(given)
        assert not connection.ensure_connected()
        assert word in connection.state["detail"], (word, connection.state)
        with pytest.raises(Unavailable):
            connection.publish("farm", {})
        connection.close()
    right = MqttBroker(MqttOptions.from_url(f"mqtts://{USER}:{quote(PASSWORD, safe='')}@{address}", ca=pem))
    assert right.ensure_connected(), right.state
    assert PASSWORD not in repr(right.options)
    right.close()


@pytest.mark.parametrize(
    ("more", "word"),
    [
        ({"mqtt_url": "tcp://broker"}, "mqtt_url must be mqtt://"),
        ({"mqtt_url": "mqtt://broker/path"}, "mqtt_url must be mqtt://"),
        ({"mqtt_url": "mqtt://broker:99999"}, "[Pp]ort"),
        ({"mqtt_url": "mqtt://broker", "mqtt_ca": "ca.pem"}, "mqtt_ca requires TLS"),
        ({"mqtt_url": "mqtt://fleet@broker"}, "user without a password"),
        ({"mqtt_url": "mqtt://broker", "mqtt_password_file": "file"}, "requires a user"),
        ({"mqtt_password_file": os.devnull}, "require mqtt_url"),
    ],
)
def test_incomplete_settings_are_refused(tmp_path: Path, more: dict[str, str], word: str) -> None:
    with pytest.raises(ValueError, match=word):
        settings_for(tmp_path, **more)
