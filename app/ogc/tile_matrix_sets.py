"""Tile matrix sets: the web's Mercator quad, and one in the local frame (OGC Two Dimensional Tile Matrix Set 2.0)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from fastapi import Path
from pydantic import BaseModel, ConfigDict, Field
from pydantic.json_schema import SkipJsonSchema
from starlette.responses import Response

from app.api.http.features import omittable
from app.api.http.schemas import component_schemas
from app.errors import NotFound
from app.model import geodesy
from app.model.imagery import LOCAL
from app.model.names import did_you_mean
from app.ogc.crs import EPSG, MERCATOR, local_uri
from app.ogc.extensions import Extension
from app.ogc.negotiation import HTML, JSON, PAGES, Representation
from app.ogc.pages import add, anchor, page, representations, respond_page, table
from app.ogc.routing import both, ogc_router
from app.ogc.schemas import OgcLinkOut
from app.ogc.service import Link, Service, link
from app.store.parts.boxes import ring
from app.store.values import Box

TILE = 256
"""Side of a tile in pixels."""

PIXEL_METRES = 0.00028
"""Side of a pixel for scale denominators, by the standard."""

MERCATOR_EDGE = 20037508.3427892
"""Half the side of the Mercator square in metres."""

LOCAL_EDGE = 131072.0
"""Half the side of the local square in metres: a whole number of metres per pixel at the coarsest level."""

MERCATOR_LEVELS, LOCAL_LEVELS = 25, 21

router = ogc_router()


@dataclass(frozen=True, slots=True)
class TileMatrixSet:
    """Square around an origin, halved at each level: level z has 2^z x 2^z tiles.

    code: of the CRS, ``local`` or PROJ's. edge: half the square's side in metres. registered: URI of a well-known one.
    """

    id: str
    title: str
    code: str
    edge: float
    levels: int
    registered: str | None = None

    def crs(self, service: Service) -> str:
        """Return the URI of the CRS."""
        return local_uri(service) if self.code == LOCAL else f"{EPSG}{self.code.partition(':')[2]}"

    def box(self, z: int, row: int, column: int) -> Box:
        """Return the box of a tile in metres."""
        side = 2 * self.edge / 2**z
        left, top = -self.edge + column * side, self.edge - row * side
        return left, top - side, left + side, top

    def check(self, z: int, row: int, column: int) -> None:
        """Raise NotFound for a tile that does not exist."""
        if z >= self.levels:
            raise NotFound(f"{self.id} has no level {z}: use 0 to {self.levels - 1}")
        if max(row, column) >= 2**z:
            raise NotFound(f"level {z} of {self.id} has no tile {row}/{column}: rows and columns are 0 to {2**z - 1}")

    def limits(self, box: Box, datum_frame: geodesy.LocalFrame) -> list[tuple[int, int, int, int]]:
        """Return for each level the first and last row, and the first and last column, of tiles that meet a box.

        box: in degrees; west > east crosses the antimeridian.
        """
        west, south, east, north = box
        outline = ring((west, south, east + 360.0 if west > east else east, north))
        if self.code == LOCAL:
            points = datum_frame.to_local(outline)
        else:
            outline[:, 1] = outline[:, 1].clip(-85.05, 85.05)
            points = geodesy.between(geodesy.WGS84, self.code, outline)
            if west > east:
                points[:, 0] = np.where(points[:, 0] < points[0, 0], points[:, 0] + 2 * self.edge, points[:, 0])
        (x0, y0), (x1, y1) = points.min(axis=0).tolist(), points.max(axis=0).tolist()
        if self.code != LOCAL and x1 > self.edge:
            x0, x1 = -self.edge, self.edge
        out = []
        for z in range(self.levels):
            side = 2 * self.edge / 2**z
            rows = _clip((self.edge - y1) / side, z), _clip((self.edge - y0) / side, z)
            columns = _clip((x0 + self.edge) / side, z), _clip((x1 + self.edge) / side, z)
            out.append((*rows, *columns))
        return out


def _clip(index: float, z: int) -> int:
    return int(min(max(index // 1.0, 0.0), 2**z - 1))


SETS: Mapping[str, TileMatrixSet] = {
    one.id: one
    for one in (
        TileMatrixSet(
            "WebMercatorQuad",
            "Web Mercator",
            MERCATOR,
            MERCATOR_EDGE,
            MERCATOR_LEVELS,
            "http://www.opengis.net/def/tilematrixset/OGC/1.0/WebMercatorQuad",
        ),
        TileMatrixSet("local", "Local frame", LOCAL, LOCAL_EDGE, LOCAL_LEVELS),
    )
}
"""Tile matrix sets by id."""

SetPath = Annotated[
    str,
    Path(max_length=100, description="Id of the tile matrix set: `WebMercatorQuad` or `local`.", examples=["local"]),
]


def find_set(service: Service, name: str) -> TileMatrixSet:
    """Return a tile matrix set by id. Raises NotFound, also for the local one of a version without a datum."""
    if name not in SETS:
        raise NotFound(f"unknown tile matrix set {name!r}{did_you_mean(name, SETS)}; available: {', '.join(SETS)}")
    if SETS[name].code == LOCAL and service.version.datum is None:
        raise NotFound(f"{service.environment.name} has no datum, so its local frame has no place: upload a datum.yaml")
    return SETS[name]


# --- shapes ---


class OgcTileMatrixOut(BaseModel):
    """Level of a tile matrix set."""

    model_config = ConfigDict(populate_by_name=True)

    id: str
    scale_denominator: float = Field(alias="scaleDenominator", description="For pixels of 0.28 mm.")
    cell_size: float = Field(alias="cellSize", description="Metres per pixel.")
    corner_of_origin: str = Field(alias="cornerOfOrigin")
    point_of_origin: tuple[float, float] = Field(alias="pointOfOrigin")
    tile_width: int = Field(alias="tileWidth")
    tile_height: int = Field(alias="tileHeight")
    matrix_width: int = Field(alias="matrixWidth")
    matrix_height: int = Field(alias="matrixHeight")


class OgcTileMatrixSetOut(BaseModel):
    """Tile matrix set."""

    model_config = ConfigDict(populate_by_name=True)

    id: str
    title: str
    uri: str
    crs: str
    ordered_axes: list[str] = Field(alias="orderedAxes")
    well_known_scale_set: str | SkipJsonSchema[None] = omittable("Of WebMercatorQuad only.", "wellKnownScaleSet")
    tile_matrices: list[OgcTileMatrixOut] = Field(alias="tileMatrices")


class OgcTileMatrixSetItemOut(BaseModel):
    """Entry of the list of tile matrix sets."""

    id: str
    title: str
    uri: str
    crs: str
    links: list[OgcLinkOut]


class OgcTileMatrixSetsOut(BaseModel):
    """Tile matrix sets of the service."""

    model_config = ConfigDict(populate_by_name=True)

    tile_matrix_sets: list[OgcTileMatrixSetItemOut] = Field(alias="tileMatrixSets")
    links: list[OgcLinkOut]


def uri_of(service: Service, one: TileMatrixSet) -> str:
    """Return the URI of a tile matrix set: the registered one, else its address."""
    return one.registered or service.url("tileMatrixSets", one.id)


def definition(service: Service, one: TileMatrixSet) -> dict[str, Any]:
    """Build the JSON of a tile matrix set."""
    matrices = []
    for z in range(one.levels):
        cell = 2 * one.edge / TILE / 2**z
        matrices.append(
            {
                "id": str(z),
                "scaleDenominator": cell / PIXEL_METRES,
                "cellSize": cell,
                "cornerOfOrigin": "topLeft",
                "pointOfOrigin": [-one.edge, one.edge],
                "tileWidth": TILE,
                "tileHeight": TILE,
                "matrixWidth": 2**z,
                "matrixHeight": 2**z,
            }
        )
    out: dict[str, Any] = {
        "id": one.id,
        "title": one.title,
        "uri": uri_of(service, one),
        "crs": one.crs(service),
        "orderedAxes": ["x", "y"] if one.code == LOCAL else ["E", "N"],
    }
    if one.registered:
        out["wellKnownScaleSet"] = "http://www.opengis.net/def/wkss/OGC/1.0/GoogleMapsCompatible"
    return {**out, "tileMatrices": matrices}


def available_sets(service: Service) -> list[TileMatrixSet]:
    """Return the tile matrix sets of a version."""
    return [one for one in SETS.values() if one.code != LOCAL or service.version.datum is not None]


@both(
    router,
    "/tileMatrixSets",
    {JSON: {"schema": {"$ref": "#/components/schemas/OgcTileMatrixSetsOut"}}, HTML: {}},
    summary="List the tile matrix sets",
    openapi_extra=component_schemas(OgcTileMatrixSetsOut),
)
async def list_tile_matrix_sets(service: Service, f: Representation = None) -> Response:  # noqa: ARG001  parsed by choose()
    """Return the tile matrix sets: Web Mercator, and with a datum one in metres of the local frame."""
    used = service.choose()
    links = service.alternates(service.url("tileMatrixSets"), PAGES, used)
    sets = available_sets(service)
    if used == "json":
        listed = [
            {
                "id": one.id,
                "title": one.title,
                "uri": uri_of(service, one),
                "crs": one.crs(service),
                "links": [link(service.url("tileMatrixSets", one.id), "self", JSON, one.title)],
            }
            for one in sets
        ]
        return service.respond_json({"tileMatrixSets": listed, "links": links})
    root, body = page("Tile matrix sets", [(service.title, service.landing_url)])
    rows = [(anchor(one.title, service.url("tileMatrixSets", one.id, f="html")), one.id, one.levels) for one in sets]
    table(body, ("title", "id", "levels"), rows)
    representations(body, links)
    return respond_page(service, root)


@both(
    router,
    "/tileMatrixSets/{tms}",
    {JSON: {"schema": {"$ref": "#/components/schemas/OgcTileMatrixSetOut"}}, HTML: {}},
    summary="Define a tile matrix set",
    openapi_extra=component_schemas(OgcTileMatrixSetOut),
)
async def get_tile_matrix_set(
    service: Service,
    tms: SetPath,
    f: Representation = None,  # noqa: ARG001  parsed by choose()
) -> Response:
    """Return CRS, origin and levels of a tile matrix set."""
    used = service.choose()
    one = find_set(service, tms)
    if used == "json":
        return service.respond_json(definition(service, one))
    trail = [(service.title, service.landing_url), ("Tile matrix sets", service.url("tileMatrixSets", f="html"))]
    root, body = page(one.title, trail)
    add(body, "p", f"CRS: {one.crs(service)}")
    rows = [
        (m["id"], m["matrixWidth"], f"{m['cellSize']:.7g}", f"{m['scaleDenominator']:.7g}")
        for m in definition(service, one)["tileMatrices"]
    ]
    table(body, ("level", "rows and columns", "metres per pixel", "scale 1:"), rows)
    representations(body, service.alternates(service.url("tileMatrixSets", tms), PAGES, used))
    return respond_page(service, root)


def _landing_links(service: Service) -> list[Link]:
    rel = "http://www.opengis.net/def/rel/ogc/1.0/tiling-schemes"
    return [link(service.url("tileMatrixSets"), rel, JSON, "Tile matrix sets")]


extension = Extension(
    conformance=(
        "http://www.opengis.net/spec/tms/2.0/conf/tilematrixset",
        "http://www.opengis.net/spec/tms/2.0/conf/json-tilematrixset",
    ),
    landing_links=_landing_links,
)
