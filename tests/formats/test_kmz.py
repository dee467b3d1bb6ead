"""KMZ: the main document is the first .kml entry, other entries round-trip byte for byte, and so do grids."""

from __future__ import annotations

import io
import math
import os
import shutil
import subprocess
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
from lxml import etree

from app.convert.files import offline
from app.errors import BadUpload, TooLarge, UnreadableFile
from app.formats import FileGroup, ReadContext, WriteContext, get_format, group, read, write, write_options
from app.limits import Limits
from app.model.features import Features
from app.model.frame import GROUND, Datum, Level
from app.model.grid import OccupancyGrid
from app.model.imagery import GeoImage
from app.model.layers import MAP, Layers, PartKey, Resources
from app.model.notes import Dropped
from app.syntax import archives

SAMPLES = Path(__file__).parents[1] / "samples" / "kmz"
OBJECTS = PartKey("objects", GROUND, "kml")
RESOURCES = PartKey("resources", GROUND, "kmz")
DATUM = Datum(50.0, 7.0, 60.0, 33.0)
DOCUMENT = b'<kml xmlns="http://www.opengis.net/kml/2.2"><Placemark><name>A</name></Placemark></kml>'
DRAWING = (
    b'<kml xmlns="http://www.opengis.net/kml/2.2"><Document><Placemark><name>Yard</name>'
    b"<Point><coordinates>7.001,50.001</coordinates></Point></Placemark></Document></kml>"
)


def load(data: bytes, name: str = "a.kmz", **context: Any) -> Layers:
    return read(FileGroup(get_format("kmz"), name, {name: data}), ReadContext(**context))


def save(layers: Layers) -> bytes:
    return write(get_format("kmz"), layers, WriteContext())["map.kmz"]


@pytest.fixture(scope="session")
def real(shared: Path, facts_json: dict[str, Any]) -> dict[str, bytes]:
    files = {name: (shared / "data" / name).read_bytes() for name in facts_json if name.endswith(".kmz")}
    assert len(files) >= 10
    return files


REFUSED = {
    "kmz/libkml/bad-too-large.kmz": TooLarge,
    "kmz/libkml/overflow_bad_offset.kmz": UnreadableFile,
    "kmz/libkml/nokml.kmz": UnreadableFile,
}


def test_real_archive_round_trips(real, same, facts_json):
    for name, data in real.items():
        if name in REFUSED:
            continue
        layers = load(data)
        once = save(layers)
        assert same("kmz", {"a.kmz": data}, {"b.kmz": once}) == [], name
        assert save(load(once)) == once, name
        facts = facts_json[name]["facts"]
        with zipfile.ZipFile(io.BytesIO(once)) as archive:
            assert archive.namelist()[0] == facts["first_kml_entry"]
        part = layers.parts[OBJECTS]
        assert isinstance(part, Features)
        drawn = [p for p in part.properties if p["kml"]["xml"].startswith("<Placemark")]
        assert len(drawn) == facts["first_kml"]["placemarks"], name


def test_hostile_and_damaged_archives_are_refused(real):
    for name, error in REFUSED.items():
        with pytest.raises(error) as caught:
            load(real[name])
        assert caught.value.problems


def test_sample_round_trips_with_resources(same):
    data = (SAMPLES / "yard.kmz").read_bytes()
    layers = load(data)
    assert sorted(layers.resources()) == ["images/plan.png", "site/more.kml"]
    part = layers.parts[OBJECTS]
    assert isinstance(part, Features)
    assert [p["kind"] for p in part.properties] == ["overlay", "note", "poi"]
    once = save(layers)
    assert same("kmz", {"a.kmz": data}, {"b.kmz": once}) == []
    again = archives.unpack(once, Limits())
    before = archives.unpack(data, Limits())
    assert next(iter(again)) == "site/yard.kml"
    assert {n: b for n, b in again.items() if n != "site/yard.kml"} == {
        n: b for n, b in before.items() if n != "site/yard.kml"
    }


def test_drawing_of_archive_is_exported_as_kml(same):
    layers = load((SAMPLES / "yard.kmz").read_bytes())
    context = WriteContext()
    out = write(get_format("kml"), layers, context)
    original = archives.unpack((SAMPLES / "yard.kmz").read_bytes(), Limits())["site/yard.kml"]
    assert same("kml", {"a.kml": original}, out) == []
    assert context.dropped == [Dropped("resources", 2, "only KMZ contains images and further files of a drawing")]


def grids() -> Layers:
    cells = np.random.default_rng(3).choice(np.array([0, 1, 37, 50, 99, 100, 255], np.uint8), (30, 41))
    grid = OccupancyGrid(cells, 0.25, (-10.0, 5.0, math.radians(25.0)), "scale", 0.7, 0.2, True, {"x": {"y": [1]}})
    flat = OccupancyGrid(np.full((3, 2), 255, np.uint8), 1.0)
    parts = {PartKey("occupancy", GROUND, MAP): grid, PartKey("occupancy", "upper", "keep out"): flat}
    return Layers(parts, DATUM)


