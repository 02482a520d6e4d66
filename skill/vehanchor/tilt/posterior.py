"""Posterior of the camera's tilt: the product of up to three cues.

The unknowns are the tilt as a vector (degrees between the axis and straight down, to the right and to the lower side of
the image) and the focal length. The prior assumes that most drones keep the horizon level.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from vehanchor.scale.lengths import Z95

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike, NDArray

    from vehanchor.tilt.focal import Focal

_MOST_DEG = 64.0  # images with a larger tilt show the horizon
_STEP_DEG, _FINER = 3.0, 3  # of the grid, and the factor by which each later pass is finer
_NEGLIGIBLE = 12.0  # nats below the maximum; less likely tilts are not refined
_MOST_POINTS = 6000
_LEVEL_SHARE, _LEVEL_SD_DEG = 0.7, 8.0  # share of cameras with a level horizon, and its standard deviation
_NEAR_DEG = 10.0  # tilts farther from the maximum belong to another mode
_FOCAL_STEPS = np.linspace(-1.8, 1.8, 7)  # standard deviations of the focal length in the first pass
_GROUND_SD_DEG = 0.7  # slope of the ground, which may differ beside a court


class TiltCue(Protocol):
    """Cue of the tilt."""

    @property
    def kind(self) -> str:
        """Name in records."""

    def log_likelihoods(self, downs: NDArray[np.float64], focal_px: float) -> NDArray[np.float64]:
        """Compute ``[k]`` for unit vectors straight down ``[k, 3]`` in the camera's frame and a focal length."""


@dataclass(frozen=True)
class GimbalCue:
    """Angle of the gimbal, from the metadata.

    Attributes:
        tilt_deg: angle between the camera's axis and straight down.
        roll_deg: direction of the tilt in the image, clockwise from its upper side.
        sd_deg: standard deviation in either direction.
        chance_wrong: 0..1, chance that the angle is wrong altogether.
    """

    tilt_deg: float
    roll_deg: float
    sd_deg: float
    chance_wrong: float = 0.002
    kind: str = "metadata"

    def log_likelihoods(self, downs: NDArray[np.float64], focal_px: float) -> NDArray[np.float64]:  # noqa: ARG002
        """Compute a normal log-likelihood of the angle between the two vectors, with a floor; see ``TiltCue``."""
        stated = downs_of(self.tilt_deg * _toward(self.roll_deg)[None])[0]
        apart = np.degrees(np.arccos(np.clip(downs @ stated, -1.0, 1.0)))
        peak = (1 - self.chance_wrong) / (2 * math.pi * self.sd_deg**2)
        floor = self.chance_wrong / (math.pi * _MOST_DEG**2)
        return np.asarray(np.log(peak * np.exp(-0.5 * (apart / self.sd_deg) ** 2) + floor))


class TiltPosterior(NamedTuple):
    """Tilt of a camera with its uncertainty.

    Attributes:
        tilt_deg: angle between its axis and straight down.
        low_deg: lower end of its 95 % interval.
        high_deg: upper end.
        roll_deg: direction of the tilt in the image, clockwise from its upper side.
        focal_px: focal length, pixels of the image.
        tilts: ``[k, 2]`` tilts of the whole distribution, degrees to the right and to the lower side.
        chances: ``[k]`` probability of each tilt.
    """

    tilt_deg: float
    low_deg: float
    high_deg: float
    roll_deg: float
    focal_px: float
    tilts: NDArray[np.float64]
    chances: NDArray[np.float64]

    def chance_above(self, tilt_deg: float) -> float:
        """Compute the probability that the tilt exceeds an angle."""
        return float(self.chances[np.hypot(*self.tilts.T) > tilt_deg].sum())


def downs_of(tilts: ArrayLike) -> NDArray[np.float64]:
    """Compute unit vectors straight down ``[k, 3]`` for tilts ``[k, 2]``, degrees."""
    vectors = np.radians(np.asarray(tilts, dtype=np.float64))
    angles = np.hypot(*vectors.T)
    return np.column_stack([np.sinc(angles / math.pi)[:, None] * vectors, np.cos(angles)])


