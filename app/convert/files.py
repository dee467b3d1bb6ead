"""Convert files to files without a store: ``fleetmap convert`` and ``POST /convert``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from app import formats, upload_reader
from app.convert import recipe as recipes
from app.convert import site
from app.convert import worker as making
from app.convert.report import Report, unsupported_layers
from app.errors import CannotConvert, Invalid, NotFound, Problem
from app.formats import Files, Format
from app.limits import Limits
from app.model.frame import Datum
from app.model.layers import Layer, Layers
from app.store.values import PartEntry, Provenance
from app.templates import REQUEST
from app.upload_reader import EnvironmentContext, UploadHints


@dataclass(frozen=True, slots=True)
class Converted:
    """Converted map: files, main file first, its report, and warnings about the input."""

    files: dict[str, bytes]
    report: Report
    warnings: list[Problem] = field(default_factory=list)


def offline(
    files: Files,
    to: str,
    *,
    hints: UploadHints | None = None,
    datum: Datum | None = None,
    options: Mapping[str, str] | None = None,
    derived: bool = True,
    limits: Limits | None = None,
) -> Converted:
    """Read files, derive missing layers, and write the target format.

    options: options of the target format, and parameters of the derivations.

    Raises the errors of ``app.upload_reader.read`` and ``app.convert.recipe.plan_chain``.
    """
    return _offline(lambda: files, to, hints or UploadHints(), datum, options or {}, limits or Limits(), derived)


def _offline(
    load: Callable[[], Files],
    to: str,
    hints: UploadHints,
    datum: Datum | None,
    options: Mapping[str, str],
    limits: Limits,
    derived: bool,
) -> Converted:
    """Run ``offline`` on files that are loaded on demand and released before the map is written."""
    fmt = formats.get_format(to)
    option_values = dict(options)
    recipes.writer_options(fmt, option_values)
    needed: frozenset[Layer] = fmt.layers | fmt.needs.also.union(*fmt.needs.one_of)
    if "topology" in fmt.layers:
        needed |= {"occupancy"}  # for warnings about edges that cross occupied cells
    required_layers = None if "objects" in needed else needed  # any file can contain objects
    if site.selects_all(fmt, option_values):
        required_layers = None  # further parts may be derived from any layer
    cells = bool(option_values) or not fmt.traits.outlines  # an option may need the images, too
    complete = required_layers is None and cells
    knowing = EnvironmentContext(datum, None, required_layers, cells, fmt.traits.is_drawing or fmt.traits.is_container)
    upload_bundle = upload_reader.read(upload_reader.unpack(load(), limits), hints, knowing, limits)
    try:
        written = _convert_layers(fmt, upload_bundle, datum, option_values, derived=derived and complete)
    except (CannotConvert, Invalid, NotFound):
        if complete:
            raise
        # Never derive from partially read layers: a world without its meshes has no walls.
        upload_bundle = upload_reader.read(
            upload_reader.unpack(load(), limits), hints, replace(knowing, wanted=None, cells=True), limits
        )
        written = _convert_layers(fmt, upload_bundle, datum, option_values, derived=derived)
    report = written.report.with_value_origin(dict.fromkeys(option_values, REQUEST))
    report = replace(report, warnings=(*upload_bundle.warnings, *report.warnings))
    return Converted(written.files, report, upload_bundle.warnings)


def _convert_layers(
    fmt: Format,
    upload_bundle: upload_reader.Bundle,
    datum: Datum | None,
    option_values: Mapping[str, Any],
    *,
    derived: bool,
) -> making.WrittenMap:
    credit = {key: upload_bundle.credit(key) for key in upload_bundle.parts}
    layers = upload_bundle.layers(datum)
    return making.from_layers(fmt, layers, option_values, derived=derived, origin=upload_bundle.origin, credit=credit)


def write_layers(layers: Layers, to: str, options: Mapping[str, str], came: Provenance) -> Converted:
    """Write layers in the target format and derive missing ones.

    options: options of the format, and parameters of the derivations. came: provenance of the layers, for the report.
    """
    fmt = formats.get_format(to)
    recipes.writer_options(fmt, options)
    entries = {key: PartEntry(key, "", 1, {}, came) for key in layers.parts}
    written_map = making.from_layers(fmt, layers, options, derived=True, entries=entries)
    report = written_map.report.with_value_origin(dict.fromkeys(options, REQUEST))
    return Converted(written_map.files, replace(report, dropped=report.dropped + unsupported_layers(fmt, None, layers)))


def offline_paths(
    paths: Mapping[str, Path],
    to: str,
    hints: UploadHints,
    datum: Datum | None,
    options: Mapping[str, str],
    limits: Limits,
) -> Converted:
    """Run ``offline`` on spooled files (in a worker)."""
    return _offline(
        lambda: {name: path.read_bytes() for name, path in paths.items()}, to, hints, datum, options, limits, True
    )
