"""Reading of uploads: format detection, folder conventions, precedence of files."""

from __future__ import annotations

import io
import math
import zipfile
from pathlib import Path
from typing import Any

import pytest
import shapely

from app.errors import BadUpload, Invalid, UnreadableFile
from app.limits import Limits
from app.model.features import Features, features
from app.model.frame import Datum
from app.model.layers import PartKey
from app.upload_reader import Bundle, EnvironmentContext, UploadHints, corner, read, template_folder, unpack

LIMITS = Limits()

DATUM = b"datum_latitude: 53.26\ndatum_longitude: -0.52\n"
FENCED = (
    DATUM + b"gnss_fence:\n  gnss_fence_coords: [[53.26, -0.52], [53.261, -0.52], [53.261, -0.519], [53.26, -0.519]]\n"
)
GRID = (
    b"image: map.pgm\nresolution: 0.1\norigin: [0.0, 0.0, 0.0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
)
PGM = b"P5\n2 2\n255\n\x00\xfe\xfe\xcd"


def placemark(name: str, shape: str, points: str) -> str:
    inner = f"<coordinates>{points}</coordinates>"
    if shape == "Polygon":
        inner = f"<outerBoundaryIs><LinearRing>{inner}</LinearRing></outerBoundaryIs>"
    return f"<Placemark><name>{name}</name><{shape}>{inner}</{shape}></Placemark>"


def kml(*placemarks: str) -> bytes:
    return f'<kml xmlns="http://www.opengis.net/kml/2.2"><Document>{"".join(placemarks)}</Document></kml>'.encode()


FENCE = placemark("the edge", "Polygon", "-0.52,53.26 -0.52,53.261 -0.519,53.261 -0.519,53.26 -0.52,53.26")
FIELD = placemark("field", "Polygon", "-0.53,53.26 -0.53,53.262 -0.529,53.262 -0.53,53.26")
PATH = placemark("path", "LineString", "-0.52,53.26 -0.5195,53.2605 -0.519,53.261")


def tmap2(name: str) -> bytes:
    node = (
        "- meta: {map: m, node: %s, pointset: p}\n  node:\n    name: %s\n    parent_frame: map\n    verts: []\n"
        "    pose: {position: {x: %s, y: 0.0, z: 0.0}, orientation: {w: 1.0, x: 0.0, y: 0.0, z: 0.0}}\n"
        "    edges: [{edge_id: %s, node: %s, action: move_base}]\n"
    )
    nodes = node % ("A", "A", "0.0", "A_B", "B") + node % ("B", "B", "1.0", "B_A", "A")
    head = f"meta: {{last_updated: 2022-01-01_00-00-00}}\nmetric_map: m\nname: {name}\npointset: p\n"
    return f"{head}nodes:\n{nodes}".encode()


def read_upload(files: dict[str, bytes], *, context: EnvironmentContext | None = None, **hints: Any) -> Bundle:
    return read(unpack(files, LIMITS), UploadHints(**hints), context or EnvironmentContext(), LIMITS)


def part(bundle: Bundle, layer: str, name: str) -> Features:
    content = bundle.parts[PartKey(layer, "ground", name)]  # type: ignore[arg-type]
    assert isinstance(content, Features)
    return content


def kinds(f: Features) -> list[Any]:
    return sorted(str(p["kind"]) for p in f.properties)


def warned(bundle: Bundle, file: str) -> str:
    return " ".join(w.problem for w in bundle.warnings if w.file == file)


def test_handwritten_file_takes_precedence_over_generated_one() -> None:
    other = DATUM.replace(b"53.26", b"10.0")
    bundle = read_upload({"datum.yaml": DATUM, "datum_autogen.yaml": other})
    assert bundle.datum is not None
    assert bundle.datum.latitude == 53.26
    assert not bundle.files["datum_autogen.yaml"].used
    assert bundle.files["datum.yaml"].used
    assert "datum.yaml takes precedence" in warned(bundle, "datum_autogen.yaml")


