"""The arguments that every change has in common: its author, message, condition and idempotency key."""

from __future__ import annotations

from dataclasses import dataclass, replace

from app.store.values import Idempotency


@dataclass(frozen=True, slots=True)
class CommitRequest:
    """Who changes an environment, why, and on which condition.

    if_match: an ``If-Match`` header, which must name the head. idempotency_key: a header as well, unchecked. dry_run:
    store the result as a dry run instead of committing it.
    """

    author: str
    message: str = ""
    if_match: str | None = None
    idempotency_key: str | None = None
    dry_run: bool = False

    def with_message(self, message: str) -> CommitRequest:
        """Return the same request with another message."""
        return replace(self, message=message)

    def as_dry_run(self, dry_run: bool) -> CommitRequest:
        """Return the same request as a dry run, if ``dry_run`` is true."""
        return replace(self, dry_run=dry_run)

    def with_default_message(self, message: str) -> CommitRequest:
        """Return the same request, with this message if it has none."""
        return self if self.message else replace(self, message=message)

    def idempotency(self, fingerprint: str) -> Idempotency | None:
        """Return the key with the fingerprint of the request's content, None for a dry run, which uses up no key.

        Raises Invalid if the key is invalid.
        """
        key = None if self.idempotency_key is None else Idempotency(self.idempotency_key, fingerprint)
        return None if self.dry_run else key
