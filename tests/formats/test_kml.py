"""KML: drawings round-trip, edits are written, and maps of other formats round-trip."""

from __future__ import annotations

import json
import math
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from lxml import etree

from app.errors import BadUpload, MissingDatum, UnreadableFile
from app.formats import FileGroup, ReadContext, WriteContext, get_format, read, write
from app.formats.kml.coordinates import parse_coordinates
from app.model.features import NO_GEOMETRY, Features, concatenate, features, from_columns, merge_documents
from app.model.frame import GROUND, Datum, Level
from app.model.grid import OccupancyGrid
from app.model.layers import MAP, NETWORK, SITE, ZONES, Layers, PartKey

SAMPLES = Path(__file__).parents[1] / "samples" / "kml"
OBJECTS = PartKey("objects", GROUND, "kml")
TOPOLOGY = PartKey("topology", GROUND, NETWORK)
DATUM = Datum(50.0, 7.0, 60.0, 33.0)


def load(data: bytes, name: str = "a.kml", **context: Any) -> tuple[Layers, ReadContext]:
    read_context = ReadContext(**context)
    return read(FileGroup(get_format("kml"), name, {name: data}), read_context), read_context


def save(layers: Layers, **context: Any) -> bytes:
    return write(get_format("kml"), layers, WriteContext(**context))["map.kml"]


def objects(layers: Layers) -> Features:
    part = layers.parts[OBJECTS]
    assert isinstance(part, Features)
    return part


def placemark(inner: str, attributes: str = "") -> bytes:
    return f'<kml xmlns="http://www.opengis.net/kml/2.2"><Placemark{attributes}>{inner}</Placemark></kml>'.encode()


def changed(layers: Layers, place: int, geometry: Any = None, **properties: Any) -> Layers:
    """Replace the geometry or properties of one object."""
    part = objects(layers)
    shapes = part.geometry.copy()
    if geometry is not None:
        shapes[place] = geometry
    new_properties = list(part.properties)
    new_properties[place] = {k: v for k, v in {**new_properties[place], **properties}.items() if v is not None}
    return Layers(
        {**layers.parts, OBJECTS: Features(part.ids, shapes, tuple(new_properties), part.local.copy(), part.document)}
    )


def equal(a: Layers, b: Layers) -> None:
    """Compare parts, ids, typed properties, anchors, documents, and coordinates to a nanometre or 1e-12 degrees."""
    assert set(a.parts) == set(b.parts)
    assert a.datum == b.datum
    for key, p in a.parts.items():
        q = b.parts[key]
        assert isinstance(p, Features)
        assert isinstance(q, Features)
        left, right = p.index(), q.index()
        assert left.keys() == right.keys()
        assert p.document == q.document
        for i, m in left.items():
            n = right[i]
            assert json.dumps(p.properties[m], sort_keys=True) == json.dumps(q.properties[n], sort_keys=True)
            assert p.local[m] == q.local[n]
            assert p.geometry[m].geom_type == q.geometry[n].geom_type
            at = [shapely.get_coordinates(g, include_z=g.has_z) for g in (p.geometry[m], q.geometry[n])]
            assert at[0].shape == at[1].shape
            assert np.allclose(*at, rtol=0, atol=1.01e-9 if p.local[m] else 1.01e-12)


# --- real drawings ----------------------------------------------------------------------------------------------------

REFUSED = {"kml/libkml/billion.kml"}
UNCOUNTABLE = {"kml/libkml/all-unknown-input.kml"}
"""Files whose LatLonBox contains words, which the independent comparison cannot read."""


@pytest.fixture(scope="session")
def real(shared: Path, facts_json: dict[str, Any]) -> dict[str, bytes]:
    files = {name: (shared / "data" / name).read_bytes() for name in facts_json if name.endswith(".kml")}
    assert len(files) >= 30
    return files


def test_real_drawing_round_trips(real, same):
    for name, data in real.items():
        if name in REFUSED | UNCOUNTABLE:
            continue
        layers, _ = load(data)
        once = save(layers)
        assert same("kml", {"a.kml": data}, {"a.kml": once}) == [], name
        again, _ = load(once)
        assert save(again) == once, name
        assert [p.get("name") for p in objects(again).properties] == [p.get("name") for p in objects(layers).properties]


def test_unknown_elements_round_trip_in_place(real):
    data = real["kml/libkml/all-unknown-input.kml"]
    layers, _ = load(data)
    once = save(layers)

    def plain(element: etree._Element) -> Any:
        texts = [(element.text or "").strip(), *((c.tail or "").strip() for c in element)]
        return element.tag, dict(element.attrib), texts, [plain(c) for c in element]

    parser = etree.XMLParser(remove_comments=True)
    assert plain(etree.fromstring(once)) == plain(etree.fromstring(data, parser))
    assert len(objects(layers)) > 20


