"""Collections of the vector layers: nodes, edges, objects by geometry, zones, and the fence; tables of all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from starlette.concurrency import run_in_threadpool

from app.convert.recently_used import RecentlyUsed
from app.ogc.crs import CRS84, reference_systems
from app.ogc.description import operation
from app.ogc.extensions import Collection, Extension
from app.ogc.footprints import footprint_table, raster_parts, raster_title
from app.ogc.negotiation import GEOJSON, HTML, JSON, JSONFG, SCHEMA
from app.ogc.service import Link, Service, link
from app.ogc.tables import (
    CACHE,
    VECTOR_LAYERS,
    Declared,
    JsonType,
    Table,
    VectorLayer,
    build_box_table,
    build_item_table,
    build_tables,
    empty_table,
    table_key,
)
from app.store.values import Box

TITLES: Final[Mapping[str, tuple[VectorLayer, str, str]]] = {
    "nodes": ("topology", "Nodes", "Places of the network that robots drive on."),
    "edges": ("topology", "Edges", "Directed connections from `source` to `target`; a two-way street is two edges."),
    "objects-points": ("objects", "Objects: points", "Objects with a point or several."),
    "objects-lines": ("objects", "Objects: lines", "Objects with a line or several."),
    "objects-polygons": ("objects", "Objects: areas", "Objects with a polygon or several."),
    "objects-other": ("objects", "Objects: others", "Objects without geometry, or with geometries of several types."),
    "zones": ("zones", "Zones", "Areas with a kind: keepout, speed, priority …"),
    "fence": ("location", "Fence", "The area of the site."),
}
"""Collections by id: layer, title, description."""


def _declared(geometry_type: str, *names: str) -> Declared:
    text: frozenset[JsonType] = frozenset({"string"})
    return Declared(dict.fromkeys((*names, "name", "level", "part"), text), frozenset({geometry_type}))


EMPTY: Final[Mapping[str, Declared]] = {
    "nodes": _declared("Point", "kind"),
    "edges": _declared("LineString", "kind", "source", "target"),
    "objects-points": _declared("Point", "kind"),
    "objects-lines": _declared("LineString", "kind"),
    "objects-polygons": _declared("Polygon", "kind"),
    "zones": _declared("Polygon", "kind"),
    "fence": _declared("Polygon", "kind"),
}
"""What drafts say of collections without features, so that programs can add the first one."""


MAX_READ: Final = 1000

_READ: RecentlyUsed[list[int]] = RecentlyUsed(MAX_READ, lambda _: 1)
"""Number of features that were read by boxes, of layers without a table."""


async def layer_tables(service: Service, layer: VectorLayer) -> dict[str, Table]:
    """Return the tables of a layer. Concurrent requests wait for one that builds them."""
    key = table_key(service.version, layer)
    if key is None:
        return {}
    tables = CACHE.get(key)
    if tables is None:
        cache = service.services.response_cache
        content, version = service.services.store.content, service.version
        tables = await cache.join(("ogc", key), build_tables, content, version, layer)
        CACHE.put(key, tables)
    return tables


async def find_table(service: Service, name: str) -> Table | None:
    """Return the table of a collection; None if there is no such collection with items."""
    entry = TITLES.get(name)
    if entry is None:
        return await footprint_table(service, name)
    table = (await layer_tables(service, entry[0])).get(name)
    datum = service.version.datum
    if table is None and service.draft is not None and datum is not None and name in EMPTY:
        return empty_table(EMPTY[name], datum)
    return table


async def find_item_table(service: Service, name: str, item: str) -> Table | None:
    """Return a table of a collection that has a feature, if there is one; of a draft, whose content changes often, only
    with this feature.
    """
    entry = TITLES.get(name)
    key = None if entry is None else table_key(service.version, entry[0])
    if entry is None or key is None or service.version.pending is None or CACHE.get(key) is not None:
        return await find_table(service, name)
    content = service.services.store.content
    table = await run_in_threadpool(build_item_table, content, service.version, entry[0], name, item)
    return table or await find_table(service, name)


async def find_box_table(service: Service, name: str, boxes: Sequence[Box]) -> Table | None:
    """Return a table of what a collection has in a box in degrees, if that takes less than the table of all; else None.

    Which it does until the boxes asked for have together as many features as the layer: then all are worth a table.
    """
    entry = TITLES.get(name)
    key = None if entry is None else table_key(service.version, entry[0])
    if entry is None or key is None or len(boxes) != 1 or len(key[1]) != 1 or CACHE.get(key) is not None:
        return None
    read = _READ.get(key) or _READ.put(key, [0])
    if read[0] >= sum(one.count for one in service.version.parts if one.key == key[1][0][0]):
        return None
    content = service.services.store.content
    table = await run_in_threadpool(build_box_table, content, service.version, entry[0], name, boxes[0])
    read[0] += 1 if table is None else len(table)
    return table


async def vector_tables(service: Service) -> dict[str, Table]:
    """Return the tables of the vector layers, in the order of TITLES.

    Drafts have those without features, too: a version cannot be written, so empty layers would only be in the way.
    """
    if service.draft is not None:
        candidates = {name: await find_table(service, name) for name in TITLES}
        return {name: table for name, table in candidates.items() if table is not None}
    cached = {name: table for layer in VECTOR_LAYERS for name, table in (await layer_tables(service, layer)).items()}
    return {name: cached[name] for name in TITLES if name in cached}


async def tables(service: Service) -> dict[str, Table]:
    """Return the tables of all collections."""
    footprints = {name: await footprint_table(service, name) for name in raster_parts(service)}
    return await vector_tables(service) | {name: table for name, table in footprints.items() if table is not None}


def title_of(service: Service, name: str) -> str:
    """Return the title of a collection that exists."""
    return TITLES[name][1] if name in TITLES else raster_title(raster_parts(service)[name])


def item_links(service: Service, name: str) -> list[Link]:
    """Link to the items of a collection, and to what describes them."""
    title = title_of(service, name)
    return [
        link(service.url("collections", name, "items", f="json"), "items", GEOJSON, f"{title} as GeoJSON"),
        link(service.url("collections", name, "items", f="jsonfg"), "items", JSONFG, f"{title} as JSON-FG"),
        link(service.url("collections", name, "items", f="html"), "items", HTML, f"{title} as a page"),
        link(service.url("collections", name, "schema"), "http://www.opengis.net/def/rel/ogc/1.0/schema", SCHEMA,
             f"Schema of {title}"),
        link(service.url("collections", name, "queryables"), "http://www.opengis.net/def/rel/ogc/1.0/queryables",
             SCHEMA, f"Properties of {title} that filter"),
    ]  # fmt: skip


async def _collections(service: Service) -> Sequence[Collection]:
    datum = service.version.datum
    if datum is None:
        return ()
    crs = list(reference_systems(service, datum))
    shown = await vector_tables(service)
    boxes = await run_in_threadpool(lambda: {name: table.bbox for name, table in shown.items()})
    return [
        Collection(
            id=name,
            title=TITLES[name][1],
            description=f"{TITLES[name][2]} {len(table)} features.",
            bbox=boxes[name],
            members={"itemType": "feature", "crs": crs, "storageCrs": CRS84},
            links=item_links(service, name),
        )
        for name, table in shown.items()
    ]


ITEMS_PARAMETERS = ("limit", "bbox", "datetime", "bbox-crs", "crs", "cursor", "f")


async def _paths(service: Service) -> Mapping[str, object]:
    out: dict[str, object] = {}
    for name, table in (await tables(service)).items():
        base, title = f"/collections/{name}", title_of(service, name)
        suffix = name.title().replace("-", "")
        properties = await run_in_threadpool(queryables, table)
        filters = [_filter_parameter(key, sorted(types)) for key, types in properties.items()]
        item_id = {"name": "featureId", "in": "path", "required": True, "schema": {"type": "string"}}
        out[base] = operation(f"describe{suffix}", f"{title}: collection", (JSON, HTML))
        out[f"{base}/items"] = operation(
            f"get{suffix}", f"{title}: features", (GEOJSON, JSONFG, HTML), ITEMS_PARAMETERS, filters
        )
        out[f"{base}/items/{{featureId}}"] = operation(
            f"getOneOf{suffix}", f"{title}: one feature", (GEOJSON, JSONFG, HTML), ("crs", "f"), [item_id]
        )
        out[f"{base}/schema"] = operation(f"schemaOf{suffix}", f"{title}: schema", (SCHEMA, HTML))
        out[f"{base}/queryables"] = operation(f"queryablesOf{suffix}", f"{title}: filters", (SCHEMA, HTML))
    return out


RESERVED = frozenset(
    {"limit", "bbox", "bbox-crs", "crs", "datetime", "f", "cursor", "filter", "filter-lang", "filter-crs"}
)
"""Names of parameters that are no property filters, even if a property has such a name."""

SCALARS = frozenset({"string", "integer", "number", "boolean"})


def queryables(table: Table) -> dict[str, frozenset[str]]:
    """Return the properties that are parameters, with their types: those that have single values in all features."""
    return {
        name: types
        for name, types in sorted(table.types.items())
        if types <= SCALARS and name not in RESERVED and len(name) <= 200
    }


def _filter_parameter(name: str, types: Sequence[str]) -> dict[str, object]:
    schema = {"type": types[0]} if len(types) == 1 else {"oneOf": [{"type": one} for one in types]}
    return {
        "name": name,
        "in": "query",
        "required": False,
        "description": f"Only features whose property `{name}` equals this value.",
        "schema": schema,
        "style": "form",
        "explode": False,
    }


extension = Extension(
    conformance=(
        "http://www.opengis.net/spec/ogcapi-common-2/1.0/conf/collections",
        "http://www.opengis.net/spec/ogcapi-features-5/1.0/conf/schemas",
        "http://www.opengis.net/spec/ogcapi-features-5/1.0/conf/core-roles-features",
        "http://www.opengis.net/spec/ogcapi-features-5/1.0/conf/queryables",
        "http://www.opengis.net/spec/json-fg-1/1.0/conf/core",
    ),
    collections=_collections,
    paths=_paths,
)
