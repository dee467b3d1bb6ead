"""What survives a restart, in one small file that is replaced whole: what was believed last, and what is still to do.

What is installed is not told here but by the folder itself (``current`` and the manifest in it): one truth for each.
"""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from app.errors import Invalid

FORM = 1
HASH_BYTES = 1 << 18


@dataclass(frozen=True, slots=True)
class State:
    """marks: channel -> (sequence, root) of the newest manifest ever believed. etag, expires (seconds since 1970) and
    asked (channel and formats) are of the manifest that is installed. activated: the folder for which the hooks have
    run; None while they do.
    """

    environment: str
    key: bytes | None = None
    given: str | None = None
    channel: str | None = None
    marks: Mapping[str, tuple[int, str]] = field(default_factory=dict)
    etag: str | None = None
    expires: float = 0.0
    asked: str = ""
    activated: str | None = None

    def marked(self, channel: str, sequence: int, root: str) -> State:
        """After a manifest of this channel was believed."""
        return dataclasses.replace(self, marks={**self.marks, channel: (sequence, root)}, channel=channel)


def load(path: Path, environment: str) -> State:
    """What stands there, or a fresh one; Invalid where it is of another environment or not to be read."""
    try:
        body = json.loads(path.read_bytes())
        if body["form"] != FORM:
            raise ValueError(f"it has the form {body['form']}")
        found = State(
            environment=str(body["environment"]),
            key=base64.b64decode(body["key"]) if body.get("key") else None,
            given=body.get("given"),
            channel=body.get("channel"),
            marks={str(c): (int(m["sequence"]), str(m["root"])) for c, m in body["marks"].items()},
            etag=body.get("etag"),
            expires=float(body.get("expires", 0)),
            asked=str(body.get("asked", "")),
            activated=body.get("activated"),
        )
    except FileNotFoundError:
        return State(environment)
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise Invalid(
            f"{path} cannot be read ({error}). Remove it to start afresh; the key is then pinned anew at first contact"
        ) from None
    if found.environment != environment:
        raise Invalid(f"{path.parent} holds maps of {found.environment}, not of {environment}: use a folder for each")
    return found


def save(path: Path, state: State) -> None:
    """Whole or not at all, also where the power goes."""
    body = {
        "form": FORM,
        "environment": state.environment,
        "key": base64.b64encode(state.key).decode() if state.key else None,
        "given": state.given,
        "channel": state.channel,
        "marks": {c: {"sequence": s, "root": r} for c, (s, r) in sorted(state.marks.items())},
        "etag": state.etag,
        "expires": state.expires,
        "asked": state.asked,
        "activated": state.activated,
    }
    write_whole(path, json.dumps(body, indent=1).encode() + b"\n")


def write_whole(path: Path, data: bytes) -> None:
    """Replace a file at once, and for good."""
    write_new(path, data)
    sync_folder(path.parent)


def write_new(path: Path, data: bytes) -> None:
    """Replace a file at once. No link that somebody has put beside it is followed, and no full disk left fuller."""
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
    """What was renamed in it stays so after a power cut."""
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def digest(path: Path) -> str:
    """SHA-256 of a file."""
    total, buffer = hashlib.sha256(), memoryview(bytearray(HASH_BYTES))
    with path.open("rb", buffering=0) as stream:
        while count := stream.readinto(buffer):
            total.update(buffer[:count])
    return total.hexdigest()
