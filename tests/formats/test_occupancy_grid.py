"""occupancy_grid: equal to Nav2's rule on real maps, round trips, errors with key and line."""

from __future__ import annotations

import io
import json
import math
import random
import re
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from app import formats
from app.errors import Ambiguous, BadUpload, Invalid, MissingLayer, NotFound, TooLarge, UnreadableFile
from app.formats import ReadContext, WriteContext, occupancy_grid
from app.formats.occupancy_grid.resampling import normalize, resample
from app.formats.occupancy_grid.words import KEYS
from app.limits import Limits
from app.model.grid import UNKNOWN_GREY, OccupancyGrid
from app.model.layers import Layers, PartKey

FORMAT = formats.get_format("occupancy_grid")
SAMPLES = Path(__file__).parents[1] / "samples/occupancy_grid"
YAML = b"image: map.pgm\nresolution: 0.05\norigin: [-1, -2, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
PGM = b"P5\n3 2\n255\n" + bytes([0, 254, 205, 254, 254, 100])

Same = Callable[[str, dict[str, bytes], dict[str, bytes]], list[str]]


def read(files: dict[str, bytes], *, main: str | None = None, **options: Any) -> tuple[OccupancyGrid, ReadContext]:
    layers, context = read_layers(files, main=main, **options)
    (grid,) = layers.grids().values()
    return grid, context


def read_layers(files: dict[str, bytes], *, main: str | None = None, **options: Any) -> tuple[Layers, ReadContext]:
    groups, _ = formats.group(files, "occupancy_grid")
    group = next(g for g in groups if main in (None, g.main))
    context = ReadContext(options=formats.read_options(FORMAT, options))
    return formats.read(group, context), context


def write(layers: Layers | OccupancyGrid, **options: str) -> tuple[dict[str, bytes], WriteContext]:
    if isinstance(layers, OccupancyGrid):
        layers = Layers({PartKey("occupancy"): layers})
    context = WriteContext(options=formats.write_options(FORMAT, options))
    return formats.write(FORMAT, layers, context), context


def grid_of(rows: list[list[int]], resolution: float = 1.0, **more: Any) -> OccupancyGrid:
    """Return the rows of a grid, the top one first."""
    return OccupancyGrid(np.array(rows, np.uint8)[::-1].copy(), resolution, **more)


def seen(grid: OccupancyGrid) -> list[list[int]]:
    rows: list[list[int]] = grid.cells[::-1].tolist()
    return rows


def independent(files: dict[str, bytes], facts: Any) -> np.ndarray:
    """Read the cells with the facts' own reader, as canonical values."""
    cells = facts.occupancy(files)["cells"]
    return np.where(cells < 0, 255, cells).astype(np.uint8)


# --- real maps ----------------------------------------------------------------------------------------------------
def real_maps(shared: Path, facts_json: dict[str, Any]) -> list[tuple[str, dict[str, bytes], dict[str, Any]]]:
    out = []
    for name, entry in sorted(facts_json.items()):
        if entry["kind"] == "occupancy_map_yaml":
            folder = (shared / "data" / name).parent
            files = {p.name: p.read_bytes() for p in folder.iterdir() if p.is_file()}
            out.append((name, files, entry["facts"]))
    assert len(out) > 10
    return out


def test_real_maps_match_facts_and_round_trip(shared: Path, facts_json: dict[str, Any], same: Same) -> None:
    for name, files, facts in real_maps(shared, facts_json):
        main = name.rpartition("/")[2]
        layers, context = read_layers(files, main=main)
        (key,), (grid,) = layers.parts, layers.grids().values()
        yaml_facts = facts["yaml"]
        assert key == PartKey("occupancy", "ground", main.removesuffix(".yaml")), name
        assert (grid.width, grid.height) == (facts["width"], facts["height"]), name
        assert grid.resolution == yaml_facts["resolution"], name
        assert list(grid.origin) == yaml_facts["origin"], name
        counts = grid.counts()
        assert (counts["occupied"], counts["free"], counts["unknown"]) == tuple(facts["cells"].values())[:3], name
        if "other_values" in facts["cells"]:
            values, numbers = np.unique(grid.cells, return_counts=True)
            other_values = {str(-1 if v == 255 else v): int(n) for v, n in zip(values, numbers, strict=True)}
            assert other_values == facts["cells"]["other_values"], name
        bottom_left = int(grid.cells[0, 0])
        assert (-1 if bottom_left == 255 else bottom_left) == facts["bottom_left_cell"], name
        assert bool(context.warnings) == (not facts["image_reference_resolves"]), name
        picture = next(iter(FORMAT.claims.companions(main, files[main], sorted(files))))
        original = {main: files[main], picture: files[picture]}
        pictures = []
        for kind in ("pgm", "png"):
            served, write_context = write(layers, file_type=kind)
            mask = [main.replace(".yaml", "_filter_info.yaml")] if re.search("keepout|speed|nogo", main) else []
            assert list(served) == [main, main.removesuffix("yaml") + kind, *mask]
            if kind == "pgm":  # reading it takes seconds
                assert same("occupancy_grid", original, served) == [], name
            image = served.pop(main.removesuffix("yaml") + kind)
            pictures.append(
                ({n: d.replace(b".png", b".pgm") for n, d in served.items()}, np.asarray(Image.open(io.BytesIO(image))))
            )
            grey = ["free_thresh"] if UNKNOWN_GREY in grid.properties else []
            assert [w.where for w in write_context.warnings] == grey, name
            assert write_context.dropped == [], name
        (pgm, cells), (png, same_cells) = pictures
        assert png == pgm, name
        assert np.array_equal(same_cells, cells), name


