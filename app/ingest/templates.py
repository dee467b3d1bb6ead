"""What an environment fills in where no layer tells it: checked, and joined with what it said before."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from app import templates
from app.model.templates import Own, Templates


@dataclass(frozen=True, slots=True)
class TemplateWish:
    """What is to be said from now on. set: the environment's; None: it stays. formats: what is said of these, instead
    of all that was; an empty one takes it back. clear: also forget all that is not named here."""

    set: str | None = None
    formats: Mapping[str, Own] = field(default_factory=dict)
    clear: bool = False
    dry_run: bool = False

    def checked(self, where: str = "body.formats.{}") -> TemplateWish:
        """The same with typed values. NotFound for a format, Invalid for a set or values that there are none of.

        where: the place of a format's templates in the request.
        """
        if self.set is not None:
            templates.check_set(self.set, "body.set")
        out = {}
        for name, own in self.formats.items():
            known, place = templates.check_format(name), where.format(name)
            if own.set is not None:
                templates.check_set(own.set, f"{place}.set")
            out[name] = Own(own.set, templates.check_values(known, own.values, f"{place}.values"))
        return TemplateWish(self.set, out, self.clear, self.dry_run)

    def applied(self, old: Templates) -> Templates:
        """What holds then."""
        new = Templates() if self.clear else old
        new = Templates(self.set or new.set, new.formats)
        for name, own in self.formats.items():
            new = templates.with_own(new, name, own)
        return new

    def told(self) -> str:
        """In a few words, for the history."""
        said = [] if self.set is None else [f"the set {self.set}"]
        said += [name if own.as_dict() else f"{name} taken back" for name, own in sorted(self.formats.items())]
        return f"Templates: {', '.join(said) or ('taken back' if self.clear else 'as before')}"

    def as_dict(self) -> dict[str, Any]:
        """For a fingerprint of the request."""
        own = {name: said.as_dict() for name, said in self.formats.items()}
        return {"set": self.set, "formats": own, "clear": self.clear}
