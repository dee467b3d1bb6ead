"""Canonical values: invalid ones are rejected, and they are immutable."""

from __future__ import annotations

import dataclasses
import math
import sys
from typing import Any

import numpy as np
import pytest
import shapely

from app.errors import Invalid
from app.model.features import (
    MAX_ID,
    NO_GEOMETRY,
    Features,
    concatenate,
    features,
    from_columns,
    points,
    segments,
    shared_key_dict,
    unique_ids,
)
from app.model.frame import MAX_METRES, Datum, Level, is_writable
from app.model.grid import OccupancyGrid
from app.model.imagery import GeoImage
from app.model.layers import LAYERS, PART_TYPES, Layers, PartKey, Resources, is_empty, join_levels
from app.model.voxels import VoxelMap, gather, morton, spread

NAN, INF = math.nan, math.inf
CELLS = np.zeros((2, 3), np.uint8)


def at(*coordinates: float) -> Features:
    return features([("a", shapely.Point(*coordinates), {})], "wgs84")


# --- datum and levels ---------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("latitude", [NAN, INF, -INF, 85.1, -85.1, 90.0, True, "53", None]),
        ("longitude", [NAN, INF, 180.1, -180.1, True]),
        ("altitude", [NAN, INF, -12_001.0, 100_001.0]),
        ("heading", [NAN, INF, 361.0, -361.0]),
    ],
)
def test_datum_must_be_on_earth(name: str, values: list[Any]) -> None:
    good = {"latitude": 53.0, "longitude": 0.1, "altitude": 0.0, "heading": 0.0}
    for value in values:
        with pytest.raises(Invalid, match=name):
            Datum(**{**good, name: value})


def test_equal_datums_are_equal() -> None:
    assert Datum(53, 0) == Datum(53.0, -0.0, -0.0, 0)
    assert repr(Datum(53, 0)) == repr(Datum(53.0, -0.0))
    assert Datum(-85.0, 180.0, 1.0, -360.0).as_dict() == {
        "latitude": -85.0,
        "longitude": 180.0,
        "altitude": 1.0,
        "heading": -360.0,
    }
    with pytest.raises(dataclasses.FrozenInstanceError):
        Datum(53.0, 0.1).latitude = 1.0  # type: ignore[misc]


@pytest.mark.parametrize(
    ("name", "elevation"), [("", 0), ("a\nb", 0), ("x" * 257, 0), ("a", NAN), ("a", INF), ("a", 1e8)]
)
def test_level_requires_name_and_elevation(name: str, elevation: float) -> None:
    with pytest.raises(Invalid):
        Level(name, elevation)


def test_levels_are_merged_by_name() -> None:
    joined = join_levels([Level(), Level("L2", 3.0)], [Level("L1", -2.5), Level("L2", 4.0)])
    assert [(level.name, level.elevation) for level in joined] == [("L1", -2.5), ("ground", 0.0), ("L2", 4.0)]


# --- features -----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    "coordinates",
    [(NAN, 1), (1, NAN), (INF, 1), (181, 1), (-180.001, 1), (1, 90.001), (1, -91), (1, 1, INF), (1, 1, 1e8)],
)
def test_degrees_must_be_in_range(coordinates: tuple[float, ...]) -> None:
    with pytest.raises(Invalid) as error:
        at(*coordinates)
    assert error.value.problems[0].where == "a"


@pytest.mark.parametrize("coordinates", [(180, 90), (-180, -90), (0, 0), (1, 1, -MAX_METRES)])
def test_extreme_degrees_are_accepted(coordinates: tuple[float, ...]) -> None:
    assert len(at(*coordinates)) == 1


@pytest.mark.parametrize("coordinates", [(NAN, 0), (0, INF), (1.0001e7, 0), (0, -1.0001e7), (0, 0, INF)])
def test_metres_must_be_in_range(coordinates: tuple[float, ...]) -> None:
    with pytest.raises(Invalid, match="metres"):
        features([("a", shapely.Point(*coordinates), {})], "local")
    features([("a", shapely.Point(500, 300), {})], "local")


def test_invalid_feature_of_many_is_named() -> None:
    line = shapely.LineString([(0, 0), (1, 1)])
    bad = shapely.LineString([(0, 0), (1, INF)])
    with pytest.raises(Invalid, match="'third'"):
        features([("first", line, {}), ("second", NO_GEOMETRY, {}), ("third", bad, {})], "wgs84")
    nested = shapely.GeometryCollection([shapely.MultiPoint([(0, 0), (0, 91)])])
    with pytest.raises(Invalid, match="'b'"):
        features([("a", line, {}), ("b", nested, {})], "wgs84")


def test_invalid_feature_of_very_many_is_named() -> None:
    at = np.zeros((70_000, 2))
    at[66_000] = (2e7, 0)
    with pytest.raises(Invalid, match="'i66000' has the coordinates"):
        from_columns([f"i{k}" for k in range(len(at))], points(at), [{}] * len(at), "local")


