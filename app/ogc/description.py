"""OpenAPI 3.0 document of one environment's service, and the same as a page."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from starlette.responses import Response

from app import __version__
from app.api.http.problems import MEDIA_TYPE
from app.api.http.responses import json_bytes
from app.ogc.extensions import extensions
from app.ogc.negotiation import HTML, JSON, OPENAPI, Representation
from app.ogc.pages import add, anchor, page, respond_page, table
from app.ogc.routing import both, ogc_router
from app.ogc.service import Service

DEFAULT_LIMIT = 1000
MAX_LIMIT = 10_000
"""Number of features on a page: by default, and the maximum to which larger values are reduced."""

router = ogc_router()

PARAMETERS: Mapping[str, Mapping[str, object]] = {
    "limit": {
        "name": "limit",
        "in": "query",
        "required": False,
        "description": f"Maximum number of features on a page. Larger values count as {MAX_LIMIT}.",
        "schema": {"type": "integer", "minimum": 1, "maximum": MAX_LIMIT, "default": DEFAULT_LIMIT},
        "style": "form",
        "explode": False,
    },
    "bbox": {
        "name": "bbox",
        "in": "query",
        "required": False,
        "description": "Only features that intersect this box: minimum x, minimum y, maximum x, maximum y in "
        "`bbox-crs`, by default degrees as west, south, east, north; west > east crosses the antimeridian. With six "
        "numbers the third and the sixth are heights in metres; features without heights match all heights.",
        "schema": {"type": "array", "minItems": 4, "maxItems": 6, "items": {"type": "number"}},
        "style": "form",
        "explode": False,
    },
    "datetime": {
        "name": "datetime",
        "in": "query",
        "required": False,
        "description": "RFC 3339 time or interval. Features have no times here, so that all match.",
        "schema": {"type": "string"},
        "style": "form",
        "explode": False,
    },
    "bbox-crs": {
        "name": "bbox-crs",
        "in": "query",
        "required": False,
        "description": "URI of the CRS of `bbox`: one of the collection. Default: CRS84.",
        "schema": {"type": "string", "format": "uri"},
        "style": "form",
        "explode": False,
    },
    "crs": {
        "name": "crs",
        "in": "query",
        "required": False,
        "description": "URI of the CRS of the response: one of the collection. Default: CRS84.",
        "schema": {"type": "string", "format": "uri"},
        "style": "form",
        "explode": False,
    },
    "cursor": {
        "name": "cursor",
        "in": "query",
        "required": False,
        "description": "Start of the page: follow the link `next` of the page before.",
        "schema": {"type": "string", "maxLength": 4000},
        "style": "form",
        "explode": False,
    },
    "f": {
        "name": "f",
        "in": "query",
        "required": False,
        "description": "Representation, before the header `Accept`.",
        "schema": {"type": "string"},
        "style": "form",
        "explode": False,
    },
}  # fmt: skip
"""Parameters of the services, by name."""


def operation(
    name: str,
    summary: str,
    media_types: Iterable[str],
    parameters: Sequence[str] = ("f",),
    further: Sequence[Mapping[str, object]] = (),
) -> dict[str, object]:
    """Build the path item of a ``GET``. parameters: names in PARAMETERS; further: parameters of this path only."""
    problem = {"description": "Error", "content": {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}}
    content = {media: {"schema": {"type": "string"} if media == HTML else {"type": "object"}} for media in media_types}
    references = [{"$ref": f"#/components/parameters/{parameter}"} for parameter in parameters]
    responses = {"200": {"description": "OK", "content": content}, "default": problem}
    for status in ("400", "401", "403", "404", "406", "500"):
        responses[status] = problem
    get = {
        "operationId": name,
        "summary": summary,
        "tags": ["data"],
        "parameters": [*references, *further],
        "responses": responses,
    }
    return {"get": get}


async def openapi_document(service: Service) -> dict[str, Any]:
    """Build the OpenAPI document of a service."""
    paths: dict[str, object] = {
        "/": operation("getLandingPage", "Landing page", (JSON, HTML)),
        "/conformance": operation("getConformance", "Conformance classes", (JSON, HTML)),
        "/api": operation("getApi", "This document", (OPENAPI, HTML)),
        "/collections": operation("getCollections", "Collections", (JSON, HTML)),
    }
    for one in extensions():
        for path, item in (await one.paths(service)).items():
            before = paths.get(path)  # another module has other methods of the same path
            paths[path] = {**before, **item} if isinstance(before, Mapping) and isinstance(item, Mapping) else item
    text = {"type": "string"}
    problem = {
        "type": "object",
        "required": ["type", "title", "status", "detail"],
        "properties": {"type": text, "title": text, "status": {"type": "integer"}, "detail": text,
                       "errors": {"type": "array", "items": {"type": "object"}}},
    }  # fmt: skip
    return {
        "openapi": "3.0.3",
        "info": {"title": service.title, "description": service.description, "version": __version__},
        "servers": [{"url": service.address}],
        "tags": [{"name": "data"}],
        "security": [{"basic": []}, {"token": []}],
        "paths": paths,
        "components": {
            "parameters": PARAMETERS,
            "schemas": {"Problem": problem},
            "securitySchemes": {
                "basic": {"type": "http", "scheme": "basic", "description": "Any user name; the token as password."},
                "token": {"type": "http", "scheme": "bearer"},
            },
        },
    }


@both(
    router,
    "/api",
    {OPENAPI: {"schema": {"type": "object"}}, HTML: {}},
    summary="Get the OpenAPI document of an OGC service",
)
async def get_api(service: Service, f: Representation = None) -> Response:  # noqa: ARG001  parsed by choose()
    """Return the OpenAPI 3.0 document of this environment's OGC service."""
    if service.choose({"json": OPENAPI, "html": HTML}) == "html":
        return await _page(service)
    return service.respond(json_bytes(await openapi_document(service)), OPENAPI)


@both(router, "/api.html", {HTML: {}}, summary="Describe an OGC service")
async def get_api_page(service: Service) -> Response:
    """Return the addresses of this environment's OGC service with their parameters, as a page."""
    return await _page(service)


async def _page(service: Service) -> Response:
    document = await openapi_document(service)
    root, body = page("Addresses", [(service.title, service.landing_url)])
    add(body, "p", "Every address takes the parameters beside it. The OpenAPI document is at ")
    paragraph = body[-1]
    add(paragraph, "a", service.url("api"), href=service.url("api"))
    rows = []
    for path, item in document["paths"].items():
        get = item["get"]
        names = [parameter.get("name") or parameter["$ref"].rpartition("/")[2] for parameter in get["parameters"]]
        cell = path if "{" in path else anchor(path, service.address + path)
        rows.append((cell, get["summary"], ", ".join(names)))
    table(body, ("address", "content", "parameters"), rows)
    add(body, "h2", "Parameters")
    table(body, ("name", "meaning"), [(name, item["description"]) for name, item in PARAMETERS.items()])
    return respond_page(service, root)
