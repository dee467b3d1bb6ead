"""Solid objects are equal in worlds, grids and drawings: multipolygons, lifts, and slices of worlds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import orjson
import osmium
import pytest
import shapely
from lxml import etree

from app import formats, upload_reader
from app.convert import worker
from app.derive import DerivationNotes
from app.derive.objects_to_occupancy import Parameters, objects_to_occupancy
from app.errors import CannotConvert
from app.limits import Limits
from app.model import osm_areas
from app.model.frame import Datum
from app.model.grid import OCCUPIED, OccupancyGrid
from app.model.layers import Layers
from app.upload_reader import EnvironmentContext, UploadHints

SAMPLES = Path(__file__).parents[1] / "samples"
DATUM = Datum(53.2, -0.5)
ZOO = "osm/urban-usa-mn-minnesota-zoo/osm.xml"

CORNERS = {
    # an outer ring of two ways, a courtyard with a kiosk in it, and a second building of the same relation
    **{1: (0, 0), 2: (40, 0), 3: (40, 30), 4: (0, 30)},
    **{5: (10, 8), 6: (30, 8), 7: (30, 22), 8: (10, 22)},
    **{9: (18, 13), 10: (22, 13), 11: (22, 17), 12: (18, 17)},
    **{13: (60, 0), 14: (70, 0), 15: (70, 10), 16: (60, 10)},
}
WAYS = {
    1: ("outer", [1, 2, 3]),
    2: ("outer", [1, 4, 3]),
    3: ("inner", [5, 6, 7]),
    4: ("inner", [5, 8, 7]),
    5: ("outer", [9, 10, 11, 12, 9]),
    6: ("", [13, 14, 15, 16, 13]),
}
AREA = 40 * 30 - 20 * 14 + 4 * 4 + 10 * 10


def courtyard(without: int | None = None) -> bytes:
    """Build a house with a courtyard as an OpenStreetMap file, in metres from the datum; optionally without one way."""
    metre = 1 / 111_320
    narrow = metre / np.cos(np.radians(DATUM.latitude))
    out = ['<osm version="0.6">']
    for i, (x, y) in CORNERS.items():
        lat, lon = DATUM.latitude + y * metre, DATUM.longitude + x * narrow
        out.append(f'<node id="{i}" version="1" lat="{lat:.7f}" lon="{lon:.7f}"/>')
    for i, (_, refs) in WAYS.items():
        if i != without:
            out.append(f'<way id="{i}" version="1">{"".join(f"""<nd ref="{r}"/>""" for r in refs)}</way>')
    members = "".join(f'<member type="way" ref="{i}" role="{role}"/>' for i, (role, _) in WAYS.items())
    tags = '<tag k="type" v="multipolygon"/><tag k="building" v="yes"/><tag k="height" v="5"/>'
    return "".join([*out, f'<relation id="7" version="1">{members}{tags}</relation></osm>']).encode()


def read(files: dict[str, bytes], datum: Datum | None = DATUM) -> upload_reader.Bundle:
    return upload_reader.read(upload_reader.unpack(files, Limits()), UploadHints(), EnvironmentContext(datum), Limits())


def written(layers: Layers, to: str, **options: Any) -> dict[str, bytes]:
    return worker.from_layers(formats.get_format(to), layers, options, derived=False).files


def cut(layers: Layers, **options: Any) -> dict[str, OccupancyGrid]:
    """Return the derived grid of each level."""
    derived_layers = objects_to_occupancy(layers, Parameters(outside_free=True, **options), DerivationNotes())
    return {key.level: grid for key, grid in derived_layers.grids().items()}


def square_metres(grid: OccupancyGrid) -> float:
    return float((grid.cells == OCCUPIED).sum() * grid.resolution**2)


def test_multipolygon_is_an_area_with_holes_everywhere() -> None:
    layers = read({"map.osm": courtyard()}).layers(DATUM)
    (grid,) = cut(layers).values()
    assert square_metres(grid) == pytest.approx(AREA, rel=0.03)
    drawn = orjson.loads(next(iter(written(layers, "geojson").values())))
    (relation,) = [f for f in drawn["features"] if f["id"] == "r7"]
    shape = shapely.from_geojson(orjson.dumps(relation["geometry"]))
    assert [len(part.interiors) for part in shape.geoms] == [1, 0, 0]
    folder = next(iter(written(layers, "kml").values()))
    inner = etree.fromstring(folder).findall(".//{*}innerBoundaryIs")
    assert len(inner) == 1
    world = etree.fromstring(written(layers, "gazebo")["world.sdf"])
    (model,) = [m for m in world.iter("model") if m.findall(".//collision") and m.get("name") != "ground_plane"]
    assert len(model.findall(".//collision//polyline")) + len(model.findall(".//collision//box")) == 4, (
        "a box is one ring"
    )


def test_multipolygon_is_the_original_relation_in_osm() -> None:
    layers = read({"map.osm": courtyard()}).layers(DATUM)
    root = etree.fromstring(written(layers, "osm")["map.osm"])
    (relation,) = root.findall("relation")
    assert [(m.get("ref"), m.get("role")) for m in relation.findall("member")] == [
        (str(i), role) for i, (role, _) in WAYS.items()
    ]
    assert {w.get("id"): [int(n.get("ref", "")) for n in w.findall("nd")] for w in root.findall("way")} == {
        str(i): refs for i, (_, refs) in WAYS.items()
    }
    assert len(root.findall("node")) == len(CORNERS)


def test_multipolygon_equals_the_area_that_osmium_assembles(tmp_path: Path) -> None:
    path = tmp_path / "map.osm"
    path.write_bytes(courtyard())
    factory = osmium.geom.WKBFactory()
    processor = osmium.FileProcessor(path).with_areas()
    (expected,) = [shapely.from_wkb(factory.create_multipolygon(o)) for o in processor if o.is_area()]
    part = next(iter(read({"map.osm": courtyard()}).layers(DATUM).vector("objects").values()))
    (area,) = [g for i, g in zip(part.ids, part.geometry, strict=True) if i == "r7"]
    assert shapely.symmetric_difference(area, expected).area < 1e-9 * expected.area
    assert area.is_valid


def test_multipolygon_with_missing_way_is_warned_about() -> None:
    bundle = read({"map.osm": courtyard(without=3)})
    assert any("1 multipolygons have no area" in w.problem and w.problem.endswith(": 7") for w in bundle.warnings)
    part = next(iter(bundle.layers(DATUM).vector("objects").values()))
    assert part.geometry[part.index()["r7"]].is_empty


def test_open_rings_make_no_area() -> None:
    line = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    assert osm_areas.assemble_area([line]) is None
    assert osm_areas.assemble_area([]) is None
    assert osm_areas.assemble_area([line, line[::-1]]) is None, "a way there and back encloses nothing"
    assert osm_areas.assemble_area([line, np.array([[1.0, 1.0], [0.0, 0.0]])]).area == pytest.approx(0.5)


def test_lift_has_walls_a_free_cabin_and_open_doors(shared: Path) -> None:
    """The first lift of the hotel: a cabin of 2.7 m whose door of 1.7 m is in the middle of its lower side."""
    layers = read(
        {"hotel.building.yaml": (shared / "data/openrmf_building/hotel/hotel.building.yaml").read_bytes()}, None
    )
    layers = layers.layers(None)
    lift = next(p for part in layers.vector("objects").values() for p in part.properties if p.get("name") == "Lift1")
    assert lift["kind"] == "lift"
    x, y, _, _, _, yaw = lift["pose"]
    c, s = np.cos(yaw), np.sin(yaw)

    def at(grid: OccupancyGrid, u: float, v: float) -> int:
        column = int((x + c * u - s * v - grid.origin[0]) / grid.resolution)
        row = int((y + s * u + c * v - grid.origin[1]) / grid.resolution)
        return int(grid.cells[row, column])

    half = lift["size"][1] / 2
    back = read(written(layers, "gazebo"), None).layers(None)
    for grid in (cut(layers)["L1"], next(iter(cut(back).values()))):
        assert at(grid, 0.0, 0.0) == 0, "a robot stands in the cabin"
        assert at(grid, 0.0, -half - 0.02) == 0, "and gets in and out by its door"
        assert at(grid, -lift["size"][0] / 2 - 0.02, 0.0) == OCCUPIED


def content(path: Path) -> Layers | None:
    """Return the objects of a map with their files; None if it has none."""
    every = [path] if path.is_file() else [p for p in sorted(path.rglob("*")) if p.is_file()]
    files = {p.relative_to(path.parent).as_posix(): p.read_bytes() for p in every if p.name != "facts.json"}
    if not files:
        return None
    layers = read(files).layers(DATUM)
    parts = {k: p for k, p in layers.parts.items() if k.layer in ("objects", "resources")}
    return Layers(parts, layers.datum or DATUM, layers.levels)


def assert_law(layers: Layers, label: str, **options: Any) -> int:
    """Assert that the slice of the written world equals the derived grid of each level; return the number of levels."""
    try:
        grids = cut(layers, **options)
    except CannotConvert:  # nothing solid, or places too far from the datum
        return 0
    back = read(written(layers, "gazebo", content="all"), None).layers(None)
    for level, grid in grids.items():
        expected = grid.cells == OCCUPIED
        occupied = np.zeros_like(expected)
        if not expected.any():
            continue
        height = layers.elevation(level) + 0.2
        (other,) = cut(Layers(back.parts), resolution=grid.resolution, height=height).values()
        shift = [round((other.origin[k] - grid.origin[k]) / grid.resolution) for k in (1, 0)]
        cells = np.argwhere(other.cells == OCCUPIED) + shift
        assert (cells >= 0).all(), label
        assert (cells < occupied.shape).all(), label
        occupied[tuple(cells.T)] = True
        assert (occupied == expected).mean() >= 0.99, (label, level)
        assert (occupied & expected).sum() >= 0.99 * (occupied | expected).sum(), (label, level)
    return len(grids)


def test_slice_of_a_written_world_equals_the_derived_grid(shared: Path) -> None:
    """The slice law for every sample with solid objects, and for real buildings, a town and a world."""
    counts = {p.relative_to(SAMPLES).as_posix(): 0 for p in sorted(SAMPLES.glob("*/*")) if p.name != "facts.json"}
    for name in counts:
        layers = content(SAMPLES / name)
        counts[name] = 0 if layers is None else assert_law(layers, name)
    assert {name.partition("/")[0] for name, count in counts.items() if count} >= {
        "gazebo",
        "lanelet2",
        "openrmf",
        "osm",
    }
    data = shared / "data"
    for name, resolution in (("openrmf_building/hotel/hotel.building.yaml", 0.1), (ZOO, 0.5)):
        layers = content(data / name)
        assert layers is not None
        assert assert_law(layers, name, resolution=resolution)
    assert assert_law(read({"map.osm": courtyard()}).layers(DATUM), "courtyard")
