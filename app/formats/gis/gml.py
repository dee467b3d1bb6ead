"""GML 2 and 3 (OGC 07-036), also as answers of a WFS. Read only.

Each feature is an object of the family ``gml``, or what the upload's ``layer`` says. Its plain elements are its
properties; ``gml_id`` is its id. An element called name in any case is its ``name``; a ``kind`` that is no text becomes
``class``. Arcs and curves become lines. ``srsName`` names the CRS: any that PROJ knows is converted to degrees
(WGS 84).

Nothing outside of the file is read: schemas (``schemaLocation``) are not fetched, so types are inferred from the
values, and references (``xlink:href``) are not followed.
"""

from __future__ import annotations

import re

from app.errors import TooLarge
from app.formats import Files, Format, ReadContext, Traits, register
from app.formats.gis.layers import read_tables
from app.formats.gis.tables import ReadOptions, Table, to_parts
from app.model.layers import VECTOR_LAYERS, Layers
from app.syntax import xml

NAME = "gml"
_NAMESPACE = re.compile(rb"""=\s*["']http://www\.opengis\.net/gml(?:/3\.2)?["']""")
_SCHEMAS = re.compile(rb"""(?:\b[\w.-]+:)?(?:noNamespaceS|s)chemaLocation\s*=\s*(?:"[^"]*"|'[^']*')""")


def detect(name: str, data: bytes) -> bool:  # noqa: ARG001
    """Detect XML that declares GML's namespace near its beginning."""
    head = data[:65536].lstrip(b"\xef\xbb\xbf \t\r\n")
    return head[:1] == b"<" and _NAMESPACE.search(head) is not None


def read(files: Files, context: ReadContext) -> Layers:
    """Read all features. Raises UnreadableFile for damaged files, a DOCTYPE, and features without a CRS."""
    data = files[context.main]
    if len(data) > context.limits.text_bytes:
        raise TooLarge(f"{context.main} has {len(data)} bytes; the limit for a text is {context.limits.text_bytes}")
    xml.check_prolog(data)
    schemas = len(_SCHEMAS.findall(data))
    if schemas:
        context.warn(f"{schemas} references to schemas are not followed; types are inferred from the values")
        data = _SCHEMAS.sub(b"", data)
    tables = read_tables(data, "GML", context, WRITE_GFS="NO", EXPOSE_GML_ID="YES", DOWNLOAD_SCHEMA="NO")
    return Layers(to_parts([_with_id(table) for table in tables], context, NAME))


def _with_id(table: Table) -> Table:
    """Use ``gml_id`` as the id of features that have no other."""
    columns = dict(table.columns)
    if "id" not in columns and "gml_id" in columns:
        columns = {"id": columns.pop("gml_id"), **columns}
    return Table(table.name, columns, table.geometry, table.crs)


register(
    Format(
        name=NAME,
        title="GML",
        files={"map.gml": "application/gml+xml"},
        layers=frozenset(VECTOR_LAYERS),
        detect=detect,
        read=read,
        read_options=ReadOptions,
        extensions=(".gml",),
        traits=Traits(is_drawing=True),
    )
)
