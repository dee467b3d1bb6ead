"""Consumer checks for datum.yaml: the environment_template's tools, mapviz and robot_localization.

Sources: LCAS/environment_common (templating/datum.py and its converters: they look up datum_latitude, datum_longitude,
gnss_fence.gnss_fence_coords, gmapping), navsat_transform.cpp (``datum``: three decimals), rcl_yaml_param_parser (values
of one list must be of one type).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from app.errors import Problem
from app.formats import Files
from app.formats._rules import LIMITS, error_finding, is_number, numbers, shown, warning_finding
from app.model.frame import MAX_DATUM_LATITUDE
from app.syntax import yaml

SIZES = ("xmin", "xmax", "ymin", "ymax")
SAME_DEGREES = 1e-9


def check(files: Files) -> Iterator[Problem]:
    """Check a site's datum by its readers' rules."""
    main = next(iter(files))
    top = yaml.load(files[main], LIMITS)
    if not isinstance(top, dict):
        yield error_finding("a datum must be a mapping", main)
        return
    position: dict[str, Any] = {}
    for key, bound in (("datum_latitude", 90.0), ("datum_longitude", 180.0)):
        value = top.get(key)
        if not is_number(value) or abs(value) > bound:
            yield error_finding(f"must be degrees within ±{bound:g}, got {shown(value)}", main, where=key)
        else:
            position[key] = value
    if abs(position.get("datum_latitude", 0.0)) > MAX_DATUM_LATITUDE:
        reason = (
            f"latitude must be within ±{MAX_DATUM_LATITUDE:g} degrees: no local frame is exact beyond it, and this "
            "server rejects such a datum"
        )
        yield error_finding(reason, main, where="datum_latitude")
    fence = top.get("gnss_fence")
    corners = fence.get("gnss_fence_coords") if isinstance(fence, dict) else None
    if corners is None or corners == []:  # the writer's output without a fence
        yield warning_finding(
            "the fence is empty: the environment_template's tools draw the map from it", main, where="gnss_fence"
        )
    elif not isinstance(corners, list) or len(corners) < 3 or not all(numbers(c, 2, 3) for c in corners):
        reason = "must be a list of at least three corners [latitude, longitude]"
        yield error_finding(reason, main, where="gnss_fence.gnss_fence_coords")
    elif any(abs(c[0]) > 90.0 or abs(c[1]) > 180.0 for c in corners):
        reason = "each corner must be [latitude, longitude] in degrees"
        yield error_finding(reason, main, where="gnss_fence.gnss_fence_coords")
    size = top.get("gmapping")
    if size is not None and not (isinstance(size, dict) and all(is_number(size.get(w)) for w in SIZES)):
        yield error_finding(f"needs the numbers {', '.join(SIZES)}", main, where="gmapping")
    yield from _navsat(top.get("navsat_transform_node"), position, main)


def _navsat(parameters: Any, position: dict[str, Any], main: str) -> Iterator[Problem]:
    location = "navsat_transform_node.datum"
    if parameters is None:
        return
    datum = parameters.get("datum") if isinstance(parameters, dict) else None
    if datum is None:
        if isinstance(parameters, dict) and parameters.get("wait_for_datum"):
            yield warning_finding(
                "wait_for_datum is set but there is no datum; robot_localization waits for one", main, where=location
            )
        return
    if not numbers(datum, 3, 3):
        yield error_finding(f"must be [latitude, longitude, yaw], got {shown(datum)}", main, where=location)
        return
    if len({type(v) for v in datum}) > 1:
        yield warning_finding(
            f"mixed types in {shown(datum)}: ROS 2 requires one type per list, write 0.0 instead of 0",
            main,
            where=location,
        )
    for value, key in zip(datum, ("datum_latitude", "datum_longitude"), strict=False):
        if key in position and abs(value - position[key]) > SAME_DEGREES:
            yield warning_finding(f"differs from {key} {position[key]!r}", main, where=location)
            break