def test_shared_key_dicts_are_ordinary_dicts_with_less_memory() -> None:
    pattern = shared_key_dict("kind", "source", "target")
    one, two = pattern.copy(), pattern.copy()
    one["kind"], one["source"], one["target"] = "edge", "a", "b"
    assert one == {"kind": "edge", "source": "a", "target": "b"}
    assert list(one) == ["kind", "source", "target"]
    assert two == {"kind": None, "source": None, "target": None}
    assert sys.getsizeof(one) <= 0.7 * sys.getsizeof({"kind": "edge", "source": "a", "target": "b"})
    two["more"] = 1
    assert "more" not in one
    assert "more" not in pattern.copy()


def test_2d_and_3d_geometries_may_be_mixed() -> None:
    both = features([("a", shapely.Point(1, 1), {}), ("b", shapely.Point(1, 1, 5), {}), ("c", None, {})], "wgs84")
    assert [g.has_z for g in both.geometry] == [False, True, False]


@pytest.mark.parametrize("name", ["", "x" * (MAX_ID + 1), "a\nb", "a\x00", "\x85", "\u2028", "\ud800"])
def test_id_must_fit_one_line(name: str) -> None:
    with pytest.raises(Invalid):
        features([(name, shapely.Point(0, 0), {})], "local")
    with pytest.raises(Invalid):
        PartKey("objects", "ground", name or "")


@pytest.mark.parametrize(
    "name", ["a b", "n-12", "größe", "北門", "全角\u3000空白", "nb\xa0sp", "zero\u200bwidth", "👩\u200d🌾", "\u202eabc"]
)
def test_real_names_are_valid_ids(name: str) -> None:
    assert features([(name, shapely.Point(0, 0), {})], "local").ids == (name,)
    assert PartKey("objects", name, name).name == name
    assert is_writable(name)


def test_ids_must_be_distinct() -> None:
    with pytest.raises(Invalid, match="'a'"):
        features([("a", None, {}), ("b", None, {}), ("a", None, {})], "local")
    one = features([("a", None, {})], "local")
    with pytest.raises(Invalid, match="'a'"):
        concatenate([one, one])
    assert unique_ids(["a", "b", "a", "a", "a#2", "c"], {"c"}) == ["a", "b", "a#2", "a#3", "a#2#2", "c#2"]


def test_feature_columns_must_have_equal_length_and_type() -> None:
    geometry = points(np.zeros((2, 2)))
    local = np.ones(2, bool)
    with pytest.raises(ValueError, match="columns differ"):
        Features(("a",), geometry, ({}, {}), local)
    with pytest.raises(ValueError, match="bool"):
        Features(("a", "b"), geometry, ({}, {}), np.ones(2))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="NO_GEOMETRY"):
        Features(("a", "b"), np.array([geometry[0], None], object), ({}, {}), local)


def test_features_are_immutable() -> None:
    one = from_columns(["a", "b"], points(np.zeros((2, 2))), [{"kind": "node"}, {}], "local")
    with pytest.raises(ValueError, match="read-only"):
        one.geometry[0] = NO_GEOMETRY
    with pytest.raises(ValueError, match="read-only"):
        one.local[0] = False
    with pytest.raises(dataclasses.FrozenInstanceError):
        one.ids = ()  # type: ignore[misc]


def test_features_select_and_concatenate() -> None:
    rows = [("a", shapely.Point(0, 0), {"kind": "node"}), ("b", None, {"kind": "edge"}), ("c", None, {})]
    collection = features(rows, "local", {"x": {"name": "n"}})
    assert collection.select_kinds("node", "edge").ids == ("a", "b")
    assert collection.select(np.array([False, True, True])).ids == collection.select([1, 2]).ids == ("b", "c")
    assert collection.select([2, 0]).ids == ("c", "a")
    assert collection.select([]).document == {"x": {"name": "n"}}
    assert collection.index() == {"a": 0, "b": 1, "c": 2}
    assert [(f.id, f.anchor) for f in collection] == [("a", "local"), ("b", "local"), ("c", "local")]
    other = features([("d", None, {})], "wgs84", {"x": {"style": 1}, "y": 2})
    both = concatenate([collection, other])
    assert both.ids == ("a", "b", "c", "d")
    assert both.local.tolist() == [True, True, True, False]
    assert both.document == {"x": {"name": "n", "style": 1}, "y": 2}
    assert len(concatenate([])) == 0
    lines = segments(np.array([[0.0, 0.0]]), np.array([[1.0, 2.0]]))
    assert lines[0].wkt == "LINESTRING (0 0, 1 2)"