def test_grids_round_trip():
    layers = grids()
    data = save(layers)
    assert sorted(archives.unpack(data, Limits())) == ["doc.kml", "map.png", "upper-keep_out.png"]
    again = load(data)
    assert again.datum == DATUM
    assert set(again.parts) == set(layers.parts)
    for key, grid in layers.grids().items():
        other = again.grids()[key]
        assert np.array_equal(grid.cells, other.cells)
        names = ("resolution", "origin", "mode", "occupied_thresh", "free_thresh", "negate", "properties")
        assert [getattr(grid, n) for n in names] == [getattr(other, n) for n in names]
    assert save(again) == data


def test_grid_and_image_with_same_name_round_trip():
    picture = Resources({"map.png": b"somebody's", "doc.kml.txt": b"x"})
    layers = Layers({**grids().parts, RESOURCES: picture}, DATUM)
    again = load(save(layers))
    assert again.resources() == dict(picture.files)
    assert len(again.grids()) == 2


def test_grid_with_repainted_image_is_refused():
    files = archives.unpack(save(grids()), Limits())
    from app.syntax import images

    files["map.png"] = images.encode_png(np.zeros((30, 41, 3), np.uint8))
    with pytest.raises(UnreadableFile, match="colours"):
        load(archives.pack(files, "doc.kml"))


def test_first_kml_in_archive_is_main_document():
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        archive.writestr("b.txt", b"1")
        archive.writestr("z/Main.KML", DOCUMENT)
        archive.writestr("doc.kml", DOCUMENT.replace(b">A<", b">B<"))
    layers = load(out.getvalue())
    part = layers.parts[OBJECTS]
    assert isinstance(part, Features)
    assert part.ids == ("A",)
    assert sorted(layers.resources()) == ["b.txt", "doc.kml"]
    assert next(iter(archives.unpack(save(layers), Limits()))) == "z/Main.KML"


@pytest.mark.parametrize(
    "data",
    [b"", b"<kml/>", archives.pack({}), archives.pack({"a.txt": b"1"}), archives.pack({"doc.kml": b"<kml>"})],
    ids=["empty", "no archive", "nothing in it", "no kml", "broken kml"],
)
def test_bad_archives_are_refused(data):
    with pytest.raises(BadUpload) as caught:
        load(data)
    assert caught.value.problems


@pytest.mark.parametrize(
    ("name", "data", "answer"),
    [
        ("a.kmz", b"damaged", True),
        ("upload", archives.pack({"doc.kml": DOCUMENT}), True),
        ("folder.zip", archives.pack({"doc.kml": DOCUMENT}), False),
        ("folder", archives.pack({"map.yaml": b""}), False),
        ("a.kml", DOCUMENT, False),
    ],
)
def test_detect_accepts_kmz_only(name, data, answer):
    assert get_format("kmz").detect(name, data) is answer


def test_written_kmz_is_read_by_ogr(tmp_path):
    tool = shutil.which("ogrinfo")
    if tool is None:
        if os.environ.get("CI"):
            pytest.fail("ogrinfo is absent")
        pytest.skip("ogrinfo is absent")
    path = tmp_path / "map.kmz"
    path.write_bytes(save(Layers({**load(archives.pack({"doc.kml": DRAWING})).parts, **grids().parts}, DATUM)))
    done = subprocess.run([tool, "-ro", "-al", str(path)], capture_output=True, text=True, check=True)
    assert "ERROR" not in done.stdout + done.stderr
    assert "Yard" in done.stdout


def make_image(bands: int = 3, **more: Any) -> GeoImage:
    pixels = np.random.default_rng(bands).integers(0, 255, (4, 6, bands), np.uint8)
    c, s = 0.5 * math.cos(0.3), 0.5 * math.sin(0.3)
    return GeoImage(pixels, **{"transform": (c, s, 10.0, s, -c, 20.0), **more})


EARTH = {"crs": "EPSG:32632", "transform": (0.5, 0.0, 356000.0, 0.0, -0.5, 5540000.0)}


@pytest.mark.parametrize("bands", [1, 2, 3, 4])
@pytest.mark.parametrize("place", [{}, EARTH], ids=["local", "utm"])
def test_images_round_trip_with_position(bands: int, place: dict[str, Any]) -> None:
    key = PartKey("imagery", "2", "plan")
    picture = make_image(bands, properties={"attribution": ["© Somebody"]}, **place)
    context = WriteContext()
    data = write(get_format("kmz"), Layers({key: picture}, DATUM, (Level(), Level("2", 3.0))), context)["map.kmz"]
    assert context.dropped == []
    again = load(data).parts
    assert list(again) == [key]
    image = again[key]
    assert isinstance(image, GeoImage)
    assert (image.pixels == picture.pixels).all()
    assert (image.transform, image.crs, image.properties) == (picture.transform, picture.crs, picture.properties)


