"""What OSM's tags mean in our words, and back: kinds, measures, speeds, directions, the edges of a way."""

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
"""The keys that say what an element is, most telling first (OSM wiki: Map features)."""

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
"""A closed way with one of these is an area (OSM wiki: Area), unless it says ``area=no``."""

LINES = frozenset({"coastline", "cliff", "tree_row", "ridge", "arete", "valley", "track", "slipway", "citywalls"})
"""Values of such keys that are lines all the same."""

Direction = Literal["both", "forward", "backward"]

FORWARD = frozenset({"yes", "true", "1", "reversible", "alternating"})
BACKWARD = frozenset({"-1", "reverse"})
BOTH = frozenset({"no", "false", "0"})


def direction(tags: Mapping[str, Any]) -> Direction:
    """Which way along its nodes a way may be used.

    ``oneway`` decides. Without it roundabouts and motorways are one-way, their links too: to drive against a link's
    traffic is worse than not to drive there. A reversible way is taken as it was drawn, never in both directions.
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
    """Whether an element is only there to say that it is gone."""
    return attributes.get("action") == "delete" or attributes.get("visible") == "false"


KINDS: Mapping[str, Mapping[Any, str]] = {
    "natural": {"tree": "tree", "water": "water"},
    "waterway": dict.fromkeys(
        ("river", "stream", "canal", "ditch", "drain", "tidal_channel", "riverbank", "dock"), "water"
    ),
    "landuse": {"basin": "water", "reservoir": "water"},
}
"""By a main tag's key and value, the kind where the key itself tells too little."""


def object_kind(tags: Mapping[str, Any], otherwise: str) -> str:
    """The key of the main tag, or what its value says more plainly."""
    main_key = next((key for key in MAIN_TAGS if key in tags and tags[key] != "no"), None)
    if main_key is None:
        return str(tags["type"]) if otherwise == "relation" and tags.get("type") else otherwise
    if main_key in KINDS:
        return KINDS[main_key].get(tags[main_key], main_key)
    return "building" if main_key == "building:part" else main_key


_MEASURES = frozenset({"height", "building:levels", "min_height", "building:min_level", "width", "est_width"})
_MEASURES |= {"diameter", "circumference"}
_SPOKEN = {"name": "name", "height": "height", "base": "min_height", "width": "width"}
"""Canonical words of objects, and the tag that says each."""

_EDGE_TAGS = frozenset({"maxspeed", "maxspeed:forward", "maxspeed:backward", "width", "est_width", "lanes"})
_EDGE_TAGS |= {"surface", "access"}


def object_properties(tags: Mapping[str, Any]) -> dict[str, Any]:
    """The canonical words that an object's tags say, but for its kind. A highway's measures are its edges'."""
    out: dict[str, Any] = {}
    if name := tags.get("name"):
        out["name"] = name
    if "highway" in tags or _MEASURES.isdisjoint(tags):
        return out
    values = {"height": osm_tags.height(tags), "base": osm_tags.base(tags), "width": osm_tags.width(tags)}
    return out | {key: value for key, value in values.items() if value is not None}


def edge_properties(tags: Mapping[str, Any], heading: Literal["forward", "backward"]) -> dict[str, Any]:
    """The canonical words that a highway's tags say of its edges in one direction."""
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
    """Whether a canonical value says something else than the tags; one that is absent says nothing."""
    if isinstance(now, str):
        return now not in ("", source_value)
    if isinstance(now, bool) or not isinstance(now, int | float) or now <= 0:
        return False
    return not isinstance(source_value, int | float) or abs(now - source_value) > 1e-6 * now


def _number(value: Any) -> str:
    return plain(repr(round(float(value), 9))).removesuffix(".0")


def kmh(value: float) -> str:
    """A speed in m/s as a tag says it."""
    return plain(f"{value * 3.6:.6g}")


def is_area(tags: Mapping[str, Any]) -> bool:
    """Whether a closed way encloses something rather than going around it."""
    if "area" in tags:
        return bool(tags["area"] != "no")
    return any(k in AREAS and tags[k] not in LINES and tags[k] != "no" for k in tags) and "barrier" not in tags


@dataclass(slots=True)
class Edges:
    """The directed edges of one way: parallel lists. segment: index of the first of the two refs."""

    segment: list[int] = field(default_factory=list)
    ids: list[str] = field(default_factory=list)
    source: list[int] = field(default_factory=list)
    target: list[int] = field(default_factory=list)


LOOP = "self_loop"
"""The tag of ways that are an edge from a node to itself, ``yes``. Without it a node twice in a row is a mistake."""


def is_loop(refs: Sequence[int], tags: Mapping[str, Any]) -> bool:
    """Whether a way is an edge from a node to itself, and not a mistake in the data."""
    return len(refs) == 2 and refs[0] == refs[1] and tags.get(LOOP) == "yes"


def way_edges(way: int, refs: Sequence[int], tags: Mapping[str, Any], absent: Set[int]) -> Edges:
    """The edges that a way means: reader and writer must agree on them, ids included. absent: nodes without a place."""
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
    """An object's own words with the tags that its name and measures say now. A highway's are its edges'."""
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
    """A highway's tags with the words that its edges say now. changes: by direction; ways: those that are there."""
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
