"""Changed cells as tiles, compared with a plain comparison of the cells as clients read them."""

from __future__ import annotations

import io
import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from app.store.cell_changes import classify, halve
from tests.api.conftest import Api

Cells = NDArray[np.uint8]
PIXELS = {0: 254, 100: 0, 255: 205}


def upload(api: Api, env: str, cells: Cells, origin: str = "[-1.0, -2.0, 0.0]", resolution: float = 0.5) -> int:
    """Upload a grid, row 0 on top; return the version."""
    table = np.zeros(256, np.uint8)
    for value, grey in PIXELS.items():
        table[value] = grey
    height, width = cells.shape
    yaml = (
        f"image: map.pgm\nresolution: {resolution}\norigin: {origin}\nnegate: 0\n"
        "occupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    image = b"P5\n%d %d\n255\n" % (width, height) + table[cells].tobytes()
    version: int = api.upload(env, {"map.yaml": yaml.encode(), "map.pgm": image}).json()["version"]
    return version


def describe(api: Api, env: str, query: str) -> dict[str, Any]:
    body: dict[str, Any] = api.get(f"environments/{env}/diff/tiles/map?{query}").json()
    return body


def mosaic(api: Api, env: str, query: str, z: int) -> Cells:
    """Join all tiles of a level."""
    about = describe(api, env, query)
    k = about["levels"] - 1 - z
    height, width = ((about[side] + (1 << k) - 1) >> k for side in ("height", "width"))
    out = np.zeros((-(-height // 256) * 256, -(-width // 256) * 256), np.uint8)
    for row in range(out.shape[0] // 256):
        for col in range(out.shape[1] // 256):
            data = api.get(f"environments/{env}/diff/tiles/map/{z}/{row}/{col}.png?{query}").content
            image = Image.open(io.BytesIO(data))
            assert (image.mode, image.size) == ("L", (256, 256))
            out[row * 256 : (row + 1) * 256, col * 256 : (col + 1) * 256] = np.asarray(image)
    assert not out[height:].any()
    assert not out[:, width:].any()
    return out[:height, :width]


def expected_class(was: int, now: int) -> int:
    if was == now:
        return 0
    if now == 255:
        return 3
    return {(0, 100): 1, (100, 0): 2, (255, 0): 4, (255, 100): 5}.get((was, now), 6)


def test_classes_of_every_pair_of_values() -> None:
    values = [0, 1, 50, 99, 100, 255]
    before, after = (np.array(grid, np.uint8) for grid in np.meshgrid(values, values))
    got = classify(before, after)
    for place in np.ndindex(before.shape):
        assert got[place] == expected_class(int(before[place]), int(after[place]))


def test_overview_has_the_most_severe_class() -> None:
    changes = np.array([[0, 6, 0], [3, 2, 0], [5, 0, 1]], np.uint8)
    assert halve(changes).tolist() == [[2, 0], [5, 1]]
    assert halve(halve(changes)).tolist() == [[1]]


def test_every_level_agrees_with_a_plain_comparison(api: Api, bare: str) -> None:
    random = np.random.default_rng(1)
    before = random.choice(np.array([0, 100, 255], np.uint8), (1100, 2100), p=[0.8, 0.1, 0.1])
    after = before.copy()
    after[3, 5] = 100 - before[3, 5] if before[3, 5] != 255 else 0
    after[700:760, 1900:2000] = random.choice(np.array([0, 100, 255], np.uint8), (60, 100))
    first, second = upload(api, bare, before), upload(api, bare, after)
    query = f"from={first}&to={second}"
    about = describe(api, bare, query)
    assert (about["width"], about["height"], about["levels"], about["tile"]) == (2100, 1100, 5, 256)
    pairs = zip(before.ravel().tolist(), after.ravel().tolist(), strict=True)
    level = np.array([expected_class(*pair) for pair in pairs], np.uint8).reshape(before.shape)
    for z in range(4, -1, -1):
        assert np.array_equal(mosaic(api, bare, query, z), level), f"z {z}"
        reduced = np.zeros([(side + 1) // 2 for side in level.shape], np.uint8)
        for row, col in np.argwhere(level):
            old = reduced[row // 2, col // 2]
            reduced[row // 2, col // 2] = min(old, level[row, col]) if old else level[row, col]
        level = reduced
    same = f"from={second}&to={second}"
    assert not mosaic(api, bare, same, 0).any()


def test_position_is_that_of_the_grid(api: Api, bare: str) -> None:
    cells = np.zeros((6, 8), np.uint8)
    first = upload(api, bare, cells, "[3.0, 4.0, 0.5]")
    cells[0, 0] = 100
    second = upload(api, bare, cells, "[3.0, 4.0, 0.5]")
    about = describe(api, bare, f"from={first}&to={second}")
    assert (about["resolution"], about["origin"], about["levels"]) == (0.5, [3.0, 4.0, 0.5], 1)
    a, b, c, d, e, f = about["transform"]
    corner = np.array([a * 0 + b * 6 + c, d * 0 + e * 6 + f])  # the lower left corner is the origin
    assert corner == pytest.approx([3.0, 4.0])
    right = np.array([a * 8 + b * 6 + c, d * 8 + e * 6 + f]) - corner
    assert right == pytest.approx([4.0 * math.cos(0.5), 4.0 * math.sin(0.5)])
    x0, y0, *_ = about["bounds"]
    assert (x0, y0) == pytest.approx((3.0 - 3.0 * math.sin(0.5), 4.0))
    assert mosaic(api, bare, f"from={first}&to={second}", 0)[0, 0] == 1


def test_moved_grid_is_compared_in_the_frame_of_the_newer_one(api: Api, bare: str) -> None:
    before = np.zeros((6, 8), np.uint8)
    before[0, 0] = 100
    first = upload(api, bare, before, "[0.0, 0.0, 0.0]")
    after = np.zeros((8, 10), np.uint8)  # two columns more at the left, two rows more below
    after[0, 3] = 100
    second = upload(api, bare, after, "[-1.0, -1.0, 0.0]")
    expected = np.full((8, 10), 4, np.uint8)
    expected[0:6, 2:10] = 0
    expected[0, 2], expected[0, 3] = 2, 1
    assert mosaic(api, bare, f"from={first}&to={second}", 0).tolist() == expected.tolist()
    # back: the older grid's further cells do not exist in the newer frame
    back = np.zeros((6, 8), np.uint8)
    back[0, 0], back[0, 1] = 1, 2
    assert mosaic(api, bare, f"from={second}&to={first}", 0).tolist() == back.tolist()


def test_turned_and_finer_grid_is_looked_up_at_the_centre(api: Api, bare: str) -> None:
    before = np.zeros((40, 40), np.uint8)
    before[:, 20:] = 100
    first = upload(api, bare, before, "[-10.0, -10.0, 0.0]", 0.5)
    second = upload(api, bare, np.zeros((8, 8), np.uint8), f"[0.0, 0.0, {math.pi / 2!r}]", 1.0)
    # the newer grid extends from x = -8 to 0 and y = 0 to 8: all free before
    assert not mosaic(api, bare, f"from={first}&to={second}", 0).any()
    third = upload(api, bare, np.zeros((8, 8), np.uint8), f"[4.0, 0.0, {math.pi / 2!r}]", 1.0)
    # x = -4 to 4, growing upwards in the image's rows downwards: the half with x > 0 was occupied
    changes = mosaic(api, bare, f"from={first}&to={third}", 0)
    assert (changes == 2).sum() == 32
    assert changes[4:].tolist() == np.full((4, 8), 2).tolist()


def test_new_and_deleted_grid(api: Api, bare: str) -> None:
    cells = np.array([[0, 100], [255, 0]], np.uint8)
    version = upload(api, bare, cells)
    assert mosaic(api, bare, f"from=0&to={version}", 0).tolist() == [[4, 5], [0, 4]]
    assert mosaic(api, bare, f"from={version}&to=0", 0).tolist() == [[3, 3], [0, 3]]


def test_caching_and_problems(api: Api, farm: str) -> None:
    path = f"environments/{farm}/diff/tiles/map"
    numbered = api.get(f"{path}/0/0/0.png?from=2&to=3")
    assert "immutable" in numbered.headers["cache-control"]
    assert "no-cache" in api.get(f"{path}/0/0/0.png?from=2&to=latest").headers["cache-control"]
    api.get(f"{path}/0/0/0.png?from=2&to=3", 304, headers={"If-None-Match": numbered.headers["etag"]})
    about = api.get(f"{path}?from=2&to=3")
    assert about.headers["etag"] != numbered.headers["etag"]
    api.get(f"{path}?from=2&to=3", 304, headers={"If-None-Match": about.headers["etag"]})
    address = f"{path}/0/0/0.png?from=2&to=3&hash="
    assert api.get(address + about.json()["hash"]).content == numbered.content
    assert "other content" in api.problem("GET", f"{address}{'0' * 32}", 404)["detail"]
    assert "z 0 to 0" in api.problem("GET", f"{path}/1/0/0.png?from=2&to=3", 404)["detail"]
    assert "rows 0 to 0" in api.problem("GET", f"{path}/0/0/1.png?from=2&to=3", 404)["detail"]
    detail = api.problem("GET", f"environments/{farm}/diff/tiles/maps?from=2&to=3", 404)["detail"]
    assert "did you mean map" in detail
    assert "map (level ground)" in detail
    api.problem("GET", f"{path}?from=2&to=3&level=roof", 404)
    api.problem("GET", f"{path}/0/0/0.png?from=2&to=77", 404)


def test_level_is_needed_if_several_have_the_grid(api: Api, bare: str) -> None:
    yaml = b"image: map.pgm\nresolution: 0.5\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    files = {"map.yaml": yaml, "map.pgm": b"P5\n1 1\n255\n\x00"}
    for level in ("L1", "L2"):
        api.upload(bare, files, level=level)
    assert "L1, L2" in api.problem("GET", f"environments/{bare}/diff/tiles/map?from=0&to=2", 409)["detail"]
    assert describe(api, bare, "from=0&to=2&level=L2")["level"] == "L2"
