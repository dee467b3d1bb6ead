"""Rules of Nav2 for a map's YAML file and image, and for masks of its costmap filters.

Sources: nav2_map_server, map_io.cpp (loadMapYaml, loadMapFromFile); nav2_ros_common, validate_messages.hpp;
nav2_costmap_2d, static_layer.cpp and costmap_filters; PyYAML for the tools in Python.
"""

from __future__ import annotations

import math
import posixpath
import re
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from app.errors import BadUpload, Problem
from app.formats import Files
from app.formats._rules import LIMITS, cpp_bool, cpp_number, error_finding, shown, warning_finding
from app.limits import Limits
from app.syntax import geotiff, images, yaml

REQUIRED = ("image", "resolution", "origin", "free_thresh", "occupied_thresh", "negate")
MODES = ("trinary", "scale", "raw")
MAX_CELLS = 32767
MIN_RESOLUTION = 1e-6
SAVED_UNKNOWN = 205
"""Grey value that map_saver writes for unknown; 1 - 205/255 = 0.19608 is just above its free_thresh of 0.196."""

DECODED = 2**22
"""Maximum pixels of a compressed image that is decoded to search a grey value; a PGM is searched directly."""

_YAML = Limits(yaml_nodes=10_000)
_HEADER = Limits(pixels=MAX_CELLS**2)
"""Limits for an image's header: Nav2's, whatever the server's settings are."""


def check(files: Files) -> Iterator[Problem]:
    """Check a YAML file as map_server reads it, and its image's header. A single image has no rules."""
    main = next((n for n in files if images.detect_kind(files[n]) is None and not geotiff.is_tiff(files[n])), None)
    if main is None:
        return
    members = yaml.load(files[main], _YAML, typed=False)
    if not isinstance(members, dict):
        yield error_finding("a map's YAML file must be a mapping", main)
        return
    for key in REQUIRED:
        if members.get(key) is None:
            yield error_finding("map_server rejects a map without this key", main, where=key)
    thresholds: dict[str, float] = {}
    for key in ("resolution", "free_thresh", "occupied_thresh"):
        if members.get(key) is not None:
            number = cpp_number(members[key])
            if number is None or not math.isfinite(number):
                yield error_finding(f"must be a finite number, got {shown(members[key])}", main, where=key)
                continue
            thresholds[key] = number
            yield from _for_python(members[key], main, key)
    if thresholds.get("resolution", 1.0) < MIN_RESOLUTION:
        yield error_finding(f"Nav2 rejects a resolution below {MIN_RESOLUTION:g} m", main, where="resolution")
    yield from _origin(members.get("origin"), main)
    mode = members.get("mode", "trinary")
    if mode not in MODES:
        yield error_finding(f"must be one of {', '.join(MODES)}, got {shown(mode)}", main, where="mode")
    negate = _negate(members.get("negate"))
    if members.get("negate") is not None and negate is None:
        yield error_finding(f"must be 0, 1, true or false, got {shown(members['negate'])}", main, where="negate")
    free, occupied = thresholds.get("free_thresh", 0.0), thresholds.get("occupied_thresh", 1.0)
    for key in ("free_thresh", "occupied_thresh"):
        if not 0.0 <= thresholds.get(key, 0.0) <= 1.0:
            yield warning_finding("is outside 0 to 1; no cell or every cell matches it", main, where=key)
    if mode in ("trinary", "scale") and free > occupied:
        yield warning_finding("is above occupied_thresh; cells that match both are free", main, where="free_thresh")
    if members.get("image") is not None:
        yield from _picture(members, main, files, str(mode), bool(negate), (free, occupied))


def _negate(value: Any) -> bool | None:
    flag = cpp_bool(value)
    if flag is not None:
        return flag
    number = cpp_number(value)
    return bool(number) if number is not None and number.is_integer() else None


def _for_python(text: str, main: str, key: str) -> Iterator[Problem]:
    if re.fullmatch(r"[-+]?\d+[eE][-+]?\d+|[-+]?[\d.]+[eE]\d+", text.strip()):
        reason = f"Python tools (PyYAML) read {shown(text)} as text: write a point and a sign, as in 1.0e-05"
        yield warning_finding(reason, main, where=key)


