"""Places of several robots' grids in one frame: which rotation and shift lays each onto the others.

Pairs of grids are searched at every angle, all shifts of an angle at once by a correlation in the frequency domain. A
position gains by walls of one grid on walls of the other, and loses by walls of one in the free space of the other: the
acceptance of Carpin, Fast and accurate map merging for multi-robot systems (2008), of walls only, since free space
agrees with itself anywhere. The best positions are refined by iterative closest points onto all grids placed so far.
Grids are placed one after the other, the best first (as by a spanning tree of the strongest pairs), then each again
onto all others, which spreads the error of loops.

A position counts only if no other fits nearly as well: a corridor slides along itself, and grids without a common area
fit in many ways.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from app.model.alignment import POINTS, Fit, angle_of, refine
from app.model.grid import OccupancyGrid
from app.model.stitching.charts import SAMPLES, Chart, Look, Tally
from app.model.stitching.lines import Target, chain, inverse, settled, slide
from app.model.stitching.search import SEARCH_CELLS, Search

MAX_GRIDS = 12
"""Maximum number of grids: each pair is searched."""

RIVAL = 0.8
"""Share of the best position's evidence at which another position makes it ambiguous."""


@dataclass(frozen=True, slots=True)
class Start:
    """A position that is known. motion: into the frame. is_exact: by pairs of points; kept if walls disagree."""

    motion: Fit
    is_exact: bool = False


@dataclass(frozen=True, slots=True)
class Bounds:
    """Bounds of a search around the stored position, or around a start.

    angle: radians. reach: metres that a grid's middle may move. None: any; around a start START_ANGLE and START_REACH.
    near: metres at which walls agree, at least one and a half cells. least: minimum share of the walls seen by both
    that agree: a metre of wall in free space outweighs least / (1 - least) metres of wall on a wall, since parallel
    walls agree by chance. overlap: minimum share of a grid's known cells that another one knows, or of the others'
    that it knows.
    """

    angle: float | None = None
    reach: float | None = None
    near: float = 0.1
    least: float = 0.9
    overlap: float = 0.1

    @property
    def conflict(self) -> float:
        """Return the weight of a metre of wall in free space against a metre of wall on a wall."""
        return self.least / max(0.01, 1.0 - self.least)


@dataclass(frozen=True, slots=True)
class Placement:
    """Where a grid lies among others.

    Attributes:
        fit: motion of the grid. agreement: of the walls that both saw, the share within ``near``. overlap: the share of
            its known cells that another grid knows. residual: metres, of the walls that agree.
        walls: metres of wall that agree.
        area: square metres that another grid knows as well.
        rivals: other positions that fit nearly as well, the best first.
        problem: why the position cannot be trusted, and what to supply; empty if it can.
        warning: a doubt about a position that is used.
    """

    fit: Fit
    walls: float = 0.0
    area: float = 0.0
    rivals: tuple[Fit, ...] = ()
    problem: str = ""
    warning: str = ""


START_ANGLE, START_REACH = math.radians(20.0), 2.0
"""Default bounds of a search around a known position: radians, metres."""

STAYS = Placement(Fit(0.0, 0.0, 0.0, 0.0, 1.0, 1.0))
"""Placement of the first grid, whose frame is everybody's."""


def place_grids(
    grids: Sequence[OccupancyGrid], bounds: Bounds, starts: Mapping[int, Start] | None = None
) -> list[Placement]:
    """Place grids in the frame of the first.

    Args:
        grids: 2 to MAX_GRIDS. Free cells with the grey of unknown ones count as unknown.
        starts: known positions by the index of the grid.

    Returns a placement for each grid in their order; those that fit nowhere, or in several ways, have a problem.
    """
    charts = [Chart(grid) for grid in grids]
    near = max(bounds.near, *(1.5 * chart.resolution for chart in charts))
    for chart in charts:
        chart.look_ahead(near)
    placer = _Placer(charts, replace(bounds, near=near), starts or {})
    return placer.run()


