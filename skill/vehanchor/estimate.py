"""One photograph to its scale: the geometric perception skill.

    image -> raster -> prior -> search -> tilt -> rulers -> decision -> record

Stateless but for loaded models, and deterministic: the same image and model give the same record for any number of
threads.
"""

from __future__ import annotations

import hashlib
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, overload

from vehanchor.analysis.scale import ScaleAnalysis
from vehanchor.detection.detections import NOT_SEARCHED, Detections
from vehanchor.detection.detector import Detector, load_detector
from vehanchor.detection.scene_scale import load_scene_scale
from vehanchor.detection.search import search
from vehanchor.imagery.detail import resolved_share
from vehanchor.imagery.facts import image_facts
from vehanchor.imagery.sources.opening import can_be_read_again, open_raster
from vehanchor.models.files import models_sha256, read_model
from vehanchor.models.session import named_providers
from vehanchor.models.zoo import bundled_courts, bundled_scene_scale, resolve_model
from vehanchor.options import ScaleOptions
from vehanchor.records import FrameScale, GsdEstimate, KnownScale, Notice, RulerScale, SceneScaleEstimate
from vehanchor.records.notices import NoticeCode
from vehanchor.rulers.agreement import disagreements
from vehanchor.rulers.decision import convergence, decide
from vehanchor.rulers.evidence import View
from vehanchor.rulers.measurement import measure_all, with_tilt
from vehanchor.rulers.reference import reference_length
from vehanchor.rulers.registry import active_rulers, check_rulers, ruler_class, uses
from vehanchor.rulers.scene_scale import SceneScale
from vehanchor.rulers.vehicles import Vehicles
from vehanchor.tilt.camera_tilt import metadata_tilt
from vehanchor.tilt.estimate import tilt_notice

if TYPE_CHECKING:
    import os
    from collections.abc import Callable, Sequence
    from pathlib import Path
    from typing import Unpack

    import onnxruntime

    from vehanchor.detection.card import DetectorCard
    from vehanchor.detection.convergence import Convergence
    from vehanchor.imagery.raster import Raster
    from vehanchor.imagery.sources.opening import ImageSource
    from vehanchor.options import Frame, OptionKeywords
    from vehanchor.rulers.decision import RulerShare, ScaleDecision
    from vehanchor.rulers.evidence import Evidence
    from vehanchor.rulers.vehicles import VehicleEvidence

_MODEL_DIGITS = 12
GEOREFERENCE_TOLERANCE = 0.10  # the file's own scale may differ by this from another before a warning


@overload
def estimate_gsd(
    image: ImageSource,
    *,
    detector: Detector | str | os.PathLike[str] | None = None,
    threads: int | None = None,
    providers: Sequence[str] | None = None,
    progress: Callable[[int, int], None] | None = None,
    **options: Unpack[OptionKeywords],
) -> GsdEstimate: ...


@overload
def estimate_gsd(
    image: list[str] | list[Path] | list[ImageSource] | tuple[ImageSource, ...],
    *,
    detector: Detector | str | os.PathLike[str] | None = None,
    threads: int | None = None,
    providers: Sequence[str] | None = None,
    progress: Callable[[int, int], None] | None = None,
    **options: Unpack[OptionKeywords],
) -> list[GsdEstimate]: ...


