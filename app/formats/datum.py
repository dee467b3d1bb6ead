"""datum.yaml: position of an environment's local origin (0, 0), and the GNSS fence around it.

Positions are [latitude, longitude], degrees WGS 84: the reverse of GeoJSON and KML. One file is the parameter file of
robot_localization's navsat_transform_node, of mapviz and of gmapping.
Source: the environment_template's config/location/datum.yaml; navsat_transform.cpp for the meaning of ``datum``.

The heading is ``navsat_transform_node.datum[2]``: the yaw of the local +x axis in radians, counter-clockwise from
east; so the bearing of the local +y axis, clockwise from north, is the same angle negated. mapviz' altitude is stored
but not used; ``datum_altitude`` is our extension, which no consumer reads, and is written only if it is not 0.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from app.errors import Problem, UnreadableFile
from app.formats import (
    Claims,
    Files,
    Format,
    LayerRequirements,
    ReadContext,
    WriteContext,
    _datum_rules,
    _fields,
    register,
)
from app.formats._fields import ANGLE, COORDINATE, LATITUDE, LONGITUDE, Number, OneOf, record
from app.model.features import Features, features
from app.model.frame import GROUND, MAX_DATUM_LATITUDE, Datum
from app.model.geodesy import distance
from app.model.grid import OccupancyGrid
from app.model.layers import SITE, Layers, PartKey
from app.parameters import parameter
from app.syntax import yaml
from app.syntax.decimals import DEGREES

NAME = "datum"
FENCE = "fence"
MAPVIZ_ALTITUDE = 100.0
HALF_MAP = 100.0
"""Default distance from the datum to each side of the map, in metres: the template's map size."""


@dataclass(frozen=True, slots=True)
class NavSat:
    """Parameters of robot_localization's navsat_transform_node except the datum, with the template's defaults."""

    magnetic_declination_radians: float = parameter(
        0.0, "navsat_transform_node parameter, used if no source has it", minimum=-4.0, maximum=4.0, unit="rad"
    )
    yaw_offset: float = parameter(
        0.0, "navsat_transform_node parameter, used if no source has it", minimum=-7.0, maximum=7.0, unit="rad"
    )
    zero_altitude: bool = parameter(True, "navsat_transform_node parameter, used if no source has it")
    broadcast_utm_transform: bool = parameter(False, "navsat_transform_node parameter, used if no source has it")
    broadcast_utm_transform_as_parent_frame: bool = parameter(
        False, "navsat_transform_node parameter, used if no source has it"
    )
    publish_filtered_gps: bool = parameter(True, "navsat_transform_node parameter, used if no source has it")
    use_odometry_yaw: bool = parameter(False, "navsat_transform_node parameter, used if no source has it")
    wait_for_datum: bool = parameter(True, "navsat_transform_node parameter, used if no source has it")


_SIZE = record(xmin=COORDINATE, xmax=COORDINATE, ymin=COORDINATE, ymax=COORDINATE)
_ALTITUDE = Number(-12_000.0, 100_000.0, unit="metres")
_HEADING = Number(-360.0, 360.0, unit="degrees")
_ORIGIN = record("name", latitude=LATITUDE, longitude=LONGITUDE, altitude=_ALTITUDE, heading=_HEADING)
_BOOL = OneOf((True, False))
SHAPE = record(
    datum_latitude=LATITUDE,
    datum_longitude=LONGITUDE,
    datum_altitude=_ALTITUDE,
    gnss_fence=record("gnss_fence_coords"),
    gmapping=_SIZE,
    mapviz_initialize_origin=record(local_xy_origins=[_ORIGIN], is_open=True),
    navsat_transform_node=record(
        "datum map_frame odom_frame base_link_frame world_frame cartesian_frame_id gps_frame",
        frequency=Number(0.0, 1e4, above=True, unit="Hz"),
        delay=Number(0.0, 1e4, unit="s"),
        transform_timeout=Number(0.0, 1e4, unit="s"),
        magnetic_declination_radians=ANGLE,
        yaw_offset=ANGLE,
        use_manual_datum=_BOOL,
        use_local_cartesian=_BOOL,
        broadcast_cartesian_transform=_BOOL,
        broadcast_cartesian_transform_as_parent_frame=_BOOL,
        zero_altitude=_BOOL,
        broadcast_utm_transform=_BOOL,
        broadcast_utm_transform_as_parent_frame=_BOOL,
        publish_filtered_gps=_BOOL,
        use_odometry_yaw=_BOOL,
        wait_for_datum=_BOOL,
    ),
)
"""Shape of the file. Source: environment_template, robot_localization's navsat_transform_node, mapviz."""

