"""Map directory on the robot's disk.

::

    DIR/current -> versions/7-9f3c21aa       switched by one rename: always a complete, verified version
    DIR/versions/7-9f3c21aa/<format>/<file>  with manifest.json, manifest.sig, environment.sh, closures.json
                                             and levels.json
    DIR/versions/7-9f3c21aa-0b12cd34         the same root with closures of this digest in force
    DIR/partial/<sha256>[.part]              complete and partial downloads
    DIR/state.json, DIR/lock                 persistent state; lock of the running agent
    DIR/changed                              changed files, as listed for the hooks
    DIR/hooks.json, DIR/hooks.lock           hooks for `fleetmap agent-level`; lock while hooks run
    DIR/hook-status, DIR/level               results of the hooks' steps; names of the robot's level

Unchanged files are hard links to those of the previous version, so they are read-only.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import re
import shlex
import shutil
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

from app.agent.http_client import AgentStopped
from app.agent.signed_manifest import Manifest, ManifestFile, parse
from app.agent.state import digest, sync_folder, write_atomically
from app.errors import Conflict, Invalid, Unavailable, Untrusted

OLD_VERSIONS_KEPT = 2
"""Number of old versions to keep besides the current one."""

LOCK_SECONDS = 1.0
"""Maximum time to wait for the lock: a child process that a killed agent was starting may hold it until it runs."""

HOOKS_LOCK_SECONDS = 0.1
"""Interval between two attempts to get a lock."""

READ_ONLY = 0o444
CHUNK = 1 << 20


class MapDirectory:
    """Installed maps of one environment. Locked by one agent at a time."""

    def __init__(self, path: Path) -> None:
        self.path = path.absolute()
        self.current = self.path / "current"
        self.versions = self.path / "versions"
        self.partial = self.path / "partial"
        self.state = self.path / "state.json"
        self.hook_status = self.path / "hook-status"
        self.protected: frozenset[str] = frozenset()
        """Version folders that must not be removed, because the agent may still switch to them."""
        self._lock: IO[str] | None = None

    def _wait_for_lock(self, handle: IO[str]) -> None:
        deadline = time.monotonic() + LOCK_SECONDS
        while True:
            try:
                return fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                if time.monotonic() > deadline:
                    raise Conflict(f"another agent uses {self.path}: use another directory") from None
                time.sleep(HOOKS_LOCK_SECONDS)

    def open(self) -> None:
        """Create missing folders and take the lock.

        Raises Conflict if another agent holds it or ``current`` is not a link, Invalid if the disk has no locks.
        """
        for folder in (self.path, self.versions, self.partial):
            folder.mkdir(parents=True, exist_ok=True)
        if self.current.exists() and not self.current.is_symlink():
            raise Conflict(f"{self.current} already exists and is not a link: use another directory")
        handle = (self.path / "lock").open("a")
        try:
            self._wait_for_lock(handle)
        except Conflict:
            handle.close()
            raise
        except OSError as error:
            handle.close()
            raise Invalid(f"could not lock {self.path} ({error.strerror}): use a directory on another disk") from None
        self._lock = handle
        for left in self.versions.glob(".*"):
            shutil.rmtree(left, ignore_errors=True)

    @contextlib.contextmanager
    def hooks_lock(self, stopping: threading.Event | None = None) -> Iterator[None]:
        """Hold the lock for running hooks; wait for other processes. Raises AgentStopped."""
        with (self.path / "hooks.lock").open("a") as handle:
            while True:
                try:
                    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    break
                except BlockingIOError:
                    if stopping is None:
                        time.sleep(HOOKS_LOCK_SECONDS)
                    elif stopping.wait(HOOKS_LOCK_SECONDS):
                        raise AgentStopped from None
            yield

    def close(self) -> None:
        """Release the lock."""
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    # --- reading ---

    @property
    def current_version(self) -> str | None:
        """Name of the version folder that ``current`` points to."""
        try:
            target = self.current.readlink()
        except OSError:
            return None
        return target.name if target == Path("versions") / target.name else None

    def manifest(self, name: str | None) -> Manifest | None:
        """Return the manifest of a version folder; None if it is absent or invalid."""
        if name is None:
            return None
        path = self.versions / name
        try:
            return parse((path / "manifest.json").read_bytes(), (path / "manifest.sig").read_text().strip())
        except (OSError, ValueError, Untrusted):
            return None

    def damaged_files(self, name: str, manifest: Manifest) -> list[str]:
        """Return the files of a version that are missing or differ from their hash."""
        return [file.path for file in manifest.files if not _has_content(self.versions / name / file.path, file)]

    def is_complete(self, file: ManifestFile) -> Path:
        """Return the path of a file once it is completely downloaded and verified."""
        return self.partial / file.sha256

    def index(self) -> dict[str, list[Path]]:
        """Return SHA-256 -> files of all versions on disk, from their manifests. Not verified."""
        paths: dict[str, list[Path]] = {}
        for name in self._names():
            manifest = self.manifest(name)
            for file in manifest.files if manifest else ():
                paths.setdefault(file.sha256, []).append(self.versions / name / file.path)
        return paths

    def find_local_copy(self, file: ManifestFile, index: Mapping[str, Sequence[Path]]) -> Path | None:
        """Return a downloaded or installed file with this content, after verifying its hash; None if there is none."""
        fetched = self.is_complete(file)
        if _has_content(fetched, file):
            return fetched
        fetched.unlink(missing_ok=True)  # damaged on disk
        return next((path for path in index.get(file.sha256, ()) if _has_content(path, file)), None)

    def delta_base(self, file: ManifestFile, installed: Mapping[str, ManifestFile]) -> tuple[Path, str] | None:
        """Return the installed file of this path with its hash, as the dictionary of a delta."""
        old = installed.get(file.path)
        standing = self.current_version
        if old is None or standing is None:
            return None
        path = self.versions / standing / old.path
        return (path, old.sha256) if _has_content(path, old) else None

    def make_room(self, manifest: Manifest, sources: Mapping[str, Path], keep: Sequence[ManifestFile] = ()) -> None:
        """Free disk space for the files of a manifest that are not in ``sources``.

        If needed, removes partial downloads of other maps, then old versions, then the files of a planned map
        (``keep``). Raises Unavailable if that is not enough.
        """
        new_files = {file.sha256: file for file in manifest.files if file.path not in sources}.values()
        count = sum(file.size - min(file.size, self._partial_size(file)) for file in new_files) + CHUNK
        steps: Sequence[Callable[[], None]] = (
            lambda: self._forget((*manifest.files, *keep)),
            lambda: self._drop(0, sources.values()),
            lambda: self._forget(manifest.files),
        )
        for step in steps:
            if self._free() < count:
                step()
        if (free := self._free()) < count:
            raise Unavailable(f"not enough disk space in {self.path}: the new map needs {count} bytes, {free} are free")

    def _free(self) -> int:
        return shutil.disk_usage(self.path).free

    def _partial_size(self, file: ManifestFile) -> int:
        try:
            return self.is_complete(file).with_suffix(".part").stat().st_size
        except OSError:
            return 0

    # --- changing ---

    def describe(self, name: str, manifest: Manifest) -> None:
        """Store a newer manifest of an existing version: the same files with a later sequence or expiry."""
        self._describe(self.versions / name, manifest)

    def refresh(self) -> None:
        """Rewrite the descriptive files of all versions if the directory was moved or an older agent wrote them.

        Raises OSError if those of the current version cannot be read or written; other versions are left then.
        """
        for name in self._names():
            try:
                self._refresh(self.versions / name, self.manifest(name))
            except OSError:
                if name == self.current_version:
                    raise

    def _refresh(self, folder: Path, manifest: Manifest | None) -> None:
        used = folder.stat()
        for path, data in self._descriptions(folder, manifest) if manifest else ():
            if not path.exists() or path.read_bytes() != data:
                write_atomically(path, data)
        os.utime(folder, ns=(used.st_atime_ns, used.st_mtime_ns))  # versions stay in the order of their last use

    def build(self, manifest: Manifest, sources: dict[str, Path]) -> str:
        """Build a complete version folder, synced to disk, and return its name. ``current`` does not change.

        Args:
            sources: path -> verified file.
        """
        base = f"{manifest.version}-{manifest.root[:8]}"
        if manifest.closures_key:
            base += f"-{manifest.closures_key[:8]}"
        for name in (n for n in self._names() if n == base or n.startswith(base + ".")):
            existing_manifest = self.manifest(name)
            if (
                existing_manifest is not None
                and existing_manifest.map_key == manifest.map_key
                and not self.damaged_files(name, existing_manifest)
            ):
                self.describe(name, manifest)
                return name
        staging = self.versions / ".new"
        shutil.rmtree(staging, ignore_errors=True)
        try:
            self._stage(staging, manifest, sources)
            name, count = base, 0
            while (self.versions / name).exists():
                count += 1
                name = f"{base}.{count}"
            staging.rename(self.versions / name)
        except OSError:
            shutil.rmtree(staging, ignore_errors=True)  # frees space on a full disk
            raise
        sync_folder(self.versions)
        return name

    def _stage(self, staging: Path, manifest: Manifest, sources: Mapping[str, Path]) -> None:
        staging.mkdir()
        folders = {staging}
        for file in manifest.files:
            target = staging / file.path
            target.parent.mkdir(parents=True, exist_ok=True)
            folders |= {parent for parent in target.parents if staging in parent.parents}
            if os.path.lexists(target):
                raise Conflict(
                    f"{file.path} and another file of the map have the same name on the file system of {self.path}: "
                    "use a case-sensitive file system"
                )
            _link(sources[file.path], target)
        self._describe(staging, manifest)
        for folder in folders:
            sync_folder(folder)

    def switch(self, name: str) -> None:
        """Switch ``current`` to a built version atomically."""
        now = time.time()
        os.utime(self.versions / name, (now, now))
        link = self.path / ".current.new"
        link.unlink(missing_ok=True)
        link.symlink_to(Path("versions") / name)
        link.replace(self.current)
        sync_folder(self.path)

    def prune(self, keep: Iterable[ManifestFile] = ()) -> None:
        """Remove old versions beyond OLD_VERSIONS_KEPT, and downloads not in ``keep``."""
        self._drop(OLD_VERSIONS_KEPT)
        self._forget(keep)

    def free_space(self) -> None:
        """Remove all old versions and downloads, for a full disk."""
        self._drop(0)
        self._forget(())

    def _drop(self, keep_count: int, needed: Iterable[Path] = ()) -> None:
        """Remove old versions except the ``keep_count`` last used ones, protected ones and those of needed files."""
        spared = {self.current_version} | {
            p.relative_to(self.versions).parts[0] for p in needed if self.versions in p.parents
        }
        old = [name for name in self._names() if name not in spared]
        removable = [name for name in old if name not in self.protected]
        # Folders that differ only in closures share a root and count once.
        roots = {_root_name(name) for name in old if name in self.protected}
        standing = _root_name(self.current_version or "")
        roots.discard(standing)
        spare: set[str] = set()
        for name in removable:
            root = _root_name(name)
            if (
                keep_count
                and root not in {_root_name(s) for s in spare}
                and (root == standing or len(roots | {root}) <= keep_count)
            ):
                spare.add(name)
                roots |= {root} - {standing}
        for name in (name for name in removable if name not in spare):
            trash = self.versions / f".{name}"
            shutil.rmtree(trash, ignore_errors=True)
            (self.versions / name).rename(trash)
            shutil.rmtree(trash, ignore_errors=True)

    def _forget(self, keep: Iterable[ManifestFile]) -> None:
        """Remove complete and partial downloads, except those in ``keep``."""
        hashes = {file.sha256 for file in keep}
        for path in self.partial.iterdir():
            if path.name.removesuffix(".part") not in hashes:
                path.unlink(missing_ok=True)

    def _names(self) -> list[str]:
        """Return the names of version folders, last used first."""
        folders = [p for p in self.versions.iterdir() if p.is_dir() and not p.name.startswith(".")]
        return [p.name for p in sorted(folders, key=lambda p: (-p.stat().st_mtime, p.name))]

    def _describe(self, folder: Path, manifest: Manifest) -> None:
        """Write the manifest and the descriptive files into a version folder."""
        write_atomically(folder / "manifest.sig", manifest.signature.encode() + b"\n")
        for path, data in self._descriptions(folder, manifest):
            write_atomically(path, data)
        write_atomically(folder / "manifest.json", manifest.data)

    def _descriptions(self, folder: Path, manifest: Manifest) -> list[tuple[Path, bytes]]:
        """Return path and content of the files that describe a version to other programs."""
        return [
            (folder / "environment.sh", environment_sh(manifest, self.current).encode()),
            (folder / "closures.json", closures_json(manifest)),
            (folder / "levels.json", levels_json(manifest)),
        ]


def _root_name(name: str) -> str:
    """Return the part of a folder name with version and root."""
    return "-".join(name.partition(".")[0].split("-")[:2])


def _has_content(path: Path, file: ManifestFile) -> bool:
    try:
        return path.stat().st_size == file.size and digest(path) == file.sha256
    except OSError:
        return False


def _link(source: Path, target: Path) -> None:
    try:
        os.link(source, target)
    except OSError:  # no hard links on this file system, or too many to this file
        shutil.copyfile(source, target)
        with target.open("rb+") as stream:
            os.fsync(stream.fileno())
    target.chmod(READ_ONLY)


TEMPLATE: Sequence[tuple[str, str, Sequence[str]]] = (
    ("DATUM_FILE", "datum", ("datum.yaml",)),
    ("TMAP_FILE", "tmap2", ("network.tmap2.yaml",)),
    ("COSTMAP_YAML_FILE", "occupancy_grid", ("map.yaml",)),
    ("NOGO_COSTMAP_YAML_FILE", "occupancy_grid", ("nogo.yaml", "keepout.yaml")),
    ("GAZEBO_WORLD_FILE", "gazebo", ("world.sdf",)),
)
"""Variables of environment_template: name, format, file names in order of preference."""


PLACE: Sequence[str] = (
    "ENVIRONMENT_COMMON_LATEST_RELEASE",
    "ENVIRONMENT_ORIGINS",
    "FARM_NAME",
    "FIELD_NAME",
    "FIELD_ID",
    "FIELD_TYPE",
)
"""Variables of environment_template that name the environment."""


def environment_sh(manifest: Manifest, current: Path) -> str:
    """Return ``environment.sh``: variables of environment_template for the installed files, and the environment's own.

    As in the template, the variable of an absent file is empty, so that sourcing it again leaves no stale values. All
    values are quoted literals, so that file names cannot run commands.
    """
    names_by_format: dict[str, list[str]] = {}
    for file in manifest.files:
        names_by_format.setdefault(file.format, []).append(file.name)
    values: dict[str, str] = {}
    for variable, format_, candidates in TEMPLATE:
        names = names_by_format.get(format_, [])
        file_name = next((name for name in candidates if name in names), None)
        if file_name is None and variable in ("TMAP_FILE", "GAZEBO_WORLD_FILE") and len(names) == 1:
            file_name = names[0]
        values[variable] = str(current / format_ / file_name) if file_name else ""
    models = any(name.startswith("models/") for name in names_by_format.get("gazebo", ()))
    values["GAZEBO_CUSTOM_MODELS"] = str(current / "gazebo" / "models") if models else ""
    for variable, ending in (("POI_FILE", "poi.kml"), ("PROPERTIES_FILE", "properties.sh")):
        file_name = next((file.path for file in manifest.files if file.path.rpartition("/")[2] == ending), None)
        values[variable] = str(current / file_name) if file_name else ""
    place = {**dict.fromkeys(PLACE, ""), **manifest.variables}
    values |= {name: value for name, value in place.items() if name not in (*values, "GAZEBO_MODEL_PATH")}
    values |= _level_variables(manifest, current)
    values |= {
        "FLEETMAP_ENVIRONMENT": manifest.environment,
        "FLEETMAP_VERSION": str(manifest.version),
        "FLEETMAP_ROOT": manifest.root,
        "FLEETMAP_CHANNEL": manifest.channel or "",
        "FLEETMAP_CURRENT": str(current),
        "FLEETMAP_OVERLAYS": manifest.overlays_digest or "",
        "FLEETMAP_CLOSURES_FILE": str(current / "closures.json"),
        "FLEETMAP_LEVELS_FILE": str(current / "levels.json"),
    }
    lines = [f"export {name}={shlex.quote(value)}" for name, value in values.items()]
    if models:
        lines.append('export GAZEBO_MODEL_PATH="${GAZEBO_MODEL_PATH:+$GAZEBO_MODEL_PATH:}$GAZEBO_CUSTOM_MODELS"')
    return "# Written by `fleetmap agent` with each version; to be sourced.\n" + "\n".join(lines) + "\n"


def _level_variables(manifest: Manifest, current: Path) -> dict[str, str]:
    """Return the template's variables of each level with separate files, such as ``COSTMAP_YAML_FILE_L2``."""
    values: dict[str, str] = {}
    for level in manifest.levels:
        suffix = re.sub(r"[^A-Z0-9]", "_", level.name.upper())
        names = {(f.format, f.name.rpartition("/")[2]): f.path for f in manifest.files if f.level == level.name}
        for variable, format_, candidates in TEMPLATE:
            path = next((names[format_, name] for name in candidates if (format_, name) in names), None)
            if path is not None:
                values.setdefault(f"{variable}_{suffix}", str(current / path))
    return values


def closures_json(manifest: Manifest) -> bytes:
    """Return ``closures.json``: the closures in force, as the signed manifest lists them."""
    return _json({"digest": manifest.overlays_digest or "", "closures": list(manifest.overlays)})


def levels_json(manifest: Manifest) -> bytes:
    """Return ``levels.json``: name, elevation and files (by format, relative to its folder) of each level."""
    levels = []
    for level in manifest.levels:
        files: dict[str, list[str]] = {}
        for file in manifest.files:
            if file.level == level.name:
                files.setdefault(file.format, []).append(file.name)
        levels.append({"name": level.name, "elevation": level.elevation, "files": files})
    return _json({"levels": levels})


def _json(body: Mapping[str, Any]) -> bytes:
    return json.dumps(body, ensure_ascii=False, indent=1).encode("utf-8", "replace") + b"\n"
