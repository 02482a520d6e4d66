"""The network beside a detector that tells the length of a fleet's vehicles by their look."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vehanchor.detection.card import FleetCard
from vehanchor.detection.companion import Companion
from vehanchor.detection.look import CHIP_SHAPE, MAX_CHIPS, FleetLook, vehicle_chips

if TYPE_CHECKING:
    import onnxruntime
    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster

__all__ = ["FleetNetwork"]


class FleetNetwork(Companion[FleetCard]):
    """A network from chips of vehicles to what they tell of their fleet.

    ``chips [n, 1, 16, 24]`` to ``log_odds [n]`` and ``log_length [n]``, see ``FleetLook``; else as ``Companion``.
    """

    named = "fleet network"
    trained_by = "research/training/fleet"
    chip_shape = (1, *CHIP_SHAPE)
    outputs = ("log_odds", "log_length")
    card_type = FleetCard

    def look(
        self, raster: Raster, boxes: NDArray[np.float64], run_options: onnxruntime.RunOptions | None = None
    ) -> FleetLook:
        """What vehicles tell of their fleet by their look alone.

        Args:
            raster: the image.
            boxes: ``[n, 5]`` in image pixels, best first.
            run_options: see ``Detector.detect_tile``.

        Returns:
            Of the first m = min(n, 100).
        """
        if len(boxes) == 0:
            return FleetLook(np.zeros(0), np.zeros(0))
        return FleetLook(*self.answers(vehicle_chips(raster, boxes[:MAX_CHIPS]), run_options))
