"""Coverage: the table, downloads, losses on the map, derivations; and the base map of one configured host."""

from __future__ import annotations

import http.server
import io
import re
import threading
import zipfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
import pytest
from playwright.sync_api import Browser, Page, expect

from tests.api import samples
from tests.cli.conftest import TOKEN, ServerProcess
from tests.web.conftest import DESKTOP, TABLET, Open, WebServer, check_themes, wait_until

SAMPLES = Path(__file__).resolve().parents[1] / "samples"
COLUMNS = ("location", "objects", "occupancy", "topology", "zones", "imagery", "voxels")
AVAILABILITY = {"direct": "available", "derivable": "available, derived", "missing": "missing"}
WIDE = {"width": 1700, "height": 1000}


def upload(server: WebServer, name: str, files: dict[str, bytes]) -> None:
    server.call("POST", "environments", json={"name": name, "title": name.title()})
    parts = [("files", (path, content)) for path, content in files.items()]
    server.call("POST", f"environments/{name}/versions", 201, files=parts)


@pytest.fixture(scope="module", autouse=True)
def sites(server: WebServer) -> None:
    server.make_site("orchard", rows=3, row_length=12.0)
    folder = SAMPLES / "openrmf" / "clinic"
    upload(server, "clinic", {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*.*")})
    upload(server, "room", samples.grid(width=80, height=60, resolution=0.1))
    upload(server, "farm", {"map.tmap2.yaml": samples.tmap2()})


def expected_cells(server: WebServer, site: str) -> dict[str, list[str]]:
    """Return for each format its availability and the word of each column, as the API has them."""
    formats = {line["id"]: line for line in server.get("formats")}
    own = server.get(f"environments/{site}/versions/latest")["information"]
    rows = {}
    for line in server.get(f"environments/{site}/versions/latest/maps"):
        steps = {step["to"] for step in line["chain"]}
        words = []
        for layer in COLUMNS:
            given = formats[line["format"]]["information"][layer]
            has = own[layer] != "missing"
            stored = own[layer] if has else "derived" if layer in steps else "missing"
            words.append({"-": "–", "derived": "derivable", "raw": stored}[given])
        rows[line["format"]] = [AVAILABILITY[line["state"]], *words]
    return rows


@pytest.mark.parametrize("site", ["orchard", "clinic"])
def test_table_equals_the_api(open_page: Open, server: WebServer, site: str) -> None:
    page = open_page(f"/?site={site}&view=coverage", size=WIDE)
    page.get_by_role("button", name="Full table").click()
    table = page.get_by_role("region", name="Full table").get_by_role("table")
    expect(table.get_by_role("rowheader").first).to_be_visible()
    shown = {}
    for row in table.locator("tbody tr").all():
        name, state = row.locator("th small").inner_text().split(" · ")
        shown[name] = [state, *row.locator("td .mark").all_inner_texts()]
    assert shown == expected_cells(server, site)
    page.keyboard.press("Escape")
    expect(table).to_have_count(0)
    page.get_by_label("Search formats").fill("waypoints")
    formats = page.get_by_role("region", name="Formats", exact=True)
    expect(formats.get_by_role("listitem").filter(has_text="available")).to_have_count(1)
    page.get_by_label("Only available").check()
    page.get_by_label("Search formats").fill("")
    available = sum(state != "missing" for state, *_ in shown.values())
    expect(formats.locator(".format-row")).to_have_count(available)
    assert "have=1" in page.url


def test_missing_map_says_what_to_supply(open_page: Open, server: WebServer) -> None:
    lines = {line["format"]: line for line in server.get("environments/room/versions/1/maps")}
    assert lines["kml"]["missing"]
    page = open_page("/?site=room&view=coverage")
    page.get_by_role("button", name=re.compile("^KML missing")).click()
    note = page.get_by_role("region", name="What is missing")
    for text in lines["kml"]["missing"]:
        expect(note).to_contain_text(text, ignore_case=True)
    note.get_by_role("link", name="Upload files").click()
    expect(page.get_by_role("region", name="Upload", exact=True)).to_be_visible()
    viewer = open_page("/?site=room&view=coverage&format=kml", token=server.make_token("viewer")["token"])
    expect(viewer.get_by_role("region", name="What is missing")).to_contain_text("An editor of room can upload it")
    expect(viewer.get_by_role("link", name="Upload files")).to_have_count(0)


def test_map_is_downloaded_with_its_parameters(open_page: Open, server: WebServer) -> None:
    page = open_page("/?site=room&view=coverage&format=occupancy_grid")
    page.get_by_text("Parameters", exact=True).click()
    page.get_by_label("resolution").fill("-1")
    expect(page.get_by_role("alert")).to_contain_text("must be at least")
    expect(page.get_by_role("button", name="Download")).to_be_disabled()
    page.get_by_label("resolution").fill("")
    page.get_by_label("file type").select_option("png")
    page.get_by_text("Address for robots").click()
    expect(page.get_by_label("Always the latest version", exact=True)).to_have_value(
        f"{server.address}/maps/room/occupancy_grid?file_type=png"
    )
    with page.expect_download() as waiting:
        page.get_by_role("button", name="Download").click()
    expect(page.get_by_role("status").filter(has_text="occupancy_grid.zip")).to_be_visible()
    content = waiting.value.path().read_bytes()
    assert content == server.http.get("/maps/room/occupancy_grid?file_type=png").content
    assert "map.png" in zipfile.ZipFile(io.BytesIO(content)).namelist()
    page.get_by_text("Report of this map").click()
    expect(page.get_by_role("article")).to_contain_text("Made of")


def count_pixels(page: Page, colour: tuple[int, int, int]) -> int:
    """Count the pixels of exactly a colour on the painted layers of the map."""
    return int(
        page.evaluate(
            """([r, g, b]) => { let count = 0;
            for (const canvas of document.querySelectorAll('.painted-layer:not([hidden]) canvas')) {
              const {data} = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
              for (let i = 0; i < data.length; i += 4)
                if (data[i] === r && data[i + 1] === g && data[i + 2] === b && data[i + 3] === 255) count += 1;
            } return count; }""",
            list(colour),
        )
    )


DELETED = (0xCF, 0x22, 0x2E)


def test_losses_are_drawn_and_listed(open_page: Open, server: WebServer) -> None:
    losses = server.get("environments/orchard/versions/1/losses", format="tmap2", crs="local")
    groups = Counter((one["properties"]["kind"], one["properties"]["change"]) for one in losses["features"])
    page = open_page("/?site=orchard&view=coverage&format=tmap2")
    expect(page.get_by_role("checkbox", name="Show on the map what would be lost")).to_be_visible()
    assert count_pixels(page, DELETED) == 0
    page.get_by_role("checkbox", name="Show on the map what would be lost").check()
    card = page.get_by_role("article")
    for (kind, change), number in groups.items():
        expect(card).to_contain_text(f"{number} × {kind.replace('_', ' ')} {change}")
    for line in losses["report"]["dropped"]:
        expect(card).to_contain_text(line["why"])
    wait_until(page, "() => document.querySelectorAll('.painted-layer:not([hidden]) canvas').length > 5")
    wait_for_pixels(page, DELETED)
    assert "losses=1" in page.url
    page.goto("/?site=farm&view=coverage&format=tmap2&losses=1")
    assert not server.get("environments/farm/versions/1/losses", format="tmap2")["features"]
    expect(page.get_by_text("Nothing is lost")).to_be_visible()


def wait_for_pixels(page: Page, colour: tuple[int, int, int]) -> None:
    for _ in range(200):
        if count_pixels(page, colour) > 200:
            return
        page.wait_for_timeout(100)
    raise AssertionError("the losses were not drawn")


def test_derivation_is_tried_then_saved_then_out_of_date(open_page: Open, server: WebServer) -> None:
    site = "environments/room"
    page = open_page("/?site=room&view=coverage")
    page.get_by_role("button", name="Derive", exact=True).click()
    page.get_by_role("button", name=re.compile("Network of nodes and directed edges along the paths")).click()
    page.get_by_text("Parameters (").click()
    page.get_by_label("robot radius").fill("0.2")
    page.get_by_role("button", name="Try it on the map").click()
    result = page.get_by_role("region", name="Result of the dry run")
    expect(result).to_contain_text("Topology:")
    expect(result.get_by_role("list", name="Changes")).to_contain_text("node added")
    assert server.get(f"{site}/versions/latest")["version"] == 1
    assert "version=dry:" in page.url
    result.get_by_role("button", name="Before").click()
    expect(result.get_by_role("button", name="Before")).to_have_attribute("aria-pressed", "true")
    expect(page).not_to_have_url(re.compile("version=dry:"))
    result.get_by_role("button", name="Save as a version").click()
    expect(page.get_by_role("link", name=re.compile("^v2"))).to_be_visible()
    saved = server.get(f"{site}/versions/latest")
    assert (saved["version"], saved["information"]["topology"]) == (2, "derived")
    square = {"type": "Polygon", "coordinates": [[[1, 1], [3, 1], [3, 3], [1, 3], [1, 1]]]}
    change = {"op": "cells", "grid": "map", "polygon": square, "crs": "local", "value": 100}
    server.call("POST", f"{site}/edits", json={"message": "A crate", "changes": [change]})
    assert server.get(f"{site}/versions/3")["stale"]
    page.reload()
    note = page.get_by_role("region", name="Out of date")
    expect(note).to_contain_text("Topology")
    note.get_by_role("button", name="Derive again").click()
    expect(page.get_by_role("heading", name="Topology from occupancy")).to_be_visible()
    expect(page.get_by_text("With the parameters of last time")).to_be_visible()


class TileHandler(http.server.BaseHTTPRequestHandler):
    """Tiles of one colour."""

    protocol_version = "HTTP/1.1"
    content = cv2.imencode(".png", np.full((256, 256, 3), (10, 200, 60), np.uint8))[1].tobytes()

    def do_GET(self) -> None:
        self.server.paths.append(self.path)  # type: ignore[attr-defined]
        self.send_response(200)
        self.send_header("content-type", "image/png")
        self.send_header("content-length", str(len(self.content)))
        self.end_headers()
        self.wfile.write(self.content)

    def log_message(self, *_: Any) -> None:
        return


@pytest.fixture
def tiles() -> Iterator[http.server.ThreadingHTTPServer]:
    tile_server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), TileHandler)
    tile_server.paths = []  # type: ignore[attr-defined]
    threading.Thread(target=tile_server.serve_forever, daemon=True).start()
    yield tile_server
    tile_server.shutdown()
    tile_server.server_close()


