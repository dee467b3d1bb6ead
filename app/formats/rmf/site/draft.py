"""Site being written: elements by id, ids in use, and the levels and lifts so far."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import orjson

from app.formats import WriteContext
from app.formats._network import get_source_properties
from app.formats.rmf import common
from app.formats.rmf.common import BUILDING, NAV_GRAPH, Storey, mapping
from app.formats.rmf.site import vocabulary
from app.formats.rmf.site.vocabulary import NAME, Cabin, metres
from app.model.features import Features, Properties
from app.model.layers import Layers, Resources
from app.parameters import parameter


@dataclass(frozen=True, slots=True)
class WriteOptions(common.WriteOptions):
    """Values of a site that no source specifies, and its encoding."""

    encoding: Literal["json", "ron"] = parameter(
        "json", "encoding of the file: json, or ron for older releases of the editor"
    )


@dataclass(slots=True)
class Floor:
    """Level being written. element: its output so far; by_place: anchors of nodes and corners by position."""

    storey: Storey
    id: str
    elevation: float
    document: dict[str, Any]
    element: dict[str, Any]
    nodes: dict[str, str] = field(default_factory=dict)
    by_place: dict[tuple[float, float], str] = field(default_factory=dict)

    @property
    def anchors(self) -> dict[str, Any]:
        """Return the level's anchors by id, as written."""
        anchors: dict[str, Any] = self.element["anchors"]
        return anchors


@dataclass(slots=True)
class Lift:
    """Lift being written.

    anchors: anchors of its cabin by id; by_place: those that are nodes, by position and name.
    """

    cabin: Cabin
    element: dict[str, Any]
    anchors: dict[str, Any]
    by_place: dict[tuple[float, float, str], str] = field(default_factory=dict)


def sorted_json(value: Any) -> bytes:
    """Serialise a value as JSON with sorted keys: equal values give equal bytes."""
    return orjson.dumps(value, option=orjson.OPT_SORT_KEYS)


class Draft:
    """Site being written: its output so far, and the ids in use."""

    def __init__(self, layers: Layers, context: WriteContext, storeys: Sequence[Storey]) -> None:
        self.layers, self.context = layers, context
        self.options = context.options if isinstance(context.options, WriteOptions) else WriteOptions()
        self.robots = common.Robots(self.options, _iterate_nodes(storeys))
        self.dropped: Counter[str] = Counter()
        self.created: Counter[str] = Counter()
        self.used: dict[str, bytes] = {}
        self.resources: dict[str, bytes] = {}
        for part in layers.parts_of("resources", name=BUILDING).values():
            self.resources.update(part.files if isinstance(part, Resources) else {})
        documents = [_document(storey) for storey in storeys]
        first = next((d for d in documents if isinstance(d.get("site"), dict)), {})
        self.site: dict[str, Any] = first.get("site", {})
        if any(d.get("of") != first.get("of") for d in documents if d):
            context.warn("the levels come from different sites; members of the whole site are taken from the first one")
        documents = [d if first and d.get("of") == first.get("of") else {} for d in documents]
        self.same = {s.name for s, d in zip(storeys, documents, strict=True) if d}
        self.mentioned = _ids(documents, storeys, self.same)
        self.claimed: set[str] = set(element_ids(self.site))
        self.next = 0
        self.anchors: dict[str, Any] = dict(mapping(self.site.get("anchors"), "anchors"))
        guided = mapping(mapping(self.site.get("navigation"), "navigation").get("guided"), "guided")
        self.guided = dict(guided)
        self.graphs: dict[str, Any] = dict(mapping(guided.get("graphs"), "graphs"))
        ranking = [str(i) for i in guided.get("ranking") or []]
        self.numbers = {n: i for i, n in vocabulary.graph_numbers(self.graphs.items(), ranking).items()}
        self.mutexes: dict[str, Any] = dict(mapping(guided.get("mutex_groups"), "mutex_groups"))
        self.textures: dict[str, Any] = dict(mapping(self.site.get("textures"), "textures"))
        self.texture_ids = {sorted_json(group): i for i, group in self.textures.items()}
        self.groups: dict[str, Any] = dict(mapping(self.site.get("fiducial_groups"), "fiducial_groups"))
        self.descriptions: dict[str, Any] = dict(mapping(self.site.get("model_descriptions"), "model_descriptions"))
        self.robot_types: dict[str, Any] = dict(mapping(self.site.get("robots"), "robots"))
        self.description_ids = {sorted_json([d, i in self.robot_types]): i for i, d in self.descriptions.items()}
        self.mutex_ids, self.group_ids = _ids_by_name(self.mutexes), _ids_by_name(self.groups)
        self.instances: dict[str, Any] = {}
        self.fresh: list[str] = []
        self.moved: dict[str, tuple[Any, Any]] = {}
        self.locations: dict[str, Any] = {}
        self.lanes: dict[str, Any] = {}
        self.floors = [self._floor(s, d) for s, d in zip(storeys, documents, strict=True)]
        self.lifts: dict[str, Lift] = {}
        self.docks: dict[tuple[str, str], str] = {}

    def claim(self, hint: Any = None) -> str:
        """Reserve the wanted id if it is free, else a new one."""
        key = str(hint)
        if isinstance(hint, int) and not isinstance(hint, bool) and 0 <= hint < 2**32 and key not in self.claimed:
            self.claimed.add(key)
            return key
        while (key := str(self.next)) in self.mentioned or key in self.claimed:
            self.next += 1
        self.claimed.add(key)
        return key

    def source_members(self, floor: Floor, p: Properties) -> dict[str, Any]:
        """Return the site's source members of an item; none if it comes from another site."""
        return get_source_properties(p, NAME) if floor.storey.name in self.same else {}

    def _floor(self, storey: Storey, document: dict[str, Any]) -> Floor:
        level = dict(mapping(document.get("level"), "level"))
        level_id = level.pop("id", None)
        i = self.claim(int(level_id) if isinstance(level_id, str) and level_id.isdigit() else None)
        self.claimed.update(element_ids(level))
        source_properties = mapping(level.get("properties"), "properties")
        listed = next((level.elevation for level in self.layers.levels if level.name == storey.name), None)
        old = mapping(storey.document.get("level"), "level").get("elevation", 0.0)
        elevation = float(source_properties.get("elevation", old) or 0.0) if listed is None else listed
        properties = {**source_properties, "name": storey.name, "elevation": elevation}
        floor = Floor(storey, i, elevation, document, {**level, "properties": properties, "anchors": {}})
        if not document:
            spoken = mapping(storey.document.get("level"), "level")
            for section in ("layers", "features", "constraints", "lights", "physical_cameras"):
                self.dropped[f"a building's {section}"] += bool(spoken.get(section))
        return floor

    def coordinates(self, part: Features) -> np.ndarray[Any, np.dtype[np.object_]]:
        """Return the part's geometry in metres of the local frame."""
        return part.in_local(self.layers.frame)

    def mutex(self, name: str) -> str:
        """Return the id of the mutex group with this name, creating it if missing."""
        return self.group_named(self.mutexes, self.mutex_ids, name)

    def group_named(self, groups: dict[str, Any], ids: dict[str, str], name: str) -> str:
        """Return the id of the group with this name, creating it if missing."""
        if name not in ids:
            ids[name] = self.claim()
            groups[ids[name]] = {"name": name}
        return ids[name]

    def items(self, floor: Floor) -> Iterator[tuple[str, Properties, Any, str]]:
        """Iterate over (kind, properties, geometry in metres, id) of the level's objects in source order."""
        for part in floor.storey.objects:
            geometry = self.coordinates(part)

            def order(k: int, part: Features = part) -> tuple[str, bool, int, int, str]:
                p = part.properties[k]
                at = get_source_properties(p, BUILDING).get("index", get_source_properties(p, NAV_GRAPH).get("index"))
                has_position = isinstance(at, int)
                return (
                    str(p.get("kind")),
                    not has_position,
                    at if isinstance(at, int) else 0,
                    len(part.ids[k]),
                    part.ids[k],
                )

            for k in sorted(range(len(part)), key=order):
                yield str(part.properties[k].get("kind")), part.properties[k], geometry[k], part.ids[k]


