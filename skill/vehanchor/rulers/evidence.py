"""Input and output of a ruler: ``View`` and ``Evidence``.

To add a ruler, subclass ``vehanchor.rulers.ruler.Ruler`` in a file of its own and name it in
``vehanchor.records.ruler_kinds``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import ArrayLike, NDArray

    from vehanchor.detection.card import DetectorCard
    from vehanchor.detection.detections import Detections
    from vehanchor.detection.scene_scale import SceneScalePrior
    from vehanchor.imagery.facts import ImageFacts
    from vehanchor.imagery.raster import Raster
    from vehanchor.models.runtime import Runtime
    from vehanchor.options import Basis, ScaleOptions
    from vehanchor.records import Notice
    from vehanchor.scale.lengths import Interval
    from vehanchor.scale.plane import GroundPlane
    from vehanchor.tilt.camera_tilt import CameraTilt


@dataclass(frozen=True, eq=False)
class View:
    """Input of a ruler.

    Attributes:
        image: facts of the image.
        detections: result of the search.
        card: of the detector.
        options: all options of the method.
        resolved_share: function of centres ``[n, 2]`` in pixels and the scale where they were found; it gives the share
            of the resolution at which there is detail (``vehanchor.imagery.detail``).
        raster: the open image, for a ruler that reads pixels; None if only search results are kept.
        runtime: runtime of a ruler's own model.
        prior: the scene-scale prior; None without one.
        tilt: of the camera; None for an image taken at nadir, or of unknown tilt.
        found: results of ``Ruler.find`` by kind of ruler.
        expected: ``[g]`` density of the scale in a tilted view, from rulers that do not depend on vehicles; None
            without any.
    """

    image: ImageFacts
    detections: Detections
    card: DetectorCard
    options: ScaleOptions
    resolved_share: Callable[[NDArray[np.float64], float], float]
    raster: Raster | None = None
    runtime: Runtime | None = None
    prior: SceneScalePrior | None = None
    tilt: CameraTilt | None = None
    found: Mapping[str, tuple[Any, ...]] = field(default_factory=dict)
    expected: NDArray[np.float64] | None = None

    @cached_property
    def plane(self) -> GroundPlane | None:
        """Ground plane of a tilted view, with one metre per pixel at the image's centre; None at nadir."""
        return None if self.tilt is None else self.tilt.plane(self.image)

    def rectified(self, points: ArrayLike) -> NDArray[np.float64]:
        """Rectify points ``[n, 2]`` of the image to nadir and to the scale of its centre.

        Returns:
            ``[n, 2]`` pixels with an arbitrary origin. At nadir the points themselves.

        Raises:
            TooObliqueError: a point is above the horizon, or just below it.
        """
        places = np.asarray(points, dtype=np.float64)
        return places if self.plane is None else self.plane.from_above(places)

    def at_nadir(self) -> View:
        """Copy the view without its tilt."""
        return replace(self, tilt=None)


class Mark(NamedTuple):
    """Measured line of a ruler, or a labelled place.

    Attributes:
        points: its corners, x and y in pixels of the image; a single point is a place.
        label: text beside its middle, as "60 m"; empty for none.
        closed: whether the last corner is connected to the first.
    """

    points: tuple[tuple[float, float], ...]
    label: str = ""
    closed: bool = False

    @classmethod
    def of_height(cls, image: ImageFacts, height_m: float) -> Mark:
        """Mark the height of the camera in the middle of the image."""
        return cls(((image.width_px / 2, image.height_px / 2),), f"{height_m:.4g} m up")


class Fact(NamedTuple):
    """Fact about the scale from the caller.

    Attributes:
        name: noun with its value, as "known length of 60 m".
        basis: how the fact is known.
        gsd_m_per_px: scale by this fact alone.
        interval: its 95 % interval.
        chance: 0..1, chance of an error below 20 % by this fact alone.
        family: facts of one family are recognised together, and may be wrong together; empty for an independent fact.
    """

    name: str
    basis: Basis
    gsd_m_per_px: float
    interval: Interval
    chance: float
    family: str = ""


@dataclass(frozen=True, eq=False)
class Evidence:
    """Result of one ruler.

    Attributes:
        kind: of the ruler.
        gsd_m_per_px: metres per pixel of the full image, at its centre in a tilted view; None if nothing was found.
        interval: the 95 % interval around it, metres per pixel; None if nothing was found.
        n: number of things measured.
        confidence: in 0..1; 0 if nothing was found, and for a prior.
        notices: warnings.
        density: probabilities on ``vehanchor.scale.fusion.GRID``; None without any.
        explanation: the measurement in a sentence; None if not needed.
        marks: measured lines, for pictures.
        facts: facts from the caller behind it; empty for a ruler that measures the image.
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
    facts: tuple[Fact, ...] = ()

    @property
    def fusable_density(self) -> NDArray[np.float64] | None:
        """Density to multiply with those of other rulers; None without any."""
        return self.density

    @property
    def sets_scale(self) -> bool:
        """Whether the ruler can set a scale by itself; a prior cannot."""
        return self.gsd_m_per_px is not None and self.confidence > 0
