"""Content of ROS 2 topics: the maps of the HTTP interface, read back from the files that robots would load."""

from __future__ import annotations

import json
from collections.abc import Mapping

from app import formats
from app.api.http.dependencies import Services
from app.convert import site
from app.errors import CannotConvert, NotFound
from app.events import cdr
from app.events.ros2 import TopicContent
from app.events.ros_names import EnvironmentSelector, namespace_of
from app.formats import ReadContext
from app.model import masks
from app.model.frame import GROUND
from app.model.grid import OccupancyGrid
from app.model.layers import MAP
from app.store.values import LATEST, Version
from app.syntax import yaml

PRODUCTION = "production"
PAGE = 1000


def channel_versions(services: Services, chosen: tuple[EnvironmentSelector, ...], channel: str) -> dict[str, Version]:
    """Resolve the selected environments, each to the version and closures of the channel.

    channel: empty for production if it exists, else latest. Environments whose channel has no version are skipped.
    """
    names = [entry.pattern for entry in chosen if entry.is_single]
    if any(not entry.is_single for entry in chosen):
        names += [name for name in _all_names(services) if namespace_of(name, chosen) is not None]
    out = {}
    for name in dict.fromkeys(names):
        for ref in [channel] if channel else [PRODUCTION, LATEST]:
            try:
                out[name], _ = services.store.channels.target(name, ref)
                break
            except NotFound:
                continue
    return out


def _all_names(services: Services) -> list[str]:
    names: list[str] = []
    cursor: str | None = None
    while True:
        page, cursor = services.store.environments.page(limit=PAGE, cursor=cursor)
        names += [environment.name for environment in page]
        if cursor is None:
            return names


def topic_content(services: Services, derive: bool, version: Version) -> TopicContent:
    """Load the grid of each level, and the network. derive: also derive content that is not stored."""
    absent: list[str] = []
    grids: dict[str, cdr.Grid] = {}
    for values in _grids(version, derive, absent):
        try:
            grids[values["level"]] = _grid(services, version, values, derive)
        except (CannotConvert, NotFound) as error:
            absent.append(f"no grid of the level {values['level']}: {error.detail}")
    order = [GROUND, *(level.name for level in version.levels)]  # levels are sorted by elevation
    lowest = next((name for name in order if name in grids), None)
    network = None
    if derive or any(e.key.layer == "topology" and e.count for e in version.parts):
        try:
            network = _network(services, version, derive)
        except (CannotConvert, NotFound) as error:
            absent.append(f"no network: {error.detail}")
    by_level = {None if level == lowest else level: grid for level, grid in sorted(grids.items())}
    return TopicContent(by_level, network, tuple(absent))


def _grids(version: Version, derive: bool, absent: list[str]) -> list[dict[str, str]]:
    """Select options of ``occupancy_grid``: on each level the grid ``map``, else the only one that is no mask.

    absent: gets the levels with several others.
    """
    stored = [e.key for e in version.parts if e.key.layer == "occupancy" and e.count]
    if derive and not stored:
        return [{"grid": MAP, "level": level.name} for level in sorted(version.levels, key=lambda one: one.name)]
    parts = formats.get_format("occupancy_grid").selection.parts
    assert parts is not None
    names: dict[str, list[str]] = {}
    for key in stored:
        if key.name not in masks.MASKS:
            names.setdefault(key.level, []).append(key.name)
    chosen = {level: site.default_name(parts, of_level) for level, of_level in sorted(names.items())}
    absent += [
        f"no grid of the level {level}: name one {MAP}; its grids: {', '.join(names[level])[:500]}"
        for level, name in chosen.items()
        if name is None
    ]
    return [{"grid": name, "level": level} for level, name in chosen.items() if name is not None]


def _grid(services: Services, version: Version, values: Mapping[str, str], derive: bool) -> cdr.Grid:
    cached_map = services.maps.get_blocking(version, "occupancy_grid", values, derive=derive)
    files = {file.name: file.read() for file in cached_map.files}
    fmt = formats.get_format("occupancy_grid")
    assert fmt.read is not None
    read = fmt.read(files, ReadContext(services.options.limits, main=cached_map.files[0].name))
    grid = next(iter(read.parts.values()))
    assert isinstance(grid, OccupancyGrid)
    # Unknown is 255, which is -1 as a signed byte.
    return cdr.Grid(grid.width, grid.height, grid.resolution, grid.origin, grid.cells.tobytes())


def _network(services: Services, version: Version, derive: bool) -> str:
    """Return the tmap2 as JSON: topological_navigation publishes it so, and YAML parsers read JSON."""
    cached_map = services.maps.get_blocking(version, "tmap2", {}, derive=derive)
    document = yaml.load(cached_map.files[0].read(), services.options.limits)
    return json.dumps(document, ensure_ascii=False)
