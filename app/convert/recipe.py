"""Plan the conversion to a map from the part list, without loading a layer.

A recipe's key hashes everything that the bytes depend on (parts used, datum, steps, parameters, the writer's version).
Equal keys mean equal bytes, so the key is cache key and ETag.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import orjson

from app import __version__, derive, formats, parameters, templates
from app.convert import closures as applied_closures
from app.derive import ChainFailure, Step
from app.errors import Invalid, MissingDatum, MissingLayer, Problem
from app.formats import Format
from app.model.closures import ClosureMode
from app.model.features import Features
from app.model.layers import LAYERS, MAP, Layer, Layers, PartKey
from app.model.names import did_you_mean
from app.model.templates import Templates
from app.model.voxels import VoxelMap
from app.store.values import PartEntry, Version

HOW_TO_SUPPLY: Mapping[Layer, str] = {
    "location": 'a datum: upload a datum.yaml, or PATCH the environment with {"datum": {…}}',
    "objects": "objects: upload an OSM, KML or GeoJSON file",
    "topology": "a network: upload a tmap2 or OSM file, or a drawing (KML, GeoJSON) with layer=topology",
    "occupancy": "an occupancy grid: upload a map.yaml with its image",
    "voxels": "a voxel map: upload an OctoMap file or a point cloud (pcd, ply, las)",
    "imagery": "a georeferenced image: upload a GeoTIFF, or a PNG with its world file",
    "zones": "zones: upload a drawing with layer=zones",
    "resources": "the files that belong to the objects: upload them together with the objects' file",
}
"""Advice for the user about a missing layer, by layer."""


@dataclass(frozen=True, slots=True)
class AvailableLayers:
    """Inputs of a conversion: the parts with content, and whether there is a datum.

    anchors: by part, which of ``local`` and ``wgs84`` its features have. empty_parts: parts without features; an empty
    file is a map of its own format only. pinned: by layer, the derivations and parameters that its content was derived
    with; stale content is excluded from ``keys`` and derived again with them. drawn: parts that a step created for maps
    only (see ``Derivation.is_terminal``), which are no evidence for other derivations.
    """

    keys: frozenset[PartKey]
    datum: bool
    anchors: Mapping[PartKey, frozenset[str]] = field(default_factory=dict)
    empty_parts: frozenset[PartKey] = frozenset()
    pinned: Mapping[Layer, Mapping[str, Mapping[str, Any]]] = field(default_factory=dict)
    drawn: frozenset[PartKey] = frozenset()

    def for_format(self, fmt: Format) -> AvailableLayers:
        """Add the empty parts that were uploaded in this format; a folder of maps contains all of them."""
        if fmt.traits.is_container:
            return replace(self, keys=self.keys | self.empty_parts, empty_parts=frozenset())
        format_keys = {
            k for k in self.empty_parts if k.name == fmt.family or (k.layer == "voxels" and k.layer in fmt.layers)
        }
        return replace(self, keys=self.keys | format_keys, empty_parts=frozenset()) if format_keys else self

    @property
    def layers(self) -> frozenset[Layer]:
        """Layers with content; a datum is sufficient for location."""
        return frozenset({k.layer for k in self.keys} | ({"location"} if self.datum else set()))

    @property
    def dead(self) -> frozenset[Layer]:
        """Layers that nothing can be derived from, since all their parts are drawn."""
        return frozenset({k.layer for k in self.drawn} - {k.layer for k in self.keys - self.drawn})


@dataclass(frozen=True, slots=True)
class DerivationChain:
    """Derivation chain to a format: the steps (none: direct) and the parts to load."""

    steps: tuple[Step, ...]
    keys: tuple[PartKey, ...]


@dataclass(frozen=True, slots=True)
class Spread:
    """Selection of the parts of a chain's last layer to write as one map, for formats with one part per file.

    default: the level whose files are at the top. names: of the parts to write, empty for all. stored: (level, name)
    of stored parts, which are not written here. optional: without such content in the layers, the map has no files.
    """

    default: str
    names: tuple[str, ...] = ()
    stored: tuple[tuple[str, str], ...] = ()
    optional: bool = False


@dataclass(frozen=True, slots=True)
class MapOrder:
    """Request for a map as values, from which any server plans the same recipe. closures: their mode, None for none."""

    ref: int | str
    format: str
    values: Mapping[str, str]
    derive: bool
    file: str | None
    listed: bool
    closures: ClosureMode | None

    def as_dict(self) -> dict[str, Any]:
        """Convert the order to JSON."""
        return {**dataclasses.asdict(self), "values": dict(self.values)}


@dataclass(frozen=True, slots=True)
class Recipe:
    """Recipe of one map of one version: all inputs of the conversion, and the key of its result.

    origin: where the non-default parameters came from (request, environment, a set); not part of the key. spread: every
    part that the chain produces, instead of one. members: the maps that this one is assembled from. archive: whether to
    create a zip of those. file: name of the requested file in the map, if any. failed: cheaper chains that the content
    does not allow; not part of the key either. replan: plans this request without these derivations (see
    ``derive.first_working``); None if there is no alternative. compared: the recipe of the map, if this one is for what
    the map loses (``app.convert.losses``). order: the request that it was planned for; None if no other server can plan
    it.
    """

    version: Version
    format: Format
    options: Any
    chain: DerivationChain
    key: str
    origin: Mapping[str, str] = field(default_factory=dict)
    spread: Spread | None = None
    members: tuple[Member, ...] = ()
    archive: bool = False
    file: str | None = None
    failed: tuple[ChainFailure, ...] = ()
    replan: Callable[[frozenset[str]], Recipe] | None = field(default=None, compare=False, repr=False)
    compared: Recipe | None = field(default=None, compare=False, repr=False)
    order: MapOrder | None = field(default=None, compare=False, repr=False)

    @property
    def etag(self) -> str:
        """Strong entity tag, with quotes."""
        return f'"{self.key[:32]}"'

    @property
    def steps(self) -> tuple[Step, ...]:
        """Derivations of the chain, in order."""
        return self.chain.steps

    @property
    def is_derived(self) -> bool:
        """Whether any part of the map has to be derived."""
        return bool(self.steps) or any(member.recipe.steps for member in self.members)

    def without(self, failed: Sequence[ChainFailure]) -> Recipe:
        """Plan the same request without derivations that found nothing to use. Raises MissingLayer."""
        if self.replan is None or {one.step for one in failed} == {one.step for one in self.failed}:
            return self
        return replace(
            self.replan(frozenset(one.step for one in failed)),
            failed=tuple(failed),
            replan=self.replan,
            order=self.order,
        )


@dataclass(frozen=True, slots=True)
class Member:
    """Map that is part of a larger one. folder: prefix of its files, with its slash.

    place: level and name of its part; None if it has several parts, of which these levels and names (None: all) are
    used. only_default: on each level use only the default part.
    """

    recipe: Recipe
    folder: str = ""
    place: tuple[str, str] | None = None
    levels: frozenset[str] | None = None
    names: frozenset[str] | None = None
    only_default: bool = False


def available_layers(version: Version) -> AvailableLayers:
    """Describe the content of a version."""
    entries = [e for e in version.parts if e.count > 0]
    pinned = _pinned_layers(version, entries)
    entries = [e for e in entries if e.key.layer not in pinned]
    anchors = {e.key: frozenset(name for name, box in (e.bounds or {}).items() if box) for e in entries}
    blank = frozenset(e.key for e in version.parts if not e.count)
    drawn = frozenset(
        e.key
        for e in entries
        if not e.provenance.is_edited and derive.is_display_only(e.provenance.information, e.provenance.steps)
    )
    return AvailableLayers(frozenset(e.key for e in entries), version.datum is not None, anchors, blank, pinned, drawn)


def available_in(layers: Layers) -> AvailableLayers:
    """Describe the content of layers in memory."""
    keys: set[PartKey] = set()
    blank: set[PartKey] = set()
    anchors: dict[PartKey, frozenset[str]] = {}
    for key, part in layers.parts.items():
        if isinstance(part, Features | VoxelMap) and not len(part):
            blank.add(key)
            continue
        if isinstance(part, Features):
            some = {"local"} if part.local.any() else set()
            anchors[key] = frozenset(some | ({"wgs84"} if part.needs_datum else set()))
        keys.add(key)
    return AvailableLayers(frozenset(keys), layers.datum is not None, anchors, frozenset(blank))


def _pinned_layers(version: Version, entries: Sequence[PartEntry]) -> dict[Layer, Mapping[str, Mapping[str, Any]]]:
    """Find the layers whose parts are all derived and stale: they are derived again with the same steps.

    Layers with edited or uploaded parts stay as they are (the version lists them as stale), and so do names that a
    derivation takes over from the parts that it replaces: only to store its result brings new ones. Closed areas make
    nothing stale: they are applied to what is stored.
    """
    stale = applied_closures.drop_areas(version).stale
    derivations = derive.all_derivations()
    out: dict[Layer, Mapping[str, Mapping[str, Any]]] = {}
    for layer in {key.layer for key in stale}:
        parts = [e for e in entries if e.key.layer == layer]
        if all(e.key in stale and e.provenance.information == "derived" and not e.provenance.is_edited for e in parts):
            steps = [step for e in parts for step in e.provenance.steps]
            if any(step.get("step") not in derivations for step in steps):
                continue  # fetched online, which a conversion never does
            if any(layer in derivations[str(step.get("step"))].also for step in steps if step.get("to") == layer):
                continue
            out[layer] = {str(s["step"]): dict(s.get("parameters") or {}) for s in steps if "step" in s}
    return out


def plan_chain(
    fmt: Format,
    available: AvailableLayers,
    options: Any,
    *,
    derived: bool = True,
    values: Mapping[str, str] | None = None,
    without: frozenset[str] = frozenset(),
) -> DerivationChain:
    """Find the cheapest chain to a format.

    Raises MissingLayer or MissingDatum (with what to supply), or Ambiguous (with the choices).

    values: requested values by name; those that are no options of the format are parameters of a step of the chain. If
    no step of the cheapest chain has such a parameter, a step that has it derives the layer again (a slice of a world
    although a grid is stored). without: derivations that found nothing to use.
    """
    option_values = dict(values or {})
    available = available.for_format(fmt)
    for layer, before in available.pinned.items():
        rivals = {n for n, d in derive.all_derivations().items() if d.gives == layer and n not in before}
        if not without & before.keys():  # its derivation finds nothing any more: allow any other
            without |= rivals
    if fmt.needs.datum and not available.datum:
        raise MissingDatum(f"{fmt.name} needs {HOW_TO_SUPPLY['location']}")
    named = _chain_to_named_part(fmt, available, options, option_values, without) if derived else None
    if named is not None:
        return named
    best = _best_chain(fmt, available, without, derived=derived)
    rest = option_values.keys() - {f.name for f in dataclasses.fields(fmt.write_options)}
    if rest and (best is None or not rest <= _parameters_of(best)):
        available, best = _plan_with_parameters(fmt, available, without, frozenset(rest), derived=derived)
    if best is None:
        raise MissingLayer(f"cannot convert to {fmt.name}: supply {' or '.join(missing_layers(fmt, available))}")
    carried = fmt.layers | {layer for step in best.steps for layer in step.reads}
    keys = sorted(k for k in available.keys if k.layer in carried)
    chosen: Sequence[PartKey] = [k for k in keys if k.layer in fmt.layers]
    if not any(step.gives in fmt.layers for step in best.steps):  # a derived one is chosen after all steps
        chosen = fmt.selection.choose(chosen, options)
    needed = {layer for step in best.steps for layer in step.needs}
    if not _has_complete_map(fmt, available):
        _check_anchor(fmt, available, sorted({*chosen, *(k for k in keys if k.layer in needed)}))
    read = {layer for step in best.steps for layer in step.reads}
    keys = sorted({*chosen, *(k for k in keys if k.layer in read and k not in available.drawn)})
    remembered = {name: value for steps in available.pinned.values() for name, value in steps.items()}
    steps = [derive.with_parameters([s], {**remembered.get(s.name, {}), **option_values})[0] for s in best.steps]
    return DerivationChain(tuple(steps), tuple(keys))


def _chain_to_named_part(
    fmt: Format, available: AvailableLayers, options: Any, option_values: Mapping[str, str], without: frozenset[str]
) -> DerivationChain | None:
    """Find a chain to a part requested by name that is not stored, if a derivation creates parts of that name."""
    parts = fmt.selection.parts
    if parts is None or (name := getattr(options, parts.name)) is None:
        return None
    layer, level = parts.layer, getattr(options, parts.level)
    if any((k.layer, k.name) == (layer, name) and level in (None, k.level) for k in available.keys):
        return None
    further = option_values.keys() - {f.name for f in dataclasses.fields(fmt.write_options)}
    for d in sorted(derive.all_derivations().values(), key=lambda d: (d.cost, d.name)):
        if (
            d.gives != layer
            or name not in d.part_names
            or not d.needs <= available.layers - available.dead
            or d.name in without
        ):
            continue
        if level is not None and not any(k.level == level and k.layer in d.needs for k in available.keys):
            continue
        if further <= derive.parameter_names(d.name):
            keys = sorted(k for k in available.keys if k.layer in d.needs or (k.layer, k.name) == (layer, MAP))
            before = available.pinned.get(layer, {}).get(d.name, {})
            return DerivationChain(derive.with_parameters([d.step()], {**before, **option_values}), tuple(keys))
    return None


def _best_chain(
    fmt: Format, available: AvailableLayers, without: frozenset[str], *, derived: bool = True
) -> derive.Plan | None:
    best: derive.Plan | None = derive.Plan((), 0.0) if _has_complete_map(fmt, available) else None
    for required in fmt.needs.one_of:
        plan = derive.plan(available.layers, required, without, available.dead)
        if plan is not None and (derived or not plan.steps) and (best is None or plan.cost < best.cost):
            best = plan
    return best


def _has_complete_map(fmt: Format, available: AvailableLayers) -> bool:
    """Return whether a map of this format is stored, so that no other layer is needed."""
    return fmt.needs.accepts_family and any(k.layer == "objects" and k.name == fmt.family for k in available.keys)


def _parameters_of(plan: derive.Plan) -> frozenset[str]:
    """Return the names of all parameters of a plan's steps."""
    return frozenset().union(*(derive.parameter_names(step.name) for step in plan.steps))


