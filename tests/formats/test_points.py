"""Clouds and voxels, over HTTP and directly: the file stays with its own voxels only; time and memory."""

from __future__ import annotations

import struct
import time
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from app import formats
from app.convert.files import offline
from app.errors import Ambiguous, Invalid, MissingLayer, NotFound
from app.formats import FileGroup, ReadContext, WriteContext, get_format
from app.model.layers import Layers, PartKey
from app.model.voxels import VoxelMap, coarser, cut, expand_leaves, morton
from app.syntax import lzf
from tests.api.conftest import Api
from tests.formats import clouds

SAMPLES = Path(__file__).resolve().parents[1] / "samples"
SHELF = (SAMPLES / "pcd" / "shelf.pcd").read_bytes()
LINE = (SAMPLES / "pcd" / "line.pcd").read_bytes()
PYRAMID = (SAMPLES / "ply" / "pyramid.ply").read_bytes()
FIELD = (SAMPLES / "las" / "field.las").read_bytes()
SHED = (SAMPLES / "octomap" / "shed.bt").read_bytes()


def layers_of(name: str, data: bytes, **more: str) -> Layers:
    fmt = get_format(name.rpartition(".")[2])
    context = ReadContext(options=formats.read_options(fmt, more))
    return formats.read(FileGroup(fmt, name, {name: data}), context)


def written(layers: Layers, to: str, **options: str) -> tuple[bytes, WriteContext]:
    fmt = get_format(to)
    context = WriteContext(options=formats.write_options(fmt, options))
    (data,) = formats.write(fmt, layers, context).values()
    return data, context


def cells(voxels: VoxelMap) -> set[tuple[int, ...]]:
    return set(zip(*(voxels.axis(k)[0].tolist() for k in range(3)), strict=True))


def test_real_clouds_round_trip_over_http(api: Api, shared: Path) -> None:
    for k, path in enumerate(sorted((shared / "data" / "pointcloud").rglob("*.p[cl]?"))):
        env, data = f"cloud-{k}", path.read_bytes()
        api.post("environments", {"name": env})
        version = api.upload(env, {path.name: data}).json()
        assert version["information"]["voxels"] == "raw"
        kind = path.suffix[1:]
        assert api.get(f"/maps/{env}/{kind}").content == data
        assert api.get(f"/maps/{env}/octomap").content.startswith(b"# Octomap OcTree")
        coverage = api.get(f"environments/{env}/versions/1/maps").json()
        assert {t["format"]: t["state"] for t in coverage}["las"] == "direct"
        report = api.get(f"environments/{env}/versions/1/reports/{kind}").json()
        assert {line["layer"] for line in report["layers"]} == {"voxels", "resources"}
        assert all(line["information"] == "raw" for line in report["layers"])


def test_cloud_is_not_exported_for_other_voxels(api: Api) -> None:
    """Another octree with the same name replaces the cloud; the previous version still has it."""
    api.post("environments", {"name": "stale"})
    api.upload("stale", {"map.pcd": SHELF})
    api.upload("stale", {"map.bt": SHED})
    old = api.get("environments/stale/versions/1/maps/pcd").content
    new = api.get("environments/stale/versions/2/maps/pcd").content
    assert old == SHELF
    assert new == offline({"map.bt": SHED}, "pcd").files["map.pcd"]
    api.upload("stale", {"map.ply": PYRAMID}, mode="merge")
    assert api.get("environments/stale/versions/3/maps/ply").content == PYRAMID
    back = api.get("environments/stale/versions/3/maps/pcd").content
    assert len(clouds.pcd(back)[1]) == 5, "the pyramid's vertices"
    api.upload("stale", {"map.bt": SHED}, mode="merge")
    assert api.get("environments/stale/versions/4/maps/pcd").content == new
    report = api.get("environments/stale/versions/4/reports/octomap").json()
    assert not [d for d in report["dropped"] if d["what"] == "resources"], "the cloud has gone with its voxels"


def test_two_clouds_are_selected_by_name(api: Api) -> None:
    api.post("environments", {"name": "pair"})
    api.upload("pair", {"shelf.pcd": SHELF, "line.pcd": LINE})
    assert api.get("/maps/pair/pcd/shelf.pcd").content == SHELF
    assert api.get("/maps/pair/pcd/line.pcd").content == LINE
    assert api.get("/maps/pair/pcd?name=line").content == LINE
    api.problem("GET", "/maps/pair/pcd", 409)
    api.problem("GET", "/maps/pair/pcd/other.pcd", 404)
    api.problem(
        "POST", "environments/pair/versions", 422, files=[("files", ("a.pcd", LINE))], data={"resolution": "-1"}
    )
    assert api.upload("pair", {"line.pcd": LINE}, resolution="0.2").json()["version"] == 2
    assert api.get("environments/pair/versions/2/layers/voxels?name=line").json()["resolution"] == 0.2


