"""Promptable segmenters for tests: a tiny ONNX graph of each contract that computes a mask from picture and prompt.

Encoders average the picture over the cells of the mask's grid. Decoders put out, for every cell,
the least of

* how far the cell's centre is inside the box, in pixels of the model's input (a linear function:
  interpolation between cells finds the box's sides again exactly); beside points the box is a cell
  wider on every side;
* how like its colour is to that at the positive points, or at the box's centre: a cell's side or,
  for another colour, minus as much;
* minus the same for the negative points.

Coordinates, half pixels, scaling, padding, normalisation and labels follow the real exports, so
that a mask is only right where the caller keeps to all of them. Objects whose sides lie between
cells, and half a cell inside the box, are found exactly.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import onnx
from onnx import TensorProto, helper
from onnx.external_data_helper import set_external_data

from tests.models import Graph, save_model

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

SamFiles = tuple[Path, Path]
Content = Literal["object", "empty", "full"]
OBJECT: Content = "object"
EMPTY: Content = "empty"
FULL: Content = "full"

CELL_PX = 4  # of the mask's grid, in pixels of the model's input
_MEAN = (123.675, 116.28, 103.53)
_SD = (58.395, 57.12, 57.375)
_FAR = 1e4
_ALIKE = 30.0  # of 255, the largest difference of a channel
_FLOAT = TensorProto.FLOAT
_INT64 = TensorProto.INT64


def write_sam(
    folder: Path,
    *,
    input_px: int = 128,
    preprocess: bool = True,
    masks: Sequence[Content] = (OBJECT,),
    scores: Sequence[float] = (0.9,),
    low_res: bool = True,
    embedding_stride: int = 16,
    fixed: bool = False,
    metadata: Mapping[str, str] | None = None,
) -> SamFiles:
    """SAM and MobileSAM: Meta's decoder, samexporter's encoder with or without the preprocessing in the graph.

    Args:
        folder: for both files.
        input_px: long side of the model's input.
        preprocess: take ``[h, w, 3]`` 0..255, else ``[1, 3, s, s]`` normalised and padded.
        masks: what each output mask holds.
        scores: predicted IoU of each.
        low_res: put out ``low_res_masks``; then ``masks`` is nonsense of the right shape, as in
            exports that froze it.
        embedding_stride: 16 as in SAM, or 4.
        fixed: with ``preprocess``, take ``[s, s, 3]`` only: the caller pads.
        metadata: of the encoder's file.
    """
    graph = Graph()
    if preprocess:
        centred = graph.add("Sub", ["input_image", graph.constant(_MEAN)])
        normal = graph.add("Div", [centred, graph.constant(_SD)])
        planes = graph.add(
            "Unsqueeze", [graph.add("Transpose", [normal], perm=[2, 0, 1]), _ints(graph, [0])]
        )
        size = graph.add(
            "Slice", [graph.add("Shape", [planes]), _ints(graph, [2]), _ints(graph, [4])]
        )
        missing = graph.add("Sub", [_ints(graph, [input_px, input_px]), size])
        image = graph.add(
            "Pad", [planes, graph.add("Concat", [_ints(graph, [0] * 6), missing], axis=0)]
        )
        shape: list[Any] = [input_px, input_px, 3] if fixed else ["image_height", "image_width", 3]
    else:
        image = "input_image"
        shape = [1, 3, input_px, input_px]
    block = embedding_stride // CELL_PX
    _embedded(graph, image, cell_px=CELL_PX, block=block, output="image_embeddings")
    side = input_px // embedding_stride
    encoder = _write(
        folder / "encoder.onnx",
        graph,
        {"input_image": (_FLOAT, shape)},
        {"image_embeddings": (_FLOAT, [1, 3 * block**2, side, side])},
        metadata,
    )

    graph = Graph()
    cells = (
        graph.add("DepthToSpace", ["image_embeddings"], blocksize=block)
        if block > 1
        else "image_embeddings"
    )
    coords = graph.add("Add", ["point_coords", graph.constant([0.5])])
    logits = _stacked(
        graph,
        _logits(
            graph,
            _colours(graph, cells, mean=_MEAN, sd=_SD),
            coords=coords,
            labels="point_labels",
            cell_px=CELL_PX,
        ),
        masks,
    )
    outputs: dict[str, Any] = {
        "masks": (_FLOAT, [1, len(masks), "height", "width"]),
        "iou_predictions": (_FLOAT, [1, len(masks)]),
    }
    if low_res:
        graph.add("Identity", [logits], output="low_res_masks")
        graph.add("Neg", [logits], output="masks")
        outputs["low_res_masks"] = (
            _FLOAT,
            [1, len(masks), input_px // CELL_PX, input_px // CELL_PX],
        )
    else:
        longest = graph.add("ReduceMax", ["orig_im_size"], axes=[0], keepdims=1)
        scaled = graph.add(
            "Div", [graph.add("Mul", ["orig_im_size", graph.constant([float(input_px)])]), longest]
        )
        kept = _as_int(
            graph, graph.add("Floor", [graph.add("Add", [scaled, graph.constant([0.5])])])
        )
        whole = _resized(graph, logits, _ints(graph, [input_px, input_px]), len(masks))
        picture = graph.add("Slice", [whole, _ints(graph, [0, 0]), kept, _ints(graph, [2, 3])])
        _resized(graph, picture, _as_int(graph, "orig_im_size"), len(masks), output="masks")
    _scores(graph, scores, shape=[1, len(masks)], output="iou_predictions")
    side = input_px // CELL_PX
    decoder = _write(
        folder / "decoder.onnx",
        graph,
        {
            "image_embeddings": (
                _FLOAT,
                [1, 3 * block**2, input_px // embedding_stride, input_px // embedding_stride],
            ),
            "point_coords": (_FLOAT, [1, "num_points", 2]),
            "point_labels": (_FLOAT, [1, "num_points"]),
            "mask_input": (_FLOAT, [1, 1, side, side]),
            "has_mask_input": (_FLOAT, [1]),
            "orig_im_size": (_FLOAT, [2]),
        },
        outputs,
    )
    return encoder, decoder


def write_sam2(
    folder: Path,
    *,
    input_px: int = 128,
    masks: Sequence[Content] = (EMPTY, OBJECT, FULL),
    scores: Sequence[float] = (0.3, 0.9, 0.5),
) -> SamFiles:
    """SAM 2 and 2.1 as samexporter writes them: a stretched square, three levels of features, the graph pads."""
    graph = Graph()
    levels = {
        "high_res_feats_0": CELL_PX,
        "high_res_feats_1": 2 * CELL_PX,
        "image_embed": 4 * CELL_PX,
    }
    for name, kernel in levels.items():
        _embedded(graph, "image", cell_px=kernel, block=1, output=name)
    features = {
        name: (_FLOAT, [1, 3, input_px // kernel, input_px // kernel])
        for name, kernel in levels.items()
    }
    encoder = _write(
        folder / "sam2.encoder.onnx",
        graph,
        {"image": (_FLOAT, [1, 3, input_px, input_px])},
        features,
    )

    graph = Graph()
    coords = graph.add("Add", ["point_coords", graph.constant([0.5])])
    padded = graph.add("Concat", [coords, graph.constant([[[0.0, 0.0]]])], axis=1)
    labels = graph.add("Concat", ["point_labels", graph.constant([[-1.0]])], axis=1)
    logits = _logits(
        graph,
        _colours(graph, "high_res_feats_0", mean=_MEAN, sd=_SD),
        coords=padded,
        labels=labels,
        cell_px=CELL_PX,
    )
    _stacked(graph, logits, masks, output="masks")
    _scores(graph, scores, shape=[1, len(masks)], output="iou_predictions")
    side = input_px // CELL_PX
    decoder = _write(
        folder / "sam2.decoder.onnx",
        graph,
        {
            "image_embed": features["image_embed"],
            "high_res_feats_0": features["high_res_feats_0"],
            "high_res_feats_1": features["high_res_feats_1"],
            "point_coords": (_FLOAT, ["num_labels", "num_points", 2]),
            "point_labels": (_FLOAT, ["num_labels", "num_points"]),
            "mask_input": (_FLOAT, ["num_labels", 1, side, side]),
            "has_mask_input": (_FLOAT, ["num_labels"]),
        },
        {
            "masks": (_FLOAT, [1, len(masks), side, side]),
            "iou_predictions": (_FLOAT, [1, len(masks)]),
        },
    )
    return encoder, decoder


def write_transformers(
    folder: Path,
    *,
    sam3: bool = False,
    masks: Sequence[Content] = (EMPTY, OBJECT, FULL),
    scores: Sequence[float] = (0.3, 0.9, 0.5),
) -> SamFiles:
    """SAM 2, or the SAM 3 tracker (stride 14, mean and sd 0.5), in the layout of transformers.js."""
    input_px, cell = (224, 7) if sam3 else (128, CELL_PX)
    strides = (7, 7, 14) if sam3 else (cell, 2 * cell, 4 * cell)
    mean, sd = ((127.5,) * 3, (127.5,) * 3) if sam3 else (_MEAN, _SD)
    graph = Graph()
    features: dict[str, Any] = {}
    for level, kernel in enumerate(strides):
        name = f"image_embeddings.{level}"
        _embedded(graph, "pixel_values", cell_px=kernel, block=1, output=name)
        features[name] = (_FLOAT, ["batch_size", 3, input_px // kernel, input_px // kernel])
    encoder = _write(
        folder / "vision_encoder.onnx",
        graph,
        {"pixel_values": (_FLOAT, ["batch_size", 3, input_px, input_px])},
        features,
    )

    graph = Graph()
    corners = graph.add("Reshape", ["input_boxes", _ints(graph, [1, -1, 2])])
    points = graph.add("Reshape", ["input_points", _ints(graph, [1, -1, 2])])
    coords = graph.add(
        "Add", [graph.add("Concat", [points, corners], axis=1), graph.constant([0.5])]
    )
    n_boxes = graph.add(
        "Slice", [graph.add("Shape", ["input_boxes"]), _ints(graph, [1]), _ints(graph, [2])]
    )
    repeats = graph.add("Concat", [_ints(graph, [1]), n_boxes], axis=0)
    of_boxes = graph.add("Tile", [graph.constant([[2.0, 3.0]]), repeats])
    of_points = graph.add(
        "Cast", [graph.add("Reshape", ["input_labels", _ints(graph, [1, -1])])], to=_FLOAT
    )
    labels = graph.add("Concat", [of_points, of_boxes], axis=1)
    logits = _logits(
        graph,
        _colours(graph, "image_embeddings.0", mean=mean, sd=sd),
        coords=coords,
        labels=labels,
        cell_px=cell,
    )
    stacked = _stacked(graph, logits, masks)
    graph.add("Unsqueeze", [stacked, _ints(graph, [1])], output="pred_masks")
    _scores(graph, scores, shape=[1, 1, len(masks)], output="iou_scores")
    _scores(graph, [5.0], shape=[1, 1, 1], output="object_score_logits")
    decoder = _write(
        folder / "prompt_encoder_mask_decoder.onnx",
        graph,
        {
            "input_points": (_FLOAT, ["batch_size", 1, "num_points", 2]),
            "input_labels": (_INT64, ["batch_size", 1, "num_points"]),
            "input_boxes": (_FLOAT, ["batch_size", "num_boxes", 4]),
            **features,
        },
        {
            "iou_scores": (_FLOAT, [1, 1, len(masks)]),
            "pred_masks": (_FLOAT, [1, 1, len(masks), "mask_height", "mask_width"]),
            "object_score_logits": (_FLOAT, [1, 1, 1]),
        },
    )
    return encoder, decoder


def write_efficient_sam(
    folder: Path,
    *,
    input_px: int = 128,
    masks: Sequence[Content] = (EMPTY, OBJECT, FULL),
    scores: Sequence[float] = (0.3, 0.9, 0.5),
) -> SamFiles:
    """EfficientSAM: it stretches and scales coordinates in the graph, and puts out masks of the image's size."""
    graph = Graph()
    square = _resized(graph, "batched_images", _ints(graph, [input_px, input_px]), 3)
    _embedded(
        graph,
        graph.add("Mul", [square, graph.constant([255.0])]),
        cell_px=CELL_PX,
        block=CELL_PX,
        output="image_embeddings",
    )
    side = input_px // CELL_PX // CELL_PX
    embedding = (_FLOAT, ["batch", 3 * CELL_PX**2, side, side])
    encoder = _write(
        folder / "efficient_encoder.onnx",
        graph,
        {"batched_images": (_FLOAT, ["batch", 3, "height", "width"])},
        {"image_embeddings": embedding},
    )

    graph = Graph()
    cells = graph.add("DepthToSpace", ["image_embeddings"], blocksize=CELL_PX)
    size = graph.add("Cast", ["orig_im_size"], to=_FLOAT)
    height, width = graph.split(size, 2, axis=0)
    factor = graph.add(
        "Div", [graph.constant([float(input_px)]), graph.add("Concat", [width, height], axis=0)]
    )
    points = graph.add("Reshape", ["batched_point_coords", _ints(graph, [1, -1, 2])])
    coords = graph.add("Add", [graph.add("Mul", [points, factor]), graph.constant([0.5])])
    labels = graph.add("Reshape", ["batched_point_labels", _ints(graph, [1, -1])])
    stacked = _stacked(
        graph, _logits(graph, cells, coords=coords, labels=labels, cell_px=CELL_PX), masks
    )
    full = _resized(graph, stacked, "orig_im_size", len(masks))
    graph.add("Unsqueeze", [full, _ints(graph, [1])], output="output_masks")
    _scores(graph, scores, shape=[1, 1, len(masks)], output="iou_predictions")
    # the low-resolution masks have no name in its export
    graph.add("Identity", [stacked], output="4242")
    decoder = _write(
        folder / "efficient_decoder.onnx",
        graph,
        {
            "image_embeddings": embedding,
            "batched_point_coords": (_FLOAT, [1, 1, "num_points", 2]),
            "batched_point_labels": (_FLOAT, [1, 1, "num_points"]),
            "orig_im_size": (_INT64, [2]),
        },
        {
            "output_masks": (_FLOAT, [1, 1, len(masks), "height", "width"]),
            "iou_predictions": (_FLOAT, [1, 1, len(masks)]),
            "4242": (_FLOAT, [1, len(masks), "rows", "columns"]),
        },
    )
    return encoder, decoder


