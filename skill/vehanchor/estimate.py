"""One photograph to its scale: the geometric perception skill.

    image -> raster -> search -> sighting -> rulers -> evidence -> conclude -> record

Stateless but for loaded models, and deterministic: the same image and model give the same record, whatever the number
of threads.
"""

from __future__ import annotations

import hashlib
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.analysis.scale import ScaleAnalysis
from vehanchor.detection.detections import Detections
from vehanchor.detection.scene_scale import load_scene_scale
from vehanchor.detection.search import search
from vehanchor.imagery.detail import resolved_share
from vehanchor.imagery.identity import image_id
from vehanchor.imagery.sources.opening import can_be_read_again, open_raster
from vehanchor.models.files import models_sha256, read_model
from vehanchor.models.zoo import bundled_courts, bundled_scene_scale
from vehanchor.records import FrameScale, GsdEstimate, KnownScale, Notice, RulerScale, SceneScaleEstimate
from vehanchor.records.notices import NoticeCode
from vehanchor.rulers.agreement import disagreements
from vehanchor.rulers.decision import convergence, decide
from vehanchor.rulers.evidence import ImageFacts, View
from vehanchor.rulers.reference import reference_length
from vehanchor.rulers.registry import OTHER_RULERS
from vehanchor.rulers.scene_scale import SceneScale
from vehanchor.rulers.vehicles import Vehicles
from vehanchor.tilt.camera_tilt import known_plane, metadata_tilt, rectified, tilt_record
from vehanchor.tilt.estimate import estimate_tilt, expected_scale, on_the_plane
from vehanchor.tilt.vehicle_cue import tilt_notice

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor.detection.card import DetectorCard
    from vehanchor.detection.convergence import Convergence
    from vehanchor.detection.detector import Detector
    from vehanchor.imagery.raster import Raster
    from vehanchor.imagery.sources.opening import ImageSource
    from vehanchor.options import Frame, ScaleOptions
    from vehanchor.rulers.evidence import Evidence
    from vehanchor.rulers.fused import RulerShare
    from vehanchor.rulers.vehicles import VehicleEvidence
    from vehanchor.tilt.camera_tilt import CameraTilt

_NOT_SEARCHED = Detections(np.zeros((0, 5)), np.zeros(0), 0, n_tiles_total=0)
_MODEL_DIGITS = 12
GEOREFERENCE_TOLERANCE = 0.10  # the file's own scale may differ by this from another before a warning


def check_region(detector: Detector, options: ScaleOptions) -> Detector:
    """The detector, after a check that it has a reference length for the options' region: before the work."""
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
    """Search an open image and measure its scale; the detector's runtime says how, and for which call."""
    options.frame.check(raster.width_px, raster.height_px)
    options = options.in_pixels(raster.width_px, raster.height_px)
    facts = image_facts(raster)
    aside = metadata_tilt(facts, options)  # a horizon in sight is refused before the work
    weighed = detector.card.votes or not options.rulers.uses(Vehicles.kind)  # else there is nothing to weigh it against
    looks = weighed and options.rulers.uses(SceneScale.kind)
    network = load_scene_scale(detector.runtime) if looks else None
    scene = None if network is None else network.look(raster)
    nothing_yet, resolved = replace(_NOT_SEARCHED, scene=scene), partial(resolved_share, raster)
    view = View(facts, nothing_yet, detector.card, options, resolved, raster, detector.runtime)
    if options.rulers.searches:
        detections = search(
            raster,
            detector,
            options.search,
            scene=scene,
            convergence=None if aside else partial(_convergence, view),  # lengths differ over a view that is not level
        )
        view = replace(view, detections=detections)
    return analyse_detections(view)


def _convergence(view: View, detections: Detections) -> Convergence:
    """Say whether what was found so far would do."""
    view = replace(view, detections=detections)
    return convergence(Vehicles().look(view), (SceneScale().look(view),))


def image_facts(raster: Raster) -> ImageFacts:
    """Facts of an open image, as records hold them."""
    return ImageFacts(
        raster.width_px,
        raster.height_px,
        raster.georeference_gsd_m_per_px,
        image_notices(raster),
        raster.camera,
        image_id(raster),
    )


def image_notices(raster: Raster) -> tuple[Notice, ...]:
    """What there was to tell when an image was read."""
    return tuple(Notice(code=note.code, message=note.message) for note in raster.warnings)


