"""Decompression bombs are rejected early, with little memory and time."""

from __future__ import annotations

import bz2
import gzip
import io
import struct
import time
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from app import upload_reader
from app.errors import BadUpload, TooLarge
from app.formats import ReadContext, get_format
from app.limits import UNPACKED_FREE_BYTES, Limits
from app.pool import Pool
from app.upload_reader import EnvironmentContext, UploadHints
from tests.hostile.corpus import KML, ROOM, SAMPLES, zipped

MEMORY_BYTES = 400 * 2**20
CPU_SECONDS = 10.0
UNFOLDED_BYTES = 32 * 2**20


def measured_upload(path: str) -> tuple[str, int, float]:
    """Read a file as an upload (in a worker); return the error class, the growth of peak memory, the CPU time."""
    before, start = _peak_bytes(), time.process_time()
    data = Path(path).read_bytes()
    try:
        upload_reader.read(
            upload_reader.unpack({Path(path).name: data}, Limits()), UploadHints(), EnvironmentContext(), Limits()
        )
    except BadUpload as error:
        result = type(error).__name__
        assert all(p.problem and p.file for p in error.problems), error.problems
    else:
        result = "read"
    return result, _peak_bytes() - before, time.process_time() - start


def _peak_bytes() -> int:
    status = Path("/proc/self/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0]) * 1024


def bomb(name: str, size: int, more: dict[str, bytes] | None = None) -> bytes:
    """Build an archive with one member of this many zero bytes, without having them in memory."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for other, body in (more or {}).items():
            archive.writestr(other, body)
        info = zipfile.ZipInfo(name)
        info.compress_type = zipfile.ZIP_DEFLATED
        with archive.open(info, "w") as member:
            for _ in range(size // 2**20):
                member.write(bytes(2**20))
    return out.getvalue()


DOCUMENT = KML.format(name="x", at="7,50").encode()


def uploads() -> Iterator[tuple[str, bytes]]:
    yield "document.kmz", bomb("doc.kml", UNFOLDED_BYTES)
    yield "source.kmz", bomb("notes.bin", UNFOLDED_BYTES, {"doc.kml": DOCUMENT})
    yield "folder.zip", bomb("data/table.csv", UNFOLDED_BYTES, {"doc.kml": DOCUMENT})
    yield (
        "package.zip",
        bomb("config/world/poi.csv", UNFOLDED_BYTES, {"config/location/datum.yaml": b"datum_latitude: 1\n"}),
    )
    yield "plans.zip", zipped({"room.yaml": ROOM, **{f"{k}.pgm": bytes(2**20) for k in range(280)}})
    yield "extract.osm.gz", gzip.compress(b"<osm>" + bytes(UNFOLDED_BYTES), 9)
    yield "extract.osm.bz2", bz2.compress(b"<osm>" + bytes(UNFOLDED_BYTES))


@pytest.fixture(scope="module")
def worker() -> Iterator[Pool]:
    pool = Pool(1, warm=("app.upload_reader", "tests.hostile.test_decompression"))
    yield pool
    pool.close()


def test_decompression_bombs_are_rejected_with_little_memory(worker: Pool, tmp_path: Path) -> None:
    for name, data in uploads():
        path = tmp_path / name
        path.write_bytes(data)
        result, memory, seconds = worker.run(measured_upload, str(path))
        assert result == "TooLarge", name
        assert memory < MEMORY_BYTES, f"{name}: {memory} bytes"
        assert seconds < CPU_SECONDS, f"{name}: {seconds} s"


def test_small_archives_may_compress_well() -> None:
    body = b"0" * (UNPACKED_FREE_BYTES - len(DOCUMENT))
    assert len(upload_reader.unpack({"a.zip": zipped({"doc.kml": DOCUMENT, "a.txt": body})}, Limits())) == 2


def test_empty_image_may_compress_better_than_text() -> None:
    blank = bytes(2 * UNPACKED_FREE_BYTES)
    limits = Limits(pixels=len(blank))
    assert upload_reader.unpack({"a.zip": zipped({"blank.pgm": blank})}, limits)["blank.pgm"] == blank
    for files in ({"blank.txt": blank}, {"a.pgm": blank, "b.pgm": b"0"}):
        with pytest.raises(TooLarge):
            upload_reader.unpack({"a.zip": zipped(files)}, limits)


def test_text_in_an_archive_has_the_limit_of_text() -> None:
    with pytest.raises(
        TooLarge, match=r"doc\.kml: declares \d+ bytes; the limit for a text of \d+ compressed bytes is 50"
    ) as caught:
        upload_reader.unpack({"a.zip": zipped({"doc.kml": DOCUMENT})}, Limits(text_bytes=50))
    assert [(p.file, p.where) for p in caught.value.problems] == [("a.zip", "doc.kml")]


def test_compressed_points_are_limited_by_the_ratio() -> None:
    spiral = (SAMPLES / "las" / "spiral.laz").read_bytes()
    count = 20_000_000
    lie = bytearray(spiral)
    struct.pack_into("<Q", lie, 247, count)
    with pytest.raises(TooLarge, match="bytes decompress to more than the limit of 16777216 bytes"):
        _read("las", "a.laz", bytes(lie))
    packed = (
        b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH %d\nHEIGHT 1\nPOINTS %d\nDATA binary_compressed\n"
    )
    packed = packed % (count, count) + struct.pack("<II", 100, 12 * count) + bytes(100)
    with pytest.raises(TooLarge, match="100 bytes decompress to more than the limit of 16777216 bytes"):
        _read("pcd", "a.pcd", b"VERSION .7\n" + packed)


def _read(name: str, file: str, data: bytes) -> Any:
    fmt = get_format(name)
    assert fmt.read is not None
    return fmt.read({file: data}, ReadContext(main=file))
