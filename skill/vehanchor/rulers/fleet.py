"""Fleet of an image: the vehicles behind its scale."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.scale.defaults import CAR_LENGTH_M
from vehanchor.scale.density import GRID
from vehanchor.scale.lengths import MIN_SCORE, dominant_group, inlier_mask

if TYPE_CHECKING:
    from typing import TypeAlias

    from numpy.typing import NDArray

    from vehanchor.detection.detections import Appearance, Detections
    from vehanchor.options import Lengths
    from vehanchor.scale.density import Density

    Mask: TypeAlias = NDArray[np.bool_]
    """``[n]`` whether each detection is in the fleet."""

    Centres: TypeAlias = NDArray[np.float64]
    """``[m, 2]`` x, y in pixels of the image."""

    LengthsPx: TypeAlias = NDArray[np.float64]
    """``[m]`` lengths of the fleet, pixels of the image."""

    Scores: TypeAlias = NDArray[np.float64]
    """``[m]`` detection scores of the fleet."""

    Weights: TypeAlias = NDArray[np.float64]
    """``[n]`` weights of all detections."""


@dataclass(frozen=True, eq=False)
class Fleet:
    """Vehicles behind the scale; shapes name all detections ``n`` and those of the fleet ``m``.

    Attributes:
        detections: all detections.
        kept: ``[n]`` bool, the detections of the fleet.
        main_reduction: reduction of the image copy with most of the fleet, by score; None without
            vehicles.
        rival_share: evidence of the strongest group of other lengths over the fleet's; 0 without
            any.
    """

    detections: Detections
    kept: Mask
    main_reduction: float | None
    rival_share: float = 0.0

    @property
    def is_stated(self) -> bool:
        """Whether the caller states that most of these vehicles are cars."""
        stated_cars = self.detections.stated & self.kept
        n_stated = int(stated_cars.sum())
        return bool(2 * n_stated > self.kept.sum())

    @property
    def centres(self) -> Centres:
        """``[m, 2]`` centres x, y in pixels of the image."""
        return np.asarray(self.detections.boxes[self.kept, :2])

    @property
    def lengths(self) -> LengthsPx:
        """``[m]`` lengths in pixels of the image."""
        return np.asarray(self.detections.boxes[self.kept, 2])

    @property
    def scores(self) -> Scores:
        """``[m]`` detection scores."""
        return np.asarray(self.detections.scores[self.kept])

    @property
    def appearance(self) -> Appearance | None:
        """Appearance of the vehicles that have any; None without such vehicles."""
        appearance = self.detections.appearance
        if appearance is None:
            return None
        # Only the first detections have an appearance.
        kept = self.kept[: len(appearance)]
        if not kept.any():
            return None
        return appearance.take(kept)


def select(detections: Detections, lengths: Lengths, expected: Density | None = None) -> Fleet:
    """Select the fleet by the outlier filter and, after a search over scales, by one modal length.

    A vehicle that the caller adds is one clear vote: it joins the fleet, or is an outlier like
    others.

    Args:
        detections: vehicles in pixels of the image.
        lengths: options with the filter's factor.
        expected: ``[g]`` density of the scale by other rulers or the scene-scale prior, which
            identifies cars; None without any.

    Returns:
        The fleet, empty if there are no vehicles.
    """
    lengths_px = detections.boxes[:, 2]
    rival_share = 0.0
    if detections.reductions is None or len(lengths_px) == 0:
        kept = inlier_mask(lengths_px, lengths.alpha)
    else:
        # A search over scales also finds things of a car's shape that are larger or smaller.
        weights = _evidence_of_cars(detections, expected)
        kept, rival_share = dominant_group(lengths_px, weights)
        kept[kept] = inlier_mask(lengths_px[kept], lengths.alpha)
    main_reduction = _main_reduction(detections, kept)
    return Fleet(detections, kept, main_reduction, rival_share)


def _evidence_of_cars(detections: Detections, expected: Density | None) -> Weights:
    """Weigh each box ``[n]`` by its squared score, and by how likely it is as long as a car.

    The square reduces the weight of false alarms, most of which have low scores.

    Args:
        detections: vehicles in pixels of the image.
        expected: as in ``select``.
    """
    weights = np.maximum(detections.scores, MIN_SCORE) ** 2
    if expected is None:
        return np.asarray(weights)
    # The scale at which each box would be as long as a car, and how likely that scale is.
    log_scales = np.log(CAR_LENGTH_M / detections.boxes[:, 2])
    likely = np.interp(log_scales, GRID, expected / expected.max())
    # The caller states that added vehicles are cars, whatever scale follows from their lengths.
    likely = np.where(detections.stated, 1.0, likely)
    return np.asarray(likely * weights)


def _main_reduction(detections: Detections, kept: Mask) -> float | None:
    """Find the reduction with most of the kept vehicles, by score; the finer of equals."""
    if not kept.any():
        return None
    if detections.reductions is None:
        return 1.0
    # Negative reductions sort finer copies first; argmax takes the first of equals.
    reductions = detections.reductions[kept]
    negative, inverse = np.unique(-reductions, return_inverse=True)
    scores = np.bincount(inverse, weights=detections.scores[kept])
    best = np.argmax(scores)
    return float(-negative[best])
