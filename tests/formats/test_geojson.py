"""GeoJSON: round trips, metres are never degrees, all layers, hostile bytes."""

from __future__ import annotations

import json
import os
import random
import shutil
import subprocess
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import orjson
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from app import formats
from app.errors import BadUpload, TooLarge, UnreadableFile
from app.formats import FileGroup, ReadContext, WriteContext, geojson
from app.formats.geojson import words
from app.limits import Limits
from app.model.features import Features, features
from app.model.frame import Datum, Level
from app.model.geodesy import local_frame
from app.model.layers import NETWORK, SITE, ZONES, Layers, PartKey

SAMPLE = Path(__file__).parents[1] / "samples" / "geojson" / "field.geojson"
HOME = PartKey("objects", "ground", "geojson")
TOPOLOGY = PartKey("topology", "ground", NETWORK)
DATUM = Datum(53.25, -0.5, heading=30.0)


def read(data: bytes | str | dict[str, Any], context: ReadContext | None = None, **options: Any) -> Layers:
    if isinstance(data, dict):
        data = json.dumps(data)
    raw = data.encode() if isinstance(data, str) else data
    fmt = formats.get_format("geojson")
    return formats.read(FileGroup(fmt, "a.geojson", {"a.geojson": raw}), context or ReadContext(**options))


def write(layers: Layers, context: WriteContext | None = None) -> bytes:
    (data,) = formats.write(formats.get_format("geojson"), layers, context or WriteContext()).values()
    return data


def part(layers: Layers, key: PartKey) -> Features:
    content = layers.parts[key]
    assert isinstance(content, Features)
    return content


def feature(geometry: Any, properties: Any = None, **members: Any) -> dict[str, Any]:
    return {"type": "Feature", "geometry": geometry, "properties": properties, **members}


def collection(*rows: Any, **members: Any) -> dict[str, Any]:
    return {"type": "FeatureCollection", "features": list(rows), **members}


def point(*at: float) -> dict[str, Any]:
    return {"type": "Point", "coordinates": list(at)}


def same_features(a: Features, b: Features, metres: float = 0.0) -> None:
    assert a.ids == b.ids
    assert a.properties == b.properties
    assert a.local.tolist() == b.local.tolist()
    assert a.document == b.document
    for p, q in zip(a.geometry, b.geometry, strict=True):
        assert shapely.equals_identical(p, q) or shapely.equals_exact(p, q, metres)


# --- what comes in goes out --------------------------------------------------------------------------------------


@pytest.mark.parametrize("datum", [None, DATUM])
def test_collection_round_trips(datum: Datum | None) -> None:
    served = orjson.loads(write(Layers(read(SAMPLE.read_bytes()).parts, datum)))
    original = orjson.loads(SAMPLE.read_bytes())
    fleet_map = served.pop("fleet_map", None)
    assert served == original
    assert (fleet_map is None) == (datum is None)
    assert geojson.detect("x", SAMPLE.read_bytes())


def test_sample_objects_match_expected() -> None:
    context = ReadContext()
    objects = part(read(SAMPLE.read_bytes(), context), HOME)
    assert objects.ids == ("a", "7", "7#2", "Barn", "feature/4", "Zoë", "flat", "empty")
    assert [p["kind"] for p in objects.properties] == [
        *("path", "region", "poi", "barn", "note", "region", "path", "note"),
    ]
    assert objects.properties[0]["tags"] == {"b": [1, None, 2.5]}
    assert objects.geometry[2].z == 31.5
    assert not objects.geometry[6].has_z
    assert objects.geometry[3].is_valid, "an open ring is closed"
    assert objects.document["attribution"] == ["CC0-1.0"]
    assert any("duplicate ids" in p.problem for p in context.warnings)
    assert not objects.local.any()


