"""OpenAPI document: complete, and all its examples work against a server."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from app import derive
from app.cli import demo
from app.cli.client import Client
from app.formats import all_formats, get_format
from app.parameters import describe
from tests.api import samples
from tests.api.conftest import ADMIN, Api, parts, running, settings_for
from tests.api.test_alignments import piece_files

UPLOADED = {"datum.yaml": samples.DATUM}
"""Files that the upload examples name."""


@pytest.fixture(scope="module")
def api(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Api]:
    """Run a server with the objects that the examples name: the demo, a robot's report."""
    with running(settings_for(tmp_path_factory.mktemp("examples"), job_seconds=60)) as api:
        with Client(api.url, ADMIN) as client:
            demo.install(client)
        status = {"environment": "orchard", "channel": "latest", "version": 1, "root": "0" * 64, "state": "ready"}
        api("PUT", "robots/mower-3/status", 200, json=status)
        yield api


@pytest.fixture(scope="module")
def schema(api: Api) -> dict[str, Any]:
    body: dict[str, Any] = api.as_(None).get("/openapi.json").json()
    return body


def operations(schema: dict[str, Any]) -> list[tuple[str, str, dict[str, Any]]]:
    return [(path, method, op) for path, item in schema["paths"].items() for method, op in item.items()]


