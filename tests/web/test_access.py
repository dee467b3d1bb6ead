"""Tokens in a browser: made, shown once, used, revoked."""

from __future__ import annotations

import re

import httpx
import pytest
from playwright.sync_api import expect

from tests.web.conftest import Open, WebServer, check_accessibility


@pytest.fixture(scope="module", autouse=True)
def yard(server: WebServer) -> None:
    server.call("POST", "environments", json={"name": "yard", "title": "Yard"})


def status_of(server: WebServer, token: str) -> int:
    headers = {"authorization": f"Bearer {token}"}
    return httpx.get(f"{server.address}/api/v1/environments", headers=headers).status_code


def test_robot_token_is_shown_once_used_and_revoked(open_page: Open, server: WebServer, axe: str) -> None:
    page = open_page("/?site=yard")
    page.get_by_role("button", name="Tokens").click()
    dialog = page.get_by_role("dialog", name="Tokens")
    dialog.get_by_label("Role").select_option("robot")
    dialog.get_by_label("Name").fill("mower-3")
    dialog.get_by_label("Sites").fill("yard*")
    dialog.get_by_role("button", name="Create token").click()
    token = dialog.get_by_role("textbox", name="Token").inner_text()
    command = dialog.get_by_role("textbox", name="Command on the robot")
    expect(command).to_contain_text(token)
    expect(command).to_contain_text("--robot mower-3 --environment yard")
    check_accessibility(page, axe)
    page.keyboard.press("Escape")
    expect(dialog.get_by_role("alertdialog")).to_contain_text("can never be shown again")
    page.keyboard.press("Escape")
    dialog.get_by_role("button", name="Back to the token").click()
    expect(dialog.get_by_role("textbox", name="Token")).to_have_text(token)
    assert status_of(server, token) == 200
    dialog.get_by_role("button", name="I have copied it").click()
    row = dialog.get_by_role("listitem").filter(has_text="mower-3")
    expect(row).to_contain_text(re.compile(r"robot · yard\*"))
    expect(dialog.get_by_role("listitem").filter(has_text="administrator")).to_contain_text("in use")
    assert token not in page.content()
    check_accessibility(page, axe)
    row.get_by_role("button", name="Revoke mower-3").click()
    expect(row).to_contain_text("The robot mower-3 loses its access")
    row.get_by_role("button", name="Revoke", exact=True).click()
    expect(row).to_have_count(0)
    assert status_of(server, token) == 401
    assert "mower-3" not in {one["name"] for one in server.get("tokens")}


def test_revoking_ones_own_token_says_so_and_a_link_signs_in(open_page: Open, server: WebServer) -> None:
    own = server.call("POST", "tokens", json={"name": "Anna", "role": "admin"})
    page = open_page("/?site=yard", token=own["token"])
    page.get_by_role("button", name="Tokens").click()
    row = page.get_by_role("dialog").get_by_role("listitem").filter(has_text="Anna")
    row.get_by_role("button", name="Sign-in link for Anna").click()
    address = row.get_by_role("textbox", name="Sign-in link").inner_text()
    other = open_page(address.removeprefix(server.address), token=None)
    expect(other.get_by_role("heading", name="Sites")).to_be_visible()
    row.get_by_role("button", name="Revoke Anna").click()
    expect(row).to_contain_text("You are signed in with this token")
    row.get_by_role("button", name="Revoke", exact=True).click()
    expect(page.get_by_role("dialog", name="Sign in again")).to_be_visible()
    assert status_of(server, own["token"]) == 401
