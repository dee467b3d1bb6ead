"""OpenStreetMap: independently counted facts, round trips, edits, irregular extracts, hostile bytes."""

from __future__ import annotations

import bz2
import gzip
import os
import random
import shutil
import subprocess
import tracemalloc
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import networkx
import numpy as np
import pytest
import shapely
from lxml import etree

from app import formats
from app.errors import BadUpload, MissingDatum, TooLarge, UnreadableFile
from app.formats import FileGroup, ReadContext, WriteContext, osm
from app.formats.osm import scanning
from app.formats.osm.elements import Data
from app.formats.osm.scanning import scan
from app.formats.osm.strict import read_events
from app.formats.osm.tags import direction
from app.limits import Limits
from app.model.features import Features, features
from app.model.frame import Datum, Level
from app.model.geodesy import local_frame
from app.model.layers import NETWORK, SITE, ZONES, Layers, PartKey

SAMPLE = Path(__file__).parents[1] / "samples" / "osm" / "quarter.osm"
REAL = ("urban-usa-mn-minnesota-zoo", "urban-usa-fl-miami-subberbs", "urban-netherlands-subburbs")
TOPOLOGY, OBJECTS = PartKey("topology", "ground", NETWORK), PartKey("objects", "ground", "osm")


def read(data: bytes, context: ReadContext | None = None, **options: Any) -> Layers:
    fmt = formats.get_format("osm")
    return formats.read(FileGroup(fmt, "map.osm", {"map.osm": data}), context or ReadContext(**options))


def write(layers: Layers, context: WriteContext | None = None) -> bytes:
    (data,) = formats.write(formats.get_format("osm"), layers, context or WriteContext()).values()
    return data


def part(layers: Layers, key: PartKey) -> Features:
    content = layers.parts[key]
    assert isinstance(content, Features)
    return content


def network(layers: Layers) -> networkx.MultiDiGraph:
    graph = networkx.MultiDiGraph()
    for f in part(layers, TOPOLOGY):
        if f.properties["kind"] == "node":
            graph.add_node(f.id, at=f.geometry.coords[0])
    for f in part(layers, TOPOLOGY):
        if f.properties["kind"] == "edge":
            assert f.properties["source"] in graph
            assert f.properties["target"] in graph
            graph.add_edge(f.properties["source"], f.properties["target"], key=f.id)
    return graph


def xml(body: str, root: str = '<osm version="0.6">') -> bytes:
    return f"<?xml version='1.0' encoding='UTF-8'?>\n{root}\n{body}\n</osm>".encode()


def elements(data: bytes) -> dict[str, Any]:
    """Return elements as type + id -> (attributes, refs or members, tags)."""
    root = etree.fromstring(data)
    out = {}
    for e in root.iterchildren("node", "way", "relation"):
        inner = [dict(c.attrib) for c in e if c.tag != "tag"]
        out[e.tag[0] + e.get("id")] = (dict(e.attrib), inner, {t.get("k"): t.get("v") for t in e.iterchildren("tag")})
    return out


def refs(data: bytes, way: str) -> list[str]:
    return [m["ref"] for m in elements(data)[way][1]]


def check_with_osmium(data: bytes, folder: Path) -> None:
    tool = shutil.which("osmium")
    if tool is None:
        if os.environ.get("CI"):
            pytest.fail("osmium (osmium-tool) is absent")
        pytest.skip("osmium (osmium-tool) is absent")
    path = folder / "served.osm"
    path.write_bytes(data)
    subprocess.run([tool, "fileinfo", "-e", str(path)], check=True, capture_output=True)
    subprocess.run([tool, "check-refs", str(path)], check=True, capture_output=True)


# --- real extracts -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", REAL)
def test_real_extracts_match_counted_facts(name: str, shared: Path, facts_json: dict[str, Any]) -> None:
    path = f"osm/{name}/osm.xml"
    facts = facts_json[path]["facts"]
    layers = read((shared / "data" / path).read_bytes())
    graph = network(layers)
    assert graph.number_of_nodes() == facts["distinct_nodes_used_by_highway_ways"]
    undirected = {frozenset((a, b)) for a, b, _ in graph.edges}
    assert len(undirected) == facts["undirected_highway_edges"]
    assert networkx.number_weakly_connected_components(graph) == facts["highway_connected_components"]
    objects = part(layers, OBJECTS)
    highways = objects.select_kinds("highway")
    kinds = [p["osm"]["tags"]["highway"] for p, i in zip(highways.properties, highways.ids, strict=True) if i[0] == "w"]
    assert {k: kinds.count(k) for k in kinds} == facts["highway_kinds"]
    assert sum(i[0] == "w" for i in objects.ids) == facts["ways"]
    assert sum(i[0] == "r" for i in objects.ids) == facts["relations"]
    box = facts["bounds_element"]
    assert objects.document["bounds"] == [box["minlon"], box["minlat"], box["maxlon"], box["maxlat"]]
    assert "http://opendatacommons.org/licenses/odbl/1-0/" in objects.document["attribution"]
    # A two-way street is two edges; a one-way street is one, in the direction of its tags.
    directed = {(a, b) for a, b, _ in graph.edges}
    two_way = sum((b, a) in directed for a, b in directed)
    assert 0 < two_way < graph.number_of_edges()


@pytest.mark.parametrize("name", REAL)
def test_committed_datums_equal_corner_of_bounds(name: str, shared: Path, facts_json: dict[str, Any]) -> None:
    facts = facts_json[f"osm/{name}/datum_autogen.yaml"]["facts"]
    west, south, _, _ = part(read((shared / "data/osm" / name / "osm.xml").read_bytes()), TOPOLOGY).document["bounds"]
    assert [south, west] == [facts["datum_latitude"], facts["datum_longitude"]]


def test_dataset_network_matches_nodes_and_edges(shared: Path, facts: Any) -> None:
    folder = shared / "data/osm/urban-usa-mn-minnesota-zoo"
    theirs = facts.tmap2_nodes(facts.tmap2((folder / "network_autogen.tmap2.yaml").read_bytes()))
    graph = network(read((folder / "osm.xml").read_bytes(), requested_layers=frozenset({"topology"})))
    assert len(theirs) == graph.number_of_nodes()
    # Their names are not ours; their degrees and places are: (0, 0) is the datum, metres by their own rule.
    degrees = sorted(len({e["node"] for e in n["edges"]}) for n in theirs)
    ours = networkx.Graph(graph.to_undirected())
    assert sum(degrees) in range(2 * ours.number_of_edges() - 10, 2 * ours.number_of_edges() + 1)


