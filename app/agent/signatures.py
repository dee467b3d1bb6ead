"""Verify signatures of manifests: by the trusted key, by one that it endorses, or by a mirror that it permits to sign.

A server's keys endorse their successors. A centre permits a mirror's key to sign the manifests of one environment for
a time, so that the mirror can serve while it is cut off.
"""

from __future__ import annotations

import base64
import binascii
import dataclasses
import hashlib
import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

from app.agent.signed_manifest import MAX_CLOCK_SKEW, read_time
from app.agent.state import AgentState
from app.errors import Untrusted

_KEY_ID = re.compile(r"[0-9a-f]{16}")


def key_id(public: bytes) -> str:
    """Return the id of a raw public key: the first 16 hexadecimal digits of its SHA-256."""
    return hashlib.sha256(public).hexdigest()[:16]


@dataclass(frozen=True, slots=True)
class Trust:
    """Why a manifest is trusted.

    Attributes:
        key: raw public key that signed it.
        root: raw public key to trust from now on: the same, or of a mirror's manifest that of its centre.
        until: end of the mirror's permission; None for a manifest of the trusted server itself.
    """

    key: bytes
    root: bytes
    until: datetime | None = None


class Unendorsed(Untrusted):
    """A manifest that is signed with a key which the trusted key does not endorse."""


def verify_manifest(
    data: bytes,
    signature: str,
    pinned: bytes | None,
    given: str | None,
    keys: Callable[[], Sequence[Mapping[str, Any]]],
    *,
    environment: str,
    now: datetime,
) -> Trust:
    """Verify the signature of an environment's manifest, also by a mirror that the trusted key permits to sign.

    Args:
        signature, given, keys: as for ``verify_signature``.
        now: time for which a mirror's permission must be valid.

    Raises:
        Unendorsed, Untrusted: the signature or the key is not valid.
    """
    if pinned is None and given is not None and not _KEY_ID.fullmatch(given):
        pinned = _bytes(given)
    trusted = key_id(pinned) if pinned is not None else given
    name = signature.partition(":")[0]
    if trusted is None or trusted == name:
        key = verify_signature(data, signature, pinned, given, keys)
        return Trust(key, key)
    lines = keys()
    server_keys = _listed(lines)
    permission = _permission(name, server_keys, trusted, pinned, environment, now) if name in server_keys else None
    if permission is None:
        key = verify_signature(data, signature, pinned, given, lambda: lines)
        return Trust(key, key)
    root, until = permission
    key = server_keys[name][0]
    signed = _bytes(signature.partition(":")[2])
    if signed is None or not _verifies(key, signed, data):
        raise Untrusted(f"signature of the manifest does not match key {name}: the manifest was changed in transit")
    return Trust(key, root, until)


_Listed = Mapping[str, "tuple[bytes, Mapping[str, Any]]"]


def _permission(
    name: str, server_keys: _Listed, trusted: str, pinned: bytes | None, environment: str, now: datetime
) -> tuple[bytes, datetime] | None:
    """Return the key that permits a mirror's key to sign, and until when; None if none that is trusted does.

    Raises Unendorsed if the permission has ended.
    """
    public, line = server_keys[name]
    delegations = line.get("delegations", ())
    for one in delegations if isinstance(delegations, list) else ():
        members = one if isinstance(one, dict) else {}
        by, statement = str(members.get("signed_by", "")), _bytes(str(members.get("statement", "")))
        signed = _bytes(str(members.get("signature", "")))
        voucher = pinned if pinned is not None and key_id(pinned) == by else server_keys.get(by, (None,))[0]
        if voucher is None or statement is None or signed is None or not _verifies(voucher, signed, statement):
            continue
        if by != trusted and not _is_endorsed(by, server_keys, trusted, pinned):
            continue
        until = _delegated_until(statement, public, environment)
        if until is None:
            continue
        if now > until + MAX_CLOCK_SKEW:
            raise Unendorsed(
                f"manifest is signed by a mirror with key {name}, which key {by} permits until "
                f"{until:%Y-%m-%d %H:%M} UTC; the time is {now:%Y-%m-%d %H:%M} UTC: connect the mirror to its "
                "centre, and check the clocks"
            )
        return voucher, until
    return None


