"""What Nav2 wants of a map's YAML and picture, and of the masks of its costmap filters.

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
from app.syntax import images, yaml

REQUIRED = ("image", "resolution", "origin", "free_thresh", "occupied_thresh", "negate")
MODES = ("trinary", "scale", "raw")
MAX_CELLS = 32767
MIN_RESOLUTION = 1e-6
SAVED_UNKNOWN = 205
"""The grey that map_saver writes for unknown; 1 - 205/255 = 0.19608 is just above its free_thresh of 0.196."""

DECODED = 2**22
"""Pixels up to which a compressed picture is decoded to look for a grey; a PGM is searched as it is."""

_YAML = Limits(yaml_nodes=10_000)


def check(files: Files) -> Iterator[Problem]:
    """A YAML as map_server reads it, and its picture's header. A picture alone has no rules."""
    main = next((n for n in files if images.detect_kind(files[n]) is None), None)
    if main is None:
        return
    members = yaml.load(files[main], _YAML, typed=False)
    if not isinstance(members, dict):
        yield error_finding("a map's YAML is a mapping", main)
        return
    for key in REQUIRED:
        if members.get(key) is None:
            yield error_finding("map_server refuses a map without this key", main, where=key)
    thresholds: dict[str, float] = {}
    for key in ("resolution", "free_thresh", "occupied_thresh"):
        if members.get(key) is not None:
            number = cpp_number(members[key])
            if number is None or not math.isfinite(number):
                yield error_finding(f"must be a finite number, is {shown(members[key])}", main, where=key)
                continue
            thresholds[key] = number
            yield from _for_python(members[key], main, key)
    if thresholds.get("resolution", 1.0) < MIN_RESOLUTION:
        yield error_finding(f"Nav2 refuses a resolution below {MIN_RESOLUTION:g} m", main, where="resolution")
    yield from _origin(members.get("origin"), main)
    mode = members.get("mode", "trinary")
    if mode not in MODES:
        yield error_finding(f"must be one of {', '.join(MODES)}, is {shown(mode)}", main, where="mode")
    negate = _negate(members.get("negate"))
    if members.get("negate") is not None and negate is None:
        yield error_finding(f"must be 0, 1, true or false, is {shown(members['negate'])}", main, where="negate")
    free, occupied = thresholds.get("free_thresh", 0.0), thresholds.get("occupied_thresh", 1.0)
    for key in ("free_thresh", "occupied_thresh"):
        if not 0.0 <= thresholds.get(key, 0.0) <= 1.0:
            yield warning_finding("lies outside of 0 to 1, so it never or always holds", main, where=key)
    if mode in ("trinary", "scale") and free > occupied:
        yield warning_finding("is above occupied_thresh: where both hold a cell is free", main, where="free_thresh")
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
        reason = f"{shown(text)} is a text for tools in Python (PyYAML): write a point and a sign, as in 1.0e-05"
        yield warning_finding(reason, main, where=key)


def _origin(origin: Any, main: str) -> Iterator[Problem]:
    if origin is None:
        return
    pose = [cpp_number(v) for v in origin] if isinstance(origin, list) else []
    if len(pose) != 3 or any(v is None or not math.isfinite(v) for v in pose):
        yield error_finding(f"must be three finite numbers [x, y, yaw], is {shown(origin)}", main, where="origin")
        return
    for text in origin:
        yield from _for_python(text, main, "origin")
    if pose[2]:
        reason = f"Nav2's static layer and AMCL ignore the yaw of {pose[2]:g} rad: bake it into the cells, yaw 0"
        yield warning_finding(reason, main, where="origin")


def _picture(
    members: Mapping[str, Any], main: str, files: Files, mode: str, negate: bool, thresholds: tuple[float, float]
) -> Iterator[Problem]:
    image = members["image"]
    if not isinstance(image, str) or not image:
        yield error_finding(f"must be the name of a picture, is {shown(image)}", main, where="image")
        return
    if image.startswith("/"):
        reason = "an absolute path: each robot must have the picture there. A name beside the YAML goes along with it"
        yield warning_finding(reason, main, where="image")
        return
    name = posixpath.normpath(posixpath.join(posixpath.dirname(main), image))
    if name not in files:
        yield error_finding(
            f"the picture {shown(image)} is not there, seen from the YAML's folder", main, where="image"
        )
        return
    data = files[name]
    kind = images.detect_kind(data)
    if kind is None:
        yield warning_finding(
            "neither PGM, PNG, BMP nor JPEG: whether map_server reads it depends on its GraphicsMagick", name
        )
        return
    try:
        width, height = images.read_size(data, LIMITS)
    except BadUpload as error:
        yield error_finding(error.detail, name)
        return
    if max(width, height) > MAX_CELLS:
        yield error_finding(f"has {width} × {height} cells; Nav2 takes at most {MAX_CELLS} each way", name)
    if kind == "jpeg":
        yield warning_finding("a JPEG blurs the greys, so that cells beside a wall may change: use PGM or PNG", name)
    speed = "speed" in posixpath.basename(main).lower()
    if speed and mode == "trinary":
        reason = "a speed mask says shares of the speed, and trinary knows 0 and 100 only: use scale or raw"
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
    """What the greys that occur become; big pictures that would have to be decoded are left alone."""
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
        reason = "some cells are unknown: Nav2's speed filter tells an error wherever a robot drives on one"
        yield warning_finding(reason, name)
    if not speed and SAVED_UNKNOWN in pixels:
        reason = (
            f"with {thresholds[0]:g} the grey 205, map_saver's unknown, is read as free: write 0.196 where such cells "
            "mean unknown"
        )
        yield warning_finding(reason, main, where="free_thresh")
