"""Conformance suite of versions and content; every test runs on both databases."""

from __future__ import annotations

import dataclasses
import hashlib
import random
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from app.errors import Conflict, Invalid, NotFound, Problem, StaleParent, Unavailable
from app.model.features import Features, features
from app.model.frame import Datum, Level
from app.model.layers import Layers, Part, PartKey, Resources
from app.model.templates import NO_TEMPLATES, FormatTemplate, Templates
from app.model.voxels import VoxelMap
from app.store.changes import Changes, Delete, Drop, Put, Replace
from app.store.store import Store
from app.store.values import Idempotency, Provenance, Source
from tests.store.samples import (
    DATUM,
    GRID,
    OBJECTS,
    TOPOLOGY,
    add_sources,
    assert_same_layers,
    assert_same_part,
    everything,
    grid,
    mixed,
    network,
    picture,
    replaces,
    rows,
    save,
    voxels,
)


@pytest.fixture
def farm(store: Store) -> Store:
    store.environments.create("farm", datum=DATUM)
    return store


def test_every_kind_of_part_round_trips(farm: Store):
    parts = everything()
    version = save(farm, "farm", *replaces(parts))
    assert version.number == 2
    assert version.parent == 1
    assert [e.key for e in version.parts] == sorted(parts)
    assert_same_layers(farm.content.load(farm.versions.get("farm")), Layers(parts, DATUM))
    some = farm.content.load(version, [GRID, OBJECTS])
    assert set(some.parts) == {GRID, OBJECTS}
    with pytest.raises(NotFound, match="occupancy"):
        farm.content.load(version, [PartKey("occupancy", "ground", "keepout")])


def test_content_is_equal_in_another_process(farm: Store, tmp_path: Path):
    parts = everything()
    version = save(farm, "farm", *replaces(parts))
    other = Store(farm.database_url, farm.blob_dir, readonly=True)
    assert_same_layers(other.content.load(other.versions.get("farm")), Layers(parts, DATUM))
    assert other.versions.prepare(version, Changes((Drop(GRID),))).changed
    with pytest.raises((Unavailable, Invalid)):
        other.environments.create("second")
    other.close()


def test_equal_content_has_equal_roots_on_both_databases(store: Store, sqlite_store: Store):
    for one in (store, sqlite_store):
        one.environments.create("farm", datum=DATUM)
        save(one, "farm", *replaces(everything()))
    assert store.versions.get("farm").root == sqlite_store.versions.get("farm").root


def test_root_depends_on_content_only(farm: Store):
    farm.environments.create("other", title="t")
    save(farm, "other", *replaces(everything()))
    other = save(farm, "other", datum=DATUM)
    prepared = farm.versions.prepare(
        farm.versions.get("farm"), Changes(tuple(Replace(k, p, Provenance("derived")) for k, p in everything().items()))
    )
    assert prepared.root == other.root
    for changed in (
        Changes((Drop(GRID),)),
        Changes(datum=Datum(53.2, -0.5)),
        Changes(datum=None),
        Changes(levels=(Level(), Level("first", 3.0))),
    ):
        assert farm.versions.prepare(other, changed).root != other.root


def test_replace_with_same_content_changes_nothing(farm: Store):
    first = save(farm, "farm", *replaces(everything()))
    farm.chunks.forget()
    reads = farm.chunks.reads
    prepared = farm.versions.prepare(first, Changes((Replace(TOPOLOGY, network(300)),)))
    assert not prepared.changed
    assert not prepared.chunks
    assert farm.chunks.reads - reads == 2  # the part's root: compared, and checked for damage
    shuffled = network(300).select(np.random.default_rng(0).permutation(300))
    assert not farm.versions.prepare(first, Changes((Replace(TOPOLOGY, shuffled),))).changed
    assert not farm.versions.prepare(first, Changes(replaces(everything()))).changed
    digest = farm.blobs.put(b"again")
    same = farm.versions.commit("farm", prepared, author="bob", message="x", sources=[Source("again.txt", 5, digest)])
    assert same.number == first.number
    assert [(s.name, s.used) for s in same.sources] == [("again.txt", False)]
    assert farm.versions.get("farm").number == first.number
    assert add_sources(farm, "farm", first.number, Source("again.txt", 5, digest)).sources == same.sources


