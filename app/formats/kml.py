"""KML: drawings from Google Earth and the like, and any map of ours to look at there.

Positions are longitude, latitude[, altitude], degrees WGS 84. A placemark or overlay is one object; whatever the file
says beyond the canonical words is kept and comes back (``_kml`` tells how). Nothing that a file refers to is fetched.
Source: OGC 12-007r2 (KML 2.3), Google's ``gx`` extension.
"""

from __future__ import annotations

from app.formats import Files, Format, ReadContext, WriteContext, _kml_rules, register
from app.formats._archive import is_archive
from app.formats._kml import FAMILY, MAIN, read_kml
from app.formats._kml_writing import NEEDS, write_kml
from app.model.layers import Layers

_HEADS = (b"<kml", b":kml", b"opengis.net/kml", b"earth.google.com/kml")


def detect(name: str, data: bytes) -> bool:
    """A file called .kml, or one whose root says so."""
    if is_archive(data):
        return False
    head = data[:4096]
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        head = head.replace(b"\0", b"")
    return name.lower().endswith(".kml") or (b"<" in head[:16] and any(word in head for word in _HEADS))


def read(files: Files, context: ReadContext) -> Layers:
    """The objects of a drawing, or the layers that we once wrote into it."""
    layers, _ = read_kml(files[context.main], context, {})
    return layers


def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """The drawings as they were uploaded, with everything else beside them in our own words."""
    files = sum(len(p.files) for k, p in layers.of("resources", name="kmz").items() if hasattr(p, "files"))
    context.drop("resources", files, "images and further files of a drawing travel in KMZ only")
    return {MAIN: write_kml(layers, context, with_pictures=False, taken=frozenset()).kml}


register(
    Format(
        name="kml",
        title="KML",
        files=(MAIN,),
        media_types=("application/vnd.google-earth.kml+xml",),
        carries=frozenset({"location", "objects", "topology", "zones", "occupancy"}),
        detect=detect,
        read=read,
        check=_kml_rules.check,
        write=write,
        needs=NEEDS,
        family=FAMILY,
        marks_blocked=True,
        drawing=True,
        outlines=True,
        titled=True,
        rank=10,
        extensions=(".kml",),
    )
)
