"""Routes of the OGC API: each at three addresses, with errors as the standard demands."""

from __future__ import annotations

import inspect
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from functools import wraps
from typing import Annotated, Any, get_type_hints

import orjson
from fastapi import APIRouter, Depends, Request
from fastapi.exceptions import RequestValidationError
from starlette.responses import Response

from app.api.http import problems
from app.api.http.responses import StrictRoute
from app.api.http.schemas import problem_responses
from app.errors import FleetMapError
from app.ogc.drafts import DRAFT, draft_service
from app.ogc.negotiation import HTML, prefers_html
from app.ogc.pages import error_page, page_headers
from app.ogc.service import Service, current_service, version_service

SHORT = "/ogc/{env}"
LONG = "/ogc/{env}/versions/{v}"

SERVICES = (
    (SHORT, current_service, ""),
    (LONG, version_service, "_of_version"),
    (DRAFT, draft_service, "_of_draft"),
)
"""Addresses of services, what finds them, and the end of the names of their operations."""

SAME = {"description": "Not modified: the client has this content"}
REDIRECT = {"description": "The content is at `Location`: a link that needs no token until it expires"}

Handler = Callable[..., Awaitable[Response]]


class OgcRoute(StrictRoute):
    """Route whose invalid parameters are 400, and whose errors are pages for browsers."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """Wrap the handler."""
        handler = super().get_route_handler()

        async def convert_errors(request: Request) -> Response:
            try:
                return await handler(request)
            except (FleetMapError, RequestValidationError) as error:
                return _error_response(request, error)

        return convert_errors


def _error_response(request: Request, error: FleetMapError | RequestValidationError) -> Response:
    """Build the response for an error: a problem, or a page with the same words."""
    if isinstance(error, RequestValidationError):
        response = problems.validation_error_response(error)
    else:
        response = problems.error_response(error)
    body: dict[str, Any] = orjson.loads(bytes(response.body))
    if response.status_code == 422:
        response.status_code = body["status"] = 400
    headers = {name: value for name, value in response.headers.items() if name not in ("content-length",)}
    if prefers_html(request):
        headers |= {**page_headers(), "content-type": HTML}
        return Response(error_page(body), response.status_code, headers)
    return Response(orjson.dumps(body), response.status_code, headers)


def ogc_router() -> APIRouter:
    """Create the router of a module."""
    return APIRouter(tags=["ogc"], route_class=OgcRoute)


def both(
    router: APIRouter,
    path: str,
    content: Mapping[str, object],
    *,
    in_schema: bool = True,
    redirects: bool = False,
    **options: Any,
) -> Callable[[Handler], Handler]:
    """Register a handler for ``GET`` below each address of SERVICES.

    The handler's parameter of type Service gets the one of the address.

    Args:
        content: media types of the response, each with its OpenAPI object.
        redirects: the response is a redirect to that content.
        options: further arguments of FastAPI's ``add_api_route``.
    """

    def register(handler: Handler) -> Handler:
        for prefix, dependency, suffix in SERVICES:
            endpoint = _with_service(handler, dependency, suffix)
            responses: dict[int | str, dict[str, Any]] = {
                **problem_responses(None, 404, 406),
                400: {
                    "description": "A parameter is invalid or unknown; `errors` names it.",
                    "content": {problems.MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}},
                },
                **({307: REDIRECT} if redirects else {200: {"description": "OK", "content": dict(content)}, 304: SAME}),
            }
            router.add_api_route(
                prefix + path,
                endpoint,
                methods=["GET"],
                responses=responses,
                response_class=Response,
                status_code=307 if redirects else 200,
                include_in_schema=in_schema,
                **options,
            )
        return handler

    return register


def _with_service(handler: Handler, dependency: Callable[..., Service | Awaitable[Service]], suffix: str) -> Handler:
    """Return a handler whose parameter of type Service is injected by a dependency."""
    hints = get_type_hints(handler, include_extras=True)

    @wraps(handler)
    async def endpoint(**values: Any) -> Response:
        return await handler(**values)

    injected = Annotated[Service, Depends(dependency)]
    parameters = [
        parameter.replace(
            kind=inspect.Parameter.KEYWORD_ONLY, annotation=injected if hints[name] is Service else hints[name]
        )
        for name, parameter in inspect.signature(handler).parameters.items()
    ]
    endpoint.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    endpoint.__name__ = handler.__name__ + suffix
    return endpoint
