"""Forms of settings: sizes with units, networks, URLs."""

from __future__ import annotations

import ipaddress
import re
from decimal import Decimal
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

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


def check_public_url(url: str | None) -> str | None:
    """Check the server's address for its clients; return it. Raises ValueError."""
    if url is not None and (basemap_origin(url + "/") is None or "?" in url or "#" in url):
        raise ValueError("public_url must be scheme, host and optional path: https://host/path")
    return url


def check_blob_url(url: str | None) -> str | None:
    """Check where uploaded files are kept; return it. Raises ValueError."""
    if url is None:
        return None
    if "://" in url and not url.startswith(("file://", "s3://")):
        raise ValueError("unsupported scheme: use a path, a file:// URL or s3://bucket/prefix")
    if url.startswith("s3://") and not urlsplit(url).netloc:
        raise ValueError("no bucket: use s3://bucket or s3://bucket/prefix")
    return url


def check_basemap(url: str) -> None:
    """Check the URL of a base map. Raises ValueError."""
    if basemap_origin(url) is None:
        raise ValueError("basemap_url must be a complete URL without a user: https://host/{z}/{x}/{y}.png")
    if not all(name in url for name in ("{z}", "{x}", "{y}")):
        raise ValueError("basemap_url must contain {z}, {x} and {y}")


def check_imagery(url: str, kind: str) -> None:
    """Check the URL of an imagery provider, of the kind ``xyz``, ``wms`` or ``mapbox``. Raises ValueError."""
    parts = urlsplit(url)
    if parts.scheme not in ("http", "https") or not parts.hostname or "{" in parts.netloc:
        raise ValueError("imagery_url must be a complete URL: https://host/…")
    query = {key.upper() for key in parse_qs(parts.query, keep_blank_values=True)}
    tiled = [("{z}", "{TileMatrix}"), ("{x}", "{TileCol}"), ("{y}", "{-y}", "{TileRow}")]
    if kind == "xyz" and not all(any(name in url for name in names) for names in tiled):
        raise ValueError("imagery_url of tiles must contain {z}, {x} and {y} (or {-y}; WMTS: {TileMatrix} …)")
    if kind == "wms" and "LAYERS" not in query:
        raise ValueError("imagery_url of a WMS must contain its layers: https://host/wms?layers=…")


BROKER_PORTS = {"mqtt": 1883, "mqtts": 8883}
"""Schemes of MQTT brokers, with their default ports."""


def check_broker(url: str | None, password_file: Path | None, ca: Path | None) -> None:
    """Check the address of an MQTT broker, and the files that go with it. Raises ValueError."""
    if url is None:
        if password_file is not None or ca is not None:
            raise ValueError("mqtt_password_file and mqtt_ca require mqtt_url")
        return
    parts = urlsplit(url)
    rest = parts.path.strip("/") or parts.query or parts.fragment
    if parts.scheme not in BROKER_PORTS or not parts.hostname or rest or parts.port == 0:
        raise ValueError("mqtt_url must be mqtt://[user[:password]@]host[:port], or mqtts:// for TLS")
    if ca is not None and parts.scheme != "mqtts":
        raise ValueError("mqtt_ca requires TLS: mqtts://host")
    if password_file is not None and (not parts.username or parts.password is not None):
        raise ValueError("mqtt_password_file requires a user in mqtt_url, without a password: mqtts://user@host")
    if parts.username and parts.password is None and password_file is None:
        raise ValueError("mqtt_url has a user without a password: add it, or set mqtt_password_file")
