"""Security of the embedded router: TLS, users and access control.

Only the server may publish events, maps and ROS 2 topics; a robot may publish only its own status and liveliness token.
Every user may subscribe to and query all keys, so read access depends only on a password (and a certificate if
required). Source: Zenoh's access control, which passes a message if a rule of its sender (ingress) and one of its
receiver (egress) allow it. Wildcards do not match key segments that start with ``@``, which are used for history and
recovery (``@adv``) and for the ROS 2 graph.
"""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from app.errors import Invalid, Problem
from app.events import messages
from app.events.credentials import ZenohCredentials, readable_file

SERVER = "server"
"""User name of the server on its own router."""

PASSWORD_FILE = "zenoh-password"  # noqa: S105  the name of a file
USERS_FILE = "zenoh-users"
MAX_USERS_BYTES = 2**20

ALL_KEYS = ("**", "**/@adv/**", "@ros2_lv/**", "@/*/@ros2_lv/**")
SUBSCRIBER_MESSAGES = ("declare_subscriber", "query", "liveliness_query", "declare_liveliness_subscriber")
PUBLISHER_MESSAGES = ("put", "delete", "declare_queryable", "reply", "liveliness_token")


@dataclass(frozen=True, slots=True)
class RouterSecurity:
    """Security settings of the operator.

    Attributes:
        login: credentials of the server at another router, and of its own router at other routers. The embedded router
            presents its certificate to robots as well.
        mutual: whether robots must present a certificate signed by the login's ca.
        users: file of ``name:password`` lines.
        folder: folder for generated files.
    """

    login: ZenohCredentials = field(default_factory=ZenohCredentials)
    mutual: bool = False
    users: Path | None = None
    folder: Path = Path()

    def router_values(self, prefix: str, *, access: bool) -> dict[str, Any]:
        """Return Zenoh's settings for the router. access: whether to add access control. Raises Invalid."""
        out = self.login.values()
        if self.login.certificate is not None and self.login.key is not None:
            out["transport/link/tls/listen_certificate"] = readable_file(self.login.certificate)
            out["transport/link/tls/listen_private_key"] = readable_file(self.login.key)
        # By default, robots need no certificate.
        out["transport/link/tls/enable_mtls"] = self.mutual
        if self.users is not None:
            users = {**read_users(self.users), SERVER: self._server_password()}
            authentication = out.get("transport/auth/usrpwd", {"user": None, "password": None})
            out["transport/auth/usrpwd"] = {**authentication, "dictionary_file": str(self._dictionary(users))}
            if access:
                out["access_control"] = access_control(prefix, [name for name in users if name != SERVER])
        return out

    def session_values(self) -> dict[str, Any]:
        """Return Zenoh's settings for the server's session at its own router."""
        out = self.login.values()
        out["transport/link/tls/enable_mtls"] = self.mutual
        # The session connects to a loopback address, which the certificate need not contain.
        out["transport/link/tls/verify_name_on_connect"] = False
        if self.users is not None:
            credentials = {"user": SERVER, "password": self._server_password(), "dictionary_file": None}
            out["transport/auth/usrpwd"] = credentials
        return out

    def _server_password(self) -> str:
        """Return the server's password, created once and shared by all processes of the data folder."""
        path = self.folder / PASSWORD_FILE
        if not path.is_file():
            temporary = _private(path, secrets.token_urlsafe(32))
            try:
                os.link(temporary, path)
            except FileExistsError:
                pass  # another process has created it
            finally:
                temporary.unlink()
        return path.read_text().strip()

    def _dictionary(self, users: Mapping[str, str]) -> Path:
        path = self.folder / USERS_FILE
        _private(path, "".join(f"{name}:{password}\n" for name, password in users.items())).replace(path)
        return path.resolve()


