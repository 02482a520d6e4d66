"""Georeferenced images, whose geotransform gives the true GSD."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehanchor.errors import VehAnchorError
from vehanchor.imagery.sources.opening import open_raster
from vehanchor_evaluation.known_scale import (
    DATASET_READING,
    FileIssue,
    KnownScaleImage,
    KnownScaleSet,
    files_of,
    labels_beside,
)

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path


def survey_geotiffs(paths: Sequence[Path]) -> KnownScaleSet:
    """Read the true GSD at the centre of orthophotos from their georeference.

    Pixels in degrees and Mercator's metres are converted at the image's latitude: see
    ``vehanchor.imagery.metadata.georeference``.

    Args:
        paths: files, and folders to search for images.

    Returns:
        The images with a georeference; the issues list the others.

    Raises:
        InvalidParameterError: a path does not exist.
    """
    images = []
    issues = []
    for file in files_of(paths):
        try:
            with open_raster(file, DATASET_READING) as raster:
                gsd = raster.georeference_gsd_m_per_px
        except VehAnchorError as error:
            issues.append(FileIssue(file, error.code, str(error)))
            continue
        if gsd is None:
            message = "the file has no valid georeference"
            issues.append(FileIssue(file, "no_georeference", message))
            continue
        images.append(KnownScaleImage(file, gsd, labels=labels_beside(file)))
    source = f"{len(paths)} georeferenced files"
    if len(paths) == 1:
        source = str(paths[0])
    return KnownScaleSet(source, tuple(images), tuple(issues))
