"""Search by name in all environments."""

from __future__ import annotations

from typing import Annotated

from fastapi import Query
from pydantic import BaseModel, Field
from starlette.responses import Response

from app.api.http.auth import Viewer
from app.api.http.dependencies import ServicesDep
from app.api.http.responses import api_router, json_response
from app.api.http.schemas import problem_responses
from app.errors import Invalid, Problem
from app.store.search_index import SearchKind


class SearchItemOut(BaseModel):
    """An environment, or an item of its map."""

    kind: SearchKind
    environment: str
    version: int = Field(description="Searched version: that of `production` if this channel exists, else the newest.")
    id: str = Field(description="Id of the item; of an environment its name.")
    name: str = Field(description="Name of the item; its id if it has none.")
    level: str | None = Field(description="Level of the item; null for an environment.")
    where: tuple[float, float] | None = Field(
        description="A point of the item in metres in the local frame. Null for an environment, for an item without "
        "coordinates, and for one in degrees if the environment has no datum."
    )
    title: str = Field(description="Title of the environment.")


class SearchOut(BaseModel):
    """Best matches first."""

    items: list[SearchItemOut]
    truncated: bool = Field(description="Whether there are more matches than `limit`.")


router = api_router("search", "/search")


@router.get("", responses=problem_responses(SearchOut, 422), summary="Search by name")
def search(
    services: ServicesDep,
    principal: Viewer,
    q: Annotated[
        str,
        Query(
            min_length=1,
            max_length=100,
            description="Text to find, in upper or lower case; every character stands for itself.",
            examples=["dock"],
        ),
    ],
    limit: Annotated[int, Query(ge=1, le=100, description="Maximum number of items.")] = 20,
) -> Response:
    """Find environments by name and title, and nodes, zones and objects by name and id.

    Searched are the accessible environments, in the version of `production` if this channel exists, else in the newest
    one. Order: equal names and ids, then prefixes, then other parts; in each environments, nodes, zones, objects, by
    the text that matches. Of more than 1000 that match in the middle of their name or id, some are chosen.
    """
    text = q.strip()
    if not text or not text.isprintable():
        raise Invalid(
            "q must have visible characters, and no control characters",
            [Problem("must have visible characters, and no control characters", where="q")],
        )
    hits, truncated = services.store.search.find(text, limit=limit, allowed=principal.environments)
    items = [
        {
            "kind": hit.kind,
            "environment": hit.environment,
            "version": hit.version,
            "id": hit.id,
            "name": hit.name,
            "level": hit.level,
            "where": hit.position,
            "title": hit.title,
        }
        for hit in hits
    ]
    return json_response({"items": items, "truncated": truncated})
