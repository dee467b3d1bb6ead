"""Read a bundle of uploaded files into layers: detect formats, apply folder conventions, resolve conflicts.

Only files with the same content compete: ``X`` wins over ``X_autogen``, and of two files with the same network the
richer format wins; the others are stored as sources. No content read is discarded.
"""

from __future__ import annotations

import contextlib
import dataclasses
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import PurePosixPath

import numpy as np
import shapely

from app import formats
from app.errors import BadUpload, FleetMapError, Invalid, Problem, UnreadableFile
from app.formats import FileGroup, Files, Format, ReadContext
from app.formats.environment import content as exact_content
from app.limits import Limits
from app.model import masks
from app.model.features import Features, from_columns
from app.model.frame import GROUND, MAX_DATUM_LATITUDE, Datum, Level
from app.model.geodesy import local_frame
from app.model.layers import VECTOR_LAYERS, Layer, Layers, Part, PartKey, is_empty, join_levels
from app.model.names import did_you_mean
from app.syntax import archives, json, shell, xml, yaml
from app.upload_reader.bundle import Bundle as Bundle
from app.upload_reader.bundle import EnvironmentContext as EnvironmentContext
from app.upload_reader.bundle import FileUse, ParsedPart
from app.upload_reader.bundle import UploadHints as UploadHints
from app.upload_reader.conflicts import resolve_conflicts
from app.upload_reader.drawings import assign_layer

TEMPLATE_FOLDERS = ("location", "metric", "topological", "world")
"""Folders of an environment_template's ``config``, which determine the layer of a drawing."""

_FOLDER_LAYER: Mapping[str, Layer] = {"location": "location", "topological": "topology", "world": "objects"}

PACKAGE = "environment"
"""Format of a folder with maps of other formats (environment_template)."""

VARIABLES_FILES = ("properties.sh", "environment.sh")

_OF_FILES = re.compile(rf"^line \d+: ({'|'.join(sorted(shell.OF_FILES))}) is skipped: only a shell")

DRAWN_LAYERS: tuple[Layer, ...] = ("objects", "topology", "location", "zones")

_UNREPORTED_FILES = re.compile(r"(^|/)(\.|license|licence|copying|readme|notice|authors|changelog)", re.IGNORECASE)
_LICENCE = re.compile(r"(licen[cs]e|copying|notice|attribution|copyright)([-.].*)?", re.IGNORECASE)
_COPYRIGHT = re.compile(r"(copyright|©|\(c\)).*\d{4}", re.IGNORECASE)
_NOTICE_BYTES, _NOTICE_LINE = 2**14, 160
_JSON_ENDS, _YAML_ENDS = (".json", ".geojson"), (".yaml", ".yml")
_XML_ENDS = (".xml", ".osm", ".kml", ".sdf", ".world", ".gpx")


def parse_drawn_layer(name: str | None) -> Layer | None:
    """Check the layer requested for a drawing. Raises Invalid with the allowed layers."""
    for layer in DRAWN_LAYERS:
        if layer == name:
            return layer
    if name is None:
        return None
    problem = f"must be one of {', '.join(DRAWN_LAYERS)}, got {name[:80]!r}{did_you_mean(name, DRAWN_LAYERS)}"
    raise Invalid(f"layer {problem}", [Problem(problem, where="layer")])


def unpack(files: Files, limits: Limits) -> dict[str, bytes]:
    """Replace each ``.zip`` among the files by its members (a KMZ is a format, not a folder)."""
    out: dict[str, bytes] = {}
    left = limits.unpacked_bytes
    for name, data in files.items():
        members = {name: data}
        if name.lower().endswith(".zip") and data[:2] == b"PK":
            with _errors_in_file(name):
                members = archives.unpack(data, dataclasses.replace(limits, unpacked_bytes=left))
            left -= sum(map(len, members.values()))
        for member, content in members.items():
            if member in out:
                raise BadUpload(
                    f"duplicate file name {member} in the upload: use different names or folders",
                    [Problem("duplicate name", member)],
                )
            out[member] = content
    if len(out) > limits.files:
        raise BadUpload(f"too many files in the upload: {len(out)}, the limit is {limits.files}")
    return out


