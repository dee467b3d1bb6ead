"""The loop: hear or poll, verify, fetch what differs, switch, run the hooks, tell."""

from __future__ import annotations

import base64
import dataclasses
import errno
import random
import re
import socket
import threading
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from app.agent import hooks, trust
from app.agent.ear import Ear
from app.agent.folder import Folder
from app.agent.state import State, load, save, write_whole
from app.agent.trust import File, Manifest
from app.agent.web import Busy, Stopped, Web
from app.errors import FleetMapError, Invalid, NotFound, Unavailable, Untrusted
from app.events import messages
from app.events.login import Login
from app.events.messages import RobotState, RobotStatus

LATEST = "latest"
PRODUCTION = "production"
POLL_SECONDS = 60.0
FIRST_PAUSE_SECONDS = 1.0
"""After the first failure; doubled each time up to the pause between polls."""

GATHER_SECONDS = 0.02
"""Events that come together are one look at the server. Doubled for each look that brought nothing, up to 5 seconds: on
an open router anybody can put events.
"""

MAX_DOUBLINGS = 8
LAYERS = ("imagery", "location", "objects", "occupancy", "topology", "voxels", "zones")
"""What may have changed, where the server is too old to tell."""

ROUTER = re.compile(r"(tcp|tls|quic|udp|ws|wss)/[A-Za-z0-9_.:%\[\]-]+")
"""A router as a server may tell it: no device, no local socket, nothing (``#…``) that would weaken the robot's TLS."""

MAX_VARIABLE_BYTES = 100_000

LONG_SECONDS = 5.0
"""After a longer download the channel is looked at again before the switch."""

REJOIN_SECONDS = 1.0
"""A fleet that finds its router again does not ask in the same moment: up to so long."""

CONFIRM_SECONDS = 60.0
"""What was said over Zenoh is said over HTTP as well within so long, where it still holds then: on the bus nobody
confirms that he heard it. A fleet that changes at once does so spread over this time.
"""

FIRST_CONFIRM_SECONDS = 2.0
"""The same for the first status after the start."""

AGAIN_SECONDS = 30.0
"""A robot without Zenoh repeats its status with the first sync after so long."""

NO_ROOT = "0" * 64

Tell = Callable[..., None]
"""tell(what, **members): one line of what happens."""


@dataclass(frozen=True, slots=True)
class Options:
    """How to run. channel: None follows production where there is one, else latest. key: to trust at first contact.

    zenoh_login: at the router; a password without a user is the robot's. ca: who signs the server's certificate.
    """

    server: str
    environment: str
    formats: tuple[str, ...]
    into: Path
    channel: str | None = None
    robot: str = ""
    on_change: tuple[str, ...] = ()
    token: str | None = None
    key: str | None = None
    poll_seconds: float = POLL_SECONDS
    zenoh_connect: str | None = None
    zenoh_prefix: str | None = None
    zenoh_config: Path | None = None
    zenoh_login: Login = field(default_factory=Login)
    ca: Path | None = None


def robot_name(text: str | None = None) -> str:
    """A robot's name as it may be part of a key; the host's where none is given. Invalid."""
    name = text or re.sub(r"[^A-Za-z0-9_.-]", "-", socket.gethostname()).lstrip("_.-") or "robot"
    if not messages.ROBOT_NAME.fullmatch(name):
        raise Invalid(f"a robot's name is of letters, digits, dots, - and _, got {name!r}")
    return name


