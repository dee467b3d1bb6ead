"""Registry of formats, and the read boundary with its limits.

A format is one module of this package that ends in ``register(Format(...))``; nothing else is edited. A large format
is a package, and so is a family: it imports its formats' modules. Modules whose name starts with ``_`` are helpers
shared by readers. Formats convert between named bytes and layers: they use no paths and no network.
"""

from __future__ import annotations

import contextlib
import gc
import re
import struct
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from typing import Any

import yaml
from lxml import etree

from app import parameters, plugins
from app.errors import BadUpload, FleetMapError, Invalid, NotFound, Problem, TooLarge, UnreadableFile
from app.formats._format import (
    ANY_FEATURES,
    UNTITLED,
    Bends,
    Claims,
    Files,
    Format,
    LayerRequirements,
    NestedMap,
    NoOptions,
    Parts,
    ReadContext,
    Selection,
    Traits,
    WriteContext,
    one_map_per_folder,
)
from app.model import bends
from app.model.features import Features
from app.model.layers import Layers
from app.model.names import did_you_mean

__all__ = [  # the public interface; see docs/contributing/plug-ins.md
    "ANY_FEATURES",
    "BAD_INPUT",
    "UNTITLED",
    "Bends",
    "Claims",
    "Files",
    "Format",
    "LayerRequirements",
    "NestedMap",
    "NoOptions",
    "Parts",
    "ReadContext",
    "Selection",
    "Traits",
    "WriteContext",
    "one_map_per_folder",
    "register",
]


@dataclass(frozen=True, slots=True)
class FileGroup:
    """Files of an upload that form one map: a main file and its companions.

    shared_files: files of other maps that the reader may read.
    """

    format: Format
    main: str
    files: Files
    shared_files: Files = field(default_factory=dict)


_registry = plugins.Registry[Format](__name__, "format", "fleetmap.formats")


def register(new: Format) -> Format:
    """Register a format. The last statement of its module."""
    _registry.add(new.name, new)
    return new


def all_formats() -> dict[str, Format]:
    """Return every format by name, in alphabetical order."""
    return _registry.all()


def writable_formats() -> frozenset[str]:
    """Return the ids of the formats that are read and written: a file of one can be made again from its layers."""
    return frozenset(name for name, fmt in all_formats().items() if fmt.read is not None and fmt.write is not None)


def get_format(name: str) -> Format:
    """Return the format of this name. Raises NotFound, which lists the known formats."""
    formats = all_formats()
    if name not in formats:
        raise NotFound(f"unknown format {name!r:.80}{did_you_mean(name, formats)}; available: {', '.join(formats)}")
    return formats[name]


def detect(name: str, data: bytes) -> Format | None:
    """Return the format whose main file this is, judged by content; the highest priority wins."""
    readable = sorted((f for f in all_formats().values() if f.read), key=lambda f: (-f.claims.priority, f.name))
    return next((f for f in readable if f.detect(name, data)), None)


_APPLE_DOUBLE = b"\x00\x05\x16\x07"
"""First bytes of AppleDouble files, which macOS adds to archives as ``._<file>``."""


def group(files: Files, format_name: str | None = None) -> tuple[list[FileGroup], list[str]]:
    """Group an upload's files into maps; return the groups and the names that belong to none.

    With a format name, every file that the format detects is a main file. If it detects none, a single file is read
    anyway, so that the reader can report what is wrong with it.
    """
    groups, used = [], set()
    forced_format = get_format(format_name) if format_name else None
    for name in sorted(files):
        if files[name].startswith(_APPLE_DOUBLE):
            continue
        fmt = forced_format if forced_format and forced_format.detect(name, files[name]) else None
        fmt = fmt or (None if forced_format else detect(name, files[name]))
        if fmt:
            groups.append((fmt, name))
    if forced_format and not groups:
        if forced_format.read is None:
            raise Invalid(f"{forced_format.name} can be exported but not read")
        main = next((n for n in sorted(files) if n.lower().endswith(forced_format.extensions)), None)
        groups = [(forced_format, main or next(iter(sorted(files))))]
    groups, belong = _sort_files(files, groups)
    out = []
    mains = {main for _, main in groups}
    names = tuple(sorted(files))
    speaking = tuple(sorted(main for fmt, main in groups if fmt.claims.is_sidecar(main)))
    yielding = {
        other
        for fmt, main in groups
        if speaking and not fmt.claims.is_sidecar(main)
        for other in fmt.claims.companions(main, files[main], speaking)
        if other in speaking
    }
    groups = [(fmt, main) for fmt, main in groups if main not in yielding]
    mains -= yielding
    for fmt, main in groups:
        more = belong[main] if main in belong else fmt.claims.companions(main, files[main], names)
        companions = [n for n in more if n in files and n not in mains]
        used.update([main, *companions])
        own_files = {n: files[n] for n in [main, *companions]}
        seen = {n: files[n] for n in fmt.claims.related_files(main, names) if n in files and n not in own_files}
        out.append(FileGroup(fmt, main, own_files, seen))
    return out, sorted(set(files) - used)


