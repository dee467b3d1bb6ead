"""Features of a collection: pages, single features, schema and queryables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from hashlib import sha256
from typing import Annotated, Any, cast

import numpy as np
import orjson
import shapely
from fastapi import Path
from numpy.typing import NDArray
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from app.api.http.features import CONFORMS, geometries_as_geojson, page_of
from app.api.http.schemas import component_schemas
from app.errors import NotFound
from app.model.frame import Datum
from app.model.names import did_you_mean
from app.ogc import item_pages
from app.ogc.collections import CollectionPath, unknown_collection_error
from app.ogc.crs import CRS84, ReferenceSystem, local_uri, parse_crs, reference_systems
from app.ogc.examples import example_page
from app.ogc.item_query import ItemQuery, invalid, parse_bbox, parse_items_query, select_rows
from app.ogc.negotiation import GEOJSON, HTML, JSONFG, PAGES, SCHEMA, Representation
from app.ogc.routing import both, ogc_router
from app.ogc.schemas import OgcFeatureOut, OgcFeaturesOut
from app.ogc.service import Link, Service, etag_of, link
from app.ogc.tables import Table
from app.ogc.vector import RESERVED, TITLES, find_box_table, find_item_table, find_table, queryables, tables, title_of

ITEMS = {"json": GEOJSON, "jsonfg": JSONFG, "html": HTML}

router = ogc_router()

FeaturePath = Annotated[
    str, Path(max_length=2000, description="Id of the feature, percent-encoded.", examples=["Dock1"])
]


@dataclass(frozen=True, slots=True)
class Output:
    """Representation and CRS of features. place: CRS of JSON-FG's ``place``, None without one."""

    used: str
    crs: ReferenceSystem
    place: ReferenceSystem | None

    @property
    def content_crs(self) -> str:
        """Return the value of the header ``Content-Crs``."""
        return f"<{(self.place or self.crs).uri}>"


def _output(service: Service, systems: Mapping[str, ReferenceSystem], crs: ReferenceSystem | None) -> Output:
    """Choose representation and CRS. JSON-FG has local metres in ``place`` unless another CRS is requested."""
    used = service.choose(ITEMS)
    if used != "jsonfg":
        return Output(used, crs or systems[CRS84], None)
    chosen = systems[local_uri(service)] if crs is None else crs
    return Output(used, systems[CRS84], None if chosen.kind == "crs84" else chosen)


async def _table(service: Service, collection: str) -> Table:
    """Return the table of a collection. Raises NotFound."""
    table = await find_table(service, collection)
    if table is None:
        raise unknown_collection_error(service, collection, list(await tables(service)))
    return table


async def _box_table(service: Service, collection: str) -> Table | None:
    """Return a table of the box that is asked for, if there is one and it is enough. Raises Invalid."""
    given, datum = service.request.query_params, service.version.datum
    if datum is None or "bbox" not in given or collection not in TITLES or not RESERVED.issuperset(given):
        return None
    systems = reference_systems(service, datum)
    crs = parse_crs(given.get("bbox-crs", CRS84), systems, "bbox-crs")
    box, _ = parse_bbox(given["bbox"], crs)
    return await find_box_table(service, collection, crs.box_in_wgs84(box, datum, "bbox"))


# --- features as text ---


def feature_texts(table: Table, rows: NDArray[np.intp], output: Output, collection: str) -> list[bytes]:
    """Write features as JSON."""
    texts = table.texts(rows.tolist())
    other = output.place or (output.crs if output.crs.kind != "crs84" else None)
    shapes: list[bytes] = []
    if other is not None:
        written = geometries_as_geojson(_finite(table.in_crs(rows, other)), other.digits)
        shapes = [b"null" if shape is None else bytes(orjson.dumps(shape)) for shape in written]
    if output.used == "jsonfg":
        kind = b'"featureType":' + orjson.dumps(collection) + b',"time":null,"place":'
        places = shapes or [b"null"] * len(texts)
        heads = [kind + place + b"," for place in places]
        at = len(b'{"type":"Feature",')
        return [text[:at] + head + text[at:] for (text, _, _), head in zip(texts, heads, strict=True)]
    if not shapes:
        return [text for text, _, _ in texts]
    return [text[:a] + shape + text[b:] for (text, a, b), shape in zip(texts, shapes, strict=True)]


