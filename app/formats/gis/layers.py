"""Files that GDAL reads, as tables."""

from __future__ import annotations

from app.formats import ReadContext
from app.formats.gis.shapes import parse_shapes
from app.formats.gis.tables import Table
from app.syntax import ogr


def read_tables(
    data: bytes, driver: ogr.Driver, context: ReadContext, *, encoding: str | None = None, **options: str
) -> list[Table]:
    """Read the layers of a file as tables. Parameters and errors: see ``ogr.read_layers``."""
    layers, warnings = ogr.read_layers(data, driver, context.limits, encoding=encoding, **options)
    for text in warnings:
        context.warn(f"GDAL: {text}")
    return [Table(layer.name, layer.columns, parse_shapes(layer.geometry, layer.name), layer.crs) for layer in layers]