@pytest.mark.parametrize(
    "top",
    [
        feature(point(1, 2), {"name": "x"}, id=5, extra={"a": 1}),
        feature(None, None),
        point(1, 2),
        {"type": "GeometryCollection", "geometries": []},
        {"type": "Polygon", "coordinates": [[[0, 0], [1, 0], [1, 1], [0, 0]]], "bbox": [0, 0, 1, 1]},
        collection(),
        collection(coordRefSys="http://www.opengis.net/def/crs/OGC/0/CRS84"),
        collection(feature(point(1, 2), {}, id=1.5), feature(point(1, 2), {}, id="1.5"), links=[{"href": "x"}]),
        collection(feature(point(1, 2, 3), {"kind": None, "name": 4, "osm": 5})),
    ],
)
def test_every_root_type_round_trips(top: dict[str, Any]) -> None:
    assert orjson.loads(write(read(top))) == json.loads(json.dumps(top))
    assert geojson.detect("x", json.dumps(top).encode())


def test_single_feature_round_trips_with_datum() -> None:
    layers = Layers(read(feature(point(1, 2), {"name": "x"})).parts, DATUM)
    served = orjson.loads(write(layers))
    assert served["type"] == "Feature"
    assert read(write(layers)).datum == DATUM
    assert write(read(write(layers))) == write(layers)
    assert {k: v for k, v in served.items() if k != "fleet_map"} == feature(point(1, 2), {"name": "x"})


def test_edits_are_written_and_other_features_unchanged() -> None:
    layers = read(SAMPLE.read_bytes())
    objects = part(layers, HOME)
    rows = [(f.id, f.geometry, f.properties) for f in objects if f.id != "a"]
    rows[2] = ("Barn", shapely.Point(7.5, 50.5), {**rows[2][2], "kind": "shed", "roof": "red"})
    rows.append(("new", shapely.Point(7, 50), {"kind": "tree"}))
    served = orjson.loads(write(Layers({HOME: features(rows, "wgs84", objects.document)})))
    assert [f.get("id") for f in served["features"]] == [7, 7, None, None, None, "flat", "empty", "new"]
    barn = served["features"][2]
    assert barn["geometry"] == point(7.5, 50.5)
    assert barn["properties"] == {"kind": "shed", "name": "Barn", "roof": "red"}
    assert barn["title"] == "seen from above"
    assert served["features"][-1]["properties"] == {"kind": "tree"}


numbers = st.floats(-80, 80, allow_nan=False).map(lambda v: round(v, 12) + 0.0)
positions = st.tuples(numbers, numbers).map(list)
values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**63 - 1)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(st.characters(exclude_categories=("Cs",)), max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text("abkindme", max_size=5), inner, max_size=3),
    max_leaves=6,
)
shapes = st.one_of(
    st.none(),
    positions.map(lambda p: {"type": "Point", "coordinates": p}),
    st.lists(positions, min_size=2, max_size=4).map(lambda p: {"type": "LineString", "coordinates": p}),
    st.lists(positions, min_size=1, max_size=4).map(lambda p: {"type": "MultiPoint", "coordinates": p}),
    st.lists(positions, min_size=3, max_size=5).map(lambda p: {"type": "Polygon", "coordinates": [[*p, p[0]]]}),
)
rows = st.builds(
    lambda g, p, i: feature(g, p, **({} if i is None else {"id": i})),
    shapes,
    st.none() | st.dictionaries(st.sampled_from(["kind", "name", "a", "layer", "more", "geojson", "osm"]), values),
    st.none() | st.integers(-5, 5) | st.text("ab#2", max_size=3),
)


@given(st.lists(rows, max_size=5))
def test_any_collection_round_trips(features_: list[dict[str, Any]]) -> None:
    top = orjson.loads(orjson.dumps(collection(*features_)))
    assert orjson.loads(write(read(orjson.dumps(top)))) == top


# --- our own layers ----------------------------------------------------------------------------------------------