def _ids_by_name(groups: Mapping[str, Any]) -> dict[str, str]:
    """Map each name to the id of the first group with this name."""
    return {str(group.get("name")): i for i, group in reversed(list(groups.items()))}


def spot_of(at: Sequence[float]) -> tuple[float, float]:
    """Convert [x, y] in metres to a key: positions that are written alike share it."""
    return metres(at[0]), metres(at[1])


def _document(storey: Storey) -> dict[str, Any]:
    """Return the site data of the level's collection documents."""
    documents = (part.document.get(NAME) for part in (*storey.objects, *storey.networks))
    return next((document for document in documents if isinstance(document, dict)), {})


def _iterate_nodes(storeys: Iterable[Storey]) -> Iterator[tuple[str, str, Properties]]:
    for storey in storeys:
        for part in storey.networks:
            for i, p in zip(part.ids, part.properties, strict=True):
                if p.get("kind") == "node":
                    yield storey.name, i, p


def element_ids(value: Any) -> set[str]:
    """Collect the element ids in all nested mappings, except instances of scenarios, whose keys are model ids."""
    if not isinstance(value, dict):
        return set()
    ids = {k for k in value if k.isascii() and k.isdigit()}
    return ids.union(*(element_ids(v) for k, v in value.items() if k not in ("extensions", "tasks", "instances")))


def _ids(documents: Iterable[Mapping[str, Any]], storeys: Iterable[Storey], same: set[str]) -> set[str]:
    """Collect all source ids of the site's items and documents, so that no new element gets one of them."""
    out: set[str] = set()
    for document in documents:
        out |= element_ids(document)
        out.add(str(mapping(document.get("level"), "level").get("id")))
    for storey in storeys:
        if storey.name not in same:
            continue
        for part in (*storey.objects, *storey.networks):
            for p in part.properties:
                members = get_source_properties(p, NAME)
                listed = members.get("anchors")
                ids = [
                    members.get("id"),
                    members.get("lane"),
                    members.get("anchor"),
                    mapping(members.get("robot"), "").get("id"),
                ]
                out.update(str(i) for i in [*ids, *(listed if isinstance(listed, list) else ())] if i is not None)
                out |= element_ids({k: v for k, v in members.items() if k in ("locations", "says")})
    return out