def _plan_with_parameters(
    fmt: Format, available: AvailableLayers, without: frozenset[str], names: frozenset[str], *, derived: bool
) -> tuple[AvailableLayers, derive.Plan]:
    """Find a plan with a step that has all these parameters; return it after the inputs without that step's layer."""
    useful = frozenset().union(*fmt.needs.one_of)
    everything = derive.all_derivations()
    candidates: list[tuple[float, str, AvailableLayers, derive.Plan]] = []
    for name, step in everything.items() if derived else ():
        if not names <= derive.parameter_names(name) or step.gives not in useful or name in without:
            continue
        remaining_keys = frozenset(k for k in available.keys if k.layer != step.gives)
        less = replace(available, keys=remaining_keys, drawn=available.drawn & remaining_keys)
        rivals = frozenset(n for n, d in everything.items() if d.gives == step.gives and n != name)
        # Only the alternatives with the step's layer: a format that needs only a grid would ignore its objects.
        alternatives = [required for required in fmt.needs.one_of if step.gives in required]
        plans = [
            plan
            for required in alternatives
            if (plan := derive.plan(less.layers, required, without | rivals, less.dead)) is not None
        ]
        plans = [plan for plan in plans if any(s.name == name for s in plan.steps)]
        if plans:
            plan = min(plans, key=lambda one: one.cost)
            candidates.append((plan.cost, name, less, plan))
    if candidates:
        _, _, less, plan = min(candidates, key=lambda f: f[:2])
        return less, plan
    if any(names <= derive.parameter_names(name) for name in without):
        lacking = " or ".join(missing_layers(fmt, available)) or "other layers"
        raise MissingLayer(f"cannot convert to {fmt.name} with {', '.join(sorted(names))}: supply {lacking}")
    derivation_parameters = sorted(
        {n for d, step in everything.items() if step.gives in useful for n in derive.parameter_names(d)}
    )
    format_parameters = [p["name"] for p in parameters.describe(fmt.write_options)]
    accepted = ", ".join(format_parameters) or "none"
    further = f"; if a layer is derived, also {', '.join(derivation_parameters)}" if derivation_parameters else ""
    wrong = sorted(names)
    near = did_you_mean(wrong[0], [*format_parameters, *derivation_parameters])
    problem = f"unknown parameter of {fmt.name} for this map{near}; accepted: {accepted}{further}"
    raise Invalid(f"{', '.join(wrong)}: {problem}", [Problem(problem, where=name) for name in wrong])


