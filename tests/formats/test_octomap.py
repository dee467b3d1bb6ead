"""octomap: bytes computed by hand, real maps, the C++ library's own tools if installed, hostile bytes."""

from __future__ import annotations

import math
import shutil
import struct
import subprocess
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app import formats
from app.errors import Ambiguous, BadUpload, Invalid, MissingLayer, NotFound, TooLarge, UnreadableFile
from app.formats import FileGroup, ReadContext, WriteContext, get_format, octomap
from app.formats.octomap import WriteOptions
from app.limits import Limits
from app.model.layers import Layers, PartKey
from app.model.voxels import DEPTH, HALF, VoxelMap, coarser, cut, morton, prune

SAMPLES = Path(__file__).resolve().parents[1] / "samples" / "octomap"
Same = Callable[[str, dict[str, bytes], dict[str, bytes]], list[str]]

FREE, OCCUPIED = (float(v) for v in octomap.LOG_ODDS)
LINES = b"# (feel free to add / change comments, but leave the first line as it is!)\n#\n"


def header(kind: str, size: int, res: str = "0.1", name: str = "OcTree") -> bytes:
    first = b"# Octomap OcTree binary file\n" if kind == "bt" else b"# Octomap OcTree file\n"
    return first + LINES + f"id {name}\nsize {size}\nres {res}\ndata\n".encode()


def read(data: bytes, name: str = "a.bt", **more: Any) -> tuple[VoxelMap, ReadContext]:
    context = ReadContext(**more)
    layers = formats.read(FileGroup(get_format("octomap"), name, {name: data}), context)
    (part,) = layers.parts.values()
    assert isinstance(part, VoxelMap)
    return part, context


def write(voxels: VoxelMap, **options: Any) -> bytes:
    context = WriteContext(options=WriteOptions(**options))
    (data,) = formats.write(get_format("octomap"), Layers({PartKey("voxels"): voxels}), context).values()
    return data


def rows(voxels: VoxelMap) -> list[tuple[int, int, float]]:
    return list(zip(voxels.depth.tolist(), voxels.code.tolist(), voxels.log_odds.tolist(), strict=True))


def leaves(*given: tuple[int, int, float], **more: Any) -> VoxelMap:
    order = sorted(given, key=lambda leaf: leaf[1] << 3 * (DEPTH - leaf[0]))
    depth, code, odds = zip(*order, strict=True) if order else ((), (), ())
    more = {"resolution": 0.1, "binary": False} | more
    return VoxelMap(
        depth=np.array(depth, np.uint8), code=np.array(code, np.uint64), log_odds=np.array(odds, np.float32), **more
    )


def random_tree(seed: int, values: tuple[float, ...] = (-2.0, -0.4, 0.85, 3.5), colour: bool = False) -> VoxelMap:
    """Create leaves of many depths below a few branches."""
    dice = np.random.default_rng(seed)
    out: list[tuple[int, int, float]] = []
    stack = [(int(dice.integers(1, 6)), 0)]
    stack = [(stack[0][0], int(dice.integers(0, 8 ** stack[0][0])))]
    while stack:
        depth, code = stack.pop()
        for octant in range(8):
            child = depth + 1, code << 3 | octant
            roll = dice.random()
            if roll < 0.3:
                out.append((*child, float(dice.choice(values))))
            elif roll < 0.5 and depth + 1 < DEPTH and len(out) < 400:
                stack.append(child)
    voxels = leaves(*(out or [(16, 5, 1.0)]))
    if not colour:
        return voxels
    shades = dice.integers(0, 256, (len(voxels), 3)).astype(np.uint8)
    shades[dice.random(len(voxels)) < 0.3] = 255
    return VoxelMap(0.1, voxels.depth, voxels.code, voxels.log_odds, shades, False)


