"""Pipeline from a photograph to its scale: the geometric perception skill.

    image -> raster -> prior -> search -> tilt -> rulers -> decision -> record

Stateless except for loaded models, and deterministic: the same image and model give the same record for any number of
threads.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

from vehanchor.analysis.scale import ScaleAnalysis
from vehanchor.detection.corrections import corrected
from vehanchor.detection.detections import NOT_SEARCHED, Detections
from vehanchor.detection.scene_scale import load_scene_scale
from vehanchor.detection.search import search
from vehanchor.errors import InvalidParameterError
from vehanchor.imagery.detail import resolved_share
from vehanchor.imagery.facts import image_facts
from vehanchor.imagery.identity import begin_image_id
from vehanchor.imagery.sources.opening import can_be_read_again, open_raster
from vehanchor.records import (
    FrameScale,
    GsdEstimate,
    KnownScale,
    Notice,
    RulerScale,
    SceneScaleEstimate,
    VehiclesByHand,
)
from vehanchor.records.notices import NoticeCode
from vehanchor.rulers.agreement import disagreements, outvoted_priors
from vehanchor.rulers.decision import convergence, decide
from vehanchor.rulers.evidence import View
from vehanchor.rulers.measurement import measure_all, with_tilt
from vehanchor.rulers.reference import reference_length
from vehanchor.rulers.registry import active_rulers, check_rulers, ruler_class, uses
from vehanchor.rulers.scene_scale import SceneScale
from vehanchor.rulers.stated import unit_notices
from vehanchor.rulers.vehicles import Vehicles
from vehanchor.tilt.camera_tilt import metadata_tilt
from vehanchor.tilt.estimate import tilt_notice

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from vehanchor.detection.card import DetectorCard
    from vehanchor.detection.convergence import Convergence
    from vehanchor.detection.detector import Detector
    from vehanchor.detection.scene_scale import SceneScalePrior
    from vehanchor.imagery.raster import Raster, RasterNote
    from vehanchor.imagery.sources.opening import ImageSource
    from vehanchor.options import Frame, ScaleOptions
    from vehanchor.rulers.decision import RulerShare, ScaleDecision
    from vehanchor.rulers.evidence import Evidence
    from vehanchor.rulers.vehicles import VehicleEvidence

_MODEL_DIGITS = 12
GEOREFERENCE_TOLERANCE = 0.10  # largest difference of the file's own scale without a warning


def checked_detector(detector: Detector, options: ScaleOptions) -> Detector:
    """Check, before the work, that the rulers exist and the detector knows the region; return the detector."""
    check_rulers(options.rulers)
    reference_length(detector.card, options.reference, None)
    return detector


def analyse_image(image: ImageSource, detector: Detector, options: ScaleOptions) -> ScaleAnalysis:
    """Open an image, search it and measure its scale; see ``Engine.analyse_scale``."""
    reading = options.reading
    with open_raster(image, bands=reading.bands, limits=reading.limits, bgr=reading.bgr) as raster:
        analysis = analyse_raster(raster, detector, options)
    seen = image if can_be_read_again(image) else None
    return replace(analysis, image=seen, reading=reading, ground=raster.ground)


def analyse_raster(raster: Raster, detector: Detector, options: ScaleOptions) -> ScaleAnalysis:
    """Search an open image and measure its scale, with the detector's runtime."""
    return analyse_detections(search_raster(raster, detector, options))


def search_raster(
    raster: Raster,
    detector: Detector,
    options: ScaleOptions,
    prior: SceneScalePrior | None = None,
    *,
    check_stretch: bool = True,
) -> View:
    """Take the scene-scale prior of an open image, and search it: the first half of ``analyse_raster``.

    Args:
        raster: the image.
        detector: finds the vehicles.
        options: of the method.
        prior: known scene-scale prior; None takes the image's own, if it has a use.
        check_stretch: as in ``vehanchor.detection.search.search``.
    """
    options.frame.check(raster.width_px, raster.height_px)
    options = options.in_pixels(raster.width_px, raster.height_px)
    rulers = active_rulers(options.rulers)
    facts, image_id = image_facts(raster), begin_image_id(raster)
    tilt = metadata_tilt(facts, options)  # refuses an image with the horizon before the work
    kinds = {ruler.kind for ruler in rulers}
    weighed = detector.card.votes or Vehicles.kind not in kinds  # otherwise the prior has no use
    if prior is None and weighed and SceneScale.kind in kinds:
        network = load_scene_scale(detector.runtime)
        prior = None if network is None else network.predict(raster)
    resolved = partial(resolved_share, raster)
    view = View(facts, NOT_SEARCHED, detector.card, options, resolved, raster, detector.runtime, prior, tilt)
    if not any(ruler.needs_search for ruler in rulers):
        if options.by_hand.given:
            raise InvalidParameterError(f"{options.by_hand.given} needs the ruler vehicles: add it to rulers")
        return replace(view, image=facts._replace(image_id=image_id()))
    detections = search(
        raster,
        detector,
        options.search,
        prior=prior,
        convergence=None if tilt else partial(_convergence, view),  # in a tilted view, lengths vary over the image
        check_stretch=check_stretch,
    )
    chosen, size_px = options.search, (raster.width_px, raster.height_px)
    detections = corrected(detections, options.by_hand, options.frame, size_px, chosen.nms_iou)
    return replace(view, image=facts._replace(image_id=image_id()), detections=detections)


