"""Pipeline from a photograph to its scale: the geometric perception skill.

    image -> raster -> tilt -> prior -> search -> rulers -> decision -> record

Stateless except for loaded models, and deterministic: the same image and model give the same record
for any number of threads.
"""

from __future__ import annotations

import math
import os
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

from vehanchor.analysis.convergence import search_until_settled
from vehanchor.analysis.scale_analysis import ScaleAnalysis
from vehanchor.detection.detections import NOT_SEARCHED, corrected
from vehanchor.detection.scene_scale import load_scene_scale
from vehanchor.detection.search import ImageSearch
from vehanchor.errors import ImageListError, InvalidParameterError, VehAnchorError
from vehanchor.imagery.detail import measure_detail_share
from vehanchor.imagery.facts import image_facts
from vehanchor.imagery.sources.opening import open_raster
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
from vehanchor.rulers.active import active_rulers, check_rulers, ruler_class
from vehanchor.rulers.camera_tilt import metadata_tilt, tilt_notice
from vehanchor.rulers.reference import reference_length
from vehanchor.rulers.ruler import View
from vehanchor.rulers.scene_scale import SceneScale
from vehanchor.rulers.stated_scale import StatedScale
from vehanchor.rulers.vehicles import measured_vehicles
from vehanchor.rulers.witnesses import disagreements, measure_all, with_doubts
from vehanchor.scale.defaults import PROBABLY_RIGHT
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
    from vehanchor.records import Reason
    from vehanchor.rulers.vehicles import VehicleWitness
    from vehanchor.scale.lengths import Interval
    from vehanchor.scale.posterior import Remark, Witness

_MODEL_DIGITS = 12
_SHOWN_FAILURES = 10  # of a list of images
GEOREFERENCE_TOLERANCE = 0.10  # largest difference of the file's own scale without a warning


def checked_detector(detector: Detector, options: ScaleOptions) -> Detector:
    """Check, before the work, that the rulers exist and the detector knows the region; return the detector."""
    check_rulers(options.rulers)
    reference_length(detector.card, options.reference, None)
    return detector


def analyse_image(image: ImageSource, detector: Detector, options: ScaleOptions) -> ScaleAnalysis:
    """Open an image, search it and measure its scale; see ``Engine.analyse_scale``."""
    with open_raster(image, options.reading) as raster:
        return analyse_raster(detector, raster, options).drawn_over(image, raster, options.reading)


def estimate_each(
    images: Sequence[ImageSource], detector: Detector, options: ScaleOptions
) -> list[GsdEstimate]:
    """Estimate the scale of each image; one that fails does not end the work on the others.

    Raises:
        ImageListError: images failed; the error names them and holds all results.
    """
    results: list[GsdEstimate | VehAnchorError] = []
    for image in images:
        try:
            results.append(analyse_image(image, detector, options).estimate)
        except VehAnchorError as error:
            results.append(error)
    records = [each for each in results if not isinstance(each, VehAnchorError)]
    if len(records) < len(results):
        raise ImageListError(_failures_text(images, results), results)
    return records


def _failures_text(
    images: Sequence[ImageSource], results: Sequence[GsdEstimate | VehAnchorError]
) -> str:
    """Name the failed images, the first of them with their errors."""
    failures = [
        f"image {number} ({_image_name(image)}): {error}"
        for number, (image, error) in enumerate(zip(images, results, strict=True), 1)
        if isinstance(error, VehAnchorError)
    ]
    shown = "; ".join(failures[:_SHOWN_FAILURES])
    more = (
        f"; and {len(failures) - _SHOWN_FAILURES} more" if len(failures) > _SHOWN_FAILURES else ""
    )
    return (
        f"{len(failures)} of {len(results)} images cannot be used: {shown}{more}. Leave them "
        "out; results of this "
        "error has the records of the others"
    )


