"""Every route with every kind of token. ``ROWS`` has the expected results; a route without a row fails."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any, Literal, get_args

import httpx
import pytest
from starlette.routing import Route

from app.store.values import Role
from tests.api import samples
from tests.api.conftest import API, Api, running, settings_for

FARM, ABSENT, OTHERS = "farm", "farm-absent", "street*"
"""Environment, an unused name, and the pattern of the limited tokens, which match neither."""

INCLUDES: dict[str, set[str]] = {
    "viewer": {"viewer", "robot", "mirror", "editor", "admin"},
    "robot": {"robot", "editor", "admin"},
    "mirror": {"mirror", "admin"},
    "editor": {"editor", "admin"},
    "admin": {"admin"},
}
Scope = Literal["environment", "server", "filtered", "job", "open"]
"""Scope to which a token for other environments has no access.

environment: one that the request names (403, whether or not it exists). server: all environments or the server itself
(403). filtered: the response omits inaccessible items. job: only those of the token (404). open: no token is needed.
"""


@dataclass(frozen=True)
class Row:
    """Request and its required role. ``{env}`` and ``{job}`` are replaced. creates: sent with the existing name."""

    request: str
    role: Role | None
    scope: Scope
    body: Any = None
    query: str = ""
    own_robot: bool = False
    creates: bool = False


def rows(scope: Scope, **roles: str) -> list[Row]:
    """Create rows without bodies: ``role="METHOD path, METHOD path"``."""
    role_names: dict[str, Role] = {role: role for role in get_args(Role)}
    return [Row(line.strip(), role_names.get(role), scope) for role, text in roles.items() for line in text.split(",")]


E = f"{API}/environments/{{env}}"
V = f"{E}/versions/{{v}}"
STATUS = {"environment": "{env}", "channel": "latest", "version": 1, "root": "0" * 64, "state": "active"}
STATE = {"maps": [{"mapId": "{env}", "mapVersion": "1", "mapStatus": "ENABLED"}]}
NAMED = "environment={env}"
NONCE = f"nonce={'n' * 16}"
OGC_PATHS = ("", "/", "/conformance", "/api", "/api.html", "/crs/local", "/collections", "/collections/{collection}",
             "/collections/{collection}/schema", "/collections/{collection}/queryables",
             "/collections/{collection}/geotiff",
             "/collections/{collection}/items", "/collections/{collection}/items/{feature}",
             "/tileMatrixSets", "/tileMatrixSets/{tms}", "/wmts/1.0.0/WMTSCapabilities.xml", "/layers.qlr",
             *(f"{of}{path}" for of in ("", "/collections/{collection}") for path in (
                 "/map", "/tiles", "/tiles/{tms}", "/tiles/{tms}/{z}/{row}/{col}",
                 "/map/tiles", "/map/tiles/{tms}", "/map/tiles/{tms}/{z}/{row}/{col}")))  # fmt: skip
OGC_ITEMS = "/ogc/{env}/drafts/{draft}/collections/{collection}/items"
ITEM_METHODS = ("OPTIONS", "PUT", "PATCH", "DELETE")
ROWS = [
    *(
        Row(f"GET /ogc/{{env}}{start}{path}", "viewer", "environment")
        for start in ("", "/versions/{v}")
        for path in OGC_PATHS
    ),
    *(Row(f"GET /ogc/{{env}}/drafts/{{draft}}{path}", "editor", "environment") for path in OGC_PATHS),
    *(Row(f"{method} {OGC_ITEMS}", "editor", "environment", {}) for method in ("POST", "OPTIONS")),
    *(Row(f"{m} {OGC_ITEMS}/{{feature}}", "editor", "environment", {}) for m in ("PUT", "PATCH", "DELETE", "OPTIONS")),
    *(
        Row(f"{method} /ogc/{{env}}{start}/collections/{{collection}}/items{end}", "viewer", "environment")
        for start in ("", "/versions/{v}")
        for method, end in (("OPTIONS", ""), ("POST", ""), *((m, "/{feature}") for m in ITEM_METHODS))
    ),
    *rows(
        "open",
        open="GET /, GET /icon.svg, GET /service-worker.js, GET /assets/{name}, GET /openapi.json, GET /docs, "
        "GET /docs/{name}, GET /healthz, GET /readyz",
    ),
    *rows("server", viewer="GET /metrics", admin=f"GET {API}/tokens, DELETE {API}/tokens/{{id}}, POST {API}/keys"),
    *rows("server", admin=f"GET {API}/audit, GET {API}/retention, GET {API}/stored/{{kind}}/{{sha256}}"),
    *rows("server", admin=f"GET {API}/webhooks, DELETE {API}/webhooks/{{id}}, POST {API}/webhooks/{{id}}/test"),
    Row(f"POST {API}/webhooks", "admin", "server", {"url": "https://hooks.example.org/fleet"}),
    Row(f"POST {API}/tokens", "admin", "server", {"name": "x", "role": "viewer", "environments": OTHERS}),
    *rows("filtered", viewer=f"GET {API}/formats, GET {API}/derivations, GET {API}/generators, GET {API}/templates"),
    *rows("filtered", viewer=f"GET {API}/keys, GET {API}/environments, GET {API}/robots, GET {API}/robots/{{robot}}"),
    *rows("filtered", viewer=f"GET {API}/jobs, GET {API}/session, GET {API}/page"),
    Row(f"GET {API}/search", "viewer", "filtered", query="q=n"),
    Row(f"DELETE {API}/session", None, "open"),
    Row(f"POST {API}/session", None, "open", {"token": "TOKEN", "code": "CODE"}),
    Row(f"POST {API}/tokens/{{id}}/sign-in-code", "admin", "server"),
    Row(f"GET {API}/events", "viewer", "filtered", query="since=0&follow=false"),
    Row(f"POST {API}/convert", "editor", "filtered"),
    Row(f"POST {API}/robots/{{robot}}/vda5050/state", "robot", "filtered", STATE, own_robot=True),
    Row(f"GET {API}/events", "viewer", "environment", query=f"{NAMED}&since=0&follow=false"),
    Row(f"GET {API}/robots", "viewer", "environment", query=NAMED),
    Row(f"GET {API}/robots/{{robot}}", "viewer", "environment", query=NAMED),
    Row(f"DELETE {API}/robots/{{robot}}", "editor", "environment", query=NAMED),
    Row(f"PUT {API}/robots/{{robot}}/status", "robot", "environment", STATUS, own_robot=True),
    Row(f"POST {API}/environments", "admin", "environment", {"name": "{env}"}, creates=True),
    Row(f"POST {API}/environments", "admin", "environment", {"name": "street-2", "clone": {"environment": "{env}"}}),
    Row(f"GET {API}/jobs/{{job}}", "admin", "job"),
    Row(f"DELETE {API}/jobs/{{job}}", "admin", "job"),
    Row(f"PATCH {E}", "editor", "environment", {"datum": {"latitude": 53.2, "longitude": -0.5}}),
    Row(f"PATCH {E}", "admin", "environment", {"title": "x"}),
    Row(f"GET {API}/mirror", "mirror", "filtered", query=NONCE),
    Row(
        f"POST {API}/mirror/delegations",
        "mirror",
        "environment",
        {"public_key": "A" * 43 + "=", "environments": ["{env}"]},
    ),
    Row(f"GET {E}/mirror", "mirror", "environment", query=NONCE),
    Row(f"POST {E}/mirror/content", "mirror", "environment", {"after": 0, "last": 0}),
    Row(f"POST {E}/mirror/reports", "mirror", "environment", {}),
    Row(f"GET {API}/keys", "viewer", "environment", query=NAMED),
    *rows(
        "environment",
        viewer=f"GET {E}, GET {E}/versions, GET {V}, GET {V}/sources, GET {V}/sources/{{name}}, GET {V}/layers, "
        f"GET {V}/tiles/{{kind}}/{{name}}, GET {V}/tiles/{{kind}}/{{name}}/{{z}}/{{row}}/{{col}}.png, "
        f"GET {V}/preview.png, "
        f"GET {V}/layers/{{layer}}, GET {V}/maps, GET {V}/reports/{{format}}, POST {V}/links, GET {E}/diff, "
        f"GET {E}/diff/tiles/{{name}}, GET {E}/diff/tiles/{{name}}/{{z}}/{{row}}/{{col}}.png, GET {V}/losses, "
        f"GET {V}/delta, GET {V}/checks, POST {V}/checks, GET {E}/impact, "
        f"GET {E}/channels, GET {E}/transform, GET {E}/templates, GET {E}/templates/{{format}}, "
        f"GET {V}/manifest, GET {V}/provenance, GET {E}/overlays, GET {E}/overlays/nav2, GET {E}/overlays/rmf, "
        f"GET {E}/overlays/vda5050, GET {V}/vda5050/actions, GET {V}/maps/{{format}}, "
        f"GET {V}/maps/{{format}}/{{file}}, GET /maps/{{env}}/{{format}}, GET /maps/{{env}}/{{format}}/{{file}}",
        robot=f"POST {E}/overlays",
        editor=f"POST {E}/versions, POST {E}/edits, PUT {E}/channels/{{channel}}, "
        f"DELETE {E}/channels/{{channel}}/planned, POST {E}/derivations, POST {E}/generations, PUT {E}/templates, "
        f"DELETE {E}/templates, PUT {E}/templates/{{format}}, DELETE {E}/templates/{{format}}, POST {E}/alignments, "
        f"POST {E}/overlays/{{id}}/accept, POST {E}/overlays/{{id}}/reject, POST {E}/overlays/{{id}}/end, "
        f"POST {E}/overlays/{{id}}/keep, PATCH {E}/overlays/{{id}}, GET {E}/drafts, POST {E}/drafts, "
        f"GET {E}/drafts/{{draft}}, DELETE {E}/drafts/{{draft}}, POST {E}/drafts/{{draft}}/edits, "
        f"POST {E}/drafts/{{draft}}/rebase, POST {E}/drafts/{{draft}}/commit, "
        f"PUT {V}/tags/{{tag}}, DELETE {V}/tags/{{tag}}",
        admin=f"DELETE {E}, POST {E}/restore, POST {E}/purge",
    ),
]

NO_TOKEN = ("none", "garbage", "expired", "revoked")
LIMITED = " elsewhere"
VALUES = {"v": "1", "format": "tmap2", "file": "network.tmap2.yaml", "name": "n.tmap2.yaml", "layer": "topology",
          "channel": "staging", "id": "nosuch", "robot": "r1", "kind": "blobs", "sha256": "0" * 64,
          "collection": "nodes", "feature": "gate", "tms": "local", "z": "0", "row": "0", "col": "0",
          "draft": "0" * 16, "tag": "season"}  # fmt: skip


@dataclass
class Site:
    """Server, a client without a token, and a token for every kind of caller."""

    api: Api
    anonymous: httpx.Client
    bearer: dict[str, str]

    def send(self, row: Row, caller: str, env: str, method: str | None = None) -> httpx.Response:
        job = ""
        if "{job}" in row.request:
            job = self.api.app.state.services.store.jobs.create("another token").id
        row_method, path = row.request.split(" ")
        values = {**VALUES, "env": env, "job": job}
        path = re.sub(r"\{(\w+)\}", lambda match: values[match[1]], path)
        query = f"?{row.query.replace('{env}', env)}" if row.query else ""
        content = None if row.body is None else json.dumps(row.body).replace("{env}", env)
        headers = {"content-type": "application/json"} if content else {}
        if caller in self.bearer:
            headers["authorization"] = f"Bearer {self.bearer[caller]}"
        answer = self.anonymous.request(method or row_method, path + query, content=content, headers=headers)
        self.text = answer.text.replace(env, "{env}")
        return answer


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    with running(settings_for(tmp_path_factory.mktemp("matrix"), token_failures=10_000)) as api:
        api.post("environments", {"name": FARM})
        api.upload(FARM, {"n.tmap2.yaml": samples.tmap2()})
        store = api.app.state.services.store
        past = datetime.now(UTC) - timedelta(seconds=1)
        bearer = {"garbage": "x" * 43, "expired": store.tokens.create("expired", "admin", expires=past)[1]}
        for pattern, suffix in ((None, ""), (OTHERS, LIMITED)):
            for name, robot in (
                ("viewer", None),
                ("robot", "r1"),
                ("robot", "r2"),
                ("mirror", None),
                ("editor", None),
                ("admin", None),
            ):
                caller = f"{name} {robot}" if robot else name
                bearer[caller + suffix] = store.tokens.create(caller, name, pattern, robot)[1]
        revoked, bearer["revoked"] = store.tokens.create("revoked", "admin")
        api.get("formats", headers={"Authorization": f"Bearer {bearer['revoked']}"})
        api("DELETE", f"tokens/{revoked.id}", 204)
        yield Site(api, api.as_(None).http, bearer)


def expected(row: Row, caller: str) -> int | None:
    """Return the expected status for a caller; None for any except 401 and 403."""
    if row.role is None:
        return None
    if caller in NO_TOKEN:
        return 401
    limited = caller.endswith(LIMITED)
    name = caller.removesuffix(LIMITED)
    if row.scope == "job":
        return None if name == "admin" and not limited else 404
    if name.split(" ")[0] not in INCLUDES[row.role] or (row.own_robot and name == "robot r2"):
        return 403
    return 403 if limited and row.scope in ("environment", "server") else None


def hidden(routes: list[Any]) -> Iterator[str]:
    """List the paths of routes, including included routers, that OpenAPI omits."""
    for route in routes:
        if hasattr(route, "original_router"):
            yield from hidden(route.original_router.routes)
        elif not route.include_in_schema:
            yield route.path


def test_every_route_has_a_row(site: Site) -> None:
    app = site.api.app
    routes = {
        f"{method.upper()} {path}"
        for path, operations in app.openapi()["paths"].items()
        for method in operations
        if method != "parameters"
        and operations[method]["tags"] != ["maps by format"]  # these are listed by the short URL
    }
    for route in app.routes:
        if isinstance(route, Route):
            routes |= {f"{m} {route.path.replace(':path', '')}" for m in (route.methods or ()) if m != "HEAD"}
        else:
            assert not list(hidden(route.original_router.routes)), "not in OpenAPI, so not in this table"
    assert {row.request.replace("{job}", "{id}") for row in ROWS} == routes


def test_route_returns_expected_status_to_each_caller(site: Site) -> None:
    wrong = []
    for row in ROWS:
        for caller in ("none", *site.bearer):
            env = FARM if row.creates else ABSENT
            status = site.send(row, caller, env).status_code
            want = expected(row, caller)
            if status >= 500 or (status in (401, 403) if want is None else status != want):
                wrong.append(f"{row.request} {row.query} {row.body}, {caller}: {status}, not {want}")
        if row.request.startswith("GET "):
            head = site.send(row, "none", FARM, "HEAD").status_code
            if head != 401 and row.role is not None:
                wrong.append(f"HEAD {row.request}: {head}")
    assert wrong == []


def test_responses_do_not_reveal_inaccessible_environments(site: Site) -> None:
    """A limited token gets the same response for an existing and a missing environment."""
    site.api("PUT", "robots/r1/status", 200, json={**STATUS, "environment": FARM})
    differ = []
    for row in ROWS:
        if "{env}" not in f"{row.request} {row.query} {row.body}":
            continue
        for caller in site.bearer:
            if caller.endswith(LIMITED):
                answers = [(site.send(row, caller, env).status_code, site.text) for env in (FARM, ABSENT)]
                if answers[0] != answers[1]:
                    differ.append(f"{row.request} {row.query}, {caller}: {answers}")
    assert differ == []
    header = {"Authorization": f"Bearer {site.bearer['viewer' + LIMITED]}"}
    anonymous = site.anonymous
    for path in ("environments", "robots"):
        assert anonymous.get(f"{API}/{path}", headers=header).json() == []
    assert "farm" not in anonymous.get(f"{API}/events?since=0&follow=false", headers=header).text
    seen, unseen = (anonymous.get(f"{API}/robots/{robot}", headers=header) for robot in ("r1", "r9"))
    assert (seen.status_code, seen.text.replace("r1", "r9")) == (unseen.status_code, unseen.text)


def test_foreign_jobs_are_not_found(site: Site) -> None:
    store = site.api.app.state.services.store
    job = store.jobs.create("another token").id
    for caller in ("viewer", "editor", "admin" + LIMITED):
        header = {"Authorization": f"Bearer {site.bearer[caller]}"}
        foreign, absent = (site.anonymous.get(f"{API}/jobs/{number}", headers=header) for number in (job, "0" * 32))
        assert (
            (foreign.status_code, foreign.text.replace(job, "0" * 32)) == (absent.status_code, absent.text) != (200, "")
        )
    assert store.jobs.get(job)


def test_unknown_addresses_need_a_token(site: Site) -> None:
    for path in ("/nothing", "/api/v1/nothing", "/docsx", "/healthz/", "/maps"):
        site.api.as_(None).problem("GET", path, 401)
        site.api.problem("GET", path, 404)
