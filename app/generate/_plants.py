"""Plants for sites: species as L-systems, grown into meshes that simulators show.

A plant consists of a mesh of wood (branches as tapering prisms) and one of green (leaves), in OBJ and without
collision, and a cylinder that robots collide with: its trunk, or almost all of a bush. Sites call ``grow_plants`` for a
few plants of a species and place them scaled and turned as often as they like.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from app.errors import CannotGenerate, Problem
from app.generate import RandomSource, _lsystem

Array = NDArray[np.float64]

MAX_VARIANTS = 16
VERTEX_DECIMALS = 4
"""Decimals of a metre of a mesh's vertices: coarse enough to hide the last bits of a machine's sine, fine for twigs."""

MIN_BRANCH_METRES = 0.001
"""Radius of the thinnest drawn twig in metres."""


@dataclass(frozen=True, slots=True)
class Species:
    """Species of plant. rules and iterations: its L-system. body: the part that a robot collides with."""

    kind: str
    rules: str
    iterations: int
    body: Literal["trunk", "crown"] = "trunk"


APPLE = r"""
# A spindle as it stands in orchards: a leader with scaffold branches that bear fruit.
leaf = 0.15
axiom: !(0.05) F(0.6, 0.046) T(0.95, 0.045)
T(l, w) : w > 0.016 -> [ X(l, w * 0.55) ] /(rand(125, 150)) [ X(l * 0.9, w * 0.5) ] /(rand(100, 140)) U(l, w)
U(l, w) -> F(rand(0.17, 0.22), w * 0.9) [ X(l * 0.8, w * 0.5) ] /(rand(60, 90)) F(rand(0.17, 0.22), w * 0.8) V(l, w)
V(l, w) -> T(l * 0.84, w * 0.8)
T(l, w) : w <= 0.016 -> B(l * 1.2, w)
X(l, w) -> &(rand(60, 80)) $ B(l, w)
B(l, w) : l > 0.35 -> !(w) F(l * 0.35, w * 0.8) Y(0) [
    +(rand(30, 55)) ^(rand(-10, 25)) B(l * 0.6, w * 0.55) ] F(l * 0.25, w * 0.65) Y(90) [
    -(rand(30, 55)) ^(rand(-10, 25)) B(l * 0.55, w * 0.5) ] ^(rand(4, 14)) B(l * 0.6, w * 0.6)
B(l, w) : l <= 0.35 @ 4 -> !(w) F(l * 0.6, w * 0.5) Y(0) Y(90) ^(20) L(leaf)
B(l, w) : l <= 0.35 @ 1 -> !(w) F(l * 0.6, w * 0.5) Y(45) L(leaf) &(70) O(0.037)
Y(a) -> [ /(a) +(rand(40, 70)) L(leaf * rand(0.8, 1.2)) ] [ /(a) -(rand(40, 70)) L(leaf * rand(0.8, 1.2)) ]
"""

VINE = r"""
# A vine on wires along x: a trunk, two cordons, and shoots that grow upright from them.
axiom: !(0.025) F(0.85, 0.02) [ /(90) &(90) C(6) ] [ /(90) ^(90) C(6) ]
C(n) : n > 0 -> !(0.004 + n * 0.002) F(rand(0.09, 0.12)) [ U(rand(-20, 20)) S(rand(5, 8)) ] C(n - 1)
U(a) -> $ ^(90) +(a)
S(n) : n > 0 -> !(0.002 + n * 0.0004) F(rand(0.09, 0.13)) [
    /(rand(0, 360)) &(rand(50, 80)) L(rand(0.13, 0.18)) ] +(rand(-6, 6)) &(rand(-6, 6)) S(n - 1)
S(n) : n <= 0 @ 3 -> L(0.1)
S(n) : n <= 0 @ 1 -> &(120) O(0.05)
"""

BUSH = r"""
# Stems from one root that fork again and again.
axiom: !(0.016) K(7)
K(n) : n > 0 -> [ /(n * 51 + rand(0, 40)) &(rand(12, 50)) S(0.34, 0.016) ] K(n - 1)
S(l, w) : l > 0.12 -> !(w) F(l * rand(0.7, 1.1), w * 0.75) [
    +(rand(15, 40)) /(rand(0, 180)) S(l * 0.7, w * 0.7) ] [
    -(rand(15, 40)) /(rand(0, 180)) S(l * 0.7, w * 0.7) ] [ /(rand(0, 360)) &(60) L(0.12) ]
