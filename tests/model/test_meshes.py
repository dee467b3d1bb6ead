"""Meshes compared with trimesh and pycollada on real files, values computed by hand, and hostile files."""

from __future__ import annotations

import io
import struct
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.errors import Invalid, TooLarge
from app.model.meshes import Mesh, read_mesh


def stl(*triangles: Any, count: int | None = None, head: bytes = b"") -> bytes:
    body = b"".join(struct.pack("<12fH", 0, 0, 0, *np.ravel(t), 0) for t in triangles)
    return head.ljust(80, b" ") + struct.pack("<I", len(triangles) if count is None else count) + body


TRIANGLE = ((0, 0, 0), (2, 0, 0), (0, 3, 1))

ASCII = """solid a name
 facet normal 0 0 1
  outer loop
   vertex 0 0 0
   vertex 2.0 0 0
   vertex 0 3e0 1
  endloop
 endfacet
endsolid a name
"""


def dae(body: str, scene: str = "", unit: str = "1", libraries: str = "") -> bytes:
    show = (
        f'<library_visual_scenes><visual_scene id="s">{scene}</visual_scene></library_visual_scenes>'
        '<scene><instance_visual_scene url="#s"/></scene>'
    )
    return (
        '<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">'
        f'<asset><unit meter="{unit}"/><up_axis>Y_UP</up_axis></asset>'
        f'<library_geometries><geometry id="g" name="shape"><mesh>'
        '<source id="p"><float_array id="a" count="12">0 0 0  1 0 0  1 1 0  0 1 0</float_array><technique_common>'
        '<accessor source="#a" count="4" stride="3"/></technique_common></source>'
        '<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>'
        f"{body}</mesh></geometry></library_geometries>{libraries}{show if scene else ''}</COLLADA>"
    ).encode()


INPUT = '<input semantic="VERTEX" source="#v" offset="0"/>'
ONE = f'<triangles count="1">{INPUT}<p>0 1 2</p></triangles>'
SHOWN = '<node name="n"><instance_geometry url="#g"/></node>'


def of_files(data: Path) -> list[Path]:
    paths = [p for p in sorted(data.rglob("*")) if p.suffix.lower() in (".dae", ".stl")]
    assert len(paths) == 21
    return paths


def test_real_meshes_equal_trimesh(shared: Path, facts_json: dict[str, Any]) -> None:
    import trimesh

    data = shared / "data"
    collada_names = {name for name, fact in facts_json.items() if fact["kind"] == "collada"}
    for path in of_files(data):
        name = path.relative_to(data).as_posix()
        content = path.read_bytes()
        mesh = read_mesh(content, name)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            loaded: Any = trimesh.load(io.BytesIO(content), file_type=path.suffix[1:].lower(), process=False)
            other: Any = loaded.to_geometry() if isinstance(loaded, trimesh.Scene) else loaded
        unit = 1.0
        if name in collada_names:
            facts = facts_json[name]["facts"]
            unit = float(facts["unit_meter"])
            assert len({names[-1] for names in mesh.names}) == facts["geometries"], name
        ours = np.sort(mesh.triangles().reshape(-1, 9), axis=0)
        theirs = np.sort(np.asarray(other.triangles, np.float64).reshape(-1, 9) * unit, axis=0)
        assert ours.shape == theirs.shape, name
        assert np.abs(ours - theirs).max() < 1e-6, name  # they store 32 bits


def test_turtlebot_wall_is_in_inches_and_unrotated(shared: Path) -> None:
    path = shared / "data/gazebo_sdf/turtlebot3_world/models/turtlebot3_world/meshes/wall.dae"
    mesh = read_mesh(path.read_bytes(), path.name)
    assert len(mesh.faces) == 48
    assert mesh.vertices.max(axis=0) == pytest.approx([450 * 0.0254, 519.615 * 0.0254, 200 * 0.0254])
    assert mesh.vertices.min(axis=0) == pytest.approx([-450 * 0.0254, -519.615 * 0.0254, 0])


@pytest.mark.parametrize(
    "data",
    [
        stl(TRIANGLE),
        stl(TRIANGLE, head=b"solid binary with a lying head"),
        stl(TRIANGLE) + b"trailing",
        ASCII.encode(),
        ASCII.upper().encode(),
    ],
)
def test_stl_is_read_as_binary_and_text(data: bytes) -> None:
    mesh = read_mesh(data, "a.STL")
    assert mesh.vertices[mesh.faces].tolist() == [[list(map(float, v)) for v in TRIANGLE]]


