"""``fleetmap backup`` and ``fleetmap restore``: copies of all that a server stores, and their way back."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from app.cli import local, options, output
from app.errors import Invalid

if TYPE_CHECKING:
    from app.backup.check import PlaceCheck
    from app.backup.repository import Repository, SnapshotList
    from app.backup.service import BackupResult
    from app.config import Settings
    from app.signing import SigningKeys
    from app.store.store import Store

NICENESS = 10
"""How much a backup stands back behind the server for processors."""

DatabaseUrl = Annotated[str | None, typer.Option("--database-url", help="Database [default: FLEETMAP_DATABASE_URL].")]
DataDir = Annotated[
    Path | None, typer.Option("--data-dir", help="Data folder of the server [default: FLEETMAP_DATA_DIR].")
]
BlobUrl = Annotated[
    str | None, typer.Option("--blob-url", help="Folder or s3:// address of stored files [default: FLEETMAP_BLOB_URL].")
]
Identity = Annotated[
    Path | None, typer.Option("--identity", metavar="FILE", help="File with the age identity of encrypted backups.")
]


def backup(
    place: Annotated[
        str, typer.Argument(metavar="DEST", help="Folder, single file NAME.tar, or s3://bucket/prefix (with AWS_*).")
    ],
    keys: Annotated[
        bool, typer.Option("--keys", help="Include the signing keys: whoever reads them can sign maps.")
    ] = False,
    recipients: Annotated[
        list[str] | None,
        typer.Option("--recipient", metavar="age1…", help="Encrypt with age to this recipient; repeatable."),
    ] = None,
    keep: Annotated[
        str | None,
        typer.Option(
            "--keep",
            metavar="RULE",
            help="Then remove older backups: 30d keeps all of 30 days; 7d/90d/2y all of 7 days, one a day of 90 days, "
            "one a month of 2 years. Days and months without a backup are not counted.",
        ),
    ] = None,
    show_list: Annotated[bool, typer.Option("--list", help="List the backups in DEST; write none.")] = False,
    verify: Annotated[
        bool, typer.Option("--verify", help="Read all backups in DEST and compare every hash; write none.")
    ] = False,
    identity: Identity = None,
    database_url: DatabaseUrl = None,
    data_dir: DataDir = None,
    blob_url: BlobUrl = None,
    as_json: options.Json = False,
) -> None:
    """Back up all that is stored, while the server runs.

    In a folder or bucket a backup adds only what has changed, and many backups share their content. A backup exists
    when it is complete: one that is interrupted leaves nothing that could be restored by mistake. Everything is
    compared with its hash when it is read. Garbage collection waits until the end. Keys are left out without --keys.

    Exit status: 0 if everything stored is in the backup, 1 otherwise.

    Example: `fleetmap backup /mnt/backup/fleetmap --keep 30d/1y`
    """
    local.require_server_python("backup")
    if show_list and verify:
        raise typer.BadParameter("--list and --verify cannot be combined")
    _stand_back()  # before imports, which take seconds
    settings = _settings(database_url, data_dir, blob_url)
    if show_list or verify:
        with _opened(settings, place, identity) as repository:
            if show_list:
                _show_list(repository.snapshots(), as_json=as_json)
            else:
                _verify(repository, as_json=as_json)
        return
    from app.backup.retention import parse_rule
    from app.backup.service import BackupOptions

    rule = None if keep is None else parse_rule(keep)
    chosen = BackupOptions(tuple(recipients or ()), _identities(identity), rule)
    result = _back_up(settings, place, chosen, keys=keys)
    if as_json:
        output.show_json(_as_dict(result))
    else:
        _show(result)
    if result.snapshot.damaged:
        raise typer.Exit(1)


def _stand_back() -> None:
    """Let this process's files be read by its user only, and the server go first."""
    os.umask(0o077)
    os.nice(NICENESS)


def _back_up(settings: Settings, place: str, chosen: Any, *, keys: bool) -> BackupResult:
    from app.backends.lead import open_leads
    from app.backup.keys import collect_keys
    from app.backup.service import BackupService

    _require_database(settings)
    with _store(settings) as store, closing(open_leads(settings.direct_database, settings.data_dir)) as leads:
        store.check()
        leads.start()
        mounted = _mounted(settings)
        if keys and mounted is not None:
            output.print_status(
                f"the signing key is in {settings.signing_key}, which is not in the backup: keep a copy of it",
                style="yellow",
            )
        bundle = collect_keys(store, settings.data_dir / "keys", mounted, include=keys)
        with output.progress_bar("backing up", count_bytes=True) as bar:
            return BackupService(store, leads).back_up(place, bundle, chosen, bar.advance)
    raise AssertionError("unreachable")


