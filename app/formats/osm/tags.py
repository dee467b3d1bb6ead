"""Convert OSM tags to canonical properties and back: kinds, sizes, speeds, directions, the edges of a way."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Literal

from app.formats.osm.xml_text import as_texts, plain
from app.model import osm_tags
from app.model.features import Properties

FAMILY = "osm"

MAIN_TAGS = (
    "highway",
    "building",
    "building:part",
    "barrier",
    "railway",
    "waterway",
    "aeroway",
    "aerialway",
    "power",
    "man_made",
    "amenity",
    "shop",
    "office",
    "craft",
    "emergency",
    "leisure",
    "tourism",
    "historic",
    "public_transport",
    "natural",
    "landuse",
    "military",
    "place",
    "boundary",
    "route",
)
"""Keys that determine an element's kind, most specific first (OSM wiki: Map features)."""

AREAS = frozenset(
    {
        "building",
        "building:part",
        "amenity",
        "shop",
        "office",
        "craft",
        "leisure",
        "tourism",
        "historic",
        "natural",
        "landuse",
        "military",
        "place",
        "boundary",
    }
)
"""Keys that make a closed way an area (OSM wiki: Area), unless it has ``area=no``."""

LINES = frozenset({"coastline", "cliff", "tree_row", "ridge", "arete", "valley", "track", "slipway", "citywalls"})
"""Values of such keys that are lines nevertheless."""

Direction = Literal["both", "forward", "backward"]

FORWARD = frozenset({"yes", "true", "1", "reversible", "alternating"})
BACKWARD = frozenset({"-1", "reverse"})
BOTH = frozenset({"no", "false", "0"})


def direction(tags: Mapping[str, Any]) -> Direction:
    """Return the directions in which a way may be used, relative to its nodes.

    ``oneway`` decides. Without it roundabouts and motorways are one-way, and so are their links: driving against a
    link's traffic is worse than not using it. A reversible way is one-way as drawn, never bidirectional.
    """
    oneway = str(tags.get("oneway", "")).strip().lower()
    if oneway in FORWARD:
        return "forward"
    if oneway in BACKWARD:
        return "backward"
    if oneway in BOTH:
        return "both"
    implied = tags.get("junction") in ("roundabout", "circular") or tags.get("highway") in ("motorway", "motorway_link")
    return "forward" if implied else "both"


def is_deleted(attributes: Mapping[str, Any]) -> bool:
    """Whether an element is marked as deleted."""
    return attributes.get("action") == "delete" or attributes.get("visible") == "false"


KINDS: Mapping[str, Mapping[Any, str]] = {
    "natural": {"tree": "tree", "water": "water"},
    "waterway": dict.fromkeys(
        ("river", "stream", "canal", "ditch", "drain", "tidal_channel", "riverbank", "dock"), "water"
    ),
    "landuse": {"basin": "water", "reservoir": "water"},
}
"""Kinds by a main tag's key and value, if the key alone is too general."""


def object_kind(tags: Mapping[str, Any], otherwise: str) -> str:
    """Return the key of the main tag, or a more specific kind from its value; without one, the tag ``kind``."""
    main_key = next((key for key in MAIN_TAGS if key in tags and tags[key] != "no"), None)
    if main_key is None and tags.get("kind"):
        return str(tags["kind"])  # of an object of another format, as it is written
    if main_key is None:
        return str(tags["type"]) if otherwise == "relation" and tags.get("type") else otherwise
    if main_key in KINDS:
        return KINDS[main_key].get(tags[main_key], main_key)
    return "building" if main_key == "building:part" else main_key


_MEASURES = frozenset({"height", "building:levels", "min_height", "building:min_level", "width", "est_width"})
_MEASURES |= {"diameter", "circumference"}
_SPOKEN = {"name": "name", "height": "height", "base": "min_height", "width": "width"}
"""Canonical properties of objects, and their tags."""

_EDGE_TAGS = frozenset({"maxspeed", "maxspeed:forward", "maxspeed:backward", "width", "est_width", "lanes"})
_EDGE_TAGS |= {"surface", "access"}


def object_properties(tags: Mapping[str, Any]) -> dict[str, Any]:
    """Return the canonical properties from an object's tags, except its kind. A highway's sizes belong to its edges."""
    out: dict[str, Any] = {}
    if name := tags.get("name"):
        out["name"] = name
    if "highway" in tags or _MEASURES.isdisjoint(tags):
        return out
    values = {"height": osm_tags.height(tags), "base": osm_tags.base(tags), "width": osm_tags.width(tags)}
    return out | {key: value for key, value in values.items() if value is not None}


