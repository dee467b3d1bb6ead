"""Edits of large parts: they read what they name, and give the same as if all were read."""

from __future__ import annotations

import itertools
import random
import sys
import time
from typing import Any

import numpy as np
import pytest
import shapely

from app.ingest import edited_part
from app.ingest.edits import edit_changes
from app.model.features import Features
from app.model.frame import Level
from app.model.layers import PartKey
from app.store.changes import Changes, Provenance, Put
from app.store.store import Store
from app.store.values import Version

KEY = PartKey("topology", "ground", "network")
DRAWN = PartKey("objects", "ground", "dxf")


def make_grid(store: Store, name: str, side: int) -> Version:
    """Commit a network of side × side nodes with edges to the east and north; some were read from drawn lines."""
    rows: list[tuple[str, Any, dict[str, Any]]] = []
    for i, j in itertools.product(range(side), range(side)):
        rows.append((f"n{i}_{j}", shapely.Point(2 * i, 2 * j), {"kind": "node"}))
        for k, m in ((i + 1, j), (i, j + 1)):
            if k < side and m < side:
                properties = {"kind": "edge", "source": f"n{i}_{j}", "target": f"n{k}_{m}"}
                if i == 1:
                    properties["drawn_from"] = f"line{j}"
                rows.append((f"e{i}_{j}_{k}_{m}", shapely.LineString([(2 * i, 2 * j), (2 * k, 2 * m)]), properties))
    lines = [(f"line{j}", shapely.LineString([(2, 2 * j), (4, 2 * j)]), {"kind": "line"}) for j in range(side)]
    store.environments.create(name)
    operations = (Put(KEY, as_features(rows), Provenance("raw")), Put(DRAWN, as_features(lines), Provenance("raw")))
    prepared = store.versions.prepare(store.versions.get(name), Changes(operations))
    return store.versions.commit(name, prepared, author="test", message="")


def as_features(rows: list[tuple[str, Any, dict[str, Any]]]) -> Features:
    geometry = np.empty(len(rows), object)
    geometry[:] = [one for _, one, _ in rows]
    return Features(tuple(i for i, _, _ in rows), geometry, tuple(p for _, _, p in rows), np.ones(len(rows), bool))


def move(node: str, x: float, y: float) -> dict[str, Any]:
    place = {"type": "Point", "coordinates": [x, y]}
    feature = {"type": "Feature", "id": node, "geometry": None, "place": place, "properties": {"kind": "node"}}
    return {"op": "put", "layer": "topology", "feature": feature}


def delete(item: str, layer: str = "topology") -> dict[str, Any]:
    return {"op": "delete", "layer": layer, "id": item}


def put_edge(source: str, target: str) -> dict[str, Any]:
    properties = {"kind": "edge", "source": source, "target": target}
    feature = {"type": "Feature", "id": f"{source}-{target}", "geometry": None, "properties": properties}
    return {"op": "put", "layer": "topology", "feature": feature}


def root_after(store: Store, base: Version, changes: list[dict[str, Any]]) -> str:
    change_set, _ = edit_changes(store, base, changes)
    return store.versions.prepare(base, change_set).root


def test_edits_are_the_same_whether_all_or_little_is_read(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    base = make_grid(store, "grid", 12)
    chance = random.Random(4)
    for _ in range(12):
        i, j = chance.randrange(1, 10), chance.randrange(1, 10)
        changes = [move(f"n{i}_{j}", 2 * i + 0.3, 2 * j), put_edge(f"n{i}_{j}", "n11_11"), delete("e0_0_1_0")]
        changes += [delete(f"line{j}", "objects"), move(f"n{i}_{j + 1}", 2 * i, 2 * j + 2.4)]
        monkeypatch.setattr(edited_part, "WHOLE", 10**9)
        whole = root_after(store, base, changes)
        monkeypatch.setattr(edited_part, "WHOLE", 0)
        assert root_after(store, base, changes) == whole
        assert whole != base.root


def test_edges_follow_nodes_of_earlier_edits(store: Store) -> None:
    base = make_grid(store, "grid", 30)
    names = ("n5_5", "n6_5", "n5_6")
    for step in range(1, 4):
        for name in names:
            x, y = (2 * int(part) for part in name[1:].split("_"))
            change_set, _ = edit_changes(store, base, [move(name, x + step / 10, y)])
            prepared = store.versions.prepare(base, change_set)
            base = store.versions.commit("grid", prepared, author="test", message="")
    features = store.content.load(base, [KEY]).parts[KEY]
    assert isinstance(features, Features)
    shapes = dict(zip(features.ids, features.geometry, strict=True))
    for edge in ("e5_5_6_5", "e5_5_5_6", "e4_5_5_5", "e6_5_7_5", "e6_4_6_5"):
        _, i, j, k, m = edge.replace("e", "e_").split("_")
        ends = shapely.get_coordinates(shapes[edge]).tolist()
        assert ends == [shapely.get_coordinates(shapes[f"n{a}_{b}"]).tolist()[0] for a, b in ((i, j), (k, m))]


def test_an_edit_costs_by_what_it_changes(store: Store) -> None:
    costs = []
    for side in (18, 120):
        base = make_grid(store, f"grid{side}", side)
        changes = [[move(f"n{k}_{k}", 2 * k + 0.5, 2 * k)] for k in range(1, 8)]
        root_after(store, base, changes[0])
        rounds = []
        for change in changes[1:]:
            start = time.thread_time()
            root_after(store, base, change)
            rounds.append(time.thread_time() - start)
        costs.append(min(rounds))
    assert costs[1] < 10 * costs[0], f"44 times the features cost {costs[1] / costs[0]:.1f} times as much"


def make_levels(store: Store, name: str, levels: int) -> Version:
    """Commit a row of 200 nodes on one level, and a node on each of the others."""
    operations = []
    for level in range(levels):
        nodes = 200 if level == 0 else 1
        rows = [(f"n{level}_{k}", shapely.Point(2 * k, 0), {"kind": "node"}) for k in range(nodes)]
        operations.append(Put(PartKey("topology", f"l{level}", "network"), as_features(rows), Provenance("raw")))
    store.environments.create(name)
    site = tuple(Level(f"l{level}", 3.0 * level) for level in range(levels))
    prepared = store.versions.prepare(store.versions.get(name), Changes(tuple(operations), levels=site))
    return store.versions.commit(name, prepared, author="test", message="")


def count_calls(store: Store, base: Version, changes: list[dict[str, Any]]) -> int:
    """Count the calls of Python functions that edits take."""
    calls = 0

    def count(frame: Any, event: str, argument: Any) -> None:
        nonlocal calls
        calls += event == "call"

    before = sys.getprofile()
    sys.setprofile(count)
    try:
        edit_changes(store, base, changes)
    finally:
        sys.setprofile(before)
    return calls


def test_edits_of_one_level_cost_the_same_whatever_others_there_are(store: Store) -> None:
    costs = []
    for levels in (2, 40):
        base = make_levels(store, f"site{levels}", levels)
        changes = [{**put_edge(f"n0_{k}", f"n0_{k + 1}"), "level": "l0"} for k in range(150)]
        edit_changes(store, base, changes)  # fills caches
        few, many = (count_calls(store, base, changes[:number]) for number in (50, 150))
        costs.append(many - few)
    assert costs[1] < 2 * costs[0], f"20 times the levels cost {costs[1] / costs[0]:.1f} times as much"
