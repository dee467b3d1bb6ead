"""Checks of TLS certificates: their files, time, names and authority."""

from __future__ import annotations

import ipaddress
import ssl
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from urllib.parse import urlsplit

from app.certificates import Certificate, read_certificate
from app.doctor.registry import Finding, check, error, ok, warning
from app.doctor.site import Site
from app.errors import Invalid

SOON = timedelta(days=21)
NOW = timedelta(days=3)
RENEW = "renew it and restart the server, which reads it at its start"


@check
def certificate_https(site: Site) -> Iterator[Finding]:
    """Look at the certificate of HTTPS."""
    settings = site.settings
    if settings.tls_certificate is None or settings.tls_key is None:
        yield ok("none: HTTP, or a proxy has it")
        return
    ca = site.environment.get("FLEETMAP_CA")
    hosts = {urlsplit(url).hostname for url in (settings.public_url, site.server) if url}
    yield from _examine(site, settings.tls_certificate, settings.tls_key, Path(ca) if ca else None, hosts)


@check
def certificate_zenoh(site: Site) -> Iterator[Finding]:
    """Look at the certificates of Zenoh."""
    settings = site.settings
    if settings.zenoh_mode == "off":
        yield ok("Zenoh is off")
        return
    if settings.zenoh_ca is not None:
        yield from _read(site, settings.zenoh_ca)
    if settings.zenoh_certificate is not None and settings.zenoh_key is not None:
        hosts = _advertised(settings.zenoh_advertise) if settings.zenoh_mode == "router" else set()
        yield from _examine(site, settings.zenoh_certificate, settings.zenoh_key, settings.zenoh_ca, hosts)
    elif settings.zenoh_ca is None:
        yield ok("none: events are not encrypted, or the router's authority is a public one")


def _advertised(endpoints: str) -> set[str | None]:
    """Return the host names in advertised endpoints such as ``tls/maps.example.org:7447``."""
    parts = [part.strip() for part in endpoints.split(",") if part.strip().startswith(("tls/", "quic/"))]
    hosts = {part.partition("/")[2].rpartition(":")[0].strip("[]") for part in parts}
    return {host for host in hosts if host not in ("0.0.0.0", "::", "*")}  # noqa: S104  nothing is bound here


def _read(site: Site, path: Path) -> Iterator[Finding]:
    """Look at a certificate's file and time."""
    try:
        certificate = read_certificate(path)
    except Invalid as failure:
        yield error(failure.detail, str(path), "set a readable PEM file")
        return
    yield _time(site, certificate)


def _time(site: Site, certificate: Certificate) -> Finding:
    left, place = certificate.ends - site.now(), str(certificate.path)
    until = f"{certificate.ends:%Y-%m-%d %H:%M} UTC"
    if site.now() < certificate.begins:
        return error(f"not valid before {certificate.begins:%Y-%m-%d %H:%M} UTC", place, "check this machine's clock")
    if left < timedelta(0):
        return error(f"expired on {until}", place, RENEW)
    detail = f"valid until {until}, {left.days} days"
    if left < NOW:
        return error(detail, place, RENEW)
    return warning(detail, place, RENEW) if left < SOON else ok(detail, place)


def _examine(site: Site, path: Path, key: Path, ca: Path | None, hosts: set[str | None]) -> Iterator[Finding]:
    """Look at a certificate with its key, as a client of these hosts sees it."""
    findings = list(_read(site, path))
    yield from findings
    if not path.is_file():
        return
    try:
        server = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        server.load_cert_chain(path, key, password="")
    except (OSError, ssl.SSLError) as failure:
        advice = "set the certificate (with its chain) and its unencrypted key, both readable by this user"
        yield error(f"certificate and key cannot be used: {failure.strerror or failure}", f"{path}, {key}", advice)
        return
    if any(finding.level == "error" for finding in findings):
        return
    names = read_certificate(path).names
    for host in sorted(host for host in hosts if host):
        if not _covers(names, host):
            advice = f"create one whose names contain {host}; it has {', '.join(names) or 'none'}"
            yield error(f"is not valid for {host}", str(path), advice)
    problem = _verify(server, ca)
    if problem is None:
        yield ok("its chain leads to a trusted authority", str(path))
    elif ca is None:
        advice = "with an authority of your own, set FLEETMAP_CA to it on all clients and here; else add the chain"
        yield warning(f"not trusted by this machine: {problem}", str(path), advice)
    else:
        yield error(f"not signed by {ca}: {problem}", str(path), "use a certificate of this authority, with its chain")


def _covers(names: tuple[str, ...], host: str) -> bool:
    """Whether a certificate with these names is valid for a host; ``*`` stands for one label."""
    try:
        return str(ipaddress.ip_address(host)) in names
    except ValueError:
        parent = host.lower().partition(".")[2]
        return any(name.lower() in (host.lower(), f"*.{parent}") for name in names)


def _verify(server: ssl.SSLContext, ca: Path | None) -> str | None:
    """Shake hands with a certificate in memory, as a client that trusts an authority; return the client's problem."""
    try:
        client = ssl.create_default_context(cafile=ca)
    except (OSError, ssl.SSLError) as failure:
        return f"the authority cannot be read ({failure.strerror or failure})"
    client.check_hostname = False
    to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
    ours = client.wrap_bio(to_client, to_server)
    theirs = server.wrap_bio(to_server, to_client, server_side=True)
    for _ in range(10):
        for end in (ours, theirs):
            try:
                end.do_handshake()
            except ssl.SSLWantReadError:
                continue
            except ssl.SSLCertVerificationError as failure:
                return failure.verify_message
            except ssl.SSLError as failure:
                return failure.reason or str(failure)
            if end is ours:
                return None
    return "the handshake does not end"
