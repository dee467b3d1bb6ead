"""OpenAPI: what FastAPI cannot know by itself, the maps' plain routes, and the pages at /docs without a network."""

from __future__ import annotations

from importlib import resources
from typing import Any

import orjson
from fastapi import FastAPI, Request
from fastapi.openapi.docs import get_swagger_ui_html
from fastapi.openapi.utils import get_openapi
from starlette.responses import HTMLResponse, RedirectResponse, Response

from app import formats, parameters
from app.api.http.auth import is_open
from app.api.http.problems import MEDIA_TYPE
from app.api.http.responses import API
from app.api.http.schemas import ProblemOut, problem_responses
from app.derive import all_derivations
from app.errors import NotFound
from app.model.closures import CLOSURE_MODES

SESSION_SCRIPT = """\
// The token stays until the tab is closed, and no longer: the page's own memory would outlive the browser.
const key = "fleetmap-token";
let restored = false;
ui.getStore().subscribe(() => {
  if (!ui.specSelectors.specJson().size) return;
  if (!restored) {
    restored = true;
    const kept = sessionStorage.getItem(key);
    if (kept) ui.preauthorizeApiKey("token", kept);
    return;
  }
  const given = ui.authSelectors.authorized().getIn(["token", "value"]);
  if (given) sessionStorage.setItem(key, given);
  else sessionStorage.removeItem(key);
});
"""

ASSETS = {
    "swagger-ui-bundle.js": "text/javascript",
    "swagger-ui.css": "text/css",
    "favicon.png": "image/png",
}
_PACKAGE = "fastapi_offline"

DESCRIPTION = """\
Every environment's maps, versioned in canonical layers, for every robot in its own format.

All errors are `application/problem+json` (RFC 9457). Lists come in pages: the `Link` header names the next one.
Versions are named by number, by channel (`production`), or `latest`. Coordinates are `longitude, latitude` in GeoJSON
and `latitude, longitude` in query parameters, as their names say.

Access: `Authorization: Bearer <token>`; maps also by a signed link (`POST …/links`). Roles: `viewer` and `robot` read,
`robot` also tells the status of the robot that its token names and what is blocked; `editor` also uploads, edits,
converts, moves channels and sets datums; `admin` does all.
"""


TAGS = {
    "environments": "Mapped places.",
    "versions": "Immutable states: upload, edit, revert, compare.",
    "sources": "The uploaded files, byte for byte.",
    "layers": "Canonical content.",
    "maps": "Maps in a format, converted on demand.",
    "maps by format": "The short address of each format, with the parameters of that format.",
    "channels": "Which version robots drive on.",
    "robots": "Who holds what, who lags.",
    "overlays": "What robots report as blocked.",
    "vda5050": "Maps for fleet managers that speak VDA 5050.",
    "events": "Every change as it happens.",
    "manifest": "What a robot verifies.",
    "transform": "Between earth and local frame.",
    "derivations": "What is computed from what, and committing it.",
    "alignments": "Laying a map of another frame onto what is stored.",
    "generations": "Sites made up from parameters and a seed.",
    "templates": "What is filled in where a format asks for more than the layers have.",
    "formats": "What can be read, served and converted.",
    "jobs": "Work that takes long.",
    "stored data": "Healing from another server.",
    "tokens": "Access.",
    "audit": "Who changed what, from where.",
    "health": "Operation.",
}


def add_pages(app: FastAPI) -> None:
    """``/openapi.json`` and ``/docs``, with all that the page loads from this server."""

    async def schema(_: Request) -> Response:
        return Response(orjson.dumps(app.openapi()), media_type="application/json")

    async def docs(_: Request) -> Response:
        page = get_swagger_ui_html(
            openapi_url="/openapi.json",
            title=f"{app.title}: HTTP interface",
            swagger_js_url="/docs/swagger-ui-bundle.js",
            swagger_css_url="/docs/swagger-ui.css",
            swagger_favicon_url="/docs/favicon.png",
            swagger_ui_parameters={"persistAuthorization": False, "docExpansion": "none", "tryItOutEnabled": True},
        )
        return HTMLResponse(bytes(page.body).decode().replace("</body>", f"<script>{SESSION_SCRIPT}</script></body>"))

    async def asset(request: Request) -> Response:
        name = request.path_params["name"]
        if name not in ASSETS:
            raise NotFound("the documentation has no such file")
        data = resources.files(_PACKAGE).joinpath("static", name).read_bytes()
        return Response(data, headers={"cache-control": "public, max-age=86400"}, media_type=ASSETS[name])

    async def front(_: Request) -> Response:
        return RedirectResponse("/docs", 307)  # until there is a page for operators

    app.router.add_route("/", front, methods=["GET"], include_in_schema=False)
    app.router.add_route("/openapi.json", schema, methods=["GET"], include_in_schema=False)
    app.router.add_route("/docs", docs, methods=["GET"], include_in_schema=False)
    app.router.add_route("/docs/{name}", asset, methods=["GET"], include_in_schema=False)


