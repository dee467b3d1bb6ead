"""Descriptions of formats and derivations for clients and the command line; needs no web server and no store."""

from __future__ import annotations

from typing import Any

from app import derive, formats, parameters
from app.derive import Derivation
from app.formats import Format
from app.model.layers import CONTENT_LAYERS, Layer


def describe_format(fmt: Format) -> dict[str, Any]:
    """Describe a format as JSON.

    ``information``: the layers that a file of it provides, directly or by derivation.
    """
    return {
        "id": fmt.name,
        "title": fmt.title,
        "files": list(fmt.files),
        "media_types": list(fmt.files.values()),
        "read": fmt.read is not None,
        "write": fmt.write is not None,
        "options": _options(fmt),
        "information": {layer: _information(fmt, layer) for layer in CONTENT_LAYERS},
    }


def describe_formats() -> list[dict[str, Any]]:
    """Describe every format, by name."""
    return [describe_format(fmt) for fmt in formats.all_formats().values()]


def describe_derivation(derivation: Derivation) -> dict[str, Any]:
    """Describe a derivation as JSON."""
    return {
        "id": derivation.name,
        "title": derivation.title,
        "gives": derivation.gives,
        "needs": sorted(derivation.needs),
        "cost": derivation.cost,
        "version": derivation.version,
        "parameters": parameters.describe(derivation.parameters),
    }


def describe_derivations() -> list[dict[str, Any]]:
    """Describe every derivation, by name."""
    return [describe_derivation(derivation) for derivation in derive.all_derivations().values()]


def _options(fmt: Format) -> list[dict[str, Any]]:
    """Describe the parameters of a format, those of its maps (``for: write``) and of an upload (``for: read``)."""
    written = [{**p, "for": "write"} for p in parameters.describe(fmt.write_options)] if fmt.write else []
    read = [{**p, "for": "read"} for p in parameters.describe(fmt.read_options)] if fmt.read else []
    return written + read


def _information(fmt: Format, layer: Layer) -> str:
    carried = fmt.layers - ({"occupancy"} if fmt.traits.outlines else frozenset())  # the outline of a grid is no grid
    if layer in carried:
        return "raw"
    return "derived" if derive.plan(carried, frozenset({layer})) is not None else "-"
