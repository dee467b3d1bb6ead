"""Cache of converted maps on disk, keyed by content; concurrent callers for a key wait for one conversion.

A map is a folder ``<key[:2]>/<key>`` with its files and ``map.json``, whose first line is the hash of the rest. A
rename creates it atomically. A file lock per key works across worker processes of the server.

The disk is not trusted. A process hashes an entry on first use, and file content on every read (``CachedFile.read``); a
mismatch removes the entry and the map is converted again. So the fsync may run after the rename, in the background: an
entry left half-written by a power cut never passes the hash. If the disk cannot be written (full, read-only), maps are
still converted and kept in memory for a while.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import math
import os
import random
import shutil
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol
from uuid import uuid4

import orjson

from app.backends.blobs import sync
from app.backends.locks import file_lock
from app.backends.room import lacking_bytes
from app.convert.report import Report
from app.errors import BROKEN_STORAGE_ERRNOS, DISK_FULL_ERRNOS, Unavailable, system_reason

log = logging.getLogger(__name__)

FRESH_SECONDS = 60.0
"""Minimum seconds between two updates of an entry's last-use time, which orders eviction."""

MAX_MEMORY_BYTES = 64 * 2**20
"""Size limit in bytes of maps kept in memory after a failed write; the newest stays, whatever its size."""

MAX_CHECKED = 100_000
"""Maximum number of entries remembered as verified."""


class LostMap(Unavailable):
    """Cached map that was damaged or removed while it was read; a new request converts it again."""


@dataclass(frozen=True, slots=True)
class CachedFile:
    """One file of a cached map. place: level and name of its part, in a map of several parts.

    path: None if it is in memory (``data``), because it could not be written. on_damage: called with the reason.
    """

    name: str
    size: int
    sha256: str
    media_type: str
    path: Path | None
    place: tuple[str, str] | None = None
    data: bytes | None = field(default=None, compare=False, repr=False)
    on_damage: Callable[[str], None] = field(default=lambda _: None, compare=False, repr=False)

    def read(self) -> bytes:
        """Read the content and verify its hash. Raises LostMap if it is damaged or deleted."""
        if self.path is None:
            return self.data or b""
        try:
            data = self.path.read_bytes()
        except OSError as error:
            raise self.lost_error(error) from error
        self.check(hashlib.sha256(data).hexdigest())
        return data

    def check(self, sha256: str) -> None:
        """Raise LostMap if the content's hash differs from ``sha256``."""
        if sha256 != self.sha256:
            raise self.lost_error(None)

    def lost_error(self, error: OSError | None) -> LostMap:
        """Build the error for unreadable content (None: its hash differs), and report the damage."""
        if error is None:
            self.on_damage(f"{self.name!r} does not match its hash")
        elif error.errno in BROKEN_STORAGE_ERRNOS:  # not if the entry was merely evicted
            self.on_damage(f"{self.name!r} cannot be read: {system_reason(error)}")
        return LostMap(f"the cached file {self.name!r} was lost while it was read: request it again")


@dataclass(frozen=True, slots=True)
class CachedMap:
    """Cached map: files (main file first), archive, report. fresh: converted by this call."""

    files: tuple[CachedFile, ...]
    archive: CachedFile | None
    report: Report
    fresh: bool = field(default=False, compare=False)

    @property
    def size(self) -> int:
        """Total size of its files in bytes."""
        return sum(file.size for file in self.all_files())

    def all_files(self) -> tuple[CachedFile, ...]:
        """All files and their archive."""
        return (*self.files, *([self.archive] if self.archive else []))

    def single_file(self) -> CachedFile:
        """The map's only file, or the zip of all files."""
        return self.archive or self.files[0]

    def file(self, name: str) -> CachedFile | None:
        """Return the file with this name."""
        return next((f for f in self.files if f.name == name), None)


@dataclass(frozen=True, slots=True)
class ConvertedMap:
    """Result of a conversion: content by name, media types, an archive if there are several files, the report.

    A CachedFile instead of bytes is linked, if its content still matches its hash. places: see ``CachedFile.place``.
    """

    files: dict[str, tuple[bytes | CachedFile, str]]
    archive: tuple[str, bytes] | None
    report: Report
    places: Mapping[str, tuple[str, str]] = field(default_factory=dict)


STALE_AFTER_SECONDS = 3600.0
"""Age in seconds after which an unfinished entry counts as left behind by a killed process."""


