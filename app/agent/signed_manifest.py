"""Parse and verify signed manifests.

A manifest is accepted if it is signed by the pinned key, belongs to the robot's environment and channel, has not
expired and is not older than the newest accepted one. A new key is accepted only if the pinned one endorses it.

Attacks that this prevents, as named by The Update Framework: rollback (a lower sequence), freeze (an expired manifest),
mix-and-match (files of different versions; prevented by one signed list of all hashes), arbitrary software (other
bytes, or a foreign key).
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta, timezone
from typing import Any

from app.agent.state import Mark
from app.dangerous_variables import DANGEROUS_VARIABLE
from app.errors import Untrusted

MAX_CLOCK_SKEW = timedelta(seconds=60)
"""Maximum difference between the robot's clock and the server's."""

MAX_SEQUENCE_AHEAD = 10**9
"""Maximum lead of a manifest's sequence over the highest accepted one: one manifest signed with a stolen key must not
make all later manifests look old.
"""

MAX_EPOCH_AHEAD = 2**32
"""Maximum lead of an epoch; large enough for epochs that are a time in seconds."""

MAX_ELEVATION_METRES = 1e6
MAX_FILES = 100_000
MAX_VARIABLES = 2000
MAX_DEPTH = 100
_HASH = re.compile(r"[0-9a-f]{64}")
_FORMAT = re.compile(r"[a-z0-9][a-z0-9_]{0,62}")
_LAYER = re.compile(r"[a-z][a-z0-9_]{0,31}")
_TIME = re.compile(
    r"(?P<date>\d{4}-\d\d-\d\d)[Tt ](?P<clock>\d\d:\d\d:\d\d)(\.(?P<fraction>\d{1,30}))?(?P<zone>[Zz]|[+-]\d\d:\d\d)",
    re.ASCII,
)
_VARIABLE = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,127}")


@dataclass(frozen=True, slots=True)
class ManifestFile:
    """A file of a map.

    Attributes:
        name: relative path, with ``/`` as separator.
        level: name of the level that the file belongs to.
    """

    format: str
    name: str
    size: int
    sha256: str
    level: str | None = None

    @property
    def path(self) -> str:
        """Path below ``current``."""
        return f"{self.format}/{self.name}"


@dataclass(frozen=True, slots=True)
class Level:
    """A level. elevation: metres."""

    name: str
    elevation: float


@dataclass(frozen=True, slots=True)
class Manifest:
    """Signed list of a version's files.

    Attributes:
        data, signature: signed bytes and signature header as received.
        variables: shell variables of the environment (``FARM_NAME`` …), for ``environment.sh``.
        variables_left_out: names of signed variables that no map may set; they are not in ``variables``.
        layers: layer -> hash of its content.
        time: time of signing.
        levels: lowest first.
        missing: optional format -> reason why it is not available.
        overlays: closures in force, as the server lists them.
        overlays_digest: None if the server applies no closures.
        closures, parameters: echo of the request: how closures are shown, and format -> its parameters.
        edge_sequence: number of changes that a mirror made by itself.
    """

    environment: str
    channel: str | None
    sequence: int
    version: int
    root: str
    expires: datetime
    files: tuple[ManifestFile, ...]
    data: bytes
    signature: str
    variables: Mapping[str, str] = field(default_factory=dict)
    layers: Mapping[str, str] = field(default_factory=dict)
    epoch: int = 0
    time: datetime | None = None
    levels: tuple[Level, ...] = ()
    missing: Mapping[str, str] = field(default_factory=dict)
    overlays: tuple[Mapping[str, Any], ...] = ()
    overlays_digest: str | None = None
    closures: str = "apply"
    parameters: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    edge_sequence: int = 0
    variables_left_out: tuple[str, ...] = ()

    @property
    def mark(self) -> Mark:
        """Position in the channel's history."""
        return Mark(self.epoch, self.sequence, self.root, self.overlays_digest, self.edge_sequence)

    @property
    def map_key(self) -> tuple[Any, ...]:
        """Key that is equal for manifests with equal version folders."""
        return self.root, self.closures_key, self.content

    @property
    def closures_key(self) -> str:
        """Digest of the closures in force; empty if there are none."""
        return self.overlays_digest if self.overlays and self.overlays_digest else ""

    @property
    def content(self) -> dict[str, str]:
        """Path -> SHA-256 of all files."""
        return {file.path: file.sha256 for file in self.files}


