"""Images: display, and resampling to another grid, compared with PROJ pixel by pixel."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from pyproj import Transformer

from app.errors import Invalid, MissingDatum
from app.model.frame import Datum
from app.model.geodesy import local_frame
from app.model.imagery import GeoImage, display_pixels, pixel_positions
from app.model.resampling import resample, to_wgs84

UTM = "EPSG:32630"
DATUM = Datum(53.2686, -0.5245)
EAST, NORTH = 665050.0, 5904950.0
"""A point near the datum in UTM zone 30."""


def numbered(shape: tuple[int, int] = (60, 80), crs: str = UTM, transform: Any = None, **properties: Any) -> GeoImage:
    """Return an image in which every pixel has another number."""
    values = np.arange(shape[0] * shape[1], dtype=np.int32).reshape(*shape, 1) + 1
    return GeoImage(values, transform or (0.5, 0.0, EAST, 0.0, -0.5, NORTH), crs, properties)


def truth(image: GeoImage, source: GeoImage, to_source: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return each result pixel's value at its position by PROJ alone, and its distance to a pixel's edge."""
    height, width = image.pixels.shape[:2]
    rows, columns = (v.ravel() + 0.5 for v in np.mgrid[0:height, 0:width])
    places = to_source(pixel_positions(image.transform, columns, rows))
    a, b, c, d, e, f = source.transform
    back = np.linalg.inv(np.array([[a, b], [d, e]]))
    u, v = back @ (places - [c, f]).T
    h, w = source.pixels.shape[:2]
    inside = (u > 0) & (v > 0) & (u < w) & (v < h)
    value = np.zeros(len(u), source.pixels.dtype)
    value[inside] = source.pixels[v[inside].astype(int), u[inside].astype(int), 0]
    edge = np.minimum(np.abs(u - np.round(u)), np.abs(v - np.round(v)))
    return value.reshape(height, width), edge.reshape(height, width)


@pytest.mark.parametrize("heading", [0.0, 33.0, -120.0])
@pytest.mark.parametrize("transform", [None, (0.4, 0.3, EAST, 0.3, -0.4, NORTH)], ids=["upright", "turned"])
def test_resampled_pixels_are_where_proj_puts_them(heading: float, transform: Any) -> None:
    source = numbered(transform=transform, nodata=0)
    frame = local_frame(Datum(DATUM.latitude, DATUM.longitude, heading=heading))
    image = resample(source, frame, method="nearest")
    earth = Transformer.from_crs("EPSG:4326", UTM, always_xy=True)
    tmerc = Transformer.from_crs(
        f"+proj=tmerc +lat_0={DATUM.latitude} +lon_0={DATUM.longitude} +k=1 +ellps=WGS84", "EPSG:4326", always_xy=True
    )
    turn = math.radians(heading)

    def to_source(xy: np.ndarray) -> np.ndarray:
        # computed independently: local y points to the heading, clockwise from north
        east = xy[:, 0] * math.cos(turn) + xy[:, 1] * math.sin(turn)
        north = xy[:, 1] * math.cos(turn) - xy[:, 0] * math.sin(turn)
        return np.column_stack(earth.transform(*tmerc.transform(east, north)))

    expected, edge = truth(image, source, to_source)
    sure = edge > 1e-3
    assert sure.mean() > 0.9
    assert np.array_equal(image.pixels[..., 0][sure], expected[sure])
    assert image.crs == "local"
    # corners to the millimetre: the outline contains the source's corners, and no more than a pixel beyond
    corners = local_frame(frame.datum).to_local(
        np.column_stack(earth.transform(*source.outline().T, direction="INVERSE"))
    )
    a, _, c, _, e, f = image.transform
    height, width = image.pixels.shape[:2]
    low, high = np.array([c, f + e * height]), np.array([c + a * width, f])
    assert (corners.min(axis=0) - low > -1e-3).all()
    assert (corners.min(axis=0) - low < a + 1e-3).all()
    assert (high - corners.max(axis=0) > -1e-3).all()
    assert (high - corners.max(axis=0) < a + 1e-3).all()
    assert abs(c / a - round(c / a)) < 1e-6
    assert abs(f / a - round(f / a)) < 1e-6


