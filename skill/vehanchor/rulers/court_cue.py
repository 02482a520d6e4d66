"""Courts as a tilt cue: only the true tilt gives a court the length, width and right angles of its rules."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.scale.plane import LEAST_DESCENT

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vehanchor.courts.court import Court

_CONSTRUCTION_SD = 0.003  # of a court's length: deviation of a corner from the rules
_UNKNOWN_RULES_SD = 0.006  # for basketball courts, whose rules are a guess
_TRUST_PX = 1.5  # factor on the corners' standard deviation, because errors along a line are correlated
_LEAST_SD_PX = 0.3


@dataclass(frozen=True, eq=False)
class CourtCue:
    """Court in perspective (a ``vehanchor.tilt.posterior.TiltCue``).

    Attributes:
        corners: ``[4, 2]`` pixels from the image's centre; the first two bound a long side.
        rules: ``[4]`` corners by the rules, complex, metres from the centre.
        sd_px: standard deviation of a corner along either axis.
    """

    corners: NDArray[np.float64]
    rules: NDArray[np.complex128]
    sd_px: float
    kind: str = "courts"

    def log_likelihoods(self, downs: NDArray[np.float64], focal_px: float) -> NDArray[np.float64]:
        """Compute ``[k]`` from the distances, in pixels, between the observed corners and those of the rules."""
        rays = np.column_stack([self.corners / focal_px, np.ones(4)])
        descents = downs @ rays.T  # [k, 4]
        seen = (descents / np.linalg.norm(rays, axis=1) >= LEAST_DESCENT).all(axis=1)
        descents = np.maximum(descents, 1e-6)
        right = np.array([1.0, 0.0, 0.0]) - downs[:, :1] * downs
        right /= np.linalg.norm(right, axis=1, keepdims=True)
        lower = np.cross(downs, right)
        places = (right @ rays.T + 1j * (lower @ rays.T)) / descents  # on the ground, for a camera one unit up
        places -= places.mean(axis=1, keepdims=True)
        size = places @ np.conj(self.rules) / (np.abs(self.rules) ** 2).sum()
        off = np.abs(places - size[:, None] * self.rules) * focal_px * descents**1.5
        return np.asarray(np.where(seen, -0.5 * (off**2).sum(axis=1) / self.sd_px**2, -math.inf))


def court_cues(courts: Sequence[Court], width_px: int, height_px: int) -> list[CourtCue]:
    """Make tilt cues of the courts that have enough pixels to show perspective.

    Args:
        courts: courts of one image.
        width_px: width of the image.
        height_px: height of the image.
    """
    found = []
    for court in courts:
        if court.shape is None or not math.isfinite(court.shape_sd_px):
            continue
        across = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * [court.length_m / 2, court.width_m / 2]
        length_px = float(np.hypot(*(court.shape[1] - court.shape[0])))
        relative_sd = _CONSTRUCTION_SD if court.kind == "tennis" else _UNKNOWN_RULES_SD
        sd = math.hypot(max(_TRUST_PX * court.shape_sd_px, _LEAST_SD_PX), relative_sd * length_px)
        corners = court.shape - [width_px / 2, height_px / 2]
        found.append(CourtCue(corners, across[:, 0] + 1j * across[:, 1], sd))
    return found
