"""What the rule of retention keeps, and what it would remove now."""

from __future__ import annotations

from typing import Annotated

from fastapi import Query
from pydantic import BaseModel, ConfigDict, Field
from starlette.responses import Response

from app.api.http.auth import ServerAdmin
from app.api.http.dependencies import ServicesDep
from app.api.http.responses import api_router, json_response
from app.api.http.schemas import problem_responses
from app.formats import writable_formats


class RetentionPlanOut(BaseModel):
    """What the rule does in an environment."""

    environment: str
    kept: dict[str, int] = Field(
        description="Number of versions that stay, by reason: `head`, `channel`, `robot`, `tag`, `recent`, `daily` …"
    )
    thinned: list[int] = Field(description="Versions whose content the next run removes.")
    files: int = Field(description="Number of uploaded files of kept versions that the next run removes.")


class RetentionOut(BaseModel):
    """A dry run of the server's rule. Null and empty if there is none: everything is kept."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"rule": None, "environments": []}]})

    rule: str | None
    environments: list[RetentionPlanOut]
    removable_bytes: int | None = Field(None, description="With `space`: what the next runs remove, approximately.")
    stored_bytes: int | None = Field(None, description="With `space`: what is stored now.")


router = api_router("retention", "/retention")


@router.get("", responses=problem_responses(RetentionOut), summary="Get what retention would remove")
def get_retention(
    services: ServicesDep,
    _: ServerAdmin,
    space: Annotated[bool, Query(description="Also compute the space, which reads the index of all content.")] = False,
) -> Response:
    """Return what the rule of the settings `FLEETMAP_RETENTION_…` would remove now; changes nothing.

    The server applies its rule once a day. Requires an administrator's token for all environments.
    """
    rule, store = services.options.retention, services.store
    plans = [] if rule is None else list(store.retention.plan(rule, writable_formats()))
    body = {"rule": None if rule is None else rule.text, "environments": [plan.as_dict() for plan in plans]}
    removable, stored = store.garbage.removable_bytes(plans) if space else (None, None)
    return json_response({**body, "removable_bytes": removable, "stored_bytes": stored})
