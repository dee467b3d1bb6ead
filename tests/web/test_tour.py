"""README's tour in the page, as a newcomer takes it: upload, try, commit, impact, promote, robots follow, roll back."""

from __future__ import annotations

import itertools
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from tests.web.conftest import DESKTOP, TABLET, Open, WebServer

FIRST = {"Gate": (0.0, 0.0), "Barn": (20.0, 0.0), "Field": (20.0, 15.0)}
SECOND = {"Gate": (0.0, 0.0), "Barn": (20.0, 0.0), "Pond": (5.0, 18.0)}


def tmap2(nodes: dict[str, tuple[float, float]]) -> bytes:
    """Write a topological map with edges in both directions between consecutive nodes."""
    names = list(nodes)
    neighbours: dict[str, list[str]] = {name: [] for name in names}
    for a, b in itertools.pairwise(names):
        neighbours[a].append(b)
        neighbours[b].append(a)
    lines = ["meta: {last_updated: '2026-01-01_00-00-00'}", "metric_map: map", "name: farm", "pointset: farm"]
    lines += ["transformation: {child: topo_map, parent: map, rotation: {w: 1.0, x: 0.0, y: 0.0, z: 0.0},"]
    lines += ["  translation: {x: 0.0, y: 0.0, z: 0.0}}", "nodes:"]
    for name, (x, y) in nodes.items():
        lines += ["- meta: {map: map, node: " + name + ", pointset: farm}", "  node:", f"    name: {name}"]
        lines += [
            f"    pose: {{position: {{x: {x}, y: {y}, z: 0.0}}, orientation: {{w: 1.0, x: 0.0, y: 0.0, z: 0.0}}}}"
        ]
        lines += ["    edges:"]
        for other in neighbours[name]:
            lines += [f"    - {{edge_id: {name}_{other}, node: {other}, action: move_base}}"]
    return "\n".join(lines).encode() + b"\n"


def upload(page: Page, nodes: dict[str, tuple[float, float]], message: str, version: int) -> None:
    """Choose a file, see what it would change, and commit it."""
    file: Any = {"name": "farm.tmap2.yaml", "mimeType": "application/yaml", "buffer": tmap2(nodes)}
    page.locator("input[type=file]").first.set_input_files(file)
    page.get_by_role("button", name="Try", exact=True).click()
    expect(page.get_by_role("region", name="What would change")).to_be_visible()
    page.get_by_label("Message").fill(message)
    page.get_by_role("button", name=f"Commit as v{version}").click()
    expect(page.get_by_text(f"v{version} committed")).to_be_visible()


def promote(page: Page) -> None:
    page.get_by_role("link", name="Promote to robots").click()
    expect(page.get_by_role("form", name="Promote")).to_be_visible()


def report(server: WebServer, name: str, robot: str, version: int, state: str) -> None:
    """Report what a robot does with a version, as its agent does."""
    root = server.get(f"environments/{name}/versions/{version}")["root"]
    status = {"environment": name, "channel": "production", "version": version, "root": root, "state": state}
    server.call("PUT", f"robots/{robot}/status", json={**status, "node": "Field"})


@pytest.mark.parametrize(
    ("size", "theme", "touch"),
    [(DESKTOP, "light", False), (TABLET, "dark", True)],
    ids=["desktop-light", "tablet-dark"],
)
def test_tour(open_page: Open, server: WebServer, size: dict[str, int], theme: str, touch: bool) -> None:
    name = f"farm-{theme}"
    page = open_page("/", size=size, color_scheme=theme, has_touch=touch)
    page.get_by_role("button", name="New site").click()
    page.get_by_label("Title").fill(name)
    page.get_by_role("button", name="Create site").click()

    upload(page, FIRST, "The farm", 1)
    promote(page)
    page.get_by_role("button", name="Promote now").click()
    expect(page.get_by_text("production is now v1")).to_be_visible()
    for robot in ("mule-1", "mule-2"):
        report(server, name, robot, 1, "active")

    page.get_by_role("link", name="Upload", exact=True).click()
    page.get_by_role("button", name="Upload more").click()
    upload(page, SECOND, "The field is a pond now", 2)
    assert server.get(f"environments/{name}/versions/2")["message"] == "The field is a pond now"
    promote(page)
    impact = page.get_by_role("region", name="Impact")
    expect(impact).to_contain_text("mule-1")  # it stands at a node that is deleted
    expect(impact).to_contain_text("1 node deleted")
    page.get_by_role("button", name="Promote now").click()
    expect(page.get_by_text("production is now v2")).to_be_visible()

    page.get_by_role("link", name="Fleet").click()
    card = page.get_by_role("article", name="Channel production")
    expect(card).to_contain_text("v2")
    report(server, name, "mule-1", 2, "active")
    expect(card.get_by_text("same map")).to_have_count(0)
    report(server, name, "mule-2", 2, "active")  # without a reload
    expect(card.get_by_text("same map")).to_be_visible()

    page.get_by_role("link", name="History").click()
    page.get_by_role("listitem", name="Channel production").get_by_role("button", name="Roll back to v1").click()
    page.get_by_role("button", name="Roll back now").click()
    expect(page.get_by_role("listitem", name="Channel production")).to_contain_text("Return to v2")
    channels = {one["channel"]: one["version"] for one in server.get(f"environments/{name}/channels")}
    assert channels["production"] == 1
