"""Results with their evidence, as pictures draw them; the analyses add the image and export."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.imagery.raster import Window
from vehanchor.rulers.vehicles import vehicle_witness

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.detection.detections import Detections
    from vehanchor.options.pixel_grid import PixelGrid
    from vehanchor.records import AreaMeasurement, DistanceMeasurement, GsdEstimate
    from vehanchor.rulers.vehicles import VehicleWitness
    from vehanchor.scale.posterior import Answer, Mark, Witness
    from vehanchor.segmentation.object_mask import ObjectMask
    from vehanchor.segmentation.prompt import Prompt


@dataclass(frozen=True, eq=False, kw_only=True)
class Evidence:
    """Evidence in square pixels; its record has coordinates in pixels of the file.

    Attributes:
        grid: the image's pixels, in its file and square.
    """

    grid: PixelGrid

    @property
    def whole_image(self) -> Window:
        """All of the image, in square pixels."""
        width_px = self.grid.square_width_px
        height_px = self.grid.square_height_px
        return Window(0, 0, width_px=width_px, height_px=height_px)


@dataclass(frozen=True, eq=False)
class ScaleEvidence(Evidence):
    """Estimate with its evidence.

    Attributes:
        estimate: the record.
        witnesses: witnesses of all rulers.
        detections: all detected vehicles, in square pixels of the image: ``boxes`` and ``scores``,
            best first.
        answer: decision on the scale; None without a scale, and in the preset ``paper``.
        part: the part that is a photograph, in square pixels; None if the image is one as it is.
    """

    estimate: GsdEstimate
    witnesses: tuple[Witness, ...]
    detections: Detections
    answer: Answer | None = None
    part: Window | None = None

    @property
    def vehicles(self) -> VehicleWitness | None:
        """Witness of the vehicles; None if the caller excludes them."""
        return vehicle_witness(self.witnesses)

    @property
    def kept(self) -> NDArray[np.bool_]:
        """Mask ``[n]`` of the detections behind the scale; empty if vehicles are excluded."""
        vehicles = self.vehicles
        if vehicles is None:
            return np.zeros(0, dtype=bool)
        return vehicles.fleet.kept

    @property
    def marks(self) -> tuple[Mark, ...]:
        """Lines that rulers measured, in square pixels of the image."""
        return tuple(mark for witness in self.witnesses for mark in witness.marks)


@dataclass(frozen=True, eq=False, kw_only=True)
class MeasurementEvidence(Evidence):
    """Scale of a measurement.

    Attributes:
        scale: the scale with its evidence; None for a known scale.
        nadir: whether the camera points straight down, so that one scale holds everywhere.
    """

    scale: ScaleEvidence | None
    nadir: bool = True


@dataclass(frozen=True, eq=False)
class AreaEvidence(MeasurementEvidence):
    """Area with its evidence.

    Attributes:
        measurement: the record.
        segmentation: the mask, and its window in the image, in square pixels.
        prompt: the box or points, in square pixels of the full image; empty for a shape of the
            caller.
    """

    measurement: AreaMeasurement
    segmentation: ObjectMask
    prompt: Prompt


@dataclass(frozen=True, eq=False)
class DistanceEvidence(MeasurementEvidence):
    """Distance with its evidence.

    Attributes:
        measurement: the record.
    """

    measurement: DistanceMeasurement

    @property
    def path(self) -> NDArray[np.float64]:
        """Points of the line, ``[n, 2]`` square pixels of the image."""
        points = [(point.x_px, point.y_px) for point in self.measurement.path]
        return self.grid.to_square(points)