class SharedMaps(Protocol):
    """Maps that several servers share."""

    def publish(self, key: str, cached_map: CachedMap) -> None:
        """Share a map that this server has made."""

    def load(self, key: str) -> ConvertedMap | None:
        """Get a map that any server has made."""

    def find(self, sha256: str, max_bytes: int) -> bytes | None:
        """Return a made file by its hash; None if there is none of at most ``max_bytes``."""


class Cache:
    """Cache of at most ``limit`` bytes that evicts the least recently used maps, and leaves the disk's reserve free.

    shared: the maps of all servers, which this folder is a cache of. damaged: number of damaged entries. on_damage:
    called for each. problem: why maps cannot be written to disk now, or None.
    """

    def __init__(self, folder: Path, limit: int, shared: SharedMaps | None = None) -> None:
        self._folder, self._limit, self._shared = folder, limit, shared
        self._locks: dict[str, threading.Lock] = {}
        self._guard = threading.Lock()
        self._checked: OrderedDict[str, tuple[int, int, int]] = OrderedDict()
        self._in_memory: OrderedDict[str, CachedMap] = OrderedDict()
        self._syncing: ThreadPoolExecutor | None = None
        self.hits = self.misses = self.damaged = 0
        self.on_damage: Callable[[], None] = lambda: None
        self.problem: str | None = None
        try:
            (folder / "locks").mkdir(parents=True, exist_ok=True)
        except OSError as error:
            self._note_problem(system_reason(error))
        for old in folder.glob("making-*"):
            with contextlib.suppress(OSError):
                if time.time() - old.stat().st_mtime > STALE_AFTER_SECONDS:
                    shutil.rmtree(old, ignore_errors=True)
        self._total = sum(size for _, size, _ in self._entries())

    @property
    def size(self) -> int:
        """Size of the entries on disk in bytes; what other processes have added is counted at the next eviction."""
        return self._total

    @property
    def limit(self) -> int:
        """Size limit on disk in bytes."""
        return self._limit

    def get(self, key: str) -> CachedMap | None:
        """Return the map if it is cached and intact."""
        cached_map = self._read_checked(key)
        if cached_map is not None:
            return cached_map
        with self._guard:
            return self._in_memory.get(key)

    def _read_checked(self, key: str) -> CachedMap | None:
        """Read the entry on disk; verify it on this process's first use and remove it if it is damaged."""
        entry = self._read_entry(key)
        if entry is None:
            return None
        cached_map, stamp = entry
        with self._guard:
            checked = self._checked.get(key) == stamp
        if not checked:
            try:
                _check_files(cached_map)
            except LostMap:
                return None
            self._mark_checked(key, stamp)
        with contextlib.suppress(OSError):
            folder = self._path(key)
            if time.time() - folder.stat().st_mtime > FRESH_SECONDS:
                os.utime(folder)
        return cached_map

    def _read_entry(self, key: str) -> tuple[CachedMap, tuple[int, int, int]] | None:
        """Read ``map.json`` and a stamp; None if it is absent, currently unreadable or damaged.

        The stamp changes if any file of the entry is written or deleted.
        """
        folder = self._path(key)
        try:
            with (folder / "map.json").open("rb") as file:
                status, raw = os.fstat(file.fileno()), file.read()
        except OSError as error:
            if error.errno in BROKEN_STORAGE_ERRNOS:
                self.discard(key, f"map.json cannot be read: {system_reason(error)}")
            return None
        line, _, text = raw.partition(b"\n")
        if line != hashlib.sha256(text).hexdigest().encode() or (described := orjson.loads(text))["key"] != key:
            earlier = raw.startswith(b"{")  # earlier releases wrote no hash
            self.discard(key, None if earlier else "map.json does not match its hash")
            return None
        damaged = partial(self.discard, key)
        files = tuple(_file_from_entry(folder, f, damaged) for f in described["files"])
        archive = _file_from_entry(folder, described["archive"], damaged) if described["archive"] else None
        cached_map = CachedMap(files, archive, Report.from_dict(described["report"]))
        times = [status.st_mtime_ns, *(_write_file(file) for file in cached_map.all_files())]
        return cached_map, (status.st_ino, min(times), max(times))

    def _mark_checked(self, key: str, stamp: tuple[int, int, int]) -> None:
        with self._guard:
            self._checked[key] = stamp
            while len(self._checked) > MAX_CHECKED:
                self._checked.popitem(last=False)

    def discard(self, key: str, reason: str | None) -> None:
        """Remove an entry that must not be served. reason: the damage; None if it is only outdated."""
        with self._guard:
            self._checked.pop(key, None)
        if reason is not None:
            self.damaged += 1
            self.on_damage()
            log.warning("cache: damaged map removed, it will be converted again (key=%s, reason=%s)", key[:16], reason)
        self._remove(self._path(key))

    def _remove(self, folder: Path) -> None:
        """Remove an entry atomically. On a read-only disk it stays, and is verified again."""
        away = self._folder / f"making-{uuid4().hex}"
        with contextlib.suppress(OSError):
            folder.rename(away)
        shutil.rmtree(away, ignore_errors=True)

    def stored_keys(self) -> list[str]:
        """List the keys of all entries on disk."""
        return sorted(folder.name for _, _, folder in self._entries())

    def check(self, key: str) -> tuple[int, bool]:
        """Verify an entry even if it was verified before; remove it if it is damaged.

        Returns the bytes read and whether it is intact.
        """
        before = self.damaged
        entry = self._read_entry(key)
        if entry is None:
            return 0, self.damaged == before
        cached_map, stamp = entry
        try:
            _check_files(cached_map)
        except LostMap:
            return 0, self.damaged == before
        self._mark_checked(key, stamp)
        return sum(f.size for f in cached_map.all_files()), True

    def sample(self, share: float) -> Iterator[tuple[str, int, bool]]:
        """Verify a random share of the entries. Yields (key, bytes read, whether it was intact)."""
        keys = self.stored_keys()
        for key in random.sample(keys, math.ceil(len(keys) * share)):
            yield key, *self.check(key)

    def get_or_make(self, key: str, maker: Callable[[], ConvertedMap], *, uses_cache: bool = False) -> CachedMap:
        """Return the map; if it is not cached, one caller converts it and the others wait.

        uses_cache: the maker gets other maps from this cache; their makers must not.
        """
        cached_map = self.get(key)
        if cached_map is not None:
            self.hits += 1
            return cached_map
        with self._key_lock(key, uses_cache=uses_cache):
            cached_map = self.get_or_fetch(key)
            if cached_map is not None:
                self.hits += 1
                return cached_map
            self.misses += 1
            cached_map = self._store(key, maker())
            if self._shared is not None:
                self._shared.publish(key, cached_map)
            return replace(cached_map, fresh=True)

    def get_or_fetch(self, key: str) -> CachedMap | None:
        """Return the map if it is cached, or if another server has made it."""
        cached_map = self.get(key)
        shared_map = self._shared.load(key) if cached_map is None and self._shared is not None else None
        return cached_map if shared_map is None else self._store(key, shared_map)

    @contextlib.contextmanager
    def hold_files(self) -> Iterator[Callable[[CachedMap], CachedMap]]:
        """Yield a function that protects a map's files from eviction until the block ends.

        It raises LostMap if they are already deleted.
        """
        folder: Path | None = self._folder / f"making-{uuid4().hex}"
        count = 0
        try:
            assert folder is not None
            folder.mkdir()
        except OSError as error:
            self._note_problem(system_reason(error))
            folder = None

        def hold(cached_map: CachedMap) -> CachedMap:
            nonlocal count
            files = []
            for file in cached_map.files:
                count += 1
                if file.path is None:
                    files.append(file)
                elif folder is None:
                    files.append(replace(file, path=None, data=file.read()))
                else:
                    try:
                        _link(file.path, folder / str(count))
                        files.append(replace(file, path=folder / str(count)))
                    except FileNotFoundError as error:
                        raise file.lost_error(error) from error
                    except OSError:  # disk full
                        files.append(replace(file, path=None, data=file.read()))
            return replace(cached_map, files=tuple(files), archive=None)

        try:
            yield hold
        finally:
            if folder is not None:
                shutil.rmtree(folder, ignore_errors=True)

    def _store(self, key: str, product: ConvertedMap) -> CachedMap:
        try:
            cached_map = self._write(key, product)
        except OSError as error:
            self._note_problem(system_reason(error))
            return self._keep_in_memory(key, product)
        self._note_problem(None)
        if cached_map is None:
            return self._keep_in_memory(key, product)
        for file in cached_map.all_files():
            self._note_hash(file)
        self._total += sum(f.size for f in cached_map.all_files())
        self.leave_room()
        return cached_map

    def _write(self, key: str, product: ConvertedMap) -> CachedMap | None:
        """Write an entry to disk; None if it is removed or unreadable right after the write.

        Raises OSError if it cannot be written, LostMap if a file of the product is damaged.
        """
        making = self._folder / f"making-{uuid4().hex}"
        making.mkdir()
        try:
            files = [_write(making, str(k), name, *content) for k, (name, content) in enumerate(product.files.items())]
            files = [{**f, "place": product.places[f["name"]]} if f["name"] in product.places else f for f in files]
            archive = _write(making, "whole", *product.archive, "application/zip") if product.archive else None
            text = orjson.dumps({"key": key, "files": files, "archive": archive, "report": product.report.as_dict()})
            (making / "map.json").write_bytes(hashlib.sha256(text).hexdigest().encode() + b"\n" + text)
            target = self._path(key)
            target.parent.mkdir(exist_ok=True)
            try:
                making.rename(target)
            except OSError:  # another host that shares the disk may have been first: equal bytes
                first = self._read_checked(key)  # removes a damaged one
                if first is not None:
                    return first
                self._remove(target)  # incomplete entry
                making.rename(target)
        finally:
            shutil.rmtree(making, ignore_errors=True)
        entry = self._read_entry(key)
        if entry is None:  # evicted by another process, or damaged, which is reported
            return None
        cached_map, stamp = entry
        self._mark_checked(key, stamp)  # hashed before the write: not read back from disk
        self._sync_later(key)
        return cached_map

    def _sync_later(self, key: str) -> None:
        with self._guard:
            if self._syncing is None:
                self._syncing = ThreadPoolExecutor(1, thread_name_prefix="fleetmap-sync")
        with contextlib.suppress(RuntimeError):  # the process ends
            self._syncing.submit(self._sync, key)

    def _sync(self, key: str) -> None:
        """Flush an entry to the disk; remove it if that fails."""
        folder = self._path(key)
        try:
            for path in (*folder.iterdir(), folder, folder.parent):
                sync(path)
        except OSError as error:  # other errors: it was evicted, or the next use verifies it
            if error.errno in BROKEN_STORAGE_ERRNOS | DISK_FULL_ERRNOS:
                self.discard(key, f"cannot be written: {system_reason(error)}")

    def _keep_in_memory(self, key: str, product: ConvertedMap) -> CachedMap:
        """Keep the map in memory."""

        def described(name: str, content: bytes | CachedFile, media_type: str) -> CachedFile:
            data = content.read() if isinstance(content, CachedFile) else content
            digest = hashlib.sha256(data).hexdigest()
            return CachedFile(name, len(data), digest, media_type, None, product.places.get(name), data)

        files = tuple(described(name, *content) for name, content in product.files.items())
        archive = described(*product.archive, "application/zip") if product.archive else None
        cached_map = CachedMap(files, archive, product.report)
        with self._guard:
            self._in_memory[key] = cached_map
            while len(self._in_memory) > 1 and sum(m.size for m in self._in_memory.values()) > MAX_MEMORY_BYTES:
                self._in_memory.popitem(last=False)
        return cached_map

    def _note_problem(self, reason: str | None) -> None:
        """Log once that the disk cannot be written, and once that it works again."""
        if (reason is None) != (self.problem is None):
            if reason is None:
                log.warning("cache: writing to disk works again")
            else:
                log.error("cache: writing to disk failed, maps are kept in memory (reason=%s)", reason)
        self.problem = reason
        if reason is None:
            with self._guard:
                self._in_memory.clear()

    def find_by_hash(self, sha256: str, max_bytes: int) -> bytes | None:
        """Return the content of a made file by its SHA-256; None if there is none of at most ``max_bytes``."""
        try:
            path = self._folder / self._hash_path(sha256).read_text()
            if path.stat().st_size > max_bytes:
                return None
            data = path.read_bytes()
            if hashlib.sha256(data).hexdigest() == sha256:
                return data
        except OSError:
            pass
        return None if self._shared is None else self._shared.find(sha256, max_bytes)

    def _note_hash(self, file: CachedFile) -> None:
        path = self._hash_path(file.sha256)
        if file.path is None:
            return
        with contextlib.suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            temporary = path.with_suffix(f".{uuid4().hex}")
            temporary.write_text(file.path.relative_to(self._folder).as_posix())
            temporary.replace(path)

    def _hash_path(self, sha256: str) -> Path:
        return self._folder / "hashes" / sha256[:2] / sha256

    def leave_room(self) -> None:
        """Evict the least recently used maps beyond the size limit, or what the disk's reserve lacks."""
        limit = min(self._limit, max(0, self._total - lacking_bytes(self._folder)))
        if self._total > limit:
            self._evict(limit)

    def _evict(self, limit: int) -> None:
        """Remove entries until the size limit holds. Safe to run in several processes at once."""
        entries = sorted(self._entries())
        total = sum(size for _, size, _ in entries)
        for _, size, folder in entries[:-1]:  # the newest stays, whatever its size
            if total <= limit:
                break
            for line in self._hashes_of_folder(folder):
                self._hash_path(line).unlink(missing_ok=True)
            self._remove(folder)
            total -= size
        self._total = total

    def _hashes_of_folder(self, folder: Path) -> list[str]:
        """List the hashes indexed for this folder."""
        try:
            described = orjson.loads((folder / "map.json").read_bytes().partition(b"\n")[2])
            every = [*described["files"], *([described["archive"]] if described["archive"] else [])]
            place = folder.relative_to(self._folder).as_posix() + "/"
            return [f["sha256"] for f in every if self._hash_path(f["sha256"]).read_text().startswith(place)]
        except (OSError, orjson.JSONDecodeError, KeyError):
            return []

    def _entries(self) -> list[tuple[float, int, Path]]:
        """List the entries: time of last use, size in bytes, folder."""
        out = []
        for folder in self._folder.glob("[0-9a-f][0-9a-f]/*"):
            with contextlib.suppress(OSError):
                out.append((folder.stat().st_mtime, sum(f.stat().st_size for f in folder.iterdir()), folder))
        return out

    @contextlib.contextmanager
    def _key_lock(self, key: str, *, uses_cache: bool) -> Iterator[None]:
        """Lock a key among threads and processes. uses_cache: other keys are locked meanwhile, see ``get_or_make``."""
        with self._guard:
            lock = self._locks.setdefault(key, threading.Lock())
        with lock:
            # Few lock files; keys that share one rarely collide. Who locks other keys meanwhile has files of its own:
            # otherwise it would wait for itself if they share one.
            path = self._folder / "locks" / (f"{key[:2]}-uses-cache" if uses_cache else key[:2])
            with contextlib.ExitStack() as stack:
                try:
                    stack.enter_context(file_lock(path))
                except OSError as error:  # without a lock file two processes may convert the same map
                    self._note_problem(system_reason(error))
                yield
        with self._guard:
            if not lock.locked():
                self._locks.pop(key, None)

    def _path(self, key: str) -> Path:
        return self._folder / key[:2] / key


