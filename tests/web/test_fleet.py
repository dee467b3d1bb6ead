"""Fleet: robots converge before one's eyes, their reports become closures, and time can be turned back."""

from __future__ import annotations

import re
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
from playwright.sync_api import Locator, Page, expect

from tests.web.conftest import TABLET, Open, WebServer, check_accessibility, wait_until

RESOLUTION = 0.02
"""Metres per pixel of the map in the tests that point at it."""

ROBOTS = [f"mower-{number}" for number in range(1, 5)]


@pytest.fixture(scope="module")
def site(server: WebServer) -> str:
    """An orchard with two versions: the second has an edge less."""
    name = server.make_site("fleet-orchard")
    edge = next(f for f in features(server, name) if f["properties"]["kind"] == "edge")
    changes = [{"op": "delete", "layer": "topology", "id": edge["id"]}]
    server.call("POST", f"environments/{name}/edits", 201, json={"message": "one edge less", "changes": changes})
    return name


def features(server: WebServer, site: str) -> list[dict[str, Any]]:
    listed: list[dict[str, Any]] = server.get(f"environments/{site}/versions/latest/layers/topology", crs="local")[
        "features"
    ]
    return listed


def promote(server: WebServer, site: str, version: int) -> None:
    server.call("PUT", f"environments/{site}/channels/production", json={"version": version})


def report(server: WebServer, site: str, robot: str, version: int, state: str = "active", **more: Any) -> None:
    """Report as an agent does: with the root of the version and the digest of the closures in force."""
    root = server.get(f"environments/{site}/versions/{version}")["root"]
    channels = server.get(f"environments/{site}/channels", robots="true")
    digest = next(c["overlays"]["digest"] for c in channels if c["channel"] == "production")
    body = {"environment": site, "channel": "production", "version": version, "root": root, "state": state}
    server.call("PUT", f"robots/{robot}/status", json={**body, "overlays": digest, **more})


def two_way_street(server: WebServer, site: str) -> tuple[dict[str, Any], dict[str, Any], tuple[float, float]]:
    """Return the edges of a street that is far from other things, and its middle."""
    listed = features(server, site)
    places = {f["id"]: (f.get("place") or f["geometry"])["coordinates"] for f in listed if is_node(f)}
    edges = {(f["properties"]["source"], f["properties"]["target"]): f for f in listed if not is_node(f)}
    pairs = [(one, other) for one, other in edges if (other, one) in edges]
    source, target = max(pairs, key=lambda pair: distance(places[pair[0]], places[pair[1]]))
    middle = [(a + b) / 2 for a, b in zip(places[source], places[target], strict=True)]
    return edges[source, target], edges[target, source], (middle[0], middle[1])


def is_node(feature: dict[str, Any]) -> bool:
    return "source" not in feature["properties"]


def distance(one: list[float], other: list[float]) -> float:
    return float((one[0] - other[0]) ** 2 + (one[1] - other[1]) ** 2)


def bar(page: Page) -> Locator:
    return page.get_by_role("progressbar", name="Robots of production")


def click_map(page: Page, offsets: Iterable[tuple[float, float]]) -> None:
    """Click at places of the map, in metres from its middle."""
    box = page.get_by_role("application").bounding_box()
    assert box is not None
    for x, y in offsets:
        page.mouse.click(
            box["x"] + box["width"] / 2 + x / RESOLUTION, box["y"] + box["height"] / 2 - y / RESOLUTION, delay=20
        )


def test_the_bar_fills_as_robots_take_a_version(server: WebServer, site: str, open_page: Open, axe: str) -> None:
    promote(server, site, 1)
    for robot in ROBOTS:
        report(server, site, robot, 1)
    page = open_page(f"/?site={site}&view=fleet")
    channel = page.get_by_role("article", name="Channel production")
    expect(bar(page)).to_have_attribute("aria-valuenow", "4")
    expect(channel).to_contain_text("All hold the same map since")

    promote(server, site, 2)
    expect(bar(page)).to_have_attribute("aria-valuenow", "0")
    report(server, site, "mower-1", 2)
    report(server, site, "mower-2", 2, "downloading", detail="12 of 40 MB")
    report(server, site, "mower-3", 2, "failed", detail="map_server did not answer")
    expect(bar(page)).to_have_attribute("aria-valuetext", "1 of 4 hold this map, 1 failed, 2 behind")
    rows = page.get_by_role("list", name="Robots")
    expect(rows.get_by_role("button", name="mower-2")).to_contain_text("downloading v2: 12 of 40 MB")
    expect(rows.get_by_role("button", name="mower-3")).to_contain_text("1 change behind")
    page.get_by_role("button", name="failed 1").click()
    expect(rows.get_by_role("listitem")).to_have_count(1)
    check_accessibility(page, axe)

    for robot in ROBOTS:
        report(server, site, robot, 2)
    expect(bar(page)).to_have_attribute("aria-valuenow", "4")
    root = server.get(f"environments/{site}/versions/2")["root"]
    expect(channel.get_by_title(root)).to_have_text(root[:8])
    counted = next(c for c in server.get(f"environments/{site}/channels") if c["channel"] == "production")
    assert counted["robots"]["holding"] == 4