def _finite(geometry: NDArray[np.object_]) -> NDArray[np.object_]:
    """Replace geometries that the CRS cannot represent by empty ones, which are written as null."""
    bounds = shapely.bounds(geometry)
    lost = np.isinf(bounds).any(axis=1)
    if lost.any():
        geometry = geometry.copy()
        geometry[lost] = shapely.GeometryCollection()
    return geometry


def _fg_members(output: Output, collection: str, datum: Datum) -> dict[str, Any]:
    """Return the members that JSON-FG adds to a document; the datum says what the local frame is."""
    if output.used != "jsonfg":
        return {}
    reference = {} if output.place is None else {"coordRefSys": output.place.uri}
    local = output.place is not None and output.place.kind == "local"
    origin = {"datum": datum.as_dict()} if local else {}
    return {"conformsTo": CONFORMS, "featureType": collection, **reference, **origin}


@dataclass(frozen=True, slots=True)
class ItemsPage:
    """Page of a query. cursor: of the next page, None for the last one."""

    rows: NDArray[np.intp]
    matched: int
    cursor: str | None


def find_page(table: Table, query: ItemQuery) -> ItemsPage:
    """Find the rows of a page."""
    rows = select_rows(table, query)
    page = page_of(cast("Sequence[int]", rows), table.position, query.limit, query.cursor)
    return ItemsPage(rows[np.array(page.indices, np.intp)], len(rows), page.members.get("next"))


def _page_links(service: Service, collection: str, output: Output, cursor: str | None) -> list[Link]:
    """Link a page to itself, its other representations, the next page and its collection."""
    pairs = [(k, v) for k, v in service.request.query_params.multi_items() if k != "f"]
    base = service.url("collections", collection, "items", pairs=pairs)
    links = service.alternates(base, ITEMS, output.used)
    if cursor is not None:
        forward = [*((k, v) for k, v in pairs if k != "cursor"), ("cursor", cursor), ("f", output.used)]
        url = service.url("collections", collection, "items", pairs=forward)
        links.append(link(url, "next", ITEMS[output.used], "next page"))
    title = title_of(service, collection)
    links.append(link(service.url("collections", collection), "collection", PAGES["json"], title))
    return links


def _write_page(table: Table, page: ItemsPage, output: Output, collection: str, links: list[Link]) -> bytes:
    texts = feature_texts(table, page.rows, output, collection)
    members = {
        **_fg_members(output, collection, table.datum),
        "numberMatched": page.matched,
        "numberReturned": len(texts),
        "timeStamp": datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z"),
        "links": links,
    }
    head = b'{"type":"FeatureCollection",' + orjson.dumps(members)[1:-1] + b',"features":['
    return head + b",".join(texts) + b"]}"


# --- routes ---

_PARAMETERS = [
    {"name": "limit", "in": "query", "description": "Maximum number of features on a page: 1 to 10000; larger values "
     "count as 10000.", "schema": {"type": "integer", "minimum": 1, "default": 1000}},
    {"name": "bbox", "in": "query", "description": "Only features that intersect this box: 4 numbers, or 6 with "
     "heights, in `bbox-crs`.", "schema": {"type": "string"}},
    {"name": "bbox-crs", "in": "query", "description": "URI of the CRS of `bbox`. Default: CRS84.",
     "schema": {"type": "string"}},
    {"name": "crs", "in": "query", "description": "URI of the CRS of the response: one that the collection lists. "
     "Default: CRS84.", "schema": {"type": "string"}},
    {"name": "datetime", "in": "query", "description": "RFC 3339 time or interval. Features have no times, so that "
     "all match.", "schema": {"type": "string"}},
    {"name": "cursor", "in": "query", "description": "Start of the page: follow the link `next`.",
     "schema": {"type": "string"}},
]  # fmt: skip


@both(
    router,
    "/collections/{collection}/items",
    {
        GEOJSON: {"schema": {"$ref": "#/components/schemas/OgcFeaturesOut"}},
        JSONFG: {"schema": {"$ref": "#/components/schemas/OgcFeaturesOut"}},
        HTML: {},
    },
    summary="List the features of an OGC collection",
    openapi_extra={"x-free-query": True, "parameters": _PARAMETERS, **component_schemas(OgcFeaturesOut)},
)
async def list_items(service: Service, collection: CollectionPath, f: Representation = None) -> Response:  # noqa: ARG001
    """Return a page of features: GeoJSON, JSON-FG with local metres in `place` (`f=jsonfg`), or a page.

    Further query parameters are the properties that `/queryables` lists: only features with equal values.
    """
    table = await _box_table(service, collection) or await _table(service, collection)
    example = example_page(service, table)
    if example is not None:
        return example
    systems = reference_systems(service, table.datum)
    pairs = service.request.query_params.multi_items()
    if any(name not in RESERVED for name, _ in pairs):
        await run_in_threadpool(queryables, table)
    query = parse_items_query(pairs, table, systems)
    output = _output(service, systems, query.crs)
    page = find_page(table, query) if query.is_plain else await run_in_threadpool(find_page, table, query)
    if query.is_plain and output.used == "json" and table.is_written(page.rows.tolist()):
        return _respond_page(service, collection, table, page, output)  # takes less than a switch of threads
    return await run_in_threadpool(_respond_page, service, collection, table, page, output)


