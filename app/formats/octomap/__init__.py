"""OctoMap files: an octree of log-odds (``.ot``) or of free and occupied voxels only (``.bt``).

A text header (``# Octomap OcTree file`` or ``# Octomap OcTree binary file``, comments, ``id``, ``size`` = nodes,
``res`` = metres, ``data``), then the tree depth first, children in ascending order, x in the lowest bit of an octant.
``.bt``: inner nodes only, two bits a child (1 free, 2 occupied, 3 inner, 0 unknown), octant 0 in the lowest, 16 bits
little endian. ``.ot``: every node, float32 log-odds little endian, for a ColorOcTree then red, green, blue, then a byte
with a bit for each child. Files of 2010 have a binary header: uint32 3, float64 resolution, uint32 nodes, and then the
``.bt`` stream. Source: octomap's AbstractOcTree::write, AbstractOccupancyOcTree::readBinary,
OccupancyOcTreeBase::writeBinaryNode.

Inner nodes carry no information: they are computed from the leaves (highest log-odds, mean colour), as by
``updateInnerOccupancy``. Written files equal those of the C++ library for the same tree byte for byte.

Frame: local; the tree is centred on the origin.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from app.errors import NotFound, Problem, TooLarge, UnreadableFile
from app.formats import Files, Format, LayerRequirements, Parts, ReadContext, Selection, WriteContext, register
from app.formats._select import file_stem, select_part
from app.formats.octomap import rules
from app.model.frame import is_writable
from app.model.layers import MAP, Layers, PartKey
from app.model.voxels import DEPTH, LOG_ODDS, UNSET, VoxelMap, coarser, cut, merge_to_parents, prune
from app.parameters import parameter

NAME = "octomap"
TEXT = b"# Octomap OcTree"
BINARY_FILE = b"# Octomap OcTree binary file"
FULL_FILE = b"# Octomap OcTree file"
COMMENTS = ("# (feel free to add / change comments, but leave the first line as it is!)", "#")
LEGACY = struct.Struct("<IdI")

OCTREE = "OcTree"
COLOR_OCTREE = "ColorOcTree"
FULL_TYPES = (OCTREE, COLOR_OCTREE, "OcTreeStamped")
"""Tree types whose ``.ot`` is read: OcTreeStamped does not write its times and is stored like an OcTree."""

HEADER_BYTES = 2**16
MAX_PENDING_NODES = 7 * DEPTH
"""Maximum number of pending nodes in a depth-first walk of a tree of this depth."""

Kind = Literal["bt", "ot"]
Words = NDArray[np.uint16]
Masks = NDArray[np.uint8]
Rows = NDArray[np.intp]


@dataclass(frozen=True, slots=True)
class WriteOptions:
    """Selection of the voxels, and their encoding."""

    name: str | None = parameter(None, "name of the voxel map; *: all; default: map, else the only one")
    level: str | None = parameter(None, "level of the voxel map; *: all; default: ground, or the only one that has it")
    kind: Literal["bt", "ot"] | None = parameter(
        None, "bt: free and occupied only; ot: log-odds and colours; default: as uploaded"
    )
    depth: int | None = parameter(
        None,
        f"level of detail: merge voxels below this depth ({DEPTH}: smallest voxels; each step down doubles their "
        "edge) into the most occupied of them",
        minimum=1,
        maximum=DEPTH,
    )
    bbox: tuple[float, float, float, float, float, float] | None = parameter(
        None,
        "keep only voxels that intersect this box: min x,min y,min z,max x,max y,max z in the local frame",
        unit="m",
    )
    prune: bool | None = parameter(
        None, "merge eight equal leaves into one; default: as in OctoMap, true for bt, false for ot"
    )


# --- detecting ----------------------------------------------------------------------------------------------------
def detect(name: str, data: bytes) -> bool:
    """Detect the first line, or the binary header of 2010 with plausible numbers."""
    del name
    if data.startswith(TEXT):
        return data.startswith((BINARY_FILE, FULL_FILE))
    if len(data) < LEGACY.size or data[:4] != b"\x03\0\0\0":
        return False
    _, resolution, size = LEGACY.unpack_from(data)
    inner = (len(data) - LEGACY.size) // 2
    return bool(1e-6 <= resolution <= 1e4) and inner <= size <= 1 + 8 * inner


@dataclass(frozen=True, slots=True)
class _Header:
    """Header of a file. body: offset of the tree's first byte."""

    kind: Kind
    id: str
    size: int
    resolution: float
    comments: tuple[str, ...]
    body: int


