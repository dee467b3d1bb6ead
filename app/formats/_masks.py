"""Parameter files of costmap filter masks beside their grids: see ``app.model.masks``."""

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

_BY_NAME = (
    (re.compile(r"keep_?out|no_?go|preferred", re.IGNORECASE), FilterInfo(KEEPOUT, 0.0, 1.0)),
    (re.compile(r"speed", re.IGNORECASE), FilterInfo(SPEED_PERCENT, 100.0, -1.0)),
)
"""Default filter info of masks without parameters: by name pattern, with the values of Nav2's examples."""


def companions(main: str, names: Sequence[str]) -> list[str]:
    """Return a mask's parameter files: ``<mask>_filter_info.yaml``, ``<mask>_params.yaml``, also without ``_mask``."""
    folder, _, base = main.rpartition("/")
    stem = base.rpartition(".")[0]
    stems = dict.fromkeys([stem, stem.removesuffix("_mask")])
    ends = [s + more + end for more in (masks.INFO_SUFFIX, "_params") for s in stems for end in (".yaml", ".yml")]
    name_set = set(names)
    return [n for n in (f"{folder}/{end}".lstrip("/") for end in ends) if n in name_set and n != main]


def read(file: str, data: bytes, context: ReadContext) -> dict[str, Any]:
    """Read a grid's properties from a parameter file; empty, with a warning, if it has no mask parameters.

    Raises UnreadableFile if a parameter has the wrong type.
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
        context.warn(f"the file has no parameters of a {masks.NODE}; it is stored as a source only", file=file)
        return {}
    if len(servers) > 1:
        context.warn(
            f"the file has parameters of {len(servers)} filter info servers; only the first one is used", file=file
        )
    faults = list(_invalid_keys(servers[0]))
    if faults:
        places = [Problem(reason, file, where=location) for location, reason in faults]
        raise UnreadableFile(f"{file}: " + "; ".join(reason for _, reason in faults), places)
    return {masks.NAME: {"params": document}}


def _invalid_keys(parameters: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield (key, error) for each invalid parameter."""
    kind = parameters.get("type", KEEPOUT)
    if isinstance(kind, bool) or not isinstance(kind, int) or kind not in masks.TYPES:
        yield "type", f"type must be an integer from 0 to {masks.TYPES[-1]}, got {str(kind)[:40]!r}"
    for key in ("base", "multiplier"):
        value = parameters.get(key, 0.0)
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            yield key, f"{key} must be a number, got {str(value)[:40]!r}"
    for key in ("mask_topic", "filter_info_topic"):
        if not isinstance(parameters.get(key, ""), str):
            yield key, f"{key} must be a string, got {str(parameters[key])[:40]!r}"


def _kept_parameters(grid: OccupancyGrid) -> dict[str, Any] | None:
    """Return the parameter file that a grid stores, with base and multiplier as floats (ROS rejects integers there)."""
    source_properties = grid.properties.get(masks.NAME)
    document = source_properties.get("params") if isinstance(source_properties, Mapping) else None
    server = next(masks.servers(document), None)
    if server is None or list(_invalid_keys(server)):  # not valid after an edit: use the defaults
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
    """Write ``<grid>_filter_info.yaml`` for a mask; nothing for other grids. stem: of the grid's files."""
    file = f"{stem}{masks.INFO_SUFFIX}.yaml"
    document = _kept_parameters(grid)
    if document is None:
        info = next((info for pattern, info in _BY_NAME if pattern.search(stem)), None)
        if info is None:
            return {}
        document = masks.params(stem, info)
        why = "no source specifies it: values of Nav2's examples"
        context.fill("filter info: type, base, multiplier", info.as_dict(), why)
    kind = next(masks.servers(document)).get("type", KEEPOUT)
    if kind in (SPEED_PERCENT, SPEED_METRES) and bool((grid.cells == UNKNOWN).any()):
        context.warn("the speed mask has unknown cells; Nav2 treats them as errors", file=f"{stem}.yaml")
    return {file: yaml.mapping(document, 0).encode()}