def _convergence(view: View, detections: Detections) -> Convergence:
    """Compute the convergence of the search so far."""
    view = replace(view, detections=detections)
    priors = [ruler.measure(view) for ruler in active_rulers(view.options.rulers) if not ruler.sets_scale]
    return convergence(Vehicles().measure(view), priors)


def analyse_detections(view: View) -> ScaleAnalysis:
    """Measure the scale of a searched image; one search can serve several options.

    Args:
        view: of the image.

    Raises:
        InvalidParameterError: the model does not know the region, or a ruler does not exist.
        CalibrationMismatchError: the calibration was made for another model.
        TooObliqueError: the horizon is visible, or nearly so.
    """
    return analyse_view(with_tilt(view))


def analyse_view(view: View, known: Sequence[Evidence] = ()) -> ScaleAnalysis:
    """Measure the scale of a view with an estimated tilt.

    Args:
        view: of the image.
        known: earlier evidence, which is not measured again.
    """
    vehicles, others = measure_all(view, known)
    notices = tilt_notice(view.image, view.options, view.detections) if view.tilt is None and vehicles.n else ()
    return conclude(view, vehicles, others, notices)


def conclude(
    view: View, vehicles: VehicleEvidence, others: tuple[Evidence, ...], notices: Sequence[Notice] = ()
) -> ScaleAnalysis:
    """Decide on the scale, and make the record.

    Args:
        view: of the image.
        vehicles: their evidence.
        others: evidence of the other rulers.
        notices: of the tilt.
    """
    decision = decide(vehicles, others)
    outvoted = [ruler.kind for ruler in decision.rulers if not ruler.agrees]
    warnings = [*image_notices(view.image.notices), *vehicles.notices]
    warnings += [notice for other in others for notice in other.notices]
    warnings += [*notices, *disagreements((vehicles, *others), outvoted, settled=decision.led_by_measured)]
    warnings += outvoted_priors((vehicles, *others)).values()
    warnings += unit_notices((vehicles, *others))
    if decision.gsd_m_per_px is not None:
        alone = decision.gsd_m_per_px == vehicles.gsd_m_per_px
        own, who_says = view.image.georeference_gsd_m_per_px, Vehicles.says() if alone else "the rulers say"
        warnings += georeference_notice(own, decision.gsd_m_per_px, who_says)
    record = _record(view, vehicles, others, decision, tuple(warnings))
    rectified = view.tilt is not None and uses(view.options.rulers, Vehicles.kind)
    return ScaleAnalysis(record, vehicles, others, view.detections if rectified else None)


def _record(
    view: View,
    vehicles: VehicleEvidence,
    others: Sequence[Evidence],
    decision: ScaleDecision,
    warnings: tuple[Notice, ...],
) -> GsdEstimate:
    image, gsd, interval = view.image, decision.gsd_m_per_px, decision.interval
    return GsdEstimate(
        status="no_scale" if gsd is None else "low_confidence" if decision.reason else "ok",
        gsd_m_per_px=gsd,
        confidence=decision.confidence,
        n_vehicles=vehicles.n,
        mode_length_px=vehicles.mode_length_px,
        gsd_ci95_low_m_per_px=interval and interval.low,
        gsd_ci95_high_m_per_px=interval and interval.high,
        p_within_20=decision.p_within_20,
        reason=decision.reason,
        scene_scale=next((_scene_scale(other) for other in others if other.kind == SceneScale.kind), None),
        leading_ruler=decision.source,
        rulers=tuple(_ruler_scale(share) for share in decision.rulers),
        n_detections=len(vehicles.fleet.detections.boxes),
        working_scale=vehicles.fleet.working_scale,
        by_hand=_by_hand(view.detections),
        tiles_searched=view.detections.n_tiles,
        tiles_total=view.detections.n_tiles_total or view.detections.n_tiles,
        candidates_skipped=view.detections.n_skipped,
        stopped_because=view.detections.stopped_because,
        aggregation=vehicles.aggregation,
        reference_length_m=vehicles.reference.length_m,
        reference_source=vehicles.reference.source,
        resolution_guard=vehicles.guarded,
        composite_confidence=vehicles.confidence,
        confidence_terms=vehicles.terms,
        image_width_px=image.width_px,
        image_height_px=image.height_px,
        georeference_gsd_m_per_px=image.georeference_gsd_m_per_px,
        tilt=None if view.tilt is None else view.tilt.record(image, gsd),
        frame=frame_scale(view.options.frame, image.width_px, gsd, interval),
        scale=_known_scale(view, gsd, interval, decision.confidence),
        model=view.card.name,
        model_sha256=view.card.sha256,
        warnings=warnings,
    )