def everything(anchor: Any = "local") -> Layers:
    def at(x: float, y: float, *z: float) -> tuple[float, ...]:
        return (x, y, *z) if anchor == "local" else (x / 1000, y / 1000, *z)

    nodes = {
        "WayPoint1": {"name": "WayPoint1", "orientation": [0, 0, 0.5, 0.8660254], "tmap2": {"verts": [{"x": 1}]}},
        "B & <ö>": {"level": "mine", "part": [1]},
    }
    edge = {"source": "WayPoint1", "target": "B & <ö>", "action": "move_base", "tmap2": {"config": [], "goal": None}}
    network = [
        ("WayPoint1", shapely.Point(at(1 / 3, -2.123456789)), {"kind": "node", **nodes["WayPoint1"]}),
        ("B & <ö>", shapely.Point(at(30.0, 4.0, 1.5)), {"kind": "node", **nodes["B & <ö>"]}),
        ("e1", shapely.LineString([at(1 / 3, -2.123456789), at(30.0, 4.0)]), {"kind": "edge", **edge}),
    ]
    square = shapely.Polygon([at(0, 0), at(9, 0), at(9, 9), at(0, 9)])
    parts: dict[PartKey, Any] = {
        TOPOLOGY: features(network, anchor, {"tmap2": {"name": "farm", "meta": {"last_updated": "x"}}}),
        PartKey("location", "ground", SITE): features([("fence", square, {"kind": "fence"})], anchor),
        PartKey("zones", "L2", ZONES): features([("z", square, {"kind": "keepout", "expires": "2030"})], anchor),
        PartKey("objects", "ground", "kml"): features(
            [("shed", square, {"kind": "region", "kml": {"style": "#a"}}), ("text", None, {"kind": "note"})],
            anchor,
            {"kml": {"skeleton": "<kml/>"}},
        ),
        PartKey("objects", "ground", "osm"): features([], anchor, {"bounds": [0, 1, 2, 3]}),
    }
    return Layers(parts, levels=(Level(), Level("L2", 4.5)))


@pytest.mark.parametrize("datum", [None, DATUM])
@pytest.mark.parametrize("anchor", ["local", "wgs84"])
def test_all_layers_round_trip(anchor: Any, datum: Datum | None) -> None:
    before = everything(anchor)
    before = Layers(before.parts, datum, before.levels)
    data = write(before)
    after = read(data)
    assert after.datum == datum
    assert after.levels == before.levels
    assert set(after.parts) == set(before.parts)
    for key in before.parts:
        if key.name != "osm":
            same_features(part(before, key), part(after, key), 1e-9)
    assert part(after, PartKey("objects", "ground", "osm")).document == {"bounds": [0, 1, 2, 3]}
    assert write(after) == data
    assert geojson.detect("x", data)


def test_metres_are_not_written_as_degrees() -> None:
    layers = everything()
    served = orjson.loads(write(layers))
    assert served["coordRefSys"] == words.LOCAL_3D
    assert served["conformsTo"] == ["http://www.opengis.net/spec/json-fg-1/1.0/conf/core"]
    assert all(f["geometry"] is None for f in served["features"])
    assert sum(f["place"] is not None for f in served["features"]) == 6
    with_datum = orjson.loads(write(Layers(layers.parts, DATUM)))
    node = next(f for f in with_datum["features"] if f["id"] == "WayPoint1")
    assert node["place"]["coordinates"] == [round(1 / 3, 9), -2.123456789]
    earth = local_frame(DATUM).to_wgs84(np.array([[1 / 3, -2.123456789]]))[0]
    assert node["geometry"]["coordinates"] == pytest.approx(earth, abs=1e-12)
    assert node["properties"]["layer"] == "topology"


def test_items_without_place_are_read_from_geometry() -> None:
    served = orjson.loads(write(Layers(everything().parts, DATUM)))
    for f in served["features"]:
        f.pop("place", None)
    after = read(collection(*served["features"]))
    assert not part(after, TOPOLOGY).local.any()
    assert set(part(after, TOPOLOGY).ids) == {"WayPoint1", "B & <ö>", "e1"}


