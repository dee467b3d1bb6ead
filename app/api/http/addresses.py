"""Parsing of map URLs, and their resolution to a version and a recipe."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from urllib.parse import quote

from fastapi import Request

from app.api.http.dependencies import Services
from app.api.http.parameters import parse_options, parse_version_ref
from app.api.http.signed import LINK, MAP_PATH
from app.convert.recipe import Recipe
from app.errors import Invalid, NotFound
from app.links import SignedAddress
from app.model.closures import ClosureMode
from app.store.values import LATEST, Version

PRODUCTION = "production"
_AUTHORITY = re.compile(r"[A-Za-z0-9._-]{1,255}(:[0-9]{1,5})?|\[[0-9A-Fa-f:.]{2,60}\](:[0-9]{1,5})?")


def origin(request: Request, public_url: str | None) -> str:
    """Return the server's address for absolute links: the configured one, else scheme and ``Host`` of the request."""
    if public_url is not None:
        return public_url.rstrip("/")
    host = request.headers.get("host", "")
    if _AUTHORITY.fullmatch(host) is None:
        server = request.scope.get("server") or ("localhost", None)
        host = server[0] if server[1] is None else f"{server[0]}:{server[1]}"
    return f"{request.url.scheme}://{host}"


@dataclass(frozen=True, slots=True)
class MapRequest:
    """Parsed URL of a map.

    Attributes:
        version: None in a short URL.
        file: None for the complete map.
        values: parameters of the map.
        derive: allow derived information.
        closures: None for the default of the URL.
    """

    environment: str
    version: str | None
    format: str
    file: str | None
    values: Mapping[str, str] = field(default_factory=dict)
    derive: bool = True
    closures: ClosureMode | None = None


def parse_map_request(request: Request) -> MapRequest:
    """Parse the URL of a map. Raises NotFound for another path, Invalid for an unreadable query."""
    link = signed_link(request)
    options = parse_query(request.scope["query_string"] if link is None else link.query)
    match = MAP_PATH.fullmatch(request.scope["path"])
    if match is None:
        raise NotFound("there is no map at this address")
    return MapRequest(match["short"] or match["long"], match["version"], match["format"], match["file"], *options)


def signed_link(request: Request) -> SignedAddress | None:
    """Return the verified signed link of a request, or None."""
    link: SignedAddress | None = request.scope["state"].get(LINK)
    return link


def request_address(request: Request) -> str:
    """Return the request's URL for later requests, without the signature of a link."""
    link = signed_link(request)
    query = request.url.query if link is None else link.query.decode()
    return quote(request.scope["path"], safe="/") + (f"?{quote(query, safe='&=%,.:+-_~/')}" if query else "")


def parse_query(query: bytes) -> tuple[dict[str, str], bool, ClosureMode | None]:
    """Decode a query and apply ``parse_options``. Raises Invalid."""
    try:
        text = query.decode("ascii")
    except UnicodeDecodeError:
        raise Invalid("unreadable query: it must be percent-encoded UTF-8") from None
    return parse_options(text)


def resolve_recipe(services: Services, wanted: MapRequest) -> Recipe:
    """Resolve a URL to its current recipe. Blocks. Raises the errors of ``Maps.recipe``."""
    version = resolve_version(services, wanted)
    return services.maps.recipe(version, wanted.format, wanted.values, derive=wanted.derive, file=wanted.file)


def resolve_version(services: Services, wanted: MapRequest) -> Version:
    """Resolve a URL to a version, with the closures that its maps show.

    A short URL means the channel ``production`` if it exists, else the head.
    """
    target = partial(services.store.channels.target, wanted.environment)
    if wanted.version is not None:
        return target(parse_version_ref(wanted.version), wanted.closures)[0]
    try:
        return target(PRODUCTION, wanted.closures)[0]
    except NotFound:
        return target(LATEST, wanted.closures)[0]
