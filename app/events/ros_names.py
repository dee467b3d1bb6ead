"""ROS 2 names on Zenoh: topics, keys and liveliness tokens.

``rmw_zenoh`` publishes a message at ``<domain>/<topic>/<type>/<hash of the type>`` and announces nodes and publishers
by tokens under ``@ros2_lv/<domain>``; in Humble the hash is ``TypeHashNotSupported``. ``zenoh-bridge-ros2dds``
publishes at the topic's name and announces publishers by tokens under ``@/<session>/@ros2_lv``. Sources: rmw_zenoh's
design document and liveliness_utils.cpp, zenoh-plugin-ros2dds' liveliness_mgt.rs; REP 2011 for the hashes (``RIHS01``).
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Literal, get_args

NODE = "fleet_map_server"

Keys = Literal["rmw_zenoh", "rmw_zenoh_humble", "ros2dds"]
KEYS: tuple[Keys, ...] = get_args(Keys)

UNHASHED = "TypeHashNotSupported"

_PIECE = r"[A-Za-z][A-Za-z0-9]*(?:_[A-Za-z0-9]+)*_?"
_NAMESPACE = re.compile(rf"/|(?:/{_PIECE})+")
_PATTERN = re.compile(r"[a-z0-9*?][a-z0-9_*?-]{0,62}")


@dataclass(frozen=True, slots=True)
class Type:
    """Message type: ``package/msg/Name`` and the hash of its definition."""

    name: str
    hash: str

    @property
    def dds(self) -> str:
        """DDS name of the type, ``package::msg::dds_::Name_``."""
        package, kind, name = self.name.split("/")
        return f"{package}::{kind}::dds_::{name}_"


GRID = Type("nav_msgs/msg/OccupancyGrid", "RIHS01_8d348150c12913a31ee0ec170fbf25089e4745d17035792a1ba94d6f0bc0cfc7")
GRID_UPDATE = Type(
    "map_msgs/msg/OccupancyGridUpdate", "RIHS01_c4095b0be2e4363f8978a1570e0293ee093436f1e1c61d99b48502ac317025e8"
)
STRING = Type("std_msgs/msg/String", "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18")


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic. All topics are reliable and keep the last ``depth`` messages.

    Attributes:
        name: full name (``/farm/map``).
        latched: whether late joiners get the last message.
    """

    name: str
    type: Type
    latched: bool
    depth: int

    def key(self, style: Keys, domain: int) -> str:
        """Return the key of its messages."""
        bare = self.name.strip("/")
        return bare if style == "ros2dds" else f"{domain}/{bare}/{self.type.dds}/{self._hash(style)}"

    def token(self, style: Keys, domain: int, session: str, entity: int) -> str:
        """Return the liveliness token that announces its publisher.

        Args:
            session: id of the Zenoh session.
            entity: unique number within the session.
        """
        if style == "ros2dds":
            # Values of Cyclone DDS: reliable 1, transient local 1, keep last 0. A reader of the token takes the type's
            # hash from the user data, where DDS carries it since Iron.
            quality = f":1:{int(self.latched)}:0,{self.depth}:typehash={self.type.hash};"
            return f"@/{session}/@ros2_lv/MP/{_escape(self.name.strip('/'))}/{_escape(self.type.name)}/{quality}"
        # rmw_zenoh omits its defaults: reliable, volatile, keep last.
        quality = f":{'1' if self.latched else ''}:,{self.depth}:,:,:,,"
        name = self.name.replace("/", "%")
        return (
            f"@ros2_lv/{domain}/{session}/0/{entity}/MP/%/%/{NODE}/{name}/{self.type.dds}/{self._hash(style)}/{quality}"
        )

    def _hash(self, style: Keys) -> str:
        return UNHASHED if style == "rmw_zenoh_humble" else self.type.hash


def node_token(domain: int, session: str) -> str:
    """Return the liveliness token that announces the node to rmw_zenoh."""
    return f"@ros2_lv/{domain}/{session}/0/0/NN/%/%/{NODE}"