@pytest.mark.parametrize("name", REAL)
def test_real_extracts_round_trip(name: str, shared: Path, same: Callable[..., list[str]], tmp_path: Path) -> None:
    data = (shared / "data/osm" / name / "osm.xml").read_bytes()
    layers = read(data)
    context = WriteContext()
    served = write(layers, context)
    assert same("osm", {"osm.xml": data}, {"map.osm": served}) == []
    assert context.dropped == []
    before, after = elements(data), elements(served)
    for key, (attributes, inner, tags) in before.items():
        numbers = {k: float(attributes.pop(k)) for k in ("lat", "lon") if k in attributes}
        assert numbers == {k: float(after[key][0].pop(k)) for k in numbers}
        assert (attributes, inner, tags) == after[key], key
    assert dict(etree.fromstring(data).attrib) == dict(etree.fromstring(served).attrib)
    assert write(read(served)) == served
    check_with_osmium(served, tmp_path)


@pytest.mark.parametrize("name", REAL)
def test_fast_and_strict_parsers_agree_and_skip_unrequested_content(name: str, shared: Path) -> None:
    data = (shared / "data/osm" / name / "osm.xml").read_bytes()
    quick, careful = scan(data, Limits(), False), read_events(data, Limits())
    assert quick is not None, "a file as the OSM server writes it is regular"
    assert quick.ids == careful.ids
    assert np.array_equal(quick.lonlat, careful.lonlat)
    assert (quick.tags, quick.ways, quick.relations) == (careful.tags, careful.ways, careful.relations)
    assert (quick.root, quick.bounds) == (careful.root, careful.bounds)
    assert all(quick.attributes(k) == careful.attributes(k) for k in range(len(quick.ids)))
    complete, less = read(data), read(data, requested_layers=frozenset({"topology"}))
    assert set(less.parts) == {TOPOLOGY}
    a, b = part(complete, TOPOLOGY), part(less, TOPOLOGY)
    assert (a.ids, a.properties, a.document) == (b.ids, b.properties, b.document)
    assert shapely.equals(a.geometry, b.geometry).all()


def contents(data: Data) -> Any:
    """Return all parsed content in comparable form."""
    nodes = [(i, at, data.tags.get(k), data.attributes(k)) for k, (i, at) in enumerate(zip(data.ids, data.lonlat.tolist(), strict=True))]  # fmt: skip  # noqa: E501
    return nodes, data.ways, data.relations, data.root, data.bounds


@pytest.mark.parametrize("piece", [1, 50, 300, 1000])
def test_nodes_are_scanned_in_pieces(piece: int, monkeypatch: pytest.MonkeyPatch) -> None:
    tag = '<tag k="natural" v="tree"/>'
    nodes = [
        f' <node id="{k}" version="{k % 3}" lat="{k / 7:.7f}" lon="-{k}"' + (f">{tag}</node>" if k % 4 == 0 else "/>")
        for k in range(1, 40)
    ]
    way = ' <way id="5" version="1">\n  <nd ref="1"/>\n  <nd ref="39"/>\n  <tag k="highway" v="path"/>\n </way>'
    text = "\n".join(['<?xml version="1.0" encoding="UTF-8"?>', '<osm version="0.6">', *nodes, way, "</osm>", ""])
    data = text.encode()
    reference = read_events(data, Limits())
    monkeypatch.setattr(scanning, "SCAN_BYTES", piece)
    pieces = scan(data, Limits(), False)
    assert pieces is not None
    assert len(pieces.ids) > 5
    assert contents(pieces) == contents(reference)


def test_attributes_of_many_name_lists_are_stored(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scanning, "PATTERNS", 3)
    monkeypatch.setattr(scanning, "MAX_CACHED_TEXTS", 2)
    names = ["version", "__class__", "__dict__", "user", "uid", "changeset", "x:y", "a.b-c"]
    rows = [f'<node id="{k}" {n}="{k} &amp; {n}" visible="true" lat="1.5" lon="{k}"/>' for k, n in enumerate(names, 1)]
    text = f'<?xml version="1.0" encoding="UTF-8"?>\n<osm version="0.6">\n{" ".join(rows)}\n</osm>'.encode()
    content = scan(text.replace(b"x:y", b"x_y"), Limits(), False)
    assert content is not None
    expected = [
        {n.replace(":", "_"): f"{k} & {n.replace(':', '_')}", "visible": "true"} for k, n in enumerate(names, 1)
    ]
    assert [content.attributes(k) for k in range(len(names))] == expected


def test_defective_files_are_read_as_intended(shared: Path, same: Callable[..., list[str]]) -> None:
    folder = shared / "data/osm/osm-testdata-xml"
    for case in sorted(folder.iterdir()):
        data = (case / "data.osm").read_bytes()
        result = (case / "result").read_text().strip() if (case / "result").exists() else ""
        if result == "invalid":
            with pytest.raises(UnreadableFile) as refused:
                read(data)
            assert refused.value.problems[0].problem, case.name
            assert refused.value.problems[0].line, case.name
        else:
            assert same("osm", {"a.osm": data}, {"b.osm": write(read(data))}) == [], case.name


def test_irregular_files_round_trip(shared: Path, same: Callable[..., list[str]], tmp_path: Path) -> None:
    paths = [*sorted((shared / "data/osm/osm-testdata-grid").rglob("data.osm")), SAMPLE]
    paths += sorted((shared / "data/lanelet2").rglob("*.osm"))
    assert len(paths) > 10
    for path in paths:
        data = path.read_bytes()
        served = write(read(data))
        assert same("osm", {"a.osm": data}, {"b.osm": served}) == [], path.name
    check_with_osmium(write(read((paths[0]).read_bytes())), tmp_path)


# --- a small extract with every oddity ---------------------------------------------------------------------------


