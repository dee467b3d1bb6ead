"""Tiny models with the interface of the Segment-Anything family, which segment by colour alone.

The encoder's embedding is its image in squares of 4 pixels; the decoder's mask at a point are the squares of the
point's colour. Violations of the interface change the output: with a label other than 1 the mask is upside down;
without the padding point (-1), or with a mask input, the predicted IoU is low.
"""

from __future__ import annotations

from typing import Any

import onnx

MAKE, FLOAT = onnx.helper, onnx.TensorProto.FLOAT
MEAN, DEVIATION = [123.675, 116.28, 103.53], [58.395, 57.12, 57.375]


def _constants(**values: Any) -> list[Any]:
    import numpy as np

    return [onnx.numpy_helper.from_array(np.asarray(v), name) for name, v in values.items()]


def _model(nodes: list[Any], inputs: list[Any], outputs: list[Any], constants: list[Any]) -> bytes:
    graph = MAKE.make_graph(nodes, "tiny", inputs, outputs, constants)
    onnx_model = MAKE.make_model(graph, opset_imports=[MAKE.make_opsetid("", 18)], ir_version=8)
    onnx.checker.check_model(onnx_model, full_check=True)
    return bytes(onnx_model.SerializeToString())


def encoder(side: int, *, upright: bool = False, second: bool = False, free: bool = False) -> bytes:
    """Build an encoder [1, 3, side, side] -> image_embeddings.

    upright: [h, w, 3], which it normalises and pads itself; second: as SAM 2; free: its sizes are not stated.
    """
    import numpy as np

    nodes, constants = [], []
    if upright:
        picture = MAKE.make_tensor_value_info("input_image", FLOAT, ["image_height", "image_width", 3])
        constants += _constants(
            mean=np.array(MEAN, np.float32),
            deviation=np.array(DEVIATION, np.float32),
            whole=np.array([side, side], np.int64),
            before=np.zeros(4, np.int64),
            middle=np.zeros(0, np.int64),
            two=np.array([2], np.int64),
            none=np.array([0], np.int64),
            first=np.array([0], np.int64),
        )
        nodes += [
            MAKE.make_node("Sub", ["input_image", "mean"], ["less"]),
            MAKE.make_node("Div", ["less", "deviation"], ["normal"]),
            MAKE.make_node("Transpose", ["normal"], ["turned"], perm=[2, 0, 1]),
            MAKE.make_node("Unsqueeze", ["turned", "first"], ["single"]),
            MAKE.make_node("Shape", ["input_image"], ["shape"]),
            MAKE.make_node("Slice", ["shape", "none", "two"], ["size"]),
            MAKE.make_node("Sub", ["whole", "size"], ["after"]),
            MAKE.make_node("Concat", ["before", "none", "none", "after"], ["pads"], axis=0),
            MAKE.make_node("Pad", ["single", "pads"], ["x"]),
        ]
    else:
        size: Any = ["h", "w"] if free else [side, side]
        picture = MAKE.make_tensor_value_info("x", FLOAT, ["batch", 3, *size])
    names = ["image_embed", "high_res_feats_0"] if second else ["image_embeddings"]
    nodes.append(MAKE.make_node("AveragePool", ["x"], [names[0]], kernel_shape=[4, 4], strides=[4, 4]))
    low = side // 4
    outputs = [MAKE.make_tensor_value_info(names[0], FLOAT, [1, 3, *(["a", "b"] if free or upright else [low, low])])]
    if second:
        nodes.append(MAKE.make_node("ReduceMax", ["x"], ["high_res_feats_0"], keepdims=1))
        outputs.append(MAKE.make_tensor_value_info("high_res_feats_0", FLOAT, [1, 1, 1, 1]))
    return _model(nodes, [picture], outputs, constants)


