"""QGIS layer definition file: all collections of a version with their styles, opened with one file.

Features come by OGC API - Features, grids and images by WMTS, which QGIS reads since 3.22. The file has absolute
addresses and no token: QGIS asks for it.
"""

from __future__ import annotations

from collections.abc import Mapping
from urllib.parse import quote, urlencode

from lxml import etree
from starlette.responses import Response

from app.convert.drawing import Colour
from app.convert.painting import THEMES
from app.derive.zones_to_occupancy import KEEPOUTS, LANES, SPEEDS
from app.errors import NotFound
from app.model.areas import AREA_KINDS, AREA_OPACITY
from app.ogc import wmts
from app.ogc.collections import notice
from app.ogc.extensions import Collection, Extension, all_collections
from app.ogc.routing import both, ogc_router
from app.ogc.service import Link, Service, link
from app.ogc.tiles import PNG
from app.ogc.vector import TITLES
from app.syntax.geotiff import crs_to_wkt

QLR = "application/x-qgis-layer-definition"
THEME = THEMES["light"]
ARROW_SCALE = 300
"""Scale denominator up to which arrows are drawn: beyond it they would hide the network."""

OVER_IMAGE = "0.35"
"""Opacity of a grid above an image."""

GEOMETRY = {
    "nodes": "Point",
    "edges": "Line",
    "objects-points": "Point",
    "objects-lines": "Line",
    "objects-polygons": "Polygon",
    "zones": "Polygon",
    "fence": "Polygon",
}
"""QGIS' type of geometry of each collection with a style, from the top of the legend down."""

router = ogc_router()


def _rgba(colour: Colour, opacity: int = 255) -> str:
    return ",".join(map(str, (*colour, opacity)))


def _symbol(parent: etree._Element, name: str, kind: str, *layers: tuple[str, Mapping[str, str]]) -> etree._Element:
    """Add a symbol of simple layers: class and properties of each. Returns its last layer."""
    symbol = etree.SubElement(parent, "symbol", type=kind, name=name, alpha="1", force_rhr="0", clip_to_extent="1")
    layer = symbol
    for class_name, values in layers:
        layer = etree.SubElement(symbol, "layer", {"class": class_name, "enabled": "1", "locked": "0", "pass": "0"})
        options = etree.SubElement(layer, "Option", type="Map")
        for key, value in values.items():
            etree.SubElement(options, "Option", type="QString", name=key, value=value)
    return layer


def _renderer(layer: etree._Element, kind: str, **attributes: str) -> etree._Element:
    return etree.SubElement(
        layer, "renderer-v2", {"type": kind, "symbollevels": "0", "enableorderby": "0", **attributes}
    )


def _line(colour: Colour, width: str, style: str = "solid") -> tuple[str, Mapping[str, str]]:
    values = {"line_color": _rgba(colour), "line_width": width, "line_width_unit": "MM", "line_style": style,
              "capstyle": "round", "joinstyle": "round"}  # fmt: skip
    return "SimpleLine", values


def _fill(colour: Colour, opacity: int, style: str = "solid", width: str = "0.3") -> tuple[str, Mapping[str, str]]:
    values = {"color": _rgba(colour, opacity), "style": "solid" if opacity else "no", "outline_color": _rgba(colour),
              "outline_width": width, "outline_width_unit": "MM", "outline_style": style}  # fmt: skip
    return "SimpleFill", values


def _marker(shape: str, colour: Colour, size: str, offset: str = "0,0") -> tuple[str, Mapping[str, str]]:
    values = {"name": shape, "color": _rgba(colour), "size": size, "size_unit": "MM", "offset": offset,
              "offset_unit": "MM", "outline_color": _rgba(THEME.halo), "outline_width": "0.2",
              "outline_width_unit": "MM", "outline_style": "solid"}  # fmt: skip
    return "SimpleMarker", values


def _style(layer: etree._Element, name: str) -> None:
    """Add the renderer of a collection."""
    if name == "edges":
        _style_edges(layer)
    elif name == "zones":
        _style_zones(layer)
    else:
        kind, part = {
            "nodes": ("marker", _marker("circle", THEME.node, "1.8")),
            "objects-points": ("marker", _marker("circle", THEME.objects, "1.2")),
            "objects-lines": ("line", _line(THEME.objects, "0.35")),
            "objects-polygons": ("fill", _fill(THEME.objects, 70)),
            "fence": ("fill", _fill(THEME.fence, 0, "dash", "0.4")),
        }[name]
        _symbol(etree.SubElement(_renderer(layer, "singleSymbol"), "symbols"), "0", kind, part)


def _style_edges(layer: etree._Element) -> None:
    """Draw lines, and near by an arrowhead after the middle of each edge: a two-way street has two, back to back."""
    renderer = _renderer(layer, "RuleRenderer")
    rules = etree.SubElement(renderer, "rules", key="edges")
    etree.SubElement(rules, "rule", key="line", symbol="0", label="edge")
    etree.SubElement(rules, "rule", key="arrow", symbol="1", label="direction", scalemindenom="1",
                     scalemaxdenom=str(ARROW_SCALE))  # fmt: skip
    symbols = etree.SubElement(renderer, "symbols")
    _symbol(symbols, "0", "line", _line(THEME.edge, "0.5"))
    places = {"placement": "centralpoint", "placements": "CentralPoint", "rotate": "1", "ring_filter": "0"}
    arrows = _symbol(symbols, "1", "line", ("MarkerLine", places))
    kind, values = _marker("filled_arrowhead", THEME.node, "2.6", "1.9,0")
    _symbol(arrows, "@1@0", "marker", (kind, {**values, "outline_style": "no"}))


