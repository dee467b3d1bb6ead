"""Create the random secrets that the compose files mount, in ``secrets/`` beside them. Existing ones are kept.

They are passwords, a certification authority with one certificate for the proxy and the Zenoh routers (by
``openssl``), and the routers' users and rules. The rules are written again each time: after a change of ``robots``
run this again, and restart the routers one by one. ``--scale`` adds the key of the S3 server, for compose.scale.yaml
and Kubernetes; ``--kubernetes`` prints the files as secrets of Kubernetes. A server without containers uses the same
files (``--sqlite``, if it has no PostgreSQL).
"""

from __future__ import annotations

import argparse
import base64
import ipaddress
import json
import re
import secrets
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROUTER = "router"
"""User name and certificate's name of the routers among each other."""
ROUTERS = ("router", "router-1", "router-2")
"""Host names of the routers, in the compose files and as services of Kubernetes."""
ROUTER_PORT = 7447
INSIDE = "/run/secrets"
"""Where containers find the secrets."""
_OF_ALL = ("fleetmap_database_url", "fleetmap_blob_access_key", "fleetmap_blob_secret_key")
_OF_SERVERS = ("fleetmap_admin_token", "fleetmap_zenoh_password", "ca.pem")
_OF_ROUTERS = ("router.json5", "router_users", "ca.pem", "server.pem", "server.key")
KUBERNETES = {
    "fleetmap": {name: name for name in _OF_ALL},
    "fleetmap-server": {name: name for name in _OF_SERVERS},
    "fleetmap-router": {name: name for name in _OF_ROUTERS},
    "fleetmap-database": {"database_password": "database_password"},
    "fleetmap-store": {"store_users.json": "store_users.json"},
    "fleetmap-tls": {"tls.crt": "server.pem", "tls.key": "server.key"},
}
"""Secrets of the manifests: name -> key -> file."""

AUTHORITY_DAYS, CERTIFICATE_DAYS = 3650, 825
ROBOTS = """\
# Users of the Zenoh routers: one robot a line, NAME:PASSWORD (letters, digits, dots, - and _). Then run
# make_secrets.py again, and restart the routers one by one. make_secrets.py --robot NAME adds one.
"""
EXTENSIONS = """\
[req]
distinguished_name = name
x509_extensions = extensions
prompt = no
[name]
CN = {name}
[extensions]
subjectKeyIdentifier = hash
authorityKeyIdentifier = keyid
"""
OF_AUTHORITY = "basicConstraints = critical, CA:TRUE\nkeyUsage = critical, keyCertSign, cRLSign\n"
OF_SERVER = "basicConstraints = critical, CA:FALSE\nkeyUsage = critical, digitalSignature\nsubjectAltName = {names}\n"


def make(folder: Path, hosts: list[str], robots: list[str], *, database: bool = True, renew: bool = False) -> list[str]:
    """Write missing secrets of compose.yaml and return the names of new files.

    hosts: names and addresses by which robots and browsers reach this machine; robots: users to add; database: whether
    the server uses PostgreSQL; renew: replace the certificate.

    The files are readable by all, since the containers' users do not exist on this machine; their folder is private.
    """
    if sys.version_info < (3, 10):  # noqa: UP036  runs where the containers run
        raise SystemExit("Python 3.10 or newer is required")
    sys.path.insert(0, str(HERE.parent))  # names and rules of this checkout, which need no packages
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    folder.chmod(0o700)
    written = _database(folder) if database else []
    written += _write_missing(
        folder,
        {
            "fleetmap_admin_token": secrets.token_urlsafe(32),
            "fleetmap_zenoh_password": secrets.token_urlsafe(32),
            "router_password": secrets.token_urlsafe(32),
            "grafana_password": secrets.token_urlsafe(16),
        },
    )
    written += _robots(folder / "robots", robots)
    written += _certificates(folder, hosts, renew=renew)
    users, rules = _router(folder)
    _write(folder / "router_users", users)
    _write(folder / "router.json5", rules)
    return written


def make_scale(folder: Path) -> list[str]:
    """Write what compose.scale.yaml needs beside the secrets of ``make``; return the names of new files."""
    keys = {"fleetmap_blob_access_key": secrets.token_hex(10), "fleetmap_blob_secret_key": secrets.token_urlsafe(32)}
    written = _write_missing(folder, keys)
    _write(folder / "store_users.json", _store_users(folder))
    return written


