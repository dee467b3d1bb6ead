"""Nav2's costmap filter masks: grids of keepout zones or speed limits, and the meaning of their cells.

A mask is an occupancy grid of its own; the value in filter space is ``base + multiplier * cell`` of ``type`` 0 (keepout
and preferred lanes, 0…100), 1 (speed limit in % of the robot's), 2 (speed limit in m/s), 3 (binary) or 4 (zone
parameters). In a speed mask cell 0 is no limit, and unknown an error. The node ``costmap_filter_info_server`` gets
these values from a YAML file of ROS parameters; the mask's own map server may be in the same file. Source:
docs.nav2.org, Costmap Filter Info Server; nav2_costmap_2d, costmap_filters.

A grid stores this file under ``properties.costmap_filter`` as ``{params: …}``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

NAME = "costmap_filter"
NODE = "costmap_filter_info_server"
PARAMETERS = "ros__parameters"
KEEPOUT, SPEED_PERCENT, SPEED_METRES = 0, 1, 2
TYPES = range(5)
MASKS = frozenset({"keepout", "speed", "nogo", "preferred"})
"""Names of grids that mark where robots should drive, not obstacles."""

KEEPOUT_MASKS = frozenset({"keepout", "nogo"})
"""Those of them that mark where robots must not drive."""

KEEPOUT_NAME = re.compile(r"keep_?out|no_?go", re.IGNORECASE)
"""Part of the name of such a mask without parameters of its own, such as ``depot_keepout``."""

INFO_SUFFIX = "_filter_info"
"""End of a mask's name in the name of its parameter file; no grid may have such a name itself."""

MAX_NAMESPACES = 4
"""Maximum depth of namespaces around a node."""


@dataclass(frozen=True, slots=True)
class FilterInfo:
    """Meaning of a mask's cells: value = base + multiplier * cell."""

    type: int
    base: float
    multiplier: float

    def as_dict(self) -> dict[str, Any]:
        """Return Nav2's parameters."""
        return {"type": self.type, "base": self.base, "multiplier": self.multiplier}


def is_keepout(name: str, properties: Mapping[str, Any]) -> bool:
    """Return whether a grid with this name and these properties marks where robots must not drive."""
    if name in MASKS:
        return name in KEEPOUT_MASKS
    stored = properties.get(NAME)
    kinds = [server.get("type") for server in servers(stored.get("params") if isinstance(stored, Mapping) else None)]
    return KEEPOUT in kinds if kinds else KEEPOUT_NAME.search(name) is not None


def params(name: str, info: FilterInfo) -> dict[str, Any]:
    """Return default parameters of a mask's filter info server and map server. name: of the grid."""
    word = re.sub(r"[^A-Za-z0-9_]", "_", name)
    topic = f"/{word}_filter_mask"
    filter_parameters = {**info.as_dict(), "filter_info_topic": f"/{word}_costmap_filter_info", "mask_topic": topic}
    server = {"frame_id": "map", "topic_name": topic, "yaml_filename": f"{name}.yaml"}
    return {NODE: {PARAMETERS: filter_parameters}, "filter_mask_server": {PARAMETERS: server}}


def is_filter_info(name: str, node: Any) -> bool:
    """Return whether this entry of a parameter file is a filter info server's."""
    parameters = node.get(PARAMETERS) if isinstance(node, Mapping) else None
    return isinstance(parameters, Mapping) and ("mask_topic" in parameters or NODE in name)


def servers(document: Any, depth: int = 0) -> Iterator[Mapping[str, Any]]:
    """Iterate over the parameters of each filter info server in a parameter file, in order."""
    if not isinstance(document, Mapping) or depth > MAX_NAMESPACES:
        return
    for name, node in document.items():
        if is_filter_info(name, node):
            yield node[PARAMETERS]
        elif isinstance(node, Mapping) and PARAMETERS not in node:
            yield from servers(node, depth + 1)
