"""The engine: loaded models, default options and runtime.

    >>> import vehanchor
    >>> engine = vehanchor.Engine(runtime=vehanchor.Runtime(threads=2))
    >>> engine.estimate("photo.jpg").gsd_m_per_px  # doctest: +SKIP
    0.152

``vehanchor`` has the same methods as functions.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from functools import cache, partial
from typing import TYPE_CHECKING, Any, TypeVar, overload

from vehanchor.analysis.image_list import estimate_each
from vehanchor.analysis.pipeline import (
    analyse_image,
    analyse_raster,
    checked_detector,
)
from vehanchor.detection.chips import prepare_colours
from vehanchor.detection.detector import Detector, open_detector
from vehanchor.errors import InvalidParameterError
from vehanchor.export import MAX_ENLARGEMENT
from vehanchor.export.resample import Resampled, resample_raster
from vehanchor.imagery.sources.opening import ImageSource, open_raster
from vehanchor.models.runtime import Cancellation, Runtime
from vehanchor.models.zoo import load_ruler_networks
from vehanchor.options import ScaleOptions, declared_options
from vehanchor.options.rulers import GSD_M_PER_PX
from vehanchor.options.signature import list_keywords, share_keywords
from vehanchor.rulers.active import check_rulers

if TYPE_CHECKING:
    from vehanchor.analysis.measurement_analysis import AreaAnalysis, DistanceAnalysis
    from vehanchor.analysis.scale_analysis import ScaleAnalysis
    from vehanchor.detection.detector import DetectorSource
    from vehanchor.measure.scale_source import ScaleInput
    from vehanchor.measure.shapes import Orientation
    from vehanchor.options.reading import Place
    from vehanchor.records import AreaMeasurement, DistanceMeasurement, GsdEstimate, KnownScale
    from vehanchor.segmentation.prompt import Box, Point
    from vehanchor.segmentation.segmenter import Segmenter, SegmenterSource

__all__ = ["Cancellation", "Detector", "Engine", "ImageSource", "Runtime"]

_MODEL_KEYWORDS = frozenset({"detector", "segmenter"})
_RUNTIME_KEYWORDS = frozenset(field.name for field in fields(Runtime))
T = TypeVar("T")


class Engine:
    """Loaded models with default options and a runtime; safe for several threads.

    The engine loads each model on its first use, and keeps it. All methods take the same keywords
    for one call: the fields of the option groups in ``vehanchor.options``, the fields of
    ``Runtime``, ``detector`` and ``segmenter``. An unknown keyword raises an
    ``InvalidParameterError`` that lists the options. Records do not depend on the runtime.

    Args:
        detector: a bundled model's name, the path of an ONNX oriented-box model, or a loaded
            ``Detector``, which keeps its own threads and providers; None for the bundled one.
        segmenter: paths of encoder and decoder, or a loaded ``Segmenter``; None for the bundled
            one.
        classes: the detector's classes, by name or index, that count as vehicles, whichever
            detector the engine or a call uses; None for the detector's own.
        options: default options of the method; keywords of a call replace single fields.
        runtime: threads and providers of the models; None for the CPU and all cores.

    Attributes:
        options: default options of the method.
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
        self._detector_source = detector
        self._segmenter_source = segmenter
        self._classes = classes
        # Progress and cancellation belong to a call, so the models are opened without them.
        idle = self.runtime.idle
        self._detector = _load_once(partial(open_detector, detector, classes, idle))
        self._segmenter = _load_once(partial(_open_segmenter, segmenter, idle))

    @property
    def detector(self) -> Detector:
        """The detector with this engine's runtime; the first access loads it.

        Raises:
            ModelError: the detector cannot be used.
            InvalidParameterError: the detector lacks one of the engine's classes.
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
        """Load the detector, its auxiliary models and the rulers' networks before their first use.

        Raises:
            ModelError: a model cannot be used.
        """
        load_ruler_networks(self.detector.runtime.idle)
        prepare_colours()

    def replace(
        self,
        *,
        detector: DetectorSource | None = None,
        segmenter: SegmenterSource | None = None,
        options: ScaleOptions | None = None,
        runtime: Runtime | None = None,
    ) -> Engine:
        """Copy the engine with other settings; the copy shares the models that do not change.

        Args:
            detector: another detector; None keeps this engine's.
            segmenter: another segmenter; None keeps this engine's.
            options: other default options; None keeps this engine's.
            runtime: another runtime; None keeps this engine's. If only progress and cancellation
                differ, the models are shared.
        """
        other = Engine(
            detector or self._detector_source,
            segmenter or self._segmenter_source,
            classes=self._classes,
            options=options or self.options,
            runtime=runtime or self.runtime,
        )
        # Runtimes compare equal if only progress and cancellation differ.
        if other.runtime == self.runtime:
            if not detector:
                other._detector = self._detector
            if not segmenter:
                other._segmenter = self._segmenter
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
        """Estimate the ground sampling distance of aerial images from cars and other rulers.

        Args:
            image: path, encoded bytes, binary file object, Pillow image, rasterio dataset, or array
                (H x W x 3 RGB or H x W; uint8, uint16 or float). A list of them gives a list of
                records; ``vehanchor.find_images`` lists the images of folders and patterns.
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
        engine, call_options = self.for_call(options, keywords)
        if isinstance(image, list | tuple):
            call_options.check_for_several_images()
        detector = checked_detector(engine.detector, call_options)
        if isinstance(image, list | tuple):
            return estimate_each(image, detector, call_options)
        return analyse_image(image, detector, call_options).estimate

    def analyse_scale(
        self, image: ImageSource, options: ScaleOptions | None = None, **keywords: Any
    ) -> ScaleAnalysis:
        """Estimate the scale of one image; return the record with its detections and evidence."""
        engine, call_options = self.for_call(options, keywords)
        detector = checked_detector(engine.detector, call_options)
        return analyse_image(image, detector, call_options)

    def measure_area(
        self, image: ImageSource, options: ScaleOptions | None = None, **keywords: Any
    ) -> AreaMeasurement:
        """Measure an area like ``analyse_area``, but return the record alone."""
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
        must_fit: Mapping[str, float] | None = None,
        **keywords: Any,
    ) -> AreaAnalysis:
        """Measure the area of the object in a box or at points.

        The area is ``A = N_px * GSD^2`` (paper, section III-G). Boxes and points are in pixels of
        the image, or of the resized copy that the option ``frame`` describes; the first pixel
        spans 0 to 1. The option ``coordinates`` selects other units. Give either ``box`` or
        ``points``.

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
                and the interval and the confidence of that estimate hold.
            object_height_m: height of the object above the ground, such as a roof; None for 0.
            must_fit: ``diameter_m`` of a circle, or ``length_m`` and ``width_m`` of a rectangle, in
                metres: the record's ``fit`` states the probability that it fits, and where.
            **keywords: see ``Engine``.

        Returns:
            The record with mask, prompt and analysis of the scale; ``area_m2`` is None if there is
            no scale.

        Raises:
            PromptError: neither or both prompts are given, or the prompt is not in the image.
            ScaleMismatchError: the scale was estimated from another image.
            VehAnchorError: as ``estimate``.
        """
        # Late imports, here and below: an estimate starts without what only measuring needs.
        from vehanchor.measure.area import analyse_objects
        from vehanchor.measure.fit import read_must_fit
        from vehanchor.segmentation.prompt import read_prompt

        engine, call_options = self.for_call(options, keywords)
        prompt = read_prompt(box, points)
        shape_to_fit = read_must_fit(must_fit)
        segmenter = engine.segmenter
        scale_input = engine._scale_input(gsd_m_per_px, scale, call_options)
        with open_raster(image, call_options.reading) as raster:
            (analysis,) = analyse_objects(
                raster,
                [prompt],
                segmenter=segmenter,
                scale=scale_input,
                options=call_options,
                object_height_m=object_height_m,
                must_fit=shape_to_fit,
            )
        return analysis.drawn_over(image, raster, call_options.reading)

    def measure_areas(
        self, image: ImageSource, shapes: Any, options: ScaleOptions | None = None, **keywords: Any
    ) -> tuple[AreaMeasurement, ...]:
        """Measure areas like ``analyse_areas``, but return the records alone."""
        analyses = self.analyse_areas(image, shapes, options, **keywords)
        return tuple(analysis.measurement for analysis in analyses)

    def analyse_areas(
        self,
        image: ImageSource,
        shapes: Any,
        options: ScaleOptions | None = None,
        *,
        gsd_m_per_px: float | None = None,
        scale: KnownScale | GsdEstimate | Mapping[str, Any] | None = None,
        object_height_m: float | None = None,
        edge_px: float | None = None,
        orientation: Orientation | None = None,
        must_fit: Mapping[str, float] | None = None,
        **keywords: Any,
    ) -> tuple[AreaAnalysis, ...]:
        """Measure the areas of shapes that the caller has already, with one search.

        No segmenter runs. A polygon's area follows from its corners, a mask's from its pixels.
        Coordinates are those of ``analyse_area``; a mask has the size of the image, or of the
        ``frame``.

        Args:
            image: as in ``estimate``.
            shapes: a list of shapes: polygons (pairs x, y or one flat list), masks ``[h, w]``,
                COCO's run lengths, polygons or annotations, GeoJSON, geometries of shapely in
                pixels. Or masks ``[n, h, w]``, supervision's ``Detections``, or GeoJSON of several
                shapes, which is in degrees if the image is georeferenced.
            options: as in ``estimate``.
            gsd_m_per_px: as in ``analyse_area``.
            scale: as in ``analyse_area``.
            object_height_m: height of all shapes above the ground; None for 0.
            edge_px: how far the edges may lie from those of the objects, either way, in pixels of
                the caller's picture; None for 0.5 for polygons and 1 for masks.
            orientation: "oriented" or "stored": whether the shapes belong to the upright picture or
                to the pixels as the file stores them; needed for a mask whose size does not show
                it.
            must_fit: as in ``analyse_area``, for each shape.
            **keywords: see ``Engine``.

        Returns:
            For each shape, in order, what ``analyse_area`` returns; ``mask_score`` and
            ``segmenter`` are None.

        Raises:
            PromptError: a shape crosses itself, is empty, outside the image or of another size, or
                there are too many.
            ScaleMismatchError: the scale was estimated from another image.
            VehAnchorError: as ``estimate``.
        """
        from vehanchor.measure.area import ShapeReading, analyse_objects
        from vehanchor.measure.fit import read_must_fit
        from vehanchor.measure.shapes import read_shapes

        engine, call_options = self.for_call(options, keywords)
        callers_shapes = read_shapes(shapes)
        shape_reading = ShapeReading(edge_px=edge_px, orientation=orientation)
        shape_to_fit = read_must_fit(must_fit)
        scale_input = engine._scale_input(gsd_m_per_px, scale, call_options)
        with open_raster(image, call_options.reading) as raster:
            analyses = analyse_objects(
                raster,
                callers_shapes,
                segmenter=None,
                scale=scale_input,
                options=call_options,
                object_height_m=object_height_m,
                reading=shape_reading,
                must_fit=shape_to_fit,
            )
        return tuple(
            analysis.drawn_over(image, raster, call_options.reading) for analysis in analyses
        )

    def measure_distance(
        self,
        image: ImageSource,
        path: Sequence[Place],
        options: ScaleOptions | None = None,
        **keywords: Any,
    ) -> DistanceMeasurement:
        """Measure a distance like ``analyse_distance``, but return the record alone."""
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
            PromptError: there are fewer than two points, one is outside the image, or all are the
                same.
            ScaleMismatchError: the scale was estimated from another image.
            VehAnchorError: as ``estimate``.
        """
        from vehanchor.measure.distance import analyse_paths, read_path

        engine, call_options = self.for_call(options, keywords)
        points = read_path(path)
        scale_input = engine._scale_input(gsd_m_per_px, scale, call_options)
        with open_raster(image, call_options.reading) as raster:
            (analysis,) = analyse_paths(
                raster,
                [points],
                scale=scale_input,
                options=call_options,
                object_height_m=object_height_m,
            )
        return analysis.drawn_over(image, raster, call_options.reading)

    def resample(
        self,
        image: ImageSource,
        options: ScaleOptions | None = None,
        *,
        gsd_m_per_px: float,
        max_enlargement: float = MAX_ENLARGEMENT,
        **keywords: Any,
    ) -> Resampled:
        """Resample a photograph to a scale that another model expects, by that of measurements.

        Args:
            image: as in ``estimate``.
            options: as in ``estimate``.
            gsd_m_per_px: scale of the copy, metres per pixel.
            max_enlargement: largest factor; a larger one adds no detail.
            **keywords: see ``Engine``.

        Returns:
            The copy with its factor and scale; ``write`` writes it into a folder.

        Raises:
            InvalidParameterError: the photograph has no single usable scale, or would grow more.
            VehAnchorError: as ``estimate``.
        """
        from vehanchor.measure.scale_source import find_measurement_scale

        GSD_M_PER_PX.check("gsd_m_per_px", gsd_m_per_px)
        engine, call_options = self.for_call(options, keywords)
        detector = checked_detector(engine.detector, call_options)
        with open_raster(image, call_options.reading) as raster:
            scale = find_measurement_scale(raster, partial(analyse_raster, detector), call_options)
            return resample_raster(
                raster,
                scale,
                gsd_m_per_px,
                max_enlargement=max_enlargement,
                max_pixels=call_options.reading.limits.max_pixels,
            )

    def for_call(
        self, options: ScaleOptions | None, keywords: Mapping[str, object]
    ) -> tuple[Engine, ScaleOptions]:
        """Apply the keywords of a call to the engine and its options.

        Args:
            options: options of the call; None for the engine's.
            keywords: single options, fields of the runtime, other models.

        Returns:
            The engine, with other models and another runtime if the call names them; the options.

        Raises:
            InvalidParameterError: a keyword is unknown or invalid.
        """
        models: dict[str, Any] = {}
        runtime_fields: dict[str, Any] = {}
        option_values: dict[str, Any] = {}
        for name, value in keywords.items():
            if name in _MODEL_KEYWORDS:
                models[name] = value
            elif name in _RUNTIME_KEYWORDS:
                runtime_fields[name] = value
            else:
                option_values[name] = value

        _check_is_options(options)
        engine = self
        if models or runtime_fields:
            runtime = self.runtime.with_keywords(runtime_fields)
            engine = self.replace(**models, runtime=runtime)
        call_options = (options or self.options).with_keywords(option_values)
        check_rulers(call_options.rulers)
        return engine, call_options

    def _scale_input(
        self,
        gsd_m_per_px: float | None,
        scale: KnownScale | GsdEstimate | Mapping[str, Any] | None,
        options: ScaleOptions,
    ) -> ScaleInput:
        """Return the caller's scale, or the analysis that estimates one if there is none."""
        from vehanchor.measure.scale_source import read_scale_argument

        caller_scale = read_scale_argument(gsd_m_per_px, scale, options)
        if caller_scale is not None:
            return caller_scale
        detector = checked_detector(self.detector, options)
        return partial(analyse_raster, detector)