@contextlib.contextmanager
def _errors_in_file(name: str) -> Iterator[None]:
    """Add the file name to errors raised within the block."""
    try:
        yield
    except BadUpload as error:
        places = [dataclasses.replace(p, file=name) for p in error.problems] or [Problem(error.detail, name)]
        raise type(error)(f"{name}: {error.detail}", places) from error


def read(
    files: Files, hints: UploadHints, context: EnvironmentContext, limits: Limits, *, inner: bool = False
) -> Bundle:
    """Read all files of an upload (already unpacked). inner: they are from one file of it.

    Raises BadUpload with the location of every problem, Invalid for unusable hints.
    """
    parse_drawn_layer(hints.layer)
    if not files:
        raise Invalid("the upload has no file: send at least one as form field 'files'")
    bundle = Bundle(files={name: FileUse() for name in files}, inner=inner)
    if (content := exact_content.find(files)) is not None:
        if _read_exact_content(files, content, hints, limits, bundle):
            return bundle
        files = {name: data for name, data in files.items() if name not in exact_content.content_files(files, content)}
    if hints.format is not None and formats.get_format(hints.format).traits.is_container:
        # Any upload may be a folder of other formats' maps: detect each file's format by its content.
        template_files = [n for n in files if template_folder(n) or PurePosixPath(n).name in VARIABLES_FILES]
        if template_files:
            hints = dataclasses.replace(hints, format=None)
    variables = _read_variables(files, bundle)
    others = {n: d for n, d in files.items() if n not in variables}
    groups, rest = _group(others, hints) if any(others.values()) or not variables else ([], sorted(others))
    taken = _skip_superseded(groups, bundle)
    _check_options(groups, hints)
    parsed_parts: list[ParsedPart] = []
    problems: list[Problem] = []
    details: list[str] = []
    errors: list[type[BadUpload]] = []
    for group in sorted(taken, key=lambda g: (-g.format.claims.priority, g.main)):
        try:
            parsed_parts += _read_group(group, hints, context, limits, bundle)
        except BadUpload as error:
            problems += error.problems
            details.append(error.detail)
            errors.append(type(error))
    if errors:
        raise errors[0](details[0] if len(details) == 1 else "; ".join(details), problems)
    _report_unread_files({name: files[name] for name in rest}, bundle)
    resolve_conflicts(parsed_parts, bundle)
    if hints.format is None and not any(u.format for u in bundle.files.values()) and not variables:
        lacks = {name: text for name in sorted(files) if (text := _missing_metadata(name, files[name]))}
        known_formats = ", ".join(f.name for f in formats.all_formats().values() if f.read)
        detail = f"no file has a recognised map format: set format to one of {known_formats}"
        detail += "".join(f"; {name}: {text}" for name, text in list(lacks.items())[:1])
        problems = [
            Problem(lacks[n], n) if n in lacks else _unread_file_warnings(n, files[n], limits) for n in sorted(files)
        ]
        broken = next((p for p in problems if p.line is not None), None)
        detail += f"; {broken.file}, line {broken.line}: {broken.problem}" if broken else ""
        raise UnreadableFile(detail, problems)
    _choose_datum(bundle, context)
    return bundle


def _report_unread_files(files: Files, bundle: Bundle) -> None:
    """Collect the credits of files that no format reads, and warn about those that may be intended as maps."""
    bundle.notices = {name: text for name, data in files.items() if (text := _notice(name, data))}
    for name, data in files.items():
        if data and not _UNREPORTED_FILES.search(PurePosixPath(name).name):
            lacking = _missing_metadata(name, data)
            reason = "no format can read this file; it is stored as a source only"
            bundle.warnings.append(Problem(reason + (f" ({lacking})" if lacking else ""), name))


