"""Objects as voxels: surfaces, insides, extruded footprints, levels and limits."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np
import pytest
import shapely

from app.derive import DerivationNotes
from app.derive.objects_to_voxels import Parameters, objects_to_voxels
from app.errors import CannotConvert, MissingLayer
from app.model.frame import Level
from app.model.layers import MAP, Layers, PartKey
from app.model.notes import Filled
from app.model.voxels import VoxelMap
from tests.derive.test_objects_to_occupancy import BOX, grid, layers, objects


def voxels(content: Layers, notes: DerivationNotes | None = None, **options: Any) -> VoxelMap:
    derived_layers = objects_to_voxels(content, Parameters(**options), notes or DerivationNotes())
    part = derived_layers.parts[PartKey("voxels", "ground", MAP)]
    assert isinstance(part, VoxelMap)
    assert part.occupied.all()
    return part


def model(*shapes: dict[str, Any], **more: Any) -> Layers:
    return layers(objects((None, {"kind": "model", "shapes": list(shapes), **more})))


def test_box_fills_its_voxels() -> None:
    v = voxels(model(BOX))
    assert v.voxel_counts() == {"occupied": 10 * 20 * 30, "free": 0}
    assert v.bounds() == (-0.5, -1.0, 0.0, 0.5, 1.0, 3.0)
    assert len(v) < 6000, "merged as OctoMap merges"
    hollow = voxels(model(BOX), filled=False)
    assert hollow.voxel_counts()["occupied"] == 6000 - 8 * 18 * 28
    assert voxels(model(BOX), resolution=0.5).voxel_counts()["occupied"] == 2 * 4 * 6


def test_sphere_volume_agrees_with_trimesh() -> None:
    import trimesh

    v = voxels(model({"type": "sphere", "radius": 2, "pose": [5, 0, 0, 0, 0, 0]}))
    low = [v.axis(k)[0] for k in range(3)]
    middle = np.column_stack(low) * 0.1
    assert 2**3 < v.voxel_counts()["occupied"] * 1e-3 / (4 / 3 * math.pi) < 2.1**3, (
        "between the sphere and a voxel more"
    )
    assert np.linalg.norm(middle - [5, 0, 0], axis=1).max() < 2.2
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=2)
    solid = mesh.voxelized(0.1).fill()
    assert v.voxel_counts()["occupied"] == pytest.approx(solid.filled_count, rel=0.08)


def test_footprints_are_extruded_from_their_base_to_their_top() -> None:
    rows: list[Any] = [
        (shapely.box(0, 0, 1, 1), {"kind": "building", "height": 2.0, "base": 1.0}),
        (shapely.LineString([(5, 0.05), (7, 0.05)]), {"kind": "wall"}),
        (shapely.box(9, 9, 10, 10), {"kind": "hole"}),
        (shapely.box(-9, -9, -8, -8), {"kind": "floor"}),
    ]
    notes = DerivationNotes()
    v = voxels(layers(objects(*rows)), notes, extrude=3.0)
    assert v.voxel_counts()["occupied"] == 10 * 10 * 10 + 22 * 30  # the wall is half its thickness longer on each end
    assert v.bounds() == (0.0, 0.0, 0.0, 7.1, 1.0, 3.0)
    (line,) = notes.template
    assert (line.subject, line.value, line.option) == ("height", 3.0, "extrude")
    assert line.why == "1 footprints state no height"


def test_all_levels_share_one_voxel_map() -> None:
    content = Layers(
        {
            PartKey("objects", "ground", "a"): objects((shapely.box(0, 0, 1, 1), {"kind": "crate", "height": 1.0})),
            PartKey("objects", "L2", "a"): objects(
                (shapely.box(0, 0, 1, 1), {"kind": "crate", "height": 1.0}),
                (None, {"kind": "model", "shapes": [BOX], "pose": [5, 0, 4, 0, 0, 0]}),
            ),
        },
        levels=(Level(), Level("L2", 4.0)),
    )
    v = voxels(content)
    assert v.bounds() == (0.0, -1.0, 0.0, 5.5, 1.0, 7.0)
    assert v.voxel_counts()["occupied"] == 1000 + 1000 + 6000


def test_box_on_an_upper_level_stands_on_its_floor() -> None:
    """Its pose is in the local frame, as Open-RMF's readers store it."""
    table = {"kind": "furniture", "size": [2.0, 2.0, 1.0], "pose": [5.0, 5.0, 10.0, 0.0, 0.0, 0.0]}
    rows = objects((shapely.box(0, 0, 10, 10), {"kind": "floor"}), (shapely.Point(5, 5), table))
    content = layers(rows, level="L2", levels=(Level(), Level("L2", 10.0)))
    g = grid(content, level="L2", resolution=0.1)
    assert int((g.cells == 100).sum()) == 400
    assert voxels(content).bounds() == (4.0, 4.0, 10.0, 6.0, 6.0, 11.0)


def test_objects_without_body_raise_missing_layer() -> None:
    for rows in ([], [(shapely.box(0, 0, 1, 1), {"kind": "region"})], [(shapely.box(0, 0, 1, 1), {"kind": "hole"})]):
        with pytest.raises(MissingLayer, match="no stored object has a body"):
            voxels(layers(objects(*rows)))


def test_limits_are_checked_before_memory_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(CannotConvert, match=r"resolution of at least 3\.05"):
        voxels(model(BOX, pose=[1e5, 0, 0, 0, 0, 0]), resolution=1.0)
    assert voxels(model(BOX, pose=[1e4, 0, 0, 0, 0, 0])).resolution == 0.5
    big = {"type": "box", "size": [2000, 2000, 2000]}
    start = time.process_time()
    with pytest.raises(CannotConvert, match="coarser resolution, or filled=false"):
        voxels(model(big), resolution=0.1)
    assert time.process_time() - start < 20
    notes = DerivationNotes()
    assert voxels(model(big), notes).resolution == 10.0
    assert notes.template == [Filled("resolution", 10.0, "0.1 m would be too many voxels")]
    from app.derive import objects_to_voxels as module

    monkeypatch.setattr(module, "MAX_VOXELS", 5999)
    with pytest.raises(CannotConvert, match="more than 5999"):
        voxels(model(BOX))
