"""Upload in a browser: files are tried, drawn, committed once; what goes wrong is told, and nothing is lost."""

from __future__ import annotations

from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from tests.web.conftest import TABLET, Open, WebServer, check_accessibility, wait_until

GRID = "image: yard.pgm\nresolution: 0.1\norigin: [0, 0, 0]\noccupied_thresh: 0.65\nfree_thresh: 0.25\nnegate: 0\n"
BROKEN = '<osm version="0.6">\n<node id="1" lat="52" lon="5"/>\n<node id="2" lat="x" lon="5"/>\n</osm\n'


@pytest.fixture
def grid(tmp_path: Path) -> list[Path]:
    """Return a free yard of 4 m by 3 m with a wall, as an occupancy grid."""
    rows = [[0 if row == 10 else 254 for _ in range(40)] for row in range(30)]
    (tmp_path / "yard.pgm").write_bytes(b"P5\n40 30\n255\n" + bytes(value for row in rows for value in row))
    (tmp_path / "yard.yaml").write_text(GRID)
    return [tmp_path / "yard.yaml", tmp_path / "yard.pgm"]


def empty_site(server: WebServer, name: str) -> str:
    server.call("POST", "environments", json={"name": name, "title": name.title()})
    return name


def choose(page: Page, *files: Path) -> None:
    page.get_by_label("Choose files", exact=True).or_(page.get_by_label("Add files", exact=True)).locator(
        "css=:scope:is(input)"
    ).set_input_files(list(files))


def try_files(page: Page) -> None:
    page.get_by_role("button", name="Try", exact=True).click()


def node(name: str, x: float) -> dict[str, object]:
    place = {"type": "Point", "coordinates": [x, 1]}
    feature = {"type": "Feature", "id": name, "geometry": None, "place": place, "properties": {"kind": "node"}}
    return {"op": "put", "layer": "topology", "feature": feature}


def test_files_are_tried_drawn_and_committed(open_page: Open, server: WebServer, axe: str, grid: list[Path]) -> None:
    site = empty_site(server, "yard")
    page = open_page(f"/?site={site}&view=upload")
    expect(page.get_by_text("Drop this site’s first map here")).to_be_visible()
    check_accessibility(page, axe)
    choose(page, *grid)
    expect(page.get_by_text("yard.pgm")).to_be_visible()
    try_files(page)
    changes = page.get_by_role("region", name="What would change")
    expect(changes).to_contain_text("Grid yard: 40 cells blocked, 1,160 cells freed")
    expect(page.get_by_text("Trial: not saved")).to_be_visible()
    expect(page.get_by_text("found: Occupancy grid", exact=False)).to_be_visible()
    wait_until(page, DRAWN, [139, 30, 107])  # the wall, in the colour of cells that are new and occupied
    assert server.get(f"environments/{site}")["version"] == 0
    page.get_by_label("Message").fill("Survey of the yard")
    page.get_by_role("button", name="Commit as v1").click()
    expect(page.get_by_text("v1 committed")).to_be_visible()
    expect(page.get_by_role("link", name="Promote to robots")).to_be_visible()
    assert "dry:" not in page.url
    version = server.get(f"environments/{site}/versions/latest")
    assert (version["version"], version["message"]) == (1, "Survey of the yard")
    assert {source["name"] for source in version["sources"]} == {"yard.yaml", "yard.pgm"}
    page.get_by_role("link", name="Show on the map").click()
    expect(page.get_by_role("button", name="Hide Occupancy “yard”")).to_be_visible()


DRAWN = """([red, green, blue]) =>
  [...document.querySelectorAll('.painted-layer:not([hidden]) canvas')].some((canvas) => {
  const {data} = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
  for (let at = 0; at < data.length; at += 4) {
    if (data[at + 3] > 150 && Math.abs(data[at] - red) + Math.abs(data[at + 1] - green)
        + Math.abs(data[at + 2] - blue) < 12) return true;
  }
  return false;
})"""


def test_broken_file_is_told_with_its_line_and_another_takes_its_place(
    open_page: Open, server: WebServer, axe: str, tmp_path: Path, grid: list[Path]
) -> None:
    site = empty_site(server, "broken")
    page = open_page(f"/?site={site}&view=upload", size=TABLET, has_touch=True, color_scheme="dark")
    bad = tmp_path / "field.osm"
    bad.write_text(BROKEN)
    choose(page, bad)
    try_files(page)
    expect(page.get_by_role("alert")).to_contain_text("field.osm:4")
    expect(page.get_by_role("button", name="Commit", exact=False)).to_have_count(0)
    page.get_by_role("button", name="Remove field.osm").click()
    expect(page.get_by_role("alert")).to_have_count(0)
    choose(page, *grid)
    page.get_by_text("Options", exact=True).or_(page.locator("summary", has_text="Options")).first.click()
    page.get_by_label("Level").fill("L2")
    page.get_by_label("Name of the grid").fill("floor")
    try_files(page)
    expect(page.get_by_role("region", name="What would change")).to_contain_text("Grid floor: 40 cells blocked")
    check_accessibility(page, axe)
    page.get_by_role("link", name="Layers", exact=True).click()  # and back: nothing is lost
    expect(page.get_by_text("Trial: not saved")).to_have_count(0)
    page.get_by_role("link", name="Upload", exact=True).click()
    page.get_by_role("button", name="Commit as v1").click()
    expect(page.get_by_text("v1 committed")).to_be_visible()
    parts = server.get(f"environments/{site}/versions/1/layers")
    assert [(part["layer"], part["level"], part["name"]) for part in parts] == [("occupancy", "L2", "floor")]


