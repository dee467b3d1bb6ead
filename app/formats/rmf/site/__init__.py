"""map.site.json, map.site.ron: sites of the Open-RMF site editor, the successor of the traffic editor's buildings.

A site has levels with anchors (positions in metres), and walls, doors, floors and drawings on them; lifts, whose cabins
have their own anchors; models; and, shared by all levels, the navigation graphs with lanes and locations. Releases of
the editor up to 2024 wrote RON, later ones write JSON; both are read, including members that only the older ones have.
``geographic_offset`` is the latitude and longitude of (0, 0); the editor treats the +y axis as UTM north.

Canonical: as a building (``openrmf``), with its keys, so that either format can be written from the other, and
navigation graphs from both. An anchor is a node unless only walls, doors or floors use it; its id is the name of its
location, else ``<level>/<id>``. An anchor in a lift's cabin is a node on each level from which a lane leads to it. A
lane is an edge there and, unless its reverse is disabled, an edge back. Data of an item that only a site has is in its
``properties.rmf_site``, such data of a level and of the site in the documents' ``rmf_site``: ``{site, level, order}``.

Source: open-rmf/rmf_site, crates/rmf_site_format; crates/rmf_site_editor/src/site (lift.rs, georeference.rs, save.rs).
"""

from __future__ import annotations

import re

from app.formats import Claims, Format, LayerRequirements, Selection, Traits, register
from app.formats.rmf.common import BUILDING, choose_building
from app.formats.rmf.images import companion_hook
from app.formats.rmf.site import rules
from app.formats.rmf.site.draft import WriteOptions
from app.formats.rmf.site.reading import read
from app.formats.rmf.site.vocabulary import NAME
from app.formats.rmf.site.writing import FILE, FILE_RON, write

_JSON_SITE = re.compile(rb'"format_version"\s*:\s*"')
_RON_SITE = re.compile(rb'\bformat_version\s*:\s*"')
_OF_SITE = re.compile(rb'[\s,{("](?:levels|navigation|geographic_offset|model_instances)"?\s*:')


def detect(name: str, data: bytes) -> bool:
    """Detect JSON or RON with a format version and members that only a site has."""
    low = name.lower()
    if low.endswith(".json"):
        return bool(_JSON_SITE.search(data) and _OF_SITE.search(data))
    return low.endswith(".ron") and bool(_RON_SITE.search(data) and _OF_SITE.search(data))


def options_from_filename(name: str) -> dict[str, str]:
    """Select RON for ``map.site.ron``."""
    return {"encoding": "ron" if name.endswith(".ron") else "json"} if name.endswith((".ron", ".json")) else {}


register(
    Format(
        name=NAME,
        title="Site (Open-RMF site editor)",
        files={FILE: "application/json", FILE_RON: "text/plain"},
        layers=frozenset({"topology", "objects", "resources"}),
        detect=detect,
        read=read,
        check=rules.check,
        write=write,
        needs=LayerRequirements(one_of=(frozenset({"topology"}),), also=frozenset({"objects", "resources"})),
        write_options=WriteOptions,
        extensions=(".site.json", ".site.ron", ".json", ".ron"),
        selection=Selection(choose=choose_building, from_filename=options_from_filename),
        claims=Claims(
            priority=45, companions=companion_hook(re.compile(rb'\b(?:Local|Remote)"?\s*[:(]\s*"([^"\n]{1,500})"'))
        ),
        traits=Traits(family=BUILDING, keeps_bends="nodes", has_title=True),
    )
)
