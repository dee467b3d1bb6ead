"""ply: real clouds round-trip vertex by vertex, also as read by trimesh; meshes, both byte orders, hostile bytes."""

from __future__ import annotations

import io
import struct
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from app import formats
from app.convert.files import offline
from app.errors import TooLarge, UnreadableFile
from app.formats import FileGroup, ReadContext, get_format
from app.formats.clouds.ply_codec import parse
from app.limits import Limits
from app.model.layers import PartKey
from app.model.voxels import VoxelMap
from tests.formats import clouds

FORMAT = get_format("ply")
SAMPLES = Path(__file__).resolve().parents[1] / "samples"
PYRAMID = (SAMPLES / "ply" / "pyramid.ply").read_bytes()
NORMALS = (SAMPLES / "ply" / "normals.ply").read_bytes()
REAL = "pointcloud/open3d_fragment/fragment_002.ply"
KINDS = ["ascii", "binary_little_endian", "binary_big_endian"]


def read(data: bytes, **more: Any) -> tuple[VoxelMap, ReadContext]:
    context = ReadContext(**more)
    layers = formats.read(FileGroup(FORMAT, "map.ply", {"map.ply": data}), context)
    voxels = layers.parts[PartKey("voxels")]
    assert isinstance(voxels, VoxelMap)
    return voxels, context


def again(cloud: bytes, to: str = "ply", **options: str) -> bytes:
    (out,) = offline({"map.ply": cloud}, to, options=options).files.values()
    return out


