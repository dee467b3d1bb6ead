"""Pages of a centre applied to a mirror, on both databases."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from app.errors import Conflict, Gone, Mirrored, Unavailable, Untrusted
from app.model.layers import PartKey
from app.store import mirror_source
from app.store.edge_changes import OverlayChange
from app.store.fleet_values import Overlay
from app.store.mirror_source import new_content
from app.store.mirror_state import StoredDelegation
from app.store.mirror_target import MirrorPage, parse_page
from app.store.store import Store
from tests.store.samples import assert_same_layers, everything, grid, replaces, save

CENTRE = "https://centre.example"
NOW = datetime.now(UTC).replace(microsecond=0)


@pytest.fixture
def centre(migrated_file: Path, tmp_path: Path) -> Iterator[Store]:
    file = tmp_path / "centre" / "fleetmap.sqlite"
    file.parent.mkdir()
    shutil.copyfile(migrated_file, file)
    store = Store(f"sqlite:///{file}", tmp_path / "centre" / "blobs")
    store.migrate()
    store.environments.create("farm", title="Farm", tags=["wheat"], author="anna")
    save_grid(store, 0)
    yield store
    store.close()


KEY = PartKey("occupancy", "ground", "grid")


def save_grid(store: Store, seed: int) -> None:
    save(store, "farm", *replaces({KEY: grid(64, 64, seed=seed)}))


def get_page(centre: Store, store: Store, name: str) -> MirrorPage:
    """The next page of an environment, as it is sent."""
    local = next((e for e in store.mirror_target.environments().values() if e.name == name), None)
    after, sequence = (-1, 0) if local is None else (local.head, local.sequence)
    return parse_page(json.loads(json.dumps(centre.mirror_source.page(name, after, sequence))))


def copy(centre: Store, store: Store, name: str = "farm", **more: bool) -> MirrorPage:
    """Apply the next page with its content."""
    page = get_page(centre, store, name)
    after = page.last - len(page.versions)
    content = centre.mirror_source.content(name, after, page.last)
    _, absent = store.mirror_target.absent_chunks(page.prefixes)
    assert {h[:8] for h in content.chunks} == set(page.prefixes)
    chosen = [h for h in content.chunks if h[:8] in absent]
    store.mirror_target.add_chunks({h.hex(): data for h, data in centre.chunks.stored(chosen)})
    for sha256 in content.blobs:
        store.blobs.put(centre.blobs.get(sha256))
    roots = [entry.hash for version, _ in page.versions for entry in version.parts]
    base = [e.hash for e in store.versions.get_with_base(name, after)[0].parts] if after >= 0 else []
    new = new_content(store.chunks.stage(), base, roots)
    store.mirror_target.apply(page, CENTRE, new.chunks, new.blobs, **more)
    return page


def test_every_kind_of_content_is_equal(centre: Store, store: Store) -> None:
    save(centre, "farm", *replaces(everything()))
    copy(centre, store)
    ours, theirs = store.versions.get("farm"), centre.versions.get("farm")
    assert ours == theirs
    assert_same_layers(store.content.load(ours), centre.content.load(theirs))
    assert store.verifier().run().findings == []
    assert store.events.page("farm") == [
        replace(event, position=k + 1) for k, event in enumerate(centre.events.page("farm"))
    ]
    before = store.events.last_position()
    save_grid(centre, 1)
    copy(centre, store)
    assert store.versions.get("farm") == centre.versions.get("farm")
    assert store.events.last_position() == before + 1
    store.garbage.collect(timedelta(0))
    assert store.verifier().run().findings == [], "what versions need is kept"


def test_history_comes_in_pages(centre: Store, store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mirror_source, "MAX_VERSIONS", 2)
    monkeypatch.setattr(mirror_source, "MAX_EVENTS", 4)
    for number in range(5):
        save_grid(centre, number + 1)
        centre.channels.move("farm", "production", number + 2, author="anna")
    heads = []
    while not copy(centre, store).complete:
        heads.append(store.environments.get("farm").head)
        assert store.versions.get("farm") == centre.versions.get("farm", heads[-1]), "a state that the centre had"
    assert heads == sorted(heads)
    assert len(heads) > 2
    assert store.environments.get("farm").head == 6
    assert store.channels.all("farm") == centre.channels.all("farm")


def test_names_change_places(centre: Store, store: Store) -> None:
    centre.environments.create("yard")
    for name in ("farm", "yard"):
        copy(centre, store, name)
    for old, new in (("farm", "other"), ("yard", "farm"), ("other", "yard")):
        centre.environments.update(old, new_name=new)
    for item in centre.mirror_source.listing(None)["environments"]:
        local = store.mirror_target.environments()[item["id"]]
        page = parse_page(centre.mirror_source.page(item["name"], local.head, local.sequence))
        store.mirror_target.apply(page, CENTRE, (), ())
    assert {e.name: e.id for e in store.environments.page()[0]} == {e.name: e.id for e in centre.environments.page()[0]}
    store.mirror_target.remove(next(e.id for e in store.environments.page()[0] if e.name == "yard"))
    assert store.environments.create("yard").sequence > centre.environments.get("yard").sequence


def test_missing_content_stops_a_page(centre: Store, store: Store) -> None:
    page = get_page(centre, store, "farm")
    content = centre.mirror_source.content("farm", -1, page.last)
    with pytest.raises(Unavailable, match="removed while"):
        store.mirror_target.apply(page, CENTRE, content.chunks, ())
    assert store.mirror_target.environments() == {}
    assert store.events.last_position() == 0


def test_changed_manifest_is_refused(centre: Store) -> None:
    body = centre.mirror_source.page("farm", -1, 0)
    with pytest.raises(Untrusted, match="KeyError"):
        parse_page({name: value for name, value in body.items() if name != "events"})
    body["versions"][1]["root"] = "0" * 64
    with pytest.raises(Untrusted, match="0000 is stated"):
        parse_page(body)


def test_older_page_changes_nothing(centre: Store, store: Store) -> None:
    page = get_page(centre, store, "farm")
    copy(centre, store)
    centre.channels.move("farm", "production", 1, author="anna")
    copy(centre, store)
    store.mirror_target.apply(page, CENTRE, (), ())
    assert store.channels.all("farm") == centre.channels.all("farm")


def test_mirror_of_a_mirror_is_refused(centre: Store, store: Store) -> None:
    copy(centre, store)
    assert store.mirror_source.listing(None)["environments"] == []
    with pytest.raises(Mirrored, match="follow https://centre"):
        store.mirror_source.page("farm", -1, 0)


def test_changes_are_refused_but_deletion_is_followed(centre: Store, store: Store) -> None:
    copy(centre, store)
    for change in (
        lambda: store.environments.delete("farm"),
        lambda: store.channels.move("farm", "production", 1, author="me"),
        lambda: save_grid(store, 7),
    ):
        with pytest.raises(Mirrored, match="https://centre"):
            change()
    centre.environments.delete("farm")
    copy(centre, store)
    with pytest.raises(Gone):
        store.environments.get("farm")


def obstruction(state: str = "pending") -> Overlay:
    end = NOW + timedelta(hours=1)
    return Overlay("farm", "blocked", "ground", None, "e1", None, "a tree", "r1", NOW, end, state=state)  # type: ignore[arg-type]


def test_edge_changes_go_up_once(centre: Store, store: Store) -> None:
    copy(centre, store)
    sequence = store.events.last_sequence("farm")
    reported, _ = store.overlays.add(obstruction())
    store.overlays.decide("farm", reported.id, "pending", "accepted", "bob", NOW)
    assert store.events.last_sequence("farm") == sequence, "the next sequence is the centre's"
    local = [event for event in store.events.page(None) if "edge_sequence" in event.body]
    assert [(event.body["sequence"], event.body["edge_sequence"]) for event in local] == [(sequence, 1), (sequence, 2)]
    _, position = store.channels.target("farm", "latest")
    assert (position.sequence, position.edge) == (sequence, 2)
    for _ in range(2):  # the answer to the first attempt was lost
        for queued in store.edge_changes.waiting(10):
            overlay = replace(reported, state="pending")
            change = OverlayChange(queued.body["event"], overlay, queued.body["author"], NOW)
            centre.edge_changes.apply("farm", change)
    for queued in store.edge_changes.waiting(10):
        store.edge_changes.settle(queued, None, None)
    assert centre.events.last_sequence("farm") == sequence + 2
    copy(centre, store)
    assert store.overlays.all("farm") == centre.overlays.all("farm")
    assert store.overlays.closures("farm") == centre.overlays.closures("farm")


def test_refused_change_is_taken_back(centre: Store, store: Store) -> None:
    copy(centre, store)
    accepted, _ = store.overlays.add(obstruction("accepted"))
    before = store.channels.target("farm", "latest")
    (queued,) = store.edge_changes.waiting(10)
    store.edge_changes.settle(queued, "too many closures", None)
    after = store.channels.target("farm", "latest")
    assert store.overlays.get("farm", accepted.id).state == "rejected"
    assert "too many closures" in str(store.overlays.get("farm", accepted.id).decided_by)
    assert after[0].closures != before[0].closures
    assert after[1].edge == before[1].edge + 1
    centre.environments.create("yard")
    change = OverlayChange("overlay.created", replace(obstruction(), id="a1"), "r1", NOW)
    centre.edge_changes.apply("yard", change)
    with pytest.raises(Conflict, match="another environment"):
        centre.edge_changes.apply("farm", change)


def test_state_of_a_mirror(centre: Store, store: Store) -> None:
    assert store.mirrors.state() is None
    assert store.mirrors.describe() is None
    store.mirrors.start(CENTRE, b"k" * 32)
    copy(centre, store)
    farm_id = store.environments.get("farm").id
    end = NOW + timedelta(days=7)
    store.mirrors.store_delegations([StoredDelegation(farm_id, b"statement", "a" * 16, b"s" * 64, b"e" * 32, end)])
    store.mirrors.store_delegations([StoredDelegation("0" * 32, b"of a purged one", "a" * 16, b"", b"", end)])
    delegation = store.mirrors.delegation("farm")
    assert delegation is not None
    assert (delegation.statement, delegation.expires) == (b"statement", end)
    assert store.mirrors.describe()["state"] == "starting"  # type: ignore[index]
    store.mirrors.save(contact=datetime.now(UTC), failures={"yard": "of its own"})
    described = store.mirrors.describe()
    assert described is not None
    assert described["state"] == "connected"
    assert [(one["name"], one["problem"]) for one in described["environments"]] == [
        ("farm", None),
        ("yard", "of its own"),
    ]
    store.mirrors.save(problem="no connection")
    assert store.mirrors.describe()["state"] == "cut off"  # type: ignore[index]
