"""gazebo: worlds computed by hand, real worlds, libsdformat's own check if installed, grids as walls."""

# ruff: noqa: E501 - lines of XML

from __future__ import annotations

import math
import re
import struct
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from lxml import etree

from app import formats
from app.convert.files import offline
from app.errors import Ambiguous, BadUpload, MissingDatum, MissingLayer, NotFound, TooLarge, UnreadableFile
from app.formats import WriteContext, gazebo, get_format
from app.formats.gazebo import bodies, writing
from app.formats.gazebo.library import Library
from app.formats.gazebo.writing import WriteOptions
from app.limits import Limits
from app.model import solids
from app.model.features import Features, features
from app.model.frame import Datum, Level
from app.model.grid import OccupancyGrid
from app.model.layers import Layers, PartKey, Resources
from app.model.meshes import read_mesh
from app.upload_reader import Bundle, EnvironmentContext, UploadHints, unpack
from app.upload_reader import read as read_bundle
from tests import libsdformat

SAMPLES = Path(__file__).resolve().parents[1] / "samples" / "gazebo"
LIMITS = Limits()
Same = Callable[[str, dict[str, bytes], dict[str, bytes]], list[str]]
OBJECTS = PartKey("objects", name="gazebo")
RESOURCES = PartKey("resources", name="gazebo")


DATA = Path(__file__).resolve().parents[3] / "shared" / "data"


def folder(path: Path) -> dict[str, bytes]:
    return {p.relative_to(path).as_posix(): p.read_bytes() for p in sorted(path.rglob("*")) if p.is_file()}


def read_upload(files: dict[str, bytes], name: str | None = None, context: EnvironmentContext | None = None) -> Bundle:
    return read_bundle(unpack(files, LIMITS), UploadHints(name), context or EnvironmentContext(), LIMITS)


def objects(bundle: Bundle) -> Features:
    part = bundle.parts[OBJECTS]
    assert isinstance(part, Features)
    return part


def resources(bundle: Bundle) -> dict[str, bytes]:
    part = bundle.parts[RESOURCES]
    assert isinstance(part, Resources)
    return dict(part.files)


def world(inner: str, version: str = "1.7", name: str = "w") -> dict[str, bytes]:
    return {"a.world": f'<sdf version="{version}"><world name="{name}">{inner}</world></sdf>'.encode()}


def one(inner: str, **more: Any) -> dict[str, Any]:
    """Return the properties of the first object of a world."""
    return dict(objects(read_upload(world(inner, **more))).properties[0])


def write(
    parts: dict[PartKey, Any], datum: Datum | None = None, levels: Any = None, **options: Any
) -> dict[str, bytes]:
    return report(parts, datum, levels, **options)[0]


def report(
    parts: dict[PartKey, Any], datum: Datum | None = None, levels: Any = None, **options: Any
) -> tuple[dict[str, bytes], WriteContext]:
    context = WriteContext(title="here", options=WriteOptions(**options))
    layers = Layers(parts, datum, levels or (Level(),))
    files = formats.write(get_format("gazebo"), layers, context)
    check(files)
    return files, context


def check(files: dict[str, bytes]) -> list[str]:
    """Return libsdformat's complaints about a bundle, except missing files (none if it is not installed)."""
    if libsdformat.LIBRARY is None:
        return []
    import tempfile

    with tempfile.TemporaryDirectory() as at:
        for name, data in files.items():
            path = Path(at) / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        models = f"{at}/models"
        _, output = libsdformat.check(Path(at) / "world.sdf", {"SDF_PATH": models, "GZ_SIM_RESOURCE_PATH": models})
    lines = output.splitlines()
    errors = [
        re.sub(r"\[/sdf.*?\]: ", "", n) for n in lines if "Error" in n and "findFile" not in n and "backward" not in n
    ]
    if not errors:
        assert "Valid" in output
    return errors


def tree(files: dict[str, bytes]) -> etree._Element:
    world = etree.fromstring(files["world.sdf"]).find("world")
    assert world is not None
    return world


