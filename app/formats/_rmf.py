"""What the two formats of Open-RMF share: typed parameters, rows of YAML in flow style, lanes as pairs of edges.

Source: open-rmf/rmf_traffic_editor, rmf_building_map_tools (building_map/param_value.py, edge.py, level.py).
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from typing import Any, NoReturn

import numpy as np
import orjson
import shapely
from numpy.typing import NDArray

from app.errors import Problem, UnreadableFile
from app.formats import _yaml
from app.model.features import Properties
from app.model.frame import MAX_METRES

BUILDING, NAV_GRAPH = "openrmf", "rmf_nav_graph"
"""The families: under these names stands what only a building or a navigation graph knows of an item."""

CABIN_HEIGHT = 2.5
"""Metres; the height that rmf_building_map_tools gives every lift cabin."""

MAX_GRAPHS = 9
"""building_map_generator writes graphs 0 … 8 and leaves out lanes of any other."""

LONGEST = 240
"""Characters of a node's id, so that an edge's id, made of two of them, is one, too."""

Array = NDArray[np.float64]


def refuse(reason: str, where: str) -> NoReturn:
    """Raise UnreadableFile that names the place."""
    raise UnreadableFile(f"{where}: {reason}" if where else reason, [Problem(reason, where=where or None)])


def mapping(value: Any, where: str) -> dict[str, Any]:
    """A mapping; nothing at all is an empty one."""
    if value is None:
        return {}
    if not isinstance(value, dict):
        refuse("must be a mapping", where)
    return value


def listing(value: Any, where: str) -> list[Any]:
    """A list; nothing at all (or ``{}``, as the editor writes it) is an empty one."""
    if value is None or value == {}:
        return []
    if not isinstance(value, list):
        refuse("must be a list", where)
    return value


def number(value: Any, where: str) -> float:
    """A number of usual size, also one in quotes."""
    if isinstance(value, str):
        try:
            value = _yaml.scalar(value)
        except ValueError:
            value = None
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        refuse("must be a number", where)
    if abs(value) > MAX_METRES:
        refuse(f"is beyond ±{MAX_METRES:g}", where)
    return float(value)


def places(rows: Sequence[Any], where: str) -> Array:
    """float64 [n, 2]: the first two numbers of each row."""
    try:
        flat = [v for row in rows for v in (row[0], row[1])]
    except (TypeError, LookupError):
        k = next(k for k, row in enumerate(rows) if not isinstance(row, list) or len(row) < 2)
        refuse("must be a list that begins with x and y", f"{where}[{k}]")
    if not all(map((float, int).__contains__, map(type, flat))):
        flat = [number(v, f"{where}[{k // 2}][{k % 2}]") for k, v in enumerate(flat)]
    return np.array(flat, np.float64).reshape(-1, 2)


def index(value: Any, where: str) -> int:
    """A vertex' place in its level's list."""
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    if isinstance(value, bool) or not isinstance(value, int):
        refuse("must be the number of a vertex", where)
    return value


def value_of(parameters: Any, key: str, default: Any = None) -> Any:
    """The value of a parameter ``[type, value]``."""
    said = parameters.get(key) if isinstance(parameters, Mapping) else None
    return said[1] if isinstance(said, list) and len(said) == 2 else default


def typed(value: Any) -> Any:
    """A value as a typed parameter: 1 text, 2 integer, 3 decimal, 4 truth value; nested ones stay as they are."""
    kinds: dict[type, int] = {str: 1, int: 2, float: 3, bool: 4}
    kind = kinds.get(type(value))
    return value if kind is None else [kind, value]


def short(text: str, most: int = LONGEST) -> str:
    """The text, or where it is too long for an id its beginning and a hash of all of it."""
    if len(text) <= most:
        return text
    return f"{text[: most - 18]}~{hashlib.blake2b(text.encode(), digest_size=8).hexdigest()}"


def limit(p: Properties) -> float:
    """An edge's speed limit in metres per second; 0 where there is none."""
    said = p.get("speed_limit")
    good = isinstance(said, (int, float)) and not isinstance(said, bool) and math.isfinite(said) and said > 0
    return float(said) if good and said is not None else 0.0


def turned(orientation: Any) -> Any:
    """The orientation of a lane that is driven the other way round."""
    return {"forward": "backward", "backward": "forward"}.get(orientation, orientation)


def pose_of(p: Properties) -> list[float] | None:
    """An object's pose [x, y, z, roll, pitch, yaw], or None."""
    said = p.get("pose")
    if not isinstance(said, (list, tuple)) or len(said) != 6:
        return None
    if not all(isinstance(v, (int, float)) and not isinstance(v, bool) and math.isfinite(v) for v in said):
        return None
    return list(map(float, said))


def size_of(p: Properties) -> tuple[float, float] | None:
    """An object's width (along x) and depth (along y), metres, or None."""
    said = p.get("size")
    if not isinstance(said, (list, tuple)) or len(said) < 2:
        return None
    if not all(isinstance(v, (int, float)) and not isinstance(v, bool) and math.isfinite(v) for v in said):
        return None
    return float(said[0]), float(said[1])


def ends(geometry: Any) -> Array:
    """float64 [2, 2]: first and last point of a line."""
    at: Array = shapely.get_coordinates(geometry)
    return at[[0, -1]]


class Flow:
    """Writes values in flow style, on one line. Equal mappings are written once."""

    def __init__(self) -> None:
        self._known: dict[bytes, str] = {}

    def __call__(self, value: Any) -> str:
        """The value as YAML that PyYAML and yaml-cpp read alike; mappings by sorted keys."""
        if isinstance(value, dict):
            if not value:
                return "{}"
            key = orjson.dumps(value)
            said = self._known.get(key)
            if said is None:
                said = "{" + ", ".join(f"{_yaml.text(k)}: {self(value[k])}" for k in sorted(value)) + "}"
                self._known[key] = said
            return said
        if isinstance(value, (list, tuple)):
            return "[" + ", ".join(map(self, value)) + "]"
        return _yaml.text(value)
