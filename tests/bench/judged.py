"""Time and memory of derivations on the labelled maps, beside those of another checkout of this project.

    python -m tests.bench.judged --before ../before --kind scan --rounds 3
    python -m tests.bench.judged --before ../before --made-up --pictures docs/images

Each round runs a process in each checkout in turn, with the other checkout's own ``.venv``. A process derives once so
that native code is compiled, then measures the CPU of at least five runs; the fastest of all rounds counts. Memory is
the peak of ``tracemalloc`` in one more run: arrays and objects of Python, not what compiled code allocates by itself.

With ``--pictures`` nothing is measured: what both checkouts derive is drawn side by side.
"""

from __future__ import annotations

import argparse
import json
import os
import pickle
import subprocess
import sys
import tempfile
import time
import tracemalloc
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parents[2]
RUNS, SECONDS = 5, 1.0
"""Minimum number of runs of a process, and of seconds that they take together."""

Case = tuple[str, str, str, Any]
"""Kind of label, name, derivation or generator, layers."""


def _cases(kind: str | None, only: str, data: Path | None) -> Iterator[Case]:
    """Yield what the judge derives."""
    from app.model.layers import MAP, Layers, PartKey
    from tests.derive import judge
    from tests.derive.judge import aerial, completion, plan, rooms, scan
    from tests.derive.judge.__main__ import OWN

    for case in judge.cases(OWN, data or judge.DATA):
        if kind not in (None, case.kind) or only not in case.name:
            continue
        try:
            if case.kind == "scan":
                layers = Layers({PartKey("occupancy", "ground", MAP): scan.read_grid(case)[1]})
                yield case.kind, case.name, "occupancy_to_objects", layers
            elif case.kind in ("plan", "aerial"):
                picture = (plan if case.kind == "plan" else aerial).read_picture(case)
                layers = Layers({PartKey("imagery", "ground", case.kind): picture})
                for step in ("imagery_to_occupancy", "imagery_to_objects"):
                    yield case.kind, case.name, step, layers
            elif case.kind == "rooms":
                yield case.kind, case.name, "occupancy_to_zones", rooms.read_layers(case)[0]
            elif case.kind == "completion":
                grid = completion.read_grid(case)
                hole, _ = completion.holes(grid, case.labels["seed"])[0]
                layers = Layers({completion.KEY: completion.cut(grid, hole)})
                yield case.kind, case.name, "complete_grid", layers
        except judge.BadLabels as error:
            print(f"not measured: {error}", file=sys.stderr)


def _made_up() -> Iterator[Case]:
    """Yield what docs/images/derived-maps.png shows."""
    from tests.bench import made_up_maps

    for title, step, layers in made_up_maps.cases():
        yield "made-up", title, step, layers


def _run(checkout: Path, *arguments: str) -> str:
    """Run this file as a process in a checkout, and return what it prints."""
    python = checkout / ".venv" / "bin" / "python"
    command = [str(python if checkout != HERE else sys.executable), "-P", __file__, *arguments]
    env = {**os.environ, "PYTHONPATH": str(checkout)}
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=checkout, env=env)
    if done.returncode:
        raise RuntimeError(f"{checkout} {arguments[0]}: {done.stderr[-2000:]}")
    return done.stdout


def _measure(checkout: Path, step: str, path: Path) -> dict[str, float]:
    figures: dict[str, float] = json.loads(_run(checkout, step, str(path)))
    return figures


def _derive(step: str, path: Path, result: Path) -> None:
    """Derive and store what a picture shows of it, free of a checkout's classes. This runs in either checkout."""
    from app import derive, generate
    from app.derive import DerivationNotes
    from app.errors import FleetMapError
    from app.model.features import Features

    layers = pickle.loads(path.read_bytes())
    derivation = derive.all_derivations().get(step)
    if derivation is None and step != "complete_grid":
        result.write_bytes(pickle.dumps({"fault": "not derived"}))
        return
    try:
        if derivation is None:
            derived = generate.run(step, 7, {}, layers, DerivationNotes())
        else:
            derived = derivation.function(layers, derivation.parameters(), DerivationNotes())
    except FleetMapError as error:
        result.write_bytes(pickle.dumps({"fault": str(error)}))
        return
    (part,) = derived.parts.values()
    if isinstance(part, Features):
        rows = [(shape, dict(words)) for shape, words in zip(part.geometry, part.properties, strict=True)]
        result.write_bytes(pickle.dumps({"rows": rows}))
    else:
        result.write_bytes(pickle.dumps({"cells": part.cells}))