def test_sample_network_matches_expected() -> None:
    context = ReadContext()
    layers = read(SAMPLE.read_bytes(), context)
    graph = network(layers)
    assert set(graph) == {"n1", "n2", "n3", "n4", "n5", "n9000000000"}
    assert {k for _, _, k in graph.edges} == {
        *("w100:1-2", "w100:2-1", "w100:2-3", "w100:3-2"),
        *("w101:2-4", "w101:4-9000000000", "w102:5-4"),
        *("w103:3-5", "w103:5-3", "w103:5-3#2", "w103:3-5#2"),
    }
    assert graph.nodes["n2"]["at"] == (7.001, 50.0)
    properties = {f.id: f.properties for f in part(layers, TOPOLOGY)}
    assert properties["n2"]["osm"]["tags"] == {"highway": "traffic_signals"}
    assert properties["n3"]["osm"]["attributes"]["user"] == 'Zoë & "Co"'
    assert properties["w100:1-2"]["osm"] == {"way": 100, "tags": {"highway": "residential", "name": "Straße"}}
    texts = " ".join(f"{p.where} {p.problem}" for p in context.warnings)
    for expected in ("way 103 the way repeats a node directly", "way 106 the way is marked as deleted"):
        assert expected in texts
    assert "2 nodes that have no position" in texts
    assert "node 7 the node has no position" in texts
    assert "way 105 the way has no nodes" in texts


def test_sample_objects_match_expected() -> None:
    objects = {f.id: f for f in part(read(SAMPLE.read_bytes()), OBJECTS)}
    assert set(objects) == {"n-3", "n7", "n22", *(f"w{i}" for i in (*range(100, 107), 200, 201)), "r300"}
    barn = objects["w200"]
    assert barn.properties["kind"] == "building"
    assert barn.geometry.geom_type == "Polygon"
    assert objects["n-3"].properties["kind"] == "tree"
    assert objects["w201"].geometry.geom_type == "LineString"
    assert objects["n7"].geometry.is_empty
    assert objects["r300"].properties["kind"] == "restriction"
    assert objects["w104"].properties["osm"]["missing"] == [1, 2]


@pytest.mark.parametrize(
    ("tags", "expected"),
    [
        ({"highway": "path"}, "both"),
        ({"oneway": "yes"}, "forward"),
        ({"oneway": "true"}, "forward"),
        ({"oneway": "1"}, "forward"),
        ({"oneway": "reversible"}, "forward"),
        ({"oneway": "-1"}, "backward"),
        ({"oneway": "reverse"}, "backward"),
        ({"junction": "roundabout"}, "forward"),
        ({"junction": "roundabout", "oneway": "no"}, "both"),
        ({"highway": "motorway"}, "forward"),
        ({"highway": "motorway_link"}, "forward"),
        ({"highway": "motorway", "oneway": "no"}, "both"),
        ({"highway": "trunk"}, "both"),
    ],
)
def test_direction_follows_oneway_tags(tags: dict[str, str], expected: str) -> None:
    assert direction(tags) == expected


