"""Drafts: edits gather in them, are read like a version, rebased feature by feature, and committed as one version."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest

from tests.api.conftest import Api
from tests.api.test_merged_uploads import CLEAR, GREY, WALL, generate_hall, saved_grid, written_pixels

Json = dict[str, Any]


def node(id: str, x: float, y: float, **properties: Any) -> Json:
    place = {"type": "Point", "coordinates": [x, y]}
    members = {"kind": "node", "name": id, **properties}
    feature = {"type": "Feature", "id": id, "place": place, "geometry": None, "properties": members}
    return {"op": "put", "layer": "topology", "feature": feature}


def edge(source: str, target: str, **properties: Any) -> Json:
    members = {"kind": "edge", "source": source, "target": target, **properties}
    feature = {"type": "Feature", "id": f"{source}_{target}", "geometry": None, "properties": members}
    return {"op": "put", "layer": "topology", "feature": feature}


def delete(id: str) -> Json:
    return {"op": "delete", "layer": "topology", "id": id}


def cells(value: int, x0: float, y0: float, x1: float, y1: float) -> Json:
    ring = [[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]]
    return {"op": "cells", "polygon": {"type": "Polygon", "coordinates": [ring]}, "crs": "local", "value": value}


def features(api: Api, env: str, ref: Any) -> dict[str, Json]:
    items = api.get(f"environments/{env}/versions/{ref}/layers/topology?crs=local").json()["features"]
    return {item["id"]: item for item in items}


class Desk:
    """A draft of an environment."""

    def __init__(self, api: Api, env: str, **body: Any) -> None:
        self.api, self.env = api, env
        self.made: Json = api.post(f"environments/{env}/drafts", body).json()
        self.at = f"environments/{env}/drafts/{self.made['id']}"
        self.ref: str = self.made["version"]

    def edit(self, *changes: Json, expect: int = 200, headers: Any = None) -> Json:
        answer = self.api.post(f"{self.at}/edits", {"changes": list(changes)}, expect, headers=headers)
        return dict(answer.json())

    def rebase(self, expect: int = 200, **body: Any) -> Json:
        return dict(self.api.post(f"{self.at}/rebase", body, expect).json())

    def commit(self, expect: int = 201, headers: Any = None, **body: Any) -> Json:
        return dict(self.api.post(f"{self.at}/commit", body, expect, headers=headers).json())

    def features(self) -> dict[str, Json]:
        return features(self.api, self.env, self.ref)


@pytest.fixture
def desk(api: Api, farm: str) -> Iterator[Desk]:
    return Desk(api, farm, name="new lanes")


def edit_head(desk: Desk, *changes: Json) -> Json:
    return dict(desk.api.post(f"environments/{desk.env}/edits", {"changes": list(changes)}).json())


def test_edits_gather_in_a_draft_and_become_one_version(api: Api, desk: Desk) -> None:
    env = desk.env
    assert (desk.made["base"], desk.made["head"], desk.made["behind"], desk.made["changes"]) == (3, 3, False, {})
    assert (desk.made["name"], desk.made["is_owner"]) == ("new lanes", True)
    first = desk.edit(node("shed", 20, 0), edge("barn", "shed"))
    second = desk.edit(node("shed", 20, 5, name="tool shed"), cells(100, 0, 0, 1, 1))
    assert first["changes"]["topology"] == {"added": 2, "changed": 0, "deleted": 0}
    assert second["changes"]["topology"] == {"added": 2, "changed": 0, "deleted": 0}, "counted against the base"
    assert second["changes"]["occupancy"]["map"]["blocked"] > 0
    assert (first["revision"], second["revision"]) == (2, 3)
    assert api.get(f"environments/{env}").json()["version"] == 3, "no version yet"
    assert "shed" not in features(api, env, "latest")
    assert desk.features()["barn_shed"]["place"]["coordinates"][-1] == pytest.approx([20, 5])
    listed = api.get(f"environments/{env}/drafts").json()
    assert [one["id"] for one in listed] == [desk.made["id"]]
    shown = api.get(f"environments/{env}/diff?to={desk.ref}").json()
    assert shown["layers"]["topology"]["added"] == ["barn_shed", "shed"]
    read = api.get(f"environments/{env}/versions/{desk.ref}").json()
    assert (read["version"], read["id"], read["diff"]) == (None, desk.ref, shown)
    assert read["revision"] == 3
    assert api.get(f"environments/{env}/impact?to={desk.ref}").json()["to"] == desk.ref
    assert api.get(f"environments/{env}/versions/{desk.ref}/checks").json()["version"] == desk.ref
    version = desk.commit(headers={"If-Match": '"3"'})
    assert (version["version"], version["parent"], version["message"]) == (4, 3, "new lanes")
    assert version["root"] == read["root"]
    assert features(api, env, "latest")["shed"]["properties"]["name"] == "tool shed"
    api.problem("GET", desk.at, 404)
    api.problem("GET", f"environments/{env}/versions/{desk.ref}", 404)


def test_answers_follow_the_edits_of_a_draft(api: Api, desk: Desk) -> None:
    """Answers that are kept in memory or by a client must not outlive the content."""
    addresses = [
        f"environments/{desk.env}/versions/{desk.ref}{path}"
        for path in ("", "/layers/topology?crs=local", "/checks", "/preview.png", "/tiles/occupancy/map")
    ]
    addresses.append(f"environments/{desk.env}/diff?to={desk.ref}&format=geojson")
    before = [api.get(address) for address in addresses]
    desk.edit(node("silo", 3, 3), cells(100, 0, 0, 2, 2))
    for address, old in zip(addresses, before, strict=True):
        assert "immutable" not in old.headers.get("cache-control", ""), address
        new = api.get(address, headers={"if-none-match": old.headers["etag"]})
        assert new.headers["etag"] != old.headers["etag"], address
        assert new.content != old.content, address


def test_draft_is_refused_where_robots_read(api: Api, desk: Desk) -> None:
    desk.edit(node("silo", 3, 3))
    at = f"environments/{desk.env}/versions/{desk.ref}"
    for path in ("maps/tmap2", "manifest?formats=tmap2", "delta?since=1"):
        assert "commit it first" in api.problem("GET", f"{at}/{path}", 422)["detail"]
    api.problem("PUT", f"environments/{desk.env}/channels/staging", 422, json={"version": desk.ref})


def test_invalid_edit_leaves_the_draft_as_it_was(api: Api, desk: Desk) -> None:
    desk.edit(node("shed", 20, 0))
    refused = api.problem(
        "POST", f"{desk.at}/edits", 422, json={"changes": [node("b", 1, 1), {**node("c", 1, 1), "layer": "zones"}]}
    )
    assert refused["errors"][0]["where"] == "changes[1]"
    assert "edge" in api.problem("POST", f"{desk.at}/edits", 422, json={"changes": [delete("barn")]})["detail"]
    now = api.get(desk.at).json()
    assert (now["revision"], now["changes"]["topology"]["added"]) == (2, 1)


def test_edit_of_other_content_is_refused_on_request(api: Api, desk: Desk) -> None:
    tag = api.get(desk.at).headers["etag"]
    desk.edit(node("a", 1, 1), headers={"If-Match": tag})
    refused = desk.edit(node("b", 1, 1), headers={"If-Match": tag}, expect=412)
    assert "read it again" in refused["detail"]
    assert "b" not in desk.features()


def test_concurrent_edits_are_all_kept_and_none_is_worked_out_twice(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    editor = desk.api.app.state.services.ingest.drafts
    run_in_worker, runs = editor._run_in_worker, []

    def counted(*arguments: Any, **options: Any) -> Any:
        runs.append(1)
        return run_in_worker(*arguments, **options)

    monkeypatch.setattr(editor, "_run_in_worker", counted)
    with ThreadPoolExecutor(4) as threads:
        list(threads.map(lambda k: desk.edit(node(f"n{k}", k, 1)), range(8)))
    assert {f"n{k}" for k in range(8)} <= set(desk.features())
    assert len(runs) == 8


def test_only_the_owner_and_administrators_write_a_draft(api: Api, farm: str) -> None:
    ann, bob, viewer = api.token_for("editor"), api.token_for("editor"), api.token_for("viewer")
    desk = Desk(ann, farm)
    assert desk.made["name"] == "draft 1"
    desk.edit(node("shed", 20, 0))
    assert [one["is_owner"] for one in bob.get(f"environments/{farm}/drafts").json()] == [False]
    assert "shed" in features(bob, farm, desk.ref), "editors see it"
    for method, path, body in (
        ("POST", "/edits", {"changes": [node("b", 1, 1)]}),
        ("POST", "/rebase", {}),
        ("POST", "/commit", {}),
        ("DELETE", "", None),
    ):
        assert "belongs to" in bob.problem(method, desk.at + path, 403, json=body)["detail"]
    viewer.problem("GET", f"environments/{farm}/drafts", 403)
    ann.problem("POST", f"environments/{farm}/drafts", 409, json={"name": "draft 1"})
    assert Desk(bob, farm).made["name"] == "draft 1", "names are unique among one's own"
    desk.api = api
    desk.edit(node("c", 1, 1))
    api("DELETE", desk.at, 204)
    api.problem("GET", desk.at, 404)


def test_commit_needs_the_head_and_changes(api: Api, desk: Desk) -> None:
    assert "no changes" in desk.commit(409)["detail"]
    desk.edit(node("shed", 20, 0))
    assert "If-Match" in desk.commit(412, headers={"If-Match": '"2"'})["detail"]
    edit_head(desk, node("silo", 5, 5))
    assert api.get(desk.at).json()["behind"] is True
    assert "rebase the draft" in desk.commit(412)["detail"]
    assert desk.rebase()["base"] == 4
    first = desk.commit(headers={"Idempotency-Key": "k"}, message="both")
    again = desk.commit(headers={"Idempotency-Key": "k"}, message="both")
    assert first == again
    assert {"shed", "silo"} <= set(features(api, desk.env, 5))


def test_rebase_merges_properties_ends_and_cells(desk: Desk) -> None:
    """Each side moves one end of an edge and changes another property of the same node; both are kept."""
    desk.edit(node("barn", 12, 0, name="barn", colour="red"), cells(100, 0, 0, 1, 1), edge("gate", "field"))
    edit_head(desk, node("gate", 0, 4), node("field", 10, 9), cells(100, 2, 0, 3, 1))
    edit_head(desk, node("yard", 30, 0), edge("barn", "yard"))
    rebased = desk.rebase()
    assert (rebased["base"], rebased["behind"]) == (5, False)
    now = desk.features()
    ends = {name: item["place"]["coordinates"] for name, item in now.items()}
    assert ends["gate_barn"] == [pytest.approx([0, 4]), pytest.approx([12, 0])], "an end from each"
    assert ends["gate_field"] == [pytest.approx([0, 4]), pytest.approx([10, 9])], "of the draft, to their nodes"
    assert ends["barn_yard"] == [pytest.approx([12, 0]), pytest.approx([30, 0])], "theirs, to the draft's node"
    assert now["barn"]["properties"]["colour"] == "red"
    grid = rebased["changes"]["occupancy"]["map"]
    assert (grid["bbox"][0], grid["bbox"][2]) == pytest.approx((0, 1), abs=0.51), "their cells are no change"
    desk.commit()


def test_rebase_merges_cells_of_a_generated_grid(api: Api, bare: str) -> None:
    """The first edit of cells also changes what the grid says about itself, on each side."""
    generate_hall(api, bare)
    desk = Desk(api, bare, name="walls")
    before = written_pixels(api, bare)
    desk.edit(cells(100, 1, 1, 2, 2))
    edit_head(desk, cells(100, 5, 5, 6, 6))
    desk.rebase()
    desk.commit()
    changed = np.argwhere(written_pixels(api, bare) != before)
    assert changed.tolist() == [[1, 1], [5, 5]]
    assert "walls_map" in api.get(f"/maps/{bare}/gazebo").text


def test_rebase_merges_cells_of_grey(api: Api, bare: str) -> None:
    """Nav2 reads map_saver's grey of unknown cells as free: to confirm such a cell as free is a change, too."""
    api.upload(bare, saved_grid(np.full((3, 4), GREY)))
    desk = Desk(api, bare, name="grey")
    desk.edit(cells(0, 0, 0, 1, 1), cells(0, 1, 0, 2, 1), cells(100, 2, 0, 3, 1))
    edit_head(desk, cells(0, 1, 0, 2, 1), cells(100, 3, 0, 4, 1), cells(0, 0, 2, 1, 3))
    desk.rebase()
    desk.edit(cells(100, 3, 2, 4, 3))
    edit_head(desk, cells(0, 3, 2, 4, 3))
    (conflict,) = desk.rebase(409)["conflicts"]
    assert "1 cells differently" in conflict["reason"]
    desk.rebase(prefer="head")
    desk.commit()
    assert written_pixels(api, bare).tolist() == [
        [CLEAR, CLEAR, WALL, WALL],
        [GREY, GREY, GREY, GREY],
        [CLEAR, GREY, GREY, CLEAR],
    ]