# --- our own samples ---------------------------------------------------------------------------------------------
def test_yard_matches_values_computed_by_hand() -> None:
    bundle = read_upload(folder(SAMPLES / "yard"))
    part = objects(bundle)
    assert {(i, p["kind"]) for i, p in zip(part.ids, part.properties, strict=True)} == {
        ("sun", "light"), ("ground_plane", "model"), ("post", "model"), ("sign", "model"), ("crate", "include"),
        ("spare crate", "include"), ("oak", "include"), ("entrance", "model"),
    }  # fmt: skip
    by = {f.id: f for f in part}
    quarter = round(math.pi / 2, 9)
    # The sign is 2 m along the x axis of a frame at (10, 20) rotated by 90 degrees: north of it.
    assert by["sign"].properties["pose"] == [10.0, 22.0, 0.0, 0.0, 0.0, quarter]
    # Nothing of the sign collides, so what is seen of it is its solid; its board is turned once more: along x again.
    assert by["sign"].properties["shapes"] == [
        {"type": "box", "size": [1.0, 0.1, 0.5], "pose": [0.0, 0.0, 1.0, 0.0, 0.0, quarter], "visual": True}
    ]
    assert shapely.equals_exact(by["sign"].geometry.normalize(), shapely.box(9.5, 21.95, 10.5, 22.05).normalize(), 1e-9)
    # The crate: a cube of 1 m twice as long along x, half a metre up; the include's own pose turns it to the north.
    assert by["crate"].properties["shapes"] == [
        {
            "type": "mesh", "file": "models/crate/meshes/crate.stl", "scale": [2.0, 1.0, 1.0],
            "pose": [0.0, 0.0, 0.5, 0.0, 0.0, 0.0],
        }
    ]  # fmt: skip
    assert by["crate"].properties["size"] == [2.0, 1.0, 1.0]
    assert by["crate"].geometry.bounds == pytest.approx((-3.5, -5.0, -2.5, -3.0))
    # An include without a pose uses the pose of its model.
    assert by["spare crate"].properties["pose"] == [7.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    assert by["oak"].geometry == shapely.Point(5, 5), "only its position is in the upload"
    # The gate is 1 m north of its model at (0, 8), its right post 4 m right of the left one.
    assert by["entrance"].geometry.bounds == pytest.approx((-2.1, 8.9, 2.1, 9.1))
    assert by["entrance"].geometry.area == pytest.approx(0.08)
    assert by["ground_plane"].geometry.bounds == (-30.0, -20.0, 30.0, 20.0)
    assert bundle.datum == Datum(53.2686, -0.5245, 12.5, heading=-30.0)
    problems = [w.problem for w in bundle.warnings]
    assert any("moves 1 of 8 objects (post)" in p for p in problems)
    assert any("names 1 unknown objects: ghost" in p for p in problems)
    assert any("Oak tree is remote and not fetched" in p for p in problems)
    assert by["post"].properties["gazebo"]["state"] == [1.0, 2.5, 0.5, 0.0, 0.0, 0.0]
    files = folder(SAMPLES / "yard")
    assert resources(bundle) == {n: d for n, d in files.items() if n.startswith("models/")}
    assert all(use.used for use in bundle.files.values())


def test_yard_round_trips(same: Same) -> None:
    files = folder(SAMPLES / "yard")
    out = offline(files, "gazebo").files
    assert next(iter(out)) == "world.sdf"
    assert same("gazebo", files, out) == []
    back = tree(out)
    assert back.find("plugin/rain") is not None
    assert back.find("model[@name='sign']/plugin") is not None
    assert back.find("model[@name='sign']/pose").get("relative_to") == "corner"
    assert back.find("state") is None
    assert back.find("gui") is not None
    if libsdformat.LIBRARY:
        # both are the upload's own words: an address of another machine, and one that libsdformat does not know
        missing_uris = ("https://fuel.gazebosim.org/1.0/openrobotics/models/Oak tree", "file://models/crate")
        assert sorted(check(out)) == sorted(f"Error Code 13: Msg: Unable to find uri[{uri}]" for uri in missing_uris)


def test_heading_is_negated_in_datum() -> None:
    """heading_deg 30 in a world: libignition-math puts a point 100 m along the world's x axis 86.603 m east and 50 m
    north of the origin, and one along its y axis 50 m west and 86.603 m north (LOCAL2 to SPHERICAL, version 6.10)."""
    datum = read_upload(folder(SAMPLES / "yard")).datum
    assert datum is not None
    frame = Layers({}, datum).frame
    assert frame is not None
    north_up = Layers({}, Datum(datum.latitude, datum.longitude)).frame
    assert north_up is not None
    earth = frame.to_wgs84(np.array([[100.0, 0.0], [0.0, 100.0]]))
    assert north_up.to_local(earth) == pytest.approx(np.array([[86.6025, 50.0], [-50.0, 86.6025]]), abs=1e-3)


def test_coordinates_match_libignition_math() -> None:
    """Latitude 53.27, longitude -0.52, heading_deg 30: (100, 0) is at 53.2704492641, -0.5187019410 and (0, 100) at
    53.2707781582, -0.5207494405 (libignition-math 6.10, LOCAL2 to SPHERICAL)."""
    place = (
        "<spherical_coordinates><latitude_deg>53.27</latitude_deg><longitude_deg>-0.52</longitude_deg>"
        "<elevation>0</elevation><heading_deg>30</heading_deg></spherical_coordinates>"
    )
    datum = read_upload(world(place + "<model name='m'><link name='l'/></model>")).datum
    frame = Layers({}, datum).frame
    assert frame is not None
    earth = frame.to_wgs84(np.array([[100.0, 0.0], [0.0, 100.0]]))
    truth = np.array([[-0.5187019410, 53.2704492641], [-0.5207494405, 53.2707781582]])
    assert np.abs(earth - truth).max() < 1e-8


def test_orchard_list_becomes_a_world() -> None:
    bundle = read_upload(folder(SAMPLES / "orchard"))
    part = objects(bundle)
    assert part.ids == ("grass", "tree", "tree#2", "shed", "barrow")
    by = {f.id: f for f in part}
    # The trunk is 1 m along x of the tree's frame, which is rotated by 90 degrees at (4, 3): at (4, 4).
    x, y = by["tree"].geometry.centroid.coords[0]
    assert (x, y) == pytest.approx((4.0, 4.0), abs=1e-6)
    assert by["tree#2"].geometry.centroid.coords[0] == pytest.approx((-3.0, 0.0), abs=1e-6)
    assert [s.get("visual", False) for s in by["tree"].properties["shapes"]] == [False, True], "crowns do not collide"
    assert by["shed"].geometry.bounds == (9.0, -1.5, 11.0, 1.5)
    assert by["grass"].properties["size"] == [30.0, 20.0, 0.0]
    assert any("custom_models/barrow.yaml is not in the upload" in w.problem for w in bundle.warnings)
    answer = offline(folder(SAMPLES / "orchard"), "gazebo")
    assert check(answer.files) == []
    world = tree(answer.files)
    assert [m.get("name") for m in world.iterchildren("model")] == ["grass", "ground_plane", "shed", "tree", "tree_2"]
    assert len(world.findall("model[@name='tree']//collision")) == 1
    assert len(world.findall("model[@name='tree']//visual")) == 2
    assert world.findtext("model[@name='grass']//script/name") == "Gazebo/DarkGrey"
    assert {t["what"]: t["option"] for t in answer.report.as_dict()["template"]} == {
        "ground plane": "ground",
        "colour of ground": "ground_colour",
        "sun": "sun",
    }
    assert [(d["what"], d["count"]) for d in answer.report.as_dict()["dropped"]] == [
        ("objects of kind model", 1),
        ("solids of objects of kind model", 1),
    ]


def test_single_model_becomes_a_world() -> None:
    bundle = read_upload(folder(SAMPLES / "cart"))
    (cart,) = objects(bundle)
    assert cart.properties["pose"] == [2.0, 3.0, 0.0, 0.0, 0.0, 0.0]
    assert cart.geometry.bounds == pytest.approx((1.4, 2.6, 2.6, 3.4))
    assert cart.properties["size"] == [1.2, 0.8, 0.8]
    assert all(use.used for use in bundle.files.values()), "its model.config goes along"
    out = offline(folder(SAMPLES / "cart"), "gazebo").files
    assert {m.get("name") for m in tree(out).iterchildren("model")} == {"cart", "ground_plane"}
    assert set(out) == {"world.sdf"}
    assert check(out) == []


def test_single_model_keeps_its_meshes() -> None:
    cube = (SAMPLES / "yard/models/crate/meshes/crate.stl").read_bytes()
    for uri, served in (("meshes/a.stl", "meshes/a.stl"), ("model://cart/meshes/a.stl", "models/cart/meshes/a.stl")):
        mesh = f"<collision name='c'><geometry><mesh><uri>{uri}</uri></mesh></geometry></collision>"
        model = f"<sdf version='1.6'><model name='cart'><link name='l'>{mesh}</link></model></sdf>".encode()
        files = {"my/cart/model.sdf": model, "my/cart/meshes/a.stl": cube}
        assert objects(read_upload(files)).properties[0]["shapes"] == [
            {"type": "mesh", "file": served, "scale": [1, 1, 1]}
        ]
        out = offline(files, "gazebo").files
        assert out[served] == cube
        assert offline(out, "gazebo").files == out


# --- poses and frames --------------------------------------------------------------------------------------------
LINK = "<link name='l'><collision name='c'><geometry><box><size>2 1 1</size></box></geometry></collision></link>"


def test_poses_of_every_kind_are_read() -> None:
    quarter = round(math.pi / 2, 9)
    turned = "0 0 0.7071067811865476 0.7071067811865476"
    for xml, pose in {
        "<pose>1 2 3 0.1 0.2 0.3</pose>": [1.0, 2.0, 3.0, 0.1, 0.2, 0.3],
        "<pose degrees='true'>1 2 3 0 0 90</pose>": [1.0, 2.0, 3.0, 0.0, 0.0, quarter],
        f"<pose rotation_format='quat_xyzw'>1 2 3 {turned}</pose>": [1.0, 2.0, 3.0, 0.0, 0.0, quarter],
        "<pose>1 2</pose>": [1.0, 2.0, 0.0, 0.0, 0.0, 0.0],
        "<pose/>": [0.0] * 6,
        "<pose frame=''>1 0 0 0 0 0</pose>": [1.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    }.items():
        assert one(f"<model name='m'>{xml}{LINK}</model>")["pose"] == pytest.approx(pose, abs=1e-9), xml
    for bad in ("1 2 3 4 5 6 7", "nan 0 0 0 0 0", "1e999 0 0 0 0 0", "a b c d e f", "1_0 0 0 0 0 0", "1e8 0 0 0 0 0"):
        with pytest.raises(UnreadableFile) as caught:
            read_upload(world(f"<model name='m'><pose>{bad}</pose>{LINK}</model>"))
        assert caught.value.problems[0].file == "a.world"
        assert caught.value.problems[0].line == 1
    with pytest.raises(UnreadableFile):
        read_upload(world("<model name='m'><pose rotation_format='quat_xyzw'>0 0 0 0 0 0 0</pose></model>"))


def test_frames_in_worlds_and_models_are_resolved() -> None:
    part = objects(
        read_upload(
            world(
                "<model name='a'><pose>10 0 0 0 0 1.5707963267948966</pose>"
                "<link name='l'><pose>1 0 0 0 0 0</pose></link></model>"
                f"<model name='b'><pose relative_to='a'>2 0 0 0 0 0</pose>{LINK}</model>"
                f"<model name='c'><pose relative_to='a::l'>2 0 0 0 0 0</pose>{LINK}</model>"
                f"<model name='d'><pose relative_to='f'>0 0 5 0 0 0</pose>{LINK}</model>"
                "<frame name='f' attached_to='b'><pose>0 1 0 0 0 0</pose></frame>"
                f"<model name='e' placement_frame='l'><pose>5 5 0 0 0 0</pose>"
                "<link name='l'><pose>1 1 0 0 0 0</pose></link></model>",
            )
        )
    )
    pose = {f.id: [round(v, 6) + 0.0 for v in f.properties["pose"][:3]] for f in part}
    # a looks north at (10, 0); b is 2 m in front of it; a's link 1 m in front, c 2 m in front of that; f is 1 m left of
    # b, which is west; e is placed so that its link is at (5, 5).
    assert pose == {
        "a": [10, 0, 0], "b": [10, 2, 0], "c": [10, 3, 0], "d": [9, 2, 5], "e": [4, 4, 0],
    }  # fmt: skip
    inside = one(
        "<model name='m'><link name='p'><pose>0 0 1 0 0 0</pose></link>"
        "<link name='q'><pose relative_to='p'>0 0 1 0 0 0</pose>"
        "<collision name='c'><pose relative_to='j'>0 0 0.5 0 0 0</pose><geometry><sphere><radius>1</radius></sphere>"
        "</geometry></collision></link>"
        "<joint name='j' type='fixed'><pose>3 0 0 0 0 0</pose><parent>p</parent><child>q</child></joint>"
        "<model name='n'><pose relative_to='q'>1 0 0 0 0 0</pose><link name='l'>"
        "<collision name='c'><geometry><sphere><radius>2</radius></sphere></geometry></collision></link></model>"
        "</model>"
    )
    # q is 1 m above p, the joint is 3 m along x in q's frame, the sphere half a metre above; n beside q.
    assert {(s["radius"], *s["pose"][:3]) for s in inside["shapes"]} == {(1.0, 3.0, 0.0, 2.5), (2.0, 1.0, 0.0, 2.0)}


def test_unknown_and_cyclic_frames_give_a_warning() -> None:
    bundle = read_upload(
        world(
            "<model name='a'><pose relative_to='b'>1 0 0 0 0 0</pose></model>"
            "<model name='b'><pose relative_to='a'>1 0 0 0 0 0</pose></model>"
            "<model name='c'><pose relative_to='nowhere'>1 0 0 0 0 0</pose></model>"
        )
    )
    assert len(objects(bundle)) == 3
    problems = " ".join(w.problem for w in bundle.warnings)
    assert "cycle" in problems
    assert "'nowhere' is unknown" in problems


def test_shapes_of_every_kind_are_read() -> None:
    def shape(inner: str) -> Any:
        link = f"<link name='l'><collision name='c'><geometry>{inner}</geometry></collision></link>"
        return one(f"<model name='m'>{link}</model>", version="1.11").get("shapes")

    assert shape("<box><size>1 2 3</size></box>") == [{"type": "box", "size": [1, 2, 3]}]
    assert shape("<cylinder><radius>2</radius><length>3</length></cylinder>") == [
        {"type": "cylinder", "radius": 2, "length": 3}
    ]
    assert shape("<capsule><radius>2</radius><length>3</length></capsule>") == [
        {"type": "capsule", "radius": 2, "length": 3}
    ]
    assert shape("<sphere><radius>2</radius></sphere>") == [{"type": "sphere", "radius": 2}]
    assert shape("<ellipsoid><radii>1 2 3</radii></ellipsoid>") == [{"type": "ellipsoid", "radii": [1, 2, 3]}]
    assert shape("<plane><normal>1 0 0</normal><size>4 5</size></plane>") == [
        {"type": "plane", "normal": [1, 0, 0], "size": [4, 5]}
    ]
    ring = "<polyline>{}<height>2</height></polyline>"
    outer = "".join(f"<point>{x} {y}</point>" for x, y in ((0, 0), (4, 0), (4, 4), (0, 4)))
    inner = "".join(f"<point>{x} {y}</point>" for x, y in ((1, 1), (2, 1), (2, 2)))
    (line,) = shape(ring.format(outer) + ring.format(inner))
    assert line["height"] == 2
    assert [len(r) for r in line["points"]] == [4, 3]
    assert shape("<empty/>") is None
    cone = "<cone><radius>1</radius><length>2</length></cone>"
    assert shape(cone) == [{"type": "cone", "uri": "<cone>"}], "solid, whatever it is"
    with pytest.raises(UnreadableFile, match="3 numbers"):
        shape("<box><size>1 2</size></box>")


def test_shapes_round_trip() -> None:
    shapes = [
        {"type": "box", "size": [1.0, 2.0, 3.0], "pose": [1.0, 0.0, 0.0, 0.0, 0.0, 0.5]},
        {"type": "cylinder", "radius": 2.0, "length": 3.0},
        {"type": "capsule", "radius": 2.0, "length": 3.0},
        {"type": "sphere", "radius": 2.0, "visual": True},
        {"type": "ellipsoid", "radii": [1.0, 2.0, 3.0]},
        {"type": "plane", "normal": [0.0, 0.0, 1.0], "size": [4.0, 5.0]},
        {"type": "polyline", "points": [[[0.0, 0.0], [4.0, 0.0], [4.0, 4.0]], [[1.0, 0.5], [2.0, 0.5], [2.0, 1.0]]], "height": 2.0},
        {"type": "mesh", "file": "m/cube.stl", "scale": [2.0, 1.0, 1.0]},
    ]  # fmt: skip
    rows = [("a", shapely.Point(0, 0), {"kind": "thing", "shapes": shapes, "pose": [1.0, 2.0, 3.0, 0.0, 0.0, 0.5]})]
    cube = (SAMPLES / "yard/models/crate/meshes/crate.stl").read_bytes()
    parts = {
        PartKey("objects", name="other"): features(rows, "local"),
        PartKey("resources", name="other"): Resources({"m/cube.stl": cube}),
    }
    files = write(parts)
    assert check(files) == []
    assert files["models/m/cube.stl"] == cube
    assert etree.fromstring(files["world.sdf"]).get("version") == "1.8", "capsules came with 1.8"
    back = {f.id: f for f in objects(read_upload(files))}["a"]
    assert back.properties["pose"] == rows[0][2]["pose"]
    assert back.properties["shapes"] == [
        {**s, "file": "models/m/cube.stl"} if s["type"] == "mesh" else s for s in shapes if not s.get("visual")
    ]


# --- uploads -----------------------------------------------------------------------------------------------------
def test_several_worlds_share_one_part() -> None:
    """Each world keeps its own objects and settings; a selected world contains nothing of the others."""
    first = b'<sdf version="1.5"><world name="one"><gravity>0 0 -1</gravity><model name="m"><link name="l"/></model></world></sdf>'
    second = b'<sdf version="1.6"><world name="two"><wind/><model name="m"><link name="k"/></model></world></sdf>'
    files = {"w/short.world": first, "w/longer.world.xml": second}
    bundle = read_upload(files)
    assert objects(bundle).ids == ("m", "m#2")
    assert set(objects(bundle).document["gazebo"]["worlds"]) == {"w/short", "w/longer"}
    answer = offline(files, "gazebo")
    assert tree(answer.files).get("name") == "one"
    assert tree(answer.files).findtext("gravity") == "0 0 -1"
    assert [m.find("link").get("name") for m in tree(answer.files).iterchildren("model")] == ["l"]
    assert any("longer" in w["problem"] for w in answer.report.as_dict()["warnings"])
    assert answer.report.as_dict()["dropped"] == [
        {"what": "objects of the world w/longer", "count": 1, "why": "request it with world=w/longer"}
    ]
    for name in ("longer", "w/longer"):
        other = offline(files, "gazebo", options={"world": name}).files
        assert tree(other).get("name") == "two"
        assert [m.get("name") for m in tree(other).iterchildren("model")] == ["m"]
        assert [m.find("link").get("name") for m in tree(other).iterchildren("model")] == ["k"]
    with pytest.raises(NotFound, match="w/longer"):
        offline(files, "gazebo", options={"world": "none"})


def test_limo_track_worlds_round_trip(shared: Path, same: Same) -> None:
    root = shared / "data/environment_template/indoor-agilex-limo-track"
    files = folder(root)
    bundle = read_upload(files)
    prefix = "config/world/"
    names = ["potholes", "potholes_simple", "simple", "simulation_table"]
    assert sorted(objects(bundle).document["gazebo"]["worlds"]) == [prefix + n for n in names]
    for name in names:
        world_files = {
            n: d
            for n, d in files.items()
            if n.startswith(prefix + "custom_models/") or n == f"{prefix}{name}.world.xml"
        }
        out = offline(files, "gazebo", options={"world": name}).files
        assert same("gazebo", world_files, out) == []
        model_names = {"simple": {"simple.stl"}}.get(name, {name})
        assert {n.split("/")[1] for n in out if n.startswith("models/")} == model_names, "only what this world needs"


def test_model_becomes_a_world_when_upload_has_none() -> None:
    model = b'<sdf version="1.6"><model name="%s">%s<link name="l"/></model></sdf>'
    files = {"models/a/model.sdf": model % (b"a", b""), "models/b/model.sdf": model % (b"b", b"")}
    assert set(objects(read_upload(files)).ids) == {"a", "b"}
    include = b"<include><uri>model://b</uri></include>"
    assert objects(read_upload({**files, "models/a/model.sdf": model % (b"a", include)})).ids == ("a",)
    bundle = read_upload({**files, **world("<include><uri>model://a</uri></include>")})
    assert objects(bundle).ids == ("a",)
    assert not bundle.files["models/b/model.sdf"].used
    assert any(w.file == "models/b/model.sdf" for w in bundle.warnings)


def test_files_of_a_world_are_no_other_maps() -> None:
    """A mesh, a texture or a list in a model's directory is no separate map."""
    kml = (
        b'<kml xmlns="http://www.opengis.net/kml/2.2"><Document><Placemark><name>p</name></Placemark></Document></kml>'
    )
    files = {
        **world("<include><uri>model://a</uri></include>"),
        "x/a/model.sdf": b'<sdf version="1.6"><model name="a"><link name="l"/></model></sdf>',
        "x/a/notes.kml": kml,
        "b.kml": kml,
    }
    groups, rest = formats.group(files)
    assert {(g.format.name, g.main) for g in groups} == {("gazebo", "a.world"), ("kml", "b.kml")}
    assert set(groups[0].files) == {"a.world", "x/a/model.sdf", "x/a/notes.kml"}
    assert rest == []
    assert resources(read_upload(files))["models/a/notes.kml"] == kml


@pytest.mark.parametrize(
    ("uri", "file", "served"),
    [
        ("model://a/m.stl", "models/a/m.stl", "models/a/m.stl"),
        ("model:///a/m.stl", "deep/down/a/m.stl", "models/a/m.stl"),
        ("model://m.stl", "x/m.stl", "models/m.stl"),
        ("file://models/a/m.stl", "y/models/a/m.stl", "models/a/m.stl"),
        ("file://models/a/m.stl", "y/a/m.stl", "models/a/m.stl"),
        ("meshes/m.stl", "meshes/m.stl", "meshes/m.stl"),
        ("model://b/c/m.stl", "models/b/c/m.stl", "models/b/c/m.stl"),
    ],
)
def test_meshes_are_found_in_upload(uri: str, file: str, served: str) -> None:
    cube = (SAMPLES / "yard/models/crate/meshes/crate.stl").read_bytes()
    mesh = f"<link name='l'><collision name='c'><geometry><mesh><uri>{uri}</uri></mesh></geometry></collision></link>"
    files = {**world(f"<model name='m'>{mesh}</model>"), file: cube}
    bundle = read_upload(files)
    assert objects(bundle).properties[0]["shapes"] == [{"type": "mesh", "file": served, "scale": [1, 1, 1]}]
    assert objects(bundle).geometry[0].area == pytest.approx(1.0)
    out = offline(files, "gazebo").files
    assert out[served] == cube
    assert objects(read_upload(out)).properties[0]["shapes"] == objects(bundle).properties[0]["shapes"]


@pytest.mark.parametrize(
    "uri",
    [
        "https://example.org/m.stl", "file:///etc/passwd", "model://../../m.stl", "../m.stl", "/etc/passwd", "~/m.stl",
        "model://a/%2e%2e/m.stl", "$HOME/m.stl", "a\\m.stl", "package://p/m.stl", "", "model://", "model://gone/m.stl",
    ],
)  # fmt: skip
def test_library_never_reads_outside_upload(uri: str) -> None:
    mesh = f"<link name='l'><collision name='c'><geometry><mesh><uri>{uri}</uri></mesh></geometry></collision></link>"
    files = {**world(f"<model name='m'>{mesh}</model>"), "sub/x.stl": b"x"}
    bundle = read_upload(files)
    assert objects(bundle).properties[0]["shapes"] == [{"type": "mesh", "uri": uri}], "an unreadable solid"
    assert any("upload" in w.problem or "is stored unchanged" in w.problem for w in bundle.warnings)
    assert uri in offline(files, "gazebo").files["world.sdf"].decode()


def test_cyclic_includes_raise_an_error_with_file() -> None:
    model = b'<sdf version="1.6"><model name="%s"><include><uri>model://%s</uri></include></model></sdf>'
    files = {"models/a/model.sdf": model % (b"a", b"b"), "models/b/model.sdf": model % (b"b", b"a")}
    for upload in (files, {**files, **world("<include><uri>model://a</uri></include>")}):
        with pytest.raises(UnreadableFile, match="includes itself") as caught:
            read_upload(upload)
        assert caught.value.problems[0].file


def test_exponential_includes_raise_too_large() -> None:
    files = world("<include><uri>model://m0</uri></include>")
    for k in range(8):
        inner = "".join(f"<include><name>n{j}</name><uri>model://m{k + 1}</uri></include>" for j in range(10))
        files[f"m{k}/model.sdf"] = f"<sdf version='1.7'><model name='m'>{inner}</model></sdf>".encode()
    files["m8/model.sdf"] = f"<sdf version='1.7'><model name='m'>{LINK}</model></sdf>".encode()
    with pytest.raises(TooLarge, match="shapes"):
        read_upload(files)


def test_broken_mesh_gives_a_warning() -> None:
    broken = b"\0" * 80 + struct.pack("<I", 2**31) + bytes(50)
    mesh = "<link name='l'><collision name='c'><geometry><mesh><uri>model://m.stl</uri></mesh></geometry></collision></link>"
    bundle = read_upload({**world(f"<model name='m'><pose>1 2 0 0 0 0</pose>{mesh}</model>"), "m.stl": broken})
    assert objects(bundle).geometry[0] == shapely.Point(1, 2)
    assert any(w.file and w.file.endswith("m.stl") and "solids are unknown" in w.problem for w in bundle.warnings)


def test_default_coordinates_give_no_datum_and_existing_datum_stays() -> None:
    place = "<spherical_coordinates><latitude_deg>{}</latitude_deg><longitude_deg>{}</longitude_deg><elevation>0</elevation><heading_deg>{}</heading_deg></spherical_coordinates><model name='m'><link name='l'/></model>"
    assert read_upload(world(place.format(0, 0, 0))).datum is None
    assert read_upload(world(place.format(10, 20, 270))).datum == Datum(10, 20, heading=90.0)
    datum = Datum(10.0, 20.5)
    bundle = read_upload(world(place.format(10, 20, 0)), context=EnvironmentContext(datum))
    assert bundle.datum is None
    assert any("differs from the environment's datum" in w.problem for w in bundle.warnings)
    files = world(place.format(10, 20, 0))
    parts = read_upload(files).parts
    assert "<longitude_deg>20.5<" in write(parts, datum)["world.sdf"].decode(), "the environment's datum is written"
    text = write(parts, Datum(10.0, 20.0))["world.sdf"].decode()
    assert "<longitude_deg>20<" in text, "equivalent coordinates stay unchanged"
    default = read_upload(world(place.format(0, 0, 0))).parts
    out, context = report(default, datum)
    assert "<longitude_deg>0<" in out["world.sdf"].decode()
    assert any("georeference=true" in w.problem for w in context.warnings)
    assert "<longitude_deg>20.5<" in write(default, datum, georeference=True)["world.sdf"].decode()
    moon = "<spherical_coordinates><surface_model>MOON_SCS</surface_model><latitude_deg>1</latitude_deg></spherical_coordinates>"
    bundle = read_upload(world(moon + "<model name='m'/>"))
    assert bundle.datum is None
    assert any("MOON_SCS" in w.problem for w in bundle.warnings)


def test_moved_and_renamed_objects_are_written() -> None:
    bundle = read_upload(folder(SAMPLES / "yard"))
    part = objects(bundle)
    moved = {"sign": [1.0, 1.0, 0.0, 0.0, 0.0, 0.0], "spare crate": [0.0] * 6, "crate": [9.0, 9.0, 0.0, 0.0, 0.0, 0.0]}
    names = {"crate": "box 1", "post": "pole"}
    properties = [
        {**p, "pose": moved.get(i, p["pose"]), "name": names.get(i, p["name"])}
        for i, p in zip(part.ids, part.properties, strict=True)
    ]
    parts = {**bundle.parts, OBJECTS: Features(part.ids, part.geometry, tuple(properties), part.local, part.document)}
    files = write(parts)
    back = {f.properties["name"]: f.properties["pose"] for f in objects(read_upload(files))}
    assert back["sign"] == moved["sign"]
    assert back["spare crate"] == moved["spare crate"], "an include's zero pose is not its model's own"
    assert back["box 1"] == moved["crate"]
    assert back["pole"] == [1.0, 2.0, 0.5, 0.0, 0.0, 0.0]


# --- worlds of other things --------------------------------------------------------------------------------------
def test_objects_of_other_formats_become_static_models() -> None:
    square = shapely.box(0, 0, 10, 6)
    holed = shapely.Polygon([(20, 0), (30, 0), (30, 10), (25, 12), (20, 10)], [[(24, 4), (26, 4), (26, 6), (24, 6)]])
    rows: list[tuple[str, Any, dict[str, Any]]] = [
        ("house", square, {"kind": "building", "name": "a::b", "height": 4.0, "base": 1.0}),
        ("hall", holed, {"kind": "building"}),
        ("w", shapely.LineString([(0, 20), (5, 20), (5, 25)]), {"kind": "wall", "width": 0.2}),
        ("floor", shapely.box(0, 0, 1, 1), {"kind": "floor"}),
        ("door", shapely.LineString([(0, 30), (1, 30)]), {"kind": "door"}),
        ("field", shapely.Polygon([(0, 0), (1, 0), (0, 1)]), {"kind": "region"}),
        ("poi", shapely.Point(1, 1), {"kind": "poi"}),
        ("tree", shapely.Point(3, 4), {"kind": "tree"}),
        ("bin", shapely.Point(7, 7), {"kind": "bin", "size": [0.5, 0.6, 1.0]}),
        ("shelf", shapely.Point(8, 9), {"kind": "shelf", "size": [1, 1, 2], "pose": [8, 9, 3.5, 0, 0, 0]}),
        ("nothing", None, {"kind": "building"}),
    ]
    parts = {PartKey("objects", name="osm", level="L2"): features(rows, "local")}
    files, context = report(parts, None, (Level(), Level("L2", 3.0)), wall_height=2.0, building_height=5.0)
    assert check(files) == []
    by = {f.properties["name"]: f for f in objects(read_upload(files))}
    assert set(by) == {"a_b", "hall", "w", "floor", "door", "field", "tree", "bin", "shelf", "ground_plane", "sun"}
    box = solids.Solids({}, False, True)

    def extent(name: str) -> Any:
        return pytest.approx(box.bounds(by[name].properties), abs=1e-6)

    assert extent("a_b") == (0, 0, 4, 10, 6, 7), "from 1 to 4 m above a floor at 3 m"
    assert extent("hall") == (20, 0, 3, 30, 12, 8)
    assert by["hall"].geometry.area == pytest.approx(holed.area)
    assert extent("w") == (-0.1, 19.9, 3, 5.1, 25.1, 5), "its ends reach half its width further, as in grids"
    assert by["w"].geometry.area == pytest.approx(10.2 * 0.2, abs=0.03)
    assert extent("floor") == (0, 0, 2.9, 1, 1, 3), "one stands on it"
    assert by["door"].properties["shapes"][0]["visual"] is True
    assert by["field"].properties["shapes"][0]["visual"] is True
    assert extent("bin") == (6.75, 6.7, 3, 7.25, 7.3, 4)
    assert extent("shelf") == (7.5, 8.5, 3.5, 8.5, 9.5, 5.5), "its pose is in the local frame"
    colours = {t.subject: (t.value, t.option) for t in context.template if t.subject.startswith("colour")}
    assert colours["colour of building"] == ([0.75, 0.68, 0.6], "building_colour")
    assert set(colours) == {f"colour of {kind}" for kind in ("building", "wall", "floor", "door", "region", "ground")}
    filled = {(t.subject, t.value) for t in context.template if not isinstance(t.value, list)}
    assert {("height of building", 5.0), ("height of wall", 2.0), ("height of tree", 3.0)} <= filled
    assert ("sun", "directional light") in filled
    assert {d.subject for d in context.dropped} == {"objects of kind poi", "objects of kind building"}
    assert write(parts, None, (Level(), Level("L2", 3.0)), wall_height=2.0, building_height=5.0) == files


def test_options_set_missing_measures_and_colours() -> None:
    rows = [
        ("fence", shapely.LineString([(0, 0), (4, 0)]), {"kind": "fence"}),
        ("tree", shapely.Point(9, 0), {"kind": "tree"}),
        ("floor", shapely.box(0, 5, 2, 7), {"kind": "floor"}),
        ("door", shapely.LineString([(0, 5), (1, 5)]), {"kind": "door"}),
        ("rock", shapely.Point(5, 9), {"kind": "obstacle"}),
        ("pole", shapely.Point(5, 12), {"kind": "pole"}),
        ("house", shapely.box(20, 5, 22, 7), {"kind": "building", "height": 4.0}),
    ]
    parts = {PartKey("objects", name="osm"): features(rows, "local")}
    measures = {
        "barrier_height": 1.5, "tree_height": 5.0, "floor_thickness": 0.3, "door_height": 2.4, "obstacle_height": 0.4,
        "pole_height": 7.0, "wall_thickness": 0.5, "pole_radius": 0.2,
    }  # fmt: skip
    files, context = report(
        parts, **measures, building_colour=(0.0, 0.5, 1.0), sun=False, ground_colour=(0.1, 0.2, 0.1)
    )
    assert check(files) == []
    by = {f.properties["name"]: f for f in objects(read_upload(files))}
    box = solids.Solids({}, False, True)

    def extent(name: str) -> Any:
        return pytest.approx(box.bounds(by[name].properties), abs=0.01)

    assert extent("fence") == (0, -0.25, 0, 4, 0.25, 1.5)
    assert extent("tree") == (8.8, -0.2, 0, 9.2, 0.2, 5)
    assert extent("floor") == (0, 5, -0.3, 2, 7, 0)
    assert box.bounds(by["rock"].properties)[5] == pytest.approx(0.4)
    assert box.bounds(by["pole"].properties)[5] == pytest.approx(7.0)
    house = next(m for m in tree(files).iter("model") if m.get("name") == "house")
    assert house.findtext(".//diffuse") == "0 0.5 1 1"
    ground = next(m for m in tree(files).iter("model") if m.get("name") == "ground_plane")
    assert ground.findtext(".//diffuse") == "0.1 0.2 0.1 1"
    assert tree(files).find(".//light") is None
    options = {t.option: t.value for t in context.template if t.option}
    assert {name: options[name] for name in measures} == measures
    assert "sun" not in options
    bare = tree(write(parts, ground=False, sun=False))
    assert "ground_plane" not in {m.get("name") for m in bare.iter("model")}


def test_shapes_can_be_collision_or_visual_only_with_colours() -> None:
    shapes: list[dict[str, Any]] = [
        {"type": "cylinder", "radius": 0.1, "length": 2.0, "unseen": True},
        {"type": "sphere", "radius": 1.0, "visual": True, "colour": [0.2, 0.5, 0.1]},
        {"type": "box", "size": [1.0, 1.0, 1.0], "colour": [2, "</diffuse>", None]},
    ]
    rows = [("tree", shapely.Point(0, 0), {"kind": "tree", "shapes": shapes})]
    files = write({PartKey("objects", name="generated"): features(rows, "local")})
    assert check(files) == []
    model = next(e for e in tree(files).iter("model") if e.get("name") == "tree")
    assert [e.get("name") for e in model.iter("collision")] == ["collision_0", "collision_2"]
    assert [e.get("name") for e in model.iter("visual")] == ["visual_1", "visual_2"]
    assert [e.text for e in model.iter("diffuse")] == ["0.2 0.5 0.1 1.0"], "what is no colour is none"


def test_geographic_objects_are_written_in_local_frame() -> None:
    datum = Datum(53.0, -0.5, heading=20.0)
    frame = Layers({}, datum).frame
    assert frame is not None
    corner = frame.to_wgs84(np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 5.0], [0.0, 5.0]]))
    parts = {PartKey("objects", name="osm"): features([("h", shapely.Polygon(corner), {"kind": "building"})], "wgs84")}
    files = write(parts, datum)
    assert check(files) == []
    by = {f.id: f for f in objects(read_upload(files))}
    assert by["h"].geometry.bounds == pytest.approx((0, 0, 10, 5), abs=1e-6)
    assert read_upload(files).datum == datum
    with pytest.raises(MissingDatum):
        write(parts)


