"""Address of the Zenoh router: from the agent's options, else from the server."""

from __future__ import annotations

import re

from app.agent.http_client import ServerClient, plain
from app.agent.options import AgentOptions
from app.errors import FleetMapError, Invalid
from app.events import messages

ROUTER = re.compile(r"(tcp|tls|quic|udp|ws|wss)/[A-Za-z0-9_.:%\[\]-]+")
"""Router address accepted from a server: no device, no local socket, no ``#…`` that could weaken the robot's TLS."""


def find_router(options: AgentOptions, web: ServerClient, *, has_endpoint: bool) -> tuple[str, str] | None:
    """Return the router addresses and the key prefix; None to keep the present ones.

    Args:
        has_endpoint: whether addresses are already set.

    Raises Invalid if the server announces no router or an unsupported address.
    """
    connect, prefix = options.zenoh_connect, options.zenoh_prefix
    if connect is None or prefix is None:
        try:
            events = web.readyz().get("events", {})
            from_server = events.get("connect")
            connect = connect or (plain(str(from_server)) if from_server else None)
            prefix = prefix or plain(str(events.get("prefix") or messages.PREFIX))
        except (FleetMapError, AttributeError):
            if connect is None or has_endpoint:
                return None
            prefix = prefix or messages.PREFIX
    if connect is None:
        raise Invalid("the server announces no Zenoh router: set FLEETMAP_ZENOH_CONNECT, or rely on polling")
    if options.zenoh_connect is None and not all(ROUTER.fullmatch(part.strip()) for part in connect.split(",")):
        raise Invalid(f"unsupported router address from the server {connect[:300]!r}: set FLEETMAP_ZENOH_CONNECT")
    return connect, prefix
