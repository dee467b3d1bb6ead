"""waypoints_csv: positions, angles and further columns, with hand-computed facts."""

from __future__ import annotations

import math

import pytest
import shapely

from app import formats
from app.errors import MissingDatum, UnreadableFile
from app.formats import FileGroup, ReadContext, WriteContext, get_format
from app.model.features import Features, features
from app.model.frame import Datum
from app.model.layers import Layers, PartKey

FORMAT = get_format("waypoints_csv")
NETWORK = PartKey("topology", "ground", "network")


def read(text: str) -> tuple[Features, ReadContext]:
    context = ReadContext(main="w.csv")
    return formats.read(FileGroup(FORMAT, "w.csv", {"w.csv": text.encode()}), context).vector("topology")[
        NETWORK
    ], context


def write(layers: Layers) -> tuple[str, WriteContext]:
    context = WriteContext()
    return formats.write(FORMAT, layers, context)["waypoints.csv"].decode(), context


def test_metres_and_yaw_become_nodes() -> None:
    part, _ = read('yaw,name,y,x\n1.5707963267949,"gate, north",-3.25,12.5\n')
    assert list(part.ids) == ["gate, north"]
    assert (part.geometry[0].x, part.geometry[0].y) == (12.5, -3.25)
    assert part.local.all()
    half = math.sqrt(0.5)
    assert part.properties[0]["orientation"] == pytest.approx([0, 0, half, half])


@pytest.mark.parametrize(
    ("header", "expected"),
    [
        ('"name","x","y"', True),
        ('\ufeff"name",x,"y"\r', True),
        ("name,x,y\rA,1,2", True),
        ("name;x;y", False),
        ("", False),
    ],
)
def test_the_header_may_be_quoted(header: str, expected: bool) -> None:
    assert FORMAT.detect("w.csv", f"{header}\n".encode()) is expected


def test_degrees_are_latitude_then_longitude_and_come_back() -> None:
    text = "name,latitude,longitude\nbarn,53.2687,-0.5244\n"
    part, _ = read(text)
    assert (part.geometry[0].x, part.geometry[0].y) == (-0.5244, 53.2687)
    assert not part.local.any()
    assert write(Layers({NETWORK: part}, Datum(53.2686, -0.5245, heading=30.0)))[0] == text


def test_degrees_from_metres_need_a_datum() -> None:
    part, _ = read("name,latitude,longitude\nbarn,53.2687,-0.5244\n")
    with pytest.raises(MissingDatum):
        write(Layers({NETWORK: part}))


def test_further_columns_come_back() -> None:
    text = 'name,x,y,note\na,1.0,2.0,"say ""no"""\nb,0.0,0.0,\n'
    assert write(Layers({NETWORK: read(text)[0]}))[0] == text


def test_edges_and_altitudes_are_reported_as_dropped() -> None:
    rows = [
        ("a", shapely.Point(0, 0, 2.5), {"kind": "node"}),
        ("b", shapely.Point(9, 0), {"kind": "node"}),
        ("e", shapely.LineString([(0, 0), (9, 0)]), {"kind": "edge", "source": "a", "target": "b"}),
    ]
    text, context = write(Layers({NETWORK: features(rows, "local")}))
    assert text == "name,x,y,yaw\na,0.0,0.0,\nb,9.0,0.0,\n"
    assert {(d.subject, d.count) for d in context.dropped} == {("edges", 1), ("altitudes of nodes", 1)}


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("name,x,y\na,nan,0\n", "line 2, x"),
        ("name,x,y\na,1_0,0\n", "line 2, x"),
        ("name,x,y\na,1e9,0\n", "line 2, x"),
        ("name,latitude,longitude\na,91,0\n", "line 2, latitude"),
        ("name,x,y\n\na,1\n", "line 3"),
        ("name,x,y\n,1,2\n", "line 2, name"),
        ('name,x,y\n"a,1,2\n', "line 2"),
        ("name,x,x,y\na,1,1,2\n", "line 1"),
    ],
)
def test_bad_values_are_refused_with_location(text: str, place: str) -> None:
    with pytest.raises(UnreadableFile) as caught:
        read(text)
    assert caught.value.problems[0].where == place


def test_duplicate_names_are_warned_about() -> None:
    part, context = read("name,x,y\na,0,0\na,1,0\n")
    assert len(set(part.ids)) == 2
    assert "1 duplicate names" in context.warnings[0].problem