def test_bounds_of_occupied_cells_match_facts(shared: Path, facts_json: dict[str, Any]) -> None:
    """Catches errors that counts miss: rows upside down, columns mirrored, an origin off by a cell."""
    for name, files, facts in real_maps(shared, facts_json):
        grid, _ = read(files, main=name.rpartition("/")[2])
        rows, columns = np.nonzero(grid.cells == 100)
        x, y, _ = grid.origin
        if "occupied_bbox_m_unrotated" not in facts:
            assert not len(rows), name
            continue
        low = [x + grid.resolution * columns.min(), y + grid.resolution * rows.min()]
        high = [x + grid.resolution * (columns.max() + 1), y + grid.resolution * (rows.max() + 1)]
        assert np.allclose([*low, *high], facts["occupied_bbox_m_unrotated"], atol=1e-6), name


def test_image_with_foreign_path_is_found_by_base_name(shared: Path) -> None:
    folder = shared / "data/occupancy_grid/turtlebot3_map_office_raw"
    _, context = read({p.name: p.read_bytes() for p in folder.iterdir()})
    (warning,) = context.warnings
    assert "map_office_raw.pgm" in warning.problem
    assert (warning.file, warning.line, warning.where) == ("map_office_raw.yaml", 1, "image")


def test_pgm_png_and_bmp_give_the_same_map(shared: Path) -> None:
    folder = shared / "data/occupancy_grid/nav2_testmap"
    grids = [read({p.name: p.read_bytes()}, resolution="0.1")[0] for p in sorted(folder.glob("testmap.*"))]
    assert len(grids) == 3
    assert all((g.cells == grids[0].cells).all() for g in grids)
    assert grids[0].counts() == {"occupied": 29, "free": 71, "unknown": 0, "other": 0}


def test_extra_keys_of_real_map_round_trip(shared: Path) -> None:
    folder = shared / "data/occupancy_grid/nav2_map_circular"
    grid, _ = read({p.name: p.read_bytes() for p in folder.iterdir()})
    assert grid.properties == {"occupancy_grid": {"map_type": "occupancy"}}
    assert b"\nmap_type: occupancy\n" in write(grid)[0]["map.yaml"]


def test_large_map_is_read_in_bounded_memory(shared: Path) -> None:
    folder = shared / "data/environment_template/riseholme_park_farm_strawberry_polytunnels/config/metric/map"
    files = {p.name: p.read_bytes() for p in folder.glob("map.*")}
    tracemalloc.start()
    try:
        grid, _ = read(files)
        reading = tracemalloc.get_traced_memory()[1]
        tracemalloc.reset_peak()
        before = tracemalloc.get_traced_memory()[0]
        write(grid)
        writing = tracemalloc.get_traced_memory()[1] - before
    finally:
        tracemalloc.stop()
    assert reading < 2 * grid.cells.nbytes  # Pillow's own decoded picture, as large as the cells, is not counted
    assert writing < 3.5 * grid.cells.nbytes


# --- samples ------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", json.loads((SAMPLES / "facts.json").read_text()))
def test_samples_match_facts(name: str, facts: Any, same: Same) -> None:
    expected = json.loads((SAMPLES / "facts.json").read_text())[name]
    files = {p.name: p.read_bytes() for p in (SAMPLES / name).parent.iterdir()}
    grid, _ = read(files)
    counts = {**grid.counts(), "width": grid.width, "height": grid.height}
    corners = {"bottom_left": grid.cells[0, 0], "bottom_right": grid.cells[0, -1], "top_right": grid.cells[-1, -1]}
    assert {**counts, **{k: int(v) for k, v in corners.items()}} == expected
    assert (independent(files, facts) == grid.cells).all()
    main = name.rpartition("/")[2]
    served, context = write(Layers({PartKey("occupancy", name=main.removesuffix(".yaml")): grid}))
    assert same("occupancy_grid", files, served) == []
    again, _ = read(served)
    assert (again.origin, again.negate) == (grid.origin, grid.negate)
    filled = [t.subject for t in context.template]
    assert filled == (["filter info: type, base, multiplier"] if name == "speed/speed.yaml" else [])
    if not filled:
        assert again.properties == grid.properties


# --- telling and finding ------------------------------------------------------------------------------------------
def test_detect_uses_content() -> None:
    assert FORMAT.detect("a.yaml", YAML)
    assert FORMAT.detect("no name at all", b"\xef\xbb\xbf# a comment\n# another: image\n\n" + YAML)
    assert FORMAT.detect("a.yaml", YAML.replace(b"\n", b"\r\n"))
    assert FORMAT.detect("a.yaml", b'# c\n{image: a.png, resolution: 1, "origin": [0, 0, 0]}')
    assert FORMAT.detect("a.yaml", b'"image": a.png\n"resolution": 1\n"negate": 0\n')
    assert FORMAT.detect(
        "a.yaml", b"image: a\nresolution: 1\nfree_thresh: 0.1"
    )  # so that the reader can say what lacks
    assert not FORMAT.detect("map.pgm", PGM)
    assert not FORMAT.detect("map.yaml", b"image: a.png\nname: b\n")
    assert not FORMAT.detect("map.yaml", b"levels:\n  L1:\n    image: a\n    resolution: 1\n    origin: [0, 0, 0]\n")
    assert not FORMAT.detect("map.yaml", b"# image: a\n# resolution: 1\n# origin: []\n")
    assert not FORMAT.detect("map.yaml", b"")


