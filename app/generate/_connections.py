"""Edges of a network whose nodes were deleted, and the pieces into which it splits."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from app.derive import DerivationNotes
from app.model.features import Features
from app.model.layers import Layers, Part, PartKey


# --- the whole network ------------------------------------------------------------------------------------------
def drop_unconnected(given: Layers, parts: dict[PartKey, Part], notes: DerivationNotes) -> dict[PartKey, Part]:
    """Drop edges whose nodes were deleted, on any level; warn if the network splits into more pieces."""
    before = given.vector("topology")
    after: dict[PartKey, Features] = {}
    for key, part in before.items():
        new = parts.get(key, part)
        assert isinstance(new, Features)
        after[key] = new
    if all(after[k] is p for k, p in before.items()):
        return {}
    removed = {i for p in before.values() for i in p.ids} - {i for p in after.values() for i in p.ids}
    out: dict[PartKey, Part] = {}
    for key, part in after.items():
        lost = [
            p.get("kind") == "edge" and (p.get("source") in removed or p.get("target") in removed)
            for p in part.properties
        ]
        if any(lost):
            notes.drop("edges", sum(lost), "an obstacle covers their start or end")
            after[key] = part.select(~np.array(lost))
        if after[key] is not before[key]:
            out[key] = after[key]
    used = {
        p[end] for f in before.values() for p in f.properties if p.get("kind") == "edge" for end in ("source", "target")
    }
    was, now = (_count_components(list(f.values()), used - removed) for f in (before, after))
    if now > was:
        notes.warn(f"the network has {now} pieces now, {was} before")
    return out


def _count_components(collections: Sequence[Features], nodes: set[str]) -> int:
    """Count the pieces that these nodes of a network form."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    number = {i: k for k, i in enumerate(sorted(nodes))}
    edges = [p for f in collections for p in f.properties if p.get("kind") == "edge"]
    ends = [
        (number[p["source"]], number[p["target"]]) for p in edges if p["source"] in number and p["target"] in number
    ]
    if not nodes:
        return 0
    a, b = np.array(ends, np.int64).reshape(-1, 2).T
    graph = coo_matrix((np.ones(len(a), np.int8), (a, b)), shape=(len(nodes),) * 2)
    return int(connected_components(graph, directed=False)[0])
