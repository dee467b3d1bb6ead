"""Made maps on disk, keyed by content: one of many askers makes a map, all others wait for it.

A map is a folder ``<key[:2]>/<key>`` with its files and ``map.json``; it appears by a rename, so it is whole or absent.
A file lock for each key holds across worker processes of the server.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from uuid import uuid4

import orjson

FRESH_SECONDS = 60.0
"""A map is marked as used at most this often: its age decides what goes when room is needed."""


@dataclass(frozen=True, slots=True)
class MadeFile:
    """One file of a made map, on disk. place: the level and name of the part that it is of, in a map of several."""

    name: str
    size: int
    sha256: str
    media_type: str
    path: Path
    place: tuple[str, str] | None = None


@dataclass(frozen=True, slots=True)
class Made:
    """A made map: its files (main file first), the one thing to download, the report; fresh: made just now."""

    files: tuple[MadeFile, ...]
    archive: MadeFile | None
    report: dict[str, Any]
    fresh: bool = field(default=False, compare=False)

    def whole(self) -> MadeFile:
        """The file itself where the map is one file, else the zip of all."""
        return self.archive or self.files[0]

    def file(self, name: str) -> MadeFile | None:
        """One file by its name."""
        return next((f for f in self.files if f.name == name), None)


@dataclass(frozen=True, slots=True)
class Product:
    """What a maker returns: content by name with media types, an archive of it where there are several, the report.

    A path instead of bytes is a file on the cache's disk, which is linked. places: see ``MadeFile.place``.
    """

    files: dict[str, tuple[bytes | Path, str]]
    archive: tuple[str, bytes] | None
    report: dict[str, Any]
    places: Mapping[str, tuple[str, str]] = field(default_factory=dict)


ABANDONED_SECONDS = 3600.0
"""A map in the making that nobody touched for so long was left by a killed process."""


class Cache:
    """At most ``limit`` bytes of made maps; the longest unused go first."""

    def __init__(self, folder: Path, limit: int) -> None:
        self._folder, self._limit = folder, limit
        self._locks: dict[str, threading.Lock] = {}
        self._guard = threading.Lock()
        self.hits = self.misses = 0
        (folder / "locks").mkdir(parents=True, exist_ok=True)
        for old in folder.glob("making-*"):
            with contextlib.suppress(OSError):
                if time.time() - old.stat().st_mtime > ABANDONED_SECONDS:
                    shutil.rmtree(old, ignore_errors=True)
        self._total = sum(size for _, size, _ in self._entries())

    def get(self, key: str) -> Made | None:
        """The map, if it is made."""
        folder = self._path(key)
        try:
            described = orjson.loads((folder / "map.json").read_bytes())
            if time.time() - folder.stat().st_mtime > FRESH_SECONDS:
                os.utime(folder)
        except (OSError, orjson.JSONDecodeError):
            return None
        files = tuple(_described(folder, f) for f in described["files"])
        archive = _described(folder, described["archive"]) if described["archive"] else None
        return Made(files, archive, described["report"])

    def get_or_make(self, key: str, maker: Callable[[], Product]) -> Made:
        """The map; made now if nobody has, and then by one caller only."""
        found = self.get(key)
        if found is not None:
            self.hits += 1
            return found
        with self._only(key):
            found = self.get(key)
            if found is not None:
                self.hits += 1
                return found
            self.misses += 1
            return replace(self._store(key, maker()), fresh=True)

    @contextlib.contextmanager
    def holding(self) -> Iterator[Callable[[Made], Made]]:
        """A function that keeps a made map's files until the block ends, whatever room the cache needs meanwhile.

        It raises FileNotFoundError where they are gone already.
        """
        folder = self._folder / f"making-{uuid4().hex}"
        folder.mkdir()
        count = 0

        def hold(made: Made) -> Made:
            nonlocal count
            files = []
            for file in made.files:
                count += 1
                _link(file.path, folder / str(count))
                files.append(replace(file, path=folder / str(count)))
            return replace(made, files=tuple(files), archive=None)

        try:
            yield hold
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def _store(self, key: str, product: Product) -> Made:
        making = self._folder / f"making-{uuid4().hex}"
        making.mkdir()
        try:
            files = [_write(making, str(k), name, *content) for k, (name, content) in enumerate(product.files.items())]
            files = [{**f, "place": product.places[f["name"]]} if f["name"] in product.places else f for f in files]
            archive = _write(making, "whole", *product.archive, "application/zip") if product.archive else None
            described = {"files": files, "archive": archive, "report": product.report}
            (making / "map.json").write_bytes(orjson.dumps(described))
            target = self._path(key)
            target.parent.mkdir(exist_ok=True)
            with contextlib.suppress(OSError):  # another host on the same disk may have been first: equal bytes
                making.rename(target)
        finally:
            shutil.rmtree(making, ignore_errors=True)
        made = self.get(key)
        if made is None:
            raise OSError(f"the cache folder {self._folder} does not keep what is written to it")
        for file in (*made.files, *([made.archive] if made.archive else [])):
            self._note_hash(file)
        self._total += sum(f.size for f in made.files) + (made.archive.size if made.archive else 0)
        if self._total > self._limit:
            self._make_room()
        return made

    def by_hash(self, sha256: str, most: int) -> bytes | None:
        """The content of a made file that is still here, by its SHA-256; None where it is gone or larger."""
        try:
            path = self._folder / self._hash_path(sha256).read_text()
            if path.stat().st_size > most:
                return None
            data = path.read_bytes()
        except OSError:
            return None
        return data if hashlib.sha256(data).hexdigest() == sha256 else None

    def _note_hash(self, file: MadeFile) -> None:
        path = self._hash_path(file.sha256)
        with contextlib.suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            temporary = path.with_suffix(f".{uuid4().hex}")
            temporary.write_text(file.path.relative_to(self._folder).as_posix())
            temporary.replace(path)

    def _hash_path(self, sha256: str) -> Path:
        return self._folder / "hashes" / sha256[:2] / sha256

    def _make_room(self) -> None:
        """Called when there is too much; other processes may be doing the same, which does no harm."""
        entries = sorted(self._entries())
        total = sum(size for _, size, _ in entries)
        for _, size, folder in entries[:-1]:  # the newest stays, whatever its size
            if total <= self._limit:
                break
            for line in self._described_hashes(folder):
                self._hash_path(line).unlink(missing_ok=True)
            shutil.rmtree(folder, ignore_errors=True)
            total -= size
        self._total = total

    def _described_hashes(self, folder: Path) -> list[str]:
        """The hashes that lead to this folder."""
        try:
            described = orjson.loads((folder / "map.json").read_bytes())
            every = [*described["files"], *([described["archive"]] if described["archive"] else [])]
            place = folder.relative_to(self._folder).as_posix() + "/"
            return [f["sha256"] for f in every if self._hash_path(f["sha256"]).read_text().startswith(place)]
        except (OSError, orjson.JSONDecodeError, KeyError):
            return []

    def _entries(self) -> list[tuple[float, int, Path]]:
        """Each made map: when it was last used, its size, its folder."""
        out = []
        for folder in self._folder.glob("[0-9a-f][0-9a-f]/*"):
            with contextlib.suppress(OSError):
                out.append((folder.stat().st_mtime, sum(f.stat().st_size for f in folder.iterdir()), folder))
        return out

    @contextlib.contextmanager
    def _only(self, key: str) -> Iterator[None]:
        """One caller at a time for a key, among threads and processes."""
        with self._guard:
            lock = self._locks.setdefault(key, threading.Lock())
        with lock:
            path = self._folder / "locks" / key[:2]  # few files; neighbours in the hash wait for each other, rarely
            with path.open("w") as handle:
                fcntl.flock(handle, fcntl.LOCK_EX)
                yield
        with self._guard:
            if not lock.locked():
                self._locks.pop(key, None)

    def _path(self, key: str) -> Path:
        return self._folder / key[:2] / key


def _write(folder: Path, stored: str, name: str, data: bytes | Path, media_type: str) -> dict[str, Any]:
    target = folder / stored
    if isinstance(data, Path):
        _link(data, target)
        with target.open("rb") as stream:
            digest = hashlib.file_digest(stream, "sha256").hexdigest()
    else:
        target.write_bytes(data)
        digest = hashlib.sha256(data).hexdigest()
    size = target.stat().st_size
    return {"name": name, "stored": stored, "size": size, "sha256": digest, "media_type": media_type}


def _link(source: Path, target: Path) -> None:
    """A second name of a file, or a copy where the file system has no such thing. FileNotFoundError as usual."""
    try:
        target.hardlink_to(source)
    except FileNotFoundError:
        raise
    except OSError:
        shutil.copyfile(source, target)


def _described(folder: Path, f: dict[str, Any]) -> MadeFile:
    level, name = f.get("place") or (None, None)
    place = None if level is None or name is None else (level, name)
    return MadeFile(f["name"], f["size"], f["sha256"], f["media_type"], folder / f["stored"], place)