def keep_weights_beside(path: Path, suffix: str = "_data") -> Path:
    """Move a model's float constants of four dimensions into a file beside it, as exports of large models do."""
    model = onnx.load(str(path))
    beside = path.with_name(path.name + suffix)
    for tensor in model.graph.initializer:
        # the shapes of tensors have to stay in the file
        if len(tensor.dims) == 4 and tensor.data_type == _FLOAT:
            set_external_data(tensor, location=beside.name)
    onnx.save(model, str(path))
    assert beside.is_file()
    return beside


# --- Parts
#
# -----------------------------------------------------------------------------------------------------------


def _ints(graph: Graph, values: Sequence[int]) -> str:
    return graph.constant(list(values), np.int64)


def _as_int(graph: Graph, name: str) -> str:
    return graph.add("Cast", [name], to=_INT64)


def _embedded(graph: Graph, image: str, cell_px: int, block: int, output: str) -> None:
    """``[1, 3, s, s]`` to its cells' means, blocks of cells folded into channels."""
    pooled = graph.add("AveragePool", [image], kernel_shape=[cell_px] * 2, strides=[cell_px] * 2)
    if block > 1:
        graph.add("SpaceToDepth", [pooled], blocksize=block, output=output)
    else:
        graph.add("Identity", [pooled], output=output)