@dataclass(slots=True)
class _Placer:
    """The grids placed so far, and the positions to try for the others."""

    charts: Sequence[Chart]
    bounds: Bounds
    starts: Mapping[int, Start]
    placed: dict[int, Placement] = field(default_factory=lambda: {0: STAYS})
    pool: dict[int, list[Fit]] = field(default_factory=dict)

    def run(self) -> list[Placement]:
        """Place the best grid that can be trusted, until none is left."""
        newest, rest = 0, set(range(1, len(self.charts)))
        latest: dict[int, Placement] = {}
        while rest:
            for index in sorted(rest):
                self._add_candidates(index, newest)
                latest[index] = self._choose(index)
            sure = [index for index in sorted(rest) if not latest[index].problem]
            if not sure:
                break
            newest = max(sure, key=lambda index: latest[index].walls)
            self.placed[newest] = latest[newest]
            rest.discard(newest)
        if not rest:
            self._settle()
        return [self.placed.get(index) or latest[index] for index in range(len(self.charts))]

    def _bounds_of(self, index: int) -> tuple[Fit, float, float]:
        """Return (start, maximum angle, maximum shift) of a grid's search."""
        start, angle, reach = self.starts.get(index), self.bounds.angle, self.bounds.reach
        if start is None:
            return STAYS.fit, math.pi if angle is None else angle, math.inf if reach is None else reach
        return start.motion, START_ANGLE if angle is None else angle, START_REACH if reach is None else reach

    def _is_allowed(self, index: int, fit: Fit) -> bool:
        start, angle, reach = self._bounds_of(index)
        middle = self.charts[index].middle[None]
        shift = float(np.linalg.norm(fit.apply_to(middle) - start.apply_to(middle)))
        return abs(angle_of(fit.yaw - start.yaw)) <= angle + 1e-3 and shift <= reach + self.bounds.near

    def _add_candidates(self, index: int, newest: int) -> None:
        """Search for positions of a grid on one that has just been placed."""
        pool = self.pool.setdefault(index, [])
        moving, onto = self.charts[index], self.charts[newest]
        if index in self.starts and not pool:
            pool.append(self.starts[index].motion)
        if len(moving.outline) < 3 or len(onto.outline) < 3:
            return
        place = self.placed[newest].fit
        start, angle, reach = self._bounds_of(index)
        start = chain(start, inverse(place))  # into the frame of the other grid
        if moving.radius <= onto.radius or math.isfinite(reach):
            fits: Iterator[Fit] = iter(Search(moving, onto, self.bounds.near, start, angle, reach).positions())
        else:
            search = Search(onto, moving, self.bounds.near, inverse(start), angle, math.inf)
            fits = (inverse(fit) for fit in search.positions())
        pool += [chain(fit, place) for fit in fits]

    def _choose(self, index: int) -> Placement:
        """Return the best position of a grid among those placed, with its problem if it cannot be trusted."""
        chart, near = self.charts[index], self.bounds.near
        problem = self._lack(index)
        if problem:
            return Placement(STAYS.fit, problem=problem)
        target = self._walls_of(self.placed)
        tree = target.tree
        sample = chart.lines.some(POINTS).points
        wide = max(3 * near, 2 * chart.radius / SEARCH_CELLS)
        tried: list[tuple[float, Placement]] = []
        for candidate in self.pool[index]:
            fit = slide(refine(candidate, sample, tree, wide, near), sample, target, near)
            if self._is_allowed(index, fit):
                tried.append(self._judge(index, fit))
        tried.sort(key=lambda row: -row[0])
        return self._decide(index, self._distinct(index, tried))

    def _lack(self, index: int) -> str:
        """Return why a grid cannot be matched at all."""
        for chart, role in ((self.charts[index], "the grid"), (self.charts[0], "the first grid")):
            if len(chart.outline) < 3:
                if self.starts.get(index, Start(STAYS.fit)).is_exact:
                    return ""
                return (
                    f"{role} has {len(chart.outline)} occupied border cells, and at least 3 are required to match it: "
                    "give pairs of points"
                )
        return ""

    def _walls_of(self, placed: Mapping[int, Placement], but: int = -1) -> Target:
        return Target([self.charts[k].lines.some(20_000).moved(p.fit) for k, p in placed.items() if k != but])

    def _judge(self, index: int, fit: Fit) -> tuple[float, Placement]:
        """Measure a position of a grid against all placed ones: (evidence in metres of wall, placement)."""
        chart, tally = self.charts[index], Tally(self.bounds.near)
        onto_this, seen = inverse(fit), fit.apply_to(chart.seen)
        shared = np.zeros(len(seen), bool)
        on_others = Look.nowhere(len(chart.walls))
        for k, place in self.placed.items():
            if k == index:
                continue
            other, back = self.charts[k], inverse(place.fit)
            on_others.join(chart.look_from(other, chain(fit, back)))
            shared |= other.look_up(back.apply_to(seen))[2]
            tally.add(other.look_from(chart, chain(place.fit, onto_this)), other.metres_of_sample)
        tally.add(on_others, chart.metres_of_sample)
        share = tally.agree / (tally.agree + tally.conflict) if tally.agree else 0.0
        overlap = float(shared.mean()) if len(shared) else 0.0
        residual = math.sqrt(tally.squares / tally.agree) if tally.agree else math.inf
        measured = replace(fit, residual=residual, agreement=share, overlap=overlap)
        evidence = tally.agree - self.bounds.conflict * tally.conflict
        return evidence, Placement(measured, tally.agree, overlap * chart.seen_area)

    def _smaller_area(self, index: int) -> float:
        others = sum(self.charts[k].seen_area for k in self.placed if k != index)
        return max(min(self.charts[index].seen_area, others), 1e-9)

    def _distinct(self, index: int, tried: list[tuple[float, Placement]]) -> list[tuple[float, Placement]]:
        """Keep the best of positions that are the same one."""
        chart, out = self.charts[index], list[tuple[float, Placement]]()
        apart = max(5 * self.bounds.near, 0.02 * chart.radius)
        middle = chart.middle[None]
        for evidence, place in tried:
            moved = place.fit.apply_to(middle)
            if not any(
                abs(angle_of(place.fit.yaw - o.fit.yaw)) < math.radians(5)
                and np.linalg.norm(moved - o.fit.apply_to(middle)) < apart
                for _, o in out
            ):
                out.append((evidence, place))
        return out

    def _decide(self, index: int, tried: list[tuple[float, Placement]]) -> Placement:
        """Return the best position, with the reason if it cannot be trusted."""
        start = self.starts.get(index)
        if start is not None and start.is_exact:
            return self._decide_exact(index, start, tried)
        if not tried or tried[0][1].walls <= 0.0:
            return Placement(
                STAYS.fit, problem="it fits nowhere within this angle and reach: give pairs or a larger reach"
            )
        (evidence, best), rest = tried[0], tried[1:]
        rivals = [place for worth, place in rest if worth >= RIVAL * evidence]
        best = replace(best, rivals=tuple(place.fit for place in rivals[:3]))
        share = f"{best.fit.agreement:.0%} of the walls that both saw agree there ({best.walls:.1f} m)"
        if evidence <= 0.0 or best.fit.agreement < self.bounds.least:
            reason = f"no position fits: at the best one {share}, and {self.bounds.least:.0%} are required (least)"
            return replace(best, problem=f"{reason}; the common area is too small: give pairs of points")
        common = best.area / self._smaller_area(index)
        if common < self.bounds.overlap:
            reason = f"the best position has {common:.1%} of its cells in common with the others ({share})"
            return replace(
                best, problem=f"{reason}, and {self.bounds.overlap:.0%} are required (overlap): give pairs of points"
            )
        if not rivals:
            return best
        if start is None:
            reason = f"{len(rivals) + 1} positions fit nearly as well: {share}, but the others come close"
            hint = "the common area is too small or repeats itself: give pairs, a pose, or a smaller reach and angle"
            return replace(best, problem=f"{reason}; {hint}")
        middle = self.charts[index].middle[None]
        aim = start.motion.apply_to(middle)
        every = [best, *rivals]
        first = min(every, key=lambda place: float(np.linalg.norm(place.fit.apply_to(middle) - aim)))
        others = tuple(place.fit for place in every if place is not first)[:3]
        return replace(first, rivals=others, warning="other positions fit as well; the one nearest to its pose is used")

    def _decide_exact(self, index: int, start: Start, tried: list[tuple[float, Placement]]) -> Placement:
        """Return the position by pairs of points, refined by walls where they agree."""
        given = self._judge(index, start.motion)
        limit = max(0.5, 5 * self.bounds.near)
        middle = self.charts[index].middle[None]
        for evidence, place in tried:
            shift = float(np.linalg.norm(place.fit.apply_to(middle) - start.motion.apply_to(middle)))
            turn = abs(angle_of(place.fit.yaw - start.motion.yaw))
            good = place.fit.agreement >= self.bounds.least and evidence >= given[0]
            if shift <= limit and turn <= math.radians(5) and good:
                return place
        doubt = "the walls do not confirm the position by its pairs of points, which is used as it is"
        return replace(given[1], warning=doubt if given[1].fit.agreement < self.bounds.least else "")

    def _settle(self) -> None:
        """Move all grids at once to where the walls of each two agree best, which spreads the error of loops."""
        fixed = {k for k, place in self.placed.items() if k == 0 or place.warning or not len(self.charts[k].outline)}
        before = {k: place.fit for k, place in self.placed.items()}
        lines = {k: self.charts[k].lines.some(SAMPLES) for k in before}
        after = settled(before, lines, fixed, self.bounds.near)
        old, new = sum(self._judge(k, before[k])[0] for k in before), 0.0
        for k in before:
            self.placed[k] = replace(self.placed[k], fit=after[k])
        # counts of cells within a distance are coarser than the fit: a little less is no worse
        new = sum(self._judge(k, after[k])[0] for k in before)
        chosen = after if new >= 0.97 * old and all(self._is_allowed(k, after[k]) for k in before) else before
        for k in before:
            self.placed[k] = replace(self.placed[k], fit=chosen[k])
        for k in set(before) - {0}:
            place, measured = self.placed[k], self._judge(k, chosen[k])[1]
            self.placed[k] = replace(measured, rivals=place.rivals, warning=place.warning)