def test_real_network_takes_precedence_over_drawn_one_and_regions_stay() -> None:
    bundle = read_upload(
        {
            "config/location/datum.yaml": DATUM,
            "config/topological/network.tmap2.yaml": tmap2("hand"),
            "config/topological/.network.tmap2": tmap2("hidden"),
            "config/topological/drawn.kml": kml(PATH),
            "config/topological/drawn_regions.kml": kml(FIELD),
        }
    )
    network = part(bundle, "topology", "network")
    assert network.document["tmap2"]["name"] == "hand"
    assert not bundle.files["config/topological/.network.tmap2"].used
    assert not bundle.files["config/topological/drawn.kml"].used
    assert kinds(part(bundle, "objects", "kml")) == ["region"]


def test_single_drawing_in_topological_is_a_network_and_stays_a_drawing() -> None:
    bundle = read_upload({"config/topological/drawn.kml": kml(PATH)})
    network = part(bundle, "topology", "network")
    assert kinds(network) == ["edge"] * 4 + ["node"] * 3
    assert len(part(bundle, "objects", "kml")) == 1


def test_layer_hint_assigns_a_drawing() -> None:
    assert kinds(part(read_upload({"a.kml": kml(FIELD, PATH)}), "objects", "kml")) == ["path", "region"]
    bundle = read_upload({"a.kml": kml(FIELD, PATH)}, layer="zones")
    assert kinds(part(bundle, "zones", "zones")) == ["keepout"]
    assert kinds(part(bundle, "objects", "kml")) == ["path"]
    bundle = read_upload({"a.kml": kml(FIELD)}, layer="location")
    assert kinds(part(bundle, "location", "site")) == ["fence"]


def test_fence_is_found_among_the_fields() -> None:
    bundle = read_upload({"config/location/datum.yaml": FENCED, "config/location/fields.kml": kml(FIELD, FENCE)})
    site = part(bundle, "location", "site")
    assert len(site) == 1
    assert site.properties[0]["name"] == "the edge"
    assert kinds(part(bundle, "objects", "kml")) == ["region"]


def test_single_polygon_replaces_another_fence() -> None:
    first = part(read_upload({"a.kml": kml(FENCE)}, layer="location"), "location", "site")
    context = EnvironmentContext(fence=first.geometry[0])
    moved = FIELD.replace("field", "new boundary")
    replaced = read({"b.kml": kml(moved)}, UploadHints(layer="location"), context, Limits())
    assert part(replaced, "location", "site").properties[0]["name"] == "new boundary"
    both = read({"b.kml": kml(moved, FENCE)}, UploadHints(layer="location"), context, Limits())
    assert part(both, "location", "site").properties[0]["name"] == "the edge", "the one that is there already"


def test_polygons_without_a_fence_are_regions() -> None:
    bundle = read_upload({"a.kml": kml(FIELD, FIELD.replace("field", "other"))}, layer="location")
    assert kinds(part(bundle, "objects", "kml")) == ["region", "region"]
    assert "no GNSS fence" in warned(bundle, "a.kml")


def test_grid_name_is_folder_in_a_template_and_file_elsewhere() -> None:
    files = {f"config/metric/{f}/map.{e}": d for f in ("map", "nogo") for e, d in (("yaml", GRID), ("pgm", PGM))}
    assert {k.name for k in read_upload(files).parts} == {"map", "nogo"}
    assert {k.name for k in read_upload({"hall.yaml": GRID, "map.pgm": PGM}).parts} == {"hall"}
    assert {k.name for k in read_upload({"hall.yaml": GRID, "map.pgm": PGM}, grid="keepout").parts} == {"keepout"}