MAX_USUAL_METRES = 100_000.0
"""Distance from the datum to a corner of the fence, in metres, beyond which one of them is probably wrong."""

NAVSAT = tuple(f.name for f in fields(NavSat))
"""Names of the parameters, in the template's order."""


@dataclass(frozen=True, slots=True)
class WriteOptions(NavSat):
    """Values to write if no source has them."""

    half_size: float = parameter(
        HALF_MAP,
        "distance from the datum to each side of the map, if the environment has no known extent",
        minimum=1.0,
        maximum=1e5,
        unit="m",
    )


HEAD = "# Site datum: the place of the local (0, 0), degrees WGS 84\n"
FENCE_HEAD = "\n# GNSS fence, [latitude, longitude]\n"
SIZE_HEAD = "\n# Map size (x east, y north), metres from the datum\n"


def read(files: Files, context: ReadContext) -> Layers:
    """Read the datum, and the fence as one polygon of the location layer (longitude, latitude, wgs84).

    All other keys are stored in the collection document. Raises UnreadableFile with the invalid key.
    """
    top = yaml.load(files[context.main or next(iter(files))], context.limits)
    if not isinstance(top, dict):
        raise _unreadable_error("must be a mapping with datum_latitude and datum_longitude", "")
    for key in ("gmapping", "mapviz_initialize_origin", "navsat_transform_node"):
        if not isinstance(top.get(key, {}), (dict, type(None))):
            raise _unreadable_error("must be a mapping", key)
    latitude = _degrees(top.get("datum_latitude"), "datum_latitude", MAX_DATUM_LATITUDE)
    longitude = _degrees(top.get("datum_longitude"), "datum_longitude", 180.0)
    altitude = _number(top.get("datum_altitude", 0.0), "datum_altitude")
    yaw = _yaw(top.get("navsat_transform_node") or {}, latitude, longitude, context)
    ring = _fence(top.get("gnss_fence"), context)
    _fields.check(top, SHAPE, context)
    _check_place(latitude, longitude, ring, context)
    document = {NAME: {key: value for key, value in top.items() if key not in ("gnss_fence", "datum_altitude")}}
    fence = top.get("gnss_fence")
    if isinstance(fence, dict) and len(fence) > 1:
        document[NAME]["gnss_fence"] = {key: value for key, value in fence.items() if key != "gnss_fence_coords"}
    rows = []
    if ring is not None:
        properties: dict[str, Any] = {"kind": FENCE}
        if (ring[0] == ring[-1]).all():
            properties[NAME] = {"closed": True}
        rows.append((FENCE, shapely.Polygon(ring), properties))
    datum = Datum(latitude, longitude, altitude, _heading(yaw))
    return Layers({PartKey("location", context.level, SITE): features(rows, "wgs84", document)}, datum)


def _check_place(latitude: float, longitude: float, ring: NDArray[np.float64] | None, context: ReadContext) -> None:
    """Warn about an implausible datum or fence."""
    if latitude == longitude == 0.0:
        context.warn("the datum is at 0, 0; set the position of your site", where="datum_latitude")
    if ring is None:
        return
    location = "gnss_fence.gnss_fence_coords"
    far = [k for k, (x, y) in enumerate(ring.tolist()) if distance((longitude, latitude), (x, y)) > MAX_USUAL_METRES]
    if far:
        reason = f"{len(far)} of {len(ring)} points are more than {MAX_USUAL_METRES / 1000:g} km from the datum"
        context.warn(f"{reason}; are latitude and longitude swapped?", where=f"{location}[{far[0]}]")
    if not shapely.Polygon(ring).is_valid:
        context.warn("the fence crosses itself; its inside is undefined", where=location)


def _unreadable_error(reason: str, location: str) -> UnreadableFile:
    return UnreadableFile(f"{location}: {reason}" if location else reason, [Problem(reason, where=location or None)])