def _style_zones(layer: etree._Element) -> None:
    renderer = _renderer(layer, "categorizedSymbol", attr="kind")
    categories, symbols = etree.SubElement(renderer, "categories"), etree.SubElement(renderer, "symbols")
    quiet = round(255 * AREA_OPACITY)
    groups = ((sorted(KEEPOUTS), THEME.keepout, 60), (sorted(SPEEDS), THEME.speed, 60),
              (sorted(LANES), THEME.lane, 60), (AREA_KINDS, THEME.area, quiet), ([""], THEME.zone, 60))  # fmt: skip
    rows = [(kind, colour, opacity) for kinds, colour, opacity in groups for kind in kinds]
    for number, (kind, colour, opacity) in enumerate(rows):
        etree.SubElement(categories, "category", value=kind, label=kind or "other", symbol=str(number), render="true")
        _symbol(symbols, str(number), "fill", _fill(colour, opacity))


def _maplayer(layers: etree._Element, layer_id: str, title: str, provider: str, source: str) -> etree._Element:
    layer = etree.SubElement(layers, "maplayer", type="raster" if provider == "wms" else "vector")
    etree.SubElement(layer, "id").text = layer_id
    etree.SubElement(layer, "datasource").text = source
    etree.SubElement(layer, "layername").text = title
    code = "EPSG:3857" if provider == "wms" else "EPSG:4326"
    system = etree.SubElement(etree.SubElement(layer, "srs"), "spatialrefsys", nativeFormat="Wkt")
    etree.SubElement(system, "wkt").text = crs_to_wkt(code)  # with the code alone QGIS 3.22 has no CRS
    etree.SubElement(system, "authid").text = code
    etree.SubElement(layer, "provider").text = provider
    return layer


def _feature_source(service: Service, name: str) -> str:
    """Return QGIS' address of a collection; restricted to the shown box, so that large sites open at once."""
    values = {"pagingEnabled": "true", "restrictToRequestBBOX": "1", "srsname": "OGC:CRS84", "typename": name,
              "url": service.landing_url}  # fmt: skip
    return " ".join(f"{key}='{value}'" for key, value in values.items())


def _raster_source(service: Service, name: str) -> str:
    values = {"crs": "EPSG:3857", "format": PNG, "layers": name, "styles": "default",
              "tileMatrixSet": wmts.SET.id, "url": wmts.url(service)}  # fmt: skip
    # QGIS 3.40 takes these characters as they are and does not decode them, and no version takes + for a space.
    return urlencode(values, safe=":/@", quote_via=quote)


def definition_file(service: Service, collections: list[Collection]) -> bytes:
    """Write the file. collections: with content."""
    root = etree.Element("qlr")
    group = etree.SubElement(root, "layer-tree-group", name=service.title, checked="Qt::Checked", expanded="1")
    layers = etree.SubElement(root, "maplayers")
    by_id = {one.id: one for one in collections}
    names = [name for name in GEOMETRY if name in by_id]
    rasters = [name for name in by_id if name not in TITLES]
    # Several grids would hide each other: only the first one is shown at the start, and so with images.
    first = {next((name for name in rasters if name.startswith(word)), "") for word in ("grid-", "image-")}
    names += sorted(rasters, key=lambda name: (not name.startswith("grid-"), name.startswith("image-"), name))
    for name in names:
        provider = "OAPIF" if name in GEOMETRY else "wms"
        source = _feature_source(service, name) if name in GEOMETRY else _raster_source(service, name)
        layer_id, title = f"{service.environment.name}_{name}", by_id[name].title
        shown = name not in rasters or name in first
        etree.SubElement(group, "layer-tree-layer", id=layer_id, name=title, providerKey=provider, source=source,
                         checked="Qt::Checked" if shown else "Qt::Unchecked", expanded="0")  # fmt: skip
        layer = _maplayer(layers, layer_id, title, provider, source)
        if name in GEOMETRY:
            layer.set("geometry", GEOMETRY[name])
            _style(layer, name)
        else:
            pipe = etree.SubElement(layer, "pipe")
            over = name.startswith("grid-") and any(other.startswith("image-") for other in rasters)
            opacity = OVER_IMAGE if over else "1"
            etree.SubElement(pipe, "rasterrenderer", type="singlebandcolordata", band="1", opacity=opacity)
    return bytes(etree.tostring(root, encoding="utf-8", xml_declaration=True, pretty_print=True,
                                doctype="<!DOCTYPE qgis-layer-definition>"))  # fmt: skip


@both(router, "/layers.qlr", {QLR: {}}, summary="Get a QGIS layer definition")
async def get_layer_definition(service: Service) -> Response:
    """Return a file that opens all collections in QGIS, with styles: drag it onto the map.

    Its addresses are those of the version asked for. QGIS asks for user and password: any name, and a token.
    """
    reason = notice(service)
    if reason is not None:
        raise NotFound(f"no layers: {reason}")
    data = definition_file(service, await all_collections(service))
    headers = {"content-disposition": f'attachment; filename="{service.environment.name}.qlr"'}
    return service.respond(data, QLR, headers)


def _landing_links(service: Service) -> list[Link]:
    if service.version.datum is None:
        return []
    return [
        link(service.url("layers.qlr"), "http://www.opengis.net/def/rel/ogc/1.0/styles", QLR, "All layers for QGIS")
    ]


extension = Extension(landing_links=_landing_links)
