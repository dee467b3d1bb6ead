"""Search by name in all environments, on both databases."""

from __future__ import annotations

import random
import threading
import time
from typing import Any

import numpy as np
import pytest
import shapely
from sqlalchemy import delete, select, update

from app.errors import Unavailable
from app.model.features import features
from app.model.frame import Datum
from app.model.geodesy import local_frame
from app.model.layers import PartKey
from app.store import search as search_module
from app.store import search_index as index_module
from app.store import tables
from app.store.changes import Put, Replace
from app.store.gram_shares import REFRESH_SECONDS, GramShares
from app.store.grams import fold, wanted_grams
from app.store.search import Search, SearchHit
from app.store.search_index import SearchIndex
from app.store.store import Store
from tests.store import samples

ZONES = PartKey("zones", "first", "zones")


def node(item: str, x: float, name: str | None = None, kind: str = "node") -> tuple[str, Any, dict[str, Any]]:
    return item, shapely.Point(x, 1.0), {"kind": kind} | ({} if name is None else {"name": name})


def summary(hits: list[SearchHit]) -> list[tuple[str, str, str]]:
    return [(hit.kind, hit.environment, hit.id) for hit in hits]


@pytest.fixture
def site(store: Store) -> Store:
    """Two environments with items of each kind; the second one has a channel ``production``."""
    store.environments.create("farm", title="Große Farm")
    network = features(
        [
            node("n1", 1.0, "Dock"),
            node("n2", 2.0, "dock 2"),
            node("n3", 3.0, "Old dock"),
            node("dock", 4.0),
            ("e1", shapely.LineString([(0, 0), (1, 0)]), {"kind": "edge", "name": "dock lane"}),
        ],
        "local",
    )
    ring = [(0, 0), (10, 0), (10, 1), (1, 1), (1, 10), (0, 10)]
    zones = features([("z1", shapely.Polygon(ring), {"kind": "keepout", "name": "Dock zone"})], "local")
    things = features([("o1", shapely.Point(-0.5, 53.2), {"kind": "poi", "name": "dock light"})], "wgs84")
    empty = features([("o2", None, {"name": "dock nowhere"})], "local")
    samples.save(
        store,
        "farm",
        Replace(samples.TOPOLOGY, network),
        Replace(ZONES, zones),
        Replace(samples.OBJECTS, things),
        Replace(PartKey("objects", "ground", "kml"), empty),
    )
    store.environments.create("docklands")
    samples.save(store, "docklands", Replace(samples.TOPOLOGY, features([node("old", 5.0, "Dock A")], "local")))
    store.channels.move("docklands", "production", 1, author="ann")
    samples.save(store, "docklands", Replace(samples.TOPOLOGY, features([node("new", 6.0, "Dock B")], "local")))
    return store


def test_equal_names_come_first_then_prefixes_then_parts(site: Store) -> None:
    hits, more = site.search.find("DOCK", limit=50)
    assert summary(hits) == [
        ("node", "farm", "dock"),
        ("node", "farm", "n1"),
        ("environment", "docklands", "docklands"),
        ("node", "farm", "n2"),
        ("node", "docklands", "old"),
        ("zone", "farm", "z1"),
        ("object", "farm", "o1"),
        ("object", "farm", "o2"),
        ("node", "farm", "n3"),
    ]
    assert not more
    some, more = site.search.find("dock", limit=3)
    assert (some, more) == (hits[:3], True)
    assert site.search.find("dock", limit=9) == (hits, False)