@pytest.mark.parametrize("pack", [gzip.compress, bz2.compress], ids=["gz", "bz2"])
def test_compressed_files_are_read(pack: Callable[[bytes], bytes]) -> None:
    data = pack(SAMPLE.read_bytes())
    assert osm.detect("map.osm.gz", data)
    assert write(read(data)) == write(read(SAMPLE.read_bytes()))
    for cut in (5, len(data) // 2, len(data) - 1):
        with pytest.raises(BadUpload):
            read(data[:cut])
    bomb = pack(b'<osm version="0.6">' + b" " * 10_000_000)
    with pytest.raises(TooLarge):
        read(bomb, limits=Limits(unpacked_bytes=1_000_000))
    with pytest.raises(UnreadableFile):
        read(bomb)


def test_pbf_reads_equal_to_xml(tmp_path: Path) -> None:
    import osmium

    body = """<bounds minlat="50" minlon="7" maxlat="50.01" maxlon="7.01"/>
     <node id="1" version="2" timestamp="2014-01-01T00:00:00Z" uid="5" user="ä" changeset="9"
      lat="50.1234567" lon="-7.7"/>
     <node id="2" version="1" lat="50.5" lon="-7.5"><tag k="highway" v="crossing"/></node>
     <node id="3" lat="50.25" lon="-7.25"/><node id="4" lat="50.26" lon="-7.25"/>
     <way id="10" version="4"><nd ref="1"/><nd ref="2"/><tag k="highway" v="path"/></way>
     <way id="11"><nd ref="3"/><nd ref="4"/><nd ref="77"/><tag k="barrier" v="wall"/></way>
     <relation id="20"><member type="way" ref="10" role="x"/><member type="node" ref="3" role=""/></relation>"""
    source = xml(body, '<osm version="0.6" generator="me">')
    path = tmp_path / "map.osm.pbf"
    header = osmium.io.Header()
    header.set("generator", "me")
    header.add_box(osmium.osm.Box(7.0, 50.0, 7.01, 50.01))
    with osmium.SimpleWriter(str(path), header=header) as writer:
        for item in osmium.FileProcessor(osmium.io.FileBuffer(source, "osm")):
            writer.add(item)
    data = path.read_bytes()
    assert osm.detect("anything", data)
    ours, theirs = read(source), read(data)
    assert set(ours.parts) == set(theirs.parts)
    for key in ours.parts:
        a, b = part(ours, key), part(theirs, key)
        assert (a.ids, a.properties) == (b.ids, b.properties)
        assert shapely.equals(a.geometry, b.geometry).all()
        assert a.document["bounds"] == b.document["bounds"]
    assert write(ours) == write(theirs)
    for cut in (3, 20, len(data) // 2, len(data) - 5):
        with pytest.raises(BadUpload):
            read(data[:cut], ReadContext(main="map.osm.pbf")) if cut > 15 else read(data[:cut])
    noise = random.Random(1)
    for _ in range(40):
        broken = bytearray(data)
        for _ in range(3):
            broken[noise.randrange(20, len(data))] = noise.randrange(256)
        with suppress(BadUpload):
            read(bytes(broken))


# --- editing -----------------------------------------------------------------------------------------------------


def edited(layers: Layers, change: Callable[[list[Any]], list[Any]]) -> Layers:
    rows = [(f.id, f.geometry, f.properties) for f in part(layers, TOPOLOGY)]
    return Layers({**layers.parts, TOPOLOGY: features(change(rows), "wgs84")}, layers.datum, layers.levels)


def test_moved_node_is_written_at_new_position() -> None:
    layers = read(SAMPLE.read_bytes())
    place = shapely.Point(7.5, 50.5)
    moved = edited(layers, lambda rows: [(i, place if i == "n2" else g, p) for i, g, p in rows])
    out = elements(write(moved))
    assert (out["n2"][0]["lon"], out["n2"][0]["lat"]) == ("7.5", "50.5")
    assert out["w100"] == elements(write(layers))["w100"]


def test_deleted_edge_splits_way(tmp_path: Path) -> None:
    body = "".join(f'<node id="{i}" lat="50" lon="7.{i}"/>' for i in range(1, 6))
    body += '<way id="9" version="2">' + "".join(f'<nd ref="{i}"/>' for i in range(1, 6))
    body += '<tag k="highway" v="path"/></way><relation id="1"><member type="way" ref="9" role="r"/></relation>'
    layers = read(xml(body))
    edited_layers = edited(layers, lambda rows: [r for r in rows if r[0] not in ("w9:2-3", "w9:3-2", "w9:4-3")])
    served = write(edited_layers)
    out = elements(served)
    assert refs(served, "w9") == ["1", "2"]
    assert refs(served, "w-1") == ["3", "4"]
    assert out["w-1"][2] == {"highway": "path", "oneway": "yes"}
    assert refs(served, "w-2") == ["4", "5"]
    assert out["w-2"][2] == {"highway": "path"}
    assert [m["ref"] for m in out["r1"][1]] == ["9", "-1", "-2"]
    before, after = network(edited_layers), network(read(served))
    assert {(a, b) for a, b, _ in before.edges} == {(a, b) for a, b, _ in after.edges}
    check_with_osmium(served, tmp_path)


def test_deleted_node_is_removed_unless_bend_of_way() -> None:
    layers = read(SAMPLE.read_bytes())
    touched = {
        "n1",
        *(f.id for f in part(layers, TOPOLOGY) if "n1" in (f.properties.get("source"), f.properties.get("target"))),
    }
    served = write(edited(layers, lambda rows: [r for r in rows if r[0] not in touched]))
    assert refs(served, "w100") == ["2", "3"]
    assert refs(served, "w201") == ["20", "30", "1"], "the fence has its own course"
    assert float(elements(served)["n1"][0]["lat"]) == 50.0


def test_added_edges_become_way_with_changed_tags(tmp_path: Path) -> None:
    layers = read(SAMPLE.read_bytes())

    def change(rows: list[Any]) -> list[Any]:
        node = ("shed", shapely.Point(7.004, 50.004), {"kind": "node", "name": "Shed"})
        ends = {"n5": shapely.Point(7.002, 50.001), "n1": shapely.Point(7, 50), "shed": node[1]}
        new = [
            (f"{a}_{b}", shapely.LineString([ends[a], ends[b]]), {"kind": "edge", "source": a, "target": b, **more})
            for a, b, more in (
                ("n5", "shed", {"speed_limit": 0.5}),
                ("shed", "n5", {"speed_limit": 0.5}),
                ("shed", "n1", {"width": 2}),
            )
        ]
        tagged = [
            (
                i,
                g,
                {**p, "osm": {**p["osm"], "tags": {**p["osm"]["tags"], "surface": "mud"}}} if i[:5] == "w102:" else p,
            )
            for i, g, p in rows
        ]
        return [*tagged, node, *new]

    served = write(edited(layers, change))
    out = elements(served)
    shed = next(k for k, v in out.items() if v[2].get("name") == "Shed")
    assert int(shed[1:]) < 0
    ways = {tuple(m["ref"] for m in v[1]): v[2] for k, v in out.items() if k.startswith("w-")}
    assert ways[("5", shed[1:])] == {"highway": "path", "maxspeed": "1.8"}
    assert ways[(shed[1:], "1")] == {"highway": "path", "width": "2", "oneway": "yes"}
    assert out["w102"][2] == {"highway": "service", "oneway": "-1", "surface": "mud"}


def test_new_network_replaces_highways_only(tmp_path: Path) -> None:
    layers = read(SAMPLE.read_bytes())
    rows = [
        ("n1", shapely.Point(0, 0), {"kind": "node"}),
        ("B & <C>", shapely.Point(30, 0, 2.5), {"kind": "node", "tmap2": {"verts": []}}),
        ("n1_B", shapely.LineString([(0, 0), (15, 5), (30, 0)]), {"kind": "edge", "source": "n1", "target": "B & <C>"}),
    ]
    datum = Datum(50.0, 7.0)
    other = Layers({**layers.parts, TOPOLOGY: features(rows, "local")}, datum)
    context = WriteContext()
    served = write(other, context)
    out = elements(served)
    assert not {"w100", "w101"} & out.keys()
    assert {"w200", "w201", "w106", "n22"} <= out.keys()
    node = next(v for v in out.values() if v[2].get("name") == "B & <C>")
    at = local_frame(datum).to_wgs84(np.array([[30.0, 0.0]]))[0]
    assert np.allclose([float(node[0]["lon"]), float(node[0]["lat"])], at, atol=1e-11)
    assert node[2]["ele"] == "2.5"
    assert any("no longer in the network" in d.subject for d in context.dropped)
    graph = network(read(served))
    assert sorted(d for _, d in graph.degree() if d) == [1, 1, 2], "the bend is a node, one way only"
    with pytest.raises(MissingDatum):
        write(Layers(other.parts))


def test_redrawn_building_gets_new_nodes() -> None:
    layers = read(SAMPLE.read_bytes())
    objects = part(layers, OBJECTS)
    shape = shapely.Polygon([(7.003, 50.003), (7.0031, 50.003), (7.0031, 50.0031), (7.0035, 50.004), (7.003, 50.0031)])
    rows = [(f.id, shape if f.id == "w200" else f.geometry, f.properties) for f in objects]
    served = write(Layers({**layers.parts, OBJECTS: features(rows, "wgs84", objects.document)}))
    again = {f.id: f for f in part(read(served), OBJECTS)}
    assert again["w200"].geometry.equals(shape)
    assert "22" in refs(served, "w200"), "its own node where one stands at a corner"


def test_items_of_other_formats_get_tags() -> None:
    square = shapely.box(7.0, 50.0, 7.001, 50.001)
    holed = shapely.Polygon(square.exterior, [shapely.box(7.0002, 50.0002, 7.0004, 50.0004).exterior])
    line = shapely.LineString([(7.0, 50.0), (7.1, 50.1)])
    parts: dict[PartKey, Any] = {
        PartKey("objects", "ground", "kml"): features(
            [
                ("field", square, {"kind": "region", "name": 'North "field"', "crop": "wheat", "kml": {"x": [1]}}),
                ("pond", holed, {"kind": "region"}),
                ("tree", shapely.Point(7.0, 50.0), {"kind": "poi", "height": 3.5, "alive": True}),
                ("drawn", line, {"kind": "path"}),
                ("text", None, {"kind": "note"}),
            ],
            "wgs84",
        ),
        PartKey("objects", "L2", "kml"): features([("up", line, {"kind": "path"})], "wgs84"),
        PartKey("zones", "ground", ZONES): features([("z", square, {"kind": "keepout"})], "wgs84"),
        PartKey("location", "ground", SITE): features([("fence", square, {"kind": "fence"})], "wgs84"),
        TOPOLOGY: features(
            [
                ("drawn/0", shapely.Point(7.0, 50.0), {"kind": "node", "drawn_from": "drawn"}),
                ("drawn/1", shapely.Point(7.1, 50.1), {"kind": "node", "drawn_from": "drawn"}),
                ("e", line, {"kind": "edge", "source": "drawn/0", "target": "drawn/1", "drawn_from": "drawn"}),
            ],
            "wgs84",
        ),
    }
    context = WriteContext(attribution=("© somebody",))
    served = write(Layers(parts, Datum(50.0, 7.0), (Level(), Level("L2", 3.0))), context)
    root = etree.fromstring(served)
    assert root.get("attribution") == "© somebody"
    assert dict(root.find("bounds").attrib) == {
        "minlat": "50.0",
        "minlon": "7.0",
        "maxlat": "50.001",
        "maxlon": "7.001",
    }
    tags = [v[2] for v in elements(served).values()]
    assert {"name": 'North "field"', "kind": "region", "crop": "wheat", "area": "yes"} in tags
    assert {"kind": "region", "type": "multipolygon"} in tags, "an id is no name"
    assert {"kind": "poi", "height": "3.5", "alive": "yes"} in tags
    assert {"kind": "keepout", "zone": "keepout", "area": "yes"} in tags
    paths = [t for t in tags if t.get("kind") == "path"]
    assert paths == [{"kind": "path", "level": "L2"}], "the network derived from the other is written already"
    lost = {d.subject for d in context.dropped}
    assert {"GNSS fence", "datum", "items without a geometry", "zones"} <= lost
    back = [dict(p) for p in part(read(served), OBJECTS).properties]
    assert sorted(p["kind"] for p in back if "kind" in p["osm"].get("tags", {})) == [
        "keepout",
        "path",
        "poi",
        "region",
        "region",
    ]
    assert [p["name"] for p in back if "name" in p] == ['North "field"']
    assert any("nested" in item for item in lost)


def test_levels_with_same_ids_stay_separate() -> None:
    ground, upper = read(SAMPLE.read_bytes()), read(SAMPLE.read_bytes(), level="L2")
    shifted = Layers(
        {
            k: features(
                [(f.id, shapely.transform(f.geometry, lambda c: c + 0.5), f.properties) for f in part(upper, k)],
                "wgs84",
            )
            for k in upper.parts
        }
    )
    served = write(Layers({**ground.parts, **shifted.parts}))
    graph = network(read(served))
    single = network(ground)
    assert graph.number_of_nodes() == 2 * single.number_of_nodes()
    assert networkx.number_weakly_connected_components(graph) == 2 * networkx.number_weakly_connected_components(single)


def test_arbitrary_edited_properties_are_written_safely() -> None:
    source_properties: list[dict[str, Any]] = [
        {"refs": "1,2", "tags": {"a": 1}},
        {"refs": [1.5, None], "tags": []},
        {"refs": [True], "tags": {"highway": "path"}},
        {"refs": [10**30]},
        {
            "refs": [1, 2],
            "missing": ["x"],
            "vertices": [1],
            "tags": {"k\x01": "v\ud800\n"},
            "attributes": {"bad name": "x", "id": "9"},
        },
    ]
    line = shapely.LineString([(7, 50), (7.1, 50)])
    rows: list[Any] = [(f"w{k + 1}", line, {"kind": "line", "osm": s}) for k, s in enumerate(source_properties)]
    rows += [
        ("r1", None, {"osm": {"members": [["way"], "x", ["way", "1", "r"], ["node", 1, 5]]}}),
        ("n0x", line, {"osm": 5}),
    ]
    served = write(Layers({OBJECTS: features(rows, "wgs84")}))
    assert len(etree.fromstring(served)) > 5
    assert read(served)


# --- hostile bytes -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        ('<node id="1" lat="NaN" lon="1"/>', "finite"),
        ('<node id="1" lat="inf" lon="1"/>', "finite"),
        ('<node id="1" lat="1e999" lon="1"/>', "invalid position"),
        ('<node id="1" lat="90.1" lon="1"/>', "invalid position"),
        ('<node id="1" lat="1" lon="-180.5"/>', "invalid position"),
        ('<node id="1" lat="1_0" lon="1"/>', "finite"),
        ('<node id="1" lat="١" lon="1"/>', "finite"),
        ('<node lat="1" lon="1"/>', "id"),
        ('<node id="x" lat="1" lon="1"/>', "id"),
        ('<node id="99999999999999999999" lat="1" lon="1"/>', "id"),
        ('<node id="9223372036854775808" lat="1" lon="1"/>', "64 bits"),
        ('<way id="1"><nd ref="9999999999999999999"/></way>', "64 bits"),
        ('<way id="1"><nd/></way>', "ref"),
        ('<relation id="1"><member type="area" ref="1" role=""/></relation>', "member"),
        ('<bounds minlat="5" minlon="1" maxlat="4" maxlon="2"/>', "bounds"),
        ('<bounds minlat="nan" minlon="1" maxlat="4" maxlon="2"/>', "bounds"),
        ('<way id="1"><way id="2"><nd ref="1"/></way></way>', "not allowed"),
        ('<node id="1" lat="1" lon="1" user="' + "x" * 70_000 + '"/>', "longer"),
        ("<a>" * 300 + "</a>" * 300, "not an element"),
        ('<node id="1" lat="1" lon="1">&bomb;</node>', ""),
        ('<node id="1" lat="1" lon="1" id="2"/>', ""),
        ("<node id='1' lat='1' lon='1'/>\x00", ""),
    ],
)
def test_bad_content_is_refused_with_a_reason(body: str, reason: str) -> None:
    with pytest.raises(UnreadableFile) as refused:
        read(xml(body))
    assert reason in refused.value.detail
    assert refused.value.problems


