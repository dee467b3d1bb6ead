"""Environment variables ``FLEETMAP_…``: names in use, and warnings about unused ones."""

from __future__ import annotations

from collections.abc import Iterable

from app.model.names import did_you_mean, nearest

PREFIX = "FLEETMAP_"

CLIENT = frozenset({"FLEETMAP_SERVER", "FLEETMAP_TOKEN", "FLEETMAP_CA"})
"""Variables of commands that call a server."""

AGENT = frozenset(
    f"{PREFIX}{name}"
    for name in (
        *("ROBOT", "AGENT_KEY", "HOOK_SECONDS"),
        *("ZENOH_CONNECT", "ZENOH_PREFIX", "ZENOH_CONFIG", "ZENOH_CA", "ZENOH_CERTIFICATE", "ZENOH_KEY"),
        *("ZENOH_USER", "ZENOH_PASSWORD"),
    )
)
"""Variables of the agent. Its hooks get further ones from the agent."""

HOOKS = ("NAV2_", "ROS_", "TOPOLOGICAL_", "HOOK_")
"""Prefixes of the variables of the agent's bundled hooks."""

COMPOSE = frozenset({"FLEETMAP_PUBLISH", "FLEETMAP_ZENOH_PUBLISH"})
"""Variables of the Compose file."""

MIN_SIMILARITY = 0.8
"""Minimum similarity (0 to 1) of a mistyped client variable; high, since clients do not know the server's settings."""


def unknown(names: Iterable[str], settings: Iterable[str]) -> list[str]:
    """Return a warning for each variable that neither the server, a client, the agent nor its hooks use."""
    setting_names = {*settings, *CLIENT, *AGENT, *COMPOSE}
    hooks = tuple(f"{PREFIX}{start}" for start in HOOKS)
    return [
        f"unknown setting {name}{did_you_mean(name, setting_names)}; it has no effect"
        for name in sorted(names)
        if name not in setting_names and not name.startswith(hooks)
    ]


def mistyped(names: Iterable[str]) -> list[str]:
    """Return a warning for each variable that is probably a mistyped client variable."""
    out = []
    for name in sorted(names):
        ours = name.startswith(PREFIX) and name not in CLIENT | AGENT | COMPOSE
        meant = nearest(name.removeprefix(PREFIX), [n.removeprefix(PREFIX) for n in CLIENT], similarity=MIN_SIMILARITY)
        if ours and meant is not None:
            out.append(f"unknown variable {name} (did you mean {PREFIX}{meant}?); it has no effect")
    return out