class Agent:
    """One environment's map in one folder. clock: seconds since 1970; it may be a minute off."""

    def __init__(self, options: Options, tell: Tell, clock: Callable[[], float] = time.time) -> None:
        if options.key is not None:
            options = dataclasses.replace(options, key=trust.check_given(options.key))
        self.options, self._tell, self._clock = options, tell, clock
        self._robot = robot_name(options.robot)
        self._login = options.zenoh_login
        if self._login.password is not None and self._login.user is None:
            self._login = dataclasses.replace(self._login, user=self._robot)
        self._login.values()  # Invalid comes now, not in the session's thread
        self._stopping = threading.Event()
        self._wake = threading.Event()
        self._folder = Folder(options.into)
        self._web = Web(options.server, options.token, self._stopping, options.ca)
        self._ear: Ear | None = None
        self._state = State(options.environment)
        self._said: RobotStatus | None = None
        self._put: RobotStatus | None = None
        self._put_at = 0.0
        self._on_bus: RobotStatus | None = None
        self._confirm_at: float | None = None
        self._confirmed = False
        self._target: tuple[int, str] | None = None
        self._activated: tuple[str | None, tuple[int, str] | None] | None = None
        self._told: set[str] = set()
        self._preloaded: tuple[int, str, tuple[File, ...]] | None = None
        self._rejoined = False
        self._in_vain = 0
        self._called = 0
        self._behind = 0

    # --- outside ---

    def open(self) -> None:
        """Take the folder and look at what is in it. Raises Conflict or Invalid where it is not ours."""
        self._folder.open()
        self._state = load(self._folder.state, self.options.environment)
        given = self.options.key
        if given is not None and given != self._state.given:
            if self._state.key is not None and given not in (trust.key_id(self._state.key), _text(self._state.key)):
                self._tell("trusting", key=given, detail="the key that was pinned before is forgotten")
                self._state = dataclasses.replace(self._state, key=None)
            self._state = dataclasses.replace(self._state, given=given)
        installed = self._folder.manifest(self._folder.standing)
        name = self._folder.standing
        if installed is not None and name is not None and (bad := self._folder.damaged(name, installed)):
            self._tell("damaged", version=installed.version, files=bad[:20])
            self._state = dataclasses.replace(self._state, etag=None)
        if installed is not None and name is not None:
            self._folder.refresh(name, installed)

    def close(self) -> None:
        """Let go of everything."""
        if self._ear is not None:
            self._ear.close()
        self._web.close()
        self._folder.close()

    def stop(self) -> None:
        """End soon; may be called from a signal's handler or another thread."""
        self._stopping.set()
        self._wake.set()
        self._web.interrupt()

    def once(self) -> bool:
        """One sync: whether the folder now holds the channel's map and all hooks were content."""
        try:
            return self._sync_and_tell()
        except Stopped:
            return False

    def run(self) -> None:
        """Keep the folder until ``stop``."""
        self._ear = Ear(
            self.options.environment,
            self._robot,
            heard=self._heard,
            back=self._back,
            lost=self._lost,
            config=self.options.zenoh_config,
            login=self._login,
        )
        if self._login.user not in (None, self._robot):
            reason = (
                f"a fleet map server's router lets the user {self._login.user} be seen as the robot of that name alone"
            )
            self._tell("user", detail=f"{reason}: use --robot {self._login.user}, or its own user")
        if (installed := self._folder.manifest(self._folder.standing)) is not None:
            self._tell("holding", version=installed.version, root=installed.root)
        failures = 0
        woken = False
        while not self._stopping.is_set():
            self._wake.clear()
            before = (self._state.marks, self._said)
            pause = self.options.poll_seconds
            try:
                if not woken or not self._ear.connected:
                    self._find_router()
                good = self._sync_and_tell()
                failures = 0 if good else failures + 1
                # A server of several hosts may know for a moment less than its events say: look again, ever later.
                self._behind = self._behind + 1 if good and self._mark < self._called else 0
                vain = woken and before == (self._state.marks, self._said)
                self._in_vain = self._in_vain + 1 if vain else 0
            except Stopped:
                break
            if failures or self._behind:
                pause = min(pause, FIRST_PAUSE_SECONDS * 2 ** min(20, max(failures, self._behind) - 1))
            woken = self._rest(max(self._after, pause * random.uniform(0.5, 1.5)))  # noqa: S311  jitter is no secret

    # --- what wakes it ---

    def _rest(self, seconds: float) -> bool:
        """Until something happens, at most so long: whether it did. What is to be confirmed is confirmed meanwhile."""
        end = time.monotonic() + seconds
        while True:
            now = time.monotonic()
            until = end if self._confirm_at is None else min(end, self._confirm_at)
            woken = self._wait(max(0.0, until - now))
            if woken or self._stopping.is_set() or time.monotonic() >= end:
                return woken
            try:
                self._send_status()
            except Stopped:
                return False

    def _wait(self, seconds: float) -> bool:
        """Until something happens, at most so long: whether an event or the router was it."""
        woken = self._wake.wait(seconds)
        if woken and not self._stopping.is_set():
            rejoined, self._rejoined = self._rejoined, False
            most = REJOIN_SECONDS * random.random() if rejoined else self._gather  # noqa: S311
            self._stopping.wait(most)
        return woken

    @property
    def _gather(self) -> float:
        return GATHER_SECONDS * 2.0 ** min(MAX_DOUBLINGS, self._in_vain)

    def _heard(self, event: messages.Event) -> None:
        """In a thread of Zenoh's: wake the loop if it is of our concern."""
        if event.environment != self.options.environment or not isinstance(event.channel, str | None):
            return
        channel = self._state.channel
        if event.sequence <= self._mark:
            return
        ours = {self.options.channel} if self.options.channel else {PRODUCTION, channel}
        if event.type == "version.created":
            concerns = channel in (LATEST, None)
        elif event.type.startswith("overlay."):
            concerns = False  # what is accepted of them comes as a version
        else:
            concerns = event.channel in ours or event.type.startswith("environment.")
        if concerns:
            if event.type == "channel.moved" or (event.type == "version.created" and channel == LATEST):
                self._called = event.sequence  # so far the channel that is followed has moved
            self._wake.set()

    @property
    def _mark(self) -> int:
        """The sequence that the channel is known to have reached."""
        return self._state.marks.get(self._state.channel or "", (-1, ""))[0]

    def _back(self) -> None:
        self._tell("connected", detail="listening for events over Zenoh")
        self._rejoined = True
        self._put = self._on_bus = None  # who was away may not know how we are
        self._wake.set()

    def _lost(self, problem: str) -> None:
        self._tell(
            "polling", detail=f"{problem}; changes are noticed within {self.options.poll_seconds:g} seconds or so"
        )

    def _find_router(self) -> None:
        if self._ear is None:
            return
        connect, prefix = self.options.zenoh_connect, self.options.zenoh_prefix
        if connect is None or prefix is None:
            try:
                found = self._web.readyz().get("events", {})
                told = found.get("connect")
                connect = connect or (str(told) if told else None)
                prefix = prefix or str(found.get("prefix") or messages.PREFIX)
            except (FleetMapError, AttributeError):
                if connect is None or self._ear.aimed:
                    return
                prefix = prefix or messages.PREFIX
        if connect is None:
            self._tell_once("polling", detail="the server tells no router: FLEETMAP_ZENOH_CONNECT can name one")
            return
        told = self.options.zenoh_connect is None
        if told and not all(ROUTER.fullmatch(part.strip()) for part in connect.split(",")):
            detail = f"the server tells a router by what is no plain address ({connect[:300]}): FLEETMAP_ZENOH_CONNECT"
            self._tell_once("polling", detail=f"{detail} can name it")
            return
        self._ear.aim(connect, prefix)

    # --- one sync ---

    def _sync_and_tell(self) -> bool:
        self._after = 0.0
        self._target = None
        try:
            good = self._sync()
        except FleetMapError as error:
            if isinstance(error, Busy):
                self._after = error.seconds
            self._fail("refused" if isinstance(error, Untrusted) else "failed", error.detail)
            good = False
        except OSError as error:
            self._fail("failed", f"{error.filename or self._folder.path}: {error.strerror or error}")
            good = False
        except Stopped:
            raise
        except Exception as error:  # noqa: BLE001  a mistake of ours; who ends here is of no use to a robot
            where = traceback.extract_tb(error.__traceback__)[-1]
            place = f"{Path(where.filename).name}:{where.lineno}"
            self._fail("failed", f"the agent made a mistake ({type(error).__name__} at {place}): {error}")
            good = False
        self._send_status()
        return good

    _after = 0.0

    def _sync(self) -> bool:
        self._keep(self._state)
        plans = self._plans()
        channel = self._channel(plans)
        manifest = self._manifest(channel)
        if manifest is not None:
            self._install(manifest)
        self._target = None
        good = self._run_hooks()
        if good:
            planned = next((p for p in plans or () if p.get("channel") == channel), {}).get("planned")
            standing = (self._folder.standing, self._state.marks.get(channel))
            if planned is None or self._activated != standing:
                self._say("active")
                self._activated = standing
            if plans is not None:
                self._preload(planned)
        return good

    def _plans(self) -> list[Mapping[str, Any]] | None:
        try:
            return self._web.channels(self.options.environment)
        except (NotFound, Invalid) as error:
            if self.options.channel is None and PRODUCTION not in self._state.marks:
                raise  # which channel to follow is not known then
            self._tell_once("channels", detail=error.detail)
            return None

    def _channel(self, plans: Sequence[Mapping[str, Any]] | None) -> str:
        """Which channel to follow. One that was followed by default stays so, also where the server says it is gone."""
        if self.options.channel is not None:
            return self.options.channel
        stands = any(p.get("channel") == PRODUCTION and p.get("version") is not None for p in plans or ())
        if stands or PRODUCTION in self._state.marks:
            return PRODUCTION
        self._tell_once("following", channel=LATEST, detail="no channel production stands on a version yet")
        return LATEST

    def _manifest(self, channel: str, wanted: Callable[[Manifest], bool] = lambda _: True) -> Manifest | None:
        """The channel's manifest, believed; None where the installed one is still it, or it is not wanted."""
        asked = f"{channel}?{','.join(self.options.formats)}"
        state = self._state
        current = state.asked == asked and state.etag is not None and state.expires > self._clock()
        installed = self._folder.manifest(self._folder.standing)
        newest = installed is not None and (installed.sequence, installed.root) == state.marks.get(channel)
        fits = current and newest  # else "not modified" would be said of a map that does not stand
        found = self._web.manifest(
            self.options.environment, channel, self.options.formats, state.etag if fits else None
        )
        if found is None:
            return None
        manifest, key = self._believe(found[0], found[1], channel, state.marks.get(channel))
        if not wanted(manifest):
            return None
        new = dataclasses.replace(state, key=key).marked(channel, manifest.sequence, manifest.root)
        if state.key != key:
            self._tell("trusting", key=trust.key_id(key), detail="rotated" if state.key else "first contact")
        self._keep(new)
        self._etag = (asked, found[2], manifest.expires.timestamp())
        return manifest

    _etag: tuple[str, str | None, float] = ("", None, 0.0)

    def _believe(
        self, data: bytes, signature: str, channel: str | None, mark: tuple[int, str] | None
    ) -> tuple[Manifest, bytes]:
        key = trust.signer(data, signature, self._state.key, self._state.given, self._web.keys)
        manifest = trust.parse(data, signature)
        trust.check(
            manifest,
            environment=self.options.environment,
            channel=channel,
            formats=self.options.formats,
            mark=mark,
            now=datetime.fromtimestamp(self._clock(), timezone.utc),
        )
        return manifest, key

    def _install(self, manifest: Manifest) -> None:
        """Fetch what is not here, build the version, switch to it."""
        name = self._folder.standing
        installed = self._folder.manifest(name)
        bad = self._folder.damaged(name, installed) if name is not None and installed is not None else []
        if bad and installed is not None:
            self._tell("damaged", version=installed.version, files=bad[:20])
        whole = installed is not None and not bad
        if not (whole and installed and (installed.content, installed.root) == (manifest.content, manifest.root)):
            received, deltas, begun = self._web.received, self._web.deltas, time.monotonic()
            self._target = (manifest.version, manifest.root)
            self._say("downloading")
            sources = self._fetch(manifest, installed)
            if (newer := self._overtaken(manifest, time.monotonic() - begun)) is not None:
                self._install(newer)
                return
            name = self._folder.build(manifest, sources)
            self._folder.switch(name)
            self._tell(
                "switched",
                version=manifest.version,
                root=manifest.root,
                channel=manifest.channel,
                sequence=manifest.sequence,
                files=len(_changed(installed, manifest)),
                bytes=self._web.received - received,
                deltas=self._web.deltas - deltas,
                seconds=round(time.monotonic() - begun, 3),
            )
        elif installed.data != manifest.data and name is not None:
            self._folder.describe(name, manifest)  # the same files: a newer sequence or a later expiry
        asked, etag, expires = self._etag
        self._keep(dataclasses.replace(self._state, etag=etag, asked=asked, expires=expires))
        self._folder.tidy(self._preloaded[2] if self._preloaded else ())

    def _overtaken(self, manifest: Manifest, seconds: float) -> Manifest | None:
        """The channel's newer manifest, where it moved on while this map was fetched, to one that is here already: what
        was taken back meanwhile is not put in place. Where the newer one is still to be fetched it has its turn.
        """
        if manifest.channel is None or (self._called <= manifest.sequence and seconds < LONG_SECONDS):
            return None
        index = self._folder.index()

        def here(newer: Manifest) -> bool:
            if newer.sequence == manifest.sequence:
                return False
            self._wake.set()
            return all(self._folder.known(file, index) is not None for file in newer.files)

        try:
            return self._manifest(manifest.channel, here)
        except FleetMapError:
            return None  # the next look tells of it

    def _fetch(self, manifest: Manifest, installed: Manifest | None) -> dict[str, Path]:
        index = self._folder.index()
        old = {file.path: file for file in installed.files} if installed else {}
        sources: dict[str, Path] = {}
        wanted = []
        for file in manifest.files:
            there = self._folder.known(file, index)
            if there is None:
                wanted.append(file)
            else:
                sources[file.path] = there
        self._folder.make_room(manifest, sources, self._preloaded[2] if self._preloaded else ())
        for file in wanted:
            ready = self._folder.ready(file)
            if not ready.exists():  # two names can have the same bytes
                before = self._folder.before(file, old)
                self._web.fetch(manifest.environment, manifest.version, file, ready, before)
            sources[file.path] = ready
        return sources

    def _preload(self, planned: Any) -> None:
        """Fetch what a channel is planned to move to, so that the switch itself takes no time."""
        version = planned.get("version") if isinstance(planned, dict) else None
        if type(version) is not int:
            if self._preloaded is not None:
                self._preloaded = None
                self._folder.tidy()
            return
        if self._preloaded is not None and self._preloaded[0] == version:
            self._target = self._preloaded[:2]
            self._say("ready")
            return
        found = self._web.manifest(self.options.environment, str(version), self.options.formats)
        if found is None:
            return
        manifest, _ = self._believe(found[0], found[1], None, None)
        if manifest.version != version:
            raise Untrusted(f"the manifest is of version {manifest.version}, and {version} was asked for")
        self._target = (manifest.version, manifest.root)
        self._fetch(manifest, self._folder.manifest(self._folder.standing))
        self._preloaded = (manifest.version, manifest.root, manifest.files)
        self._say("ready")

    # --- hooks ---

    def _run_hooks(self) -> bool:
        """Run what is to be run for the version that stands and was not yet: whether all were content."""
        name = self._folder.standing
        manifest = self._folder.manifest(name)
        if name is None or manifest is None or self._state.activated == name:
            return True
        before = self._folder.manifest(self._state.activated)
        if self.options.on_change:  # cut off in the middle, or taken back: what the robot has taken is not known
            self._keep(dataclasses.replace(self._state, activated=None))
        variables = {
            "FLEETMAP_ENVIRONMENT": manifest.environment,
            "FLEETMAP_VERSION": str(manifest.version),
            "FLEETMAP_ROOT": manifest.root,
            "FLEETMAP_CHANNEL": manifest.channel or "",
            "FLEETMAP_SEQUENCE": str(manifest.sequence),
            "FLEETMAP_CURRENT": str(self._folder.current),
            **self._changes(_changed(before, manifest)),
            "FLEETMAP_LAYERS": " ".join(_changed_layers(before, manifest)),
            "FLEETMAP_ROBOT": self._robot,
        }
        for command in self.options.on_change:
            problem = hooks.run(command, variables, stopping=self._stopping)
            if problem is not None:
                if self._stopping.is_set():
                    raise Stopped
                self._fail(
                    "failed", f"version {manifest.version} is in place, but its robot has not taken it: {problem}"
                )
                return False
            self._tell("hook", command=command, version=manifest.version)
        self._keep(dataclasses.replace(self._state, activated=name))
        return True

    def _changes(self, paths: Sequence[str]) -> dict[str, str]:
        """The variables that list changed files. A variable's size is limited (128 KiB on Linux): what does not fit is
        left out from the deepest folders up, and stands in the file with the rest.
        """
        where = self._folder.path / "changed"
        write_whole(where, "".join(f"{path}\n" for path in paths).encode())
        room, fit = MAX_VARIABLE_BYTES, set()
        for path in sorted(paths, key=lambda p: (p.count("/"), p)):
            room -= len(path.encode()) + 1
            if room < 0:
                break
            fit.add(path)
        return {"FLEETMAP_CHANGED": "\n".join(p for p in paths if p in fit), "FLEETMAP_CHANGED_FILE": str(where)}

    # --- what is told ---

    def _keep(self, state: State) -> None:
        """On the disk, too. What could not be written is tried again, before anything else is done."""
        if state != self._state:
            self._state, self._unsaved = state, True
        if self._unsaved:
            try:
                save(self._folder.state, state)
            except OSError as error:
                if error.errno not in (errno.ENOSPC, errno.EDQUOT):
                    raise
                self._folder.spare()
                save(self._folder.state, state)
            self._unsaved = False

    _unsaved = False

    def _say(self, state: RobotState, detail: str | None = None) -> None:
        """Note the status and send it. version and root: of what it is about: what stands, unless another
        is being fetched or lies ready.
        """
        manifest = self._folder.manifest(self._folder.standing)
        version, root = (manifest.version, manifest.root) if manifest else (0, NO_ROOT)
        if self._target is not None:
            version, root = self._target
        channel = self._state.channel or self.options.channel or LATEST
        sequence = manifest.sequence if manifest else None
        moment = datetime.fromtimestamp(self._clock(), timezone.utc)
        now = moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")
        detail = detail[: messages.MAX_DETAIL] if detail else None
        status = RobotStatus(channel, version, root, state, detail, now, sequence, holds=self._loaded(manifest))
        if _same(status, self._said):
            return
        self._said = status
        if detail is None:
            self._tell(state, version=version, root=root, channel=channel)
        self._send_status()

    def _loaded(self, standing: Manifest | None) -> tuple[int, str] | None:
        """Version and root that ``current`` points to, if the hooks have loaded it; None while they have not."""
        if standing is None:
            return 0, NO_ROOT
        return (standing.version, standing.root) if self._state.activated == self._folder.standing else None

    def _fail(self, what: str, detail: str) -> None:
        self._tell(what, detail=detail)
        self._say("failed", detail=detail)

    def _send_status(self) -> None:
        """Over Zenoh at once and over HTTP a little later, or over HTTP at once where nobody is on the bus; once for
        each change. What could not be sent is sent later.

        A robot that is not on the bus says it again now and then: only so does the server know that it is there.
        """
        status, now = self._said, time.monotonic()
        if status is None or self._stopping.is_set():
            return
        on_bus = self._ear is not None and self._ear.connected
        stale = not on_bus and now - self._put_at > AGAIN_SECONDS
        if _same(status, self._put) and not stale:
            self._confirm_at = None
            return
        if on_bus and self._ear is not None:
            if not _same(status, self._on_bus) and self._ear.put_status(status):
                self._on_bus = status
            if _same(status, self._on_bus):
                if self._confirm_at is None:
                    # A robot counts in roll-outs only once it has reported with its token.
                    share = random.uniform(0.25, 1.0)  # noqa: S311
                    self._confirm_at = now + share * (CONFIRM_SECONDS if self._confirmed else FIRST_CONFIRM_SECONDS)
                if now < self._confirm_at:
                    return
        self._confirm_at = now + CONFIRM_SECONDS  # where this try fails
        try:
            self._web.put_status(self._robot, {"environment": self.options.environment, **status.as_dict()})
        except Unavailable:
            return
        except FleetMapError as error:
            self._tell_once("status", detail=f"the server does not take the robot's status: {error.detail}")
        self._put, self._put_at, self._confirm_at, self._confirmed = status, now, None, True

    def _tell_once(self, what: str, **members: Any) -> None:
        if what not in self._told:
            self._told.add(what)
            self._tell(what, **members)


def _same(one: RobotStatus, other: RobotStatus | None) -> bool:
    return other is not None and dataclasses.replace(one, time=None) == dataclasses.replace(other, time=None)


def _changed(old: Manifest | None, new: Manifest) -> list[str]:
    """Paths of files that are new, gone or other."""
    before, after = old.content if old else {}, new.content
    return sorted(path for path in {*before, *after} if before.get(path) != after.get(path))


def _changed_layers(old: Manifest | None, new: Manifest) -> list[str]:
    """Names of the layers that are new, gone or other."""
    if not new.layers:
        return list(LAYERS)
    before, after = old.layers if old else {}, new.layers
    return sorted(name for name in {*before, *after} if before.get(name) != after.get(name))


def _text(key: bytes) -> str:
    return base64.b64encode(key).decode()
