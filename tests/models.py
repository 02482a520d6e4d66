"""Detectors for tests: tiny ONNX graphs that really read their boxes from the picture.

``paint_vehicles`` draws a grey body for each box and, from the box's centre to the right, a beacon
of five pixels that spells the box out:

    pixel 0   (255, 0, 255), the mark; it is the pixel that holds the box's centre
    pixel 1   length in pixels: whole, 256ths; width, whole
    pixel 2   width, 256ths; angle in pi / 65536: high byte, low byte
    pixel 3   score in 255ths; class index; 0
    pixel 4   the centre within the mark's pixel: x and y in 256ths; 0

``write_detector`` writes a graph that finds marks, reads the numbers beside them and returns them
in either layout of Ultralytics' exports. Its boxes are exact, up to those units. A beacon that is
resampled, compressed with loss or cut by a tile's edge is not found. The numbers of two marks in
one cell of ``CELL_PX`` mix.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import cv2
import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from vehanchor.detection.boxes import box_corners, canonical_boxes
from vehanchor.detection.chips import CHIP_COLUMNS, CHIP_LENGTH_PX, CHIP_ROWS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import ArrayLike, NDArray

BEACON_PX = 5
# Side of a cell, which has one anchor.
CELL_PX = 4
_MARK = (255, 0, 255)
_BODY = (150, 158, 170)
_OPSET = 17
_IR_VERSION = 8


def blank_image(
    width_px: int, height_px: int, level: int = 70, shade_levels: int = 16
) -> NDArray[np.uint8]:
    """Make a picture ``[h, w, 3]`` uint8 of nearly one grey level, with a photograph's noise.

    Without noise, painted vehicles make a drawing of it, which has no scale. With few levels of
    grey it is faint, and stretched: therefore it becomes lighter from left to right. It has no
    features by which two pictures could be linked.
    """
    rng = np.random.default_rng(0)
    noise = rng.integers(-4, 5, size=(height_px, width_px, 1))
    shade = np.linspace(-shade_levels, shade_levels, width_px)[:, None]
    grey = np.clip(np.rint(level + shade) + noise, 0, 255).astype(np.uint8)
    return np.repeat(grey, 3, axis=2)


def paint_vehicles(
    image: NDArray[np.uint8],
    boxes: ArrayLike,
    *,
    scores: Sequence[float] | None = None,
    classes: Sequence[int] | None = None,
) -> NDArray[np.float64]:
    """Paint vehicles into an image, all bodies before all beacons: overlapping ones are found, too.

    Args:
        image: ``[h, w, 3]`` uint8 RGB, changed in place.
        boxes: ``[n, 5]`` rows ``(x, y, length, width, angle)``: pixels counted from the image's
            corner, sides below 256, radians. The five pixels from the centre to the right lie
            inside the image.
        scores: ``[n]`` in 1/255..1; default 0.9 each.
        classes: ``[n]`` class indices; default 0 each.

    Returns:
        ``[n, 5]`` float64 canonical boxes, rounded as the beacons hold them: what a detector finds,
        in the same order. The scores it finds are ``round(255 * score) / 255``.
    """
    rows = canonical_boxes(np.asarray(boxes, dtype=np.float64))
    if scores is None:
        scores = [0.9] * len(rows)
    if classes is None:
        classes = [0] * len(rows)
    levels = [round(255 * score) for score in scores]
    assert len(levels) == len(classes) == len(rows)
    assert all(1 <= level <= 255 for level in levels)
    corners = np.rint((box_corners(rows) - 0.5) * 16).astype(np.int32)
    for corner in corners:
        cv2.fillPoly(image, [corner], _BODY, shift=4)
    painted = rows.copy()
    for i, (row, level, kind) in enumerate(zip(rows, levels, classes, strict=True)):
        painted[i] = _paint_beacon(image, row, level, kind)
    return painted


def _paint_beacon(
    image: NDArray[np.uint8], row: NDArray[np.float64], level: int, kind: int
) -> tuple[float, ...]:
    """Paint a beacon; return the box ``(x, y, length, width, angle)`` that it spells."""
    x = int(row[0])
    y = int(row[1])
    assert 0 <= y < image.shape[0], f"{row} is outside the image"
    assert 0 <= x <= image.shape[1] - BEACON_PX, f"{row} has no room for its beacon"
    length = int(np.rint(row[2] * 256))
    width = int(np.rint(row[3] * 256))
    assert length < 65536, f"{row} is longer than 255 px"
    angle = int(np.rint(row[4] / np.pi * 65536)) % 65536
    part_x = min(255, int(np.rint((row[0] - x) * 256)))
    part_y = min(255, int(np.rint((row[1] - y) * 256)))
    image[y, x : x + BEACON_PX] = [
        _MARK,
        (length >> 8, length & 255, width >> 8),
        (width & 255, angle >> 8, angle & 255),
        (level, kind, 0),
        (part_x, part_y, 0),
    ]
    return (
        x + part_x / 256,
        y + part_y / 256,
        length / 256,
        width / 256,
        angle * np.pi / 65536,
    )


def assert_same_boxes(
    found: NDArray[np.float64], expected: NDArray[np.float64], within: float = 1e-3
) -> None:
    """Compare boxes in any order."""
    assert len(found) == len(expected)
    distances = np.linalg.norm(found[:, None, :2] - expected[None, :, :2], axis=2)
    ordered = found[np.argmin(distances, axis=0)]
    np.testing.assert_allclose(ordered[:, :4], expected[:, :4], atol=within * 10)
    assert np.abs(np.sin(ordered[:, 4] - expected[:, 4])).max() < 10 * within


def fleet(n: int, mean: float = 30.0) -> NDArray[np.float64]:
    """Make the lengths of a fleet, most of them near the mean."""
    return mean * (1 + 0.06 * np.linspace(-1, 1, n) ** 3)


def car_park(
    lengths: ArrayLike,
    width_px: int = 480,
    height_px: int = 360,
    *,
    scores: Sequence[float] | None = None,
) -> NDArray[np.uint8]:
    """Paint a vehicle of each length, in rows from the upper left corner."""
    image = blank_image(width_px, height_px)
    columns = (width_px - 60) // 70
    boxes = []
    for k, length in enumerate(np.asarray(lengths)):
        row, column = divmod(k, columns)
        boxes.append([40 + 70 * column, 50 + 60 * row, length, 12, 0.4])
    paint_vehicles(image, np.reshape(boxes, (-1, 5)), scores=scores)
    return image


POOL = (420, 280, 468, 376)
POOL_RGB = (40, 140, 210)


def pool_among_cars(
    n_vehicles: int = 30, rectangle: tuple[int, int, int, int] = POOL
) -> NDArray[np.uint8]:
    """Paint a picture of 800 x 600 px with a pool below rows of cars."""
    image = car_park(fleet(n_vehicles), 800, 600)
    x1, y1, x2, y2 = rectangle
    image[y1:y2, x1:x2] = POOL_RGB
    return image


def write_detector(
    path: Path,
    *,
    layout: Literal["raw", "end2end"] = "raw",
    names: Mapping[int, str] | None = {0: "small vehicle"},
    fixed_size: int | tuple[int, int] | None = None,
    dtype: Literal["float32", "float16"] = "float32",
    metadata: Mapping[str, str | None] | None = None,
    cap: int = 300,
    swap_sides: bool = False,
    angle_offset: float = 0.0,
) -> Path:
    """Write a detector of painted vehicles.

    Args:
        path: of the ONNX file.
        layout: ``raw`` returns ``[1, 4 + nc + 1, anchors]``; ``end2end`` rows ``[1, cap, 7]``,
            best first, then zeros.
        names: class names for the metadata; None leaves the entry out.
        fixed_size: side, or (height, width), of the input in pixels, a multiple of ``CELL_PX``;
            None leaves batch, height and width symbolic, and the raw layout's output shape too.
        dtype: of input and output; the arithmetic between is float32.
        metadata: entries to add or replace; None as a value removes one. Without it the file has
            what Ultralytics writes: task, stride, imgsz, names.
        cap: rows of the end-to-end layout.
        swap_sides: return width before length, with the angle of the width: the same boxes.
        angle_offset: added to every angle, for example whole turns.

    Returns:
        The path.
    """
    n_out = max(len(names or {}), 1)
    graph = Graph()
    table = _box_table(graph, swap_sides=swap_sides, angle_offset=angle_offset)
    # Only marks are not zero, so the sum over a cell is its mark's value. Unlike a maximum, a sum
    # keeps negative angles.
    pooled = graph.add("AveragePool", [table], kernel_shape=[CELL_PX] * 2, strides=[CELL_PX] * 2)
    cells = graph.times(pooled, float(CELL_PX**2))
    flat = graph.add("Reshape", [cells, graph.constant([0, 7, -1], np.int64)])  # [b, 7, anchors]
    if layout == "raw":
        result = _raw_rows(graph, flat, n_out)
    else:
        result = _end_to_end_rows(graph, flat, cap)
    element = TensorProto.FLOAT if dtype == "float32" else TensorProto.FLOAT16
    graph.add("Cast", [result], output="output0", to=element)

    size = (fixed_size, fixed_size) if isinstance(fixed_size, int) else fixed_size
    batch: int | str = "batch"
    anchors: int | str = "anchors"
    sides: tuple[int | str, int | str] = ("height", "width")
    if size:
        batch = 1
        anchors = (size[0] // CELL_PX) * (size[1] // CELL_PX)
        sides = size
    shape_out = [batch, cap, 7]
    if layout == "raw":
        shape_out = [batch, 4 + n_out + 1, anchors]
    entries: dict[str, str | None] = {
        "description": "test detector",
        "task": "obb",
        "stride": "32",
        "imgsz": repr(list(size or (1024, 1024))),
        "names": None if names is None else repr(dict(names)),
        **(metadata or {}),
    }
    return save_model(
        path,
        graph.nodes,
        inputs=[helper.make_tensor_value_info("images", element, [batch, 3, *sides])],
        outputs=[helper.make_tensor_value_info("output0", element, shape_out)],
        constants=graph.constants,
        metadata=entries,
    )


def _box_table(graph: Graph, *, swap_sides: bool, angle_offset: float) -> str:
    """Read the boxes at all marks: ``[b, 7, h, w]`` of x, y, both sides, score, class, angle."""
    levels = graph.times(graph.as_float("images"), 255.0)
    codes = graph.add("Round", [levels])
    reads = [codes] + [_shifted_left(graph, codes, k) for k in range(1, BEACON_PX)]
    pixels = [graph.split(read, 3, axis=1) for read in reads]
    mark_pixel, first, second, third, fourth = pixels
    mark = _mark_mask(graph, mark_pixel)
    column, row = _pixel_indices(graph, mark)

    def with_fraction(whole: str, fraction: str) -> str:
        return graph.add("Sum", [whole, graph.times(fraction, 1 / 256)])

    x = with_fraction(column, fourth[0])
    y = with_fraction(row, fourth[1])
    length = with_fraction(first[0], first[1])
    width = with_fraction(first[2], second[0])
    angle = graph.times(with_fraction(second[1], second[2]), np.pi / 256)
    score = graph.times(third[0], 1 / 255)
    sides = [length, width]
    if swap_sides:
        sides.reverse()
        angle_offset += np.pi / 2
    turned = graph.plus(angle, angle_offset)
    fields = graph.add("Concat", [x, y, *sides, score, third[1], turned], axis=1)
    # A beacon cut by the edge reads zeros: without a score it is not a vehicle.
    has_score = graph.add("Greater", [third[0], graph.constant([0.0])])
    visible = graph.add("Mul", [mark, graph.as_float(has_score)])
    return graph.add("Mul", [fields, visible])


BODIES = {
    "reference_length_m": 4.3,
    "reference_length_sd_m": 0.3,
    "region_lengths_m": {"europe": 4.1},
}
"""Lengths of bodies in the card of ``write_chip_network``."""

_CHIP_OUTPUTS = {
    "logit": 1,
    "kinds": 10,
    "edges": 4,
    "edge_log_sd": 4,
    "turn": 1,
    "log_metres": 2,
    "metres_log_sd": 2,
    "drawn": 1,
}
"""Outputs of a chip network, and the numbers of each."""


def write_chip_network(
    detector: Path,
    *,
    without: str = "",
    gain: float = 1.0,
    edges: Sequence[float] = (-0.5, 0.5, -0.2, 0.2),
    length_m: float = 4.3,
    brightness: float = 0.0,
    drawn: float = -20.0,
    metadata: Mapping[str, str | None] | None = None,
) -> Path:
    """Write a linear chip network beside a detector.

    Args:
        detector: file of the detector, which its metadata names by the stem.
        without: name of an output that is missing.
        gain: logit of a white chip; a black one has 0.
        edges: of each body, in candidate lengths; a red square of 8 px on black moves them to its
            place.
        length_m: of each car by its appearance.
        brightness: addition to the log of this length for a white chip.
        drawn: log odds that a candidate is drawn.
        metadata: entries to add or replace; None as a value removes one.

    Returns:
        The path.
    """
    weight, offset = _chip_layer(gain=gain, edges=edges, length_m=length_m, brightness=brightness)
    offset[-1] = drawn
    graph = Graph()
    flat = graph.add("Flatten", ["chips"])
    joined = graph.add("Gemm", [flat, graph.constant(weight), graph.constant(offset)])
    sizes = list(_CHIP_OUTPUTS.values())
    parts = [f"{name}_part" for name in _CHIP_OUTPUTS]
    split = helper.make_node("Split", [joined, graph.constant(sizes, np.int64)], parts, axis=1)
    graph.nodes.append(split)
    outputs = []
    for (name, size), part in zip(_CHIP_OUTPUTS.items(), parts, strict=True):
        shape: list[int | str] = ["n", size]
        if size == 1:
            shape = ["n"]
            graph.add("Squeeze", [part, graph.constant([1], np.int64)], output=name)
        else:
            graph.add("Identity", [part], output=name)
        if name != without:
            outputs.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, shape))
    chip_shape: list[int | str] = ["n", 3, CHIP_ROWS, CHIP_COLUMNS]
    return save_model(
        detector.with_name(f"{detector.stem}.chips.onnx"),
        graph.nodes,
        inputs=[helper.make_tensor_value_info("chips", TensorProto.FLOAT, chip_shape)],
        outputs=outputs,
        constants=graph.constants,
        metadata={
            "vehanchor.detector": detector.stem,
            "vehanchor.weights": "1,1,0",
            "vehanchor.least_score": "0.15",
            "vehanchor.bodies": json.dumps(BODIES),
            **(metadata or {}),
        },
    )


def _chip_layer(
    *, gain: float, edges: Sequence[float], length_m: float, brightness: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Make the weights ``[pixels, outputs]`` and offsets ``[outputs]`` of a chip network."""
    n_outputs = sum(_CHIP_OUTPUTS.values())
    starts = np.cumsum([0, *_CHIP_OUTPUTS.values()]).tolist()
    first = dict(zip(_CHIP_OUTPUTS, starts, strict=False))
    # A red square of 8 px moves both ends by its column, and both sides by its row.
    rows = (np.arange(CHIP_ROWS) + 0.5 - CHIP_ROWS / 2) / CHIP_LENGTH_PX / 8**2
    columns = (np.arange(CHIP_COLUMNS) + 0.5 - CHIP_COLUMNS / 2) / CHIP_LENGTH_PX / 8**2
    weight = np.zeros((3, CHIP_ROWS, CHIP_COLUMNS, n_outputs))
    n_values = weight[..., 0].size
    edge = first["edges"]
    metres = first["log_metres"]
    weight[..., 0] = gain / n_values
    weight[0, :, :, edge : edge + 2] = columns[None, :, None]
    weight[0, :, :, edge + 2 : edge + 4] = rows[:, None, None]
    weight[..., metres : metres + 2] = brightness / n_values

    width_m = length_m * (edges[3] - edges[2])
    edge_sd = first["edge_log_sd"]
    offset = np.zeros(n_outputs)
    offset[edge : edge + 4] = edges
    offset[edge_sd : edge_sd + 4] = np.log(0.02)
    offset[metres : metres + 2] = np.log([length_m, width_m])
    offset[first["metres_log_sd"] : first["drawn"]] = np.log(0.07)
    return weight.reshape(-1, n_outputs), offset


