"""Match re-uploaded features with new ids to the head by geometry, to keep ids stable and diffs small."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import shapely

from app.model.features import Features
from app.model.layers import PartKey
from app.store.store import Store
from app.store.values import Version


def match_ids(store: Store, base: Version, key: PartKey, new: Features) -> Features:
    """Give new features the ids of equal head features that the upload no longer contains.

    Features whose id exists in the head keep it, and so do those whose id is a name given by people (a renamed waypoint
    is another waypoint to the robots). Any other feature takes the id of a head feature that the upload does not
    contain, if kind, anchor and geometry are equal and the pair is unique at its position; an edge must also join the
    same nodes.
    """
    stored = store.content.load(base, [key]).parts.get(key)
    if not isinstance(stored, Features) or not len(stored) or not len(new):
        return new
    stored_ids, present = set(stored.ids), set(new.ids)
    strange = [k for k, i in enumerate(new.ids) if i not in stored_ids and new.properties[k].get("name") != i]
    missing = [k for k, i in enumerate(stored.ids) if i not in present]
    renamed: dict[str, str] = {}
    for edges in (False, True):  # edges last: they need the ids of their nodes
        wanting = [k for k in strange if (new.properties[k].get("kind") == "edge") is edges]
        left = [k for k in missing if (stored.properties[k].get("kind") == "edge") is edges]
        if not wanting or not left:
            continue
        places = _places(stored, left, {})
        for place, new_indices in _places(new, wanting, renamed).items():
            stored_indices = places.get(place, [])
            if len(new_indices) == len(stored_indices) == 1:
                renamed[new.ids[new_indices[0]]] = stored.ids[stored_indices[0]]
    if not renamed:
        return new
    ids = tuple(renamed.get(i, i) for i in new.ids)
    properties = tuple(
        {**p, **{w: renamed[p[w]] for w in ("source", "target") if p.get(w) in renamed}} for p in new.properties
    )
    return replace(new, ids=ids, properties=properties)


def _places(f: Features, indices: Sequence[int], renamed: dict[str, str]) -> dict[tuple[Any, ...], list[int]]:
    """Index features by position: anchor, kind, geometry and, for an edge, the nodes it joins."""
    shapes = shapely.to_wkb(f.geometry[np.array(indices, np.intp)])
    out: dict[tuple[Any, ...], list[int]] = defaultdict(list)
    for k, shape in zip(indices, shapes, strict=True):
        p = f.properties[k]
        ends = tuple(renamed.get(p[w], p[w]) for w in ("source", "target") if isinstance(p.get(w), str))
        if not f.geometry[k].is_empty:
            out[(bool(f.local[k]), p.get("kind"), ends, shape)].append(k)
    return out
