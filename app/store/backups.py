"""What a server remembers of its backups: the last success, failures since, and the places that it writes to.

It is a document in the database, so that a restored copy of the database still knows its places. Backups leave it out,
since it has the secrets of encrypted places.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from typing import Any, Final

from app.backends.documents import Document

DOCUMENT: Final = "backup"


@dataclass(frozen=True, slots=True)
class BackupRecord:
    """Last successful backup. destination: without secrets. size: bytes of all that it consists of; written: by it."""

    finished: datetime
    destination: str
    snapshot: str
    size: int
    written: int
    seconds: float


@dataclass(frozen=True, slots=True)
class BackupFailures:
    """Failed backups since the last success. last: time and reason of the last one, None if there is none."""

    count: int
    last: tuple[datetime, str] | None


@dataclass(frozen=True, slots=True)
class KnownPlace:
    """Place of backups that belongs to this server. key: names its content; recipients: of age, none: not encrypted."""

    id: str
    key: bytes
    recipients: tuple[str, ...]


class Backups:
    """Records of backups in one document."""

    def __init__(self, document: Document) -> None:
        self._document = document

    def last(self) -> BackupRecord | None:
        """Return the last successful backup, None if there was none. Raises Unavailable."""
        members = self._read().get("last")
        if members is None:
            return None
        return BackupRecord(**{**members, "finished": datetime.fromisoformat(members["finished"])})

    def failures(self) -> BackupFailures:
        """Return the failures since the last success. Raises Unavailable."""
        members = self._read()
        reason = members.get("failure")
        last = None if reason is None else (datetime.fromisoformat(reason["time"]), str(reason["reason"]))
        return BackupFailures(int(members.get("failures", 0)), last)

    def note_success(self, record: BackupRecord) -> None:
        """Store a successful backup. Raises Unavailable."""
        last = {**asdict(record), "finished": record.finished.isoformat()}
        self._change({"last": last, "failures": 0, "failure": None})

    def note_failure(self, time: datetime, reason: str) -> None:
        """Count a failed backup. Raises Unavailable."""
        count = int(self._read().get("failures", 0)) + 1
        self._change({"failures": count, "failure": {"time": time.isoformat(), "reason": reason[:500]}})

    def place(self, id_: str) -> KnownPlace | None:
        """Return a place of backups by its id, None if it does not belong to this server. Raises Unavailable."""
        members = self._read().get("places", {}).get(id_)
        if members is None:
            return None
        return KnownPlace(id_, base64.b64decode(members["key"]), tuple(members["recipients"]))

    def add_place(self, id_: str, key: bytes, recipients: Sequence[str]) -> None:
        """Remember a place of backups. Raises Unavailable."""
        place = {"key": base64.b64encode(key).decode(), "recipients": list(recipients)}
        self._change({"places": {**self._read().get("places", {}), id_: place}})

    def _read(self) -> dict[str, Any]:
        return _parse(self._document.read())

    def _change(self, members: dict[str, Any]) -> None:
        self._document.update(lambda content: json.dumps(_parse(content) | members).encode(), notify=False)


def _parse(content: bytes | None) -> dict[str, Any]:
    members: dict[str, Any] = json.loads(content or b"{}")
    return members
