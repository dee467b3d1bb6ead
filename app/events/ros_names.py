"""What ROS 2 calls things on Zenoh: names of topics, keys, liveliness tokens.

``rmw_zenoh`` puts a message at ``<domain>/<topic>/<type>/<hash of the type>`` and tells of nodes and publishers by
tokens under ``@ros2_lv/<domain>``; Humble's says ``TypeHashNotSupported`` for the hash. ``zenoh-bridge-ros2dds`` puts
it at the topic's name, and tells of publishers by tokens under ``@/<session>/@ros2_lv``. Sources: rmw_zenoh's design
document and liveliness_utils.cpp, zenoh-plugin-ros2dds' liveliness_mgt.rs; REP 2011 for the hashes (``RIHS01``).
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
    """A message's type: ``package/msg/Name`` and the hash of its definition."""

    name: str
    hash: str

    @property
    def dds(self) -> str:
        """``package::msg::dds_::Name_``."""
        package, kind, name = self.name.split("/")
        return f"{package}::{kind}::dds_::{name}_"


GRID = Type("nav_msgs/msg/OccupancyGrid", "RIHS01_8d348150c12913a31ee0ec170fbf25089e4745d17035792a1ba94d6f0bc0cfc7")
GRID_UPDATE = Type(
    "map_msgs/msg/OccupancyGridUpdate", "RIHS01_c4095b0be2e4363f8978a1570e0293ee093436f1e1c61d99b48502ac317025e8"
)
STRING = Type("std_msgs/msg/String", "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18")


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic: its full name (``/farm/map``), its type, and whether late joiners get the last message.

    All are reliable and keep the last ``depth`` messages.
    """

    name: str
    type: Type
    latched: bool
    depth: int

    def key(self, style: Keys, domain: int) -> str:
        """Where its messages are put."""
        bare = self.name.strip("/")
        return bare if style == "ros2dds" else f"{domain}/{bare}/{self.type.dds}/{self._hash(style)}"

    def token(self, style: Keys, domain: int, session: str, entity: int) -> str:
        """The liveliness token that says that it is published. session: the Zenoh session's id. entity: a number of
        its own in the session."""
        if style == "ros2dds":
            # Values of Cyclone DDS: reliable 1, transient local 1, keep last 0. A reader of the token takes the type's
            # hash from the user data, where DDS carries it since Iron.
            quality = f":1:{int(self.latched)}:0,{self.depth}:typehash={self.type.hash};"
            return f"@/{session}/@ros2_lv/MP/{_escape(self.name.strip('/'))}/{_escape(self.type.name)}/{quality}"
        # rmw_zenoh leaves out what is its default: reliable, volatile, keep last.
        quality = f":{'1' if self.latched else ''}:,{self.depth}:,:,:,,"
        name = self.name.replace("/", "%")
        return (
            f"@ros2_lv/{domain}/{session}/0/{entity}/MP/%/%/{NODE}/{name}/{self.type.dds}/{self._hash(style)}/{quality}"
        )

    def _hash(self, style: Keys) -> str:
        return UNHASHED if style == "rmw_zenoh_humble" else self.type.hash


def node_token(domain: int, session: str) -> str:
    """The liveliness token of rmw_zenoh that says that the node is there."""
    return f"@ros2_lv/{domain}/{session}/0/0/NN/%/%/{NODE}"


def _escape(name: str) -> str:
    return name.replace("/", "§")


# --- topics of environments ---------------------------------------------------------------------------------------
def map_topic(namespace: str, level: str | None) -> Topic:
    """The grid of a level; None: of the environment's lowest, which needs no name."""
    return Topic(_below(namespace, level, "map"), GRID, latched=True, depth=1)


def update_topic(namespace: str, level: str | None) -> Topic:
    """The changed rectangles of a level's grid, called as Nav2 looks for it."""
    return Topic(_below(namespace, level, "map_updates"), GRID_UPDATE, latched=False, depth=10)


def network_topic(namespace: str) -> Topic:
    """The network of all levels, called as topological_navigation looks for it."""
    return Topic(_below(namespace, None, "topological_map_2"), STRING, latched=True, depth=1)


def _below(namespace: str, level: str | None, name: str) -> str:
    return "/".join([namespace.rstrip("/"), *([] if level is None else [token(level, "level")]), name])


def token(text: str, before: str) -> str:
    """Some name as a piece of a topic's name: letters, digits and single underscores, no digit first.

    before: what is put first where it would start with a digit, or be hidden (with an underscore).
    """
    bare = re.sub(r"_+", "_", re.sub(r"[^A-Za-z0-9_]", "_", text)).rstrip("_")
    return bare if bare[:1].isalpha() else f"{before}_{bare.lstrip('_')}".rstrip("_")


@dataclass(frozen=True, slots=True)
class EnvironmentSelector:
    """Environments that go out: a name or a pattern, and their namespace (None: ``/`` and the environment's name)."""

    pattern: str
    namespace: str | None

    @property
    def is_single(self) -> bool:
        """Whether it names a single environment."""
        return not any(c in self.pattern for c in "*?")


def parse_selectors(text: str) -> tuple[EnvironmentSelector, ...]:
    """``farm, hall=/site/hall, north-*`` as a setting says it. ValueError says what is wrong."""
    out = []
    for piece in filter(None, (part.strip() for part in text.split(","))):
        name, equals, namespace = (part.strip() for part in piece.partition("="))
        chosen = EnvironmentSelector(name, namespace if equals else None)
        if not _PATTERN.fullmatch(name):
            raise ValueError(f"{name!r} is neither an environment's name nor a pattern of such")
        if chosen.namespace is not None:
            if not chosen.is_single:
                raise ValueError(
                    f"{piece!r}: a pattern stands for several environments, which cannot share a namespace"
                )
            if not _NAMESPACE.fullmatch(chosen.namespace) or "__" in chosen.namespace:
                raise ValueError(f"{chosen.namespace!r} is no namespace of ROS 2, like / or /site/hall")
        out.append(chosen)
    spaces = [c.namespace for c in out if c.namespace is not None]
    if len(spaces) != len(set(spaces)):
        raise ValueError("two environments cannot share a namespace")
    return tuple(out)


def parse_keys(text: str) -> tuple[Keys, ...]:
    """``rmw_zenoh,ros2dds`` as a setting says it. ValueError says what is wrong."""
    names = list(dict.fromkeys(filter(None, (part.strip() for part in text.split(",")))))
    unknown = [name for name in names if name not in KEYS]
    if unknown or not names:
        raise ValueError(f"{', '.join(map(repr, unknown)) or 'nothing'}: there are {', '.join(KEYS)}")
    return tuple(key for key in KEYS if key in names)


def namespace_of(environment: str, chosen: Iterable[EnvironmentSelector]) -> str | None:
    """The namespace of an environment: that of the first entry that names or matches it; None where none does."""
    for entry in chosen:
        if fnmatchcase(environment, entry.pattern):
            return entry.namespace or "/" + token(environment, "environment")
    return None
