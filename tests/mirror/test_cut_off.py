"""A mirror serves robots that trust its centre's key, also when it is cut off, until its permission ends."""

from __future__ import annotations

import base64
import itertools
import json
import os
import signal
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import pytest

from app.agent import signatures
from app.agent.agent import Agent, AgentOptions
from app.errors import Unavailable, Untrusted
from app.signing import Keys
from app.store.store import Store
from tests.agent.conftest import whole
from tests.api.conftest import ADMIN, Api, create_farm
from tests.events.conftest import eventually
from tests.mirror.conftest import Edge, long_network, mirror_token, stored_bytes
from tests.preloaded import PreloadedProcess

Make = Callable[..., Edge]
ROOT = Path(__file__).parents[2]
DAY = 86_400.0
_count = itertools.count(1)


@pytest.fixture
def farm(centre: Api) -> str:
    return create_farm(centre, f"grove-{next(_count)}")


class Robot:
    """An agent in this process that trusts the centre's key, with a clock that can be moved."""

    def __init__(self, server: Api, env: str, into: Path, key: str) -> None:
        self.ahead = 0.0
        self.log: list[dict[str, Any]] = []
        options = AgentOptions(server.url, env, ("tmap2",), into, token=ADMIN, robot="mower", channel="latest", key=key)
        self.agent = Agent(options, self._note, clock=lambda: time.time() + self.ahead)
        self.agent.open()
        self.into = into

    def _note(self, event: str, **members: Any) -> None:
        self.log.append({"event": event, **members})

    def accepts(self) -> bool:
        self.log.clear()
        return self.agent.run_once() and not any(line["event"] in ("refused", "unreachable") for line in self.log)


@pytest.fixture
def move_clock() -> Iterator[Callable[[Api, float], None]]:
    """Move the clock of a server so many seconds ahead."""
    stores: list[Store] = []
    with pytest.MonkeyPatch.context() as patch:

        def move(server: Api, seconds: float) -> None:
            store: Store = server.app.state.services.store
            patch.setattr(store._database, "now", lambda: datetime.now(UTC) + timedelta(seconds=seconds))
            store.generation.change()  # what is in memory was signed before
            stores.append(store)

        yield move
    for store in stores:
        store.generation.change()


@pytest.fixture
def clock(site: Api, move_clock: Callable[[Api, float], None]) -> Callable[[float], None]:
    """Move the clock of the edge's server so many seconds ahead."""
    return partial(move_clock, site)


def test_robot_accepts_for_48_hours_without_the_centre(
    centre: Api, site: Api, farm: str, follower: Make, clock: Callable[[float], None], tmp_path: Path
) -> None:
    edge = follower(farm)
    edge.follow()
    edge.wire.cut = True
    key = centre.get("keys").json()[0]["id"]
    robot = Robot(site, farm, tmp_path / "robot", key)
    signers = set()
    for hours in (0, 6, 24, 30, 48):
        clock(hours * 3600.0)
        robot.ahead = hours * 3600.0
        assert robot.accepts(), (hours, robot.log)
        signers.add((robot.into / "current" / "manifest.sig").read_text().partition(":")[0])
        with pytest.raises(Unavailable):
            edge.mirror.run_once()
    assert whole(robot.into)["version"] == 3
    assert signers == {site.get("keys").json()[0]["id"]}
    path = f"environments/{farm}/overlays"
    site.post(path, {"kind": "blocked", "edge": "gate_barn", "state": "accepted"})
    assert robot.accepts(), robot.log
    assert whole(robot.into)["edge_sequence"] == 1, "a closure of the edge is in the robot's map"
    clock(8 * DAY)
    robot.ahead = 8 * DAY
    assert not robot.accepts()
    assert "connect the mirror to its centre" in str(robot.log)
    assert whole(robot.into)["edge_sequence"] == 1, "it keeps its map"
    robot.agent.close()


