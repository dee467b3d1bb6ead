"""Sites for tests of the OGC API: the demo, streets, a building with levels, a turned site, terrain, one nowhere."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx

from app.cli import demo
from app.cli.client import Client
from tests.api import samples
from tests.api.conftest import ADMIN, Api

ON_EARTH = ("orchard", "zoo", "hotel", "turned", "terrain")
NOWHERE = "nowhere"
TURNED_DATUM = {"latitude": 53.2686, "longitude": -0.5245, "altitude": 0.0, "heading": 30.0}

SHAPES = {
    "well": {"type": "Point", "coordinates": [3.0, 4.0]},
    "trees": {"type": "MultiPoint", "coordinates": [[1.0, 1.0], [2.0, 1.0]]},
    "hose": {"type": "LineString", "coordinates": [[0.0, 0.0], [20.0, 0.0], [20.0, 5.0]]},
    "shed": {"type": "Polygon", "coordinates": [[[5.0, 5.0], [9.0, 5.0], [9.0, 8.0], [5.0, 8.0], [5.0, 5.0]]]},
}
"""Objects of the turned site in local metres."""


def local_geojson(shapes: dict[str, Any], kinds: str) -> bytes:
    """Write GeoJSON in local metres."""
    features = [
        {"type": "Feature", "id": name, "properties": {"kind": kinds, "name": f"the {name}", "level": "odd", "rank": k},
         "geometry": None, "place": shape}
        for k, (name, shape) in enumerate(shapes.items())
    ]  # fmt: skip
    head = {"type": "FeatureCollection", "coordRefSys": "https://www.opengis.net/def/crs/OGC/0/Engineering2D"}
    return json.dumps({**head, "features": features}).encode()


def create_turned(api: Api, name: str, datum: dict[str, float] = TURNED_DATUM) -> None:
    """Create a site whose +y axis points 30 degrees east of north, or as its datum says."""
    api.post("environments", {"name": name, "title": "Turned <site>", "datum": datum})
    api.upload(name, {"network.tmap2.yaml": samples.tmap2()})
    api.upload(name, {"things.geojson": local_geojson(SHAPES, "thing")}, layer="objects", format="geojson")
    grid = samples.grid(width=40, height=30)
    grid["map.yaml"] = grid["map.yaml"].replace(b"0.0]", b"0.4]")
    api.upload(name, grid)
    zone = {"wet": SHAPES["shed"]}
    api.upload(name, {"zones.geojson": local_geojson(zone, "keepout")}, layer="zones", format="geojson", mode="merge")


def create_sites(api: Api, shared: Path) -> None:
    """Create all sites."""
    with Client(api.url, ADMIN) as client:
        demo.install(client)
    api.post("environments", {"name": "zoo"})
    api.upload("zoo", {"map.osm": (shared / "data/osm/urban-usa-mn-minnesota-zoo/osm.xml").read_bytes()})
    folder = shared / "data/openrmf_building/hotel"
    api.post("environments", {"name": "hotel", "datum": {"latitude": 1.3, "longitude": 103.85}})
    api.upload("hotel", {path.name: path.read_bytes() for path in folder.iterdir()})
    create_turned(api, "turned")
    api.upload("turned", {"color.ot": (shared / "data/octomap/synthetic_color/color.ot").read_bytes()})
    api.post("environments", {"name": "terrain", "datum": {"latitude": 38.81, "longitude": -77.05}})
    api.upload("terrain", {"network.tmap2.yaml": samples.tmap2()})
    api.upload("terrain", {"dtm.tif": (shared / "data/geotiff/opengeos_dtm/dtm.tif").read_bytes()})
    api.post("environments", {"name": NOWHERE})
    api.upload(NOWHERE, {"network.tmap2.yaml": samples.tmap2()})


@dataclass
class Ogc:
    """Client of one site's service, which follows absolute links only."""

    http: httpx.Client
    root: str

    def get(self, url: str, expect: int = 200, accept: str = "*/*", **params: Any) -> httpx.Response:
        """Request an absolute URL; further parameters are added to its query."""
        full = httpx.URL(url).copy_merge_params({k.replace("_", "-"): str(v) for k, v in params.items()})
        answer = self.http.get(full, headers={"accept": accept})
        assert answer.status_code == expect, f"{full}: {answer.status_code} {answer.text[:1000]}"
        return answer

    def landing(self) -> dict[str, Any]:
        body: dict[str, Any] = self.get(self.root).json()
        return body

    def collections(self) -> list[dict[str, Any]]:
        """Return the collections."""
        listed: list[dict[str, Any]] = self.get(link(self.landing(), "data")).json()["collections"]
        return listed

    def items_url(self, collection: dict[str, Any]) -> str:
        return link(collection, "items", "application/geo+json")

    def all_items(self, url: str, **params: Any) -> list[dict[str, Any]]:
        """Follow the pages from a URL; return all features."""
        out: list[dict[str, Any]] = []
        page = self.get(url, **params).json()
        while True:
            out += page["features"]
            following = [one["href"] for one in page["links"] if one["rel"] == "next"]
            if not following:
                return out
            page = self.get(following[0]).json()


def link(document: dict[str, Any], rel: str, media_type: str | None = None) -> str:
    """Return the only link of a document with a relation and a media type."""
    hrefs = [one["href"] for one in document["links"] if one["rel"] == rel and media_type in (None, one["type"])]
    assert len(hrefs) == 1, (rel, media_type, document["links"])
    assert hrefs[0].startswith("http")
    return str(hrefs[0])
