"""Base of all detector contracts: conversion of a model's outputs to boxes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar, Self

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from vehanchor.detection.detections import Objects


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
    def recognise(cls, shapes: Sequence[tuple[int, ...]], named_classes: Collection[int]) -> Self | None:
        """Create the contract for a model with outputs of these shapes; None for another layout.

        Args:
            shapes: shapes of the outputs for one image.
            named_classes: indices of the classes that the metadata names; may be empty.
        """

    @abstractmethod
    def objects(
        self, outputs: Sequence[NDArray[Any]], min_score: float, classes: NDArray[np.intp] | None = None
    ) -> Objects:
        """Read the objects from the outputs for one image; sides may be in any order, angles unbounded.

        Args:
            outputs: in the order of the shapes.
            min_score: objects with a lower score are left out.
            classes: each object gets the best of these classes with its score; None for all classes.
        """

    def ran_out(self, outputs: Sequence[NDArray[Any]]) -> bool:
        """Test whether the outputs are full, so that objects may be missing."""
        del outputs
        return False
