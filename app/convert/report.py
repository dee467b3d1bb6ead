"""Map reports: origin of each layer, filled-in values, dropped content and warnings.

Reports are values; they are converted to JSON for responses, the command line, and the cache on disk.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import orjson

from app import formats
from app.convert.closures import ClosureLine, merge_report_lines
from app.errors import Problem
from app.formats import Format
from app.model.features import Features
from app.model.layers import LAYERS, VECTOR_LAYERS, Layer, Layers, PartKey
from app.model.notes import Dropped, Filled
from app.model.templates import NO_TEMPLATES, Templates
from app.store.values import Information, PartEntry
from app.templates import DEFAULT, resolve


@dataclass(frozen=True, slots=True)
class LayerLine:
    """Origin of one part in a map: raw, derived, generated or template, with steps, sources and credits.

    steps: as JSON, as in the provenance.
    """

    layer: Layer
    level: str
    name: str
    information: Information
    steps: tuple[Mapping[str, Any], ...] = ()
    sources: tuple[str, ...] = ()
    attribution: tuple[str, ...] = ()

    @property
    def key(self) -> PartKey:
        """Key of the part."""
        return PartKey(self.layer, self.level, self.name)

    def as_dict(self) -> dict[str, Any]:
        """Convert the line to JSON."""
        return {
            "layer": self.layer,
            "level": self.level,
            "name": self.name,
            "information": self.information,
            "steps": [dict(step) for step in self.steps],
            "sources": list(self.sources),
            "attribution": list(self.attribution),
        }

    @classmethod
    def from_dict(cls, line: Mapping[str, Any]) -> LayerLine:
        """Read the line from JSON."""
        lists = {name: tuple(line[name]) for name in ("steps", "sources", "attribution")}
        return cls(line["layer"], line["level"], line["name"], line["information"], **lists)


@dataclass(frozen=True, slots=True)
class Report:
    """Report of a map in one format. template: filled-in values. version: of an environment's map.

    attribution: licences and credits of all layers, without duplicates.
    """

    format: str
    layers: tuple[LayerLine, ...] = ()
    attribution: tuple[str, ...] = ()
    template: tuple[Filled, ...] = ()
    dropped: tuple[Dropped, ...] = ()
    warnings: tuple[Problem, ...] = ()
    closures: tuple[ClosureLine, ...] = ()
    version: int | None = None

    def as_dict(self) -> dict[str, Any]:
        """Convert the report to JSON; without ``version`` if there is none."""
        return {
            "format": self.format,
            "layers": [line.as_dict() for line in self.layers],
            "attribution": list(self.attribution),
            "template": [line.as_dict() for line in self.template],
            "dropped": [line.as_dict() for line in self.dropped],
            "warnings": [problem.as_dict() for problem in self.warnings],
            "closures": [line.as_dict() for line in self.closures],
        } | ({} if self.version is None else {"version": self.version})

    @classmethod
    def from_dict(cls, report: Mapping[str, Any]) -> Report:
        """Read the report from JSON."""
        return cls(
            report["format"],
            tuple(map(LayerLine.from_dict, report["layers"])),
            tuple(report["attribution"]),
            tuple(map(Filled.from_dict, report["template"])),
            tuple(map(Dropped.from_dict, report["dropped"])),
            tuple(Problem(**warning) for warning in report["warnings"]),
            tuple(map(ClosureLine.from_dict, report["closures"])),
            report.get("version"),
        )

    def with_value_origin(self, origin: Mapping[str, str], templates: Templates = NO_TEMPLATES) -> Report:
        """Add the origin of each filled-in value.

        origin: of the map's own parameters; that of nested maps follows from the environment's templates.
        """
        lines = []
        for line in self.template:
            origins = origin if line.format is None else resolve(templates, formats.get_format(line.format)).origin
            lines.append(replace(line, origin=origins.get(str(line.option), DEFAULT)))
        return replace(self, template=tuple(lines))


def merge_reports(reports: Sequence[tuple[str, Report]]) -> Report:
    """Join the reports of several maps, each with the folder of its files; remove duplicate lines."""
    every = [report for _, report in reports]
    warnings = [
        replace(one, file=folder + one.file) if one.file is not None else one
        for folder, report in reports
        for one in report.warnings
    ]
    return Report(
        every[0].format,
        _unique(line for report in every for line in report.layers),
        tuple(dict.fromkeys(text for report in every for text in report.attribution)),
        _unique(line for report in every for line in report.template),
        tuple(dict.fromkeys(line for report in every for line in report.dropped)),
        tuple(dict.fromkeys(warnings)),
        merge_report_lines(report.closures for report in every),
        every[0].version,
    )


L = TypeVar("L", LayerLine, Filled)


def _unique(lines: Iterable[L]) -> tuple[L, ...]:
    """Remove duplicates from lines that contain JSON and so cannot be hashed."""
    return tuple({orjson.dumps(line.as_dict(), option=orjson.OPT_SORT_KEYS): line for line in lines}.values())


def all_credits(lines: Iterable[LayerLine]) -> tuple[str, ...]:
    """Collect the licences and credits of these layers, without duplicates."""
    return tuple(dict.fromkeys(text for line in lines for text in line.attribution))


def unsupported_layers(fmt: Format, entries: Mapping[PartKey, PartEntry] | None, layers: Layers) -> tuple[Dropped, ...]:
    """List the layers that a format cannot express: of a stored version, or (entries: None) of layers in memory."""
    counts: dict[str, int] = {}
    if entries is not None:
        for key, entry in entries.items():
            if key.layer not in fmt.layers and entry.count:
                items = entry.count if key.layer in VECTOR_LAYERS else 1  # count grids and images, not their cells
                counts[key.layer] = counts.get(key.layer, 0) + items
    else:
        for key, part in layers.parts.items():
            if key.layer not in fmt.layers:
                counts[key.layer] = counts.get(key.layer, 0) + (len(part) if isinstance(part, Features) else 1)
    why = f"{fmt.name} cannot represent it"
    return tuple(Dropped(layer, counts[layer], why) for layer in LAYERS if counts.get(layer))
