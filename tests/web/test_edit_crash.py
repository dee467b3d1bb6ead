"""The server is killed while a draft is saved: the draft stays, is sent again, and nothing is lost or doubled."""

from __future__ import annotations

import re
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx
import pytest
from playwright.sync_api import Page, Route, expect

from tests.cli.conftest import TOKEN, ServerProcess
from tests.web.conftest import SECONDS, Open, WebServer
from tests.web.test_edit import CENTRE, RESOLUTION, Editing, features, make_network


class Crashing:
    """A server that can be killed and started again on the same data, at the same address."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._process = self._start("0")
        self.address = self._process.ready()

    def _start(self, port: str) -> ServerProcess:
        environment = {"FLEETMAP_DATA_DIR": str(self._folder / "data"), "FLEETMAP_ADMIN_TOKEN": TOKEN}
        return ServerProcess("--port", port, environment=environment, folder=self._folder)

    def kill(self) -> None:
        self._process.stop(signal.SIGKILL)

    def restart(self) -> None:
        self._process = self._start(self.address.rpartition(":")[2])
        self._process.ready()


@pytest.fixture(scope="module")
def crashing(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Crashing]:
    process = Crashing(tmp_path_factory.mktemp("crashing"))
    yield process
    process.kill()


@pytest.fixture(scope="module")
def server(crashing: Crashing) -> Iterator[WebServer]:
    headers = {"authorization": f"Bearer {TOKEN}"}
    with httpx.Client(base_url=crashing.address, headers=headers, timeout=SECONDS) as http:
        yield WebServer(crashing.address, TOKEN, http)


def test_a_killed_server_loses_and_doubles_nothing(server: WebServer, crashing: Crashing, open_page: Open) -> None:
    site = make_network(server, "killed", a=(10, 10), b=(20, 10))
    page = open_page(f"/?site={site}&view=edit&at={CENTRE[0]},{CENTRE[1]},{RESOLUTION}")
    expect(page.get_by_role("toolbar", name="Editing tools")).to_be_visible()
    expect(page.locator(".map-area")).to_have_attribute("aria-busy", "false")
    editing = Editing(page)

    def die_after_storing(route: Route) -> None:
        headers = {name: value for name, value in route.request.all_headers().items() if not name.startswith(":")}
        httpx.post(route.request.url, content=route.request.post_data_buffer, headers=headers).raise_for_status()
        crashing.kill()
        route.abort()

    def die_before_storing(route: Route) -> None:
        crashing.kill()
        route.abort()

    # The answer is lost: the version exists, and the page does not know.
    editing.tool("Draw lanes")
    editing.click(20, 10)
    editing.click(25, 14)
    page.keyboard.press("Enter")
    editing.changes("2 changes")
    save_while(page, die_after_storing, "Save 2 changes")
    crashing.restart()
    assert server.get(f"environments/{site}")["version"] == 2
    page.reload()
    expect(page.get_by_text("Restored 2 changes")).to_be_visible()
    save_again(page, 2)
    editing.changes("No changes")
    assert server.get(f"environments/{site}")["version"] == 2, "saved once"

    # The request is lost.
    editing.tool("Select and move")
    editing.drag((25, 14), (26, 16))
    editing.changes("1 change")
    save_while(page, die_before_storing, "Save 1 change")
    crashing.restart()
    save_again(page, 3)
    found = features(server, site)
    assert set(found) == {"a", "b", "n1", "a_b", "b_a", "b_n1", "n1_b"}
    assert found["n1"]["place"]["coordinates"] == pytest.approx((26, 16), abs=2 * RESOLUTION)
    assert server.get(f"environments/{site}")["version"] == 3


def save_while(page: Page, happening: Callable[[Route], None], button: str) -> None:
    """Press Save, with something that happens to the request."""
    page.get_by_role("button", name="Review", exact=True).click()
    dialog = page.get_by_role("dialog", name="Review and save")

    def handle(route: Route) -> None:
        if "dry_run" in (route.request.post_data or ""):
            route.continue_()
        else:
            happening(route)

    page.route("**/edits", handle)
    dialog.get_by_role("button", name=button).click()
    expect(dialog.get_by_text("Offline: your changes are kept on this device")).to_be_visible()
    page.unroute("**/edits")


def save_again(page: Page, version: int) -> None:
    dialog = page.get_by_role("dialog", name="Review and save")
    if not dialog.is_visible():
        page.get_by_role("button", name="Review", exact=True).click()
    save = dialog.get_by_role("button", name=re.compile("^Save "))
    expect(save).to_be_enabled()  # the page finds that the server is back
    save.click()
    expect(page.get_by_text(f"Saved as v{version}")).to_be_visible()
