"""Derivations of bad content give a clear problem or a non-empty result, never a plausible empty map or a 500."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest
import shapely
from numpy.typing import NDArray

from app import derive, formats
from app.derive import DerivationNotes, imagery_to_objects, imagery_to_occupancy, occupancy_to_objects
from app.errors import FleetMapError
from app.model.features import Features
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from app.model.imagery import GeoImage
from app.model.layers import Layers, PartKey
from tests.api.conftest import Api

Cells = NDArray[np.uint8]

YAML = "image: map.pgm\nresolution: {}\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"


def grid(shade: int, width: int, height: int, resolution: float = 0.1) -> dict[str, bytes]:
    head = f"P5 {width} {height} 255\n".encode()
    return {"map.yaml": YAML.format(resolution).encode(), "map.pgm": head + bytes([shade]) * (width * height)}


GRIDS = {
    "all free": grid(254, 30, 20),
    "all occupied": grid(0, 30, 20),
    "all unknown": grid(205, 30, 20),
    "1 x 1 free": grid(254, 1, 1),
    "1 x 1 occupied": grid(0, 1, 1),
    "1 x 1 unknown": grid(205, 1, 1),
    "a line": grid(254, 200, 1),
}
OF_GRIDS = sorted(name for name, d in derive.all_derivations().items() if "occupancy" in d.needs and not d.is_terminal)
METHODS: dict[str, list[dict[str, Any]]] = {
    "occupancy_to_topology": [{"method": "skeleton"}, {"method": "roadmap"}, {"method": "voronoi"}]
}
GIVES = {
    # Derivations that work on such a grid; all others are rejected.
    ("occupancy_to_voxels", "all occupied"),
    ("occupancy_to_voxels", "1 x 1 occupied"),
    ("occupancy_to_voxels", "all free"),
    ("occupancy_to_voxels", "1 x 1 free"),
    ("occupancy_to_voxels", "a line"),
    ("occupancy_to_imagery", "all free"),
    ("occupancy_to_imagery", "all occupied"),
    ("occupancy_to_imagery", "1 x 1 free"),
    ("occupancy_to_imagery", "1 x 1 occupied"),
    ("occupancy_to_imagery", "a line"),
}


@pytest.mark.parametrize("case", GRIDS)
def test_grids_without_content_return_problems(api: Api, fresh: Callable[[], str], case: str) -> None:
    assert OF_GRIDS, "no derivation takes a grid"
    env = fresh()
    api.post("environments", {"name": env})
    api.upload(env, GRIDS[case])
    for name in OF_GRIDS:
        for values in METHODS.get(name, [{}]):
            request = {"method": name, "parameters": values}
            answer = api("POST", f"environments/{env}/derivations", json=request)
            if (name, case) in GIVES:
                assert answer.status_code == 201, (name, values, answer.text)
                continue
            assert answer.status_code == 422, (name, values, answer.text)
            assert "grid" in answer.json()["detail"], (name, answer.text)
    # The coverage table matches the downloads.
    for row in api.get(f"environments/{env}/versions/1/maps").json():
        answer = api("GET", f"environments/{env}/versions/1/maps/{row['format']}")
        if row["state"] == "missing":
            assert row["missing"], row
            assert answer.status_code in (409, 422), (row, answer.status_code, answer.text[:300])
        else:
            assert answer.status_code == 200, (row, answer.text[:300])
            assert answer.content


# --- meshes -----------------------------------------------------------------------------------------------------------
def stl(triangles: Any) -> bytes:
    rows = np.asarray(triangles, np.float32).reshape(-1, 3, 3)
    body = b"".join(struct.pack("<12fH", 0, 0, 1, *row.ravel().tolist(), 0) for row in rows)
    return bytes(80) + struct.pack("<I", len(rows)) + body


def box(size: float, *, lid: bool = True) -> NDArray[np.float32]:
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32) * size
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4)] + ([(1, 5, 7, 3)] if lid else [])
    return np.array([corners[list(t)] for a, b, c, d in faces for t in ((a, b, c), (a, c, d))], np.float32)


FLAT = [[[0, 0, 0.2], [3, 0, 0.2], [0, 3, 0.2]]]
MESHES: dict[str, bytes | None] = {
    "open: without a lid": stl(box(2.0, lid=False)),
    "open: one wall": stl([[[0, 0, 0], [2, 0, 0], [0, 0, 2]], [[2, 0, 0], [2, 0, 2], [0, 0, 2]]]),
    "inside out": stl(box(2.0)[:, ::-1]),
    "each triangle twice": stl(np.concatenate([box(2.0), box(2.0)])),
    "points and lines": stl([[[1, 1, 1]] * 3, [[0, 0, 0], [1, 1, 1], [2, 2, 2]]]),
    "lying in the plane of the cut": stl(FLAT),
    "a body and points": stl(np.concatenate([box(2.0), np.ones((3, 3, 3), np.float32)])),
    "not a number": stl([[[math.nan] * 3, [0, 0, 0], [1, 1, 1]]]),
    "beyond the world": stl(box(1e30)),
    "without triangles": stl([]),
    "cut short": stl(box(2.0))[:-30],
    "something else": b"<html>no mesh</html>",
    "missing": None,
}
SOUND = {
    "open: without a lid",
    "open: one wall",
    "inside out",
    "each triangle twice",
    "a body and points",
}
"""Meshes that are obstacles for a robot, and are detected."""


def world(mesh: bytes | None) -> dict[str, bytes]:
    shape = "<geometry><mesh><uri>model://thing/thing.stl</uri></mesh></geometry>"
    link = f"<link name='l'><collision name='c'>{shape}</collision></link>"
    text = f"<sdf version='1.9'><world name='w'><model name='m'><static>true</static>{link}</model></world></sdf>"
    files = {"w.world": text.encode()}
    if mesh is not None:
        files |= {"models/thing/thing.stl": mesh, "models/thing/model.config": b"<model><name>thing</name></model>"}
        files["models/thing/model.sdf"] = f"<sdf version='1.9'><model name='thing'>{link}</model></sdf>".encode()
    return files


@pytest.mark.parametrize("case", MESHES)
def test_bad_meshes_are_sliced_or_reported(api: Api, fresh: Callable[[], str], case: str) -> None:
    env = fresh()
    api.post("environments", {"name": env})
    answer = api.upload(env, world(MESHES[case]), expect=None)
    if answer.status_code != 201:
        assert answer.status_code == 422, answer.text
        assert case not in SOUND
        return
    for path in ("occupancy_grid/map.pgm?resolution=0.1", "octomap?resolution=0.1"):
        response = api("GET", f"environments/{env}/versions/latest/maps/{path}")
        if case in SOUND:
            assert response.status_code == 200, (path, response.text)
        if response.status_code != 200:
            assert response.status_code == 422, (path, response.status_code)
            assert response.json()["detail"]
        elif path.startswith("octomap"):
            size = next(line for line in response.content.split(b"\n") if line.startswith(b"size "))
            assert int(size.split()[1]) > 1
        else:
            assert 0 in response.content.split(b"255\n", 1)[1], "a map without an obstacle looks right"


# --- pictures ---------------------------------------------------------------------------------------------------------
def test_picture_without_position_is_rejected_with_advice(api: Api, fresh: Callable[[], str]) -> None:
    env = fresh()
    api.post("environments", {"name": env})
    ok, png = cv2.imencode(".png", np.full((20, 30, 3), 90, np.uint8))
    assert ok
    refused = api.upload(env, {"above.png": png.tobytes()}, expect=422, format="satellite").json()
    text = refused["detail"] + json.dumps(refused.get("errors", []))
    assert "corners=" in text
    assert "metres_per_pixel" in text
    # In WGS 84, but in an environment without a datum.
    world_file = b"0.00001\n0\n0\n-0.00001\n10\n52\n"
    api.upload(env, {"above.png": png.tobytes(), "above.pgw": world_file}, format="satellite", crs="EPSG:4326")
    for method in ("imagery_to_occupancy", "imagery_to_objects"):
        answer = api("POST", f"environments/{env}/derivations", json={"method": method, "parameters": {}})
        assert answer.status_code == 422, answer.text
        assert answer.json()["detail"]


def pictures(seed: int) -> GeoImage:
    """Build a random image of noise, one colour or blocks, of any type, number of bands, position and size."""
    rng = np.random.default_rng(seed)
    height, width = (int(v) for v in rng.integers(1, 90, 2))
    if seed % 7 == 0:
        height, width = (1, int(rng.integers(1, 400))) if seed % 2 else (int(rng.integers(1, 400)), 1)
    bands = int(rng.choice([1, 1, 2, 3, 3, 3, 4, 4, 6]))
    kind = seed % 4
    if kind == 0:
        values = rng.integers(0, 256, (height, width, bands))
    elif kind == 1:
        values = np.full((height, width, bands), int(rng.integers(0, 256)))
    elif kind == 2:
        blocks = rng.integers(0, 256, (height // 9 + 1, width // 9 + 1, bands))
        values = blocks.repeat(9, axis=0).repeat(9, axis=1)[:height, :width]
    else:
        values = np.zeros((height, width, bands), int)
        values[height // 3 :, width // 3 :] = rng.integers(0, 256, bands)
    pixels: NDArray[Any] = values.astype(rng.choice(["uint8", "uint8", "uint16", "int16", "float32", "float64"]))
    more: dict[str, Any] = {}
    if pixels.dtype.kind == "f":
        maximum = float(np.finfo(pixels.dtype).max)
        pixels.reshape(-1)[:: int(rng.integers(2, 9))] = rng.choice([np.nan, np.inf, -np.inf, maximum, 0.0])
    if seed % 5 == 0:
        more["nodata"] = float(pixels.reshape(-1)[0]) if np.isfinite(pixels.reshape(-1)[0]) else "nan"
    if seed % 6 == 0:
        more["bands"] = [{"colour": str(rng.choice(["gray", "red", "nir", "alpha", "palette", "mask"]))}] * bands
    if seed % 11 == 0:
        more["palette"] = rng.integers(0, 256, (int(rng.integers(1, 257)), 4)).tolist()
    a, b, c, d, e, f = (rng.normal(0, 1, 6) * 10.0 ** rng.integers(-3, 3)).tolist()
    transform = (a, b, c, d, e, f) if seed % 3 == 0 else (0.5, 0.0, c, 0.0, -0.5, f)
    return GeoImage(pixels, transform, "local", properties=more)


ODD: list[dict[str, Any]] = [
    {},
    {"segmentation": "colour", "clusters": 2, "minimum_area": 0.0},
    {"segmentation": "colour", "clusters": 32, "resolution": 0.05},
    {"segmentation": "index", "minimum_area": 0.0},
    {"segmentation": "index", "near_infrared": 1},
    {"segmentation": "plan", "gap": 0.0, "minimum_area": 0.0},
    {"segmentation": "plan", "gap": 20.0, "outside_free": True, "resolution": 100.0},
    {"resolution": 100.0},
    {"segmentation": "model", "model": "../../etc/passwd"},
]


@pytest.mark.parametrize("seed", range(45))
def test_any_picture_gives_objects_or_a_clear_problem(seed: int) -> None:
    layers = Layers({PartKey("imagery", "ground", "satellite"): pictures(seed)})
    for module in (imagery_to_objects, imagery_to_occupancy):
        function = getattr(module, module.__name__.rpartition(".")[2])
        try:
            derived_layers = function(layers, module.Parameters(**ODD[seed % len(ODD)]), DerivationNotes())
        except FleetMapError as error:
            assert error.detail
            continue
        (part,) = derived_layers.parts.values()
        if isinstance(part, Features):
            assert len(part)
            assert shapely.is_valid(part.geometry).all()
            assert np.isfinite(shapely.bounds(part.geometry)).all()
            assert all(0 <= p.get("confidence", 1) <= 1 for p in part.properties)
        else:
            assert isinstance(part, OccupancyGrid)
            assert (part.cells == FREE).any()
            assert all(math.isfinite(v) for v in (*part.origin, part.resolution))


# --- grids with anything in them --------------------------------------------------------------------------------------
def grids(seed: int) -> OccupancyGrid:
    rng = np.random.default_rng(seed)
    height, width = (int(v) for v in rng.integers(1, 80, 2))
    if seed % 6 == 0:
        height = 1
    cells: Cells = rng.choice(np.array([FREE, OCCUPIED, UNKNOWN, 1, 50, 99, 66], np.uint8), (height, width))
    if seed % 3:
        block = int(rng.integers(2, 12))
        cells = cells[::block, ::block].repeat(block, axis=0).repeat(block, axis=1)[:height, :width].copy()
    resolution = float(10.0 ** rng.uniform(-3, 2))
    origin = tuple((rng.normal(0, 1, 3) * [1e5, 1e5, 3]).tolist())
    low, high = sorted(rng.uniform(0, 1, 2).tolist())
    return OccupancyGrid(cells, resolution, origin, occupied_thresh=high, free_thresh=low)  # type: ignore[arg-type]


HARD: list[dict[str, Any]] = [
    {},
    {"context": "forest", "minimum_size": 0.0},
    {"context": "orchard", "tolerance": 0.0, "minimum_size": 0.0},
    {"context": "warehouse", "tolerance": 100.0},
    {"wall_width": 0.0, "minimum_size": 0.0, "height": 0.001},
    {"wall_width": 10.0, "height": 1000.0},
    {"minimum_size": 100.0},
]


@pytest.mark.parametrize("seed", range(42))
def test_any_grid_gives_objects_or_a_clear_problem(seed: int) -> None:
    grid = grids(seed)
    layers = Layers({PartKey("occupancy"): grid})
    try:
        derived_layers = occupancy_to_objects.occupancy_to_objects(
            layers, occupancy_to_objects.Parameters(**HARD[seed % len(HARD)]), DerivationNotes()
        )
    except FleetMapError as error:
        assert error.detail
        return
    (part,) = derived_layers.parts.values()
    assert isinstance(part, Features)
    assert len(part)
    assert shapely.is_valid(part.geometry).all()
    # They are inside the grid, and can be written as a world.
    x, y, yaw = grid.origin
    around = shapely.transform(
        shapely.box(0, 0, grid.width * grid.resolution, grid.height * grid.resolution),
        lambda at: at @ np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]]) + [x, y],
    )
    reach = 3 * grid.resolution + 2 * HARD[seed % len(HARD)].get("tolerance", 0.0)
    assert shapely.covered_by(shapely.centroid(part.geometry), around.buffer(reach)).all()
    gazebo = formats.get_format("gazebo")
    assert gazebo.write(derived_layers, formats.WriteContext(options=gazebo.write_options()))