def edits(seed: int) -> Callable[[Store], None]:
    """Rounds of random puts and deletes; after each one the root must equal that of an upload of the layer."""

    def run(store: Store) -> None:
        random.seed(seed)
        rng = np.random.default_rng(seed)
        items: dict[str, tuple[Any, dict[str, Any], bool]] = {}
        store.environments.create("a")
        store.environments.create("b")
        for round_ in range(14):
            for local in (True, False):
                chosen = [f"n{i}" for i in rng.integers(0, 600, rng.choice([0, 1, 5, 200]))]
                put = {}
                for i in dict.fromkeys(chosen):
                    if i in items and items[i][2] != local and rng.random() < 0.5:
                        continue
                    stays = i in items and items[i][2] == local and rng.random() < 0.5
                    place = items[i][0] if stays else shapely.Point(*(rng.random(2) * (300 if local else 0.01)))
                    put[i] = (place, {"r": round_, "x": [1, 1.0]}, local)
                operations: list[Any] = []
                if put:
                    listed = features([(i, g, p) for i, (g, p, _) in put.items()], "local" if local else "wgs84")
                    operations.append(Put(TOPOLOGY, listed))
                    items.update(put)
                deleted_ids = (
                    random.sample(sorted(items), min(len(items), int(rng.choice([0, 1, 40])))) if items else []
                )
                if round_ == 9 and not local:
                    deleted_ids = sorted(items)
                if deleted_ids:
                    operations.append(Delete(TOPOLOGY, tuple(deleted_ids)))
                    for i in deleted_ids:
                        del items[i]
                if not operations:
                    continue
                head = save(store, "a", *operations)
                from app.model.features import concatenate

                uploaded = concatenate(
                    [
                        features([(i, g, p) for i, (g, p, is_local) in items.items() if is_local is flag], anchor)
                        for flag, anchor in ((True, "local"), (False, "wgs84"))
                    ]
                )
                fresh = save(store, "b", Replace(TOPOLOGY, uploaded))
                assert head.root == fresh.root
                entry = head.part(TOPOLOGY)
                assert entry is not None
                assert entry.count == len(items)
                assert entry.bounds == fresh.part(TOPOLOGY).bounds  # type: ignore[union-attr]
        loaded = store.content.load(store.versions.get("a")).parts[TOPOLOGY]
        assert isinstance(loaded, Features)
        assert set(loaded.ids) == set(items)

    return run


@pytest.mark.parametrize("seed", range(4))
def test_edits_give_root_of_new_upload(sqlite_store: Store, seed: int):
    edits(seed)(sqlite_store)


def test_edits_give_root_of_new_upload_on_each_database(store: Store):
    edits(99)(store)


def test_put_and_delete_report_changes(farm: Store):
    save(farm, "farm", Replace(TOPOLOGY, network(200)))
    new = features(
        [("n1", shapely.Point(1, 1), {"kind": "node"}), ("new", shapely.Point(2, 2), {"v": 1})],
        "local",
        {"tmap2": {"name": "changed"}, "more": 1},
    )
    version = save(farm, "farm", Put(TOPOLOGY, new), Delete(TOPOLOGY, ("n2", "n3")))
    assert version.changes == {"topology": {"added": 1, "changed": 1, "deleted": 2, "document": True}}
    part = farm.content.load(version).parts[TOPOLOGY]
    assert isinstance(part, Features)
    assert part.document == {"tmap2": {"name": "changed"}, "more": 1}
    assert len(part) == 199
    with pytest.raises(NotFound, match="'gone'"):
        farm.versions.prepare(version, Changes((Delete(TOPOLOGY, ("n1", "gone")),)))
    with pytest.raises(NotFound):
        farm.versions.prepare(version, Changes((Delete(OBJECTS, ("n1",)),)))
    with pytest.raises(NotFound):
        farm.versions.prepare(version, Changes((Drop(OBJECTS),)))
    with pytest.raises(Invalid):
        farm.versions.prepare(version, Changes((Put(GRID, new),)))
    with pytest.raises(Invalid):
        farm.versions.prepare(version, Changes((Replace(GRID, new),)))


def test_integer_replaced_by_float_is_change(farm: Store):
    save(farm, "farm", Replace(TOPOLOGY, features([("a", shapely.Point(0, 0), {"v": 1, "w": 2})], "local")))
    before = farm.versions.get("farm")
    after = save(farm, "farm", Replace(TOPOLOGY, features([("a", shapely.Point(0, 0), {"v": 1.0, "w": 2})], "local")))
    assert after.changes == {"topology": {"added": 0, "changed": 1, "deleted": 0}}
    assert farm.content.diff(before, after) == {
        "topology": {"added": [], "changed": [{"id": "a", "fields": ["v"]}], "deleted": []}
    }


def test_features_are_ordered_by_id_and_documents_keep_order(farm: Store):
    version = save(farm, "farm", Replace(TOPOLOGY, network(300)))
    part = farm.content.load(version).parts[TOPOLOGY]
    assert isinstance(part, Features)
    assert list(part.ids) == sorted(part.ids)
    assert farm.content.has_ids(version, TOPOLOGY, ["n5", "n299", "nope"]) == {"n5", "n299"}
    assert farm.content.has_ids(version, OBJECTS, ["n5"]) == set()
    some = farm.content.features(version, TOPOLOGY, ids=["n7", "n250", "nope"])
    assert some.ids == ("n250", "n7")
    index = part.index()
    assert rows(some) == rows(part.select([index["n250"], index["n7"]]))


