"""Create the random secrets that the compose files mount, in ``secrets/`` beside them. Existing ones are kept.

With ``--scale`` also those of compose.scale.yaml and Kubernetes: the key of the S3 server, a certification authority
with the certificate of the proxy and the Zenoh routers (by ``openssl``), and the routers' users and rules. The rules
are written again each time: after a change of ``robots`` run this again, and restart the routers one by one.
``--kubernetes`` prints the files as secrets of Kubernetes.
"""

from __future__ import annotations

import argparse
import base64
import json
import secrets
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROUTER = "router"
"""User name and certificate's name of the routers among each other."""
ROUTERS = ("router-1", "router-2")
"""Host names of the routers, in compose.scale.yaml and as services of Kubernetes."""
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
# make_secrets.py --scale again, and restart the routers one by one.
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


def make(folder: Path) -> list[str]:
    """Write missing secrets and return their names.

    The files are readable by all, since the container's user does not exist on this machine; their folder is private.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    password = folder / "database_password"
    written = []
    if not password.exists():
        if (folder / "fleetmap_database_url").exists():
            raise SystemExit("fleetmap_database_url exists without database_password: remove it, or write both")
        written.append(_write(password, secrets.token_hex(24)))
    url = f"postgresql+psycopg://fleetmap:{password.read_text().strip()}@database:5432/fleetmap"
    return written + _write_missing(
        folder, {"fleetmap_database_url": url, "fleetmap_admin_token": secrets.token_urlsafe(32)}
    )


def make_scale(folder: Path, hosts: list[str]) -> list[str]:
    """Write what compose.scale.yaml needs beside the secrets of ``make``; return the names of new files.

    hosts: names and addresses by which robots and browsers reach this machine.
    """
    if sys.version_info < (3, 10):  # noqa: UP036  runs where the containers run
        raise SystemExit("--scale requires Python 3.10 or newer")
    written = _write_missing(
        folder,
        {
            "fleetmap_blob_access_key": secrets.token_hex(10),
            "fleetmap_blob_secret_key": secrets.token_urlsafe(32),
            "fleetmap_zenoh_password": secrets.token_urlsafe(32),
            "router_password": secrets.token_urlsafe(32),
        },
    )
    if not (folder / "robots").exists():
        written.append(_write(folder / "robots", ROBOTS.rstrip()))
        (folder / "robots").chmod(0o600)
    written += _certificates(folder, hosts)
    _write(folder / "store_users.json", _store_users(folder))
    users, rules = _router(folder)
    _write(folder / "router_users", users)
    _write(folder / "router.json5", rules)
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


def _write(path: Path, content: str) -> str:
    path.unlink(missing_ok=True)
    path.write_text(content + "\n")
    path.chmod(0o444)
    return path.name


def _read(folder: Path, name: str) -> str:
    return (folder / name).read_text().strip()


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
    sys.path.insert(0, str(HERE.parent))
    from app.errors import Invalid  # of this checkout, which needs no packages for this
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


def _certificates(folder: Path, hosts: list[str]) -> list[str]:
    """Create the authority and the certificate, unless they exist. To renew one, remove it and its key."""
    written = []
    pem, key = folder / "ca.pem", folder / "ca.key"
    if not pem.exists():
        _sign(pem, key, "Fleet Map Server", OF_AUTHORITY, AUTHORITY_DAYS)
        key.chmod(0o400)
        written += [pem.name, key.name]
    if not (folder / "server.pem").exists():
        if not key.exists():
            raise SystemExit("ca.key is missing: put server.pem and server.key of your own authority into the folder")
        places = [*hosts, "localhost", "127.0.0.1", *ROUTERS]
        names = ", ".join(f"{'IP' if _is_address(place) else 'DNS'}:{place}" for place in dict.fromkeys(places))
        arguments = ("-CA", str(pem), "-CAkey", str(key))
        extensions = OF_SERVER.format(names=names)
        _sign(folder / "server.pem", folder / "server.key", ROUTER, extensions, CERTIFICATE_DAYS, *arguments)
        written += ["server.pem", "server.key"]
    return written


def _is_address(host: str) -> bool:
    return ":" in host or host.replace(".", "").isdigit()


def _sign(pem: Path, key: Path, name: str, extensions: str, days: int, *arguments: str) -> None:
    with tempfile.TemporaryDirectory() as temporary:
        config = Path(temporary) / "openssl.cnf"
        config.write_text(EXTENSIONS.format(name=name) + extensions)
        command = ["openssl", "req", "-x509", "-config", str(config), "-days", str(days), *arguments]
        command += ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes"]
        try:
            done = subprocess.run(  # noqa: S603  a constant, and names in a file of ours
                [*command, "-keyout", str(key), "-out", str(pem)], capture_output=True, check=False
            )
        except FileNotFoundError:
            raise SystemExit(
                "openssl 3 is required for the certificates: install it (Debian: apt install openssl)"
            ) from None
    if done.returncode:
        raise SystemExit(f"openssl could not create {pem.name}: {done.stderr.decode(errors='replace').strip()}")
    for path in (pem, key):
        path.chmod(0o444)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", nargs="?", type=Path, default=HERE / "secrets")
    parser.add_argument("--scale", action="store_true", help="also those of compose.scale.yaml")
    parser.add_argument("--host", action="append", default=[], help="name or address of this machine, may be repeated")
    parser.add_argument("--kubernetes", action="store_true", help="print the existing ones as secrets of Kubernetes")
    options = parser.parse_args()
    if options.kubernetes:
        if not (options.folder / "router.json5").exists():
            raise SystemExit(f"{options.folder} is not complete: run make_secrets.py --scale first")
        print(kubernetes_secrets(options.folder))
        raise SystemExit(0)
    names = make(options.folder)
    if options.scale:
        names += make_scale(options.folder, options.host)
    for name in names:
        print("wrote", name)