def test_image_overlay_corners_match_pyproj() -> None:
    picture = make_image(**EARTH)
    files = archives.unpack(save(Layers({PartKey("imagery", name="aerial"): picture})), Limits())
    root = etree.fromstring(files["doc.kml"])
    assert root.findtext(".//{*}Icon/{*}href") == "aerial.png"
    quad = [tuple(map(float, t.split(","))) for t in root.findtext(".//{*}LatLonQuad/{*}coordinates").split()]
    to_earth = pyproj.Transformer.from_crs("EPSG:32632", "EPSG:4326", always_xy=True)
    x, y = 356000.0, 5540000.0
    corners = [(x, y - 2.0), (x + 3.0, y - 2.0), (x + 3.0, y), (x, y)]  # from the lower left one, counter-clockwise
    assert np.allclose(quad, [to_earth.transform(*corner) for corner in corners], atol=1e-11)
    box = {
        n: float(root.findtext(f".//{{*}}LatLonBox/{{*}}{n}")) for n in ("north", "south", "east", "west", "rotation")
    }
    middle = [sum(c[k] for c in quad) / 4 for k in (0, 1)]
    assert middle == pytest.approx([(box["east"] + box["west"]) / 2, (box["north"] + box["south"]) / 2], abs=1e-11)
    convergence = pyproj.Proj("EPSG:32632").get_factors(*middle).meridian_convergence
    assert box["rotation"] == pytest.approx(-convergence, abs=1e-4)


def test_images_beside_kml_require_option() -> None:
    fmt, key = get_format("kml"), PartKey("imagery", name="aerial")
    layers = Layers({key: make_image(**EARTH)}, DATUM)
    bare = WriteContext()
    assert list(write(fmt, layers, bare)) == ["map.kml"]
    assert [(d.subject, d.count) for d in bare.dropped] == [("imagery", 1)]
    files = write(fmt, layers, WriteContext(options=write_options(fmt, {"pictures": "true"})))
    assert list(files) == ["map.kml", "aerial.png"]
    (item,), rest = group({f"a/{name}": data for name, data in files.items()})
    assert (item.format.name, sorted(item.files), rest) == ("kml", ["a/aerial.png", "a/map.kml"], [])
    assert list(read(item, ReadContext()).parts) == [key]
    context = ReadContext()
    assert not read(FileGroup(fmt, "map.kml", {"map.kml": files["map.kml"]}), context).parts
    assert "'aerial.png' is not in the upload" in context.warnings[0].problem


@pytest.mark.parametrize(
    ("picture", "datum", "reason"),
    [
        (make_image(), None, "there is no datum"),
        (make_image(crs="EPSG:4326", transform=(1.0, 0, 178.0, 0, -1.0, 5.0)), None, "not on earth"),
        (make_image(crs="EPSG:32601", transform=(9e4, 0, 1e5, 0, -9e4, 1e5)), None, "antimeridian"),
        (make_image(crs="EPSG:4326", transform=(0.1, 0, 1.0, 0, -0.1, 89.0)), None, "beyond ±85"),
        (make_image(crs="EPSG:2", transform=(1, 0, 0, 0, -1, 0)), None, "unknown CRS"),
    ],
    ids=["no datum", "off earth", "antimeridian", "polar", "no such CRS"],
)
def test_images_without_position_are_reported_as_dropped(picture: GeoImage, datum: Datum | None, reason: str) -> None:
    context = WriteContext()
    data = write(get_format("kmz"), Layers({PartKey("imagery", name="p"): picture}, datum), context)["map.kmz"]
    assert list(archives.unpack(data, Limits())) == ["doc.kml"]
    (line,) = context.dropped
    assert (line.subject, line.count) == ("imagery ground/p", 1)
    assert line.why.startswith("no position in KML: ")
    assert reason in line.why


def test_pixel_values_beyond_8_bit_are_reported_as_dropped() -> None:
    context = WriteContext()
    heights = GeoImage(np.arange(24, dtype=np.float32).reshape(4, 6, 1), **EARTH, properties={"nodata": 3})
    data = write(get_format("kmz"), Layers({PartKey("imagery", name="dem"): heights}), context)["map.kmz"]
    assert [d.subject for d in context.dropped] == ["imagery ground/dem: pixel values"]
    image = load(data).parts[PartKey("imagery", name="dem")]
    assert isinstance(image, GeoImage)
    assert (image.pixels.shape, image.transform) == ((4, 6, 2), EARTH["transform"])


def test_images_beside_kml_match_files() -> None:
    room = SAMPLES.parent / "occupancy_grid" / "room"
    files = {p.name: p.read_bytes() for p in room.iterdir()}
    kmz = archives.unpack(offline(files, "kmz", datum=DATUM).files["map.kmz"], Limits())
    output = offline(files, "kml", datum=DATUM, options={"pictures": "true"}).files
    assert output["room.png"] == kmz["room.png"]
    assert list(offline(files, "kml", datum=DATUM).files) == ["map.kml"]