def write_other_model(path: Path, *, metadata: Mapping[str, str | None] | None = None) -> Path:
    """Write a sound model that is not a detector: a classifier, ``[1, 3, h, w]`` to ``[1, 3]``."""
    mean = helper.make_node("ReduceMean", ["image"], ["logits"], axes=[2, 3], keepdims=0)
    image_shape: list[int | str] = [1, 3, "height", "width"]
    return save_model(
        path,
        [mean],
        inputs=[helper.make_tensor_value_info("image", TensorProto.FLOAT, image_shape)],
        outputs=[helper.make_tensor_value_info("logits", TensorProto.FLOAT, [1, 3])],
        constants=[],
        metadata=metadata or {},
    )


class Graph:
    """Nodes and constants of a graph under construction; names are made up as it grows."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def add(
        self, operator: str, inputs: Sequence[str], *, output: str | None = None, **attributes: Any
    ) -> str:
        """Add a node with one output; return the output's name."""
        name = output or f"v{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, list(inputs), [name], **attributes))
        return name

    def times(self, name: str, factor: float) -> str:
        """Multiply a tensor by a number."""
        return self.add("Mul", [name, self.constant([factor])])

    def plus(self, name: str, number: float) -> str:
        """Add a number to a tensor."""
        return self.add("Add", [name, self.constant([number])])

    def as_float(self, name: str) -> str:
        """Convert a tensor to float32."""
        return self.add("Cast", [name], to=TensorProto.FLOAT)

    def split(self, name: str, parts: int, *, axis: int) -> list[str]:
        """Split a tensor along an axis; return the names of the parts."""
        outputs = [f"v{len(self.nodes)}_{k}" for k in range(parts)]
        ones = self.constant([1] * parts, np.int64)
        self.nodes.append(helper.make_node("Split", [name, ones], outputs, axis=axis))
        return outputs

    def constant(self, values: ArrayLike, dtype: type[np.generic] = np.float32) -> str:
        """Add a constant; return its name."""
        name = f"c{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.asarray(values, dtype=dtype), name))
        return name


