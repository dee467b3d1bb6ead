"""What formats and derivations can do, as clients and the command line see it: no web, no store."""

from __future__ import annotations

from typing import Any

from app import derive, formats, parameters
from app.derive import Derivation
from app.formats import Format
from app.model.layers import CONTENT_LAYERS, Layer


def describe_format(known: Format) -> dict[str, Any]:
    """Describe a format as JSON.

    ``information`` is what a file of it gives, itself or by derivation.
    """
    return {
        "id": known.name,
        "title": known.title,
        "files": list(known.files),
        "media_types": list(known.media_types),
        "read": known.read is not None,
        "write": known.write is not None,
        "options": _options(known),
        "information": {layer: _information(known, layer) for layer in CONTENT_LAYERS},
    }


def describe_formats() -> list[dict[str, Any]]:
    """Describe every format, by name."""
    return [describe_format(known) for known in formats.all_formats().values()]


def describe_derivation(known: Derivation) -> dict[str, Any]:
    """Describe a derivation as JSON."""
    return {
        "id": known.name,
        "title": known.title,
        "gives": known.gives,
        "needs": sorted(known.needs),
        "cost": known.cost,
        "version": known.version,
        "parameters": parameters.describe(known.parameters),
    }


def describe_derivations() -> list[dict[str, Any]]:
    """Describe every derivation, by name."""
    return [describe_derivation(known) for known in derive.all_derivations().values()]


def _options(known: Format) -> list[dict[str, Any]]:
    """Describe the parameters of a format, those of its maps (``for: write``) and of an upload (``for: read``)."""
    written = [{**p, "for": "write"} for p in parameters.describe(known.write_options)] if known.write else []
    read = [{**p, "for": "read"} for p in parameters.describe(known.read_options)] if known.read else []
    return written + read


def _information(known: Format, layer: Layer) -> str:
    carried = known.carries - ({"occupancy"} if known.outlines else frozenset())  # where a grid lies is no grid
    if layer in carried:
        return "raw"
    return "derived" if derive.plan(carried, frozenset({layer})) is not None else "-"
