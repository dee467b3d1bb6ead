"""Solids compared with values computed by hand: volumes, boxes and poses; rejection of invalid shapes."""

from __future__ import annotations

import io
import math
import time
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from app.errors import Invalid
from app.model import solids
from app.model.solids import Solids, rotation
from tests.model.test_meshes import ONE, SHOWN, TRIANGLE, dae, stl

BOX = {"type": "box", "size": [2, 4, 6]}


def volume(corners: Any) -> float:
    """Return the volume of closed, outward triangles (divergence theorem): wrong if any is inverted."""
    return float(np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6.0)


def one(shape: dict[str, Any], files: dict[str, bytes] | None = None, **more: Any) -> Any:
    return solids.triangles({"shapes": [shape], **more}, files or {}, planes=True)


def picture(rows: list[list[int]], mode: str = "L") -> bytes:
    out = io.BytesIO()
    Image.fromarray(np.array(rows, np.uint8 if mode == "L" else np.uint16)).save(out, "PNG")
    return out.getvalue()


@pytest.mark.parametrize(
    ("shape", "expected", "half"),
    [
        (BOX, 48.0, (1, 2, 3)),
        ({"type": "cylinder", "radius": 0.5, "length": 2}, math.pi * 0.25 * 2, (0.5, 0.5, 1)),
        ({"type": "sphere", "radius": 1.5}, 4 / 3 * math.pi * 1.5**3, (1.5, 1.5, 1.5)),
        (
            {"type": "capsule", "radius": 0.5, "length": 2},
            math.pi * 0.25 * 2 + 4 / 3 * math.pi * 0.125,
            (0.5, 0.5, 1.5),
        ),
        ({"type": "ellipsoid", "radii": [1, 2, 3]}, 4 / 3 * math.pi * 6, (1, 2, 3)),
    ],
)
def test_volume_and_extent_of_primitives(shape: dict[str, Any], expected: float, half: tuple[float, ...]) -> None:
    triangles = one(shape)
    assert volume(triangles) == pytest.approx(expected, rel=0.01)
    assert triangles.reshape(-1, 3).max(axis=0) == pytest.approx(half)
    assert triangles.reshape(-1, 3).min(axis=0) == pytest.approx([-v for v in half])
    edges = np.round(np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).reshape(-1, 6), 9) + 0.0
    edge_set = {tuple(e) for e in edges}
    assert all((*e[3:], *e[:3]) in edge_set for e in edge_set), "closed: each edge is met by its reverse"


def test_round_solid_is_accurate_to_millimetres() -> None:
    """The widest gap between a circle and a chord is at the chord's middle."""
    for radius in (0.05, 0.5, 3.0):
        ring = one({"type": "cylinder", "radius": radius, "length": 1})
        at = ring.reshape(-1, 3)[:, :2]
        hull = shapely.convex_hull(shapely.multipoints(at))
        assert radius - shapely.boundary(hull).distance(shapely.Point(0, 0)) <= 0.0021


def test_polyline_rings_follow_even_odd_rule() -> None:
    rings = [[[0, 0], [4, 0], [4, 4], [0, 4]], [[1, 1], [1, 3], [3, 3], [3, 1]], [[10, 0], [11, 0], [11, 1], [10, 1]]]
    shape = {"type": "polyline", "points": rings, "height": 2.5}
    triangles = one(shape)
    assert volume(triangles) == pytest.approx((16 - 4 + 1) * 2.5)
    assert (triangles[:, :, 2].min(), triangles[:, :, 2].max()) == (0, 2.5)
    ground = solids.footprint({"shapes": [shape]}, {})
    assert ground.area == pytest.approx(13)
    assert ground.is_valid


def test_self_crossing_ring_is_solid() -> None:
    triangles = one({"type": "polyline", "points": [[[0, 0], [2, 2], [2, 0], [0, 2]]], "height": 1})
    assert volume(triangles) == pytest.approx(2)


def test_pose_rotates_about_fixed_axes() -> None:
    """Roll first, about the fixed x, then pitch about the fixed y, then yaw about the fixed z."""
    at = rotation(math.pi / 2, 0, math.pi / 2) @ [0, 0, 1]  # roll: z -> -y; yaw: -y -> x
    assert at == pytest.approx([1, 0, 0])
    assert rotation(0, math.pi / 2, 0) @ [1, 0, 0] == pytest.approx([0, 0, -1])
    assert rotation(math.pi / 2, math.pi / 2, 0) @ [0, 1, 0] == pytest.approx([1, 0, 0])  # y -> z -> x


@given(st.tuples(*[st.floats(-4, 4)] * 3))
@settings(max_examples=50)
def test_pose_rotation_agrees_with_scipy(angles: tuple[float, float, float]) -> None:
    from scipy.spatial.transform import Rotation

    assert rotation(*angles) == pytest.approx(Rotation.from_euler("xyz", angles).as_matrix())


