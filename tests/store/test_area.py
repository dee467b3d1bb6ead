"""Areas without a database: for any drawing they are valid, cut at the antimeridian, and cover the drawing."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from app.model.features import features
from app.model.frame import Datum
from app.model.geodesy import local_frame, surface
from app.store.area import area_in_degrees, fence_polygon
from app.store.encode import from_wkb
from app.store.values import NO_AREA, Area

METRES = st.floats(-1e7, 1e7)
DATUMS = st.builds(Datum, st.floats(-85, 85), st.floats(-180, 180), st.just(0.0), st.floats(-360, 360))


def area_of(shape: Any, anchor: Any, datum: Datum | None = None) -> Area:
    frame = None if datum is None else local_frame(datum)
    fence = fence_polygon([features([("f", shape, {"kind": "fence"})], anchor)], frame)
    return NO_AREA if fence is None else area_in_degrees("fence", fence)


def check(area: Area) -> None:
    shapes = from_wkb([wkb for _, wkb in area.pieces])
    assert shapely.is_valid(shapes).all()
    for shape, (box, _) in zip(shapes, area.pieces, strict=True):
        assert shape.geom_type in ("Polygon", "MultiPolygon")
        assert shape.bounds == box
        west, south, east, north = box
        assert -180 <= west < east <= 180
        assert -90 <= south < north <= 90
        assert east - west <= 180
    assert len(area.pieces) <= 2
    assert area.size == pytest.approx(sum(surface(shape) for shape in shapes), rel=1e-9, abs=0.06)


@given(st.lists(st.tuples(st.floats(-180, 180), st.floats(-90, 90)), min_size=3, max_size=9))
def test_area_of_any_polygon_in_degrees_is_valid(points: list[tuple[float, float]]) -> None:
    check(area_of(shapely.Polygon(points), "wgs84"))


@given(st.lists(st.tuples(METRES, METRES), min_size=3, max_size=7), DATUMS)
def test_area_of_any_polygon_in_metres_is_valid(points: list[tuple[float, float]], datum: Datum) -> None:
    check(area_of(shapely.Polygon(points), "local", datum))


@given(st.floats(-180, 180), st.floats(-80, 80), st.floats(1e-5, 5), st.floats(1e-5, 5))
def test_box_area_covers_its_middle_and_no_point_outside(x: float, y: float, width: float, height: float) -> None:
    corners = np.array(shapely.box(x - width, y - height, x + width, y + height).exterior.coords)
    corners[:, 0] = (corners[:, 0] + 180.0) % 360.0 - 180.0
    area = area_of(shapely.Polygon(corners), "wgs84")
    check(area)
    shapes = from_wkb([wkb for _, wkb in area.pieces])

    def covered(longitude: float, latitude: float) -> bool:
        point = shapely.Point((longitude + 180.0) % 360.0 - 180.0, latitude)
        return bool(shapely.covers(shapes, point).any())

    assert covered(x + width * 0.01, y)
    assert covered(x - width * 0.9, y + height * 0.9)
    for outside in ((x - width * 1.1, y), (x + width * 1.1, y), (x, y + height * 1.1), (x + 180.0, y)):
        assert not covered(*outside)
