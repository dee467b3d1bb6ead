"""The Zenoh router that the agent connects to: given by its options, or by the server."""

from __future__ import annotations

import re

from app.agent.http_client import ServerClient, plain
from app.agent.options import AgentOptions
from app.errors import FleetMapError, Invalid
from app.events import messages

ROUTER = re.compile(r"(tcp|tls|quic|udp|ws|wss)/[A-Za-z0-9_.:%\[\]-]+")
"""A router as a server may name it: no device, no local socket, nothing (``#…``) that would weaken the robot's TLS."""


def find_router(options: AgentOptions, web: ServerClient, *, has_endpoint: bool) -> tuple[str, str] | None:
    """Return the router's addresses and the start of its keys; None to stay with those of before.

    has_endpoint: whether there are such. Raises Invalid if the server names no router, or by no plain address.
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
        raise Invalid("the server tells no router: FLEETMAP_ZENOH_CONNECT can name one")
    if options.zenoh_connect is None and not all(ROUTER.fullmatch(part.strip()) for part in connect.split(",")):
        detail = f"the server tells a router by what is no plain address ({connect[:300]}): FLEETMAP_ZENOH_CONNECT"
        raise Invalid(f"{detail} can name it")
    return connect, prefix
