"""Resolve parts of several files with the same key: join parts that belong together, else choose one."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import PurePosixPath

import shapely

from app.errors import Problem
from app.model.features import Features, concatenate, unique_ids
from app.model.layers import Part, PartKey, Resources
from app.upload_reader.bundle import Bundle, ParsedPart
from app.upload_reader.drawings import SAME_PLACE_DEGREES

_SINGLE_SOURCE_LAYERS: Mapping[str, str] = {
    "topology": "network",
    "location": "location",
    "occupancy": "grid {name}",
    "voxels": "voxel map {name}",
    "imagery": "image {name}",
}
"""Names shown to users of the layers that come from one file only."""


def resolve_conflicts(parsed_parts: list[ParsedPart], bundle: Bundle) -> None:
    """Join parts that belong together; of several files with the same network, site or grid, use one."""
    by_key: dict[PartKey, list[ParsedPart]] = {}
    for one in parsed_parts:
        by_key.setdefault(one.key, []).append(one)
    useful: set[str] = set()
    renamed: dict[str, dict[str, str]] = {}
    for key, rivals in sorted(by_key.items()):  # objects come before the topology read from the same drawing
        winners = rivals
        if key.layer in _SINGLE_SOURCE_LAYERS and len(rivals) > 1:
            rivals.sort(key=_priority)
            winners = rivals[:1]
            for loser in rivals[1:]:
                if key.layer == "location" and _merge_fence_style(winners, loser):
                    useful.add(loser.group.main)
                    continue
                noun = _SINGLE_SOURCE_LAYERS[key.layer].format(name=key.name)
                reason = f"its {noun} is ignored: {winners[0].group.main} takes precedence"
                bundle.warnings.append(Problem(reason, loser.group.main))
        useful.update(w.group.main for w in winners)
        bundle.parts[key] = _join(winners, renamed)
        names = tuple(sorted({n for w in winners for n in w.group.files}))
        bundle.origin[key] = (names, winners[0].group.format.name)
    for one in parsed_parts:
        if one.group.main not in useful:
            for name in one.group.files:
                bundle.files[name].used = False


def _merge_fence_style(winners: list[ParsedPart], loser: ParsedPart) -> bool:
    """Merge name and style of a drawn fence into an equal one that takes precedence. Returns whether they are equal."""
    site, drawn = winners[0].part, loser.part
    if not (isinstance(site, Features) and isinstance(drawn, Features) and len(site) == len(drawn) == 1):
        return False
    if site.local.any() or drawn.local.any():
        return False
    if shapely.hausdorff_distance(site.geometry[0], drawn.geometry[0]) >= SAME_PLACE_DEGREES:
        return False
    properties = ({**drawn.properties[0], **site.properties[0]},)
    part = Features(site.ids, site.geometry, properties, site.local, {**drawn.document, **site.document})
    winners[0] = ParsedPart(winners[0].key, part, winners[0].group)
    return True


def _priority(one: ParsedPart) -> tuple[object, ...]:
    name = PurePosixPath(one.group.main).name
    return (-one.group.format.claims.priority, name.startswith("."), "_autogen" in name, len(name), one.group.main)


def _join(candidates: list[ParsedPart], renamed: dict[str, dict[str, str]]) -> Part:
    """Join several files' parts of one key. Duplicate ids get a suffix, recorded in ``renamed``."""
    if len(candidates) == 1:
        part = candidates[0].part
        new = renamed.get(candidates[0].group.main, {})
        if candidates[0].key.layer == "topology" and isinstance(part, Features) and new:
            properties = [
                {**p, "drawn_from": new[i]} if isinstance(i := p.get("drawn_from"), str) and i in new else p
                for p in part.properties
            ]
            part = Features(part.ids, part.geometry, tuple(properties), part.local, part.document)
        return part
    if candidates[0].key.layer == "resources":
        files: dict[str, bytes] = {}
        for one in candidates:
            files.update(one.part.files if isinstance(one.part, Resources) else {})
        return Resources(files)
    taken: set[str] = set()
    collections = []
    for one in candidates:
        part = one.part
        assert isinstance(part, Features)
        ids = tuple(unique_ids(part.ids, taken))
        taken.update(ids)
        if ids != part.ids:
            renamed[one.group.main] = {a: b for a, b in zip(part.ids, ids, strict=True) if a != b}
            part = Features(ids, part.geometry, part.properties, part.local, part.document)
        collections.append(part)
    return concatenate(collections)
