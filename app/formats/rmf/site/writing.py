"""Writing an Open-RMF site from a site, a building, navigation graphs, or any other network.

Elements keep their source ids; new ones get the smallest free ids. An element uses its source anchors if they are
still at its position, else any anchor there, else a new one: geometry takes precedence.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import orjson

from app.errors import MissingLayer
from app.formats import WriteContext
from app.formats.rmf import common
from app.formats.rmf.common import Storey, mapping
from app.formats.rmf.site import vocabulary
from app.formats.rmf.site.draft import Draft, Lift
from app.formats.rmf.site.lift_writing import LiftWriter
from app.formats.rmf.site.model_writing import ModelWriter
from app.formats.rmf.site.network_writing import NetworkWriter
from app.formats.rmf.site.object_writing import ObjectWriter
from app.formats.rmf.site.vocabulary import VERSION
from app.model.layers import Layers
from app.syntax import ron

FILE, FILE_RON = "map.site.json", "map.site.ron"
ZOOM = 15
"""Default zoom level of the map tiles behind a site."""


def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """Write ``map.site.json`` or ``map.site.ron``, and the drawings that it names.

    Raises MissingLayer if there is neither a network nor anything that came from Open-RMF.
    """
    storeys = common.storeys(layers)
    if not storeys:
        raise MissingLayer("rmf_site needs a network: upload a site.json, building.yaml, tmap2 or OSM file")
    draft = Draft(layers, context, storeys)
    site = vocabulary.sort_members(_Writer(draft).site())
    if draft.options.encoding == "ron":
        main = {FILE_RON: ron.dump(site, vocabulary.SHAPE)}
    else:
        main = {FILE: orjson.dumps(site, option=orjson.OPT_INDENT_2 | orjson.OPT_APPEND_NEWLINE)}
    return {**main, **dict(sorted(draft.used.items()))}


class _Writer:
    """Writer of one site."""

    def __init__(self, draft: Draft) -> None:
        self.draft, self.models = draft, ModelWriter(draft)
        self.networks, self.objects = NetworkWriter(draft, self.models), ObjectWriter(draft, self.models)
        self.lifts = LiftWriter(draft)

    def site(self) -> dict[str, Any]:
        """Return the site as a JSON-like value."""
        self.lifts.write()
        for floor in self.draft.floors:
            self.networks.write_nodes(floor)
        everywhere: dict[str, str] = {}
        for floor in self.draft.floors:
            everywhere = {**floor.nodes, **everywhere}
        self.networks.write_lanes(everywhere)
        for floor in self.draft.floors:
            self.objects.write_objects(floor)
            self.objects.write_images(floor)
            floor.element["anchors"] = dict(floor.anchors)
        for lift in self.draft.lifts.values():
            lift.element["cabin_anchors"] = lift.anchors
        self._report()
        properties = self._properties()
        dangling = mapping(self.draft.site.get("dangling"), "dangling")
        guided = {
            **self.draft.guided,
            "graphs": self.draft.graphs,
            "ranking": self._ranking(),
            "lanes": {**self.draft.lanes, **mapping(dangling.get("lanes"), "dangling")},
            "locations": {**self.draft.locations, **mapping(dangling.get("locations"), "dangling")},
        }
        if self.draft.mutexes or "mutex_groups" in guided:
            guided["mutex_groups"] = self.draft.mutexes
        instances = {**self.draft.instances, **mapping(dangling.get("model_instances"), "dangling")}
        navigation = {**mapping(self.draft.site.get("navigation"), "navigation"), "guided": guided}
        out = {
            **{k: v for k, v in self.draft.site.items() if k not in ("dangling", "models")},
            "format_version": self.draft.site.get("format_version", VERSION),
            "properties": properties,
            "levels": {floor.id: floor.element for floor in self.draft.floors},
        }
        collected = {
            "anchors": self.draft.anchors,
            "textures": self.draft.textures,
            "fiducial_groups": self.draft.groups,
            "lifts": {str(k): lift.element for k, lift in self._lifts_by_id()},
            "scenarios": self.models.scenarios(instances),
            "model_descriptions": self.draft.descriptions,
            "robots": self.draft.robot_types,
            "model_instances": instances,
        }
        out |= {key: value for key, value in collected.items() if value or key in self.draft.site}
        if any(guided[key] for key in ("graphs", "lanes", "locations")):
            out["navigation"] = navigation
        else:
            out.pop("navigation", None)
        return out

    def _lifts_by_id(self) -> Iterable[tuple[str, Lift]]:
        return ((lift.element.pop("id"), lift) for lift in self.draft.lifts.values())

    def _properties(self) -> dict[str, Any]:
        out = dict(mapping(self.draft.site.get("properties"), "properties"))
        if "name" not in out:
            source_value = next(
                (s.document["building"].get("name") for s in self._storeys() if "building" in s.document), None
            )
            out["name"] = (
                source_value
                if isinstance(source_value, str) and source_value
                else self.draft.options.building or self.draft.context.title
            )
            if out["name"] != source_value:
                self.draft.context.fill("properties.name", out["name"], "no source names the site", "building")
        datum = self.draft.layers.datum
        if datum is not None:
            was = mapping(out.get("geographic_offset"), "geographic_offset")
            source_value = was.get("anchor")
            now = [datum.latitude, datum.longitude]
            same = isinstance(source_value, list) and [np.float32(v) for v in source_value] == [
                np.float32(v) for v in now
            ]
            offset = {"zoom": ZOOM, "visible": False, **was, "anchor": source_value if same else now}
            out["geographic_offset"] = offset
            why = "a site's +y axis is north, and (0, 0) has no altitude"
            self.draft.context.drop("the datum's heading", abs(datum.heading) > 1e-9, why)
            self.draft.context.drop("the datum's altitude", datum.altitude != 0, why)
        return out

    def _storeys(self) -> Iterable[Storey]:
        return (floor.storey for floor in self.draft.floors)

    def _ranking(self) -> list[int]:
        ranking = [i for i in self.draft.guided.get("ranking") or [] if str(i) in self.draft.graphs]
        return ranking + [int(i) for i in self.draft.graphs if int(i) not in ranking]

    def _report(self) -> None:
        draft = self.draft
        for noun, count in sorted(draft.dropped.items()):
            draft.context.drop(noun, count, "a site cannot store it")
        if draft.created["lanes"]:
            why = f"{draft.created['lanes']} edges come from another format"
            draft.context.fill("lanes: graphs", draft.options.graph, why, "graph")
            draft.context.fill(
                "lanes: speed_limit", draft.options.speed_limit, f"{why}; used for those without one", "speed_limit"
            )
        draft.robots.report(draft.context)
        if draft.created["lifts"]:
            draft.context.fill("lifts: doors", "none", f"{draft.created['lifts']} lifts come from a navigation graph")
