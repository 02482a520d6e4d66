"""Auxiliary models: small networks that run on chips of a detector's boxes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Generic, TypeVar

import numpy as np

from vehanchor.detection.card import AuxiliaryCard, read_card
from vehanchor.errors import ModelContractError
from vehanchor.models.files import models_sha256, read_model
from vehanchor.models.runtime import LoadedModel, Runtime
from vehanchor.models.session import open_session, run_session

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

_CardT = TypeVar("_CardT", bound=AuxiliaryCard)
_INPUT = "chips"


class AuxiliaryModel(LoadedModel, Generic[_CardT]):
    """Network from ``chips [n, c, h, w]`` float32 to outputs with a row for each chip.

    Args:
        path: the ONNX file.
        runtime: how to open it; None for the defaults.

    Attributes:
        path: the ONNX file.
        card: model card.

    Raises:
        ModelNotFoundError: there is no such file.
        ModelContractError: the file is another kind of network, or its metadata are incomplete.
        ProviderUnavailableError: an execution provider is not installed.
    """

    named: ClassVar[str]
    trained_by: ClassVar[str]
    chip_shape: ClassVar[tuple[int, int, int]]
    outputs: ClassVar[Mapping[str, tuple[int, ...]]]  # names, and shapes of a row
    card_type: ClassVar[type[AuxiliaryCard]]

    card: _CardT

    def __init__(self, path: str | Path, *, runtime: Runtime | None = None) -> None:
        self.path, self.runtime = Path(path), runtime or Runtime()
        file = read_model(self.path)
        self._session = open_session(self.path, content=file.content, runtime=self.runtime)
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        names = [each.name for each in (*inputs, *outputs)]
        if names != [_INPUT, *self.outputs] or tuple(inputs[0].shape[1:]) != self.chip_shape:
            channels, height, width = self.chip_shape
            raise ModelContractError(
                f"{self.path} has {', '.join(names)}: expected {_INPUT} [n, {channels}, {height}, {width}] and "
                f"{', '.join(self.outputs)}, as {self.trained_by} writes them"
            )
        metadata = self._session.get_modelmeta().custom_metadata_map
        self.card = read_card(self.card_type, self.path, models_sha256(file), metadata)  # type: ignore[assignment]

    def predict(self, chips: NDArray[np.uint8]) -> list[NDArray[np.float64]]:
        """Run the network on chips.

        Args:
            chips: ``[n, h, w, 3]`` uint8 RGB.

        Returns:
            The outputs in their order, ``[n, ...]`` each.

        Raises:
            ModelContractError: the network fails, or does not give finite numbers for each chip.
            OutOfMemoryError: there is too little memory for it now.
        """
        planes = np.ascontiguousarray(chips.transpose(0, 3, 1, 2))
        batch: NDArray[np.float32] = np.divide(planes, np.float32(255), dtype=np.float32)
        described = f"the {self.named} {self.path} fails on {list(batch.shape)}"
        results = run_session(self._session, list(self.outputs), {_INPUT: batch}, self.runtime, described)
        numbers = [np.asarray(each, np.float64) for each in results]
        shapes = [(len(chips), *shape) for shape in self.outputs.values()]
        if [each.shape for each in numbers] != shapes or not all(np.isfinite(each).all() for each in numbers):
            raise ModelContractError(f"the {self.named} {self.path} does not give numbers for each of its chips")
        return numbers
