"""Previews over HTTP: the picture, caching, refused parameters."""

from __future__ import annotations

import io

from PIL import Image

from tests.api.conftest import Api


def test_preview_is_a_picture_of_the_requested_width(api: Api, farm: str) -> None:
    base = f"environments/{farm}/versions"
    answer = api.get(f"{base}/3/preview.png?width=200&theme=dark&layers=topology,occupancy")
    assert answer.headers["content-type"] == "image/png"
    assert Image.open(io.BytesIO(answer.content)).width == 200
    assert answer.headers["cache-control"] == "private, max-age=31536000, immutable"
    same = api.get(f"{base}/3/preview.png?width=200&theme=dark&layers=occupancy,topology")
    assert (same.headers["etag"], same.content) == (answer.headers["etag"], answer.content)
    assert api.get(f"{base}/latest/preview.png").headers["cache-control"] == "private, no-cache"
    condition = {"If-None-Match": answer.headers["etag"]}
    assert api.get(f"{base}/3/preview.png?width=200&theme=dark&layers=topology,occupancy", 304, headers=condition)


def test_preview_refuses_what_it_cannot_draw(api: Api, farm: str) -> None:
    base = f"environments/{farm}/versions/3/preview.png"
    for query in ("width=63", "width=2049", "theme=blue", "layers=maps", "layers=", "size=3"):
        api.problem("GET", f"{base}?{query}", 422)
    assert "available" in api.problem("GET", f"{base}?level=attic", 404)["detail"]
    assert "has no voxels" in api.problem("GET", f"{base}?layers=voxels", 404)["detail"]