def _colours(graph: Graph, cells: str, mean: Sequence[float], sd: Sequence[float]) -> str:
    """Undo a normalisation: 0..255 again."""
    spread, centre = (graph.constant(np.reshape(values, (1, 3, 1, 1))) for values in (sd, mean))
    return graph.add("Add", [graph.add("Mul", [cells, spread]), centre])


def _logits(graph: Graph, colours: str, coords: str, labels: str, cell_px: int) -> str:
    """``[1, 1, rows, columns]`` from ``[1, 3, rows, columns]`` colours, ``[1, n, 2]`` coordinates and ``[1, n]``."""
    ones = graph.add(
        "Add", [_times(graph, graph.split(colours, 3, axis=1)[0], 0.0), graph.constant([1.0])]
    )
    column, row = (
        _times(graph, graph.add("Sub", [graph.add("CumSum", [ones, graph.constant(axis, np.int64)]),
                                        graph.constant([0.5])]), cell_px)
        for axis in (3, 2)
    )  # fmt: skip
    upright = _ints(graph, [-1, 1, 1, 1])
    x, y = (graph.add("Reshape", [part, upright]) for part in graph.split(coords, 2, axis=2))
    label = graph.add("Reshape", [labels, upright])

    def labelled(value: int) -> str:
        same = graph.add("Equal", [label, graph.constant([float(value)])])
        return graph.add("Cast", [same], to=_FLOAT)

    def summed(name: str, *axes: int) -> str:
        return graph.add("ReduceSum", [name, _ints(graph, axes)], keepdims=1)

    def less(first: str, second: str) -> str:
        return graph.add("Sub", [first, second])

    first = labelled(2)
    last = labelled(3)
    x1, y1 = (summed(graph.add("Mul", [at, first]), 0) for at in (x, y))
    x2, y2 = (summed(graph.add("Mul", [at, last]), 0) for at in (x, y))
    has_box = summed(first, 0)
    inside = graph.add("Min", [less(column, x1), less(x2, column), less(row, y1), less(y2, row)])
    has_point = graph.add("Min", [summed(labelled(1), 0), graph.constant([1.0])])
    inside = graph.add("Add", [inside, _times(graph, has_point, cell_px)])

    def hit(at_x: str, at_y: str) -> str:
        half = graph.constant([cell_px / 2])
        near = [
            graph.add("LessOrEqual", [graph.add("Abs", [less(grid, at)]), half])
            for grid, at in ((column, at_x), (row, at_y))
        ]
        return graph.add("Cast", [graph.add("And", near)], to=_FLOAT)

    def likeness(weight: str) -> str:
        total = graph.add("Max", [summed(weight, 2, 3), graph.constant([1e-6])])
        target = graph.add("Div", [summed(graph.add("Mul", [colours, weight]), 2, 3), total])
        difference = graph.add(
            "ReduceMax", [graph.add("Abs", [less(colours, target)])], axes=[1], keepdims=1
        )
        steep = _times(graph, less(graph.constant([_ALIKE]), difference), cell_px / 10)
        return graph.add(
            "Clip", [steep, graph.constant(-float(cell_px)), graph.constant(float(cell_px))]
        )

    def unless(missing: str, name: str) -> str:
        """``name`` where there is such a prompt, else no bound at all."""
        present = graph.add("Mul", [name, missing])
        absent = _times(graph, less(graph.constant([1.0]), missing), _FAR)
        return graph.add("Add", [present, absent])

    points = hit(x, y)
    middle = hit(
        _times(graph, graph.add("Add", [x1, x2]), 0.5),
        _times(graph, graph.add("Add", [y1, y2]), 0.5),
    )
    positive = graph.add(
        "Add",
        [summed(graph.add("Mul", [points, labelled(1)]), 0), graph.add("Mul", [middle, has_box])],
    )
    negative = summed(graph.add("Mul", [points, labelled(0)]), 0)
    has_negative = graph.add("Min", [summed(negative, 2, 3), graph.constant([1.0])])
    return graph.add(
        "Min",
        [
            unless(has_box, inside),
            likeness(positive),
            unless(has_negative, graph.add("Neg", [likeness(negative)])),
        ],
    )


