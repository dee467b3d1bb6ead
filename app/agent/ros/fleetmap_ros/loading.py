"""Load a robot's new map into Nav2 and topological_navigation.

The agent's hooks ``nav2`` and ``topological`` run this file with the system's ``python3`` (standard library only, no
installed package); the ROS 2 node ``fleetmap_ros`` imports it. This module decides which services to call; a ``Ros``
calls them with the command ``ros2`` or rclpy.

Each step prints one line and appends one JSON line ``{"step", "result", "detail"}`` to the file FLEETMAP_HOOK_STATUS;
``result`` is ``done``, ``skipped`` or ``failed``. ``hooks/nav2.json`` beside ``current`` stores what was loaded last,
so that closed edges are opened again and a mask that the map no longer has is replaced by an empty one.

Sources: navigation2: ``nav2_msgs/srv/{LoadMap,SetRouteGraph,DynamicEdges}.srv``, ``nav2_map_server/src/map_server.cpp``
and ``nav2_route/src/plugins/edge_cost_functions/dynamic_edges_scorer.cpp``; topological_navigation, ``manager2.py``.
"""

from __future__ import annotations

import contextlib
import functools
import json
import os
import queue
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Protocol

CALL_SECONDS = 60.0
WAIT_SECONDS = 5.0
"""Time limit for the discovery of a service."""

TOTAL_SECONDS = 240.0
"""Time limit for all calls of a hook: less than the agent's limit for a hook, so that the hook can still report."""

SETTLE_SECONDS = 2.0
"""Pause after which a latched topic has delivered its history; the message before it is the newest."""

MAX_OUTPUT_BYTES = 8192
"""Number of bytes of a response kept from its start and from its end: LoadMap's response contains the map."""

MAX_CHUNKS = 64
"""Maximum number of queued chunks of 64 KiB."""

MAX_EDGE_ID = 65535
"""Maximum edge id of DynamicEdges, which has 16 bits."""

GROUND = "ground"
LOAD_MAP = "nav2_msgs/srv/LoadMap"
SET_ROUTE_GRAPH = "nav2_msgs/srv/SetRouteGraph"
DYNAMIC_EDGES = "nav2_msgs/srv/DynamicEdges"
WRITE_TOPOLOGICAL_MAP = "topological_navigation_msgs/srv/WriteTopologicalMap"
RESULTS = {1: "the map does not exist", 2: "invalid map data", 3: "invalid map metadata", 255: "undefined failure"}
"""Error results of LoadMap."""

Report = Callable[[str, str, str], None]
"""Report function: ``report(step, result, detail)``."""


class LoadError(Exception):
    """Failed step; the text says what to do."""


class SkippedStep(Exception):
    """Skipped step: not needed, or not possible and not required."""


class Ros(Protocol):
    """Service calls, and one latched topic."""

    def has_service(self, name: str, type: str) -> bool:
        """Whether a service is available; waits some seconds for its discovery."""

    def call(self, name: str, type: str, request: Mapping[str, Any]) -> Mapping[str, Any]:
        """Call a service and return ``result`` or ``success`` of its response. Raises LoadError."""

    def last_text(self, topic: str) -> str:
        """Read the newest message of a latched std_msgs/msg/String. Raises LoadError."""


