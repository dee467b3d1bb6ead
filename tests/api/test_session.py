"""Sessions of browsers: sign in, cookies, forged requests, anonymous readers."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import httpx
import pytest

from app.api.http.auth import SESSION_COOKIE, Credentials
from tests.api import samples
from tests.api.conftest import ADMIN, API, Api, problem, running, settings_for
from tests.certificates import Authority
from tests.events.conftest import eventually

SIGN_IN = f"{API}/session"
MEMBERS = {"name", "role", "environments", "robot", "expires"}


class Browser:
    """Client that keeps cookies and, like a browser, sends Origin with changes of the server's own page."""

    def __init__(self, api: Api, verify: Any = False) -> None:
        self.http = httpx.Client(base_url=api.url, timeout=60.0, verify=verify)
        self.origin = {"origin": api.url}

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *_: object) -> None:
        self.http.close()

    def sign_in(self, **body: str) -> httpx.Response:
        answer = self.http.post(SIGN_IN, json=body, headers=self.origin)
        assert answer.status_code == 201, answer.text
        return answer

    @property
    def secret(self) -> str:
        return str(self.http.cookies[SESSION_COOKIE])


@pytest.fixture
def browser(api: Api) -> Iterator[Browser]:
    with Browser(api) as browser:
        yield browser


def new_token(api: Api, role: str, **more: Any) -> dict[str, Any]:
    made: dict[str, Any] = api.post("tokens", {"name": f"a-{role}", "role": role, **more}).json()
    return made


@pytest.mark.parametrize("role", ["viewer", "robot", "editor", "admin"])
def test_session_has_the_rights_of_its_token(api: Api, browser: Browser, bare: str, role: str) -> None:
    more = {"robot": "r1"} if role == "robot" else {}
    token = new_token(api, role, environments=bare, **more)
    answer = browser.sign_in(token=token["token"])
    body = answer.json()
    assert set(body) == MEMBERS
    assert (body["name"], body["role"], body["environments"]) == (f"a-{role}", role, bare)
    assert body["robot"] == ("r1" if role == "robot" else None)
    ends = datetime.fromisoformat(body["expires"]) - datetime.now(UTC)
    assert timedelta(hours=11, minutes=55) < ends <= timedelta(hours=12)
    assert answer.headers["cache-control"] == "no-store"
    cookie = answer.headers["set-cookie"]
    assert {part.strip().lower() for part in cookie.split(";")[1:]} == {"httponly", "samesite=strict", "path=/"}
    assert token["token"] not in cookie
    assert browser.http.get(SIGN_IN).json() == body
    assert [e["name"] for e in browser.http.get(f"{API}/environments").json()] == [bare]
    changed = browser.http.post(
        f"{API}/environments/{bare}/edits", json={"changes": []}, headers=browser.origin
    ).status_code
    assert (changed == 403) == (role in ("viewer", "robot"))
    assert browser.http.get(f"{API}/environments/elsewhere").status_code == 403
    assert browser.http.delete(f"{API}/environments/{bare}", headers=browser.origin).status_code == (
        204 if role == "admin" else 403
    )


def test_session_of_a_token_answers_also_to_the_token(api: Api) -> None:
    soon = datetime.now(UTC).replace(microsecond=0) + timedelta(hours=2)
    token = new_token(api, "viewer", expires=soon.isoformat())
    body = api.as_(token["token"]).get("session").json()
    assert body == {
        "name": "a-viewer",
        "role": "viewer",
        "environments": None,
        "robot": None,
        "expires": body["expires"],
    }
    assert datetime.fromisoformat(body["expires"]) == soon
    with Browser(api) as browser:
        assert datetime.fromisoformat(browser.sign_in(token=token["token"]).json()["expires"]) == soon
    assert api.get("session").json()["expires"] is None
    api.as_(None).problem("GET", "session", 401)