def _unreadable_error(reason: str, line: int | None = None, location: str | None = None) -> UnreadableFile:
    return UnreadableFile(reason, [Problem(reason, line=line, where=location)])


def _header(data: bytes, context: ReadContext) -> _Header:
    if not data.startswith(TEXT):
        return _legacy_header(data, context)
    kind: Kind = "bt" if data.startswith(BINARY_FILE) else "ot"
    if kind == "ot" and not data.startswith(FULL_FILE):
        raise _unreadable_error(f"the first line must be {FULL_FILE.decode()!r} or {BINARY_FILE.decode()!r}", 1)
    entries: dict[str, tuple[str, int]] = {}
    comments: list[str] = []
    position, number = data.find(b"\n") + 1, 1
    while True:
        end = data.find(b"\n", position, HEADER_BYTES)
        if position == 0 or end < 0:
            raise _unreadable_error("incomplete header: the line 'data' is missing", number, "data")
        number += 1
        line, position = data[position:end].rstrip(b"\r"), end + 1
        tokens = line.split()
        while tokens:
            token = tokens.pop(0)
            if token == b"data":
                return _header_from_ids(kind, entries, tuple(comments), position, context)
            if token.startswith(b"#"):
                comments.append(_decode_text(line[line.index(b"#") :]))
                break
            key = _decode_text(token)
            if key not in ("id", "res", "size") or not tokens:
                context.warn(f"unknown keyword {key[:40]!r} in the header; it is ignored", line=number, where=key[:40])
                break
            entries[key] = (_decode_text(tokens.pop(0)), number)


def _decode_text(text: bytes) -> str:
    try:
        return text.decode()
    except UnicodeDecodeError:
        return text.decode("latin-1")


