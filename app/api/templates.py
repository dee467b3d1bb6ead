"""Templates: what formats ask for and no layer has, by named sets and for each environment."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import Path, Query
from pydantic import BaseModel, ConfigDict, Field
from starlette.responses import Response

from app import formats, templates
from app.api.http.auth import Viewer
from app.api.http.dependencies import CommitDep, Services, ServicesDep
from app.api.http.parameters import parse_version_ref
from app.api.http.responses import api_router, commit_response, json_response, version_headers
from app.api.http.schemas import (
    MAX_TEXT,
    VERSION,
    EnvironmentPath,
    RequestModel,
    VersionOut,
    problem_responses,
)
from app.formats import Format
from app.ingest import CommitRequest, TemplateUpdate
from app.model.templates import FormatTemplate, Templates


class FormatTemplatesBody(RequestModel):
    """What is filled in where the format asks for more than the layers have."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"values": {"action": "NavigateToPose", "xy_goal_tolerance": 0.4}}]},
    )

    set: str | None = Field(None, max_length=100, description="Another set than the environment's; see `/templates`.")
    values: dict[str, Any] = Field(
        default_factory=dict, max_length=100, description="By parameter of the format, as `/formats` lists them."
    )
    message: str = Field("", max_length=MAX_TEXT)
    dry_run: bool = Field(False, description="Only say what would be.")


class OwnTemplatesBody(RequestModel):
    """One format's templates among others."""

    set: str | None = Field(None, max_length=100)
    values: dict[str, Any] = Field(default_factory=dict, max_length=100)


class TemplatesBody(RequestModel):
    """The set of an environment, and values for several formats at once."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [{"set": "outdoor", "formats": {"tmap2": {"values": {"xy_goal_tolerance": 0.4}}}}]
        },
    )

    set: str | None = Field(None, max_length=100, description="A set's name; left out: it stays.")
    formats: dict[str, OwnTemplatesBody] = Field(
        default_factory=dict, max_length=100, description="What is said of these, instead of all that was."
    )
    message: str = Field("", max_length=MAX_TEXT)
    dry_run: bool = Field(False, description="Only say what would be.")


class TemplateSetOut(BaseModel):
    """A named set of values, by format and parameter."""

    name: str
    title: str
    formats: dict[str, dict[str, Any]]


class FormatTemplateOut(BaseModel):
    """One format's templates. ``set``: where it is another than the environment's. ``ignored``: what was kept once and
    this release cannot use."""

    format: str
    set: str | None
    values: dict[str, Any]
    effective: dict[str, dict[str, Any]]
    ignored: list[str] | None = None


class FormatTemplatesOut(FormatTemplateOut):
    """A format's templates in a version of an environment."""

    environment: str
    version: int


class TemplatesOut(BaseModel):
    """A version's templates."""

    environment: str
    version: int
    set: str
    sets: list[str]
    formats: list[FormatTemplateOut]


router = api_router("templates")

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
    return json_response(body, headers=version_headers(stored_version))


@router.put("/environments/{env}/templates", status_code=201, responses=CHANGED, summary="Choose a template set")
def put_templates(env: EnvironmentPath, body: TemplatesBody, services: ServicesDep, commit: CommitDep) -> Response:
    """A version in which another set holds, or other values of several formats at once. What is left out stays."""
    format_templates = {name: FormatTemplate(template.set, template.values) for name, template in body.formats.items()}
    update = TemplateUpdate(body.set, format_templates, dry_run=body.dry_run).validated()
    return _commit_templates(services, env, update, commit.with_message(body.message))


@router.delete("/environments/{env}/templates", status_code=201, responses=CHANGED, summary="Take all templates back")
def delete_templates(
    env: EnvironmentPath,
    services: ServicesDep,
    commit: CommitDep,
    message: Message = "",
    dry_run: DryRun = False,
) -> Response:
    """A version in which the formats' own defaults hold."""
    update = TemplateUpdate(clear=True, dry_run=dry_run)
    return _commit_templates(services, env, update, commit.with_message(message))


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
    return json_response(body, headers=version_headers(stored_version))


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
    commit: CommitDep,
) -> Response:
    """A version with these values of the format's parameters, instead of all that was said of the format before.

    Maps of the new version are made with them; old versions keep answering as they did.
    """
    update = TemplateUpdate(None, {format: FormatTemplate(body.set, body.values)}, dry_run=body.dry_run).validated(
        "body"
    )
    return _commit_templates(services, env, update, commit.with_message(body.message))


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
    commit: CommitDep,
    message: Message = "",
    dry_run: DryRun = False,
) -> Response:
    """A version in which the environment's set holds for the format again."""
    update = TemplateUpdate(None, {format: FormatTemplate()}, dry_run=dry_run).validated()
    return _commit_templates(services, env, update, commit.with_message(message))


def _commit_templates(
    services: Services,
    env: str,
    update: TemplateUpdate,
    commit: CommitRequest,
) -> Response:
    return commit_response(services.ingest.template(env, update, commit))


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
