"""Images: decoding equals Pillow's, damaged files and false headers are refused, PNG is written correctly."""

from __future__ import annotations

import io
import random
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from app.errors import BadUpload, TooLarge, UnreadableFile
from app.limits import Limits
from app.model.grid import OccupancyGrid
from app.syntax import images

LIMITS = Limits()
RANDOM = np.random.default_rng(7)
SHADES = RANDOM.integers(0, 256, (37, 53), np.uint8)
COLOURS = RANDOM.integers(0, 256, (37, 53, 3), np.uint8)


def saved(image: Image.Image, kind: str, **options: Any) -> bytes:
    out = io.BytesIO()
    image.save(out, kind, **options)
    return out.getvalue()


def grey(data: bytes) -> np.ndarray:
    return images.read_grey(data, LIMITS).pixels()[0]


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png(width: int, height: int, packed: bytes, depth: int = 8, colour: int = 0, extra: bytes = b"") -> bytes:
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0))
    return images.PNG_MAGIC + header + extra + chunk(b"IDAT", packed) + chunk(b"IEND", b"")


def pictures() -> dict[str, bytes]:
    """Return one image of each kind, all 53 × 37."""
    grey8, rgb = Image.fromarray(SHADES), Image.fromarray(COLOURS)
    rgba = rgb.convert("RGBA")
    rgba.putalpha(Image.fromarray(np.where(SHADES > 128, 255, SHADES).astype(np.uint8)))
    la = grey8.convert("LA")
    la.putalpha(Image.fromarray(np.where(SHADES[::-1] > 60, 255, 0).astype(np.uint8)))
    palette = rgb.quantize(17)
    deep = Image.fromarray(RANDOM.integers(0, 65536, SHADES.shape).astype(np.uint16))
    return {
        "L.png": saved(grey8, "png"),
        "RGB.png": saved(rgb, "png"),
        "RGBA.png": saved(rgba, "png"),
        "LA.png": saved(la, "png"),
        "P.png": saved(palette, "png"),
        "P transparent.png": saved(palette, "png", transparency=3),
        "L transparent.png": saved(Image.fromarray(SHADES // 16), "png", transparency=5),
        "1.png": saved(grey8.convert("1"), "png"),
        "I;16.png": saved(deep, "png"),
        "L.pgm": saved(grey8, "ppm"),
        "RGB.ppm": saved(rgb, "ppm"),
        "1.pbm": saved(grey8.convert("1"), "ppm"),
        "L.bmp": saved(grey8, "bmp"),
        "RGB.bmp": saved(rgb, "bmp"),
        "1.bmp": saved(grey8.convert("1"), "bmp"),
        "L.jpg": saved(grey8, "jpeg"),
        "RGB.jpg": saved(rgb, "jpeg"),
        "progressive.jpg": saved(rgb, "jpeg", progressive=True),
    }


@pytest.mark.parametrize("name", pictures())
def test_every_image_kind_matches_independent_reader(name: str, facts: Any) -> None:
    data = pictures()[name]
    shades, opaque = images.read_grey(data, LIMITS).pixels()
    expected, alpha = facts.grey(Image.open(io.BytesIO(data)))
    # Ties of a coloured pixel's weighted sum fall on either side.
    assert np.abs(shades.astype(int) - expected).max() <= (1 if alpha is not None else 0)
    assert (shades != expected).mean() < 1e-3
    if alpha is None:
        assert opaque is None or opaque.all()
    else:
        assert opaque is not None
        assert (opaque == (alpha == 255)).all()
        assert not opaque.all()


def test_deep_grey_png_with_transparent_value_is_read() -> None:
    rows = np.array([[0, 257, 65535]], ">u2")
    packed = zlib.compress(b"\0" + rows.tobytes())
    data = png(3, 1, packed, depth=16, extra=chunk(b"tRNS", struct.pack(">H", 257)))
    shades, opaque = images.read_grey(data, LIMITS).pixels()
    assert shades.tolist() == [[0, 1, 255]]
    assert opaque is not None
    assert opaque.tolist() == [[True, False, True]]


@pytest.mark.parametrize("most", [1, 2, 3, 7, 15, 100, 127, 254, 255, 256, 1000, 4095, 65535])
@pytest.mark.parametrize("magic", ["P2", "P5"])
def test_pgm_of_any_depth_is_read(magic: str, most: int, facts: Any) -> None:
    values = np.unique(np.linspace(0, most, 300).astype(int))
    header = f"{magic}\n# made by a test\n{len(values)} 1 #width\n# and\r\n\t{most}\n".encode()
    body = (
        " ".join(map(str, values)).encode() if magic == "P2" else values.astype(">u2" if most > 255 else "u1").tobytes()
    )
    data = header + body
    expected, _ = facts.grey(Image.open(io.BytesIO(data)))
    # Where 255 v / most ends in .5 the reader that the facts come from rounds to even, GraphicsMagick up.
    assert np.abs(grey(data).astype(int) - expected).max() <= 1
    assert (grey(data) != expected).mean() < 0.05
    assert grey(data)[0].tolist() == [(int(65535 * int(v) / most + 0.5) + 128) // 257 for v in values]
    assert grey(data)[0, 0] == 0
    assert grey(data)[0, -1] == 255


def test_plain_and_binary_pgm_are_equal(shared: Path) -> None:
    folder = shared / "data/occupancy_grid/joctomap_ecmr"
    plain, binary = (grey((folder / f"ecmr_{n}.pgm").read_bytes()) for n in ("ascii", "binary"))
    assert plain.shape == (473, 504)
    assert (plain == binary).all()


def test_plain_pgm_with_comments_is_read() -> None:
    assert grey(b"P2 # x\n2 2 255\n1 2 # 9 9\n3# 7\n 4\n").tolist() == [[1, 2], [3, 4]]


def test_pgm_reader_ignores_data_after_pixels() -> None:
    assert grey(b"P5 2 1 255\n\x01\x02P5 1 1 255\n\x03").tolist() == [[1, 2]]
    assert grey(b"P2 2 1 255\n1 2 3 4").tolist() == [[1, 2]]


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "unsupported image type"),
        (b"GIF89a", "unsupported image type"),
        (b"P9 1 1 255\n", "unsupported image type"),
        (b"P1 1 1\n0", "PBM and PPM"),
        (b"P5 ", "width"),
        (b"P5 2", "height"),
        (b"P5 2 2", "highest value"),
        (b"P5 2 2 255", "ends after its header"),
        (b"P5 2 2 255x....", "damaged"),
        (b"P5 2 2 255\n...", "truncated"),
        (b"P5 2 2 0\n....", "highest value is 0"),
        (b"P5 2 2 65536\n........", "highest value is 65536"),
        (b"P5 0 2 255\n", "0 × 2"),
        (b"P5 -1 2 255\n", "width"),
        (b"P5 1 1 100\n\xff", "above its declared maximum"),
        (b"P2 1 1 255\n256", "above its declared maximum"),
        (b"P2 2 1 255\n1", "truncated"),
        (b"P2 2 1 255\n1 # 2 3 4", "truncated"),
        (b"P2 2 1 255\n1 -2", "whole numbers"),
        (b"P2 2 1 255\n1 4294967298", "9 digits"),
        (b"P5 1" + b"0" * 5000, "width"),
        (b"P5 2 2 # no end" + b" " * 100, "highest value"),
        (b"BM" + b"\0" * 60, "damaged"),
        (b"\xff\xd8\xff\xe0", "truncated"),
    ],
)
def test_bad_images_are_refused_with_reason(data: bytes, reason: str) -> None:
    with pytest.raises(UnreadableFile, match=reason):
        grey(data)


