"""Checks in a browser: mistakes are listed by rule, shown on the map, repaired, and then gone."""

from __future__ import annotations

from typing import Any

import pytest
from playwright.sync_api import expect

from tests.web.conftest import Open, WebServer, check_themes


def node(name: str, x: float, y: float) -> dict[str, Any]:
    place = {"type": "Point", "coordinates": [x, y]}
    properties = {"kind": "node", "name": name}
    feature = {"type": "Feature", "id": name, "geometry": None, "place": place, "properties": properties}
    return {"op": "put", "layer": "topology", "feature": feature}


def street(one: str, other: str) -> list[dict[str, Any]]:
    return [
        {
            "op": "put",
            "layer": "topology",
            "feature": {
                "type": "Feature",
                "id": f"{source}_{target}",
                "geometry": None,
                "properties": {"kind": "edge", "source": source, "target": target},
            },
        }
        for source, target in ((one, other), (other, one))
    ]


SHED = {
    "type": "Feature",
    "id": "shed",
    "geometry": None,
    "place": {"type": "Polygon", "coordinates": [[[8, 18], [12, 18], [12, 22], [8, 22], [8, 18]]]},
    "properties": {"kind": "building", "name": "Shed"},
}


@pytest.fixture(scope="module", autouse=True)
def yard(server: WebServer) -> None:
    """A ring with a shed in its way, and two nodes that lie beside the street instead of on it."""
    corners = {"a": (0, 0), "b": (20, 0), "c": (20, 20), "d": (0, 20), "near": (10, 0.1), "side": (20.1, 10)}
    changes = [node(name, x, y) for name, (x, y) in corners.items()]
    for pair in ("ab", "bc", "cd", "da"):
        changes += street(*pair)
    changes.append({"op": "put", "layer": "objects", "feature": SHED})
    server.call("POST", "environments", json={"name": "yard", "title": "Yard"})
    server.call("POST", "environments/yard/edits", json={"message": "A ring", "changes": changes})


def near_misses(server: WebServer) -> int:
    items = server.get("environments/yard/versions/latest/checks")["items"]
    return sum(item["rule"] == "near-miss" for item in items)


def test_mistakes_are_listed_shown_and_accessible(open_page: Open, axe: str) -> None:
    page = open_page("/?site=yard")
    checks = page.get_by_role("link", name="Checks", exact=True)
    expect(checks).to_have_attribute("title", "Checks (7): 1 error")
    checks.click()
    page.get_by_role("button", name="cross shed").click()
    expect(page.get_by_text("c_d, d_c", exact=True)).to_be_visible()
    assert "check=edge-through-obstacle" in page.url
    check_themes(page, axe)
    page.get_by_role("button", name="1 error").click()
    expect(page.get_by_role("button", name="cross shed")).to_have_count(0)
    expect(page.get_by_role("button", name="near is 0.10 m", exact=False)).to_be_visible()


def test_viewer_sees_mistakes_but_no_repairs(open_page: Open, server: WebServer) -> None:
    page = open_page("/?site=yard&view=checks", token=server.make_token("viewer")["token"])
    page.get_by_role("button", name="near is 0.10 m", exact=False).click()
    expect(page.get_by_text("x, y")).to_be_visible()
    expect(page.get_by_role("button", name="Split the edge", exact=False)).to_have_count(0)


def test_repair_is_tried_committed_and_the_finding_gone(open_page: Open, server: WebServer) -> None:
    before = near_misses(server)
    assert before == 2
    page = open_page("/?site=yard&view=checks")
    page.get_by_role("button", name="near is 0.10 m", exact=False).click()
    page.get_by_role("button", name="Split the edge at near", exact=False).click()
    expect(page.get_by_text("What would change")).to_be_visible()
    expect(page.get_by_text("edges added")).to_be_visible()
    assert server.get("environments/yard")["version"] == 1
    page.get_by_role("button", name="Fix: commit as v2").click()
    expect(page.get_by_role("button", name="side is 0.10 m", exact=False)).to_be_visible()
    expect(page.get_by_role("button", name="near is 0.10 m", exact=False)).to_have_count(0)
    version = server.get("environments/yard/versions/latest")
    assert version["version"] == 2
    assert "Split the edge" in version["message"]
    assert near_misses(server) == before - 1
