"""Networks from drawn lines: vertices become nodes, segments become directed edges.

Drawings (KML, GeoJSON) have no junctions. Vertices nearer than ``join`` metres are one node, and a line that ends on
another's segment splits it; lines that merely cross do not join, since a bridge crosses too. The drawing itself stays
an object: its nodes and edges name it in ``drawn_from``, so that a drawing format need not write it a second time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from app.errors import Invalid, Problem
from app.model.distinct import distinct
from app.model.features import MAX_ID, Features, Properties, short_id, unique_ids
from app.model.frame import MAX_DATUM_LATITUDE, MAX_METRES, Datum
from app.model.geodesy import LocalFrame, local_frame

Metres = NDArray[np.float64]
Places = NDArray[np.intp]

JOIN = 0.1
"""Default join distance in metres: drawings snapped by eye are off by millimetres, robots' goals are farther apart."""

MIN_JOIN = 1e-6
"""Minimum distance in metres within which vertices join: with less, only equal ones do, and a cell's number would
overflow.
"""

CARRIED = ("action", "speed_limit", "width", "tmap2")
"""Properties of a line that its edges inherit; the rest stays with the drawing."""

_FORWARD = frozenset({"yes", "true", "1", "1.0", "on", "forward"})
_BACKWARD = frozenset({"-1", "-1.0", "reverse", "backward"})
_POINT, _LINE, _RING, _POLYGON = 0, 1, 2, 3

Direction = Literal["both", "forward", "backward"]


def from_drawing(
    objects: Features,
    *,
    join: float = JOIN,
    frame: LocalFrame | None = None,
    outlines: bool = False,
    origins: Sequence[str] | None = None,
) -> Features:
    """Build the network that lines (and points of interest) draw.

    Lines are LineStrings, rings and their collections, of any kind; outlines: those of polygons too. Points count if
    their kind is ``poi``: such a node gets the point's id, position and properties, and absorbs vertices within
    ``join`` metres. A vertex is called ``<object id>/<index>`` (counted through the object), an edge ``<a>_<b>``; the
    first vertex in the objects' order gives a node its id, its exact position and its anchor. Each segment becomes two
    edges, one if the line has ``oneway`` (yes, true, 1; or -1 for against the drawing). origins: value of
    ``drawn_from`` for each object, by default its id. Distances are measured in ``frame``, or, without one and with
    items on earth, in a local frame at the middle of the data. Raises Invalid if lines cover more than that frame can.
    """
    drawing = _Drawing(objects, outlines)
    xy = _metres(drawing, frame)
    if not np.isfinite(xy).all() or (np.abs(xy) > MAX_METRES).any():
        reason = "the lines cover too much of the earth for one network: upload the lines of one site"
        raise Invalid(reason, [Problem(reason)])
    node = _cluster(xy, join, len(drawing.poi_owner))
    leaders = np.flatnonzero(node == np.arange(len(node)))
    segments = _split(drawing, xy, node, join)
    return _assemble(drawing, leaders, segments, origins or objects.ids)


def direction(properties: Properties) -> Direction:
    """Return the direction of use of a line: its ``oneway``, at any depth of a format's further attributes."""
    value = _find(properties, 3)
    word = str(value).strip().lower()
    if word in _FORWARD:
        return "forward"
    return "backward" if word in _BACKWARD else "both"


def _find(value: Any, depth: int) -> Any:
    """Return ``oneway`` from nested properties, or from a list of ``{name, value}``; the outermost wins."""
    if isinstance(value, Mapping):
        if "oneway" in value:
            return value["oneway"]
        if value.get("name") == "oneway" and "value" in value:
            return value["value"]
    nested = value.values() if isinstance(value, Mapping) else value if isinstance(value, list) else ()
    for inner in nested if depth else ():
        if isinstance(inner, Mapping | list) and (inner_value := _find(inner, depth - 1)) is not None:
            return inner_value
    return None