def _unread_files(files: Files) -> set[str]:
    """List the names of files that are neither a map nor belong to one."""
    others = {n: d for n, d in files.items() if d and PurePosixPath(n).name not in VARIABLES_FILES}
    empty = {n for n, d in files.items() if not d}
    return empty | set(formats.group(others)[1] if others else ())


def _read_exact_content(files: Files, main: str, hints: UploadHints, limits: Limits, bundle: Bundle) -> bool:
    """Read the exact layers that a package contains. Returns False, with a warning, if its maps are used instead."""
    if dataclasses.replace(hints, format=None) != UploadHints() or hints.format not in (None, PACKAGE):
        content: exact_content.Content | str = "the upload specifies how to read its maps"
    else:
        try:
            with _errors_in_file(main):
                content = exact_content.read(files, main, limits, lambda: _unread_files(files))
        except BadUpload:
            raise
        except (*formats.BAD_INPUT, FleetMapError, shapely.errors.ShapelyError) as error:
            reason = (
                f"the exact content beside the maps is damaged: {formats.describe_parse_error(error)[1]}; remove its "
                "folder to read the maps instead"
            )
            raise UnreadableFile(f"{main}: {reason}", [Problem(reason, main)]) from error
    if isinstance(content, str):
        for name in exact_content.content_files(files, main):
            bundle.files[name] = FileUse(PACKAGE, used=False)
        bundle.warnings.append(Problem(f"exact content ignored; the maps of the package are used: {content}", main))
        return False
    bundle.files |= {name: FileUse(PACKAGE, used=True) for name in files if name not in content.added}
    _report_unread_files({name: files[name] for name in sorted(content.added)}, bundle)
    bundle.parts, bundle.datum, bundle.levels = dict(content.layers.parts), content.layers.datum, content.layers.levels
    bundle.origin = dict.fromkeys(bundle.parts, ((main,), PACKAGE))
    bundle.credits = content.credits
    return True


def _unread_file_warnings(name: str, data: bytes, limits: Limits) -> Problem:
    """Explain why no format reads a file: with the line of the syntax error in a broken JSON, YAML or XML file."""
    end = PurePosixPath(name).suffix.lower()
    first = data.lstrip(b"\xef\xbb\xbf \t\r\n")[:1]
    try:
        if end in _JSON_ENDS or (first and first in b"{[" and end not in _YAML_ENDS):
            json.load(data, limits)
        elif end in _YAML_ENDS:
            yaml.load(data, limits)
        elif end in _XML_ENDS or first == b"<":
            xml.parse(data, limits)
    except BadUpload as error:
        problem = next(iter(error.problems), Problem(error.detail))
        return dataclasses.replace(problem, file=name)
    except formats.BAD_INPUT as error:
        line, reason = formats.describe_parse_error(error)
        return Problem(f"syntax error: {reason}", name, line)
    return Problem("no recognised map format", name)


def template_folder(name: str) -> tuple[str, ...] | None:
    """Return the path below ``config`` of an environment_template (``("metric", "map", "map.yaml")``), else None."""
    parts = PurePosixPath(name).parts
    for start, part in enumerate(parts[:-2]):
        if part == "config" and parts[start + 1] in TEMPLATE_FOLDERS:
            return parts[start + 1 :]
    return parts if len(parts) > 1 and parts[0] in TEMPLATE_FOLDERS else None