def test_grid_is_not_named_like_the_parameters_of_a_mask() -> None:
    """Its YAML file would be listed in manifests, and a request for it would select the mask."""
    for name, grid in (("keepout_filter_info", None), ("a", "b_filter_info")):
        with pytest.raises(BadUpload, match="is named like the parameters of a mask"):
            read_upload({f"{name}.yaml": GRID, "map.pgm": PGM}, grid=grid)


def test_zip_of_a_folder_equals_its_files() -> None:
    files = {"config/location/datum.yaml": FENCED, "config/topological/n.kml": kml(PATH)}
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as z:
        for name, data in files.items():
            z.writestr(name, data)
    packed = read_upload({"farm.zip": buffer.getvalue()})
    assert packed.parts.keys() == read_upload(files).parts.keys()
    assert packed.datum == read_upload(files).datum


def test_drawings_with_equal_ids_are_both_stored() -> None:
    bundle = read_upload({"a.kml": kml(PATH), "b.kml": kml(PATH, FIELD)})
    assert len(part(bundle, "objects", "kml")) == 3


def test_missing_datum_becomes_south_west_corner_with_a_warning() -> None:
    bundle = read_upload({"a.kml": kml(PATH)})
    assert bundle.datum is not None
    assert (bundle.datum.latitude, bundle.datum.longitude) == (53.26, -0.52)
    assert any("south-west corner" in w.problem for w in bundle.warnings)


@pytest.mark.parametrize("latitude", [88.0, -88.0])
def test_data_beyond_datum_latitude_limit_gives_a_warning(latitude: float) -> None:
    point = b'{"type": "Feature", "properties": {}, "geometry": {"type": "Point", "coordinates": [10, %g]}}' % latitude
    bundle = read({"a.geojson": point}, UploadHints(), EnvironmentContext(), Limits())
    assert bundle.datum == Datum(math.copysign(85.0, latitude), 10.0)
    assert any("Use local metres near the poles" in w.problem for w in bundle.warnings)
    with pytest.raises(BadUpload, match="must be between -85 and 85"):
        read(
            {"datum.yaml": b"datum_latitude: %g\ndatum_longitude: 10\n" % latitude},
            UploadHints(),
            EnvironmentContext(),
            Limits(),
        )


def test_corner_across_the_antimeridian_is_the_western_end() -> None:
    line = shapely.LineString([(179.9, -17.0), (180.0, -16.9)])
    other = shapely.LineString([(-180.0, -16.9), (-179.8, -16.8)])
    datum = corner({PartKey("objects"): features([("a", line, {}), ("b", other, {})], "wgs84")})
    assert datum is not None
    assert (datum.latitude, datum.longitude) == (-17.0, 179.9)


def test_variables_are_read_without_running_them() -> None:
    bundle = read_upload(
        {"config/properties.sh": b"export FARM_NAME='x'\nexport BAD=$(rm -rf /)\n", "datum.yaml": DATUM}
    )
    empty = part(bundle, "objects", "environment")
    assert empty.document["environment"]["variables"] == {"FARM_NAME": "x"}
    assert warned(bundle, "config/properties.sh")


def test_unknown_files_become_sources_with_a_warning() -> None:
    bundle = read_upload({"datum.yaml": DATUM, "model.stl": b"solid", "LICENSE": b"x", "a/.placeholder": b""})
    assert [w.file for w in bundle.warnings if "no format can read" in w.problem] == ["model.stl"]
    assert not bundle.files["model.stl"].used


@pytest.mark.parametrize(
    ("files", "hints", "error", "words"),
    [
        ({}, {}, Invalid, "no file"),
        ({"a.bin": b"\x00\x01"}, {}, UnreadableFile, "no file has a recognised map format"),
        ({"a.kml": b""}, {}, UnreadableFile, "empty"),
        ({"a.kml": kml(PATH)}, {"layer": "occupancy"}, Invalid, "layer must be one of"),
        ({"a.kml": kml(PATH)}, {"options": {"colour": "red"}}, Invalid, "colour"),
        ({"a.kml": b"<kml><Document>"}, {}, BadUpload, "a.kml"),
    ],
)
def test_invalid_upload_is_rejected_with_a_reason(
    files: dict[str, bytes], hints: dict[str, Any], error: type[Exception], words: str
) -> None:
    with pytest.raises(error, match=words):
        read_upload(files, **hints)


