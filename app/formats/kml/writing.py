"""Write KML: uploaded drawings unchanged, all other content as placemarks of our own (see ``reading``)."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import orjson
import shapely

from app.formats import LayerRequirements, WriteContext
from app.formats.kml.drawings import Document, fill_drawings, group_by_drawing, unique_names, wrap_document
from app.formats.kml.overlays import write_overlays
from app.formats.kml.texts import (
    GX,
    KML,
    bracket,
    coordinate_texts,
    data_element,
    degree_texts,
    geometry_element,
    place_members,
)
from app.formats.kml.words import END, FAMILY, OWN_ELEMENT, OWN_KEYS, STYLE, escape, quote_attribute, spell
from app.model.areas import AREA_COLOUR, AREA_KINDS, AREA_OPACITY
from app.model.features import Features, Properties
from app.model.frame import GROUND
from app.model.geodesy import LocalFrame
from app.model.layers import Layer, Layers, PartKey
from app.syntax import decimals

ATOM = "http://www.w3.org/2005/Atom"
HEAD = '<?xml version="1.0" encoding="UTF-8"?>\n'
_NAMESPACES = f'xmlns="{KML}" xmlns:gx="{GX}" xmlns:kml="{KML}" xmlns:atom="{ATOM}"'

NEEDS = LayerRequirements(
    (
        frozenset({"objects"}),
        frozenset({"topology"}),
        frozenset({"location"}),
        frozenset({"zones"}),
        frozenset({"occupancy"}),
    ),
    anchor="wgs84",
)
"""Alternatives of layers that ``write_kml`` can draw."""

_AREA = "{2:02x}{1:02x}{0:02x}".format(*AREA_COLOUR)
_COLOURS = {
    "node": "<IconStyle><color>ff00a5ff</color><scale>0.6</scale><Icon><href>"
    "http://maps.google.com/mapfiles/kml/shapes/shaded_dot.png</href></Icon></IconStyle>",
    "edge": "<LineStyle><color>ff00a5ff</color><width>3</width></LineStyle>",
    "location": "<LineStyle><color>ff2f2fd3</color><width>4</width></LineStyle>"
    "<PolyStyle><color>402f2fd3</color></PolyStyle>",
    "zone": "<LineStyle><color>ff2f2fd3</color><width>2</width></LineStyle>"
    "<PolyStyle><color>802f2fd3</color></PolyStyle>",
    "area": f"<LineStyle><color>ff{_AREA}</color><width>1</width></LineStyle>"
    f"<PolyStyle><color>{round(255 * AREA_OPACITY):02x}{_AREA}</color></PolyStyle>",
    "object": "<LineStyle><color>ffb0b0b0</color><width>2</width></LineStyle>"
    "<PolyStyle><color>60b0b0b0</color></PolyStyle>",
}
"""Our styles, by use; colours are aabbggrr."""


@dataclass(frozen=True, slots=True)
class WrittenKml:
    """A KML file, the images that it refers to, and the name of its only source inside an archive, if any."""

    kml: bytes
    pictures: dict[str, bytes]
    entry: str | None


def write_kml(layers: Layers, context: WriteContext, *, with_pictures: bool, taken: frozenset[str]) -> WrittenKml:
    """Write all vector layers and the positions of grids. with_pictures: also image files; taken: names in use."""
    frame = layers.frame
    documents: list[Document] = []
    folders: list[str] = []
    drawn = {i for part in layers.vector("objects").values() for i in part.ids}
    parts = group_by_drawing(layers)
    claimed = {text for part in parts.values() for text in _attribution_texts(part)}
    shared = [text for text in context.attribution if text not in claimed]
    for key in sorted(parts):
        part = parts[key]
        remainder: Features | None = part
        if key.layer == "objects" and key.name == FAMILY:
            drawings, remainder = fill_drawings(key, part, frame, context)
            documents += drawings
        elif key.layer == "topology":
            remainder = _drop_drawing(part, drawn)
        if remainder is not None:
            folders.append(_folder(key, remainder, layers, frame, shared))
    overlays, pictures = write_overlays(layers, context, with_pictures, taken)
    # A single uploaded drawing is written unchanged: the datum is written only with our own content.
    datum = [_datum(layers)] if folders or overlays or not documents else []
    ours = "".join([*datum, *folders, *overlays])
    context.drop("voxels", len(layers.parts_of("voxels")), "KML cannot express it")
    entry = documents[0].entry if len(documents) == 1 else None
    return WrittenKml((HEAD + _file(documents, ours, context)).encode(), pictures, entry)


def _file(documents: list[Document], ours: str, context: WriteContext) -> str:
    """Combine drawings and our own folders into one document, in the simplest lossless form."""
    if len(documents) == 1:
        only = documents[0].xml
        if not ours and all(escape(text) in only for text in context.attribution):
            return only.replace(END, "") + "\n"
        if END in only and not re.match(r"<[\w.-]+:", only):
            return only.replace(END, _map(ours, context, [])) + "\n"
    inner = unique_names([d.xml.replace(END, "") for d in documents])
    wrapped = [wrap_document(d, xml) for d, xml in zip(documents, inner, strict=True)]
    return f"<kml {_NAMESPACES}>{_map(ours, context, wrapped)}</kml>\n"


def _map(ours: str, context: WriteContext, documents: list[str]) -> str:
    """Write our own Document: its styles, our own data, and embedded documents."""
    credit = escape("\n".join(context.attribution))
    styles = "".join(f'<Style id="{STYLE}{n}">{s}</Style>' for n, s in _COLOURS.items() if f"#{STYLE}{n}<" in ours)
    return "".join(
        [
            f"<Document><name>{escape(context.title)}</name>",
            f"<description>{credit}</description>" if credit else "",
            styles,
            f"<ExtendedData>{data_element(OWN_ELEMENT, 'map')}</ExtendedData>\n",
            *documents,
            ours,
            "</Document>",
        ]
    )


def _drop_drawing(part: Features, drawn: set[str]) -> Features | None:
    """Return a network without the part derived from a drawing that is also written; None if nothing else is in it."""
    mask = [isinstance(i := p.get("drawn_from"), str) and i in drawn for p in part.properties]
    if not any(mask):
        return part
    return part.select(~np.array(mask)) if not all(mask) else None


def _datum(layers: Layers) -> str:
    """Write the environment's datum as a placemark; its exact numbers are in its ExtendedData."""
    datum = layers.datum
    if datum is None:
        return ""
    data = "".join(data_element(n, v) for n, v in {"kind": "datum", **datum.as_dict()}.items())
    at = ",".join(decimals.numbers([datum.longitude, datum.latitude], decimals.DEGREES))
    return (
        f"<Placemark><name>datum</name><ExtendedData>{data_element('layer', 'location')}{data}</ExtendedData>"
        f"<Point><coordinates>{at}</coordinates></Point></Placemark>\n"
    )


