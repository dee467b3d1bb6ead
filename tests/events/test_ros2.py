"""Topics for ROS 2: subscribed to as rmw_zenoh and zenoh-bridge-ros2dds do, decoded by hand, tokens and all."""

from __future__ import annotations

import json
import logging
import math
import os
import signal
import struct
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
import zenoh
from zenoh import ext

from app.api.ros2 import topic_content
from app.backends.lead import LocalLeads
from app.backends.notify import CommitCounter
from app.errors import Unavailable
from app.events import cdr, ros_names
from app.events.bus import BusOptions, router_configuration
from app.events.ros2 import Ros2Options, Ros2Publisher, TopicContent, ros2_state
from app.events.ros_names import EnvironmentSelector
from app.events.router import Router
from tests.api import samples
from tests.api.conftest import Api, running, settings_for
from tests.events.conftest import client_config, eventually
from tests.events.test_relay import router_of
from tests.ports import free_port

GRID = "nav_msgs::msg::dds_::OccupancyGrid_/RIHS01_8d348150c12913a31ee0ec170fbf25089e4745d17035792a1ba94d6f0bc0cfc7"
UPDATE = (
    "map_msgs::msg::dds_::OccupancyGridUpdate_/RIHS01_c4095b0be2e4363f8978a1570e0293ee093436f1e1c61d99b48502ac317025e8"
)
STRING = "std_msgs::msg::dds_::String_/RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"

WHEN = datetime(2026, 5, 1, 4, 0, 0, 250_000, UTC)


# --- an independent reader of CDR -----------------------------------------------------------------------------------
class Cdr:
    """Reads little endian CDR, version 1."""

    def __init__(self, data: bytes) -> None:
        assert data[:4] == b"\x00\x01\x00\x00"
        self.data, self.at = data[4:], 0

    def __call__(self, kind: str) -> Any:
        size = {"i": 4, "I": 4, "f": 4, "d": 8}[kind]
        self.at = (self.at + size - 1) // size * size
        (value,) = struct.unpack_from("<" + kind, self.data, self.at)
        self.at += size
        return value

    def bytes(self) -> bytes:
        count = self("I")
        self.at += count
        return self.data[self.at - count : self.at]

    def text(self) -> str:
        raw = self.bytes()
        assert raw[-1:] == b"\0"
        return raw[:-1].decode()

    def header(self) -> tuple[int, int, str]:
        return self("i"), self("I"), self.text()

    def end(self) -> None:
        assert self.at == len(self.data)


def grid_of(data: bytes) -> dict[str, Any]:
    read = Cdr(data)
    out: dict[str, Any] = {"header": read.header(), "load": (read("i"), read("I")), "resolution": read("f")}
    width, height = read("I"), read("I")
    out["pose"] = [read("d") for _ in range(7)]
    cells = np.frombuffer(read.bytes(), np.int8)
    read.end()
    assert len(cells) == width * height
    return {**out, "cells": cells.reshape(height, width)}


def update_of(data: bytes) -> dict[str, Any]:
    read = Cdr(data)
    out: dict[str, Any] = {"header": read.header(), "x": read("i"), "y": read("i")}
    width, height = read("I"), read("I")
    cells = np.frombuffer(read.bytes(), np.int8)
    read.end()
    return {**out, "cells": cells.reshape(height, width)}


def text_of(data: bytes) -> str:
    read = Cdr(data)
    out = read.text()
    read.end()
    return out


# --- the encoder ----------------------------------------------------------------------------------------------------
SMALL = cdr.Grid(3, 2, 0.5, (-1.0, 2.0, math.pi / 2), bytes([0, 100, 255, 50, 0, 0]))


