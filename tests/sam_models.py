"""Promptable segmenters for tests: a tiny ONNX graph of each contract.

The graphs compute a mask from picture and prompt. Encoders average the picture over the cells of
the mask's grid. Decoders put out the smallest of three numbers for every cell:

* the distance of the cell's centre from the box's sides, positive inside, in pixels of the model's
  input. It is linear, so interpolation between cells restores the box's sides exactly. Beside
  points the box is a cell wider on every side;
* a cell's side if its colour is like that at the positive points or at the box's centre, else minus
  a cell's side;
* minus the same for the negative points.

Coordinates, half pixels, scaling, padding, normalisation and labels follow the real exports, so a
mask is right only if the caller follows all of them. Objects are found exactly if their sides lie
between cells and half a cell inside the box.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import onnx
from onnx.external_data_helper import set_external_data

from tests.sam_graph import (
    BOTTOM_RIGHT,
    EMPTY,
    FLOAT,
    FULL,
    INT64,
    OBJECT,
    TOP_LEFT,
    Content,
    SamGraph,
    Tensor,
    denormalised,
    embed,
    object_logits,
    put_out_scores,
    resized,
    stack_candidates,
    write_graph,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

__all__ = [
    "EMPTY",
    "FULL",
    "OBJECT",
    "SamFiles",
    "keep_weights_beside",
    "write_efficient_sam",
    "write_sam",
    "write_sam2",
    "write_transformers",
]

SamFiles = tuple[Path, Path]
"""Encoder and decoder."""

# Side of a cell of the mask's grid, in pixels of the model's input.
CELL_PX = 4
_MEAN = (123.675, 116.28, 103.53)
_SD = (58.395, 57.12, 57.375)
# SAM 3: mean and standard deviation 0.5 of 0..1.
_SAM3_LEVEL = (127.5, 127.5, 127.5)


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
    """Write SAM and MobileSAM: Meta's decoder, samexporter's encoder.

    Args:
        folder: folder for both files.
        input_px: long side of the model's input.
        preprocess: take ``[h, w, 3]`` 0..255, else ``[1, 3, s, s]`` normalised and padded.
        masks: content of each output mask.
        scores: predicted IoU of each.
        low_res: put out ``low_res_masks``; then ``masks`` is nonsense of the right shape, as in
            exports that froze it.
        embedding_stride: 16 as in SAM, or 4.
        fixed: with ``preprocess``, take ``[s, s, 3]`` only: the caller pads.
        metadata: metadata of the encoder's file.
    """
    block = embedding_stride // CELL_PX
    side = input_px // embedding_stride
    embedding = (FLOAT, [1, 3 * block**2, side, side])

    graph = SamGraph()
    if not preprocess:
        image = "input_image"
        shape: list[Any] = [1, 3, input_px, input_px]
    else:
        image = _normalised_and_padded(graph, "input_image", input_px)
        shape = [input_px, input_px, 3] if fixed else ["image_height", "image_width", 3]
    embed(graph, image, cell_px=CELL_PX, block=block, output="image_embeddings")
    encoder = write_graph(
        folder / "encoder.onnx",
        graph,
        inputs={"input_image": (FLOAT, shape)},
        outputs={"image_embeddings": embedding},
        metadata=metadata,
    )

    graph = SamGraph()
    cells = "image_embeddings"
    if block > 1:
        cells = graph.add("DepthToSpace", [cells], blocksize=block)
    logits = object_logits(
        graph,
        denormalised(graph, cells, mean=_MEAN, sd=_SD),
        coords=graph.shifted("point_coords", 0.5),
        labels="point_labels",
        cell_px=CELL_PX,
    )
    candidates = stack_candidates(graph, logits, masks)
    grid = input_px // CELL_PX
    outputs: dict[str, Tensor] = {
        "masks": (FLOAT, [1, len(masks), "height", "width"]),
        "iou_predictions": (FLOAT, [1, len(masks)]),
    }
    if low_res:
        graph.add("Identity", [candidates], output="low_res_masks")
        graph.add("Neg", [candidates], output="masks")
        outputs["low_res_masks"] = (FLOAT, [1, len(masks), grid, grid])
    else:
        _put_out_full_masks(graph, candidates, input_px, n_masks=len(masks))
    put_out_scores(graph, scores, shape=[1, len(masks)], output="iou_predictions")
    decoder = write_graph(
        folder / "decoder.onnx",
        graph,
        inputs={
            "image_embeddings": embedding,
            "point_coords": (FLOAT, [1, "num_points", 2]),
            "point_labels": (FLOAT, [1, "num_points"]),
            "mask_input": (FLOAT, [1, 1, grid, grid]),
            "has_mask_input": (FLOAT, [1]),
            "orig_im_size": (FLOAT, [2]),
        },
        outputs=outputs,
    )
    return encoder, decoder


def _normalised_and_padded(graph: SamGraph, image: str, input_px: int) -> str:
    """Normalise ``[h, w, 3]`` 0..255 and pad it to ``[1, 3, s, s]``, right and below."""
    centred = graph.difference(image, graph.constant(_MEAN))
    normal = graph.ratio(centred, graph.constant(_SD))
    planes = graph.with_axis(graph.add("Transpose", [normal], perm=[2, 0, 1]), 0)
    size = graph.shape_of(planes, 2, 4)
    missing = graph.difference(graph.size(input_px, input_px), size)
    # Begins of all four axes, then ends of the first two.
    unpadded = graph.ints(0, 0, 0, 0, 0, 0)
    return graph.add("Pad", [planes, graph.joined(unpadded, missing, axis=0)])


def _put_out_full_masks(graph: SamGraph, candidates: str, input_px: int, *, n_masks: int) -> None:
    """Put out ``masks`` in the size of the image, as SAM's post-processing does."""
    longest = graph.add("ReduceMax", ["orig_im_size"], axes=[0], keepdims=1)
    factor_times_size = graph.ratio(graph.scaled("orig_im_size", input_px), longest)
    picture_size = graph.as_ints(graph.add("Floor", [graph.shifted(factor_times_size, 0.5)]))
    whole = resized(graph, candidates, graph.size(input_px, input_px), n_masks)
    # Without the padding, at the size of the image.
    picture = graph.add("Slice", [whole, graph.ints(0, 0), picture_size, graph.ints(2, 3)])
    resized(graph, picture, graph.as_ints("orig_im_size"), n_masks, output="masks")


