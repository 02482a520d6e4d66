"""Measured sports court."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Court:
    """Court that was found and measured in an image.

    Attributes:
        kind: ``tennis``, ``basketball_fiba``, ``basketball_nba`` or ``basketball_ncaa``.
        corners: ``[4, 2]`` corners of its outline, pixels of the image (0 is the left and upper edge); the first two
            bound a long side.
        length_m: length of the long sides by the rules of the game.
        width_m: length of the short sides by the rules of the game.
        gsd_m_per_px: GSD from its area.
        log_sd: standard deviation of the GSD's logarithm from the pixels alone.
        score: match of the template with the lines, at most 1.
        coverage: 0..1, share of its lines found where they should be.
        distortion: deviation from the shape in the rules.
    """

    kind: str
    corners: NDArray[np.float64]
    length_m: float
    width_m: float
    gsd_m_per_px: float
    log_sd: float
    score: float
    coverage: float
    distortion: float