def _by_hand(detections: Detections) -> VehiclesByHand | None:
    told = detections.corrections
    return told and VehiclesByHand(confirmed=told.n_confirmed, dropped=told.n_dropped, added=told.n_added)


def _ruler_scale(share: RulerShare) -> RulerScale:
    ruler = ruler_class(share.kind)
    return RulerScale(
        kind=share.kind,
        label=ruler.label,
        sets_scale=ruler.sets_scale,
        gsd_m_per_px=share.gsd_m_per_px,
        gsd_ci95_low_m_per_px=share.interval.low,
        gsd_ci95_high_m_per_px=share.interval.high,
        n=share.n,
        weight=share.weight,
        agrees=share.agrees,
        explanation=share.explanation,
    )


def model_id(card: DetectorCard) -> str:
    """Give the first digits of a detector's checksum."""
    return card.sha256[:_MODEL_DIGITS]


def _known_scale(
    view: View, gsd: float | None, interval: tuple[float, float] | None, confidence: float
) -> KnownScale | None:
    """Make the scale to give back; None without a scale, or if the image has no checksum."""
    if gsd is None or interval is None or not view.image.image_id:
        return None
    return KnownScale(
        gsd_m_per_px=gsd,
        gsd_ci95_low_m_per_px=min(interval[0], gsd),
        gsd_ci95_high_m_per_px=max(interval[1], gsd),
        confidence=confidence,
        image_id=view.image.image_id,
        model_id=model_id(view.card),
        plane=None if view.tilt is None else view.tilt.known_plane(),
    )


def _scene_scale(evidence: Evidence) -> SceneScaleEstimate | None:
    if evidence.gsd_m_per_px is None or evidence.interval is None:
        return None
    low, high = evidence.interval
    return SceneScaleEstimate(
        gsd_m_per_px=evidence.gsd_m_per_px, gsd_ci95_low_m_per_px=low, gsd_ci95_high_m_per_px=high
    )


def image_notices(notes: Iterable[RasterNote]) -> tuple[Notice, ...]:
    """Convert the warnings from reading an image to notices."""
    return tuple(Notice(code=note.code, message=note.message) for note in notes)


def georeference_notice(own: float | None, gsd_m_per_px: float, who_says: str) -> list[Notice]:
    """Warn if the file's own scale differs from another by more than a tenth.

    Args:
        own: the file's scale, metres per pixel; None without one.
        gsd_m_per_px: the other scale.
        who_says: source of the other scale, as the middle of a sentence.

    Returns:
        One notice, or none.
    """
    if own is None or abs(gsd_m_per_px - own) <= GEOREFERENCE_TOLERANCE * own:
        return []
    return [
        Notice(
            code=NoticeCode.GEOREFERENCE_DIFFERS,
            message=f"The file's own scale is {own:.4g} m/px, {who_says} {gsd_m_per_px:.4g} m/px: "
            f"{100 * (gsd_m_per_px / own - 1):+.0f} %. Check which of the two is wrong before using either.",
        )
    ]


def frame_scale(
    frame: Frame, width_px: int, gsd: float | None, interval: tuple[float, float] | None
) -> FrameScale | None:
    """Compute the scale in the caller's copy of an image with this width; None without a copy."""
    if frame.size is None:
        return None
    factor = width_px / frame.size[0]
    return FrameScale(
        width_px=frame.size[0],
        height_px=frame.size[1],
        gsd_m_per_px=None if gsd is None else gsd * factor,
        gsd_ci95_low_m_per_px=None if interval is None else interval[0] * factor,
        gsd_ci95_high_m_per_px=None if interval is None else interval[1] * factor,
    )