def test_a_report_is_closed_for_the_fleet_by_one_tap(server: WebServer, site: str, open_page: Open, axe: str) -> None:
    edge, back, (x, y) = two_way_street(server, site)
    promote(server, site, 2)
    for robot in ROBOTS:
        report(server, site, robot, 2)
    page = open_page(f"/?site={site}&view=fleet&at={x},{y},{RESOLUTION}", color_scheme="dark")
    expect(page.get_by_role("tab", name="Closures")).to_be_visible()
    for one in (edge, back):
        body = {"kind": "blocked", "edge": one["id"], "ttl_seconds": 1800, "detail": "a fallen tree"}
        server.call("POST", f"environments/{site}/overlays", 201, json=body)
    expect(page.get_by_role("tab", name="1 waiting")).to_be_visible()

    click_map(page, [(0, 0)])
    waiting = page.get_by_role("region", name="Waiting for a decision").get_by_role("listitem")
    expect(waiting).to_contain_text("a fallen tree")
    expect(waiting).to_contain_text(re.compile(r"ends in\s*2\d:\d\d"))
    check_accessibility(page, axe)
    waiting.get_by_role("button", name="Close for all robots").click()
    expect(page.get_by_role("status").filter(has_text="Closed for all robots")).to_be_visible()
    closed = page.get_by_role("region", name="Closed now").get_by_role("listitem")
    expect(closed).to_contain_text("a fallen tree")
    in_force = server.get(f"environments/{site}/overlays", state="accepted")
    assert {overlay["edge"] for overlay in in_force} == {edge["id"], back["id"]}
    assert {overlay["decided_by"] for overlay in in_force} != {None}

    expect(page.get_by_text("production: 0 of 4 robots keep out")).to_be_visible()
    report(server, site, "mower-1", 2)
    expect(page.get_by_text("production: 1 of 4 robots keep out")).to_be_visible()

    closed.get_by_role("button", name="End now").click()
    expect(page.get_by_role("status").filter(has_text="Open again")).to_be_visible()
    expect(closed).to_have_count(0)
    assert server.get(f"environments/{site}/overlays", state="accepted") == []
    report(server, site, "mower-1", 2)


def test_streets_and_areas_are_closed_on_the_map(server: WebServer, site: str, open_page: Open) -> None:
    edge, back, (x, y) = two_way_street(server, site)
    page = open_page(f"/?site={site}&view=fleet&fleet=closures&at={x},{y},{RESOLUTION}")
    page.get_by_role("button", name="Close a street").click()
    form = page.get_by_role("form", name="Close a street")
    click_map(page, [(0, 0)])
    expect(form.get_by_role("checkbox", name="Both directions")).to_be_checked()
    form.get_by_label("Why").fill("<b>ladders</b>")
    form.get_by_label("Until").select_option("15 minutes")
    form.get_by_role("button", name="Close for all robots").click()
    expect(form).to_have_count(0)
    expect(page.get_by_role("region", name="Closed now")).to_contain_text("<b>ladders</b>")
    in_force = server.get(f"environments/{site}/overlays", state="accepted")
    assert sorted(overlay["edge"] for overlay in in_force) == sorted([edge["id"], back["id"]])

    page.get_by_role("button", name="Close an area").click()
    form = page.get_by_role("form", name="Close an area")
    expect(form.get_by_role("button", name="Close for all robots")).to_be_disabled()
    click_map(page, [(-2, -1), (2, -1), (2, 1), (-2, 1), (-3, 0)])
    expect(form).to_contain_text("5 corners")
    form.get_by_role("button", name="Remove the last").click()
    form.get_by_role("button", name="Close for all robots").click()
    expect(page.get_by_role("region", name="Closed now").get_by_role("listitem")).to_have_count(2)
    area = next(o for o in server.get(f"environments/{site}/overlays", state="accepted") if "polygon" in o)
    corners = [(-2, -1), (2, -1), (2, 1), (-2, 1)]
    assert len(area["polygon"]["coordinates"][0]) == 5
    for (px, py), (dx, dy) in zip(area["polygon"]["coordinates"][0], corners, strict=False):
        assert (px, py) == (pytest.approx(x + dx, abs=2 * RESOLUTION), pytest.approx(y + dy, abs=2 * RESOLUTION))
    for overlay in server.get(f"environments/{site}/overlays", state="accepted"):
        server.call("POST", f"environments/{site}/overlays/{overlay['id']}/end")
    viewer = open_page(f"/?site={site}&view=fleet&fleet=closures", token=server.make_token("viewer")["token"])
    expect(viewer.get_by_text("Ended in the last 30 days")).to_be_visible()
    expect(viewer.get_by_role("button", name="Close a street")).to_have_count(0)