def _attribution_texts(part: Features) -> list[str]:
    """Return the licences and credits in a part's own document."""
    attribution = part.document.get("attribution")
    return [text for text in attribution if isinstance(text, str)] if isinstance(attribution, list) else []


def _folder(key: PartKey, part: Features, layers: Layers, frame: LocalFrame | None, shared: Sequence[str] = ()) -> str:
    """Write a part with our own data. shared: credits that are in no part's document."""
    data = [data_element(OWN_ELEMENT, "part"), place_members(key)]
    elevation = layers.elevation(key.level)
    if elevation:
        data.append(data_element("elevation", elevation))
    document = part.document if key.name != FAMILY else {}
    if shared and key.name != FAMILY:
        document = {**document, "attribution": [*_attribution_texts(part), *shared]}
    if document:
        data.append(data_element("document", dict(document)))
    title = key.layer if key.level == GROUND else f"{key.layer}, {key.level}"
    return "".join(
        [
            f"<Folder><name>{escape(title)}</name><ExtendedData>{''.join(data)}</ExtendedData>\n",
            *_placemarks(key, part, frame),
            "</Folder>\n",
        ]
    )


def _placemarks(key: PartKey, part: Features, frame: LocalFrame | None) -> Iterator[str]:
    """Write every item of a part as a placemark with all its properties."""
    geometry = part.in_wgs84(frame)
    texts = degree_texts(geometry)
    exact = _local_texts(part)
    part_data = place_members(key)
    opening: dict[str, str] = {}
    types = shapely.get_type_id(geometry).tolist()
    for k, (i, p) in enumerate(zip(part.ids, part.properties, strict=True)):
        out = ["<Placemark>"]
        data = [part_data, f'<Data name="id"><value>{spell(i)}</value></Data>']
        more: dict[str, Any] = {}
        for label in sorted(p):
            value = p[label]
            if label == "name" and isinstance(value, str) and value == value.strip() != "":
                shown = escape(value)
                if "\ufffd" not in shown:
                    out.append(f"<name>{shown}</name>")
                    continue
            start = opening.get(label)
            if start is None:
                plain = label not in OWN_KEYS and label and label.isprintable() and label == label.strip()
                start = opening[label] = f'<Data name="{quote_attribute(label)}"><value>' if plain else ""
            if start:
                data.append(f"{start}{spell(value)}</value></Data>")
            else:
                more[label] = value
        if more:
            data.append(data_element("more", more))
        if exact[k]:
            data.append(f'<Data name="local"><value>{exact[k]}</value></Data>')
        if types[k] == 7 and not geometry[k].is_empty:
            data.append('<Data name="geometry"><value>GeometryCollection</value></Data>')
        out.append(f"<styleUrl>#{STYLE}{_style(key.layer, p)}</styleUrl><ExtendedData>{''.join(data)}</ExtendedData>")
        if types[k] == 0 and texts.start[k] < texts.start[k + 1] and not geometry[k].is_empty:
            out.append(f"<Point><coordinates>{texts.texts[texts.start[k]]}</coordinates></Point>")
        else:
            out.append(geometry_element(geometry[k], iter(texts.texts_of(k))))
        out.append("</Placemark>\n")
        yield "".join(out)


def _style(layer: Layer, properties: Properties) -> str:
    if layer == "topology":
        return "edge" if properties.get("kind") == "edge" else "node"
    if layer == "zones":
        return "area" if properties.get("kind") in AREA_KINDS else "zone"
    return "location" if layer == "location" else "object"


def _local_texts(part: Features) -> list[str]:
    """Write the exact metres of local items as JSON, an empty text for the others."""
    out = [""] * len(part)
    indices = np.flatnonzero(part.local)
    if not len(indices):
        return out
    geometry = part.geometry[indices]
    texts = coordinate_texts(geometry, decimals.METRES, bracket, ",")
    for n, k in enumerate(indices.tolist()):
        shape, lists = texts.shape[n], texts.texts_of(n)
        if shape == "P":
            out[k] = lists[0]
        elif shape == "L":
            out[k] = f"[{lists[0]}]"
        elif shape[:1] == "A":
            out[k] = f"[[{'],['.join(lists)}]]"
        else:
            out[k] = orjson.dumps(orjson.loads(shapely.to_geojson(geometry[n]))).decode()
        if "[]" in out[k] and not geometry[n].is_empty:
            out[k] = orjson.dumps(orjson.loads(shapely.to_geojson(geometry[n]))).decode()
    return out