def _sort_files(
    files: Files, groups: Sequence[tuple[Format, str]]
) -> tuple[list[tuple[Format, str]], dict[str, Iterable[str]]]:
    """Select the main files that remain, with the companions of formats that inspect the files."""
    belong: dict[str, Iterable[str]] = {}
    for fmt in dict.fromkeys(fmt for fmt, _ in groups):
        if fmt.claims.sort is not None:
            belong |= {m: list(o) for m, o in fmt.claims.sort(files, [m for k, m in groups if k is fmt]).items()}
    claimed = {name for companions in belong.values() for name in companions}
    remaining = [(k, m) for k, m in groups if (m in belong if k.claims.sort is not None else m not in claimed)]
    return remaining, belong


BAD_INPUT = (
    ValueError,
    TypeError,
    LookupError,
    AttributeError,
    ArithmeticError,
    RecursionError,
    UnicodeError,
    EOFError,
    OSError,
    SyntaxError,
    struct.error,
    zlib.error,
    zipfile.BadZipFile,
    NotImplementedError,
    yaml.YAMLError,
    etree.LxmlError,
)
"""Exceptions that readers raise on invalid input; any other exception is a bug and is not converted."""


def read(item: FileGroup, context: ReadContext) -> Layers:
    """Read one map's files into layers; any error in the bytes becomes a BadUpload.

    Raises UnreadableFile (with file, line and reason), TooLarge or UnsafeArchive.
    """
    fmt = item.format
    if fmt.read is None:
        raise Invalid(f"{fmt.name} can be exported but not read")
    context.main = item.main
    if context.options is None:
        context.options = fmt.read_options()
    earlier = len(context.warnings)
    try:
        with _gc_paused():
            layers = fmt.read({**item.files, **item.shared_files} if item.shared_files else item.files, context)
    except BadUpload as error:
        raise type(error)(
            error.detail, [_with_file(p, context.main) for p in error.problems] or [Problem(error.detail, context.main)]
        ) from error
    except FleetMapError as error:
        raise UnreadableFile(
            f"{context.main}: {error.detail}",
            [_with_file(p, context.main) for p in error.problems] or [Problem(error.detail, context.main)],
        ) from error
    except MemoryError as error:
        raise TooLarge(
            f"{context.main} needs more memory than an upload may use", [Problem("out of memory", context.main)]
        ) from error
    except BAD_INPUT as error:
        line, reason = describe_parse_error(error)
        detail = f"{context.main} cannot be read as {fmt.title}: {reason}"
        raise UnreadableFile(detail, [Problem(reason, context.main, line)]) from error
    if fmt.traits.keeps_bends == "nodes":
        layers = bends.join(layers)
    count = sum(len(p) for p in layers.parts.values() if isinstance(p, Features))
    if count > context.limits.features:
        raise TooLarge(f"{item.main} has {count} features; the limit is {context.limits.features}")
    context.warnings[earlier:] = group_warnings(context.warnings[earlier:], context.limits.warnings)
    return layers


def group_warnings(warnings: Sequence[Problem], limit: int) -> list[Problem]:
    """Merge repeated warnings of one file: the first of its kind, the number of others, and examples.

    Two warnings are of one kind if they differ only in names and numbers. Kinds with up to ``MAX_ALIKE_WARNINGS``
    warnings are not merged.
    """
    kinds: dict[tuple[str | None, str], list[Problem]] = {}
    for one in dict.fromkeys(warnings):
        kinds.setdefault((one.file, _VARIABLE.sub("…", one.problem)), []).append(one)
    out: list[Problem] = []
    for same in kinds.values():
        if len(same) <= MAX_ALIKE_WARNINGS:
            out += same
            continue
        examples = "; ".join(dict.fromkeys(one.where or one.problem for one in same[1:MAX_ALIKE_WARNINGS]))[:240]
        reason = f"{same[0].problem} (and {len(same) - 1} more like it: {examples})"
        out.append(replace(same[0], problem=reason))
    if len(out) > limit:
        reason = f"and {len(out) - limit} more warnings"
        out[limit:] = [Problem(reason, out[-1].file)]
    return out


MAX_ALIKE_WARNINGS = 3
"""Maximum number of warnings of one kind that are reported one by one."""

_VARIABLE = re.compile(r"""'[^']*'|"[^"]*"|\w+://\S+|\S*\d\S*|(?<=edge )\S+|^\S+(?= is not in the upload)""")


