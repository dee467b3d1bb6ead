"""Align a grid with another map of the site: a version with a moved grid origin and unchanged cells."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from app import derive
from app.derive import DerivationNotes
from app.errors import CannotConvert, Invalid, NotFound, Problem
from app.model import alignment
from app.model.frame import GROUND
from app.model.grid import OccupancyGrid
from app.model.layers import MAP, Layers, PartKey
from app.model.names import did_you_mean
from app.store.changes import Changes, Prepared, Replace
from app.store.in_worker import open_store
from app.store.values import Version

ALIGNED = "aligned"
"""Name of the alignment step in a part's provenance."""

GRID_DERIVATIONS: Mapping[str, str] = {"objects": "objects_to_occupancy", "voxels": "voxels_to_occupancy"}
"""Derivation that turns a layer into a grid, by layer."""


@dataclass(frozen=True, slots=True)
class AlignmentRequest:
    """Request to align a grid with a target map.

    pairs: points (from, to) in metres, instead of a map. values: parameters of the derivation that turns the layer into
    a grid. angle: radians. least: minimum share that must agree.
    """

    grid: str = MAP
    level: str = GROUND
    layer: Literal["occupancy", "objects", "voxels"] = "occupancy"
    name: str = MAP
    onto_level: str = GROUND
    values: Mapping[str, Any] = field(default_factory=dict)
    pairs: tuple[tuple[tuple[float, float], tuple[float, float]], ...] = ()
    angle: float = math.pi
    reach: float | None = None
    near: float = 0.1
    least: float = 0.5
    dry_run: bool = False


@dataclass(frozen=True, slots=True)
class AlignmentResult:
    """Result of an alignment. prepared: None for a dry run in which the maps do not fit."""

    summary: dict[str, Any]
    warnings: tuple[Problem, ...]
    prepared: Prepared | None


def prepare_alignment(database_url: str, blob_dir: str, base: Version, request: AlignmentRequest) -> AlignmentResult:
    """Find the alignment of a grid and prepare the moved grid (in a worker).

    Raises NotFound (no such grid), Invalid (parameters), CannotConvert (no alignment fits well enough).
    """
    store = open_store(database_url, blob_dir)
    key = PartKey("occupancy", request.level, request.grid)
    target = PartKey("occupancy", request.onto_level, request.name)
    entries = {e.key: e for e in base.parts}
    if key not in entries:
        stored = [f"{k.level}/{k.name}" for k in sorted(entries) if k.layer == "occupancy"]
        name = f"{request.level}/{request.grid}"
        raise NotFound(f"unknown grid {name!r}{did_you_mean(name, stored)}; available: {', '.join(stored) or 'none'}")
    if not request.pairs and request.layer == "occupancy" and key == target:
        reason = "a grid cannot be aligned with itself: name another grid, a layer (objects, voxels) or pairs of points"
        raise Invalid(reason, [Problem(reason, where="body.onto")])
    if request.layer != "occupancy" and not request.pairs:
        target_keys = [k for k in entries if k.layer in (request.layer, "resources", "location")]
    else:
        target_keys = [] if request.pairs else [target]
    loaded = store.content.load(base, sorted({key, *target_keys}))
    grid = loaded.parts[key]
    assert isinstance(grid, OccupancyGrid)
    notes = DerivationNotes()
    if request.pairs:
        fit, report = _fit_by_points(request, notes)
    else:
        target_grid = (
            loaded.parts.get(target) if request.layer == "occupancy" else _derive_target(loaded, request, target, notes)
        )
        assert isinstance(target_grid, OccupancyGrid)
        fits = alignment.align_grids(grid, target_grid, angle=request.angle, reach=request.reach, near=request.near)
        fit, report = fits[0], {"others": [f.as_dict() for f in fits[1:4]]}
        if len(fits) > 1 and fits[1].score >= fit.score - 0.05:
            notes.warn("another position fits about as well (see others), for example by symmetry; set a smaller angle")
    moved = fit.move_grid(grid)
    report = {
        "grid": {"level": request.level, "name": request.grid},
        **fit.as_dict(),
        "origin": list(moved.origin),
        "before": list(grid.origin),
        **report,
    }
    if fit.score < request.least:
        reason = (
            f"the maps do not fit: at the best position {fit.score:.0%} agree within {request.near:g} m, "
            f"but {request.least:.0%} are required (least)"
        )
        if not request.dry_run:
            raise CannotConvert(f"{reason}; give pairs of points or a larger near, or inspect it with dry_run", [])
        notes.warn(reason)
    if any(k.layer in ("topology", "zones", "imagery") or (k.layer == "occupancy" and k != key) for k in entries):
        notes.warn("only the grid moves; features drawn on it in local metres keep their coordinates")
    if fit.score < request.least:
        return AlignmentResult(report, tuple(notes.warnings), None)
    old = entries[key].provenance.with_edit_step()
    provenance = replace(old, steps=(*old.steps, {"step": ALIGNED, "parameters": report}))
    prepared = store.versions.prepare(base, Changes((Replace(key, moved, provenance),)))
    return AlignmentResult(report, tuple(notes.warnings), prepared)


def previous_alignment(version: Version, request: AlignmentRequest) -> dict[str, Any] | None:
    """Read the alignment report from a version's provenance, for a repeated request."""
    for entry in version.parts:
        if entry.key == PartKey("occupancy", request.level, request.grid):
            steps = [s for s in entry.provenance.steps if s.get("step") == ALIGNED]
            return dict(steps[-1]["parameters"]) if steps else None
    return None


def _fit_by_points(request: AlignmentRequest, notes: DerivationNotes) -> tuple[alignment.Fit, dict[str, Any]]:
    fit, disagreeing, scale = alignment.fit_pairs(
        np.array(request.pairs, np.float64).reshape(-1, 2, 2), near=request.near
    )
    if disagreeing:
        notes.warn(f"{len(disagreeing)} pairs disagree with the others and are ignored: {disagreeing[:20]}")
    if abs(scale - 1.0) > 0.02:
        notes.warn(f"the second points are {scale:.3f} times as far apart as the first; check the grid's resolution")
    return fit, {"disagreeing": disagreeing, "scale": round(scale, 6)}


def _derive_target(loaded: Layers, request: AlignmentRequest, target: PartKey, notes: DerivationNotes) -> OccupancyGrid:
    """Derive a grid from the target layer."""
    step = derive.all_derivations()[GRID_DERIVATIONS[request.layer]].step()
    unknown = request.values.keys() - derive.parameter_names(step.name)
    if unknown:
        accepted = ", ".join(sorted(derive.parameter_names(step.name)))
        reason = f"unknown parameter of {step.name}; accepted: {accepted}"
        raise Invalid(reason, [Problem(reason, where=f"body.onto.parameters.{name}") for name in sorted(unknown)])
    bare = Layers({k: p for k, p in loaded.parts.items() if k.layer != "occupancy"}, loaded.datum, loaded.levels)
    derived_layers = derive.run(derive.with_parameters([step], request.values), bare, notes)
    grid = derived_layers.parts.get(PartKey("occupancy", target.level, MAP))
    if not isinstance(grid, OccupancyGrid):
        levels = ", ".join(k.level for k in derived_layers.grids())
        raise NotFound(f"{step.name} creates no grid on level {target.level}: choose one of its levels: {levels}")
    return grid