@pytest.mark.parametrize(
    "data",
    [
        b"P5 100000 100000 255\n" + b"\0" * 1000,
        b"P2 999999999 999999999 255\n0",
        png(100_000, 100_000, zlib.compress(b"\0" * 1000)),
        png(2**31 - 1, 2**31 - 1, b""),
        saved(Image.fromarray(SHADES), "bmp")[:18] + struct.pack("<ii", 10**5, 10**5) + b"\x01\0\x08\0" + b"\0" * 1000,
    ],
    ids=["P5", "P2", "PNG", "largest PNG", "BMP"],
)
def test_ten_gigabytes_in_a_kilobyte_are_refused_before_decoding(data: bytes) -> None:
    tracemalloc.start()
    try:
        with pytest.raises(TooLarge, match="limit is"):
            images.read_grey(data, LIMITS).pixels()
        assert tracemalloc.get_traced_memory()[1] < 10 * 2**20
    finally:
        tracemalloc.stop()


def test_size_beyond_data_is_refused_before_decoding() -> None:
    with pytest.raises(UnreadableFile, match="too many for its"):
        grey(png(16_000, 16_000, zlib.compress(b"\0" * 10_000)))


def test_compressed_bomb_is_inflated_to_declared_size_only() -> None:
    packer = zlib.compressobj(9)
    packed = b"".join([packer.compress(bytes(2**20)) for _ in range(570)] + [packer.flush()])
    assert len(packed) < 600_000
    assert grey(png(10, 10, packed)).tolist() == [[0] * 10] * 10  # what follows the last row is never unfolded
    with pytest.raises(TooLarge):
        images.read_grey(png(23_875, 25_000, packed), LIMITS)


def test_text_and_profile_bombs_are_skipped() -> None:
    bomb = zlib.compress(bytes(200 * 2**20))
    extra = chunk(b"zTXt", b"a\0\0" + bomb) + chunk(b"iCCP", b"a\0\0" + bomb)
    assert grey(png(1, 1, zlib.compress(b"\0\7"), extra=extra)).tolist() == [[7]]


