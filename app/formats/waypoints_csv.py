"""waypoints_csv: waypoints as a table, one per row: ``name,x,y,yaw`` or ``name,latitude,longitude,yaw``.

The first row names the columns, in any order; ``yaw`` may be absent or empty. ``x`` and ``y`` are metres in the local
frame, ``latitude`` and ``longitude`` degrees WGS 84, ``yaw`` radians, counter-clockwise from the local x axis. UTF-8,
comma-separated, quoted where necessary (RFC 4180).

Each row is a node without edges; its id is its name. ``yaw`` is its orientation. Further columns are stored as texts
under ``properties.waypoints_csv`` and written again. A map has the coordinates of the upload, by default metres.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator, Sequence

import numpy as np
import shapely

from app.errors import MissingDatum, TooLarge
from app.formats import Files, Format, LayerRequirements, ReadContext, WriteContext, register
from app.formats._network import (
    check_name,
    duplicates,
    get_source_properties,
    identifier,
    merge_networks,
    quaternion,
    raise_unreadable,
    shorten_list,
    source_document,
    yaw_or_source,
)
from app.model.features import Properties, from_columns, unique_ids
from app.model.frame import MAX_METRES, Anchor
from app.model.layers import NETWORK, Layers, PartKey
from app.syntax import decimals

NAME = "waypoints_csv"
METRES, DEGREES = ("x", "y"), ("latitude", "longitude")
_DECIMAL = re.compile(r"\s*[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]{1,4})?\s*")
LIMITS = {"x": MAX_METRES, "y": MAX_METRES, "latitude": 90.0, "longitude": 180.0, "yaw": 1e6}


def read(files: Files, context: ReadContext) -> Layers:
    """Read the rows as nodes. Raises UnreadableFile naming the line and column."""
    if not context.wants("topology"):
        return Layers()
    data = files[context.main or next(iter(files))]
    if len(data) > context.limits.text_bytes:
        raise TooLarge(f"the table has {len(data)} bytes; the limit for text files is {context.limits.text_bytes}")
    rows = _rows(data.decode("utf-8-sig"))
    header = [title.strip() for title in next(rows, ("", []))[1]]
    axes = _axes(header)
    if axes is None or duplicates(header):
        raise_unreadable(
            "the first row must name each column once: name, and either x and y or latitude and longitude", "line 1"
        )
    names: list[str] = []
    places: list[tuple[float, ...]] = []
    properties: list[Properties] = []
    for location, row in rows:
        if len(row) != len(header):
            raise_unreadable(f"has {len(row)} values, but the first row names {len(header)} columns", location)
        cells = dict(zip(header, row, strict=True))
        names.append(check_name(cells.pop("name").strip(), f"{location}, name"))
        places.append(tuple(_number(cells.pop(axis), axis, location) for axis in axes))
        node: dict[str, object] = {"kind": "node", "name": names[-1]}
        source_members: dict[str, object] = {}
        if yaw := cells.pop("yaw", "").strip():
            source_members["yaw"] = angle = _number(yaw, "yaw", location)
            node["orientation"] = quaternion(angle)
        source_members |= {column: text for column, text in cells.items() if text}
        properties.append({**node, NAME: source_members})
    if repeats := duplicates(names):
        context.warn(f"{len(repeats)} duplicate names: {shorten_list(repeats)}; later ones got a number")
    xy = np.array(places, np.float64).reshape(-1, 2)
    points = np.asarray(shapely.points(xy if axes == METRES else xy[:, ::-1]), object).reshape(-1)
    anchor: Anchor = "local" if axes == METRES else "wgs84"
    document = {NAME: {"columns": header}}
    part = from_columns(unique_ids(map(identifier, names)), points, properties, anchor, document)
    return Layers({PartKey("topology", context.level, NETWORK): part})


def _rows(text: str) -> Iterator[tuple[str, list[str]]]:
    """Yield (line, cells) of each row that is not empty."""
    rows = csv.reader(io.StringIO(text, newline=""), strict=True)
    try:
        for row in rows:
            if row:
                yield f"line {rows.line_num}", row
    except csv.Error as error:
        raise_unreadable(f"not CSV: {error}", f"line {rows.line_num}")


def _axes(header: Sequence[str]) -> tuple[str, str] | None:
    """Return the names of the coordinate columns; None if this is no such table."""
    candidates = [axes for axes in (METRES, DEGREES) if set(axes) <= set(header)]
    return candidates[0] if "name" in header and len(candidates) == 1 else None


def _number(text: str, column: str, location: str) -> float:
    if not _DECIMAL.fullmatch(text):
        raise_unreadable(f"must be a number, got {text[:60]!r}", f"{location}, {column}")
    value = float(text)
    if not abs(value) <= LIMITS[column]:
        raise_unreadable(f"must be within ±{LIMITS[column]:g}, got {text[:60]}", f"{location}, {column}")
    return value


def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """Write ``waypoints.csv``: the nodes of all networks, sorted by id. Raises MissingDatum if degrees need a datum."""
    net = merge_networks(layers, context)
    columns = source_document(layers, NAME).get("columns")
    columns = columns if isinstance(columns, list) and _axes(list(map(str, columns))) else ["name", *METRES, "yaw"]
    axes = _axes(columns) or METRES
    context.drop("edges", len(net.edges), "a table of waypoints has no edges")
    context.drop("altitudes of nodes", sum(bool(n.z) for n in net.nodes), "waypoints are two-dimensional")
    if len(set(net.levels)) > 1:
        context.drop("levels of nodes", len(net.nodes), "all networks are joined into one table")
    places = np.array([(n.x, n.y) for n in net.nodes], np.float64).reshape(-1, 2)
    digits = decimals.METRES
    if axes == DEGREES:
        if layers.frame is None:
            raise MissingDatum("waypoints in degrees need a datum: set the environment's datum")
        places, digits = layers.frame.to_wgs84(places)[:, ::-1], decimals.DEGREES
    dropped_count = 0
    out = io.StringIO(newline="")
    table = csv.writer(out, lineterminator="\n")
    table.writerow(columns)
    for node, position in sorted(zip(net.nodes, places.tolist(), strict=True), key=lambda one: one[0].id):
        p, source_members = node.properties, get_source_properties(node.properties, NAME)
        angle = yaw_or_source(source_members.get("yaw"), p.get("orientation"))
        cells = {key: str(value) for key, value in source_members.items()}
        cells |= dict(zip(axes, decimals.numbers(position, digits), strict=True))
        cells |= {"name": str(p.get("name") or node.id), "yaw": "" if angle is None else decimals.number(angle, 12)}
        table.writerow([cells.get(str(column), "") for column in columns])
        dropped_count += bool(p.keys() - {"kind", "name", "orientation", NAME})
        context.drop("orientations of nodes", angle is not None and "yaw" not in columns, "the table has no column yaw")
    context.drop("attributes of nodes", dropped_count, "the table has no columns for them")
    return {"waypoints.csv": out.getvalue().encode()}


def detect(name: str, data: bytes) -> bool:
    """Detect a first row with such columns."""
    if not name.lower().endswith(".csv"):
        return False
    first = re.split("[\r\n]", data[:4096].decode("utf-8-sig", "replace"), maxsplit=1)[0]
    return _axes([title.strip() for title in next(csv.reader([first]), [])]) is not None


register(
    Format(
        name=NAME,
        title="Waypoints (CSV)",
        files={"waypoints.csv": "text/csv"},
        layers=frozenset({"topology"}),
        detect=detect,
        read=read,
        write=write,
        needs=LayerRequirements(one_of=(frozenset({"topology"}),)),
        extensions=(".csv",),
    )
)
