"""Search by name in all environments, on both databases."""

from __future__ import annotations

import random
import threading
import time
from typing import Any

import numpy as np
import pytest
import shapely

from app.errors import Unavailable
from app.model.features import features
from app.model.frame import Datum
from app.model.geodesy import local_frame
from app.model.layers import PartKey
from app.store import search as search_module
from app.store.changes import Replace
from app.store.search import NameIndex, Search, SearchHit, fold
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
        ("node", "farm", "n1"),
        ("node", "farm", "dock"),
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


def test_memory_is_limited(site: Store) -> None:
    tiny = Search(site._database, site.chunks, max_bytes=1)
    for _ in range(2):
        assert tiny.find("dock", limit=50) == site.search.find("dock", limit=50)
        assert len(tiny._indexes) == 1


def test_index_equals_a_search_in_each_name() -> None:
    rng = random.Random(3)
    alphabet = "aAbBß İ1_%ΣÄ"
    words = ["".join(rng.choices(alphabet, k=rng.randint(1, 6))) for _ in range(400)]
    items = [(f"{rng.choice(words)}{k}", rng.choice([*words, None])) for k in range(300)]
    index = NameIndex(items, np.zeros((len(items), 2)), np.ones(len(items), bool))
    for query in {fold(word[: rng.randint(1, 3)]) for word in words} | {fold(items[7][0]), "nothing"}:
        expected = {}
        for row, (item, name) in enumerate(items):
            texts = [fold(item), fold(name or item)]
            ranks = [0 if t == query else 1 if t.startswith(query) else 2 for t in texts if query in t]
            if ranks:
                expected[row] = min(ranks)
        assert index.find(query, 10_000) == expected, query
        best = index.find(query, 5)
        assert all(expected[row] <= rank for row, rank in best.items())
        good = sorted(rank for row, rank in best.items())[:5]
        assert good == sorted(expected.values())[:5], query
    for row, (item, name) in enumerate(items):
        assert index.item(row) == (item, name or item)


def test_searches_do_not_queue_while_the_index_is_built(site: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    fresh = Search(site._database, site.chunks)
    reached, go = threading.Event(), threading.Event()
    build = fresh._build

    def slow(entry: Any) -> Any:
        reached.set()
        assert go.wait(20)
        return build(entry)

    monkeypatch.setattr(fresh, "_build", slow)
    results: list[Any] = []
    threads = [
        threading.Thread(target=lambda: results.append(fresh.find("dock", limit=5)))
        for _ in range(search_module.MAX_BUILDERS)
    ]
    for thread in threads:
        thread.start()
    assert reached.wait(20)
    while fresh._builders._value:  # until all searches wait
        time.sleep(0.01)
    with pytest.raises(Unavailable, match="being built"):
        fresh.find("dock", limit=5)
    go.set()
    for thread in threads:
        thread.join(20)
    assert len(results) == search_module.MAX_BUILDERS
