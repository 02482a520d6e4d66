"""Distance on the ground: an image and two points or a path in, metres out.

Raster + path -> pixels x GSD -> record. The scale comes from the vehicles of the whole image, or from the caller.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.analysis.measured import DistanceAnalysis
from vehanchor.errors import PromptError
from vehanchor.imagery.sources.opening import can_be_read_again, open_raster
from vehanchor.measure.coordinates import CoordinateFrame
from vehanchor.measure.resolved_scale import choose_scale, interval_around, resolve_scale
from vehanchor.options import ScaleOptions
from vehanchor.records import DistanceMeasurement, ImagePoint
from vehanchor.records.interop import places_of

if TYPE_CHECKING:
    import os
    from collections.abc import Callable, Mapping, Sequence
    from typing import Any, Unpack

    import onnxruntime

    from vehanchor.detection.detector import Detector
    from vehanchor.imagery.raster import Raster
    from vehanchor.imagery.sources.opening import ImageSource
    from vehanchor.measure.coordinates import Place
    from vehanchor.measure.resolved_scale import ResolvedScale, ScaleInput
    from vehanchor.options import OptionKeywords
    from vehanchor.records import GsdEstimate, KnownScale

MIN_PATH_PX = 2.0
"""Shortest path, pixels of the full image."""

MAX_PATH_POINTS = 1000
_POINT_SD = 1.0  # how well a place is hit, in the finest step of the caller's coordinates, as for lines of known length


def measure_distance(
    image: ImageSource,
    path: Sequence[Place],
    *,
    gsd_m_per_px: float | None = None,
    scale: KnownScale | GsdEstimate | Mapping[str, Any] | None = None,
    object_height_m: float | None = None,
    detector: Detector | str | os.PathLike[str] | None = None,
    threads: int | None = None,
    providers: Sequence[str] | None = None,
    progress: Callable[[int, int], None] | None = None,
    **options: Unpack[OptionKeywords],
) -> DistanceMeasurement:
    """Measure the length of a line on the ground, ``D = P * GSD``.

    Places are in pixels, the image's first pixel spanning 0 to 1; of the caller's resized copy where a frame is named;
    in shares of the sides where ``coordinates`` says so.

    Args:
        image: as in ``estimate_gsd``.
        path: x, y of two points or more, in order; the line is straight between them. Or a line of shapely.
        gsd_m_per_px: the scale, metres per pixel of the full image, where it is known: then no detector runs.
        scale: an earlier estimate of this image, or its ``scale``: then no detector runs, either, and its interval and
            confidence hold.
        object_height_m: how high it lies above the ground, as a roof does; None for on it.
        detector: as in ``estimate_gsd``.
        threads: as in ``estimate_gsd``.
        providers: as in ``estimate_gsd``.
        progress: called with (tiles done, tiles in all) while vehicles are searched.
        **options: as in ``estimate_gsd``; the frame is that of the path, too.

    Returns:
        The record; ``distance_m`` is None, never a guess, where there is no scale.

    Raises:
        PromptError: fewer than two points, one outside the image, or all in one place.
        ImageError: the image cannot be used; see ``vehanchor.errors`` for its kinds.
        ModelError: the detector cannot be used.
        InvalidParameterError: an option has no meaning.
        FrameError: the frame has another aspect ratio than the image.
        ScaleMismatchError: the scale was estimated from another image.
        CalibrationError: the calibration cannot be read, or was made for another detector.
    """
    return analyse_distance(
        image,
        path,
        ScaleOptions.of(options),
        gsd_m_per_px=gsd_m_per_px,
        scale=scale,
        object_height_m=object_height_m,
        detector=detector,
        threads=threads,
        providers=providers,
        progress=progress,
    ).measurement


def analyse_distance(
    image: ImageSource,
    path: Sequence[Place],
    options: ScaleOptions | None = None,
    *,
    gsd_m_per_px: float | None = None,
    scale: KnownScale | GsdEstimate | Mapping[str, Any] | None = None,
    object_height_m: float | None = None,
    detector: Detector | str | os.PathLike[str] | None = None,
    threads: int | None = None,
    providers: Sequence[str] | None = None,
    progress: Callable[[int, int], None] | None = None,
    run_options: onnxruntime.RunOptions | None = None,
) -> DistanceAnalysis:
    """As ``measure_distance``, with the vehicles behind the number.

    Args:
        image: as in ``estimate_gsd``.
        path: as in ``measure_distance``, as all that follow.
        options: every choice of the method of scale, the frame included; None for the defaults.
        gsd_m_per_px: a known scale.
        scale: one that was estimated before.
        object_height_m: above the ground.
        detector: of vehicles.
        threads: CPU threads.
        providers: where models run.
        progress: of the search for vehicles.
        run_options: ONNX Runtime's, for a caller that may have to end a running model (``terminate``).

    Returns:
        The record and the scale's analysis.

    Raises:
        VehAnchorError: as ``measure_distance``.
    """
    chosen = options or ScaleOptions()
    places = read_path(path)
    source = choose_scale(gsd_m_per_px, scale, detector, chosen, threads=threads, providers=providers)
    with open_raster(image, bands=chosen.reading.bands, limits=chosen.reading.limits, bgr=chosen.reading.bgr) as raster:
        (analysis,) = analyse_paths(
            raster,
            [places],
            source,
            chosen,
            object_height_m=object_height_m,
            progress=progress,
            run_options=run_options,
        )
    seen = image if can_be_read_again(image) else None
    return replace(analysis, image=seen, reading=chosen.reading, ground=raster.ground)


def read_path(path: Sequence[Place]) -> tuple[Place, ...]:
    """Take a path as the caller gave it, checked for itself.

    Raises:
        PromptError: fewer than two points, or one that is no two finite numbers.
    """
    places = []
    for each in places_of(path):
        try:
            x, y = (float(value) for value in each)
        except (TypeError, ValueError):
            raise PromptError(f"a point of the path is {each!r}: use x, y") from None
        if not (math.isfinite(x) and math.isfinite(y)):
            raise PromptError(f"a point of the path is {x}, {y}: use finite numbers")
        places.append((x, y))
    if not 2 <= len(places) <= MAX_PATH_POINTS:
        raise PromptError(f"the path has {len(places)} points: give two, or up to {MAX_PATH_POINTS} along a line")
    return tuple(places)


def analyse_paths(
    raster: Raster,
    paths: Sequence[Sequence[Place]],
    scale: ScaleInput,
    options: ScaleOptions,
    *,
    object_height_m: float | None = None,
    progress: Callable[[int, int], None] | None = None,
    run_options: onnxruntime.RunOptions | None = None,
) -> tuple[DistanceAnalysis, ...]:
    """As ``analyse_distance``, of several paths in an image that is open already: one search serves them all.

    Args:
        raster: the image.
        paths: what ``read_path`` gave, in the caller's coordinates.
        scale: what ``choose_scale`` gave.
        options: every choice of the method of scale.
        object_height_m: above the ground, of all of them.
        progress: of the search for vehicles.
        run_options: ONNX Runtime's, for a caller that may have to end a running model (``terminate``).

    Raises:
        VehAnchorError: as ``measure_distance``.
    """
    options.frame.check(raster.width_px, raster.height_px)
    coordinates = CoordinateFrame(options.frame, raster.width_px, raster.height_px)
    in_image = [_in_image(path, coordinates) for path in paths]
    found = resolve_scale(
        raster, scale, options, object_height_m=object_height_m, progress=progress, run_options=run_options
    )
    return tuple(
        DistanceAnalysis(_conclude(path, coordinates, found), scale=found.analysis, nadir=found.plane is None)
        for path in in_image
    )


def _in_image(path: Sequence[Place], coordinates: CoordinateFrame) -> list[Place]:
    outside = next((place for place in path if not coordinates.inside([place])), None)
    if outside is not None:
        raise PromptError(
            f"point {outside[0]:g}, {outside[1]:g} is not inside the {coordinates.name}"
            f"{coordinates.other_reading(path)}"
        )
    places = [coordinates.in_image(place) for place in path]
    length_px = _length(places)
    if length_px < MIN_PATH_PX:
        raise PromptError(
            f"the path is {length_px:.3g} px of the full image long: at least {MIN_PATH_PX:g} px are needed"
            f"{coordinates.other_reading(path)}"
        )
    return places


def _length(places: Sequence[Place]) -> float:
    return sum(math.dist(first, second) for first, second in pairwise(places))


def _length_sd(places: Sequence[Place], unit_px: tuple[float, float]) -> float:
    """Standard deviation of a path's length, pixels, where each point is hit no better than a step of coordinates."""
    at = np.array(places)
    legs = np.diff(at, axis=0)
    reach = np.hypot(legs[:, 0], legs[:, 1])[:, None]
    along = np.divide(legs, reach, out=np.zeros_like(legs), where=reach > 0)
    gradient = np.zeros_like(at)  # of the length by each point: a point on a straight line adds nothing
    gradient[:-1] -= along
    gradient[1:] += along
    return float(np.hypot.reduce((gradient * unit_px * _POINT_SD).ravel()))


def _conclude(places: Sequence[Place], coordinates: CoordinateFrame, scale: ResolvedScale) -> DistanceMeasurement:
    """Path and scale to record."""
    length_px, gsd, estimate = _length(places), scale.gsd_m_per_px, scale.estimate
    distance, low, high = scale.length_m(places), None, None
    if distance is not None:
        low, high = interval_around(
            distance, math.hypot(scale.log_sd, _length_sd(places, coordinates.unit_px) / length_px)
        )
    return DistanceMeasurement(
        status=scale.status,
        distance_m=distance,
        distance_ci95_low_m=low,
        distance_ci95_high_m=high,
        confidence=scale.confidence,
        gsd_m_per_px=gsd,
        n_vehicles=None if estimate is None else estimate.n_vehicles,
        scale_source=scale.source,
        length_px=length_px,
        path=tuple(ImagePoint(x_px=x, y_px=y) for x, y in places),
        image_width_px=coordinates.width_px,
        image_height_px=coordinates.height_px,
        scale=scale.known,
        estimate=estimate,
        warnings=scale.notices,
    )
