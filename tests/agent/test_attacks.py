"""Attackers between robot and server, or in place of the server, cannot install a wrong or an old map."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pytest
from backports import zstd

from app.agent import signatures
from app.agent.agent import Agent, AgentOptions
from app.errors import Untrusted
from app.signing import Keys, key_id
from tests.agent.conftest import Gate, network, whole
from tests.api.conftest import ADMIN, Api

SIGNATURE = "fleetmap-signature"
Changed = tuple[int, dict[str, str], bytes]
Change = Callable[[str, int, dict[str, str], bytes], Changed]


class Once:
    """``fleetmap agent --once`` within this process: there are many attacks."""

    def __init__(self, server: str, env: str, into: Path, key: str | None = None) -> None:
        self.into = into
        self.lines: list[dict[str, Any]] = []
        agent = Agent(
            AgentOptions(
                server=server, environment=env, formats=("tmap2",), into=into, robot=into.name, token=ADMIN, key=key
            ),
            lambda event, **members: self.lines.append({"event": event, **members}),
        )
        try:
            agent.open()
            self.good = agent.run_once()
        finally:
            agent.close()

    def saw(self, event: str, **members: Any) -> dict[str, Any] | None:
        fits = (x for x in self.lines if x["event"] == event and all(x.get(k) == v for k, v in members.items()))
        return next(fits, None)


Start = Callable[..., Once]


@pytest.fixture
def robot(api: Api, place: str, tmp_path: Path) -> Start:
    """Sync once."""

    def start(*, server: str | None = None, name: str = "robot", key: str | None = None) -> Once:
        return Once(server or api.url, place, tmp_path / name, key)

    return start


@pytest.fixture
def keys(api: Api, folder: Path) -> Keys:
    """The server's own keys: what a signed manifest is made with."""
    api.get("keys")
    return Keys(folder / "keys")


def signed(keys: Keys, **members: Any) -> Change:
    """Manifests with other members, signed."""

    def change(path: str, status: int, headers: dict[str, str], body: bytes) -> Changed:
        if "/manifest" not in path or status != 200:
            return status, headers, body
        data = json.dumps({**json.loads(body), **members}).encode()
        key, signature = keys.sign(data)
        return 200, {**headers, SIGNATURE: f"{key}:{base64.b64encode(signature).decode()}"}, data

    return change


def on(part: str, change: Callable[[bytes], bytes]) -> Change:
    """Other bodies at some addresses."""

    def apply(path: str, status: int, headers: dict[str, str], body: bytes) -> Changed:
        return status, headers, change(body) if part in path and status == 200 else body

    return apply


def attacked(
    robot: Start, gate: Gate, *, word: str, holds: int | None = 1, about: int | None = None, **rest: Any
) -> None:
    """Run an agent that must refuse, report the reason and keep its map."""
    gate.statuses.clear()
    one = robot(server=gate.url, **rest)
    assert not one.good, one.lines
    refusal = one.saw("refused")
    assert refusal, one.lines
    assert word in refusal["detail"], refusal
    assert gate.statuses[-1]["state"] == "failed"
    assert word in gate.statuses[-1]["detail"]
    if holds is None:
        assert not (one.into / "current").exists()
    else:
        assert whole(one.into)["version"] == holds
        assert gate.statuses[-1]["version"] == (holds if about is None else about)


@pytest.fixture
def lagging(api: Api, place: str, robot: Start, gate: Gate) -> str:
    """Environment at version 2 whose robot still runs version 1."""
    assert robot(server=gate.url).good
    api.upload(place, {"n.tmap2.yaml": network(1)})
    return place


def recover(robot: Start, gate: Gate) -> None:
    """Without the attack all is well at once."""
    gate.change = None
    one = robot(server=gate.url)
    assert one.good, one.lines
    assert whole(one.into)["version"] == 2


DANGEROUS = (
    *("LD_PRELOAD", "PATH", "PROMPT_COMMAND", "GAZEBO_PLUGIN_PATH"),
    *("OPENSSL_CONF", "ZENOH_CONFIG_OVERRIDE", "ROS_MASTER_URI", "FLEETMAP_TOKEN"),
)


def test_variables_that_change_how_programs_run_are_left_out(
    lagging: str, robot: Start, gate: Gate, keys: Keys
) -> None:
    gate.change = signed(keys, variables={**dict.fromkeys(DANGEROUS, "/x"), "FARM_NAME": "Riseholme"})
    one = robot(server=gate.url)
    assert one.good, one.lines
    assert whole(one.into)["version"] == 2
    text = (one.into / "current" / "environment.sh").read_text()
    assert "export FARM_NAME=Riseholme\n" in text
    assert not [name for name in DANGEROUS if name in text]
    assert "/x" not in text
    assert gate.statuses[-1]["state"] == "active"
    assert all(name in gate.statuses[-1]["detail"] for name in DANGEROUS), gate.statuses[-1]