def test_obj_reads_polygons_negative_indexes_and_parts() -> None:
    text = (
        "# two things\nmtllib http://example.org/evil.mtl\no first\nv 0 0 0\nv\t1 0 0 1.0\nv 1 1 0\nv 0 1 0\n"
        "vn 0 0 1\nf 1//1 2//1 3//1 4//1\ng second\nv 5 5 5\nf -1 -2 \\\n -3\n"
    )
    mesh = read_mesh(text.encode(), "a.obj")
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [4, 3, 2]]
    assert mesh.triangles("second").tolist() == [[[5, 5, 5], [0, 1, 0], [1, 1, 0]]]
    assert len(mesh.triangles("first")) == 2
    with pytest.raises(Invalid, match="unknown submesh 'third': the mesh has first, second"):
        mesh.triangles("third")


@pytest.mark.parametrize(
    ("body", "faces"),
    [
        (ONE, [[0, 1, 2]]),
        (f"<polylist>{INPUT}<vcount>4 3</vcount><p>0 1 2 3 0 1 2</p></polylist>", [[0, 1, 2], [0, 2, 3], [0, 1, 2]]),
        (f"<polygons>{INPUT}<p>0 1 2 3</p><p>1 2 3</p></polygons>", [[0, 1, 2], [0, 2, 3], [1, 2, 3]]),
        (f"<trifans>{INPUT}<p>0 1 2 3</p></trifans>", [[0, 1, 2], [0, 2, 3]]),
        (f"<tristrips>{INPUT}<p>0 1 3 2</p></tristrips>", [[0, 1, 3], [2, 3, 1]]),
        (
            '<triangles><input semantic="NORMAL" source="#p" offset="0"/><input semantic="VERTEX" source="#v" '
            'offset="1"/><p>3 0 3 1 3 2</p></triangles>',
            [[0, 1, 2]],
        ),
        (f"<lines>{INPUT}<p>0 1</p></lines>{ONE}", [[0, 1, 2]]),
    ],
)
def test_collada_reads_every_primitive(body: str, faces: list[list[int]]) -> None:
    assert read_mesh(dae(body, SHOWN), "a.dae").faces.tolist() == faces
    assert read_mesh(dae(body), "a.dae").faces.tolist() == faces, "without a scene all geometries count"


def test_collada_applies_scene_transforms_before_unit() -> None:
    scene = (
        "<node><translate>10 0 0</translate><rotate>0 0 1 90</rotate><scale>2 2 2</scale>"
        '<node name="inner"><matrix>1 0 0 1  0 1 0 0  0 0 1 0  0 0 0 1</matrix><instance_geometry url="#g"/></node>'
        '<instance_node url="#lib"/></node>'
    )
    library = '<library_nodes><node id="lib" name="other"><instance_geometry url="#g"/></node></library_nodes>'
    mesh = read_mesh(dae(ONE, scene, "0.01", library), "a.dae")
    # (0,0,0) -> matrix (1,0,0) -> scale (2,0,0) -> turn (0,2,0) -> shift (10,2,0) -> centimetres
    assert mesh.triangles("inner")[0] == pytest.approx(np.array([[0.10, 0.02, 0], [0.10, 0.04, 0], [0.08, 0.04, 0]]))
    assert mesh.triangles("other")[0] == pytest.approx(np.array([[0.10, 0, 0], [0.10, 0.02, 0], [0.08, 0.02, 0]]))
    middle = mesh.triangles("other", centre=True)[0]
    assert middle.min(axis=0) == pytest.approx(-middle.max(axis=0))


def test_skinned_mesh_uses_bind_shape() -> None:
    library = (
        '<library_controllers><controller id="c"><skin source="#g"><bind_shape_matrix>1 0 0 0 0 1 0 0 0 0 1 7 0 0 0 1'
        "</bind_shape_matrix></skin></controller></library_controllers>"
    )
    mesh = read_mesh(dae(ONE, '<node><instance_controller url="#c"/></node>', "1", library), "a.dae")
    assert mesh.vertices[:, 2].tolist() == [7, 7, 7, 7]


def nested(depth: int) -> bytes:
    """Return nodes that instantiate the next one twice each: 2^depth instances in a few lines."""
    nodes = "".join(
        f'<node id="d{k}"><instance_node url="#d{k + 1}"/><instance_node url="#d{k + 1}"/></node>' for k in range(depth)
    )
    last = f'<node id="d{depth}"><instance_geometry url="#g"/></node>'
    return dae(ONE, '<node><instance_node url="#d0"/></node>', "1", f"<library_nodes>{nodes}{last}</library_nodes>")


WIDE = dae(
    "",
    '<node><instance_node url="#w"/></node>' * 3000,
    "1",
    '<library_nodes><node id="w">' + '<instance_geometry url="#g"/>' * 3000 + "</node></library_nodes>",
)
"""Return nine million instances of an empty node."""