def test_old_version_reads_like_head(farm: Store):
    first = save(farm, "farm", *replaces(everything()))
    farm.chunks.forget()
    before = farm.chunks.reads
    farm.content.load(first)
    cost = farm.chunks.reads - before
    for k in range(30):
        save(farm, "farm", Put(TOPOLOGY, features([(f"n{k}", shapely.Point(k, k), {"k": k})], "local")))
    old = farm.versions.get("farm", first.number)
    assert old.root == first.root
    farm.chunks.forget()
    before = farm.chunks.reads
    assert_same_layers(farm.content.load(old), Layers(everything(), DATUM))
    assert farm.chunks.reads - before == cost


def test_version_stores_only_changed_chunks(farm: Store):
    save(farm, "farm", Replace(TOPOLOGY, network(20_000, side=3000)), Replace(GRID, grid(3000, 3000)))
    head = farm.versions.get("farm")
    near = farm.content.features(head, TOPOLOGY, bbox=(1000, 1000, 1300, 1300))
    assert 100 < len(near) < 400
    changed = Features(
        near.ids, near.geometry.copy(), tuple({**p, "name": "x"} for p in near.properties), near.local.copy()
    )
    one = farm.versions.prepare(head, Changes((Put(TOPOLOGY, changed.select([0])),)))
    many = farm.versions.prepare(head, Changes((Put(TOPOLOGY, changed),)))
    assert len(one.chunks) <= 6
    assert sum(map(len, one.chunks.values())) < 20_000
    assert len(many.chunks) < 25  # of about 320 leaves
    cells = grid(3000, 3000).cells.copy()
    cells[1000:1010, 1000:1010] = 100
    blocked = farm.versions.prepare(head, Changes((Replace(GRID, grid_of(cells)),)))
    assert len(blocked.chunks) <= 4
    assert sum(map(len, blocked.chunks.values())) < 20_000


def grid_of(cells: Any) -> Any:
    source_grid = grid()
    return type(source_grid)(
        cells,
        source_grid.resolution,
        source_grid.origin,
        source_grid.mode,
        source_grid.occupied_thresh,
        source_grid.free_thresh,
        source_grid.negate,
        source_grid.properties,
    )


def test_diff_reads_only_differing_chunks(farm: Store):
    save(farm, "farm", Replace(TOPOLOGY, network(20_000, side=3000)))
    a = farm.versions.get("farm")
    moved = features([("n17", shapely.Point(5.0, 5.0), {"kind": "node"}), ("new", None, {})], "local")
    b = save(farm, "farm", Put(TOPOLOGY, moved), Delete(TOPOLOGY, ("n18",)))
    farm.chunks.forget()
    before = farm.chunks.reads
    changed = {"id": "n17", "fields": ["count", "geometry", "name", "weight"]}
    assert farm.content.diff(a, b) == {"topology": {"added": ["new"], "changed": [changed], "deleted": ["n18"]}}
    assert farm.chunks.reads - before < 30
    assert farm.content.diff(b, a)["topology"]["added"] == ["n18"]
    assert farm.content.diff(a, a) == {}


def test_box_query_reads_few_chunks_at_any_version(farm: Store):
    network_part = network(20_000, side=3000)
    old = save(farm, "farm", Replace(TOPOLOGY, network_part))
    save(farm, "farm", Drop(TOPOLOGY))
    box = (500.0, 700.0, 800.0, 900.0)
    farm.chunks.forget()
    before = farm.chunks.reads
    hits = farm.content.features(old, TOPOLOGY, bbox=box)
    assert farm.chunks.reads - before < 60
    xy = shapely.get_coordinates(network_part.geometry)
    inside = (xy[:, 0] >= 500) & (xy[:, 0] <= 800) & (xy[:, 1] >= 700) & (xy[:, 1] <= 900)
    assert set(hits.ids) == {network_part.ids[k] for k in np.flatnonzero(inside)}
    assert hits.document == network_part.document
    frame = farm.content.load(old).frame
    assert frame is not None
    corners = frame.to_wgs84(np.array([[500.0, 700.0], [800.0, 900.0]]))
    (west, south), (east, north) = corners.tolist()
    degrees = frame.to_wgs84(xy)
    inside = (degrees[:, 0] >= west) & (degrees[:, 0] <= east) & (degrees[:, 1] >= south) & (degrees[:, 1] <= north)
    hits = farm.content.features(old, TOPOLOGY, bbox=(west, south, east, north), crs="wgs84")
    assert set(hits.ids) == {network_part.ids[k] for k in np.flatnonzero(inside)}
    some = farm.content.features(old, TOPOLOGY, bbox=(west, south, east, north), crs="wgs84", ids=hits.ids[:3])
    assert some.ids == hits.ids[:3]