INVALID_VARIABLES = ({"A B": "/x"}, {"A;rm": "/x"}, {"A": "1\n2"}, {"A": 7}, {"PATH": 7}, [1], [[1, "x"]], "x")


def test_invalid_variables_are_refused(lagging: str, robot: Start, gate: Gate, keys: Keys) -> None:
    for variables in INVALID_VARIABLES:
        gate.change = signed(keys, variables=variables)
        attacked(robot, gate, word="manifest")
    recover(robot, gate)


def test_old_manifest_is_refused(api: Api, lagging: str, robot: Start, gate: Gate) -> None:
    path = f"environments/{lagging}/versions/latest/manifest?formats=tmap2"
    gate_open = robot(server=gate.url)
    assert gate_open.good
    before = api.get(path)
    api.upload(lagging, {"n.tmap2.yaml": network(2)})
    assert robot(server=gate.url).good

    def replay(path: str, status: int, headers: dict[str, str], body: bytes) -> Changed:
        if "/manifest" not in path:
            return status, headers, body
        return 200, dict(before.headers), before.content

    gate.change = replay
    attacked(robot, gate, word="sequence 3 is lower than 4", holds=3)


MANIFESTS: tuple[tuple[dict[str, Any], str], ...] = (
    ({"expires": "2020-01-01T00:00:00Z"}, "expired"),
    ({"expires": (datetime.now(timezone.utc) - timedelta(seconds=200)).isoformat()}, "expired"),
    ({"environment": "elsewhere"}, "belongs to environment 'elsewhere'"),
    ({"channel": "staging"}, "belongs to channel 'staging'"),
    ({"channel": None}, "belongs to channel None"),
    ({"sequence": 1, "root": "0" * 64}, "possible rollback"),
    ({"sequence": -1}, "invalid manifest"),
    ({"sequence": True}, "invalid manifest"),
    ({"root": "x"}, "invalid manifest"),
    ({"expires": "2990-01-01T00:00:00"}, "invalid manifest"),
    ({"files": []}, "missing tmap2"),
    ({"files": [{"format": "tmap2", "name": "../../../x", "size": 1, "sha256": "0" * 64}]}, "file path"),
    ({"files": [{"format": "tmap2", "name": "/etc/x", "size": 1, "sha256": "0" * 64}]}, "file path"),
    ({"files": [{"format": "..", "name": "x", "size": 1, "sha256": "0" * 64}]}, "file path"),
    ({"files": [{"format": "tmap2", "name": "a\nb", "size": 1, "sha256": "0" * 64}]}, "file path"),
    ({"files": [{"format": "tmap2", "name": "a/" * 1500 + "b", "size": 1, "sha256": "0" * 64}]}, "file path"),
    ({"files": [{"format": "tmap2", "name": "x" * 300, "size": 1, "sha256": "0" * 64}]}, "file path"),
    ({"files": [{"format": "tmap2", "name": "x", "size": 1, "sha256": "../../x"}]}, "invalid manifest"),
    ({"files": [{"format": "tmap2", "name": n, "size": 1, "sha256": "0" * 64} for n in ("a", "a/b")]}, "folder"),
    ({"files": 7}, "invalid manifest"),
)  # fmt: skip
"""Signed members that a server never sends to this robot, and a word of the refusal."""


def test_manifest_of_other_environment_or_channel_is_refused(
    lagging: str, robot: Start, gate: Gate, keys: Keys
) -> None:
    for members, word in MANIFESTS:
        gate.change = signed(keys, **members)
        attacked(robot, gate, word=word)
    recover(robot, gate)


def test_manifest_is_accepted_with_clock_skew_of_seconds(lagging: str, robot: Start, gate: Gate, keys: Keys) -> None:
    gate.change = signed(keys, expires=(datetime.now(timezone.utc) - timedelta(seconds=20)).isoformat())
    assert robot(server=gate.url).good


UNSIGNED: tuple[tuple[Change, str], ...] = (
    (on("/manifest", lambda body: body.replace(b'"version":2', b'"version":9')), "changed in transit"),
    (on("/manifest", lambda _: b"x"), "changed in transit"),
    (lambda p, s, h, b: (s, {k: v for k, v in h.items() if k != SIGNATURE}, b), "no valid signature"),
)


def test_unsigned_manifest_is_refused(lagging: str, robot: Start, gate: Gate) -> None:
    for change, word in UNSIGNED:
        gate.change = change
        attacked(robot, gate, word=word)
    recover(robot, gate)


WRONG_BYTES: tuple[Callable[[bytes], bytes], ...] = (
    lambda b: b[:-2] + b"x\n", lambda b: b + b"x", lambda b: b[:-1], lambda _: b"", lambda b: b * 50,
)  # fmt: skip


def test_wrong_bytes_are_refused(lagging: str, robot: Start, gate: Gate) -> None:
    gate.deltas = False
    for change in WRONG_BYTES:
        gate.change = on("/maps/", change)
        attacked(robot, gate, word="differs from the manifest", about=2)
    recover(robot, gate)


