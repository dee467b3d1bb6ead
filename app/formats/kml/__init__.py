"""KML and KMZ: one reader and one writer, with the images beside the drawing or in one archive with it."""

from app.formats.kml import kml, kmz

__all__ = ["kml", "kmz"]
