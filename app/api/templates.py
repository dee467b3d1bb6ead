"""Templates: values that formats need and no layer provides, as named sets and per environment."""

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
    UNCHANGED_OR_DRY_RUN,
    VERSION,
    DryRun,
    EnvironmentPath,
    RequestModel,
    VersionOut,
    problem_responses,
)
from app.formats import Format
from app.ingest import CommitRequest, TemplateUpdate
from app.model.templates import FormatTemplate, Templates


class FormatTemplatesBody(RequestModel):
    """Values for one format, filled in if the layers lack them."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"values": {"action": "NavigateToPose", "xy_goal_tolerance": 0.4}}]},
    )

    set: str | None = Field(
        None,
        max_length=100,
        description="Another set than the environment's for this format; see `GET /api/v1/templates`.",
    )
    values: dict[str, Any] = Field(
        default_factory=dict,
        max_length=100,
        description="Values by parameter of the format; see `GET /api/v1/formats`.",
    )
    message: str = Field("", max_length=MAX_TEXT)
    dry_run: DryRun = False


class OwnTemplatesBody(RequestModel):
    """Values for one format of several."""

    set: str | None = Field(None, max_length=100)
    values: dict[str, Any] = Field(default_factory=dict, max_length=100)


class TemplatesBody(RequestModel):
    """Template set of an environment, and values for several formats."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [{"set": "outdoor", "formats": {"tmap2": {"values": {"xy_goal_tolerance": 0.4}}}}]
        },
    )

    set: str | None = Field(None, max_length=100, description="Name of a set. Default: unchanged.")
    formats: dict[str, OwnTemplatesBody] = Field(
        default_factory=dict,
        max_length=100,
        description="Values of these formats, which replace their previous values.",
    )
    message: str = Field("", max_length=MAX_TEXT)
    dry_run: DryRun = False


class TemplateSetOut(BaseModel):
    """Named set of values, by format and parameter."""

    name: str
    title: str
    formats: dict[str, dict[str, Any]]


class FormatTemplateOut(BaseModel):
    """Templates of one format.

    `set`: set of this format, if it differs from the environment's. `ignored`: stored parameters that this release
    cannot use.
    """

    format: str
    set: str | None
    values: dict[str, Any]
    effective: dict[str, dict[str, Any]]
    ignored: list[str] | None = None


class FormatTemplatesOut(FormatTemplateOut):
    """Templates of a format in a version of an environment."""

    environment: str
    version: int


class TemplatesOut(BaseModel):
    """Templates of a version."""

    environment: str
    version: int
    set: str
    sets: list[str]
    formats: list[FormatTemplateOut]


router = api_router("templates")

FormatPath = Annotated[
    str, Path(max_length=64, description="Id of a format; see `GET /api/v1/formats`.", examples=["tmap2"])
]
TemplateVersion = Annotated[
    str,
    Query(alias="version", pattern=VERSION, description="Version: number, channel, or `latest`.", examples=["latest"]),
]
DryRunQuery = Annotated[DryRun, Query()]
Message = Annotated[str, Query(max_length=MAX_TEXT, description="Reason of the change, for the history.")]

CHANGED: dict[int | str, dict[str, Any]] = {
    **problem_responses(VersionOut, 400, 404, 409, 412, 415, ok=201, description="A new version"),
    **UNCHANGED_OR_DRY_RUN,
}


@router.get("/templates", responses=problem_responses(list[TemplateSetOut]), summary="List template sets")
def list_sets(_: Viewer) -> Response:
    """List the named sets of values for parameters of formats.

    Parameters that a set does not define have the defaults of the format.
    """
    return json_response(sets())


def sets() -> list[dict[str, Any]]:
    """Convert the named sets to JSON."""
    return [one.as_dict(name) for name, one in templates.SETS.items()]