def _escape(name: str) -> str:
    return name.replace("/", "§")


# --- topics of environments ---------------------------------------------------------------------------------------
def map_topic(namespace: str, level: str | None) -> Topic:
    """Return the grid topic of a level; None: the lowest level, whose topic has no level name."""
    return Topic(_below(namespace, level, "map"), GRID, latched=True, depth=1)


def update_topic(namespace: str, level: str | None) -> Topic:
    """Return the topic of grid updates of a level, with the name that Nav2 subscribes to."""
    return Topic(_below(namespace, level, "map_updates"), GRID_UPDATE, latched=False, depth=10)


def network_topic(namespace: str) -> Topic:
    """Return the topic of the network of all levels, with the name that topological_navigation subscribes to."""
    return Topic(_below(namespace, None, "topological_map_2"), STRING, latched=True, depth=1)


def _below(namespace: str, level: str | None, name: str) -> str:
    return "/".join([namespace.rstrip("/"), *([] if level is None else [token(level, "level")]), name])


def token(text: str, before: str) -> str:
    """Convert a name to a segment of a topic name: letters, digits and single underscores, no leading digit.

    Args:
        before: prefix if it would start with a digit or with an underscore (hidden topic).
    """
    bare = re.sub(r"_+", "_", re.sub(r"[^A-Za-z0-9_]", "_", text)).rstrip("_")
    return bare if bare[:1].isalpha() else f"{before}_{bare.lstrip('_')}".rstrip("_")


@dataclass(frozen=True, slots=True)
class EnvironmentSelector:
    """Environments to publish: name or pattern, and namespace (None: ``/`` and the environment's name)."""

    pattern: str
    namespace: str | None

    @property
    def is_single(self) -> bool:
        """Whether it selects a single environment by name."""
        return not any(c in self.pattern for c in "*?")


def parse_selectors(text: str) -> tuple[EnvironmentSelector, ...]:
    """Parse a setting such as ``farm, hall=/site/hall, north-*``. Raises ValueError."""
    out = []
    for piece in filter(None, (part.strip() for part in text.split(","))):
        name, equals, namespace = (part.strip() for part in piece.partition("="))
        chosen = EnvironmentSelector(name, namespace if equals else None)
        if not _PATTERN.fullmatch(name):
            raise ValueError(f"invalid environment {name[:80]!r}: use a name or a pattern with * and ?")
        if chosen.namespace is not None:
            if not chosen.is_single:
                raise ValueError(
                    f"invalid environment {piece[:80]!r}: environments of a pattern cannot share a namespace"
                )
            if not _NAMESPACE.fullmatch(chosen.namespace) or "__" in chosen.namespace:
                raise ValueError(f"invalid namespace {chosen.namespace[:80]!r}: use one like / or /site/hall")
        out.append(chosen)
    spaces = [c.namespace for c in out if c.namespace is not None]
    if len(spaces) != len(set(spaces)):
        raise ValueError("duplicate namespace: use a different one for each environment")
    return tuple(out)


def parse_keys(text: str) -> tuple[Keys, ...]:
    """Parse a setting such as ``rmw_zenoh,ros2dds``. Raises ValueError."""
    names = list(dict.fromkeys(filter(None, (part.strip() for part in text.split(",")))))
    unknown = [name for name in names if name not in KEYS]
    if unknown or not names:
        raise ValueError(f"unknown keys {', '.join(unknown)[:80]!r}: use one or several of {', '.join(KEYS)}")
    return tuple(key for key in KEYS if key in names)


def namespace_of(environment: str, chosen: Iterable[EnvironmentSelector]) -> str | None:
    """Return the namespace of an environment from the first selector that matches it; None if none does."""
    for entry in chosen:
        if fnmatchcase(environment, entry.pattern):
            return entry.namespace or "/" + token(environment, "environment")
    return None
