"""Maps from layers: what their reports say."""

from __future__ import annotations

import pytest
import shapely

from app import formats
from app.convert import make
from app.model.features import features
from app.model.frame import Datum
from app.model.layers import NETWORK, Layers, PartKey

PLANNED = ("tmap2", "nav2_route", "rmf_nav_graph", "openrmf", "lif", "navgraph", "osm", "lanelet2")


def network(**said: object) -> Layers:
    rows = [
        ("a", shapely.Point(0, 0), {"kind": "node", "name": "a"}),
        ("b", shapely.Point(5, 0), {"kind": "node", "name": "b"}),
        ("a_b", shapely.LineString([(0, 0), (5, 0)]), {"kind": "edge", "source": "a", "target": "b", **said}),
        ("b_a", shapely.LineString([(5, 0), (0, 0)]), {"kind": "edge", "source": "b", "target": "a"}),
    ]
    return Layers({PartKey("topology", "ground", NETWORK): features(rows, "local")}, Datum(53.2, -0.5))


def warned(name: str, layers: Layers) -> list[str]:
    report = make.from_layers(formats.get_format(name), layers, {}, derived=False).report
    return [w["problem"] for w in report["warnings"] if "blocked" in w["problem"]]


@pytest.mark.parametrize("name", PLANNED)
def test_a_blocked_edge_is_told_of_where_planners_do_not_read_of_it(name: str) -> None:
    (told,) = warned(name, network(blocked=True, blocked_until="2030-01-01T00:00:00Z"))
    assert told.startswith("1 edges are blocked")
    assert name in told
    assert warned(name, network()) == []
    assert warned(name, network(blocked=False)) == []


def test_a_package_tells_it_once_for_each_map_in_it() -> None:
    told = warned("environment", network(blocked=True))
    assert told
    assert len(told) == len(set(told))


def test_formats_that_nobody_plans_on_say_it_themselves() -> None:
    layers = network(blocked=True)
    assert warned("geojson", layers) == []
    made = make.from_layers(formats.get_format("geojson"), layers, {}, derived=False).files
    assert b'"blocked":true' in b"".join(made.values())
