"""``fleetmap verify`` beside a running server: what it finds, what it heals, from where, and with which exit status."""

from __future__ import annotations

import contextlib
import io
import json
import sqlite3
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from app.cli import run
from tests.api import samples
from tests.api.conftest import ADMIN, Api, running, settings_for

NETWORK = {"n.tmap2.yaml": samples.tmap2()}
MOVED = {"n.tmap2.yaml": samples.tmap2({"gate": (0.0, 0.0), "barn": (12.0, 0.0), "field": (10.0, 8.0)})}


def zipped(files: dict[str, bytes]) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return out.getvalue()


ARCHIVE = {"site.zip": zipped({"notes.txt": b"n" * 70_000, "datum.yaml": samples.DATUM})}
UPLOADS = (NETWORK, MOVED, ARCHIVE)


def upload_all(api: Api) -> None:
    api.post("environments", {"name": "farm"})
    for files in UPLOADS:
        api.upload("farm", files)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Api, Path]]:
    """A server whose data is damaged, and healed by the end of each test."""
    folder = tmp_path_factory.mktemp("verified")
    with running(settings_for(folder, memory_cache_bytes=0, scrub_hours=0)) as api:
        upload_all(api)
        yield api, folder


@pytest.fixture(scope="module")
def other(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Api, Path]]:
    """Another server that was given the same uploads."""
    folder = tmp_path_factory.mktemp("replica")
    with running(settings_for(folder, scrub_hours=0)) as api:
        upload_all(api)
        yield api, folder


def verify(folder: Path, capfd: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, Any]:
    capfd.readouterr()
    status = run(["verify", "--data-dir", str(folder), "--json", *arguments])
    return status, json.loads(capfd.readouterr().out)


def damage_chunks(api: Api, folder: Path) -> None:
    with contextlib.closing(sqlite3.connect(folder / "fleetmap.sqlite3", timeout=30)) as database, database:
        database.execute("DELETE FROM chunk WHERE rowid % 3 = 0")
        database.execute("UPDATE chunk SET data = zeroblob(length(data)) WHERE rowid % 3 = 1")
    api.app.state.services.store.chunks.forget()


def damage_blobs(folder: Path) -> None:
    for path in (folder / "blobs").rglob("*"):
        if path.is_file() and len(path.name.split(".")[0]) == 64:
            path.write_bytes(bytes(path.stat().st_size))


def answers(api: Api) -> list[bytes]:
    place = "environments/farm/versions"
    addresses = [f"{place}/{v}/maps/{f}" for v in (1, 2, 3) for f in ("tmap2", "geojson")]
    addresses += [f"{place}/{v}/sources/{name}" for v, files in enumerate(UPLOADS, 1) for name in files]
    return [api.get(address).content for address in addresses]


def test_verify_lists_damage_and_changes_nothing(server: tuple[Api, Path], capfd: pytest.CaptureFixture[str]) -> None:
    api, folder = server
    good = answers(api)
    status, report = verify(folder, capfd)
    assert (status, report["ok"], report["findings"]) == (0, True, [])
    assert report["checked"]["version"] == 4
    assert report["checked"]["cache"] > 0
    damage_chunks(api, folder)
    for _ in range(2):
        status, report = verify(folder, capfd)
        assert (status, report["ok"]) == (1, False)
        assert {f["problem"] for f in report["findings"]} == {"lost", "damaged"}
        assert {v["version"] for f in report["findings"] for v in f["versions"]} == {1, 2, 3}
    assert run(["verify", "--data-dir", str(folder)]) == 1
    text = capfd.readouterr().out
    assert "farm 1" in text
    assert "fleetmap verify --repair" in text
    # The uploads are read again, by the reader that made the chunks.
    status, report = verify(folder, capfd, "--repair")
    assert status == 0, report
    assert {f["repaired_from"].rpartition(" ")[0] for f in report["findings"]} == {"the uploads of farm"}
    for path in (folder / "cache").glob("??/*/map.json"):
        path.unlink()
    api.app.state.services.response_cache._entries.clear()
    assert answers(api) == good
    assert verify(folder, capfd)[0] == 0


def test_verify_repairs_files_from_originals_and_archives(
    server: tuple[Api, Path], capfd: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    api, folder = server
    good = answers(api)
    damage_blobs(folder)
    status, report = verify(folder, capfd, "--repair")
    assert status == 1
    assert not any(f["repaired_from"] for f in report["findings"])
    originals = tmp_path / "anywhere" / "deep"
    originals.mkdir(parents=True)
    (originals / "of-another-name").write_bytes(ARCHIVE["site.zip"])
    status, report = verify(folder, capfd, "--repair", "--from", str(tmp_path))
    assert status == 1
    healed = [f["repaired_from"] for f in report["findings"] if f["repaired_from"]]
    assert sorted(healed) == [str(tmp_path), "the uploads of farm 3", "the uploads of farm 3"], "and its members"
    for number, files in enumerate((NETWORK, MOVED)):
        (originals / str(number)).write_bytes(next(iter(files.values())))
    assert verify(folder, capfd, "--repair", "--from", str(tmp_path))[0] == 0
    assert answers(api) == good
    assert run(["verify", "--data-dir", str(folder), "--from", str(tmp_path)]) == 2, "--from needs --repair"


@pytest.mark.parametrize("how", ["folder", "address"])
def test_verify_repairs_everything_from_replica(
    server: tuple[Api, Path], other: tuple[Api, Path], capfd: pytest.CaptureFixture[str], how: str
) -> None:
    api, folder = server
    good = answers(api)
    damage_blobs(folder)
    damage_chunks(api, folder)
    place = str(other[1]) if how == "folder" else other[0].url
    status, report = verify(folder, capfd, "--repair", "--from", place, "--token", ADMIN)
    assert status == 0, report
    assert {f["repaired_from"] for f in report["findings"]} == {place}
    api.app.state.services.response_cache._entries.clear()
    assert answers(api) == good


def test_large_stored_files_are_streamed(other: tuple[Api, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    api, folder = other
    blobs = api.app.state.services.store.blobs
    data = bytes(range(256)) * 2**13
    name = blobs.put(data)
    monkeypatch.setattr("app.api.stored.IN_MEMORY", len(data) - 1)
    monkeypatch.setattr(blobs, "get", None)  # nothing reads it as a whole
    got = api.get(f"stored/blobs/{name}")
    assert (got.content, got.headers["content-type"]) == (data, "application/octet-stream")
    assert int(got.headers["content-length"]) == len(data)
    path = next(folder.rglob(f"{name}*"))
    path.write_bytes(data[:-1] + b"?")
    api.problem("GET", f"stored/blobs/{name}", 404)


def test_stored_bytes_are_for_administrators(other: tuple[Api, Path]) -> None:
    api, _ = other
    (source,) = api.get("environments/farm/versions/1/sources").json()
    address = f"stored/blobs/{source['sha256']}"
    assert api.get(address).content == NETWORK["n.tmap2.yaml"]
    for kind in ("blobs", "chunks"):
        api.problem("GET", f"stored/{kind}/{'0' * 64}", 404)
    api.token_for("editor").problem("GET", address, 403)
    api.token_for("admin", environments="farm").problem("GET", address, 403)