@dataclass(frozen=True)
class Names:
    """Names of nodes and grids; a node with an empty name is never called.

    Attributes:
        required: names set by the operator; an absent node is an error.
    """

    map_server: str = "/map_server"
    keepout_server: str = "/keepout_filter_mask_server"
    speed_server: str = "/speed_filter_mask_server"
    route_server: str = "/route_server"
    dynamic_edges: str = ""
    manager: str = "/topological_map_manager2"
    topic: str = "/topological_map_2"
    grid: str = ""
    keepout_grid: str = "keepout"
    speed_grid: str = "speed"
    required: frozenset[str] = frozenset()

    @classmethod
    def from_environment(cls, variables: Mapping[str, str]) -> Names:
        """Read the names from environment variables, listed in docs/how-to/nav2.md."""
        given = {
            "map_server": variables.get("FLEETMAP_NAV2_MAP_SERVER"),
            "keepout_server": variables.get("FLEETMAP_NAV2_KEEPOUT_SERVER"),
            "speed_server": variables.get("FLEETMAP_NAV2_SPEED_SERVER"),
            "route_server": variables.get("FLEETMAP_NAV2_ROUTE_SERVER"),
            "dynamic_edges": variables.get("FLEETMAP_NAV2_DYNAMIC_EDGES"),
            "manager": variables.get("FLEETMAP_TOPOLOGICAL_MANAGER"),
            "topic": variables.get("FLEETMAP_TOPOLOGICAL_TOPIC"),
            "grid": variables.get("FLEETMAP_NAV2_GRID", variables.get("FLEETMAP_NAV2_MAP")),
            "keepout_grid": variables.get("FLEETMAP_NAV2_KEEPOUT_GRID"),
            "speed_grid": variables.get("FLEETMAP_NAV2_SPEED_GRID"),
        }
        values = {name: value for name, value in given.items() if value is not None}
        return cls(**values, required=frozenset(name for name, value in values.items() if value))


@dataclass
class Site:
    """Map to load.

    Attributes:
        folder: version folder rather than ``current``, so that a switch in between does not mix two maps.
        memory: folder that stores what was loaded last.
        changed: changed files as ``format/file``; None: all files.
        level: level of the robot; empty: the default level.
    """

    folder: Path
    memory: Path
    changed: frozenset[str] | None = None
    level: str = ""
    _prefix: str | None = field(default=None, repr=False)

    @classmethod
    def from_environment(cls, variables: Mapping[str, str]) -> Site:
        """Read the agent's hook variables. Raises KeyError if one is missing."""
        current = Path(variables["FLEETMAP_CURRENT"])
        listed = Path(variables.get("FLEETMAP_CHANGED_FILE", ""))
        text = listed.read_text() if listed.is_file() else variables.get("FLEETMAP_CHANGED", "")
        memory = current.parent / "hooks"
        return cls(
            current.resolve(strict=True), memory, frozenset(text.splitlines()), variables.get("FLEETMAP_LEVEL", "")
        )

    @property
    def prefix(self) -> str:
        """Folder of the level's files below a format: ``L2/``; empty for the default level. Raises LoadError."""
        if self._prefix is None:
            self._prefix = self._find_prefix()
        return self._prefix

    def _find_prefix(self) -> str:
        level = self.level
        if not level:
            return ""
        names, files = self._levels()
        if names and level not in names:
            raise LoadError(f"the map has no level {level!r}: choose one of {', '.join(names)}")
        folders = {name.partition("/")[0] for name in files.get(level, ()) if "/" in name}
        if len(folders) == 1:  # the folder name is the level name, percent-encoded if needed
            return folders.pop() + "/"
        below = any(name.startswith(f"{level}/") for name in files.get(level, ()))
        if below or any((folder / level).is_dir() for folder in self.folder.iterdir() if folder.is_dir()):
            return f"{level}/"
        if level == GROUND or files.get(level) or names == [level]:
            return ""
        raise LoadError(f"the map has no files of level {level!r}")

    def level_names(self) -> list[str]:
        """Return the names of the map's levels; none if it does not list them. Raises LoadError."""
        return self._levels()[0]

    def _levels(self) -> tuple[list[str], dict[str, list[str]]]:
        """Return level names and files by level of ``levels.json``; empty if there is no such file."""
        try:
            lines = json.loads((self.folder / "levels.json").read_bytes())["levels"]
            files = {
                str(line["name"]): [n for names in line.get("files", {}).values() for n in names] for line in lines
            }
        except FileNotFoundError:
            return [], {}
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise LoadError(f"could not read {self.folder / 'levels.json'}: {error}") from None
        return list(files), files

    def path(self, format: str, name: str) -> str:
        """Return the path of a file of the level: ``format/[level/]name``."""
        return f"{format}/{self.prefix}{name}"

    def has_changed(self, *paths: str) -> bool:
        """Whether one of these files has changed."""
        return self.changed is None or any(path in self.changed for path in paths)

    def recall(self) -> dict[str, Any]:
        """Read what was loaded last; empty if unknown."""
        try:
            state = json.loads((self.memory / "nav2.json").read_bytes())
        except (OSError, ValueError):
            return {}
        return state if isinstance(state, dict) else {}

    def remember(self, **members: Any) -> None:
        """Store what was loaded."""
        self.memory.mkdir(exist_ok=True)
        new = self.memory / ".nav2.json.new"
        new.write_text(json.dumps({**self.recall(), **members}) + "\n")
        new.replace(self.memory / "nav2.json")


