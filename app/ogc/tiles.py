"""Tilesets (OGC API - Tiles): vector tiles and map tiles of the site and of each collection."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

from fastapi import Path
from pydantic import BaseModel, ConfigDict, Field
from pydantic.json_schema import SkipJsonSchema
from starlette.responses import Response

from app.api.http.caching import none_match
from app.api.http.features import omittable
from app.api.http.schemas import component_schemas
from app.api.http.tile_address import LevelOfDetail
from app.convert.views import View, view_key
from app.errors import NotFound
from app.model.geodesy import local_frame
from app.ogc.collections import CollectionPath
from app.ogc.crs import CRS84
from app.ogc.description import operation
from app.ogc.extensions import Collection, Extension, all_collections
from app.ogc.extent import site_box
from app.ogc.footprints import raster_parts
from app.ogc.negotiation import HTML, JSON, PAGES, Representation
from app.ogc.pages import add, anchor, link_list, linked, page, representations, respond_page, table
from app.ogc.rasters import check_collection, content_of
from app.ogc.routing import both, ogc_router
from app.ogc.schemas import OgcLinkOut
from app.ogc.service import Link, Service, link
from app.ogc.tables import VECTOR_LAYERS, Table, TableKey, table_key
from app.ogc.tile_matrix_sets import TILE, SetPath, TileMatrixSet, available_sets, find_set, uri_of
from app.ogc.vector import TITLES, layer_tables
from app.ogc.vector_tiles import TILES, tile_etag, vector_tile
from app.store.values import Box

MVT = "application/vnd.mapbox-vector-tile"
PNG = "image/png"
REL = "http://www.opengis.net/def/rel/ogc/1.0/"
CONFORMANCE = "http://www.opengis.net/spec/ogcapi-tiles-1/1.0/conf/"

Kind = Literal["vector", "map"]
FOLDER: Mapping[Kind, tuple[str, ...]] = {"vector": ("tiles",), "map": ("map", "tiles")}
MEDIA: Mapping[Kind, str] = {"vector": MVT, "map": PNG}
WORDS: Mapping[Kind, str] = {"vector": "Vector tiles", "map": "Map tiles"}

MAX_INDEX = 2**25
RowPath = Annotated[
    int, Path(ge=0, lt=MAX_INDEX, description="Row of the tile, 0 in the north or on top.", examples=[0])
]
ColumnPath = Annotated[int, Path(ge=0, lt=MAX_INDEX, description="Column of the tile, 0 on the left.", examples=[0])]

router = ogc_router()


class OgcTemplatedLinkOut(OgcLinkOut):
    """Link, perhaps with variables."""

    templated: Literal[True] | SkipJsonSchema[None] = omittable("Present if `href` has variables in braces.")


class OgcTileSetItemOut(BaseModel):
    """Entry of a list of tilesets."""

    model_config = ConfigDict(populate_by_name=True)

    title: str
    data_type: Kind = Field(alias="dataType")
    crs: str
    tile_matrix_set_uri: str = Field(alias="tileMatrixSetURI")
    links: list[OgcTemplatedLinkOut]


class OgcTileSetsOut(BaseModel):
    """Tilesets of a site or a collection."""

    tilesets: list[OgcTileSetItemOut]
    links: list[OgcLinkOut]


class OgcTileLimitsOut(BaseModel):
    """Tiles of a level that may have content."""

    model_config = ConfigDict(populate_by_name=True)

    tile_matrix: str = Field(alias="tileMatrix")
    min_tile_row: int = Field(alias="minTileRow")
    max_tile_row: int = Field(alias="maxTileRow")
    min_tile_col: int = Field(alias="minTileCol")
    max_tile_col: int = Field(alias="maxTileCol")


class OgcTileBoxOut(BaseModel):
    """Box around the content."""

    model_config = ConfigDict(populate_by_name=True)

    lower_left: tuple[float, float] = Field(alias="lowerLeft")
    upper_right: tuple[float, float] = Field(alias="upperRight")
    crs: str


class OgcTileLayerOut(BaseModel):
    """Collection in the tiles."""

    model_config = ConfigDict(populate_by_name=True)

    id: str
    title: str
    data_type: Kind = Field(alias="dataType")


class OgcTileSetOut(OgcTileSetItemOut):
    """Tileset."""

    tile_matrix_set_limits: list[OgcTileLimitsOut] | SkipJsonSchema[None] = omittable(
        "Omitted if nothing has a position.", "tileMatrixSetLimits"
    )
    bounding_box: OgcTileBoxOut | SkipJsonSchema[None] = omittable("Omitted if nothing has a position.", "boundingBox")
    layers: list[OgcTileLayerOut]


# --- descriptions ---


def _parts(kind: Kind, collection: str | None) -> tuple[str, ...]:
    return (*(("collections", collection) if collection is not None else ()), *FOLDER[kind])


def tileset_url(service: Service, kind: Kind, collection: str | None, tms: str) -> str:
    """Return the absolute URL of a tileset."""
    return service.url(*_parts(kind, collection), tms)


def tile_template(service: Service, kind: Kind, collection: str | None, tms: str) -> str:
    """Return the absolute URL of tiles with the variables ``{tileMatrix}``, ``{tileRow}`` and ``{tileCol}``."""
    return tileset_url(service, kind, collection, tms) + "/{tileMatrix}/{tileRow}/{tileCol}"


def _item(service: Service, kind: Kind, collection: str | None, title: str, one: TileMatrixSet) -> dict[str, Any]:
    url = tileset_url(service, kind, collection, one.id)
    template = {
        **link(tile_template(service, kind, collection, one.id), "item", MEDIA[kind], "Tiles"),
        "templated": True,
    }
    return {
        "title": f"{title}: {WORDS[kind].lower()}, {one.title}",
        "dataType": kind,
        "crs": one.crs(service),
        "tileMatrixSetURI": uri_of(service, one),
        "links": [
            link(url, "self", JSON, "This tileset"),
            link(service.url("tileMatrixSets", one.id), f"{REL}tiling-scheme", JSON, one.title),
            {**template, "templated": True},
        ],
    }


async def _listed(service: Service, kind: Kind, collection: str | None) -> tuple[str, Box | None, list[Collection]]:
    """Return title, box and collections of a tileset. Raises NotFound if there is none."""
    await check_collection(service, collection)
    entries = await all_collections(service)
    if collection is not None:
        (entry,) = [one for one in entries if one.id == collection]
        if kind == "vector" and collection not in TITLES:
            raise _no_vector_tiles_error(collection)
        return entry.title, entry.bbox, [entry]
    shown = [one for one in entries if kind == "map" or one.id in TITLES]
    return service.title, await site_box(service), shown


def _no_vector_tiles_error(collection: str) -> NotFound:
    return NotFound(
        f"collection {collection} has no vector tiles: use its map tiles (/collections/{collection}/map/tiles)"
    )


async def _tilesets(service: Service, kind: Kind, collection: str | None) -> Response:
    used = service.choose()
    title, _, _ = await _listed(service, kind, collection)
    sets = available_sets(service)
    links = service.alternates(service.url(*_parts(kind, collection)), PAGES, used)
    if used == "json":
        items = [_item(service, kind, collection, title, one) for one in sets]
        return service.respond_json({"tilesets": items, "links": links})
    root, body = page(f"{WORDS[kind]} of {title}", [(service.title, service.landing_url)])
    rows = [
        (anchor(one.title, tileset_url(service, kind, collection, one.id) + "?f=html"), linked(one.crs(service)))
        for one in sets
    ]
    table(body, ("tile matrix set", "CRS"), rows)
    representations(body, links)
    return respond_page(service, root)


async def _tileset(service: Service, kind: Kind, collection: str | None, tms: str) -> Response:
    used = service.choose()
    title, box, entries = await _listed(service, kind, collection)
    one = find_set(service, tms)
    document = _item(service, kind, collection, title, one)
    alternates = service.alternates(tileset_url(service, kind, collection, tms), PAGES, used)
    document["links"] = [*alternates, *document["links"][1:]]
    if box is not None:
        document["tileMatrixSetLimits"] = _limits(service, one, box)
        document["boundingBox"] = {"lowerLeft": [box[0], box[1]], "upperRight": [box[2], box[3]], "crs": CRS84}
    document["layers"] = [{"id": entry.id, "title": entry.title, "dataType": kind} for entry in entries]
    if used == "json":
        return service.respond_json(document)
    root, body = page(document["title"], [(service.title, service.landing_url)])
    line = add(body, "p", "Address of a tile: ")
    add(line, "code", tile_template(service, kind, collection, tms))
    link_list(body, [one_link for one_link in document["links"] if "templated" not in one_link])
    representations(body, alternates)
    return respond_page(service, root)


def _limits(service: Service, one: TileMatrixSet, box: Box) -> list[dict[str, Any]]:
    assert service.version.datum is not None
    names = ("minTileRow", "maxTileRow", "minTileCol", "maxTileCol")
    limits = one.limits(box, local_frame(service.version.datum))
    return [{"tileMatrix": str(z), **dict(zip(names, row, strict=True))} for z, row in enumerate(limits)]


# --- tiles ---


async def _tile(
    service: Service, kind: Kind, collection: str | None, tms: str, address: tuple[int, int, int]
) -> Response:
    one = find_set(service, tms)
    one.check(*address)
    await check_collection(service, collection)
    if kind == "map":
        return await _map_tile(service, collection, one, address)
    return await _vector_tile(service, collection, one, address)


async def _map_tile(
    service: Service, collection: str | None, one: TileMatrixSet, address: tuple[int, int, int]
) -> Response:
    content = content_of(service, collection)
    view = View(one.code, one.box(*address), TILE, TILE)
    key = view_key(service.version, content, view, None)
    etag = f'"{key[:32]}"'
    if none_match(service.request.headers.get("if-none-match"), etag):
        return service.respond(b"", PNG, etag=etag)
    views, join = service.services.views, service.services.response_cache.join
    png = await join(("view", key), views.png, service.version, content, view, None)
    return service.respond(png, PNG, etag=etag)


async def _vector_tile(
    service: Service, collection: str | None, tiling: TileMatrixSet, address: tuple[int, int, int]
) -> Response:
    if collection is not None and collection not in TITLES:
        raise _no_vector_tiles_error(collection)
    layers = VECTOR_LAYERS if collection is None else (TITLES[collection][0],)
    keys = {name: key for name in layers if (key := table_key(service.version, name)) is not None}
    etag = tile_etag(keys, collection, tiling, address)
    if none_match(service.request.headers.get("if-none-match"), etag):
        return service.respond(b"", MVT, etag=etag)
    data = TILES.get(etag)
    if data is None:
        chosen: dict[str, tuple[TableKey, Table]] = {}
        for name, key in keys.items():
            by_id = await layer_tables(service, name)
            chosen |= {one: (key, rows) for one, rows in by_id.items() if collection in (None, one)}
        join = service.services.response_cache.join
        data = TILES.put(etag, await join(("mvt", etag), vector_tile, chosen, tiling, *address))
    response = service.respond(data, MVT, etag=etag)
    if not data:
        response.status_code = 204
        del response.headers["content-length"], response.headers["content-type"]
    return response


# --- routes ---

_LIST = {JSON: {"schema": {"$ref": "#/components/schemas/OgcTileSetsOut"}}, HTML: {}}
_SET = {JSON: {"schema": {"$ref": "#/components/schemas/OgcTileSetOut"}}, HTML: {}}


def _register(kind: Kind, word: str) -> None:
    """Add the routes of one kind of tiles: of the site and of each collection."""
    path = "/" + "/".join(FOLDER[kind])
    shown = {MEDIA[kind]: {"schema": {"type": "string", "format": "binary"}}}

    async def list_tilesets(service: Service, f: Representation = None) -> Response:  # noqa: ARG001
        """Return the tilesets of the site: one for each tile matrix set."""
        return await _tilesets(service, kind, None)

    async def get_tileset(service: Service, tms: SetPath, f: Representation = None) -> Response:  # noqa: ARG001
        """Return CRS, address of tiles, limits and layers of a tileset."""
        return await _tileset(service, kind, None, tms)

    async def get_tile(service: Service, tms: SetPath, z: LevelOfDetail, row: RowPath, col: ColumnPath) -> Response:
        """Return a tile of the site; 204 for a vector tile without content. Tiles of numbered versions never change."""
        return await _tile(service, kind, None, tms, (z, row, col))

    async def list_collection_tilesets(
        service: Service,
        collection: CollectionPath,
        f: Representation = None,  # noqa: ARG001
    ) -> Response:
        """Return the tilesets of a collection: one for each tile matrix set."""
        return await _tilesets(service, kind, collection)

    async def get_collection_tileset(
        service: Service,
        collection: CollectionPath,
        tms: SetPath,
        f: Representation = None,  # noqa: ARG001
    ) -> Response:
        """Return CRS, address of tiles, limits and layers of a collection's tileset."""
        return await _tileset(service, kind, collection, tms)

    async def get_collection_tile(
        service: Service, collection: CollectionPath, tms: SetPath, z: LevelOfDetail, row: RowPath, col: ColumnPath
    ) -> Response:
        """Return a tile of a collection; 204 for a vector tile without content."""
        return await _tile(service, kind, collection, tms, (z, row, col))

    lists, sets = component_schemas(OgcTileSetsOut), component_schemas(OgcTileSetOut)
    for prefix, of, (listing, describing, getting) in (
        ("", "the site", (list_tilesets, get_tileset, get_tile)),
        (
            "/collections/{collection}",
            "a collection",
            (list_collection_tilesets, get_collection_tileset, get_collection_tile),
        ),
    ):
        for handler in (listing, describing, getting):
            handler.__name__ = handler.__name__.replace("tile", f"{kind}_tile", 1)
        both(router, prefix + path, _LIST, summary=f"List the {word} tilesets of {of}", openapi_extra=lists)(listing)
        both(router, f"{prefix}{path}/{{tms}}", _SET, summary=f"Describe a {word} tileset of {of}", openapi_extra=sets)(
            describing
        )
        both(router, f"{prefix}{path}/{{tms}}/{{z}}/{{row}}/{{col}}", shown, summary=f"Get a {word} tile of {of}")(
            getting
        )


