"""Environments at a position: fences, floor and datums, on both databases."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
import shapely
from alembic import command
from alembic.script import ScriptDirectory
from sqlalchemy import event, insert, select, update

from app.errors import Damaged, Invalid
from app.model.features import Features, features
from app.model.frame import Datum
from app.model.geodesy import local_frame, surface
from app.model.grid import OccupancyGrid
from app.model.layers import PartKey
from app.store import area, position, schema, tables
from app.store.changes import Changes, Delete, Drop, Put, Replace
from app.store.encode import to_wkb
from app.store.store import Store
from app.store.values import Match
from tests.store.samples import DATUM, OBJECTS, TOPOLOGY, network, save

SITE = PartKey("location", "ground", "site")
MAP = PartKey("occupancy", "ground", "map")
FARM_DATUM = Datum(53.268, -0.5245)
FARM = shapely.box(-0.54, 53.254, -0.521, 53.276)


def fence(shape: Any, kind: str = "fence", anchor: Any = "wgs84") -> Features:
    return features([("fence", shape, {"kind": kind})], anchor)


def grid(free: tuple[int, int, int, int] | None, origin: tuple[float, float, float] = (0.0, 0.0, 0.0), **more: Any):
    """Return a grid of 400 × 300 m, 1 m per cell: unknown except for free cells from (column, row) to (column, row)."""
    cells = np.full((300, 400), 255, np.uint8)
    if free is not None:
        u0, v0, u1, v1 = free
        cells[v0:v1, u0:u1] = 0
        cells[v0, u0:u1] = 100
    return OccupancyGrid(cells, 1.0, origin, **more)


def at(datum: Datum, x: float, y: float) -> tuple[float, float]:
    """Convert local metres to latitude and longitude."""
    longitude, latitude = local_frame(datum).to_wgs84(np.array([[x, y]]))[0].tolist()
    return latitude, longitude


def names(store: Store, latitude: float, longitude: float, **more: Any) -> list[str]:
    return [e.name for e, _ in store.areas.locate(latitude, longitude, **more)[0]]


def match(store: Store, name: str, latitude: float, longitude: float) -> Match | None:
    matches = {e.name: m for e, m in store.areas.locate(latitude, longitude)[0]}
    return matches.get(name)


def stale(store: Store) -> list[str]:
    table = tables.environment
    with store._database.read() as connection:
        return list(connection.execute(select(table.c.name).where(table.c.area_stale)).scalars())


def test_positions_find_the_field_that_contains_them(store: Store):
    fields = {"north": shapely.box(-0.53, 53.27, -0.529, 53.271), "south": shapely.box(-0.53, 53.268, -0.529, 53.269)}
    for name, field in fields.items():
        store.environments.create(name, datum=Datum(field.bounds[1], field.bounds[0]))
        farm = features([("farm", FARM, {"kind": "region"})], "wgs84")
        save(store, name, Replace(SITE, fence(field)), Replace(OBJECTS, farm))
        assert store.environments.get(name).bounds == FARM.bounds
    assert names(store, 53.2705, -0.5295) == ["north"]
    assert names(store, 53.2685, -0.5295) == ["south"]
    assert names(store, 53.2695, -0.5295) == []
    position_match = match(store, "north", 53.2705, -0.5295)
    assert position_match is not None
    assert position_match.by == "fence"
    assert position_match.area == pytest.approx(surface(fields["north"]), abs=0.1)
    assert position_match.area == pytest.approx(66.7 * 111.3, rel=0.01)
    assert position_match.distance == pytest.approx(math.hypot(33.4, 55.7), rel=0.01)
    assert {e.name for e in store.environments.page(bbox=(-0.53, 53.2694, -0.5295, 53.2696))[0]} == {"north", "south"}
    assert stale(store) == []


def test_fences_have_holes_and_several_pieces(store: Store):
    store.environments.create("yard", datum=FARM_DATUM)
    ring = shapely.Polygon(
        shapely.box(-0.53, 53.26, -0.52, 53.27).exterior, [shapely.box(-0.526, 53.264, -0.524, 53.266).exterior]
    )
    island = shapely.box(-0.51, 53.26, -0.50, 53.27)
    save(store, "yard", Replace(SITE, fence(shapely.MultiPolygon([ring, island]))))
    assert names(store, 53.262, -0.525) == ["yard"]
    assert names(store, 53.265, -0.525) == []
    assert names(store, 53.265, -0.505) == ["yard"]
    assert names(store, 53.265, -0.515) == []
    for edge in ((53.26, -0.53), (53.27, -0.505), (53.265, -0.526)):
        assert names(store, *edge) == ["yard"], "the edge belongs to it"
    position_match = match(store, "yard", 53.265, -0.505)
    assert position_match is not None
    assert position_match.area == pytest.approx(surface(ring) + surface(island), abs=0.1)


def test_position_query_agrees_with_geometry_on_both_databases(store: Store):
    random = np.random.default_rng(3)
    drawn: dict[str, Any] = {}
    for k in range(6):
        outer = shapely.convex_hull(shapely.multipoints(random.random((8, 2)) * 0.1))
        drawn[f"f{k}"] = shapely.difference(outer, outer.centroid.buffer(0.01))
        store.environments.create(f"f{k}")
        save(store, f"f{k}", Replace(SITE, fence(shapely.MultiPolygon(shapely.get_parts(drawn[f"f{k}"]).tolist()))))
    vertices = shapely.get_coordinates(list(drawn.values()))[::7]
    for x, y in (*vertices.tolist(), *(random.random((40, 2)) * 0.1).tolist()):
        covering = {name for name, shape in drawn.items() if shape.covers(shapely.Point(x, y))}
        assert set(names(store, y, x)) == covering, (x, y)


@pytest.mark.parametrize("form", ["crossing", "cut", "local", "touching", "circle"])
def test_fence_across_antimeridian_covers_positions(store: Store, form: str):
    datum = Datum(-17.0, 179.999)
    store.environments.create("fiji", datum=datum)
    shape: Any = shapely.Polygon([(179.99, -17.01), (-179.99, -17.01), (-179.99, -16.99), (179.99, -16.99)])
    if form == "cut":
        shape = shapely.MultiPolygon(
            [shapely.box(179.99, -17.01, 180, -16.99), shapely.box(-180, -17.01, -179.99, -16.99)]
        )
    elif form == "touching":
        shape = shapely.Polygon([(179.99, -17.01), (-180.0, -17.01), (180.0, -16.99), (179.99, -16.99)])
    if form == "local":
        save(store, "fiji", Replace(SITE, fence(shapely.box(-900, -900, 1000, 900), anchor="local")))
    elif form != "circle":
        save(store, "fiji", Replace(SITE, fence(shape)))
    for longitude in (179.9985, 180.0, -180.0, *(() if form == "touching" else (-179.9995,))):
        assert names(store, -17.0, longitude) == ["fiji"], longitude
    for longitude in (179.98, -179.98, 0.0, 90.0, -90.0, *((-179.9995,) if form == "touching" else ())):
        assert names(store, -17.0, longitude) == [], longitude
    assert names(store, -16.98, 179.9995) == []
    position_match = match(store, "fiji", -17.0, 180.0)
    assert position_match is not None
    width = {"crossing": 0.02, "cut": 0.02, "touching": 0.01}.get(form)
    if width is not None:
        assert position_match.area == pytest.approx(surface(shapely.box(0, -17.01, width, -16.99)), rel=1e-6)
    assert position_match.distance == pytest.approx(106.5, rel=0.01)


def test_fence_without_area_is_ignored(store: Store):
    line = shapely.Polygon([(-0.53, 53.26), (-0.52, 53.27), (-0.525, 53.265)])
    bow = shapely.Polygon([(-0.53, 53.26), (-0.52, 53.27), (-0.52, 53.26), (-0.53, 53.27)])
    drawn = {
        "line": features([("fence", line, {"kind": "fence"})], "wgs84"),
        "bow": features([("fence", bow, {"kind": "fence"})], "wgs84"),
        "path": features([("p", shapely.LineString([(-0.53, 53.26), (-0.52, 53.27)]), {"kind": "fence"})], "wgs84"),
        "empty": features([("none", None, {"kind": "fence"})], "wgs84"),
    }
    for name, part in drawn.items():
        store.environments.create(name, datum=Datum(53.2605, -0.5255))
        save(store, name, Replace(SITE, part))
    assert names(store, 53.265, -0.529) == ["bow"]
    assert names(store, 53.265, -0.521) == ["bow"]
    assert names(store, 53.269, -0.525) == [], "between the two triangles"
    environments = store.areas.locate(53.2605, -0.5255)[0]
    assert {(e.name, m.by) for e, m in environments} == {(name, "datum") for name in ("line", "path", "empty")}


def test_polygons_of_kind_fence_win_over_other_polygons(store: Store):
    store.environments.create("farm", datum=FARM_DATUM)
    boundary = shapely.box(-0.525, 53.268, -0.524, 53.269)
    save(store, "farm", Replace(SITE, features([("farm", FARM, {}), ("own", boundary, {"kind": "fence"})], "wgs84")))
    assert names(store, 53.2685, -0.5245) == ["farm"]
    assert names(store, 53.26, -0.53) == []
    save(store, "farm", Delete(SITE, ("own",)))
    assert names(store, 53.26, -0.53) == ["farm"]


def test_floor_area_joins_grids_networks_and_floors(store: Store):
    turned = Datum(53.2, -0.5, heading=30.0)
    for name in ("grid", "network", "hall", "mask", "unknown"):
        store.environments.create(name, datum=turned)
    save(store, "grid", Replace(MAP, grid((100, 50, 300, 250), origin=(500.0, 0.0, math.pi / 2))))
    nodes = [(f"n{k}", shapely.Point(xy), {"kind": "node"}) for k, xy in enumerate([(-500, 0), (-300, 0), (-400, 90)])]
    far = ("n9", shapely.Point(9000, 0), {"kind": "node"})
    edge = ("e", shapely.LineString([(-500, 0), (-300, 0)]), {"kind": "edge", "source": "n0", "target": "n1"})
    save(store, "network", Replace(TOPOLOGY, features([*nodes, far, edge], "local")))
    hall = shapely.box(-400, -400, -300, -300)
    building = ("b", shapely.box(0, -900, 900, 0), {"kind": "building"})
    save(store, "hall", Replace(OBJECTS, features([("f", hall, {"kind": "floor"}), building], "local")))
    save(store, "mask", Replace(PartKey("occupancy", "ground", "keepout"), grid((0, 0, 400, 300))))
    info = {"costmap_filter": {"params": {}}}
    save(store, "mask", Replace(PartKey("occupancy", "ground", "lanes"), grid((0, 0, 400, 300), properties=info)))
    save(store, "unknown", Replace(MAP, grid(None)))

    def hits(x: float, y: float) -> dict[str, str]:
        return {e.name: m.by for e, m in store.areas.locate(*at(turned, x, y))[0]}

    # the grid is turned by 90°: x = 500 - v, y = u; the lowest row of its free room is a wall
    assert hits(350, 200) == {"grid": "floor"}
    assert hits(450 + 8, 200) == {"grid": "floor"}, "10 m around it"
    assert hits(500, 200) == {}
    assert hits(350, 320) == {}
    assert hits(-400, 20) == {"network": "floor"}
    assert hits(-480, 80) == {}
    assert hits(1500, 0) == {}, "the strip to a node that is beyond the neighbourhood"
    assert hits(-350, -350) == {"hall": "floor"}
    assert hits(200, -500) == {}, "a building is no floor"
    assert hits(0, 0) == {"mask": "datum", "unknown": "datum"}
    position_match = match(store, "hall", *at(turned, -350, -350))
    assert position_match is not None
    assert position_match.area == pytest.approx(100 * 100 + 4 * 100 * 10 + math.pi * 100, rel=1e-3)
    assert position_match.distance == pytest.approx(math.hypot(350, 350), abs=0.1)


@pytest.mark.parametrize("anchor", ["local", "wgs84"])
def test_floor_counts_only_near_datum(store: Store, anchor: Any):
    datum = Datum(53.2, -0.5)
    store.environments.create("long", datum=datum)
    store.environments.create("far", datum=datum)
    road = shapely.LineString([(0, 0), (50_000, 0)])
    other = shapely.LineString([(5000, 0), (9000, 0)])
    if anchor == "wgs84":
        road, other = local_frame(datum).geometries_to_wgs84(np.array([road, other], object))
    antipode = shapely.Point(179.5, -53.2)
    listed = [("e", road, {"kind": "edge"}), *([("x", antipode, {"kind": "node"})] if anchor == "wgs84" else [])]
    save(store, "long", Replace(TOPOLOGY, features(listed, anchor)))
    save(store, "far", Replace(TOPOLOGY, features([("e", other, {"kind": "edge"})], anchor)))
    assert names(store, *at(datum, 1900, 0)) == ["long"]
    assert names(store, *at(datum, 2100, 0)) == []
    assert names(store, *at(datum, 6000, 0)) == []
    assert {(e.name, m.by) for e, m in store.areas.locate(*at(datum, 0, 0))[0]} == {("long", "floor"), ("far", "datum")}


def test_datum_has_neighbourhood_except_null_island(store: Store):
    store.environments.create("bare", datum=FARM_DATUM)
    store.environments.create("nowhere")
    store.environments.create("unset", datum=Datum(0.0, 0.0))
    store.environments.create("gulf", datum=Datum(0.0, 0.0))
    square = fence(shapely.box(-9, -9, 9, 9), anchor="local")
    save(store, "unset", Replace(TOPOLOGY, network(20)), Replace(SITE, square))
    save(store, "nowhere", Replace(TOPOLOGY, network(20)), Replace(SITE, fence(FARM)))
    assert match(store, "bare", *at(FARM_DATUM, 199, 0)) == Match(
        "datum", pytest.approx(math.pi * 200**2, rel=0.01), 199.0
    )
    assert names(store, *at(FARM_DATUM, 199, 0)) == ["nowhere", "bare"], "a fence on earth needs no datum"
    assert match(store, "nowhere", *at(FARM_DATUM, 199, 0)) == Match("fence", pytest.approx(3.1e6, rel=0.1), None)
    assert names(store, *at(FARM_DATUM, 0, 1500)) == []
    assert names(store, 0.0, 0.0) == []
    assert names(store, 0.0, 1e-5) == []
    save(store, "gulf", Replace(SITE, fence(shapely.box(-1, -1, 1, 1))))
    assert names(store, 0.0, 0.0) == ["gulf"], "a drawn fence counts"


def test_matches_are_ordered_by_fence_size_and_distance(store: Store):
    for name, half in (("large", 0.02), ("small", 0.01)):
        store.environments.create(name, datum=FARM_DATUM)
        box = shapely.box(*(c + s * half for c, s in zip((-0.5245, 53.268) * 2, (-1, -1, 1, 1), strict=True)))
        save(store, name, Replace(SITE, fence(box)))
    store.environments.create("a-far", datum=Datum(*at(FARM_DATUM, 150, 0)))
    store.environments.create("b-near", datum=Datum(*at(FARM_DATUM, 50, 0)))
    store.environments.create("room", datum=FARM_DATUM)
    save(store, "room", Replace(MAP, grid((0, 0, 10, 10), origin=(-5.0, -5.0, 0.0))))
    expected = ["small", "large", "room", "b-near", "a-far"]
    assert names(store, FARM_DATUM.latitude, FARM_DATUM.longitude) == expected
    seen: list[str] = []
    cursor: str | None = None
    pages = 0
    while pages == 0 or cursor is not None:
        environments, cursor = store.areas.locate(FARM_DATUM.latitude, FARM_DATUM.longitude, limit=2, cursor=cursor)
        seen += [e.name for e, _ in environments]
        pages += 1
    assert (seen, pages) == (expected, 3)
    assert names(store, FARM_DATUM.latitude, FARM_DATUM.longitude, allowed="*r*") == [
        "large",
        "room",
        "b-near",
        "a-far",
    ]
    assert names(store, FARM_DATUM.latitude, FARM_DATUM.longitude, q="ROOM") == ["room"]
    assert names(store, FARM_DATUM.latitude, FARM_DATUM.longitude, bbox=(-0.51, 53.26, -0.50, 53.27)) == ["large"]
    for bad in ("", "farm", "1 2 3", "a 1 2 farm"):
        with pytest.raises(Invalid, match="Link"):
            store.areas.locate(FARM_DATUM.latitude, FARM_DATUM.longitude, cursor=bad)
    for wrong in ((91.0, 0.0), (0.0, 181.0), (math.nan, 0.0), (0.0, math.inf)):
        with pytest.raises(Invalid, match="degrees"):
            store.areas.locate(*wrong)
    with pytest.raises(Invalid):
        store.areas.locate(0.0, 0.0, limit=0)


def test_area_follows_every_change_in_its_transaction(store: Store):
    west, east = (53.265, -0.529), (53.265, -0.521)
    one, other = shapely.box(-0.53, 53.26, -0.525, 53.27), shapely.box(-0.525, 53.26, -0.52, 53.27)

    def matching_names() -> tuple[list[str], list[str]]:
        assert stale(store) == []
        return names(store, *west), names(store, *east)

    store.environments.create("farm", datum=FARM_DATUM)
    save(store, "farm", Replace(SITE, fence(one)))
    assert matching_names() == (["farm"], [])
    save(store, "farm", Put(SITE, fence(other)))
    assert matching_names() == ([], ["farm"])
    save(store, "farm", Replace(TOPOLOGY, network(50, side=300)))
    assert matching_names() == ([], ["farm"])
    store.versions.revert("farm", 2, author="me", message="back")
    assert matching_names() == (["farm"], [])
    store.environments.create("copy", clone=store.versions.get("farm", 4))
    assert matching_names() == (["farm"], ["copy"])
    store.environments.update("copy", new_name="second")
    assert matching_names() == (["farm"], ["second"])
    store.environments.delete("second")
    assert matching_names() == (["farm"], [])
    assert names(store, *east, deleted=True) == ["second"]
    store.environments.restore("second")
    assert matching_names() == (["farm"], ["second"])
    save(store, "second", Drop(SITE))
    assert matching_names() == (["farm"], [])
    position_match = match(store, "second", *at(FARM_DATUM, 150, 150))
    assert (position_match.by if position_match else "none") == "floor"
    moved = Datum(53.3, -0.6)
    base = store.versions.get("second")
    store.versions.commit("second", store.versions.prepare(base, Changes(datum=moved)), author="me", message="moved")
    assert stale(store) == []
    assert names(store, *at(FARM_DATUM, 150, 150)) == []
    assert names(store, *at(moved, 150, 150)) == ["second"]
    store.environments.delete("second")
    store.environments.purge("second")
    with store._database.read() as connection:
        assert len(connection.execute(select(tables.area)).all()) == 1


def test_area_of_large_content_is_computed_by_next_query(store: Store, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(area, "MAX_FEATURES", 10)
    monkeypatch.setattr(area, "MAX_CELLS", 1000)
    store.environments.create("farm", datum=FARM_DATUM)
    save(store, "farm", Replace(TOPOLOGY, network(50, side=300)))
    assert stale(store) == ["farm"]
    expected = Match("floor", pytest.approx(9e4, rel=0.2), pytest.approx(212.1, abs=0.1))
    assert match(store, "farm", *at(FARM_DATUM, 150, 150)) == expected
    assert stale(store) == []
    save(store, "farm", Replace(MAP, grid((0, 0, 400, 300), origin=(-400.0, -300.0, 0.0))))
    assert stale(store) == ["farm"]
    save(store, "farm", Replace(SITE, fence(FARM)))
    assert stale(store) == [], "a fence needs no floor"
    save(store, "farm", Drop(SITE))
    assert stale(store) == ["farm"]
    save(store, "farm", Replace(PartKey("zones", "ground", "zones"), features([], "local", {"a": 1})))
    assert stale(store) == ["farm"], "a change outside the area does not mark it as current"
    assert names(store, *at(FARM_DATUM, -200, -200)) == ["farm"]
    assert stale(store) == []


def test_several_servers_compute_areas_concurrently(store: Store, database_url: str, monkeypatch: pytest.MonkeyPatch):
    for k in range(8):
        store.environments.create(f"farm-{k}", datum=FARM_DATUM)
        save(store, f"farm-{k}", Replace(SITE, fence(FARM)))
    table = tables.environment
    with store._database.write() as connection:
        connection.execute(tables.area.delete())
        connection.execute(update(table).values(area_stale=True))
    moved = threading.Event()
    compute = position.compute_area

    def slow(*arguments: Any) -> Any:
        result = compute(*arguments)
        if not moved.is_set():  # a commit between the computation and the write
            moved.set()
            save(store, "farm-0", Replace(SITE, fence(shapely.box(-0.5, 53.0, -0.4, 53.1))))
            with store._database.write() as connection:
                connection.execute(update(table).where(table.c.name == "farm-0").values(area_stale=True))
        return result

    monkeypatch.setattr(position, "compute_area", slow)
    others = [Store(database_url, store.blob_dir) for _ in range(3)]
    try:
        with ThreadPoolExecutor(3) as threads:
            answers = list(threads.map(lambda s: names(s, 53.26, -0.53), others))
    finally:
        for other in others:
            other.close()
    assert stale(store) == []
    assert names(store, 53.26, -0.53) == [f"farm-{k}" for k in range(1, 8)]
    assert names(store, 53.05, -0.45) == ["farm-0"]
    assert all(set(answer) <= {f"farm-{k}" for k in range(8)} and len(answer) >= 7 for answer in answers)
    with store._database.read() as connection:
        assert len(connection.execute(select(tables.area)).all()) == 8


def test_damaged_environment_does_not_hide_others(
    store: Store, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    for name in ("good", "rotten"):
        store.environments.create(name, datum=FARM_DATUM)
    with store._database.write() as connection:
        connection.execute(tables.area.delete())
        connection.execute(update(tables.environment).values(area_stale=True))
    compute = position.compute_area

    def fail(draft: Any, entries: Any, datum: Any) -> Any:
        if not calls:
            calls.append(1)
            raise Damaged("chunk 4711 has other bytes")
        return compute(draft, entries, datum)

    calls: list[int] = []
    monkeypatch.setattr(position, "compute_area", fail)
    environment_names = names(store, FARM_DATUM.latitude, FARM_DATUM.longitude)
    assert len(environment_names) == 1
    assert len(stale(store)) == 1
    assert "chunk 4711" in caplog.text
    assert stale(store)[0] in caplog.text
    assert names(store, FARM_DATUM.latitude, FARM_DATUM.longitude) == ["good", "rotten"]


def test_environments_of_older_release_are_found_after_migration(store: Store):
    store.environments.create("old", datum=FARM_DATUM)
    save(store, "old", Replace(SITE, fence(FARM)))
    revision = ScriptDirectory.from_config(schema.config()).get_revision("0007")
    settings = schema.config()
    with store._database.engine.connect() as connection:
        connection.execution_options(write=True)
        with connection.begin():
            settings.attributes["connection"] = connection
            command.downgrade(settings, str(revision.down_revision))
    store.migrate()
    assert stale(store) == []
    assert names(store, 53.26, -0.53) == ["old"]


# --- ten thousand environments ---

MANY = 10_000


@contextmanager
def statements(store: Store) -> Iterator[list[tuple[str, Any]]]:
    """Record the executed statements on areas."""
    seen: list[tuple[str, Any]] = []

    def note(connection: Any, cursor: Any, statement: str, parameters: Any, *_: Any) -> None:
        if "JOIN environment" in statement:
            seen.append((statement, parameters))

    event.listen(store._database.engine, "before_cursor_execute", note)
    try:
        yield seen
    finally:
        event.remove(store._database.engine, "before_cursor_execute", note)


def crowd(store: Store, corners: Sequence[tuple[float, float]], size: float) -> None:
    """Insert environments with a square fence each, in their stored form."""
    store.environments.create("model", datum=DATUM)
    with store._database.write() as connection:
        columns = [column for column in tables.environment.c if column.computed is None]
        row = dict(connection.execute(select(*columns)).mappings().one())
        boxes = shapely.box(*np.array([(x, y, x + size, y + size) for x, y in corners]).T)
        wkb = to_wkb(np.asarray(boxes, object))
        connection.execute(
            insert(tables.environment),
            [{**row, "id": f"{k:032x}", "name": f"e{k}", "extent": None} for k in range(len(corners))],
        )
        connection.execute(
            insert(tables.area),
            [
                {
                    "environment_id": f"{k:032x}",
                    "piece": 0,
                    "basis": "fence",
                    "size": 1.0,
                    **dict(zip(("west", "south", "east", "north"), box.bounds, strict=True)),
                    "geometry": bytes(wkb[k]),
                }
                for k, box in enumerate(boxes)
            ],
        )


def test_position_query_of_ten_thousand_environments_uses_index(store: Store):
    random = np.random.default_rng(0)
    corners = (random.random((MANY, 2)) * np.array([300.0, 100.0]) - np.array([150.0, 50.0])).tolist()
    crowd(store, corners, 0.05)
    if not store._database.sqlite:
        with store._database.engine.connect() as connection:
            connection.exec_driver_sql("ANALYZE area")
            connection.exec_driver_sql("ANALYZE environment")
            connection.commit()
    x, y = corners[4711]
    with statements(store) as seen:
        assert "e4711" in names(store, y + 0.01, x + 0.01)
    ((statement, parameters),) = seen
    with store._database.engine.connect() as connection:
        if store._database.sqlite:
            plan = connection.exec_driver_sql(f"EXPLAIN QUERY PLAN {statement}", parameters).all()
            query_plan = " | ".join(str(line[-1]) for line in plan)
            assert "SEARCH environment USING INDEX sqlite_autoindex_environment_1" in query_plan, query_plan
            scans = [str(line[-1]) for line in plan if "SCAN" in str(line[-1])]
            assert scans
            assert all(line.startswith("SCAN box_tree VIRTUAL TABLE INDEX") for line in scans), query_plan
            steps = [0]
            driver: Any = connection.connection.driver_connection

            def count() -> int:
                steps[0] += 1
                return 0

            driver.set_progress_handler(count, 1)
            row_count = len(connection.exec_driver_sql(statement, parameters).all())
            driver.set_progress_handler(None, 0)
            assert row_count < 5, "number of polygons that shapely tests"
            assert steps[0] < MANY / 10, "instructions of SQLite's machine: not one for each environment"
        else:
            plan_ = connection.exec_driver_sql(f"EXPLAIN (ANALYZE, FORMAT JSON) {statement}", parameters).scalar_one()
            nodes = list(flat(plan_[0]["Plan"]))
            scans = {n.get("Index Name") for n in nodes}
            assert "ix_area_geometry" in scans, nodes
            assert all(n["Node Type"] != "Seq Scan" for n in nodes), nodes
            assert sum(n["Actual Rows"] + n.get("Rows Removed by Filter", 0) for n in nodes) < 20, nodes


def flat(plan: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Return the nodes of a plan."""
    yield plan
    for inner in plan.get("Plans", ()):
        yield from flat(inner)


def test_stale_areas_are_found_by_index(sqlite_store: Store):
    sqlite_store.environments.create("farm", datum=FARM_DATUM)
    with sqlite_store._database.engine.connect() as connection:
        query = select(tables.environment.c.id).where(tables.environment.c.area_stale)
        text = str(query.compile(sqlite_store._database.engine))
        plan = " ".join(str(row[-1]) for row in connection.exec_driver_sql(f"EXPLAIN QUERY PLAN {text}"))
    assert "ix_environment_area_stale" in plan