def test_occupancy_grid_encodes_to_expected_bytes() -> None:
    """Worked out by hand from the message's definition."""
    sine, cosine = math.sin(math.pi / 4), math.cos(math.pi / 4)
    expected = (
        bytes.fromhex("00010000")  # CDR, little endian
        + struct.pack("<iI", 1777608000, 250_000_000) + bytes.fromhex("04000000") + b"map\0"  # 16 bytes
        + struct.pack("<iI", 1777608000, 250_000_000) + bytes.fromhex("0000003f 03000000 02000000")  # 36
        + bytes(4)  # a pose is doubles: at 40
        + struct.pack("<3d", -1.0, 2.0, 0.0) + struct.pack("<4d", 0.0, 0.0, sine, cosine)
        + bytes.fromhex("06000000 00 64 ff 32 00 00")
    )  # fmt: skip
    assert cdr.occupancy_grid(SMALL, WHEN, "map") == expected


def test_grid_update_and_string_encode_to_expected_bytes() -> None:
    message = cdr.occupancy_grid_update(1, 0, 2, 1, bytes([100, 255]), WHEN, "odom")
    assert message == (
        bytes.fromhex("00010000") + struct.pack("<iI", 1777608000, 250_000_000) + bytes.fromhex("05000000") + b"odom\0"
        + bytes(3) + bytes.fromhex("01000000 00000000 02000000 01000000 02000000 64ff")
    )  # fmt: skip
    assert cdr.string("grün") == bytes.fromhex("00010000 06000000") + "grün".encode() + b"\0"


def test_messages_and_type_hashes_match_rosbags() -> None:
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.LATEST)
    text = "std_msgs/Header header\nint32 x\nint32 y\nuint32 width\nuint32 height\nint8[] data\n"
    store.register(typesys.get_types_from_msg(text, "map_msgs/msg/OccupancyGridUpdate"))
    for message_type in (ros_names.GRID, ros_names.GRID_UPDATE, ros_names.STRING):
        assert store.hash_rihs01(message_type.name) == message_type.hash
    for frame in ("map", "a", "odometry"):
        grid = store.deserialize_cdr(cdr.occupancy_grid(SMALL, WHEN, frame), ros_names.GRID.name)
        assert (grid.header.frame_id, grid.info.width, grid.info.height) == (frame, 3, 2)
        assert grid.info.map_load_time.nanosec == 250_000_000
        assert grid.info.origin.orientation.w == math.cos(math.pi / 4)
        assert list(grid.data) == [0, 100, -1, 50, 0, 0]
        assert bytes(store.serialize_cdr(grid, ros_names.GRID.name)) == cdr.occupancy_grid(SMALL, WHEN, frame)
        message = cdr.occupancy_grid_update(1, 0, 2, 1, bytes([100, 255]), WHEN, frame)
        change = store.deserialize_cdr(message, ros_names.GRID_UPDATE.name)
        assert (change.x, change.y, list(change.data)) == (1, 0, [100, -1])
    assert store.deserialize_cdr(cdr.string("grün"), ros_names.STRING.name).data == "grün"


# --- names ----------------------------------------------------------------------------------------------------------
def test_keys_and_tokens() -> None:
    topic = ros_names.map_topic("/site/farm", "Level 1")
    assert topic.key("rmw_zenoh", 7) == f"7/site/farm/Level_1/map/{GRID}"
    assert topic.key("rmw_zenoh_humble", 0) == (
        "0/site/farm/Level_1/map/nav_msgs::msg::dds_::OccupancyGrid_/TypeHashNotSupported"
    )
    assert topic.key("ros2dds", 7) == "site/farm/Level_1/map"
    assert topic.token("rmw_zenoh", 7, "abc", 3) == (
        f"@ros2_lv/7/abc/0/3/MP/%/%/fleet_map_server/%site%farm%Level_1%map/{GRID}/:1:,1:,:,:,,"
    )
    assert ros_names.update_topic("/", None).token("rmw_zenoh", 0, "abc", 1) == (
        f"@ros2_lv/0/abc/0/1/MP/%/%/fleet_map_server/%map_updates/{UPDATE}/::,10:,:,:,,"
    )
    assert topic.token("ros2dds", 7, "abc", 3) == (
        "@/abc/@ros2_lv/MP/site§farm§Level_1§map/nav_msgs§msg§OccupancyGrid/:1:1:0,1:typehash="
        "RIHS01_8d348150c12913a31ee0ec170fbf25089e4745d17035792a1ba94d6f0bc0cfc7;"
    )
    for style in ros_names.KEYS:
        for name in (topic.key(style, 0), topic.token(style, 0, "abc", 1), ros_names.node_token(0, "abc")):
            zenoh.KeyExpr(name)