def test_openapi_lists_every_address(schema: dict[str, Any]) -> None:
    e, v = "/api/v1/environments/{env}", "/api/v1/environments/{env}/versions/{v}"
    wanted = {
        f"{v}/tiles/{{kind}}/{{name}}": "get", f"{v}/tiles/{{kind}}/{{name}}/{{z}}/{{row}}/{{col}}.png": "get",
        f"{v}/preview.png": "get",
        "/healthz": "get", "/readyz": "get", "/metrics": "get", "/api/v1/formats": "get",
        "/api/v1/environments": "get post", e: "get patch delete", f"{e}/restore": "post", f"{e}/purge": "post",
        f"{e}/versions": "get post", v: "get", f"{v}/sources": "get", f"{v}/sources/{{name}}": "get",
        f"{v}/layers": "get", f"{v}/layers/{{layer}}": "get", f"{e}/edits": "post", f"{v}/maps": "get",
        f"{v}/maps/{{format}}": "get", f"{v}/maps/{{format}}/{{file}}": "get", f"{v}/reports/{{format}}": "get",
        f"{v}/links": "post", f"{v}/tags/{{tag}}": "put delete",
        "/api/v1/templates": "get", f"{e}/templates": "get put delete", f"{e}/templates/{{format}}": "get put delete",
        f"{e}/diff/tiles/{{name}}": "get", f"{e}/diff/tiles/{{name}}/{{z}}/{{row}}/{{col}}.png": "get",
        f"{v}/losses": "get", f"{e}/diff": "get", f"{v}/delta": "get", f"{v}/checks": "get post",
        f"{e}/impact": "get", f"{e}/overlays": "get post",
        f"{e}/overlays/{{id}}/accept": "post", f"{e}/overlays/{{id}}/reject": "post",
        f"{e}/overlays/{{id}}/end": "post", f"{e}/overlays/{{id}}/keep": "post",
        f"{e}/overlays/nav2": "get", f"{e}/overlays/rmf": "get", f"{e}/overlays/vda5050": "get",
        f"{v}/vda5050/actions": "get", "/api/v1/robots/{robot}/vda5050/state": "post",
        f"{e}/channels": "get", f"{e}/channels/{{channel}}": "put",
        f"{e}/channels/{{channel}}/planned": "delete", f"{e}/transform": "get", "/api/v1/convert": "post",
        "/api/v1/derivations": "get", "/api/v1/generators": "get",
            f"{e}/generations": "post", "/api/v1/events": "get", f"{v}/provenance": "get",
        "/api/v1/keys": "get post", f"{v}/manifest": "get", f"{e}/derivations": "post", f"{e}/alignments": "post",
        "/api/v1/robots": "get", "/api/v1/robots/{robot}": "get delete", "/api/v1/robots/{robot}/status": "put",
        "/api/v1/audit": "get", "/api/v1/retention": "get",
        "/api/v1/jobs": "get", "/api/v1/jobs/{id}": "get delete",
        "/api/v1/tokens": "get post", "/api/v1/tokens/{id}": "delete", "/api/v1/tokens/{id}/sign-in-code": "post",
        "/api/v1/webhooks": "get post", "/api/v1/webhooks/{id}": "delete", "/api/v1/webhooks/{id}/test": "post",
        "/api/v1/session": "get post delete", "/api/v1/page": "get", "/api/v1/search": "get",
        "/maps/{env}/{format}": "get", "/maps/{env}/{format}/{file}": "get",
        "/api/v1/stored/{kind}/{sha256}": "get", "/api/v1/mirror": "get", "/api/v1/mirror/delegations": "post",
        f"{e}/mirror": "get", f"{e}/mirror/content": "post", f"{e}/mirror/reports": "post",
    }  # fmt: skip
    ogc = ("/", "/conformance", "/api", "/api.html", "/crs/local", "/collections", "/collections/{collection}",
           "/collections/{collection}/items", "/collections/{collection}/items/{feature}",
           "/collections/{collection}/schema", "/collections/{collection}/queryables",
           "/collections/{collection}/geotiff",
           "/tileMatrixSets", "/tileMatrixSets/{tms}", "/wmts/1.0.0/WMTSCapabilities.xml", "/layers.qlr",
           *(f"{of}{path}" for of in ("", "/collections/{collection}") for path in (
               "/map", "/tiles", "/tiles/{tms}", "/tiles/{tms}/{z}/{row}/{col}",
               "/map/tiles", "/map/tiles/{tms}", "/map/tiles/{tms}/{z}/{row}/{col}")))  # fmt: skip
    draft = "/ogc/{env}/drafts/{draft}"
    wanted |= {start + path: "get" for start in ("/ogc/{env}", "/ogc/{env}/versions/{v}", draft) for path in ogc}
    wanted[f"{draft}/collections/{{collection}}/items"] = "get post"
    wanted[f"{draft}/collections/{{collection}}/items/{{feature}}"] = "get put patch delete"
    wanted |= {f"{e}/overlays/{{id}}": "patch", f"{e}/drafts": "get post", f"{e}/drafts/{{draft}}": "get delete"}
    wanted |= {f"{e}/drafts/{{draft}}/{work}": "post" for work in ("edits", "rebase", "commit")}
    by_format = {f"/maps/{{env}}/{fmt.name}" for fmt in all_formats().values() if fmt.write}
    assert by_format < set(schema["paths"])
    assert {path: " ".join(sorted(item, key=["get", "post", "put", "patch", "delete"].index))
            for path, item in schema["paths"].items() if path not in by_format} == wanted  # fmt: skip


def test_openapi_describes_every_call(schema: dict[str, Any]) -> None:
    seen = set()
    for path, method, op in operations(schema):
        operation = f"{method} {path}"
        assert op.get("summary"), operation
        assert op.get("description"), operation
        assert op["operationId"] not in seen, operation
        seen.add(op["operationId"])
        for parameter in op.get("parameters", ()):
            assert parameter.get("description") or parameter["schema"].get("description"), (
                operation,
                parameter["name"],
            )
        is_open = path in ("/healthz", "/readyz") or (path == "/api/v1/session" and method != "get")
        assert ("security" in op) != is_open, operation


def test_openapi_documents_every_problem(schema: dict[str, Any]) -> None:
    for path, method, op in operations(schema):
        for status, response in op["responses"].items():
            if int(status) < 400:
                continue
            content = response["content"]
            assert list(content) == ["application/problem+json"], (method, path, status)
            assert content["application/problem+json"]["schema"] == {"$ref": "#/components/schemas/Problem"}
        if "security" in op:
            assert {"401", "403", "422", "429", "503"} <= set(op["responses"]), (method, path)
        if "requestBody" in op:
            assert {"400", "413", "415"} <= set(op["responses"]), (method, path)