def reduce_chain(chain: DerivationChain) -> DerivationChain:
    """Reduce a chain to the parts that its steps read."""
    read = {layer for step in chain.steps for layer in step.reads}
    return replace(chain, keys=tuple(k for k in chain.keys if k.layer in read))


def missing_layers(fmt: Format, available: AvailableLayers) -> list[str]:
    """List what to supply for a format, one text per alternative."""
    out = []
    for required in fmt.needs.one_of:
        lacking = [HOW_TO_SUPPLY[layer] for layer in LAYERS if layer in required - available.layers]
        out.append(" and ".join(lacking))
    return [text for text in dict.fromkeys(out) if text]


def detours(failed: Sequence[ChainFailure]) -> list[Problem]:
    """Warn that a map was derived with another chain than the cheapest one: name the failed step and the reason."""
    return [Problem(f"{one.step} failed: {one.reason}; another derivation was used") for one in failed if one.step]


def recipe(
    version: Version,
    name: str,
    values: Mapping[str, str],
    *,
    derived: bool = True,
    without: frozenset[str] = frozenset(),
) -> Recipe:
    """Plan a version's map. Raises NotFound, Invalid, MissingLayer, MissingDatum or Ambiguous if it is impossible.

    values: options of the format and parameters of the derivations, as strings. without: see ``plan_chain``.
    """
    fmt = formats.get_format(name)
    options = writer_options(fmt, values)
    derivation_chain = plan_chain(
        fmt, available_layers(version), options, derived=derived, values=values, without=without
    )
    return recipe_of_chain(version, fmt, options, derivation_chain)