def _respond_page(service: Service, collection: str, table: Table, page: ItemsPage, output: Output) -> Response:
    links = _page_links(service, collection, output, page.cursor)
    if output.used == "html":
        shown = item_pages.items_page(service, collection, table, page.rows, page.matched, links)
        return item_pages.respond_page(service, shown)
    body = _write_page(table, page, output, collection, links)
    seed = repr((service.version.root, service.address, str(service.request.url.query), output.used, collection))
    headers = {"content-crs": output.content_crs}
    for one in links:
        if one["rel"] == "next":
            headers["link"] = f'<{one["href"]}>; rel="next"; type="{one["type"]}"'
    etag = f'W/"{sha256(seed.encode()).hexdigest()[:32]}"'  # weak: timeStamp is that of the response
    return service.respond(body, ITEMS[output.used], headers, etag)


@both(
    router,
    "/collections/{collection}/items/{feature:path}",
    {
        GEOJSON: {"schema": {"$ref": "#/components/schemas/OgcFeatureOut"}},
        JSONFG: {"schema": {"$ref": "#/components/schemas/OgcFeatureOut"}},
        HTML: {},
    },
    summary="Get a feature of an OGC collection",
    openapi_extra={
        "x-free-query": True,
        "parameters": [one for one in _PARAMETERS if one["name"] == "crs"],
        **component_schemas(OgcFeatureOut),
    },
)
async def get_item(
    service: Service,
    collection: CollectionPath,
    feature: FeaturePath,
    f: Representation = None,  # noqa: ARG001  parsed by choose()
) -> Response:
    """Return one feature with links."""
    table = await find_item_table(service, collection, feature) or await _table(service, collection)
    systems = reference_systems(service, table.datum)
    given = service.request.query_params
    unknown = sorted(set(given) - {"f", "crs"})
    if unknown:
        near = did_you_mean(unknown[0], ("f", "crs"))
        raise invalid(
            unknown[0][:80], "is unknown", f"unknown query parameter {unknown[0][:80]!r}{near}; accepted: crs, f"
        )
    output = _output(service, systems, parse_crs(given["crs"], systems, "crs") if "crs" in given else None)
    row = await _row(service, collection, table, feature)
    links = _item_links(service, collection, feature, output, [("crs", given["crs"])] if "crs" in given else [])
    if output.used == "html":
        return item_pages.respond_page(service, item_pages.item_page(service, collection, table, row, links))
    body = await run_in_threadpool(_write_item, table, row, output, collection, links)
    return service.respond(body, ITEMS[output.used], {"content-crs": output.content_crs})


async def item_etag(service: Service, collection: str, feature: str) -> str:
    """Return the ETag of a feature's GeoJSON in CRS84, whatever the request accepts. Raises NotFound."""
    table = await find_item_table(service, collection, feature) or await _table(service, collection)
    output = Output("json", reference_systems(service, table.datum)[CRS84], None)
    row = await _row(service, collection, table, feature)
    links = _item_links(service, collection, feature, output, [])
    return etag_of(await run_in_threadpool(_write_item, table, row, output, collection, links))


async def _row(service: Service, collection: str, table: Table, feature: str) -> int:
    row = await run_in_threadpool(table.row_of, feature)
    if row is None:
        listed = service.url("collections", collection, "items")
        raise NotFound(f"{collection} has no feature {feature[:80]!r}: list them at {listed}")
    return row


def _item_links(
    service: Service, collection: str, feature: str, output: Output, pairs: Sequence[tuple[str, str]]
) -> list[Link]:
    """Link a feature to itself, its other representations and its collection."""
    url = service.url("collections", collection, "items", feature, pairs=pairs)
    links = service.alternates(url, ITEMS, output.used)
    title = title_of(service, collection)
    return [*links, link(service.url("collections", collection), "collection", PAGES["json"], title)]


