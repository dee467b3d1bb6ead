"""Server-sent events."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from typing import Any

from tests.api import samples
from tests.api.conftest import API, Api


def stream(api: Api, **query: Any) -> Iterator[tuple[int, str, dict[str, Any]]]:
    headers = query.pop("headers", {})
    with api.http.stream("GET", f"{API}/events", params=query, headers=headers, timeout=30) as answer:
        assert answer.status_code == 200, answer.read()
        assert answer.headers["content-type"].startswith("text/event-stream")
        told: dict[str, str] = {}
        for line in answer.iter_lines():
            if not line and "data" in told:
                yield int(told["id"]), told["event"], json.loads(told["data"])
                told = {}
            elif not line.startswith(":"):
                name, _, value = line.partition(": ")
                told[name] = value


def test_what_happened_and_what_happens(api: Api, bare: str) -> None:
    api.upload(bare, {"n.tmap2.yaml": samples.tmap2()})
    seen = list(stream(api, environment=bare, since=0, follow="false"))
    assert [(n, kind) for n, kind, _ in seen] == [(1, "environment.created"), (2, "version.created")]
    assert seen[1][2]["sequence"] == 2
    following = stream(api, environment=bare, headers={"last-event-id": "2"})
    threading.Timer(0.3, lambda: api.upload(bare, samples.grid())).start()
    number, kind, body = next(following)
    assert (number, kind, body["version"]) == (3, "version.created", 2)
    following.close()


def test_all_environments_of_a_token(api: Api, fresh: Any) -> None:
    ours, theirs = fresh(), fresh()
    for name in (ours, theirs):
        api.post("environments", {"name": name})
    token = api.post("tokens", {"name": "seer", "role": "viewer", "environments": ours}).json()["token"]
    names = {body["environment"] for _, _, body in stream(api.as_(token), since=0, follow="false")}
    assert names == {ours}
    assert api.as_(token).get(f"events?environment={theirs}&follow=false", expect=None).status_code == 403


def test_refusals(api: Api, bare: str) -> None:
    assert api.get("events?environment=nowhere&follow=false", expect=None).status_code == 404
    bad = api.get(f"events?environment={bare}", expect=None, headers={"last-event-id": "x"})
    assert bad.status_code == 422
    assert api.get("events?since=-1", expect=None).status_code == 422
