"""Where a camera looked, from all that tells something of it: witnesses of the direction straight down, multiplied.

The unknowns are the lean of the camera (a vector: how many degrees its axis is from straight down, towards which side
of the image) and its focal length. Without a witness drones' cameras are taken to keep the horizon level, most of them.
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

_MOST_DEG = 64.0  # a camera that leans further has the horizon in sight
_STEP_DEG, _FINER = 3.0, 3  # of the lean's grid, and by how much each look after the first is finer
_NEGLIGIBLE = 12.0  # nats below the best: what is less likely is looked at no finer
_MOST_POINTS = 6000
_LEVEL_SHARE, _LEVEL_SD_DEG = 0.7, 8.0  # of cameras whose horizon is level, and how level it is
_NEAR_DEG = 10.0  # what lies further from the likeliest is another answer, not its spread
_FOCAL_STEPS = np.linspace(-1.8, 1.8, 7)  # standard deviations of a focal length, at first
_GROUND_SD_DEG = 0.7  # no ground is quite level: what a court says of itself need not hold beside it


class TiltCue(Protocol):
    """Something that tells where a camera looked."""

    @property
    def kind(self) -> str:
        """Name in records."""

    def log_likelihoods(self, downs: NDArray[np.float64], focal_px: float) -> NDArray[np.float64]:
        """``[k]`` for unit vectors straight down ``[k, 3]`` in the camera's frame, under a focal length."""


class Focal(NamedTuple):
    """A focal length as far as it is known.

    Attributes:
        pixels: of the image.
        log_sd: standard deviation of its log.
        known: whether anything told it.
    """

    pixels: float
    log_sd: float
    known: bool = True

    @property
    def doubt(self) -> str:
        """That nothing told it, as the end of a sentence; nothing where something did."""
        return "" if self.known else "; focal length unknown"


@dataclass(frozen=True)
class GimbalCue:
    """An angle that the gimbal wrote.

    Attributes:
        tilt_deg: angle between the camera's axis and straight down.
        roll_deg: direction in which it looked aside, clockwise from the image's upper side.
        sd_deg: of either way.
        chance_wrong: 0..1, that the angle is one of something else.
    """

    tilt_deg: float
    roll_deg: float
    sd_deg: float
    chance_wrong: float = 0.002
    kind: str = "metadata"

    def log_likelihoods(self, downs: NDArray[np.float64], focal_px: float) -> NDArray[np.float64]:  # noqa: ARG002
        """As ``TiltCue``: a normal distribution of the angle between the two, on a floor."""
        said = downs_of(self.tilt_deg * _toward(self.roll_deg)[None])[0]
        apart = np.degrees(np.arccos(np.clip(downs @ said, -1.0, 1.0)))
        peak = (1 - self.chance_wrong) / (2 * math.pi * self.sd_deg**2)
        floor = self.chance_wrong / (math.pi * _MOST_DEG**2)
        return np.asarray(np.log(peak * np.exp(-0.5 * (apart / self.sd_deg) ** 2) + floor))


class TiltPosterior(NamedTuple):
    """Where a camera looked.

    Attributes:
        tilt_deg: angle between its axis and straight down.
        low_deg: lower end of its 95 % interval.
        high_deg: upper end.
        roll_deg: direction in which it looked aside, clockwise from the image's upper side.
        focal_px: focal length, pixels of the image.
        leans: ``[k, 2]`` degrees to the right and to the lower side, of the whole distribution.
        chances: ``[k]`` of each.
    """

    tilt_deg: float
    low_deg: float
    high_deg: float
    roll_deg: float
    focal_px: float
    leans: NDArray[np.float64]
    chances: NDArray[np.float64]

    def chance_above(self, tilt_deg: float) -> float:
        """Chance, 0..1, that it looked further aside than an angle."""
        return float(self.chances[np.hypot(*self.leans.T) > tilt_deg].sum())


def downs_of(leans: ArrayLike) -> NDArray[np.float64]:
    """Unit vectors straight down ``[k, 3]`` of leans ``[k, 2]``, degrees."""
    vectors = np.radians(np.asarray(leans, dtype=np.float64))
    tilts = np.hypot(*vectors.T)
    return np.column_stack([np.sinc(tilts / math.pi)[:, None] * vectors, np.cos(tilts)])


