"""KMZ: a KML file with its images in a ZIP archive.

The main document is the first entry in the archive whose name ends in ``.kml``, as in the reference reader; every
other entry is stored byte for byte. Grids and images are written as overlays with their images and are read back as
grids and images.
"""

from __future__ import annotations

from dataclasses import replace

from app.errors import Problem, UnreadableFile
from app.formats import Claims, Files, Format, ReadContext, Traits, WriteContext, register
from app.formats.kml import rules
from app.formats.kml.reading import read_kml
from app.formats.kml.words import FAMILY
from app.formats.kml.writing import NEEDS, write_kml
from app.model.layers import Layers, Part, PartKey, Resources
from app.model.names import name_problem
from app.syntax import archives as archive

MAIN = "map.kmz"
DOCUMENT = "doc.kml"
RESOURCES = "kmz"


def detect(name: str, data: bytes) -> bool:
    """Detect a .kmz file, or an archive of another name that begins with a KML file (a .zip is a folder)."""
    lower = name.lower()
    if lower.endswith(".kmz"):
        return True
    return archive.is_archive(data) and not lower.endswith(".zip") and _first_entry_name(data).endswith(b".kml")


def _first_entry_name(data: bytes) -> bytes:
    return data[30 : 30 + int.from_bytes(data[26:28], "little")].lower()


def read(files: Files, context: ReadContext) -> Layers:
    """Read the layers of the main document, and all other entries as resources."""
    entries = archive.unpack(files[context.main], context.limits)
    main = main_document_name(entries)
    companions = {name: body for name, body in entries.items() if name != main}
    layers, used = read_kml(entries[main], context, companions, main)
    resources = {name: body for name, body in companions.items() if name not in used}
    parts: dict[PartKey, Part] = dict(layers.parts)
    if resources and context.wants("resources"):
        parts[PartKey("resources", context.level, RESOURCES)] = Resources(resources)
    return Layers(parts, layers.datum, layers.levels)


def main_document_name(entries: Files) -> str:
    """Return the name of the main document. Raises UnreadableFile if there is none."""
    main = next((name for name in entries if name.lower().endswith(".kml")), None)
    if main is None:
        names = ", ".join(sorted(entries)[:5]) or "nothing"
        reason = f"the archive has no .kml entry (it contains {names}): a KMZ needs one, usually doc.kml"
        raise UnreadableFile(reason, [Problem(reason)])
    return main


def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """Write one archive: the main document first, then images and uploaded entries, by name."""
    extra_files: dict[str, bytes] = {}
    for part in layers.parts_of("resources", name=RESOURCES).values():
        if isinstance(part, Resources):
            for name, body in part.files.items():
                if extra_files.setdefault(name, body) != body:
                    context.drop("resources", 1, f"two levels contain different files named {name}")
    written = write_kml(layers, context, with_pictures=True, taken=frozenset(extra_files))
    main = written.entry if written.entry and not name_problem(written.entry) else DOCUMENT
    stem, n = main.removesuffix(".kml"), 2
    while main in extra_files or main in written.pictures:
        main, n = f"{stem}-{n}.kml", n + 1
    return {MAIN: archive.pack({**extra_files, **written.pictures, main: written.kml}, main)}


register(
    Format(
        name="kmz",
        title="KMZ (KML with its images)",
        files={MAIN: "application/vnd.google-earth.kmz"},
        layers=frozenset({"location", "objects", "topology", "zones", "occupancy", "imagery", "resources"}),
        detect=detect,
        read=read,
        check=rules.check_archive,
        write=write,
        needs=replace(NEEDS, one_of=(*NEEDS.one_of, frozenset({"imagery"}))),
        version=3,
        extensions=(".kmz",),
        claims=Claims(priority=11),
        traits=Traits(family=FAMILY, is_drawing=True, marks_blocked=True, has_title=True),
    )
)
