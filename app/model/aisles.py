"""Nodes of an aisle between two rows, as in the strawberry polytunnels of Riseholme.

They are named ``r1.5-ca`` (headland before the row between rows 1 and 2), ``-cb`` (row's end), ``-c0``, ``-c1`` …,
``-cy`` (row's end), ``-cz`` (headland behind it).
"""

from __future__ import annotations


def stop_positions(low: float, high: float, turn: float, spacing: float) -> list[tuple[str, float]]:
    """Return the suffixes of an aisle's nodes and their positions along it, in metres.

    low, high: the aisle's ends in the headlands. turn: distance from there to the rows' ends. spacing: approximate
    distance of the nodes along the row.
    """
    first, last = low + turn, high - turn
    steps = max(1, round((last - first) / spacing))
    inner = [(f"c{k - 1}", first + (last - first) * k / steps) for k in range(1, steps)]
    return [("ca", low), ("cb", first), *inner, ("cy", last), ("cz", high)]
