"""Uploads with mode=merge: what they change in stored grids, and what they keep."""

from __future__ import annotations

from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from tests.api import samples
from tests.api.conftest import Api

WALL, CLEAR, GREY = 0, 254, 205
"""Pixels of map_saver: occupied, free, unknown."""

NAV2, EARLIER = 0.25, 0.196
"""free_thresh of Nav2's map_saver, which reads its own grey as free, and of the map_saver before it."""


def saved_grid(
    pixels: NDArray[Any], *, free: float = NAV2, origin: tuple[float, float] = (0.0, 0.0)
) -> dict[str, bytes]:
    """Write a grid of cells of 1 m as map_saver does. pixels: [height, width], row 0 at the bottom."""
    text = (
        f"image: map.pgm\nmode: trinary\nresolution: 1.0\norigin: [{origin[0]}, {origin[1]}, 0]\nnegate: 0\n"
        f"occupied_thresh: 0.65\nfree_thresh: {free}\n"
    )
    height, width = pixels.shape
    image = b"P5\n%d %d\n255\n" % (width, height) + np.flipud(pixels).astype(np.uint8).tobytes()
    return {"map.yaml": text.encode(), "map.pgm": image}


def written_pixels(api: Api, env: str) -> NDArray[np.uint8]:
    """Read the pixels of the grid that robots fetch, row 0 at the bottom."""
    data = api.get(f"environments/{env}/versions/latest/maps/occupancy_grid/map.pgm").content
    _, size, _, body = data.split(b"\n", 3)
    width, height = map(int, size.split())
    return np.flipud(np.frombuffer(body, np.uint8).reshape(height, width))


def test_grey_of_unknown_cells_overwrites_nothing(api: Api, bare: str) -> None:
    """Nav2's map_saver writes a threshold by which its grey is free; a wall below that grey was not seen again."""
    monday = np.full((4, 5), CLEAR)
    monday[1, :4], monday[3] = WALL, GREY
    tuesday = np.full((4, 5), GREY)
    tuesday[1:3, 0], tuesday[3, 0], tuesday[0, 1] = CLEAR, WALL, WALL
    api.upload(bare, saved_grid(monday))
    assert np.array_equal(written_pixels(api, bare), monday)
    api.upload(bare, saved_grid(tuesday), mode="merge")
    expected = monday.copy()
    expected[1:3, 0], expected[3, 0], expected[0, 1] = CLEAR, WALL, WALL
    assert np.array_equal(written_pixels(api, bare), expected)
    api.upload(bare, saved_grid(tuesday), mode="merge", expect=200)


def test_grey_beyond_the_stored_grid_stays_grey(api: Api, bare: str) -> None:
    west, east = np.full((2, 3), GREY), np.full((2, 3), GREY)
    west[0], east[1] = CLEAR, WALL
    api.upload(bare, saved_grid(west))
    api.upload(bare, saved_grid(east, origin=(2.0, 0.0)), mode="merge")
    assert written_pixels(api, bare).tolist() == [
        [CLEAR, CLEAR, CLEAR, GREY, GREY],
        [GREY, GREY, WALL, WALL, WALL],
    ]


def test_grey_is_unknown_by_the_thresholds_of_the_stored_grid(api: Api, bare: str) -> None:
    stored, uploaded = np.full((2, 2), GREY), np.full((2, 3), GREY)
    stored[0], uploaded[1, 2] = WALL, CLEAR
    api.upload(bare, saved_grid(stored, free=EARLIER))
    api.upload(bare, saved_grid(uploaded), mode="merge")
    assert written_pixels(api, bare).tolist() == [[WALL, WALL, GREY], [GREY, GREY, CLEAR]]


def make_placeholder(api: Api, env: str) -> dict[str, Any]:
    """Derive a grid without obstacles, in cells of 1 m, from a fence; returns its map.yaml."""
    api.upload(env, {"datum.yaml": samples.DATUM})
    api.post(f"environments/{env}/derivations", {"method": "location_to_occupancy", "parameters": {"resolution": 1.0}})
    text = api.get(f"environments/{env}/versions/latest/maps/occupancy_grid/map.yaml").text
    return dict(yaml.safe_load(text))


def derive_voxels(api: Api, env: str) -> tuple[list[str], list[Any]]:
    """Derive voxels from the grids; returns the names of their steps, and what is stale."""
    api.post(f"environments/{env}/derivations", {"method": "occupancy_to_voxels"})
    lines = api.get(f"environments/{env}/versions/latest/reports/octomap").json()["layers"]
    steps = next(line["steps"] for line in lines if line["layer"] == "voxels")
    return [step["step"] for step in steps], api.get(f"environments/{env}/versions/latest").json()["stale"]


