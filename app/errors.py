"""The one error tree. It knows no HTTP; ``app.api.http.problems`` maps a class to a status.

Every error says in ``detail`` what went wrong and what the user can do about it; ``problems`` name the places.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

DISK_FULL_ERRNOS = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
"""What writing fails with where the disk is full, or a quota or the process's limit is reached."""

BROKEN_STORAGE_ERRNOS = frozenset({errno.EIO, errno.EBADMSG, errno.EUCLEAN})
"""What reading damaged storage fails with. All others (too many open files, no permission) say nothing about bytes."""


def system_reason(error: OSError) -> str:
    """Why the system refuses, without the path, for clients and the log."""
    return os.strerror(error.errno) if error.errno else type(error).__name__


@dataclass(frozen=True, slots=True)
class Problem:
    """One thing that is wrong or doubtful, and where: file name, line (from 1), key or element path.

    level: of a finding about a served or checked map: ``error`` where its consumer would refuse or misread it,
    ``warning`` where it may not like it.
    """

    problem: str
    file: str | None = None
    line: int | None = None
    where: str | None = None
    level: Literal["error", "warning"] | None = None

    def as_dict(self) -> dict[str, str | int]:
        """The problem as JSON, without its empty members."""
        members = {"file": self.file, "line": self.line, "where": self.where, "problem": self.problem}
        members |= {"level": self.level}
        return {name: value for name, value in members.items() if value is not None}


class FleetMapError(Exception):
    """Base of all errors that a user can be told about."""

    def __init__(self, detail: str, problems: Sequence[Problem] = ()) -> None:
        super().__init__(detail)
        self.detail = detail
        self.problems = tuple(problems)

    def __reduce__(self) -> tuple[type[FleetMapError], tuple[Any, ...]]:
        return type(self), (self.detail, self.problems)


class NotFound(FleetMapError):
    """No such environment, version, map, grid, source, job or token."""


class Gone(NotFound):
    """It was here and has been deleted."""


class Invalid(FleetMapError):
    """A parameter, name or request body that cannot be used."""


class BadUpload(FleetMapError):
    """An upload that cannot be taken in."""


class UnreadableFile(BadUpload):
    """A file that is not what its format says."""


class TooLarge(BadUpload):
    """An upload, what it would unfold to, or an answer over Zenoh, beyond a limit (limits are settings)."""


class UnsafeArchive(BadUpload):
    """An archive with links, escaping names, overlaps or encrypted members."""


class CannotConvert(FleetMapError):
    """The stored layers do not give the wanted map; ``detail`` says what to supply."""


class CannotDerive(CannotConvert):
    """A derivation found nothing in the stored content that it can use; ``step`` is its name.

    choose: it found several things, and none was named.
    """

    def __init__(self, detail: str, problems: Sequence[Problem] = (), step: str = "", *, choose: bool = False) -> None:
        super().__init__(detail, problems)
        self.step, self.choose = step, choose

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.detail, self.problems, self.step), {"choose": self.choose}


class CannotGenerate(FleetMapError):
    """A generator cannot make a site of these parameters; ``detail`` says which to change."""


class MissingLayer(CannotConvert):
    """A layer that the format needs neither exists nor can be derived."""


class MissingDatum(CannotConvert):
    """The format speaks of places on earth and the environment has no datum."""


class Ambiguous(CannotConvert):
    """Several parts fit and none was named."""


class Conflict(FleetMapError):
    """The request does not fit the present state (a taken name, a reused idempotency key)."""


class StaleParent(Conflict):
    """The head has moved since the version that the request was based on."""


class Denied(FleetMapError):
    """A token without the role or the scope that the call needs."""


class Unauthenticated(Denied):
    """No token, or an unknown or expired one."""


class InvalidLink(Denied):
    """A signed link that was altered or never made here, or whose environment is deleted."""


class ExpiredLink(Denied):
    """A signed link whose time is over."""


class Unavailable(FleetMapError):
    """Not now: too much work, a store that does not answer. Trying again later may help."""


class NoRoom(Unavailable):
    """The server's disk is full: nothing can be stored, what is stored can be read."""


class DatabaseDamaged(Unavailable):
    """The database itself is malformed, missing or was replaced: an operator must act."""


class Damaged(FleetMapError):
    """Stored bytes that no longer match their hash. An alarm, never served."""


class Untrusted(FleetMapError):
    """What a robot was told and must not believe: a foreign signature, an old or expired manifest, wrong bytes."""
