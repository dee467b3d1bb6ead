"""environment: all maps of a place in one archive, scripts with valid paths, round trips."""

from __future__ import annotations

import io
import json
import subprocess
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import orjson
import pytest
import shapely

from app import formats, upload_reader
from app.convert import recipe
from app.convert import worker as making
from app.convert.files import offline
from app.errors import BadUpload, CannotConvert, MissingLayer
from app.formats import WriteContext, get_format
from app.formats.environment import MAIN, detect
from app.limits import Limits
from app.model.features import Features, features, from_columns
from app.model.frame import Datum, Level
from app.model.grid import OccupancyGrid
from app.model.imagery import GeoImage
from app.model.layers import Layers, Part, PartKey, Resources
from app.model.templates import NO_TEMPLATES
from app.model.voxels import VoxelMap
from app.store import parts as store_parts
from app.store.tree import ChunkStage
from app.syntax import archives, shell
from app.upload_reader import Bundle, EnvironmentContext, UploadHints

FORMAT = get_format("environment")
SAMPLE = (Path(__file__).resolve().parents[1] / "samples/environment/yard.zip").read_bytes()
DATUM = Datum(53.2686, -0.5245, heading=20.0)
TEMPLATES = [
    "indoor-agilex-limo-track",
    "riseholme_park_farm_general_east_pathway",
    "riseholme_park_farm_strawberry_polytunnels",
    "riseholme_park_farm_vineyard",
]
Same = Callable[[str, dict[str, bytes], dict[str, bytes]], list[str]]


