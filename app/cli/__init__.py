"""``fleetmap``: the command line of the server, its clients and the agent.

Exit status: 0 success, 1 failure (the reason is on standard error), 2 wrong usage.
"""

from __future__ import annotations

import atexit
import gc
import sys
from collections.abc import Sequence

from app import __version__


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command and exit with its status."""
    atexit.register(gc.freeze)  # else the interpreter scans all objects of a server for a second before it ends
    given = list(sys.argv[1:] if arguments is None else arguments)
    sys.exit(run(given))


def run(arguments: Sequence[str]) -> int:
    """Run one command and return its exit status. Errors are printed to standard error, as JSON with ``--json``."""
    if list(arguments) == ["--version"]:  # without the imports of a command
        sys.stdout.write(f"fleetmap {__version__}\n")
        return 0
    from app.cli.commands import build, needed_command
    from app.cli.problems import RequestFailed, describe_error
    from app.errors import FleetMapError

    try:
        build(needed_command(arguments))(list(arguments), prog_name="fleetmap", standalone_mode=True)
    except SystemExit as error:
        return error.code if isinstance(error.code, int) else int(error.code is not None)
    except (RequestFailed, FleetMapError, ModuleNotFoundError, OSError) as error:
        problem, hint = describe_error(error)
        if problem is None:
            raise
        from app.cli import output

        output.show_problem(problem, hint=hint, as_json="--json" in arguments)
        return 1
    return 0
