"""The web page against its bounds, in Debian's headless Chromium: `make bench-web`.

CPU is that of the thread that runs the page's scripts, as Chromium counts it, so a busy machine changes it little;
frames per second and times until paint are only meaningful on a quiet one.
"""

from __future__ import annotations

import io
import json
import math
import re
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import numpy as np
from PIL import Image
from playwright.sync_api import Browser, CDPSession, Page, sync_playwright
from rich.console import Console
from rich.table import Table

from tests.cli.conftest import TOKEN, ServerProcess

NODES, EDGES = 3025, 10_692
SIDE = 55
VIEW = {"width": 1280, "height": 800}
PAN_FRAMES = 60
Row = tuple[str, str, str]


def network(side: int, spacing: float) -> dict[str, Any]:
    """Build a square network of side² nodes: streets in both directions, and as many diagonals as the bound names."""
    xs = np.arange(side) * spacing
    nodes = {
        f"n{i}_{j}": {"type": "Point", "coordinates": [float(xs[i]), float(xs[j])]}
        for i in range(side)
        for j in range(side)
    }
    ends = [((i, j), (i + 1, j)) for i in range(side - 1) for j in range(side)]
    ends += [((i, j), (i, j + 1)) for i in range(side) for j in range(side - 1)]
    pairs = [*ends, *((b, a) for a, b in ends)][:EDGES] if side == SIDE else ends
    features = [
        {"type": "Feature", "id": name, "geometry": None, "place": place, "properties": {"kind": "node", "name": name}}
        for name, place in nodes.items()
    ]
    for k, (a, b) in enumerate(pairs[:EDGES]):
        source, target = (f"n{i}_{j}" for i, j in (a, b))
        properties = {"kind": "edge", "source": source, "target": target}
        features.append({"type": "Feature", "id": f"e{k}", "geometry": None, "properties": properties})
    return {"features": features}


def grid_files(width: int, height: int, resolution: float, yaw: float, seed: int = 7) -> dict[str, bytes]:
    """Build an occupancy grid with rooms: walls, free floor and an unknown rim."""
    dice = np.random.default_rng(seed)
    cells = np.full((height, width), 254, np.uint8)
    step = 400
    for at in range(0, height, step):
        cells[at : at + 6] = 0
    for at in range(0, width, step):
        cells[:, at : at + 6] = 0
    for _ in range(2000):
        row, column = dice.integers(0, height - 40), dice.integers(0, width - 40)
        cells[row : row + 25, column : column + 25] = dice.choice([0, 205])
    cells[:50] = cells[-50:] = 205
    stream = io.BytesIO()
    Image.fromarray(cells).save(stream, "PNG", compress_level=1)
    header = (
        f"image: map.png\nresolution: {resolution}\norigin: [0.0, 0.0, {yaw}]\nnegate: 0\noccupied_thresh: 0.65\n"
        "free_thresh: 0.25\nmode: trinary\n"
    )
    return {"map.yaml": header.encode(), "map.png": stream.getvalue()}


class Bench:
    """A server with the sites to measure, and a browser."""

    def __init__(self, http: httpx.Client, browser: Browser, folder: Path) -> None:
        self.http, self.browser, self.folder = http, browser, folder

    def call(self, method: str, path: str, **request: Any) -> Any:
        answer = self.http.request(method, f"/api/v1/{path}", **request)
        answer.raise_for_status()
        return answer.json() if answer.content else None

    def make_site(self, name: str, files: dict[str, bytes], side: int = 0, spacing: float = 2.0) -> None:
        """Create a site with a grid and a network of side² nodes."""
        self.call("POST", "environments", json={"name": name})
        parts = [("files", (file, data)) for file, data in files.items()]
        if parts:
            self.call("POST", f"environments/{name}/versions", files=parts)
        if side:
            features = network(side, spacing)["features"]
            for start in range(0, len(features), 5000):
                changes = [{"op": "put", "layer": "topology", "feature": one} for one in features[start : start + 5000]]
                self.call("POST", f"environments/{name}/edits", json={"message": "network", "changes": changes})

    @contextmanager
    def open(self, path: str) -> Iterator[tuple[Page, CDPSession]]:
        """Open the page signed in; counters of CPU start before it loads."""
        context = self.browser.new_context(viewport=VIEW, base_url=str(self.http.base_url))  # type: ignore[arg-type]
        page = context.new_page()
        context.request.post("/api/v1/session", data={"token": TOKEN})
        devtools = context.new_cdp_session(page)
        devtools.send("Performance.enable", {"timeDomain": "threadTicks"})
        page.goto(path, wait_until="commit")
        try:
            yield page, devtools
        finally:
            context.close()


