"""The audit log, for administrators."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated

from fastapi import Query, Request
from pydantic import BaseModel
from starlette.responses import Response

from app.api.http.auth import ServerAdmin
from app.api.http.dependencies import ServicesDep
from app.api.http.responses import api_router, page_response
from app.api.http.schemas import Limit, problem_responses
from app.errors import Invalid
from app.store.audit import AuditEntry
from app.store.values import rfc3339


class AuditTokenOut(BaseModel):
    """Token that made a change, with its name and role at that time."""

    id: str
    name: str
    role: str


class AuditOut(BaseModel):
    """One change.

    `request` is the `X-Request-Id` of the response, which the server's log contains as well. `target` names the
    created object if the path does not.
    """

    id: int
    time: datetime
    token: AuditTokenOut
    address: str
    request: str
    method: str
    path: str
    environment: str | None
    target: str | None


router = api_router("audit", "/audit")


@router.get("", responses=problem_responses(list[AuditOut]), summary="List changes with their authors and addresses")
def list_audit(
    request: Request,
    services: ServicesDep,
    _: ServerAdmin,
    environment: Annotated[str | None, Query(max_length=63, description="Only changes of this environment.")] = None,
    token_id: Annotated[str | None, Query(max_length=32, description="Only changes made with this token.")] = None,
    limit: Limit = 100,
    cursor: Annotated[
        str | None, Query(max_length=18, description="Start of the page, from the `Link` header of the previous page.")
    ] = None,
) -> Response:
    """List changes, newest first. Each entry is stored in the same transaction as its change.

    Requires an administrator's token for all environments. Reports of robots and actions of the server itself
    (planned moves, closures that expire) are not listed: read the events.
    """
    if cursor is not None and not (cursor.isascii() and cursor.isdigit()):
        raise Invalid("invalid cursor: take it from the Link header of the previous page")
    before = None if cursor is None else int(cursor)
    entries = services.store.audit.page(environment=environment, token_id=token_id, before=before, limit=limit + 1)
    more = str(entries[limit - 1].id) if len(entries) > limit else None
    return page_response(request, [as_dict(entry) for entry in entries[:limit]], more)


def as_dict(entry: AuditEntry) -> dict[str, object]:
    """Convert one entry to JSON."""
    return {
        "id": entry.id,
        "time": rfc3339(entry.time),
        "token": {"id": entry.token_id, "name": entry.token, "role": entry.role},
        "address": entry.address,
        "request": entry.request_id,
        "method": entry.method,
        "path": entry.path,
        "environment": entry.environment,
        "target": entry.target,
    }