def test_rebase_of_a_grid_in_another_frame_is_a_conflict(api: Api, bare: str) -> None:
    api.upload(bare, saved_grid(np.full((3, 4), CLEAR)))
    desk = Desk(api, bare, name="wider")
    desk.edit(cells(100, 0, 0, 1, 1))
    api.upload(bare, saved_grid(np.full((3, 5), CLEAR)))
    (conflict,) = desk.rebase(409)["conflicts"]
    assert conflict["fields"] == ["grid"]
    desk.rebase(prefer="head")
    assert "occupancy" not in api.get(desk.at).json()["changes"]


def test_conflicts_name_feature_and_field(api: Api, desk: Desk) -> None:
    desk.edit(node("barn", 12, 0, speed=1), node("gate", 0, 0, note="mine"), delete("barn_field"), delete("field"))
    edit_head(desk, node("barn", 10, 0, speed=2), node("gate", 0, 1), node("x", 1, 1), edge("field", "x"))
    body = desk.rebase(409)
    found = {(c["layer"], c["id"]): c["fields"] for c in body["conflicts"]}
    assert found == {("topology", "barn"): ["speed"], ("topology", "field_x"): ["source"]}
    assert "topology barn (speed)" in body["detail"]
    assert api.get(desk.at).json()["base"] == 3, "nothing changed"
    still = desk.rebase(409, prefer="draft")
    assert [c["id"] for c in still["conflicts"]] == ["field_x"], "an edge without its node is never stored"
    desk.edit(node("field", 10, 8))
    kept = desk.rebase(prefer="draft")
    assert kept["behind"] is False
    now = desk.features()
    assert now["barn"]["properties"]["speed"] == 1
    assert now["barn"]["place"]["coordinates"] == pytest.approx([12, 0])
    assert now["gate"]["properties"]["note"] == "mine"
    assert now["gate"]["place"]["coordinates"] == pytest.approx([0, 1])
    assert "barn_field" not in now


