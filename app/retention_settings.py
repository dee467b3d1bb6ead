"""Settings of what is kept, a part of ``app.config.Settings``: versions, uploads, robots."""

from __future__ import annotations

from typing import Any, Self

from pydantic import Field, field_validator, model_validator
from pydantic_settings import BaseSettings

from app.errors import Invalid
from app.store.retention_rule import Rule


class RetentionSettings(BaseSettings):
    """Which versions and uploads stay by their age, and how many robots."""

    max_robots: int = Field(
        default=10_000,
        ge=1,
        le=100_000,
        description="Maximum number of robots in an environment; statuses of further ones are refused. On a router "
        "without users anyone can invent robots. The page's view of a fleet reads all of its robots: with 100 000 that "
        "takes some 200 MB of memory and 10 seconds.",
    )
    retention_all_days: int | None = Field(
        default=None,
        ge=1,
        le=100_000,
        description="Days of which all versions stay. Older ones are thinned once a day, but for one a day "
        "(`FLEETMAP_RETENTION_DAILY_DAYS`) and for those in use: tagged, on a channel, held by a robot. Unset: "
        "everything stays.",
    )
    retention_daily_days: int = Field(
        default=365,
        ge=0,
        le=100_000,
        description="Days of which the last version of each day stays; 0: none.",
    )
    retention_last: int = Field(
        default=10, ge=1, le=1_000_000, description="Number of the newest versions that stay, however old."
    )
    retention_source_days: int | None = Field(
        default=None,
        ge=1,
        le=100_000,
        description="Days after which uploaded files of kept versions go, if their content is in the layers and the "
        "server writes their format; what no layer has, such as comments, is lost. Unset: they stay.",
    )

    @field_validator("retention_all_days", "retention_source_days", mode="before")
    @classmethod
    def _no_days_are_unset(cls, value: Any) -> Any:
        return None if value == "" else value

    @model_validator(mode="after")
    def _retention_is_consistent(self) -> Self:
        if self.retention is not None:
            try:
                self.retention.check()
            except Invalid as error:
                raise ValueError(error.detail) from error
        return self

    @property
    def retention(self) -> Rule | None:
        """Rule of retention, None if everything stays."""
        if self.retention_all_days is None:
            return None
        return Rule(self.retention_all_days, self.retention_daily_days, self.retention_last, self.retention_source_days)
