"""Frame of the page: sign-in, sites, the map of a site, offline, session's end."""

from __future__ import annotations

import time
from collections.abc import Callable

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from playwright.sync_api import Page, expect

from tests.web.conftest import DESKTOP, SECONDS, TABLET, Open, WebServer, check_themes, wait_until

VIEWS = ("Layers", "History", "Upload", "Edit", "Coverage", "Fleet", "Checks")


@pytest.fixture(scope="module", autouse=True)
def orchard(server: WebServer) -> str:
    return server.make_site("orchard")


def test_sign_in_by_token_stays_out_of_scripts_and_address(open_page: Open, server: WebServer) -> None:
    page = open_page("/", token=None)
    page.get_by_label("Token").fill("wrong-token-of-a-guess")
    page.get_by_role("button", name="Sign in").click()
    expect(page.get_by_role("alert")).to_contain_text("unknown or expired", ignore_case=True)
    page.get_by_label("Token").fill(server.token)
    page.get_by_role("button", name="Sign in").click()
    expect(page.get_by_role("heading", name="Sites")).to_be_visible()
    assert page.evaluate("document.cookie") == ""
    assert server.token not in page.url
    assert server.token not in page.evaluate("JSON.stringify([{...localStorage}, {...sessionStorage}])")


def test_site_is_found_and_drawn(open_page: Open) -> None:
    page = open_page("/")
    page.get_by_label("Search").fill("orch")
    page.get_by_role("link", name="Orchard").click()
    expect(page.get_by_role("heading", name="Orchard")).to_be_visible()
    expect(page.get_by_text("v1", exact=False).first).to_be_visible()
    expect(page.get_by_role("button", name="Hide Network")).to_be_visible()
    wait_until_drawn(page)


def wait_until_drawn(page: Page) -> None:
    """Wait until the layers of the map show many colours: the picture, the grid and the features."""
    wait_until(
        page,
        """() => { const seen = new Set();
            for (const canvas of document.querySelectorAll('.painted-layer:not([hidden]) canvas')) {
              const {data} = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
              const words = new Uint32Array(data.buffer);
              for (let i = 0; i < words.length; i += 7) if (words[i]) seen.add(words[i]);
            } return seen.size > 50; }""",
    )


def test_site_of_a_purged_name_gets_its_own_tiles(open_page: Open, server: WebServer) -> None:
    site = "environments/again"
    page = open_page("/")
    seen: list[str] = []
    page.on("request", lambda request: seen.append(request.url))

    def hash_shown() -> str:
        own = str(server.get(f"{site}/versions/1/tiles/occupancy/map")["hash"])
        with page.expect_response(lambda answer: f"hash={own}" in answer.url and "occupancy/map/" in answer.url) as got:
            page.goto("/?site=again")
        assert got.value.ok
        return own

    hashes = []
    for rows in (4, 6):
        server.make_site("again", rows=rows)
        hashes.append(hash_shown())
        server.call("DELETE", site)
        server.call("POST", f"{site}/purge")
    assert hashes[0] != hashes[1]
    own = [url for url in seen if "tiles/occupancy/map/" in url]
    assert all(any(f"hash={one}" in url for one in hashes) for url in own)


def test_map_is_selected_by_pointer_and_by_list_and_link(open_page: Open, server: WebServer) -> None:
    page = open_page("/?site=orchard")
    page.get_by_text("Features (").click()
    page.get_by_placeholder("Search by name, id or kind").fill("Dock1")
    page.get_by_role("button", name="Dock1", exact=False).first.click()
    expect(page.get_by_role("article")).to_contain_text("Dock1")
    assert "feature=Dock1" in page.url
    again = open_page(page.url.removeprefix(server.address))
    expect(again.get_by_role("article")).to_contain_text("Dock1")
    page.get_by_role("button", name="Clear the selection").click()
    expect(page.get_by_role("article")).to_have_count(0)


@pytest.mark.parametrize(("role", "upload", "tokens"), [("viewer", 0, 0), ("editor", 1, 0), ("admin", 1, 1)])
def test_role_decides_what_is_shown(open_page: Open, server: WebServer, role: str, upload: int, tokens: int) -> None:
    page = open_page("/?site=orchard", token=server.make_token(role)["token"])
    expect(page.get_by_role("link", name="Fleet")).to_be_visible()
    expect(page.get_by_role("link", name="Upload", exact=True)).to_have_count(upload)
    expect(page.get_by_role("button", name="Tokens")).to_have_count(tokens)