def test_images_belong_to_their_yaml() -> None:
    files = {"a/map.yaml": YAML, "a/map.pgm": PGM, "a/other.pgm": PGM, "b/map.pgm": PGM}
    groups, rest = formats.group(files)
    assert [(g.format.name, g.main, sorted(g.files)) for g in groups] == [
        ("occupancy_grid", "a/map.yaml", ["a/map.pgm", "a/map.yaml"])
    ]
    assert rest == ["a/other.pgm", "b/map.pgm"]


@pytest.mark.parametrize(
    ("image", "where", "warns"),
    [
        ("map.pgm", "maps/map.pgm", False),
        ("./map.pgm", "maps/map.pgm", False),
        ("images/map.pgm", "maps/images/map.pgm", False),
        ("images/map.pgm", "maps/map.pgm", True),
        ("map.pgm", "elsewhere/map.pgm", True),
        ("/home/ada/maps/map.pgm", "maps/map.pgm", True),
        ("~/maps/map.pgm", "maps/map.pgm", True),
        ("../map.pgm", "map.pgm", True),
        ("../../../etc/map.pgm", "maps/map.pgm", True),
        ("C:\\maps\\map.pgm", "maps/map.pgm", True),
        ("file:///maps/map.pgm", "maps/map.pgm", True),
        ("$HOME/map.pgm", "maps/map.pgm", True),
        ("a%2f..%2fmap.pgm", None, False),
        ("100%.pgm", "maps/100%.pgm", False),
        ("other.pgm", None, False),
        ("..", None, False),
        ("/", None, False),
        ("map.yaml", None, False),
    ],
)
def test_image_lookup_never_leaves_the_upload(image: str, where: str | None, warns: bool) -> None:
    files = {"maps/map.yaml": YAML.replace(b"map.pgm", json.dumps(image).encode())}
    files[where or "maps/unrelated.pgm"] = PGM
    if where is None:
        with pytest.raises(UnreadableFile, match="add this file") as error:
            read(files)
        assert (error.value.problems[0].line, error.value.problems[0].where) == (1, "image")
        return
    grid, context = read(files)
    assert grid.width == 3
    assert bool(context.warnings) == warns


def test_ambiguous_image_name_raises_unreadable_file() -> None:
    files = {"map.yaml": YAML.replace(b"map.pgm", b"/x/map.pgm"), "b/map.pgm": PGM, "a/map.pgm": PGM}
    with pytest.raises(UnreadableFile, match="next to the YAML file"):
        read(files)
    assert read({**files, "map.pgm": PGM})[1].warnings[0].problem.endswith("'map.pgm' is used")


# --- reading ------------------------------------------------------------------------------------------------------
def test_rows_are_flipped_and_thresholds_applied() -> None:
    grid, context = read({"map.yaml": YAML, "map.pgm": PGM})
    assert seen(grid) == [[100, 0, 255], [0, 0, 255]]
    assert (grid.resolution, grid.origin, grid.mode) == (0.05, (-1.0, -2.0, 0.0), "trinary")
    assert context.warnings == []


def test_context_sets_grid_and_level() -> None:
    groups, _ = formats.group({"map.yaml": YAML, "map.pgm": PGM})
    layers = formats.read(groups[0], ReadContext(grid="keepout", level="L2"))
    assert list(layers.parts) == [PartKey("occupancy", "L2", "keepout")]
    assert formats.read(groups[0], ReadContext(requested_layers=frozenset({"topology"}))).parts == {}


@pytest.mark.parametrize(
    ("old", "new", "key", "line"),
    [
        (b"image: map.pgm\n", b"", "image", None),
        (b"map.pgm", b"", "image", 1),
        (b"map.pgm", b"[1]", "image", 1),
        (b"resolution: 0.05\n", b"", "resolution", None),
        (b"0.05", b"0", "resolution", 2),
        (b"0.05", b"-0.05", "resolution", 2),
        (b"0.05", b"1e-9", "resolution", 2),
        (b"0.05", b"[0.05]", "resolution", 2),
        (b"0.05", b"true", "resolution", 2),
        (b"0.05", b"5cm", "resolution", 2),
        (b"[-1, -2, 0]", b"[-1, -2]", "origin", 3),
        (b"[-1, -2, 0]", b"[-1, -2, 0, 0]", "origin", 3),
        (b"[-1, -2, 0]", b"[-1, null, 0]", "origin", 3),
        (b"[-1, -2, 0]", b"[-1, 1e300, 0]", "origin", 3),
        (b"[-1, -2, 0]", b"{x: 1}", "origin", 3),
        (b"negate: 0\n", b"", "negate", None),
        (b"negate: 0", b"negate: maybe", "negate", 4),
        (b"negate: 0", b"negate: 0.5", "negate", 4),
        (b"0.65", b"65", "occupied_thresh", 5),
        (b"0.65", b"x", "occupied_thresh", 5),
        (b"0.196", b"-0.1", "free_thresh", 6),
        (b"free_thresh: 0.196\n", b"", "free_thresh", None),
        (b"negate: 0", b"negate: 0\nmode: Trinary", "mode", 5),
        (b"negate: 0", b"negate: 0\nmode: [raw]", "mode", 5),
    ],
)
def test_invalid_yaml_raises_unreadable_file_with_key_and_line(
    old: bytes, new: bytes, key: str, line: int | None
) -> None:
    with pytest.raises(UnreadableFile) as error:
        read({"map.yaml": YAML.replace(old, new, 1), "map.pgm": PGM})
    (problem,) = error.value.problems
    assert (problem.file, problem.where, problem.line) == ("map.yaml", key, line)
    assert key in problem.problem


