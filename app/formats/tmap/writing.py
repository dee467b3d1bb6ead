"""Writing networks of topological_navigation in both layouts."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import orjson
import shapely

from app.formats import WriteContext
from app.formats._network import shorten_list
from app.formats.tmap.frames import child_frame, has_default_frame, is_in_child_frame, map_transform, multiply
from app.formats.tmap.network import (
    ANY_YAW,
    CANONICAL_EDGE,
    CANONICAL_NODE,
    CROSS_PART_PROPERTIES,
    EDGE_TEMPLATE,
    EPOCH,
    FRAME,
    LAST_UPDATED,
    NAME,
    TRANSFORMATION,
    WRITTEN_ON_DEMAND,
    Array,
    ListOptions,
    WriteOptions,
    ring,
)
from app.model.features import Features, Properties, unique_ids
from app.model.frame import GROUND
from app.model.layers import Layers
from app.syntax import yaml
from app.syntax.decimals import METRES, encode_pieces, numbers


def write(layers: Layers, context: WriteContext, *, listed: bool = False) -> bytes:
    """Write all networks of the environment as one file, nodes and edges sorted by length and text of id.

    listed: write the older list. WGS 84 items are converted to local metres (MissingDatum without a datum). Members
    that the source does not have are filled in.
    """
    return _Writer(layers, context, listed=listed).file()


Lines = list[tuple[int, str, str]]
"""(length, name or id, text) of nodes or edges; sorting puts WayPoint9 before WayPoint10."""


class _Writer:
    """Writer of one file: top level, templates of items so far, counts for the report."""

    def __init__(self, layers: Layers, context: WriteContext, *, listed: bool) -> None:
        self.layers, self.context, self.listed = layers, context, listed
        kind = ListOptions if listed else WriteOptions
        self.options: WriteOptions | ListOptions = context.options if isinstance(context.options, kind) else kind()
        self.document = self._document()
        self.turn = map_transform(self.document)
        self.ring = ring(self.options.verts_radius)
        self.foreign: Mapping[str, Any] | None = None  # document of the current network, if its child frame is another
        self.moved: list[str] = []  # nodes from such child frames
        self.legacy = False  # whether the current network came as the older list, which lacks members of tmap2
        self.unwritten = CROSS_PART_PROPERTIES if self.options.osm else CROSS_PART_PROPERTIES | WRITTEN_ON_DEMAND
        # Sets of properties that add nothing to an item's own ``properties``.
        self.plain_node, self.plain_edge = CANONICAL_NODE | self.unwritten, CANONICAL_EDGE | self.unwritten
        self.templates: dict[Any, list[str]] = {}
        self.filled: Counter[str] = Counter()
        self.dropped: Counter[str] = Counter()

    def _document(self) -> dict[str, Any]:
        """Return the top level without the nodes: from the source, with defaults filled in."""
        parts = list(self.layers.vector("topology").values())
        parts += [part for key, part in self.layers.vector("objects").items() if key.name == NAME]
        source_document: Any = next((p.document[NAME] for p in parts if isinstance(p.document.get(NAME), Mapping)), {})
        document = {key: value for key, value in source_document.items() if key != "nodes"}
        default_name = next((document[key] for key in ("pointset", "name", "metric_map") if document.get(key)), None)
        title = default_name if isinstance(default_name, str) else self.context.title
        if self.listed:
            more = [key for key in document if key not in ("metric_map", "pointset")]
            if document.get("name") == document.get("pointset"):
                more = [key for key in more if key != "name"]
            self.context.drop("top level keys of a tmap2 file", len(more), "a list cannot store " + shorten_list(more))
            document = {key: document[key] for key in ("metric_map", "pointset") if key in document}
        for key in ("metric_map", "pointset") if self.listed else ("metric_map", "name", "pointset"):
            value = document.get(key)
            if value is None or isinstance(value, (dict, list)):
                document[key] = title
                self.context.fill(key, title, "no source specifies it")
            elif not isinstance(value, str):
                document[key] = yaml.text(value)
                self.context.warn(f"the source's {key} is not text; {document[key]!r} is written", where=key)
        if self.options.pointset is not None:
            document["name"] = document["pointset"] = self.options.pointset
        if self.listed:
            return document
        meta = dict(document["meta"]) if isinstance(document.get("meta"), dict) else {}
        updated = meta.get("last_updated")
        if not (isinstance(updated, str) and LAST_UPDATED.match(updated)):
            meta["last_updated"] = EPOCH
            self.context.fill("meta.last_updated", EPOCH, "no source specifies it in the form that the schema requires")
            if updated is not None:
                self.context.warn(
                    f"last_updated {updated!r} is not a time; {EPOCH} is written", where="meta.last_updated"
                )
        if self.context.attribution and not meta.keys() & {"attribution", "license", "copyright"}:
            meta["attribution"] = "; ".join(self.context.attribution)
        document["meta"] = meta
        if "transformation" not in document:
            document["transformation"] = TRANSFORMATION
            self.context.fill("transformation", "identity, from map to topo_map", "no source specifies it")
        return document

    def file(self) -> bytes:
        """Return the file."""
        nodes: Lines = []
        taken: set[str] = set()
        networks = self.layers.vector("topology")
        for key, part in networks.items():
            nodes += self._network(part, key.level, taken)
        if len({key.level for key in networks}) > 1:
            count = sum(len(part) for key, part in networks.items() if key.level != GROUND)
            why = "the format has no levels: all networks are merged, 2-D points at their level's elevation"
            self.context.drop("levels of nodes and edges", count, why)
        self._report()
        items = [text for _, _, text in sorted(nodes)]
        nodes.clear()
        if self.listed:
            return encode_pieces([items[0].lstrip(" "), *items[1:]] if items else ["[]\n"])
        before, after = _split({**self.document, "nodes": None}, 0, "nodes")
        pieces = [before, "\n" if items else " []\n", *items, after]
        items.clear()
        return encode_pieces(pieces)

    def _network(self, part: Features, level: str, taken: set[str]) -> Lines:
        """Write the nodes of a network, each with its edges."""
        self.legacy = "tmap" in part.document
        document = _mapping_text(part.document.get(NAME))
        has_other_frame = not self.listed and child_frame(document) not in (None, child_frame(self.document))
        self.foreign = document if has_other_frame else None
        is_point = (shapely.get_type_id(part.geometry) == 0) & ~shapely.is_empty(part.geometry)
        kinds = [p.get("kind") for p in part.properties]
        places = [k for k, point in enumerate(is_point.tolist()) if point and kinds[k] == "node"]
        names = self._names(part, places, taken)
        name_texts = {i: yaml.text(name) for i, name in names.items()}
        edges = self._edges(part, kinds, name_texts)
        coordinates = self._positions(part, places, 0.0 if level == GROUND else self.layers.elevation(level))
        out = []
        plain = self._plain_node()
        for index, at in zip(places, coordinates, strict=True):
            i, p = part.ids[index], part.properties[index]
            name = names[i]
            if self._is_plain(p, self.plain_node) and "orientation" not in p and p.get("name", name) == name:
                self.filled["nodes"] += 1
                self.filled["orientations"] += 1
                self.filled["any yaw"] += 1
                text = plain(name_texts[i], _list_text(edges.pop(i)), at)
            else:
                text = self._node(p, name, name_texts[i], at, edges.pop(i))
            out.append((len(name), name, text))
        return out

    def _is_plain(self, p: Properties, keys: frozenset[str]) -> bool:
        """Check that an item comes from another format and adds nothing to its own ``properties``."""
        return NAME not in p and not self.legacy and p.keys() <= keys

    def _plain_node(self) -> Callable[[str, str, tuple[str, str, str]], str]:
        """Create a fast formatter of nodes with only a name and position: (name, edges, position) as texts -> entry."""
        a, b, c, d, e = self._node_template({}, {}, None, has_yaw=False, fill=True)
        d += self._pose(None, ("\0", "\0", "\0"), [0.0, 0.0, 0.0, 1.0], turned=self._is_in_child_frame({}))
        d, y, z, end = d.split("\0")
        e = end + e

        def plain(name_text: str, listed: str, at: tuple[str, str, str]) -> str:
            return f"{a} {name_text}\n{b}{listed}{c} {name_text}\n{d}{at[0]}{y}{at[1]}{z}{at[2]}{e}"

        return plain

    def _names(self, part: Features, places: Sequence[int], taken: set[str]) -> dict[str, str]:
        """Return the nodes' names in the file by id. Names that repeat in their source repeat here."""
        names = []
        for k in places:
            source_properties = part.properties[k].get(NAME)
            node = source_properties.get("node") if isinstance(source_properties, dict) else None
            node_name = node.get("name") if isinstance(node, dict) else None
            names.append(node_name if isinstance(node_name, str) and node_name else part.ids[k])
        clashing = sorted({name for name in names if name in taken})
        if clashing:
            renamed = dict(zip(clashing, unique_ids(clashing, taken | set(names)), strict=True))
            names = [renamed.get(name, name) for name in names]
            self.context.warn(
                f"{len(clashing)} names occur in several networks; a number makes them unique: {shorten_list(clashing)}"
            )
        taken.update(names)
        return {part.ids[k]: name for k, name in zip(places, names, strict=True)}

    def _edges(self, part: Features, kinds: Sequence[Any], name_texts: Mapping[str, str]) -> dict[str, Lines]:
        """Group the edges by the id of their source node. name_texts: each node's name as YAML, by id."""
        edges: dict[str, Lines] = {i: [] for i in name_texts}
        a, b, c = self._edge_template({}, None, None, fill=True)
        plain = dropped_count = 0
        for i, p, kind in zip(part.ids, part.properties, kinds, strict=True):
            source, target = p.get("source"), p.get("target")
            if not (kind == "edge" and isinstance(source, str) and isinstance(target, str) and source in name_texts):
                dropped_count += kind != "node"
                continue
            to = name_texts.get(target) or yaml.text(target)
            if self._is_plain(p, self.plain_edge) and "action" not in p:
                plain += 1
                text = f"{a} {yaml.text(i)}\n{b} {to}\n{c}"
            else:
                i, text = self._edge(p, i, to)  # noqa: PLW2901  sort by the written id: the order is the same when read again
            edges[source].append((len(i), i, text))
        self.filled["edges"] += plain
        self.dropped["items that are neither nodes nor edges from a node"] += dropped_count
        self.dropped["nodes without a point"] += kinds.count("node") - len(name_texts)
        return edges

    def _positions(self, part: Features, places: Sequence[int], elevation: float) -> list[tuple[str, str, str]]:
        """Return x, y, z as texts: metres in each node's parent_frame."""
        nodes = part.select(places)
        xyz: Array = shapely.get_coordinates(nodes.in_local(self.layers.frame), include_z=True).reshape(-1, 3)
        xyz[np.isnan(xyz[:, 2]), 2] = elevation
        if self.turn is not None:
            inside = [k for k, p in enumerate(nodes.properties) if self._is_in_child_frame(p)]
            xyz[inside] = (xyz[inside] - self.turn.shift) @ self.turn.matrix()
        texts = list(map(yaml.decimal, numbers(xyz.ravel(), METRES)))
        return list(zip(texts[::3], texts[1::3], texts[2::3], strict=True))

    def _is_in_child_frame(self, p: Properties) -> bool:
        """Check that a node's pose is in the child frame of the transformation."""
        source_properties = p.get(NAME)
        node = _mapping_text(source_properties.get("node") if isinstance(source_properties, dict) else None)
        return self.turn is not None and is_in_child_frame({} if self._is_foreign(node) else node, self.document)

    def _is_foreign(self, node: Mapping[str, Any]) -> bool:
        """Check that a node's frame is the child of another network's transformation, which is not written."""
        if self.foreign is None or not is_in_child_frame(node, self.foreign):
            return False
        return self.turn is None or not is_in_child_frame(node, self.document)

    def _moved_node(self, node: Mapping[str, Any]) -> dict[str, Any]:
        """Return the members of a node from another network's child frame, in a frame of this transformation."""
        transformation = _mapping_text(self.document.get("transformation"))
        frame: Any = transformation.get("parent", FRAME)
        if self.turn is not None and has_default_frame(self.document):
            frame = self.turn.child
        return {**{key: value for key, value in node.items() if key != "nav_frame"}, "parent_frame": frame}

    def _edge(self, p: Properties, i: str, target: str) -> tuple[str, str]:
        """Return the written id and the text of an edge. target: its target's name as YAML."""
        source_properties, action = p.get(NAME), p.get("action")
        extra_members: dict[str, Any] = source_properties if isinstance(source_properties, dict) else {}
        if "edge_id" in extra_members:
            i = str(extra_members["edge_id"])
            extra_members = {key: value for key, value in extra_members.items() if key != "edge_id"}
        more = None if p.keys() <= self.plain_edge else self._more(p, CANONICAL_EDGE)
        fill = source_properties is None or self.legacy
        self.filled["edges"] += source_properties is None if self.listed else fill
        # Edges that differ only in id and target share their text.
        key = orjson.dumps((action, extra_members, more, fill)).decode() if extra_members or more or action else fill
        pieces = self.templates.get(key)
        if pieces is None:
            pieces = self.templates[key] = self._edge_template(extra_members, action, more, fill=fill)
        return i, f"{pieces[0]} {yaml.text(i)}\n{pieces[1]} {target}\n{pieces[2]}"

    def _edge_template(
        self, extra_members: Mapping[str, Any], action: Any, more: dict[str, Any] | None, *, fill: bool
    ) -> list[str]:
        """Return the text of an edge in three pieces, around its id and its target."""
        if isinstance(self.options, ListOptions):
            limit = (more or {}).get("speed_limit")
            speed = limit if isinstance(limit, (int, float)) and not isinstance(limit, bool) else self.options.top_vel
            fixed = {"map_2d": self.document["metric_map"], "top_vel": float(speed)}
            # Keys that the list's reader uses; it ignores others.
            fixed |= {
                "inflation_radius": self.options.inflation_radius,
                "recovery_behaviours_config": self.options.recovery,
            }
            out = {**fixed, **extra_members}
        else:
            out = (
                {**EDGE_TEMPLATE, **self._default_edge(self.options), **extra_members} if fill else dict(extra_members)
            )
        if action is not None:
            out["action"] = action
        if fill or self.listed:
            out.setdefault("action", self.options.action)
        if more:
            out["properties"] = {**_mapping_text(extra_members.get("properties")), **more}
        pieces = _split({**out, "edge_id": None, "node": None}, 6, "edge_id", "node")
        pieces[0] = f"    - {pieces[0][6:]}"
        return pieces

    @staticmethod
    def _default_edge(options: WriteOptions) -> dict[str, Any]:
        """Return the members that the options set for a new edge of a tmap2 file."""
        return {
            "action_type": options.action_type,
            "fail_policy": options.fail_policy,
            "fluid_navigation": options.fluid_navigation,
            "recovery_behaviours_config": options.recovery,
            "restrictions_planning": options.restrictions,
            "restrictions_runtime": options.restrictions,
        }

    def _default_node(self) -> dict[str, Any]:
        """Return the members that the options set for a new node of a tmap2 file."""
        assert isinstance(self.options, WriteOptions)
        return {
            "localise_by_topic": self.options.localise_by_topic,
            "parent_frame": self._default_frame(self.options),
            "restrictions_planning": self.options.restrictions,
            "restrictions_runtime": self.options.restrictions,
        }

    def _default_frame(self, options: WriteOptions) -> str:
        """Return the frame of new nodes: that of nodes without a frame in the source's document, if it has one."""
        return self.turn.child if self.turn is not None and has_default_frame(self.document) else options.parent_frame

    def _node(self, p: Properties, name: str, name_text: str, at: tuple[str, str, str], edges: Lines) -> str:
        """Return the text of a node's entry. name_text: its name as YAML; at: its position as texts."""
        source_properties = p.get(NAME)
        extra_members: dict[str, Any] = source_properties if isinstance(source_properties, dict) else {}
        node = _mapping_text(extra_members.get("node"))
        more = None
        if not p.keys() <= self.plain_node or p.get("name", name) != name:
            more = self._more(p, CANONICAL_NODE)
            if isinstance(p.get("name"), str) and p["name"] not in ("", name):
                more["name"] = p["name"]
        if self._is_foreign(node):
            self.moved.append(name)
            node = self._moved_node(node)
            extra_members = {**extra_members, "node": node}
        if "name" in node or "edges" in node:
            dangling = [e for e in node.get("edges") or () if isinstance(e, dict)]
            edges = edges + [_dangling(e, name) for e in dangling]
            node = {key: value for key, value in node.items() if key not in ("name", "edges")}
            extra_members = {**extra_members, "node": node}
        quaternion = _quaternion(p.get("orientation"))
        self.filled["orientations"] += quaternion is None
        fill = source_properties is None or self.legacy
        self.filled["nodes"] += source_properties is None if self.listed else fill
        if fill or self.listed:
            node_members = {**({} if self.listed else node), **_mapping_text(node.get("properties"))}
            self.filled["any yaw" if quaternion is None else "yaw"] += "yaw_goal_tolerance" not in node_members
        key = (
            "node",
            quaternion is None,
            fill,
            orjson.dumps((extra_members, more)).decode() if extra_members or more else None,
        )
        pieces = self.templates.get(key)
        if pieces is None:
            pieces = self.templates[key] = self._node_template(
                extra_members, node, more, has_yaw=quaternion is not None, fill=fill
            )
        meta = extra_members.get("meta")
        called = yaml.text(str(meta["node"])) if isinstance(meta, dict) and "node" in meta else name_text
        pose = self._pose(node.get("pose"), at, quaternion or [0.0, 0.0, 0.0, 1.0], turned=self._is_in_child_frame(p))
        return (
            f"{pieces[0]} {called}\n{pieces[1]}{_list_text(edges)}{pieces[2]} {name_text}\n{pieces[3]}{pose}{pieces[4]}"
        )

    def _pose(self, extra: Any, at: tuple[str, str, str], quaternion: list[float], *, turned: bool) -> str:
        """Return the text after ``pose:``."""
        if turned and self.turn is not None:
            x, y, z, w = self.turn.quaternion
            quaternion = multiply((-x, -y, -z, w), quaternion)
        if isinstance(extra, dict):
            position = {**dict(zip("xyz", map(float, at), strict=True)), **_mapping_text(extra.get("position"))}
            orientation = {**dict(zip("xyzw", quaternion, strict=True)), **_mapping_text(extra.get("orientation"))}
            return yaml.block({**extra, "orientation": orientation, "position": position}, 4)
        ox, oy, oz, ow = map(yaml.text, quaternion)
        return (
            f"\n      orientation:\n        w: {ow}\n        x: {ox}\n        y: {oy}\n        z: {oz}\n"
            f"      position:\n        x: {at[0]}\n        y: {at[1]}\n        z: {at[2]}\n"
        )

    def _tolerances(self, has_yaw: bool) -> dict[str, float]:
        """Return the default tolerances of a node. has_yaw: whether it has an orientation."""
        yaw = self.options.yaw_goal_tolerance if has_yaw else ANY_YAW
        return {"xy_goal_tolerance": self.options.xy_goal_tolerance, "yaw_goal_tolerance": yaw}

    def _node_template(
        self,
        extra_members: Mapping[str, Any],
        node: Mapping[str, Any],
        more: dict[str, Any] | None,
        *,
        has_yaw: bool,
        fill: bool,
    ) -> list[str]:
        """Return the text of a node's entry in five pieces, around meta.node, edges, name and pose."""
        inner = dict(node)
        if self.listed:
            inner_properties = _mapping_text(inner.get("properties"))
            tolerances = {key: inner_properties.get(key, value) for key, value in self._tolerances(has_yaw).items()}
            fixed = {"map": self.document["metric_map"], "pointset": self.document["pointset"]}
            fixed |= {"localise_by_topic": self.options.localise_by_topic}
            inner = {"verts": self.ring, **fixed, **tolerances, **inner}
        elif fill:
            inner = {**self._default_node(), "verts": self.ring, **inner}
            tolerances = self._tolerances(has_yaw)
            # The older layout has its tolerances beside the name.
            tolerances = {key: inner.get(key, value) for key, value in tolerances.items()}
            inner["properties"] = {**tolerances, **_mapping_text(inner.get("properties"))}
        elif "nav_frame" not in inner and not (self.turn is not None and has_default_frame(self.document)):
            inner.setdefault("parent_frame", FRAME)
        if more:
            inner["properties"] = {**_mapping_text(inner.get("properties")), **more}
        meta = {"map": self.document["metric_map"], "pointset": self.document["pointset"]}
        meta = {**meta, **_mapping_text(extra_members.get("meta")), "node": None}
        head, middle = _split(meta, 4, "node")
        pieces = _split({**inner, "edges": None, "name": None, "pose": None}, 4, "edges", "name", "pose")
        before, between, after = _split({**extra_members, "meta": None, "node": None}, 2, "meta", "node")
        opening = f"{before}\n{head}"
        return [f"- {opening[2:]}", f"{middle}{between}\n{pieces[0]}", pieces[1], pieces[2], pieces[3] + after]

    def _more(self, p: Properties, canonical: frozenset[str]) -> dict[str, Any]:
        """Return the canonical and other formats' properties for an item's own ``properties``."""
        return {key: value for key, value in p.items() if key not in canonical and key not in self.unwritten}

    def _report(self) -> None:
        fill, filled, options = self.context.fill, self.filled, self.options
        if self.moved:
            problem = f"{len(self.moved)} nodes are in the frame of another transformation than the one written"
            listed = shorten_list(sorted(self.moved))
            self.context.warn(f"{problem}; their poses are converted: {listed}", where="transformation")
        if filled["edges"]:
            why = f"{filled['edges']} edges come from a format without it"
            reason = f"{why}; used for those without one"
            fill("edges: action", options.action, reason, "action")
            if isinstance(options, ListOptions):
                fill("edges: top_vel", options.top_vel, f"{why}; used for those without a speed limit", "top_vel")
                fill("edges: inflation_radius", options.inflation_radius, why, "inflation_radius")
                fill("edges: map_2d", self.document["metric_map"], why)
            else:
                fill("edges: action_type", options.action_type, reason, "action_type")
                fill("edges: fail_policy", options.fail_policy, why, "fail_policy")
                fill("edges: fluid_navigation", options.fluid_navigation, why, "fluid_navigation")
                fill("edges: restrictions", options.restrictions, why, "restrictions")
                fill("edges: config, goal", "the defaults", why)
            fill("edges: recovery_behaviours_config", options.recovery, why, "recovery")
        if filled["nodes"]:
            why = f"{filled['nodes']} nodes come from a format without it"
            reason = f"{why}; used for those without one"
            fill("nodes: verts", f"an octagon of {options.verts_radius:g} m", reason, "verts_radius")
            fill("nodes: xy_goal_tolerance", options.xy_goal_tolerance, reason, "xy_goal_tolerance")
            fill("nodes: localise_by_topic", options.localise_by_topic, why, "localise_by_topic")
            if isinstance(options, WriteOptions):
                fill("nodes: parent_frame", self._default_frame(options), why, "parent_frame")
                fill("nodes: restrictions", options.restrictions, why, "restrictions")
            else:
                fill("nodes: map, pointset", "the map's", why)
        if filled["yaw"]:
            why = f"{filled['yaw']} nodes with an orientation have none; in radians"
            fill("nodes: yaw_goal_tolerance", options.yaw_goal_tolerance, why, "yaw_goal_tolerance")
        if filled["any yaw"]:
            why = f"{filled['any yaw']} nodes have none and no orientation: any yaw is accepted; in radians"
            fill("nodes without an orientation: yaw_goal_tolerance", ANY_YAW, why)
        if filled["orientations"]:
            fill("nodes: pose.orientation", [0.0, 0.0, 0.0, 1.0], f"{filled['orientations']} nodes have none")
        for noun, count in sorted(self.dropped.items()):
            self.context.drop(noun, count, "the format cannot store it")
        for family in sorted(WRITTEN_ON_DEMAND & self.unwritten):
            items = [p for part in self.layers.vector("topology").values() for p in part.properties if family in p]
            self.context.drop(
                f"{family} tags and attributes", len(items), f"omitted to save space; request them with {family}=true"
            )