def kubernetes_secrets(folder: Path) -> str:
    """Return the existing secrets as a list of Kubernetes objects, in JSON."""

    def secret(name: str, files: dict[str, str]) -> dict[str, object]:
        data = {key: base64.b64encode((folder / file).read_bytes()).decode() for key, file in files.items()}
        kind = "kubernetes.io/tls" if "tls.key" in files else "Opaque"
        return {"apiVersion": "v1", "kind": "Secret", "metadata": {"name": name}, "type": kind, "data": data}

    items = [secret(name, files) for name, files in KUBERNETES.items()]
    return json.dumps({"apiVersion": "v1", "kind": "List", "items": items}, indent=2)


def _write_missing(folder: Path, contents: dict[str, str]) -> list[str]:
    return [_write(folder / name, content) for name, content in contents.items() if not (folder / name).exists()]


def _write(path: Path, content: str, mode: int = 0o444) -> str:
    temporary = path.with_name(f".{path.name}")  # a file is complete, also after a power cut
    temporary.unlink(missing_ok=True)
    temporary.write_text(content + "\n")
    temporary.chmod(mode)
    temporary.replace(path)
    return path.name


def _read(folder: Path, name: str) -> str:
    return (folder / name).read_text().strip()


def _database(folder: Path) -> list[str]:
    """The password of PostgreSQL, and the URL with it."""
    password, url = folder / "database_password", folder / "fleetmap_database_url"
    if url.exists() and not password.exists():
        raise SystemExit(f"{url} exists without database_password: remove it, or write both")
    written = _write_missing(folder, {password.name: secrets.token_hex(24)})
    location = f"postgresql+psycopg://fleetmap:{_read(folder, password.name)}@database:5432/fleetmap"
    return written + _write_missing(folder, {url.name: location})


def _robots(path: Path, names: list[str]) -> list[str]:
    """Add users with random passwords to the file, which is created if it is missing."""
    from app.events.messages import ROBOT_NAME
    from app.events.security import SERVER

    for name in names:
        if not ROBOT_NAME.fullmatch(name) or name in (ROUTER, SERVER):
            raise SystemExit(f"--robot {name[:80]!r}: use letters, digits, dots, - and _, not {ROUTER} or {SERVER}")
    text = path.read_text() if path.exists() else ROBOTS
    existing = {line.partition(":")[0].strip() for line in text.splitlines()}
    lines = [f"{name}:{secrets.token_urlsafe(24)}" for name in dict.fromkeys(names) if name not in existing]
    if path.exists() and not lines:
        return []
    _write(path, "\n".join([text.rstrip(), *lines]), mode=0o600)
    return [path.name]


def _store_users(folder: Path) -> str:
    """The one user of the S3 server, in SeaweedFS' form."""
    key = {
        "accessKey": _read(folder, "fleetmap_blob_access_key"),
        "secretKey": _read(folder, "fleetmap_blob_secret_key"),
    }
    actions = ["Admin", "Read", "Write", "List"]  # Admin: the first upload creates the bucket
    return json.dumps({"identities": [{"name": "fleetmap", "credentials": [key], "actions": actions}]}, indent=2)


def _router(folder: Path) -> tuple[str, str]:
    """Users of both routers, and their configuration, with the rules and limits of the server's own router."""
    from app.errors import Invalid
    from app.events.security import SERVER, access_control, read_users

    lines = [line for line in (folder / "robots").read_text().splitlines() if line.strip() and line.strip()[0] != "#"]
    try:
        robots = read_users(folder / "robots") if lines else {}
    except Invalid as error:
        raise SystemExit(error.detail) from None
    if ROUTER in robots:
        raise SystemExit(f"{folder / 'robots'}: the name {ROUTER} is reserved")
    passwords = {SERVER: "fleetmap_zenoh_password", ROUTER: "router_password"}
    users = {**{user: _read(folder, name) for user, name in passwords.items()}, **robots}
    configuration = {
        "mode": "router",
        "listen": {"endpoints": [f"tls/0.0.0.0:{ROUTER_PORT}"]},
        "scouting": {"multicast": {"enabled": False}},
        "access_control": access_control("fleetmap", list(robots), ROUTER),
        "transport": {
            "unicast": {"max_sessions": 10_000, "accept_pending": 1000},
            "shared_memory": {"enabled": False},
            "link": {
                "rx": {"max_message_size": 65 * 2**20},
                "tls": {
                    "root_ca_certificate": f"{INSIDE}/ca.pem",
                    "listen_certificate": f"{INSIDE}/server.pem",
                    "listen_private_key": f"{INSIDE}/server.key",
                    "enable_mtls": False,
                },
            },
            "auth": {
                "usrpwd": {"user": ROUTER, "password": users[ROUTER], "dictionary_file": f"{INSIDE}/router_users"}
            },
        },
    }
    return "\n".join(f"{name}:{password}" for name, password in users.items()), json.dumps(configuration, indent=2)


