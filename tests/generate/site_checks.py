"""Checks that every generated site must pass, one function each, for the tests of single sites."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import orjson
import pytest
import shapely

from app import formats, generate
from app.convert.files import write_layers
from app.derive import DerivationNotes
from app.derive.objects_to_occupancy import Parameters, objects_to_occupancy
from app.formats import FileGroup, ReadContext
from app.generate import _reach
from app.model.features import Features
from app.model.grid import FREE, OCCUPIED, OccupancyGrid
from app.model.imagery import GeoImage
from app.model.layers import Layers, Resources
from app.store.values import Provenance
from tests import libsdformat
from tests.api.conftest import Api

CAME = Provenance("generated")


def make(name: str, seed: int = 7, given: Layers | None = None, **values: Any) -> tuple[Layers, DerivationNotes]:
    """A site and its generator's notes."""
    notes = DerivationNotes()
    before = given or Layers()
    new_layers = generate.run(name, seed, values, before, notes)
    return Layers({**before.parts, **new_layers.parts}, new_layers.datum, new_layers.levels), notes


def digest(layers: Layers) -> str:
    """Return a hash of everything generated except the image, whose colours may change."""
    out = hashlib.sha256()
    for key, part in sorted(layers.parts.items()):
        out.update(orjson.dumps([key.layer, key.level, key.name]))
        if isinstance(part, Features):
            out.update(orjson.dumps([part.ids, part.properties, part.document], option=orjson.OPT_SORT_KEYS))
            out.update(b"".join(shapely.to_wkb(part.geometry, byte_order=1)))
        elif isinstance(part, OccupancyGrid):
            out.update(orjson.dumps([part.resolution, part.origin]) + part.cells.tobytes())
        elif isinstance(part, Resources):
            for path, data in sorted(part.files.items()):
                out.update(path.encode() + data)
        else:
            assert isinstance(part, GeoImage)
    return out.hexdigest()


def agrees_with_itself(layers: Layers, radius: float, height: float = 0.2) -> None:
    """Free space in one piece, edges in free space only, the network in one piece, the world's slice the grid."""
    grids = layers.grids()
    assert grids
    for grid in grids.values():
        free = (grid.cells == FREE).astype(np.uint8)
        assert cv2.connectedComponents(free, connectivity=4)[0] == 2, "free space is one piece"
    levels: dict[str, str] = {}
    pairs: list[tuple[str, str]] = []
    for key, part in layers.vector("topology").items():
        lines = [g for g, p in zip(part.geometry, part.properties, strict=True) if p["kind"] == "edge"]
        ends = [(p["source"], p["target"]) for p in part.properties if p["kind"] == "edge"]
        levels |= {i: key.level for i, p in zip(part.ids, part.properties, strict=True) if p["kind"] == "node"}
        pairs += ends
        grid = next(g for k, g in grids.items() if k.level == key.level)
        assert _reach.passable(grid, lines, radius).all(), "no edge leads through an obstacle"
    near = {name: {b for a, b in pairs if a == name} for name in levels}
    seen = set(list(levels)[:1])
    waiting = list(seen)
    while waiting:
        fresh = near[waiting.pop()] - seen
        seen |= fresh
        waiting += fresh
    assert seen == set(levels), "every node can be reached, over all levels"
    world(layers, height)


def world(layers: Layers, height: float) -> None:
    """The world as Gazebo gets it, cut above each level's floor, is the level's grid."""
    files = write_layers(layers, "gazebo", {}, CAME).files
    read = formats.read(FileGroup(formats.get_format("gazebo"), "world.sdf", files), ReadContext())
    fence = {k: p for k, p in layers.parts.items() if k.layer == "location"}
    for key, grid in layers.grids().items():
        cut = Parameters(height=round(layers.elevation(key.level) + height, 3), resolution=grid.resolution)
        (again,) = (
            objects_to_occupancy(Layers({**read.parts, **fence}, layers.datum), cut, DerivationNotes()).grids().values()
        )
        assert again.cells.shape == grid.cells.shape
        ours, theirs = grid.cells == OCCUPIED, again.cells == OCCUPIED
        assert (ours == theirs).mean() >= 0.99
        assert (ours & theirs).sum() >= 0.99 * (ours | theirs).sum(), "and so are its obstacles alone"


