"""Part 4, Create, Replace, Update and Delete: features of drafts are written one by one, those of versions never."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Annotated, Any, Final

from fastapi import Depends, Header, HTTPException, Request
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from app.api.http.auth import Editor, Principal, Viewer
from app.api.http.caching import none_match
from app.api.http.problems import MalformedBody, UnsupportedMedia
from app.api.http.schemas import EnvironmentPath, problem_responses
from app.errors import Invalid, NotFound, Problem, StaleParent
from app.ingest.drafts import MAX_ATTEMPTS
from app.ogc.collections import CollectionPath, unknown_collection_error
from app.ogc.crs import CRS84, parse_crs, reference_systems
from app.ogc.drafts import DRAFT, draft_service, own_draft
from app.ogc.extensions import Extension
from app.ogc.feature_edits import FeatureEditor
from app.ogc.footprints import raster_parts
from app.ogc.items import FeaturePath, item_etag
from app.ogc.property_types import property_types
from app.ogc.routing import LONG, SHORT, ogc_router
from app.ogc.service import Service
from app.ogc.vector import TITLES, tables, vector_tables
from app.store.values import DRAFT_PREFIX

PART4: Final = "http://www.opengis.net/spec/ogcapi-features-4/1.0/conf"
MERGE_PATCH: Final = "application/merge-patch+json"
ITEMS_METHODS: Final = "GET, HEAD, OPTIONS, POST"
ITEM_METHODS: Final = "GET, HEAD, OPTIONS, PUT, PATCH, DELETE"
READ_METHODS: Final = "GET, HEAD, OPTIONS"

router = ogc_router()

DraftService = Annotated[Service, Depends(draft_service)]
ContentCrs = Annotated[
    str | None,
    Header(
        alias="Content-Crs",
        max_length=2000,
        description="CRS of the sent coordinates, as `<URI>`: one of the collection. Default: CRS84.",
    ),
]
IfItemMatch = Annotated[
    str | None,
    Header(alias="If-Match", max_length=2000, description="`ETag` of the feature, as `GET` returned it."),
]


class SpelledName(bytes):
    """Name of a header that is sent as it is spelled: uvicorn lowers names, and QGIS 3.40 knows only ``Location``."""

    def lower(self) -> bytes:
        """Return the name itself."""
        return self


Edit = Callable[[FeatureEditor], Mapping[str, Any]]


async def _body(request: Request) -> Mapping[str, Any]:
    media = request.headers.get("content-type", "application/geo+json").partition(";")[0].strip().lower()
    accepted = ("application/geo+json", "application/json", MERGE_PATCH, "application/vnd.ogc.fg+json")
    if media not in accepted:
        raise UnsupportedMedia(f"unsupported media type: send {', '.join(accepted)}")
    try:
        body = await request.json()
    except ValueError as error:
        raise MalformedBody(f"the request body is not JSON: {error}") from None
    if not isinstance(body, dict):
        raise Invalid("the body must be a GeoJSON Feature", [Problem("must be an object", where="body")])
    if body.get("place") is not None:
        raise Invalid(
            "'place' is not accepted: send 'geometry', and its CRS as Content-Crs",
            [Problem("not accepted", where="place")],
        )
    return body


async def _feature_body(request: Request) -> Mapping[str, Any]:
    body = await _body(request)
    if body.get("type") != "Feature":
        raise Invalid("the body must be one GeoJSON Feature", [Problem("must be 'Feature'", where="type")])
    return body


async def _write(
    service: Service,
    principal: Principal,
    collection: str,
    content_crs: str | None,
    edit: Edit,
    if_match: str | None = None,
) -> Service:
    """Apply one edit to the draft of a service; returns the service of its new content.

    if_match: tag of the draft that the edit was decided for, else the edit is worked out anew when others edit.
    """
    if collection in raster_parts(service):
        raise HTTPException(
            405,
            f"{collection} is an outline, which follows its content: upload a grid, an image or a voxel map instead",
            headers={"allow": READ_METHODS},
        )
    if collection not in TITLES or service.version.datum is None:
        raise unknown_collection_error(service, collection, list(await tables(service)))
    services, env = service.services, service.environment.name
    systems = reference_systems(service, service.version.datum)
    crs = parse_crs((content_crs or CRS84).strip().removeprefix("<").removesuffix(">"), systems, "Content-Crs")
    content = services.store.content
    if service.version.pending is None:  # what is refused must not leave an empty draft
        types = await property_types(service, service.version, collection)
        change = await run_in_threadpool(edit, FeatureEditor(content, service.version, collection, types, crs))
        await run_in_threadpool(services.ingest.drafts.check, service.version, [change])
    draft = await run_in_threadpool(own_draft, services, env, service.draft or "", principal)
    base = await run_in_threadpool(services.store.versions.get, env, draft.base)
    types = await property_types(service, base, collection)

    def once() -> None:
        version = services.store.versions.get(env, DRAFT_PREFIX + draft.id)
        assert version.pending is not None
        editor = FeatureEditor(content, version, collection, types, crs)
        tag = if_match or f'"{version.pending.tag}"'
        services.ingest.drafts.edit(env, draft.id, [edit(editor)], principal.as_writer(), tag)

    def apply() -> Service:
        attempts = 1 if if_match is not None else MAX_ATTEMPTS
        for attempt in range(attempts):
            try:
                with services.ingest.drafts.turn(draft.id):
                    once()
            except StaleParent:
                if attempt == attempts - 1:
                    raise
            else:
                break
        return replace(service, version=services.store.versions.get(env, DRAFT_PREFIX + draft.id))

    return await run_in_threadpool(apply)


async def _check_item(service: Service, collection: str, feature: str, if_match: str | None) -> str | None:
    """Check If-Match with a feature's ETag; returns the tag of the draft for which it holds. Raises StaleParent."""
    if if_match is None:
        return None
    etag = await item_etag(service, collection, feature)
    if not none_match(if_match, etag):  # weakly: compression makes tags of the same content weak
        raise StaleParent(
            f"the feature {feature[:80]!r} has changed, or the tag is not that of its GeoJSON in CRS84: read it again "
            "so, and repeat the change"
        )
    pending = service.version.pending
    return None if pending is None else f'"{pending.tag}"'


