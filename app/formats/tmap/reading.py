"""Reading networks of topological_navigation in both layouts."""

from __future__ import annotations

import hashlib
import unicodedata
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.errors import Problem, UnreadableFile
from app.formats import Files, ReadContext, _fields, all_formats
from app.formats._network import edge_lines, node_points, shorten_list
from app.formats.tmap.frames import to_local
from app.formats.tmap.network import (
    EDGE_WORDS,
    ENTRIES,
    MAX_ID_CHARACTERS,
    MAX_NAME,
    NAME,
    NODE_WORDS,
    NUMERIC_WORDS,
    SHAPE,
    Array,
    parse_number,
)
from app.model.features import Properties, from_columns, unique_ids
from app.model.layers import NETWORK, Layers, PartKey
from app.syntax import yaml


def read(files: Files, context: ReadContext) -> Layers:
    """Read the network as topology or, if no node has an edge, its nodes as objects of kind ``poi``.

    Coordinates are local metres, 2-D if z is 0. Raises UnreadableFile with the node.
    """
    if not (context.wants("topology") or context.wants("objects")):
        return Layers()
    top = yaml.load(files[context.main or next(iter(files))], context.limits)
    legacy = isinstance(top, list)
    entries, document = _top(top, context)
    nodes = [_entry(entry, k) for k, entry in enumerate(entries)]
    names = [_name(node.get("name"), k, context) for k, node in enumerate(nodes)]
    ids = unique_ids(map(_identifier, names))
    _warn_names(names, context)
    index_by_name = {name: k for k, name in reversed(list(enumerate(names)))}

    rows, dangling = _edges(nodes, names, index_by_name, context)
    common = {"map": document.get("metric_map"), "pointset": document.get("pointset")}
    xyz, orientations = _poses(nodes, names)
    _fields.check(top, ENTRIES if legacy else SHAPE, context)
    to_local(xyz, orientations, nodes, document, context)
    has_edges = bool(rows) or bool(dangling)
    kind = "node" if has_edges or not nodes else "poi"
    properties: list[Properties] = []
    for k, (entry, node, name) in enumerate(zip(entries, nodes, names, strict=True)):
        node_properties: dict[str, Any] = {"kind": kind, "name": name}
        if orientations[k] is not None:
            node_properties["orientation"] = orientations[k]
        node_properties[NAME] = source_properties = _extra_node_members(entry, node, name, common)
        if name != ids[k]:
            source_properties["node"]["name"] = name
        if k in dangling:
            source_properties["node"]["edges"] = dangling[k]
        _lift(node_properties, source_properties["node"])
        properties.append(node_properties)
    geometry = node_points(xyz)
    collection_document = {**_credit(document), NAME: document, **({"tmap": {"layout": "list"}} if legacy else {})}
    if kind == "poi":
        context.warn(f"no node has an edge; the {len(nodes)} nodes are read as points of interest")
        key = PartKey("objects", context.level, NAME)
        return Layers({key: from_columns(ids, geometry, properties, "local", collection_document)})

    sources = np.array([r[0] for r in rows], np.intp)
    targets = np.array([r[1] for r in rows], np.intp)
    _warn_isolated(names, sources, targets, dangling, context)
    edge_ids = unique_ids((_identifier(r[2]) for r in rows), set(ids))
    properties += _edge_properties(rows, edge_ids, ids, context)
    both = np.concatenate([geometry, edge_lines(xyz, sources, targets)])
    key = PartKey("topology", context.level, NETWORK)
    return Layers({key: from_columns([*ids, *edge_ids], both, properties, "local", collection_document)})


