"""The formats of Open-RMF: buildings of its traffic editor, sites of its site editor, and navigation graphs."""

from app.formats.rmf import building, nav_graph, site

__all__ = ["building", "nav_graph", "site"]