def test_preferred_head_keeps_what_only_the_draft_changed(desk: Desk) -> None:
    desk.edit(node("barn", 12, 0, speed=1), cells(100, 0, 0, 1, 1))
    edit_head(desk, node("barn", 14, 0, speed=2), cells(0, 0, 0, 0.5, 0.5), delete("gate_barn"))
    fields = {c["id"]: c["fields"] for c in desk.rebase(409)["conflicts"]}
    assert fields["barn"] == ["geometry", "speed"]
    assert fields["gate_barn"] == ["deleted"], "the draft dragged it"
    desk.rebase(prefer="head")
    now = desk.features()
    assert now["barn"]["properties"]["speed"] == 2
    assert now["barn"]["place"]["coordinates"] == pytest.approx([14, 0])
    assert "gate_barn" not in now
    assert now["barn_gate"]["place"]["coordinates"][0] == pytest.approx([14, 0])


def test_unknown_draft_is_told(api: Api, farm: str, fresh: Any) -> None:
    desk = Desk(api, farm)
    other = fresh()
    api.post("environments", {"name": other})
    for env, name in ((other, desk.made["id"]), (farm, "0" * 16)):
        assert "has no draft" in api.problem("GET", f"environments/{env}/drafts/{name}", 404)["detail"]
        assert "has no draft" in api.problem("GET", f"environments/{env}/versions/draft:{name}/layers", 404)["detail"]
    api.problem("GET", f"environments/{farm}/drafts/mine", 422)
    assert "name" in api.problem("POST", f"environments/{farm}/drafts", 422, json={"name": "a\nb"})["detail"]