def test_real_drawing_matches_independent_counts(real, facts_json):
    types = {
        "Point": {"Point", "Model"},
        "LineString": {"LineString", "LinearRing", "gx:Track"},
        "Polygon": {"Polygon"},
    }
    for name, data in real.items():
        facts = facts_json[name].get("facts", {})
        if name in REFUSED | UNCOUNTABLE | {"kml/libkml/old_schema_example.kml", "kml/togeojson/addresses.kml"}:
            continue
        layers, _ = load(data)
        part = objects(layers)
        drawn = [k for k, p in enumerate(part.properties) if p["kml"]["xml"].startswith("<Placemark")]
        assert len(drawn) == facts["placemarks"], name
        counted = facts["placemarks_by_geometry"]
        for ours, theirs in types.items():
            expected = sum(counted.get(t, 0) for t in theirs)
            empty = sum(part.geometry[k].is_empty for k in drawn) - counted.get("none", 0)
            geometry_count = sum(part.geometry[k].geom_type == ours for k in drawn)
            assert geometry_count in (expected, expected - empty), name
        tracks = "gx:coord" in facts["coordinate_tuples_by_parent"]  # not in the counted box
        if "bbox_lonlat" in facts and not tracks and "all-altitudemodes" not in name and "badcoords" not in name:
            shapes = [g for g, p in zip(part.geometry, part.properties, strict=True) if p["kind"] != "overlay"]
            assert np.allclose(shapely.total_bounds(shapes), facts["bbox_lonlat"], rtol=0, atol=1e-9), name


def test_repeated_names_are_stored_with_one_warning(real):
    name = "environment_template/riseholme_park_farm_strawberry_polytunnels/config/topological/tmap2_autogen.kml"
    layers, context = load(real[name])
    assert len(objects(layers)) == 627
    assert sum("have the name" in w.problem for w in context.warnings) == 1
    assert len(context.warnings) < 4


def test_irregular_coordinates_read_as_in_google_earth(real):
    layers, context = load(real["kml/libkml/badcoords.kml"])
    assert shapely.get_coordinates(objects(layers).geometry).tolist() == [
        [-55.809700, -60.700099],
        [-55.066600, -60.7630997],
        [-54.308998, -60.977600],
        [-54.300701, -61.510200],
    ]
    assert context.warnings
    layers, _ = load(real["kml/libkml/all-altitudemodes.kml"])
    ring = objects(layers).geometry[objects(layers).index()["placemark-linearring"]]
    assert shapely.get_coordinates(ring).tolist() == [[19, 37], [19, 41], [13, 41], [13, 37], [19, 37]]


def test_entity_bomb_is_refused(real):
    with pytest.raises(UnreadableFile, match="DOCTYPE"):
        load(real["kml/libkml/billion.kml"])


# --- our own samples --------------------------------------------------------------------------------------------------


@pytest.fixture
def orchard() -> Layers:
    return load((SAMPLES / "orchard.kml").read_bytes(), "orchard.kml")[0]


def test_drawing_becomes_objects(orchard):
    part = objects(orchard)
    assert list(part.ids) == [
        "gate",
        "Row",
        "Row#2",
        "Block with a pond",
        "Two trees",
        "Open ring, spaced commas",
        "Mower",
        "Barn",
        "A thought",
        "Plan",
    ]
    kinds = ["poi", "path", "path", "region", "poi", "region", "path", "poi", "note", "overlay"]
    assert [p["kind"] for p in part.properties] == kinds
    row = part.properties[1]
    assert (row["name"], row["oneway"], row["trees"], row["kml"]["data"]) == ("Row", "yes", "41", {"kind": "apple"})
    assert shapely.get_coordinates(part.geometry[0], include_z=True).tolist() == [[7.001, 50.0005, 61.5]]
    assert not part.geometry[1].has_z
    assert len(part.geometry[3].interiors) == 1
    assert part.geometry[5].exterior.is_closed
    assert part.geometry[8].is_empty
    assert not part.local.any()
    plan = part.geometry[9]
    assert shapely.get_coordinates(plan.centroid)[0] == pytest.approx([7.003, 50.0015])
    assert math.degrees(math.atan2(*_up(plan))) == pytest.approx(-12.5, abs=1e-6)


def _up(plan: Any) -> tuple[float, float]:
    """Return east and north of an overlay's left side, scaled to metres."""
    corner = shapely.get_coordinates(plan)
    east, north = corner[3] - corner[0]
    return float(east) * math.cos(math.radians(50.0015)), float(north)


@pytest.mark.parametrize("name", ["orchard.kml", "prefixed.kml"])
def test_samples_round_trip(name, same):
    data = (SAMPLES / name).read_bytes()
    layers, _ = load(data)
    once = save(layers)
    assert same("kml", {"a.kml": data}, {"a.kml": once}) == []
    assert once == save(load(once, "a.kml")[0])
    assert once == save(layers)


def test_prefixed_kml_20_file_without_names_is_read():
    layers, _ = load((SAMPLES / "prefixed.kml").read_bytes())
    part = objects(layers)
    assert list(part.ids) == ["Well", "same", "same#2"]
    assert shapely.get_coordinates(part.geometry[2]).tolist() == [[7, 50], [7.1, 50.1]]
    assert b"<k:name>Deep well</k:name>" in save(changed(layers, 0, name="Deep well"))
    assert b"<k:name>New</k:name>" in save(changed(layers, 1, name="New"))