# --- grids --------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    "cells",
    [
        np.zeros((2, 3), np.int8),
        np.zeros((2, 3)),
        np.zeros(3, np.uint8),
        np.zeros((0, 3), np.uint8),
        np.zeros((2, 0), np.uint8),
    ],
)
def test_grid_cells_must_be_rows_of_bytes(cells: Any) -> None:
    with pytest.raises(Invalid, match="uint8"):
        OccupancyGrid(cells, 0.05)


@pytest.mark.parametrize("shape", [(1, 1), (3, 5), (2000, 700)])
def test_grid_cells_must_be_0_to_100_or_unknown(shape: tuple[int, int]) -> None:
    for value in range(256):
        cells = np.zeros(shape, np.uint8)
        cells[-1, -1] = value
        if value <= 100 or value == 255:
            OccupancyGrid(cells, 0.05)
        else:
            with pytest.raises(Invalid, match="0 to 100"):
                OccupancyGrid(cells, 0.05)


@pytest.mark.parametrize(
    "bad",
    [
        *({"resolution": v} for v in (0.0, -0.05, NAN, INF, 1e-7, 1e5)),
        *({"origin": v} for v in ((0, 0), (0, 0, NAN), (INF, 0, 0), (0, 1.1e7, 0), (0, 0, 0, 0))),
        *({"occupied_thresh": v} for v in (NAN, -0.1, 1.1)),
        *({"free_thresh": v} for v in (NAN, -0.1, 1.1)),
        {"mode": "Trinary"},
        {"mode": ""},
    ],
)
def test_grid_requires_valid_origin_and_resolution(bad: dict[str, Any]) -> None:
    with pytest.raises(Invalid):
        OccupancyGrid(**{"cells": CELLS.copy(), "resolution": 0.05, **bad})


def test_grid_counts_cells_and_returns_corners() -> None:
    cells = np.array([[0, 100, 255], [50, 100, 255]], np.uint8)
    grid = OccupancyGrid(cells, 0.5, (1.0, 2.0, math.pi / 2))
    assert grid.counts() == {"occupied": 2, "free": 1, "unknown": 2, "other": 1}
    assert np.allclose(grid.corners(), [[1, 2], [1, 3.5], [0, 3.5], [0, 2]])
    assert (grid.width, grid.height) == (3, 2)
    with pytest.raises(ValueError, match="read-only"):
        grid.cells[0, 0] = 1
    plain = OccupancyGrid(CELLS.copy(), 1, (0, -0.0, 0), "raw", 1, 0)
    assert repr((plain.resolution, plain.origin, plain.occupied_thresh)) == "(1.0, (0.0, 0.0, 0.0), 1.0)"


# --- voxels and pictures ------------------------------------------------------------------------------------------
def voxels(**other: Any) -> VoxelMap:
    values: dict[str, Any] = {
        "resolution": 0.1,
        "depth": np.array([16, 1], np.uint8),
        "code": np.array([5, 7], np.uint64),
        "log_odds": np.array([1, -1], np.float32),
    }
    return VoxelMap(**{**values, **other})


@pytest.mark.parametrize(
    "bad",
    [
        *({"resolution": v} for v in (0.0, -1.0, NAN, INF, 1e-7)),
        {"depth": np.array([0, 1], np.uint8)},
        {"depth": np.array([17, 1], np.uint8)},
        {"depth": np.array([16, 1], np.int64)},
        {"depth": np.array([16], np.uint8)},
        {"code": np.array([5, 8], np.uint64)},
        {"code": np.array([2**48, 0], np.uint64)},
        {"code": np.array([5, 7], np.int64)},
        {"log_odds": np.array([NAN, 0], np.float32)},
        {"log_odds": np.array([INF, 0], np.float32)},
        {"log_odds": np.array([0, 0], np.float64)},
        {"depth": np.array([1, 16], np.uint8), "code": np.array([7, 5], np.uint64)},
        {"depth": np.array([16, 16], np.uint8), "code": np.array([5, 5], np.uint64)},
        {"depth": np.array([15, 16], np.uint8), "code": np.array([1, 15], np.uint64)},
        {"depth": np.array([16, 15], np.uint8), "code": np.array([8, 1], np.uint64)},
        {"code": np.array([5, 2**63 + 7], np.uint64)},
        {"colour": np.zeros((2, 4), np.uint8)},
        {"colour": np.zeros((1, 3), np.uint8)},
        {"colour": np.zeros((2, 3), np.float32)},
    ],
)
def test_voxels_must_be_inside_tree(bad: dict[str, Any]) -> None:
    with pytest.raises((Invalid, ValueError)):
        voxels(**bad)


