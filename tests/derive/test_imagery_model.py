"""Models of the YOLO family: tiny ONNX models with known outputs."""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import shapely

from app.derive import DerivationNotes, _onnx
from app.derive.imagery_to_objects import Parameters, imagery_to_objects
from app.derive.imagery_to_occupancy import Parameters as GridParameters
from app.derive.imagery_to_occupancy import imagery_to_occupancy
from app.errors import CannotConvert, Invalid, NotFound
from app.model.features import Features
from app.model.grid import FREE, OCCUPIED, OccupancyGrid
from app.model.layers import Layers, PartKey
from tests.api.conftest import running, settings_for
from tests.derive.pictures import local

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

SIDE = 64


def model(rows: Any, prototypes: Any = None, *, side: int | None = SIDE, names: str = "") -> bytes:
    """A model that gives these rows, scores times the largest red value of the picture, and these prototypes.

    rows: [4 + classes + coefficients, n] as YOLOv8 gives it. A tile without red has no detection.
    """
    make, dtype = onnx.helper, onnx.TensorProto.FLOAT
    table = np.asarray(rows, np.float32)[None]
    keep = np.zeros_like(table)
    keep[:, :4] = 1
    if prototypes is not None:
        keep[:, -len(prototypes) :] = 1
    constants = [
        onnx.numpy_helper.from_array(table, "table"),
        onnx.numpy_helper.from_array(keep * table, "always"),
        onnx.numpy_helper.from_array((1 - keep) * table, "scores"),
        onnx.numpy_helper.from_array(np.array([0], np.int64), "first"),
        onnx.numpy_helper.from_array(np.array([1], np.int64), "second"),
        onnx.numpy_helper.from_array(np.array([1], np.int64), "channel"),
    ]
    nodes = [
        make.make_node("Slice", ["images", "first", "second", "channel"], ["red"]),
        make.make_node("ReduceMax", ["red"], ["most"], keepdims=0),
        make.make_node("Mul", ["scores", "most"], ["lit"]),
        make.make_node("Add", ["always", "lit"], ["output0"]),
    ]
    outputs = [make.make_tensor_value_info("output0", dtype, list(table.shape))]
    if prototypes is not None:
        shape = [1, *np.shape(prototypes)]
        constants.append(onnx.numpy_helper.from_array(np.asarray(prototypes, np.float32)[None], "masks"))
        nodes.append(make.make_node("Identity", ["masks"], ["output1"]))
        outputs.append(make.make_tensor_value_info("output1", dtype, shape))
    size: Any = side if side else "side"
    inputs = [make.make_tensor_value_info("images", dtype, [1, 3, size, size])]
    graph = make.make_graph(nodes, "tiny", inputs, outputs, constants)
    onnx_model = make.make_model(graph, opset_imports=[make.make_opsetid("", 13)], ir_version=8)
    if names:
        onnx_model.metadata_props.add(key="names", value=names)
    return bytes(onnx_model.SerializeToString())


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(_onnx.FOLDER, str(tmp_path))
    return tmp_path


def put(folder: Path, data: bytes, classes: Any = ("building", "tree", None)) -> None:
    (folder / "tiny.onnx").write_bytes(data)
    if classes is not None:
        (folder / "tiny.json").write_text(json.dumps(list(classes)))


def content(width: int = SIDE, height: int = SIDE, red: Any = None) -> Layers:
    """Return an image with pixels of 1 m, red in the window ``red``, by default everywhere."""
    pixels = np.zeros((height, width, 3), np.uint8)
    pixels[..., 0] = 255 if red is None else 0
    if red is not None:
        pixels[red] = 255
    return Layers({PartKey("imagery", "ground", "satellite"): local(pixels, 1.0)})


def detect(layers: Layers, notes: DerivationNotes | None = None, **more: Any) -> dict[str, Any]:
    options = Parameters(segmentation="model", model="tiny", resolution=1.0, **more)
    derived_layers = imagery_to_objects(layers, options, notes if notes is not None else DerivationNotes())
    (part,) = derived_layers.parts.values()
    assert isinstance(part, Features)
    return {f.properties["kind"]: (f.geometry, f.properties["confidence"]) for f in part}


# x, y, width, height, then the chances of building, tree and a class without a kind
HOUSE = [20, 20, 20, 10, 0.9, 0.1, 0.0]
TWICE = [21, 20, 20, 10, 0.8, 0.1, 0.0]
TREE = [48, 48, 10, 10, 0.0, 0.7, 0.0]
CAR = [10, 50, 6, 6, 0.0, 0.0, 0.9]
UNSURE = [50, 10, 8, 8, 0.2, 0.0, 0.0]
ROWS = np.array([HOUSE, TWICE, TREE, CAR, UNSURE]).T


def test_boxes_become_objects_and_cells(folder: Path) -> None:
    put(folder, model(ROWS))
    notes = DerivationNotes()
    things = detect(content(), notes)
    assert set(things) == {"building", "tree"}
    assert things["building"][0].equals(shapely.box(10, 64 - 25, 30, 64 - 15)), "y points upward"
    assert things["building"][1] == 0.9
    assert things["tree"][0].equals(shapely.box(43, 11, 53, 21))
    assert [d.count for d in notes.dropped if "map them to no kind" in d.why] == [1]
    # Where the model sees nothing is unknown, so a map of obstacles alone has no free cell.
    with pytest.raises(CannotConvert, match="shows no free ground"):
        imagery_to_occupancy(
            content(), GridParameters(segmentation="model", model="tiny", resolution=1.0), DerivationNotes()
        )
    put(folder, model(ROWS), ("building", "field", None))
    derived_layers = imagery_to_occupancy(
        content(), GridParameters(segmentation="model", model="tiny", resolution=1.0), DerivationNotes()
    )
    (grid,) = derived_layers.parts.values()
    assert isinstance(grid, OccupancyGrid)
    assert ((grid.cells == OCCUPIED).sum(), (grid.cells == FREE).sum()) == (200, 100)


