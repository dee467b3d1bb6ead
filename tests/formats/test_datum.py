"""datum.yaml: real files round-trip, the heading matches robot_localization, errors name their location."""

from __future__ import annotations

import json
import math
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ryml
import shapely
import yaml
from hypothesis import given
from hypothesis import strategies as st

from app import formats
from app.errors import BadUpload, UnreadableFile
from app.formats import FileGroup, ReadContext, WriteContext, get_format
from app.model.features import Features, features
from app.model.frame import Datum
from app.model.geodesy import LocalFrame
from app.model.layers import Layers, PartKey

FORMAT = get_format("datum")
SAMPLES = Path(__file__).resolve().parents[1] / "samples" / "datum"
FACTS: dict[str, Any] = json.loads((SAMPLES / "facts.json").read_text())
SITE = PartKey("location", "ground", "site")
Same = Callable[[str, dict[str, bytes], dict[str, bytes]], list[str]]

FILE = """\
datum_latitude: 53.25
datum_longitude: -0.5
gnss_fence:
  gnss_fence_coords: [[53.26, -0.51], [53.24, -0.51], [53.24, -0.49]]
gmapping: {xmin: -1, xmax: 1, ymin: -1, ymax: 1}
navsat_transform_node:
  datum: [53.25, -0.5, 0.0]
"""


def read(data: bytes | str, **context: Any) -> tuple[Layers, ReadContext]:
    read_context = ReadContext(main="datum.yaml", **context)
    content = data.encode() if isinstance(data, str) else data
    return formats.read(FileGroup(FORMAT, "datum.yaml", {"datum.yaml": content}), read_context), read_context


def write(layers: Layers) -> tuple[bytes, WriteContext]:
    context = WriteContext()
    files = formats.write(FORMAT, layers, context)
    assert list(files) == ["datum.yaml"]
    return files["datum.yaml"], context


def site(layers: Layers) -> Features:
    part = layers.parts[SITE]
    assert isinstance(part, Features)
    return part


def datum(layers: Layers) -> Datum:
    assert layers.datum is not None
    return layers.datum


def real(shared: Path) -> list[Path]:
    return sorted((shared / "data").rglob("datum*.yaml"))


def test_real_files_round_trip(shared: Path, same: Same, facts_json: dict[str, Any]) -> None:
    paths = real(shared)
    assert len(paths) == 9
    for path in paths:
        data = path.read_bytes()
        assert formats.detect(path.name, data) is FORMAT
        layers, context = read(data)
        crossing = "general_east_pathway" in str(path)
        assert ["crosses itself" in w.problem for w in context.warnings] == [True] * crossing, path
        served, write_context = write(layers)
        assert same("datum", {"datum.yaml": data}, {"datum.yaml": served}) == [], path
        assert (write_context.dropped, write_context.template, write_context.warnings) == ([], [], [])
        assert yaml.safe_load(served) == yaml.safe_load(data)
        ryml.parse_in_arena(served)
        assert write(read(served)[0])[0] == served

        fact = facts_json[str(path.relative_to(shared / "data"))]["facts"]
        assert (datum(layers).latitude, datum(layers).longitude) == (fact["datum_latitude"], fact["datum_longitude"])
        assert (datum(layers).altitude, datum(layers).heading) == (0.0, 0.0)  # mapviz' 100 m are not believed
        part = site(layers)
        assert (part.ids, part.local.tolist(), part.properties[0]["kind"]) == (("fence",), [False], "fence")
        ring = shapely.get_coordinates(part.geometry[0])
        assert len(ring) - (0 if fact["fence_closed"] else 1) == fact["fence_points"]
        assert ring[0].tolist() == fact["fence_first"][::-1]
        box = fact["fence_bbox"]
        assert part.geometry[0].bounds == (box["minlon"], box["minlat"], box["maxlon"], box["maxlat"])


def test_sample_is_written_as_expected() -> None:
    data = (SAMPLES / "datum.yaml").read_bytes()
    fact = FACTS["datum.yaml"]
    layers, context = read(data)
    assert context.warnings == []
    assert (datum(layers).latitude, datum(layers).longitude) == (fact["latitude"], fact["longitude"])
    assert datum(layers).heading == pytest.approx(fact["heading"], abs=1e-12)
    fence = site(layers).geometry[0]
    assert len(fence.exterior.coords) - 1 == fact["fence_points"]
    assert list(fence.bounds) == fact["fence_bounds"]
    served, write_context = write(layers)
    after, before = yaml.safe_load(served), yaml.safe_load(data)
    template = after["navsat_transform_node"]
    assert template | before["navsat_transform_node"] == template
    assert {**after, "navsat_transform_node": 0} == {**before, "navsat_transform_node": 0}
    lacking = {key for key in template if key not in before["navsat_transform_node"]}
    assert {t.option for t in write_context.template} == lacking
    assert {t.subject.partition(": ")[0] for t in write_context.template} == {"navsat_transform_node"}
    assert "frequency" in template


