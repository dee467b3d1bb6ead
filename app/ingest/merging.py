"""Merge the grids of several robots into one: a version with the merged grid, from which a revert leads back."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np

from app.derive import DerivationNotes
from app.errors import CannotConvert, Conflict, Invalid, NotFound, Problem
from app.ingest.alignment import AlignmentResult
from app.model import alignment, stitching
from app.model.alignment import Fit
from app.model.frame import GROUND
from app.model.grid import OccupancyGrid, unknown_grey
from app.model.layers import PartKey
from app.model.names import did_you_mean
from app.store.changes import Changes, Drop, Operation, Provenance, Replace
from app.store.in_worker import open_store
from app.store.values import Information, PartEntry, Version

MERGED = "merged"
"""Name of the merging step in a part's provenance."""

MAX_SOURCE_CELLS = 2**28
"""Maximum number of cells of all grids of a merge together."""

_PAIRS_NEAR = 0.5
"""Distance in metres at which pairs of points agree."""


@dataclass(frozen=True, slots=True)
class MergeRequest:
    """Request to merge grids of one level into the frame of the first.

    grids: 2 to MAX_GRIDS names, oldest first. name: of the result; empty: the first grid's. drop: delete the sources.
    pairs: points (in the grid, in the first grid's frame) in metres, by grid. poses: where a grid's frame is in the
    first one's, roughly, (x, y, yaw) in metres and radians, by grid. angle, reach, near, least, overlap: see
    `stitching.Bounds`. max_cells: of the result.
    """

    grids: tuple[str, ...]
    level: str = GROUND
    name: str = ""
    seam: stitching.Seam = "evidence"
    drop: bool = False
    pairs: Mapping[str, tuple[tuple[tuple[float, float], tuple[float, float]], ...]] = field(default_factory=dict)
    poses: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    angle: float | None = None
    reach: float | None = None
    near: float = 0.1
    least: float = 0.9
    overlap: float = 0.1
    max_cells: int = 2**26
    dry_run: bool = False

    @property
    def key(self) -> PartKey:
        """Return the key of the merged grid."""
        return PartKey("occupancy", self.level, self.name or self.grids[0])


def check(request: MergeRequest) -> None:
    """Check names. Raises Invalid, which names the member of the request."""
    problems: list[Problem] = []
    if not 2 <= len(request.grids) <= stitching.MAX_GRIDS:
        problems.append(Problem(f"name 2 to {stitching.MAX_GRIDS} grids", where="body.merge.grids"))
    twice = sorted({name for name in request.grids if request.grids.count(name) > 1})
    problems += [Problem(f"grid {name!r:.80} is named twice", where="body.merge.grids") for name in twice]
    for word, names in (("pairs", request.pairs), ("poses", request.poses)):
        for name in names:
            if name not in request.grids[1:]:
                reason = "the first grid stays where it is" if name in request.grids else "it is not one of the grids"
                problems.append(Problem(f"{name!r:.80}: {reason}", where=f"body.merge.{word}"))
    both = sorted(set(request.pairs) & set(request.poses))
    problems += [
        Problem(f"grid {name!r:.80} has pairs as well: give either", where="body.merge.poses") for name in both
    ]
    if problems:
        raise Invalid("; ".join(f"{p.where}: {p.problem}" for p in problems), problems)


def prepare_merge(database_url: str, blob_dir: str, base: Version, request: MergeRequest) -> AlignmentResult:
    """Place grids, merge them, and prepare the version (in a worker).

    Raises NotFound (no such grid), Invalid (pairs, sizes), Conflict (another grid has the name), CannotConvert (a grid
    fits nowhere or in several ways).
    """
    store = open_store(database_url, blob_dir)
    entries = _entries(base, request)
    keys = [entry.key for entry in entries]
    loaded = store.content.load(base, keys)
    grids = [cast(OccupancyGrid, loaded.parts[key]) for key in keys]
    notes = DerivationNotes()
    for name, grid in zip(request.grids, grids, strict=True):
        grey = unknown_grey(grid)
        if grey is not None:
            notes.warn(f"{name}: {int(grey.sum())} free cells have the grey of unknown ones and count as unknown")
    for index, entry in enumerate(entries):
        twin = next((e.key.name for e in entries[:index] if e.hash == entry.hash), None)
        if twin is not None:
            notes.warn(f"{entry.key.name} has the same content as {twin}")
    bounds = stitching.Bounds(request.angle, request.reach, request.near, request.least, request.overlap)
    places = stitching.place_grids(grids, bounds, _starts(request, notes))
    report: dict[str, Any] = {
        "name": request.key.name,
        "level": request.level,
        "seam": request.seam,
        "grids": [_line(name, place) for name, place in zip(request.grids, places, strict=True)],
    }
    for name, place in zip(request.grids, places, strict=True):
        if place.warning:
            notes.warn(f"{name}: {place.warning}")
    problems = [Problem(p.problem, where=f"body.merge.grids.{n}") for n, p in enumerate(places) if p.problem]
    if problems:
        texts = [f"{request.grids[n]}: {place.problem}" for n, place in enumerate(places) if place.problem]
        if not request.dry_run:
            raise CannotConvert(f"the grids cannot be merged: {'; '.join(texts)}", problems)
        for text in texts:
            notes.warn(text)
        return AlignmentResult(report, tuple(notes.warnings), None)
    merged, provenance = _merged(request, grids, places, entries, report, notes)
    operations: list[Operation] = [Replace(request.key, merged, provenance)]
    operations += [Drop(key) for key in keys if request.drop and key != request.key]
    prepared = store.versions.prepare(base, Changes(tuple(operations)))
    return AlignmentResult(report, tuple(notes.warnings), prepared)


