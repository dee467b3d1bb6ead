"""Writing edges as lanes of a building; opposite edges become one two-way lane."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from app.formats._network import get_source_properties
from app.formats.rmf import common
from app.formats.rmf.building.vocabulary import NAME
from app.formats.rmf.common import NAV_GRAPH, Flow, mapping, parameter_value
from app.model.features import Features, Properties

LANE_TEMPLATE: Mapping[str, Any] = {"graph_idx": [2, 0], "orientation": [1, ""], "speed_limit": [3, 0.0]}


def sort_by_lane(parts: Sequence[Features]) -> Iterable[tuple[str, Properties]]:
    """Iterate over (id, properties) of all items but nodes: by source lane and direction, then by id."""

    def each() -> Iterator[tuple[str, Properties]]:
        for part in parts:
            for i, p in zip(part.ids, part.properties, strict=True):
                if p.get("kind") != "node":
                    yield i, p

    def key(item: tuple[str, Properties]) -> tuple[bool, int, bool, int, str]:
        i, p = item
        source_members = get_source_properties(p, NAME)
        was = source_members.get("index")
        has_index = isinstance(was, int)
        return (not has_index, was if isinstance(was, int) else 0, source_members.get("reverse") is True, len(i), i)

    # Items in the order of their file need no sorting in memory.
    return each() if all(a <= b for a, b in pairwise(map(key, each()))) else sorted(each(), key=key)


def lane_parameters(p: Properties, options: common.WriteOptions) -> dict[str, Any]:
    """Build the parameters of a lane that comes from another format."""
    out = {key: list(value) for key, value in LANE_TEMPLATE.items()}
    if NAV_GRAPH not in p:
        out["graph_idx"] = [2, options.graph]
    graph = get_source_properties(p, NAV_GRAPH)
    graph_parameters = mapping(graph.get("parameters"), "parameters")
    if isinstance(graph.get("graph"), int):
        out["graph_idx"] = [2, graph["graph"]]
    for key, value in graph_parameters.items():
        if key == "orientation_constraint":
            out["orientation"] = [1, value]
        elif key not in ("door_name", "speed_limit", "is_bidirectional", "dock_name", "undock_name"):
            out[key] = common.typed_parameter(value)
    return out


@dataclass(slots=True)
class Lane:
    """Directed edge to be written as a lane.

    was: index of its source lane in the file; reverse: the edge is that lane's reverse direction.
    """

    source: int
    target: int
    was: int | None
    reverse: bool
    limit: float
    parameters: dict[str, Any]
    more: Sequence[Any]
    signature: str
    both: bool = False

    @classmethod
    def from_edge(cls, limit: float, source_members: Mapping[str, Any], source: int, target: int, flow: Flow) -> Lane:
        """Create a lane from an edge with this speed limit in m/s (0: none)."""
        was = source_members.get("index") if isinstance(source_members.get("index"), int) else None
        reverse = source_members.get("reverse") is True
        parameters = mapping(source_members.get("parameters"), "parameters")
        speed = parameter_value(parameters, "speed_limit", 0.0)
        if (speed if isinstance(speed, (int, float)) and speed > 0 else 0.0) != limit:
            parameters = {**parameters, "speed_limit": [3, limit]}
        signature = str(was)
        if was is None:
            signature = flow({k: v for k, v in parameters.items() if k != "orientation"})
        more = source_members.get("more")
        return cls(source, target, was, reverse, limit, parameters, more if isinstance(more, list) else (), signature)

    def _orientation(self) -> Any:
        return str(parameter_value(self.parameters, "orientation", ""))

    def parameters_key(self) -> Any:
        """Return a key that is equal for edges that can form one lane."""
        direction = self._orientation() if self.was is None else self.reverse
        return (self.source, self.target, self.limit, self.signature, direction)

    def partner(self) -> Any:
        """Return the ``parameters_key`` of the opposite edge that would form a two-way lane with this one."""
        direction = common.reverse_orientation(self._orientation()) if self.was is None else not self.reverse
        return (self.target, self.source, self.limit, self.signature, direction)

    def row(self, flow: Flow) -> str:
        """Format the lane as a row of the file."""
        parameters = self.parameters
        if self.both or parameter_value(parameters, "bidirectional") is True or self.was is None:
            parameters = {**parameters, "bidirectional": [4, self.both]}
        if self.reverse and "orientation" in parameters:
            parameters = {**parameters, "orientation": [1, common.reverse_orientation(self._orientation())]}
        more = "".join(f", {flow(v)}" for v in self.more)
        return f"[{self.source}, {self.target}, {flow(parameters)}{more}]"