def test_hits_have_position_level_and_version(site: Store) -> None:
    hits = {hit.id: hit for hit in site.search.find("dock", limit=50)[0]}
    assert hits["n1"].position == (1.0, 1.0)
    assert (hits["n1"].name, hits["n1"].level, hits["n1"].title) == ("Dock", "ground", "Große Farm")
    assert hits["dock"].name == "dock"
    position = hits["z1"].position
    assert position is not None
    assert shapely.Polygon([(0, 0), (10, 0), (10, 1), (1, 1), (1, 10), (0, 10)]).contains(shapely.Point(position))
    assert hits["z1"].level == "first"
    assert hits["o1"].position is None, "in degrees, and there is no datum"
    assert hits["o2"].position is None
    environment = hits["docklands"]
    assert (environment.level, environment.position, environment.version) == (None, None, 1)
    assert hits["old"].version == 1, "production, not the head"
    datum = Datum(53.2, -0.5, 0.0, 30.0)
    site.versions.commit(
        "farm", site.versions.prepare(site.versions.get("farm"), changes_with(datum)), author="ann", message="datum"
    )
    moved = {hit.id: hit for hit in site.search.find("dock", limit=50)[0]}
    expected = local_frame(datum).to_local(np.array([[-0.5, 53.2]]))[0]
    assert moved["o1"].position == pytest.approx(tuple(expected), abs=1e-6)
    assert moved["n1"].version == 2


def changes_with(datum: Datum) -> Any:
    from app.store.changes import Changes

    return Changes((), datum=datum)


def test_titles_and_ids_are_searched_in_any_case(site: Store) -> None:
    assert summary(site.search.find("große", limit=5)[0]) == [("environment", "farm", "farm")]
    assert summary(site.search.find("GROßE F", limit=5)[0]) == [("environment", "farm", "farm")]
    assert summary(site.search.find("Z1", limit=5)[0]) == [("zone", "farm", "z1")]
    assert site.search.find("lane", limit=5)[0] == [], "edges have no names that people know"


@pytest.mark.parametrize("query", ["%", "_", "*", "n%", "d_ck", "\\", "'", "--", "[a-z]", ".*", "%' OR 1=1 --", "\x00"])
def test_every_character_stands_for_itself(site: Store, query: str) -> None:
    assert site.search.find(query, limit=50)[0] == []


def test_pattern_limits_environments(site: Store) -> None:
    assert {hit.environment for hit in site.search.find("dock", limit=50, allowed="farm*")[0]} == {"farm"}
    assert site.search.find("dock", limit=50, allowed="street*") == ([], False)


def test_changes_are_found_at_once(site: Store) -> None:
    site.search.find("dock", limit=5)
    site.channels.move("docklands", "production", 2, author="ann")
    assert summary(site.search.find("dock b", limit=5)[0]) == [("node", "docklands", "new")]
    assert site.search.find("dock a", limit=5)[0] == []
    site.environments.update("farm", new_name="yard")
    assert summary(site.search.find("old dock", limit=5)[0]) == [("node", "yard", "n3")]
    site.environments.delete("yard")
    assert site.search.find("old dock", limit=5)[0] == []