def _shifted_left(graph: Graph, name: str, k: int) -> str:
    """Shift: each pixel gets the value ``k`` pixels to its right, zero beyond the edge."""
    padded = graph.add("Pad", [name, graph.constant([0, 0, 0, 0, 0, 0, 0, k], np.int64)])
    return _slice(graph, padded, k, np.iinfo(np.int64).max, axis=3)


def _slice(graph: Graph, name: str, start: int, end: int, *, axis: int) -> str:
    """Cut a tensor from ``start`` to ``end`` along an axis."""
    limits = [graph.constant([value], np.int64) for value in (start, end, axis)]
    return graph.add("Slice", [name, *limits])


def _mark_mask(graph: Graph, channels: Sequence[str]) -> str:
    """Compute 1 at the marks and 0 elsewhere."""
    red, green, blue = [
        graph.add("Equal", [name, graph.constant([float(level)])])
        for name, level in zip(channels, _MARK, strict=True)
    ]
    is_mark = graph.add("And", [graph.add("And", [red, green]), blue])
    return graph.as_float(is_mark)


def _pixel_indices(graph: Graph, like: str) -> tuple[str, str]:
    """Compute the column and the row of every pixel."""
    ones = graph.plus(graph.times(like, 0.0), 1.0)
    indices = []
    for axis in (3, 2):
        counts = graph.add("CumSum", [ones, graph.constant(axis, np.int64)])
        indices.append(graph.plus(counts, -1.0))
    column, row = indices
    return column, row