@pytest.mark.parametrize("yaw", [0.0, 0.5, -0.5, math.pi / 2, math.pi, -3.0, 7.0, 100.0])
def test_heading_matches_robot_localization(yaw: float) -> None:
    """A robot at the datum whose yaw is 0 in the local frame points along +x: by ``yaw`` counter-clockwise of east."""
    layers, _ = read(FILE.replace("-0.5, 0.0]", f"-0.5, {yaw}]"))
    frame = LocalFrame(datum(layers))
    ahead = frame.to_wgs84(np.array([[1.0, 0.0]]))
    east, north = LocalFrame(Datum(53.25, -0.5)).to_local(ahead)[0]
    assert (east, north) == (pytest.approx(math.cos(yaw), abs=1e-6), pytest.approx(math.sin(yaw), abs=1e-6))
    served, _ = write(layers)
    assert yaml.safe_load(served)["navsat_transform_node"]["datum"] == [53.25, -0.5, yaw]  # its own digits and turns


def test_new_datum_moves_only_origins_at_old_datum() -> None:
    layers, _ = read((SAMPLES / "datum.yaml").read_bytes())
    served, _ = write(Layers(layers.parts, Datum(-33.4, 151.25, 12.5, 90.0), layers.levels))
    top = yaml.safe_load(served)
    assert (top["datum_latitude"], top["datum_longitude"], top["datum_altitude"]) == (-33.4, 151.25, 12.5)
    origin, depot = top["mapviz_initialize_origin"]["local_xy_origins"]
    assert (origin["latitude"], origin["longitude"], origin["altitude"]) == (-33.4, 151.25, 100.0)
    assert (depot["latitude"], depot["longitude"]) == (-33.5, 151.3)
    assert top["navsat_transform_node"]["datum"] == [-33.4, 151.25, pytest.approx(-math.pi / 2)]
    assert len(top["gnss_fence"]["gnss_fence_coords"]) == 5
    back = datum(read(served)[0])
    assert (back.altitude, back.heading) == (12.5, pytest.approx(90.0))


def test_missing_size_is_filled_in_from_extent() -> None:
    frame = LocalFrame(Datum(10.0, 20.0))
    corners = frame.to_wgs84(np.array([[-30.2, -10.4], [50.5, -10.4], [50.5, 80.9], [-30.2, 80.9]]))
    fence = features([("f", shapely.Polygon(corners), {"kind": "fence"})], "wgs84")
    served, context = write(Layers({SITE: fence}, Datum(10.0, 20.0)))
    top = yaml.safe_load(served)
    assert top["gmapping"] == {"xmin": -31, "xmax": 51, "ymin": -11, "ymax": 81}
    assert top["mapviz_initialize_origin"]["local_xy_origins"][0]["latitude"] == 10.0
    assert top["navsat_transform_node"]["wait_for_datum"] is True
    assert top["navsat_transform_node"]["datum"] == [10.0, 20.0, 0.0]
    whats = {t.subject.partition(": ")[0] for t in context.template}
    assert whats == {"gmapping", "mapviz_initialize_origin", "navsat_transform_node"}


def test_missing_values_come_from_options() -> None:
    context = WriteContext(
        options=formats.write_options(FORMAT, {"wait_for_datum": "no", "yaw_offset": "1.57", "half_size": 50})
    )
    top = yaml.safe_load(formats.write(FORMAT, Layers({}, Datum(10.0, 20.0)), context)["datum.yaml"])
    assert top["gmapping"] == {"xmin": -50, "xmax": 50, "ymin": -50, "ymax": 50}
    assert top["navsat_transform_node"]["wait_for_datum"] is False
    assert top["navsat_transform_node"]["yaw_offset"] == 1.57
    assert {t.option for t in context.template} >= {"wait_for_datum", "yaw_offset", "half_size"}
    data = (SAMPLES / "datum.yaml").read_bytes()
    other = {"use_odometry_yaw": True, "wait_for_datum": False}
    other_context = WriteContext(options=formats.write_options(FORMAT, other))
    served = yaml.safe_load(formats.write(FORMAT, read(data)[0], other_context)["datum.yaml"])["navsat_transform_node"]
    source = yaml.safe_load(data)["navsat_transform_node"]
    assert {key: served[key] for key in other} == {**other, **{k: v for k, v in source.items() if k in other}}


