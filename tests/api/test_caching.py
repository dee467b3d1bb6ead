"""Conditional and partial requests, header by header."""

from __future__ import annotations

import pytest

from app.api.http.caching import Unsatisfiable, byte_range, content_disposition, match, none_match

TAG = '"abc"'


@pytest.mark.parametrize(
    ("header", "matches"),
    [
        (None, False),
        ('"abc"', True),
        ('W/"abc"', True),
        ('"x", "abc"', True),
        ('"x","y" , W/"abc"', True),
        ("*", True),
        (" * ", True),
        ('"x"', False),
        ("abc", False),
        ("", False),
        ('"x" garbage "abc"', False),
        ('"a,b", "abc"', True),
    ],
)
def test_if_none_match_compares_weakly(header: str | None, matches: bool) -> None:
    assert none_match(header, TAG) is matches


@pytest.mark.parametrize(
    ("header", "matches"),
    [(None, True), ("*", True), ('"abc"', True), ('W/"abc"', False), ('"x", "abc"', True), ('"x"', False)],
)
def test_if_match_compares_strongly(header: str | None, matches: bool) -> None:
    assert match(header, TAG) is matches


@pytest.mark.parametrize(
    ("header", "expected"),
    [
        (None, None),
        ("bytes=0-9", (0, 10)),
        ("bytes=5-", (5, 100)),
        ("bytes=-10", (90, 100)),
        ("bytes=-1000", (0, 100)),
        ("bytes=90-1000", (90, 100)),
        ("Bytes = 0-0", (0, 1)),
        ("bytes=100-", Unsatisfiable()),
        ("bytes=-0", Unsatisfiable()),
        ("bytes=9-5", None),
        ("bytes=0-1,5-6", None),
        ("lines=0-1", None),
        ("bytes=", None),
        ("bytes=-", None),
        ("bytes=a-b", None),
        ("bytes=0-" + "9" * 40, None),
    ],
)
def test_byte_range_parses_single_ranges(header: str | None, expected: tuple[int, int] | Unsatisfiable | None) -> None:
    assert byte_range(header, None, TAG, 100) == expected


def test_if_range_requires_the_current_etag() -> None:
    assert byte_range("bytes=0-9", TAG, TAG, 100) == (0, 10)
    assert byte_range("bytes=0-9", '"old"', TAG, 100) is None
    assert byte_range("bytes=0-9", f"W/{TAG}", TAG, 100) is None


def test_ranges_of_an_empty_file_are_unsatisfiable() -> None:
    assert byte_range("bytes=0-", None, TAG, 0) == Unsatisfiable()
    assert byte_range("bytes=-1", None, TAG, 0) == Unsatisfiable()


def test_content_disposition_quotes_file_names() -> None:
    assert content_disposition("a/b/map.yaml") == 'attachment; filename="map.yaml"'
    assert content_disposition('x"y.kml') == "attachment; filename=\"x_y.kml\"; filename*=UTF-8''x%22y.kml"
    assert content_disposition("Höhe.kml") == "attachment; filename=\"H_he.kml\"; filename*=UTF-8''H%C3%B6he.kml"
    assert "\n" not in content_disposition("a\r\nX: y")
