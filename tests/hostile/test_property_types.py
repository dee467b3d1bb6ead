"""Canonical properties with values of any type, from edits or GeoJSON, make no writer fail.

``FLEETMAP_WORDS=500 pytest tests/hostile/test_property_types.py`` (a part of ``make fuzz``) runs longer than CI does.
"""

# ruff: noqa: E501 - lists of values

from __future__ import annotations

import os
import random
import traceback
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray

from app import formats, upload_reader
from app.convert.recipe import AvailableLayers, plan_chain
from app.convert.worker import write
from app.errors import FleetMapError
from app.limits import Limits
from app.model.features import NO_GEOMETRY, Features
from app.model.frame import Datum
from app.model.layers import Layer, Layers
from app.upload_reader import EnvironmentContext, UploadHints
from tests.hostile.corpus import sample_maps

HERE = Datum(50.0, 7.0, heading=30.0)
SMALLER = 0.1
"""Scale of the samples' streets, some hundred metres long: these tests need no large grids."""
VALUES: tuple[Any, ...] = (
    None, True, 0, -5, 2**63 - 1, 1.5, -1e300, 1e300, "", "x", "50", "nan", "\u202e\u200b", "a\nb", "\0", "]]>", "<&>", "-->", [], {},
    [None], [[]], [1, 2, 3], ["a"], [{}], [[1.0, 2.0]], {"a": 1}, {"": {}}, {"name": []}, {"type": []}, {"a:b c": "<"}, [["a", "b", "c"]],
)  # fmt: skip
SHAPES = (
    NO_GEOMETRY,
    shapely.Point(),
    shapely.Point(7.0002, 50.0002),
    shapely.Point(7.0002, 50.0002, 3.0),
    shapely.LineString([(7.0, 50.0), (7.0002, 50.0002)]),
    shapely.LineString([(7.0, 50.0), (7.0, 50.0)]),
    shapely.LinearRing([(7.0, 50.0), (7.0002, 50.0), (7.0002, 50.0002)]),
    shapely.Polygon([(7.0, 50.0), (7.0002, 50.0), (7.0002, 50.0002)]),
    shapely.Polygon(),
    shapely.MultiPoint([(7.0, 50.0), (7.0002, 50.0002)]),
    shapely.GeometryCollection([shapely.Point(7.0, 50.0), shapely.LineString([(7.0, 50.0), (7.0002, 50.0002)])]),
)
WORDS = (
    "kind", "name", "source", "target", "orientation", "action", "speed_limit", "width", "drawn_from", "oneway", "tags",
    "value", "expires", "pose", "size", "datum", "bounds", "attribution", "data", "style", "layer", "level", "part", "more",
    *formats.all_formats(),
)  # fmt: skip
ROUNDS = int(os.environ.get("FLEETMAP_WORDS", "2"))
FOR_EACH = 6


def mutated_value(value: Any, dice: random.Random) -> Any:
    """Change, remove or add one member of a value."""
    if isinstance(value, Mapping):
        out = dict(value)
        key = dice.choice([*out, dice.choice(WORDS)]) if out else dice.choice(WORDS)
        if key in out and dice.random() < 0.15:
            del out[key]
        elif key in out and dice.random() < 0.6:
            out[key] = mutated_value(out[key], dice)
        else:
            out[key] = dice.choice(VALUES)
        return out
    if isinstance(value, list) and value and dice.random() < 0.7:
        rows = list(value)
        at = dice.randrange(len(rows))
        rows[at] = mutated_value(rows[at], dice)
        return rows if dice.random() < 0.8 else rows[:at]
    return dice.choice(VALUES)


def mutated_part(part: Features, dice: random.Random) -> Features:
    """Change one feature or the document."""
    geometry, properties, local = part.geometry.copy(), list(part.properties), part.local.copy()
    document = part.document
    kind = dice.random()
    if kind < 0.2 or not len(part):
        document = mutated_value(document, dice)
    else:
        k = dice.randrange(len(part))
        if kind < 0.8:
            properties[k] = mutated_value(properties[k], dice)
        else:
            geometry[k] = dice.choice(SHAPES)
            local[k] = dice.random() < 0.5
    return Features(part.ids, geometry, tuple(properties), local, document)


def bases() -> Iterator[tuple[str, str, dict[str, bytes], Layer | None]]:
    """Yield name, format, files and layer of each sample, and once more as a network if it is a drawing."""
    drawn: tuple[Layer | None, ...] = (None, "topology")
    for format_name, files in sample_maps():
        for layer in drawn:
            if layer is None or formats.get_format(format_name).traits.is_drawing:
                yield f"{format_name}/{min(files)}{f' as {layer}' if layer else ''}", format_name, files, layer


def read_base(format_name: str, files: dict[str, bytes], layer: Layer | None) -> Layers:
    """Read a sample and scale it."""
    upload_bundle = upload_reader.read(
        upload_reader.unpack(files, Limits()),
        UploadHints(format_name, layer=layer),
        EnvironmentContext(HERE),
        Limits(),
    )
    layers = upload_bundle.layers(HERE)
    parts = {key: scaled_part(p) if isinstance(p, Features) else p for key, p in layers.parts.items()}
    return Layers(parts, layers.datum, layers.levels)


def scaled_part(part: Features) -> Features:
    """Scale all geometries in degrees near HERE about that point."""
    centre = np.array([HERE.longitude, HERE.latitude])

    def nearer(at: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.hstack([centre + (at[:, :2] - centre) * SMALLER, at[:, 2:]])

    geometry = part.geometry.copy()
    for flat, mask in ((False, ~shapely.has_z(geometry)), (True, shapely.has_z(geometry))):
        these = mask & ~part.local & (shapely.distance(geometry, shapely.Point(centre)) < 0.01)
        geometry[these] = shapely.transform(geometry[these], nearer, include_z=flat)
    return Features(part.ids, geometry, part.properties, part.local, part.document)


def writer_bugs(layers: Layers) -> list[tuple[str, BaseException]]:
    """Write every format, with derivations. Returns exceptions that are no errors for users."""
    out: list[tuple[str, BaseException]] = []
    stock = AvailableLayers(frozenset(layers.parts), layers.datum is not None)
    for name, fmt in formats.all_formats().items():
        try:
            written = write(fmt, layers, {}, plan_chain(fmt, stock, fmt.write_options()))
        except FleetMapError as error:
            assert error.detail
        except Exception as error:  # noqa: BLE001  this test looks for any exception
            out.append((name, error))
        else:
            assert all(isinstance(data, bytes) for data in written.files.values())
    return out


@pytest.mark.parametrize(("format_name", "files", "layer"), [pytest.param(*base, id=name) for name, *base in bases()])
def test_property_values_of_any_type_break_no_writer(
    format_name: str, files: dict[str, bytes], layer: Layer | None
) -> None:
    layers = read_base(format_name, files, layer)
    vector = [key for key, part in layers.parts.items() if isinstance(part, Features)]
    if not vector:
        return
    failures: dict[str, str] = {}
    for seed in range(ROUNDS):
        dice = random.Random(seed)
        parts = dict(layers.parts)
        for _ in range(dice.randint(1, FOR_EACH)):
            key = dice.choice(vector)
            parts[key] = mutated_part(parts[key], dice)  # type: ignore[arg-type]
        for name, error in writer_bugs(Layers(parts, layers.datum, layers.levels)):
            place = traceback.extract_tb(error.__traceback__)[-1]
            failures.setdefault(f"{name}: {type(error).__name__} {place.filename}:{place.lineno}", f"{error}"[:200])
    assert not failures, "\n".join(f"{place}  {text}" for place, text in sorted(failures.items()))
