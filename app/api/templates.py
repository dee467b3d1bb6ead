"""Templates: what formats ask for and no layer has, by named sets and for each environment."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Path, Query
from starlette.responses import Response

from app import formats, templates
from app.api.auth import Editor, Principal, Viewer
from app.api.dependencies import Services, ServicesDep
from app.api.maps import parse_version_ref
from app.api.responses import StrictRoute, json_response
from app.api.schemas import (
    MAX_TEXT,
    VERSION,
    EnvironmentPath,
    FormatTemplatesBody,
    FormatTemplatesOut,
    IdempotencyKey,
    IfMatch,
    TemplatesBody,
    TemplateSetOut,
    TemplatesOut,
    VersionOut,
    problem_responses,
)
from app.api.versions import commit_response
from app.formats import Format
from app.ingest import TemplateUpdate
from app.model.templates import FormatTemplate, Templates
from app.store.values import Version

router = APIRouter(tags=["templates"], route_class=StrictRoute)

FormatPath = Annotated[
    str, Path(max_length=64, description="A format's id; see `GET /api/v1/formats`.", examples=["tmap2"])
]
TemplateVersion = Annotated[
    str, Query(alias="version", pattern=VERSION, description="Number, channel, or `latest`.", examples=["latest"])
]
Message = Annotated[str, Query(max_length=MAX_TEXT, description="Why, for the history.")]
DryRun = Annotated[bool, Query(description="Only say what would be.")]

CHANGED: dict[int | str, dict[str, Any]] = {
    **problem_responses(VersionOut, 400, 404, 409, 412, 415, ok=201, description="A new version"),
    200: {"model": VersionOut, "description": "Nothing changed: the head. Or a dry run: `version` is null."},
}


@router.get("/templates", responses=problem_responses(list[TemplateSetOut]), summary="All template sets")
def list_sets(_: Viewer) -> Response:
    """Named sets of values for parameters of formats. What one does not say is left to the format's defaults."""
    return json_response(sets())


def sets() -> list[dict[str, Any]]:
    """The named sets as clients see them."""
    return [one.as_dict(name) for name, one in templates.SETS.items()]


@router.get(
    "/environments/{env}/templates",
    responses=problem_responses(TemplatesOut, 404),
    summary="An environment's templates",
)
def get_templates(
    env: EnvironmentPath, services: ServicesDep, _: Viewer, version: TemplateVersion = "latest"
) -> Response:
    """The chosen set, and for each format with parameters the values of its own, what holds, and from where.

    A parameter of a request goes before the environment's values, these before the set's, these before the format's
    defaults.
    """
    stored_version = services.store.versions.get(env, parse_version_ref(version))
    fmts = [f for f in formats.all_formats().values() if f.write is not None and templates.has_parameters(f)]
    body = {
        "environment": env,
        "version": stored_version.number,
        "set": stored_version.templates.set,
        "sets": list(templates.SETS),
        "formats": [_line(stored_version.templates, one) for one in fmts],
    }
    return json_response(body, headers=_headers(stored_version))


@router.put("/environments/{env}/templates", status_code=201, responses=CHANGED, summary="Choose a template set")
def put_templates(
    env: EnvironmentPath,
    body: TemplatesBody,
    services: ServicesDep,
    principal: Editor,
    if_match: IfMatch = None,
    idempotency_key: IdempotencyKey = None,
) -> Response:
    """A version in which another set holds, or other values of several formats at once. What is left out stays."""
    format_templates = {name: FormatTemplate(template.set, template.values) for name, template in body.formats.items()}
    update = TemplateUpdate(body.set, format_templates, dry_run=body.dry_run).validated()
    return _commit_templates(services, env, update, body.message, principal, if_match, idempotency_key)


@router.delete("/environments/{env}/templates", status_code=201, responses=CHANGED, summary="Take all templates back")
def delete_templates(
    env: EnvironmentPath,
    services: ServicesDep,
    principal: Editor,
    message: Message = "",
    dry_run: DryRun = False,
    if_match: IfMatch = None,
    idempotency_key: IdempotencyKey = None,
) -> Response:
    """A version in which the formats' own defaults hold."""
    update = TemplateUpdate(clear=True, dry_run=dry_run)
    return _commit_templates(services, env, update, message, principal, if_match, idempotency_key)


@router.get(
    "/environments/{env}/templates/{format}",
    responses=problem_responses(FormatTemplatesOut, 404),
    summary="An environment's templates for a format",
)
def get_format_templates(
    env: EnvironmentPath, format: FormatPath, services: ServicesDep, _: Viewer, version: TemplateVersion = "latest"
) -> Response:
    """`values`: the environment's own. `effective`: each parameter's value, and `from`: `environment`, `set NAME` or
    `default`."""
    fmt = templates.check_format(format)
    stored_version = services.store.versions.get(env, parse_version_ref(version))
    body = {"environment": env, "version": stored_version.number, **_line(stored_version.templates, fmt)}
    return json_response(body, headers=_headers(stored_version))


@router.put(
    "/environments/{env}/templates/{format}",
    status_code=201,
    responses=CHANGED,
    summary="Set an environment's templates for a format",
)
def put_format_templates(
    env: EnvironmentPath,
    format: FormatPath,
    body: FormatTemplatesBody,
    services: ServicesDep,
    principal: Editor,
    if_match: IfMatch = None,
    idempotency_key: IdempotencyKey = None,
) -> Response:
    """A version with these values of the format's parameters, instead of all that was said of the format before.

    Maps of the new version are made with them; old versions keep answering as they did.
    """
    update = TemplateUpdate(None, {format: FormatTemplate(body.set, body.values)}, dry_run=body.dry_run).validated(
        "body"
    )
    return _commit_templates(services, env, update, body.message, principal, if_match, idempotency_key)


@router.delete(
    "/environments/{env}/templates/{format}",
    status_code=201,
    responses=CHANGED,
    summary="Take an environment's templates for a format back",
)
def delete_format_templates(
    env: EnvironmentPath,
    format: FormatPath,
    services: ServicesDep,
    principal: Editor,
    message: Message = "",
    dry_run: DryRun = False,
    if_match: IfMatch = None,
    idempotency_key: IdempotencyKey = None,
) -> Response:
    """A version in which the environment's set holds for the format again."""
    update = TemplateUpdate(None, {format: FormatTemplate()}, dry_run=dry_run).validated()
    return _commit_templates(services, env, update, message, principal, if_match, idempotency_key)


def _commit_templates(
    services: Services,
    env: str,
    update: TemplateUpdate,
    message: str,
    principal: Principal,
    if_match: str | None,
    key: str | None,
) -> Response:
    outcome = services.ingest.template(
        env, update, message=message, author=principal.name, if_match=if_match, idempotency=key
    )
    return commit_response(outcome)


def _line(stored_templates: Templates, fmt: Format) -> dict[str, Any]:
    """One format's templates as clients see them."""
    format_template, ignored = stored_templates.for_format(fmt.name), templates.resolve(stored_templates, fmt).ignored
    return {
        "format": fmt.name,
        "set": format_template.set,
        "values": dict(format_template.values),
        "effective": templates.effective(stored_templates, fmt),
        **({"ignored": list(ignored)} if ignored else {}),
    }


def _headers(version: Version) -> dict[str, str]:
    number = str(version.number)
    return {"etag": f'"{number}"', "fleetmap-version": number, "fleetmap-root": version.root}