def _number(value: Any, location: str) -> float:
    """Return a finite number, possibly given in quotes."""
    if isinstance(value, str):
        try:
            value = yaml.scalar(value)
        except ValueError:
            value = None
    if value is None or isinstance(value, bool) or not isinstance(value, (int, float)):
        raise _unreadable_error("must be a number", location)
    return float(value)


def _degrees(value: Any, location: str, bound: float) -> float:
    if value is None:
        raise _unreadable_error("missing: the datum needs datum_latitude and datum_longitude in degrees", location)
    degrees = _number(value, location)
    if not -bound <= degrees <= bound:
        raise _unreadable_error(f"must be between {-bound:g} and {bound:g} degrees, got {degrees:g}", location)
    return degrees


def _yaw(navsat: Mapping[str, Any], latitude: float, longitude: float, context: ReadContext) -> float:
    """Return the angle from east to the local +x axis, counter-clockwise, in radians."""
    location = "navsat_transform_node.datum"
    raw_datum = navsat.get("datum")
    if raw_datum is None:
        return 0.0
    if not isinstance(raw_datum, list) or len(raw_datum) < 2:
        raise _unreadable_error("must be [latitude, longitude, yaw in radians]", location)
    other = [_number(v, f"{location}[{k}]") for k, v in enumerate(raw_datum[:3])]
    if abs(other[0] - latitude) > 1e-9 or abs(other[1] - longitude) > 1e-9:
        context.warn("differs from datum_latitude and datum_longitude, which take precedence", where=location)
    for key in ("yaw_offset", "magnetic_declination_radians"):
        value = navsat.get(key, 0.0)
        if isinstance(value, (int, float)) and not isinstance(value, bool) and value != 0:
            context.warn(
                f"is {value}: robot_localization adds it to the datum's yaw; this server uses the yaw as given",
                where=f"navsat_transform_node.{key}",
            )
    return other[2] if len(other) > 2 else 0.0


def _heading(yaw: float) -> float:
    """Return degrees clockwise from true north to the local +y axis, within ±180."""
    return math.degrees(-math.remainder(yaw, 2 * math.pi)) + 0.0


def _fence(members: Any, context: ReadContext) -> NDArray[np.float64] | None:
    """Return float64 [n, 2] (longitude, latitude) in the file's order, or None without a fence."""
    location = "gnss_fence.gnss_fence_coords"
    if members is not None and not isinstance(members, dict):
        raise _unreadable_error("must be a mapping with gnss_fence_coords", "gnss_fence")
    listed = (members or {}).get("gnss_fence_coords")
    if listed is None or listed == []:
        context.warn("missing; the environment has a datum but no fence", where=location)
        return None
    if not isinstance(listed, list):
        raise _unreadable_error("must be a list of [latitude, longitude]", location)
    ring = np.empty((len(listed), 2))
    for k, pair in enumerate(listed):
        at = f"{location}[{k}]"
        if not isinstance(pair, list) or len(pair) != 2:
            raise _unreadable_error("must be [latitude, longitude]", at)
        ring[k] = _degrees(pair[1], f"{at}[1]", 180.0), _degrees(pair[0], f"{at}[0]", 90.0)
    if len(np.unique(ring, axis=0)) < 3:
        raise _unreadable_error(
            f"a fence needs at least 3 different points, got {len(np.unique(ring, axis=0))}", location
        )
    return ring


# --- writing ---------------------------------------------------------------------------------------------------------


def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """Write ``datum.yaml`` in the template's layout. The caller ensures that there is a datum."""
    datum, frame = layers.datum, layers.frame
    if datum is None or frame is None:
        raise ValueError("datum required")
    fence, document, closed = _select_fence(layers, context)
    latitude, longitude = yaml.text(datum.latitude), yaml.text(datum.longitude)
    out = [HEAD, f"datum_latitude: {latitude}\ndatum_longitude: {longitude}\n"]
    if datum.altitude:
        out.append(f"datum_altitude: {yaml.text(datum.altitude)}\n")
    out.append(FENCE_HEAD)
    ring = None if fence is None else shapely.get_coordinates(fence.exterior)
    if ring is None:
        context.warn("the environment has no fence; gnss_fence_coords is empty", where="gnss_fence.gnss_fence_coords")
        pairs = []
    else:
        pairs = [f"[{yaml.text(y)}, {yaml.text(x)}]" for x, y in (ring if closed else ring[:-1]).tolist()]
    out.append(f"gnss_fence:\n  gnss_fence_coords: [{', '.join(pairs)}]\n")
    more_fence = document.pop("gnss_fence", None)
    if isinstance(more_fence, dict) and more_fence:
        out.append(yaml.mapping(more_fence, 2))
    out.append(f"{SIZE_HEAD}gmapping:\n")
    out.append(_mapping_text(_size(document, layers, ring, context), 2, ("xmin", "xmax", "ymin", "ymax")))
    old = (document.get("datum_latitude"), document.get("datum_longitude"))
    out.append("\nmapviz_initialize_origin:" + _mapviz(document, datum, old, context))
    out.append("\nnavsat_transform_node:\n" + _navsat(document, datum, context))
    extra_members = {key: value for key, value in document.items() if key not in _KEYS}
    if extra_members:
        out.append("\n" + yaml.mapping(extra_members, 0))
    return {"datum.yaml": "".join(out).encode()}