def _image_name(image: ImageSource) -> str:
    return os.fspath(image) if isinstance(image, str | os.PathLike) else type(image).__name__


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
    """Take the scene-scale prior of an open image, and search it: the first half of ``analyse_raster``.

    Args:
        raster: the image.
        detector: finds the vehicles.
        options: of the method.
        prior: known scene-scale prior; None takes the image's own, if it has a use.
        check_stretch: as in ``vehanchor.detection.search.ImageSearch.result``.
    """
    options.frame.check(raster.width_px, raster.height_px)
    options = options.in_pixels(raster.width_px, raster.height_px)
    rulers = active_rulers(options.rulers)
    facts = image_facts(raster)
    tilt = metadata_tilt(facts, options)  # refuses an image with the horizon before the work
    kinds = {ruler.kind for ruler in rulers}
    if prior is None and SceneScale.kind in kinds:
        prior = load_scene_scale(detector.runtime).predict(raster)
    detail_share = partial(measure_detail_share, raster)
    view = View(
        facts,
        NOT_SEARCHED,
        card=detector.card,
        options=options,
        measure_detail_share=detail_share,
        raster=raster,
        runtime=detector.runtime,
        prior=prior,
        tilt=tilt,
    )
    if not any(ruler.needs_search for ruler in rulers):
        if options.by_hand.given:
            raise InvalidParameterError(
                f"{options.by_hand.given} needs the ruler vehicles: add it to rulers"
            )
        return view
    work = ImageSearch(raster, detector, options=options.search, prior=prior)
    if tilt is None:
        search_until_settled(work, view)
    else:  # lengths vary over the image
        for _ in work:
            pass
    detections = work.result(check_stretch=check_stretch)
    chosen = options.search
    size_px = (raster.width_px, raster.height_px)
    detections = corrected(detections, options.by_hand, options.frame, size_px, chosen.nms_iou)
    return replace(view, detections=detections)


def analyse_view(view: View, known: Sequence[Witness] | None = None) -> ScaleAnalysis:
    """Measure the scale of a searched image; one search can serve several options.

    Args:
        view: of the image, with its tilt.
        known: as in ``vehanchor.rulers.witnesses.measure_all``.

    Raises:
        InvalidParameterError: the model does not know the region, or a ruler does not exist.
        CalibrationMismatchError: the calibration was made for another model.
    """
    witnesses = measure_all(view, known)
    vehicles = measured_vehicles(witnesses)
    doubtful = view.tilt is None and vehicles is not None and vehicles.found
    return conclude(
        view, witnesses, tilt_notice(view.image, view.options, view.detections) if doubtful else ()
    )


def conclude(
    view: View, measured: tuple[Witness, ...], notices: Sequence[Notice] = ()
) -> ScaleAnalysis:
    """Decide on the scale, and make the record.

    Args:
        view: of the image.
        measured: witnesses of all rulers.
        notices: of the tilt.
    """
    witnesses = _without_repetition(measured)
    own = notices_of(notice for each in witnesses for notice in each.notices)
    witnesses = with_doubts(witnesses, notices)
    vehicles = measured_vehicles(witnesses)
    if view.options.method.preset == "paper":
        found = None
        decided = _by_paper(vehicles)
    else:
        found = answer(witnesses)
        decided = _no_scale(witnesses) if found is None else _Decided.of(found, witnesses)
    warnings = [*notices_of(view.image.notices), *own, *notices]
    warnings += [] if found is None else disagreements(witnesses, found)
    warnings += georeference_notice(
        view.image.georeference_gsd_m_per_px, decided.gsd_m_per_px, "the rulers say"
    )
    record = _record(view, witnesses, decided, tuple(warnings))
    shown = NOT_SEARCHED if vehicles is None else view.detections
    return ScaleAnalysis(record, measured, shown, answer=found)


