"""PLY point clouds (and meshes, of which the vertices count) ↔ voxels.

Read: the voxels that the vertices lie in, and the file beside them (see ``clouds.points``). Written: the very file that
the voxels were made of; the points of another cloud format's; else the centres of the occupied voxels, as float32.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

from app.formats import Files, Format, LayerRequirements, ReadContext, Selection, WriteContext, register
from app.formats.clouds import ply_codec, points
from app.formats.clouds.parsers import PARSERS
from app.model.layers import Layers, PartKey
from app.parameters import parameter

NAME = "ply"


@dataclass(frozen=True, slots=True)
class WriteOptions:
    """Which cloud, and how it is written."""

    name: str | None = parameter(None, points.NAME_DOC)
    level: str | None = parameter(None, points.LEVEL_DOC)
    data: Literal["ascii", "binary_little_endian", "binary_big_endian"] | None = parameter(
        None, "how points are encoded; default: as uploaded, else binary_little_endian"
    )
    frame: Literal["source", "local"] | None = parameter(None, points.FRAME_DOC)


def read(files: Files, context: ReadContext) -> Layers:
    """One voxel map and its cloud. Raises UnreadableFile (with line and word, or the reason) or TooLarge."""
    return points.read(files, context, NAME, ply_codec.parse)


def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """``map.ply`` (``<name>.ply`` where a name is asked for). Raises MissingLayer, NotFound, Ambiguous or Invalid."""
    options = context.options if isinstance(context.options, WriteOptions) else WriteOptions()
    source = points.source(layers, context, options.name, options.level, options.frame, (NAME,), PARSERS)
    name = points.file_name(options.name, NAME)
    if source.data is not None and options.data is None:
        return {name: source.data}
    cloud = source.cloud()
    if source.form != NAME:
        if cloud.height > 1:
            context.drop("rows and columns of the cloud", 1, "a PLY's vertices are one list: ask for pcd")
        context.drop(
            "viewpoint", int(cloud.viewpoint != points.IDENTITY_VIEWPOINT), "PLY has no place for it: ask for pcd"
        )
        cloud = replace(cloud, columns=points.plain(cloud), comments=())
    for noun, count in cloud.further.items():
        context.drop(noun, count, "written again, a PLY has vertices only: leave out data= and frame= to keep it")
    return {name: ply_codec.pack(cloud, options.data or "binary_little_endian")}


def choose(keys: Sequence[PartKey], options: WriteOptions) -> Sequence[PartKey]:
    """The named voxel map; else ``map``, else the only one; and the cloud that belongs to it."""
    return points.choose(keys, options.name, options.level)


register(
    Format(
        name=NAME,
        title="PLY point cloud",
        files={"map.ply": "application/octet-stream"},
        layers=frozenset({"voxels", "resources"}),
        detect=ply_codec.detect,
        read=read,
        write=write,
        needs=LayerRequirements((frozenset({"voxels"}),), also=frozenset({"resources"})),
        read_options=points.ReadOptions,
        write_options=WriteOptions,
        extensions=(".ply",),
        selection=Selection(choose, points.options_from_filename((NAME,)), points.PARTS),
    )
)
