"""Fleet network: predicts the lengths of vehicles from their appearance."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from vehanchor.detection.appearance import CHIP_SHAPE, MAX_CHIPS, FleetAppearance, vehicle_chips
from vehanchor.detection.auxiliary import AuxiliaryModel
from vehanchor.detection.card import FleetCard

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster


class FleetNetwork(AuxiliaryModel[FleetCard]):
    """Network from chips of vehicles ``[n, 1, 16, 24]`` to ``log_odds [n]`` and ``log_length [n]``.

    See ``FleetAppearance`` for the two outputs.
    """

    named = "fleet network"
    trained_by = "research/training/fleet"
    chip_shape = (1, *CHIP_SHAPE)
    outputs: ClassVar = {"log_odds": (), "log_length": ()}
    card_type = FleetCard

    def appearance(self, raster: Raster, boxes: NDArray[np.float64]) -> FleetAppearance:
        """Predict fleet and length of vehicles from their chips.

        Args:
            raster: the image.
            boxes: ``[n, 5]`` in image pixels, best first.

        Returns:
            Predictions for the first m = min(n, 100).
        """
        if len(boxes) == 0:
            return FleetAppearance(np.zeros(0), np.zeros(0))
        return FleetAppearance(*self.predict(vehicle_chips(raster, boxes[:MAX_CHIPS])))