def test_revoked_token_asks_to_sign_in_and_loses_nothing(open_page: Open, server: WebServer) -> None:
    token = server.make_token("editor")
    page = open_page("/?site=orchard", token=token["token"])
    page.get_by_text("Features (").click()
    page.get_by_placeholder("Search by name, id or kind").fill("Yard")
    server.call("DELETE", f"tokens/{token['id']}", 204)
    sign_in_again(page, server)
    expect(page.get_by_placeholder("Search by name, id or kind")).to_have_value("Yard")
    expect(page.get_by_role("button", name="Yard1", exact=False).first).to_be_visible()


def test_failed_sign_out_is_told(open_page: Open) -> None:
    """The cookie that stays would sign in whoever opens the page next."""
    page = open_page("/")
    expect(page.get_by_role("heading", name="Sites")).to_be_visible()
    page.evaluate("""() => { window.answered = window.fetch;
        window.fetch = (request, ...more) => request.method === 'DELETE'
          ? Promise.reject(new TypeError('no connection')) : window.answered(request, ...more); }""")
    page.get_by_role("button", name="Sign out").click()
    expect(page.locator(".toasts > *")).to_contain_text("You are still signed in")
    expect(page.get_by_role("heading", name="Sites")).to_be_visible()
    page.evaluate("window.fetch = window.answered")
    page.get_by_role("button", name="Sign out").click()
    expect(page.get_by_label("Token")).to_be_visible()


def test_error_of_a_version_ends_with_it(open_page: Open, orchard: str) -> None:
    page = open_page(f"/?site={orchard}")
    expect(page.get_by_role("button", name="Hide Network")).to_be_visible()
    page.evaluate("history.pushState(null, '', `${location.search}&version=999`); dispatchEvent(new Event('popstate'))")
    expect(page.get_by_role("button", name="Try again")).to_be_visible()
    page.go_back()
    expect(page.get_by_role("button", name="Try again")).to_have_count(0)


def test_site_opened_without_a_session_is_loaded_after_signing_in(open_page: Open, server: WebServer) -> None:
    token = server.make_token("editor")
    page = open_page("/", token=token["token"])
    link = page.locator("a", has_text="Orchard")
    expect(link).to_be_visible()
    server.call("DELETE", f"tokens/{token['id']}", 204)
    expect(page.get_by_role("dialog", name="Sign in again")).to_be_visible()
    link.dispatch_event("click")  # as if it were in the moment before the dialog
    expect(page.get_by_role("button", name="Try again")).to_be_attached()
    sign_in_again(page, server)
    expect(page.get_by_role("button", name="Hide Network")).to_be_visible()
    expect(page.get_by_role("button", name="Try again")).to_have_count(0)
    wait_until_drawn(page)


def sign_in_again(page: Page, server: WebServer) -> None:
    dialog = page.get_by_role("dialog", name="Sign in again")
    expect(dialog.get_by_label("Token")).to_be_focused()
    for _ in range(2):
        page.keyboard.press("Escape")  # browsers let a page refuse only the first
    dialog.get_by_label("Token").fill(server.token)
    dialog.get_by_role("button", name="Sign in", exact=True).click()
    expect(dialog).to_have_count(0)


def test_last_map_stays_readable_offline(open_page: Open) -> None:
    page = open_page("/?site=orchard")
    expect(page.get_by_role("button", name="Hide Network")).to_be_visible()
    page.evaluate("navigator.serviceWorker.ready.then(() => 1)")
    page.reload()  # now through the service worker, which keeps what it sees
    expect(page.get_by_role("button", name="Hide Network")).to_be_visible()
    wait_until_drawn(page)
    page.context.set_offline(True)
    page.reload()
    expect(page.get_by_role("button", name="Hide Network")).to_be_visible()
    expect(page.get_by_text("Offline", exact=False)).to_be_visible()
    page.context.set_offline(False)
    expect(page.get_by_text("Offline", exact=False)).to_have_count(0)