@pytest.mark.parametrize("quote", ['"', "'"])
def test_bad_position_is_reported_with_line(quote: str) -> None:
    lines = "\n".join(f'<node id="{k}" lat="{89 + k}" lon="1"/>' for k in range(4)).replace('"', quote)
    with pytest.raises(UnreadableFile) as refused:
        read(xml(lines))
    assert (refused.value.problems[0].line, refused.value.problems[0].where) == (5, "node 2")


def test_entities_are_refused_in_any_encoding() -> None:
    bomb = '<!DOCTYPE osm [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><osm version="0.6"><note>&b;</note></osm>'
    for text in (bomb, "<?xml version='1.0'?>\n" + bomb, "<!-- x -->" + bomb):
        for encoding in ("utf-8", "utf-16"):
            if encoding == "utf-16" and text[:5] == "<?xml":
                continue
            with pytest.raises(UnreadableFile):
                read(text.encode(encoding))


def test_other_encodings_and_layouts_are_read() -> None:
    text = '<osm version="0.6"><node id="1" lat="1" lon="2"><tag k="name" v="Zoë"/></node></osm>'
    expected = read(text.encode())
    for data in (
        ('<?xml version="1.0" encoding="ISO-8859-1"?>' + text).encode("latin-1"),
        text.encode("utf-16"),
        b"\xef\xbb\xbf" + text.encode(),
        b"\n \n" + text.encode(),
        text.replace('"', "'").encode(),
        text.replace("><", "><!-- <node id='9'/> --><").encode(),
        text.replace('"Zoë"', '"Zo&#235;"').encode(),
        text.replace('<tag k="name" v="Zoë"/>', "<tag\nv = 'Zoë'\n k='name' ></tag>").encode(),
    ):
        content = part(read(data), OBJECTS)
        assert content.ids == part(expected, OBJECTS).ids
        assert content.properties == part(expected, OBJECTS).properties
        assert osm.detect("x", data)