def smallest(voxels: VoxelMap) -> dict[tuple[int, int, int], float]:
    """Return every smallest voxel by its indices; for small trees."""
    out = {}
    sides = [voxels.axis(k) for k in range(3)]
    for i, odds in enumerate(voxels.log_odds.tolist()):
        x, y, z = (range(int(low[i]), int(high[i])) for low, high in sides)
        out.update({(a, b, c): odds for a in x for b in y for c in z})
    return out


# --- worked out by hand -------------------------------------------------------------------------------------------
def test_children_have_two_bits() -> None:
    # The root's octant 7 (x, y, z ≥ 0) is inner; within it octant 0 is free, 1 (x) occupied, the rest unknown.
    data = header("bt", 4) + bytes([0x00, 0b11_00_00_00, 0b00_00_10_01, 0x00])
    voxels, context = read(data)
    assert rows(voxels) == [(2, 0o70, pytest.approx(FREE)), (2, 0o71, pytest.approx(OCCUPIED))]
    assert voxels.binary
    assert voxels.colour is None
    assert voxels.properties == {}
    assert context.warnings == []
    assert voxels.bounds() == (0.0, 0.0, 0.0, 3276.8, 1638.4, 1638.4)
    assert voxels.voxel_counts() == {"occupied": 2**42, "free": 2**42}
    assert write(voxels) == data


def test_smallest_voxel_position_equals_library() -> None:
    # key = floor(coordinate / resolution) + 32768: (1.05, -0.05, 0.25) at 0.1 m is voxel (10, -1, 2).
    code = morton(np.array([10]), np.array([-1]), np.array([2]))
    voxels = leaves((16, int(code[0]), 1.5))
    assert voxels.bounds() == (1.0, -0.1, 0.2, 1.1, 0.0, 0.3)
    again, _ = read(write(voxels), "a.ot")
    assert rows(again) == rows(voxels)


def test_log_odds_are_read_and_inner_nodes_computed() -> None:
    def node(odds: float, mask: int) -> bytes:
        return struct.pack("<fB", odds, mask)

    # Root: octants 0 (leaf) and 7 (inner, with the leaves 2 and 3). Inner nodes carry the highest below.
    data = header("ot", 5) + node(0.5, 0x81) + node(-1.25, 0) + node(0.5, 0x0C) + node(-2.0, 0) + node(0.5, 0)
    voxels, _ = read(data, "a.ot")
    assert rows(voxels) == [(1, 0, -1.25), (2, 0o72, -2.0), (2, 0o73, 0.5)]
    assert not voxels.binary
    assert write(voxels) == data
    stale = header("ot", 5) + node(3.0, 0x81) + node(-1.25, 0) + node(-9, 0x0C) + node(-2.0, 0) + node(0.5, 0)
    assert write(read(stale, "a.ot")[0]) == data, "inner nodes are computed from the leaves"


def test_inner_node_colours_are_means_of_set_colours() -> None:
    def node(odds: float, colour: tuple[int, int, int], mask: int) -> bytes:
        return struct.pack("<f3BB", odds, *colour, mask)

    red, dark, none = (255, 0, 0), (10, 5, 1), (255, 255, 255)
    mean = (132, 2, 0)  # (255 + 10) // 2, (0 + 5) // 2, (0 + 1) // 2
    data = header("ot", 6, name="ColorOcTree")
    data += node(1.0, mean, 0x03) + node(1.0, mean, 0x07) + node(1.0, red, 0) + node(-1.0, dark, 0)
    data += node(0.0, none, 0) + node(-2.0, none, 0)
    voxels, _ = read(data, "a.ot")
    assert voxels.colour is not None
    assert voxels.colour.tolist() == [list(red), list(dark), list(none), list(none)]
    assert write(voxels) == data
    assert b"id ColorOcTree" in write(voxels, kind="bt")