def recipe_of_chain(
    version: Version, fmt: Format, options: Any, chain: DerivationChain, spread: Spread | None = None
) -> Recipe:
    """Build the recipe of a map from a chain. spread: see ``Recipe``."""
    entries = {e.key: e for e in version.parts}
    return Recipe(version, fmt, options, chain, _key(version, fmt, options, chain, entries, spread), spread=spread)


def writer_options(fmt: Format, values: Mapping[str, str]) -> Any:
    """Select the format's options from the requested values.

    Raises Invalid for a name that is neither an option nor a parameter of any derivation.
    """
    option_names = {f.name for f in dataclasses.fields(fmt.write_options)}
    steps = frozenset().union(*(derive.parameter_names(name) for name in derive.all_derivations()))
    return formats.write_options(fmt, {n: v for n, v in values.items() if n in option_names or n not in steps})


def defaults(stored_templates: Templates, fmt: Format) -> Any:
    """Build the options of a format's writer from an environment's templates."""
    return formats.write_options(fmt, templates.resolve(stored_templates, fmt).values)


def _key(
    version: Version,
    fmt: Format,
    options: Any,
    chain: DerivationChain,
    entries: Mapping[PartKey, PartEntry],
    spread: Spread | None,
) -> str:
    ingredients: dict[str, Any] = {
        "server": __version__,
        "format": [fmt.name, fmt.version],
        "options": parameters.canonical(options),
        "steps": [[s.name, s.version, s.given] for s in chain.steps],
        "parts": [[k.layer, k.level, k.name, entries[k].hash] for k in chain.keys],
        "attribution": sorted({text for k in chain.keys for text in entries[k].provenance.attribution}),
        "datum": version.datum.as_dict() if version.datum else None,
        "levels": [[level.name, level.elevation] for level in version.levels],
    }
    ingredients |= applied_closures.ingredients(version, fmt, chain.keys)
    if fmt.traits.has_title or fmt.traits.is_container:
        ingredients["title"] = version.environment
    if spread is not None:
        ingredients["spread"] = dataclasses.asdict(spread)
    if fmt.traits.is_container:  # it contains other formats' maps and derived layers
        ingredients["formats"] = [[f.name, f.version] for f in formats.all_formats().values()]
        ingredients["derivations"] = [[d.name, d.version] for d in derive.all_derivations().values()]
        format_defaults = {
            f.name: defaults(version.templates, f) for f in formats.all_formats().values() if f is not fmt
        }
        format_defaults = {name: parameters.canonical(chosen) for name, chosen in format_defaults.items()}
        if any(format_defaults.values()):
            ingredients["templates"] = {name: values for name, values in format_defaults.items() if values}
    return hashlib.sha256(orjson.dumps(ingredients, option=orjson.OPT_SORT_KEYS)).hexdigest()


def _check_anchor(fmt: Format, available: AvailableLayers, keys: list[PartKey]) -> None:
    """Raise MissingDatum early if the conversion would fail without a datum."""
    if fmt.needs.anchor is None or available.datum:
        return
    other = "wgs84" if fmt.needs.anchor == "local" else "local"
    grids_only = fmt.needs.anchor == "wgs84"
    for key in keys:
        if other in available.anchors.get(key, ()) or (grids_only and key.layer == "occupancy"):
            part_frame = "WGS 84 degrees" if other == "wgs84" else "local metres"
            fmt_frame = "local metres" if other == "wgs84" else "WGS 84 degrees"
            raise MissingDatum(
                f"layer {key.layer} is in {part_frame} and {fmt.name} needs {fmt_frame}: supply "
                f"{HOW_TO_SUPPLY['location']}"
            )