def _without_repetition(witnesses: tuple[Witness, ...]) -> tuple[Witness, ...]:
    """Leave out a stated scale that repeats the answer of the others: the same number is one witness."""
    stated = next(
        (each for each in witnesses if each.kind == StatedScale.kind and each.found), None
    )
    rest = tuple(each for each in witnesses if each is not stated)
    found = None if stated is None else judge(rest)
    if stated is None or stated.gsd_m_per_px is None or found is None:
        return witnesses
    repeats = abs(math.log(stated.gsd_m_per_px / found.gsd_m_per_px)) <= SAME_NUMBER
    return rest if repeats else witnesses


class _Decided(NamedTuple):
    """What a record says of the scale."""

    gsd_m_per_px: float | None
    interval: Interval | None
    confidence: float
    reason: Reason | None
    leading: str | None = None
    rulers: tuple[RulerScale, ...] = ()

    @classmethod
    def of(cls, found: Answer, witnesses: Sequence[Witness]) -> _Decided:
        heard = [each for each in witnesses if each.found]
        rulers = tuple(
            _ruler_scale(each, p_right) for each, p_right in zip(heard, found.p_right, strict=True)
        )
        kind = heard[found.leading].kind
        return cls(found.gsd_m_per_px, found.interval, found.chance, found.reason, kind, rulers)


def _by_paper(vehicles: VehicleWitness | None) -> _Decided:
    """Decide by the published method, for the preset ``paper``."""
    if vehicles is None or vehicles.paper.gsd_m_per_px is None:
        return _Decided(None, None, confidence=0.0, reason="too_few")
    paper = vehicles.paper
    rulers = (_ruler_scale(replace(vehicles, gsd_m_per_px=paper.gsd_m_per_px), paper.confidence),)
    reason = paper.reason(vehicles.n)
    return _Decided(
        paper.gsd_m_per_px,
        paper.interval,
        confidence=paper.confidence,
        reason=reason,
        leading=vehicles.kind,
        rulers=rulers,
    )


def _no_scale(witnesses: Sequence[Witness]) -> _Decided:
    """Say why there is no scale: the scene looks too coarse for cars, or no ruler found anything."""
    priors = [
        each.interval for each in witnesses if not each.sets_scale and each.interval is not None
    ]
    coarse = any(interval.low > GUARD_GSD_M_PER_PX for interval in priors)
    return _Decided(None, None, confidence=0.0, reason="too_coarse" if coarse else "too_few")


def _record(
    view: View, witnesses: Sequence[Witness], decided: _Decided, warnings: tuple[Notice, ...]
) -> GsdEstimate:
    image = view.image
    vehicles = measured_vehicles(witnesses)
    gsd = decided.gsd_m_per_px
    interval = decided.interval
    return GsdEstimate(
        status="no_scale" if gsd is None else "low_confidence" if decided.reason else "ok",
        **_with_ci95(gsd, interval),
        confidence=decided.confidence,
        n_vehicles=None if vehicles is None else vehicles.n,
        mode_length_px=None if vehicles is None else vehicles.mode_length_px,
        reason=decided.reason,
        leading_ruler=decided.leading,
        rulers=decided.rulers,
        image_width_px=image.width_px,
        image_height_px=image.height_px,
        georeference_gsd_m_per_px=image.georeference_gsd_m_per_px,
        tilt=None if view.tilt is None else view.tilt.record(image, gsd),
        frame=frame_scale(view.options.frame, image.width_px, gsd=gsd, interval=interval),
        scale=make_known_scale(view, gsd, interval=interval, confidence=decided.confidence),
        model=view.card.name,
        warnings=warnings,
        details=_details(view, vehicles, witnesses),
    )


