"""Cached maps on disk: complete or absent, converted once for concurrent callers, limited in size."""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from app.backends.room import RESERVE_SHARE
from app.convert import cache as caching
from app.convert.cache import Cache, ConvertedMap, LostMap
from app.convert.report import Report
from tests.api.test_damage import mounted_disk


def key(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def product(data: bytes = b"hello", archive: bytes | None = None) -> ConvertedMap:
    return ConvertedMap({"map.kml": (data, "text/xml")}, ("kml.zip", archive) if archive else None, Report("kml"))


def test_cached_map_returns_bytes_hash_and_report(tmp_path: Path) -> None:
    cache = Cache(tmp_path, 10**6)
    assert cache.get(key("a")) is None
    cached_map = cache.get_or_make(key("a"), product)
    file = cached_map.single_file()
    assert (file.name, file.size, file.media_type) == ("map.kml", 5, "text/xml")
    assert file.path.read_bytes() == b"hello"
    assert file.sha256 == hashlib.sha256(b"hello").hexdigest()
    assert cached_map.report == Report("kml")
    again = Cache(tmp_path, 10**6).get(key("a"))
    assert again == cached_map


def test_map_of_several_files_has_an_archive(tmp_path: Path) -> None:
    cached_map = Cache(tmp_path, 10**6).get_or_make(key("a"), lambda: product(archive=b"PK.."))
    assert cached_map.single_file().name == "kml.zip"
    assert cached_map.file("map.kml") is not None
    assert cached_map.file("other") is None


def test_concurrent_callers_run_one_conversion(tmp_path: Path) -> None:
    cache, count, lock = Cache(tmp_path, 10**6), [], threading.Lock()

    def slow() -> ConvertedMap:
        with lock:
            count.append(1)
        time.sleep(0.2)
        return product()

    with ThreadPoolExecutor(20) as many:
        cached_maps = list(many.map(lambda _: cache.get_or_make(key("a"), slow), range(20)))
    assert len(count) == 1
    assert len({m.single_file().sha256 for m in cached_maps}) == 1
    assert (cache.misses, cache.hits) == (1, 19)


def key_in_folder(text: str, prefix: str) -> str:
    """Return a key with these first two digits: keys with equal ones share a lock file."""
    return next(one for number in range(100_000) if (one := key(f"{text}{number}")).startswith(prefix))


def test_map_made_from_another_one_does_not_wait_for_itself(tmp_path: Path) -> None:
    """Two maps and what they are made from share lock files crosswise; then one shares its own."""
    cache, done, made = Cache(tmp_path, 10**6), [], threading.Barrier(2, timeout=60)

    def request(outer: str, inner: str, *, meet: bool) -> None:
        def maker() -> ConvertedMap:
            if meet:
                made.wait()
            return product(cache.get_or_make(inner, product).single_file().read())

        done.append(cache.get_or_make(outer, maker, uses_cache=True).single_file().read())

    def run(*pairs: tuple[str, str]) -> None:
        meet = len(pairs) == 2
        threads = [threading.Thread(target=request, args=pair, kwargs={"meet": meet}, daemon=True) for pair in pairs]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(60)

    run((key_in_folder("a", "01"), key_in_folder("b", "02")), (key_in_folder("c", "02"), key_in_folder("d", "01")))
    run((key_in_folder("e", "03"), key_in_folder("f", "03")))
    assert done == [b"hello"] * 3


def test_failed_conversion_leaves_nothing_and_is_retried(tmp_path: Path) -> None:
    cache = Cache(tmp_path, 10**6)

    def fail() -> ConvertedMap:
        raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        cache.get_or_make(key("a"), fail)
    assert cache.get(key("a")) is None
    assert not list(tmp_path.glob("making-*"))
    assert cache.get_or_make(key("a"), product).single_file().size == 5


def test_eviction_removes_least_recently_used_map(tmp_path: Path) -> None:
    cache = Cache(tmp_path, 4000)
    for name in "abc":
        cache.get_or_make(key(name), lambda: product(b"x" * 1500))
        time.sleep(0.02)
    assert cache.get(key("a")) is None
    assert cache.get(key("c")) is not None


def test_cache_gives_way_when_disk_gets_short(tmp_path: Path) -> None:
    """Its limit is larger than the disk: uploads must not fail for maps that can be made again."""
    with mounted_disk(tmp_path / "disk") as disk:
        reserve = RESERVE_SHARE * shutil.disk_usage(disk).total
        cache = Cache(disk / "cache", 2**30)
        for number in range(50):
            cache.get_or_make(key(str(number)), lambda: product(os.urandom(400_000)))
            assert shutil.disk_usage(disk).free >= reserve
        assert cache.problem is None
        assert cache.get(key("49")) is not None
        assert cache.get(key("0")) is None
        before = cache.size
        (disk / "upload").write_bytes(bytes(shutil.disk_usage(disk).free))
        cache.leave_room()
        assert shutil.disk_usage(disk).free >= reserve
        assert 0 < cache.size < before


def test_leftovers_of_killed_process_are_removed_at_start(tmp_path: Path) -> None:
    (tmp_path / "making-1").mkdir(parents=True)
    (tmp_path / "making-1" / "0").write_bytes(b"half")
    Cache(tmp_path, 10**6)
    assert (tmp_path / "making-1").exists(), "a sibling process may be using it"
    os.utime(tmp_path / "making-1", (0, 0))
    Cache(tmp_path, 10**6)
    assert not (tmp_path / "making-1").exists()


def flip(path: Path, *, quietly: bool = False) -> None:
    """Change a byte in the middle. quietly: keep the modification time, as bit rot does."""
    before, data = path.stat(), bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    if quietly:
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


def zero(path: Path) -> None:
    """Overwrite a file with zeros, as after a power cut that stored only its length."""
    path.write_bytes(bytes(path.stat().st_size))


def entry(folder: Path, name: str) -> Path:
    return folder / key(name)[:2] / key(name)


@pytest.mark.parametrize("file", ["0", "whole", "map.json"])
@pytest.mark.parametrize("harm", [flip, zero, lambda path: path.write_bytes(b""), Path.unlink])
def test_damaged_entry_is_converted_again_after_restart(
    tmp_path: Path, file: str, harm: Callable[[Path], None]
) -> None:
    Cache(tmp_path, 10**6).get_or_make(key("a"), lambda: product(b"x" * 5000, archive=b"PK" * 50))
    harm(entry(tmp_path, "a") / file)
    cache = Cache(tmp_path, 10**6)
    assert cache.get(key("a")) is None
    assert cache.damaged == (0 if harm is Path.unlink and file == "map.json" else 1)
    cached_map = cache.get_or_make(key("a"), lambda: product(b"y" * 5000, archive=b"PK" * 50))
    assert cached_map.files[0].read() == b"y" * 5000
    assert Cache(tmp_path, 10**6).get(key("a")) == cached_map


def test_entry_changed_while_server_runs_is_not_served(tmp_path: Path) -> None:
    cache = Cache(tmp_path, 10**6)
    cached_map = cache.get_or_make(key("a"), product)
    flip(cached_map.files[0].path, quietly=True)
    with pytest.raises(LostMap):
        cached_map.files[0].read()
    assert cache.damaged == 1
    assert cache.get(key("a")) is None, "a damaged entry is removed"
    cached_map = cache.get_or_make(key("a"), product)
    flip(cached_map.files[0].path)
    assert cache.get(key("a")) is None, "a changed file is hashed again"
    assert cache.damaged == 2


def test_entry_is_hashed_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Cache(tmp_path, 10**6).get_or_make(key("a"), product)
    hashed: list[Path] = []
    real = caching._hash
    monkeypatch.setattr(caching, "_hash", lambda path: (hashed.append(path), real(path))[1])
    cache = Cache(tmp_path, 10**6)
    for _ in range(5):
        assert cache.get(key("a")) is not None
    assert len(hashed) == 1


def test_entry_under_another_key_is_not_served(tmp_path: Path) -> None:
    cache = Cache(tmp_path, 10**6)
    cache.get_or_make(key("a"), product)
    entry(tmp_path, "b").parent.mkdir(exist_ok=True)
    entry(tmp_path, "a").rename(entry(tmp_path, "b"))
    assert cache.get(key("b")) is None
    assert cache.damaged == 1


def test_entry_of_earlier_release_is_converted_again_without_alarm(tmp_path: Path) -> None:
    cache = Cache(tmp_path, 10**6)
    cache.get_or_make(key("a"), product)
    described = entry(tmp_path, "a") / "map.json"
    described.write_bytes(described.read_bytes().partition(b"\n")[2])
    assert cache.get(key("a")) is None
    assert cache.damaged == 0
    assert cache.get_or_make(key("a"), product).files[0].read() == b"hello"


def test_map_that_cannot_be_synced_is_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[Path] = []
    cache = Cache(tmp_path, 10**6)

    def sync(path: Path) -> None:
        if path.is_relative_to(tmp_path):  # earlier tests may still be syncing
            synced.append(path)
        if len(synced) > 4:
            raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(caching, "sync", sync)
    for name in "ab":
        cache.get_or_make(key(name), product)
    assert cache._syncing is not None
    cache._syncing.shutdown(wait=True)
    folder = entry(tmp_path, "a")
    assert set(synced[:4]) == {folder / "0", folder / "map.json", folder, folder.parent}
    assert cache.get(key("a")) is not None
    assert cache.get(key("b")) is None


def test_maps_are_served_when_disk_is_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    cache = Cache(tmp_path, 10**6)
    stored = cache.get_or_make(key("before"), lambda: product(b"before"))
    real, full = Path.mkdir, OSError(errno.ENOSPC, "No space left on device")

    def mkdir(path: Path, *args: Any, **more: Any) -> None:
        if path.name.startswith("making-"):
            raise full
        real(path, *args, **more)

    monkeypatch.setattr(Path, "mkdir", mkdir)
    for _ in range(2):
        cached_map = cache.get_or_make(key("a"), lambda: product(archive=b"PK"))
        assert (cached_map.files[0].read(), cached_map.single_file().read(), cached_map.files[0].path) == (
            b"hello",
            b"PK",
            None,
        )
    assert cache.misses == 2, "converted once"
    assert cache.get(key("before")) == stored
    with cache.hold_files() as hold:
        assert [f.read() for f in (*hold(cached_map).files, *hold(stored).files)] == [b"hello", b"before"]
    assert cache.problem == "No space left on device"
    assert [r.levelname for r in caplog.records] == ["ERROR"], "it is logged once"
    monkeypatch.undo()
    assert cache.get_or_make(key("b"), product).files[0].path is not None
    assert cache.problem is None
    assert cache.get(key("a")) is None


def test_check_hashes_every_entry_and_removes_the_damaged_ones(tmp_path: Path) -> None:
    cache = Cache(tmp_path, 10**6)
    for name in "abc":
        cache.get_or_make(key(name), product)
    flip(entry(tmp_path, "b") / "0", quietly=True)
    assert {k: cache.check(k) for k in cache.stored_keys()} == {
        key("a"): (5, True), key("b"): (0, False), key("c"): (5, True)
    }  # fmt: skip
    assert cache.stored_keys() == sorted([key("a"), key("c")])


def refusing(monkeypatch: pytest.MonkeyPatch, name: str, number: int) -> None:
    """Make reading of files with this name fail."""
    real = Path.open

    def refuse(path: Path, mode: str = "r", **more: Any) -> Any:
        if path.name == name and "r" in mode:
            raise OSError(number, os.strerror(number), str(path))
        return real(path, mode, **more)

    monkeypatch.setattr(Path, "open", refuse)


@pytest.mark.parametrize("name", ["map.json", "0"])
@pytest.mark.parametrize("number", [errno.EMFILE, errno.ENFILE, errno.EACCES, errno.ESTALE, errno.EIO, errno.EBADMSG])
def test_unreadable_entry_is_removed_only_when_damaged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, name: str, number: int
) -> None:
    Cache(tmp_path, 10**6).get_or_make(key("a"), product)
    cache, damaged = Cache(tmp_path, 10**6), number in {errno.EIO, errno.EBADMSG}
    refusing(monkeypatch, name, number)
    assert cache.get(key("a")) is None
    assert damaged or cache.check(key("a")) == (0, True)
    monkeypatch.undo()
    assert cache.damaged == damaged
    assert (cache.get(key("a")) is None) == damaged
    assert str(tmp_path) not in caplog.text


def test_entry_evicted_at_once_is_no_disk_problem(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cache = Cache(tmp_path, 10**6)
    refusing(monkeypatch, "map.json", errno.ENOENT)
    cached_map = cache.get_or_make(key("a"), product)
    assert (cached_map.files[0].read(), cache.problem) == (b"hello", None)


@pytest.mark.parametrize("error", [shutil.Error("/srv/data/cache/0"), OSError("/srv/data is odd"), PermissionError(13)])
def test_disk_problem_contains_no_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: OSError) -> None:
    def refuse(*_: object) -> None:
        raise error

    cache = Cache(tmp_path, 10**6)
    monkeypatch.setattr(caching, "_write", refuse)
    assert cache.get_or_make(key("a"), product).files[0].read() == b"hello"
    assert cache.problem
    assert "/srv" not in cache.problem
