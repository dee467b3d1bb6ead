"""Upload and download of real maps over HTTP, on both databases, keep their information."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyproj import Transformer

from app.store.store import Store
from app.syntax import archives
from tests.api.conftest import Api, running, settings_for
from tests.postgres import Cluster

SHARED = Path(__file__).resolve().parents[2] / "shared"
KINDS = {
    "datum": "datum",
    "tmap2": "tmap2",
    "kml": "kml",
    "kmz": "kmz",
    "osm_xml": "osm",
    "occupancy_map_yaml": "occupancy_grid",
    "openrmf_building": "openrmf",
    "rmf_nav_graph": "rmf_nav_graph",
    "fawkes_navgraph": "navgraph",
    "nav2_route_graph": "nav2_route",
    "lif": "lif",
    "geotiff": "satellite",
    "sdf": "gazebo",
}

REFUSED = {
    "geotiff/rasterio/corrupt.tif": "damaged tile data",
    "kml/libkml/billion.kml": "entity expansion attack",
    "kmz/libkml/bad-too-large.kmz": "declares 4 GiB",
    "kmz/libkml/nokml.kmz": "no KML in it",
    "kmz/libkml/overflow_bad_offset.kmz": "damaged archive",
    **{
        f"osm/osm-testdata-xml/{name}/data.osm": "must fail, says its own result file"
        for name in (
            "101-missing_version",
            "104-empty_file",
            "105-incomplete_xml_file",
            "106-invalid_xml_file",
            "107-wrongly_nested_xml_file",
            "109-unknown_data_level",
            "110-entity_declaration",
        )
    },
}
UNCOMPARED = {
    "kml/libkml/all-unknown-input.kml": "the comparator cannot read it; the format's own tests compare the tree"
}

Same = Callable[[str, dict[str, bytes], dict[str, bytes]], list[str]]


def samples() -> list[Any]:
    """Return every real file for SQLite; for PostgreSQL, which stores the same chunks, the largest of each kind."""
    path = SHARED / "data" / "facts.json"
    if not path.is_file():
        return [pytest.param("sqlite", "", "", id="absent")]
    facts = json.loads(path.read_text())["files"]
    maps = {n: e for n, e in facts.items() if e["kind"] in KINDS and (e["kind"] != "sdf" or e["facts"]["worlds"])}
    accepted = sorted((n for n in maps if n not in REFUSED), key=lambda n: (path.parent / n).stat().st_size)
    largest = set({maps[n]["kind"]: n for n in accepted}.values())
    rows = [(database, n) for n in maps for database in ("sqlite", "postgres") if database == "sqlite" or n in largest]
    return [pytest.param(database, n, KINDS[maps[n]["kind"]], id=f"{database}-{n}") for database, n in rows]


@pytest.fixture(scope="module")
def server(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[str], Api]]:
    """Return a function: database -> its server, which runs until the end of the module."""
    with ExitStack() as stack:

        @cache
        def start(database: str) -> Api:
            folder = tmp_path_factory.mktemp("server")
            url = None
            if database == "postgres":
                cluster: Cluster = request.getfixturevalue("postgres_cluster")
                url = cluster.url(cluster.create_database())
                store = Store(url, folder / "blobs")
                store.migrate()
                store.close()
            return stack.enter_context(running(settings_for(folder, database_url=url)))

        yield start


@pytest.fixture(params=["sqlite", "postgres"])
def api(request: pytest.FixtureRequest, server: Callable[[str], Api]) -> Api:
    """A module's fixture would be set up for each sample: pytest parametrizes it together with direct arguments."""
    return server(request.param)


def files_of(data: Path, name: str, kind: str) -> dict[str, bytes]:
    path = data / name
    if kind == "gazebo":  # a world with all files below its folder, or beside the folder of the worlds
        root = path.parent.parent if path.parent.name == "worlds" else path.parent
        paths = [p for p in root.rglob("*") if p == path or (p.is_file() and p.parent != path.parent)]
        return {p.relative_to(root).as_posix(): p.read_bytes() for p in paths}
    if kind != "occupancy_grid":
        return {path.name: path.read_bytes()}
    paths = [p for p in path.parent.rglob("*") if p == path or p.suffix.lower() in (".pgm", ".png")]
    return {p.relative_to(path.parent).as_posix(): p.read_bytes() for p in paths}


