"""The geometric perception skill: an image in, its metric scale out.

Raster -> tiles -> boxes -> lengths -> mode -> GSD -> confidence -> record. Stateless but for loaded models, and
deterministic: the same image and model give the same record, whatever the number of threads.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, NamedTuple, get_args

import numpy as np

from vehanchor.detection.detector import Detections, Detector, detect_vehicles, load_detector
from vehanchor.errors import FrameError, InvalidParameterError
from vehanchor.imagery.detail import resolved_share
from vehanchor.imagery.raster import ImageSource, open_raster
from vehanchor.models.zoo import resolve_model
from vehanchor.options import NMS_IOU, OUTLIER_ALPHA, Aggregation, ImageLimits
from vehanchor.records import FrameScale, GsdEstimate, Notice, ReferenceSource
from vehanchor.scale.calibration import Calibration, opened_calibration
from vehanchor.scale.confidence import FALLBACK_CONFIDENCE, composite, confidence_terms, fleet_doubts, guard_length
from vehanchor.scale.lengths import LengthGroup, dominant_group, gsd_interval, inlier_mask, modal_length

if TYPE_CHECKING:
    import os
    from collections.abc import Callable

    import onnxruntime
    from numpy.typing import NDArray

    from vehanchor.detection.detector import DetectorCard
    from vehanchor.imagery.raster import Raster
    from vehanchor.scale.confidence import FleetDoubt

__all__ = ["ScaleAnalysis", "ScaleOptions", "analyse_scale", "estimate_gsd", "scale_from_detections"]

GEOREFERENCE_TOLERANCE = 0.10  # the file's own scale and the estimate may differ by this before a warning
DEFAULT_LIMITS = ImageLimits()
_DOUBTS: dict[FleetDoubt, str] = {
    "lengths_disagree": "Vehicles of two sizes were found, and the evidence for the other size is not much weaker "
    "than for the one that was used. One of them is not cars: the scale may be off by the ratio of the sizes.",
    "lengths_alike": "The vehicles are all of one length, as no fleet of cars is: they may be equal lorries, "
    "containers or roof units, and the scale off by the ratio of their length to a car's.",
    "scores_unclear": "None of the vehicles is clearly a car: they may be things of similar shape at another scale.",
    "looks_alike": "The vehicles look more alike than cars of different makes and paint do: they may be equal "
    "caravans, lorries or containers, and the scale off by the ratio of their length to a car's.",
    "looks_unlike_cars": "The vehicles look like no fleet of cars that is known: they may be boats or other things of "
    "a car's shape, and the scale off by the ratio of their length to a car's.",
}
_LEAST_SCORE = 1e-3  # below it a detection is no evidence, but still one
_REFERENCE_SETTERS = ("reference_length_m", "region", "calibration")


@dataclass(frozen=True)
class ScaleOptions:
    """Every choice of the method; the defaults are the paper's, or the model's own where that is None.

    Attributes:
        min_score: lowest detection score; None takes the model's (0.1, the paper's, for foreign models).
        tile_px: tile side; None is 1024, or the model's input where that is fixed.
        stride_px: step between tiles; None is three quarters of the tile.
        nms_iou: IoU above which the weaker of two boxes is dropped.
        search_scales: search reduced copies of the image, too, for vehicles longer than the model was trained on; None
            takes the model's own choice (no, for foreign models).
        alpha: outlier filter, ``P_i <= alpha * median``; None switches it off.
        aggregation: ``kde``, ``weighted_kde``, ``median`` or ``mean`` (see ``vehanchor.scale.lengths.modal_length``);
            None takes the model's own choice (``kde``, the paper's, for foreign models).
        reference_length_m: ``L_ref``; None has it told from the look of the vehicles (see
            ``vehanchor.detection.look``), or takes the model's where its file cannot tell.
        region: take the model's reference length for this region (``europe``, ``north_america``, ...) instead.
        calibration: take the reference length measured for this fleet and detector (see ``load_calibration``) instead.
        frame_width_px: width of the resized copy the caller works in; with ``frame_height_px``.
        frame_height_px: its height.
        bands: three 1-based bands to take as red, green, blue; None takes the first three.
        limits: what an image may cost, checked before decoding.
    """

    min_score: float | None = None
    tile_px: int | None = None
    stride_px: int | None = None
    nms_iou: float = NMS_IOU
    search_scales: bool | None = None
    alpha: float | None = OUTLIER_ALPHA
    aggregation: Aggregation | None = None
    reference_length_m: float | None = None
    region: str | None = None
    calibration: Calibration | None = None
    frame_width_px: int | None = None
    frame_height_px: int | None = None
    bands: tuple[int, int, int] | None = None
    limits: ImageLimits = DEFAULT_LIMITS

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if (
                isinstance(value, (int, float))
                and not isinstance(value, bool)
                and not (math.isfinite(value) and value > 0)
            ):
                allowed_zero = field.name in ("min_score", "nms_iou") and value == 0
                if not allowed_zero:
                    raise InvalidParameterError(f"{field.name} is {value}: use a finite number > 0")
        for name, value in (("min_score", self.min_score), ("nms_iou", self.nms_iou)):
            if value is not None and value > 1:
                raise InvalidParameterError(f"{name} is {value}: it lies in 0..1")
        if self.aggregation is not None and self.aggregation not in get_args(Aggregation):
            raise InvalidParameterError(
                f"aggregation is {self.aggregation!r}: use one of {', '.join(get_args(Aggregation))}"
            )
        setters = [name for name in _REFERENCE_SETTERS if getattr(self, name) is not None]
        if len(setters) > 1:
            raise InvalidParameterError(f"give {' or '.join(setters)}, not both: each sets the reference length")
        if (self.frame_width_px is None) != (self.frame_height_px is None):
            raise InvalidParameterError("a frame needs both frame_width_px and frame_height_px")


@dataclass(frozen=True, eq=False)
class ScaleAnalysis:
    """An estimate together with the detections it came from.

    Attributes:
        estimate: the record.
        detections: all vehicles found.
        kept: ``[n]`` bool, those that passed the outlier filter.
        guard_length_px: ``P_thresh`` of the resolution guard.
        resolved: share of the pixels' resolution at which there is detail, see ``resolved_share``.
    """

    estimate: GsdEstimate
    detections: Detections
    kept: NDArray[np.bool_]
    guard_length_px: float
    resolved: float = 1.0


def estimate_gsd(
    image: ImageSource,
    *,
    detector: Detector | str | os.PathLike[str] | None = None,
    threads: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    min_score: float | None = None,
    tile_px: int | None = None,
    stride_px: int | None = None,
    nms_iou: float = NMS_IOU,
    search_scales: bool | None = None,
    alpha: float | None = OUTLIER_ALPHA,
    aggregation: Aggregation | None = None,
    reference_length_m: float | None = None,
    region: str | None = None,
    calibration: Calibration | str | os.PathLike[str] | None = None,
    frame_width_px: int | None = None,
    frame_height_px: int | None = None,
    bands: tuple[int, int, int] | None = None,
    limits: ImageLimits = DEFAULT_LIMITS,
) -> GsdEstimate:
    """Estimate the ground sampling distance of an aerial image from the cars in it.

    Args:
        image: path, encoded bytes, binary file object, or array (H x W x 3 RGB or H x W; uint8, uint16 or float).
        detector: a bundled model's name, the path of an ONNX oriented-box model, or a loaded ``Detector``; default the
            bundled one.
        threads: CPU threads for the model; None leaves it to ONNX Runtime. Ignored for a loaded ``Detector``.
        progress: called with (tiles done, tiles in all).
        min_score: see ``ScaleOptions``, as all that follow.
        tile_px: tile side, pixels.
        stride_px: step between tiles, pixels.
        nms_iou: IoU of the non-maximum suppression.
        search_scales: search reduced copies of the image, too.
        alpha: factor of the outlier filter, None for off.
        aggregation: ``kde``, ``weighted_kde``, ``median`` or ``mean``; None for the model's choice.
        reference_length_m: the fleet's modal vehicle length, metres.
        region: take the model's reference length for a region.
        calibration: take the reference length of a calibration, or of its file.
        frame_width_px: width of the caller's resized copy.
        frame_height_px: its height.
        bands: three 1-based bands.
        limits: limits on bytes and pixels.

    Returns:
        The record; ``gsd_m_per_px`` is None, never a guess, where no vehicle is found.

    Raises:
        ImageError: the image cannot be used; see ``vehanchor.errors`` for its kinds.
        ModelError: the detector cannot be used.
        InvalidParameterError: an option has no meaning.
        FrameError: the frame has another aspect ratio than the image.
        CalibrationError: the calibration cannot be read, or was made for another detector.
    """
    options = ScaleOptions(
        min_score=min_score,
        tile_px=tile_px,
        stride_px=stride_px,
        nms_iou=nms_iou,
        search_scales=search_scales,
        alpha=alpha,
        aggregation=aggregation,
        reference_length_m=reference_length_m,
        region=region,
        calibration=opened_calibration(calibration),
        frame_width_px=frame_width_px,
        frame_height_px=frame_height_px,
        bands=bands,
        limits=limits,
    )
    return analyse_scale(image, options, detector=detector, threads=threads, progress=progress).estimate


def analyse_scale(
    image: ImageSource,
    options: ScaleOptions | None = None,
    *,
    detector: Detector | str | os.PathLike[str] | None = None,
    threads: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    run_options: onnxruntime.RunOptions | None = None,
) -> ScaleAnalysis:
    """As ``estimate_gsd``, with the detections behind the number.

    Args:
        image: as in ``estimate_gsd``.
        options: every choice of the method; None for the defaults.
        detector: as in ``estimate_gsd``.
        threads: as in ``estimate_gsd``.
        progress: as in ``estimate_gsd``.
        run_options: ONNX Runtime's, for a caller that may have to end a running model (``terminate``).

    Returns:
        The record, the detections and which of them were kept.

    Raises:
        VehAnchorError: as ``estimate_gsd``.
    """
    chosen = options or ScaleOptions()
    model = open_detector(detector, chosen, threads=threads)
    with open_raster(image, bands=chosen.bands, limits=chosen.limits) as raster:
        return analyse_raster(raster, model, chosen, progress=progress, run_options=run_options)


def open_detector(
    detector: Detector | str | os.PathLike[str] | None, options: ScaleOptions, *, threads: int | None = None
) -> Detector:
    """The detector that a caller names, after a check that it knows the region of the options: before the work."""
    if not isinstance(detector, Detector):
        path = resolve_model(None if detector is None else str(detector))
        detector = load_detector(path, threads=threads)
    _reference_length(detector.card, options, None)
    return detector


def analyse_raster(
    raster: Raster,
    detector: Detector,
    options: ScaleOptions,
    *,
    progress: Callable[[int, int], None] | None = None,
    run_options: onnxruntime.RunOptions | None = None,
) -> ScaleAnalysis:
    """As ``analyse_scale``, of an image that is open already."""
    check_frame(options, raster.width_px, raster.height_px)
    detections = detect_vehicles(
        raster,
        detector,
        min_score=options.min_score,
        tile_px=options.tile_px,
        stride_px=options.stride_px,
        nms_iou=options.nms_iou,
        search_scales=options.search_scales,
        progress=progress,
        run_options=run_options,
    )
    kept, _ = _kept_vehicles(detections, options.alpha)
    return scale_from_detections(
        detections,
        detector.card,
        options,
        image_width_px=raster.width_px,
        image_height_px=raster.height_px,
        georeference_gsd_m_per_px=raster.georeference_gsd_m_per_px,
        resolved=resolved_share(raster, detections.boxes[kept, :2], _working_scale(detections, kept) or 1.0),
        notices=raster_notices(raster),
    )


def raster_notices(raster: Raster) -> tuple[Notice, ...]:
    """What the raster has to tell, as the records hold it."""
    return tuple(Notice(code=note.code, message=note.message) for note in raster.warnings)


def scale_from_detections(
    detections: Detections,
    card: DetectorCard,
    options: ScaleOptions,
    *,
    image_width_px: int,
    image_height_px: int,
    georeference_gsd_m_per_px: float | None = None,
    resolved: float = 1.0,
    notices: tuple[Notice, ...] = (),
) -> ScaleAnalysis:
    """The second half of the skill: vehicles found to record, so that one search can serve several options.

    Args:
        detections: vehicles in image pixels, as ``detect_vehicles`` returns them.
        card: of the model that found them.
        options: every choice of the method.
        image_width_px: width of the image.
        image_height_px: its height.
        georeference_gsd_m_per_px: the scale that the file carries, to compare with.
        resolved: share of the pixels' resolution at which there is detail, see ``resolved_share``.
        notices: warnings so far.

    Returns:
        The record, the detections and which of them were kept.

    Raises:
        InvalidParameterError: the model does not know the region.
        CalibrationMismatchError: the calibration was made for another model.
    """
    kept, rival_share = _kept_vehicles(detections, options.alpha)
    working_scale = _working_scale(detections, kept)
    lengths, scores = detections.boxes[kept, 2], detections.scores[kept]
    fleet_log_odds = _fleet_evidence(detections, kept)
    reference = _reference_length(card, options, fleet_log_odds)
    warnings = list(notices)
    if detections.n_capped_tiles:
        warnings.append(
            Notice(
                code="detections_capped",
                message=f"{detections.n_capped_tiles} of {detections.n_tiles} tiles reached the model's largest "
                "number of boxes: vehicles may be missing. Export the model without nms=True, or use smaller tiles.",
            )
        )
    gsd = mode_px = interval = None
    aggregation = options.aggregation or card.aggregation
    shortest_px = guard_length(reference.length_m, card.min_length_px)
    if len(lengths):
        mode_px, aggregation = modal_length(lengths, scores, aggregation)
        gsd = reference.length_m / mode_px
        weighted = scores if aggregation == "weighted_kde" else None
        interval = gsd_interval(lengths, mode_px, reference.length_m, reference.sd_m, scores=weighted)
    seen_px = (mode_px or math.nan) * (working_scale or 1.0)  # as the model saw them
    unresolved = seen_px >= shortest_px > seen_px * resolved
    guarded = seen_px < shortest_px or unresolved
    if unresolved:
        warnings.append(
            Notice(
                code="detail_missing",
                message=f"The image has no detail finer than {1 / resolved:.2g} px, as after enlarging or blur: the "
                f"vehicles' {seen_px:.1f} px hold no more than {seen_px * resolved:.1f} px would, and "
                f"{shortest_px:.1f} px are needed. Give the original image.",
            )
        )
    doubts: tuple[FleetDoubt, ...] = ()
    if detections.scales is not None:
        doubts = fleet_doubts(
            lengths,
            scores,
            rival_share=rival_share,
            clear_score=card.clear_score,
            fleet_log_odds=fleet_log_odds,
        )
    warnings += [Notice(code=doubt, message=_DOUBTS[doubt]) for doubt in doubts]
    terms = confidence_terms(
        lengths,
        scores,
        seen_px,
        (max(card.min_length_px, card.length_range_px[0]), card.length_range_px[1]),
    )
    confidence = composite(terms, guarded=guarded, disputed=bool(doubts))
    truth = georeference_gsd_m_per_px
    if gsd is not None and truth is not None and abs(gsd - truth) > GEOREFERENCE_TOLERANCE * truth:
        warnings.append(
            Notice(
                code="georeference_differs",
                message=f"The file's own scale is {truth:.4g} m/px, the vehicles say {gsd:.4g} m/px: "
                f"{100 * (gsd / truth - 1):+.0f} %. Check which of the two is wrong before using either.",
            )
        )
    estimate = GsdEstimate(
        status="no_anchor" if gsd is None else "ok" if confidence >= FALLBACK_CONFIDENCE else "low_confidence",
        gsd_m_per_px=gsd,
        confidence=confidence,
        n_vehicles=len(lengths),
        mode_length_px=mode_px,
        gsd_ci95_low_m_per_px=interval and interval.low,
        gsd_ci95_high_m_per_px=interval and interval.high,
        n_detections=len(detections.boxes),
        working_scale=working_scale,
        aggregation=aggregation,
        reference_length_m=reference.length_m,
        reference_source=reference.source,
        resolution_guard=guarded,
        confidence_terms=terms,
        image_width_px=image_width_px,
        image_height_px=image_height_px,
        georeference_gsd_m_per_px=truth,
        frame=_frame_scale(options, image_width_px, gsd, interval),
        model=card.name,
        model_sha256=card.sha256,
        warnings=tuple(warnings),
    )
    return ScaleAnalysis(estimate, detections, kept, shortest_px, resolved)


def _kept_vehicles(detections: Detections, alpha: float | None) -> LengthGroup:
    """The outlier filter; after a search over scales, within the lengths that can belong to one fleet."""
    lengths = detections.boxes[:, 2]
    if detections.scales is None or len(lengths) == 0:
        return LengthGroup(inlier_mask(lengths, alpha), 0.0)
    group = dominant_group(lengths, np.maximum(detections.scores, _LEAST_SCORE) ** 2)
    kept = group.members.copy()
    kept[kept] = inlier_mask(lengths[kept], alpha)
    return LengthGroup(kept, group.rival_share)


def _working_scale(detections: Detections, kept: NDArray[np.bool_]) -> float | None:
    """The scale at which most of the kept vehicles were found, by score; the finer of two equal ones."""
    if not kept.any():
        return None
    if detections.scales is None:
        return 1.0
    scales, which = np.unique(-detections.scales[kept], return_inverse=True)
    return float(-scales[np.argmax(np.bincount(which, weights=detections.scores[kept]))])


class _Reference(NamedTuple):
    """``L_ref``, its standard deviation between places that it serves, metres, and where it is from."""

    length_m: float
    sd_m: float
    source: ReferenceSource


def _fleet_evidence(detections: Detections, kept: NDArray[np.bool_]) -> NDArray[np.float64] | None:
    """Log odds for a fleet of the kept vehicles that were asked; None without any."""
    odds = detections.fleet_log_odds
    if odds is None or not kept[: len(odds)].any():
        return None
    return odds[kept[: len(odds)]]


def _reference_length(
    card: DetectorCard, options: ScaleOptions, fleet_log_odds: NDArray[np.float64] | None
) -> _Reference:
    """The caller's reference length, else what the look of the vehicles says of their fleet, else the model's.

    A caller who names the length or the region has settled most of what differs between regions: half of it remains.
    """
    if options.calibration is not None:
        options.calibration.check_detector(card.name, card.sha256)
        measured = options.calibration
        return _Reference(measured.reference_length_m, measured.reference_length_sd_m, "calibration")
    if options.reference_length_m is not None:
        return _Reference(options.reference_length_m, card.reference_length_sd_m / 2, "given")
    if options.region is not None:
        if options.region not in card.region_lengths_m:
            raise InvalidParameterError(
                f"region is {options.region!r}: this model knows {', '.join(sorted(card.region_lengths_m))}; "
                "or give reference_length_m"
            )
        return _Reference(card.region_lengths_m[options.region], card.reference_length_sd_m / 2, "region")
    if card.fleet_lengths is not None and fleet_log_odds is not None:
        fleets = card.fleet_lengths
        return _Reference(fleets.reference_length(fleet_log_odds), fleets.sd_m, "appearance")
    return _Reference(card.reference_length_m, card.reference_length_sd_m, "model")


def check_frame(options: ScaleOptions, width_px: int, height_px: int) -> None:
    """Refuse a frame whose aspect ratio is not the image's, beyond the rounding of one pixel.

    Raises:
        FrameError: it differs; the message gives the height that would fit.
    """
    if options.frame_width_px is None or options.frame_height_px is None:
        return
    fitting = options.frame_width_px * height_px / width_px
    slack = 1.0 + height_px / width_px  # one pixel of rounding in either side
    if abs(options.frame_height_px - fitting) > slack:
        raise FrameError(
            f"the frame is {options.frame_width_px} x {options.frame_height_px} px, the image {width_px} x {height_px} "
            f"px: a copy of that width would be {round(fitting)} px high. Give the size of an uncropped copy"
        )


def _frame_scale(
    options: ScaleOptions, width_px: int, gsd: float | None, interval: tuple[float, float] | None
) -> FrameScale | None:
    if options.frame_width_px is None or options.frame_height_px is None:
        return None
    factor = width_px / options.frame_width_px
    return FrameScale(
        width_px=options.frame_width_px,
        height_px=options.frame_height_px,
        gsd_m_per_px=None if gsd is None else gsd * factor,
        gsd_ci95_low_m_per_px=None if interval is None else interval[0] * factor,
        gsd_ci95_high_m_per_px=None if interval is None else interval[1] * factor,
    )
