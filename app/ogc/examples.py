"""What QGIS before 3.44 needs to draw the first feature of a draft's collection.

Newer versions read the type of geometries and the fields from the schema (Part 5). Older ones open a layer by a page of
10 features and take both from these, so that a layer without features has neither, and nothing can be drawn. They get
an example instead: a feature without coordinates and values. QGIS counts and shows the features of other requests only.
"""

from __future__ import annotations

import re
from datetime import UTC, datetime
from typing import Final

import orjson
from starlette.responses import Response

from app.ogc.crs import CRS84
from app.ogc.negotiation import GEOJSON
from app.ogc.service import Service
from app.ogc.tables import Table

READS_SCHEMA: Final = 34400
"""First version of QGIS that reads schemas: 3.44.0."""

_OPENING: Final = [("limit", "10")]


def example_page(service: Service, table: Table) -> Response | None:
    """Return a page with the example if QGIS opens a collection without features by this request, else None."""
    declared = table.declared
    program = re.search(r"\bQGIS/(\d{5,6})\b", service.request.headers.get("user-agent", ""))
    if declared is None or program is None or int(program[1]) >= READS_SCHEMA:
        return None
    if service.request.query_params.multi_items() != _OPENING:
        return None
    (kind,) = declared.geometry_types
    geometry = {"type": kind, "coordinates": []}
    example = {"type": "Feature", "id": "example", "geometry": geometry, "properties": dict.fromkeys(declared.types)}
    page = {
        "type": "FeatureCollection",
        "numberMatched": 0,
        "numberReturned": 1,
        "timeStamp": datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z"),
        "links": [],
        "features": [example],
    }
    return service.respond(orjson.dumps(page), GEOJSON, {"content-crs": f"<{CRS84}>", "cache-control": "no-store"})