def test_solids_apply_scale_then_shape_pose_then_object_pose() -> None:
    shape = {"type": "mesh", "file": "m/a.stl", "scale": [10, 1, 1], "pose": [1, 0, 0, 0, 0, math.pi / 2]}
    triangles = one(shape, {"m/a.stl": stl(TRIANGLE)}, pose=[100, 0, 5, 0, 0, math.pi / 2])
    # (2,0,0) -> scale (20,0,0) -> turned (0,20,0) -> shifted (1,20,0) -> turned (-20,1,0) -> (80,1,5)
    assert triangles[0] == pytest.approx(np.array([[100, 1, 5], [80, 1, 5], [100, -2, 6]]))


def test_mirrored_mesh_keeps_outward_faces() -> None:
    files = {"a.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"}
    assert volume(one({"type": "mesh", "file": "a.obj"}, files)) == pytest.approx(1 / 6)
    assert volume(one({"type": "mesh", "file": "a.obj", "scale": [-2, 1, 1]}, files)) == pytest.approx(2 / 6)


def test_submesh_is_selected_and_centred() -> None:
    files = {
        "a.dae": dae(ONE, SHOWN + '<node name="far"><translate>9 9 9</translate><instance_geometry url="#g"/></node>')
    }
    assert len(one({"type": "mesh", "file": "a.dae"}, files)) == 2
    far = one({"type": "mesh", "file": "a.dae", "submesh": "far"}, files)
    assert far[0, 0].tolist() == [9, 9, 9]
    middle = one({"type": "mesh", "file": "a.dae", "submesh": "far", "center": True, "scale": [2, 2, 2]}, files)
    assert middle[0, 0].tolist() == [-1, -1, 0]


def test_planes_and_visuals_count_only_when_requested() -> None:
    plane = {"type": "plane", "normal": [0, 0, 1], "size": [10, 20]}
    properties = {"shapes": [plane, {**BOX, "visual": True}]}
    assert len(solids.triangles(properties, {})) == 0
    assert solids.bounds(properties, {}) is None
    assert solids.footprint(properties, {}).is_empty
    assert solids.bounds(properties, {}, planes=True) == (-5, -10, 0, 5, 10, 0)
    assert solids.size(properties, {}, visuals=True) == (2, 4, 6)
    for normal, axis in (([0, 0, -1], 2), ([1, 0, 0], 0), ([0, 1, 0], 1)):
        triangles = one({**plane, "normal": normal})
        assert np.ptp(triangles.reshape(-1, 3)[:, axis]) == pytest.approx(0, abs=1e-12)
        facing = np.cross(triangles[0, 1] - triangles[0, 0], triangles[0, 2] - triangles[0, 0])
        assert facing / np.linalg.norm(facing) == pytest.approx(normal)


def test_height_map_is_closed_with_north_up() -> None:
    files = {"h.png": picture([[0, 0, 200], [0, 0, 0], [0, 0, 0]])}
    shape = {"type": "heightmap", "file": "h.png", "size": [4, 2, 3], "position": [10, 0, 1]}
    triangles = one(shape, files)
    highest = triangles.reshape(-1, 3)[triangles.reshape(-1, 3)[:, 2].argmax()]
    assert highest.tolist() == [12, 1, 4], "the brightest pixel, top right, is at the full height"
    # Two triangles of area 1 rise to a height of 3 at one corner each, on a floor 3 mm thick.
    assert volume(solids.apply_pose(triangles, (-10, 0, -1, 0, 0, 0))) == pytest.approx(2 * 1 * 3 / 3 + 8 * 0.003)
    deep = one(shape, {"h.png": picture([[0, 65535], [0, 0]], "I;16")})
    assert deep[:, :, 2].max() == pytest.approx(4)
    assert volume(deep) > 0


def test_large_height_map_keeps_peaks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(solids, "MAX_HEIGHTMAP_SIDE", 4)
    rows = [[0] * 9 for _ in range(6)]
    rows[0][8] = 100
    rows[5][4] = 50
    triangles = one({"type": "heightmap", "file": "h.png", "size": [3, 2, 10]}, {"h.png": picture(rows)})
    assert len(triangles) == 2 * (3 - 1) * (3 - 1) + 2 + 2 * (2 + 2 + 2 + 2)
    top = triangles.reshape(-1, 3)
    assert top[top[:, 2] == 10][0].tolist() == [1.5, 1, 10]
    assert top[top[:, 2] == 5][0].tolist() == [0, -1, 5]
    assert volume(triangles) > 0


