"""``fleetmap agent`` and ``fleetmap agent-level``: keep a robot's map directory up to date with a channel."""

from __future__ import annotations

import contextlib
import json
import os
import sys
from collections.abc import Callable
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from app.cli import completion, options, output
from app.cli.signals import call_at_stop
from app.errors import Invalid

if TYPE_CHECKING:
    from app.agent.agent import Agent


def _copy_ros_package(workspace: Path | None) -> None:
    """Copy the ROS 2 package and exit."""
    if workspace is not None:
        from app.agent import ros

        output.print_status(
            f"wrote {ros.copy_package(workspace)}: build it with colcon build --packages-select fleetmap_ros"
        )
        raise typer.Exit


Environment = Annotated[
    str,
    typer.Option("--environment", "-e", help="Name of the environment.", autocompletion=completion.environments),
]
Formats = Annotated[
    str,
    typer.Option(
        "--formats",
        "-f",
        help="Required formats, comma-separated, with optional parameters: `occupancy_grid?level=L2&grid=map,tmap2`.",
    ),
]
OptionalFormats = Annotated[
    str, typer.Option("--optional", help="Optional formats, comma-separated: installed if the server has them.")
]
Channel = Annotated[
    str | None,
    typer.Option(
        "--channel",
        help="Channel to follow [default: production if it exists, else latest].",
        autocompletion=completion.versions,
    ),
]
Robot = Annotated[
    str | None, typer.Option("--robot", envvar="FLEETMAP_ROBOT", help="Name of the robot [default: host name].")
]
OnChange = Annotated[
    list[str] | None,
    typer.Option(
        "--on-change", help="Command to run after each switch, or a bundled hook (nav2, topological); repeatable."
    ),
]
BeforeSwitch = Annotated[
    list[str] | None,
    typer.Option(
        "--before-switch",
        help="Command to run before each switch, also for closures: exit status 0 allows the switch, 75 delays it "
        "(runs again after 5 seconds), any other rejects the map; repeatable.",
    ),
]
TrustedKey = Annotated[
    str | None,
    typer.Option(
        "--key",
        envvar="FLEETMAP_AGENT_KEY",
        help="Server key to trust, as key id or public key (`fleetmap keys show`) [default: pin the key of the first "
        "contact].",
    ),
]
Poll = Annotated[
    float,
    typer.Option("--poll", min=0.1, help="Seconds between polls, ±50 % jitter; events trigger a sync at once."),
]
ZenohConnect = Annotated[
    str | None,
    typer.Option(
        "--zenoh",
        envvar="FLEETMAP_ZENOH_CONNECT",
        help="Address of the Zenoh router [default: as announced by the server].",
    ),
]
ZenohPrefix = Annotated[
    str | None,
    typer.Option(
        "--zenoh-prefix",
        envvar="FLEETMAP_ZENOH_PREFIX",
        help="Prefix of all Zenoh keys [default: as announced by the server].",
    ),
]
ZenohConfig = Annotated[
    Path | None,
    typer.Option(
        "--zenoh-config",
        envvar="FLEETMAP_ZENOH_CONFIG",
        help="JSON5 file with further Zenoh settings.",
    ),
]
ZenohCa = Annotated[
    Path | None,
    typer.Option(
        "--zenoh-ca",
        envvar="FLEETMAP_ZENOH_CA",
        help="CA certificate of the router, PEM file [default: public authorities].",
    ),
]
ZenohCertificate = Annotated[
    Path | None,
    typer.Option(
        "--zenoh-certificate",
        envvar="FLEETMAP_ZENOH_CERTIFICATE",
        help="Client certificate of the robot, PEM file, if the router requires one.",
    ),
]
ZenohKey = Annotated[
    Path | None, typer.Option("--zenoh-key", envvar="FLEETMAP_ZENOH_KEY", help="Private key of --zenoh-certificate.")
]
ZenohUser = Annotated[
    str | None,
    typer.Option(
        "--zenoh-user", envvar="FLEETMAP_ZENOH_USER", help="User name at the router [default: the robot's name]."
    ),
]
Ca = Annotated[
    Path | None,
    typer.Option(
        "--ca",
        envvar="FLEETMAP_CA",
        help="CA certificate of the server, PEM file [default: public authorities].",
    ),
]
RosPackage = Annotated[
    Path | None,
    typer.Option(
        "--ros-package",
        metavar="DIR",
        callback=_copy_ros_package,
        is_eager=True,
        help="Copy the ROS 2 package fleetmap_ros to this folder (src of a workspace) and exit.",
    ),
]


