"""Pipeline from a photograph to its scale: the geometric perception skill.

    image -> raster -> tilt -> prior -> search -> rulers -> decision -> record

Stateless except for loaded models, and deterministic: the same image and model give the same record
for any number of threads.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from vehanchor.analysis.convergence import search_until_settled
from vehanchor.analysis.image_doubts import shows_horizon, with_detections, with_image_doubts
from vehanchor.analysis.remedies import expected_gains
from vehanchor.analysis.scale_analysis import ScaleAnalysis
from vehanchor.detection.copies import without_copies
from vehanchor.detection.detections import NOT_SEARCHED, corrected
from vehanchor.detection.scene_scale import load_scene_scale
from vehanchor.detection.search import ImageSearch
from vehanchor.errors import InvalidParameterError
from vehanchor.imagery.detail import measure_detail_share
from vehanchor.imagery.drawing import measure_drawing_chance
from vehanchor.imagery.facts import image_facts
from vehanchor.imagery.overlaid_lettering import paint_over_lettering
from vehanchor.imagery.photograph import find_photographs
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options.reading import CoordinateFrame
from vehanchor.records import (
    ConfidenceTerms,
    EstimateDetails,
    FrameScale,
    GsdEstimate,
    KnownPlane,
    KnownScale,
    Notice,
    RulerScale,
    SceneScaleEstimate,
    VehiclesByHand,
)
from vehanchor.records.notices import NoticeCode
from vehanchor.rulers.active import active_rulers, check_rulers, ruler_class, unused_facts
from vehanchor.rulers.camera_tilt import metadata_tilt, tilt_doubt
from vehanchor.rulers.reference import reference_length
from vehanchor.rulers.ruler import View
from vehanchor.rulers.scene_scale import SceneScale
from vehanchor.rulers.several_scales import several_scales_notice
from vehanchor.rulers.stated_scale import StatedScale
from vehanchor.rulers.vehicles import vehicle_witness
from vehanchor.rulers.witnesses import (
    NO_PHOTOGRAPH,
    disagreements,
    doubted_as_drawing,
    measure_all,
    with_doubts,
    without_findings,
)
from vehanchor.scale.defaults import PROBABLY_RIGHT, SHORT_SHA
from vehanchor.scale.density import quantile
from vehanchor.scale.lengths import GUARD_GSD_M_PER_PX
from vehanchor.scale.posterior import Answer, answer, judge
from vehanchor.scale.reliability import SAME_NUMBER

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from vehanchor.detection.detector import Detector
    from vehanchor.detection.scene_scale import SceneScalePrior
    from vehanchor.imagery.raster import Raster
    from vehanchor.imagery.sources.opening import ImageSource
    from vehanchor.options import Frame, ScaleOptions
    from vehanchor.options.pixel_grid import PixelGrid
    from vehanchor.records import ExpectedGain, Reason
    from vehanchor.rulers.vehicles import VehicleWitness
    from vehanchor.scale.lengths import Interval
    from vehanchor.scale.posterior import Remark, Witness

# Largest relative difference of the file's own scale without a warning.
GEOREFERENCE_TOLERANCE = 0.10
# Fields of ``EstimateDetails`` that are None without the ruler ``vehicles``.
_VEHICLE_DETAILS = (
    "n_detections",
    "working_scale",
    "aggregation",
    "reference_length_m",
    "reference_source",
    "resolution_guard",
    "composite_confidence",
    "confidence_terms",
)


def checked_detector(detector: Detector, options: ScaleOptions) -> Detector:
    """Check, before the work, that the rulers exist and the detector knows the region.

    Returns:
        The detector.
    """
    check_rulers(options.rulers)
    reference_length(detector.card, options.reference, None)
    return detector


def analyse_image(image: ImageSource, detector: Detector, options: ScaleOptions) -> ScaleAnalysis:
    """Open an image, search it and measure its scale; see ``Engine.analyse_scale``."""
    with open_raster(image, options.reading) as raster:
        analysis = analyse_raster(detector, raster, options)
        return analysis.drawn_over(image, raster, options.reading)


def analyse_raster(detector: Detector, raster: Raster, options: ScaleOptions) -> ScaleAnalysis:
    """Search an open image and measure its scale, with the detector's runtime."""
    return analyse_view(search_raster(raster, detector, options))