class Steps:
    """Runs steps and reports each; a failed step does not prevent the next ones."""

    def __init__(self, report: Report) -> None:
        self._report, self.failed = report, False

    def run(self, name: str, step: Callable[[], str | None]) -> bool:
        """Run a step, which returns a description or None if nothing was to do. Return False if it failed."""
        try:
            detail = step()
        except SkippedStep as skipped:
            self._report(name, "skipped", str(skipped))
        except LoadError as error:
            self.failed = True
            self._report(name, "failed", str(error))
            return False
        else:
            if detail is not None:
                self._report(name, "done", detail)
        return True


# --- Nav2 ---


class Nav2:
    """Nav2's map server, filter mask servers and route server."""

    def __init__(self, ros: Ros, site: Site, names: Names) -> None:
        self._ros, self._site, self._names = ros, site, names

    def load(self, report: Report) -> bool:
        """Load changed files and report each step. Return whether all succeeded."""
        steps = Steps(report)
        if not steps.run("level", self._level):
            return False
        steps.run("map", self._map)
        for kind in ("keepout", "speed"):
            steps.run(kind, functools.partial(self._mask, kind))
        steps.run("route graph", self._route)
        return not steps.failed

    def _level(self) -> str | None:
        return f"level {self._site.level}" if self._site.prefix else None

    def _map(self) -> str | None:
        server = self._names.map_server
        if not server:
            return None
        grids = grid_names(self._site)
        name = map_grid(grids, self._names)
        path = self._site.path("occupancy_grid", f"{name or 'map'}.yaml")
        if name in grids:
            if not self._is_due("map", path):
                return None
            self._load_map(server, "map_server", path)
            self._site.remember(map=path)
            return f"{server} loaded {path}"
        if self._is_on_another_level("map", path):
            raise LoadError(f"level {self._site.level} has no grid; Nav2 keeps the one of another level")
        if self._changed(path):
            raise LoadError(f"the map no longer has the grid {name or 'map'}; Nav2 keeps the previous one")
        if self._names.grid and grids:
            raise LoadError(f"unknown grid {name}: set FLEETMAP_NAV2_GRID to one of {', '.join(grids)}")
        return None

    def _mask(self, kind: str) -> str | None:
        """Load a filter mask; load an empty one if the map no longer has it."""
        server, name = getattr(self._names, f"{kind}_server"), getattr(self._names, f"{kind}_grid")
        if not server:
            return None
        path = self._site.path("occupancy_grid", f"{name}.yaml")
        service = f"{server}/load_map"
        if (self._site.folder / path).is_file():
            if not self._is_due(kind, path):
                return None
            if f"{kind}_server" not in self._names.required and not self._ros.has_service(service, LOAD_MAP):
                raise SkippedStep(f"service {service} not found; Nav2 does not use the mask {path}")
            self._load_map(server, f"{kind}_server", path)
            self._site.remember(**{kind: path})
            return f"{server} loaded {path}"
        if not self._site.recall().get(kind) and not self._changed(path):
            return None
        if f"{kind}_server" not in self._names.required and not self._ros.has_service(service, LOAD_MAP):
            self._site.remember(**{kind: None})
            raise SkippedStep(f"service {service} not found, and the map no longer has the mask {name}")
        self._load_map(server, f"{kind}_server", str(self._empty_mask()))
        self._site.remember(**{kind: None})
        return f"{server} loaded an empty mask: the map no longer has {path}"

    def _route(self) -> str | None:
        server = self._names.route_server
        if not server:
            return None
        path = self._site.path("nav2_route", "graph.geojson")
        file = self._site.folder / path
        if not file.is_file():
            if self._is_on_another_level("route", path):
                raise LoadError(f"level {self._site.level} has no route graph; Nav2 keeps the one of another level")
            if self._changed(path):
                raise LoadError("the map no longer has a route graph; Nav2 keeps the previous one")
            return None
        saved_state = self._site.recall()
        blocked, remembered = blocked_edges(file), set(saved_state.get("closed_edges") or ())
        is_due = self._is_due("route", path)
        if not is_due and blocked == remembered:
            return None
        done = []
        if blocked and (is_due or blocked - remembered):  # before the graph, so that no route uses a closed edge
            self._adjust(blocked, set())
            self._site.remember(closed_edges=sorted(blocked | remembered))
            done.append(f"{len(blocked)} edges closed")
        if is_due:
            answer = self._call(
                f"{server}/set_route_graph", SET_ROUTE_GRAPH, {"graph_filepath": str(file)}, "route_server"
            )
            if answer.get("success") is not True:
                raise LoadError(f"{server}/set_route_graph rejected {path}: check the log of the route server")
            self._site.remember(route=path)
            done.append(f"{server} loaded {path}")
        if opened := remembered - blocked:
            self._adjust(set(), opened)
            self._site.remember(closed_edges=sorted(blocked))
            done.append(f"{len(opened)} edges opened again")
        return ", ".join(done)

    def _adjust(self, closed: set[int], opened: set[int]) -> None:
        """Close and open edges with DynamicEdges. Raises LoadError."""
        service = self._names.dynamic_edges or f"{self._names.route_server}/DynamicEdgesScorer/adjust_edges"
        if beyond := [edge for edge in closed | opened if not 0 <= edge <= MAX_EDGE_ID]:
            raise LoadError(f"DynamicEdges cannot close edge {beyond[0]}: ids must be at most {MAX_EDGE_ID}")
        if not self._ros.has_service(service, DYNAMIC_EDGES):
            if not closed:
                return  # without the scorer the route server has no closed edges
            raise LoadError(
                f"service {service} not found, and the graph has {len(closed)} closed edges: add DynamicEdgesScorer to "
                "the route server's edge_cost_functions, or request nav2_route without closures=mark"
            )
        request = {"closed_edges": sorted(closed), "opened_edges": sorted(opened), "adjust_edges": []}
        if self._ros.call(service, DYNAMIC_EDGES, request).get("success") is not True:
            raise LoadError(f"{service} rejected the request to close or open edges")

    def _is_on_another_level(self, kind: str, path: str) -> bool:
        """Whether Nav2 has loaded a file of another level."""
        saved_state = self._site.recall().get(kind)
        return bool(saved_state) and str(saved_state).rpartition("/")[0] != path.rpartition("/")[0]

    def _changed(self, path: str) -> bool:
        """Whether a file or its image is listed as changed."""
        stem = path.rpartition(".")[0]
        return self._site.changed is not None and self._site.has_changed(path, f"{stem}.pgm", f"{stem}.png")

    def _is_due(self, kind: str, path: str) -> bool:
        """Whether a file has changed, or another one is loaded."""
        saved_state = self._site.recall()
        return self._site.changed is None or self._changed(path) or (kind in saved_state and saved_state[kind] != path)

    def _load_map(self, server: str, role: str, path: str) -> None:
        url = str(self._site.folder / path)  # an absolute path is accepted, file:// is not
        result = self._call(f"{server}/load_map", LOAD_MAP, {"map_url": url}, role).get("result")
        if result != 0:
            reason = RESULTS.get(result, "no result") if isinstance(result, int) else "no result"
            raise LoadError(f"{server}/load_map rejected {path}: {reason} (result={result})")

    def _call(self, service: str, type: str, request: Mapping[str, Any], role: str) -> Mapping[str, Any]:
        if not self._ros.has_service(service, type):
            variable = f"FLEETMAP_NAV2_{role.upper()}"
            raise LoadError(f"service {service} not found: start Nav2, or set {variable} (empty: do not load)")
        return self._ros.call(service, type, request)

    def _empty_mask(self) -> Path:
        """Write a mask of one free cell, which restricts nothing, and return its path."""
        self._site.memory.mkdir(exist_ok=True)
        (self._site.memory / "empty.pgm").write_bytes(b"P5\n1 1\n255\n\xfe")
        path = self._site.memory / "empty.yaml"
        path.write_text(
            "image: empty.pgm\nmode: trinary\nresolution: 0.01\norigin: [0.0, 0.0, 0.0]\nnegate: 0\n"
            "occupied_thresh: 0.65\nfree_thresh: 0.25\n"
        )
        return path.resolve()


