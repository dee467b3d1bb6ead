"""Fetch imagery of a site from an online provider: Mapbox static images, WMS, and tiles (XYZ or WMTS).

Off unless the operator configures a provider. Requests go only to its host; redirects to another host are rejected.
Responses are untrusted: their size and time are bounded before they are read, and a worker process decodes them, as it
does uploads. All images are in Web Mercator (EPSG:3857). The token occurs only in request URLs, never in messages,
logs, caches or versions.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import math
import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal
from urllib.parse import parse_qsl, quote, urlencode, urljoin, urlsplit, urlunsplit

import numpy as np
import shapely
from numpy.typing import NDArray

from app import upload_reader
from app.errors import (
    BadUpload,
    CannotDerive,
    Conflict,
    Invalid,
    MissingDatum,
    MissingLayer,
    Problem,
    Unavailable,
)
from app.limits import Limits
from app.model.geodesy import WGS84, between
from app.model.imagery import GeoImage
from app.model.layers import Layers, PartKey
from app.parameters import describe, parameter
from app.store.changes import Changes, Prepared, Provenance, Replace
from app.store.in_worker import open_store
from app.store.values import Version
from app.upload_reader import EnvironmentContext, UploadHints

if TYPE_CHECKING:
    import httpx

METHOD = "location_to_imagery"
MERCATOR = "EPSG:3857"
HALF = 20037508.342789244
"""Half the side of the Web Mercator square, in metres."""

Kind = Literal["xyz", "wms", "mapbox"]
BLOCK: Mapping[str, int] = {"wms": 2048, "mapbox": 1280}
"""Maximum side of one requested image in pixels, by kind of provider."""

MAPBOX_TILE = 512
"""Side of the tiles that define Mapbox zoom levels, in pixels."""

MAX_REQUESTS = 400
MAX_PIXELS = 2**26
MAX_CONCURRENT_REQUESTS = 4
MAX_REDIRECTS = 3
MAX_WAIT_SECONDS = 10.0

MAGIC: Mapping[bytes, str] = {b"\x89PNG\r\n\x1a\n": "png", b"\xff\xd8\xff": "jpg"}


@dataclass(frozen=True, slots=True)
class Provider:
    """Imagery provider.

    url: of tiles with {z}, {x}, {y} (or {-y}, counted from the south; or {TileMatrix}, {TileCol}, {TileRow} of WMTS),
    of a WMS with its layers in the query, or of a Mapbox style up to ``static``. token: replaces {token}; without that
    placeholder sent as access_token to Mapbox. seconds: time limit for all requests of one image. tile: side in pixels.
    """

    url: str
    kind: Kind
    token: str = ""
    attribution: tuple[str, ...] = ()
    max_bytes: int = 64 * 2**20
    seconds: float = 60.0
    tries: int = 3
    max_zoom: int = 19
    tile: int = 256
    cache_dir: Path | None = None
    cache_bytes: int = 256 * 2**20

    @property
    def host(self) -> str:
        """Host that requests go to."""
        return urlsplit(self.url).netloc.rpartition("@")[2]

    def provenance_step(self, chosen: Parameters) -> dict[str, Any]:
        """Build the step for a version's provenance."""
        parameters = {p["name"]: getattr(chosen, p["name"]) for p in describe(Parameters)}
        parameters |= {"provider": self.host, "kind": self.kind}
        return {"step": METHOD, "from": ["location"], "to": "imagery", "parameters": parameters}


@dataclass(frozen=True, slots=True)
class Parameters:
    """Parameters of the image to fetch."""

    resolution: float = parameter(
        0.3, "ground size of a pixel; tiles use the next finer zoom level", minimum=0.01, maximum=1000.0, unit="m"
    )
    padding: float = parameter(10.0, "margin around the fence", minimum=0.0, maximum=10_000.0, unit="m")
    radius: float | None = parameter(
        None, "distance from the datum to each side, if there is no fence", minimum=1.0, maximum=50_000.0, unit="m"
    )
    picture: str = parameter("satellite", "name of the stored picture")
    level: str = parameter("ground", "level of the stored picture")

    @property
    def key(self) -> PartKey:
        """Key of the part that the image is stored as."""
        return PartKey("imagery", self.level, self.picture)