EDITS = {
    "point": (0, shapely.Point(7.5, 50.5), "7.5,50.5"),
    "line, more vertices": (1, shapely.LineString([(7, 50), (7.1, 50), (7.2, 50), (7.3, 50)]), "7.2,50.0 7.3,50.0"),
    "line to point": (2, shapely.Point(7.5, 50.5), "<Point><coordinates>7.5,50.5</coordinates></Point>"),
    "area without its hole": (3, shapely.box(7, 50, 7.5, 50.5), "7.5,50.0"),
    "two points to three": (4, shapely.MultiPoint([(7, 50), (7.1, 50), (7.2, 50)]), "7.2,50.0"),
    "odd ring": (5, shapely.box(7, 50, 7.5, 50.5), "7.5,50.5"),
    "track to line": (6, shapely.LineString([(7, 50), (7.1, 50.1)]), "7.1,50.1"),
    "model": (7, shapely.Point(7.5, 50.5), "<longitude>7.5</longitude><latitude>50.5</latitude>"),
    "a note gets a place": (8, shapely.Point(7.5, 50.5), "7.5,50.5"),
    "overlay, other corners": (9, shapely.box(7, 50, 7.5, 50.5), "LatLonQuad"),
    "overlay, other shape": (9, shapely.Polygon([(7, 50), (8, 50), (7.5, 50.5)]), "<east>8.0</east>"),
    "nowhere any more": (3, NO_GEOMETRY, None),
}


@pytest.mark.parametrize("edit", EDITS)
def test_edited_geometry_replaces_stored_one(orchard, edit):
    place, shape, text = EDITS[edit]
    data = save(changed(orchard, place, shape))
    if text:
        assert text in data.decode()
    again = objects(load(data, "orchard.kml")[0])
    if edit == "overlay, other shape":
        assert again.geometry[9].equals(shapely.box(7, 50, 8, 50.5))
    elif shape.is_empty:
        assert again.geometry[place].is_empty
    else:
        assert again.geometry[place].equals_exact(shape.normalize(), 1e-9) or again.geometry[place].equals(shape)
    before = objects(orchard)
    for k in set(range(len(before))) - {place}:
        assert again.geometry[k].equals_exact(before.geometry[k], 1e-11)
    for word in ("Orchard &amp; yard", "Main", "row_normal", "2024-05-01T08:00:00Z")[: 3 if place == 6 else 4]:
        assert word in data.decode()


def test_edited_names_and_values_replace_stored_ones(orchard):
    layers = changed(orchard, 1, name="Q <1> & 'co'", oneway="no", trees=12)
    again = objects(load(save(layers))[0]).properties[1]
    assert (again["name"], again["oneway"], again["trees"]) == ("Q <1> & 'co'", "no", "12")
    assert again["kml"]["data"] == {"kind": "apple"}
    nameless = objects(load(save(changed(orchard, 1, name=None)))[0]).properties[1]
    assert "name" not in nameless


def test_drawing_reflects_deleted_and_added_objects(orchard, same):
    part = objects(orchard)
    new = features([("shed", shapely.Point(7.2, 50.2), {"kind": "poi", "name": "Shed", "roof": "tin"})], "wgs84")
    both = concatenate([part.select([0, 3, 9]), new])
    again = objects(load(save(Layers({OBJECTS: both})), "orchard.kml")[0])
    assert sorted(again.ids) == ["Block with a pond", "Plan", "gate", "shed"]
    assert again.properties[again.index()["shed"]] == {"kind": "poi", "name": "Shed", "roof": "tin"}
    assert again.properties[0]["kml"]["place"] == 0


def test_written_drawing_is_independent_of_storage_order(orchard):
    part = objects(orchard)
    shuffled = part.select(np.random.default_rng(1).permutation(len(part)))
    assert save(Layers({OBJECTS: shuffled})) == save(orchard)


def test_objects_without_document_are_written(orchard):
    part = objects(orchard).with_document({})
    again = objects(load(save(Layers({OBJECTS: part})))[0])
    assert sorted(again.ids) == sorted(part.ids)
    for k, i in enumerate(part.ids):
        assert again.geometry[again.index()[i]].equals_exact(part.geometry[k], 1e-11)


def styled(colour: str, name: str) -> bytes:
    return (
        f'<kml xmlns="http://www.opengis.net/kml/2.2"><Document><Style id="a"><LineStyle><color>{colour}</color>'
        f'</LineStyle></Style><StyleMap id="m"><Pair><key>normal</key><styleUrl>#a</styleUrl></Pair></StyleMap>'
        f"<Folder><name>F</name><Placemark><name>{name}</name><styleUrl>#m</styleUrl>"
        "<Point><coordinates>7,50</coordinates></Point></Placemark></Folder></Document></kml>"
    ).encode()


