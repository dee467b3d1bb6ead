"""A real agent process over HTTPS and TLS, with a password of its own."""

from __future__ import annotations

import os
import ssl
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from app.agent.agent import Agent, AgentOptions
from app.errors import Invalid
from app.events.credentials import ZenohCredentials
from tests.agent.conftest import ROOT, Robot, network
from tests.api.conftest import ADMIN, Api, running, settings_for
from tests.certificates import Authority
from tests.events.conftest import eventually
from tests.events.test_fleet import robot_of
from tests.ports import free_port
from tests.preloaded import run_preloaded


@pytest.fixture(scope="module")
def authority(tmp_path_factory: pytest.TempPathFactory) -> Authority:
    return Authority(tmp_path_factory.mktemp("certificates"))


@pytest.fixture(scope="module")
def secure(tmp_path_factory: pytest.TempPathFactory, authority: Authority) -> Iterator[Api]:
    folder = tmp_path_factory.mktemp("secure")
    users = folder / "users"
    users.write_text("tractor:of the tractor\n")
    certificate, key = authority.sign("server")
    settings = settings_for(
        folder / "data",
        tls_certificate=certificate,
        tls_key=key,
        zenoh_mode="router",
        zenoh_listen=f"tls/127.0.0.1:{free_port()}",
        zenoh_certificate=certificate,
        zenoh_key=key,
        zenoh_ca=authority.pem,
        zenoh_mtls=True,
        zenoh_users=users,
    )
    with running(settings, ssl.create_default_context(cafile=authority.pem)) as api:
        eventually(lambda: api.get("/readyz").json()["events"]["state"] == "connected")
        yield api


def place(api: Api, name: str) -> str:
    api.post("environments", {"name": name})
    api.upload(name, {"n.tmap2.yaml": network(count=20)})
    return name


def test_agent_follows_over_tls(secure: Api, authority: Authority, tmp_path: Path) -> None:
    env = place(secure, "farm")
    certificate, key = authority.sign("tractor")
    variables = {
        "FLEETMAP_CA": str(authority.pem),
        "FLEETMAP_ZENOH_CA": str(authority.pem),
        "FLEETMAP_ZENOH_CERTIFICATE": str(certificate),
        "FLEETMAP_ZENOH_KEY": str(key),
        "FLEETMAP_ZENOH_PASSWORD": "of the tractor",
    }
    one = Robot(secure.url, env, tmp_path / "tractor", "--poll", "3600", **variables)
    try:
        one.wait("active", version=1)
        one.wait("connected")
        secure.upload(env, {"n.tmap2.yaml": network(0.25, count=20)})
        one.wait("active", version=2)
        assert one.standing["version"] == 2
        assert eventually(lambda: (r := robot_of(secure, "tractor")) and r["online"] and r["version"] == 2)
        assert one.stop() == 0
    finally:
        one.kill()
    assert not [line for line in one.lines if "user tractor" in str(line)]


def test_agent_with_wrong_password_still_polls(secure: Api, authority: Authority, tmp_path: Path) -> None:
    env = place(secure, "field")
    certificate, key = authority.sign("stranger")
    one = Robot(
        secure.url, env, tmp_path / "plough", "--poll", "0.5", "--ca", str(authority.pem), "--zenoh-ca",
        str(authority.pem), "--zenoh-certificate", str(certificate), "--zenoh-key", str(key), "--zenoh-user", "tractor",
        FLEETMAP_ZENOH_PASSWORD="guessed",
    )  # fmt: skip
    try:
        one.wait("active", version=1)
        secure.upload(env, {"n.tmap2.yaml": network(0.5, count=20)})
        one.wait("active", version=2)
        assert one.saw("connected") is None
        assert "use --robot tractor" in one.wait("user")["detail"]
        assert eventually(lambda: (r := robot_of(secure, "plough")) and r["version"] == 2), "over HTTPS"
        assert one.stop() == 0
    finally:
        one.kill()


def test_agent_trusts_no_other_authority(secure: Api, tmp_path: Path) -> None:
    env = place(secure, "wood")
    other = Authority(tmp_path / "others")
    for more in ((), ("--ca", str(other.pem))):
        one = Robot(secure.url, env, tmp_path / "robot", "--once", *more)
        try:
            assert one.end() == 1
        finally:
            one.kill()
        assert "certificate" in str(one.lines).lower()
        assert not (tmp_path / "robot" / "current").exists()


def test_agent_checks_credentials_before_start(authority: Authority, tmp_path: Path) -> None:
    missing_file = tmp_path / "gone.pem"
    key = tmp_path / "no.pem"
    key.write_text("no certificate")
    cases: list[tuple[dict[str, Any], str]] = [
        ({"ca": missing_file}, "gone.pem"),
        ({"ca": key}, "not a certificate of a certification authority"),
        ({"zenoh_login": ZenohCredentials(ca=missing_file)}, "could not read"),
        ({"zenoh_login": ZenohCredentials(certificate=authority.pem)}, "certificate and key must be set together"),
        ({"zenoh_login": ZenohCredentials(user="tractor")}, "user and password must be set together"),
    ]
    for more, reason in cases:
        with pytest.raises(Invalid, match=reason):
            Agent(
                AgentOptions("https://127.0.0.1:1", "farm", ("tmap2",), tmp_path / "robot", **more),
                lambda *_, **__: None,
            )


def test_command_line_uses_https(secure: Api, authority: Authority) -> None:
    clean = {k: v for k, v in os.environ.items() if not k.startswith("FLEETMAP_")}
    variables = {**clean, "FLEETMAP_SERVER": secure.url, "FLEETMAP_TOKEN": ADMIN}
    for more, status in (({"FLEETMAP_CA": str(authority.pem)}, 0), ({}, 1)):
        process = run_preloaded(["versions", "--json"], env={**variables, **more}, cwd=ROOT)
        assert process.returncode == status, process.stdout