class _Drawing:
    """The vertices of all points and lines: pois first, then line vertices in the objects' order.

    raw: [v, 3] coordinates as they are anchored, z NaN if absent. owner: [v] index of the object. number: [v] the
    vertex' index within its object. first, last: indices of the ends of each line. closed: per line.
    """

    def __init__(self, objects: Features, outlines: bool) -> None:
        self.objects = objects
        types = shapely.get_type_id(objects.geometry) if len(objects) else np.empty(0, np.int64)
        kinds = np.array([p.get("kind") == "poi" for p in objects.properties], bool)
        empty = shapely.is_empty(objects.geometry) if len(objects) else np.empty(0, bool)
        self.poi_owner: Places = np.flatnonzero(kinds & (types == _POINT) & ~empty)
        lines, line_owner = _lines(objects.geometry, outlines)
        points = shapely.get_coordinates(objects.geometry[self.poi_owner], include_z=True)
        vertices, line = shapely.get_coordinates(lines, include_z=True, return_index=True)
        self.raw: Metres = np.concatenate([points, vertices])
        self.owner: Places = np.concatenate([self.poi_owner, line_owner[line]]).astype(np.intp)
        counts = np.bincount(line, minlength=len(lines)).astype(np.intp)
        used = counts > 0
        self.line_owner: Places = line_owner[used]
        counts = counts[used]
        self.last: Places = np.cumsum(counts) - 1 + len(points)
        self.first: Places = self.last - counts + 1
        same = self.raw[self.first, :2] == self.raw[self.last, :2]
        self.closed = same.all(axis=1) & (counts > 2)
        place = np.arange(len(vertices))
        changes = np.flatnonzero(np.diff(self.owner[len(points) :], prepend=-1))
        begins = np.repeat(changes, np.diff(np.append(changes, len(vertices))))
        self.number: Places = np.concatenate([np.zeros(len(points), np.intp), place - begins]).astype(np.intp)


def _lines(geometry: NDArray[np.object_], outlines: bool) -> tuple[NDArray[np.object_], Places]:
    """Return all lines among the geometries, also inside collections, with the index of the object of each."""
    owner = np.arange(len(geometry), dtype=np.intp)
    parts = geometry
    while len(parts) and (shapely.get_type_id(parts) > _POLYGON).any():
        parts, index = shapely.get_parts(parts, return_index=True)
        owner = owner[index]
    types = shapely.get_type_id(parts) if len(parts) else np.empty(0, np.int64)
    line = (types == _LINE) | (types == _RING)
    out, owners = parts[line], owner[line]
    if outlines and (types == _POLYGON).any():
        areas = np.flatnonzero(types == _POLYGON)
        rings, index = shapely.get_rings(parts[areas], return_index=True)
        place = np.concatenate([np.flatnonzero(line), areas[index]])
        # back into drawing order: an object's lines and outlines keep their position
        order = np.argsort(place, kind="stable")
        out, owners = np.concatenate([out, rings])[order], np.concatenate([owners, owner[areas][index]])[order]
    return out, owners


def _metres(drawing: _Drawing, frame: LocalFrame | None) -> Metres:
    """Return [v, 2] metres; without a frame and with all items on earth, in a frame at the middle of the data."""
    flat = np.ascontiguousarray(drawing.raw[:, :2])
    local = drawing.objects.local[drawing.owner]
    if local.all():
        return flat
    if frame is None:
        if local.any():
            # raises MissingDatum, which explains how to set a datum
            drawing.objects.in_local(None)
        frame = middle_frame(flat)
    out = flat.copy()
    out[~local] = frame.to_local(flat[~local])
    return out


def middle_frame(lonlat: Metres) -> LocalFrame:
    """Build a local frame at the middle of points on earth: float64 [n, 2], longitude and latitude."""
    longitude = lonlat[:, 0]
    if longitude.max() - longitude.min() > 180.0:
        longitude = np.where(longitude < 0.0, longitude + 360.0, longitude)
    east = (float(longitude.min()) + float(longitude.max())) / 2.0
    north = (float(lonlat[:, 1].min()) + float(lonlat[:, 1].max())) / 2.0
    latitude = min(max(north, -MAX_DATUM_LATITUDE), MAX_DATUM_LATITUDE)
    return local_frame(Datum(latitude, east - 360.0 if east > 180.0 else east))


