"""Frame of a site of a given size: at the origin, or inside the environment's fence."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely

from app.errors import CannotGenerate, Problem
from app.generate._shapes import angle, mm
from app.generate._site import Site


@dataclass(frozen=True, slots=True)
class SiteFrame:
    """Frame in which a site was drawn: its origin in local metres and its rotation.

    sine, cosine: of the rotation, rounded, so that every machine gives the same positions.
    """

    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0
    sine: float = 0.0
    cosine: float = 1.0

    def to_local(self, u: float, v: float) -> tuple[float, float]:
        """Convert a drawn position to local metres."""
        return mm(self.x + self.cosine * u - self.sine * v), mm(self.y + self.sine * u + self.cosine * v)

    def geometry_to_local(self, geometry: Any) -> Any:
        """Convert a drawn geometry to local metres."""
        turn = np.array([[self.cosine, self.sine], [-self.sine, self.cosine]])

        def moved(xy: Any) -> Any:
            u, v = xy[:, :1], xy[:, 1:]
            return np.round(u * turn[0] + v * turn[1] + np.array([self.x, self.y]), 3) + 0.0

        return shapely.transform(geometry, moved)


def place_site(site: Site, width: float, depth: float, margin: float, room: float = math.inf) -> SiteFrame:
    """Bound the site to a rectangle of this size with a margin around it, or place it into the given fence.

    room: minimum distance in metres beside a robot (``Site.set_fence``). The drawn rectangle extends from (0, 0) to
    (width, depth). In a given fence it is along the fence's longer side if it fits, else across it or along the axes.
    Raises CannotGenerate if the fence has no room for it.
    """
    outline = shapely.box(-margin, -margin, width + margin, depth + margin)
    fence = site.set_fence(outline, room=room)
    if not site.is_given:
        return SiteFrame()
    shapely.prepare(fence)
    for yaw in _turns(fence):
        s, c = round(math.sin(yaw), 12), round(math.cos(yaw), 12)
        for middle in _middles(fence):
            x = middle[0] - (c * width - s * depth) / 2
            y = middle[1] - (s * width + c * depth) / 2
            place = SiteFrame(mm(x), mm(y), angle(yaw), s, c)
            if shapely.contains(fence, place.geometry_to_local(outline)):
                return place
    need = f"{width + 2 * margin:.1f} × {depth + 2 * margin:.1f} m"
    problem = f"the fence has no room for the site, which needs {need}: make the site smaller, or the fence wider"
    raise CannotGenerate(problem, [Problem(problem, where="fence")])


def _turns(fence: Any) -> list[float]:
    """Yield directions to try: along the fence's longer side, across it, and the axes."""
    corners = shapely.get_coordinates(shapely.minimum_rotated_rectangle(fence))
    if len(corners) < 4:
        return [0.0]
    a, b = corners[1] - corners[0], corners[2] - corners[1]
    long = a if float(a @ a) >= float(b @ b) else b
    yaw = math.atan2(float(long[1]), float(long[0]))
    yaw = round(math.remainder(yaw, math.pi), 6)  # the long side, not upside down
    return [yaw, yaw + math.pi / 2, 0.0, math.pi / 2]


def _middles(fence: Any) -> list[tuple[float, float]]:
    """Yield positions to try for the centre: the fence's own, and that of the largest circle in it."""
    circle = shapely.maximum_inscribed_circle(fence, tolerance=0.5)
    box = shapely.minimum_rotated_rectangle(fence)
    points = [shapely.centroid(box), shapely.centroid(fence), shapely.Point(shapely.get_coordinates(circle)[0])]
    return [(round(p.x, 3), round(p.y, 3)) for p in points]
