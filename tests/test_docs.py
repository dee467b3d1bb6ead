"""The documentation builds without warnings and contains every setting, format, route, event, command and metric."""

from __future__ import annotations

import dataclasses
import html
import logging
import os
import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command

from app import derive, generate
from app.api.http.problems import STATUS, problem_status
from app.cli.commands import ALIASES, build
from app.config import Settings
from app.event_types import EVENT_TYPES
from app.events import bus, messages
from app.formats import all_formats
from app.main import create_app

ROOT = Path(__file__).resolve().parents[1]
TEXTS = (".py", ".md", ".toml", ".yaml", ".yml", ".svg", ".sh", ".service", ".env", ".js", "Makefile", "Dockerfile")
NAMED_TEST = re.compile(r"(tests/[\w/]+\.py)::(test_\w+)")
SKIPPED = frozenset({".git", ".venv", "build", "data", "dist", "node_modules"})


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the pages. A warning of MkDocs (a broken link or anchor, a page missing in the menu) is a failure."""
    from mkdocs.commands.build import build as build_pages
    from mkdocs.config import load_config
    from mkdocs.exceptions import Abort

    folder = tmp_path_factory.mktemp("site")
    messages: list[str] = []
    handler = logging.Handler(logging.WARNING)
    handler.emit = lambda record: messages.append(record.getMessage())  # type: ignore[method-assign]
    log = logging.getLogger("mkdocs")
    log.addHandler(handler)
    try:
        build_pages(load_config(str(ROOT / ".mkdocs.yml"), site_dir=str(folder), strict=True))
    except Abort:
        pytest.fail("\n".join(messages))
    finally:
        log.removeHandler(handler)
    return folder


@pytest.fixture(scope="module")
def pages(site: Path) -> Mapping[str, str]:
    """Map the path below the site to the text of the page."""
    out = {}
    for path in site.rglob("*.html"):
        body = path.read_text().partition("<article")[2].partition("</article>")[0]
        out[path.relative_to(site).as_posix()] = " ".join(html.unescape(re.sub(r"<[^>]*>", " ", body)).split())
    assert len(out) > len(all_formats())
    return out


def test_readme_is_short() -> None:
    assert (ROOT / "README.md").stat().st_size <= 10_000


def test_links_of_top_level_texts_resolve() -> None:
    for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md"):
        for target in re.findall(r"\]\((?!https?:)([^)#]+)", (ROOT / name).read_text()):
            assert (ROOT / target).is_file(), f"{name}: {target}"


def words(page: str) -> set[str]:
    """Split a page into words without punctuation at their ends."""
    return {word.strip(".,;:()[]¶") for word in page.split()}


@pytest.fixture(scope="module")
def schema(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    settings = Settings(_env_file=None, data_dir=tmp_path_factory.mktemp("data"), zenoh_mode="off")  # type: ignore[call-arg]
    described: dict[str, Any] = create_app(settings).openapi()
    return described


def test_pages_load_nothing_from_other_hosts(site: Path) -> None:
    loading = re.compile(r"<(?:script|img|iframe|source)\b[^>]*\bsrc=[\"']?(?:https?:)?//|@import|url\([\"']?https?:")
    for path in site.rglob("*"):
        if path.suffix in (".html", ".css", ".svg"):
            text = path.read_text()
            assert not loading.search(text), path
            for link in re.findall(r"<link\b[^>]*>", text):
                assert "canonical" in link or not re.search(r"href=[\"']?(?:https?:)?//", link), link


def test_every_setting_is_documented(pages: Mapping[str, str]) -> None:
    page = pages["reference/settings.html"]
    for name, field in Settings.model_fields.items():
        assert f"FLEETMAP_{name.upper()}" in words(page)
        assert field.description, name
        assert "".join(field.description.replace("`", "").split())[:60] in "".join(page.split()), name


@pytest.mark.parametrize("name", sorted(all_formats()))
def test_every_format_has_a_page(pages: Mapping[str, str], name: str) -> None:
    fmt = all_formats()[name]
    page = pages[f"reference/formats/{name}.html"]
    assert fmt.title in page
    assert name in words(pages["reference/formats.html"])
    for file in fmt.files:
        assert file in page
    options = (fmt.write_options if fmt.write else None, fmt.read_options if fmt.read else None)
    for field in (f for cls in options if cls for f in dataclasses.fields(cls)):
        assert field.name in words(page)
        assert field.metadata["doc"], f"{name}: {field.name} has no description"
    assert ("Rules of its consumers" in page) == (fmt.check is not None)


@pytest.mark.parametrize("kind", ["derivations", "generators"])
def test_every_derivation_and_generator_is_documented(pages: Mapping[str, str], kind: str) -> None:
    declared: Mapping[str, Any] = derive.all_derivations() if kind == "derivations" else generate.all_generators()
    page = pages[f"reference/{kind}.html"]
    for name, one in declared.items():
        assert name in words(page)
        for field in dataclasses.fields(one.parameters):
            assert field.name in words(page), f"{name}: {field.name}"
            assert field.metadata["doc"], f"{name}: {field.name} has no description"


def test_every_route_is_documented(pages: Mapping[str, str], schema: dict[str, Any]) -> None:
    page = pages["reference/http.html"]
    for path, item in schema["paths"].items():
        name = path.removeprefix("/maps/{env}/")
        if name in all_formats():
            assert f"reference/formats/{name}.html" in pages
            continue
        for method in item:
            assert f"{method.upper()} {path} ¶" in page, f"{method} {path}"
    for name in schema["components"]["schemas"]:
        assert f"{name} ¶" in page


def test_every_event_is_documented(pages: Mapping[str, str]) -> None:
    """``tests/api/test_event_payloads.py`` compares the payloads with what the server sends."""
    for kind in EVENT_TYPES:
        assert f"{kind} ¶" in pages["reference/events.html"]


def test_every_command_is_documented(pages: Mapping[str, str]) -> None:
    page = pages["reference/cli.html"]

    def check(name: str, command: Any) -> None:
        assert f"{name} ¶" in page
        for option in (o for p in command.params for o in p.opts if o.startswith("--") and not p.hidden):
            assert option in words(page), f"{name} {option}"
        for child in getattr(command, "commands", {}):
            check(f"{name} {child}", command.commands[child])

    root: Any = get_command(build())
    for name in sorted(root.commands):
        if name not in ALIASES:
            check(f"fleetmap {name}", root.commands[name])


def test_every_metric_is_documented(pages: Mapping[str, str]) -> None:
    named = {
        n for p in (ROOT / "app").rglob("*.py") for n in re.findall(r"[\"'](fleetmap_[a-z_]+)[\"'],", p.read_text())
    }
    named -= {"fleetmap_agent", "fleetmap_ros", "fleetmap_heads"}
    assert {"fleetmap_head", "fleetmap_requests"} <= named
    for name in named:
        assert {name, f"{name}_total"} & words(pages["reference/metrics.html"]), name


def test_every_problem_is_documented(pages: Mapping[str, str]) -> None:
    for cls, (status, title) in STATUS.items():
        _, _, kind = problem_status(cls.__new__(cls))
        row = pages["reference/errors.html"].partition(f" {kind} ")[2][:80]
        assert row.split()[0] == str(status), kind
        assert title in row, kind


def test_every_zenoh_key_is_documented(pages: Mapping[str, str]) -> None:
    class Recorder:
        """Session that records the keys declared on it."""

        def __init__(self) -> None:
            self.keys: list[str] = []

        def __getattr__(self, _: str) -> Any:
            return lambda *arguments, **__: self.keys.append(str(arguments[0])) if arguments else self

    session: Any = Recorder()
    session_bus = bus.Bus(bus.BusOptions(), query_handler=Any, explain=Any, on_status=Any, on_alive=Any)  # type: ignore[arg-type]
    session_bus._declare(session)
    session_bus.close()
    keys = [*session.keys, messages.events_key("fleetmap", "*"), messages.status_key("fleetmap", "*", "*")]
    assert len(keys) > 6
    documented = {re.sub(r"{[a-z]+}", "*", word) for word in words(pages["reference/zenoh.html"])}
    for key in keys:
        assert key.replace("/**", "/*") in documented, key


def test_tests_that_texts_name_exist() -> None:
    """The promises of ``docs/security.md`` name the tests behind them."""
    named = {match for path, text in texts() if path.suffix == ".md" for match in NAMED_TEST.findall(text)}
    assert len([file for file, _ in named]) > 40
    for file, name in named:
        assert f"def {name}(" in (ROOT / file).read_text(), f"{file} has no {name}"
    promises = (ROOT / "docs" / "security.md").read_text().split("| promise | test |")[1].split("\n\n")[0]
    for row in promises.strip().splitlines()[1:]:
        assert NAMED_TEST.search(row), f"no test behind this promise: {row}"


@cache
def files_of_the_project() -> list[Path]:
    """List the files below the root, without folders that tools fill."""
    out = []
    for folder, folders, names in os.walk(ROOT):
        folders[:] = sorted(set(folders) - SKIPPED)
        out += [Path(folder, name) for name in sorted(names)]
    return out


@cache
def texts() -> list[tuple[Path, str]]:
    """Return the project's own texts: (path below the root, content)."""
    out = []
    for path in files_of_the_project():
        relative = path.relative_to(ROOT)
        if "samples" not in relative.parts and path.name.endswith(TEXTS) and path.is_file():
            out.append((relative, path.read_text(errors="replace")))
    return out


def test_texts_contain_no_path_of_a_machine() -> None:
    for path, text in texts():
        for word in ("/" + "work/", "/" + "root/"):
            assert word not in text, f"{path} names a path of a machine"


def test_texts_name_only_documents_of_the_project() -> None:
    pages = {path.name for path in files_of_the_project() if path.suffix == ".md"}
    pages |= {f"{name}.md" for name in all_formats()}
    pages |= {"grammar.md", "extensions.md", "LIF.md", "NOTICE.md"}  # of RON and LIF, and in a test's upload
    for path, text in texts():
        lines = "\n".join(line for line in text.splitlines() if ".md" in line)
        named = set(re.findall(r"(?<![\w/*.-])(?:[\w.-]+/)*([\w-]+\.md)\b", lines))
        assert named <= pages, f"{path} names {', '.join(sorted(named - pages))}"
        lower = text.lower()
        for phrase in ("the contract", "house rules", "design page"):
            assert path == Path("tests/test_docs.py") or phrase not in lower, f"{path} speaks of {phrase!r}"
