"""Webhooks: addresses that get each event, signed."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any

from fastapi import Path
from pydantic import BaseModel, ConfigDict, Field
from starlette.responses import Response

from app.api.http.auth import ServerAdmin
from app.api.http.dependencies import ServicesDep
from app.api.http.responses import api_router, json_response
from app.api.http.schemas import RequestModel, problem_responses
from app.events import webhooks as delivery
from app.events.outgoing import check_url
from app.store.values import rfc3339
from app.store.webhooks import Attempts, Webhook

MAX_LISTED = 100
"""Maximum number of environments that a list shows for each webhook."""


class WebhookBody(RequestModel):
    """A new webhook."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "url": "https://hooks.example.org/fleet",
                    "environments": "farm*",
                    "types": ["version.created", "channel.moved"],
                }
            ]
        },
    )

    url: str = Field(
        min_length=1,
        max_length=2000,
        description="Address that gets events by POST: https and public, or in `FLEETMAP_WEBHOOK_NETWORKS`.",
    )
    secret: str | None = Field(
        None,
        max_length=200,
        description="Key of the signatures: `whsec_` and the base64 of 24 to 64 random bytes. Default: a random one.",
    )
    environments: str | None = Field(
        None,
        min_length=1,
        max_length=200,
        description="Name pattern (`farm-*`) of the environments whose events are sent. Default: all.",
    )
    types: list[str] | None = Field(
        None, min_length=1, max_length=100, description="Types of the events that are sent. Default: all."
    )


class FailureOut(BaseModel):
    """Failed attempts since the last success."""

    failures: int
    failing_since: datetime | None
    next_try: datetime | None = Field(description="null: at once.")
    error: str | None = Field(description="Why the last attempt failed.")


class WaitingEnvironmentOut(FailureOut):
    """An environment whose events wait because the receiver refused the next one."""

    environment: str


class WebhookOut(FailureOut):
    """A webhook without its secret."""

    id: str
    url: str
    environments: str | None
    types: list[str] | None
    created: datetime
    delivered: datetime | None = Field(description="Time of the last delivered event; null: none so far.")
    waiting: int = Field(description="Number of events that are still to be delivered; 1000: that many or more.")
    refused: list[WaitingEnvironmentOut] = Field(description="At most 100 environments.")


class NewWebhookOut(WebhookOut):
    """New webhook with its secret, which is returned only once."""

    secret: str


class TestOut(BaseModel):
    """Result of a test message."""

    delivered: bool
    status: int | None = Field(description="Status of the receiver's response; null: there was none.")
    detail: str | None = Field(description="Why it was not delivered.")
    seconds: float


WebhookPath = Annotated[str, Path(max_length=100, description="Id of the webhook.")]

router = api_router("webhooks", "/webhooks")


def _attempts(attempts: Attempts) -> dict[str, Any]:
    return {
        "failures": attempts.failures,
        "failing_since": rfc3339(attempts.since) if attempts.since else None,
        "next_try": rfc3339(attempts.next_try) if attempts.next_try else None,
        "error": attempts.error,
    }


def _as_dict(webhook: Webhook, services: ServicesDep) -> dict[str, Any]:
    stored = services.store.webhooks
    lags = stored.lags(webhook.id)[:MAX_LISTED]
    return {
        "id": webhook.id,
        "url": webhook.url,
        "environments": webhook.environments,
        "types": webhook.types,
        "created": rfc3339(webhook.created),
        "delivered": rfc3339(webhook.delivered) if webhook.delivered else None,
        "waiting": stored.count_waiting(webhook),
        **_attempts(webhook.attempts),
        "refused": [{"environment": lag.environment, **_attempts(lag.attempts)} for lag in lags],
    }


@router.get("", responses=problem_responses(list[WebhookOut]), summary="List webhooks")
def list_webhooks(services: ServicesDep, _: ServerAdmin) -> Response:
    """List the webhooks, oldest first: what waits for delivery, why, and when it is tried again.

    A receiver that is not reached, or is overloaded (429, 502, 503, 504), waits as a whole. One that refuses an event
    with another status delays only the environment of that event (`refused`).
    """
    return json_response([_as_dict(webhook, services) for webhook in services.store.webhooks.all()])


@router.post(
    "",
    status_code=201,
    responses=problem_responses(NewWebhookOut, 400, 409, 415, ok=201, description="The webhook"),
    summary="Create a webhook",
)
def create_webhook(body: WebhookBody, services: ServicesDep, _: ServerAdmin) -> Response:
    """Create a webhook that gets the events from now on. Its secret is only in this response.

    The body of a request is the event as in `GET /events`, signed as Standard Webhooks: `webhook-id` (the same in each
    attempt), `webhook-timestamp`, `webhook-signature`. Any status 2xx acknowledges it.
    """
    url = check_url(body.url, services.options.webhooks)
    webhook = services.store.webhooks.create(url, body.secret, body.environments, body.types)
    answer = {**_as_dict(webhook, services), "secret": webhook.secret}
    return json_response(answer, 201, {"cache-control": "no-store"})


@router.delete("/{id}", status_code=204, responses=problem_responses(None, 404), summary="Delete a webhook")
def delete_webhook(id: WebhookPath, services: ServicesDep, _: ServerAdmin) -> Response:
    """Delete a webhook; events that wait are not sent any more."""
    services.store.webhooks.delete(id)
    return Response(status_code=204)


@router.post("/{id}/test", responses=problem_responses(TestOut, 404), summary="Test a webhook")
def send_test_message(id: WebhookPath, services: ServicesDep, _: ServerAdmin) -> Response:
    """Send a message of the type `webhook.test` now; return how it went.

    If it is delivered, events that wait are tried again at once.
    """
    webhook = services.store.webhooks.get(id)
    attempt, seconds = delivery.send_test(webhook, services.options.webhooks)
    delivered = attempt.outcome == "delivered"
    if delivered:
        services.store.webhooks.retry_now(id)
    answer = {"delivered": delivered, "status": attempt.status, "detail": attempt.detail, "seconds": round(seconds, 3)}
    return json_response(answer)
