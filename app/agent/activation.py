"""Switch to a map and run the hooks that load it.

``--before-switch`` commands decide when to switch; ``--on-change`` commands load the map after it. If they fail,
``current`` is switched back to the version that the robot loaded last, so ``current`` is always the map in use.
"""

from __future__ import annotations

import json
import random
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from app.agent import hooks
from app.agent.http_client import AgentStopped
from app.agent.levels import level_problem, level_variables, read_level
from app.agent.map_directory import MapDirectory
from app.agent.options import AgentOptions
from app.agent.signed_manifest import Manifest
from app.agent.state import StateStore, write_durably

DELAY_STATUS = 75
"""Exit status of ``--before-switch`` that delays the switch (EX_TEMPFAIL of sysexits.h)."""

BEFORE_SWITCH_SECONDS = 5.0
"""Interval between two runs of ``--before-switch`` while it delays a switch."""

BEFORE_SWITCH_LIMIT_SECONDS = 60.0
"""Maximum run time of ``--before-switch``."""

MAX_VARIABLE_BYTES = 100_000

HOOK_SUCCESS = ("done", "unchanged")
MAX_HOOK_STATUS_BYTES = 65_536
MAX_HOOK_STEPS = 5

LAYERS = ("imagery", "location", "objects", "occupancy", "topology", "voxels", "zones")
"""Layers that may have changed if the server is too old to list them."""

LogEvent = Callable[..., None]
"""Log function: ``log(event, **members)`` writes one line."""


class Retries:
    """Exponential backoff between attempts, per subject."""

    def __init__(self, longest: float, first: Callable[[], float]) -> None:
        self._longest, self._first = longest, first
        self._failures: dict[str, tuple[int, float, str]] = {}

    def note_failure(self, subject: str, reason: str) -> None:
        """Record a failure; the pause before the next attempt doubles with each one."""
        count = self._failures.get(subject, (0, 0.0, ""))[0] + 1
        pause = min(self._longest, self._first() * 2 ** min(20, count - 1))
        due = time.monotonic() + pause * random.uniform(0.5, 1.5)  # noqa: S311  jitter is no secret
        self._failures[subject] = (count, due, reason)

    def reason(self, subject: str) -> str | None:
        """Return the reason of the last failure if the next attempt is not due yet."""
        _, due, reason = self._failures.get(subject, (0, 0.0, None))
        return reason if due > time.monotonic() else None

    def forget_others(self, *subjects: str | None) -> None:
        """Clear the failures of all other subjects, so that they can be tried at once."""
        self._failures = {name: failure for name, failure in self._failures.items() if name in subjects}

    @property
    def next_due(self) -> float | None:
        """Monotonic time of the next attempt; None if none is due."""
        now = time.monotonic()
        return min((due for _, due, _ in self._failures.values() if due > now), default=None)


@dataclass(frozen=True, slots=True)
class Pending:
    """A map whose switch ``--before-switch`` delays.

    Attributes:
        since: RFC 3339 time from which the version is ready.
        members: of the log line ``switched``.
    """

    name: str
    manifest: Manifest
    since: str
    members: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Outcome:
    """Outcome of an installation.

    Attributes:
        manifest: map that ``detail`` is about; None for the map that ``current`` points to.
    """

    state: Literal["active", "waiting", "failed"]
    detail: str | None = None
    manifest: Manifest | None = None


ACTIVE = Outcome("active")