async def _change_item(
    service: Service,
    principal: Principal,
    collection: str,
    feature: str,
    edit: Edit,
    content_crs: str | None,
    if_match: str | None,
) -> Response:
    """Change a feature; the response has the ETag of its GeoJSON, unless it is in another collection now."""
    tag = await _check_item(service, collection, feature, if_match)
    after = await _write(service, principal, collection, content_crs, edit, tag)
    try:
        headers = {"etag": await item_etag(after, collection, feature)}
    except NotFound:
        headers = {}
    return Response(status_code=204, headers=headers)


_BODY: Mapping[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {
            "application/geo+json": {
                "schema": {"type": "object", "description": "GeoJSON Feature."},
                "examples": {
                    "node": {
                        "value": {
                            "type": "Feature",
                            "geometry": {"type": "Point", "coordinates": [5.6135, 52.4206]},
                            "properties": {"name": "well"},
                        }
                    }
                },
            }
        },
    }
}
_PATCH_BODY: Mapping[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {
            MERGE_PATCH: {
                "schema": {"type": "object", "description": "`geometry` and `properties` to change (RFC 7396)."},
                "examples": {"name": {"value": {"properties": {"name": "north gate"}}}},
            }
        },
    }
}


@router.post(
    DRAFT + "/collections/{collection}/items",
    status_code=201,
    response_class=Response,
    responses={
        **problem_responses(None, 400, 403, 404, 409, 412, 415),
        201: {"description": "A new feature; `Location` has its address"},
    },
    summary="Add a feature to a draft",
    openapi_extra=dict(_BODY),
)
async def create_item(
    service: DraftService,
    collection: CollectionPath,
    request: Request,
    principal: Editor,
    content_crs: ContentCrs = None,
) -> Response:
    """Add one feature. Without an id it gets one.

    The ends of an edge are put onto the nodes within 0.5 m; `source` and `target` are set by them. An edge that ends at
    no node is refused.
    """
    body = await _feature_body(request)
    created: list[str] = []

    def edit(editor: FeatureEditor) -> Mapping[str, Any]:
        item, change = editor.create(body)
        created[:] = [item]
        return change

    after = await _write(service, principal, collection, content_crs, edit)
    location = after.url("collections", collection, "items", created[0])
    response = Response(status_code=201)
    response.raw_headers.append((SpelledName(b"Location"), location.encode()))
    return response


@router.put(
    DRAFT + "/collections/{collection}/items/{feature:path}",
    status_code=204,
    responses=problem_responses(None, 400, 403, 404, 412, 415),
    summary="Replace a feature of a draft",
    openapi_extra=dict(_BODY),
)
async def replace_item(
    service: DraftService,
    collection: CollectionPath,
    feature: FeaturePath,
    request: Request,
    principal: Editor,
    content_crs: ContentCrs = None,
    if_match: IfItemMatch = None,
) -> Response:
    """Replace geometry and properties. Edges move with their nodes; ends of edges are put onto nodes."""
    body = await _feature_body(request)

    def edit(editor: FeatureEditor) -> Mapping[str, Any]:
        return editor.change(feature, body, replaces=True)

    return await _change_item(service, principal, collection, feature, edit, content_crs, if_match)


@router.patch(
    DRAFT + "/collections/{collection}/items/{feature:path}",
    status_code=204,
    responses=problem_responses(None, 400, 403, 404, 412, 415),
    summary="Update a feature of a draft",
    openapi_extra=dict(_PATCH_BODY),
)
async def update_item(
    service: DraftService,
    collection: CollectionPath,
    feature: FeaturePath,
    request: Request,
    principal: Editor,
    content_crs: ContentCrs = None,
    if_match: IfItemMatch = None,
) -> Response:
    """Change `geometry`, single `properties`, or both, as a JSON merge patch; null removes a property."""
    body = await _body(request)
    unknown = sorted(set(body) - {"type", "id", "geometry", "properties"})
    if unknown or not {"geometry", "properties"} & set(body):
        reason = f"unknown member {unknown[0][:80]!r}" if unknown else "nothing to change"
        raise Invalid(f"{reason}: give 'geometry', 'properties' or both", [Problem(reason, where="body")])

    def edit(editor: FeatureEditor) -> Mapping[str, Any]:
        return editor.change(feature, body, replaces=False)

    return await _change_item(service, principal, collection, feature, edit, content_crs, if_match)