def _cluster(xy: Metres, join: float, fixed: int) -> Places:
    """Return for each vertex the index of its node's main vertex; the first ``fixed`` are main vertices.

    Greedy in order: a vertex joins the nearest node within ``join``, else it is a node of its own. (Linking neighbours
    in chains would shrink a densely digitised line to one node.)
    """
    n = len(xy)
    node = np.arange(n)
    if n == fixed:
        return node
    # equal positions first: they are the majority, and vectorised
    _, first, inverse = np.unique(xy.view(np.complex128).ravel(), return_index=True, return_inverse=True)
    node[fixed:] = first[inverse[fixed:]]
    if join < MIN_JOIN:
        return node
    heads = np.flatnonzero(node == np.arange(n))
    cell = np.floor(xy[heads] / join).astype(np.int64)
    crowded = _near_others(cell)
    # a cell contains at most four nodes, so each vertex is compared with at most 36, however dense the drawing is
    taken: dict[tuple[int, int], list[int]] = {}
    moved: dict[int, int] = {}
    limit = join * join
    for k, (i, j), (x, y) in zip(
        heads[crowded].tolist(), cell[crowded].tolist(), xy[heads[crowded]].tolist(), strict=True
    ):
        best, nearest = limit, k
        if k >= fixed:
            for a in (i - 1, i, i + 1):
                for b in (j - 1, j, j + 1):
                    for other in taken.get((a, b), ()):
                        distance = (xy[other, 0] - x) ** 2 + (xy[other, 1] - y) ** 2
                        if distance < best:
                            best, nearest = distance, other
        if nearest == k:
            taken.setdefault((i, j), []).append(k)
        else:
            moved[k] = nearest
    if moved:
        jump = np.arange(n)
        jump[list(moved)] = list(moved.values())
        node = jump[node]
    return node


def _near_others(cell: NDArray[np.int64]) -> Places:
    """Return indices of items whose cell or one of its eight neighbours contains another item."""
    row, column = _compact(cell[:, 0]), _compact(cell[:, 1])
    width = int(column.max()) + 3
    key = (row + 1) * width + column + 1
    cells, inverse, counts = np.unique(key, return_inverse=True, return_counts=True)
    near = counts > 1
    for step in (1, width - 1, width, width + 1):
        at = np.searchsorted(cells, cells + step)
        matched = at < len(cells)
        matched[matched] = cells[at[matched]] == cells[matched] + step
        near[matched] = True
        near[at[matched]] = True
    return np.flatnonzero(near[inverse])


def _compact(values: NDArray[np.int64]) -> NDArray[np.int64]:
    """Map values to small numbers in the same order that keep gaps between values: keys cannot overflow."""
    distinct, inverse = np.unique(values, return_inverse=True)
    rank = np.concatenate([np.zeros(1, np.int64), np.minimum(np.diff(distinct), 2).cumsum()])
    return np.asarray(rank[inverse], np.int64)


def _split(drawing: _Drawing, xy: Metres, node: Places, join: float) -> tuple[Places, Places, Places]:
    """Return the segments between nodes as (start, end, object) in drawing order, split at line ends and pois."""
    place = np.arange(len(drawing.poi_owner), len(xy))
    inner = np.ones(len(xy), bool)
    inner[drawing.last] = False
    begin = place[inner[place]]
    start, end, owner = node[begin], node[begin + 1], drawing.owner[begin]
    keep = start != end
    start, end, owner = start[keep], end[keep], owner[keep]
    open_line = ~drawing.closed
    tips = np.concatenate(
        [np.arange(len(drawing.poi_owner)), drawing.first[open_line], drawing.last[open_line]]
    ).astype(np.intp)
    tips = distinct(node[tips])
    if join <= 0.0 or not len(start) or not len(tips):
        return start, end, owner
    point, segment = _points_near_lines(
        shapely.points(xy[tips]), shapely.linestrings(np.stack([xy[start], xy[end]], axis=1)), join
    )
    p = tips[point]
    a, b = start[segment], end[segment]
    along = xy[b] - xy[a]
    t = ((xy[p] - xy[a]) * along).sum(axis=1) / np.maximum((along * along).sum(axis=1), 1e-300)
    inside = (p != a) & (p != b) & (t > 0.0) & (t < 1.0)
    if not inside.any():
        return start, end, owner
    p, segment, t = p[inside], segment[inside], t[inside]
    # one chain for each segment: its start, the nodes on it by distance, its end
    n = len(start)
    chain_segment = np.concatenate([np.arange(n), segment, np.arange(n)])
    chain_t = np.concatenate([np.full(n, -1.0), t, np.full(n, 2.0)])
    chain_node = np.concatenate([start, p, end])
    order = np.lexsort((chain_node, chain_t, chain_segment))
    s, v = chain_segment[order], chain_node[order]
    link = (s[1:] == s[:-1]) & (v[1:] != v[:-1])
    return v[:-1][link], v[1:][link], owner[s[:-1][link]]


