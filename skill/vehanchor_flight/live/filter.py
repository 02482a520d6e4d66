"""Kalman filter over the log of a camera's scale, as pure functions of a frozen state.

The state is the natural log of metres per pixel. Features between frames predict it; the vehicles
of a frame correct it. Frames of the same ground show the same cars: they repeat an error instead of
averaging it. A measurement therefore counts by the new ground since the one before. The error of
the reference length is common to the flight, and no number of frames reduces it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from vehanchor.odds import chance_of, log_odds_of
from vehanchor.scale.defaults import USABLE_CHANCE
from vehanchor.scale.density import TOLERANCE
from vehanchor.scale.lengths import Z95, Interval

_STEADY_LOG_SD = 0.002  # Of the ratio between two frames of the same ground.
_UNLINKED_LOG_SD_PER_S = 0.5  # A climb of 5 m/s at 10 m of height.
_MAX_LOG_SD = 1.0  # Beyond it, the state says nothing.
# Share of a measurement that counts without new ground: the noise of single boxes.
_SAME_GROUND_SHARE = 0.02
_MIN_LOG_SD = 0.02  # Of a measurement, beside the common error.
_GATE_SDS = 3.5  # A measurement that is farther off contradicts the state.
_MAX_CONTRADICTIONS = 3  # In a row; then the state was wrong.
_MAX_LOG_ODDS = 4.0
_MIN_CHANCE = 1e-3  # Keeps log odds finite.
# Factor on the chance for each contradiction in a row: either may be right. Our choice.
_CONTRADICTION_FACTOR = 0.5


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
        low = math.exp(self.log_gsd - reach)
        high = math.exp(self.log_gsd + reach)
        return Interval(low, high)

    @property
    def chance(self) -> float:
        """Probability of an error below 20 %."""
        # The scale is right if the vehicles are cars and the normal error of the log is small.
        tolerance = math.log1p(TOLERANCE)
        width = self.log_sd * math.sqrt(2)
        within = math.erf(tolerance / width)
        chance = within * chance_of(self.log_odds)
        return chance * _CONTRADICTION_FACTOR**self.contradictions

    @property
    def usable(self) -> bool:
        """Whether a planner can use the scale now."""
        return self.chance >= USABLE_CHANCE


def started(measured: Measurement) -> FilterState:
    """Start the filter from one measurement."""
    variance = _own_variance(measured)
    return FilterState(
        measured.log_gsd,
        variance,
        common_log_sd=measured.common_log_sd,
        log_odds=_log_odds(measured.chance),
        information=1 / variance,
    )


def predicted(
    state: FilterState,
    seconds: float,
    motion: Motion | None,
) -> FilterState | None:
    """Predict the state of the next frame.

    Args:
        state: of the frame before.
        seconds: between the two.
        motion: by features; None if the frames share none.

    Returns:
        The state; None if its error is too large to say anything.
    """
    if motion is None:
        # Nothing in common: the scale stays the best guess, and its error grows with time.
        log_ratio = 0.0
        moved = 1.0
        noise = (_UNLINKED_LOG_SD_PER_S * seconds) ** 2
    else:
        # Frames of the same ground match better than frames that hardly overlap.
        log_ratio = motion.log_ratio
        moved = motion.moved
        match_variance = motion.log_sd**2
        noise = _STEADY_LOG_SD**2 + match_variance * motion.moved
    variance = state.variance + noise
    if variance > _MAX_LOG_SD**2:
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
    variance = _own_variance(measured)
    innovation = measured.log_gsd - state.log_gsd
    innovation_sd = math.sqrt(state.variance + variance)
    if abs(innovation) > _GATE_SDS * innovation_sd:
        return _contradicted(state, measured)
    # Over new ground, the whole measurement counts. Over the ground of the last measurement, its
    # error repeats, and only what it knows beyond the last one counts.
    new_share = max(min(state.moved, 1.0), _SAME_GROUND_SHARE)
    additional = max(0.0, 1 / variance - state.information)
    information = new_share / variance + (1 - new_share) * additional
    # Kalman gain, in terms of information.
    ratio = state.variance * information
    gain = ratio / (1 + ratio)
    # Cars over new ground confirm those before, and a single sure frame is enough.
    own_log_odds = _log_odds(measured.chance)
    confirmed_log_odds = state.log_odds + new_share * own_log_odds
    log_odds = max(confirmed_log_odds, own_log_odds)
    return FilterState(
        state.log_gsd + gain * innovation,
        state.variance * (1 - gain),
        common_log_sd=measured.common_log_sd,
        log_odds=min(_MAX_LOG_ODDS, log_odds),
        information=1 / variance,
    )


def _contradicted(state: FilterState, measured: Measurement) -> FilterState:
    """Keep the scale of the state and lower its odds, or start anew from the measurement."""
    contradictions = state.contradictions + 1
    if contradictions >= _MAX_CONTRADICTIONS:
        return started(measured)
    own_log_odds = _log_odds(measured.chance)
    log_odds = state.log_odds - max(own_log_odds, 0.0)
    return state._replace(contradictions=contradictions, log_odds=log_odds)


def _own_variance(measured: Measurement) -> float:
    """Return the variance of a measurement's own error, with a lower limit."""
    return max(measured.log_sd, _MIN_LOG_SD) ** 2


def _log_odds(chance: float) -> float:
    """Convert a chance to log odds, within limits."""
    inside = max(chance, _MIN_CHANCE)
    inside = min(inside, 1 - _MIN_CHANCE)
    log_odds = log_odds_of(inside)
    return min(log_odds, _MAX_LOG_ODDS)
