"""The agent installs and runs without the server's packages."""

from __future__ import annotations

import ast
import fnmatch
import re
import subprocess
import sys
import tomllib
from datetime import UTC, datetime
from pathlib import Path

import pytest

from app.agent import signed_manifest
from tests.agent.conftest import ROOT
from tests.agent.conftest import whole as whole_map
from tests.api.conftest import ADMIN, Api

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
MODULES = {
    "pyyaml": "yaml", "pillow": "PIL", "opencv-python-headless": "cv2", "python-multipart": "python_multipart",
    "prometheus-client": "prometheus_client", "pydantic-settings": "pydantic_settings", "pycollada": "collada",
    "fastapi-offline": "fastapi_offline", "psycopg": "psycopg", "laspy": "laspy",
}  # fmt: skip

BLOCKED = """
import sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {absent!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Absent())
from app.cli import run
status = run(sys.argv[1:])
if status == 0 and sys.argv[1] == "agent":
    heavy = {absent!r} & {{name.partition(".")[0] for name in sys.modules}}
    assert not heavy, heavy
sys.exit(status)
"""


def names(texts: list[str]) -> set[str]:
    return {re.split(r"[\[<>=!~; ]", text, maxsplit=1)[0].lower() for text in texts}


def without_server(*arguments: str) -> subprocess.CompletedProcess[str]:
    """``fleetmap`` where none of the server's packages can be imported."""
    server = names(PROJECT["optional-dependencies"]["server"])
    absent = {MODULES.get(name, name.replace("-", "_")) for name in server} | {"starlette"}
    absent -= {"httpcore"}  # also a part of httpx
    script = BLOCKED.format(absent=absent)
    return subprocess.run(
        [sys.executable, "-c", script, *arguments],
        env={"PATH": "/usr/bin:/bin", "PYTHONPATH": str(ROOT), "FLEETMAP_TOKEN": ADMIN},
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


def test_base_install_is_small() -> None:
    assert names(PROJECT["dependencies"]) == {
        "typer", "rich", "httpx", "eclipse-zenoh", "cryptography", "backports-zstd",
    }  # fmt: skip
    extras = PROJECT["optional-dependencies"]
    assert {"numpy", "shapely", "lxml"} <= names(extras["convert"])
    assert {"fleet-map-server", "fastapi", "sqlalchemy", "scipy", "opencv-python-headless"} <= names(extras["server"])


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["agent", "--help"], ["promote", "--help"]])
def test_help_needs_no_server(arguments: list[str]) -> None:
    process = without_server(*arguments)
    assert process.returncode == 0, process.stderr


def test_agent_syncs_without_server_packages(api: Api, place: str, tmp_path: Path) -> None:
    process = without_server(
        "agent", "-s", api.url, "-e", place, "-f", "tmap2", "--into", str(tmp_path / "r"), "--once"
    )
    assert process.returncode == 0, process.stderr
    assert whole_map(tmp_path / "r")["version"] == 1


@pytest.mark.parametrize("arguments", [["serve"], ["migrate"]])
def test_missing_package_names_what_to_install(arguments: list[str], tmp_path: Path) -> None:
    process = without_server(*arguments)
    assert process.returncode == 1
    assert 'pip install "fleet-map-server[server]"' in process.stderr, process.stderr


def robot_modules() -> list[str]:
    """ROBOT of the Makefile: what `make lint` checks for Python 3.10."""
    text = (ROOT / "Makefile").read_text().replace("\\\n", " ")
    match = re.search(r"^ROBOT := (.+)$", text, re.MULTILINE)
    assert match is not None
    return match[1].split()


def imported(path: Path) -> set[str]:
    """Modules of ours that are imported with this file: not those within a function or below TYPE_CHECKING."""
    names: set[str] = set()
    todo: list[ast.AST] = [ast.parse(path.read_text())]
    while todo:
        node = todo.pop()
        if isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f"{node.module}.{one.name}" for one in node.names)}
        elif isinstance(node, ast.Import):
            names |= {one.name for one in node.names}
        lazy = isinstance(node, ast.FunctionDef) or (isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node))
        todo += [] if lazy and "app/agent" not in path.as_posix() else list(ast.iter_child_nodes(node))
    return {name for name in names if name.partition(".")[0] == "app"}


def file_of(module: str) -> Path | None:
    base = ROOT.joinpath(*module.split("."))
    return next((p for p in (base / "__init__.py", base.with_suffix(".py")) if p.is_file()), None)


