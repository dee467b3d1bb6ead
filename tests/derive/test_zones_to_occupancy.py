"""Zones -> costmap filter masks: their cells, the meaning of these, and delivery over HTTP."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
import yaml

from app import derive
from app.convert.files import offline
from app.derive import DerivationNotes
from app.derive.zones_to_occupancy import Parameters, zones_to_occupancy
from app.errors import CannotConvert, MissingDatum, MissingLayer, NotFound
from app.model.features import features
from app.model.frame import Datum
from app.model.grid import OccupancyGrid
from app.model.layers import Layers, PartKey
from app.upload_reader import UploadHints
from tests.api.conftest import Api, running, settings_for

KEEPOUT, SPEED = PartKey("occupancy", "ground", "keepout"), PartKey("occupancy", "ground", "speed")
MAP, ZONES = PartKey("occupancy"), PartKey("zones", "ground", "zones")


def zones(*rows: tuple[Any, dict[str, Any]], anchor: Any = "local", **more: Any) -> Layers:
    part = features([(f"z{k}", shape, p) for k, (shape, p) in enumerate(rows)], anchor)
    return Layers({ZONES: part, **more.pop("parts", {})}, **more)


def derive_masks(layers: Layers, **values: Any) -> tuple[Layers, DerivationNotes]:
    notes = DerivationNotes()
    return zones_to_occupancy(layers, Parameters(**values), notes), notes


def grid(layers: Layers, key: PartKey) -> OccupancyGrid:
    part = layers.parts[key]
    assert isinstance(part, OccupancyGrid)
    return part


def info(mask: OccupancyGrid) -> tuple[int, float, float]:
    parameters = mask.properties["costmap_filter"]["params"]["costmap_filter_info_server"]["ros__parameters"]
    return parameters["type"], parameters["base"], parameters["multiplier"]


def speed_at(mask: OccupancyGrid, x: float, y: float) -> float | None:
    """The limit at a place as Nav2's speed filter finds it; None: no limit."""
    column, row = (int((v - o) // mask.resolution) for v, o in zip((x, y), mask.origin, strict=False))
    cell = int(mask.cells[row, column])
    _, base, multiplier = info(mask)
    assert cell != 255, "an error to Nav2"
    return None if cell == 0 else base + multiplier * cell


def the_map(width: int = 12, height: int = 8, origin: tuple[float, float, float] = (-1.0, -1.0, 0.0)) -> OccupancyGrid:
    return OccupancyGrid(np.zeros((height, width), np.uint8), 0.5, origin)


def test_keepout_covers_every_touched_cell_in_map_frame() -> None:
    box, sliver = shapely.box(0.0, 0.0, 1.0, 0.5), shapely.box(3.1, 1.1, 3.2, 1.2)
    layers = zones((box, {"kind": "keepout"}), (sliver, {"kind": "Keepout"}), parts={MAP: the_map()})
    out, notes = derive_masks(layers)
    mask = grid(out, KEEPOUT)
    assert list(out.parts) == [KEEPOUT]
    assert (mask.resolution, mask.origin, mask.cells.shape) == (0.5, (-1.0, -1.0, 0.0), (8, 12))
    expected = np.zeros((8, 12), np.uint8)
    expected[2, 2:4] = 100  # y 0…0.5 is row 2 from below, x 0…1 are columns 2 and 3
    expected[4, 8] = 100
    assert (mask.cells == expected).all()
    assert info(mask) == (0, 0.0, 1.0)
    assert mask.mode == "scale"
    assert notes.dropped == notes.warnings == notes.template == []


def test_masks_have_holes_levels_and_other_resolutions() -> None:
    ring = shapely.box(0, 0, 3, 3).difference(shapely.box(1, 1, 2, 2))
    layers = zones((ring, {"kind": "keepout"}))
    upper = features([("u", shapely.box(10, 10, 11, 11), {"kind": "keepout"})], "local")
    out, _ = derive_masks(Layers({**layers.parts, PartKey("zones", "L2", "zones"): upper}), resolution=0.5)
    mask = grid(out, KEEPOUT)
    assert mask.origin == (-1.0, -1.0, 0.0)  # the zones and a metre around them
    assert mask.cells.shape == (10, 10)
    assert int((mask.cells == 100).sum()) == 36 - 4
    assert mask.cells[4:6, 4:6].tolist() == [[0, 0], [0, 0]]
    assert grid(out, PartKey("occupancy", "L2", "keepout")).origin == (9.0, 9.0, 0.0)
    finer, _ = derive_masks(
        zones((ring, {"kind": "keepout"}), parts={MAP: the_map(origin=(-1.25, -1.0, 0.0))}), resolution=0.1
    )
    assert grid(finer, KEEPOUT).origin == (-1.3, -1.0, 0.0), "a whole multiple of its own cells"
    turned, _ = derive_masks(zones((ring, {"kind": "keepout"}), parts={MAP: the_map(origin=(0.0, 0.0, 0.3))}))
    assert grid(turned, KEEPOUT).origin[2] == 0.0


def test_lowest_speed_limit_wins_and_is_rounded_down() -> None:
    layers = zones(
        (shapely.box(0, 0, 4, 4), {"kind": "speed", "value": 1.5}),
        (shapely.box(0, 0, 2, 4), {"kind": "speed", "value": 0.333}),
        (shapely.box(3, 0, 4, 1), {"kind": "speed", "value": 0}),
        (shapely.box(2, 2, 3, 3), {"kind": "speed"}),
    )
    out, notes = derive_masks(layers)
    mask = grid(out, SPEED)
    assert list(out.parts) == [SPEED]
    assert info(mask) == (2, 0.0, 0.02)
    assert speed_at(mask, 2.5, 0.5) == pytest.approx(1.5)
    assert speed_at(mask, 1.0, 1.0) == pytest.approx(0.32), "rounded down"
    assert speed_at(mask, 3.5, 0.5) == pytest.approx(0.02)
    assert speed_at(mask, -0.5, -0.5) is None
    assert {d.subject: d.count for d in notes.dropped} == {"speed zones without a limit": 1, "exact speed limits": 2}
    assert "limit 0" in notes.warnings[0].problem


@pytest.mark.parametrize(
    ("limits", "unit", "expected"),
    [
        ((0.3, 30), "m/s", (0.3, 30.0)),
        ((0.04, 5.0), "m/s", (0.04, 4.0)),
        ((0.13, 3.0), "m/s", (0.1, 3.0)),
        (("0.25 %", "80 %"), "%", (0.25, 25.0)),
        (("1 %", "80 %"), "%", (1.0, 80.0)),
    ],
)
def test_high_speed_limit_does_not_raise_a_low_one(
    limits: tuple[Any, Any], unit: str, expected: tuple[float, float]
) -> None:
    """Steps that reach the highest limit would be above the lowest one."""
    places = ((0, 0, 4, 4), (6, 0, 9, 4))
    layers = zones(*((shapely.box(*at), {"kind": "speed", "value": v}) for at, v in zip(places, limits, strict=True)))
    out, notes = derive_masks(layers)
    mask = grid(out, SPEED)
    assert (speed_at(mask, 2, 2), speed_at(mask, 7, 2)) == (pytest.approx(expected[0]), pytest.approx(expected[1]))
    slowed = [w.problem for w in notes.warnings if f"get the limit {expected[1]:g} {unit}" in w.problem]
    assert len(slowed) == (expected[1] < float(str(limits[1]).rstrip(" %")))


def test_speed_in_percent() -> None:
    layers = zones(
        (shapely.box(0, 0, 4, 4), {"kind": "speed", "value": "50 %"}),
        (shapely.box(5, 0, 6, 1), {"kind": "speed", "value": "120%"}),
    )
    mask = grid(derive_masks(layers)[0], SPEED)
    assert info(mask) == (1, 0.0, 1.0)
    assert (speed_at(mask, 1, 1), speed_at(mask, 5.5, 0.5)) == (50.0, None)
    both = zones(
        (shapely.box(0, 0, 4, 4), {"kind": "speed", "value": "50%"}),
        (shapely.box(5, 0, 6, 1), {"kind": "speed", "value": "0.5 m/s"}),
    )
    with pytest.raises(CannotConvert, match="max_speed"):
        derive_masks(both)
    mask = grid(derive_masks(both, max_speed=2.0)[0], SPEED)
    assert info(mask)[0] == 2
    assert (speed_at(mask, 1, 1), speed_at(mask, 5.5, 0.5)) == (pytest.approx(1.0), pytest.approx(0.5))
    mask = grid(derive_masks(both, max_speed=2.0, speed_in="percent")[0], SPEED)
    assert info(mask) == (1, 0.0, 1.0)
    assert (speed_at(mask, 1, 1), speed_at(mask, 5.5, 0.5)) == (50.0, 25.0)


def test_preferred_lanes_are_free_and_cells_beside_them_cost() -> None:
    layers = zones(
        (shapely.box(0, 0, 4, 1), {"kind": "preferred lane"}),
        (shapely.box(1, 0, 2, 1), {"kind": "keepout"}),
        parts={MAP: the_map()},
    )
    out, notes = derive_masks(layers, lane_cost=70)
    mask = grid(out, KEEPOUT)
    assert mask.cells[2].tolist() == [70, 70, 0, 0, 100, 100, 0, 0, 0, 0, 70, 70]
    assert mask.cells[0].tolist() == [70] * 12
    assert [t.value for t in notes.template] == [70]


def test_dropped_zones_are_noted() -> None:
    layers = zones(
        (shapely.box(0, 0, 1, 1), {"kind": "keepout", "expires": "2031-01-01T00:00:00Z"}),
        (shapely.box(90, 90, 91, 91), {"kind": "keepout"}),
        (shapely.box(4, 0, 91, 1), {"kind": "keepout"}),
        (shapely.box(0, 0, 1, 1), {"kind": "priority", "value": 3}),
        (shapely.LineString([(0, 0), (1, 1)]), {"kind": "keepout"}),
        parts={MAP: the_map()},
    )
    _, notes = derive_masks(layers)
    assert {d.subject: d.count for d in notes.dropped} == {
        "zones of other kinds": 1,
        "zones without an area": 1,
        "zones outside of the map": 1,
        "parts of zones outside of the map": 1,
    }
    assert "until they are derived again" in notes.warnings[0].problem


def test_missing_zones_raise_missing_layer() -> None:
    with pytest.raises(MissingLayer, match="kind keepout"):
        derive_masks(zones((shapely.box(0, 0, 1, 1), {"kind": "priority"})))
    with pytest.raises(MissingDatum):
        derive_masks(zones((shapely.box(0, 0, 1e-4, 1e-4), {"kind": "keepout"}), anchor="wgs84"))
    with pytest.raises(CannotConvert, match="coarser"):
        derive_masks(zones((shapely.box(0, 0, 1e5, 1e5), {"kind": "keepout"})))
    with pytest.raises(CannotConvert, match="125004 × 10 cells is too large"):
        derive_masks(zones((shapely.box(0, 0, 1e5, 5), {"kind": "keepout"})))
    earth = zones((shapely.box(0, 0, 1e-4, 1e-4), {"kind": "keepout"}), anchor="wgs84", datum=Datum(0.0, 0.0))
    width = grid(derive_masks(earth)[0], KEEPOUT).width
    assert width == pytest.approx((11.13 + 2) / 0.05, abs=3)


@pytest.mark.parametrize(("length", "resolution"), [(1630, 0.05), (1637, 0.1), (10_000, 0.4)])
def test_mask_of_long_zones_has_no_more_cells_along_a_side_than_nav2_loads(length: float, resolution: float) -> None:
    mask = grid(derive_masks(zones((shapely.box(0, 0, length, 5), {"kind": "keepout"})))[0], KEEPOUT)
    assert mask.resolution == pytest.approx(resolution)
    assert mask.width <= 32767
    assert mask.width * mask.resolution == pytest.approx(length + 2, abs=2 * resolution)


def test_masks_do_not_serve_as_map() -> None:
    assert derive.plan(frozenset({"zones"}), frozenset({"occupancy"})) is None


KML = """<kml xmlns="http://www.opengis.net/kml/2.2"><Document><name>zones</name>{}</Document></kml>"""
PLACEMARK = (
    "<Placemark><name>{name}</name>{data}<Polygon><outerBoundaryIs><LinearRing><coordinates>{at}</coordinates>"
    "</LinearRing></outerBoundaryIs></Polygon></Placemark>"
)


def drawn(*names: str) -> bytes:
    """Squares of about 5 m on the equator, side by side."""
    squares = []
    for k, name in enumerate(names):
        west, east = k * 1e-4, k * 1e-4 + 5e-5
        at = f"{west},0 {east},0 {east},0.00005 {west},0.00005 {west},0"
        data = ""
        if name == "slow":
            pair = '<Data name="kind"><value>speed</value></Data><Data name="value"><value>0.5</value></Data>'
            data = f"<ExtendedData>{pair}</ExtendedData>"
        squares.append(PLACEMARK.format(name=name, at=at, data=data))
    return KML.format("".join(squares)).encode()


def test_drawing_gives_masks_offline() -> None:
    hints = UploadHints(layer="zones")
    files = offline({"zones.kml": drawn("pond")}, "occupancy_grid", hints=hints, options={"grid": "keepout"}).files
    assert list(files) == ["keepout.yaml", "keepout.pgm", "keepout_filter_info.yaml"]
    with pytest.raises((NotFound, MissingLayer)):
        offline({"zones.kml": drawn("pond")}, "occupancy_grid", hints=hints, options={"grid": "speed"})
    with pytest.raises(MissingLayer):
        offline({"zones.kml": drawn("pond")}, "occupancy_grid", hints=hints)


@pytest.fixture(scope="module")
def api(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Api]:
    with running(settings_for(tmp_path_factory.mktemp("server"))) as server:
        yield server


def mask_of(files: dict[str, bytes], name: str) -> tuple[dict[str, Any], np.ndarray[Any, Any]]:
    map_yaml = yaml.safe_load(files[f"{name}.yaml"])
    head, size, _, body = files[f"{name}.pgm"].split(b"\n", 3)
    width, height = map(int, size.split())
    assert head == b"P5"
    return map_yaml, np.frombuffer(body, np.uint8).reshape(height, width)


def test_drawn_keepout_is_served_as_mask(api: Api, tmp_path: Path) -> None:
    datum = {"latitude": 0.0, "longitude": 0.0}
    api.post("environments", {"name": "pasture", "datum": datum})
    api.upload("pasture", {"zones.kml": drawn("pond")}, layer="zones")
    first = api.get("/maps/pasture/occupancy_grid/keepout.yaml")
    assert yaml.safe_load(first.text)["image"] == "keepout.pgm"
    api.get("/maps/pasture/occupancy_grid", 422)
    room = {
        "map.yaml": b"image: map.pgm\nresolution: 0.25\norigin: [-2.0, -3.0, 0.0]\nnegate: 0\n"
        b"occupied_thresh: 0.65\nfree_thresh: 0.196\n",
        "map.pgm": b"P5\n80 60\n255\n" + b"\xfe" * 4800,
    }
    api.upload("pasture", room)
    answer = api.get("/maps/pasture/occupancy_grid?grid=keepout")
    with zipfile.ZipFile(io.BytesIO(answer.content)) as z:
        files = {n: z.read(n) for n in z.namelist()}
    assert sorted(files) == ["keepout.pgm", "keepout.yaml", "keepout_filter_info.yaml"]
    map_yaml, pixels = mask_of(files, "keepout")
    assert (map_yaml["resolution"], map_yaml["origin"], pixels.shape) == (0.25, [-2.0, -3.0, 0.0], (60, 80))
    black = np.argwhere(pixels == 0)
    assert len(black) == (pixels < 254).sum()
    # 5.56 m (in longitude) × 5.53 m from (0, 0): columns 8…30, and rows 12…34 from below.
    assert (black[:, 1].min(), black[:, 1].max()) == (8, 30)
    assert (59 - black[:, 0].max(), 59 - black[:, 0].min()) == (12, 34)
    parameters = yaml.safe_load(api.get("/maps/pasture/occupancy_grid/keepout_filter_info.yaml").text)
    assert parameters["costmap_filter_info_server"]["ros__parameters"]["type"] == 0
    assert api.get("/maps/pasture/occupancy_grid/map.pgm").content == room["map.pgm"]
    base = "environments/pasture/versions/latest"
    report = api.get(f"{base}/reports/occupancy_grid?grid=keepout").json()
    (line,) = [line for line in report["layers"] if line["layer"] == "occupancy"]
    assert (line["information"], line["name"], line["sources"]) == ("derived", "keepout", ["zones.kml"])
    assert line["steps"][0]["step"] == "zones_to_occupancy"
    api.get(f"{base}/maps/occupancy_grid/keepout.yaml?derive=false", 404)
    api.get(f"{base}/maps/occupancy_grid/speed.yaml", 404)
    api.get(f"{base}/maps/occupancy_grid/attic.yaml", 404)
    coarse = api.get(f"{base}/maps/occupancy_grid/keepout.yaml?resolution=0.5")
    assert yaml.safe_load(coarse.text)["resolution"] == 0.5
    api.get(f"{base}/maps/occupancy_grid/keepout.yaml?lane_cost=500", 422)


def test_speed_zones_over_http_and_committed(api: Api) -> None:
    api.post("environments", {"name": "yard", "datum": {"latitude": 0.0, "longitude": 0.0}})
    api.upload("yard", {"zones.kml": drawn("pond")}, layer="zones")
    square = [[10.0, 0.0], [12.0, 0.0], [12.0, 2.0], [10.0, 2.0], [10.0, 0.0]]
    slow = {
        "type": "Feature",
        "id": "slow",
        "properties": {"kind": "speed", "value": 0.5},
        "geometry": {"type": "Polygon", "coordinates": [square]},
    }
    changes = [{"op": "put", "layer": "zones", "feature": slow, "crs": "local"}]
    api.post("environments/yard/edits", {"message": "slow down", "changes": changes})
    base = "environments/yard/versions/latest/maps/occupancy_grid"
    filter_info = yaml.safe_load(api.get(f"{base}/speed_filter_info.yaml").text)
    parameters = filter_info["costmap_filter_info_server"]["ros__parameters"]
    assert (parameters["type"], parameters["base"], parameters["multiplier"]) == (2, 0.0, 0.01)
    assert yaml.safe_load(api.get(f"{base}/keepout.yaml").text)["mode"] == "scale"
    before = api.get(f"{base}/speed.pgm").content
    version = api.post("environments/yard/derivations", {"method": "zones_to_occupancy"}).json()
    assert version["information"]["occupancy"] == "derived"
    assert api.get(f"{base}/speed.pgm").content == before
    response = api.get(
        "environments/yard/versions/latest/layers/occupancy?name=speed", headers={"Accept": "application/json"}
    )
    assert response.json()["counts"]["other"] > 0
