"""Overlays: robots report what is blocked, editors decide on it; each step is an event (``overlay.…``)."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from functools import partial
from typing import Annotated, Any, Literal

import shapely
from fastapi import APIRouter, Query
from starlette.responses import Response

from app.api.access import Editor, Reporter, Viewer
from app.api.answers import Route, answer
from app.api.schemas import EnvironmentPath, OverlayBody, OverlayOut, OverlayPath, told
from app.api.services import Here, Services
from app.errors import Conflict, FleetMapError, Invalid, MissingDatum, Problem
from app.fleet import overlays
from app.ingest.edits import edit_changes, shape_of
from app.model.frame import GROUND
from app.store.values import Overlay, rfc3339

log = logging.getLogger(__name__)

MAX_POINTS = 1000
"""Of a reported polygon: it goes to every robot in an event."""

router = APIRouter(prefix="/environments/{env}/overlays", tags=["overlays"], route_class=Route)


@router.get("", responses=told(list[OverlayOut], 404), summary="What is reported as blocked")
def list_overlays(
    env: EnvironmentPath,
    here: Here,
    _: Viewer,
    state: Annotated[
        Literal["pending", "accepted", "rejected", "expired", "ended"] | None,
        Query(description="Only these; left out: all of the last 30 days."),
    ] = None,
) -> Response:
    """Oldest first. `pending` waits for a decision, `expired` was never decided on, `ended` was taken out again."""
    return answer([overlay.as_dict() for overlay in here.store.overlays(env, state)])


@router.post(
    "",
    status_code=201,
    responses={
        **told(OverlayOut, 400, 404, 409, 415, ok=201, description="It waits for a decision"),
        200: {"model": OverlayOut, "description": "The same was reported before: its end has moved."},
    },
    summary="Report what is blocked",
)
def report_overlay(env: EnvironmentPath, body: OverlayBody, here: Here, who: Reporter) -> Response:
    """A robot (or an editor) says that a polygon or an edge cannot be passed for a time. No map changes by that."""
    if (body.polygon is None) == (body.edge is None):
        raise Invalid("give polygon or edge, one of them", [Problem("one of polygon and edge", where="body")])
    head = here.store.version(env)
    now = datetime.now(UTC)
    crs = None if body.polygon is None else body.crs or ("wgs84" if head.datum else "local")
    if crs == "wgs84" and head.datum is None:
        raise MissingDatum(
            f"{env} has no datum, so degrees have no place in its maps: give the polygon in local metres"
        )
    level = body.level or GROUND
    if body.edge is not None:
        level = overlays.edge_of(here.store, head, body.edge)[0].level
    elif level not in (names := [known.name for known in head.levels]):
        known = ", ".join(names)[:500]
        raise Invalid(f"{env} has no level {level[:80]!r}; it has {known}", [Problem("no such level", where="level")])
    wanted = Overlay(
        environment=env,
        kind=body.kind,
        level=level,
        polygon=None if body.polygon is None else _polygon(body.polygon),
        edge=body.edge,
        crs=crs,
        detail=body.detail,
        reporter=who.robot or who.name,
        created=now,
        expires=now + timedelta(seconds=body.ttl_seconds),
    )
    if changes := overlays.accepting(here.store, head, wanted):
        edit_changes(here.store, head, changes)  # Invalid now, not for the editor
    overlay, new = here.store.add_overlay(wanted)
    return answer(overlay.as_dict(), 201 if new else 200)


def _polygon(given: Mapping[str, Any]) -> dict[str, Any]:
    """The GeoJSON geometry and nothing else that came with it: all robots are told of it."""
    shape = shape_of(given)
    if (count := int(shapely.get_num_coordinates(shape))) > MAX_POINTS:
        problem = f"has {count} points, at most {MAX_POINTS} are taken: send its outline with fewer"
        raise Invalid(f"the polygon {problem}", [Problem(problem, where="body.polygon")])
    clean: dict[str, Any] = json.loads(shapely.to_geojson(shape))
    return clean


@router.post(
    "/{id}/accept", responses=told(OverlayOut, 404, 409, 412, 422, 503), summary="Take an overlay into a version"
)
def accept_overlay(env: EnvironmentPath, id: OverlayPath, here: Here, who: Editor) -> Response:
    """A polygon becomes a zone of kind `keepout` with `expires`, an edge gets `blocked` and `blocked_until`: a version.
    When its time is over it is taken out again, by a version as well.
    """
    now = datetime.now(UTC)
    known = here.store.overlay(env, id)
    if known.state == "pending" and known.expires <= now:
        raise Conflict(f"the overlay {id} has expired")
    if not (known.state == "accepted" and known.version is None):  # else a crash came between this and the version
        known = here.store.decide_overlay(env, id, "pending", "accepted", who.name, now)
    try:
        version = _edit(here, known, ending=False, author=who.name)
    except FleetMapError:
        # It may be in the map all the same: another editor was at it too, or the database's answer was lost.
        if not overlays.ending(here.store, here.store.version(env), known):
            here.store.decide_overlay(env, id, "accepted", "pending", who.name, now)
        raise
    return answer(here.store.note_overlay_version(env, id, version).as_dict())


@router.post("/{id}/reject", responses=told(OverlayOut, 404, 409), summary="Reject an overlay")
def reject_overlay(env: EnvironmentPath, id: OverlayPath, here: Here, who: Editor) -> Response:
    """It stays in the list, and nothing changes."""
    decided = here.store.decide_overlay(env, id, "pending", "rejected", who.name, datetime.now(UTC))
    return answer(decided.as_dict())


def _edit(here: Services, overlay: Overlay, *, ending: bool, author: str) -> int:
    """The version that an overlay is in, or is out of; the same one where this is done twice."""
    edits = partial(overlays.ending if ending else overlays.accepting, here.store)
    what = f"edge {overlay.edge}" if overlay.edge is not None else "a polygon"
    message = f"{what} is free again" if ending else f"{what} is blocked until {rfc3339(overlay.expires)}"
    outcome = here.ingest.amend(
        overlay.environment,
        lambda head: edits(head, overlay),
        message=f"{message} (reported by {overlay.reporter})",
        author=author,
    )
    assert outcome.version is not None
    return outcome.version.number


def end_overlays(here: Services, now: datetime) -> None:
    """What is blocked no longer: pending overlays expire, accepted ones are taken out of the map. Blocks."""
    for overlay in here.store.expire_overlays(now):
        try:
            _edit(here, overlay, ending=True, author=overlay.decided_by or "")
            here.store.decide_overlay(
                overlay.environment, overlay.id, "accepted", "ended", overlay.decided_by or "", now
            )
        except Conflict:
            continue  # another process was quicker
        except FleetMapError as error:
            log.warning("the overlay %s of %s cannot be ended: %s", overlay.id, overlay.environment, error.detail)
