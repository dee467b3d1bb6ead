"""The service of a draft, at an address of its own: the one that GIS programs can write to."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Final

from fastapi import Path, Request

from app.api.http.auth import Editor, Principal
from app.api.http.dependencies import Services, ServicesDep
from app.api.http.schemas import EnvironmentPath
from app.errors import Conflict
from app.ogc.service import Service, service_at
from app.store.values import DRAFT_PREFIX, LATEST, Draft

PERSONAL: Final = "mine"
"""Name of the draft at ``/ogc/{env}/drafts/mine``: each caller has one of their own, made by the first write."""

DRAFT: Final = "/ogc/{env}/drafts/{draft}"

OgcDraftPath = Annotated[
    str,
    Path(
        pattern=r"^([0-9a-f]{16}|mine)$",
        description="Id of the draft; or `mine`: your draft of this name, which the first write creates.",
        examples=[PERSONAL],
    ),
]


def draft_service(
    env: EnvironmentPath, draft: OgcDraftPath, request: Request, services: ServicesDep, principal: Editor
) -> Service:
    """Return the service of a draft; of the head for ``mine`` before the first write."""
    ref = LATEST
    if draft != PERSONAL:
        ref = DRAFT_PREFIX + draft
    elif (existing := services.store.drafts.find(env, principal.as_writer(), PERSONAL)) is not None:
        ref = existing.ref
    return replace(service_at(request, services, env, ref, f"/ogc/{env}/drafts/{draft}"), draft=draft)


def own_draft(services: Services, env: str, draft: str, principal: Principal) -> Draft:
    """Return the draft to write; ``mine`` is created if it does not exist."""
    if draft != PERSONAL:
        return services.store.drafts.get(env, draft)
    owner = principal.as_writer()
    existing = services.store.drafts.find(env, owner, PERSONAL)
    if existing is not None:
        return existing
    try:
        return services.store.drafts.create(env, owner, PERSONAL)
    except Conflict:
        existing = services.store.drafts.find(env, owner, PERSONAL)  # made by another request meanwhile
        if existing is None:
            raise
        return existing