def test_upload_error_names_every_bad_file() -> None:
    with pytest.raises(BadUpload) as caught:
        read_upload({"a.kml": b"<kml><Document>", "datum.yaml": DATUM.replace(b"53.26", b"953.26")})
    assert {p.file for p in caught.value.problems} == {"a.kml", "datum.yaml"}


@pytest.mark.parametrize(
    ("name", "below"),
    [
        ("config/metric/map/map.yaml", ("metric", "map", "map.yaml")),
        ("farm/config/location/datum.yaml", ("location", "datum.yaml")),
        ("topological/network.tmap2.yaml", ("topological", "network.tmap2.yaml")),
        ("map.yaml", None),
        ("other/location/datum.yaml", None),
    ],
)
def test_template_folder_is_path_below_config(name: str, below: tuple[str, ...] | None) -> None:
    assert template_folder(name) == below


@pytest.mark.parametrize(
    ("environment", "layers"),
    [
        ("indoor-agilex-limo-track", {"objects", "occupancy", "resources"}),
        ("riseholme_park_farm_general_east_pathway", {"location", "objects", "topology", "occupancy"}),
        ("riseholme_park_farm_strawberry_polytunnels", {"location", "objects", "topology", "occupancy"}),
        ("riseholme_park_farm_vineyard", {"location", "objects", "topology", "occupancy"}),
    ],
)
def test_real_template_folders_are_read(
    shared: Path, facts_json: dict[str, Any], environment: str, layers: set[str]
) -> None:
    root = shared / "data" / "environment_template" / environment
    files = {p.relative_to(root).as_posix(): p.read_bytes() for p in root.rglob("*") if p.is_file()}
    bundle = read_upload(files)
    assert bundle.layers(None).layers == layers
    for name in files:
        file_facts = facts_json[f"environment_template/{environment}/{name}"]
        if file_facts["kind"] == "tmap2" and bundle.files[name].used and "poi" not in name:
            network = part(bundle, "topology", "network")
            assert sum(p["kind"] == "node" for p in network.properties) == file_facts["facts"]["nodes"]
            assert sum(p["kind"] == "edge" for p in network.properties) == file_facts["facts"]["edges_directed"]
        if file_facts["kind"] == "occupancy_map_yaml" and "metric/map/" in name:
            grid = bundle.parts[PartKey("occupancy", "ground", "map")]
            assert grid.counts()["occupied"] == file_facts["facts"]["cells"]["occupied_100"]  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("name", "data", "line"),
    [
        ("map.yaml", b"image: a.pgm\nresolution: [0.05\norigin: 3\n", 3),
        ("graph.geojson", b'{"features": [\n1,,2]}', 2),
        ("data", b'{"a":\n\n]', 3),
        ("world.sdf", b"<sdf>\n<world>\n</sdf>", 3),
        ("drawing", b"<a>\n<b></a>", 2),
        ("entities.xml", b"<!DOCTYPE a [<!ENTITY b 'c'>]>\n<a/>", 1),
        ("fine.json", b'{"a": 1}', None),
        ("notes.txt", b"{ not JSON, and not called so either", 1),
    ],
)
def test_unknown_file_with_syntax_error_is_reported_with_its_line(name: str, data: bytes, line: int | None) -> None:
    with pytest.raises(UnreadableFile) as caught:
        read({name: data}, UploadHints(), EnvironmentContext(), LIMITS)
    (problem,) = caught.value.problems
    assert (problem.file, problem.line) == (name, line)
    assert (problem.problem == "no recognised map format") == (line is None)
    assert (f"line {line}" in caught.value.detail) == (line is not None)