def on_level(change: Json, level: str) -> Json:
    return {**change, "level": level}


def lift(source: str, target: str) -> Json:
    """Put an edge to another level's node; it is stored on the ground."""
    change = on_level(edge(source, target, action="lift"), "ground")
    change["feature"]["place"] = {"type": "LineString", "coordinates": [[0, 0], [1, 1]]}
    return change


@pytest.fixture
def storeys(api: Api, farm: str) -> Iterator[Desk]:
    """A draft of an environment with a second network, on level `upper`, and a third, on `top`."""
    changes = [on_level(node(name, x, 1), "upper") for name, x in (("loft", 1), ("attic", 5), ("roof", 9))]
    changes += [on_level(node("roof", 9, 1), "top"), on_level(node("mast", 9, 2), "top")]
    api.post(f"environments/{farm}/edits", {"changes": changes})
    return Desk(api, farm, name="lifts")


def becomes_edge(name: str) -> Json:
    change = on_level(edge("attic", "attic"), "upper")
    change["feature"] |= {"id": name, "place": {"type": "LineString", "coordinates": [[5, 1], [5, 1]]}}
    return change


@pytest.mark.parametrize("removal", [delete("loft"), becomes_edge("loft")])
@pytest.mark.parametrize("removes", ["draft", "head"])
def test_edge_to_another_level_keeps_its_node(storeys: Desk, removal: Json, removes: str) -> None:
    """One side deletes a node, or makes it an edge, to which the other leads a lift from a level of its own."""
    changes = {removes: removal, "head" if removes == "draft" else "draft": lift("gate", "loft")}
    storeys.edit(changes["draft"])
    edit_head(storeys, changes["head"])
    for body in ({}, {"prefer": "draft"}, {"prefer": "head"}):
        (conflict,) = storeys.rebase(409, **body)["conflicts"]
        assert (conflict["level"], conflict["id"], conflict["fields"]) == ("ground", "gate_loft", ["target"])
        assert ("the draft deleted" in conflict["reason"]) == (removes == "draft")
    storeys.edit(on_level(node("loft", 1, 1), "upper") if removes == "draft" else delete("gate_loft"))
    storeys.rebase()


@pytest.mark.parametrize("moves", ["draft", "head"])
def test_edge_to_another_level_is_tied_to_its_moved_node(storeys: Desk, moves: str) -> None:
    changes = {moves: on_level(node("loft", 3, 4), "upper")}
    changes["head" if moves == "draft" else "draft"] = lift("gate", "loft")
    storeys.edit(changes["draft"])
    edit_head(storeys, changes["head"])
    storeys.rebase()
    assert storeys.features()["gate_loft"]["place"]["coordinates"] == [[0, 0], pytest.approx([3, 4])]


def test_node_of_an_unchanged_level_takes_the_place_of_a_deleted_one(storeys: Desk) -> None:
    storeys.edit(lift("gate", "roof"))
    edit_head(storeys, {**delete("roof"), "level": "upper"})
    storeys.rebase()
    assert "gate_roof" in storeys.features()
