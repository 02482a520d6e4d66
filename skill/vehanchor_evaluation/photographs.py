"""Photographs whose scale another ruler than vehicles tells: the camera's height, or what else there is."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

from vehanchor.batch.known_lengths import with_lines_of
from vehanchor.errors import InvalidParameterError, VehAnchorError
from vehanchor.estimate import analyse_raster
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.rulers.registry import active_rulers
from vehanchor.scale.lengths import Z95
from vehanchor_evaluation.known_scale import (
    DATASET_LIMITS,
    FileIssue,
    KnownScaleImage,
    KnownScaleSet,
    files_of,
    labels_beside,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from vehanchor.batch.known_lengths import KnownLengthTable
    from vehanchor.detection.detector import Detector
    from vehanchor.options import ScaleOptions


def survey_photographs(
    paths: Sequence[Path],
    detector: Detector,
    options: ScaleOptions,
    known_lengths: Callable[[Sequence[Path]], KnownLengthTable] | None = None,
) -> KnownScaleSet:
    """Take the scale of photographs from all rulers but vehicles and the look of the ground.

    Args:
        paths: files, and folders to search for images.
        detector: named in the records; it does not run.
        options: every choice of the method; rulers that they leave out are not heard.
        known_lengths: reads the lines of known length of single photographs, given what they are; None for none.

    Returns:
        The photographs of which one knows the scale, with what it may be off by; as issues the others, and those whose
        camera looked aside.

    Raises:
        InvalidParameterError: a path does not exist, or the options leave no such ruler.
    """
    rulers = tuple(
        each.kind for each in active_rulers(options.rulers) if each.sets_scale and each.independent_of_vehicles
    )
    if not rulers:
        raise InvalidParameterError("photographs need another ruler than vehicles: leave --rulers and --metadata alone")
    apart = replace(
        options,
        rulers=replace(options.rulers, rulers=rulers),
        reading=replace(options.reading, limits=DATASET_LIMITS),
    )
    images, issues = [], []
    files = files_of(paths)
    lines = known_lengths(files) if known_lengths else {}
    for file in files:
        try:
            with open_raster(file, bands=apart.reading.bands, limits=DATASET_LIMITS) as raster:
                record = analyse_raster(raster, detector, with_lines_of(apart, lines, file)).estimate
        except VehAnchorError as error:
            issues.append(FileIssue(file, error.code, str(error)))
            continue
        gsd, low, high = record.gsd_m_per_px, record.gsd_ci95_low_m_per_px, record.gsd_ci95_high_m_per_px
        if gsd is None or low is None or high is None:
            why = " ".join(notice.message for notice in record.warnings) or "no ruler but vehicles finds anything in it"
            issues.append(FileIssue(file, "no_other_ruler", why))
            continue
        if record.tilt is not None:
            why = (
                f"the camera looked {record.tilt.tilt_deg:.0f} degrees aside: one scale does not hold for all vehicles"
            )
            issues.append(FileIssue(file, "camera_tilted", why))
            continue
        log_sd = math.log(high / low) / (2 * Z95)
        images.append(KnownScaleImage(file, gsd, labels=labels_beside(file), gsd_log_sd=log_sd))
    source = str(paths[0]) if len(paths) == 1 else f"{len(paths)} photographs"
    return KnownScaleSet(source, tuple(images), tuple(issues))
