"""Networks of topological_navigation: ``tmap2``, and the older list, ``tmap``."""

from app.formats.tmap import tmap, tmap2

__all__ = ["tmap", "tmap2"]