def test_box_query_finds_wgs84_and_local_items_in_either_crs(farm: Store):
    version = save(farm, "farm", Replace(OBJECTS, mixed()))
    assert set(farm.content.features(version, OBJECTS, bbox=(-100, -100, 100, 100)).ids) == set("pzlaem")
    assert set(farm.content.features(version, OBJECTS, bbox=(-100, -100, 100, -1)).ids) == {"p", "m"}
    assert set(farm.content.features(version, OBJECTS, bbox=(5, -100, 100, -0.5)).ids) == set()
    assert set(farm.content.features(version, OBJECTS, bbox=(-0.512, 53.19, -0.49, 53.22), crs="wgs84").ids) == set(
        "pzlaem"
    )
    blind = save(farm, "farm", datum=None)
    from app.errors import MissingDatum

    with pytest.raises(MissingDatum, match="datum"):
        farm.content.features(blind, OBJECTS, bbox=(-1, 53, 0, 54), crs="wgs84")


def test_grid_diff_counts_and_bounds_changed_cells(farm: Store):
    cells = np.zeros((600, 700), np.uint8)
    save(farm, "farm", Replace(GRID, grid_of(cells)))
    a = farm.versions.get("farm")
    assert a.changes["occupancy"]["map"]["freed"] == 600 * 700
    new = cells.copy()
    new[10:12, 20:23] = 100
    new[300, 600] = 255
    new[301, 600] = 40
    b = save(farm, "farm", Replace(GRID, grid_of(new)))
    expected = {
        "freed": 0,
        "blocked": 6,
        "unknown": 1,
        "other": 1,
        "bbox": [-3 + 20 * 0.05, 2.5, -3 + 601 * 0.05, 17.1],
    }
    assert b.changes["occupancy"]["map"] == {**expected, "bbox": pytest.approx(expected["bbox"])}
    assert farm.content.diff(b, a)["occupancy"]["map"]["freed"] == 8
    delta = farm.content.delta_parts(a, b)
    patched = cells.copy()
    for r in delta.grids[0].rectangles:
        h, w = r.cells.shape
        patched[r.row : r.row + h, r.column : r.column + w] = r.cells
    assert (patched == new).all()
    assert sum(r.cells.size for r in delta.grids[0].rectangles) <= 10


def test_grid_diff_aligns_grown_grid_with_old_one(farm: Store):
    cells = np.zeros((50, 60), np.uint8)
    a = save(farm, "farm", Replace(GRID, grid(60, 50)))
    old = grid(60, 50).cells
    wider = np.full((70, 80), 255, np.uint8)
    wider[10:60, 20:80] = old
    wider[0, 0] = 100
    g = grid_of(wider)
    moved = type(g)(wider, g.resolution, (g.origin[0] - 20 * 0.05, g.origin[1] - 10 * 0.05, 0.0), g.mode)
    b = save(farm, "farm", Replace(GRID, moved))
    diff = farm.content.diff(a, b)["occupancy"]["map"]
    assert (diff["freed"], diff["blocked"], diff["unknown"], diff["other"]) == (0, 1, 0, 0)
    assert {"height", "origin", "width"} <= set(diff["fields"])
    assert farm.content.delta_parts(a, b).grids[0].whole
    c = save(farm, "farm", Replace(GRID, grid_of(cells)))
    turned = type(g)(cells, 0.07, (0.0, 0.0, 0.5), "trinary")
    diff = farm.content.diff(c, save(farm, "farm", Replace(GRID, turned)))["occupancy"]["map"]
    assert diff["fields"] == ["mode", "origin", "properties", "resolution"]
    deletion = save(farm, "farm", Drop(GRID))
    assert deletion.changes["occupancy"]["map"]["unknown"] == 3000
    assert farm.content.delta_parts(c, deletion).grids[0].deleted


def test_diff_of_other_layers_has_counts(farm: Store):
    key, photo, files = (
        PartKey("voxels", "ground", "v"),
        PartKey("imagery", "ground", "i"),
        PartKey("resources", "ground", "r"),
    )
    first: dict[PartKey, Part] = {key: voxels(100), photo: picture(), files: Resources({"a": b"1", "b": b"2"})}
    a = save(farm, "farm", *replaces(first))
    pixels = picture().pixels.copy()
    pixels[0, 0, 0] += 1
    p = picture()
    second: dict[PartKey, Part] = {
        key: voxels(100),
        photo: type(p)(pixels, p.transform, p.crs, {}),
        files: Resources({"a": b"1", "b": b"3", "c": b"4"}),
    }
    b = save(farm, "farm", *replaces(second))
    assert farm.content.diff(a, b) == {
        "imagery": {"i": {"added": 0, "changed": 1, "deleted": 0, "fields": ["properties"]}},
        "resources": {"r": {"added": 1, "changed": 1, "deleted": 0}},
    }
    assert b.changes == farm.content.diff(a, b)
    assert farm.content.delta_parts(a, b).other == (photo, files)
    for dtype in (np.uint16, np.float32, bool):
        again = save(farm, "farm", Replace(photo, picture(dtype=dtype)))
        assert_same_part(farm.content.load(again, [photo]).parts[photo], picture(dtype=dtype))


