"""Shell completion: names of environments, formats, channels, levels and grids of the server.

Returns within TIMEOUT_SECONDS, and nothing if the server is unavailable or rejects the request: it prints no errors.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import typer

TIMEOUT_SECONDS = 1.0
"""Maximum wait for the server."""

MAX_NAMES = 1000

DRAWN_LAYERS = ("objects", "topology", "location", "zones")
"""Copy of ``app.upload_reader.DRAWN_LAYERS``, to avoid its imports."""


def environments(ctx: typer.Context) -> list[tuple[str, str]]:
    """Complete the name of an environment."""
    return [(row["name"], row.get("title") or "") for row in _rows(ctx, "environments", limit=MAX_NAMES)]


def formats(ctx: typer.Context) -> list[tuple[str, str]]:
    """Complete the name of a format."""
    return [(row["id"], row["title"]) for row in _rows(ctx, "formats")]


def derivations(ctx: typer.Context) -> list[tuple[str, str]]:
    """Complete the name of a derivation."""
    return [(row["id"], row["title"]) for row in _rows(ctx, "derivations")]


def generators(ctx: typer.Context) -> list[tuple[str, str]]:
    """Complete the name of a generator."""
    return [(row["id"], row["title"]) for row in _rows(ctx, "generators")]


def channels(ctx: typer.Context) -> list[str]:
    """Complete the name of a channel that can be moved."""
    return [name for name in versions(ctx) if name != "latest"]


def versions(ctx: typer.Context) -> list[str]:
    """Complete a version by the channels that point to one."""
    return _distinct(
        row["channel"] for row in _rows(ctx, "environments", _environment(ctx), "channels", robots="false")
    )


def levels(ctx: typer.Context) -> list[str]:
    """Complete the name of a level."""
    return _distinct(row["level"] for row in _layers(ctx))


def grids(ctx: typer.Context) -> list[str]:
    """Complete the name of an occupancy grid."""
    return _distinct(row["name"] for row in _layers(ctx) if row["layer"] == "occupancy")


def drawn_layers() -> list[str]:
    """Complete the layer of a drawing."""
    return list(DRAWN_LAYERS)


def _layers(ctx: typer.Context) -> list[Mapping[str, Any]]:
    return _rows(ctx, "environments", _environment(ctx), "versions", "latest", "layers")


def _environment(ctx: typer.Context) -> str:
    return str(ctx.params.get("environment") or "")


def _distinct(names: Iterable[Any]) -> list[str]:
    return list(dict.fromkeys(str(name) for name in names))


def _rows(ctx: typer.Context, *path: str, **query: Any) -> list[Any]:
    """Get a list from the server; empty if it fails or takes too long, or no environment is typed yet."""
    if not all(path):
        return []
    import json
    from http.client import HTTPException
    from urllib.parse import quote, urlencode
    from urllib.request import Request, urlopen

    from app.errors import FleetMapError
    from app.events.credentials import ca_ssl_context

    given = (ctx.params.get("server"), os.environ.get("FLEETMAP_SERVER"), "http://127.0.0.1:8000")
    server = str(next(filter(None, given))).rstrip("/")
    if "://" not in server:
        server = f"http://{server}"
    token = ctx.params.get("token") or os.environ.get("FLEETMAP_TOKEN")
    address = f"{server}/api/v1/{'/'.join(quote(part, safe='') for part in path)}?{urlencode(query)}"
    headers = {"Authorization": f"Bearer {token}"} if token else {}
    ca = os.environ.get("FLEETMAP_CA")
    try:
        context = ca_ssl_context(Path(ca)) if ca else None
        request = Request(address, headers=headers)  # noqa: S310  the server that the user has named
        with urlopen(request, timeout=TIMEOUT_SECONDS, context=context) as answer:  # noqa: S310
            rows = json.load(answer)
    except (OSError, ValueError, HTTPException, FleetMapError):
        return []
    return rows if isinstance(rows, list) else []
