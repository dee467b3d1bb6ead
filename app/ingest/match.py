"""A re-upload whose ids differ is matched to the head by geometry first, so that identities and diffs stay small."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from typing import Any

import numpy as np
import shapely

from app.model.features import Features
from app.model.layers import PartKey
from app.store import Store
from app.store.values import Version


def match_ids(store: Store, base: Version, key: PartKey, new: Features) -> Features:
    """The new collection with the head's ids where a feature stands at the very place of one whose id has gone.

    Features whose ids the head knows keep them. Of the others, one takes the id of a head feature that the upload
    does not name, if kind, anchor and geometry are equal and the pair is the only one of its place. Edges follow
    their nodes.
    """
    stored = store.load(base, [key]).parts.get(key)
    if not isinstance(stored, Features) or not len(stored) or not len(new):
        return new
    known, named = set(stored.ids), set(new.ids)
    strange = [k for k, i in enumerate(new.ids) if i not in known]
    gone = [k for k, i in enumerate(stored.ids) if i not in named]
    if not strange or not gone:
        return new
    places = _places(stored, gone)
    renamed: dict[str, str] = {}
    for place, wanting in _places(new, strange).items():
        left = places.get(place, [])
        if len(wanting) == len(left) == 1:
            renamed[new.ids[wanting[0]]] = stored.ids[left[0]]
    if not renamed:
        return new
    ids = tuple(renamed.get(i, i) for i in new.ids)
    properties = tuple(_renamed(i, p, renamed) for i, p in zip(new.ids, new.properties, strict=True))
    return replace(new, ids=ids, properties=properties)


def _places(f: Features, where: list[int]) -> dict[tuple[Any, ...], list[int]]:
    shapes = shapely.to_wkb(shapely.normalize(f.geometry[np.array(where, np.intp)]))
    out: dict[tuple[Any, ...], list[int]] = defaultdict(list)
    for k, shape in zip(where, shapes, strict=True):
        if not f.geometry[k].is_empty:
            direction = f.geometry[k].coords[0] if f.properties[k].get("kind") == "edge" else None
            out[(bool(f.local[k]), f.properties[k].get("kind"), direction, shape)].append(k)
    return out


def _renamed(old: str, properties: Any, renamed: dict[str, str]) -> Any:
    changed = {w: renamed[properties[w]] for w in ("source", "target") if properties.get(w) in renamed}
    if old in renamed and not properties.get("name") and properties.get("kind") != "edge":
        changed["name"] = old  # the file's own name for it, which the way back must say again
    if old in renamed and properties.get("kind") == "edge":
        changed["edge_id"] = old
    return {**properties, **changed} if changed else properties
