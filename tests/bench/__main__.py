"""Measure conversions against floors, first GET against conversion, GETs against a peer, large maps, events."""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
from rich.console import Console
from rich.table import Table

from app import upload_reader
from app.convert.files import offline
from app.limits import Limits
from app.model.frame import Datum
from app.model.grid import OccupancyGrid
from app.upload_reader import UploadHints
from tests.bench import (
    backup,
    closures,
    derived,
    events,
    floors,
    generate,
    http,
    large,
    mirror,
    networks,
    ogc,
    scale,
    servers,
    sizing,
)
from tests.ports import free_port

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
FARM = "environment_template/riseholme_park_farm_strawberry_polytunnels/config/"
ALLOWED_MS = 15.0
HERE = Datum(53.268642038, -0.524509505881)


def best(work: Callable[[], Any], tries: int) -> float:
    """Measure the fastest of several tries in milliseconds, after a warm-up."""
    work()
    times = []
    for _ in range(tries):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times) * 1e3


def conversions(tries: int) -> list[dict[str, Any]]:
    """Measure our conversions and their floors alternately."""

    def data(name: str) -> bytes:
        return (DATA / name).read_bytes()

    cases: list[tuple[str, str, dict[str, bytes], str, dict[str, Any], Callable[[], Any]]] = []
    for place in ("urban-usa-mn-minnesota-zoo", "urban-usa-fl-miami-subberbs", "urban-netherlands-subburbs"):
        osm = data(f"osm/{place}/osm.xml")
        cases.append(("osm → tmap2", place, {"map.osm": osm}, "tmap2", {}, lambda d=osm: floors.osm_to_tmap2(d)))
    for name in (FARM + "topological/r_sp_man_tmap.kml", "kml/riseholme_park_farm_mid_19/mid_19_man_tmap.kml"):
        kml = data(name)
        more = {"hints": UploadHints(layer="topology")}
        cases.append(
            (
                "kml → tmap2",
                name.rpartition("/")[2],
                {"a.kml": kml},
                "tmap2",
                more,
                lambda d=kml: floors.kml_to_tmap2(d),
            )
        )
    tmap2 = data(FARM + "topological/network.tmap2.yaml")
    cases.append(
        (
            "tmap2 → kml",
            "strawberry",
            {"a.tmap2.yaml": tmap2},
            "kml",
            {"datum": HERE},
            lambda: floors.tmap2_to_kml(tmap2),
        )
    )
    datum = data("datum/riseholme_park_farm_general_south_pathway/datum_autogen.yaml")
    cases.append(("datum → kml", "south_pathway", {"datum.yaml": datum}, "kml", {}, lambda: floors.datum_to_kml(datum)))
    described, picture = data(FARM + "metric/map/map.yaml"), data(FARM + "metric/map/map.png")
    grid = {"map.yaml": described, "map.png": picture}
    cases.append(
        (
            "occupancy grid → kml",
            "strawberry 4000²",
            grid,
            "kml",
            {"datum": HERE},
            lambda: floors.grid_to_kml(described, picture),
        )
    )
    rows = []
    for label, name, files, to, more, floor in cases:
        low = best(floor, tries)
        ours = best(lambda: offline(files, to, **more), tries)  # noqa: B023
        bound = 2 * low + ALLOWED_MS
        rows.append(
            {
                "conversion": label,
                "input": name,
                "floor_ms": low,
                "ours_ms": ours,
                "bound_ms": bound,
                "holds": ours <= bound,
            }
        )
    return rows


def serving(tries: int) -> list[dict[str, Any]]:
    """Measure a server: first GET against the bare conversion, repeated GETs against a bare Starlette route."""
    rows: list[dict[str, Any]] = []
    port, peer = free_port(), free_port()
    token = "bench-" + "0" * 40
    with tempfile.TemporaryDirectory() as folder:
        env = {"FLEETMAP_DATA_DIR": folder, "FLEETMAP_ADMIN_TOKEN": token, "FLEETMAP_MAX_UPLOADS_WAITING": "64"}
        command = [sys.executable, "-m", "app.cli", "serve", "--host", "127.0.0.1", "--port", str(port)]
        with http.serving(command, port, env), http.serving(http.bare(peer), peer):
            auth = {"Authorization": f"Bearer {token}"}
            with httpx.Client(base_url=f"http://127.0.0.1:{port}", headers=auth, timeout=120) as client:
                rows += _first_gets(client, tries)
                rows += _repeated(client, port, peer, auth)
    return rows