def search_raster(
    raster: Raster,
    detector: Detector,
    options: ScaleOptions,
    prior: SceneScalePrior | None = None,
    *,
    check_stretch: bool = True,
) -> View:
    """Take the scene-scale prior of an open image, and search it.

    This is the first half of ``analyse_raster``; ``analyse_view`` is the second.

    Args:
        raster: the image.
        detector: detector of the vehicles.
        options: options of the method.
        prior: known scene-scale prior; None computes that of the image, if a ruler uses it.
        check_stretch: as in ``vehanchor.detection.search.ImageSearch.result``; also whether to
            look for seams between pictures.
    """
    options.frame.check(raster.grid)
    options = options.in_pixels(raster.grid)
    rulers = active_rulers(options.rulers)
    facts = image_facts(raster)
    # An image with the horizon is refused before the work.
    tilt = metadata_tilt(facts, options)
    photographs = find_photographs(raster)
    # Several photographs are searched with all that is between them, and doubted.
    photograph = photographs[0] if len(photographs) == 1 else raster
    facts = with_image_doubts(
        facts,
        photograph,
        metadata=options.rulers.metadata,
        check_seams=check_stretch,
        beside_each_other=() if len(photographs) == 1 else photographs,
    )
    uses_prior = any(ruler.kind == SceneScale.kind for ruler in rulers)
    if prior is None and uses_prior:
        # Letters look like things on the ground; vehicles under them are not painted over.
        ground = paint_over_lettering(photograph)
        prior = load_scene_scale(detector.runtime).predict(ground)
    view = View(
        facts,
        NOT_SEARCHED,
        card=detector.card,
        options=options,
        measure_detail_share=partial(measure_detail_share, photograph),
        raster=photograph,
        runtime=detector.runtime,
        prior=prior,
        tilt=tilt,
        drawing_chance=measure_drawing_chance(photograph),
    )
    if not any(ruler.needs_search for ruler in rulers):
        if options.by_hand.given:
            raise InvalidParameterError(
                f"{options.by_hand.given} needs the ruler vehicles: add it to rulers"
            )
        return view

    search = ImageSearch(photograph, detector, options=options.search, prior=prior)
    if tilt is None:
        search_until_settled(search, view)
    else:
        # Lengths vary over a tilted image, so that a part of it does not settle the scale.
        for _ in search:
            pass
    detections = corrected(
        without_copies(raster, search.result(check_stretch=check_stretch)),
        options.by_hand,
        CoordinateFrame(options.frame, raster.grid),
        nms_iou=options.search.nms_iou,
        length_over_width=detector.card.errors.boxes.length_over_width,
    )
    return with_detections(view, raster, detections)


def analyse_view(view: View, earlier: Sequence[Witness] | None = None) -> ScaleAnalysis:
    """Measure the scale of a searched image; one search can serve several options.

    Args:
        view: view of the image, with its tilt.
        earlier: as in ``vehanchor.rulers.witnesses.measure_all``.

    Raises:
        InvalidParameterError: the model does not know the region, or a ruler does not exist.
        CalibrationMismatchError: the calibration was made for another model.
    """
    witnesses = measure_all(view, earlier)
    vehicles = vehicle_witness(witnesses)
    notices: tuple[Notice, ...] = ()
    tilt_chance = 0.0
    # The vehicles may show a tilt, or several scales, only if no tilt is known.
    if view.tilt is None and vehicles is not None and vehicles.found:
        log_size_sd = view.card.errors.boxes.log_size_sd
        doubt = tilt_doubt(view.image, view.options, view.detections, log_size_sd=log_size_sd)
        tilt_chance = doubt.chance
        notices = doubt.notices + several_scales_notice(
            view.image,
            view.detections,
            length_m=vehicles.reference.length_m,
            errors=view.card.errors,
        )
    return conclude(view, witnesses, notices, tilt_chance=tilt_chance)