def test_a_long_press_starts_closing_a_street(server: WebServer, site: str, open_page: Open) -> None:
    edge, back, (x, y) = two_way_street(server, site)
    page = open_page(f"/?site={site}&view=fleet&at={x},{y},{RESOLUTION}", size=TABLET, has_touch=True)
    page.get_by_role("tab", name="Closures").wait_for()
    wait_until(page, "document.querySelectorAll('.painted-layer:not([hidden])').length > 2")
    box = page.get_by_role("application").bounding_box()
    assert box is not None
    centre = {"x": box["x"] + box["width"] / 2, "y": box["y"] + box["height"] / 2}
    session = page.context.new_cdp_session(page)
    session.send("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": [centre]})
    form = page.get_by_role("form", name="Close a street")
    expect(form).to_be_visible()
    session.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    expect(form.get_by_role("combobox").first).to_have_value(re.compile(f"{edge['id']}|{back['id']}"))


def test_the_map_as_a_robot_held_it(server: WebServer, site: str, open_page: Open) -> None:
    """The version and the closures of then, exact by the digest that the robot reported."""
    edge, _, _ = two_way_street(server, site)
    promote(server, site, 1)
    body = {"kind": "blocked", "edge": edge["id"], "state": "accepted", "ttl_seconds": 600}
    overlay = server.call("POST", f"environments/{site}/overlays", 201, json=body)
    report(server, site, "reaper", 1)
    server.call("POST", f"environments/{site}/overlays/{overlay['id']}/end")
    promote(server, site, 2)
    report(server, site, "reaper", 2)
    page = open_page(f"/?site={site}&view=fleet")
    page.get_by_role("list", name="Robots").get_by_role("button", name="reaper").click()
    card = page.get_by_role("article", name="Robot reaper")
    then = card.get_by_role("listitem").filter(has_text="active v1")
    then.get_by_role("button", name="Map then").click()
    note = page.get_by_role("status").filter(has_text="Map as reaper held it at")
    expect(note).to_contain_text("v1, 1 closed")
    expect(page.get_by_title("Which version is shown")).to_contain_text("v1 · 1 behind the latest")
    page.reload()
    expect(note).to_contain_text("v1, 1 closed")
    note.get_by_role("button", name="Back to now").click()
    expect(note).to_have_count(0)
    expect(page.get_by_title("Which version is shown")).to_contain_text("v2")
    server.call("DELETE", "robots/reaper", params={"environment": site})


def test_five_hundred_robots(server: WebServer, site: str, open_page: Open) -> None:
    """The list stays short, and all arrive without reading the list again."""
    promote(server, site, 2)
    for robot in ROBOTS:
        report(server, site, robot, 2)
    fleet = [f"fleet-{number:03}" for number in range(500)]
    roots = {version: server.get(f"environments/{site}/versions/{version}")["root"] for version in (1, 2)}

    def report_all(version: int) -> None:
        body = {"environment": site, "channel": "production", "version": version, "root": roots[version]}
        headers = {"prefer": "return=minimal"}

        def put(robot: str) -> None:
            server.call("PUT", f"robots/{robot}/status", 204, json={**body, "state": "active"}, headers=headers)

        with ThreadPoolExecutor(16) as pool:
            list(pool.map(put, fleet))

    report_all(1)
    channels = server.get(f"environments/{site}/channels")
    total = next(c["robots"]["total"] for c in channels if c["channel"] == "production")
    page = open_page(f"/?site={site}&view=fleet")
    expect(bar(page)).to_have_attribute("aria-valuetext", re.compile(f"of {total} hold this map, .*500 behind"))
    rows = page.get_by_role("list", name="Robots").get_by_role("listitem")
    expect(rows).to_have_count(100)
    expect(page.get_by_text(f"{total - 100} more robots: search or filter to find them.")).to_be_visible()
    lists: list[str] = []
    page.on("request", lambda request: lists.append(request.url) if "/api/v1/robots" in request.url else None)
    report_all(2)
    expect(bar(page)).not_to_have_attribute("aria-valuetext", re.compile("behind"))
    assert lists == []
    page.get_by_role("searchbox", name="Search robots").fill("fleet-499")
    expect(rows).to_have_count(1)
    expect(rows).to_contain_text("runs v2")