def _first_gets(client: httpx.Client, tries: int) -> list[dict[str, Any]]:
    tmap2 = (DATA / FARM / "topological/network.tmap2.yaml").read_bytes()
    osm = (DATA / "osm/urban-usa-mn-minnesota-zoo/osm.xml").read_bytes()
    cases = (
        ("first GET, tmap2 → kml", "network.tmap2.yaml", tmap2, "kml", {"datum": HERE}),
        ("first GET, osm → tmap2", "map.osm", osm, "tmap2", {}),
    )
    rows = []
    for label, name, data, to, more in cases:
        bare = best(lambda: offline({name: data}, to, **more), tries)  # noqa: B023
        times = []
        for k in range(tries + 1):
            env = f"bench-{to}-{k}"
            body: dict[str, Any] = {"name": env}
            if more:
                body["datum"] = {"latitude": HERE.latitude + k * 1e-6, "longitude": HERE.longitude}
            client.post("/api/v1/environments", json=body).raise_for_status()
            # Each try edits a node by a micrometre, so that nothing is in the cache.
            answer = client.post(f"/api/v1/environments/{env}/versions", files=[("files", (name, data))])
            answer.raise_for_status()
            if not more and k:
                head = answer.json()["version"]
                shift = {"datum": {"latitude": 44.7 + k * 1e-6, "longitude": -93.2}}
                client.patch(f"/api/v1/environments/{env}", json=shift).raise_for_status()
                assert head >= 1
            start = time.perf_counter()
            client.get(f"/maps/{env}/{to}").raise_for_status()
            times.append((time.perf_counter() - start) * 1e3)
        first = min(times[1:])
        rows.append(
            {
                "what": label,
                "peer": bare,
                "ours": first,
                "unit": "ms",
                "ratio": first / bare,
                "bound": "≤ 1.3",
                "holds": first <= 1.3 * bare,
            }
        )
    return rows


