"""prm: the probabilistic roadmap that environment_common builds from a map's image, as YAML.

``nodes``: ``{id, x, y}``, whole pixels of the image, x from its left, y from its *top*; ``edges``: ``{from, to,
weight}`` between ids, bidirectional, with the distance in pixels as weight. Source: environment_common,
convertors/metric_to_prm.py, which writes ``topological/prm_autogen.yaml`` from ``metric/map/map.yaml``.

Pixels need their image to become positions: we write ``picture`` ({resolution, origin, height}, our extension) beside
the two lists. Without it the map's YAML and image are looked up in the upload (``metric/map/`` of an
environment_template, else beside the roadmap, else the only map.yaml), or options give all three. A node is at the
centre of its pixel, metres in the local frame. On writing, pixels are those of the stored grid ``map``, else of the
image that the roadmap came with, else of an assumed image that just contains the network. Weights of each source
are scaled from its own pixels to these.

Canonical: a node's id is its ``id`` as a text, an edge's ``<from>-<to>``; see ``_undirected`` for edges of both
directions. ``properties.prm`` contains ``more`` (further keys) and ``id`` if it is not an integer; the document's
``prm`` contains ``picture`` ({resolution, origin, height}), ``top`` (further keys of the file) and ``dangling`` (edges
to unknown nodes).
"""

from __future__ import annotations

import contextlib
import math
import posixpath
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from app.errors import FleetMapError, Problem, UnreadableFile
from app.formats import (
    BAD_INPUT,
    Claims,
    Files,
    Format,
    LayerRequirements,
    ReadContext,
    Selection,
    Traits,
    WriteContext,
    _fields,
    register,
)
from app.formats._fields import NOT_NEGATIVE, Number, record
from app.formats._network import (
    Array,
    Edge,
    MergedNetwork,
    check_name,
    duplicates,
    get_source_properties,
    identifier,
    is_name,
    merge_networks,
    natural_sort_key,
    node_points,
    number,
    raise_unreadable,
    report_3d_loss,
    shorten_list,
    source_document,
)
from app.formats._undirected import NODE_CANONICAL, Line, canonical, edges, lines, warn_isolated
from app.model.features import Properties, from_columns, unique_ids
from app.model.frame import GROUND, MAX_METRES
from app.model.grid import OccupancyGrid
from app.model.layers import MAP, NETWORK, Layers, PartKey
from app.parameters import parameter
from app.syntax import images, yaml

NAME = "prm"
FILE = "prm.yaml"
PICTURE = "picture"
OWN_KEYS = ("nodes", "edges", PICTURE)
_PIXEL = Number(-1e12, 1e12)
SHAPE = record(
    "picture",
    nodes=[record("id name", x=_PIXEL, y=_PIXEL)],
    edges=[record("from to", weight=NOT_NEGATIVE)],
)
"""Shape of the file."""

MAX_ROUNDING_PIXELS = 1e-4
"""Maximum distance from a whole pixel that counts as that pixel; metres are stored to a nanometre."""

SAME_SCALE = 1e-6
"""Relative difference within which two sizes of pixels are equal: files round them."""

SAME_LENGTH = 0.01
"""Relative difference from an edge's length within which a weight counts as that length."""

RESOLUTION = 0.05
"""Default size of a pixel of an assumed image, in metres."""

MARGIN = 1.0
"""Margin around the network in an assumed image, in metres."""

MAPS = ("map.yaml", "map.yml", "map_autogen.yaml")
MAP_STEMS = {name.partition(".")[0] for name in MAPS}
PICTURES = (".pgm", ".png", ".bmp", ".jpg", ".jpeg")


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """Image that the pixels belong to, for a roadmap that is uploaded without its map."""

    resolution: float | None = parameter(
        None, "pixel size of the map's image, for a roadmap without its map", minimum=1e-6, maximum=1e4, unit="m"
    )
    origin: tuple[float, float, float] = parameter(
        (0.0, 0.0, 0.0), "x,y,yaw of the image's lower left corner (metres, radians), for a roadmap without its map"
    )
    height: int | None = parameter(
        None, "height of the map's image in pixels, for a roadmap without its map", minimum=1, maximum=2**31
    )


