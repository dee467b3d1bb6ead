"""Imagery from a provider: a correct test server, and a misbehaving one."""

from __future__ import annotations

import io
import re
import struct
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest
from PIL import Image

from app.errors import CannotDerive, Invalid, Unavailable
from app.ingest import online
from app.ingest.online import Fetcher, Provider, assemble_image, plan_mosaic
from app.limits import Limits
from app.model.geodesy import WGS84, between
from app.model.imagery import GeoImage, pixel_positions
from tests.api.conftest import Api, running, settings_for

FENCE = """<kml xmlns="http://www.opengis.net/kml/2.2"><Document><Placemark><name>fence</name><Polygon><outerBoundaryIs>
<LinearRing><coordinates>-0.5251,53.2682 -0.5240,53.2682 -0.5240,53.2688 -0.5251,53.2688 -0.5251,53.2682</coordinates>
</LinearRing></outerBoundaryIs></Polygon></Placemark></Document></kml>"""
FEATURE = {"type": "Feature", "id": "post", "geometry": None, "properties": {"kind": "pole"}}
FEATURE |= {"place": {"type": "Point", "coordinates": [1.0, 1.0]}}
BOX = (-0.5251, 53.2682, -0.5240, 53.2688)


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


BOMB = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", 60000, 60000, 8, 2, 0, 0, 0))
BOMB += chunk(b"IDAT", zlib.compress(bytes(2**20))) + chunk(b"IEND", b"")
SECRET = "pk.very-secret"


