"""What an environment fills in where no layer tells it: checked, and joined with what it said before."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from app import templates
from app.model.templates import FormatTemplate, Templates


@dataclass(frozen=True, slots=True)
class TemplateUpdate:
    """What is to be said from now on. set: the environment's; None: it stays. formats: what is said of these, instead
    of all that was; an empty one takes it back. clear: also forget all that is not named here."""

    set: str | None = None
    formats: Mapping[str, FormatTemplate] = field(default_factory=dict)
    clear: bool = False
    dry_run: bool = False

    def validated(self, location: str = "body.formats.{}") -> TemplateUpdate:
        """The same with typed values. NotFound for a format, Invalid for a set or values that there are none of.

        location: the place of a format's templates in the request.
        """
        if self.set is not None:
            templates.check_set(self.set, "body.set")
        out = {}
        for name, format_template in self.formats.items():
            fmt, place = templates.check_format(name), location.format(name)
            if format_template.set is not None:
                templates.check_set(format_template.set, f"{place}.set")
            out[name] = FormatTemplate(
                format_template.set, templates.check_values(fmt, format_template.values, f"{place}.values")
            )
        return TemplateUpdate(self.set, out, self.clear, self.dry_run)

    def apply_to(self, old: Templates) -> Templates:
        """What holds then."""
        new = Templates() if self.clear else old
        new = Templates(self.set or new.set, new.formats)
        for name, format_template in self.formats.items():
            new = templates.with_format_template(new, name, format_template)
        return new

    def summary(self) -> str:
        """In a few words, for the history."""
        parts = [] if self.set is None else [f"the set {self.set}"]
        parts += [
            name if format_template.as_dict() else f"{name} taken back"
            for name, format_template in sorted(self.formats.items())
        ]
        return f"Templates: {', '.join(parts) or ('taken back' if self.clear else 'as before')}"

    def as_dict(self) -> dict[str, Any]:
        """For a fingerprint of the request."""
        format_templates = {name: format_template.as_dict() for name, format_template in self.formats.items()}
        return {"set": self.set, "formats": format_templates, "clear": self.clear}
