"""Editing in a real browser: what is drawn is what the server then has, and nothing is lost on the way."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest
from playwright.sync_api import Page, Route, expect

from tests.web.conftest import TABLET, Open, WebServer

RESOLUTION = 0.05
"""Metres in a pixel of the map, in all tests."""

CENTRE = (20.0, 12.0)


@dataclass(frozen=True)
class Editing:
    """The Edit view, by metres of the local frame."""

    page: Page

    def pixel(self, x: float, y: float) -> tuple[float, float]:
        box = self.page.locator(".map").bounding_box()
        assert box is not None
        return (
            box["x"] + box["width"] / 2 + (x - CENTRE[0]) / RESOLUTION,
            box["y"] + box["height"] / 2 - (y - CENTRE[1]) / RESOLUTION,
        )

    def click(self, x: float, y: float, **more: Any) -> None:
        # Behind the timer of 250 ms by which the map tells two clicks, wherever they are, from a double click.
        self.page.evaluate("new Promise(resolve => setTimeout(resolve, 300))")
        self.page.mouse.move(*self.pixel(x, y))
        self.page.mouse.click(*self.pixel(x, y), **more)

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        mouse = self.page.mouse
        mouse.move(*self.pixel(*start))
        mouse.down()
        mouse.move(*self.pixel((start[0] + end[0]) / 2, (start[1] + end[1]) / 2), steps=3)
        mouse.move(*self.pixel(*end), steps=3)
        mouse.up()

    def tool(self, name: str) -> None:
        self.page.get_by_role("toolbar", name="Editing tools").get_by_role(
            "button", name=re.compile(f"^{name}")
        ).click()

    def changes(self, count: str) -> None:
        expect(self.page.get_by_role("region", name="Edit").locator(".edit-status")).to_contain_text(count)

    def select(self, name: str) -> None:
        """Select by the list, as without a pointer."""
        search = self.page.get_by_placeholder("Search by name, id or kind")
        if not search.is_visible():
            self.page.get_by_text("Features", exact=True).click()
        search.fill(name)
        self.page.get_by_role("button", name=name, exact=True).click()

    def save(self, message: str, version: int) -> None:
        self.page.get_by_role("button", name="Review", exact=True).click()
        dialog = self.page.get_by_role("dialog", name="Review and save")
        dialog.get_by_label("Message").fill(message)
        dialog.get_by_role("button", name=re.compile("^Save ")).click()
        expect(self.page.get_by_text(f"Saved as v{version}")).to_be_visible()


Edit = Callable[..., Editing]


@pytest.fixture
def edit(open_page: Open) -> Edit:
    """Return a function that opens the Edit view of a site."""

    def open_one(site: str, **more: Any) -> Editing:
        at = f"{CENTRE[0]},{CENTRE[1]},{RESOLUTION}"
        page = open_page(f"/?site={site}&view=edit&at={at}", **more)
        expect(page.get_by_role("toolbar", name="Editing tools")).to_be_visible()
        expect(page.locator(".map-area")).to_have_attribute("aria-busy", "false")
        return Editing(page)

    return open_one


def make_network(server: WebServer, name: str, **nodes: tuple[float, float]) -> str:
    """Create an environment with nodes and one two-way street between the first two."""
    server.call("POST", "environments", json={"name": name})
    changes = [put(node, "Point", list(at), kind="node", name=node) for node, at in nodes.items()]
    first, second = list(nodes)[:2]
    for source, target in ((first, second), (second, first)):
        line = [list(nodes[source]), list(nodes[target])]
        changes.append(put(f"{source}_{target}", "LineString", line, kind="edge", source=source, target=target))
    server.call("POST", f"environments/{name}/edits", 201, json={"message": "start", "changes": changes})
    return name


def put(item: str, shape: str, coordinates: list[Any], **properties: Any) -> dict[str, Any]:
    feature = {"type": "Feature", "id": item, "geometry": None, "properties": properties}
    place = {"type": shape, "coordinates": coordinates}
    return {"op": "put", "layer": "topology", "feature": {**feature, "place": place}}


def features(server: WebServer, site: str, layer: str = "topology", version: str = "latest") -> dict[str, Any]:
    answer = server.get(f"environments/{site}/versions/{version}/layers/{layer}", crs="local")
    return {feature["id"]: feature for feature in answer["features"]}


def at(feature: dict[str, Any]) -> tuple[float, ...]:
    geometry = feature.get("place") or feature["geometry"]
    return tuple(round(value, 6) for value in geometry["coordinates"])


def test_draw_split_undo_reload_and_save(server: WebServer, edit: Edit) -> None:
    site = make_network(server, "drawn", a=(10, 10), b=(20, 10))
    editing = edit(site)
    page = editing.page
    editing.tool("Draw lanes")
    editing.click(20, 10)
    editing.click(20, 15)  # a node and a street
    editing.click(30, 15.2)  # drawn onto 90°
    editing.click(15, 10.1)  # splits a–b
    page.keyboard.press("Enter")
    editing.changes("9 changes")
    page.keyboard.press("Control+z")
    editing.changes("4 changes")
    page.keyboard.press("Control+y")
    page.keyboard.press("Control+z")
    editing.tool("Split lanes")
    editing.click(25, 15)
    editing.changes("6 changes")
    expect(page.get_by_text("kept on this device")).to_be_visible()

    page.reload()
    expect(page.get_by_text("Restored 6 changes")).to_be_visible()
    page.keyboard.press("Control+z")  # history is restored too
    editing.changes("4 changes")
    page.keyboard.press("Control+y")
    editing.changes("6 changes")
    assert server.get(f"environments/{site}")["version"] == 1
    editing.save("a loop", 2)
    editing.changes("No changes")

    found = features(server, site)
    nodes = {item: at(one) for item, one in found.items() if one["properties"]["kind"] == "node"}
    middle = next(item for item in nodes if item not in ("a", "b", "n1", "n2"))
    assert set(nodes) == {"a", "b", "n1", "n2", middle}
    assert nodes["n1"] == pytest.approx((20, 15), abs=RESOLUTION)
    assert nodes["n2"][1] == nodes["n1"][1]
    streets = {("a", "b"), ("b", "n1"), ("n1", middle), (middle, "n2")}
    edges = {(p["source"], p["target"]) for p in (one["properties"] for one in found.values()) if p["kind"] == "edge"}
    assert edges == streets | {(target, source) for source, target in streets}
    assert server.get(f"environments/{site}/versions/2")["message"] == "a loop"


def test_two_editors_lose_nothing(server: WebServer, edit: Edit) -> None:
    site = make_network(server, "shared", a=(10, 10), b=(20, 10), c=(15, 15), d=(25, 15))
    anna, ben = edit(site), edit(site)
    anna.select("Node c")
    anna.page.get_by_label("x, metres").fill("16.125")
    anna.page.get_by_label("x, metres").press("Enter")
    anna.changes("1 change")
    # Ben moves another node, and draws one whose id Anna uses as well.
    ben.drag((25, 15), (27, 15))
    ben.tool("Draw lanes")
    ben.click(12, 18)
    ben.page.keyboard.press("Enter")
    anna.tool("Draw lanes")
    anna.click(28, 18)
    anna.page.keyboard.press("Enter")
    anna.save("c is further east", 2)
    ben.save("d is further east", 3)  # merged without a question
    expect(ben.page.get_by_text("Merged with v2")).to_be_visible()
    found = features(server, site)
    assert at(found["c"]) == (16.125, 15)
    assert at(found["d"]) == pytest.approx((27, 15), abs=RESOLUTION)
    assert at(found["n1"]) == pytest.approx((28, 18), abs=RESOLUTION)
    assert at(found["n1-2"]) == pytest.approx((12, 18), abs=RESOLUTION)

    # The same node, by both.
    anna.page.reload()
    anna.page.get_by_role("toolbar", name="Editing tools").wait_for()
    for editing, x in ((anna, "14"), (ben, "13")):
        editing.tool("Select and move")
        editing.select("Node c")
        expect(editing.page.get_by_label("x, metres")).to_have_value("16.125")  # else it may change under the typing
        editing.page.get_by_label("x, metres").fill(x)
        editing.page.get_by_label("x, metres").press("Enter")
    anna.save("c is at 14", 4)
    ben.page.get_by_role("button", name="Review", exact=True).click()
    ben.page.get_by_role("dialog").get_by_role("button", name=re.compile("^Save ")).click()
    conflicts = ben.page.get_by_role("region", name="Conflicts")
    expect(conflicts.get_by_role("heading", name="1 conflict with v4")).to_be_visible()
    conflicts.get_by_role("button", name="Keep both").click()
    conflicts.get_by_role("button", name="Merge and save").click()
    expect(ben.page.get_by_text("Saved as v5")).to_be_visible()
    found = features(server, site)
    assert at(found["c"]) == (14, 15)
    assert (13, 15) in {
        at(one) for item, one in found.items() if item not in ("c",) and one["properties"]["kind"] == "node"
    }


def test_changes_of_one_node_by_two_are_joined(server: WebServer, edit: Edit) -> None:
    site = make_network(server, "joined", a=(10, 10), b=(20, 10), c=(15, 15))
    anna, ben = edit(site), edit(site)
    anna.select("Node c")
    anna.page.get_by_label("name", exact=True).fill("Gate")
    anna.page.get_by_label("name", exact=True).press("Enter")
    ben.drag((15, 15), (17, 15))
    anna.save("c is the gate", 2)
    ben.save("c is further east", 3)
    expect(ben.page.get_by_text("has the changes of both")).to_be_visible()
    gate = features(server, site)["c"]
    assert gate["properties"]["name"] == "Gate"
    assert at(gate) == pytest.approx((17, 15), abs=RESOLUTION)


def test_a_node_dropped_onto_a_lane_joins_it(server: WebServer, edit: Edit) -> None:
    site = make_network(server, "dropped", a=(10, 10), b=(20, 10), c=(15, 15), d=(15, 6))
    editing = edit(site)
    page = editing.page
    editing.drag((15, 15), (14, 10.1))
    editing.changes("4 changes")  # the node, the old street, two new ones
    page.keyboard.press("Control+z")
    editing.changes("No changes")
    page.keyboard.press("Control+y")
    editing.click(12, 20)
    page.keyboard.down("Alt")
    editing.drag((15, 6), (17, 9.9))
    page.keyboard.up("Alt")
    editing.save("c is on the lane", 2)
    found = features(server, site)
    assert at(found["c"]) == pytest.approx((14, 10), abs=RESOLUTION)
    assert at(found["d"]) == pytest.approx((17, 9.9), abs=RESOLUTION)
    edges = {(p["source"], p["target"]) for p in (one["properties"] for one in found.values()) if p["kind"] == "edge"}
    assert edges == {("a", "c"), ("c", "a"), ("c", "b"), ("b", "c")}


def test_moving_by_touch(server: WebServer, edit: Edit) -> None:
    site = make_network(server, "touched", a=(15, 12), b=(22, 12))
    editing = edit(site, size=TABLET, has_touch=True)
    page = editing.page
    page.touchscreen.tap(*editing.pixel(22, 12))
    expect(page.get_by_role("heading", name="Node b")).to_be_visible()
    session = page.context.new_cdp_session(page)

    def touch(kind: str, *points: tuple[float, float]) -> None:
        places = [{"x": x, "y": y} for x, y in (editing.pixel(*point) for point in points)]
        session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": places})

    touch("touchStart", (22, 12))
    for step in range(1, 6):
        touch("touchMove", (22 + step * 0.4, 12 + step * 0.4))
    touch("touchEnd")
    editing.changes("1 change")
    editing.save("b by touch", 2)
    found = features(server, site)
    assert at(found["b"]) == pytest.approx((24, 14), abs=2 * RESOLUTION)
    line = (found["a_b"].get("place") or found["a_b"]["geometry"])["coordinates"]
    assert tuple(line[-1][:2]) == pytest.approx(at(found["b"]))


def test_keyboard_alone(server: WebServer, edit: Edit) -> None:
    site = make_network(server, "typed", a=(10, 10), b=(20, 10))
    page = edit(site).page
    page.keyboard.press("a")
    page.get_by_role("application").focus()
    page.keyboard.press("Space")  # a node at the cross, in the middle of the map
    page.keyboard.press("Enter")
    page.keyboard.press("z")
    for x, y in (("2", "3"), ("6.5", "3"), ("6.5", "5.001"), ("2", "5.001")):
        page.get_by_label("x, metres").first.fill(x)
        page.get_by_label("y, metres").first.fill(y)
        page.keyboard.press("Enter")
    page.get_by_role("button", name="Finish").press("Enter")
    expect(page.get_by_role("heading", name="Zone (keepout)")).to_be_visible()
    page.get_by_role("application").focus()
    page.keyboard.press("Escape")
    page.keyboard.press("Control+s")
    page.keyboard.press("Tab")
    page.get_by_role("button", name=re.compile("^Save 2")).press("Enter")
    expect(page.get_by_text("Saved as v2")).to_be_visible()
    zone = next(iter(features(server, site, "zones").values()))
    geometry = zone.get("place") or zone["geometry"]
    assert geometry["coordinates"][0] == [[2, 3], [6.5, 3], [6.5, 5.001], [2, 5.001], [2, 3]]
    assert zone["properties"] == {"kind": "keepout"}
    assert at(features(server, site)["n1"]) == pytest.approx(CENTRE, abs=RESOLUTION)


def test_an_ended_session_keeps_the_draft(server: WebServer, edit: Edit) -> None:
    site = make_network(server, "ended", a=(10, 10), b=(20, 10), c=(15, 15))
    editing = edit(site)
    page = editing.page
    editing.click(15, 10)
    page.get_by_role("button", name="Make one-way").click()
    page.get_by_label("New property", exact=True).fill("speed_limit")
    page.get_by_label("Value of the new property").fill("0.8")
    page.get_by_role("button", name="Set", exact=True).click()
    editing.changes("2 changes")
    late: list[Route] = []  # the dry run, which is answered after the next sign-in
    page.route("**/edits", lambda route: route.continue_() if late else late.append(route))
    with page.expect_request("**/edits"):
        page.locator("button", has_text=re.compile("^Review$")).click()
    save = page.locator("button", has_text=re.compile("^Save 2 changes$"))
    expect(save).to_be_enabled()
    page.context.clear_cookies()
    save.dispatch_event("click")  # a check may have opened the dialog before
    dialog = page.get_by_role("dialog", name="Sign in again")
    dialog.get_by_label("Token").fill(server.token)
    dialog.get_by_role("button", name="Sign in").click()
    expect(dialog).to_be_hidden()
    with page.expect_response(lambda answer: answer.request == late[0].request):
        late[0].fulfill(status=401, json={"status": 401, "title": "Not signed in", "detail": "the session has ended"})
    save.click()
    expect(page.get_by_text("Saved as v2")).to_be_visible()
    edges = [one["properties"] for one in features(server, site).values() if one["properties"]["kind"] == "edge"]
    assert len(edges) == 1
    assert edges[0]["speed_limit"] == 0.8


def test_cells_and_merging_by_dropping(server: WebServer, edit: Edit) -> None:
    site = server.make_site("painted", rows=2, row_length=20)
    editing = edit(site)
    page = editing.page
    before = occupied(server, site)
    editing.tool("Set cells")
    for x, y in ((15, 8), (16, 8), (16, 9), (15, 9)):
        editing.click(x, y)
    page.keyboard.press("Enter")
    editing.changes("1 change")
    editing.save("a box", 2)
    assert occupied(server, site) > before


def occupied(server: WebServer, site: str) -> int:
    answer = server.http.get(
        f"/api/v1/environments/{site}/versions/latest/layers/occupancy",
        params={"name": "map"},
        headers={"accept": "application/json"},
    )
    return int(answer.json()["counts"]["occupied"])


def test_draft_that_is_left_waits_for_its_user(server: WebServer, edit: Edit) -> None:
    site = make_network(server, "left", a=(10, 10), b=(20, 10))
    anna, ben = (server.make_token("editor", name=name)["token"] for name in ("Anna", "Ben"))
    editing = edit(site, token=anna)
    page, address = editing.page, editing.page.url
    editing.tool("Draw lanes")
    editing.click(12, 18)
    editing.changes("1 change")
    expect(page.get_by_text("kept on this device")).to_be_visible()
    for token, changes in ((ben, "No changes"), (anna, "1 change")):
        page.get_by_role("button", name="Sign out").click()
        page.get_by_label("Token").fill(token)
        page.get_by_role("button", name="Sign in", exact=True).click()
        expect(page.get_by_role("heading", name="Sites")).to_be_visible()  # not what the last user had open
        page.goto(address)
        editing.changes(changes)


def test_ruler_and_views_take_clicks_in_any_order(server: WebServer, edit: Edit) -> None:
    site = make_network(server, "measured", a=(10, 10), b=(20, 10))
    editing = edit(site)
    page = editing.page
    ruler, measure = page.get_by_role("button", name="Measure", exact=True), page.locator(".measure")

    def show(view: str) -> None:
        page.get_by_role("link", name=view, exact=True).click()
        expect(page.get_by_role("region", name=view, exact=True)).to_be_visible()

    ruler.click()
    show("Layers")  # it goes on measuring there
    for x in (25, 27):
        editing.click(x, 18)
    expect(measure).to_contain_text("2.0")
    ruler.click()
    editing.click(20, 10)
    expect(page.get_by_role("article", name="Selected: b")).to_be_visible()  # a click selects again

    ruler.click()
    show("Edit")
    expect(page.get_by_role("toolbar", name="Editing tools")).to_be_visible()
    ruler.click()
    editing.tool("Draw lanes")
    editing.click(12, 18)
    editing.changes("1 change")
    show("Layers")
    expect(measure).to_have_count(0)
    editing.click(10, 10)
    expect(page.get_by_role("article", name="Selected: a")).to_be_visible()
    expect(measure).to_have_count(0)