def test_no_base_map_unless_configured(open_page: Open) -> None:
    page = open_page("/?site=orchard&base=1")  # the fixture refuses requests to other hosts
    expect(page.get_by_role("button", name="Hide Network")).to_be_visible()
    page.wait_for_timeout(1000)
    expect(page.get_by_role("button", name=re.compile("base map"))).to_have_count(0)


def test_base_map_comes_from_its_host_only(
    browser: Browser, tiles: http.server.ThreadingHTTPServer, tmp_path: Path
) -> None:
    host = f"http://127.0.0.1:{tiles.server_address[1]}"
    credit = "© <b>Tiles</b> of a test"
    environment = {
        "FLEETMAP_DATA_DIR": str(tmp_path / "data"),
        "FLEETMAP_ADMIN_TOKEN": TOKEN,
        "FLEETMAP_BASEMAP_URL": host + "/{z}/{x}/{y}.png",
        "FLEETMAP_BASEMAP_ATTRIBUTION": credit,
    }
    process = ServerProcess(environment=environment, folder=tmp_path)
    context = browser.new_context(viewport=DESKTOP, reduced_motion="reduce")  # type: ignore[arg-type]
    try:
        process.ready()
        with httpx.Client(base_url=process.address, headers={"authorization": f"Bearer {TOKEN}"}, timeout=60) as http_:
            server = WebServer(process.address, TOKEN, http_)
            server.make_site("orchard", rows=3, row_length=12.0)
            datum = server.get("environments/orchard")["datum"]
            policy = http_.get("/").headers["content-security-policy"]
        assert f"img-src 'self' {host} blob:" in policy
        assert policy.count(host) == 1
        assert context.request.post(f"{process.address}/api/v1/session", data={"token": TOKEN}).ok
        others: set[str] = set()
        page = context.new_page()
        page.on("request", lambda request: others.add(re.match(r"\w+:/?/?[^/]*", request.url)[0]))  # type: ignore[index]
        page.goto(f"{process.address}/?site=orchard&hide=imagery/satellite,occupancy/map")
        expect(page.get_by_role("button", name="Show base map")).to_be_visible()
        assert not tiles.paths  # type: ignore[attr-defined]
        with page.expect_response(lambda response: response.url.startswith(host)):
            page.get_by_role("button", name="Show base map").click()
        expect(page.get_by_text(credit)).to_be_visible()
        wait_for_tile(page, tiles.paths, datum)  # type: ignore[attr-defined]
        assert {one for one in others if not one.startswith("blob:")} == {process.address, host}
        page.get_by_role("button", name="Hide base map").click()
        expect(page.get_by_text(credit)).to_have_count(0)
    finally:
        context.close()
        process.stop()


