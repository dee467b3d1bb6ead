"""What a robot believes: a manifest signed by the pinned key, of its environment and channel, fresh, never older.

Attacks that this refuses, in the words of The Update Framework: rollback (a lower sequence), freeze (an expired
manifest), mix-and-match (files of different versions: all hashes stand in one signed list), arbitrary bytes, and a
foreign key. A new key is taken only with the endorsement of the pinned one.
"""

from __future__ import annotations

import base64
import binascii
import dataclasses
import hashlib
import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta, timezone
from typing import Any

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

from app.agent.state import AgentState, Mark
from app.errors import Untrusted

MAX_CLOCK_SKEW = timedelta(seconds=60)
"""How far a robot's clock may be from the server's."""

MAX_SEQUENCE_AHEAD = 10**9
"""Maximum distance of a manifest's sequence from the highest accepted one: a stolen key cannot make all later ones look
old with a single manifest.
"""

MAX_EPOCH_AHEAD = 2**32
"""The same for epochs, with room for those that are a time in seconds."""

MAX_ELEVATION_METRES = 1e6
MAX_FILES = 100_000
MAX_VARIABLES = 2000
MAX_DEPTH = 100
_HASH = re.compile(r"[0-9a-f]{64}")
_FORMAT = re.compile(r"[a-z0-9][a-z0-9_]{0,62}")
_LAYER = re.compile(r"[a-z][a-z0-9_]{0,31}")
_KEY_ID = re.compile(r"[0-9a-f]{16}")
_TIME = re.compile(
    r"(?P<date>\d{4}-\d\d-\d\d)[Tt ](?P<clock>\d\d:\d\d:\d\d)(\.(?P<fraction>\d{1,30}))?(?P<zone>[Zz]|[+-]\d\d:\d\d)",
    re.ASCII,
)
_VARIABLE = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,127}")
_FORBIDDEN = re.compile(
    r"PATH|ENV|IFS|HOME|SHELL|(LD|DYLD|BASH|GIT|SSH|FLEETMAP)_\w*|PYTHON\w*|\w*_PRELOAD|\w*LIBRARY_PATH"
)
"""The server leaves these out, and more; a robot does not even believe a signature on them."""


@dataclass(frozen=True, slots=True)
class ManifestFile:
    """A file of a map. name: relative, with ``/`` between folders. level: name of the level that it belongs to."""

    format: str
    name: str
    size: int
    sha256: str
    level: str | None = None

    @property
    def path(self) -> str:
        """Where it lies below ``current``."""
        return f"{self.format}/{self.name}"


@dataclass(frozen=True, slots=True)
class Level:
    """A storey. elevation: metres."""

    name: str
    elevation: float


@dataclass(frozen=True, slots=True)
class Manifest:
    """A signed list of a version's files. data, signature: the signed bytes and the header, as they came.

    variables: what the place is called (``FARM_NAME`` …), for who sources ``environment.sh``. layers: layer -> a hash
    of its content. time: when it was signed. levels: lowest first. missing: optional format -> why it cannot be given.
    overlays: closures in force, as the server lists them; overlays_digest is None if the server applies none.
    closures, parameters: of the request that it answers: how closures are shown, and format -> its parameters.
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

    @property
    def mark(self) -> Mark:
        """Its position in the channel's history."""
        return Mark(self.epoch, self.sequence, self.root, self.overlays_digest)

    @property
    def map_key(self) -> tuple[Any, ...]:
        """Equal for manifests whose version folders are the same."""
        return self.root, self.closures_key, self.content

    @property
    def closures_key(self) -> str:
        """The digest of the closures in force, empty if there are none."""
        return self.overlays_digest if self.overlays and self.overlays_digest else ""

    @property
    def content(self) -> dict[str, str]:
        """Path -> SHA-256: equal for equal maps."""
        return {file.path: file.sha256 for file in self.files}