def grid_names(site: Site) -> list[str]:
    """Return the names of the level's grids."""
    folder = site.folder / site.path("occupancy_grid", "")
    return sorted(p.stem for p in folder.glob("*.yaml") if not p.stem.endswith("_filter_info"))


def map_grid(grids: Sequence[str], names: Names) -> str | None:
    """Return the name of the grid for the map server; None if there is none. Raises LoadError if it is ambiguous."""
    if names.grid:
        return names.grid
    if "map" in grids:
        return "map"
    maps = [g for g in grids if g not in ("nogo", names.keepout_grid, names.speed_grid)]
    if len(maps) > 1:
        raise LoadError(f"several grids ({', '.join(maps)}): choose one with FLEETMAP_NAV2_GRID (node parameter: grid)")
    return maps[0] if maps else None


def blocked_edges(path: Path) -> set[int]:
    """Return the ids of route graph edges with ``blocked`` in their metadata. Raises LoadError."""
    try:
        features = json.loads(path.read_bytes())["features"]
        edges = [f["properties"] for f in features if "startid" in f["properties"]]
        return {int(e["id"]) for e in edges if (e.get("metadata") or {}).get("blocked") is True}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise LoadError(f"{path} is not a route graph: {error}") from None


# --- topological_navigation ---


@dataclass(frozen=True)
class Network:
    """Identity of a network: name, point set, node names and edge ids."""

    name: str
    pointset: str
    nodes: frozenset[str]
    edges: frozenset[str]

    def difference(self, other: Network) -> str | None:
        """Describe the first difference of another network from this one; None if they are equal."""
        for word, ours, theirs in (("name", self.name, other.name), ("pointset", self.pointset, other.pointset)):
            if ours != theirs:
                return f"its {word} is {theirs[:80]!r}, not {ours[:80]!r}"
        for word, own_names, other_names in (("nodes", self.nodes, other.nodes), ("edges", self.edges, other.edges)):
            if own_names != other_names:
                one = sorted(own_names ^ other_names)[0]
                lack = "lacks" if one in own_names else "still has"
                return f"it has {len(other_names)} {word}, not {len(own_names)}; for example it {lack} {one[:80]!r}"
        return None