def _details(
    view: View, vehicles: VehicleWitness | None, witnesses: Sequence[Witness]
) -> EstimateDetails:
    searched = view.detections
    told = view.detections.corrections
    scene = next((each for each in witnesses if each.kind == SceneScale.kind and each.found), None)
    paper, reference = (None, None) if vehicles is None else (vehicles.paper, vehicles.reference)
    return EstimateDetails(
        preset=view.options.method.preset,
        scene_scale=None
        if scene is None
        else SceneScaleEstimate(**_with_ci95(scene.gsd_m_per_px, scene.interval)),
        n_detections=None if vehicles is None else len(vehicles.fleet.detections.boxes),
        by_hand=told and VehiclesByHand(dropped=told.n_dropped, added=told.n_added),
        working_scale=None if vehicles is None else vehicles.fleet.main_reduction,
        tiles_searched=searched.n_tiles,
        tiles_total=searched.n_tiles_total or searched.n_tiles,
        candidates_skipped=searched.n_skipped,
        stopped_because=searched.stopped_because,
        aggregation=None if vehicles is None else vehicles.aggregation,
        reference_length_m=reference and reference.length_m,
        reference_source=reference and reference.source,
        resolution_guard=paper and paper.guarded,
        composite_confidence=paper and paper.confidence,
        confidence_terms=paper and ConfidenceTerms(**paper.terms._asdict()),
        model_sha256=view.card.sha256,
    )


def _ruler_scale(witness: Witness, p_right: float) -> RulerScale:
    ruler = ruler_class(witness.kind)
    return RulerScale(
        kind=witness.kind,
        label=ruler.label,
        sets_scale=ruler.sets_scale,
        **_with_ci95(witness.gsd_m_per_px, witness.interval),
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
    return KnownScale(
        gsd_m_per_px=gsd,
        gsd_ci95_low_m_per_px=min(interval[0], gsd),
        gsd_ci95_high_m_per_px=max(interval[1], gsd),
        confidence=confidence,
        image_id=view.image.image_id,
        model_id=view.card.sha256[:_MODEL_DIGITS],
        plane=view.tilt and KnownPlane.model_validate(view.tilt, from_attributes=True),
    )


def _with_ci95(
    gsd: float | None, interval: tuple[float, float] | None, factor: float = 1.0
) -> dict[str, Any]:
    """Fields of a scale and its interval, times a factor; all None without a scale."""
    low, high = interval or (None, None)
    values = {"gsd_m_per_px": gsd, "gsd_ci95_low_m_per_px": low, "gsd_ci95_high_m_per_px": high}
    return {name: value and value * factor for name, value in values.items()}


def notices_of(notes: Iterable[Remark]) -> tuple[Notice, ...]:
    """Convert the warnings of an image and of rulers to notices."""
    return tuple(Notice(code=note.code, message=note.message) for note in notes)


def georeference_notice(
    own: float | None, gsd_m_per_px: float | None, who_says: str
) -> list[Notice]:
    """Warn if the file's own scale differs from another by more than a tenth.

    Args:
        own: the file's scale, metres per pixel; None without one.
        gsd_m_per_px: the other scale; None without one.
        who_says: source of the other scale, as the middle of a sentence.

    Returns:
        One notice, or none.
    """
    if (
        own is None
        or gsd_m_per_px is None
        or abs(gsd_m_per_px - own) <= GEOREFERENCE_TOLERANCE * own
    ):
        return []
    return [
        Notice(
            code=NoticeCode.GEOREFERENCE_DIFFERS,
            message=f"The file's own scale is {own:.4g} m/px, {who_says} {gsd_m_per_px:.4g} m/px: "
            f"{100 * (gsd_m_per_px / own - 1):+.0f} %. Check which of the two is wrong before "
            "using either.",
        )
    ]


def frame_scale(
    frame: Frame, width_px: int, gsd: float | None, interval: tuple[float, float] | None
) -> FrameScale | None:
    """Compute the scale in the caller's copy of an image with this width; None without a copy."""
    if frame.size is None:
        return None
    return FrameScale(
        width_px=frame.size[0],
        height_px=frame.size[1],
        **_with_ci95(gsd, interval, width_px / frame.size[0]),
    )
