"""Files of GIS programs."""

from app.formats.gis import gpkg

__all__ = ["gpkg"]