def parse(data: bytes, signature: str) -> Manifest:
    """Parse a manifest and check each member. Raises Untrusted if one is invalid."""
    try:
        body = json.loads(data)
        files = tuple(
            ManifestFile(f["format"], f["name"], f["size"], f["sha256"], f.get("level")) for f in body["files"]
        )
        signed_at = body.get("time")
        expires = read_time(body["expires"])
        variables, left_out = _read_variables(body.get("variables", {}))
        manifest = Manifest(
            body["environment"],
            body.get("channel"),
            body["sequence"],
            body["version"],
            body["root"],
            expires,
            files,
            data,
            signature,
            variables,
            dict(body.get("layers", {})),
            body.get("epoch", 0),
            None if signed_at is None else read_time(signed_at),
            tuple(Level(level["name"], level["elevation"]) for level in body.get("levels", [])),
            {line["format"]: line["detail"] for line in body.get("missing", [])},
            tuple(body.get("overlays", [])),
            body.get("overlays_digest"),
            body.get("closures", "apply"),
            {format_: dict(values) for format_, values in body.get("parameters", {}).items()},
            body.get("edge_sequence", 0),
            left_out,
        )
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise Untrusted(f"invalid manifest from the server: {type(error).__name__}: {error}") from None
    valid_numbers = all(
        type(n) is int and 0 <= n < 2**63
        for n in (
            manifest.sequence,
            manifest.version,
            manifest.epoch,
            manifest.edge_sequence,
            *(f.size for f in files),
        )
    )
    texts = all(isinstance(t, str) for t in (manifest.environment, manifest.channel or "", manifest.root))
    hashes = texts and all(
        isinstance(h, str) and _HASH.fullmatch(h) for h in (manifest.root, *(f.sha256 for f in files))
    )
    if not (valid_numbers and hashes) or expires.tzinfo is None or len(files) > MAX_FILES:
        raise Untrusted("invalid manifest from the server: invalid number, hash or time of expiry, or too many files")
    _check_paths(files)
    _check_site(manifest)
    if not all(isinstance(t, str) for t in manifest.layers.values()) or not all(map(_LAYER.fullmatch, manifest.layers)):
        raise Untrusted("invalid manifest from the server: invalid name or hash of a layer")
    return manifest


def read_time(text: str) -> datetime:
    """Read an RFC 3339 time. Raises ValueError.

    ``fromisoformat`` of Python 3.10 reads neither ``Z`` nor fractions with other than 3 or 6 digits.
    """
    match = _TIME.fullmatch(text)
    if match is None:
        raise ValueError(f"not an RFC 3339 time: {text[:80]!r}")
    fraction = f".{(match['fraction'] + '000000')[:6]}" if match["fraction"] else ""
    zone = "+00:00" if match["zone"] in ("Z", "z") else match["zone"]
    moment = datetime.fromisoformat(f"{match['date']}T{match['clock']}{fraction}{zone}")
    try:
        return moment.astimezone(timezone.utc)
    except OverflowError:
        raise ValueError(f"time outside years 1 to 9999: {text[:80]!r}") from None


def _check_site(manifest: Manifest) -> None:
    """Check levels, missing formats, closures and the time of signing."""
    names = [level.name for level in manifest.levels]
    problems = (
        (manifest.time is not None and manifest.time.tzinfo is None, "the time of signing has no time zone"),
        (not all(map(_is_name, names)) or len(set(names)) != len(names), "a level's name is invalid or a duplicate"),
        (not all(_is_number(level.elevation) for level in manifest.levels), "a level's elevation is not a number"),
        (not all(f.level is None or f.level in names for f in manifest.files), "a file belongs to an unknown level"),
        (not all(_is_name(format_) for format_ in manifest.missing), "a missing format has no name"),
        (not all(isinstance(why, str) for why in manifest.missing.values()), "a missing format has no reason"),
        (not all(_is_closure(closure) for closure in manifest.overlays), "a closure has no id"),
        (bool(manifest.overlays) and manifest.overlays_digest is None, "the closures have no digest"),
        (not _is_digest(manifest.overlays_digest), "the digest of the closures is invalid"),
        (not isinstance(manifest.closures, str), "the member closures is not a string"),
    )
    for is_wrong, problem in problems:
        if is_wrong:
            raise Untrusted(f"invalid manifest from the server: {problem}")


