"""LAS and LAZ point clouds ↔ voxels.

Reading gives the voxels of the points, and the file as a resource (see ``clouds.points``), placed by the file's CRS, as
WKT or GeoTIFF keys. Heights become metres: by its vertical CRS, else by ``VerticalUnits``, else they have the unit of
the horizontal CRS that the keys name.
Writing gives the file that the voxels came from; the points of another cloud format; else the centres of the occupied
voxels. New files are LAS 1.4 in steps of a millimetre.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from app.formats import Files, Format, LayerRequirements, ReadContext, Selection, WriteContext, register
from app.formats.clouds import las_codec, points
from app.formats.clouds.parsers import PARSERS
from app.model.layers import MAP, Layers, PartKey
from app.parameters import parameter

NAME = "las"
ENDINGS = ("las", "laz")


@dataclass(frozen=True, slots=True)
class WriteOptions:
    """Selection of the cloud, and its encoding."""

    name: str | None = parameter(None, points.NAME_DOC)
    level: str | None = parameter(None, points.LEVEL_DOC)
    kind: Literal["las", "laz"] | None = parameter(None, "las, or laz (compressed); default: as uploaded, else las")
    frame: Literal["source", "local"] | None = parameter(None, points.FRAME_DOC)


def read(files: Files, context: ReadContext) -> Layers:
    """Read one voxel map and its cloud. Raises UnreadableFile or TooLarge."""
    main = context.main or next(iter(files))
    compressed = len(files[main]) > 104 and bool(files[main][104] & 0xC0)
    return points.read(files, context, "laz" if compressed else "las", las_codec.parse)


def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """Write ``map.las`` or ``map.laz`` (``<name>.las`` if a name is requested).

    Raises MissingLayer, NotFound, Ambiguous or Invalid.
    """
    options = context.options if isinstance(context.options, WriteOptions) else WriteOptions()
    source = points.source(layers, context, options.name, options.level, options.frame, ENDINGS, PARSERS)
    kind = options.kind or (source.form if source.form in ENDINGS else "las")
    name = points.file_name(options.name, kind)
    if source.data is not None:
        return {name: source.data if kind == source.form else las_codec.recompress(source.data, kind == "laz")}
    cloud = source.cloud()
    if source.form not in ENDINGS:
        if cloud.height > 1:
            context.drop("rows and columns of the cloud", 1, "LAS cannot store them: request pcd instead")
        context.drop(
            "viewpoint", int(cloud.viewpoint != points.IDENTITY_VIEWPOINT), "LAS cannot store it: request pcd instead"
        )
        for noun, count in cloud.further.items():
            context.drop(noun, count, "LAS has points only")
    return {name: las_codec.pack(points.plain(cloud), context, kind == "laz")}


def choose(keys: Sequence[PartKey], options: WriteOptions) -> Sequence[PartKey]:
    """Choose the named voxel map, else ``map``, else the only one, and its cloud."""
    return points.choose(keys, options.name, options.level)


def options_from_filename(name: str) -> dict[str, str]:
    """Select compression for ``map.laz``, and the voxel map ``lab`` for ``lab.las``."""
    stem, _, end = name.rpartition(".")
    if not stem or end not in ENDINGS:
        return {}
    return {"kind": end, **({} if stem == MAP else {"name": stem})}


register(
    Format(
        name=NAME,
        title="LAS and LAZ point cloud",
        files={"map.las": "application/vnd.las", "map.laz": "application/vnd.laszip"},
        layers=frozenset({"voxels", "resources"}),
        detect=las_codec.detect,
        read=read,
        write=write,
        needs=LayerRequirements((frozenset({"voxels"}),), also=frozenset({"resources"})),
        read_options=points.ReadOptions,
        write_options=WriteOptions,
        extensions=(".las", ".laz"),
        selection=Selection(choose, options_from_filename, points.PARTS),
    )
)