def test_voxel_diff_counts_added_changed_and_deleted(farm: Store):
    key = PartKey("voxels", "ground", "v")
    original = voxels(30_000)
    assert original.colour is not None
    a = save(farm, "farm", Replace(key, original))
    assert a.changes["voxels"] == {"v": {"added": len(original), "changed": 0, "deleted": 0}}
    odds, colour = original.log_odds.copy(), original.colour.copy()
    odds[[5, 20_000]] += 0.5
    colour[[5, 7]] ^= 1
    depth, code = original.depth.copy(), original.code.copy()
    depth[100], code[100] = 15, code[100] >> np.uint64(3)  # a larger leaf in place of a smaller one
    remaining = np.arange(len(original)) >= 3
    remaining[101:110] = original.code[101:110] >> np.uint64(3) != code[100]
    columns = (c[remaining] for c in (depth, code, odds, colour))
    names = ("depth", "code", "log_odds", "colour")
    other = dataclasses.replace(original, **dict(zip(names, columns, strict=True)))
    b = save(farm, "farm", Replace(key, other))
    deleted_count = int((~remaining).sum())
    assert b.changes["voxels"] == {"v": {"added": 1, "changed": 3, "deleted": deleted_count + 1}}
    assert_same_part(farm.content.load(b, [key]).parts[key], other)
    plain = save(farm, "farm", Replace(key, dataclasses.replace(other, colour=None)))
    assert plain.changes["voxels"]["v"] == {"added": 0, "changed": len(other), "deleted": 0, "fields": ["colour"]}
    empty = VoxelMap(0.05, np.empty(0, np.uint8), np.empty(0, np.uint64), np.empty(0, np.float32))
    none = save(farm, "farm", Replace(key, empty))
    assert none.changes["voxels"]["v"]["deleted"] == len(other)


def test_delta_turns_one_version_into_the_other(farm: Store):
    a = save(farm, "farm", Replace(TOPOLOGY, network(500)))
    put = features([("n3", shapely.Point(9, 9), {"v": 2}), ("x", None, {})], "local")
    b = save(farm, "farm", Put(TOPOLOGY, put), Delete(TOPOLOGY, ("n4",)), datum=Datum(1, 2))
    delta = farm.content.delta_parts(a, b)
    assert delta.datum
    assert not delta.levels
    (one,) = delta.features
    assert rows(one.put) == rows(put)
    assert one.deleted == ("n4",)


def test_second_commit_on_same_head_raises_stale_parent(farm: Store):
    head = farm.versions.get("farm")
    first = farm.versions.prepare(head, Changes((Replace(TOPOLOGY, network(10)),)))
    second = farm.versions.prepare(head, Changes((Replace(TOPOLOGY, network(11)),)))
    farm.versions.commit("farm", first, author="a", message="1")
    with pytest.raises(StaleParent, match="version 2"):
        farm.versions.commit("farm", second, author="b", message="2")
    assert farm.versions.get("farm").part(TOPOLOGY).count == 10  # type: ignore[union-attr]


def test_concurrent_writers_create_one_line_of_versions(farm: Store):
    def write(k: int) -> int:
        store = Store(farm.database_url, farm.blob_dir)
        try:
            for n in range(4):
                for _ in range(200):
                    put = features([(f"w{k}-{n}", shapely.Point(k, n), {"k": k})], "local")
                    prepared = store.versions.prepare(store.versions.get("farm"), Changes((Put(TOPOLOGY, put),)))
                    try:
                        store.versions.commit("farm", prepared, author=f"w{k}", message=str(n))
                        break
                    except StaleParent:
                        continue
                else:
                    raise AssertionError("never succeeded")
        finally:
            store.close()
        return k

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(write, range(4)))
    listed = farm.versions.page("farm", limit=100)
    assert [v.number for v in listed] == list(range(17, -1, -1))
    assert [v.parent for v in listed] == [*range(16, -1, -1), None]
    assert farm.versions.get("farm").part(TOPOLOGY).count == 16  # type: ignore[union-attr]
    assert [e.sequence for e in farm.events.page("farm")] == list(range(1, 19))