def test_drawings_in_one_part_keep_their_styles(same):
    files = {"one.kml": styled("ff0000ff", "One"), "two.kml": styled("ff00ff00", "Two")}
    parts = [objects(load(data, name)[0]) for name, data in files.items()]
    together = concatenate(parts)
    data = save(Layers({OBJECTS: together}))
    for name, original in files.items():
        lost = same("kml", {name: original}, {"b.kml": data})
        assert len(lost) == 1
        assert "0, now 1" in lost[0]  # the other file's placemark, and nothing else
    again = objects(load(data)[0])
    assert set(again.document["kml"]["documents"]) == set(together.document["kml"]["documents"])
    assert len(again.document["kml"]["documents"]) == 2
    assert save(Layers({OBJECTS: again})) == data
    for part, (name, original) in zip(parts, files.items(), strict=True):
        (key,) = part.document["kml"]["documents"]
        indices = [k for k, p in enumerate(again.properties) if p["kml"]["document"] == key]
        alone = {"kml": {"documents": {key: again.document["kml"]["documents"][key]}}}
        assert (
            same(
                "kml", {name: original}, {"b.kml": save(Layers({OBJECTS: again.select(indices).with_document(alone)}))}
            )
            == []
        )


def test_numeric_ids_and_levels_round_trip_as_texts():
    part = features([("12", shapely.Point(1, 2), {"kind": "bench"}), ("1e3", shapely.Point(3, 4), {})], "local")
    key = PartKey("objects", "2", "generated")
    again, _ = load(save(Layers({key: part}, Datum(10.0, 20.0), (Level("2", 3.0),))))
    assert again.parts[key].ids == part.ids
    assert again.levels == (Level("2", 3.0),)


@pytest.mark.parametrize("ring", ["7,50 8,51 7,50", "7,50,1 8,51,2 7,50,1", "7,50 8,51 8,51 7,50", "7,50 7,50", "7,50"])
def test_edge_drawn_as_area_round_trips(ring, same):
    area = f"<outerBoundaryIs><LinearRing><coordinates>{ring}</coordinates></LinearRing></outerBoundaryIs>"
    data = placemark(f"<Polygon>{area}</Polygon>")
    layers, _ = load(data)
    assert objects(layers).geometry[0].geom_type == "Polygon"
    assert objects(layers).properties[0]["kind"] == "region"
    assert same("kml", {"a.kml": data}, {"b.kml": save(layers)}) == []
    assert same("kml", {"a.kml": data}, {"b.kml": save(load(save(layers))[0])}) == []


def test_schema_placemarks_are_stored_with_warning(real, same):
    data = real["kml/libkml/old_schema_example.kml"]
    layers, context = load(data)
    assert "S_521_525_SSSSS" in context.warnings[0].problem
    assert save(layers).count(b"foo ") == 2


def test_source_properties_are_skipped_when_not_requested():
    data = (SAMPLES / "orchard.kml").read_bytes()
    complete, short = objects(load(data)[0]), objects(load(data, keep_source_properties=False)[0])
    assert short.ids == complete.ids
    assert all(a.equals(b) for a, b in zip(short.geometry, complete.geometry, strict=True))
    assert [{**p, "kml": 0} for p in short.properties] == [{**p, "kml": 0} for p in complete.properties]
    assert short.properties[1]["kml"]["data"] == {"kind": "apple"}
    assert short.document == {}
    assert sorted(objects(load(save(Layers({OBJECTS: short})))[0]).ids) == sorted(complete.ids)


def test_documents_merge_by_key_at_every_depth():
    a = {"kml": {"documents": {"a": {"xml": "1"}}, "x": 1}, "only": [1]}
    b = {"kml": {"documents": {"b": {"xml": "2"}}, "x": {"y": 2}}}
    assert merge_documents(a, b) == {
        "kml": {"documents": {"a": {"xml": "1"}, "b": {"xml": "2"}}, "x": {"y": 2}},
        "only": [1],
    }
    assert a == {"kml": {"documents": {"a": {"xml": "1"}}, "x": 1}, "only": [1]}


@pytest.mark.parametrize("depth", [101, 250])
def test_deep_folders_are_read(depth, same):
    data = b"<kml>" + b"<Folder>" * depth + b"<Placemark/>" + b"</Folder>" * depth + b"</kml>"
    layers, _ = load(data)
    assert len(objects(layers)) == 1
    assert same("kml", {"a.kml": data}, {"b.kml": save(layers)}) == []


# --- our own words ----------------------------------------------------------------------------------------------------


