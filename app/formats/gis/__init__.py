"""Files of GIS and CAD programs: DXF, FlatGeobuf, GeoPackage, GML, shapefile."""

from app.formats.gis import dxf, flatgeobuf, gml, gpkg, shapefile

__all__ = ["dxf", "flatgeobuf", "gml", "gpkg", "shapefile"]