_KEYS = frozenset(
    {"datum_latitude", "datum_longitude", "gmapping", "mapviz_initialize_origin", "navsat_transform_node"}
)


def _select_fence(layers: Layers, context: WriteContext) -> tuple[Any, dict[str, Any], bool]:
    """Return the fence as a polygon in degrees or None, the source's other keys, and whether its ring was closed."""
    source_document: dict[str, Any] = {}
    candidates: list[tuple[bool, float, str, Any, bool]] = []
    dropped_count = 0
    for key, part in sorted(layers.vector("location").items(), key=lambda item: item[0].level != GROUND):
        document = part.document.get(NAME)
        if isinstance(document, dict) and not source_document:
            source_document = dict(document)
        places = part.in_wgs84(layers.frame)
        if part.local.any():
            # Computed degrees are rounded for equal output on every machine; given degrees are written unchanged.
            places = places.copy()
            places[part.local] = shapely.transform(places[part.local], lambda xy: np.round(xy, DEGREES) + 0.0)
        for feature, geometry in zip(part, places, strict=True):
            source_properties = feature.properties.get(NAME)
            closed = isinstance(source_properties, dict) and source_properties.get("closed") is True
            pieces = list(geometry.geoms) if geometry.geom_type == "MultiPolygon" else [geometry]
            for k, piece in enumerate(pieces):
                if piece.geom_type == "Polygon" and not piece.is_empty:
                    is_fence = feature.properties.get("kind") == FENCE
                    candidates.append((not is_fence, -piece.area, f"{key.level}/{feature.id}/{k}", piece, closed))
                else:
                    dropped_count += 1
    context.drop("location items that are not polygons", dropped_count, "datum.yaml holds one fence")
    if not candidates:
        return None, source_document, False
    candidates.sort(key=lambda row: row[:3])
    context.drop("further location polygons", len(candidates) - 1, "datum.yaml holds one fence")
    fence = candidates[0][3]
    context.drop("holes of the fence", len(fence.interiors), "a fence in datum.yaml is one ring")
    return fence, source_document, candidates[0][4]


def _options(context: WriteContext) -> WriteOptions:
    return context.options if isinstance(context.options, WriteOptions) else WriteOptions()


def _size(document: Mapping[str, Any], layers: Layers, ring: Any, context: WriteContext) -> dict[str, Any]:
    """Return the source's gmapping; missing keys come from the extent of fence and data, in whole metres."""
    gmapping = document.get("gmapping")
    size = dict(gmapping) if isinstance(gmapping, dict) else {}
    lacking = [key for key in ("xmin", "xmax", "ymin", "ymax") if key not in size]
    if not lacking:
        return size
    extent = _extent(layers, ring)
    if extent is None:
        half = _options(context).half_size
        why, extent, option = "the environment has no known extent", (-half, -half, half, half), "half_size"
    else:
        why, option = "extent of the fence and the data, in whole metres", None
    west, south, east, north = extent
    bounds = {"xmin": math.floor(west), "xmax": math.ceil(east), "ymin": math.floor(south), "ymax": math.ceil(north)}
    for key in lacking:
        size[key] = bounds[key]
    context.fill("gmapping", {key: size[key] for key in lacking}, why, option)
    return size