def vertices(data: bytes) -> Any:
    """Read vertices with trimesh, an independent implementation."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return trimesh.load(io.BytesIO(data), file_type="ply", process=False)


def header(kind: str = "binary_little_endian", n: int = 1, more: str = "") -> bytes:
    axes = "".join(f"property float {a}\n" for a in "xyz")
    return f"ply\nformat {kind} 1.0\nelement vertex {n}\n{axes}{more}end_header\n".encode()


def test_real_cloud_matches_facts(shared: Path, facts_json: dict[str, Any]) -> None:
    data = (shared / "data" / REAL).read_bytes()
    facts = facts_json[REAL]["facts"]
    cloud = parse(data, ReadContext())
    places = cloud.places(0, len(cloud))
    assert len(cloud) == facts["points"]
    assert np.allclose([places.min(axis=0), places.max(axis=0)], facts["bounds"], atol=1e-4)
    assert np.array_equal(places, vertices(data).vertices)
    voxels, _ = read(data)
    assert set(map(tuple, np.floor(places / 0.05).astype(int).tolist())) == set(
        zip(*(voxels.axis(k)[0].tolist() for k in range(3)), strict=True)
    )


@pytest.mark.parametrize("kind", [None, *KINDS])
def test_real_cloud_round_trips_vertex_by_vertex(shared: Path, kind: str | None) -> None:
    data = (shared / "data" / REAL).read_bytes()
    back = again(data) if kind is None else again(data, data=kind)
    assert clouds.ply(back) == clouds.ply(data)
    ours, theirs = vertices(back), vertices(data)
    assert np.array_equal(ours.vertices, theirs.vertices)
    assert np.array_equal(ours.colors, theirs.colors)
    assert b"comment Created by Open3D\n" in back


def test_faces_stay_in_the_file_and_are_reported_when_dropped() -> None:
    voxels, context = read(PYRAMID)
    assert voxels.leaf_counts() == {"occupied": 5, "free": 0}
    assert any("5 × face" in w.problem for w in context.warnings)
    assert again(PYRAMID) == PYRAMID
    dropped_items = offline({"a.ply": PYRAMID}, "ply", options={"data": "ascii"}).report.as_dict()["dropped"]
    assert [(d["what"], d["count"]) for d in dropped_items] == [("face", 5)]
    for to in ("pcd", "las"):
        dropped = offline({"a.ply": PYRAMID}, to).report.as_dict()["dropped"]
        assert ("face", 5) in [(d["what"], d["count"]) for d in dropped]


def test_vertices_after_lists_are_read_in_both_byte_orders() -> None:
    cloud = parse(NORMALS, ReadContext())
    assert cloud.places(0, 3).tolist() == [[0.1, 0.2, 0.3], [-1.01, 2.02, 3.03], [5.5, -5.5, 0.5]]
    assert cloud.columns["intensity"].tolist() == [7, 8, 65535]
    assert cloud.further == {"camera": 1}
    names, rows = clouds.ply(again(NORMALS, data="binary_little_endian"))
    assert names == ["x", "y", "z", "nx", "ny", "nz", "intensity"]
    assert rows[1] == [-1.01, 2.02, 3.03, 1.0, 0.0, 0.0, 8]


def test_normals_and_colours_convert_to_pcl_columns() -> None:
    header, points = clouds.pcd(again(NORMALS, "pcd"))
    assert header["FIELDS"] == "x y z normal_x normal_y normal_z intensity"
    assert (header["TYPE"], header["SIZE"]) == ("F F F F F F U", "8 8 8 4 4 4 2")
    assert points[0] == [0.1, 0.2, 0.3, 0.0, 0.0, 1.0, 7]
    header, points = clouds.pcd(again(PYRAMID, "pcd"))
    assert header["FIELDS"] == "x y z rgb"
    assert [struct.unpack("<I", struct.pack("<f", p[3]))[0] for p in points] == [
        0xFF0000, 0x00FF00, 0x0000FF, 0x0A141E, 0x28323C,
    ]  # fmt: skip
    names, rows = clouds.ply(offline({"a.pcd": again(PYRAMID, "pcd")}, "ply").files["map.ply"])
    assert names == ["x", "y", "z", "red", "green", "blue"]
    assert rows == clouds.ply(PYRAMID)[1], "there and back"


def test_lists_of_different_lengths_are_skipped() -> None:
    more = "element face 3\nproperty list uchar int vertex_indices\nproperty list ushort float w\n"
    faces = b"".join(struct.pack(f"<B{n}iH{m}f", n, *range(n), m, *[0.5] * m) for n, m in ((3, 0), (4, 2), (0, 1)))
    data = header(more=more) + struct.pack("<3f", 1, 2, 3) + faces
    _, context = read(data)
    assert not any("follow" in w.problem for w in context.warnings)
    assert any("2 bytes follow" in w.problem for w in read(data + b"ab")[1].warnings)
    with pytest.raises(UnreadableFile, match="within face"):
        read(data[:-1])


@pytest.mark.parametrize(
    ("data", "message", "line"),
    [
        (b"ply\nformat ascii 2.0\nend_header\n", "version 1.0", 2),
        (header(n=10**11), "limit", None),
        (header(n=2) + bytes(23), "need 24 bytes", 3),
        (header("ascii", 2) + b"1 2 3\n", "1 lines", 8),
        (header("ascii", 2) + b"1 2 3\n4 five 6\n", "invalid row of numbers", 9),
        (b"ply\nformat ascii 1.0\nelement face 1\nend_header\n", "one element vertex", None),
        (header(more="property list uchar int a\n") + bytes(20), "with list properties", 3),
        (header(more="property quad a\n"), "supported type", 7),
        (header(more="property float x\n"), "duplicate property", 7),
        (header(more="element vertex x\n"), "a name and a number", 7),
        (header(more="element f 1\nproperty list float int a\n"), "must have an integer type", 8),
        (header().replace(b"property float z\n", b"") + bytes(8), "missing: z", None),
        (header(more="strange 1\n"), "unknown keyword", 7),
        (b"ply\nproperty float x\nend_header\n", "precedes the first element", 2),
        (header()[:-5], "incomplete header", 7),
    ],
)
def test_invalid_file_raises_an_error_with_line(data: bytes, message: str, line: int | None) -> None:
    with pytest.raises((UnreadableFile, TooLarge), match=message) as caught:
        read(data)
    assert caught.value.problems[0].file == "map.ply"
    assert caught.value.problems[0].line == line


def test_limits_are_enforced() -> None:
    with pytest.raises(TooLarge, match="limit is 5"):
        read(header(n=6) + bytes(72), limits=Limits(voxels=5))
    with pytest.raises(TooLarge, match="text"):
        read(header("ascii") + b"1 2 3" + b" " * 200, limits=Limits(text_bytes=100))


def test_voxel_centres_become_a_cloud() -> None:
    """The colour tree's occupied voxels at full depth, read by trimesh."""
    shelf = (SAMPLES / "octomap" / "shelf.ot").read_bytes()
    converted = offline({"shelf.ot": shelf}, "ply")
    mesh = vertices(converted.files["map.ply"])
    voxels = formats.read(FileGroup(get_format("octomap"), "a.ot", {"a.ot": shelf}), ReadContext()).parts[
        PartKey("voxels", name="a")
    ]
    assert isinstance(voxels, VoxelMap)
    assert len(mesh.vertices) == voxels.voxel_counts()["occupied"] > 0
    want = set()
    for row in np.flatnonzero(voxels.occupied):
        spans = [range(int(a[row]), int(b[row])) for a, b in map(voxels.axis, range(3))]
        want |= {(x, y, z) for x in spans[0] for y in spans[1] for z in spans[2]}
    assert set(map(tuple, np.floor(mesh.vertices / voxels.resolution).astype(int).tolist())) == want
    assert any(d["what"] == "free voxels" for d in converted.report.as_dict()["dropped"]) == bool(
        voxels.leaf_counts()["free"]
    )
