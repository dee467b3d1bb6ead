"""A centre that lies, breaks off, or is another one: an error that says so, nothing half stored, recovery by itself."""

from __future__ import annotations

import gzip
import itertools
import json
import tracemalloc
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import pytest
from sqlalchemy import update

from app.errors import Denied, FleetMapError, Unauthenticated, Unavailable, Untrusted
from app.mirror.centre import Centre
from app.store import tables
from tests.api import samples
from tests.api.conftest import Api, create_farm, running, settings_for
from tests.mirror.conftest import Edge, mirror_token

Make = Callable[..., Edge]
Change = Callable[[str, bytes], bytes]
_count = itertools.count(1)


@pytest.fixture
def farm(centre: Api) -> str:
    return create_farm(centre, f"field-{next(_count)}")


def only(ending: str, change: Callable[[bytes], bytes]) -> Change:
    return lambda path, body: change(body) if path.endswith(ending) else body


def flipped(body: bytes) -> bytes:
    return body[:-9] + bytes([body[-9] ^ 1]) + body[-8:]


@pytest.mark.parametrize(
    ("change", "kind"),
    [
        (only("/content", flipped), (Untrusted, Unavailable)),
        (only("/content", lambda body: body[: len(body) // 2]), (Unavailable,)),
        (only("/content", lambda _: b"\0\0\0\3abc"), (Untrusted,)),
        (only("/mirror", lambda body: body.replace(b'"tags":["wheat"]', b'"tags":["weeds"]')), (Untrusted,)),
        (only("/mirror", lambda body: body[:-40]), (Untrusted,)),
        (only("/keys", lambda _: b"[]"), (Untrusted,)),
    ],
    ids=["damaged content", "content cut off", "other content", "changed page", "page cut off", "no keys"],
)
def test_changed_answer_is_refused(
    farm: str, alone: Make, change: Change, kind: tuple[type[FleetMapError], ...]
) -> None:
    edge = alone(farm)
    edge.wire.change = change
    outcome: Any = None
    try:
        outcome = edge.mirror.run_once().failures
    except FleetMapError as error:
        assert isinstance(error, kind), error
    assert outcome is None or list(outcome) == [farm], outcome
    assert edge.store.mirror_target.environments() == {}, "nothing half stored"
    edge.wire.change = None
    edge.follow()
    assert edge.store.environments.get(farm).head == 3
    assert edge.store.verifier().run().findings == []


def test_cut_off_transfer_goes_on(farm: str, alone: Make) -> None:
    edge = alone(farm)
    for limit in itertools.count(200, 400):
        edge.wire.limit = limit
        failures = edge.mirror.run_once().failures
        if not failures:
            break
        assert "ended early" in failures[farm]
        assert edge.store.mirror_target.environments() == {}
    assert edge.store.verifier().run().findings == []


def test_lost_content_of_one_environment_holds_up_no_other(centre: Api, farm: str, alone: Make) -> None:
    later = create_farm(centre, f"{farm}-later")
    centre.upload(farm, {"network.tmap2.yaml": samples.tmap2({"only": (1.0, 2.0)}, ())})
    store = centre.app.state.services.store
    before = {entry.hash for entry in store.versions.get(farm, 3).parts}
    lost = next(bytes.fromhex(e.hash) for e in store.versions.get(farm).parts if e.hash not in before)
    edge = alone(farm, later)
    with store._database.write() as connection:
        row = connection.execute(tables.chunk.select().where(tables.chunk.c.hash == lost)).one()
        connection.execute(update(tables.chunk).where(tables.chunk.c.hash == lost).values(data=b"damaged"))
    failures = edge.mirror.run_once().failures
    assert list(failures or ()) == [farm]
    assert edge.store.environments.get(later).head == 3
    with store._database.write() as connection:
        connection.execute(update(tables.chunk).where(tables.chunk.c.hash == lost).values(data=row.data))
    edge.follow()
    assert edge.store.environments.get(farm).head == 4


def test_repeated_answer_is_refused(farm: str, alone: Make) -> None:
    edge = alone(farm)
    edge.wire.repeats = {}
    edge.mirror.run_once()
    with pytest.raises(Untrusted, match="another request"):
        edge.mirror.run_once()


@pytest.fixture(scope="module")
def stranger(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Api]:
    """Another server, with another key."""
    with running(settings_for(tmp_path_factory.mktemp("stranger"))) as api:
        yield api


def test_another_server_under_the_same_address_is_refused(centre: Api, stranger: Api, farm: str, alone: Make) -> None:
    alone(farm).follow()
    imposter = alone(farm, token=mirror_token(stranger))
    imposter.centre.url = stranger.url
    with pytest.raises(Untrusted, match="is not the centre that this server follows"):
        imposter.mirror.run_once()
    assert "not the centre" in str(imposter.store.mirrors.state().problem)  # type: ignore[union-attr]
    assert imposter.store.environments.get(farm).head == 3
    first = alone(farm, folder="other", given="0" * 16)
    with pytest.raises(Untrusted, match="0000000000000000"):
        first.mirror.run_once()


def test_rotated_key_is_followed(centre: Api, farm: str, alone: Make) -> None:
    edge = alone(farm)
    edge.follow()
    key = centre.post("keys", expect=201).json()["id"]
    edge.follow()
    described = edge.store.mirrors.describe()
    assert described is not None
    assert described["key"] == key


def set_epoch(api: Api, epoch: int) -> None:
    with api.app.state.services.store._database.write() as connection:
        connection.execute(update(tables.server).values(epoch=epoch))


def test_lower_epoch_is_refused(stranger: Api, alone: Make) -> None:
    farm = create_farm(stranger, "epochs")
    edge = alone(farm, token=mirror_token(stranger))
    edge.centre.url = stranger.url
    set_epoch(stranger, 5)
    edge.follow()
    set_epoch(stranger, 4)
    try:
        with pytest.raises(Untrusted, match="epoch 4, lower than 5"):
            edge.mirror.run_once()
    finally:
        set_epoch(stranger, 5)
    edge.follow()


def test_restored_centre_replaces_the_history_only_with_a_higher_epoch(
    stranger: Api, alone: Make, tmp_path: Path
) -> None:
    farm = create_farm(stranger, "restored")
    edge = alone(farm, token=mirror_token(stranger))
    edge.centre.url = stranger.url
    edge.follow()
    store = stranger.app.state.services.store
    with store._database.write() as connection:  # as after a restore: the last version is gone
        row = connection.execute(tables.environment.select().where(tables.environment.c.name == farm)).one()
        before = connection.execute(
            tables.version.select().where(tables.version.c.environment_id == row.id, tables.version.c.number == 2)
        ).one()
        for table, column in ((tables.source, "number"), (tables.version, "number")):
            connection.execute(table.delete().where(table.c.environment_id == row.id, table.c[column] == 3))
        events = tables.event
        connection.execute(
            events.delete().where(events.c.environment_id == row.id, events.c.sequence > before.sequence)
        )
        connection.execute(
            update(tables.environment)
            .where(tables.environment.c.id == row.id)
            .values(head=2, root=before.root, sequence=before.sequence)
        )
        connection.execute(update(tables.log).values(position=tables.log.c.position - 1))
    failures = edge.mirror.run_once().failures
    assert failures is not None
    assert "not the one mirrored before" in failures[farm]
    assert edge.store.environments.get(farm).head == 3
    stranger.post(f"environments/{farm}/overlays", {"kind": "blocked", "edge": "gate_barn", "state": "accepted"})
    set_epoch(stranger, 6)
    edge.follow()
    assert edge.store.environments.get(farm).head == 2
    assert [e.body["type"] for e in edge.store.events.page(farm)] == [
        "environment.created",
        "version.created",
        "version.created",
        "overlay.accepted",
    ]
    version, position = edge.store.channels.target(farm, "latest")
    assert (version.number, position.epoch) == (2, 6)
    assert edge.store.verifier().run().findings == []


def test_newer_form_is_refused(farm: str, alone: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    edge = alone(farm)
    monkeypatch.setattr("app.store.mirror_source.FORM", 2)
    with pytest.raises(Untrusted, match="update the older one"):
        edge.mirror.run_once()


def test_revoked_token_stops_the_mirror_until_there_is_another(centre: Api, farm: str, alone: Make) -> None:
    created = centre.post("tokens", {"name": "short", "role": "mirror"}).json()
    edge = alone(farm, token=created["token"])
    edge.follow()
    centre("DELETE", f"tokens/{created['id']}", 204)
    with pytest.raises(Unauthenticated, match="--role mirror"):
        edge.mirror.run_once()
    assert edge.store.environments.get(farm).head == 3
    alone(farm).follow()


def test_token_limits_what_is_mirrored(centre: Api, farm: str, alone: Make) -> None:
    other = create_farm(centre, f"secret-{farm}")
    edge = alone(token=mirror_token(centre, "field-*"))
    edge.follow()
    assert farm in {one.name for one in edge.store.mirror_target.environments().values()}
    assert other not in {one.name for one in edge.store.mirror_target.environments().values()}
    limited = centre.as_(mirror_token(centre, "field-*"))
    content = {"after": -1, "last": 1, "chunks": True}
    limited.problem("POST", f"environments/{other}/mirror/content", 403, json=content)
    source = centre.get(f"environments/{other}/versions/1/sources").json()[0]["sha256"]
    own = create_farm(centre, f"field-{farm}-own")
    foreign = {"after": 2, "last": 3, "blobs": [source]}
    limited.problem("POST", f"environments/{own}/mirror/content", 404, json=foreign)
    with pytest.raises(Denied):
        edge.centre.page(other, -1, 0)
    viewer = centre.token_for("viewer")
    viewer.problem("GET", f"environments/{own}/mirror?nonce={'n' * 16}", 403)


def centre_of(answer: Callable[[httpx.Request], httpx.Response]) -> Centre:
    return Centre("http://centre", "token", client=httpx.Client(transport=httpx.MockTransport(answer)))


def peak_bytes(action: Callable[[], object]) -> int:
    """Return the most memory that an action took at once."""
    tracemalloc.start()
    try:
        action()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_packed_answer_takes_no_more_memory_than_a_page_may(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.mirror.centre.MAX_PAGE_BYTES", 2**20)
    bomb = gzip.compress(bytes(2**26))
    packed = centre_of(
        lambda _: httpx.Response(200, headers={"content-encoding": "gzip"}, stream=httpx.ByteStream(bomb))
    )

    def read() -> None:
        with packed.content("farm", {}) as pieces:
            assert len(next(pieces)) <= 2**20
        with pytest.raises(Untrusted, match="more than 1048576 bytes"):
            packed.listing()

    assert peak_bytes(read) < 2**24


def test_packed_answer_is_read_whole() -> None:
    lines = [{"key": "k" * 200}] * 3000
    data = gzip.compress(json.dumps(lines).encode())
    pieces = [data[k : k + 7] for k in range(0, len(data), 7)]
    headers = {"content-encoding": "gzip"}
    assert centre_of(lambda _: httpx.Response(200, headers=headers, content=iter(pieces))).keys() == lines

    def answer(body: bytes, _: httpx.Request) -> httpx.Response:
        return httpx.Response(200, headers=headers, stream=httpx.ByteStream(body))

    for damaged in (data[:-9], b"x" + data, data[:50] + b"\0\0\0\0" + data[54:]):
        with pytest.raises(Unavailable):
            centre_of(partial(answer, damaged)).keys()


def test_large_head_of_a_file_is_not_read(farm: str, alone: Make) -> None:
    edge = alone(farm)

    def enlarged(body: bytes) -> bytes:
        return (2**30).to_bytes(4) + body[4:] if body[4:5] == b"\x95" else body  # a head is an array of five

    edge.wire.change = only("/content", enlarged)
    failures = edge.mirror.run_once().failures
    assert "sent 1073741824 bytes before a file" in failures[farm]
    edge.wire.change = None
    edge.follow()


def test_coding_that_was_not_requested_is_refused() -> None:
    with pytest.raises(Untrusted, match="'zstd', which was not requested"):
        centre_of(
            lambda _: httpx.Response(200, headers={"content-encoding": "zstd"}, stream=httpx.ByteStream(b"x"))
        ).keys()


@pytest.mark.parametrize(("end", "has_event"), [(b"", False), (b"\ndata: {}\n", True), (b"data: {}\n", False)])
def test_endless_line_of_events_takes_no_memory(end: bytes, has_event: bool) -> None:
    pieces = itertools.chain((b"x" * 2**16 for _ in range(1000)), [end])
    centre = centre_of(lambda _: httpx.Response(200, content=pieces))
    outcome: list[bool] = []
    assert peak_bytes(lambda: outcome.append(centre.wait_for_event(1))) < 2**22
    assert outcome == [has_event]


def test_event_is_found_in_pieces() -> None:
    pieces = [b": hello\n\nid: 1\nda", b"t", b"a: {}", b"\n"]
    assert centre_of(lambda _: httpx.Response(200, content=iter(pieces))).wait_for_event(1)
