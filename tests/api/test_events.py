"""Server-sent events."""

from __future__ import annotations

import itertools
import json
import threading
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest

from tests.api import samples
from tests.api.conftest import API, Api


def stream(api: Api, **query: Any) -> Iterator[tuple[int, str, dict[str, Any]]]:
    headers = query.pop("headers", {})
    with api.http.stream("GET", f"{API}/events", params=query, headers=headers, timeout=60) as answer:
        assert answer.status_code == 200, answer.read()
        assert answer.headers["content-type"].startswith("text/event-stream")
        fields: dict[str, str] = {}
        for line in answer.iter_lines():
            if not line and "data" in fields:
                yield int(fields["id"]), fields["event"], json.loads(fields["data"])
                fields = {}
            elif not line.startswith(":"):
                name, _, value = line.partition(": ")
                fields[name] = value


def test_stream_sends_stored_and_new_events(api: Api, bare: str) -> None:
    api.upload(bare, {"n.tmap2.yaml": samples.tmap2()})
    seen = list(stream(api, environment=bare, since=0, follow="false"))
    assert [(n, kind) for n, kind, _ in seen] == [(1, "environment.created"), (2, "version.created")]
    assert seen[1][2]["sequence"] == 2
    following = stream(api, environment=bare, headers={"last-event-id": "2"})
    threading.Timer(0.3, lambda: api.upload(bare, samples.grid())).start()
    number, kind, body = next(following)
    assert (number, kind, body["version"]) == (3, "version.created", 2)
    following.close()


def test_stream_without_events_can_be_resumed(api: Api, bare: str) -> None:
    with api.http.stream("GET", f"{API}/events", params={"environment": bare}, timeout=60) as answer:
        beginning = list(itertools.takewhile(bool, answer.iter_lines()))
    assert "id: 1" in beginning, "the environment's creation"
    api.upload(bare, {"n.tmap2.yaml": samples.tmap2()})
    seen = list(stream(api, environment=bare, headers={"last-event-id": "1"}, follow="false"))
    assert [(n, kind) for n, kind, _ in seen] == [(2, "version.created")]


def test_stream_covers_all_environments_of_a_token(api: Api, fresh: Any) -> None:
    ours, theirs = fresh(), fresh()
    for name in (ours, theirs):
        api.post("environments", {"name": name})
    token = api.post("tokens", {"name": "seer", "role": "viewer", "environments": ours}).json()["token"]
    names = {body["environment"] for _, _, body in stream(api.as_(token), since=0, follow="false")}
    assert names == {ours}
    assert api.as_(token).get(f"events?environment={theirs}&follow=false", expect=None).status_code == 403


def test_rename_and_purge_are_sent_under_the_old_name(api: Api, fresh: Any) -> None:
    """Streams of a renamed or purged environment get that event; events under its new name need access to it."""
    old, new = fresh(), fresh()
    api.post("environments", {"name": old})
    local = api.token_for("viewer", environments=old)
    following = stream(local, environment=old, since=0)
    assert next(following)[1] == "environment.created"
    api("PATCH", f"environments/{old}", 200, json={"name": new})
    number, kind, body = next(following)
    assert (number, kind, body["environment"]) == (2, "environment.deleted", old)
    assert list(following) == [], "the stream ends"
    assert new not in json.dumps(body)
    again = list(stream(local, environment=old, headers={"last-event-id": "1"}))
    assert [body for _, _, body in again] == [body]
    assert local.get(f"events?environment={old}&since=2", expect=None).status_code == 404
    everything = stream(local, since=0, follow="false")
    assert {b["environment"] for _, _, b in everything} == {old}
    other = api.token_for("viewer", environments=new)
    assert [(n, b["environment"]) for n, _, b in stream(other, environment=new, since=0, follow="false")] == [(3, new)]
    api("DELETE", f"environments/{new}", 204)
    api.post(f"environments/{new}/purge", expect=204)
    events = list(stream(api, environment=new, since=3, follow="false"))
    assert [(n, kind) for n, kind, _ in events] == [(4, "environment.deleted")]
    api.post("environments", {"name": new})
    events = list(stream(api, environment=new, headers={"last-event-id": "4"}, follow="false"))
    assert [(n, kind) for n, kind, _ in events] == [(5, "environment.created")]


def test_stream_ends_with_its_token(api: Api, bare: str) -> None:
    token = api.post("tokens", {"name": "seer", "role": "viewer"}).json()
    following = stream(api.as_(token["token"]), environment=bare, since=0)
    assert next(following)[1] == "environment.created"
    api("DELETE", f"tokens/{token['id']}", 204)
    api.upload(bare, samples.grid())
    assert list(following) == []
    soon = (datetime.now(UTC) + timedelta(seconds=1)).isoformat()
    brief = api.post("tokens", {"name": "guest", "role": "viewer", "expires": soon}).json()
    assert [kind for _, kind, _ in stream(api.as_(brief["token"]), environment=bare, since=1)] == ["version.created"]


def test_streams_at_one_position_share_reads(api: Api, bare: str, monkeypatch: pytest.MonkeyPatch) -> None:
    events = type(api.app.state.services.store.events)
    reads, quick = [], events.page

    def counted(self: Any, environment: Any, since: int = 0, limit: int = 1000) -> Any:
        reads.append((environment, since))
        return quick(self, environment, since, limit)

    count = 30
    begun, versions = threading.Barrier(count + 1), []

    def follow(client: Api) -> None:
        following = stream(client, environment=bare, since=0)
        next(following)
        begun.wait(60)
        versions.append(next(following)[2]["version"])

    threads = [threading.Thread(target=follow, args=(api.as_(api.token),)) for _ in range(count)]
    for thread in threads:
        thread.start()
    begun.wait(60)
    monkeypatch.setattr(events, "page", counted)
    api.upload(bare, samples.grid())
    for thread in threads:
        thread.join(60)
    assert versions == [1] * count
    assert reads.count((bare, 1)) < count / 2


def test_invalid_streams_are_refused(api: Api, bare: str) -> None:
    assert api.get("events?environment=nowhere&follow=false", expect=None).status_code == 404
    bad = api.get(f"events?environment={bare}", expect=None, headers={"last-event-id": "x"})
    assert bad.status_code == 422
    assert api.get("events?since=-1", expect=None).status_code == 422
    head = api("HEAD", f"events?environment={bare}", 200)
    assert (head.headers["content-type"], head.content) == ("text/event-stream; charset=utf-8", b"")
    api.get("/healthz", timeout=60)  # on the same connection
    for query in (f"environment={bare}&since=2", f"since={10**9}"):
        assert "is beyond the event log" in api.problem("GET", f"events?{query}&follow=false", 422)["detail"]