def parse(data: bytes, signature: str) -> Manifest:
    """The members of a manifest, each checked; Untrusted where they are not what a manifest has."""
    try:
        body = json.loads(data)
        files = tuple(
            ManifestFile(f["format"], f["name"], f["size"], f["sha256"], f.get("level")) for f in body["files"]
        )
        signed_at = body.get("time")
        expires = read_time(body["expires"])
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
            dict(body.get("variables", {})),
            dict(body.get("layers", {})),
            body.get("epoch", 0),
            None if signed_at is None else read_time(signed_at),
            tuple(Level(level["name"], level["elevation"]) for level in body.get("levels", [])),
            {line["format"]: line["detail"] for line in body.get("missing", [])},
            tuple(body.get("overlays", [])),
            body.get("overlays_digest"),
            body.get("closures", "apply"),
            {format_: dict(values) for format_, values in body.get("parameters", {}).items()},
        )
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise Untrusted(f"the server's manifest cannot be read: {type(error).__name__}: {error}") from None
    valid_numbers = all(
        type(n) is int and 0 <= n < 2**63
        for n in (manifest.sequence, manifest.version, manifest.epoch, *(f.size for f in files))
    )
    texts = all(isinstance(t, str) for t in (manifest.environment, manifest.channel or "", manifest.root))
    hashes = texts and all(
        isinstance(h, str) and _HASH.fullmatch(h) for h in (manifest.root, *(f.sha256 for f in files))
    )
    if not (valid_numbers and hashes) or expires.tzinfo is None or len(files) > MAX_FILES:
        raise Untrusted("the server's manifest cannot be read: a number, a hash or the time of expiry is none")
    _check_paths(files)
    _check_variables(manifest.variables)
    _check_site(manifest)
    if not all(isinstance(t, str) for t in manifest.layers.values()) or not all(map(_LAYER.fullmatch, manifest.layers)):
        raise Untrusted("the server's manifest cannot be read: a layer's name or hash is none")
    return manifest


def read_time(text: str) -> datetime:
    """Read an RFC 3339 time. Raises ValueError.

    Python 3.10's own ``fromisoformat`` reads neither ``Z`` nor a fraction of other than 3 or 6 digits.
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
        raise ValueError(f"a time before year 1 or after 9999: {text[:80]!r}") from None


def _check_site(manifest: Manifest) -> None:
    """Check levels, missing formats, closures and the time of signing."""
    names = [level.name for level in manifest.levels]
    problems = (
        (manifest.time is not None and manifest.time.tzinfo is None, "the time of signing has no zone"),
        (not all(map(_is_name, names)) or len(set(names)) != len(names), "a level's name is invalid or a duplicate"),
        (not all(_is_number(level.elevation) for level in manifest.levels), "a level's elevation is not a number"),
        (not all(f.level is None or f.level in names for f in manifest.files), "a file belongs to an unknown level"),
        (not all(_is_name(format_) for format_ in manifest.missing), "a missing format has no name"),
        (not all(isinstance(why, str) for why in manifest.missing.values()), "a missing format has no reason"),
        (not all(_is_closure(closure) for closure in manifest.overlays), "a closure has no id"),
        (bool(manifest.overlays) and manifest.overlays_digest is None, "its closures have no digest"),
        (not _is_digest(manifest.overlays_digest), "the digest of its closures is invalid"),
        (not isinstance(manifest.closures, str), "how it shows closures is not a text"),
    )
    for is_wrong, problem in problems:
        if is_wrong:
            raise Untrusted(f"the server's manifest cannot be read: {problem}")


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


def _check_variables(variables: Mapping[str, str]) -> None:
    """Names that a shell takes, texts in one line, and nothing that changes how the robot's own programs run."""
    if len(variables) > MAX_VARIABLES:
        raise Untrusted(f"the manifest has {len(variables)} variables, more than {MAX_VARIABLES}")
    for name, value in variables.items():
        fine = _VARIABLE.fullmatch(name) and isinstance(value, str) and (value.isprintable() or not value)
        if not fine or _FORBIDDEN.fullmatch(name):
            raise Untrusted(f"the manifest has a variable that is not handed on to a robot: {name[:80]!r}")