def test_jpeg_with_many_scans_is_refused() -> None:
    data = pictures()["progressive.jpg"]
    start = data.index(b"\xff\xda")
    scan = data[start : data.index(b"\xff", start + 2)]
    with pytest.raises(TooLarge, match="scans"):
        grey(data[:-2] + scan * 80 + data[-2:])


def test_unknown_critical_chunk_and_late_header_are_refused() -> None:
    with pytest.raises(UnreadableFile, match="unknown chunk"):
        grey(png(1, 1, zlib.compress(b"\0\7"), extra=chunk(b"ABCD", b"")))
    with pytest.raises(UnreadableFile, match="start with its header"):
        grey(images.PNG_MAGIC + chunk(b"IDAT", b"") + chunk(b"IEND", b""))


@pytest.mark.parametrize("name", pictures())
def test_truncated_image_is_refused_or_complete(name: str) -> None:
    data = pictures()[name]
    original, opaque = images.read_grey(data, LIMITS).pixels()
    refused = 0
    for end in sorted({*range(0, len(data), max(1, len(data) // 60)), *range(max(0, len(data) - 20), len(data))}):
        try:
            cut, clear = images.read_grey(data[:end], LIMITS).pixels()
        except BadUpload:
            refused += 1
        else:
            assert (cut == original).all()
            assert (clear is None) == (opaque is None)
    assert refused > 50


@pytest.mark.parametrize("name", pictures())
def test_flipped_bit_never_crashes_or_changes_png_pixels(name: str) -> None:
    data = pictures()[name]
    original = grey(data)
    dice = random.Random(name)
    for _ in range(60):
        damaged = bytearray(data)
        damaged[dice.randrange(len(damaged))] ^= 1 << dice.randrange(8)
        try:
            shades = grey(bytes(damaged))
        except BadUpload:
            continue
        if name.endswith(".png"):
            assert (shades == original).all()  # every byte of a chunk is under its checksum


@given(
    st.binary(max_size=300),
    st.sampled_from([b"", b"P5 ", b"P2 ", b"P5 3 3 255\n", images.PNG_MAGIC, b"BM", b"\xff\xd8\xff"]),
)
def test_any_bytes_are_refused_or_read(body: bytes, head: bytes) -> None:
    try:
        image = images.read_grey(head + body, Limits(pixels=10_000))
        shades, _ = image.pixels()
    except BadUpload:
        return
    assert shades.shape == (image.height, image.width)


@pytest.mark.parametrize("bands", [1, 2, 3, 4])
@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize("shape", [(1, 1), (3, 5), (1200, 700)])
def test_written_png_reads_back(bands: int, flip: bool, shape: tuple[int, int]) -> None:
    pixels = RANDOM.integers(0, 256, (*shape, bands), np.uint8)
    pixels = pixels[..., 0] if bands == 1 else pixels
    data = images.encode_png(pixels, flip=flip)
    assert data == images.encode_png(pixels.copy(), flip=flip)
    image = Image.open(io.BytesIO(data))
    assert image.mode == {1: "L", 2: "LA", 3: "RGB", 4: "RGBA"}[bands]
    assert (np.asarray(image) == (pixels[::-1] if flip else pixels)).all()
    assert (np.asarray(images.read_image(data, LIMITS)) == np.asarray(image)).all()


def test_lookup_table_is_applied_when_writing_png() -> None:
    table = bytes(255 - v for v in range(256))
    data = images.encode_png(SHADES, table=table)
    assert (np.asarray(Image.open(io.BytesIO(data))) == 255 - SHADES).all()
    assert (images.apply_table(SHADES, table) == 255 - SHADES).all()


def test_png_of_cells_has_the_top_row_on_top() -> None:
    cells = np.array([[0, 100, 255], [1, 2, 3]], np.uint8)
    image = Image.open(io.BytesIO(images.encode_png(cells, flip=True)))
    assert image.mode == "L"
    assert np.asarray(image).tolist() == [[1, 2, 3], [0, 100, 255]]


def test_overlay_png_is_black_white_and_transparent() -> None:
    grid = OccupancyGrid(np.array([[0, 100, 255], [50, 0, 0]], np.uint8), 0.05)
    image = Image.open(io.BytesIO(images.overlay_png(grid))).convert("RGBA")
    assert np.asarray(image).tolist() == [
        [[128, 128, 128, 255], [255, 255, 255, 255], [255, 255, 255, 255]],
        [[255, 255, 255, 255], [0, 0, 0, 255], [0, 0, 0, 0]],
    ]


def test_png_writing_memory_stays_near_output_size() -> None:
    cells = np.zeros((4000, 4000), np.uint8)
    cells.flags.writeable = False
    tracemalloc.start()
    try:
        images.encode_png(cells, flip=True)
        assert tracemalloc.get_traced_memory()[1] < cells.nbytes
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("make", [lambda d: d, bytes.lower])
def test_image_kind_is_detected_by_content(make: Callable[[bytes], bytes]) -> None:
    kinds = {name: images.detect_kind(data) for name, data in pictures().items()}
    ends = {"png": "png", "pgm": "pgm", "ppm": "pgm", "pbm": "pgm", "bmp": "bmp", "jpg": "jpeg"}
    assert all(kind == ends[name.rpartition(".")[2]] for name, kind in kinds.items())
    assert images.detect_kind(make(b"Plain text")) is None


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "LA"])
@pytest.mark.parametrize("shape", [(37, 53), (3000, 301), (1, 1)])
def test_coloured_png_in_strips_matches_pillow(mode: str, shape: tuple[int, int]) -> None:
    dice = np.random.default_rng(3)
    hills = np.add.outer(np.arange(shape[0]), np.arange(shape[1]))[..., None] // 3 + np.arange(len(mode)) * 40
    pixels = (hills + dice.integers(0, 3, hills.shape)).astype(np.uint8)  # so that Pillow takes each of PNG's filters
    data = saved(Image.fromarray(pixels, mode), "png")
    decoded_pixels = images.png_pixels(data, LIMITS)
    assert decoded_pixels is not None
    assert decoded_pixels.dtype == np.uint8
    assert np.array_equal(decoded_pixels, pixels)


def test_png_filters_and_many_small_chunks_are_read() -> None:
    """Filters of the PNG specification (RFC 2083, 6), computed by hand: each row results from the one before."""
    width, bands = 2, 3
    rows = [
        bytes([0, 1, 2, 3, 4, 5, 6]),
        bytes([1, 10, 10, 10, 1, 1, 1]),  # sub: left
        bytes([2, 1, 1, 1, 1, 1, 1]),  # up
        bytes([3, 1, 1, 1, 1, 1, 1]),  # half of left and up
        bytes([4, 1, 1, 1, 1, 1, 1]),  # Paeth
    ]
    packed = zlib.compress(b"".join(rows))
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, len(rows), 8, 2, 0, 0, 0))
    small = b"".join(chunk(b"IDAT", packed[k : k + 3]) for k in range(0, len(packed), 3))
    decoded_pixels = images.png_pixels(images.PNG_MAGIC + header + small + chunk(b"IEND", b""), LIMITS)
    assert decoded_pixels is not None
    assert decoded_pixels.reshape(len(rows), width * bands).tolist() == [
        [1, 2, 3, 4, 5, 6],
        [10, 10, 10, 11, 11, 11],
        [11, 11, 11, 12, 12, 12],
        [6, 6, 6, 10, 10, 10],
        [7, 7, 7, 11, 11, 11],
    ]


