"""History in the page: time line, comparison, restoring, promotion with its impact, roll back, planned moves."""

from __future__ import annotations

import re
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from tests.web.conftest import TABLET, Open, WebServer, check_accessibility

DELETED = "r1.5-c0_r1.5-c1"
CLOSED = [[30, 20], [33, 20], [33, 26], [30, 26], [30, 20]]


@pytest.fixture(scope="module", autouse=True)
def orchard(server: WebServer) -> None:
    """Make an orchard of three versions: version 3 adds, moves and deletes nodes and edges, and blocks cells."""
    server.make_site("orchard")
    edit(server, "A wash place", put_node("Wash1", 30, 3), put_edge("Yard2", "Wash1"), put_edge("Wash1", "Yard2"))
    server.call("PUT", "environments/orchard/channels/production", json={"version": 1})
    server.call("PUT", "environments/orchard/channels/production", json={"version": 2})
    moved = feature(server, "r1.5-c4")
    assert moved is not None
    moved["place"]["coordinates"][0] += 1.2
    edit(
        server,
        "Row 1 is closed",
        {"op": "put", "layer": "topology", "feature": moved},
        put_node("Pump", 20, 2),
        {"op": "delete", "layer": "topology", "id": DELETED},
        {"op": "cells", "crs": "local", "polygon": {"type": "Polygon", "coordinates": [CLOSED]}, "value": 100},
    )
    report(server, "mule-1", node="r1.5-c0", route=[DELETED])
    report(server, "mule-2", pose={"x": 40, "y": 30, "yaw": 0, "level": "ground"})
    report(server, "tractor-7")


def put_node(name: str, x: float, y: float) -> dict[str, Any]:
    place = {"type": "Point", "coordinates": [x, y]}
    properties = {"kind": "node", "name": name}
    item = {"type": "Feature", "id": name, "geometry": None, "place": place, "properties": properties}
    return {"op": "put", "layer": "topology", "feature": item}


def put_edge(source: str, target: str) -> dict[str, Any]:
    properties = {"kind": "edge", "source": source, "target": target}
    item = {"type": "Feature", "id": f"{source}_{target}", "geometry": None, "properties": properties}
    return {"op": "put", "layer": "topology", "feature": item}


def edit(server: WebServer, message: str, *changes: dict[str, Any]) -> int:
    made = server.call("POST", "environments/orchard/edits", 201, json={"message": message, "changes": list(changes)})
    return int(made["version"])


def feature(server: WebServer, name: str, version: str = "latest") -> dict[str, Any] | None:
    found = server.get(f"environments/orchard/versions/{version}/layers/topology", crs="local", ids=name)["features"]
    return found[0] if found else None


def report(server: WebServer, robot: str, **place: Any) -> None:
    root = server.get("environments/orchard/versions/2")["root"]
    status = {"environment": "orchard", "channel": "production", "version": 2, "root": root, "state": "active"}
    server.call("PUT", f"robots/{robot}/status", json={**status, **place})


def channel(server: WebServer, name: str = "production") -> dict[str, Any]:
    return next(one for one in server.get("environments/orchard/channels") if one["channel"] == name)


def head(server: WebServer) -> int:
    return int(server.get("environments/orchard")["version"])


def pixels(page: Page, colour: str) -> int:
    """Count the pixels of a colour of the theme on the map's visible layers."""
    return int(
        page.evaluate(
            """name => {
            const probe = document.createElement('canvas').getContext('2d');
            probe.fillStyle = getComputedStyle(document.documentElement).getPropertyValue(name);
            probe.fillRect(0, 0, 1, 1);
            const wanted = new Uint32Array(probe.getImageData(0, 0, 1, 1).data.buffer)[0];
            let count = 0;
            for (const canvas of document.querySelectorAll('.painted-layer:not([hidden]) canvas')) {
              const {data} = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
              for (const word of new Uint32Array(data.buffer)) if (word === wanted) count += 1;
            } return count; }""",
            f"--map-{colour}",
        )
    )


def wait_for_pixels(page: Page, colour: str) -> None:
    for _ in range(120):
        if pixels(page, colour) > 10:
            return
        page.wait_for_timeout(250)
    pytest.fail(f"nothing is drawn in the colour {colour}")


def test_versions_are_compared_and_a_feature_restored(open_page: Open, server: WebServer, axe: str) -> None:
    page = open_page("/?site=orchard&view=history")
    line = page.get_by_role("list", name="Versions, newest first")
    third = line.get_by_role("button", name="Row 1 is closed")
    expect(third).to_contain_text("map: ")
    expect(third).to_contain_text("cells blocked")
    expect(line.get_by_role("button", name="A wash place")).to_contain_text("production")
    third.click()
    page.get_by_role("button", name="Compare with v2").click()
    expect(page.get_by_role("heading", name="v2 → v3")).to_be_visible()
    assert "from=2" in page.url
    expect(page.get_by_role("button", name="Pump added")).to_be_visible()
    expect(page.get_by_role("region", name="Changed: Edges").get_by_text("moved").first).to_be_visible()
    for colour in ("added", "changed", "deleted"):
        wait_for_pixels(page, colour)
    check_accessibility(page, axe)

    page.get_by_role("button", name="Swipe").click()
    handle = page.get_by_role("slider", name="Swipe: v2 on the left, v3 on the right")
    handle.press("Home")
    expect(handle).to_have_attribute("aria-valuenow", "0")
    page.get_by_role("button", name="Blink").click()
    page.get_by_role("button", name="Showing v3: show v2").click()  # reduced motion: by hand
    expect(page.get_by_role("button", name="Showing v2: show v3")).to_be_visible()
    page.get_by_role("button", name="Overlay").click()

    page.get_by_placeholder("Search by name, id or property").fill(DELETED)
    page.get_by_role("button", name=f"{DELETED} deleted").click()
    card = page.get_by_role("article")
    expect(card).to_contain_text("speed_limit")
    before = feature(server, DELETED, "2")
    card.get_by_role("button", name="Restore this").click()
    expect(page.get_by_text("is as in v2 again: saved as v4")).to_be_visible()
    assert feature(server, DELETED) == before
    assert head(server) == 4
    expect(page.get_by_role("heading", name="v2 → v4")).to_be_visible()
    expect(page.get_by_role("button", name=f"{DELETED} deleted")).to_have_count(0)


