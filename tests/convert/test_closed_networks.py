"""Close one edge of each real network: the map loses this edge and nothing else."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest

from app import formats
from app.convert import worker
from app.formats import Files, ReadContext
from app.model.closures import Closure, Closures
from app.model.frame import Datum
from app.model.geodesy import local_frame
from app.model.layers import Layers

DATUM = Datum(44.97, -93.2)
NETWORKS = (
    ("tmap2", "environment_template"),
    ("tmap", "tmap2/legacy_tmap_bacchus_vines"),
    ("nav2_route", "nav2_route_graph/nav2_route"),
    ("navgraph", "navgraph/robotino_llsf"),
    ("rmf_nav_graph", "rmf_nav_graph/generated_hotel"),
    ("openrmf", "openrmf_building/hotel"),
    ("lif", "lif"),
    ("lanelet2", "lanelet2/fzi_mapping_example"),
    ("osm", "osm/urban-usa-mn-minnesota-zoo"),
)


def groups_in(folder: Path, name: str) -> list[formats.FileGroup]:
    """Group the maps of a format below a folder, folder by folder."""
    out: list[formats.FileGroup] = []
    for place in [folder, *sorted(p for p in folder.rglob("*") if p.is_dir())]:
        files = {f.name: f.read_bytes() for f in sorted(place.iterdir()) if f.is_file()}
        if files:
            out += formats.group(files, name)[0]
    return out


def read(group: formats.FileGroup) -> Layers:
    layers = formats.read(group, ReadContext(frame=local_frame(DATUM)))
    return layers if layers.datum is not None else replace(layers, datum=DATUM)


def edges(layers: Layers) -> dict[tuple[str, str], tuple[str, str, str]]:
    """Map (level, id) of each edge to level, source and target."""
    return {
        (key.level, i): (key.level, str(p["source"]), str(p["target"]))
        for key, part in layers.vector("topology").items()
        for i, p in zip(part.ids, part.properties, strict=True)
        if p.get("kind") == "edge"
    }


def edges_in(name: str, files: Files) -> Counter[tuple[str, str, str]]:
    return Counter(v for group in formats.group(files, name)[0] for v in edges(read(group)).values())


@pytest.mark.parametrize(("name", "folder"), NETWORKS, ids=[name for name, _ in NETWORKS])
def test_map_of_real_network_loses_the_closed_edge_alone(shared: Path, name: str, folder: str) -> None:
    readable = []
    for group in groups_in(shared / "data" / folder, name):
        try:
            layers = read(group)
        except formats.FleetMapError:
            continue
        if len(edges(layers)) > 2:
            readable.append(layers)
    assert readable, f"no network of {name} in the real maps"
    layers = readable[0]
    level, edge = sorted(edges(layers))[len(edges(layers)) // 2]
    fmt = formats.get_format(name)
    closures = Closures((Closure("c", "blocked", level, "2030-01-01T00:00:00Z", edge=edge),))
    closed = worker.from_layers(fmt, layers, {}, derived=False, closures=closures)
    complete = worker.from_layers(fmt, layers, {}, derived=False, closures=Closures())
    before, after = edges_in(name, complete.files), edges_in(name, closed.files)
    assert before - after == Counter([edges(layers)[level, edge]])
    assert not after - before
    assert closed.report.as_dict()["closures"] == [
        {"id": "c", "level": level, "expires": "2030-01-01T00:00:00Z", "edge": edge, "effect": "left out 1 edge",
         "edges": [edge]}
    ]  # fmt: skip