def _check_paths(files: Sequence[ManifestFile]) -> None:
    """No file leaves its folder, none is told twice, none is also a folder."""
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
            raise Untrusted(f"the manifest names a file that cannot be: {file.format!r}/{file.name!r}")
        seen.add(file.path)
        parts = file.path.split("/")
        folders |= {"/".join(parts[:n]) for n in range(1, len(parts))}
    if both := sorted(seen & folders):
        raise Untrusted(f"the manifest names a file that is a folder as well: {both[0]}")


def key_id(public: bytes) -> str:
    """The id of a raw public key."""
    return hashlib.sha256(public).hexdigest()[:16]


def verify_signature(
    data: bytes, signature: str, pinned: bytes | None, given: str | None, keys: Callable[[], list[Mapping[str, Any]]]
) -> bytes:
    """The raw public key that signed ``data``, if the robot may believe it: the pinned one, or one that it vouches for.

    signature: ``<key id>:<base64>``. given: what the operator said to trust at first contact (id or raw key in base64).
    keys: asks the server for its keys, the newest first; called only where the pinned key is not the one. Untrusted.
    """
    name, _, text = signature.partition(":")
    signed = _bytes(text)
    if not name or signed is None or len(signed) != 64:
        raise Untrusted("the server's manifest is not signed")
    if pinned is None and given is not None:
        pinned = _bytes(given) if not _KEY_ID.fullmatch(given) else None
    is_pinned = pinned is not None and key_id(pinned) == name
    key = pinned if pinned is not None and is_pinned else _from_server(name, pinned, given, keys())
    if not _verifies(key, signed, data):
        raise Untrusted(f"the manifest's signature is not that of the key {name}: it was changed on its way")
    return key


def _from_server(name: str, pinned: bytes | None, given: str | None, keys: Sequence[Mapping[str, Any]]) -> bytes:
    server_keys: dict[str, tuple[bytes, Mapping[str, Any]]] = {}
    for line in keys:
        public = _bytes(str(line.get("public_key", "")))
        if public is not None and len(public) == 32 and line.get("id") == key_id(public):
            server_keys[key_id(public)] = (public, line)
    if name not in server_keys:
        raise Untrusted(f"the manifest is signed with the key {name}, which the server does not tell")
    trusted = key_id(pinned) if pinned is not None else given
    if trusted is None:
        return server_keys[name][0]  # first contact: whoever answers is believed, and only he from now on
    at = name
    for _ in range(len(server_keys) + 1):
        if at == trusted:
            return server_keys[name][0]
        if at not in server_keys:
            break
        public, line = server_keys[at]
        by = str(line.get("endorsed_by", ""))
        voucher = (
            pinned if pinned is not None and by == key_id(pinned) else server_keys[by][0] if by in server_keys else None
        )
        endorsement = _bytes(str(line.get("endorsement", "")))
        if voucher is None or endorsement is None or not _verifies(voucher, endorsement, public):
            break
        at = by
    raise Untrusted(
        f"the manifest is signed with the key {name}, for which the trusted key {trusted} does not vouch. Is this "
        "another server? If it is meant to be, say its key with --key and remove state.json"
    )