def agent(
    environment: Environment,
    formats: Formats,
    into: Annotated[
        Path, typer.Option("--into", "-o", help="Directory for the maps; they appear in `current/<format>/`.")
    ],
    optional: OptionalFormats = "",
    channel: Channel = None,
    robot: Robot = None,
    on_change: OnChange = None,
    before_switch: BeforeSwitch = None,
    key: TrustedKey = None,
    poll: Poll = 60.0,
    zenoh_connect: ZenohConnect = None,
    zenoh_prefix: ZenohPrefix = None,
    zenoh_config: ZenohConfig = None,
    zenoh_ca: ZenohCa = None,
    zenoh_certificate: ZenohCertificate = None,
    zenoh_key: ZenohKey = None,
    zenoh_user: ZenohUser = None,
    ca: Ca = None,
    ros_package: RosPackage = None,  # noqa: ARG001  its callback
    once: Annotated[bool, typer.Option("--once", help="Sync once, then exit.")] = False,
    server: options.Server = None,
    token: options.Token = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print a line of JSON for each event.")] = False,
) -> None:
    """Keep a robot's map directory up to date with a channel.

    The agent receives events, fetches changed files, verifies the signature and all hashes, switches `current`
    atomically and reports the robot's status. Without a connection it keeps the installed map. Set the password for the
    Zenoh router with FLEETMAP_ZENOH_PASSWORD.

    Example: `fleetmap agent -e farm -f occupancy_grid,tmap2 -o /srv/maps --channel production --on-change nav2`
    """
    from app.agent.agent import Agent, AgentOptions, robot_name
    from app.agent.requests import parse_formats
    from app.cli.client import DEFAULT_SERVER
    from app.events.credentials import ZenohCredentials

    password = os.environ.get("FLEETMAP_ZENOH_PASSWORD") or None
    agent_options = AgentOptions(
        server=server or DEFAULT_SERVER,
        environment=environment,
        formats=_required_formats(formats),
        optional=parse_formats(optional),
        into=into,
        channel=channel,
        robot=robot_name(robot),
        on_change=tuple(on_change or ()),
        before_switch=tuple(before_switch or ()),
        token=token or None,
        key=key or None,
        poll_seconds=poll,
        zenoh_connect=zenoh_connect or None,
        zenoh_prefix=zenoh_prefix or None,
        zenoh_config=zenoh_config,
        zenoh_login=ZenohCredentials(zenoh_ca, zenoh_certificate, zenoh_key, zenoh_user or None, password),
        ca=ca,
    )
    _run(Agent(agent_options, _logger(as_json=as_json)), once=once)


def _required_formats(text: str) -> tuple[str, ...]:
    from app.agent.requests import parse_formats

    names = parse_formats(text)
    if not names:
        raise Invalid("--formats is empty: list at least one format, such as occupancy_grid,tmap2")
    return names


def _run(agent: Agent, *, once: bool) -> None:
    """Run the agent until it is stopped by a signal, or once."""
    call_at_stop(agent.stop)
    try:
        agent.open()
        if once:
            if not agent.run_once():
                raise typer.Exit(1)
        else:
            agent.run()
    finally:
        agent.close()
    if not once:
        # Skip the interpreter's shutdown: a callback of a Zenoh thread during it would abort the process.
        with contextlib.suppress(OSError):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(0)


def agent_level(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="Directory of the agent (`--into`).")],
    level: Annotated[str, typer.Argument(help="New level of the robot, one of `current/levels.json`.")],
    for_next_map: Annotated[
        bool, typer.Option("--next", help="Store that the robot's level has this name in the next map; load nothing.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print a line of JSON for each event.")] = False,
) -> None:
    """Load another level of the robot's map, for example after a ride in a lift.

    Runs the agent's `--on-change` commands for that level and stores the level for later maps. Run it as the user of
    the agent. The agent may be running.

    Example: `fleetmap agent-level /srv/maps L2`
    """
    from app.agent.activation import hook_variables
    from app.agent.levels import load_level

    load_level(directory, level, hook_variables, _logger(as_json=as_json), for_next_map=for_next_map)


def _logger(*, as_json: bool) -> Callable[..., None]:
    """Return a function that prints one line for each event."""

    def log(event: str, **members: Any) -> None:
        # A full disk or a closed pipe (rich would exit) must not stop the agent.
        with contextlib.suppress(OSError, SystemExit, UnicodeError):
            print_line(event, members)

    def print_line(event: str, members: dict[str, Any]) -> None:
        if as_json:
            time = datetime.now(timezone.utc).isoformat(timespec="milliseconds").replace("+00:00", "Z")
            line = json.dumps({"time": time, "event": event, **members}, ensure_ascii=False)
            sys.stdout.write(line.encode("utf-8", "replace").decode() + "\n")
            sys.stdout.flush()
        else:
            style = "red" if event in ("failed", "refused", "damaged") else None
            output.print_status(f"{event}: {_line(members)}".encode("utf-8", "replace").decode(), style=style)

    return log


def _line(members: dict[str, Any]) -> str:
    """Format the members of an event as text: short hashes, the detail last."""
    words = []
    for name, value in members.items():
        if value in (None, "") or name == "detail":
            continue
        words.append(f"{name} {value[:8] if name == 'root' else value}")
    head = ", ".join(words)
    detail = str(members.get("detail") or "")
    return f"{head}: {detail}" if head and detail else head or detail