def sound_sdf(layers: Layers, folder: Path) -> None:
    """The written world passes libsdformat's own check."""
    if libsdformat.LIBRARY is None:
        pytest.skip("libsdformat is not installed")
    for name, data in write_layers(layers, "gazebo", {}, CAME).files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    status, output = libsdformat.check(folder / "world.sdf")
    assert status == 0, output
    assert "Valid" in output


def serves(layers: Layers) -> dict[str, list[dict[str, Any]]]:
    """Return what each format drops; every format exports the site, and reads its own output."""
    out = {}
    for name, fmt in formats.all_formats().items():
        if fmt.write is None:
            continue
        written_map = write_layers(layers, name, {}, CAME)
        assert written_map.files, name
        errors = [w for w in written_map.report.as_dict()["warnings"] if w.get("level") == "error"]
        assert not errors, (name, errors)
        out[name] = written_map.report.as_dict()["dropped"]
        if "topology" in fmt.layers and not fmt.traits.is_container:
            clear_of_obstacles(layers, fmt, written_map.files)
    return out


def clear_of_obstacles(layers: Layers, fmt: formats.Format, files: dict[str, bytes]) -> None:
    """Check that no exported edge crosses an occupied cell.

    Edges have their shape in formats with shapes, else they are straight from node to node. Cells are looked up along
    each line, independent of the server's own check.
    """
    shaped = fmt.traits.keeps_bends == "shape"
    grids = {k.level: g for k, g in layers.grids().items()}
    for group in formats.group(files, fmt.name)[0]:
        assert fmt.read is not None
        context = ReadContext(frame=layers.frame, main=group.main, options=fmt.read_options())
        read = replace(fmt.read(group.files, context), datum=layers.datum)
        for key, part in read.vector("topology").items():
            grid = grids.get(key.level) or next(iter(grids.values()))
            at = dict(zip(part.ids, part.in_local(layers.frame), strict=True))
            lines: dict[str, Any] = {}
            for i, p in zip(part.ids, part.properties, strict=True):
                if p["kind"] != "edge" or len(read.vector("topology")) < len(grids):  # levels are joined
                    continue
                if not {p["source"], p["target"]} <= at.keys():  # from one level to another
                    continue
                lines[i] = at[i] if shaped else shapely.LineString([at[p["source"]], at[p["target"]]])
            assert not occupied_lines(grid, lines), fmt.name


def occupied_lines(grid: OccupancyGrid, lines: dict[str, Any]) -> set[str]:
    """Return the names of lines that touch an occupied cell, looked up every half cell."""
    step = grid.resolution / 2
    geometry = np.array(list(lines.values()), object)
    count = np.ceil(shapely.length(geometry) / step).astype(np.intp)
    owner = np.repeat(np.arange(len(lines)), count)
    at = (np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)) * step
    xy = shapely.get_coordinates(shapely.line_interpolate_point(geometry[owner], at))
    column, row = ((xy - grid.origin[:2]) / grid.resolution).astype(int).T
    names = list(lines)
    return {names[k] for k in np.unique(owner[grid.cells[row, column] == OCCUPIED]).tolist()}


def over_http(api: Api, name: str, formats_: tuple[str, ...], **values: Any) -> dict[str, Any]:
    """Generate through the API, export some formats, and upload the results to another environment."""
    env = f"made-{name}"
    api.post("environments", {"name": env})
    body = {"generator": name, "seed": 7, "parameters": values}
    version: dict[str, Any] = api.post(f"environments/{env}/generations", body).json()
    assert api.post(f"environments/{env}/generations", body, expect=200).json()["version"] is not None
    states = {row["format"]: row["state"] for row in api.get(f"environments/{env}/versions/latest/maps").json()}
    assert set(states.values()) <= {"direct", "derivable"}, states
    api.post("environments", {"name": f"{env}-back", "datum": version.get("datum")})
    for format_name in formats_:
        answer = api.get(f"environments/{env}/versions/latest/maps/{format_name}")
        inside = answer.headers.get("content-disposition", "")
        file = "map.zip" if "zip" in answer.headers["content-type"] else inside.rpartition("filename=")[2].strip('"')
        second_version = api.upload(f"{env}-back", {file or "map": answer.content}, format=format_name).json()
        assert second_version["version"], format_name
    return version
