"""Data of an upload: hints of its sender, context of the environment, and the content of its files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import shapely

from app.errors import Problem
from app.formats import FileGroup
from app.model.features import Features
from app.model.frame import GROUND, Datum, Level
from app.model.imagery import GeoImage
from app.model.layers import Layer, Layers, Part, PartKey, join_levels


@dataclass(frozen=True, slots=True)
class UploadHints:
    """Hints of the sender about the files; everything else is detected from their content."""

    format: str | None = None
    layer: Layer | None = None
    level: str = GROUND
    grid: str | None = None
    options: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class EnvironmentContext:
    """Context of the environment, and the content that will be used (see ``ReadContext``)."""

    datum: Datum | None = None
    fence: shapely.Polygon | None = None
    wanted: frozenset[Layer] | None = None
    cells: bool = True
    whole: bool = True


@dataclass(frozen=True, slots=True)
class ParsedPart:
    """One part read from one file."""

    key: PartKey
    part: Part
    group: FileGroup


@dataclass(slots=True)
class FileUse:
    """Use of a file: its format and whether it is used."""

    format: str | None = None
    used: bool = False


@dataclass(slots=True)
class Bundle:
    """Combined content of the files: parts by key, each with its files and format."""

    parts: dict[PartKey, Part] = field(default_factory=dict)
    origin: dict[PartKey, tuple[tuple[str, ...], str]] = field(default_factory=dict)
    datum: Datum | None = None
    levels: tuple[Level, ...] = ()
    files: dict[str, FileUse] = field(default_factory=dict)
    warnings: list[Problem] = field(default_factory=list)
    fence: shapely.Polygon | None = None
    notices: dict[str, str] = field(default_factory=dict)
    credits: Mapping[PartKey, tuple[str, ...]] = field(default_factory=dict)
    inner: bool = False

    def credit(self, key: PartKey) -> tuple[str, ...]:
        """Collect the licences and credits of a part, from its files and the licence files in their folders."""
        part = self.parts[key]
        attribution = part.document.get("attribution", ()) if isinstance(part, Features) else ()
        attribution = part.attribution if isinstance(part, GeoImage) else attribution
        texts = [text for text in attribution if isinstance(text, str)] if isinstance(attribution, list | tuple) else []
        texts += self.credits.get(key, ())
        names, _ = self.origin.get(key, ((), ""))
        for notice, text in sorted(self.notices.items()):
            folder = notice.rpartition("/")[0]
            if any(not folder or name.startswith(f"{folder}/") for name in names):
                texts.append(text)
        return tuple(dict.fromkeys(texts))

    def layers(self, datum: Datum | None) -> Layers:
        """Return the parts as layers with a datum; the bundle's own takes precedence."""
        return Layers(dict(self.parts), self.datum or datum, join_levels((Level(),), self.levels))
