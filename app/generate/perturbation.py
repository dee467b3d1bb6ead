"""Perturbation: a changed copy of an environment, to study how much change a fleet tolerates.

Level by level, objects that are not part of the building are shifted and turned, rows of them as a whole, some are
removed, and new obstacles are added on free ground. The grids follow: what changes in a slice of the objects changes in
them. On a level with a grid and no objects with a body, pieces of occupied cells are moved instead. Then sensor noise
is added to the grids, more of it far from the robots' paths: false obstacles, worn or grown edges, unseen patches.
Network edges that obstacles now block are removed or marked as blocked.

Robots have driven along the network and seen it from close by: there is no noise within their radius of its edges. An
obstacle on an edge is a real one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from app.derive import DerivationNotes
from app.derive.objects_to_occupancy import Parameters as Slice
from app.derive.objects_to_occupancy import objects_to_occupancy
from app.errors import BadUpload, CannotConvert, CannotGenerate, Invalid, Problem
from app.generate import MAX_CELLS, MAX_OBJECTS, RandomSource, generates
from app.generate._cell_changes import (
    CellChange,
    apply_change,
    grid_to_metres,
    grid_window,
    metres_to_grid,
    occupied_cells,
    open_cells,
    replace_cells,
    square_boxes,
    unpack_squares,
)
from app.generate._connections import drop_unconnected
from app.generate._movables import Movable, append_rows, changed_features, find_rows, move_shape, separate
from app.model import masks, solids
from app.model.features import Features
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, unknown_grey_as_unknown
from app.model.layers import MAP, Layers, Part, PartKey
from app.model.obstacles import object_footprint
from app.parameters import parameter

Array = NDArray[np.float64]
Cells = NDArray[np.int64]

NAME = "perturbation"
"""Family of new obstacles."""

FIXED_KINDS = frozenset(
    {
        *("wall", "fence", "hedge", "barrier", "railing", "building", "door", "floor", "lift", "hole", "water", "pond"),
        *("ditch", "stream", "pillar", "column", "stairs", "field", "terrain", "ground_plane", "light"),
    }
)
"""Kinds of objects that are built, or are ground: they never move."""


SHAPELESS = 0.25
"""Radius in metres around a model without a known shape."""

HALF = 0.71
"""Half the diagonal of a cell, as a share of its side: the maximum error of distances between cells."""

MAX_ATTEMPTS = 40
"""Number of positions that are tried for each new obstacle."""

MAX_PIECES = 20_000
"""Maximum number of pieces of occupied cells that are moved; more are rather noise."""


@dataclass(frozen=True, slots=True)
class Perturbation:
    """Parameters of the perturbation. The defaults are mild."""

    severity: float = parameter(
        1.0, "factor on all following parameters except sizes and distances", minimum=0.0, maximum=10.0
    )
    level: str | None = parameter(None, "level to disturb; default: all")
    grid: str | None = parameter(
        None, "grid with noise; default: all except costmap filter masks. All grids follow the objects"
    )
    shift: float = parameter(0.1, "maximum distance by which an object is moved", minimum=0.0, maximum=100.0, unit="m")
    turn: float = parameter(5.0, "maximum angle by which an object is turned", minimum=0.0, maximum=180.0, unit="°")
    row_shift: float = parameter(
        0.15, "maximum distance by which a whole row of objects is moved", minimum=0.0, maximum=100.0, unit="m"
    )
    missing: float = parameter(0.03, "share of objects that are removed", minimum=0.0, maximum=1.0)
    largest: float = parameter(5.0, "maximum length of changed objects", minimum=0.05, maximum=1000.0, unit="m")
    obstacles: int = parameter(3, "number of new obstacles on each level", minimum=0, maximum=10_000)
    obstacle_size: tuple[float, float] = parameter(
        (0.3, 1.0), "smallest,largest diameter of new obstacles", minimum=0.05, maximum=50.0, unit="m"
    )
    speckle: float = parameter(0.0005, "share of distant free cells that become occupied", minimum=0.0, maximum=0.5)
    erode: float = parameter(0.05, "share of obstacles' edge cells that become free", minimum=0.0, maximum=1.0)
    dilate: float = parameter(0.05, "share of cells beside obstacles that become occupied", minimum=0.0, maximum=1.0)
    dropped: int = parameter(2, "number of patches of each grid that become unknown", minimum=0, maximum=10_000)
    patch: float = parameter(1.5, "maximum diameter of such a patch", minimum=0.05, maximum=1000.0, unit="m")
    sensor_range: float = parameter(
        10.0, "distance from the robots' paths at which noise is strongest", minimum=0.1, maximum=1000.0, unit="m"
    )
    robot_radius: float = parameter(
        0.3, "radius of the robot; edges closer to a new obstacle are blocked", minimum=0.0, maximum=5.0, unit="m"
    )
    edges: Literal["remove", "block"] = parameter(
        "remove", "treatment of blocked edges: removed, with covered nodes, or marked as blocked"
    )


@generates(
    {"objects", "occupancy", "topology"},
    changes={"objects", "occupancy", "topology"},
    also={"resources", "location"},
    parameters=Perturbation,
)
def perturbation(given: Layers, options: Perturbation, source: RandomSource, notes: DerivationNotes) -> Layers:
    """Disturbed environment: objects shifted, removed and added, noise on its grids, a network that still fits.

    Objects keep their family and ids; new ones are of the family ``perturbation``. Grids keep their frame. Voxels,
    zones and images do not change. Raises CannotGenerate if the environment is too large, or there is no such level.
    """
    low, high = options.obstacle_size
    if low > high:
        raise Invalid(
            "obstacle_size: the smaller value must come first",
            [Problem("the smaller value must come first", where="obstacle_size")],
        )
    cells = sum(g.cells.size for g in given.grids().values())
    objects = sum(len(p) for p in given.vector("objects").values())
    if cells > MAX_CELLS or objects > MAX_OBJECTS:
        raise CannotGenerate(
            f"there are {cells} cells and {objects} objects; the limits are {MAX_CELLS} and {MAX_OBJECTS}: split the "
            "environment, or make its grid coarser"
        )
    levels = sorted({k.level for k in given.parts if k.layer in ("objects", "occupancy", "topology")})
    if options.level is not None:
        if options.level not in levels:
            reason = f"unknown level {options.level!r:.80}; available: {', '.join(levels)}"
            raise CannotGenerate(f"level: {reason}", [Problem(reason, where="level")])
        levels = [options.level]
    if options.severity == 0.0:
        raise CannotGenerate("severity: must be above 0", [Problem("must be above 0", where="severity")])
    if options.grid is not None and options.grid not in {k.name for k in given.grids()}:
        grid_names = ", ".join(sorted({k.name for k in given.grids()})) or "none"
        reason = f"unknown grid {options.grid!r:.80}; available: {grid_names}"
        raise CannotGenerate(f"grid: {reason}", [Problem(reason, where="grid")])
    parts: dict[PartKey, Part] = {}
    for level in levels:
        parts |= _Level(given, options, source, notes, level).changed_parts()
    if not parts:
        text = "; ".join(f"{w.where}: {w.problem}" for w in notes.warnings)
        text += "".join(f"; {one.count} {one.subject}: {one.why}" for one in notes.dropped)
        raise CannotGenerate(
            f"these parameters disturb nothing{' (' + text.removeprefix('; ') + ')' if text else ''}: increase them, "
            "or upload or derive obstacles or a grid"
        )
    if options.edges == "remove":
        parts |= drop_unconnected(given, parts, notes)
    notes.warn("voxels, zones and images are unchanged; derive them again if they must match")
    return Layers(parts, given.datum, given.levels)


class _Level:
    """One level during the perturbation."""

    def __init__(
        self, given: Layers, options: Perturbation, source: RandomSource, notes: DerivationNotes, level: str
    ) -> None:
        self.given, self.options, self.source, self.notes, self.level = given, options, source, notes, level
        self.parts: dict[PartKey, Features] = {k: p for k, p in given.vector("objects", level).items() if len(p)}
        self.stored = given.grids(level)
        grids = {k: unknown_grey_as_unknown(g) for k, g in self.stored.items()}
        masked = {k for k, g in grids.items() if k.name in masks.MASKS or masks.NAME in g.properties}
        self.maps = {k: g for k, g in grids.items() if k not in masked}
        noisy = self.maps if options.grid is None else {k: g for k, g in grids.items() if k.name == options.grid}
        self.noisy, self.grids = frozenset(noisy), {**self.maps, **noisy}
        self.lines = {k: p for k, p in given.vector("topology", level).items() if len(p)}

    def draw(self, name: str) -> np.random.Generator:
        """Return the random stream of one purpose on this level."""
        return self.source.stream(f"{self.level}/{name}")

    def changed_parts(self) -> dict[PartKey, Part]:
        """Return the parts of the level that changed."""
        out: dict[PartKey, Part] = {}
        things = self._things()
        grids = self.maps if things else {k: g for k, g in self.grids.items() if k in self.noisy}
        first = next((k for k in grids if k.name == MAP), next(iter(grids), None))
        main = None if first is None else grids[first]
        if things:
            change, objects = self._objects(things, main)
            out |= objects
            changes = dict.fromkeys(self.maps, change)
        elif first is not None:
            changes = {k: self._pieces(k, g) for k, g in grids.items()}
            change = changes[first]
        else:
            self.notes.warn("it has neither obstacles nor a grid", where=self.level)
            return out
        network, edge_lines = self._network(change, main)
        out |= network
        for key, grid in self.grids.items():
            cells = apply_change(grid, changes[key]) if key in changes else grid.cells
            if key in self.noisy:
                cells = self._noise(key, grid, cells, edge_lines)
            if not np.array_equal(cells, grid.cells):
                out[key] = replace_cells(self.stored[key], cells)
        return out

    # --- objects -----------------------------------------------------------------------------------------------------
    def _things(self) -> list[Movable]:
        """Collect everything with a body; movable objects are separated from fixed ones first."""
        solid_reader = solids.Solids(self.given.resources())
        out: list[Movable] = []
        for key, part in self.parts.items():
            metres = part.in_local(self.given.frame)
            for k, (p, geometry) in enumerate(zip(part.properties, metres, strict=True)):
                try:
                    body = object_footprint(p, geometry, solid_reader)
                except (Invalid, BadUpload) as error:
                    self.notes.warn(f"it is unchanged; {error.detail}", where=part.ids[k])
                    continue
                if (body is None or body.is_empty) and p.get("kind") in ("model", "include") and not geometry.is_empty:
                    body = shapely.centroid(geometry).buffer(SHAPELESS)  # its files are in another part
                if body is None or body.is_empty:
                    continue
                x0, y0, x1, y1 = body.bounds
                pose = p.get("pose")
                middle = ((x0 + x1) / 2, (y0 + y1) / 2) if pose is None else solids.parse_pose(p)[:2]
                woven = (
                    isinstance(p.get("osm"), dict) and shapely.get_type_id(geometry) != 0
                )  # its nodes would stay behind
                stays = (
                    str(p.get("kind")) in FIXED_KINDS or math.hypot(x1 - x0, y1 - y0) > self.options.largest or woven
                )
                thing = Movable((key, k), (float(middle[0]), float(middle[1])), body)
                if stays:
                    thing.moved = None
                out.append(thing)
        return out

    def _objects(self, things: list[Movable], main: OccupancyGrid | None) -> tuple[CellChange, dict[PartKey, Part]]:
        """Return the changes of the obstacles, and the changed parts of objects."""
        loose = [t for t in things if t.moved is not None]
        rows = find_rows(np.array([t.at for t in loose]).reshape(-1, 2))
        for t, row in zip(loose, rows.tolist(), strict=True):
            t.row = row
        self._shaken(loose)
        back = separate(things)
        if back:
            self.notes.drop("moves of objects", back, "their new place is occupied")
        fresh = self._obstacles(things, main or self._slice(self.given.parts, None))
        phrases = self._summary(things)
        out: dict[PartKey, Part] = {}
        for key, part in self.parts.items():
            part_things = {
                t.place[1]: t for t in things if isinstance(t.place, tuple) and t.place[0] == key and t.has_changed
            }
            if part_things:
                out[key] = changed_features(part, part_things, self.given)
        if fresh:
            key = PartKey("objects", self.level, NAME)
            before = out.get(key, self.parts.get(key))
            assert before is None or isinstance(before, Features)
            out[key] = append_rows(before, fresh)
            phrases.append(f"{len(fresh)} new obstacles")
        if phrases:
            self.notes.warn(f"disturbed: {', '.join(phrases)}", where=self.level)
        merged = {**self.parts, **out}
        return self._slice_changes(merged, main), out

    def _summary(self, things: Sequence[Movable]) -> list[str]:
        removed_count = sum(t.gone for t in things)
        moved = sum(t.has_changed for t in things) - removed_count
        rows = len({t.row for t in things if t.row >= 0 and t.moved is not None})
        phrases = [f"{moved} objects moved" + (f" ({rows} rows)" if rows else "")] if moved else []
        return phrases + ([f"{removed_count} removed"] if removed_count else [])

    def _shaken(self, loose: list[Movable]) -> None:
        """Draw the removed objects, and the displacement of the others."""
        s, options = self.options.severity, self.options
        go = self.draw("missing").random(len(loose)) < min(options.missing * s, 1.0)
        by = self.draw("shift").random((len(loose), 3)) * 2 - 1
        rows = self.draw("rows").random((max((t.row for t in loose), default=-1) + 1, 2)) * 2 - 1
        for t, removed, (dx, dy, turn) in zip(loose, go.tolist(), by.tolist(), strict=True):
            if removed:
                t.gone = True
                continue
            along = rows[t.row].tolist() if t.row >= 0 else (0.0, 0.0)
            half = math.sqrt(0.5)  # so that the maximum applies in every direction
            x = half * s * (dx * options.shift + along[0] * options.row_shift)
            y = half * s * (dy * options.shift + along[1] * options.row_shift)
            angle = math.radians(min(options.turn * s, 180.0)) * turn
            t.moved = (round(x, 3) + 0.0, round(y, 3) + 0.0, round(angle, 6) + 0.0)

    def _slice_changes(self, merged: dict[PartKey, Any], main: OccupancyGrid | None) -> CellChange:
        """Return what a slice of the objects shows now and not before, and the reverse."""
        slice_properties = main.properties.get("slice") if main is not None else None
        height = slice_properties.get("height") if isinstance(slice_properties, dict) else None
        size = None if main is None else main.resolution
        slice_parameters = Slice(height=height, resolution=size, padding=0.0)
        rest = {k: p for k, p in self.given.parts.items() if k.layer == "resources"}
        grids: list[OccupancyGrid | None] = []
        for objects in (self.parts, merged):
            grid = self._slice({**rest, **objects}, slice_parameters)
            grids.append(grid)
            size = size if grid is None else grid.resolution
            slice_parameters = replace(slice_parameters, resolution=size)
        if size is None:
            return CellChange(1.0)
        before, after = (occupied_cells(g) if g is not None else np.empty(0, np.int64) for g in grids)
        freed, filled = np.setdiff1d(before, after, True), np.setdiff1d(after, before, True)
        return CellChange(size, unpack_squares(freed), unpack_squares(filled), unpack_squares(before))

    def _slice(self, parts: Mapping[PartKey, Part], slice_parameters: Slice | None) -> OccupancyGrid | None:
        """Return the level's grid of these objects; None if there is nothing at that height."""
        level_parts = {k: p for k, p in parts.items() if k.layer in ("resources", "location") or k.level == self.level}
        try:
            sliced_layers = objects_to_occupancy(
                Layers(level_parts, self.given.datum, self.given.levels), slice_parameters or Slice(), DerivationNotes()
            )
        except CannotConvert:
            return None
        return sliced_layers.grids(self.level).get(PartKey("occupancy", self.level, MAP))

    # --- new obstacles -----------------------------------------------------------------------------------------------
    def _obstacles(
        self, things: Sequence[Movable], main: OccupancyGrid | None
    ) -> list[tuple[str, Any, dict[str, Any]]]:
        """Add new objects on free ground."""
        rng = self.draw("obstacles")
        bodies = [t.now() for t in things if t.moved is not None and not t.gone]  # the grid shows all others
        tree = shapely.STRtree(bodies)
        new: list[Any] = []
        rows: list[tuple[str, Any, dict[str, Any]]] = []
        random_position = self._room(main)
        count = self._scaled_count(self.options.obstacles)
        floor = self.given.elevation(self.level)
        taken = {i for part in self.parts.values() for i in part.ids}
        for _ in range(count if random_position is not None else 0):
            shape, yaw, high, size = self._body(rng)
            for _ in range(MAX_ATTEMPTS):
                assert random_position is not None
                x, y = random_position(rng)
                body = move_shape(shape, (0.0, 0.0), (x, y, yaw))
                near = [bodies[k] for k in tree.query(body)] + new
                if not any(shapely.intersects(body, other) for other in near):
                    break
            else:
                continue
            number = len(rows) + 1
            while f"new/{number}" in taken:
                number += 1
            taken.add(f"new/{number}")
            new.append(body)
            solid: dict[str, Any] = {"type": "cylinder", "radius": size[0] / 2, "length": high}
            if len(size) == 2:
                solid = {"type": "box", "size": [*size, high]}
            solid["pose"] = [0.0, 0.0, round(high / 2, 4), 0.0, 0.0, 0.0]
            wide = [size[0], size[-1], high]
            properties = {"kind": "obstacle", "pose": [x, y, floor, 0.0, 0.0, yaw], "size": wide, "height": high}
            rows.append((f"new/{number}", body, {**properties, "shapes": [solid]}))
        if len(rows) < count:
            self.notes.drop("new obstacles", count - len(rows), f"there is no free space for them on {self.level}")
        return rows

    def _body(self, rng: np.random.Generator) -> tuple[Any, float, float, list[float]]:
        """Draw (outline around 0, yaw, height, sizes) of a box, or of a cylinder, which has one size."""
        kind, a, b, turn, tall = rng.random(5).tolist()
        low, high = self.options.obstacle_size
        long, wide = (round(low + (high - low) * v, 3) for v in (a, b))
        height = round(0.4 + 1.2 * tall, 2)
        if kind < 0.5:
            return _ring(long / 2), 0.0, height, [long]
        return shapely.box(-long / 2, -wide / 2, long / 2, wide / 2), round(math.pi * turn, 6), height, [long, wide]

    def _room(self, main: OccupancyGrid | None) -> Callable[[np.random.Generator], tuple[float, float]] | None:
        """Return a function that draws a position on open ground; None if there is none."""
        if main is None:
            return None
        spots = open_cells(main.cells, self.options.obstacle_size[1] / main.resolution)

        def drawn(rng: np.random.Generator) -> tuple[float, float]:
            row, column = divmod(int(spots[int(rng.integers(len(spots)))]), main.width)
            x, y = grid_to_metres(main, np.array([[column + 0.5, row + 0.5]]))[0].tolist()
            return round(x, 3) + 0.0, round(y, 3) + 0.0

        return drawn if len(spots) else None

    def _scaled_count(self, count: int) -> int:
        """Return a count scaled by severity."""
        return min(round(count * self.options.severity), MAX_OBJECTS)

    # --- a grid without objects --------------------------------------------------------------------------------------
    def _pieces(self, key: PartKey, grid: OccupancyGrid) -> CellChange:
        """Move and remove small pieces of occupied cells, and add new ones, as cells of the grid itself."""
        import cv2

        occupied = (grid.cells == OCCUPIED).astype(np.uint8)
        _, label, stats, _ = cv2.connectedComponentsWithStats(occupied, connectivity=8)
        size = grid.resolution
        max_diagonal = self.options.largest / size
        fits = (np.hypot(stats[:, 2], stats[:, 3]) <= max_diagonal) & (stats[:, 4] >= 4)
        fits[0] = False
        pieces = np.flatnonzero(fits)
        if len(pieces) > MAX_PIECES:
            self.notes.drop("pieces of the grid", len(pieces) - MAX_PIECES, f"at most {MAX_PIECES} are moved")
            pieces = pieces[:MAX_PIECES]
        loose = []
        for k in pieces.tolist():
            x, y, w, h, _ = (int(v) for v in stats[k])
            loose.append(Movable(k, ((x + w / 2) * size, (y + h / 2) * size), None))
        for t, row in zip(loose, find_rows(np.array([t.at for t in loose]).reshape(-1, 2)).tolist(), strict=True):
            t.row = row
        self._shaken(loose)
        cells = grid.cells.copy()
        blocked_count = 0
        for t in loose:
            assert isinstance(t.place, int)
            x, y, w, h, _ = (int(v) for v in stats[t.place])
            inside = label[y : y + h, x : x + w] == t.place
            cells[y : y + h, x : x + w][inside] = FREE
            dx, dy = (0, 0) if t.gone or t.moved is None else (round(t.moved[0] / size), round(t.moved[1] / size))
            into = grid_window(cells, x + dx, y + dy, w, h)
            if not t.gone and (into is None or (cells[into][inside] != FREE).any()):
                t.moved, into = (0.0, 0.0, 0.0), grid_window(cells, x, y, w, h)
                blocked_count += 1
            elif (dx, dy) == (0, 0) and not t.gone:
                t.moved = (0.0, 0.0, 0.0)
            if not t.gone and into is not None:
                cells[into][inside] = OCCUPIED
        if blocked_count:
            self.notes.drop("moves of pieces of the grid", blocked_count, "their new place is occupied or unknown")
        added = self._paint_obstacles(key, grid, cells)
        phrases = self._summary(loose) + ([f"{added} new obstacles"] if added else [])
        if phrases:
            self.notes.warn(f"disturbed, by its cells: {', '.join(phrases)}", where=f"{self.level}/{key.name}")
        row, column = np.nonzero((grid.cells == OCCUPIED) & (cells != OCCUPIED))
        freed = np.stack([column, row], axis=1)
        row, column = np.nonzero((grid.cells != OCCUPIED) & (cells == OCCUPIED))
        filled = np.stack([column, row], axis=1)
        row, column = np.nonzero(occupied)
        return CellChange(0.0, freed, filled, np.stack([column, row], axis=1))

    def _paint_obstacles(self, key: PartKey, grid: OccupancyGrid, cells: NDArray[np.uint8]) -> int:
        """Paint new obstacles onto open cells; return their number."""
        import cv2

        rng = self.draw(f"obstacles/{key.name}")
        spots = open_cells(cells, self.options.obstacle_size[1] / grid.resolution)
        done, count = 0, self._scaled_count(self.options.obstacles)
        for _ in range(count if len(spots) else 0):
            shape, yaw, _, _ = self._body(rng)
            for _ in range(MAX_ATTEMPTS):
                row, column = divmod(int(spots[int(rng.integers(len(spots)))]), grid.width)
                at = shapely.get_coordinates(move_shape(shape, (0.0, 0.0), (0.0, 0.0, yaw)))[:-1] / grid.resolution
                reach = int(np.ceil(np.abs(at).max())) + 1
                spot = np.zeros((2 * reach + 1, 2 * reach + 1), np.uint8)
                cv2.fillPoly(spot, [np.round(at + reach).astype(np.int32)], 1)
                into = grid_window(cells, column - reach, row - reach, 2 * reach + 1, 2 * reach + 1)
                if into is not None and (cells[into][spot == 1] == FREE).all():
                    cells[into][spot == 1] = OCCUPIED
                    done += 1
                    break
        if done < count:
            self.notes.drop("new obstacles", count - done, f"there is no free space for them on {self.level}")
        return done

    # --- the network -------------------------------------------------------------------------------------------------
    def _network(self, change: CellChange, main: OccupancyGrid | None) -> tuple[dict[PartKey, Part], list[Any]]:
        """Return the changed parts of the network, and the lines (metres) that robots can still use."""
        out: dict[PartKey, Part] = {}
        edge_lines: list[Any] = []
        boxes, old = (square_boxes(places, change.size, main) for places in (change.filled, change.before))
        tree, was = shapely.STRtree(boxes), shapely.STRtree(old)
        for key, part in self.lines.items():
            metres = shapely.force_2d(part.in_local(self.given.frame))
            coarse = HALF * (change.size or (main.resolution if main is not None else 0.0))
            hit = _nearest(tree, metres, self.options.robot_radius + coarse) < self._reach(was, metres, coarse)
            edge = np.array([p.get("kind") == "edge" for p in part.properties])
            edge_lines += [g for g, e, h in zip(metres, edge, hit, strict=True) if e and not h and not g.is_empty]
            crossed = [part.ids[k] for k in np.flatnonzero(hit & edge)]
            covered = [part.ids[k] for k in np.flatnonzero(hit & ~edge)]
            if not crossed and not covered:
                continue
            if self.options.edges == "block":
                properties = tuple(
                    {**p, "blocked": True} if h and e else p for p, h, e in zip(part.properties, hit, edge, strict=True)
                )
                if crossed:
                    out[key] = Features(part.ids, part.geometry.copy(), properties, part.local.copy(), part.document)
                self._warn("blocked", crossed, key)
                self._warn("under an obstacle", covered, key, "nodes")
            else:
                out[key] = part.select(~hit)
                self._warn("removed", crossed, key)
                self._warn("removed", covered, key, "nodes")
        return out, edge_lines

    def _reach(self, was: shapely.STRtree, metres: NDArray[np.object_], coarse: float) -> Array:
        """Return the minimum distance of an obstacle to each line or point: the robot's radius plus a cell's tolerance.

        Lines with a smaller distance before are meant for a smaller robot: half of that distance.
        """
        radius = self.options.robot_radius
        away = _nearest(was, metres, radius)
        return np.where(away < radius - 2 * coarse, away / 2, np.nextafter(radius + coarse, np.inf))

    def _warn(self, effect: str, ids: Sequence[str], key: PartKey, kind: str = "edges") -> None:
        if ids:
            some = ", ".join(ids[:10]) + (" …" if len(ids) > 10 else "")
            location = f"{key.level}/{key.name}"
            self.notes.warn(f"{len(ids)} {kind} are {effect} because of new obstacles: {some}", where=location)

    # --- noise -------------------------------------------------------------------------------------------------------
    def _noise(
        self, key: PartKey, grid: OccupancyGrid, cells: NDArray[np.uint8], lines: Sequence[Any]
    ) -> NDArray[np.uint8]:
        """Add sensor noise to cells."""
        known_cells = cells != UNKNOWN
        down, across = np.flatnonzero(known_cells.any(axis=1)), np.flatnonzero(known_cells.any(axis=0))
        if not len(down):
            return cells
        y0, x0 = int(down[0]), int(across[0])
        inner = (slice(y0, int(down[-1]) + 1), slice(x0, int(across[-1]) + 1))  # many maps are mostly unknown
        out = cells.copy()
        out[inner] = self._errors(key, grid, cells[inner], (x0, y0), lines)
        return out

    def _errors(
        self, key: PartKey, grid: OccupancyGrid, cells: NDArray[np.uint8], first: tuple[int, int], lines: Sequence[Any]
    ) -> NDArray[np.uint8]:
        """Add sensor noise to a window of the grid. first: its first column and row."""
        import cv2

        options, s = self.options, self.options.severity
        out = cells.copy()
        free, occupied = cells == FREE, cells == OCCUPIED
        driven = np.zeros(cells.shape, np.uint8)
        for line in lines:
            at = np.round(metres_to_grid(grid, shapely.get_coordinates(line)) - 0.5) - first
            if (
                np.abs(at).max(initial=0.0) < 2**24
            ):  # cv2 takes 32-bit coordinates; distant obstacles are outside every grid
                cv2.polylines(driven, [at.astype(np.int32)], False, 1)
        if not driven.any():
            away = cv2.distanceTransform(np.pad(free, 1).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
            driven.reshape(-1)[int(np.argmax(away[1:-1, 1:-1]))] = 1
            near = np.zeros(cells.shape, bool)
            away = cv2.distanceTransform(1 - driven, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        else:
            away = cv2.distanceTransform(1 - driven, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
            near = away <= options.robot_radius / grid.resolution + 2.0
        # in 64 steps, so that no last bit of a distance decides
        weight = np.floor(np.minimum(away * (grid.resolution / options.sensor_range), 1.0) * 64) / 64
        kernel = np.ones((3, 3), np.uint8)
        rng = self.draw(f"noise/{key.name}")
        chance = rng.random(cells.shape, np.float32)
        worn = occupied & (cv2.dilate(free.astype(np.uint8), kernel) == 1)
        beside = free & (cv2.dilate(occupied.astype(np.uint8), kernel) == 1)
        share = (0.5 + 0.5 * weight).astype(np.float32)
        out[worn & (chance < min(options.erode * s, 1.0) * share)] = FREE
        out[beside & ~near & (chance < min(options.dilate * s, 1.0) * share)] = OCCUPIED
        out[free & ~beside & ~near & (chance < min(options.speckle * s, 1.0) * weight)] = OCCUPIED
        candidates = np.flatnonzero((cells != UNKNOWN) & ~near)
        for _ in range(self._scaled_count(options.dropped) if len(candidates) else 0):
            row, column = divmod(int(candidates[int(rng.integers(len(candidates)))]), cells.shape[1])
            radius = max(1, round(options.patch / 2 / grid.resolution * (0.3 + 0.7 * float(rng.random()))))
            y0, x0 = max(0, row - radius), max(0, column - radius)
            hole = (slice(y0, row + radius + 1), slice(x0, column + radius + 1))
            down = np.arange(hole[0].start, min(hole[0].stop, cells.shape[0]))[:, None] - row
            across = np.arange(hole[1].start, min(hole[1].stop, cells.shape[1]))[None] - column
            out[hole][(down**2 + across**2 <= radius**2) & ~near[hole]] = UNKNOWN
        return out


def _nearest(tree: shapely.STRtree, metres: NDArray[np.object_], max_distance: float) -> Array:
    """Return the distance in metres of each geometry to the nearest of the tree; infinite beyond ``max_distance``."""
    out = np.full(len(metres), np.inf)
    usable = np.flatnonzero(~shapely.is_empty(metres))
    if len(usable) and len(tree.geometries) and max_distance > 0:
        at, away = tree.query_nearest(
            metres[usable], max_distance=max_distance, return_distance=True, all_matches=False
        )
        out[usable[at[0]]] = np.round(away, 6)
    elif len(usable) and len(tree.geometries):
        out[usable[np.unique(tree.query(metres[usable], predicate="intersects")[0])]] = 0.0
    return out


def _ring(radius: float) -> Any:
    return shapely.transform(shapely.Point(0, 0).buffer(radius, quad_segs=4), lambda xy: np.round(xy, 3) + 0.0)