@pytest.mark.parametrize("value", [b".nan", b".inf", b"-.inf", b"1e999"])
def test_non_finite_number_raises_unreadable_file(value: bytes) -> None:
    for old in (b"0.05", b"-2", b"0.65"):
        with pytest.raises(UnreadableFile) as error:
            read({"map.yaml": YAML.replace(old, value, 1), "map.pgm": PGM})
        assert error.value.problems[0].line


def test_all_problems_are_reported_at_once() -> None:
    with pytest.raises(UnreadableFile) as error:
        read({"map.yaml": b"image: a\nresolution: 0\nnegate: x\n", "map.pgm": PGM})
    assert {p.where for p in error.value.problems} == {
        *("resolution", "negate", "origin", "occupied_thresh", "free_thresh")
    }


@pytest.mark.parametrize("data", [b"", b"[]", b"text", b"a: [", b"- 1\n- 2\n", b"\xff\xfe"])
def test_yaml_without_mapping_raises_unreadable_file(data: bytes) -> None:
    with pytest.raises(UnreadableFile):
        read({"map.yaml": data})


def test_alias_bomb_raises_unreadable_file() -> None:
    bomb = b"a0: &a0 [x, x]\n" + b"".join(
        b"a%d: &a%d [%s]\n" % (i, i, b", ".join([b"*a%d" % (i - 1)] * 9)) for i in range(1, 12)
    )
    with pytest.raises(BadUpload):
        read({"map.yaml": YAML + bomb, "map.pgm": PGM})


def test_damaged_image_raises_an_error_with_its_name() -> None:
    with pytest.raises(UnreadableFile, match=r"map.pgm: the PGM is truncated") as error:
        read({"map.yaml": YAML, "map.pgm": PGM[:-1]})
    assert error.value.problems[0].file == "map.pgm"
    with pytest.raises(TooLarge) as large:
        read({"map.yaml": YAML, "map.pgm": b"P5 100000 100000 255\n" + PGM})
    assert large.value.problems[0].file == "map.pgm"


def test_values_accepted_by_yaml_cpp_are_accepted() -> None:
    text = YAML.replace(b"0.05", b'"5e-2"').replace(b"negate: 0", b"negate: no").replace(b"[-1,", b"['-1',")
    grid, _ = read({"map.yaml": text, "map.pgm": PGM})
    assert (grid.resolution, grid.negate, grid.origin[0]) == (0.05, False, -1.0)


def test_yaw_is_kept_with_a_warning() -> None:
    grid, context = read({"map.yaml": YAML.replace(b"-2, 0]", b"-2, 0.5]"), "map.pgm": PGM})
    assert grid.origin == (-1.0, -2.0, 0.5)
    assert "normalize" in context.warnings[0].problem
    assert context.warnings[0].line == 3
    served, write_context = write(grid)
    assert b"origin: [-1.0, -2.0, 0.5]" in served["map.yaml"]
    assert "normalize" in write_context.warnings[0].problem


def test_swapped_thresholds_are_read_as_in_nav2(facts: Any) -> None:
    files = {"map.yaml": YAML.replace(b"0.65", b"0.1").replace(b"0.196", b"0.9"), "map.pgm": PGM}
    grid, context = read(files)
    assert (grid.cells == independent(files, facts)).all()
    assert "free_thresh" in context.warnings[0].problem


# --- a picture alone ----------------------------------------------------------------------------------------------
def test_single_image_requires_resolution() -> None:
    with pytest.raises(UnreadableFile, match="resolution") as error:
        read({"hall.pgm": PGM})
    assert error.value.problems[0].where == "resolution"
    options = {"resolution": "0.1", "origin": "1,2,0", "negate": "true", "mode": "raw"}
    layers, _ = read_layers({"x/hall.pgm": PGM}, **options)
    ((key, grid),) = layers.grids().items()
    assert key.name == "hall"
    assert (grid.resolution, grid.origin, grid.negate, grid.mode) == (0.1, (1.0, 2.0, 0.0), True, "raw")
    assert seen(grid) == [[0, 255, 255], [255, 255, 100]]


def test_error_names_the_yaml_when_detection_fails() -> None:
    with pytest.raises(UnreadableFile) as error:
        read({"map.pgm": PGM, "map.yaml": b"image: map.pgm\n"})
    assert {p.file for p in error.value.problems} == {"map.yaml"}


def test_image_options_are_ignored_with_warning_when_yaml_exists() -> None:
    grid, context = read({"map.yaml": YAML, "map.pgm": PGM}, resolution="7")
    assert grid.resolution == 0.05
    assert "are ignored" in context.warnings[0].problem