def restore(
    source: Annotated[
        str | None, typer.Argument(metavar="SOURCE", help="Where the backups are, as for `fleetmap backup`.")
    ] = None,
    snapshot: Annotated[
        str | None, typer.Option("--snapshot", metavar="ID", help="Begin of the backup's id [default: the newest].")
    ] = None,
    identity: Identity = None,
    raise_epoch: Annotated[
        bool,
        typer.Option(
            "--raise-epoch", help="Restore nothing: let robots accept a database that was restored otherwise."
        ),
    ] = False,
    database_url: DatabaseUrl = None,
    data_dir: DataDir = None,
    blob_url: BlobUrl = None,
    as_json: options.Json = False,
) -> None:
    """Restore a backup into an empty place, on SQLite or PostgreSQL, whichever the backup is of.

    Everything is checked before a server may use it. A restore that is interrupted leaves a place that servers refuse;
    run it again. Afterwards the server's epoch is higher, so that robots accept the restored maps. Keys are restored if
    the backup has them and the place has none.

    Example: `fleetmap restore /mnt/backup/fleetmap --data-dir data`
    """
    local.require_server_python("restore")
    if raise_epoch == (source is not None):
        raise typer.BadParameter("pass either SOURCE or --raise-epoch")
    settings = _settings(database_url, data_dir, blob_url)
    if source is None:
        _require_database(settings)
        with _store(settings) as store:
            store.check()
            epoch = store.raise_epoch()
        if as_json:
            output.show_json({"epoch": epoch})
        else:
            output.print_result(f"epoch {epoch}: robots accept what the server has now")
        return
    _restore(settings, source, snapshot, identity, as_json=as_json)


def _restore(settings: Settings, source: str, snapshot: str | None, identity: Path | None, *, as_json: bool) -> None:
    from app.backup.keys import SIGNING, key_documents, place_keys
    from app.backup.service import choose_restorable
    from app.backup.service import restore as restore_from
    from app.main import create_folders
    from app.signing import exported_key_ids

    folder = settings.data_dir / "keys"
    with _opened(settings, source, identity) as repository:
        chosen = choose_restorable(repository, snapshot)  # before anything is created
        create_folders(settings)
        with _store(settings) as store:
            present = key_documents(store, folder)
            mounted = _mounted(settings)
            ids = [key.id for key in mounted.public()] if mounted is not None else []
            if not ids and SIGNING in present:
                ids = exported_key_ids(present[SIGNING])

            def place(documents: Mapping[str, bytes]) -> None:
                place_keys(store, folder, documents)

            with output.progress_bar("restoring", count_bytes=True) as bar:
                result = restore_from(
                    store, repository, chosen, present_keys=ids, place_keys=place, progress=bar.advance
                )
    restored = result.snapshot
    if as_json:
        output.show_json(
            {
                "snapshot": restored.id,
                "started": restored.started.isoformat(),
                "epoch": result.epoch,
                "rows": result.rows,
                "checked": result.verification.checked,
                "keys": restored.keys or bool(ids),
                "damaged": list(restored.damaged),
            }
        )
        return
    counts = ", ".join(f"{count} {kind}s" for kind, count in result.verification.checked.items() if kind != "database")
    output.print_result(f"restored backup {restored.id}: {result.rows} rows, checked {counts}; epoch {result.epoch}")
    if restored.damaged:
        output.print_status(f"{len(restored.damaged)} objects were damaged before the backup", style="yellow")
    if not restored.keys and not ids:
        output.print_status(
            "the backup has no keys: put the server's folder keys back, or robots must trust its new key",
            style="yellow",
        )


def _settings(database_url: str | None, data_dir: Path | None, blob_url: str | None) -> Settings:
    from app.cli.server import load_settings

    return load_settings({"database_url": database_url, "data_dir": data_dir, "blob_url": blob_url})