def test_changed_leaves_detach_the_cloud() -> None:
    layers = layers_of("map.pcd", SHELF)
    key = PartKey("voxels")
    voxels = layers.parts[key]
    assert isinstance(voxels, VoxelMap)
    assert written(layers, "pcd")[0] == SHELF
    for other in (
        coarser(voxels, 15),
        cut(voxels, (0, 0, 0, 1, 1, 1)),
        replace(voxels, log_odds=-voxels.log_odds),
        replace(voxels, resolution=0.1),
    ):
        assert written(Layers({**layers.parts, key: other}), "pcd")[0] != SHELF
    del (parts := dict(layers.parts))[PartKey("resources", name="points/map")]
    centres = clouds.pcd(written(Layers(parts), "pcd")[0])[1]
    assert len(centres) == 3, "without the file: the voxels"
    parts[PartKey("resources", name="points/map")] = layers_of("map.pcd", LINE).parts[
        PartKey("resources", name="points/map")
    ]
    assert len(clouds.pcd(written(Layers(parts), "pcd")[0])[1]) == 3, "another file of the same name is not taken"
    with pytest.raises(Invalid, match="frame=source"):
        written(Layers({key: coarser(voxels, 15)}), "pcd", frame="source")


def test_centres_are_inside_their_voxels(shared: Path) -> None:
    """octomap → pcd → voxels of the same resolution gives the same occupied voxels."""
    path = shared / "data/octomap/geb079/geb079.bt"
    pcd_data = offline({"geb.bt": path.read_bytes()}, "pcd").files["map.pcd"]
    voxels = formats.read(FileGroup(get_format("octomap"), "a.bt", {"a.bt": path.read_bytes()}), ReadContext())
    (before,) = voxels.parts.values()
    assert isinstance(before, VoxelMap)
    after = layers_of("map.pcd", pcd_data, resolution="0.08").parts[PartKey("voxels")]
    assert isinstance(after, VoxelMap)
    assert np.array_equal(after.code, expand_leaves(before, before.occupied)[0])
    assert len(after) == 185673, "as liboctomap counts"


def test_far_clouds_are_written_in_both_frames(shared: Path) -> None:
    data = (shared / "data/pointcloud/pcl_data/samp41-utm.pcd").read_bytes()
    layers = layers_of("map.pcd", data)
    voxels = layers.parts[PartKey("voxels")]
    assert isinstance(voxels, VoxelMap)
    origin = voxels.properties["points"]["origin"]
    assert all(v == int(v) for v in origin)
    local, _ = written(layers, "pcd", frame="local")
    a, b = np.array(clouds.pcd(data)[1]), np.array(clouds.pcd(local)[1])
    assert np.array_equal(a - origin, b)
    assert cells(voxels) == {tuple(p) for p in np.floor(b * (1 / 0.05)).astype(int).tolist()}
    source, context = written(layers, "ply", frame="source")
    assert np.array_equal(np.array(clouds.ply(source)[1]), a)
    assert any("coordinates of the upload" in w.problem for w in context.warnings)
    assert np.array_equal(np.array(clouds.ply(written(layers, "ply")[0])[1]), b), "others are local by default"
    placed = layers_of("map.pcd", data, crs="EPSG:32633", resolution="0.1")
    assert placed.datum is not None
    assert 48.7 < placed.datum.latitude < 48.8
    normals = b"ply\nformat ascii 1.0\nelement vertex 1\n" + b"".join(
        b"property double %s\n" % n for n in (b"x", b"y", b"z", b"nx", b"ny", b"nz")
    )
    ply = normals + b"end_header\n700000 5900000 0 1 0 0\n"
    turned = layers_of("map.ply", ply, crs="EPSG:32630")
    *_, nx, ny, nz = clouds.ply(written(turned, "ply", frame="local")[0])[1][0]
    assert abs(np.hypot(nx, ny) - 1) < 1e-9
    assert -0.05 < ny < -0.03, "three degrees east of the meridian, at 53° north: its grid is turned by 2.4°"
    assert nz == 0


