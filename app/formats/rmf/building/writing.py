"""Writing a building: coordinates, levels and lifts."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import groupby, islice
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from app.errors import MissingLayer
from app.formats import WriteContext
from app.formats._network import get_source_properties
from app.formats.rmf import common
from app.formats.rmf.building.coordinates import DEGREE_SYSTEMS, IMAGE, METRIC, Scaling, Transform, to_file, transforms
from app.formats.rmf.building.lanes import LANE_TEMPLATE, Lane, lane_parameters, sort_by_lane
from app.formats.rmf.building.reading import named_images, plain_text
from app.formats.rmf.building.vocabulary import DOOR_TEMPLATE, FILE, IN_PIXELS, LINES, NAME, RINGS
from app.formats.rmf.common import NAV_GRAPH, Array, Flow, Storey, mapping, parameter_value
from app.formats.rmf.images import find_stored_image
from app.model.features import Features, Properties, unique_ids
from app.model.layers import Layers, Resources
from app.syntax import yaml
from app.syntax.decimals import DEGREES, METRES, encode_pieces, numbers


class _RewriteError(Exception):
    """Signal that the levels' coordinates are inconsistent and metres must be written. The text is the reason."""


def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """Write ``building.yaml`` and its images, in its source coordinates; networks of other formats in metres.

    Raises MissingLayer if there is neither a network nor anything that came from a building.
    """
    storeys = common.storeys(layers)
    if not storeys:
        raise MissingLayer("openrmf needs a network: upload a building.yaml, tmap2 or OSM file")
    resources: dict[str, bytes] = {}
    for part in layers.parts_of("resources", name=NAME).values():
        resources.update(part.files if isinstance(part, Resources) else {})
    buildings: list[dict[str, Any]] = []
    for storey in storeys:
        building = storey.document.get("building")
        if isinstance(building, dict) and building not in buildings:
            buildings.append(building)
    systems = {building.get("coordinate_system", IMAGE) for building in buildings}
    system = systems.pop() if len(systems) == 1 and (len(buildings) == 1 or systems == {METRIC}) else METRIC
    why = "the levels come from different buildings" if len(buildings) > 1 and system == METRIC else ""
    draft = WriteContext(context.title, context.options, context.attribution)
    try:
        files = _Writer(layers, draft, storeys, buildings[0] if buildings else {}, system, resources, why).files()
        context.dropped += draft.dropped
        context.template += draft.template
        context.warnings += draft.warnings
        return files
    except _RewriteError as changed:
        return _Writer(layers, context, storeys, buildings[0], METRIC, resources, str(changed)).files()


Sections = dict[str, list[str]]
"""A level's lists by name, as pieces of complete output lines."""


def _section_lines(rows: Iterable[str]) -> list[str]:
    """Join rows to pieces of thousands of lines: far fewer strings in memory than rows."""
    left = iter(rows)
    pieces = iter(lambda: "".join(f"      - {row}\n" for row in islice(left, 4096)), "")
    return list(pieces)


class _Vertices:
    """Vertex list of a level being written: nodes first, then the corners of objects."""

    def __init__(self, rows: list[str], old: Mapping[int, int]) -> None:
        self.rows = rows
        self._old = old
        self._by_place: dict[str, int] = {}

    def __len__(self) -> int:
        return len(self.rows)

    def find_or_add(self, position: tuple[str, str], hint: Any) -> int:
        """Return the vertex at this position (x and y as texts): the hinted one, else any, else a new one."""
        start = f"[{position[0]}, {position[1]}, "
        old_row = self._old.get(hint) if isinstance(hint, int) else None
        if old_row is not None and self.rows[old_row].startswith(start):
            return old_row
        if not self._by_place:  # built on first use: most maps never need it
            for k, row in enumerate(self.rows):
                self._by_place.setdefault(", ".join(row.split(", ", 2)[:2]) + ", ", k)
        new_row = self._by_place.get(start)
        if new_row is None:
            new_row = self._by_place[start] = len(self.rows)
            self.rows.append(f"{start}0.0, '']")
        return new_row


