"""Collections of all modules."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import Path
from starlette.responses import Response

from app.api.http.schemas import component_schemas
from app.errors import NotFound
from app.model.names import did_you_mean
from app.ogc.crs import CRS84
from app.ogc.extensions import Collection, all_collections, extensions
from app.ogc.negotiation import HTML, JSON, PAGES, Representation
from app.ogc.pages import add, anchor, draw_map_picture, link_list, page, representations, respond_page, table, url_list
from app.ogc.routing import both, ogc_router
from app.ogc.schemas import OgcCollectionOut, OgcCollectionsOut
from app.ogc.service import Link, Service, link

router = ogc_router()

CollectionPath = Annotated[
    str, Path(max_length=512, description="Id of the collection, from `/collections`.", examples=["nodes"])
]


def describe(service: Service, collection: Collection) -> dict[str, Any]:
    """Build the JSON of a collection, without the links to itself."""
    out: dict[str, Any] = {"id": collection.id, "title": collection.title, "description": collection.description}
    if collection.bbox is not None:
        out["extent"] = {"spatial": {"bbox": [list(collection.bbox)], "crs": CRS84}}
    links = [*collection.links]
    links += [added for one in extensions() for added in one.collection_links(service, collection.id)]
    return {**out, **collection.members, "links": links}


def notice(service: Service) -> str | None:
    """Return why a version has no collections, and what to do; None if its content can be placed on earth."""
    if service.version.datum is None:
        return (
            f"{service.environment.name} has no datum, so that its place on earth is unknown: upload a datum.yaml, or "
            'PATCH the environment with {"datum": {"latitude": …, "longitude": …}}'
        )
    return None


def _self_links(service: Service, collection: Collection, used: str) -> list[Link]:
    return service.alternates(service.url("collections", collection.id), PAGES, used)


@both(
    router,
    "/collections",
    {JSON: {"schema": {"$ref": "#/components/schemas/OgcCollectionsOut"}}, HTML: {}},
    summary="List the OGC collections",
    openapi_extra=component_schemas(OgcCollectionsOut),
)
async def list_collections(service: Service, f: Representation = None) -> Response:  # noqa: ARG001  parsed by choose()
    """Return the collections with content, one geometry type each. Without a datum there is none."""
    used = service.choose()
    collections = await all_collections(service)
    missing = None if collections else notice(service)
    links = service.alternates(service.url("collections"), PAGES, used)
    if used == "json":
        listed = []
        for collection in collections:
            described = describe(service, collection)
            own_page = link(service.url("collections", collection.id), "self", JSON, collection.title)
            listed.append({**described, "links": [own_page, *described["links"]]})
        lists = [list(one["crs"]) for one in listed if "crs" in one]
        crs = [uri for uri in lists[0] if all(uri in one for one in lists)] if lists else [CRS84]
        extra = {} if missing is None else {"notice": missing}
        return service.respond_json({**extra, "crs": crs, "collections": listed, "links": links})
    root, body = page("Collections", [(service.title, service.landing_url)])
    if missing is not None:
        add(body, "p", missing)
    rows = [
        (anchor(one.title, service.url("collections", one.id, f="html")), one.id, one.description)
        for one in collections
    ]
    if rows:
        table(body, ("title", "id", "content"), rows)
    representations(body, links)
    return respond_page(service, root)


async def find_collection(service: Service, name: str) -> Collection:
    """Return a collection by id. Raises NotFound."""
    collections = {one.id: one for one in await all_collections(service)}
    if name not in collections:
        raise unknown_collection_error(service, name, list(collections))
    return collections[name]


def unknown_collection_error(service: Service, name: str, available: list[str]) -> NotFound:
    """Build the error for an unknown collection."""
    reason = notice(service)
    if not available and reason is not None:
        return NotFound(f"no collection {name[:80]!r}: {reason}")
    names = ", ".join(available) or "none"
    return NotFound(f"unknown collection {name[:80]!r}{did_you_mean(name, available)}; available: {names}")


@both(
    router,
    "/collections/{collection}",
    {JSON: {"schema": {"$ref": "#/components/schemas/OgcCollectionOut"}}, HTML: {}},
    summary="Describe an OGC collection",
    openapi_extra=component_schemas(OgcCollectionOut),
)
async def get_collection(
    service: Service,
    collection: CollectionPath,
    f: Representation = None,  # noqa: ARG001  parsed by choose()
) -> Response:
    """Return title, extent, coordinate reference systems and links of a collection."""
    used = service.choose()
    entry = await find_collection(service, collection)
    described = describe(service, entry)
    links = [*_self_links(service, entry, used), *described["links"]]
    if used == "json":
        return service.respond_json({**described, "links": links})
    trail = [(service.title, service.landing_url), ("Collections", service.url("collections", f="html"))]
    root, body = page(entry.title, trail)
    add(body, "p", entry.description)
    if entry.bbox is not None:
        add(body, "p", "West, south, east, north: " + ", ".join(f"{value:.7f}°" for value in entry.bbox))
        draw_map_picture(body, service, "collections", entry.id)
    link_list(body, links)
    if "crs" in entry.members:
        add(body, "h2", "Coordinate reference systems")
        url_list(body, described["crs"])
    representations(body, links)
    return respond_page(service, root)
