"""Occupancy grids of Nav2's map_server: a YAML file with resolution, origin and thresholds, and a grey image.

A pixel g (0…255) is x = 1 - g/255 occupied (``negate``: g/255). ``trinary``: 100 if x ≥ occupied_thresh, then 0 if
x ≤ free_thresh (free takes precedence), else unknown; ``scale``: between the thresholds round(100 (x - free)/
(occupied - free)); ``raw``: g itself up to 100, else unknown.
A pixel that is not opaque is unknown (trinary, scale). The image's
top row is the map's last one. Comparisons are in float32. Source: nav2_map_server, map_io.cpp.

A costmap filter mask (keepout, speed) is such a grid with an additional ``<grid>_filter_info.yaml``: see ``_masks``.

``<grid>.tif`` is the same grid for GIS: see ``geotiff_grid``.

Frame: local; ``origin`` = [x, y, yaw] of the lower left corner, metres and radians. Nav2 ignores the yaw.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

from app.errors import FleetMapError
from app.formats import BAD_INPUT, Claims, Format, LayerRequirements, Parts, Selection, _masks, register
from app.formats._select import file_stem
from app.formats.occupancy_grid import geotiff_grid, rules
from app.formats.occupancy_grid.reading import IMAGE_ENDS, TIFF_ENDS, YAML_ENDS, ReadOptions, find_image, is_image, read
from app.formats.occupancy_grid.words import NAME
from app.formats.occupancy_grid.writing import WriteOptions, choose, write
from app.limits import Limits
from app.model import masks
from app.syntax import geotiff, yaml

_BLOCK = re.compile(
    rb'^["\']?(image|resolution|origin|occupied_thresh|free_thresh|negate)(?=["\']?[ \t]*:)', re.MULTILINE
)
_FLOW = re.compile(rb'(?<=[{,\s"\'])(?:image|resolution|origin|occupied_thresh|free_thresh|negate)(?=["\']?[ \t]*:)')
_FLOW_START = re.compile(rb"(?:\xef\xbb\xbf)?(?:\s|#[^\n]*\n|---|%[^\n]*\n)*\{")
HEAD = 2**16


def detect(name: str, data: bytes) -> bool:
    """Detect YAML with an image and at least two of a grid's other keys, and our GeoTIFF; no other single image."""
    del name
    if geotiff_grid.is_grid(data):
        return True
    head = data[:HEAD]
    if b"image" not in head or b"\0" in head:
        return False
    pattern = _FLOW if _FLOW_START.match(head) else _BLOCK
    keys = set(pattern.findall(head.removeprefix(b"\xef\xbb\xbf")))
    return b"image" in keys and len(keys) >= 3


def companions(main: str, data: bytes, names: Sequence[str]) -> Iterable[str]:
    """Find the image of a YAML file, and a mask's parameters; for an image, the YAML file with the same stem."""
    if geotiff.is_tiff(data):
        return _masks.companions(main, names)
    if is_image(main, data):
        stem = main.rpartition(".")[0]
        return [n for n in names if n in (stem + ".yaml", stem + ".yml")]
    try:
        image = yaml.load(data, Limits(yaml_nodes=10_000))["image"]
        picture = find_image(str(image), main, names)[0]
        return [n for n in [picture] if n] + _world_files(str(image), main, names) + _masks.companions(main, names)
    except (*BAD_INPUT, FleetMapError):  # the reader reports the error
        return []


def _world_files(image: str, main: str, names: Sequence[str]) -> list[str]:
    """Find the world file and the CRS beside an image. They say nothing that the YAML file does not."""
    folder = main.rpartition("/")[0]
    base = re.split(r"[/\\]", image)[-1]
    path = f"{folder}/{base}" if folder else base
    return [n for n in (path.rpartition(".")[0] + ".pgw", path + ".aux.xml") if n in names]


def options_from_filename(name: str) -> dict[str, str]:
    """Select the grid ``keepout`` for ``keepout.yaml``, ``.pgm`` and ``keepout_filter_info.yaml``.

    ``keepout.png`` also selects PNG, ``keepout.tif`` GeoTIFF.
    """
    for end in (".pgw", ".png.aux.xml"):
        if name.endswith(end) and len(name) > len(end):
            return {"grid": name.removesuffix(end), "file_type": "png", "world_file": "true"}
    stem, _, end = name.rpartition(".")
    if f".{end}" in YAML_ENDS:
        stem = stem.removesuffix(masks.INFO_SUFFIX)
    if not stem or f".{end}" not in (*YAML_ENDS, ".pgm", ".png", ".tif"):
        return {}
    return {"grid": stem, **({"file_type": end} if end in ("pgm", "png", "tif") else {})}


register(
    Format(
        name=NAME,
        title="Occupancy grid (Nav2, ROS map_server)",
        files={"map.yaml": "application/yaml", "map.pgm": "image/x-portable-graymap"},
        layers=frozenset({"occupancy"}),
        detect=detect,
        read=read,
        write=write,
        needs=LayerRequirements(one_of=(frozenset({"occupancy"}),)),
        read_options=ReadOptions,
        write_options=WriteOptions,
        check=rules.check,
        version=5,
        extensions=(*YAML_ENDS, *IMAGE_ENDS, *TIFF_ENDS),
        selection=Selection(choose, options_from_filename, Parts("occupancy", "grid", file_stem)),
        claims=Claims(priority=40, companions=companions),
    )
)