def read_users(path: Path) -> dict[str, str]:
    """Read a file of ``name:password`` lines; ``#`` starts a comment line. Names are robot names. Raises Invalid."""
    readable_file(path)
    if path.stat().st_size > MAX_USERS_BYTES:
        raise Invalid(f"{path} exceeds {MAX_USERS_BYTES} bytes: it must be a file of NAME:PASSWORD lines")
    users: dict[str, str] = {}
    problems = []
    for number, raw in enumerate(path.read_bytes().splitlines(), 1):
        try:
            line = raw.decode().strip()
        except UnicodeDecodeError:
            problems.append(Problem("not UTF-8", path.name, number))
            continue
        if not line or line.startswith("#"):
            continue
        name, colon, password = line.partition(":")
        name, password = name.strip(), password.strip()
        if not colon or not password or not password.isprintable():
            problems.append(Problem("must be NAME:PASSWORD", path.name, number))
        elif not messages.ROBOT_NAME.fullmatch(name):
            problems.append(Problem("invalid name: use letters, digits, dots, - and _", path.name, number))
        elif name == SERVER:
            problems.append(Problem(f"the name {SERVER} is reserved", path.name, number))
        elif name in users:
            problems.append(Problem("duplicate name", path.name, number))
        else:
            users[name] = password
    if problems or not users:
        summary = "; ".join(f"line {p.line}: {p.problem}" for p in problems[:20]) or "the file has no users"
        raise Invalid(f"{path}: {summary}", problems)
    return users


def access_control(prefix: str, robots: Iterable[str], router: str | None = None) -> dict[str, Any]:
    """Return Zenoh's access control. Denied messages are dropped; to see them, set ``RUST_LOG=zenoh=trace``.

    router: name of the other routers of a mesh. A router knows the one that connects to it by its user, and the one
    that it connects to by its certificate: both have this name.
    """

    def rule(name: str, flows: list[str], kinds: Iterable[str], keys: Iterable[str]) -> dict[str, Any]:
        return {"id": name, "permission": "allow", "flows": flows, "messages": list(kinds), "key_exprs": list(keys)}

    names = list(robots)
    rules = [
        rule(
            "server: all messages",
            ["ingress", "egress"],
            (*PUBLISHER_MESSAGES, *SUBSCRIBER_MESSAGES),
            ALL_KEYS,
        ),
        rule("robots: receive all", ["egress"], (*PUBLISHER_MESSAGES, *SUBSCRIBER_MESSAGES), ALL_KEYS),
        rule("robots: subscribe and query all", ["ingress"], SUBSCRIBER_MESSAGES, ALL_KEYS),
    ]
    subjects = [{"id": SERVER, "usernames": [SERVER]}]
    if router is not None:
        subjects += [
            {"id": "router that connects", "usernames": [router]},
            {"id": "router that is connected to", "cert_common_names": [router]},
        ]
    policies = [{"rules": [rules[0]["id"]], "subjects": [str(subject["id"]) for subject in subjects]}]
    if names:  # a subject without names would be every client
        subjects.append({"id": "robots", "usernames": names})
        policies.append({"rules": [rules[1]["id"], rules[2]["id"]], "subjects": ["robots"]})
    for name in names:
        robot_rules = [
            rule(f"status of {name}", ["ingress"], ["put"], [messages.status_key(prefix, "*", name)]),
            rule(f"presence of {name}", ["ingress"], ["liveliness_token"], [messages.robot_key(prefix, name)]),
        ]
        rules += robot_rules
        subjects.append({"id": f"robot {name}", "usernames": [name]})
        policies.append({"rules": [r["id"] for r in robot_rules], "subjects": [f"robot {name}"]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def _private(path: Path, text: str) -> Path:
    """Write a temporary file beside ``path``, readable by its owner only, and return it."""
    temporary = path.with_name(f"{path.name}.{os.getpid()}.{secrets.token_hex(4)}")
    with open(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as stream:  # noqa: PTH123  its mode
        stream.write(text)
    return temporary