# --- which grid ---------------------------------------------------------------------------------------------------
def test_choose_selects_grid() -> None:
    def layers(*keys: PartKey) -> Layers:
        return Layers({key: grid_of([[0] * (i + 1)]) for i, key in enumerate(keys)})

    def file_names(content: Layers, **options: str) -> list[str]:
        return list(write(content, **options)[0])

    ground, keepout = PartKey("occupancy"), PartKey("occupancy", name="keepout")
    speed, upper = PartKey("occupancy", name="speed"), PartKey("occupancy", "L1", "map")
    attic = PartKey("occupancy", "L2", "map")
    assert file_names(layers(ground, keepout)) == ["map.yaml", "map.pgm"]
    assert file_names(layers(keepout)) == ["keepout.yaml", "keepout.pgm", "keepout_filter_info.yaml"]
    assert file_names(layers(ground, keepout), grid="keepout") == [
        "keepout.yaml",
        "keepout.pgm",
        "keepout_filter_info.yaml",
    ]
    assert b"P5\n1 1\n" in write(layers(ground, upper))[0]["map.pgm"]
    assert b"P5\n2 1\n" in write(layers(ground, upper), level="L1")[0]["map.pgm"]
    with pytest.raises(Ambiguous, match="keepout, speed"):
        write(layers(keepout, speed))
    with pytest.raises(Ambiguous, match="L1, L2"):
        write(layers(upper, attic))
    with pytest.raises(NotFound, match="keepout"):
        write(layers(keepout), grid="map")
    with pytest.raises(NotFound, match="ground"):
        write(layers(keepout), level="L9")
    with pytest.raises(MissingLayer, match="upload"):
        write(Layers())
    with pytest.raises(Invalid, match="height"):
        write(layers(ground), height="1")


@pytest.mark.parametrize("name", ["a/b", "..", ".hidden", "käfig 1", "true", "100%", 'q"uote', "😀", "#x", "a: b"])
def test_unusual_grid_names_round_trip(name: str, facts: Any) -> None:
    grid = grid_of([[0, 100], [255, 0]])
    served, _ = write(Layers({PartKey("occupancy", name=name): grid}))
    assert not any("/" in n or n.startswith(".") for n in served)
    again, context = read(served)
    assert (again.cells == grid.cells).all()
    assert context.warnings == []


# --- writing ------------------------------------------------------------------------------------------------------
def test_new_grid_is_written_as_by_map_saver() -> None:
    served, context = write(grid_of([[0, 100], [255, 0]], 0.05, origin=(-1.0, 0.1, 0.0)))
    assert served == {
        "map.yaml": b"image: map.pgm\nmode: trinary\nresolution: 0.05\norigin: [-1.0, 0.1, 0.0]\nnegate: 0\n"
        b"occupied_thresh: 0.65\nfree_thresh: 0.196\n",
        "map.pgm": b"P5\n2 2\n255\n" + bytes([254, 0, 205, 254]),
    }
    assert context.warnings == []


def test_value_outside_trinary_is_written_raw(facts: Any) -> None:
    grid = grid_of([[0, 100], [255, 37]])
    served, context = write(grid)
    assert b"mode: raw\n" in served["map.yaml"]
    assert (independent(served, facts) == grid.cells).all()
    assert "raw" in context.warnings[0].problem
    forced, context = write(grid, mode="trinary")
    assert seen(read(forced)[0]) == [[0, 100], [255, 255]]
    assert context.dropped[0].count == 1
    scaled, _ = write(grid, mode="scale")
    assert list(scaled) == ["map.yaml", "map.png"]
    assert (independent(scaled, facts) == grid.cells).all()
    with pytest.raises(Invalid, match="file_type=png"):
        write(grid, mode="scale", file_type="pgm")


def test_unknown_in_scale_is_transparent_in_png_and_raw_in_pgm(facts: Any) -> None:
    grid = grid_of([[0, 100, 255], [1, 50, 99]], mode="scale", occupied_thresh=1.0, free_thresh=0.0)
    served, context = write(grid)
    assert list(served) == ["map.yaml", "map.png"]
    assert Image.open(io.BytesIO(served["map.png"])).mode == "LA"
    assert (independent(served, facts) == grid.cells).all()
    assert context.warnings == []
    plain, context = write(grid, file_type="pgm")
    assert b"mode: raw\n" in plain["map.yaml"]
    assert (independent(plain, facts) == grid.cells).all()
    assert "unknown" in context.warnings[0].problem
    complete_grid = grid_of([[0, 100, 7]], mode="scale", occupied_thresh=1.0, free_thresh=0.0)
    assert list(write(complete_grid)[0]) == ["map.yaml", "map.pgm"]


def test_every_cell_value_round_trips_in_common_scales(facts: Any) -> None:
    every = OccupancyGrid(np.arange(101, dtype=np.uint8)[None, :].copy(), 1.0)
    for high, low in ((1.0, 0.0), (0.99, 0.01), (0.65, 0.196)):
        grid = OccupancyGrid(every.cells, 1.0, mode="scale", occupied_thresh=high, free_thresh=low)
        served, context = write(grid)
        assert b"mode: scale" in served["map.yaml"]
        assert (independent(served, facts) == grid.cells).all()
        assert context.warnings == []


THRESHOLDS = st.one_of(st.floats(0, 1), st.sampled_from([0.0, 0.01, 0.196, 0.25, 0.5, 0.65, 0.99, 1.0]))


@given(
    pixels=st.lists(st.integers(0, 255), min_size=1, max_size=40),
    mode=st.sampled_from(["trinary", "scale", "raw"]),
    negate=st.booleans(),
    high=THRESHOLDS,
    low=THRESHOLDS,
    kind=st.sampled_from([{}, {"file_type": "pgm"}, {"file_type": "png"}]),
)
def test_any_uploaded_grid_round_trips(
    facts: Any, pixels: list[int], mode: str, negate: bool, high: float, low: float, kind: dict[str, str]
) -> None:
    text = (
        f"image: map.pgm\nmode: {mode}\nresolution: 0.1\norigin: [0, 0, 0]\nnegate: {int(negate)}\n"
        f"occupied_thresh: {high!r}\nfree_thresh: {low!r}\n"
    )
    files = {"map.yaml": text.encode(), "map.pgm": b"P5\n%d 1\n255\n" % len(pixels) + bytes(pixels)}
    grid, _ = read(files)
    expected = independent(files, facts)
    assert (grid.cells == expected).all()
    served, context = write(grid, **kind)
    assert (independent(served, facts) == expected).all()
    assert f"mode: {mode}\n".encode() in served["map.yaml"]
    assert not any(w.level is None for w in context.warnings)
    again, _ = read(served)
    assert (again.occupied_thresh, again.free_thresh, again.negate) == (high, low, negate)