def test_robot_accepts_all_along_while_its_centre_changes_for_48_hours(
    centre: Api, site: Api, farm: str, follower: Make, move_clock: Callable[[Api, float], None], tmp_path: Path
) -> None:
    """Before, while and after the mirror catches up, which transfers little more than what it lacks."""
    centre.upload(farm, {"network.tmap2.yaml": long_network()})
    edge = follower(farm)
    edge.follow()
    first = centre.get(f"environments/{farm}/versions/latest").json()["version"]
    edge.wire.cut = True
    robot = Robot(site, farm, tmp_path / "robot", centre.get("keys").json()[0]["id"])
    for hours in range(0, 49, 6):
        seconds = hours * 3600.0
        robot.ahead = seconds
        edge.now = lambda ahead=seconds: datetime.now(UTC) + timedelta(seconds=ahead)
        for server in (centre, site):
            move_clock(server, seconds)
        if hours % 12 == 6 and hours < 24:
            centre.upload(farm, {"network.tmap2.yaml": long_network(1 + hours // 12)})
        with pytest.raises(Unavailable):
            edge.mirror.run_once()
        assert robot.accepts(), (hours, robot.log)
        assert whole(robot.into)["version"] == first
    edge.wire.cut = False
    accepted: list[bool] = []

    def answer(request: httpx.Request) -> httpx.Response:
        """Have the robot ask the edge after each request of the mirror."""
        response = handle(request)
        accepted.append(robot.accepts())
        return response

    edge.wire.sent = edge.wire.received = 0
    before, handle = stored_bytes(edge.store), edge.wire.handle_request
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(edge.wire, "handle_request", answer)
        edge.follow()
    missing, transferred = stored_bytes(edge.store) - before, edge.wire.sent + edge.wire.received
    assert transferred <= 1.1 * missing, (transferred, missing)
    assert len(accepted) > 3
    assert all(accepted), robot.log
    assert robot.accepts(), robot.log
    assert (
        whole(robot.into)["version"]
        == centre.get(f"environments/{farm}/versions/latest").json()["version"]
        == first + 2
    )
    signer = (robot.into / "current" / "manifest.sig").read_text().partition(":")[0]
    assert signer == site.get("keys").json()[0]["id"]
    robot.agent.close()


def test_robot_moves_between_centre_and_edge(centre: Api, site: Api, farm: str, follower: Make, tmp_path: Path) -> None:
    edge = follower(farm)
    edge.follow()
    key = centre.get("keys").json()[0]["public_key"]
    first = Robot(centre, farm, tmp_path / "robot", key)
    assert first.accepts()
    first.agent.close()
    second = Robot(site, farm, tmp_path / "robot", key)
    assert second.accepts(), second.log
    second.agent.close()
    centre.post("keys", expect=201)
    edge.follow()
    third = Robot(site, farm, tmp_path / "robot", key)
    assert third.accepts(), third.log
    third.agent.close()
    last = Robot(centre, farm, tmp_path / "robot", key)
    assert last.accepts(), last.log
    last.agent.close()


@pytest.fixture
def permission(tmp_path: Path) -> tuple[Keys, Keys, dict[str, Any]]:
    """The keys of a centre and a mirror, and the members of a permission of one day for the environment grove."""
    now = datetime.now(UTC)
    members = {"start": now - timedelta(hours=1), "until": now + timedelta(days=1), "environment": "grove"}
    return Keys(tmp_path / "centre"), Keys(tmp_path / "edge"), members


def listed(centre: Keys, edge: Keys, members: dict[str, Any], signer: Keys | None = None) -> list[dict[str, Any]]:
    from app.signing import delegation_statement

    public = edge.public()[0].public
    statement = delegation_statement(public, members["environment"], members["start"], members["until"])
    by, signature = (signer or centre).sign(statement)
    one = {
        "statement": base64.b64encode(statement).decode(),
        "signed_by": by,
        "signature": base64.b64encode(signature).decode(),
    }
    keys = [key.as_dict() for key in edge.public()]
    return [{**keys[0], "delegations": [one]}, *keys[1:], *(key.as_dict() for key in centre.public())]


def verify(centre: Keys, edge: Keys, lines: list[dict[str, Any]], trusted: bytes | None = None, **more: Any) -> Any:
    key, signature = edge.sign(b"data")
    header = f"{key}:{base64.b64encode(signature).decode()}"
    options = {"environment": "grove", "now": datetime.now(UTC), **more}
    pinned = centre.public()[-1].public if trusted is None else trusted
    return signatures.verify_manifest(b"data", header, pinned, None, lambda: lines, **options)


def test_permission_is_for_one_key_environment_and_time(permission: tuple[Keys, Keys, dict[str, Any]]) -> None:
    centre, edge, members = permission
    trust = verify(centre, edge, listed(centre, edge, members))
    assert (trust.key, trust.root) == (edge.public()[0].public, centre.public()[0].public)
    assert trust.until == members["until"].replace(microsecond=0)
    refused: list[tuple[list[dict[str, Any]], dict[str, Any]]] = [
        (listed(centre, edge, members), {"environment": "field"}),
        (listed(centre, edge, members), {"now": datetime.now(UTC) + timedelta(days=2)}),
        (listed(centre, edge, members, signer=edge), {}),
        (listed(centre, edge, members)[1:], {}),
    ]
    for lines, more in refused:
        with pytest.raises(Untrusted):
            verify(centre, edge, lines, **more)
    changed = listed(centre, edge, members)
    statement = json.loads(base64.b64decode(changed[0]["delegations"][0]["statement"]))
    statement["until"] = "2099-01-01T00:00:00Z"
    changed[0]["delegations"][0]["statement"] = base64.b64encode(json.dumps(statement).encode()).decode()
    with pytest.raises(Untrusted, match="does not endorse"):
        verify(centre, edge, changed)
    edge.rotate()
    with pytest.raises(Untrusted, match="does not endorse"):
        verify(centre, edge, [key.as_dict() for key in edge.public()] + listed(centre, edge, members)[2:])


def test_permission_of_a_rotated_key_is_accepted(permission: tuple[Keys, Keys, dict[str, Any]]) -> None:
    centre, edge, members = permission
    first = centre.public()[0].public
    centre.rotate()
    trust = verify(centre, edge, listed(centre, edge, members), first)
    assert trust.root == centre.public()[0].public, "the robot trusts the newer key from now on"


def test_agents_before_mirrors_refuse_a_mirror(permission: tuple[Keys, Keys, dict[str, Any]]) -> None:
    centre, edge, members = permission
    key, signature = edge.sign(b"data")
    header = f"{key}:{base64.b64encode(signature).decode()}"
    with pytest.raises(Untrusted, match="does not endorse"):
        signatures.verify_signature(
            b"data", header, centre.public()[0].public, None, lambda: listed(centre, edge, members)
        )


def test_killed_mirror_leaves_the_old_or_the_new_state(centre: Api, farm: str, tmp_path: Path) -> None:
    data = tmp_path / "edge"
    token = tmp_path / "token"
    token.write_text(mirror_token(centre))
    clean = {k: v for k, v in os.environ.items() if not k.startswith("FLEETMAP_")}
    environment = {**clean, "PYTHONPATH": str(ROOT), "FLEETMAP_DATA_DIR": str(data)}

    def start() -> PreloadedProcess:
        arguments = ["mirror", centre.url, "--token-file", str(token), "-e", farm]
        return PreloadedProcess(arguments, env=environment, cwd=tmp_path)

    def heads() -> int:
        if not (data / "fleetmap.sqlite3").exists():
            return -1
        store = Store(f"sqlite:///{data}/fleetmap.sqlite3", data / "blobs", readonly=True)
        try:
            return next((one.head for one in store.mirror_target.environments().values()), -1)
        finally:
            store.close()

    process = start()
    assert process.stdout is not None
    line = process.stdout.readline()
    assert "following" in line, line
    eventually(lambda: heads() == 3 or (data / "blobs").is_dir())
    process.send_signal(signal.SIGKILL)
    process.wait(60)
    process.stdout.close()
    assert heads() in (-1, 3)
    centre("PATCH", f"environments/{farm}", 200, json={"datum": {"latitude": 53.2, "longitude": 0.5}})
    process = start()
    try:
        eventually(lambda: heads() == 4 or process.poll() is not None)
    finally:
        process.terminate()
        process.wait(60)
    assert process.stdout is not None
    with process.stdout:
        assert process.returncode == 0, process.stdout.read()
    store = Store(f"sqlite:///{data}/fleetmap.sqlite3", data / "blobs")
    try:
        assert store.verifier().run().findings == []
        described = store.mirrors.describe()
        assert described is not None
        assert (described["state"], described["environments"][0]["version"]) == ("connected", 4)
        assert store.versions.get(farm).root == centre.get(f"environments/{farm}/versions/latest").json()["root"]
    finally:
        store.close()
