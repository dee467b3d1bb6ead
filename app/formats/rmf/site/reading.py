"""Reading a site: the parts of its levels, and documents like those of a building."""

from __future__ import annotations

from typing import Any

from app.formats import Files, ReadContext
from app.formats.rmf.common import BUILDING, mapping, raise_unreadable
from app.formats.rmf.images import images
from app.formats.rmf.site import vocabulary
from app.formats.rmf.site.network_reading import NetworkReader
from app.formats.rmf.site.object_reading import ObjectReader
from app.formats.rmf.site.source import Source, SourceLevel
from app.formats.rmf.site.vocabulary import NAME, elements, references, text
from app.model.features import Properties, features
from app.model.frame import GROUND, Level
from app.model.layers import NETWORK, Layers, Part, PartKey, Resources
from app.syntax import json, ron

_LISTS = frozenset({"anchors", "doors", "floors", "walls", "models", "drawings"})
"""Item sections of a level; its other members stay in the document."""


def read(files: Files, context: ReadContext) -> Layers:
    """Read topology and objects of each level, the uploaded drawings, and the site's datum.

    Raises UnreadableFile with the location.
    """
    main = context.main or next(iter(files))
    data = files[main]
    top = ron.load(data, context.limits) if _is_ron(main, data) else json.load(data, context.limits)
    if not isinstance(top, dict):
        raise_unreadable("must be a site: a mapping with format_version and levels", "")
    reader = _SiteReader(top, context)
    parts = reader.parts()
    pictures = images(files, main, list(reader.source.drawings()), context)
    if pictures and context.wants("resources"):
        parts[PartKey("resources", GROUND, BUILDING)] = Resources(pictures)
    parts = {key: part for key, part in parts.items() if context.wants(key.layer)}
    levels = tuple(Level(level.name, level.elevation) for level in reader.source.levels.values())
    return Layers(parts, reader.source.datum(), levels)


def _is_ron(name: str, data: bytes) -> bool:
    start = data[:4096].removeprefix(b"\xef\xbb\xbf").lstrip()[:1]
    return start in (b"(", b"#", b"/") or (start != b"{" and name.lower().endswith(".ron"))


class _SiteReader:
    """Reader of a site's parts."""

    def __init__(self, top: dict[str, Any], context: ReadContext) -> None:
        self.source = Source(top, context)
        self.networks = NetworkReader(self.source)
        self.objects = ObjectReader(self.source)

    def parts(self) -> dict[PartKey, Part]:
        """Return a network and objects for each level."""
        source = self.source
        taken: set[str] = set()
        networks = self.networks.read(taken)
        lifts: dict[str, list[tuple[str, Any, Properties]]] = {}
        for k, lift in enumerate(source.lifts):
            home, row = self.objects.lift_row(k, lift)
            lifts.setdefault(home, []).append(row)
        objects = {i: [*self.objects.read(level), *lifts.get(i, [])] for i, level in source.levels.items()}
        building = self._building()
        out: dict[PartKey, Part] = {}
        site = {
            **{k: v for k, v in source.top.items() if k not in ("levels", "lifts", "model_instances", "navigation")},
            "navigation": {
                **{k: v for k, v in mapping(source.top.get("navigation"), "navigation").items() if k != "guided"},
                "guided": {k: v for k, v in source.guided.items() if k not in ("lanes", "locations")},
            },
        }
        if source.placed:
            site["models"] = sorted(int(i) for listed in source.placed.values() for i, _ in listed)
        if source.dangling:
            site["dangling"] = source.dangling
        digest = vocabulary.digest(site)
        for i, level in source.levels.items():
            document = {BUILDING: building[i], NAME: {"of": digest, **self._document(level)}}
            if not level.order:
                document[NAME]["site"] = site
            out[PartKey("topology", level.name, NETWORK)] = networks[i].with_document(document)
            out[PartKey("objects", level.name, BUILDING)] = features(objects[i], "local", document)
        if not taken:  # without a network the map is one of this family only
            for level in source.levels.values():
                network = out.pop(PartKey("topology", level.name, NETWORK))
                out[PartKey("topology", level.name, BUILDING)] = network
        source.warn_unknown()
        return out

    def _document(self, level: SourceLevel) -> dict[str, Any]:
        """Return the level's members that are neither items nor derived from items."""
        members = {key: value for key, value in level.element.items() if key not in _LISTS}
        members["id"] = level.id
        drawings: dict[str, Any] = {}
        for i, drawing in elements(level.element.get("drawings"), f"{level.location}.drawings"):
            location = f"{level.location}.drawings.{i}"
            drawings[i] = {k: v for k, v in drawing.items() if k not in ("anchors", "fiducials", "measurements")}
            drawings[i]["transform"] = self.source.transform(drawing, location)
            used: set[str] = set()
            for key, one in elements(drawing.get("measurements"), f"{location}.measurements"):
                used.update(references(one.get("anchors"), f"{location}.measurements.{key}.anchors", 2))
            used |= {str(one.get("anchor")) for _, one in elements(drawing.get("fiducials"), f"{location}.fiducials")}
            drawings[i]["anchors"] = {
                a: raw for a, raw in mapping(drawing.get("anchors"), location).items() if a not in used
            }
        forms = {
            anchor: raw
            for anchor, raw in mapping(level.element.get("anchors"), f"{level.location}.anchors").items()
            if anchor not in level.nodes and "Translate2D" not in raw
        }
        return {"level": members, "drawings": drawings, "forms": forms, "order": level.order}

    def _building(self) -> dict[str, dict[str, Any]]:
        """Build documents like a building's: in pixels if each level has a drawing, else in metres."""
        name = text(mapping(self.source.top.get("properties"), "properties").get("name"), "properties.name")
        drawings: dict[str, tuple[list[float], str]] = {}
        for i, level in self.source.levels.items():
            primary = self.source.primary(level)
            if primary is None:
                continue
            members = mapping(level.element["drawings"], "drawings")[primary]
            location = f"{level.location}.drawings.{primary}"
            _, file = vocabulary.asset(mapping(members.get("properties"), location).get("source"), location)
            drawings[i] = self.source.transform(members, location), file
        drawn = len(drawings) == len(self.source.levels)
        system = "reference_image" if drawn else "cartesian_meters"
        building: dict[str, Any] = {"name": name, "coordinate_system": system}
        straight = [i for i, (turn, _) in drawings.items() if turn[1:] == [0.0, 0.0, 0.0]]
        if drawn and straight:
            building["reference_level_name"] = self.source.levels[straight[0]].name
        out: dict[str, dict[str, Any]] = {}
        for i, level in self.source.levels.items():
            members = {"elevation": level.elevation}
            out[i] = {"building": building, "level": members, "order": level.order}
            if i in drawings:
                out[i]["transform"], file = drawings[i]
                members["drawing"] = {"filename": file}
        return out