@given(
    cells=st.lists(st.sampled_from([*range(101), 255]), min_size=1, max_size=40),
    mode=st.sampled_from(["trinary", "scale", "raw"]),
    negate=st.booleans(),
    high=THRESHOLDS,
    low=THRESHOLDS,
    kind=st.sampled_from([{}, {"file_type": "pgm"}, {"file_type": "png"}]),
)
def test_any_stored_grid_round_trips(
    facts: Any, cells: list[int], mode: Any, negate: bool, high: float, low: float, kind: dict[str, str]
) -> None:
    """Cells that the stored mode and thresholds cannot represent (after an edit) are written in a mode that can."""
    grid = OccupancyGrid(np.array([cells], np.uint8), 0.1, (0.0, 0.0, 0.0), mode, high, low, negate)
    served, context = write(grid, **kind)
    assert (independent(served, facts) == grid.cells).all()
    assert any(w.level is None for w in context.warnings) == (f"mode: {mode}\n".encode() not in served["map.yaml"])


JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**63 - 1)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(st.characters(codec="utf-8"), max_size=12),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.text(st.characters(codec="utf-8"), max_size=6), inner, max_size=3)
    ),
    max_leaves=6,
)


@given(extra=st.dictionaries(st.text(st.characters(codec="utf-8"), max_size=8), JSON, max_size=4))
def test_extra_keys_of_any_kind_round_trip(extra: dict[str, Any]) -> None:
    extra = {k: v for k, v in extra.items() if k not in KEYS}
    grid = grid_of([[0]], properties={"occupancy_grid": extra} if extra else {})
    again, _ = read(write(grid)[0])
    assert again.properties == grid.properties


@given(st.floats(1e-6, 1e4), st.tuples(*[st.floats(-1e7, 1e7)] * 3))
def test_numbers_round_trip_exactly(resolution: float, origin: tuple[float, float, float]) -> None:
    again, _ = read(write(OccupancyGrid(np.zeros((1, 1), np.uint8), resolution, origin))[0])
    assert (again.resolution, again.origin) == (resolution, origin)


def test_same_layers_give_same_bytes() -> None:
    cells = np.random.default_rng(1).choice(np.array([0, 100, 255], np.uint8), (300, 400))
    for kind in ("pgm", "png"):
        assert (
            write(OccupancyGrid(cells, 0.1), file_type=kind)[0]
            == write(OccupancyGrid(cells.copy(), 0.1), file_type=kind)[0]
        )


def test_grid_too_wide_for_nav2_gives_a_warning() -> None:
    _, context = write(OccupancyGrid(np.zeros((1, 32768), np.uint8), 0.1))
    assert "32767" in context.warnings[0].problem


# --- resampling ---------------------------------------------------------------------------------------------------
def test_coarser_cells_keep_obstacles_and_unknown() -> None:
    grid = grid_of([[0, 0, 0, 255, 0], [0, 0, 0, 0, 100], [255, 255, 0, 7, 0]], 0.5)
    out = resample(grid, 1.0)
    assert seen(out) == [[0, 255, 0], [255, 7, 100]]
    assert (out.resolution, out.origin) == (1.0, grid.origin)
    assert seen(resample(grid, 10.0)) == [[100]]


def test_cells_sharing_a_source_cell_both_get_its_obstacle() -> None:
    grid = grid_of([[0, 100, 0]], 1.0)
    assert seen(resample(grid, 1.5)) == [[100, 100]]


def test_finer_cells_are_copies() -> None:
    grid = grid_of([[0, 100], [255, 3]], 1.0)
    out = resample(grid, 0.5)
    assert seen(out) == [[0, 0, 100, 100], [0, 0, 100, 100], [255, 255, 3, 3], [255, 255, 3, 3]]


@given(
    cells=st.integers(1, 9).flatmap(
        lambda n: st.lists(st.lists(st.sampled_from([0, 100, 255, 40]), min_size=n, max_size=n), min_size=1, max_size=9)
    ),
    old=st.sampled_from([0.05, 0.1, 0.03, 1.0]),
    new=st.sampled_from([0.05, 0.1, 0.02, 0.07, 0.25, 3.0, 0.013]),
)
def test_resampling_matches_covered_areas(cells: list[list[int]], old: float, new: float) -> None:
    grid = grid_of(cells, old)
    out = resample(grid, new)
    rank = {0: 0, 255: 1, 40: 41, 100: 101}
    slack = 1e-5 * old
    for j in range(out.height):
        for i in range(out.width):
            if new >= old:
                covered = [
                    int(grid.cells[q, p])
                    for q in range(grid.height)
                    for p in range(grid.width)
                    if p * old < (i + 1) * new - slack
                    and (p + 1) * old > i * new + slack
                    and q * old < (j + 1) * new - slack
                    and (q + 1) * old > j * new + slack
                ]
                assert out.cells[j, i] == max(covered, key=lambda v: rank[v])
            else:
                p, q = ((k + 0.5) * new / old for k in (i, j))
                if min(abs(p - round(p)), abs(q - round(q))) > 1e-6:
                    near = grid.cells[min(int(q), grid.height - 1), min(int(p), grid.width - 1)]
                    assert out.cells[j, i] == near