def estimate_gsd(
    image: Any,
    *,
    detector: Detector | str | os.PathLike[str] | None = None,
    threads: int | None = None,
    providers: Sequence[str] | None = None,
    progress: Callable[[int, int], None] | None = None,
    **options: Unpack[OptionKeywords],
) -> GsdEstimate | list[GsdEstimate]:
    """Estimate the ground sampling distance of an aerial image from the cars in it, and from what other rulers say.

    Args:
        image: path, encoded bytes, binary file object, Pillow image, rasterio dataset, or array (H x W x 3 RGB or
            H x W; uint8, uint16 or float). A list of them gives a list; ``vehanchor.find_images`` makes one of folders
            and patterns, ``vehanchor batch`` goes on where one of thousands cannot be read.
        detector: a bundled model's name, the path of an ONNX oriented-box model, or a loaded ``Detector``; default the
            bundled one.
        threads: CPU threads for the model; None leaves it to ONNX Runtime. Ignored for a loaded ``Detector``.
        providers: where models run, in order of preference, as ``["cuda", "cpu"]``: with ``cpu`` among them one that
            is missing gives way, and the log says so. None for the CPU. Ignored for a loaded ``Detector``.
        progress: called with (tiles done, tiles in all).
        **options: the fields of ``vehanchor.options``' groups: ``min_score``, ``nms_iou``, ``search_scales``,
            ``tile_px``, ``stride_px``, ``effort``, ``max_tiles``, ``max_seconds`` (``Search``), ``aggregation``,
            ``alpha`` (``Lengths``), ``reference_length_m``, ``region``, ``calibration`` (``Reference``),
            ``frame_width_px``, ``frame_height_px``, ``coordinates`` (``Frame``), ``bands``, ``limits``, ``bgr``,
            ``max_megapixels`` (``Reading``), ``rulers``, ``metadata``, ``known_lengths``, ``height_m``,
            ``focal_35mm`` (``Rulers``).

    Returns:
        The record, or a list of records; ``gsd_m_per_px`` is None, never a guess, where no ruler finds anything.

    Raises:
        ImageError: the image cannot be used; see ``vehanchor.errors`` for its kinds.
        ModelError: the detector cannot be used.
        InvalidParameterError: an option has no meaning.
        FrameError: the frame has another aspect ratio than the image.
        CalibrationError: the calibration cannot be read, or was made for another detector.
    """
    chosen = ScaleOptions.of(options)
    model = open_detector(detector, chosen, threads=threads, providers=providers)
    if isinstance(image, list | tuple):
        return [analyse_scale(each, chosen, detector=model, progress=progress).estimate for each in image]
    return analyse_scale(image, chosen, detector=model, progress=progress).estimate


def analyse_scale(
    image: ImageSource,
    options: ScaleOptions | None = None,
    *,
    detector: Detector | str | os.PathLike[str] | None = None,
    threads: int | None = None,
    providers: Sequence[str] | None = None,
    progress: Callable[[int, int], None] | None = None,
    run_options: onnxruntime.RunOptions | None = None,
) -> ScaleAnalysis:
    """As ``estimate_gsd``, with the detections behind the number.

    Args:
        image: as in ``estimate_gsd``.
        options: every choice of the method; None for the defaults.
        detector: as in ``estimate_gsd``.
        threads: as in ``estimate_gsd``.
        providers: as in ``estimate_gsd``.
        progress: as in ``estimate_gsd``.
        run_options: ONNX Runtime's, for a caller that may have to end a running model (``terminate``).

    Returns:
        The record, the detections and which of them were kept.

    Raises:
        VehAnchorError: as ``estimate_gsd``.
    """
    chosen = options or ScaleOptions()
    model = open_detector(detector, chosen, threads=threads, providers=providers)
    with open_raster(image, bands=chosen.reading.bands, limits=chosen.reading.limits, bgr=chosen.reading.bgr) as raster:
        analysis = analyse_raster(raster, model, chosen, progress=progress, run_options=run_options)
    seen = image if can_be_read_again(image) else None
    return replace(analysis, image=seen, reading=chosen.reading, ground=raster.ground)


def open_detector(
    detector: Detector | str | os.PathLike[str] | None,
    options: ScaleOptions,
    *,
    threads: int | None = None,
    providers: Sequence[str] | None = None,
) -> Detector:
    """Open a detector; check before the work that it knows the region and that the rulers exist."""
    check_rulers(options.rulers)
    if not isinstance(detector, Detector):
        path = resolve_model(None if detector is None else str(detector))
        detector = load_detector(path, threads=threads, providers=named_providers(providers))
    reference_length(detector.card, options.reference, None)
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
    view = search_raster(raster, detector, options, progress=progress, run_options=run_options)
    return analyse_detections(view)