def previous_merge(version: Version, request: MergeRequest) -> dict[str, Any] | None:
    """Read the report from a version's provenance, for a repeated request."""
    for entry in version.parts:
        if entry.key == request.key:
            steps = [s for s in entry.provenance.steps if s.get("step") == MERGED]
            return dict(steps[-1]["parameters"]) if steps else None
    return None


def _entries(base: Version, request: MergeRequest) -> list[PartEntry]:
    """Return the entries of the grids; check that the result may have its name."""
    stored = {e.key: e for e in base.parts if e.key.layer == "occupancy"}
    keys = [PartKey("occupancy", request.level, name) for name in request.grids]
    lacking = [key.name for key in keys if key not in stored]
    if lacking:
        available = [f"{key.level}/{key.name}" for key in sorted(stored)]
        name = f"{request.level}/{lacking[0]}"
        listed = ", ".join(available) or "none"
        raise NotFound(
            f"unknown grid {name!r:.160}{did_you_mean(name, available)}; available: {listed}. Grids of one level are "
            "merged"
        )
    entries = [stored[key] for key in keys]
    cells = sum(entry.count for entry in entries)
    if cells > MAX_SOURCE_CELLS:
        reason = f"the grids have {cells} cells together; the limit is {MAX_SOURCE_CELLS}: merge fewer or coarser grids"
        raise Invalid(reason, [Problem(reason, where="body.merge.grids")])
    namesake = stored.get(request.key)
    if namesake is not None and request.key not in keys:
        last = namesake.provenance.steps[-1:] or ({},)
        if last[0].get("step") != MERGED:
            raise Conflict(
                f"another grid has the name {request.key.name!r:.80}: choose another name, or merge it as well"
            )
    return entries


def _starts(request: MergeRequest, notes: DerivationNotes) -> dict[int, stitching.Start]:
    """Return the known positions by the index of the grid."""
    out = {}
    for index, name in enumerate(request.grids):
        if name in request.poses:
            x, y, yaw = request.poses[name]
            out[index] = stitching.Start(Fit(x, y, yaw, 0.0, 0.0))
        elif name in request.pairs:
            points = np.array(request.pairs[name], np.float64).reshape(-1, 2, 2)
            try:
                fit, disagreeing, scale = alignment.fit_pairs(points, near=_PAIRS_NEAR)
            except Invalid as error:
                raise Invalid(
                    f"{name:.80}: {error.detail}",
                    [Problem(p.problem, where=f"body.merge.pairs.{name[:80]}") for p in error.problems],
                ) from error
            if disagreeing:
                notes.warn(
                    f"{name}: {len(disagreeing)} pairs disagree with the others and are ignored: {disagreeing[:20]}"
                )
            if abs(scale - 1.0) > 0.02:
                notes.warn(
                    f"{name}: the second points are {scale:.3f} times as far apart as the first; check its resolution"
                )
            out[index] = stitching.Start(fit, is_exact=True)
    return out


def _line(name: str, place: stitching.Placement) -> dict[str, Any]:
    """Return the report of one grid."""
    fit = {key: value for key, value in place.fit.as_dict().items() if math.isfinite(value)}
    line: dict[str, Any] = {"grid": name, **fit, "walls": round(place.walls, 3), "area": round(place.area, 3)}
    if place.rivals:
        line["others"] = [{k: v for k, v in rival.as_dict().items() if math.isfinite(v)} for rival in place.rivals]
    return {**line, "problem": place.problem} if place.problem else line


def _merged(
    request: MergeRequest,
    grids: Sequence[OccupancyGrid],
    places: Sequence[stitching.Placement],
    entries: Sequence[PartEntry],
    report: dict[str, Any],
    notes: DerivationNotes,
) -> tuple[OccupancyGrid, Provenance]:
    """Return the merged grid with its provenance, and complete the report."""
    fits = [place.fit for place in places]
    mosaic = stitching.merge_cells(grids, fits, request.seam, near=request.near, max_cells=request.max_cells)
    merged = mosaic.grid
    report |= {
        "resolution": merged.resolution,
        "origin": list(merged.origin),
        "size": [merged.width, merged.height],
        "cells": merged.counts(),
        "conflicts": mosaic.conflicts,
        "freed": mosaic.freed,
    }
    if mosaic.freed:
        notes.warn(
            f"{mosaic.freed} cells that one grid has occupied are free, since "
            + ("more of the others saw them free" if request.seam == "evidence" else "a later grid saw them free")
        )
    order: tuple[Information, ...] = ("raw", "derived", "generated", "template")
    old = [entry.provenance for entry in entries]
    information = next(kind for kind in order if any(p.information == kind for p in old))
    if any(p.information != information for p in old):
        kinds = ", ".join(f"{entry.key.name}: {entry.provenance.information}" for entry in entries)
        notes.warn(f"the grids differ in their information ({kinds}); the merged grid counts as {information}")
    steps: list[Mapping[str, Any]] = []
    for step in (step for p in old for step in p.steps):
        if step not in steps:
            steps.append(step)
    provenance = Provenance(
        information,
        sources=tuple(sorted({source for p in old for source in p.sources})),
        steps=(*steps, {"step": MERGED, "parameters": report}),
        attribution=tuple(dict.fromkeys(text for p in old for text in p.attribution)),
    )
    return merged, provenance
