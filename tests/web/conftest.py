"""The page in a real browser: Debian's Chromium against a server process, by roles and labels."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import httpx
import pytest
from playwright.sync_api import Browser, BrowserContext, ConsoleMessage, Page, expect, sync_playwright

from app.cli.demo import PLAIN
from tests.cli.conftest import TOKEN, ServerProcess

SECONDS = 60.0
"""Maximum wait for what the page shows, on any machine."""

DESKTOP = {"width": 1280, "height": 800}
TABLET = {"width": 800, "height": 1280}
THEME = "document.documentElement.dataset.theme"
COLOUR_RULES = ("color-contrast", "link-in-text-block")
"""The rules of axe on colours, of those that it enables."""


@dataclass(frozen=True)
class WebServer:
    """A running server, and calls of its API as administrator."""

    address: str
    token: str
    http: httpx.Client

    def call(self, method: str, path: str, expected: int | None = None, **request: Any) -> Any:
        """Call the API and return the JSON. expected: status; None: any success."""
        answer = self.http.request(method, f"/api/v1/{path}", **request)
        assert answer.status_code == expected if expected else answer.is_success, answer.text
        return answer.json() if answer.content else None

    def get(self, path: str, **parameters: Any) -> Any:
        return self.call("GET", path, params=parameters)

    def make_site(self, name: str, generator: str = "orchard", **parameters: Any) -> str:
        """Create an environment with a generated site as version 1."""
        self.call("POST", "environments", json={"name": name, "title": name.title()})
        if generator == "orchard":  # straight rows along the x axis: tests click on places
            parameters = {"rows": 8, "row_length": 40.0, **PLAIN, **parameters}
        body = {"generator": generator, "seed": 7, "parameters": parameters}
        self.call("POST", f"environments/{name}/generations", 201, json=body, timeout=120)
        return name

    def make_token(self, role: str, **limits: Any) -> dict[str, str]:
        """Create a token and return ``{id, token}``."""
        created: dict[str, str] = self.call(
            "POST", "tokens", json={"name": f"{role} of a test", "role": role, **limits}
        )
        return created


@pytest.fixture(scope="package")
def running_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[WebServer]:
    """Start the server of all modules."""
    folder = tmp_path_factory.mktemp("web")
    environment = {"FLEETMAP_DATA_DIR": str(folder / "data"), "FLEETMAP_ADMIN_TOKEN": TOKEN}
    process = ServerProcess(environment=environment, folder=folder)
    try:
        process.ready()
        headers = {"authorization": f"Bearer {TOKEN}"}
        with httpx.Client(base_url=process.address, headers=headers, timeout=SECONDS) as http:
            yield WebServer(process.address, TOKEN, http)
    finally:
        process.stop()


@pytest.fixture(scope="module")
def server(running_server: WebServer) -> Iterator[WebServer]:
    """Return the server without the sites of other modules."""
    yield running_server
    for environment in running_server.get("environments"):
        running_server.call("DELETE", f"environments/{environment['name']}")
        running_server.call("POST", f"environments/{environment['name']}/purge")


@pytest.fixture(scope="package")
def browser() -> Iterator[Browser]:
    """Start the browser of all modules. While it runs, no test outside of this folder could start an event loop."""
    program = shutil.which("chromium-headless-shell")
    assert program, "chromium-headless-shell is not installed (Debian: apt install chromium-headless-shell)"
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        yield browser
        browser.close()


Open = Callable[..., Page]


@pytest.fixture
def open_page(browser: Browser, server: WebServer) -> Iterator[Open]:
    """Return a function that opens the page in a browser of its own: signed in with a token, at an address.

    After the test, nothing may have gone to another host, and no script may have failed or been refused.
    """
    contexts: list[BrowserContext] = []
    faults: list[str] = []
    expect.set_options(timeout=SECONDS * 1000)

    def open_one(
        path: str = "/", *, token: str | None = server.token, size: dict[str, int] = DESKTOP, **more: Any
    ) -> Page:
        context = browser.new_context(viewport=size, base_url=server.address, reduced_motion="reduce", **more)  # type: ignore[arg-type]
        contexts.append(context)
        context.set_default_timeout(SECONDS * 1000)
        page = context.new_page()
        page.on("pageerror", lambda error: faults.append(f"script failed: {error}"))
        page.on("console", lambda message: faults.extend(_violations(message)))
        page.on(
            "request",
            lambda request: (
                None
                if request.url.startswith((server.address, "blob:"))
                else faults.append(f"request to another host: {request.url}")
            ),
        )
        if token is not None:
            answer = context.request.post("/api/v1/session", data={"token": token})
            assert answer.ok, answer.text()
        page.goto(path)
        return page

    yield open_one
    for context in contexts:
        context.close()
    assert not faults


def _violations(message: ConsoleMessage) -> list[str]:
    text = message.text
    return [text] if message.type == "error" and ("Content Security Policy" in text or "Refused" in text) else []


@pytest.fixture(scope="session")
def axe() -> str:
    """Return the source of axe, which finds what people with disabilities could not use."""
    path = Path(__file__).resolve().parents[2] / "app" / "web" / "node_modules" / "axe-core" / "axe.min.js"
    assert path.is_file(), "axe-core is missing: `npm ci` in app/web"
    return path.read_text()


def wait_until(page: Page, expression: str, argument: Any = None) -> None:
    """Wait until a JavaScript function returns true; Playwright's own waiting needs ``eval``, which is forbidden."""
    deadline = time.monotonic() + SECONDS
    while not page.evaluate(expression, argument):
        assert time.monotonic() < deadline, f"not true within {SECONDS:.0f} s: {expression}"
        page.wait_for_timeout(250)


def check_accessibility(page: Page, axe: str, rules: Sequence[str] = ()) -> None:
    """Assert that axe finds nothing serious on the page as it is shown. rules: default: all that axe enables."""
    if not page.evaluate("'axe' in window"):
        page.evaluate(axe)
    options = {"resultTypes": ["violations"]} | ({"runOnly": {"type": "rule", "values": list(rules)}} if rules else {})
    found = page.evaluate("options => axe.run(document, options).then(({violations}) => violations)", options)
    serious = [
        f"{one['id']}: {one['help']}: {[node['html'][:120] for node in one['nodes'][:3]]}"
        for one in found
        if one["impact"] in ("serious", "critical")
    ]
    assert not serious, "\n".join(serious)


def check_themes(page: Page, axe: str) -> None:
    """Check the accessibility of the page as it is shown, then its colours in the other theme, which changes no more.

    The page stays in that theme.
    """
    check_accessibility(page, axe)
    theme: Literal["light", "dark"] = "light" if page.evaluate(THEME) == "dark" else "dark"
    page.emulate_media(color_scheme=theme)
    wait_until(page, f"theme => {THEME} === theme", theme)
    check_accessibility(page, axe, COLOUR_RULES)
