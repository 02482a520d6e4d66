"""Lines where a court has none, as on roofs with seams, roads with lanes and car parks.

Regular grids have lines wherever a court has one. They also have lines between these, which a court
lacks: behind the service lines of a tennis court, all lines run along it, at four distances.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

import cv2
import numpy as np

from vehanchor.courts.fit import project

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.courts.fit import Fit
    from vehanchor.courts.templates import Template

    GreyImage: TypeAlias = NDArray[np.float32]
    """``[h, w]`` grey levels."""

    Levels: TypeAlias = NDArray[np.float32]
    """``[n]`` grey levels across a court."""

# Numbers without a measurement beside them are choices.

# Samples along a strip.
_SAMPLES = 48
# Step across it.
_STEP_PX = 0.25
# A line is brighter than the pixels this far to either side.
_FLANK_PX = 2.0
# Distance from where a line should be, within which its brightness counts.
_ON_LINE_PX = 1.0
# Distance from all lines beyond which another one is surplus: the larger of both.
_OFF_LINE_PX = 1.5
_OFF_LINE_M = 0.35
# Largest share that is told apart from others.
_LARGEST_SHARE = 10.0


def surplus_share(grey: GreyImage, template: Template, court_fit: Fit) -> float:
    """Compare the strongest line where a court has none with the court's own lines.

    Args:
        grey: ``[h, w]`` grey levels.
        template: template of the court.
        court_fit: fit of the template to this image.

    Returns:
        Contrast of the strongest surplus line over the median contrast of the court's lines; 0 for
        a template without strips.
    """
    own = 0.0
    surplus = 0.0
    for strip in template.strips:
        ridges, places = _ridges_across(grey, template, court_fit, strip)
        distances = np.abs(places[:, None] - template.lines_of_strips)
        on_line = distances * court_fit.px_per_m <= _ON_LINE_PX
        contrasts = [ridges[is_near].max() for is_near in on_line.T]
        off_line_m = max(_OFF_LINE_M, _OFF_LINE_PX / court_fit.px_per_m)
        off_lines = distances.min(axis=1) > off_line_m
        own += float(np.median(contrasts))
        surplus += float(ridges[off_lines].max(initial=0.0))
    if surplus <= 0.0:
        return 0.0
    return surplus / max(own, surplus / _LARGEST_SHARE)


def _ridges_across(
    grey: GreyImage, template: Template, court_fit: Fit, strip: tuple[float, float]
) -> tuple[Levels, NDArray[np.float64]]:
    """Measure how much brighter than both sides each place across a strip is.

    Args:
        grey: ``[h, w]`` grey levels.
        template: template of the court.
        court_fit: fit of the template.
        strip: its ends along the court, metres.

    Returns:
        Contrasts ``[n]`` in grey levels, and the places ``[n]``, metres across the court.
    """
    step_m = _STEP_PX / court_fit.px_per_m
    flank = round(_FLANK_PX / _STEP_PX)
    half_m = template.width_m / 2
    n_steps = round(half_m / step_m) + flank
    across_m = np.arange(-n_steps, n_steps + 1) * step_m
    along_m = np.linspace(*strip, _SAMPLES)
    grid = np.stack(np.meshgrid(along_m, across_m, indexing="ij"), axis=-1)
    points = project(court_fit.matrix, grid.reshape(-1, 2)).astype(np.float32)
    x, y = points.reshape(_SAMPLES, -1, 2).transpose(2, 0, 1)
    sampled = cv2.remap(
        grey,
        np.ascontiguousarray(x),
        np.ascontiguousarray(y),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    levels = sampled.mean(axis=0)
    inner = levels[flank:-flank]
    before = levels[: -2 * flank]
    after = levels[2 * flank :]
    ridges = inner - np.maximum(before, after)
    places_m = np.asarray(across_m[flank:-flank], np.float64)
    return np.asarray(ridges, np.float32), places_m
