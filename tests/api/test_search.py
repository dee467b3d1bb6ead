"""Search by name over HTTP; ``tests/store/test_search.py`` has its order and content."""

from __future__ import annotations

import pytest

from tests.api import samples
from tests.api.conftest import Api

MEMBERS = {"kind", "environment", "version", "id", "name", "level", "where", "title"}


def test_search_returns_items_of_accessible_environments(api: Api, farm: str, bare: str) -> None:
    found = api.get(f"environments/{farm}/versions/3/layers/topology").json()["features"]
    node = next(f["id"] for f in found if f["properties"]["kind"] == "node" and len(f["id"]) > 3)
    allowed = api.token_for("viewer", environments=farm)
    body = allowed.get("search", params={"q": node.upper(), "limit": 100}).json()
    assert set(body) == {"items", "truncated"}
    hit = next(item for item in body["items"] if (item["environment"], item["id"]) == (farm, node))
    assert set(hit) == MEMBERS
    assert (hit["kind"], hit["version"], hit["title"], len(hit["where"])) == ("node", 3, "Farm", 2)
    limited = api.token_for("viewer", environments=bare)
    assert limited.get("search", params={"q": node}).json() == {"items": [], "truncated": False}
    items = limited.get("search", params={"q": "env-", "limit": 100}).json()["items"]
    assert [(item["kind"], item["id"], item["where"]) for item in items] == [("environment", bare, None)]


def test_search_follows_production(api: Api, bare: str) -> None:
    api.upload(bare, {"n.tmap2.yaml": samples.tmap2()})
    assert api.get("search", params={"q": bare}).json()["items"][0]["version"] == 1
    api("PUT", f"environments/{bare}/channels/production", 200, json={"version": 0})
    assert api.get("search", params={"q": bare}).json()["items"][0]["version"] == 0


def test_search_is_truncated_by_limit(api: Api, farm: str) -> None:
    body = api.get("search", params={"q": "e", "limit": 1}).json()
    assert (len(body["items"]), body["truncated"]) == (1, True)
    assert len(api.get("search", params={"q": "e"}).json()["items"]) <= 20


@pytest.mark.parametrize(
    "query",
    ["", "q=", "q=%20", "q=a%00b", "q=a%0Ab", f"q={'x' * 101}", "q=a&limit=0", "q=a&limit=101", "q=a&kind=node"],
)
def test_unusable_query_returns_422(api: Api, query: str) -> None:
    api.problem("GET", f"search?{query}", 422)


@pytest.mark.parametrize("query", ["%", "_", "*", "%25", "';--"])
def test_wildcards_are_not_special(api: Api, farm: str, query: str) -> None:
    items = api.get("search", params={"q": query, "limit": 100}).json()["items"]
    assert all(query in f"{item['id']} {item['name']} {item['title']}" for item in items)
