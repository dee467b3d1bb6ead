"""A router of our own that tells friend from foe: TLS, users, and who may say what.

Only the server puts events, maps and topics of ROS 2; a robot puts its own status and shows its own token. Everybody
who may come in hears and asks everything: what a robot may hear is decided by whether it has a password (and, where
asked for, a certificate). Source: Zenoh's access control, where a message is let through if a rule of its sender
(ingress) and one of its receiver (egress) say so. Keys with a piece that starts with ``@`` are matched by no wildcard;
they carry history and recovery (``@adv``) and the graph of ROS 2.
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
"""The user that the server itself is on its own router."""

PASSWORD_FILE = "zenoh-password"  # noqa: S105  the name of a file
USERS_FILE = "zenoh-users"
MAX_USERS_BYTES = 2**20

ALL_KEYS = ("**", "**/@adv/**", "@ros2_lv/**", "@/*/@ros2_lv/**")
SUBSCRIBER_MESSAGES = ("declare_subscriber", "query", "liveliness_query", "declare_liveliness_subscriber")
PUBLISHER_MESSAGES = ("put", "delete", "declare_queryable", "reply", "liveliness_token")


@dataclass(frozen=True, slots=True)
class RouterSecurity:
    """What an operator sets. login: of the server at somebody else's router, and of its own router at others.

    certificate and key of the login are what a router of our own shows, too. mutual: robots must show a certificate
    that the login's ca has signed. users: a file of ``name:password`` lines. folder: for what is kept between starts.
    """

    login: ZenohCredentials = field(default_factory=ZenohCredentials)
    mutual: bool = False
    users: Path | None = None
    folder: Path = Path()

    def router_values(self, prefix: str, *, access: bool) -> dict[str, Any]:
        """Zenoh's settings for the router. access: whether to say who may say what. Raises Invalid."""
        out = self.login.values()
        if self.login.certificate is not None and self.login.key is not None:
            out["transport/link/tls/listen_certificate"] = readable_file(self.login.certificate)
            out["transport/link/tls/listen_private_key"] = readable_file(self.login.key)
        # Unless asked for, a robot without a certificate is welcome.
        out["transport/link/tls/enable_mtls"] = self.mutual
        if self.users is not None:
            users = {**read_users(self.users), SERVER: self._server_password()}
            authentication = out.get("transport/auth/usrpwd", {"user": None, "password": None})
            out["transport/auth/usrpwd"] = {**authentication, "dictionary_file": str(self._dictionary(users))}
            if access:
                out["access_control"] = access_control(prefix, [name for name in users if name != SERVER])
        return out

    def session_values(self) -> dict[str, Any]:
        """Zenoh's settings for the server's own session at its own router."""
        out = self.login.values()
        out["transport/link/tls/enable_mtls"] = self.mutual
        # It connects to an address of this machine, which no certificate may name.
        out["transport/link/tls/verify_name_on_connect"] = False
        if self.users is not None:
            credentials = {"user": SERVER, "password": self._server_password(), "dictionary_file": None}
            out["transport/auth/usrpwd"] = credentials
        return out

    def _server_password(self) -> str:
        """Made once; all processes of the data folder have the same."""
        path = self.folder / PASSWORD_FILE
        if not path.is_file():
            temporary = _private(path, secrets.token_urlsafe(32))
            try:
                os.link(temporary, path)
            except FileExistsError:
                pass  # another process was quicker
            finally:
                temporary.unlink()
        return path.read_text().strip()

    def _dictionary(self, users: Mapping[str, str]) -> Path:
        path = self.folder / USERS_FILE
        _private(path, "".join(f"{name}:{password}\n" for name, password in users.items())).replace(path)
        return path.resolve()


def read_users(path: Path) -> dict[str, str]:
    """A file of ``name:password`` lines; ``#`` starts a comment line. Names are robots'. Raises Invalid."""
    readable_file(path)
    if path.stat().st_size > MAX_USERS_BYTES:
        raise Invalid(f"{path} has more than {MAX_USERS_BYTES} bytes: is it a file of users?")
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
            problems.append(Problem("not NAME:PASSWORD", path.name, number))
        elif not messages.ROBOT_NAME.fullmatch(name):
            problems.append(Problem("a name is of letters, digits, dots, - and _", path.name, number))
        elif name == SERVER:
            problems.append(Problem(f"the name {SERVER} is the server's own", path.name, number))
        elif name in users:
            problems.append(Problem("this name is there already", path.name, number))
        else:
            users[name] = password
    if problems or not users:
        summary = "; ".join(f"line {p.line}: {p.problem}" for p in problems[:20]) or "there is no user in it"
        raise Invalid(f"{path}: {summary}", problems)
    return users


def access_control(prefix: str, robots: Iterable[str]) -> dict[str, Any]:
    """Zenoh's access control: what is not allowed is dropped (the router says so with ``RUST_LOG=zenoh=trace``)."""

    def rule(name: str, flows: list[str], kinds: Iterable[str], keys: Iterable[str]) -> dict[str, Any]:
        return {"id": name, "permission": "allow", "flows": flows, "messages": list(kinds), "key_exprs": list(keys)}

    names = list(robots)
    rules = [
        rule(
            "the server says and hears all",
            ["ingress", "egress"],
            (*PUBLISHER_MESSAGES, *SUBSCRIBER_MESSAGES),
            ALL_KEYS,
        ),
        rule("robots hear all", ["egress"], (*PUBLISHER_MESSAGES, *SUBSCRIBER_MESSAGES), ALL_KEYS),
        rule("robots ask all", ["ingress"], SUBSCRIBER_MESSAGES, ALL_KEYS),
    ]
    subjects = [{"id": SERVER, "usernames": [SERVER]}, {"id": "robots", "usernames": names}]
    policies = [
        {"rules": [rules[0]["id"]], "subjects": [SERVER]},
        {"rules": [rules[1]["id"], rules[2]["id"]], "subjects": ["robots"]},
    ]
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
    """A new file beside ``path`` that only its owner reads."""
    temporary = path.with_name(f"{path.name}.{os.getpid()}.{secrets.token_hex(4)}")
    with open(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as stream:  # noqa: PTH123  its mode
        stream.write(text)
    return temporary