@dataclass(frozen=True, slots=True)
class TileRequest:
    """One request: position and size in pixels of the whole image, and the URL without the token."""

    column: int
    row: int
    width: int
    height: int
    url: str


@dataclass(frozen=True, slots=True)
class Mosaic:
    """All requests of an image, its size in pixels and its transform in Web Mercator."""

    blocks: tuple[TileRequest, ...]
    width: int
    height: int
    transform: tuple[float, float, float, float, float, float]


# --- the site ---------------------------------------------------------------------------------------------------------
def check_free(base: Version, chosen: Parameters, *, replace: bool) -> None:
    """Raise Conflict if an image of that name was uploaded or edited, unless ``replace`` is set."""
    old = {e.key: e for e in base.parts if e.count > 0}.get(chosen.key)
    if old is not None and not replace and (old.provenance.information != "derived" or old.provenance.is_edited):
        raise Conflict(
            f"the image {chosen.level}/{chosen.picture} is {old.provenance.information}: set replace=true to replace "
            "it, or choose another name with picture"
        )


def site_box(site: Layers, chosen: Parameters) -> tuple[float, float, float, float]:
    """Compute the box of the fence and its padding: west, south, east, north in degrees.

    Raises MissingDatum, or MissingLayer if there is neither a fence nor a radius.
    """
    frame = site.frame
    if frame is None:
        raise MissingDatum('fetching imagery needs a datum: PATCH the environment with {"datum": {…}}')
    areas = [area for part in site.vector("location").values() for area in part.in_local(frame)]
    boxes = shapely.bounds([a for a in areas if shapely.get_dimensions(a) == 2 and not a.is_empty])
    if len(boxes):
        low, high = boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)
    elif chosen.radius is not None:
        low, high = np.full(2, -chosen.radius), np.full(2, chosen.radius)
    else:
        raise MissingLayer("the environment has no fence: upload one as layer location, or set radius (metres)")
    (x0, y0), (x1, y1) = low - chosen.padding, high + chosen.padding
    lonlat = frame.to_wgs84(np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]))
    (west, south), (east, north) = lonlat.min(axis=0), lonlat.max(axis=0)
    return float(west), float(south), float(east), float(north)


# --- requests --------------------------------------------------------------------------------------------------------
def plan_mosaic(provider: Provider, box: tuple[float, float, float, float], resolution: float) -> Mosaic:
    """Plan the requests that cover a box (west, south, east, north in degrees). Raises Invalid if they are too many."""
    west, south, east, north = box
    if not (-180 <= west < east <= 180 and -85.05 <= south < north <= 85.05):
        raise Invalid("the site is outside Web Mercator: it crosses the date line or is at a pole")
    low, high = between(WGS84, MERCATOR, np.array([[west, south], [east, north]])).tolist()
    stretch = 1.0 / math.cos(math.radians((south + north) / 2))
    zoom, size = 0, resolution * stretch
    if provider.kind != "wms":
        base_resolution = 2 * HALF / (MAPBOX_TILE if provider.kind == "mapbox" else provider.tile)
        zoom = min(max(math.ceil(math.log2(base_resolution / size) - 1e-9), 0), provider.max_zoom)
        size = base_resolution / 2**zoom
    left, right = math.floor((low[0] + HALF) / size), math.ceil((high[0] + HALF) / size)
    top, bottom = math.floor((HALF - high[1]) / size), math.ceil((HALF - low[1]) / size)
    width, height = right - left, bottom - top
    side = provider.tile if provider.kind == "xyz" else BLOCK[provider.kind]
    count = (math.ceil(width / side) + 1) * (math.ceil(height / side) + 1)
    if count > MAX_REQUESTS or width * height > MAX_PIXELS:
        cost = f"{width} × {height} pixels and about {count} requests"
        raise Invalid(
            f"the image would take {cost}; the limit is {MAX_PIXELS} pixels and {MAX_REQUESTS} requests: set a "
            "coarser resolution",
            [Problem("too fine for a site of this size", where="resolution")],
        )
    make = {"xyz": _tiles, "wms": _maps, "mapbox": _statics}[provider.kind]
    blocks = tuple(make(provider, (left, top, right, bottom), size, zoom))
    return Mosaic(blocks, width, height, (size, 0.0, left * size - HALF, 0.0, -size, HALF - top * size))


