"""The shell blocks of README and docs work as they are pasted.

In docs, each block fenced with ``sh`` is run, page by page. ``console`` fences commands that need more than tests have
(a robot, ROS 2, Docker, certificates). In the README, the blocks of the sections in ``README_SECTIONS`` are run.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.cli.conftest import ServerProcess
from tests.ports import free_port
from tests.preloaded import preloaded_command

ROOT = Path(__file__).resolve().parents[2]
README_SECTIONS = ("Tour",)
TUTORIALS = ("tutorials/first-environment.md", "tutorials/first-robot.md")
"""In the order in which a reader does them: each goes on where the one before it ended."""

ADDRESS = "http://127.0.0.1:8000"
TOOLS = ("bash", "curl")
SECONDS = 280


def blocks(text: str) -> list[str]:
    """The bodies of the ``sh`` blocks of a Markdown text, in order."""
    return re.findall(r"^```sh\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


def read(page: str) -> str:
    """A page of docs."""
    return (ROOT / "docs" / page).read_text()


def pages_with_commands() -> list[str]:
    """Pages of docs with ``sh`` blocks, apart from the tutorials."""
    docs = ROOT / "docs"
    names = (str(path.relative_to(docs)) for path in sorted(docs.rglob("*.md")) if blocks(path.read_text()))
    return [page for page in names if page not in TUTORIALS]


class Place:
    """A folder in which a demo server runs, as after ``make run``, with ``fleetmap`` in its ``.venv``.

    Of the checkout it also has ``docker``, in which pages create secrets.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        binaries = folder / ".venv" / "bin"
        binaries.mkdir(parents=True)
        (binaries / "activate").write_text(f'PATH="{binaries}:$PATH"\n')
        shutil.copytree(ROOT / "docker", folder / "docker", ignore=shutil.ignore_patterns("secrets", ".env"))
        (folder / "app").symlink_to(ROOT / "app")
        self.server = ServerProcess(
            "--demo",
            environment={
                "FLEETMAP_ZENOH_MODE": "router",
                "FLEETMAP_ZENOH_LISTEN": f"tcp/127.0.0.1:{free_port()}",
            },
            folder=folder,
        )

    def run(self, commands: str) -> str:
        """Paste commands into a shell in the folder; what they printed. Fails where one of them fails."""
        script = """
            set -euo pipefail
            trap 'kill $(jobs -p) 2>/dev/null || true' EXIT
            curl() { command curl --no-progress-meter --fail-with-body "$@"; echo; }
            . .venv/bin/activate
            """
        script += commands.replace(ADDRESS, self.server.address)
        clean = {name: value for name, value in os.environ.items() if not name.startswith("FLEETMAP_")}
        done = subprocess.run(
            ["bash", "-c", script],
            cwd=self.folder,
            env={**clean, "COLUMNS": "200"},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=SECONDS,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Place]:
    for tool in TOOLS:
        if shutil.which(tool) is None:
            (pytest.fail if os.environ.get("CI") else pytest.skip)(f"{tool} is not installed")
    place = Place(tmp_path_factory.mktemp("place"))
    try:
        place.server.ready()
        place.server.wait_for("administrator's token")
        with preloaded_command(place.folder / ".venv" / "bin" / "fleetmap", {"PYTHONPATH": str(ROOT)}):
            yield place
    finally:
        place.server.stop()


def test_tutorials_work_as_pasted(place: Place) -> None:
    output = place.run("\n".join(block for page in TUTORIALS for block in blocks(read(page))))
    assert "my-farm: version 2\n" in output
    assert "versions 2 → 3: objects 1 changed; topology 6 changed" in output, "the tutorial shows these lines"
    assert "my-farm: version 4 has the content of version 2" in output
    assert re.search(r"^production +3 .*1 of 1", output, re.MULTILINE)
    assert '"edge": "Lane/0_Lane/1"' in output
    assert (place.folder / "maps" / "current").readlink().name.startswith("2-")


@pytest.mark.parametrize("page", pages_with_commands())
def test_commands_of_page_work_as_pasted(page: str, place: Place) -> None:
    login = f"export FLEETMAP_SERVER={ADDRESS} FLEETMAP_TOKEN=$(cat data/demo-token)\n"
    place.run(login + "\n".join(blocks(read(page))))


def test_readme_works_as_pasted(place: Place) -> None:
    readme = (ROOT / "README.md").read_text()
    pasted = ""
    for heading in README_SECTIONS:
        _, separator, after = readme.partition(f"\n## {heading}\n")
        assert separator, f"README.md has no section {heading!r}: name the sections to run in README_SECTIONS"
        pasted += "\n".join(blocks(after.split("\n## ")[0]))
    assert ADDRESS in pasted
    output = place.run(pasted.replace("my-farm", "readme-farm"))
    assert "readme-farm" in output
    assert "image:" in (place.folder / "grid" / "map.yaml").read_text()
    assert "edge_id" in (place.folder / "network.tmap2.yaml").read_text()
    assert "<Placemark>" in (place.folder / "readme-farm.kml").read_text()
    assert (place.folder / "robot" / "current" / "tmap2" / "network.tmap2.yaml").is_file()