LOOP = dae(
    ONE,
    '<node><instance_node url="#l"/></node>',
    "1",
    '<library_nodes><node id="l"><instance_node url="#l"/></node></library_nodes>',
)
BOMB = (
    b'<?xml version="1.0"?><!DOCTYPE a [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;">]>'
    b"<COLLADA><asset/>&b;</COLLADA>"
)


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("a.stl", b"", "the header states"),
        ("a.stl", stl(TRIANGLE, count=2**31), "header states 2147483648 triangles, but there are 1"),
        ("a.stl", stl(TRIANGLE)[:-1], "header states 1 triangles, but there are 0"),
        ("a.stl", stl(((0, 0, 0), (float("nan"), 0, 0), (0, 1, 0))), "finite"),
        ("a.stl", stl(((0, 0, 0), (3e38, 0, 0), (0, 1, 0))), "finite"),
        ("a.stl", stl(), "no triangles"),
        ("a.stl", ASCII.replace("   vertex 2.0 0 0\n", "").encode(), "need 3 vertices, but there are 2"),
        ("a.stl", ASCII.replace("2.0", "two").encode(), "could not convert"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", "missing vert"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", "missing vert"),
        ("a.obj", b"v 0 0\n", "three numbers"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 nan 0\nf 1 2 3\n", "finite"),
        ("a.obj", b"\xff\xfe\x00", "no triangles"),
        ("a.dae", BOMB, "DOCTYPE"),
        ("a.dae", b"<kml/>", "not COLLADA"),
        ("a.dae", b"<COLLADA>", "Premature end"),
        ("a.dae", LOOP, "nested deeper"),
        ("a.dae", WIDE, "more than 100000 elements"),
        ("a.dae", nested(40), "nested deeper"),
        ("a.dae", dae(f"<polylist>{INPUT}<vcount>2147483647</vcount><p>0 1 2</p></polylist>", SHOWN), "does not fit"),
        ("a.dae", dae(f"<polylist>{INPUT}<vcount>-3 6</vcount><p>0 1 2</p></polylist>", SHOWN), "does not fit"),
        ("a.dae", dae(ONE.replace("0 1 2", "0 1 9"), SHOWN), "missing vert"),
        ("a.dae", dae(ONE.replace("0 1 2", "0 1 -1"), SHOWN), "missing vert"),
        ("a.dae", dae(ONE.replace("0 1 2", "0 1"), SHOWN), "three vertices"),
        ("a.dae", dae(ONE.replace("#v", "file:///etc/passwd"), SHOWN), "no positions"),
        ("a.dae", dae(ONE.replace('offset="0"', 'offset="1000000000"'), SHOWN), "offset"),
        ("a.dae", dae(ONE, SHOWN).replace(b'stride="3"', b'stride="1"'), "three numbers"),
        ("a.dae", dae(ONE, SHOWN).replace(b"1 1 0", b"1 x 0"), "could not convert"),
        ("a.dae", dae(ONE, SHOWN, "nan"), "unit"),
        ("a.dae", dae(ONE, SHOWN, "0"), "unit"),
        ("a.dae", dae(ONE, "<node><scale>1e200 1e200 1e200</scale>" + SHOWN + "</node>"), "finite"),
        ("a.dae", dae("", SHOWN), "no triangles"),
        ("a.fbx", b"", "use one of .dae, .obj, .stl"),
    ],
)
def test_rejected_mesh_names_file(name: str, data: bytes, message: str) -> None:
    start = time.process_time()
    with pytest.raises(Invalid) as caught:
        read_mesh(data, f"models/{name}")
    assert message in caught.value.detail
    assert caught.value.detail.startswith(f"models/{name} ")
    assert caught.value.problems[0].file == f"models/{name}"
    assert time.process_time() - start < 20


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("a.stl", stl(*[TRIANGLE] * 11)),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n" + b"f 1 2 3\n" * 11),
        ("a.dae", dae(ONE.replace("<p>0 1 2</p>", "<p>" + "0 1 2 " * 11 + "</p>"), SHOWN)),
        ("a.dae", dae(ONE, SHOWN * 11)),
    ],
)
def test_mesh_triangles_are_limited(name: str, data: bytes) -> None:
    assert len(read_mesh(data, name, 11).faces) == 11
    with pytest.raises(TooLarge, match=f"{name} has .* triangles; the limit is 10"):
        read_mesh(data, name, 10)


def test_large_mesh_is_read_quickly() -> None:
    n = 200_000
    data = stl(*[TRIANGLE]).replace(struct.pack("<I", 1), struct.pack("<I", n), 1) + stl(TRIANGLE)[84:] * (n - 1)
    start = time.process_time()
    mesh: Mesh = read_mesh(data, "a.stl")
    assert len(mesh.faces) == n
    assert time.process_time() - start < 20