def network(n: int = 12) -> Features:
    """Build nodes on a circle of 50 m with edges in both directions between neighbours and all robot properties."""
    angle = np.arange(n) * 2 * np.pi / n
    xy = np.round(np.stack([50 * np.cos(angle), 50 * np.sin(angle)], axis=1), 9)
    rows: list[tuple[str, Any, dict[str, Any]]] = []
    for k in range(n):
        verts = [{"x": 0.1 * v, "y": -0.3} for v in range(4)]
        source_properties = {
            "meta": {"map": "m & m", "pointset": "<p>"},
            "verts": verts,
            "restrictions_runtime": "'True'",
        }
        turn = [0.0, 0.0, math.sin(angle[k] / 2), math.cos(angle[k] / 2)]
        rows.append(
            (
                f"P{k}",
                shapely.Point(xy[k]),
                {"kind": "node", "name": f"P{k}", "orientation": turn, "tmap2": source_properties},
            )
        )
    for k in range(n):
        for m in ((k + 1) % n, k - 1 if k else n - 1):
            source_properties = {
                "config": [],
                "fluid_navigation": True,
                "goal": {"target_pose": {"pose": "$node.pose"}},
                "n": 1,
                "r": 1.0,
            }
            edge = {
                "kind": "edge",
                "source": f"P{k}",
                "target": f"P{m}",
                "action": "NavigateToPose",
                "tmap2": source_properties,
            }
            rows.append((f"P{k}_P{m}", shapely.LineString(xy[[k, m]]), edge))
    return features(rows, "local", {"tmap2": {"name": "ring", "metric_map": "m"}})


def test_network_round_trips():
    layers = Layers({TOPOLOGY: network()}, DATUM)
    data = save(layers)
    again, context = load(data)
    equal(layers, again)
    assert context.warnings == []
    assert save(again) == data
    root = etree.fromstring(data)
    assert len(root.findall(".//{*}Placemark")) == 12 + 24 + 1
    assert len(root.findall(".//{*}LineString")) == 24


def test_vector_layers_round_trip():
    fence = shapely.box(6.999, 49.999, 7.001, 50.001)
    datum = {"kind": "fence", "name": "farm", "datum": DATUM.as_dict()}
    rows: list[tuple[str, Any, dict[str, Any]]] = [
        (
            "w1",
            shapely.MultiPolygon([shapely.box(7, 50, 7.1, 50.1)]),
            {"kind": "building", "osm": {"tags": {"a": "1"}}},
        ),
        ("n1", shapely.Point(7, 50, 12.5), {"kind": "poi", "layer": "x", "id": 7, "more": [1], "level": None}),
        ("r1", shapely.GeometryCollection([shapely.Point(7, 50)]), {"kind": "site", "name": " padded "}),
        ("r2", NO_GEOMETRY, {"kind": "relation", "name": "", "bad\nkey": "\x00\x0b"}),
    ]
    hole = shapely.Polygon([(0, 0), (9, 0), (9, 9), (0, 9)], [[(1, 1), (2, 1), (2, 2)]])
    layers = Layers(
        {
            TOPOLOGY: network(),
            PartKey("topology", "upper", NETWORK): network(3),
            PartKey("location", GROUND, SITE): features([("fence", fence, datum)], "wgs84", {"datum": {"a": [1.5]}}),
            PartKey("zones", GROUND, ZONES): features([("z", hole, {"kind": "speed", "value": 0.5})], "local"),
            PartKey("objects", GROUND, "osm"): features(rows, "wgs84", {"osm": {"version": "0.6"}}),
            PartKey("objects", GROUND, "gazebo"): features(
                [("m", shapely.MultiPoint([(1, 2), (3, 4)]), {"kind": "model"})], "local"
            ),
        },
        DATUM,
        (Level(), Level("upper", 3.5)),
    )
    data = save(layers, attribution=("© somebody & co",))
    again, _ = load(data)
    parts = {
        k: p.with_document({**p.document, "attribution": ["© somebody & co"]})
        for k, p in layers.parts.items()
        if isinstance(p, Features)
    }
    equal(Layers({**layers.parts, **parts}, layers.datum, layers.levels), again)
    assert again.elevation("upper") == 3.5
    assert "© somebody &amp; co" in data.decode()
    assert save(again, attribution=("© somebody & co",)) == data


def test_drawing_and_network_share_file(orchard, same):
    layers = Layers({**orchard.parts, TOPOLOGY: network()}, DATUM)
    data = save(layers)
    again, _ = load(data, "orchard.kml")
    equal(layers, again)
    assert same("kml", {"a.kml": (SAMPLES / "orchard.kml").read_bytes()}, {"b.kml": save(Layers(orchard.parts))}) == []
    prefixed = load((SAMPLES / "prefixed.kml").read_bytes(), "prefixed.kml")[0]
    mixed = Layers({**prefixed.parts, TOPOLOGY: network()}, DATUM)
    again, _ = load(save(mixed), "prefixed.kml")
    equal(Layers({TOPOLOGY: network()}, DATUM), Layers({TOPOLOGY: again.parts[TOPOLOGY]}, again.datum))
    assert list(objects(again).ids) == ["Well", "same", "same#2"]


def test_datum_round_trips():
    layers = Layers({}, Datum(-33.456789012345678, 151.2, -5.25, 359.5))
    assert load(save(layers))[0].datum == layers.datum


def test_metres_without_datum_raise_missing_datum():
    with pytest.raises(MissingDatum):
        save(Layers({TOPOLOGY: network()}))


