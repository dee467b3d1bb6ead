"""Content negotiation: the parameter ``f`` before the header ``Accept``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

from fastapi import Query, Request

from app.api.http.problems import NotAcceptable
from app.errors import Invalid, Problem
from app.model.names import did_you_mean

JSON = "application/json"
HTML = "text/html"
GEOJSON = "application/geo+json"
JSONFG = "application/vnd.ogc.fg+json"
SCHEMA = "application/schema+json"
OPENAPI = "application/vnd.oai.openapi+json;version=3.0"
PROJJSON = "application/projjson+json"
WKT = "text/plain; charset=utf-8"

PAGES: Mapping[str, str] = {"json": JSON, "html": HTML}
"""Representations of most resources: value of ``f`` -> media type, the default first."""

Representation = Annotated[
    str | None,
    Query(
        max_length=20,
        description="Representation, before the header `Accept`: `json` or `html`, and where the page lists it "
        "`jsonfg` or `wkt`.",
    ),
]


def choose(request: Request, offers: Mapping[str, str]) -> str:
    """Return the key of the requested representation.

    Args:
        offers: value of ``f`` -> media type, the default first.

    Raises Invalid for an unknown ``f``, NotAcceptable if the client accepts none of the media types.
    """
    given = request.query_params.get("f")
    if given is not None:
        if given not in offers:
            names = ", ".join(offers)
            near = did_you_mean(given, offers)
            problem = Problem(f"must be one of {names}", where="f")
            raise Invalid(f"unknown f {given[:40]!r}{near}; available: {names}", [problem])
        return given
    accept = request.headers.get("accept", "").strip() or "*/*"
    ranges = [_parse(part) for part in accept.split(",")[:50]]
    scores = {name: _quality(media.partition(";")[0], ranges) for name, media in offers.items()}
    best = max(scores, key=lambda name: scores[name])
    if scores[best] <= 0:
        raise NotAcceptable(f"none of the accepted media types is available: accept {', '.join(offers.values())}")
    return best


def prefers_html(request: Request) -> bool:
    """Test if an error should be a page. Never raises."""
    if "f" in request.query_params:
        return request.query_params["f"] == "html"
    ranges = [_parse(part) for part in request.headers.get("accept", "").split(",")[:50]]
    return _quality(HTML, ranges) > _quality(JSON, ranges)


def _parse(text: str) -> tuple[str, float]:
    """Parse a media range as (type, quality); a malformed quality is 0."""
    media, *parameters = (piece.strip().lower() for piece in text.split(";"))
    quality = 1.0
    for parameter in parameters:
        name, _, value = parameter.partition("=")
        if name.strip() == "q":
            try:
                quality = float(value)
            except ValueError:
                quality = 0.0
    return media, quality


def _quality(media: str, ranges: list[tuple[str, float]]) -> float:
    """Return the quality of a media type: of its most specific range. JSON in general includes its dialects."""
    family = media.partition("/")[0] + "/*"
    for pattern in (media, family, "*/*"):
        values = [quality for name, quality in ranges if name == pattern]
        if values:
            return max(values)
    if media.endswith("+json"):
        return max((0.9 * quality for name, quality in ranges if name == JSON), default=0.0)
    return 0.0
