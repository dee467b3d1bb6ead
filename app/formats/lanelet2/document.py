"""File content that is being written: points, ways and relations, and their ids."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import chain
from typing import Any

import numpy as np

from app.formats import WriteContext
from app.formats._network import get_source_properties
from app.formats.lanelet2.tags import GENERATOR, LOCAL, NAME, decimal
from app.formats.osm import xml_text
from app.formats.osm.xml_text import NO_ATTRIBUTES, as_texts, attribute_text, element_id, integers
from app.model.layers import Layers, PartKey
from app.syntax.decimals import number


@dataclass(slots=True)
class Point:
    """A point to write. at: (lon, lat) of the source if the file also has metres, else None."""

    xyz: tuple[float, float, float]
    local: bool
    tags: Mapping[str, str] = field(default_factory=dict)
    attributes: Mapping[str, str] = field(default_factory=dict)
    at: tuple[float, float] | None = None
    stored: bool = True
    vertex: bool = False


@dataclass(slots=True)
class Level:
    """Ids of one level's elements in the file: stored id -> id."""

    nodes: dict[int, int] = field(default_factory=dict)
    ways: dict[int, int] = field(default_factory=dict)
    relations: dict[int, int] = field(default_factory=dict)


class Document:
    """File content that is being written: points, ways and relations by their ids in the file, and the losses.

    levels: ids of stored elements in the file. explained: for each network, the items that stored lanelets represent.
    moved: those of them that are no longer at the lanelets' position. metric: stored positions are metres of another
    frame.
    """

    def __init__(self, layers: Layers, context: WriteContext) -> None:
        self.layers, self.context = layers, context
        self.points: dict[int, Point] = {}
        self.ways: dict[int, tuple[list[int], Mapping[str, str], Mapping[str, str]]] = {}
        self.relations: dict[int, tuple[list[tuple[str, int, str]], Mapping[str, str], Mapping[str, str]]] = {}
        self.levels: dict[str, Level] = {}
        self.lost: Counter[str] = Counter()
        self.children: dict[tuple[str, int], Any] = {}
        self.explained: dict[PartKey, set[str]] = {}
        self.moved: dict[PartKey, set[str]] = {}
        own_parts = [part for key, part in layers.vector("objects").items() if key.name == NAME]
        self.documents = [
            source_members for part in own_parts if isinstance(source_members := part.document.get(NAME), Mapping)
        ]
        self.projector = next((s for d in self.documents if isinstance(s := d.get("projector"), str)), None)
        self.metric = any(part.local.any() for part in own_parts)
        rows = [get_source_properties(p, NAME) for part in own_parts for p in part.properties]
        self.taken = {k[1] for part in own_parts for i in part.ids if (k := element_id(i))}
        self.taken.update(chain.from_iterable(integers(source_members.get("refs")) or () for source_members in rows))
        self.counter = 0
        # In a map with metres of another frame, new points have a position on earth only.
        self.say_metres = self.metric or not any(
            LOCAL[0] in as_texts(t) for source_members in rows for t in _iterate_tags(source_members)
        )

    def next_id(self) -> int:
        """Return a new id; points, ways and relations share one sequence of numbers."""
        self.counter += 1
        while self.counter in self.taken:
            self.counter += 1
        self.taken.add(self.counter)
        return self.counter

    def unknown(self, kind: str, number: int, source_members: Mapping[str, Any]) -> None:
        """Store the elements inside an element that OSM does not define."""
        if source_members.get("children"):
            self.children[kind, number] = source_members["children"]

    def to_anchor(self, x: float, y: float, z: float | None, local: bool) -> tuple[float, float, float]:
        """Convert a position in metres to the anchor of a point."""
        high = math.nan if z is None else z
        if local or self.layers.frame is None:
            return x, y, high
        lon, lat = np.round(self.layers.frame.to_wgs84(np.array([[x, y]]))[0], 12).tolist()
        return lon, lat, high

    def add_point(self, x: float, y: float, z: float, tags: Mapping[str, str] = NO_ATTRIBUTES) -> int:
        """Add a point at a position in metres and return its id."""
        new = self.next_id()
        point_tags = dict(tags)
        if self.say_metres:
            point_tags |= {LOCAL[0]: number(x), LOCAL[1]: number(y)}
        if not math.isnan(z):
            point_tags["ele"] = number(z)
        self.points[new] = Point((x, y, z), True, point_tags, stored=False)
        return new

    def point_in_metres(self, point: Point) -> tuple[float, float] | None:
        """Return [x, y], or None if the point has no position in metres."""
        if point.local:
            return point.xyz[:2]
        if self.layers.frame is None or math.isnan(point.xyz[0]):
            return None
        x, y = self.layers.frame.to_local(np.array([point.xyz[:2]]))[0].tolist()
        return x, y

    def text(self) -> bytes:
        """Return the file. The document is empty afterwards."""
        nodes = self._nodes_in_degrees()
        return xml_text.document(self._head(), nodes, self.ways, self.relations, self.children)

    def _nodes_in_degrees(self) -> dict[int, xml_text.Node]:
        """Return all points in degrees with their tags."""
        todo = [i for i, p in self.points.items() if p.local and not (self.metric or math.isnan(p.xyz[0]))]
        degrees: dict[int, tuple[float, float]] = {}
        if todo and self.layers.frame is not None:
            places = self.layers.frame.to_wgs84(np.array([self.points[i].xyz[:2] for i in todo], np.float64))
            degrees = {i: (x, y) for i, (x, y) in zip(todo, places.tolist(), strict=True)}
        out = {}
        while self.points:  # frees each point before the next: there may be millions
            i, point = self.points.popitem()
            if not point.local:
                lon, lat = point.xyz[:2]
            else:
                lon, lat = degrees.get(i) or point.at or (math.nan, math.nan)
            out[i] = xml_text.Node(lon, lat, self._tags(point), point.attributes)
        return out

    def _tags(self, point: Point) -> Mapping[str, str]:
        """Return the stored tags, updated to the current position."""
        tags = point.tags
        if not point.stored:
            return tags
        x, y, z = point.xyz
        if point.local and not math.isnan(x) and (decimal(tags.get(LOCAL[0])), decimal(tags.get(LOCAL[1]))) != (x, y):
            tags = {**tags, LOCAL[0]: number(x), LOCAL[1]: number(y)}
        elif not point.local and LOCAL[0] in tags and (point.at is None or point.at != (x, y)):
            tags = {k: v for k, v in tags.items() if k not in LOCAL}
            self.lost["local_x and local_y of moved points"] += 1
        elevation = decimal(tags["ele"]) if "ele" in tags else 0.0
        if not math.isnan(z) and z != elevation and not (math.isnan(elevation) and z == 0.0):
            tags = {**tags, "ele": number(z)}
        return tags

    def _head(self) -> list[str]:
        root: dict[str, str] = {"version": "0.6", "generator": GENERATOR}
        for one in self.documents:
            root |= as_texts(one.get("attributes"))
        root["version"] = "0.6"
        if self.context.attribution and not root.keys() & {"attribution", "copyright", "license"}:
            root["attribution"] = "; ".join(self.context.attribution)
        lines = [f"<osm{attribute_text(root, frozenset())}>"]
        for one in self.documents:
            lines += xml_text.element_lines(one.get("elements"))
            boxes = one.get("bounds")
            lines += [f" <bounds{attribute_text(as_texts(b), frozenset())}/>" for b in boxes or [] if as_texts(b)]
        return lines


def _iterate_tags(source_members: Mapping[str, Any]) -> Iterable[Any]:
    """Return the tags of a stored point or of a way's bends."""
    bends = source_members.get("vertices")
    rows = bends if isinstance(bends, list) else [bends]
    return [source_members.get("tags"), *(row.get("tags") for row in rows if isinstance(row, Mapping))]


def is_same_place(a: tuple[float, float, float], b: tuple[float, float, float]) -> bool:
    """Whether two positions are equal; a missing elevation is equal to any."""
    high = math.isnan(a[2]) or math.isnan(b[2]) or a[2] == b[2]
    return a[0] == b[0] and a[1] == b[1] and high