def test_moved_placemark_moves_local_item():
    layers = Layers({TOPOLOGY: network()}, DATUM)
    data = save(layers).decode()
    assert layers.frame is not None
    lon, lat = layers.frame.to_wgs84(np.array([[50.0, 0.0]]))[0]
    moved_lon, moved_lat = layers.frame.to_wgs84(np.array([[60.0, 5.0]]))[0]
    old = f"<Point><coordinates>{round(float(lon), 12)!r},{round(float(lat), 12)!r}</coordinates>"
    assert data.count(old) == 1
    new = data.replace(old, f"<Point><coordinates>{float(moved_lon)!r},{float(moved_lat)!r}</coordinates>")
    again, context = load(new.encode())
    part = again.parts[TOPOLOGY]
    assert isinstance(part, Features)
    assert shapely.get_coordinates(part.geometry[part.index()["P0"]])[0] == pytest.approx([60.0, 5.0], abs=1e-6)
    assert shapely.get_coordinates(part.geometry[part.index()["P1"]]) == pytest.approx(
        shapely.get_coordinates(network().geometry[1]), abs=1e-9
    )
    assert any("moved" in w.problem for w in context.warnings)


def test_network_derived_from_drawing_is_not_written_twice(orchard, same):
    drawn_network = features([("a", shapely.Point(7.0011, 50.0006), {"kind": "node", "drawn_from": "Row"})], "wgs84")
    other = features([("b", shapely.Point(7.0011, 50.0006), {"kind": "node", "drawn_from": "gone"})], "wgs84")
    data = save(Layers({**orchard.parts, TOPOLOGY: drawn_network}))
    assert same("kml", {"a.kml": (SAMPLES / "orchard.kml").read_bytes()}, {"b.kml": data}) == []
    layers, _ = load(save(Layers({**orchard.parts, TOPOLOGY: concatenate([drawn_network, other])})))
    part = layers.parts[TOPOLOGY]
    assert isinstance(part, Features)
    assert part.ids == ("b",)


def test_grid_is_written_as_overlay_with_position():
    cells = np.zeros((40, 100), np.uint8)
    grid = OccupancyGrid(cells, 0.5, (-10.0, 5.0, math.radians(25.0)))
    layers = Layers({PartKey("occupancy", GROUND, MAP): grid}, DATUM)
    context = WriteContext()
    root = etree.fromstring(write(get_format("kml"), layers, context)["map.kml"])
    assert context.dropped[0].subject == "occupancy"
    overlay = root.find(".//{*}GroundOverlay")
    assert overlay.findtext(".//{*}href") == "map.png"
    turned = float(overlay.findtext("{*}LatLonBox/{*}rotation"))
    assert turned == pytest.approx(25.0 - 33.0, abs=1e-3), "against north at its own middle, not at the datum"
    quad = overlay.findtext("{*}LatLonQuad/{*}coordinates")
    assert layers.frame is not None
    corners = np.array([list(map(float, c.split(","))) for c in quad.split()])
    assert np.allclose(layers.frame.to_local(corners), grid.corners(), atol=1e-6)
    # The box turned by its rotation is the grid: within a millimetre at this size.
    sides = {s: float(overlay.findtext(f"{{*}}LatLonBox/{{*}}{s}")) for s in ("north", "south", "east", "west")}
    middle = layers.frame.to_local(
        np.array([[(sides["east"] + sides["west"]) / 2, (sides["north"] + sides["south"]) / 2]])
    )
    assert np.allclose(middle, grid.corners().mean(axis=0), atol=1e-3)
    again, read_context = load(save(layers))
    assert not again.parts_of("occupancy")
    assert any("KMZ" in w.problem for w in read_context.warnings)
    assert again.datum == DATUM


TEXTS = st.text(
    st.one_of(st.sampled_from("&<>\"' \t\r\n;#%?{}[]-0.é本\x7f\x85\ufeff\u202e"), st.characters(codec="utf-8")),
    max_size=12,
)
VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**63 - 1)
    | st.floats(allow_nan=False, allow_infinity=False)
    | TEXTS,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(TEXTS, inner, max_size=3),
    max_leaves=6,
)


@given(name=TEXTS, properties=st.dictionaries(TEXTS, VALUES, max_size=5))
def test_any_property_round_trips(name, properties):
    node_properties = {"kind": "node", **properties, "name": name}
    part = features([("p", shapely.Point(1.0, 2.0), node_properties)], "local", {"x": {"y": name}})
    layers = Layers({TOPOLOGY: part}, DATUM)
    equal(layers, load(save(layers))[0])


@given(name=TEXTS)
def test_any_placemark_name_round_trips(name):
    layers, _ = load(placemark("<name>old</name><Point><coordinates>7,50</coordinates></Point>"))
    again = objects(load(save(changed(layers, 0, name=name)))[0])
    shown = "".join(c if c in "\t\n\r" or (c >= " " and c not in "\ufffe\uffff") else "\ufffd" for c in name).strip()
    assert again.properties[0].get("name", "") == shown
    assert all(i.isprintable() for i in again.ids)


