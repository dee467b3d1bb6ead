"""Safe ZIP reading and deterministic writing, for KMZ and for uploads of a zipped folder.

Nothing is extracted to disk: an archive becomes a mapping of names to bytes in memory. The central directory and every
local header are parsed here instead of by ``zipfile``, because the two must agree and ``zipfile`` allows differences.
Nested archives stay bytes. Layout: PKWARE APPNOTE 6.3.
"""

from __future__ import annotations

import io
import itertools
import re
import stat
import struct
import unicodedata
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass

from app.errors import Problem, TooLarge, UnreadableFile, UnsafeArchive
from app.limits import UNPACKED_FREE_BYTES, Limits
from app.model.names import name_problem

_END = struct.Struct("<4s4H2LH")
_END64 = struct.Struct("<4sQ2H2L4Q")
_LOCATOR64 = struct.Struct("<4sLQL")
_CENTRAL = struct.Struct("<4s6H3L5H2L")
_LOCAL = struct.Struct("<4s5H3L2H")

_STORED, _DEFLATED = 0, 8
_ENCRYPTED = 0x0001 | 0x0040 | 0x2000
_DESCRIPTOR = 0x0008
_UTF8 = 0x0800
_UNIX = (3, 19)
_MASK16, _MASK32 = 0xFFFF, 0xFFFFFFFF
_ZIP64, _UNICODE_PATH = 0x0001, 0x7075

_CHUNK = 2**20

_TEXTS = (
    *(".kml", ".xml", ".osm", ".sdf", ".world", ".dae", ".gml", ".dxf"),
    *(".yaml", ".yml", ".json", ".geojson", ".ron", ".lif", ".tmap2", ".tmap", ".csv"),
)
_TEXT_COST = 2
"""Divisor of the allowed compression ratio for text, which costs more memory when parsed. Real text reaches 40."""
_IMAGES = (".pgm", ".ppm", ".pnm", ".pbm", ".png", ".bmp", ".tif", ".tiff", ".jpg", ".jpeg")
_ARRAY = re.compile(r"(?:.*/)?config/fleet_map/[0-9]+\.bin")
"""Names of the cells and voxels of an environment package, which are as large and uniform as images."""

_LIMITS = Limits()
_DENSE_RATIO = 40
"""Maximum compression ratio of written content beyond the free bytes: less than half of what ``unpack`` accepts."""

_EPOCH = (1980, 1, 1, 0, 0, 0)


@dataclass(frozen=True, slots=True)
class _Entry:
    """Member as described by the central directory. start: offset of its local header."""

    name: str
    raw_name: bytes
    flags: int
    method: int
    crc: int
    packed: int
    size: int
    start: int
    mode: int

    @property
    def is_folder(self) -> bool:
        return self.name.endswith("/")


def is_archive(data: bytes) -> bool:
    """Return whether the bytes look like a ZIP archive (also an empty one)."""
    return data[:4] in (b"PK\x03\x04", b"PK\x05\x06")


def unpack(data: bytes, limits: Limits) -> dict[str, bytes]:
    """Unpack an archive's files in the order of its central directory, without folders.

    Raises UnsafeArchive (links, devices, encryption, overlaps, colliding or escaping names, headers that disagree),
    TooLarge (more files or bytes than ``limits`` allow; actual output is counted) or
    UnreadableFile (not a ZIP archive, damaged, an unknown compression).
    """
    entries, directory = _entries(data, limits)
    _check_names(entries)
    _check_sizes(entries, len(data), limits)
    spans = []
    for entry in entries:
        start, end = _locate(data, entry, directory)
        spans.append((entry.start, end, start, entry))
    spans.sort(key=lambda s: s[0])
    for (_, end, _, before), (begin, _, _, entry) in itertools.pairwise(spans):
        if begin < end:
            raise _unsafe_error("shares its bytes with another member", f"{before.name} and {entry.name}")
    places = {entry.name: start for _, _, start, entry in spans}
    return {e.name: _inflate(data, e, places[e.name]) for e in entries if not e.is_folder}


