"""Storage that grows with the change: compressed files, differences of files that are sent again, collection."""

from __future__ import annotations

import random
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from sqlalchemy import select

from app.errors import Damaged, NotFound
from app.model.layers import PartKey
from app.store import tables
from app.store.blob_rows import BlobRow, select_rows
from app.store.changes import Changes, Drop, Replace
from app.store.store import Store
from app.store.values import Source
from tests.store.samples import TOPOLOGY, add_sources, grid, network, save

HEIGHT, WIDTH = 1000, 2500


def stored_bytes(store: Store) -> int:
    return sum(file.size for file in store.blobs.files.list())


def drawn_map() -> NDArray[np.uint8]:
    """Return a map of 2.5 MB: rooms with walls, unknown ground, and the noise of a sensor."""
    cells = np.full((HEIGHT, WIDTH), 205, np.uint8)
    random.seed(4)
    rng = np.random.default_rng(4)
    for _ in range(200):
        y, x, height, width = random.randrange(HEIGHT), random.randrange(WIDTH), *random.choices(range(20, 300), k=2)
        cells[y : y + height, x : x + width] = 254
        cells[y : y + 2, x : x + width] = cells[y : y + height, x : x + 2] = 0
    noisy = rng.random(cells.shape) < 0.02
    cells[noisy & (cells == 254)] = 253
    return cells


def commit_source(store: Store, name: str, sha256: str, size: int) -> None:
    head = store.versions.get("farm")
    prepared = store.versions.prepare(head, Changes((Replace(TOPOLOGY, network(3, seed=head.number)),)))
    source = Source(name, size, sha256)
    store.versions.commit("farm", prepared, author="ann", message="", sources=[source])


def test_hundred_uploads_of_a_changed_file_cost_little_more_than_one(sqlite_store: Store) -> None:
    store = sqlite_store
    cells = drawn_map()
    header = b"P5\n2500 1000\n255\n"
    last = store.blobs.put(header + cells.tobytes())
    one = stored_bytes(store)
    assert one < cells.size / 10
    rng = np.random.default_rng(5)
    names = [last]
    contents = {last: header + cells.tobytes()}
    for k in range(99):
        y, x = rng.integers(0, HEIGHT - 5, 2)
        cells[y : y + 5, x : x + 5] = k
        (last,) = store.blobs.put_many([header + cells.tobytes()], [last])
        names.append(last)
        if k in (0, 48, 62, 98):
            contents[last] = header + cells.tobytes()
    assert len(set(names)) == 100
    assert stored_bytes(store) <= 1.3 * one, f"{stored_bytes(store) / one:.2f} times"
    for name, data in contents.items():
        assert store.blobs.get(name) == data
        with store.blobs.open(name) as file:
            file.seek(17)
            assert file.read(1000) == data[17:1017]
    assert longest_chain(store, names[-2]) <= 7


def longest_chain(store: Store, name: str) -> int:
    rows = chain(store, name)
    return len(rows) - 1


def chain(store: Store, name: str) -> list[BlobRow]:
    out = []
    with store._database.read() as connection:
        current: str | None = name
        while current is not None:
            row = select_rows(connection, [current])[current]
            out.append(row)
            current = row.base
    return out


def test_text_that_moves_is_kept_as_a_difference(store: Store) -> None:
    lines = [f"- node: {random.Random(k).getrandbits(200):x}\n" for k in range(4000)]
    first = store.blobs.put("".join(lines).encode())
    before = stored_bytes(store)
    changed = "".join([*lines[:100], "- inserted: 1\n", *lines[100:3000], *lines[3001:]]).encode()
    (second,) = store.blobs.put_many([changed], [first])
    assert [row.coding for row in chain(store, second)] == ["patch", "zstd"]
    assert stored_bytes(store) - before < 2000
    assert store.blobs.get(second) == changed
    assert store.blobs.size(second) == len(changed)


def test_file_that_differs_entirely_is_kept_whole(store: Store) -> None:
    first = store.blobs.put(random.Random(1).randbytes(200_000))
    (second,) = store.blobs.put_many([random.Random(2).randbytes(200_000)], [first])
    assert [row.coding for row in chain(store, second)] == [None]


def test_damaged_base_is_found_and_healed(store: Store) -> None:
    content = random.Random(1).randbytes(200_000)
    first = store.blobs.put(content)
    (second,) = store.blobs.put_many([content[:-9] + b"elsewhere"], [first])
    (key,) = [row.key for row in chain(store, first)]
    store.blobs.files.write({key: content[1:] + b"x"})
    with pytest.raises(Damaged):
        store.blobs.get(second)
    assert store.blob_upkeep.verify() == sorted([first, second])
    store.blobs.put(content)
    assert store.blobs.get(second).endswith(b"elsewhere")
    assert store.blob_upkeep.verify() == []