def _list_text(items: Lines) -> str:
    """Return the text after ``edges:`` or ``nodes:``."""
    return "\n" + "".join([text for _, _, text in sorted(items)]) if items else " []\n"


def _mapping_text(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _quaternion(value: Any) -> list[float] | None:
    """Return four finite numbers, else None."""
    if not isinstance(value, (list, tuple)) or len(value) != 4:
        return None
    if not all(isinstance(v, (int, float)) and not isinstance(v, bool) and math.isfinite(v) for v in value):
        return None
    return list(map(float, value))


def _dangling(edge: Mapping[str, Any], name: str) -> tuple[int, str, str]:
    """Return a dangling edge unchanged, with the id that the schema requires."""
    edge_id = edge.get("edge_id")
    i = (
        edge_id
        if isinstance(edge_id, str) and edge_id
        else f"{name}_{edge.get('node')}"
        if edge_id is None
        else str(edge_id)
    )
    return len(i), i, f"    - {yaml.mapping({**edge, 'edge_id': i}, 6)[6:]}"


def _split(values: Mapping[str, Any], column: int, *holes: str) -> list[str]:
    """Split a mapping's text around the values of these keys, given in alphabetical order.

    A piece before a hole ends with the key's colon: the inserted text needs its own space and line break.
    """
    pieces = []
    part: dict[str, Any] = {}
    for key in sorted(values):
        if key in holes:
            pieces.append(f"{yaml.mapping(part, column) if part else ''}{' ' * column}{key}:")
            part = {}
        else:
            part[key] = values[key]
    return [*pieces, yaml.mapping(part, column) if part else ""]
