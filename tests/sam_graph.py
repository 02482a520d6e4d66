"""Parts of the tiny ONNX graphs of ``tests.sam_models``: arithmetic and the object's logits."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
import onnx
from onnx import TensorProto, helper

from tests.models import Graph, save_model

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

Content = Literal["object", "empty", "full"]
OBJECT: Content = "object"
EMPTY: Content = "empty"
FULL: Content = "full"
Tensor = tuple[int, "Sequence[Any]"]
"""Element type and shape of an input or output."""

FLOAT = TensorProto.FLOAT
INT64 = TensorProto.INT64
# Labels of SAM's points.
TOP_LEFT = 2
BOTTOM_RIGHT = 3
_OUTSIDE = 0
_ON_OBJECT = 1
# Bound of a prompt that is missing.
_NO_BOUND = 1e4
# Colours with a smaller difference in their worst channel are alike; levels 0..255.
_ALIKE = 30.0
# Logits of the candidates that do not show the object.
_LEVELS: dict[Content, float] = {EMPTY: -1.0, FULL: 1.0}


class SamGraph(Graph):
    """Graph with the arithmetic of the segmenters; each method returns the name of its result."""

    def ints(self, *values: int) -> str:
        return self.constant(list(values), np.int64)

    def as_ints(self, name: str) -> str:
        return self.add("Cast", [name], to=INT64)

    def as_floats(self, name: str) -> str:
        return self.add("Cast", [name], to=FLOAT)

    def sum(self, first: str, second: str) -> str:
        return self.add("Add", [first, second])

    def difference(self, first: str, second: str) -> str:
        return self.add("Sub", [first, second])

    def product(self, first: str, second: str) -> str:
        return self.add("Mul", [first, second])

    def ratio(self, first: str, second: str) -> str:
        return self.add("Div", [first, second])

    def shifted(self, name: str, offset: float) -> str:
        return self.sum(name, self.constant([offset]))

    def scaled(self, name: str, factor: float) -> str:
        return self.product(name, self.constant([float(factor)]))

    def total(self, name: str, *axes: int) -> str:
        return self.add("ReduceSum", [name, self.ints(*axes)], keepdims=1)

    def at_most(self, name: str, limit: float) -> str:
        return self.add("Min", [name, self.constant([limit])])

    def at_least(self, name: str, limit: float) -> str:
        return self.add("Max", [name, self.constant([limit])])

    def reshaped(self, name: str, *shape: int) -> str:
        return self.add("Reshape", [name, self.ints(*shape)])

    def joined(self, *names: str, axis: int) -> str:
        return self.add("Concat", list(names), axis=axis)

    def with_axis(self, name: str, axis: int, *, output: str | None = None) -> str:
        return self.add("Unsqueeze", [name, self.ints(axis)], output=output)

    def shape_of(self, name: str, first: int, last: int) -> str:
        """Some sides of a tensor, from ``first`` to before ``last``."""
        shape = self.add("Shape", [name])
        return self.add("Slice", [shape, self.ints(first), self.ints(last)])

    def size(self, width: int, height: int) -> str:
        """A size as ONNX's operators take it: rows, then columns."""
        return self.ints(height, width)


def embed(graph: SamGraph, image: str, *, cell_px: int, block: int, output: str) -> None:
    """Average ``[1, 3, s, s]`` over cells; fold blocks of cells into channels."""
    square = [cell_px, cell_px]
    pooled = graph.add("AveragePool", [image], kernel_shape=square, strides=square)
    if block > 1:
        graph.add("SpaceToDepth", [pooled], blocksize=block, output=output)
    else:
        graph.add("Identity", [pooled], output=output)


def denormalised(graph: SamGraph, cells: str, *, mean: Sequence[float], sd: Sequence[float]) -> str:
    """Undo a normalisation of ``[1, 3, rows, columns]``, back to 0..255."""
    spread = graph.constant(np.reshape(sd, (1, 3, 1, 1)))
    centre = graph.constant(np.reshape(mean, (1, 3, 1, 1)))
    return graph.sum(graph.product(cells, spread), centre)


