"""The pages of ``docs/reference`` that the code declares: an MkDocs hook.

``<!-- reference: NAME -->`` in a page is replaced by what ``BLOCKS[NAME]`` makes, and each format gets its own page. So
a page holds only what the code cannot say, and what the code says stands nowhere else.
"""

from __future__ import annotations

import dataclasses
import html
import importlib
import inspect
import itertools
import json
import re
import sys
import tempfile
import types
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import architecture
import declared
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from prometheus_client.metrics import MetricWrapperBase
from pydantic import SecretStr
from typer.main import get_command

from app import derive, generate
from app.api.http import problems
from app.api.http.auth import RequireRole
from app.api.http.metrics import (
    Metrics,
    QueueCollector,
    _Backups,
    _HeadVersionCollector,
    _Leaders,
    _Scrubs,
    _Webhooks,
)
from app.api.http.mirror_metrics import MirrorCollector
from app.api.http.operation_metrics import GAUGES
from app.api.http.responses import API
from app.backends.documents import FileDocument
from app.backends.lead import LocalLeads
from app.backends.queue import QueueFigures
from app.cli import commands
from app.config import Settings
from app.derive import Derivation
from app.errors import FleetMapError
from app.event_types import EVENT_TYPES, describe
from app.formats import Format, all_formats
from app.generate import Generator
from app.main import create_app
from app.setting_values import format_size
from app.store import encode, tree
from app.store.backups import Backups

FORMATS = "reference/formats"
LIMITS = ("ge", "gt", "le")
"""What pydantic calls bounds."""

MARKER = re.compile(r"^<!-- reference: ([a-z-]+) -->$", re.MULTILINE)
METHODS = ("get", "post", "put", "patch", "delete")
EVERYWHERE = {"400", "401", "403", "408", "413", "415", "422", "429", "503", "507"}
"""Statuses that most calls share: ``docs/reference/errors.md`` explains them once."""


# --- MkDocs ----------------------------------------------------------------------------------------------------------
def on_config(config: MkDocsConfig) -> None:
    """Add the formats' pages to the navigation, below the page that lists them."""
    pages = [{name: f"{FORMATS}/{name}.md"} for name in all_formats()]
    _extend(config.nav or [], pages)


def on_files(files: Files, *, config: MkDocsConfig) -> None:
    """Add the formats' pages, and the picture of the packages."""
    for fmt in all_formats().values():
        files.append(File.generated(config, f"{FORMATS}/{fmt.name}.md", content=format_page(fmt)))
    files.append(File.generated(config, "images/architecture.svg", content=architecture.svg()))


def on_page_markdown(markdown: str, *, page: Page, **_: Any) -> str:
    """Fill in what the code declares."""

    def fill(match: re.Match[str]) -> str:
        if match[1] not in BLOCKS:
            raise PluginError(f"{page.file.src_uri}: there is no generated block {match[1]!r}: {', '.join(BLOCKS)}")
        return BLOCKS[match[1]]()

    return MARKER.sub(fill, markdown)


def _extend(nav: list[Any], pages: Sequence[Mapping[str, str]]) -> None:
    for item in nav:
        for section in item.values() if isinstance(item, dict) else ():
            if isinstance(section, list):
                _extend(section, pages)
                if f"{FORMATS}.md" in section:
                    section.extend(pages)


# --- Markdown --------------------------------------------------------------------------------------------------------
def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table; a column that is empty in all rows is left out, and so is a table without rows."""
    every = [list(row) for row in rows]
    kept = [k for k in range(len(head)) if any(row[k] for row in every)]
    lines = [[head[k] for k in kept], ["---"] * len(kept), *([_cell(row[k]) for k in kept] for row in every)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n" if every else ""


def _cell(text: str) -> str:
    return " ".join(re.sub(r"\n+ *- ", "<br>", text).replace("|", "\\|").split())


def code(value: object) -> str:
    """A value as code."""
    return f"`{value}`"


def codes(values: Iterable[object]) -> str:
    """Values as code, separated by commas."""
    return ", ".join(map(code, values))


def plain(text: str) -> str:
    """A text of the code's as Markdown: what stands in backticks is code, nothing else is markup."""
    pieces = re.split(r"(``.+?``|`[^`\n]+`)", text, flags=re.DOTALL)
    return "".join(p if k % 2 else html.escape(p, quote=False).replace("*", "\\*") for k, p in enumerate(pieces))


