"""Template values of an environment, for formats that need more than the layers have: a named set, and own values.

Stored with each version; ``app.templates`` defines the sets and resolves the values of a format.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

DEFAULT_SET: Final = "default"
"""Name of the set that leaves each format's own defaults unchanged."""


@dataclass(frozen=True, slots=True)
class FormatTemplate:
    """An environment's template for one format.

    set: another set than the environment's, or None. values: by parameter, as JSON; they take precedence over any set.
    """

    set: str | None = None
    values: Mapping[str, Any] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON members, without the empty ones; values by name."""
        out: dict[str, Any] = {} if self.set is None else {"set": self.set}
        return out | ({"values": dict(sorted(self.values.items()))} if self.values else {})


@dataclass(frozen=True, slots=True)
class Templates:
    """An environment's chosen set, and its own values by format."""

    set: str = DEFAULT_SET
    formats: Mapping[str, FormatTemplate] = field(default_factory=dict)

    def for_format(self, name: str) -> FormatTemplate:
        """Return the template of a format."""
        return self.formats.get(name) or FormatTemplate()

    def set_of(self, name: str) -> str:
        """Return the set that applies to a format."""
        return self.for_format(name).set or self.set

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON members in a fixed order; empty if nothing was ever set."""
        format_values = {name: template.as_dict() for name, template in sorted(self.formats.items())}
        format_values = {name: template for name, template in format_values.items() if template}
        out: dict[str, Any] = {} if self.set == DEFAULT_SET else {"set": self.set}
        return out | ({"formats": format_values} if format_values else {})

    @classmethod
    def from_dict(cls, members: Mapping[str, Any]) -> Templates:
        """Read the result of ``as_dict``."""
        format_templates = {
            str(name): FormatTemplate(template.get("set"), dict(template.get("values", {})))
            for name, template in members.get("formats", {}).items()
        }
        return cls(members.get("set", DEFAULT_SET), format_templates)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Templates) and self.as_dict() == other.as_dict()

    def __hash__(self) -> int:
        return hash(repr(self.as_dict()))


NO_TEMPLATES: Final = Templates()
"""Templates of an environment without settings."""


def template_changes(old: Templates, new: Templates) -> dict[str, Any]:
    """Return the differences ``{templates: {set: {from, to}, FORMAT: {PARAMETER: {from, to}, set: …}}}``, or {}.

    None means not set.
    """
    out: dict[str, Any] = {}
    if old.set != new.set:
        out["set"] = {"from": old.set, "to": new.set}
    for name in sorted(old.formats.keys() | new.formats.keys()):
        a, b = old.for_format(name), new.for_format(name)
        changed: dict[str, Any] = {} if a.set == b.set else {"set": {"from": a.set, "to": b.set}}
        for key in sorted(a.values.keys() | b.values.keys()):
            if (key in a.values) != (key in b.values) or a.values.get(key) != b.values.get(key):
                changed[key] = {"from": a.values.get(key), "to": b.values.get(key)}
        if changed:
            out[name] = changed
    return {"templates": out} if out else {}