def test_masks_limit_objects_within_their_boxes(folder: Path) -> None:
    left = np.where(np.arange(16) < 5, 8.0, -8.0)[None, :].repeat(16, axis=0)  # the left 20 of 64 pixels
    rows = np.concatenate([ROWS, [[1.0] * 5, [0.0] * 5]])
    put(folder, model(rows, np.stack([left, np.zeros((16, 16))])))
    things = detect(content())
    assert set(things) == {"building"}, "nothing of the tree is in the mask"
    assert things["building"][0].area == pytest.approx(100, abs=10)
    assert shapely.bounds(things["building"][0])[2] == pytest.approx(20, abs=1)


def test_older_yolo_layout_with_objectness_is_read(folder: Path) -> None:
    older = np.array([[*r[:4], 1.0, *r[4:]] for r in (HOUSE, TWICE, TREE, CAR, UNSURE)])
    put(folder, model(older))  # [n, 5 + classes]
    things = detect(content(), confidence=0.5)
    assert things["building"][0].equals(shapely.box(10, 39, 30, 49))


def test_large_images_are_tiled_without_seams(folder: Path) -> None:
    """The model answers for a tile with any red in it: that of the far corner only, here."""
    put(folder, model(np.array([TREE]).T))
    layers = content(200, 100, red=(slice(90, 100), slice(190, 200), 0))
    (tree,) = detect(layers).values()
    assert tree[0].equals(shapely.box(136 + 43, 11, 136 + 53, 21))
    everywhere = detect(content(200, 100))
    assert "tree" in everywhere
    small = detect(content(55, 55))
    assert shapely.bounds(small["tree"][0]).tolist() == [43, 2, 53, 12], "a tile of the lower right, padded"


def test_class_names_are_read_from_model_metadata(folder: Path) -> None:
    put(folder, model(ROWS, names="{0: 'building', 1: 'tree', 2: 'car'}"), None)
    assert set(detect(content())) == {"building", "tree"}
    put(folder, model(ROWS), None)
    with pytest.raises(CannotConvert, match=r"add tiny\.json beside it"):
        detect(content())


def test_yolo_model_is_repeatable(folder: Path) -> None:
    put(folder, model(ROWS))
    assert str(detect(content(150, 90))) == str(detect(content(150, 90)))


def test_unusable_models_raise_errors(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(NotFound, match="available: none"):
        detect(content())
    put(folder, model(ROWS), ("building", "tree", None, None, None))
    with pytest.raises(CannotConvert, match="does not have 5 classes"):
        detect(content())
    put(folder, model(ROWS), ("building", "castle", None))
    with pytest.raises(CannotConvert, match="must be null or one of"):
        detect(content())
    put(folder, b"no model")
    with pytest.raises(CannotConvert, match="cannot be loaded"):
        detect(content())
    put(folder, model(ROWS))
    with pytest.raises(CannotConvert, match="finds nothing"):
        detect(content(), confidence=0.95)
    for name in ("../tiny", "other", "tiny.onnx"):
        with pytest.raises(NotFound, match="available: tiny"):
            _onnx.find_model(name)
    with pytest.raises(Invalid, match="name a model"):
        imagery_to_objects(content(), Parameters(segmentation="model"), DerivationNotes())
    with pytest.raises(Invalid, match="applies only to segmentation=model"):
        imagery_to_objects(content(), Parameters(model="tiny", segmentation="colour"), DerivationNotes())
    real = importlib.import_module

    def absent(name: str, *more: Any) -> Any:
        if name == "onnxruntime":
            raise ModuleNotFoundError(name)
        return real(name, *more)

    monkeypatch.setattr(_onnx.importlib, "import_module", absent)
    with pytest.raises(CannotConvert, match=r'pip install "fleet-map-server\[models\]"'):
        detect(content())
    monkeypatch.delenv(_onnx.FOLDER)
    with pytest.raises(CannotConvert, match="FLEETMAP_MODELS_DIR"):
        detect(content())


def test_yolo_model_works_through_server(folder: Path, tmp_path: Path) -> None:
    """In a confined worker, with its limit of memory."""
    put(folder, model(ROWS))
    ok, png = cv2.imencode(".png", np.full((SIDE, SIDE, 3), (0, 0, 255), np.uint8))
    assert ok
    with running(settings_for(tmp_path / "data", models_dir=folder)) as api:
        api.post("environments", {"name": "yard"})
        api.upload("yard", {"yard.png": png.tobytes()}, format="satellite", metres_per_pixel="1")
        parameters = {"segmentation": "model", "model": "tiny", "resolution": 1.0}
        path = "environments/yard/derivations"
        version = api.post(path, {"method": "imagery_to_objects", "parameters": parameters}).json()
        assert version["information"]["objects"] == "derived"
        things = api.get("environments/yard/versions/latest/layers/objects?crs=local").json()["features"]
        assert {f["properties"]["kind"] for f in things} == {"building", "tree"}
        api.problem(
            "POST", path, 404, json={"method": "imagery_to_objects", "parameters": {**parameters, "model": "x"}}
        )
