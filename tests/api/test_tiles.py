"""Tiles over HTTP: description, values, caching, slices, selection."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.api.conftest import Api

GRID = b"image: map.pgm\nresolution: 0.5\norigin: [2, 3, 0.5]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
IMMUTABLE = "private, max-age=31536000, immutable"


def pgm(grey: np.ndarray[Any, Any]) -> bytes:
    height, width = grey.shape
    return f"P5 {width} {height} 255\n".encode() + grey.astype(np.uint8).tobytes()


@pytest.fixture(scope="module")
def site(api: Api) -> str:
    """Environment with a grid of 300 × 280 cells, one obstacle in its upper left corner, on two levels."""
    name = "tiled-site"
    api.post("environments", {"name": name})
    grey = np.full((280, 300), 254)
    grey[0, 0] = 0
    files = {"map.yaml": GRID, "map.pgm": pgm(grey)}
    api.upload(name, files)
    api.upload(name, files, level="first")
    api.upload(name, files, grid="keepout")
    return name


def tile(api: Api, path: str, **more: Any) -> np.ndarray[Any, Any]:
    answer = api.get(path, **more)
    assert answer.headers["content-type"] == "image/png"
    return np.asarray(Image.open(io.BytesIO(answer.content)))


def test_description_and_values_of_a_grid(api: Api, site: str) -> None:
    base = f"environments/{site}/versions/1/tiles/occupancy/map"
    body = api.get(base).json()
    assert {k: body[k] for k in ("kind", "name", "level", "width", "height", "resolution", "tile", "levels")} == {
        "kind": "occupancy", "name": "map", "level": "ground", "width": 300, "height": 280, "resolution": 0.5,
        "tile": 256, "levels": 2,
    }  # fmt: skip
    assert body["origin"] == [2.0, 3.0, 0.5]
    assert (body["z_min"], body["z_max"], body["deviation"]) == (None, None, 0.0)
    whole = tile(api, f"{base}/0/0/0.png")
    assert (whole.shape, whole[0, 0]) == ((256, 256), 100)
    assert (whole[:140, :150].ravel()[1:] == 0).all()
    assert (whole[140:] == 255).all()
    detail = tile(api, f"{base}/1/1/1.png")
    assert (detail[:24, :44] == 0).all()
    assert (detail != 255).sum() == 24 * 44
    assert tile(api, f"{base}/1/0/0.png")[0, :2].tolist() == [100, 0]
    for outside in ("2/0/0", "1/2/0", "1/0/2", "0/0/1"):
        api.problem("GET", f"{base}/{outside}.png", 404)
    api.problem("GET", f"{base}/-1/0/0.png", 422)
    api.problem("GET", f"{base}/1/0/0.png?z_min=0", 422)


def test_a_numbered_version_is_immutable_and_a_channel_revalidates(api: Api, site: str) -> None:
    for path in ("tiles/occupancy/map", "tiles/occupancy/map/0/0/0.png"):
        numbered = api.get(f"environments/{site}/versions/1/{path}")
        assert numbered.headers["cache-control"] == IMMUTABLE
        latest = api.get(f"environments/{site}/versions/latest/{path}?level=ground")
        assert latest.headers["cache-control"] == "private, no-cache"
        assert latest.headers["etag"] == numbered.headers["etag"]  # the grid did not change
        assert not latest.headers["etag"].startswith("W/")
        same = api.get(
            f"environments/{site}/versions/1/{path}", 304, headers={"If-None-Match": numbered.headers["etag"]}
        )
        assert (same.content, same.headers["cache-control"]) == (b"", IMMUTABLE)
    other = api.get(f"environments/{site}/versions/1/tiles/occupancy/map/1/0/0.png")
    assert other.headers["etag"] != numbered.headers["etag"]


def test_address_with_a_hash_is_of_that_content_only(api: Api, site: str) -> None:
    base = f"environments/{site}/versions/1/tiles/occupancy/map"
    own = api.get(base).json()["hash"]
    assert api.get(f"{base}/0/0/0.png?hash={own}").content == api.get(f"{base}/0/0/0.png").content
    assert "other content" in api.problem("GET", f"{base}/0/0/0.png?hash={'0' * len(own)}", 404)["detail"]


def test_names_and_levels_select_a_part(api: Api, site: str) -> None:
    base = f"environments/{site}/versions/latest/tiles"
    assert api.get(f"{base}/occupancy/keepout").json()["name"] == "keepout"
    assert api.get(f"{base}/occupancy/map?level=first").json()["level"] == "first"
    assert "level" in api.problem("GET", f"{base}/occupancy/map", 409)["detail"]
    assert "available" in api.problem("GET", f"{base}/occupancy/nosuch", 404)["detail"]
    api.problem("GET", f"{base}/imagery/map", 404)
    api.problem("GET", f"{base}/topology/map", 422)
