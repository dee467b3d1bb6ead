"""Rules of Open-RMF's site editor for sites: required members, existing ids, supported versions.

Source: open-rmf/rmf_site, crates/rmf_site_format (serde's attributes of each struct; nav_graph.rs for the export).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from app.errors import Problem
from app.formats import Files
from app.formats._rules import (
    LIMITS,
    duplicates,
    error_finding,
    is_brief,
    is_number,
    missing,
    names,
    numbers,
    shown,
    warning_finding,
)
from app.syntax import json, ron

REQUIRED: Mapping[str, tuple[str, ...]] = {
    "doors": ("anchors", "name", "kind"),
    "walls": ("anchors",),
    "floors": ("anchors",),
    "drawings": ("properties",),
    "lanes": ("anchors", "graphs"),
    "locations": ("anchor", "tags", "name", "graphs"),
    "lifts": ("cabin_doors", "properties", "cabin_anchors"),
    "model_instances": ("parent", "name", "pose", "description"),
}


def check(files: Files) -> Iterator[Problem]:
    """Check a site with the rules of its editor."""
    main = next(iter(files))
    if is_brief(files[main]):
        return
    top = ron.load(files[main], LIMITS) if main.endswith(".ron") else json.load(files[main], LIMITS)
    if not isinstance(top, dict):
        yield error_finding("a site must be a mapping", main)
        return
    version = top.get("format_version")
    if not isinstance(version, str) or not version.startswith("0.") or not version[2:].isdigit():
        yield error_finding(f'must be "0.MINOR", got {shown(version)}', main, where="format_version")
    properties = top.get("properties")
    if not isinstance(properties, dict) or not isinstance(properties.get("name"), str):
        yield error_finding("a site needs a name", main, where="properties.name")
    elif (offset := properties.get("geographic_offset")) is not None:
        if absent := missing(offset, ("anchor", "zoom", "visible")):
            yield error_finding(f"needs {', '.join(absent)}", main, where="properties.geographic_offset")
        elif not numbers(offset["anchor"], 2, 2) or not -80 <= offset["anchor"][0] <= 84:
            reason = "must be [latitude, longitude] within the zones of UTM (80° S to 84° N)"
            yield error_finding(reason, main, where="properties.geographic_offset.anchor")
    yield from _site(top, main)


def _section(members: Any, section: str, main: str, location: str) -> Iterator[Problem]:
    """Check that elements have their required members."""
    for i, one in _elements(members):
        if absent := missing(one, REQUIRED[section]):
            yield error_finding(f"needs {', '.join(absent)}", main, where=f"{location}.{i}")


def _elements(members: Any) -> list[tuple[str, Any]]:
    return list(members.items()) if isinstance(members, dict) else []


def _site(top: Mapping[str, Any], main: str) -> Iterator[Problem]:
    levels = _elements(top.get("levels"))
    if not levels:
        yield error_finding("a site needs at least one level", main, where="levels")
    site = {i for i, _ in _elements(top.get("anchors"))}
    ids = list(site)
    anchor_ids = set(site)
    for i, level in levels:
        location = f"levels.{i}"
        properties = level.get("properties") if isinstance(level, dict) else None
        if not isinstance(properties, dict) or not is_number(properties.get("elevation")) or "name" not in properties:
            yield error_finding("needs a name and an elevation", main, where=f"{location}.properties")
            continue
        level_anchors = {a for a, _ in _elements(level.get("anchors"))}
        ids += [i, *level_anchors]
        anchor_ids |= level_anchors
        for section in ("doors", "walls", "floors", "drawings"):
            yield from _section(level.get(section), section, main, f"{location}.{section}")
            ids += [key for key, _ in _elements(level.get(section))]
        for section in ("doors", "walls", "floors"):
            yield from _check_anchors(level.get(section), level_anchors | site, main, f"{location}.{section}")
    if repeats := duplicates(level["properties"].get("name") for _, level in levels if _is_named(level)):
        yield warning_finding(f"duplicate level names: {names(repeats)}", main, where="levels")
    for i, lift in _elements(top.get("lifts")):
        yield from _section({i: lift}, "lifts", main, "lifts")
        cabin = {a for a, _ in _elements(lift.get("cabin_anchors"))} if isinstance(lift, dict) else set()
        ids += [i, *cabin]
        anchor_ids |= cabin
        properties = lift.get("properties") if isinstance(lift, dict) else None
        yield from _check_anchors({i: _ends(properties)}, site, main, "lifts")
    yield from _navigation(top.get("navigation"), anchor_ids, ids, main)
    yield from _section(top.get("model_instances"), "model_instances", main, "model_instances")
    described = {i for i, _ in _elements(top.get("model_descriptions"))}
    dangling = [
        i
        for i, one in _elements(top.get("model_instances"))
        if isinstance(one, dict) and one.get("description") is not None and str(one["description"]) not in described
    ]
    if dangling:
        yield error_finding(f"models without a description: {names(dangling)}", main, where="model_instances")
    if repeats := duplicates(ids):
        yield error_finding(f"duplicate element ids: {names(repeats)}", main)


def _is_named(level: Any) -> bool:
    return isinstance(level, dict) and isinstance(level.get("properties"), dict)


def _ends(properties: Any) -> dict[str, Any]:
    return {"anchors": properties.get("reference_anchors")} if isinstance(properties, dict) else {}


def _check_anchors(members: Any, anchors: set[str], main: str, location: str) -> Iterator[Problem]:
    """Check that elements use existing anchors."""
    dangling = [
        i
        for i, one in _elements(members)
        if isinstance(one, dict) and any(str(a) not in anchors for a in one.get("anchors") or ())
    ]
    if dangling:
        yield error_finding(f"{names(dangling)} use anchors that do not exist", main, where=location)


def _navigation(navigation: Any, anchors: set[str], ids: list[str], main: str) -> Iterator[Problem]:
    guided = navigation.get("guided") if isinstance(navigation, dict) else None
    if not isinstance(guided, dict):
        return
    location = "navigation.guided"
    if absent := missing(guided, ("graphs", "ranking", "lanes", "locations")):
        yield error_finding(f"needs {', '.join(absent)}", main, where=location)
    for section in ("lanes", "locations"):
        yield from _section(guided.get(section), section, main, f"{location}.{section}")
        ids += [i for i, _ in _elements(guided.get(section))]
    yield from _check_anchors(guided.get("lanes"), anchors, main, f"{location}.lanes")
    places = {
        i: {"anchors": [one.get("anchor")]} for i, one in _elements(guided.get("locations")) if isinstance(one, dict)
    }
    yield from _check_anchors(places, anchors, main, f"{location}.locations")
    called = [one.get("name") for _, one in _elements(guided.get("locations")) if isinstance(one, dict)]
    if repeats := duplicates(name for name in called if name and name != "<Unnamed>"):
        yield warning_finding(f"duplicate location names: {names(repeats)}", main, where=f"{location}.locations")