def test_datum_without_fence_round_trips() -> None:
    served, write_context = write(Layers({}, Datum(10.0, 20.0)))
    assert yaml.safe_load(served)["gnss_fence"]["gnss_fence_coords"] == []
    assert "no fence" in write_context.warnings[0].problem
    assert [p.problem for p in formats.check(FORMAT, {"datum.yaml": served}) if p.level == "error"] == []
    layers, context = read(served)
    assert datum(layers) == Datum(10.0, 20.0)
    assert len(site(layers)) == 0
    assert "no fence" in context.warnings[0].problem
    assert write(layers)[0] == served
    bare, _ = read("datum_latitude: 10\ndatum_longitude: 20\n")
    assert datum(bare) == Datum(10.0, 20.0)


def test_one_fence_is_written_and_others_are_reported_as_dropped() -> None:
    small = shapely.Polygon([(0, 0), (0, 1), (1, 1)])
    big = shapely.Polygon([(0, 0), (0, 3), (3, 3), (3, 0)], [[(1, 1), (1, 2), (2, 2)]])
    rows: list[tuple[str, Any, dict[str, Any]]] = [
        ("a", small, {"kind": "region"}),
        ("b", big, {"kind": "fence"}),
        ("c", shapely.LineString([(0, 0), (1, 1)]), {"kind": "path"}),
    ]
    served, context = write(Layers({SITE: features(rows, "wgs84")}, Datum(1.0, 1.0)))
    assert yaml.safe_load(served)["gnss_fence"]["gnss_fence_coords"] == [[0, 0], [3, 0], [3, 3], [0, 3]]
    assert {d.subject: d.count for d in context.dropped} == {
        "location items that are not polygons": 1,
        "further location polygons": 1,
        "holes of the fence": 1,
    }
    served, _ = write(Layers({SITE: features(rows[:1], "wgs84")}, Datum(1.0, 1.0)))
    assert len(yaml.safe_load(served)["gnss_fence"]["gnss_fence_coords"]) == 3


def test_local_fence_is_written_in_degrees() -> None:
    square = shapely.Polygon([(0, 0), (100, 0), (100, 100), (0, 100)])
    served, _ = write(Layers({SITE: features([("f", square, {"kind": "fence"})], "local")}, Datum(53.25, -0.5)))
    coords = yaml.safe_load(served)["gnss_fence"]["gnss_fence_coords"]
    assert coords[0] == [53.25, -0.5]
    assert coords[2] == [pytest.approx(53.2508985, abs=1e-6), pytest.approx(-0.4985018, abs=1e-6)]


def test_degrees_near_zero_are_numbers_for_pyyaml() -> None:
    served, _ = write(Layers({}, Datum(1e-7, -2e-12)))
    top = yaml.safe_load(served)
    assert (top["datum_latitude"], top["datum_longitude"]) == (1e-7, -2e-12)


def test_doubtful_values_are_warned_about() -> None:
    text = FILE.replace("datum: [53.25, -0.5, 0.0]", "yaw_offset: 1.57\n  datum: [53.2501, -0.5, 0.0]")
    layers, context = read(text)
    assert datum(layers).latitude == 53.25
    assert [p.where for p in context.warnings] == ["navsat_transform_node.datum", "navsat_transform_node.yaw_offset"]


@pytest.mark.parametrize(
    ("before", "after", "where", "line"),
    [
        ("datum_latitude: 53.25\n", "", "datum_latitude", None),
        ("datum_latitude: 53.25", "datum_latitude: north", "datum_latitude", None),
        ("datum_latitude: 53.25", "datum_latitude: true", "datum_latitude", None),
        ("datum_latitude: 53.25", "datum_latitude: [1]", "datum_latitude", None),
        ("datum_latitude: 53.25", "datum_latitude: 91", "datum_latitude", None),
        ("datum_latitude: 53.25", "datum_latitude: 89.9", "datum_latitude", None),
        ("datum_latitude: 53.25", "datum_latitude: .nan", None, 1),
        ("datum_longitude: -0.5", "datum_longitude: 180.5", "datum_longitude", None),
        ("datum_longitude: -0.5", "datum_longitude: -.inf", None, 2),
        ("[53.26, -0.51], ", "", "gnss_fence.gnss_fence_coords", None),
        ("[[53.26, -0.51], [53.24, -0.51], [53.24, -0.49]]", "[[53.26, -0.51]]", "gnss_fence.gnss_fence_coords", None),
        ("[53.24, -0.49]]", "[53.26, -0.51]]", "gnss_fence.gnss_fence_coords", None),
        ("[53.24, -0.49]", "[53.24]", "gnss_fence.gnss_fence_coords[2]", None),
        ("[53.24, -0.49]", "5", "gnss_fence.gnss_fence_coords[2]", None),
        ("[53.24, -0.49]", "[x, -0.49]", "gnss_fence.gnss_fence_coords[2][0]", None),
        ("[53.24, -0.49]", "[153.24, -0.49]", "gnss_fence.gnss_fence_coords[2][0]", None),
        ("[53.24, -0.49]", "[53.24, 200]", "gnss_fence.gnss_fence_coords[2][1]", None),
        ("[53.24, -0.49]", "[53.24, .nan]", None, 4),
        ("gnss_fence:\n  gnss_fence_coords: [[", "gnss_fence: [[", "gnss_fence", None),
        ("gnss_fence_coords: [[53.26, -0.51], [53.24, -0.51], [53.24, -0.49]]", "gnss_fence_coords: all",
         "gnss_fence.gnss_fence_coords", None),
        ("{xmin: -1, xmax: 1, ymin: -1, ymax: 1}", "big", "gmapping", None),
        ("datum: [53.25, -0.5, 0.0]", "datum: here", "navsat_transform_node.datum", None),
        ("datum: [53.25, -0.5, 0.0]", "datum: [53.25, -0.5, east]", "navsat_transform_node.datum[2]", None),
        ("\n  datum: [53.25, -0.5, 0.0]", " 5", "navsat_transform_node", None),
    ],
)  # fmt: skip
def test_invalid_values_are_refused_with_location(before: str, after: str, where: str | None, line: int | None) -> None:
    assert before in FILE
    with pytest.raises(UnreadableFile) as caught:
        read(FILE.replace(before, after, 1))
    problem = caught.value.problems[0]
    assert (problem.where, problem.line, problem.file) == (where, line, "datum.yaml")


