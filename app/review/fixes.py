"""Edits that repair a network, as ``POST /edits`` takes them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import shapely
import shapely.geometry
import shapely.ops

from app.model.features import Properties
from app.model.geodesy import LocalFrame
from app.review.findings import Fix
from app.review.network import Item, Network

Change = Mapping[str, Any]

CANONICAL = frozenset({"kind", "action", "speed_limit", "width", "surface", "access", "stairs"})
"""Properties of an edge that a new edge beside it takes; data of formats stay with the edge that was read."""


class Fixer:
    """Builder of edits for one network."""

    def __init__(self, network: Network, frame: LocalFrame | None) -> None:
        self._network, self._frame = network, frame
        self._taken = {item.id for item in (*network.nodes, *network.edges)}
        self._reserved: set[str] = set()

    def delete(self, item: Item) -> Change:
        """Delete a node or an edge."""
        return {"op": "delete", "layer": "topology", "level": item.key.level, "name": item.key.name, "id": item.id}

    def rename(self, item: Item, name: str) -> Change:
        """Put a node with another name."""
        part = self._network.parts[item.key]
        geometry, is_local = part.geometry[item.row], bool(part.local[item.row])
        return self._put(item, item.id, {**item.properties, "name": name}, geometry, is_local=is_local)

    def move(self, item: Item, xy: tuple[float, float]) -> Change:
        """Put a node at another position; its edges follow."""
        old = self._network.parts[item.key].geometry[item.row]
        height = shapely.get_coordinates(old, include_z=True)[0][2:] if old.has_z else ()
        return self._put_local(item, item.id, item.properties, shapely.Point(*xy, *height))

    def add_node(self, beside: Item, xy: tuple[float, float], node_id: str) -> Change:
        """Put a new node into the part of an item."""
        return self._put_local(beside, node_id, {"kind": "node", "name": node_id}, shapely.Point(xy))

    def add_edge(self, beside: Item, source: str, target: str, line: Any, like: Properties | None = None) -> Change:
        """Put a new edge into the part of an item. like: properties of an edge beside it."""
        kept = {name: value for name, value in (like or {}).items() if name in CANONICAL}
        properties = {**kept, "kind": "edge", "source": source, "target": target}
        return self._put_local(beside, self.new_id(f"{source}_{target}"), properties, line)

    def split(self, edge: int, node_id: str, xy: tuple[float, float]) -> list[Change]:
        """Replace an edge by two that meet at a node: the first keeps its id."""
        item, line = self._network.edges[edge], self._network.lines[edge]
        at = line.project(shapely.Point(xy))
        before, after = shapely.ops.substring(line, 0, at), shapely.ops.substring(line, at, line.length)
        kept = {name: value for name, value in item.properties.items() if name != "bends"}
        first = shapely.LineString([*_corners(before)[:-1], _at_height(before, xy)])
        second = shapely.LineString([_at_height(before, xy), *_corners(after)[1:]])
        return [
            self._put_local(item, item.id, {**kept, "target": node_id}, first),
            self._put_local(item, self.new_id(f"{item.id}#2"), {**kept, "source": node_id}, second),
        ]

    def new_id(self, wanted: str) -> str:
        """Return an id that no node and no edge has, and reserve it."""
        out, count = wanted[:480], 1
        while out in self._taken:
            count += 1
            out = f"{wanted[:480]}-{count}"
        self._taken.add(out)
        self._reserved.add(out)
        return out

    def build(self, title: str, changes: Iterable[Change]) -> Fix:
        """Build a fix and give back the ids of its new features: each fix is applied alone."""
        out = Fix(title, tuple(changes))
        self._taken -= self._reserved
        self._reserved.clear()
        return out

    def _put_local(self, beside: Item, item_id: str, properties: Properties, geometry: Any) -> Change:
        """Put a feature with a geometry in metres, converted if the item beside it is on earth."""
        is_local = bool(self._network.parts[beside.key].local[beside.row])
        if not is_local and self._frame is not None:
            geometry = self._frame.geometries_to_wgs84(np.array([geometry], object))[0]
        return self._put(beside, item_id, properties, geometry, is_local=is_local)

    def _put(self, beside: Item, item_id: str, properties: Properties, geometry: Any, *, is_local: bool) -> Change:
        feature = {
            "type": "Feature",
            "id": item_id,
            "geometry": shapely.geometry.mapping(geometry),
            "properties": dict(properties),
        }
        crs = "local" if is_local else "wgs84"
        part = {"level": beside.key.level, "name": beside.key.name}
        return {"op": "put", "layer": "topology", **part, "crs": crs, "feature": feature}


def _corners(line: Any) -> list[tuple[float, ...]]:
    """Return the corners of a line, or of the point that an empty piece of a line is."""
    return [tuple(at) for at in line.coords]


def _at_height(line: Any, xy: tuple[float, float]) -> tuple[float, ...]:
    """Return a position with the height of a line's end."""
    return (*xy, *_corners(line)[-1][2:])