class TopologicalMap:
    """topological_navigation's map manager."""

    def __init__(self, ros: Ros, site: Site, names: Names) -> None:
        self._ros, self._site, self._names = ros, site, names

    def load(self, report: Report) -> bool:
        """Switch to a changed network and check that it is published. Return whether it succeeded."""
        steps = Steps(report)
        return steps.run("topological map", self._switch)

    def _file(self) -> str:
        folder = self._site.folder / self._site.path("tmap2", "")
        names = sorted(p.name for p in folder.glob("*.yaml"))
        if not names:
            raise LoadError(
                f"no tmap2 file in {folder.parent if self._site.prefix else folder}: add tmap2 to --formats"
            )
        return self._site.path("tmap2", "network.tmap2.yaml" if "network.tmap2.yaml" in names else names[0])

    def _switch(self) -> str | None:
        if not self._names.manager:
            return None
        path = self._file()
        saved_state = self._site.recall()
        elsewhere = "topological_map" in saved_state and saved_state["topological_map"] != path
        if not self._site.has_changed(path) and not elsewhere:
            return None
        file = self._site.folder / path
        network = read_network(file)
        service = f"{self._names.manager}/switch_topological_map"
        if not self._ros.has_service(service, WRITE_TOPOLOGICAL_MAP):
            raise LoadError(f"service {service} not found: start the map manager, or set FLEETMAP_TOPOLOGICAL_MANAGER")
        problem = None
        # Some managers prefix the name with their own folder: enough ``..`` reach the same file from any folder.
        for name in (str(file), "../" * 40 + str(file).lstrip("/")):
            answer = self._ros.call(service, WRITE_TOPOLOGICAL_MAP, {"filename": name, "no_alias": False})
            if answer.get("success") is not True:
                raise LoadError(f"{service} rejected {path}: check the log of the map manager")
            problem = network.difference(parse_network(self._ros.last_text(self._names.topic)))
            if problem is None:
                self._site.remember(topological_map=path)
                return f"{self._names.manager} publishes {path}: {len(network.nodes)} nodes, {len(network.edges)} edges"
        raise LoadError(f"{service} reported success, but {self._names.topic} does not publish {path}: {problem}")


