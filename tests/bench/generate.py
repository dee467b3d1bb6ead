"""Generators: wave-function collapse on the paper's case, noise and automata against NumPy's own passes.

Process times, native code compiled before. *NumPy's own pass* is the same arithmetic written as NumPy expressions over
the whole array: eight shifted sums and the rule for an automaton's step, ramps and blends for Perlin noise; for all
noise also ``np.sin`` over as many values, the cheapest pass that makes a smooth field.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.errors import CannotGenerate
from app.generate import RandomSource, _automata, _kernels_noise, _kernels_wfc, _wfc
from app.generate.wave_function_collapse import SAMPLES
from app.model.grid import OCCUPIED

SEEDS = 100
SIDE = 2000
PATTERN = 5
SHARE = 0.05

Array = NDArray[np.float64]


def seconds(work: Callable[[], Any], tries: int = 5) -> float:
    """Measure the process time of the fastest of several tries, after a warm-up."""
    work()
    times = []
    for _ in range(tries):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return min(times)


def pairs(cells: NDArray[np.uint8]) -> Array:
    """Compute the shares of the pairs of neighbours, along x and along y."""
    full = (cells == OCCUPIED).astype(int)
    both = (2 * full[:, :-1] + full[:, 1:], 2 * full[:-1] + full[1:])
    return np.array([float((p == k).mean()) for p in both for k in range(4)])


def collapse() -> list[dict[str, Any]]:
    """Measure the warehouse of 5 m × 5 m → 200 × 200 and 300 × 300 tiles."""
    _kernels_wfc.compile_all()
    sample = SAMPLES["warehouse"].cells(0.05)
    rows = []
    for side in (200, 300):
        seeds = SEEDS if side == 200 else SEEDS // 10
        times, apart, share, failed = [], [], [], 0
        for seed in range(seeds):
            start = time.process_time()
            model = _wfc.learn(sample, tile=1, pattern=PATTERN, symmetry="none")
            try:
                fixed = np.full((side, side), -1)
                tiles = _wfc.collapse_model(model, (side, side), fixed, RandomSource(seed, "bench").stream, joined=True)
            except CannotGenerate:
                failed += 1
                continue
            times.append(time.process_time() - start)
            out = _wfc.render(model, tiles)
            apart.append(float(np.abs(pairs(out) - pairs(sample)).max()))
            share.append(abs(float((out == OCCUPIED).mean() - (sample == OCCUPIED).mean())))
        label = f"wave-function collapse, {side} × {side} tiles"
        row = {"peer": None, "ratio": None}
        rows += [
            {
                **row,
                "what": f"{label}: slowest of {seeds}",
                "ours": max(times),
                "unit": "s",
                "bound": "≤ 5 s" if side == 200 else "–",
                "holds": side != 200 or max(times) <= 5.0,
            },
            {
                **row,
                "what": f"{label}: seeds without contradiction",
                "ours": 100 * (1 - failed / seeds),
                "unit": "%",
                "bound": "≥ 99 %",
                "holds": failed <= seeds / 100,
            },
            {
                **row,
                "what": f"{label}: occupied, largest difference",
                "ours": 100 * max(share),
                "unit": "%",
                "bound": f"≤ {100 * SHARE:g} %",
                "holds": max(share) <= SHARE,
            },
            {
                **row,
                "what": f"{label}: neighbours, largest difference",
                "ours": 100 * max(apart),
                "unit": "%",
                "bound": f"≤ {100 * SHARE:g} %",
                "holds": max(apart) <= SHARE,
            },
        ]
    return rows


def passes() -> list[dict[str, Any]]:
    """Measure one step of an automaton and one octave of noise on SIDE × SIDE cells."""
    alive = np.random.default_rng(5).random((SIDE, SIDE)) < 0.5
    padded = np.pad(alive.astype(np.uint8), 1)

    def step() -> None:
        total = padded[:-2, :-2].copy()
        for y, x in ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1), (2, 2)):
            total += padded[y : y + SIDE, x : x + SIDE]
        np.where(alive, (total >= 4) & (total <= 8), (total >= 5) & (total <= 8))

    rule = (5, 6, 7, 8), (4, 5, 6, 7, 8)
    rows = [
        _row(
            "automaton's step: NumPy",
            seconds(step),
            seconds(lambda: _automata.run_automaton(alive, *rule, 1, outside=True)),
        )
    ]
    _kernels_noise.compile_all()
    x, y = np.linspace(0.0, 37.3, SIDE), np.linspace(0.0, 31.1, SIDE)
    order = np.random.default_rng(1).permutation(256).astype(np.uint8)
    table = np.concatenate([order, order])
    flat = np.zeros((SIDE, SIDE))
    values = np.random.default_rng(2).random((SIDE, SIDE)) * 40.0
    sine = seconds(lambda: np.sin(values))
    same = seconds(lambda: perlin(x, y, table), 2)
    for name, kernel in (("Perlin", _kernels_noise.perlin2), ("simplex", _kernels_noise.simplex2)):
        ours = seconds(lambda: kernel(x, y, table, 1.0, flat))  # noqa: B023
        if name == "Perlin":
            rows.append(_row("Perlin noise 2-D: the same in NumPy", same, ours))
        rows.append(_row(f"{name} noise 2-D: np.sin", sine, ours))
    n, z = 250, np.linspace(0.0, 9.1, SIDE * SIDE // 250**2)
    deep = np.zeros((len(z), n, n))
    for name, solid in (("Perlin", _kernels_noise.perlin3), ("simplex", _kernels_noise.simplex3)):
        ours = seconds(lambda: solid(x[:n], y[:n], z, table, 1.0, deep))  # noqa: B023
        rows.append(_row(f"{name} noise 3-D: np.sin", sine, ours))
    return rows


def perlin(x: Array, y: Array, table: NDArray[np.uint8]) -> Array:
    """Compute Perlin noise as NumPy passes over the array."""
    i, j = np.floor(x).astype(int), np.floor(y).astype(int)
    u, v = (x - i)[None], (y - j)[:, None]
    turn = np.arange(8) * math.pi / 4
    gx, gy = np.cos(turn), np.sin(turn)

    def ramp(a: int, b: int) -> Array:
        h = table[table[(i + a) & 255][None] + ((j + b) & 255)[:, None]] & 7
        return np.asarray(gx[h] * (u - a) + gy[h] * (v - b))

    s, w = (6 * q**5 - 15 * q**4 + 10 * q**3 for q in (u, v))
    low, high = (ramp(0, b) + s * (ramp(1, b) - ramp(0, b)) for b in (0, 1))
    return np.asarray(math.sqrt(2) * (low + w * (high - low)))


def _row(label: str, peer: float, ours: float) -> dict[str, Any]:
    """Build the row of a comparison with a NumPy pass: nanoseconds per cell."""
    peer, ours = (1e9 * t / SIDE**2 for t in (peer, ours))
    return {
        "what": label,
        "peer": peer,
        "ours": ours,
        "unit": "ns",
        "ratio": ours / peer,
        "bound": "≤ 2",
        "holds": ours <= 2 * peer,
    }


def rows() -> list[dict[str, Any]]:
    """Run all measurements."""
    return [*collapse(), *passes()]
