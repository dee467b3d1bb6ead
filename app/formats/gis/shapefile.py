"""Shapefile (ESRI, 1998): ``.shp`` with its ``.shx``, ``.dbf``, ``.prj`` and ``.cpg``, also in a ``.zip``. Read only.

Each record is an object of the family ``shapefile``, or what the upload's ``layer`` says. Its fields are its
properties; ``id`` or ``name`` is its id, else layer and number. A field called name in any case is its ``name``; a
``kind`` that is no text becomes ``class``. Measures (M) are not read.

The ``.prj`` names the CRS: any that PROJ knows is converted to degrees (WGS 84), and a local one to metres. Without a
``.prj`` the option ``crs`` is needed: coordinates are never guessed. ``.cpg`` names the encoding of texts; without it,
the ``.dbf`` does, else they are ISO 8859-1.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterable, Sequence

from app.errors import Problem, UnreadableFile
from app.formats import Claims, Files, Format, ReadContext, Traits, register
from app.formats.gis.layers import read_tables
from app.formats.gis.tables import ReadOptions, to_parts
from app.model.layers import VECTOR_LAYERS, Layers

NAME = "shapefile"
_READ = (".shp", ".shx", ".dbf", ".prj", ".cpg")
_COMPANIONS = (*_READ, ".qix", ".sbn", ".sbx", ".qpj", ".qmd", ".shp.xml")
"""Files beside the main one; spatial indexes and metadata are not read."""


def detect(name: str, data: bytes) -> bool:
    """Detect the header of a .shp; a .shx has the same one."""
    return data[:4] == b"\x00\x00\x27\x0a" and data[28:32] == b"\xe8\x03\x00\x00" and not _end(name, ".shx")


def _end(name: str, end: str) -> bool:
    return name.lower().endswith(end)


def companions(main: str, data: bytes, names: Sequence[str]) -> Iterable[str]:
    """Return the files of the same name with another extension."""
    del data
    stem = main[: -len(".shp")] if _end(main, ".shp") else main
    return [name for name in names if name != main and name.lower() in {f"{stem}{end}".lower() for end in _COMPANIONS}]


def read(files: Files, context: ReadContext) -> Layers:
    """Read all records. Raises UnreadableFile for damaged files, and without a CRS or the index (.shx)."""
    members = {end: next((files[n] for n in sorted(files) if _end(n, end)), None) for end in _READ}
    members[".shp"] = files[context.main]
    if members[".shx"] is None:
        reason = "the .shx file is missing: upload all files of the shapefile together, or in one .zip"
        raise UnreadableFile(reason, [Problem(reason)])
    if members[".prj"] is not None:  # pyogrio cannot pass on a CRS with other characters
        members[".prj"] = members[".prj"].decode("utf-8-sig", "replace").encode("ascii", "replace")
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for end, data in members.items():
            if data is not None:
                archive.writestr(f"{NAME}{end}", data)
    return Layers(to_parts(read_tables(packed.getvalue(), "ESRI Shapefile", context), context, NAME))


register(
    Format(
        name=NAME,
        title="Shapefile",
        files={"map.shp": "application/vnd.shp"},
        layers=frozenset(VECTOR_LAYERS),
        detect=detect,
        read=read,
        read_options=ReadOptions,
        extensions=(".shp",),
        claims=Claims(companions=companions),
        traits=Traits(is_drawing=True),
    )
)
