"""Floors: the same conversions by the fastest parser and a string writer, without checks, options or layers.

Each function takes the input's bytes and returns the output's text, specialised for one given file. They are the
reference for our benchmarks, not a second implementation.
"""

from __future__ import annotations

import io
import itertools
import re
from collections import defaultdict

import numpy as np
import orjson
import ryml
import yaml
from lxml import etree
from PIL import Image
from pyproj import Proj

EDGE = (
    "    - edge_id: %s_%s\n      node: %s\n      action: move_base\n      action_type: move_base_msgs/MoveBaseGoal\n"
    "      config: []\n      fail_policy: fail\n      fluid_navigation: true\n      goal:\n        target_pose:\n"
    "          header:\n            frame_id: $node.parent_frame\n          pose: $node.pose\n"
    "      recovery_behaviours_config: ''\n      restrictions_planning: 'True'\n      restrictions_runtime: 'True'\n"
)
NODE = (
    "- meta:\n    map: m\n    node: %s\n    pointset: m\n  node:\n    localise_by_topic: ''\n    parent_frame: map\n"
    "    name: %s\n    pose:\n      orientation:\n        w: 1.0\n        x: 0.0\n        y: 0.0\n        z: 0.0\n"
    "      position:\n        x: %s\n        y: %s\n        z: 0.0\n    properties:\n      xy_goal_tolerance: 0.3\n"
    "      yaw_goal_tolerance: 0.1\n    restrictions_planning: 'True'\n    restrictions_runtime: 'True'\n    verts:\n"
    "    - x: -0.13\n      y: 0.213\n    - x: -0.242\n      y: 0.059\n    - x: -0.213\n      y: -0.13\n"
    "    - x: -0.059\n      y: -0.242\n    - x: 0.13\n      y: -0.213\n    - x: 0.242\n      y: -0.059\n"
    "    - x: 0.213\n      y: 0.13\n    - x: 0.059\n      y: 0.242\n    edges:%s\n"
)


def _tmap2(names: list[str], xy: np.ndarray, links: dict[str, list[str]]) -> str:
    out = ["meta:\n  last_updated: 1970-01-01_00-00-00\nmetric_map: m\nname: m\npointset: m\nnodes:\n"]
    for name, (x, y) in zip(names, xy.tolist(), strict=True):
        edges = "".join(EDGE % (name, other, other) for other in links[name])
        out.append(NODE % (name, name, x, y, "\n" + edges if edges else " []"))
    return "".join(out)


def _local(lonlat: np.ndarray) -> np.ndarray:
    lon, lat = lonlat.min(axis=0)
    return np.column_stack(Proj(f"+proj=tmerc +lat_0={lat} +lon_0={lon} +k=1 +ellps=WGS84")(lonlat[:, 0], lonlat[:, 1]))


def osm_to_tmap2(data: bytes) -> str:
    """Convert highway nodes and segments of an OSM file."""
    root = etree.fromstring(data)
    place = {n.get("id"): (float(n.get("lon")), float(n.get("lat"))) for n in root.iterfind("node")}
    links: dict[str, list[str]] = defaultdict(list)
    for way in root.iterfind("way"):
        if any(t.get("k") == "highway" for t in way.iterfind("tag")):
            refs = [n.get("ref") for n in way.iterfind("nd")]
            for a, b in itertools.pairwise(refs):
                links[a].append(b)
                links[b].append(a)
    names = [n for n in links if n in place]
    return _tmap2(names, _local(np.array([place[n] for n in names])), links)


def kml_to_tmap2(data: bytes) -> str:
    """Convert lines (or rings) of a drawing to a network: each vertex a node, each segment two edges."""
    root = etree.fromstring(data)
    names: list[str] = []
    places: list[str] = []
    links: dict[str, list[str]] = defaultdict(list)
    node_names: dict[str, str] = {}
    for k, coordinates in enumerate(root.iter("{*}coordinates")):
        last = None
        for j, point in enumerate((coordinates.text or "").split()):
            name = node_names.get(point)
            if name is None:
                name = node_names[point] = f"n{k}_{j}"
                names.append(name)
                places.append(point)
            if last is not None:
                links[last].append(name)
                links[name].append(last)
            last = name
    lonlat = np.array([p.split(",")[:2] for p in places], float)
    return _tmap2(names, _local(lonlat), links)