@dataclass(frozen=True, slots=True)
class _Picture:
    """Georeference of an image: metres per pixel, (x, y, yaw) of the lower left corner, rows."""

    resolution: float
    origin: tuple[float, float, float]
    height: int

    def metres(self, pixels: Array) -> Array:
        """Convert pixels [n, 2] (x from the left, y from the top) to the metres [n, 2] of their centres."""
        x, y, yaw = self.origin
        u = (pixels[:, 0] + 0.5) * self.resolution
        v = (self.height - 0.5 - pixels[:, 1]) * self.resolution
        cos, sin = math.cos(yaw), math.sin(yaw)
        return np.stack([x + cos * u - sin * v, y + sin * u + cos * v], axis=1)

    def pixels(self, metres: Array) -> Array:
        """Convert metres to pixels, not rounded."""
        x, y, yaw = self.origin
        dx, dy = metres[:, 0] - x, metres[:, 1] - y
        cos, sin = math.cos(yaw), math.sin(yaw)
        u, v = (cos * dx + sin * dy) / self.resolution, (cos * dy - sin * dx) / self.resolution
        return np.stack([u - 0.5, self.height - 0.5 - v], axis=1)

    def as_dict(self) -> dict[str, Any]:
        """Return the members for the document."""
        return {"resolution": self.resolution, "origin": list(self.origin), "height": self.height}


# --- reading ---------------------------------------------------------------------------------------------------------
def read(files: Files, context: ReadContext) -> Layers:
    """Read the roadmap as topology. Raises UnreadableFile naming the node, or what to supply if the map is unknown."""
    if not context.wants("topology"):
        return Layers()
    main = context.main or next(iter(files))
    top = yaml.load(files[main], context.limits)
    if not isinstance(top, dict) or not isinstance(top.get("nodes"), list):
        reason = "a roadmap must be a mapping with a list of nodes"
        raise UnreadableFile(f"{main}: {reason}", [Problem(reason, main, where="nodes")])
    picture = _picture(top.get(PICTURE), files, main, context)
    names, pixels, rests = _nodes(top["nodes"])
    if repeats := duplicates(names):
        context.warn(
            f"{len(repeats)} duplicate ids: {shorten_list(repeats)}; edges connect to the first node of that id"
        )
    if len(pixels) and (pixels.min() < -0.5 or pixels[:, 1].max() > picture.height - 0.5):
        context.warn(f"some nodes lie outside the map's image ({picture.height} rows)")
    _fields.check(top, SHAPE, context)
    index_by_name = {name: k for k, name in reversed(list(enumerate(names)))}
    ids = unique_ids(map(identifier, names))
    xyz = np.concatenate([picture.metres(pixels), np.zeros((len(names), 1))], axis=1)
    if len(xyz) and np.abs(xyz).max() > MAX_METRES:
        raise_unreadable(f"nodes must be within ±{MAX_METRES:g} m", "nodes")
    file_lines, dangling = _edges(top.get("edges"), index_by_name, context)
    warn_isolated(len(names), (k for line in file_lines for k in (line.a, line.b)), names, context)
    properties: list[Properties] = []
    for i, name, extra_members in zip(ids, names, rests, strict=True):
        canonical_members = canonical(("name",), extra_members)
        more = {key: value for key, value in extra_members.items() if key not in canonical_members and key != "id"}
        source_members: dict[str, Any] = {"more": more} if more else {}
        if "id" in extra_members or name != i:
            source_members["id"] = extra_members.get("id", name)
        properties.append({"kind": "node", **canonical_members, NAME: source_members})
    edge_ids, shapes, edge_properties = edges(file_lines, ids, xyz, NAME)
    document: dict[str, Any] = {"picture": picture.as_dict()}
    extra_members = {key: value for key, value in top.items() if key not in OWN_KEYS}
    document |= ({"top": extra_members} if extra_members else {}) | ({"dangling": dangling} if dangling else {})
    geometry = np.empty(len(ids) + len(shapes), object)
    geometry[:] = [*node_points(xyz), *shapes]
    part = from_columns([*ids, *edge_ids], geometry, [*properties, *edge_properties], "local", {NAME: document})
    return Layers({PartKey("topology", context.level, NETWORK): part})


