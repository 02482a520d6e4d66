"""The engine: loaded models, default options and runtime.

    >>> import vehanchor
    >>> engine = vehanchor.Engine(runtime=vehanchor.Runtime(threads=2))
    >>> engine.estimate("photo.jpg").gsd_m_per_px  # doctest: +SKIP
    0.152

``vehanchor`` has the same methods as functions.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar, overload

from vehanchor.analysis.pipeline import (
    analyse_image,
    analyse_raster,
    checked_detector,
    estimate_each,
)
from vehanchor.courts.network import load_court_network
from vehanchor.detection.detector import Detector, load_detector
from vehanchor.detection.scene_scale import load_scene_scale
from vehanchor.errors import InvalidParameterError
from vehanchor.imagery.sources.opening import ImageSource, open_raster
from vehanchor.measure.area import analyse_objects
from vehanchor.measure.distance import analyse_paths, read_path
from vehanchor.measure.scale_source import given_scale
from vehanchor.models.runtime import Cancellation, Runtime
from vehanchor.models.zoo import resolve_model, resolve_segmenter
from vehanchor.options import ScaleOptions
from vehanchor.rulers.active import check_rulers
from vehanchor.segmentation.prompt import read_prompt
from vehanchor.segmentation.segmenter import Segmenter, load_segmenter

if TYPE_CHECKING:
    from vehanchor.analysis.measurement_analysis import AreaAnalysis, DistanceAnalysis
    from vehanchor.analysis.scale_analysis import ScaleAnalysis
    from vehanchor.measure.scale_source import ScaleInput
    from vehanchor.options.reading import Place
    from vehanchor.records import AreaMeasurement, DistanceMeasurement, GsdEstimate, KnownScale
    from vehanchor.segmentation.prompt import Box, Point

__all__ = ["Cancellation", "Detector", "Engine", "ImageSource", "Runtime", "Segmenter"]

_OWN_KEYWORDS = frozenset({"detector", "segmenter", *(each.name for each in fields(Runtime))})
T = TypeVar("T")
DetectorSource: TypeAlias = Detector | str | os.PathLike[str]
"""A bundled model's name, the path of an ONNX oriented-box model, or a loaded detector."""
SegmenterSource: TypeAlias = Segmenter | tuple[str | os.PathLike[str], str | os.PathLike[str]]
"""Paths of encoder and decoder, or a loaded segmenter."""


