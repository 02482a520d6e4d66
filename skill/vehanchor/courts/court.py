"""A sports court that was found and measured."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Court:
    """A court that was found and measured.

    Attributes:
        kind: ``tennis``, ``basketball_fiba``, ``basketball_nba`` or ``basketball_ncaa``.
        corners: ``[4, 2]`` of its outline, pixels of the image (0 is its left and upper edge); the first two bound a
            long side.
        length_m: what its rules say of the long sides.
        width_m: of the short ones.
        gsd_m_per_px: the scale by its area.
        log_sd: standard deviation of the scale's log by the pixels alone.
        score: of the template on the lines, 1 at most.
        coverage: 0..1, share of its lines that is seen where it should be.
        distortion: how far it is from the rules' shape.
        shape: ``[4, 2]`` the corners as they are seen in perspective, in the order of ``corners``; None for one of too
            few pixels for that.
        shape_sd_px: standard deviation of each of these along either axis.
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
    shape: NDArray[np.float64] | None = None
    shape_sd_px: float = math.inf