def _store(settings: Settings) -> closing[Store]:
    from app.main import open_store

    return closing(open_store(settings))


def _mounted(settings: Settings) -> SigningKeys | None:
    from app.signing import MountedKeys

    return None if settings.signing_key is None else MountedKeys(settings.signing_key)


def _identities(identity: Path | None) -> tuple[str, ...]:
    from app.backup.encryption import read_identities

    return () if identity is None else tuple(read_identities(identity))


def _require_database(settings: Settings) -> None:
    """Raise Invalid if SQLite's file is missing, which opening would create."""
    from sqlalchemy.engine import make_url

    url = make_url(settings.database)
    if url.get_backend_name() == "sqlite" and not Path(url.database or "").is_file():
        raise Invalid(f"database {url.database} not found: set the server's data folder with --data-dir")


@contextmanager
def _opened(settings: Settings, place: str, identity: Path | None) -> Iterator[Repository]:
    """Open a place of backups for reading, by the key of this machine's server if it writes there."""
    import tempfile

    from app.backup.service import opened_place

    with (
        tempfile.TemporaryDirectory(prefix="fleetmap-") as scratch,
        opened_place(
            place, Path(scratch), key=lambda id_: _known_key(settings, id_), identities=_identities(identity)
        ) as repository,
    ):
        yield repository


def _known_key(settings: Settings, id_: str) -> bytes | None:
    """Return the key of a place if this machine has the server that writes there."""
    from app.errors import FleetMapError

    try:
        _require_database(settings)
        with _store(settings) as store:
            store.check()
            known_place = store.backups.place(id_)
    except FleetMapError:
        return None
    return None if known_place is None else known_place.key


def _show_list(listed: SnapshotList, *, as_json: bool) -> None:
    if as_json:
        members = ("id", "started", "finished", "release", "revision", "database", "keys", "written")
        rows = [{**{m: s.as_dict()[m] for m in members}, "bytes": s.size} for s in listed.intact]
        output.show_json({"backups": rows, "broken": listed.broken})
    else:
        table = [
            (s.id, s.started.strftime("%Y-%m-%d %H:%M:%S"), _size(s.size), _size(s.written), "yes" if s.keys else "no")
            for s in listed.intact
        ]
        output.show_table(("backup", "of (UTC)", "size", "added", "keys"), table)
        for problem in listed.broken.values():
            output.print_status(problem, style="yellow")
    if listed.broken:
        raise typer.Exit(1)


def _verify(repository: Repository, *, as_json: bool) -> None:
    from app.backup.service import verify_place

    with output.progress_bar("checking", count_bytes=True) as bar:
        check: PlaceCheck = verify_place(repository, bar.advance)
    if as_json:
        problems = [{"problem": text, "backups": list(ids)} for text, ids in check.problems]
        members = {"backups": check.snapshots, "packs": check.packs, "bytes": check.size, "problems": problems}
        output.show_json({"ok": not problems, **members})
    else:
        output.print_result(f"checked: {check.snapshots} backups, {check.packs} packs, {_size(check.size)}")
        for text, ids in check.problems:
            output.print_result(f"{text}; affected: {', '.join(ids[:5])}")
        if not check.problems:
            output.print_result("no damage found")
    if check.problems:
        raise typer.Exit(1)


def _as_dict(result: BackupResult) -> dict[str, Any]:
    snapshot = result.snapshot
    return {
        "snapshot": snapshot.id,
        "destination": result.place,
        "started": snapshot.started.isoformat(),
        "finished": snapshot.finished.isoformat(),
        "bytes": snapshot.size,
        "written": snapshot.written,
        "keys": snapshot.keys,
        "removed": list(result.removed),
        "freed": result.freed,
        "damaged": list(snapshot.damaged),
    }


def _show(result: BackupResult) -> None:
    snapshot = result.snapshot
    output.print_result(
        f"backup {snapshot.id} in {result.place}: {_size(snapshot.written)} added, {_size(snapshot.size)} in all"
    )
    if result.removed:
        output.print_result(f"removed {len(result.removed)} older backups, {_size(result.freed)}")
    if snapshot.damaged:
        output.print_result(
            f"{len(snapshot.damaged)} stored objects are damaged and not in the backup: run `fleetmap verify`"
        )


def _size(count: int) -> str:
    from rich.filesize import decimal

    return decimal(count)
