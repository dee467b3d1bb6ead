"""Write a route graph: nodes and edges with their original numbers."""

from __future__ import annotations

import hashlib
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import orjson
import shapely
from numpy.typing import NDArray

from app.errors import CannotConvert
from app.formats import WriteContext
from app.formats._network import (
    Edge,
    MergedNetwork,
    Node,
    count,
    get_source_properties,
    merge_networks,
    source_document,
)
from app.formats.nav2_route.reading import as_floats, fits, loader_problems
from app.formats.nav2_route.vocabulary import (
    CANONICAL_EDGE,
    CANONICAL_METADATA,
    CANONICAL_NODE,
    FRAME,
    MAX_ID,
    MAX_USED_ID,
    NAME,
    NUMBERS,
)
from app.model.features import Properties
from app.model.geodesy import local_crs_wkt
from app.model.layers import Layers
from app.parameters import parameter
from app.syntax import json
from app.syntax.decimals import METRES


@dataclass(frozen=True, slots=True)
class WriteOptions:
    """Values to write if no source has them."""

    graph_name: str | None = parameter(None, "name of a graph whose source has none; default: the map's")
    frame_id: str = parameter(FRAME, "frame of nodes whose source has none")


NO_PLACE = "urn:ogc:def:crs:EPSG::3857"
"""CRS in Nav2's own graphs, with which QGIS shows metres that have no place on earth; the route server ignores it."""


def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """Write ``graph.geojson``: all networks of the environment as one graph, nodes and then edges by their numbers.

    Items keep the numbers of their source; any other item gets one that follows from its id alone (unless that is
    taken), so that it does not depend on other items. Wgs84 items are converted to local metres. Raises MissingDatum
    without a datum, CannotConvert if there is no node or no edge.
    """
    return {"graph.geojson": _Writer(layers, context).data()}


ORDER = json.rank_keys(
    "type name id startid endid frame trigger cost overridable metadata operations properties geometry coordinates"
)


def _dump(value: Any) -> bytes:
    return orjson.dumps(json.sort_keys(value, ORDER))


