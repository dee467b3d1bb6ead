"""Drafts in the store: kept with all of their content until they are committed, deleted or expire."""

from __future__ import annotations

from datetime import timedelta

import pytest

from app.errors import Conflict, Invalid, NotFound, StaleParent
from app.store import drafts
from app.store.changes import Changes, Replace
from app.store.pending import as_prepared
from app.store.store import Store
from app.store.values import Draft, Pending, Writer
from tests.store.conftest import Clock, count
from tests.store.samples import GRID, TOPOLOGY, grid, network, save

ANN, BOB = Writer("1", "ann"), Writer("2", "bob")


def edit(store: Store, draft: Draft, nodes: int) -> Draft:
    current = store.versions.get("farm", draft.ref)
    assert current.pending is not None
    base = store.versions.get("farm", draft.base)
    prepared = store.versions.prepare_further(base, current, Changes((Replace(TOPOLOGY, network(nodes)),)))
    return store.drafts.store("farm", current.pending, prepared, rebased=False)


def test_draft_holds_its_content_until_it_is_deleted(farm: Store) -> None:
    made = farm.drafts.create("farm", ANN, "lanes")
    edited = edit(farm, edit(farm, made, 60), 50)
    assert edited.changes["topology"]["added"] == 50
    assert edited.changes["topology"]["deleted"] == 0, "counted against the base"
    assert farm.garbage.collect(timedelta(0))["chunks"] > 0, "those of the first edit"
    farm.chunks.forget()
    assert len(farm.content.features(farm.versions.get("farm", made.ref), TOPOLOGY)) == 50
    assert farm.drafts.all("farm") == [edited]
    farm.drafts.delete("farm", made.id)
    with pytest.raises(NotFound, match="has no draft"):
        farm.versions.get("farm", made.ref)
    assert farm.garbage.collect(timedelta(0))["chunks"] > 0
    assert farm.verifier().run().findings == []


def test_commit_takes_the_draft_away_with_its_content(farm: Store) -> None:
    draft = edit(farm, farm.drafts.create("farm", ANN), 50)
    current = farm.versions.get("farm", draft.ref)
    edit(farm, draft, 51)
    with pytest.raises(StaleParent, match="edited meanwhile"):
        farm.versions.commit("farm", as_prepared(current), author="ann", message="")
    assert farm.versions.get("farm").number == 1
    newer = farm.versions.get("farm", draft.ref)
    version = farm.versions.commit("farm", as_prepared(newer), author="ann", message="")
    assert (version.number, version.root, version.pending) == (2, newer.root, None)
    assert farm.drafts.all("farm") == []
    farm.garbage.collect(timedelta(0))
    assert len(farm.content.features(version, TOPOLOGY)) == 51
    assert farm.verifier().run().findings == []


def test_only_one_of_two_edits_of_the_same_content_is_stored(farm: Store) -> None:
    draft = farm.drafts.create("farm", ANN)
    current = farm.versions.get("farm", draft.ref)
    assert current.pending is not None
    base = farm.versions.get("farm")
    prepared = farm.versions.prepare_further(base, current, Changes((Replace(TOPOLOGY, network(9)),)))
    farm.drafts.store("farm", current.pending, prepared, rebased=False)
    with pytest.raises(StaleParent, match="edited meanwhile"):
        farm.drafts.store("farm", current.pending, prepared, rebased=False)
    save(farm, "farm", Replace(GRID, grid()))
    now = Pending("draft", draft.id, draft.expires, changed=True, revision=2)
    with pytest.raises(StaleParent, match="rebase again"):
        farm.drafts.store("farm", now, prepared, rebased=True)
    assert farm.drafts.get("farm", draft.id).revision == 2


def test_draft_expires_long_after_its_last_edit(farm: Store, clock: Clock) -> None:
    draft = farm.drafts.create("farm", ANN)
    clock.now += drafts.LIFETIME - timedelta(seconds=1)
    draft = edit(farm, draft, 9)
    clock.now += drafts.LIFETIME - timedelta(seconds=1)
    farm.drafts.remove_expired()
    assert farm.drafts.get("farm", draft.id) == draft
    clock.now += timedelta(seconds=1)
    with pytest.raises(NotFound):
        farm.drafts.get("farm", draft.id)
    assert farm.drafts.all("farm") == []
    farm.drafts.remove_expired()
    assert count(farm, "draft") == 0


def test_drafts_are_limited_in_number_and_size(farm: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drafts, "MAX_DRAFTS", 3)
    monkeypatch.setattr(drafts, "MAX_CHANGES", 20)
    names = [farm.drafts.create("farm", writer).name for writer in (ANN, ANN, BOB)]
    assert names == ["draft 1", "draft 2", "draft 1"]
    with pytest.raises(Conflict, match="3 drafts already"):
        farm.drafts.create("farm", BOB, "one more")
    (draft,) = [one for one in farm.drafts.all("farm") if one.owner == "bob"]
    with pytest.raises(Invalid, match="would change 21 features"):
        edit(farm, draft, 21)
    assert edit(farm, draft, 20).revision == 2


def test_purged_environment_has_no_drafts(farm: Store) -> None:
    farm.drafts.create("farm", ANN)
    farm.environments.delete("farm")
    farm.environments.purge("farm")
    assert count(farm, "draft") == 0
