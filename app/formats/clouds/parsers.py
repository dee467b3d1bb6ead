"""Parsers of cloud files by extension: any of them can be the source of a requested cloud."""

from __future__ import annotations

from collections.abc import Mapping

from app.formats.clouds import las_codec, pcd_codec, ply_codec
from app.formats.clouds.points import Parse

PARSERS: Mapping[str, Parse] = {
    "pcd": pcd_codec.parse,
    "ply": ply_codec.parse,
    "las": las_codec.parse,
    "laz": las_codec.parse,
}