def test_version_is_restored_after_a_look_at_what_changes(open_page: Open, server: WebServer) -> None:
    now = edit(server, "A well", put_node(f"Well{head(server)}", 2, 2))
    page = open_page("/?site=orchard&view=history&version=3", size=TABLET)
    page.get_by_role("button", name="Restore…").click()
    dialog = page.get_by_role("dialog", name="Restore version 3")
    expect(dialog).to_contain_text(re.compile(r"Network: \d deleted"))
    dialog.get_by_label("Message").fill("Back to the closed row")
    dialog.get_by_role("button", name="Restore as a new version").click()
    expect(page.get_by_text(f"Version 3 is restored as v{now + 1}")).to_be_visible()
    made = server.get("environments/orchard/versions/latest")
    assert (made["version"], made["message"]) == (now + 1, "Back to the closed row")
    assert made["root"] == server.get("environments/orchard/versions/3")["root"]


def test_promotion_tells_its_impact_and_is_rolled_back(open_page: Open, server: WebServer, axe: str) -> None:
    page = open_page("/?site=orchard&view=history&version=3")
    page.get_by_role("button", name="Promote…").click()
    impact = page.get_by_role("region", name="Impact")
    expect(impact.get_by_role("button", name="mule-1")).to_contain_text(f"the edge {DELETED} of its route is deleted")
    expect(impact).to_contain_text("1 robot has not reported where it is: tractor-7")
    expect(impact).to_contain_text("1 robot is clear of it: mule-2")
    expect(impact).to_contain_text("1 edge deleted")
    expect(page.get_by_text("Checks find")).to_be_visible()
    wait_for_pixels(page, "robot")
    check_accessibility(page, axe)
    assert channel(server)["version"] == 2
    page.get_by_role("button", name="Promote now").click()
    expect(page.get_by_text("production is now v3")).to_be_visible()
    assert channel(server)["version"] == 3

    row = page.get_by_role("listitem", name="Channel production")
    row.get_by_role("button", name="Roll back to v2").click()
    form = page.get_by_role("form", name="Roll back")
    expect(form.get_by_role("region", name="Impact")).to_be_visible()
    form.get_by_role("button", name="Roll back now").click()
    expect(page.get_by_text("production is now v2")).to_be_visible()
    assert channel(server)["version"] == 2
    page.get_by_role("button", name="Return to v3").last.click()  # of the message: undone by one tap
    expect(page.get_by_text("production is v3 again")).to_be_visible()
    assert channel(server)["version"] == 3


def test_moves_are_planned_and_cancelled(open_page: Open, server: WebServer) -> None:
    page = open_page("/?site=orchard&view=history&promote=1&channel=test-field", size=TABLET)
    page.get_by_label("Later").check()
    page.get_by_label("Time of the move").fill("2090-01-31T06:00")
    page.get_by_role("button", name="Plan the move").click()
    row = page.get_by_role("listitem", name="Channel test-field")
    expect(row).to_contain_text("31 Jan 2090")
    assert channel(server, "test-field")["planned"]["version"] == 1
    row.get_by_role("button", name="Cancel").click()
    expect(row.get_by_text("31 Jan 2090")).to_have_count(0)
    assert channel(server, "test-field")["planned"] is None

    page.goto("/?site=orchard&view=history&promote=2&channel=test-field")
    page.get_by_label("Roll-out").check()
    page.get_by_label("Ready, % of online robots").fill("80")
    page.get_by_role("button", name="Start the roll-out").click()
    expect(row).to_contain_text("moves at 80 %")
    rollout = channel(server, "test-field")["rollout"]
    assert (rollout["state"], rollout["ready"], rollout["failed"]) == ("waiting", 0.8, 0.2)


def test_viewer_reads_history_only(open_page: Open, server: WebServer) -> None:
    page = open_page("/?site=orchard&view=history&version=3", token=server.make_token("viewer")["token"])
    expect(page.get_by_role("button", name="Compare with v2")).to_be_visible()
    for name in ("Promote…", "Restore…", "Roll back to v2"):
        expect(page.get_by_role("button", name=name)).to_have_count(0)


def test_map_is_shown_as_a_robot_had_it(open_page: Open, server: WebServer) -> None:
    root = server.get("environments/orchard/versions/1")["root"]
    status = {"environment": "orchard", "channel": "production", "version": 1, "root": root, "state": "active"}
    server.call("PUT", "robots/mule-9/status", json=status)
    page = open_page("/?site=orchard&view=history")
    page.get_by_text("The map as a robot had it").click()
    page.get_by_role("combobox", name="Robot").select_option("mule-9")
    expect(page.get_by_role("status").filter(has_text="mule-9 had v1")).to_be_visible()
    expect(page.get_by_role("link", name="v1")).to_be_visible()  # in the top bar: the version on the map
    page.get_by_label("Time").fill("2020-01-01T12:00:00")
    expect(page.get_by_text("mule-9 had not reported a map by then.")).to_be_visible()
