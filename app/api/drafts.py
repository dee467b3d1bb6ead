"""Drafts: named working versions, which edits gather in until they are reviewed and committed as one version."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal

import orjson
from fastapi import Path
from pydantic import BaseModel, ConfigDict, Field
from starlette.responses import Response

from app.api.http.auth import Editor, Principal
from app.api.http.dependencies import CommitDep, ServicesDep
from app.api.http.problems import MEDIA_TYPE, document
from app.api.http.responses import api_path, api_router, commit_response, json_response
from app.api.http.schemas import (
    MAX_TEXT,
    EnvironmentPath,
    IfMatch,
    ProblemOut,
    RequestModel,
    VersionOut,
    component_schemas,
    problem_responses,
)
from app.api.versions import Change
from app.ingest import RebaseResult
from app.store.drafts import LIFETIME, MAX_NAME
from app.store.values import Draft


class DraftCreateBody(RequestModel):
    """New draft with the content of the head."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"name": "new lanes"}]})

    name: str | None = Field(
        None, min_length=1, max_length=MAX_NAME, description="Name, unique among yours. Default: `draft 1`, `draft 2` …"
    )


class DraftEditsBody(RequestModel):
    """Changes to a draft that are made together, or not at all, as in `POST …/edits`."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "changes": [
                        {
                            "op": "put",
                            "layer": "topology",
                            "feature": {
                                "type": "Feature",
                                "id": "well",
                                "geometry": {"type": "Point", "coordinates": [5.6135, 52.4207]},
                                "properties": {"kind": "node", "name": "well"},
                            },
                        }
                    ]
                }
            ]
        },
    )

    changes: list[Change] = Field(min_length=1, max_length=100_000)


class RebaseBody(RequestModel):
    """How to put a draft on top of the head."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"prefer": "draft"}]})

    prefer: Literal["draft", "head"] | None = Field(
        None, description="Side that wins where both changed the same. Default: such places are conflicts."
    )


class DraftCommitBody(RequestModel):
    """Reason of the new version."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"message": "lanes of the new shed"}]})

    message: str = Field("", max_length=MAX_TEXT, description="Default: the name of the draft.")


class DraftOut(BaseModel):
    """Working version of an environment, which nobody but its readers by id sees until it is committed."""

    id: str = Field(examples=["0123456789abcdef"])
    version: str = Field(
        description="Name by which it can be read like a version of its environment.",
        examples=["draft:0123456789abcdef"],
    )
    environment: str
    name: str
    owner: str = Field(description="Name of the token that made it.")
    is_owner: bool = Field(description="Whether your token made it. Only its owner and administrators may change it.")
    base: int = Field(description="Number of the version that it was made from or rebased on.")
    head: int = Field(description="Number of the environment's newest version.")
    behind: bool = Field(description="Whether `head` is newer than `base`: rebase it before you commit it.")
    revision: int = Field(description="Rises with every edit.")
    created: datetime
    changed: datetime = Field(description="Time of the last edit.")
    expires: datetime = Field(description=f"Time when it is removed: {LIFETIME.days} days after the last edit.")
    changes: dict[str, Any] = Field(description="Counts of changes against `base`, by layer, as those of a version.")


class ConflictOut(BaseModel):
    """What a draft and the head changed differently since the draft's base."""

    layer: str
    level: str
    part: str = Field(description="Name of the part; `site` for a datum.")
    id: str | None = Field(description="Id of the feature; null for a grid or the datum.")
    fields: list[str] = Field(
        description="Properties, `geometry`, `source`, `target`, `deleted`; `cells` or `grid`; `datum`."
    )
    reason: str


class RebaseConflictsOut(ProblemOut):
    """Refused rebase: nothing was changed."""

    conflicts: list[ConflictOut] = Field(description="At most 1000.")


MAX_CONFLICTS = 1000

DraftPath = Annotated[str, Path(pattern=r"^[0-9a-f]{16}$", description="Id of the draft.")]

router = api_router("drafts", "/environments/{env}/drafts")


@router.get("", responses=problem_responses(list[DraftOut], 404), summary="List drafts")
def list_drafts(env: EnvironmentPath, services: ServicesDep, principal: Editor) -> Response:
    """List the drafts of an environment, of all editors, last edited first."""
    return json_response([_as_json(draft, principal) for draft in services.store.drafts.all(env)])


