"""PCD point clouds (Point Cloud Library) ↔ voxels.

Reading gives the voxels of the points, and the file as a resource (see ``clouds.points``). Writing gives the file that
the voxels came from; the points of another cloud format; else the centres of the occupied voxels, as float32.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

from app.formats import Files, Format, LayerRequirements, ReadContext, Selection, WriteContext, register
from app.formats.clouds import pcd_codec, points
from app.formats.clouds.parsers import PARSERS
from app.model.layers import Layers, PartKey
from app.parameters import parameter

NAME = "pcd"


@dataclass(frozen=True, slots=True)
class WriteOptions:
    """Selection of the cloud, and its encoding."""

    name: str | None = parameter(None, points.NAME_DOC)
    level: str | None = parameter(None, points.LEVEL_DOC)
    data: Literal["ascii", "binary", "binary_compressed"] | None = parameter(
        None, "encoding of the points; default: as uploaded, else binary"
    )
    frame: Literal["source", "local"] | None = parameter(None, points.FRAME_DOC)


def read(files: Files, context: ReadContext) -> Layers:
    """Read one voxel map and its cloud. Raises UnreadableFile (with line and keyword, or the reason) or TooLarge."""
    return points.read(files, context, NAME, pcd_codec.parse)


def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """Write ``map.pcd`` (``<name>.pcd`` if a name is requested).

    Raises MissingLayer, NotFound, Ambiguous or Invalid.
    """
    options = context.options if isinstance(context.options, WriteOptions) else WriteOptions()
    source = points.source(layers, context, options.name, options.level, options.frame, (NAME,), PARSERS)
    name = points.file_name(options.name, NAME)
    if source.data is not None and options.data is None:
        return {name: source.data}
    cloud = source.cloud()
    if source.form != NAME:
        cloud = replace(cloud, columns=pcd_codec.add_padding(points.plain(cloud)), comments=())
        for noun, count in cloud.further.items():
            context.drop(noun, count, "a PCD has points only")
    return {name: pcd_codec.pack(cloud, options.data or "binary")}


def choose(keys: Sequence[PartKey], options: WriteOptions) -> Sequence[PartKey]:
    """Choose the named voxel map, else ``map``, else the only one, and its cloud."""
    return points.choose(keys, options.name, options.level)


register(
    Format(
        name=NAME,
        title="PCD point cloud",
        files={"map.pcd": "application/octet-stream"},
        layers=frozenset({"voxels", "resources"}),
        detect=pcd_codec.detect,
        read=read,
        write=write,
        needs=LayerRequirements((frozenset({"voxels"}),), also=frozenset({"resources"})),
        read_options=points.ReadOptions,
        write_options=WriteOptions,
        extensions=(".pcd",),
        selection=Selection(choose, points.options_from_filename((NAME,)), points.PARTS),
    )
)
