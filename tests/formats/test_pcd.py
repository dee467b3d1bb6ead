"""pcd: real clouds round-trip in every encoding and match facts, voxels contain every point, hostile bytes."""

from __future__ import annotations

import math
import random
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app import formats
from app.convert.files import offline
from app.errors import Invalid, TooLarge, UnreadableFile
from app.formats import FileGroup, ReadContext, get_format
from app.formats.clouds.pcd_codec import parse
from app.limits import Limits
from app.model.layers import Layers, PartKey
from app.model.voxels import HALF, VoxelMap
from app.syntax import lzf
from tests.formats import clouds

FORMAT = get_format("pcd")
SAMPLES = Path(__file__).resolve().parents[1] / "samples" / "pcd"
REAL = ["lamppost.pcd", "room_scan1.pcd", "samp41-utm.pcd"]
KINDS = ["ascii", "binary", "binary_compressed"]


def read(data: bytes, options: dict[str, str] | None = None, **more: Any) -> tuple[VoxelMap, ReadContext, Layers]:
    context = ReadContext(options=formats.read_options(FORMAT, options or {}), **more)
    layers = formats.read(FileGroup(FORMAT, "map.pcd", {"map.pcd": data}), context)
    voxels = layers.parts[PartKey("voxels")]
    assert isinstance(voxels, VoxelMap)
    return voxels, context, layers


def again(cloud: bytes, **options: str) -> bytes:
    (out,) = offline({"map.pcd": cloud}, "pcd", options=options).files.values()
    return out


def cells(voxels: VoxelMap) -> set[tuple[int, int, int]]:
    assert (voxels.depth == 16).all()
    return set(zip(*(voxels.axis(k)[0].tolist() for k in range(3)), strict=True))


def header(fields: str = "x y z", size: str = "4 4 4", kind: str = "F F F", n: int = 1, data: str = "binary") -> bytes:
    count = " ".join("1" for _ in fields.split())
    lines = f"VERSION 0.7\nFIELDS {fields}\nSIZE {size}\nTYPE {kind}\nCOUNT {count}\n"
    return f"{lines}WIDTH {n}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA {data}\n".encode()


@pytest.mark.parametrize("name", REAL)
def test_real_clouds_match_facts(shared: Path, facts_json: dict[str, Any], name: str) -> None:
    data = (shared / "data/pointcloud/pcl_data" / name).read_bytes()
    facts = facts_json[f"pointcloud/pcl_data/{name}"]["facts"]
    cloud = parse(data, ReadContext())
    places = cloud.places(0, len(cloud))
    assert len(cloud) == facts["points"]
    assert int(np.isfinite(places).all(axis=1).sum()) == facts["finite_points"]
    assert np.allclose([places.min(axis=0), places.max(axis=0)], facts["bounds"], atol=1e-3)
    voxels, context, _ = read(data)
    x, y, z = (places[:, k] - o for k, o in enumerate(voxels.properties["points"].get("origin", (0, 0, 0))))
    truth = {tuple(math.floor(v / 0.05) for v in p) for p in zip(x.tolist(), y.tolist(), z.tolist(), strict=True)}
    voxel_cells = cells(voxels)
    # A quotient and a product may round to two sides of a voxel's face.
    assert len(truth ^ voxel_cells) <= 0.01 * len(truth)
    assert all(any((i + a, j + b, k + c) in voxel_cells for a in (-1, 0, 1) for b in (-1, 0, 1) for c in (-1, 0, 1)) for i, j, k in truth)  # fmt: skip  # noqa: E501
    assert voxels.resolution == 0.05
    assert ("samp41" in name) == any("used as the local origin" in w.problem for w in context.warnings)


@pytest.mark.parametrize("kind", [None, *KINDS])
@pytest.mark.parametrize("name", REAL)
def test_real_clouds_round_trip_point_by_point(shared: Path, name: str, kind: str | None) -> None:
    data = (shared / "data/pointcloud/pcl_data" / name).read_bytes()
    back = again(data) if kind is None else again(data, data=kind)
    _, before = clouds.pcd(data)
    header, after = clouds.pcd(back)
    assert after == before
    assert header["FIELDS"] == "x y z"
    assert (back == data) == (kind is None), "asked for nothing special: the very file"


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["shelf", "intensity", "line"])
def test_fields_round_trip_in_order(name: str, kind: str) -> None:
    data = (SAMPLES / f"{name}.pcd").read_bytes()
    a, before = clouds.pcd(data)
    b, after = clouds.pcd(again(data, data=kind))
    assert repr(after) == repr(before), "as text, since NaN is not equal to itself"
    real = [n for n in a["FIELDS"].split() if n != "_"]
    assert b["FIELDS"].split() == real
    assert (b["WIDTH"], b["HEIGHT"]) == (a["WIDTH"], a["HEIGHT"])
    assert list(map(float, b["VIEWPOINT"].split())) == list(map(float, a["VIEWPOINT"].split()))


