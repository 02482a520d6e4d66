"""Command ``vehanchor calibrate``: fleet calibration, the reference length of a region."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vehanchor.cli.terminal import print_facts
from vehanchor.errors import InvalidParameterError
from vehanchor.scale.defaults import SHORT_SHA
from vehanchor.storage.atomic import check_output_path, write_record
from vehanchor_evaluation.commands.request import measuring_command
from vehanchor_evaluation.commands.sources import (
    FilesCommand,
    KnownScaleRequest,
    open_shared,
    print_issues,
)

if TYPE_CHECKING:
    from vehanchor.cli.cli_options import ParsedOptions
    from vehanchor.scale.calibration import Calibration
    from vehanchor_evaluation.fleet_survey import FleetSurvey
    from vehanchor_evaluation.known_scale import KnownScaleSet


calibrate = typer.Typer(pretty_exceptions_enable=False, add_completion=False)


class _Boxes(StrEnum):
    labels = "labels"
    detector = "detector"


@dataclass(frozen=True, kw_only=True)
class CalibrateRequest(KnownScaleRequest):
    """Options of the command, one per field."""

    out: Annotated[
        Path,
        typer.Option(
            metavar="FILE.json", help="Calibration to write, for --calibration.", show_default=False
        ),
    ]
    photographs: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILES",
            help="Photographs, or folders of them, with a scale from another ruler: the height "
            "in their metadata, courts, --known-lengths, or --height. Its uncertainty is included.",
            show_default=False,
        ),
    ] = None
    boxes: Annotated[
        _Boxes | None,
        typer.Option(
            "--from",
            help="Source of the boxes. Default: labels with --dota, else detector.",
            show_default=False,
        ),
    ] = None
    plot: Annotated[
        str | None,
        typer.Option(metavar="OUT.png", help="Write a plot of lengths and mode (extra 'plots')."),
    ] = None


@calibrate.command("calibrate", cls=FilesCommand)
@measuring_command(CalibrateRequest, without=("reference_length_m", "region", "calibration"))
def calibrate_fleet(request: CalibrateRequest, parsed: ParsedOptions) -> None:
    """Measure the reference length of a region's fleet on images of known scale.

    With labels, this is the paper's method: the mode of length times scale over all labelled
    vehicles. With --detector the result is for that model only. Without labels, the model detects
    the vehicles, and the result is for that model only, because it includes the model's bias.
    Photographs with a height need no georeference. Fewer than 100 vehicles or too coarse imagery
    are refused.
    """
    _check_outputs(request.out, request.plot)
    boxes = request.boxes
    if boxes is None:
        boxes = _Boxes.detector if request.dota is None else _Boxes.labels
    if boxes is _Boxes.labels:
        survey, calibration = _from_labels(request, parsed)
    else:
        survey, calibration = _from_detections(request, parsed)
    write_record(request.out, calibration, indent=2)
    print_facts(str(request.out), _facts(calibration))
    if request.plot is not None:
        from vehanchor.pictures.plot import write_plot
        from vehanchor_evaluation.figures import plot_reference_length

        write_plot(request.plot, plot_reference_length(survey.images, calibration))


def _check_outputs(out: Path, plot: str | None) -> None:
    """Check folders, suffixes and matplotlib before the search."""
    check_output_path(out)
    if plot is None:
        return
    from vehanchor.pictures.plot import require_plots
    from vehanchor.pictures.scale import check_picture_path

    require_plots()
    if check_picture_path(plot).resolve() == out.resolve():
        raise InvalidParameterError(
            f"{plot!r} names both the plot and the calibration: choose another name"
        )


def _known_scale(request: CalibrateRequest, parsed: ParsedOptions) -> KnownScaleSet:
    """Find the images of known scale: by georeference, table, or another ruler."""
    if not request.photographs:
        if request.known_lengths is not None:
            raise InvalidParameterError("--known-lengths needs --photographs")
        return request.survey()
    if request.dota or request.table or request.geotiff:
        raise InvalidParameterError(
            "give the images with one of --photographs, --dota, --table and --geotiff"
        )
    from vehanchor_evaluation.photographs import survey_photographs

    detector = open_shared(parsed, request.workers).detector
    data = survey_photographs(
        request.photographs, detector, options=parsed.options(), known_lengths=request.lines
    )
    data = data.select(limit=request.limit)
    if not data.images:
        print_issues(data.issues)
        raise InvalidParameterError(
            f"no photograph in {data.source!r} has a ruler other than vehicles"
        )
    return data


def _from_labels(
    request: CalibrateRequest, parsed: ParsedOptions
) -> tuple[FleetSurvey, Calibration]:
    from vehanchor_evaluation.dota import SMALL_VEHICLE
    from vehanchor_evaluation.fleet_survey import calibrate_labelled, labelled_vehicles

    data = _known_scale(request, parsed)
    survey = labelled_vehicles(data, request.label_classes or (SMALL_VEHICLE,))
    print_issues(survey.issues)
    card = None
    if parsed.detector is not None:
        card = parsed.engine().detector.card
    return survey, calibrate_labelled(survey, card)


def _from_detections(
    request: CalibrateRequest, parsed: ParsedOptions
) -> tuple[FleetSurvey, Calibration]:
    from vehanchor_evaluation.fleet_survey import calibrate_found, found_vehicles

    options = parsed.options()
    data = _known_scale(request, parsed)
    detector = open_shared(parsed, request.workers).detector
    searched = request.search(data, detector, options, cache=request.cache)
    survey = found_vehicles(data, searched, card=detector.card, options=options)
    print_issues(survey.issues)
    return survey, calibrate_found(survey, detector.card)


def _facts(calibration: Calibration) -> list[tuple[str, str]]:
    length = f"{calibration.reference_length_m:.4g} m"
    low = f"{calibration.reference_length_ci95_low_m:.4g}"
    high = f"{calibration.reference_length_ci95_high_m:.4g}"
    origin = "labelled" if calibration.source == "labels" else "found"
    mode = f"{calibration.mode_length_px:.1f} px"
    gsd = f"{calibration.median_gsd_m_per_px:.3g} m/px"
    detector = "any whose boxes match these labels"
    if calibration.detector is not None:
        sha = (calibration.detector_sha256 or "")[:SHORT_SHA]
        detector = f"{calibration.detector} ({sha})"
    return [
        ("reference length", f"{length}   (95 %: {low} to {high})"),
        ("vehicles", f"{calibration.n_vehicles} {origin}"),
        ("images", str(calibration.n_images)),
        ("modal length", f"{mode}, at a median of {gsd}"),
        ("for detector", detector),
    ]