def test_base_is_kept_while_a_difference_needs_it(store: Store) -> None:
    store.environments.create("farm")
    content = random.Random(1).randbytes(200_000)
    first = store.blobs.put(content)
    (second,) = store.blobs.put_many([content[:-9] + b"elsewhere"], [first])
    commit_source(store, "m", second, 200_000)
    for _ in range(2):
        assert store.garbage.collect(timedelta(0))["blobs"] == 0
    store.environments.delete("farm")
    store.environments.purge("farm")
    assert store.garbage.collect(timedelta(0))["blobs"] == 2
    assert list(store.blobs.files.list()) == []


# --- collection ---


def test_collection_looks_only_at_what_is_new(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    store.environments.create("farm")
    save(store, "farm", Replace(TOPOLOGY, network(5000)))
    save(store, "farm", Replace(GRID, grid()))
    store.garbage.collect(timedelta(0))
    with store._database.read() as connection:
        total = connection.exec_driver_sql("SELECT count(*) FROM chunk").scalar_one()
        young = connection.exec_driver_sql("SELECT count(*) FROM chunk WHERE kept IS false").scalar_one()
    assert young == 0
    store.chunks.forget()
    before = store.chunks.reads
    waste = store.blobs.put(random.Random(8).randbytes(100_000))
    removed = store.garbage.collect(timedelta(0))
    assert removed["blobs"] == 1
    assert store.chunks.reads - before < total / 10, "versions that were seen are not walked again"
    with pytest.raises(NotFound):
        store.blobs.get(waste)
    monkeypatch.setattr(store.blobs.files, "list", None)  # nor are the files listed
    store.garbage.collect(timedelta(0))


def test_collection_finds_what_is_new_by_an_index(sqlite_store: Store) -> None:
    query = select(tables.chunk.c.hash, tables.chunk.c.used).where(tables.is_young(tables.chunk))
    with sqlite_store._database.read() as connection:
        plan = connection.exec_driver_sql(f"EXPLAIN QUERY PLAN {query.compile(connection)}").all()
    assert "ix_chunk_young" in str(plan)


def test_versions_of_an_older_release_are_not_collected(store: Store) -> None:
    """Servers of the release before do not mark what versions refer to as kept."""
    store.environments.create("farm")
    store.garbage.collect(timedelta(0))
    save(store, "farm", Replace(TOPOLOGY, network(300)))
    name = store.blobs.put(b"s" * 100)
    add_sources(store, "farm", 1, Source("s", 100, name))
    with store._database.write() as connection:
        connection.exec_driver_sql("UPDATE chunk SET kept = false, used = 5")
        connection.exec_driver_sql("UPDATE blob SET kept = false, used = 5")
    removed = store.garbage.collect(timedelta(hours=6))
    assert (removed["chunks"], removed["blobs"]) == (0, 0)
    assert store.blobs.get(name) == b"s" * 100
    store.chunks.forget()
    assert store.content.load(store.versions.get("farm")).parts[TOPOLOGY]
    with store._database.read() as connection:
        assert connection.exec_driver_sql("SELECT count(*) FROM chunk WHERE kept IS false").scalar_one() == 0


def test_purge_has_everything_looked_at(store: Store) -> None:
    for name in ("farm", "other"):
        store.environments.create(name)
        save(store, name, Replace(TOPOLOGY, network(300, seed=len(name))))
    store.garbage.collect(timedelta(0))
    save(store, "farm", Drop(TOPOLOGY))
    store.environments.delete("farm")
    store.environments.purge("farm")
    assert store.garbage.collect(timedelta(0))["chunks"] > 3
    store.chunks.forget()
    assert store.content.load(store.versions.get("other")).parts[TOPOLOGY]
    stray = "packs/" + "1" * 64
    store.blobs.files.write({stray: b"x"})
    store.garbage.look_at_everything()
    assert store.garbage.collect(timedelta(0))["temporary"] == 1


GRID = PartKey("occupancy", "ground", "map")


def test_data_of_an_older_release_is_read(store: Store, tmp_path: Path) -> None:
    """Files as they are, and packs without compression, as rows without the newer columns state."""
    import hashlib

    del tmp_path
    large, small = random.Random(1).randbytes(70_000), b"name: farm\n" * 20
    names = [hashlib.sha256(data).hexdigest() for data in (large, small)]
    store.blobs.files.write({f"{names[0][:2]}/{names[0]}": large, "packs/" + "a" * 64: b"??" + small})
    with store._database.write() as connection:
        for name, size, pack, start in ((names[0], len(large), None, 0), (names[1], len(small), "a" * 64, 2)):
            quoted = "NULL" if pack is None else f"'{pack}'"
            connection.exec_driver_sql(
                f"INSERT INTO blob (sha256, size, pack, start, used) VALUES ('{name}', {size}, {quoted}, {start}, 7)"
            )
    assert store.blobs.get_many(names) == dict(zip(names, (large, small), strict=True))
    assert store.blob_upkeep.verify() == []
    assert store.blobs.put_many([large, small]) == names
