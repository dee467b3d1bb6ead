"""Error classes. They are independent of HTTP; ``app.api.http.problems`` maps each class to a status.

``detail`` of an error states what is wrong and what to do about it; ``problems`` name the locations.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

DISK_FULL_ERRNOS = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
"""Error numbers of a failed write: disk full, quota reached, or file size limit of the process."""

BROKEN_STORAGE_ERRNOS = frozenset({errno.EIO, errno.EBADMSG, errno.EUCLEAN})
"""Error numbers of reading damaged storage. Others (too many open files, no permission) do not indicate damage."""


def system_reason(error: OSError) -> str:
    """Return the reason of a system error without the path, for clients and the log."""
    return os.strerror(error.errno) if error.errno else type(error).__name__


@dataclass(frozen=True, slots=True)
class Problem:
    """Problem and its location: file name, line (from 1), key or element path.

    level: for findings of a map check: ``error`` if the consumer would reject or misread the map, ``warning`` if it
    might.
    """

    problem: str
    file: str | None = None
    line: int | None = None
    where: str | None = None
    level: Literal["error", "warning"] | None = None

    def as_dict(self) -> dict[str, str | int]:
        """Convert the problem to JSON, without empty members."""
        members = {"file": self.file, "line": self.line, "where": self.where, "problem": self.problem}
        members |= {"level": self.level}
        return {name: value for name, value in members.items() if value is not None}


class FleetMapError(Exception):
    """Base class of all errors that are reported to users."""

    def __init__(self, detail: str, problems: Sequence[Problem] = ()) -> None:
        super().__init__(detail)
        self.detail = detail
        self.problems = tuple(problems)

    def __reduce__(self) -> tuple[type[FleetMapError], tuple[Any, ...]]:
        return type(self), (self.detail, self.problems)


class NotFound(FleetMapError):
    """No such environment, version, map, grid, source, job or token."""


class Gone(NotFound):
    """A resource that has been deleted."""


class Thinned(NotFound):
    """A version or an uploaded file whose content a rule of retention has removed."""


class Invalid(FleetMapError):
    """Invalid parameter, name or request body."""


class BadUpload(FleetMapError):
    """Upload that cannot be stored."""


class UnreadableFile(BadUpload):
    """File that violates its format."""


class TooLarge(BadUpload):
    """Upload, its uncompressed content, or Zenoh reply above a limit (limits are settings)."""


class UnsafeArchive(BadUpload):
    """Archive with links, names outside of it, overlaps or encrypted members."""


class CannotConvert(FleetMapError):
    """The stored layers cannot be converted to the requested map; ``detail`` states what to supply."""


class CannotDerive(CannotConvert):
    """A derivation found no usable content; ``step`` is its name.

    choose: it found several candidates, and the request selects none.
    """

    def __init__(self, detail: str, problems: Sequence[Problem] = (), step: str = "", *, choose: bool = False) -> None:
        super().__init__(detail, problems)
        self.step, self.choose = step, choose

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.detail, self.problems, self.step), {"choose": self.choose}


class CannotGenerate(FleetMapError):
    """A generator cannot create a site with these parameters; ``detail`` states which to change."""


class MissingLayer(CannotConvert):
    """A layer that the format needs neither exists nor can be derived."""


class MissingDatum(CannotConvert):
    """The format needs WGS 84 coordinates and the environment has no datum."""


class Ambiguous(CannotConvert):
    """Several parts match and the request selects none."""


class Conflict(FleetMapError):
    """The request conflicts with the current state (name already exists, idempotency key reused)."""


class Mirrored(Conflict):
    """A change of an environment that follows another server, where it must be made."""


class StaleParent(Conflict):
    """The head has moved since the version that the request was based on."""


class Denied(FleetMapError):
    """Token without the role or the scope that the call requires."""


class Unauthenticated(Denied):
    """Missing, unknown or expired token."""


class InvalidLink(Denied):
    """Signed link that was altered, was not created by this server, or whose environment is deleted."""


class ExpiredLink(Denied):
    """Expired signed link."""


class Unavailable(FleetMapError):
    """Temporarily unavailable: overload, or no response from the store. Retry later."""


class NoRoom(Unavailable):
    """The server's disk is full: writes fail, reads work."""


class DatabaseDamaged(Unavailable):
    """The database is malformed, missing or was replaced: an operator must act."""


class Damaged(FleetMapError):
    """Stored bytes that do not match their hash; never served."""


class LostBlobs(Damaged):
    """Stored files that are not where they are read; ``names`` are their hashes. Workers get them and try again."""

    def __init__(self, detail: str, problems: Sequence[Problem] = (), names: Sequence[str] = ()) -> None:
        super().__init__(detail, problems)
        self.names = tuple(names)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.detail, self.problems, self.names)


class Untrusted(FleetMapError):
    """Data that a robot must reject: a foreign signature, an old or expired manifest, wrong bytes."""
