"""Protocols of the analyses that pictures draw; pictures import no analysis."""

# ruff: noqa: D102 - the analyses document these attributes

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from vehanchor.detection.detections import Detections
    from vehanchor.records import AreaMeasurement, DistanceMeasurement, GsdEstimate
    from vehanchor.rulers.vehicles import VehicleWitness
    from vehanchor.scale.posterior import Answer, Mark, Witness
    from vehanchor.segmentation.prompt import Prompt
    from vehanchor.segmentation.segmenter import Segmentation


class DrawableScale(Protocol):
    """Scale with its evidence; see ``vehanchor.analysis.scale.ScaleAnalysis``."""

    @property
    def estimate(self) -> GsdEstimate: ...
    @property
    def vehicles(self) -> VehicleWitness | None: ...
    @property
    def witnesses(self) -> tuple[Witness, ...]: ...
    @property
    def answer(self) -> Answer | None: ...
    @property
    def detections(self) -> Detections: ...
    @property
    def kept(self) -> NDArray[np.bool_]: ...
    @property
    def marks(self) -> tuple[Mark, ...]: ...


class DrawableMeasurement(Protocol):
    """Area or distance with its scale; see ``vehanchor.analysis.measured``."""

    @property
    def measurement(self) -> AreaMeasurement | DistanceMeasurement: ...
    @property
    def scale(self) -> DrawableScale | None: ...
    @property
    def nadir(self) -> bool: ...


class DrawableDistance(DrawableMeasurement, Protocol):
    """Distance with its scale."""

    @property
    def measurement(self) -> DistanceMeasurement: ...


class DrawableArea(DrawableMeasurement, Protocol):
    """Area with its mask and scale."""

    @property
    def measurement(self) -> AreaMeasurement: ...
    @property
    def segmentation(self) -> Segmentation: ...
    @property
    def prompt(self) -> Prompt: ...