def _write_item(table: Table, row: int, output: Output, collection: str, links: list[Link]) -> bytes:
    (text,) = feature_texts(table, np.array([row]), output, collection)
    members = {**_fg_members(output, collection, table.datum), "links": links}
    if output.used == "jsonfg":
        members.pop("featureType")  # it is a member of the feature itself
    return text[:-1] + b"," + orjson.dumps(members)[1:]


# --- schemas ---


MEASURES = frozenset({"speed_limit", "width", "height", "base", "value"})
"""Properties that are numbers, even while all their values are whole."""


def _property_schema(name: str, types: frozenset[str]) -> dict[str, Any]:
    if name in MEASURES and "integer" in types:
        types |= {"number"}
    kinds = sorted(types - {"integer"} if "number" in types else types)
    return {"type": kinds[0] if len(kinds) == 1 else kinds}


GEOMETRY_FORMATS = {
    frozenset({"Point"}): "geometry-point",
    frozenset({"MultiPoint"}): "geometry-multipoint",
    frozenset({"Point", "MultiPoint"}): "geometry-point-or-multipoint",
    frozenset({"LineString"}): "geometry-linestring",
    frozenset({"MultiLineString"}): "geometry-multilinestring",
    frozenset({"LineString", "MultiLineString"}): "geometry-linestring-or-multilinestring",
    frozenset({"Polygon"}): "geometry-polygon",
    frozenset({"MultiPolygon"}): "geometry-multipolygon",
    frozenset({"Polygon", "MultiPolygon"}): "geometry-polygon-or-multipolygon",
}


def collection_schema(service: Service, collection: str, table: Table) -> dict[str, Any]:
    """Build the schema of a collection's features (Part 5)."""
    listed: dict[str, Any] = {
        "id": {"type": "string", "x-ogc-role": "id", "x-ogc-propertySeq": 0, "readOnly": True},
        "geometry": {
            "x-ogc-role": "primary-geometry",
            "format": GEOMETRY_FORMATS.get(table.geometry_types, "geometry-any"),
            "x-ogc-propertySeq": 1,
        },
    }
    for number, (name, types) in enumerate(table.types.items(), start=2):
        if name not in listed:
            listed[name] = {"title": name, **_property_schema(name, types), "x-ogc-propertySeq": number}
    return _schema(service, collection, "schema", listed)  # features may have others, too


def queryables_schema(service: Service, collection: str, table: Table) -> dict[str, Any]:
    """Build the schema of the properties that filter."""
    listed: dict[str, Any] = {
        "geometry": {
            "x-ogc-role": "primary-geometry",
            "format": GEOMETRY_FORMATS.get(table.geometry_types, "geometry-any"),
        }
    }
    for name, types in queryables(table).items():
        listed.setdefault(name, {"title": name, **_property_schema(name, types)})
    return {**_schema(service, collection, "queryables", listed), "additionalProperties": False}


def _schema(service: Service, collection: str, page: str, listed: dict[str, Any]) -> dict[str, Any]:
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$id": service.url("collections", collection, page),
        "type": "object",
        "title": title_of(service, collection),
        "properties": listed,
    }


async def _respond_schema(service: Service, collection: str, name: str) -> Response:
    offers = {"json": SCHEMA, "html": HTML}
    used = service.choose(offers)
    table = await _table(service, collection)
    build = collection_schema if name == "schema" else queryables_schema
    schema = await run_in_threadpool(build, service, collection, table)
    if used == "json":
        return service.respond(orjson.dumps(schema), SCHEMA)
    links = service.alternates(service.url("collections", collection, name), offers, used)
    return item_pages.respond_page(service, item_pages.schema_page(service, collection, schema, name, links))


@both(
    router,
    "/collections/{collection}/schema",
    {SCHEMA: {"schema": {"type": "object"}}, HTML: {}},
    summary="Get the schema of an OGC collection",
)
async def get_schema(service: Service, collection: CollectionPath, f: Representation = None) -> Response:  # noqa: ARG001
    """Return the properties of a collection's features with their types, as JSON Schema with `x-ogc-role`."""
    return await _respond_schema(service, collection, "schema")


@both(
    router,
    "/collections/{collection}/queryables",
    {SCHEMA: {"schema": {"type": "object"}}, HTML: {}},
    summary="List the filters of an OGC collection",
)
async def get_queryables(service: Service, collection: CollectionPath, f: Representation = None) -> Response:  # noqa: ARG001
    """Return the properties that are parameters of `items`, as JSON Schema."""
    return await _respond_schema(service, collection, "queryables")
