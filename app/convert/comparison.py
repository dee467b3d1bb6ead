"""Comparison of features with what a format gives back of them: matching first, then properties and geometry."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from app.model.features import Properties

TOLERANCE_METRES = 0.01
"""Maximum distance of equal geometries."""

NOISE = 1e-6
"""Maximum difference of equal numbers, relative or absolute."""

ENDS = ("source", "target")
ORIENTATION = "orientation"


class Item(NamedTuple):
    """A feature of one layer. geometry: in metres."""

    level: str
    id: str
    geometry: Any
    properties: Properties

    @property
    def is_edge(self) -> bool:
        """Whether it is an edge of a network."""
        return self.properties.get("kind") == "edge"


def match_items(stored: Sequence[Item], returned: Sequence[Item]) -> dict[int, int]:
    """Match features of a layer; returns index -> index.

    By id and place (formats without ids number features anew, so an id may be another feature's), else by name, else by
    position; edges by id and the nodes they join, else by these nodes; the rest by id. A key must be unique on both
    sides among the features that are left.
    """
    pairs: dict[int, int] = {}
    _pair_in_place(stored, returned, pairs)
    for kinds in (True, False):  # some formats return all objects as kinds of their own
        for levels in (True, False):
            key = partial(_name_key, with_level=levels, with_kind=kinds)
            _pair_by(stored, returned, key, key, pairs)
        _pair_by_position(stored, returned, pairs, edges=False, with_kind=kinds)
    _pair_by_id(stored, returned, pairs, edges=False)
    ids = {returned[k].id: stored[j].id for j, k in pairs.items()}
    for edge_key in (_edge_key, _ends):
        _pair_by(stored, returned, partial(edge_key, ids={}), partial(edge_key, ids=ids), pairs)
    _pair_by_position(stored, returned, pairs, edges=True, with_kind=True)
    _pair_by_id(stored, returned, pairs, edges=True)
    return pairs


def _pair_in_place(stored: Sequence[Item], returned: Sequence[Item], pairs: dict[int, int]) -> None:
    """Add the pairs of features, but edges, with one id, kind and box; those of the same level first."""
    first, second = (_boxes(items, range(len(items))) for items in (stored, returned))
    for key in (lambda item: (item.level, item.id), lambda item: item.id):
        taken = set(pairs.values())
        by_id: dict[Hashable, list[int]] = defaultdict(list)
        for k, item in enumerate(returned):
            if k not in taken:
                by_id[key(item)].append(k)
        for j, item in enumerate(stored):
            hits = by_id.get(key(item), ()) if j not in pairs and not item.is_edge else ()
            near = [k for k in hits if _is_near(first[j], second[k]) and _kind(item) == _kind(returned[k])]
            if len(near) == 1 and near[0] not in taken:
                pairs[j] = near[0]
                taken.add(near[0])


def _is_near(box: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    """Test if two boxes agree; those of empty geometries do."""
    return bool((np.abs(np.nan_to_num(box - other, nan=0.0)) <= TOLERANCE_METRES).all())


def _kind(item: Item) -> Any:
    return item.properties.get("kind")


def _pair_by_id(stored: Sequence[Item], returned: Sequence[Item], pairs: dict[int, int], *, edges: bool) -> None:
    def key(item: Item) -> Hashable | None:
        return (item.id, str(_kind(item))) if item.is_edge is edges else None

    def key_on_level(item: Item) -> Hashable | None:
        return (item.level, key(item)) if item.is_edge is edges else None

    for one in (key_on_level, key):
        _pair_by(stored, returned, one, one, pairs)


def _edge_key(item: Item, ids: Mapping[str, str]) -> Hashable | None:
    ends = _ends(item, ids)
    return None if ends is None else (item.id, ends)


def _name_key(item: Item, with_level: bool, with_kind: bool) -> Hashable | None:
    name = item.properties.get("name")
    if not isinstance(name, str) or not name or item.is_edge:
        return None
    return item.level if with_level else "", str(_kind(item)) if with_kind else "", name


def _ends(item: Item, ids: Mapping[str, str]) -> Hashable | None:
    ends = [end for end in map(item.properties.get, ENDS) if isinstance(end, str)]
    return tuple(ids.get(end, end) for end in ends) if item.is_edge and len(ends) == len(ENDS) else None


def _pair_by(
    stored: Sequence[Item],
    returned: Sequence[Item],
    stored_key: Callable[[Item], Hashable | None],
    returned_key: Callable[[Item], Hashable | None],
    pairs: dict[int, int],
) -> None:
    """Add the pairs of features that are left and whose keys are equal and unique on both sides; None matches none."""
    left = _unique((stored_key(item), k) for k, item in enumerate(stored) if k not in pairs)
    taken = set(pairs.values())
    right = _unique((returned_key(item), k) for k, item in enumerate(returned) if k not in taken)
    pairs.update((k, right[key]) for key, k in left.items() if key in right)


def _unique(keyed: Iterable[tuple[Hashable | None, int]]) -> dict[Hashable, int]:
    groups: dict[Hashable, list[int]] = defaultdict(list)
    for key, k in keyed:
        if key is not None:
            groups[key].append(k)
    return {key: members[0] for key, members in groups.items() if len(members) == 1}


def _pair_by_position(
    stored: Sequence[Item], returned: Sequence[Item], pairs: dict[int, int], *, edges: bool, with_kind: bool
) -> None:
    """Add the pairs of features that are left and whose boxes agree; a box must have one candidate."""
    from scipy.spatial import cKDTree  # slow to import

    taken = set(pairs.values())
    left = _candidates(stored, pairs.keys(), edges)
    right = _candidates(returned, taken, edges)
    if not left or not right:
        return
    right_boxes = cKDTree(_boxes(returned, right))
    near = right_boxes.query_ball_point(_boxes(stored, left), TOLERANCE_METRES, p=math.inf)
    candidates: dict[int, list[int]] = {}
    for j, hits in zip(left, near, strict=True):
        places = [right[hit] for hit in hits]
        candidates[j] = [k for k in places if not with_kind or _kind(returned[k]) == _kind(stored[j])]
    wanted: dict[int, int] = defaultdict(int)
    for hits in candidates.values():
        for k in hits:
            wanted[k] += 1
    pairs.update((j, hits[0]) for j, hits in candidates.items() if len(hits) == 1 and wanted[hits[0]] == 1)


def _candidates(items: Sequence[Item], matched: Collection[int], edges: bool) -> list[int]:
    left = [k for k, item in enumerate(items) if k not in matched and item.is_edge is edges]
    return [k for k in left if not items[k].geometry.is_empty]


def _boxes(items: Sequence[Item], indices: Sequence[int]) -> NDArray[np.float64]:
    geometry = np.empty(len(indices), object)
    geometry[:] = [items[k].geometry for k in indices]
    boxes: NDArray[np.float64] = shapely.bounds(geometry)
    return boxes


def differing_fields(
    stored: Sequence[Item], returned: Sequence[Item], pairs: Mapping[int, int], ignored: Collection[str]
) -> Iterator[tuple[int, list[str]]]:
    """Yield the matched features that differ, and the names of what does not come back.

    ignored: names of formats, whose own properties are not compared. Added properties are no loss, nor are those that
    come back as properties of the format.
    """
    ids = {returned[k].id: stored[j].id for j, k in pairs.items()}
    moved = _moved([(stored[j].geometry, returned[k].geometry) for j, k in pairs.items()])
    for (j, k), is_moved in zip(pairs.items(), moved, strict=True):
        before, after = stored[j], returned[k]
        names = [
            name
            for name, value in before.properties.items()
            if name not in ignored
            and not _is_same(name, value, after.properties.get(name), ids)
            and not _is_carried(name, value, after.properties, ignored)
        ]
        names += ["geometry"] if is_moved else []
        names += ["level"] if before.level != after.level else []
        if names:
            yield j, sorted(names)


def _is_same(name: str, before: Any, after: Any, ids: Mapping[str, str]) -> bool:
    if name in ENDS and isinstance(after, str):
        return bool(before == ids.get(after, after))
    if is_equal(before, after):
        return True
    # a quaternion and its negative are the same rotation
    return name == ORIENTATION and isinstance(after, list) and is_equal(before, [-v for v in after if _is_number(v)])


def _is_carried(name: str, value: Any, properties: Properties, namespaces: Collection[str]) -> bool:
    """Test if a format returns a value under the same name among its own properties, or in a mapping of these."""
    for members in (properties[key] for key in properties.keys() & set(namespaces)):
        nested = members.values() if isinstance(members, Mapping) else ()
        for mapping in (members, *nested):
            if isinstance(mapping, Mapping) and name in mapping and is_equal(value, mapping[name]):
                return True
    return False


def is_equal(a: Any, b: Any) -> bool:
    """Compare JSON-like values, numbers up to noise."""
    if _is_number(a) and _is_number(b):
        return math.isclose(a, b, rel_tol=NOISE, abs_tol=NOISE)
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return a.keys() == b.keys() and all(is_equal(value, b[key]) for key, value in a.items())
    if isinstance(a, list | tuple) and isinstance(b, list | tuple):
        return len(a) == len(b) and all(map(is_equal, a, b))
    return type(a) is type(b) and bool(a == b)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _moved(pairs: Sequence[tuple[Any, Any]]) -> list[bool]:
    """Test if geometries differ by more than the tolerance; the order of vertices and rings does not matter."""
    if not pairs:
        return []
    before, after = np.empty(len(pairs), object), np.empty(len(pairs), object)
    before[:], after[:] = zip(*pairs, strict=True)
    same = np.asarray(shapely.equals_exact(before, after, TOLERANCE_METRES)) & ~_heights_differ(before, after)
    for k in np.flatnonzero(~same).tolist():
        same[k] = _is_same_shape(before[k], after[k])
    return [not flag for flag in same.tolist()]


def _heights_differ(before: NDArray[np.object_], after: NDArray[np.object_]) -> NDArray[np.bool_]:
    """Test pairs of 3-D geometries with equal numbers of vertices for other heights; a missing height is 0."""
    out = np.zeros(len(before), bool)
    for k in np.flatnonzero(shapely.has_z(before) | shapely.has_z(after)).tolist():
        first, second = (np.nan_to_num(shapely.get_coordinates(g, include_z=True)[:, 2]) for g in (before[k], after[k]))
        if len(first) == len(second):
            out[k] = bool((np.abs(first - second) > TOLERANCE_METRES).any())
        else:
            out[k] = bool(abs(first.max(initial=0.0) - second.max(initial=0.0)) > TOLERANCE_METRES)
    return out


def _is_same_shape(before: Any, after: Any) -> bool:
    """Test if two shapes cover the same points, whatever the order and number of their vertices."""
    if before.is_empty or after.is_empty:
        return bool(before.is_empty and after.is_empty)
    if shapely.get_dimensions(before) != shapely.get_dimensions(after):
        return False
    pair = np.array([before, after], object)
    if _heights_differ(pair[:1], pair[1:])[0]:
        return False
    return bool(shapely.hausdorff_distance(before, after) <= TOLERANCE_METRES)
