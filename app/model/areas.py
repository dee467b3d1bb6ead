"""Zones that name places, as rooms and aisles, and their colours in pictures and files.

They limit nothing, so they are drawn quietly: a thin line in the colour of objects, and hardly a fill.
"""

from __future__ import annotations

AREA_KINDS = ("room", "corridor", "door", "aisle", "row")
"""Kinds of zones that name places."""

AREA_COLOUR, DARK_AREA_COLOUR = (107, 81, 55), (211, 179, 143)
"""Red, green and blue of these zones' outlines on light and on dark ground: ``--map-object`` of the web page."""

AREA_OPACITY = 0.08
"""Opacity of their fill."""
