"""Rules of the OctoMap library for its files.

Source: OctoMap, AbstractOcTree::read (first line, ``id``, ``size``, ``res``, ``data``; an unknown id is rejected),
AbstractOccupancyOcTree::readBinary (size and number of nodes are compared), OcTreeKey (16 levels).
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Iterator

import numpy as np

from app.errors import Problem
from app.formats import Files
from app.formats._rules import error_finding, shown, warning_finding

BINARY, FULL = b"# Octomap OcTree binary file", b"# Octomap OcTree file"
NODE_BYTES = {"OcTree": 5, "ColorOcTree": 8, "OcTreeStamped": 5}
MAX_HEADER_BYTES = 2**16
MAX_CELLS = 65536
_KEYS = re.compile(rb"^(id|size|res)[ \t]+([^\r\n]*?)[ \t]*\r?$", re.MULTILINE)

_codes = np.arange(65536)
_CHILDREN = sum(((_codes >> shift) & 3 > 0).astype(np.uint8) for shift in range(0, 16, 2))
_INNER = sum(((_codes >> shift) & 3 == 3).astype(np.uint8) for shift in range(0, 16, 2))
"""Number of children, and of inner nodes among them, by the 16 bits of an inner node."""


def check(files: Files) -> Iterator[Problem]:
    """Check a file's header against its data; the tree's nodes are counted, not built."""
    main = next(iter(files))
    data = files[main]
    if data[:4] == b"\x03\0\0\0":
        reason = (
            "obsolete format of 2010 without a text header, which newer tools reject: download it again as .bt or .ot"
        )
        yield warning_finding(reason, main)
        _, resolution, size = struct.unpack("<IdI", data[:16])
        yield from _binary(data[16:], size, main)
        yield from _resolution(resolution, main)
        return
    kind = next((k for k in (BINARY, FULL) if data.startswith(k)), None)
    start = re.search(rb"^data[ \t]*\r?\n", data[:MAX_HEADER_BYTES], re.MULTILINE)
    if kind is None or start is None:
        reason = "the first line must be '# Octomap OcTree file' or '… binary file', the last header line 'data'"
        yield error_finding(reason, main, line=1)
        return
    header = {key.decode(): value.decode("latin1") for key, value in _KEYS.findall(data[: start.start()])}
    tree, size, res = header.get("id"), header.get("size"), header.get("res")
    if tree not in NODE_BYTES:
        yield error_finding(f"tree type {shown(tree)} is unknown to OctoMap", main, where="id")
    if size is None or not size.isdigit():
        yield error_finding(f"must be the number of nodes, got {shown(size)}", main, where="size")
    try:
        yield from _resolution(float(res or "nan"), main)
    except ValueError:
        yield error_finding(f"must be a number, got {shown(res)}", main, where="res")
    body = data[start.end() :]
    count = int(size) if size is not None and size.isdigit() else None
    if kind == BINARY:
        yield from _binary(body, count, main)
    elif tree in NODE_BYTES and count is not None:
        need = count * NODE_BYTES[tree]
        if len(body) < need:
            yield error_finding(f"{count} nodes need {need} bytes, but the file has {len(body)}", main, where="size")
        elif len(body) > need:
            yield warning_finding(f"{len(body) - need} bytes follow the last node", main, where="size")


def _resolution(value: float, main: str) -> Iterator[Problem]:
    if not math.isfinite(value) or value <= 0:
        yield error_finding(f"must be a length above 0, got {value:g}", main, where="res")


def _binary(body: bytes, count: int | None, main: str) -> Iterator[Problem]:
    """Check a stream with two bits per child: declared nodes, and inner nodes that must follow."""
    if not count and not body:
        return
    masks = np.frombuffer(body, "<u2", len(body) // 2)
    assert isinstance(_INNER, np.ndarray)
    assert isinstance(_CHILDREN, np.ndarray)
    # Depth first: the stream ends when no inner node is open.
    open_nodes = 1 + np.cumsum(_INNER[masks].astype(np.int64) - 1)
    ends = np.flatnonzero(open_nodes == 0)
    if not len(ends):
        yield error_finding("truncated file: an inner node's children are missing", main)
        return
    used = int(ends[0]) + 1
    if used < len(masks):
        yield warning_finding(f"{len(body) - 2 * used} bytes follow the tree", main)
    nodes = 1 + int(_CHILDREN[masks[:used]].sum(dtype=np.int64))
    if count is not None and nodes != count:
        yield warning_finding(
            f"the header declares {count} nodes, but the tree has {nodes}: OctoMap reports an error", main, where="size"
        )