def build(app: FastAPI) -> dict[str, Any]:
    """The whole description."""
    schema = get_openapi(
        title=app.title,
        version=app.version,
        summary="HTTP interface of the Fleet Map Server",
        description=DESCRIPTION,
        routes=app.routes,
    )
    components = schema.setdefault("components", {})
    schemas = components.setdefault("schemas", {})
    schemas.pop("HTTPValidationError", None)
    schemas.pop("ValidationError", None)
    problem = ProblemOut.model_json_schema(ref_template="#/components/schemas/{model}")
    schemas.update(problem.pop("$defs"))
    schemas["Problem"] = problem
    for operations in schema["paths"].values():
        for operation in operations.values():
            schemas.update(operation.pop("x-schemas", {}))  # of bodies that a route reads itself
    components["securitySchemes"] = {
        "token": {"type": "http", "scheme": "bearer", "description": "A token; see `/api/v1/tokens`."},
        "link": {
            "type": "apiKey",
            "in": "query",
            "name": "signature",
            "description": "A signed link, used as it was given (with its `expires`); see `POST …/links`.",
        },
    }
    _map_paths(schema["paths"])
    for path, operations in schema["paths"].items():
        for method, operation in operations.items():
            _finish(path, method, operation)
    schema["tags"] = [{"name": name, "description": text} for name, text in TAGS.items()]
    return schema


def _finish(path: str, method: str, operation: dict[str, Any]) -> None:
    """The problems that every call can meet, and the token."""
    operation.pop("x-free-query", None)
    problem = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}
    responses = operation["responses"]
    common: dict[str, str] = {}
    if not is_open(path):
        operation["security"] = [{"token": []}, *([{"link": []}] if _is_map(path) else [])]
        common |= {
            "401": "A token is needed, or it is unknown or has expired.",
            "403": "The token's role or its environments do not allow it."
            + (" Or the signed link was altered, or has expired." if _is_map(path) else ""),
            "429": "Too many wrong tokens from this address.",
        }
        common["422"] = "A parameter, the body or a file cannot be used; `errors` says where."
        common["503"] = "Too busy, or a part of the server does not answer: try again after `Retry-After` seconds."
        if method != "get":
            common["507"] = (
                "The server's disk is full, and nothing was stored: try again after its operator has freed space."
            )
    if "requestBody" in operation:
        common |= {
            "400": "The body is malformed.",
            "408": "The body stopped coming.",
            "413": "The body is larger than the server takes.",
            "415": "A media type or content coding that is not taken.",
        }
    for status, text in common.items():
        response = responses.get(status)
        if response is None or "HTTPValidationError" in str(response):
            responses[status] = {"description": text, "content": problem}


def _is_map(path: str) -> bool:
    return path.startswith("/maps/") or "/maps/{format}" in path


def _map_paths(paths: dict[str, Any]) -> None:
    """The plain routes, as ``app.api.maps`` serves them; the formats' parameters from their declarations."""
    long = f"{API}/environments/{{env}}/versions/{{v}}/maps/{{format}}"
    for path, summary, extra in (
        (long, "A map in a format", ()),
        (long + "/{file}", "One file of a map", ("file",)),
        ("/maps/{env}/{format}", "A map, by the short address for robots", ()),
        ("/maps/{env}/{format}/{file}", "One file of a map, by the short address", ("file",)),
    ):
        names = [n for n in ("env", "v", "format") if "{" + n + "}" in path] + list(extra)
        content: dict[str, Any] = {"application/octet-stream": {}, "application/zip": {}}
        describing = "The file itself where the format is one file, else a zip of all." if not extra else "The file."
        short = " From the channel `production` where there is one, else `latest`." if path.startswith("/maps") else ""
        operation = {
            "tags": ["maps"],
            "summary": summary,
            "operationId": "get_" + "_".join(["map", *(["file"] if extra else []), *(["short"] if short else [])]),
            "description": f"{describing}{short} Derives what is missing. Ask again with `If-None-Match`: it costs "
            "nothing. `Link` names the report on what was raw, derived, filled in or dropped. Where a format has parts "
            "by level and name, `*` gives all of them: `?level=*&grid=*`; files of other levels than the default one "
            "are below a folder of the level's name (`L2/map.yaml`).",
            "parameters": [_path_parameter(name) for name in names] + _query_parameters() + _header_parameters(),
            "responses": {
                "200": {"description": describing, "headers": _HEADERS, "content": content},
                "202": {
                    "description": "It takes long: follow the job at `Location`, then ask again.",
                    "content": {"application/json": {"schema": {"$ref": "#/components/schemas/JobOut"}}},
                },
                "206": {"description": "A part of the file"},
                "304": {"description": "The client has it"},
                **{str(k): v for k, v in problem_responses(None, 404, 409, 416, 422, 503).items()},
            },
        }
        paths[path] = {"get": operation}
    short = paths["/maps/{env}/{format}"]["get"]
    for fmt in formats.all_formats().values():
        if fmt.write is None:
            continue
        common_names = {"env", "derive", "closures", *(p["name"] for p in _header_parameters())}
        common = [p for p in short["parameters"] if p["name"] in common_names]
        paths[f"/maps/{{env}}/{fmt.name}"] = {
            "get": {
                **short,
                "tags": ["maps by format"],
                "summary": fmt.title,
                "operationId": f"get_{fmt.name}",
                "parameters": [*common[:1], *_writer_parameters(fmt), *common[1:]],
            }
        }