# --- coordinates ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "points"),
    [
        ("7,50", [[7, 50, 0]]),
        ("\n\t7,50,3 \t 8,51\r\n", [[7, 50, 3], [8, 51, 0]]),
        ("-7.5e0,+50.25,1E1", [[-7.5, 50.25, 10]]),
        ("", []),
        ("  \n", []),
        *(
            (odd, None)
            for odd in ("7, 50", "7,50,", ",7,50", "7,,50", "7", "1,2,3,4", "a,b", "7;50", "1_0,2", "nan,1", "７,50")
        ),
        *((odd, None) for odd in ("1e5e5,2", "--1,2", "1-2,3", "7\xa050", "+,1", "1,.")),
    ],
)
def test_coordinate_text_is_plain_or_irregular(text, points):
    around = ["1,2,3", text, "4,5 6,7"]
    parsed = parse_coordinates(around)
    assert parsed.odd.tolist() == [False, points is None, False]
    parts = [parsed.points[a:b].tolist() for a, b in zip(parsed.start, parsed.start[1:], strict=False)]
    assert parts == [[[1, 2, 3]], points or [], [[4, 5, 0], [6, 7, 0]]]


@given(st.lists(st.lists(st.tuples(st.floats(-180, 180), st.floats(-90, 90)), max_size=5), max_size=5))
def test_coordinates_round_trip_exactly(lists):
    texts = [" ".join(f"{x!r},{y!r}" for x, y in points) for points in lists]
    parsed = parse_coordinates(texts) if texts else None
    for k, points in enumerate(lists):
        assert parsed is not None
        assert [tuple(p[:2]) for p in parsed.points[parsed.start[k] : parsed.start[k + 1]].tolist()] == points


# --- bad input --------------------------------------------------------------------------------------------------------

DOT = "<Point><coordinates>{}</coordinates></Point>"
HOSTILE = {
    "empty": b"",
    "no xml": b"kml",
    "cut": b"<kml><Document>",
    "html": b"<html><body/></html>",
    "doctype": b'<!DOCTYPE kml [<!ENTITY a SYSTEM "file:///etc/passwd">]><kml>&a;</kml>',
    "doctype behind a comment": b"<!-- \n --><!DOCTYPE kml []><kml/>",
    "doctype in utf-16": '<?xml version="1.0" encoding="UTF-16"?><!DOCTYPE kml [<!ENTITY a "b">]><kml/>'.encode(
        "utf-16"
    ),
    "unknown entity": b"<kml>&unknown;</kml>",
    "too deep": b"<kml>" + b"<Folder>" * 300 + b"</Folder>" * 300 + b"</kml>",
    "long attribute": placemark("", f' id="{"x" * 70_000}"'),
    "nan": placemark(DOT.format("nan,1")),
    "inf": placemark(DOT.format("1e999,1")),
    "longitude": placemark(DOT.format("180.1,1")),
    "latitude": placemark(DOT.format("1,-90.1")),
    "altitude": placemark(DOT.format("1,1,1e300")),
    "words": placemark(DOT.format("north,west")),
    "huge number": placemark(DOT.format("1" * 5000 + ",1")),
    "track": placemark("<Track><coord>1 x 2</coord></Track>"),
    "model": placemark("<Model><Location><longitude>999</longitude><latitude>0</latitude></Location></Model>"),
    "overlay": b"<kml><GroundOverlay><LatLonBox><north>1</north><south>0</south><east>a</east><west>0</west>"
    b"</LatLonBox></GroundOverlay></kml>",
    "overlay off earth": b"<kml><GroundOverlay><LatLonBox><north>91</north><south>0</south><east>1</east><west>0</west>"
    b"</LatLonBox></GroundOverlay></kml>",
    "our marks": placemark("<description>\x91\x9c\x82\x86</description>"),
    "local": placemark(
        '<ExtendedData><Data name="layer"><value>topology</value></Data>'
        '<Data name="local"><value>[[],[]]</value></Data></ExtendedData>' + DOT.format("1,1")
    ),
    "datum": placemark(
        '<ExtendedData><Data name="layer"><value>location</value></Data><Data name="kind"><value>datum</value></Data>'
        '<Data name="latitude"><value>89</value></Data><Data name="longitude"><value>0</value></Data></ExtendedData>'
    ),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_bad_files_are_refused(case):
    with pytest.raises(BadUpload) as caught:
        load(HOSTILE[case])
    assert caught.value.problems


def test_bad_coordinate_is_reported_with_line():
    data = (
        b"<kml><Document>\n<Placemark>\n<Point>\n<coordinates>200,1</coordinates></Point></Placemark></Document></kml>"
    )
    with pytest.raises(UnreadableFile) as caught:
        load(data)
    assert caught.value.problems[0].line in (3, 4)
    assert caught.value.problems[0].file == "a.kml"


def test_doctype_in_description_is_text(same):
    data = placemark("<description><![CDATA[<!DOCTYPE html><html/>]]></description>")
    assert same("kml", {"a.kml": data}, {"b.kml": save(load(data)[0])}) == []


@pytest.mark.parametrize("name", ["a\x85b", "\u202eevil", " ", "\u200b", "x" * 3000])
def test_unprintable_names_become_printable_ids(name):
    layers, _ = load(placemark(f"<name>{name}</name>"))
    assert objects(layers).ids[0].isprintable()
    assert objects(layers).properties[0].get("name", "") == name.strip()


def test_truncated_files_are_refused_or_read():
    data = (SAMPLES / "orchard.kml").read_bytes()
    for length in range(0, len(data.rstrip()) - 1, 7):
        with pytest.raises(BadUpload):
            load(data[:length])


@given(st.data())
def test_mutated_files_are_refused_or_read(data):
    body = bytearray((SAMPLES / "orchard.kml").read_bytes())
    for _ in range(data.draw(st.integers(1, 5))):
        body[data.draw(st.integers(0, len(body) - 1))] = data.draw(st.integers(0, 255))
    try:
        layers, _ = load(bytes(body))
    except BadUpload:
        return
    again, _ = load(save(layers))
    assert set(again.parts) == set(layers.parts)


# --- detection, other readers -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "data", "answer"),
    [
        ("a.kml", b"whatever", True),
        ("a.xml", b'<?xml version="1.0"?><kml xmlns="http://www.opengis.net/kml/2.2"/>', True),
        ("noname", "<kml/>".encode("utf-16"), True),
        ("a.kml", b"PK\x03\x04", False),
        ("a.osm", b"<osm version='0.6'/>", False),
        ("a.txt", b"see http://earth.google.com/kml/2.2", False),
    ],
)
def test_detect_accepts_kml_only(name, data, answer):
    assert get_format("kml").detect(name, data) is answer