class Activation:
    """Switches versions of one map directory and runs its hooks. Not thread-safe."""

    def __init__(
        self,
        folder: MapDirectory,
        store: StateStore,
        options: AgentOptions,
        robot: str,
        *,
        log: LogEvent,
        stopping: threading.Event,
        retries: Retries,
    ) -> None:
        self._folder, self._store, self._options, self._robot = folder, store, options, robot
        self._log, self._stopping = log, stopping
        self.retries = retries
        self.pending: Pending | None = None
        self._replacement: str | None = None

    def switch(self, name: str, manifest: Manifest, members: Mapping[str, Any], since: str) -> Outcome:
        """Switch to a built version if ``--before-switch`` allows it. ``load`` runs the hooks afterwards.

        Args:
            members: of the log line ``switched``.
            since: RFC 3339 time from which the version is ready.
        """
        with self._folder.hooks_lock(self._stopping):
            problem = level_problem(manifest, read_level(self._folder, manifest))
            if problem is not None and self._folder.manifest(self._store.value.working) is not None:
                self.pending = None
                reason = f"version {manifest.version} is refused: {problem}"
                self.retries.note_failure(identity(manifest), reason)
                return Outcome("failed", reason, manifest)
            if self._options.before_switch:
                self.pending = Pending(name, manifest, since, members)
                self.protect()
                if (outcome := self._before_switch(name, manifest, since)) is not None:
                    return outcome
            self.pending = None
            self._folder.switch(name)
        self.protect()
        self._log("switched", **members)
        return ACTIVE

    def replace(self, name: str, manifest: Manifest, members: Mapping[str, Any], since: str) -> Outcome:
        """Switch to the current version with other closures and run the hooks; a newer pending map stays pending.

        After a failure the robot returns to the closures that it has loaded; the agent retries with backoff.
        """
        self._replacement = identity(manifest)
        if (reason := self.retries.reason(self._replacement)) is not None:
            return Outcome("waiting", reason, manifest)
        pending = self.pending
        try:
            outcome = self.switch(name, manifest, members, since)
        finally:
            if pending is not None:
                self.pending = pending
            elif self.pending is not None and self.pending.name == name:
                self.pending = None
            self.protect()
        return self.load() if outcome.state == "active" else outcome

    def refusal(self, manifest: Manifest) -> Outcome | None:
        """Return the failure of this manifest if its next attempt is not due yet."""
        self.retries.forget_others(identity(manifest), self._folder.current_version, self._replacement)
        reason = self.retries.reason(identity(manifest))
        return None if reason is None else Outcome("failed", reason, manifest)

    def is_waiting(self) -> bool:
        """Whether ``--before-switch`` delays a switch."""
        return self.pending is not None

    def protect(self) -> None:
        """Protect the folders of the working and the pending version from removal."""
        names = {self._store.value.working, self.pending.name if self.pending else None}
        self._folder.protected = frozenset(name for name in names if name is not None)

    def _before_switch(self, name: str, manifest: Manifest, since: str) -> Outcome | None:
        """Run the ``--before-switch`` commands; return None if all allow the switch."""
        installed = self._folder.manifest(self._store.value.activated)
        variables = self._variables(manifest, installed)
        ready = self._folder.versions / name
        variables |= {"FLEETMAP_NEXT": str(ready), "FLEETMAP_CLOSURES_FILE": str(ready / "closures.json")}
        for command in self._options.before_switch:
            ended = hooks.execute(command, variables, BEFORE_SWITCH_LIMIT_SECONDS, self._stopping)
            if ended.status == 0:
                continue
            if self._stopping.is_set():
                raise AgentStopped
            if ended.status == DELAY_STATUS:
                detail = (
                    f"version {manifest.version} has been ready since {since}; "
                    f"--before-switch {command} delays the switch"
                )
                return Outcome("waiting", detail, manifest)
            reason = f"version {manifest.version} is refused: --before-switch {command} {ended.text}"
            self.pending = None
            self.retries.note_failure(identity(manifest), reason)
            return Outcome("failed", reason, manifest)
        return None

    @property
    def is_load_due(self) -> bool:
        """Whether ``load`` would run the hooks now."""
        name = self._folder.current_version
        return name is not None and self._store.value.activated != name and self.retries.reason(name) is None

    def load(self) -> Outcome:
        """Run the hooks of the current version if they have not run yet; if they fail, restore the working version."""
        name = self._folder.current_version
        manifest = self._folder.manifest(name)
        if name is None or manifest is None or self._store.value.activated == name:
            return ACTIVE
        if (reason := self.retries.reason(name)) is not None:
            return Outcome("failed", reason)
        with self._folder.hooks_lock(self._stopping):
            if (problem := self._run_hooks(name, manifest)) is None:
                return ACTIVE
            return self._roll_back(name, manifest, problem)

    def _roll_back(self, name: str, manifest: Manifest, problem: str) -> Outcome:
        """Restore the version whose hooks succeeded last."""
        back = self._store.value.working
        previous = self._folder.manifest(back)
        if back is None or back == name or previous is None or self._folder.damaged_files(back, previous):
            reason = f"version {manifest.version} is current, but the robot could not load it: {problem}"
            self.retries.note_failure(name, reason)
            return Outcome("failed", reason)
        reason = (
            f"the robot could not load version {manifest.version}; version {previous.version} is restored: {problem}"
        )
        self.retries.note_failure(identity(manifest), reason)
        self._folder.switch(back)
        self._log("restored", version=previous.version, root=previous.root, detail=problem)
        is_loaded = self._store.value.activated == back  # no hook of the newer version has run
        if not is_loaded and (second := self._run_hooks(back, previous)) is not None:
            reason = f"{reason}; version {previous.version} could not be loaded again either: {second}"
            self.retries.note_failure(back, reason)
        return Outcome("failed", reason, manifest)

    def _run_hooks(self, name: str, manifest: Manifest) -> str | None:
        """Run the ``--on-change`` commands; return None if all succeeded, and mark the version as loaded."""
        level = read_level(self._folder, manifest)
        if (problem := level_problem(manifest, level)) is not None:
            return problem
        before = self._folder.manifest(self._store.value.activated)
        try:
            variables = self._variables(manifest, before)
            self._folder.hook_status.unlink(missing_ok=True)
        except OSError as error:
            return f"could not run the hooks: {error.filename or self._folder.path}: {error.strerror or error}"
        if self._options.on_change:  # after an interruption it is unknown which version the robot has loaded
            self._store.set(activated=None)
        for command in self._options.on_change:
            problem = hooks.run(command, variables, stopping=self._stopping)
            if problem is not None:
                if self._stopping.is_set():
                    raise AgentStopped
                return problem
            self._log("hook", command=command, version=manifest.version)
        self._store.set(activated=name, working=name)
        self.protect()
        return None

    def hook_remark(self) -> str | None:
        """Return the steps that hooks of the current version reported as not done."""
        steps = [s for s in read_hook_status(self._folder.hook_status) if s["result"] not in HOOK_SUCCESS]
        return "; ".join(f"{s['step']}: {s['result']}: {s['detail']}" for s in steps[:MAX_HOOK_STEPS]) or None

    def _variables(self, manifest: Manifest, before: Manifest | None) -> dict[str, str]:
        """Return the environment variables of a command. before: manifest that the robot has loaded."""
        files, layers = changed_files(before, manifest), changed_layers(before, manifest)
        return hook_variables(self._folder, manifest, files, layers, read_level(self._folder, manifest), self._robot)


