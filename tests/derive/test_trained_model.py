"""A model that is trained here on made-up sites, and tried on others through the server: pixels by colour and texture.

The pictures are the generators', with the light, haze and noise of a photograph; what stands where is known from the
generated objects and the generators' flat colours. The network is a fixed bank of local means and deviations at three
scales, a layer of random units, and a layer that ridge regression trains in closed form.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import shapely
import shapely.affinity
import shapely.geometry
from numpy.typing import NDArray

from app import generate
from app.derive import DerivationNotes, _onnx
from app.derive.imagery_to_objects import Parameters, imagery_to_objects
from app.errors import CannotConvert
from app.model.features import Features
from app.model.imagery import GeoImage
from app.model.layers import Layers, PartKey
from tests.api.conftest import running, settings_for
from tests.derive.pictures import local

onnx = pytest.importorskip("onnx")
onnxruntime = pytest.importorskip("onnxruntime")

CLASSES = ("field", "tree", "building", "road")
SIZE, TILE, UNITS = 0.25, 64, 160
SCALES = (3, 7, 15)
TRAINING = (("town", 1), ("orchard", 1), ("town", 2), ("orchard", 2), ("town", 5))
HELD_OUT = (("town", 11), ("orchard", 12))
SITES = {"town": {"width": 70.0, "depth": 60.0}, "orchard": {"rows": 5, "row_length": 40.0}}


@dataclass(frozen=True)
class Picture:
    """rgb: uint8 [h, w, 3]; truth: index into CLASSES, [h, w]."""

    rgb: NDArray[np.uint8]
    truth: NDArray[np.int64]


def photograph(name: str, seed: int) -> Picture:
    """Return a generated site as an aerial photograph of 0.25 m, with the class of each pixel."""
    site = generate.run(name, seed, SITES[name], Layers({}), DerivationNotes())
    image = next(part for key, part in site.parts.items() if key.layer == "imagery")
    assert isinstance(image, GeoImage)
    size, _, left, _, _, top = image.transform
    flat = image.pixels[..., :3].astype(np.float32)
    green = (flat[..., 1] > flat[..., 0] + 8) & (flat[..., 1] > flat[..., 2] + 8)
    truth = np.where(green, 0, 3).astype(np.uint8)
    for part in site.parts.values():
        for feature in part if isinstance(part, Features) else ():
            kind = feature.properties.get("kind")
            if kind in ("building", "tree") and feature.geometry is not None:
                shape = feature.geometry
                if shape.geom_type == "Point":
                    shape = shape.buffer(float(feature.properties.get("radius", 0.9)))
                ring = (shapely.get_coordinates(shape) - [left, top]) / [size, -size]
                cv2.fillPoly(truth, [ring.round().astype(np.int32)], CLASSES.index(kind))
    step = round(SIZE / size)
    height, width = (n // step * step for n in truth.shape)
    small = cv2.resize(flat[:height, :width], None, fx=1 / step, fy=1 / step, interpolation=cv2.INTER_AREA)
    rng = np.random.default_rng(seed)
    light = cv2.resize(
        rng.uniform(0.75, 1.15, (4, 4)).astype(np.float32), small.shape[1::-1], interpolation=cv2.INTER_CUBIC
    )
    haze = rng.uniform(0, 25, 3)
    classes = truth[step // 2 : height : step, step // 2 : width : step].astype(np.int64)
    # crowns are rough, fields less, roofs and roads are smooth
    rough = np.array([9.0, 22.0, 4.0, 5.0])[classes][..., None]
    seen = small * light[..., None] + haze + rng.normal(0.0, 1.0, small.shape) * rough
    return Picture(np.clip(seen, 0, 255).astype(np.uint8), classes)


def graph(weights: NDArray[np.float32] | None, *, nan: bool = False) -> bytes:
    """Return the network as ONNX: logits [1, classes, h, w], or without weights the units [1, UNITS + 1, h, w]."""
    make, dtype = onnx.helper, onnx.TensorProto.FLOAT
    rng = np.random.default_rng(0)
    constants, nodes = [], [make.make_node("Mul", ["image", "image"], ["square"])]

    def constant(name: str, value: Any) -> str:
        constants.append(onnx.numpy_helper.from_array(np.asarray(value, np.float32), name))
        return name

    features = ["image"]
    for side in SCALES:
        pool = {"kernel_shape": [side] * 2, "pads": [side // 2] * 4, "count_include_pad": 0}
        nodes += [
            make.make_node("AveragePool", ["image"], [f"mean{side}"], **pool),
            make.make_node("AveragePool", ["square"], [f"mean_square{side}"], **pool),
            make.make_node("Mul", [f"mean{side}", f"mean{side}"], [f"square_mean{side}"]),
            make.make_node("Sub", [f"mean_square{side}", f"square_mean{side}"], [f"variance{side}"]),
            make.make_node("Abs", [f"variance{side}"], [f"positive{side}"]),
            make.make_node("Sqrt", [f"positive{side}"], [f"deviation{side}"]),
        ]
        features += [f"mean{side}", f"deviation{side}"]
    nodes.append(make.make_node("Concat", features, ["features"], axis=1))
    count = 3 * len(features)
    first = constant("first", rng.normal(0, 1.2, (UNITS, count, 1, 1)))
    bias = constant("bias", rng.uniform(-1.5, 1.5, UNITS))
    nodes += [make.make_node("Conv", ["features", first, bias], ["sums"]), make.make_node("Relu", ["sums"], ["units"])]
    outputs = [make.make_tensor_value_info("units", dtype, [1, UNITS, TILE, TILE])]
    if weights is not None:
        last = constant("last", (weights[:-1].T * np.nan if nan else weights[:-1].T)[:, :, None, None])
        nodes.append(make.make_node("Conv", ["units", last, constant("offset", weights[-1])], ["logits"]))
        outputs = [make.make_tensor_value_info("logits", dtype, [1, weights.shape[1], TILE, TILE])]
    inputs = [make.make_tensor_value_info("image", dtype, [1, 3, TILE, TILE])]
    built = make.make_model(
        make.make_graph(nodes, "pixels", inputs, outputs, constants),
        opset_imports=[make.make_opsetid("", 13)],
        ir_version=8,
    )
    return bytes(built.SerializeToString())


@pytest.fixture(scope="module")
def weights() -> NDArray[np.float32]:
    """Train the last layer by ridge regression on the training sites, each class with the same weight."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(graph(None), options, providers=["CPUExecutionProvider"])
    rng = np.random.default_rng(1)
    rows, labels = [], []
    for name, seed in TRAINING:
        picture = photograph(name, seed)
        for _ in range(20):
            row, column = (int(rng.integers(0, n - TILE)) for n in picture.truth.shape)
            at = (slice(row, row + TILE), slice(column, column + TILE))
            tile = (picture.rgb[at].astype(np.float32) / 255 - 0.5) / 0.25
            (units,) = session.run(None, {"image": tile.transpose(2, 0, 1)[None]})
            chosen = rng.integers(0, TILE * TILE, 200)
            rows.append(units[0].reshape(UNITS, -1).T[chosen])
            labels.append(picture.truth[at].ravel()[chosen])
    x, label = np.concatenate(rows), np.concatenate(labels)
    x = np.column_stack([x, np.ones(len(x))]).astype(np.float64)
    share = np.bincount(label, minlength=len(CLASSES)) / len(label)
    weight = (1 / np.maximum(share, 1e-3))[label][:, None]
    target = np.eye(len(CLASSES))[label]
    solved = np.linalg.solve(x.T @ (x * weight) + 1e-2 * len(x) * np.eye(UNITS + 1), x.T @ (target * weight))
    return np.asarray(6.0 * solved, np.float32)  # from shares to logits that are as sure


