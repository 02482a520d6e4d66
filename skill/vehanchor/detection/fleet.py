"""The network beside a detector that tells the length of a fleet's vehicles by their look."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.detection.card import read_fleet_card
from vehanchor.detection.look import CHIP_SHAPE, MAX_CHIPS, FleetLook, vehicle_chips
from vehanchor.errors import ModelContractError
from vehanchor.models.files import models_sha256, read_model
from vehanchor.models.session import DEFAULT_PROVIDERS, open_session, run_session

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster

__all__ = ["FleetNetwork"]

_INPUT, _OUTPUTS = "chips", ["log_odds", "log_length"]


class FleetNetwork:
    """A network from chips of vehicles to what they tell of their fleet.

    ``chips [n, 1, 16, 24]`` to ``log_odds [n]`` and ``log_length [n]``, see ``FleetLook``.

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
        if names != [_INPUT, *_OUTPUTS] or inputs[0].shape[1:] != [1, *CHIP_SHAPE]:
            raise ModelContractError(
                f"{self.path} has {', '.join(names)}: expected {_INPUT} [n, 1, {CHIP_SHAPE[0]}, {CHIP_SHAPE[1]}] and "
                f"{' [n], '.join(_OUTPUTS)} [n], as training/fleet writes them"
            )
        metadata = self._session.get_modelmeta().custom_metadata_map
        self.card = read_fleet_card(self.path, models_sha256(file), metadata)

    def look(self, raster: Raster, boxes: NDArray[np.float64]) -> FleetLook:
        """What vehicles tell of their fleet by their look alone.

        Args:
            raster: the image.
            boxes: ``[n, 5]`` in image pixels, best first.

        Returns:
            Of the first m = min(n, 100).
        """
        if len(boxes) == 0:
            return FleetLook(np.zeros(0), np.zeros(0))
        chips = vehicle_chips(raster, boxes[:MAX_CHIPS])
        described = f"the fleet network {self.path} fails on {list(chips.shape)}"
        answers = run_session(self._session, _OUTPUTS, {_INPUT: chips}, None, described)
        odds, lengths = (np.asarray(answer, dtype=np.float64) for answer in answers)
        if not (odds.shape == lengths.shape == (len(chips),) and np.isfinite([odds, lengths]).all()):
            raise ModelContractError(f"the fleet network {self.path} does not give two numbers for each vehicle")
        return FleetLook(odds, lengths)