def test_resample_to_degrees_round_trips() -> None:
    source = numbered(nodata=0)
    image = to_wgs84(source, method="nearest", resolution=2e-6)
    forth = Transformer.from_crs("EPSG:4326", UTM, always_xy=True)
    expected, edge = truth(image, source, lambda p: np.column_stack(forth.transform(p[:, 0], p[:, 1])))
    sure = edge > 1e-3
    assert np.array_equal(image.pixels[..., 0][sure], expected[sure])
    assert set(np.unique(image.pixels)) >= set(range(1, 4801)), "at this resolution no pixel is missed"


@pytest.mark.parametrize("longitude", [179.99995, 180.0, -179.9999])
def test_image_on_the_antimeridian_is_resampled_to_degrees_beyond_it(longitude: float) -> None:
    """The image is 40 × 30 m; before, it would have been as wide as the globe."""
    forth = Transformer.from_crs("EPSG:4326", "EPSG:32760", always_xy=True)
    east, north = forth.transform(longitude, -16.8)
    source = numbered(crs="EPSG:32760", transform=(0.5, 0.0, east - 20.0, 0.0, -0.5, north + 15.0), nodata=0)
    image = to_wgs84(source, method="nearest", resolution=2e-6)
    west = image.transform[2]
    assert abs(west - longitude) < 0.001 or abs(west - longitude - 360.0) < 0.001
    expected, edge = truth(image, source, lambda p: np.column_stack(forth.transform(p[:, 0], p[:, 1])))
    sure = edge > 1e-3
    assert np.array_equal(image.pixels[..., 0][sure], expected[sure])
    assert set(np.unique(image.pixels)) >= set(range(1, 4801)), "at this resolution no pixel is missed"
    default = to_wgs84(source)
    assert default.pixels.shape[0] * default.pixels.shape[1] < 10_000, "about as many pixels as the image has"


@pytest.mark.parametrize("crs", ["EPSG:3413", "EPSG:3031"])
def test_image_around_a_pole_has_longitudes_of_the_globe(crs: str) -> None:
    """The image is 160 × 120 km with the pole in its middle; before, its longitudes began at -540 degrees."""
    forth = Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    source = numbered(crs=crs, transform=(2000.0, 0.0, -80_000.0, 0.0, -2000.0, 60_000.0), nodata=0)
    image = to_wgs84(source, method="nearest", resolution=0.05)
    west, east = image.transform[2], image.transform[2] + 0.05 * image.pixels.shape[1]
    assert -180.051 < west < -175.0
    assert 175.0 < east < 180.051
    expected, edge = truth(image, source, lambda p: np.column_stack(forth.transform(p[:, 0], p[:, 1])))
    sure = edge > 1e-3
    assert np.array_equal(image.pixels[..., 0][sure], expected[sure])
    assert image.pixels.any()


def test_resampled_plane_stays_plane() -> None:
    """On a plane of heights, values between pixels equal the plane to a millimetre."""
    rows, columns = np.mgrid[0:60, 0:80] + 0.5
    heights = (0.25 * columns - 0.125 * rows)[..., None]
    source = GeoImage(heights, (0.5, 0.0, EAST, 0.0, -0.5, NORTH), UTM)
    frame = local_frame(DATUM)
    image = resample(source, frame)
    assert image.properties["nodata"] == "nan"
    v, u = np.nonzero(np.isfinite(image.pixels[..., 0]))
    earth = frame.to_wgs84(pixel_positions(image.transform, u + 0.5, v + 0.5))
    xy = np.column_stack(Transformer.from_crs("EPSG:4326", UTM, always_xy=True).transform(earth[:, 0], earth[:, 1]))
    column, row = (xy[:, 0] - EAST) / 0.5, (NORTH - xy[:, 1]) / 0.5
    within = (column > 1) & (row > 1) & (column < 79) & (row < 59)
    expected = 0.25 * column - 0.125 * row
    assert within.sum() > 4000
    assert np.abs(image.pixels[v, u, 0] - expected)[within].max() < 1e-3


@pytest.mark.parametrize(("kind", "band"), [(np.uint8, "alpha"), (np.uint16, "mask"), (np.int8, "mask")])
def test_resampled_image_marks_outside_by_extra_band(kind: Any, band: str) -> None:
    source = GeoImage(np.full((40, 40, 3), 100, kind), (0.4, 0.3, EAST, 0.3, -0.4, NORTH), UTM)
    image = resample(source, local_frame(DATUM))
    assert image.colours == ("red", "green", "blue", band)
    opaque = image.pixels[..., 3] != 0
    assert 0.4 < opaque.mean() < 0.6, "half of the box around a turned square"
    assert (image.pixels[opaque][:, :3] == 100).all(), "transparency does not darken the edge"
    assert display_pixels(image)[..., 3].tolist() == np.where(opaque, 255, 0).tolist() or band == "alpha"


