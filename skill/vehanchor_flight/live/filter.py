"""Kalman filter over the log of a camera's scale, as pure functions of a frozen state.

The state is the natural log of metres per pixel. Features between frames predict it; the vehicles
of a frame correct it. Frames of the same ground show the same cars: they repeat an error instead of
averaging it. A measurement therefore counts by the new ground since the one before. The error of
the reference length is common to the flight, and no number of frames reduces it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from vehanchor.scale.defaults import USABLE_CHANCE
from vehanchor.scale.density import TOLERANCE
from vehanchor.scale.lengths import Z95, Interval

_STEADY_LOG_SD = 0.002  # of the ratio between two frames of the same ground
_UNLINKED_LOG_SD_PER_S = 0.5  # a climb of 5 m/s at 10 m of height
_WIDEST_LOG_SD = 1.0  # beyond it, the state says nothing
_SAME_GROUND = 0.02  # share of a measurement that counts without new ground: noise of single boxes
_LEAST_LOG_SD = 0.02  # of a measurement, beside the common error
_GATE_SDS = 3.5  # a measurement further off contradicts the state
_MOST_CONTRADICTIONS = 3  # in a row; then the state was wrong
_MOST_LOG_ODDS = 4.0
# factor on the chance for each contradiction in a row: either may be right; a choice
_CONTRADICTED = 0.5


class Measurement(NamedTuple):
    """Scale of one frame by its vehicles.

    Attributes:
        log_gsd: natural log of metres per pixel.
        log_sd: standard deviation of its own error, which other cars do not share.
        common_log_sd: standard deviation of the error that all cars of the flight share.
        chance: probability of an error below 20 %.
    """

    log_gsd: float
    log_sd: float
    common_log_sd: float
    chance: float


class Motion(NamedTuple):
    """Change between two frames by their features.

    Attributes:
        log_ratio: log of the new frame's metres per pixel over the old frame's.
        log_sd: its standard deviation for frames that hardly overlap.
        moved: share of the new frame that shows other ground, 0..1.
    """

    log_ratio: float
    log_sd: float
    moved: float


class FilterState(NamedTuple):
    """State of the filter.

    Attributes:
        log_gsd: natural log of metres per pixel.
        variance: of its error without the common part.
        common_log_sd: standard deviation of the common part.
        log_odds: log odds that the followed vehicles are cars.
        information: of the last measurement, inverse variance.
        moved: new ground since the last measurement, in frames.
        silent_s: seconds since the last measurement that agreed.
        contradictions: number of measurements in a row that did not agree.
    """

    log_gsd: float
    variance: float
    common_log_sd: float
    log_odds: float
    information: float
    moved: float = 0.0
    silent_s: float = 0.0
    contradictions: int = 0

    @property
    def log_sd(self) -> float:
        """Standard deviation of the log scale, the common part included."""
        return math.sqrt(self.variance + self.common_log_sd**2)

    @property
    def gsd_m_per_px(self) -> float:
        """Metres per pixel."""
        return math.exp(self.log_gsd)

    @property
    def interval(self) -> Interval:
        """95 % interval, metres per pixel."""
        reach = Z95 * self.log_sd
        return Interval(math.exp(self.log_gsd - reach), math.exp(self.log_gsd + reach))

    @property
    def chance(self) -> float:
        """Probability of an error below 20 %."""
        within = math.erf(math.log1p(TOLERANCE) / (self.log_sd * math.sqrt(2)))
        return within / (1 + math.exp(-self.log_odds)) * _CONTRADICTED**self.contradictions

    @property
    def usable(self) -> bool:
        """Whether a planner can use the scale now."""
        return self.chance >= USABLE_CHANCE


def started(measured: Measurement) -> FilterState:
    """Start the filter from one measurement."""
    variance = max(measured.log_sd, _LEAST_LOG_SD) ** 2
    return FilterState(
        measured.log_gsd,
        variance,
        common_log_sd=measured.common_log_sd,
        log_odds=_log_odds(measured.chance),
        information=1 / variance,
    )


def predicted(state: FilterState, seconds: float, motion: Motion | None) -> FilterState | None:
    """Predict the state of the next frame.

    Args:
        state: of the frame before.
        seconds: between the two.
        motion: by features; None if the frames share none.

    Returns:
        The state; None if it says nothing any more.
    """
    if motion is None:
        log_ratio = 0.0
        moved = 1.0
        noise = (_UNLINKED_LOG_SD_PER_S * seconds) ** 2
    else:
        log_ratio = motion.log_ratio
        moved = motion.moved
        noise = _STEADY_LOG_SD**2 + motion.log_sd**2 * motion.moved
    variance = state.variance + noise
    if variance > _WIDEST_LOG_SD**2:
        return None
    return state._replace(
        log_gsd=state.log_gsd + log_ratio,
        variance=variance,
        moved=state.moved + moved,
        silent_s=state.silent_s + seconds,
    )


def corrected(state: FilterState | None, measured: Measurement) -> FilterState:
    """Correct the state by a measurement of the same frame.

    A measurement that contradicts the state lowers the odds. After three in a row, the state starts
    anew from the last.

    Args:
        state: predicted; None starts the filter.
        measured: by the frame's vehicles.
    """
    if state is None:
        return started(measured)
    variance = max(measured.log_sd, _LEAST_LOG_SD) ** 2
    off = measured.log_gsd - state.log_gsd
    if abs(off) > _GATE_SDS * math.sqrt(state.variance + variance):
        if state.contradictions + 1 >= _MOST_CONTRADICTIONS:
            return started(measured)
        return state._replace(
            contradictions=state.contradictions + 1,
            log_odds=state.log_odds - max(_log_odds(measured.chance), 0.0),
        )
    new = max(min(state.moved, 1.0), _SAME_GROUND)
    information = new / variance + (1 - new) * max(0.0, 1 / variance - state.information)
    gain = state.variance * information / (1 + state.variance * information)
    own = _log_odds(measured.chance)
    return FilterState(
        state.log_gsd + gain * off,
        state.variance * (1 - gain),
        common_log_sd=measured.common_log_sd,
        log_odds=min(_MOST_LOG_ODDS, max(state.log_odds + new * own, own)),
        information=1 / variance,
    )


def _log_odds(chance: float) -> float:
    inside = min(max(chance, 1e-3), 1 - 1e-3)
    return min(math.log(inside / (1 - inside)), _MOST_LOG_ODDS)