def test_stored_world_is_written_alone_unless_content_is_all() -> None:
    parts: dict[PartKey, Any] = dict(read_upload(world("<model name='m'><link name='l'/></model>")).parts)
    parts[PartKey("objects", name="osm")] = features([("h", shapely.box(0, 0, 1, 1), {"kind": "building"})], "local")
    parts[PartKey("occupancy")] = OccupancyGrid(np.full((2, 2), 100, np.uint8), 0.5)
    files, context = report(parts)
    assert [m.get("name") for m in tree(files).iter("model")] == ["m"]
    assert {d.subject: d.count for d in context.dropped} == {
        "objects of other formats": 1,
        "walls of the grid map": 1,
    }
    everything = tree(write(parts, content="all"))
    assert [m.get("name") for m in everything.iter("model")] == ["h", "m", "walls_map"]
    assert everything.find("light") is None, "the stored world's author decides on its light and ground"


def test_grid_cells_become_walls() -> None:
    cells = np.zeros((4, 6), np.uint8)
    cells[0, :] = 100
    cells[1:3, 2:4] = 100
    cells[3, 5] = 70
    cells[3, 0] = 255
    grid = OccupancyGrid(cells, 0.5, (10.0, 20.0, math.pi / 2))
    files, context = report({PartKey("occupancy", name="map"): grid}, wall_height=3.0)
    assert check(files) == []
    assert {"world.sdf", "models/walls_map/meshes/walls_map.stl"} == set(files)
    mesh = read_mesh(files["models/walls_map/meshes/walls_map.stl"], "a.stl")
    corners = mesh.vertices[mesh.faces]
    volume = float(np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6)
    assert volume == pytest.approx(11 * 0.25 * 3.0), "closed, its faces outward: 11 cells, 3 m high"
    walls = {f.id: f for f in objects(read_upload(files))}["walls_map"]
    assert walls.geometry.area == pytest.approx(11 * 0.25, abs=1e-6)
    # The grid's x axis looks north: its 6 × 4 cells of half a metre lie west of (10, 20).
    assert walls.geometry.bounds == pytest.approx((8.0, 20.0, 10.0, 23.0), abs=1e-6)
    assert [t.value for t in context.template if t.subject == "height of walls"] == [3.0]
    less = write({PartKey("occupancy", name="map"): grid}, threshold=80)
    assert len(less["models/walls_map/meshes/walls_map.stl"]) < len(files["models/walls_map/meshes/walls_map.stl"])
    free = OccupancyGrid(np.zeros((3, 3), np.uint8), 0.5)
    empty, context = report({PartKey("occupancy", name="map"): free})
    assert set(empty) == {"world.sdf"}
    assert any("no walls" in w.problem for w in context.warnings)