def hook_variables(
    folder: MapDirectory, manifest: Manifest, files: Sequence[str], layers: Sequence[str], level: str | None, robot: str
) -> dict[str, str]:
    """Return the environment variables of a command.

    Args:
        files, layers: changed files and layers.
        level: current level of the robot.
    """
    return {
        "FLEETMAP_ENVIRONMENT": manifest.environment,
        "FLEETMAP_VERSION": str(manifest.version),
        "FLEETMAP_ROOT": manifest.root,
        "FLEETMAP_CHANNEL": manifest.channel or "",
        "FLEETMAP_SEQUENCE": str(manifest.sequence),
        "FLEETMAP_CURRENT": str(folder.current),
        **_file_variables(folder.path / "changed", files),
        "FLEETMAP_LAYERS": " ".join(layers),
        "FLEETMAP_ROBOT": robot,
        "FLEETMAP_OVERLAYS": manifest.overlays_digest or "",
        "FLEETMAP_CLOSURES_FILE": str(folder.current / "closures.json"),
        "FLEETMAP_HOOK_STATUS": str(folder.hook_status),
        **level_variables(manifest, level),
    }


def read_hook_status(path: Path) -> list[dict[str, str]]:
    """Return the steps that hooks wrote to ``FLEETMAP_HOOK_STATUS``: JSON lines ``{"step", "result", "detail"}``."""
    try:
        with path.open("rb") as stream:
            lines = stream.read(MAX_HOOK_STATUS_BYTES).splitlines()
    except OSError:
        return []
    steps = []
    for line in lines:
        try:
            body = json.loads(line)
            steps.append({name: str(body[name])[:300] for name in ("step", "result", "detail")})
        except (ValueError, KeyError, TypeError, RecursionError):
            continue  # other output, or a truncated line
    return steps


def identity(manifest: Manifest) -> str:
    """Return the key under which failures of this manifest are recorded; a newer sequence has another key."""
    return f"{manifest.epoch} {manifest.sequence} {manifest.root} {manifest.closures_key}"


def _file_variables(path: Path, names: Sequence[str]) -> dict[str, str]:
    """Return changed files as hook variables, and write the complete list to ``path``.

    The size of a variable is limited (128 KiB on Linux): names in the deepest folders are skipped first.
    """
    write_durably(path, "".join(f"{name}\n" for name in names).encode())
    remaining, fit = MAX_VARIABLE_BYTES, set()
    for name in sorted(names, key=lambda n: (n.count("/"), n)):
        remaining -= len(name.encode()) + 1
        if remaining < 0:
            break
        fit.add(name)
    return {"FLEETMAP_CHANGED": "\n".join(n for n in names if n in fit), "FLEETMAP_CHANGED_FILE": str(path)}


def changed_files(old: Manifest | None, new: Manifest) -> list[str]:
    """Return the paths of files that are new, removed or different."""
    before, after = old.content if old else {}, new.content
    return sorted(path for path in {*before, *after} if before.get(path) != after.get(path))


def changed_layers(old: Manifest | None, new: Manifest) -> list[str]:
    """Return the names of layers that are new, removed or different."""
    if not new.layers:
        return list(LAYERS)
    before, after = old.layers if old else {}, new.layers
    return sorted(name for name in {*before, *after} if before.get(name) != after.get(name))
