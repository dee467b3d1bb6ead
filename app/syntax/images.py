"""Safe image reading and fast PNG writing for grids, overlays and floor plans.

The kind of an image is detected by its first bytes, never by its name. Its size is checked before pixels are decoded. A
damaged image is rejected, never read in part. Supported: PGM (P2, P5) and raw PBM and PPM (P4, P6), PNG, BMP, JPEG.
"""

from __future__ import annotations

import io
import re
import struct
import zlib
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from app.errors import TooLarge, UnreadableFile
from app.limits import Limits
from app.model.grid import OCCUPIED, UNKNOWN, OccupancyGrid

Bytes = NDArray[np.uint8]

# Pillow's own limit would reject images that the settings allow; _check_size checks every image instead.
Image.MAX_IMAGE_PIXELS = None

PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
STRIP = 2**18
"""Number of pixels converted at a time: fits into the processor's cache and bounds memory."""

MAX_JPEG_SCANS = 64
DEFLATE_RATIO = 1032
"""Maximum compression ratio of a deflate stream (RFC 1951: 258 bytes for 2 bits)."""

RED, GREEN, BLUE = 298839, 586811, 114350
"""GraphicsMagick's weights of a grey value, in millionths: Nav2 converts coloured images with transparency so."""

_LONG_NUMBER = re.compile(rb"[0-9]{10}")

Strips = Iterator[tuple[int, Bytes, NDArray[np.bool_] | None]]


@dataclass(frozen=True, slots=True)
class Grey:
    """Decoded image in 8-bit grey.

    strips: yields (first row, grey uint8 [rows, width], opaque bool [rows, width] or None if every pixel is opaque),
    from the top row down. Raises UnreadableFile while reading strips if the image turns out to be damaged.
    """

    width: int
    height: int
    strips: Callable[[], Strips]

    def pixels(self) -> tuple[Bytes, NDArray[np.bool_] | None]:
        """Read the complete image: grey and opaque [height, width], top row first."""
        grey = np.empty((self.height, self.width), np.uint8)
        opaque: NDArray[np.bool_] | None = None
        for y, block, clear in self.strips():
            grey[y : y + len(block)] = block
            if clear is not None:
                if opaque is None:
                    opaque = np.ones(grey.shape, bool)
                opaque[y : y + len(block)] = clear
        return grey, opaque


def detect_kind(data: bytes) -> str | None:
    """Detect ``pgm`` (all of PBM, PGM, PPM), ``png``, ``bmp`` or ``jpeg`` by the first bytes; else None."""
    if data[:8] == PNG_MAGIC:
        return "png"
    if data[:3] == b"\xff\xd8\xff":
        return "jpeg"
    if data[:2] == b"BM" and len(data) >= 26:
        return "bmp"
    if data[:1] == b"P" and data[1:2] in b"123456" and data[2:3] and data[2:3] in b" \t\r\n\v\f#":
        return "pgm"
    return None


def read_grey(data: bytes, limits: Limits) -> Grey:
    """Read an image as grey, like GraphicsMagick and so Nav2. Raises UnreadableFile or TooLarge."""
    if detect_kind(data) == "pgm" and data[:2] in (b"P2", b"P5"):
        return _read_pgm(data, limits)
    image = read_image(data, limits)
    return Grey(image.width, image.height, lambda: _image_strips(image))


def read_image(data: bytes, limits: Limits) -> Image.Image:
    """Decode an image in its stored mode. Raises UnreadableFile or TooLarge.

    16-bit grey has mode ``I;16``; transparency is in the alpha band or in ``info["transparency"]``.
    """
    kind = detect_kind(data)
    if kind is None:
        raise UnreadableFile("unsupported image type: use PGM, PNG, BMP or JPEG")
    if kind == "pgm" and data[:2] in (b"P1", b"P3"):
        raise UnreadableFile("PBM and PPM in plain text are unsupported: save it as PGM (P5) or PNG")
    if kind == "pgm" and data[:2] in (b"P2", b"P5"):
        pixels, _ = _read_pgm(data, limits).pixels()
        return Image.fromarray(pixels)
    if kind == "png":
        data = b"".join(_check_png(data, limits))
    elif kind == "jpeg":
        _check_jpeg(data)
    names = {"png": "PNG", "jpeg": "JPEG", "bmp": "BMP", "pgm": "PPM"}
    # Pillow raises struct.error, SyntaxError and others on malformed input.
    try:
        stream = io.BytesIO(data)
        image = Image.open(stream, formats=[names[kind]])
        _check_size(image.width, image.height, limits)
        if kind == "bmp" and image.info.get("compression") == 0:
            _check_bmp(image, data)
        image.load()
        stream.close()  # some images would keep their file's bytes
    except (OSError, SyntaxError, ValueError, LookupError, TypeError, EOFError, struct.error, zlib.error) as error:
        reason = str(error) or type(error).__name__
        raise UnreadableFile(f"the {names[kind]} image is damaged or truncated: {reason}") from error
    return image


