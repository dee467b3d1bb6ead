"""Template updates of an environment: validate them and merge them with its templates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from app import templates
from app.model.templates import FormatTemplate, Templates


@dataclass(frozen=True, slots=True)
class TemplateUpdate:
    """Update of an environment's templates.

    set: template set of the environment; None keeps the current one. formats: new templates of these formats, replacing
    all previous ones; an empty one resets the format. clear: also reset everything not named here.
    """

    set: str | None = None
    formats: Mapping[str, FormatTemplate] = field(default_factory=dict)
    clear: bool = False

    def validated(self, location: str = "body.formats.{}") -> TemplateUpdate:
        """Return the update with typed values.

        location: the place of a format's templates in the request. Raises NotFound for an unknown format, Invalid for
        an unknown set or unknown values.
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
        return TemplateUpdate(self.set, out, self.clear)

    def apply_to(self, old: Templates) -> Templates:
        """Return the templates after the update."""
        new = Templates() if self.clear else old
        new = Templates(self.set or new.set, new.formats)
        for name, format_template in self.formats.items():
            new = templates.with_format_template(new, name, format_template)
        return new

    def summary(self) -> str:
        """Summarise the update as a version message."""
        parts = [] if self.set is None else [f"the set {self.set}"]
        parts += [
            name if format_template.as_dict() else f"{name} reset"
            for name, format_template in sorted(self.formats.items())
        ]
        return f"Templates: {', '.join(parts) or ('reset' if self.clear else 'unchanged')}"

    def as_dict(self) -> dict[str, Any]:
        """Return the update as JSON, for a fingerprint of the request."""
        format_templates = {name: format_template.as_dict() for name, format_template in self.formats.items()}
        return {"set": self.set, "formats": format_templates, "clear": self.clear}
