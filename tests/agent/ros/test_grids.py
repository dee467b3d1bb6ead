"""Grids as Nav2's map server reads them."""

from __future__ import annotations

from pathlib import Path

import pytest

from app.agent.ros.fleetmap_ros import grids

HEAD = "resolution: 0.05\norigin: [-1.5, 2.0, 0.25]\nnegate: {negate}\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"


def put(folder: Path, image: bytes, *, negate: object = 0, mode: str | None = None) -> Path:
    (folder / "map.pgm").write_bytes(image)
    text = f"image: map.pgm\n{HEAD.format(negate=negate)}" + (f"mode: {mode}\n" if mode else "")
    (folder / "map.yaml").write_text(text)
    return folder / "map.yaml"


def test_rows_are_turned_and_values_are_cells(tmp_path: Path) -> None:
    grid = grids.read_map(put(tmp_path, b"P5\n# a comment\n3 2\n255\n" + bytes([0, 205, 254, 254, 254, 0])))
    assert (grid.width, grid.height, grid.resolution, grid.origin) == (3, 2, 0.05, (-1.5, 2.0, 0.25))
    assert grid.cells == bytes([0, 0, 100, 100, 255, 0]), "the lowest row first"


@pytest.mark.parametrize(
    ("mode", "negate", "cells"),
    [
        ("trinary", 0, [100, 100, 255, 0]),
        ("trinary", 1, [0, 255, 255, 100]),
        ("trinary", "true", [0, 255, 255, 100]),
        ("scale", 0, [100, 100, 67, 0]),
        ("raw", 0, [0, 50, 255, 255]),
    ],
)
def test_cell_values_of_all_modes(tmp_path: Path, mode: str, negate: object, cells: list[int]) -> None:
    path = put(tmp_path, b"P2 4 1 255\n0 50 127 254\n", mode=mode, negate=negate)
    assert list(grids.read_map(path).cells) == cells


def test_pgm_with_other_white_value_is_read(tmp_path: Path) -> None:
    assert grids.read_map(put(tmp_path, b"P5 2 1 100\n\x00\x64")).cells == bytes([100, 0])


@pytest.mark.parametrize(
    ("image", "reason"),
    [
        (b"\x89PNG\r\n", "file_type=pgm"),
        (b"P5\n2 2\n255\n\x00\x00\x00", "3 of 4 pixels"),
        (b"P5\n0 2\n255\n", "0 × 2"),
        (b"P5\n99999 99999\n255\n", "image size"),
        (b"P5\n1 1\n65535\n\x00\x00", "grey values"),
        (b"P5\n1", "header"),
        (b"P2\n1 1\n255\nx", "pixels must be numbers"),
        (b"P2\n1 1\n100\n101", "pixels must be numbers"),
    ],
)
def test_unreadable_image_raises_grid_error_with_path(tmp_path: Path, image: bytes, reason: str) -> None:
    path = put(tmp_path, image)
    with pytest.raises(grids.GridError, match=r"could not publish .*map\.yaml") as caught:
        grids.read_map(path)
    assert reason in str(caught.value)


@pytest.mark.parametrize("text", ["", "[1]", "image: map.pgm", "{", HEAD.format(negate=0) + "image: none.pgm"])
def test_invalid_yaml_raises_grid_error(tmp_path: Path, text: str) -> None:
    (tmp_path / "map.yaml").write_text(text)
    with pytest.raises(grids.GridError, match="could not publish"):
        grids.read_map(tmp_path / "map.yaml")


def test_grid_written_by_server_is_read(tmp_path: Path) -> None:
    """A grid that the server has read and written, against the server's own cells."""
    np = pytest.importorskip("numpy", reason="the server's packages")
    from app.convert.files import offline
    from app.upload_reader import UploadHints
    from tests.api import samples

    converted = offline(samples.grid(), "occupancy_grid", hints=UploadHints())
    for name, data in converted.files.items():
        (tmp_path / name).write_bytes(data)
    (path,) = tmp_path.glob("*.yaml")
    grid = grids.read_map(path)
    cells = np.frombuffer(grid.cells, np.uint8).reshape(grid.height, grid.width)
    pixels = next(data for name, data in converted.files.items() if name.endswith(".pgm"))
    rows = np.frombuffer(pixels[-grid.width * grid.height :], np.uint8).reshape(grid.height, grid.width)[::-1]
    assert ((cells == 100) == (rows == 0)).all()
    assert ((cells == 0) == (rows == 254)).all()