@router.get(
    "/environments/{env}/templates",
    responses=problem_responses(TemplatesOut, 404),
    summary="Get an environment's templates",
)
def get_templates(
    env: EnvironmentPath, services: ServicesDep, _: Viewer, version: TemplateVersion = "latest"
) -> Response:
    """Return the template set, and for each format its own and its effective values with their origin.

    Precedence: parameters of a request, values of the environment, values of the set, defaults of the format.
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


@router.put(
    "/environments/{env}/templates", status_code=201, responses=CHANGED, summary="Set an environment's templates"
)
def put_templates(env: EnvironmentPath, body: TemplatesBody, services: ServicesDep, commit: CommitDep) -> Response:
    """Create a version with another template set, or with other values of several formats.

    Omitted formats keep their values.
    """
    format_templates = {name: FormatTemplate(template.set, template.values) for name, template in body.formats.items()}
    update = TemplateUpdate(body.set, format_templates).validated()
    return _commit_templates(services, env, update, commit.with_message(body.message).as_dry_run(body.dry_run))


@router.delete("/environments/{env}/templates", status_code=201, responses=CHANGED, summary="Reset all templates")
def delete_templates(
    env: EnvironmentPath,
    services: ServicesDep,
    commit: CommitDep,
    message: Message = "",
    dry_run: DryRunQuery = False,
) -> Response:
    """Create a version without templates: the formats' own defaults apply."""
    update = TemplateUpdate(clear=True)
    return _commit_templates(services, env, update, commit.with_message(message).as_dry_run(dry_run))


@router.get(
    "/environments/{env}/templates/{format}",
    responses=problem_responses(FormatTemplatesOut, 404),
    summary="Get a format's templates",
)
def get_format_templates(
    env: EnvironmentPath, format: FormatPath, services: ServicesDep, _: Viewer, version: TemplateVersion = "latest"
) -> Response:
    """Return the templates of a format.

    `values`: the environment's own. `effective`: each parameter's value, and `from`: `environment`, `set NAME` or
    `default`.
    """
    fmt = templates.check_format(format)
    stored_version = services.store.versions.get(env, parse_version_ref(version))
    body = {"environment": env, "version": stored_version.number, **_line(stored_version.templates, fmt)}
    return json_response(body, headers=version_headers(stored_version))


@router.put(
    "/environments/{env}/templates/{format}",
    status_code=201,
    responses=CHANGED,
    summary="Set a format's templates",
)
def put_format_templates(
    env: EnvironmentPath,
    format: FormatPath,
    body: FormatTemplatesBody,
    services: ServicesDep,
    commit: CommitDep,
) -> Response:
    """Create a version with these values of the format's parameters. They replace all previous values of the format.

    Maps of the new version use them; maps of old versions do not change.
    """
    update = TemplateUpdate(None, {format: FormatTemplate(body.set, body.values)}).validated("body")
    return _commit_templates(services, env, update, commit.with_message(body.message).as_dry_run(body.dry_run))


@router.delete(
    "/environments/{env}/templates/{format}",
    status_code=201,
    responses=CHANGED,
    summary="Reset a format's template",
)
def delete_format_templates(
    env: EnvironmentPath,
    format: FormatPath,
    services: ServicesDep,
    commit: CommitDep,
    message: Message = "",
    dry_run: DryRunQuery = False,
) -> Response:
    """Create a version in which the environment's template set applies to the format again."""
    update = TemplateUpdate(None, {format: FormatTemplate()}).validated()
    return _commit_templates(services, env, update, commit.with_message(message).as_dry_run(dry_run))


def _commit_templates(
    services: Services,
    env: str,
    update: TemplateUpdate,
    commit: CommitRequest,
) -> Response:
    return commit_response(services.ingest.template(env, update, commit))


def _line(stored_templates: Templates, fmt: Format) -> dict[str, Any]:
    """Convert a format's templates to JSON."""
    format_template, ignored = stored_templates.for_format(fmt.name), templates.resolve(stored_templates, fmt).ignored
    return {
        "format": fmt.name,
        "set": format_template.set,
        "values": dict(format_template.values),
        "effective": templates.effective(stored_templates, fmt),
        **({"ignored": list(ignored)} if ignored else {}),
    }