def corner(parts: Mapping[PartKey, Part]) -> Datum | None:
    """Return the south-west corner of the WGS 84 parts: of ``<bounds>`` if a file has them, else of the data."""
    stated = [b for p in parts.values() if isinstance(p, Features) and (b := p.document.get("bounds"))]
    if stated:
        boxes = np.array(stated, float)
    else:
        on_earth = [p.geometry[~p.local] for p in parts.values() if isinstance(p, Features) and p.needs_datum]
        if not on_earth:
            return None
        boxes = shapely.bounds(np.concatenate(on_earth))
        boxes = boxes[~np.isnan(boxes).any(axis=1)]
        if not len(boxes):
            return None
    west, south, east = boxes[:, 0].min(), boxes[:, 1].min(), boxes[:, 2].max()
    if east - west > 180.0:  # the data crosses the antimeridian: west is the smallest eastern longitude
        west = boxes[boxes[:, 0] > 0.0, 0].min()
    return Datum(float(np.clip(south, -MAX_DATUM_LATITUDE, MAX_DATUM_LATITUDE)), float(west))


def _notice(name: str, data: bytes) -> str | None:
    """Summarise a LICENSE, NOTICE or COPYING file in one line: title and copyright holder. None for other files."""
    if not _LICENCE.fullmatch(PurePosixPath(name).name) or not data:
        return None
    text = data[:_NOTICE_BYTES].decode("utf-8", "replace")
    lines = [" ".join(line.split()).strip("#*=- ")[:_NOTICE_LINE] for line in text.splitlines()]
    lines = ["".join(c for c in line if c.isprintable()) for line in lines if line]
    if not lines:
        return None
    title_lines = lines[:2] if len(lines) > 1 and re.match(r"version\b", lines[1], re.IGNORECASE) else lines[:1]
    holder = next((line for line in lines if _COPYRIGHT.match(line) and line not in title_lines), None)
    return f"{', '.join([*title_lines, *filter(None, [holder])])} ({name})"


def _group(files: Files, hints: UploadHints) -> tuple[list[FileGroup], list[str]]:
    present = {name: data for name, data in files.items() if data}
    if not present:
        raise UnreadableFile("all files are empty", [Problem("the file is empty", name) for name in sorted(files)])
    groups, rest = formats.group(present, hints.format)
    for fmt in formats.all_formats().values():
        if hints.format in (None, fmt.name) and fmt.claims.completing_options & hints.options.keys():
            completed = _complete_group(fmt, groups, rest, present, hints.options.get("file"))
            if completed is not None:
                groups = [*(g for g in groups if g.main not in completed.files), completed]
                rest = sorted(set(rest) - completed.files.keys())
    return groups, sorted({*rest, *(files.keys() - present.keys())})


def _complete_group(
    fmt: Format, groups: list[FileGroup], rest: list[str], files: Files, main_name: str | None
) -> FileGroup | None:
    """Find the file that is a map only together with the upload's options: an image with its position."""
    lone = {g.main for g in groups if g.format is fmt and fmt.claims.missing_metadata(g.main, g.files[g.main])}
    names = sorted(n for n in {*rest, *lone} if fmt.claims.missing_metadata(n, files[n]))
    if main_name is not None:
        names = [n for n in names if n == main_name or n.rpartition("/")[2] == main_name]
        if not names:
            raise Invalid(f"the upload has no file {main_name[:200]!r}", [Problem("unknown file", where="file")])
    if len(names) > 1:
        reason = (
            f"the options describe one image, but the upload has several: select one with file=…: {', '.join(names)}"
        )
        raise Invalid(reason, [Problem(reason, where="file")])
    if not names:
        return None
    main = names[0]
    others = [n for n in fmt.claims.companions(main, files[main], sorted(files)) if n in files]
    return FileGroup(fmt, main, {n: files[n] for n in [main, *others]})


def _missing_metadata(name: str, data: bytes) -> str:
    """Return the metadata that a file lacks to be a map, if a format recognises it; else an empty text."""
    if not data:
        return ""
    return next((text for f in formats.all_formats().values() if (text := f.claims.missing_metadata(name, data))), "")


