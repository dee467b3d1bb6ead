"""``fleetmap retention``: thin old versions and remove old uploads by a rule, or tell what it would do."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager, nullcontext
from dataclasses import replace
from datetime import timedelta
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from app.cli import local, options, output
from app.cli.verify import BlobUrl, DatabaseUrl, DataDir
from app.errors import Conflict, Invalid

if TYPE_CHECKING:
    from app.config import Settings
    from app.store.retention import EnvironmentPlan
    from app.store.retention_rule import Rule
    from app.store.store import Store

ALONE_SECONDS: Final = 5.0
"""Maximum time until the database is connected, and leads of a server that was killed are free."""


def retention(
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Tell what would be removed; change nothing.")] = False,
    all_days: Annotated[
        int | None, typer.Option("--all-days", help="Days of which all versions stay [default: the setting].")
    ] = None,
    daily_days: Annotated[
        int | None, typer.Option("--daily-days", help="Days of which one version a day stays [default: the setting].")
    ] = None,
    last: Annotated[
        int | None, typer.Option("--last", help="Number of the newest versions that stay [default: the setting].")
    ] = None,
    source_days: Annotated[
        int | None, typer.Option("--source-days", help="Days after which uploads that the layers contain go.")
    ] = None,
    now: Annotated[
        bool, typer.Option("--now", help="Remove the content at once, not after 6 hours; no server or worker may run.")
    ] = False,
    database_url: DatabaseUrl = None,
    data_dir: DataDir = None,
    blob_url: BlobUrl = None,
    as_json: options.Json = False,
) -> None:
    """Thin old versions by a rule: all of some days, one a day for longer.

    Versions stay whatever the rule if they are tagged, on a channel or planned for one, the last before it, held by a
    robot, or the base of a draft. A thinned version keeps its entry in the history; its content is removed by the
    server's daily collection, 6 hours later or more, so that nobody who reads it is disturbed. The rule is that of the
    settings FLEETMAP_RETENTION_…, by which a server thins every day.

    Example: `fleetmap retention --dry-run --all-days 30`
    """
    local.require_server_python("retention")
    from app.cli.server import load_settings
    from app.formats import writable_formats
    from app.main import open_store

    if dry_run and now:
        raise typer.BadParameter("--dry-run and --now cannot be combined")
    settings = load_settings({"database_url": database_url, "data_dir": data_dir, "blob_url": blob_url})
    rule = _rule(settings, all_days, daily_days, last, source_days)
    with closing(open_store(settings, readonly=dry_run)) as store, _alone(settings) if now else nullcontext():
        store.check()
        plans = list(store.retention.plan(rule, writable_formats()))
        removable, before = store.garbage.removable_bytes(plans)
        result: dict[str, Any] = {"rule": rule.text, "dry_run": dry_run, "stored_bytes": before}
        if dry_run:
            result |= {"removable_bytes": removable, "environments": [plan.as_dict() for plan in plans]}
        else:
            result["environments"] = [_apply(store, plan, rule) for plan in plans]
            if now:
                store.garbage.collect(timedelta(0))
            removable, after = store.garbage.removable_bytes()
            result |= {"removable_bytes": removable, "stored_bytes_after": after}
    if as_json:
        output.show_json(result)
    else:
        _show(result)


def _rule(
    settings: Settings, all_days: int | None, daily_days: int | None, last: int | None, source_days: int | None
) -> Rule:
    """Return the rule of the settings with these changes. Raises Invalid if there is none, or if it is unsafe."""
    from app.store.retention_rule import Rule

    rule = settings.retention
    if rule is None:
        if all_days is None:
            raise Invalid(
                "there is no rule, so everything stays: set FLEETMAP_RETENTION_ALL_DAYS, or use --all-days, for "
                "example 30"
            )
        kept = settings.retention_daily_days, settings.retention_last, settings.retention_source_days
        rule = Rule(all_days, *kept)
    given = {"all_days": all_days, "daily_days": daily_days, "last": last, "source_days": source_days}
    rule = replace(rule, **{name: value for name, value in given.items() if value is not None})
    rule.check()
    return rule


@contextmanager
def _alone(settings: Settings) -> Iterator[None]:
    """Keep servers and backups away: they may still read what is removed at once. Raises Conflict if one runs."""
    from app.backends.lead import open_leads
    from app.store.garbage_collection import CONTENT_LEAD

    with closing(open_leads(settings.direct_database, settings.data_dir)) as leads:
        leads.start()
        housekeeping = leads.lead("housekeeping").acquire(ALONE_SECONDS)
        if housekeeping is None:
            raise Conflict("a server uses this data: stop it, or omit --now")
        content = leads.lead(CONTENT_LEAD).acquire(ALONE_SECONDS)
        if content is None:
            raise Conflict("a backup of this data is running: wait until it has ended, or omit --now")
        with housekeeping.fenced(), content.fenced():
            yield


def _apply(store: Store, plan: EnvironmentPlan, rule: Rule) -> dict[str, Any]:
    versions: list[int] = []
    files = 0
    with output.progress_bar(f"thinning {plan.environment}"):
        for removed in store.retention.apply(plan, rule):
            versions += removed.versions
            files += removed.files
    return {**plan.as_dict(), "thinned": versions, "files": files}


def _show(result: dict[str, Any]) -> None:
    would = "would be " if result["dry_run"] else ""
    output.print_result(f"rule: {result['rule']}")
    for item in result["environments"]:
        kept = ", ".join(f"{number} {reason}" for reason, number in sorted(item["kept"].items()))
        files = f", {item['files']} files of kept versions" if item["files"] else ""
        output.print_result(
            f"{item['environment']}: {len(item['thinned'])} versions {would}thinned{files}; stay: {kept}"
        )
    output.print_result(f"stored: {_megabytes(result['stored_bytes'])}")
    if "stored_bytes_after" in result:
        output.print_result(f"stored now: {_megabytes(result['stored_bytes_after'])}")
    when = "" if result["dry_run"] else " by the daily collection of the server, after 6 hours"
    output.print_result(f"removable: {_megabytes(result['removable_bytes'])}{when}")


def _megabytes(size: int) -> str:
    return f"{size / 1e6:.1f} MB"