def prose(docstring: str) -> str:
    """A docstring as Markdown: paragraphs, lists, ``**bold**`` words, and terms with their indented descriptions."""
    out = []
    for block in re.split(r"\n\s*\n", inspect.cleandoc(docstring)):
        listed = re.sub(r"(?m)^(``.*)$\n((?:^    .*$\n?)+)", _definition, block + "\n")
        out.append(plain(listed).replace("\\*\\*", "**"))
    return re.sub(r"(?m)^\\\* ", "* ", "\n\n".join(out)) + "\n"


def _definition(match: re.Match[str]) -> str:
    return f"* {match[1]}: {' '.join(match[2].split())}\n"


def sentence(text: str) -> str:
    """A text that begins with a capital letter and ends with a full stop."""
    text = text.strip()
    first = re.match(r"[a-z]+(?=[ ,;]|$)", text)  # a name such as recovery_behaviours_config stays as it is
    text = text[0].upper() + text[1:] if first else text
    return text + ("" if not text or text.endswith((".", "!", "?", ":")) else ".")


# --- parameters ------------------------------------------------------------------------------------------------------
def parameters(cls: type[Any], *, head: str = "parameter") -> str:
    """The parameters that a dataclass declares: type, default, bounds, unit, meaning."""
    hints = get_type_hints(cls)
    rows = []
    for field in dataclasses.fields(cls):
        metadata = field.metadata
        rows.append(
            (
                code(field.name),
                kind_of(hints[field.name]),
                "" if field.default is None else code(_text(field.default)),
                bounds(metadata.get("minimum"), metadata.get("maximum")),
                metadata.get("unit", ""),
                sentence(plain(metadata.get("doc", ""))),
            )
        )
    return table((head, "type", "default", "bounds", "unit", "meaning"), rows)


def kind_of(hint: Any) -> str:
    """A type as users know it."""
    origin, args = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return kind_of(next(a for a in args if a is not type(None)))
    if origin is Literal:
        return codes(args)
    if origin is tuple:
        return f"{kind_of(args[0])}s, comma-separated" if args[1:2] == (...,) else f"{len(args)} {kind_of(args[0])}s"
    names = {bool: "truth value", int: "integer", float: "number", str: "text", Path: "path", SecretStr: "secret text"}
    return names[hint]


def bounds(low: float | None, high: float | None, *, above: float | None = None) -> str:
    """Bounds as a range."""
    ends = [None if end is None else str(int(end)) if end == int(end) else f"{end:g}" for end in (low, above, high)]
    start = f"above {ends[1]}" if ends[1] else ends[0]
    if start and ends[2]:
        return f"{start}{',' if ends[1] else ''} to {ends[2]}"
    return start if ends[1] else f"from {start}" if start else f"up to {ends[2]}" if ends[2] else ""


