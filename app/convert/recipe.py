"""How a map would be made: decided from what is there, without loading a layer.

A recipe's key hashes all that the bytes depend on (the parts that are used, the datum, the steps, the parameters, the
writer's version), so an equal key means equal bytes: it is the cache's key and the ETag.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import orjson

from app import __version__, derive, formats, parameters
from app.derive import Step
from app.errors import MissingDatum, MissingLayer
from app.formats import Format
from app.model.layers import LAYERS, Layer, PartKey
from app.store.values import PartEntry, Version

SUPPLY: Mapping[Layer, str] = {
    "location": 'a datum: upload a datum.yaml, or PATCH the environment with {"datum": {…}}',
    "objects": "objects: upload an OSM, KML or GeoJSON file",
    "topology": "a network: upload a tmap2 or OSM file, or a drawing (KML, GeoJSON) with layer=topology",
    "occupancy": "an occupancy grid: upload a map.yaml with its image",
    "voxels": "a voxel map: upload an OctoMap file",
    "imagery": "a georeferenced picture",
    "zones": "zones: upload a drawing with layer=zones",
    "resources": "the files that belong to the objects",
}
"""What a user can do about a missing layer."""


@dataclass(frozen=True, slots=True)
class Stock:
    """What there is to make maps from: the parts that have content, and whether there is a datum.

    anchors: of each part, which of ``local`` and ``wgs84`` its items are. blank: parts without items; an empty file is
    a map of its own format, and of no other.
    """

    keys: frozenset[PartKey]
    datum: bool
    anchors: Mapping[PartKey, frozenset[str]] = field(default_factory=dict)
    blank: frozenset[PartKey] = frozenset()

    def seen_by(self, known: Format) -> Stock:
        """The same with the blank parts that came from this format."""
        own = {k for k in self.blank if k.name == known.family or (k.layer == "voxels" and k.layer in known.carries)}
        return replace(self, keys=self.keys | own, blank=frozenset()) if own else self

    @property
    def layers(self) -> frozenset[Layer]:
        """The layers with content; a datum alone is location enough."""
        return frozenset({k.layer for k in self.keys} | ({"location"} if self.datum else set()))


@dataclass(frozen=True, slots=True)
class Chain:
    """A way to a format: the derivation steps (none: direct), and the parts to load."""

    steps: tuple[Step, ...]
    keys: tuple[PartKey, ...]


@dataclass(frozen=True, slots=True)
class Recipe:
    """One map of one version: everything ``make`` needs to know, and the key of what it will give."""

    version: Version
    format: Format
    options: Any
    chain: Chain
    key: str

    @property
    def etag(self) -> str:
        """A strong entity tag, with its quotes."""
        return f'"{self.key[:32]}"'

    @property
    def steps(self) -> tuple[Step, ...]:
        """The derivations on the way, in order."""
        return self.chain.steps


def stock(version: Version) -> Stock:
    """What a version holds."""
    entries = [e for e in version.parts if e.count > 0]
    anchors = {e.key: frozenset(name for name, box in (e.bounds or {}).items() if box) for e in entries}
    blank = frozenset(e.key for e in version.parts if not e.count)
    return Stock(frozenset(e.key for e in entries), version.datum is not None, anchors, blank)


def chain(known: Format, available: Stock, options: Any, *, derived: bool = True) -> Chain:
    """The cheapest way to a format. MissingLayer or MissingDatum say what to supply; Ambiguous names the choices."""
    available = available.seen_by(known)
    if known.needs.datum and not available.datum:
        raise MissingDatum(f"{known.name} needs {SUPPLY['location']}")
    best: derive.Plan | None = None
    for wanted in known.needs.one_of:
        found = derive.plan(available.layers, wanted)
        if found is not None and (derived or not found.steps) and (best is None or found.cost < best.cost):
            best = found
    if best is None:
        raise MissingLayer(f"{known.name} cannot be made: supply {' or '.join(missing(known, available))}")
    carried = known.carries | {layer for step in best.steps for layer in step.needs}
    keys = sorted(k for k in available.keys if k.layer in carried)
    chosen = known.choose([k for k in keys if k.layer in known.carries], options)
    needed = {layer for step in best.steps for layer in step.needs}
    keys = sorted({*chosen, *(k for k in keys if k.layer in needed)})
    _check_anchor(known, available, keys)
    return Chain(best.steps, tuple(keys))


def missing(known: Format, available: Stock) -> list[str]:
    """What to supply for a format, one text for each alternative."""
    out = []
    for wanted in known.needs.one_of:
        lacking = [SUPPLY[layer] for layer in LAYERS if layer in wanted - available.layers]
        out.append(" and ".join(lacking))
    return [text for text in dict.fromkeys(out) if text]


def recipe(version: Version, name: str, values: Mapping[str, str], *, derived: bool = True) -> Recipe:
    """The recipe of a version's map. NotFound, Invalid, MissingLayer, MissingDatum or Ambiguous if there is none."""
    known = formats.get_format(name)
    options = formats.write_options(known, values)
    way = chain(known, stock(version), options, derived=derived)
    entries = {e.key: e for e in version.parts}
    return Recipe(version, known, options, way, _key(version, known, options, way, entries))


def _key(version: Version, known: Format, options: Any, way: Chain, entries: Mapping[PartKey, PartEntry]) -> str:
    ingredients = {
        "server": __version__,
        "format": [known.name, known.version],
        "options": parameters.canonical(options),
        "steps": [[s.name, s.version] for s in way.steps],
        "parts": [[k.layer, k.level, k.name, entries[k].hash] for k in way.keys],
        "datum": version.datum.as_dict() if version.datum else None,
        "levels": [[level.name, level.elevation] for level in version.levels],
    }
    return hashlib.sha256(orjson.dumps(ingredients, option=orjson.OPT_SORT_KEYS)).hexdigest()


def _check_anchor(known: Format, available: Stock, keys: list[PartKey]) -> None:
    """Refuse early what would fail on the way for want of a datum."""
    if known.needs.anchor is None or available.datum:
        return
    other = "wgs84" if known.needs.anchor == "local" else "local"
    grids_only = known.needs.anchor == "wgs84"
    for key in keys:
        if other in available.anchors.get(key, ()) or (grids_only and key.layer == "occupancy"):
            here = "places on earth" if other == "wgs84" else "local metres"
            there = "local metres" if other == "wgs84" else "places on earth"
            raise MissingDatum(
                f"the {key.layer} are {here} and {known.name} speaks of {there}: supply {SUPPLY['location']}"
            )
