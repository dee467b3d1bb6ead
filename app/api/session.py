"""Sessions of browsers: sign in with a token or a one-time code, and out."""

from __future__ import annotations

from datetime import datetime
from typing import Any, Self
from urllib.parse import quote

from fastapi import Request
from pydantic import BaseModel, ConfigDict, Field, model_validator
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from app.api.http.auth import (
    SESSION_COOKIE,
    Credentials,
    Principal,
    Viewer,
    authorise,
    check_same_origin,
)
from app.api.http.dependencies import Services, ServicesDep
from app.api.http.responses import api_router, json_response
from app.api.http.schemas import RequestModel, problem_responses
from app.errors import Conflict, NotFound, Unauthenticated
from app.store.sessions import Session
from app.store.values import Role, rfc3339


class SignInBody(RequestModel):
    """A token or a one-time code: exactly one of them."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"token": "TOKEN"}]})

    token: str | None = Field(None, min_length=1, max_length=512, description="Access token.")
    code: str | None = Field(
        None,
        min_length=1,
        max_length=128,
        description="One-time code of `POST /api/v1/tokens/{id}/sign-in-code`, valid for 10 minutes.",
    )

    @model_validator(mode="after")
    def _one_of_both(self) -> Self:
        if (self.token is None) == (self.code is None):
            raise ValueError("give either token or code: exactly one of them")
        return self


class SessionOut(BaseModel):
    """The caller, as the server knows it."""

    name: str = Field(description="Name of the token. `anonymous`: no token was needed.")
    role: Role
    environments: str | None = Field(description="Name pattern of the accessible environments; null: all.")
    robot: str | None = Field(description="Robot whose status the caller may report; null: any that the role allows.")
    expires: datetime | None = Field(
        description="End of the token, or of the session if it is not used until then, whichever is earlier; null: "
        "never."
    )


router = api_router("session", "/session")


def as_dict(principal: Principal) -> dict[str, Any]:
    """Convert a caller to JSON."""
    ends = [time for time in (principal.expires, principal.session_ends) if time is not None]
    return {
        "name": principal.name,
        "role": principal.role,
        "environments": principal.environments,
        "robot": principal.robot,
        "expires": rfc3339(min(ends)) if ends else None,
    }


def sign_in_path(code: str) -> str:
    """Return the address of the page that signs in with a code. A browser does not send what follows the #."""
    return f"/#sign-in={quote(code, safe='')}"


@router.post(
    "",
    status_code=201,
    responses=problem_responses(
        SessionOut, 401, 403, 409, 422, 429, 503, ok=201, description="The session; its cookie is set"
    ),
    summary="Sign in",
)
async def sign_in(body: SignInBody, request: Request, services: ServicesDep) -> Response:
    """Start a session in a browser: the response sets the cookie `fleetmap_session`, which page scripts cannot read.

    The session has the rights of its token, and ends with it, or after 12 hours without use. A token has at most 32
    sessions: a further one ends the one that was unused longest. A code is used up. A wrong token or code returns 401,
    and counts like a wrong token. With a session, a change requires the header `Origin` of this server.
    """
    if services.access.insecure:
        raise Conflict("access control is disabled: everyone is administrator, and nobody needs to sign in")
    check_same_origin(request.scope, required=False)
    credentials = Credentials.from_scope(request.scope)
    started = await run_in_threadpool(_start, services, body)
    if started is None:
        services.access.note_failure(credentials.client)
        problem = "unknown or expired token" if body.code is None else "unknown, used or expired code"
        raise Unauthenticated(f"{problem}: ask an administrator for a new one")
    session, secret = started
    if credentials.session is not None:
        await run_in_threadpool(_end, services, credentials.session)
    principal = Principal.from_token(session.token, session.ends)
    authorise(request.scope, principal, None)
    request.scope["state"]["principal"] = principal  # for the log
    response = json_response(as_dict(principal), 201, {"cache-control": "no-store"})
    _set_cookie(response, request, secret)
    return response


@router.get("", responses=problem_responses(SessionOut), summary="Get the caller")
def get_session(principal: Viewer) -> Response:
    """Return the caller's name and rights, whether by session or token; 401 if nobody is signed in.

    Without access control, and for readers from `FLEETMAP_ANONYMOUS_NETWORKS`, `name` is `anonymous`.
    """
    return json_response(as_dict(principal), headers={"cache-control": "no-store"})


@router.delete("", status_code=204, responses=problem_responses(None, 403, 422, 503), summary="Sign out")
async def sign_out(request: Request, services: ServicesDep) -> Response:
    """End the session of the cookie, if there is one, and clear the cookie. A token stays valid."""
    headers = dict(request.scope["headers"])
    secret = Credentials.from_headers(None, headers.get(b"cookie"), request.scope).session
    if secret is not None:
        check_same_origin(request.scope, required=b"authorization" not in headers)
        await run_in_threadpool(_end, services, secret)
    response = Response(status_code=204, headers={"cache-control": "no-store"})
    _set_cookie(response, request, "", max_age=0)
    return response


def _start(services: Services, body: SignInBody) -> tuple[Session, str] | None:
    """Start a session; None if the token or code is wrong."""
    if body.code is not None:
        return services.store.sessions.redeem(body.code)
    token = services.store.tokens.find(body.token or "")
    try:
        return None if token is None else services.store.sessions.create(token)
    except NotFound:  # revoked at the same time
        return None


def _end(services: Services, secret: bytes) -> None:
    if services.store.sessions.end(secret.decode("ascii")):
        services.access.invalidate()


def _set_cookie(response: Response, request: Request, value: str, max_age: int | None = None) -> None:
    secure = request.scope["scheme"] == "https"
    response.set_cookie(SESSION_COOKIE, value, max_age, path="/", secure=secure, httponly=True, samesite="strict")
