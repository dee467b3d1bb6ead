"""Open-RMF formats: traffic editor buildings, site editor sites and navigation graphs."""

from app.formats.rmf import building, nav_graph, site

__all__ = ["building", "nav_graph", "site"]
