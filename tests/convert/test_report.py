"""A report is unchanged by a round trip through JSON."""

from __future__ import annotations

import orjson

from app.convert.closures import ClosureLine
from app.convert.report import LayerLine, Report
from app.errors import Problem
from app.model.notes import Dropped, Filled, Notes

FULL = Report(
    "tmap2",
    (LayerLine("topology", "ground", "network", "derived", ({"step": "a"},), ("a.kml",), ("© Somebody",)),),
    ("© Somebody",),
    (Filled("width", [1.5], "none is given", "width", "geojson", "request"), Filled("name", None, "none is given")),
    (Dropped("zones", 2, "no place"),),
    (Problem("turned", "map.yaml", 3, "origin", "warning"), Problem("blank")),
    (ClosureLine("1", "ground", "2030-01-01T00:00:00Z", "left out 1 edge", ("a_b",), "a_b"),),
    7,
)


def test_report_survives_json() -> None:
    for report in (FULL, Report("kml")):
        assert Report.from_dict(orjson.loads(orjson.dumps(report.as_dict()))) == report


def test_report_json_omits_members_without_a_value() -> None:
    assert list(Report("kml").as_dict()) == [
        "format",
        "layers",
        "attribution",
        "template",
        "dropped",
        "warnings",
        "closures",
    ]
    assert Filled("width", 1, "why").as_dict() == {"what": "width", "value": 1, "why": "why"}
    assert list(FULL.as_dict()["template"][0]) == ["what", "value", "why", "option", "format", "from"]
    assert list(FULL.as_dict()["closures"][0]) == ["id", "level", "expires", "edge", "effect", "edges"]


def test_notes_become_warnings_of_a_version() -> None:
    notes = Notes()
    notes.warn("turned", where="L2")
    notes.drop("zones", 2, "no place")
    notes.drop("nothing", 0, "no place")
    notes.fill("width", 1.5, "none is given")
    assert notes.as_warnings() == (
        Problem("turned", where="L2"),
        Problem("dropped: 2 zones: no place"),
        Problem("filled in: width = 1.5: none is given"),
    )