def test_rectangles_cover_each_cell_once() -> None:
    dice = np.random.default_rng(5)
    for shape, share in (((17, 23), 0.5), ((40, 8), 0.9), ((1, 9), 0.4), ((9, 1), 0.6)):
        cells = dice.random(shape) < share
        count = np.zeros(shape, int)
        for x0, x1, y0, y1 in bodies.rectangles(cells):
            count[y0:y1, x0:x1] += 1
        assert (count == cells).all()
        surface = bodies.extrude(cells, 1.0, 1.0).astype(float)
        volume = np.einsum("ij,ij->i", surface[:, 0], np.cross(surface[:, 1], surface[:, 2])).sum() / 6
        assert volume == pytest.approx(cells.sum())


def test_large_grid_gives_a_small_mesh() -> None:
    """4000 × 4000 cells with rooms and 20 000 single cells of noise: seconds, and a mesh of some megabytes."""
    cells = np.zeros((4000, 4000), np.uint8)
    cells[::200, :] = cells[:, ::250] = 100
    dice = np.random.default_rng(1)
    cells[dice.integers(0, 4000, 20_000), dice.integers(0, 4000, 20_000)] = 100
    surface = bodies.extrude(cells == 100, 0.05, 2.5)
    assert len(surface) < 500_000
    a, b, c = surface.astype(float).transpose(1, 0, 2)
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6
    assert volume == pytest.approx(int((cells == 100).sum()) * 0.05**2 * 2.5, rel=1e-4)


