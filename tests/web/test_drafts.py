"""Drafts in the page: kept from the editor or made elsewhere, reviewed on the map, merged, committed, deleted."""

from __future__ import annotations

from typing import Any

from playwright.sync_api import Page, expect

from tests.web.conftest import Open, WebServer
from tests.web.test_edit import CENTRE, RESOLUTION, Editing, at, features, make_network

DATUM = {"latitude": 52.4205, "longitude": 5.6135}
DATUM_POINT = {"type": "Point", "coordinates": [5.6136, 52.4206]}
MERGE_PATCH = {"content-type": "application/merge-patch+json"}


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


def test_draft_of_a_gis_program_is_edited_further_and_committed(server: WebServer, open_page: Open) -> None:
    site = make_network(server, "shared-draft", a=(10, 10), b=(20, 10), c=(15, 15))
    datum = {"type": "Feature", "id": "datum", "geometry": None, "properties": {"kind": "datum", "datum": DATUM}}
    change = {"op": "put", "layer": "location", "feature": datum}
    server.call("POST", f"environments/{site}/edits", 201, json={"changes": [change]})
    nodes = f"/ogc/{site}/drafts/mine/collections/nodes/items"
    well = {"type": "Feature", "id": "well", "geometry": DATUM_POINT, "properties": {"name": "well"}}
    assert server.http.post(nodes, json=well).status_code == 201
    (draft,) = server.get(f"environments/{site}/drafts")

    page = open_page(f"/?site={site}&view=history&at={CENTRE[0]},{CENTRE[1]},{RESOLUTION}")
    drafts = page.get_by_role("region", name="Drafts")
    drafts.get_by_role("button", name="Continue editing").click()
    editing = Editing(page)
    expect(page.locator(".edit-status")).to_contain_text("in the draft “mine”")
    editing.select("Node well")
    editing.select("Node c")
    for_x = page.get_by_label("x, metres")
    for_x.fill("16.125")
    for_x.press("Enter")
    editing.changes("1 change")
    page.reload()
    expect(page.get_by_text("Restored 1 change")).to_be_visible()

    # QGIS goes on meanwhile: what it adds is merged, the same node is asked for.
    assert server.http.post(nodes, json={**well, "id": "pump", "properties": {}}).status_code == 201
    save_in_draft(page)
    expect(page.get_by_text("Saved in the draft “mine”")).to_be_visible()
    editing.changes("No changes")
    assert server.get(f"environments/{site}")["version"] == 2
    assert at(features(server, site, version=draft["version"])["c"]) == (16.125, 15)
    answer = server.http.patch(f"{nodes}/c", json={"properties": {"name": "by QGIS"}}, headers=MERGE_PATCH)
    assert answer.status_code == 204
    editing.select("Node c")
    page.get_by_label("name", exact=True).fill("by the page")
    page.get_by_label("name", exact=True).press("Enter")
    save_in_draft(page)
    conflicts = page.get_by_role("region", name="Conflicts")
    expect(conflicts.get_by_role("heading", name="1 conflict with the draft “mine”")).to_be_visible()
    conflicts.get_by_role("button", name="Keep mine").click()
    conflicts.get_by_role("button", name="Merge and save").click()
    editing.changes("No changes")

    server.call("POST", f"environments/{site}/edits", 201, json={"changes": [node("silo", 6, 6)]})
    page.get_by_role("button", name="Review", exact=True).click()
    dialog = page.get_by_role("dialog", name="Review and save")
    dialog.get_by_role("button", name="Merge with v3").click()
    dialog.get_by_label("Message").fill("well and pump")
    dialog.get_by_role("button", name="Commit", exact=True).click()
    expect(page.get_by_text("Saved as v4")).to_be_visible()
    expect(page.locator(".edit-status")).to_contain_text("on v4")
    found = features(server, site)
    assert {"well", "pump", "silo", "a", "b"} < set(found)
    assert at(found["c"]) == (16.125, 15)
    assert found["c"]["properties"]["name"] == "by the page"
    assert server.get(f"environments/{site}/versions/4")["message"] == "well and pump"
    assert server.get(f"environments/{site}/drafts") == []


def save_in_draft(page: Page) -> None:
    page.get_by_role("button", name="Review", exact=True).click()
    page.get_by_role("dialog").get_by_role("button", name="Save 1 change in the draft").click()


def test_conflicts_of_a_merge_offer_a_choice(server: WebServer, open_page: Open) -> None:
    name = make_network(server, "torn", a=(10, 10), b=(20, 10))
    site = f"environments/{name}"
    drafts = [server.call("POST", f"{site}/drafts", 201, json={"name": one}) for one in ("my way", "their way")]
    for draft in drafts:
        server.call("POST", f"{site}/drafts/{draft['id']}/edits", 200, json={"changes": [node("a", 11, 11)]})
    server.call("POST", f"{site}/edits", 201, json={"changes": [node("a", 14, 14)]})

    page = open_page(f"/?site={name}&view=history")
    row = page.get_by_role("region", name="Drafts").get_by_role("listitem").filter(has_text="my way")
    row.get_by_role("button", name="Merge with v2").click()
    conflicts = row.get_by_role("alert", name="Conflicts of the merge")
    expect(conflicts).to_contain_text("Network a: geometry")
    assert server.get(f"{site}/drafts/{drafts[0]['id']}")["base"] == 1
    conflicts.get_by_role("button", name="Keep the draft’s").click()
    expect(conflicts).to_have_count(0)
    assert server.get(f"{site}/drafts/{drafts[0]['id']}")["base"] == 2
    assert position(server, site, drafts[0]["version"]) == [11, 11]

    page.goto(f"{server.address}/?site={name}&view=edit&version={drafts[1]['version']}")
    expect(page.locator(".map-area")).to_have_attribute("aria-busy", "false")
    page.get_by_role("button", name="Review", exact=True).click()
    dialog = page.get_by_role("dialog", name="Review and save")
    dialog.get_by_role("button", name="Merge with v2").click()
    dialog.get_by_role("button", name="Keep those of v2").click()
    expect(dialog.get_by_role("alert")).to_have_count(0)
    assert server.get(f"{site}/drafts/{drafts[1]['id']}")["base"] == 2
    assert position(server, site, drafts[1]["version"]) == [14, 14]


def position(server: WebServer, site: str, ref: str) -> list[float]:
    (found,) = server.get(f"{site}/versions/{ref}/layers/topology", ids="a", crs="local")["features"]
    return [round(value, 3) for value in found["place"]["coordinates"][:2]]