@pytest.mark.parametrize(
    ("name", "token"),
    [("farm", "farm"), ("north-field", "north_field"), ("3rd--floor-", "level_3rd_floor"), ("_x", "level_x"),
     ("Erdgeschoß", "Erdgescho"), ("---", "level")],
)  # fmt: skip
def test_topic_names_are_valid_for_ros(name: str, token: str) -> None:
    assert ros_names.token(name, "level") == token


def test_environment_selectors_are_parsed() -> None:
    chosen = ros_names.parse_selectors(" farm=/, hall=/site/hall ,north-*,")
    assert [ros_names.namespace_of(n, chosen) for n in ("farm", "hall", "north-1", "south")] == [
        "/", "/site/hall", "/north_1", None,
    ]  # fmt: skip
    for wrong in ("Farm", "farm=site", "farm=/a b", "f-*=/", "a=/x,b=/x", "farm=", "=/", "a=/x__y", "a=/1"):
        with pytest.raises(ValueError, match=r".+"):
            ros_names.parse_selectors(wrong)
    assert ros_names.parse_keys("ros2dds, rmw_zenoh") == ("rmw_zenoh", "ros2dds")
    for wrong in ("", "dds", "rmw_zenoh,x"):
        with pytest.raises(ValueError, match="unknown keys"):
            ros_names.parse_keys(wrong)


def test_settings_are_checked(tmp_path: Path) -> None:
    for more in ({"ros2_environments": "Farm"}, {"ros2_keys": "dds"}, {"ros2_channel": "A"}, {"ros2_domain_id": 233}):
        with pytest.raises(ValueError, match=r"ros2_"):
            settings_for(tmp_path, zenoh_mode="router", **more)
    with pytest.raises(ValueError, match="zenoh_mode"):
        settings_for(tmp_path, zenoh_mode="off", ros2_environments="farm")


# --- robots ---------------------------------------------------------------------------------------------------------
class Heard:
    """A subscription. latched: as rmw_zenoh (with recovery) or the bridge (without) subscribe to transient local."""

    def __init__(self, session: zenoh.Session, key: str, *, latched: bool = True, recovery: bool = True) -> None:
        self.samples: list[zenoh.Sample] = []
        self._news = threading.Condition()
        self._held: Any
        if latched:
            self._held = ext.declare_advanced_subscriber(
                session,
                key,
                self._take,
                history=ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
                recovery=ext.RecoveryConfig(periodic_queries=None, heartbeat=True) if recovery else None,
                subscriber_detection=True,
            )
        else:
            self._held = session.declare_subscriber(key, self._take)

    def _take(self, sample: zenoh.Sample) -> None:
        with self._news:
            self.samples.append(sample)
            self._news.notify_all()

    def wait(self, count: int = 1, seconds: float = 20.0) -> bytes:
        """The payload of the count-th sample."""
        with self._news:
            assert self._news.wait_for(lambda: len(self.samples) >= count, seconds), f"{len(self.samples)} came"
            return bytes(self.samples[count - 1].payload)


def tokens(session: zenoh.Session, key: str) -> set[str]:
    return {str(reply.ok.key_expr) for reply in session.liveliness().get(key, timeout=60.0) if reply.ok}


