"""Compression of JSON: which responses, how ETags and caches follow, and what is left alone."""

from __future__ import annotations

import gzip
import json
import zlib

import httpx
import pytest

from app.api.http.compression import MIN_BYTES, accepted_coding, zstd
from tests.api import samples
from tests.api.conftest import Api

GZIP = {"Accept-Encoding": "gzip"}
PLAIN = {"Accept-Encoding": "identity"}


def raw(api: Api, path: str, **headers: str) -> tuple[httpx.Response, bytes]:
    """Return a response and its body as it was sent."""
    with api.http.stream("GET", f"/api/v1/{path}", headers=headers) as answer:
        return answer, b"".join(answer.iter_raw())


@pytest.mark.parametrize(
    ("header", "coding"),
    [
        (b"", None),
        (b"gzip, deflate", b"gzip"),
        (b"gzip, deflate, br, zstd", b"zstd"),
        (b"zstd;q=0.5, gzip", b"gzip"),
        (b"gzip;q=0, *", b"zstd"),
        (b"gzip;q=0", None),
        (b"*;q=0", None),
        (b"identity, gzip;q=0.1", None),
        (b"GZIP;Q=0.5", b"gzip"),
        (b"gzip;q=x", None),
        (b"br", None),
    ],
)
def test_client_chooses_the_coding(header: bytes, coding: bytes | None) -> None:
    assert accepted_coding(header) == coding


def test_large_json_is_compressed_and_equal(api: Api, farm: str) -> None:
    path = f"environments/{farm}/versions/3/layers/topology"
    plain, body = raw(api, path, **PLAIN)
    assert "content-encoding" not in plain.headers
    assert len(body) >= MIN_BYTES
    assert not plain.headers["etag"].startswith("W/")
    for coding, unpack in (("gzip", gzip.decompress), ("zstd", zstd.decompress)):
        packed, data = raw(api, path, **{"Accept-Encoding": coding})
        assert packed.headers["content-encoding"] == coding
        assert packed.headers["content-length"] == str(len(data))
        assert len(data) < len(body) / 2
        assert unpack(data) == body
        assert packed.headers["etag"] == "W/" + plain.headers["etag"]
        assert packed.headers["content-type"] == plain.headers["content-type"]
    for answer in (plain, packed):
        assert answer.headers["vary"] == "accept, accept-encoding"


def test_conditions_match_compressed_and_plain_responses(api: Api, farm: str) -> None:
    path = f"environments/{farm}/versions/3/layers/topology"
    plain, packed = (raw(api, path, **headers)[0].headers["etag"] for headers in (PLAIN, GZIP))
    for sent in (plain, packed):
        for headers in (PLAIN, GZIP):
            answer, body = raw(api, path, **headers, **{"If-None-Match": sent})
            assert (answer.status_code, body) == (304, b"")
            assert answer.headers["etag"] == sent, "caches update the stored response with this tag only"
            assert "accept-encoding" in answer.headers["vary"]


def test_small_json_files_and_images_are_left_alone(api: Api, farm: str) -> None:
    for path in (f"environments/{farm}/channels", f"environments/{farm}/versions/3/maps/geojson",
                 f"environments/{farm}/versions/3/layers/occupancy", f"environments/{farm}/transform?xy=1,2",
                 f"environments/{farm}/versions/3/manifest?formats=tmap2,geojson,kml,nav2_route"):  # fmt: skip
        answer, body = raw(api, path, **GZIP)
        assert answer.status_code == 200, answer.headers
        assert "content-encoding" not in answer.headers, path
        assert body == raw(api, path, **PLAIN)[1]
        assert not answer.headers.get("etag", "").startswith("W/"), path


def test_event_stream_is_not_compressed(api: Api, farm: str) -> None:
    answer, body = raw(api, f"events?environment={farm}&since=0&follow=false", **GZIP)
    assert answer.headers["content-type"].startswith("text/event-stream")
    assert "content-encoding" not in answer.headers
    assert b"data:" in body


def test_long_errors_are_compressed(api: Api, bare: str) -> None:
    changes = [{"op": "delete", "layer": "topology", "id": f"node-{k}"} for k in range(500)]
    with api.http.stream("POST", f"/api/v1/environments/{bare}/edits", json={"changes": changes}, headers=GZIP) as sent:
        data = b"".join(sent.iter_raw())
    assert sent.status_code in (404, 422)
    text = zlib.decompress(data, 31) if "content-encoding" in sent.headers else data
    assert ("content-encoding" in sent.headers) == (len(text) >= MIN_BYTES)
    assert json.loads(text)["status"] == sent.status_code


def test_head_has_no_body_and_no_coding(api: Api, farm: str) -> None:
    answer = api.http.head(f"/api/v1/environments/{farm}/versions/3/layers/topology", headers=GZIP)
    assert answer.status_code == 200
    assert answer.content == b""
    assert "content-encoding" not in answer.headers


def test_weak_tag_of_a_compressed_response_is_accepted_by_if_match(api: Api, bare: str) -> None:
    api.upload(bare, {"n.tmap2.yaml": samples.tmap2()}, message="x" * 2000)
    answer, _ = raw(api, f"environments/{bare}/versions/1", **GZIP)
    assert answer.headers["etag"] == 'W/"1"'
    body = {"changes": [{"op": "delete", "layer": "topology", "id": "barn_field"}]}
    api.post(f"environments/{bare}/edits", body, 412, headers={"If-Match": 'W/"7"'})
    api.post(f"environments/{bare}/edits", body, 201, headers={"If-Match": answer.headers["etag"]})
