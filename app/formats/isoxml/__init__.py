"""ISOXML (ISO 11783-10): ``TASKDATA.XML`` of farm software and terminals, with its fields.

**Reading.** Polygons, lines and points of fields (``PFD`` with ``PLN``, ``LSG``, ``PNT``) and guidance lines (``GGP``
with ``GPN``) are objects of the family ``isoxml``, or what the upload's ``layer`` says. A boundary without a name is
called after its field, ``Oats boundary``, so ``layer=location`` finds the fence also beside obstacles.
``properties.isoxml`` contains ``field``, ``type`` (``boundary``, ``obstacle``, ``headland`` …) and ``group`` of
guidance lines, and ``pattern`` of those that are more than their line: the attributes of ``GPN`` and the types of its
points. So A+ lines, pivots and spirals have the shape of the points that define them. ``width`` is that of a line, in
metres. Coordinates are degrees WGS 84 and, if given, heights in millimetres, which become metres. Fields in
files of their own (``XFR``, such as ``PFD00001.XML``) are read from the upload. Tasks, products, machines and points in
binary files are not read; the elements are counted in a warning.

**Writing.** Each level is a field that is called after the environment; objects of the family ``isoxml`` are in the
field that they name. The fence is its boundary (``PLN`` of type 1), keepout zones are obstacles (6), other zones are
treatment zones (2). Objects have the type that they were read with; others that of their kind (``building``, ``road``,
``water``, ``wall`` …), else polygons and points are ``other`` and lines are left out, since lines have no such type.
Guidance patterns are those that were read; a heading or radius is left out once its points have been moved. Edges are
guidance lines, two-way ones once: ``AB`` (``GPN`` of type 1) if straight, else curves (3); nodes are left out, since
guidance has no network. Parts of one multipolygon are polygons of their own, as version 4 of the standard
demands. Coordinates have 9 decimals (0.1 mm), names at most 32 characters.
"""

from __future__ import annotations

from app.formats import ANY_FEATURES, Claims, Format, LayerRequirements, Traits, register
from app.formats.isoxml.reading import companions, detect, read
from app.formats.isoxml.words import NAME
from app.formats.isoxml.writing import write
from app.model.layers import VECTOR_LAYERS

register(
    Format(
        name=NAME,
        title="ISOXML task data",
        files={"TASKDATA.XML": "application/xml"},
        layers=frozenset(VECTOR_LAYERS),
        detect=detect,
        read=read,
        write=write,
        version=2,
        needs=LayerRequirements(ANY_FEATURES, anchor="wgs84"),
        extensions=(".xml",),
        claims=Claims(companions=companions),
        traits=Traits(is_drawing=True, has_title=True),
    )
)