S(l, w) : l <= 0.12 -> !(w) F(l, w * 0.6) [ +(55) L(0.12) ] [ -(55) L(0.12) ] L(0.13)
"""

PINE = r"""
# A straight stem with whorls of five boughs, the higher the shorter.
axiom: !(0.13) F(1.2, 0.12) W(14)
W(n) : n > 0 -> P(n) P(n) P(n) P(n) P(n) /(rand(20, 50)) F(0.28 + n * 0.02, n * 0.0085) W(n - 1)
W(n) : n <= 0 -> F(0.3, 0.002) L(0.25)
P(n) -> [ &(rand(86, 100)) $ B(0.16 * n + rand(0.15, 0.3), 0.004 + n * 0.002) ] /(rand(68, 76))
B(l, w) -> !(w) F(l * 0.4, w * 0.8) M(l * 0.5) F(l * 0.2, w * 0.7) ^(4) M(l * 0.42) F(l * 0.2, w * 0.5) ^(4) E(l * 0.3)
E(l) -> M(l) N(l)
M(l) -> [ +(rand(34, 48)) N(l) ] [ -(rand(34, 48)) N(l) ]
N(l) -> [ L(l) ] [ +(16) L(l * 0.7) ] [ -(16) L(l * 0.7) ]
"""

SPECIES: Mapping[str, Species] = {
    "apple": Species("tree", APPLE, 22),
    "vine": Species("plant", VINE, 18),
    "bush": Species("bush", BUSH, 12, "crown"),
    "pine": Species("tree", PINE, 22),
}
"""Species that sites can use, in natural sizes: a spindle of 3 m, a vine of 1.7 m, a bush of 1 m, a pine of 7 m."""


@dataclass(frozen=True, slots=True)
class Plant:
    """Grown plant with its root at the origin, in metres.

    files: its meshes by path among the resources. body: radius and height of the cylinder that robots collide with.
    height: of its top. spread: its maximum distance from the stem.
    """

    name: str
    kind: str
    files: Mapping[str, bytes]
    body: tuple[float, float]
    height: float
    spread: float
    meshes: tuple[tuple[str, tuple[float, float, float]], ...]

    def shapes(self, scale: float = 1.0) -> list[dict[str, Any]]:
        """Return the plant's solids (``app.model.solids``), scaled: the cylinder, then the visual shapes."""
        radius, length = (round(v * scale, 3) for v in self.body)
        pose = [0.0, 0.0, round(length / 2, 4), 0.0, 0.0, 0.0]
        out: list[dict[str, Any]] = [
            {"type": "cylinder", "radius": radius, "length": length, "pose": pose, "unseen": True}
        ]
        size = [round(scale, 6)] * 3
        for file, colour in self.meshes:
            out.append({"type": "mesh", "file": file, "scale": size, "visual": True, "colour": list(colour)})
        return out


def grow_plants(species: str, count: int, source: RandomSource) -> list[Plant]:
    """Grow a number of different plants of a species of ``SPECIES``; the same for the same random source."""
    plant_species = SPECIES[species]
    system = _lsystem.parse(plant_species.rules)
    budget = _lsystem.Budget()
    out = []
    for k in range(count):
        chance = source.stream(f"plant/{species}/{k}")
        out.append(grow(system, plant_species, f"{species}_{k + 1}", chance, budget))
    return out


def grow(
    system: _lsystem.System,
    species: Species,
    name: str,
    chance: np.random.Generator,
    budget: _lsystem.Budget | None = None,
    *,
    angle: float = 25.0,
    length: float = 0.1,
    radius: float = 0.01,
) -> Plant:
    """Grow a plant of an L-system. name: of its directory. Raises CannotGenerate if it explodes or draws nothing."""
    symbols = _lsystem.expand(system, species.iterations, chance, budget)
    drawing = _lsystem.draw(symbols, angle=angle, length=length, radius=radius)
    if not drawing.branches:
        problem = "the L-system draws no branch: its result contains no F"
        raise CannotGenerate(f"{problem}; use more rounds, or draw in its rules", [Problem(problem, where="rules")])
    wood = _prisms(drawing.branches)
    green = _blades(drawing.leaves)
    fruit = _balls(drawing.fruit)
    meshes = []
    files = {}
    for part, triangles, colour in (
        ("wood", wood, (0.4, 0.28, 0.18)),
        ("leaves", green, (0.25, 0.5, 0.18)),
        ("fruit", fruit, (0.75, 0.15, 0.12)),
    ):
        if len(triangles):
            path = f"models/{name}/meshes/{part}.obj"
            files[path] = obj(triangles, part)
            meshes.append((path, colour))
    everything = np.concatenate([wood.reshape(-1, 3), green.reshape(-1, 3), fruit.reshape(-1, 3)])
    spread = float(np.sqrt((everything[:, :2] ** 2).sum(axis=1).max()))
    height = max(0.01, float(everything[:, 2].max()))
    if species.body == "crown":
        body = (0.7 * spread, 0.9 * height)
    else:
        body = (max(MIN_BRANCH_METRES, drawing.branches[0][2], drawing.branches[0][3]), drawing.stem or height)
    body = (max(0.001, round(body[0], 3)), max(0.01, round(body[1], 3)))
    return Plant(name, species.kind, files, body, round(height, 3), round(spread, 3), tuple(meshes))


# --- meshes ----------------------------------------------------------------------------------------------------------

_NONE: Array = np.empty((0, 3, 3))