def test_2010_format_is_read() -> None:
    body = bytes([0x00, 0b11_00_00_00, 0b00_00_10_01, 0x00])
    voxels, context = read(struct.pack("<IdI", 3, 0.1, 4) + body)
    assert "2010" in context.warnings[0].problem
    assert write(voxels) == header("bt", 4) + body
    wall, _ = read((SAMPLES / "wall_2010.bt").read_bytes())
    assert wall.voxel_counts() == {"occupied": 96, "free": 0}
    assert wall.bounds() == (-0.8, 0.0, 0.0, 0.8, 0.1, 0.6)


def test_samples_contain_expected_voxels() -> None:
    shed, _ = read((SAMPLES / "shed.bt").read_bytes())
    walls = 22 * 16 * 9 - 20 * 14 * 8 - 4 * 5  # the block less its inside less the door
    assert shed.voxel_counts() == {"occupied": walls, "free": 22 * 16 * 9 - walls}
    assert shed.bounds() == (-2.5, -2.0, 0.0, 3.0, 2.0, 2.25)
    assert shed.properties["octomap"]["comments"] == ["# a shed with a door, made up", "# licence: CC0"]
    assert b"# licence: CC0\n" in write(shed)
    shelf, _ = read((SAMPLES / "shelf.ot").read_bytes(), "shelf.ot")
    assert shelf.voxel_counts() == {"occupied": 6 * 3 * 3, "free": 4 * 3 * 7}
    assert shelf.colour is not None
    assert int((shelf.colour != 255).any(axis=1).sum()) == 6 * 2 * 3


@pytest.mark.parametrize("odds", [-0.5, 0.0, 2.0])
def test_single_leaf_tree_becomes_eight_octants(odds: float) -> None:
    voxels, _ = read(header("ot", 1) + struct.pack("<fB", odds, 0), "a.ot")
    assert rows(voxels) == [(1, k, odds) for k in range(8)]
    assert rows(prune(voxels)) == rows(voxels), "the root never becomes a leaf"
    again, _ = read(write(voxels, kind="bt"))
    assert again.occupied.tolist() == [odds >= 0] * 8


def test_empty_trees_round_trip() -> None:
    for kind, name in (("bt", "OcTree"), ("ot", "OcTree"), ("ot", "ColorOcTree")):
        data = header(kind, 0, name=name)
        voxels, context = read(data, f"a.{kind}")
        assert len(voxels) == 0
        assert voxels.bounds() is None
        assert "no voxels" in context.warnings[0].problem
        assert write(voxels) == data
    bare, context = read(header("bt", 1) + b"\0\0")
    assert len(bare) == 0
    assert "no voxels" in context.warnings[0].problem


def test_resolution_is_formatted_as_in_library_unless_more_precise() -> None:
    for text in ("0.05", "1e-05", "2", "1000", "0.123456"):
        assert f"\nres {text}\n".encode() in write(leaves((16, 1, 1.0), resolution=float(text)))
    assert b"\nres 0.1234567\n" in write(leaves((16, 1, 1.0), resolution=0.1234567))


def test_header_keywords_are_read() -> None:
    body = bytes([0x00, 0b11_00_00_00, 0b00_00_10_01, 0x00])
    first = b"# Octomap OcTree binary file\n"
    loose = first + b"# by hand\r\nres 1e-1   size 4\n  id 1 # the old name\ncolour blue\n\ndata \n" + body
    voxels, context = read(loose)
    assert voxels.resolution == 0.1
    assert [(w.line, w.where) for w in context.warnings] == [(5, "colour"), (4, "id")]
    assert voxels.properties["octomap"]["comments"] == ["# by hand", "# the old name"]
    other, _ = read(header("bt", 4, name="MyTree") + body)
    assert b"id MyTree\n" in write(other)
    assert b"id OcTree\n" in write(other, kind="ot")
    stamped = header("ot", 2, name="OcTreeStamped") + struct.pack("<fBfB", 1.0, 1, 1.0, 0)
    assert write(read(stamped, "a.ot")[0]) == stamped
    white, _ = read(header("bt", 4, name="ColorOcTree") + body)
    full = write(white, kind="ot")
    assert b"id ColorOcTree\n" in full
    assert read(full, "a.ot")[0].colour.tolist() == [[255] * 3] * 2  # type: ignore[union-attr]