def test_comments_are_kept_when_encoding_changes() -> None:
    assert b"# a shelf, scanned from its front\n" in again((SAMPLES / "shelf.pcd").read_bytes(), data="binary")


def test_voxels_match_values_computed_by_hand() -> None:
    """Points of the sample by voxels of 5 cm: (0.01, …) and (0.03, …) share one, NaN has none."""
    voxels, context, _ = read((SAMPLES / "shelf.pcd").read_bytes())
    assert cells(voxels) == {(0, 0, 0), (-3, 25, 6), (20, 20, 20)}
    assert voxels.colour is not None
    shade = dict(zip(zip(*(voxels.axis(k)[0].tolist() for k in range(3)), strict=True), voxels.colour.tolist(), strict=True))  # fmt: skip  # noqa: E501
    assert shade == {(0, 0, 0): [127, 127, 0], (-3, 25, 6): [0, 0, 255], (20, 20, 20): [128, 128, 129]}
    assert voxels.occupied.all()
    assert not voxels.binary, "colours need an .ot"
    assert any("1 of 6 points have no valid coordinates" in w.problem for w in context.warnings)


def test_rotated_viewpoint_gives_a_warning() -> None:
    data = header().replace(b"VIEWPOINT 0 0 0 1 0 0 0", b"VIEWPOINT 0 0 0 0.7071 0.7071 0 0") + struct.pack(
        "<3f", 1, 2, 3
    )
    _, context, _ = read(data)
    assert any("VIEWPOINT" in w.problem for w in context.warnings)


def test_old_headers_with_missing_keywords_are_read() -> None:
    data = b"# .PCD v.5\nVERSION .5\nCOLUMNS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 2\nDATA ascii\n0 0 0\n1 1 1\n"
    assert len(read(data)[0]) == 2
    assert formats.detect("map.pcd", data) is FORMAT


def test_compressed_data_with_padding_is_read() -> None:
    head = header("x _ y z", "4 1 4 4", "F U F F", 2, "binary_compressed")
    x, others = struct.pack("<2f", 1, 2), struct.pack("<4f", 3, 4, 5, 6)
    for flat in (x + b"\7\7" + others, x + others):  # with padding, and as PCL does it
        packed = bytes([len(flat) - 1]) + flat
        data = head + struct.pack("<II", len(packed), len(flat)) + packed
        assert clouds.pcd(again(data, data="binary"))[1] == [[1, 3, 5], [2, 4, 6]]


def test_float_colours_round_trip_as_text() -> None:
    """An alpha of 255 makes a packed colour a NaN, whose text would lose the value."""
    colour = struct.unpack("<f", struct.pack("<I", 0xFF102030))[0]
    data = header("x y z rgb", "4 4 4 4", "F F F F") + struct.pack("<4f", 0, 0, 0, colour)
    text = again(data, data="ascii")
    assert text.endswith(f"0.0 0.0 0.0 {0xFF102030}\n".encode())
    voxels = read(text)[0]
    assert voxels.colour is not None
    assert voxels.colour.tolist() == [[0x10, 0x20, 0x30]]