def cpu(devtools: CDPSession) -> float:
    """Return the CPU of the page's main thread in milliseconds."""
    metrics = {one["name"]: one["value"] for one in devtools.send("Performance.getMetrics")["metrics"]}
    return float(metrics["TaskDuration"]) * 1000


PAINTED = """(least) => {
  const canvases = [...document.querySelectorAll('.painted-layer:not([hidden]) canvas')];
  const painted = canvases.filter((canvas) => {
    if (!canvas.width) return false;
    const {data} = canvas.getContext('2d').getImageData(canvas.width / 4, canvas.height / 2, canvas.width / 2, 1);
    return data.some((value, index) => index % 4 === 3 && value);
  });
  return painted.length >= least;
}"""


def paint(bench: Bench, site: str, layers: int) -> tuple[float, float]:
    """Return the milliseconds and the main thread's CPU until layers of the map are painted."""
    with bench.open(f"/?site={site}&view=none") as (page, devtools):
        start = time.perf_counter()
        page.wait_for_function(PAINTED, arg=layers, polling=100, timeout=120_000)
        seconds = time.perf_counter() - start
        used = cpu(devtools)
        return seconds * 1000, used


PAN = """(frames) => new Promise((resolve) => {
  const map = document.querySelector('.map');
  const at = {x: 640, y: 400};
  const send = (type, x, y, buttons) => map.querySelector('.ol-viewport').dispatchEvent(new PointerEvent(type,
    {bubbles: true, clientX: x, clientY: y, pointerId: 1, isPrimary: true, buttons, button: 0, pointerType: 'mouse'}));
  send('pointerdown', at.x, at.y, 1);
  const start = performance.now();
  let count = 0;
  const step = () => {
    count += 1;
    const type = 'pointermove';
    document.dispatchEvent(new PointerEvent(type, {bubbles: true, clientX: at.x - count * 4, clientY: at.y + count * 2,
      pointerId: 1, isPrimary: true, buttons: 1, pointerType: 'mouse'}));
    if (count < frames) return requestAnimationFrame(step);
    document.dispatchEvent(new PointerEvent('pointerup', {bubbles: true, clientX: at.x, clientY: at.y, pointerId: 1,
      isPrimary: true, pointerType: 'mouse'}));
    resolve(frames / (performance.now() - start) * 1000);
  };
  requestAnimationFrame(step);
})"""


def pan(bench: Bench, site: str, at: str) -> tuple[float, float]:
    """Return the main thread's CPU per frame while the map is dragged, and frames per second."""
    with bench.open(f"/?site={site}&view=none{at}") as (page, devtools):
        page.wait_for_function(PAINTED, arg=2, polling=50, timeout=120_000)
        page.wait_for_timeout(3000)
        before = cpu(devtools)
        rate = page.evaluate(PAN, PAN_FRAMES)
        return (cpu(devtools) - before) / PAN_FRAMES, rate


def drag(bench: Bench, site: str) -> float:
    """Return the main thread's CPU per movement in milliseconds while a node is dragged in the editor."""
    with bench.open(f"/?site={site}&view=edit&at=100,100,0.05") as (page, devtools):
        page.get_by_role("toolbar", name="Editing tools").wait_for(timeout=120_000)
        page.wait_for_timeout(3000)
        box = page.locator(".map").bounding_box()
        assert box
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x + 8, y + 3)
        page.wait_for_timeout(500)
        before = cpu(devtools)
        for step in range(PAN_FRAMES):
            page.mouse.move(x + 8 + step, y + 3 + step / 3)
            page.evaluate("() => new Promise(requestAnimationFrame)")
        used = cpu(devtools) - before
        page.mouse.up()
        page.get_by_role("button", name="Undo (Ctrl+Z)").and_(page.locator(":enabled")).wait_for(timeout=60_000)
        return used / PAN_FRAMES