def write(fmt: Format, layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """Write layers as one map's files, main file first."""
    if fmt.write is None:
        raise Invalid(f"{fmt.name} can be read but not exported")
    if context.options is None:
        context.options = fmt.write_options()
    layers = _straighten(fmt, layers, context)
    with _gc_paused():
        files = fmt.write(layers, context)
    token = JUST_WRITTEN.set(True)
    try:
        context.warnings = _merge_findings(context.warnings, check(fmt, files))
    finally:
        JUST_WRITTEN.reset(token)
    return files


def _straighten(fmt: Format, layers: Layers, context: WriteContext) -> Layers:
    """Straighten edges for formats whose consumers drive straight from node to node, and report the new nodes."""
    straight, split = straighten(fmt, layers)
    if split.nodes:
        edges = "1 edge bends" if split.edges == 1 else f"{split.edges} edges bend"
        context.fill("nodes at bends", split.nodes, f"{edges}, and in {fmt.name} edges are straight")
    return straight


def straighten(fmt: Format, layers: Layers) -> tuple[Layers, bends.Split]:
    """Split edges at bends if the format's consumers ignore shapes; otherwise return the layers unchanged."""
    if fmt.traits.keeps_bends == "shape":
        return layers, bends.Split()
    return bends.split(layers, fmt.name if fmt.traits.keeps_bends == "foreign" else None)


MAX_FINDINGS = 50
"""Maximum number of findings per level that a check lists; further ones are counted."""

JUST_WRITTEN: ContextVar[bool] = ContextVar("SERVED", default=False)
"""Whether the checked map was just written by this server; then only the start of a large text is checked."""


def check(fmt: Format, files: Files) -> list[Problem]:
    """Check a map against its consumers' loader rules; return errors first, then warnings.

    An ``error`` means that a consumer rejects the map, a ``warning`` that it may misinterpret it.

    files: the map's files, main file first. This runs on each exported map, where it may take a few milliseconds
    (``_rules.is_brief``). A format's ``check`` yields problems from its loader's rules and may raise parse errors,
    which are reported as errors too.
    """
    if fmt.check is None or not files:
        return []
    main = next(iter(files))
    findings: dict[str, list[Problem]] = {"error": [], "warning": []}
    more = {"error": 0, "warning": 0}
    seen: set[tuple[str | None, str | None, str]] = set()
    with _gc_paused():
        every = list(_findings(fmt, files, main))
    for one in every:
        problem = replace(one, file=one.file or main, level=one.level or "error")
        finding_key = (problem.file, problem.where, problem.problem)
        if finding_key in seen:
            continue
        if len(findings[str(problem.level)]) < MAX_FINDINGS:
            seen.add(finding_key)
            findings[str(problem.level)].append(problem)
        else:
            more[str(problem.level)] += 1
    for level, problems in findings.items():
        if more[level]:
            reason = f"and {more[level]} more findings of this level"
            problems.append(replace(problems[-1], problem=reason, line=None, where=None))
    return findings["error"] + findings["warning"]


def _findings(fmt: Format, files: Files, main: str) -> Iterator[Problem]:
    assert fmt.check is not None
    try:
        yield from fmt.check(files)
    except FleetMapError as error:
        yield from [replace(p, level="error") for p in error.problems] or [Problem(error.detail, main, level="error")]
    except BAD_INPUT as error:
        line, reason = describe_parse_error(error)
        yield Problem(f"cannot be read as {fmt.title}: {reason}", main, line, level="error")


def _merge_findings(warnings: Sequence[Problem], findings: Iterable[Problem]) -> list[Problem]:
    """Merge a writer's warnings with a check's findings.

    Of two about one location the writer's text is kept, at its level.
    """
    places: dict[tuple[str | None, str | None], int] = {(p.file, p.where): k for k, p in enumerate(warnings) if p.where}
    texts = {p.problem for p in warnings}
    out = list(warnings)
    for one in findings:
        k = places.get((one.file, one.where))
        if k is not None:
            out[k] = replace(out[k], level="error" if "error" in (one.level, out[k].level) else "warning")
        elif one.problem not in texts:
            out.append(one)
    return out


@contextlib.contextmanager
def _gc_paused() -> Iterator[None]:
    """Pause garbage collection: it would repeatedly scan the many values that readers build.

    That took a quarter of the time of a large file.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def write_options(fmt: Format, values: Mapping[str, str]) -> Any:
    """Parse the format's write options from texts. Raises Invalid, which lists the accepted ones."""
    return parameters.parse(fmt.write_options, values, f"parameter of {fmt.name}")


def read_options(fmt: Format, values: Mapping[str, str]) -> Any:
    """Parse the format's read options from texts. Raises Invalid, which lists the accepted ones."""
    return parameters.parse(fmt.read_options, values, f"option of {fmt.name}")


def _with_file(problem: Problem, file: str) -> Problem:
    return problem if problem.file else Problem(problem.problem, file, problem.line, problem.where)


def describe_parse_error(error: BaseException) -> tuple[int | None, str]:
    """Return the line (from 1, None if the parser reports none) and a readable reason."""
    if isinstance(error, yaml.MarkedYAMLError):
        mark = error.problem_mark or error.context_mark
        return (mark.line + 1 if mark else None), " ".join(filter(None, [error.context, error.problem])) or "not YAML"
    if isinstance(error, SyntaxError):  # lxml's XMLSyntaxError is one, and Pillow raises it for broken PNG chunks
        return error.lineno, error.msg or "syntax error"
    if isinstance(error, RecursionError):
        return None, "nested too deeply"
    if isinstance(error, KeyError):
        return None, f"{error.args[0]!r} is missing" if error.args else "a key is missing"
    if isinstance(error, UnicodeError):
        return None, f"not UTF-8 text ({error})"
    return None, str(error) or type(error).__name__