def _picture(members: Any, files: Files, main: str, context: ReadContext) -> _Picture:
    """Return the image's georeference: from the options, else the file itself, else the map beside it."""
    options = context.options if isinstance(context.options, ReadOptions) else ReadOptions()
    if options.resolution is not None and options.height is not None:
        _check_origin(options.origin, main)
        return _Picture(options.resolution, options.origin, options.height)
    if members is not None:
        return _parse_picture(members)
    for name in related_files(main, list(files)):
        if not name.lower().endswith((".yaml", ".yml")):
            continue
        try:
            beside = yaml.load(files[name], context.limits)
            rows = images.read_size(_image_of(name, str(beside["image"]), files), context.limits)[1]
            return _parse_picture({**beside, "height": rows})
        except (*BAD_INPUT, FleetMapError):  # the map's own reader reports its errors
            continue
    reason = (
        "the nodes are pixels of a map's image: add that map (map.yaml and its image) to the upload, or set the "
        "options resolution, origin and height"
    )
    raise UnreadableFile(f"{main}: {reason}", [Problem(reason, main, where="nodes")])


def _image_of(name: str, image: str, files: Files) -> bytes:
    """Return the image that a map's YAML file names: at its path, else by its name beside the YAML file."""
    folder = posixpath.dirname(name)
    beside = posixpath.join(folder, re.split(r"[/\\]", image)[-1])
    return files.get(posixpath.normpath(posixpath.join(folder, image))) or files[beside]


def _parse_picture(members: Any) -> _Picture:
    """Check and return a mapping's resolution, origin and height."""
    if not isinstance(members, dict):
        raise_unreadable("must be a mapping with resolution, origin and height", PICTURE)
    origin, height = members.get("origin"), members.get("height")
    if not isinstance(origin, list) or len(origin) != 3:
        raise_unreadable("must be [x, y, yaw]", f"{PICTURE}.origin")
    if isinstance(height, bool) or not isinstance(height, int) or not 1 <= height <= 2**31:
        raise_unreadable("must be an integer above 0", f"{PICTURE}.height")
    resolution = number(members.get("resolution"), f"{PICTURE}.resolution")
    if not 1e-6 <= resolution <= 1e4:
        raise_unreadable("must be between 1e-6 and 1e4 metres", f"{PICTURE}.resolution")
    x, y, yaw = (number(v, f"{PICTURE}.origin") for v in origin)
    if max(map(abs, (x, y, yaw))) > MAX_METRES:
        raise_unreadable(f"must be within ±{MAX_METRES:g}", f"{PICTURE}.origin")
    return _Picture(resolution, (x, y, yaw), height)


def _check_origin(origin: Sequence[float], file: str) -> None:
    if not all(math.isfinite(v) and abs(v) <= MAX_METRES for v in origin):
        reason = f"origin must be three numbers within ±{MAX_METRES:g}"
        raise UnreadableFile(f"{file}: {reason}", [Problem(reason, file, where="origin")])


