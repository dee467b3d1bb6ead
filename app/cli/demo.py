"""Demo environment: a small synthetic orchard.

Equal to ``fleetmap generate orchard`` with the seed and parameters below; created over HTTP.
"""

from __future__ import annotations

from typing import Any

from app.cli.client import Client, quote_path
from app.cli.problems import RequestFailed

NAME = "orchard"
TITLE = "Demo orchard"
DATUM = (52.4205, 5.6132)
"""Latitude and longitude of the local origin, the south-west corner of the yard. x runs east along the tree rows."""

PLAIN: dict[str, Any] = {
    "angle": 0.0,
    "skew": 0.0,
    "taper": 0.0,
    "curve": 0.0,
    "missing": 0.0,
    "cross_aisles": 0,
    "cross_width": 3.0,
    "headland": 5.0,
    "yard": 8.0,
    "docks": 2,
    "shed": 7.0,
    "row_spacing": 3.6,
    "tree_spacing": 1.8,
}
"""Straight rows along the x axis, so that examples can name places: nothing is drawn from the seed but trees."""

SITE: dict[str, Any] = {
    "generator": "orchard",
    "seed": 7,
    "parameters": {"datum": DATUM, "rows": 6, "row_length": 36.0, **PLAIN},
    "message": "demo orchard",
}


def install(client: Client) -> dict[str, Any]:
    """Create the demo environment unless it has content. Return ``{environment, version, created}``.

    An environment with content stays unchanged, including changes by users.
    """
    try:
        client.post("/environments", {"name": NAME, "title": TITLE, "tags": ["demo"]})
    except RequestFailed as refused:
        if refused.status != 409:
            raise
    head = client.get(quote_path("environments", NAME, "versions", "latest"))
    if any(kind != "missing" for kind in (head.get("information") or {}).values()):
        return {"environment": NAME, "version": head["version"], "created": False}
    version = client.post(quote_path("environments", NAME, "generations"), SITE)
    return {"environment": NAME, "version": version["version"], "created": True}


def curl_lines(server: str, token: str | None) -> list[str]:
    """Return three example commands: find the map at a position, get the network, get all layers as KML."""
    access = f'-H "Authorization: Bearer {token}" ' if token else ""
    return [
        f'curl {access}"{server}/api/v1/environments?contains={DATUM[0]},{DATUM[1]}"',
        f'curl {access}"{server}/maps/{NAME}/tmap2"',
        f'curl {access}-o {NAME}.kml "{server}/maps/{NAME}/kml"',
    ]