def picture(*occupied: tuple[int, int], width: int = 8, height: int = 6) -> dict[str, bytes]:
    """A map whose cells (column, row from the bottom) are occupied; one cell is unknown."""
    rows = [[254] * width for _ in range(height)]
    rows[height - 1][width - 1] = 205
    for column, row in occupied:
        rows[height - 1 - row][column] = 0
    files = samples.grid(width=width, height=height)
    head = files["map.pgm"][: -width * height]
    return {**files, "map.pgm": head + bytes(v for row in rows for v in row)}


@pytest.fixture(scope="module")
def port() -> int:
    return free_port()


@pytest.fixture(scope="module")
def api(tmp_path_factory: pytest.TempPathFactory, port: int) -> Iterator[Api]:
    settings = settings_for(
        tmp_path_factory.mktemp("ros2"),
        zenoh_mode="router",
        zenoh_listen=f"tcp/127.0.0.1:{port}",
        ros2_environments="farm=/, *-hall, tower, quiet",
        ros2_domain_id=5,
        ros2_keys="rmw_zenoh,rmw_zenoh_humble,ros2dds",
        zenoh_max_reply_bytes=40_000,
    )
    with running(settings) as api:
        eventually(lambda: api.get("/readyz").json()["ros2"]["state"] == "connected")
        yield api


def test_ros2_publishes_map_updates_and_network(api: Api, session: zenoh.Session) -> None:
    api.post("environments", {"name": "farm"})
    early = Heard(session, f"5/map/{GRID}")
    version = api.upload("farm", picture((2, 3))).json()
    grid = grid_of(early.wait())
    moment = datetime.fromisoformat(version["time"])
    assert grid["header"] == (int(moment.timestamp()), moment.microsecond * 1000, "map")
    assert grid["load"] == grid["header"][:2]
    assert grid["resolution"] == 0.5
    assert grid["pose"] == [-1.0, -2.0, 0.0, 0.0, 0.0, 0.0, 1.0]
    expected = np.zeros((6, 8), np.int8)
    expected[3, 2], expected[0, 7] = 100, -1
    assert (grid["cells"] == expected).all()

    changes = Heard(session, f"5/map_updates/{UPDATE}", latched=False)
    bridged = Heard(session, "map_updates", latched=False)
    Heard(session, f"5/map/{GRID}").wait()  # a volatile subscription counts from when the publisher knows of it
    api.upload("farm", picture((2, 3), (4, 1), (6, 4)))
    for received in (changes, bridged):
        change = update_of(received.wait())
        assert (change["x"], change["y"], change["header"][2]) == (4, 1, "map")
        assert change["cells"].tolist() == [[100, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 100]]
    expected[1, 4] = expected[4, 6] = 100
    assert (grid_of(early.wait(2))["cells"] == expected).all()

    late = [
        Heard(session, f"5/map/{GRID}"),
        Heard(session, "5/map/nav_msgs::msg::dds_::OccupancyGrid_/TypeHashNotSupported"),
        Heard(session, "map", recovery=False),
    ]
    for received in late:
        assert received.wait() == early.wait(2)
    attached = [received.samples[0].attachment for received in late]
    assert attached[2] is None, "the bridge knows no attachments"
    for sample, count in ((early.samples[0], 1), (late[0].samples[0], 2)):
        raw = bytes(sample.attachment)  # type: ignore[arg-type]
        number, stamp, length = struct.unpack_from("<qqB", raw)
        assert (number, length, len(raw)) == (count, 16, 33)
        assert abs(stamp / 1e9 - time.time()) < 300
    assert bytes(early.samples[0].attachment)[17:] == bytes(early.samples[1].attachment)[17:]  # type: ignore[arg-type]
    assert bytes(attached[0])[17:] != bytes(attached[1])[17:]  # type: ignore[arg-type]

    seen = len(early.samples)
    network = Heard(session, f"5/topological_map_2/{STRING}")
    api.upload("farm", {"network.tmap2.yaml": samples.tmap2()})
    document = json.loads(text_of(network.wait()))
    assert sorted(n["node"]["name"] for n in document["nodes"]) == ["barn", "field", "gate"]
    assert document == yaml.safe_load(api.get("/maps/farm/tmap2").content)
    assert text_of(Heard(session, "topological_map_2", recovery=False).wait()) == text_of(network.wait())
    assert len(early.samples) == seen, "a grid that did not change is not told again"


