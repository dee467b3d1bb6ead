"""Landing page and conformance classes."""

from __future__ import annotations

from starlette.responses import Response

from app.api.http.schemas import component_schemas
from app.ogc.collections import notice
from app.ogc.crs import CRS84, reference_systems
from app.ogc.extensions import Extension, extensions
from app.ogc.extent import site_box
from app.ogc.negotiation import HTML, JSON, OPENAPI, PAGES, Representation
from app.ogc.pages import add, draw_map_picture, link_list, page, representations, respond_page, url_list
from app.ogc.routing import both, ogc_router
from app.ogc.schemas import OgcConformanceOut, OgcLandingOut
from app.ogc.service import Link, Service, link

COMMON = "http://www.opengis.net/spec/ogcapi-common-1/1.0/conf"
FEATURES = "http://www.opengis.net/spec/ogcapi-features-1/1.0/conf"

router = ogc_router()


def _links(service: Service) -> list[Link]:
    return [
        link(service.url("api"), "service-desc", OPENAPI, "OpenAPI document of this service"),
        link(service.url("api.html"), "service-doc", HTML, "Description of this service"),
        link(service.url("conformance"), "conformance", JSON, "Conformance classes"),
        link(service.url("collections"), "data", JSON, "Collections"),
        *(added for one in extensions() for added in one.landing_links(service)),
    ]


def _attribution(service: Service) -> str:
    texts = dict.fromkeys(text for entry in service.version.parts for text in entry.provenance.attribution)
    return "; ".join(texts)


_CONTENT = {JSON: {"schema": {"$ref": "#/components/schemas/OgcLandingOut"}}, HTML: {}}


@both(router, "", _CONTENT, in_schema=False)
@both(
    router,
    "/",
    _CONTENT,
    summary="Get the OGC API landing page",
    openapi_extra=component_schemas(OgcLandingOut),
)
async def get_landing_page(service: Service, f: Representation = None) -> Response:  # noqa: ARG001  parsed by choose()
    """Return the entry for GIS programs: paste this address into QGIS as an OGC API - Features connection.

    Without a version: the channel `production` if it exists, else the latest version. HTTP Basic is allowed here and
    below, with any user name and the token as the password.
    """
    used = service.choose()
    links = [*service.alternates(service.landing_url, PAGES, used), *_links(service)]
    document: dict[str, object] = {"title": service.title, "description": service.description}
    credits_ = _attribution(service)
    if credits_:
        document["attribution"] = credits_
    box = await site_box(service)
    if service.version.datum is not None:
        document["crs"] = list(reference_systems(service, service.version.datum))
    if box is not None:
        document["extent"] = {"spatial": {"bbox": [list(box)], "crs": CRS84}}
    if used == "json":
        return service.respond_json({**document, "links": links})
    root, body = page(service.title)
    if service.environment.description:
        add(body, "p", service.environment.description)
    add(body, "p", service.description, class_="soft")
    if credits_:
        add(body, "p", credits_, class_="soft")
    missing = notice(service)
    if missing is not None:
        add(body, "p", missing)
    if box is not None:
        draw_map_picture(body, service)
    line = add(body, "p", "In QGIS: add an OGC API - Features connection with the address ")
    add(line, "code", service.landing_url).tail = ". If it asks for a password, give your token; any user name will do."
    link_list(body, links)
    representations(body, links)
    return respond_page(service, root)


@both(
    router,
    "/conformance",
    {JSON: {"schema": {"$ref": "#/components/schemas/OgcConformanceOut"}}, HTML: {}},
    summary="List the OGC conformance classes",
    openapi_extra=component_schemas(OgcConformanceOut),
)
async def get_conformance(service: Service, f: Representation = None) -> Response:  # noqa: ARG001  parsed by choose()
    """Return the URIs of the conformance classes that the service implements."""
    used = service.choose()
    classes = [uri for one in extensions() for uri in (*one.conformance, *one.conformance_of(service))]
    if used == "json":
        return service.respond_json({"conformsTo": classes})
    root, body = page("Conformance classes", [(service.title, service.landing_url)])
    url_list(body, classes)
    representations(body, service.alternates(service.url("conformance"), PAGES, used))
    return respond_page(service, root)


extension = Extension(
    conformance=(
        f"{COMMON}/core",
        f"{COMMON}/landing-page",
        f"{COMMON}/json",
        f"{COMMON}/html",
        f"{COMMON}/oas30",
        f"{FEATURES}/core",
        f"{FEATURES}/geojson",
        f"{FEATURES}/html",
        f"{FEATURES}/oas30",
    ),
)
