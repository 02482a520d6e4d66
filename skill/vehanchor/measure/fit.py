"""Whether a circle or a rectangle fits into an object: ``must_fit``.

Let t be the most pixels per metre at which the shape fits into the mask. The shape fits if the
image has at most t pixels per metre. The probability of that is taken over the whole posterior of
the scale, with the error of the mask's edge, and is never above the scale's confidence.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from vehanchor.errors import InvalidParameterError
from vehanchor.measure.placement import make_grid, place_circle, place_rectangle
from vehanchor.options.option import is_number
from vehanchor.records import ImagePoint
from vehanchor.records.measurement import Fit, image_points
from vehanchor.scale.density import GRID, LOG_STEP, TOLERANCE

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike, NDArray

    from vehanchor.measure.placement import PlacedRectangle
    from vehanchor.measure.polygon import Part
    from vehanchor.measure.scale_source import MeasurementScale
    from vehanchor.segmentation.object_mask import ObjectMask

_FORMS = 'give {"diameter_m": 12} or {"length_m": 12, "width_m": 5}'
# Sizes between these have a meaning in a photograph. Choices.
_LEAST_M = 0.001
_MAX_M = 100_000.0
# Least spread of the log, which keeps the normal distribution of an exact number finite.
_LEAST_LOG_SD = LOG_STEP / 4


@dataclass(frozen=True)
class MustFit:
    """Shape that must fit: a circle, or a rectangle.

    Attributes:
        length_m: length of the rectangle, or diameter of the circle, metres.
        width_m: width of the rectangle, metres; None for a circle.
    """

    length_m: float
    width_m: float | None = None

    @property
    def narrowest_m(self) -> float:
        """Its smaller extent, metres."""
        return self.length_m if self.width_m is None else self.width_m


def read_must_fit(value: Any) -> MustFit | None:
    """Read what must fit; None for nothing.

    Args:
        value: a mapping with ``diameter_m``, or with ``length_m`` and ``width_m``.

    Raises:
        InvalidParameterError: it has other keys, or a size is not a positive number.
    """
    if value is None or isinstance(value, MustFit):
        return value
    if not isinstance(value, Mapping):
        raise InvalidParameterError(f"must_fit is {value!r}: {_FORMS}")
    given = {name: size for name, size in value.items() if size is not None}
    sizes = {}
    for name, size in given.items():
        if not is_number(size) or not _LEAST_M <= size <= _MAX_M:
            raise InvalidParameterError(
                f"must_fit: {name} is {size!r}: use {_LEAST_M:g} to {_MAX_M:.0f} metres"
            )
        sizes[name] = float(size)
    if set(sizes) == {"diameter_m"}:
        return MustFit(sizes["diameter_m"])
    if set(sizes) != {"length_m", "width_m"}:
        raise InvalidParameterError(f"must_fit has {', '.join(given) or 'no size'}: {_FORMS}")
    length_m = max(sizes.values())
    width_m = min(sizes.values())
    return MustFit(length_m, width_m)


def find_fit(
    must_fit: MustFit,
    pixels: ObjectMask,
    scale: MeasurementScale,
    *,
    parts: Sequence[Part] = (),
    edge_sd_px: float,
    width_log_sd: float = 0.0,
    at_most: float | None = None,
) -> Fit:
    """Find out whether a shape fits into an object, and where.

    Args:
        must_fit: the shape.
        pixels: the object's mask, which is not empty.
        scale: the scale at the height of the object.
        parts: rings of a polygon; empty for a mask.
        edge_sd_px: standard deviation of the edge's place, pixels.
        width_log_sd: least standard deviation of the log of what fits inside.
        at_most: largest probability, of a doubtful mask; None for any other.
    """
    grid = make_grid(pixels, parts, scale.plane)
    gsd = scale.gsd_m_per_px

    def probability(narrowest_px: float) -> float:
        # An edge that lies further inside by d takes 2 d from the extent.
        log_sd = max(2 * edge_sd_px / narrowest_px, width_log_sd)
        fits = fit_probability(must_fit.narrowest_m, narrowest_px, scale, log_sd)
        return fits if at_most is None else min(fits, at_most)

    if must_fit.width_m is None:
        circle = place_circle(grid)
        if circle is None:
            return _nothing(must_fit)
        x, y = circle.centre
        return Fit(
            fit_probability=probability(circle.diameter_px),
            center=ImagePoint(x_px=x, y_px=y),
            diameter_m=must_fit.length_m,
        )
    rectangle = place_rectangle(grid, must_fit.length_m, must_fit.width_m)
    if rectangle is None:
        return _nothing(must_fit)
    x, y = rectangle.centre_in_image
    corners: tuple[ImagePoint, ...] = ()
    if gsd is not None:
        placed = rectangle.corners(must_fit.length_m / gsd, must_fit.width_m / gsd)
        corners = image_points(placed)
    return Fit(
        fit_probability=probability(rectangle.width_px),
        center=ImagePoint(x_px=x, y_px=y),
        heading_deg=rectangle.heading_deg,
        corners=corners,
        n_fits_at_least=_count(rectangle, must_fit, scale),
        length_m=must_fit.length_m,
        width_m=must_fit.width_m,
    )


def _nothing(must_fit: MustFit) -> Fit:
    """State that the object has no place for any shape of these proportions."""
    if must_fit.width_m is None:
        return Fit(fit_probability=0.0, diameter_m=must_fit.length_m)
    return Fit(
        fit_probability=0.0,
        length_m=must_fit.length_m,
        width_m=must_fit.width_m,
        n_fits_at_least=0,
    )


def _count(rectangle: PlacedRectangle, must_fit: MustFit, scale: MeasurementScale) -> int:
    """Count the rectangles that fit in rows at the finest scale of the interval."""
    assert must_fit.width_m is not None
    if scale.gsd_m_per_px is None:
        return 0
    finest, _ = scale.spread.around(scale.gsd_m_per_px)
    return rectangle.count_rows(must_fit.length_m / finest, must_fit.width_m / finest)


def fit_probability(
    narrowest_m: float, narrowest_px: float, scale: MeasurementScale, log_sd: float
) -> float:
    """Compute the probability that the image has at most t pixels per metre.

    Args:
        narrowest_m: the smaller extent of the shape, metres.
        narrowest_px: that of the largest shape of its proportions in the mask, pixels.
        scale: the scale.
        log_sd: standard deviation of the log of ``narrowest_px``, from the error of the edge.
    """
    if scale.gsd_m_per_px is None:
        return 0.0
    # The shape fits if one pixel has at least so many metres.
    least_gsd = narrowest_m / narrowest_px
    probability = _posterior_above(least_gsd, scale, log_sd)
    if scale.confidence is None:
        return probability
    return min(probability, scale.confidence)


def _posterior_above(gsd_m_per_px: float, scale: MeasurementScale, log_sd: float) -> float:
    """Compute the mass of the scales above one that is known up to a normal error of its log."""
    least_log_gsd = math.log(gsd_m_per_px)
    if scale.posterior is not None:
        deviations = (GRID - least_log_gsd) / max(log_sd, _LEAST_LOG_SD)
        return float(scale.posterior @ _standard_normal(deviations))
    # Of a scale that was given back, only value, interval and confidence are known. The mass that
    # the confidence leaves out lies anywhere, so it counts as too small.
    assert scale.gsd_m_per_px is not None
    spread = scale.spread.plus(log_sd)
    distance = math.log(scale.gsd_m_per_px) - least_log_gsd
    side = spread.below if distance > 0 else spread.above
    probability = float(_standard_normal(distance / max(side, _LEAST_LOG_SD)))
    if scale.confidence is None:
        return probability
    within = _mass_within_tolerance(scale)
    return probability * min(1.0, scale.confidence / within)


def _mass_within_tolerance(scale: MeasurementScale) -> float:
    """Compute the mass within 20 % of the value, given that the interval holds."""
    sd_below = max(scale.spread.below, _LEAST_LOG_SD)
    sd_above = max(scale.spread.above, _LEAST_LOG_SD)
    below = math.log(1 + TOLERANCE) / sd_below
    above = -math.log(1 - TOLERANCE) / sd_above
    return float(_standard_normal(above) - _standard_normal(-below))


def _standard_normal(deviations: ArrayLike) -> NDArray[np.float64]:
    """Compute the cumulative distribution function of the standard normal distribution."""
    # Imported where a shape is fitted: it takes 0.15 s, which every command would wait for.
    from scipy.special import ndtr

    return np.asarray(ndtr(deviations))