def test_ros_sees_a_node_and_its_publishers(api: Api, session: zenoh.Session) -> None:
    api.post("environments", {"name": "east-hall"})
    api.upload("east-hall", picture())
    for key, count in (("@ros2_lv/5/**", 4), ("@/*/@ros2_lv/**", 2)):
        eventually(lambda key=key, n=count: sum("east_hall" in token for token in tokens(session, key)) == n)
    token_fields = [token.split("/") for token in tokens(session, "@ros2_lv/5/**")]
    nodes = [t for t in token_fields if t[5] == "NN"]
    assert [t[3:] for t in nodes] == [["0", "0", "NN", "%", "%", "fleet_map_server"]]
    publishers = [t for t in token_fields if t[5] == "MP" and t[9].startswith("%east_hall%")]
    assert {(t[9], t[10].split("::")[-1], t[11][:12], t[12]) for t in publishers} == {
        ("%east_hall%map", "OccupancyGrid_", "RIHS01_8d348", ":1:,1:,:,:,,"),
        ("%east_hall%map", "OccupancyGrid_", "TypeHashNotS", ":1:,1:,:,:,,"),
        ("%east_hall%map_updates", "OccupancyGridUpdate_", "RIHS01_c4095", "::,10:,:,:,,"),
        ("%east_hall%map_updates", "OccupancyGridUpdate_", "TypeHashNotS", "::,10:,:,:,,"),
    }
    assert {t[2] for t in token_fields} == {nodes[0][2]}, "one session"
    entities = [t[4] for t in token_fields]
    assert len(entities) == len(set(entities))
    bridge = {t.split("/", 3)[3] for t in tokens(session, "@/*/@ros2_lv/**") if "east_hall" in t}
    assert bridge == {
        "MP/east_hall§map/nav_msgs§msg§OccupancyGrid/:1:1:0,1:typehash=" + GRID.split("/")[1] + ";",
        "MP/east_hall§map_updates/map_msgs§msg§OccupancyGridUpdate/:1:0:0,10:typehash=" + UPDATE.split("/")[1] + ";",
    }
    api("DELETE", "environments/east-hall", 204)
    eventually(lambda: not any("east_hall" in t for t in tokens(session, "@ros2_lv/5/**")))
    eventually(lambda: not any("east_hall" in t for t in tokens(session, "@/*/@ros2_lv/**")))


def test_each_level_has_its_topic_and_the_lowest_needs_no_name(api: Api, session: zenoh.Session) -> None:
    api.post("environments", {"name": "tower"})
    api.upload("tower", picture((1, 1)), level="L2")
    assert grid_of(Heard(session, f"5/tower/map/{GRID}").wait())["cells"][1, 1] == 100
    api.upload("tower", picture((2, 2)))
    assert grid_of(Heard(session, f"5/tower/L2/map/{GRID}").wait())["cells"][1, 1] == 100
    ground = Heard(session, f"5/tower/map/{GRID}")
    eventually(lambda: ground.samples and grid_of(bytes(ground.samples[-1].payload))["cells"][2, 2] == 100)


def test_each_level_publishes_its_map_or_its_only_grid_that_is_no_mask(api: Api) -> None:
    api.post("environments", {"name": "mill"})
    floors = {"ground": "map attic", "L2": "upstairs keepout", "L3": "left right", "L4": "nogo"}
    for level, names in floors.items():
        for name in names.split():
            api.upload("mill", samples.grid(name), level=level, grid=name)
    services = api.app.state.services
    content = topic_content(services, False, services.store.versions.get("mill"))
    assert set(content.grids) == {None, "L2"}
    assert content.absent == ("no grid of the level L3: name one map; its grids: left, right",)