def search_raster(
    raster: Raster,
    detector: Detector,
    options: ScaleOptions,
    *,
    progress: Callable[[int, int], None] | None = None,
    run_options: onnxruntime.RunOptions | None = None,
) -> View:
    """Take the scene-scale prior of an open image, and search it: the first half of ``analyse_raster``."""
    options.frame.check(raster.width_px, raster.height_px)
    options = options.in_pixels(raster.width_px, raster.height_px)
    rulers = active_rulers(options.rulers)
    facts = image_facts(raster)
    tilt = metadata_tilt(facts, options)  # an image with the horizon in sight is refused before the work
    kinds = {ruler.kind for ruler in rulers}
    weighed = detector.card.votes or Vehicles.kind not in kinds  # else the prior has nothing to weigh
    wanted = weighed and SceneScale.kind in kinds
    network = load_scene_scale(threads=detector.threads, providers=detector.providers) if wanted else None
    prior = None if network is None else network.look(raster, run_options=run_options)
    view = View(
        facts,
        NOT_SEARCHED,
        detector.card,
        options,
        partial(resolved_share, raster),
        raster,
        detector.providers,
        run_options,
        prior,
        tilt,
    )
    if not any(ruler.needs_search for ruler in rulers):
        return view
    detections = search(
        raster,
        detector,
        options.search,
        scene=prior,
        convergence=None if tilt else partial(_convergence, view),  # in a tilted view lengths differ with the place
        progress=progress,
        run_options=run_options,
    )
    return replace(view, detections=detections)


def _convergence(view: View, detections: Detections) -> Convergence:
    """Convergence of the search so far."""
    view = replace(view, detections=detections)
    priors = [ruler.measure(view) for ruler in active_rulers(view.options.rulers) if not ruler.sets_scale]
    return convergence(Vehicles().measure(view), priors)


def analyse_detections(view: View) -> ScaleAnalysis:
    """As ``analyse_raster``, of an image that has been searched: one search can serve several options.

    Args:
        view: of the image.

    Raises:
        InvalidParameterError: the model does not know the region, or there is no such ruler.
        CalibrationMismatchError: the calibration was made for another model.
        TooObliqueError: the horizon is in sight, or nearly so.
    """
    return analyse_view(with_tilt(view))


def analyse_view(view: View, known: Sequence[Evidence] = ()) -> ScaleAnalysis:
    """As ``analyse_detections``, of a view whose tilt has been estimated.

    Args:
        view: of the image.
        known: evidence that is not measured again.
    """
    vehicles, others = measure_all(view, known)
    notices = tilt_notice(view.image, view.options, view.detections) if view.tilt is None and vehicles.n else ()
    return conclude(view, vehicles, others, notices)


def conclude(
    view: View, vehicles: VehicleEvidence, others: tuple[Evidence, ...], notices: Sequence[Notice] = ()
) -> ScaleAnalysis:
    """Decide on the scale, and write the record.

    Args:
        view: of the image.
        vehicles: their evidence.
        others: evidence of the other rulers.
        notices: of the tilt.
    """
    decision = decide(vehicles, others)
    outvoted = [ruler.kind for ruler in decision.rulers if not ruler.agrees]
    warnings = [*view.image.notices, *vehicles.notices, *(notice for other in others for notice in other.notices)]
    warnings += [*notices, *disagreements((vehicles, *others), outvoted)]
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
        tiles_searched=view.detections.n_tiles,
        tiles_total=view.detections.n_tiles_total or view.detections.n_tiles,
        stopped_because=view.detections.stopped_because,
        aggregation=vehicles.aggregation,
        reference_length_m=vehicles.reference.length_m,
        reference_source=vehicles.reference.source,
        resolution_guard=vehicles.guarded,
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
    """First digits of a detector's checksum."""
    return card.sha256[:_MODEL_DIGITS]


def networks_sha256(card: DetectorCard) -> str:
    """SHA-256 of all networks behind a record: the detector, those beside it, the ground's and the courts'.

    What was found with some of them replaced is not the same any more.
    """
    digest = hashlib.sha256()
    for checksum in (card.sha256, card.fleet_sha256, card.verifier_sha256):
        digest.update(f"{checksum}\n".encode())
    for path in (bundled_scene_scale(), bundled_courts()):
        digest.update(models_sha256(read_model(path)).encode() if path else b"\n")
    return digest.hexdigest()


def _known_scale(
    view: View, gsd: float | None, interval: tuple[float, float] | None, confidence: float
) -> KnownScale | None:
    """The scale as it can be given back; None without one, or if the image has no checksum."""
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


def georeference_notice(own: float | None, gsd_m_per_px: float, who_says: str) -> list[Notice]:
    """Warn where the scale that the file carries differs from another by more than a tenth.

    Args:
        own: the file's scale, metres per pixel; None where it has none.
        gsd_m_per_px: the other scale.
        who_says: whose it is, as the middle of a sentence.

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
    """The scale in the caller's copy of an image, of so many columns; None where there is no copy."""
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