def decoder(
    side: int,
    *,
    steep: float = 40.0,
    iou: float = 0.95,
    four: bool = False,
    together: bool = False,
    second: bool = False,
    low_res: bool = True,
    without: str = "",
) -> bytes:
    """steep: how fast its logits fall with the difference of colours. four: with the mask for several points, too,
    which is all of the picture. together: takes several prompts. low_res: with low_res_masks. without: an input it
    lacks."""
    import numpy as np

    low = side // 4
    embedding = "image_embed" if second else "image_embeddings"
    n: Any = "n" if together else 1
    inputs = {
        embedding: [1, 3, low, low],
        "point_coords": [n, "num_points", 2],
        "point_labels": [n, "num_points"],
        "mask_input": [n, 1, low, low],
        "has_mask_input": [1],
        "orig_im_size": [2],
    }
    if second:
        inputs["high_res_feats_0"] = [1, 1, 1, 1]
    constants = _constants(
        zero=np.array([0], np.int64),
        one=np.array([1], np.int64),
        two=np.array([2], np.int64),
        minus=np.array([-1], np.int64),
        turned=np.array([1, 0], np.int64),
        four=np.array(4.0, np.float32),
        steep=np.array(steep, np.float32),
        near=np.array(0.3, np.float32),
        iou=np.array(iou, np.float32),
        huge=np.array(100.0, np.float32),
        low=np.array(-10.0, np.float32),
        high=np.array(10.0, np.float32),
        axes=np.array([2, 3], np.int64),
        colour=np.array([1], np.int64),
        places=np.array([1, 2, 3], np.int64),
    )
    nodes = [
        # The point of each prompt, and the colour there.
        MAKE.make_node("Slice", ["point_coords", "zero", "one", "one"], ["firsts"]),
        MAKE.make_node("Squeeze", ["firsts", "one"], ["xy"]),
        MAKE.make_node("Gather", ["xy", "turned"], ["yx"], axis=1),
        MAKE.make_node("Div", ["yx", "four"], ["cells"]),
        MAKE.make_node("Floor", ["cells"], ["floors"]),
        MAKE.make_node("Cast", ["floors"], ["at"], to=onnx.TensorProto.INT64),
        MAKE.make_node("Squeeze", [embedding, "zero"], ["single"]),
        MAKE.make_node("Transpose", ["single"], ["last"], perm=[1, 2, 0]),
        MAKE.make_node("GatherND", ["last", "at"], ["there"]),
        MAKE.make_node("Unsqueeze", ["there", "axes"], ["wide"]),
        MAKE.make_node("Sub", [embedding, "wide"], ["differ"]),
        MAKE.make_node("Abs", ["differ"], ["apart"]),
        MAKE.make_node("ReduceSum", ["apart", "colour"], ["far"], keepdims=1),
        MAKE.make_node("Sub", ["near", "far"], ["close"]),
        MAKE.make_node("Mul", ["close", "steep"], ["steeply"]),
        MAKE.make_node("Clip", ["steeply", "low", "high"], ["logits"]),  # so that 0 is halfway between two colours
        # Labels.
        MAKE.make_node("Slice", ["point_labels", "zero", "one", "one"], ["label"]),
        MAKE.make_node("Unsqueeze", ["label", "axes"], ["labels"]),
        MAKE.make_node("Mul", ["logits", "labels"], ["told"]),
        MAKE.make_node("Slice", ["point_labels", "one", "two", "one"], ["none"]),
        MAKE.make_node("ReduceMax", ["mask_input", "places"], ["given"], keepdims=0),
        MAKE.make_node("Unsqueeze", ["given", "one"], ["given2"]),
        MAKE.make_node("Add", ["none", "given2"], ["wrong1"]),
        MAKE.make_node("Add", ["wrong1", "has_mask_input"], ["wrong"]),
        MAKE.make_node("Neg", ["wrong"], ["right"]),
        MAKE.make_node("Mul", ["right", "iou"], ["score"]),
    ]
    if four:
        nodes += [
            MAKE.make_node("Abs", ["told"], ["positive"]),
            MAKE.make_node("Add", ["positive", "huge"], ["all"]),
            MAKE.make_node("Neg", ["huge"], ["nothing"]),
            MAKE.make_node("Mul", ["positive", "nothing"], ["empty"]),
            MAKE.make_node("Concat", ["all", "told", "empty", "told"], ["low_res_masks"], axis=1),
            MAKE.make_node("Concat", ["score", "score", "score", "score"], ["iou_predictions"], axis=1),
        ]
    else:
        nodes += [
            MAKE.make_node("Identity", ["told"], ["low_res_masks"]),
            MAKE.make_node("Identity", ["score"], ["iou_predictions"]),
        ]
    nodes += [
        MAKE.make_node("Shape", ["low_res_masks"], ["shape"]),
        MAKE.make_node("Slice", ["shape", "zero", "two"], ["many"]),
        MAKE.make_node("Cast", ["orig_im_size"], ["size"], to=onnx.TensorProto.INT64),
        MAKE.make_node("Concat", ["many", "size"], ["sizes"], axis=0),
        MAKE.make_node("Resize", ["low_res_masks", "", "", "sizes"], ["masks"], mode="linear"),
    ]
    count = 4 if four else 1
    outputs = [
        MAKE.make_tensor_value_info("masks", FLOAT, [n, count, "height", "width"]),
        MAKE.make_tensor_value_info("iou_predictions", FLOAT, [n, count]),
    ]
    if low_res:
        outputs.append(MAKE.make_tensor_value_info("low_res_masks", FLOAT, [n, count, low, low]))
    taken = [MAKE.make_tensor_value_info(name, FLOAT, shape) for name, shape in inputs.items() if name != without]
    if without:  # an export that has it built in
        built = np.zeros([1 if isinstance(k, str) else k for k in inputs[without]], np.float32)
        constants.append(onnx.numpy_helper.from_array(built, without))
    return _model(nodes, taken, outputs, constants)
