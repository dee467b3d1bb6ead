"""Made maps on disk: whole or absent, made once for many askers, bounded."""

from __future__ import annotations

import hashlib
import os
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from app.convert.cache import Cache, Product


def key(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def product(data: bytes = b"hello", archive: bytes | None = None) -> Product:
    return Product({"map.kml": (data, "text/xml")}, ("kml.zip", archive) if archive else None, {"format": "kml"})


def test_a_made_map_comes_back_with_its_bytes_hash_and_report(tmp_path: Path) -> None:
    cache = Cache(tmp_path, 10**6)
    assert cache.get(key("a")) is None
    made = cache.get_or_make(key("a"), product)
    file = made.whole()
    assert (file.name, file.size, file.media_type) == ("map.kml", 5, "text/xml")
    assert file.path.read_bytes() == b"hello"
    assert file.sha256 == hashlib.sha256(b"hello").hexdigest()
    assert made.report == {"format": "kml"}
    again = Cache(tmp_path, 10**6).get(key("a"))
    assert again == made


def test_several_files_come_with_an_archive(tmp_path: Path) -> None:
    made = Cache(tmp_path, 10**6).get_or_make(key("a"), lambda: product(archive=b"PK.."))
    assert made.whole().name == "kml.zip"
    assert made.file("map.kml") is not None
    assert made.file("other") is None


def test_one_of_many_askers_makes_it(tmp_path: Path) -> None:
    cache, count, lock = Cache(tmp_path, 10**6), [], threading.Lock()

    def slow() -> Product:
        with lock:
            count.append(1)
        time.sleep(0.2)
        return product()

    with ThreadPoolExecutor(20) as many:
        made = list(many.map(lambda _: cache.get_or_make(key("a"), slow), range(20)))
    assert len(count) == 1
    assert len({m.whole().sha256 for m in made}) == 1
    assert (cache.misses, cache.hits) == (1, 19)


def test_a_failed_maker_leaves_nothing_and_the_next_one_tries(tmp_path: Path) -> None:
    cache = Cache(tmp_path, 10**6)

    def fail() -> Product:
        raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        cache.get_or_make(key("a"), fail)
    assert cache.get(key("a")) is None
    assert not list(tmp_path.glob("making-*"))
    assert cache.get_or_make(key("a"), product).whole().size == 5


def test_room_is_made_by_dropping_the_longest_unused(tmp_path: Path) -> None:
    cache = Cache(tmp_path, 4000)
    for name in "abc":
        cache.get_or_make(key(name), lambda: product(b"x" * 1500))
        time.sleep(0.02)
    assert cache.get(key("a")) is None
    assert cache.get(key("c")) is not None


def test_what_a_killed_process_left_is_cleaned_at_the_next_start(tmp_path: Path) -> None:
    (tmp_path / "making-1").mkdir(parents=True)
    (tmp_path / "making-1" / "0").write_bytes(b"half")
    Cache(tmp_path, 10**6)
    assert (tmp_path / "making-1").exists(), "a sibling process may be at work on it"
    os.utime(tmp_path / "making-1", (0, 0))
    Cache(tmp_path, 10**6)
    assert not (tmp_path / "making-1").exists()