def _extent(layers: Layers, ring: Any) -> tuple[float, float, float, float] | None:
    """Return west, south, east and north of all data, in local metres."""
    frame = layers.frame
    boxes: list[NDArray[np.float64]] = []
    if ring is not None and frame is not None:
        boxes.append(frame.to_local(ring))
    for part in layers.parts.values():
        if isinstance(part, Features) and len(part):
            boxes.append(shapely.get_coordinates(part.in_local(frame)))
        elif isinstance(part, OccupancyGrid):
            boxes.append(np.asarray(part.corners(), np.float64))
    everything = np.concatenate([np.empty((0, 2)), *boxes])
    if not len(everything):
        return None
    west, south = everything.min(axis=0).tolist()
    east, north = everything.max(axis=0).tolist()
    return west, south, east, north


def _mapviz(document: Mapping[str, Any], datum: Datum, old: tuple[Any, Any], context: WriteContext) -> str:
    """Return mapviz' origins; those at the source's datum move to the current datum."""
    mapviz = document.get("mapviz_initialize_origin")
    if mapviz is None:
        new_origin: dict[str, Any] = {"name": "dont_change_this", "latitude": None, "longitude": None}
        new_origin |= {"altitude": MAPVIZ_ALTITUDE, "heading": 0.0}
        mapviz = {"local_xy_origins": [new_origin]}
        context.fill("mapviz_initialize_origin", "one origin at the datum", "no source specifies it")
        old = (None, None)
    origins = mapviz.get("local_xy_origins") if isinstance(mapviz, dict) else None
    if not isinstance(mapviz, dict) or not isinstance(origins, list):
        return yaml.block(mapviz, 0)
    moved = []
    for origin in origins:
        if isinstance(origin, dict) and (origin.get("latitude"), origin.get("longitude")) == old:
            moved.append({**origin, "latitude": datum.latitude, "longitude": datum.longitude})
        else:
            moved.append(origin)
    return yaml.block({**mapviz, "local_xy_origins": moved}, 0)


def _navsat(document: Mapping[str, Any], datum: Datum, context: WriteContext) -> str:
    """Return navsat_transform_node's parameters, with the current datum."""
    members = document.get("navsat_transform_node")
    navsat = dict(members) if isinstance(members, dict) else {}
    defaults = {key: getattr(_options(context), key) for key in NAVSAT}
    for key in NAVSAT:
        if key not in navsat:
            context.fill(f"navsat_transform_node: {key}", defaults[key], "no source specifies it", key)
    listed = navsat.pop("datum", None)
    yaw: Any = listed[2] if isinstance(listed, list) and len(listed) > 2 else None
    more = listed[3:] if isinstance(listed, list) else []
    # Keep the source's yaw for the same angle: it may exceed a full turn and has digits that degrees would lose.
    if isinstance(yaw, bool) or not isinstance(yaw, (int, float)) or _heading(yaw) != datum.heading:
        yaw = -math.radians(datum.heading) + 0.0
    values = [yaml.text(datum.latitude), yaml.text(datum.longitude), *map(yaml.text, [yaw, *more])]
    return _mapping_text({**defaults, **navsat}, 2, NAVSAT) + f"  datum: [{', '.join(values)}]\n"


def _mapping_text(values: Mapping[str, Any], column: int, first: Sequence[str]) -> str:
    """Return a mapping's text: these keys in this order, then the others sorted."""
    out = [yaml.mapping({key: values[key]}, column) for key in first if key in values]
    extra_members = {key: value for key, value in values.items() if key not in first}
    return "".join(out) + (yaml.mapping(extra_members, column) if extra_members else "")


_KEY = re.compile(rb"(?m)^datum_latitude\s*:")


def detect(name: str, data: bytes) -> bool:
    """Detect YAML with the datum's latitude and longitude at its top level."""
    yaml_name = name.lower().endswith((".yaml", ".yml"))
    return yaml_name and bool(_KEY.search(data)) and b"datum_longitude" in data


register(
    Format(
        name=NAME,
        title="Datum and GNSS fence (environment_template)",
        files={"datum.yaml": "application/yaml"},
        layers=frozenset({"location"}),
        detect=detect,
        read=read,
        check=_datum_rules.check,
        write=write,
        needs=LayerRequirements(one_of=(frozenset({"location"}),), anchor="wgs84", datum=True),
        write_options=WriteOptions,
        extensions=(".yaml", ".yml"),
        claims=Claims(priority=60, leads_folder="location"),
    )
)
