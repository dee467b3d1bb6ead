"""What is known of an upload: hints of its sender, the environment's context, and what its files say together."""

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
    """What the sender said of the files; everything else is found out from their content."""

    format: str | None = None
    layer: Layer | None = None
    level: str = GROUND
    grid: str | None = None
    options: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class EnvironmentContext:
    """What the environment knows already, and what will be used of the files (see ``ReadContext``)."""

    datum: Datum | None = None
    fence: shapely.Polygon | None = None
    wanted: frozenset[Layer] | None = None
    cells: bool = True
    whole: bool = True


@dataclass(frozen=True, slots=True)
class ParsedPart:
    """One part as one file told it."""

    key: PartKey
    part: Part
    group: FileGroup


@dataclass(slots=True)
class FileUse:
    """What became of a file."""

    format: str | None = None
    used: bool = False


@dataclass(slots=True)
class Bundle:
    """What the files say together: parts by key, each with the files and format it came from."""

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
        """Licences and credits of a part: what its files say themselves, and the licence files of their folders."""
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
        """The parts under a datum (the bundle's own wins)."""
        return Layers(dict(self.parts), self.datum or datum, join_levels((Level(),), self.levels))