# --- real maps ----------------------------------------------------------------------------------------------------
def real(shared: Path) -> list[Path]:
    return sorted(p for p in (shared / "data" / "octomap").rglob("*") if p.suffix in (".bt", ".ot"))


def test_real_maps_match_library_counts(shared: Path, facts_json: dict[str, Any]) -> None:
    seen = real(shared)
    assert len(seen) >= 5
    for path in seen:
        facts = facts_json[path.relative_to(shared / "data").as_posix()]["facts"]
        voxels, _ = read(path.read_bytes(), path.name)
        assert voxels.resolution == facts["resolution"]
        assert voxels.leaf_counts() == {"occupied": facts["occupied_leafs"], "free": facts["free_leafs"]}
        names = {"occupied": "occupied_voxels_at_max_depth", "free": "free_voxels_at_max_depth"}
        assert voxels.voxel_counts() == {k: facts[n] for k, n in names.items()}
        depths, counts = np.unique(voxels.depth, return_counts=True)
        assert dict(zip(map(str, depths.tolist()), counts.tolist(), strict=True)) == facts["leafs_by_depth"]
        assert voxels.bounds() == pytest.approx([*facts["bbox_known"][0], *facts["bbox_known"][1]])
        if voxels.binary:
            assert float(voxels.log_odds.min()) == pytest.approx(facts["logodds_min"], abs=1e-9)
            assert float(voxels.log_odds.max()) == pytest.approx(facts["logodds_max"], abs=1e-9)


def test_real_maps_round_trip_byte_for_byte(shared: Path, same: Same) -> None:
    """The library wrote all of them except the one of 2010, which gets the current header."""
    for path in real(shared):
        data = path.read_bytes()
        voxels, _ = read(data, path.name)
        out = write(voxels)
        assert not same("octomap", {path.name: data}, {f"map{path.suffix}": out})
        if data.startswith(b"#"):
            assert out == data
        else:
            assert out.endswith(data[16:])


def test_real_maps_keep_voxels_in_other_kind(shared: Path, facts: ModuleType) -> None:
    for path in real(shared):
        data = path.read_bytes()
        voxels, _ = read(data, path.name)
        other = write(voxels, kind="ot" if voxels.binary else "bt")
        before, after = (facts.merged(facts.octomap(d)) for d in (data, other))
        assert (before == after).all()


def test_large_map_is_read_in_bounded_time(shared: Path) -> None:
    """geb079: 35 ms in C++. A loop over half a million nodes would take ten times as long as this allows."""
    data = (shared / "data" / "octomap" / "geb079" / "geb079.bt").read_bytes()
    times = []
    for _ in range(3):
        start = time.process_time()
        voxels, _ = read(data)
        times.append(time.process_time() - start)
    assert len(voxels) == 428144
    assert min(times) < 1.0


# --- the library's own tools --------------------------------------------------------------------------------------
@pytest.mark.skipif(shutil.which("convert_octree") is None, reason="octomap-tools is not installed")
@pytest.mark.parametrize("seed", range(6))
def test_written_bytes_equal_library(seed: int, tmp_path: Path) -> None:
    voxels = random_tree(seed, colour=seed % 2 == 1)
    full = write(voxels)
    (tmp_path / "a.ot").write_bytes(full)
    for kind in ("ot", "bt"):
        target = tmp_path / f"out.{kind}"
        subprocess.run(["convert_octree", tmp_path / "a.ot", target], check=True, capture_output=True)
        assert target.read_bytes() == write(voxels, kind=kind)
    if voxels.colour is None:
        binary = (tmp_path / "out.bt").read_bytes()
        subprocess.run(["convert_octree", tmp_path / "out.bt", tmp_path / "full.ot"], check=True, capture_output=True)
        assert (tmp_path / "full.ot").read_bytes() == write(read(binary)[0], kind="ot")


