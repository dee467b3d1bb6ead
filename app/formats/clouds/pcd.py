"""PCD point clouds (Point Cloud Library) ↔ voxels.

Read: the voxels that the points lie in, and the file beside them (see ``clouds.points``). Written: the very file that
the voxels were made of; the points of another cloud format's; else the centres of the occupied voxels, as float32.
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
    """Which cloud, and how it is written."""

    name: str | None = parameter(None, points.NAME_DOC)
    level: str | None = parameter(None, points.LEVEL_DOC)
    data: Literal["ascii", "binary", "binary_compressed"] | None = parameter(
        None, "how points are encoded; default: as uploaded, else binary"
    )
    frame: Literal["source", "local"] | None = parameter(None, points.FRAME_DOC)


def read(files: Files, context: ReadContext) -> Layers:
    """One voxel map and its cloud. Raises UnreadableFile (with line and word, or the reason) or TooLarge."""
    return points.read(files, context, NAME, pcd_codec.parse)


def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """``map.pcd`` (``<name>.pcd`` where a name is asked for). Raises MissingLayer, NotFound, Ambiguous or Invalid."""
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
    """The named voxel map; else ``map``, else the only one; and the cloud that belongs to it."""
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