Edges = tuple[int, int, int, int]


def _tiles(provider: Provider, edges: Edges, size: float, zoom: int) -> Iterator[TileRequest]:  # noqa: ARG001
    left, top, right, bottom = edges
    side, count = provider.tile, 2**zoom
    for y in range(top // side, -(-bottom // side)):
        for x in range(left // side, -(-right // side)):
            values = {"z": zoom, "x": x, "y": y, "-y": count - 1 - y, "TileMatrix": zoom, "TileCol": x, "TileRow": y}
            url = provider.url
            for name, value in values.items():
                url = url.replace(f"{{{name}}}", str(value))
            yield TileRequest(x * side - left, y * side - top, side, side, url)


def _maps(provider: Provider, edges: Edges, size: float, zoom: int) -> Iterator[TileRequest]:  # noqa: ARG001
    url_parameters = dict(parse_qsl(urlsplit(provider.url).query, keep_blank_values=True))
    upper = {key.upper() for key in url_parameters}
    usual = {"SERVICE": "WMS", "VERSION": "1.3.0", "REQUEST": "GetMap", "STYLES": "", "FORMAT": "image/jpeg"}
    query = {**{key: value for key, value in usual.items() if key not in upper}, **url_parameters}
    old = next((value for key, value in url_parameters.items() if key.upper() == "VERSION"), "1.3.0") < "1.3"
    for column, row, w, h in _cut(edges, BLOCK["wms"]):
        x, y = (edges[0] + column) * size - HALF, HALF - (edges[1] + row) * size
        box = ",".join(f"{v:.9f}" for v in (x, y - h * size, x + w * size, y))
        request_parameters = {
            **query,
            "SRS" if old else "CRS": MERCATOR,
            "BBOX": box,
            "WIDTH": str(w),
            "HEIGHT": str(h),
        }
        yield TileRequest(column, row, w, h, _with_query(provider.url, request_parameters))


def _statics(provider: Provider, edges: Edges, size: float, zoom: int) -> Iterator[TileRequest]:
    parts = urlsplit(provider.url)
    for column, row, w, h in _cut(edges, BLOCK["mapbox"]):
        middle = [(edges[0] + column + w / 2) * size - HALF, HALF - (edges[1] + row + h / 2) * size]
        ((lon, lat),) = between(MERCATOR, WGS84, np.array([middle])).tolist()
        path = f"{parts.path.rstrip('/')}/{lon:.9f},{lat:.9f},{zoom}/{w}x{h}"
        yield TileRequest(column, row, w, h, urlunsplit(parts._replace(path=path)))


def _cut(edges: Edges, side: int) -> Iterator[tuple[int, int, int, int]]:
    """Yield blocks (column, row, width, height) of at most ``side`` pixels a side."""
    width, height = edges[2] - edges[0], edges[3] - edges[1]
    for row in range(0, height, side):
        for column in range(0, width, side):
            yield column, row, min(side, width - column), min(side, height - row)


def _with_query(url: str, query: Mapping[str, str]) -> str:
    # Placeholders in braces are filled in later.
    return urlunsplit(urlsplit(url)._replace(query=urlencode(query, safe="{}:,/")))


# --- fetching ---------------------------------------------------------------------------------------------------------
class _RetryableError(Exception):
    """Temporary failure of a provider. wait: seconds that the provider requests before a retry."""

    def __init__(self, text: str, wait: float = 0.0) -> None:
        super().__init__(text)
        self.wait = wait


class Fetcher:
    """Fetches images from a provider, within its limits."""

    def __init__(self, provider: Provider, *, sleep: Callable[[float], None] = time.sleep) -> None:
        self.provider, self._sleep = provider, sleep
        # Their request log lines would contain the token.
        for name in ("httpx", "httpcore"):
            logging.getLogger(name).setLevel(logging.WARNING)

    def fetch(self, blocks: Sequence[TileRequest]) -> list[bytes | None]:
        """Fetch the images of all blocks; None for each that the provider does not have (404).

        Raises CannotDerive if the provider refuses or sends something else, Unavailable if it is down or too slow.
        """
        import httpx  # slow to import, and most servers use no provider

        p = self.provider
        deadline = time.monotonic() + p.seconds
        room = _ByteBudget(p.max_bytes)
        timeout = httpx.Timeout(min(20.0, p.seconds))
        headers = {"Accept": "image/png, image/jpeg", "Accept-Encoding": "identity", "User-Agent": "fleet-map-server"}
        with (
            httpx.Client(timeout=timeout, headers=headers, follow_redirects=False) as client,
            ThreadPoolExecutor(MAX_CONCURRENT_REQUESTS) as threads,
        ):
            waiting = [threads.submit(self._fetch_tile, client, block, deadline, room) for block in blocks]
            try:
                return [one.result() for one in waiting]
            except BaseException:
                for one in waiting:
                    one.cancel()
                room.stopped.set()
                raise

    def _fetch_tile(self, client: httpx.Client, block: TileRequest, deadline: float, room: _ByteBudget) -> bytes | None:
        cached = self._read_cache(block)
        if cached is not None:
            return cached
        for k in range(self.provider.tries):
            try:
                data = self._request_tile(client, block, deadline, room)
                break
            except _RetryableError as error:
                wait = max(0.5 * 2**k, min(error.wait, MAX_WAIT_SECONDS))
                last = k + 1 == self.provider.tries
                if last or room.stopped.is_set() or time.monotonic() + wait > deadline:
                    raise Unavailable(f"the imagery provider {self.provider.host} {error}: try again later") from None
                self._sleep(wait)
        if data is not None:
            self._write_cache(block, data)
        return data

    def _request_tile(
        self, client: httpx.Client, block: TileRequest, deadline: float, room: _ByteBudget
    ) -> bytes | None:
        """Fetch one block. No error message contains the URL with the token."""
        import httpx

        url = self._address(block.url)
        try:
            for _ in range(MAX_REDIRECTS + 1):
                with client.stream("GET", url) as answer:
                    if answer.is_redirect:
                        url = self._led_to(url, answer.headers.get("location", ""))
                        continue
                    return self._body(answer, deadline, room)
        except httpx.TimeoutException:
            raise _RetryableError("did not respond in time") from None
        except httpx.InvalidURL:
            raise self._provider_error("redirected to an invalid URL") from None
        except httpx.HTTPError as error:
            raise _RetryableError(f"cannot be reached ({type(error).__name__})") from None
        raise self._provider_error(f"redirected more than {MAX_REDIRECTS} times")

    def _address(self, url: str) -> str:
        """Insert the token into a URL."""
        token = quote(self.provider.token, safe="")
        if self.provider.kind == "mapbox" and "{token}" not in url and token:
            return f"{url}{'&' if '?' in url else '?'}access_token={token}"
        return url.replace("{token}", token)

    def _led_to(self, url: str, location: str) -> str:
        target = urljoin(url, location)
        old, new = urlsplit(url), urlsplit(target)
        if (old.scheme, old.netloc) != (new.scheme, new.netloc):
            raise self._provider_error("redirected to another host, which is not allowed: check FLEETMAP_IMAGERY_URL")
        return target

    def _body(self, answer: httpx.Response, deadline: float, room: _ByteBudget) -> bytes | None:
        status = answer.status_code
        if status == 404:
            return None
        if status in (401, 403):
            raise self._provider_error(
                f"rejected the request ({status}): check FLEETMAP_IMAGERY_TOKEN and its permissions"
            )
        if status == 429 or status >= 500:
            retry_after = answer.headers.get("retry-after", "")
            raise _RetryableError(
                f"returned status {status}",
                float(retry_after) if retry_after.isascii() and retry_after.isdigit() else 0.0,
            )
        if status != 200:
            raise self._provider_error(f"returned status {status}")
        kind = answer.headers.get("content-type", "").partition(";")[0].strip().lower()[:80]
        if kind and not kind.startswith("image/") and kind != "application/octet-stream":
            raise self._provider_error(f"sent {kind!r} instead of an image: check FLEETMAP_IMAGERY_URL")
        if answer.headers.get("content-encoding", "identity").lower() != "identity":
            raise self._provider_error("sent a compressed response, which was not requested")
        length = answer.headers.get("content-length", "")
        if length.isascii() and length.isdigit() and int(length) > self.provider.max_bytes:
            raise self._too_large()
        out = bytearray()
        # Without a chunk size: httpx would wait until a chunk is full, past the deadline of a slow response.
        for chunk in answer.iter_raw():
            if not room.take(len(chunk)):
                raise self._too_large()
            out += chunk
            if time.monotonic() > deadline:
                raise _RetryableError(f"did not complete its response within {self.provider.seconds:g} s")
        data = bytes(out)
        if not any(data.startswith(magic) for magic in MAGIC):
            raise self._provider_error("sent data that is neither PNG nor JPEG: check FLEETMAP_IMAGERY_URL")
        return data

    def _provider_error(self, problem: str) -> CannotDerive:
        return CannotDerive(f"the imagery provider {self.provider.host} {problem}", step=METHOD)

    def _too_large(self) -> CannotDerive:
        max_bytes = self.provider.max_bytes
        return self._provider_error(
            f"sent more than FLEETMAP_IMAGERY_MAX_BYTES ({max_bytes}): set a coarser resolution"
        )

    # --- cache ---
    def _file(self, block: TileRequest) -> Path | None:
        folder = self.provider.cache_dir
        return None if folder is None else folder / hashlib.sha256(block.url.encode()).hexdigest()

    def _read_cache(self, block: TileRequest) -> bytes | None:
        file = self._file(block)
        if file is None:
            return None
        try:
            data = file.read_bytes()
            os.utime(file)
        except OSError:
            return None
        return data if any(data.startswith(magic) for magic in MAGIC) else None

    def forget(self, blocks: Iterable[TileRequest]) -> None:
        """Remove responses from the cache: one of them may be damaged, and is fetched again next time."""
        for file in filter(None, map(self._file, blocks)):
            with contextlib.suppress(OSError):
                file.unlink()

    def _write_cache(self, block: TileRequest, data: bytes) -> None:
        """Cache a response and evict the least recently used ones. Ignores a full disk."""
        file = self._file(block)
        if file is None or len(data) > self.provider.cache_bytes:
            return
        with contextlib.suppress(OSError):
            file.parent.mkdir(parents=True, exist_ok=True)
            part = file.with_suffix(f".{threading.get_ident()}.part")
            part.write_bytes(data)
            part.replace(file)
            _trim(file.parent, self.provider.cache_bytes)


class _ByteBudget:
    """Byte budget of all responses for one image."""

    def __init__(self, max_bytes: int) -> None:
        self._left, self._lock = max_bytes, threading.Lock()
        self.stopped = threading.Event()

    def take(self, count: int) -> bool:
        """Take ``count`` bytes from the budget. Returns False if it has fewer left."""
        with self._lock:
            self._left -= count
            return self._left >= 0


def _trim(folder: Path, max_bytes: int) -> None:
    entries = []
    for file in folder.iterdir():
        with contextlib.suppress(OSError):
            status = file.stat()
            entries.append((status.st_mtime_ns, status.st_size, file))
    total = sum(size for _, size, _ in entries)
    for _, size, file in sorted(entries):
        if total <= max_bytes:
            return
        with contextlib.suppress(OSError):
            file.unlink()
        total -= size


# --- in a worker ------------------------------------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class FetchedImagery:
    """Responses of a provider, and how to store them.

    provenance_step: the step for the version's provenance. site: the fences that bounded the request, as the
    provenance's inputs.
    """

    sheet: Mosaic
    answers: tuple[bytes | None, ...]
    parameters: Parameters
    provenance_step: Mapping[str, Any]
    attribution: tuple[str, ...]
    site: tuple[Mapping[str, Any], ...] = ()


def prepare_picture(
    database_url: str, blob_dir: str, base: Version, fetched: FetchedImagery, limits: Limits
) -> tuple[Prepared, tuple[Problem, ...]]:
    """Decode the responses, assemble the image and prepare the version that contains it (in a worker).

    Raises CannotDerive if a response is no image of the requested size.
    """
    picture, missing = assemble_image(fetched.sheet, fetched.answers, fetched.attribution, limits)
    warnings = []
    if missing:
        why = f"the provider has no image for {missing} of {len(fetched.answers)} tiles; they are transparent"
        warnings.append(Problem(why))
    inputs = (*fetched.site, {"datum": base.datum.as_dict() if base.datum else None})
    provenance = Provenance("derived", None, (), None, (dict(fetched.provenance_step),), fetched.attribution, inputs)
    store = open_store(database_url, blob_dir)
    return store.versions.prepare(base, Changes((Replace(fetched.parameters.key, picture, provenance),))), tuple(
        warnings
    )


def assemble_image(
    mosaic: Mosaic, answers: Iterable[bytes | None], attribution: tuple[str, ...], limits: Limits
) -> tuple[GeoImage, int]:
    """Assemble the image. Returns it and the number of missing tiles. Raises CannotDerive if all are missing."""
    pixels = np.zeros((mosaic.height, mosaic.width, 4), np.uint8)
    missing = 0
    for block, data in zip(mosaic.blocks, answers, strict=True):
        if data is None:
            missing += 1
            continue
        shown = _decode_tile(block, data, limits)
        row, column = max(block.row, 0), max(block.column, 0)
        end, right = min(block.row + block.height, mosaic.height), min(block.column + block.width, mosaic.width)
        inner = shown[row - block.row : end - block.row, column - block.column : right - block.column]
        pixels[row:end, column:right] = inner
    if missing == len(mosaic.blocks):
        raise CannotDerive("the imagery provider has no image of this place at this resolution", step=METHOD)
    properties = {"attribution": list(attribution)} if attribution else {}
    image = pixels if (pixels[..., 3] < 255).any() else np.ascontiguousarray(pixels[..., :3])
    return GeoImage(image, mosaic.transform, MERCATOR, properties), missing


def _decode_tile(block: TileRequest, data: bytes, limits: Limits) -> NDArray[np.uint8]:
    """Decode a response like an upload, to RGBA: uint8 [height, width, 4]."""
    end = next(kind for magic, kind in MAGIC.items() if data.startswith(magic))
    name = f"answer.{end}"
    hints = UploadHints(format="satellite", options={"metres_per_pixel": "1"})
    try:
        (part,) = upload_reader.read({name: data}, hints, EnvironmentContext(), limits).layers(None).parts.values()
    except (BadUpload, ValueError) as error:
        raise CannotDerive(f"the imagery provider sent an image that cannot be read: {error}", step=METHOD) from error
    assert isinstance(part, GeoImage)
    height, width, bands = part.pixels.shape
    if (height, width) != (block.height, block.width) or part.pixels.dtype != np.uint8:
        raise CannotDerive(
            f"the imagery provider sent images of {width} × {height} pixels instead of {block.width} × "
            f"{block.height}: check FLEETMAP_IMAGERY_TILE_SIZE",
            step=METHOD,
        )
    out = np.full((height, width, 4), 255, np.uint8)
    out[..., :3] = part.pixels[..., :3] if bands >= 3 else part.pixels[..., :1]
    if bands in (2, 4):
        out[..., 3] = part.pixels[..., -1]
    return out
