"""Models of the Segment-Anything family and pixel classification models: tiny ONNX models with known outputs."""

from __future__ import annotations

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
from app.errors import CannotConvert, Invalid, NotFound, TooLarge
from app.model.features import Features
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from app.model.layers import Layers, PartKey
from tests.api.conftest import running, settings_for
from tests.derive.pictures import local

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

from tests.derive import tiny_sam  # noqa: E402  it needs onnx

SIDE = 128
GRASS, CROWN, ROOF, ODD = (110, 150, 80), (35, 75, 35), (170, 80, 70), (60, 60, 190)
BUILDING = (8, 8, 24, 20)  # columns and rows of the upper left and lower right corner
TREE = (46, 14, 6)
ODD_BOX = (40, 40, 44, 48)


def yard(width: int = 64, height: int = 64) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Grass with a building, a tree and something small and blue."""
    image = np.full((height, width, 3), GRASS, np.uint8)
    x0, y0, x1, y1 = BUILDING
    image[y0:y1, x0:x1] = ROOF
    cv2.circle(image, (TREE[0], TREE[1]), TREE[2], CROWN, -1)
    x0, y0, x1, y1 = ODD_BOX
    image[y0:y1, x0:x1] = ODD
    return image


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(_onnx.FOLDER, str(tmp_path))
    return tmp_path


def put(folder: Path, encoder: bytes | None = None, decoder: bytes | None = None) -> None:
    (folder / "sam.encoder.onnx").write_bytes(encoder or tiny_sam.encoder(SIDE))
    (folder / "sam.decoder.onnx").write_bytes(decoder or tiny_sam.decoder(SIDE))


def content(image: np.ndarray[Any, np.dtype[np.uint8]]) -> Layers:
    """Pixels of half a metre."""
    return Layers({PartKey("imagery", "ground", "satellite"): local(image, 0.5)})


def detect(
    layers: Layers, notes: DerivationNotes | None = None, **more: Any
) -> dict[str, list[tuple[Any, dict[str, Any]]]]:
    # Squares of the embedding that hold two colours are things, too: small ones.
    usual = {"segmentation": "model", "model": "sam", "resolution": 0.5, "minimum_area": 5.0}
    options = Parameters(**{**usual, **more})
    derived_layers = imagery_to_objects(layers, options, notes if notes is not None else DerivationNotes())
    (part,) = derived_layers.parts.values()
    assert isinstance(part, Features)
    out: dict[str, list[tuple[Any, dict[str, Any]]]] = {}
    for f in part:
        out.setdefault(str(f.properties["kind"]), []).append((f.geometry, dict(f.properties)))
    return out


def box(corners: tuple[int, int, int, int], height: int = 64) -> Any:
    """Of pixels, as metres."""
    x0, y0, x1, y1 = corners
    return shapely.box((x0) / 2, (height - y1) / 2, (x1) / 2, (height - y0) / 2)


def alike(a: Any, b: Any) -> float:
    return float(a.intersection(b).area / a.union(b).area)


def check(things: dict[str, list[tuple[Any, dict[str, Any]]]], height: int = 64) -> None:
    """Objects of the yard, each once."""
    assert {kind: len(of) for kind, of in things.items()} == {"building": 1, "tree": 1, "field": 1, "area": 1}
    assert alike(things["building"][0][0], box(BUILDING, height)) > 0.85
    crown = shapely.Point((TREE[0] + 0.5) / 2, (height - TREE[1] - 0.5) / 2).buffer(TREE[2] / 2)
    assert alike(things["tree"][0][0], crown) > 0.65  # its edge is as coarse as the embedding
    assert alike(things["area"][0][0], box(ODD_BOX, height)) > 0.8
    assert not things["field"][0][0].intersects(box(BUILDING, height).centroid)


@pytest.mark.parametrize(
    "how",
    [
        {},
        {"decoder": {"four": True, "together": True}},
        {"decoder": {"low_res": False}},
        {"encoder": {"upright": True}},
        {"encoder": {"free": True}},
        {"encoder": {"second": True}, "decoder": {"second": True, "together": True}},
    ],
    ids=["export", "several masks", "large masks", "mobile, preprocessing", "free size", "sam 2"],
)
def test_masks_become_objects_classified_by_colour(folder: Path, how: dict[str, dict[str, Any]]) -> None:
    put(folder, tiny_sam.encoder(SIDE, **how.get("encoder", {})), tiny_sam.decoder(SIDE, **how.get("decoder", {})))
    notes = DerivationNotes()
    things = detect(content(yard()), notes, stability=0.7)
    check(things)
    properties = things["building"][0][1]
    assert properties["model"] == "sam"
    assert 0.3 < properties["confidence"] <= 0.95
    assert properties["stability"] > 0.9
    assert any("3 were classified by colour and shape, 1 have kind area" in w.problem for w in notes.warnings)


def test_cells_of_unclassified_masks_stay_unknown(folder: Path) -> None:
    put(folder)
    how = GridParameters(segmentation="model", model="sam", resolution=0.5, minimum_area=5.0)
    (grid,) = imagery_to_occupancy(content(yard()), how, DerivationNotes()).parts.values()
    assert isinstance(grid, OccupancyGrid)
    cells = grid.cells[::-1]
    assert [cells[14, 16], cells[TREE[1], TREE[0]], cells[44, 42], cells[60, 4]] == [OCCUPIED, OCCUPIED, UNKNOWN, FREE]


def test_large_images_are_processed_in_tiles_and_as_a_whole(folder: Path) -> None:
    """Wide image: as a whole at half size, and tiles from 0, 128 and 160 on; none cuts objects that begin there."""
    put(folder, tiny_sam.encoder(160), tiny_sam.decoder(160))
    image = np.full((64, 320, 3), GRASS, np.uint8)
    houses = [(64, 8, 80, 24), (152, 8, 168, 24)]  # the second is cut by the first tile
    for x0, y0, x1, y1 in houses:
        image[y0:y1, x0:x1] = ROOF if x0 < 100 else (210, 200, 205)  # one thing, for this model, is of one colour
    image[48:56, 24:296] = (185, 175, 160)  # through all tiles: only the whole picture shows all of it
    things = detect(content(image))
    assert all("middle_line" in properties for _, properties in things.pop("path"))
    assert {kind: len(of) for kind, of in things.items()} == {"building": 2, "field": 1, "road": 1}
    seen = sorted((t[0] for t in things["building"]), key=lambda g: float(g.centroid.x))
    assert [alike(g, box(house)) > 0.85 for g, house in zip(seen, houses, strict=True)] == [True, True]
    (road,) = things["road"]
    assert alike(road[0], box((24, 48, 296, 56))) > 0.9
    assert road[1]["width"] == pytest.approx(4, abs=0.3)


def test_masks_below_thresholds_are_dropped(folder: Path) -> None:
    put(folder, decoder=tiny_sam.decoder(SIDE, iou=0.6))
    with pytest.raises(CannotConvert, match=r"confidence of at least 0\.88 and a stability of at least 0\.95"):
        detect(content(yard()))
    assert detect(content(yard()), confidence=0.55)["tree"][0][1]["confidence"] <= 0.6
    put(folder, decoder=tiny_sam.decoder(SIDE, steep=0.5))  # its logits are all near the threshold
    with pytest.raises(CannotConvert, match=r"a stability of at least 0\.95"):
        detect(content(yard()))
    assert detect(content(yard()), stability=0.0)


def test_single_prompt_finds_one_object(folder: Path) -> None:
    put(folder)
    assert set(detect(content(yard()), points=1)) == {"field"}


def test_masks_of_grey_image_have_kind_area(folder: Path) -> None:
    put(folder)
    notes = DerivationNotes()
    grey = cv2.cvtColor(yard(), cv2.COLOR_RGB2GRAY)
    assert set(detect(content(grey), notes)) == {"area"}
    assert any("0 were classified" in w.problem for w in notes.warnings)


def test_sam_model_is_repeatable(folder: Path) -> None:
    put(folder)
    assert str(detect(content(yard(150, 90)))) == str(detect(content(yard(150, 90))))


def test_wrong_models_raise_errors(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = r"image_embeddings, point_coords, point_labels, mask_input, has_mask_input, orig_im_size"
    put(folder, decoder=tiny_sam.encoder(SIDE))
    with pytest.raises(
        CannotConvert, match=expected + r".*sam\.decoder\.onnx\) has the signature \(x \[batch, 3, 128, 128\]\)"
    ):
        detect(content(yard()))
    put(folder, encoder=tiny_sam.decoder(SIDE))
    with pytest.raises(CannotConvert, match=expected + r".*sam\.encoder\.onnx\) has the signature"):
        detect(content(yard()))
    put(folder, decoder=tiny_sam.decoder(SIDE, second=True))
    with pytest.raises(CannotConvert, match="high_res_feats"):
        detect(content(yard()))
    put(folder, decoder=tiny_sam.decoder(SIDE, without="has_mask_input"))
    with pytest.raises(CannotConvert, match=expected):
        detect(content(yard()))
    put(folder, encoder=b"no model")
    with pytest.raises(CannotConvert, match=r"cannot be loaded: sam\.encoder\.onnx"):
        detect(content(yard()))
    put(folder, encoder=tiny_sam.encoder(64))  # an embedding that the decoder does not take
    with pytest.raises(CannotConvert, match=r"the model sam \(sam\.decoder\.onnx\) failed"):
        detect(content(yard()))
    put(folder)
    monkeypatch.setenv(_onnx.LARGEST, "1000")
    with pytest.raises(TooLarge, match="larger than 1000 bytes: raise FLEETMAP_MODELS_MAX_BYTES"):
        detect(content(yard()))
    monkeypatch.delenv(_onnx.LARGEST)
    big = Layers({PartKey("imagery", "ground", "satellite"): local(np.zeros((3000, 3000, 3), np.uint8), 0.5)})
    with pytest.raises(CannotConvert, match="use a resolution coarser than"):
        detect(big)
    (folder / "sam.decoder.onnx").unlink()
    with pytest.raises(NotFound, match=r"available: sam\.encoder$"):
        detect(content(yard()))


def test_model_file_names_are_paired(folder: Path) -> None:
    for name in ("vit_b_encoder", "vit_b_decoder", "m.Encoder", "m.decoder", "yolo", "lone.decoder"):
        (folder / f"{name}.onnx").write_bytes(b"?")
    with pytest.raises(NotFound, match=r"available: lone\.decoder, m, vit_b, yolo$"):
        _onnx.find_model("x")
    assert [f.name for f in _onnx.find_model("vit_b").files] == ["vit_b_encoder.onnx", "vit_b_decoder.onnx"]


# --- pixel classification models ---------------------------------------------------------------------------------
def pixels(side: int | None = 64, count: int = 3, coarse: int = 2) -> bytes:
    """[1, 3, side, side] -> logits [1, 3, side / coarse, …]: 8 times each normalised colour (of ``count`` of them)."""
    make, dtype = onnx.helper, onnx.TensorProto.FLOAT
    size: Any = side or "side"
    nodes = [
        make.make_node("AveragePool", ["x"], ["low"], kernel_shape=[coarse] * 2, strides=[coarse] * 2),
        make.make_node("Slice", ["low", "zero", "count", "one"], ["some"]),
        make.make_node("Mul", ["some", "eight"], ["logits"]),
    ]
    constants = [
        onnx.numpy_helper.from_array(np.array(v), name)
        for name, v in {"zero": [0], "count": [count], "one": [1], "eight": np.float32(8)}.items()
    ]
    graph = make.make_graph(
        nodes,
        "tiny",
        [make.make_tensor_value_info("x", dtype, [1, 3, size, size])],
        [make.make_tensor_value_info("logits", dtype, [1, count, "h", "w"])],
        constants,
    )
    onnx_model = make.make_model(graph, opset_imports=[make.make_opsetid("", 13)], ir_version=8)
    return bytes(onnx_model.SerializeToString())


PLAIN = {"classes": ["building", "field", None], "mean": [0, 0, 0], "std": [1, 1, 1]}


def write_model(folder: Path, data: bytes, metadata: Any) -> None:
    (folder / "pixels.onnx").write_bytes(data)
    (folder / "pixels.json").write_text(json.dumps(metadata))


def test_pixel_classes_are_continuous_across_tiles(folder: Path) -> None:
    """Red is a building, green a field, blue nothing; a red band runs through three tiles without a seam."""
    write_model(folder, pixels(), PLAIN)
    image = np.full((80, 150, 3), (0, 255, 0), np.uint8)
    image[20:40, 10:140] = (255, 0, 0)
    image[60:70, 60:80] = (0, 0, 255)
    notes = DerivationNotes()
    things = detect(content(image), notes, model="pixels", minimum_area=None)
    assert {kind: len(of) for kind, of in things.items()} == {"building": 1, "field": 1}
    assert alike(things["building"][0][0], box((10, 20, 140, 40), 80)) > 0.98
    assert things["field"][0][0].area == pytest.approx((80 * 150 - 20 * 130 - 200) / 4, rel=0.02)
    assert things["building"][0][1]["confidence"] > 0.9
    assert [d.subject for d in notes.dropped] == ["m² of ground"]
    with pytest.raises(CannotConvert, match="finds nothing"):
        detect(content(np.full((80, 80, 3), 128, np.uint8)), model="pixels")  # a third each


def test_path_classes_have_width(folder: Path) -> None:
    write_model(folder, pixels(), {**PLAIN, "classes": ["path", "field", None]})
    image = np.full((64, 64, 3), (0, 255, 0), np.uint8)
    image[30:36] = (255, 0, 0)
    things = detect(content(image), model="pixels")
    assert things["path"][0][1]["width"] == pytest.approx(3, abs=0.5)


def test_pixel_model_uses_default_mean_and_rejects_wrong_metadata(folder: Path) -> None:
    write_model(folder, pixels(None), ["building", "field", None])
    image = np.full((64, 64, 3), (124, 116, 104), np.uint8)  # ImageNet's mean: nothing is more likely than the rest
    image[10:30, 10:30] = (255, 0, 0)
    assert set(detect(content(image), model="pixels")) == {"building"}
    write_model(folder, pixels(), {**PLAIN, "classes": ["building", "field"]})
    with pytest.raises(CannotConvert, match=r"does not have 2 classes: it returns \(1, 3, 32, 32\)"):
        detect(content(image), model="pixels")
    for wrong in ({"std": [1, 0, 1]}, {"mean": [1, 2]}, {"mean": "abc"}, {"std": None}):
        write_model(folder, pixels(), {**PLAIN, **wrong})
        with pytest.raises(CannotConvert, match=r"pixels\.json: (std|mean) must be"):
            detect(content(image), model="pixels")
    write_model(folder, pixels(), PLAIN)
    with pytest.raises(
        Invalid, match="points: applies only to models of the Segment-Anything family, which pixels is not"
    ):
        detect(content(image), model="pixels", points=8)
    with pytest.raises(Invalid, match="stability: applies only to segmentation=model"):
        imagery_to_objects(content(image), Parameters(stability=0.5, segmentation="colour"), DerivationNotes())


def test_sam_model_works_through_server(folder: Path, tmp_path: Path) -> None:
    """In a confined worker, with its limit of memory."""
    put(folder)
    ok, png = cv2.imencode(".png", yard()[..., ::-1])
    assert ok
    settings = settings_for(tmp_path / "data", models_dir=folder)
    with running(settings) as api:
        api.post("environments", {"name": "yard"})
        api.upload("yard", {"yard.png": png.tobytes()}, format="satellite", metres_per_pixel="0.5")
        parameters = {"segmentation": "model", "model": "sam", "resolution": 0.5, "minimum_area": 5}
        path = "environments/yard/derivations"
        version = api.post(path, {"method": "imagery_to_objects", "parameters": parameters}).json()
        assert version["information"]["objects"] == "derived"
        assert any("kind area" in w["problem"] for w in version["warnings"])
        things = api.get("environments/yard/versions/latest/layers/objects?crs=local").json()["features"]
        assert sorted(f["properties"]["kind"] for f in things) == ["area", "building", "field", "tree"]
        wrong = api.problem(
            "POST", path, 422, json={"method": "imagery_to_objects", "parameters": {**parameters, "points": 99}}
        )
        assert "at most 64" in wrong["detail"]
        (folder / "sam.decoder.onnx").write_bytes(tiny_sam.encoder(SIDE))
        wrong = api.problem(
            "POST", path, 422, json={"method": "imagery_to_objects", "parameters": {**parameters, "points": 9}}
        )
        assert "expected an encoder" in wrong["detail"]