_register("vector", "vector")
_register("map", "map")


def _landing_links(service: Service) -> list[Link]:
    if service.version.datum is None:
        return []
    return [link(service.url(*FOLDER[kind]), f"{REL}tilesets-{kind}", JSON, WORDS[kind]) for kind in FOLDER]


def _collection_links(service: Service, collection: str) -> Sequence[Link]:
    kinds: tuple[Kind, ...] = ("vector", "map") if collection in TITLES else ("map",)
    return [link(service.url(*_parts(kind, collection)), f"{REL}tilesets-{kind}", JSON, WORDS[kind]) for kind in kinds]


async def _paths(service: Service) -> Mapping[str, object]:
    if service.version.datum is None:
        return {}
    out: dict[str, object] = {
        "/tileMatrixSets": operation("getTileMatrixSetsList", "Tile matrix sets", (JSON, HTML)),
        "/tileMatrixSets/{tileMatrixSetId}": operation(
            "getTileMatrixSet", "Tile matrix set", (JSON, HTML), ("f",), [_SET_ID]
        ),
    }
    names = [*TITLES, *raster_parts(service)]
    existing = {one.id for one in await all_collections(service)}
    for collection in (None, *(name for name in names if name in existing)):
        for kind in FOLDER:
            if kind == "map" or collection is None or collection in TITLES:
                out |= _tile_paths(kind, collection)
    return out