def conclude(
    view: View,
    measured: tuple[Witness, ...],
    notices: Sequence[Notice] = (),
    *,
    tilt_chance: float = 0.0,
) -> ScaleAnalysis:
    """Decide on the scale, and make the record.

    Args:
        view: view of the image.
        measured: witnesses of all rulers.
        notices: notices of the tilt.
        tilt_chance: 0..1, chance that the image has no single scale because of an unknown tilt.
    """
    measured = doubted_as_drawing(measured, view.drawing_chance)
    doubts: tuple[Remark, ...] = (*view.image.notices, *notices)
    is_oblique = shows_horizon(view)
    if is_oblique:
        measured = without_findings(measured)
    distinct = _without_repetition(measured)
    witnesses = with_doubts(distinct, doubts, tilt_chance=tilt_chance)
    is_paper = view.options.method.preset == "paper"
    decided = None if is_paper else answer(witnesses)
    if decided is not None:
        witnesses = _fitted_to(decided, witnesses)
        measured = _fitted_to(decided, measured)
    vehicles = vehicle_witness(witnesses)
    if is_paper:
        decision = _decision_by_paper(vehicles)
    else:
        decision = _decision(decided, witnesses)

    warnings = [*notices_of(view.image.notices)]
    if view.drawing_chance >= PROBABLY_RIGHT:
        warnings.append(NO_PHOTOGRAPH)
        if decision.gsd_m_per_px is None:
            decision = decision._replace(reason="no_photograph")
    if is_oblique:
        decision = decision._replace(reason="oblique")
    warnings += notices_of(notice for witness in witnesses for notice in witness.notices)
    warnings += notices
    warnings += unused_facts(view.options.rulers)
    if decided is not None:
        warnings += disagreements(witnesses, decided)
    warnings += georeference_notice(
        view.image.georeference_gsd_m_per_px,
        decision.gsd_m_per_px,
        "the rulers give",
        interval=decision.interval,
    )
    record = _record(view, witnesses, decision, tuple(warnings))
    if record.reason is not None and not is_paper:

        def decide(hypothetical: Sequence[Witness]) -> Answer | None:
            return judge(with_doubts(hypothetical, doubts, tilt_chance=tilt_chance))

        record = _with_remedies(record, expected_gains(view, distinct, decided, decide))
    shown = NOT_SEARCHED if vehicles is None else view.detections
    return ScaleAnalysis(
        record,
        measured,
        shown,
        answer=decided,
        part=view.image.part,
        grid=view.image.grid,
    )


def _with_remedies(record: GsdEstimate, remedies: tuple[ExpectedGain, ...]) -> GsdEstimate:
    """Add to a record what would help."""
    details = record.details.model_copy(update={"remedies": remedies})
    return record.model_copy(update={"details": details})


def _fitted_to(decided: Answer, witnesses: Sequence[Witness]) -> tuple[Witness, ...]:
    """Mark those vehicles as kept whose lengths fit the decided scale."""
    vehicles = vehicle_witness(witnesses)
    if vehicles is None or not vehicles.found:
        return tuple(witnesses)
    fitted = vehicles.fitted_to(decided.gsd_m_per_px)
    return tuple(fitted if witness is vehicles else witness for witness in witnesses)


def _without_repetition(witnesses: tuple[Witness, ...]) -> tuple[Witness, ...]:
    """Leave out a stated scale that repeats the answer of the others.

    The same number is one witness: an answer that is given back does not confirm itself.
    """
    for stated in witnesses:
        if stated.kind != StatedScale.kind or not stated.found or stated.gsd_m_per_px is None:
            continue
        others = tuple(witness for witness in witnesses if witness is not stated)
        decided = judge(others)
        if decided is None:
            return witnesses
        log_ratio = math.log(stated.gsd_m_per_px / decided.gsd_m_per_px)
        return others if abs(log_ratio) <= SAME_NUMBER else witnesses
    return witnesses


class _Decision(NamedTuple):
    """Scale and its explanation, for the record.

    Attributes:
        gsd_m_per_px: the scale; None if there is none.
        interval: its 95 % interval.
        confidence: 0..1.
        reason: why the scale is not usable; None if it is.
        leading: kind of the ruler that leads.
        rulers: rulers that found something.
    """

    gsd_m_per_px: float | None
    interval: Interval | None
    confidence: float
    reason: Reason | None
    leading: str | None = None
    rulers: tuple[RulerScale, ...] = ()


def _decision(decided: Answer | None, witnesses: Sequence[Witness]) -> _Decision:
    """Take the decision of the posterior; None means that there is no scale."""
    if decided is None:
        return _no_scale(witnesses)
    informative = [witness for witness in witnesses if witness.found]
    rulers = [
        _ruler_scale(witness, p_right)
        for witness, p_right in zip(informative, decided.p_right, strict=True)
    ]
    return _Decision(
        decided.gsd_m_per_px,
        decided.interval,
        confidence=decided.chance,
        reason=decided.reason,
        leading=informative[decided.leading].kind,
        rulers=tuple(rulers),
    )


