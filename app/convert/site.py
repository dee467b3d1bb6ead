"""Plan a map of the whole site: every level, every named part, and every mask that can be derived from zones.

Formats with one part per file declare the options that select it (``Format.parts``). If such an option is ``*``, the
map is assembled from ordinary maps, each converted and cached under its own key: one for each stored part, and one for
each derivation that creates parts which are not stored. Files of the default level are at the top, those of other
levels in a folder with the level's name.
"""

from __future__ import annotations

import dataclasses
import hashlib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import orjson

from app import derive
from app.convert import recipe as recipes
from app.convert.recipe import AvailableLayers, DerivationChain, Member, Recipe, Spread
from app.derive import Derivation
from app.errors import MissingLayer, NotFound
from app.formats import Format, Parts
from app.model.frame import GROUND
from app.model.layers import MAP, Layer, PartKey
from app.store.values import Version

ALL = "*"
"""Option value that selects all levels or all named parts."""

SITE_WIDE_LAYERS: frozenset[Layer] = frozenset({"location", "resources"})
"""Layers that belong to all levels, whichever one they are stored on."""

MAX_FOLDER_BYTES = 120
DIGEST_DIGITS = 16

_SAFE = re.compile(r"[A-Za-z0-9_-](?:[A-Za-z0-9_ -]*[A-Za-z0-9_-])?")


def level_folder_name(level: str) -> str:
    """Build the name of the folder for a level's files.

    Letters, digits, ``_``, ``-`` and inner spaces stay; everything else is percent-encoded, as in a URL. Folder names
    contain no dot and file names do, so they never collide. A name that becomes too long is cut, and ends in ``~`` and
    the start of its SHA-256.
    """
    text = level if _SAFE.fullmatch(level) else "".join(map(_encode_character, level))
    if len(text) > MAX_FOLDER_BYTES:
        digest = hashlib.sha256(level.encode()).hexdigest()[:DIGEST_DIGITS]
        text = f"{text[:MAX_FOLDER_BYTES].rstrip('%')}~{digest}"
    return text


def _encode_character(character: str) -> str:
    if character.isascii() and (character.isalnum() or character in "_-"):
        return character
    return "".join(f"%{byte:02X}" for byte in character.encode())


def level_of_folder(folder: str, levels: Iterable[str]) -> str | None:
    """Find the level of a folder by the folder's name."""
    return next((level for level in levels if level_folder_name(level) == folder), None)


def selects_all(fmt: Format, values: Mapping[str, Any]) -> bool:
    """Return whether several parts are selected."""
    parts = fmt.selection.parts
    return parts is not None and ALL in (values.get(parts.name), values.get(parts.level))


def whole_site_options(fmt: Format) -> dict[str, str]:
    """Build the options that select the whole site; empty if one map covers all levels anyway."""
    parts = fmt.selection.parts
    return {} if parts is None else {parts.level: ALL, parts.name: ALL}


