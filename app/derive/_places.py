"""Words on a network: nodes of doors, aisles, rows and rooms take the names of these areas."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from app.model.areas import AREA_KINDS
from app.model.features import Features, Properties, from_columns, points, short_id, unique_ids
from app.model.frame import is_writable
from app.model.layers import Layers

Metres = NDArray[np.float64]

STRIPS = ("aisle", "row")

SNAP = 0.4
"""Distance in metres up to which an existing node stands for a place; else an edge gets a node there."""

ENDS = ("in", "out")
"""Suffixes of the nodes at the ends of an aisle or row: the end with the lower coordinate along its axis is in."""


@dataclass(frozen=True, slots=True)
class Place:
    """Point that gets a named node. owner: name of its area. reach: maximum distance of the network. area: polygon that
    the node must be in."""

    name: str
    owner: str
    at: tuple[float, float]
    reach: float
    area: Any = None


@dataclass(slots=True)
class _Net:
    """Network as arrays: positions and ids of nodes, undirected edges with their properties by direction."""

    xy: list[tuple[float, float]]
    ids: list[str]
    edges: dict[tuple[int, int], Properties]
    used: set[int]


def named(network: Features, layers: Layers, level: str) -> tuple[Features, int]:
    """Return a derived network with the names of a level's areas, and the number of areas without a node.

    A door has one node, an aisle or row a node in its middle and ``/in`` and ``/out`` at its ends, a room or corridor
    the node nearest to its middle. Where there is no node, the nearest edge is divided. Such a node has the area's
    name as its id and name; the id is on one line, and cut if it is long. All nodes in an area have its name as
    ``area``; those in aisles and rows that of these.
    """
    areas = _areas(layers, level)
    if not areas or not len(network):
        return network, 0
    net = _net(network)
    titles: dict[int, Place] = {}
    missing = 0
    for kind, name, shape in sorted(areas, key=lambda area: (AREA_KINDS.index(area[0]) < 2, area[1])):
        hits = [node for place in _places(kind, name, shape) if (node := _node(net, place, titles)) is not None]
        missing += not hits
    return _features(net, titles, areas), missing


def _areas(layers: Layers, level: str) -> list[tuple[str, str, Any]]:
    """Return kind, name and polygon in metres of a level's areas."""
    out = []
    for part in layers.vector("zones", level).values():
        chosen = part.select([k for k, p in enumerate(part.properties) if p.get("kind") in AREA_KINDS])
        for i, p, shape in zip(chosen.ids, chosen.properties, chosen.in_local(layers.frame), strict=True):
            if shapely.get_dimensions(shape) == 2 and not shape.is_empty:
                name = p.get("name")
                polygon = shapely.make_valid(shapely.force_2d(shape))
                out.append((str(p["kind"]), name if isinstance(name, str) and name else i, polygon))
    return out


def _places(kind: str, name: str, shape: Any) -> list[Place]:
    """Return the points of an area that get a named node."""
    corners = shapely.get_coordinates(shapely.minimum_rotated_rectangle(shape))
    if len(corners) < 4:
        return []
    sides = np.hypot(*np.diff(corners[:4], axis=0, append=corners[:1]).T)
    middle = shapely.centroid(shape)
    if kind == "door":
        return [Place(name, "", (middle.x, middle.y), max(SNAP, float(sides.max()) / 2))]
    if kind not in STRIPS:
        inside = middle if shape.contains(middle) else shapely.point_on_surface(shape)
        return [Place(name, name, (inside.x, inside.y), np.inf, shape)]
    short = 0 if sides[0] <= sides[1] else 1
    ends = np.array([corners[k : k + 2].mean(axis=0) for k in (short, short + 2)])
    axis = int(np.argmax(np.abs(ends[1] - ends[0])))
    ends = ends[np.argsort(ends[:, axis], kind="stable")]
    reach = max(SNAP, float(sides.min()))
    at = [(float(x), float(y)) for x, y in ends]
    suffixed = [Place(f"{name}/{end}", name, place, reach) for end, place in zip(ENDS, at, strict=True)]
    return [Place(name, name, (middle.x, middle.y), reach / 2 + SNAP, shape), *suffixed]