def _decision_by_paper(vehicles: VehicleWitness | None) -> _Decision:
    """Decide by the published method, for the preset ``paper``."""
    if vehicles is None or vehicles.paper.gsd_m_per_px is None:
        return _Decision(None, None, confidence=0.0, reason="too_few")
    paper = vehicles.paper
    witness = replace(vehicles, gsd_m_per_px=paper.gsd_m_per_px)
    return _Decision(
        paper.gsd_m_per_px,
        vehicles.paper_interval,
        confidence=paper.confidence,
        reason=paper.reason(vehicles.n),
        leading=vehicles.kind,
        rulers=(_ruler_scale(witness, paper.confidence),),
    )


def _no_scale(witnesses: Sequence[Witness]) -> _Decision:
    """Explain a missing scale: the scene looks too coarse for cars, or no ruler found anything."""
    reason: Reason = "too_few"
    for witness in witnesses:
        if witness.sets_scale or witness.interval is None:
            continue
        if witness.interval.low > GUARD_GSD_M_PER_PX:
            reason = "too_coarse"
    return _Decision(None, None, confidence=0.0, reason=reason)


def _record(
    view: View,
    witnesses: Sequence[Witness],
    decision: _Decision,
    warnings: tuple[Notice, ...],
) -> GsdEstimate:
    """Make the record of an image."""
    image = view.image
    vehicles = vehicle_witness(witnesses)
    gsd = decision.gsd_m_per_px
    interval = decision.interval
    n_vehicles = None
    mode_length_px = None
    if vehicles is not None:
        n_vehicles = vehicles.n
        mode_length_px = vehicles.mode_length_px
    tilt = None
    if view.tilt is not None:
        tilt = view.tilt.record(image, gsd)
    return GsdEstimate(
        status=_status(decision),
        **_with_ci95(gsd, interval),
        confidence=decision.confidence,
        n_vehicles=n_vehicles,
        mode_length_px=mode_length_px,
        reason=decision.reason,
        leading_ruler=decision.leading,
        rulers=decision.rulers,
        image_width_px=image.grid.width_px,
        image_height_px=image.grid.height_px,
        georeference_gsd_m_per_px=image.georeference_gsd_m_per_px,
        tilt=tilt,
        frame=frame_scale(view.options.frame, image.grid, gsd=gsd, interval=interval),
        scale=make_known_scale(view, gsd, interval=interval, confidence=decision.confidence),
        model=view.card.name,
        warnings=warnings,
        details=_details(view, vehicles, witnesses),
    )


def _status(decision: _Decision) -> Literal["ok", "low_confidence", "no_scale"]:
    """Name the status of a record."""
    if decision.gsd_m_per_px is None:
        return "no_scale"
    if decision.reason is not None:
        return "low_confidence"
    return "ok"


def _details(
    view: View, vehicles: VehicleWitness | None, witnesses: Sequence[Witness]
) -> EstimateDetails:
    """Make the details of a record; those of vehicles are None if the caller excludes them."""
    detections = view.detections
    by_hand = None
    if detections.corrections is not None:
        corrections = detections.corrections
        by_hand = VehiclesByHand(dropped=corrections.n_dropped, added=corrections.n_added)
    return EstimateDetails(
        preset=view.options.method.preset,
        pixel_aspect=view.image.grid.stated_aspect,
        scene_scale=_scene_scale(witnesses),
        by_hand=by_hand,
        tiles_searched=detections.n_tiles,
        tiles_total=detections.n_tiles_total or detections.n_tiles,
        candidates_skipped=detections.n_skipped,
        stopped_because=detections.stopped_because,
        model_sha256=view.card.sha256,
        **_vehicle_details(vehicles),
    )


def _scene_scale(witnesses: Sequence[Witness]) -> SceneScaleEstimate | None:
    """Show the scene-scale prior; None if it was not measured."""
    for witness in witnesses:
        if witness.kind == SceneScale.kind and witness.found:
            return SceneScaleEstimate(**_with_ci95(witness.gsd_m_per_px, witness.interval))
    return None