def related_files(main: str, names: Sequence[str]) -> Iterable[str]:
    """Return maps of the upload that the pixels may belong to, likeliest first, and their images.

    Images are those beside them, and in folders below those that are named like a map.
    """
    folder = main.rpartition("/")[0]
    root = folder.rpartition("/")[0] if folder.rpartition("/")[2] == "topological" else None
    likely = [] if root is None else [f"{root}/metric/map".lstrip("/")]
    folders = dict.fromkeys([*likely, folder])
    maps = [f"{f}/{m}".lstrip("/") for f in folders for m in MAPS]
    name_set = set(names)
    maps = [n for n in maps if n in name_set]
    if not maps:
        every = [n for n in sorted(name_set) if n.rpartition("/")[2] in MAPS]
        maps = every if len({n.rpartition("/")[0] for n in every}) == 1 else []
    homes = {n.rpartition("/")[0] for n in maps}
    pictures = [n for n in sorted(name_set) if n.lower().endswith(PICTURES)]
    beside = [n for n in pictures if n.rpartition("/")[0] in homes]
    above = tuple(f"{home}/".lstrip("/") for home in homes)
    below = [n for n in pictures if n.startswith(above) and posixpath.basename(n).rpartition(".")[0] in MAP_STEMS]
    return [*(n for n in maps if n != main), *dict.fromkeys([*beside, *below])]


def _nodes(entries: Sequence[Any]) -> tuple[list[str], Array, list[dict[str, Any]]]:
    """Return ids as texts, float64 [n, 2] pixels, and further keys, with ``id`` if it is not an integer."""
    names, rows, rests = [], [], []
    for k, node in enumerate(entries):
        location = f"nodes[{k}]"
        if not isinstance(node, dict):
            raise_unreadable("a node must be a mapping with id, x and y", location)
        extra_members = {key: value for key, value in node.items() if key not in ("id", "x", "y")}
        names.append(_id(node.get("id"), f"{location}.id"))
        if not isinstance(node["id"], int):
            extra_members["id"] = node["id"]
        rows.append((number(node.get("x"), f"{location}.x"), number(node.get("y"), f"{location}.y")))
        if max(map(abs, rows[-1])) > 1e12:
            raise_unreadable("pixel coordinates must be within ±1e12", location)
        rests.append(extra_members)
    return names, np.array(rows, np.float64).reshape(-1, 2), rests


def _id(value: Any, location: str) -> str:
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        raise_unreadable("an id must be a number or a string", location)
    return check_name(value if isinstance(value, str) else yaml.text(value), location)


def _edges(
    entries: Any, index_by_name: Mapping[str, int], context: ReadContext
) -> tuple[list[Line], list[dict[str, Any]]]:
    """Return the edges between nodes, and the dangling ones unchanged."""
    if entries is not None and not isinstance(entries, list):
        raise_unreadable("must be a list", "edges")
    file_lines, dangling = [], []
    for k, edge in enumerate(entries or ()):
        location = f"edges[{k}]"
        if not isinstance(edge, dict):
            raise_unreadable("an edge must be a mapping with from and to", location)
        ends = [_id(edge.get(end), f"{location}.{end}") for end in ("from", "to")]
        absent = [end for end in ends if end not in index_by_name]
        if absent:
            context.warn(
                f"unknown node {absent[0]!r}; the edge is stored but is not part of the network", where=location
            )
            dangling.append(edge)
            continue
        if ends[0] == ends[1]:
            context.warn(f"{ends[0]} is connected to itself", where=location)
        extra_members = {key: value for key, value in edge.items() if key not in ("from", "to")}
        if "weight" in extra_members:
            number(extra_members["weight"], f"{location}.weight")
        file_lines.append(Line(index_by_name[ends[0]], index_by_name[ends[1]], extra_members))
    return file_lines, dangling


# --- writing ---------------------------------------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class WriteOptions:
    """Values to write if no source has them."""

    pixel_size: float = parameter(
        RESOLUTION, "pixel size of the assumed image, if no map's image is known", minimum=1e-3, maximum=100.0, unit="m"
    )


