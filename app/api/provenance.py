"""Provenance graph of a version: files, the layers made of them, and the maps made of those."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any
from xml.sax.saxutils import escape

from fastapi import Request
from pydantic import BaseModel
from starlette.responses import Response

from app.api.http.auth import Viewer
from app.api.http.dependencies import ServicesDep
from app.api.http.parameters import parse_version_ref
from app.api.http.responses import api_router, json_response
from app.api.http.schemas import EnvironmentPath, VersionName, VersionPath, problem_responses
from app.convert.maps import Maps
from app.store.values import Version


class ProvenanceOut(BaseModel):
    """Provenance graph: files, layers and maps. `links` connect them by id."""

    environment: str
    version: VersionName
    sources: list[dict[str, Any]]
    parts: list[dict[str, Any]]
    maps: list[dict[str, Any]]
    links: list[dict[str, str]]


router = api_router("versions", "/environments/{env}/versions/{v}")

ROW, WIDTH, GAP, TOP = 34, 250, 130, 60
COLOURS = {
    "raw": "#dceefb",
    "derived": "#fdf1d3",
    "generated": "#efe3fb",
    "template": "#eeeeee",
    "missing": "#f6f6f6",
    "stale": "#fbd9d5",
}


def graph(maps: Maps, version: Version) -> dict[str, Any]:
    """Build ``{sources, parts, maps, links}``, the nodes and links of the graph.

    They have file names, parts with their provenance, formats with their coverage, and links between ids (``from``,
    ``to``).
    """
    stale = version.stale
    links: list[dict[str, str]] = []
    parts = []
    for entry in version.parts:
        if not entry.count:
            continue
        key, told_by = entry.key, entry.provenance
        name = f"part:{key.layer}/{key.level}/{key.name}"
        parts.append(
            {
                "id": name,
                "layer": key.layer,
                "level": key.level,
                "name": key.name,
                "information": told_by.information,
                "steps": [str(step.get("step", "")) for step in told_by.steps],
                "stale": list(stale.get(key, ())),
            }
        )
        inputs = [line for line in told_by.inputs if "layer" in line]
        links += [{"from": f"part:{line['layer']}/{line['level']}/{line['name']}", "to": name} for line in inputs]
        if not inputs:
            links += [{"from": f"source:{source}", "to": name} for source in told_by.sources]
    part_ids = {part["id"] for part in parts}
    map_lines = []
    for line in maps.coverage(version):
        name = f"map:{line['format']}"
        map_lines.append({"id": name, "format": line["format"], "state": line["state"], "chain": line["chain"]})
        if line["state"] == "missing":
            continue
        used = maps.source_parts(version, line["format"])
        links += [
            {"from": f"part:{k.layer}/{k.level}/{k.name}", "to": name}
            for k in used
            if f"part:{k.layer}/{k.level}/{k.name}" in part_ids
        ]
    named = {link["from"] for link in links if link["from"].startswith("source:")}
    sources = [{"id": f"source:{s.name}", "name": s.name, "used": s.used} for s in version.sources]
    have = {s["id"] for s in sources}
    sources += [{"id": name, "name": name.partition(":")[2], "used": True} for name in sorted(named - have)]
    return {"sources": sources, "parts": parts, "maps": map_lines, "links": links}


@dataclass(slots=True)
class _Box:
    x: float
    y: float
    text: str
    note: str
    colour: str
    title: str = ""
    lines: list[str] = field(default_factory=list)


def svg(graph: dict[str, Any], title: str) -> bytes:
    """Draw the graph as SVG: files on the left, layers in the middle, maps on the right; stale items in red."""
    boxes: dict[str, _Box] = {}
    columns = _columns(graph)
    for column, rows in enumerate(columns):
        for row, (name, text, note, colour, full) in enumerate(rows):
            x, y = 20 + column * (WIDTH + GAP), TOP + row * ROW
            boxes[name] = _Box(x, y, text, note, COLOURS[colour], full)
    height = TOP + ROW * max((len(rows) for rows in columns), default=1) + 20
    width = 20 + 3 * WIDTH + 2 * GAP + 20
    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
        'font-family="sans-serif" font-size="12">',
        f"<title>{escape(title)}</title>",
        f'<rect width="{width}" height="{height}" fill="white"/>',
    ]
    for column, heading in enumerate(("files", "layers", "maps")):
        out.append(f'<text x="{20 + column * (WIDTH + GAP)}" y="35" font-size="15">{heading}</text>')
    for link in graph["links"]:
        a, b = boxes.get(link["from"]), boxes.get(link["to"])
        if a is not None and b is not None:
            out.append(_curve(a, b))
    for box in boxes.values():
        out += _box_lines(box)
    out.append("</svg>")
    return "\n".join(out).encode()


def _columns(graph: dict[str, Any]) -> list[list[tuple[str, str, str, str, str]]]:
    """List files, layers and maps, each with id, text, note, colour and full text."""
    return [
        [
            (s["id"], s["name"].rpartition("/")[2], "" if s["used"] else "stored, not used", "raw", s["name"])
            for s in graph["sources"]
        ],
        [
            (
                p["id"],
                f"{p['layer']}: {p['name']}" + ("" if p["level"] == "ground" else f" ({p['level']})"),
                "stale: " + ", ".join(p["stale"]) if p["stale"] else ", ".join(filter(None, p["steps"])),
                "stale" if p["stale"] else p["information"],
                p["information"],
            )
            for p in graph["parts"]
        ],
        [
            (m["id"], m["format"], ", ".join(step["step"] for step in m["chain"]), _state(m["state"]), m["state"])
            for m in graph["maps"]
        ],
    ]


def _curve(a: _Box, b: _Box) -> str:
    """Draw a curve from the right of a box to the left of the next column, or around to the right within a column."""
    same = a.x == b.x
    x1, y1, y2 = a.x + WIDTH, a.y + 13, b.y + 13
    x2 = b.x + WIDTH if same else b.x
    bend = 60 if same else GAP / 2
    x3 = x2 + bend if same else x2 - bend
    red = b.colour == COLOURS["stale"]
    stroke = "#c0392b" if red else "#9aa5b1"
    return (
        f'<path d="M{x1} {y1} C{x1 + bend} {y1} {x3} {y2} {x2} {y2}" fill="none" stroke="{stroke}" '
        f'stroke-width="1"{" stroke-dasharray=" + chr(34) + "4 3" + chr(34) if red else ""}/>'
    )


def _box_lines(box: _Box) -> list[str]:
    out = [
        f'<g><title>{escape(box.title)}</title><rect x="{box.x}" y="{box.y}" width="{WIDTH}" height="27" rx="4" '
        f'fill="{box.colour}" stroke="#7b8794"/><text x="{box.x + 8}" y="{box.y + (12 if box.note else 18)}">'
        f"{escape(_short(box.text, 38))}</text>"
    ]
    if box.note:
        note = escape(_short(box.note, 46))
        out.append(f'<text x="{box.x + 8}" y="{box.y + 23}" font-size="9" fill="#52606d">{note}</text>')
    return [*out, "</g>"]


def _state(state: str) -> str:
    return {"direct": "raw", "derivable": "derived"}.get(state, "missing")


def _short(text: str, limit: int) -> str:
    return text if len(text) <= limit else text[: limit - 1] + "…"


@router.get(
    "/provenance",
    responses={
        **problem_responses(ProvenanceOut, 404),
        200: {"model": ProvenanceOut, "content": {"image/svg+xml": {}}},
    },
    summary="Get the provenance graph",
)
def provenance(env: EnvironmentPath, v: VersionPath, request: Request, services: ServicesDep, _: Viewer) -> Response:
    """Return the provenance graph as an SVG image, or as JSON with `Accept: application/json`.

    Stale items are marked.
    """
    version = services.store.versions.get(env, parse_version_ref(v))
    lineage = graph(services.maps, version)
    if "application/json" in request.headers.get("accept", ""):
        return json_response({"environment": env, "version": version.ref, **lineage})
    picture = svg(lineage, f"{env}, version {version.ref}")
    return Response(picture, media_type="image/svg+xml", headers={"content-security-policy": "default-src 'none'"})
