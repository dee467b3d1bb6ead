"""Form fields of uploads: each field is taken and checked once; the rest are options of a format."""

from __future__ import annotations

from collections.abc import Iterable

from app.api.http.parameters import require_format
from app.api.http.uploads import UploadForm
from app.errors import Invalid, Problem
from app.model.frame import GROUND, Level
from app.upload_reader import UploadHints, parse_drawn_layer

_TRUTH = {"": False, "false": False, "0": False, "no": False, "true": True, "1": True, "yes": True}


class FormFields:
    """Fields of a form and its query that are not taken yet. Empty fields count as missing."""

    def __init__(self, form: UploadForm, query: Iterable[tuple[str, str]] = ()) -> None:
        self._fields = dict(form.fields)
        for name, value in query:
            if name in self._fields:
                raise Invalid(f"duplicate field {name[:80]!r}: give it once", [Problem("duplicate", where=name[:80])])
            self._fields[name] = value

    def take(self, name: str) -> str:
        """Take the text of a field; empty if it is missing."""
        return self._fields.pop(name, "")

    def take_flag(self, name: str) -> bool:
        """Take a boolean field; False if it is missing."""
        text = self.take(name)
        if text.lower() not in _TRUTH:
            raise Invalid(
                f"{name} must be true or false, got {text[:80]!r}", [Problem("must be true or false", where=name)]
            )
        return _TRUTH[text.lower()]

    def take_format(self, name: str) -> str | None:
        """Take the id of a format. Raises Invalid with the existing ids for an unknown one."""
        text = self.take(name)
        return require_format(text, name).name if text else None

    def take_hints(self) -> UploadHints:
        """Take layer, level, format and grid of the files, without options."""
        layer = parse_drawn_layer(self.take("layer") or None)
        level = self.take("level") or GROUND
        Level(level)
        return UploadHints(self.take_format("format"), layer, level, self.take("grid") or None)

    def take_rest(self) -> dict[str, str]:
        """Take all remaining fields."""
        fields, self._fields = self._fields, {}
        return fields