def test_sign_out_ends_session_and_clears_cookie(api: Api, browser: Browser) -> None:
    browser.sign_in(token=new_token(api, "viewer")["token"])
    secret = browser.secret
    assert browser.http.get(f"{API}/formats").status_code == 200
    foreign = browser.http.delete(SIGN_IN, headers={"origin": "http://evil.example"})
    assert problem(foreign)["status"] == 403
    assert browser.http.get(SIGN_IN).status_code == 200
    answer = browser.http.delete(SIGN_IN, headers=browser.origin)
    assert (answer.status_code, answer.content) == (204, b"")
    assert "Max-Age=0" in answer.headers["set-cookie"]
    assert SESSION_COOKIE not in browser.http.cookies
    stolen = browser.http.get(f"{API}/formats", headers={"cookie": f"{SESSION_COOKIE}={secret}"})
    assert "sign in again" in problem(stolen)["detail"]
    assert stolen.status_code == 401
    assert browser.http.delete(SIGN_IN, headers=browser.origin).status_code == 204, "nobody is signed in"


def test_second_sign_in_ends_the_first_session(api: Api, browser: Browser) -> None:
    token = new_token(api, "viewer")["token"]
    browser.sign_in(token=token)
    first = browser.secret
    browser.sign_in(token=token)
    assert browser.secret != first
    assert browser.http.get(SIGN_IN).status_code == 200
    with Browser(api) as other:
        assert other.http.get(SIGN_IN, headers={"cookie": f"{SESSION_COOKIE}={first}"}).status_code == 401


@pytest.mark.parametrize(
    ("headers", "allowed"),
    [
        ({}, False),
        ({"origin": "null"}, False),
        ({"origin": "http://evil.example"}, False),
        ({"origin": "https://{host}"}, False),
        ({"origin": "http://127.0.0.1"}, False),
        ({"origin": "http://{host}.evil.example"}, False),
        ({"origin": "http://evil@{host}"}, False),
        ({"origin": "http://evil.example", "sec-fetch-site": "same-origin"}, False),
        ({"sec-fetch-site": "same-site"}, False),
        ({"sec-fetch-site": "cross-site"}, False),
        ({"sec-fetch-site": "same-origin"}, True),
        ({"origin": "http://{host}"}, True),
    ],
)
def test_change_by_cookie_needs_same_origin(
    api: Api, browser: Browser, bare: str, headers: dict[str, str], allowed: bool
) -> None:
    browser.sign_in(token=ADMIN)
    host = api.url.removeprefix("http://")
    sent = {name: value.replace("{host}", host) for name, value in headers.items()}
    for method, path, body in (
        ("PATCH", f"environments/{bare}", {"title": "changed"}),
        ("POST", f"environments/{bare}/edits", {"changes": []}),
        ("PUT", f"environments/{bare}/channels/staging", {"version": 0}),
        ("DELETE", f"environments/{bare}", None),
    ):
        answer = browser.http.request(method, f"{API}/{path}", json=body, headers=sent)
        if allowed:
            assert answer.status_code != 403, answer.text
        else:
            assert answer.status_code == 403
            assert "origin" in problem(answer)["detail"].lower() or "another site" in problem(answer)["detail"]
    assert (api.get(f"environments/{bare}", None).status_code == 404) == allowed
    assert browser.http.get(f"{API}/formats", headers={"origin": "http://evil.example"}).status_code == 200


def test_token_wins_over_cookie(api: Api, browser: Browser, bare: str) -> None:
    browser.sign_in(token=new_token(api, "viewer")["token"])
    bearer = {"authorization": f"Bearer {ADMIN}"}
    assert browser.http.get(SIGN_IN, headers=bearer).json()["role"] == "admin"
    changed = browser.http.patch(f"{API}/environments/{bare}", json={"title": "x"}, headers=bearer)
    assert changed.status_code == 200, "a token needs no Origin"
    assert browser.http.get(SIGN_IN, headers={"authorization": "Bearer wrong"}).status_code == 401


def test_sign_in_from_another_site_is_refused(api: Api, browser: Browser) -> None:
    foreign = browser.http.post(SIGN_IN, json={"token": ADMIN}, headers={"origin": "http://evil.example"})
    assert problem(foreign)["status"] == 403
    assert "set-cookie" not in foreign.headers
    assert browser.http.post(SIGN_IN, json={"token": ADMIN}).status_code == 201, "a script sends no Origin"


