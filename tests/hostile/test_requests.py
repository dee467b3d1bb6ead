"""Invalid requests in valid JSON are rejected with a problem, and nothing is stored."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.api.conftest import Api, running, settings_for
from tests.hostile.corpus import network_cases, room

CELLS = {"op": "cells", "grid": "room", "crs": "local", "value": 100}


@pytest.fixture(scope="module")
def api(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Api]:
    folder: Path = tmp_path_factory.mktemp("server")
    with running(settings_for(folder)) as api:
        api.post("environments", {"name": "farm"})
        api.upload("farm", room())
        yield api


def invalid_requests() -> Iterator[tuple[str, str, Any, str]]:
    """Yield method, path, JSON, and a word of the error."""
    for time in ("9999-12-31T23:59:59-23:59", "0001-01-01T00:00:00+23:59"):
        yield "PUT", "environments/farm/channels/staging", {"version": 1, "activate_at": time}, ""
        yield "POST", "tokens", {"name": "a", "role": "viewer", "expires": time}, ""
    for rings in (
        [[[0, 0], [1e308, 0], [5, 5], [0, 0]]],
        [[[-1e300, -1e300], [1e300, -1e300], [0, 1e300], [-1e300, -1e300]]],
        [],
    ):
        change: Any = {**CELLS, "polygon": {"type": "Polygon", "coordinates": rings}}
        yield "POST", "environments/farm/edits", {"message": "", "changes": [change]}, ""
    value: Any = 1
    for _ in range(400):
        value = [value]
    point = {"type": "Point", "coordinates": [0, 0]}
    feature = {"type": "Feature", "id": "d", "geometry": point, "properties": {"x": value}}
    change = {"op": "put", "layer": "objects", "crs": "local", "feature": feature}
    yield "POST", "environments/farm/edits", {"message": "", "changes": [change]}, "nested"
    yield "GET", "environments?q=%00", None, ""


def test_invalid_requests_are_rejected_and_store_nothing(api: Api) -> None:
    for method, path, body, word in invalid_requests():
        assert word in api.problem(method, path, 422, json=body)["detail"]
    assert api.get("environments/farm").json()["version"] == 1


@pytest.mark.parametrize("origin", [[], {}, 5, None, True])
def test_edit_with_properties_of_other_types(api: Api, origin: Any) -> None:
    api.post("environments", {"name": "odd", "datum": {"latitude": 50.0, "longitude": 7.0}})
    try:
        node = {
            "type": "Feature",
            "id": "n",
            "geometry": {"type": "Point", "coordinates": [7.0, 50.0]},
            "properties": {"kind": "node", "drawn_from": origin, "name": origin, "orientation": origin},
        }
        change = {"op": "put", "layer": "topology", "feature": node}
        api.post("environments/odd/edits", {"message": "", "changes": [change]})
        for name in ("kml", "kmz", "geojson", "osm", "tmap2"):
            answer = api.get(f"environments/odd/versions/latest/maps/{name}", None)
            assert answer.status_code < 500, f"{name}: {answer.text}"
    finally:
        api("DELETE", "environments/odd")
        api("POST", "environments/odd/purge")


def test_hostile_networks_are_rejected_or_stored(api: Api) -> None:
    """Plain YAML networks are rejected with a location or stored, never a server error.

    Stored ones can be downloaded in their own format.
    """
    stored = 0
    for k, case in enumerate(network_cases()):
        env = f"hostile-{k}"
        api.post("environments", {"name": env})
        format_option = {"format": case.format} if case.format else {}
        answer = api.upload(env, case.files, expect=None, **format_option)
        assert answer.status_code in (200, 201, 422), f"{case.name}: {answer.status_code} {answer.text[:300]}"
        if answer.status_code == 422:
            assert case.verdict != "read", case.name
            assert all(e["problem"] for e in answer.json()["errors"]), case.name
            continue
        assert case.verdict != "refused", case.name
        stored += 1
        if case.format and answer.json()["changes"]:
            back = api.get(f"/maps/{env}/{case.format}", expect=None)
            if back.status_code == 202:  # a slow machine
                api.finished(back.json())
                back = api.get(f"/maps/{env}/{case.format}", expect=None)
            assert back.status_code in (200, 404, 422), f"{case.name}: {back.status_code} {back.text[:300]}"
    assert stored > 20
