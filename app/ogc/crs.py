"""Coordinate reference systems (Part 2): which a site has, and the address that defines the local frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import shapely
from numpy.typing import NDArray
from starlette.responses import Response

from app.api.http.responses import json_bytes
from app.errors import Invalid, NotFound, Problem
from app.model import geodesy
from app.model.frame import Datum
from app.ogc.extensions import Extension
from app.ogc.negotiation import HTML, PROJJSON, WKT, Representation
from app.ogc.pages import add, page, representations, respond_page
from app.ogc.routing import both, ogc_router
from app.ogc.service import Service
from app.store.parts.boxes import ring, split_box, unwrapped_box, widened
from app.store.values import Box

CRS84 = "http://www.opengis.net/def/crs/OGC/1.3/CRS84"
EPSG = "http://www.opengis.net/def/crs/EPSG/0/"
MERCATOR = "EPSG:3857"
MAX_UTM_LATITUDE = 84.0

REPRESENTATIONS = {"wkt": WKT, "json": PROJJSON, "html": HTML}

router = ogc_router()


@dataclass(frozen=True, slots=True)
class ReferenceSystem:
    """CRS of requests and responses.

    kind: ``crs84`` and ``local`` for these, else ``epsg``. code: for PROJ. swap: whether latitude comes first.
    """

    uri: str
    kind: Literal["crs84", "local", "epsg"]
    code: str = ""
    swap: bool = False

    @property
    def digits(self) -> int:
        """Return the number of decimals of coordinates: 1e-9 metres or 1e-12 degrees."""
        return 12 if self.kind == "crs84" or self.swap else 9

    @property
    def is_geographic(self) -> bool:
        """Return whether coordinates are degrees."""
        return self.kind == "crs84" or self.swap

    @property
    def ends_at_antimeridian(self) -> bool:
        """Return whether geometries across the antimeridian are in two pieces."""
        return self.is_geographic or self.code == MERCATOR

    def from_wgs84(self, geometry: NDArray[np.object_], datum: Datum) -> NDArray[np.object_]:
        """Convert geometries from CRS84; those too far from the datum for the local frame become empty."""
        if self.kind == "crs84":
            return geometry
        if self.kind == "local":
            return geodesy.local_frame(datum).near_geometries_to_local(geometry)
        return swap_axes(geometry) if self.swap else geodesy.geometries_from_wgs84(self.code, geometry)

    def to_wgs84(self, geometry: NDArray[np.object_], datum: Datum) -> NDArray[np.object_]:
        """Convert geometries to CRS84; coordinates outside the CRS become infinite."""
        if self.kind == "crs84":
            return geometry
        if self.kind == "local":
            return geodesy.local_frame(datum).geometries_to_wgs84(geometry)
        return swap_axes(geometry) if self.swap else geodesy.geometries_to_wgs84(self.code, geometry)

    def box_in_wgs84(self, box: Box, datum: Datum, parameter: str) -> list[Box]:
        """Return the boxes in degrees around a box in this CRS. Raises Invalid if it is not on earth."""
        if self.kind == "crs84":
            return split_box(box)
        if self.swap:
            return split_box((box[1], box[0], box[3], box[2]))
        outline = ring(box)
        if self.kind == "local":
            points = geodesy.local_frame(datum).to_wgs84(outline)
        else:
            points = geodesy.between(self.code, geodesy.WGS84, outline)
        if not np.isfinite(points).all():
            problem = Problem("outside the CRS", where=parameter)
            raise Invalid(f"{parameter} is outside the area of {self.uri}: give coordinates of that CRS", [problem])
        if self.code == MERCATOR:  # its boxes are boxes in degrees, also the one around the globe
            (west, south), (east, north) = points.min(axis=0).tolist(), points.max(axis=0).tolist()
            return [(west, south, east, north)]
        return split_box(widened(unwrapped_box(points, datum.longitude)))


def swap_axes(geometry: NDArray[np.object_]) -> NDArray[np.object_]:
    """Exchange x and y of all coordinates."""
    out = np.empty(len(geometry), object)
    deep = shapely.has_z(geometry)
    for mask, order in ((~deep, [1, 0]), (deep, [1, 0, 2])):
        if mask.any():
            out[mask] = shapely.transform(geometry[mask], lambda xy, o=order: xy[:, o], include_z=len(order) == 3)
    return out


def local_uri(service: Service) -> str:
    """Return the URI of the local frame."""
    return service.url("crs", "local")


def reference_systems(service: Service, datum: Datum) -> Mapping[str, ReferenceSystem]:
    """Return the CRSs of a site by URI, the default first and the local frame last."""
    systems = [
        ReferenceSystem(CRS84, "crs84"),
        ReferenceSystem(f"{EPSG}4326", "epsg", "EPSG:4326", swap=True),
        ReferenceSystem(f"{EPSG}3857", "epsg", MERCATOR),
    ]
    if abs(datum.latitude) <= MAX_UTM_LATITUDE:
        zone = int((datum.longitude + 180.0) // 6.0) % 60 + 1
        code = (32600 if datum.latitude >= 0 else 32700) + zone
        systems.append(ReferenceSystem(f"{EPSG}{code}", "epsg", f"EPSG:{code}"))
    systems.append(ReferenceSystem(local_uri(service), "local"))
    return {system.uri: system for system in systems}


def parse_crs(text: str, systems: Mapping[str, ReferenceSystem], parameter: str) -> ReferenceSystem:
    """Return the CRS with a URI. Raises Invalid for one that the collection does not have."""
    if text not in systems:
        accepted = ", ".join(systems)
        problem = Problem(f"must be one of {accepted}", where=parameter)
        raise Invalid(f"unknown {parameter} {text[:200]!r}; available: {accepted}", [problem])
    return systems[text]


@both(
    router,
    "/crs/local",
    {"text/plain": {"schema": {"type": "string"}}, PROJJSON: {"schema": {"type": "object"}}, HTML: {}},
    summary="Define the local frame",
)
async def get_local_crs(service: Service, f: Representation = None) -> Response:  # noqa: ARG001  parsed by choose()
    """Return the local frame as a CRS: WKT 2 (ISO 19162:2019), or PROJJSON with `f=json`.

    It is the transverse Mercator projection at the datum; with a heading, a CRS derived from it by an affine
    transformation. Its address is the CRS's URI.
    """
    used = service.choose(REPRESENTATIONS)
    datum = service.version.datum
    if datum is None:
        raise NotFound(f"{service.environment.name} has no datum, so its local frame has no place: upload a datum.yaml")
    if used == "wkt":
        return service.respond(geodesy.local_crs_wkt(datum).encode(), WKT)
    if used == "json":
        return service.respond(json_bytes(geodesy.local_crs_projjson(datum)), PROJJSON)
    root, body = page("Local frame", [(service.title, service.landing_url)])
    add(body, "p", "Metres; the origin is the datum.")
    add(body, "pre", geodesy.local_crs_wkt(datum, pretty=True))
    representations(body, service.alternates(local_uri(service), REPRESENTATIONS, used))
    return respond_page(service, root)


extension = Extension(conformance=("http://www.opengis.net/spec/ogcapi-features-2/1.0/conf/crs",))
