"""`python -m tests.derive.judge FOLDER`: measure derivations on labelled maps, print the table, write the pictures."""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from tests.derive.judge import DATA, BadLabels, Result, cases, judged

OWN = Path(__file__).resolve().parents[1] / "labels"


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, prog="python -m tests.derive.judge")
    parser.add_argument("folder", nargs="?", type=Path, default=OWN, help="folder with *.labels.yaml; default: ours")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the maps that the labels name")
    parser.add_argument("--pictures", type=Path, help="folder for the results drawn over their maps")
    parser.add_argument("--kind", help="only labels of this kind")
    parser.add_argument("--only", help="only label files whose name contains this")
    parser.add_argument("--json", action="store_true", help="print JSON")
    return parser.parse_args()


def main() -> int:
    """Return 0 if every figure is within its bounds, 1 if not, 2 if labels cannot be used."""
    options = _arguments()
    try:
        chosen = [
            case
            for case in cases(options.folder, options.data)
            if options.kind in (None, case.kind) and (options.only or "") in case.name
        ]
        if not chosen:
            raise BadLabels(f"{options.folder}: no file *.labels.yaml of that kind and name")
        results = []
        for case in chosen:
            print(f"{case.kind} {case.name} …", file=sys.stderr, flush=True)
            results.append(judged(case))
    except BadLabels as e:
        print(e, file=sys.stderr)
        return 2
    if options.pictures:
        _save_pictures(results, options.pictures)
    _print(results, options.json)
    return 0 if all(result.is_kept for result in results) else 1


def _save_pictures(results: list[Result], folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for result in results:
        if result.picture is not None and result.case is not None:
            result.picture.save(folder / f"{result.case.kind}-{result.case.name}.png")


def _print(results: list[Result], as_json: bool) -> None:
    rows: list[dict[str, Any]] = [
        {
            "kind": result.case.kind,
            "case": result.case.name,
            "figure": figure.name,
            "value": None if math.isnan(figure.value) else float(figure.value),
            "unit": figure.unit,
            "bound": figure.bound,
            "kept": bool(figure.is_kept),
            "seconds": round(result.seconds, 2),
            "megabytes": round(result.megabytes, 1),
        }
        for result in results
        if result.case is not None
        for figure in result.figures
    ]
    if as_json:
        print(json.dumps(rows, indent=2))
        return
    table = Table("kind", "case", "figure", "value", "bound", "", "CPU s", "MB")
    last = None
    for row in rows:
        first = (row["kind"], row["case"]) != last
        last = (row["kind"], row["case"])
        mark = "" if not row["bound"] else ("kept" if row["kept"] else "[bold red]missed[/]")
        head = (row["kind"], row["case"]) if first else ("", "")
        tail = (f"{row['seconds']:.2f}", f"{row['megabytes']:.0f}") if first else ("", "")
        table.add_row(
            *head,
            row["figure"],
            "–" if row["value"] is None else f"{row['value']:.3g} {row['unit']}".strip(),
            row["bound"],
            mark,
            *tail,
        )
    Console(width=None if sys.stdout.isatty() else 140).print(table)


if __name__ == "__main__":
    sys.exit(main())
