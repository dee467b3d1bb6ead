"""Persistent state of the agent in ``state.json``: trusted key, accepted manifests and pending hooks.

The installed version is not part of it: ``current`` and the manifest in it are the only source for that.
"""

from __future__ import annotations

import base64
import dataclasses
import errno
import hashlib
import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from app.errors import Invalid

HASH_BYTES = 1 << 18

MAX_TIME = 253402214400.0
"""9999-12-31, in seconds since 1970."""

BOOT_ID = Path("/proc/sys/kernel/random/boot_id")

STATE_FORMAT = 2
"""Format number of state.json. Format 1 (releases without epochs) is read as well."""


class Mark(NamedTuple):
    """Position of a manifest in its channel's history.

    edge_sequence: number of changes that a mirror made by itself; it orders manifests of equal sequence.
    """

    epoch: int
    sequence: int
    root: str
    overlays_digest: str | None = None
    edge_sequence: int = 0

    @property
    def position(self) -> tuple[int, int, int]:
        """Position without the content."""
        return self.epoch, self.sequence, self.edge_sequence


@dataclass(frozen=True, slots=True)
class AgentState:
    """Content of ``state.json``.

    Attributes:
        key, given: pinned public key; key set by the operator (id, or public key in base64).
        marks: highest (epoch, sequence, root) accepted per channel; lower ones are refused.
        etag, expires, asked: of the installed manifest: ETag, expiry in seconds since 1970, channel and formats.
        activated: version folder for which the hooks have run; None while they run.
        working: version folder whose hooks succeeded last; ``current`` goes back to it if those of a newer one fail.
        newest_time: newest signed time accepted, in seconds since 1970.
        boot: id of the boot of the machine in which the hooks have run; None if unknown.
    """

    environment: str
    key: bytes | None = None
    given: str | None = None
    channel: str | None = None
    marks: Mapping[str, Mark] = field(default_factory=dict)
    etag: str | None = None
    expires: float = 0.0
    asked: str = ""
    activated: str | None = None
    working: str | None = None
    newest_time: float = 0.0
    boot: str | None = None

    def in_boot(self, boot: str | None) -> AgentState:
        """Return the state in this boot of the machine; in another one nothing is loaded that the hooks had loaded."""
        activated = self.activated if self.boot in (None, boot) else None
        return dataclasses.replace(self, activated=activated, boot=boot)

    def with_mark(self, channel: str, mark: Mark) -> AgentState:
        """Return the state after a manifest of this channel was accepted."""
        return dataclasses.replace(self, marks={**self.marks, channel: mark}, channel=channel)


def load(path: Path, environment: str) -> AgentState:
    """Read the state, or return a new one if there is no file.

    Raises Invalid if the file is unreadable or belongs to another environment.
    """
    try:
        body = json.loads(path.read_bytes())
        if body["form"] not in (1, STATE_FORMAT):
            raise ValueError(f"unsupported format {body['form']!r:.80}; this agent reads 1 and {STATE_FORMAT}")
        state = AgentState(
            environment=str(body["environment"]),
            key=base64.b64decode(body["key"]) if body.get("key") else None,
            given=body.get("given"),
            channel=body.get("channel"),
            marks={
                str(c): Mark(
                    int(m.get("epoch", 0)),
                    int(m["sequence"]),
                    str(m["root"]),
                    _text(m.get("overlays_digest")),
                    int(m.get("edge_sequence", 0)),
                )
                for c, m in body["marks"].items()
            },
            etag=body.get("etag"),
            expires=float(body.get("expires", 0)),
            asked=str(body.get("asked", "")),
            activated=_name(body.get("activated")),
            working=_name(body["working"] if "working" in body else body.get("activated")),
            newest_time=float(body.get("newest_time", 0)),
            boot=_text(body.get("boot")),
        )
        if not 0 <= state.newest_time <= MAX_TIME:
            raise ValueError("newest_time is not a time")
    except FileNotFoundError:
        return AgentState(environment)
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise Invalid(
            f"could not read {path} ({error}): delete it to start with a new state. The agent then pins the key of the "
            "next contact"
        ) from None
    if state.environment != environment:
        raise Invalid(
            f"{path.parent} contains maps of environment {state.environment!r:.80}, not {environment!r:.80}: "
            "use one directory for each environment"
        )
    return state


def save(path: Path, state: AgentState) -> None:
    """Write the state atomically and durably."""
    body = {
        "form": STATE_FORMAT,
        "environment": state.environment,
        "key": base64.b64encode(state.key).decode() if state.key else None,
        "given": state.given,
        "channel": state.channel,
        "marks": {c: mark._asdict() for c, mark in sorted(state.marks.items())},
        "etag": state.etag,
        "expires": state.expires,
        "asked": state.asked,
        "activated": state.activated,
        "working": state.working,
        "newest_time": state.newest_time,
        "boot": state.boot,
    }
    write_durably(path, json.dumps(body, indent=1).encode() + b"\n")


def read_boot_id() -> str | None:
    """Return the id of the machine's present boot; None if the system has none."""
    try:
        return BOOT_ID.read_text().strip() or None
    except OSError:
        return None


def _text(value: Any) -> str | None:
    return None if value is None else str(value)


def _name(value: Any) -> str | None:
    """Check the name of a version folder."""
    if value is not None and (not isinstance(value, str) or "/" in value or value in ("", ".", "..")):
        raise ValueError(f"invalid version folder {value!r:.80}")
    return value


class StateStore:
    """The state in memory and on disk. If a write fails, the next ``save`` repeats it."""

    def __init__(self, path: Path, environment: str, free_space: Callable[[], None]) -> None:
        """Create a store. free_space: called if the disk is full, before a second attempt to write."""
        self._path, self._free_space = path, free_space
        self.value = AgentState(environment)
        self._unsaved = False

    def load(self) -> None:
        """Read the state from disk. Raises Invalid."""
        self.value = load(self._path, self.value.environment)

    def stage(self, state: AgentState) -> None:
        """Replace the state in memory; the next ``save`` writes it."""
        if state != self.value:
            self.value, self._unsaved = state, True

    def set(self, **changes: Any) -> None:
        """Replace some attributes and save."""
        self.save(dataclasses.replace(self.value, **changes))

    def save(self, state: AgentState) -> None:
        """Save a state if it has changed or the last write failed."""
        self.stage(state)
        if self._unsaved:
            try:
                save(self._path, state)
            except OSError as error:
                if error.errno not in (errno.ENOSPC, errno.EDQUOT):
                    raise
                self._free_space()
                save(self._path, state)
            self._unsaved = False


def write_durably(path: Path, data: bytes) -> None:
    """Replace a file atomically and durably: it survives a power cut."""
    write_atomically(path, data)
    sync_folder(path.parent)


def write_atomically(path: Path, data: bytes) -> None:
    """Replace a file atomically. Never follows a planted link; removes its temporary file if writing fails."""
    temporary = path.with_name(f".{path.name}.new")
    temporary.unlink(missing_ok=True)
    try:
        with temporary.open("xb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        temporary.replace(path)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise


def sync_folder(path: Path) -> None:
    """Sync a folder, so that renames in it survive a power cut."""
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def digest(path: Path) -> str:
    """Return the SHA-256 of a file."""
    total, buffer = hashlib.sha256(), memoryview(bytearray(HASH_BYTES))
    with path.open("rb", buffering=0) as stream:
        while count := stream.readinto(buffer):
            total.update(buffer[:count])
    return total.hexdigest()