def parse_network(text: str) -> Network:
    """Parse the network in the manager's JSON. Raises LoadError."""
    try:
        body = json.loads(text)
        nodes = [n["node"] for n in body.get("nodes") or ()]
        return Network(
            str(body.get("name", "")),
            str(body.get("pointset", "")),
            frozenset(str(n["name"]) for n in nodes),
            frozenset(str(e["edge_id"]) for n in nodes for e in n.get("edges") or ()),
        )
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise LoadError(f"the map manager does not publish a tmap2: {type(error).__name__}: {error}") from None


def read_network(path: Path) -> Network:
    """Read the network of a tmap2 file as the server writes it: one scalar per line, indented by two spaces per depth.

    Raises LoadError.
    """
    name, pointset, part = "", "", ""
    nodes: set[str] = set()
    edges: set[str] = set()
    with path.open(encoding="utf-8") as stream:
        for line in stream:
            indent = len(line) - len(line.lstrip(" -"))
            key, colon, value = line.lstrip(" -").rstrip("\n").partition(":")
            if not colon:
                continue
            value = value.strip()
            if indent == 2 and key in ("meta", "node"):
                part = key
            elif indent == 0:
                part = ""
                name, pointset = (
                    _scalar(value) if key == "name" else name,
                    _scalar(value) if key == "pointset" else pointset,
                )
            elif part == "node" and indent == 4 and key == "name":
                nodes.add(_scalar(value))
            elif part == "node" and indent == 6 and key == "edge_id":
                edges.add(_scalar(value))
    if not nodes:
        raise LoadError(f"{path} has no nodes, or was not written by a Fleet Map Server")
    return Network(name, pointset, frozenset(nodes), frozenset(edges))


def _scalar(text: str) -> str:
    """Parse a YAML scalar in one line."""
    if len(text) >= 2 and text[0] == text[-1] == "'":
        return text[1:-1].replace("''", "'")
    if len(text) >= 2 and text[0] == text[-1] == '"':
        try:
            return str(json.loads(re.sub(r"\\x([0-9a-fA-F]{2})", r"\\u00\1", text)))
        except ValueError:
            return text[1:-1]
    return text


# --- the command ros2 ---