@pytest.mark.parametrize("kind", ["bomb", "nonsense", "other"])
def test_poisoned_delta_is_replaced_by_the_complete_file(lagging: str, robot: Start, gate: Gate, kind: str) -> None:
    bodies = {"bomb": lambda b: b[:40] + zstd.compress(bytes(2**30)), "nonsense": lambda b: b[:40] + b"nonsense"}
    change = bodies.get(kind, lambda _: b"x" * 60)
    gate.change = lambda p, s, h, b: (s, h, change(b) if h.get("content-encoding") == "dcz" else b)
    one = robot(server=gate.url)
    assert one.good, one.lines
    assert whole(one.into)["version"] == 2
    switched = one.saw("switched")
    assert switched is not None
    assert switched["deltas"] == 0
    assert "1 deltas could not be decoded" in switched["detail"]


def test_foreign_key_is_refused(lagging: str, robot: Start, gate: Gate, tmp_path: Path) -> None:
    foreign = Keys(tmp_path / "foreign")
    sign = signed(foreign)

    def change(path: str, status: int, headers: dict[str, str], body: bytes) -> Changed:
        if path.endswith("/keys"):
            foreign_key = foreign.public()[0].as_dict()
            endorsed = {"endorsed_by": json.loads(body)[0]["id"], "endorsement": base64.b64encode(bytes(64)).decode()}
            return 200, headers, json.dumps([{**foreign_key, **endorsed}, *json.loads(body)]).encode()
        return sign(path, status, headers, body)

    gate.change = change
    attacked(robot, gate, word="does not endorse")
    gate.change = sign
    attacked(robot, gate, word="which the server does not list")
    recover(robot, gate)


def test_rotated_key_replaces_old_key(api: Api, lagging: str, robot: Start, gate: Gate, keys: Keys) -> None:
    old = api.get(f"environments/{lagging}/versions/latest/manifest?formats=tmap2")
    api.post("keys")
    api.post("keys")
    one = robot(server=gate.url)
    assert one.good, one.lines
    assert one.saw("trusting", detail="rotated")
    assert whole(one.into)["version"] == 2
    gate.change = lambda p, s, h, b: (200, dict(old.headers), old.content) if "/manifest" in p else (s, h, b)
    attacked(robot, gate, word="does not endorse", holds=2)


def test_trusted_key_can_be_set(api: Api, place: str, robot: Start, gate: Gate) -> None:
    key = api.get("keys").json()[0]
    attacked(robot, gate, key="0" * 16, word="does not endorse", holds=None)
    other = base64.b64encode(bytes(range(32))).decode()
    attacked(robot, gate, key=other, word="does not endorse", holds=None)
    assert robot(key=f" {key['id']}\n", name="by-id").good
    assert robot(key=key["public_key"], name="by-key").good
    with pytest.raises(Untrusted, match="invalid --key"):
        robot(key="nonsense", name="wrong")


def test_expired_manifest_is_fetched_again(api: Api, place: str, robot: Start, gate: Gate) -> None:
    one = robot(server=gate.url)
    assert one.good

    def conditional_requests() -> list[bool]:
        gate.requests.clear()
        assert robot(server=gate.url).good
        return ["if-none-match" in sent for _, path, sent, _ in gate.requests if "/manifest" in path]

    assert conditional_requests() == [True]
    state = json.loads((one.into / "state.json").read_text())
    (one.into / "state.json").write_text(json.dumps({**state, "expires": 1.0}))
    assert conditional_requests() == [False], "else a 304 for ever would hold back all changes"


def test_token_is_not_logged(place: str, robot: Start, gate: Gate) -> None:
    one = robot(server=gate.url)
    assert one.good
    for path in one.into.rglob("*"):
        assert path.is_dir() or ADMIN.encode() not in path.read_bytes()
    assert ADMIN not in str(one.lines)


def test_endorsements_are_followed_back_to_the_trusted_key(tmp_path: Path) -> None:
    keys = Keys(tmp_path)
    first = keys.public()[0]
    for _ in range(7):
        keys.rotate()
    name, signature = keys.sign(b"data")
    header = f"{name}:{base64.b64encode(signature).decode()}"
    listed = [k.as_dict() for k in keys.public()]
    key = signatures.verify_signature(b"data", header, first.public, None, lambda: listed)
    assert key_id(key) == name == keys.public()[0].id
    assert signatures.verify_signature(b"data", header, None, first.id, lambda: listed) == key
    assert (
        signatures.verify_signature(b"data", header, None, base64.b64encode(first.public).decode(), lambda: listed)
        == key
    )
    for left in (0, 1, 6):  # a link of the chain is missing
        with pytest.raises(Untrusted, match=r"does not endorse|does not list"):
            signatures.verify_signature(
                b"data", header, first.public, None, lambda n=left: listed[:n] + listed[n + 1 :]
            )
    circle = [{**listed[0], "endorsed_by": listed[0]["id"]}]
    with pytest.raises(Untrusted, match="does not endorse"):
        signatures.verify_signature(b"data", header, first.public, None, lambda: circle)