@pytest.mark.parametrize("data", [b"", b"[]", b"- 1", b"a: [", b"\xff", b"x", b"datum_latitude: *a"])
def test_other_bytes_are_refused(data: bytes) -> None:
    with pytest.raises(BadUpload):
        read(data)


def test_truncated_and_mutated_files_are_read_or_refused() -> None:
    data = (SAMPLES / "datum.yaml").read_bytes()
    dice = random.Random(5)
    for k in range(400):
        variant = bytearray(data[: dice.randrange(len(data))] if k % 3 == 0 else data)
        for _ in range(dice.randrange(4)):
            if variant:
                variant[dice.randrange(len(variant))] = dice.randrange(256)
        try:
            layers, _ = read(bytes(variant))
        except BadUpload:
            continue
        yaml.safe_load(write(layers)[0])


degrees = st.floats(-80, 80).map(lambda v: round(v, 12) + 0.0)
scalars = st.none() | st.booleans() | st.integers(-1000, 1000) | st.floats(-1e9, 1e9) | st.text("ab: #'-é", max_size=6)
more = st.dictionaries(st.text("abcdef", min_size=1, max_size=5), scalars | st.lists(scalars, max_size=3), max_size=3)


@given(
    degrees, degrees, st.floats(-10, 10), st.lists(st.tuples(degrees, degrees), min_size=3, max_size=8, unique=True),
    st.booleans(), more, more, more,
)  # fmt: skip
def test_any_file_round_trips(
    latitude: float, longitude: float, yaw: float, ring: list[tuple[float, float]], closed: bool,
    size: dict[str, Any], navsat: dict[str, Any], rest: dict[str, Any],
) -> None:  # fmt: skip
    coords = [list(p) for p in ring] + ([list(ring[0])] if closed else [])
    document = {
        **rest,
        "datum_latitude": latitude,
        "datum_longitude": longitude,
        "gnss_fence": {"gnss_fence_coords": coords},
        "gmapping": {**size, "xmin": -1, "xmax": 1.5, "ymin": 2, "ymax": -2},
        "mapviz_initialize_origin": {"local_xy_origins": [{"latitude": latitude, "longitude": longitude}]},
        "navsat_transform_node": {**navsat, "datum": [latitude, longitude, yaw]},
    }
    layers, _ = read(yaml.safe_dump(document, allow_unicode=True))
    served, _ = write(layers)
    after = yaml.safe_load(served)
    assert after["navsat_transform_node"] | document["navsat_transform_node"] == after["navsat_transform_node"]
    assert {**after, "navsat_transform_node": 0} == {**document, "navsat_transform_node": 0}
    assert write(read(served)[0])[0] == served
    assert [f.id for f in site(layers)] == ["fence"]


@pytest.mark.parametrize(
    ("name", "data", "is_one"),
    [
        ("datum.yaml", FILE.encode(), True),
        ("datum_autogen.yml", FILE.encode(), True),
        ("datum.txt", FILE.encode(), False),
        ("map.yaml", b"image: map.pgm\n", False),
        ("x.yaml", b"a:\n  datum_latitude: 1\n  datum_longitude: 2\n", False),
    ],
)
def test_detect_accepts_datum_files_only(name: str, data: bytes, is_one: bool) -> None:
    assert FORMAT.detect(name, data) is is_one