# --- laws ---------------------------------------------------------------------------------------------------------
@given(st.integers(0, 2**31), st.booleans())
def test_any_tree_round_trips(seed: int, colour: bool) -> None:
    voxels = random_tree(seed, colour=colour)
    again, _ = read(write(voxels), "a.ot")
    assert rows(again) == rows(voxels)
    if colour:
        assert (again.colour == voxels.colour).all()
    binary = write(voxels, kind="bt")
    likely, _ = read(binary)
    assert write(likely) == binary
    unpruned, _ = read(write(voxels, kind="bt", prune=False))
    assert unpruned.depth.tolist() == voxels.depth.tolist()
    assert unpruned.occupied.tolist() == voxels.occupied.tolist()


def test_pruning_merges_eight_equal_leaves_level_by_level() -> None:
    block = [(16, 0o7000 + k, 0.5) for k in range(64)]
    assert rows(prune(leaves(*block))) == [(14, 0o70, 0.5)]
    block[13] = (16, block[13][1], 0.25)
    merged = rows(prune(leaves(*block)))
    assert len(merged) == 7 + 8
    assert [r for r in merged if r[0] == 15] == [(15, 0o700 + k, 0.5) for k in range(8) if k != 1]
    # Seven leaves and one that is split are no eight.
    split = [(15, k, 1.0) for k in range(7)] + [(16, 0o70 + k, 1.0) for k in range(7)]
    assert rows(prune(leaves(*split))) == rows(leaves(*split))


def test_pruning_stops_as_in_library() -> None:
    eight = [(15, k, 1.0) for k in range(8)]
    assert len(prune(leaves(*eight))) == 8, "no leaf of depth 16 merges, so the library does not look at depth 15"
    assert rows(prune(leaves(*eight), deepest=15)) == [(14, 0, 1.0)]
    more = [*eight, *((16, 0o100 * 8 + k, 1.0) for k in range(8))]
    assert rows(prune(leaves(*more))) == [(14, 0, 1.0), (15, 0o100, 1.0)]


def test_pruning_averages_colours_and_reports_it() -> None:
    eight = leaves(*((16, k, 1.0) for k in range(8)))
    shades = np.full((8, 3), 255, np.uint8)
    shades[0], shades[1] = (10, 20, 30), (20, 20, 31)
    voxels = VoxelMap(0.1, eight.depth, eight.code, eight.log_odds, shades, False)
    merged = prune(voxels)
    assert merged.colour is not None
    assert merged.colour.tolist() == [[15, 20, 30]]
    context = WriteContext(options=WriteOptions(prune=True))
    octomap.write(Layers({PartKey("voxels"): voxels}), context)
    assert [(d.subject, d.count) for d in context.dropped] == [("colours", 8)]
    first = VoxelMap(0.1, eight.depth, eight.code, eight.log_odds, shades[::-1].copy(), False)
    assert prune(first).colour.tolist() == [[255] * 3]  # type: ignore[union-attr]


@pytest.mark.parametrize("depth", [1, 9, 13, 15])
def test_coarser_map_has_maximum_occupancy_of_merged_voxels(depth: int) -> None:
    voxels = random_tree(depth)
    coarse = coarser(voxels, depth)
    assert int(coarse.depth.max()) <= depth
    highest: dict[tuple[int, int], float] = {}
    for d, code, odds in rows(voxels):
        key = (d, code) if d <= depth else (depth, code >> 3 * (d - depth))
        highest[key] = max(odds, highest.get(key, -math.inf))
    assert {(d, c): odds for d, c, odds in rows(coarse)} == highest
    assert write(voxels, depth=depth) == write(coarse)
    assert coarser(voxels, DEPTH) is voxels