def test_choose_selects_grid_for_walls() -> None:
    keys = [PartKey("occupancy", name=n) for n in ("keepout", "lab", "map")]
    assert [k.name for k in writing.choose(keys, WriteOptions())] == ["map"]
    assert [k.name for k in writing.choose(keys, WriteOptions(grid="keepout"))] == ["keepout"]
    assert [k.name for k in writing.choose(keys[:2], WriteOptions())] == ["lab"], "a mask is no wall"
    with pytest.raises(MissingLayer, match="supply"):
        writing.choose(keys[:1], WriteOptions())
    rivals = [PartKey("occupancy", name=n) for n in ("a", "b")]
    with pytest.raises(Ambiguous):
        writing.choose(rivals, WriteOptions())
    assert writing.choose([OBJECTS, *rivals], WriteOptions()) == [OBJECTS]
    with pytest.raises(NotFound):
        writing.choose(keys, WriteOptions(grid="none"))


@pytest.mark.parametrize("version", ["1.4", "1.5", "1.6", "1.7", "1.8", "1.9"])
def test_written_versions_load_in_libsdformat(version: str) -> None:
    rows = [("h", shapely.box(0, 0, 1, 1), {"kind": "building"}), ("p", shapely.Point(1, 2), {"kind": "tree"})]
    files = write({PartKey("objects", name="osm"): features(rows, "local")}, Datum(1.0, 2.0, 3.0, 4.0), version=version)
    assert check(files) == []
    assert etree.fromstring(files["world.sdf"]).get("version") == version
    assert read_upload(files).datum == Datum(1.0, 2.0, 3.0, 4.0)