def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """Write ``prm.yaml``: all networks as one roadmap, nodes in natural order of ids, edges by their nodes.

    Nodes of other formats move to the centres of their pixels; ids that are not integers are replaced by numbers (the
    id becomes the ``name``). Raises MissingDatum for wgs84 items without a datum.
    """
    net = merge_networks(layers, context)
    report_3d_loss(net, context, "pixels have no altitude and no level")
    net = _sort_nodes(net)
    document = source_document(layers, NAME)
    xy = np.array([(n.x, n.y) for n in net.nodes], np.float64).reshape(-1, 2)
    picture = _select_picture(layers, document, xy, context)
    pixels = _pixels(net, picture.pixels(xy), picture.resolution, context)
    ids = _ids(net)
    top = document.get("top")
    top = {key: v for key, v in top.items() if key not in OWN_KEYS} if isinstance(top, dict) else {}
    out = [yaml.mapping(top, 0)] if top else []
    out += ["nodes:\n", *_node_texts(net, ids, pixels, context)] if net.nodes else ["nodes: []\n"]
    net.edges = _scale_weights(net.edges, layers, picture.resolution)
    dangling = _dangling(document, picture.resolution)
    line_texts = [*_line_texts(net, ids, pixels, context), *(_edge(e.pop("from"), e.pop("to"), e) for e in dangling)]
    out += ["edges:\n", *line_texts] if line_texts else ["edges: []\n"]
    out.append(yaml.mapping({PICTURE: picture.as_dict()}, 0))
    return {FILE: "".join(out).encode()}


def _pixels(net: MergedNetwork, exact: Array, resolution: float, context: WriteContext) -> Array:
    """Return float64 [n, 2] pixels of the nodes: whole numbers, except for a roadmap's own fractional ones."""
    near = np.round(exact)
    own_nodes = np.array([NAME in n.properties for n in net.nodes], bool)
    is_integer = np.asarray((np.abs(exact - near) <= MAX_ROUNDING_PIXELS).all(axis=1), bool)
    moved = int((~is_integer & ~own_nodes).sum())
    context.drop("positions of nodes within their pixels", moved, f"pixels of {resolution:g} m are whole numbers")
    # The pixel that contains the position, including its left and lower edge.
    inside = np.stack(
        [np.floor(exact[:, 0] + 0.5 + MAX_ROUNDING_PIXELS), np.ceil(exact[:, 1] - 0.5 - MAX_ROUNDING_PIXELS)], axis=1
    )
    return np.where(is_integer[:, None], near, np.where(own_nodes[:, None], np.round(exact, 6), inside))


def _node_texts(net: MergedNetwork, ids: Sequence[Any], pixels: Array, context: WriteContext) -> list[str]:
    out = []
    dropped_count = renamed = 0
    for k, (node, i) in enumerate(zip(net.nodes, ids, strict=True)):
        p = node.properties
        more = get_source_properties(p, NAME).get("more")
        members = {key: v for key, v in more.items() if key not in ("id", "x", "y")} if isinstance(more, dict) else {}
        called = p.get("name")
        if isinstance(called, str) and called:
            members["name"] = called
        elif str(i) != node.id and NAME not in p:
            members["name"] = node.id
        renamed += str(i) != node.id and NAME not in p
        dropped_count += bool(p.keys() - NODE_CANONICAL - {NAME})
        x, y = (yaml.text(_plain(v)) for v in pixels[k].tolist())
        out.append(f"- id: {yaml.text(i)}\n  x: {x}\n  y: {y}\n{yaml.mapping(members, 2) if members else ''}")
    context.drop("attributes of nodes", dropped_count, "the format cannot store them")
    if renamed:
        context.warn(f"{renamed} nodes got a number as id; their old id is used as name unless they had one")
    return out


def _scale_weights(network: Sequence[Edge], layers: Layers, resolution: float) -> list[Edge]:
    """Convert the weights of edges from the pixels of their own network's image to those of this size in metres."""
    parts = layers.vector("topology")
    scales = {key: _scale(get_source_properties(part.document, NAME), resolution) for key, part in parts.items()}
    out = []
    for edge in network:
        members = get_source_properties(edge.properties, NAME)
        more = members.get("more")
        if isinstance(more, dict) and "weight" in more:
            more = {**more, "weight": _scaled(more["weight"], scales[edge.part])}
            out.append(replace(edge, properties={**edge.properties, NAME: {**members, "more": more}}))
        else:
            out.append(edge)
    return out