@pytest.mark.parametrize(
    ("body", "status"),
    [
        ({}, 422),
        ({"token": ADMIN, "code": "x"}, 422),
        ({"token": ""}, 422),
        ({"token": ADMIN, "remember": True}, 422),
        ({"token": "x" * 513}, 422),
        ({"token": "x" * 5000}, 413),
        ({"code": "x" * 22}, 401),
        ({"token": "wrong"}, 401),
    ],
)
def test_invalid_sign_in_is_refused(api: Api, browser: Browser, body: Any, status: int) -> None:
    answer = browser.http.post(SIGN_IN, json=body)
    assert problem(answer)["status"] == status
    assert "set-cookie" not in answer.headers
    assert ADMIN not in answer.text


def test_form_of_another_site_cannot_sign_in(api: Api, browser: Browser) -> None:
    for media in ("text/plain", "application/x-www-form-urlencoded", "multipart/form-data; boundary=x"):
        answer = browser.http.post(SIGN_IN, content=f'{{"token": "{ADMIN}"}}', headers={"content-type": media})
        assert answer.status_code == 415


def test_wrong_sign_ins_are_throttled_and_valid_ones_accepted(tmp_path: Path) -> None:
    with running(settings_for(tmp_path, token_failures=3)) as api, Browser(api) as browser:
        for body in ({"token": "wrong"}, {"code": "wrong"}, {"token": "wrong"}):
            assert browser.http.post(SIGN_IN, json=body).status_code == 401
        answer = browser.http.post(SIGN_IN, json={"code": "wrong"})
        assert problem(answer)["status"] == 429
        assert answer.headers["retry-after"] == "60"
        browser.sign_in(token=ADMIN)
        ended = {"cookie": f"{SESSION_COOKIE}={'x' * 43}"}
        statuses = {httpx.get(f"{api.url}{SIGN_IN}", headers=ended).status_code for _ in range(5)}
        assert statuses == {401}, "an open page sends an ended session again"


def test_sign_in_code_of_an_administrator(api: Api, browser: Browser) -> None:
    token = new_token(api, "editor")
    made = api.post(f"tokens/{token['id']}/sign-in-code").json()
    assert set(made) == {"code", "path", "expires"}
    assert made["path"] == f"/#sign-in={made['code']}"
    assert browser.sign_in(code=made["code"]).json()["name"] == "a-editor"
    again = browser.http.post(SIGN_IN, json={"code": made["code"]})
    assert problem(again)["status"] == 401
    api.problem("POST", "tokens/nosuch/sign-in-code", 404)
    entry = api.get("audit?limit=5").json()[0]
    assert entry["path"] == f"/api/v1/tokens/{token['id']}/sign-in-code"
    assert made["code"] not in api.get("audit").text


def test_changes_by_session_are_logged_under_the_token(api: Api, browser: Browser, bare: str) -> None:
    token = new_token(api, "editor")
    browser.sign_in(token=token["token"])
    edit = {"op": "put", "layer": "topology", "feature": samples_node("n1")}
    body = {"changes": [edit], "message": "by hand"}
    made = browser.http.post(f"{API}/environments/{bare}/edits", json=body, headers=browser.origin)
    assert made.json()["author"] == "a-editor"
    assert api.get(f"audit?environment={bare}&limit=1").json()[0]["token"]["id"] == token["id"]


def samples_node(name: str) -> dict[str, Any]:
    place = {"type": "Point", "coordinates": [2.0, 1.0]}
    return {"type": "Feature", "id": name, "geometry": None, "place": place, "properties": {"kind": "node"}}


def memory_hits(api: Api) -> float:
    lines = api.get("/metrics").text.splitlines()
    return sum(float(line.split()[1]) for line in lines if line.startswith('fleetmap_cache_hits_total{cache="memory"}'))


def test_cached_map_is_not_served_after_the_end_of_a_session(api: Api, browser: Browser, farm: str) -> None:
    path = f"/maps/{farm}/tmap2"
    for end in ("sign out", "revocation"):
        token = new_token(api, "viewer")
        browser.sign_in(token=token["token"])
        first = browser.http.get(path)
        assert browser.http.get(path, headers={"if-none-match": first.headers["etag"]}).status_code == 304
        before = memory_hits(api)
        for _ in range(50):
            assert browser.http.get(path).status_code == 200
        assert memory_hits(api) > before
        cookie = {"cookie": f"{SESSION_COOKIE}={browser.secret}"}
        if end == "sign out":
            browser.http.delete(SIGN_IN, headers=browser.origin)
        else:
            api("DELETE", f"tokens/{token['id']}", 204)
        assert httpx.get(api.url + path, headers=cookie).status_code == 401
        browser.http.cookies.clear()


