"""HTML pages of features: tables of pages, single features, schemas, and a map drawn as SVG."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
import orjson
import shapely
from numpy.typing import NDArray

from app.ogc.pages import add, anchor, linked, page, representations, respond_page, table
from app.ogc.service import Link, Service
from app.ogc.tables import Table
from app.ogc.vector import title_of

__all__ = ["item_page", "items_page", "respond_page", "schema_page"]

MAX_COLUMNS = 12
MAX_ROWS = 200
"""Maximum number of columns and rows of a page's table; a page of features may have more."""

MAX_CELL = 120
MAX_DRAWN_POINTS = 20_000
WIDTH = 640.0
MIN_SPAN_DEGREES = 1e-5


def _trail(service: Service, collection: str | None = None) -> list[tuple[str, str]]:
    out = [(service.title, service.landing_url), ("Collections", service.url("collections", f="html"))]
    if collection is not None:
        out.append((title_of(service, collection), service.url("collections", collection, f="html")))
    return out


def _text(value: object, length: int = MAX_CELL) -> str:
    text = value if isinstance(value, str) else "" if value is None else orjson.dumps(value).decode()
    return text if len(text) <= length else text[: length - 1] + "…"


def _cell(value: object, length: int = MAX_CELL) -> Element | str:
    text = _text(value, length)
    return linked(text) if text == value else text


def items_page(
    service: Service, collection: str, source: Table, rows: NDArray[np.intp], matched: int, links: Sequence[Link]
) -> Element:
    """Build the page of a page of features."""
    root, body = page(f"{title_of(service, collection)}: features", _trail(service, collection))
    add(body, "p", f"{len(rows)} of {matched} features on this page.")
    draw_map(body, source.in_wgs84(rows))
    shown = rows[:MAX_ROWS].tolist()
    loaded = [source.properties(row) for row in shown]
    names = list(dict.fromkeys(name for one in loaded for name in one))[:MAX_COLUMNS]
    lines = [
        (
            anchor(source.ids[row], service.url("collections", collection, "items", source.ids[row], f="html")),
            *(_cell(one.get(name)) for name in names),
        )
        for row, one in zip(shown, loaded, strict=True)
    ]
    table(body, ("id", *names), lines)
    if len(rows) > len(shown):
        add(body, "p", f"The table has the first {MAX_ROWS} features of this page: add limit={MAX_ROWS} to page by it.")
    for one in links:
        if one["rel"] == "next":
            add(add(body, "p"), "a", "next page", href=one["href"], rel="next")
    representations(body, links)
    return root


def item_page(service: Service, collection: str, source: Table, row: int, links: Sequence[Link]) -> Element:
    """Build the page of a feature."""
    root, body = page(source.ids[row], _trail(service, collection))
    draw_map(body, source.in_wgs84(np.array([row])))
    table(body, ("property", "value"), [(name, _cell(value, 20_000)) for name, value in source.properties(row).items()])
    representations(body, links)
    return root


def schema_page(
    service: Service, collection: str, schema: Mapping[str, Any], name: str, links: Sequence[Link]
) -> Element:
    """Build the page of a schema."""
    root, body = page(f"{title_of(service, collection)}: {name}", _trail(service, collection))
    rows = [(key, _text(one.get("type") or one.get("format"))) for key, one in schema["properties"].items()]
    table(body, ("property", "type"), rows)
    representations(body, links)
    return root


# --- map ---


def draw_map(parent: Element, geometry: NDArray[np.object_]) -> None:
    """Draw geometries in degrees as SVG, north up; nothing without coordinates. Large ones are simplified."""
    geometry = shapely.force_2d(geometry[~shapely.is_empty(geometry)])
    if not len(geometry):
        return
    turned = (
        shapely.transform(geometry, lambda xy: np.column_stack([xy[:, 0] % 360.0, xy[:, 1]]))
        if _width(geometry) > 180.0
        else geometry
    )
    geometry = turned if _width(turned) < _width(geometry) else geometry  # on both sides of the antimeridian
    bounds = shapely.bounds(geometry)
    west, south = bounds[:, :2].min(axis=0).tolist()
    east, north = bounds[:, 2:].max(axis=0).tolist()
    squeeze = max(0.01, math.cos(math.radians((south + north) / 2)))
    span = max((east - west) * squeeze, north - south, MIN_SPAN_DEGREES)
    scale = WIDTH / span
    flat = shapely.transform(
        geometry, lambda xy: np.column_stack([(xy[:, 0] - west) * squeeze, north - xy[:, 1]]) * scale
    )
    if shapely.get_num_coordinates(flat).sum() > MAX_DRAWN_POINTS:
        flat = shapely.simplify(flat, 1.0, preserve_topology=False)
    width, height = max((east - west) * squeeze * scale, 20.0), max((north - south) * scale, 20.0)
    box = f"-10 -10 {width + 20:.0f} {height + 20:.0f}"
    svg = add(parent, "svg", viewBox=box, role="img", preserveAspectRatio="xMidYMid meet")
    svg.set("aria-label", f"Map of {len(geometry)} features, north up")
    paths: dict[str, list[str]] = {"area": [], "line": [], "point": []}
    budget = MAX_DRAWN_POINTS
    for piece in shapely.get_parts(shapely.get_parts(flat)):
        budget -= int(shapely.get_num_coordinates(piece))
        if budget < 0:
            break
        if piece.geom_type == "Polygon" and not piece.is_empty:
            paths["area"] += [_path(ring.coords) + "Z" for ring in (piece.exterior, *piece.interiors)]
        elif piece.geom_type in ("LineString", "LinearRing") and not piece.is_empty:
            paths["line"].append(_path(piece.coords))
        elif piece.geom_type == "Point" and not piece.is_empty:
            paths["point"].append(_path(piece.coords) + "h0")
    for kind, drawn in paths.items():
        if drawn:
            add(svg, "path", d="".join(drawn), class_=kind)


def _width(geometry: NDArray[np.object_]) -> float:
    west, _, east, _ = shapely.total_bounds(geometry)
    return float(east - west)


def _path(coordinates: Any) -> str:
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in coordinates)
