"""Geometries are cut at the antimeridian and joined again: facts worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from app.model.antimeridian import cut_at_antimeridian, join_at_antimeridian

CROSSING = {
    "LINESTRING (179 0, -179 2)": "MULTILINESTRING ((179 0, 180 1), (-180 1, -179 2))",
    "LINESTRING (-179 0, 179 2, -179 4)": "MULTILINESTRING ((-179 0, -180 1), (180 1, 179 2, 180 3), (-180 3, -179 4))",
    "LINESTRING Z (179 0 1, 180 1 2, -179 2 3)": "MULTILINESTRING Z ((179 0 1, 180 1 2), (-180 1 2, -179 2 3))",
    "MULTILINESTRING ((170 0, 171 0), (178 0, -178 4))":
        "MULTILINESTRING ((170 0, 171 0), (178 0, 180 2), (-180 2, -178 4))",
    "POLYGON ((179 -17, -179 -17, -179 -16, 179 -16, 179 -17))":
        "MULTIPOLYGON (((179 -17, 180 -17, 180 -16, 179 -16, 179 -17)), "
        "((-180 -17, -179 -17, -179 -16, -180 -16, -180 -17)))",
    "POLYGON ((178 0, -178 0, -178 4, 178 4, 178 0), (179 1, -179 1, -179 3, 179 3, 179 1))":
        "MULTIPOLYGON (((178 0, 180 0, 180 1, 179 1, 179 3, 180 3, 180 4, 178 4, 178 0)), "
        "((-180 0, -178 0, -178 4, -180 4, -180 3, -179 3, -179 1, -180 1, -180 0)))",
}  # fmt: skip

TOUCHING = {
    "LINESTRING (180 0, -180 1)": "LINESTRING (180 0, 180 1)",
    "LINESTRING (180 0, -179 1)": "LINESTRING (-180 0, -179 1)",
    "LINESTRING (-179 0, 180 1)": "LINESTRING (-179 0, -180 1)",
    "LINESTRING Z (179 0 1, -180 1 2)": "LINESTRING Z (179 0 1, 180 1 2)",
    "MULTILINESTRING ((180 0, -179 1), (-178 0, -177 0))": "MULTILINESTRING ((-180 0, -179 1), (-178 0, -177 0))",
    "POLYGON ((180 0, -179 0, -179 1, 180 1, 180 0))": "POLYGON ((-180 0, -179 0, -179 1, -180 1, -180 0))",
    "POLYGON ((179 0, -180 0, -180 1, 179 1, 179 0))": "POLYGON ((179 0, 180 0, 180 1, 179 1, 179 0))",
}  # fmt: skip

STAYING = [
    "LINESTRING (179 0, 180 0, 180 5)",
    "LINESTRING (-0.5 53, 0.5 53)",
    "MULTIPOINT (179 1, -179 1)",
    "POLYGON ((-180 -90, 180 -90, 180 90, -180 90, -180 -90))",
    "POLYGON ((0 80, 120 80, -120 80, 0 80))",
    "MULTIPOLYGON (((179 0, 180 0, 180 1, 179 1, 179 0)), ((-180 0, -179 0, -179 1, -180 1, -180 0)))",
    "POINT EMPTY",
]


def cut(wkt: str) -> shapely.Geometry:
    (out,) = cut_at_antimeridian(np.array([shapely.from_wkt(wkt)], object))
    assert isinstance(out, shapely.Geometry)
    return out


@pytest.mark.parametrize("wkt", CROSSING)
def test_crossing_geometries_are_cut(wkt: str) -> None:
    out = cut(wkt)
    if "LINE" in wkt:
        assert shapely.equals_identical(out, shapely.from_wkt(CROSSING[wkt])), out.wkt  # in the line's direction
    else:
        assert shapely.equals_exact(out, shapely.from_wkt(CROSSING[wkt]), normalize=True), out.wkt
        assert all(part.exterior.is_ccw for part in shapely.get_parts(out))


@pytest.mark.parametrize("wkt", TOUCHING)
def test_what_touches_from_one_side_is_on_that_side(wkt: str) -> None:
    """It is in one piece, with the sign of 180 degrees that its other longitudes have."""
    out, expected = cut(wkt), shapely.from_wkt(TOUCHING[wkt])
    assert out.geom_type == expected.geom_type
    assert shapely.equals_exact(out, expected, normalize="POLYGON" in wkt), out.wkt
    assert out.has_z == expected.has_z


@pytest.mark.parametrize("wkt", STAYING)
def test_others_stay(wkt: str) -> None:
    assert shapely.equals_identical(cut(wkt), shapely.from_wkt(wkt))


@pytest.mark.parametrize("wkt", CROSSING)
def test_pieces_are_joined(wkt: str) -> None:
    """The result has the length or area of the original, beyond 180 degrees, and its direction."""
    joined = join_at_antimeridian(cut(wkt))
    sent = shapely.from_wkt(wkt)
    assert shapely.get_num_geometries(joined) == shapely.get_num_geometries(sent)
    west, _, east, _ = joined.bounds
    assert east - west < 20
    if joined.geom_type == "LineString":
        ends = shapely.get_coordinates(joined, include_z=joined.has_z)[[0, -1]]
        ends[:, 0] = (ends[:, 0] + 180.0) % 360.0 - 180.0
        assert ends.tolist() == shapely.get_coordinates(sent, include_z=sent.has_z)[[0, -1]].tolist()
