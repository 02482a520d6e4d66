"""Records together with what they were concluded from, as rulers, pictures and tables look at them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from vehanchor.detection.detections import Detections
    from vehanchor.imagery.metadata.georeference import Ground
    from vehanchor.imagery.sources.opening import ImageSource
    from vehanchor.options import Reading
    from vehanchor.records import AreaMeasurement, DistanceMeasurement, GsdEstimate
    from vehanchor.rulers.evidence import Evidence, Mark
    from vehanchor.rulers.vehicles import VehicleEvidence
    from vehanchor.segmentation.prompt import Prompt
    from vehanchor.segmentation.segmenter import Segmentation


@dataclass(frozen=True, eq=False)
class ScaleFindings:
    """An estimate together with what it was concluded from.

    Attributes:
        estimate: the record.
        vehicles: their evidence, that of those that were dropped included.
        others: the evidence of the other rulers.
        in_image: the vehicles as they are in the image, where the camera looked aside and their evidence has them
            levelled; None where it has them as they are.
        image: where the image can be read again, for pictures; None for a stream.
        reading: how it was read; None for the defaults.
        ground: where on the ground the image lies; None where nothing tells.
    """

    estimate: GsdEstimate
    vehicles: VehicleEvidence
    others: tuple[Evidence, ...] = ()
    in_image: Detections | None = None
    image: ImageSource | None = None
    reading: Reading | None = None
    ground: Ground | None = None

    @property
    def detections(self) -> Detections:
        """All vehicles that were found: ``boxes`` and ``scores``, best first."""
        return self.in_image or self.vehicles.fleet.detections

    @property
    def kept(self) -> NDArray[np.bool_]:
        """``[n]`` bool, which of them the scale was taken from."""
        return self.vehicles.fleet.kept

    @property
    def marks(self) -> tuple[Mark, ...]:
        """What other rulers were laid along, in pixels of the image."""
        return tuple(mark for other in self.others for mark in other.marks)

    @property
    def guard_length_px(self) -> float:
        """``P_thresh`` of the resolution guard."""
        return self.vehicles.guard_length_px

    @property
    def resolved(self) -> float:
        """Share of the pixels' resolution at which there is detail."""
        return self.vehicles.resolved


@dataclass(frozen=True, eq=False, kw_only=True)
class MeasuredFindings:
    """What a measurement came from, whatever was measured.

    Attributes:
        scale: the analysis of the scale; None for one that was given, or given back.
        image: where the image can be read again, for pictures; None for a stream.
        reading: how it was read; None for the defaults.
        ground: where on the ground the image lies; None where nothing tells.
        level: whether one scale holds all over: the camera looked straight down.
    """

    scale: ScaleFindings | None
    image: ImageSource | None = None
    reading: Reading | None = None
    ground: Ground | None = None
    level: bool = True


@dataclass(frozen=True, eq=False)
class AreaFindings(MeasuredFindings):
    """A measurement of an object together with what it came from.

    Attributes:
        measurement: the record.
        segmentation: the mask, and the window of the image it lies in.
        prompt: the box or points, in pixels of the full image.
    """

    measurement: AreaMeasurement
    segmentation: Segmentation
    prompt: Prompt


@dataclass(frozen=True, eq=False)
class DistanceFindings(MeasuredFindings):
    """A measured line together with what its length came from.

    Attributes:
        measurement: the record.
    """

    measurement: DistanceMeasurement
