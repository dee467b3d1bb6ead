"""Maps as topics of ROS 2, without a ROS node: latched grids, their changes, and networks, in CDR over Zenoh.

A thread with a session of its own, since messages are large and must not be dropped: Zenoh drops what waits for more
than 50 ms, and blocks the session instead where it is told to; events would wait with it. What a channel stands on is
looked at after each commit, so what goes out is always a whole state, and the last one, never a queue of them.

Latched: rmw_zenoh and zenoh-bridge-ros2dds (since 1.5.1) subscribe with history to publishers that keep their last
samples and can be detected; a plain publisher tells late joiners nothing.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import zenoh
from zenoh import ext

from app.errors import FleetMapError
from app.events import cdr, leader, ros_names
from app.events.bus import BusOptions, connection_error, session_configuration
from app.events.leader import POLL_SECONDS, LeaderThread
from app.events.ros_names import EnvironmentSelector, Keys, Topic
from app.store.values import Version

log = logging.getLogger(__name__)

FRAME = "map"
"""The frame of all maps, as Nav2 and topological_navigation call it."""

HEARTBEAT_SECONDS = 0.5
COMMIT_POLL_SECONDS = 0.02
VERSION_POLL_SECONDS = 5.0
"""How often the database is asked all the same: another host may have committed."""

RETRY_SECONDS = 30.0
"""After a map could not be made it is tried again so much later, or when the channel moves."""

NAME = "ros2"


@dataclass(frozen=True, slots=True)
class Ros2Options:
    """What goes out, and on whose keys."""

    environments: tuple[EnvironmentSelector, ...]
    keys: tuple[Keys, ...] = ("rmw_zenoh", "ros2dds")
    domain: int = 0


@dataclass(frozen=True, slots=True)
class TopicContent:
    """What an environment has to say. grids: by level, None for the lowest. network: the tmap2 as JSON. absent: why
    something is not there, for the log."""

    grids: Mapping[str | None, cdr.Grid]
    network: str | None
    absent: tuple[str, ...] = ()


LookUpVersions = Callable[[], Mapping[str, Version]]
"""The chosen environments, each with the version that its channel stands on."""

Fetch = Callable[[Version], TopicContent]
"""What is in a version. Raises FleetMapError where it cannot be had now."""


class TopicPublisher:
    """A topic on one kind of keys. It is detected and keeps its last message as long as it is held."""

    def __init__(self, session: zenoh.Session, topic: Topic, style: Keys, domain: int, entity: int) -> None:
        key = topic.key(style, domain)
        reliable, block = zenoh.Reliability.RELIABLE, zenoh.CongestionControl.BLOCK
        self._publisher: Any
        if topic.latched:
            self._publisher = ext.declare_advanced_publisher(
                session,
                key,
                cache=ext.CacheConfig(topic.depth),
                publisher_detection=True,
                sample_miss_detection=ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=HEARTBEAT_SECONDS),
                reliability=reliable,
                congestion_control=block,
            )
        else:
            self._publisher = session.declare_publisher(key, reliability=reliable, congestion_control=block)
        token = topic.token(style, domain, str(session.info.zid()), entity)
        self._token: Any = session.liveliness().declare_token(token)
        # rmw_zenoh hashes the token by XXH3; for who receives it is just an id that stays the same.
        self._gid = hashlib.sha256(token.encode()).digest()[:16]
        self._attached = style != "ros2dds"
        self._count = 0

    def put(self, payload: zenoh.ZBytes) -> None:
        """Publish; rmw_zenoh drops what comes without its attachment."""
        if not self._attached:
            self._publisher.put(payload)
            return
        self._count += 1
        attachment = (ext.Int64(self._count), ext.Int64(time.time_ns()), self._gid)
        self._publisher.put(payload, attachment=ext.z_serialize(attachment))

    def close(self) -> None:
        """Say that it is gone."""
        for declaration in (self._token, self._publisher):
            with contextlib.suppress(Exception):
                declaration.undeclare()


@dataclass(slots=True)
class _Topic:
    """A topic on all its keys, and what was said last."""

    publishers: Sequence[TopicPublisher]
    last: cdr.Grid | str | None = None

    def put(self, payload: bytes) -> None:
        shared = zenoh.ZBytes(payload)
        for publisher in self.publishers:
            publisher.put(shared)

    def close(self) -> None:
        for publisher in self.publishers:
            publisher.close()


@dataclass(slots=True)
class _PublishedEnvironment:
    """An environment: root and closures' digest that were published, and its topics by name. retry: when it is
    published again after a failure.
    """

    versions: tuple[str, str] = ("", "")
    topics: dict[str, _Topic] = field(default_factory=dict)
    retry: float | None = None


class Ros2Publisher(LeaderThread):
    """The thread. One process of a data folder publishes (it holds a file lock); where it dies, another takes over."""

    def __init__(
        self,
        options: Ros2Options,
        bus: BusOptions,
        data_dir: Path,
        *,
        generation: Callable[[], int],
        look: LookUpVersions,
        fetch: Fetch,
    ) -> None:
        super().__init__(data_dir, NAME, well="maps go out to ROS 2", trouble="NOTHING GOES OUT TO ROS 2")
        self._options, self._bus = options, bus
        self._generation, self._look_up_versions, self._fetch = generation, look, fetch
        self._session: zenoh.Session | None = None
        self._node: Any = None
        self._entities = 0
        self._environments: dict[str, _PublishedEnvironment] = {}
        self._owners: dict[str, str] = {}

    def _run_once(self) -> None:
        """Publish what has changed, then wait for more."""
        if self._session is None and not self._open():
            self._stopping.wait(POLL_SECONDS)
            return
        generation = self._generation()
        self._publish_changes(self._look_up_versions())
        self._publish_state({"state": "connected", "topics": len(self._owners)})
        last_read = time.monotonic()
        while not self._stopping.wait(COMMIT_POLL_SECONDS):
            if self._generation() != generation or time.monotonic() - last_read > VERSION_POLL_SECONDS:
                return

    def _open(self) -> bool:
        try:
            self._session = zenoh.open(zenoh.Config.from_json5(session_configuration(self._bus)))
            if any(style != "ros2dds" for style in self._options.keys):
                zid = str(self._session.info.zid())
                self._node = self._session.liveliness().declare_token(ros_names.node_token(self._options.domain, zid))
        except FleetMapError:
            raise
        except Exception as error:  # noqa: BLE001  zenoh raises one class for everything
            self._release()
            self._publish_state({"state": "down", "detail": connection_error(self._bus, error)})
            return False
        return True

    def _on_unexpected_error(self) -> None:
        super()._on_unexpected_error()
        self._release()  # what was said last is not known for sure

    def _release(self) -> None:
        for name in list(self._environments):
            self._retire(name, ())
        self._environments.clear()
        if self._session is not None:
            with contextlib.suppress(Exception):
                _close(self._session)
        self._session = self._node = None
        self._entities = 0

    # --- what has changed ---

    def _publish_changes(self, standing: Mapping[str, Version]) -> None:
        for name in [n for n in self._environments if n not in standing]:
            self._retire(name, ())
            del self._environments[name]
        for name, version in standing.items():
            if self._stopping.is_set():
                return
            place = self._environments.setdefault(name, _PublishedEnvironment())
            waits = place.retry is not None and time.monotonic() < place.retry
            shown = (version.root, version.closures.digest if version.closures else "")
            if place.versions == shown and (place.retry is None or waits):
                continue
            place.versions, place.retry = shown, None
            try:
                content = self._fetch(version)
            except Exception as error:  # one environment's trouble is not the others'
                if isinstance(error, FleetMapError):
                    log.warning("ROS 2: %s stays as it is: %s", name, error.detail)
                else:
                    log.exception("ROS 2: %s stays as it is", name)
                place.retry = time.monotonic() + RETRY_SECONDS
                continue
            for reason in content.absent:
                log.warning("ROS 2: %s, version %d: %s", name, version.number, reason)
            self._publish(name, place, version, content)

    def _publish(self, name: str, place: _PublishedEnvironment, version: Version, content: TopicContent) -> None:
        namespace = ros_names.namespace_of(name, self._options.environments)
        assert namespace is not None
        topic_names: set[str] = set()
        for level, grid in content.grids.items():
            topic, updates = ros_names.map_topic(namespace, level), ros_names.update_topic(namespace, level)
            if topic.name in topic_names:
                log.error("ROS 2: a level of %s is left out: another one has its topic %s", name, topic.name)
                continue
            size = grid.width * grid.height
            if size > self._bus.max_reply_bytes:
                log.error("ROS 2: %s is left out: %d bytes are more than is sent over Zenoh", topic.name, size)
                continue
            out, changes = self._out(name, place, topic), self._out(name, place, updates)
            if out is None or changes is None:
                continue
            topic_names |= {topic.name, updates.name}
            before = out.last
            if before == grid:
                continue
            if isinstance(before, cdr.Grid) and before.frame == grid.frame:
                changes.put(update(before, grid, version))
            out.put(cdr.occupancy_grid(grid, version.time, FRAME))
            out.last = grid
            log.info("ROS 2: %s is version %d of %s", topic.name, version.number, name)
        if content.network is not None:
            topic = ros_names.network_topic(namespace)
            out = self._out(name, place, topic)
            if out is not None:
                topic_names.add(topic.name)
                if out.last != content.network:
                    out.put(cdr.string(content.network))
                    out.last = content.network
                    log.info("ROS 2: %s is version %d of %s", topic.name, version.number, name)
        self._retire(name, topic_names)

    def _out(self, name: str, place: _PublishedEnvironment, topic: Topic) -> _Topic | None:
        """The topic, declared; None where another environment has it."""
        existing_topic = place.topics.get(topic.name)
        if existing_topic is not None:
            return existing_topic
        owner = self._owners.get(topic.name)
        if owner is not None:
            log.error("ROS 2: %s of %s is left out: %s has that topic; give namespaces", topic.name, name, owner)
            return None
        assert self._session is not None
        publishers = []
        for style in self._options.keys:
            self._entities += 1
            publishers.append(TopicPublisher(self._session, topic, style, self._options.domain, self._entities))
        new_topic = _Topic(publishers)
        place.topics[topic.name] = new_topic
        self._owners[topic.name] = name
        return new_topic

    def _retire(self, name: str, topic_names: Sequence[str] | set[str]) -> None:
        place = self._environments[name]
        for topic in [t for t in place.topics if t not in topic_names]:
            place.topics.pop(topic).close()
            del self._owners[topic]


def update(before: cdr.Grid, after: cdr.Grid, version: Version) -> bytes:
    """The smallest rectangle that holds all cells in which two different grids of one frame differ, as a message."""
    shape = (after.height, after.width)
    new = np.frombuffer(after.cells, np.int8).reshape(shape)
    changed = new != np.frombuffer(before.cells, np.int8).reshape(shape)
    rows, columns = np.flatnonzero(changed.any(axis=1)), np.flatnonzero(changed.any(axis=0))
    y0, y1, x0, x1 = int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1
    block = new[y0:y1, x0:x1].tobytes()
    return cdr.occupancy_grid_update(x0, y0, x1 - x0, y1 - y0, block, version.time, FRAME)


def ros2_state(data_dir: Path) -> dict[str, Any]:
    """What /readyz says of topics: ``starting``, ``connected`` with their number, or ``down`` with the reason."""
    return leader.read_state(data_dir, NAME)


def _close(session: Any) -> None:
    session.close()
