"""FlatGeobuf 3: one table of features of any type with a spatial index, which web maps read in pieces.

**Our own data.** All features with a geometry, with the columns ``id``, ``layer``, ``level``, ``part``, then their
properties; ``more`` is JSON with those that no column can express. They are read back into their parts. The file has
one CRS: degrees (EPSG:4326, rounded to 1e-12), so that items in metres come back in degrees; without a datum an
engineering CRS in metres. Datum, levels and documents have no place in it.

**Reading other files.** Each feature is an object of the family ``flatgeobuf``, or what the upload's ``layer`` says.
Its columns are its properties; ``id`` or ``name`` is its id, else layer and number. A column called name in any case
is its ``name``; a ``kind`` that is no text becomes ``class``. Any CRS that PROJ knows is converted to degrees (WGS 84).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from app.formats import ANY_FEATURES, Files, Format, LayerRequirements, ReadContext, Traits, WriteContext, register
from app.formats.gis.layers import read_tables
from app.formats.gis.shapes import transformed
from app.formats.gis.tables import ReadOptions, columns, to_parts
from app.model.features import Features, Properties
from app.model.frame import Level
from app.model.geodesy import WGS84
from app.model.layers import VECTOR_LAYERS, Layer, Layers, PartKey
from app.syntax import ogr
from app.syntax.decimals import DEGREES
from app.syntax.geotiff import LOCAL_WKT

NAME = "flatgeobuf"
_TYPES = {"text": str, "integer": np.int64, "real": np.float64, "boolean": np.bool_}


def detect(name: str, data: bytes) -> bool:  # noqa: ARG001
    """Detect the magic bytes of version 3."""
    return data[:4] == b"fgb\x03" and data[4:7] == b"fgb"


def read(files: Files, context: ReadContext) -> Layers:
    """Read all features. Raises UnreadableFile for damaged files and without a CRS."""
    data = files[context.main]
    return Layers(to_parts(read_tables(data, "FlatGeobuf", context, VERIFY_BUFFERS="YES"), context, NAME))


def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """Write ``map.fgb`` with all vector layers. Raises MissingDatum for metres and degrees without a datum."""
    _report_losses(layers, context)
    keys: list[PartKey] = []
    ids: list[str] = []
    properties: list[Properties] = []
    shapes: list[NDArray[np.object_]] = []
    parts = [(key, part) for key, part in sorted(layers.parts.items()) if isinstance(part, Features)]
    in_metres = layers.datum is None and all(bool(part.local.all()) for _, part in parts)
    for key, part in parts:
        kept = np.flatnonzero(~shapely.is_empty(part.geometry))
        if not in_metres:
            context.drop(
                "anchors of items in metres", int(part.local[kept].sum()), "the file has one CRS: they are in degrees"
            )
        context.drop("items without a geometry", len(part) - len(kept), "a spatial index cannot contain them")
        shapes.append((part.geometry if in_metres else part.in_wgs84(layers.frame))[kept])
        keys += [key] * len(kept)
        ids += [part.ids[k] for k in kept]
        properties += [part.properties[k] for k in kept]
    geometry = np.concatenate(shapes) if shapes else np.empty(0, object)
    if not in_metres:
        geometry = transformed(geometry, _round)
    listed = {column.name: (_TYPES[column.type], column.values) for column in columns(keys, ids, properties)}
    codes = np.asarray(shapely.to_wkb(geometry, output_dimension=3, flavor="iso"), object)
    return {"map.fgb": ogr.write_layer("FlatGeobuf", "map", listed, codes, LOCAL_WKT if in_metres else WGS84)}


def _round(points: NDArray[np.float64]) -> NDArray[np.float64]:
    out: Any = points.copy()
    out[:, :2] = np.round(points[:, :2], DEGREES)
    return np.asarray(out)


def _report_losses(layers: Layers, context: WriteContext) -> None:
    cells: tuple[Layer, ...] = ("occupancy", "voxels", "imagery")
    for layer in cells:
        context.drop(layer, len(layers.parts_of(layer)), "the file contains features, not cells or pixels")
    context.drop("resources", len(layers.resources()), "the file has no further files")
    documents = sum(bool(part.document) for part in layers.parts.values() if isinstance(part, Features))
    context.drop("documents of parts", documents, "the file contains features only")
    context.drop("elevations of levels", int(layers.levels != (Level(),)), "the file contains features only")


register(
    Format(
        name=NAME,
        title="FlatGeobuf",
        files={"map.fgb": "application/flatgeobuf"},
        layers=frozenset(VECTOR_LAYERS),
        detect=detect,
        read=read,
        write=write,
        needs=LayerRequirements(ANY_FEATURES),
        read_options=ReadOptions,
        extensions=(".fgb",),
        traits=Traits(is_drawing=True, marks_blocked=True),
    )
)