def test_level_of_detail_is_reported_and_pruned() -> None:
    voxels = leaves(*((16, k, 1.0 if k % 9 else -1.0) for k in range(64)))
    context = WriteContext(options=WriteOptions(kind="bt", depth=15))
    data = octomap.write(Layers({PartKey("voxels"): voxels}), context)["map.bt"]
    assert rows(read(data)[0]) == [(14, 0, pytest.approx(OCCUPIED))]
    assert ("voxels", 56) in [(d.subject, d.count) for d in context.dropped]


def test_bbox_keeps_exactly_intersecting_voxels() -> None:
    size = 13
    middle = int(morton(np.array([0]), np.array([0]), np.array([0]))[0])
    base = middle >> 3 * (DEPTH - size)
    given = [(size, base + 1, 1.0), (size, base + 2, -1.0), *((16, (base << 9) + k, 0.5) for k in range(0, 512, 3))]
    voxels = leaves(*given)
    box = (0.15, -1.0, 0.3, 0.95, 1.25, 0.52)
    remaining = smallest(cut(voxels, box))
    expected = {
        v: odds
        for v, odds in smallest(voxels).items()
        if all(v[k] * 0.1 < box[k + 3] - 1e-9 and (v[k] + 1) * 0.1 > box[k] + 1e-9 for k in range(3))
    }
    assert remaining == expected
    assert remaining
    data = write(voxels, bbox=box)
    assert smallest(read(data, "a.ot")[0]) == expected


def test_bbox_on_faces_points_and_everything() -> None:
    voxels = leaves((13, int(morton(*(np.array([0]) for _ in "xyz"))[0]) >> 9, 1.0))
    assert cut(voxels, (0.3, 0.0, 0.0, 0.5, 0.1, 0.1)).bounds() == (0.3, 0.0, 0.0, 0.5, 0.1, 0.1)
    assert cut(voxels, (0.25, 0.25, 0.25) * 2).bounds() == (0.2, 0.2, 0.2, 0.3, 0.3, 0.3)
    assert rows(cut(voxels, (-1e7, -1e7, -1e7, 1e7, 1e7, 1e7))) == rows(voxels)
    assert len(cut(voxels, (0.8, 0.0, 0.0, 2.0, 2.0, 2.0))) == 0
    with pytest.raises(NotFound, match="outside"):
        write(voxels, bbox=(0.8, 0.0, 0.0, 2.0, 2.0, 2.0))
    for bad in ((1.0, 0.0, 0.0, 0.0, 1.0, 1.0), (0.0, 0.0, 0.0, math.inf, 1.0, 1.0)):
        with pytest.raises(Invalid):
            cut(voxels, bad)


def test_bbox_result_size_is_bounded() -> None:
    voxels = leaves(*((1, k, -1.0) for k in range(8)))
    side = HALF * 0.1 - 0.15
    tracemalloc.start()
    with pytest.raises(Invalid, match="smaller box"):
        cut(voxels, (-side, -side, -side, side, side, side), limit=100_000)
    assert tracemalloc.get_traced_memory()[1] < 2**26
    tracemalloc.stop()


# --- options ------------------------------------------------------------------------------------------------------
def test_bt_reports_dropped_log_odds_and_colours() -> None:
    voxels, _ = read((SAMPLES / "shelf.ot").read_bytes(), "shelf.ot")
    context = WriteContext(options=WriteOptions(kind="bt"))
    (name,) = octomap.write(Layers({PartKey("voxels"): voxels}), context)
    assert name == "map.bt"
    assert [(d.subject, d.count) for d in context.dropped] == [("log-odds", len(voxels)), ("colours", 36)]
    quiet = WriteContext(options=WriteOptions())
    (name,) = octomap.write(Layers({PartKey("voxels"): voxels}), quiet)
    assert name == "map.ot"
    assert quiet.dropped == []