def _is_name(value: object) -> bool:
    return isinstance(value, str) and value.isprintable() and 0 < len(value.encode("utf-8", "replace")) <= 255


def _is_number(value: object) -> bool:
    if not isinstance(value, int | float) or isinstance(value, bool):
        return False
    return -MAX_ELEVATION_METRES <= value <= MAX_ELEVATION_METRES


def _is_closure(value: object) -> bool:
    return isinstance(value, dict) and _is_name(value.get("id"))


def _is_digest(value: object) -> bool:
    return value is None or (isinstance(value, str) and is_hash(value))


def is_hash(text: str) -> bool:
    """Whether a text is a SHA-256 in hexadecimal digits."""
    return _HASH.fullmatch(text) is not None


def _read_variables(pairs: Any) -> tuple[dict[str, str], tuple[str, ...]]:
    """Return the variables for the robot, and the names of those left out since they affect its programs.

    These are no reason to refuse the manifest: older servers sign some, and installed maps may have them.
    Raises Untrusted if a name is not one of a shell, or a value not one line of text.
    """
    variables = dict(pairs)
    if len(variables) > MAX_VARIABLES:
        raise Untrusted(f"manifest has {len(variables)} variables, more than {MAX_VARIABLES}")
    for name, value in variables.items():
        fine = _VARIABLE.fullmatch(name) and isinstance(value, str) and (value.isprintable() or not value)
        if not fine:
            raise Untrusted(f"manifest contains the invalid variable {name[:80]!r}")
    harmless = {name: value for name, value in variables.items() if not DANGEROUS_VARIABLE.fullmatch(name)}
    return harmless, tuple(sorted(variables.keys() - harmless.keys()))


def _check_paths(files: Sequence[ManifestFile]) -> None:
    """Check that paths are relative, stay in their folder, are unique and are not folders as well."""
    seen: set[str] = set()
    folders: set[str] = set()
    for file in files:
        valid_format = isinstance(file.format, str) and _FORMAT.fullmatch(file.format)
        pieces = file.name.split("/") if isinstance(file.name, str) else [""]
        fine = (
            valid_format
            and len(pieces) <= MAX_DEPTH
            and all(p not in ("", ".", "..") and len(p.encode("utf-8", "replace")) <= 255 for p in pieces)
        )
        if not fine or "\\" in file.name or not file.name.isprintable() or file.path in seen:
            raise Untrusted(f"manifest contains an invalid or duplicate file path: {file.format!r}/{file.name!r}")
        seen.add(file.path)
        parts = file.path.split("/")
        folders |= {"/".join(parts[:n]) for n in range(1, len(parts))}
    if both := sorted(seen & folders):
        raise Untrusted(f"manifest lists a file that is also a folder: {both[0]}")