def _header_from_ids(
    kind: Kind, entries: Mapping[str, tuple[str, int]], comments: tuple[str, ...], body: int, context: ReadContext
) -> _Header:
    for key in ("id", "size", "res"):
        if key not in entries:
            raise _unreadable_error(f"the header has no {key}", location=key)
    name, line = entries["id"]
    if name == "1":
        context.warn("the id 1 is obsolete; it is read as OcTree", line=line, where="id")
        name = OCTREE
    if kind == "ot" and name not in FULL_TYPES:
        reason = f"unsupported .ot type {name[:80]!r}: must be one of {', '.join(FULL_TYPES)}: save it as .bt"
        raise _unreadable_error(reason, line, "id")
    if not re.fullmatch(r"\w{1,80}", name, re.ASCII):
        raise _unreadable_error(f"the tree's type must be a word, got {name[:80]!r}", line, "id")
    size, line = entries["size"]
    if not re.fullmatch(r"\d{1,12}", size, re.ASCII):
        raise _unreadable_error(f"size must be the number of nodes, got {size[:40]!r}", line, "size")
    resolution, line = entries["res"]
    if not re.fullmatch(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", resolution, re.ASCII):
        raise _unreadable_error(f"res must be a number of metres, got {resolution[:40]!r}", line, "res")
    _check_resolution(float(resolution), line)
    is_default = comments == COMMENTS
    user_comments = () if is_default else tuple(c for c in comments if is_writable(c.replace("\t", " ")))
    if len(user_comments) < len(comments) and not is_default:
        context.warn("comments with control characters are dropped")
    return _Header(kind, name, int(size), float(resolution), user_comments, body)


def _check_resolution(resolution: float, line: int | None = None) -> None:
    if not 1e-6 <= resolution <= 1e4:
        raise _unreadable_error(f"the resolution must be between 1e-6 and 1e4 metres, got {resolution!r}", line, "res")


def _legacy_header(data: bytes, context: ReadContext) -> _Header:
    if len(data) < LEGACY.size or data[:4] != b"\x03\0\0\0":
        raise _unreadable_error(f"the first line must be {FULL_FILE.decode()!r} or {BINARY_FILE.decode()!r}", 1)
    _, resolution, size = LEGACY.unpack_from(data)
    _check_resolution(resolution)
    context.warn("an OctoMap file of 2010 has no text header; it is written with the current one")
    return _Header("bt", OCTREE, size, resolution, (), LEGACY.size)


# --- reading ------------------------------------------------------------------------------------------------------
def read(files: Files, context: ReadContext) -> Layers:
    """Read one voxel map. Raises UnreadableFile (with line and keyword of the header, or the reason) or TooLarge."""
    main = context.main or next(iter(files))
    data = files[main]
    header = _header(data, context)
    if not context.wants("voxels"):
        return Layers()
    if header.size > context.limits.voxels:
        raise TooLarge(f"the tree has {header.size} nodes; the limit is {context.limits.voxels}")
    colour: NDArray[np.uint8] | None = None
    if header.size == 0 and len(data) == header.body:
        depth, code, odds = np.empty(0, np.uint8), np.empty(0, np.uint64), np.empty(0, np.float32)
        colour = np.empty((0, 3), np.uint8) if header.id == COLOR_OCTREE and header.kind == "ot" else None
    elif header.kind == "bt":
        depth, code, odds = _read_binary(data, header)
    else:
        depth, code, odds, colour = _read_full(data, header)
    if not len(depth):
        context.warn("the tree has no voxels; the voxel map is empty")
    source_properties: dict[str, Any] = {}
    if header.id != (COLOR_OCTREE if colour is not None else OCTREE):
        source_properties["id"] = header.id
    if header.comments:
        source_properties["comments"] = list(header.comments)
    properties = {NAME: source_properties} if source_properties else {}
    voxels = VoxelMap(header.resolution, depth, code, odds, colour, header.kind == "bt", properties)
    name = context.grid or main.rpartition("/")[2].rpartition(".")[0] or MAP
    return Layers({PartKey("voxels", context.level, name): voxels})


def _read_binary(data: bytes, header: _Header) -> tuple[NDArray[np.uint8], NDArray[np.uint64], NDArray[np.float32]]:
    """Return depth, code and log-odds of the leaves of a stream of inner nodes."""
    body_size = len(data) - header.body
    if body_size % 2:
        raise _unreadable_error(f"the tree has {body_size} bytes: must be a multiple of 16 bits", location="data")
    if body_size // 2 > header.size:
        raise _unreadable_error(
            f"the header declares {header.size} nodes, but the data has {body_size // 2} inner nodes alone",
            location="size",
        )
    masks: Words = np.frombuffer(data, "<u2", body_size // 2, header.body).astype(np.uint16, copy=False)
    inner = _pack_bits(masks & (masks >> np.uint16(1)))
    leaves = _pack_bits(masks ^ (masks >> np.uint16(1)))
    count = int(np.bitwise_count(leaves).sum(dtype=np.int64))
    _check_size(len(masks) + count, header)
    occupied = _pack_bits((masks & ~(masks << np.uint16(1))) >> np.uint16(1))
    at_depth = _split_by_depth(inner, DEPTH - 1)
    if len(masks) > 1 and bool((masks == 0).any()):
        raise _unreadable_error("an inner node has no children", location="data")
    codes, depths, states = [], [], []
    code = np.zeros(1, np.uint64)
    for depth, rows in enumerate(at_depth):
        node, octant = _children(leaves[rows])
        codes.append(code[node] << np.uint64(3) | octant)
        depths.append(np.full(len(node), depth + 1, np.uint8))
        states.append(occupied[rows][node] >> octant.astype(np.uint8) & np.uint8(1))
        node, octant = _children(inner[rows])
        code = code[node] << np.uint64(3) | octant
    code, depth_, state = np.concatenate(codes), np.concatenate(depths), np.concatenate(states)
    up = np.multiply(np.uint8(DEPTH) - depth_, np.uint8(3), dtype=np.uint64)
    order = np.argsort(code << up)
    return depth_[order], code[order], np.array(LOG_ODDS)[state[order]]


def _pack_bits(pairs: Words) -> Masks:
    """Pack the even bits of 16-bit words: uint8 [n]."""
    x = pairs & np.uint16(0x5555)
    x = (x | x >> np.uint16(1)) & np.uint16(0x3333)
    x = (x | x >> np.uint16(2)) & np.uint16(0x0F0F)
    return (x | x >> np.uint16(4)).astype(np.uint8)


def _read_full(
    data: bytes, header: _Header
) -> tuple[NDArray[np.uint8], NDArray[np.uint64], NDArray[np.float32], NDArray[np.uint8] | None]:
    """Return depth, code, log-odds and colour of the leaves of a stream of all nodes."""
    record = _record(header.id)
    body_size = len(data) - header.body
    if body_size % record.itemsize:
        size = record.itemsize
        raise _unreadable_error(
            f"the tree has {body_size} bytes: must be a multiple of {size}, the size of a node of {header.id}",
            location="data",
        )
    nodes = np.frombuffer(data, record, body_size // record.itemsize, header.body)
    _check_size(len(nodes), header)
    masks: Masks = np.ascontiguousarray(nodes["mask"])
    at_depth = _split_by_depth(masks, DEPTH)
    leaf = masks == 0
    code, depth = np.empty(len(nodes), np.uint64), np.empty(len(nodes), np.uint8)
    codes = np.zeros(1, np.uint64)
    for d, rows in enumerate(at_depth):
        code[rows] = codes
        depth[rows] = d
        node, octant = _children(masks[rows])
        codes = codes[node] << np.uint64(3) | octant
    odds = nodes["odds"][leaf].astype(np.float32) + np.float32(0.0)
    infinite = np.flatnonzero(~np.isfinite(nodes["odds"]))
    if len(infinite):
        at = int(infinite[0])
        raise _unreadable_error(f"the log-odds of node {at} must be a finite number", location="data")
    colour = np.ascontiguousarray(nodes["colour"][leaf]) if header.id == COLOR_OCTREE else None
    if len(nodes) == 1:  # the whole tree is one leaf: its eight octants
        colour = None if colour is None else np.repeat(colour, 8, axis=0)
        return np.ones(8, np.uint8), np.arange(8, dtype=np.uint64), np.repeat(odds, 8), colour
    return depth[leaf], code[leaf], odds, colour


def _record(tree: str) -> np.dtype[Any]:
    """Return the dtype of a node of an ``.ot``."""
    colour = [("colour", "u1", 3)] if tree == COLOR_OCTREE else []
    return np.dtype([("odds", "<f4"), *colour, ("mask", "u1")])


def _check_size(counted: int, header: _Header) -> None:
    if counted != header.size:
        raise _unreadable_error(f"the header declares {header.size} nodes, but the data has {counted}", location="size")


def _children(masks: Masks) -> tuple[Rows, NDArray[np.uint64]]:
    """Return row and octant of each set bit, in ascending order."""
    bits = np.flatnonzero(np.unpackbits(masks, bitorder="little"))
    return bits >> 3, (bits & 7).astype(np.uint64)


def _split_by_depth(masks: Masks, deepest: int) -> list[Rows]:
    """Group the nodes of a depth-first stream by depth, as ascending indices: children stay in order.

    masks: uint8 [n], one bit per child that follows in the stream. Before node k, P[k] + 1 nodes are pending (including
    k): P[0] = 0, P[k + 1] = P[k] + children - 1. The subtree of k ends at the first P below P[k]; since P decreases by
    at most one, there it is P[k] - 1. The depth of a node is the number of subtrees that have started before it and
    not ended. No recursion for any input.
    """
    n = len(masks)
    children = np.bitwise_count(masks)
    waiting = np.cumsum(children, dtype=np.int64)
    waiting -= np.arange(1, n + 1)
    short = waiting < 0
    if not bool(short.any()):
        raise _unreadable_error("the data ends before the end of the tree", location="data")
    end = int(np.argmax(short))
    if end != n - 1:
        raise _unreadable_error(f"the tree ends after {end + 1} nodes, but more data follows", location="data")
    if n > 1 and int(waiting.max()) > MAX_PENDING_NODES:
        raise _unreadable_error(f"the tree is deeper than {DEPTH} levels", location="data")
    before = np.zeros(n, np.int8)
    before[1:] = waiting[:-1]
    order = np.argsort(before, kind="stable")
    group = np.searchsorted(before[order], np.arange(int(before.max()) + 2))
    step = np.zeros(n + 1, np.int64)
    step[np.flatnonzero(children) + 1] = 1
    ends = []
    for value in range(1, len(group) - 1):
        these, lower = order[group[value] : group[value + 1]], order[group[value - 1] : group[value]]
        begun = these[children[these] > 0]
        ends.append(lower[np.searchsorted(lower, begun)])
    if ends:
        step -= np.bincount(np.concatenate(ends), minlength=n + 1)
    depth = np.cumsum(step[:n])
    if int(depth.max()) > deepest:
        raise _unreadable_error(f"the tree is deeper than {DEPTH} levels", location="data")
    order = np.argsort(depth.astype(np.int8), kind="stable")
    return np.split(order, np.cumsum(np.bincount(depth))[:-1])


# --- writing ------------------------------------------------------------------------------------------------------
def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """Write ``map.bt`` or ``map.ot`` (``<name>.bt`` if a name is requested).

    Raises MissingLayer, NotFound, Ambiguous, or Invalid for an impossible box.
    """
    options = context.options if isinstance(context.options, WriteOptions) else WriteOptions()
    key = choose(sorted(layers.parts_of("voxels")), options)[0]
    voxels = layers.parts[key]
    if not isinstance(voxels, VoxelMap):
        raise AssertionError(f"{key} is not a voxel map")
    kind: Kind = options.kind or ("bt" if voxels.binary else "ot")
    if options.bbox is not None:
        before = len(voxels)
        voxels = cut(voxels, options.bbox)
        if before and not len(voxels):
            raise NotFound("the bbox is outside the voxel map: use a box that overlaps it")
    if options.depth is not None:
        merged = coarser(voxels, options.depth)
        context.drop("voxels", len(voxels) - len(merged), f"merged at depth={options.depth}")
        voxels = merged
    tree = _tree_type(voxels)
    if kind == "bt":
        voxels = _likeliest(voxels, context)
    if kind == "bt" if options.prune is None else options.prune:
        voxels = _prune(voxels, options.depth or DEPTH, kind, context)
    if kind == "ot" and tree not in FULL_TYPES:
        context.warn(f"the tree has type {tree}; it is written as {OCTREE}")
        tree = OCTREE
    size, body = _binary(voxels) if kind == "bt" else _full(voxels, tree == COLOR_OCTREE)
    stem = file_stem(options.name or MAP)
    return {f"{stem}.{kind}": _head(kind, tree, size, voxels) + body}


def choose(keys: Sequence[PartKey], options: WriteOptions) -> Sequence[PartKey]:
    """Choose the named voxel map, else ``map``, else the only one; on its level, else the ground, else the only one."""
    supply = "upload one (an OctoMap file or a point cloud)"
    return select_part(keys, "voxels", options.name, options.level, noun="voxel map", option="name", supply=supply)


def options_from_filename(name: str) -> dict[str, str]:
    """Select the full tree for ``map.ot``, and the voxel map ``lab`` for ``lab.bt``."""
    stem, _, end = name.rpartition(".")
    if not stem or end not in ("bt", "ot"):
        return {}
    return {"kind": end, **({} if stem == MAP else {"name": stem})}


def _tree_type(voxels: VoxelMap) -> str:
    source_properties = voxels.properties.get(NAME)
    name = source_properties.get("id") if isinstance(source_properties, Mapping) else None
    return name if isinstance(name, str) else OCTREE if voxels.colour is None else COLOR_OCTREE


def _likeliest(voxels: VoxelMap, context: WriteContext) -> VoxelMap:
    """Reduce voxels to free and occupied, as OctoMap's toMaxLikelihood does."""
    odds = np.array(LOG_ODDS)[voxels.occupied.astype(np.intp)]
    if not voxels.binary:
        finer = int(np.count_nonzero(odds != voxels.log_odds))
        context.drop("log-odds", finer, "a .bt stores free and occupied only: request kind=ot")
    if voxels.colour is not None:
        set_ = int(np.count_nonzero((voxels.colour != UNSET).any(axis=1)))
        context.drop("colours", set_, "a .bt stores free and occupied only: request kind=ot")
    return VoxelMap(voxels.resolution, voxels.depth, voxels.code, odds, None, True, voxels.properties)


def _prune(voxels: VoxelMap, deepest: int, kind: Kind, context: WriteContext) -> VoxelMap:
    out = prune(voxels, deepest)
    if kind == "ot" and voxels.colour is not None and out.colour is not None and len(out) < len(voxels):
        holder = np.searchsorted(out.place, voxels.place, side="right") - 1
        other = int(np.count_nonzero((voxels.colour != out.colour[holder]).any(axis=1)))
        context.drop("colours", other, "pruning averages the colours of equal voxels")
    return out


def _head(kind: Kind, tree: str, size: int, voxels: VoxelMap) -> bytes:
    """Format the header as the library does: six digits of the resolution, unless it has more."""
    source_properties = voxels.properties.get(NAME)
    comments = source_properties.get("comments") if isinstance(source_properties, Mapping) else None
    shown = f"{voxels.resolution:g}"
    lines = [
        (BINARY_FILE if kind == "bt" else FULL_FILE).decode(),
        *(comments if isinstance(comments, (list, tuple)) else COMMENTS),
        f"id {tree}",
        f"size {size}",
        f"res {shown if float(shown) == voxels.resolution else repr(voxels.resolution)}",
        "data",
    ]
    return ("\n".join(map(str, lines)) + "\n").encode()


def _binary(voxels: VoxelMap) -> tuple[int, bytes]:
    """Return the number of nodes, and the stream of inner nodes."""
    if not len(voxels):
        return 0, b""
    state = np.where(voxels.occupied, np.uint16(2), np.uint16(1))
    keys, masks = [], []
    code, bits = np.empty(0, np.uint64), np.empty(0, np.uint16)
    for depth in range(DEPTH, 0, -1):
        indices = np.flatnonzero(voxels.depth == depth)
        code = np.concatenate([voxels.code[indices], code])
        bits = np.concatenate([state[indices], bits])
        if not len(code):
            continue
        if len(indices) not in (0, len(code)):
            order = np.argsort(code, kind="stable")  # two ascending runs
            code, bits = code[order], bits[order]
        octant = (code & np.uint64(7)).astype(np.uint16)
        above = code >> np.uint64(3)
        start = np.flatnonzero(np.concatenate([[True], above[1:] != above[:-1]]))
        code = above[start]
        masks.append(np.bitwise_or.reduceat(bits << (octant + octant), start))
        keys.append(_key(code, depth - 1))
        bits = np.full(len(code), 3, np.uint16)
    order = np.argsort(np.concatenate(keys))
    stream = np.concatenate(masks)[order]
    return len(voxels) + len(stream), stream.astype("<u2", copy=False).tobytes()


def _full(voxels: VoxelMap, coloured: bool) -> tuple[int, bytes]:
    """Return the number of nodes, and the stream of all nodes.

    In a coloured tree of a map without colours all colours are unset.
    """
    if not len(voxels):
        return 0, b""
    colours = voxels.colour if coloured else None
    keys, masks, odds_of, colour_of = [], [], [], []
    code, odds = np.empty(0, np.uint64), np.empty(0, np.float32)
    colour = None if colours is None else np.empty((0, 3), np.uint8)
    for depth in range(DEPTH, 0, -1):
        indices = np.flatnonzero(voxels.depth == depth)
        code = np.concatenate([voxels.code[indices], code])
        odds = np.concatenate([voxels.log_odds[indices], odds])
        if colour is not None and colours is not None:
            colour = np.concatenate([colours[indices], colour])
        if not len(code):
            continue
        if len(indices) not in (0, len(code)):
            order = np.argsort(code, kind="stable")  # two ascending runs
            code, odds = code[order], odds[order]
            colour = None if colour is None else colour[order]
        bit = np.left_shift(np.uint8(1), (code & np.uint64(7)).astype(np.uint8))
        start, code, odds, colour = merge_to_parents(code, odds, colour)
        keys.append(_key(code, depth - 1))
        masks.append(np.bitwise_or.reduceat(bit, start))
        odds_of.append(odds)
        colour_of.append(colour)
    if voxels.binary:  # the library reads and writes the root of every .bt as occupied
        odds_of[-1] = np.array([LOG_ODDS[1]])
    key = np.concatenate(keys)
    order = np.argsort(key)
    n = len(voxels) + len(key)
    # An inner node directly precedes its first leaf, after its ancestors, which have smaller keys.
    at = np.searchsorted(_key(voxels.code, voxels.depth), key[order]) + np.arange(len(key))
    inner = np.zeros(n, bool)
    inner[at] = True
    nodes = np.zeros(n, _record(COLOR_OCTREE if coloured else OCTREE))
    nodes["odds"][inner] = np.concatenate(odds_of)[order]
    nodes["odds"][~inner] = voxels.log_odds
    nodes["mask"][inner] = np.concatenate(masks)[order]
    if coloured:
        colour_arrays = [c for c in colour_of if c is not None]
        nodes["colour"][inner] = np.concatenate(colour_arrays)[order] if colour_arrays else UNSET
        nodes["colour"][~inner] = UNSET if colours is None else colours
    return n, nodes.tobytes()


def _key(code: NDArray[np.uint64], depth: int | NDArray[np.uint8]) -> NDArray[np.uint64]:
    """Compute the sort key of a depth-first walk: position, then depth."""
    levels = np.asarray(depth, np.uint64)
    position = code << (np.uint64(3) * (np.uint64(DEPTH) - levels))
    return position << np.uint64(5) | levels


register(
    Format(
        name=NAME,
        title="OctoMap (.bt, .ot)",
        files={"map.bt": "application/octet-stream", "map.ot": "application/octet-stream"},
        layers=frozenset({"voxels"}),
        detect=detect,
        read=read,
        check=rules.check,
        write=write,
        needs=LayerRequirements((frozenset({"voxels"}),)),
        write_options=WriteOptions,
        extensions=(".bt", ".ot"),
        selection=Selection(choose, options_from_filename, Parts("voxels", "name", file_stem)),
    )
)
