"""``fleetmap verify``: check all stored data against its hashes and repair damage."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from app.cli import local, options, output
from app.cli.client import Client
from app.cli.problems import RequestFailed
from app.errors import FleetMapError, Invalid

if TYPE_CHECKING:
    from app.config import Settings
    from app.ingest.repair import Donor
    from app.store.store import Store
    from app.store.verify import Finding, VerifyResult

REMOVED = "removed, since no version uses it"
MAX_ROUNDS = 10
"""Maximum number of checks and repairs: a chunk tree is repaired level by level."""

MAX_VERSIONS = 5
"""Maximum number of versions listed in one row of the table."""


Sources = Annotated[
    list[str] | None,
    typer.Option(
        "--from",
        metavar="PLACE",
        help="Source for repairs: a file or folder of original files, the data folder of another server, or its "
        "address (with --token or FLEETMAP_TOKEN of an administrator); repeatable.",
    ),
]
DatabaseUrl = Annotated[str | None, typer.Option("--database-url", help="Database [default: FLEETMAP_DATABASE_URL].")]
DataDir = Annotated[
    Path | None, typer.Option("--data-dir", help="Data folder of the server [default: FLEETMAP_DATA_DIR].")
]
BlobUrl = Annotated[
    str | None, typer.Option("--blob-url", help="Folder or s3:// address of stored files [default: FLEETMAP_BLOB_URL].")
]


def verify(
    repair: Annotated[
        bool, typer.Option("--repair", help="Replace damaged data; the history does not change.")
    ] = False,
    sources: Sources = None,
    database_url: DatabaseUrl = None,
    data_dir: DataDir = None,
    blob_url: BlobUrl = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Check all stored data against its hashes.

    Exit status: 0 if no damage is left, 1 otherwise. May run while the server runs. Removes damaged cached maps, which
    are converted again when requested; changes nothing else without --repair. --repair tries the sources of --from,
    then reads the uploads of damaged versions again. Damaged maps that servers share are removed, and made again when
    requested.

    Example: `fleetmap verify --repair --from /backup/originals --from https://other-server`
    """
    local.require_server_python("verify")
    from app.cli.server import load_settings
    from app.convert.cache import Cache

    if sources and not repair:
        raise typer.BadParameter("--from requires --repair")
    settings = load_settings({"database_url": database_url, "data_dir": data_dir, "blob_url": blob_url})
    if not settings.blob_dir.is_dir() and not (settings.blob_url or "").startswith("s3://"):
        raise Invalid(
            f"folder of stored files {settings.blob_dir} not found: set the server's data folder with --data-dir"
        )
    with ExitStack() as stack:
        store = stack.enter_context(closing(_open(settings, readonly=not repair)))
        verification = latest = _check(store)
        left, healed = verification.findings, dict[tuple[str, str], str]()
        for _ in range(MAX_ROUNDS if repair else 0):
            if not left:
                break
            donors = [_donor(place, token, left, stack) for place in sources or ()]
            fresh = _repair(store, left, donors, settings)
            if not fresh and not any(f.versions or f.kind != "chunk" for f in left):
                removed = store.chunks.remove_damaged(latest.unused_chunks, latest.started)
                fresh = {("chunk", name): REMOVED for name in removed}
            if not fresh:
                break
            healed |= fresh
            latest = _check(store)  # finds damage below repaired chunks
            left = latest.findings
            finding_keys = {(f.kind, f.name) for f in verification.findings}
            verification.findings += [f for f in left if (f.kind, f.name) not in finding_keys]
    for f in left:  # damaged again, for example by a failing disk
        healed.pop((f.kind, f.name), None)
    cache = _check_cache(Cache(settings.cache_dir, settings.cache_bytes)) if settings.cache_dir.is_dir() else (0, 0)
    if as_json:
        output.show_json(_as_dict(verification, healed, cache, ok=not left))
    else:
        _show(verification, healed, cache, repaired=repair)
    if left:
        raise typer.Exit(1)


def _open(settings: Settings, *, readonly: bool) -> Store:
    from app.main import create_folders, open_store

    if not readonly:  # with files in S3, this machine may not have served yet
        create_folders(settings)
    return open_store(settings, readonly=readonly)


def _check(store: Store) -> VerifyResult:
    with output.progress_bar("checking", count_bytes=True) as bar:
        return store.verifier(lambda _, size: bar.advance(size)).run()
    raise AssertionError("unreachable")


def _check_cache(cache: Any) -> tuple[int, int]:
    """Check cached maps and remove damaged ones. Return the number of cached and of removed maps."""
    results = [cache.check(key)[1] for key in cache.stored_keys()]
    return len(results), results.count(False)


def _repair(
    store: Store, findings: list[Finding], donors: list[Donor], settings: Settings
) -> dict[tuple[str, str], str]:
    from app.ingest.repair import repair
    from app.main import sandbox_policy
    from app.pool import Pool

    seconds, memory = settings.max_seconds, settings.max_memory_bytes
    pool = Pool(1, memory_bytes=memory, seconds=seconds, allowed=sandbox_policy(settings))
    try:
        with output.progress_bar("repairing"):
            return repair(store, findings, donors, pool.run, settings.limits)
        raise AssertionError("unreachable")
    finally:
        pool.close()


