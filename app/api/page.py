"""The web page: its built files, and the headers that confine it."""

from __future__ import annotations

import gzip
import hashlib
import mimetypes
import re
from functools import cache, lru_cache
from pathlib import Path

from fastapi import APIRouter, Request
from pydantic import BaseModel, Field
from starlette.responses import Response

from app.api.http.auth import Viewer
from app.api.http.caching import none_match
from app.api.http.dependencies import Services, ServicesDep
from app.api.http.responses import api_router, json_response
from app.api.http.schemas import problem_responses
from app.errors import NotFound, Unavailable
from app.setting_values import basemap_origin

FOLDER = Path(__file__).resolve().parents[1] / "web" / "dist"

POLICY = "; ".join(
    (
        "default-src 'none'",
        "script-src 'self'",
        "style-src 'self'",
        "img-src 'self' blob:",
        "connect-src 'self'",
        "worker-src 'self'",
        "manifest-src 'self'",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
    )
)
"""Content-Security-Policy: nothing from elsewhere, nothing inline, in no frame."""

HEADERS = {
    "content-security-policy": POLICY,
    "cross-origin-opener-policy": "same-origin",
    "permissions-policy": "camera=(), geolocation=(), microphone=()",
    "referrer-policy": "no-referrer",
    "x-content-type-options": "nosniff",
}
FOREVER = "public, max-age=31536000, immutable"
"""For files whose names contain their hash."""

_FILE = re.compile(r"(assets/)?\w[\w.-]*")

root_router = APIRouter()
router = api_router("session", "/page")


class BaseMapOut(BaseModel):
    """Base map below the sites, from a host that the operator has chosen."""

    url: str = Field(description="URL of Web Mercator tiles with `{z}`, `{x}` and `{y}`.")
    attribution: str = Field(description="Credits as text.")


class PageOut(BaseModel):
    """Settings of the web page."""

    basemap: BaseMapOut | None = Field(description="Null: none is configured (`FLEETMAP_BASEMAP_URL`).")


@router.get("", responses=problem_responses(PageOut), summary="Get the settings of the web page")
def page_settings(services: ServicesDep, _: Viewer) -> Response:
    """Return which base map the web page may draw."""
    options = services.options
    basemap = None
    if options.basemap_url is not None:
        basemap = {"url": options.basemap_url, "attribution": options.basemap_attribution}
    return json_response({"basemap": basemap})


@root_router.get("/", include_in_schema=False)
def front(request: Request) -> Response:
    """Return the page."""
    return _file(request, "index.html", "no-cache")


@root_router.get("/icon.svg", include_in_schema=False)
def icon(request: Request) -> Response:
    """Return the page's icon."""
    return _file(request, "icon.svg", "public, max-age=86400")


@root_router.get("/service-worker.js", include_in_schema=False)
def service_worker(request: Request) -> Response:
    """Return the script that keeps the page and the last map readable while the server does not answer."""
    return _file(request, "service-worker.js", "no-cache")


@root_router.get("/assets/{name}", include_in_schema=False)
def asset(request: Request, name: str) -> Response:
    """Return a script or style sheet of the page."""
    return _file(request, f"assets/{name}", FOREVER)


def _file(request: Request, name: str, cache_control: str) -> Response:
    """Return a built file, compressed if the client accepts that."""
    if not (FOLDER / "index.html").is_file():
        raise Unavailable(
            "the web page is not built: run `make run`, or install a wheel; /docs describes the HTTP calls"
        )
    path = FOLDER / name
    if not _FILE.fullmatch(name) or not path.is_file():
        raise NotFound("no such file of the page: open /")
    plain, packed, etag = _read(path, path.stat().st_mtime_ns)
    services: Services = request.app.state.services
    policy = policy_for(services.options.basemap_url)
    headers = {
        **HEADERS,
        "content-security-policy": policy,
        "cache-control": cache_control,
        "etag": etag,
        "vary": "accept-encoding",
    }
    if none_match(request.headers.get("if-none-match"), etag):
        return Response(status_code=304, headers=headers)
    body = plain
    if packed is not None and "gzip" in request.headers.get("accept-encoding", ""):
        body = packed
        headers["content-encoding"] = "gzip"
    return Response(body, headers=headers, media_type=mimetypes.guess_type(name)[0] or "application/octet-stream")


@cache
def policy_for(basemap_url: str | None) -> str:
    """Return the policy, which allows images of the base map's origin if there is one."""
    origin = basemap_origin(basemap_url) if basemap_url else None
    return POLICY if origin is None else POLICY.replace("img-src 'self'", f"img-src 'self' {origin}")


@lru_cache(maxsize=256)
def _read(path: Path, _changed: int) -> tuple[bytes, bytes | None, str]:
    """Return a file's bytes, its gzip form if that is smaller, and its weak ETag; cached until the file changes."""
    plain = path.read_bytes()
    packed = gzip.compress(plain, 9, mtime=0)
    etag = f'W/"{hashlib.sha256(plain).hexdigest()[:32]}"'
    return plain, packed if len(packed) < len(plain) else None, etag
