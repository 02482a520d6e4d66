"""Estimates of several images in one call."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from vehanchor.analysis.pipeline import analyse_image
from vehanchor.errors import ImageListError, VehAnchorError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor.detection.detector import Detector
    from vehanchor.imagery.sources.opening import ImageSource
    from vehanchor.options import ScaleOptions
    from vehanchor.records import GsdEstimate

# Images whose errors are shown if many images of a list fail.
_MAX_SHOWN_FAILURES = 10


def estimate_each(
    images: Sequence[ImageSource], detector: Detector, options: ScaleOptions
) -> list[GsdEstimate]:
    """Estimate the scale of each image; an image that fails does not stop the others.

    Raises:
        ImageListError: images failed; the error names them and holds all results.
    """
    results: list[GsdEstimate | VehAnchorError] = []
    for image in images:
        try:
            results.append(analyse_image(image, detector, options).estimate)
        except VehAnchorError as error:
            results.append(error)
    records = [result for result in results if not isinstance(result, VehAnchorError)]
    if len(records) < len(results):
        raise ImageListError(_failures_text(images, results), results)
    return records


def _failures_text(
    images: Sequence[ImageSource], results: Sequence[GsdEstimate | VehAnchorError]
) -> str:
    """Name the failed images with their errors, up to ten of them."""
    failures = []
    for number, (image, result) in enumerate(zip(images, results, strict=True), 1):
        if isinstance(result, VehAnchorError):
            failures.append(f"image {number} ({_image_name(image)}): {result}")
    shown = "; ".join(failures[:_MAX_SHOWN_FAILURES])
    n_more = len(failures) - _MAX_SHOWN_FAILURES
    if n_more > 0:
        shown += f"; and {n_more} more"
    return (
        f"{len(failures)} of {len(results)} images cannot be used: {shown}. Leave them out; "
        "the attribute results of this error holds the records of the others"
    )


def _image_name(image: ImageSource) -> str:
    """Name an image by its path, or by the type of its source."""
    if isinstance(image, str | os.PathLike):
        return os.fspath(image)
    return type(image).__name__