def test_ros2_publishes_version_of_channel(api: Api, session: zenoh.Session) -> None:
    api.post("environments", {"name": "west-hall"})
    received = Heard(session, f"5/west_hall/map/{GRID}")
    api.upload("west-hall", picture((1, 1)))
    assert grid_of(received.wait(1))["cells"][1, 1] == 100
    api("PUT", "environments/west-hall/channels/production", 200, json={"version": 1})
    api.upload("west-hall", picture((2, 2)))
    api.upload("west-hall", picture((3, 3)))
    api("PUT", "environments/west-hall/channels/production", 200, json={"version": 3})
    assert grid_of(received.wait(2))["cells"][3, 3] == 100, "version 2 was on no channel"
    api("PUT", "environments/west-hall/channels/production", 200, json={"version": 1})
    assert grid_of(received.wait(3))["cells"][1, 1] == 100


def test_another_frame_is_a_new_map_and_no_update(api: Api, session: zenoh.Session) -> None:
    api.post("environments", {"name": "north-hall"})
    received = Heard(session, f"5/north_hall/map/{GRID}")
    changes = Heard(session, f"5/north_hall/map_updates/{UPDATE}", latched=False)
    api.upload("north-hall", picture((1, 1)))
    received.wait(1)
    api.upload("north-hall", picture((1, 1), width=9))
    assert grid_of(received.wait(2))["cells"].shape == (6, 9)
    turned = samples.grid()
    turned["map.yaml"] = turned["map.yaml"].replace(b"-2.0, 0.0]", b"-2.0, 0.5]")
    api.upload("north-hall", turned)
    pose = grid_of(received.wait(3))["pose"]
    assert pose[3:] == [0.0, 0.0, math.sin(0.25), math.cos(0.25)]
    assert not changes.samples


def test_ros2_publishes_only_selected_and_stored_content(
    api: Api, session: zenoh.Session, caplog: pytest.LogCaptureFixture
) -> None:
    api.post("environments", {"name": "secret"})
    api.upload("secret", picture())
    api.post("environments", {"name": "quiet"})
    api.upload("quiet", picture(width=250, height=170))  # more bytes than go over Zenoh
    eventually(lambda: "skipped /quiet/map: 42500 bytes" in caplog.text)
    api.upload("quiet", {"network.tmap2.yaml": samples.tmap2()})
    Heard(session, f"5/quiet/topological_map_2/{STRING}").wait()
    topics = {t.split("/")[9] for t in tokens(session, "@ros2_lv/5/*/*/*/MP/**")}
    assert "%quiet%topological_map_2" in topics
    assert not {"%quiet%map", "%secret%map", "%secret%topological_map_2"} & topics
    assert "topological_map_2" not in {t.rpartition("%")[2] for t in topics if t.startswith("%tower")}, "no derived one"


def test_ros2_topics_survive_killed_router(api: Api, session: zenoh.Session, port: int) -> None:
    api.post("environments", {"name": "rough-hall"})
    api.upload("rough-hall", picture((1, 1)))
    early = Heard(session, f"5/rough_hall/map/{GRID}")
    early.wait()
    os.kill(router_of(api), signal.SIGKILL)
    api.upload("rough-hall", picture((2, 2)))

    def last() -> Any:
        return early.samples and grid_of(bytes(early.samples[-1].payload))["cells"][2, 2] == 100

    eventually(last)
    with zenoh.open(client_config(port)) as other:
        late = Heard(other, f"5/rough_hall/map/{GRID}")
        assert grid_of(late.wait(1, 30))["cells"][2, 2] == 100