@pytest.mark.parametrize("name", ["L.png", "P.png", "1.png", "I;16.png", "RGB clear.png"])
def test_png_kinds_without_own_decoder_are_left_to_pillow(name: str) -> None:
    makers = {"L.png": "L", "P.png": "P", "1.png": "1", "I;16.png": "I;16", "RGB clear.png": "RGB"}
    more = {"transparency": (1, 2, 3)} if "clear" in name else {}
    assert images.png_pixels(saved(Image.new(makers[name], (5, 4)), "png", **more), LIMITS) is None


def test_truncated_coloured_png_is_refused() -> None:
    short = png(2, 3, zlib.compress(b"\0" * 14), colour=2)  # 21 bytes are three rows
    with pytest.raises(UnreadableFile, match="too few pixels"):
        images.png_pixels(short, LIMITS)
    with pytest.raises(UnreadableFile, match="damaged"):
        images.png_pixels(png(2, 3, b"no zlib at all", colour=2), LIMITS)
    with pytest.raises(UnreadableFile, match="damaged"):
        images.png_pixels(png(2, 3, zlib.compress(b"\x09" * 21), colour=2), LIMITS)


def test_long_compressed_pixels_span_several_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    original = images.encode_png(COLOURS)
    monkeypatch.setattr(images._IdatWriter, "MOST", 1000)
    parted = images.encode_png(COLOURS)
    assert parted.count(b"IDAT") == -(-original.index(b"IEND") // 1000) > original.count(b"IDAT") == 1
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(parted))), COLOURS)


def test_coloured_png_reading_memory_stays_near_pixel_size() -> None:
    data = saved(Image.fromarray(RANDOM.integers(0, 256, (3000, 2000, 3), np.uint8)), "png")
    tracemalloc.start()
    try:
        decoded_pixels = images.png_pixels(data, LIMITS)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert decoded_pixels is not None
    assert peak < 1.5 * decoded_pixels.nbytes
