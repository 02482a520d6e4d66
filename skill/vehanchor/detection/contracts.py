"""Contracts of oriented-box detectors: output layouts, and the classes that are vehicles.

A layout is recognised by the shapes of the outputs:

- ``Raw``: ``[1, 4+classes+1, anchors]``, exported by Ultralytics (YOLOv8 and YOLO11 OBB); also the
  layout of the bundled detector.
- ``EndToEnd``: ``[1, n, 7]``, exported by Ultralytics with ``nms=True``, or from YOLO26 OBB.

To add one, write a subclass of ``DetectorContract`` and add it to ``CONTRACTS``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np

from vehanchor.detection.detections import Objects
from vehanchor.errors import InvalidParameterError, ModelContractError

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from numpy.typing import NDArray

# Names of vehicles; the first that the model has is used.
_VEHICLE_NAMES = ("small vehicle", "car", "vehicle")
# Classes of DOTA v1.0 in the order of Ultralytics' models.
_DOTA_NAMES = (
    "plane",
    "ship",
    "storage tank",
    "baseball diamond",
    "tennis court",
    "basketball court",
    "ground track field",
    "harbor",
    "bridge",
    "large vehicle",
    "small vehicle",
    "helicopter",
    "roundabout",
    "soccer ball field",
    "swimming pool",
)

# A raw column is cx, cy, w, h, the scores, and the angle.
_N_BOX_ROWS = 4
_ROWS_WITHOUT_SCORES = _N_BOX_ROWS + 1
_BOX_ROWS = [0, 1, 2, 3, -1]

# Columns of an end-to-end row.
_END_TO_END_WIDTH = 7
_BOX_COLUMNS = [0, 1, 2, 3, 6]
_SCORE_COLUMN = 4
_CLASS_COLUMN = 5
# Rows of padding have the score 0.
_MIN_SCORE = 1e-9
# Class indices are below; the comparison also drops NaN.
_MAX_CLASSES = 1 << 31


class DetectorContract(ABC):
    """Layout of a detector's outputs.

    Attributes:
        layout: the outputs' shapes, for messages.
        n_classes: number of classes of the model; None if the layout does not show it.
    """

    layout: ClassVar[str]
    n_classes: int | None = None

    @classmethod
    @abstractmethod
    def recognise(
        cls, shapes: Sequence[tuple[int, ...]], named_classes: Collection[int]
    ) -> Self | None:
        """Create the contract for a model with outputs of these shapes; None for another layout.

        Args:
            shapes: shapes of the outputs for one image.
            named_classes: indices of the classes that the metadata names; may be empty.
        """

    @abstractmethod
    def objects(
        self,
        outputs: Sequence[NDArray[Any]],
        min_score: float,
        classes: NDArray[np.intp] | None = None,
    ) -> Objects:
        """Read the objects from the outputs for one image.

        Either side of a box may come first, and angles are unbounded.

        Args:
            outputs: in the order of the shapes.
            min_score: objects with a lower score are left out.
            classes: each object gets the best of these classes with its score; None for all
                classes.
        """

    def ran_out(self, outputs: Sequence[NDArray[Any]]) -> bool:
        """Test whether the outputs are full, so that objects may be missing."""
        del outputs
        return False


class Raw(DetectorContract):
    """Layout ``[1, 4+classes+1, anchors]``: columns of cx, cy, w, h, a score for each class, angle.

    Args:
        n_classes: number of scores in a column.
    """

    layout = "[1, 4+classes+1, anchors]"

    def __init__(self, n_classes: int) -> None:
        self.n_classes: int = n_classes

    @classmethod
    def recognise(
        cls, shapes: Sequence[tuple[int, ...]], named_classes: Collection[int]
    ) -> Raw | None:
        """Recognise the layout by the class names in the metadata, else by the many anchors."""
        shape = shapes[0]
        if len(shape) != 3:
            return None
        _, n_rows, n_anchors = shape
        n_classes = n_rows - _ROWS_WITHOUT_SCORES
        if named_classes:
            # A column has one score for every class from 0 on; any other index would address
            # another value.
            is_raw = set(named_classes) == set(range(n_classes))
        else:
            is_raw = n_classes >= 1 and n_rows < n_anchors != _END_TO_END_WIDTH
        if not is_raw:
            return None
        return cls(n_classes)

    def objects(
        self,
        outputs: Sequence[NDArray[Any]],
        min_score: float,
        classes: NDArray[np.intp] | None = None,
    ) -> Objects:
        """Read the columns; see ``DetectorContract.objects``."""
        output = outputs[0][0]
        indices = classes
        if indices is None:
            indices = np.arange(self.n_classes)
        scores = output[_N_BOX_ROWS + indices]
        # A maximum over one row would only copy it.
        best_scores = scores[0]
        if len(scores) > 1:
            best_scores = scores.max(axis=0)
        columns = np.flatnonzero(best_scores >= min_score)
        best_classes = indices[scores[:, columns].argmax(axis=0)]
        return Objects(
            output[:, columns][_BOX_ROWS].T.astype(np.float64),
            best_scores[columns].astype(np.float64),
            best_classes,
        )


class EndToEnd(DetectorContract):
    """Layout ``[1, n, 7]``: a row is cx, cy, w, h, score, class, angle.

    Rows of zeros pad the table to n, 300 in practice.
    """

    layout = "[1, n, 7]"

    @classmethod
    def recognise(
        cls, shapes: Sequence[tuple[int, ...]], named_classes: Collection[int]
    ) -> EndToEnd | None:
        """Recognise rows of seven values; see ``DetectorContract.recognise``."""
        del named_classes
        shape = shapes[0]
        if len(shape) != 3 or shape[2] != _END_TO_END_WIDTH:
            return None
        return cls()

    def objects(
        self,
        outputs: Sequence[NDArray[Any]],
        min_score: float,
        classes: NDArray[np.intp] | None = None,
    ) -> Objects:
        """Read the rows; see ``DetectorContract.objects``."""
        table = outputs[0][0].astype(np.float64)
        is_certain = table[:, _SCORE_COLUMN] >= max(min_score, _MIN_SCORE)
        has_class = np.abs(table[:, _CLASS_COLUMN]) < _MAX_CLASSES
        rows = table[is_certain & has_class]
        if classes is not None:
            rows = rows[np.isin(rows[:, _CLASS_COLUMN].astype(np.intp), classes)]
        return Objects(
            rows[:, _BOX_COLUMNS],
            rows[:, _SCORE_COLUMN],
            rows[:, _CLASS_COLUMN].astype(np.intp),
        )

    def ran_out(self, outputs: Sequence[NDArray[Any]]) -> bool:
        """Test whether no row is padding; see ``DetectorContract.ran_out``."""
        scores = outputs[0][0][:, _SCORE_COLUMN]
        return bool(len(scores) and (scores > 0).all())


CONTRACTS: tuple[type[DetectorContract], ...] = (Raw, EndToEnd)


def recognise_contract(
    shapes: Sequence[tuple[int, ...]], named_classes: Collection[int]
) -> DetectorContract:
    """Recognise the contract of a model by its outputs.

    Args:
        shapes: as in ``DetectorContract.recognise``.
        named_classes: as in ``DetectorContract.recognise``.

    Returns:
        The first of ``CONTRACTS`` that recognises the shapes.

    Raises:
        ModelContractError: no contract recognises the shapes.
    """
    for kind in CONTRACTS:
        contract = kind.recognise(shapes, named_classes)
        if contract is not None:
            return contract
    stated = ", ".join(str(list(shape)) for shape in shapes)
    expected = " or ".join(kind.layout for kind in CONTRACTS)
    raise ModelContractError(
        f"its outputs have shapes {stated}, with {len(named_classes)} class names in the metadata; "
        f"expected {expected}"
    )


def vehicle_classes(
    class_names: Mapping[int, str], n_classes: int | None, wanted: Sequence[str | int] | None = None
) -> NDArray[np.intp]:
    """Find the indices of the classes that count as vehicles.

    Args:
        class_names: class index to name, from the model's file; fifteen classes without names are
            taken as DOTA's.
        n_classes: number of classes of the model; None if its outputs do not show it.
        wanted: names (in either spelling) or indices; None takes "small vehicle", else "car" or
            "vehicle", else the only class under any name.

    Returns:
        ``[n]`` int, n >= 1, rising.

    Raises:
        InvalidParameterError: the model lacks a wanted class, or ``wanted`` is empty.
        ModelContractError: ``wanted`` is None, and no class of the model is a vehicle.
    """
    names = {index: _canonical_name(name) for index, name in class_names.items()}
    if not names and n_classes == len(_DOTA_NAMES):
        names = dict(enumerate(_DOTA_NAMES))
    if wanted is not None:
        return _wanted_classes(wanted, names, n_classes)
    for vehicle_name in _VEHICLE_NAMES:
        matching = [index for index, name in names.items() if name == vehicle_name]
        if matching:
            return np.unique(np.array(matching, dtype=np.intp))
    if len(names) == 1 or n_classes == 1:
        return np.array([next(iter(names), 0)], dtype=np.intp)
    listed = ", ".join(class_names.values()) or "no names"
    raise ModelContractError(
        f"no class is a small vehicle (it has {listed}); name the classes to use with classes=[...]"
    )


def _canonical_name(name: str) -> str:
    """Convert a class name to lower case with spaces."""
    return name.lower().replace("-", " ").replace("_", " ").strip()


def _wanted_classes(
    wanted: Sequence[str | int], names: Mapping[int, str], n_classes: int | None
) -> NDArray[np.intp]:
    """Find the indices of the classes that the caller wants.

    Raises:
        InvalidParameterError: the model lacks one, or there is none.
    """
    if not wanted:
        raise InvalidParameterError("classes is empty: name at least one, or leave it out")
    indices: list[int] = []
    for name_or_index in wanted:
        matching = _matching_indices(name_or_index, names, n_classes)
        if not matching:
            classes = dict(names) or f"{n_classes or 0} without names"
            raise InvalidParameterError(
                f"class {name_or_index!r} is not in the model; it has {classes}"
            )
        indices += matching
    return np.unique(np.array(indices, dtype=np.intp))


def _matching_indices(
    name_or_index: str | int, names: Mapping[int, str], n_classes: int | None
) -> list[int]:
    """List the indices of the classes with a name or an index; several classes may share a name."""
    if not isinstance(name_or_index, int):
        wanted_name = _canonical_name(name_or_index)
        return [index for index, name in names.items() if name == wanted_name]
    if names:
        exists = name_or_index in names
    else:
        exists = name_or_index >= 0 and (n_classes is None or name_or_index < n_classes)
    return [name_or_index] if exists else []