def world(x: np.ndarray[Any, Any], y: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Return the colour of a position in Web Mercator metres: blocks of 16 m, so that every pixel reveals its
    position.
    """
    return np.stack([(x // 16) % 256, (y // 16) % 256, (x // 16 + y // 16) % 256], axis=-1).astype(np.uint8)


def drawn(left: float, top: float, size: float, width: int, height: int) -> bytes:
    x, y = np.meshgrid(left + (np.arange(width) + 0.5) * size, top - (np.arange(height) + 0.5) * size)
    out = io.BytesIO()
    Image.fromarray(world(x, y)).save(out, "PNG")
    return out.getvalue()


@dataclass
class Misbehaving:
    """Imagery provider for tests. behaviour: kind of fault, or fine. paths: requested paths."""

    url: str = ""
    behaviour: str = "fine"
    paths: list[str] = field(default_factory=list)
    lock: threading.Lock = field(default_factory=threading.Lock)
    closing: threading.Event = field(default_factory=threading.Event)


def picture_for(path: str) -> bytes:
    """Build the response of a correct provider."""
    parts = urlsplit(path)
    query = {key.upper(): values[0] for key, values in parse_qs(parts.query).items()}
    tile = re.match(r"/tiles/(\d+)/(\d+)/(\d+)\.png", parts.path)
    if tile:
        z, x, y = map(int, tile.groups())
        size = 2 * online.HALF / (256 * 2**z)
        return drawn(x * 256 * size - online.HALF, online.HALF - y * 256 * size, size, 256, 256)
    static = re.match(r"/styles/static/([-\d.]+),([-\d.]+),(\d+)/(\d+)x(\d+)", parts.path)
    if static:
        lon, lat, z, w, h = (float(v) for v in static.groups())
        size = 2 * online.HALF / (512 * 2**z)
        ((x, y),) = between(WGS84, online.MERCATOR, np.array([[lon, lat]]))
        return drawn(x - w / 2 * size, y + h / 2 * size, size, int(w), int(h))
    assert query["REQUEST"] == "GetMap"
    assert query["LAYERS"] == "ortho"
    assert query["CRS"] == "EPSG:3857"
    west, south, east, north = map(float, query["BBOX"].split(","))
    w, h = int(query["WIDTH"]), int(query["HEIGHT"])
    assert (east - west) / w == pytest.approx((north - south) / h)
    return drawn(west, north, (east - west) / w, w, h)


@pytest.fixture
def provider() -> Iterator[Misbehaving]:
    state = Misbehaving()

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def log_message(self, *_: Any) -> None:
            pass

        def send(self, status: int, body: bytes, kind: str = "image/png", **headers: str) -> None:
            self.send_response(status)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", headers.pop("length", str(len(body))))
            for name, value in headers.items():
                self.send_header(name.replace("_", "-"), value)
            self.end_headers()
            self.wfile.write(body)

        def do_GET(self) -> None:
            with state.lock:
                state.paths.append(self.path)
                count = len(state.paths)
            behaviour = state.behaviour
            try:
                if (
                    behaviour == "fine"
                    or (behaviour == "busy" and count > 2)
                    or (behaviour == "led" and "moved" in self.path)
                ):
                    self.send(200, picture_for(self.path.replace("/moved", "")))
                elif behaviour == "forbidden":
                    self.send(403, b"{}", "application/json")
                elif behaviour == "failing":
                    self.send(500, b"oops", "text/plain")
                elif behaviour in ("broken", "busy"):
                    self.send(503, b"", Retry_After="0")
                elif behaviour == "html":
                    self.send(200, b"<html>sign in</html>", "text/html; charset=utf-8")
                elif behaviour == "disguised":
                    self.send(200, b"<html>sign in</html>")
                elif behaviour == "huge":
                    self.send(200, b"\x89PNG\r\n\x1a\n", length=str(10 * 2**30))
                    self.close_connection = True
                elif behaviour == "endless":
                    self.send_response(200)
                    self.send_header("Content-Type", "image/png")
                    self.send_header("Connection", "close")
                    self.end_headers()
                    self.close_connection = True
                    while not state.closing.is_set():
                        self.wfile.write(b"\x89PNG\r\n\x1a\n" + bytes(2**16))
                elif behaviour == "dripping":
                    self.send_response(200)
                    self.send_header("Content-Length", "1000000")
                    self.end_headers()
                    self.close_connection = True
                    while not state.closing.is_set():
                        self.wfile.write(b"x")
                        time.sleep(0.05)
                elif behaviour == "silent":
                    state.closing.wait(20)
                    self.close_connection = True
                elif behaviour == "elsewhere":
                    self.send(302, b"", Location="http://169.254.169.254/latest/meta-data/")
                elif behaviour == "led":
                    self.send(302, b"", Location="/moved" + self.path)
                elif behaviour == "circle":
                    self.send(302, b"", Location=self.path)
                elif behaviour == "missing":
                    self.send(404, b"")
                elif behaviour == "patchy":
                    if count == 1:
                        self.send(404, b"")
                    else:
                        self.send(200, picture_for(self.path))
                elif behaviour == "small":
                    self.send(200, drawn(0, 0, 1, 64, 64))
                elif behaviour == "torn":
                    self.send(200, picture_for(self.path)[:200])
                elif behaviour == "bomb":
                    self.send(200, BOMB)
                else:
                    raise AssertionError(behaviour)
            except (BrokenPipeError, ConnectionResetError):
                self.close_connection = True

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05})
    thread.start()
    state.url = f"http://127.0.0.1:{server.server_address[1]}"
    try:
        yield state
    finally:
        state.closing.set()
        server.shutdown()
        server.server_close()
        thread.join(60)


def tiles(at: Misbehaving, **more: Any) -> Provider:
    return Provider(at.url + "/tiles/{z}/{x}/{y}.png?key={token}", "xyz", SECRET, ("© Somebody",), **more)


def fetched(provider: Provider, resolution: float = 0.5) -> tuple[GeoImage, int]:
    mosaic = plan_mosaic(provider, BOX, resolution)
    return assemble_image(
        mosaic, Fetcher(provider, sleep=lambda _: None).fetch(mosaic.blocks), provider.attribution, Limits()
    )


def check(picture: GeoImage) -> None:
    """Check that every pixel is at the position of the transform, and that the image exceeds the box by at most a
    pixel.
    """
    height, width = picture.pixels.shape[:2]
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    at = pixel_positions(picture.transform, u.ravel(), v.ravel()).reshape(height, width, 2)
    near = np.abs(at / 16 - np.round(at / 16)).min(axis=2) * 16 > 0.01  # not on the edge of a block of colour
    assert near.mean() > 0.9
    assert np.array_equal(picture.pixels[..., :3][near], world(at[..., 0], at[..., 1])[near])
    (west, south), (east, north) = between(WGS84, online.MERCATOR, np.array([BOX[:2], BOX[2:]]))
    size = picture.transform[0]
    outline = picture.outline()
    assert np.allclose(outline.min(axis=0), (west, south), atol=size)
    assert np.allclose(outline.max(axis=0), (east, north), atol=size)


@pytest.mark.parametrize("kind", ["xyz", "wms", "mapbox"])
def test_fetched_image_is_at_its_position(provider: Misbehaving, kind: Any) -> None:
    url = {"xyz": "/tiles/{z}/{x}/{y}.png", "wms": "/wms?layers=ortho&format=image/png", "mapbox": "/styles/static"}
    tile_provider = Provider(provider.url + url[kind], kind, SECRET)
    picture, missing = fetched(tile_provider)
    check(picture)
    assert (picture.crs, missing) == ("EPSG:3857", 0)
    ground = picture.transform[0] * np.cos(np.radians(53.2685))
    assert 0.25 < ground <= 0.5001
    if kind == "wms":
        assert ground == pytest.approx(0.5, rel=1e-3)
        assert all(SECRET not in path for path in provider.paths)
    if kind == "mapbox":
        assert all(f"access_token={SECRET}" in path for path in provider.paths)


def test_large_images_are_fetched_in_parts(provider: Misbehaving) -> None:
    for kind, url, resolution in (("wms", "/wms?layers=ortho", 0.03), ("mapbox", "/styles/static", 0.05)):
        provider.paths.clear()
        picture, _ = fetched(Provider(provider.url + url, kind, max_zoom=22), resolution)  # type: ignore[arg-type]
        check(picture)
        assert len(provider.paths) == 4, "two across and two along"


def test_url_templates_support_tms_rows_and_wmts_names() -> None:
    box, size = (-0.5251, 53.2682, -0.5250, 53.2683), 0.5
    plain = plan_mosaic(Provider("https://a/{z}/{x}/{y}", "xyz"), box, size).blocks[0]
    below = plan_mosaic(Provider("https://a/{z}/{x}/{-y}", "xyz"), box, size).blocks[0]
    wmts = plan_mosaic(Provider("https://a/{TileMatrix}/{TileCol}/{TileRow}", "xyz"), box, size).blocks[0]
    z, x, y = (int(v) for v in plain.url.removeprefix("https://a/").split("/"))
    assert below.url == f"https://a/{z}/{x}/{2**z - 1 - y}"
    assert wmts.url == plain.url
    # The wiki of OpenStreetMap gives this tile for the position, by another formula.
    n = 2**z
    lat = np.radians(53.2683)
    assert x == int((-0.5251 + 180) / 360 * n)
    assert y == int((1 - np.arcsinh(np.tan(lat)) / np.pi) / 2 * n)


@pytest.mark.parametrize(
    ("behaviour", "error", "message"),
    [
        ("forbidden", CannotDerive, r"rejected the request \(403\)"),
        ("broken", Unavailable, "returned status 503"),
        ("failing", Unavailable, "returned status 500"),
        ("html", CannotDerive, "sent 'text/html'"),
        ("disguised", CannotDerive, "neither PNG nor JPEG"),
        ("huge", CannotDerive, "FLEETMAP_IMAGERY_MAX_BYTES"),
        ("endless", CannotDerive, "FLEETMAP_IMAGERY_MAX_BYTES"),
        ("dripping", Unavailable, "within"),
        ("silent", Unavailable, "in time"),
        ("elsewhere", CannotDerive, "another host"),
        ("circle", CannotDerive, "redirected more than"),
        ("missing", CannotDerive, "no image of this place"),
        ("small", CannotDerive, "64 × 64 pixels instead of 256 × 256"),
        ("torn", CannotDerive, "cannot be read"),
        ("bomb", CannotDerive, "cannot be read"),
    ],
)
def test_misbehaving_provider_raises_error(
    provider: Misbehaving, behaviour: str, error: type[Exception], message: str
) -> None:
    provider.behaviour = behaviour
    seconds = 1.5 if behaviour in ("dripping", "silent") else 60.0
    tile_provider = tiles(provider, max_bytes=2**20, seconds=seconds, tries=2)
    begun = time.monotonic()
    with pytest.raises(error, match=message) as caught:
        fetched(tile_provider)
    assert time.monotonic() - begun < 60.0
    assert SECRET not in str(caught.value)
    assert SECRET not in repr(caught.value.__cause__)
    assert "169.254" not in str(caught.value)


def test_unreachable_provider_raises_unavailable(provider: Misbehaving) -> None:
    with pytest.raises(Unavailable, match="cannot be reached"):
        fetched(Provider("http://127.0.0.1:9/{z}/{x}/{y}", "xyz", tries=1))


def test_busy_provider_is_retried(provider: Misbehaving) -> None:
    provider.behaviour = "busy"
    picture, _ = fetched(tiles(provider, tries=4))
    check(picture)
    provider.behaviour, provider.paths[:] = "busy", []
    waits: list[float] = []
    tile_provider = tiles(provider, tries=4)
    mosaic = plan_mosaic(tile_provider, BOX, 0.5)
    Fetcher(tile_provider, sleep=waits.append).fetch(mosaic.blocks)
    assert waits
    assert max(waits) <= online.MAX_WAIT_SECONDS


def test_redirect_to_the_same_host_is_followed(provider: Misbehaving) -> None:
    provider.behaviour = "led"
    picture, _ = fetched(tiles(provider))
    check(picture)


def test_missing_parts_are_transparent(provider: Misbehaving) -> None:
    provider.behaviour = "patchy"
    picture, missing = fetched(tiles(provider), resolution=0.2)
    assert missing == 1
    assert picture.pixels.shape[2] == 4
    assert 0 < (picture.pixels[..., 3] == 0).mean() < 1


def test_fetched_parts_are_cached(provider: Misbehaving, tmp_path: Path) -> None:
    tile_provider = tiles(provider, cache_dir=tmp_path / "c", cache_bytes=10**6)
    first, _ = fetched(tile_provider)
    count = len(provider.paths)
    provider.behaviour = "broken"
    again, _ = fetched(tile_provider)
    assert len(provider.paths) == count
    assert np.array_equal(first.pixels, again.pixels)
    files = list((tmp_path / "c").iterdir())
    assert files
    assert all(SECRET not in f.name and SECRET.encode() not in f.read_bytes() for f in files)
    provider.behaviour = "fine"
    size = max(f.stat().st_size for f in files)
    fetched(tiles(provider, cache_dir=tmp_path / "c", cache_bytes=3 * size), resolution=0.1)
    assert sum(f.stat().st_size for f in (tmp_path / "c").iterdir()) <= 3 * size


@pytest.mark.parametrize(
    ("box", "resolution", "message"),
    [
        ((-0.6, 53.0, -0.4, 53.2), 0.1, "coarser resolution"),
        ((179.9, 0.0, 180.1, 0.1), 1.0, "date line"),
        ((0.0, 86.0, 0.1, 86.1), 1.0, "pole"),
    ],
)
def test_invalid_areas_cause_no_request(box: Any, resolution: float, message: str) -> None:
    with pytest.raises(Invalid, match=message):
        plan_mosaic(Provider("https://a/{z}/{x}/{y}", "xyz"), box, resolution)


@pytest.mark.parametrize(
    "values",
    [
        {"imagery_url": "ftp://a/{z}/{x}/{y}"},
        {"imagery_url": "https://a/tiles"},
        {"imagery_url": "https://{z}/{x}/{y}"},
        {"imagery_url": "https://a/wms?styles=", "imagery_kind": "wms"},
    ],
)
def test_invalid_provider_urls_are_refused(tmp_path: Path, values: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="imagery_url"):
        settings_for(tmp_path, **values)


# --- through the server ----------------------------------------------------------------------------------------------
@contextmanager
def serving(folder: Path, at: Misbehaving, seconds: float = 60.0, cache_bytes: int = 0) -> Iterator[Api]:
    more = {
        "imagery_url": at.url + "/tiles/{z}/{x}/{y}.png?key={token}",
        "imagery_token": SECRET,
        "imagery_attribution": "© Somebody; © Else",
        "imagery_tries": 1,
        "imagery_seconds": seconds,
        "imagery_cache_bytes": cache_bytes,
    }
    with running(settings_for(folder, **more)) as api:
        yield api


def test_site_gets_its_image(provider: Misbehaving, tmp_path: Path) -> None:
    with serving(tmp_path, provider) as api:
        listed = {d["id"] for d in api.get("derivations").json()}
        assert "location_to_imagery" in listed
        api.post("environments", {"name": "farm", "datum": {"latitude": 53.2682, "longitude": -0.5251}})
        request = {"method": "location_to_imagery", "parameters": {"resolution": 0.5}}
        path = "environments/farm/derivations"
        no_fence = api.problem("POST", path, 422, json=request)
        assert "radius" in no_fence["detail"]
        api.upload("farm", {"fence.kml": FENCE.encode()}, layer="location")
        version = api.post(path, request).json()
        assert version["information"]["imagery"] == "derived"
        assert version["stale"] == []
        image = api.get(
            "environments/farm/versions/latest/layers/imagery", headers={"Accept": "application/json"}
        ).json()
        assert image["crs"] == "EPSG:3857"
        assert image["attribution"] == ["© Somebody", "© Else"]
        report = api.get("environments/farm/versions/latest/reports/satellite").json()
        assert report["attribution"] == ["© Somebody", "© Else"]
        (line,) = [line for line in report["layers"] if line["layer"] == "imagery"]
        assert line["steps"][0]["step"] == "location_to_imagery"
        assert line["steps"][0]["parameters"]["provider"] == provider.url.removeprefix("http://")
        assert SECRET not in str(report) + str(version) + str(image)
        assert api.get("/maps/farm/satellite").content[:4] in (b"II*\0", b"MM\0*")
        assert api.post(path, request, expect=200).json()["version"] == version["version"], "the same image"
        # A part on another level is independent.
        put = {"op": "put", "layer": "objects", "level": "1", "feature": FEATURE}
        assert api.post("environments/farm/edits", {"changes": [put]}).json()["stale"] == []
        # The fence moves: the image becomes stale, and is still served until it is fetched again.
        (fence,) = api.get("environments/farm/versions/latest/layers/location").json()["features"]
        fence["geometry"]["coordinates"][0][1][0] = fence["geometry"]["coordinates"][0][2][0] = -0.5242
        put = {"op": "put", "layer": "location", "feature": fence}
        (stale,) = api.post("environments/farm/edits", {"changes": [put]}).json()["stale"]
        assert (stale["layer"], stale["changed"]) == ("imagery", ["location ground/site"])
        assert api.get("/maps/farm/satellite").status_code == 200
        report = api.get("environments/farm/versions/latest/reports/satellite").json()
        assert any("Derive it again" in w["problem"] for w in report["warnings"])
        assert api.post(path, request).json()["stale"] == []
        # The datum moves, too; the new image is the same, and no longer stale.
        place = {"latitude": 53.2682, "longitude": -0.5251, "altitude": 20.0}
        api("PATCH", "environments/farm", 200, json={"datum": place})
        later = api.get("environments/farm/versions/latest").json()
        assert [s["changed"] for s in later["stale"]] == [["datum"]]
        again = api.post(path, request).json()
        assert (again["version"], again["root"], again["stale"]) == (later["version"] + 1, later["root"], [])
        # Errors of the provider create no version.
        for behaviour, status in (
            *(("broken", 503), ("failing", 503)),
            *(("html", 422), ("forbidden", 422), ("bomb", 422), ("huge", 422), ("endless", 422)),
        ):
            provider.behaviour = behaviour
            problem = api.problem("POST", path, status, json=request)
            assert SECRET not in str(problem)
            assert len(problem["detail"]) > 20
        before = api.get("environments/farm/versions/latest").json()["version"]
        provider.behaviour = "fine"
        api.problem("POST", path, 422, json={**request, "parameters": {"zoom": 3}})
        viewer = api.token_for("viewer")
        viewer.problem("POST", path, 403, json=request)
        assert api.get("environments/farm/versions/latest").json()["version"] == before


def test_damaged_response_is_fetched_again(provider: Misbehaving, tmp_path: Path) -> None:
    with serving(tmp_path, provider, cache_bytes=2**20) as api:
        api.post("environments", {"name": "farm", "datum": {"latitude": 53.2682, "longitude": -0.5251}})
        request = {"method": "location_to_imagery", "parameters": {"resolution": 0.5, "radius": 20}}
        provider.behaviour = "bomb"
        api.problem("POST", "environments/farm/derivations", 422, json=request)
        provider.behaviour = "fine"
        api.post("environments/farm/derivations", request)
        count = len(provider.paths)
        api.post("environments/farm/derivations", request, expect=200)
        assert len(provider.paths) == count, "good ones are cached"


def test_image_that_does_not_come_in_time_creates_no_version(provider: Misbehaving, tmp_path: Path) -> None:
    with serving(tmp_path, provider, seconds=1.0) as api:
        api.post("environments", {"name": "farm", "datum": {"latitude": 53.2682, "longitude": -0.5251}})
        request = {"method": "location_to_imagery", "parameters": {"resolution": 0.5, "radius": 20}}
        before = api.get("environments/farm").json()["version"]
        for provider.behaviour in ("silent", "dripping"):
            problem = api.problem("POST", "environments/farm/derivations", 503, json=request)
            assert "try again later" in problem["detail"]
            assert SECRET not in str(problem)
        assert api.get("environments/farm").json()["version"] == before


def test_image_around_the_datum_is_stale_after_upload_of_a_fence(provider: Misbehaving, tmp_path: Path) -> None:
    with serving(tmp_path, provider) as api:
        api.post("environments", {"name": "farm", "datum": {"latitude": 53.2682, "longitude": -0.5251}})
        request = {"method": "location_to_imagery", "parameters": {"resolution": 0.5, "radius": 20}}
        assert api.post("environments/farm/derivations", request).json()["stale"] == []
        later = api.upload("farm", {"fence.kml": FENCE.encode()}, layer="location").json()
        assert [s["changed"] for s in later["stale"]] == [["location ground/site"]]


def test_missing_provider_causes_no_request(api: Api, fresh: Callable[[], str]) -> None:
    name = fresh()
    api.post("environments", {"name": name, "datum": {"latitude": 53.2682, "longitude": -0.5251}})
    request = {"method": "location_to_imagery", "parameters": {"radius": 50}}
    problem = api.problem("POST", f"environments/{name}/derivations", 422, json=request)
    assert "FLEETMAP_IMAGERY_URL" in problem["detail"]
    assert "location_to_imagery" not in {d["id"] for d in api.get("derivations").json()}