# --- real worlds -------------------------------------------------------------------------------------------------
def real_worlds() -> list[str]:
    """List the real worlds below ../shared/data."""
    paths = (path for path in sorted(DATA.rglob("*")) if path.name.endswith((".world", ".sdf", ".world.xml")))
    return [path.relative_to(DATA).as_posix() for path in paths if path.is_file() and b"<world" in path.read_bytes()]


def uploaded_world(path: Path) -> dict[str, bytes]:
    """Return a world with everything beside it but other worlds."""
    root = path.parent.parent if path.parent.name == "worlds" else path.parent
    return {
        p.relative_to(root).as_posix(): p.read_bytes()
        for p in sorted(root.rglob("*"))
        if p == path or (p.is_file() and not p.name.endswith((".world", ".world.xml")) and p.parent != path.parent)
    }


def test_real_worlds_are_found(shared: Path) -> None:
    assert len(real_worlds()) > 10


@pytest.mark.parametrize("key", real_worlds())
def test_real_worlds_match_facts_and_round_trip(key: str, facts_json: dict[str, Any], same: Same) -> None:
    """libsdformat reports no errors for written files beyond those for the originals."""
    files, facts = uploaded_world(DATA / key), facts_json[key]["facts"]
    bundle = read_upload(files, "gazebo")
    kinds = Counter(p["kind"] for p in objects(bundle).properties)
    assert kinds["model"] == facts["top_level_models"]
    assert kinds["include"] == facts["includes"] - facts["includes_inside_model"]
    assert kinds["light"] == facts["light_count"]
    names = facts["top_level_model_names"]
    models = [p["name"] for p in objects(bundle).properties if p["kind"] == "model"]
    assert models[: len(names)] == names
    moved = [p for p in objects(bundle).properties if "state" in p["gazebo"] and p["kind"] == "model"]
    assert len(moved) == facts.get("state_pose_differs", 0)
    for name, text in facts["poses_top_level"].items():
        if text:
            properties = next(p for p in objects(bundle).properties if p["name"] == name and p["kind"] == "model")
            assert properties["pose"] == pytest.approx([float(v) for v in text.split()]), name
    out = offline(files, "gazebo", hints=UploadHints("gazebo")).files
    assert same("gazebo", files, out) == []
    assert etree.fromstring(out["world.sdf"]).get("version") == facts["sdf_version"]
    again = offline(out, "gazebo").files
    assert {n: out[n] for n in again} == again, "what only a comment names goes along, until the comment is gone"
    if complaints := check(out):
        name = f"worlds/{Path(key).name}" if Path(key).parent.name == "worlds" else Path(key).name
        models_in_place = {re.sub(r"^(custom_)?models/", "models/", n): d for n, d in files.items()}
        assert set(complaints) <= set(check({**models_in_place, "world.sdf": files[name]}))