def test_detect_accepts_osm_only() -> None:
    assert osm.detect("a", SAMPLE.read_bytes())
    assert osm.detect("a", b'<!DOCTYPE osm [<!ENTITY a "b">]><osm/>'), "so that the reader can say what is wrong"
    assert not osm.detect("a", b"<!---->" * 500)
    assert not osm.detect("a.osm", b"")
    assert not osm.detect("a.osm", b"<kml><osm/></kml>")
    assert not osm.detect("a.osm", gzip.compress(b"hello"))
    assert not osm.detect("a", b'{"osm": "<osm>"}')


def test_truncated_and_mutated_files_never_crash(shared: Path) -> None:
    real = (shared / "data/osm" / REAL[0] / "osm.xml").read_bytes()
    noise = random.Random(7)
    for data in (SAMPLE.read_bytes(), real[:200_000] + b"</osm>"):
        for cut in [noise.randrange(len(data) - 8) for _ in range(20)]:
            with pytest.raises(BadUpload):
                read(data[:cut])
        for _ in range(60):
            broken = bytearray(data)
            for _ in range(noise.randrange(1, 4)):
                broken[noise.randrange(len(data))] = noise.choice(b"<>\"'&0z \x00\xff")
            with suppress(BadUpload):
                write(read(bytes(broken)))


def test_counts_are_bounded() -> None:
    many = xml("".join(f'<node id="{k}" lat="1" lon="1"/>' for k in range(1, 2000)))
    assert read(many)
    with pytest.raises(TooLarge):
        read(many, limits=Limits(features=200))
    with pytest.raises(TooLarge):
        read(many.replace(b'"1"', b"'1'"), limits=Limits(features=200))


def test_memory_stays_within_ten_times_the_input() -> None:
    nodes = "".join(f' <node id="{k}" version="1" lat="50.{k:06d}" lon="7.{k:06d}"/>\n' for k in range(1, 16_000))
    ways = "".join(
        f' <way id="{w}">\n'
        + "".join(f'  <nd ref="{w * 8 + j}"/>\n' for j in range(9))
        + '  <tag k="natural" v="x"/>\n </way>\n'
        for w in range(1, 1_600)
    )
    for data in (xml(nodes + ways), xml(nodes + ways).replace(b'"1"', b"'1'")):
        tracemalloc.start()
        read(data)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 10 * len(data)


@pytest.mark.parametrize("quote", ["'", '"'])
def test_nested_node_is_reported(quote: str) -> None:
    body = "<node id='2' lat='1' lon='1'><node id='3' lat='2' lon='2'/></node><node id='4' lat='1' lon='2'/>"
    context = ReadContext()
    read(xml(body.replace("'", quote)), context)
    assert any("<node> inside <node>" in w.problem for w in context.warnings)


def test_many_attributes_are_read() -> None:
    many = " ".join(f"a{k}='x'" for k in range(50_000))
    with pytest.raises(UnreadableFile, match="50001 attributes"):
        read(f"<osm version='0.6' {many}></osm>".encode())


# --- what tags say in canonical words --------------------------------------------------------------------------------