def _prisms(branches: Sequence[Any]) -> Array:
    """Return branches as closed tapering prisms of 3, 5 or 8 sides: float64 [n, 3, 3], outside counter-clockwise."""
    if not branches:
        return _NONE
    start, end, left, up = (np.array([b[k] for b in branches], np.float64) for k in (0, 1, 4, 5))
    radii = np.maximum(np.array([(b[2], b[3]) for b in branches], np.float64), MIN_BRANCH_METRES)
    thickest = radii.max(axis=1)
    long = ((end - start) ** 2).sum(axis=1) > 1e-12
    out = []
    for sides, some in (
        (8, thickest >= 0.03),
        (5, (thickest < 0.03) & (thickest >= 0.01)),
        (3, thickest < 0.01),
    ):
        chosen = np.flatnonzero(some & long)
        if not len(chosen):
            continue
        turn = [2.0 * math.pi * k / sides for k in range(sides)]
        around = np.array([(round(math.cos(a), 12), round(math.sin(a), 12)) for a in turn])
        # from left to up is counter-clockwise, seen from the tip
        rim = left[chosen, None] * around[None, :, :1] + up[chosen, None] * around[None, :, 1:]
        low = start[chosen, None] + rim * radii[chosen, None, None, 0]
        high = end[chosen, None] + rim * radii[chosen, None, None, 1]
        low_next, high_next = np.roll(low, -1, axis=1), np.roll(high, -1, axis=1)
        faces = [np.stack([low, low_next, high_next], axis=2), np.stack([low, high_next, high], axis=2)]
        for rim_, back in ((low, True), (high, False)):
            fan = np.stack([np.repeat(rim_[:, :1], sides - 2, axis=1), rim_[:, 1:-1], rim_[:, 2:]], axis=2)
            faces.append(fan[:, :, ::-1] if back else fan)
        out.append(np.concatenate(faces, axis=1).reshape(-1, 3, 3))
    return _round_triangles(np.concatenate(out)) if out else _NONE


def _blades(leaves: Sequence[Any]) -> Array:
    """Return leaves as rhombs, visible from both sides."""
    if not leaves:
        return _NONE
    at, heading, left = (np.array([leaf[k] for leaf in leaves], np.float64) for k in (0, 1, 2))
    size = np.array([leaf[3] for leaf in leaves], np.float64)[:, None]
    middle = at + heading * size * 0.45
    a, b, c, d = at, middle + left * size * 0.25, at + heading * size, middle - left * size * 0.25
    faces = [np.stack(corners, axis=1) for corners in ((a, b, c), (a, c, d), (a, c, b), (a, d, c))]
    return _round_triangles(np.stack(faces, axis=1).reshape(-1, 3, 3))


def _balls(fruit: Sequence[Any]) -> Array:
    """Return fruit as octahedra that hang from their position."""
    if not fruit:
        return _NONE
    radius = np.array([f[1] for f in fruit], np.float64)[:, None, None, None]
    middle = np.array([f[0] for f in fruit], np.float64)[:, None, None] - radius * np.array([0.0, 0.0, 1.0])
    axes = np.eye(3)
    faces = []
    for x in (1, -1):
        for y in (1, -1):
            for z in (1, -1):
                corners = [axes[0] * x, axes[1] * y, axes[2] * z]
                faces.append(corners if x * y * z > 0 else corners[::-1])
    return _round_triangles((middle + radius * np.array(faces)[None]).reshape(-1, 3, 3))


def _round_triangles(triangles: Array) -> Array:
    """Round to a tenth of a millimetre; triangles without area are dropped."""
    out = np.round(triangles, VERTEX_DECIMALS) + 0.0
    normal = np.cross(out[:, 1] - out[:, 0], out[:, 2] - out[:, 0])
    return np.asarray(out[(normal != 0).any(axis=1)], np.float64)


def obj(triangles: Array, name: str) -> bytes:
    """Write triangles float64 [n, 3, 3] as an OBJ file, equal vertices once."""
    fine = np.round(triangles.reshape(-1, 3) * 10**VERTEX_DECIMALS).astype(np.int64)
    corners, index = np.unique(fine, axis=0, return_inverse=True)
    index = index.reshape(-1, 3) + 1
    lines: list[str] = [f"o {name}"]
    lines += [f"v {_decimal(x)} {_decimal(y)} {_decimal(z)}" for x, y, z in corners.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in index.tolist()]
    return ("\n".join(lines) + "\n").encode()


def _decimal(steps: int) -> str:
    """Write an integer of the finest steps in metres, without trailing zeros."""
    sign, steps = ("-", -steps) if steps < 0 else ("", steps)
    integer, rest = divmod(steps, 10**VERTEX_DECIMALS)
    return f"{sign}{integer}.{rest:0{VERTEX_DECIMALS}d}".rstrip("0").rstrip(".")


def mesh_files(plants: Iterable[Plant]) -> dict[str, bytes]:
    """Return the meshes of all these plants: the content of a site's ``Resources``."""
    return {path: data for plant in plants for path, data in sorted(plant.files.items())}