def test_store_is_shared_between_threads(farm: Store):
    version = save(farm, "farm", *replaces(everything()))
    expected = Layers(everything(), DATUM)

    def read(k: int) -> None:
        farm.chunks.forget()
        assert_same_layers(farm.content.load(version), expected)
        assert farm.versions.prepare(version, Changes((Replace(TOPOLOGY, network(50 + k)),))).changed

    with ThreadPoolExecutor(6) as pool:
        list(pool.map(read, range(12)))


def test_idempotency_key_creates_one_version(farm: Store):
    head = farm.versions.get("farm")
    prepared = farm.versions.prepare(head, Changes((Replace(TOPOLOGY, network(10)),)))
    key = Idempotency("abc", "print")
    version = farm.versions.commit("farm", prepared, author="a", message="m", idempotency=key)
    assert farm.versions.idempotent("farm", "abc") == ("print", version.number)
    assert farm.versions.idempotent("farm", "other") is None
    assert farm.versions.commit("farm", prepared, author="a", message="m", idempotency=key) == version
    with pytest.raises(Conflict, match="abc"):
        farm.versions.commit("farm", prepared, author="a", message="m", idempotency=Idempotency("abc", "else"))
    assert farm.versions.get("farm").number == version.number


def test_revert_copies_a_manifest(farm: Store):
    a = save(farm, "farm", *replaces(everything()))
    b = save(farm, "farm", Drop(GRID), Put(TOPOLOGY, features([("n1", None, {})], "local")), datum=None)
    c = farm.versions.revert("farm", a.number, author="bob", message="back")
    assert (c.number, c.root, c.parent) == (b.number + 1, a.root, b.number)
    assert c.changes["topology"] == {"added": 0, "changed": 1, "deleted": 0}
    assert c.changes["occupancy"]["map"]["freed"] > 0
    assert c.changes["datum"]["to"] == DATUM.as_dict()
    assert_same_layers(farm.content.load(c), farm.content.load(a))
    assert farm.versions.revert("farm", a.number, author="bob", message="again").number == c.number
    with pytest.raises(StaleParent):
        farm.versions.revert("farm", b.number, author="bob", message="x", expected=b.number)
    key = Idempotency("k", "f")
    d = farm.versions.revert("farm", b.number, author="bob", message="x", expected=c.number, idempotency=key)
    assert farm.versions.revert("farm", b.number, author="bob", message="x", expected=c.number, idempotency=key) == d
    with pytest.raises(NotFound, match="no version 77"):
        farm.versions.revert("farm", 77, author="bob", message="x")


def test_version_lists_sources_and_provenance(farm: Store):
    digest = farm.blobs.put(b"content")
    prepared = farm.versions.prepare(
        farm.versions.get("farm"),
        Changes(
            (
                Replace(TOPOLOGY, network(5), Provenance("raw", "tmap2", ("a.yaml",), "f" * 64, (), ("ODbL",))),
                Replace(GRID, grid(), Provenance("derived", steps=({"step": "x", "parameters": {"r": 1.5}},))),
            )
        ),
    )
    warnings = [Problem("odd\x00 name \ud800", "a.yaml", 3, "nodes[1]")]
    sources = [Source("a.yaml", 7, digest, "tmap2"), Source("b.txt", 7, digest, None, used=False)]
    version = farm.versions.commit("farm", prepared, author="ann", message="first", sources=sources, warnings=warnings)
    again = farm.versions.get("farm", version.number)
    assert again == version
    assert again.sources == tuple(sources)
    assert again.warnings == (Problem("odd\ufffd name ?", "a.yaml", 3, "nodes[1]"),)
    assert again.information == {
        "location": "raw",
        "objects": "missing",
        "topology": "raw",
        "occupancy": "derived",
        "voxels": "missing",
        "imagery": "missing",
        "zones": "missing",
    }
    body = again.as_dict()
    assert {"environment", "version", "root", "parent", "author", "message", "time", "changes", "sources"} <= set(body)
    assert body["warnings"] == [{"file": "a.yaml", "line": 3, "where": "nodes[1]", "problem": "odd\ufffd name ?"}]
    assert again.part(TOPOLOGY).provenance.attribution == ("ODbL",)  # type: ignore[union-attr]
    edited = save(farm, "farm", Put(TOPOLOGY, features([("q", None, {})], "local"), Provenance("raw", "edit")))
    assert edited.part(TOPOLOGY).provenance.sources == ("a.yaml",)  # type: ignore[union-attr]
    with pytest.raises(Unavailable, match="send it again"):
        add_sources(farm, "farm", version.number, Source("lost", 1, "0" * 64))
    with pytest.raises(Invalid, match="NUL"):
        farm.versions.commit("farm", prepared, author="ann", message="a\x00b")