def _raw_rows(graph: Graph, flat: str, n_classes: int) -> str:
    """Convert ``[b, 7, anchors]`` to cx, cy, w, h, one score per class, angle."""
    cx, cy, w, h, score, kind, angle = graph.split(flat, 7, axis=1)
    scores = []
    for index in range(n_classes):
        is_class = graph.add("Equal", [kind, graph.constant([float(index)])])
        scores.append(graph.add("Mul", [score, graph.as_float(is_class)]))
    return graph.add("Concat", [cx, cy, w, h, *scores, angle], axis=1)


def _end_to_end_rows(graph: Graph, flat: str, cap: int) -> str:
    """Convert ``[b, 7, anchors]`` to the ``cap`` best rows."""
    # There are never fewer anchors than rows.
    padded = graph.add("Pad", [flat, graph.constant([0, 0, 0, 0, 0, cap], np.int64)])
    score = _slice(graph, padded, 4, 5, axis=1)
    indices = f"indices{len(graph.nodes)}"
    top = helper.make_node(
        "TopK",
        [score, graph.constant([cap], np.int64)],
        [f"top{len(graph.nodes)}", indices],
        axis=2,
        largest=1,
        sorted=1,
    )
    graph.nodes.append(top)
    wide = graph.add("Tile", [indices, graph.constant([1, 7, 1], np.int64)])
    best = graph.add("GatherElements", [padded, wide], axis=2)
    return graph.add("Transpose", [best], perm=[0, 2, 1])


def save_model(
    path: Path,
    nodes: Sequence[onnx.NodeProto],
    inputs: Sequence[onnx.ValueInfoProto],
    outputs: Sequence[onnx.ValueInfoProto],
    constants: Sequence[onnx.TensorProto],
    metadata: Mapping[str, str | None],
) -> Path:
    """Write a checked ONNX file; None as a metadata value leaves the entry out."""
    graph = helper.make_graph(list(nodes), "test", list(inputs), list(outputs), list(constants))
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", _OPSET)])
    model.ir_version = _IR_VERSION
    entries = {key: value for key, value in metadata.items() if value is not None}
    helper.set_model_props(model, entries)
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, str(path))
    return path
