"""Provenance graph: files, layers and maps."""

from __future__ import annotations

from pathlib import Path

from lxml import etree

from tests.api import samples
from tests.api.conftest import Api
from tests.api.test_derivations import DATUM, lanes


def test_graph_links_files_layers_and_maps(api: Api, fresh: object) -> None:
    api.post("environments", {"name": "traced", "datum": DATUM})
    api.upload("traced", lanes())
    api.post("environments/traced/derivations", {"method": "objects_to_topology"})
    address = "environments/traced/versions/{}/provenance"
    provenance = api.get(address.format("latest"), headers={"accept": "application/json"}).json()
    links = {(link["from"], link["to"]) for link in provenance["links"]}
    assert ("source:lanes.kml", "part:objects/ground/kml") in links
    assert ("part:objects/ground/kml", "part:topology/ground/network") in links
    assert ("part:topology/ground/network", "map:tmap2") in links
    assert not any(part["stale"] for part in provenance["parts"])
    api.upload("traced", lanes("0.002,0.002"))
    provenance = api.get(address.format("latest"), headers={"accept": "application/json"}).json()
    stale = {part["id"]: part["stale"] for part in provenance["parts"]}
    assert stale["part:topology/ground/network"] == ["objects ground/kml"]
    picture = api.get(address.format("latest"))
    assert picture.headers["content-type"] == "image/svg+xml"
    root = etree.fromstring(picture.content)
    texts = [e.text for e in root.iter("{http://www.w3.org/2000/svg}text")]
    assert "lanes.kml" in texts
    assert "stale: objects ground/kml" in texts
    assert "tmap2" in texts


def test_svg_escapes_names(api: Api, bare: str) -> None:
    api.upload(bare, {"a<b>&\"'.tmap2.yaml": samples.tmap2()})
    etree.fromstring(api.get(f"environments/{bare}/versions/1/provenance").content)


def test_command_line_writes_the_graph(api: Api, tmp_path: Path) -> None:
    from app.cli import run

    api.post("environments", {"name": "drawn", "datum": DATUM})
    api.upload("drawn", lanes())
    target = tmp_path / "p.svg"
    arguments = ["coverage", "drawn", "--picture", str(target), "--server", api.url, "--token", api.token]
    assert run(arguments) == 0
    assert etree.fromstring(target.read_bytes()).tag.endswith("svg")