def tmap2_to_kml(data: bytes) -> str:
    """Convert nodes to points and edges to lines, with all their attributes as data."""
    tree = ryml.parse_in_arena(data)
    tree.resolve()
    nodes = orjson.loads(ryml.emit_json(tree))["nodes"]
    at = {n["node"]["name"]: n["node"]["pose"]["position"] for n in nodes}
    back = Proj("+proj=tmerc +lat_0=53.268642038 +lon_0=-0.524509505881 +k=1 +ellps=WGS84")
    lon, lat = back([p["x"] for p in at.values()], [p["y"] for p in at.values()], inverse=True)
    place = {n: f"{x!r},{y!r}" for n, x, y in zip(at, lon, lat, strict=True)}
    out = ['<?xml version="1.0" encoding="UTF-8"?><kml xmlns="http://www.opengis.net/kml/2.2"><Document>']
    more = '<Data name="%s"><value>%s</value></Data>'
    for n in nodes:
        node = n["node"]
        edges = node.pop("edges")
        extended_data = "".join(more % (k, orjson.dumps(v).decode()) for k, v in node.items())
        out.append(
            f"<Placemark><name>{node['name']}</name><ExtendedData>{extended_data}</ExtendedData>"
            f"<Point><coordinates>{place[node['name']]}</coordinates></Point></Placemark>\n"
        )
        for e in edges:
            extended_data = "".join(more % (k, orjson.dumps(v).decode()) for k, v in e.items())
            out.append(
                f"<Placemark><name>{e['edge_id']}</name><ExtendedData>{extended_data}</ExtendedData><LineString><coordinates>"
                f"{place[node['name']]} {place[e['node']]}</coordinates></LineString></Placemark>\n"
            )
    return "".join(out) + "</Document></kml>"


def datum_to_kml(data: bytes) -> str:
    """Convert the fence to a polygon."""
    document = yaml.load(data, yaml.CSafeLoader)
    ring = " ".join(f"{lon!r},{lat!r}" for lat, lon in document["gnss_fence"]["gnss_fence_coords"])
    return (
        '<?xml version="1.0" encoding="UTF-8"?><kml xmlns="http://www.opengis.net/kml/2.2"><Document><Placemark>'
        f"<name>fence</name><Polygon><outerBoundaryIs><LinearRing><coordinates>{ring}</coordinates></LinearRing>"
        "</outerBoundaryIs></Polygon></Placemark></Document></kml>"
    )


def grid_to_kml(described: bytes, picture: bytes) -> str:
    """Convert the grid to a ground overlay: its corners, not its cells."""
    map_yaml = dict(re.findall(r"(\w+):\s*(.+)", described.decode()))
    width, height = Image.open(io.BytesIO(picture)).size
    x, y, _ = (float(v) for v in map_yaml["origin"].strip("[] ").split(","))
    res = float(map_yaml["resolution"])
    back = Proj("+proj=tmerc +lat_0=53.268642038 +lon_0=-0.524509505881 +k=1 +ellps=WGS84")
    lon, lat = back([x, x + width * res], [y, y + height * res], inverse=True)
    return (
        '<?xml version="1.0" encoding="UTF-8"?><kml xmlns="http://www.opengis.net/kml/2.2"><Document><GroundOverlay>'
        f"<name>map</name><Icon><href>{map_yaml['image']}</href></Icon><LatLonBox><north>{lat[1]!r}</north>"
        f"<south>{lat[0]!r}</south><east>{lon[1]!r}</east><west>{lon[0]!r}</west></LatLonBox></GroundOverlay>"
        "</Document></kml>"
    )