def install(folder: Path, data: bytes, classes: tuple[str | None, ...] = CLASSES) -> None:
    (folder / "land.onnx").write_bytes(data)
    (folder / "land.json").write_text(json.dumps({"classes": classes, "mean": [0.5] * 3, "std": [0.25] * 3}))


def accuracy(features: list[tuple[str, Any]], truth: NDArray[np.int64]) -> float:
    """Return the share of pixels of which the class is right; paths are roads."""
    out = np.full(truth.shape, -1, np.int64)
    order = ("field", "vegetation", "path", "road", "tree", "building")
    for kind, shape in sorted((f for f in features if f[0] in order), key=lambda f: order.index(f[0])):
        mask = np.zeros(truth.shape, np.uint8)
        for piece in getattr(shape, "geoms", [shape]):
            if piece.geom_type != "Polygon":
                continue
            rings = [
                (np.column_stack([c[:, 0], len(truth) * SIZE - c[:, 1]]) / SIZE).round().astype(np.int32)
                for c in (np.asarray(ring.coords) for ring in (piece.exterior, *piece.interiors))
            ]
            cv2.fillPoly(mask, rings, 1)
        word = {"path": "road", "vegetation": "field"}.get(kind, kind)
        out[mask > 0] = CLASSES.index(word)
    return float((out == truth).mean())


def objects(picture: Picture, notes: DerivationNotes | None = None, **options: Any) -> list[tuple[str, Any]]:
    layers = Layers({PartKey("imagery", "ground", "satellite"): local(picture.rgb, SIZE)})
    derived = imagery_to_objects(layers, Parameters(resolution=SIZE, **options), notes or DerivationNotes())
    (part,) = derived.parts.values()
    assert isinstance(part, Features)
    return [(str(f.properties["kind"]), f.geometry) for f in part if f.geometry is not None]


def test_trained_model_beats_colours_on_sites_that_it_never_saw(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, weights: NDArray[np.float32]
) -> None:
    monkeypatch.setenv(_onnx.FOLDER, str(tmp_path))
    install(tmp_path, graph(weights))
    for name, seed in HELD_OUT:
        picture = photograph(name, seed)
        by_model = accuracy(objects(picture, segmentation="model", model="land", confidence=0.3), picture.truth)
        by_colour = accuracy(objects(picture, segmentation="colour"), picture.truth)
        assert by_model > 0.85, name
        assert by_model > by_colour + 0.1, name