class _Prompt(NamedTuple):
    """Points of a prompt, ``[n, 1, 1, 1]`` each, in pixels of the model's input."""

    x: str
    y: str
    label: str


class _Grid(NamedTuple):
    """Centres of all cells, ``[1, 1, rows, columns]`` each, in pixels of the model's input."""

    x: str
    y: str
    cell_px: int


def object_logits(graph: SamGraph, colours: str, *, coords: str, labels: str, cell_px: int) -> str:
    """Compute the object's logits ``[1, 1, rows, columns]``.

    Args:
        graph: graph of a decoder.
        colours: ``[1, 3, rows, columns]`` mean colours of the cells, 0..255.
        coords: ``[1, n, 2]`` x and y of the prompt's points.
        labels: ``[1, n]``.
        cell_px: side of a cell.
    """
    grid = _grid_like(graph, colours, cell_px)
    x, y = graph.split(coords, 2, axis=2)
    prompt = _Prompt(
        x=graph.reshaped(x, -1, 1, 1, 1),
        y=graph.reshaped(y, -1, 1, 1, 1),
        label=graph.reshaped(labels, -1, 1, 1, 1),
    )
    is_top_left = _labelled(graph, prompt, TOP_LEFT)
    is_bottom_right = _labelled(graph, prompt, BOTTOM_RIGHT)
    x1 = graph.total(graph.product(prompt.x, is_top_left), 0)
    y1 = graph.total(graph.product(prompt.y, is_top_left), 0)
    x2 = graph.total(graph.product(prompt.x, is_bottom_right), 0)
    y2 = graph.total(graph.product(prompt.y, is_bottom_right), 0)
    has_box = graph.total(is_top_left, 0)
    is_on_object = _labelled(graph, prompt, _ON_OBJECT)
    is_outside = _labelled(graph, prompt, _OUTSIDE)

    # How far a cell's centre is inside the box; beside points the box is a cell wider.
    depths = [
        graph.difference(grid.x, x1),
        graph.difference(x2, grid.x),
        graph.difference(grid.y, y1),
        graph.difference(y2, grid.y),
    ]
    has_point = graph.at_most(graph.total(is_on_object, 0), 1.0)
    inside_box = graph.sum(graph.add("Min", depths), graph.scaled(has_point, cell_px))

    # The cells whose colours show the object: at its points, or at the box's middle.
    at_points = _cells_at(graph, grid, prompt.x, prompt.y)
    middle_x = graph.scaled(graph.sum(x1, x2), 0.5)
    middle_y = graph.scaled(graph.sum(y1, y2), 0.5)
    at_middle = graph.product(_cells_at(graph, grid, middle_x, middle_y), has_box)
    at_object = graph.sum(graph.total(graph.product(at_points, is_on_object), 0), at_middle)
    # Those whose colours it does not have.
    at_others = graph.total(graph.product(at_points, is_outside), 0)
    has_others = graph.at_most(graph.total(at_others, 2, 3), 1.0)

    like_object = _likeness(graph, colours, at_object, cell_px)
    unlike_others = graph.add("Neg", [_likeness(graph, colours, at_others, cell_px)])
    bounds = [
        _bound_if(graph, has_box, inside_box),
        like_object,
        _bound_if(graph, has_others, unlike_others),
    ]
    return graph.add("Min", bounds)


def _grid_like(graph: SamGraph, colours: str, cell_px: int) -> _Grid:
    plane = graph.split(colours, 3, axis=1)[0]
    ones = graph.shifted(graph.scaled(plane, 0.0), 1.0)
    centres = []
    for axis in (3, 2):
        numbers = graph.add("CumSum", [ones, graph.constant(axis, np.int64)])
        centres.append(graph.scaled(graph.shifted(numbers, -0.5), cell_px))
    return _Grid(centres[0], centres[1], cell_px)