class Engine:
    """Loaded models with default options and a runtime; safe for several threads.

    Each model is loaded when it is first needed, and kept. All methods take the same keywords for
    one call: the fields of the option groups in ``vehanchor.options``, those of ``Runtime``, and
    ``detector`` and ``segmenter``. An unknown keyword is an ``InvalidParameterError`` that lists
    the options. Records do not depend on the runtime.

    Args:
        detector: a bundled model's name, the path of an ONNX oriented-box model, or a loaded
            ``Detector``, which keeps its own threads and providers; None for the bundled one.
        segmenter: paths of encoder and decoder, or a loaded ``Segmenter``; None for the bundled
            one.
        classes: the detector's classes, by name or index, that count as vehicles; None for the
            model's own.
        options: defaults of the method; keywords of a call change single fields.
        runtime: threads and providers of the models; None for the CPU and all cores.

    Attributes:
        options: defaults of the method.
        runtime: threads and providers of the models.
    """

    def __init__(
        self,
        detector: DetectorSource | None = None,
        segmenter: SegmenterSource | None = None,
        *,
        classes: Sequence[str | int] | None = None,
        options: ScaleOptions | None = None,
        runtime: Runtime | None = None,
    ) -> None:
        self.options = options or ScaleOptions()
        self.runtime = runtime or Runtime()
        self._sources = detector, segmenter, classes
        self._detector = _once(partial(open_detector, detector, classes, self.runtime.idle))
        self._segmenter = _once(partial(open_segmenter, segmenter, self.runtime.idle))

    @property
    def detector(self) -> Detector:
        """The detector with this engine's runtime; the first access loads it.

        Raises:
            ModelError: the detector cannot be used.
        """
        return self._detector().under(self.runtime)

    @property
    def segmenter(self) -> Segmenter:
        """The segmenter with this engine's runtime; the first access loads it.

        Raises:
            ModelError: the segmenter cannot be used.
            InvalidParameterError: the source is neither a ``Segmenter`` nor two paths.
        """
        return self._segmenter().under(self.runtime)

    def load(self) -> None:
        """Load the detector and the auxiliary models before their first use.

        Raises:
            ModelError: a model cannot be used.
        """
        runtime = self.detector.runtime.idle
        load_scene_scale(runtime)
        load_court_network(runtime)

    def replace(
        self,
        *,
        detector: DetectorSource | None = None,
        segmenter: SegmenterSource | None = None,
        options: ScaleOptions | None = None,
        runtime: Runtime | None = None,
    ) -> Engine:
        """Copy the engine with other settings; None keeps this engine's, and unchanged models are shared.

        Args:
            detector: another detector.
            segmenter: another segmenter.
            options: other defaults.
            runtime: another runtime. If only progress and cancellation differ, the models are
                shared.
        """
        ours, our_segmenter, classes = self._sources
        chosen = options or self.options
        under = runtime or self.runtime
        other = Engine(
            detector or ours,
            segmenter or our_segmenter,
            classes=classes,
            options=chosen,
            runtime=under,
        )
        if under == self.runtime:
            other._detector = other._detector if detector else self._detector
            other._segmenter = other._segmenter if segmenter else self._segmenter
        return other

    @overload
    def estimate(
        self, image: ImageSource, options: ScaleOptions | None = None, **keywords: Any
    ) -> GsdEstimate: ...

    @overload
    def estimate(
        self,
        image: list[Any] | tuple[Any, ...],
        options: ScaleOptions | None = None,
        **keywords: Any,
    ) -> list[GsdEstimate]: ...

    def estimate(
        self, image: Any, options: ScaleOptions | None = None, **keywords: Any
    ) -> GsdEstimate | list[GsdEstimate]:
        """Estimate the ground sampling distance of an aerial image from the cars and the other rulers in it.

        Args:
            image: path, encoded bytes, binary file object, Pillow image, rasterio dataset, or array
                (H x W x 3 RGB or H x W; uint8, uint16 or float). A list of them gives a list;
                ``vehanchor.find_images`` makes one of folders and patterns.
            options: options of the method in groups; None for the engine's.
            **keywords: single options, fields of the runtime, another detector; see ``Engine``.

        Returns:
            The record, or a list of records; ``gsd_m_per_px`` is None if no ruler finds anything.

        Raises:
            ImageError: the image cannot be used; see ``vehanchor.errors`` for its kinds.
            ImageListError: images of a list cannot be used; ``results`` holds the records of the
                others.
            ModelError: a model cannot be used.
            InvalidParameterError: an option is invalid.
            FrameError: the frame has another aspect ratio than the image.
            CalibrationError: the calibration cannot be read, or belongs to another detector.
            CancelledError: the call was cancelled (``concurrent.futures``).
        """
        engine, chosen = self.for_call(options, keywords)
        detector = checked_detector(engine.detector, chosen)
        if isinstance(image, list | tuple):
            return estimate_each(image, detector, chosen)
        return analyse_image(image, detector, chosen).estimate

    def analyse_scale(
        self, image: ImageSource, options: ScaleOptions | None = None, **keywords: Any
    ) -> ScaleAnalysis:
        """Estimate the scale of one image; return the record with its detections and evidence."""
        engine, chosen = self.for_call(options, keywords)
        return analyse_image(image, checked_detector(engine.detector, chosen), chosen)

    def measure_area(
        self, image: ImageSource, options: ScaleOptions | None = None, **keywords: Any
    ) -> AreaMeasurement:
        """Measure an area as ``analyse_area``, with its keywords; return the record alone."""
        return self.analyse_area(image, options, **keywords).measurement

    def analyse_area(
        self,
        image: ImageSource,
        options: ScaleOptions | None = None,
        *,
        box: Box | None = None,
        points: Sequence[Point] | None = None,
        gsd_m_per_px: float | None = None,
        scale: KnownScale | GsdEstimate | Mapping[str, Any] | None = None,
        object_height_m: float | None = None,
        **keywords: Any,
    ) -> AreaAnalysis:
        """Measure the area of the object in a box or at a point, ``A = N_px * GSD^2`` (paper, section III-G).

        Boxes and points are in pixels of the image, or of the copy that a frame names; the first
        pixel spans 0 to 1. The option ``coordinates`` chooses other units. Exactly one of ``box``
        and ``points`` is needed.

        Args:
            image: as in ``estimate``.
            options: as in ``estimate``.
            box: x1, y1, x2, y2, a geometry of shapely, or supervision's ``Detections`` of one
                object.
            points: x, y and, optionally, whether the point lies on the object (the default) or
                beside it.
            gsd_m_per_px: known scale, metres per pixel of the full image; the detector does not
                run.
            scale: an earlier estimate of this image, or its ``scale``; the detector does not run,
                and the estimate's interval and confidence hold.
            object_height_m: height of the object above the ground, as of a roof; None for 0.
            **keywords: see ``Engine``.

        Returns:
            The record with mask, prompt and analysis of the scale; ``area_m2`` is None if there is
            no scale.

        Raises:
            PromptError: neither or both prompts are given, or the prompt is not in the image.
            ScaleMismatchError: the scale was estimated from another image.
            VehAnchorError: as ``estimate``.
        """
        engine, chosen = self.for_call(options, keywords)
        prompt = read_prompt(box, points)
        segmenter = engine.segmenter
        known = engine._scale_input(gsd_m_per_px, scale, chosen)
        with open_raster(image, chosen.reading) as raster:
            (found,) = analyse_objects(
                raster,
                [prompt],
                segmenter=segmenter,
                scale=known,
                options=chosen,
                object_height_m=object_height_m,
            )
        return found.drawn_over(image, raster, chosen.reading)

    def measure_distance(
        self,
        image: ImageSource,
        path: Sequence[Place],
        options: ScaleOptions | None = None,
        **keywords: Any,
    ) -> DistanceMeasurement:
        """Measure a distance as ``analyse_distance``, with its keywords; return the record alone."""
        return self.analyse_distance(image, path, options, **keywords).measurement

    def analyse_distance(
        self,
        image: ImageSource,
        path: Sequence[Place],
        options: ScaleOptions | None = None,
        *,
        gsd_m_per_px: float | None = None,
        scale: KnownScale | GsdEstimate | Mapping[str, Any] | None = None,
        object_height_m: float | None = None,
        **keywords: Any,
    ) -> DistanceAnalysis:
        """Measure the length of a line on the ground, ``D = P * GSD``.

        Args:
            image: as in ``estimate``.
            path: x, y of two or more points in order, joined by straight lines; or a line of
                shapely. Coordinates as in ``analyse_area``.
            options: as in ``estimate``.
            gsd_m_per_px: as in ``analyse_area``.
            scale: as in ``analyse_area``.
            object_height_m: height of the line above the ground; None for 0.
            **keywords: see ``Engine``.

        Returns:
            The record with the analysis of the scale; ``distance_m`` is None if there is no scale.

        Raises:
            PromptError: fewer than two points, one outside the image, or all in one place.
            ScaleMismatchError: the scale was estimated from another image.
            VehAnchorError: as ``estimate``.
        """
        engine, chosen = self.for_call(options, keywords)
        places = read_path(path)
        known = engine._scale_input(gsd_m_per_px, scale, chosen)
        with open_raster(image, chosen.reading) as raster:
            (found,) = analyse_paths(
                raster, [places], scale=known, options=chosen, object_height_m=object_height_m
            )
        return found.drawn_over(image, raster, chosen.reading)

    def for_call(
        self, options: ScaleOptions | None, keywords: Mapping[str, object]
    ) -> tuple[Engine, ScaleOptions]:
        """Apply the keywords of a call to the engine and its options.

        Raises:
            InvalidParameterError: a keyword is unknown or invalid.
        """
        own: dict[str, Any] = {name: keywords[name] for name in keywords if name in _OWN_KEYWORDS}
        models: dict[str, Any] = {
            name: own.pop(name) for name in ("detector", "segmenter") if name in own
        }
        engine = (
            self.replace(**models, runtime=self.runtime.with_keywords(own))
            if own or models
            else self
        )
        rest = {name: value for name, value in keywords.items() if name not in _OWN_KEYWORDS}
        chosen = (options or self.options).with_keywords(rest)
        check_rulers(chosen.rulers)
        return engine, chosen

    def _scale_input(
        self,
        gsd_m_per_px: float | None,
        scale: KnownScale | GsdEstimate | Mapping[str, Any] | None,
        options: ScaleOptions,
    ) -> ScaleInput:
        """Take the caller's known scale, else the analysis that finds it."""
        given = given_scale(gsd_m_per_px, scale, options)
        return (
            partial(analyse_raster, checked_detector(self.detector, options))
            if given is None
            else given
        )


