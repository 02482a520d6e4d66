"""Scale of each frame of a running camera: features, one searched window, and the filter.

The window lies where the last frames had cars, and now and then elsewhere.
"""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from vehanchor.analysis.pipeline import checked_detector, conclude, search_raster
from vehanchor.detection.scene_scale import load_scene_scale
from vehanchor.imagery.raster import Window
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.imagery.tiles import read_reduced_window
from vehanchor.options.option import Limits
from vehanchor.rulers.scene_scale import SceneScale
from vehanchor.rulers.vehicles import Vehicles
from vehanchor.rulers.witnesses import measure_all
from vehanchor.scale.defaults import CAR_LENGTH_M
from vehanchor.scale.density import quantile
from vehanchor.scale.lengths import Z95
from vehanchor_flight.features import find_features
from vehanchor_flight.live.filter import FilterState, Measurement, Motion, corrected, predicted
from vehanchor_flight.matching import match
from vehanchor_flight.records import LiveScale

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.analysis.scale_analysis import ScaleAnalysis
    from vehanchor.detection.detector import Detector
    from vehanchor.detection.scene_scale import SceneScalePrior
    from vehanchor.imagery.raster import Raster
    from vehanchor.options import ScaleOptions
    from vehanchor.records import GsdEstimate, Reason, Status
    from vehanchor_flight.features import Features
    from vehanchor_flight.live.frames import Frame
    from vehanchor_flight.matching import Match

    Points: TypeAlias = NDArray[np.float64]
    """Points x, y ``[n, 2]`` in pixels."""

    Corner: TypeAlias = NDArray[np.intp]
    """Corner x, y ``[2]`` of a window in pixels."""

    Flags: TypeAlias = NDArray[np.bool_]
    """Which of the points have a property."""

HOLD_S = Limits(above=0, most=3600)
"""Limits of the seconds without vehicles after which there is no scale."""

WINDOW_PX = 640
"""Side of a searched window in the reduced frame."""

_MAX_CAR_LENGTH_PX = 60.0  # In the reduced frame.
_MAX_REDUCTION = 8
_MIN_SHORTER_SIDE_PX = WINDOW_PX // 4  # Of the reduced frame.
_ELSEWHERE_PERIOD = 4  # One window in four is the next in turn, wherever the cars are.
_FEATURES_SIDE_PX = 480  # Of the reduced copy: a third of the side of 1280 px.
# Frames between two checks of the image's proportions, which do not change in flight.
_STRETCH_PERIOD = 10
_PRIOR_FRAMES = 1.0  # New ground, in frames, after which the scene-scale prior is predicted again.
_GRID_POINTS = 8  # Along each side of a frame, to count its new ground.


