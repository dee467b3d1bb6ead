"""Fetch signed manifests, verify them and compare them with those accepted before."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime, timezone
from typing import Any

from app.agent import signatures, signed_manifest
from app.agent.freshness import Freshness, SignedClock
from app.agent.http_client import ClosuresChanged, ServerClient
from app.agent.map_directory import MapDirectory
from app.agent.options import AgentOptions
from app.agent.requests import FormatRequest, encode_entries
from app.agent.signatures import Trust
from app.agent.signed_manifest import Manifest
from app.agent.state import Mark, StateStore
from app.errors import FleetMapError, Unavailable, Untrusted


class Manifests:
    """Manifests of one environment. Not thread-safe."""

    def __init__(
        self,
        options: AgentOptions,
        requests: Sequence[FormatRequest],
        web: ServerClient,
        folder: MapDirectory,
        store: StateStore,
        *,
        clock: SignedClock,
        freshness: Freshness,
        log: Callable[..., None],
    ) -> None:
        self._options, self._web, self._folder, self._store = options, web, folder, store
        self._clock, self._freshness, self._log = clock, freshness, log
        count = len(options.formats)
        self._required = [request.name for request in requests[:count]]
        self._optional = [request.name for request in requests[count:]]
        self._parameters = {request.name: dict(request.parameters) for request in requests if request.parameters}
        self._query = f"formats={encode_entries(requests[:count])}"
        if options.optional:
            self._query += f"&optional={encode_entries(requests[count:])}"
        self._latest: tuple[str, str | None, Manifest] | None = None
        self._mirror_keys: Sequence[Mapping[str, Any]] = ()

    def fetch_latest(self, channel: str, accept: Callable[[Manifest], bool] = lambda _: True) -> Manifest | None:
        """Fetch the channel's manifest; None if it has not changed or ``accept`` returns False.

        Raises:
            Untrusted: the manifest must not be used.
        """
        request_key = f"{channel}?{self._query}"
        state, now = self._store.value, self._clock.now()
        mark = state.marks.get(channel)
        installed = self._folder.manifest(self._folder.current_version)
        etag, cached = None, None
        if state.asked == request_key and state.expires > now and installed is not None and installed.mark == mark:
            etag = state.etag  # only then: 304 must mean that this map is installed
        elif self._latest is not None and self._latest[0] == request_key:
            _, latest_etag, manifest = self._latest
            if manifest.mark == mark and manifest.expires.timestamp() > now:
                etag, cached = latest_etag, manifest
        response = self._web.manifest(self._options.environment, channel, self._query, etag)
        self._freshness.note_response()
        if response is None:
            return cached if cached is not None and accept(cached) else None
        manifest, trust = self._verify(response[0], response[1], channel, mark)
        key = trust.root
        if self._clock.is_plausible(manifest):
            self._freshness.observe(manifest, self._clock.local)
        if not accept(manifest):
            return None
        if state.key is not None and state.key != key:  # an endorsed new key: positions of the old one do not count
            state = dataclasses.replace(state, marks={})
            self._clock.floor = 0.0
        self._clock.observe(manifest)
        if state.key != key:
            self._log("trusting", key=signatures.key_id(key), detail="rotated" if state.key else "first contact")
        state = dataclasses.replace(state, key=key, newest_time=self._clock.floor)
        self._store.save(state.with_mark(channel, manifest.mark))
        self._latest = (request_key, response[2], manifest)
        return manifest

    def fetch_planned(self, version: int) -> Manifest:
        """Fetch the manifest of a version that a channel is planned to move to. Raises Untrusted."""
        closures = "&closures=apply" if self.has_closures else ""
        response = self._web.manifest(self._options.environment, str(version), self._query + closures)
        if (
            response is not None
            and not closures
            and signed_manifest.parse(response[0], response[1]).overlays_digest is not None
        ):
            response = self._web.manifest(self._options.environment, str(version), f"{self._query}&closures=apply")
        if response is None:
            raise Unavailable(f"the server did not return the manifest of version {version}")
        manifest, _ = self._verify(response[0], response[1], None, None)
        if manifest.version != version:
            raise Untrusted(f"the server returned the manifest of version {manifest.version} instead of {version}")
        return manifest

    def check_refreshed(self, manifest: Manifest, current: Manifest) -> None:
        """Check that a manifest is the current version's, with the closures of the channel's newest manifest.

        It has no sequence of its own that could show a replay. Closures are those of the environment, whatever the
        version. Raises Untrusted, ClosuresChanged.
        """
        if manifest.root != current.root:
            raise Untrusted(f"version {manifest.version} has root {manifest.root[:8]} instead of {current.root[:8]}")
        got, newest = manifest.overlays_digest or "none", self.overlays_digest or "none"
        if got != newest:
            raise ClosuresChanged(
                f"the server returned closures {got[:8]} instead of {newest[:8]}, those of the channel's newest "
                "manifest: they have just changed, or an old manifest was replayed"
            )

    def note_installed(self, manifest: Manifest) -> None:
        """Store the ETag of the installed manifest."""
        request_key, etag, latest = self._latest or ("", None, None)
        if latest is not None and latest.data == manifest.data:
            self._store.set(etag=etag, asked=request_key, expires=manifest.expires.timestamp())

    @property
    def closures_key(self) -> str:
        """Digest of the closures in the newest manifest, empty if there are none."""
        return self._latest[2].closures_key if self._latest else ""

    @property
    def overlays_digest(self) -> str | None:
        """Digest of the closures of the newest manifest; None without a manifest or if the server applies none."""
        return self._latest[2].overlays_digest if self._latest else None

    @property
    def has_closures(self) -> bool:
        """Whether the server applies closures, according to the newest manifest."""
        manifest = self._latest[2] if self._latest else self._folder.manifest(self._folder.current_version)
        return manifest is not None and manifest.overlays_digest is not None

    def missing_remark(self, manifest: Manifest) -> str | None:
        """Return a remark about missing optional formats with their reasons; None if none is missing."""
        present = {file.format for file in manifest.files}
        lacking = [name for name in self._optional if name not in present]
        reasons = [f"{name} ({manifest.missing[name]})" if name in manifest.missing else name for name in lacking]
        return f"missing optional formats: {', '.join(reasons)}" if reasons else None

    @staticmethod
    def variables_remark(manifest: Manifest) -> str | None:
        """Return a remark about variables of the map that the robot does not set; None if there are none."""
        names = ", ".join(manifest.variables_left_out)
        return f"environment.sh lacks variables that no map may set: {names[:300]}" if names else None

    def _verify(self, data: bytes, signature: str, channel: str | None, mark: Mark | None) -> tuple[Manifest, Trust]:
        """Verify a manifest; return it, and why it is trusted. Raises Untrusted."""
        state = self._store.value
        trust = self._trust(data, signature)
        key = trust.root
        manifest = signed_manifest.parse(data, signature)
        if trust.until is not None:
            manifest = dataclasses.replace(manifest, expires=min(manifest.expires, trust.until))
        signed_manifest.check_manifest(
            manifest,
            environment=self._options.environment,
            channel=channel,
            formats=self._required,
            optional=self._optional,
            parameters=self._parameters,
            mark=mark if state.key in (None, key) else None,
            # Positions and times that an old key signed do not apply to a new key.
            now=datetime.fromtimestamp(
                self._clock.now() if state.key in (None, key) else self._clock.local, timezone.utc
            ),
        )
        return manifest, trust

    def _trust(self, data: bytes, signature: str) -> Trust:
        """Verify a signature with the server's keys, of a mirror also with its centre's. Raises Untrusted."""
        state, environment = self._store.value, self._options.environment
        now = datetime.fromtimestamp(self._clock.now(), timezone.utc)

        def verify(keys: Callable[[], Sequence[Mapping[str, Any]]]) -> Trust:
            return signatures.verify_manifest(
                data, signature, state.key, state.given, keys, environment=environment, now=now
            )

        if self._mirror_keys:
            with contextlib.suppress(Untrusted):
                return verify(lambda: self._mirror_keys)
        try:
            return verify(self._web.keys)
        except signatures.Unendorsed as error:
            try:
                lines = self._web.keys(environment)
            except FleetMapError:
                raise error from None
            try:
                trust = verify(lambda: lines)
            except signatures.Unendorsed:  # a permission that has ended
                raise
            except Untrusted:
                raise error from None
            self._mirror_keys = lines
            return trust
