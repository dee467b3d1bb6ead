"""Why a request to an S3 server failed, and what to do: in words for people, without addresses and signatures."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Final
from urllib.parse import urlsplit


@dataclass(frozen=True, slots=True)
class Fault:
    """What is wrong, and what to do about it; is_full: no room, so that reading works."""

    reason: str
    advice: str
    is_full: bool = False

    def __str__(self) -> str:
        return f"{self.reason}: {self.advice}"


_KEYS = "AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or FLEETMAP_BLOB_ACCESS_KEY and FLEETMAP_BLOB_SECRET_KEY"
_POLICY = f"let the bucket's policy allow it for this key, and check the bucket's name and the keys ({_KEYS})"
_SERVER_LOG = "look at its log and its free space (SeaweedFS answers so if it has no volume left to write)"
_REFUSED = "access was refused"
_SCHEME = "check whether AWS_ENDPOINT_URL must begin with http:// or https://"

_FULL = ("code: 507", "InsufficientStorage", "QuotaExceeded", "XMinioStorageFull", "no space left", "ServiceFull")

_FAULTS: Final = (
    (("latest/api/token", "latest/meta-data"), Fault("no access key is set", f"set {_KEYS}")),
    (("InvalidAccessKeyId",), Fault(f"{_REFUSED}, since it does not know the access key", f"correct {_KEYS}")),
    (("SignatureDoesNotMatch",), Fault(f"{_REFUSED}, since the secret key is wrong", f"correct {_KEYS}")),
    (("ExpiredToken", "InvalidToken"), Fault(f"{_REFUSED}, since the session has ended", "renew AWS_SESSION_TOKEN")),
    (
        ("RequestTimeTooSkewed",),
        Fault(f"{_REFUSED}, since the clocks differ", "make a time service run on both machines"),
    ),
    (("NoSuchBucket",), Fault("no such bucket", "create it, or correct the bucket's name")),
    (
        ("PermanentRedirect", "HeaderMalformed"),
        Fault("the bucket is in another region", "set AWS_REGION to the bucket's"),
    ),
    (_FULL, Fault("it is full", "free space there, or raise the quota of the bucket", is_full=True)),
    (("code: 401", "code: 403", "AccessDenied"), Fault(_REFUSED, _POLICY)),
    (
        ("InvalidCertificate",),
        Fault("its certificate is not trusted", "add its authority to this machine's certificates"),
    ),
    (("InvalidContentType", "ConnectionReset"), Fault("it broke off the connection", _SCHEME)),
    (("kind: Timeout", "TimedOut", "timed out"), Fault("it answers too slowly", "check its load and the network")),
    (("kind: Connect", "error sending"), Fault("it does not answer", "check AWS_ENDPOINT_URL, and whether it runs")),
)
"""Words of an answer or error, and what they mean; the first that fits."""


def fault_of(error: Exception) -> Fault:
    """Return what an error of obstore means."""
    text = str(error)
    for words, fault in _FAULTS:
        if any(word in text for word in words):
            return fault
    code = text.partition("status code: ")[2].partition(":")[0]
    return Fault(f"it answered {code}" if code else type(error).__name__, _SERVER_LOG)


def check_endpoint() -> Fault | None:
    """Return what is wrong with the address of the S3 server: obstore ends the thread that uses an unusable one."""
    for name in ("AWS_ENDPOINT_URL", "AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT"):
        address = os.environ.get(name)
        if address:
            parts = urlsplit(address)
            if parts.scheme not in ("http", "https") or not parts.hostname:
                return Fault(f"{name} is no address", "use a complete one: http://host:port or https://host")
    return None