def test_stream_by_cookie_ends_with_its_session(api: Api, browser: Browser, bare: str) -> None:
    browser.sign_in(token=new_token(api, "viewer")["token"])
    with browser.http.stream("GET", f"{API}/events?environment={bare}&since=0") as answer:
        assert answer.status_code == 200
        lines = answer.iter_lines()
        assert next(line for line in lines if line.startswith("event:")) == "event: environment.created"
        with Browser(api) as other:
            other.http.cookies = browser.http.cookies
            assert other.http.delete(SIGN_IN, headers=other.origin).status_code == 204
        api.upload(bare, samples.grid())
        assert not any(line.startswith("event:") for line in lines)


def test_idle_session_ends(api: Api, browser: Browser, monkeypatch: pytest.MonkeyPatch) -> None:
    browser.sign_in(token=new_token(api, "viewer")["token"])
    assert browser.http.get(SIGN_IN).status_code == 200
    database = api.app.state.services.store.sessions._database
    later = database.now() + timedelta(hours=12, seconds=1)
    monkeypatch.setattr(database, "now", lambda: later)
    api.app.state.services.access.invalidate()
    assert browser.http.get(SIGN_IN).status_code == 401


def test_session_survives_restart_and_is_shared_by_processes(tmp_path: Path) -> None:
    settings = settings_for(tmp_path)
    with running(settings) as api, Browser(api) as browser:
        token = new_token(api, "viewer")
        secret = browser.sign_in(token=token["token"]) and browser.secret
        cookie = {"cookie": f"{SESSION_COOKIE}={secret}"}
        code = api.post(f"tokens/{token['id']}/sign-in-code").json()["code"]
        with running(settings) as second:
            assert httpx.get(second.url + SIGN_IN, headers=cookie).json()["name"] == "a-viewer"
            assert httpx.post(second.url + SIGN_IN, json={"code": code}).status_code == 201
            assert httpx.post(api.url + SIGN_IN, json={"code": code}).status_code == 401
            assert httpx.get(api.url + SIGN_IN, headers=cookie).status_code == 200
            signed_out = httpx.delete(second.url + SIGN_IN, headers={**cookie, "origin": second.url})
            assert signed_out.status_code == 204
            assert httpx.get(second.url + SIGN_IN, headers=cookie).status_code == 401
            eventually(lambda: httpx.get(api.url + SIGN_IN, headers=cookie).status_code == 401, 10)
        secret = browser.sign_in(token=token["token"]) and browser.secret
    with running(settings) as api:
        answer = httpx.get(api.url + SIGN_IN, headers={"cookie": f"a=b; {SESSION_COOKIE}={secret}; c=d"})
        assert answer.json()["name"] == "a-viewer"


def test_cookie_is_secure_over_https_and_behind_a_trusted_proxy(api: Api, tmp_path: Path) -> None:
    host = api.url.removeprefix("http://")
    proxied = {"x-forwarded-proto": "https", "x-forwarded-for": "10.1.2.3", "origin": f"https://{host}"}
    answer = httpx.post(api.url + SIGN_IN, json={"token": ADMIN}, headers=proxied)
    assert answer.status_code == 201, answer.text
    assert "; Secure" in answer.headers["set-cookie"]
    plain = {**proxied, "origin": api.url}
    assert httpx.post(api.url + SIGN_IN, json={"token": ADMIN}, headers=plain).status_code == 403
    authority = Authority(tmp_path)
    certificate, key = authority.sign("server")
    settings = settings_for(tmp_path / "data", tls_certificate=certificate, tls_key=key)
    with running(settings) as secure, Browser(secure) as browser:
        assert "; Secure" in browser.sign_in(token=ADMIN).headers["set-cookie"]
        made = browser.http.post(f"{API}/environments", json={"name": "farm"}, headers=browser.origin)
        assert made.status_code == 201