def edge_properties(tags: Mapping[str, Any], heading: Literal["forward", "backward"]) -> dict[str, Any]:
    """Return the canonical properties of a highway's edges in one direction."""
    out: dict[str, Any] = {}
    if not _EDGE_TAGS.isdisjoint(tags):
        if limit := osm_tags.speed_limit(tags, heading):
            out["speed_limit"] = limit
        if width := osm_tags.way_width(tags):
            out["width"] = width
        out |= {key: tags[key] for key in ("surface", "access") if tags.get(key)}
    if tags.get("highway") == "steps":
        out["stairs"] = True
    return out


def differs(now: Any, source_value: Any) -> bool:
    """Whether a canonical value differs from the tags; an absent value does not."""
    if isinstance(now, str):
        return now not in ("", source_value)
    if isinstance(now, bool) or not isinstance(now, int | float) or now <= 0:
        return False
    return not isinstance(source_value, int | float) or abs(now - source_value) > 1e-6 * now


def _number(value: Any) -> str:
    return plain(repr(round(float(value), 9))).removesuffix(".0")


def kmh(value: float) -> str:
    """Format a speed in m/s as a tag's value."""
    return plain(f"{value * 3.6:.6g}")


def is_area(tags: Mapping[str, Any]) -> bool:
    """Whether a closed way is an area rather than a closed line."""
    if "area" in tags:
        return bool(tags["area"] != "no")
    return any(k in AREAS and tags[k] not in LINES and tags[k] != "no" for k in tags) and "barrier" not in tags


@dataclass(slots=True)
class Edges:
    """Directed edges of one way: parallel lists. segment: index of the first of the two refs."""

    segment: list[int] = field(default_factory=list)
    ids: list[str] = field(default_factory=list)
    source: list[int] = field(default_factory=list)
    target: list[int] = field(default_factory=list)


LOOP = "self_loop"
"""Tag of ways that are an edge from a node to itself, ``yes``. Without it a repeated node is a data error."""


def is_loop(refs: Sequence[int], tags: Mapping[str, Any]) -> bool:
    """Whether a way is an edge from a node to itself, and not a data error."""
    return len(refs) == 2 and refs[0] == refs[1] and tags.get(LOOP) == "yes"


def way_edges(way: int, refs: Sequence[int], tags: Mapping[str, Any], absent: Set[int]) -> Edges:
    """Return the edges of a way, for reader and writer alike, ids included. absent: nodes without a position."""
    out = Edges()
    seen: dict[str, int] = {}
    heading = direction(tags)
    loop = is_loop(refs, tags)
    forward, backward = loop or heading != "backward", not loop and heading != "forward"
    for k, (a, b) in enumerate(pairwise(refs)):
        if (a == b and not loop) or (absent and (a in absent or b in absent)):
            continue
        for is_edge, p, q in ((forward, a, b), (backward, b, a)):
            if is_edge:
                name = f"w{way}:{p}-{q}"
                times = seen[name] = seen.get(name, 0) + 1
                out.segment.append(k)
                out.ids.append(name if times == 1 else f"{name}#{times}")
                out.source.append(p)
                out.target.append(q)
    return out


EDGE_WORDS = ("speed_limit", "width", "surface", "access")


def object_tags(source_properties: Mapping[str, Any], p: Properties, i: str) -> Mapping[str, Any]:
    """Update an object's stored tags to its current name and sizes. A highway's belong to its edges."""
    tags = as_texts(source_properties.get("tags"))
    if "highway" in tags:
        return source_properties
    values = object_properties(tags)
    new = {w: v for w in _SPOKEN if differs(v := p.get(w), values.get(w)) and v != i}
    if not new:
        return source_properties
    new_tags = {_SPOKEN[w]: v if isinstance(v, str) else _number(v) for w, v in new.items()}
    return {**source_properties, "tags": {**tags, **new_tags}}


def way_tags(
    tags: Mapping[str, str], changes: Mapping[str, Mapping[str, Any]], headings: Set[str]
) -> Mapping[str, str]:
    """Update a highway's tags to its edges' current properties.

    changes: by direction; headings: the existing directions.
    """
    out = dict(tags)
    limits = {heading: new["speed_limit"] for heading, new in changes.items() if "speed_limit" in new}
    if limits and limits.keys() == headings and len(set(limits.values())) == 1:
        for key in ("maxspeed:forward", "maxspeed:backward"):
            out.pop(key, None)
        out["maxspeed"] = kmh(next(iter(limits.values())))
    else:
        out |= {f"maxspeed:{heading}": kmh(limit) for heading, limit in sorted(limits.items())}
    for new in changes.values():
        out |= {w: v if isinstance(v, str) else _number(v) for w, v in new.items() if w != "speed_limit"}
    return out


CARRIES = frozenset[Any]({"topology", "objects", "zones"})