def tilt_posterior(cues: Sequence[TiltCue], focal: Focal, *, n_looks: int = 3) -> TiltPosterior | None:
    """Multiply what witnesses say.

    Args:
        cues: at least one.
        focal: the focal length as far as it is known without them.
        n_looks: each after the first is three times as fine. To tell whether it leans at all, two do.

    Returns:
        The lean; None where no direction is possible for all of them.
    """
    steps = _FOCAL_STEPS if focal.log_sd > 0 else np.zeros(1)
    step = _STEP_DEG
    reach = np.arange(-_MOST_DEG, _MOST_DEG + step, step)
    leans = np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 2)
    for look in range(n_looks):
        leans = leans[np.hypot(*leans.T) <= _MOST_DEG]
        focals = focal.pixels * np.exp(focal.log_sd * steps)
        logs = _log_prior(leans)[:, None] - 0.5 * steps**2
        for place, each in enumerate(focals):
            logs[:, place] += sum(one.log_likelihoods(downs_of(leans), float(each)) for one in cues)
        if not np.isfinite(logs).any():
            return None
        kept = logs.max(axis=1) > logs.max() - _NEGLIGIBLE
        if look == n_looks - 1 or kept.sum() * _FINER**2 > _MOST_POINTS:
            break
        likely = steps[logs.max(axis=0) > logs.max() - _NEGLIGIBLE]
        if len(steps) > 1:
            apart = (steps[1] - steps[0]) / 2
            steps = np.linspace(likely.min() - apart, likely.max() + apart, len(_FOCAL_STEPS))
        step /= _FINER
        finer = (np.arange(_FINER) - (_FINER - 1) / 2) * step
        around = np.stack(np.meshgrid(finer, finer), axis=-1).reshape(-1, 2)
        leans = (leans[kept][:, None] + around).reshape(-1, 2)
    return _summed_up(leans, np.exp(logs - logs.max()), focals)


def _summed_up(leans: NDArray[np.float64], weights: NDArray[np.float64], focals: NDArray[np.float64]) -> TiltPosterior:
    weights = weights / weights.sum()
    chances = weights.sum(axis=1)
    tilts = np.hypot(*leans.T)
    best = leans[int(chances.argmax())]
    near = chances * (np.hypot(*(leans - best).T) <= _NEAR_DEG)
    middle = near @ leans / near.sum()
    order = np.argsort(tilts)
    below = np.cumsum(chances[order])
    low, high = np.interp([0.025, 0.975], below, tilts[order])
    tilt = float(np.hypot(*middle))
    low, high = (
        tilt - math.hypot(tilt - low, Z95 * _GROUND_SD_DEG),
        tilt + math.hypot(high - tilt, Z95 * _GROUND_SD_DEG),
    )
    pixels = math.exp(float(near / chances.clip(1e-300) @ weights @ np.log(focals)) / float(near.sum()))
    roll = math.degrees(math.atan2(-middle[0], middle[1])) if tilt > 0 else 0.0
    return TiltPosterior(tilt, max(low, 0.0), high, roll, pixels, leans, chances)


def _toward(roll_deg: float) -> NDArray[np.float64]:
    """The way in the image, right and down, in which the ground straight below lies."""
    roll = math.radians(roll_deg)
    return np.array([-math.sin(roll), math.cos(roll)])


def _log_prior(leans: NDArray[np.float64]) -> NDArray[np.float64]:
    """Every tilt alike; most cameras level, so that they look towards the image's upper side."""
    tilts = np.hypot(*leans.T)
    aside = np.degrees(np.arctan2(-leans[:, 0], leans[:, 1]))
    level = math.sqrt(2 * math.pi) * _LEVEL_SD_DEG
    share = _LEVEL_SHARE * np.exp(-0.5 * (aside / _LEVEL_SD_DEG) ** 2) / level + (1 - _LEVEL_SHARE) / 360
    return np.asarray(np.log(share) - np.log(np.maximum(tilts, _STEP_DEG)))
