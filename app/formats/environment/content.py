"""Exact copy of the stored layers in an environment package, beside the maps written from them.

Other formats round, fill in and drop data; so ``fleet_map/content.json`` in a package contains the stored layers, and
the SHA-256 of each map. As long as the maps are unchanged, reading the package restores the same layers; once a map was
edited, added or removed, only the maps are read.

content.json: ``version``; ``maps``, path -> SHA-256; ``datum``; ``levels``, [name, elevation]; ``parts``, each with
``layer``, ``level``, ``name``, ``attribution`` and the fields of its type. Geometry is hexadecimal WKB. An array is
{``file``, ``type``, ``shape``}: little-endian numbers in a separate file; a resource is the name of its file. Paths
are relative to the directory ``config``; a resource that is also one of the maps is not stored twice.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
import orjson
import shapely
from numpy.typing import NDArray

from app.errors import Problem, TooLarge, UnreadableFile
from app.formats import Files
from app.limits import Limits
from app.model.features import Features
from app.model.frame import Datum, Level
from app.model.imagery import LOCAL, GeoImage
from app.model.layers import PART_TYPES, Layers, Part, PartKey, Resources
from app.syntax import geotiff, json

FOLDER = "fleet_map/"
MAIN = f"{FOLDER}content.json"
VERSION = 1

_TYPES = frozenset({"|u1", "|i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f4", "<f8", "|b1"})

_KINDS: Mapping[str, type] = {"properties": dict, "crs": str, "binary": bool, "negate": bool}
"""Types of fields that the layer classes do not check."""


@dataclass(frozen=True, slots=True)
class Content:
    """Content of a package. credits: licences and credits by part. added: files that do not belong to it."""

    layers: Layers
    credits: Mapping[PartKey, tuple[str, ...]]
    added: frozenset[str] = frozenset()


# --- writing ---------------------------------------------------------------------------------------------------------


def pack(layers: Layers, maps: Files, credits: Mapping[PartKey, Sequence[str]]) -> dict[str, bytes]:
    """Write the content's files by path. maps: the files of the package, by path. credits: by part."""
    hashes = {path: hashlib.sha256(data).hexdigest() for path, data in sorted(maps.items())}
    blobs = _Blobs({digest: path for path, digest in reversed(hashes.items())})
    parts = [
        {
            **{"layer": key.layer, "level": key.level, "name": key.name, "attribution": list(credits.get(key, ()))},
            **_encode_part(part, blobs),
        }
        for key, part in sorted(layers.parts.items(), key=lambda item: item[0])
    ]
    content = {
        "version": VERSION,
        "maps": hashes,
        "datum": None if layers.datum is None else layers.datum.as_dict(),
        "levels": [[level.name, level.elevation] for level in layers.levels],
        "parts": parts,
    }
    return {MAIN: orjson.dumps(content), **blobs.files}


@dataclass(slots=True)
class _Blobs:
    """Files of the content, equal ones stored once. paths: existing files by SHA-256."""

    paths: dict[str, str]
    files: dict[str, bytes] = field(default_factory=dict)

    def put(self, data: bytes) -> str:
        digest = hashlib.sha256(data).hexdigest()
        if digest not in self.paths:
            self.paths[digest] = f"{FOLDER}{len(self.files)}.bin"
            self.files[self.paths[digest]] = data
        return self.paths[digest]


def _encode_part(part: Part, blobs: _Blobs) -> dict[str, Any]:
    if isinstance(part, Features):
        columns = {"ids": list(part.ids), "local": part.local.tolist(), "properties": list(part.properties)}
        return {**columns, "geometry": shapely.to_wkb(part.geometry, hex=True).tolist(), "document": part.document}
    if isinstance(part, Resources):
        return {"files": {path: blobs.put(bytes(data)) for path, data in sorted(part.files.items())}}
    values = {f.name: getattr(part, f.name) for f in fields(part)}
    return {name: _array(v, blobs) if isinstance(v, np.ndarray) else v for name, v in values.items()}


def _array(array: NDArray[Any], blobs: _Blobs) -> dict[str, Any]:
    plain = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
    return {"file": blobs.put(plain.tobytes()), "type": plain.dtype.str, "shape": list(plain.shape)}


# --- reading ---------------------------------------------------------------------------------------------------------


def find(files: Files) -> str | None:
    """Find the content file of a package in an upload, or return None."""
    return next((name for name in sorted(files) if f"/{name}".endswith(f"/config/{MAIN}")), None)


