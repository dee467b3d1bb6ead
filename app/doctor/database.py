"""Checks of the database, the stored files and their backup."""

from __future__ import annotations

import os
from collections.abc import Iterator
from datetime import timedelta

from app.backends.blob_s3 import S3Files
from app.backends.s3_faults import Fault
from app.doctor.disks import FREE
from app.doctor.registry import Finding, check, error, human_size, ok, warning
from app.doctor.site import Site
from app.errors import DatabaseDamaged, FleetMapError, NoRoom
from app.store.database import REPAIR
from app.store.scrub import current_state, figures

MAX_PAGES_BYTES = 2**30
"""Maximum size in bytes of an SQLite file whose pages are checked here: reading a larger one takes too long."""

OLD_SCRUB = timedelta(days=14)
OLD_BACKUP = timedelta(days=2)
FIRST_START = (
    "start the server: it creates it; if it has run before, pass the server's own settings (--data-dir, its variables)"
)


@check
def database(site: Site) -> Iterator[Finding]:
    """Look whether the database answers, is intact, and has a schema for this release."""
    place = _without_password(site)
    if not site.has_database:
        yield warning("there is no database yet", place, FIRST_START)
        return
    try:
        versions = site.store.database_versions()
    except FleetMapError as failure:
        yield error(failure.detail, place, _advice(site, failure))
        return
    yield ok("answers: " + ", ".join(f"{name} {version}" for name, version in versions.items()), place)
    if versions.get("PostGIS") == "missing":
        advice = "install PostGIS 3, and run as a superuser in this database: CREATE EXTENSION postgis"
        yield warning("the database has no PostGIS", place, advice)
    try:
        site.store.check()
    except FleetMapError as failure:
        yield error(failure.detail, place, "its reason says which release or command; back up before a migration")
    else:
        yield ok("the schema suits this release", place)


def _advice(site: Site, failure: FleetMapError) -> str:
    """Say what to do with a database that does not answer."""
    if site.database_file is None:
        return "start the database; check address, user and password (FLEETMAP_DATABASE_URL) and the network"
    if isinstance(failure, DatabaseDamaged):
        return f"{REPAIR}; or set the right file with --data-dir or FLEETMAP_DATABASE_URL"
    return f"let the user of the server (now number {os.getuid()}) read and write the file and its folder (chown)"


@check
def database_pages(site: Site) -> Iterator[Finding]:
    """Check the pages of an SQLite file of moderate size."""
    file = site.database_file
    if file is None or not file.exists():
        yield ok("no SQLite file: PostgreSQL checks its pages itself" if file is None else "no file yet")
        return
    size = file.stat().st_size
    if size > MAX_PAGES_BYTES:
        yield ok(f"not checked, since it has {human_size(size)}: `fleetmap verify` does that", str(file))
        return
    problem = site.store.integrity()
    if problem is None:
        yield ok("all pages are intact", str(file))
    else:
        yield error(problem, str(file), "stop the server, run `fleetmap verify`, and restore a backup of the database")


@check
def stored_files(site: Site) -> Iterator[Finding]:
    """Look whether the blob store can be written, by a small file."""
    place = site.settings.blob_url or str(site.settings.blob_dir)
    if not place.startswith("s3://") and not site.settings.blob_dir.is_dir():
        yield warning("the folder of stored files does not exist yet", place, FIRST_START)
        return
    if not site.has_database:
        yield ok("not checked without a database", place)
        return
    if place.startswith("s3://"):
        yield from _bucket_findings(site, place)
        return
    try:
        site.store.blobs.files.check()
    except FleetMapError as failure:
        yield error(failure.detail, place, _folder_advice(failure))
    else:
        yield ok("can be written", place)


def _bucket_findings(site: Site, place: str) -> Iterator[Finding]:
    """Say what is wrong with a store of files in S3, each reason once."""
    if site.endpoint_fault is not None:
        yield error(site.endpoint_fault.reason, place, site.endpoint_fault.advice)
        return
    files = site.store.blobs.files
    assert isinstance(files, S3Files)
    faults: dict[Fault, list[str]] = {}
    for done, fault in files.find_faults():
        faults.setdefault(fault, []).append(done)
    for fault, denied in faults.items():
        yield error(f"the bucket cannot be {' or '.join(denied)}: {fault.reason}", place, fault.advice)
    if not faults:
        yield ok("can be written, read, listed and emptied", place)


def _folder_advice(failure: FleetMapError) -> str:
    """Say what to do with a folder of files that cannot be written."""
    if isinstance(failure, NoRoom):
        return FREE
    return f"let the user of the server, who runs this, write it and all below: chown -R {os.getuid()} (check folders)"


@check
def stored_data(site: Site) -> Iterator[Finding]:
    """Look at the last background check of all stored data."""
    if not site.has_database:
        yield ok("not checked without a database")
        return
    state = figures(current_state(site.store))
    damage = {kind: count for kind, count in state["findings"].items() if count and kind != "cache"}
    if damage:
        listed = ", ".join(f"{count} {kind}s" for kind, count in damage.items())
        advice = "run `fleetmap verify`, which lists the versions, then `fleetmap verify --repair`"
        yield error(f"stored data is damaged: {listed}", "", advice)
    hours = site.settings.scrub_hours
    if not hours:
        advice = "set it, or run `fleetmap verify` regularly"
        yield warning("stored data is never checked in the background", "FLEETMAP_SCRUB_HOURS=0", advice)
    elif state["completed"] and state["age"] > max(OLD_SCRUB.total_seconds(), 2 * hours * 3600):
        days = state["age"] / 86_400
        advice = "see the log for `scrub:`, or raise FLEETMAP_SCRUB_BYTES_PER_SECOND"
        yield warning(f"the last check of stored data ended {days:.0f} days ago", "", advice)
    elif not damage:
        age = f"{state['age'] / 86_400:.1f} days ago" if state["completed"] else "not yet"
        yield ok(f"no damage known; last complete check: {age}")


@check
def backup(site: Site) -> Iterator[Finding]:
    """Look at the age of the last backup."""
    if not site.has_database:
        yield ok("nothing to back up yet")
        return
    last, failures = site.store.backups.last(), site.store.backups.failures()
    advice = "run `fleetmap backup`, and schedule it daily"
    if last is None:
        yield warning("no backup is known", "", advice)
    elif site.now() - last.finished > OLD_BACKUP:
        yield warning(f"the last backup is {(site.now() - last.finished).days} days old", last.destination, advice)
    else:
        yield ok(f"the last backup ended {last.finished:%Y-%m-%d %H:%M} UTC")
    if failures.last is not None:
        yield warning(f"{failures.count} backups failed since: {failures.last[1]}", "", "repair it, and back up")


def _without_password(site: Site) -> str:
    from sqlalchemy import make_url

    return make_url(site.settings.database).render_as_string(hide_password=True)
