"""Forms of settings: sizes with units, networks, URLs."""

from __future__ import annotations

import ipaddress
import re
from decimal import Decimal

_UNITS = {"": 1, "b": 1} | {f"{p}b": 1000**n for n, p in enumerate("kmgt", 1)}
_UNITS |= {f"{p}ib": 1024**n for n, p in enumerate("kmgt", 1)}
_SIZE = re.compile(r"([0-9]+(?:\.[0-9]+)?)\s*([a-z]*)", re.IGNORECASE)


def parse_size(text: str) -> int:
    """Parse a size such as ``512MiB``, ``2 GB`` or ``1048576`` as bytes. Raises ValueError."""
    match = _SIZE.fullmatch(text.strip())
    factor = _UNITS.get(match[2].lower()) if match else None
    if match is None or factor is None:
        raise ValueError(
            f"must be a size in bytes, such as 512MiB or 2GB, got {text[:40]!r}: units are kB, MB, GB and TB "
            "(powers of 1000), KiB, MiB, GiB and TiB (powers of 1024)"
        )
    size = Decimal(match[1]) * factor
    if size != int(size):
        raise ValueError(f"must be a whole number of bytes, got {text[:40]!r}")
    return int(size)


def format_size(size: int) -> str:
    """Format bytes for ``parse_size``, with the largest unit that gives a whole number."""
    for unit, factor in (("GiB", 2**30), ("MiB", 2**20), ("KiB", 2**10)):
        if size and size % factor == 0:
            return f"{size // factor}{unit}"
    return str(size)


def parse_networks(text: str) -> list[ipaddress.IPv4Network | ipaddress.IPv6Network]:
    """Parse comma-separated addresses and CIDRs. Raises ValueError."""
    out = []
    for part in filter(None, (part.strip() for part in text.split(","))):
        try:
            out.append(ipaddress.ip_network(part))
        except ValueError as error:
            raise ValueError(f"{error}: use networks such as 192.168.7.0/24, comma-separated") from None
    return out


_ORIGIN = re.compile(r"(https?://(?:[a-z0-9.-]+|\[[0-9a-f:.]+\])(?::[0-9]{1,5})?)/[!-~]*", re.IGNORECASE)


def basemap_origin(url: str) -> str | None:
    """Return the origin of a base map's tiles; None if the URL is no plain one with a host."""
    match = _ORIGIN.fullmatch(url)
    return match[1].lower() if match else None
