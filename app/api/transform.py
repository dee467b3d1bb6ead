"""Transformation between WGS 84 and the local frame."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from fastapi import Query
from pydantic import BaseModel
from starlette.responses import Response

from app.api.http.auth import Viewer
from app.api.http.dependencies import ServicesDep
from app.api.http.parameters import numbers, parse_version_ref
from app.api.http.responses import api_router, json_response
from app.api.http.schemas import VERSION_OR_PENDING, DatumOut, EnvironmentPath, problem_responses
from app.errors import Invalid, MissingDatum, Problem
from app.model.frame import MAX_METRES
from app.model.geodesy import local_frame


class TransformOut(BaseModel):
    """One position in both frames."""

    latlon: list[float]
    xy: list[float]
    datum: DatumOut


router = api_router("transform", "/environments/{env}")


TOO_FAR = "the position is too far from the datum for the local frame"


def _invalid_place_error(location: str, detail: str) -> Invalid:
    return Invalid(detail, [Problem(detail, where=location)])


@router.get(
    "/transform",
    responses=problem_responses(TransformOut, 404),
    summary="Convert a position between WGS 84 and the local frame",
)
def transform(
    env: EnvironmentPath,
    services: ServicesDep,
    _: Viewer,
    latlon: Annotated[
        str | None, Query(description="`LAT,LON` in degrees (WGS 84).", examples=["52.4206,5.6134"])
    ] = None,
    xy: Annotated[str | None, Query(description="`X,Y` in metres of the local frame.")] = None,
    version: Annotated[
        str,
        Query(
            pattern=VERSION_OR_PENDING,
            description="Version whose datum to use: number, channel, or `latest`; or `dry:…`, or `draft:…`.",
        ),
    ] = "latest",
) -> Response:
    """Convert `latlon` or `xy`; the response has both. Numbers are rounded to 1e-12 degrees and 1e-9 metres."""
    if (latlon is None) == (xy is None):
        raise Invalid("give either latlon=LAT,LON or xy=X,Y", [Problem("give either latlon or xy", where="query")])
    datum = services.store.versions.get(env, parse_version_ref(version)).datum
    if datum is None:
        raise MissingDatum(f'{env} has no datum: PATCH it with {{"datum": {{…}}}} or upload a datum.yaml')
    frame = local_frame(datum)
    if latlon is not None:
        latitude, longitude = numbers(latlon, "latlon", "LAT,LON")
        if not (-90 <= latitude <= 90 and -180 <= longitude <= 180):
            raise _invalid_place_error("latlon", "latlon must be LAT,LON in degrees: the latitude comes first")
        lonlat = np.array([[longitude, latitude]])
        place = frame.to_local(lonlat)
        if not (np.isfinite(place).all() and (np.abs(place) <= MAX_METRES).all()):
            raise _invalid_place_error("latlon", TOO_FAR)
    else:
        x, y = numbers(xy or "", "xy", "X,Y")
        if max(abs(x), abs(y)) > MAX_METRES:
            raise _invalid_place_error("xy", f"x and y must be within ±{MAX_METRES:g} metres")
        place = np.array([[x, y]])
        lonlat = frame.to_wgs84(place)
        if not np.isfinite(lonlat).all():
            raise _invalid_place_error("xy", TOO_FAR)
    degrees, metres = np.round(lonlat[0], 12) + 0.0, np.round(place[0], 9) + 0.0
    return json_response(
        {
            "latlon": [float(degrees[1]), float(degrees[0])],
            "xy": [float(metres[0]), float(metres[1])],
            "datum": datum.as_dict(),
        }
    )