def _points_near_lines(
    points: NDArray[np.object_], lines: NDArray[np.object_], distance: float
) -> tuple[Places, Places]:
    """Find pairs (point, line) within a distance, sorted; in portions of bounded memory (hostile drawings)."""
    tree = shapely.STRtree(lines)
    limit = 1_000_000 + 10 * (len(points) + len(lines))
    portion = max(1, 5_000_000 // len(lines))
    pair_blocks: list[NDArray[np.intp]] = []
    total = 0
    for begin in range(0, len(points), portion):
        pairs = tree.query(points[begin : begin + portion], predicate="dwithin", distance=distance)
        total += pairs.shape[1]
        if total > limit:
            reason = "too many overlapping lines: draw each path once, or use a smaller join distance"
            raise Invalid(reason, [Problem(reason)])
        pairs[0] += begin
        pair_blocks.append(pairs)
    pairs = np.concatenate(pair_blocks, axis=1)
    order = np.lexsort((pairs[1], pairs[0]))
    return pairs[0][order], pairs[1][order]


def _assemble(
    drawing: _Drawing, leaders: Places, segments: tuple[Places, Places, Places], origins: Sequence[str]
) -> Features:
    objects = drawing.objects
    pois = len(drawing.poi_owner)
    owners = drawing.owner[leaders].tolist()
    base = {k: short_id(objects.ids[k], 240) for k in set(owners[pois:])}
    names = [objects.ids[k] for k in owners[:pois]]
    names += [f"{base[k]}/{i}" for k, i in zip(owners[pois:], drawing.number[leaders[pois:]].tolist(), strict=True)]
    ids = unique_ids(names)
    properties: list[Properties] = []
    for k, i in zip(owners[:pois], ids, strict=False):
        object_properties = objects.properties[k]
        named = object_properties.get("name")
        properties.append(
            {**object_properties, "kind": "node", "name": named if named else i, "drawn_from": origins[k]}
        )
    properties += [
        {"kind": "node", "name": i, "drawn_from": origins[k]} for k, i in zip(owners[pois:], ids[pois:], strict=True)
    ]
    rank = np.empty(len(drawing.raw), np.intp)
    rank[leaders] = np.arange(len(leaders))
    a, b, by = _directed_edges(objects, rank[segments[0]], rank[segments[1]], segments[2])
    shared = {k: {w: objects.properties[k][w] for w in CARRIED if w in objects.properties[k]} for k in set(by)}
    edges = [f"{ids[p]}_{ids[q]}" for p, q in zip(a, b, strict=True)]
    if edges and max(map(len, edges)) > MAX_ID - 12:
        edges = [short_id(i, MAX_ID - 12) for i in edges]
    if len({*ids, *edges}) < len(ids) + len(edges):
        edges = unique_ids(edges, set(ids))
    properties += [
        {"kind": "edge", "source": ids[p], "target": ids[q], **shared[k], "drawn_from": origins[k]}
        for p, q, k in zip(a, b, by, strict=True)
    ]
    at = drawing.raw[leaders]
    anchors = objects.local[drawing.owner[leaders]]
    p, q = np.array(a, np.intp), np.array(b, np.intp)
    ends = np.stack([at[p], at[q]], axis=1)
    local = np.concatenate([anchors, anchors[p]])
    mixed = anchors[p] != anchors[q]
    geometry = np.concatenate([_geometries(at, shapely.points), _geometries(ends, shapely.linestrings)])
    if mixed.any():
        reason = "a line in local metres meets one in degrees: convert the drawing to one kind of coordinates first"
        raise Invalid(reason, [Problem(reason, where=edges[int(np.flatnonzero(mixed)[0])])])
    return Features((*ids, *edges), geometry, tuple(properties), local)


def _directed_edges(
    objects: Features, start: Places, end: Places, owner: Places
) -> tuple[list[int], list[int], list[int]]:
    """Return (from, to, object) of all directed edges, each pair of nodes once, the first in drawing order."""
    directions = {k: direction(objects.properties[k]) for k in set(owner.tolist())}
    pairs: dict[tuple[int, int], int] = {}
    for p, q, k in zip(start.tolist(), end.tolist(), owner.tolist(), strict=True):
        heading = directions[k]
        if heading != "backward":
            pairs.setdefault((p, q), k)
        if heading != "forward":
            pairs.setdefault((q, p), k)
    return [p for p, _ in pairs], [q for _, q in pairs], list(pairs.values())


def _geometries(coordinates: Metres, make: Any) -> NDArray[np.object_]:
    """Build geometries from [n, …, 3], two-dimensional if any z is absent."""
    n = len(coordinates)
    out = np.empty(n, object)
    if not n:
        return out
    flat = np.isnan(coordinates[..., 2]).reshape(n, -1).any(axis=1)
    if flat.any():
        out[flat] = make(np.ascontiguousarray(coordinates[flat][..., :2]))
    if not flat.all():
        out[~flat] = make(coordinates[~flat])
    return out
