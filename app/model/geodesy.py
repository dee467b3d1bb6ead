"""Conversion between WGS 84 and the local frame. No other module uses the ellipsoid.

The local frame is the transverse Mercator projection centred on the datum with scale 1, turned by the datum's heading.
PROJ's ``tmerc`` (Poder/Engsager) is exact to nanometres at these distances.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from pyproj import CRS, Geod, Proj, Transformer
from pyproj.crs import CompoundCRS, ProjectedCRS
from pyproj.crs.coordinate_operation import HotineObliqueMercatorBConversion, TransverseMercatorConversion
from pyproj.exceptions import ProjError

from app.errors import Invalid
from app.model.frame import MAX_METRES, Datum

Array = NDArray[np.float64]

WGS84 = "EPSG:4326"

SAME_METRES = 1e-6
"""Maximum distance of coordinates that are equal in two definitions of a CRS."""


class LocalFrame:
    """The local frame of a datum. Vectorised; every array is float64 of shape [n, 2] or [n, 3]."""

    __slots__ = ("_cos", "_proj", "_sin", "datum")

    def __init__(self, datum: Datum) -> None:
        self.datum = datum
        # Degrees with 17 significant digits: PROJ reads back the same float64.
        self._proj = Proj(self._definition("+ellps=WGS84"))
        heading = math.radians(datum.heading)
        self._cos, self._sin = math.cos(heading), math.sin(heading)

    def _definition(self, shape: str) -> str:
        return (
            f"+proj=tmerc +lat_0={self.datum.latitude:.17g} +lon_0={self.datum.longitude:.17g} +k=1 +x_0=0 +y_0=0 "
            f"{shape} +units=m +no_defs"
        )

    @property
    def crs(self) -> str:
        """Return the frame without the heading as a CRS on WGS 84 in PROJ's syntax: east and north in metres.

        With a heading of 0 its coordinates are the local ones; ``from_local`` gives them for any heading.
        """
        return self._definition("+datum=WGS84")

    @property
    def wkt(self) -> str:
        """Return ``crs`` with a name as WKT 1, which every GIS reads."""
        datum = self.datum
        conversion = TransverseMercatorConversion(datum.latitude, datum.longitude, 0.0, 0.0, 1.0)
        name = f"metres east and north of {datum.latitude:.7f}, {datum.longitude:.7f}"
        return str(ProjectedCRS(conversion, name, geodetic_crs=WGS84).to_wkt("WKT1_GDAL"))

    def turned_wkt(self, angle: float) -> str:
        """Return ``crs`` with axes turned counter-clockwise by an angle (radians) as WKT 1, which every GIS reads.

        Coordinates are those of ``crs``, turned, within 0.01 mm up to 1 km from the datum and 8 mm up to 10 km: no GIS
        reads an affine CRS from WKT 1, so this is the oblique Mercator projection centred on the datum.
        """
        azimuth = 45.0  # any but 0 and 90, where some programs fail; the grid's angle to it decides about the axes
        grid = (azimuth + math.degrees(angle) + 180.0) % 360.0 - 180.0
        datum = self.datum
        conversion = HotineObliqueMercatorBConversion(
            latitude_projection_centre=datum.latitude,
            longitude_projection_centre=datum.longitude,
            azimuth_projection_centre=azimuth,
            angle_from_rectified_to_skew_grid=grid,
        )
        name = f"metres along a grid turned by {math.degrees(angle):.7f} degrees"
        return str(ProjectedCRS(conversion, name, geodetic_crs=WGS84).to_wkt("WKT1_GDAL"))

    def is_same_crs(self, crs: str, points: Array) -> bool:
        """Return whether these points (x, y) of a CRS have the same coordinates in ``crs``: float64 [n, 2]."""
        try:
            return bool((np.abs(between(crs, self.crs, points) - points) <= SAME_METRES).all())
        except Invalid:
            return False

    @property
    def from_local(self) -> tuple[float, float, float, float]:
        """Return (p, q, r, s) with east = p·x + q·y and north = r·x + s·y in ``crs``."""
        return self._cos, self._sin, -self._sin, self._cos

    def to_local(self, lonlat: Array) -> Array:
        """Convert (longitude, latitude[, altitude]) in degrees and metres to (x, y[, z]) in metres.

        A third column passes through: heights keep the reference of their source. Points far round the globe, which the
        projection does not cover, become infinite.
        """
        points = np.asarray(lonlat, np.float64)
        out = points.copy()
        east, north = self._proj(points[:, 0], points[:, 1])
        if self._sin == 0.0 and self._cos == 1.0:
            out[:, 0], out[:, 1] = east, north
        else:
            with np.errstate(invalid="ignore"):  # infinite coordinates become NaN, which callers reject as well
                out[:, 0] = east * self._cos - north * self._sin
                out[:, 1] = east * self._sin + north * self._cos
        return out

    def _to_bounded_local(self, lonlat: Array) -> Array:
        """Convert like ``to_local``, but raise Invalid for coordinates that are infinite or beyond the maximum."""
        out = self.to_local(lonlat)
        far = ~(np.abs(out[:, :2]) <= MAX_METRES).all(axis=1)
        if far.any():
            longitude, latitude = lonlat[np.flatnonzero(far)[0], :2]
            raise Invalid(
                f"the position {latitude:g}, {longitude:g} (latitude, longitude) is too far from the datum "
                f"{self.datum.latitude:g}, {self.datum.longitude:g} for the local frame: correct it or the datum"
            )
        return out

    def to_wgs84(self, xy: Array) -> Array:
        """Convert (x, y[, z]) in metres to (longitude, latitude[, altitude]); longitude in [-180, 180]."""
        points = np.asarray(xy, np.float64)
        out = points.copy()
        x, y = points[:, 0], points[:, 1]
        if self._sin == 0.0 and self._cos == 1.0:
            east, north = x, y
        else:
            east = x * self._cos + y * self._sin
            north = y * self._cos - x * self._sin
        longitude, latitude = self._proj(east, north, inverse=True)
        out[:, 0], out[:, 1] = longitude, latitude
        return out

    def geometries_to_local(self, geometry: NDArray[np.object_]) -> NDArray[np.object_]:
        """Convert shapely geometries from degrees to metres. Raises Invalid if one is too far from the datum."""
        return _transform(geometry, self._to_bounded_local)

    def near_geometries_to_local(self, geometry: NDArray[np.object_]) -> NDArray[np.object_]:
        """Convert shapely geometries from degrees to metres; those too far from the datum become empty."""
        out = _transform(geometry, self.to_local)
        points, index = shapely.get_coordinates(out, return_index=True)
        far = np.unique(index[~(np.abs(points) <= MAX_METRES).all(axis=1)])
        if len(far):
            out[far] = shapely.GeometryCollection()
        return out

    def geometries_to_wgs84(self, geometry: NDArray[np.object_]) -> NDArray[np.object_]:
        """Convert shapely geometries from metres to degrees."""
        return _transform(geometry, self.to_wgs84)


def _transform(geometry: NDArray[np.object_], function: object) -> NDArray[np.object_]:
    """Transform x and y of all coordinates at once; a z passes through (mixed 2-D and 3-D is supported)."""
    if not len(geometry):
        return geometry
    has_z = shapely.has_z(geometry)
    out = np.empty(len(geometry), object)
    for mask, include_z in ((~has_z, False), (has_z, True)):
        if mask.any():
            out[mask] = shapely.transform(geometry[mask], function, include_z=include_z)
    return out


@lru_cache(maxsize=256)
def local_frame(datum: Datum) -> LocalFrame:
    """Return the frame of a datum; cached, since building one takes PROJ about a millisecond."""
    return LocalFrame(datum)


@lru_cache(maxsize=1)
def _ellipsoid() -> Geod:
    return Geod(ellps="WGS84")


def distance(a: tuple[float, float], b: tuple[float, float]) -> float:
    """Return the metres along the ellipsoid between two (longitude, latitude) in degrees."""
    return float(_ellipsoid().inv(*a, *b)[2])


def surface(polygon: object) -> float:
    """Return the square metres on the ellipsoid of a shapely Polygon or MultiPolygon in degrees, without its holes.

    A ring with longitudes beyond ±180 crosses the antimeridian.
    """
    total = 0.0
    for piece in shapely.get_parts(polygon):
        rings = [piece.exterior, *piece.interiors]
        sizes = [abs(_ellipsoid().polygon_area_perimeter(*ring.coords.xy)[0]) for ring in rings]
        total += sizes[0] - sum(sizes[1:])
    return total


def crs_bounds(crs: str, points: Array) -> tuple[float, float, float, float] | None:
    """Return (west, south, east, north) in degrees around points (x, y) of a named CRS; None if PROJ cannot convert.

    points: float64 [n, 2], x first (easting, longitude) whatever the CRS's own order.
    """
    try:
        longitude, latitude = _transformer(crs, WGS84).transform(points[:, 0], points[:, 1])
    except ProjError:
        return None
    if not (np.isfinite(longitude).all() and np.isfinite(latitude).all()):
        return None
    return float(longitude.min()), float(latitude.min()), float(longitude.max()), float(latitude.max())


def between(source: str, target: str, points: Array) -> Array:
    """Convert points (x, y) of one CRS to another: float64 [n, 2], x (easting, longitude) first in both.

    Points outside the target CRS become infinite. Raises Invalid if PROJ has no conversion between the two.
    """
    try:
        x, y = _transformer(source, target).transform(points[:, 0], points[:, 1])
    except ProjError as error:
        raise Invalid(f"cannot convert from the CRS {_short(source)} to {_short(target)}: {error}") from error
    return np.column_stack([x, y])


def geometries_from_wgs84(crs: str, geometry: NDArray[np.object_]) -> NDArray[np.object_]:
    """Convert shapely geometries from (longitude, latitude) to a CRS, x (easting) first; a z passes through.

    Points outside the CRS become infinite.
    """

    return _between(WGS84, crs, geometry)


def geometries_to_wgs84(crs: str, geometry: NDArray[np.object_]) -> NDArray[np.object_]:
    """Convert shapely geometries from a CRS, x (easting) first, to (longitude, latitude); a z passes through.

    Points outside the CRS become infinite.
    """
    return _between(crs, WGS84, geometry)


def _between(source: str, target: str, geometry: NDArray[np.object_]) -> NDArray[np.object_]:
    def convert(points: Array) -> Array:
        out = np.array(points, np.float64)
        out[:, :2] = between(source, target, points)
        return out

    return _transform(geometry, convert)


def local_crs_wkt(datum: Datum, *, pretty: bool = False) -> str:
    """Return the local frame as a CRS in WKT 2 (ISO 19162:2019)."""
    return str(_local_crs(datum).to_wkt("WKT2_2019", pretty=pretty))


def local_crs_projjson(datum: Datum) -> dict[str, Any]:
    """Return the local frame as a CRS in PROJJSON."""
    return dict(_local_crs(datum).to_json_dict())


_DEGREE = 'ANGLEUNIT["degree",0.0174532925199433]'
_METRE = 'LENGTHUNIT["metre",1]'
_AXES = f'CS[Cartesian,2],AXIS["x",{{}},ORDER[1]],AXIS["y",{{}},ORDER[2]],{_METRE}'
_COEFFICIENT = 'SCALEUNIT["coefficient",1]'
LOCAL_NAME = "Fleet Map Server local frame"


@lru_cache(maxsize=64)
def _local_crs(datum: Datum) -> CRS:
    """Build the local frame: a transverse Mercator projection, with a heading an affine CRS derived from it."""
    lengths = "".join(f'PARAMETER["False {name}",0,{_METRE}],' for name in ("easting", "northing")).rstrip(",")
    geographic = (
        '["WGS 84",DATUM["World Geodetic System 1984",ELLIPSOID["WGS 84",6378137,298.257223563,'
        f'{_METRE}]],PRIMEM["Greenwich",0,{_DEGREE}]]'
    )
    conversion = (
        'CONVERSION["centred on the datum",METHOD["Transverse Mercator",ID["EPSG",9807]],'
        f'PARAMETER["Latitude of natural origin",{datum.latitude:.17g},{_DEGREE}],'
        f'PARAMETER["Longitude of natural origin",{datum.longitude:.17g},{_DEGREE}],'
        f'PARAMETER["Scale factor at natural origin",1,SCALEUNIT["unity",1]],{lengths}]'
    )
    if datum.heading == 0.0:
        axes = _AXES.format("east", "north")
        return CRS.from_wkt(f'PROJCRS["{LOCAL_NAME}",BASEGEOGCRS{geographic},{conversion},{axes}]')
    p, q, _, _ = LocalFrame(datum).from_local
    rows = (("A0", 8623, 0.0), ("A1", 8624, p), ("A2", 8625, -q), ("B0", 8639, 0.0), ("B1", 8640, q), ("B2", 8641, p))
    parameters = ",".join(
        f'PARAMETER["{name}",{value:.17g},{_METRE if name.endswith("0") else _COEFFICIENT},ID["EPSG",{code}]]'
        for name, code, value in rows
    )
    return CRS.from_wkt(
        f'DERIVEDPROJCRS["{LOCAL_NAME}",BASEPROJCRS["north up",BASEGEOGCRS{geographic},{conversion}],'
        f'DERIVINGCONVERSION["turned by the heading",METHOD["Affine parametric transformation",ID["EPSG",9624]],'
        f"{parameters}],{_AXES.format('unspecified', 'unspecified')}]"
    )


def _short(crs: str) -> str:
    return crs if len(crs) <= 80 else crs[:79] + "…"


def crs_to_wgs84(crs: str, points: Array) -> Array:
    """Convert points of a CRS (a code or WKT) to (longitude, latitude, height): float64 [n, 3], x first in any CRS.

    Heights keep their reference and become metres, by the unit of the CRS's vertical axis if it has one. Points that
    PROJ cannot convert become infinite. Raises Invalid for a CRS that PROJ does not know.
    """
    out = np.array(points, np.float64)
    try:
        out[:, :2] = between(crs, WGS84, points)
        out[:, 2] *= _vertical_unit(crs)
    except (ProjError, Invalid) as error:
        raise Invalid(f"unknown CRS {_short(crs)!r}: use a code such as EPSG:32632") from error
    return out


def length_units(crs: str) -> tuple[float, float] | None:
    """Return the metres of a unit of x and of z; None if x is an angle. Without a vertical axis, heights are in metres.

    Raises Invalid for a CRS that PROJ does not know.
    """
    unit = engineering_unit(crs)
    if unit is not None:
        return unit, unit
    definition = CRS.from_user_input(crs)
    if definition.is_geographic or not definition.axis_info:
        return None
    return float(definition.axis_info[0].unit_conversion_factor), _vertical_unit(crs)


def with_vertical(crs: str, vertical: str) -> str | None:
    """Return the code of a CRS (EPSG:<number>) with the heights of a vertical one; None if PROJ knows no such CRS."""
    try:
        CRS.from_user_input(f"{crs}+{vertical}")
    except ProjError:
        return None
    return f"{crs}+{vertical}"


def with_height_unit(crs: str, unit: float) -> str:
    """Return a CRS with heights above an unknown surface, whose unit has this many metres, as WKT 2.

    Raises Invalid for a CRS that cannot have such heights (a geocentric one).
    """
    axis = f'AXIS["up (H)",up,LENGTHUNIT["{unit:.10g} m",{unit:.17g}]]'
    heights = CRS.from_wkt(f'VERTCRS["height",VDATUM["unknown"],CS[vertical,1],{axis}]')
    try:
        horizontal = CRS.from_user_input(crs).to_2d()
        compound = CompoundCRS(f"{horizontal.name} + height", [horizontal, heights])
    except ProjError as error:
        raise Invalid(f"the CRS {_short(crs)!r} cannot have heights of another unit") from error
    return str(compound.to_wkt("WKT2_2019"))


def engineering_unit(crs: str) -> float | None:
    """Return the metres of a unit of an engineering CRS (a local frame without a position on earth), else None.

    Raises Invalid for a CRS that PROJ does not know.
    """
    try:
        definition = CRS.from_user_input(crs)
    except ProjError as error:
        raise Invalid(f"unknown CRS {_short(crs)!r}: use a code such as EPSG:32632") from error
    if definition.type_name != "Engineering CRS":
        return None
    return float(definition.axis_info[0].unit_conversion_factor) if definition.axis_info else 1.0


def wgs84_wkt() -> str:
    """Return WGS 84 in degrees as WKT 1, in the dialect of GDAL."""
    return str(CRS.from_user_input(WGS84).to_wkt("WKT1_GDAL"))


def check_crs(crs: str) -> None:
    """Raise Invalid for a CRS (a code or WKT) that PROJ does not know."""
    try:
        CRS.from_user_input(crs)
    except ProjError as error:
        raise Invalid(f"unknown CRS {_short(crs)!r}: use a code such as EPSG:32632") from error


@lru_cache(maxsize=64)
def is_geographic(crs: str) -> bool:
    """Return whether a named CRS has longitudes and latitudes. Raises Invalid if PROJ does not know it."""
    try:
        return bool(CRS.from_user_input(crs).is_geographic)
    except ProjError as error:
        raise Invalid(f"unknown CRS {_short(crs)!r}: use a code such as EPSG:32632") from error


@lru_cache(maxsize=64)
def _vertical_unit(crs: str) -> float:
    """Return the metres of one unit of height; 1 if the CRS has no vertical axis."""
    axes = CRS.from_user_input(crs).axis_info
    return next((axis.unit_conversion_factor for axis in axes if axis.direction in ("up", "down")), 1.0)


@lru_cache(maxsize=64)
def _transformer(source: str, target: str) -> Transformer:
    return Transformer.from_crs(source, target, always_xy=True)
