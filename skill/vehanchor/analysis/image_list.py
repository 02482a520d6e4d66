"""Estimates of the images of a list."""

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

_SHOWN_FAILURES = 10


def estimate_each(images: Sequence[ImageSource], detector: Detector, options: ScaleOptions) -> list[GsdEstimate]:
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
        raise ImageListError(_message(images, results), results)
    return records


def _message(images: Sequence[ImageSource], results: Sequence[GsdEstimate | VehAnchorError]) -> str:
    """Name the failed images, the first of them with their errors."""
    failures = [
        f"image {number} ({_name(image)}): {error}"
        for number, (image, error) in enumerate(zip(images, results, strict=True), 1)
        if isinstance(error, VehAnchorError)
    ]
    shown = "; ".join(failures[:_SHOWN_FAILURES])
    more = f"; and {len(failures) - _SHOWN_FAILURES} more" if len(failures) > _SHOWN_FAILURES else ""
    return (
        f"{len(failures)} of {len(results)} images cannot be used: {shown}{more}. Leave them out; results of this "
        "error has the records of the others"
    )


def _name(image: ImageSource) -> str:
    return os.fspath(image) if isinstance(image, str | os.PathLike) else type(image).__name__