def _draw(chosen: Iterator[Case], checkouts: list[Path], folder: Path, *, is_made_up: bool) -> None:
    """Draw all cases; made-up ones as one picture."""
    from tests.bench import judged_pictures

    folder.mkdir(parents=True, exist_ok=True)
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        path, result = Path(scratch) / "layers", Path(scratch) / "result"
        for kind, name, step, layers in chosen:
            path.write_bytes(pickle.dumps(layers))
            columns = []
            for checkout, label in zip(checkouts, ["before", "now"][-len(checkouts) :], strict=True):
                _run(checkout, step, str(path), str(result))
                columns.append((label, pickle.loads(result.read_bytes())))
            title = name if is_made_up else f"{name}: {step}"
            row = judged_pictures.side_by_side(title, layers, columns)
            if is_made_up:
                rows.append(row)
            else:
                row.save(folder / f"{kind}-{name}-{step}.png")
            print(f"{name} {step}", file=sys.stderr, flush=True)
    if rows:
        judged_pictures.stack(rows).save(folder / "derived-maps.png", optimize=True)


def _child(step: str, path: Path) -> None:
    """Derive and print figures. This runs in either checkout, so it imports little."""
    from app import derive, generate
    from app.derive import DerivationNotes
    from app.errors import CannotGenerate

    layers = pickle.loads(path.read_bytes())
    derivation = derive.all_derivations().get(step)

    def run() -> None:
        try:
            if derivation is None:
                generate.run(step, 7, {}, layers, DerivationNotes())
            else:
                derivation.function(layers, derivation.parameters(), DerivationNotes())
        except CannotGenerate:
            pass  # nothing is certain: all stays unknown

    run()
    times: list[float] = []
    while len(times) < RUNS or sum(times) < SECONDS:
        start = time.process_time()
        run()
        times.append(time.process_time() - start)
    tracemalloc.start()
    run()
    print(json.dumps({"ms": min(times) * 1e3, "mb": tracemalloc.get_traced_memory()[1] / 1e6}))


def main() -> int:
    """Print a row for each derivation: CPU in milliseconds and memory in megabytes, before and now."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--before", type=Path, help="folder of the other checkout")
    parser.add_argument("--kind", help="only labels of this kind")
    parser.add_argument("--only", default="", help="only labels whose name contains this")
    parser.add_argument("--data", type=Path, help="folder of the maps that the labels name")
    parser.add_argument("--rounds", type=int, default=3, help="number of processes in each checkout")
    parser.add_argument("--made-up", action="store_true", help="made-up maps instead of labelled ones")
    parser.add_argument("--pictures", type=Path, help="folder for pictures of what is derived before and now")
    options = parser.parse_args()
    checkouts = [HERE] if options.before is None else [options.before.resolve(), HERE]
    chosen = _made_up() if options.made_up else _cases(options.kind, options.only, options.data)
    if options.pictures:
        _draw(chosen, checkouts, options.pictures, is_made_up=options.made_up)
        return 0
    print("| kind | map | derivation | CPU ms, before | now | ratio | peak MB, before | now |")
    print("| --- | --- | --- | ---: | ---: | ---: | ---: | ---: |")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "layers"
        for kind, name, step, layers in chosen:
            path.write_bytes(pickle.dumps(layers))
            rounds = [[_measure(at, step, path) for at in checkouts] for _ in range(options.rounds)]
            best = [min(figures["ms"] for figures in column) for column in zip(*rounds, strict=True)]
            peaks = [figures["mb"] for figures in rounds[-1]]
            ratio = f"{best[-1] / best[0]:.2f}"
            cells = [f"{best[0]:.1f}", f"{best[-1]:.1f}", ratio, f"{peaks[0]:.1f}", f"{peaks[-1]:.1f}"]
            print(f"| {kind} | `{name}` | `{step}` | {' | '.join(cells)} |", flush=True)
    return 0


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    if len(sys.argv) in (3, 4) and not sys.argv[1].startswith("-"):
        (_child if len(sys.argv) == 3 else _derive)(sys.argv[1], *map(Path, sys.argv[2:]))
    else:
        sys.exit(main())