def test_trained_model_works_through_server(tmp_path: Path, weights: NDArray[np.float32]) -> None:
    """From settings and upload to stored objects and their report; models that answer nonsense store nothing."""
    folder = tmp_path / "models"
    folder.mkdir()
    install(folder, graph(weights))
    (folder / "empty.onnx").write_bytes(graph(weights, nan=True))
    (folder / "huge.onnx").write_bytes(huge())
    for name in ("empty", "huge"):
        (folder / f"{name}.json").write_text(json.dumps(CLASSES))
    picture = photograph(*HELD_OUT[0])
    ok, png = cv2.imencode(".png", picture.rgb[..., ::-1])
    assert ok
    with running(settings_for(tmp_path / "data", models_dir=folder)) as api:
        api.post("environments", {"name": "quarter"})
        api.upload("quarter", {"quarter.png": png.tobytes()}, format="satellite", metres_per_pixel=str(SIZE))
        path = "environments/quarter/derivations"

        def body(model: str) -> dict[str, Any]:
            parameters = {"segmentation": "model", "model": model, "resolution": SIZE, "confidence": 0.3}
            return {"method": "imagery_to_objects", "parameters": parameters}

        for model, reason in (("empty", "not numbers (NaN in logits)"), ("huge", "memory")):
            assert reason in api.problem("POST", path, 422, json=body(model))["detail"]
        assert api.get("environments/quarter/versions/latest").json()["version"] == 1, "nothing is stored"
        version = api.post(path, body("land")).json()
        assert version["information"]["objects"] == "derived"
        features = api.get("environments/quarter/versions/latest/layers/objects?crs=local").json()["features"]
        regions = [f["properties"] for f in features if not f["properties"].get("middle_line")]
        assert {properties["model"] for properties in regions} == {"land"}
        assert all(0.3 <= properties["confidence"] <= 1.0 for properties in regions)
        local_shapes = [
            (f["properties"]["kind"], shapely.geometry.shape(f["geometry"] or f["place"])) for f in features
        ]
        # in the picture's frame, of which the lower left corner is the origin
        x, y = np.min([shapely.bounds(shape)[:2] for _, shape in local_shapes], axis=0)
        moved = [(kind, shapely.affinity.translate(shape, -x, -y)) for kind, shape in local_shapes]
        assert accuracy(moved, picture.truth) > 0.85
        report = api.get("environments/quarter/versions/latest/reports/geojson").json()
        steps = [step for row in report["layers"] for step in row.get("steps", ())]
        assert "land" in [step["parameters"].get("model") for step in steps]


def huge() -> bytes:
    """Return a model that asks for 20 GB: zeros as an intermediate result, added up."""
    make, dtype = onnx.helper, onnx.TensorProto.FLOAT
    shape = onnx.numpy_helper.from_array(np.array([20 * 2**30 // 4], np.int64), "shape")
    one = onnx.numpy_helper.from_array(np.array([1], np.int64), "one")
    nodes = [
        make.make_node("ReduceMax", ["image"], ["most"], axes=[1, 2, 3], keepdims=0),
        make.make_node("Expand", ["most", "shape"], ["many"]),
        make.make_node("ReduceMax", ["many"], ["again"], keepdims=0),
        make.make_node("Reshape", ["again", "one"], ["flat"]),
        make.make_node("Add", ["image", "flat"], ["sum"]),
        make.make_node("Concat", ["sum", "image"], ["logits"], axis=1),
    ]
    inputs = [make.make_tensor_value_info("image", dtype, [1, 3, TILE, TILE])]
    outputs = [make.make_tensor_value_info("logits", dtype, [1, 6, TILE, TILE])]
    built = make.make_model(
        make.make_graph(nodes, "huge", inputs, outputs, [shape, one]),
        opset_imports=[make.make_opsetid("", 13)],
        ir_version=8,
    )
    return bytes(built.SerializeToString())


def test_model_of_one_class_warns_and_wrong_shape_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, weights: NDArray[np.float32]
) -> None:
    monkeypatch.setenv(_onnx.FOLDER, str(tmp_path))
    picture = photograph(*HELD_OUT[1])
    only = np.zeros_like(weights)
    only[-1, 2] = 9.0
    install(tmp_path, graph(only))
    notes = DerivationNotes()
    assert {kind for kind, _ in objects(picture, notes, segmentation="model", model="land")} == {"building"}
    assert any("puts every pixel into one class (building)" in w.problem for w in notes.as_warnings())
    install(tmp_path, graph(weights), ("field", "tree", None))
    with pytest.raises(CannotConvert, match=r"does not have 3 classes: it returns \(1, 4, 64, 64\)"):
        objects(picture, segmentation="model", model="land")