def test_write_requires_exactly_one_cloud() -> None:
    for to in ("pcd", "ply", "las"):
        with pytest.raises(MissingLayer, match="upload"):
            written(Layers(), to)
        two = Layers({**layers_of("a.pcd", SHELF).parts, **layers_of("b.ply", PYRAMID).parts})
        with pytest.raises(Ambiguous, match="a, b"):
            written(two, to)
        with pytest.raises(NotFound):
            written(two, to, name="c")
        assert written(two, to, name="b")[0]


def test_too_many_centres_raise_invalid() -> None:
    huge = VoxelMap(0.05, np.array([1], np.uint8), np.array([0], np.uint64), np.array([1], np.float32))
    with pytest.raises(Invalid, match="depth"):
        written(Layers({PartKey("voxels"): huge}), "pcd")


def test_expanded_codes_match_brute_force() -> None:
    depth = np.array([14, 16, 15], np.uint8)
    code = np.array([5, 6 << 6, (6 << 3) + 1], np.uint64)
    voxels = VoxelMap(0.1, depth, code, np.array([1, -1, 1], np.float32))
    got, rows = expand_leaves(voxels, voxels.occupied)
    assert got.tolist() == [*range(5 << 6, 6 << 6), *range(((6 << 3) + 1) << 3, ((6 << 3) + 2) << 3)]
    assert rows.tolist() == [0] * 64 + [2] * 8


def big_text(megabytes: int) -> bytes:
    dice = np.random.default_rng(5)
    n = megabytes * 10**6 // 27
    rows = "\n".join(map("%.6f %.6f %.6f".__mod__, map(tuple, dice.uniform(-50, 50, (n, 3)).tolist())))
    head = (
        f"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {n}\nHEIGHT 1\nPOINTS {n}\nDATA ascii\n"
    )
    return head.encode() + rows.encode() + b"\n"


def test_large_text_is_read_in_bounded_memory() -> None:
    data = big_text(2)
    assert len(data) > 1_700_000
    lzf.squeeze(bytes(lzf.MAX_INTERPRETED_BYTES))  # compiled before anything is traced: that would take long
    for options in ({}, {"crs": "EPSG:32630", "origin": "0,0,0"}):
        tracemalloc.start()
        layers_of("map.pcd", data, **({} if not options else {"resolution": "1"}))
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 10 * len(data), f"{peak / len(data):.1f} times the text"
    layers = layers_of("map.pcd", data)
    for to, options in (("pcd", {"data": "ascii"}), ("pcd", {"data": "binary_compressed"}), ("ply", {}), ("las", {})):
        tracemalloc.start()
        written(layers, to, **options)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 10 * len(data), f"{to} {options}: {peak / len(data):.1f} times the text"


def test_many_points_are_read_in_a_few_times_the_sorting_time() -> None:
    """numpy.unique would take twice as long as all of it: NumPy hashes since 2.3."""
    n = 300_000
    dice = np.random.default_rng(5)
    body = dice.uniform(-50, 50, (n, 3)).astype("<f4").tobytes()
    head = f"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH {n}\nHEIGHT 1\nDATA binary\n".encode()
    ours = floor = 9.0
    for _ in range(3):  # both in turn, by the processor's time, so that a busy machine slows both
        start = time.process_time()
        layers = layers_of("map.pcd", head + body)
        ours = min(ours, time.process_time() - start)
        start = time.process_time()
        places = np.floor(np.frombuffer(body, "<f4").astype(float) * (1 / 0.05)).astype(np.int64).reshape(-1, 3)
        codes = np.sort(morton(*places.T))
        codes = codes[np.concatenate([[True], codes[1:] != codes[:-1]])]
        floor = min(floor, time.process_time() - start)
    voxels = layers.parts[PartKey("voxels")]
    assert isinstance(voxels, VoxelMap)
    assert np.array_equal(voxels.code, codes)
    assert ours < 8 * floor, f"{ours:.2f} s, and the sort alone {floor:.2f} s"


def test_voxel_colours_are_means_of_point_colours() -> None:
    head = b"VERSION 0.7\nFIELDS x y z rgba\nSIZE 4 4 4 4\nTYPE F F F U\nWIDTH 3\nHEIGHT 1\nDATA binary\n"
    body = b"".join(struct.pack("<3fI", 0.01 * k, 0, 0, v) for k, v in enumerate((0xFF0A0000, 0xFF140005, 0xFF1E0007)))
    voxels = layers_of("map.pcd", head + body).parts[PartKey("voxels")]
    assert isinstance(voxels, VoxelMap)
    assert voxels.colour is not None
    assert voxels.colour.tolist() == [[20, 0, 4]]
