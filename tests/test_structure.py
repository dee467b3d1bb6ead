"""Structure of the code: lengths of functions and files, names, imports of private modules."""

from __future__ import annotations

import ast
import dataclasses
import gc
import re
from collections import Counter, defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

from app.formats import Format

TOP = Path(__file__).parents[1]
MAX_FUNCTION_LINES = 60
MAX_FILE_LINES = 600

LONG_FUNCTIONS = {
    "app/generate/_kernels_wfc.py:collapse": "one compiled loop with its backtracking: its parts would copy its state",
    "app/syntax/yaml/lines.py:load_lines": "the hot loop of the fast parser: its state stays in locals",
}
"""Exceptions with their reasons."""

LONG_FILES = {
    "app/agent/ros/fleetmap_ros/loading.py": "runs as one script under the robot's own Python",
}
"""Exceptions with their reasons."""

VAGUE_NAMES = {
    "told",
    "said",
    "known",
    "found",
    "made",
    "held",
    "who",
    "where",
    "here",
    "there",
    "what",
    "which",
    "own",
    "mine",
    "tell",
    "say",
    "ask",
    "ear",
    "wish",
}
"""Participles and question words, which are not allowed as names."""

PUBLIC_NAMES = {
    "app/api/search.py:where": "a member of a hit, as clients see it",
    "app/api/http/schemas.py:where": "a member of problems, as clients see them",
    "app/api/checks.py:where": "a member of findings",
    "app/api/impact.py:where": "the same",
    "app/errors.py:where": "the same member, and what sets it:",
    "app/formats/_rules.py:where": "",
    "app/formats/clouds/points.py:where": "",
    "app/formats/gazebo/sdf.py:where": "",
    "app/formats/rmf/site/vocabulary.py:where": "",
    "app/generate/_expressions.py:where": "",
    "app/generate/_site.py:where": "",
    "app/model/notes.py:where": "",
    "app/cli/client.py:tell": "a method of Python's files",
    "app/store/scrub.py:found": "a member of a stored file",
}
"""Exceptions with their reasons."""

WRITERS = {
    "app/api/http/metrics.py": "gives room on the disk to files that Prometheus's client has made",
    "app/api/http/uploads.py": "files of an upload, in a workspace",
    "app/backup/create.py": "rows of tables, in a workspace",
    "app/backup/restore.py": "rows of tables and parts of files, in a workspace",
    "app/convert/cache.py": "a map's files are renamed, linked and synced as one folder, which no other store does",
    "app/convert/trials.py": "a log of which one line is appended at a time",
    "app/doctor/workers.py": "a file that a worker must not be able to create",
    "app/events/router.py": "hands settings to its process by a descriptor",
    "app/events/security.py": "files of passwords, which the router's process reads",
    "app/ingest/online.py": "a cache by address: nobody knows the hash of what a provider will send",
    "app/main.py": "creates the data folder and the folder of Prometheus's client",
    "app/mirror/content.py": "fetched files, in a workspace",
    "app/native.py": "compiled code, outside of the data folder",
    "app/review/graph_rules.py": "no file: a method of the same name",
    "app/signing.py": "a private key in a file of its own, as operators back it up and remove it",
    "app/store/blob_coding.py": "temporary files, in a workspace",
    "app/store/blobs.py": "the same",
    "app/store/made_maps.py": "the same",
    "app/store/database.py": "creates the folder of SQLite's file",
    "app/syntax/geotiff.py": "no file: rasterio writes to memory",
    "app/web/build.py": "the page, when it is built",
}
"""Modules beside ``app/backends`` that write files on the server, with their reasons."""

WRITING = {
    *("write_bytes", "write_text", "mkdir", "unlink", "rmtree", "rename", "hardlink_to", "symlink_to", "copyfile"),
    *("fdopen", "posix_fallocate", "NamedTemporaryFile", "TemporaryDirectory"),
}
"""Functions that write files, besides ``open`` with such a mode."""


CALLED_FROM_OUTSIDE = {
    "app/agent/ros/launch/fleetmap_agent.launch.py:generate_launch_description": "by ROS 2's launch",
    "app/web/build.py:PageBuildHook": "by hatchling",
}
"""Names that occur once, with their reasons."""

Nodes = dict[type[ast.AST], list[Any]]
"""The nodes of a syntax tree by their class."""


@cache
def modules(folder: str) -> dict[str, Nodes]:
    """Parse each file below a folder, and walk through it once: path -> nodes."""
    gc.disable()  # half the time: a million objects, none of which is garbage
    try:
        paths = sorted((TOP / folder).rglob("*.py"))
        return {path.relative_to(TOP).as_posix(): by_class(ast.parse(path.read_text())) for path in paths}
    finally:
        gc.enable()


def by_class(tree: ast.Module) -> Nodes:
    nodes: Nodes = defaultdict(list)
    for node in ast.walk(tree):
        nodes[type(node)].append(node)
    return nodes


def functions(nodes: Nodes) -> list[ast.FunctionDef | ast.AsyncFunctionDef]:
    return nodes[ast.FunctionDef] + nodes[ast.AsyncFunctionDef]