def _read_variables(files: Files, bundle: Bundle) -> set[str]:
    """Read literal assignments of ``properties.sh`` and ``environment.sh``, without running them."""
    variables: dict[str, str] = {}
    names = sorted(n for n in files if PurePosixPath(n).name in VARIABLES_FILES and files[n])
    for name in names:
        with _errors_in_file(name):
            assigned, doubts = shell.assignments(files[name])
        variables.update({n: v for n, v in assigned.items() if v or n not in shell.OF_FILES})
        bundle.files[name] = FileUse(PACKAGE, used=True)
        # The export writes the paths of the package's files again: nothing is lost.
        bundle.warnings += [Problem(doubt, name) for doubt in doubts if not _OF_FILES.search(doubt)]
    if names:
        key = PartKey("objects", GROUND, PACKAGE)
        empty = from_columns([], np.empty(0, object), [], "local", {PACKAGE: {"variables": variables}})
        bundle.parts[key], bundle.origin[key] = empty, (tuple(names), PACKAGE)
    return set(names)


def _skip_superseded(groups: list[FileGroup], bundle: Bundle) -> list[FileGroup]:
    """Skip files that another file supersedes, without reading them.

    These are ``X_autogen`` beside ``X``, a drawn network beside a real one in ``topological/``, and a drawn fence
    beside a datum in ``location/``.
    """
    mains = {g.main: g for g in groups}
    leaders = _leaders(groups)
    out = []
    for group in groups:
        name = group.main
        reason = None
        folder = (template_folder(name) or ("",))[0]
        sibling = name.replace("_autogen", "", 1) if "_autogen" in PurePosixPath(name).name else None
        if sibling in mains and mains[sibling].format is group.format:
            reason = f"{sibling} takes precedence over the generated file"
        elif (
            (group.format.traits.is_drawing or group.format.claims.gives_way)
            and folder == "topological"
            and not _is_regions(name)
        ):
            if folder in leaders:
                reason = f"the network comes from the richer {leaders[folder]} file"
        elif (
            group.format.traits.is_drawing
            and folder == "location"
            and PurePosixPath(name).name.startswith("fence_autogen.")
            and folder in leaders
        ):
            reason = f"the fence comes from the {leaders[folder]} file"
        if reason is None:
            out.append(group)
            continue
        for file in group.files:
            bundle.files[file] = FileUse(group.format.name, used=False)
        bundle.warnings.append(Problem(f"ignored, stored as a source only: {reason}", name))
    return out


def _leaders(groups: list[FileGroup]) -> dict[str, str]:
    """Return by folder of an environment_template the format that takes precedence there, if such a file exists."""
    out: dict[str, str] = {}
    for group in sorted(groups, key=lambda g: -g.format.claims.priority):
        folder = (template_folder(group.main) or ("",))[0]
        if folder and group.format.claims.leads_folder == folder:
            out.setdefault(folder, group.format.name)
    return out


def _applicable_options(group: FileGroup, hints: UploadHints) -> dict[str, str]:
    names = {f.name for f in dataclasses.fields(group.format.read_options)}
    return {name: value for name, value in hints.options.items() if name in names}


def _check_options(groups: list[FileGroup], hints: UploadHints) -> None:
    """Raise Invalid for an option that no format of the upload has."""
    option_names = {f.name for g in groups for f in dataclasses.fields(g.format.read_options)}
    for name in hints.options:
        if name not in option_names:
            accepted = ", ".join(sorted(option_names)) or "none"
            detail = f"no format of this upload has the option {name[:80]!r}; accepted: {accepted}"
            raise Invalid(detail, [Problem(f"unknown option; accepted: {accepted}", where=name)])


def _is_regions(name: str) -> bool:
    return "region" in PurePosixPath(name).name.lower()


def _check_grid_names(layers: Layers, file: str) -> None:
    """Raise UnreadableFile for a grid whose YAML file would have the name of a mask's parameter file."""
    for name in (key.name for key in layers.grids() if key.name.endswith(masks.INFO_SUFFIX)):
        reason = f"the grid {name[:80]!r} is named like the parameters of a mask: give it another name with grid=…"
        raise UnreadableFile(f"{file}: {reason}", [Problem(reason, file)])