class _Writer:
    """Writer of one building in one coordinate system."""

    def __init__(
        self,
        layers: Layers,
        context: WriteContext,
        storeys: Sequence[Storey],
        building: Mapping[str, Any],
        system: str,
        resources: Mapping[str, bytes],
        why: str,
    ) -> None:
        self.layers, self.context, self.storeys, self.system = layers, context, storeys, system
        self.options = context.options if isinstance(context.options, common.WriteOptions) else common.WriteOptions()
        self.robots = common.Robots(self.options, _iterate_nodes(storeys))
        self.names = common.VertexNames(
            ((s.name, n, i), i, p)
            for s in storeys
            for n, part in enumerate(s.networks)
            for i, p in zip(part.ids, part.properties, strict=True)
            if p.get("kind") == "node"
        )
        self.building = dict(building)
        self.resources = resources
        self.why = why
        self.converted = bool(building) and self.building.get("coordinate_system", IMAGE) != system
        self.degrees = system in DEGREE_SYSTEMS
        self.decimals = DEGREES if self.degrees else METRES
        self.flow = Flow()
        self.dropped: Counter[str] = Counter()
        self.created_ids: Counter[str] = Counter()
        self.used: dict[str, bytes] = {}
        self.scaling: dict[str, Scaling] = {}
        self.transforms = {s.name: self._transform(s) for s in storeys}
        reference = self.building.get("reference_level_name")
        self.reference = plain_text(reference) if plain_text(reference) in self.transforms else storeys[0].name

    def _transform(self, storey: Storey) -> Transform:
        values = storey.document.get("transform")
        if self.system != IMAGE or not isinstance(values, list) or len(values) != 4:
            return Transform()
        return Transform(values[0], values[1], (values[2], values[3]))

    def files(self) -> dict[str, bytes]:
        """Return ``building.yaml``, then the images."""
        levels = [piece for storey in self.storeys for piece in self._level(storey)]
        lifts = self._lifts()
        if self.system == IMAGE:
            self._check()
        top = self._top()
        before = {key: value for key, value in top.items() if key < "levels"}
        after = {key: value for key, value in top.items() if key > "levels"}
        text = [yaml.mapping(before, 0) if before else "", "levels:\n", *levels, lifts]
        text.append(yaml.mapping(after, 0) if after else "")
        self._report()
        levels.clear()
        return {FILE: encode_pieces(text), **dict(sorted(self.used.items()))}

    def _top(self) -> dict[str, Any]:
        top = {key: value for key, value in self.building.items() if key not in ("levels", "lifts")}
        if "name" not in top and "building_name" not in top:
            name = self._graph_name()
            default = self.options.building or self.context.title
            top["name"] = default if name is None else name
            if name is None:
                self.context.fill("name", default, "no source names the building", "building")
        if self.system != IMAGE or "coordinate_system" in top:
            top["coordinate_system"] = self.system
        if "reference_level_name" in top and plain_text(top["reference_level_name"]) not in self.transforms:
            del top["reference_level_name"]
        return top

    def _graph_name(self) -> Any:
        """Return the building's name from its navigation graphs."""
        for storey in self.storeys:
            for part in storey.networks:
                graphs = mapping(mapping(part.document.get(NAV_GRAPH), NAV_GRAPH).get("graphs"), "graphs")
                for graph in sorted(graphs):
                    if isinstance(graphs[graph], dict) and graphs[graph].get("building_name") is not None:
                        return graphs[graph]["building_name"]
        return None

    def _served_levels(self, lift: str) -> dict[str, list[str]]:
        """Return the levels with a node in this lift according to navigation graphs, each without doors."""
        return {
            storey.name: []
            for storey in self.storeys
            for part in storey.networks
            if any(
                mapping(get_source_properties(p, NAV_GRAPH).get("parameters"), "").get("lift") == lift
                for p in part.properties
            )
        }

    def _check(self) -> None:
        """Check that the file's measurements and fiducials reproduce the levels' transforms."""
        level_transforms = transforms(self.scaling, self.reference, lambda problem, location: None)
        for name, transform in self.transforms.items():
            if not transform.is_close(level_transforms[name]):
                raise _RewriteError(f"measurements and fiducials no longer match the position of level {name}")

    # coordinates
    def _coordinates(self, part: Features, indices: NDArray[np.intp], storey: str) -> tuple[Array, NDArray[np.intp]]:
        """Return the file's x and y of all coordinates of these items, and the item index of each."""
        geometry = part.geometry[indices]
        if (part.local[indices] == self.degrees).any():
            subset, frame = part.select(indices), self.layers.frame
            geometry = subset.in_wgs84(frame) if self.degrees else subset.in_local(frame)
        at, owner = shapely.get_coordinates(geometry, return_index=True)
        return to_file(self.system, at, self.transforms[storey]), owner

    def _texts(self, raw: Array) -> list[tuple[str, str]]:
        texts = list(map(yaml.decimal, numbers(raw.ravel(), self.decimals)))
        return list(zip(texts[::2], texts[1::2], strict=True))

    # levels

    def _elevation(self, storey: Storey) -> Any:
        """Return the elevation as in the source, unless the environment's differs."""
        source_elevation = mapping(storey.document.get("level"), "level").get("elevation", 0.0)
        elevation = next((level.elevation for level in self.layers.levels if level.name == storey.name), None)
        return source_elevation if elevation is None or source_elevation == elevation else elevation

    def _level(self, storey: Storey) -> list[str]:
        """Return the level's lines, in pieces."""
        members = dict(mapping(storey.document.get("level"), "level"))
        if self.converted:
            dropped_keys = sorted(key for key in members if key in IN_PIXELS and members[key])
            self.dropped["level settings in pixels of their drawing"] += len(dropped_keys)
            members = {key: value for key, value in members.items() if key not in IN_PIXELS}
        members["elevation"] = self._elevation(storey)
        self._drawings(members, storey.name)
        vertices, ids = self._nodes(storey)
        sections: Sections = {"lanes": _section_lines(self._lanes(storey, ids))}
        self._objects(storey, vertices, sections)
        self._dangling(storey, vertices, sections)
        sections["vertices"] = _section_lines(vertices.rows)
        out = [f"  {yaml.text(storey.name)}:\n"]
        for key in sorted({*members, *(k for k, rows in sections.items() if rows)}):
            if key in sections:
                out.append(f"    {key}:\n")
                out += sections[key]
            else:
                out.append(yaml.mapping({key: members[key]}, 4))
        return out

    def _drawings(self, members: dict[str, Any], level: str) -> None:
        """Add the images that the level names, under paths below the building's directory."""
        for key, image in list(named_images(members)):
            name = find_stored_image(image, self.resources)
            if name is None:
                if image:
                    problem = f"the image {image[:200]!r} was not uploaded; the map names it but does not contain it"
                    self.context.warn(problem, where=f"levels.{level}.{key}.filename")
                continue
            self.used[name] = self.resources[name]
            if name != image:
                outer, _, inner = key.partition(".")
                if inner:
                    members[outer] = {**members[outer], inner: {**members[outer][inner], "filename": name}}
                else:
                    members[outer] = {**members[outer], "filename": name}

    def _nodes(self, storey: Storey) -> tuple[_Vertices, dict[str, int]]:
        """Convert the nodes to vertices in source order, with each node id's vertex index."""
        elevation = float(self._elevation(storey))
        nodes: list[tuple[tuple[bool, int, int, str], str]] = []
        for n, part in enumerate(storey.networks):
            point = (shapely.get_type_id(part.geometry) == 0) & ~shapely.is_empty(part.geometry)
            node: NDArray[np.bool_] = np.array([p.get("kind") == "node" for p in part.properties], bool)
            self.dropped["nodes without a point"] += int((node & ~point).sum())
            indices = np.flatnonzero(node & point)
            raw, _ = self._coordinates(part, indices, storey.name)
            z = shapely.get_z(part.geometry[indices])
            for k, position, high in zip(indices.tolist(), self._texts(raw), z.tolist(), strict=True):
                i, p = part.ids[k], part.properties[k]
                at = get_source_properties(p, NAME).get("index")
                has_index = isinstance(at, int)
                key = (not has_index, at if isinstance(at, int) else 0, len(i), i)
                height = 0.0 if math.isnan(high) else high - elevation
                name = self.names.choose((storey.name, n, i), i, p)
                row = self._vertex(name, p, position, height, self.robots.vertex_properties(storey.name, i))
                nodes.append((key, row))
        nodes.sort(key=lambda item: item[0])
        ids: dict[str, int] = {}
        old: dict[int, int] = {}
        for k, ((unknown, was, _, i), _) in enumerate(nodes):
            ids.setdefault(i, k)
            if not unknown:
                old.setdefault(was, k)
        return _Vertices([row for _, row in nodes], old), ids

    def _vertex(
        self, new_name: str, p: Properties, position: tuple[str, str], z: float, further: Mapping[str, Any]
    ) -> str:
        """Return a vertex's row. new_name: for a node of another format. z: metres above the level."""
        source_members = get_source_properties(p, NAME)
        title = p.get("name")
        parameters = source_members.get("parameters")
        if NAME in p:
            name = (
                source_members["name"]
                if "name" in source_members and plain_text(source_members["name"]) == title
                else title or ""
            )
        else:
            name = new_name
            graph = mapping(get_source_properties(p, NAV_GRAPH).get("parameters"), "parameters")
            parameters = {
                key: common.typed_parameter(value) for key, value in graph.items() if key not in ("name", "lift")
            }
            self.dropped["nodes' attributes of other formats"] += any(
                isinstance(v, dict) for key, v in p.items() if key != NAV_GRAPH
            )
        if further:
            parameters = {
                **(parameters or {}),
                **{key: common.typed_parameter(value) for key, value in further.items()},
            }
        parameters = common.with_area(parameters or {}, p, typed=True)
        self.dropped["nodes' orientations"] += p.get("orientation") is not None
        row = f"[{position[0]}, {position[1]}, {yaml.text(round(z, METRES) + 0.0)}, {yaml.text(name)}"
        if parameters or source_members.get("more"):
            row += f", {self.flow(parameters)}"
        return row + "".join(f", {self.flow(v)}" for v in source_members.get("more") or ()) + "]"

    # lanes

    def _lanes(self, storey: Storey, ids: Mapping[str, int]) -> Iterator[str]:
        """Write edges as lanes; the edges of one source lane, or matching opposite edges, form a two-way lane."""
        for _, lanes in groupby(self._edges(storey, ids), key=lambda lane: lane.was):
            waiting: dict[Any, list[Lane]] = {}
            out: list[Lane] = []
            for lane in lanes:
                partner = waiting.get(lane.partner())
                if partner and lane.source != lane.target:
                    first = partner.pop()
                    first.both = True
                    continue
                waiting.setdefault(lane.parameters_key(), []).append(lane)
                out.append(lane)
            for lane in out:
                yield lane.row(self.flow)

    def _edges(self, storey: Storey, ids: Mapping[str, int]) -> Iterator[Lane]:
        """Iterate over the level's edges in the order of their source lanes."""
        for _, p in sort_by_lane(storey.networks):
            source, target = ids.get(str(p.get("source"))), ids.get(str(p.get("target")))
            if p.get("kind") != "edge" or source is None or target is None:
                self.dropped["edges without two nodes on their level"] += 1
                continue
            self.dropped["edges' actions"] += p.get("action") is not None
            self.dropped["edges' widths"] += p.get("width") is not None
            source_members = get_source_properties(p, NAME)
            if NAME not in p:
                self.created_ids["lanes"] += NAV_GRAPH not in p
                source_members = {"parameters": lane_parameters(p, self.options)}
                self.dropped["edges' attributes of other formats"] += any(
                    isinstance(v, dict) for key, v in p.items() if key != NAV_GRAPH
                )
            limit = common.limit(p) or (self.options.speed_limit if NAME not in p and NAV_GRAPH not in p else 0.0)
            yield Lane.from_edge(limit, source_members, source, target, self.flow)

    def _dangling(self, storey: Storey, vertices: _Vertices, sections: Sections) -> None:
        """Write back rows to vertices that did not exist, if these still do not exist."""
        for section, rows in mapping(storey.document.get("dangling"), "dangling").items():
            for row in rows:
                ends = row["vertices"] if isinstance(row, dict) else row[:2]
                if section in RINGS or not all(0 <= v < len(vertices) for v in ends):
                    sections.setdefault(section, []).extend(_section_lines([self.flow(row)]))
                    problem = f"{section} with vertices that do not exist; rmf_building_map_tools will reject the file"
                    self.context.warn(problem, where=f"levels.{storey.name}.{section}")
                else:
                    self.dropped[f"{section} to vertices that did not exist"] += 1

    # objects

    def _objects(self, storey: Storey, vertices: _Vertices, sections: Sections) -> None:
        sections_of = {kind: section for section, kind in {**LINES, **RINGS}.items()}
        rows_by_section: dict[str, list[tuple[tuple[bool, int, str], str]]] = {}
        scaling = Scaling([], [])
        for part in storey.objects:
            everything = np.arange(len(part))
            raw, owner = self._coordinates(part, everything, storey.name)
            texts = self._texts(raw)
            first = np.searchsorted(owner, everything)
            last = np.searchsorted(owner, everything, side="right")
            order = sorted(range(len(part)), key=lambda k: _place(part.ids[k], part.properties[k]))
            for k in order:
                p = part.properties[k]
                kind, at = p.get("kind"), texts[first[k] : last[k]]
                coordinates = raw[first[k] : last[k]]
                key = _place(part.ids[k], p)
                if kind == "lift":
                    continue
                if kind in LINES.values() and len(at) >= 2:
                    row, parameters = self._line(p, vertices, [at[0], at[-1]])
                    self.dropped["bends of walls, doors and measurements"] += int(len(at) > 2)
                    if kind == "measurement":
                        metres = parameter_value(parameters, "distance", 0.0)
                        length = math.dist(coordinates[0], coordinates[-1])
                        scaling.measurements.append((length, float(metres)))
                    rows_by_section.setdefault(sections_of[str(kind)], []).append((key, row))
                elif kind in RINGS.values() and len(at):
                    rows = [(key, row) for row in self._rings(p, part.geometry[k], vertices, at)]
                    rows_by_section.setdefault(sections_of[str(kind)], []).extend(rows)
                elif kind == "model" and len(at) == 1:
                    rows_by_section.setdefault("models", []).append((key, self._model(p, at[0], storey)))
                elif kind == "fiducial" and len(at) == 1:
                    name = str(p.get("name") or "")
                    more = get_source_properties(p, NAME).get("more") or []
                    row = f"[{at[0][0]}, {at[0][1]}, {yaml.text(name)}{''.join(', ' + self.flow(v) for v in more)}]"
                    rows_by_section.setdefault("fiducials", []).append((key, row))
                    scaling.fiducials.append((name, float(at[0][0]), -float(at[0][1])))
                else:
                    self.dropped["objects that a building cannot contain"] += 1
        for section, rows_of in rows_by_section.items():
            sections[section] = _section_lines(row for _, row in sorted(rows_of, key=lambda item: item[0]))
        self.scaling[storey.name] = scaling

    def _line(self, p: Properties, vertices: _Vertices, ends: list[tuple[str, str]]) -> tuple[str, dict[str, Any]]:
        source_members = get_source_properties(p, NAME)
        hints = source_members.get("vertices")
        hints = hints if isinstance(hints, list) and len(hints) == 2 else [None, None]
        i, j = (vertices.find_or_add(position, hint) for position, hint in zip(ends, hints, strict=True))
        parameters = dict(mapping(source_members.get("parameters"), "parameters"))
        if p.get("kind") == "door" and "parameters" not in source_members:
            parameters = dict(DOOR_TEMPLATE)
            self.created_ids["doors"] += 1
        name = p.get("name")
        if isinstance(name, str) and name and parameter_value(parameters, "name") != name:
            parameters["name"] = [1, name]
        more = "".join(f", {self.flow(v)}" for v in source_members.get("more") or ())
        return f"[{i}, {j}, {self.flow(parameters)}{more}]", parameters

    def _rings(self, p: Properties, geometry: Any, vertices: _Vertices, texts: list[tuple[str, str]]) -> Iterable[str]:
        source_members = get_source_properties(p, NAME)
        members = {key: value for key, value in source_members.items() if key not in ("index", "vertices")}
        members.setdefault("parameters", {})
        source_hints = source_members.get("vertices")
        hints: list[Any] = source_hints if isinstance(source_hints, list) else []
        pieces = list(geometry.geoms) if geometry.geom_type == "MultiPolygon" else [geometry]
        done = 0
        for piece in pieces:
            count = int(shapely.get_num_coordinates(piece))
            ring = texts[done : done + count]
            done += count
            if piece.geom_type == "Polygon":
                self.dropped["holes in floors"] += len(piece.interiors)
                ring = ring[: len(piece.exterior.coords)]
                if len(ring) != len(hints):  # a polygon repeats its first corner, a floor need not
                    ring = ring[:-1]
            corner_hints = hints if len(hints) == len(ring) else [None] * len(ring)
            corners = [vertices.find_or_add(position, hint) for position, hint in zip(ring, corner_hints, strict=True)]
            yield self.flow({**members, "vertices": corners})

    def _model(self, p: Properties, position: tuple[str, str], storey: Storey) -> str:
        members = dict(mapping(get_source_properties(p, NAME).get("says"), "says"))
        pose = common.object_pose(p)
        if pose is not None and not self.degrees:
            z = round(pose[2] - float(self._elevation(storey)), METRES) + 0.0
            if z or "z" not in members:
                members["z"] = z
            members["yaw"] = round(pose[5] - self.transforms[storey.name].rotation, DEGREES) + 0.0
            self.dropped["models' roll and pitch"] += bool(pose[3] or pose[4])
        members.setdefault("yaw", 0.0)
        if isinstance(p.get("name"), str):
            members["name"] = p["name"]
        members["x"], members["y"] = (float(v) for v in position)
        return self.flow(members)

    def _lifts(self) -> str:
        """Write the lifts of all levels, in the order of their file."""
        lifts: list[tuple[tuple[bool, int, str], str, dict[str, Any]]] = []
        for storey in self.storeys:
            for part in storey.objects:
                for k, p in enumerate(part.properties):
                    if p.get("kind") != "lift":
                        continue
                    if int(shapely.get_type_id(part.geometry[k])) != 0 or part.geometry[k].is_empty:
                        self.dropped["lifts without a point"] += 1
                        continue
                    members = dict(mapping(get_source_properties(p, NAME).get("says"), "says"))
                    floor = plain_text(members.get("reference_floor_name"))
                    floor = floor if floor in self.transforms else self.reference
                    raw, _ = self._coordinates(part, np.array([k]), floor)
                    (x, y) = self._texts(raw)[0]
                    members["x"], members["y"] = float(x), float(y)
                    size = common.object_size(p) or (1.0, 1.0)
                    members["width"], members["depth"] = size
                    pose = common.object_pose(p)
                    if pose is not None and not self.degrees:
                        members["yaw"] = round(pose[5], DEGREES) + 0.0
                    members.setdefault("yaw", 0.0)
                    if NAME not in p:
                        self.created_ids["lifts"] += 1
                        served = self._served_levels(str(p.get("name")))
                        members |= {"doors": {}, "level_doors": served, "reference_floor_name": floor, "plugins": True}
                    lifts.append((_place(part.ids[k], p), str(p.get("name") or part.ids[k]), members))
        lifts.sort(key=lambda item: item[0])
        names = unique_ids(name for _, name, _ in lifts)
        if not lifts:
            return "lifts: {}\n"
        # Order matters: a vertex belongs to the first lift whose shaft contains it.
        rows = zip(names, lifts, strict=True)
        return "lifts:\n" + "".join(yaml.mapping({name: members}, 2) for name, (_, _, members) in rows)

    def _report(self) -> None:
        if self.why:
            text = "cartesian_meters is written instead of the source's coordinates"
            self.context.warn(f"{self.why}: {text}", file=FILE, where="coordinate_system")
        for text, count in sorted(self.dropped.items()):
            self.context.drop(text, count, "a building in these coordinates cannot store it")
        if self.created_ids["lanes"]:
            why = f"{self.created_ids['lanes']} edges come from another format"
            self.context.fill("lanes: graph_idx", self.options.graph, why, "graph")
            limited = f"{why}; used for those without one"
            self.context.fill("lanes: speed_limit", self.options.speed_limit, limited, "speed_limit")
            self.context.fill("lanes: orientation", LANE_TEMPLATE["orientation"][1], why)
        self.robots.report(self.context)
        self.names.report(self.context, FILE, "levels")
        if self.created_ids["doors"]:
            parameters = {key: value[1] for key, value in DOOR_TEMPLATE.items()}
            self.context.fill(
                "doors: parameters", parameters, f"{self.created_ids['doors']} doors come from a navigation graph"
            )
        if self.created_ids["lifts"]:
            why = f"{self.created_ids['lifts']} lifts come from a navigation graph"
            self.context.fill(
                "lifts: doors, level_doors, reference floor",
                "none, on the levels of its vertices, the first level",
                why,
            )


def _place(i: str, p: Properties) -> tuple[bool, int, str]:
    """Return the sort key of items in their list: order of the file, then id."""
    at = get_source_properties(p, NAME).get("index", get_source_properties(p, NAV_GRAPH).get("index"))
    has_index = isinstance(at, int)
    return (not has_index, at if isinstance(at, int) else 0, i)


def _iterate_nodes(storeys: Iterable[Storey]) -> Iterator[tuple[str, str, Properties]]:
    for storey in storeys:
        for part in storey.networks:
            for i, p in zip(part.ids, part.properties, strict=True):
                if p.get("kind") == "node":
                    yield storey.name, i, p
