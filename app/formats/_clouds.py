"""How each kind of cloud file is read, by its ending: any of them may be what a wanted cloud is made from."""

from __future__ import annotations

from collections.abc import Mapping

from app.formats import _las, _pcd, _ply
from app.formats._points import Parse

PARSERS: Mapping[str, Parse] = {"pcd": _pcd.parse, "ply": _ply.parse, "las": _las.parse, "laz": _las.parse}
