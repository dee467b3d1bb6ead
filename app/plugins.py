"""Plug-ins: modules of other distributions that register formats or derivations, found by entry points.

A plug-in's module looks like a built-in one and declares the interface version that it was written for:
``FLEETMAP_INTERFACE = 1``. docs/contributing/plug-ins.md lists the public interface.
"""

from __future__ import annotations

import logging
from importlib.metadata import EntryPoint, entry_points
from typing import Any

INTERFACE = 1
"""Interface version, incremented by changes that break plug-ins."""

log = logging.getLogger(__name__)


def load(group: str, registry: dict[str, Any]) -> None:
    """Import the plug-ins of an entry point group, in the order of their distributions' names.

    A plug-in that fails is logged and leaves nothing in the registry: the server runs without it.
    """
    for entry in sorted(entry_points(group=group), key=lambda entry: (_distribution(entry), entry.name)):
        before = dict(registry)
        try:
            _check_interface(entry.load())
        except Exception as error:  # noqa: BLE001  foreign code may raise anything
            registry.clear()
            registry.update(before)
            reason = str(error) or type(error).__name__
            log.error("plug-in %s of %s is not used: %s", entry.name, _distribution(entry), reason)  # noqa: TRY400


def _check_interface(module: object) -> None:
    version = getattr(module, "FLEETMAP_INTERFACE", None)
    if version != INTERFACE:
        declared = "declares no FLEETMAP_INTERFACE" if version is None else f"was written for interface {version!r}"
        raise ValueError(f"it {declared}; this server has interface {INTERFACE}")


def _distribution(entry: EntryPoint) -> str:
    return f"{entry.dist.name} {entry.dist.version}" if entry.dist is not None else "an unknown distribution"
