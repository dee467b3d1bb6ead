"""Format requests of the agent, each with its parameters: ``occupancy_grid?level=L2&grid=map,tmap2``."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from urllib.parse import parse_qsl, quote

from app.errors import Invalid

_FORMAT = re.compile(r"[a-z0-9][a-z0-9_]{0,62}")


@dataclass(frozen=True, slots=True)
class FormatRequest:
    """A format and the parameters of its map."""

    name: str
    parameters: tuple[tuple[str, str], ...] = ()

    @property
    def entry(self) -> str:
        """Entry in the format list of a manifest request, not yet percent-encoded."""
        query = "&".join(f"{quote(name, safe='')}={quote(value, safe='')}" for name, value in self.parameters)
        return f"{self.name}?{query}" if query else self.name


def parse_formats(text: str) -> tuple[str, ...]:
    """Split a comma-separated list of formats. A comma or ``&`` inside a value is percent-encoded."""
    return tuple(part.strip() for part in text.split(",") if part.strip())


def parse_requests(required: Sequence[str], optional: Sequence[str]) -> tuple[FormatRequest, ...]:
    """Parse the entries of ``--formats`` and ``--optional``. Raises Invalid if a format is invalid or a duplicate."""
    requests: dict[str, FormatRequest] = {}
    for entry in (*required, *optional):
        name, _, query = entry.partition("?")
        if not _FORMAT.fullmatch(name):
            raise Invalid(
                f"invalid format {entry[:80]!r}: use NAME or NAME?PARAMETER=VALUE, such as occupancy_grid?level=L2"
            )
        if name in requests:
            raise Invalid(f"duplicate format {name}: name each format once, in --formats or in --optional")
        try:
            parameters = tuple(parse_qsl(query, keep_blank_values=True, strict_parsing=bool(query)))
        except ValueError:
            raise Invalid(f"invalid parameters {query[:80]!r}: use PARAMETER=VALUE, separated by &") from None
        requests[name] = FormatRequest(name, parameters)
    return tuple(requests.values())


def encode_entries(requests: Sequence[FormatRequest]) -> str:
    """Return the value of the query parameter ``formats`` or ``optional``."""
    return ",".join(quote(request.entry, safe="") for request in requests)