def _once(load: Callable[[], T]) -> Callable[[], T]:
    """Give a function that loads a model on its first call, in one thread, and returns it on each."""
    lock = threading.Lock()
    loaded = cache(load)

    def get() -> T:
        with lock:
            return loaded()

    return get


def open_detector(
    source: DetectorSource | None, classes: Sequence[str | int] | None, runtime: Runtime
) -> Detector:
    """Open a detector.

    Raises:
        ModelError: it cannot be used.
    """
    if isinstance(source, Detector):
        return source
    path = resolve_model(None if source is None else str(source))
    return (
        Detector(path, classes=classes, runtime=runtime)
        if classes
        else load_detector(path, runtime)
    )


def open_segmenter(source: SegmenterSource | None, runtime: Runtime) -> Segmenter:
    """Open a segmenter.

    Raises:
        ModelError: it cannot be used.
        InvalidParameterError: the source is neither a ``Segmenter`` nor two paths.
    """
    if isinstance(source, Segmenter):
        return source
    files = None
    if source is not None:
        if isinstance(source, str) or len(source) != 2:
            raise InvalidParameterError(
                f"segmenter is {source!r}: give two paths, of its encoder and its decoder"
            )
        files = Path(source[0]), Path(source[1])
    return load_segmenter(*resolve_segmenter(files), runtime)
