"""Download of the files of a manifest that are not on disk yet."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from urllib.parse import quote, urlencode

from app.agent.http_client import ServerClient
from app.agent.map_directory import MapDirectory
from app.agent.requests import FormatRequest
from app.agent.signed_manifest import Manifest, ManifestFile


class Downloads:
    """Downloads into a map directory."""

    def __init__(self, folder: MapDirectory, web: ServerClient, requests: Sequence[FormatRequest]) -> None:
        self._folder, self._web = folder, web
        self._parameters = {request.name: request.parameters for request in requests}

    def fetch(
        self,
        manifest: Manifest,
        installed: Manifest | None,
        keep: Sequence[ManifestFile],
        begin: Callable[[], object] = lambda: None,
    ) -> dict[str, Path]:
        """Fetch missing files. Return path -> verified local copy.

        Args:
            begin: called before the first download.
            installed: manifest of the current version, whose files serve as dictionaries for deltas.
            keep: fetched files of a planned version; removed only if disk space is short.
        """
        index = self._folder.index()
        old = {file.path: file for file in installed.files} if installed else {}
        sources: dict[str, Path] = {}
        missing = []
        for file in manifest.files:
            local_copy = self._folder.find_local_copy(file, index)
            if local_copy is None:
                missing.append(file)
            else:
                sources[file.path] = local_copy
        if missing:
            begin()
        self._folder.make_room(manifest, sources, keep)
        for file in missing:
            ready = self._folder.is_complete(file)
            if not ready.exists():  # two names can have the same bytes
                self._web.fetch(
                    manifest.environment,
                    manifest.version,
                    file,
                    ready,
                    self._folder.delta_base(file, old),
                    query=self._query(file, manifest),
                    overlays=manifest.overlays_digest,
                )
            sources[file.path] = ready
        return sources

    def _query(self, file: ManifestFile, manifest: Manifest) -> str:
        """Return the query string of a file: the parameters of its format and ``closures``."""
        parameters = dict(self._parameters.get(file.format, ()))
        if manifest.overlays_digest is not None:
            parameters.setdefault("closures", "apply")
        return urlencode(parameters, quote_via=quote)

    def has_all(self, manifest: Manifest) -> bool:
        """Whether every file of a manifest is on the disk."""
        index = self._folder.index()
        return all(self._folder.find_local_copy(file, index) is not None for file in manifest.files)
