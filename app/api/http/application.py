"""FastAPI application that serves cached responses first and builds its own OpenAPI document."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI
from starlette.types import Receive, Scope, Send

from app.api.http import openapi
from app.api.http.response_cache import ResponseCache


class FleetMapApp(FastAPI):
    """FastAPI with a response cache in front. response_cache: None until the services are open."""

    response_cache: ResponseCache | None = None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve a repeated request for a map from memory; pass all others on."""
        if self.response_cache is not None and scope["type"] == "http" and scope["method"] in ("GET", "HEAD"):
            reply = self.response_cache.reply(scope)
            if reply is not None:
                await send(reply[0])
                await send(reply[1])
                return
        await super().__call__(scope, receive, send)

    def openapi(self) -> dict[str, Any]:
        """Return the OpenAPI document, built on first use."""
        if self.openapi_schema is None:
            self.openapi_schema = openapi.build(self)
        return self.openapi_schema