def test_version_of_somebody_else_is_told_and_the_files_are_tried_again(
    open_page: Open, server: WebServer, grid: list[Path]
) -> None:
    site = empty_site(server, "meanwhile")
    page = open_page("/")
    page.route("**/api/v1/events?*", lambda route: route.abort())  # or the button is off before it is pressed
    page.goto(f"/?site={site}&view=upload")
    choose(page, *grid)
    try_files(page)
    expect(page.get_by_text("Trial: not saved")).to_be_visible()
    page.get_by_label("Message").fill("A wall")
    server.call("POST", f"environments/{site}/edits", json={"message": "The gate", "changes": [node("gate", 1)]})
    page.get_by_role("button", name="Commit as v1").dispatch_event("click")  # disabled if it has heard of v1 already
    alert = page.get_by_role("alert")
    expect(alert).to_contain_text("v1 was saved meanwhile")
    expect(alert).to_contain_text("The gate")
    assert server.get(f"environments/{site}")["version"] == 1
    page.get_by_role("button", name="Try again on v1").click()
    expect(page.get_by_label("Message")).to_have_value("A wall")
    page.get_by_role("button", name="Commit as v2").click()
    expect(page.get_by_text("v2 committed")).to_be_visible()
    layers = {part["layer"] for part in server.get(f"environments/{site}/versions/2/layers") if part["count"]}
    assert layers == {"topology", "occupancy"}


def test_commit_waits_for_the_server_and_happens_once(open_page: Open, server: WebServer, grid: list[Path]) -> None:
    site = empty_site(server, "offline")
    page = open_page(f"/?site={site}&view=upload")
    choose(page, *grid)
    try_files(page)
    expect(page.get_by_role("button", name="Commit as v1")).to_be_visible()
    # The first attempt arrives, but its response is lost.
    lost: list[int] = []

    def lose(route) -> None:  # type: ignore[no-untyped-def]
        if route.request.method != "POST" or lost:
            route.continue_()
            return
        lost.append(route.fetch().status)
        route.abort("connectionreset")

    page.route(f"**/environments/{site}/versions", lose)
    page.get_by_role("button", name="Commit as v1").click()
    expect(page.get_by_text("v1 committed")).to_be_visible()
    assert lost == [201]
    assert [one["version"] for one in server.get(f"environments/{site}/versions")] == [1, 0]


def test_who_signs_in_again_is_told_nothing_of_tokens(open_page: Open, server: WebServer, grid: list[Path]) -> None:
    site = empty_site(server, "signed")
    page = open_page(f"/?site={site}&view=upload")
    choose(page, *grid)
    page.context.clear_cookies()
    # another request may have opened the dialog before
    page.get_by_role("button", name="Try", exact=True).dispatch_event("click")
    dialog = page.get_by_role("dialog", name="Sign in again")
    dialog.get_by_label("Token").fill(server.token)
    problem = page.locator(".panel .problem")
    expect(problem).to_have_count(1)
    dialog.get_by_role("button", name="Sign in").click()
    expect(dialog).to_be_hidden()
    expect(problem).to_have_count(0)
    try_files(page)
    expect(page.get_by_role("button", name="Commit as v1")).to_be_visible()


def test_files_are_dropped_on_any_view(open_page: Open, server: WebServer) -> None:
    site = empty_site(server, "dropped")
    page = open_page(f"/?site={site}")
    expect(page.get_by_role("link", name="Upload", exact=True)).to_be_visible()
    data = page.evaluate_handle(
        """() => { const data = new DataTransfer();
        data.items.add(new File(['<kml xmlns="http://www.opengis.net/kml/2.2"><Placemark><name>Well</name>'
          + '<Point><coordinates>5.1,52.1</coordinates></Point></Placemark></kml>'], 'wells.kml'));
        return data; }"""
    )
    for event in ("dragenter", "dragover", "drop"):
        page.locator(".map").dispatch_event(event, {"dataTransfer": data})
    expect(page.get_by_text("wells.kml", exact=True)).to_be_visible()
    expect(page.get_by_role("link", name="Upload", exact=True)).to_have_attribute("aria-current", "page")
    try_files(page)
    expect(page.get_by_role("region", name="What would change")).to_contain_text("added")
