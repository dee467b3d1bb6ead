"""Databases with many environments and versions, filled by the store's own code.

Each environment is created, and its last versions are prepared and committed, as a server does it; only the
transactions are joined, a thousand commits in one, so that they do not wait for the disk. Of a long history, one
environment in two hundred has committed every version itself; the others have copies of its older versions and events,
row by row as a mirror stores them, below a newest version of their own. All are a day old, and garbage was collected.
"""

from __future__ import annotations

import contextlib
import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Final

import numpy as np
from sqlalchemy import Connection, func, insert, select, update

from app.model.features import Features, from_columns, points
from app.model.frame import Datum
from app.model.layers import NETWORK, PartKey
from app.store import tables
from app.store.changes import KEEP, Changes, Put, Replace
from app.store.outbox import append_copies
from app.store.store import Store
from app.store.values import Event

TOPOLOGY: Final = PartKey("topology", "ground", NETWORK)
NODES: Final = 20
JOINED: Final = 1000
"""Number of commits in one transaction while a database is filled."""

GROUP: Final = 200
"""Number of environments that share a long history."""

SHORT: Final = 10
"""Number of versions up to which each environment commits all of its own."""

AGE: Final = timedelta(days=1)
"""Age of what is written: a garbage collection looks again at the versions of the hour before the last one."""

GRACE: Final = timedelta(hours=6)

NEWEST: Final = 1
"""Number of versions of its own that an environment with a copied history has."""


def name_of(environment: int) -> str:
    """Return an environment's name: none begins with another."""
    return f"site-{environment:05}"


def datum_of(environment: int) -> Datum:
    """Return an environment's place on earth: a lattice whose points are a kilometre apart."""
    row, column = divmod(environment, 100)
    return Datum(50.0 + row * 0.01, 5.0 + column * 0.015)


def network(seed: int) -> Features:
    """Return named nodes; the seed is in their names."""
    xy = np.random.default_rng(seed).random((NODES, 2)) * 100
    names = [f"Dock {seed}-{k}" for k in range(NODES)]
    properties = [{"kind": "node", "name": name} for name in names]
    return from_columns([f"n{k}" for k in range(NODES)], points(xy), properties, "local")


def fill(url: str, folder: Path, environments: int, versions: int) -> None:
    """Create environments, each with this many versions after its empty one; goes on where it was interrupted."""
    store = Store(url, folder / "blobs", clock=lambda: datetime.now(UTC) - AGE)
    store.migrate()
    with store.transaction() as connection:
        done = connection.execute(select(func.count()).select_from(tables.environment)).scalar_one()
    number = JOINED
    history: _History | None = None
    with contextlib.ExitStack() as stack:
        for environment in range(done, environments):
            if number >= JOINED:
                stack.close()
                connection = stack.enter_context(joined(store))
                number = 0
            first = environment - environment % GROUP  # of the environments that share a history
            if versions > SHORT and environment == first:
                history = None
            elif versions > SHORT and history is None:
                history = _read_history(connection, first, versions - NEWEST)
            number += _fill_environment(store, connection, environment, versions, history)
    store.search_index.refresh(environments)
    store.search_index.merge()  # as every day
    store.garbage.collect(GRACE)  # the first one, which looks at everything
    store.close()


@dataclass(frozen=True, slots=True)
class _History:
    """Rows of the versions 2 to ``last`` of an environment, and their events."""

    last: int
    root: str
    sequence: int
    versions: Sequence[dict[str, Any]]
    events: Sequence[Event]


def _read_history(connection: Connection, environment: int, last: int) -> _History:
    owner, version, event = tables.environment, tables.version, tables.event
    environment_id = connection.execute(select(owner.c.id).where(owner.c.name == name_of(environment))).scalar_one()
    query = select(version).where(version.c.environment_id == environment_id, version.c.number.between(2, last))
    rows = [dict(row._mapping) for row in connection.execute(query.order_by(version.c.number))]
    first, newest = rows[0]["sequence"], rows[-1]
    logged = select(event).where(
        event.c.environment_id == environment_id, event.c.sequence.between(first, newest["sequence"])
    )
    events = [Event(r.sequence, "", r.body, r.time, 0) for r in connection.execute(logged.order_by(event.c.sequence))]
    return _History(last, newest["root"], newest["sequence"], rows, events)


def _copy_history(connection: Connection, environment: int, history: _History) -> None:
    """Give an environment with its first version the older versions of another one."""
    owner, name = tables.environment, name_of(environment)
    environment_id = connection.execute(select(owner.c.id).where(owner.c.name == name)).scalar_one()
    rows = [{**row, "environment_id": environment_id} for row in history.versions]
    connection.execute(insert(tables.version), rows)
    head = {"head": history.last, "root": history.root, "sequence": history.sequence}
    connection.execute(update(owner).where(owner.c.id == environment_id).values(head))
    events = [replace(e, environment=name, body={**e.body, "environment": name}) for e in history.events]
    append_copies(connection, environment_id, events)


def _fill_environment(
    store: Store, connection: Connection, environment: int, versions: int, history: _History | None
) -> int:
    """Create an environment and commit its versions; returns how many commits that took."""
    name, datum = name_of(environment), datum_of(environment)
    store.environments.create(name, title=f"Site {environment}", datum=datum)
    if history is not None:
        _copy_history(connection, environment, history)
    first = store.versions.get(name).number + 1
    dice = random.Random(environment)
    head = store.versions.get(name)
    for version in range(first, versions + 1):
        if version == first:
            place = KEEP if history is None else datum
            changes = Changes((Replace(TOPOLOGY, network(environment)),), place)
        else:
            k = dice.randrange(NODES)
            moved = points(np.array([[dice.random() * 100, dice.random() * 100]]))
            properties = [{"kind": "node", "name": f"Dock {environment}-{k}"}]
            changes = Changes((Put(TOPOLOGY, from_columns([f"n{k}"], moved, properties, "local")),))
        head = store.versions.commit(name, store.versions.prepare(head, changes), author="bench", message="")
    return versions + 1 - first


@contextlib.contextmanager
def joined(store: Store) -> Iterator[Connection]:
    """Have all transactions of the store be one."""
    database = store._database
    methods = {name: getattr(database, name) for name in ("read", "snapshot", "write")}
    with database.connection() as connection:
        connection.execution_options(write=True)
        with connection.begin():

            @contextlib.contextmanager
            def reuse(**options: Any) -> Iterator[Connection]:
                yield connection

            for name in methods:
                setattr(database, name, reuse)
            try:
                yield connection
            finally:
                for name, method in methods.items():
                    setattr(database, name, method)