def test_resolution_option_is_bounded() -> None:
    grid = grid_of([[0, 100], [255, 0]], 0.05)
    served, _ = write(grid, resolution="0.1")
    assert b"resolution: 0.1\n" in served["map.yaml"]
    assert seen(read(served)[0]) == [[100]]
    wide = OccupancyGrid(np.zeros((4000, 4000), np.uint8), 0.05)
    with pytest.raises(Invalid, match="cells"):
        write(wide, resolution="0.001")
    for bad in ("0", "-1", "nan", "1e9", "x"):
        with pytest.raises(Invalid, match="resolution"):
            write(grid, resolution=bad)


# --- yaw ----------------------------------------------------------------------------------------------------------
def place(grid: OccupancyGrid) -> tuple[np.ndarray, np.ndarray]:
    """Return every cell's centre in metres [n, 2] by the definition of origin and yaw, and the cells' values [n]."""
    x, y, yaw = grid.origin
    rows, columns = np.indices(grid.cells.shape)
    u, v = (columns.ravel() + 0.5) * grid.resolution, (rows.ravel() + 0.5) * grid.resolution
    at = np.stack([x + u * math.cos(yaw) - v * math.sin(yaw), y + u * math.sin(yaw) + v * math.cos(yaw)], 1)
    return at, grid.cells.ravel()


@pytest.mark.parametrize("yaw", [0.0, 0.3, -1.2, math.pi / 2, math.pi, -math.pi / 2, 3.0, 7.0])
@pytest.mark.parametrize("origin", [(0.0, 0.0), (-3.21, 7.77), (1234.567, -9876.543)])
def test_normalize_keeps_positions(yaw: float, origin: tuple[float, float]) -> None:
    dice = np.random.default_rng(5)
    cells = dice.choice(np.array([0, 0, 0, 255, 100], np.uint8), (23, 31))
    grid = OccupancyGrid(cells, 0.2, (*origin, yaw))
    out = normalize(grid)
    assert out.origin[2] == 0.0
    for v in out.origin[:2]:
        assert abs(v / 0.2 - round(v / 0.2)) < 1e-6
    # Every obstacle is in an occupied cell.
    at, values = place(grid)
    index = np.floor((at - out.origin[:2]) / 0.2 + 1e-9).astype(int)
    assert (index >= 0).all()
    assert (index < [out.width, out.height]).all()
    baked_cells = out.cells[index[:, 1], index[:, 0]]
    assert (baked_cells[values == 100] == 100).all()
    # Every free cell was free at its centre, every cell outside is unknown, and no obstacle came from nowhere.
    at, values = place(out)
    turned = (at - np.array(origin)) @ np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]) / 0.2
    inside = ((turned > 1e-6) & (turned < np.array([31, 23]) - 1e-6)).all(axis=1)
    edge = (np.abs(turned - np.round(turned)) < 1e-6).any(axis=1)
    column, row = np.floor(turned[inside & ~edge]).astype(int).T
    was = cells[row, column]
    now = values[inside & ~edge]
    assert (was[now == 0] == 0).all()
    assert (now[was == 100] == 100).all()
    outside = ((turned < -1) | (turned > np.array([32, 24]))).any(axis=1)
    assert (values[outside] == 255).all()
    assert (values == 100).sum() <= 2 * (cells == 100).sum() + 4


def test_normalize_is_exact_for_quarter_turns() -> None:
    cells = np.random.default_rng(2).choice(np.array([0, 100, 255], np.uint8), (5, 7))
    for turns, yaw in enumerate([0.0, math.pi / 2, math.pi, 3 * math.pi / 2]):
        out = normalize(OccupancyGrid(cells, 0.5, (2.0, -1.0, yaw)))
        expected = np.rot90(cells[::-1], turns)[::-1]
        assert (out.cells == expected).all()


def test_normalize_keeps_aligned_grid() -> None:
    grid = grid_of([[0, 100, 255]], 0.05, origin=(0.15, -100.0, 0.0))
    out = normalize(grid)
    assert (out.cells == grid.cells).all()
    assert out.origin == grid.origin


def test_normalize_is_an_option(facts: Any) -> None:
    grid = grid_of([[0, 100], [255, 0]], 1.0, origin=(0.3, 0.0, 0.5))
    served, context = write(grid, normalize="true")
    assert context.warnings == []
    assert facts.load_yaml(served["map.yaml"])["origin"][2] == 0.0
    assert (independent(served, facts) == normalize(grid).cells).all()


def test_normalize_is_bounded() -> None:
    long = OccupancyGrid(np.zeros((1, 2**20), np.uint8), 1.0, (0.0, 0.0, math.pi / 4))
    with pytest.raises(Invalid, match="cells"):
        normalize(long)


# --- hostile ------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", ["room", "turned", "speed"])
def test_truncated_and_mutated_files_are_rejected_or_read(name: str) -> None:
    files = {p.name: p.read_bytes() for p in (SAMPLES / name).iterdir()}
    dice = random.Random(name)
    for victim, original in files.items():
        for _ in range(120):
            data = bytearray(original)
            if dice.random() < 0.5:
                data = data[: dice.randrange(len(data))]
            else:
                data[dice.randrange(len(data))] ^= 1 << dice.randrange(8)
            try:
                grid, _ = read({**files, victim: bytes(data)})
            except BadUpload:
                continue
            write(grid)