def test_search_equals_comparison_with_each_text(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(index_module, "SLICE", 50)
    rng = random.Random(3)
    alphabet = "aAbBß İ1_%'\\\"ΣÄ&:"
    words = ["".join(rng.choices(alphabet, k=rng.randint(1, 6))).strip() or "x" for _ in range(100)]
    items: list[tuple[str, str, str | None]] = []
    for environment in ("yy", "zz"):
        store.environments.create(environment)
        of_it = [(f"{rng.choice(words)}{k}", rng.choice([*words, None])) for k in range(80)]
        items += [(environment, *item) for item in of_it]
        part = features([node(item, 0.0, name) for item, name in of_it], "local")
        samples.save(store, environment, Replace(samples.TOPOLOGY, part))
    queries = {fold(word[: rng.randint(1, 4)]).strip() for word in words} | {
        fold(items[7][1]),
        "nothing",
        "'",
        '"',
        ":*",
    }
    for query in sorted(queries - {""})[::4]:
        expected: dict[tuple[str, str], int] = {}
        for environment, item, name in items:
            texts = [fold(item), fold(name or item)]
            ranks = [0 if t == query else 1 if t.startswith(query) else 2 for t in texts if query in t]
            if ranks:
                expected[environment, item] = min(ranks)
        for allowed, few in ((None, 5), ("y*", 5), ("y*", 0), ("y?", 0)):
            monkeypatch.setattr(search_module, "FEW", few)
            here = {k: rank for k, rank in expected.items() if allowed is None or k[0] == "yy"}
            hits, more = store.search.find(query, limit=200, allowed=allowed)
            found = [(hit.environment, hit.id) for hit in hits]
            assert not more
            assert sorted(found) == sorted(here), query
            assert [here[k] for k in found] == sorted(here.values()), query
            assert store.search.find(query, limit=5, allowed=allowed) == (hits[:5], len(hits) > 5)


def test_tokens_for_many_environments_find_only_these(store: Store) -> None:
    network = features([node("n1", 1.0, "Dock")], "local")
    for name in (*(f"farm-{k}" for k in range(8)), "farmer", "yard-1"):
        store.environments.create(name, title="Dock yard")
        samples.save(store, name, Replace(samples.TOPOLOGY, network))
    for allowed, expected in (
        ("farm-*", {f"farm-{k}" for k in range(8)}),
        ("*-[!7]", {f"farm-{k}" for k in range(7)} | {"yard-1"}),
        ("farm-1", {"farm-1"}),
        ("farm-?", {f"farm-{k}" for k in range(8)}),
        ("_arm*", set()),
    ):
        for query in ("dock", "ock", "k"):
            hits, _ = store.search.find(query, limit=50, allowed=allowed)
            assert {hit.environment for hit in hits} == expected, (allowed, query)
            assert {hit.kind for hit in hits} == ({"environment", "node"} if expected else set())


def test_only_the_difference_is_written(site: Store) -> None:
    site.search.find("dock", limit=5)
    with site._database.read() as connection:
        query = select(tables.search_item.c.id, tables.search_item.c.feature)
        before = {row.id: row.feature for row in connection.execute(query)}
        network = features([node("n2", 2.0, "dock two")], "local")
        samples.save(site, "farm", Put(samples.TOPOLOGY, network))
        site.search.find("dock", limit=5)
    with site._database.read() as connection:
        after = {row.id: row.feature for row in connection.execute(query)}
    assert [before[k] for k in before.keys() - after.keys()] == ["n2"]
    assert [after[k] for k in after.keys() - before.keys()] == ["n2"]
    assert site.search_index.refresh(10) == 0


def test_new_title_and_purge_are_seen(site: Store) -> None:
    site.search.find("dock", limit=5)
    site.environments.update("farm", title="Small holding")
    assert summary(site.search.find("small", limit=5)[0]) == [("environment", "farm", "farm")]
    assert site.search.find("große", limit=5)[0] == []
    site.environments.delete("farm")
    site.environments.purge("farm")
    assert {hit.environment for hit in site.search.find("dock", limit=50)[0]} == {"docklands"}
    site.environments.create("farm")
    assert site.search.find("old dock", limit=5)[0] == []


def test_index_that_is_built_afresh_gives_the_same(site: Store) -> None:
    before = site.search.find("dock", limit=50)
    with site._database.write() as connection:
        connection.execute(update(tables.environment).values(search_version=-1, search_sequence=-1))
    assert site.search.find("dock", limit=50) == before


def test_merged_index_of_texts_gives_the_same(site: Store) -> None:
    for version in range(8):
        samples.save(site, "farm", Put(samples.TOPOLOGY, features([node("n9", 1.0, f"Shed {version}")], "local")))
        site.search.find("shed", limit=5)
    queries = ("shed", "hed 7", "e", "zone", "arm")
    before = [summary(site.search.find(query, limit=20)[0]) for query in queries]
    assert before[0]
    assert before[1]
    site.search_index.merge()
    assert [summary(site.search.find(query, limit=20)[0]) for query in queries] == before
    if site.database_url.startswith("sqlite"):
        with site.transaction() as connection:
            segments = "SELECT count(DISTINCT segid) FROM search_node_idx"
            assert connection.exec_driver_sql(segments).scalar() == 1


def test_damaged_environment_is_skipped(site: Store) -> None:
    site.search.find("dock", limit=5)
    samples.save(site, "farm", Replace(samples.TOPOLOGY, features([node("n9", 1.0, "New dock")], "local")))
    entry = next(e for e in site.versions.get("farm").parts if e.key == samples.TOPOLOGY)
    with site._database.write() as connection:
        connection.execute(delete(tables.chunk).where(tables.chunk.c.hash == bytes.fromhex(entry.hash)))
    site.chunks.forget()
    for _ in range(2):
        hits, _ = site.search.find("dock", limit=50)
        assert {hit.environment for hit in hits} == {"farm", "docklands"}
        assert "n9" not in {hit.id for hit in hits}


def test_search_after_mass_change_asks_to_try_again(site: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(index_module, "AT_ONCE", 1)
    with pytest.raises(Unavailable, match="being built"):
        site.search.find("dock", limit=5)
    assert site.search.find("dock", limit=5)[0]


def test_searches_do_not_queue_while_the_index_is_built(site: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    index = SearchIndex(site._database, site.chunks)
    fresh = Search(site._database, index)
    reached, go = threading.Event(), threading.Event()
    refresh = index.refresh

    def slow(limit: int) -> int:
        reached.set()
        assert go.wait(20)
        return refresh(limit)

    monkeypatch.setattr(index, "refresh", slow)
    results: list[Any] = []
    threads = [
        threading.Thread(target=lambda: results.append(fresh.find("dock", limit=5)))
        for _ in range(index_module.MAX_BUILDERS)
    ]
    for thread in threads:
        thread.start()
    assert reached.wait(20)
    while index._builders._value:  # until all searches wait
        time.sleep(0.01)
    with pytest.raises(Unavailable, match="being built"):
        fresh.find("dock", limit=5)
    go.set()
    for thread in threads:
        thread.join(20)
    assert len(results) == index_module.MAX_BUILDERS


def test_only_the_rarest_groups_of_a_text_are_asked_for() -> None:
    shares = {"doc": 0.9, "k 1": 0.2}
    assert wanted_grams("dock 117", sqlite=False, shares=shares) == "'117' & 'k 1'"
    assert wanted_grams("dock", sqlite=False, shares=shares) == "'ock' & 'doc'"
    assert wanted_grams("dock 117", sqlite=False, shares={}) == "'117' & 'doc' & 'k 1'"


def test_search_by_statistics_finds_the_same(store: Store) -> None:
    store.environments.create("port")
    nodes = [node(f"n{k}", float(k), f"Dock {k}") for k in range(400)]
    samples.save(store, "port", Replace(samples.TOPOLOGY, features(nodes, "local")))
    texts = ("ock 11", "ock 117", "dock 3", "k 39", "dock 400")
    before = [store.search.find(text, limit=500) for text in texts]
    now = 0.0
    shares = GramShares(lambda: now)
    with store._database.write() as connection:
        if not store._database.sqlite:
            shares.current(connection)
            connection.exec_driver_sql("ANALYZE search_item")
        now = REFRESH_SECONDS - 1
        assert shares.current(connection) == {}
        now = REFRESH_SECONDS
        known = shares.current(connection)
    assert store._database.sqlite or known["doc"] > 0.9 > known["k 1"]
    search = Search(store._database, store.search._index)
    assert [search.find(text, limit=500) for text in texts] == before
    assert [len(hits) for hits, _ in before] == [11, 1, 111, 11, 0]


def test_what_a_search_reads_of_new_items_is_bounded(store: Store) -> None:
    store.environments.create("port")
    nodes = [node(f"n{k}", float(k), f"Dock {k:x} of {k}") for k in range(3000)]
    samples.save(store, "port", Replace(samples.TOPOLOGY, features(nodes, "local")))
    assert len(store.search.find("dock", limit=50)[0]) == 50
    if not store._database.sqlite:
        with store._database.write() as connection:
            pages = connection.exec_driver_sql("SELECT gin_clean_pending_list('ix_search_item_grams')").scalar_one()
        assert pages <= 20
