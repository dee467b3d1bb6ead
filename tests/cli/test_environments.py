"""The real environment_template folders, each with one command: into a server, and converted without one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.cli.conftest import Fleetmap

Same = Callable[[str, dict[str, bytes], dict[str, bytes]], list[str]]


@dataclass(frozen=True)
class Wanted:
    """A map to ask for, and the files below ``config`` that tell it."""

    format: str
    files: tuple[str, ...]
    option: str | None = None


DATUM = Wanted("datum", ("location/datum_autogen.yaml",))
NETWORK = Wanted("tmap2", ("topological/network.tmap2.yaml",))
MAP = Wanted("occupancy_grid", ("metric/map/map.yaml", "metric/map/map.png"), "grid=map")

FOLDERS: dict[str, tuple[Wanted, ...]] = {
    "indoor-agilex-limo-track": (
        Wanted(
            "occupancy_grid",
            ("metric/potholes_20mm/map.yaml", "metric/potholes_20mm/map.pgm"),
            "grid=potholes_20mm",
        ),
        Wanted(
            "occupancy_grid",
            ("metric/potholes_50mm/map.yaml", "metric/potholes_50mm/map.pgm"),
            "grid=potholes_50mm",
        ),
    ),
    "riseholme_park_farm_general_east_pathway": (
        DATUM,
        Wanted("tmap2", ("topological/network_autogen.tmap2.yaml",)),
        MAP,
    ),
    "riseholme_park_farm_vineyard": (DATUM, NETWORK, MAP),
    "riseholme_park_farm_strawberry_polytunnels": (
        Wanted("datum", ("location/datum.yaml",)),
        NETWORK,
        MAP,
        Wanted("occupancy_grid", ("metric/bigmap/map.yaml", "metric/bigmap/big-map.png"), "grid=bigmap"),
        Wanted("occupancy_grid", ("metric/nogo/nogo_map.yaml", "metric/nogo/nogo_map.png"), "grid=nogo"),
    ),
}


def template(shared: Path, name: str) -> Path:
    return shared / "data" / "environment_template" / name


def read(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def originals(folder: Path, expected: Wanted) -> dict[str, bytes]:
    return {Path(name).name: (folder / "config" / name).read_bytes() for name in expected.files}


@pytest.mark.parametrize("name", FOLDERS)
def test_folder_import_and_export_keep_its_maps(
    name: str, shared: Path, fleetmap: Fleetmap, same: Same, tmp_path: Path
) -> None:
    folder = template(shared, name)
    result = fleetmap("import", folder, "--json")
    assert result.status == 0, result.err
    version = result.json
    assert version["environment"] == name
    assert version["version"] == 1
    sources = {source["name"] for source in version["sources"]}
    assert sources == set(read(folder)), "every file is kept as a source"
    used = {source["name"] for source in version["sources"] if source["used"]}
    for expected in FOLDERS[name]:
        assert {f"config/{file}" for file in expected.files} <= used
        out = tmp_path / f"{expected.format}-{expected.option}"
        options = ["--option", expected.option] if expected.option else []
        got = fleetmap("export", name, expected.format, "-o", f"{out}/", *options)
        assert got.status == 0, got.err
        assert same(expected.format, originals(folder, expected), read(out)) == []
    again = fleetmap("import", folder)
    assert again.status == 0, again.err
    assert f"{name}: no changes, still version 1" in again.out


@pytest.mark.parametrize("name", FOLDERS)
def test_folder_converts_without_server(name: str, shared: Path, offline: Fleetmap, same: Same, tmp_path: Path) -> None:
    folder = template(shared, name)
    for expected in FOLDERS[name]:
        out = tmp_path / f"{expected.format}-{expected.option}"
        options = ["--option", expected.option] if expected.option else []
        result = offline("convert", folder, "--to", expected.format, "-o", f"{out}/", *options)
        assert result.status == 0, result.err
        assert same(expected.format, originals(folder, expected), read(out)) == []


def test_network_converts_to_another_format_and_back_offline(
    shared: Path, offline: Fleetmap, same: Same, tmp_path: Path
) -> None:
    original = template(shared, "riseholme_park_farm_vineyard") / "config/topological/network.tmap2.yaml"
    datum = template(shared, "riseholme_park_farm_vineyard") / "config/location/datum_autogen.yaml"
    for middle in ("kml", "geojson"):
        drawn, back = tmp_path / f"map.{middle}", tmp_path / f"{middle}.tmap2.yaml"
        result = offline("convert", original, datum, "--to", middle, "-o", drawn)
        assert result.status == 0, result.err
        result = offline("convert", drawn, datum, "--to", "tmap2", "-o", back)
        assert result.status == 0, result.err
        assert (
            same("tmap2", {"network.tmap2.yaml": original.read_bytes()}, {"network.tmap2.yaml": back.read_bytes()})
            == []
        )