class _Writer:
    def __init__(self, layers: Layers, context: WriteContext) -> None:
        self.context = context
        self.datum = layers.datum
        self.document = source_document(layers, NAME)
        self.net: MergedNetwork = merge_networks(layers, context)
        if not self.net.nodes or not self.net.edges:
            noun = "no node" if not self.net.nodes else "no edge between its nodes"
            raise CannotConvert(
                f"the network has {noun}, but the route server needs nodes and edges: supply a network with edges"
            )
        self.nodes, self.edges = self._numbers()
        self.options = context.options if isinstance(context.options, WriteOptions) else WriteOptions()
        self.framed = 0
        self.lost: Counter[str] = Counter()

    def _numbers(self) -> tuple[list[int], list[int]]:
        """Return the numbers of nodes and edges, different from each other if enough are available."""
        net, context = self.net, self.context
        nodes, edges = _stored_numbers(net.nodes), _stored_numbers(net.edges)
        own_nodes, own_edges = set(nodes.values()), set(edges.values())
        apart = len(net.nodes) + len(net.edges) <= MAX_USED_ID // 2
        nodes = _assign_numbers(net.nodes, nodes, own_nodes | own_edges if apart else own_nodes)
        edges = _assign_numbers(net.edges, edges, {*own_edges, *nodes.values()} if apart else own_edges)
        duplicate_count = sum(_claim(n) not in (None, nodes[k]) for k, n in enumerate(net.nodes))
        duplicate_count += sum(_claim(e) not in (None, edges[k]) for k, e in enumerate(net.edges))
        if duplicate_count:
            context.warn(
                f"{duplicate_count} items shared the number of another one, which Nav2 would confuse; they got "
                "new numbers"
            )
        return [nodes[k] for k in range(len(nodes))], [edges[k] for k in range(len(edges))]

    def data(self) -> bytes:
        """Return the complete text, one line for each feature."""
        net, context = self.net, self.context
        at = np.array([(n.x, n.y, 0.0 if n.z is None else n.z) for n in net.nodes], np.float64)
        places = (np.round(at, METRES) + 0.0).tolist()
        rows = [
            self._feature(node, n, {"type": "Point", "coordinates": position if position[2] else position[:2]}, {})
            for n, node, position in sorted(zip(self.nodes, net.nodes, places, strict=True), key=lambda t: t[0])
        ]
        for n, edge in sorted(zip(self.edges, net.edges, strict=True), key=lambda t: t[0]):
            ends = {"startid": self.nodes[edge.source], "endid": self.nodes[edge.target]}
            rows.append(self._feature(edge, n, self._shape(edge), ends))
        self._report()
        head = {"type": "FeatureCollection", **self._head()}
        ignored = self.document.get("ignored")
        rows += [_dump(row) for row in ignored if isinstance(row, dict)] if isinstance(ignored, list) else []
        self.lost["dangling"] += count(self.document.get("dangling"))
        context.drop(
            "edges without both end nodes",
            self.lost["dangling"],
            "Nav2 rejects a graph that contains one, and loses the old graph",
        )
        return _dump(head)[:-1] + b',"features":[\n' + b",\n".join(rows) + b"\n]}\n"

    def _head(self) -> dict[str, Any]:
        members = self.document.get("members")
        head = {w: v for w, v in members.items() if w not in ("type", "features")} if isinstance(members, dict) else {}
        if not self.document:
            title = self.options.graph_name or self.context.title
            # GDAL and QGIS take WKT as a name, and so show the metres where they are on earth.
            crs = NO_PLACE if self.datum is None else local_crs_wkt(self.datum)
            head = {"name": title, "crs": {"type": "name", "properties": {"name": crs}}}
            self.context.fill("name", title, "no source specifies it", "graph_name")
            self.context.fill("crs", {"name": crs}, "QGIS displays metres with it; the route server ignores it")
        if self.context.attribution and not head.keys() & {"attribution", "license", "copyright"}:
            head["attribution"] = "; ".join(self.context.attribution)
        return head

    def _feature(self, item: Node | Edge, n: int, geometry: dict[str, Any], ends: dict[str, int]) -> bytes:
        """Return one line of the file."""
        p = item.properties
        source_members = get_source_properties(p, NAME)
        extra_properties = source_members.get("properties")
        properties: dict[str, Any] = {"id": n, **ends}
        if NAME not in p and not ends:
            properties["frame"] = self.options.frame_id
            self.framed += 1
        if isinstance(extra_properties, dict):
            properties |= {w: v for w, v in extra_properties.items() if w not in properties}
        metadata = properties.get("metadata")
        more = self._metadata(p, str(n))
        if more and isinstance(metadata, (dict, type(None))):
            properties["metadata"] = {**(metadata or {}), **more}
        for key in ("metadata", "operations"):
            if key in properties:
                properties[key] = as_floats(properties[key])
        for reason in loader_problems(properties):
            self.context.warn(reason, where=str(n))
        self.lost["attributes"] += bool(p.keys() - (CANONICAL_EDGE if ends else CANONICAL_NODE))
        self.lost["dangling"] += count(source_members.get("dangling"))
        members = source_members.get("members")
        row = {"type": "Feature", "properties": properties, "geometry": geometry}
        if isinstance(members, dict):
            row |= {w: v for w, v in members.items() if w not in row}
        return _dump(row)

    def _metadata(self, p: Properties, number: str) -> dict[str, Any]:
        """Return the canonical properties in the metadata."""
        out: dict[str, Any] = {}
        for key, canonical in CANONICAL_METADATA.items():
            value: Any = p.get(canonical)
            if fits(key, value):
                out[key] = float(value) if key in NUMBERS else value
        if out.get("name") == number:
            del out["name"]
        if p.get("blocked") is True:
            out["blocked"] = True
        return out

    def _shape(self, edge: Edge) -> dict[str, Any]:
        source_members = get_source_properties(edge.properties, NAME)
        kind = "LineString" if source_members.get("line") is True else "MultiLineString"
        odd = source_members.get("geometry")
        if isinstance(odd, dict):
            return {"type": kind, **{w: v for w, v in odd.items() if w != "type"}}
        if edge.geometry is None or shapely.get_num_coordinates(edge.geometry) < 2:
            ends = [self.net.nodes[edge.source], self.net.nodes[edge.target]]
            at: NDArray[np.float64] = np.array([(n.x, n.y) for n in ends])
        else:
            at = shapely.get_coordinates(edge.geometry, include_z=bool(shapely.has_z(edge.geometry)))
        coordinates = (np.round(at, METRES) + 0.0).tolist()
        return {"type": kind, "coordinates": coordinates if kind == "LineString" else [coordinates]}

    def _report(self) -> None:
        net, context, counts = self.net, self.context, self.lost
        if len(set(net.levels)) > 1:
            context.drop("levels of nodes", len(net.nodes), "all networks are joined into one graph")
        foreign = sum(NAME not in n.properties for n in net.nodes) + sum(NAME not in e.properties for e in net.edges)
        if self.framed:
            context.fill("frame", self.options.frame_id, f"{self.framed} nodes have none", "frame_id")
        if foreign:
            context.fill(
                "id", "a number computed from each id", f"{foreign} nodes and edges have no number of their own"
            )
        context.drop(
            "items with attributes that Nav2 cannot express", counts["attributes"], "source properties of other formats"
        )


def _claim(item: Node | Edge) -> int | None:
    """Return an item's number in its source."""
    source_id = get_source_properties(item.properties, NAME).get("id")
    return (
        source_id
        if isinstance(source_id, int) and not isinstance(source_id, bool) and 0 <= source_id <= MAX_ID
        else None
    )


def _stored_numbers(items: Sequence[Node | Edge]) -> dict[int, int]:
    """Map index to number of items that have one; of several with the same number, the one with a matching id."""
    claims: dict[int, list[int]] = defaultdict(list)
    for k, item in enumerate(items):
        n = _claim(item)
        if n is not None:
            claims[n].append(k)
    return {min(rivals, key=lambda k: (items[k].id != str(n), items[k].id)): n for n, rivals in claims.items()}


def _assign_numbers(items: Sequence[Node | Edge], claims: Mapping[int, int], taken: set[int]) -> dict[int, int]:
    """Map index to number of all items; ``taken`` grows. Numeric ids are assigned before computed numbers."""
    out = dict(claims)
    remaining = sorted((k for k in range(len(items)) if k not in out), key=lambda k: items[k].id)
    for k in remaining:
        if _is_number(items[k].id) and int(items[k].id) not in taken:
            out[k] = int(items[k].id)
            taken.add(out[k])
    large = sum(n > MAX_USED_ID for n in claims.values())
    size = 2**16 if len(items) - large <= 2**16 else 2**32
    for k in remaining:
        if k not in out:
            out[k] = next(n for n in _candidates(items[k].id, size) if n not in taken)
            taken.add(out[k])
    return out


def _is_number(text: str) -> bool:
    return text.isascii() and text.isdigit() and len(text) <= 5 and str(int(text)) == text and int(text) <= MAX_USED_ID


def _candidates(text: str, size: int) -> Iterable[int]:
    """Yield numbers below ``size`` that follow from a text, each once."""
    first = int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "big")
    step = first >> 32 | 1  # odd, so that every number occurs
    return ((first + k * step) % size for k in range(size))
