"""Scale of each frame of a running camera: features, one searched window, and the filter.

The window lies where the last frames had cars, and now and then elsewhere.
"""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import TYPE_CHECKING

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
    from vehanchor.records import GsdEstimate
    from vehanchor_flight.features import Features
    from vehanchor_flight.live.frames import Frame
    from vehanchor_flight.matching import Match

HOLD_S = Limits(above=0, most=3600)
"""Limits of the seconds without vehicles after which there is no scale."""

WINDOW_PX = 640
"""Side of a searched window in the reduced frame."""

_LONGEST_CAR_PX = 60.0  # in the reduced frame
_MOST_FACTOR = 8
_ELSEWHERE_EVERY = 4  # one window in four is the next in turn
_FEATURES_SIDE_PX = 480  # of the reduced copy: a third of the side of 1280 px
# frames; a camera's proportions do not change in flight, so that the last result is kept
_STRETCH_EVERY = 10
_PRIOR_FRAMES = 1.0  # new ground, in frames, after which the scene-scale prior is taken again
_GRID_POINTS = 8  # along each side of a frame, to count its new ground


class LiveEstimator:
    """Estimates the scale of one frame after the other.

    Args:
        detector: finds the vehicles.
        options: of the method; the rulers are vehicles and the scene-scale prior.
        hold_s: seconds without vehicles after which there is no scale.

    Raises:
        InvalidParameterError: the seconds are invalid, or the model does not know the region.
    """

    def __init__(self, detector: Detector, options: ScaleOptions, *, hold_s: float = 10.0) -> None:
        options.by_hand.check_single()
        rulers = replace(options.rulers, rulers=(Vehicles.kind, SceneScale.kind), metadata=False)
        self._options = replace(options, rulers=rulers)
        self._detector = checked_detector(detector, self._options)
        self._hold_s = HOLD_S.check("hold", hold_s)
        self._network = load_scene_scale(detector.runtime)
        self._turn = 0
        self._first_s = 0.0
        self._last_s = 0.0
        self._state: FilterState | None = None
        self._features: Features | None = None
        self._prior: SceneScalePrior | None = None
        self._prior_moved = math.inf  # new ground since the prior was taken
        self._stretch: float | None = None
        self._cars: NDArray[np.float64] = np.zeros((0, 2))

    def estimate(self, frame: Frame) -> LiveScale:
        """Estimate the scale of the next frame."""
        if self._turn == 0:
            self._first_s = self._last_s = frame.at_s
        seconds = max(0.0, frame.at_s - self._last_s)
        self._last_s = frame.at_s
        with open_raster(frame.image) as raster:
            linked = self._follow(raster, seconds)
            analysis = self._search(raster)
        self._turn += 1
        return self._record(frame, analysis.estimate, linked=linked)

    def _follow(self, raster: Raster, seconds: float) -> bool:
        """Move the state, the prior and the cars from the last frame to this one; tell whether features link them."""
        features = find_features(raster, _FEATURES_SIDE_PX)
        before = self._features
        self._features = features
        matched = None if before is None else match(before, features)
        motion = None if matched is None else _motion(matched, raster.width_px, raster.height_px)
        if self._state is not None:
            self._state = predicted(self._state, seconds, motion)
        if self._state is not None and self._state.silent_s > self._hold_s:
            self._state = None
        if matched is None or motion is None:
            self._prior_moved = math.inf
            self._cars = np.zeros((0, 2))
            return False
        self._prior_moved += motion.moved
        if self._prior is not None:
            self._prior = self._prior.scaled(math.exp(motion.log_ratio))
        cars = self._cars @ matched.turn[:, :2].T + matched.turn[:, 2]
        self._cars = cars[
            np.all((cars >= 0) & (cars < (raster.width_px, raster.height_px)), axis=1)
        ]
        return True

    def _search(self, raster: Raster) -> ScaleAnalysis:
        """Search one window of the frame, and correct the state by its vehicles."""
        if self._prior_moved >= _PRIOR_FRAMES:
            self._prior = self._network.predict(raster)
            self._prior_moved = 0.0
        factor = reduction_factor(self._expected_gsd(), raster.width_px, raster.height_px)
        window = next_window(
            raster.width_px, raster.height_px, factor=factor, turn=self._turn, cars=self._cars
        )
        prior = None if self._prior is None else self._prior.scaled(factor)
        with open_raster(read_reduced_window(raster, window, factor)) as part:
            checks = self._stretch is None or self._turn % _STRETCH_EVERY == 0
            view = search_raster(
                part, self._detector, options=self._options, prior=prior, check_stretch=checks
            )
            if view.detections.stretch is not None:
                self._stretch = view.detections.stretch
            view = replace(view, detections=replace(view.detections, stretch=self._stretch))
            analysis = conclude(view, measure_all(view))  # no tilt: the camera looks down
        measured = measurement(analysis, factor)
        if measured is not None:
            self._state = corrected(self._state, measured)
        self._replace_cars(analysis, window, factor)
        return analysis

    def _expected_gsd(self) -> float | None:
        """Give the scale by the filter, else by the prior."""
        if self._state is not None:
            return self._state.gsd_m_per_px
        return None if self._prior is None else quantile(self._prior.density, 0.5)

    def _replace_cars(self, analysis: ScaleAnalysis, window: Window, factor: int) -> None:
        """Replace the known cars inside a window by those that were found there."""
        low = np.array([window.x_px, window.y_px]) * factor
        high = low + np.array([window.width_px, window.height_px]) * factor
        outside = ~np.all((self._cars >= low) & (self._cars < high), axis=1)
        centres = np.zeros((0, 2)) if analysis.vehicles is None else analysis.vehicles.fleet.centres
        self._cars = np.concatenate([self._cars[outside], centres * factor + low])

    def _record(self, frame: Frame, window: GsdEstimate, *, linked: bool) -> LiveScale:
        state = self._state
        interval = None if state is None else state.interval
        usable = state is not None and state.usable
        contradicted = state is not None and state.contradictions > 0
        return LiveScale(
            frame=frame.name,
            at_s=frame.at_s - self._first_s,
            status="no_scale" if state is None else "ok" if usable else "low_confidence",
            gsd_m_per_px=None if state is None else state.gsd_m_per_px,
            gsd_ci95_low_m_per_px=interval and interval.low,
            gsd_ci95_high_m_per_px=interval and interval.high,
            confidence=0.0 if state is None else state.chance,
            reason=None if usable else "disagree" if contradicted else window.reason or "imprecise",
            n_vehicles=window.n_vehicles or 0,
            seen_s_ago=None if state is None else state.silent_s,
            linked=linked,
            n_skipped=frame.n_skipped,
            latency_s=max(0.0, time.monotonic() - frame.arrived_s),
            image_width_px=frame.image.shape[1],
            image_height_px=frame.image.shape[0],
        )


