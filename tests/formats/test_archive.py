"""ZIP archives: safe ones are unpacked byte for byte, unsafe ones are refused before any file is written."""

from __future__ import annotations

import io
import stat
import struct
import unicodedata
import zipfile
import zlib
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.errors import BadUpload, TooLarge, UnreadableFile, UnsafeArchive
from app.formats import all_formats
from app.limits import Limits
from app.model.names import name_problem
from app.syntax import archives

FILES = {"doc.kml": b"<kml/>" * 50, "images/é.png": bytes(range(256)), "empty.txt": b"", "inner.zip": b""}
FILES["inner.zip"] = archives.pack({"a.txt": b"inside"})


def zipped(*members: tuple[str | zipfile.ZipInfo, bytes]) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, body in members:
            archive.writestr(name, body)
    return out.getvalue()


class Pipe(io.RawIOBase):
    """A target without seek, so that sizes follow the data."""

    def __init__(self) -> None:
        self.body = bytearray()

    def writable(self) -> bool:
        return True

    def write(self, data) -> int:
        self.body += data
        return len(data)


def with_mode(mode: int, name: str = "a") -> bytes:
    info = zipfile.ZipInfo(name)
    info.create_system = 3
    info.external_attr = mode << 16
    return zipped((info, b"/etc/passwd"))


def patched(data: bytes, mark: bytes, offset: int, new: bytes, occurrence: int = 0) -> bytes:
    """Patch bytes at this offset of the n-th header with this signature."""
    at = -1
    for _ in range(occurrence + 1):
        at = data.index(mark, at + 1)
    return data[: at + offset] + new + data[at + offset + len(new) :]


LOCAL, CENTRAL = b"PK\x03\x04", b"PK\x01\x02"


def renamed(name: bytes) -> bytes:
    """Build an archive with one member of this raw name in both headers."""
    return zipped(("x" * len(name), b"1")).replace(b"x" * len(name), name)


def test_packed_files_round_trip_and_bytes_are_deterministic():
    data = archives.pack(FILES, "doc.kml")
    assert archives.unpack(data, Limits()) == FILES
    assert list(archives.unpack(data, Limits())) == ["doc.kml", "empty.txt", "images/é.png", "inner.zip"]
    assert data == archives.pack(dict(reversed(FILES.items())), "doc.kml")
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        assert archive.testzip() is None
        assert archive.namelist()[0] == "doc.kml"
        assert {i.date_time for i in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}


def test_archives_of_other_packers_are_read():
    pipe = Pipe()
    with zipfile.ZipFile(pipe, "w", zipfile.ZIP_DEFLATED) as archive:  # sizes in data descriptors
        archive.writestr("a.txt", b"a" * 1000)
        archive.mkdir("folder")
        with archive.open("folder/b.txt", "w", force_zip64=True) as member:
            member.write(b"b" * 10)
        archive.comment = b"a comment with PK\x05\x06 in it"
    assert archives.unpack(bytes(pipe.body), Limits()) == {"a.txt": b"a" * 1000, "folder/b.txt": b"b" * 10}
    assert archives.unpack(zipped(), Limits()) == {}


def test_unflagged_name_is_utf8_from_unix_and_cp437_from_dos():
    raw = "é.txt".encode()
    unix = renamed(raw)
    assert list(archives.unpack(unix, Limits())) == ["é.txt"]
    dos = patched(unix, CENTRAL, 5, b"\x00")
    assert list(archives.unpack(dos, Limits())) == [raw.decode("cp437")]


