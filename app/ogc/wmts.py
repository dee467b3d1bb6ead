"""Static WMTS 1.0.0 document, for programs that know no OGC API - Tiles: QGIS, ArcGIS, GDAL.

Its layers are the map tiles in Web Mercator: one of the site, and one of each collection. Source: OGC 07-057r7.
"""

from __future__ import annotations

from lxml import etree
from starlette.responses import Response

from app.errors import NotFound
from app.model.geodesy import local_frame
from app.ogc.collections import notice
from app.ogc.extensions import Extension, all_collections
from app.ogc.extent import site_box
from app.ogc.routing import both, ogc_router
from app.ogc.service import Link, Service, link
from app.ogc.tile_matrix_sets import SETS, definition
from app.ogc.tiles import PNG, tile_template
from app.store.values import Box

XML = "application/xml"
WMTS = "http://www.opengis.net/wmts/1.0"
OWS = "http://www.opengis.net/ows/1.1"
XLINK = "http://www.w3.org/1999/xlink"
SET = SETS["WebMercatorQuad"]
SITE = "site"
"""Identifier of the layer of the whole site."""

router = ogc_router()


def _add(parent: etree._Element, name: str, text: str | None = None, **attributes: str) -> etree._Element:
    """Add an element; the prefix ``ows:`` selects that namespace."""
    prefix, _, local = name.rpartition(":")
    child = etree.SubElement(parent, f"{{{OWS if prefix else WMTS}}}{local}", attributes)
    child.text = text
    return child


def _layer(contents: etree._Element, service: Service, name: str, title: str, text: str, box: Box | None) -> None:
    layer = _add(contents, "Layer")
    _add(layer, "ows:Title", title)
    _add(layer, "ows:Abstract", text)
    if box is not None and box[0] <= box[2]:
        bounds = _add(layer, "ows:WGS84BoundingBox")
        _add(bounds, "ows:LowerCorner", f"{box[0]!r} {box[1]!r}")
        _add(bounds, "ows:UpperCorner", f"{box[2]!r} {box[3]!r}")
    _add(layer, "ows:Identifier", name)
    style = _add(layer, "Style", isDefault="true")
    _add(style, "ows:Identifier", "default")
    _add(layer, "Format", PNG)
    of_set = _add(layer, "TileMatrixSetLink")
    _add(of_set, "TileMatrixSet", SET.id)
    if box is not None:
        _limits(_add(of_set, "TileMatrixSetLimits"), service, box)
    template = tile_template(service, "map", None if name == SITE else name, SET.id)
    for ours, theirs in (("{tileMatrix}", "{TileMatrix}"), ("{tileRow}", "{TileRow}"), ("{tileCol}", "{TileCol}")):
        template = template.replace(ours, theirs)
    _add(layer, "ResourceURL", format=PNG, resourceType="tile", template=template)


def _limits(parent: etree._Element, service: Service, box: Box) -> None:
    assert service.version.datum is not None
    names = ("MinTileRow", "MaxTileRow", "MinTileCol", "MaxTileCol")
    for z, row in enumerate(SET.limits(box, local_frame(service.version.datum))):
        limits = _add(parent, "TileMatrixLimits")
        _add(limits, "TileMatrix", str(z))
        for name, value in zip(names, row, strict=True):
            _add(limits, name, str(value))


def _tile_matrix_set(contents: etree._Element, service: Service) -> None:
    one = _add(contents, "TileMatrixSet")
    _add(one, "ows:Identifier", SET.id)
    _add(one, "ows:SupportedCRS", "urn:ogc:def:crs:EPSG::3857")
    document = definition(service, SET)
    _add(one, "WellKnownScaleSet", "urn:ogc:def:wkss:OGC:1.0:GoogleMapsCompatible")
    for matrix in document["tileMatrices"]:
        level = _add(one, "TileMatrix")
        _add(level, "ows:Identifier", matrix["id"])
        _add(level, "ScaleDenominator", repr(matrix["scaleDenominator"]))
        _add(level, "TopLeftCorner", " ".join(repr(value) for value in matrix["pointOfOrigin"]))
        for name in ("TileWidth", "TileHeight", "MatrixWidth", "MatrixHeight"):
            _add(level, name, str(matrix[name[0].lower() + name[1:]]))


async def capabilities(service: Service) -> bytes:
    """Write the document. Raises NotFound for a version without a datum."""
    reason = notice(service)
    if reason is not None:
        raise NotFound(f"no map tiles: {reason}")
    root = etree.Element(
        f"{{{WMTS}}}Capabilities", {"version": "1.0.0"}, nsmap={None: WMTS, "ows": OWS, "xlink": XLINK}
    )
    about = _add(root, "ows:ServiceIdentification")
    _add(about, "ows:Title", service.title)
    _add(about, "ows:Abstract", service.description)
    _add(about, "ows:ServiceType", "OGC WMTS")
    _add(about, "ows:ServiceTypeVersion", "1.0.0")
    contents = _add(root, "Contents")
    _layer(contents, service, SITE, service.title, "Everything on the default level.", await site_box(service))
    for entry in await all_collections(service):
        _layer(contents, service, entry.id, entry.title, entry.description, entry.bbox)
    _tile_matrix_set(contents, service)
    _add(root, "ServiceMetadataURL", **{f"{{{XLINK}}}href": url(service)})
    return bytes(etree.tostring(root, encoding="utf-8", xml_declaration=True, pretty_print=True))


def url(service: Service) -> str:
    """Return the absolute URL of the document."""
    return service.url("wmts", "1.0.0", "WMTSCapabilities.xml")


@both(router, "/wmts/1.0.0/WMTSCapabilities.xml", {XML: {}}, summary="Get the WMTS capabilities")
async def get_capabilities(service: Service) -> Response:
    """Return the capabilities of a WMTS 1.0.0 whose tiles are the map tiles in Web Mercator, by REST only."""
    return service.respond(await capabilities(service), XML)


def _landing_links(service: Service) -> list[Link]:
    return [link(url(service), "service-desc", XML, "WMTS capabilities")] if service.version.datum is not None else []


extension = Extension(landing_links=_landing_links)
