"""The network beside a detector that tells fleets of vehicles apart by their look."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.detection.card import read_fleet_card
from vehanchor.detection.look import CHIP_SHAPE, MAX_CHIPS, vehicle_chips
from vehanchor.errors import ModelContractError
from vehanchor.models.files import models_sha256, read_model
from vehanchor.models.session import DEFAULT_PROVIDERS, open_session, run_session

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster

__all__ = ["FleetNetwork"]

_INPUT, _OUTPUT = "chips", "log_odds"


class FleetNetwork:
    """A network from chips of vehicles to log odds of their fleet: ``chips [n, 1, 16, 24]`` to ``log_odds [n]``.

    Args:
        path: the ONNX file.
        threads: CPU threads; None leaves it to ONNX Runtime.
        providers: ONNX Runtime execution providers in order of preference.

    Attributes:
        path: the ONNX file.
        card: what it says of itself.

    Raises:
        ModelNotFoundError: there is no such file.
        ModelContractError: it is no such network, or does not say for which detector and lengths.
        ProviderUnavailableError: an execution provider is not installed.
    """

    def __init__(
        self, path: str | Path, *, threads: int | None = None, providers: Sequence[str] = DEFAULT_PROVIDERS
    ) -> None:
        self.path = Path(path)
        file = read_model(self.path)
        self._session = open_session(self.path, content=file.content, threads=threads, providers=providers)
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        names = [each.name for each in (*inputs, *outputs)]
        if names != [_INPUT, _OUTPUT] or inputs[0].shape[1:] != [1, *CHIP_SHAPE]:
            raise ModelContractError(
                f"{self.path} has {', '.join(names)}: expected {_INPUT} [n, 1, {CHIP_SHAPE[0]}, {CHIP_SHAPE[1]}] and "
                f"{_OUTPUT} [n], as training/fleet writes them"
            )
        metadata = self._session.get_modelmeta().custom_metadata_map
        self.card = read_fleet_card(self.path, models_sha256(file), metadata)

    def log_odds(self, raster: Raster, boxes: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log odds that vehicles are of North America's fleet, from their look alone.

        Args:
            raster: the image.
            boxes: ``[n, 5]`` in image pixels, best first.

        Returns:
            ``[m]`` float64 of the first m = min(n, 100).
        """
        if len(boxes) == 0:
            return np.zeros(0)
        chips = vehicle_chips(raster, boxes[:MAX_CHIPS])
        described = f"the fleet network {self.path} fails on {list(chips.shape)}"
        odds = np.asarray(run_session(self._session, [_OUTPUT], {_INPUT: chips}, None, described)[0], dtype=np.float64)
        if odds.shape != (len(chips),) or not np.isfinite(odds).all():
            raise ModelContractError(f"the fleet network {self.path} does not give one number for each vehicle")
        return odds