class LiveEstimator:
    """Estimates the scale of one frame after the other.

    Args:
        detector: finds the vehicles.
        options: of the method; the rulers are vehicles and the scene-scale prior.
        hold_s: seconds without vehicles after which there is no scale.

    Raises:
        InvalidParameterError: the seconds are invalid, or the model does not know the region.
    """

    def __init__(
        self,
        detector: Detector,
        options: ScaleOptions,
        *,
        hold_s: float = 10.0,
    ) -> None:
        options.check_for_several_images()
        kinds = (Vehicles.kind, SceneScale.kind)
        rulers = replace(options.rulers, rulers=kinds, metadata=False)
        self._options = replace(options, rulers=rulers)
        self._detector = checked_detector(detector, self._options)
        self._hold_s = HOLD_S.check("hold", hold_s)
        self._network = load_scene_scale(detector.runtime)
        self._n_frames = 0
        self._first_s = 0.0
        self._last_s = 0.0
        self._state: FilterState | None = None
        self._features: Features | None = None
        self._prior: SceneScalePrior | None = None
        # New ground since the prior was predicted, in frames.
        self._prior_moved = math.inf
        self._stretch: float | None = None
        self._stretch_log_odds: float | None = None
        # Centres of the cars of the last frames, in pixels of the current one.
        self._cars: Points = np.zeros((0, 2))

    def estimate(self, frame: Frame) -> LiveScale:
        """Estimate the scale of the next frame."""
        if self._n_frames == 0:
            self._first_s = frame.at_s
            self._last_s = frame.at_s
        seconds = max(0.0, frame.at_s - self._last_s)
        self._last_s = frame.at_s
        with open_raster(frame.image) as raster:
            linked = self._follow(raster, seconds)
            analysis = self._search(raster)
        self._n_frames += 1
        return self._record(frame, analysis.estimate, linked=linked)

    def _follow(self, raster: Raster, seconds: float) -> bool:
        """Move the state, the prior and the cars from the last frame to this one.

        Returns:
            Whether features link the two frames.
        """
        features = find_features(raster, _FEATURES_SIDE_PX)
        last_features = self._features
        self._features = features
        matched = None
        motion = None
        if last_features is not None:
            matched = match(last_features, features)
        if matched is not None:
            motion = _motion(matched, raster.width_px, raster.height_px)
        self._predict_state(seconds, motion)
        if matched is None or motion is None:
            # The frame may show other ground.
            self._prior_moved = math.inf
            self._cars = np.zeros((0, 2))
            return False
        self._prior_moved += motion.moved
        if self._prior is not None:
            ratio = math.exp(motion.log_ratio)
            self._prior = self._prior.scaled(ratio)
        rotation = matched.turn[:, :2]
        shift = matched.turn[:, 2]
        cars = self._cars @ rotation.T + shift
        is_shown = _is_in_frame(cars, raster.width_px, raster.height_px)
        self._cars = cars[is_shown]
        return True

    def _predict_state(self, seconds: float, motion: Motion | None) -> None:
        """Predict the state of this frame; a state without vehicles for too long ends."""
        state = self._state
        if state is not None:
            state = predicted(state, seconds, motion)
        if state is not None and state.silent_s > self._hold_s:
            state = None
        self._state = state

    def _search(self, raster: Raster) -> ScaleAnalysis:
        """Search one window of the frame, and correct the state by its vehicles."""
        if self._prior_moved >= _PRIOR_FRAMES:
            self._prior = self._network.predict(raster)
            self._prior_moved = 0.0
        expected_gsd = self._expected_gsd()
        factor = reduction_factor(expected_gsd, raster.width_px, raster.height_px)
        window = next_window(
            raster.width_px,
            raster.height_px,
            factor=factor,
            turn=self._n_frames,
            cars=self._cars,
        )
        analysis = self._analyse(raster, window, factor)
        measured = measurement(analysis, factor)
        if measured is not None:
            self._state = corrected(self._state, measured)
        self._replace_cars(analysis, window, factor)
        return analysis

    def _analyse(self, raster: Raster, window: Window, factor: int) -> ScaleAnalysis:
        """Search a window of the reduced frame, and measure its scale.

        Args:
            raster: the frame.
            window: in pixels of the reduced frame.
            factor: reduction of the frame.
        """
        prior = self._prior
        if prior is not None:
            prior = prior.scaled(factor)
        is_due = self._n_frames % _STRETCH_PERIOD == 0
        check_stretch = self._stretch is None or is_due
        with open_raster(read_reduced_window(raster, window, factor)) as part:
            view = search_raster(
                part,
                self._detector,
                options=self._options,
                prior=prior,
                check_stretch=check_stretch,
            )
            if view.detections.stretch is not None:
                self._stretch = view.detections.stretch
            if view.detections.stretch_log_odds is not None:
                self._stretch_log_odds = view.detections.stretch_log_odds
            detections = replace(
                view.detections, stretch=self._stretch, stretch_log_odds=self._stretch_log_odds
            )
            # The view has no tilt: the camera looks down.
            view = replace(view, detections=detections)
            witnesses = measure_all(view)
            return conclude(view, witnesses)

    def _expected_gsd(self) -> float | None:
        """Return the scale by the filter, else by the prior."""
        if self._state is not None:
            return self._state.gsd_m_per_px
        if self._prior is not None:
            return quantile(self._prior.density, 0.5)
        return None

    def _replace_cars(self, analysis: ScaleAnalysis, window: Window, factor: int) -> None:
        """Replace the known cars inside a window by those of its search.

        Args:
            analysis: of the window.
            window: in pixels of the reduced frame.
            factor: reduction of the frame.
        """
        low, high = _corners(window)
        is_inside = _is_inside(self._cars, low * factor, high * factor)
        new_cars = np.zeros((0, 2))
        if analysis.vehicles is not None:
            centres = analysis.vehicles.fleet.centres
            new_cars = centres * factor + low * factor
        other_cars = self._cars[~is_inside]
        self._cars = np.concatenate([other_cars, new_cars])

    def _record(self, frame: Frame, window: GsdEstimate, *, linked: bool) -> LiveScale:
        """Make the record of a frame from the filter and the estimate of the searched window."""
        state = self._state
        status: Status = "no_scale"
        reason: Reason | None = window.reason or "imprecise"
        gsd: float | None = None
        low: float | None = None
        high: float | None = None
        confidence = 0.0
        seen_s_ago: float | None = None
        if state is not None:
            status = "low_confidence"
            gsd = state.gsd_m_per_px
            low, high = state.interval
            confidence = state.chance
            seen_s_ago = state.silent_s
            if state.usable:
                status = "ok"
                reason = None
            elif state.contradictions > 0:
                reason = "disagree"
        height_px, width_px, _ = frame.image.shape
        latency_s = time.monotonic() - frame.arrived_s
        return LiveScale(
            frame=frame.name,
            at_s=frame.at_s - self._first_s,
            status=status,
            gsd_m_per_px=gsd,
            gsd_ci95_low_m_per_px=low,
            gsd_ci95_high_m_per_px=high,
            confidence=confidence,
            reason=reason,
            n_vehicles=window.n_vehicles or 0,
            seen_s_ago=seen_s_ago,
            linked=linked,
            n_skipped=frame.n_skipped,
            latency_s=max(0.0, latency_s),
            image_width_px=width_px,
            image_height_px=height_px,
        )