def _delegated_until(statement: bytes, public: bytes, environment: str) -> datetime | None:
    """Return the end of a permission; None if it is about another key or environment, or cannot be read."""
    try:
        body = json.loads(statement)
        about = (body["kind"], _bytes(body["public_key"]), body["environment"])
        until = read_time(body["until"])
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
    return until if about == ("delegation", public, environment) else None


def verify_signature(
    data: bytes,
    signature: str,
    pinned: bytes | None,
    given: str | None,
    keys: Callable[[], Sequence[Mapping[str, Any]]],
) -> bytes:
    """Verify a signature and return the raw public key that signed ``data``: the pinned one or one that it endorses.

    Args:
        signature: ``<key id>:<base64>``.
        given: key to trust at first contact, set by the operator (id, or raw key in base64).
        keys: fetches the server's keys, newest first; called only if another key than the pinned one signed.

    Raises:
        Untrusted: the signature or the key is not valid.
    """
    name, _, text = signature.partition(":")
    signed = _bytes(text)
    if not name or signed is None or len(signed) != 64:
        raise Untrusted("manifest has no valid signature")
    if pinned is None and given is not None:
        pinned = _bytes(given) if not _KEY_ID.fullmatch(given) else None
    is_pinned = pinned is not None and key_id(pinned) == name
    key = pinned if pinned is not None and is_pinned else _from_server(name, pinned, given, keys())
    if not _verifies(key, signed, data):
        raise Untrusted(f"signature of the manifest does not match key {name}: the manifest was changed in transit")
    return key


def _from_server(name: str, pinned: bytes | None, given: str | None, keys: Sequence[Mapping[str, Any]]) -> bytes:
    server_keys = _listed(keys)
    if name not in server_keys:
        raise Untrusted(f"manifest is signed with key {name}, which the server does not list")
    trusted = key_id(pinned) if pinned is not None else given
    if trusted is None or _is_endorsed(name, server_keys, trusted, pinned):  # None: trust on first use
        return server_keys[name][0]
    raise Unendorsed(
        f"manifest is signed with key {name}, which the trusted key {trusted} does not endorse: possibly another "
        "server. If this is intended, set --key to its key and delete state.json"
    )


def _listed(keys: Sequence[Mapping[str, Any]]) -> dict[str, tuple[bytes, Mapping[str, Any]]]:
    """Return the keys with valid ids: id -> raw key, and its members."""
    out: dict[str, tuple[bytes, Mapping[str, Any]]] = {}
    for line in keys:
        public = _bytes(str(line.get("public_key", "")))
        if public is not None and len(public) == 32 and line.get("id") == key_id(public):
            out[key_id(public)] = (public, line)
    return out


def _is_endorsed(name: str, server_keys: _Listed, trusted: str, pinned: bytes | None) -> bool:
    """Return whether a chain of endorsements leads from the trusted key to this one."""
    at = name
    for _ in range(len(server_keys) + 1):
        if at == trusted:
            return True
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
    return False


def check_key(text: str) -> str:
    """Check a key of an operator: its id (16 hexadecimal digits) or the raw public key in base64. Raises Untrusted."""
    text = text.strip()
    raw = _bytes(text)
    if _KEY_ID.fullmatch(text) or (raw is not None and len(raw) == 32):
        return text
    raise Untrusted("invalid --key: use the id (16 hexadecimal digits) or the public_key (base64) of GET /api/v1/keys")


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
    """Return the state with a trusted key set by the operator (id, or public key in base64).

    Another pinned key and its accepted positions are removed.
    """
    if key is None or key == state.given:
        return state
    if state.key is not None and key not in (key_id(state.key), base64.b64encode(state.key).decode()):
        state = dataclasses.replace(state, key=None, marks={})
    return dataclasses.replace(state, given=key)