def test_ros2_publishes_derived_content_when_enabled(tmp_path: Path) -> None:
    """Of a network alone: a grid that is free along it."""
    port = free_port()
    with running(
        settings_for(
            tmp_path,
            zenoh_mode="router",
            zenoh_listen=f"tcp/127.0.0.1:{port}",
            ros2_environments="farm",
            ros2_derive=True,
            ros2_keys="ros2dds",
        )
    ) as api:
        eventually(lambda: api.get("/readyz").json()["events"]["state"] == "connected")
        api.post("environments", {"name": "farm"})
        api.upload("farm", {"network.tmap2.yaml": samples.tmap2()})
        with zenoh.open(client_config(port)) as session:
            grid = grid_of(Heard(session, "farm/map", recovery=False).wait(1, 60))
            assert set(np.unique(grid["cells"])) == {-1, 0}
            assert not tokens(session, "@ros2_lv/**"), "nobody asked for rmw_zenoh's keys"


# --- what goes wrong ------------------------------------------------------------------------------------------------
@pytest.fixture
def router(tmp_path: Path) -> Iterator[tuple[str, int]]:
    port = free_port()
    endpoint = f"tcp/127.0.0.1:{port}"
    new_router = Router(router_configuration(BusOptions(listen=endpoint)))
    assert new_router.problem is None
    try:
        yield endpoint, port
    finally:
        new_router.close()


def version(name: str, root: str) -> Any:
    return SimpleNamespace(environment=name, number=1, root=root, time=WHEN, closures=None)