def _writer_parameters(fmt: formats.Format) -> list[dict[str, Any]]:
    """The parameters of one format's writer."""
    return [
        {
            "name": option["name"],
            "in": "query",
            "description": f"{option['description']} Default: {option['default']!r}.",
            "schema": dict(option["schema"]),
        }
        for option in parameters.describe(fmt.write_options)
    ]


_HEADERS: dict[str, Any] = {
    "ETag": {"schema": {"type": "string"}, "description": "Strong: equal tags mean equal bytes."},
    "Fleetmap-Version": {"schema": {"type": "integer"}},
    "Fleetmap-Root": {"schema": {"type": "string"}},
    "Fleetmap-Overlays": {
        "schema": {"type": "string"},
        "description": "Digest of the closures in force that the map shows; absent with `closures=ignore`.",
    },
    "Link": {"schema": {"type": "string"}, "description": 'The report, `rel="describedby"`.'},
}

_EXAMPLES = {
    "env": ("An environment's name.", "orchard"),
    "v": ("Number, channel, or `latest`.", "latest"),
    "format": ("A format's id.", "geojson"),
    "file": ("A file's name; it may have folders.", "map.geojson"),
}


def _path_parameter(name: str) -> dict[str, Any]:
    description, example = _EXAMPLES[name]
    schema: dict[str, Any] = {"type": "string"}
    if name == "format":
        schema["enum"] = [fmt.name for fmt in formats.all_formats().values() if fmt.write]
    return {
        "name": name,
        "in": "path",
        "required": True,
        "description": description,
        "schema": schema,
        "example": example,
    }


def _query_parameters() -> list[dict[str, Any]]:
    """``derive``, ``closures``, the options of all formats, and the parameters of the derivations on the way to them.

    One that several have is told once, with what it means for each.
    """
    out: dict[str, dict[str, Any]] = {}
    declared = [(fmt.name, fmt.write_options) for fmt in formats.all_formats().values() if fmt.write]
    declared += [(step.name, step.parameters) for step in all_derivations().values()]
    for name, options in declared:
        for option in parameters.describe(options):
            text = f"`{name}`: {option['description']} Default: {option['default']!r}."
            entry = out.setdefault(
                option["name"],
                {"name": option["name"], "in": "query", "description": "", "schema": dict(option["schema"])},
            )
            if entry["schema"] != option["schema"]:
                entry["schema"] = {"type": "string"}
            entry["description"] = f"{entry['description']} {text}".strip()
    derive = {
        "name": "derive",
        "in": "query",
        "description": "`false`: only from information that is stored as it is.",
        "schema": {"type": "boolean", "default": True},
    }
    closures = {
        "name": "closures",
        "in": "query",
        "description": "How the closures in force are shown: `apply` (closed edges are left out of formats that "
        "cannot express a blocked edge), `mark` or `ignore`. Default: `apply`, but `ignore` at a version's number.",
        "schema": {"type": "string", "enum": list(CLOSURE_MODES)},
    }
    return [derive, closures, *(out[name] for name in sorted(out))]


def _header_parameters() -> list[dict[str, Any]]:
    texts = {
        "If-None-Match": "ETags that the client has.",
        "Range": "One range of bytes.",
        "If-Range": "The range holds only for this ETag.",
        "Available-Dictionary": "`:<base64 of the SHA-256>:` of a file that the client has (RFC 9842); with "
        "`Accept-Encoding: dcz` the answer is a delta to it.",
    }
    return [
        {"name": name, "in": "header", "description": text, "schema": {"type": "string"}}
        for name, text in texts.items()
    ]