def body_lines(node: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Count the lines of a function's body, without parameters (options of a command) and docstring."""
    body = node.body[1:] if ast.get_docstring(node, clean=False) is not None else node.body
    return (node.end_lineno or 0) - body[0].lineno + 1 if body else 0


def test_functions_are_short() -> None:
    lengths = {
        f"{path}:{node.name}": body_lines(node) for path, nodes in modules("app").items() for node in functions(nodes)
    }
    assert {name for name, length in lengths.items() if length > MAX_FUNCTION_LINES} == set(LONG_FUNCTIONS)
    assert len(LONG_FUNCTIONS) <= 5


def test_files_are_short() -> None:
    lengths = {path: len((TOP / path).read_text().splitlines()) for path in modules("app")}
    assert {path for path, length in lengths.items() if length > MAX_FILE_LINES} == set(LONG_FILES)
    assert len(LONG_FILES) <= 5


def assigned_names(nodes: Nodes) -> Iterator[str]:
    yield from (node.id for node in nodes[ast.Name] if isinstance(node.ctx, ast.Store))
    yield from (node.attr for node in nodes[ast.Attribute] if isinstance(node.ctx, ast.Store))
    yield from (node.name for node in functions(nodes) + nodes[ast.ClassDef])
    yield from (node.arg for node in nodes[ast.arg])


def test_names_are_nouns_and_verbs() -> None:
    vague = {
        f"{path}:{name}"
        for folder in ("app", "docs")
        for path, nodes in modules(folder).items()
        for name in assigned_names(nodes)
        if name.strip("_").lower() in VAGUE_NAMES
    }
    assert vague == set(PUBLIC_NAMES)


def test_private_modules_are_imported_in_their_package_only() -> None:
    outside = []
    for path, nodes in modules("app").items():
        importer = path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
        names = [alias.name for node in nodes[ast.Import] for alias in node.names]
        names += [
            f"{node.module}.{alias.name}" for node in nodes[ast.ImportFrom] if node.module for alias in node.names
        ]
        for name in names:
            pieces = name.split(".")
            private = next((k for k, piece in enumerate(pieces) if piece.startswith("_")), None)
            if pieces[0] != "app" or private is None or not is_module(pieces[: private + 1]):
                continue
            package = ".".join(pieces[:private])
            if not f"{importer}.".startswith(f"{package}."):
                outside.append(f"{importer} imports {name}")
    assert outside == []


def is_module(pieces: list[str]) -> bool:
    path = TOP.joinpath(*pieces)
    return path.is_dir() or path.with_suffix(".py").is_file()


def defined_names(nodes: Nodes) -> Iterator[str]:
    """Names of functions, classes and constants of a module, and of methods that override none of a base class."""
    for node in (*functions(nodes), *nodes[ast.ClassDef]):
        if not node.col_offset and not node.decorator_list:
            yield node.name
    for node in (*nodes[ast.Assign], *nodes[ast.AnnAssign]):
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        yield from (one.id for one in targets if isinstance(one, ast.Name) and not one.col_offset)
    for node in nodes[ast.ClassDef]:
        if not node.bases:
            methods = [one for one in node.body if isinstance(one, ast.FunctionDef | ast.AsyncFunctionDef)]
            yield from (one.name for one in methods if not one.name.startswith("__"))


def test_what_only_tests_use_is_not_kept() -> None:
    """What is defined is named a second time: in the code, or in the documentation of what plug-ins may use."""
    places = [(TOP / "app").rglob("*.py"), (TOP / "migrations").rglob("*.py"), (TOP / "docs").rglob("*.md")]
    words = Counter(word for paths in places for path in paths for word in re.findall(r"\w+", path.read_text()))
    unused = {
        f"{path}:{name}" for path, nodes in modules("app").items() for name in defined_names(nodes) if words[name] == 1
    }
    assert unused - set(CALLED_FROM_OUTSIDE) == set()
    assert set(CALLED_FROM_OUTSIDE) - unused == set(), "no exceptions any more"


def calls_of_writers(nodes: Nodes) -> Iterator[str]:
    """List the functions that write files, where a module calls them."""
    for node in nodes[ast.Call]:
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        texts = [one.value for one in node.args if isinstance(one, ast.Constant) and isinstance(one.value, str)]
        if name in WRITING or (name == "open" and any(len(text) < 4 and set(text) & set("wax+") for text in texts)):
            yield name


def test_only_backends_write_files_of_the_server() -> None:
    """The command line and the robot's side have files of their own."""
    apart = ("app/backends/", "app/cli/", "app/agent/")
    writers = {
        name for name, nodes in modules("app").items() if not name.startswith(apart) and any(calls_of_writers(nodes))
    }
    assert writers - set(WRITERS) == set(), "put it behind a port of app/backends"
    assert set(WRITERS) - writers == set(), "no exceptions any more"


def test_only_backends_lock_files() -> None:
    for name, nodes in modules("app").items():
        if not name.startswith(("app/backends/", "app/agent/")):
            imports = {alias.name for node in nodes[ast.Import] for alias in node.names}
            assert "fcntl" not in imports, name


def test_format_has_few_fields() -> None:
    assert len(dataclasses.fields(Format)) <= 16
