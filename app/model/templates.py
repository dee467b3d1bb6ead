"""What an environment fills in where a format asks for something that no layer has: a named set, and values of its own.

Kept with each version; ``app.templates`` has the sets and says what holds for a format.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

DEFAULT_SET: Final = "default"
"""The set that leaves each format's own defaults as they are."""


@dataclass(frozen=True, slots=True)
class FormatTemplate:
    """What an environment says of one format. set: another set than the environment's, or None. values: by parameter,
    as JSON has them; they go before those of any set."""

    set: str | None = None
    values: Mapping[str, Any] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """JSON-like members, without the empty ones; values by name."""
        out: dict[str, Any] = {} if self.set is None else {"set": self.set}
        return out | ({"values": dict(sorted(self.values.items()))} if self.values else {})


@dataclass(frozen=True, slots=True)
class Templates:
    """The set that an environment has chosen, and by format what it says itself."""

    set: str = DEFAULT_SET
    formats: Mapping[str, FormatTemplate] = field(default_factory=dict)

    def for_format(self, name: str) -> FormatTemplate:
        """What is said of a format."""
        return self.formats.get(name) or FormatTemplate()

    def set_of(self, name: str) -> str:
        """The set that holds for a format."""
        return self.for_format(name).set or self.set

    def as_dict(self) -> dict[str, Any]:
        """JSON-like members in one order; empty where nothing was ever said."""
        format_values = {name: template.as_dict() for name, template in sorted(self.formats.items())}
        format_values = {name: template for name, template in format_values.items() if template}
        out: dict[str, Any] = {} if self.set == DEFAULT_SET else {"set": self.set}
        return out | ({"formats": format_values} if format_values else {})

    @classmethod
    def from_dict(cls, members: Mapping[str, Any]) -> Templates:
        """The reverse of ``as_dict``."""
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
"""An environment that has said nothing."""


def template_changes(old: Templates, new: Templates) -> dict[str, Any]:
    """``{templates: {set: {from, to}, FORMAT: {PARAMETER: {from, to}, set: {from, to}}}}`` of what differs, or {}.

    None stands for what is not said.
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