def test_openapi_references_resolve(schema: dict[str, Any]) -> None:
    schemas = set(schema["components"]["schemas"])
    used = set(re.findall(r"#/components/schemas/([A-Za-z_0-9]+)", str(schema)))
    assert used <= schemas
    assert "HTTPValidationError" not in schemas


def test_openapi_lists_parameters_of_formats(api: Api, schema: dict[str, Any]) -> None:
    op = schema["paths"]["/api/v1/environments/{env}/versions/{v}/maps/{format}"]["get"]
    listed = {p["name"] for p in op["parameters"] if p["in"] == "query"}
    declared = {o["name"] for f in api.get("formats").json() if f["write"] for o in f["options"] if o["for"] == "write"}
    steps = {name for step in derive.all_derivations() for name in derive.parameter_names(step)}
    assert listed == declared | steps | {"derive", "closures"}


def test_openapi_lists_parameters_by_format(schema: dict[str, Any]) -> None:
    op = schema["paths"]["/maps/{env}/octomap"]["get"]
    option_names = {o["name"] for o in describe(get_format("octomap").write_options)}
    assert option_names
    assert {p["name"] for p in op["parameters"] if p["in"] == "query"} == option_names | {"derive", "closures"}


def test_docs_page_needs_no_network(api: Api) -> None:
    anonymous = api.as_(None)
    page = anonymous.get("/docs").text
    links = re.findall(r'(?:src|href)="([^"]+)"', page)
    assert len(links) >= 3
    for link in links:
        assert link.startswith("/docs/"), link
        assert anonymous.get(link).content
    assert "//" not in page.replace("</", "").replace("<!--", "").replace("/*", "") or "http" not in page


# --- the examples work ---

ORDER = ["post", "get", "put", "patch", "delete"]
LAST = ("delete_environment", "restore_environment", "purge_environment")


def example_of(parameter: dict[str, Any]) -> Any:
    if "example" in parameter:
        return parameter["example"]
    for place in (parameter, parameter.get("schema", {})):
        if place.get("examples"):
            examples = place["examples"]
            return examples[0] if isinstance(examples, list) else next(iter(examples.values()))["value"]
    return None


LANE = b"""{"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {},
"geometry": {"type": "LineString", "coordinates": [[5.6134, 52.4206], [5.6136, 52.4206]]}}]}"""


def bodies_of(schema: dict[str, Any], op: dict[str, Any]) -> list[dict[str, Any]]:
    """Yield the requests of a call's examples, as arguments for the client."""
    content = op.get("requestBody", {}).get("content", {})
    out: list[dict[str, Any]] = []
    for media, media_object in content.items():
        examples = [e["value"] for e in media_object.get("examples", {}).values()]
        reference = media_object["schema"].get("$ref", "").rpartition("/")[2]
        examples += schema["components"]["schemas"].get(reference, {}).get("examples", [])
        assert examples, f"{op['operationId']} has no example for {media}"
        for value in examples:
            if media == "multipart/form-data":
                files = {name: UPLOADED[name] for name in value["files"]}
                data = {k: v for k, v in value.items() if k != "files"}
                out.append({"files": parts(files), "data": data})
            else:
                out.append({"json": value})
    return out or [{}]


def draft_of(api: Api) -> str:
    """Create a draft with a change."""
    made: str = api.post("environments/orchard/drafts", {}).json()["id"]
    feature = {"type": "Feature", "id": made, "geometry": {"type": "Point", "coordinates": [5.6135, 52.4206]}}
    changes = [{"op": "put", "layer": "objects", "feature": {**feature, "properties": {"kind": "pole"}}}]
    api.post(f"environments/orchard/drafts/{made}/edits", {"changes": changes}, 200)
    return made