class Ros2Command:
    """Service calls with the command ``ros2``; time limits per call and for all calls."""

    def __init__(
        self,
        call_seconds: float = CALL_SECONDS,
        total_seconds: float = TOTAL_SECONDS,
        wait_seconds: float = WAIT_SECONDS,
    ) -> None:
        self._call_seconds, self._wait_seconds = call_seconds, wait_seconds
        self._end = time.monotonic() + total_seconds
        self._services: dict[str, bool] = {}

    @classmethod
    def from_environment(cls, variables: Mapping[str, str]) -> Ros2Command:
        """Read FLEETMAP_ROS_SECONDS, FLEETMAP_HOOK_SECONDS and FLEETMAP_ROS_WAIT_SECONDS. Raises LoadError."""
        return cls(
            _seconds(variables, "FLEETMAP_ROS_SECONDS", CALL_SECONDS),
            _seconds(variables, "FLEETMAP_HOOK_SECONDS", TOTAL_SECONDS),
            _seconds(variables, "FLEETMAP_ROS_WAIT_SECONDS", WAIT_SECONDS),
        )

    def has_service(self, name: str, type: str) -> bool:
        """Whether ``ros2 service type`` finds the service within FLEETMAP_ROS_WAIT_SECONDS."""
        del type  # a wrong type makes the call fail
        if name not in self._services:
            end = time.monotonic() + self._wait_seconds
            while (status := self._run(["ros2", "service", "type", name])[0]) != 0 and time.monotonic() < end:
                time.sleep(min(0.5, self._wait_seconds))
            self._services[name] = status == 0
        return self._services[name]

    def call(self, name: str, type: str, request: Mapping[str, Any]) -> Mapping[str, Any]:
        """Run ``ros2 service call`` and return ``result`` or ``success`` of the response. Raises LoadError."""
        status, text = self._run(["ros2", "service", "call", name, type, flow_yaml(request)])
        result, success = re.search(r"result=(\d+)", text), re.search(r"success=(True|False)", text)
        if status != 0 or not (result or success):
            error = re.search(r"[^\n]*[Ee]rror[^\n]*", text)
            detail = error[0].strip()[:300] if error else text.strip()[-300:]
            raise LoadError(f"no response from {name} (ros2 exited with status {status}): {detail}")
        answer: dict[str, Any] = {"result": int(result[1])} if result else {}
        return answer | ({"success": success[1] == "True"} if success else {})

    def last_text(self, topic: str) -> str:
        """Run ``ros2 topic echo`` until it pauses; return the last message. Raises LoadError."""
        arguments = ["ros2", "topic", "echo", "--full-length", "--field", "data"]
        arguments += ["--qos-durability", "transient_local", "--qos-reliability", "reliable"]
        end = time.monotonic() + self._limit()
        process, chunks = _start([*arguments, topic, "std_msgs/msg/String"])
        text, rest = "", ""
        try:
            while (left := end - time.monotonic()) > 0:
                chunk = chunks.get(timeout=min(SETTLE_SECONDS, left) if text else left)
                if chunk is None:
                    break
                *lines, rest = (rest + chunk.decode(errors="replace")).split("\n")
                text = next((m for line in reversed(lines) if (m := _message(line)) is not None), text)
        except queue.Empty:
            pass
        finally:
            process.kill()
            process.wait()
        if not text:
            raise LoadError(
                f"no message on {topic}: start the map manager, or set FLEETMAP_TOPOLOGICAL_TOPIC to its topic"
            )
        return text

    def _limit(self) -> float:
        left = self._end - time.monotonic()
        if left <= 0:
            raise LoadError("no time left: all calls together exceeded FLEETMAP_HOOK_SECONDS")
        return min(self._call_seconds, left)

    def _run(self, arguments: list[str]) -> tuple[int, str]:
        """Run a command. Return its exit status, and start and end of its output. Raises LoadError after the limit."""
        limit = self._limit()
        end = time.monotonic() + limit
        process, chunks = _start(arguments)
        head, tail = b"", bytearray()
        try:
            while (chunk := chunks.get(timeout=max(0.0, end - time.monotonic()))) is not None:
                room = MAX_OUTPUT_BYTES - len(head)
                head += chunk[:room]
                tail += chunk[room:]
                del tail[:-MAX_OUTPUT_BYTES]
            status = process.wait(max(0.1, end - time.monotonic()))
        except (queue.Empty, subprocess.TimeoutExpired):
            process.kill()
            process.wait()
            raise LoadError(
                f"no response from {arguments[3]} within {limit:g} seconds (FLEETMAP_ROS_SECONDS)"
            ) from None
        return status, (head + bytes(tail)).decode(errors="replace")


