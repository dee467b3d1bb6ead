"""Requirements on every format, tested with its registration and samples: new formats are included automatically."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import pytest
import shapely

from app import formats
from app.convert.files import offline
from app.convert.worker import from_layers
from app.errors import BadUpload, CannotConvert, Invalid, MissingLayer
from app.formats import WriteContext
from app.limits import Limits
from app.model.features import features
from app.model.frame import Datum
from app.model.layers import LAYERS, Layers, PartKey
from app.store import parts
from app.store.tree import ChunkStage
from app.upload_reader import EnvironmentContext, UploadHints, read, unpack

SAMPLES = Path(__file__).resolve().parents[1] / "samples"
HERE = Datum(53.2686, -0.5245, heading=12.5)
LIMITS = Limits()


def cases() -> list[tuple[str, str, dict[str, bytes]]]:
    """Yield (format, case, files): each folder below samples/<format>, and each file outside of one, is a map."""
    out = []
    for folder in sorted(SAMPLES.iterdir()) if SAMPLES.is_dir() else []:
        for item in sorted(folder.iterdir()):
            if item.is_dir():
                files = {p.relative_to(item).as_posix(): p.read_bytes() for p in sorted(item.rglob("*")) if p.is_file()}
                files = {n: d for n, d in files.items() if not n.endswith("facts.json")}
                out.append((folder.name, f"{folder.name}/{item.name}", files))
            elif not item.name.endswith("facts.json"):
                out.append((folder.name, f"{folder.name}/{item.name}", {item.name: item.read_bytes()}))
    return out


CASES = [pytest.param(f, files, id=case) for f, case, files in cases()]
NAMES = sorted(formats.all_formats())

READ_ONLY = {"dxf", "gml", "shapefile"}
"""Formats that are not served, as CHANGELOG.md says."""


def layers_of(name: str, files: dict[str, bytes], hints: UploadHints | None = None) -> Layers:
    bundle = read(unpack(files, LIMITS), hints or UploadHints(name), EnvironmentContext(), LIMITS)
    return bundle.layers(HERE)


@pytest.mark.parametrize("name", NAMES)
def test_format_declares_required_attributes(name: str) -> None:
    fmt = formats.get_format(name)
    assert fmt.title
    assert fmt.layers <= set(LAYERS)
    assert fmt.files
    assert fmt.read is None or fmt.extensions, "a reader needs extensions, so that a named format finds its file"
    assert fmt.write is None or fmt.needs.one_of, "a writer says what it needs"


@pytest.mark.parametrize("name", NAMES)
def test_format_has_sample(name: str) -> None:
    assert any(f == name for f, _, _ in cases()), f"add a sample of our own to tests/samples/{name}"


@pytest.mark.parametrize(("name", "files"), CASES)
def test_detect_identifies_format_by_content(name: str, files: dict[str, bytes]) -> None:
    groups, _ = formats.group(files)
    assert name in {g.format.name for g in groups}


@pytest.mark.parametrize(("name", "files"), CASES)
def test_written_map_reads_back_equal_and_writes_same_bytes(name: str, files: dict[str, bytes]) -> None:
    to = name if formats.get_format(name).write else "geojson"
    first = offline(files, to, hints=UploadHints(name), datum=HERE).files
    second = offline(first, to, hints=UploadHints(to), datum=HERE).files
    assert first == second
    assert offline(files, to, hints=UploadHints(name), datum=HERE).files == first, "the same input gives the same bytes"


def mutations(data: bytes, seed: int) -> list[bytes]:
    """Yield truncated and flipped files, repeated content, other types and huge numbers."""
    dice = random.Random(seed)
    out = [b"", data[:1], data[: len(data) // 2], data[:-1], data + data, data[::-1]]
    out += [data[: dice.randrange(len(data))] for _ in range(8)]
    for _ in range(16):
        flipped = bytearray(data)
        for _ in range(dice.choice([1, 1, 4])):
            flipped[dice.randrange(len(flipped))] = dice.randrange(256)
        out.append(bytes(flipped))
    digits = [k for k, c in enumerate(data) if 48 <= c <= 57]
    for text in (b"nan", b"inf", b"-1e999", b"9" * 5000, b"1" * 30, b"-1", b"0", b"true", b"null", b"[]", b"{}", b"''"):
        if digits:
            k = dice.choice(digits)
            end = k
            while end < len(data) and chr(data[end]) in "0123456789.":
                end += 1
            out.append(data[:k] + text + data[end:])
    a, b = sorted(dice.sample(range(len(data) + 1), 2))
    out.append(data[:a] + data[b:])
    out.append(data[:b] + data[a:b] + data[b:])
    return out


@pytest.mark.parametrize(("name", "files"), CASES)
def test_damaged_file_is_read_or_refused_with_file_and_reason(name: str, files: dict[str, bytes]) -> None:
    refused = 0
    for victim in sorted(files):
        for k, damaged in enumerate(mutations(files[victim], seed=len(victim))):
            try:
                layers_of(name, {**files, victim: damaged})
            except (BadUpload, Invalid) as error:
                refused += 1
                assert error.detail, f"mutation {k} of {victim} is refused without a reason"
                assert all(p.problem for p in error.problems)
                if isinstance(error, BadUpload):
                    assert error.problems, f"mutation {k} of {victim} is refused without a place"
                    assert all(p.file for p in error.problems), f"mutation {k} of {victim}: which file?"
    assert refused, "no damage at all is noticed"


@pytest.mark.parametrize("name", NAMES)
def test_plan_without_layers_raises(name: str) -> None:
    from app.convert.recipe import AvailableLayers, plan_chain

    fmt = formats.get_format(name)
    assert fmt.write is not None or name in READ_ONLY, f"{name} is not served: say so in CHANGELOG.md first"
    if fmt.write is None:
        with pytest.raises(Invalid, match="can be read but not exported"):
            formats.write(fmt, Layers(), WriteContext())
        return
    with pytest.raises((MissingLayer, CannotConvert)) as caught:
        plan_chain(fmt, AvailableLayers(frozenset(), False), fmt.write_options())
    assert "supply" in caught.value.detail or "needs" in caught.value.detail


FILE_NAME_IS_CONTENT = {"gazebo": "worlds are chosen by their file", "rmf_nav_graph": "a graph's file has its number"}
"""Formats whose parts keep the name of a file; formats of grids, voxels and images name their part by it instead."""


@pytest.mark.parametrize(("name", "files"), [case for case in CASES if case.values[0] not in FILE_NAME_IS_CONTENT])
def test_equal_files_with_other_names_give_equal_layers(name: str, files: dict[str, bytes]) -> None:
    def hashes(named: dict[str, bytes]) -> dict[PartKey, bytes]:
        encoded_parts = {
            k: parts.compose(ChunkStage(lambda _: {}), p, None, "") for k, p in layers_of(name, named).parts.items()
        }
        return {key: part.hash for key, part in encoded_parts.items() if part is not None}

    before = hashes(files)
    assert hashes({f"another folder/{n}": data for n, data in files.items()}) == before
    for group in formats.group(files, name)[0]:
        folder, slash, base = group.main.rpartition("/")
        renamed = f"{folder}{slash}other{base[base.index('.') :]}"
        if len(files) == 1:
            after = hashes({renamed: files[group.main]})
            assert after == before or after.keys() != before.keys()


@pytest.mark.parametrize("name", NAMES)
def test_format_with_title_declares_has_title(name: str) -> None:
    """Otherwise a map of one environment would be returned for another one of equal content."""
    fmt = formats.get_format(name)
    rows: list[Any] = [("a", shapely.Point(0, 0), {"kind": "node"}), ("b", shapely.Point(9, 0), {"kind": "node"})]
    rows.append(("e", shapely.LineString([(0, 0), (9, 0)]), {"kind": "edge", "source": "a", "target": "b"}))
    wall = ("wall", shapely.box(3, 3, 4, 4), {"kind": "wall", "height": 2.0})
    if fmt.write is None:
        assert not fmt.traits.has_title
        return
    layers = Layers({PartKey("topology", name="network"): features(rows, "local"),
                     PartKey("objects", name="generated"): features([wall], "local")}, HERE)  # fmt: skip
    try:
        one, two = (from_layers(fmt, layers, {}, derived=True, title=title).files for title in ("one", "two"))
    except CannotConvert:
        pytest.skip("it needs other layers, and none of them has a name")
    assert (one != two) == (fmt.traits.has_title or fmt.traits.is_container)