def _vehicle_details(vehicles: VehicleWitness | None) -> dict[str, Any]:
    """Collect the fields of ``EstimateDetails`` about vehicles."""
    if vehicles is None:
        return dict.fromkeys(_VEHICLE_DETAILS)
    return {
        "n_detections": len(vehicles.fleet.detections.boxes),
        "working_scale": vehicles.fleet.main_reduction,
        "aggregation": vehicles.aggregation,
        "reference_length_m": vehicles.reference.stated_m,
        "reference_source": vehicles.reference.stated_source,
        "resolution_guard": vehicles.paper.guarded,
        "composite_confidence": vehicles.paper.confidence,
        "confidence_terms": ConfidenceTerms(**vehicles.paper.terms._asdict()),
    }


def _ruler_scale(witness: Witness, p_right: float) -> RulerScale:
    """Show the scale of one ruler."""
    assert witness.right_with_guess is not None
    ruler = ruler_class(witness.kind)
    return RulerScale(
        kind=witness.kind,
        label=ruler.label,
        sets_scale=ruler.sets_scale,
        **_with_ci95(witness.gsd_m_per_px, witness.interval),
        density_median_m_per_px=quantile(witness.right_with_guess, 0.5),
        n=witness.n,
        p_right=min(1.0, p_right),
        probably_right=p_right >= PROBABLY_RIGHT,
        explanation=witness.statement,
    )


def make_known_scale(
    view: View, gsd: float | None, interval: tuple[float, float] | None, confidence: float
) -> KnownScale | None:
    """Make the scale to give back; None without a scale, or if the image has no checksum."""
    if gsd is None or interval is None or not view.image.image_id:
        return None
    plane = None
    if view.tilt is not None:
        plane = KnownPlane.model_validate(view.tilt, from_attributes=True)
    low, high = interval
    return KnownScale(
        gsd_m_per_px=gsd,
        gsd_ci95_low_m_per_px=min(low, gsd),
        gsd_ci95_high_m_per_px=max(high, gsd),
        confidence=confidence,
        image_id=view.image.image_id,
        model_id=view.card.sha256[:SHORT_SHA],
        plane=plane,
    )


def _with_ci95(
    gsd: float | None, interval: tuple[float, float] | None, factor: float = 1.0
) -> dict[str, Any]:
    """Collect the fields of a scale and its interval, times a factor; all None without a scale."""
    low, high = interval or (None, None)
    values = {"gsd_m_per_px": gsd, "gsd_ci95_low_m_per_px": low, "gsd_ci95_high_m_per_px": high}
    return {name: None if value is None else value * factor for name, value in values.items()}


def notices_of(notes: Iterable[Remark]) -> tuple[Notice, ...]:
    """Convert the warnings of an image and of rulers to notices."""
    return tuple(Notice(code=note.code, message=note.message) for note in notes)


def georeference_notice(
    own: float | None,
    gsd_m_per_px: float | None,
    source: str,
    *,
    interval: Interval | None = None,
) -> list[Notice]:
    """Warn if the file's own scale differs by more than a tenth, and lies outside the interval.

    Args:
        own: the file's scale, metres per pixel; None without one.
        gsd_m_per_px: the other scale; None without one.
        source: source of the other scale, as the middle of a sentence.
        interval: 95 % interval of the other scale; None if unknown.

    Returns:
        One notice, or none.
    """
    if own is None or gsd_m_per_px is None:
        return []
    if abs(gsd_m_per_px - own) <= GEOREFERENCE_TOLERANCE * own:
        return []
    if interval is not None and interval.low <= own <= interval.high:
        return []
    percent = 100 * (gsd_m_per_px / own - 1)
    message = (
        f"The file's own scale is {own:.4g} m/px, {source} {gsd_m_per_px:.4g} m/px: "
        f"{percent:+.0f} %. Check which of the two is wrong before using either."
    )
    return [Notice(code=NoticeCode.GEOREFERENCE_DIFFERS, message=message)]


def frame_scale(
    frame: Frame, grid: PixelGrid, gsd: float | None, interval: tuple[float, float] | None
) -> FrameScale | None:
    """Compute the scale in the caller's copy of an image; None without a copy.

    In a copy with the file's pixels, which are not square, it is that of their shorter side.
    """
    if frame.size is None:
        return None
    frame_width, frame_height = frame.size
    # A pixel of the copy is as many times larger as the copy is narrower.
    factor = CoordinateFrame(frame, grid).side_of_copy_px
    return FrameScale(
        width_px=frame_width, height_px=frame_height, **_with_ci95(gsd, interval, factor)
    )