@pytest.mark.parametrize(
    ("why", "data"),
    {
        "link": with_mode(stat.S_IFLNK | 0o777),
        "device": with_mode(stat.S_IFCHR | 0o666),
        "fifo": with_mode(stat.S_IFIFO | 0o666),
        "folder in disguise": with_mode(stat.S_IFDIR | 0o755),
        "file called a folder": with_mode(stat.S_IFREG | 0o644, "a/"),
        "folder with content": zipped(("a/", b"x")),
        "up": zipped(("../a", b"1")),
        "up inside": zipped(("a/../../b", b"1")),
        "dot": zipped(("a/./b", b"1")),
        "empty folder name": zipped(("a//b", b"1")),
        "absolute": zipped(("/a", b"1")),
        "drive": zipped(("c:a", b"1")),
        "backslash": renamed(b"a\\b"),
        "control": renamed(b"a\nb"),
        "escape": renamed(b"a\x1bb"),
        "nul": renamed(b"a\x00b"),
        "only a slash": renamed(b"/"),
        "not utf-8": patched(patched(renamed(b"a\xffb"), LOCAL, 6, b"\x00\x08"), CENTRAL, 8, b"\x00\x08"),
        "too deep": zipped(("a/" * 70 + "b", b"1")),
        "too long": zipped(("a" * 1025, b"1")),
        "case": zipped(("A.txt", b"1"), ("a.TXT", b"2")),
        "normal form": zipped(("é", b"1"), (unicodedata.normalize("NFD", "é"), b"2")),
        "file and folder": zipped(("a", b"1"), ("A/b", b"2")),
        "other name": patched(zipped(("a", b"1")), LOCAL, 30, b"b"),
        "other method": patched(zipped(("a", b"1" * 99)), LOCAL, 8, b"\x00\x00"),
        "other flags": patched(zipped(("a", b"1" * 99)), LOCAL, 6, b"\x02\x00"),
        "other checksum": patched(zipped(("a", b"1" * 99)), LOCAL, 14, b"abcd"),
        "other size": patched(zipped(("a", b"1" * 99)), LOCAL, 22, struct.pack("<L", 98)),
        "encrypted": patched(patched(zipped(("a", b"1")), LOCAL, 6, b"\x01"), CENTRAL, 8, b"\x01"),
        "place of another": patched(zipped(("a", b"1" * 99), ("b", b"1" * 99)), CENTRAL, 42, b"\0\0\0\0", 1),
    }.items(),
)
def test_unsafe_archives_are_refused(why: str, data: bytes):
    with pytest.raises(UnsafeArchive) as caught:
        archives.unpack(data, Limits())
    assert caught.value.problems, why


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_duplicate_name_is_refused():
    with pytest.raises(UnsafeArchive, match="same name as another member"):
        archives.unpack(zipped(("a", b"1"), ("a", b"2")), Limits())


def test_overlapping_members_are_refused():
    """One member inside another one's data, as in self-quoting bombs."""
    inner = zipped(("b", b"2" * 10))
    stored = zipfile.ZipInfo("a")
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr(stored, inner)
    outer = out.getvalue()
    at = outer.index(LOCAL, 1)
    start = outer.rindex(CENTRAL)
    entry = inner[inner.index(CENTRAL) : inner.index(b"PK\x05\x06")]
    entry = entry[:42] + struct.pack("<L", at) + entry[46:]
    directory = outer[start : outer.rindex(b"PK\x05\x06")] + entry
    end = struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, 2, 2, len(directory), start, 0)
    with pytest.raises(UnsafeArchive, match="shares its bytes"):
        archives.unpack(outer[:start] + directory + end, Limits())


def with_declared_size(declared: int) -> bytes:
    """Build a member of a million zeros that declares another size in both headers."""
    data = zipped(("a", bytes(1_000_000)))
    size = struct.pack("<L", declared)
    return patched(patched(data, LOCAL, 22, size), CENTRAL, 24, size)


def test_unpacked_bytes_are_counted_not_declared_ones():
    with pytest.raises(UnsafeArchive, match="more than its declared 1000 bytes"):
        archives.unpack(with_declared_size(1000), Limits())
    with pytest.raises(UnsafeArchive, match="differs from its declared size"):
        archives.unpack(with_declared_size(2_000_000), Limits())
    with pytest.raises(TooLarge):
        archives.unpack(with_declared_size(0xFFFFFFFE), Limits())
    with pytest.raises(TooLarge):
        archives.unpack(zipped(("a", bytes(1001))), Limits(unpacked_bytes=1000))
    with pytest.raises(TooLarge, match="members"):
        archives.unpack(zipped(("a", b""), ("b", b"")), Limits(files=1))


def test_ten_gigabytes_declared_in_a_kilobyte_are_refused_at_once():
    data = zipped(("a", bytes(1000)))
    extra = struct.pack("<HHQ", 1, 8, 10 * 2**30)
    at, end = data.index(CENTRAL), data.index(b"PK\x05\x06")
    entry = data[at:end]
    entry = entry[:24] + b"\xff\xff\xff\xff" + entry[28:30] + struct.pack("<H", len(extra)) + entry[32:] + extra
    tail = struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, 1, 1, len(entry), at, 0)
    with pytest.raises(TooLarge, match=str(10 * 2**30)):
        archives.unpack(data[:at] + entry + tail, Limits())


