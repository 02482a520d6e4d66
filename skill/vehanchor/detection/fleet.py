"""The network beside a detector that tells the length of a fleet's vehicles by their look."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vehanchor.detection.appearance import CHIP_SHAPE, MAX_CHIPS, FleetAppearance, vehicle_chips
from vehanchor.detection.auxiliary import AuxiliaryModel
from vehanchor.detection.card import FleetCard

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster


class FleetNetwork(AuxiliaryModel[FleetCard]):
    """A network from chips of vehicles to what they tell of their fleet.

    ``chips [n, 1, 16, 24]`` to ``log_odds [n]`` and ``log_length [n]``, see ``FleetAppearance``.
    """

    named = "fleet network"
    trained_by = "research/training/fleet"
    chip_shape = (1, *CHIP_SHAPE)
    outputs = ("log_odds", "log_length")
    card_type = FleetCard

    def look(self, raster: Raster, boxes: NDArray[np.float64]) -> FleetAppearance:
        """What vehicles tell of their fleet by their look alone.

        Args:
            raster: the image.
            boxes: ``[n, 5]`` in image pixels, best first.

        Returns:
            Of the first m = min(n, 100).
        """
        if len(boxes) == 0:
            return FleetAppearance(np.zeros(0), np.zeros(0))
        return FleetAppearance(*self.answers(vehicle_chips(raster, boxes[:MAX_CHIPS])))
