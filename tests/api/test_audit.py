"""Audit log, and log lines of requests."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

import pytest

from app.api.http import middleware
from app.api.http.middleware import MAX_LOGGED_REJECTIONS
from app.logs import REQUEST_ID, JsonFormatter, TextFormatter
from app.store.audit import CALLER, Caller
from app.store.store import Store
from tests.api import samples
from tests.api.conftest import ADMIN, Api


def newest(api: Api, **query: Any) -> list[dict[str, Any]]:
    entries: list[dict[str, Any]] = api.get("audit", params=query).json()
    return entries


def test_each_change_has_one_entry(api: Api) -> None:
    editor = api.token_for("editor")
    token_entry = newest(api, limit=1)[0]
    assert token_entry["path"] == "/api/v1/tokens"
    assert token_entry["token"]["name"] == "administrator"
    api.post("environments", {"name": "audited"}, headers={"X-Request-Id": "deploy-7"})
    answer = editor.upload("audited", {"a.kml": samples.KML})
    before = newest(api, environment="audited")
    assert [(e["method"], e["path"], e["token"]["name"], e["token"]["role"]) for e in before] == [
        ("POST", "/api/v1/environments/audited/versions", "a-editor", "editor"),
        ("POST", "/api/v1/environments", "administrator", "admin"),
    ]
    assert before[0]["request"] == answer.headers["x-request-id"]
    assert before[0]["address"] == "127.0.0.1"
    assert (before[1]["target"], before[1]["request"]) == ("environment audited", "deploy-7")

    api.get("environments/audited")
    editor.upload("audited", {"a.kml": b"<kml>"}, expect=422)
    editor("PATCH", "environments/audited", 403, json={"title": "no"})
    api.post("convert", expect=415)
    assert newest(api, environment="audited") == before
    assert newest(api, limit=1) == before[:1]

    again = {"Idempotency-Key": "once"}
    for _ in range(2):
        editor.upload("audited", {"b.kml": samples.KML.replace(b"</Document>", b" </Document>")}, None, headers=again)
    assert len(newest(api, environment="audited")) == 3

    api.post("keys")
    assert newest(api, limit=1)[0]["path"] == "/api/v1/keys"


def test_robot_reports_are_not_audited(api: Api) -> None:
    api.post("environments", {"name": "reported"})
    count = len(newest(api, limit=1000))
    robot = api.token_for("robot", robot="r1")
    robot(
        "PUT",
        "robots/r1/status",
        200,
        json={"environment": "reported", "state": "active", "channel": "latest", "version": 0, "root": "0" * 64},
    )
    assert len(newest(api, limit=1000)) == count + 1  # the token


def test_audit_is_paginated_and_needs_an_unlimited_administrator(api: Api) -> None:
    for role in ("viewer", "editor"):
        api.token_for(role).problem("GET", "audit", 403)
    api.token_for("admin", environments="farm-*").problem("GET", "audit", 403)
    api.problem("GET", "audit?cursor=x", 422)
    first = api.get("audit?limit=2")
    following = api.get(first.headers["link"].partition(">")[0][1:]).json()
    assert [e["id"] for e in (*first.json(), *following)][:4] == [e["id"] for e in newest(api, limit=4)]


def test_entry_and_change_are_one_transaction(tmp_path: Path) -> None:
    store = Store(f"sqlite:///{tmp_path / 'a.sqlite'}", tmp_path / "blobs")
    store.migrate()
    caller = Caller("id", "name", "admin", "10.0.0.1", "r", "POST", "/x", None)
    reset = CALLER.set(caller)
    try:
        with pytest.raises(ZeroDivisionError), store._database.write():
            raise ZeroDivisionError
        assert store.audit.page() == []
        assert not caller.recorded
        store.environments.create("a")
        store.environments.create("b")  # of the same request
    finally:
        CALLER.reset(reset)
    store.environments.create("c")  # of the server itself
    assert [(e.token, e.address) for e in store.audit.page()] == [("name", "10.0.0.1")]
    store.close()


def test_log_names_changes_and_refused_tokens_but_no_token(
    api: Api, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        middleware, "_rejections", middleware._Quota()
    )  # other tests of this process caused refusals, too
    with caplog.at_level(logging.INFO, logger="app.requests"):
        api.post("environments", {"name": "logged"})
        api.as_("not-a-token-that-anybody-has").problem("GET", "environments/a%0Ab", 401)
        api.get("environments/logged")
    records = [r for r in caplog.records if r.name == "app.requests"]
    assert [r.levelname for r in records] == ["INFO", "WARNING"]
    assert "POST /api/v1/environments 201" in records[0].getMessage()
    assert "administrator (admin), 127.0.0.1" in records[0].getMessage()
    assert "unknown or expired token" in records[1].getMessage()
    assert ADMIN not in caplog.text
    assert "not-a-token" not in caplog.text
    line = TextFormatter().format(records[1])
    assert line.count("\n") == 0
    assert "a\\nb" in line


def test_log_limits_refusals_per_source(api: Api, caplog: pytest.LogCaptureFixture) -> None:
    anonymous = api.as_(None)
    with caplog.at_level(logging.INFO, logger="app.requests"):
        for _ in range(MAX_LOGGED_REJECTIONS + 10):
            anonymous("GET", "environments/" + "x" * 3000)
    lines = [r.getMessage() for r in caplog.records if r.name == "app.requests"]
    assert len(lines) <= MAX_LOGGED_REJECTIONS
    assert all(len(line) < 600 for line in lines)


def test_log_as_json_has_the_fields_of_a_request() -> None:
    record = logging.LogRecord("app.x", logging.INFO, "", 0, "it %s", ("works",), None)
    record.fields = {"status": 201, "ms": 1.5}
    reset = REQUEST_ID.set("abc")
    try:
        entry = json.loads(JsonFormatter().format(record))
    finally:
        REQUEST_ID.reset(reset)
    assert entry | {"time": ""} == {
        "time": "",
        "level": "info",
        "logger": "app.x",
        "message": "it works",
        "request": "abc",
        "status": 201,
        "ms": 1.5,
    }
    assert entry["time"].endswith("Z")