def download(api: Api, env: str, kind: str) -> dict[str, bytes]:
    """Download all files of a map, by the short URL for robots."""
    import io
    import zipfile

    answer = api.get(f"/maps/{env}/{kind}")
    if answer.headers["content-type"] == "application/zip" and kind != "kmz":
        with zipfile.ZipFile(io.BytesIO(answer.content)) as z:
            return {n: z.read(n) for n in z.namelist()}
    name = answer.headers["content-disposition"].partition('filename="')[2].rstrip('"')
    return {name: answer.content}


@pytest.mark.parametrize(("api", "name", "kind"), samples(), indirect=["api"])
def test_samples_keep_their_information(
    api: Api, shared: Path, same: Same, name: str, kind: str, request: pytest.FixtureRequest
) -> None:
    env = f"s{abs(hash(name)) % 10**12}"
    api.post("environments", {"name": env})
    files = files_of(shared / "data", name, kind)
    if name in REFUSED:
        problem = api.upload(env, files, expect=None, format=kind)
        assert 400 <= problem.status_code < 500, REFUSED[name]
        assert problem.json()["errors"]
        assert api.get(f"environments/{env}").json()["version"] == 0, "a rejected upload stores nothing"
        return
    api.upload(env, files, format=kind)
    sources = api.get(f"environments/{env}/versions/latest/sources").json()
    assert {s["name"] for s in sources} == set(files)
    for source in sources[:3]:
        response = api.get(f"environments/{env}/versions/latest/sources/{source['name']}")
        assert response.content == files[source["name"]], "the original is stored byte for byte"
    back = download(api, env, kind)
    if name not in UNCOMPARED:
        assert same(kind, files, back) == []


TEMPLATES = [
    "indoor-agilex-limo-track",
    "riseholme_park_farm_general_east_pathway",
    "riseholme_park_farm_strawberry_polytunnels",
    "riseholme_park_farm_vineyard",
]


@pytest.mark.parametrize(
    ("api", "name"), [("postgres", TEMPLATES[1]), *(("sqlite", name) for name in TEMPLATES)], indirect=["api"]
)
def test_template_folder_is_one_version(api: Api, shared: Path, same: Same, name: str) -> None:
    root = shared / "data" / "environment_template" / name
    files = {p.relative_to(root).as_posix(): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}
    env = name.replace("_", "-")
    api.post("environments", {"name": env})
    version = api.upload(env, files).json()
    assert version["version"] == 1
    assert {s["name"] for s in version["sources"]} == set(files)
    used = {s["name"] for s in version["sources"] if s["used"]}
    for grid in {n.split("/")[2] for n in used if n.startswith("config/metric/") and n.endswith(".yaml")}:
        answer = {n: api.get(f"/maps/{env}/occupancy_grid/{n}").content for n in (f"{grid}.yaml", f"{grid}.pgm")}
        original = {n.rpartition("/")[2]: d for n, d in files.items() if f"/metric/{grid}/" in n and n in used}
        assert same("occupancy_grid", original, answer) == []
    if any(n.endswith("network.tmap2.yaml") for n in files):
        network = next(n for n in used if "topological" in n and n.endswith(".tmap2.yaml"))
        assert same("tmap2", {"a.tmap2.yaml": files[network]}, download(api, env, "tmap2")) == []
    if any("datum" in n for n in used):
        site = next(n for n in used if "datum" in n)
        assert same("datum", {"datum.yaml": files[site]}, download(api, env, "datum")) == []


def names_in(package: bytes) -> list[str]:
    return zipfile.ZipFile(io.BytesIO(package)).namelist()


