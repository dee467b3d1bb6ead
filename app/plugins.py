"""Plug-ins: modules of other distributions that register formats or derivations, found by entry points.

A plug-in's module looks like a built-in one and declares the interface version that it was written for:
``FLEETMAP_INTERFACE = 1``. docs/contributing/plug-ins.md lists the public interface.
"""

from __future__ import annotations

import importlib
import logging
import pkgutil
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Generic, TypeVar

T = TypeVar("T")

INTERFACE = 1
"""Interface version, incremented by changes that break plug-ins."""

log = logging.getLogger(__name__)


class Registry(Generic[T]):
    """Values by name, which the modules of a package and plug-ins declare when they are imported.

    package: its public modules are imported. noun: for errors. group: entry point group of the plug-ins; empty: none.
    """

    def __init__(self, package: str, noun: str, group: str = "") -> None:
        self.entries: dict[str, T] = {}
        self._package, self._noun, self._group = package, noun, group
        self._complete = False

    def add(self, name: str, value: T) -> None:
        """Register a value. Raises ValueError if its name is taken."""
        if name in self.entries:
            raise ValueError(f"{self._noun} {name} is already registered")
        self.entries[name] = value

    def all(self) -> dict[str, T]:
        """Return every value by name, in alphabetical order. The first call imports the modules."""
        if not self._complete:
            self._import_modules()
            self._complete = True
        return dict(sorted(self.entries.items()))

    def _import_modules(self) -> None:
        for module in sorted(m.name for m in pkgutil.iter_modules(importlib.import_module(self._package).__path__)):
            if not module.startswith("_"):
                importlib.import_module(f"{self._package}.{module}")
        if self._group:
            load(self._group, self.entries)


def title(function: object) -> str:
    """Return the first line of a declared function's docstring, or its name."""
    name: str = function.__name__  # type: ignore[attr-defined]
    return (function.__doc__ or name).strip().splitlines()[0]


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