def check_manifest(
    manifest: Manifest,
    *,
    environment: str,
    channel: str | None,
    formats: Sequence[str],
    optional: Sequence[str] = (),
    parameters: Mapping[str, Mapping[str, str]] | None = None,
    mark: Mark | None,
    now: datetime | None = None,
) -> None:
    """Check that a signed manifest matches the request and is not older than an accepted one.

    Args:
        parameters: format -> requested parameters, of formats that have any.
        mark: position of the newest accepted manifest of the channel.

    Raises:
        Untrusted: the manifest must not be used; the text says how an operator can solve it.
    """
    if manifest.environment != environment:
        raise Untrusted(f"manifest belongs to environment {manifest.environment!r}, expected {environment!r}")
    if manifest.channel != channel:
        raise Untrusted(f"manifest belongs to channel {manifest.channel!r}, expected {channel!r}")
    if manifest.expires < (now or datetime.now(timezone.utc)) - MAX_CLOCK_SKEW:
        raise Untrusted(
            f"manifest expired at {manifest.expires:%Y-%m-%d %H:%M:%S} UTC; the time is "
            f"{now or datetime.now(timezone.utc):%Y-%m-%d %H:%M:%S} UTC (newer of the robot's clock and the newest "
            "signed time): possible replay of an old manifest. Check the clocks of the robot and the server"
        )
    got = {file.format for file in manifest.files}
    for format_, why in manifest.missing.items():
        if format_ in formats:
            raise Untrusted(f"required format {format_} is not available: {why}")
    if not set(formats) <= got <= {*formats, *optional}:
        missing, more = sorted(set(formats) - got), sorted(got - set(formats) - set(optional))
        raise Untrusted(
            f"formats of the manifest differ from the request: missing {', '.join(missing)[:300] or 'none'}, "
            f"unexpected {', '.join(more)[:300] or 'none'}"
        )
    _check_request(manifest, parameters or {}, optional)
    _check_ahead(manifest, mark)
    if mark is None:
        return
    if manifest.mark.position < mark.position:
        epoch = f" of epoch {manifest.epoch}" if manifest.epoch != mark.epoch else ""
        if manifest.mark.position[:2] == mark.position[:2]:
            raise Untrusted(
                f"manifest of sequence {manifest.sequence} lacks closures that a mirror has reported to this robot "
                f"(change {manifest.edge_sequence} instead of {mark.edge_sequence}): possible rollback. The server has "
                "them once the mirror is connected to it"
            )
        raise Untrusted(
            f"manifest sequence {manifest.sequence}{epoch} is lower than {mark.sequence}, which this robot has already "
            "accepted: possible rollback. If the server was reinstalled, delete state.json"
        )
    if manifest.mark.position == mark.position and manifest.root != mark.root:
        raise Untrusted(
            f"manifest of sequence {manifest.sequence} has root {manifest.root[:8]}, but this robot has accepted root "
            f"{mark.root[:8]} under the same sequence: two servers share one key, or the server was restored from a "
            "backup. After a restore, raise the server's epoch"
        )
    old, new = mark.overlays_digest, manifest.overlays_digest
    if manifest.mark.position == mark.position and old not in (None, new):
        raise Untrusted(
            f"manifest of sequence {manifest.sequence} has closures {(new or 'none')[:8]}, but this robot has accepted "
            f"closures {(old or 'none')[:8]} under the same sequence: two servers share one key, or the server was "
            "restored from a backup. After a restore, delete state.json"
        )


def _check_request(manifest: Manifest, parameters: Mapping[str, Mapping[str, str]], optional: Sequence[str]) -> None:
    """Refuse the response to a request that was changed in transit. Servers without closures do not sign requests."""
    if manifest.overlays_digest is None:
        return
    present = {file.format for file in manifest.files}
    silent = [name for name in optional if name not in present and name not in manifest.missing]
    if manifest.closures != "apply":
        problem = f"closures={manifest.closures[:80]} instead of closures=apply"
    elif manifest.parameters != parameters:
        problem = f"parameters {str(manifest.parameters)[:300]} instead of {str(parameters)[:300]}"
    elif silent:
        problem = f"optional formats {', '.join(silent)[:300]} are missing without a reason"
    else:
        return
    raise Untrusted(
        f"manifest belongs to another request ({problem}): check the proxies between the robot and the server"
    )


def _check_ahead(manifest: Manifest, mark: Mark | None) -> None:
    """Refuse a position that is too far ahead of the last accepted one."""
    epoch, sequence, edge_sequence = mark.position if mark is not None else (0, 0, 0)
    for name, value, accepted, limit in (
        ("sequence", manifest.sequence, sequence, MAX_SEQUENCE_AHEAD),
        ("epoch", manifest.epoch, epoch, MAX_EPOCH_AHEAD),
        ("edge_sequence", manifest.edge_sequence, edge_sequence, MAX_SEQUENCE_AHEAD),
    ):
        if value > accepted + limit:
            raise Untrusted(
                f"manifest {name} {value} is more than {limit} ahead of {accepted}, the highest that this robot has "
                "accepted: rotate the server's key if it may have been stolen"
            )
