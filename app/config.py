"""The settings: environment variables ``FLEETMAP_*``, a ``.env`` file, or flags of ``fleetmap serve``.

Nothing is read at import: a factory makes ``Settings()`` and passes it on. Every setting is described here, for the
documentation too; every field of ``app.limits.Limits`` is the setting ``FLEETMAP_MAX_<FIELD>``.
"""

from __future__ import annotations

import dataclasses
import ipaddress
import os
import re
from decimal import Decimal
from pathlib import Path
from typing import Any, Literal, Self
from urllib.parse import parse_qs, unquote, urlsplit

from pydantic import Field, SecretStr, ValidationInfo, field_validator, model_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from app.events.ros_names import parse_keys, parse_selectors
from app.limits import Limits
from app.logs import LogFormat

_DEFAULTS = Limits()

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
    """Format bytes as ``parse_size`` takes them, with the largest unit that leaves a whole number."""
    for unit, factor in (("GiB", 2**30), ("MiB", 2**20), ("KiB", 2**10)):
        if size and size % factor == 0:
            return f"{size // factor}{unit}"
    return str(size)


class Settings(BaseSettings):
    """Everything an operator can set. Times are seconds. Sizes (``…_bytes``) are bytes, or a number with a unit."""

    model_config = SettingsConfigDict(env_prefix="FLEETMAP_", env_file=".env", extra="ignore", frozen=True)

    data_dir: Path = Field(
        default=Path("data"),
        description="Folder for the database, the stored files and the cache; made where it is absent.",
    )
    database_url: str | None = Field(
        default=None,
        description="Database: `postgresql+psycopg://user:password@host/name` (with PostGIS), or a `sqlite:///…` file. "
        "Default: an SQLite file in the data folder.",
    )
    blob_url: str | None = Field(
        default=None,
        description="Where uploaded files are kept: a folder, as a path or `file://` address. Default: `blobs` in the "
        "data folder. All workers must see the same folder.",
    )
    host: str = Field(default="127.0.0.1", description="Address to listen on; `0.0.0.0` for all of the machine's.")
    port: int = Field(default=8000, ge=0, le=65535, description="Port to listen on.")
    tls_certificate: Path | None = Field(
        default=None, description="Certificate (PEM, with its chain) to serve HTTPS with. Unset: HTTP."
    )
    tls_key: Path | None = Field(default=None, description="Private key of that certificate (PEM).")
    workers: int = Field(default=1, ge=1, le=256, description="Processes that answer requests.")
    admin_token: SecretStr | None = Field(
        default=None,
        description="A first administrator's token, for containers and tests; use 32 random characters or more. "
        "Without it the first start makes one and prints it once.",
    )
    insecure_no_auth: bool = Field(
        default=False,
        description="Let everybody do everything without a token. Works only while listening on a loopback address.",
    )
    log_level: Literal["debug", "info", "warning", "error"] = Field(
        default="info",
        description="Lowest level that is logged. `warning`: refused tokens and failures; `info`: also changes and "
        "requests that take over a second; `debug`: all requests except those answered from memory.",
    )
    log_format: LogFormat = Field(
        default="text", description="Log format: `text`, lines for people, or `json`, one JSON object per line."
    )

    conversion_workers: int = Field(
        default_factory=lambda: max(1, min(8, os.cpu_count() or 1)),
        ge=1,
        le=256,
        description="Processes that read uploads and make maps, for each of the workers. Default: the number of "
        "processors, at most 8. While they are busy, one more computes coverage tables.",
    )
    conversion_queue: int = Field(
        default=64,
        ge=1,
        le=10_000,
        description="Conversions that may wait for a free process; further ones are answered 503.",
    )
    job_seconds: float = Field(
        default=20.0,
        gt=0,
        le=3600,
        description="A map that takes longer than this is answered 202 with the address of a job.",
    )
    cache_bytes: int = Field(
        default=4 * 2**30,
        ge=0,
        description="Room for finished maps in the data folder; the longest unused are given up first.",
    )
    memory_cache_bytes: int = Field(
        default=128 * 2**20, ge=0, description="Room for finished maps in the memory of each worker."
    )

    scrub_hours: float = Field(
        default=168.0,
        ge=0,
        le=8760,
        description="Hours between background checks of all stored data against its hashes, to find damage early; "
        "0: never.",
    )
    scrub_bytes_per_second: int = Field(
        default=4 * 2**20,
        ge=1024,
        description="Maximum read speed of these checks, so that they slow down no request.",
    )

    max_uploads: int = Field(
        default=8, ge=1, le=1000, description="Uploads that one worker takes in at once; further ones are answered 503."
    )
    max_json_bytes: int = Field(
        default=64 * 2**20, ge=1024, description="Largest request body that is not a file upload (edits, for instance)."
    )
    header_seconds: float = Field(
        default=20.0, gt=0, le=3600, description="Time in which a client must have sent a request's head."
    )
    body_seconds: float = Field(
        default=30.0,
        gt=0,
        le=3600,
        description="How long a client may pause while it sends a request body or reads a response. After that a body "
        "gets 408, and a response is cut off.",
    )
    body_pace: int = Field(
        default=1024,
        ge=1,
        description="Bytes per second that a client must send or read on average after the first "
        "`FLEETMAP_BODY_SECONDS`. A slower body gets 408, and a slower response is cut off.",
    )
    max_connections: int = Field(
        default=4096,
        ge=16,
        le=1_000_000,
        description="Maximum number of open connections for each of the workers; the limit of open files is raised for "
        "them. A quarter is only for clients with a valid token and for addresses that had one in the last 10 minutes. "
        "When all are taken, the oldest connection without a token is closed; if there is none, new ones get 503.",
    )
    max_connections_per_address: int = Field(
        default=512,
        ge=1,
        le=1_000_000,
        description="Maximum number of connections from one address that have not shown a valid token; beyond it the "
        "oldest is closed. Loopback addresses have no such limit. Behind a proxy on another machine: the value of "
        "`FLEETMAP_MAX_CONNECTIONS`.",
    )
    token_failures: int = Field(
        default=20,
        ge=1,
        le=10_000,
        description="Wrong tokens a minute from one address before further wrong ones get 429; a valid token is always "
        "accepted.",
    )

    zenoh_mode: Literal["router", "client", "off"] = Field(
        default="router",
        description="How events reach the fleet: `router` starts a Zenoh router beside the server, `client` uses the "
        "one at `FLEETMAP_ZENOH_CONNECT`, `off` sends none (robots poll).",
    )
    zenoh_listen: str = Field(
        default="tcp/127.0.0.1:7447",
        description="Where the router listens, separated by commas. A taken port means no events, told loudly and in "
        "`/readyz`.",
    )
    zenoh_connect: str = Field(
        default="",
        description="Routers to connect to, separated by commas (`tcp/router:7447`): needed as `client`; as `router` "
        "its own router joins them.",
    )
    zenoh_advertise: str = Field(
        default="",
        description="Where robots find the router, as `/readyz` tells them, separated by commas; `0.0.0.0` in it is "
        "told as the host that the robot asked. Default: as `router`, where it listens; as `client`, nothing.",
    )
    zenoh_prefix: str = Field(
        default="fleetmap",
        pattern=r"^[A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+)*$",
        description="Start of every key expression.",
    )
    zenoh_certificate: Path | None = Field(
        default=None,
        description="Certificate (PEM, with its chain) for `tls/` endpoints: the router shows it, and the server where "
        "a router asks for one.",
    )
    zenoh_key: Path | None = Field(default=None, description="Private key of that certificate (PEM).")
    zenoh_ca: Path | None = Field(
        default=None,
        description="Certification authority (PEM) that signs the router's certificate, and the robots' where they "
        "need one. Unset: the public ones.",
    )
    zenoh_mtls: bool = Field(
        default=False, description="Robots must show a certificate that `FLEETMAP_ZENOH_CA` has signed."
    )
    zenoh_users: Path | None = Field(
        default=None,
        description="File of `NAME:PASSWORD` lines, a robot's name each: nobody else comes in, and only the server "
        "puts events and maps; a robot puts its own status. Read at the start. Unset: everybody comes in.",
    )
    zenoh_user: str | None = Field(default=None, description="The server's name at the router, as `client`.")
    zenoh_password: SecretStr | None = Field(default=None, description="The server's password at the router.")
    zenoh_config: Path | None = Field(
        default=None,
        description="A JSON5 file of Zenoh's own configuration, for all else; access control that stands in it takes "
        "the place of ours.",
    )
    zenoh_max_reply_bytes: int = Field(
        default=64 * 2**20,
        ge=1024,
        description="Largest file (or grid for ROS 2) that goes over Zenoh; HTTP has no such bound. Its own router "
        "drops messages that are larger than this and than 65 MiB, unless there is a `zenoh_config`.",
    )

    ros2_environments: str = Field(
        default="",
        description="Environments whose maps go out as ROS 2 topics, separated by commas: names or patterns "
        "(`farm-*`), below `/NAME`; or `NAME=/NAMESPACE` (`farm=/` gives `/map`). Unset: none.",
    )
    ros2_channel: str = Field(
        default="",
        pattern=r"^([a-z][a-z0-9_-]{0,62})?$",
        description="Channel whose maps go out to ROS 2. Unset: `production` where there is one, else `latest`.",
    )
    ros2_domain_id: int = Field(default=0, ge=0, le=232, description="ROS 2 domain (`ROS_DOMAIN_ID`) for rmw_zenoh.")
    ros2_keys: str = Field(
        default="rmw_zenoh,ros2dds",
        description="Whom the topics are for: `rmw_zenoh` (Jazzy and newer), `rmw_zenoh_humble`, `ros2dds` (robots "
        "behind zenoh-bridge-ros2dds), separated by commas.",
    )
    ros2_derive: bool = Field(
        default=False, description="Whether grids and networks that are not stored but can be derived go out, too."
    )

    models_dir: Path | None = Field(
        default=None,
        description="Folder of segmentation models for pictures: `NAME.onnx`, with its classes in `NAME.json`; of the "
        "Segment-Anything family `NAME.encoder.onnx` and `NAME.decoder.onnx`. Unset: none.",
    )
    models_max_bytes: int = Field(
        default=2 * 2**30, ge=1, description="Largest model: the sum of its files. It must fit into a process' memory."
    )
    imagery_url: str | None = Field(
        default=None,
        description="Provider of satellite pictures for `location_to_imagery`; only its host is asked. Tiles: an "
        "address with `{z}`, `{x}`, `{y}` (or `{-y}`; WMTS: `{TileMatrix}`, `{TileCol}`, `{TileRow}`); a WMS with "
        "`layers=…`; a Mapbox style up to `/static`. `{token}` stands for the token. Unset: none is asked.",
    )
    imagery_kind: Literal["xyz", "wms", "mapbox"] = Field(
        default="xyz",
        description="What the provider speaks: `xyz` (tiles, WMTS too), `wms`, or `mapbox` static images.",
    )
    imagery_token: SecretStr | None = Field(default=None, description="The provider's token.")
    imagery_attribution: str = Field(
        default="", description="Credits of its pictures, separated by `;`. They go into maps and reports."
    )
    imagery_max_bytes: int = Field(
        default=64 * 2**20, ge=1024, description="Most bytes that are fetched for one picture of a site."
    )
    imagery_seconds: float = Field(default=60.0, gt=0, le=600, description="Longest time for fetching such a picture.")
    imagery_tries: int = Field(
        default=3, ge=1, le=10, description="How often the provider is asked before it counts as down."
    )
    imagery_max_zoom: int = Field(default=19, ge=0, le=24, description="Finest zoom level that the provider has.")
    imagery_tile_size: int = Field(default=256, ge=64, le=2048, description="Pixels along a side of its tiles (`xyz`).")
    imagery_cache_bytes: int = Field(
        default=256 * 2**20, ge=0, description="Room in the data folder for what was fetched; 0: nothing is kept."
    )

    manifest_seconds: float = Field(
        default=86_400.0,
        ge=3600,
        description="How long a signed manifest is good; a robot asks for a new one well before.",
    )

    link_seconds: float = Field(
        default=86_400.0,
        ge=1,
        le=2_592_000,
        description="Maximum life of a signed link, which is also the default. A link needs no token until it expires.",
    )

    max_upload_bytes: int = Field(
        default=_DEFAULTS.upload_bytes, ge=1, description="Largest upload: the sum of all files of one request."
    )
    max_unpacked_bytes: int = Field(
        default=_DEFAULTS.unpacked_bytes, ge=1, description="Most that the archives of one upload may unfold to."
    )
    max_unpacked_ratio: int = Field(
        default=_DEFAULTS.unpacked_ratio,
        ge=1,
        description="Maximum bytes that a compressed file unpacks to, per compressed byte; half of it for a text in an "
        "archive. 16 MiB are always allowed, for images as many bytes as `max_pixels`.",
    )
    max_files: int = Field(default=_DEFAULTS.files, ge=1, description="Most files in one upload or archive.")
    max_pixels: int = Field(default=_DEFAULTS.pixels, ge=1, description="Most pixels or cells of one picture or grid.")
    max_voxels: int = Field(default=_DEFAULTS.voxels, ge=1, description="Most nodes of one octree.")
    max_features: int = Field(
        default=_DEFAULTS.features, ge=1, description="Most nodes, edges and objects of one file."
    )
    max_yaml_depth: int = Field(
        default=_DEFAULTS.yaml_depth, ge=4, le=500, description="Deepest nesting of a YAML file."
    )
    max_yaml_nodes: int = Field(
        default=_DEFAULTS.yaml_nodes,
        ge=1,
        description="Most values of a YAML file, aliases counted as often as they are used.",
    )
    max_xml_attribute_bytes: int = Field(
        default=_DEFAULTS.xml_attribute_bytes, ge=256, description="Longest attribute of an XML file."
    )
    max_text_bytes: int = Field(
        default=_DEFAULTS.text_bytes, ge=1, description="Largest single text file (YAML, XML, JSON)."
    )
    max_seconds: float = Field(
        default=_DEFAULTS.seconds, gt=0, description="Longest time for reading or making one map."
    )
    max_memory_bytes: int = Field(
        default=_DEFAULTS.memory_bytes,
        ge=2**29,
        description="Address space of a process that reads uploads and makes maps.",
    )
    max_warnings: int = Field(default=_DEFAULTS.warnings, ge=1, description="Most warnings kept with one version.")

    @field_validator(
        "database_url",
        "blob_url",
        "admin_token",
        "tls_certificate",
        "tls_key",
        "zenoh_certificate",
        "zenoh_key",
        "zenoh_ca",
        "zenoh_users",
        "zenoh_user",
        "zenoh_password",
        "zenoh_config",
        "imagery_url",
        "imagery_token",
        "models_dir",
        mode="before",
    )
    @classmethod
    def _empty_is_unset(cls, value: Any) -> Any:
        return None if value == "" else value

    @field_validator("*", mode="before")
    @classmethod
    def _sizes_have_units(cls, value: Any, info: ValidationInfo) -> Any:
        sized = isinstance(value, str) and str(info.field_name).endswith("_bytes")
        return parse_size(value) if sized else value

    @field_validator("blob_url")
    @classmethod
    def _is_folder(cls, value: str | None) -> str | None:
        if value is not None and "://" in value and not value.startswith("file://"):
            raise ValueError("only folders are supported: give a path or a file:// address")
        return value

    @model_validator(mode="after")
    def _no_auth_only_on_loopback(self) -> Self:
        if self.insecure_no_auth and not is_loopback(self.host):
            raise ValueError(
                f"insecure_no_auth works only while listening on a loopback address, not on {self.host}: "
                "listen on 127.0.0.1, or leave it out and use tokens"
            )
        return self

    @model_validator(mode="after")
    def _client_needs_a_router(self) -> Self:
        if self.zenoh_mode == "client" and not self.zenoh_connect.strip():
            raise ValueError("zenoh_mode client needs zenoh_connect: where the router is, like tcp/router:7447")
        return self

    @model_validator(mode="after")
    def _certificates_have_keys(self) -> Self:
        for prefix in ("tls", "zenoh"):
            if (getattr(self, f"{prefix}_certificate") is None) != (getattr(self, f"{prefix}_key") is None):
                raise ValueError(f"{prefix}_certificate and {prefix}_key go together")
        return self

    @model_validator(mode="after")
    def _zenoh_security_is_whole(self) -> Self:
        if (self.zenoh_user is None) != (self.zenoh_password is None):
            raise ValueError("zenoh_user and zenoh_password go together")
        if self.zenoh_mode == "router":
            encrypted = any(part.strip().startswith(("tls/", "quic/")) for part in self.zenoh_listen.split(","))
            if encrypted and self.zenoh_certificate is None and self.zenoh_config is None:
                raise ValueError("zenoh_listen with tls/ needs zenoh_certificate and zenoh_key")
            if self.zenoh_certificate is not None and not encrypted:
                raise ValueError("zenoh_certificate is for encrypted endpoints: zenoh_listen=tls/0.0.0.0:7447")
            if self.zenoh_users is not None and self.zenoh_connect.strip() and self.zenoh_config is None:
                raise ValueError(
                    "with zenoh_users only the server and its robots may say anything: what other routers may say has "
                    "to stand in the access control of a zenoh_config"
                )
        elif self.zenoh_users is not None or self.zenoh_mtls:
            raise ValueError("zenoh_users and zenoh_mtls are for zenoh_mode=router: another router has its own users")
        if self.zenoh_mtls and (self.zenoh_ca is None or self.zenoh_certificate is None):
            raise ValueError("zenoh_mtls needs zenoh_ca, zenoh_certificate and zenoh_key")
        return self

    @field_validator("ros2_environments", "ros2_keys")
    @classmethod
    def _ros2_names(cls, value: str, info: ValidationInfo) -> str:
        (parse_keys if info.field_name == "ros2_keys" else parse_selectors)(value)
        return value

    @model_validator(mode="after")
    def _ros2_needs_zenoh(self) -> Self:
        if self.ros2_environments.strip() and self.zenoh_mode == "off":
            raise ValueError("ros2_environments needs zenoh_mode router or client: topics go over Zenoh")
        return self

    @model_validator(mode="after")
    def _imagery_url_is_complete(self) -> Self:
        if self.imagery_url is None:
            return self
        parts = urlsplit(self.imagery_url)
        if parts.scheme not in ("http", "https") or not parts.hostname or "{" in parts.netloc:
            raise ValueError("imagery_url must be a full address: https://host/…")
        query = {key.upper() for key in parse_qs(parts.query, keep_blank_values=True)}
        rows = ("{y}", "{-y}", "{TileRow}")
        tiled = [("{z}", "{TileMatrix}"), ("{x}", "{TileCol}"), rows]
        if self.imagery_kind == "xyz" and not all(any(n in self.imagery_url for n in names) for names in tiled):
            raise ValueError("imagery_url of tiles needs {z}, {x} and {y} (or {-y}; WMTS: {TileMatrix} …)")
        if self.imagery_kind == "wms" and "LAYERS" not in query:
            raise ValueError("imagery_url of a WMS needs its layers: https://host/wms?layers=…")
        return self

    @property
    def limits(self) -> Limits:
        """The limits of the read boundary."""
        names = [f.name for f in dataclasses.fields(Limits)]
        return Limits(**{name: getattr(self, f"max_{name}") for name in names})

    @property
    def database(self) -> str:
        """The database's URL, the default filled in."""
        return self.database_url or f"sqlite:///{self.data_dir.resolve() / 'fleetmap.sqlite3'}"

    @property
    def blob_dir(self) -> Path:
        """The folder of uploaded files, the default filled in."""
        if self.blob_url is None:
            return self.data_dir / "blobs"
        if self.blob_url.startswith("file://"):
            return Path(unquote(urlsplit(self.blob_url).path))
        return Path(self.blob_url)

    @property
    def cache_dir(self) -> Path:
        """The folder of finished maps."""
        return self.data_dir / "cache"

    @property
    def spool_dir(self) -> Path:
        """The folder of uploads on their way in."""
        return self.data_dir / "spool"


def is_loopback(host: str) -> bool:
    """Whether an address to listen on is reached from this machine alone."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False