def test_written_kml_is_read_by_ogr(orchard, tmp_path):
    tool = shutil.which("ogrinfo")
    if tool is None:
        if os.environ.get("CI"):
            pytest.fail("ogrinfo is absent")
        pytest.skip("ogrinfo is absent")
    layers = Layers({**orchard.parts, TOPOLOGY: network()}, DATUM)
    for name, content in (("both.kml", layers), ("alone.kml", Layers({TOPOLOGY: network()}, DATUM))):
        (tmp_path / name).write_bytes(save(content))
        command = [tool, "-ro", "-al", "-so", str(tmp_path / name)]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        assert "ERROR" not in done.stdout + done.stderr
        counts = [int(line.split(":")[1]) for line in done.stdout.splitlines() if line.startswith("Feature Count")]
        assert 36 in counts, done.stdout


def test_tmap2_round_trips_through_kml(shared, same):
    folder = shared / "data" / "environment_template"
    files = [p for p in sorted(folder.rglob("*.tmap2.yaml")) if p.stat().st_size]
    assert files
    tmap2 = get_format("tmap2")
    for path in files:
        data = {path.name: path.read_bytes()}
        layers = read(FileGroup(tmap2, path.name, data), ReadContext())
        placed = Layers(layers.parts, DATUM, layers.levels)
        again, _ = load(save(placed))
        equal(placed, again)
        direct, over_kml = (write(tmap2, part, WriteContext()) for part in (placed, again))
        assert over_kml == direct, path.name
        if "topology" in layers.layers:
            assert same("tmap2", data, over_kml) == [], path.name


def test_many_items_are_written_in_time():
    """Ten times the items take about ten times the time (a generous limit): no quadratic step."""
    import time

    def seconds(n: int) -> float:
        xy = np.stack([np.linspace(7, 7.1, n), np.linspace(50, 50.1, n)], axis=1)
        part = from_columns([f"n{k}" for k in range(n)], shapely.points(xy), [{"kind": "node"}] * n, "wgs84")
        start = time.process_time()
        load(save(Layers({TOPOLOGY: part})))
        return time.process_time() - start

    assert seconds(10_000) < 40 * max(seconds(1_000), 0.02)


def test_unknown_elements_are_reported_with_count() -> None:
    placemark = (
        "<Placemark><nam>a</nam><gx:drawOrder>1</gx:drawOrder><x:own/><ExtendedData><free/></ExtendedData>"
        "<description><![CDATA[<b>x</b>]]></description><Point><coordinates>1,2</coordinates></Point></Placemark>"
    )
    spaces = (
        'xmlns="http://www.opengis.net/kml/2.2" xmlns:gx="http://www.google.com/kml/ext/2.2" '
        'xmlns:x="http://example.com/x"'
    )
    text = f"<kml {spaces}><Document>\n{placemark}\n{placemark}<gx:zzz/><!-- <yyy/> --></Document></kml>"
    for data in (text.encode(), ('<?xml version="1.0" encoding="UTF-16"?>' + text).encode("utf-16")):
        _, context = load(data)
        (warning,) = context.warnings
        assert warning.problem == (
            "unknown elements: <nam> (did you mean name?) (2 times), <zzz>; they are stored without effect"
        )
        assert warning.line == 2
