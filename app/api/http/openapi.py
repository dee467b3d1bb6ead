"""OpenAPI document with the plain routes of maps and common responses, and the offline documentation at /docs."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import resources
from typing import Any

import orjson
from fastapi import FastAPI, Request
from fastapi.openapi.docs import get_swagger_ui_html
from fastapi.openapi.utils import get_openapi
from starlette.responses import HTMLResponse, Response

from app import formats, parameters
from app.api.http.auth import SESSION_COOKIE, is_open
from app.api.http.problems import MEDIA_TYPE
from app.api.http.responses import API
from app.api.http.schemas import ProblemOut, problem_responses
from app.derive import all_derivations
from app.errors import NotFound
from app.model.closures import CLOSURE_MODES

SESSION_SCRIPT = """\
// Keep the token until the tab is closed; the storage of Swagger UI would outlive the browser.
const key = "fleetmap-token";
let restored = false;
ui.getStore().subscribe(() => {
  if (!ui.specSelectors.specJson().size) return;
  if (!restored) {
    restored = true;
    const stored = sessionStorage.getItem(key);
    if (stored) ui.preauthorizeApiKey("token", stored);
    return;
  }
  const token = ui.authSelectors.authorized().getIn(["token", "value"]);
  if (token) sessionStorage.setItem(key, token);
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
Stores the maps of environments, versioned in canonical layers, and exports them in the format that each robot needs.

- **Errors** are `application/problem+json` (RFC 9457).
- **Lists** are paginated: follow the `Link` header with `rel="next"`.
- **Versions** are given by number, by channel (`production`), or as `latest`.
- **Coordinates** are `longitude, latitude` in GeoJSON, and `latitude, longitude` in query parameters (`LAT,LON`).
- **Access** requires `Authorization: Bearer <token>`, or in a browser a session (`POST /api/v1/session`); maps can also
  be read with a signed link (`POST …/links`).
- **Roles**: `viewer` reads; `robot` also reports the status of the token's robot, and obstructions; `mirror` is for a
  server that follows this one; `editor` also uploads, edits, converts, moves channels and sets datums; `admin` may do
  everything.
"""


TAGS = {
    "environments": "Mapped places, each with its own history of versions.",
    "versions": "Immutable states of an environment: upload, edit, revert, compare.",
    "drafts": "Working versions: edits that gather until they are committed as one version.",
    "sources": "Uploaded files, byte for byte.",
    "layers": "Canonical content of a version.",
    "tiles": "Rasters in pieces, and pictures of sites, for screens.",
    "maps": "Maps in a format, converted on demand.",
    "ogc": "OGC API - Features: an environment for GIS programs.",
    "maps by format": "Short URL of each format, with the parameters of that format.",
    "channels": "Names that point to the version that robots run.",
    "robots": "Status and lag of robots.",
    "overlays": "Obstructions that robots report, and closures in force.",
    "vda5050": "Maps for fleet managers that use VDA 5050.",
    "events": "Stream of all changes.",
    "manifest": "Signed list of files that a robot verifies.",
    "transform": "Conversion between WGS 84 and the local frame.",
    "derivations": "Layers computed from other layers.",
    "alignments": "Alignment of grids with other maps.",
    "generations": "Synthetic sites, generated from parameters and a seed.",
    "templates": "Values that are filled in if a format needs more than the layers contain.",
    "formats": "File formats that can be read, exported and converted.",
    "jobs": "Conversions that outlive their request.",
    "mirrors": "For servers that follow this one.",
    "stored data": "Stored bytes, for the repair of another server.",
    "tokens": "Access tokens.",
    "webhooks": "Addresses that get each event, signed and repeated until acknowledged.",
    "session": "Sign-in of browsers.",
    "search": "Search in all environments.",
    "audit": "Log of changes with author and address.",
    "retention": "What the rule of retention keeps and removes.",
    "health": "Liveness, readiness and metrics.",
}


def add_pages(app: FastAPI) -> None:
    """Add ``/openapi.json`` and ``/docs``; this server provides all files of the page."""

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
            raise NotFound("no such file of the documentation: see /docs")
        data = resources.files(_PACKAGE).joinpath("static", name).read_bytes()
        return Response(data, headers={"cache-control": "public, max-age=86400"}, media_type=ASSETS[name])

    app.router.add_route("/openapi.json", schema, methods=["GET"], include_in_schema=False)
    app.router.add_route("/docs", docs, methods=["GET"], include_in_schema=False)
    app.router.add_route("/docs/{name}", asset, methods=["GET"], include_in_schema=False)


def build(app: FastAPI) -> dict[str, Any]:
    """Build the OpenAPI document."""
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
            schemas.update(operation.pop("x-schemas", {}))  # of bodies that a route parses itself
    components["securitySchemes"] = {
        "token": {"type": "http", "scheme": "bearer", "description": "Bearer token; see `/api/v1/tokens`."},
        "session": {
            "type": "apiKey",
            "in": "cookie",
            "name": SESSION_COOKIE,
            "description": "Session of a browser; see `POST /api/v1/session`. Changes require the header `Origin`.",
        },
        "link": {
            "type": "apiKey",
            "in": "query",
            "name": "signature",
            "description": "Signed link, used unchanged (with its `expires`); see `POST …/links`.",
        },
    }
    _map_paths(schema["paths"])
    for path, operations in schema["paths"].items():
        for method, operation in operations.items():
            _finish(path, method, operation)
    schema["tags"] = [{"name": name, "description": text} for name, text in TAGS.items()]
    return schema


def _finish(path: str, method: str, operation: dict[str, Any]) -> None:
    """Add the problems that every call can return, and its security schemes."""
    operation.pop("x-free-query", None)
    problem = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}
    responses = operation["responses"]
    common: dict[str, str] = {}
    if not is_open(path, method.upper()):
        operation["security"] = [{"token": []}, {"session": []}, *([{"link": []}] if _is_map(path) else [])]
        common |= {
            "401": "The token is missing, unknown or expired, or the session has ended.",
            "403": "The role or the environments of the token do not allow the call."
            + (" Or the signed link is invalid or expired." if _is_map(path) else ""),
            "429": "Too many wrong tokens from this address.",
        }
        common["422"] = "A parameter, the body or a file is invalid; `errors` has the details."
        common["503"] = "Overloaded, or a part of the server does not respond: try again after `Retry-After` seconds."
        if "{env}" in path:
            common["410"] = "A rule of retention has removed the content of the version; `detail` names the nearest."
        if method != "get":
            common["507"] = (
                "The server's disk is full, and nothing was stored: try again when its operator has freed space."
            )
    if "requestBody" in operation:
        common |= {
            "400": "The body is malformed.",
            "408": "The body stopped arriving.",
            "413": "The body is too large.",
            "415": "Unsupported media type or content coding.",
        }
    for status, text in common.items():
        response = responses.get(status)
        if response is None or "HTTPValidationError" in str(response):
            responses[status] = {"description": text, "content": problem}


def _is_map(path: str) -> bool:
    return path.startswith("/maps/") or "/maps/{format}" in path


def _map_paths(paths: dict[str, Any]) -> None:
    """Add the plain routes of ``app.api.maps``, with the declared parameters of the formats."""
    long = f"{API}/environments/{{env}}/versions/{{v}}/maps/{{format}}"
    for path, summary, extra in (
        (long, "Download a map", ()),
        (long + "/{file}", "Download one file of a map", ("file",)),
        ("/maps/{env}/{format}", "Download a map by its short URL", ()),
        ("/maps/{env}/{format}/{file}", "Download one file of a map by its short URL", ("file",)),
    ):
        names = [n for n in ("env", "v", "format") if "{" + n + "}" in path] + list(extra)
        content: dict[str, Any] = {"application/octet-stream": {}, "application/zip": {}}
        describing = "The file of the map, or a zip if it has several." if not extra else "The file."
        short = " Uses the channel `production` if it exists, else `latest`." if path.startswith("/maps") else ""
        operation = {
            "tags": ["maps"],
            "summary": summary,
            "operationId": "get_" + "_".join(["map", *(["file"] if extra else []), *(["short"] if short else [])]),
            "description": f"Return {describing[0].lower()}{describing[1:]}{short} Missing layers are derived. Send "
            "`If-None-Match` with repeated requests. The header `Link` refers to the report of the map. If a format "
            "has parameters for level and name, `*` selects all: `?level=*&grid=*`. Files of other levels than the "
            "default one are below a folder named like the level (`L2/map.yaml`).",
            "parameters": [_path_parameter(name) for name in names] + _query_parameters() + _header_parameters(),
            "responses": {
                "200": {"description": describing, "headers": _HEADERS, "content": content},
                "202": {
                    "description": "The conversion takes long: follow the job at `Location`, then repeat the request.",
                    "content": {"application/json": {"schema": {"$ref": "#/components/schemas/JobOut"}}},
                },
                "206": {"description": "Part of the file"},
                "304": {"description": "Not modified: the client has this map"},
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
    """List the parameters of a format's writer."""
    return [
        {
            "name": option["name"],
            "in": "query",
            "description": _option_text(option),
            "schema": dict(option["schema"]),
        }
        for option in parameters.describe(fmt.write_options)
    ]


def _option_text(option: Mapping[str, Any]) -> str:
    """Describe an option, with its default as written in a URL."""
    text, default = option["description"].rstrip("."), option["default"]
    if default is None:
        return f"{text}."
    if isinstance(default, bool):
        default = str(default).lower()
    elif isinstance(default, tuple):
        default = ",".join(map(str, default))
    return f"{text}. Default: {f'`{default}`' if default != '' else 'empty'}."


_HEADERS: dict[str, Any] = {
    "ETag": {"schema": {"type": "string"}, "description": "Strong ETag: equal tags mean equal bytes."},
    "Fleetmap-Version": {"schema": {"type": "integer"}},
    "Fleetmap-Root": {"schema": {"type": "string"}},
    "Fleetmap-Overlays": {
        "schema": {"type": "string"},
        "description": "Digest of the closures in force that the map shows; absent with `closures=ignore`.",
    },
    "Link": {"schema": {"type": "string"}, "description": 'Report of the map, `rel="describedby"`.'},
}

_EXAMPLES = {
    "env": ("Name of the environment.", "orchard"),
    "v": ("Version: number, channel, or `latest`.", "latest"),
    "format": ("Id of the format.", "geojson"),
    "file": ("Name of the file, with its folders.", "map.geojson"),
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
    """List ``derive``, ``closures``, the options of all formats and the parameters of all derivations.

    A name that occurs several times is listed once, with its meaning for each format or derivation.
    """
    out: dict[str, dict[str, Any]] = {}
    users: dict[str, dict[str, list[str]]] = {}  # names of formats and derivations, by parameter and text
    declared = [(fmt.name, fmt.write_options) for fmt in formats.all_formats().values() if fmt.write]
    declared += [(step.name, step.parameters) for step in all_derivations().values()]
    for name, options in declared:
        for option in parameters.describe(options):
            entry = out.setdefault(
                option["name"],
                {"name": option["name"], "in": "query", "description": "", "schema": dict(option["schema"])},
            )
            if entry["schema"] != option["schema"]:
                entry["schema"] = {"type": "string"}
            users.setdefault(option["name"], {}).setdefault(_option_text(option), []).append(f"`{name}`")
    for name, texts in users.items():
        out[name]["description"] = " ".join(f"{', '.join(names)}: {text}" for text, names in texts.items())
    derive = {
        "name": "derive",
        "in": "query",
        "description": "Derive missing layers. `false`: use only stored layers.",
        "schema": {"type": "boolean", "default": True},
    }
    closures = {
        "name": "closures",
        "in": "query",
        "description": "How the map shows the closures in force. `apply`: closed edges are omitted, or marked in "
        "formats that can block an edge; `mark`: they stay in all formats, with a mark; `ignore`: closures are not "
        "shown. Default: `apply`, but `ignore` for a version number.",
        "schema": {"type": "string", "enum": list(CLOSURE_MODES)},
    }
    return [derive, closures, *(out[name] for name in sorted(out))]


def _header_parameters() -> list[dict[str, Any]]:
    texts = {
        "If-None-Match": "ETags of the client's copies.",
        "Range": "Single range of bytes.",
        "If-Range": "Apply the range only if the ETag matches.",
        "Available-Dictionary": "`:<base64 of the SHA-256>:` of a file that the client has (RFC 9842); with "
        "`Accept-Encoding: dcz` the response is a delta to it.",
    }
    return [
        {"name": name, "in": "header", "description": text, "schema": {"type": "string"}}
        for name, text in texts.items()
    ]