def _times(graph: Graph, name: str, factor: float) -> str:
    return graph.add("Mul", [name, graph.constant([float(factor)])])


def _stacked(
    graph: Graph, logits: str, masks: Sequence[Content], *, output: str | None = None
) -> str:
    """The candidates ``[1, m, rows, columns]``."""
    level = {"empty": -1.0, "full": 1.0}
    parts = [
        logits
        if content == "object"
        else graph.add("Add", [_times(graph, logits, 0.0), graph.constant([level[content]])])
        for content in masks
    ]
    return graph.add("Concat", parts, axis=1, output=output)


def _resized(
    graph: Graph, name: str, size: str, channels: int, *, output: str | None = None
) -> str:
    """Bilinear, as PyTorch's ``interpolate`` exports it."""
    sizes = graph.add("Concat", [_ints(graph, [1, channels]), size], axis=0)
    return graph.add(
        "Resize",
        [name, "", "", sizes],
        mode="linear",
        coordinate_transformation_mode="half_pixel",
        output=output,
    )


def _scores(graph: Graph, scores: Sequence[float], shape: Sequence[int], output: str) -> None:
    graph.add("Identity", [graph.constant(np.reshape(scores, shape))], output=output)


def _write(
    path: Path,
    graph: Graph,
    inputs: Mapping[str, tuple[int, Sequence[Any]]],
    outputs: Mapping[str, tuple[int, Sequence[Any]]],
    metadata: Mapping[str, str] | None = None,
) -> Path:
    def described(items: Mapping[str, tuple[int, Sequence[Any]]]) -> list[onnx.ValueInfoProto]:
        return [
            helper.make_tensor_value_info(name, element, shape)
            for name, (element, shape) in items.items()
        ]

    return save_model(
        path,
        graph.nodes,
        inputs=described(inputs),
        outputs=described(outputs),
        constants=graph.constants,
        metadata=metadata or {},
    )
