"""Publish maps as ROS 2 topics without a ROS node: latched grids, grid updates and networks, in CDR over Zenoh.

Runs in a thread with its own session, since messages are large and must not be dropped: Zenoh drops messages that wait
for more than 50 ms, or blocks the session, and then events would wait as well. The channels' versions are read after
each commit, so only the newest complete state is published, never a queue of states.

Latched: rmw_zenoh and zenoh-bridge-ros2dds (since 1.5.1) subscribe with history to publishers that cache their last
samples and can be detected; late joiners get nothing from a plain publisher.
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

from app.backends.lead import Leads
from app.backends.notify import CommitCounter
from app.errors import FleetMapError
from app.events import cdr, leader, ros_names
from app.events.bus import BusOptions, connection_error, session_configuration
from app.events.leader import POLL_SECONDS, LeaderThread
from app.events.ros_names import EnvironmentSelector, Keys, Topic
from app.store.values import Version

log = logging.getLogger(__name__)

FRAME = "map"
"""Frame id of all maps, the default of Nav2 and topological_navigation."""

HEARTBEAT_SECONDS = 0.5
VERSION_POLL_SECONDS = 5.0
"""Maximum interval between two reads of the database: another host may have committed."""

RETRY_SECONDS = 30.0
"""Pause before another attempt after a failed conversion, unless the channel moves earlier."""

NAME = "ros2"


@dataclass(frozen=True, slots=True)
class Ros2Options:
    """Environments to publish, and styles of keys."""

    environments: tuple[EnvironmentSelector, ...]
    keys: tuple[Keys, ...] = ("rmw_zenoh", "ros2dds")
    domain: int = 0


@dataclass(frozen=True, slots=True)
class TopicContent:
    """Content of an environment's topics.

    Attributes:
        grids: by level, None for the lowest.
        network: tmap2 as JSON.
        absent: reasons for missing content, for the log.
    """

    grids: Mapping[str | None, cdr.Grid]
    network: str | None
    absent: tuple[str, ...] = ()


LookUpVersions = Callable[[], Mapping[str, Version]]
"""Function that returns the selected environments with the version that their channel points to."""

Fetch = Callable[[Version], TopicContent]
"""Function that returns the content of a version. Raises FleetMapError if it is not available."""


class TopicPublisher:
    """Publisher of a topic in one style of keys. Can be discovered and caches its last message until it is closed."""

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
        # rmw_zenoh hashes the token with XXH3; subscribers only need a constant id.
        self._gid = hashlib.sha256(token.encode()).digest()[:16]
        self._attached = style != "ros2dds"
        self._count = 0

    def put(self, payload: zenoh.ZBytes) -> None:
        """Publish a message, with the attachment that rmw_zenoh requires."""
        if not self._attached:
            self._publisher.put(payload)
            return
        self._count += 1
        attachment = (ext.Int64(self._count), ext.Int64(time.time_ns()), self._gid)
        self._publisher.put(payload, attachment=ext.z_serialize(attachment))

    def close(self) -> None:
        """Withdraw the publisher and its liveliness token."""
        for declaration in (self._token, self._publisher):
            with contextlib.suppress(Exception):
                declaration.undeclare()


@dataclass(slots=True)
class _Topic:
    """A topic with its publishers, and the last published content."""

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
    """Published state of an environment.

    Attributes:
        versions: published root and digest of closures.
        topics: by name.
        retry: monotonic time of the next attempt after a failure.
    """

    versions: tuple[str, str] = ("", "")
    topics: dict[str, _Topic] = field(default_factory=dict)
    retry: float | None = None


class Ros2Publisher(LeaderThread):
    """Thread that publishes maps to ROS 2. One process of all servers publishes; if it dies, another takes over."""

    interval_seconds = 0.02

    def __init__(
        self,
        options: Ros2Options,
        bus: BusOptions,
        data_dir: Path,
        leads: Leads,
        *,
        generation: CommitCounter,
        look: LookUpVersions,
        fetch: Fetch,
    ) -> None:
        title = "ROS 2 publisher"
        super().__init__(generation, data_dir, NAME, leads, well=f"{title}: connected", trouble=f"{title}: down")
        self._options, self._bus = options, bus
        self._look_up_versions, self._fetch = look, fetch
        self._session: zenoh.Session | None = None
        self._node: Any = None
        self._entities = 0
        self._environments: dict[str, _PublishedEnvironment] = {}
        self._owners: dict[str, str] = {}

    def _run_once(self) -> None:
        """Publish changes, then wait for more."""
        if self._session is None and not self._open():
            self._stopping.wait(POLL_SECONDS)
            return
        generation = self._generation()
        self._publish_changes(self._look_up_versions())
        self._publish_state({"state": "connected", "topics": len(self._owners)})
        self._wait_for_commit(generation, VERSION_POLL_SECONDS)

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

    def _stand_by(self) -> None:
        """Withdraw the topics: another server publishes them."""
        if self._session is not None:
            self._release()
        super()._stand_by()

    def _on_unexpected_error(self) -> None:
        super()._on_unexpected_error()
        self._release()  # the last published state is uncertain

    def _release(self) -> None:
        for name in list(self._environments):
            self._retire(name, ())
        self._environments.clear()
        if self._session is not None:
            with contextlib.suppress(Exception):
                _close(self._session)
        self._session = self._node = None
        self._entities = 0

    # --- changes ---

    def _publish_changes(self, standing: Mapping[str, Version]) -> None:
        for name in [n for n in self._environments if n not in standing]:
            self._retire(name, ())
            del self._environments[name]
        for name, version in standing.items():
            if self._is_ending():
                return
            place = self._environments.setdefault(name, _PublishedEnvironment())
            waits = place.retry is not None and time.monotonic() < place.retry
            shown = (version.root, version.closures.digest if version.closures else "")
            if place.versions == shown and (place.retry is None or waits):
                continue
            place.versions, place.retry = shown, None
            try:
                content = self._fetch(version)
            except Exception as error:  # continue with the other environments
                if isinstance(error, FleetMapError):
                    log.warning("ROS 2: could not update %s, will retry: %s", name, error.detail)
                else:
                    log.exception("ROS 2: could not update %s, will retry", name)
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
                log.error("ROS 2: skipped a level of %s: another level has the same topic %s", name, topic.name)
                continue
            size = grid.width * grid.height
            if size > self._bus.max_reply_bytes:
                log.error(
                    "ROS 2: skipped %s: %d bytes exceed FLEETMAP_ZENOH_MAX_REPLY_BYTES (%d)",
                    topic.name,
                    size,
                    self._bus.max_reply_bytes,
                )
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
            log.info("ROS 2: published %s (version=%d, environment=%s)", topic.name, version.number, name)
        if content.network is not None:
            topic = ros_names.network_topic(namespace)
            out = self._out(name, place, topic)
            if out is not None:
                topic_names.add(topic.name)
                if out.last != content.network:
                    out.put(cdr.string(content.network))
                    out.last = content.network
                    log.info("ROS 2: published %s (version=%d, environment=%s)", topic.name, version.number, name)
        self._retire(name, topic_names)

    def _out(self, name: str, place: _PublishedEnvironment, topic: Topic) -> _Topic | None:
        """Return the declared topic; None if another environment has a topic of this name."""
        existing_topic = place.topics.get(topic.name)
        if existing_topic is not None:
            return existing_topic
        owner = self._owners.get(topic.name)
        if owner is not None:
            log.error(
                "ROS 2: skipped %s of %s: %s has the same topic; set namespaces in FLEETMAP_ROS2_ENVIRONMENTS",
                topic.name,
                name,
                owner,
            )
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
    """Encode the bounding rectangle of all differing cells as an OccupancyGridUpdate.

    The grids must have the same frame and differ in at least one cell.
    """
    shape = (after.height, after.width)
    new = np.frombuffer(after.cells, np.int8).reshape(shape)
    changed = new != np.frombuffer(before.cells, np.int8).reshape(shape)
    rows, columns = np.flatnonzero(changed.any(axis=1)), np.flatnonzero(changed.any(axis=0))
    y0, y1, x0, x1 = int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1
    block = new[y0:y1, x0:x1].tobytes()
    return cdr.occupancy_grid_update(x0, y0, x1 - x0, y1 - y0, block, version.time, FRAME)


def ros2_state(data_dir: Path) -> dict[str, Any]:
    """Return the state for /readyz: ``starting``, ``connected`` with the number of topics, ``down`` with the reason."""
    return leader.read_state(data_dir, NAME)


def _close(session: Any) -> None:
    session.close()
