"""``fleetmap draft`` against a server: from a new draft to a version, and what it says when it cannot."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from typing import Any

import httpx
import pytest

from tests.cli.conftest import TOKEN, Fleetmap

Call = Callable[..., Any]


@pytest.fixture
def call(server: str) -> Iterator[Call]:
    """Return a function that calls the API as administrator."""
    with httpx.Client(base_url=f"{server}/api/v1/", headers={"authorization": f"Bearer {TOKEN}"}, timeout=60) as http:

        def send(method: str, path: str, body: Any = None, token: str = TOKEN) -> Any:
            answer = http.request(method, path, json=body, headers={"authorization": f"Bearer {token}"})
            assert answer.is_success, answer.text
            return answer.json() if answer.content else None

        yield send


@pytest.fixture
def field(call: Call, request: pytest.FixtureRequest) -> str:
    """Environment with two nodes at version 1, one for each test."""
    name = request.node.name.removeprefix("test_").replace("_", "-")[:60]
    call("POST", "environments", {"name": name})
    call("POST", f"environments/{name}/edits", {"changes": [node("barn", 0), node("gate", 5)]})
    return name


def node(item: str, x: float, **properties: Any) -> dict[str, Any]:
    place = {"type": "Point", "coordinates": [x, 0.0]}
    feature = {"type": "Feature", "id": item, "geometry": None, "place": place}
    return {"op": "put", "layer": "topology", "feature": {**feature, "properties": {"kind": "node", **properties}}}


def edit(call: Call, field: str, draft: str, *changes: dict[str, Any]) -> None:
    call("POST", f"environments/{field}/drafts/{draft}/edits", {"changes": list(changes)})


def test_draft_goes_from_creation_to_a_version(fleetmap: Fleetmap, call: Call, field: str) -> None:
    created = fleetmap("draft", "create", field, "new lanes")
    assert created.status == 0
    match = re.fullmatch(rf"{field}: draft ([0-9a-f]{{16}}) 'new lanes', from version 1\n", created.out)
    assert match, created.out
    draft = match[1]
    edit(call, field, draft, node("well", 9), node("gate", 6))
    listed = fleetmap("draft", "list", field)
    assert all(word in listed.out for word in (draft, "new lanes", "(you)", "1 added", "1 changed")), listed.out
    shown = fleetmap("draft", "show", field, "new lanes").out
    assert f"draft:{draft}" in shown
    assert re.search(r"^base:? +1$", shown, re.MULTILINE), shown
    diff = fleetmap("draft", "diff", field, f"draft:{draft}").out
    assert re.search(r"\+.*well", diff), diff
    assert re.search(r"~.*gate", diff), diff
    committed = fleetmap("draft", "commit", field, "new lanes", "-m", "well and gate")
    assert committed.status == 0
    assert committed.out.startswith(f"{field}: version 2 (")
    assert call("GET", f"environments/{field}/versions/2")["message"] == "well and gate"
    assert call("GET", f"environments/{field}/drafts") == []
    again = fleetmap("draft", "commit", field, "new lanes")
    assert (again.status != 0, "unknown draft 'new lanes'" in again.err, "available: none" in again.err) == (True,) * 3


def test_draft_json_is_what_the_server_returns(fleetmap: Fleetmap, call: Call, field: str) -> None:
    created = fleetmap("draft", "create", field, "--json").json
    assert created == call("GET", f"environments/{field}/drafts/{created['id']}")
    assert created["name"] == "draft 1"
    edit(call, field, created["id"], node("well", 9))
    assert fleetmap("draft", "list", field, "--json").json == call("GET", f"environments/{field}/drafts")
    shown = fleetmap("draft", "show", field, created["id"], "--json").json
    assert (shown["revision"], shown["changes"]["topology"]["added"]) == (2, 1)
    diff = fleetmap("draft", "diff", field, "draft 1", "--json").json
    assert diff["layers"]["topology"]["added"] == ["well"]
    call("POST", f"environments/{field}/edits", {"changes": [node("silo", 20)]})
    assert fleetmap("draft", "rebase", field, "draft 1", "--json").json["base"] == 2
    version = fleetmap("draft", "commit", field, "draft 1", "--json").json
    assert (version["version"], version["parent"], version["message"]) == (3, 2, "draft 1")
    other = fleetmap("draft", "create", field, "other", "--json").json
    assert fleetmap("draft", "delete", field, "other", "--json").json == {"id": other["id"], "deleted": True}


def test_draft_is_rebased_before_it_is_committed(fleetmap: Fleetmap, call: Call, field: str) -> None:
    draft = fleetmap("draft", "create", field, "mine", "--json").json["id"]
    edit(call, field, draft, node("gate", 6, name="mine"))
    call("POST", f"environments/{field}/edits", {"changes": [node("gate", 5, name="theirs")]})
    assert "1 (head: 2)" in fleetmap("draft", "list", field).out
    refused = fleetmap("draft", "commit", field, "mine")
    assert refused.status != 0
    assert "rebase the draft" in refused.err
    conflict = fleetmap("draft", "rebase", field, "mine")
    assert conflict.status != 0
    assert "gate (name)" in conflict.err
    assert call("GET", f"environments/{field}/drafts/{draft}")["base"] == 1, "nothing changed"
    wrong = fleetmap("draft", "rebase", field, "mine", "--prefer", "ours")
    assert (wrong.status, "draft" in wrong.err and "head" in wrong.err) == (2, True)
    rebased = fleetmap("draft", "rebase", field, "mine", "--prefer", "draft")
    assert rebased.out == f"{field}: draft 'mine' is based on version 2\n"
    assert fleetmap("draft", "commit", field, "mine").status == 0
    (gate,) = call("GET", f"environments/{field}/versions/3/layers/topology?ids=gate")["features"]
    assert gate["properties"]["name"] == "mine"


def test_draft_commands_say_what_is_wrong(fleetmap: Fleetmap, call: Call, field: str) -> None:
    empty = fleetmap("draft", "create", field, "new lanes", "--json").json["id"]
    near = fleetmap("draft", "show", field, "new lane")
    assert near.status != 0
    assert "unknown draft 'new lane' (did you mean new lanes?); available: 'new lanes'" in near.err
    assert "already" in fleetmap("draft", "create", field, "new lanes").err
    assert "no changes" in fleetmap("draft", "commit", field, "new lanes").err
    assert fleetmap("draft", "list", "no-such-place").status != 0
    ann, bob = (
        call("POST", "tokens", {"name": name, "role": "editor", "environments": field})["token"]
        for name in ("ann", "bob")
    )
    for token in (ann, bob):
        made = call("POST", f"environments/{field}/drafts", {"name": "lanes"}, token)
    several = fleetmap("draft", "delete", field, "lanes")
    assert several.status == 2
    assert "use an id" in several.err
    foreign = fleetmap("draft", "delete", field, made["id"], "--token", ann)
    assert foreign.status != 0
    assert "belongs to bob" in foreign.err
    deleted = fleetmap("draft", "delete", field, "new lanes")
    assert deleted.out == f"deleted draft {empty} 'new lanes'\n"
    assert fleetmap("draft", "delete", field, "lanes", "--token", ann).status == 0, "of several, one's own"
    assert [one["id"] for one in call("GET", f"environments/{field}/drafts")] == [made["id"]]