def test_api_topology_response_is_read_as_topology() -> None:
    line = {"type": "LineString", "coordinates": [[1, 2], [3, 4]]}
    edge = {"kind": "edge", "source": "a", "target": "b"}
    nodes = [feature(point(1, 2), {"kind": "node"}, id="a"), feature(point(3, 4), {"kind": "node"}, id="b")]
    layers = read(collection(*nodes, feature(line, edge, id="a_b")))
    assert set(layers.parts) == {TOPOLOGY}
    assert part(layers, TOPOLOGY).properties[2] == edge
    context = ReadContext()
    dangling = collection(*nodes, feature(line, {**edge, "target": "c"}, id="a_c"))
    layers = read(dangling, context)
    assert set(layers.parts) == {HOME}
    assert "missing nodes" in context.warnings[0].problem
    assert orjson.loads(write(layers)) == dangling
    local = collection(
        *[{**n, "geometry": None, "place": n["geometry"]} for n in nodes],
        {**feature(None, edge, id="a_b"), "place": line},
        coordRefSys=words.LOCAL_2D,
    )
    assert part(read(local), TOPOLOGY).local.all()


def test_network_derived_from_drawing_is_not_written_twice() -> None:
    drawing = read(SAMPLE.read_bytes())
    from app.model.network import from_drawing

    network = from_drawing(part(drawing, HOME))
    assert len(network) > 4
    served = orjson.loads(write(Layers({**drawing.parts, TOPOLOGY: network})))
    assert [f.get("id") for f in served["features"]] == [
        f.get("id") for f in orjson.loads(SAMPLE.read_bytes())["features"]
    ]
    alone = orjson.loads(write(Layers({TOPOLOGY: network})))
    assert len(alone["features"]) == len(network)


def test_local_objects_of_upload_stay_local() -> None:
    top = collection(
        {**feature(None, {"name": "x"}), "place": point(100.5, 2000.25)},
        {**feature(None, {}), "place": {"type": "LineString", "coordinates": [[0, 0, 0], [5, 5, 0]]}},
        feature(point(7, 50), {}),
        coordRefSys={"type": "Reference", "href": words.LOCAL_2D},
    )
    layers = read(top)
    assert part(layers, HOME).local.tolist() == [True, True, False]
    served = orjson.loads(write(layers))
    assert [f.get("place") for f in served["features"]] == [f.get("place") for f in top["features"]]
    assert served["coordRefSys"] == words.LOCAL_2D
    context = ReadContext()
    foreign = collection({**feature(None, {}), "place": point(500_000, 5_000_000)}, coordRefSys="x/EPSG/0/32630")
    layers = read(foreign, context)
    assert part(layers, HOME).geometry[0].is_empty
    assert "x/EPSG/0/32630 is unsupported" in context.warnings[0].problem
    assert orjson.loads(write(layers)) == foreign


def test_unsupported_layers_are_reported_as_dropped() -> None:
    from app.model.grid import OccupancyGrid

    grid = OccupancyGrid(np.zeros((2, 2), np.uint8), 0.1)
    context = WriteContext(attribution=("© somebody",))
    layers = Layers({**everything("wgs84").parts, PartKey("occupancy"): grid})
    served = orjson.loads(write(layers, context))
    assert [(d.subject, d.count) for d in context.dropped] == [("occupancy", 1)]
    assert served["attribution"] == "© somebody"


def test_written_geojson_is_read_by_ogr(tmp_path: Path) -> None:
    tool = shutil.which("ogrinfo")
    if tool is None:
        if os.environ.get("CI"):
            pytest.fail("ogrinfo (GDAL) is absent")
        pytest.skip("ogrinfo (GDAL) is absent")
    for name, layers, count in (
        ("own", Layers(everything().parts, DATUM), 6 + 1),
        ("metres", everything(), 6 + 1),
        ("sample", read(SAMPLE.read_bytes()), 8),
    ):
        path = tmp_path / f"{name}.geojson"
        path.write_bytes(write(layers))
        output = subprocess.run(
            [tool, "-ro", "-so", "-al", str(path)], check=True, capture_output=True, text=True
        ).stdout
        assert sum(int(line.split(":")[1]) for line in output.splitlines() if line.startswith("Feature Count")) == count