def test_without_access_control_everyone_is_administrator(tmp_path: Path) -> None:
    with running(settings_for(tmp_path, admin_token=None, insecure_no_auth=True)) as api:
        anonymous = api.as_(None)
        body = anonymous.get("session").json()
        assert body == {"name": "anonymous", "role": "admin", "environments": None, "robot": None, "expires": None}
        anonymous.problem("POST", "session", 409, json={"token": "any"})


def test_anonymous_networks_read_without_token(tmp_path: Path) -> None:
    settings = settings_for(tmp_path, anonymous_networks="10.0.0.0/8, 127.0.0.1")
    with running(settings) as api, Browser(api) as browser:
        api.post("environments", {"name": "farm"})
        api.upload("farm", {"n.tmap2.yaml": samples.tmap2()})
        anonymous = api.as_(None)
        body = anonymous.get("session").json()
        assert body == {"name": "anonymous", "role": "viewer", "environments": None, "robot": None, "expires": None}
        for _ in range(3):
            assert anonymous.get("/maps/farm/tmap2").status_code == 200
        anonymous.problem("GET", "tokens", 403)
        anonymous.problem("PATCH", "environments/farm", 401, json={"title": "x"})
        anonymous.problem("POST", "environments/farm/versions/1/links", 401, json={"format": "tmap2"})
        assert browser.sign_in(token=ADMIN).json()["role"] == "admin"
        wrong = {"authorization": "Bearer wrong"}
        assert anonymous("GET", "session", headers=wrong).status_code == 401, "it has credentials"
        ended = {"cookie": f"{SESSION_COOKIE}={'x' * 43}"}
        assert anonymous("GET", "session", 200, headers=ended).json()["name"] == "anonymous"
        # The test's client counts as a trusted proxy, so X-Forwarded-For is the client.
        for address, status in (("192.168.1.9", 401), ("10.3.4.5", 200), ("10.3.4.5, 192.168.1.9", 401)):
            forwarded = {"x-forwarded-for": address}
            assert anonymous("GET", "formats", headers=forwarded).status_code == status, address
            assert anonymous("GET", "/maps/farm/tmap2", headers=forwarded).status_code == status, address


def test_untrusted_client_cannot_forge_its_address(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FORWARDED_ALLOW_IPS", "10.9.9.9")
    with running(settings_for(tmp_path, anonymous_networks="10.1.1.0/24")) as api:
        for name in ("x-forwarded-for", "x-real-ip", "forwarded"):
            assert api.as_(None)("GET", "formats", headers={name: "10.1.1.5"}).status_code == 401


@pytest.mark.parametrize("networks", ["10.0.0.1/8", "farm", "10.0.0.0/40"])
def test_invalid_networks_are_refused(tmp_path: Path, networks: str) -> None:
    with pytest.raises(ValueError, match="use networks such as"):
        settings_for(tmp_path, anonymous_networks=networks)


@pytest.mark.parametrize(
    ("cookie", "session"),
    [
        (b"fleetmap_session=abc", b"abc"),
        (b"a=b; fleetmap_session=abc; c=d", b"abc"),
        (b"a=fleetmap_session=abc", None),
        (b"my_fleetmap_session=abc", None),
        (b"fleetmap_session=", None),
        (b"fleetmap_session=a b", None),
        (b"fleetmap_session=" + b"x" * 129, None),
    ],
)
def test_cookie_header_is_parsed(cookie: bytes, session: bytes | None) -> None:
    scope = {"type": "http", "path": f"{API}/formats"}
    assert Credentials.from_headers(None, cookie, scope).session == session
    assert Credentials.from_headers(b"Bearer x", cookie, scope).session is None


def test_many_requests_of_one_session_look_it_up_once(api: Api, browser: Browser, monkeypatch: Any) -> None:
    browser.sign_in(token=new_token(api, "viewer")["token"])
    lookups, access = [], api.app.state.services.access
    find = access._find_session
    monkeypatch.setattr(access, "_find_session", lambda secret: (lookups.append(secret), find(secret))[1])
    monkeypatch.setattr(access, "_clock", lambda: 1000.0)
    threads = [threading.Thread(target=browser.http.get, args=(f"{API}/formats",)) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(lookups) == 1
