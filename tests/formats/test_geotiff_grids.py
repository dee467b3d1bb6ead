"""Occupancy grids as GeoTIFF, and as PNG with a world file: position by GDAL's own programs, cells, round trips."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from rasterio.io import MemoryFile

from app import formats
from app.errors import Invalid, UnreadableFile
from app.formats import FileGroup, ReadContext, WriteContext, get_format
from app.formats.occupancy_grid.writing import WriteOptions
from app.limits import Limits
from app.model.frame import Datum
from app.model.geodesy import local_frame
from app.model.grid import OccupancyGrid
from app.model.layers import Layers, PartKey
from app.upload_reader import EnvironmentContext, UploadHints
from app.upload_reader import read as read_upload

HERE = Datum(53.2686123456, -0.5245123456, heading=37.5)
NEARBY = Datum(53.2690, -0.5240, heading=-12.0)
UPRIGHT = Datum(53.2686, -0.5245)
FORMAT = get_format("occupancy_grid")
MAP = PartKey("occupancy", name="map")


def grid(height: int = 30, width: int = 20, yaw: float = 0.3, **more: Any) -> OccupancyGrid:
    cells = np.random.default_rng(1).integers(0, 101, (height, width)).astype(np.uint8)
    cells[: height // 3] = 255
    return OccupancyGrid(cells, 0.05, (-12.3, 107.77, yaw), **more)


def written(part: OccupancyGrid, datum: Datum | None, name: str = "map", **options: Any) -> dict[str, bytes]:
    context = WriteContext(options=WriteOptions(**options), attribution=("Surveyed by us",))
    return formats.write(FORMAT, Layers({PartKey("occupancy", name=name): part}, datum), context)


def read(data: bytes, datum: Datum | None) -> tuple[OccupancyGrid, ReadContext]:
    context = ReadContext(frame=None if datum is None else local_frame(datum))
    return formats.read(FileGroup(FORMAT, "map.tif", {"map.tif": data}), context).grids()[MAP], context


def program(name: str, *arguments: str | Path, lines: str | None = None) -> str:
    path = shutil.which(name)
    if path is None:
        pytest.skip(f"{name} is not installed")
    return subprocess.run([path, *arguments], input=lines, capture_output=True, text=True, check=True).stdout


def edited(data: bytes, change: Any = lambda dataset: None, **profile: Any) -> bytes:
    """Write a GeoTIFF again with another profile, like a program that keeps no metadata of ours."""
    with MemoryFile(data) as file, file.open() as source, MemoryFile() as out:
        pixels = source.read()
        settings = {**source.profile, "driver": "GTiff", **profile}
        with out.open(**settings) as dataset:
            dataset.write(pixels.astype(settings["dtype"]))
            change(dataset)
        return bytes(out.getbuffer())


@pytest.mark.parametrize("datum", [HERE, UPRIGHT])
@pytest.mark.parametrize("yaw", [0.0, 0.3, -2.0])
@pytest.mark.parametrize("file", ["map.tif", "map.png"])
def test_corners_are_where_geodesy_says(file: str, yaw: float, datum: Datum, tmp_path: Path) -> None:
    part = grid(yaw=yaw)
    options = {"file_type": "tif"} if file == "map.tif" else {"file_type": "png", "world_file": True}
    for name, data in written(part, datum, **options).items():
        (tmp_path / name).write_bytes(data)
    pixels = "0 30\n20 30\n20 0\n0 0\n"  # counter-clockwise from the lower left corner, as ``corners``
    out = program("gdaltransform", "-output_xy", "-t_srs", "EPSG:4326", tmp_path / file, lines=pixels)
    degrees = np.array([[float(word) for word in line.split()] for line in out.splitlines()])
    assert np.abs(local_frame(datum).to_local(degrees) - part.corners()).max() < 1e-3


def test_gdal_reads_classes_with_colours_and_no_data(tmp_path: Path) -> None:
    part = grid()
    (data,) = written(part, HERE, file_type="tif").values()
    (tmp_path / "map.tif").write_bytes(data)
    info = json.loads(program("gdalinfo", "-json", tmp_path / "map.tif"))
    (band,) = info["bands"]
    assert (band["type"], band["colorInterpretation"], band["noDataValue"]) == ("Byte", "Palette", 255.0)
    entries = band["colorTable"]["entries"]
    assert (entries[0][:3], entries[100][:3], entries[255][:3]) == ([254] * 3, [0] * 3, [205] * 3)
    assert info["metadata"][""]["TIFFTAG_COPYRIGHT"] == "Surveyed by us"
    assert info["metadata"]["IMAGE_STRUCTURE"]["LAYOUT"] == "COG"
    assert "Transverse Mercator" in info["coordinateSystem"]["wkt"]
    with rasterio.open(tmp_path / "map.tif") as dataset:
        assert (dataset.read(1) == part.cells[::-1]).all()


@pytest.mark.parametrize("datum", [HERE, UPRIGHT, None])
def test_round_trip_keeps_cells_place_and_thresholds(datum: Datum | None) -> None:
    part = grid(mode="scale", occupied_thresh=0.7, free_thresh=0.1, negate=True)
    (data,) = written(part, datum, file_type="tif").values()
    assert written(part, datum, file_type="tif")["map.tif"] == data
    found = formats.detect("whatever.tif", data)
    assert found is FORMAT
    back, context = read(data, datum)
    assert (back.resolution, back.origin, back.mode) == (part.resolution, part.origin, "scale")
    assert (back.occupied_thresh, back.free_thresh, back.negate) == (0.7, 0.1, True)
    assert (back.cells == part.cells).all()
    assert context.warnings == []


def test_grid_moves_with_its_place_to_another_datum() -> None:
    part = grid()
    (data,) = written(part, HERE, file_type="tif").values()
    back, _ = read(data, NEARBY)
    off = local_frame(NEARBY).to_wgs84(back.corners()) - local_frame(HERE).to_wgs84(part.corners())
    assert np.abs(off).max() * 111_000 < 2e-3
    assert back.mode == part.mode
    back, context = read(data, None)
    assert back.origin == part.origin
    assert "the environment has no datum" in context.warnings[0].problem


@pytest.mark.parametrize("tagged", [True, False])
def test_cropped_grid_keeps_its_place(tagged: bool, tmp_path: Path) -> None:
    part = grid()
    (tmp_path / "map.tif").write_bytes(written(part, HERE, file_type="tif")["map.tif"])
    metadata = [] if tagged else ["-co", "PROFILE=GeoTIFF"]
    program("gdal_translate", "-srcwin", "3", "4", "10", "20", *metadata, tmp_path / "map.tif", tmp_path / "crop.tif")
    data = (tmp_path / "crop.tif").read_bytes()
    back, _ = read(data, HERE)
    assert (back.cells == part.cells[::-1][4:24, 3:13][::-1]).all()
    c, s = np.cos(0.3) * 0.05, np.sin(0.3) * 0.05
    assert back.origin == pytest.approx((-12.3 + 3 * c - 6 * s, 107.77 + 3 * s + 6 * c, 0.3), abs=1e-6)
    with pytest.raises(UnreadableFile, match="no datum: set one first"):
        read(data, None)


def test_overviews_lose_no_obstacle() -> None:
    cells = np.zeros((1100, 1500), np.uint8)
    cells[517] = 100
    cells[:, 33] = 255
    (data,) = written(OccupancyGrid(cells, 0.05), HERE, file_type="tif").values()
    with MemoryFile(data) as file:
        with file.open() as dataset:
            assert dataset.overviews(1) == [2, 4]
            assert (dataset.read(1) == cells[::-1]).all()
        for k, height in ((0, 550), (1, 275)):
            with file.open(overview_level=k) as dataset:
                overview = dataset.read(1)
                assert overview.shape[0] == height
                assert ((overview == 100).sum(axis=0) == 1).all(), "the wall, one cell wide, is in every column"
                assert not (overview == 255).any(), "a cell is unknown only if all below are"


def test_grid_in_another_crs_is_fitted(tmp_path: Path) -> None:
    part = grid(yaw=0.0)
    (tmp_path / "map.tif").write_bytes(written(part, UPRIGHT, file_type="tif")["map.tif"])
    program("gdalwarp", "-q", "-t_srs", "EPSG:32630", tmp_path / "map.tif", tmp_path / "utm.tif")
    back, _ = read((tmp_path / "utm.tif").read_bytes(), UPRIGHT)
    assert back.resolution == pytest.approx(0.05, rel=2e-3)
    assert abs(back.origin[2]) > 0.02, "UTM's north is not the grid's"
    assert np.abs(back.corners().mean(axis=0) - part.corners().mean(axis=0)).max() < 0.05
    program("gdalwarp", "-q", "-t_srs", "EPSG:4326", tmp_path / "map.tif", tmp_path / "degrees.tif")
    with pytest.raises(UnreadableFile, match="not square in local metres"):
        read((tmp_path / "degrees.tif").read_bytes(), UPRIGHT)


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda d: edited(d, dtype="int16", nodata=None), "one band of bytes, got 1 of int16"),
        (lambda d: edited(d, lambda f: f.write(np.full((1, 30, 20), 101, np.uint8))), "cells must be 0"),
        (lambda d: edited(d, lambda f: f.update_tags(FLEETMAP_GRID="[1]")), "invalid FLEETMAP_GRID"),
        (lambda d: edited(d, lambda f: f.update_tags(FLEETMAP_GRID="{" * 2000)), "invalid FLEETMAP_GRID"),
        (lambda d: d[:400], "damaged"),
    ],
)
def test_wrong_grids_are_refused_with_a_reason(make: Any, expected: str) -> None:
    data = make(written(grid(), HERE, file_type="tif")["map.tif"])
    with pytest.raises(UnreadableFile, match=expected):
        read(data, HERE)


def test_png_with_world_file_is_one_grid_and_no_image() -> None:
    files = written(grid(), HERE, file_type="png", world_file=True)
    assert sorted(files) == ["map.pgw", "map.png", "map.png.aux.xml", "map.yaml"]
    assert sorted(written(grid(), None, file_type="png", world_file=True)) == ["map.pgw", "map.png", "map.yaml"]
    bundle = read_upload(files, UploadHints(), EnvironmentContext(), Limits())
    assert {key.layer for key in bundle.layers(HERE).parts} == {"occupancy"}
    for name in ("map.pgw", "map.png.aux.xml"):
        options = FORMAT.selection.from_filename(name)
        assert options == {"grid": "map", "file_type": "png", "world_file": "true"}
    assert FORMAT.selection.from_filename("map.tif") == {"grid": "map", "file_type": "tif"}
    for kind in (None, "pgm", "tif"):
        with pytest.raises(Invalid, match="file_type=png"):
            written(grid(), HERE, file_type=kind, world_file=True)


def test_mask_keeps_its_filter_info() -> None:
    files = written(grid(yaw=0.0), HERE, "keepout", file_type="tif")
    assert sorted(files) == ["keepout.tif", "keepout_filter_info.yaml"]
    bundle = read_upload(files, UploadHints(), EnvironmentContext(), Limits())
    (part,) = bundle.layers(HERE).grids().values()
    assert part.properties["costmap_filter"]["params"]


def test_mode_trinary_applies_the_thresholds() -> None:
    (data,) = written(grid(), HERE, file_type="tif", mode="trinary").values()
    assert set(np.unique(read(data, HERE)[0].cells)) == {0, 100, 255}