def test_choose_selects_voxel_map() -> None:
    def choose(*keys: PartKey, **options: str) -> PartKey:
        (key,) = octomap.choose(keys, WriteOptions(**options))
        return key

    lab, shed, default = (PartKey("voxels", "ground", n) for n in ("lab", "shed", "map"))
    upper = PartKey("voxels", "upper", "lab")
    assert choose(lab) == lab
    assert choose(lab, default) == default
    assert choose(lab, default, name="lab") == lab
    assert choose(lab, upper) == lab
    assert choose(lab, upper, level="upper") == upper
    with pytest.raises(Ambiguous, match="lab, shed"):
        choose(lab, shed)
    with pytest.raises(Ambiguous, match="level"):
        choose(upper, PartKey("voxels", "roof", "lab"))
    with pytest.raises(NotFound, match="lab"):
        choose(lab, name="shed")
    with pytest.raises(NotFound, match="ground"):
        choose(lab, level="roof")
    with pytest.raises(MissingLayer):
        choose()


def test_file_name_selects_kind_and_name() -> None:
    assert octomap.options_from_filename("map.ot") == {"kind": "ot"}
    assert octomap.options_from_filename("map.bt") == {"kind": "bt"}
    assert octomap.options_from_filename("lab.bt") == {"kind": "bt", "name": "lab"}
    assert octomap.options_from_filename("map.pgm") == {}
    layers = Layers({PartKey("voxels", "ground", "lab"): leaves((16, 1, 1.0))})
    assert list(octomap.write(layers, WriteContext(options=WriteOptions(kind="bt", name="lab")))) == ["lab.bt"]
    assert list(octomap.write(layers, WriteContext(options=WriteOptions(kind="bt")))) == ["map.bt"]


# --- hostile bytes ------------------------------------------------------------------------------------------------
GOOD = bytes([0x00, 0b11_00_00_00, 0b00_00_10_01, 0x00])
FIRST = b"# Octomap OcTree binary file\n"


def chain(levels: int) -> bytes:
    """Create a chain of inner nodes, the last with a leaf."""
    return b"\x03\x00" * levels + b"\x02\x00"


def long_chain(levels: int) -> bytes:
    return b"".join(struct.pack("<fB", 0.0, 1) for _ in range(levels)) + struct.pack("<fB", 0.0, 0)


