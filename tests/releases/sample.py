"""What every release leaves behind for its successors, and how it is read.

``data.zip`` is a data folder: database, files, keys (made for this sample, they sign nothing else). ``facts.json`` has
what the release answered from it. ``agent.json`` is what its agent and its server said to each other.
"""

from __future__ import annotations

import base64
import hashlib
import json
import shutil
import zipfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tests.api.conftest import Api

FOLDER = Path(__file__).with_name("published")
MAX_BYTES = 200_000
FORMATS = ("tmap2", "geojson", "nav2_route", "occupancy_grid?level=*&grid=*", "kml", "datum", "openrmf", "lif")
FILES = ("fleetmap.sqlite3", "blobs", "keys", "links.json")
"""Parts of a data folder that outlive an upgrade; caches do not."""


@dataclass(frozen=True)
class Exchange:
    """One request of an agent and its answer. Bodies are in base64. phase: of the session, see ``write``."""

    phase: str
    method: str
    path: str
    headers: dict[str, str]
    content: str
    status: int
    answer_headers: dict[str, str]
    body: str

    @property
    def data(self) -> bytes:
        """Bytes of the answer."""
        return base64.b64decode(self.body)


@dataclass(frozen=True)
class ReleaseSample:
    """Sample of one release."""

    version: str
    folder: Path

    @property
    def facts(self) -> dict[str, Any]:
        """Versions, maps, channels and so on, as the release answered."""
        out: dict[str, Any] = json.loads((self.folder / "facts.json").read_text())
        return out

    @property
    def exchanges(self) -> list[Exchange]:
        """What the agent and the server said, in order."""
        return [Exchange(**line) for line in json.loads((self.folder / "agent.json").read_text())]

    def unpack(self, into: Path) -> None:
        """Write the data folder."""
        with zipfile.ZipFile(self.folder / "data.zip") as archive:
            archive.extractall(into)


def all_samples() -> list[ReleaseSample]:
    """Return the samples of all releases, oldest first."""
    folders = [path for path in FOLDER.iterdir() if (path / "facts.json").is_file()]
    folders.sort(key=lambda path: tuple(map(int, path.name.split("."))))
    return [ReleaseSample(path.name, path) for path in folders]


def store(version: str, data_dir: Path, facts: dict[str, Any], exchanges: list[Exchange]) -> int:
    """Write a sample; returns its size in bytes. The same content gives the same archive."""
    folder = FOLDER / version
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    with zipfile.ZipFile(folder / "data.zip", "w", zipfile.ZIP_LZMA) as archive:
        for name in FILES:
            path = data_dir / name
            for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
                if file.is_file() and not file.name.startswith("."):
                    entry = zipfile.ZipInfo(file.relative_to(data_dir).as_posix(), (2026, 1, 1, 0, 0, 0))
                    archive.writestr(entry, file.read_bytes(), zipfile.ZIP_LZMA)
    (folder / "facts.json").write_text(json.dumps(facts, indent=1, sort_keys=True) + "\n")
    (folder / "agent.json").write_text(json.dumps([asdict(e) for e in exchanges], indent=1) + "\n")
    return sum(file.stat().st_size for file in folder.iterdir())


def read_facts(api: Api) -> dict[str, Any]:
    """Ask a server for everything that must stay as it is."""
    out: dict[str, Any] = {}
    for environment in api.get("environments?limit=100").json():
        name = environment["name"]
        path = f"environments/{name}"
        versions = {}
        for version in api.get(f"{path}/versions?limit=1000").json():
            number = version["version"]
            kept = ("root", "parent", "author", "message", "time", "tags", "changes", "thinned", "information")
            versions[str(number)] = {
                **{key: version.get(key) for key in kept},
                "sources": [
                    {**source, "data": _digest(api, f"{path}/versions/{number}/sources/{source['name']}")}
                    for source in version["sources"]
                ],
                "maps": {fmt: _digest(api, f"{path}/versions/{number}/maps/{fmt}") for fmt in FORMATS}
                if version.get("thinned") is None
                else {},
            }
        channels = api.get(f"{path}/channels").json()
        members = ("channel", "version", "root", "planned")
        out[name] = {
            "environment": {key: environment.get(key) for key in ("title", "description", "tags", "datum")},
            "versions": versions,
            "channels": [{key: channel.get(key) for key in members} for channel in channels],
            "robots": [
                {key: robot[key] for key in ("robot", "channel", "version", "root", "state")}
                for robot in api.get(f"robots?environment={name}").json()
            ],
            "overlays": [
                {key: overlay.get(key) for key in ("id", "kind", "state", "edge", "expires", "reporter")}
                for overlay in api.get(f"{path}/overlays").json()
            ],
            "drafts": [
                {key: draft[key] for key in ("name", "base", "changes")} for draft in api.get(f"{path}/drafts").json()
            ],
            "events": [e["type"] for e in _events(api, name)],
        }
    return out


def _events(api: Api, environment: str) -> list[dict[str, Any]]:
    text = api.get(f"events?environment={environment}&since=0&follow=false").text
    return [json.loads(line.removeprefix("data:")) for line in text.splitlines() if line.startswith("data:")]


def _digest(api: Api, path: str) -> str:
    """Hash an answer: bytes of a map or file, else the status."""
    answer = api.get(path, None)
    if answer.status_code != 200:
        return f"status {answer.status_code}"
    return hashlib.sha256(answer.content).hexdigest()
