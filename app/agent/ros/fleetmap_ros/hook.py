"""Hook of the agent: send the hook variables to the node and exit with its result.

Standard library only. The agent runs it as ``python3 hook.py SOCKET``.
"""

from __future__ import annotations

import json
import os
import socket
import sys
from collections.abc import Mapping

NAMES = ("CURRENT", "CHANGED", "CHANGED_FILE", "LEVEL", "VERSION", "ROOT", "CHANNEL", "OVERLAYS", "HOOK_STATUS")
MAX_ANSWER_BYTES = 1 << 20


def main(path: str, variables: Mapping[str, str]) -> int:
    """Request the node to load the map. Return the exit status."""
    request = {name: variables[name] for name in (f"FLEETMAP_{one}" for one in NAMES) if name in variables}
    if "FLEETMAP_CHANGED_FILE" in request:
        request.pop("FLEETMAP_CHANGED", None)  # may be truncated; the file is complete
    answer = bytearray()
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
            connection.connect(path)
            connection.sendall(json.dumps(request).encode())
            connection.shutdown(socket.SHUT_WR)
            while len(answer) < MAX_ANSWER_BYTES and (chunk := connection.recv(1 << 16)):
                answer += chunk
        body = json.loads(answer)
        ok, lines = body["ok"] is True, [str(line) for line in body["lines"]]
    except OSError as error:
        ok, lines = False, [f"no response from the node fleetmap_agent at {path}: {error.strerror or error}"]
    except (ValueError, KeyError, TypeError):
        ok, lines = False, ["the node fleetmap_agent stopped before it had loaded the map"]
    for line in lines:
        print(line)
    return 0 if ok else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], os.environ))