def test_no_node_covers_the_name_of_an_area(open_page: Open, server: WebServer) -> None:
    server.call("POST", "environments", json={"name": "named"})
    ring = [[-30, -20], [30, -20], [30, 20], [-30, 20], [-30, -20]]
    room = ("zones", "Room with a long name", {"type": "Polygon", "coordinates": [ring]}, "room")
    nodes = [("topology", f"n{x}", {"type": "Point", "coordinates": [x, 0]}, "node") for x in range(-29, 30)]
    changes = [
        {
            "op": "put",
            "layer": layer,
            "feature": {
                "type": "Feature",
                "id": name,
                "place": place,
                "geometry": None,
                "properties": {"kind": kind, "name": name},
            },
        }
        for layer, name, place, kind in (room, *nodes)
    ]
    server.call("POST", "environments/named/edits", json={"message": "", "changes": changes})
    page = open_page("/?site=named")
    expect(page.get_by_role("button", name="Hide Network")).to_be_visible()

    def seen(is_complete: Callable[[int, int], bool]) -> NDArray[np.bool_]:
        """Return which pixels are as dark as names, once the numbers of these and of those of nodes are right."""
        deadline = time.monotonic() + SECONDS
        while True:
            picture = np.frombuffer(page.locator(".ol-viewport").screenshot(), np.uint8)
            blue, _, red = np.moveaxis(cv2.imdecode(picture, cv2.IMREAD_COLOR).astype(int), -1, 0)
            ink = (red < 60) & (blue < 60)
            if is_complete(int(ink.sum()), int(((red < 60) & (blue > 90)).sum())):
                return np.asarray(ink)
            assert time.monotonic() < deadline, "the name or the nodes are not drawn"
            page.wait_for_timeout(250)

    with_nodes = seen(lambda ink, nodes: ink > 200 and nodes > 200)
    page.get_by_role("button", name="Hide Network").click()
    without = seen(lambda ink, nodes: ink > 200 and nodes < 20)
    assert (without & ~with_nodes).sum() < 0.02 * without.sum(), "nodes cover the name"


def test_legend_names_the_kinds_of_zones_that_are_on_the_map(open_page: Open, server: WebServer) -> None:
    server.call("POST", "environments", json={"name": "zones"})

    def put(*kinds: str) -> None:
        changes = []
        for x, kind in enumerate(kinds):
            ring = [[x, 0], [x + 1, 0], [x + 1, 1], [x, 1], [x, 0]]
            feature = {
                "type": "Feature",
                "id": kind,
                "place": {"type": "Polygon", "coordinates": [ring]},
                "geometry": None,
                "properties": {"kind": kind},
            }
            changes.append({"op": "put", "layer": "zones", "feature": feature})
        server.call("POST", "environments/zones/edits", json={"message": "", "changes": changes})

    put("keepout")
    page = open_page("/?site=zones")
    lines = page.get_by_label("Legend").get_by_role("listitem")
    expect(lines).to_have_text(["keepout"])
    put("room", "door", "corridor")
    page.reload()
    expect(lines).to_have_text(["corridor, room", "door", "keepout"])
    colours = [
        lines.filter(has_text=name).locator("i").evaluate("key => getComputedStyle(key).backgroundColor")
        for name in ("room", "door", "keepout")
    ]
    assert len(set(colours)) == 3
    page.get_by_role("button", name="Hide Zones").click()
    expect(lines).to_have_count(0)


def test_markup_in_names_is_text(open_page: Open, server: WebServer) -> None:
    text = "<img src=x onerror=alert(1)>\u202egnp"
    server.call("POST", "environments", json={"name": "markup", "title": text})
    feature = {
        "type": "Feature",
        "id": "n1",
        "place": {"type": "Point", "coordinates": [1, 2]},
        "geometry": None,
        "properties": {"kind": "node", "name": text + "x" * 200, "note": "<script>alert(1)</script>"},
    }
    change = {"op": "put", "layer": "topology", "feature": feature}
    server.call("POST", "environments/markup/edits", json={"message": text, "changes": [change]})
    page = open_page("/?site=markup&feature=n1")
    page.on("dialog", lambda dialog: pytest.fail(f"a script ran: {dialog.message}"))
    expect(page.get_by_role("article")).to_contain_text("<script>alert(1)</script>")
    expect(page.get_by_role("heading", level=1)).to_contain_text("<img src=x")
    assert page.locator("#page img[src=x]").count() == 0


@pytest.mark.parametrize("size", [DESKTOP, TABLET, {"width": 360, "height": 740}], ids=["desktop", "tablet", "phone"])
def test_accessible(open_page: Open, axe: str, size: dict[str, int]) -> None:
    page = open_page("/", size=size)
    expect(page.get_by_role("link", name="Orchard")).to_be_visible()
    check_themes(page, axe)
    page.goto("/?site=orchard")
    for view in VIEWS:
        if view != "Layers":  # which is open at first
            page.get_by_role("link", name=view, exact=True).click()
        expect(page.get_by_role("region", name=view)).to_be_visible()
        expect(page.locator(".panel [aria-busy=true]")).to_have_count(0)
        check_themes(page, axe)
    assert page.evaluate("document.documentElement.scrollWidth") <= size["width"]
