"""Conversion of files without a server gives the same map as a stored version."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from app import formats, upload_reader
from app.convert import files as direct
from app.convert import worker
from app.limits import Limits
from app.upload_reader import EnvironmentContext, UploadHints
from tests.worlds import CRATE, WALLS, house


def cells(files: dict[str, bytes]) -> Any:
    """Read the grey values of a map's image, top row first."""
    return next(np.asarray(Image.open(io.BytesIO(d))) for n, d in files.items() if n.endswith((".pgm", ".png")))


def test_offline_conversion_keeps_mesh_walls_beside_a_primitive_solid() -> None:
    """One box must not make a world that is read without its meshes look complete."""
    files = house(WALLS, CRATE)
    alone = cells(direct.offline(house(WALLS), "occupancy_grid").files)
    both = direct.offline(files, "occupancy_grid")
    assert (cells(both.files) == 0).sum() > (alone == 0).sum() > 500
    assert not [w for w in both.report.as_dict()["warnings"] if "cannot be read" in w["problem"]]


@pytest.mark.parametrize("wanted", ["occupancy_grid", "octomap", "satellite"])
def test_offline_conversion_equals_the_map_of_all_layers(shared: Path, wanted: str) -> None:
    """Compare the real warehouse with one more box, byte by byte."""
    root = shared / "data/gazebo_sdf/aws_small_warehouse"
    files = {p.relative_to(root).as_posix(): p.read_bytes() for p in root.rglob("*") if p.suffix in (".sdf", ".DAE")}
    world = (root / "worlds/no_roof_small_warehouse.world").read_bytes()
    files["worlds/a.world"] = world.replace(b"</world>", CRATE + b"</world>")
    options = {"resolution": "0.25"}
    upload_bundle = upload_reader.read(
        upload_reader.unpack(files, Limits()), UploadHints(), EnvironmentContext(), Limits()
    )
    fmt = formats.get_format(wanted)
    complete = worker.from_layers(fmt, upload_bundle.layers(None), options, derived=True, origin=upload_bundle.origin)
    assert direct.offline(files, wanted, options=options).files == complete.files
