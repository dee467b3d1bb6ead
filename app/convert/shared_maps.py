"""Maps that servers share: between the cache of a server and the made maps of all."""

from __future__ import annotations

from pathlib import Path

import orjson

from app.convert.cache import CachedFile, CachedMap, ConvertedMap
from app.convert.report import Report
from app.store.made_maps import MadeMaps


class SharedMaps:
    """Made maps of all servers, for ``Cache``."""

    def __init__(self, made: MadeMaps) -> None:
        self._made = made

    def publish(self, key: str, made: CachedMap) -> None:
        """Share a map that this server has made."""
        files = [{"name": f.name, "media_type": f.media_type, "place": f.place} for f in made.files]
        archive = made.archive.name if made.archive else None
        entry = orjson.dumps({"files": files, "archive": archive, "report": made.report.as_dict()})
        contents: list[bytes | Path] = [f.path if f.path is not None else f.data or b"" for f in made.all_files()]
        self._made.publish(key, entry, contents)

    def load(self, key: str) -> ConvertedMap | None:
        """Get a map that any server has made."""
        made = self._made.load(key)
        if made is None:
            return None
        entry = orjson.loads(made.entry)
        files: dict[str, tuple[bytes | CachedFile, str]] = {}
        places: dict[str, tuple[str, str]] = {}
        for described, content in zip(entry["files"], made.contents, strict=False):  # the last may be the archive
            files[described["name"]] = (content, described["media_type"])
            if described["place"] is not None:
                places[described["name"]] = tuple(described["place"])
        archive = (entry["archive"], made.contents[-1]) if entry["archive"] is not None else None
        return ConvertedMap(files, archive, Report.from_dict(entry["report"]), places)

    def find(self, sha256: str, max_bytes: int) -> bytes | None:
        """Return a made file by its hash; None if there is none of at most ``max_bytes``."""
        return self._made.find(sha256, max_bytes)