def _check_is_options(options: object) -> None:
    """Check that the argument ``options`` is no value that belongs to another argument.

    Raises:
        InvalidParameterError: it is none of ``ScaleOptions``.
    """
    if options is None or isinstance(options, ScaleOptions):
        return
    raise InvalidParameterError(
        f"options is {options!r}: use ScaleOptions, or name the argument that you mean: "
        "measure_area(image, box=(x1, y1, x2, y2)), measure_distance(image, [(x1, y1), (x2, y2)]), "
        'estimate_gsd(image, region="europe")'
    )


def _load_once(load: Callable[[], T]) -> Callable[[], T]:
    """Make a function that loads a model on its first call, and returns it on every call."""
    # The lock keeps two threads from loading the same model twice.
    lock = threading.Lock()
    cached_load = cache(load)

    def get() -> T:
        with lock:
            return cached_load()

    return get


for _name, _like in (
    ("measure_area", "analyse_area"),
    ("measure_areas", "analyse_areas"),
    ("measure_distance", "analyse_distance"),
):
    share_keywords(getattr(Engine, _name), getattr(Engine, _like))
for _name in (
    "estimate",
    "analyse_scale",
    "measure_area",
    "analyse_area",
    "measure_areas",
    "analyse_areas",
    "measure_distance",
    "analyse_distance",
    "resample",
):
    list_keywords(getattr(Engine, _name), declared_options(), _RUNTIME_KEYWORDS, _MODEL_KEYWORDS)


def _open_segmenter(source: SegmenterSource | None, runtime: Runtime) -> Segmenter:
    from vehanchor.segmentation.segmenter import open_segmenter

    return open_segmenter(source, runtime)