# --- hostile bytes -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        ("", "invalid JSON"),
        ("[]", "one object"),
        ('{"type": "Topology"}', "unsupported type"),
        ('{"type": ["Feature"]}', "unsupported type"),
        ('{"type": "FeatureCollection"}', "features"),
        ('{"type": "FeatureCollection", "features": [5]}', "type Feature"),
        ('{"type": "FeatureCollection", "features": [{"type": "Feature", "geometry": 5}]}', "object or null"),
        (collection(feature({"type": "Circle"})), "unsupported geometry type"),
        (collection(feature({"type": "Point"})), "array"),
        (collection(feature({"type": "Point", "coordinates": ["1", "2"]})), "numbers"),
        (collection(feature({"type": "Point", "coordinates": [True, 2]})), "numbers"),
        (collection(feature({"type": "Point", "coordinates": [[1, 2]]})), "numbers"),
        (collection(feature({"type": "Point", "coordinates": [1]})), "numbers"),
        (collection(feature({"type": "LineString", "coordinates": [[1, 2]]})), "two positions"),
        (collection(feature({"type": "LineString", "coordinates": [[1, 2], None]})), "arrays"),
        (collection(feature({"type": "LineString", "coordinates": [[1, 2], [1, None]]})), "numbers"),
        (collection(feature({"type": "Polygon", "coordinates": [[[0, 0], [1, 1]]]})), "four positions"),
        (collection(feature({"type": "Polygon", "coordinates": [5]})), "arrays"),
        (collection(feature({"type": "GeometryCollection", "geometries": [None]})), "unsupported geometry type"),
        (collection(feature(point(181, 0))), "longitude, latitude"),
        (collection(feature(point(0, 90.5))), "longitude, latitude"),
        (collection(feature(point(500_000, 5_000_000))), "EPSG:4326"),
        (collection({**feature(None), "place": point(1e9, 0)}, coordRefSys=words.LOCAL_2D), "outside"),
        (collection(feature(point(1, 2)), crs={"type": "name", "properties": {"name": "EPSG:3857"}}), "EPSG:3857"),
        (collection(feature(point(1, 2), [1])), "properties"),
        (collection(feature(point(1, 2), {}), fleet_map={"datum": {"latitude": 99, "longitude": 0}}), "latitude"),
        (collection(feature(point(1, 2), {}), fleet_map={"datum": {"x": 1}}), "x"),
        (collection(feature(point(1, 2), {}), fleet_map={"levels": [5]}), ""),
    ],
)
def test_bad_content_is_refused_with_a_reason(data: Any, reason: str) -> None:
    with pytest.raises(UnreadableFile) as refused:
        read(data)
    assert reason in refused.value.detail
    assert refused.value.problems


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e999", "0x10", "1_0", "01"])
def test_non_finite_numbers_are_refused(number: str) -> None:
    text = json.dumps(collection(feature(point(1, 2), {"a": 1})))
    for place in ('"a": 1', "1, 2"):
        with pytest.raises(UnreadableFile):
            read(text.replace(place, place.replace("1", number)))


def test_bad_position_is_reported_with_line() -> None:
    rows_ = ",\n".join(json.dumps(feature(point(k * 100, 0), {}, id=f"f{k}")) for k in range(4))
    with pytest.raises(UnreadableFile) as refused:
        read('{"type": "FeatureCollection", "features": [\n' + rows_ + "]}")
    assert (refused.value.problems[0].line, refused.value.problems[0].where) == (4, "feature 'f2'")
    with pytest.raises(UnreadableFile) as refused:
        read('{"type": "FeatureCollection",\n "features": [\n {"type" "Feature"}]}')
    assert refused.value.problems[0].line == 3