def test_grid_merged_onto_a_placeholder_is_used_by_derivations(api: Api, bare: str) -> None:
    """The placeholder, derived from the fence, shows no obstacles, but what a robot saw does; the fence may change."""
    x, y, _ = make_placeholder(api, bare)["origin"]
    seen = np.full((30, 30), CLEAR)
    seen[:, 7] = WALL
    api.upload(bare, saved_grid(seen, origin=(x + 2.0, y + 2.0)), mode="merge")
    assert [step["step"] for step in occupancy_report(api, bare)["steps"]] == ["location_to_occupancy"]
    assert np.count_nonzero(written_pixels(api, bare) == WALL) == 30
    api.upload(bare, {"datum.yaml": samples.DATUM.replace(b"53.2690", b"53.2691")})
    assert api.get(f"environments/{bare}/versions/latest").json()["stale"] == []
    assert derive_voxels(api, bare) == (["occupancy_to_voxels"], [])


def test_placeholder_merged_with_a_robots_grid_is_used_by_derivations(api: Api, bare: str) -> None:
    make_placeholder(api, bare)
    seen = np.full((30, 30), CLEAR)
    seen[:, 7] = WALL
    api.upload(bare, saved_grid(seen), grid="robot")
    corners = [[[x, y], [x, y]] for x, y in ((0.0, 0.0), (9.0, 0.0), (0.0, 9.0))]
    request = {"grids": ["map", "robot"], "pairs": {"robot": corners}, "drop": True}
    api.post(f"environments/{bare}/alignments", {"merge": request})
    assert derive_voxels(api, bare) == (["occupancy_to_voxels"], [])


def generate_hall(api: Api, env: str) -> None:
    """Generate a hall with objects and a grid of cells of 1 m."""
    size = {"width": 8.0, "depth": 8.0, "cell": 1.0, "resolution": 1.0}
    api.post(f"environments/{env}/generations", {"generator": "cluttered_hall", "seed": 7, "parameters": size})


def occupancy_report(api: Api, env: str) -> dict[str, Any]:
    lines = api.get(f"environments/{env}/versions/latest/reports/occupancy_grid").json()["layers"]
    return next(dict(line) for line in lines if line["layer"] == "occupancy")


def test_merged_grid_keeps_credits_and_steps(api: Api, bare: str) -> None:
    """Cells that a generator made up stay marked by its step."""
    generate_hall(api, bare)
    assert [step["step"] for step in occupancy_report(api, bare)["steps"]] == ["cluttered_hall"]
    licence = b"ODbL 1.0\n(c) 2024 Somebody\n"
    api.upload(bare, {"LICENSE": licence, **saved_grid(np.full((2, 2), WALL))}, mode="merge")
    api.upload(bare, saved_grid(np.full((2, 2), CLEAR)), mode="merge")
    report = occupancy_report(api, bare)
    assert report["information"] == "raw"
    assert [step["step"] for step in report["steps"]] == ["cluttered_hall"]
    assert report["attribution"] == ["ODbL 1.0, (c) 2024 Somebody (LICENSE)"]


def test_merged_grid_has_as_many_cells_as_an_uploaded_one(api: Api, bare: str) -> None:
    """Two small grids may be far apart: the grid around both would be too large to be uploaded again."""
    api.upload(bare, saved_grid(np.full((2, 2), CLEAR)))
    far = saved_grid(np.full((2, 2), WALL), origin=(16_400.0, 16_400.0))
    refused = api.upload(bare, far, mode="merge", expect=422).json()
    assert "16402 × 16402 cells" in refused["detail"]
    assert "23193 m apart" in refused["detail"]
    assert written_pixels(api, bare).shape == (2, 2)


def test_gazebo_has_the_walls_of_an_upload(api: Api, bare: str) -> None:
    """A grid that shows nothing but the objects makes no walls of its own, and one that was merged into it does."""
    generate_hall(api, bare)
    assert "walls_map" not in gazebo_world(api, bare)
    api.upload(bare, saved_grid(np.full((2, 2), GREY)), mode="merge", expect=200)
    assert "walls_map" not in gazebo_world(api, bare)
    api.upload(bare, saved_grid(np.full((2, 2), WALL), origin=(3.0, 3.0)), mode="merge")
    assert "walls_map" in gazebo_world(api, bare)


def gazebo_world(api: Api, env: str) -> str:
    return api.get(f"/maps/{env}/gazebo").text
