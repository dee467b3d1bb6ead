"""Content of an OSM file as columns of nodes, ways and relations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.errors import Problem, UnreadableFile

Attributes = dict[str, str]
Tags = dict[str, str]

INT64 = 2**63

EXTRAS = frozenset({"note", "meta", "remark", "MetaInfo", "changeset"})
"""Non-data elements that Overpass, JOSM and Autoware's editor write. Any other is rejected, as osmcode's tests require.
"""

DATA = frozenset({"node", "way", "relation"})

MAX_UNKNOWN_DEPTH = 8
"""Maximum nesting depth of unknown elements."""

Unknown = list[Any]
"""Element stored as it is: [name, attributes, text, children], without empty items at the end."""


@dataclass(slots=True)
class Way:
    """A way: node ids in order. children: elements that OSM does not define."""

    id: int
    refs: list[int]
    tags: Tags
    attributes: Attributes
    children: list[Unknown] = field(default_factory=list)


@dataclass(slots=True)
class Relation:
    """A relation: members as (type, id, role)."""

    id: int
    members: list[tuple[str, int, str]]
    tags: Tags
    attributes: Attributes
    children: list[Unknown] = field(default_factory=list)


@dataclass(slots=True)
class Data:
    """Content of an OSM file.

    ids: of the nodes, in the file's order. lonlat: float64 [n, 2] degrees, NaN for nodes without a position. tags: by
    the node's index in ``ids``, only for those that have any. attributes(k): further attributes of node k, one shared
    mapping for equal ones. root, bounds, elements: of the file as a whole.
    """

    ids: list[int]
    lonlat: NDArray[np.float64]
    tags: dict[int, Tags]
    attributes: Callable[[int], Attributes]
    ways: list[Way]
    relations: list[Relation]
    root: Attributes
    bounds: list[Attributes]
    elements: list[Unknown]
    node_children: dict[int, list[Unknown]] = field(default_factory=dict)
    problems: list[tuple[str, int | None, str]] = field(default_factory=list)


def check_values(osm_data: Data, line: Callable[[int], int | None]) -> None:
    """Check that ids fit into 64 bits and positions are on earth."""
    refs = chain.from_iterable(way.refs for way in osm_data.ways)
    other_ids = chain((w.id for w in osm_data.ways), (r.id for r in osm_data.relations))
    members = (m[1] for r in osm_data.relations for m in r.members)
    for noun, values in (
        ("node", osm_data.ids),
        ("way's reference", refs),
        ("way or relation", other_ids),
        ("member", members),
    ):
        try:
            np.fromiter(values, np.int64)
        except OverflowError:
            reason = f"the id of a {noun} does not fit into 64 bits"
            raise UnreadableFile(reason, [Problem(reason)]) from None
    bad = (np.abs(osm_data.lonlat) > [180.0, 90.0]).any(axis=1) | np.isinf(osm_data.lonlat).any(axis=1)
    if bad.any():
        k = int(np.flatnonzero(bad)[0])
        lon, lat = osm_data.lonlat[k].tolist()
        reason = f"invalid position lat {lat:g}, lon {lon:g}: latitude must be within ±90, longitude within ±180"
        raise UnreadableFile(
            f"node {osm_data.ids[k]}: {reason}", [Problem(reason, line=line(k), where=f"node {osm_data.ids[k]}")]
        )