def write_sam2(
    folder: Path,
    *,
    input_px: int = 128,
    masks: Sequence[Content] = (EMPTY, OBJECT, FULL),
    scores: Sequence[float] = (0.3, 0.9, 0.5),
) -> SamFiles:
    """Write SAM 2 and 2.1 in samexporter's layout.

    The picture is stretched to a square, there are three levels of features, and the graph pads.
    """
    graph = SamGraph()
    strides = {
        "high_res_feats_0": CELL_PX,
        "high_res_feats_1": 2 * CELL_PX,
        "image_embed": 4 * CELL_PX,
    }
    features: dict[str, Tensor] = {}
    for name, stride in strides.items():
        embed(graph, "image", cell_px=stride, block=1, output=name)
        features[name] = (FLOAT, [1, 3, input_px // stride, input_px // stride])
    encoder = write_graph(
        folder / "sam2.encoder.onnx",
        graph,
        inputs={"image": (FLOAT, [1, 3, input_px, input_px])},
        outputs=features,
    )

    graph = SamGraph()
    coords = graph.shifted("point_coords", 0.5)
    logits = object_logits(
        graph,
        denormalised(graph, "high_res_feats_0", mean=_MEAN, sd=_SD),
        coords=graph.joined(coords, graph.constant([[[0.0, 0.0]]]), axis=1),
        labels=graph.joined("point_labels", graph.constant([[-1.0]]), axis=1),
        cell_px=CELL_PX,
    )
    stack_candidates(graph, logits, masks, output="masks")
    put_out_scores(graph, scores, shape=[1, len(masks)], output="iou_predictions")
    grid = input_px // CELL_PX
    decoder = write_graph(
        folder / "sam2.decoder.onnx",
        graph,
        inputs={
            "image_embed": features["image_embed"],
            "high_res_feats_0": features["high_res_feats_0"],
            "high_res_feats_1": features["high_res_feats_1"],
            "point_coords": (FLOAT, ["num_labels", "num_points", 2]),
            "point_labels": (FLOAT, ["num_labels", "num_points"]),
            "mask_input": (FLOAT, ["num_labels", 1, grid, grid]),
            "has_mask_input": (FLOAT, ["num_labels"]),
        },
        outputs={
            "masks": (FLOAT, [1, len(masks), grid, grid]),
            "iou_predictions": (FLOAT, [1, len(masks)]),
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
    """Write SAM 2, or the SAM 3 tracker with stride 14, in the layout of transformers.js."""
    if sam3:
        input_px = 224
        cell_px = 7
        strides = (7, 7, 14)
        mean = sd = _SAM3_LEVEL
    else:
        input_px = 128
        cell_px = CELL_PX
        strides = (CELL_PX, 2 * CELL_PX, 4 * CELL_PX)
        mean = _MEAN
        sd = _SD
    graph = SamGraph()
    features: dict[str, Tensor] = {}
    for level, stride in enumerate(strides):
        name = f"image_embeddings.{level}"
        embed(graph, "pixel_values", cell_px=stride, block=1, output=name)
        features[name] = (FLOAT, ["batch_size", 3, input_px // stride, input_px // stride])
    encoder = write_graph(
        folder / "vision_encoder.onnx",
        graph,
        inputs={"pixel_values": (FLOAT, ["batch_size", 3, input_px, input_px])},
        outputs=features,
    )

    graph = SamGraph()
    coords, labels = _points_and_corners(graph)
    logits = object_logits(
        graph,
        denormalised(graph, "image_embeddings.0", mean=mean, sd=sd),
        coords=coords,
        labels=labels,
        cell_px=cell_px,
    )
    candidates = stack_candidates(graph, logits, masks)
    graph.with_axis(candidates, 1, output="pred_masks")
    put_out_scores(graph, scores, shape=[1, 1, len(masks)], output="iou_scores")
    put_out_scores(graph, [5.0], shape=[1, 1, 1], output="object_score_logits")
    decoder = write_graph(
        folder / "prompt_encoder_mask_decoder.onnx",
        graph,
        inputs={
            "input_points": (FLOAT, ["batch_size", 1, "num_points", 2]),
            "input_labels": (INT64, ["batch_size", 1, "num_points"]),
            "input_boxes": (FLOAT, ["batch_size", "num_boxes", 4]),
            **features,
        },
        outputs={
            "iou_scores": (FLOAT, [1, 1, len(masks)]),
            "pred_masks": (FLOAT, [1, 1, len(masks), "mask_height", "mask_width"]),
            "object_score_logits": (FLOAT, [1, 1, 1]),
        },
    )
    return encoder, decoder


def _points_and_corners(graph: SamGraph) -> tuple[str, str]:
    """Join the inputs of points and boxes: coordinates ``[1, n, 2]`` and labels ``[1, n]``."""
    points = graph.reshaped("input_points", 1, -1, 2)
    corners = graph.reshaped("input_boxes", 1, -1, 2)
    coords = graph.shifted(graph.joined(points, corners, axis=1), 0.5)
    n_boxes = graph.shape_of("input_boxes", 1, 2)
    repeats = graph.joined(graph.ints(1), n_boxes, axis=0)
    corner_labels = graph.constant([[float(TOP_LEFT), float(BOTTOM_RIGHT)]])
    of_boxes = graph.add("Tile", [corner_labels, repeats])
    of_points = graph.as_floats(graph.reshaped("input_labels", 1, -1))
    return coords, graph.joined(of_points, of_boxes, axis=1)


def write_efficient_sam(
    folder: Path,
    *,
    input_px: int = 128,
    masks: Sequence[Content] = (EMPTY, OBJECT, FULL),
    scores: Sequence[float] = (0.3, 0.9, 0.5),
) -> SamFiles:
    """Write EfficientSAM: its graph stretches, scales coordinates, and puts out full-size masks."""
    graph = SamGraph()
    square = resized(graph, "batched_images", graph.size(input_px, input_px), 3)
    levels = graph.scaled(square, 255.0)
    embed(graph, levels, cell_px=CELL_PX, block=CELL_PX, output="image_embeddings")
    side = input_px // CELL_PX // CELL_PX
    embedding = (FLOAT, ["batch", 3 * CELL_PX**2, side, side])
    encoder = write_graph(
        folder / "efficient_encoder.onnx",
        graph,
        inputs={"batched_images": (FLOAT, ["batch", 3, "height", "width"])},
        outputs={"image_embeddings": embedding},
    )

    graph = SamGraph()
    height, width = graph.split(graph.as_floats("orig_im_size"), 2, axis=0)
    size = graph.joined(width, height, axis=0)
    factor = graph.ratio(graph.constant([float(input_px)]), size)
    points = graph.reshaped("batched_point_coords", 1, -1, 2)
    logits = object_logits(
        graph,
        graph.add("DepthToSpace", ["image_embeddings"], blocksize=CELL_PX),
        coords=graph.shifted(graph.product(points, factor), 0.5),
        labels=graph.reshaped("batched_point_labels", 1, -1),
        cell_px=CELL_PX,
    )
    candidates = stack_candidates(graph, logits, masks)
    full = resized(graph, candidates, "orig_im_size", len(masks))
    graph.with_axis(full, 1, output="output_masks")
    put_out_scores(graph, scores, shape=[1, 1, len(masks)], output="iou_predictions")
    # The low-resolution masks have no name in EfficientSAM's export.
    graph.add("Identity", [candidates], output="4242")
    decoder = write_graph(
        folder / "efficient_decoder.onnx",
        graph,
        inputs={
            "image_embeddings": embedding,
            "batched_point_coords": (FLOAT, [1, 1, "num_points", 2]),
            "batched_point_labels": (FLOAT, [1, 1, "num_points"]),
            "orig_im_size": (INT64, [2]),
        },
        outputs={
            "output_masks": (FLOAT, [1, 1, len(masks), "height", "width"]),
            "iou_predictions": (FLOAT, [1, 1, len(masks)]),
            "4242": (FLOAT, [1, len(masks), "rows", "columns"]),
        },
    )
    return encoder, decoder


def keep_weights_beside(path: Path, suffix: str = "_data") -> Path:
    """Move a model's float constants of four dimensions into a file beside it.

    Exports of large models keep their weights in this way.
    """
    model = onnx.load(str(path))
    beside = path.with_name(path.name + suffix)
    for tensor in model.graph.initializer:
        # Tensors that hold shapes must stay in the file.
        if len(tensor.dims) == 4 and tensor.data_type == FLOAT:
            set_external_data(tensor, location=beside.name)
    onnx.save(model, str(path))
    assert beside.is_file()
    return beside