def test_ros2_keeps_last_map_and_retries_when_content_is_unavailable(
    router: tuple[str, int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("app.events.ros2.RETRY_SECONDS", 0.2)
    monkeypatch.setattr("app.events.ros2.VERSION_POLL_SECONDS", 0.1)
    endpoint, port = router
    state = {"root": "a", "fails": 0, "calls": 0}
    (tmp_path / "ros2.json").write_text('{"state": "connected", "topics": 99}')  # of a process that was killed

    def fetch(request: Any) -> TopicContent:
        state["calls"] += 1
        if state["fails"]:
            state["fails"] -= 1
            raise Unavailable("the pool is busy")
        return TopicContent({None: replace(SMALL, cells=SMALL.cells[:5] + request.root.encode())}, None)

    publishing = Ros2Publisher(
        Ros2Options((EnvironmentSelector("farm", "/"),), ("ros2dds",)),
        BusOptions(mode="client", connect=endpoint),
        tmp_path,
        LocalLeads(tmp_path),
        generation=CommitCounter(tmp_path),
        look=lambda: {"farm": version("farm", str(state["root"]))},
        fetch=fetch,
    )
    publishing.start()
    try:
        with zenoh.open(client_config(port)) as session:
            received = Heard(session, "map")
            assert grid_of(received.wait(1))["cells"][1, 2] == ord("a")
            eventually(lambda: ros2_state(tmp_path) == {"state": "connected", "topics": 2})
            state["fails"], state["root"] = 2, "b"
            assert grid_of(received.wait(2))["cells"][1, 2] == ord("b")
            assert caplog.text.count("the pool is busy") == 2
            assert state["calls"] == 4, "what stands is not fetched again"
            assert grid_of(Heard(session, "map").wait())["cells"][1, 2] == ord("b")
    finally:
        publishing.close()


def test_ros2_error_of_one_environment_does_not_affect_others(
    router: tuple[str, int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("app.events.ros2.RETRY_SECONDS", 0.1)
    monkeypatch.setattr("app.events.ros2.VERSION_POLL_SECONDS", 0.1)
    endpoint, port = router

    def fetch(request: Any) -> TopicContent:
        if request.environment == "bad":
            raise KeyError("nobody thought of this")
        return TopicContent({None: SMALL}, None)

    publishing = Ros2Publisher(
        Ros2Options((EnvironmentSelector("*", None),), ("ros2dds",)),
        BusOptions(mode="client", connect=endpoint),
        tmp_path,
        LocalLeads(tmp_path),
        generation=CommitCounter(tmp_path),
        look=lambda: {name: version(name, "r") for name in ("bad", "good")},
        fetch=fetch,
    )
    publishing.start()
    try:
        with zenoh.open(client_config(port)) as session:
            received = Heard(session, "good/map")
            received.wait()
            eventually(lambda: caplog.text.count("ROS 2: could not update bad") > 3)
            assert ros2_state(tmp_path) == {"state": "connected", "topics": 2}
            assert len(received.samples) == 1, "the topics of the others stay as they are"
            assert "unexpected error" not in caplog.text
    finally:
        publishing.close()


def test_ros2_reports_missing_router_and_connects_later(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.events.bus.CONNECT_SECONDS", 0.3)
    port = free_port()
    endpoint = f"tcp/127.0.0.1:{port}"
    publishing = Ros2Publisher(
        Ros2Options((EnvironmentSelector("farm", "/"),), ("ros2dds",)),
        BusOptions(mode="client", connect=endpoint),
        tmp_path,
        LocalLeads(tmp_path),
        generation=CommitCounter(tmp_path),
        look=lambda: {"farm": version("farm", "r")},
        fetch=lambda _: TopicContent({None: SMALL}, None),
    )
    publishing.start()
    try:
        eventually(lambda: ros2_state(tmp_path)["state"] == "down")
        assert "no router" in ros2_state(tmp_path)["detail"]
        new_router = Router(router_configuration(BusOptions(listen=endpoint)))
        try:
            with zenoh.open(client_config(port)) as session:
                assert grid_of(Heard(session, "map").wait())["resolution"] == 0.5
        finally:
            new_router.close()
    finally:
        publishing.close()


def test_one_topic_belongs_to_one_level_of_one_environment(
    router: tuple[str, int], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    endpoint, port = router
    caplog.set_level(logging.ERROR)
    content = {
        "a-b": TopicContent({None: SMALL, "L 1": SMALL, "L-1": replace(SMALL, resolution=1.0)}, None),
        "a_b": TopicContent({None: replace(SMALL, resolution=2.0)}, None),
    }
    publishing = Ros2Publisher(
        Ros2Options((EnvironmentSelector("a?b", None),), ("ros2dds",)),
        BusOptions(mode="client", connect=endpoint),
        tmp_path,
        LocalLeads(tmp_path),
        generation=CommitCounter(tmp_path),
        look=lambda: {name: version(name, "r") for name in content},
        fetch=lambda request: content[request.environment],
    )
    other = Ros2Publisher(
        Ros2Options((EnvironmentSelector("a?b", None),), ("ros2dds",)),
        BusOptions(mode="client", connect=endpoint),
        tmp_path,
        LocalLeads(tmp_path),
        generation=CommitCounter(tmp_path),
        look=lambda: {"a-b": version("a-b", "r")},
        fetch=lambda _: TopicContent({None: replace(SMALL, resolution=3.0)}, None),
    )
    publishing.start()
    try:
        with zenoh.open(client_config(port)) as session:
            assert grid_of(Heard(session, "a_b/map").wait())["resolution"] == 0.5
            assert grid_of(Heard(session, "a_b/L_1/map").wait())["resolution"] == 0.5
            eventually(lambda: "skipped /a_b/map of a_b: a-b has the same topic" in caplog.text)
            assert "skipped a level of a-b: another level has the same topic /a_b/L_1/map" in caplog.text
            other.start()  # a second process of the same data folder waits for the first one's end
            time.sleep(0.3)
            assert len(tokens(session, "@/*/@ros2_lv/MP/a_b§map/**")) == 1
            publishing.close()
            received = Heard(session, "a_b/map")
            assert grid_of(received.wait())["resolution"] == 3.0
    finally:
        publishing.close()
        other.close()