def analyse_detections(view: View, others: Sequence[Evidence] | None = None, *, level: bool = True) -> ScaleAnalysis:
    """As ``analyse_raster``, of an image that has been searched: one search can serve several options.

    Args:
        view: of the image.
        others: evidence of the rulers beside vehicles, where they have looked already; None has them look.
        level: measure vehicles on the plane of the ground where the camera looked aside; False where they were.

    Raises:
        InvalidParameterError: the model does not know the region.
        CalibrationMismatchError: the calibration was made for another model.
        TooObliqueError: the horizon is in sight, or nearly so.
    """
    rulers, aside = view.options.rulers, metadata_tilt(view.image, view.options)
    said = aside if level else None
    if said is not None:  # the network of the ground was never shown such a view
        view = replace(view, detections=replace(view.detections, scene=None))
    if others is None:
        others = tuple(ruler.look(view) for ruler in OTHER_RULERS if rulers.uses(ruler.kind))
    looked, seen = estimate_tilt(said, view, others) if level else None, view
    if looked is not None:
        others = on_the_plane(others, looked, view)
        seen = replace(view, detections=rectified(view.detections, looked, view.image))
    expected = None if looked is None and aside is None else expected_scale(others)
    used = rulers.uses(Vehicles.kind)
    vehicles = Vehicles(expected).look(seen if used else replace(view, detections=_NOT_SEARCHED))
    estimate = conclude(vehicles, others, view, looked, placed=level)
    in_image = view.detections if looked is not None and used else None
    return ScaleAnalysis(estimate, vehicles, tuple(others), in_image)


def conclude(
    vehicles: VehicleEvidence,
    others: Sequence[Evidence],
    view: View,
    looked: CameraTilt | None = None,
    *,
    placed: bool = True,
) -> GsdEstimate:
    """Conclude from the evidence to the caller's record.

    Args:
        vehicles: their evidence.
        others: that of the other rulers.
        view: of the image.
        looked: where the camera looked aside; None where it looked down, or nobody knows.
        placed: whether vehicles are where they were seen: those of many photographs put together are not.
    """
    image, decision = view.image, decide(vehicles, others)
    gsd, interval = decision.gsd_m_per_px, decision.interval
    warnings = [*image.notices, *vehicles.notices, *(notice for other in others for notice in other.notices)]
    warnings += tilt_notice(view) if placed and looked is None and vehicles.n else []
    warnings += disagreements((vehicles, *others), [ruler.kind for ruler in decision.rulers if not ruler.agrees])
    if gsd is not None:
        who_says = "the vehicles say" if gsd == vehicles.gsd_m_per_px else "the rulers say"
        warnings += georeference_notice(image.georeference_gsd_m_per_px, gsd, who_says)
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
        tilt=None if looked is None else tilt_record(looked, image, gsd),
        frame=frame_scale(view.options.frame, image.width_px, gsd, interval),
        scale=_known_scale(view, gsd, interval, decision.confidence, looked),
        model=view.card.name,
        model_sha256=view.card.sha256,
        warnings=tuple(warnings),
    )


def _ruler_scale(share: RulerShare) -> RulerScale:
    return RulerScale.model_validate(
        {
            "kind": share.kind,
            "gsd_m_per_px": share.gsd_m_per_px,
            "gsd_ci95_low_m_per_px": share.interval.low,
            "gsd_ci95_high_m_per_px": share.interval.high,
            "n": share.n,
            "weight": share.weight,
            "agrees": share.agrees,
            "explanation": share.explanation,
        }
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
    view: View, gsd: float | None, interval: tuple[float, float] | None, confidence: float, looked: CameraTilt | None
) -> KnownScale | None:
    """The scale as it can be given back; None where there is none, or where nobody looked at the image's pixels."""
    if gsd is None or interval is None or not view.image.image_id:
        return None
    return KnownScale(
        gsd_m_per_px=gsd,
        gsd_ci95_low_m_per_px=min(interval[0], gsd),
        gsd_ci95_high_m_per_px=max(interval[1], gsd),
        confidence=confidence,
        image_id=view.image.image_id,
        model_id=model_id(view.card),
        plane=None if looked is None else known_plane(looked.tilt_deg, looked.roll_deg, looked.focal_px),
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