def test_resample_returns_image_on_target_grid_unchanged() -> None:
    plan = numbered(crs="local")
    assert resample(plan) is plan
    assert resample(numbered(), crs=UTM).crs == UTM


def test_rotated_plan_is_resampled_without_datum() -> None:
    plan = numbered((40, 40), "local", (0.0, 0.5, 0.0, 0.5, 0.0, 0.0), nodata=0)
    image = resample(plan, method="nearest")
    # x runs along the rows, y along the columns: transposed, and upside down since rows run down.
    assert image.transform == (0.5, 0.0, 0.0, 0.0, -0.5, 20.0)
    assert np.array_equal(image.pixels[..., 0], plan.pixels[..., 0].T[::-1])


def test_resample_never_mixes_palette_values() -> None:
    values = (np.arange(1600).reshape(40, 40, 1) % 2 * 200).astype(np.uint8)
    properties = {"bands": [{"colour": "palette"}], "palette": [[k, 0, 0, 255] for k in range(256)], "nodata": 7}
    image = resample(GeoImage(values, (0.4, 0.3, EAST, 0.3, -0.4, NORTH), UTM, properties), local_frame(DATUM))
    assert set(np.unique(image.pixels)) == {0, 7, 200}


def test_resample_rejects_impossible_targets() -> None:
    with pytest.raises(MissingDatum, match="datum"):
        resample(numbered())
    with pytest.raises(MissingDatum, match="datum"):
        to_wgs84(numbered(crs="local"))
    with pytest.raises(Invalid, match="coarser"):
        resample(numbered(), local_frame(DATUM), resolution=1e-4)
    with pytest.raises(Invalid, match="beyond the target"):
        resample(numbered(), local_frame(Datum(-53.0, 179.0)))
    with pytest.raises(Invalid, match="cannot convert"):
        resample(numbered(crs="EPSG:99999"), local_frame(DATUM))


# --- displayed ----------------------------------------------------------------------------------------------------
SQUARE = (1.0, 0.0, 0.0, 0.0, -1.0, 0.0)


def shown(values: Any, kind: Any = np.uint8, **properties: Any) -> list[Any]:
    pixels = np.array(values, kind)
    return display_pixels(GeoImage(pixels, SQUARE, "local", properties)).tolist()


def test_displayed_bytes_are_unchanged() -> None:
    for bands in (1, 2, 3, 4):
        pixels = np.random.default_rng(bands).integers(0, 255, (700, 900, bands), dtype=np.uint8)
        assert np.array_equal(display_pixels(GeoImage(pixels, SQUARE)), pixels)


def test_displayed_values_of_other_types_are_stretched() -> None:
    assert shown([[[100], [300]], [[200], [300]]], np.uint16) == [[[0], [255]], [[128], [255]]]
    assert shown([[[-1.0], [1.0]]], np.float32) == [[[0, 255], [255, 255]]]
    assert shown([[[5.0], [np.nan]]], np.float64) == [[[0, 255], [0, 0]]]
    assert shown([[[np.nan], [np.inf]]], np.float64) == [[[0, 0], [0, 0]]]
    assert shown([[[-1.7e308], [1.7e308]]], np.float64)[0][1][1] == 255
    assert shown([[[True], [False]]], bool) == [[[255], [0]]]


def test_displayed_no_data_and_masks_are_transparent() -> None:
    assert shown([[[7, 7, 7], [7, 7, 8]]], nodata=7) == [[[7, 7, 7, 0], [7, 7, 8, 255]]]
    bands = [{"colour": "gray"}, {"colour": "mask"}]
    assert shown([[[9, 1], [8, 0]]], bands=bands) == [[[9, 255], [8, 0]]]
    assert shown([[[9, 65535], [9, 0]]], np.uint16) == [[[0, 255], [0, 0]]]


def test_displayed_image_uses_colour_bands() -> None:
    bands = [{"colour": c} for c in ("undefined", "blue", "green", "red", "undefined")]
    assert shown([[[1, 2, 3, 4, 5]]], bands=bands) == [[[4, 3, 2]]]
    assert shown([[[1, 2, 3, 4, 5]]]) == [[[1]]]
