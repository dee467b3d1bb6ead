"""The agent installs and runs without the server's packages."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tests.agent.conftest import ROOT, Start
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
    absent -= {"pydantic"}  # newer releases of typer bring it along
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


def test_the_base_is_small() -> None:
    assert names(PROJECT["dependencies"]) == {
        "typer", "rich", "httpx", "eclipse-zenoh", "cryptography", "backports-zstd",
    }  # fmt: skip
    assert {"fastapi", "sqlalchemy", "scipy", "opencv-python-headless", "numpy"} <= names(
        PROJECT["optional-dependencies"]["server"]
    )


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["agent", "--help"], ["promote", "--help"]])
def test_help_needs_no_server(arguments: list[str]) -> None:
    told = without_server(*arguments)
    assert told.returncode == 0, told.stderr


def test_a_robot_syncs_without_the_server_packages(api: Api, place: str, tmp_path: Path) -> None:
    told = without_server("agent", "-s", api.url, "-e", place, "-f", "tmap2", "--into", str(tmp_path / "r"), "--once")
    assert told.returncode == 0, told.stderr
    assert whole_map(tmp_path / "r")["version"] == 1


@pytest.mark.parametrize("arguments", [["serve"], ["migrate"]])
def test_other_commands_say_what_to_install(arguments: list[str], tmp_path: Path) -> None:
    told = without_server(*arguments)
    assert told.returncode == 1
    assert 'pip install "fleet-map-server[server]"' in told.stderr, told.stderr


def test_hooks_are_part_of_the_package() -> None:
    target = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]
    assert target["packages"] == ["app"]
    assert {p.name for p in (ROOT / "app" / "agent" / "hooks").glob("*.sh")} == {"nav2.sh", "topological.sh"}


def test_the_unit_keeps_the_maps_where_the_robot_can_read_them() -> None:
    unit = (ROOT / "docker" / "fleetmap-agent.service").read_text()
    assert "\nStateDirectoryMode=0755\n" in unit
    assert "\nUser=" in unit
    assert "\nDynamicUser=" not in unit, "its state is below /var/lib/private, which nobody else may enter"


def test_router_addresses_are_told_for_who_asks() -> None:
    from app.api.health import router_for

    assert router_for("", "tcp/127.0.0.1:7447", "127.0.0.1") == "tcp/127.0.0.1:7447"
    assert router_for("", "tcp/127.0.0.1:7447", "edge.local") == "", "nobody else reaches it there"
    assert router_for("", "tcp/0.0.0.0:7447,tls/[::]:7448", "edge.local") == "tcp/edge.local:7447,tls/edge.local:7448"
    assert router_for("", "tcp/0.0.0.0:7447", "::1") == "tcp/[::1]:7447"
    assert router_for("tcp/router.farm:7447", "tcp/0.0.0.0:1", "x") == "tcp/router.farm:7447"
    assert router_for("", "tcp/0.0.0.0:7447", "bad host\n") == ""
    assert router_for("", "", "x") == ""


def test_the_three_commands_of_the_readme(api: Api, robot: Start, tmp_path: Path) -> None:
    from tests.cli.test_readme import blocks

    section = blocks("A robot follows a change in three commands")[0]
    kml = (ROOT / "README.md").read_text().split("<<'KML'\n")[1].split("\nKML\n")[0]
    (tmp_path / "network.kml").write_text(kml)
    datum = {"latitude": 53.2686, "longitude": -0.5245}
    api.post("environments", {"name": "my-farm", "datum": datum})
    api.upload("my-farm", {"network.kml": kml.encode()}, layer="topology")
    section = section.replace("# 2.", "until grep -q 'version 2' said 2> /dev/null; do sleep 0.1; done\n# 2.")
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "fleetmap").write_text(f'#!/bin/sh\nexec {sys.executable} -m app.cli "$@"\n')
    (tmp_path / "bin" / "fleetmap").chmod(0o755)
    script = f"""
        set -euo pipefail
        {section}
        for n in $(seq 150); do [ -s said ] && grep -q 'version 3' said && break; sleep 0.1; done
        kill $!; wait
        """
    told = subprocess.run(
        ["bash", "-c", script],
        cwd=tmp_path,
        env={
            "PATH": f"{tmp_path}/bin:/usr/bin:/bin",
            "PYTHONPATH": str(ROOT),
            "FLEETMAP_SERVER": api.url,
            "FLEETMAP_TOKEN": ADMIN,
            "HOME": str(tmp_path),
        },
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert "version 3: objects topology" in (tmp_path / "said").read_text(), told.stdout + told.stderr
    assert whole_map(tmp_path / "maps")["version"] == 3