def _text(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return ",".join(map(_text, value))
    return f"{value:g}" if isinstance(value, float) else str(value) if value != "" else '""'


# --- formats ---------------------------------------------------------------------------------------------------------
ANCHORS = {"local": "metres of the local frame", "wgs84": "degrees (WGS 84)"}
BENDS = {
    "nodes": "Edges are straight: a bend of more than 5 cm becomes a node, and a bend again when the file is uploaded.",
    "foreign": "The consumer ignores the shape of edges: bends of edges from other formats become nodes.",
}


def formats_table() -> str:
    """All formats: what they hold, and whether they are read and written."""
    return table(
        ("id", "what it is", "read", "write", "layers"),
        (
            (
                f"[`{f.name}`](formats/{f.name}.md)",
                plain(f.title),
                "yes" if f.read else "no",
                "yes" if f.write else "no",
                ", ".join(sorted(f.layers)),
            )
            for f in all_formats().values()
        ),
    )


def format_page(fmt: Format) -> str:
    """The page of one format."""
    module = _module(fmt)
    doc = re.sub(rf"\A{fmt.name}(\.yaml)?: (?=(.))", "", inspect.getdoc(module) or fmt.title)
    text, further = _helpers(doc[0].upper() + doc[1:])
    out = [f"# {fmt.name}: {plain(fmt.title)}\n", prose(text), _facts(fmt)]
    if fmt.read and dataclasses.fields(fmt.read_options):
        out += ["## Parameters of an upload\n", parameters(fmt.read_options)]
    if fmt.write and dataclasses.fields(fmt.write_options):
        out += [
            "## Parameters of a map\n",
            f"In the URL of a map, `/maps/{{environment}}/{fmt.name}?NAME=VALUE`, or as `-O NAME=VALUE` of "
            "`fleetmap export`. Parameters of a [derivation](../derivations.md) are set in the same way.\n",
            parameters(fmt.write_options),
        ]
    for name, doc in further:
        out += [f"## {name}\n", prose(doc)]
    if fmt.write:
        out += _losses(fmt)
    if fmt.check:
        out += _rules(fmt)
    return "\n".join(out)


def _module(fmt: Format) -> types.ModuleType:
    """The module that is the format's: by its name, in the package of its family or in ``app.formats``."""
    module = fmt.detect.__module__
    family = ".".join(module.split(".")[:3])
    names = (f"{family}.{fmt.name}", f"app.formats.{fmt.name}", module)
    return next(sys.modules[name] for name in names if name in sys.modules)


def _helpers(doc: str) -> tuple[str, list[tuple[str, str]]]:
    """The docstring with links in place of the names of shared modules, and the docstrings of these."""
    further: dict[str, str] = {}

    def link(match: re.Match[str]) -> str:
        try:
            module = importlib.import_module(f"app.formats.{match[1]}")
        except ModuleNotFoundError:
            return match[0]
        name = match[1].rpartition(".")[2].lstrip("_")
        further[name] = inspect.getdoc(module) or ""
        return f"[{name}](#{name})"

    pattern = re.compile(r"``(?:app\.formats\.)?(_[a-z0-9_]+|[a-z0-9_]+\.[a-z0-9_]+)``")
    text = pattern.sub(link, doc)
    return text, list(further.items())


def _facts(fmt: Format) -> str:
    needs, parts = fmt.needs, fmt.selection.parts
    wants = " or ".join(" and ".join(sorted(layers)) for layers in needs.one_of if layers)
    rows = [
        ("Files", codes(fmt.files)),
        ("Media types", codes(dict.fromkeys(fmt.files.values()))),
        ("Uploads end in", codes(fmt.extensions)),
        ("Layers", ", ".join(sorted(fmt.layers)) + (" (only the position of a grid)" if fmt.traits.outlines else "")),
        ("A map needs", wants + (", and a datum" if needs.datum else "")),
        ("A map also uses", ", ".join(sorted(needs.also))),
        ("Coordinates", ANCHORS.get(needs.anchor or "", "")),
        ("Bends of edges", BENDS.get(fmt.traits.keeps_bends, "")),
        ("Blocked edges", "stay in a map, with a mark" if fmt.traits.marks_blocked else ""),
        (
            "Parts",
            f"one at a time, by `{parts.level}` and `{parts.name}`; `*` selects all" if parts else "",
        ),
        ("Direction", "read only" if fmt.write is None else "written only" if fmt.read is None else ""),
    ]
    return "## Facts\n\n" + table(("fact", "value"), [row for row in rows if row[1]])


def _losses(fmt: Format) -> list[str]:
    assert fmt.write is not None
    drops, fills = declared.drops(fmt.write), declared.fills(fmt.write)
    out = []
    if drops:
        out += [
            "## What a map drops\n",
            "The report of each map lists the data dropped from it, with counts, under `dropped`.\n",
            table(("what", "why"), ((plain(item), plain(why)) for item, why in drops)),
        ]
    if fills:
        out += [
            "## What a map fills in\n",
            "The report lists these values under `template`. Change them by parameter or environment template.\n",
            table(("what", "why", "parameter"), ((plain(w), plain(y), code(o) if o else "") for w, y, o in fills)),
        ]
    return out


def _rules(fmt: Format) -> list[str]:
    assert fmt.check is not None
    module = sys.modules[fmt.check.__module__]
    levels = {"error": "refused", "warning": "doubtful"}
    rows = [(levels[n], code(at) if at else "", plain(text)) for n, at, text in declared.findings(fmt.check)]
    return [
        "## Rules of its consumers\n",
        prose(inspect.getdoc(module) or ""),
        "`fleetmap check` and the report of each map list broken rules. *Refused*: a consumer does not load the "
        "map, or misreads it (`level: error`). *Doubtful*: it loads the map, but may not use it as "
        "intended (`level: warning`).\n",
        table(("level", "where", "finding"), rows),
    ]


# --- derivations and generators --------------------------------------------------------------------------------------
def derivations() -> str:
    """All derivations, with their parameters."""
    out = []
    for one in derive.all_derivations().values():
        out += [f"## {one.name}\n", _about(one), _layers(one), parameters(one.parameters)]
    return "\n".join(out)


def _layers(one: Derivation) -> str:
    rows = [
        ("needs", ", ".join(sorted(one.needs))),
        ("also uses", ", ".join(sorted(one.also))),
        ("gives", one.gives + (f" ({', '.join(sorted(one.part_names))})" if one.part_names else "")),
        ("cost", f"{one.cost:g}"),
        ("further derivations", "none: its result is used for maps only" if one.is_terminal else ""),
    ]
    return table(("", ""), [row for row in rows if row[1]])


def generators() -> str:
    """All generators, with their parameters."""
    out = []
    for one in generate.all_generators().values():
        rows = [
            ("needs", ", ".join(sorted(one.needs))),
            ("changes", ", ".join(sorted(one.changes))),
            ("also uses", ", ".join(sorted(one.also))),
            ("gives", ", ".join(sorted(one.gives))),
        ]
        facts = table(("", ""), [row for row in rows if row[1]])
        out += [f"## {one.name}\n", _about(one), facts, parameters(one.parameters)]
    return "\n".join(out)


def _about(one: Derivation | Generator) -> str:
    """What its function and its module say."""
    module = prose(inspect.getdoc(sys.modules[one.function.__module__]) or "")
    return f"{prose(inspect.getdoc(one.function) or one.title)}\n{module}"


# --- settings, metrics, errors ---------------------------------------------------------------------------------------
def settings() -> str:
    """All settings."""
    hints = get_type_hints(Settings)
    rows = []
    for name, field in Settings.model_fields.items():
        low, above, high = (next((getattr(m, w) for m in field.metadata if hasattr(m, w)), None) for w in LIMITS)
        default = field.default if field.default_factory is None else None
        is_size = name.endswith("_bytes")
        size = is_size and isinstance(default, int) and default > 0
        shown = format_size(int(default)) if size else _text(default)
        rows.append(
            (
                f"`FLEETMAP_{name.upper()}`",
                "size" if is_size else kind_of(hints[name]),
                code(shown) if default is not None and shown != '""' else "",
                bounds(low, high, above=above),
                field.description or "",
            )
        )
    return table(("setting", "type", "default", "bounds", "meaning"), rows)


def _no_tasks() -> QueueFigures:
    return QueueFigures({"robot": 0, "person": 0}, 0, 0.0, 0)


def metrics() -> str:
    """All metrics of ``/metrics``."""
    metrics = Metrics()
    rows = [
        (code(name), one._type, codes(one._labelnames), one._documentation)
        for one in vars(metrics).values()
        if isinstance(one, MetricWrapperBase) and not one._labelvalues
        for name in [one._name + ("_total" if one._type == "counter" else "")]
    ]
    hits = metrics.registry._names_to_collectors["fleetmap_cache_hits"]
    rows.append((code("fleetmap_cache_hits_total"), hits._type, codes(hits._labelnames), hits._documentation))
    with tempfile.TemporaryDirectory() as folder:
        environments = SimpleNamespace(page=lambda **_: ([], None))
        empty: Any = SimpleNamespace(
            environments=environments,
            webhooks=SimpleNamespace(all=list),
            mirrors=SimpleNamespace(figures=lambda: None),
            backups=Backups(FileDocument(Path(folder) / "backup")),
            blob_dir=Path(folder),
            is_shared=False,
        )
        of_store = (one(empty) for one in (_HeadVersionCollector, _Scrubs, _Backups, _Webhooks, MirrorCollector))
        for collector in (*of_store, _Leaders(LocalLeads(Path(folder))), QueueCollector(_no_tasks)):
            for family in collector.collect():
                labels = getattr(family, "_labelnames", ())
                name = family.name + ("_total" if family.type == "counter" else "")
                rows.append((code(name), family.type, codes(labels), family.documentation))
    rows += [(code(gauge.name), "gauge", codes(gauge.labels), gauge.meaning) for gauge in GAUGES]
    return table(("metric", "type", "labels", "meaning"), sorted(rows))


def errors() -> str:
    """All types of problems."""
    rows = []
    for cls, (status, title) in problems.STATUS.items():
        _, _, kind = problems.problem_status(cls.__new__(cls))
        rows.append((code(kind), str(status), title, sentence(plain(inspect.getdoc(cls) or ""))))
    return table(("type", "status", "title", "meaning"), sorted(rows, key=lambda row: (row[1], row[0])))


def unlisted_errors() -> list[type[FleetMapError]]:
    """Classes of errors that answer as their nearest listed base."""
    todo, out = [FleetMapError], []
    while todo:
        cls = todo.pop()
        todo += cls.__subclasses__()
        if cls not in problems.STATUS and cls is not FleetMapError and cls.__module__.startswith("app."):
            out.append(cls)
    return out


# --- HTTP ------------------------------------------------------------------------------------------------------------
@cache
def application() -> Any:
    """The server's application, never started."""
    with tempfile.TemporaryDirectory() as folder:
        return create_app(Settings(_env_file=None, data_dir=Path(folder), zenoh_mode="off"))  # type: ignore[call-arg]


def events() -> str:
    """Each event type: when it happens, and an example."""
    out = []
    for name in EVENT_TYPES:
        doc, members = describe(name)
        example = json.dumps({"type": name, **EVENT, **members}, indent=2)
        out += [f"## {name}\n", f"{doc}\n", f"```json\n{example}\n```\n"]
    return "\n".join(out)


@cache
def openapi() -> dict[str, Any]:
    """The OpenAPI document."""
    schema: dict[str, Any] = application().openapi()
    return schema


def http() -> str:
    """All calls by tag, then all schemas."""
    schema = openapi()
    roles = _roles()
    out = []
    for tag in schema["tags"]:
        if tag["name"] == "maps by format":
            continue
        out.append(f"## {tag['name'].capitalize()}\n\n{tag['description']}\n")
        out += [
            _operation(method, path, item[method], roles.get((method, path), ""))
            for path, item in schema["paths"].items()
            for method in METHODS
            if tag["name"] in item.get(method, {}).get("tags", ())
        ]
    out.append("## Schemas\n")
    for name, shape in sorted(schema["components"]["schemas"].items()):
        out.append(f"### {name}\n\n{plain(shape.get('description', ''))}\n\n{_members(shape)}")
    return "\n".join(out)


def _roles() -> dict[tuple[str, str], str]:
    """(method, path) -> the least role that a token needs."""
    out = {}
    routers = [route.original_router for route in application().routes if hasattr(route, "original_router")]
    while routers:
        for route in routers.pop().routes:
            if hasattr(route, "original_router"):
                routers.append(route.original_router)
                continue
            for dependency in _dependencies(route.dependant):
                if isinstance(dependency.call, RequireRole):
                    least = code(dependency.call.need)
                    role = f"{least}, in all environments" if dependency.call.everywhere else least
                    for method, prefix in itertools.product(route.methods, ("", API)):
                        out[method.lower(), prefix + route.path] = role
    return out


def _dependencies(dependant: Any) -> Iterator[Any]:
    """Yield the dependencies of a route, and theirs."""
    for dependency in dependant.dependencies:
        yield dependency
        yield from _dependencies(dependency)


def _operation(method: str, path: str, operation: Mapping[str, Any], role: str) -> str:
    described = plain(operation.get("description", ""))
    out = [f"### {method.upper()} {plain(path)}\n", f"**{sentence(plain(operation['summary']))}** {described}\n"]
    if {"link": []} in operation.get("security", ()):
        role = "`viewer`, or a [signed link](#post-apiv1environmentsenvversionsvlinks)"
    out.append(f"Role: {role}.\n" if role else "No token is needed.\n")
    shown = operation.get("parameters", [])
    if "maps" in operation["tags"] and "{format}" in path:
        shown = [p for p in shown if p["in"] != "query" or p["name"] in ("derive", "closures")]
        out.append("It also accepts the parameters of the [format](formats.md) and of [derivations](derivations.md).\n")
    out.append(
        table(
            ("parameter", "in", "type", "default", "meaning"),
            (
                (
                    code(p["name"]) + (" (required)" if p.get("required") and p["in"] != "path" else ""),
                    p["in"],
                    _schema(p.get("schema", {})),
                    code(_text(p["schema"]["default"])) if p.get("schema", {}).get("default") is not None else "",
                    sentence(plain(p.get("description", p.get("schema", {}).get("description", "")))),
                )
                for p in shown
            ),
        )
    )
    for media, body in operation.get("requestBody", {}).get("content", {}).items():
        shape = body.get("schema", {})
        out.append(f"Body, `{media}`: {_schema(shape)}\n" if shape else f"Body: `{media}`\n")
    rows = []
    for status, answer in sorted(operation["responses"].items()):
        if status in EVERYWHERE:
            continue
        content = answer.get("content", {})
        shapes = dict.fromkeys(_schema(c["schema"]) for c in content.values() if c.get("schema"))
        rows.append((status, sentence(plain(answer.get("description", ""))), codes(content), ", ".join(shapes)))
    out.append(table(("status", "answer", "media type", "schema"), rows))
    shared = sorted(EVERYWHERE & set(operation["responses"]))
    if shared:
        out.append(f"Also {', '.join(shared)}: see [errors](errors.md).\n")
    return "\n".join(out)


def _schema(shape: Mapping[str, Any]) -> str:
    """A JSON schema in a few words, with links to the named ones."""
    if "$ref" in shape:
        name = shape["$ref"].rpartition("/")[2]
        return f"[{name}](#{name.lower()})"
    if "enum" in shape:
        return codes(shape["enum"])
    if "const" in shape:
        return code(shape["const"])
    for word in ("anyOf", "oneOf", "allOf"):
        if word in shape:
            return " or ".join(dict.fromkeys(_schema(s) for s in shape[word] if s.get("type") != "null"))
    kind = shape.get("type", "any")
    if kind == "array":
        return f"list of {_schema(shape.get('items', {}))}"
    if kind == "object" and isinstance(shape.get("additionalProperties"), dict) and shape["additionalProperties"]:
        return f"map of {_schema(shape['additionalProperties'])}"
    if kind == "object" and shape.get("properties"):
        return "object with " + codes(shape["properties"])
    limits = bounds(shape.get("minimum"), shape.get("maximum"), above=shape.get("exclusiveMinimum"))
    if shape.get("maxLength"):
        limits = f"up to {shape['maxLength']} characters"
    return f"{kind}{f' ({limits})' if limits else ''}"


def _members(shape: Mapping[str, Any]) -> str:
    required = set(shape.get("required", ()))
    rows = []
    for name, member in shape.get("properties", {}).items():
        default = member.get("default")
        rows.append(
            (
                code(name),
                _schema(member),
                "yes" if name in required else "",
                code(_text(default)) if isinstance(default, (str, int, float, bool)) else "",
                sentence(plain(member.get("description", ""))),
            )
        )
    return table(("member", "type", "required", "default", "meaning"), rows) or f"{_schema(shape)}\n"


# --- command line ----------------------------------------------------------------------------------------------------
def cli() -> str:
    """All commands, by the help's panels."""
    root: Any = get_command(commands.build())
    out = []
    for panel, listed in commands.PANELS.items():
        out.append(f"## {panel}\n")
        for name, _ in listed:
            out += _command(f"fleetmap {name}", root.commands[name])
    return "\n".join(out)


def _command(name: str, command: Any) -> list[str]:
    is_serve = name == "fleetmap serve"
    if is_serve:
        command = get_command(commands.build("serve")).commands["serve"]  # type: ignore[attr-defined]
    out = [f"### {name}\n", f"{plain(inspect.cleandoc(command.help or ''))}\n"]
    rows = []
    for p in command.params:
        if getattr(p, "hidden", False) or (is_serve and p.name in Settings.model_fields):
            continue
        if p.param_type_name == "argument":
            label = code(p.metavar or p.human_readable_name.upper())
        else:
            label = ", ".join(code(o) for o in (*p.opts, *p.secondary_opts))
            label += "" if getattr(p, "is_flag", False) else f" `{p.metavar or 'VALUE'}`"
        default = p.default if isinstance(p.default, (str, int, float)) and not isinstance(p.default, bool) else ""
        variables = p.envvar if isinstance(p.envvar, str) else ", ".join(p.envvar or ())
        rows.append(
            (
                label + (" (required)" if p.required and p.param_type_name == "option" else ""),
                code(default) if default not in ("", None) else "",
                code(variables) if variables else "",
                plain(getattr(p, "help", None) or ""),
            )
        )
    out.append(table(("argument or option", "default", "variable", "meaning"), rows))
    if is_serve:
        out.append("Each [setting](settings.md) is an option as well: `FLEETMAP_LOG_LEVEL` is `--log-level`.\n")
    for child in sorted(getattr(command, "commands", {})):
        out += _command(f"{name} {child}", command.commands[child])
    return out


# --- the store -------------------------------------------------------------------------------------------------------
def encoding() -> str:
    """The canonical encoding, as its module specifies it."""
    text = inspect.getdoc(encode) or ""
    return prose(text.partition("\n")[2])


def chunk_tree() -> str:
    """How a sequence is cut into nodes, as its module specifies it, with its numbers."""
    text = inspect.getdoc(tree) or ""
    numbers = [
        ("children of an inner node, on average", str(2**tree.FANOUT_BITS)),
        ("a node is cut again beyond this many times the average", str(tree.OVERSIZE)),
        ("level at which everything goes into one node", str(tree.MAX_LEVEL)),
        ("version of the encoding", str(encode.ENCODING)),
    ]
    return f"{prose(text.partition(chr(10))[2])}\n{table(('number', 'value'), numbers)}"


EVENT: Mapping[str, Any] = {
    "sequence": 6,
    "environment": "my-farm",
    "version": 3,
    "root": "5048dcddc88d47e4a78da440de2f9886569444a9019e7620f618f8de726c956c",
    "previous": {"version": 2, "root": "8c3ee386be22778ecddad6d6fc39946a02942512065f33781671b317460894b9"},
    "layers": [
        {
            "layer": "occupancy",
            "level": "ground",
            "name": "map",
            "change": "added",
            "hash": "63b06a3f65b1140a8af28147e65070a11af03970b07a0f772c9ff6c759868d61",
        }
    ],
    "message": "mapped",
    "author": "administrator",
    "time": "2026-03-02T09:21:16.486836Z",
}
"""The members that all events have, by an example."""


BLOCKS: Mapping[str, Callable[[], str]] = {
    "formats": formats_table,
    "derivations": derivations,
    "generators": generators,
    "settings": settings,
    "metrics": metrics,
    "errors": errors,
    "http": http,
    "events": events,
    "cli": cli,
    "encoding": encoding,
    "chunk-tree": chunk_tree,
}
"""Name in a marker -> what makes the Markdown."""