TOWN = """<node id="1" lat="50" lon="7.0"/><node id="2" lat="50" lon="7.1"/><node id="3" lat="50" lon="7.2"/>
<node id="4" lat="50.1" lon="7.1"/><node id="5" lat="49.9" lon="7.1"/>
<node id="6" lat="50.2" lon="7"><tag k="natural" v="tree"/><tag k="height" v="12"/>
<tag k="circumference" v="1.57"/></node>
<node id="11" lat="50.3" lon="7"/><node id="12" lat="50.3" lon="7.1"/><node id="13" lat="50.4" lon="7.1"/>
<way id="1"><nd ref="1"/><nd ref="2"/><nd ref="3"/><tag k="highway" v="residential"/><tag k="maxspeed" v="30 mph"/>
<tag k="maxspeed:backward" v="walk"/><tag k="lanes" v="2"/><tag k="surface" v="asphalt"/></way>
<way id="2"><nd ref="4"/><nd ref="5"/><tag k="highway" v="footway"/><tag k="bridge" v="yes"/><tag k="layer" v="1"/>
<tag k="access" v="private"/><tag k="width" v="6'7&quot;"/></way>
<way id="3"><nd ref="2"/><nd ref="4"/><tag k="highway" v="steps"/></way>
<way id="4"><nd ref="11"/><nd ref="12"/><nd ref="13"/><nd ref="11"/><tag k="building" v="yes"/>
<tag k="building:levels" v="4"/><tag k="min_height" v="3 m"/></way>
<way id="5"><nd ref="11"/><nd ref="12"/><tag k="waterway" v="stream"/><tag k="width" v="2"/></way>
<way id="6"><nd ref="12"/><nd ref="13"/><tag k="barrier" v="hedge"/><tag k="height" v="150 cm"/></way>
<way id="7"><nd ref="11"/><nd ref="13"/><tag k="waterway" v="dam"/></way>"""


def test_tags_become_canonical_properties() -> None:
    layers = read(xml(TOWN))
    properties = {f.id: {k: v for k, v in f.properties.items() if k != "osm"} for f in part(layers, OBJECTS)}
    assert properties["n6"] == {"kind": "tree", "height": 12.0, "width": pytest.approx(0.49974652)}
    assert properties["w4"] == {"kind": "building", "height": 12.0, "base": 3.0}
    assert properties["w5"] == {"kind": "water", "width": 2.0}
    assert properties["w6"] == {"kind": "barrier", "height": 1.5}
    assert properties["w7"] == {"kind": "waterway"}
    assert properties["w1"] == {"kind": "highway"}, "sizes of a highway belong to its edges"
    edges = {f.id: f.properties for f in part(layers, TOPOLOGY) if f.properties["kind"] == "edge"}
    road = {"width": 6.0, "surface": "asphalt"}
    for i, limit in (("w1:1-2", 13.4112), ("w1:2-1", 1.666666667)):
        attributes = {k: v for k, v in edges[i].items() if k not in ("kind", "source", "target", "osm")}
        assert attributes == {**road, "speed_limit": limit}
    assert (edges["w2:4-5"]["access"], edges["w2:4-5"]["width"]) == ("private", pytest.approx(2.0066))
    assert edges["w3:2-4"]["stairs"] is True
    # The bridge goes over the road and shares no node with it.
    assert not any({p["source"], p["target"]} == {"n2", "n5"} for p in edges.values())
    graph = network(layers)
    assert set(graph["n5"]) == {"n4"}
    assert write(read(write(layers))) == write(layers)


def test_edited_properties_change_tags() -> None:
    layers = read(xml(TOWN))
    objects = part(layers, OBJECTS)
    new = {"w4": {"height": 15.0, "name": "Mill"}, "n6": {"width": 0.49974652}, "w6": {"height": None}}
    rows = [(f.id, f.geometry, {**f.properties, **new.get(f.id, {})}) for f in objects]
    layers = Layers({**layers.parts, OBJECTS: features(rows, "wgs84", objects.document)}, layers.datum, layers.levels)

    def change(rows: list[Any]) -> list[Any]:
        limits = {"w1:1-2": 5.0, "w1:2-3": 2.5, "w1:3-2": 2.5, "w2:4-5": 2.0, "w2:5-4": 2.0}
        return [(i, g, {**p, "speed_limit": limits[i], "surface": "gravel"} if i in limits else p) for i, g, p in rows]

    changed = edited(layers, change)
    served = write(changed)
    out = {k: v[2] for k, v in elements(served).items()}
    assert out["w4"] == {"building": "yes", "building:levels": "4", "min_height": "3 m", "height": "15", "name": "Mill"}
    assert out["n6"] == elements(write(read(xml(TOWN))))["n6"][2]
    assert out["w6"] == {"barrier": "hedge", "height": "150 cm"}, "unspecified values keep their tags"
    first = {"maxspeed": "30 mph", "maxspeed:backward": "walk", "maxspeed:forward": "18", "surface": "gravel"}
    assert out["w1"] == {"highway": "residential", "lanes": "2", **first}
    assert out["w-1"] == {"highway": "residential", "lanes": "2", "maxspeed": "9", "surface": "gravel"}
    assert out["w2"]["maxspeed"] == "7.2"
    again = {f.id: f.properties for f in part(read(served), TOPOLOGY) if f.properties["kind"] == "edge"}
    assert again["w1:1-2"]["speed_limit"] == 5.0
    assert again["w1:2-1"]["speed_limit"] == pytest.approx(1.666666667)
    assert {again["w-1:2-3"]["speed_limit"], again["w-1:3-2"]["speed_limit"]} == {2.5}
    # Without the ways the edges' own words make the tags.
    bare = Layers({TOPOLOGY: part(changed, TOPOLOGY)}, changed.datum, changed.levels)
    tags = [v[2] for k, v in elements(write(bare)).items() if k.startswith("w")]
    assert {"highway": "footway", "bridge": "yes", "layer": "1", "access": "private", "width": "6'7\"",
            "maxspeed": "7.2", "surface": "gravel"} in tags  # fmt: skip
    assert sorted(t["maxspeed"] for t in tags if t["highway"] == "residential") == ["18", "6", "9"]