def _read_group(
    group: FileGroup, hints: UploadHints, upload_context: EnvironmentContext, limits: Limits, bundle: Bundle
) -> list[ParsedPart]:
    folder = template_folder(group.main)
    layer = hints.layer
    grid = hints.grid
    if folder and layer is None and not (folder[0] == "topological" and _is_regions(group.main)):
        layer = _FOLDER_LAYER.get(folder[0])
    if folder and grid is None and folder[0] == "metric" and len(folder) > 2:
        siblings = [n for n, u in bundle.files.items() if n.rpartition("/")[0] == group.main.rpartition("/")[0]]
        yamls = sorted(n for n in siblings if n.endswith((".yaml", ".yml")) and "_autogen" not in n)
        grid = folder[1] if group.main in yamls[:1] or not yamls else None
    context = ReadContext(
        limits=limits,
        frame=None if upload_context.datum is None else local_frame(upload_context.datum),
        level=hints.level,
        grid=grid,
        layer=layer,
        options=formats.read_options(group.format, _applicable_options(group, hints)),
        requested_layers=_requested_layers(group.format, upload_context.wanted),
        decode_cells=upload_context.cells,
        keep_source_properties=upload_context.whole,
        folder=_folder_reader(hints, upload_context, limits, bundle),
    )
    layers = formats.read(group, context)
    _check_grid_names(layers, group.main)
    for file in group.files:
        bundle.files[file] = FileUse(group.format.name, used=True)
    bundle.warnings += context.warnings
    for site in layers.vector("location").values():
        bundle.fence = bundle.fence or (site.geometry[0] if len(site) else None)
    parts = dict(layers.parts)
    if group.format.traits.is_drawing and layer not in (None, "objects"):
        parts = assign_layer(parts, layer, hints.level, upload_context, layers.datum, group.main, bundle)
    if layers.datum is not None:
        if bundle.datum is None:
            bundle.datum = layers.datum
        elif bundle.datum != layers.datum:
            bundle.warnings.append(Problem("its datum differs from that of another file; it is ignored", group.main))
    bundle.levels = join_levels(bundle.levels, [lv for lv in layers.levels if lv != Level()])
    return [ParsedPart(key, part, group) for key, part in parts.items() if not is_empty(part)]


def _requested_layers(fmt: Format, wanted: frozenset[Layer] | None) -> frozenset[Layer] | None:
    """Return the layers to read: of a drawing all features, which may be meant for another layer."""
    return wanted | VECTOR_LAYERS if wanted is not None and fmt.traits.is_drawing else wanted


def _folder_reader(
    hints: UploadHints, context: EnvironmentContext, limits: Limits, bundle: Bundle
) -> Callable[[Files], Layers] | None:
    """Return a reader for a folder inside one file of the upload (an archive other than ``.zip``), one level deep."""
    if bundle.inner:
        return None

    def read_folder(files: Files) -> Layers:
        inner = read(files, dataclasses.replace(hints, format=None), context, limits, inner=True)
        bundle.warnings += inner.warnings
        return inner.layers(None)

    return read_folder


def _choose_datum(bundle: Bundle, context: EnvironmentContext) -> None:
    if bundle.datum is not None or context.datum is not None:
        return
    chosen = corner(bundle.parts)
    if chosen is not None:
        bundle.datum = chosen
        reason = (
            f"the environment has no datum; the south-west corner of the data (latitude {chosen.latitude!r}, longitude "
            f"{chosen.longitude!r}) is used. Upload a datum.yaml or PATCH the environment to set another"
        )
        bundle.warnings.append(Problem(reason))
        if abs(chosen.latitude) == MAX_DATUM_LATITUDE:
            reason = (
                f"the data extends beyond the datum limit of {chosen.latitude:g} degrees latitude; metres far from the "
                "datum are inexact. Use local metres near the poles"
            )
            bundle.warnings.append(Problem(reason))
