"""Losses of a format: the map is written, read back by the format's own reader, and compared feature by feature.

Format-specific properties (``properties.<format>``), float noise and the order of vertices do not count, nor do ids:
features that come back under another id are matched by name, by the nodes that they join, or by position.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from hashlib import sha256
from typing import Any, Literal, NamedTuple

import numpy as np
import orjson
import shapely
from numpy.typing import NDArray

from app import formats, upload_reader
from app.convert.comparison import Item, differing_fields, match_items
from app.convert.recipe import Recipe
from app.errors import BadUpload, CannotConvert
from app.formats import Files, Format
from app.limits import Limits
from app.model.features import Features, Properties
from app.model.frame import GROUND
from app.model.geodesy import LocalFrame, local_frame
from app.model.layers import VECTOR_LAYERS, Layer, Layers, PartKey
from app.store.in_worker import open_store
from app.store.values import Version
from app.upload_reader import EnvironmentContext, UploadHints

COMPARISON = 1
"""Version of the comparison, part of each key in the cache."""

_DEGREE_METRES = 111_319.49
"""Metres per degree, to compare positions on earth without a datum."""


class Loss(NamedTuple):
    """A stored feature that does not come back, or comes back with differing fields.

    after: as it comes back: local (else WGS 84), geometry as WKB in hex, properties; None if it does not.
    """

    key: PartKey
    id: str
    change: Literal["changed", "deleted"]
    fields: tuple[str, ...]
    after: tuple[bool, str, Properties] | None


def losses_recipe(recipe: Recipe) -> Recipe:
    """Return the recipe for the losses of a map; its cached file has the result of ``find_losses``."""
    parts = sorted([*_names(e.key), e.hash] for e in recipe.version.parts if e.key.layer in VECTOR_LAYERS)
    datum = recipe.version.datum.as_dict() if recipe.version.datum else None
    seed = orjson.dumps(["losses", COMPARISON, recipe.key, parts, datum])
    return replace(recipe, key=sha256(seed).hexdigest(), compared=recipe)


def _names(key: PartKey) -> tuple[str, str, str]:
    return key.layer, key.level, key.name


def decode_losses(data: bytes) -> list[Loss]:
    """Read the result of ``find_losses``."""
    return [
        Loss(PartKey(layer, level, name), item, change, tuple(names), None if after is None else tuple(after))
        for layer, level, name, item, change, names, after in orjson.loads(data)
    ]


def find_losses(database_url: str, blob_dir: str, version: Version, name: str, files: Files, limits: Limits) -> bytes:
    """Compare a version with its map in a format (in a worker); returns JSON, sorted by layer, level, part and id."""
    fmt = formats.get_format(name)
    keys = [entry.key for entry in version.parts if entry.key.layer in VECTOR_LAYERS and entry.count]
    stored = open_store(database_url, blob_dir).content.load(version, keys) if keys else Layers()
    has_vectors = bool(fmt.layers & VECTOR_LAYERS)
    returned = _read_back(fmt, files, stored, limits) if has_vectors and keys else Layers()
    frame = local_frame(version.datum) if version.datum else None
    losses = [one for layer in sorted(VECTOR_LAYERS) for one in _compare(layer, stored, returned, frame)]
    losses.sort(key=lambda one: (_names(one.key), one.id))
    return orjson.dumps([[*_names(one.key), one.id, one.change, one.fields, one.after] for one in losses])


def _read_back(fmt: Format, files: Files, stored: Layers, limits: Limits) -> Layers:
    """Read a map as an upload to the same environment would be read, for the level that it is from."""
    context = EnvironmentContext(stored.datum, None, fmt.layers & VECTOR_LAYERS, cells=False)
    if fmt.traits.is_drawing or fmt.traits.is_container:
        context = replace(context, wanted=None)
    levels = {key.level for key in stored.parts if key.layer in fmt.layers}
    hints = UploadHints(fmt.name, level=levels.pop() if len(levels) == 1 else GROUND)
    try:
        bundle = upload_reader.read(upload_reader.unpack(files, limits), hints, context, limits)
    except BadUpload as error:
        raise CannotConvert(f"the map in {fmt.name} cannot be read back: {error.detail}", error.problems) from error
    return bundle.layers(stored.datum)


def _compare(layer: Layer, stored: Layers, returned: Layers, frame: LocalFrame | None) -> Iterable[Loss]:
    before, after = _rows(layer, stored, frame), _rows(layer, returned, frame)
    stored_items, returned_items = [row.item for row in before], [row.item for row in after]
    pairs = match_items(stored_items, returned_items)
    names = {name for one in formats.all_formats().values() for name in (one.name, one.family)}
    for j, differing in differing_fields(stored_items, returned_items, pairs, names):
        yield Loss(before[j].key, before[j].item.id, "changed", tuple(differing), after[pairs[j]].state())
    for j, row in enumerate(before):
        if j not in pairs:
            yield Loss(row.key, row.item.id, "deleted", (), None)


class _Row(NamedTuple):
    """Feature to compare, and where it is from."""

    item: Item
    key: PartKey
    part: Features
    place: int

    def state(self) -> tuple[bool, str, Properties]:
        """Return the feature as it is anchored."""
        geometry = shapely.to_wkb(self.part.geometry[self.place], hex=True)
        return bool(self.part.local[self.place]), geometry, self.part.properties[self.place]


def _rows(layer: Layer, layers: Layers, frame: LocalFrame | None) -> list[_Row]:
    """List the features of a layer in metres; without a datum, degrees are about as long as metres of latitude."""
    rows: list[_Row] = []
    for key, part in sorted(layers.parts.items(), key=lambda item: item[0]):
        if key.layer != layer or not isinstance(part, Features):
            continue
        geometry = part.in_local(frame) if frame is not None or not part.needs_datum else _in_about_metres(part)
        columns = zip(part.ids, geometry, part.properties, strict=True)
        rows += [_Row(Item(key.level, *column), key, part, k) for k, column in enumerate(columns)]
    return rows


def _in_about_metres(part: Features) -> NDArray[np.object_]:
    out = part.geometry.copy()
    on_earth = ~part.local
    out[on_earth] = shapely.transform(part.geometry[on_earth], lambda degrees: degrees * _DEGREE_METRES)
    return out


def states_as_features(states: Sequence[tuple[bool, str, Properties]]) -> Features:
    """Convert states that came back to features with the ids 0, 1, 2 …"""
    geometry = np.empty(len(states), object)
    geometry[:] = [shapely.from_wkb(wkb) for _, wkb, _ in states]
    properties: tuple[Mapping[str, Any], ...] = tuple(state for _, _, state in states)
    local = np.array([is_local for is_local, _, _ in states], bool)
    return Features(tuple(map(str, range(len(states)))), geometry, properties, local)
