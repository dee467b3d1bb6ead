"""Help, completion, sizes with units and variables that nothing reads: all without a server."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from pydantic import ValidationError
from typer.main import get_command

from app.cli import completion, groups, variables
from app.cli.commands import ALIASES, PANELS, build, needed_command
from app.config import Settings
from app.setting_values import format_size, parse_size
from tests.cli.conftest import TOKEN, Fleetmap


@pytest.fixture(scope="module")
def everything() -> Any:
    return get_command(build())


def leaves(command: Any, path: str = "fleetmap") -> Iterator[tuple[str, Any]]:
    for name, inner in getattr(command, "commands", {}).items():
        yield f"{path} {name}", inner
        yield from leaves(inner, f"{path} {name}")


def test_every_command_has_help_with_an_example(everything: Any) -> None:
    for path, command in leaves(everything):
        if path == "fleetmap serve":
            command = get_command(build("serve")).commands["serve"]  # type: ignore[attr-defined]
        first = command.help.partition("\n\n")[0]
        assert first.endswith((".", "?")), (path, first)
        if not isinstance(command, groups.Group):
            assert "Example: `fleetmap " in command.help, path
        for parameter in command.params:
            text = getattr(parameter, "help", None)
            assert text, (path, parameter.name)
            assert text[0].isupper() or text.startswith(("viewer", "replace", "objects")), (path, text)


def test_every_command_is_in_a_panel_and_aliases_work(everything: Any) -> None:
    assert set(everything.commands) == {name for panel in PANELS.values() for name, _ in panel}
    assert list(everything.list_commands(None)) == [name for panel in PANELS.values() for name, _ in panel]
    for alias, name in ALIASES.items():
        assert everything_of(alias).help == everything_of(name).help
        assert everything_of(alias).hidden


@pytest.mark.parametrize(("columns", "expected"), [("60", 60), ("110", 110), ("300", groups.MAX_WIDTH)])
def test_help_is_as_wide_as_the_terminal(
    columns: str, expected: int, offline: Fleetmap, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    output = offline("--help").out
    assert max(map(len, output.splitlines())) == expected
    for panel in PANELS:
        assert panel[:50] in output
    output = offline("promote", "--help").out
    assert "[default: production]" in " ".join(output.replace("│", " ").split()), "brackets are no markup"


def test_only_requested_command_is_built(monkeypatch: pytest.MonkeyPatch) -> None:
    assert needed_command(["--json", "robots", "list"]) == "robots"
    assert needed_command(["--help"]) is None
    assert list(get_command(build("robots")).commands) == ["robots"]  # type: ignore[attr-defined]
    assert len(get_command(build("rbots")).commands) > 20, "to propose a name"  # type: ignore[attr-defined]
    monkeypatch.setenv("_FLEETMAP_COMPLETE", "complete_bash")
    for typed, only in (("fleetmap export fa", "export"), ("fleetmap ex", None), ("fleetmap export ", "export")):
        monkeypatch.setenv("COMP_WORDS", typed)
        assert needed_command([]) == only


@pytest.mark.parametrize(
    ("text", "size"),
    [
        ("1048576", 2**20),
        ("512MiB", 512 * 2**20),
        ("2GB", 2_000_000_000),
        ("1.5 GiB", 3 * 2**29),
        ("64kib", 2**16),
        ("7B", 7),
        ("0", 0),
    ],
)
def test_sizes_have_units(text: str, size: int) -> None:
    assert parse_size(text) == size
    assert parse_size(format_size(size)) == size


def test_settings_take_sizes_with_units(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FLEETMAP_MAX_UPLOAD_BYTES", "2GB")
    settings = Settings(cache_bytes="1GiB")  # type: ignore[arg-type]
    assert (settings.max_upload_bytes, settings.cache_bytes) == (2_000_000_000, 2**30)
    assert settings.limits.upload_bytes == 2_000_000_000
    for wrong in ("2G", "many", "-1", "0.5", "1e9", ""):
        with pytest.raises(ValidationError, match=r"size in bytes|whole number"):
            Settings(cache_bytes=wrong)  # type: ignore[arg-type]


def test_unknown_variables_raise_warnings(offline: Fleetmap, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FLEETMAP_MAX_UPLOAD_BYTE", "1")
    monkeypatch.setenv("FLEETMAP_TOKEN", "a client's")
    monkeypatch.setenv("FLEETMAP_NAV2_GRID", "a hook's")
    (tmp_path / ".env").write_text("# FLEETMAP_COMMENT=1\nexport FLEETMAP_WORKRS=2\nOTHER=1\nFLEETMAP_PORT=8000\n")
    result = offline("migrate", "--data-dir", tmp_path / "data")
    assert result.status == 0
    assert result.err.splitlines() == [
        "warning: unknown setting FLEETMAP_MAX_UPLOAD_BYTE (did you mean FLEETMAP_MAX_UPLOAD_BYTES?); it has no effect",
        "warning: unknown setting FLEETMAP_WORKRS (did you mean FLEETMAP_WORKERS?); it has no effect",
    ]
    monkeypatch.setenv("FLEETMAP_TOKN", "x")
    result = offline("robots", "--server", "http://127.0.0.1:9")
    assert "did you mean FLEETMAP_TOKEN?" in result.err
    assert "FLEETMAP_MAX_UPLOAD_BYTE" not in result.err, "a client does not know the server's settings"


def test_accepted_variables_match_settings_and_options(everything: Any) -> None:
    read = {p.envvar for _, command in leaves(everything) for p in command.params if getattr(p, "envvar", None)}
    assert read <= variables.CLIENT | variables.AGENT


def test_names_are_completed_from_the_server(server: str, fleetmap: Fleetmap, monkeypatch: pytest.MonkeyPatch) -> None:
    assert fleetmap("generate", "office", "-e", "completed", "--create").status == 0
    assert fleetmap("promote", "completed", "1").status == 0

    def complete(typed: str, address: str = server) -> set[str]:
        clean = {name: value for name, value in os.environ.items() if not name.startswith("FLEETMAP_")}
        variables = {"FLEETMAP_SERVER": address, "FLEETMAP_TOKEN": TOKEN, "_FLEETMAP_COMPLETE": "complete_bash"}
        words = {"COMP_WORDS": typed, "COMP_CWORD": str(len(typed.split(" ")) - 1)}
        process = subprocess.run(
            [sys.executable, "-m", "app.cli"],
            env={**clean, **variables, **words},
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        assert process.stderr == ""
        return set(process.stdout.split())

    assert complete("fleetmap export comp") == {"completed"}
    assert {"tmap2", "tmap"} <= complete("fleetmap export completed tm")
    assert complete("fleetmap overlays acc") == {"accept"}
    assert complete("fleetmap export comp", "http://127.0.0.1:9") == set()
    context = typer.Context(everything_of("promote"))
    context.params = {"environment": "completed", "server": server, "token": TOKEN}
    assert completion.versions(context) == ["latest", "production"]
    assert completion.channels(context) == ["production"]
    assert {"ground", "L2"} <= set(completion.levels(context))
    assert "map" in completion.grids(context)
    assert "orchard" in dict(completion.generators(context))
    assert "occupancy_to_topology" in dict(completion.derivations(context))
    context.params["token"] = "wrong"
    assert completion.environments(context) == []
    context.params = {"server": server}
    assert completion.channels(context) == [], "no environment is named yet"


def everything_of(name: str) -> Any:
    return get_command(build(name)).commands[name]  # type: ignore[attr-defined]