def _repeated(client: httpx.Client, port: int, peer: int, auth: dict[str, str]) -> list[dict[str, Any]]:
    client.post("/api/v1/environments", json={"name": "bench"}).raise_for_status()
    small = b"datum_latitude: 53.26\ndatum_longitude: -0.52\n"
    client.post("/api/v1/environments/bench/versions", files=[("files", ("datum.yaml", small))]).raise_for_status()
    side = 316
    grid = (
        b"image: big.pgm\nresolution: 0.05\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    pixels = b"P5\n%d %d\n255\n" % (side, side) + bytes([254]) * (side * side)
    files = [("files", ("big.yaml", grid)), ("files", ("big.pgm", pixels))]
    client.post("/api/v1/environments/bench/versions", files=files).raise_for_status()
    one, large = "/maps/bench/datum", "/maps/bench/occupancy_grid/big.pgm"
    tag = client.get(one).headers["etag"]
    rows = []
    for label, ours_path, peer_path, more, peer_more, bound in (
        ("repeated GET, 1 kB", one, "/1k", {}, {}, 0.6),
        ("repeated GET, 100 kB", large, "/100k", {}, {}, 0.9),
        ("repeated GET, 304", one, "/1k", {"If-None-Match": tag}, {"If-None-Match": '"tag"'}, 0.6),
    ):
        ours, theirs = [], []
        for _ in range(3):  # alternately, so that noise affects both
            theirs.append(http.rate(peer, peer_path, peer_more))
            ours.append(http.rate(port, ours_path, {**auth, **more}))
        ours_best, bare = max(ours), max(theirs)
        rows.append(
            {
                "what": label,
                "peer": bare,
                "ours": ours_best,
                "unit": "1/s",
                "ratio": ours_best / bare,
                "bound": f"≥ {bound}",
                "holds": ours_best >= bound * bare,
            }
        )
    return rows


def farm_grid() -> OccupancyGrid:
    """Read the real map of 4000 × 4000 cells."""
    files = {name: (DATA / FARM / "metric/map" / name).read_bytes() for name in ("map.yaml", "map.png")}
    upload_bundle = upload_reader.read(
        files, UploadHints(), upload_reader.EnvironmentContext(None, None, None, True, False), Limits()
    )
    (grid,) = upload_bundle.layers(None).grids().values()
    return grid


def memory() -> list[dict[str, Any]]:
    """Measure time and peak memory of large maps, each in a separate process."""
    rows = []
    for name in large.CASES:
        with tempfile.TemporaryDirectory() as folder:
            rows.append(large.measure(name, Path(folder)))
    return rows


def main() -> int:
    """Print the tables (or JSON). Returns 1 if a bound is exceeded."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench", description=__doc__)
    parser.add_argument("--tries", type=int, default=7, help="counted runs of each conversion (default 7)")
    parser.add_argument("--json", action="store_true", help="machine-readable output")
    parser.add_argument(
        "--only",
        choices=[
            "conversions",
            "serving",
            "networks",
            "large",
            "events",
            "closures",
            "generate",
            "derived",
            "ogc",
            "scale",
            "scale-postgresql",
            "mirror",
            "servers",
            "sizing",
            "backup",
            "backup-postgresql",
        ],
        help="one of the tables; scale and scale-postgresql (half an hour each), servers and sizing (with PostgreSQL), "
        "and backup and backup-postgresql only if they are named",
    )
    parser.add_argument(
        "--databases",
        type=Path,
        metavar="FOLDER",
        help="where scale and scale-postgresql find or leave their filled databases (see tests.bench.scale_databases)",
    )
    arguments = parser.parse_args()
    if arguments.only == "sizing":
        return sizing.report(arguments.json)
    is_scale = arguments.only in ("scale", "scale-postgresql")
    without_maps = ("generate", "large", "derived", "mirror", "servers", "backup", "backup-postgresql")
    if not DATA.is_dir() and not is_scale and arguments.only not in without_maps:
        print("the real maps are not beside the checkout (../shared/data): nothing to measure", file=sys.stderr)
        return 2
    converted = conversions(arguments.tries) if arguments.only in (None, "conversions") else []
    served = serving(arguments.tries) if arguments.only in (None, "serving") else []
    paths = networks.rows(farm_grid(), arguments.tries) if arguments.only in (None, "networks") else []
    big = memory() if arguments.only in (None, "large") else []
    event_rows = events.rows() if arguments.only in (None, "events") else []
    closed = closures.rows() if arguments.only in (None, "closures") else []
    ogc_rows = ogc.rows(arguments.tries * 3) if arguments.only in (None, "ogc") else []
    server_rows = servers.rows() if arguments.only == "servers" else []
    generation_rows = generate.rows() if arguments.only in (None, "generate") else []
    huge = [derived.measure(name) for name in derived.CASES] if arguments.only in (None, "derived") else []
    scale_rows = []
    if is_scale:
        scale_rows = scale.rows(postgres=arguments.only == "scale-postgresql", folder=arguments.databases)
    mirror_rows = mirror.rows() if arguments.only in (None, "mirror") else []
    is_backup = arguments.only in ("backup", "backup-postgresql")
    backup_rows = backup.rows(postgres=arguments.only == "backup-postgresql") if is_backup else []
    if arguments.json:
        tables = {"conversions": converted, "serving": served, "networks": paths, "large": big, "events": event_rows}
        tables |= {
            "closures": closed,
            "ogc": ogc_rows,
            "servers": server_rows,
            "generate": generation_rows,
            "derived": huge,
            "scale": scale_rows,
            "backup": backup_rows,
            "mirror": mirror_rows,
        }
        print(json.dumps(tables, indent=2))
    else:
        console = Console(width=110)
        if converted:
            table = Table("conversion", "input", "floor ms", "ours ms", "ours ÷ floor", "bound ms", "holds")
            for r in converted:
                ratio = f"{r['ours_ms'] / r['floor_ms']:.1f}"
                table.add_row(
                    r["conversion"],
                    r["input"],
                    f"{r['floor_ms']:.1f}",
                    f"{r['ours_ms']:.1f}",
                    ratio,
                    f"{r['bound_ms']:.1f}",
                    "yes" if r["holds"] else "NO",
                )
            console.print(table)
        ratios = {
            "served": served,
            "grid → network": paths,
            "events": event_rows,
            "closures": closed,
            "OGC API": ogc_rows,
            "generated": generation_rows,
            "several servers": server_rows,
            "many against few": scale_rows,
            "backup": backup_rows,
            "mirror": mirror_rows,
        }
        for title, rows in ratios.items():
            if not rows:
                continue
            table = Table(title, "peer", "ours", "unit", "ratio", "bound", "holds")
            for r in rows:
                table.add_row(
                    r["what"],
                    "–" if r["peer"] is None else f"{r['peer']:.1f}",
                    f"{r['ours']:.1f}",
                    r["unit"],
                    "–" if r["peer"] is None else f"{r['ratio']:.2f}",
                    r["bound"],
                    "yes" if r["holds"] else "NO",
                )
            console.print(table)
        if big:
            table = Table("large map", "input MB", "s", "peak MB", "peak ÷ input or pixels", "bound", "holds")
            for r in big:
                table.add_row(
                    r["map"],
                    f"{r['input_mb']:.1f}",
                    f"{r['ms'] / 1e3:.2f}",
                    f"{r['peak_mb']:.0f}",
                    f"{r['times']:.1f}",
                    f"≤ {r['bound']:.0f}" if r["bound"] else "–",
                    "yes" if r["holds"] else "NO",
                )
            console.print(table)
        if huge:
            table = Table("20 000 × 14 000 cells", "s", "peak GB, of the whole process", "bound", "holds")
            for r in huge:
                spent, bound = f"{r['ms'] / 1e3:.0f}", f"≤ {derived.MOST / 1e9:.0f}"
                table.add_row(r["map"], spent, f"{r['peak'] / 1e9:.2f}", bound, "yes" if r["holds"] else "NO")
            console.print(table)
    return (
        0
        if all(
            r["holds"]
            for rows in (
                converted,
                served,
                paths,
                big,
                event_rows,
                closed,
                generation_rows,
                huge,
                ogc_rows,
                scale_rows,
                mirror_rows,
                server_rows,
                backup_rows,
            )
            for r in rows
        )
        else 1
    )


if __name__ == "__main__":
    sys.exit(main())
