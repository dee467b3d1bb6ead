"""Matching and comparison of features with what a format gives back."""

from __future__ import annotations

from typing import Any

import pytest
import shapely

from app.convert.comparison import Item, differing_fields, is_equal, match_items


def node(item: str, x: float, y: float, level: str = "L1", **properties: Any) -> Item:
    return Item(level, item, shapely.Point(x, y), {"kind": "node", **properties})


def edge(item: str, source: str, target: str, *line: tuple[float, float], **properties: Any) -> Item:
    ends = {"source": source, "target": target}
    return Item("L1", item, shapely.LineString(line), {"kind": "edge", **ends, **properties})


def match(stored: list[Item], returned: list[Item]) -> dict[str, str]:
    return {stored[j].id: returned[k].id for j, k in match_items(stored, returned).items()}


def differences(stored: list[Item], returned: list[Item]) -> dict[str, list[str]]:
    pairs = match_items(stored, returned)
    return {stored[j].id: names for j, names in differing_fields(stored, returned, pairs, {"kml"})}


def test_numbered_ids_of_other_nodes_do_not_match() -> None:
    # a format without ids numbers nodes anew, and leaves one out
    stored = [node("L1/0", 0, 0), node("L1/1", 5, 0), node("L1/2", 9, 0)]
    returned = [node("L1/0", 5, 0), node("L1/1", 9, 0)]
    assert match(stored, returned) == {"L1/1": "L1/0", "L1/2": "L1/1"}
    assert differences(stored, returned) == {}


def test_edges_match_by_the_nodes_they_join() -> None:
    stored = [
        node("a", 0, 0),
        node("b", 5, 0),
        edge("ab", "a", "b", (0, 0), (2, 1), (5, 0)),
        edge("ba", "b", "a", (5, 0), (0, 0)),
    ]
    returned = [
        node("0", 0, 0),
        node("1", 5, 0),
        edge("x", "0", "1", (0, 0), (5, 0)),
        edge("y", "1", "0", (5, 0), (0, 0)),
    ]
    assert match(stored, returned) == {"a": "0", "b": "1", "ab": "x", "ba": "y"}
    assert differences(stored, returned) == {"ab": ["geometry"]}, "its bend is lost; ends under other ids are the same"


def test_name_comes_before_position_and_moved_features_keep_their_id() -> None:
    stored = [node("a", 0, 0, name="Dock"), node("b", 5, 0, name="Gate"), node("c", 9, 0)]
    returned = [node("1", 5, 0, name="Dock"), node("2", 0, 0, name="Gate"), node("c", 7, 0)]
    assert match(stored, returned) == {"a": "1", "b": "2", "c": "c"}
    assert differences(stored, returned) == {item: ["geometry"] for item in "abc"}


def test_ambiguous_features_are_not_matched() -> None:
    stored = [node("a", 0, 0), node("b", 0, 0)]
    assert match(stored, [node("1", 0, 0)]) == {}
    assert match(stored, [node("1", 0, 0), node("2", 0, 0)]) == {}


def test_another_kind_is_a_changed_kind() -> None:
    hut = shapely.box(0, 0, 3, 2)
    stored = [Item("L1", "hut", hut, {"kind": "building", "height": 3.0})]
    returned = [
        Item("ground", "w1", shapely.Polygon(hut.exterior.coords[2:] + hut.exterior.coords[1:3]), {"kind": "line"})
    ]
    assert differences(stored, returned) == {"hut": ["height", "kind", "level"]}


@pytest.mark.parametrize(("metres", "names"), [(0.009, []), (0.02, ["geometry"])])
def test_a_centimetre_is_no_difference(metres: float, names: list[str]) -> None:
    got = differences([node("a", 0, 0, name="A")], [node("a", metres, 0, name="A")])
    assert got.get("a", []) == names


def test_heights_are_compared() -> None:
    high = Item("L1", "a", shapely.Point(0, 0, 2.0), {"kind": "node", "name": "A"})
    assert differences([high], [node("a", 0, 0, name="A")]) == {"a": ["geometry"]}
    floor = Item("L1", "a", shapely.Point(0, 0, 0.0), {"kind": "node", "name": "A"})
    assert differences([floor], [node("a", 0, 0, name="A")]) == {}


def test_added_and_format_specific_properties_are_no_loss() -> None:
    stored = [node("a", 0, 0, kml={"style": "x"}, orientation=[0.0, 0.0, 1.0, 0.0], speed=1)]
    returned = [node("a", 0, 0, width=2.0, orientation=[0.0, 0.0, -1.0, 0.0], speed=1.0)]
    assert differences(stored, returned) == {}
    assert differences(stored, [node("a", 0, 0)]) == {"a": ["orientation", "speed"]}
    own = {"tags": {"speed": 1}, "orientation": [0.0, 0.0, 1.0, 0.0]}
    assert differences(stored, [node("a", 0, 0, kml=own)]) == {}, "they come back as the format's own"
    assert differences(stored, [node("a", 0, 0, kml={"tags": {"speed": 2}})]) == {"a": ["orientation", "speed"]}


@pytest.mark.parametrize(
    ("a", "b", "equal"),
    [
        (1, 1.0, True),
        (1.0, 1.0000005, True),
        (1.0, 1.00001, False),
        (True, 1, False),
        (True, "true", False),
        ({"a": [1, {"b": 0.1}]}, {"a": [1, {"b": 0.1 + 1e-9}]}, True),
        ({"a": 1}, {"a": 1, "b": 2}, False),
        ([1, 2], [1], False),
        ("x", "x", True),
        ("1", 1, False),
        (None, 0, False),
    ],
)
def test_values_are_equal_up_to_noise(a: Any, b: Any, equal: bool) -> None:
    assert is_equal(a, b) is equal
    assert is_equal(b, a) is equal