@pytest.mark.parametrize("kind", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_other_compressions_are_refused_with_a_reason(kind: int):
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", kind) as archive:
        archive.writestr("a", b"1" * 100)
    with pytest.raises(UnreadableFile, match="method"):
        archives.unpack(out.getvalue(), Limits())


def test_wrong_checksum_is_refused():
    data = zipped(("a", b"1" * 99))
    wrong = struct.pack("<L", zlib.crc32(b"2"))
    with pytest.raises(UnreadableFile, match="checksum"):
        archives.unpack(patched(patched(data, LOCAL, 14, wrong), CENTRAL, 16, wrong), Limits())


def test_every_truncation_is_refused():
    data = archives.pack(FILES, "doc.kml")
    for length in range(len(data)):
        with pytest.raises(BadUpload):
            archives.unpack(data[:length], Limits())


@given(st.data())
def test_mutated_archive_is_refused_or_within_limits(data):
    body = bytearray(archives.pack(FILES, "doc.kml"))
    for _ in range(data.draw(st.integers(1, 4))):
        body[data.draw(st.integers(0, len(body) - 1))] = data.draw(st.integers(0, 255))
    try:
        out = archives.unpack(bytes(body), Limits(unpacked_bytes=10**6))
    except BadUpload:
        return
    assert sum(map(len, out.values())) <= 10**6
    assert all(name_problem(n) is None for n in out)


@pytest.mark.parametrize("name", ["../a", "/a", "a\\b", "a/", "", "a\nb"])
def test_unusable_names_are_not_packed(name: str):
    with pytest.raises(ValueError, match="invalid name in an archive"):
        archives.pack({name: b""})


def test_large_members_round_trip():
    """More than one piece of input and output, also if the packed data ends long before its output."""
    files = {"zeros": bytes(5_000_000), "noise": bytes(range(256)) * 20_000, "ones": b"1" * (2**20)}
    assert archives.unpack(archives.pack(files), Limits()) == files


BINARY = (".zip", ".kmz", ".gz", ".bz2", ".pbf", ".bt", ".ot", ".las", ".laz", ".pcd", ".ply", ".shp", ".gpkg", ".fgb")


def test_text_limits_apply_to_files_of_all_formats():
    endings = {end for fmt in all_formats().values() for end in fmt.extensions}
    texts = sorted(end for end in endings if not end.endswith((*BINARY, *archives._IMAGES)))
    assert ".site.ron" in texts
    for end in texts:
        with pytest.raises(TooLarge, match="for a text of"):
            archives.unpack(zipped((f"map{end}", bytes(17 * 2**20))), Limits())


BUILDERS: list[Callable[[], bytes]] = [lambda: b"", lambda: b"PK", lambda: b"PK\x05\x06" + bytes(17), lambda: b"<kml/>"]


@pytest.mark.parametrize("build", BUILDERS)
def test_non_archive_is_unreadable(build: Callable[[], bytes]):
    with pytest.raises(UnreadableFile):
        archives.unpack(build(), Limits())


def test_packed_uniform_files_are_accepted(monkeypatch: pytest.MonkeyPatch):
    array, text = "config/fleet_map/0.bin", "config/fleet_map/content.json"
    packed = archives.pack({array: bytes(20_000_000)})
    assert len(packed) < 100_000
    assert len(archives.unpack(packed, Limits())[array]) == 20_000_000
    with pytest.raises(TooLarge):
        archives.unpack(zipped(("elsewhere/0.bin", bytes(20_000_000))), Limits())
    for files in (
        {text: b'{"kind":"wall"},' * 1_200_000},
        {f"{k}.osm": bytes(6_000_000) for k in range(4)},
        {array: bytes(9_000_000), text: bytes(9_000_000), "map.dae": bytes(9_000_000)},
    ):
        assert archives.unpack(archives.pack(files), Limits()) == files
    few = Limits(pixels=2**20)
    monkeypatch.setattr(archives, "_LIMITS", few)
    grids = {f"{k}.pgm": bytes(400_000) for k in range(4)}
    packed = archives.pack(grids)
    assert archives.unpack(packed, few) == grids
    assert len(packed) < 1_300_000