@router.post(
    "",
    status_code=201,
    responses=problem_responses(DraftOut, 400, 404, 409, ok=201, description="A new draft"),
    summary="Create a draft",
)
def create_draft(env: EnvironmentPath, body: DraftCreateBody, services: ServicesDep, principal: Editor) -> Response:
    """Create a draft with the content of the head.

    An environment has at most 200 drafts, and each changes at most 100 000 features.
    """
    draft = services.store.drafts.create(env, principal.as_writer(), body.name)
    location = api_path("environments", env, "drafts", draft.id)
    return json_response(_as_json(draft, principal), 201, {**_headers(draft), "location": location})


@router.get("/{draft}", responses=problem_responses(DraftOut, 404), summary="Get a draft")
def get_draft(env: EnvironmentPath, draft: DraftPath, services: ServicesDep, principal: Editor) -> Response:
    """Return a draft. Its content is read like that of a version, by the name in `version`."""
    return _response(services.store.drafts.get(env, draft), principal)


@router.delete("/{draft}", status_code=204, responses=problem_responses(None, 404), summary="Delete a draft")
def delete_draft(env: EnvironmentPath, draft: DraftPath, services: ServicesDep, principal: Editor) -> Response:
    """Delete a draft with its changes."""
    services.ingest.drafts.delete(env, draft, principal.as_writer())
    return Response(status_code=204)


@router.post(
    "/{draft}/edits",
    responses=problem_responses(DraftOut, 400, 404, 409, 412, 413, 415),
    summary="Edit a draft",
)
def edit_draft(
    env: EnvironmentPath,
    draft: DraftPath,
    body: DraftEditsBody,
    services: ServicesDep,
    principal: Editor,
    if_match: IfMatch = None,
) -> Response:
    """Put or delete features and set cells in a draft, all or none, as `POST …/edits` does in the environment.

    `If-Match` may name the draft's `ETag`, so that an edit of another content is refused with 412. Without it
    concurrent edits are all kept.
    """
    changes = [change.model_dump(exclude_none=True) for change in body.changes]
    return _response(services.ingest.drafts.edit(env, draft, changes, principal.as_writer(), if_match), principal)


@router.post(
    "/{draft}/rebase",
    responses=problem_responses(DraftOut, 400, 404, 409, 412, 415),
    summary="Rebase a draft",
    openapi_extra=component_schemas(RebaseConflictsOut),
)
def rebase_draft(
    env: EnvironmentPath,
    draft: DraftPath,
    body: RebaseBody,
    services: ServicesDep,
    principal: Editor,
    if_match: IfMatch = None,
) -> Response:
    """Put a draft's changes on top of the head, by a merge of single properties, shapes and cells.

    What both changed differently since the draft's base is a conflict (409, as `RebaseConflictsOut`), and nothing
    changes: edit these places of the draft, or give `prefer`. Edges that would lose a node are conflicts in any case.
    """
    result = services.ingest.drafts.rebase(env, draft, principal.as_writer(), if_match, body.prefer)
    return _conflicts(result) if result.conflicts else _response(result.draft, principal)


@router.post(
    "/{draft}/commit",
    status_code=201,
    responses=problem_responses(VersionOut, 400, 404, 409, 412, 415, ok=201, description="A new version"),
    summary="Commit a draft",
)
def commit_draft(
    env: EnvironmentPath,
    draft: DraftPath,
    body: DraftCommitBody,
    services: ServicesDep,
    principal: Editor,
    commit: CommitDep,
) -> Response:
    """Make a draft one version, and remove the draft.

    Returns 412 if the head is not the draft's `base`: rebase the draft first. `If-Match` names the head, as for every
    change of an environment.
    """
    described = commit.with_message(body.message)
    return commit_response(services.ingest.commit_draft(env, draft, principal.as_writer(), described))


def _as_json(draft: Draft, principal: Principal) -> dict[str, Any]:
    return {**draft.as_dict(), "is_owner": draft.owner_id == principal.id}


def _headers(draft: Draft) -> dict[str, str]:
    return {"etag": f'"{draft.tag}"'}


def _response(draft: Draft, principal: Principal) -> Response:
    return json_response(_as_json(draft, principal), headers=_headers(draft))


def _conflicts(result: RebaseResult) -> Response:
    places = [f"{c.layer} {c.id or c.part} ({', '.join(c.fields)})" for c in result.conflicts]
    more = f" and {len(places) - 5} more" if len(places) > 5 else ""
    detail = (
        f"the draft and version {result.draft.head} changed the same differently: {'; '.join(places[:5])}{more}; edit "
        "these places of the draft, or give prefer"
    )
    body = document(409, detail, title="Conflict", type_="urn:fleetmap:problem:conflict")
    body["conflicts"] = [conflict.as_dict() for conflict in result.conflicts[:MAX_CONFLICTS]]
    return Response(orjson.dumps(body), 409, {"cache-control": "no-store"}, MEDIA_TYPE)
