"""Access tokens."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated, Any, Literal

from fastapi import Path
from pydantic import BaseModel, ConfigDict, Field
from starlette.responses import Response

from app.api.http.auth import ServerAdmin
from app.api.http.dependencies import ServicesDep
from app.api.http.responses import api_router, json_response
from app.api.http.schemas import ApiTime, RequestModel, problem_responses
from app.errors import Conflict, Invalid, NotFound, Problem
from app.events.messages import ROBOT_NAME
from app.store.values import Token, rfc3339


class TokenBody(RequestModel):
    """A new token."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [{"name": "mower-3", "role": "robot", "environments": "farm*", "robot": "mower-3"}]
        },
    )

    name: str = Field(min_length=1, max_length=200, description="Who it is for; it stands as author in the history.")
    role: Literal["viewer", "robot", "editor", "admin"]
    environments: str | None = Field(
        None, min_length=1, max_length=200, description="Name pattern (`farm-*`) of the environments it reaches."
    )
    robot: str | None = Field(
        None,
        min_length=1,
        max_length=200,
        description="Role `robot`: the robot whose status it may set. Default: `name`.",
    )
    expires: ApiTime | None = Field(None, description="RFC 3339 time with zone; left out: never.")


class TokenOut(BaseModel):
    """A token without its secret."""

    id: str
    name: str
    role: str
    environments: str | None
    robot: str | None
    expires: datetime | None
    created: datetime
    ended: datetime | None = Field(description="When it was seen to have expired; it stays expired.")


class NewTokenOut(TokenOut):
    """A new token with its secret, which is told only now."""

    token: str


TokenPath = Annotated[str, Path(max_length=100, description="A token's id.")]

router = api_router("tokens", "/tokens")


def as_dict(token: Token) -> dict[str, Any]:
    """The token without its secret."""
    return {
        "id": token.id,
        "name": token.name,
        "role": token.role,
        "environments": token.environments,
        "robot": token.robot,
        "expires": rfc3339(token.expires) if token.expires else None,
        "created": rfc3339(token.created),
        "ended": rfc3339(token.ended) if token.ended else None,
    }


@router.get("", responses=problem_responses(list[TokenOut]), summary="All tokens, without their secrets")
def list_tokens(services: ServicesDep, _: ServerAdmin) -> Response:
    """Oldest first."""
    return json_response([as_dict(token) for token in services.store.tokens.all()])


@router.post(
    "",
    status_code=201,
    responses=problem_responses(NewTokenOut, 400, 415, ok=201, description="Made"),
    summary="Make a token",
)
def create_token(body: TokenBody, services: ServicesDep, _: ServerAdmin) -> Response:
    """Its secret stands in this answer and nowhere else: only its hash is stored.

    A token with the role `robot` names its robot: `robot`, by default its own `name`.
    """
    if body.expires is not None:
        if body.expires.tzinfo is None:
            raise Invalid("expires needs a zone, like 2030-01-31T06:00:00Z", [Problem("no zone", where="expires")])
        if body.expires <= datetime.now(UTC):
            raise Invalid("expires is in the past", [Problem("past", where="expires")])
    if body.robot is not None and body.role != "robot":
        raise Invalid("only a token with the role robot names a robot", [Problem("role is not robot", where="robot")])
    robot = _robot_name(body)
    token, secret = services.store.tokens.create(body.name, body.role, body.environments, robot, body.expires)
    return json_response({**as_dict(token), "token": secret}, 201, {"cache-control": "no-store"})


def _robot_name(body: TokenBody) -> str | None:
    """The robot that a token names; None for other roles than ``robot``."""
    if body.role != "robot":
        return None
    name = body.name if body.robot is None else body.robot
    if not ROBOT_NAME.fullmatch(name):
        rule = "at most 128 of A-Z, a-z, 0-9, _, . and -, starting with a letter or digit"
        field = "name" if body.robot is None else "robot"
        raise Invalid(
            f"{name[:80]!r} is no robot's name, which must be {rule}: set 'robot' (on the command line --robot)",
            [Problem(f"must be {rule}", where=field)],
        )
    return name


@router.delete("/{id}", status_code=204, responses=problem_responses(None, 404, 409), summary="Revoke a token")
def delete_token(id: TokenPath, services: ServicesDep, _: ServerAdmin) -> Response:
    """It is refused from now on (within a second by other worker processes). The last administrator's stays."""
    tokens = {token.id: token for token in services.store.tokens.all()}
    if id not in tokens:
        raise NotFound("there is no token with this id")
    if _is_full_admin(tokens[id]) and not any(_is_full_admin(t) for t in tokens.values() if t.id != id):
        raise Conflict("this is the last administrator's token: make another one first")
    services.store.tokens.delete(id)
    services.access.invalidate()
    return Response(status_code=204)


def _is_full_admin(token: Token) -> bool:
    """Whether it is an administrator's for everything, and for good."""
    return token.role == "admin" and token.environments is None and token.expires is None
