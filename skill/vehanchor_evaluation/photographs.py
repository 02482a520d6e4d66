"""Photographs of known scale from rulers other than vehicles, for example the camera's height."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

from vehanchor.analysis.pipeline import analyse_raster
from vehanchor.errors import InvalidParameterError, VehAnchorError
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.rulers.active import allowed_rulers
from vehanchor.rulers.known_length_table import with_lines_of
from vehanchor.scale.lengths import Z95
from vehanchor_evaluation.known_scale import (
    DATASET_READING,
    FileIssue,
    KnownScaleImage,
    KnownScaleSet,
    files_of,
    labels_beside,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from vehanchor.detection.detector import Detector
    from vehanchor.options import ScaleOptions
    from vehanchor.records import GsdEstimate
    from vehanchor.rulers.known_length_table import KnownLengthTable


def survey_photographs(
    paths: Sequence[Path],
    detector: Detector,
    options: ScaleOptions,
    known_lengths: Callable[[Sequence[Path]], KnownLengthTable] | None = None,
) -> KnownScaleSet:
    """Measure the scale of photographs with all rulers except vehicles and the scene-scale prior.

    Args:
        paths: files, and folders to search for images.
        detector: named in the records; it does not run.
        options: options of the estimate; they can exclude rulers.
        known_lengths: reads the lines of known length for these files; None for none.

    Returns:
        The photographs with a scale and its uncertainty. The issues list the others, including
        tilted photographs.

    Raises:
        InvalidParameterError: a path does not exist, or the options exclude all these rulers.
    """
    options = _without_vehicles(options)
    images = []
    issues = []
    files = files_of(paths)
    lines = known_lengths(files) if known_lengths else {}
    for file in files:
        try:
            options_of_file = with_lines_of(options, lines, file)
            with open_raster(file, options.reading) as raster:
                analysis = analyse_raster(detector, raster, options_of_file)
        except VehAnchorError as error:
            issues.append(FileIssue(file, error.code, str(error)))
            continue
        image = _known_scale(file, analysis.estimate)
        if isinstance(image, FileIssue):
            issues.append(image)
        else:
            images.append(image)
    source = f"{len(paths)} photographs"
    if len(paths) == 1:
        source = str(paths[0])
    return KnownScaleSet(source, tuple(images), tuple(issues))


def _without_vehicles(options: ScaleOptions) -> ScaleOptions:
    """Allow only rulers that can measure a fleet: neither vehicles nor the scene-scale prior."""
    rulers = tuple(
        ruler.kind
        for ruler in allowed_rulers(options.rulers)
        if ruler.sets_scale and ruler.pooling_gain is not None
    )
    if not rulers:
        raise InvalidParameterError(
            "photographs need a ruler other than vehicles: drop --rulers and --metadata"
        )
    ruler_options = replace(options.rulers, rulers=rulers)
    reading = replace(options.reading, limits=DATASET_READING.limits)
    return replace(options, rulers=ruler_options, reading=reading)


def _known_scale(file: Path, record: GsdEstimate) -> KnownScaleImage | FileIssue:
    """Take over the scale of a photograph, or state why it cannot be used."""
    gsd = record.gsd_m_per_px
    low = record.gsd_ci95_low_m_per_px
    high = record.gsd_ci95_high_m_per_px
    if gsd is None or low is None or high is None:
        message = " ".join(notice.message for notice in record.warnings)
        message = message or "no ruler other than vehicles gives a scale"
        return FileIssue(file, "no_other_ruler", message)
    # In a tilted photograph, near vehicles have more pixels than far ones of the same length.
    if record.tilt is not None:
        tilt = f"{record.tilt.tilt_deg:.0f} degrees"
        message = f"the camera is tilted by {tilt}: vehicles have different scales"
        return FileIssue(file, "camera_tilted", message)
    # The interval is lognormal, and 95 % reach Z95 standard deviations to both sides.
    log_sd = math.log(high / low) / (2 * Z95)
    return KnownScaleImage(file, gsd, labels=labels_beside(file), gsd_log_sd=log_sd)