_SET_ID = {"name": "tileMatrixSetId", "in": "path", "required": True,
           "schema": {"type": "string", "enum": ["WebMercatorQuad", "local"]}}  # fmt: skip
_ADDRESS = [
    {"name": name, "in": "path", "required": True, "schema": {"type": "integer", "minimum": 0}}
    for name in ("tileMatrix", "tileRow", "tileCol")
]


def _tile_paths(kind: Kind, collection: str | None) -> dict[str, object]:
    base = "".join("/" + part for part in _parts(kind, collection))
    name = f"{'dataset' if collection is None else f'{collection}.collection'}.{kind}"
    title = f"{collection or 'site'}: {WORDS[kind].lower()}"
    return {
        base: operation(f"{name}.getTileSetsList", f"{title}, tilesets", (JSON, HTML)),
        f"{base}/{{tileMatrixSetId}}": operation(
            f"{name}.getTileSet", f"{title}, tileset", (JSON, HTML), ("f",), [_SET_ID]
        ),
        f"{base}/{{tileMatrixSetId}}/{{tileMatrix}}/{{tileRow}}/{{tileCol}}": operation(
            f"{name}.getTile", title, (MEDIA[kind],), (), [_SET_ID, *_ADDRESS]
        ),
    }


extension = Extension(
    conformance=tuple(
        CONFORMANCE + name
        for name in ("core", "tileset", "tilesets-list", "dataset-tilesets", "geodata-tilesets", "mvt", "png", "oas30")
    ),
    landing_links=_landing_links,
    collection_links=_collection_links,
    paths=_paths,
)