def _net(network: Features) -> _Net:
    kinds = [p.get("kind") for p in network.properties]
    nodes = [k for k, kind in enumerate(kinds) if kind == "node"]
    place = {network.ids[k]: n for n, k in enumerate(nodes)}
    edges = {
        (place[str(p["source"])], place[str(p["target"])]): p
        for p, kind in zip(network.properties, kinds, strict=True)
        if kind == "edge"
    }
    xy = [(float(x), float(y)) for x, y in shapely.get_coordinates(network.geometry[nodes]).tolist()]
    return _Net(xy, [network.ids[k] for k in nodes], edges, set())


def _node(net: _Net, place: Place, titles: dict[int, Place]) -> int | None:
    """Return the node of a place, and note its name; None if the network does not come near."""
    xy = np.array(net.xy)
    at = np.array(place.at)
    distance = np.hypot(*(xy - at).T)
    distance[list(net.used)] = np.inf
    if place.area is not None:
        distance[~shapely.contains_xy(place.area, xy)] = np.inf
    node = int(np.argmin(distance))
    near = float(distance[node])
    if near > SNAP and np.isfinite(place.reach):
        divided = _divide(net, place)
        node, near = (node, near) if divided is None else (divided, 0.0)
    if not np.isfinite(near) or near > place.reach:
        return None
    net.used.add(node)
    titles[node] = place
    return node


def _divide(net: _Net, place: Place) -> int | None:
    """Divide the edge nearest to a place, and return the new node; None if there is none within reach."""
    pairs = np.array(list(net.edges), np.int64).reshape(-1, 2)
    if not len(pairs):
        return None
    xy = np.array(net.xy)
    a, b = xy[pairs[:, 0]], xy[pairs[:, 1]]
    along = b - a
    length2 = np.maximum((along**2).sum(axis=1), 1e-12)
    share = np.clip(((np.array(place.at) - a) * along).sum(axis=1) / length2, 0.0, 1.0)
    foot = a + share[:, None] * along
    distance = np.hypot(*(foot - place.at).T)
    rest = np.sqrt(length2) * np.minimum(share, 1.0 - share)
    distance[rest < SNAP / 2] = np.inf
    k = int(np.argmin(distance))
    if not distance[k] <= place.reach:
        return None
    node = len(net.xy)
    x, y = np.round(foot[k], 9) + 0.0
    net.xy.append((float(x), float(y)))
    net.ids.append(place.name)
    first, last = pairs[k].tolist()
    for p, q in ((first, last), (last, first)):
        properties = net.edges.pop((p, q), None)
        if properties is not None:
            net.edges[p, node] = net.edges[node, q] = properties
    return node


def _features(net: _Net, titles: dict[int, Place], areas: list[tuple[str, str, Any]]) -> Features:
    """Return the network as features, nodes first."""
    xy = np.array(net.xy)
    inside = _area_names(xy, areas)
    taken = {name for k, name in enumerate(net.ids) if k not in titles}
    ids = list(net.ids)
    for k, name in zip(titles, unique_ids(map(_node_id, titles.values()), taken), strict=True):
        ids[k] = name
        inside[k] = titles[k].owner or inside[k]
    properties: list[Properties] = []
    for k, i in enumerate(ids):
        area = {"area": inside[k]} if inside[k] else {}
        properties.append({"kind": "node", "name": titles[k].name if k in titles else i, **area})
    pairs = sorted(net.edges)
    properties += [{**net.edges[a, b], "source": ids[a], "target": ids[b]} for a, b in pairs]
    lines = shapely.linestrings(xy[np.array(pairs, np.int64).reshape(-1, 2)]) if pairs else np.empty(0, object)
    geometry = np.concatenate([points(xy), np.asarray(lines, object)])
    edges = unique_ids([short_id(f"{ids[a]}_{ids[b]}") for a, b in pairs], set(ids))
    return from_columns([*ids, *edges], geometry, properties, "local")


def _node_id(place: Place) -> str:
    """Return the id of a place's node: an area's name is any text."""
    return short_id("".join(c if is_writable(c) else " " for c in place.name))


def _area_names(xy: Metres, areas: list[tuple[str, str, Any]]) -> list[str]:
    """Return for each node the name of the area that it is in, empty if none; smaller areas go first."""
    out = [""] * len(xy)
    for kind, name, shape in sorted(areas, key=lambda area: -float(shapely.area(area[2]))):
        if kind != "door":
            for k in np.flatnonzero(shapely.contains_xy(shape, xy)).tolist():
                out[k] = name
    return out
