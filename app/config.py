"""Settings from environment variables ``FLEETMAP_*``, a ``.env`` file, or options of ``fleetmap serve``.

Nothing is read at import: a factory creates ``Settings()`` and passes it on. The descriptions are part of the
documentation; each field of ``app.limits.Limits`` is the setting ``FLEETMAP_MAX_<FIELD>``.
"""

from __future__ import annotations

import dataclasses
import ipaddress
import os
from pathlib import Path
from typing import Any, Literal, Self
from urllib.parse import unquote, urlsplit

from pydantic import Field, SecretStr, ValidationInfo, field_validator, model_validator
from pydantic_settings import SettingsConfigDict

from app import setting_values as forms
from app.events.ros_names import parse_keys, parse_selectors
from app.limits import Limits
from app.logs import LogFormat
from app.retention_settings import RetentionSettings

_DEFAULTS = Limits()


class Settings(RetentionSettings):
    """Settings of the server. Times are in seconds. Sizes (``…_bytes``) are in bytes, or a number with a unit."""

    model_config = SettingsConfigDict(env_prefix="FLEETMAP_", env_file=".env", extra="ignore", frozen=True)

    data_dir: Path = Field(
        default=Path("data"),
        description="Folder for the database, the stored files and the cache; created if missing.",
    )
    database_url: str | None = Field(
        default=None,
        description="Database URL: `postgresql+psycopg://user:password@host/name` (with PostGIS), or `sqlite:///FILE`. "
        "Default: an SQLite file in the data folder.",
    )
    database_direct_url: str | None = Field(
        default=None,
        description="Database URL for locks and notifications, if `database_url` leads to a pooler of transactions "
        "such as PgBouncer: that of PostgreSQL itself. Default: `database_url`.",
    )
    blob_url: str | None = Field(
        default=None,
        description="Where uploaded files are kept: a folder, as a path or `file://` URL, or `s3://bucket/prefix` with "
        "the usual `AWS_*` variables. Servers with one PostgreSQL database must share it. Default: `blobs` in the data "
        "folder, for one server.",
    )
    blob_access_key: str | None = Field(
        default=None, description="Access key of the S3 server. Unset: `AWS_ACCESS_KEY_ID`, or the machine's role."
    )
    blob_secret_key: SecretStr | None = Field(
        default=None, description="Secret of `blob_access_key`. Unset: `AWS_SECRET_ACCESS_KEY`."
    )
    blob_cache_bytes: int = Field(
        default=4 * 2**30,
        ge=0,
        description="Size limit of the copies of stored files in the data folder, if `blob_url` is in S3; the least "
        "recently used go first.",
    )
    host: str = Field(default="127.0.0.1", description="Address to listen on; `0.0.0.0` for all IPv4 addresses.")
    port: int = Field(default=8000, ge=0, le=65535, description="Port to listen on.")
    tls_certificate: Path | None = Field(
        default=None, description="Certificate for HTTPS (PEM, with its chain). Unset: HTTP."
    )
    tls_key: Path | None = Field(default=None, description="Private key of `tls_certificate` (PEM).")
    public_url: str | None = Field(
        default=None,
        description="Address of the server for its clients, such as `https://maps.example.org/fleet`, for "
        "absolute links. Set it behind a proxy. Unset: scheme and `Host` of the request.",
    )
    workers: int = Field(default=1, ge=1, le=256, description="Number of processes that serve requests.")
    admin_token: SecretStr | None = Field(
        default=None,
        description="Token of the first administrator, for containers and tests; use at least 32 random characters. "
        "Unset: the first start creates a token and prints it once.",
    )
    signing_key: Path | None = Field(
        default=None,
        description="File with the private Ed25519 key (PEM) that signs manifests, the same on all servers; older keys "
        "below it endorse it. Unset: the first start creates a key, in the data folder or in PostgreSQL.",
    )
    insecure_no_auth: bool = Field(
        default=False,
        description="Disable authentication: every client has administrator rights. Allowed only on a loopback "
        "address.",
    )
    log_level: Literal["debug", "info", "warning", "error"] = Field(
        default="info",
        description="Minimum level of log messages. `warning`: rejected tokens and failures; `info`: also changes and "
        "requests that take over a second; `debug`: all requests except those served from memory.",
    )
    log_format: LogFormat = Field(
        default="text", description="Log format: `text`, or `json` with one JSON object per line."
    )

    conversion_workers: int = Field(
        default_factory=lambda: max(1, min(8, os.cpu_count() or 1)),
        ge=1,
        le=256,
        description="Number of processes per worker that read uploads and convert maps. One more computes coverage "
        "tables while these are busy. Default: the number of processors, at most 8.",
    )
    conversion_queue: int = Field(
        default=64,
        ge=1,
        le=10_000,
        description="Maximum number of conversions that wait for a free process; further requests get 503.",
    )
    job_seconds: float = Field(
        default=20.0,
        gt=0,
        le=3600,
        description="Time limit for a conversion within a request; after that the request gets 202 and the URL of a "
        "job.",
    )
    cache_bytes: int = Field(
        default=4 * 2**30,
        ge=0,
        description="Size limit of the map cache on disk; the least recently used maps are evicted first.",
    )
    memory_cache_bytes: int = Field(
        default=128 * 2**20, ge=0, description="Size limit of the map cache in memory, for each worker."
    )

    scrub_hours: float = Field(
        default=168.0,
        ge=0,
        le=8760,
        description="Hours between background checks of all stored data against its hashes; 0: never.",
    )
    scrub_bytes_per_second: int = Field(
        default=4 * 2**20,
        ge=1024,
        description="Maximum read speed of these checks, in bytes per second.",
    )

    max_uploads: int = Field(
        default=8, ge=1, le=1000, description="Maximum number of concurrent uploads per worker; further ones get 503."
    )
    max_json_bytes: int = Field(
        default=64 * 2**20,
        ge=1024,
        description="Maximum size of a request body other than a file upload, such as edits.",
    )
    header_seconds: float = Field(
        default=20.0, gt=0, le=3600, description="Time limit for a client to send the header of a request."
    )
    body_seconds: float = Field(
        default=30.0,
        gt=0,
        le=3600,
        description="Maximum pause of a client while it sends a request body or reads a response. After that a body "
        "gets 408, and a response is cut off.",
    )
    body_pace: int = Field(
        default=1024,
        ge=1,
        description="Minimum average rate, in bytes per second, at which a client must send a body or read a response "
        "after the first `FLEETMAP_BODY_SECONDS`. A slower body gets 408, a slower response is cut off.",
    )
    max_connections: int = Field(
        default=4096,
        ge=16,
        le=1_000_000,
        description="Maximum number of open connections per worker; the limit of open files is raised accordingly. A "
        "quarter is reserved for clients with a valid token and addresses that used one in the last 10 minutes. If all "
        "are in use, the oldest connection without a token is closed; if there is none, new connections get 503.",
    )
    max_connections_per_address: int = Field(
        default=512,
        ge=1,
        le=1_000_000,
        description="Maximum number of connections without a valid token from one address; beyond it the oldest is "
        "closed. Does not apply to loopback addresses. Behind a proxy on another machine, set it to the value of "
        "`FLEETMAP_MAX_CONNECTIONS`.",
    )
    token_failures: int = Field(
        default=20,
        ge=1,
        le=10_000,
        description="Number of invalid tokens per minute from one address after which further ones get 429. A valid "
        "token is always accepted.",
    )

    anonymous_networks: str = Field(
        default="",
        description="Networks whose clients may read everything without a token, as role `viewer`: addresses or CIDRs, "
        "comma-separated (`192.168.7.0/24,fd00::/8`). Behind a proxy, the address is that in `X-Forwarded-For` if "
        "`FORWARDED_ALLOW_IPS` trusts the proxy, else the proxy's own. Unset: none.",
    )

    zenoh_mode: Literal["router", "client", "off"] = Field(
        default="router",
        description="Zenoh mode for events: `router` starts a router with the server, `client` connects to the one at "
        "`FLEETMAP_ZENOH_CONNECT`, `off` publishes no events (robots poll).",
    )
    zenoh_listen: str = Field(
        default="tcp/127.0.0.1:7447",
        description="Listen endpoints of the router, comma-separated. If a port is in use, no events are published; "
        "the log and `/readyz` report it.",
    )
    zenoh_connect: str = Field(
        default="",
        description="Endpoints of other routers, comma-separated (`tcp/router:7447`). Required in `client` mode; in "
        "`router` mode the server's router connects to them.",
    )
    zenoh_advertise: str = Field(
        default="",
        description="Router endpoints that `/readyz` announces to robots, comma-separated; `0.0.0.0` is replaced by "
        "the host name of the request. Default: the listen endpoints in `router` mode, none in `client` mode.",
    )
    zenoh_prefix: str = Field(
        default="fleetmap",
        pattern=r"^[A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+)*$",
        description="Prefix of all Zenoh keys.",
    )
    zenoh_certificate: Path | None = Field(
        default=None,
        description="Certificate (PEM, with its chain) of the server's router for `tls/` endpoints, and of the server "
        "as a client of other routers.",
    )
    zenoh_key: Path | None = Field(default=None, description="Private key of `zenoh_certificate` (PEM).")
    zenoh_ca: Path | None = Field(
        default=None,
        description="Certification authority (PEM) of the router's certificate, and of the robots' with `zenoh_mtls`. "
        "Unset: public ones.",
    )
    zenoh_mtls: bool = Field(
        default=False, description="Require a certificate of robots, signed by `FLEETMAP_ZENOH_CA`."
    )
    zenoh_users: Path | None = Field(
        default=None,
        description="File with one `ROBOT:PASSWORD` per line, read at start. If set, the router rejects other users, "
        "and a robot may publish only its own status and liveliness token. Unset: no user check.",
    )
    zenoh_user: str | None = Field(default=None, description="User name of the server at the router, in `client` mode.")
    zenoh_password: SecretStr | None = Field(default=None, description="Password of the server at the router.")
    zenoh_config: Path | None = Field(
        default=None,
        description="JSON5 file with further Zenoh configuration; access control in it replaces the server's.",
    )
    zenoh_max_reply_bytes: int = Field(
        default=64 * 2**20,
        ge=1024,
        description="Maximum size of a file (or a grid for ROS 2) sent over Zenoh; HTTP has no such limit. The "
        "server's router drops messages that exceed both this size and 65 MiB, unless `zenoh_config` is set.",
    )

    mqtt_url: SecretStr | None = Field(
        default=None,
        description="MQTT 5 broker that also gets the events, with the Zenoh keys as topics: "
        "`mqtt://[user[:password]@]host[:port]`, or `mqtts://` for TLS. Unset: none.",
    )
    mqtt_password_file: Path | None = Field(
        default=None, description="File with the password of the user in `mqtt_url`; read at each login."
    )
    mqtt_ca: Path | None = Field(
        default=None,
        description="Certification authority (PEM) of the broker's certificate. Unset: public ones.",
    )
    webhook_networks: str = Field(
        default="",
        description="Networks that webhooks may reach besides public addresses, also over plain HTTP: addresses or "
        "CIDRs, comma-separated (`192.168.7.20,fd00:7::/64`). Unset: only public addresses, over HTTPS.",
    )
    webhook_ca: Path | None = Field(
        default=None, description="File with certification authorities (PEM) that webhooks trust besides public ones."
    )

    ros2_environments: str = Field(
        default="",
        description="Environments to publish as ROS 2 topics, comma-separated: names or patterns (`farm-*`), with "
        "topics below `/NAME`; or `NAME=/NAMESPACE` (`farm=/` gives `/map`). Unset: none.",
    )
    ros2_channel: str = Field(
        default="",
        pattern=r"^([a-z][a-z0-9_-]{0,62})?$",
        description="Channel to publish to ROS 2. Unset: `production` if it exists, else `latest`.",
    )
    ros2_domain_id: int = Field(default=0, ge=0, le=232, description="ROS 2 domain (`ROS_DOMAIN_ID`) for rmw_zenoh.")
    ros2_keys: str = Field(
        default="rmw_zenoh,ros2dds",
        description="Receivers of the topics, comma-separated: `rmw_zenoh` (Jazzy and newer), `rmw_zenoh_humble`, "
        "`ros2dds` (robots behind zenoh-bridge-ros2dds).",
    )
    ros2_derive: bool = Field(
        default=False, description="Also publish grids and networks that are not stored but can be derived."
    )

    models_dir: Path | None = Field(
        default=None,
        description="Folder of segmentation models for images: `NAME.onnx` with its classes in `NAME.json`, or "
        "`NAME.encoder.onnx` and `NAME.decoder.onnx` for Segment Anything models. Unset: none.",
    )
    models_max_bytes: int = Field(
        default=2 * 2**30, ge=1, description="Maximum size of a model, the sum of its files; it must fit into memory."
    )
    imagery_url: str | None = Field(
        default=None,
        description="URL of the satellite imagery provider for `location_to_imagery`; the server requests only its "
        "host. Tiles: a URL with `{z}`, `{x}`, `{y}` (or `{-y}`; WMTS: `{TileMatrix}`, `{TileCol}`, `{TileRow}`); WMS: "
        "a URL with `layers=…`; Mapbox: a style up to `/static`. `{token}` stands for the token. Unset: no provider.",
    )
    imagery_kind: Literal["xyz", "wms", "mapbox"] = Field(
        default="xyz",
        description="Protocol of the provider: `xyz` (tiles, also WMTS), `wms`, or `mapbox` (static images).",
    )
    imagery_token: SecretStr | None = Field(default=None, description="Access token of the provider.")
    imagery_attribution: str = Field(
        default="", description="Credits of the imagery, separated by `;`; part of maps and reports."
    )
    basemap_url: str | None = Field(
        default=None,
        description="Base map of the web page: a URL of Web Mercator tiles with `{z}`, `{x}` and `{y}`, such as "
        "`https://tiles.example.org/{z}/{x}/{y}.png`. Browsers load its tiles from that host, and learn the URL with "
        "all it contains. Unset: no base map, and the page loads nothing from other hosts.",
    )
    basemap_attribution: str = Field(
        default="", description="Credits of the base map, as text; the page shows them on the map."
    )
    imagery_max_bytes: int = Field(
        default=64 * 2**20, ge=1024, description="Maximum number of bytes to fetch for one image of a site."
    )
    imagery_seconds: float = Field(default=60.0, gt=0, le=600, description="Time limit for fetching such an image.")
    imagery_tries: int = Field(
        default=3, ge=1, le=10, description="Number of attempts before the provider counts as down."
    )
    imagery_max_zoom: int = Field(default=19, ge=0, le=24, description="Maximum zoom level of the provider.")
    imagery_tile_size: int = Field(
        default=256, ge=64, le=2048, description="Width and height of the provider's tiles in pixels (`xyz`)."
    )
    imagery_cache_bytes: int = Field(
        default=256 * 2**20, ge=0, description="Size limit of fetched imagery in the data folder; 0: no cache."
    )

    manifest_seconds: float = Field(
        default=86_400.0,
        ge=3600,
        description="Validity of a signed manifest. Robots request a new one long before it expires.",
    )

    delegation_seconds: float = Field(
        default=604_800.0,
        ge=3600,
        le=31_536_000,
        description="Time for which a mirror of this server may sign manifests while it is cut off. It renews the "
        "permission while it is connected.",
    )

    link_seconds: float = Field(
        default=86_400.0,
        ge=1,
        le=2_592_000,
        description="Maximum and default lifetime of a signed link, which needs no token until it expires.",
    )

    max_upload_bytes: int = Field(
        default=_DEFAULTS.upload_bytes,
        ge=1,
        description="Maximum size of an upload, the sum of all files of one request.",
    )
    max_unpacked_bytes: int = Field(
        default=_DEFAULTS.unpacked_bytes, ge=1, description="Maximum unpacked size of the archives of one upload."
    )
    max_unpacked_ratio: int = Field(
        default=_DEFAULTS.unpacked_ratio,
        ge=1,
        description="Maximum compression ratio, in unpacked bytes per compressed byte; half of it for text files in an "
        "archive. 16 MiB are always allowed, and `max_pixels` bytes for images.",
    )
    max_files: int = Field(
        default=_DEFAULTS.files, ge=1, description="Maximum number of files in one upload or archive."
    )
    max_pixels: int = Field(
        default=_DEFAULTS.pixels, ge=1, description="Maximum number of pixels or cells of one image or grid."
    )
    max_voxels: int = Field(default=_DEFAULTS.voxels, ge=1, description="Maximum number of nodes of one octree.")
    max_features: int = Field(
        default=_DEFAULTS.features, ge=1, description="Maximum number of nodes, edges and objects of one file."
    )
    max_yaml_depth: int = Field(
        default=_DEFAULTS.yaml_depth, ge=4, le=500, description="Maximum nesting depth of a YAML file."
    )
    max_yaml_nodes: int = Field(
        default=_DEFAULTS.yaml_nodes,
        ge=1,
        description="Maximum number of values of a YAML file; each use of an alias counts.",
    )
    max_xml_attribute_bytes: int = Field(
        default=_DEFAULTS.xml_attribute_bytes, ge=256, description="Maximum size of one attribute in an XML file."
    )
    max_text_bytes: int = Field(
        default=_DEFAULTS.text_bytes, ge=1, description="Maximum size of one text file (YAML, XML, JSON)."
    )
    max_seconds: float = Field(
        default=_DEFAULTS.seconds, gt=0, description="Time limit for reading or converting one map."
    )
    max_memory_bytes: int = Field(
        default=_DEFAULTS.memory_bytes,
        ge=2**29,
        description="Address space limit of a process that reads uploads and converts maps.",
    )
    max_warnings: int = Field(
        default=_DEFAULTS.warnings, ge=1, description="Maximum number of warnings stored with one version."
    )

    @field_validator(
        "database_url",
        "database_direct_url",
        "signing_key",
        "blob_url",
        "blob_access_key",
        "blob_secret_key",
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
        "basemap_url",
        "public_url",
        "models_dir",
        "mqtt_url",
        "mqtt_password_file",
        "mqtt_ca",
        "webhook_ca",
        mode="before",
    )
    @classmethod
    def _empty_is_unset(cls, value: Any) -> Any:
        return None if value == "" else value

    @field_validator("*", mode="before")
    @classmethod
    def _sizes_have_units(cls, value: Any, info: ValidationInfo) -> Any:
        sized = isinstance(value, str) and str(info.field_name).endswith("_bytes")
        return forms.parse_size(value) if sized else value

    @field_validator("anonymous_networks", "webhook_networks")
    @classmethod
    def _is_networks(cls, value: str) -> str:
        forms.parse_networks(value)
        return value

    _check_blob_url = field_validator("blob_url")(forms.check_blob_url)
    _check_public_url = field_validator("public_url")(forms.check_public_url)

    @model_validator(mode="after")
    def _blob_keys_are_whole(self) -> Self:
        if (self.blob_access_key is None) != (self.blob_secret_key is None):
            raise ValueError("blob_access_key and blob_secret_key must be set together")
        if self.blob_access_key is not None and not (self.blob_url or "").startswith("s3://"):
            raise ValueError("blob_access_key requires a blob_url in S3: s3://bucket/prefix")
        return self

    @model_validator(mode="after")
    def _direct_url_needs_postgres(self) -> Self:
        if self.database_direct_url is not None:
            urls = (self.database, self.database_direct_url)
            if not all(url.startswith("postgres") for url in urls):
                raise ValueError("database_direct_url requires a database_url of PostgreSQL, and one itself")
        return self

    @model_validator(mode="after")
    def _no_auth_only_on_loopback(self) -> Self:
        if self.insecure_no_auth and not is_loopback(self.host):
            raise ValueError(
                f"insecure_no_auth is not allowed on {self.host}, which is not a loopback address: "
                "listen on 127.0.0.1, or remove it and use tokens"
            )
        return self

    @model_validator(mode="after")
    def _client_needs_a_router(self) -> Self:
        if self.zenoh_mode == "client" and not self.zenoh_connect.strip():
            raise ValueError("zenoh_mode client requires zenoh_connect, such as tcp/router:7447")
        return self

    @model_validator(mode="after")
    def _certificates_have_keys(self) -> Self:
        for prefix in ("tls", "zenoh"):
            if (getattr(self, f"{prefix}_certificate") is None) != (getattr(self, f"{prefix}_key") is None):
                raise ValueError(f"{prefix}_certificate and {prefix}_key must be set together")
        return self

    @model_validator(mode="after")
    def _zenoh_security_is_whole(self) -> Self:
        if (self.zenoh_user is None) != (self.zenoh_password is None):
            raise ValueError("zenoh_user and zenoh_password must be set together")
        if self.zenoh_mode == "router":
            encrypted = any(part.strip().startswith(("tls/", "quic/")) for part in self.zenoh_listen.split(","))
            if encrypted and self.zenoh_certificate is None and self.zenoh_config is None:
                raise ValueError("zenoh_listen with tls/ requires zenoh_certificate and zenoh_key")
            if self.zenoh_certificate is not None and not encrypted:
                raise ValueError("zenoh_certificate requires an encrypted endpoint: zenoh_listen=tls/0.0.0.0:7447")
            if self.zenoh_users is not None and self.zenoh_connect.strip() and self.zenoh_config is None:
                raise ValueError(
                    "zenoh_users with zenoh_connect requires a zenoh_config: set the rights of other routers in its "
                    "access control"
                )
        elif self.zenoh_users is not None or self.zenoh_mtls:
            raise ValueError(
                "zenoh_users and zenoh_mtls require zenoh_mode=router: configure users of other routers there"
            )
        if self.zenoh_mtls and (self.zenoh_ca is None or self.zenoh_certificate is None):
            raise ValueError("zenoh_mtls requires zenoh_ca, zenoh_certificate and zenoh_key")
        return self

    @field_validator("ros2_environments", "ros2_keys")
    @classmethod
    def _ros2_names(cls, value: str, info: ValidationInfo) -> str:
        (parse_keys if info.field_name == "ros2_keys" else parse_selectors)(value)
        return value

    @model_validator(mode="after")
    def _ros2_needs_zenoh(self) -> Self:
        if self.ros2_environments.strip() and self.zenoh_mode == "off":
            raise ValueError("ros2_environments requires zenoh_mode router or client: topics are sent over Zenoh")
        return self

    @model_validator(mode="after")
    def _urls_are_complete(self) -> Self:
        if self.imagery_url is not None:
            forms.check_imagery(self.imagery_url, self.imagery_kind)
        if self.basemap_url is not None:
            forms.check_basemap(self.basemap_url)
        broker = None if self.mqtt_url is None else self.mqtt_url.get_secret_value()
        forms.check_broker(broker, self.mqtt_password_file, self.mqtt_ca)
        return self

    @property
    def limits(self) -> Limits:
        """Limits of uploads and conversions."""
        names = [f.name for f in dataclasses.fields(Limits)]
        return Limits(**{name: getattr(self, f"max_{name}") for name in names})

    @property
    def anonymous_list(self) -> list[ipaddress.IPv4Network | ipaddress.IPv6Network]:
        """Networks whose clients may read without a token."""
        return forms.parse_networks(self.anonymous_networks)

    @property
    def webhook_list(self) -> tuple[ipaddress.IPv4Network | ipaddress.IPv6Network, ...]:
        """Networks that webhooks may reach besides public addresses."""
        return tuple(forms.parse_networks(self.webhook_networks))

    @property
    def database(self) -> str:
        """Database URL, with its default."""
        return self.database_url or f"sqlite:///{self.data_dir.resolve() / 'fleetmap.sqlite3'}"

    @property
    def direct_database(self) -> str:
        """Database URL for what belongs to a session, with its default."""
        return self.database_direct_url or self.database

    @property
    def blob_dir(self) -> Path:
        """Folder of uploaded files, with its default; of their copies on this machine if they are in S3."""
        if self.blob_url is None or self.blob_url.startswith("s3://"):
            return self.data_dir / "blobs"
        if self.blob_url.startswith("file://"):
            return Path(unquote(urlsplit(self.blob_url).path))
        return Path(self.blob_url)

    @property
    def shares_maps(self) -> bool:
        """Whether other servers may use this one's database and files."""
        return self.blob_url is not None and not self.database.startswith("sqlite")

    @property
    def cache_dir(self) -> Path:
        """Folder of cached maps."""
        return self.data_dir / "cache"

    @property
    def spool_dir(self) -> Path:
        """Folder of uploads in progress."""
        return self.data_dir / "spool"


def is_loopback(host: str) -> bool:
    """Whether a listen address is reachable only from this machine."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False