def test_hostile_property_values_are_not_written_as_tags() -> None:
    layers = read(xml(TOWN))
    objects = part(layers, OBJECTS)
    bad: list[Any] = [[1], {"a": 1}, True, -1, 0, "", None]
    for value in bad:
        rows = [(f.id, f.geometry, {**f.properties, "height": value, "name": value}) for f in objects]
        odd = Layers({**layers.parts, OBJECTS: features(rows, "wgs84", objects.document)}, layers.datum, layers.levels)
        odd = edited(odd, lambda rows, v=value: [(i, g, {**p, "width": v, "speed_limit": v}) for i, g, p in rows])
        assert write(odd) == write(layers), value


FURTHER = """\
 <note>The data is © its contributors</note>
 <meta osm_base="2026-01-01T00:00:00Z"/>
 <changeset id="7" open="true">
  <tag k="comment" v="surveyed &amp; drawn"/>
  <discussion>
   <comment uid="5" user="ä">
    <text>Why &lt;this&gt;?</text>
   </comment>
  </discussion>
 </changeset>
 <bounds minlat="1.0" minlon="1.0" maxlat="2.0" maxlon="2.0" origin="OpenStreetMap server"/>
 <bounds minlat="2.0" minlon="1.5" maxlat="3.0" maxlon="2.5" origin="second download"/>
 <node id="1" action="modify" visible="true" lat="1.5" lon="1.5">
  <tag k="barrier" v="gate"/>
  <photo href="gate.jpg"/>
 </node>
 <node id="2" lat="1.6" lon="1.6"/>
 <node id="3" version="4" lat="1.7" lon="1.7">
  <survey>on foot</survey>
 </node>
 <way id="4" action="modify">
  <nd ref="2"/>
  <nd ref="3"/>
  <tag k="highway" v="path"/>
  <bounds minlat="1.6" minlon="1.6" maxlat="1.7" maxlon="1.7"/>
 </way>
 <relation id="5">
  <member type="way" ref="4" role=""/>
  <tag k="type" v="route"/>
  <survey by="bike">
   <day>Monday</day>
  </survey>
 </relation>"""


def test_undefined_elements_round_trip() -> None:
    data = xml(FURTHER, '<osm version="0.6" generator="JOSM" upload="false">')
    read_context, write_context = ReadContext(), WriteContext()
    layers = read(data, read_context)
    served = write(layers, write_context)

    def tree(e: etree._Element) -> Any:
        return e.tag, sorted(e.attrib.items()), (e.text or "").strip(), [tree(c) for c in e]

    assert sorted(map(tree, etree.fromstring(served))) == sorted(map(tree, etree.fromstring(data)))
    assert dict(etree.fromstring(served).attrib) == {"version": "0.6", "generator": "JOSM", "upload": "false"}
    assert write_context.dropped == []
    assert [p.where for p in read_context.warnings] == ["node 1", "node 3", "way 4", "relation 5"]
    assert write(read(served)) == served


@pytest.mark.parametrize("source", ["tmap2", "geojson"])
def test_edge_from_node_to_itself_round_trips(source: str) -> None:
    datum = Datum(53.0, -0.5)
    start, end = shapely.Point(0, 0), shapely.Point(5, 0)

    def edge(i: str, a: str, b: str, line: list[tuple[float, float]]) -> Any:
        return i, shapely.LineString(line), {"kind": "edge", "source": a, "target": b, "action": "move_base"}

    rows = [
        ("a", start, {"kind": "node"}),
        ("b", end, {"kind": "node"}),
        edge("a_b", "a", "b", [(0, 0), (5, 0)]),
        edge("b_b", "b", "b", [(5, 0), (5, 0)]),
        edge("b_a", "b", "a", [(5, 0), (0, 0)]),
    ]
    fmt = formats.get_format(source)
    files = formats.write(fmt, Layers({TOPOLOGY: features(rows, "local")}, datum), WriteContext())
    main = next(iter(files))
    uploaded = formats.read(FileGroup(fmt, main, files), ReadContext(main=main))
    served = write(Layers(uploaded.parts, datum))
    again = network(read(served))
    assert sorted(a == b for a, b in again.edges()) == [False, False, True]
    assert networkx.is_isomorphic(again, networkx.MultiDiGraph([("a", "b"), ("b", "b"), ("b", "a")]))
    assert write(read(served)) == served


def test_repeated_node_within_way_is_not_edge() -> None:
    nodes = "".join(f'<node id="{k}" lat="1.{k}" lon="1"/>' for k in (1, 2))
    refs = "".join(f'<nd ref="{k}"/>' for k in (1, 1, 2))
    context = ReadContext()
    twice = '<way id="4"><nd ref="2"/><nd ref="2"/><tag k="highway" v="path"/></way>'
    graph = network(read(xml(f'{nodes}<way id="3">{refs}<tag k="highway" v="path"/></way>{twice}'), context))
    assert sorted(graph.edges()) == [("n1", "n2"), ("n2", "n1")]
    assert ["that segment is skipped" in p.problem for p in context.warnings] == [True, True]


def test_invalid_tag_values_are_reported_with_count() -> None:
    nodes = "".join(f'<node id="{k}" lat="50.00{k}" lon="7.0"/>' for k in range(1, 4))
    tree = '<node id="9" lat="50.1" lon="7.0"><tag k="natural" v="tree"/><tag k="height" v="tall"/></node>'
    ways = ""
    for k, tags in enumerate(
        (
            {"highway": "service", "maxspeed": "RO:urban", "width": "2.5 m", "lanes": "2"},
            {"highway": "service", "maxspeed": "RO:urban", "width": "about 2"},
            {"highway": "service", "maxspeed": "none", "surface": "odd", "name": "x"},
            {"railway": "rail", "maxspeed": "fast"},
        )
    ):
        tag_xml = "".join(f'<tag k="{key}" v="{value}"/>' for key, value in tags.items())
        ways += f'<way id="{k}"><nd ref="1"/><nd ref="2"/>{tag_xml}</way>'
    context = ReadContext()
    read(f'<osm version="0.6">{nodes}{tree}{ways}</osm>'.encode(), context)
    assert [(p.where, p.problem) for p in context.warnings] == [
        ("way 0", "the tag maxspeed='RO:urban' is not understood: kept without effect (2 times)"),
        ("way 1", "the tag width='about 2' is not understood: kept without effect"),
        ("node 9", "the tag height='tall' is not understood: kept without effect"),
    ]
