"""Access tokens."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated, Any

from fastapi import Path
from pydantic import BaseModel, ConfigDict, Field
from starlette.responses import Response

from app.api.http.auth import ServerAdmin
from app.api.http.dependencies import ServicesDep
from app.api.http.responses import api_router, json_response
from app.api.http.schemas import ApiTime, RequestModel, problem_responses
from app.api.session import sign_in_path
from app.errors import Invalid, Problem
from app.events.messages import ROBOT_NAME
from app.store.values import Role, Token, rfc3339


class TokenBody(RequestModel):
    """A new token."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [{"name": "mower-3", "role": "robot", "environments": "farm*", "robot": "mower-3"}]
        },
    )

    name: str = Field(min_length=1, max_length=200, description="Name shown in lists and as author in the history.")
    role: Role
    environments: str | None = Field(
        None,
        min_length=1,
        max_length=200,
        description="Name pattern (`farm-*`) of the environments that the token can access. Default: all.",
    )
    robot: str | None = Field(
        None,
        min_length=1,
        max_length=200,
        description="Role `robot`: robot whose status the token may report. Default: `name`.",
    )
    expires: ApiTime | None = Field(None, description="RFC 3339 time with time zone. Default: never.")


class TokenOut(BaseModel):
    """A token without its secret."""

    id: str
    name: str
    role: str
    environments: str | None
    robot: str | None
    expires: datetime | None
    created: datetime
    last_used: datetime | None = Field(description="Time of the last use, to the hour; null: never, or not known.")
    ended: datetime | None = Field(
        description="Time at which the server found the token expired. It stays expired, even if the clock is set back."
    )


class NewTokenOut(TokenOut):
    """New token with its secret, which is returned only once."""

    token: str


class SignInCodeOut(BaseModel):
    """One-time code to sign in a browser."""

    code: str
    path: str = Field(description="Address of the page that signs in with the code, without scheme and host.")
    expires: datetime


TokenPath = Annotated[str, Path(max_length=100, description="Id of the token.")]

router = api_router("tokens", "/tokens")


def as_dict(token: Token) -> dict[str, Any]:
    """Convert a token to JSON, without its secret."""
    return {
        "id": token.id,
        "name": token.name,
        "role": token.role,
        "environments": token.environments,
        "robot": token.robot,
        "expires": rfc3339(token.expires) if token.expires else None,
        "created": rfc3339(token.created),
        "last_used": rfc3339(token.used) if token.used else None,
        "ended": rfc3339(token.ended) if token.ended else None,
    }


@router.get("", responses=problem_responses(list[TokenOut]), summary="List tokens")
def list_tokens(services: ServicesDep, _: ServerAdmin) -> Response:
    """List the tokens, oldest first, without their secrets."""
    return json_response([as_dict(token) for token in services.store.tokens.all()])


@router.post(
    "",
    status_code=201,
    responses=problem_responses(NewTokenOut, 400, 415, ok=201, description="The token"),
    summary="Create a token",
)
def create_token(body: TokenBody, services: ServicesDep, _: ServerAdmin) -> Response:
    """Create a token. Its secret is only in this response; the server stores a hash.

    A token with the role `robot` is bound to a robot: `robot`, by default its own `name`.
    """
    if body.expires is not None:
        if body.expires.tzinfo is None:
            raise Invalid(
                "expires needs a time zone, for example 2030-01-31T06:00:00Z",
                [Problem("missing time zone", where="expires")],
            )
        if body.expires <= datetime.now(UTC):
            raise Invalid(
                "expires is in the past: give a later time", [Problem("must be in the future", where="expires")]
            )
    if body.robot is not None and body.role != "robot":
        raise Invalid(
            "robot requires the role robot: omit it, or set role to robot",
            [Problem("requires the role robot", where="robot")],
        )
    robot = _robot_name(body)
    token, secret = services.store.tokens.create(body.name, body.role, body.environments, robot, body.expires)
    return json_response({**as_dict(token), "token": secret}, 201, {"cache-control": "no-store"})


def _robot_name(body: TokenBody) -> str | None:
    """Return the robot to which a token is bound; None for other roles than ``robot``."""
    if body.role != "robot":
        return None
    name = body.name if body.robot is None else body.robot
    if not ROBOT_NAME.fullmatch(name):
        rule = "at most 128 of A-Z, a-z, 0-9, _, . and -, starting with a letter or digit"
        field = "name" if body.robot is None else "robot"
        raise Invalid(
            f"{name[:80]!r} is not a valid robot name, which must be {rule}: set 'robot' (on the command line --robot)",
            [Problem(f"must be {rule}", where=field)],
        )
    return name


@router.delete("/{id}", status_code=204, responses=problem_responses(None, 404, 409), summary="Revoke a token")
def delete_token(id: TokenPath, services: ServicesDep, _: ServerAdmin) -> Response:
    """Revoke a token; other worker processes refuse it within a second.

    The last token of a full administrator cannot be revoked.
    """
    services.store.tokens.delete(id, is_needed=_is_full_admin)
    services.access.invalidate()
    return Response(status_code=204)


@router.post(
    "/{id}/sign-in-code",
    status_code=201,
    responses=problem_responses(SignInCodeOut, 404, 409, ok=201, description="The code"),
    summary="Create a sign-in code",
)
def create_sign_in_code(id: TokenPath, services: ServicesDep, _: ServerAdmin) -> Response:
    """Create a code that signs in one browser with this token, without typing it. It is valid once, for 10 minutes."""
    code, expires = services.store.sessions.make_sign_in_code(id)
    out = {"code": code, "path": sign_in_path(code), "expires": rfc3339(expires)}
    return json_response(out, 201, {"cache-control": "no-store"})


def _is_full_admin(token: Token) -> bool:
    """Test if a token is an administrator's for all environments without expiry."""
    return token.role == "admin" and token.environments is None and token.expires is None
