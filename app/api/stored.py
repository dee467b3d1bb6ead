"""Stored bytes by hash, for another server that has lost them (``fleetmap verify --repair --from URL``)."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import Path, Request
from starlette.responses import Response

from app.api.http.auth import ServerAdmin
from app.api.http.dependencies import ServicesDep
from app.api.http.responses import api_router
from app.api.http.schemas import problem_responses
from app.api.http.streams import IN_MEMORY, raw_response, stream_file
from app.errors import Damaged, NotFound

TYPE = "application/octet-stream"

router = api_router("stored data", "/stored")


@router.get(
    "/{kind}/{sha256}",
    response_class=Response,
    responses={
        200: {"description": "The bytes", "content": {TYPE: {}}},
        **problem_responses(None, 404),
    },
    summary="Get stored bytes by their hash",
)
def stored(
    kind: Annotated[
        Literal["blobs", "chunks"],
        Path(description="Uploaded files, or chunks of versions.", examples=["blobs"]),
    ],
    sha256: Annotated[str, Path(pattern="^[0-9a-f]{64}$", description="SHA-256 of the bytes in hex.")],
    request: Request,
    services: ServicesDep,
    _: ServerAdmin,
) -> Response:
    """Return stored bytes, with which another server of the same data can repair itself.

    Requires an administrator's token for all environments.
    """
    try:
        if kind == "blobs" and (size := services.store.blobs.size(sha256)) > IN_MEMORY:
            headers = [(b"content-type", TYPE.encode()), (b"content-length", str(size).encode())]
            if request.scope["state"].get("head"):
                return raw_response(200, headers)
            return stream_file(services.store.blobs.open(sha256), 0, size, 200, headers)
        data = services.store.blobs.get(sha256) if kind == "blobs" else services.store.chunks.read(sha256)
    except Damaged as error:  # a chunk that never existed looks like a lost one
        raise NotFound(f"no {kind} with this hash: {sha256}") from error
    return Response(data, media_type=TYPE)
