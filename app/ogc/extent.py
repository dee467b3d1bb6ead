"""Place of a version on earth, without reading its content."""

from __future__ import annotations

from starlette.concurrency import run_in_threadpool

from app.convert.extents import bounds_in_both_frames
from app.ogc.service import Service
from app.store.extent import join
from app.store.values import Box, PartEntry


def part_box(service: Service, entry: PartEntry) -> Box | None:
    """Return the box in degrees around a part, None without coordinates."""
    return bounds_in_both_frames(entry, service.version.datum, service.services.tiles.header).get("wgs84")


async def site_box(service: Service) -> Box | None:
    """Return the box in degrees around a version with a datum, None without coordinates."""
    return await run_in_threadpool(_site_box, service)


def _site_box(service: Service) -> Box | None:
    if service.version.datum is None:
        return None
    boxes = [part_box(service, entry) for entry in service.version.parts if entry.key.layer != "resources"]
    return join([box for box in boxes if box is not None], service.version.datum.longitude)