def _seconds(variables: Mapping[str, str], name: str, default: float) -> float:
    try:
        return float(variables.get(name) or default)
    except ValueError:
        raise LoadError(f"{name} must be a number of seconds, got {variables[name][:80]!r}") from None


def _start(arguments: list[str]) -> tuple[subprocess.Popen[bytes], queue.Queue[bytes | None]]:
    """Start a command. Return its process and a queue of its output, with None at the end. Raises LoadError."""
    try:
        process = subprocess.Popen(  # noqa: S603  arguments are a list, no shell reads them
            arguments, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        )
    except OSError as error:
        raise LoadError(f"could not run ros2 ({error.strerror}): source the setup.bash of ROS 2 first") from None
    chunks: queue.Queue[bytes | None] = queue.Queue(MAX_CHUNKS)
    # A separate thread: children of a killed command may keep the pipe open.
    threading.Thread(target=_read, args=(process.stdout, chunks), daemon=True).start()
    return process, chunks


def _read(stream: IO[bytes], chunks: queue.Queue[bytes | None]) -> None:
    with contextlib.suppress(OSError), stream:
        while chunk := os.read(stream.fileno(), 1 << 16):
            chunks.put(chunk)
    chunks.put(None)


def flow_yaml(value: Any) -> str:
    """Format a request for ``ros2 service call``: YAML in one line."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{name}: {flow_yaml(member)}" for name, member in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(flow_yaml, value)) + "]"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return "'" + value.replace("'", "''") + "'"
    return str(value)


def _message(line: str) -> str | None:
    """Parse one line of ``ros2 topic echo``; None for a separator or a warning."""
    text = line.strip()
    if text.startswith("data: "):
        text = _scalar(text.removeprefix("data: "))
    return text if text.startswith(("{", "[")) or text == "null" else None


# --- the hooks ---


def _print(line: str) -> None:
    print(line, flush=True)


def reporter(status_file: str | None, write: Callable[[str], object] = _print) -> Report:
    """Return a function that prints each step (with ``write``) and appends it to ``status_file``."""

    def report(step: str, result: str, detail: str) -> None:
        write(f"{step}: {result}: {detail}")
        if status_file:
            line = json.dumps({"step": step, "result": result, "detail": detail})
            try:
                with Path(status_file).open("a") as stream:
                    stream.write(line + "\n")
            except OSError as error:
                write(f"could not write {status_file}: {error.strerror}")

    return report


LOADERS: Mapping[str, type[Nav2] | type[TopologicalMap]] = {"nav2": Nav2, "topological": TopologicalMap}


def main(arguments: list[str], variables: Mapping[str, str]) -> int:
    """Run one hook. Return its exit status."""
    report = reporter(variables.get("FLEETMAP_HOOK_STATUS"))
    try:
        site, ros = Site.from_environment(variables), Ros2Command.from_environment(variables)
        loader = LOADERS[arguments[0]](ros, site, Names.from_environment(variables))
        return 0 if loader.load(report) else 1
    except KeyError as error:
        report(
            "start",
            "failed",
            f"missing {error.args[0]}: run this hook from the agent, with `--on-change nav2` or `topological`",
        )
    except (LoadError, OSError) as error:
        report("start", "failed", str(error))
    return 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:], os.environ))
