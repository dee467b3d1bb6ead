"""Clock for manifest expiry, and freshness of the server's responses.

A robot's clock may be wrong, set back by an attacker, or unset after a power cut. So expiry is judged by the newer of
the clock and the newest signed time. A signed time far ahead of a plausible clock is ignored: otherwise a server whose
clock was wrong for a while would make all later manifests look expired. Freshness is judged by the monotonic clock
alone, which cannot be set.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from app.agent.signed_manifest import MAX_CLOCK_SKEW, Manifest

MIN_PLAUSIBLE_TIME = 1767225600.0
"""2026-01-01 in seconds since 1970; a clock before it counts as unset."""

MAX_PLAUSIBLE_TIME = MIN_PLAUSIBLE_TIME + 10 * 365 * 86400.0
"""Latest signed time that a robot with an unset clock accepts at first contact, in seconds since 1970."""

MAX_AHEAD_SECONDS = 12 * 3600.0
"""Maximum lead of an accepted signed time over a plausible clock. Manifests are valid for longer (one day), so a
server whose clock was this far ahead blocks no robot after it is corrected.
"""

MAX_JUMP_SECONDS = 30 * 86400.0
"""Maximum lead of an accepted signed time over the newest one if the clock is unset."""

STALE_SECONDS = 1800.0
"""Time without a newer signed response after which the server counts as frozen; at least three polls. Manifests are
signed again every 600 seconds.
"""

BEHIND_SECONDS = 60.0
"""Time after which a server behind its announced events is reported."""

FORGET_SECONDS = 900.0
"""Time after which an unconfirmed announcement is dropped: on an open router anyone can publish events."""


class SignedClock:
    """The newer of the robot's clock and the newest signed time (``floor``), in seconds since 1970."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self.floor = 0.0

    def now(self) -> float:
        """Return the time for checks of expiry."""
        return max(self._clock(), self.floor)

    @property
    def local(self) -> float:
        """Time of the robot's own clock."""
        return self._clock()

    def is_plausible(self, manifest: Manifest) -> bool:
        """Whether the signed time of a manifest is accepted; True if an older server sends none."""
        if manifest.time is None:
            return True
        clock = self._clock()
        if clock >= MIN_PLAUSIBLE_TIME:
            limit = clock + MAX_AHEAD_SECONDS
        else:
            limit = self.floor + MAX_JUMP_SECONDS if self.floor else MAX_PLAUSIBLE_TIME
        return manifest.time.timestamp() <= limit

    def observe(self, manifest: Manifest) -> None:
        """Advance the floor to the time of a verified manifest."""
        if manifest.time is not None and self.is_plausible(manifest):
            self.floor = max(self.floor, manifest.time.timestamp())


class Freshness:
    """Check that signed responses become newer and keep up with announced events."""

    def __init__(self, poll_seconds: float, time_text: Callable[[], str]) -> None:
        self._stale_after = max(STALE_SECONDS, 3 * poll_seconds)
        self._time_text = time_text
        self._newest = self._newest_ahead = 0.0
        self._newest_at: tuple[float, str] = (time.monotonic(), time_text())
        self._responded_at = self._newest_at[0]
        self._announced: tuple[int, float, str] | None = None

    def note_response(self) -> None:
        """Record that the server has just returned a channel's manifest, also an unchanged one."""
        self._responded_at = time.monotonic()

    def observe(self, manifest: Manifest, clock: float) -> None:
        """Record a channel's verified manifest. Without a signed time (older server) its expiry is used.

        Times ahead of the robot's clock are compared only with each other, so a single one does not outdate all
        later ones.
        """
        signed = (manifest.time or manifest.expires).timestamp()
        is_ahead = signed > clock + MAX_CLOCK_SKEW.total_seconds()
        if signed <= (self._newest_ahead if is_ahead else self._newest):
            return
        if is_ahead:
            self._newest_ahead = signed
        else:
            self._newest = signed
        self._newest_at = (time.monotonic(), self._time_text())

    def stale_problem(self) -> str | None:
        """Return the problem if the server counts as frozen, else None.

        The age counts until the server's last response: downloads and hooks that take long are no fault of the server.
        """
        at, text = self._newest_at
        if self._responded_at - at <= self._stale_after:
            return None
        return (
            f"no new signed response since {text}: the server or a proxy repeats old responses. "
            "Check the server's clock and the proxies in front of it"
        )

    def announce(self, sequence: int) -> None:
        """Record a sequence of the channel that an event has announced."""
        if self._announced is None or sequence > self._announced[0]:
            self._announced = (sequence, time.monotonic(), self._time_text())

    def behind_remark(self, accepted: int) -> str | None:
        """Return a remark if the server is behind its announced events, else None.

        Args:
            accepted: highest accepted sequence of the channel.
        """
        if self._announced is None:
            return None
        sequence, at, text = self._announced
        age = time.monotonic() - at
        if accepted >= sequence or age > FORGET_SECONDS:
            self._announced = None
            return None
        if age < BEHIND_SECONDS:
            return None
        return f"the server is behind its events: sequence {sequence} was announced at {text}, it returns {accepted}"