def _check_sizes(entries: list[_Entry], packed: int, limits: Limits) -> None:
    """Check the declared sizes against the limits of text, images and other content. Raises TooLarge.

    ``_inflate_pieces`` counts the actual output and stops at the declared size.
    """
    images = [e for e in entries if _is_image(e.name)]
    for e in entries:
        if e.name.lower().endswith(_TEXTS):
            bound = min(limits.text_bytes, limits.max_unpacked(e.packed // _TEXT_COST))
            if e.size > bound:
                raise _too_large_error(e.size, bound, f"the limit for a text of {e.packed} compressed bytes", e.name)
    size_of_images = sum(e.size for e in images)
    size = sum(e.size for e in entries)
    if size > limits.unpacked_bytes:
        raise _too_large_error(size, limits.unpacked_bytes, "the limit")
    ratio = f"the limit for an archive of {packed} bytes"
    for noun, declared, bound in (
        ("images", size_of_images, limits.max_unpacked(packed, limits.pixels)),
        ("files", size - size_of_images, limits.max_unpacked(packed)),
    ):
        if declared > bound:
            raise _too_large_error(declared, bound, ratio, noun=f" of {noun}")


def _is_image(name: str) -> bool:
    return name.lower().endswith(_IMAGES) or _ARRAY.fullmatch(name) is not None


def _too_large_error(size: int, bound: int, limit: str, location: str | None = None, noun: str = "") -> TooLarge:
    prefix = f"{location}: " if location else ""
    reason = f"declares {size} bytes{noun}; {limit} is {bound}"
    return TooLarge(f"the uncompressed archive is too large: {prefix}{reason}", [Problem(reason, where=location)])


def pack(files: Mapping[str, bytes], first: str | None = None) -> bytes:
    """Create a ZIP archive: the entry ``first`` leads, the others follow by name; equal files give equal bytes.

    Time stamps and permissions are constant. A file is stored uncompressed if deflate does not shrink it, or shrinks
    it further than ``unpack`` accepts. Raises ValueError for a name that ``unpack`` would reject.
    """
    out = io.BytesIO()
    free = {True: _LIMITS.pixels // 2, False: UNPACKED_FREE_BYTES // 2}
    with zipfile.ZipFile(out, "w") as archive:
        for name in sorted(files, key=lambda n: (n != first, n)):
            reason = name_problem(name)
            if reason or name.endswith("/"):
                raise ValueError(f"invalid name in an archive: {name!r} {reason or 'names a folder'}")
            info = zipfile.ZipInfo(name, _EPOCH)
            info.create_system = 3
            info.external_attr = (stat.S_IFREG | 0o644) << 16
            body = files[name]
            packed, is_image = len(zlib.compress(body, 6)), _is_image(name)
            deflate = packed < len(body)
            if len(body) > _DENSE_RATIO * packed:
                deflate = len(body) <= free[is_image]
                free[is_image] -= len(body) if deflate else 0
            info.compress_type = zipfile.ZIP_DEFLATED if deflate else zipfile.ZIP_STORED
            archive.writestr(info, body, compresslevel=6)
    return out.getvalue()


def _unsafe_error(reason: str, location: str | None = None) -> UnsafeArchive:
    prefix = f"{location}: " if location else ""
    detail = f"unsafe archive: {prefix}{reason}; pack it again with plain files"
    return UnsafeArchive(detail, [Problem(reason, where=location)])


def _damaged_error(reason: str, location: str | None = None) -> UnreadableFile:
    prefix = f"{location}: " if location else ""
    return UnreadableFile(f"damaged or not a ZIP archive: {prefix}{reason}", [Problem(reason, where=location)])


def _read_end_record(data: bytes) -> tuple[int, int, int]:
    """Return the number of entries, and the start and end of the central directory."""
    offset = data.rfind(b"PK\x05\x06", max(0, len(data) - _END.size - _MASK16))
    while offset >= 0:
        if offset + _END.size <= len(data) and offset + _END.size + _END.unpack_from(data, offset)[7] == len(data):
            break
        offset = data.rfind(b"PK\x05\x06", max(0, len(data) - _END.size - _MASK16), offset + 3) if offset else -1
    if offset < 0:
        raise _damaged_error("no end of central directory; the file may be truncated")
    _, disk, first_disk, disk_count, count, size, start, _ = _END.unpack_from(data, offset)
    stop = offset
    at64 = offset - _LOCATOR64.size
    if at64 >= 0 and data[at64 : at64 + 4] == b"PK\x06\x07":
        _, end_disk, end_at, disks = _LOCATOR64.unpack_from(data, at64)
        if end_disk or disks > 1 or end_at + _END64.size > at64 or data[end_at : end_at + 4] != b"PK\x06\x06":
            raise _damaged_error("wrong position of its ZIP64 end of central directory")
        _, length, _, _, disk64, first64, here64, count64, size64, start64 = _END64.unpack_from(data, end_at)
        if end_at + 12 + length != at64:
            raise _damaged_error("wrong length of its ZIP64 end of central directory")
        for small, large, mask in (
            (disk, disk64, _MASK16),
            (first_disk, first64, _MASK16),
            (disk_count, here64, _MASK16),
            (count, count64, _MASK16),
            (size, size64, _MASK32),
            (start, start64, _MASK32),
        ):
            if small not in (mask, large):
                raise _unsafe_error("its two ends of central directory disagree")
        disk, first_disk, disk_count, count, size, start, stop = (
            disk64,
            first64,
            here64,
            count64,
            size64,
            start64,
            end_at,
        )
    if disk or first_disk or disk_count != count:
        raise _damaged_error("it is one part of a split archive: join the parts first")
    if start + size != stop:
        raise _damaged_error("wrong position of its central directory")
    return count, start, stop


def _entries(data: bytes, limits: Limits) -> tuple[list[_Entry], int]:
    """Return the members in the directory's order, and the start of the directory."""
    if not is_archive(data):
        raise _damaged_error("missing signature at its start")
    count, start, stop = _read_end_record(data)
    if count > limits.files:
        raise TooLarge(
            f"too many members in the archive: {count}, the limit is {limits.files}",
            [Problem(f"{count} members; the limit is {limits.files}")],
        )
    out, offset = [], start
    for _ in range(count):
        if offset + _CENTRAL.size > stop:
            raise _damaged_error("its central directory is shorter than declared")
        head = _CENTRAL.unpack_from(data, offset)
        (
            mark,
            made_by,
            _,
            flags,
            method,
            _,
            _,
            crc,
            packed,
            size,
            n_name,
            n_extra,
            n_comment,
            disk,
            _,
            attr,
            header_offset,
        ) = head
        begin = offset + _CENTRAL.size
        offset = begin + n_name + n_extra + n_comment
        if mark != b"PK\x01\x02" or offset > stop:
            raise _damaged_error("its central directory is broken")
        raw = data[begin : begin + n_name]
        extra = _extra(data[begin + n_name : begin + n_name + n_extra])
        name = _decode(raw, flags, made_by >> 8, extra)
        wide = iter(_wide(extra))
        try:
            size = next(wide) if size == _MASK32 else size
            packed = next(wide) if packed == _MASK32 else packed
            header_offset = next(wide) if header_offset == _MASK32 else header_offset
        except StopIteration:
            raise _damaged_error("its ZIP64 sizes are missing", name) from None
        if disk not in (0, _MASK16):
            raise _damaged_error("it is one part of a split archive: join the parts first", name)
        out.append(_Entry(name, raw, flags, method, crc, packed, size, header_offset, attr >> 16))
    if offset != stop:
        raise _damaged_error("its central directory is longer than its members")
    return out, start


def _extra(block: bytes) -> dict[int, bytes]:
    """Parse the extra fields by number. Incomplete bytes at the end are ignored, as by other readers."""
    out: dict[int, bytes] = {}
    offset = 0
    while offset + 4 <= len(block):
        kind, length = struct.unpack_from("<2H", block, offset)
        if offset + 4 + length > len(block):
            break
        out.setdefault(kind, block[offset + 4 : offset + 4 + length])
        offset += 4 + length
    return out


def _wide(extra: Mapping[int, bytes]) -> tuple[int, ...]:
    """Return the 8-byte numbers of the ZIP64 field, in the order of the masked fields."""
    body = extra.get(_ZIP64, b"")
    return struct.unpack_from(f"<{len(body) // 8}Q", body)


def _decode(raw: bytes, flags: int, system: int, extra: Mapping[int, bytes]) -> str:
    """Decode a member's name: UTF-8 if flagged, in the Unicode path field, or packed on a Unix host."""
    path = extra.get(_UNICODE_PATH, b"")
    try:
        if flags & _UTF8:
            return raw.decode()
        if path[:1] == b"\x01" and path[1:5] == struct.pack("<L", zlib.crc32(raw)):
            return path[5:].decode()
        if system in _UNIX:
            try:
                return raw.decode()
            except UnicodeDecodeError:
                pass
        return raw.decode("cp437")
    except UnicodeDecodeError:
        raise _unsafe_error("has a name that is declared as UTF-8 but is not", repr(raw[:80])) from None


def _check_names(entries: list[_Entry]) -> None:
    """Reject names that escape the archive or collide on some file system, and members other than plain files."""
    seen: dict[str, _Entry] = {}
    for e in entries:
        reason = name_problem(e.name)
        if reason:
            raise _unsafe_error(reason, e.name.encode("unicode_escape").decode()[:200])
        if e.flags & _ENCRYPTED:
            raise _unsafe_error("is encrypted", e.name)
        kind = stat.S_IFMT(e.mode)
        if kind not in (0, stat.S_IFREG, stat.S_IFDIR) or (kind and (kind == stat.S_IFDIR) != e.is_folder):
            raise _unsafe_error("is a link, a device or a disguised folder", e.name)
        if e.is_folder and e.size:
            raise _unsafe_error("is a folder with content", e.name)
        if e.method not in (_STORED, _DEFLATED):
            raise UnreadableFile(
                f"unsupported compression method {e.method} of {e.name}: pack the archive with deflate or uncompressed",
                [Problem(f"unsupported compression method {e.method}", where=e.name)],
            )
        key = _fold(e.name)
        if key in seen:
            raise _unsafe_error("has the same name as another member (on some file systems)", e.name)
        seen[key] = e
    files = {key for key, e in seen.items() if not e.is_folder}
    for key, e in seen.items():
        cut = key.find("/")
        while cut >= 0:
            if key[:cut] in files:
                raise _unsafe_error("is in a folder that is also a file", e.name)
            cut = key.find("/", cut + 1)


def _fold(name: str) -> str:
    """Fold a name so that names which collide on some file system become equal."""
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", name.removesuffix("/")).casefold())


def _locate(data: bytes, e: _Entry, directory: int) -> tuple[int, int]:
    """Return the start of a member's data and the end of its bytes. Its local header must match the directory."""
    if e.start + _LOCAL.size > directory:
        raise _damaged_error("not found at its position in the directory", e.name)
    mark, _, flags, method, _, _, crc, packed, size, n_name, n_extra = _LOCAL.unpack_from(data, e.start)
    if mark != b"PK\x03\x04":
        raise _damaged_error("not found at its position in the directory", e.name)
    begin = e.start + _LOCAL.size
    extra = _extra(data[begin + n_name : begin + n_name + n_extra])
    start = begin + n_name + n_extra
    end = start + e.packed
    if end > directory:
        raise _damaged_error("ends beyond the archive's data", e.name)
    later = bool(e.flags & _DESCRIPTOR)
    wide = _wide(extra)
    if size == _MASK32 and packed == _MASK32 and len(wide) >= 2:
        size, packed = wide[:2]
    agree = (
        data[begin : begin + n_name] == e.raw_name
        and flags == e.flags
        and method == e.method
        and (crc == e.crc or (later and crc == 0))
        and (size == e.size or (later and size == 0))
        and (packed == e.packed or (later and packed == 0))
    )
    if not agree or (e.method == _STORED and e.packed != e.size):
        raise _unsafe_error("its local header and the directory disagree", e.name)
    if later:
        tail = data[end : min(end + 24, directory)]
        forms = ("<LLL", "<LQQ") if max(e.packed, e.size) <= _MASK32 else ("<LQQ",)
        for form in forms:
            body = struct.pack(form, e.crc, e.packed, e.size)
            for descriptor in (b"PK\x07\x08" + body, body):
                if tail.startswith(descriptor):
                    return start, end + len(descriptor)
        raise _unsafe_error("its data descriptor and the directory disagree", e.name)
    return start, end


def _inflate(data: bytes, e: _Entry, start: int) -> bytes:
    """Decompress a member, up to its declared size."""
    packed = memoryview(data)[start : start + e.packed]
    body = bytes(packed) if e.method == _STORED else _inflate_pieces(packed, e)
    if zlib.crc32(body) != e.crc:
        raise _damaged_error("its checksum is wrong", e.name)
    return body


def _inflate_pieces(packed: memoryview, e: _Entry) -> bytes:
    """Decompress in pieces, to avoid copies of the input and output beyond the declared size."""
    unpacker = zlib.decompressobj(-zlib.MAX_WBITS)
    parts, total = [], 0
    for offset in range(0, len(packed), _CHUNK):
        piece: bytes | memoryview = packed[offset : offset + _CHUNK]
        while not unpacker.eof:
            limit = min(_CHUNK, e.size + 1 - total)
            try:
                part = unpacker.decompress(piece, limit)
            except zlib.error as error:
                raise _damaged_error(str(error), e.name) from None
            piece = unpacker.unconsumed_tail
            total += len(part)
            parts.append(part)
            if total > e.size:
                raise _unsafe_error(f"decompresses to more than its declared {e.size} bytes", e.name)
            if not piece and len(part) < limit:
                break
        if unpacker.eof:
            spare = len(unpacker.unused_data) + max(0, len(packed) - offset - _CHUNK)
            if total != e.size or spare:
                raise _unsafe_error("differs from its declared size", e.name)
            return b"".join(parts)
    raise _damaged_error("truncated data", e.name)
