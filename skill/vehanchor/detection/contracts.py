"""Output layouts of oriented-box detectors, recognised by the shapes of the outputs, and the classes of vehicles.

=============  ==============================
========================================================================= contract       output
exported by =============  ==============================
========================================================================= ``Raw``        ``[1,
4+classes+1, anchors]``   Ultralytics (YOLOv8, YOLO11 OBB), and the bundled detector ``EndToEnd``
``[1, n, 7]``                   Ultralytics with ``nms=True``, or YOLO26 OBB =============
==============================
=========================================================================

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

_VEHICLE_NAMES = ("small vehicle", "car", "vehicle")  # the first that the model has is used
_DOTA_NAMES = (
    "plane", "ship", "storage "
        "tank", "baseball diamond", "tennis court", "basketball court", "ground track field",
    "harbor", "bridge", "large "
        "vehicle", "small vehicle", "helicopter", "roundabout", "soccer ball field",
    "swimming pool",
)  # fmt: skip
_FIRST_SCORE = 4  # after cx, cy, w, h
_FEATURES = _FIRST_SCORE + 1  # cx, cy, w, h and the angle, which is last
_END_TO_END_WIDTH = 7
_MOST_CLASSES = 1 << 31  # the comparison also drops NaN
_LEAST_SCORE = 1e-9  # padding has 0


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
        """Read the objects from the outputs for one image; sides may be in any order, angles unbounded.

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
    """Layout ``[1, 4+classes+1, anchors]``: a column is cx, cy, w, h, a score for each class, angle.

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
        """Recognise the layout by the class names in the metadata, else because anchors outnumber the scores."""
        shape = shapes[0]
        if len(shape) != 3:
            return None
        n_classes = shape[1] - _FEATURES
        if named_classes:
            # A column has one score for every class from 0 on; any other index would address
            # another value.
            return cls(n_classes) if set(named_classes) == set(range(n_classes)) else None
        return (
            cls(n_classes) if n_classes >= 1 and shape[1] < shape[2] != _END_TO_END_WIDTH else None
        )

    def objects(
        self,
        outputs: Sequence[NDArray[Any]],
        min_score: float,
        classes: NDArray[np.intp] | None = None,
    ) -> Objects:
        """Read the columns; see ``DetectorContract.objects``."""
        output = outputs[0][0]
        indices = np.arange(self.n_classes) if classes is None else classes
        scores = output[_FIRST_SCORE + indices]
        best = scores[0] if len(scores) == 1 else scores.max(axis=0)
        wanted = np.flatnonzero(best >= min_score)
        return Objects(
            output[:, wanted][[0, 1, 2, 3, -1]].T.astype(np.float64),
            best[wanted].astype(np.float64),
            indices[scores[:, wanted].argmax(axis=0)],
        )


class EndToEnd(DetectorContract):
    """Layout ``[1, n, 7]``: a row is cx, cy, w, h, score, class, angle, padded with zeros to n (300 in practice)."""

    layout = "[1, n, 7]"

    @classmethod
    def recognise(
        cls, shapes: Sequence[tuple[int, ...]], named_classes: Collection[int]
    ) -> EndToEnd | None:
        """Recognise rows of seven values; see ``DetectorContract.recognise``."""
        del named_classes
        return cls() if len(shapes[0]) == 3 and shapes[0][2] == _END_TO_END_WIDTH else None

    def objects(
        self,
        outputs: Sequence[NDArray[Any]],
        min_score: float,
        classes: NDArray[np.intp] | None = None,
    ) -> Objects:
        """Read the rows; see ``DetectorContract.objects``."""
        table = outputs[0][0].astype(np.float64)
        found = table[
            (table[:, 4] >= max(min_score, _LEAST_SCORE)) & (np.abs(table[:, 5]) < _MOST_CLASSES)
        ]
        if classes is not None:
            found = found[np.isin(found[:, 5].astype(np.intp), classes)]
        return Objects(found[:, [0, 1, 2, 3, 6]], found[:, 4], found[:, 5].astype(np.intp))

    def ran_out(self, outputs: Sequence[NDArray[Any]]) -> bool:
        """Test whether no row is padding; see ``DetectorContract.ran_out``."""
        scores = outputs[0][0][:, 4]
        return bool(len(scores) and (scores > 0).all())


CONTRACTS: tuple[type[DetectorContract], ...] = (Raw, EndToEnd)


def recognise_contract(
    shapes: Sequence[tuple[int, ...]], named_classes: Collection[int]
) -> DetectorContract:
    """Recognise the contract of a model by its outputs; arguments as in ``DetectorContract.recognise``.

    Returns:
        The first of ``CONTRACTS`` that recognises the shapes.

    Raises:
        ModelContractError: no contract recognises the shapes.
    """
    for kind in CONTRACTS:
        contract = kind.recognise(shapes, named_classes)
        if contract is not None:
            return contract
    raise ModelContractError(
        f"its outputs have shapes {', '.join(str(list(shape)) for shape in shapes)}, with "
        f"{len(named_classes)} class "
        f"names in the metadata; expected {' or '.join(kind.layout for kind in CONTRACTS)}"
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
        if not wanted:
            raise InvalidParameterError("classes is empty: name at least one, or leave it out")
        return np.unique(
            np.array(
                [i for each in wanted for i in _indices_of(each, names, n_classes)], dtype=np.intp
            )
        )
    for name in _VEHICLE_NAMES:
        matching = [index for index, known in names.items() if known == name]
        if matching:
            return np.unique(np.array(matching, dtype=np.intp))
    if len(names) == 1 or n_classes == 1:
        return np.array([next(iter(names), 0)], dtype=np.intp)
    listed = ", ".join(class_names.values()) or "no names"
    raise ModelContractError(
        f"no class is a small vehicle (it has {listed}); name the classes to use with classes=[...]"
    )


def _canonical_name(name: str) -> str:
    return name.lower().replace("-", " ").replace("_", " ").strip()


def _indices_of(wanted: str | int, names: Mapping[int, str], n_classes: int | None) -> list[int]:
    if isinstance(wanted, int):
        known = (
            wanted in names if names else wanted >= 0 and (n_classes is None or wanted < n_classes)
        )
        found = [wanted] if known else []
    else:
        found = [index for index, name in names.items() if name == _canonical_name(wanted)]
    if not found:
        raise InvalidParameterError(
            f"class {wanted!r} is not in the model; it has "
            f"{dict(names) or f'{n_classes or 0} without names'}"
        )
    return found