def test_footprint_is_union_of_solids() -> None:
    turned = {"shapes": [BOX], "pose": [10, 0, 0, 0, 0, math.pi / 2]}
    ground = solids.footprint(turned, {})
    assert ground.bounds == pytest.approx((8, -1, 12, 1))
    assert ground.area == pytest.approx(8)
    two = {"shapes": [BOX, {**BOX, "pose": [5, 0, 0, 0, 0, 0]}]}
    assert solids.footprint(two, {}).area == pytest.approx(16)
    flat = {"shapes": [{"type": "mesh", "file": "a.obj"}]}
    wall = {"a.obj": b"v 0 0 0\nv 1 0 0\nv 1 0 1\nf 1 2 3\n"}
    assert solids.footprint(flat, wall).length == pytest.approx(1), "a wall without thickness is a line"
    assert solids.footprint({}, {}).is_empty


def test_mesh_shared_by_many_objects_is_read_once(monkeypatch: pytest.MonkeyPatch) -> None:
    from app.model import meshes

    read: list[str] = []
    real = meshes.read_mesh

    def watched(data: bytes, name: str) -> meshes.Mesh:
        read.append(name)
        return real(data, name)

    monkeypatch.setattr(meshes, "read_mesh", watched)
    many = Solids({"a.stl": stl(TRIANGLE), "bad.stl": b""})
    for _ in range(5):
        assert len(many.triangles({"shapes": [{"type": "mesh", "file": "a.stl"}] * 3})) == 3
        with pytest.raises(Invalid, match=r"bad\.stl"):
            many.triangles({"shapes": [{"type": "mesh", "file": "bad.stl"}]})
    assert read == ["a.stl", "bad.stl"]


@pytest.mark.parametrize(
    ("shapes", "message"),
    [
        ("box", "must be a list"),
        ([1], "must be a list"),
        ([{}], "has the unknown type 'None': use one of box"),
        ([{"type": ["box"]}], "has the unknown type"),
        ([{"type": "box"}], r"shapes\[0\]\.size must be 3 numbers"),
        ([{"type": "box", "size": [1, 2]}], "must be 3 numbers"),
        ([{"type": "box", "size": [1, -2, 3]}], "at least 0"),
        ([{"type": "box", "size": [1, float("nan"), 3]}], "finite"),
        ([{"type": "box", "size": [1, True, 3]}], "finite"),
        ([{"type": "box", "size": [1, 10**400, 3]}], "finite"),
        ([{"type": "sphere", "radius": None}], "finite"),
        ([{**BOX, "pose": [0, 0, float("inf")]}], "finite"),
        ([{**BOX, "pose": "0 0 0"}], "must be .x, y, z"),
        ([{**BOX, "pose": [1e7, 1e7, 0, 0, 0, 0.5]}], "not finite metres"),
        ([{"type": "mesh"}], "path of a mesh"),
        ([{"type": "mesh", "file": "absent.dae"}], "absent.dae is missing: upload it together"),
        ([{"type": "mesh", "file": "../../etc/passwd"}], "is missing"),
        ([{"type": "plane", "normal": [0, 0, 0]}], "must not be zero"),
        ([{"type": "polyline", "height": 1}], "list of rings"),
        ([{"type": "polyline", "points": [[[0, 0], [1]]], "height": 1}], "list of rings"),
        ([{"type": "polyline", "points": [[[0, 0], [1, 1], [0, "a"]]], "height": 1}], "finite"),
        ([{"type": "heightmap", "file": "h.svg"}], "is missing"),
        ([{"type": "heightmap", "file": "bad.png"}], "bad.png cannot be read as an image"),
        ([{"type": "heightmap", "file": "dot.png"}], "2 × 2"),
        ([BOX] * 10_001, "the limit is 10000"),
    ],
)
def test_invalid_shapes_are_rejected_with_location(shapes: Any, message: str) -> None:
    files = {"bad.png": b"\x89PNG\r\n\x1a\n1234", "dot.png": picture([[1]])}
    with pytest.raises(Invalid, match=message) as caught:
        solids.triangles({"shapes": shapes}, files, planes=True)
    assert caught.value.problems


def test_degenerate_solids_are_accepted() -> None:
    for shape in (
        {"type": "box", "size": [0, 0, 0]},
        {"type": "sphere", "radius": 0},
        {"type": "cylinder", "radius": 0, "length": 0},
        {"type": "polyline", "points": [[[0, 0], [1, 1]]], "height": 1},
    ):
        triangles = one(shape)
        assert np.isfinite(triangles).all()
        assert solids.footprint({"shapes": [shape]}, {}).area == 0


def test_heavy_mesh_footprint_is_quick() -> None:
    n = 60_000
    corners = np.random.default_rng(1).uniform(-5, 5, (n, 3, 3)).astype("<f4")
    record = np.zeros(n, np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")]))
    record["corners"] = corners
    data = b" " * 80 + n.to_bytes(4, "little") + record.tobytes()
    start = time.process_time()
    ground = solids.footprint({"shapes": [{"type": "mesh", "file": "a.stl"}]}, {"a.stl": data})
    assert ground.is_valid
    assert ground.area == pytest.approx(100, rel=0.01)
    assert time.process_time() - start < 20
