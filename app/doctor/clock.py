"""Checks of the clock."""

from __future__ import annotations

from collections.abc import Iterator
from email.utils import parsedate_to_datetime

from app.doctor.registry import Finding, check, error, ok, warning
from app.doctor.site import Site

MAX_OFFSET_SECONDS = 60.0
"""Difference of clocks in seconds from which on tokens, links and manifests end visibly too early or too late."""

FEW_SECONDS = 3.0
SYNCHRONISE = "make a time service run on both machines (chrony, systemd-timesyncd): `timedatectl`"


@check
def clock(site: Site) -> Iterator[Finding]:
    """Compare this machine's clock with those of the database and the server, and look for a time service."""
    synchronised = site.clock_state()
    if synchronised is False:
        advice = "start a time service (chrony, systemd-timesyncd), or set one up in the local network"
        yield warning("no time service keeps this machine's clock right", "", advice)
    elif synchronised:
        yield ok("a time service keeps this machine's clock right")
    offset = site.store.clock_offset() if site.has_database else None
    if offset is not None:
        yield _compare("the database's clock", offset, "PostgreSQL")
    if site.server is not None:
        answer = site.fetch("/healthz")
        date = parsedate_to_datetime(answer.headers["date"])
        # the header has whole seconds: half of one on average is the rounding
        yield _compare("the server's clock", (date - site.now()).total_seconds() + 0.5, site.server)
    if synchronised is None and offset is None and site.server is None:
        yield ok("nothing to compare this machine's clock with")


def _compare(name: str, offset: float, place: str) -> Finding:
    detail = f"{name} is {abs(offset):.1f} s {'ahead of' if offset > 0 else 'behind'} this machine's"
    if abs(offset) > MAX_OFFSET_SECONDS:
        return error(detail, place, SYNCHRONISE)
    return warning(detail, place, SYNCHRONISE) if abs(offset) > FEW_SECONDS else ok(detail, place)
