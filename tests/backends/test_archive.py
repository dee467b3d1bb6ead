"""Backup in a single file: it has its name once it is complete and durable, and leaves nothing if it fails."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from app.backends import blobs
from app.backends.archive_file import PART, ArchiveFiles


def test_name_of_a_complete_archive_is_durable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The folder is synced after the archive got its name, or a power cut would take it away again."""
    place = tmp_path / "farm.tar"
    names: list[list[str]] = []
    sync = os.fsync

    def note(descriptor: int) -> None:
        sync(descriptor)
        if os.path.samestat(os.fstat(descriptor), tmp_path.stat()):
            names.append(sorted(path.name for path in tmp_path.glob("*.tar*")))

    monkeypatch.setattr(blobs.os, "fsync", note)
    archive = ArchiveFiles(place, tmp_path / "scratch", new=True)
    archive.write({"packs/one": b"1"})
    archive.finish()
    assert names[-1] == ["farm.tar"]


def test_archive_that_fills_the_disk_is_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its end cannot be written either."""
    archive = ArchiveFiles(tmp_path / "farm.tar", tmp_path / "scratch", new=True)
    archive.write({"packs/one": b"1"})
    opened = archive._archive
    assert opened is not None
    close = opened.close

    def fail() -> None:
        close()
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(opened, "close", fail)
    archive.discard()
    assert not (tmp_path / f"farm.tar{PART}").exists()
