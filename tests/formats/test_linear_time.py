"""Thousands of items of one kind are read in linear time: eight times the items, about eight times the work."""

from __future__ import annotations

import json
import time
from collections.abc import Callable

import pytest

from app import formats
from app.formats import FileGroup, ReadContext


def kml(body: str) -> bytes:
    return f'<kml xmlns="http://www.opengis.net/kml/2.2"><Document>{body}</Document></kml>'.encode()


def points(count: int) -> bytes:
    point = "<Point><coordinates>1,2</coordinates></Point>"
    return kml(f"<Placemark><MultiGeometry>{point * count}</MultiGeometry></Placemark>")


def geometries(count: int) -> bytes:
    return kml(f"<Placemark>{'<Point><coordinates>1,2</coordinates></Point>' * count}</Placemark>")


def unknown_names(count: int) -> bytes:
    return kml("".join(f"<u{k}/>" for k in range(count)))


def frames(count: int) -> bytes:
    chain = "".join(f'<frame name="f{k}"><pose relative_to="f{k + 1}">1 0 0 0 0 0</pose></frame>' for k in range(count))
    model = '<model name="m"><pose relative_to="f0">0 0 0 0 0 0</pose></model>'
    return f'<sdf version="1.7"><world name="w">{chain}{model}</world></sdf>'.encode()


def layouts(count: int) -> bytes:
    rows = [{"layoutId": str(k), "layoutVersion": "1", "nodes": [], "edges": [], "stations": []} for k in range(count)]
    meta = {"projectIdentification": "a", "creator": "b", "exportTimestamp": "c", "lifVersion": "1.0.0"}
    return json.dumps({"metaInformation": meta, "layouts": rows}).encode()


def seconds(format_name: str, data: bytes) -> float:
    """Return the processor time that this process needs to read a file, the least of three."""
    group = FileGroup(formats.get_format(format_name), "a", {"a": data})
    taken = []
    for _ in range(3):
        start = time.process_time()
        formats.read(group, ReadContext())
        taken.append(time.process_time() - start)
    return min(taken)


@pytest.mark.parametrize(
    ("format_name", "make", "count"),
    [
        ("kml", points, 5000), ("kml", geometries, 8000), ("kml", unknown_names, 2000), ("gazebo", frames, 3000),
        ("lif", layouts, 2000),
    ],
)  # fmt: skip
def test_eight_times_the_items_take_about_eight_times_as_long(
    format_name: str, make: Callable[[int], bytes], count: int
) -> None:
    few, many = seconds(format_name, make(count)), seconds(format_name, make(8 * count))
    assert many < 24 * few, "64 times as long is quadratic time"
