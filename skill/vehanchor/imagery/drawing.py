"""Drawings: pictures that are no photographs, such as pages, charts, maps and programs.

A drawing has few tones: between its edges it is flat, and at its edges two tones meet. A photograph
has noise and texture everywhere, and all tones between its darkest and its brightest. Pixels are
averaged in pairs first, because the compression of a JPEG file leaves ripples beside sharp edges. A
photograph of boats on dark water comes nearest to a drawing.

A scanned, noisy or photographed drawing is nowhere flat. The noise of a camera or of paper vanishes
where pixels are averaged in blocks of four by four, and the texture of ground does not, because it
has details of all sizes. So the flattest pixels are compared after such averages, too.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from vehanchor.imagery.raster import Window
from vehanchor.odds import chance_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster, RgbImage

PATCH_PX = 128
"""Side of the patches that are judged."""

SMALL_PATCH_PX = 64
"""Side of the patches of an image that is smaller than ``PATCH_PX``."""

# Numbers without a measurement beside them are choices.

# Patches along a side of the image, at even steps.
_MAX_ALONG = 6
# Largest difference of neighbouring pixels (3 x 3, the largest of the bands): in grey levels.
_UNIFORM = 1
_FLAT = 3
_SHARP = 40
# Share of uniform pixels from which a patch shows nothing: plain paper, or the border of a mosaic.
_EMPTY_SHARE = 0.995
# Share of sharp pixels from which a patch shows edges, and share of such patches that is needed.
_EDGE_SHARE = 0.005
_EDGED_PATCHES = 0.1
# Share of the pixels of a patch that are its flattest ones.
_FLATTEST_SHARE = 0.25
_N_GREYS = 256
# Share of flat pixels below which an image is photographed, and from which it may be drawn; between
# them the chance rises evenly. Of 376 drawings that their tones show 6 have less than 0.4, and of
# 43 photographs whose tones alone give a chance above 0.05, 41.
_FLAT_SHARES = (0.25, 0.4)
# Least share of patches on bright ground in a noisy drawing. A choice.
_PAPER_SHARE = 0.5
# Fewest and most vehicles whose surroundings are judged. Choices.
_FEWEST_VEHICLES = 2
_MAX_VEHICLES = 12


class DrawingWeights(NamedTuple):
    """Logistic regression of a drawing on medians over the patches with edges.

    Attributes:
        log_difference: weight of the log of 1 grey level plus the difference of neighbours among
            the flattest pixels.
        two_tones: weight of the share of the variance of greys that lies between two tones.
        offset: log odds without either.
    """

    log_difference: float
    two_tones: float
    offset: float


# Fitted to 1,905 photographs of known scale and 138 rendered scenes, and 430 drawings: 200 of
# research.scenes.pages, and 230 of 27 other kinds, most of them compressed, blurred, noisy or
# photographed; in equal parts. Then 4 is taken from the offset, because few pictures are drawings.
# Of the photographs the highest chance is 0.45. Of 170 further drawings of these kinds 100 of 113
# that are clean, compressed or blurred have more than 0.5, but only 4 of 57 that are noisy, scanned
# or photographed.
_WEIGHTS = DrawingWeights(log_difference=-2.47, two_tones=15.2, offset=-11.14)

# The same for the flattest pixels of blocks of four by four, and medians over all patches. Fitted
# to the 1,905 photographs and 99 drawings of research.scenes.pages, noisy, scanned or photographed,
# in equal parts. The log odds are doubled and 4.8 is taken from them, so that no usable photograph
# is lost. Of 150 further drawings of 18 kinds that were noisy, scanned or photographed, 27 have
# more than 0.5 (3 by the weights above), and no photograph. Of the 1,242 photographs with vehicles
# the highest chance around these is 0.29.
_NOISY_WEIGHTS = DrawingWeights(log_difference=-3.38, two_tones=24.06, offset=-14.81)


def measure_drawing_chance(raster: Raster, part: Window | None = None) -> float:
    """Measure the chance, 0..1, that an image is drawn and no photograph.

    Args:
        raster: the image.
        part: a part of it; None for all of it.

    Returns:
        The chance; 0 if a side is below 64 px, or if less than a tenth of it shows sharp edges.
    """
    if part is None:
        part = Window(0, 0, width_px=raster.width_px, height_px=raster.height_px)
    shorter_px = min(part.width_px, part.height_px)
    if shorter_px < SMALL_PATCH_PX:
        return 0.0
    patch_px = PATCH_PX if shorter_px >= PATCH_PX else SMALL_PATCH_PX
    columns = _starts(part.width_px, patch_px)
    rows = _starts(part.height_px, patch_px)
    measured = []
    for y in rows:
        for x in columns:
            left = part.x_px + x
            top = part.y_px + y
            patch = raster.read(Window(left, top, width_px=patch_px, height_px=patch_px))
            differences = _differences(patch)
            if np.mean(differences <= _UNIFORM) < _EMPTY_SHARE:
                measured.append(_measure(patch, differences))
    edged = [patch for patch in measured if patch.has_edges]
    if len(edged) < max(1.0, _EDGED_PATCHES * len(measured)):
        return 0.0
    # A flat thing with sharp edges, such as a pool, does not make a drawing of a photograph.
    difference = max(_upper_median(edged), _upper_median(measured))
    flat_share = min(_flat_share(edged), _flat_share(measured))
    return max(_chance(edged, difference, flat_share), _noisy_chance(measured))


def drawing_chance_around(raster: Raster, boxes: NDArray[np.float64], overall: float) -> float:
    """Compute the chance, 0..1, that vehicles are drawn, from what is around them.

    A photograph with cars may be a part of a drawing: of a program, a slide or a page.

    Args:
        raster: the image.
        boxes: ``[n, 5]`` vehicles, best first, pixels and radians.
        overall: chance that the image is drawn.

    Returns:
        The smaller one of both chances; the overall one for fewer than two vehicles, because a
        single letter or icon may be taken for a car.
    """
    patch_px = min(PATCH_PX, raster.width_px, raster.height_px)
    if len(boxes) < _FEWEST_VEHICLES or overall == 0.0:
        return overall
    measured = []
    for x, y in boxes[:_MAX_VEHICLES, :2]:
        left = int(np.clip(x - patch_px / 2, 0, raster.width_px - patch_px))
        top = int(np.clip(y - patch_px / 2, 0, raster.height_px - patch_px))
        patch = raster.read(Window(left, top, width_px=patch_px, height_px=patch_px))
        measured.append(_measure(patch, _differences(patch)))
    around = _chance(measured, _upper_median(measured), _flat_share(measured))
    return min(overall, max(around, _noisy_chance(measured)))


class _Patch(NamedTuple):
    """Part of an image.

    Attributes:
        flattest: difference of neighbours among its flattest pixels, grey levels.
        flattest_blocks: the same of blocks of four by four pixels.
        flat_share: share of flat pixels at full resolution.
        two_tones: share of the variance of its greys between two tones.
        has_edges: whether it shows sharp edges.
        is_on_paper: whether its ground is brighter than what it shows.
    """

    flattest: float
    flattest_blocks: float
    flat_share: float
    two_tones: float
    has_edges: bool
    is_on_paper: bool


def _measure(patch: RgbImage, differences: NDArray[np.uint8]) -> _Patch:
    """Measure a patch, at half its resolution where compression would disturb.

    Args:
        patch: the patch.
        differences: ``[h, w]`` largest difference among the neighbours of each pixel.
    """
    flat_share = float(np.mean(differences <= _FLAT))
    halved = _halved(patch)
    halved_differences = _differences(halved)
    has_edges = bool(np.mean(halved_differences > _SHARP) > _EDGE_SHARE)
    return _Patch(
        _flattest(halved_differences),
        _flattest(_differences(_halved(halved))),
        flat_share=flat_share,
        two_tones=_two_tone_share(halved),
        has_edges=has_edges,
        is_on_paper=bool(np.median(halved) >= halved.mean()),
    )


def _flattest(differences: NDArray[np.uint8]) -> float:
    """Compute the largest difference ``[h, w]`` among the flattest pixels."""
    return float(np.quantile(differences, _FLATTEST_SHARE, method="inverted_cdf"))


def _upper_median(patches: Sequence[_Patch]) -> float:
    """Compute the median difference; the upper one of two."""
    return float(np.quantile([patch.flattest for patch in patches], 0.5, method="higher"))


def _flat_share(patches: Sequence[_Patch]) -> float:
    """Compute the median share of flat pixels; the lower one of two."""
    return float(np.quantile([patch.flat_share for patch in patches], 0.5, method="lower"))


def _chance(patches: Sequence[_Patch], difference: float, flat_share: float) -> float:
    """Compute the chance of a drawing.

    All medians are those of the less drawn half: the border of a mosaic looks drawn, too.

    Args:
        patches: patches whose tones count.
        difference: median difference of neighbours among the flattest pixels.
        flat_share: median share of flat pixels.
    """
    two_tones = float(np.quantile([patch.two_tones for patch in patches], 0.5, method="lower"))
    of_tones = _chance_of_tones(_WEIGHTS, difference, two_tones)
    least, enough = _FLAT_SHARES
    flatness = (flat_share - least) / (enough - least)
    return float(of_tones * np.clip(flatness, 0.0, 1.0))


def _noisy_chance(patches: Sequence[_Patch]) -> float:
    """Compute the chance of a noisy, scanned or photographed drawing, by the less drawn half.

    It is on paper. Dark ground with bright things on it may be water with boats.
    """
    if np.mean([patch.is_on_paper for patch in patches]) < _PAPER_SHARE:
        return 0.0
    difference = np.quantile([patch.flattest_blocks for patch in patches], 0.5, method="higher")
    two_tones = np.quantile([patch.two_tones for patch in patches], 0.5, method="lower")
    return _chance_of_tones(_NOISY_WEIGHTS, float(difference), float(two_tones))


def _chance_of_tones(weights: DrawingWeights, difference: float, two_tones: float) -> float:
    """Compute the chance of a drawing by medians over its patches."""
    log_odds = (
        weights.log_difference * math.log1p(difference)
        + weights.two_tones * two_tones
        + weights.offset
    )
    return chance_of(log_odds)


def _halved(patch: RgbImage) -> RgbImage:
    """Average the pixels of a patch by twos along both sides."""
    size = (patch.shape[1] // 2, patch.shape[0] // 2)
    return np.asarray(cv2.resize(patch, size, interpolation=cv2.INTER_AREA), np.uint8)


def _starts(side_px: int, patch_px: int) -> list[int]:
    """Choose the first pixels of patches along a side, at even steps."""
    count = min(_MAX_ALONG, side_px // patch_px)
    places = np.linspace(0, side_px - patch_px, count)
    starts: list[int] = places.astype(int).tolist()
    return starts


def _differences(patch: RgbImage) -> NDArray[np.uint8]:
    """Compute the largest difference ``[h, w]`` among the neighbours of each pixel."""
    neighbours = np.ones((3, 3), np.uint8)
    highest = cv2.dilate(patch, neighbours)
    lowest = cv2.erode(patch, neighbours)
    red, green, blue = cv2.split(cv2.subtract(highest, lowest))
    return np.asarray(cv2.max(cv2.max(red, green), blue), np.uint8)


def _two_tone_share(patch: RgbImage) -> float:
    """Compute the share of the variance of greys between two tones; 1 for an even patch.

    Otsu's method: the two tones are the means on both sides of the grey that separates them best.
    """
    greys = cv2.cvtColor(patch, cv2.COLOR_RGB2GRAY)
    counts = np.bincount(greys.ravel(), minlength=_N_GREYS)
    shares = counts / counts.sum()
    levels = np.arange(_N_GREYS)
    # Share and sum of the darker side, for each limit between both sides.
    darker = np.cumsum(shares)
    darker_sum = np.cumsum(shares * levels)
    mean = darker_sum[-1]
    variance = float(np.sum(shares * (levels - mean) ** 2))
    if variance == 0:
        return 1.0
    spread = darker * (1 - darker)
    separates = spread > 0
    gap = mean * darker[separates] - darker_sum[separates]
    between = gap**2 / spread[separates]
    return float(between.max()) / variance