def encode_png(pixels: Bytes, *, flip: bool = False, palette: Bytes | None = None, table: bytes | None = None) -> bytes:
    """Encode uint8 [height, width] or [height, width, 1…4] (grey, grey + alpha, RGB, RGBA) as reproducible PNG.

    flip: the first row is the bottom one. palette: RGBA [256, 4], indexed by one-band pixels. table: 256 bytes that
    replace every byte first.
    """
    height, width = pixels.shape[:2]
    bands = 1 if pixels.ndim == 2 else pixels.shape[2]
    colour = 3 if palette is not None else {1: 0, 2: 4, 3: 2, 4: 6}[bands]
    out = io.BytesIO()  # getvalue returns its buffer without a copy
    out.write(PNG_MAGIC)
    out.write(_chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, colour, 0, 0, 0)))
    if palette is not None:
        out.write(_chunk(b"PLTE", palette[:, :3].tobytes()))
        out.write(_chunk(b"tRNS", palette[:, 3].tobytes()))
    # Grids are runs of few values: run-length matching is as fast as the fastest level, half the size, and needs only
    # filter 0.
    packer = zlib.compressobj(1, zlib.DEFLATED, 15, 9, zlib.Z_RLE if bands == 1 else zlib.Z_DEFAULT_STRATEGY)
    rows = max(1, STRIP // (width * bands))
    packed = _IdatWriter(out)
    for y in range(0, height, rows):
        end = min(height, y + rows)
        block = pixels[height - end : height - y][::-1] if flip else pixels[y:end]
        lines = np.zeros((end - y, 1 + width * bands), np.uint8)
        lines[:, 1:] = block.reshape(end - y, width * bands)
        if table is not None:
            lines[:, 1:] = apply_table(lines[:, 1:], table)
        packed.write(packer.compress(lines.data))
    packed.write(packer.flush())
    packed.close()
    out.write(_chunk(b"IEND", b""))
    return out.getvalue()


class _IdatWriter:
    """Writer of IDAT chunks of a PNG, up to 2^30 bytes each.

    It streams: the packed pixels may be as large as the image, and are in memory only once.
    """

    MOST = 2**30

    def __init__(self, out: io.BytesIO) -> None:
        self.out = out
        self.reserve_length()

    def reserve_length(self) -> None:
        """Reserve space for the length of a chunk."""
        self.size, self.sum = 0, zlib.crc32(b"IDAT")
        self.out.write(bytes(4) + b"IDAT")

    def write(self, packed: bytes) -> None:
        """Append packed pixels."""
        remainder = memoryview(packed)
        while remainder:
            if self.size == self.MOST:
                self.close()
                self.reserve_length()
            part = remainder[: self.MOST - self.size]
            self.out.write(part)
            self.size += len(part)
            self.sum = zlib.crc32(part, self.sum)
            remainder = remainder[len(part) :]

    def close(self) -> None:
        """Finish the chunk: append its checksum and insert its length."""
        self.out.write(struct.pack(">I", self.sum))
        self.out.seek(-12 - self.size, io.SEEK_END)
        self.out.write(struct.pack(">I", self.size))
        self.out.seek(0, io.SEEK_END)


def overlay_png(grid: OccupancyGrid) -> bytes:
    """Encode a grid as PNG overlay for a map: occupied black, free white, in between grey, unknown transparent.

    Row 0 is the map's top row. A grid with a yaw is not rotated; its corners describe the rotation.
    """
    palette = np.zeros((256, 4), np.uint8)
    palette[: OCCUPIED + 1, :3] = np.round(255 * (1 - np.arange(OCCUPIED + 1) / OCCUPIED))[:, None].astype(np.uint8)
    palette[:, 3] = 255
    palette[UNKNOWN] = 0
    return encode_png(grid.cells, flip=True, palette=palette)


def read_size(data: bytes, limits: Limits) -> tuple[int, int]:
    """Read (width, height) from the header only. Raises UnreadableFile or TooLarge."""
    kind = detect_kind(data)
    if kind == "pgm" and data[:2] in (b"P2", b"P5"):
        grey = _read_pgm(data, limits)
        return grey.width, grey.height
    names = {"png": "PNG", "jpeg": "JPEG", "bmp": "BMP", "pgm": "PPM"}
    if kind is None:
        raise UnreadableFile("unsupported image type: use PGM, PNG, BMP or JPEG")
    try:
        with Image.open(io.BytesIO(data), formats=[names[kind]]) as image:
            _check_size(image.width, image.height, limits)
            return image.width, image.height
    except (OSError, SyntaxError, ValueError, LookupError, TypeError, EOFError, struct.error, zlib.error) as error:
        raise UnreadableFile(f"the {names[kind]} image is damaged: {error}") from error


def apply_table(pixels: Bytes, table: bytes) -> Bytes:
    """Compute table[pixels] with bytes.translate, three times as fast as numpy's indexing. The result is read-only."""
    return np.frombuffer(pixels.tobytes().translate(table), np.uint8).reshape(pixels.shape)


def _check_size(width: int, height: int, limits: Limits) -> None:
    if width < 1 or height < 1:
        raise UnreadableFile(f"invalid image size: {width} × {height} pixels")
    if width * height > limits.pixels:
        raise TooLarge(
            f"the image declares {width} × {height} = {width * height} pixels; the limit is {limits.pixels} "
            "(FLEETMAP_MAX_PIXELS)"
        )


# --- PGM ----------------------------------------------------------------------------------------------------------
def _read_pgm(data: bytes, limits: Limits) -> Grey:
    """Read P2 and P5 by netpbm's rules: white space and comments between numbers, one white space before the pixels."""
    offset, numbers = 2, []
    for noun in ("width", "height", "highest value"):
        offset = _skip_white_space(data, offset)
        end = offset
        while end < offset + 10 and data[end : end + 1].isdigit():
            end += 1
        if end == offset or end == offset + 10:
            raise UnreadableFile(f"the PGM's {noun} is not a number of up to 9 digits (at byte {offset})")
        numbers.append(int(data[offset:end]))
        offset = end
    width, height, maximum = numbers
    if not 1 <= maximum <= 65535:
        raise UnreadableFile(f"the PGM's highest value is {maximum}; it must be 1 to 65535")
    _check_size(width, height, limits)
    if data[offset : offset + 1] not in (b" ", b"\t", b"\r", b"\n", b"\v", b"\f"):
        raise UnreadableFile("the PGM ends after its header" if offset >= len(data) else "the PGM's header is damaged")
    offset += 1
    count = width * height
    values: NDArray[np.integer]
    if data[:2] == b"P2":
        if len(data) > limits.text_bytes:
            raise TooLarge(f"the plain PGM has {len(data)} bytes; the limit is {limits.text_bytes}: save it as P5")
        values = _parse_plain_numbers(data[offset:], count)
    else:
        size = count * (1 if maximum < 256 else 2)
        if len(data) - offset < size:
            raise UnreadableFile(
                f"the PGM is truncated: {width} × {height} pixels are {size} bytes, it has {len(data) - offset}"
            )
        values = np.frombuffer(data, np.uint8 if maximum < 256 else ">u2", count, offset)
    rows = values.reshape(height, width)
    table = None if maximum == 255 else _scaling(maximum)

    def strips() -> Strips:
        step = max(1, STRIP // width)
        for y in range(0, height, step):
            block = rows[y : y + step]
            top = maximum if maximum in (255, 65535) and data[:2] == b"P5" else int(block.max())
            if top > maximum:
                raise UnreadableFile(f"the PGM has the value {top}, above its declared maximum {maximum}")
            yield y, (block.astype(np.uint8, copy=False) if table is None else table[block]), None

    return Grey(width, height, strips)


def _skip_white_space(data: bytes, offset: int) -> int:
    """Return the offset of the next byte that is neither white space nor in a comment."""
    while offset < len(data):
        if data[offset] == 0x23:
            ends = [end for end in (data.find(b"\n", offset), data.find(b"\r", offset)) if end >= 0]
            if not ends:
                return len(data)
            offset = min(ends)
        elif data[offset] not in b" \t\r\n\v\f":
            return offset
        else:
            offset += 1
    return offset


def _parse_plain_numbers(text: bytes, count: int) -> NDArray[np.int32]:
    """Parse the first ``count`` numbers of a P2's pixels; comments may be between them."""
    if len(text) < 2 * count - 1:
        raise UnreadableFile(f"the PGM is truncated: {count} pixels need more than {len(text)} characters")
    if b"#" in text:
        text = b"\n".join(line.partition(b"#")[0] for line in text.splitlines())
    stray = text.translate(None, b"0123456789 \t\r\n\v\f")
    if stray:
        raise UnreadableFile(f"the PGM's pixels must be whole numbers; found {stray[:20].decode('latin1')!r}")
    # Only digits and white space, and no number beyond 32 bits: fromstring reads to the end.
    if _LONG_NUMBER.search(text):
        raise UnreadableFile("the PGM has a pixel of more than 9 digits")
    # Without a count: fromstring returns uninitialised memory if the text has fewer numbers.
    values: NDArray[np.int32] = np.fromstring(text, np.int32, sep=" ") if text.strip() else np.empty(0, np.int32)
    if len(values) < count:
        raise UnreadableFile(f"the PGM is truncated: it has {len(values)} of {count} pixels")
    return values[:count]


def _scaling(maximum: int) -> Bytes:
    """Build the table from 0…maximum to 0…255 like GraphicsMagick: to 16 bits, then to 8, rounding twice."""
    value = np.minimum(np.arange(256 if maximum < 256 else 65536, dtype=np.int64), maximum)
    return (((65535 * value + maximum // 2) // maximum + 128) // 257).astype(np.uint8)


# --- images decoded by Pillow -------------------------------------------------------------------------------------
def _image_strips(image: Image.Image) -> Strips:
    width, height = image.size
    step = max(1, STRIP // width)
    clear = image.mode in ("LA", "RGBA", "PA", "La", "RGBa") or "transparency" in image.info
    for y in range(0, height, step):
        part = image.crop((0, y, width, min(height, y + step)))
        if image.mode.startswith("I"):
            deep = np.asarray(part).astype(np.uint32)
            see_through = image.info.get("transparency")
            opaque = deep != see_through if isinstance(see_through, int) else None
            yield y, ((deep + 128) // 257).astype(np.uint8), opaque
        elif not clear:
            yield y, np.asarray(part if part.mode == "L" else part.convert("L")), None
        else:
            yield y, *_grey_and_opaque(np.asarray(part.convert("RGBA")))


def _grey_and_opaque(rgba: Bytes) -> tuple[Bytes, NDArray[np.bool_]]:
    pixels = np.ascontiguousarray(rgba).view("<u4")[..., 0]
    opaque: NDArray[np.bool_] = pixels >= 0xFF000000
    red = pixels & 0xFF
    if bool(((pixels & 0xFFFFFF) == red * 0x010101).all()):
        return red.astype(np.uint8), opaque
    total = red * RED + ((pixels >> 8) & 0xFF) * GREEN + ((pixels >> 16) & 0xFF) * BLUE
    return ((total + 500_000) // 1_000_000).astype(np.uint8), opaque


def png_pixels(data: bytes, limits: Limits) -> Bytes | None:
    """Decode a PNG of 8-bit RGB, RGBA or grey + alpha to uint8 [height, width, bands]; None for any other image.

    Pillow needs 4 bytes per pixel for any number of bands. To bound memory by the result, it gets one strip of rows at
    a time, as a separate image that begins with the row before it. Raises UnreadableFile or TooLarge, as
    ``read_image``.
    """
    if detect_kind(data) != "png":
        return None
    chunks = _check_png(data, limits)
    width, height, depth, colour, _, _, interlaced = struct.unpack(">IIBBBBB", chunks[1][8:21])
    mode = {2: "RGB", 4: "LA", 6: "RGBA"}.get(colour)
    if mode is None or depth != 8 or interlaced or any(bytes(chunk[4:8]) == b"tRNS" for chunk in chunks[1:]):
        return None
    bands = len(mode)
    pixels = np.empty((height, width, bands), np.uint8)
    line, rows = 1 + width * bands, max(1, STRIP // width)
    packed = _inflate(chunk[8:-4] for chunk in chunks[1:] if bytes(chunk[4:8]) == b"IDAT")
    next(packed)
    before = bytes(line)
    try:
        for y in range(0, height, rows):
            end = min(height, y + rows)
            lines = packed.send((end - y) * line)
            if len(lines) < (end - y) * line:
                raise UnreadableFile("the PNG image is damaged or truncated: it has too few pixels")
            head = struct.pack(">IIBBBBB", width, 1 + end - y, 8, colour, 0, 0, 0)
            body = zlib.compress(before + lines, 0)
            strip = b"".join([PNG_MAGIC, _chunk(b"IHDR", head), _chunk(b"IDAT", body), _chunk(b"IEND", b"")])
            with Image.open(io.BytesIO(strip), formats=["PNG"]) as image:
                pixels[y:end] = np.asarray(image)[1:]
            before = b"\0" + pixels[end - 1].tobytes()
    except (OSError, SyntaxError, ValueError, EOFError, zlib.error) as error:
        raise UnreadableFile(f"the PNG image is damaged or truncated: {error}") from error
    return pixels


def _inflate(chunks: Iterator[memoryview]) -> Generator[bytes, int, None]:
    """Decompress a zlib stream: send the number of bytes to yield next (fewer at its end)."""
    unfold = zlib.decompressobj()
    pieces = (chunk[k : k + 2**14] for chunk in chunks for k in range(0, len(chunk), 2**14))
    remainder: bytes | memoryview = b""
    budget = yield b""
    while True:
        out = []
        while budget > 0 and not unfold.eof:
            # Without new input, output that did not fit before may remain.
            part = unfold.decompress(remainder, budget)
            remainder = unfold.unconsumed_tail
            if not part and not remainder:
                remainder = next(pieces, b"")
                if not remainder:
                    break
            out.append(part)
            budget -= len(part)
        budget = yield b"".join(out)


def _check_png(data: bytes, limits: Limits) -> list[memoryview]:
    """Check the PNG's signature and all checksums (Pillow skips IDAT's). Returns the chunks with pixels."""
    view = memoryview(data)
    offset, chunks, packed = 8, [view[:8]], 0
    width = height = depth = colour = 0
    palette = False
    while True:
        if offset + 12 > len(data):
            raise UnreadableFile("the PNG image is truncated")
        size = int.from_bytes(data[offset : offset + 4], "big")
        kind, end = data[offset + 4 : offset + 8], offset + 12 + size
        if end > len(data):
            raise UnreadableFile("the PNG image is truncated")
        if zlib.crc32(memoryview(data)[offset + 4 : end - 4]) != int.from_bytes(data[end - 4 : end], "big"):
            raise UnreadableFile(f"the PNG image is damaged: wrong checksum of its chunk {kind!r} at byte {offset}")
        if len(chunks) == 1:
            if kind != b"IHDR" or size != 13:
                raise UnreadableFile("the PNG image does not start with its header")
            width, height, depth, colour = struct.unpack(">IIBB", data[16:26])
            _check_size(width, height, limits)
        palette = palette or kind == b"PLTE"
        if kind in (b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND"):
            chunks.append(view[offset:end])
            packed += size if kind == b"IDAT" else 0
        elif not kind[0] & 0x20:
            raise UnreadableFile(f"the PNG image requires the unknown chunk {kind!r}")
        offset = end
        if kind == b"IEND":
            break
    if colour == 3 and not palette:
        raise UnreadableFile("the PNG image has no palette, which its pixels require")
    bits = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}.get(colour, 1) * depth
    if (width * bits // 8) * height > packed * DEFLATE_RATIO:
        raise UnreadableFile(f"the PNG image declares {width} × {height} pixels, too many for its {packed} bytes")
    return chunks


def _check_jpeg(data: bytes) -> None:
    """Check that a JPEG has few scans (each is a pass over the image) and an end (else it would be half grey)."""
    scans = data.count(b"\xff\xda")
    if scans > MAX_JPEG_SCANS:
        raise TooLarge(f"the JPEG image has {scans} scans; the limit is {MAX_JPEG_SCANS}")
    if data.find(b"\xff\xd9", max(2, data.rfind(b"\xff\xda"))) < 0:
        raise UnreadableFile("the JPEG image is truncated: its end is missing")


def _check_bmp(image: Image.Image, data: bytes) -> None:
    """Check that an uncompressed BMP contains its declared pixels."""
    bits = int.from_bytes(data[28:30], "little") if int.from_bytes(data[14:18], "little") >= 40 else 1
    size = ((image.width * bits + 31) // 32) * 4 * image.height
    if len(data) < size:
        raise UnreadableFile(
            f"the BMP image is truncated: {image.width} × {image.height} pixels are {size} bytes, it has {len(data)}"
        )


def _chunk(kind: bytes, body: bytes) -> bytes:
    return b"".join([struct.pack(">I", len(body)), kind, body, struct.pack(">I", zlib.crc32(body, zlib.crc32(kind)))])