def test_real_models_match_expected_shapes(shared: Path, facts_json: dict[str, Any]) -> None:
    """Collision geometry of single models by kind equals an independent count; meshes only if available."""
    seen = 0
    for key, entry in facts_json.items():
        facts = entry.get("facts") or {}
        if entry["kind"] != "sdf" or facts["worlds"] or facts["includes"] or not facts["collisions"]:
            continue
        path = shared / "data" / key
        root = path.parent.parent
        files = {p.relative_to(root).as_posix(): p.read_bytes() for p in path.parent.rglob("*") if p.is_file()}
        name = path.relative_to(root).as_posix()
        files = {n: d for n, d in files.items() if n == name or not n.endswith(".sdf")}
        files.pop(f"{path.parent.name}/model.config", None)
        (model,) = objects(read_upload(files, "gazebo"))
        shapes = Counter(s["type"] for s in model.properties.get("shapes", ()) if not s.get("visual"))
        expected_shapes = Counter(facts["collision_geometry"])
        for kind in expected_shapes:
            if kind != "mesh":
                assert shapes[kind] == expected_shapes[kind], (key, kind)
        assert shapes["mesh"] <= expected_shapes["mesh"]
        seen += 1
    assert seen > 20


def test_collada_units_are_applied_but_not_up_axis(shared: Path, facts_json: dict[str, Any]) -> None:
    """The walls of turtlebot3_world are Y_UP with a unit of 2.54 cm: only with the unit and without the turn are they
    where the map has them (all of its occupied cells within 10 cm of the model's solids)."""
    root = shared / "data/gazebo_sdf/turtlebot3_world"
    wall = facts_json["gazebo_sdf/turtlebot3_world/models/turtlebot3_world/meshes/wall.dae"]["facts"]
    assert (wall["unit_meter"], wall["up_axis"]) == ("0.0254", "Y_UP")
    bundle = read_upload({n: d for n, d in folder(root).items() if not n.startswith("maps/")})
    (place,) = [f for f in objects(bundle) if f.id == "turtlebot3_world"]
    assert place.properties["kind"] == "model"
    maps = read_upload({n: d for n, d in folder(root).items() if n.startswith("maps/")})
    (grid,) = [p for p in maps.parts.values() if isinstance(p, OccupancyGrid)]
    rows, columns = np.nonzero(grid.cells == 100)
    x = grid.origin[0] + (columns + 0.5) * grid.resolution
    y = grid.origin[1] + (rows + 0.5) * grid.resolution
    near = shapely.contains_xy(shapely.buffer(place.geometry, 0.1), x, y)
    assert near.mean() > 0.98


