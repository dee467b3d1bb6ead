"""Checks of settings, and of memory and open files against them."""

from __future__ import annotations

import platform
import resource
import sys
from collections.abc import Iterator

from app import __version__
from app.api.http.connections import FILES_PER_CONNECTION, OTHER_FILES
from app.config import is_loopback
from app.doctor.registry import Finding, check, error, human_size, ok, warning
from app.doctor.site import Site

MIN_PYTHON = (3, 11)
SERVER_BYTES = 300 * 2**20
"""Memory of a server process without its caches, in bytes."""

SHORT_TOKEN = 22


@check
def settings(site: Site) -> Iterator[Finding]:
    """Look for unknown settings, and for those that are dangerous together."""
    chosen = site.settings
    problems = [warning(text, "environment or .env", "correct the name, or remove it") for text in site.unknown]
    if not is_loopback(chosen.host) and chosen.tls_certificate is None and chosen.public_url is None:
        advice = (
            "set FLEETMAP_TLS_CERTIFICATE, or listen on loopback behind a proxy with TLS and set FLEETMAP_PUBLIC_URL"
        )
        problems.append(warning("tokens are sent in clear text over HTTP", f"FLEETMAP_HOST={chosen.host}", advice))
    if chosen.insecure_no_auth:
        advice = "remove it, and use tokens"
        problems.append(warning("every local program has all rights", "FLEETMAP_INSECURE_NO_AUTH", advice))
    token = chosen.admin_token.get_secret_value() if chosen.admin_token is not None else None
    if token is not None and len(token) < SHORT_TOKEN:
        advice = "use 32 random characters, and revoke the short one"
        problems.append(error("the administrator's token can be guessed", "FLEETMAP_ADMIN_TOKEN", advice))
    public = [str(network) for network in chosen.anonymous_list if not network.is_private]
    if public:
        advice = "list only networks in which everybody may read all maps"
        problems.append(warning(f"{', '.join(public)} can read without a token", "FLEETMAP_ANONYMOUS_NETWORKS", advice))
    if chosen.database.startswith("postgres") and chosen.blob_url is None:
        advice = "with a second server set FLEETMAP_BLOB_URL to a folder or bucket that both use"
        problems.append(warning("the database can be shared, the files cannot", "FLEETMAP_BLOB_URL", advice))
    if chosen.zenoh_mode == "router" and chosen.zenoh_users is None and not _is_local(chosen.zenoh_listen):
        advice = "set FLEETMAP_ZENOH_USERS"
        problems.append(warning("every client may publish everything over Zenoh", chosen.zenoh_listen, advice))
    yield from problems
    if not problems:
        yield ok("consistent, and none is unknown")


def _is_local(endpoints: str) -> bool:
    hosts = [part.strip().partition("/")[2].rpartition(":")[0] for part in endpoints.split(",")]
    return all(is_loopback(host) for host in hosts)


@check
def program(site: Site) -> Iterator[Finding]:
    """Show the versions of the program and of Python."""
    del site
    detail = f"fleetmap {__version__} on Python {platform.python_version()}, {platform.machine()}"
    if sys.version_info < MIN_PYTHON:
        yield error(detail, sys.executable, "install it with Python 3.11 or newer")
    else:
        yield ok(detail, sys.executable)


@check
def memory(site: Site) -> Iterator[Finding]:
    """Compare what processes may use with the memory of the machine or container."""
    chosen, total = site.settings, site.memory()
    servers = chosen.workers * (SERVER_BYTES + chosen.memory_cache_bytes)
    detail = f"{chosen.workers} server processes with their caches need {human_size(servers)} of {human_size(total)}"
    if servers > total:
        yield error(detail, "FLEETMAP_WORKERS, FLEETMAP_MEMORY_CACHE_BYTES", "lower them, or add memory")
    else:
        yield ok(detail)
    if chosen.max_memory_bytes + servers > total:
        detail = f"one conversion may use {human_size(chosen.max_memory_bytes)} of address space beside them"
        advice = "lower it, so that a large map is refused before the system stops the server; or add memory or swap"
        yield warning(detail, "FLEETMAP_MAX_MEMORY_BYTES", advice)


@check
def open_files(site: Site) -> Iterator[Finding]:
    """Compare the limit of open files with the connections."""
    chosen = site.settings
    _, limit = resource.getrlimit(resource.RLIMIT_NOFILE)
    needed = chosen.max_connections * FILES_PER_CONNECTION + OTHER_FILES
    if limit == resource.RLIM_INFINITY or limit >= needed:
        yield ok(f"{limit if limit != resource.RLIM_INFINITY else 'any number of'} open files are allowed")
    else:
        detail = f"{limit} open files are allowed, {chosen.max_connections} connections need up to {needed}"
        advice = "raise the limit (LimitNOFILE= of systemd, ulimits of Compose), or lower FLEETMAP_MAX_CONNECTIONS"
        yield warning(detail, "FLEETMAP_MAX_CONNECTIONS", advice)