def _origin(origin: Any, main: str) -> Iterator[Problem]:
    if origin is None:
        return
    pose = [cpp_number(v) for v in origin] if isinstance(origin, list) else []
    if len(pose) != 3 or any(v is None or not math.isfinite(v) for v in pose):
        yield error_finding(f"must be three finite numbers [x, y, yaw], got {shown(origin)}", main, where="origin")
        return
    for text in origin:
        yield from _for_python(text, main, "origin")
    if pose[2]:
        reason = (
            f"Nav2's static layer and AMCL ignore the yaw of {pose[2]:g} rad: rotate the cells instead and set yaw to 0"
        )
        yield warning_finding(reason, main, where="origin")


def _picture(
    members: Mapping[str, Any], main: str, files: Files, mode: str, negate: bool, thresholds: tuple[float, float]
) -> Iterator[Problem]:
    image = members["image"]
    if not isinstance(image, str) or not image:
        yield error_finding(f"must be the name of an image file, got {shown(image)}", main, where="image")
        return
    if image.startswith("/"):
        reason = "absolute path: each robot needs the image there. Use a file name next to the YAML file"
        yield warning_finding(reason, main, where="image")
        return
    name = posixpath.normpath(posixpath.join(posixpath.dirname(main), image))
    if name not in files:
        yield error_finding(f"image {shown(image)} not found relative to the YAML file", main, where="image")
        return
    data = files[name]
    kind = images.detect_kind(data)
    if kind is None:
        yield warning_finding(
            "is not PGM, PNG, BMP or JPEG: map_server may not be able to read it, depending on its GraphicsMagick", name
        )
        return
    try:
        width, height = images.read_size(data, _HEADER)
    except BadUpload as error:
        yield error_finding(error.detail, name)
        return
    if max(width, height) > MAX_CELLS:
        yield error_finding(f"has {width} × {height} cells: Nav2's maximum is {MAX_CELLS} in each direction", name)
    if kind == "jpeg":
        yield warning_finding("JPEG changes grey values, so cells beside a wall may change: use PGM or PNG", name)
    speed = "speed" in posixpath.basename(main).lower()
    if speed and mode == "trinary":
        reason = "a speed mask contains percentages, but trinary has 0 and 100 only: use scale or raw"
        yield warning_finding(reason, main, where="mode")
    if mode in MODES and (speed or (mode == "trinary" and not negate and thresholds[0] >= 1 - SAVED_UNKNOWN / 255)):
        yield from _greys(data, name, main, width * height, mode, negate, thresholds, speed=speed)


def _greys(
    data: bytes,
    name: str,
    main: str,
    count: int,
    mode: str,
    negate: bool,
    thresholds: tuple[float, float],
    *,
    speed: bool,
) -> Iterator[Problem]:
    """Check the meaning of the grey values in use; skips large images that would have to be decoded."""
    shade = np.arange(256)
    share = shade / 255 if negate else 1 - shade / 255
    if mode == "raw":
        unknown = shade > 100
    else:
        unknown = (share > thresholds[0]) & (share < thresholds[1]) if mode == "trinary" else np.zeros(256, bool)
    if data[:2] == b"P5" and data.rfind(b"\n255", 0, 512) > 0:
        pixels: bytes = data[-count:]
    elif count <= DECODED:
        try:
            pixels = images.read_grey(data, LIMITS).pixels()[0].tobytes()
        except BadUpload as error:
            yield error_finding(error.detail, name)
            return
    else:
        return
    if speed and unknown.any() and len(pixels.translate(None, bytes(np.flatnonzero(~unknown).tolist()))):
        reason = "some cells are unknown: Nav2's speed filter reports an error when a robot drives on one"
        yield warning_finding(reason, name)
    if not speed and SAVED_UNKNOWN in pixels:
        reason = (
            f"with {thresholds[0]:g} the grey 205, map_saver's unknown, is read as free: write 0.196 if such cells are "
            "unknown"
        )
        yield warning_finding(reason, main, where="free_thresh")