@pytest.mark.parametrize("size", [0, 1, 5, 1000, 40_000, lzf.MAX_INTERPRETED_BYTES // 16 + 7])
@pytest.mark.parametrize("kind", ["zeros", "noise", "text", "repeats"])
def test_compression_round_trips(size: int, kind: str) -> None:
    dice = random.Random(size)
    data = {
        "zeros": bytes(size),
        "noise": dice.randbytes(size),
        "text": b" ".join(b"%d.%d" % (k % 97, k % 13) for k in range(size))[:size],
        "repeats": (dice.randbytes(300) * (size // 300 + 1))[:size],
    }[kind]
    packed = lzf.squeeze(data)
    assert clouds.lzf(packed) == data, "by a reader that is not ours"
    assert lzf.expand(packed, len(data)) == data
    if size > 1000 and kind != "noise":
        assert len(packed) < 0.7 * size


def test_native_and_python_loops_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    data = bytes(random.Random(3).choices(range(7), k=30_000))
    plain = lzf.squeeze(data)
    monkeypatch.setattr(lzf, "MAX_INTERPRETED_BYTES", 0)
    assert lzf.squeeze(data) == plain
    assert lzf.expand(plain, len(data)) == data
    for broken in (plain[:-1], plain + b"\x40\xff", b"\xe0\xff\xff" + plain, plain[: len(plain) // 2]):
        with pytest.raises(ValueError, match="compressed data"):
            lzf.expand(broken, len(data))


@pytest.mark.parametrize(
    ("data", "message", "line"),
    [
        (header(n=10**11), "limit", None),
        (header(n=2) + bytes(12), "need 24 bytes", None),
        (header(data="ascii", n=3) + b"1 2 3\n1 2 3\n", "3 rows|3 points", 11),
        (header(data="ascii", n=2) + b"1 2 3\n1 x 3\n", "invalid row of numbers", 12),
        (header(data="ascii", n=2) + b"1 2 3\n1 2\n", "invalid row of numbers", 12),
        (header(data="zip"), "DATA must be", 10),
        (header("x y", "4 4", "F F") + bytes(8), "missing: z", None),
        (header(size="4 4"), "SIZE has 2 values", 3),
        (header(kind="F F Q"), "unknown type Q", 4),
        (header("x y x"), "duplicate field", 2),
        (header().replace(b"POINTS 1", b"POINTS 2"), "WIDTH × HEIGHT", 9),
        (header().replace(b"COUNT 1 1 1", b"COUNT 1 1 0"), "COUNT", 5),
        (header().replace(b"WIDTH 1", b"WIDTH -1"), "WIDTH", 6),
        (header().replace(b"VIEWPOINT 0", b"VIEWPOINT nan"), "VIEWPOINT", 8),
        (header().replace(b"VIEWPOINT 0", b"VIEWPOINT 1e999"), "VIEWPOINT", 8),
        (header(data="binary_compressed") + b"123", "sizes", None),
        (header(data="binary_compressed") + struct.pack("<II", 4, 12) + b"1234", "compressed", None),
        (header(data="binary_compressed") + struct.pack("<II", 99, 12) + b"1234", "99", None),
        (header(data="binary_compressed") + struct.pack("<II", 4, 2**32 - 1) + b"1234", "do not match", None),
        (header()[:-14], "incomplete header", 9),
    ],
)
def test_invalid_file_raises_an_error_with_line(data: bytes, message: str, line: int | None) -> None:
    with pytest.raises((UnreadableFile, TooLarge), match=message) as caught:
        read(data)
    assert caught.value.problems[0].file == "map.pcd"
    assert caught.value.problems[0].line == line


def test_limits_are_enforced() -> None:
    with pytest.raises(TooLarge, match="limit is 5"):
        read(header(n=6) + bytes(72), limits=Limits(voxels=5))
    with pytest.raises(TooLarge, match="text"):
        read(header(data="ascii", n=1) + b"1 2 3" + b" " * 200, limits=Limits(text_bytes=100))
    packed = b"\x00\x00" + b"\xe0\xff\x00" * 50
    size = 1 + 264 * 50
    bomb = header("x y z w", "4 4 4 1", "F F F U", 1, "binary_compressed")
    bomb = (
        bomb.replace(b"COUNT 1 1 1 1", b"COUNT 1 1 1 %d" % (size - 12)) + struct.pack("<II", len(packed), size) + packed
    )
    assert len(read(bomb)[0]) == 1, "13 kB of 152 bytes"
    with pytest.raises(TooLarge, match="more than the limit of 13000 bytes"):
        read(bomb, limits=Limits(unpacked_bytes=13_000))


def test_options_set_origin_and_crs() -> None:
    data = header(n=2) + struct.pack("<6f", 10, 20, 30, 10.3, 20.3, 30.3)
    assert cells(read(data, {"resolution": "0.5"})[0]) == {(20, 40, 60)}
    assert cells(read(data, {"resolution": "0.25", "origin": "10,20,30"})[0]) == {(0, 0, 0), (1, 1, 1)}
    with pytest.raises(UnreadableFile, match="resolution to"):
        read(header(n=2) + struct.pack("<6f", -40, 0, 0, 40, 0, 0), {"resolution": "0.001"})
    with pytest.raises((Invalid, UnreadableFile), match="EPSG"):
        read(data, {"crs": "/etc/passwd"})


def test_large_clouds_get_larger_voxels() -> None:
    data = header(n=2) + struct.pack("<6f", -2000, 0, 0, 2000, 100, 0)
    voxels, context, _ = read(data)
    assert voxels.resolution == 0.1
    assert "origin" not in voxels.properties["points"], "it stays where it is"
    assert any("0.1 m" in w.problem for w in context.warnings)


def test_points_on_octree_boundary_are_kept() -> None:
    edge = HALF * 0.05
    voxels, _, _ = read(header(size="8 8 8", n=2) + struct.pack("<6d", -edge, 0, 0, math.nextafter(edge, 0), 0, 0))
    assert cells(voxels) == {(-HALF, 0, 0), (HALF - 1, 0, 0)}


def test_cloud_without_points_round_trips() -> None:
    data = header(n=0)
    voxels, context, _ = read(data)
    assert len(voxels) == 0
    assert any("no points" in w.problem for w in context.warnings)
    assert again(data) == data
    assert clouds.pcd(again(data, data="binary_compressed"))[1] == []