def _write(folder: Path, stored: str, name: str, data: bytes | CachedFile, media_type: str) -> dict[str, Any]:
    target = folder / stored
    if isinstance(data, CachedFile) and data.path is not None:
        try:
            _link(data.path, target)
        except FileNotFoundError as error:
            raise data.lost_error(error) from error
        digest, size = _hash(target), target.stat().st_size
        data.check(digest)
    else:
        content = data.read() if isinstance(data, CachedFile) else data
        target.write_bytes(content)
        digest, size = hashlib.sha256(content).hexdigest(), len(content)
    return {"name": name, "stored": stored, "size": size, "sha256": digest, "media_type": media_type}


def _link(source: Path, target: Path) -> None:
    """Hard-link a file, or copy it if the file system has no hard links. Raises FileNotFoundError."""
    try:
        target.hardlink_to(source)
    except FileNotFoundError:
        raise
    except OSError:
        shutil.copyfile(source, target)


def _write_file(file: CachedFile) -> int:
    try:
        return 0 if file.path is None else file.path.stat().st_mtime_ns
    except OSError:
        return -1


def _hash(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _check_files(cached_map: CachedMap) -> None:
    """Verify all files of an entry and report damage. Raises LostMap if one does not match its hash."""
    for file in cached_map.all_files():
        assert file.path is not None
        try:
            digest = _hash(file.path)
        except FileNotFoundError as error:
            if (file.path.parent / "map.json").exists():  # otherwise the entry was removed meanwhile
                file.on_damage(f"{file.name!r} is missing")
            raise file.lost_error(error) from error
        except OSError as error:
            raise file.lost_error(error) from error
        file.check(digest)


def _file_from_entry(folder: Path, f: dict[str, Any], on_damage: Callable[[str], None]) -> CachedFile:
    level, name = f.get("place") or (None, None)
    place = None if level is None or name is None else (level, name)
    path = folder / f["stored"]
    return CachedFile(f["name"], f["size"], f["sha256"], f["media_type"], path, place, on_damage=on_damage)