@given(st.binary(max_size=200), st.booleans())
def test_any_bytes_are_rejected_or_read(data: bytes, after: bool) -> None:
    files = {"map.yaml": YAML + data if after else data, "map.pgm": PGM}
    FORMAT.detect("map.yaml", files["map.yaml"])
    list(FORMAT.claims.companions("map.yaml", files["map.yaml"], sorted(files)))
    context = ReadContext(limits=Limits(pixels=1000))
    group = formats.FileGroup(FORMAT, "map.yaml", files)
    try:
        formats.read(group, context)
    except BadUpload:
        return


def test_detect_is_fast_on_any_input() -> None:
    for piece in (b" ", b"{", b"#\n", b"image:", b"\n", b"---", b'"', b"image: resolution: ", b"%a\n"):
        assert FORMAT.detect("x", piece * (2**22 // len(piece))) in (True, False)


# --- costmap filter masks -----------------------------------------------------------------------------------------
MASK = {p.name: p.read_bytes() for p in (SAMPLES / "mask").iterdir()}


def info_of(files: dict[str, bytes], name: str) -> dict[str, Any]:
    parameters: dict[str, Any] = yaml.safe_load(files[name])["costmap_filter_info_server"]["ros__parameters"]
    return parameters


def test_mask_parameters_round_trip() -> None:
    grid, context = read(MASK)
    assert context.warnings == []
    served, write_context = write(Layers({PartKey("occupancy", name="slow_mask"): grid}))
    assert list(served) == ["slow_mask.yaml", "slow_mask.pgm", "slow_mask_filter_info.yaml"]
    once, now = (yaml.safe_load(f) for f in (MASK["slow_params.yaml"], served["slow_mask_filter_info.yaml"]))
    assert now == once
    assert info_of(served, "slow_mask_filter_info.yaml")["type"] == 2
    base = info_of(served, "slow_mask_filter_info.yaml")["base"]
    assert type(base) is float, "ROS refuses a whole number for a parameter declared as double"
    assert write_context.template == write_context.warnings == []
    again, _ = read(served)
    assert write(Layers({PartKey("occupancy", name="slow_mask"): again}))[0] == served


def test_mask_without_parameters_gets_nav2_defaults() -> None:
    grid = grid_of([[0, 100]])
    served, context = write(Layers({PartKey("occupancy", name="keepout"): grid}))
    assert info_of(served, "keepout_filter_info.yaml") == {
        "type": 0, "base": 0.0, "multiplier": 1.0, "mask_topic": "/keepout_filter_mask",
        "filter_info_topic": "/keepout_costmap_filter_info",
    }  # fmt: skip
    server = yaml.safe_load(served["keepout_filter_info.yaml"])["filter_mask_server"]["ros__parameters"]
    assert server == {"frame_id": "map", "topic_name": "/keepout_filter_mask", "yaml_filename": "keepout.yaml"}
    assert [t.value for t in context.template] == [{"type": 0, "base": 0.0, "multiplier": 1.0}]
    served, context = write(Layers({PartKey("occupancy", name="speed_zone"): grid_of([[0, 50], [255, 0]])}))
    parameters = info_of(served, "speed_zone_filter_info.yaml")
    assert (parameters["type"], parameters["base"], parameters["multiplier"]) == (1, 100.0, -1.0)
    assert any("unknown cells" in w.problem for w in context.warnings)
    assert list(write(grid)[0]) == ["map.yaml", "map.pgm"]


def test_parameter_files_with_namespaces_and_other_nodes_are_read() -> None:
    parameters = yaml.safe_load(MASK["slow_params.yaml"])
    within = {**MASK, "slow_params.yaml": yaml.safe_dump({"robot_1": {"nav": parameters}, "amcl": {"x": 1}}).encode()}
    grid, _ = read(within)
    served, _ = write(Layers({PartKey("occupancy", name="slow_mask"): grid}))
    assert yaml.safe_load(served["slow_mask_filter_info.yaml"]) == {"robot_1": {"nav": parameters}, "amcl": {"x": 1}}
    grid, context = read({**MASK, "slow_params.yaml": b"amcl: {ros__parameters: {alpha1: 0.2}}"})
    assert grid.properties == {}
    assert "no parameters" in context.warnings[0].problem
    both = {"a": parameters["costmap_filter_info_server"], "b": parameters["costmap_filter_info_server"]}
    _, context = read({**MASK, "slow_params.yaml": yaml.safe_dump(both).encode()})
    assert "2 filter info servers" in context.warnings[0].problem


@pytest.mark.parametrize(
    ("old", "new", "where"),
    [
        (b"type: 2", b"type: 7", "type"),
        (b"type: 2", b"type: true", "type"),
        (b"multiplier: 0.01", b"multiplier: fast", "multiplier"),
        (b"base: 0", b"base: [0]", "base"),
        (b'"/slow_filter_mask"\n    base', b"3\n    base", "mask_topic"),
    ],
)
def test_invalid_mask_parameters_raise_an_error_with_location(old: bytes, new: bytes, where: str) -> None:
    files = {**MASK, "slow_params.yaml": MASK["slow_params.yaml"].replace(old, new)}
    assert files != MASK
    with pytest.raises(UnreadableFile) as caught:
        read(files)
    assert [(p.file, p.where) for p in caught.value.problems] == [("slow_params.yaml", where)]


def test_mask_files_are_selected_by_name() -> None:
    assert occupancy_grid.options_from_filename("keepout_filter_info.yaml") == {"grid": "keepout"}
    assert occupancy_grid.options_from_filename("keepout.yaml") == {"grid": "keepout"}