def wait_for_tile(page: Page, paths: list[str], datum: dict[str, float]) -> None:
    for _ in range(300):
        if covers(paths, datum["latitude"], datum["longitude"]):
            return
        page.wait_for_timeout(100)
    raise AssertionError(f"the tile of the site was not requested: {paths}")


def covers(paths: list[str], latitude: float, longitude: float) -> bool:
    """Test whether one of the tiles contains a position."""
    for path in paths:
        z, x, y = (int(part) for part in path.removesuffix(".png").strip("/").split("/"))
        column = (longitude + 180) / 360 * 2**z
        row = (1 - np.arcsinh(np.tan(np.radians(latitude))) / np.pi) / 2 * 2**z
        if (int(column), int(row)) == (x, y):
            return True
    return False


def test_accessible(open_page: Open, axe: str) -> None:
    page = open_page("/?site=clinic&view=coverage&full=1", size=DESKTOP)
    expect(page.get_by_role("table")).to_be_visible()
    check_themes(page, axe)
    page.set_viewport_size(TABLET)  # type: ignore[arg-type]
    for query in ("format=kml", "format=tmap2&losses=1", "derive=any", "derive=occupancy_to_topology"):
        page.goto(f"/?site=clinic&view=coverage&{query}")
        expect(page.get_by_role("article")).to_be_visible()
        expect(page.locator(".panel [aria-busy=true]")).to_have_count(0)
        check_themes(page, axe)
        assert page.evaluate("document.documentElement.scrollWidth") <= TABLET["width"]
