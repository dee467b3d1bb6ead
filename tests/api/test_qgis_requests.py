"""The requests of QGIS 3.40.6 (Debian 13), recorded while it edited the demo through its provider, sent again.

It changed the geometry and an attribute of an edge, added a node and an edge, and deleted that edge:
``qgis_requests.json``. QGIS itself is too large for the automatic tests.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from app.cli import demo
from app.cli.client import Client
from tests.api.conftest import ADMIN, Api, running, settings_for

AGENT = "Mozilla/5.0 QGIS/34006/Debian GNU/Linux 13 (trixie)"
OK = {"GET": 200, "OPTIONS": 204, "PATCH": 204, "POST": 201, "DELETE": 204}


@pytest.fixture(scope="module")
def orchard(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Api]:
    """Run a server with the demo."""
    with running(settings_for(tmp_path_factory.mktemp("qgis"))) as api:
        with Client(api.url, ADMIN) as client:
            demo.install(client)
        yield api


def test_qgis_edits_gather_in_a_draft(orchard: Api) -> None:
    recorded = json.loads((Path(__file__).parent / "qgis_requests.json").read_text())
    assert {row["method"] for row in recorded} == set(OK)
    for row in recorded:
        headers = {"user-agent": AGENT} | {name: row[name] for name in ("accept", "content-type") if name in row}
        content = json.dumps(row["body"]) if "body" in row else None
        answer = orchard(row["method"], row["path"], OK[row["method"]], content=content, headers=headers)
        if row["method"] == "OPTIONS":
            has_id = not row["path"].endswith("/items")
            assert set(answer.headers["allow"].split(", ")) >= ({"PUT", "PATCH", "DELETE"} if has_id else {"POST"})
        if row["method"] == "POST":
            names = [name for name, _ in answer.headers.raw]
            assert b"Location" in names, "QGIS compares the name with its case"
    (draft,) = orchard.get("environments/orchard/drafts").json()
    assert draft["changes"] == {"topology": {"added": 1, "changed": 1, "deleted": 0}}
    at = f"environments/orchard/drafts/{draft['id']}/commit"
    version = orchard.post(at, {"message": "QGIS"}, headers={"if-match": f'"{draft["base"]}"'}).json()
    edge = orchard.get("/ogc/orchard/collections/edges/items/Dock1_Yard1").json()
    assert edge["properties"]["speed_limit"] == 0.7
    assert edge["geometry"]["coordinates"][1] == pytest.approx([5.6135407238365, 52.420554933127], abs=1e-11)
    node = orchard.get("/ogc/orchard/collections/nodes/items/from%20QGIS").json()
    assert node["geometry"]["coordinates"] == pytest.approx([5.613631, 52.420636], abs=1e-11)
    assert version["message"] == "QGIS"
