"""Local frame: equal to PROJ's own tmerc and to geodesics near the datum, and reversible everywhere on earth."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from pyproj import CRS, Geod, Transformer

from app.errors import Invalid, MissingDatum
from app.model.features import NO_GEOMETRY, concatenate, features
from app.model.frame import Datum
from app.model.geodesy import LocalFrame, crs_to_wgs84, distance, is_geographic, local_frame, surface

WGS84 = Geod(ellps="WGS84")
PLACES = [
    *((latitude, 12.3456789) for latitude in (-85.0, -60.0, -33.9, -0.001, 0.0, 0.001, 45.0, 53.268, 70.1, 85.0)),
    (51.5, 0.0),
    (64.2, -180.0),
    (64.2, 180.0),
    (-16.8, 179.9999),
    (-16.8, -179.9999),
    (37.5, -122.3),
]
DATUMS = st.builds(
    Datum,
    st.floats(-85, 85),
    st.one_of(st.floats(-180, 180), st.sampled_from([-180.0, 180.0, 179.99999, -179.99999, 0.0])),
    st.just(0.0),
    st.floats(-360, 360),
)


def test_distance_and_surface_are_geodesic() -> None:
    assert distance((0.0, 0.0), (0.0, 1.0)) == pytest.approx(110574.4, abs=0.1)
    assert distance((179.999, -17.0), (-179.999, -17.0)) == pytest.approx(212.9, abs=0.1)
    # A square degree at the equator, known from the authalic latitude of its parallel.
    assert surface(shapely.box(0, 0, 1, 1)) == pytest.approx(12_308_778_361, rel=1e-6)
    assert surface(shapely.box(179.5, 0, 180.5, 1)) == pytest.approx(surface(shapely.box(0, 0, 1, 1)), rel=1e-9)
    ring = shapely.box(0, 0, 2, 2)
    hole = shapely.box(0.5, 0.5, 1, 1)
    several = shapely.MultiPolygon([shapely.Polygon(ring.exterior, [hole.exterior]), shapely.box(5, 5, 6, 6)])
    expected = surface(ring) - surface(hole) + surface(shapely.box(5, 5, 6, 6))
    assert surface(several) == pytest.approx(expected, rel=1e-12)


def around(latitude: float, longitude: float, metres: list[float]) -> np.ndarray:
    """Return points in 24 directions at these distances, by geodesics: (longitude, latitude) float64 [n, 2]."""
    azimuth, distance = (a.ravel() for a in np.meshgrid(np.arange(0.0, 360.0, 15.0), metres))
    lon, lat, _ = WGS84.fwd(np.full(azimuth.shape, longitude), np.full(azimuth.shape, latitude), azimuth, distance)
    return np.stack([lon, lat], 1)


def turned(xy: np.ndarray, heading: float) -> np.ndarray:
    """Rotate east and north to axes whose y points ``heading`` degrees clockwise from north."""
    h = math.radians(heading)
    ahead, right = np.array([math.sin(h), math.cos(h)]), np.array([math.cos(h), -math.sin(h)])
    return np.stack([xy @ right, xy @ ahead], 1)


@pytest.mark.parametrize(("latitude", "longitude"), PLACES)
@pytest.mark.parametrize("heading", [0.0, 30.0, -30.0, 90.0, 180.0, -277.7, 360.0])
def test_local_frame_equals_proj_and_round_trips_within_ten_kilometres(
    latitude: float, longitude: float, heading: float
) -> None:
    places = around(latitude, longitude, [0.0, 0.01, 1.0, 100.0, 1000.0, 10_000.0])
    frame = LocalFrame(Datum(latitude, longitude, 0.0, heading))
    crs = CRS.from_proj4(f"+proj=tmerc +lat_0={latitude!r} +lon_0={longitude!r} +k=1 +x_0=0 +y_0=0 +datum=WGS84")
    other = Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    expected = turned(np.stack(other.transform(places[:, 0], places[:, 1]), 1), heading)
    local = frame.to_local(places)
    assert np.abs(local - expected).max() < 1e-6
    back = frame.to_wgs84(local)
    assert (np.abs(back[:, 0]) <= 180).all()
    _, _, off = WGS84.inv(places[:, 0], places[:, 1], back[:, 0], back[:, 1])
    assert np.max(off) < 1e-6
    assert np.abs(frame.to_local(back) - local).max() < 1e-6


@pytest.mark.parametrize(("latitude", "longitude"), PLACES)
def test_local_metres_equal_geodesic_metres(latitude: float, longitude: float) -> None:
    """Distance and direction from the datum equal those of geodesics, independent of any projection."""
    frame = LocalFrame(Datum(latitude, longitude))
    for metres, tolerance in ((1.0, 1e-8), (100.0, 1e-6), (1000.0, 1e-4), (10_000.0, 0.05)):
        azimuth = np.radians(np.arange(0.0, 360.0, 15.0))
        expected = metres * np.stack([np.sin(azimuth), np.cos(azimuth)], 1)
        local = frame.to_local(around(latitude, longitude, [metres]))
        assert np.abs(np.hypot(*local.T) - metres).max() < tolerance
        assert np.abs(local - expected).max() < tolerance


def test_local_axes_follow_heading() -> None:
    north, east = np.array([[0.1, 53.001]]), np.array([[0.1015, 53.0]])
    plain = LocalFrame(Datum(53.0, 0.1))
    assert plain.to_local(north)[0, 1] > 100
    assert plain.to_local(east)[0, 0] > 100
    right = LocalFrame(Datum(53.0, 0.1, 0.0, 90.0))  # +y points east, so north is to the left
    assert right.to_local(east)[0, 1] > 100
    assert right.to_local(north)[0, 0] < -100


def test_points_across_antimeridian_stay_neighbours() -> None:
    for longitude, other in ((179.9999, -179.9999), (-179.9999, 179.9999), (180.0, -179.9998), (-180.0, 179.9998)):
        frame = LocalFrame(Datum(-16.8, longitude))
        x, y = frame.to_local(np.array([[other, -16.8]]))[0]
        assert 20 < abs(x) < 22
        assert abs(y) < 0.01
        assert (x > 0) == (other < 0)
        lon, lat = frame.to_wgs84(np.array([[x, y]]))[0]
        assert (lon, lat) == (pytest.approx(other, abs=1e-11), pytest.approx(-16.8, abs=1e-11))


@given(DATUMS, st.floats(-10_000, 10_000), st.floats(-10_000, 10_000))
def test_any_local_point_round_trips(datum: Datum, x: float, y: float) -> None:
    frame = local_frame(datum)
    lonlat = frame.to_wgs84(np.array([[x, y]]))
    assert np.abs(frame.to_local(lonlat) - [x, y]).max() < 1e-6


def test_heights_pass_through_and_inputs_stay_unchanged() -> None:
    frame = LocalFrame(Datum(53.0, 0.1, 40.0, 10.0))
    given_places = np.array([[0.1, 53.0, 7.5], [0.2, 53.1, -3.0]])
    original = given_places.copy()
    local = frame.to_local(given_places)
    assert local[:, 2].tolist() == [7.5, -3.0]
    assert frame.to_wgs84(local)[:, 2].tolist() == [7.5, -3.0]
    assert (given_places == original).all()
    assert frame.to_local(np.empty((0, 2))).shape == (0, 2)


@pytest.mark.parametrize("far", [(100.0, 10.0), (90.0, 0.0), (-179.9, -53.0), (0.0, -90.0)])
def test_geometry_too_far_from_datum_is_rejected_by_name(far: tuple[float, float]) -> None:
    frame = LocalFrame(Datum(53.0, 0.0))
    near = shapely.Point(0.0, 53.0)
    with pytest.raises(Invalid, match=f"{far[1]:g}, {far[0]:g}"):
        features([("a", near, {}), ("b", shapely.LineString([near, far]), {})], "wgs84").in_local(frame)


def test_to_local_returns_infinite_points_without_error() -> None:
    assert np.isinf(LocalFrame(Datum(53.0, 0.0)).to_local(np.array([[90.0, 0.0]]))).all()


def test_local_frames_are_cached() -> None:
    assert local_frame(Datum(1.0, 2.0)) is local_frame(Datum(1.0, 2.0))
    assert local_frame(Datum(1.0, 2.0)) is not local_frame(Datum(1.0, 2.0, 0.0, 1.0))


def test_a_known_crs_is_not_parsed_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Parsing takes as long as converting thousands of points."""
    points = np.array([[12.0, 53.0, 100.0]])
    first = crs_to_wgs84("EPSG:4326+6360", points)
    assert is_geographic("EPSG:4326")
    monkeypatch.setattr("app.model.geodesy.CRS", None)
    assert np.array_equal(crs_to_wgs84("EPSG:4326+6360", points), first)
    assert is_geographic("EPSG:4326")