def reduction_factor(gsd_m_per_px: float | None, width_px: int, height_px: int) -> int:
    """Choose the reduction of a frame at which cars have a length that the detector knows.

    Args:
        gsd_m_per_px: expected scale; None if unknown.
        width_px: width of the frame.
        height_px: height of the frame.

    Returns:
        A power of two, at which the frame's shorter side still has half a window.
    """
    factor = 1
    length_px = 0.0 if gsd_m_per_px is None else CAR_LENGTH_M / gsd_m_per_px
    while (
        length_px / factor > _LONGEST_CAR_PX
        and factor < _MOST_FACTOR
        and min(width_px, height_px) // (2 * factor) >= WINDOW_PX // 4
    ):
        factor *= 2
    return factor


def next_window(
    width_px: int, height_px: int, factor: int, turn: int, cars: NDArray[np.float64]
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
    side = min(WINDOW_PX, width), min(WINDOW_PX, height)
    if len(cars) and turn % _ELSEWHERE_EVERY:
        corners = np.clip(
            np.rint(cars / factor - np.array(side) / 2),
            0,
            np.array([width, height]) - np.array(side),
        )
        around = [Window(int(left), int(top), *side) for left, top in corners]
        return around[int(np.argmax([_inside(cars / factor, each) for each in around]))]
    lefts, tops = (
        np.linspace(0, extent - own, math.ceil(extent / own)).astype(int).tolist()  # spread evenly
        for extent, own in zip((width, height), side, strict=True)
    )
    windows = [Window(left, top, *side) for top in tops for left in lefts]
    return windows[(turn // _ELSEWHERE_EVERY if len(cars) else turn) % len(windows)]


def _inside(points: NDArray[np.float64], window: Window) -> int:
    low = np.array([window.x_px, window.y_px])
    high = low + np.array([window.width_px, window.height_px])
    return int(np.all((points >= low) & (points < high), axis=1).sum())


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
    if estimate.gsd_m_per_px is None or vehicles is None or not low or not high:
        return None
    log_sd = math.log(high / low) / (2 * Z95)
    common = min(log_sd, vehicles.reference.log_sd)
    own = math.sqrt(max(log_sd**2 - common**2, 0.0))
    return Measurement(
        math.log(estimate.gsd_m_per_px / factor),
        own,
        common_log_sd=common,
        chance=estimate.confidence,
    )


def _motion(matched: Match, width_px: int, height_px: int) -> Motion:
    """Describe the change from the first frame to the second."""
    across, down = np.meshgrid(
        (np.arange(_GRID_POINTS) + 0.5) * width_px / _GRID_POINTS,
        (np.arange(_GRID_POINTS) + 0.5) * height_px / _GRID_POINTS,
    )
    points = np.column_stack([across.ravel(), down.ravel()])
    earlier = np.linalg.solve(matched.turn[:, :2], (points - matched.turn[:, 2]).T).T
    shared = np.all((earlier >= 0) & (earlier < (width_px, height_px)), axis=1).mean()
    return Motion(-matched.log_ratio, matched.log_sd, 1.0 - float(shared))
