"""Input of a ruler. Its output is a ``vehanchor.scale.posterior.Witness``.

To add a ruler, subclass ``vehanchor.rulers.ruler.Ruler`` in a file of its own and name it in
``vehanchor.records.ruler_kinds``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.scale.posterior import Mark

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import ArrayLike, NDArray

    from vehanchor.detection.card import DetectorCard
    from vehanchor.detection.detections import Detections
    from vehanchor.detection.scene_scale import SceneScalePrior
    from vehanchor.imagery.facts import ImageFacts
    from vehanchor.imagery.raster import Raster
    from vehanchor.models.runtime import Runtime
    from vehanchor.options import ScaleOptions
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


def mark_of_height(image: ImageFacts, height_m: float) -> Mark:
    """Mark the height of the camera in the middle of the image."""
    return Mark(((image.width_px / 2, image.height_px / 2),), f"{height_m:.4g} m up")