def unzipped(data: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        assert archive.testzip() is None
        return {n: archive.read(n) for n in archive.namelist()}


def maps_of(package: dict[str, bytes]) -> dict[str, bytes]:
    """Return a package without its exact copy of the stored layers."""
    return {n: d for n, d in package.items() if not n.startswith("config/fleet_map/")}


def folder(shared: Path, name: str) -> dict[str, bytes]:
    root = shared / "data" / "environment_template" / name
    return {p.relative_to(root).as_posix(): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}


def read_upload(files: dict[str, bytes], name: str | None = None) -> Bundle:
    return upload_reader.read(upload_reader.unpack(files, Limits()), UploadHints(name), EnvironmentContext(), Limits())


def written(layers: Layers, **options: Any) -> tuple[dict[str, bytes], dict[str, Any]]:
    written_map = making.from_layers(FORMAT, layers, options, derived=True)
    return unzipped(written_map.files[MAIN]), written_map.report.as_dict()


def grid(level: int = 0) -> OccupancyGrid:
    return OccupancyGrid(np.full((3, 4), level, np.uint8), 0.5, (0.0, 0.0, 0.0))


def variables_of(values: dict[str, str]) -> Features:
    return from_columns([], np.empty(0, object), [], "local", {"environment": {"variables": values}})


VARIABLES = PartKey("objects", "ground", "environment")


def sourced(files: dict[str, bytes], root: Path) -> dict[str, str]:
    """Return every variable exported by ``source config/environment.sh`` in a clean bash."""
    for name, data in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(data)
    script = 'cd / && source "$1" && env -0'
    bash = ["env", "-i", "PATH=/usr/bin:/bin", "bash", "--noprofile", "--norc", "-euo", "pipefail", "-c", script, "-"]
    done = subprocess.run(
        [*bash, str(root / "config/environment.sh")],
        capture_output=True,
        check=True,
        timeout=60,
    )
    assert done.stderr == b""
    variables = dict(line.split("=", 1) for line in done.stdout.decode().split("\0") if line)
    return {k: v for k, v in variables.items() if k not in ("PATH", "PWD", "OLDPWD", "SHLVL", "_")}


def check_paths(values: dict[str, str], root: Path) -> set[str]:
    """Check that variables with file paths refer to existing files; return their names."""
    named = set()
    for name, value in values.items():
        if name.endswith(("_FILE", "_MODELS")) and value:
            path = Path(value)
            assert path.is_absolute()
            assert path.is_dir() if name.endswith("_MODELS") else path.is_file(), f"{name}={value}"
            assert root in path.parents
            named.add(name)
    return named


# --- real environments ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", TEMPLATES)
def test_real_environments_round_trip_with_working_scripts(shared: Path, same: Same, tmp_path: Path, name: str) -> None:
    files = folder(shared, name)
    literals = json.loads((shared / "data/facts.json").read_text())["_environment_sh"][name]["literal_assignments"]
    # The script itself is not among the samples; its literals are in the facts.
    files["config/environment.sh"] = b"".join(
        b"export %s='%s'\n" % (k.encode(), v.encode()) for k, v in literals.items()
    )
    converted = offline(files, "environment", hints=UploadHints("environment"))
    assert same("environment", files, converted.files) == []
    inner = unzipped(converted.files[MAIN])
    root = tmp_path / "a folder 'with' $odd \"names\""[:22]
    values = sourced(inner, root)
    assert literals.items() <= values.items()
    named = check_paths(values, root)
    expected = {"PROPERTIES_FILE"}
    expected |= {"DATUM_FILE"} if any("location/datum" in n for n in files) else set()
    expected |= {"TMAP_FILE"} if any(n.endswith("network.tmap2.yaml") for n in inner) else set()
    expected |= {"COSTMAP_YAML_FILE"} if any("metric/map/map.yaml" in n for n in files) else set()
    expected |= {"NOGO_COSTMAP_YAML_FILE"} if any("metric/nogo/nogo_map" in n for n in files) else set()
    expected |= {"POI_FILE"} if any("poi.tmap2" in n for n in files) else set()
    expected |= {"GAZEBO_WORLD_FILE"} if any("/world/" in n and ".world" in n for n in files) else set()
    if any(n.endswith("model.sdf") for n in files):
        expected |= {"GAZEBO_CUSTOM_MODELS"}
        assert values["GAZEBO_MODEL_PATH"] == values["GAZEBO_CUSTOM_MODELS"]
    assert expected <= named
    assert {"DATUM_FILE", "TMAP_FILE", "COSTMAP_YAML_FILE", "GAZEBO_WORLD_FILE"} <= values.keys(), "empty, not unset"


def test_archive_gives_same_layers_as_directory(shared: Path) -> None:
    name = TEMPLATES[-1]
    files = folder(shared, name)
    archive = archives.pack({n: d for n, d in files.items() if d})
    loose = read_upload(files)
    for upload in ({"a.zip": archive}, {"a.zip": archive, "LICENSE": b"free"}):
        for format_name in (None, "environment"):
            packed = read_upload(upload, format_name)
            assert packed.parts.keys() == loose.parts.keys()
            assert packed.datum == loose.datum
            assert {w.problem for w in packed.warnings} == {w.problem for w in loose.warnings}
    other = read_upload({"site.bin": archive}, "environment")
    assert other.parts.keys() == loose.parts.keys()
    assert other.datum == loose.datum


def test_archive_paths_equal_template(shared: Path) -> None:
    files = folder(shared, "riseholme_park_farm_strawberry_polytunnels")
    inner = unzipped(offline(files, "environment").files[MAIN])
    assert {
        "config/environment.sh",
        "config/properties.sh",
        "config/location/datum.yaml",
        "config/location/fence.kml",
        "config/metric/map/map.yaml",
        "config/metric/bigmap/map.yaml",
        "config/metric/nogo/map.yaml",
        "config/topological/network.tmap2.yaml",
        "config/topological/network.kml",
    } <= inner.keys()
    for folder_ in ("map", "bigmap", "nogo"):
        assert b"image: map.pgm" in inner[f"config/metric/{folder_}/map.yaml"]


# --- our own sample ------------------------------------------------------------------------------------------------


def test_sample_is_detected_read_and_written() -> None:
    assert detect("yard.zip", SAMPLE)
    assert not detect("yard.kmz", SAMPLE)
    assert not detect("a.zip", archives.pack({"doc.kml": b"<kml/>"}))
    first = read_upload({"yard.zip": SAMPLE}, "environment")
    converted = offline({"yard.zip": SAMPLE}, "environment", hints=UploadHints("environment"))
    second = read_upload(maps_of(unzipped(converted.files[MAIN])), "environment")
    assert second.datum == first.datum
    assert second.parts.keys() == first.parts.keys()
    for key, part in first.parts.items():
        other = second.parts[key]
        if isinstance(part, OccupancyGrid):
            assert isinstance(other, OccupancyGrid)
            assert (part.cells == other.cells).all()
            assert part.origin == other.origin
        elif isinstance(part, Features):
            assert isinstance(other, Features)
            assert sorted(part.ids) == sorted(other.ids), key


def test_variables_round_trip_and_are_never_executed(tmp_path: Path) -> None:
    converted = offline({"yard.zip": SAMPLE}, "environment")
    inner = unzipped(converted.files[MAIN])
    values = sourced(inner, tmp_path)
    assert values["FARM_NAME"] == 'It\'s a "yard"; $(echo no)'
    assert values["FIELD_NAME"] == ""
    assert values["ENVIRONMENT_COMMON_LATEST_RELEASE"] == "v1.0.1"
    assert values["DATUM_FILE"] == f"{tmp_path}/config/location/datum.yaml", "not the path on somebody's machine"
    assert "variables that name files" in {d["what"] for d in converted.report.as_dict()["dropped"]}
    assert check_paths(values, tmp_path) == {
        "PROPERTIES_FILE",
        "DATUM_FILE",
        "TMAP_FILE",
        "COSTMAP_YAML_FILE",
        "NOGO_COSTMAP_YAML_FILE",
        "POI_FILE",
    }
    again = read_upload(maps_of(inner)).parts[VARIABLES]
    assert isinstance(again, Features)
    assert again.document["environment"]["variables"] == {
        "ENVIRONMENT_COMMON_LATEST_RELEASE": "v1.0.1",
        "FARM_NAME": 'It\'s a "yard"; $(echo no)',
        "FIELD_NAME": "",
        "FIELD_TYPE": "yard",
    }, "what names files is worked out each time, also where there is none"


def test_report_covers_every_map() -> None:
    report = offline({"yard.zip": SAMPLE}, "environment").report.as_dict()
    lines = {(line["layer"], line["name"]): line for line in report["layers"]}
    assert lines["topology", "network"]["sources"] == ["config/topological/network.tmap2.yaml"]
    assert {line["information"] for line in report["layers"]} == {"raw"}
    assert ("occupancy", "nogo") in lines
    assert any(d["what"].startswith("config/location/datum.yaml: ") for d in report["template"])
    files = {w["file"] for w in report["warnings"]}
    assert "config/metric/nogo/map.yaml" in files, (
        "the rotated grid of an inner map is reported by its path in the package"
    )


# --- what is put in ------------------------------------------------------------------------------------------------


def test_grid_directories_are_safe_in_scripts(tmp_path: Path) -> None:
    names = ["map", "a b", "a/b", "../../etc", "$(rm -rf)", ".hidden", "Größe", "x" * 200]
    parts: dict[PartKey, Part] = {PartKey("occupancy", "ground", n): grid(k) for k, n in enumerate(names)}
    parts[PartKey("occupancy", "upstairs", "map")] = grid(50)
    inner, report = written(Layers(parts, levels=(Level(), Level("upstairs", 3.0))))
    yamls = [n for n in inner if n.endswith("/map.yaml")]
    assert len(yamls) == len(names) + 1
    assert all(n.split("/")[:2] == ["config", "metric"] and len(n.split("/")) == 4 for n in yamls)
    assert {"config/metric/map/map.yaml", "config/metric/a_b/map.yaml", "config/metric/a_b_2/map.yaml"} <= set(yamls)
    assert "config/metric/map_upstairs/map.yaml" in yamls
    values = sourced(inner, tmp_path)
    assert values["COSTMAP_YAML_FILE"] == f"{tmp_path}/config/metric/map/map.yaml"
    assert {"levels of grids and images", "elevations of levels"} <= {d["what"] for d in report["dropped"]}


def test_costmap_variable_selects_grid() -> None:
    for names, chosen in (
        (["lab"], "lab"),
        (["lab", "map"], "map"),
        (["lab", "yard"], None),
        (["keepout", "map"], "map"),
    ):
        parts: dict[PartKey, Part] = {PartKey("occupancy", "ground", n): grid() for n in names}
        inner, report = written(Layers(parts))
        script = inner["config/environment.sh"].decode()
        line = f'export COSTMAP_YAML_FILE="$CONFIG_DIR/metric/{chosen}/map.yaml"' if chosen else "COSTMAP_YAML_FILE=''"
        assert line in script
        assert any("COSTMAP_YAML_FILE is empty" in w["problem"] for w in report["warnings"]) == (chosen is None)
        assert ("NOGO_COSTMAP_YAML_FILE" in script) == ("keepout" in names)


def test_objects_are_written_in_their_source_format() -> None:
    box = shapely.box(0.0, 0.0, 1.0, 1.0)
    parts: dict[PartKey, Part] = {
        PartKey("objects", "ground", "kml"): features([("a", shapely.Point(-0.5, 53.2), {"kind": "poi"})], "wgs84"),
        PartKey("objects", "ground", "made-by-hand"): features([("b", box, {"kind": "shed"})], "local"),
        PartKey("zones", "ground", "zones"): features([("z", box, {"kind": "keepout"})], "local"),
    }
    inner, _ = written(Layers(parts, DATUM))
    assert {"config/world/objects.kml", "config/world/objects.geojson"} <= inner.keys()
    again = read_upload({f"{k}": v for k, v in inner.items()})
    for key, part in parts.items():
        other = again.parts[key]
        assert isinstance(part, Features)
        assert isinstance(other, Features)
        assert part.ids == other.ids
        assert shapely.equals_exact(part.geometry, other.geometry, tolerance=1e-9).all()
        assert (part.local == other.local).all()


def test_maps_with_same_path_get_unique_paths() -> None:
    def wall(name: str) -> Features:
        return features([(name, shapely.LineString([(0, 0), (5, 0)]), {"kind": "wall", "name": name})], "local")

    poi = features([("p", shapely.Point(1, 1), {"kind": "poi", "name": "p"})], "local")
    poi_2 = features([("p", shapely.Point(2, 1), {"kind": "poi", "name": "p"})], "local")
    parts: dict[PartKey, Part] = {
        PartKey("objects", "ground", "geojson"): wall("a"),
        PartKey("objects", "ground", "made by hand"): wall("b"),
        PartKey("zones", "ground", "zones"): features([("z", shapely.box(0, 0, 1, 1), {"kind": "keepout"})], "local"),
        PartKey("objects", "Über 1", "tmap2"): poi,
        PartKey("objects", "Ober 1", "tmap2"): poi_2,
        PartKey("objects", "ober 1", "tmap2"): poi_2,
        PartKey("occupancy", "ground", "Hall"): grid(),
        PartKey("occupancy", "ground", "hall"): grid(100),
    }
    levels = tuple(Level(name) for name in ("ground", "Über 1", "Ober 1", "ober 1"))
    inner, _ = written(Layers(parts, DATUM, levels))
    names = {n.removeprefix("config/") for n in maps_of(inner)}
    assert {"world/objects.geojson", "metric/Hall/map.yaml", "metric/hall_2/map.yaml"} <= names
    assert len({n.casefold() for n in names if "/poi_" in n}) == 3
    maps = read_upload(maps_of(inner))
    drawn = {k: p for k, p in parts.items() if k.layer == "zones" or k.name in ("geojson", "made by hand")}
    assert {k: p.ids for k in drawn if isinstance(p := maps.parts[k], Features)} == {
        k: p.ids for k, p in drawn.items() if isinstance(p, Features)
    }
    assert hashes(read_upload({"a.zip": archives.pack(inner)}).parts) == hashes(parts)


def test_worlds_with_same_name_get_unique_files() -> None:
    def world(name: str, size: int) -> bytes:
        shape = f"<geometry><box><size>{size} 1 1</size></box></geometry>"
        link = f"<link name='l'><collision name='c'>{shape}</collision></link>"
        return f"<sdf version='1.6'><world name='{name}'><model name='m'>{link}</model></world></sdf>".encode()

    both = read_upload({"a/yard.world": world("a/yard", 1), "b/yard.world": world("b/yard", 2)})
    inner, _ = written(both.layers(DATUM))
    assert {"config/world/yard.world.xml", "config/world/yard_2.world.xml"} <= inner.keys()


def test_images_and_clouds_are_in_their_directories() -> None:
    samples = Path(__file__).resolve().parents[1] / "samples"
    paths = [samples / "satellite/orchard.tif", samples / "pcd/shelf.pcd", samples / "octomap/shed.bt"]
    files = {p.name: p.read_bytes() for p in paths}
    converted = offline(files, "environment", datum=DATUM)
    inner = unzipped(converted.files[MAIN])
    expected_files = ("location/orchard.tif", "metric/shelf/cloud.pcd", "metric/shelf/octomap.ot", "metric/shed/map.bt")
    assert {f"config/{n}" for n in expected_files} <= inner.keys()
    assert inner["config/metric/shelf/cloud.pcd"] == files["shelf.pcd"]
    assert offline(converted.files, "environment", datum=DATUM).files == converted.files
    assert set(read_upload(files).parts) <= read_upload(converted.files).parts.keys()


def test_failed_map_is_reported_and_others_are_written() -> None:
    """A network in metres without a datum gives no geographic drawing, but the network itself."""
    line = shapely.LineString([(0.0, 0.0), (5.0, 0.0)])
    rows: list[tuple[str, Any, dict[str, Any]]] = [
        ("a", shapely.Point(0.0, 0.0), {"kind": "node"}),
        ("b", shapely.Point(5.0, 0.0), {"kind": "node"}),
        ("a_b", line, {"kind": "edge", "source": "a", "target": "b"}),
    ]
    inner, report = written(Layers({PartKey("topology", "ground", "network"): features(rows, "local")}))
    assert maps_of(inner).keys() == {
        f"config/{n}" for n in ("environment.sh", "properties.sh", "topological/network.tmap2.yaml")
    }
    assert any(w["problem"].startswith("the package contains no kml: ") for w in report["warnings"])
    assert b"DATUM_FILE=''" in inner["config/environment.sh"]


def test_complete_derives_missing_maps_and_reports_them() -> None:
    lines = [("l", shapely.LineString([(0.0, 0.0), (5.0, 0.0), (5.0, 5.0)]), {"kind": "path"})]
    layers = Layers({PartKey("objects", "ground", "geojson"): features(lines, "local")}, DATUM)
    inner, report = written(layers)
    assert "config/topological/network.tmap2.yaml" not in inner
    assert {line["information"] for line in report["layers"]} == {"raw"}
    inner, report = written(layers, complete="true")
    assert "config/topological/network.tmap2.yaml" in inner
    topology_lines = [
        line for line in report["layers"] if line["information"] == "derived" and line["layer"] == "topology"
    ]
    assert [step["step"] for step in topology_lines[0]["steps"]] == ["objects_to_topology"]


def test_empty_environment_raises_missing_layer() -> None:
    with pytest.raises(MissingLayer, match="supply"):
        written(Layers())
    inner, _ = written(Layers({VARIABLES: variables_of({"FARM_NAME": "x"})}))
    assert maps_of(inner).keys() == {"config/environment.sh", "config/properties.sh"}
    with pytest.raises(CannotConvert):
        formats.write(FORMAT, Layers({VARIABLES: variables_of({"A": "x"})}), WriteContext())


def test_invalid_variables_are_dropped_and_reported(tmp_path: Path) -> None:
    odd = {
        "LD_PRELOAD": "/evil.so",
        "A B": "x",
        "GOOD": "`touch x`$(touch y)\\",
        "LINES": "a\nb",
        "CONFIG_DIR": "/elsewhere",
        "TMAP_FILE": "/nowhere",
        "X;touch z": "1",
    }
    inner, report = written(Layers({VARIABLES: variables_of(odd), PartKey("occupancy", "ground", "map"): grid()}))
    values = sourced(inner, tmp_path)
    assert values["GOOD"] == odd["GOOD"]
    assert values["TMAP_FILE"] == ""
    assert "LD_PRELOAD" not in values
    assert values["PROPERTIES_FILE"] == f"{tmp_path}/config/properties.sh"
    assert sum(d["count"] for d in report["dropped"] if d["what"].startswith("variables")) == 6
    assert not (set("xyz") & {p.name for p in tmp_path.iterdir()})


def test_new_writer_of_inner_map_changes_the_recipe(monkeypatch: pytest.MonkeyPatch) -> None:
    version: Any = SimpleNamespace(environment="e", datum=None, levels=(), templates=NO_TEMPLATES, closures=None)
    chain = recipe.DerivationChain((), ())

    def keys() -> list[str]:
        return [recipe._key(version, get_format(n), None, chain, {}, None) for n in ("environment", "datum")]

    before = keys()
    assert keys() == before
    monkeypatch.setitem(formats._registry.entries, "tmap2", replace(get_format("tmap2"), version=99))
    after = keys()
    assert after[0] != before[0]
    assert after[1] == before[1]


# --- bad input -----------------------------------------------------------------------------------------------------


def test_invalid_package_raises_bad_upload_with_file_and_reason() -> None:
    inside = {"config/location/datum.yaml": b"datum_latitude: north\n"}
    for upload in ({"a.zip": archives.pack(inside)}, {"a.bin": archives.pack(inside)}):
        with pytest.raises(BadUpload) as caught:
            read_upload(upload, "environment")
        assert caught.value.problems
        assert all(p.file and p.problem for p in caught.value.problems)
    with pytest.raises(BadUpload):
        read_upload({"a.bin": b"no archive"}, "environment")
    with pytest.raises(BadUpload):
        read_upload({"a.zip": archives.pack({"readme.txt": b"hello"})}, "environment")


def test_package_restores_exact_layers_until_a_map_is_edited() -> None:
    rows = [("7", shapely.Point(1 / 3, 2 / 3, 0.1), {"kind": "node", "note": [1, 1.0, None], "name": "Größe"})]
    picture = GeoImage(np.arange(24, dtype=np.uint16).reshape(2, 4, 3), (0.1, 0, 0, 0, -0.1, 0), properties={"a": 1})
    voxels = VoxelMap(0.1, np.array([16], np.uint8), np.array([7], np.uint64), np.array([0.5], np.float32))
    parts: dict[PartKey, Part] = {
        PartKey("topology", "2", "network"): features(rows, "local", {"site": {"x": [0.1]}}),
        PartKey("location"): features([], "wgs84", {"datum": {"more": True}}),
        PartKey("occupancy", "2", "nav"): grid(),
        PartKey("imagery", "2", "plan"): picture,
        PartKey("voxels", "ground", "scan"): voxels,
        PartKey("resources", "ground", "generated"): Resources({"a/b.bin": b"1", "c": b"1"}),
    }
    layers = Layers(parts, DATUM, (Level(), Level("2", 3.1)))
    files = written(layers)[0]
    package = archives.pack(files)
    again = read_upload({"a.zip": package})
    assert again.warnings == []
    assert (again.datum, again.levels) == (layers.datum, layers.levels)
    assert hashes(again.parts) == hashes(parts)
    assert hashes(read_upload({"a.bin": package}, "environment").parts) == hashes(parts)

    content = "config/fleet_map/content.json"
    yaml_name = next(n for n in files if n.endswith("nav_2/map.yaml"))
    key = PartKey("occupancy", "2", "nav")
    credited = making.from_layers(FORMAT, layers, {}, derived=True, credit={key: ("© Somebody",)})
    assert read_upload(credited.files).credit(key) == ("© Somebody",)
    edited = {**files, yaml_name: files[yaml_name].replace(b"resolution:", b"resolution:  ")}
    for changed, reason in (
        (edited, f"{yaml_name} was edited"),
        ({**files, "config/location/more.kml": b"<kml/>"}, "config/location/more.kml was added"),
        ({n: d for n, d in files.items() if n != yaml_name}, f"{yaml_name} was removed"),
        ({**files, content: b'{"version": 9}'}, "its version is not 1"),
    ):
        other = read_upload(changed)
        assert [p.problem for p in other.warnings if p.file == content] == [
            f"exact content ignored; the maps of the package are used: {reason}"
        ]
        assert not any(use.used for name, use in other.files.items() if "/fleet_map/" in name)
        assert hashes(other.parts) != hashes(parts)
    assert "content.json" not in " ".join(written(layers, complete=True)[0])

    top = orjson.loads(files[content])
    array = next(part for part in top["parts"] if part["layer"] == "occupancy")["cells"]
    damaged: list[Any] = [{**top, "parts": [{"layer": "x"}]}, {**top, "levels": 3}, {**top, "datum": {"latitude": 89}}]
    damaged += [{**top, "parts": [{**part, "ids": ["a", "a"]} for part in top["parts"]]}]
    damaged += [{**top, "parts": [{**part, "properties": 5} for part in top["parts"]]}]
    for wrong in ({"shape": [-1, 2]}, {"shape": [2**40, 2**20]}, {"type": "|O"}, {"file": "../x"}):
        parts_ = [p | {"cells": array | wrong} if p["layer"] == "occupancy" else p for p in top["parts"]]
        damaged.append({**top, "parts": parts_})
    for member, wrong in (
        ("transform", [0.1, 0, 1e19, 0, -0.1, 0]),
        ("crs", "nowhere"),
        ("crs", "+proj=longlat +nadgrids=/etc/hosts"),
        ("crs", "EPSG:9999999"),
    ):
        damaged.append({**top, "parts": [p | {member: wrong} if p["layer"] == "imagery" else p for p in top["parts"]]})
    damaged += [{**top, "parts": [{**part, "local": [[True, True]]} for part in top["parts"]]}]
    files_of = next(part for part in top["parts"] if part["layer"] == "resources")["files"]
    for name in ("../../evil.stl", "/etc/evil.stl", "a\\b", "a\nb", ""):
        named = {"files": {name: files_of["a/b.bin"]}}
        damaged.append({**top, "parts": [p | named if p["layer"] == "resources" else p for p in top["parts"]]})
    plain = orjson.dumps({**top, "levels": [["2", 4711]]})
    numbers = [plain.replace(b"4711", text) for text in (b"NaN", b"1e999", b'"nan"', b"18446744073709551616")]
    for wrong in (b"{", b"[]" * 10**5, *numbers, *map(orjson.dumps, damaged)):
        with pytest.raises(BadUpload) as caught:
            read_upload({**files, content: wrong})
        assert [p.file for p in caught.value.problems] == [content], wrong[:100]


@pytest.mark.parametrize("root", ["", "yard/"])
def test_added_files_without_format_keep_exact_layers(root: str) -> None:
    files = {f"{root}{name}": data for name, data in written(offline_layers())[0].items()}
    content = f"{root}config/fleet_map/content.json"
    mac = b"\x00\x05\x16\x07\x00\x02\x00\x00Mac OS X        "
    added = {
        f"{root}.DS_Store": b"\x00\x00\x00\x01Bud1",
        f"{root}config/fleet_map/.DS_Store": b"\x00\x00\x00\x01Bud1",
        f"__MACOSX/{root}config/location/._fence.kml": mac,
        f"__MACOSX/{root}config/metric/map/._map.yaml": mac,
        f"{root}README.md": b"# A yard\n",
        f"{root}LICENSE": b"MIT License\n\nCopyright (c) 2024 Somebody\n",
        f"{root}config/notes.txt": b"to do\n",
        f"{root}config/empty.kml": b"",
    }
    plain, with_more = read_upload(files), read_upload({**files, **added})
    assert hashes(with_more.parts) == hashes(plain.parts)
    assert [(p.file, p.problem) for p in with_more.warnings] == [
        (f"{root}config/notes.txt", "no format can read this file; it is stored as a source only")
    ]
    used = {name for name, use in with_more.files.items() if use.used}
    assert used == files.keys() | {f"{root}config/fleet_map/.DS_Store"}
    assert "Somebody" in str(with_more.credit(PartKey("occupancy", "ground", "map")))
    other = read_upload({**files, **added, f"{root}config/location/more.kml": b"<kml/>"})
    assert f"the maps of the package are used: {root}config/location/more.kml was added" in [
        p.problem.removeprefix("exact content ignored; ") for p in other.warnings if p.file == content
    ]


def test_macos_resource_forks_are_no_drawings(shared: Path) -> None:
    drawing = next(path for path in sorted((shared / "data/kml").rglob("*.kml"))).read_bytes()
    files = {"a.kml": drawing, "__MACOSX/._a.kml": b"\x00\x05\x16\x07\x00\x02\x00\x00Mac OS X        "}
    for name in (None, "kml"):
        both = read_upload(files, name)
        assert hashes(both.parts) == hashes(read_upload({"a.kml": drawing}, name).parts)
        assert not both.files["__MACOSX/._a.kml"].used


def offline_layers() -> Layers:
    return Layers({PartKey("occupancy", "ground", "map"): grid()}, DATUM, (Level(),))


def hashes(parts: Mapping[PartKey, Part]) -> dict[PartKey, bytes]:
    """Return the store's hashes of these parts."""
    encoded_parts = {key: store_parts.compose(ChunkStage(lambda _: {}), part, None, "") for key, part in parts.items()}
    return {key: part.hash for key, part in encoded_parts.items() if part is not None}


def test_nested_packages_are_opened_one_level_deep() -> None:
    middle = archives.pack({"config/inner.pkg": SAMPLE, "config/properties.sh": b"export A='1'\n"})
    once = read_upload({"a.zip": middle})
    assert PartKey("topology", "ground", "network") in once.parts
    outer = archives.pack({"config/metric/x/deep.pkg": middle})
    with pytest.raises(BadUpload, match="inside another one"):
        read_upload({"a.pkg": archives.pack({"config/metric/x/deep.pkg": outer})}, "environment")


def test_file_variables_equal_those_of_the_script() -> None:
    inner = unzipped(offline({"yard.zip": SAMPLE}, "environment").files[MAIN])
    lines = inner["config/environment.sh"].decode().splitlines()
    set_here = {line.removeprefix("export ").partition("=")[0] for line in lines if "=" in line}
    assert set_here - {"ENVIRONMENT_COMMON_LATEST_RELEASE"} <= shell.OF_FILES