def mixed() -> list[shapely.Geometry]:
    return [
        shapely.Point(0.1, 53.0),
        shapely.Point(0.1, 53.0, 12.0),
        shapely.LineString([(0.1, 53.0), (0.11, 53.01)]),
        shapely.LineString([(0.1, 53.0, 1.0), (0.11, 53.01, 2.0)]),
        shapely.Polygon(
            [(0.1, 53.0), (0.11, 53.0), (0.11, 53.01)], [[(0.105, 53.001), (0.106, 53.001), (0.106, 53.002)]]
        ),
        shapely.MultiPoint([(0.1, 53.0), (0.12, 53.02)]),
        shapely.GeometryCollection(
            [shapely.Point(0.1, 53.0, 5.0), shapely.LineString([(0.1, 53.0, 0.0), (0.2, 53.1, 1.0)])]
        ),
        NO_GEOMETRY,
        shapely.LineString(),
    ]


def test_geometries_of_all_types_are_converted_together() -> None:
    frame = LocalFrame(Datum(53.0, 0.1, 0.0, 25.0))
    drawn = mixed()
    earth = features([(str(k), g, {}) for k, g in enumerate(drawn)], "wgs84")
    local = earth.in_local(frame)
    assert [g.geom_type for g in local] == [g.geom_type for g in drawn]
    assert [g.has_z for g in local] == [g.has_z for g in drawn]
    for before, after in zip(drawn, local, strict=True):
        flat = shapely.get_coordinates(before)
        assert (
            np.abs(shapely.get_coordinates(after) - (frame.to_local(flat) if len(flat) else flat)).max(initial=0) == 0
        )
        heights = shapely.get_coordinates(before, include_z=True)[:, 2]
        assert np.array_equal(shapely.get_coordinates(after, include_z=True)[:, 2], heights, equal_nan=True)
    again = features([(str(k), g, {}) for k, g in enumerate(local)], "local").in_wgs84(frame)
    for before, after in zip(drawn, again, strict=True):
        assert np.abs(shapely.get_coordinates(after) - shapely.get_coordinates(before)).max(initial=0) < 1e-11
    assert [g.wkb for g in earth.geometry] == [g.wkb for g in drawn]


def test_only_items_with_other_anchor_are_converted() -> None:
    frame = LocalFrame(Datum(53.0, 0.1))
    local_items = features([("a", shapely.Point(3.0, 4.0), {})], "local")
    earth = features([("b", shapely.Point(0.1, 53.0), {}), ("c", shapely.Point(0.1, 53.001, 9.0), {})], "wgs84")
    both = concatenate([local_items, earth])
    local = both.in_local(frame)
    assert local[0] is both.geometry[0]
    assert (local[1].x, local[1].y) == (0.0, 0.0)
    _, _, metres = WGS84.inv(0.1, 53.0, 0.1, 53.001)
    assert local[2].y == pytest.approx(metres, abs=1e-6)
    assert local[2].z == 9.0
    degrees = both.in_wgs84(frame)
    assert degrees[1] is both.geometry[1]
    assert degrees[0].y == pytest.approx(53.0 + 0.001 * 4 / metres, abs=1e-9)
    assert both.needs_datum
    assert not local_items.needs_datum
    assert local_items.in_local(None)[0] is local_items.geometry[0]
    for convert in (both.in_local, both.in_wgs84, local_items.in_wgs84, earth.in_local):
        with pytest.raises(MissingDatum, match="datum"):
            convert(None)
