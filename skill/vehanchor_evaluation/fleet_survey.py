"""Fleet calibration: the reference length of a region from vehicles in images of known scale."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from vehanchor.detection.card import REFERENCE_LENGTH_SD_M
from vehanchor.scale.calibration import SurveyedImage, calibrate
from vehanchor_evaluation.dota import SMALL_VEHICLE, labelled_boxes
from vehanchor_evaluation.known_scale import FileIssue, naming

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from vehanchor.detection.card import DetectorCard
    from vehanchor.options import ScaleOptions
    from vehanchor.scale.calibration import Calibration
    from vehanchor_evaluation.known_scale import KnownScaleSet
    from vehanchor_evaluation.search import SearchedImage


class FleetSurvey(NamedTuple):
    """Vehicles of known scale, and issues of files that could not be used."""

    images: list[SurveyedImage]
    issues: list[FileIssue]


def labelled_vehicles(
    data: KnownScaleSet, classes: Sequence[str] = (SMALL_VEHICLE,)
) -> FleetSurvey:
    """Collect the labelled vehicles.

    Args:
        data: images of known scale.
        classes: label classes that count as vehicles.
    """
    survey = FleetSurvey([], list(data.issues))
    for image in data.images:
        if image.labels is None:
            issue = FileIssue(image.path, "no_label", "no label file found")
            survey.issues.append(issue)
            continue
        try:
            boxes = labelled_boxes(image.labels, classes)
        except (OSError, ValueError) as error:
            issue = FileIssue(image.labels, "unreadable_labels", str(error))
            survey.issues.append(issue)
            continue
        surveyed = SurveyedImage(boxes, image.gsd_m_per_px, gsd_log_sd=image.gsd_log_sd)
        survey.images.append(surveyed)
    return survey


def found_vehicles(
    data: KnownScaleSet,
    searched: Mapping[Path, SearchedImage | FileIssue],
    card: DetectorCard,
    options: ScaleOptions,
) -> FleetSurvey:
    """Collect the vehicles that a model detects, without the outliers that an estimate drops.

    Args:
        data: images of known scale.
        searched: results of ``search_images`` by image.
        card: model card of the detector.
        options: options of the estimate.
    """
    survey = FleetSurvey([], list(data.issues))
    # A calibration weights the vehicles as the later estimates do.
    aggregation = options.lengths.aggregation or card.aggregation
    is_weighted = aggregation == "weighted_kde"
    for image in data.images:
        result = searched[image.path]
        if isinstance(result, FileIssue):
            survey.issues.append(result)
            continue
        with naming(image.path):
            analysis = result.analysis(card, options)
        boxes = analysis.detections.boxes[analysis.kept]
        scores = None
        if is_weighted:
            scores = analysis.detections.scores[analysis.kept]
        surveyed = SurveyedImage(
            boxes,
            image.gsd_m_per_px,
            scores=scores,
            gsd_log_sd=image.gsd_log_sd,
        )
        survey.images.append(surveyed)
    return survey


def calibrate_labelled(survey: FleetSurvey, card: DetectorCard | None = None) -> Calibration:
    """Measure the mode of labelled lengths, as in the paper.

    Args:
        survey: labelled vehicles.
        card: model card of the only detector that may use the calibration; None for any whose boxes
            match the labels.

    Raises:
        CalibrationRefusedError: there are too few vehicles, or the imagery is too coarse.
    """
    if card is None:
        return calibrate(survey.images, source="labels", region_sd_m=REFERENCE_LENGTH_SD_M)
    return calibrate(
        survey.images,
        source="labels",
        region_sd_m=card.reference_length_sd_m,
        detector=card.name,
        detector_sha256=card.sha256,
    )


def calibrate_found(survey: FleetSurvey, card: DetectorCard) -> Calibration:
    """Measure the mode of detected lengths.

    The result includes the detector's bias, so it is for this detector only.

    Raises:
        CalibrationRefusedError: there are too few vehicles, or the imagery is too coarse.
    """
    return calibrate(
        survey.images,
        source="detections",
        region_sd_m=card.reference_length_sd_m,
        min_length_px=card.min_length_px,
        detector=card.name,
        detector_sha256=card.sha256,
    )
