"""The parameter files of costmap filter masks beside their grids: see ``app.model.masks``."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from app.errors import Problem, UnreadableFile
from app.formats import ReadContext, WriteContext
from app.model import masks
from app.model.grid import UNKNOWN, OccupancyGrid
from app.model.masks import KEEPOUT, SPEED_METRES, SPEED_PERCENT, FilterInfo
from app.syntax import yaml

SUFFIX = "_filter_info"

_BY_NAME = (
    (re.compile(r"keep_?out|no_?go|preferred", re.IGNORECASE), FilterInfo(KEEPOUT, 0.0, 1.0)),
    (re.compile(r"speed", re.IGNORECASE), FilterInfo(SPEED_PERCENT, 100.0, -1.0)),
)
"""What a mask means that does not say so: by its name, and as Nav2's own examples have it."""


def companions(main: str, names: Sequence[str]) -> list[str]:
    """The parameter files of a mask: ``<mask>_filter_info.yaml``, ``<mask>_params.yaml``, also without ``_mask``."""
    folder, _, base = main.rpartition("/")
    stem = base.rpartition(".")[0]
    stems = dict.fromkeys([stem, stem.removesuffix("_mask")])
    ends = [s + more + end for more in (SUFFIX, "_params") for s in stems for end in (".yaml", ".yml")]
    name_set = set(names)
    return [n for n in (f"{folder}/{end}".lstrip("/") for end in ends) if n in name_set and n != main]


def read(file: str, data: bytes, context: ReadContext) -> dict[str, Any]:
    """The properties of a grid that a parameter file gives it; empty, with a warning, where it says nothing of masks.

    Raises UnreadableFile where the parameters are of the wrong type.
    """
    try:
        document = yaml.load(data, context.limits)
    except UnreadableFile as error:
        raise UnreadableFile(
            f"{file}: {error.detail}",
            [Problem(p.problem, file, p.line, p.where) for p in error.problems] or [Problem(error.detail, file)],
        ) from error
    servers = list(masks.servers(document))
    if not servers:
        context.warn(f"it has no parameters of a {masks.NODE}: it is kept as a source only", file=file)
        return {}
    if len(servers) > 1:
        context.warn(f"it has parameters of {len(servers)} filter info servers: the first one counts", file=file)
    faults = list(_invalid_keys(servers[0]))
    if faults:
        places = [Problem(reason, file, where=location) for location, reason in faults]
        raise UnreadableFile(f"{file}: " + "; ".join(reason for _, reason in faults), places)
    return {masks.NAME: {"params": document}}


def _invalid_keys(parameters: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """(key, what is wrong with it)."""
    kind = parameters.get("type", KEEPOUT)
    if isinstance(kind, bool) or not isinstance(kind, int) or kind not in masks.TYPES:
        yield "type", f"type must be a whole number from 0 to {masks.TYPES[-1]}, got {str(kind)[:40]!r}"
    for key in ("base", "multiplier"):
        value = parameters.get(key, 0.0)
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            yield key, f"{key} must be a number, got {str(value)[:40]!r}"
    for key in ("mask_topic", "filter_info_topic"):
        if not isinstance(parameters.get(key, ""), str):
            yield key, f"{key} must be a text, got {str(parameters[key])[:40]!r}"


def _kept_parameters(grid: OccupancyGrid) -> dict[str, Any] | None:
    """The parameter file that a grid keeps, with base and multiplier as floats (ROS refuses whole numbers there)."""
    source_properties = grid.properties.get(masks.NAME)
    document = source_properties.get("params") if isinstance(source_properties, Mapping) else None
    server = next(masks.servers(document), None)
    if server is None or list(_invalid_keys(server)):  # whoever edited it meant something else
        return None
    normalised: dict[str, Any] = _to_floats(document, 0)
    return normalised


def _to_floats(value: Any, depth: int) -> Any:
    if not isinstance(value, Mapping) or depth > masks.MAX_NAMESPACES:
        return value
    out: dict[str, Any] = {}
    for name, node in value.items():
        if masks.is_filter_info(name, node):
            parameters = node[masks.PARAMETERS]
            floats = {k: float(v) for k, v in parameters.items() if k in ("base", "multiplier") and isinstance(v, int)}
            out[name] = {**node, masks.PARAMETERS: {**parameters, **floats}}
        else:
            out[name] = _to_floats(node, depth + 1)
    return out


def write(grid: OccupancyGrid, stem: str, context: WriteContext) -> dict[str, bytes]:
    """``<grid>_filter_info.yaml`` of a mask; nothing of a grid that is none. stem: of the grid's files."""
    file = f"{stem}{SUFFIX}.yaml"
    document = _kept_parameters(grid)
    if document is None:
        info = next((info for pattern, info in _BY_NAME if pattern.search(stem)), None)
        if info is None:
            return {}
        document = masks.params(stem, info)
        why = "no source says them: those of Nav2's examples"
        context.fill("filter info: type, base, multiplier", info.as_dict(), why)
    kind = next(masks.servers(document)).get("type", KEEPOUT)
    if kind in (SPEED_PERCENT, SPEED_METRES) and bool((grid.cells == UNKNOWN).any()):
        context.warn("a speed mask with unknown cells: Nav2 takes them for errors", file=f"{stem}.yaml")
    return {file: yaml.mapping(document, 0).encode()}
