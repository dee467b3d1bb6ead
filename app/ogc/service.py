"""The service of a request: an environment's version, its addresses and its responses."""

from __future__ import annotations

import hashlib
import time
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from urllib.parse import quote, urlencode

from fastapi import Request
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from app.api.http.addresses import origin
from app.api.http.auth import Viewer
from app.api.http.caching import cache_control, none_match
from app.api.http.dependencies import Services, ServicesDep
from app.api.http.parameters import parse_version_ref
from app.api.http.responses import json_bytes
from app.api.http.schemas import EnvironmentPath, VersionPath
from app.errors import NotFound
from app.ogc.negotiation import HTML, PAGES, choose
from app.store.values import LATEST, Environment, Version

PRODUCTION = "production"

FRESH_SECONDS = 0.1
"""Seconds for which a resolved address is cached: commits of other servers are visible within that time."""

MAX_RESOLVED = 256

Link = Mapping[str, str]
"""Link as JSON: ``href``, ``rel``, ``type``, ``title``."""


def link(href: str, rel: str, media_type: str, title: str) -> Link:
    """Build a link."""
    return {"href": href, "rel": rel, "type": media_type, "title": title}


@dataclass(frozen=True, slots=True)
class Service:
    """OGC service of one version. address: absolute URL of the landing page, without a slash at its end.

    ref: version number, or name of a channel or draft whose content may change. draft: name in the address of a draft,
    None for versions, which cannot be written.
    """

    services: Services
    request: Request
    environment: Environment
    version: Version
    ref: str | int
    address: str
    draft: str | None = None

    @property
    def title(self) -> str:
        """Return the title of the environment, else its name."""
        return self.environment.title or self.environment.name

    @property
    def description(self) -> str:
        """Describe the version in a sentence."""
        state = f"version {self.version.ref} ({self.ref})"
        if self.draft is not None:
            state = f"draft {self.draft}" + (" without changes" if self.ref == LATEST else "")
        return f"{self.environment.name}, {state}"

    def url(self, *parts: str, pairs: Sequence[tuple[str, str]] = (), **query: str) -> str:
        """Build the absolute URL of a resource of the service; each part is quoted completely."""
        path = "".join("/" + quote(part, safe="") for part in parts)
        listed = [*pairs, *query.items()]
        return f"{self.address}{path}" + (f"?{urlencode(listed)}" if listed else "")

    @property
    def landing_url(self) -> str:
        """Return the URL of the landing page."""
        return self.address + "/"

    def alternates(self, url: str, offers: Mapping[str, str], used: str) -> list[Link]:
        """Link a resource to itself and to its other representations. url: without ``f``."""
        join = "&" if "?" in url else "?"
        return [
            link(f"{url}{join}f={name}", "self" if name == used else "alternate", media, f"this document as {name}")
            for name, media in sorted(offers.items(), key=lambda item: item[0] != used)
        ]

    def respond(
        self, body: bytes, media_type: str, headers: Mapping[str, str] | None = None, etag: str | None = None
    ) -> Response:
        """Build a response that caches may store: numbered versions for good, others if they revalidate it.

        etag: strong one of the body by default. A weak one starts with ``W/``.
        """
        etag = etag or etag_of(body)
        sent = {
            "etag": etag,
            "vary": "accept, authorization, cookie",
            "cache-control": cache_control(self.ref),
            "fleetmap-version": str(self.version.ref),
            "fleetmap-root": self.version.root,
            **(headers or {}),
        }
        if none_match(self.request.headers.get("if-none-match"), etag.removeprefix("W/")):
            return Response(status_code=304, headers=sent)
        return Response(body, headers=sent, media_type=media_type)

    def respond_json(self, value: object, media_type: str = PAGES["json"]) -> Response:
        """Build a response of JSON."""
        return self.respond(json_bytes(value), media_type)

    def respond_page(self, page: bytes, headers: Mapping[str, str]) -> Response:
        """Build a response of a web page."""
        return self.respond(page, HTML, headers)

    def choose(self, offers: Mapping[str, str] = PAGES) -> str:
        """Return the requested representation."""
        return choose(self.request, offers)


def etag_of(body: bytes) -> str:
    """Return the strong ETag of a body."""
    return f'"{hashlib.sha256(body).hexdigest()[:32]}"'


async def current_service(env: EnvironmentPath, request: Request, services: ServicesDep, _: Viewer) -> Service:
    """Return the service of the channel ``production`` if it exists, else of the head."""
    return await _service(request, services, env, None, f"/ogc/{env}")


async def version_service(
    env: EnvironmentPath, v: VersionPath, request: Request, services: ServicesDep, _: Viewer
) -> Service:
    """Return the service of a version."""
    path = f"/ogc/{env}/versions/{quote(v, safe=':')}"
    return await _service(request, services, env, parse_version_ref(v), path)


async def _service(request: Request, services: Services, env: str, ref: str | int | None, path: str) -> Service:
    cache = getattr(request.app.state, "ogc_versions", None)
    if cache is None:
        cache = request.app.state.ogc_versions = ResolvedVersions()
    resolved = cache.get(services, env, ref)
    if resolved is None:
        generation = services.response_cache.generation()
        resolved = await run_in_threadpool(_resolve, services, env, ref)
        cache.put(env, ref, generation, resolved)
    return _service_of(request, services, resolved, path)


def service_at(request: Request, services: Services, env: str, ref: str | int, path: str) -> Service:
    """Return the service of a version that may change at any request, such as a draft, at a path."""
    return _service_of(request, services, _resolve(services, env, ref), path)


def _service_of(request: Request, services: Services, resolved: Resolved, path: str) -> Service:
    address = origin(request, services.options.public_url) + path
    return Service(services, request, resolved.environment, resolved.version, resolved.ref, address)


@dataclass(frozen=True, slots=True)
class Resolved:
    """What an address means at the moment."""

    environment: Environment
    version: Version
    ref: str | int


def _resolve(services: Services, env: str, ref: str | int | None) -> Resolved:
    """Read environment and version. Raises NotFound."""
    versions = services.store.versions
    if ref is None:
        try:
            version, ref = versions.get(env, PRODUCTION), PRODUCTION
        except NotFound:
            version, ref = versions.get(env, LATEST), LATEST
    else:
        version = versions.get(env, ref)
    return Resolved(services.store.environments.get(env), version, ref)


class ResolvedVersions:
    """Resolved addresses, valid until the next commit of this process and for FRESH_SECONDS.

    Clients request pages in rows, which then need no database. Used by the event loop only.
    """

    def __init__(self) -> None:
        self._entries: OrderedDict[tuple[str, str | int | None], tuple[int, float, Resolved]] = OrderedDict()

    def get(self, services: Services, env: str, ref: str | int | None) -> Resolved | None:
        """Return what an address means; None if it has to be read."""
        entry = self._entries.get((env, ref))
        if entry is None or entry[0] != services.response_cache.generation() or entry[1] < time.monotonic():
            return None
        return entry[2]

    def put(self, env: str, ref: str | int | None, generation: int, resolved: Resolved) -> None:
        """Cache what an address means. generation: from before the store was read."""
        self._entries[env, ref] = generation, time.monotonic() + FRESH_SECONDS, resolved
        self._entries.move_to_end((env, ref))
        while len(self._entries) > MAX_RESOLVED:
            self._entries.popitem(last=False)