def _certificates(folder: Path, hosts: list[str], *, renew: bool) -> list[str]:
    """Create the authority and the certificate, unless they exist. A renewed one keeps its names."""
    written = []
    authority, pem = folder / "ca.pem", folder / "server.pem"
    if not authority.exists():
        _sign(authority, "Fleet Map Server", OF_AUTHORITY, AUTHORITY_DAYS)
        authority.with_suffix(".key").chmod(0o400)
        written += ["ca.pem", "ca.key"]
    present, wanted = _names(pem) if pem.exists() else [], [_name(host) for host in hosts]
    missing = [name for name in wanted if name not in present]
    if present and not renew:
        if missing:
            raise SystemExit(
                f"{pem} is not for {', '.join(missing)}: run again with --renew, then restart the services"
            )
        return written
    if not authority.with_suffix(".key").exists():
        raise SystemExit("ca.key is missing: put server.pem and server.key of your own authority into the folder")
    names = [*present, *wanted, *map(_name, ("localhost", "127.0.0.1", *ROUTERS))]
    extensions = OF_SERVER.format(names=", ".join(dict.fromkeys(names)))
    _sign(
        pem, ROUTER, extensions, CERTIFICATE_DAYS, "-CA", str(authority), "-CAkey", str(authority.with_suffix(".key"))
    )
    return [*written, "server.pem", "server.key"]


def _names(pem: Path) -> list[str]:
    """Names and addresses for which a certificate is valid."""
    text = _openssl("x509", "-in", str(pem), "-noout", "-ext", "subjectAltName")
    return [_name(place) for place in re.findall(r"(?:DNS|IP Address):([^,\s]+)", text)]


def _name(host: str) -> str:
    """A host as openssl writes it into a certificate."""
    try:
        return f"IP:{ipaddress.ip_address(host).compressed}"
    except ValueError:
        if not re.fullmatch(r"(\*\.)?[A-Za-z0-9_-]+(\.[A-Za-z0-9_-]+)*", host):
            raise SystemExit(f"--host {host[:80]!r}: must be a host name or an address, without port") from None
        return f"DNS:{host.lower()}"


def _sign(pem: Path, name: str, extensions: str, days: int, *arguments: str) -> None:
    """Create a certificate and its key, ``….key`` beside it."""
    with tempfile.TemporaryDirectory(dir=pem.parent) as temporary:
        config, signed, key = (Path(temporary) / name for name in ("openssl.cnf", "pem", "key"))
        config.write_text(EXTENSIONS.format(name=name) + extensions)
        options = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes", *arguments]
        files = ["-config", str(config), "-keyout", str(key), "-out", str(signed)]
        _openssl("req", "-x509", *files, "-days", str(days), *options)
        for source, target in ((key, pem.with_suffix(".key")), (signed, pem)):
            source.chmod(0o444)
            source.replace(target)


def _openssl(*arguments: str) -> str:
    try:
        done = subprocess.run(  # noqa: S603  constants, and names in a file of ours
            ["openssl", *arguments],  # noqa: S607  of the machine
            capture_output=True,
            check=False,
        )
    except FileNotFoundError:
        raise SystemExit(
            "openssl 3 is required for the certificates: install it (Debian: apt install openssl)"
        ) from None
    if done.returncode:
        raise SystemExit(f"openssl {arguments[0]} failed: {done.stderr.decode(errors='replace').strip()}")
    return done.stdout.decode()


def main() -> None:
    """Run as a command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", nargs="?", type=Path, default=HERE / "secrets")
    parser.add_argument("--host", action="append", default=[], help="name or address of this machine, may be repeated")
    parser.add_argument("--robot", action="append", default=[], help="robot to add with a password, may be repeated")
    parser.add_argument(
        "--renew", action="store_true", help="replace the certificate, before it ends or for more hosts"
    )
    parser.add_argument("--sqlite", action="store_true", help="no secrets of PostgreSQL")
    parser.add_argument("--scale", action="store_true", help="also those of compose.scale.yaml")
    parser.add_argument("--kubernetes", action="store_true", help="print the existing ones as secrets of Kubernetes")
    options = parser.parse_args()
    if options.kubernetes:
        if not (options.folder / "store_users.json").exists():
            raise SystemExit(f"{options.folder} is not complete: run make_secrets.py --scale first")
        print(kubernetes_secrets(options.folder))
        return
    if options.scale and options.sqlite:
        raise SystemExit("--scale: several servers require PostgreSQL, so --sqlite is not possible")
    names = make(options.folder, options.host, options.robot, database=not options.sqlite, renew=options.renew)
    if options.scale:
        names += make_scale(options.folder)
    for name in names:
        print("wrote", name)


if __name__ == "__main__":
    main()
