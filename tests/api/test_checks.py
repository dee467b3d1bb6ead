"""Checks of versions over HTTP: findings, their fixes applied as edits, drafts, caching."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, get_args

import pytest

from app.review.rules import MAX_FINDINGS, RULES, RuleName
from tests.api import samples
from tests.api.conftest import Api

Json = dict[str, Any]

FIXABLE = {
    "near-miss", "duplicate-name", "duplicate-edge", "dead-end", "unreachable-part", "isolated-node",
    "crossing-edges-without-node", "zero-length-edge", "lifts-do-not-stack",
}  # fmt: skip
NODES = {
    "a": (0, 0), "b": (20, 0), "c": (20, 20), "d": (0, 20), "near": (10, 0.3), "far": (10, 9), "touch": (20.2, -0.2),
    "away": (30, -9), "x1": (5, 15), "x2": (5, 25), "trap": (-10, 0), "p": (40, 0), "q": (50, 0), "alone": (60, 60),
}  # fmt: skip
EDGES = [
    ("a", "b"), ("b", "c"), ("c", "d"), ("d", "a"), ("near", "far"), ("far", "c"), ("touch", "away"), ("away", "c"),
    ("x1", "x2"), ("x1", "a"), ("x2", "d"),
]  # fmt: skip


def node(item: str, xy: tuple[float, float], **more: Any) -> Json:
    feature = {"type": "Feature", "id": item, "place": {"type": "Point", "coordinates": list(xy)}, "geometry": None}
    level = more.pop("level", "ground")
    properties = {"kind": "node", "name": item, **more}
    return {"op": "put", "layer": "topology", "level": level, "feature": {**feature, "properties": properties}}


def edge(item: str, source: str, target: str, level: str = "ground", **more: Any) -> Json:
    properties = {"kind": "edge", "source": source, "target": target, **more}
    feature = {"type": "Feature", "id": item, "geometry": None, "properties": properties}
    return {"op": "put", "layer": "topology", "level": level, "feature": feature}


def broken_site() -> list[Json]:
    """Return edits that make a network with a mistake for each rule that has a fix."""
    lift = {"nav_graph": {"parameters": {"lift": "L"}}}
    changes = [node(item, (float(x), float(y))) for item, (x, y) in NODES.items()]
    changes += [edge(f"{i}_{j}", i, j) for a, b in EDGES for i, j in ((a, b), (b, a))]
    changes += [edge("a_trap", "a", "trap"), edge("b_p", "b", "p"), edge("p_q", "p", "q"), edge("q_p", "q", "p")]
    changes += [edge("a_b_again", "a", "b"), node("n1", (0.0, 30.0), name="twin"), node("n2", (5.0, 30.0), name="twin")]
    changes += [edge(f"{i}_{j}", i, j) for i, j in (("n1", "d"), ("d", "n1"), ("n2", "n1"), ("n1", "n2"))]
    changes += [node("stop", (-20.0, 20.0), **lift), edge("stop_d", "stop", "d"), edge("d_stop", "d", "stop")]
    changes += [node("above", (-25.0, 20.0), level="L2", **lift), node("hall", (-25.0, 9.0), level="L2")]
    changes += [edge("above_hall", "above", "hall", "L2"), edge("hall_above", "hall", "above", "L2")]
    changes += [node("attic", (9.0, 9.0), level="L2")]
    loop = edge("loop", "a", "a")
    loop["feature"]["geometry"] = None
    loop["feature"]["place"] = {"type": "LineString", "coordinates": [[0.0, 0.0], [0.0, 0.0]]}
    return [*changes, loop]


def edit(api: Api, env: str, changes: list[Json]) -> Json:
    body: Json = api.post(f"environments/{env}/edits", {"changes": changes}).json()
    return body


def checks(api: Api, env: str, version: str = "latest", **query: str) -> Json:
    body: Json = api.get(f"environments/{env}/versions/{version}/checks", params=query).json()
    return body


def by_rule(body: Json) -> dict[str, list[Json]]:
    out: dict[str, list[Json]] = {}
    for item in body["items"]:
        out.setdefault(item["rule"], []).append(item)
    return out


@pytest.mark.parametrize("datum", [False, True])
def test_each_fix_makes_its_finding_vanish(api: Api, bare: str, datum: bool) -> None:
    if datum:
        api.upload(bare, {"datum.yaml": samples.DATUM})
    edit(api, bare, broken_site())
    body = checks(api, bare)
    assert {rule for rule, items in by_rule(body).items() if any(item["fix"] for item in items)} == FIXABLE
    assert [rule["rule"] for rule in body["rules"]] == list(get_args(RuleName))
    assert body["truncated"] is False
    for rule in sorted(FIXABLE):
        item = next((i for i in by_rule(checks(api, bare))[rule] if i["fix"]), None)
        assert item is not None, rule
        draft = api.post(f"environments/{bare}/versions/latest/checks", {"changes": item["fix"]["changes"]}, 200).json()
        edit(api, bare, item["fix"]["changes"])
        after = checks(api, bare)
        assert item["ids"] not in [i["ids"] for i in by_rule(after).get(rule, [])], rule
        assert draft["items"] == after["items"], "a draft has the findings of the version that it would become"


def test_fix_keeps_the_anchor_of_a_network_on_earth(api: Api, bare: str) -> None:
    lon, lat = samples.LONGITUDE, samples.LATITUDE
    places = {"a": (lon, lat), "b": (lon + 3e-4, lat), "c": (lon + 1.5e-4, lat + 3e-6), "d": (lon + 1.5e-4, lat + 1e-4)}
    api.upload(bare, {"datum.yaml": samples.DATUM})
    changes: list[Json] = []
    for item, xy in places.items():
        feature = {"type": "Feature", "id": item, "geometry": {"type": "Point", "coordinates": list(xy)}}
        changes.append({"op": "put", "layer": "topology", "feature": {**feature, "properties": {"kind": "node"}}})
    edit(api, bare, [*changes, *(edge(f"{a}_{b}", a, b) for a, b in ("ab", "ba", "cd", "dc"))])
    (item,) = by_rule(checks(api, bare))["near-miss"]
    assert {change["crs"] for change in item["fix"]["changes"]} == {"wgs84"}
    edit(api, bare, item["fix"]["changes"])
    assert checks(api, bare)["items"] == []


def test_draft_stores_nothing_and_refuses_what_edits_refuse(api: Api, farm: str) -> None:
    path = f"environments/{farm}/versions/3/checks"
    before = api.get(f"environments/{farm}").json()
    body = api.post(path, {"changes": [node("lonely", (3.0, 3.0))]}, 200).json()
    assert [item["ids"] for item in by_rule(body)["isolated-node"]] == [["lonely"]]
    assert "isolated-node" not in by_rule(checks(api, farm))
    assert api.get(f"environments/{farm}").json() == before
    api.problem("POST", path, 422, json={"changes": [edge("e", "gate", "nowhere")]})
    api.problem("POST", path, 422, json={"changes": []})
    api.problem("POST", path, 422, json={"changes": [{"op": "jump"}]})
    cells = {"op": "cells", "value": 100, "crs": "local"}
    box = [[1.0, -1.0], [2.0, -1.0], [2.0, 1.0], [1.0, 1.0], [1.0, -1.0]]
    polygon = {"type": "Polygon", "coordinates": [box]}
    drawn = api.post(path, {"changes": [{**cells, "polygon": polygon}]}, 200).json()
    hits = {i for item in by_rule(drawn)["edge-through-obstacle"] for i in item["ids"]}
    assert any("gate" in i and "barn" in i for i in hits)
    drop = {"op": "delete", "layer": "topology", "id": "field"}
    api.problem("POST", path, 422, json={"changes": [drop]})


def test_findings_are_cached_by_root(api: Api, bare: str, monkeypatch: pytest.MonkeyPatch) -> None:
    edit(api, bare, broken_site())
    path = f"environments/{bare}/versions/1/checks"
    first = api.get(path)
    edit(api, bare, [node("more", (70.0, 70.0))])

    def broken(*_: Any, **__: Any) -> Any:
        raise AssertionError("checked again")

    with monkeypatch.context() as patch:
        patch.setattr(api.app.state.services.pool.__class__, "run", broken)
        assert api.get(path).content == first.content
        assert api.get(path, 304, headers={"if-none-match": first.headers["etag"]}).content == b""
    now = api.get(f"environments/{bare}/versions/latest/checks")
    assert now.headers["etag"] != first.headers["etag"]
    assert ["more"] in [item["ids"] for item in now.json()["items"]]


def test_levels(api: Api, bare: str) -> None:
    edit(api, bare, broken_site())
    upper = checks(api, bare, level="L2")
    assert {item["level"] for item in upper["items"]} == {"L2"}
    everything = checks(api, bare)["items"]
    assert [item for item in everything if item["level"] == "L2"] == upper["items"]
    api.problem("GET", f"environments/{bare}/versions/latest/checks?level=L9", 404)
    api.problem("GET", f"environments/{bare}/versions/latest/checks?floor=L2", 422)


def test_real_sites_have_few_and_true_findings(api: Api, bare: str, shared: Path) -> None:
    folder = shared / "data/openrmf_building/hotel"
    api.upload(bare, {file.name: file.read_bytes() for file in folder.iterdir()})
    assert set(by_rule(checks(api, bare))) == {"crossing-edges-without-node"}


def test_large_network_is_checked_in_time(api: Api, bare: str) -> None:
    side = 90
    ids = {(x, y): f"n{x}-{y}" for x in range(side) for y in range(side)}
    nodes = {name: (x * 1.0, y * 1.0) for (x, y), name in ids.items()}
    ways = [(ids[x, y], ids[x + 1, y]) for x in range(side - 1) for y in range(side)]
    api.upload(bare, {"big.tmap2.yaml": samples.tmap2(nodes, tuple(w for a, b in ways for w in ((a, b), (b, a))))})
    begun = time.perf_counter()
    body = checks(api, bare)
    assert time.perf_counter() - begun < 240  # two seconds of the processor; a quadratic rule takes ten minutes
    assert {item["rule"] for item in body["items"]} == {"unreachable-part"}, "rows that no column connects"
    assert len(body["items"]) == side - 1 <= MAX_FINDINGS
    assert len(body["rules"]) == len(RULES)