def _dangling(document: Mapping[str, Any], resolution: float) -> list[dict[str, Any]]:
    """Return the source's edges to unknown nodes, with weights in pixels of this size in metres."""
    scale = _scale(document, resolution)
    listed = document.get("dangling")
    listed = listed if isinstance(listed, list) else []
    edges_ = [dict(e) for e in listed if isinstance(e, dict) and {"from", "to"} <= e.keys()]
    return [{**e, "weight": _scaled(e["weight"], scale)} if "weight" in e else e for e in edges_]


def _scale(document: Mapping[str, Any], resolution: float) -> float:
    """Return the pixels of this size in metres per pixel of the document's image; 1 if they are equal or unknown."""
    source = _source_picture(document)
    scale = 1.0 if source is None else source.resolution / resolution
    return 1.0 if math.isclose(scale, 1.0, rel_tol=SAME_SCALE) else scale


def _scaled(weight: Any, scale: float) -> Any:
    """Scale a weight; what is no number, and a weight at scale 1, stays as it is."""
    is_weight = isinstance(weight, (int, float)) and not isinstance(weight, bool) and scale != 1.0
    return round(weight * scale, 9) if is_weight else weight


def _line_texts(net: MergedNetwork, ids: Sequence[Any], pixels: Array, context: WriteContext) -> list[str]:
    """Return the texts of the edges between nodes."""
    weighed = other = 0
    out = []
    for line in lines(net, context, NAME):
        members = {key: v for key, v in line.members.items() if key not in ("from", "to")}
        length = round(float(np.hypot(*(pixels[line.a] - pixels[line.b]))), 9)
        weight = members.get("weight")
        if not isinstance(weight, (int, float)):
            members["weight"] = length
            weighed += 1
        else:
            other += abs(weight - length) > max(1.0, SAME_LENGTH * length)
        out.append(_edge(ids[line.a], ids[line.b], members))
    if other:
        context.warn(f"{other} edges have a weight that is not their length in pixels; it is kept", where="edges")
    if weighed:
        context.fill("edges: weight", "distance in pixels", f"{weighed} edges come from a format without weights")
    return out


def _edge(a: Any, b: Any, members: dict[str, Any]) -> str:
    weight = f"  weight: {yaml.text(members['weight'])}\n" if isinstance(members.get("weight"), (int, float)) else ""
    extra_members = {key: value for key, value in members.items() if key != "weight" or not weight}
    ends = f"- from: {yaml.text(a)}\n  to: {yaml.text(b)}\n"
    return f"{ends}{weight}{yaml.mapping(extra_members, 2) if extra_members else ''}"


def _plain(value: float) -> float:
    return int(value) if float(value).is_integer() else value


def _sort_nodes(net: MergedNetwork) -> MergedNetwork:
    """Sort the network's nodes by id."""
    order = sorted(range(len(net.nodes)), key=lambda k: natural_sort_key(net.nodes[k].id))
    new_index = {old: new for new, old in enumerate(order)}
    moved = [
        type(e)(e.id, new_index[e.source], new_index[e.target], e.properties, e.geometry, e.part) for e in net.edges
    ]
    return MergedNetwork([net.nodes[k] for k in order], moved, net.levels)


_WHOLE_NUMBER = re.compile(r"(?:0|[1-9][0-9]{0,17})\Z", re.ASCII)