def test_versions_resolve_by_number_channel_and_latest(farm: Store):
    for n in range(3):
        save(farm, "farm", Replace(TOPOLOGY, network(5 + n)))
    farm.channels.move("farm", "production", 2, author="a")
    assert (
        farm.versions.get("farm").number
        == farm.versions.get("farm", "latest").number
        == farm.versions.get("farm", "4").number
        == 4
    )
    assert farm.versions.get("farm", "production").number == 2
    assert [v.number for v in farm.versions.page("farm", limit=2)] == [4, 3]
    assert [v.number for v in farm.versions.page("farm", limit=2, before=3)] == [2, 1]
    for ref in ("9", 9, "staging", "no such", ""):
        with pytest.raises(NotFound):
            farm.versions.get("farm", ref)


def test_datum_change_moves_no_item(farm: Store):
    a = save(farm, "farm", Replace(OBJECTS, mixed()))
    b = save(farm, "farm", datum=Datum(10.0, 20.0))
    assert a.part(OBJECTS) == b.part(OBJECTS)
    assert b.changes == {"datum": {"from": DATUM.as_dict(), "to": Datum(10.0, 20.0).as_dict()}}
    assert farm.environments.get("farm").datum == Datum(10.0, 20.0)
    with pytest.raises(Invalid, match="same name"):
        save(farm, "farm", levels=(Level("a"), Level("a", 2.0)))


def test_garbage_collection_keeps_content_of_versions(farm: Store):
    a = save(farm, "farm", *replaces(everything()))
    digest = farm.blobs.put(b"original")
    add_sources(farm, "farm", a.number, Source("o", 8, digest))
    save(farm, "farm", *(Drop(key) for key in everything()))
    farm.versions.prepare(a, Changes((Replace(TOPOLOGY, network(7)),)))
    removed = farm.garbage.collect(timedelta(0))
    assert removed["chunks"] == removed["blobs"] == 0
    farm.chunks.forget()
    assert_same_layers(farm.content.load(farm.versions.get("farm", a.number)), Layers(everything(), DATUM))
    assert farm.blobs.get(digest) == b"original"


def test_garbage_collection_removes_all_unused_content(farm: Store):
    save(farm, "farm", *replaces(everything()))
    farm.environments.create("copy", clone=farm.versions.get("farm"))
    files = [bytes([k]) * 1000 for k in range(20)]
    digests = farm.blobs.put_many([*files, b"x" * 200_000])
    assert farm.garbage.collect(timedelta(hours=1)) == {"chunks": 0, "blobs": 0, "bytes": 0, "temporary": 0}
    add_sources(farm, "farm", 2, Source("keep", 1000, digests[3]))
    removed = farm.garbage.collect(timedelta(0))
    assert removed["blobs"] == 20
    assert removed["bytes"] == 19_000 + 200_000
    assert farm.blobs.get(digests[3]) == files[3]
    remaining_files = [p for p in farm.blob_dir.rglob("*") if p.is_file() and not p.name.startswith(".")]
    total = sum(p.stat().st_size for p in remaining_files)
    with farm._database.read() as connection:
        rows = connection.exec_driver_sql("SELECT sha256, stored FROM blob").all()
    resources = everything()[PartKey("resources", "ground", "gazebo")].files.values()  # type: ignore[union-attr]
    assert {name for name, _ in rows} == {digests[3], *(hashlib.sha256(data).hexdigest() for data in resources)}
    assert total == sum(stored for _, stored in rows)
    with pytest.raises(NotFound):
        farm.blobs.get(digests[4])
    farm.environments.delete("farm")
    farm.environments.purge("farm")
    assert farm.garbage.collect(timedelta(0))["chunks"] == 0
    assert_same_layers(farm.content.load(farm.versions.get("copy")), Layers(everything(), DATUM))
    farm.environments.delete("copy")
    farm.environments.purge("copy")
    assert farm.garbage.collect(timedelta(0))["chunks"] > 10
    with farm._database.read() as connection:
        assert connection.exec_driver_sql("SELECT count(*) FROM chunk").scalar_one() == 0
    assert not [p for p in farm.blob_dir.rglob("*") if p.is_file() and not p.name.startswith(".")]


def test_garbage_collection_keeps_reused_chunks(farm: Store):
    """A commit of existing chunks marks them as used, so that a collection with a grace period keeps them."""
    prepared = farm.versions.prepare(farm.versions.get("farm"), Changes((Replace(TOPOLOGY, network(100)),)))
    farm.versions.commit("farm", prepared, author="a", message="1")
    with farm._database.write() as connection:
        connection.exec_driver_sql("UPDATE chunk SET used = 5")
        connection.exec_driver_sql("UPDATE blob SET used = 5")
    farm.environments.create("other", datum=DATUM)
    farm.versions.commit(
        "other",
        farm.versions.prepare(farm.versions.get("other"), Changes((Replace(TOPOLOGY, network(100)),))),
        author="b",
        message="2",
    )
    farm.environments.delete("farm")
    farm.environments.purge("farm")
    farm.environments.delete("other")
    farm.environments.purge("other")
    assert farm.garbage.collect(timedelta(hours=1))["chunks"] == 0