@pytest.mark.parametrize(
    ("data", "line", "where", "reason"),
    [
        (b"", 1, None, "first line"),
        (b"\x03\0\0\0", 1, None, "first line"),
        (b"# Octomap OcTreeish\nid OcTree\nsize 4\nres 1\ndata\n" + GOOD, 1, None, "first line"),
        (FIRST + b"id OcTree\nsize 4\nres 0.1\n", 4, "data", "incomplete header"),
        (FIRST + b"# " + b"x" * 70_000 + b"\ndata\n", 1, "data", "incomplete header"),
        (FIRST.rstrip(), 1, "data", "incomplete header"),
        (FIRST + b"size 4\nres 0.1\ndata\n" + GOOD, None, "id", "id"),
        (FIRST + b"id OcTree\nres 0.1\ndata\n" + GOOD, None, "size", "size"),
        (FIRST + b"id OcTree\nsize 4\ndata\n" + GOOD, None, "res", "res"),
        (FIRST + b"id OcTree\nsize -4\nres 0.1\ndata\n" + GOOD, 3, "size", "number of nodes"),
        (FIRST + b"id OcTree\nsize 4e0\nres 0.1\ndata\n" + GOOD, 3, "size", "number of nodes"),
        *(
            (FIRST + b"id OcTree\nsize 4\nres " + res + b"\ndata\n" + GOOD, 4, "res", "res")
            for res in (b"nan", b"inf", b"0", b"-0.1", b"1e999", b"1_0", b"0x1", b"1e-7", "٣".encode())
        ),
        (FIRST + b"id Oc-Tree\nsize 4\nres 0.1\ndata\n" + GOOD, 2, "id", "word"),
        (header("ot", 1, name="CountingOcTree") + b"\0" * 5, 4, "id", "CountingOcTree"),
        (header("bt", 4) + GOOD[:3], None, "data", "16 bit"),
        (header("bt", 5) + GOOD, None, "size", "the data has 4"),
        (header("bt", 2) + GOOD[:2], None, "size", "the data has 1"),
        (header("bt", 1) + GOOD[:2], None, "data", "ends before"),
        (header("bt", 5) + GOOD + b"\0\0", None, "data", "more data follows"),
        (header("bt", 4), None, "size", "the data has 0"),
        (header("bt", 0) + GOOD, None, "size", "the data has 2 inner"),
        (header("bt", 2) + b"\x03\0\0\0", None, "data", "no children"),
        (header("bt", 18) + chain(16), None, "data", "deeper"),
        (header("bt", 100_002) + chain(100_000), None, "data", "deeper"),
        (header("bt", 202) + b"\xff\xff" * 200 + b"\x02\0", None, "data", "ends before"),
        (header("ot", 2) + b"\0" * 9, None, "data", "multiple of 5"),
        (header("ot", 1) + struct.pack("<fB", math.nan, 0), None, "data", "finite"),
        (header("ot", 2) + struct.pack("<fBfB", 1.0, 1, math.inf, 0), None, "data", "node 1"),
        (header("ot", 18) + long_chain(17), None, "data", "deeper"),
        (header("ot", 2) + struct.pack("<fBfB", 1.0, 0, 1.0, 0), None, "data", "more data follows"),
        (header("ot", 2) + struct.pack("<fBfB", 1.0, 3, 1.0, 0), None, "data", "ends before"),
        (struct.pack("<IdI", 3, math.nan, 4) + GOOD, None, "res", "resolution"),
        (struct.pack("<IdI", 3, -0.1, 4) + GOOD, None, "res", "resolution"),
        (struct.pack("<IdI", 3, 0.1, 5) + GOOD, None, "size", "the data has 4"),
    ],
)
def test_invalid_file_raises_unreadable_file_with_location(
    data: bytes, line: int | None, where: str | None, reason: str
) -> None:
    with pytest.raises(UnreadableFile) as caught:
        read(data)
    (problem,) = caught.value.problems
    assert (problem.file, problem.line, problem.where) == ("a.bt", line, where)
    assert reason in problem.problem


def test_tree_of_all_sixteen_levels_is_read() -> None:
    voxels, _ = read(header("bt", 17) + chain(15))
    assert rows(voxels) == [(16, 0, pytest.approx(OCCUPIED))]
    full, _ = read(header("ot", 17) + long_chain(16), "a.ot")
    assert rows(full) == [(16, 0, 0.0)]


def test_tree_beyond_limit_raises_too_large() -> None:
    words = header("bt", 2_000_000_000) + b"\xaa\xaa" * 1000
    tracemalloc.start()
    with pytest.raises(TooLarge, match="limit"):
        read(words)
    with pytest.raises(BadUpload):
        read(header("bt", 1000) + b"\xff\xff" * 2_000_000)
    assert tracemalloc.get_traced_memory()[1] < 2**24
    tracemalloc.stop()
    with pytest.raises(TooLarge):
        read(header("bt", 4) + GOOD, limits=Limits(voxels=3))


def test_detect_rejects_other_files() -> None:
    assert formats.detect("map.bt", header("bt", 4) + GOOD) is get_format("octomap")
    assert formats.detect("simple", struct.pack("<IdI", 3, 0.1, 4) + GOOD) is get_format("octomap")
    for data in (
        b"",
        b"\x03\0\0\0",
        b"\x03" + b"\0" * 40,
        b"# Octomap\n",
        b"# Octomap OcTreeish",
        b"\x03\0\0\0" + b"x" * 40,
    ):
        assert not octomap.detect("map.bt", data)


def test_unwanted_voxels_are_not_read() -> None:
    context = ReadContext(requested_layers=frozenset({"topology"}))
    data = header("bt", 4) + GOOD
    assert octomap.read({"a.bt": data}, context).parts == {}