@router.delete(
    DRAFT + "/collections/{collection}/items/{feature:path}",
    status_code=204,
    responses=problem_responses(None, 400, 403, 404, 412),
    summary="Delete a feature of a draft",
)
async def delete_item(
    service: DraftService,
    collection: CollectionPath,
    feature: FeaturePath,
    principal: Editor,
    if_match: IfItemMatch = None,
) -> Response:
    """Delete one feature. A node with edges is refused: delete the edges first."""
    tag = await _check_item(service, collection, feature, if_match)
    await _write(service, principal, collection, None, lambda editor: editor.delete(feature), tag)
    return Response(status_code=204)


# --- methods ---


async def allow_items(service: DraftService, collection: CollectionPath) -> Response:
    """Return the methods of a draft's items."""
    return _allow(service, collection, ITEMS_METHODS)


async def allow_item(service: DraftService, collection: CollectionPath) -> Response:
    """Return the methods of a draft's item, whether or not it exists."""
    return _allow(service, collection, ITEM_METHODS)


async def allow_reading(_: Viewer) -> Response:
    """Return the methods of a version's items."""
    return Response(status_code=204, headers={"allow": READ_METHODS})


async def refuse_writing(env: EnvironmentPath, _: Viewer) -> Response:
    """Refuse to change a version."""
    raise HTTPException(
        405,
        f"versions do not change: write to a draft, at /ogc/{env}/drafts/mine, and commit it",
        headers={"allow": READ_METHODS},
    )


def _allow(service: Service, collection: str, methods: str) -> Response:
    rasters = raster_parts(service)
    if collection not in TITLES and collection not in rasters:
        raise NotFound(f"unknown collection {collection[:80]!r}; available: {', '.join((*TITLES, *rasters))}")
    methods = methods if collection in TITLES else READ_METHODS
    return Response(status_code=204, headers={"allow": methods, "cache-control": "no-store"})


_ITEMS, _ITEM = "/collections/{collection}/items", "/collections/{collection}/items/{feature:path}"
for _path, _allowed in ((_ITEMS, allow_items), (_ITEM, allow_item)):
    router.add_api_route(DRAFT + _path, _allowed, methods=["OPTIONS"], include_in_schema=False)
    for _prefix in (SHORT, LONG):
        _writing = ["POST"] if _path == _ITEMS else ["PUT", "PATCH", "DELETE"]
        router.add_api_route(_prefix + _path, allow_reading, methods=["OPTIONS"], include_in_schema=False)
        router.add_api_route(_prefix + _path, refuse_writing, methods=_writing, include_in_schema=False)


# --- description ---


def _conformance(service: Service) -> tuple[str, ...]:
    names = ("create-replace-delete", "update", "optimistic-locking-etags", "features")
    return tuple(f"{PART4}/{name}" for name in names) if service.draft is not None else ()


async def _paths(service: Service) -> Mapping[str, object]:
    if service.draft is None:
        return {}
    out: dict[str, object] = {}
    for name in await vector_tables(service):
        suffix = name.title().replace("-", "")
        title = TITLES[name][1]
        out[f"/collections/{name}/items"] = {
            "post": _operation(f"add{suffix}", f"{title}: add a feature", "201", _BODY)
        }
        out[f"/collections/{name}/items/{{featureId}}"] = {
            "put": _operation(f"replaceOneOf{suffix}", f"{title}: replace a feature", "204", _BODY, item=True),
            "patch": _operation(f"updateOneOf{suffix}", f"{title}: update a feature", "204", _PATCH_BODY, item=True),
            "delete": _operation(f"deleteOneOf{suffix}", f"{title}: delete a feature", "204", {}, item=True),
        }
    return out


def _operation(
    name: str, summary: str, status: str, body: Mapping[str, Any], *, item: bool = False
) -> dict[str, object]:
    text = {"type": "string"}
    headers = [{"name": "Content-Crs", "in": "header", "required": False, "schema": text}] if body else []
    path = [{"name": "featureId", "in": "path", "required": True, "schema": text}] if item else []
    if item:
        headers.append({"name": "If-Match", "in": "header", "required": False, "schema": text})
    problem = {"description": "Error", "content": {"application/problem+json": {"schema": {"type": "object"}}}}
    return {
        "operationId": name,
        "summary": summary,
        "tags": ["data"],
        "parameters": [*path, *headers],
        "responses": {status: {"description": "Done"}, "default": problem},
        **body,
    }


extension = Extension(conformance_of=_conformance, paths=_paths)
