"""Checks of files with keys and passwords: who can read and change them."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from pathlib import Path

from app.doctor.registry import Finding, check, error, ok, warning
from app.doctor.site import Site
from app.events.security import PASSWORD_FILE, USERS_FILE

MOUNTED = Path("/run/secrets")
"""Folder of secrets in a container, where nobody else is; container engines choose the modes."""

ENGINE = 0
"""User who may own mounted and system-wide files besides the user of the server: root."""


@check
def secret_files(site: Site) -> Iterator[Finding]:
    """Look at modes and owners of files with keys and passwords."""
    settings = site.settings
    generated = [settings.data_dir / name for name in (PASSWORD_FILE, USERS_FILE, "demo-token")]
    keys = settings.data_dir / "keys"
    generated += sorted(keys.glob("*")) if keys.is_dir() else []
    named = (settings.signing_key, settings.tls_key, settings.zenoh_key, settings.zenoh_users)
    paths = {*(path for path in generated if path.exists() and path.name != "lock"), *filter(None, named)}
    folder = site.environment.get("FLEETMAP_SECRETS_DIR")
    if folder:
        paths |= {path for path in Path(folder).glob("fleetmap_*") if path.is_file()}
    if Path(".env").is_file() and any(word in Path(".env").read_text(errors="replace") for word in ("TOKEN", "KEY=")):
        paths.add(Path(".env"))
    problems = [finding for path in sorted(paths) for finding in _examine(path, Path(folder) if folder else None)]
    if site.database_file is not None:
        problems += _examine_database(site.database_file)
    yield from problems
    if not problems:
        yield ok(f"{len(paths)} files with keys and passwords: only their owner can read them")


def _examine(path: Path, secrets: Path | None) -> Iterator[Finding]:
    try:
        status = path.stat()
    except OSError as failure:
        yield error(f"cannot be read: {failure.strerror}", str(path), "set an existing file, readable by this user")
        return
    mode = stat.S_IMODE(status.st_mode)
    if not os.access(path, os.R_OK):
        advice = f"give it to the user of the server: chown {os.getuid()} {path}"
        yield error(f"cannot be read by this user (mode {mode:04o}, owner {status.st_uid})", str(path), advice)
        return
    mounted = path.is_relative_to(MOUNTED) or (secrets is not None and secrets.is_relative_to(MOUNTED))
    if mode & (stat.S_IWGRP | stat.S_IWOTH):
        yield error(f"others can change it (mode {mode:04o})", str(path), f"chmod 600 {path}")
    elif mode & stat.S_IROTH and not mounted and _is_reachable(path):
        yield error(f"every user of this machine can read it (mode {mode:04o})", str(path), f"chmod 600 {path}")
    elif status.st_uid not in (os.getuid(), ENGINE) and not mounted:
        advice = f"chown {os.getuid()} {path}, or run the server as the owner"
        yield error(f"belongs to another user (number {status.st_uid})", str(path), advice)


def _examine_database(path: Path) -> Iterator[Finding]:
    """Look who can read SQLite's file, which has secrets of webhooks. Its group may: folders can be shared with one."""
    if path.exists() and path.stat().st_mode & stat.S_IROTH and _is_reachable(path):
        detail = f"every user of this machine can read the database (mode {stat.S_IMODE(path.stat().st_mode):04o})"
        yield warning(f"{detail}, which has the secrets of webhooks", str(path), f"chmod o-rwx {path}*")


def _is_reachable(path: Path) -> bool:
    """Whether all users may pass the folders above a file."""
    return all(folder.stat().st_mode & stat.S_IXOTH for folder in path.resolve().parents)