ROBOTS = 500
AT_CENTRE = """() => [...document.querySelectorAll('.painted-layer:not([hidden]) canvas')].filter(
  (canvas) => canvas.width
    && canvas.getContext('2d').getImageData(canvas.width / 2, canvas.height / 2, 1, 1).data[3]).length"""
UNTIL_SEEN = f"""(before) => new Promise((resolve) => {{
  const count = {AT_CENTRE};
  const look = () => count() > before ? resolve(performance.timeOrigin + performance.now())
    : requestAnimationFrame(look);
  look();
}})"""


def event_to_pixel(bench: Bench, site: str) -> float:
    """Return the median seconds from a robot's report until it is drawn at its new place, with 499 others."""
    root = bench.call("GET", f"environments/{site}/versions/latest")["root"]
    version = bench.call("GET", f"environments/{site}")["version"]

    def report(robot: int, x: float, y: float) -> None:
        status = {"environment": site, "channel": "latest", "version": version, "root": root, "state": "active"}
        pose = {"x": x, "y": y, "yaw": 0.0, "level": "ground"}
        bench.call("PUT", f"robots/r{robot}/status", json={**status, "pose": pose})

    for robot in range(ROBOTS):
        report(robot, 50 + robot % 25 * 4.0, 60.0 + robot // 25 * 4.0)
    seconds: list[float] = []
    with bench.open(f"/?site={site}&view=fleet&at=101,101,0.1") as (page, _):
        page.get_by_role("list", name="Robots").get_by_role("listitem").first.wait_for(timeout=120_000)
        page.wait_for_timeout(3000)
        for robot in range(7):
            before = page.evaluate(AT_CENTRE)
            start = time.time()
            page.evaluate(f"window.seen = ({UNTIL_SEEN})({before}); null")
            report(robot, 101.0, 101.0)
            seconds.append(page.evaluate("window.seen") / 1000 - start)
            report(robot, 50.0, 50.0)
            page.wait_for_timeout(2000)
    return statistics.median(seconds)


def memory(bench: Bench, site: str) -> float:
    """Return the memory of the browser's process for the page, in megabytes, after zooming through the map."""
    with bench.open(f"/?site={site}&view=none") as (page, _):
        page.wait_for_function(PAINTED, arg=1, polling=50, timeout=120_000)
        for _ in range(6):
            page.get_by_role("button", name="Zoom in").click()
            page.wait_for_timeout(400)
        page.wait_for_timeout(3000)
        return renderer_megabytes()


def renderer_megabytes() -> float:
    """Return the resident memory of the largest renderer process of this machine's Chromium."""
    sizes = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if b"--type=renderer" in (folder / "cmdline").read_bytes():
                match = re.search(r"^Pss:\s+(\d+)", (folder / "smaps_rollup").read_text(), re.MULTILINE)
                sizes.append(int(match[1]) / 1000 if match else 0.0)
        except OSError:
            continue
    return max(sizes, default=math.nan)


def tiles(bench: Bench, site: str) -> tuple[float, float]:
    """Return the median milliseconds of a tile at its first request, and again with its ETag known to the server."""
    base = f"environments/{site}/versions/latest/tiles/occupancy/map"
    levels = bench.call("GET", base)["levels"]
    bench.http.get(f"/api/v1/{base}/0/0/0.png")  # builds the overviews
    side = 2 ** (levels - 1) // 2
    paths = [f"/api/v1/{base}/{levels - 1}/{row}/{column}.png" for row in range(4) for column in range(min(side, 5))]

    def timed(path: str) -> float:
        start = time.perf_counter()
        bench.http.get(path).raise_for_status()
        return (time.perf_counter() - start) * 1000

    return statistics.median(map(timed, paths)), statistics.median(map(timed, paths))


def sizes(bench: Bench) -> tuple[float, float]:
    """Return the kilobytes of the first view and of all files, compressed."""
    folder = Path(__file__).resolve().parents[2] / "app" / "web" / "dist" / "assets"
    front = bench.http.get("/").text

    def packed(path: str) -> int:
        return int(bench.http.get(path).headers["content-length"])

    first = sum(packed(name) for name in set(re.findall(r"/assets/[\w.-]+", front)))
    return first / 1000, sum(packed(f"/assets/{path.name}") for path in folder.iterdir()) / 1000


def measure(bench: Bench, large: bool) -> Iterator[Row]:
    """Yield what is measured, its bound and its figure."""
    bench.make_site("square", grid_files(4000, 4000, 0.05, 0.2), SIDE, 3.6)
    first = [paint(bench, "square", 2) for _ in range(3)]
    yield f"{NODES} nodes, {EDGES} edges on 4000²: paint", "≤ 2000 ms", f"{min(t for t, _ in first):.0f} ms"
    yield "its main-thread CPU", "≤ 500 ms", f"{statistics.median(c for _, c in first):.0f} ms"
    for name, at in (("whole", ""), ("close", "&at=60,60,0.02")):
        used, rate = pan(bench, "square", at)
        yield f"panning it, {name}: CPU a frame", "≤ 16 ms", f"{used:.1f} ms"
        yield f"panning it, {name}: frames", "≥ 30 /s", f"{rate:.0f} /s"
    cold, cached = tiles(bench, "square")
    yield "tile, cold", "≤ 30 ms", f"{cold:.1f} ms"
    yield "tile, cached", "≤ 2 ms", f"{cached:.1f} ms"
    bench.make_site("network", {}, 142, 2.0)
    yield "dragging a node of 20 000: CPU a movement", "≤ 33 ms", f"{drag(bench, 'network'):.1f} ms"
    yield f"report to pixel, {ROBOTS} robots", "≤ 1 s", f"{event_to_pixel(bench, 'square'):.2f} s"
    view, everything = sizes(bench)
    yield "first view, gzip", "≤ 250 kB", f"{view:.0f} kB"
    yield "all files, gzip", "≤ 450 kB", f"{everything:.0f} kB"
    if large:
        bench.make_site("large", grid_files(27_000, 24_000, 0.05, 0.0))
        bench.http.get("/api/v1/environments/large/versions/1/tiles/occupancy/map/0/0/0.png", timeout=300)
        yield "27 000 × 24 000: paint", "≤ 3000 ms", f"{paint(bench, 'large', 1)[0]:.0f} ms"
        yield "27 000 × 24 000: page", "≤ 400 MB", f"{memory(bench, 'large'):.0f} MB"


def main() -> None:
    """Measure and print a table, or JSON with ``--json``; ``--large`` includes the largest grid."""
    with tempfile.TemporaryDirectory() as name, sync_playwright() as playwright:
        folder = Path(name)
        environment = {
            "FLEETMAP_DATA_DIR": str(folder / "data"),
            "FLEETMAP_ADMIN_TOKEN": TOKEN,
            "FLEETMAP_MAX_PIXELS": "1000000000",
        }
        process = ServerProcess(environment=environment, folder=folder)
        process.ready()
        browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=["--no-sandbox"])
        headers = {"authorization": f"Bearer {TOKEN}"}
        try:
            with httpx.Client(base_url=process.address, headers=headers, timeout=300) as http:
                rows: list[Row] = []
                report: Callable[[Row], None] = rows.append
                for row in measure(Bench(http, browser, folder), "--large" in sys.argv):
                    report(row)
                    print(*row, sep=" · ", file=sys.stderr, flush=True)
        finally:
            browser.close()
            process.stop()
    if "--json" in sys.argv:
        print(
            json.dumps([dict(zip(("what", "bound", "measured"), row, strict=True)) for row in rows], ensure_ascii=False)
        )
        return
    table = Table("what", "bound", "measured")
    for row in rows:
        table.add_row(*row)
    Console().print(table)


if __name__ == "__main__":
    main()
