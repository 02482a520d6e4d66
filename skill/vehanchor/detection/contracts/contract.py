"""The base of all detector contracts: how outputs become boxes, and nothing else."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar, Self

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from vehanchor.detection.detections import Objects


class DetectorContract(ABC):
    """One layout of a detector's outputs.

    Attributes:
        layout: the outputs' shapes, for messages.
        n_classes: of the model; None where the layout does not tell.
    """

    layout: ClassVar[str]
    n_classes: int | None = None

    @classmethod
    @abstractmethod
    def recognise(cls, shapes: Sequence[tuple[int, ...]], named_classes: Collection[int]) -> Self | None:
        """The contract for a model with outputs of these shapes, None where they are of another layout.

        Args:
            shapes: of the outputs for one image.
            named_classes: indices of the classes that the metadata names; may be none.
        """

    @abstractmethod
    def objects(
        self, outputs: Sequence[NDArray[Any]], min_score: float, classes: NDArray[np.intp] | None = None
    ) -> Objects:
        """The objects in the outputs for one image, as the model puts them out: sides in any order, angles unbounded.

        Args:
            outputs: in the order of the shapes.
            min_score: objects below it are left out.
            classes: each object gets the best of these, and the score of that; None stands for all.
        """

    def ran_out(self, outputs: Sequence[NDArray[Any]]) -> bool:
        """Whether the outputs had no room left, so that objects may be missing."""
        del outputs
        return False
