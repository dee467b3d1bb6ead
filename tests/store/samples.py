"""Small synthetic layers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import shapely

from app.model.features import Features, features, from_columns, points
from app.model.frame import Datum
from app.model.grid import OccupancyGrid
from app.model.imagery import GeoImage
from app.model.layers import NETWORK, Layers, Part, PartKey, Resources
from app.model.voxels import VoxelMap
from app.store.base import environment_row
from app.store.changes import Changes, Operation, Replace
from app.store.store import Store
from app.store.values import Provenance, Source, Version
from app.store.versions import _append_sources

DATUM = Datum(53.2, -0.5, 12.0, 10.0)
TOPOLOGY = PartKey("topology", "ground", NETWORK)
OBJECTS = PartKey("objects", "ground", "osm")
GRID = PartKey("occupancy", "ground", "map")


def network(n: int, seed: int = 0, side: float = 500.0, anchor: Any = "local") -> Features:
    """Return n nodes at random positions, every third one with nested properties."""
    random = np.random.default_rng(seed)
    xy = random.random((n, 2)) * side
    if anchor == "wgs84":
        xy = xy / 1e5 + np.array([-0.5, 53.2])
    properties: list[dict[str, Any]] = [
        {
            "kind": "node",
            "name": f"W{i}",
            "weight": float(i),
            "count": i,
            **({"tags": {"z": [1, 1.0, None]}} if i % 3 == 0 else {}),
        }
        for i in range(n)
    ]
    return from_columns([f"n{i}" for i in range(n)], points(xy), properties, anchor, {"tmap2": {"name": "test"}})


def mixed() -> Features:
    """Return all kinds of geometry, both anchors, heights, and an item without coordinates."""
    local = features(
        [
            ("p", shapely.Point(1.5, -2.5), {"kind": "poi"}),
            ("z", shapely.Point(1, 2, 3), {"a": 1, "b": 1.0, "c": True, "d": None, "e": "ü", "f": [1, [2, {"g": 3}]]}),
            ("l", shapely.LineString([(0, 0), (10, 0), (10, 5)]), {}),
            ("a", shapely.Polygon([(0, 0), (4, 0), (4, 4)], [[(1, 0.5), (2, 0.5), (2, 1)]]), {"kind": "region"}),
            ("none", None, {"note": "nowhere"}),
        ],
        "local",
        {"kml": {"name": "doc", "styles": ["x" * 5000]}, "bounds": [1.0, 2.0, 3.0, 4.0]},
    )
    earth = features(
        [
            ("e", shapely.Point(-0.5, 53.2), {"osm": {"id": 2**53 + 1}}),
            ("m", shapely.MultiPolygon([shapely.box(-0.51, 53.2, -0.5, 53.21)]), {}),
        ],
        "wgs84",
    )
    from app.model.features import concatenate

    return concatenate([local, earth])


def grid(width: int = 600, height: int = 300, seed: int = 0, **options: Any) -> OccupancyGrid:
    """Return an unknown grid with a free room and walls."""
    cells = np.full((height, width), 255, np.uint8)
    cells[20:-20, 20:-20] = 0
    cells[20, 20:-20] = 100
    spots = np.random.default_rng(seed).integers(0, [[height], [width]], (2, 50))
    cells[spots[0], spots[1]] = 37
    given = {"resolution": 0.05, "origin": (-3.0, 2.0, 0.0), "mode": "scale", "properties": {"yaml": {"x": 1}}}
    return OccupancyGrid(cells, **(given | options))


def voxels(n: int = 5000, seed: int = 0) -> VoxelMap:
    """Return leaves of the smallest size."""
    code = np.unique(np.random.default_rng(seed).integers(0, 2**40, n, dtype=np.uint64))
    return VoxelMap(
        0.05,
        np.full(len(code), 16, np.uint8),
        code,
        np.linspace(-2, 3, len(code)).astype(np.float32),
        np.arange(len(code) * 3, dtype=np.uint8).reshape(-1, 3),
        binary=False,
        properties={"id": "OcTree"},
    )


def picture(seed: int = 0, dtype: Any = np.uint8) -> GeoImage:
    """Return an image of three bands, larger than a tile."""
    pixels = (np.random.default_rng(seed).random((300, 270, 3)) * 200).astype(dtype)
    return GeoImage(pixels, (0.1, 0.0, -5.0, 0.0, -0.1, 20.0), "local", {"png": {"dpi": 72}})


def everything() -> dict[PartKey, Part]:
    """Return one part of every kind."""
    return {
        TOPOLOGY: network(300),
        OBJECTS: mixed(),
        PartKey("location", "ground", "site"): features(
            [("fence", shapely.box(-0.501, 53.199, -0.499, 53.201), {"kind": "fence"})], "wgs84"
        ),
        PartKey("zones", "first", "zones"): features([], "local"),
        GRID: grid(),
        PartKey("voxels", "ground", "tree"): voxels(),
        PartKey("imagery", "ground", "photo"): picture(),
        PartKey("resources", "ground", "gazebo"): Resources(
            {"models/a.dae": b"<dae/>", "models/b.stl": bytes(range(256)) * 400, "empty": b""}
        ),
    }


def replaces(parts: dict[PartKey, Part]) -> tuple[Operation, ...]:
    return tuple(Replace(key, part, Provenance()) for key, part in parts.items())


def save(store: Store, environment: str, *operations: Operation, base: Version | None = None, **frame: Any) -> Version:
    """Prepare on the head and commit."""
    prepared = store.versions.prepare(base or store.versions.get(environment), Changes(tuple(operations), **frame))
    return store.versions.commit(environment, prepared, author="ann", message="edit")


def add_sources(store: Store, environment: str, number: int, *sources: Source) -> Version:
    """Add files to a version, as an upload without changes does to the head; returns the version."""
    with store._database.write() as connection:
        row = environment_row(connection, environment, lock=True)
        _append_sources(connection, row.id, number, sources)
    return store.versions.get(environment, number)


def rows(f: Features) -> dict[str, tuple[str, Any, bool]]:
    """Return features as comparable values: id -> (WKB, properties with their types, local)."""
    return {
        x.id: (shapely.to_wkt(x.geometry, rounding_precision=-1), typed(x.properties), x.anchor == "local") for x in f
    }


def typed(value: Any) -> Any:
    """Return a comparable value that distinguishes 1, 1.0 and True."""
    if isinstance(value, dict):
        return {k: typed(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [typed(v) for v in value]
    return (type(value).__name__, value)


def assert_same_part(a: Part, b: Part) -> None:
    assert type(a) is type(b)
    if isinstance(a, Features):
        assert isinstance(b, Features)
        assert rows(a) == rows(b)
        assert typed(dict(a.document)) == typed(dict(b.document))
    elif isinstance(a, Resources):
        assert isinstance(b, Resources)
        assert dict(a.files) == dict(b.files)
    else:
        for name in a.__slots__:
            x, y = getattr(a, name), getattr(b, name)
            if isinstance(x, np.ndarray):
                assert x.dtype == y.dtype
                assert np.array_equal(x, y, equal_nan=x.dtype.kind == "f"), name
            else:
                assert x == y, name


def assert_same_layers(a: Layers, b: Layers) -> None:
    assert a.datum == b.datum
    assert set(a.parts) == set(b.parts)
    for key in a.parts:
        assert_same_part(a.parts[key], b.parts[key])


def ids(values: Sequence[str]) -> list[str]:
    return sorted(values)
