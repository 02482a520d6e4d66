"""Base class of rulers."""

from __future__ import annotations

from types import MappingProxyType
from typing import TYPE_CHECKING, ClassVar

if TYPE_CHECKING:
    from collections.abc import Mapping

    from vehanchor.rulers.view import View
    from vehanchor.scale.posterior import Witness


class Ruler:
    """Method to measure the scale of an image.

    Subclasses define ``measure``, and declare these attributes for the rest of the library.

    Attributes:
        kind: name in options and records.
        label: name in messages and pictures, as a noun.
        plural: whether the label is a plural.
        help: what the ruler needs, for the help of ``--rulers``.
        colour: of its curve in plots, ``#rrggbb``.
        pooling_gain: n photographs of a flight count as n to this power: 0 if all have the same error, 1 if their
            errors are independent. None: it measures the boxes of all photographs together.
        needs_search: it measures detections, so that the detector must run.
        reads_metadata: it is left out if the caller forbids metadata.
        uses_plane: it measures on ``View.plane``. If False, it is left out in a tilted view.
        measured_last: ``View.expected``, by the rulers before it, tells it cars from parts of cars in a tilted view.
        sets_scale: it can set the scale by itself. If False, it is a prior, which only weighs other rulers.
        of_flights: it measures the photographs of a flight together, never a single image.
        stored_classes: classes of its witnesses by their names in journals; a name never changes.
    """

    kind: ClassVar[str]
    label: ClassVar[str]
    help: ClassVar[str]
    plural: ClassVar[bool] = False
    colour: ClassVar[str] = "#8C6D31"
    pooling_gain: ClassVar[float | None] = 0.5
    needs_search: ClassVar[bool] = False
    reads_metadata: ClassVar[bool] = False
    uses_plane: ClassVar[bool] = False
    measured_last: ClassVar[bool] = False
    sets_scale: ClassVar[bool] = True
    of_flights: ClassVar[bool] = False
    stored_classes: ClassVar[Mapping[str, type[Witness]]] = MappingProxyType({})

    def measure(self, view: View) -> Witness | None:
        """Measure the scale; in a tilted view, the scale of the image's centre.

        Args:
            view: of the image.

        Returns:
            The witness, or ``unusable`` with the reason; None if there is nothing to say.
        """
        raise NotImplementedError

    @classmethod
    def says(cls) -> str:
        """Begin a sentence, as "the courts say"."""
        return f"the {cls.label} {'say' if cls.plural else 'says'}"
