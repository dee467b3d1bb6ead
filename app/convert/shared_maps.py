"""Maps that servers share: between the cache of a server and the made maps of all."""

from __future__ import annotations

from pathlib import Path

import orjson

from app.convert.cache import CachedFile, CachedMap, ConvertedMap
from app.convert.report import Report
from app.store.made_maps import MadeMaps


class SharedMaps:
    """Made maps of all servers, for ``Cache``."""

    def __init__(self, maps: MadeMaps) -> None:
        self._maps = maps

    def publish(self, key: str, cached_map: CachedMap) -> None:
        """Share a map that this server has made."""
        files = [{"name": f.name, "media_type": f.media_type, "place": f.place} for f in cached_map.files]
        archive = cached_map.archive.name if cached_map.archive else None
        entry = orjson.dumps({"files": files, "archive": archive, "report": cached_map.report.as_dict()})
        contents: list[bytes | Path] = [f.path if f.path is not None else f.data or b"" for f in cached_map.all_files()]
        self._maps.publish(key, entry, contents)

    def load(self, key: str) -> ConvertedMap | None:
        """Get a map that any server has made."""
        loaded = self._maps.load(key)
        if loaded is None:
            return None
        entry = orjson.loads(loaded.entry)
        files: dict[str, tuple[bytes | CachedFile, str]] = {}
        places: dict[str, tuple[str, str]] = {}
        for described, content in zip(entry["files"], loaded.contents, strict=False):  # the last may be the archive
            files[described["name"]] = (content, described["media_type"])
            if described["place"] is not None:
                places[described["name"]] = tuple(described["place"])
        archive = (entry["archive"], loaded.contents[-1]) if entry["archive"] is not None else None
        return ConvertedMap(files, archive, Report.from_dict(entry["report"]), places)

    def find(self, sha256: str, max_bytes: int) -> bytes | None:
        """Return a made file by its hash; None if there is none of at most ``max_bytes``."""
        return self._maps.find(sha256, max_bytes)
