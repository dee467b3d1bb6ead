"""KML: drawings from Google Earth and similar tools, and exports of any map to view there.

Positions are longitude, latitude[, altitude], degrees WGS 84. A placemark or overlay is one object; content beyond the
canonical properties is stored and written again (see ``kml.reading``). Files that a drawing refers to are never
fetched. Source: OGC 12-007r2 (KML 2.3), Google's ``gx`` extension.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from xml.sax.saxutils import unescape

from app.formats import Claims, Files, Format, ReadContext, Traits, WriteContext, register
from app.formats.kml import rules
from app.formats.kml.reading import read_kml
from app.formats.kml.words import MAIN
from app.formats.kml.writing import NEEDS, write_kml
from app.model.layers import Layers
from app.parameters import parameter
from app.syntax.archives import is_archive

_HREF = re.compile(rb"<href>([^<]+)</href>")
_HEADS = (b"<kml", b":kml", b"opengis.net/kml", b"earth.google.com/kml")


@dataclass(frozen=True, slots=True)
class WriteOptions:
    """Files to write beside the drawing."""

    pictures: bool = parameter(False, "also write the images of grids and imagery as files beside the KML")


def detect(name: str, data: bytes) -> bool:
    """Detect a .kml file, or a file with a kml root element."""
    if is_archive(data):
        return False
    head = data[:4096]
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        head = head.replace(b"\0", b"")
    return name.lower().endswith(".kml") or (b"<" in head[:16] and any(marker in head for marker in _HEADS))


def companions(main: str, data: bytes, names: Sequence[str]) -> list[str]:
    """Return the images of our own overlays beside the drawing."""
    if b'"fleetmap"' not in data or b"<GroundOverlay" not in data:
        return []
    folder = main[: main.rfind("/") + 1]
    paths = {folder + unescape(href.decode("utf-8", "replace")) for href in _HREF.findall(data)}
    return [name for name in names if name in paths]


def read(files: Files, context: ReadContext) -> Layers:
    """Read the objects of a drawing, or the layers that we wrote into it."""
    folder = context.main[: context.main.rfind("/") + 1]
    images = {n.removeprefix(folder): d for n, d in files.items() if n.startswith(folder) and n != context.main}
    layers, _ = read_kml(files[context.main], context, images)
    return layers


def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """Write the uploaded drawings unchanged, and all other content as placemarks of our own."""
    files = sum(len(p.files) for k, p in layers.parts_of("resources", name="kmz").items() if hasattr(p, "files"))
    context.drop("resources", files, "only KMZ contains images and further files of a drawing")
    pictures = isinstance(context.options, WriteOptions) and context.options.pictures
    written = write_kml(layers, context, with_pictures=pictures, taken=frozenset())
    return {MAIN: written.kml, **written.pictures}


register(
    Format(
        name="kml",
        title="KML",
        files={MAIN: "application/vnd.google-earth.kml+xml"},
        layers=frozenset({"location", "objects", "topology", "zones", "occupancy", "imagery"}),
        detect=detect,
        read=read,
        check=rules.check,
        write=write,
        needs=NEEDS,
        version=3,
        write_options=WriteOptions,
        extensions=(".kml",),
        claims=Claims(priority=10, companions=companions),
        traits=Traits(is_drawing=True, outlines=True, marks_blocked=True, has_title=True),
    )
)
