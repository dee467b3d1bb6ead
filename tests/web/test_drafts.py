"""Drafts in the page: kept from the editor or made elsewhere, reviewed on the map, merged, committed, deleted."""

from __future__ import annotations

from typing import Any

from playwright.sync_api import expect

from tests.web.conftest import Open, WebServer
from tests.web.test_edit import CENTRE, RESOLUTION, Editing, make_network


def node(name: str, x: float, y: float) -> dict[str, Any]:
    place = {"type": "Point", "coordinates": [x, y]}
    properties = {"kind": "node", "name": name}
    feature = {"type": "Feature", "id": name, "place": place, "geometry": None, "properties": properties}
    return {"op": "put", "layer": "topology", "feature": feature}


def test_draft_is_reviewed_merged_and_committed(server: WebServer, open_page: Open) -> None:
    site = f"environments/{server.make_site('drafty')}"
    draft = server.call("POST", f"{site}/drafts", 201, json={"name": "from QGIS"})
    server.call("POST", f"{site}/drafts/{draft['id']}/edits", 200, json={"changes": [node("shed", 3, 3)]})
    server.call("POST", f"{site}/drafts", 201, json={"name": "an idea"})
    page = open_page("/?site=drafty&view=history")
    drafts = page.get_by_role("region", name="Drafts")
    row = drafts.get_by_role("listitem").filter(has_text="from QGIS")
    expect(row).to_contain_text("Network: 1 added")
    row.get_by_role("button", name="Review").click()
    expect(page.get_by_role("heading", name="v1 → draft")).to_be_visible()
    expect(page.get_by_text("shed").first).to_be_visible()
    page.get_by_role("button", name="Back to the versions").click()

    server.call("POST", f"{site}/edits", 201, json={"changes": [node("silo", 6, 6)]})
    row.get_by_role("button", name="Merge with v2").click()
    row.get_by_role("button", name="Commit").click()
    expect(row).to_have_count(0)
    head = server.get(site)["version"]
    assert head == 3
    names = {f["id"] for f in server.get(f"{site}/versions/3/layers/topology", ids="shed,silo")["features"]}
    assert names == {"shed", "silo"}

    idea = drafts.get_by_role("listitem").filter(has_text="an idea")
    idea.get_by_role("button", name="Delete an idea").click()
    page.get_by_role("dialog").get_by_role("button", name="Delete for good").click()
    expect(idea).to_have_count(0)
    assert server.get(f"{site}/drafts") == []


def test_edits_are_kept_as_a_draft(server: WebServer, open_page: Open) -> None:
    site = make_network(server, "keeper", a=(10, 10), b=(20, 10))
    page = open_page(f"/?site={site}&view=edit&at={CENTRE[0]},{CENTRE[1]},{RESOLUTION}")
    expect(page.get_by_role("toolbar", name="Editing tools")).to_be_visible()
    expect(page.locator(".map-area")).to_have_attribute("aria-busy", "false")
    editing = Editing(page)
    editing.select("Node b")
    page.keyboard.press("Delete")
    editing.changes("2 changes")  # the node, and the two-way street
    page.get_by_role("button", name="Review", exact=True).click()
    dialog = page.get_by_role("dialog", name="Review and save")
    dialog.get_by_label("Message").fill("without b")
    dialog.get_by_role("button", name="Keep as a draft").click()
    expect(page.get_by_text("Kept as the draft without b")).to_be_visible()
    editing.changes("No changes")
    (draft,) = server.get(f"environments/{site}/drafts")
    assert draft["changes"]["topology"] == {"added": 0, "changed": 0, "deleted": 3}
    assert server.get(f"environments/{site}")["version"] == 1
