"""Maps assembled from the maps of several parts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from app import formats
from app.convert import site, worker
from app.convert.cache import Cache, ConvertedMap, LostMap
from app.convert.maps import join_members, select_file
from app.convert.recipe import DerivationChain, Member, Recipe, Spread
from app.convert.report import Report, merge_reports
from app.errors import MissingLayer, NotFound, Problem
from app.model.features import features
from app.model.frame import Level
from app.model.grid import OccupancyGrid
from app.model.layers import Layers, PartKey
from app.model.notes import Dropped

EMPTY = Report("satellite")


def recipe(key: str, **more: Any) -> Recipe:
    version: Any = None
    fmt = formats.get_format("satellite")
    return Recipe(version, fmt, fmt.write_options(), DerivationChain((), ()), key, **more)


def product(name: str, **more: Any) -> ConvertedMap:
    return ConvertedMap({name: (name.encode(), "image/tiff")}, None, replace(EMPTY, **more))


def test_files_with_equal_names_are_reported(tmp_path: Path) -> None:
    cache = Cache(tmp_path, 2**20)
    members = tuple(Member(recipe(str(n)), "L2/", ("L2", name)) for n, name in enumerate(("a_b", "a/b")))
    cached_maps = [cache.get_or_make(f"{n:064}", lambda: product("a_b.tif")) for n in range(2)]
    out = join_members(recipe("all", members=members), cached_maps)
    assert list(out.files) == ["L2/a_b.tif"]
    assert out.places == {"L2/a_b.tif": ("L2", "a_b")}
    (line,) = out.report.dropped
    assert "'a/b'" in line.subject
    assert "'a_b'" in line.why


def test_reports_are_joined_with_the_folders_of_their_files() -> None:
    lost, warning = Dropped("zones", 1, "no place"), Problem("turned", "map.yaml")
    reports = [(folder, replace(EMPTY, dropped=(lost,), warnings=(warning,))) for folder in ("", "L2/")]
    report = merge_reports(reports)
    assert report.dropped == (lost,)
    assert [one.file for one in report.warnings] == ["map.yaml", "L2/map.yaml"]


def test_held_files_outlive_the_cache(tmp_path: Path) -> None:
    cache = Cache(tmp_path, 1)
    first = cache.get_or_make("0" * 64, lambda: product("a.tif"))
    with cache.hold_files() as hold:
        open_map = hold(first)
        cache.get_or_make("1" * 64, lambda: product("b.tif"))
        assert cache.get("0" * 64) is None
        assert open_map.files[0].path.read_bytes() == b"a.tif"
        with pytest.raises(LostMap):
            hold(first)
    assert not open_map.files[0].path.exists()


def test_linked_files_are_stored_as_they_are(tmp_path: Path) -> None:
    cache = Cache(tmp_path, 2**20)
    (file,) = cache.get_or_make("0" * 64, lambda: product("a.tif")).files
    linked = ConvertedMap({"L2/a.tif": (file, file.media_type)}, None, EMPTY, {"L2/a.tif": ("L2", "a")})
    (cached_file,) = cache.get_or_make("1" * 64, lambda: linked).files
    assert (cached_file.size, cached_file.sha256, cached_file.place) == (file.size, file.sha256, ("L2", "a"))
    assert cached_file.path.read_bytes() == b"a.tif"
    (again,) = cache.get("1" * 64).files  # type: ignore[union-attr]
    assert again == cached_file


def test_default_part_of_each_level_is_selected(tmp_path: Path) -> None:
    cache = Cache(tmp_path, 2**20)
    files: dict[str, Any] = dict.fromkeys(("satellite.tif", "plan.tif", "L2/plan.tif"), (b"x", "image/tiff"))
    places = {"satellite.tif": ("ground", "satellite"), "plan.tif": ("ground", "plan"), "L2/plan.tif": ("L2", "plan")}
    cached_files = cache.get_or_make("0" * 64, lambda: ConvertedMap(files, None, EMPTY, places)).files
    spread = recipe("0", spread=Spread("ground"))
    assert [f.name for f in site.select(cached_files, Member(spread, only_default=True))] == [
        "satellite.tif",
        "L2/plan.tif",
    ]
    assert [f.name for f in site.select(cached_files, Member(spread, levels=frozenset({"L2"})))] == ["L2/plan.tif"]
    assert [f.name for f in site.select(cached_files, Member(spread, names=frozenset({"satellite"})))] == [
        "satellite.tif"
    ]


def test_file_of_a_map_of_several_parts_is_found_on_its_only_level(tmp_path: Path) -> None:
    cache = Cache(tmp_path, 2**20)
    files: dict[str, Any] = dict.fromkeys(("L2/a.tif", "L2/b.tif", "b.tif"), (b"x", "image/tiff"))
    cached_map = cache.get_or_make("0" * 64, lambda: ConvertedMap(files, None, EMPTY))
    spread = recipe("0", spread=Spread("ground"))
    assert select_file(spread, cached_map, "a.tif").name == "L2/a.tif"
    assert select_file(spread, cached_map, "b.tif").name == "b.tif"
    with pytest.raises(NotFound, match="its files: "):
        select_file(spread, cached_map, "c.tif")
    with pytest.raises(NotFound):
        select_file(replace(spread, spread=None), cached_map, "a.tif")


def tower(*kinds: str) -> Layers:
    """Build a grid on two levels, and on L2 a zone of each of these kinds."""
    cells = np.zeros((4, 6), np.uint8)
    grid = OccupancyGrid(cells, 0.5, (0.0, 0.0, 0.0), "trinary", 0.65, 0.196, False, {})
    parts: dict[PartKey, Any] = {PartKey("occupancy", level, "map"): grid for level in ("ground", "L2")}
    rows = [(f"z{n}", shapely.box(n, 0, n + 1, 1), {"kind": kind}) for n, kind in enumerate(kinds)]
    if rows:
        parts[PartKey("zones", "L2", "zones")] = features(rows, "local")
    return Layers(parts, None, (Level("ground"), Level("L2", 3.0)))


@pytest.mark.parametrize(
    ("asked", "derived", "expected"),
    [
        ({"level": "*", "grid": "*"}, True, {"map", "L2/map", "L2/keepout"}),
        ({"level": "*", "grid": "*"}, False, {"map", "L2/map"}),
        ({"level": "*"}, True, {"map", "L2/map"}),
        ({"grid": "*"}, True, {"map"}),
        ({"level": "*", "grid": "keepout"}, True, {"L2/keepout"}),
    ],
)
def test_layers_in_memory_give_the_whole_site(asked: dict[str, str], derived: bool, expected: set[str]) -> None:
    written_map = worker.from_layers(
        formats.get_format("occupancy_grid"), tower("keepout", "priority"), asked, derived=derived
    )
    assert {name.removesuffix(".pgm") for name in written_map.files if name.endswith(".pgm")} == expected
    drawn = [line for line in written_map.report.as_dict()["layers"] if line["information"] == "derived"]
    assert [(line["level"], line["name"]) for line in drawn] == [("L2", "keepout")] * ("L2/keepout" in expected)


def test_masks_need_no_map() -> None:
    fmt, layers = formats.get_format("occupancy_grid"), tower("keepout")
    zones = Layers({k: p for k, p in layers.parts.items() if k.layer == "zones"}, None, layers.levels)
    written_map = worker.from_layers(fmt, zones, {"level": "*", "grid": "keepout"}, derived=True)
    assert "keepout.pgm" in written_map.files, "the lowest level with zones is at the top"
    with pytest.raises(MissingLayer):
        worker.from_layers(fmt, zones, {"level": "*", "grid": "*"}, derived=True)


def test_whole_site_without_a_part_that_fits_is_not_found() -> None:
    fmt = formats.get_format("occupancy_grid")
    for options in ({"level": "*", "grid": "keepout"}, {"level": "L9", "grid": "*"}):
        with pytest.raises(NotFound):
            worker.from_layers(fmt, tower(), options, derived=True)
    with pytest.raises(NotFound, match="none can be derived"):
        worker.from_layers(fmt, tower("speed"), {"level": "*", "grid": "keepout"}, derived=True)


def test_formats_with_parts_declare_their_own_options() -> None:
    for fmt in formats.all_formats().values():
        if (parts := fmt.selection.parts) is not None:
            options = fmt.write_options()
            assert getattr(options, parts.name) is None, fmt.name
            assert getattr(options, parts.level) is None, fmt.name
            assert parts.layer in fmt.layers
            assert site.whole_site_options(fmt) == {parts.level: "*", parts.name: "*"}
    assert site.whole_site_options(formats.get_format("tmap2")) == {}