def check_key(text: str) -> str:
    """A key as an operator writes it: its id (16 hexadecimal digits) or the raw public key in base64; Untrusted."""
    text = text.strip()
    raw = _bytes(text)
    if _KEY_ID.fullmatch(text) or (raw is not None and len(raw) == 32):
        return text
    raise Untrusted("--key takes a key's id (16 hexadecimal digits) or its public_key in base64, as GET /api/v1/keys")


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
    """Whether a signed manifest is the one that was asked for. mark: that of the newest one ever believed.

    parameters: format -> the parameters that it was requested with, of formats that have any.

    Raises Untrusted, with what an operator can do.
    """
    if manifest.environment != environment:
        raise Untrusted(f"the manifest is of the environment {manifest.environment!r}, not of {environment!r}")
    if manifest.channel != channel:
        raise Untrusted(f"the manifest is of the channel {manifest.channel!r}, not of {channel!r}")
    if manifest.expires < (now or datetime.now(timezone.utc)) - MAX_CLOCK_SKEW:
        raise Untrusted(
            f"the manifest has expired at {manifest.expires:%Y-%m-%d %H:%M:%S} UTC, and it is "
            f"{now or datetime.now(timezone.utc):%Y-%m-%d %H:%M:%S} by the newer of this robot's clock and the newest "
            "signed time: possible replay of an old one. Check both clocks"
        )
    got = {file.format for file in manifest.files}
    for format_, why in manifest.missing.items():
        if format_ in formats:
            raise Untrusted(f"the server cannot give the required format {format_}: {why}")
    if not set(formats) <= got <= {*formats, *optional}:
        missing, more = sorted(set(formats) - got), sorted(got - set(formats) - set(optional))
        raise Untrusted(f"the manifest is of other formats: without {missing or 'none'}, with {more or 'no'} further")
    _check_request(manifest, parameters or {}, optional)
    _check_ahead(manifest, mark)
    if mark is None:
        return
    if (manifest.epoch, manifest.sequence) < (mark.epoch, mark.sequence):
        epoch = f" of epoch {manifest.epoch}" if manifest.epoch != mark.epoch else ""
        raise Untrusted(
            f"manifest sequence {manifest.sequence}{epoch} is lower than {mark.sequence}, which this robot has already "
            "accepted: possible rollback. If the server was set up anew, remove state.json"
        )
    if (manifest.epoch, manifest.sequence) == (mark.epoch, mark.sequence) and manifest.root != mark.root:
        raise Untrusted(
            f"the manifest of sequence {manifest.sequence} has the root {manifest.root[:8]}, and {mark.root[:8]} was "
            "seen under the same number: two servers use one key, or it was restored: raise its epoch"
        )
    old, new = mark.overlays_digest, manifest.overlays_digest
    if (manifest.epoch, manifest.sequence) == (mark.epoch, mark.sequence) and old not in (None, new):
        raise Untrusted(
            f"the manifest of sequence {manifest.sequence} has the closures {(new or 'none')[:8]}, and "
            f"{(old or 'none')[:8]} was seen under the same number: there are two servers with one key. If it was "
            "restored, remove state.json"
        )


def _check_request(manifest: Manifest, parameters: Mapping[str, Mapping[str, str]], optional: Sequence[str]) -> None:
    """Refuse the answer to a request that was changed on its way. Servers without closures do not sign requests."""
    if manifest.overlays_digest is None:
        return
    present = {file.format for file in manifest.files}
    silent = [name for name in optional if name not in present and name not in manifest.missing]
    if manifest.closures != "apply":
        problem = f"closures={manifest.closures[:80]} instead of apply"
    elif manifest.parameters != parameters:
        problem = f"the parameters {str(manifest.parameters)[:300]} instead of {str(parameters)[:300]}"
    elif silent:
        problem = f"without the optional {', '.join(silent)[:300]}, and without a reason"
    else:
        return
    raise Untrusted(f"the manifest answers another request ({problem}): check what is between the robot and the server")


def _check_ahead(manifest: Manifest, mark: Mark | None) -> None:
    """Refuse a position that is too far ahead of the last accepted one."""
    epoch, sequence = (mark.epoch, mark.sequence) if mark is not None else (0, 0)
    for name, value, accepted, limit in (
        ("sequence", manifest.sequence, sequence, MAX_SEQUENCE_AHEAD),
        ("epoch", manifest.epoch, epoch, MAX_EPOCH_AHEAD),
    ):
        if value > accepted + limit:
            raise Untrusted(
                f"manifest {name} {value} is more than {limit} ahead of {accepted}, the last one that this robot has "
                "accepted: rotate the server's key if it may be stolen"
            )


def _verifies(public: bytes, signature: bytes, data: bytes) -> bool:
    try:
        Ed25519PublicKey.from_public_bytes(public).verify(signature, data)
    except (InvalidSignature, ValueError):
        return False
    return True


def _bytes(text: str) -> bytes | None:
    try:
        return base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError):
        return None


def pin_key(state: AgentState, key: str | None) -> AgentState:
    """Return the state that trusts a key (id or public key, base64) of the options; another pinned key is forgotten."""
    if key is None or key == state.given:
        return state
    if state.key is not None and key not in (key_id(state.key), base64.b64encode(state.key).decode()):
        state = dataclasses.replace(state, key=None, marks={})
    return dataclasses.replace(state, given=key)
