"""Small synthetic files: a farm's datum, network, grid and drawing."""

from __future__ import annotations

DATUM = b"""\
datum_latitude: &lat 53.2686
datum_longitude: &lon -0.5245
gnss_fence:
  gnss_fence_coords: [[53.2684, -0.5250], [53.2684, -0.5240], [53.2690, -0.5240], [53.2690, -0.5250]]
gmapping: {xmin: -50, xmax: 50, ymin: -50, ymax: 50}
navsat_transform_node:
  datum: [*lat, *lon, 0.0]
"""

LATITUDE, LONGITUDE = 53.2686, -0.5245

NODES = {"gate": (0.0, 0.0), "barn": (10.0, 0.0), "field": (10.0, 8.0)}
EDGES = (("gate", "barn"), ("barn", "gate"), ("barn", "field"))


def tmap2(nodes: dict[str, tuple[float, float]] | None = None, edges: tuple[tuple[str, str], ...] = EDGES) -> bytes:
    """Write a network in the local frame, in the format of topological_navigation."""
    positions = nodes or NODES
    lines = [
        "meta:",
        "  last_updated: 2026-01-02_03-04-05",
        "metric_map: farm",
        "name: farm",
        "pointset: farm",
        "transformation:",
        "  child: topo_map",
        "  parent: map",
        "  rotation: {w: 1.0, x: 0.0, y: 0.0, z: 0.0}",
        "  translation: {x: 0.0, y: 0.0, z: 0.0}",
        "nodes:",
    ]
    leaving: dict[str, list[str]] = {}
    for a, b in edges:
        leaving.setdefault(a, []).append(b)
    for name, (x, y) in positions.items():
        lines += [
            "- meta:",
            "    map: farm",
            f"    node: {name}",
            "    pointset: farm",
            "  node:",
            f"    name: {name}",
            "    parent_frame: map",
            "    pose:",
            "      orientation: {w: 1.0, x: 0.0, y: 0.0, z: 0.0}",
            f"      position: {{x: {x}, y: {y}, z: 0.0}}",
            "    properties: {xy_goal_tolerance: 0.3, yaw_goal_tolerance: 0.1}",
            "    restrictions_planning: 'True'",
            "    restrictions_runtime: 'True'",
            "    localise_by_topic: ''",
            "    verts: []",
        ]
        targets = leaving.get(name, [])
        lines += ["    edges:" if targets else "    edges: []"]
        for target in targets:
            lines += [
                "    - action: move_base",
                "      action_type: move_base_msgs/MoveBaseGoal",
                "      config: []",
                f"      edge_id: {name}_{target}",
                "      fail_policy: fail",
                "      fluid_navigation: true",
                "      goal: {target_pose: {header: {frame_id: $node.parent_frame}, pose: $node.pose}}",
                f"      node: {target}",
                "      recovery_behaviours_config: ''",
                "      restrictions_planning: 'True'",
                "      restrictions_runtime: 'True'",
            ]
    return ("\n".join(lines) + "\n").encode()


def grid(name: str = "map", *, width: int = 8, height: int = 6, resolution: float = 0.5) -> dict[str, bytes]:
    """Write an occupancy grid: a wall of occupied cells at the left, one unknown cell at the lower right, else free."""
    rows = [[0 if c == 0 else 254 for c in range(width)] for _ in range(height)]
    rows[height - 1][width - 1] = 205
    pixels = bytes(v for row in rows for v in row)
    yaml = (
        f"image: {name}.pgm\nresolution: {resolution}\norigin: [-1.0, -2.0, 0.0]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    return {f"{name}.yaml": yaml.encode(), f"{name}.pgm": f"P5\n{width} {height}\n255\n".encode() + pixels}


KML = b"""\
<?xml version="1.0" encoding="UTF-8"?>
<kml xmlns="http://www.opengis.net/kml/2.2"><Document><name>drawing</name>
<Placemark><name>lane</name><LineString><coordinates>-0.5245,53.2686 -0.5244,53.2686 -0.5244,53.2687</coordinates>
</LineString></Placemark></Document></kml>
"""

OSM = b"""\
<osm version="0.6" copyright="Some Mappers" attribution="https://example.org/copyright">
 <bounds minlat="53.268" minlon="-0.525" maxlat="53.269" maxlon="-0.524"/>
 <node id="1" lat="53.2682" lon="-0.5248"/><node id="2" lat="53.2684" lon="-0.5246"/>
 <way id="3"><nd ref="1"/><nd ref="2"/><tag k="highway" v="track"/></way>
</osm>
"""

MORE_OSM = b"""\
<osm version="0.6"><bounds minlat="53.2681" minlon="-0.5249" maxlat="53.27" maxlon="-0.523"/>
 <node id="4" lat="53.2692" lon="-0.5238"/><node id="5" lat="53.2694" lon="-0.5236"/>
 <way id="6"><nd ref="4"/><nd ref="5"/><tag k="highway" v="track"/></way>
</osm>
"""
