"""``vehanchor calibrate``, for the command line to mount."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vehanchor.cli.options import (
    ClassOption,
    DetectorOption,
    MinScoreOption,
    open_detector,
)
from vehanchor.cli.terminal import facts_table, print_table, told_errors
from vehanchor.errors import InvalidParameterError, OutputError
from vehanchor_evaluation.commands.sources import (
    CacheOption,
    DotaOption,
    GeotiffOption,
    LabelClassOption,
    LabelsOption,
    LimitOption,
    SetOption,
    SplitOption,
    TableOption,
    WorkersOption,
    search,
    survey,
    tell_issues,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor.detection.detector import DetectorCard
    from vehanchor.scale.calibration import Calibration, SurveyedImage
    from vehanchor_evaluation.known_scale import KnownScaleSet

__all__ = ["calibrate"]

_SHORT_SHA = 12


class _Boxes(StrEnum):
    labels = "labels"
    detector = "detector"


def calibrate(
    out: Annotated[
        Path, typer.Option(metavar="FILE.json", help="The calibration, for --calibration.", show_default=False)
    ],
    dota: DotaOption = None,
    table: TableOption = None,
    geotiff: GeotiffOption = None,
    boxes: Annotated[
        _Boxes | None,
        typer.Option(
            "--from",
            help="Whose boxes are measured. Default: the labels' with --dota, else the detector's.",
            show_default=False,
        ),
    ] = None,
    labels: LabelsOption = None,
    label_classes: LabelClassOption = None,
    set_name: SetOption = None,
    split: SplitOption = None,
    limit: LimitOption = None,
    detector: DetectorOption = None,
    classes: ClassOption = None,
    min_score: MinScoreOption = None,
    plot: Annotated[
        str | None, typer.Option(metavar="OUT.png", help="Write the plot of lengths and mode (extra 'plots').")
    ] = None,
    workers: WorkersOption = None,
    cache: CacheOption = None,
) -> None:
    """Measure the reference length of a region's fleet, on images of known scale.

    From labels it is exactly the paper's: the mode of length times scale over every labelled vehicle; with --detector
    it is for that model only. Without labels the model is run over the images, and the mode is of what it finds: for
    it alone, its way to draw boxes included. Fewer than 100 vehicles are refused, and so is imagery too coarse.
    """
    with told_errors():
        from vehanchor.scale.calibration import calibrate as measure
        from vehanchor.scale.calibration import save_calibration

        _check_outputs(out, plot)
        source = boxes or (_Boxes.detector if dota is None else _Boxes.labels)
        data = survey(dota, table, geotiff, labels=labels, set_name=set_name, split=split, limit=limit)
        card: DetectorCard | None
        if source is _Boxes.labels:
            images = _labelled(data, label_classes)
            card = _card(detector, classes) if detector is not None else None
        else:
            images, card = _found(data, detector, classes, min_score, workers, cache)
        calibration = measure(
            images,
            source="labels" if source is _Boxes.labels else "detections",
            region_sd_m=_region_sd(card),
            min_length_px=card.min_length_px if card is not None and source is _Boxes.detector else 0.0,
            detector=card.name if card is not None else None,
            detector_sha256=card.sha256 if card is not None else None,
        )
        save_calibration(out, calibration)
        print_table(facts_table(str(out), _facts(calibration)))
        if plot is not None:
            from vehanchor.pictures.plot import write_plot
            from vehanchor_evaluation.figures import plot_reference_length

            write_plot(plot, plot_reference_length(images, calibration))


def _check_outputs(out: Path, plot: str | None) -> None:
    """Before the work: folders, suffixes, matplotlib."""
    if not out.parent.is_dir() or out.is_dir():
        raise OutputError(f"cannot write {str(out)!r}: name a file in a folder that exists")
    if plot is not None:
        from vehanchor.pictures.plot import require_plots
        from vehanchor.pictures.scale import check_picture_path

        require_plots()
        if check_picture_path(plot).resolve() == out.resolve():
            raise InvalidParameterError(f"{plot!r} would be both the plot and the calibration: choose another name")


def _labelled(data: KnownScaleSet, classes: Sequence[str] | None) -> list[SurveyedImage]:
    from vehanchor.scale.calibration import SurveyedImage
    from vehanchor_evaluation.dota import SMALL_VEHICLE, labelled_boxes
    from vehanchor_evaluation.known_scale import FileIssue

    images, issues = [], list(data.issues)
    for image in data.images:
        if image.labels is None:
            issues.append(FileIssue(image.path, "no_label", "no labels beside it"))
            continue
        try:
            boxes = labelled_boxes(image.labels, classes or (SMALL_VEHICLE,))
        except (OSError, ValueError) as error:
            issues.append(FileIssue(image.labels, "unreadable_labels", str(error)))
            continue
        images.append(SurveyedImage(boxes, image.gsd_m_per_px))
    tell_issues(issues)
    return images


def _found(
    data: KnownScaleSet,
    model: str | None,
    classes: Sequence[str] | None,
    min_score: float | None,
    workers: int | None,
    cache: Path | None,
) -> tuple[list[SurveyedImage], DetectorCard]:
    """What the detector finds, less the outliers that an estimate drops."""
    from vehanchor.estimate import ScaleOptions
    from vehanchor.scale.calibration import SurveyedImage
    from vehanchor_evaluation.known_scale import FileIssue

    options = ScaleOptions(min_score=min_score)
    detector, found = search(data, model, classes, [options], workers=workers, cache=cache)
    images, issues = [], list(data.issues)
    for image in data.images:
        searched = found[image.path]
        if isinstance(searched, FileIssue):
            issues.append(searched)
            continue
        analysis = searched.analysis(detector.card, options)
        boxes, scores = analysis.detections.boxes[analysis.kept], analysis.detections.scores[analysis.kept]
        weighted = detector.card.aggregation == "weighted_kde"
        images.append(SurveyedImage(boxes, image.gsd_m_per_px, scores if weighted else None))
    tell_issues(issues)
    return images, detector.card


def _card(model: str | None, classes: Sequence[str] | None) -> DetectorCard:
    return open_detector(model, classes).card


def _region_sd(card: DetectorCard | None) -> float:
    from vehanchor.detection.detector import REFERENCE_LENGTH_SD_M

    return REFERENCE_LENGTH_SD_M if card is None else card.reference_length_sd_m


def _facts(record: Calibration) -> list[tuple[str, str]]:
    low, high = record.reference_length_ci95_low_m, record.reference_length_ci95_high_m
    sha = (record.detector_sha256 or "")[:_SHORT_SHA]
    return [
        ("reference length", f"{record.reference_length_m:.4g} m   (95 %: {low:.4g} to {high:.4g})"),
        ("vehicles", f"{record.n_vehicles} {'labelled' if record.source == 'labels' else 'found'}"),
        ("images", str(record.n_images)),
        ("modal length", f"{record.mode_length_px:.1f} px, at {record.median_gsd_m_per_px:.3g} m/px in the median"),
        (
            "for detector",
            "any that draws its boxes as these labels are" if record.detector is None else f"{record.detector} ({sha})",
        ),
    ]