def test_openapi_examples_work(api: Api, schema: dict[str, Any], tmp_path: Path) -> None:
    resource_ids: dict[str, str] = {}
    job = api.app.state.services.store.jobs.create(owner="", detail="an example")
    resource_ids["/api/v1/jobs/{id}"] = job.id
    resource_ids["/api/v1/stored/{kind}/{sha256}"] = api.app.state.services.store.blobs.put(b"an example")
    calls = operations(schema)
    calls.sort(key=lambda o: (LAST.index(_name(o)) if _name(o) in LAST else -1, ORDER.index(o[1])))
    ran = 0
    for path, method, op in calls:
        operation = f"{method} {path}"
        if path == "/api/v1/environments/{env}/channels/{channel}/planned":
            body = {"version": 1, "activate_at": "2099-01-01T00:00:00Z"}
            api("PUT", "environments/orchard/channels/production", 200, json=body)
        if "/overlays/{id}" in path:
            ring = [[0, 0], [1, 0], [1, 1], [0, 0]]
            blocked = {"kind": "blocked", "crs": "local", "polygon": {"type": "Polygon", "coordinates": [ring]}}
            if path.endswith(("/{id}", "/end", "/keep")):
                blocked["state"] = "accepted"
            resource_ids[path] = api("POST", "environments/orchard/overlays", None, json=blocked).json()["id"]
        if path.startswith("/api/v1/environments/{env}/drafts/{draft}"):
            resource_ids[path] = draft_of(api)
        if path.endswith("/sources/{name}"):
            api.upload("orchard", UPLOADED)
        if operation == "post /api/v1/environments/{env}/alignments":
            for name, view in (("robot-1", (-3.0, 3.5, 10.0)), ("robot-2", (0.5, 9.0, 80.0))):
                api.upload("orchard", piece_files(name, view), grid=name)
        if path == "/api/v1/environments/{env}/derivations":
            api.upload("orchard", {"lane.geojson": LANE})
        if _name((path, method, op)) == "purge_environment":
            api("DELETE", "environments/orchard", 204)
        query: dict[str, Any] = {}
        target = path
        for parameter in op.get("parameters", ()):
            value = example_of(parameter)
            if parameter["in"] == "path":
                value = value if value is not None else resource_ids.get(path)
                assert value is not None, (operation, parameter["name"])
                target = target.replace("{" + parameter["name"] + "}", str(value))
            elif parameter["in"] == "query" and value is not None:
                query[parameter["name"]] = value
        if method == "delete" and path.startswith("/ogc/"):
            target = re.sub("/nodes/items/.*", "/edges/items/Dock1_Yard1", target)  # nodes with edges stay
        if path == "/api/v1/events":
            query["follow"] = "false"  # otherwise it would not end
        for body in bodies_of(schema, op):
            if path == "/api/v1/session" and method == "post":
                body = {"json": {"token": ADMIN}}  # the example has a placeholder
            answer = api(method.upper(), target, None, params=query, **body)
            missing = op["tags"] == ["maps by format"] and answer.status_code == 422  # this format's inputs are missing
            missing |= "/drafts/" in path and path.endswith("/geotiff") and answer.status_code == 404  # of edits
            assert answer.status_code < 400 or missing, (operation, answer.status_code, answer.text[:1000])
            assert str(answer.status_code) in op["responses"], (operation, answer.status_code)
            if path == "/api/v1/tokens" and method == "post":
                resource_ids["/api/v1/tokens/{id}"] = answer.json()["id"]
                resource_ids["/api/v1/tokens/{id}/sign-in-code"] = answer.json()["id"]
            if path == "/api/v1/webhooks" and method == "post":
                resource_ids["/api/v1/webhooks/{id}"] = answer.json()["id"]
                resource_ids["/api/v1/webhooks/{id}/test"] = answer.json()["id"]
            ran += 1
    assert ran >= len(calls)


def _name(operation: tuple[str, str, dict[str, Any]]) -> str:
    return re.sub(r"_api_v1_.*", "", operation[2]["operationId"])