class FolderDonor:
    """Source for repairs: original files with any names, identified by their hash."""

    def __init__(self, place: Path, hashes: set[str]) -> None:
        import hashlib

        self.name = str(place)
        self._files: dict[str, Path] = {}
        for path in _files(place):
            sha256 = hashlib.sha256()
            with path.open("rb") as file:
                while block := file.read(2**20):
                    sha256.update(block)
            if sha256.hexdigest() in hashes:
                self._files[sha256.hexdigest()] = path

    def blob(self, sha256: str) -> bytes | None:
        """Return the content of the file with this hash; None if there is none."""
        path = self._files.get(sha256)
        return None if path is None else path.read_bytes()

    def chunk(self, sha256: str) -> bytes | None:
        """Return None: a folder of files has no chunks."""
        del sha256
        return None


class StoreDonor:
    """Source for repairs: the data folder of another server."""

    def __init__(self, place: Path, store: Store) -> None:
        self.name, self._store = str(place), store

    def blob(self, sha256: str) -> bytes | None:
        """Return a stored file if it is intact, else None."""
        try:
            return self._store.blobs.get(sha256)
        except FleetMapError:
            return None

    def chunk(self, sha256: str) -> bytes | None:
        """Return a chunk if it is intact, else None."""
        try:
            return self._store.chunks.read(sha256)
        except FleetMapError:
            return None


class ServerDonor:
    """Source for repairs: another running server."""

    def __init__(self, address: str, client: Client) -> None:
        self.name, self._client = address, client

    def blob(self, sha256: str) -> bytes | None:
        """Return a stored file if the server has it, else None."""
        return self._get("blobs", sha256)

    def chunk(self, sha256: str) -> bytes | None:
        """Return a chunk if the server has it, else None."""
        return self._get("chunks", sha256)

    def _get(self, kind: str, sha256: str) -> bytes | None:
        try:
            with self._client.download(f"/stored/{kind}/{sha256}") as download:
                return download.path.read_bytes()
        except RequestFailed as refused:
            if refused.problem.get("status") == 404:
                return None
            raise


def _donor(place: str, token: str | None, findings: list[Finding], stack: ExitStack) -> Donor:
    if place.startswith(("http://", "https://")):
        return ServerDonor(place, stack.enter_context(Client(place, token)))
    path = Path(place)
    if not path.exists():
        raise Invalid(f"--from {place}: no such file or folder")
    database = path / "fleetmap.sqlite3"
    if database.is_file():
        from app.store.store import Store

        store = Store(f"sqlite:///{database.resolve()}", path / "blobs", readonly=True)
        return StoreDonor(path, stack.enter_context(closing(store)))
    return FolderDonor(path, {f.name for f in findings if f.kind == "blob"})


def _files(place: Path) -> Iterator[Path]:
    if place.is_file():
        yield place
    for folder, _, names in os.walk(place):
        yield from (path for name in names if (path := Path(folder) / name).is_file())


def _as_dict(
    verification: VerifyResult, healed: dict[tuple[str, str], str], cache: tuple[int, int], *, ok: bool
) -> dict[str, Any]:
    findings = [{**f.as_dict(), "repaired_from": healed.get((f.kind, f.name))} for f in verification.findings]
    return {
        "ok": ok,
        "checked": {**verification.checked, "cache": cache[0]},
        "bytes": verification.size,
        "findings": findings,
        "cache_removed": cache[1],
    }


def _show(
    verification: VerifyResult, healed: dict[tuple[str, str], str], cache: tuple[int, int], *, repaired: bool
) -> None:
    counts = ", ".join(f"{count} {kind}s" for kind, count in verification.checked.items() if kind != "database")
    output.print_result(f"checked: {counts}, {cache[0]} cached maps")
    if cache[1]:
        output.print_result(f"removed {cache[1]} damaged cached maps; they are converted again when requested")
    if not verification.findings:
        output.print_result("no damage found")
        return
    rows = []
    for f in verification.findings:
        versions = [f"{environment} {number}" for environment, number in f.versions]
        more = f" and {len(versions) - MAX_VERSIONS} more" if len(versions) > MAX_VERSIONS else ""
        version_names = ", ".join(versions[:MAX_VERSIONS]) + more or "none"
        source = healed.get((f.kind, f.name), "")
        repair = source if not source or source.startswith("removed") else f"repaired from {source}"
        rows.append((f"{f.kind} {f.name[:16]}", f.problem, version_names, repair))
    output.show_table(("what", "problem", "versions", "repair"), rows)
    left = sum((f.kind, f.name) not in healed for f in verification.findings)
    if not left:
        output.print_result("all damage repaired")
    elif repaired:
        output.print_result(
            f"{left} still damaged: set another source with --from, upload the files again, or restore a backup"
        )
    else:
        output.print_result(
            f"{left} damaged: run `fleetmap verify --repair`, which repairs from uploads and from sources of --from"
        )