def reduction_factor(gsd_m_per_px: float | None, width_px: int, height_px: int) -> int:
    """Choose the reduction of a frame at which cars have a length that the detector knows.

    Args:
        gsd_m_per_px: expected scale; None if unknown.
        width_px: width of the frame.
        height_px: height of the frame.

    Returns:
        A power of two, at which the frame's shorter side still has a quarter of a window.
    """
    factor = 1
    length_px = 0.0
    if gsd_m_per_px is not None:
        length_px = CAR_LENGTH_M / gsd_m_per_px
    shorter_px = min(width_px, height_px)
    while length_px / factor > _MAX_CAR_LENGTH_PX and factor < _MAX_REDUCTION:
        next_factor = 2 * factor
        if shorter_px // next_factor < _MIN_SHORTER_SIDE_PX:
            break
        factor = next_factor
    return factor


def next_window(
    width_px: int,
    height_px: int,
    factor: int,
    turn: int,
    cars: Points,
) -> Window:
    """Choose the window to search in a frame.

    Args:
        width_px: width of the frame.
        height_px: height of the frame.
        factor: reduction of the frame.
        turn: number of the frame.
        cars: ``[n, 2]`` centres of the cars of the last frames, pixels of this frame.

    Returns:
        In pixels of the reduced frame: the window around the car with the most neighbours, or in
        every fourth turn and without cars the next of all windows.
    """
    width = width_px // factor
    height = height_px // factor
    if not len(cars):
        windows = _all_windows(width, height)
        return windows[turn % len(windows)]
    if turn % _ELSEWHERE_PERIOD == 0:
        windows = _all_windows(width, height)
        return windows[turn // _ELSEWHERE_PERIOD % len(windows)]
    return _fullest_window(width, height, cars / factor)


def _window_sides(width: int, height: int) -> tuple[int, int]:
    """Return width and height of a window; a frame can be smaller than a whole one."""
    return min(WINDOW_PX, width), min(WINDOW_PX, height)


def _all_windows(width: int, height: int) -> list[Window]:
    """List windows that cover a reduced frame, row by row, with even overlaps."""
    window_width, window_height = _window_sides(width, height)
    n_columns = math.ceil(width / window_width)
    n_rows = math.ceil(height / window_height)
    lefts = np.linspace(0, width - window_width, n_columns)
    tops = np.linspace(0, height - window_height, n_rows)
    return [
        Window(left, top, window_width, window_height)
        for top in tops.astype(int).tolist()
        for left in lefts.astype(int).tolist()
    ]


def _fullest_window(width: int, height: int, cars: Points) -> Window:
    """Choose the window around a car that holds the most cars.

    Args:
        width: width of the reduced frame.
        height: height of the reduced frame.
        cars: ``[n, 2]`` centres in its pixels.
    """
    frame_size = np.array([width, height])
    window_width, window_height = _window_sides(width, height)
    window_size = np.array([window_width, window_height])
    # Each car is in the middle of a window, unless this would leave the frame.
    corners = np.rint(cars - window_size / 2)
    corners = np.clip(corners, 0, frame_size - window_size)
    windows = []
    n_cars = []
    for left, top in corners:
        x_px = int(left)
        y_px = int(top)
        window = Window(x_px, y_px, width_px=window_width, height_px=window_height)
        low, high = _corners(window)
        windows.append(window)
        is_inside = _is_inside(cars, low, high)
        n_cars.append(int(is_inside.sum()))
    fullest = int(np.argmax(n_cars))
    return windows[fullest]


def _corners(window: Window) -> tuple[Corner, Corner]:
    """Return the upper left and the lower right corner of a window, ``[2]`` each."""
    low = np.array([window.x_px, window.y_px])
    size = np.array([window.width_px, window.height_px])
    return low, low + size


def _is_inside(points: Points, low: Corner, high: Corner) -> Flags:
    """Find the points ``[n, 2]`` between two corners."""
    is_between = (points >= low) & (points < high)
    return np.asarray(is_between.all(axis=1))


def _is_in_frame(points: Points, width_px: int, height_px: int) -> Flags:
    """Find the points ``[n, 2]`` inside a frame."""
    low = np.zeros(2, np.intp)
    high = np.array([width_px, height_px])
    return _is_inside(points, low, high)


def measurement(analysis: ScaleAnalysis, factor: int) -> Measurement | None:
    """Make the filter's measurement from the analysis of a reduced window.

    Args:
        analysis: of the window.
        factor: its reduction.

    Returns:
        The measurement in pixels of the frame; None without a scale.
    """
    estimate = analysis.estimate
    vehicles = analysis.vehicles
    low = estimate.gsd_ci95_low_m_per_px
    high = estimate.gsd_ci95_high_m_per_px
    if estimate.gsd_m_per_px is None or vehicles is None:
        return None
    if not low or not high:
        return None
    # The interval holds the error of the reference length, too, which all cars of the flight share.
    log_sd = math.log(high / low) / (2 * Z95)
    common_log_sd = min(log_sd, vehicles.reference.log_sd)
    own_variance = max(log_sd**2 - common_log_sd**2, 0.0)
    return Measurement(
        math.log(estimate.gsd_m_per_px / factor),
        math.sqrt(own_variance),
        common_log_sd=common_log_sd,
        chance=estimate.confidence,
    )


def _motion(matched: Match, width_px: int, height_px: int) -> Motion:
    """Describe the change from the first frame to the second."""
    # Count the points of a grid in the second frame that the first one shows, too.
    steps = np.arange(_GRID_POINTS) + 0.5
    x = steps * width_px / _GRID_POINTS
    y = steps * height_px / _GRID_POINTS
    across, down = np.meshgrid(x, y)
    points = np.column_stack([across.ravel(), down.ravel()])
    rotation = matched.turn[:, :2]
    shifted = points - matched.turn[:, 2]
    solution = np.linalg.solve(rotation, shifted.T)
    earlier = np.asarray(solution, dtype=np.float64)
    is_shared = _is_in_frame(earlier.T, width_px, height_px)
    moved = 1.0 - float(is_shared.mean())
    return Motion(-matched.log_ratio, matched.log_sd, moved)
