"""PLY point clouds (and the vertices of meshes) ↔ voxels.

Reading gives the voxels of the vertices, and the file as a resource (see ``clouds.points``). Writing gives the file
that the voxels came from; the points of another cloud format; else the centres of the occupied voxels, as float32.
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
    """Selection of the cloud, and its encoding."""

    name: str | None = parameter(None, points.NAME_DOC)
    level: str | None = parameter(None, points.LEVEL_DOC)
    data: Literal["ascii", "binary_little_endian", "binary_big_endian"] | None = parameter(
        None, "encoding of the points; default: as uploaded, else binary_little_endian"
    )
    frame: Literal["source", "local"] | None = parameter(None, points.FRAME_DOC)


def read(files: Files, context: ReadContext) -> Layers:
    """Read one voxel map and its cloud. Raises UnreadableFile (with line and keyword, or the reason) or TooLarge."""
    return points.read(files, context, NAME, ply_codec.parse)


def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """Write ``map.ply`` (``<name>.ply`` if a name is requested).

    Raises MissingLayer, NotFound, Ambiguous or Invalid.
    """
    options = context.options if isinstance(context.options, WriteOptions) else WriteOptions()
    source = points.source(layers, context, options.name, options.level, options.frame, (NAME,), PARSERS)
    name = points.file_name(options.name, NAME)
    if source.data is not None and options.data is None:
        return {name: source.data}
    cloud = source.cloud()
    if source.form != NAME:
        if cloud.height > 1:
            context.drop("rows and columns of the cloud", 1, "PLY cannot store them: request pcd instead")
        context.drop(
            "viewpoint", int(cloud.viewpoint != points.IDENTITY_VIEWPOINT), "PLY cannot store it: request pcd instead"
        )
        cloud = replace(cloud, columns=points.plain(cloud), comments=())
    for noun, count in cloud.further.items():
        context.drop(noun, count, "a rewritten PLY has vertices only: omit data= and frame= to get the uploaded file")
    return {name: ply_codec.pack(cloud, options.data or "binary_little_endian")}


def choose(keys: Sequence[PartKey], options: WriteOptions) -> Sequence[PartKey]:
    """Choose the named voxel map, else ``map``, else the only one, and its cloud."""
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