def _labelled(graph: SamGraph, prompt: _Prompt, label: int) -> str:
    """``[n, 1, 1, 1]``, 1 for the points with a label, else 0."""
    return graph.as_floats(graph.add("Equal", [prompt.label, graph.constant([float(label)])]))


def _cells_at(graph: SamGraph, grid: _Grid, x: str, y: str) -> str:
    """``[n, 1, rows, columns]``, 1 for the cells that contain a point, else 0."""
    half = graph.constant([grid.cell_px / 2])
    offset_x = graph.add("Abs", [graph.difference(grid.x, x)])
    offset_y = graph.add("Abs", [graph.difference(grid.y, y)])
    near_x = graph.add("LessOrEqual", [offset_x, half])
    near_y = graph.add("LessOrEqual", [offset_y, half])
    return graph.as_floats(graph.add("And", [near_x, near_y]))


def _likeness(graph: SamGraph, colours: str, weight: str, cell_px: int) -> str:
    """Compare all colours with the weighted mean: a cell's side where alike, else minus as much."""
    weight_sum = graph.at_least(graph.total(weight, 2, 3), 1e-6)
    mean_colour = graph.ratio(graph.total(graph.product(colours, weight), 2, 3), weight_sum)
    differences = graph.add("Abs", [graph.difference(colours, mean_colour)])
    largest = graph.add("ReduceMax", [differences], axes=[1], keepdims=1)
    margin = graph.difference(graph.constant([_ALIKE]), largest)
    # Steep, so that nearly all colours reach a limit.
    steep = graph.scaled(margin, cell_px / 10)
    limits = [graph.constant(-float(cell_px)), graph.constant(float(cell_px))]
    return graph.add("Clip", [steep, *limits])


def _bound_if(graph: SamGraph, is_there: str, bound: str) -> str:
    """Return a bound if its prompt is there (1), else one that excludes nothing (0)."""
    present = graph.product(bound, is_there)
    missing = graph.difference(graph.constant([1.0]), is_there)
    return graph.sum(present, graph.scaled(missing, _NO_BOUND))


def stack_candidates(
    graph: SamGraph, logits: str, masks: Sequence[Content], *, output: str | None = None
) -> str:
    """Stack the candidates to ``[1, m, rows, columns]``."""
    candidates = []
    for content in masks:
        if content == OBJECT:
            candidates.append(logits)
        else:
            candidates.append(graph.shifted(graph.scaled(logits, 0.0), _LEVELS[content]))
    return graph.add("Concat", candidates, axis=1, output=output)


def resized(
    graph: SamGraph, name: str, size: str, channels: int, *, output: str | None = None
) -> str:
    """Resize bilinearly, as PyTorch's ``interpolate`` exports it."""
    sizes = graph.joined(graph.ints(1, channels), size, axis=0)
    return graph.add(
        "Resize",
        [name, "", "", sizes],
        mode="linear",
        coordinate_transformation_mode="half_pixel",
        output=output,
    )


def put_out_scores(
    graph: SamGraph, scores: Sequence[float], *, shape: Sequence[int], output: str
) -> None:
    graph.add("Identity", [graph.constant(np.reshape(scores, shape))], output=output)


def write_graph(
    path: Path,
    graph: SamGraph,
    *,
    inputs: Mapping[str, Tensor],
    outputs: Mapping[str, Tensor],
    metadata: Mapping[str, str] | None = None,
) -> Path:
    return save_model(
        path,
        graph.nodes,
        inputs=_described(inputs),
        outputs=_described(outputs),
        constants=graph.constants,
        metadata=metadata or {},
    )


def _described(tensors: Mapping[str, Tensor]) -> list[onnx.ValueInfoProto]:
    return [
        helper.make_tensor_value_info(name, element, shape)
        for name, (element, shape) in tensors.items()
    ]