def tilt_posterior(cues: Sequence[TiltCue], focal: Focal, *, n_passes: int = 3) -> TiltPosterior | None:
    """Multiply the likelihoods of the cues and the prior.

    Args:
        cues: at least one cue.
        focal: prior of the focal length.
        n_passes: number of passes; each one is three times finer than the one before. Two passes can detect a tilt.

    Returns:
        None if no direction is possible for all cues.
    """
    steps = _FOCAL_STEPS if focal.log_sd > 0 else np.zeros(1)
    step = _STEP_DEG
    reach = np.arange(-_MOST_DEG, _MOST_DEG + step, step)
    tilts = np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 2)
    for turn in range(n_passes):
        tilts = tilts[np.hypot(*tilts.T) <= _MOST_DEG]
        focals = focal.pixels * np.exp(focal.log_sd * steps)
        logs = _log_prior(tilts)[:, None] - 0.5 * steps**2
        for place, each in enumerate(focals):
            logs[:, place] += sum(one.log_likelihoods(downs_of(tilts), float(each)) for one in cues)
        if not np.isfinite(logs).any():
            return None
        kept = logs.max(axis=1) > logs.max() - _NEGLIGIBLE
        if turn == n_passes - 1 or kept.sum() * _FINER**2 > _MOST_POINTS:
            break
        likely = steps[logs.max(axis=0) > logs.max() - _NEGLIGIBLE]
        if len(steps) > 1:
            apart = (steps[1] - steps[0]) / 2
            steps = np.linspace(likely.min() - apart, likely.max() + apart, len(_FOCAL_STEPS))
        step /= _FINER
        finer = (np.arange(_FINER) - (_FINER - 1) / 2) * step
        around = np.stack(np.meshgrid(finer, finer), axis=-1).reshape(-1, 2)
        tilts = (tilts[kept][:, None] + around).reshape(-1, 2)
    return _summed_up(tilts, np.exp(logs - logs.max()), focals)


def _summed_up(tilts: NDArray[np.float64], weights: NDArray[np.float64], focals: NDArray[np.float64]) -> TiltPosterior:
    weights = weights / weights.sum()
    chances = weights.sum(axis=1)
    angles = np.hypot(*tilts.T)
    best = tilts[int(chances.argmax())]
    near = chances * (np.hypot(*(tilts - best).T) <= _NEAR_DEG)
    middle = near @ tilts / near.sum()
    order = np.argsort(angles)
    below = np.cumsum(chances[order])
    low, high = np.interp([0.025, 0.975], below, angles[order])
    tilt = float(np.hypot(*middle))
    low, high = (
        tilt - math.hypot(tilt - low, Z95 * _GROUND_SD_DEG),
        tilt + math.hypot(high - tilt, Z95 * _GROUND_SD_DEG),
    )
    pixels = math.exp(float(near / chances.clip(1e-300) @ weights @ np.log(focals)) / float(near.sum()))
    roll = math.degrees(math.atan2(-middle[0], middle[1])) if tilt > 0 else 0.0
    return TiltPosterior(tilt, max(low, 0.0), high, roll, pixels, tilts, chances)


def _toward(roll_deg: float) -> NDArray[np.float64]:
    """Compute the direction in the image, right and down, of the ground straight below."""
    roll = math.radians(roll_deg)
    return np.array([-math.sin(roll), math.cos(roll)])


def _log_prior(tilts: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute the log prior: flat in the angle, with a level horizon for most cameras."""
    angles = np.hypot(*tilts.T)
    rolls = np.degrees(np.arctan2(-tilts[:, 0], tilts[:, 1]))
    level = math.sqrt(2 * math.pi) * _LEVEL_SD_DEG
    share = _LEVEL_SHARE * np.exp(-0.5 * (rolls / _LEVEL_SD_DEG) ** 2) / level + (1 - _LEVEL_SHARE) / 360
    return np.asarray(np.log(share) - np.log(np.maximum(angles, _STEP_DEG)))
