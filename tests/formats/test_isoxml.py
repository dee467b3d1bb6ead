"""ISOXML: facts of the sample, fences among obstacles, and damaged files."""

from __future__ import annotations

from pathlib import Path

import pytest

from app import formats
from app.errors import UnreadableFile
from app.formats import FileGroup, ReadContext
from app.limits import Limits
from app.model.features import Features
from app.model.layers import SITE, PartKey
from app.upload_reader import EnvironmentContext, UploadHints
from app.upload_reader import read as read_upload

FILES = {p.name: p.read_bytes() for p in (Path(__file__).parents[1] / "samples" / "isoxml" / "task").iterdir()}
MAIN = "TASKDATA.XML"


def objects(files: dict[str, bytes], context: ReadContext | None = None) -> Features:
    group = FileGroup(formats.get_format("isoxml"), MAIN, files)
    part = formats.read(group, context or ReadContext()).parts[PartKey("objects", "ground", "isoxml")]
    assert isinstance(part, Features)
    return part


def test_sample_matches_facts() -> None:
    part = {f.id: f for f in objects(FILES)}
    assert set(part) == {"PFD1/PLN1", "PLN9", "PFD1/PNT3", "GPN1", "PFD2/LSG5"}
    boundary = part["PFD1/PLN1"]
    assert boundary.geometry.exterior.bounds == (-0.525, 53.268, -0.523, 53.269), "longitude, latitude"
    assert len(boundary.geometry.interiors) == 1
    assert dict(boundary.properties) == {
        "kind": "region", "name": 'Oat "Größe" boundary', "isoxml": {"field": 'Oat "Größe"', "type": "boundary"},
    }  # fmt: skip
    assert part["PLN9"].properties["isoxml"]["type"] == "obstacle"
    assert list(part["PFD1/PNT3"].geometry.coords) == [(-0.524, 53.268, 31.5)]
    assert part["GPN1"].properties["isoxml"] == {"field": 'Oat "Größe"', "type": "guidance line", "group": "Rows"}
    assert list(part["GPN1"].geometry.coords) == [(-0.5249, 53.2681), (-0.5249, 53.2689)]
    assert part["PFD2/LSG5"].properties["isoxml"] == {"field": "Hay", "type": "fence"}


def test_boundary_becomes_the_fence_beside_obstacles() -> None:
    bundle = read_upload(FILES, UploadHints(layer="location"), EnvironmentContext(), Limits())
    fence = bundle.parts[PartKey("location", "ground", SITE)]
    assert isinstance(fence, Features)
    assert [p["kind"] for p in fence.properties] == ["fence"]
    assert fence.ids == ("PFD1/PLN1",)


def test_missing_file_of_a_field_is_reported() -> None:
    context = ReadContext()
    assert len(objects({MAIN: FILES[MAIN]}, context)) == 4
    assert [w.problem for w in context.warnings] == ["PFD00002 is not in the upload"]


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ('C="53.268"', 'C="91"', "must be a number within ±90"),
        ('D="-0.525"', 'D="nan"', "must be a number within ±180"),
        ('D="-0.525"', "", "must be a number within ±180"),
        ('E="31500"', 'E="1e99"', "must be a number"),
        ("<ISO", '<!DOCTYPE a [<!ENTITY b "c">]><ISO', "DOCTYPE"),
    ],
)
def test_wrong_values_are_refused(old: str, new: str, reason: str) -> None:
    data = FILES[MAIN].decode().replace(old, new, 1).encode()
    with pytest.raises(UnreadableFile, match=reason) as caught:
        objects({MAIN: data})
    assert caught.value.problems[0].line
