"""Indexes for boxes and texts of environments: the same results as without them."""

from __future__ import annotations

import random

import pytest
from sqlalchemy import text, true

from app.model.frame import Datum
from app.store import environments
from app.store import position as position_module
from app.store.base import MAX_TEXT
from app.store.changes import Changes, Replace
from app.store.store import Store
from tests.store.conftest import count
from tests.store.samples import TOPOLOGY, network, save

PLACES = [(0.0, 10.0), (0.5, 10.5), (52.0, 179.9995), (52.0, -179.9995), (-40.0, -70.0)]


def test_indexes_change_no_result(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    dice = random.Random(2)
    for k in range(15):
        latitude, longitude = PLACES[k % 5]
        datum = Datum(latitude, longitude, 0.0, 0.0)
        tags = [f"tag{k % 3}", 'a "b"']
        store.environments.create(f"site-{k}", title=f"Größe {k}", description="100 % _field_", tags=tags, datum=datum)
        if k % 4:
            save(store, f"site-{k}", Replace(TOPOLOGY, network(5, seed=k)))
    for k in range(5):
        store.environments.update(f"site-{k}", new_name=f"yard-{k}", title=f"Moved {k}", tags=["moved"])
        head = store.versions.get(f"site-{k + 5}")
        datum = Datum(*PLACES[(k + 2) % 5], 0.0, 0.0)
        store.versions.commit(
            head.environment, store.versions.prepare(head, Changes((), datum=datum)), author="a", message=""
        )
    store.environments.delete("site-14")
    store.environments.purge("site-14")
    queries = ["yard", "SITE-1", "größe", "GRÖSSE", "moved 3", "tag1", "% _f", 'a "b"', "none", "a\\", "ag", None]
    boxes = [(lon - 1, lat - 1, lon + 1, lat + 1) for lat, lon in PLACES if abs(lon) < 179]
    boxes += [(179.0, 51.0, -179.0, 53.0), (-180.0, -90.0, 180.0, 90.0), (10.5001, 0.5, 10.6, 0.6)]
    for q in queries:
        for box in (None, *dice.sample(boxes, 3)):
            names = [e.name for e in store.environments.page(q=q, bbox=box)[0]]
            with monkeypatch.context() as without:
                without.setattr(environments, "few_environments", lambda *_: [])
                assert names == [e.name for e in store.environments.page(q=q, bbox=box)[0]], (q, box)
    positions = [(latitude + d, longitude) for latitude, longitude in PLACES for d in (0.0, 0.0004, 0.003)]
    by_index = [store.areas.locate(*position)[0] for position in positions]
    with monkeypatch.context() as without:
        without.setattr(position_module, "pieces_around", lambda x, y: true())
        assert by_index == [store.areas.locate(*position)[0] for position in positions]
    assert sum(map(len, by_index)) > 10
    for environment in store.environments.page()[0]:
        store.environments.delete(environment.name)
        store.environments.purge(environment.name)
    remains = ["environment_text"]
    if store._database.sqlite:
        remains = ["box_number", "box_tree", "environment_text WHERE environment_text MATCH 'sit OR yar OR fie'"]
    assert [count(store, rows) for rows in remains] == [0] * len(remains)


@pytest.mark.postgres
@pytest.mark.parametrize("database_url", ["postgres"], indirect=True)
def test_postgresql_finds_texts_by_their_groups_of_characters(store: Store) -> None:
    """The groups that the database computes are those that a query asks for, also of the longest text."""
    description = "Grüße\n" + "ab" * (MAX_TEXT // 3)
    store.environments.create("a", title="x" * 7, description=description)
    assert [e.name for q in ("üße\nab", "ba", "x" * 8) for e in store.environments.page(q=q)[0]] == ["a", "a"]
    with store._database.read() as connection:
        stored = connection.execute(text("SELECT tsvector_to_array(grams) FROM environment_text")).scalar_one()
    characters = f"a\n{'x' * 7}\n{description.lower()}\n[]"
    assert set(stored) == {characters[k : k + 3] for k in range(len(characters))}
