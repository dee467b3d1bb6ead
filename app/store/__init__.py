"""The versioned store: environments, versions, content, channels, tokens, events and jobs, on SQLite or PostgreSQL."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from app.errors import Problem
from app.model.features import Features
from app.model.frame import Anchor, Datum
from app.model.layers import Layer, Layers, PartKey
from app.store.blobs import Blobs
from app.store.changes import Changes, Prepared
from app.store.values import (
    Box,
    Channel,
    Delta,
    Environment,
    Event,
    Found,
    Idempotency,
    Job,
    Role,
    Source,
    State,
    Token,
    Version,
)


class Store:
    """One database and one blob folder. Thread-safe; cheap to open again in a worker process."""

    database_url: str
    blob_dir: Path
    readonly: bool
    blobs: Blobs

    def __init__(self, database_url: str, blob_dir: Path, *, readonly: bool = False) -> None:
        raise NotImplementedError

    def migrate(self) -> None:
        """Bring the database's schema up to date (creates it where there is none)."""
        raise NotImplementedError

    def check(self) -> None:
        """Unavailable unless database and blob folder answer and the schema is current."""
        raise NotImplementedError

    def recover(self) -> None:
        """At start: remove what a killed upload left behind."""
        raise NotImplementedError

    def collect(self, grace: timedelta) -> dict[str, int]:
        """Remove chunks and blobs that nothing refers to and that were not used within the grace period."""
        raise NotImplementedError

    def close(self) -> None:
        """Give back connections."""
        raise NotImplementedError

    # --- environments ---

    def create_environment(
        self,
        name: str,
        *,
        title: str = "",
        description: str = "",
        tags: Sequence[str] = (),
        author: str = "",
        datum: Datum | None = None,
        clone: Version | None = None,
    ) -> Environment:
        """A new environment."""
        raise NotImplementedError

    def environment(self, name: str, *, deleted: bool = False) -> Environment:
        """The environment; Gone where it is deleted (unless asked for), NotFound where it never was."""
        raise NotImplementedError

    def environments(
        self,
        *,
        q: str | None = None,
        contains: tuple[float, float] | None = None,
        bbox: Box | None = None,
        limit: int = 100,
        cursor: str | None = None,
        allowed: str | None = None,
        deleted: bool = False,
    ) -> tuple[list[Environment], str | None]:
        """A page of environments by name, and the cursor of the next page."""
        raise NotImplementedError

    def update_environment(
        self,
        name: str,
        *,
        new_name: str | None = None,
        title: str | None = None,
        description: str | None = None,
        tags: Sequence[str] | None = None,
        author: str = "",
    ) -> Environment:
        """Rename or describe."""
        raise NotImplementedError

    def delete_environment(self, name: str, author: str = "") -> Environment:
        """Recoverable until purged."""
        raise NotImplementedError

    def restore_environment(self, name: str, author: str = "") -> Environment:
        """Undo a deletion."""
        raise NotImplementedError

    def purge_environment(self, name: str) -> None:
        """Remove a deleted environment for good."""
        raise NotImplementedError

    # --- versions ---

    def version(self, environment: str, ref: str | int = "latest") -> Version:
        """A version by number, channel or ``latest``."""
        raise NotImplementedError

    def versions(self, environment: str, *, limit: int = 100, before: int | None = None) -> list[Version]:
        """Newest first."""
        raise NotImplementedError

    def prepare(self, base: Version, changes: Changes) -> Prepared:
        """Work out a version: reads and computes only."""
        raise NotImplementedError

    def commit(
        self,
        environment: str,
        prepared: Prepared,
        *,
        author: str,
        message: str,
        sources: Sequence[Source] = (),
        warnings: Sequence[Problem] = (),
        idempotency: Idempotency | None = None,
    ) -> Version:
        """Make the prepared version the head, in one transaction; StaleParent where the head has moved."""
        raise NotImplementedError

    def add_sources(self, environment: str, version: int, sources: Sequence[Source]) -> Version:
        """Keep further files with a version."""
        raise NotImplementedError

    def revert(
        self,
        environment: str,
        to: int,
        *,
        author: str,
        message: str,
        expected: int | None = None,
        idempotency: Idempotency | None = None,
    ) -> Version:
        """A new version with the content of an old one."""
        raise NotImplementedError

    # --- content ---

    def load(self, version: Version, keys: Collection[PartKey] | None = None) -> Layers:
        """A version's content, or some parts of it."""
        raise NotImplementedError

    def features(
        self,
        version: Version,
        key: PartKey,
        *,
        bbox: Box | None = None,
        crs: Anchor = "local",
        ids: Collection[str] | None = None,
    ) -> Features:
        """Features of a vector part: all, those whose box meets ``bbox`` (in ``crs``), or those with these ids."""
        raise NotImplementedError

    def has_ids(self, version: Version, key: PartKey, ids: Collection[str]) -> set[str]:
        """Those of the ids that the part has."""
        raise NotImplementedError

    def get(self, version: Version, key: PartKey, ids: Collection[str]) -> Features:
        """The features with these ids, as far as they exist."""
        raise NotImplementedError

    def diff(self, a: Version, b: Version) -> dict[str, Any]:
        """What differs between two versions, by layer."""
        raise NotImplementedError

    def delta_parts(self, a: Version, b: Version) -> Delta:
        """What turns version a into version b."""
        raise NotImplementedError

    def find(self, bbox: Box, *, layer: Layer | None = None, limit: int = 1000) -> list[Found]:
        """Features of all environments' heads whose box meets ``bbox`` (west, south, east, north)."""
        raise NotImplementedError

    # --- channels ---

    def channels(self, environment: str) -> list[Channel]:
        """``latest`` first, then the others by name."""
        raise NotImplementedError

    def set_channel(
        self, environment: str, channel: str, version: int, *, author: str, activate_at: datetime | None = None
    ) -> Channel:
        """Move a channel, or plan its move."""
        raise NotImplementedError

    def cancel_planned(self, environment: str, channel: str, author: str) -> Channel:
        """Forget a planned move."""
        raise NotImplementedError

    def apply_due(self, now: datetime) -> list[tuple[str, Channel]]:
        """Carry out the planned moves whose time has come: (environment, channel)."""
        raise NotImplementedError

    # --- tokens, idempotency, events, jobs ---

    def create_token(
        self,
        name: str,
        role: Role,
        environments: str | None = None,
        robot: str | None = None,
        expires: datetime | None = None,
        token: str | None = None,
    ) -> tuple[Token, str]:
        """A token and its secret, which is told only now."""
        raise NotImplementedError

    def tokens(self) -> list[Token]:
        """All tokens, oldest first."""
        raise NotImplementedError

    def delete_token(self, id: str) -> None:
        """Revoke a token."""
        raise NotImplementedError

    def find_token(self, text: str) -> Token | None:
        """The token with this secret, unless unknown or expired."""
        raise NotImplementedError

    def idempotent(self, environment: str, key: str) -> tuple[str, int] | None:
        """(fingerprint, version number) of the request that used this key."""
        raise NotImplementedError

    def events(self, environment: str | None, since: int = 0, limit: int = 1000) -> list[Event]:
        """Events after ``since``: a sequence with an environment, else a position of the whole log."""
        raise NotImplementedError

    def create_job(self, owner: str = "", detail: str = "") -> Job:
        """A queued job."""
        raise NotImplementedError

    def update_job(
        self,
        id: str,
        *,
        state: State | None = None,
        progress: float | None = None,
        detail: str | None = None,
        result: dict[str, Any] | None = None,
        problem: dict[str, Any] | None = None,
    ) -> Job:
        """Change what is given."""
        raise NotImplementedError

    def job(self, id: str) -> Job:
        """A job."""
        raise NotImplementedError

    def jobs(self, *, state: State | None = None) -> list[Job]:
        """Jobs, oldest first."""
        raise NotImplementedError

    def delete_job(self, id: str) -> None:
        """Forget a job."""
        raise NotImplementedError
