"""Conversion of files without storing them."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from typing import Any

import orjson
from fastapi import Request
from pydantic import ValidationError
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from app import formats, parameters
from app.api.environments import parse_datum
from app.api.http.auth import Editor
from app.api.http.caching import content_disposition
from app.api.http.dependencies import Services, ServicesDep
from app.api.http.forms import FormFields
from app.api.http.parameters import numbers
from app.api.http.problems import UnsupportedMedia
from app.api.http.responses import api_router, json_response
from app.api.http.schemas import DatumBody, problem_responses
from app.api.http.uploads import UploadForm
from app.convert.files import Converted
from app.convert.worker import media_type, zip_files
from app.errors import Invalid, Problem
from app.ingest.service import check_file_names, check_grid_name
from app.model.frame import Datum
from app.model.names import did_you_mean
from app.upload_reader import DRAWN_LAYERS

router = api_router("formats")

_BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "required": ["files", "to"],
                    "properties": {
                        "files": {"type": "array", "items": {"type": "string", "format": "binary"}},
                        "to": {"type": "string", "description": "Id of the output format."},
                        "datum": {
                            "type": "string",
                            "description": (
                                "`LAT,LON` or JSON. Default: the south-west corner of geographic coordinates in "
                                "the files."
                            ),
                        },
                        "format": {
                            "type": "string",
                            "description": "Id of the files' format. Default: detected from the content.",
                        },
                        "layer": {"type": "string", "enum": list(DRAWN_LAYERS)},
                        "level": {"type": "string", "default": "ground"},
                        "grid": {"type": "string", "description": "Name for an uploaded grid."},
                        "report": {
                            "type": "boolean",
                            "default": False,
                            "description": "Return only the report: derived, filled-in and dropped information.",
                        },
                    },
                    "additionalProperties": {"type": "string", "description": "Options of the output format."},
                },
                "examples": {"datum": {"value": {"files": ["datum.yaml"], "to": "kml"}}},
            }
        },
    }
}


@router.post(
    "/convert",
    response_class=Response,
    responses={
        **problem_responses(None, 400, 404, 409, 413, 415, 422, 503),
        200: {
            "description": "The file, or a zip if there are several",
            "content": {"application/octet-stream": {}, "application/zip": {}, "application/json": {}},
        },
    },
    summary="Convert files without storing them",
    openapi_extra=_BODY,
)
async def convert(request: Request, services: ServicesDep, _: Editor) -> Response:
    """Convert the files of the request to another format. The header `Fleetmap-Warnings` counts the warnings."""
    media = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if media != "multipart/form-data":
        raise UnsupportedMedia("unsupported media type: send the files as multipart/form-data")
    async with services.intake.receive(request) as form:
        return await run_in_threadpool(_convert, services, form)


def _convert(services: Services, form: UploadForm) -> Response:
    form_fields = FormFields(form)
    to = form_fields.take_format("to")
    if to is None:
        raise Invalid("missing field 'to': set it to the id of the output format", [Problem("missing", where="to")])
    fmt = formats.get_format(to)
    if not form.files:
        raise Invalid(
            "no file in the upload: send at least one in the field 'files'", [Problem("missing", where="files")]
        )
    check_file_names(form.files)
    hints = form_fields.take_hints()
    datum = _datum(form_fields.take("datum"))
    only_report = form_fields.take_flag("report")
    check_grid_name(hints.grid)
    fields = form_fields.take_rest()
    written = {p["name"] for p in parameters.describe(fmt.write_options)}
    read = {p["name"] for f in formats.all_formats().values() if f.read for p in parameters.describe(f.read_options)}
    for name in fields.keys() - written - read:
        accepted = ", ".join(sorted(written)) or "none"
        detail = f"unknown parameter {name[:80]!r} of {to}{did_you_mean(name, written | read)}; accepted: {accepted}"
        raise Invalid(detail, [Problem(f"unknown; accepted: {accepted}", where=name[:80])])
    hints = replace(hints, options={k: v for k, v in fields.items() if k not in written})
    values = {k: v for k, v in fields.items() if k in written}
    done = services.maps.convert({f.name: f.path for f in form.files}, to, hints=hints, datum=datum, options=values)
    return _answer(done, to, only_report)


def _answer(done: Converted, to: str, only_report: bool) -> Response:
    fmt = formats.get_format(to)
    headers = {"fleetmap-warnings": str(len(done.report.warnings))}
    if only_report:
        files = [
            {"name": name, "size": len(data), "sha256": hashlib.sha256(data).hexdigest()}
            for name, data in done.files.items()
        ]
        return json_response({**done.report.as_dict(), "files": files}, headers=headers)
    if len(done.files) == 1:
        name, data = next(iter(done.files.items()))
        kind = media_type(fmt, name)
    else:
        name, data, kind = f"{to}.zip", zip_files(done.files), "application/zip"
    return Response(data, headers={**headers, "content-disposition": content_disposition(name)}, media_type=kind)


def _datum(text: str) -> Datum | None:
    """Parse ``LAT,LON`` or a JSON object with latitude and longitude."""
    if not text:
        return None
    if text.lstrip().startswith("{"):
        try:
            return parse_datum(DatumBody.model_validate(orjson.loads(text)))
        except (orjson.JSONDecodeError, ValidationError):
            raise Invalid(
                'datum must be LAT,LON or {"latitude": …, "longitude": …, "altitude"?, "heading"?} in degrees',
                [Problem("invalid datum", where="datum")],
            ) from None
    latitude, longitude = numbers(text, "datum", "LAT,LON")
    return Datum(latitude, longitude)