def _credit(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return the licences and credits in ``meta`` as members of a part's document."""
    meta = document.get("meta")
    texts = [meta.get(key) for key in ("attribution", "license", "copyright")] if isinstance(meta, dict) else []
    credit = [text for text in texts if isinstance(text, str) and text]
    return {"attribution": credit} if credit else {}


def _edge_properties(
    rows: Sequence[Row], edge_ids: Sequence[str], ids: Sequence[str], context: ReadContext
) -> list[Properties]:
    """Build the properties of edges between nodes of these ids; warn about duplicate ids."""
    out: list[Properties] = []
    repeated = []
    for (source, target, source_id, edge), edge_id in zip(rows, edge_ids, strict=True):
        extra_members = {key: value for key, value in edge.items() if key not in EDGE_WORDS}
        line: dict[str, Any] = {"kind": "edge", "source": ids[source], "target": ids[target], NAME: extra_members}
        if "action" in edge:
            if isinstance(edge["action"], str):
                line["action"] = edge["action"]
            else:
                extra_members["action"] = edge["action"]
        if source_id != edge_id:
            extra_members["edge_id"] = source_id
            repeated.append(source_id)
        if "properties" in extra_members:
            _lift(line, extra_members)
        out.append(line)
    if repeated:
        context.warn(f"{len(repeated)} duplicate edge ids: {shorten_list(repeated)}; all these edges are stored")
    return out


def _top(top: Any, context: ReadContext) -> tuple[list[Any], dict[str, Any]]:
    """Split the file into (entries of the nodes, rest of the top level)."""
    if isinstance(top, list):
        document: dict[str, Any] = {}
        for key, meta_key in (("metric_map", "map"), ("pointset", "pointset"), ("name", "pointset")):
            metas = (e["meta"].get(meta_key) for e in top if isinstance(e, dict) and isinstance(e.get("meta"), dict))
            most_common = Counter(m for m in metas if isinstance(m, str)).most_common(1)
            if most_common:
                document[key] = most_common[0][0]
        return top, document
    if not isinstance(top, dict) or not isinstance(top.get("nodes"), list):
        raise UnreadableFile(
            "not a topological map: the list of nodes is missing", [Problem("must be a list", where="nodes")]
        )
    document = {key: value for key, value in top.items() if key != "nodes"}
    for key in ("name", "metric_map", "pointset"):
        if key not in document:
            context.warn("is missing; tmap2 readers require it", where=key)
        elif not isinstance(document[key], str):
            context.warn(f"is {document[key]!r}, not text; it is written as text", where=key)
    return top["nodes"], document


def _entry(entry: Any, k: int) -> dict[str, Any]:
    node = entry.get("node") if isinstance(entry, dict) else None
    if not isinstance(node, dict):
        raise UnreadableFile(
            f"nodes[{k}] has no mapping 'node'", [Problem("missing mapping 'node'", where=f"nodes[{k}]")]
        )
    edges = node.get("edges")
    if edges is not None and not (isinstance(edges, list) and all(isinstance(e, dict) for e in edges)):
        location = f"nodes[{k}].node.edges"
        raise UnreadableFile(
            f"{location} must be a list of mappings", [Problem("must be a list of mappings", where=location)]
        )
    if not isinstance(entry.get("meta", {}), (dict, type(None))):
        raise UnreadableFile(
            f"nodes[{k}].meta must be a mapping", [Problem("must be a mapping", where=f"nodes[{k}].meta")]
        )
    return node


def _name(raw_name: Any, k: int, context: ReadContext) -> str:
    location = f"nodes[{k}].node.name"
    name = raw_name if isinstance(raw_name, str) else ""
    if not isinstance(raw_name, str):
        if raw_name is None or isinstance(raw_name, (dict, list)):
            raise UnreadableFile(
                f"{location}: a node must have a name", [Problem("a node must have a name", where=location)]
            )
        context.warn(f"the name {raw_name!r} is not text; it is written as text", where=location)
        name = yaml.text(raw_name)
    if not 0 < len(name) <= MAX_NAME or (
        not name.isprintable() and any(unicodedata.category(c) in ("Cc", "Zl", "Zp") for c in name)
    ):
        reason = f"a name must have 1 to {MAX_NAME} characters and no control characters"
        raise UnreadableFile(f"{location}: {reason}", [Problem(f"{reason}, got {name[:60]!r}", where=location)])
    return name


def _identifier(name: str) -> str:
    """Convert a name to a valid id: normalise Unicode, escape invisible characters, limit the length."""
    if name.isascii() and name.isprintable() and len(name) <= MAX_ID_CHARACTERS:
        return name
    plain = unicodedata.normalize("NFC", name)
    plain = "".join(c if c.isprintable() else f"\\u{ord(c):04x}" for c in plain)
    if len(plain) > MAX_ID_CHARACTERS:
        plain = f"{plain[: MAX_ID_CHARACTERS - 17]}~{hashlib.sha256(name.encode()).hexdigest()[:16]}"
    return plain


def _warn_names(names: Sequence[str], context: ReadContext) -> None:
    repeated = [name for name, count in Counter(names).items() if count > 1]
    if repeated:
        context.warn(
            f"{len(repeated)} duplicate node names: {shorten_list(repeated)}; edges connect to the first of that name"
        )
    for name in names:
        if not name.isascii() and not name.isprintable():
            context.warn(f"the name {name!r} has invisible characters; they are escaped in its id", where=name)


Row = tuple[int, int, str, dict[str, Any]]


def _edges(
    nodes: Sequence[dict[str, Any]], names: Sequence[str], index_by_name: Mapping[str, int], context: ReadContext
) -> tuple[list[Row], dict[int, list[Any]]]:
    """Return ((source, target, edge id, mapping) of each edge between nodes, dangling edges by node)."""
    rows: list[Row] = []
    dangling: dict[int, list[Any]] = {}
    loops = []
    for k, node in enumerate(nodes):
        for edge in node.get("edges") or ():
            to = edge.get("node")
            if not isinstance(to, str) and to is not None and not isinstance(to, (dict, list)):
                to = yaml.text(to)
            target = index_by_name.get(to) if isinstance(to, str) else None
            edge_id = edge.get("edge_id")
            if not isinstance(edge_id, str):
                edge_id = (
                    f"{names[k]}_{to}" if edge_id is None or isinstance(edge_id, (dict, list)) else yaml.text(edge_id)
                )
            if target is None:
                dangling.setdefault(k, []).append(edge)
                context.warn(
                    f"the edge {edge_id!r} leads to the unknown node {to!r}; it is stored with its source node",
                    where=names[k],
                )
                continue
            if target == k:
                loops.append(edge_id)
            rows.append((k, target, edge_id or f"{names[k]}_{to}", edge))
    if loops:
        context.warn(f"{len(loops)} edges lead from a node to itself: {shorten_list(loops)}")
    return rows, dangling


def _warn_isolated(
    names: Sequence[str],
    sources: NDArray[np.intp],
    targets: NDArray[np.intp],
    dangling: Mapping[int, Any],
    context: ReadContext,
) -> None:
    linked = np.zeros(len(names), bool)
    linked[sources] = linked[targets] = linked[list(dangling)] = True
    lonely = [names[k] for k in np.flatnonzero(~linked).tolist()]
    if lonely:
        context.warn(f"{len(lonely)} nodes have no edges: {shorten_list(lonely)}")


def _poses(nodes: Sequence[dict[str, Any]], names: Sequence[str]) -> tuple[Array, list[list[float] | None]]:
    """Return (positions float64 [n, 3] in metres, a quaternion [x, y, z, w] or None for each node)."""
    positions: list[tuple[Any, ...]] = []
    orientations: list[list[float] | None] = []
    for node, name in zip(nodes, names, strict=True):
        try:
            pose = node["pose"]
            at, turned = pose["position"], pose.get("orientation")
            positions.append((at["x"], at["y"], at.get("z", 0.0)))
            orientations.append(None if turned is None else [turned["x"], turned["y"], turned["z"], turned["w"]])
        except (KeyError, TypeError, AttributeError, IndexError) as error:
            reason = (
                f"invalid pose of node {name!r}: it needs position.x and position.y, and x, y, z, w in an orientation"
            )
            raise UnreadableFile(reason, [Problem(reason, where=f"{name}.pose")]) from error
    xyz = _numbers(positions, 3, names, "position")
    indices = [k for k, o in enumerate(orientations) if o is not None]
    turned = _numbers([tuple(orientations[k] or ()) for k in indices], 4, [names[k] for k in indices], "orientation")
    for k, row in zip(indices, turned.tolist(), strict=True):
        orientations[k] = row
    return xyz, orientations


def _numbers(rows: Sequence[tuple[Any, ...]], width: int, names: Sequence[str], member: str) -> Array:
    """Parse rows of numbers, also quoted ones, to float64 [n, width]."""
    flat = [v for row in rows for v in row]
    if not all(map((float, int).__contains__, map(type, flat))):
        for k, value in enumerate(flat):
            flat[k] = parse_number(value, f"{names[k // width]}.pose.{member}")
    return np.array(flat, np.float64).reshape(-1, width)


def _extra_node_members(
    entry: Mapping[str, Any], node: Mapping[str, Any], name: str, common: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the members of a node's entry that are neither canonical nor in the document."""
    extra_members = {key: value for key, value in node.items() if key not in NODE_WORDS}
    pose = node["pose"]
    if len(pose) > 2 or len(pose["position"]) > 3 or len(pose.get("orientation") or ()) not in (0, 4):
        more = {key: value for key, value in pose.items() if key not in ("position", "orientation")}
        for member, axes in (("position", "xyz"), ("orientation", "xyzw")):
            extra = {key: value for key, value in (pose.get(member) or {}).items() if key not in axes}
            more |= {member: extra} if extra else {}
        if more:
            extra_members["pose"] = more
    out: dict[str, Any] = {"node": extra_members}
    if len(entry) > 2:
        out |= {key: value for key, value in entry.items() if key not in ("meta", "node")}
    meta = {
        key: value
        for key, value in (entry.get("meta") or {}).items()
        if not (value == name if key == "node" else key in common and common[key] == value)
    }
    if meta:
        out["meta"] = meta
    return out


def _lift(properties: dict[str, Any], extra_members: dict[str, Any]) -> None:
    """Move canonical and other formats' source properties out of an item's ``properties`` member."""
    inner_properties = extra_members.get("properties")
    if not isinstance(inner_properties, dict):
        return
    lifted = {
        key: value
        for key, value in inner_properties.items()
        if (key in NUMERIC_WORDS and isinstance(value, (int, float)) and not isinstance(value, bool) and value > 0)
        or (key == "name" and isinstance(value, str) and value not in ("", properties.get("name")))
        or (isinstance(value, dict) and key in _families() and key != NAME)
    }
    if lifted:
        properties.update(lifted)
        extra_members["properties"] = {key: value for key, value in inner_properties.items() if key not in lifted}
        if not extra_members["properties"]:
            del extra_members["properties"]


@cache
def _families() -> frozenset[str]:
    """Return the keys of source properties of all formats."""
    return frozenset(all_formats())
