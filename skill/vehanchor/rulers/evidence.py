"""The seam for rulers: what a ruler is shown, and what it answers.

A ruler sees the image and what was found in it, never another ruler, and answers with evidence: a scale with its
interval, what that stands on, and its doubts. One that finds nothing says so (``gsd_m_per_px`` None), it never guesses.
To add one, write a class that is an ``Ruler`` into a file of its own and name it in ``vehanchor.rulers.registry``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol

from vehanchor.storage.stored import stored

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.typing import NDArray

    from vehanchor.detection.card import DetectorCard
    from vehanchor.detection.detections import Detections
    from vehanchor.imagery.metadata.camera import CameraMetadata
    from vehanchor.imagery.raster import Raster
    from vehanchor.models.runtime import Runtime
    from vehanchor.options import ScaleOptions
    from vehanchor.records import Notice
    from vehanchor.scale.lengths import Interval


@stored("image_facts")
class ImageFacts(NamedTuple):
    """Facts of an image that need no look at its pixels.

    Attributes:
        width_px: columns.
        height_px: rows.
        georeference_gsd_m_per_px: the scale that the file itself carries; None where it has none.
        notices: what there was to tell when it was read.
        camera: what the file says of its camera; None where it says nothing.
        image_id: checksum of the pixels; empty where nobody summed them up.
    """

    width_px: int
    height_px: int
    georeference_gsd_m_per_px: float | None = None
    notices: tuple[Notice, ...] = ()
    camera: CameraMetadata | None = None
    image_id: str = ""


@dataclass(frozen=True, eq=False)
class View:
    """All that a ruler is shown.

    Attributes:
        image: facts of the image.
        detections: what the search found in it.
        card: of the model that found it.
        options: every choice of the method.
        resolved_share: of centres ``[n, 2]`` in pixels and the scale at which they were found: the share of the
            resolution down to which there is detail (``vehanchor.imagery.detail``).
        raster: the open image, for a ruler that looks at pixels; None where only what a search has found is kept.
        runtime: how a ruler's own model runs, as the detector does.
    """

    image: ImageFacts
    detections: Detections
    card: DetectorCard
    options: ScaleOptions
    resolved_share: Callable[[NDArray[np.float64], float], float]
    raster: Raster | None = None
    runtime: Runtime | None = None


@stored("mark")
class Mark(NamedTuple):
    """A line that a ruler was laid along, or the place for which it speaks.

    Attributes:
        points: its corners, x and y in pixels of the image; one alone is a place.
        label: what is written beside its middle, as "60 m"; empty for nothing.
        closed: whether the last corner is joined to the first.
    """

    points: tuple[tuple[float, float], ...]
    label: str = ""
    closed: bool = False

    @classmethod
    def of_height(cls, image: ImageFacts, height_m: float) -> Mark:
        """The height of the camera, in the middle of the image."""
        return cls(((image.width_px / 2, image.height_px / 2),), f"{height_m:.4g} m up")


@stored("evidence")
@dataclass(frozen=True, eq=False)
class Evidence:
    """One ruler's answer.

    Attributes:
        kind: of the ruler.
        gsd_m_per_px: metres per pixel of the full image; None where it found nothing.
        interval: the 95 % interval around it, metres per pixel; None where it found nothing.
        n: how many things it was measured on.
        confidence: in 0..1, 0 where it found nothing.
        notices: its doubts, and what else there is to tell.
        density: probabilities on ``vehanchor.scale.fusion.GRID``; None for nothing that could be multiplied.
        explanation: what it was measured by, in a sentence; None where there is no more to say than the numbers do.
        marks: what it was measured on, for pictures.
    """

    kind: str
    gsd_m_per_px: float | None
    interval: Interval | None
    n: int
    confidence: float
    notices: tuple[Notice, ...]
    density: NDArray[np.float64] | None = None
    explanation: str | None = None
    marks: tuple[Mark, ...] = ()

    @property
    def fusable_density(self) -> NDArray[np.float64] | None:
        """The density that is multiplied with those of other rulers; None for none."""
        return self.density


class Ruler(Protocol):
    """A ruler."""

    @property
    def kind(self) -> str:
        """Name in records and options."""

    def look(self, view: View) -> Evidence:
        """Say what this ruler tells of the image's scale."""