def single_part_options(fmt: Format, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options that select one part; without those that are ``*``, which take their default."""
    parts = fmt.selection.parts
    selectors = () if parts is None else (parts.name, parts.level)
    return {option: value for option, value in values.items() if option not in selectors or value != ALL}


@dataclass(frozen=True, slots=True)
class _Site:
    """Inputs of a whole-site map.

    stored: the parts of the format's layer; empty if they are derived. main: the chain that derives them then. lacking:
    the error if there is neither. makers: the derivations of parts that are not stored. default: the level whose files
    are at the top. values: requested values besides the part selection; own_values: without parameters that only the
    makers have.
    """

    version: Version
    format: Format
    parts: Parts
    available: AvailableLayers
    stored: tuple[PartKey, ...]
    main: DerivationChain | None
    lacking: MissingLayer | None
    makers: tuple[Derivation, ...]
    default: str
    values: Mapping[str, Any]
    own_values: Mapping[str, Any]

    @property
    def levels(self) -> frozenset[str]:
        """Levels that may have a folder."""
        keys = {entry.key.level for entry in self.version.parts}
        return frozenset(keys | {level.name for level in self.version.levels})

    def prefix(self, level: str) -> str:
        """Return the folder of a level's files, with its slash."""
        return "" if level == self.default else level_folder_name(level) + "/"

    def derivation_for(self, name: str, level: str) -> Derivation | None:
        """Return the derivation that may create this part; whether it does depends on the zones."""
        if any((key.level, key.name) == (level, name) for key in self.stored):
            return None
        for maker in self.makers:
            if name in maker.part_names and any(
                k.level == level and k.layer in maker.needs for k in self.available.keys
            ):
                return maker
        return None


def _site(version: Version, fmt: Format, values: Mapping[str, Any], *, derived: bool, without: frozenset[str]) -> _Site:
    """Collect the stored and the derivable parts. values: without the options that select parts."""
    parts = fmt.selection.parts
    assert parts is not None
    available = recipes.available_layers(version).for_format(fmt)
    stored = tuple(sorted(key for key in available.keys if key.layer == parts.layer))
    makers = tuple(
        d
        for d in sorted(derive.all_derivations().values(), key=lambda d: (d.cost, d.name))
        if derived and d.part_names and d.gives == parts.layer and d.needs <= available.layers
    )
    option_names = {f.name for f in dataclasses.fields(fmt.write_options)}
    only_makers = frozenset().union(*(derive.parameter_names(d.name) for d in makers)) - option_names
    own_values = {name: value for name, value in values.items() if name not in only_makers}
    main, lacking = None, None
    if not stored or own_values.keys() - option_names:  # not stored, or to be derived with these parameters
        options = recipes.writer_options(fmt, own_values)
        try:
            main = recipes.plan_chain(fmt, available, options, derived=derived, values=own_values, without=without)
        except MissingLayer as error:
            lacking = error
        if main is not None and main.steps:
            stored = ()
        else:
            main = None
    needs = frozenset().union(*(maker.needs for maker in makers))
    keys = stored or (main.keys if main is not None else [key for key in available.keys if key.layer in needs])
    default = _default_level(version, keys)
    return _Site(version, fmt, parts, available, stored, main, lacking, makers, default, values, own_values)


def _default_level(version: Version, keys: Iterable[PartKey]) -> str:
    """Return ``ground`` if it has one of the parts to write, else the lowest level that has one."""
    placed = {key.level for key in keys if key.layer not in SITE_WIDE_LAYERS}
    levels = placed or {key.level for key in keys}
    if not levels or GROUND in levels:
        return GROUND
    heights = {level.name: level.elevation for level in version.levels}
    return min(levels, key=lambda level: (heights.get(level, 0.0), level))


def recipe(
    version: Version,
    fmt: Format,
    values: Mapping[str, Any],
    *,
    derived: bool,
    without: frozenset[str],
    archive: bool,
) -> Recipe:
    """Plan a map of several parts. Raises the errors of planning one part.

    values: one of the options that select parts is ``*``. Without a level, the default one is used; without a name,
    each level's default part. archive: whether to create a zip of the files.
    """
    parts = fmt.selection.parts
    assert parts is not None
    level, name = values.get(parts.level), values.get(parts.name)
    rest = {option: value for option, value in values.items() if option not in (parts.level, parts.name)}
    site = _site(version, fmt, rest, derived=derived, without=without)
    levels = None if level == ALL else frozenset({site.default if level is None else level})
    names = None if name in (ALL, None) else frozenset({name})
    if site.lacking is not None and not (names and any(names <= maker.part_names for maker in site.makers)):
        raise site.lacking
    members: list[Member] = []
    if site.main is None:
        members += _stored_members(site, levels, name, derived=derived)
    elif names is None or not any(names <= maker.part_names for maker in site.makers):
        members.append(_spread(site, site.main, levels, names, only_default=name is None))
    if name is not None:
        for maker in site.makers:
            if (names is None or names & maker.part_names) and _can_add_part(site, maker, levels):
                members.append(_derived_member(site, maker, levels, names))
    if not members:
        _raise_missing(site, level, name, derived=derived)
    return _assemble_recipe(site, members, archive=archive)


def _stored_members(site: _Site, levels: frozenset[str] | None, name: str | None, *, derived: bool) -> Iterable[Member]:
    """Yield one map for each stored part; on each level the default part has the default file name."""
    for level in sorted({key.level for key in site.stored}, key=lambda one: (one != site.default, one)):
        if levels is not None and level not in levels:
            continue
        names = [key.name for key in site.stored if key.level == level]
        names.sort(key=lambda one: (site.parts.stem(one) != one, one))  # of equal file names the first wins
        selection: list[str | None] = [None]
        if name == ALL:
            default = default_name(site.parts, names)
            selection = [None if one == default else one for one in names]
        elif name is not None:
            selection = [one for one in names if one == name]
        for one in selection:
            selected = {site.parts.level: level} | ({} if one is None else {site.parts.name: one})
            values = {**site.own_values, **selected}
            member_recipe = recipes.recipe(site.version, site.format.name, values, derived=derived)
            part = one or default_name(site.parts, names) or MAP
            yield Member(member_recipe, site.prefix(level), (level, part))


def default_name(parts: Parts, names: Sequence[str]) -> str | None:
    """Return the default part of a level: the one with the default name, else the only one."""
    if parts.default in names:
        return parts.default
    return names[0] if len(names) == 1 else None


def _spread(
    site: _Site,
    chain: DerivationChain,
    levels: frozenset[str] | None,
    names: frozenset[str] | None,
    *,
    only_default: bool = False,
    maker: Derivation | None = None,
) -> Member:
    """Build one map of all parts that the last step of a chain creates; a member may select some of its files."""
    makes = () if maker is None else tuple(sorted(maker.part_names))
    stored_parts = tuple(sorted((k.level, k.name) for k in site.stored if k.name in makes))
    spread = Spread(site.default, makes, stored_parts, optional=maker is not None)
    values = site.own_values if maker is None else site.values
    option_names = {f.name for f in dataclasses.fields(site.format.write_options)}
    options = recipes.writer_options(
        site.format, {option: value for option, value in values.items() if option in option_names}
    )
    return Member(
        recipes.recipe_of_chain(site.version, site.format, options, chain, spread),
        "",
        None,
        levels,
        names,
        only_default,
    )


def _chain_of_derivation(site: _Site, maker: Derivation) -> DerivationChain:
    """Build the chain of a derivation that creates named parts; it may use the frame of the layer's default part."""
    keys = (k for k in site.available.keys if k.layer in maker.needs or (k.layer, k.name) == (maker.gives, MAP))
    before = site.available.pinned.get(maker.gives, {}).get(maker.name, {})
    return DerivationChain(derive.with_parameters([maker.step()], {**before, **site.values}), tuple(sorted(keys)))


def _derived_member(
    site: _Site, maker: Derivation, levels: frozenset[str] | None, names: frozenset[str] | None
) -> Member:
    return _spread(site, _chain_of_derivation(site, maker), levels, names, maker=maker)


def _can_add_part(site: _Site, maker: Derivation, levels: frozenset[str] | None) -> bool:
    """Return whether a level with the derivation's inputs lacks one of its outputs."""
    stored_parts = {(key.level, key.name) for key in site.stored}
    able = {key.level for key in site.available.keys if key.layer in maker.needs}
    return any(
        (levels is None or level in levels) and any((level, n) not in stored_parts for n in maker.part_names)
        for level in able
    )


def _raise_missing(site: _Site, level: str | None, name: str | None, *, derived: bool) -> None:
    """Raise the error that planning one part would raise, or NotFound."""
    selected = {site.parts.level: level, site.parts.name: name}
    values = {**site.own_values, **{k: v for k, v in selected.items() if v not in (None, ALL)}}
    recipes.recipe(site.version, site.format.name, values, derived=derived)
    raise NotFound(f"{site.format.name}: no stored part matches this level and name")


def _assemble_recipe(site: _Site, members: Sequence[Member], *, archive: bool) -> Recipe:
    ingredients = [
        [m.recipe.key, m.folder, m.place, _sort_values(m.levels), _sort_values(m.names), m.only_default]
        for m in members
    ]
    text = orjson.dumps(["site", site.format.name, archive, ingredients])
    steps = tuple(dict.fromkeys(step for m in members for step in m.recipe.steps))
    keys = tuple(sorted({key for m in members for key in m.recipe.chain.keys}))
    options = members[0].recipe.options
    key = hashlib.sha256(text).hexdigest()
    return Recipe(
        site.version, site.format, options, DerivationChain(steps, keys), key, members=tuple(members), archive=archive
    )


def _sort_values(values: frozenset[str] | None) -> list[str] | None:
    return None if values is None else sorted(values)


def file_recipe(
    version: Version,
    fmt: Format,
    values: Mapping[str, Any],
    file: str,
    *,
    derived: bool,
    without: frozenset[str],
) -> Recipe | None:
    """Plan the map that contains one file of the site, by the file's name; None if it is no file of the site.

    values: of the request; a level or a name in them that is not ``*`` must match the file's. Raises NotFound if the
    file's folder is no level.
    """
    parts = fmt.selection.parts
    assert parts is not None
    rest = {option: value for option, value in values.items() if option not in (parts.level, parts.name)}
    level, name = (None if values.get(o) == ALL else values.get(o) for o in (parts.level, parts.name))
    folder, _, base = file.rpartition("/")
    if not folder and level is not None:
        return None  # a file of that level's own map
    site = _site(version, fmt, rest, derived=derived, without=without)
    of_file = level_of_folder(folder, site.levels) if folder else site.default
    if of_file is None or (level is not None and level != of_file):
        levels = ", ".join(sorted(site.levels))
        raise NotFound(f"{fmt.name} has no file {file!r}: no level has this folder; levels: {levels}")
    hints = dict(fmt.selection.from_filename(base))
    if name is None and parts.name in hints:
        name = _part_with_stem(site, of_file, hints[parts.name])
    kinds = {o: v for o, v in hints.items() if o != parts.name and _default_kinds(fmt).get(o) != v}
    maker = site.derivation_for(name, of_file) if name is not None else None
    if maker is not None:
        site = replace(site, values={**kinds, **site.values})
        return replace(_derived_member(site, maker, None, None).recipe, file=file)
    if site.main is not None and not kinds:  # same map as in the manifest: convert once
        return replace(_spread(site, site.main, None, None).recipe, file=file)
    if not folder and not _is_on_default_level(site, name):
        return None
    selected: dict[str, Any] = {parts.level: of_file} | ({} if name is None else {parts.name: name})
    part_recipe = recipes.recipe(
        version, fmt.name, {**hints, **site.own_values, **selected}, derived=derived, without=without
    )
    return replace(part_recipe, file=base)


def _default_kinds(fmt: Format) -> dict[str, str]:
    """Collect the options that all default file names of the format imply: PGM is the default."""
    hints = [dict(fmt.selection.from_filename(name)) for name in fmt.files]
    values = {option: {one[option] for one in hints if option in one} for one in hints for option in one}
    return {option: next(iter(choices)) for option, choices in values.items() if len(choices) == 1}


def _part_with_stem(site: _Site, level: str, stem: str) -> str:
    """Return the name of the stored part of a level whose files have this stem, else the stem."""
    names = [key.name for key in site.stored if key.level == level]
    if stem in names:
        return stem
    return next((name for name in names if site.parts.stem(name) == stem), stem)


def _is_on_default_level(site: _Site, name: str | None) -> bool:
    """Return whether the default level has a part of this name (None: any)."""
    if site.main is not None:
        return site.default != GROUND  # on ground, planning one part finds it
    return any(key.level == site.default and name in (None, key.name) for key in site.stored)


def select(files: Iterable[Any], member: Member) -> list[Any]:
    """Select the files of a member's map that belong to the site. ``place`` of each: level and name of the part."""
    candidates = [f for f in files if member.place is not None or _fits(f.place, member)]
    if not member.only_default:
        return candidates
    out = []
    for level in dict.fromkeys(f.place[0] for f in candidates):
        level_files = [f for f in candidates if f.place[0] == level]
        parts = member.recipe.format.selection.parts
        assert parts is not None
        default = default_name(parts, list(dict.fromkeys(f.place[1] for f in level_files)))
        out += [f for f in level_files if f.place[1] == default]
    return out


def _fits(place: tuple[str, str] | None, member: Member) -> bool:
    if place is None:
        return False
    level, name = place
    return (member.levels is None or level in member.levels) and (member.names is None or name in member.names)


def no_parts_error(recipe: Recipe) -> NotFound:
    """Build the error for a site without a matching stored or derivable part."""
    return NotFound(f"{recipe.format.name}: no part has this level and name, and none can be derived")