@pytest.mark.parametrize("api", ["sqlite"], indirect=True)
@pytest.mark.parametrize("name", TEMPLATES)
def test_template_is_exported_as_a_package(api: Api, shared: Path, same: Same, name: str) -> None:
    """A zipped upload and download keep the information, and equal an upload of the folder's files."""
    root = shared / "data" / "environment_template" / name
    files = {p.relative_to(root).as_posix(): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}
    env = f"zip-{name.replace('_', '-')}"
    api.post("environments", {"name": env})
    version = api.upload(env, {"site.zip": archives.pack(files)}, format="environment").json()
    loose = api.post("environments", {"name": f"{env}-loose"[:63]}).json()["name"]
    assert api.upload(loose, files).json()["root"] == version["root"]
    answer = api.get(f"/maps/{env}/environment")
    assert answer.headers["content-type"] == "application/zip"
    assert answer.headers["content-disposition"] == 'attachment; filename="environment.zip"'
    other = api.get(f"/maps/{loose}/environment/environment.zip").content
    assert names_in(other) == names_in(answer.content), "maps differ only by the environment's name"
    assert same("environment", files, {"environment.zip": answer.content}) == []
    report = api.get(f"environments/{env}/versions/latest/reports/environment").json()
    layers = {e["layer"] for e in api.get(f"environments/{env}/versions/latest/layers").json() if e["count"]}
    assert {line["layer"] for line in report["layers"]} >= layers - {"resources"}


@pytest.mark.parametrize("api", ["sqlite"], indirect=True)
def test_coordinates_agree_with_proj(api: Api, shared: Path, facts_json: dict[str, Any]) -> None:
    """Compare OSM nodes in the local frame of a tmap2 with PROJ's own transverse Mercator."""
    name = "osm/urban-usa-mn-minnesota-zoo/osm.xml"
    api.post("environments", {"name": "zoo"})
    version = api.upload("zoo", {"osm.xml": (shared / "data" / name).read_bytes()}).json()
    counted = facts_json[name]["facts"]
    nodes = api.get("environments/zoo/versions/1/layers/topology?crs=wgs84").json()["features"]
    local = api.get("environments/zoo/versions/1/layers/topology?crs=local").json()["features"]
    assert sum(f["properties"]["kind"] == "node" for f in nodes) == counted["distinct_nodes_used_by_highway_ways"]
    datum = api.get("environments/zoo").json()["datum"]
    assert (datum["latitude"], datum["longitude"]) == (44.7644, -93.2073), "the south-west corner of <bounds>"
    assert any("south-west corner" in w["problem"] for w in version["warnings"])
    pipe = f"+proj=tmerc +lat_0={datum['latitude']} +lon_0={datum['longitude']} +k=1 +ellps=WGS84"
    proj = Transformer.from_crs("EPSG:4326", pipe, always_xy=True)
    place = {f["id"]: f for f in local}
    earth = np.array([f["geometry"]["coordinates"][:2] for f in nodes if f["properties"]["kind"] == "node"])
    metres = [place[f["id"]] for f in nodes if f["properties"]["kind"] == "node"]
    local_xy = np.array([(f.get("place") or f["geometry"])["coordinates"][:2] for f in metres])
    truth = np.column_stack(proj.transform(earth[:, 0], earth[:, 1]))
    assert np.abs(local_xy - truth).max() < 1e-6


@pytest.mark.parametrize("api", ["sqlite"], indirect=True)
@pytest.mark.parametrize("way", [["kml"], ["geojson"], ["kml", "geojson"], ["geojson", "kml"], ["kmz"]])
def test_network_keeps_every_node_edge_and_attribute_through_formats(
    api: Api, shared: Path, same: Same, way: list[str]
) -> None:
    """Convert tmap2 → kml, geojson … → tmap2."""
    path = shared / "data/environment_template/riseholme_park_farm_strawberry_polytunnels/config/topological"
    original = {"network.tmap2.yaml": (path / "network.tmap2.yaml").read_bytes()}
    env = "way-" + "-".join(way)
    datum = {"latitude": 53.268642038, "longitude": -0.524509505881}
    api.post("environments", {"name": env, "datum": datum})
    api.upload(env, original)
    for k, kind in enumerate(way):
        files = download(api, env, kind)
        env = f"{env}-{k}"
        api.post("environments", {"name": env, "datum": datum})
        api.upload(env, files, format=kind)
    assert same("tmap2", original, download(api, env, "tmap2")) == []
