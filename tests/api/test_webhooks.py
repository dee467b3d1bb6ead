"""Webhooks over HTTP and on the command line."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from app import cli
from tests.api.conftest import ADMIN, Api, running, settings_for
from tests.events.conftest import eventually
from tests.events.receiver import Receiver


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Api]:
    """A server whose webhooks may reach this machine."""
    settings = settings_for(tmp_path_factory.mktemp("hooks"), webhook_networks="127.0.0.1")
    with running(settings) as api:
        yield api


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    receiver = Receiver()
    yield receiver
    receiver.close()
    assert receiver.problems == []


def test_webhook_gets_events_and_is_listed_without_secret(site: Api, receiver: Receiver) -> None:
    answer = site.post("webhooks", {"url": receiver.url, "environments": "barn", "types": ["environment.created"]})
    assert answer.headers["cache-control"] == "no-store"
    webhook = answer.json()
    receiver.secret = webhook.pop("secret")
    assert receiver.secret.startswith("whsec_")
    site.post("environments", {"name": "barn"})
    site.post("environments", {"name": "shed"})
    eventually(lambda: receiver.sequences("barn") == [1])
    listed = eventually(lambda: (rows := site.get("webhooks").json())[0]["waiting"] == 0 and rows)
    assert [set(row) for row in listed] == [set(webhook)]
    assert receiver.secret not in json.dumps(listed)
    assert listed[0]["delivered"] is not None
    assert f'fleetmap_webhook_waiting{{webhook="{webhook["id"]}"}} 0.0' in site.get("/metrics").text
    entries = site.get("audit").json()
    assert any(entry["target"] == f"webhook {webhook['id']}" for entry in entries)
    site("DELETE", f"webhooks/{webhook['id']}", 204)
    site.problem("DELETE", f"webhooks/{webhook['id']}", 404)
    site.post("environments", {"name": "byre"})
    assert receiver.sequences("byre") == []


def test_failures_are_shown_and_a_test_tries_again(site: Api, receiver: Receiver) -> None:
    receiver.answer = lambda _, __: 503
    receiver.headers = {"retry-after": "500"}
    webhook = site.post("webhooks", {"url": receiver.url}).json()
    receiver.secret = webhook["secret"]
    site.post("environments", {"name": "mill"})
    row = eventually(lambda: (r := site.get("webhooks").json()[0])["failures"] and r)
    assert (row["error"], row["waiting"], row["refused"]) == ("the receiver answered 503", 1, [])
    assert row["failing_since"] < row["next_try"]
    failing = f'fleetmap_webhook_failing_seconds{{webhook="{webhook["id"]}"}} '
    line = next(line for line in site.get("/metrics").text.splitlines() if line.startswith(failing))
    assert float(line.removeprefix(failing)) > 0
    result = site.post(f"webhooks/{webhook['id']}/test", expect=200).json()
    assert (result["delivered"], result["status"], result["detail"]) == (False, 503, "the receiver answered 503")
    receiver.answer, receiver.headers = lambda _, __: 200, {}
    result = site.post(f"webhooks/{webhook['id']}/test", expect=200).json()
    assert (result["delivered"], result["status"], result["detail"]) == (True, 200, None)
    eventually(lambda: receiver.sequences("mill") == [1])
    assert receiver.events[0] == {"type": "webhook.test", "webhook": webhook["id"], "time": receiver.events[0]["time"]}
    site("DELETE", f"webhooks/{webhook['id']}", 204)
    site.problem("POST", f"webhooks/{webhook['id']}/test", 404)


@pytest.mark.parametrize(
    ("body", "where"),
    [
        ({"url": "https://169.254.169.254/latest/meta-data"}, "url"),
        ({"url": "https://user:password@hooks.example.org/"}, "url"),
        ({"url": "https://10.1.2.3/"}, "url"),
        ({"url": "https://hooks.example.org/", "secret": "too short"}, "secret"),
        ({"url": "https://hooks.example.org/", "types": ["version.create"]}, "types[0]"),
        ({"url": "https://hooks.example.org/", "types": []}, "types"),
        ({"url": "https://hooks.example.org/", "environments": ""}, "environments"),
        ({"url": "https://hooks.example.org/", "more": 1}, "more"),
        ({}, "url"),
    ],
)
def test_bad_webhooks_are_refused(site: Api, body: dict[str, object], where: str) -> None:
    problem = site.problem("POST", "webhooks", 422, json=body)
    assert [error["where"].removeprefix("body.") for error in problem["errors"]] == [where]
    assert site.get("webhooks").json() == []


def test_webhooks_on_the_command_line(
    site: Api, receiver: Receiver, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FLEETMAP_SERVER", site.url)
    monkeypatch.setenv("FLEETMAP_TOKEN", ADMIN)

    def run(*arguments: str, expect: int = 0) -> str:
        assert cli.run(["webhooks", *arguments]) == expect
        return capsys.readouterr().out

    added = run("add", receiver.url, "--types", "channel.moved, version.created", "--json")
    receiver.secret = json.loads(added)["secret"]
    row = json.loads(run("--json"))[0]
    assert row["types"] == ["channel.moved", "version.created"]
    assert row["id"] in run("list")
    assert "delivered: the receiver answered 204" in run("test", row["id"])
    receiver.answer = lambda _, __: 500
    assert "not delivered: the receiver answered 500" in run("test", row["id"], expect=1)
    assert run("delete", row["id"]) == f"deleted webhook {row['id']}\n"


def test_settings_name_their_networks(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"use networks such as 192\.168\.7\.0/24"):
        settings_for(tmp_path, webhook_networks="hooks.example.org")