# --- templates ---

OUTDOOR = Templates(
    "outdoor", {"tmap2": FormatTemplate(None, {"xy_goal_tolerance": 0.4}), "lif": FormatTemplate("default")}
)


def set_templates(store: Store, templates: Templates, env: str = "farm") -> Any:
    prepared = store.versions.prepare(store.versions.get(env), Changes(templates=templates))
    return store.versions.commit(env, prepared, author="a", message="templates")


def test_templates_are_part_of_a_version(farm: Store):
    before = save(farm, "farm", *replaces(everything()))
    assert before.templates == NO_TEMPLATES
    version = set_templates(farm, OUTDOOR)
    assert (version.number, version.parts) == (before.number + 1, before.parts)
    assert version.root != before.root
    assert version.changes.keys() == {"templates"}
    assert farm.versions.get("farm").templates == OUTDOOR
    assert farm.versions.get("farm", before.number).templates == NO_TEMPLATES
    assert farm.content.diff(before, version) == version.changes
    assert set_templates(farm, OUTDOOR).number == version.number, "nothing new"
    event = farm.events.page("farm", since=0)[-1]
    assert (event.body["version"], event.body["layers"]) == (version.number, [])
    later = save(farm, "farm", Drop(GRID))
    assert later.templates == OUTDOOR, "other changes keep them"
    moved = farm.versions.commit("farm", farm.versions.prepare(later, Changes(datum=None)), author="a", message="")
    assert moved.templates == OUTDOOR
    back = farm.versions.revert("farm", before.number, author="a", message="")
    assert (back.root, back.templates) == (before.root, NO_TEMPLATES)
    assert back.changes["templates"]["set"] == {"from": "outdoor", "to": "default"}
    farm.environments.create("copy", clone=version)
    copied = farm.versions.get("copy")
    assert (copied.root, copied.templates) == (version.root, OUTDOOR)
    assert copied.changes["templates"]["set"] == {"from": "default", "to": "outdoor"}
    farm.garbage.collect(timedelta(0))
    assert farm.versions.get("farm", version.number).templates == OUTDOOR


def test_templates_give_equal_roots_on_both_databases(store: Store, sqlite_store: Store):
    roots = []
    for one in (store, sqlite_store):
        one.environments.create("farm", datum=DATUM)
        bare = one.versions.get("farm").root
        roots.append((bare, set_templates(one, OUTDOOR).root, set_templates(one, Templates()).root))
    assert roots[0] == roots[1]
    assert roots[0][0] == roots[0][2] != roots[0][1]


# --- renewed provenance ---


def derived(hash_: str, join: float = 1.0) -> Provenance:
    inputs = ({"layer": "objects", "level": "ground", "name": "kml", "hash": hash_},)
    return Provenance("derived", steps=({"step": "objects_to_topology", "parameters": {"join": join}},), inputs=inputs)


def test_equal_part_derived_from_other_inputs_creates_version(farm: Store):
    first = save(farm, "farm", Replace(TOPOLOGY, network(3), derived("a")))
    again = save(farm, "farm", Replace(TOPOLOGY, network(3), derived("a")))
    assert again.number == first.number, "equal again"
    new = save(farm, "farm", Replace(TOPOLOGY, network(3), derived("b")))
    assert (new.number, new.root) == (first.number + 1, first.root)
    assert new.changes["renewed"] == [{"layer": "topology", "level": "ground", "name": TOPOLOGY.name}]
    assert new.part(TOPOLOGY).provenance.inputs[0]["hash"] == "b"  # type: ignore[union-attr]
    assert farm.versions.get("farm", first.number).part(TOPOLOGY).provenance.inputs[0]["hash"] == "a"  # type: ignore[union-attr]
    assert farm.content.diff(first, new) == {}
    other = save(farm, "farm", Replace(TOPOLOGY, network(3), derived("b", 2.0)))
    assert other.number == new.number + 1, "by other steps"
    raw_version = save(farm, "farm", Replace(TOPOLOGY, network(3), Provenance(sources=("n.yaml",))))
    assert (raw_version.number, raw_version.information["topology"]) == (other.number + 1, "raw"), "a source has it now"
    same = save(farm, "farm", Replace(TOPOLOGY, network(3), Provenance(sources=("m.yaml",))))
    assert same.number == raw_version.number, "of two sources with equal content the first one stays"


def test_edit_without_change_renews_no_provenance(farm: Store):
    first = save(farm, "farm", Replace(TOPOLOGY, network(3), derived("a")))
    assert save(farm, "farm", Put(TOPOLOGY, network(3).select([0]))).number == first.number
    edited = derived("a").with_edit_step()
    assert save(farm, "farm", Replace(TOPOLOGY, network(3), edited)).number == first.number