def test_depth_and_size_are_bounded() -> None:
    for depth, inner in ((200, "1"), (900, "1"), (900, '"]]]]"'), (100_000, "1")):
        deep = '{"type": "Feature", "geometry": null, "properties": {"a": ' + "[" * depth + inner + "]" * depth + "}}"
        with pytest.raises(UnreadableFile):
            read(deep)
        assert isinstance(geojson.detect("x", deep.encode()), bool)
    fine = {"text": "[[[[{" * 100, "quote": '"[[' * 100, "back": "\\[" * 200}
    assert read(feature(None, fine))
    nested: dict[str, Any] = point(1, 2)
    for _ in range(60):
        nested = {"type": "GeometryCollection", "geometries": [nested]}
    assert orjson.loads(write(read(feature(nested)))) == feature(nested)
    with pytest.raises(TooLarge):
        read(collection(*[feature(None)] * 11), limits=Limits(features=10))
    with pytest.raises(TooLarge):
        read(SAMPLE.read_bytes(), limits=Limits(text_bytes=100))


def test_detect_rejects_route_graphs_and_other_json(shared: Path) -> None:
    for path in sorted((shared / "data/nav2_route_graph").rglob("*.geojson")):
        assert not geojson.detect(path.name, path.read_bytes()), path.name
    for other in (b"", b"{", b'{"type": "object"}', b'{"type": "Point"}', b"<osm/>", b'["FeatureCollection"]'):
        assert not geojson.detect("x.json", other)


def test_truncated_and_mutated_files_never_crash() -> None:
    data = SAMPLE.read_bytes()
    noise = random.Random(3)
    for cut in [noise.randrange(len(data) - 4) for _ in range(30)]:
        with pytest.raises(UnreadableFile):
            read(data[:cut])
    for _ in range(300):
        broken = bytearray(data)
        for _ in range(noise.randrange(1, 4)):
            broken[noise.randrange(len(data))] = noise.choice(b'{}[]",:0-.eE9nt \xff')
        with suppress(BadUpload):
            write(read(bytes(broken)))
    top = orjson.loads(data)
    junk: list[Any] = [None, True, 5, -1.5, "x", [], {}, [[]], {"type": "Point"}, "\x00", 2**63 - 1]
    for _ in range(300):
        copy: Any = json.loads(json.dumps(top))
        at: Any = copy
        while True:
            step = noise.choice(list(at)) if isinstance(at, dict) else noise.randrange(len(at))
            if isinstance(at[step], dict | list) and at[step] and noise.random() < 0.8:
                at = at[step]
            else:
                at[step] = noise.choice(junk)
                break
        with suppress(BadUpload):
            write(read(json.dumps(copy)))


def test_arbitrary_edited_properties_are_written_safely() -> None:
    odd: list[Any] = [
        5,
        {"id": {}},
        {"geometry": {"type": "Polygon", "coordinates": 5}},
        {"kept": 5, "added": 5, "members": 5},
    ]
    rows_ = [(f"f{k}", shapely.Point(1, 2), {"geojson": o}) for k, o in enumerate(odd)]
    assert write(Layers({HOME: features(rows_, "wgs84", {"geojson": 5})}))
    assert write(
        Layers({HOME: features(rows_, "wgs84", {"geojson": {"members": {"type": 5, "features": 1}, "type": 5}})})
    )


def test_large_file_is_read_in_time() -> None:
    rows_ = [feature(point(k % 170, k % 80), {"n": k}, id=k) for k in range(50_000)]
    data = orjson.dumps(collection(*rows_))
    started = time.process_time()
    layers = read(data)
    assert orjson.loads(write(layers)) == orjson.loads(data)
    assert time.process_time() - started < 60