def test_known_obstacles_become_points(shared: Path) -> None:
    path = shared / "data/environment_template/riseholme_park_farm_strawberry_polytunnels/config/world"
    bundle = read_upload({"known_obstacles.yaml": (path / "known_obstacles.yaml").read_bytes()})
    part = objects(bundle)
    assert part.ids[0] == "tunnel_0/row_0/0"
    assert part.properties[0]["pose"] == pytest.approx([20.47, -11.17, 0, 0, 0, 4.86 - 2 * math.pi])
    # They are the feet of the world's poles.
    poles = read_upload({"gazebo.world": (path / "gazebo.world").read_bytes()})
    feet = {tuple(np.round(p["pose"][:2], 2)) for p in objects(poles).properties if str(p["name"]).startswith("pole_")}
    rows = {tuple(np.round(p["pose"][:2], 2)) for p in part.properties}
    assert len(rows & feet) > 0.9 * len(rows)
    files = offline({"known_obstacles.yaml": (path / "known_obstacles.yaml").read_bytes()}, "gazebo").files
    assert check(files) == []
    assert len(tree(files).findall("model")) == len(part) + 1


def test_environment_common_lists_are_read(shared: Path) -> None:
    root = shared / "data/gazebo_sdf/environment_common_test_files"
    bundle = read_upload({n: (root / n).read_bytes() for n in ("objects.yaml", "models.yaml")})
    part = objects(bundle)
    assert part.ids == ("ground_plane", "item_a", "item_b", "item_c", "item_d", "item_e", "item_d#2")
    assert part.geometry[0].bounds == (-5.0, -10.0, 5.0, 10.0)
    assert part.properties[4]["pose"] == [-10.0, 20.0, 0.0, 0.0, 0.0, 0.0]
    assert part.properties[4]["gazebo"]["type"] == "model_3"
    assert bundle.files["models.yaml"].used
    shelf = b'<sdf version="1.6"><model name="m"><pose>0 0 1 0 0 0</pose>' + LINK.encode() + b"</model></sdf>"
    more = read_upload({"objects.yaml": (root / "objects.yaml").read_bytes(), "custom_models/model_3/model.sdf": shelf})
    by = {f.id: f for f in objects(more)}
    assert by["item_d"].properties["shapes"] == [{"type": "box", "size": [2, 1, 1], "pose": [0, 0, 1, 0, 0, 0]}]
    assert by["item_d"].geometry.bounds == (-11.0, 19.5, -9.0, 20.5)


# --- detection and damage ----------------------------------------------------------------------------------------
def test_detect_accepts_worlds_only() -> None:
    world_ = b"<sdf version='1.6'><world name='w'/></sdf>"
    for good in (world_, b"\n \t" + world_, b"\xef\xbb\xbf" + world_, b"<?xml version='1.0'?><!-- a --> " + world_):
        assert gazebo.detect("any", good)
    for bad in (
        b"",
        b"<kml/>",
        b"<sdf version='1.6'/>",
        b"<sdfx><world/></sdfx>",
        b"<sdf><!-- <world> --></sdf>",
        b" " * 10**6,
    ):
        assert not gazebo.detect("a.sdf", bad)
    for text in (
        b"nodes: []\nedges: []\n",
        b"models: [a]\n",
        b"components: [a]\n",
        b"coordinates: [1]\norientation: 1\n",
    ):
        assert not gazebo.detect("a.yaml", text)


def test_empty_worlds_round_trip() -> None:
    files = world("<gravity>0 0 -1.6</gravity>", name="moon base")
    out = offline(files, "gazebo", hints=UploadHints("gazebo")).files
    assert tree(out).get("name") == "moon base"
    assert tree(out).findtext("gravity") == "0 0 -1.6"
    assert tree(out).find("model") is None


@pytest.mark.parametrize(
    ("inner", "reason"),
    [
        ("<model name='a\x7f'/>", "name"),
        ("<model name='" + "a" * 300 + "'/>", "name"),
        ("<model name='m'><link name='l'><collision name='c'><geometry><polyline><point>1</point></polyline></geometry></collision></link></model>", "2 numbers"),
        ("<spherical_coordinates><latitude_deg>91</latitude_deg></spherical_coordinates>", "latitude"),
        ("<spherical_coordinates><latitude_deg>1 2</latitude_deg></spherical_coordinates>", "1 numbers"),
        ("<model name='m'>" * 100 + "</model>" * 100, "nested"),
    ],
)  # fmt: skip
def test_invalid_world_raises_bad_upload_with_reason(inner: str, reason: str) -> None:
    with pytest.raises(BadUpload) as caught:
        read_upload(world(inner))
    assert reason in caught.value.detail
    assert caught.value.problems[0].file == "a.world"


@pytest.mark.parametrize(
    "text",
    [
        "components: 5\ntype: x\n",
        "components:\n- {type: {object: a, reference: sphere}, radius: x}\n",
        "components:\n- {type: {object: a, reference: box}, size: [1, 2]}\n",
        "components:\n- {type: sphere}\n",
        "components:\n- {type: {reference: box}, anchor: 5}\n",
        "models:\n- {name: a, type: b, position: {x: .inf}}\n",
        "models:\n  a: 5\n  type: {position: 1}\n",
        "a:\n- x\ncoordinates:\n- x: 1\norientation: left\n",
        "components:\n- {type: {object: custom, reference: objects.yaml}}\n",
    ],
)
def test_invalid_list_raises_unreadable_file(text: str) -> None:
    with pytest.raises(UnreadableFile) as caught:
        read_upload({"objects.yaml": text.encode()}, "gazebo")
    assert caught.value.problems[0].file == "objects.yaml"


def test_model_is_rebuilt_when_stored_text_is_invalid() -> None:
    part = objects(read_upload(world(f"<model name='m'>{LINK}</model>")))
    for text in ("<model", "<plugin/>", "<!DOCTYPE a><model/>", 5):
        source_properties = {**part.properties[0]["gazebo"], "sdf": text}
        bad = Features(
            part.ids, part.geometry, ({**part.properties[0], "gazebo": source_properties},), part.local, part.document
        )
        files = write({OBJECTS: bad})
        (model,) = tree(files).findall("model")
        assert model.findtext("link/collision/geometry/box/size") == "2.0 1.0 1.0"


def test_free_name_returns_valid_unique_names() -> None:
    taken: set[str] = set()
    names = [bodies.free_name(n, taken) for n in ("a", "a", "a::b", "__x__", "world", "\x01", "a_2")]
    assert names == ["a", "a_2", "a_b", "object_x", "object_world", "object", "a_2_2"]
    assert bodies.slug("näh (1)/x") == "n_h_1_x"


def test_model_config_selects_the_file() -> None:
    library = Library(folder(SAMPLES / "yard"))
    assert library.model_file("models/crate") == "models/crate/model.sdf"
    assert library.model_file("models/none") is None


def test_unknown_elements_outside_plugins_give_a_warning() -> None:
    box = "<geometry><box><size>1 1 1</size></box></geometry>"
    model = (
        f"<model name='a'><static>true</static><link name='l'><colision name='c'>{box}</colision>"
        "<plugin name='p' filename='f'><anything/></plugin></link></model>"
    )
    text = f"<sdf version='1.7'><world name='w'>\n{model}</world></sdf>"
    (warning,) = read_upload({"w.world": text.encode()}).warnings
    assert warning.problem == "unknown elements: <colision> (did you mean collision?); they are stored without effect"
    assert warning.line == 2
