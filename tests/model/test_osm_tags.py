"""OpenStreetMap's values, as written in its wiki."""

from __future__ import annotations

from typing import Any

import pytest

from app.model import osm_tags


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        *[("3", 3.0), ("3.5 m", 3.5), ("3,5", 3.5), ("2m", 2.0), ("50 cm", 0.5), ("10 ft", 3.048), ("10'", 3.048)],
        *[("7'6\"", 2.286), ("6' 3\"", 1.905), ("0", 0.0), ("0.5 km", 500.0), ("1 mi", 1609.344)],
        *[("", None), ("wide", None), ("-3", None), ("3;4", None), ("1e9", None), ("9" * 50, None), (3, None)],
        *[("999999999 km", None), ("٣", None), ("3 m m", None)],
    ],
)
def test_osm_lengths_are_parsed_to_metres(value: Any, expected: float | None) -> None:
    assert osm_tags.metres(value) == pytest.approx(expected) if expected is not None else osm_tags.metres(value) is None


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        *[("50", 13.888888889), ("30 mph", 13.4112), ("5 knots", 2.572222222), ("30 km/h", 8.333333333)],
        *[("walk", 1.666666667), ("50;30", 8.333333333), ("none;70", 19.444444444)],
        *[("none", None), ("RO:urban", None), ("signals", None), ("0", None), ("-5", None), (None, None)],
        *[("30 @ (22:00-06:00)", None), ("1" * 90, None)],
    ],
)
def test_osm_speeds_are_parsed_to_metres_per_second(value: Any, expected: float | None) -> None:
    assert osm_tags.speed(value) == expected


def test_osm_measures_follow_tags() -> None:
    assert osm_tags.height({"height": "12.5", "building:levels": "9"}) == 12.5
    assert osm_tags.height({"building:levels": "2.5"}) == 7.5
    assert osm_tags.height({"height": "high", "building:levels": "2"}) == 6.0
    assert osm_tags.height({"building:levels": "many"}) is None
    assert osm_tags.base({"min_height": "4", "building:min_level": "9"}) == 4.0
    assert osm_tags.base({"building:min_level": "2"}) == 6.0
    assert osm_tags.base({"min_height": "0"}) is None
    assert osm_tags.width({"est_width": "2"}) == 2.0
    assert osm_tags.width({"natural": "tree", "circumference": "3.14159265"}) == pytest.approx(1.0)
    assert osm_tags.width({"man_made": "pipeline", "diameter": "1200"}) is None, "pipes are in millimetres"
    assert osm_tags.way_width({"lanes": "2"}) == 6.0
    assert osm_tags.way_width({"lanes": "2", "width": "5"}) == 5.0
    assert osm_tags.speed_limit({"maxspeed": "50", "maxspeed:backward": "30"}, "backward") == 8.333333333
    assert osm_tags.speed_limit({"maxspeed": "50", "maxspeed:backward": "30"}, "forward") == 13.888888889