def test_agent_imports_are_checked_for_python_3_10() -> None:
    checked = {p for name in robot_modules() for p in ([ROOT / name] if name.endswith(".py") else [])}
    checked |= {p for name in robot_modules() for p in (ROOT / name).rglob("*.py")}
    for path in sorted(checked):
        for module in imported(path):
            parents = [module.rsplit(".", n)[0] for n in range(module.count(".") + 1)]
            for file in filter(None, map(file_of, parents)):
                assert file in checked, f"{path} imports {file}, which is not in ROBOT of the Makefile"
    patterns = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["ruff"]["per-file-target-version"]
    assert set(patterns.values()) == {"py310"}
    for path in checked:
        name = path.relative_to(ROOT).as_posix()
        fits = (p for pattern in patterns for p in braces(pattern) if fnmatch.fnmatch(name, p.replace("**", "*")))
        assert next(fits, None), f"{name} is not among [tool.ruff.per-file-target-version]"


def braces(pattern: str) -> list[str]:
    head, brace, rest = pattern.partition("{")
    inner, _, tail = rest.partition("}")
    return [head + one + tail for one in inner.split(",")] if brace else [pattern]


def test_server_code_is_imported_after_python_check() -> None:
    robot = {file_of(f"app.cli.{p.stem}") for p in (ROOT / "app" / "cli").glob("*.py")}
    robot |= {ROOT / name for name in robot_modules()}
    count = 0
    for path in sorted((ROOT / "app" / "cli").glob("*.py")):
        for function in (n for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.FunctionDef)):
            body = ast.unparse(function)
            lazy = {m for m in re.findall(r"from (app[\w.]*) import", body) if m != "app.cli"}
            lazy |= {f"app.{m}" for names in re.findall(r"from app import (.+)", body) for m in names.split(", ")}
            files = {file_of(m) for m in lazy if not m.startswith("app.agent")}
            if files - robot and function.name not in AFTER_THE_CHECK:
                assert "require_server_python(" in body, f"{path.name}: {function.name} imports {files - robot}"
                count += 1
    assert count >= 8


AFTER_THE_CHECK = {
    "_compile",
    "_store",
    "_run",
    "application",
    "check",
    "_companions",
    "_check_names",
    "_open",
    "_opened",
    "_rule",
    "unknown_settings",
    "_alone",
    "_back_up",
    "_identities",
    "_known_key",
    "_mounted",
    "_require_database",
    "_restore",
    "_settings",
    "_stand_back",
    "_verify",
    "_repair",
    "_donor",
    "_follow",
    "_release",
    "_show_status",
    "serve",
    "bundle",
    "_sign_in_path",
}
"""Called by a function that has checked."""


@pytest.mark.parametrize("text", ["2026-11-22T10:00:00Z", "2026-11-22T10:00:00.1234567+00:00", "2026-11-22t10:00:00z"])
def test_times_are_read_on_any_python(text: str) -> None:
    assert signed_manifest.read_time(text).replace(microsecond=0) == datetime(2026, 11, 22, 10, tzinfo=UTC)


@pytest.mark.parametrize("text", ["", "2026-11-22", "2026-11-22T10:00:00", "2026-13-22T10:00:00Z", "20261122T100000Z"])
def test_invalid_time_is_refused(text: str) -> None:
    with pytest.raises(ValueError):
        signed_manifest.read_time(text)


def test_hooks_are_part_of_the_package() -> None:
    target = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]
    assert target["packages"] == ["app"]
    assert {p.name for p in (ROOT / "app" / "agent" / "hooks").iterdir() if p.is_file()} == {
        "__init__.py", "nav2.sh", "topological.sh",
    }  # fmt: skip


def test_systemd_unit_keeps_maps_readable() -> None:
    unit = (ROOT / "docker" / "fleetmap-agent.service").read_text()
    assert "\nStateDirectoryMode=0755\n" in unit
    assert "\nUser=" in unit
    assert "\nDynamicUser=" not in unit, "its state is below /var/lib/private, which nobody else may enter"


def test_announced_router_address_depends_on_request_host() -> None:
    from app.api.health import advertised_router

    assert advertised_router("", "tcp/127.0.0.1:7447", "127.0.0.1") == "tcp/127.0.0.1:7447"
    assert advertised_router("", "tcp/127.0.0.1:7447", "edge.local") == "", "nobody else reaches it there"
    assert (
        advertised_router("", "tcp/0.0.0.0:7447,tls/[::]:7448", "edge.local")
        == "tcp/edge.local:7447,tls/edge.local:7448"
    )
    assert advertised_router("", "tcp/0.0.0.0:7447", "::1") == "tcp/[::1]:7447"
    assert advertised_router("tcp/router.farm:7447", "tcp/0.0.0.0:1", "x") == "tcp/router.farm:7447"
    assert advertised_router("", "tcp/0.0.0.0:7447", "bad host\n") == ""
    assert advertised_router("", "", "x") == ""