def content_files(files: Files, main: str) -> set[str]:
    """Return the names of the content's own files."""
    return {name for name in files if name.startswith(main.removesuffix(MAIN) + FOLDER)}


def read(files: Files, main: str, limits: Limits, unread: Callable[[], Collection[str]]) -> Content | str:
    """Read the content, or return the reason why the maps are read instead.

    Raises various exceptions (KeyError, TypeError, ValueError …) if the content is damaged.

    unread: returns the names of files that no format reads; called if files were added, since such files change no map
    (a README, files of file managers).
    """
    top = json.load(files[main], limits)
    if not isinstance(top, dict) or top.get("version") != VERSION:
        return f"its version is not {VERSION}"
    folder = main.removesuffix(MAIN)
    maps = {f"{folder}{path}": digest for path, digest in top["maps"].items()}
    other_names = files.keys() - content_files(files, main)
    added = frozenset(other_names - maps.keys())
    new_maps = added.difference(unread()) if added else added
    for name in sorted(maps.keys() | new_maps):
        if name not in other_names:
            return f"{name} was removed"
        if name not in maps:
            return f"{name} was added"
        if hashlib.sha256(files[name]).hexdigest() != maps[name]:
            return f"{name} was edited"
    parts: dict[PartKey, Part] = {}
    stated: dict[PartKey, tuple[str, ...]] = {}
    for row in top["parts"]:
        key = PartKey(row.pop("layer"), row.pop("level"), row.pop("name"))
        stated[key] = tuple(map(str, row.pop("attribution")))
        parts[key] = _decode_part(key, row, {n.removeprefix(folder): data for n, data in files.items()}, limits)
    datum = None if top["datum"] is None else Datum(**top["datum"])
    levels = tuple(Level(str(name), float(elevation)) for name, elevation in top["levels"])
    return Content(Layers(parts, datum, levels), stated, added)


def _decode_part(key: PartKey, row: Mapping[str, Any], files: Mapping[str, bytes], limits: Limits) -> Part:
    kind = PART_TYPES[key.layer]
    if kind is Features:
        ids = tuple(map(str, row["ids"]))
        if len(ids) > limits.features:
            raise TooLarge(f"the content has {len(ids)} features; the limit is {limits.features}")
        if not all(isinstance(p, dict) for p in (*row["properties"], row["document"])):
            reason = f"the properties of the layer {key.layer} must be objects"
            raise UnreadableFile(reason, [Problem(reason)])
        geometry = np.empty(len(ids), object)
        geometry[:] = shapely.from_wkb(row["geometry"])
        return Features(ids, geometry, tuple(row["properties"]), np.array(row["local"], bool), row["document"])
    if kind is Resources:
        return Resources({str(path): files[name] for path, name in row["files"].items()})
    limit = limits.voxels if key.layer == "voxels" else limits.pixels
    values = {name: _value(value, files, limit) for name, value in row.items()}
    for name, expected_class in _KINDS.items():
        if not isinstance(values.get(name, expected_class()), expected_class):
            raise TypeError(f"{name} of the layer {key.layer} must be {expected_class.__name__}")
    part: Part = kind(**values)
    if isinstance(part, GeoImage):
        _check_place(part)
    return part


def _check_place(picture: GeoImage) -> None:
    """Reject an image without a valid position, or with a CRS that makes PROJ open files."""
    if picture.crs != LOCAL and not geotiff.CRS_NAME.fullmatch(picture.crs):
        geotiff.crs_from_wkt(picture.crs)
    if (reason := geotiff.position_problem(picture)) is not None:
        raise UnreadableFile(f"an image: {reason}", [Problem(reason)])


def _value(value: Any, files: Mapping[str, bytes], limit: int) -> Any:
    """Decode a field: an array of at most ``limit`` rows or pixels, a tuple of numbers, or the value itself."""
    if isinstance(value, dict) and value.keys() == {"file", "type", "shape"}:
        shape = tuple(map(int, value["shape"]))
        if value["type"] not in _TYPES or min(shape, default=0) < 0:
            raise ValueError(f"{value['type']!r} {shape} is not an array of numbers")
        if math.prod(shape[:2]) > 4 * limit or math.prod(shape) > 64 * limit:
            raise TooLarge(f"an array of the content is {shape}; the limit is {limit}")
        return np.frombuffer(files[value["file"]], np.dtype(value["type"])).reshape(shape)
    return tuple(value) if isinstance(value, list) else value