def _ids(net: MergedNetwork) -> list[Any]:
    """Return the ids to write: integers and a roadmap's own texts unchanged, unused numbers for the others."""
    out: list[Any] = []
    for node in net.nodes:
        source_id = get_source_properties(node.properties, NAME).get("id")
        keep = isinstance(source_id, (int, float)) or (isinstance(source_id, str) and is_name(source_id))
        if keep and not isinstance(source_id, bool):
            out.append(source_id)
        elif _WHOLE_NUMBER.match(node.id):
            out.append(int(node.id))
        else:
            out.append(None)
    taken = {i for i in out if isinstance(i, int)}
    free = 0
    for k, i in enumerate(out):
        if i is None:
            while free in taken:
                free += 1
            out[k] = free
            free += 1
    return out


def _select_picture(layers: Layers, document: Mapping[str, Any], xy: Array, context: WriteContext) -> _Picture:
    """Return the image to whose pixels positions are converted."""
    grids = layers.grids()
    keys = choose(sorted(grids), None)
    if keys:
        grid: OccupancyGrid = grids[keys[0]]
        return _Picture(grid.resolution, grid.origin, grid.height)
    source_picture = _source_picture(document)
    if source_picture is not None:
        return source_picture
    low = np.floor(xy.min(axis=0) - MARGIN) if len(xy) else np.zeros(2)
    high = np.ceil(xy.max(axis=0) + MARGIN) if len(xy) else np.ones(2)
    size = context.options.pixel_size if isinstance(context.options, WriteOptions) else RESOLUTION
    rows = max(1, math.ceil((high[1] - low[1]) / size))
    picture = _Picture(size, (float(low[0]), float(low[1]), 0.0), rows)
    item = "picture: resolution, origin, height"
    context.fill(item, picture.as_dict(), "no map's image is known", "pixel_size")
    return picture


def _source_picture(document: Mapping[str, Any]) -> _Picture | None:
    """Return the image that the roadmap came with."""
    picture = document.get("picture")
    if isinstance(picture, dict):
        with contextlib.suppress(UnreadableFile):  # the document may have been edited
            return _parse_picture(picture)
    return None


def choose(keys: Sequence[PartKey], options: Any) -> Sequence[PartKey]:  # noqa: ARG001 - one signature for all formats
    """Select the networks, and the grid for pixels: ``map``, else the only one; on the ground level first."""
    grids = [key for key in keys if key.layer == "occupancy"]
    names = {key.name for key in grids}
    grids = [key for key in grids if key.name == MAP or len(names) == 1]
    grids.sort(key=lambda key: (key.level != GROUND, key))
    return [*(key for key in keys if key.layer == "topology"), *grids[:1]]


# --- detection -------------------------------------------------------------------------------------------------------
_NODES = re.compile(rb"(?m)^nodes[ \t]*:[ \t]*\r?\n[ \t]*- +\{?(?:id|x|y)[ \t]*:")
_EDGES = re.compile(rb"(?m)^edges[ \t]*:")
_EDGE = re.compile(rb"[\s{,](?:from|to)[ \t]*:")


def detect(name: str, data: bytes) -> bool:
    """Detect YAML with a list of nodes that begin with id, x or y, and with edges from and to."""
    if not name.lower().endswith((".yaml", ".yml")) or not _NODES.search(data[: 2**16]):
        return False
    match = _EDGES.search(data)
    return bool(match and (_EDGE.search(data, match.end()) or re.match(rb"[ \t]*\[\]", data[match.end() :][:8])))


register(
    Format(
        name=NAME,
        title="Probabilistic roadmap (environment_common)",
        files={FILE: "application/yaml"},
        layers=frozenset({"topology", "occupancy"}),
        detect=detect,
        read=read,
        write=write,
        needs=LayerRequirements(one_of=(frozenset({"topology"}),), anchor="local", also=frozenset({"occupancy"})),
        read_options=ReadOptions,
        write_options=WriteOptions,
        extensions=(".yaml", ".yml"),
        version=4,
        selection=Selection(choose),
        claims=Claims(priority=3, related_files=related_files, gives_way=True),
        traits=Traits(outlines=True, keeps_bends="nodes"),
    )
)