def test_voxel_positions_and_bounds() -> None:
    axes = [np.array([-32768, -1, 0, 1, 12345, 32767])] * 3
    x, y, z = axes[0], axes[1][::-1], axes[2] * 0 + 7
    code = morton(x, y, z)
    order = np.argsort(code)
    voxel_map = VoxelMap(0.5, np.full(6, 16, np.uint8), code[order], np.zeros(6, np.float32))
    for k, axis in enumerate((x, y, z)):
        low, end = voxel_map.axis(k)
        assert low.tolist() == axis[order].tolist()
        assert (end - low).tolist() == [1] * 6
    assert voxel_map.bounds() == (-16384.0, -16384.0, 3.5, 16384.0, 16384.0, 4.0)
    assert (spread(gather(code)) == code & np.uint64(0x249249249249)).all()
    big = VoxelMap(1.0, np.array([1, 1], np.uint8), np.array([0, 7], np.uint64), np.array([-1.0, 0.0], np.float32))
    assert big.bounds() == (-(2.0**15), -(2.0**15), -(2.0**15), 2.0**15, 2.0**15, 2.0**15)
    assert big.voxel_counts() == {"occupied": 2**45, "free": 2**45}
    assert big.leaf_counts() == {"occupied": 1, "free": 1}
    assert big.place.tolist() == [0, 7 * 8**15]


def test_voxels_are_immutable() -> None:
    voxel_map = voxels(colour=np.zeros((2, 3), np.uint8))
    assert voxel_map.colour is not None
    for column in (voxel_map.depth, voxel_map.code, voxel_map.log_odds, voxel_map.colour):
        with pytest.raises(ValueError, match="read-only"):
            column[0] = 1
    empty = VoxelMap(0.1, np.empty(0, np.uint8), np.empty(0, np.uint64), np.empty(0, np.float32))
    assert len(empty.depth) == 0


@pytest.mark.parametrize(
    "bad",
    [
        {"pixels": np.zeros((2, 3), np.uint8)},
        {"pixels": np.zeros((2, 3, 0), np.uint8)},
        {"pixels": np.zeros((0, 3, 1), np.uint8)},
        {"transform": (1, 0, 0, 0, -1)},
        {"transform": (1, 0, NAN, 0, -1, 0)},
        {"transform": (1, 0, 0, 0, INF, 0)},
        {"transform": (0, 0, 0, 0, 0, 0)},
        {"transform": (1, 2, 0, 2, 4, 0)},
        {"crs": ""},
    ],
)
def test_image_requires_valid_transform_and_crs(bad: dict[str, Any]) -> None:
    good: dict[str, Any] = {"pixels": np.zeros((2, 3, 1), np.uint8), "transform": (1, 0, 0, 0, -1, 0)}
    GeoImage(**good)
    with pytest.raises(Invalid):
        GeoImage(**{**good, **bad})


# --- all together -------------------------------------------------------------------------------------------------
def test_part_keys_are_checked() -> None:
    with pytest.raises(Invalid, match="unknown layer"):
        PartKey("roads")  # type: ignore[arg-type]
    for level, name in (("", "a"), ("a", ""), ("x" * 257, "a"), ("a\tb", "a"), ("a", "b\x7f")):
        with pytest.raises(Invalid):
            PartKey("objects", level, name)
    keys = [PartKey("topology"), PartKey("objects", "b"), PartKey("objects", "a", "z"), PartKey("objects", "a", "y")]
    assert sorted(keys) == [keys[3], keys[2], keys[1], keys[0]]
    assert set(PART_TYPES) == set(LAYERS)


def test_layers_require_part_types_of_their_keys() -> None:
    grid, network = OccupancyGrid(CELLS.copy(), 0.1), features([("n", shapely.Point(0, 0), {})], "local")
    with pytest.raises(ValueError, match="Features"):
        Layers({PartKey("topology"): grid})
    with pytest.raises(ValueError, match="OccupancyGrid"):
        Layers({PartKey("occupancy"): network})
    upper = PartKey("occupancy", "L1", "map")
    layers = Layers(
        {
            PartKey("occupancy"): grid,
            upper: grid,
            PartKey("topology", name="network"): network,
            PartKey("objects", name="osm"): features([], "wgs84"),
            PartKey("resources", name="kml"): Resources({"a.png": b"1"}),
            PartKey("resources", name="osm"): Resources({}),
        },
        levels=(Level(), Level("L1", 3.0)),
    )
    assert layers.layers == {"occupancy", "topology", "resources"}
    assert list(layers.grids("L1")) == [upper]
    assert len(layers.parts_of("occupancy", name="map")) == 2
    assert list(layers.vector("topology")) == [PartKey("topology", name="network")]
    assert layers.resources() == {"a.png": b"1"}
    assert (layers.elevation("L1"), layers.elevation("L9")) == (3.0, 0.0)
    assert layers.frame is None
    assert is_empty(Resources({}))
    assert not is_empty(grid)
    located = Layers({}, Datum(53.0, 0.1))
    assert located.frame is not None
    assert located.frame.datum.latitude == 53.0
