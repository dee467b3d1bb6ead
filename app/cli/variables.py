"""Environment variables ``FLEETMAP_…``: which ones are read, and warnings about those that nothing reads."""

from __future__ import annotations

from collections.abc import Iterable

from app.model.names import did_you_mean, nearest

PREFIX = "FLEETMAP_"

CLIENT = frozenset({"FLEETMAP_SERVER", "FLEETMAP_TOKEN", "FLEETMAP_CA"})
"""Read by commands that call a server."""

AGENT = frozenset(
    f"{PREFIX}{name}"
    for name in (
        *("ROBOT", "AGENT_KEY", "HOOK_SECONDS"),
        *("ZENOH_CONNECT", "ZENOH_PREFIX", "ZENOH_CONFIG", "ZENOH_CA", "ZENOH_CERTIFICATE", "ZENOH_KEY"),
        *("ZENOH_USER", "ZENOH_PASSWORD"),
    )
)
"""Read by the agent; its commands are given more."""

HOOKS = ("NAV2_", "ROS_", "TOPOLOGICAL_", "HOOK_")
"""Starts of the names that the agent's ready-made hooks read."""

COMPOSE = frozenset({"FLEETMAP_PUBLISH", "FLEETMAP_ZENOH_PUBLISH"})
"""Read by the Compose file."""

MIN_SIMILARITY = 0.8
"""Similarity, 0 to 1, from which a variable is meant for a client: the names of a server's settings are not known."""


def unknown(names: Iterable[str], settings: Iterable[str]) -> list[str]:
    """Return a warning for each variable that neither a setting nor a client, the agent or its hooks read."""
    setting_names = {*settings, *CLIENT, *AGENT, *COMPOSE}
    hooks = tuple(f"{PREFIX}{start}" for start in HOOKS)
    return [
        f"unknown setting {name}{did_you_mean(name, setting_names)}; it has no effect"
        for name in sorted(names)
        if name not in setting_names and not name.startswith(hooks)
    ]


def mistyped(names: Iterable[str]) -> list[str]:
    """Return a warning for each variable that is nearly one that a client reads."""
    out = []
    for name in sorted(names):
        ours = name.startswith(PREFIX) and name not in CLIENT | AGENT | COMPOSE
        meant = nearest(name.removeprefix(PREFIX), [n.removeprefix(PREFIX) for n in CLIENT], similarity=MIN_SIMILARITY)
        if ours and meant is not None:
            out.append(f"unknown variable {name} (did you mean {PREFIX}{meant}?); it has no effect")
    return out
