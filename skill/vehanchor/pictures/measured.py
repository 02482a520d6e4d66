"""Common parts of pictures of measurements: vehicles, scale bar and caption."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

from vehanchor.imagery.raster import Window
from vehanchor.pictures.marks import draw_marks
from vehanchor.pictures.placement import Placement
from vehanchor.pictures.scale import (
    caption_panel,
    draw_scale_bar,
    draw_vehicles,
    fit_for_eyes,
    with_margins,
)
from vehanchor.records.text import ADVICE, NO_SCALE, significant, with_interval
from vehanchor.scale.defaults import USABLE_CHANCE

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vehanchor.pictures.drawable import DrawableMeasurement
    from vehanchor.pictures.placement import Cut
    from vehanchor.pictures.scale import CaptionLine
    from vehanchor.records import AreaMeasurement, DistanceMeasurement

    Measured: TypeAlias = AreaMeasurement | DistanceMeasurement

MEASURED_RGB = (204, 121, 167)  # Okabe and Ito's reddish purple, beside the vehicles' sky blue and orange


class Canvas(NamedTuple):
    """Picture to draw into.

    Attributes:
        picture: ``[h, w, 3]`` RGB, a copy of the image at display size.
        place: of the image in the picture.
    """

    picture: NDArray[np.uint8]
    place: Placement


def open_canvas(image: NDArray[np.uint8], analysis: DrawableMeasurement, cut: Cut | None) -> Canvas:
    """Copy an image at display size and draw the evidence of its scale.

    Args:
        image: ``[h, w, 3]`` RGB, the measured image, the part of ``cut``, or a reduced copy of either.
        analysis: of a measurement in that image.
        cut: the part to show; None for all of the image.
    """
    record, scale = analysis.measurement, analysis.scale
    picture = fit_for_eyes(image) if cut is None else cut.sized(image)
    whole = Window(0, 0, record.image_width_px, record.image_height_px)
    place = Placement.of(picture, whole if cut is None else cut.part)
    if scale is not None:
        draw_vehicles(picture, scale, place)
        draw_marks(picture, scale.marks, place)
    return Canvas(picture, place)


def finish(canvas: Canvas, analysis: DrawableMeasurement, sizes: Sequence[str]) -> NDArray[np.uint8]:
    """Add the scale bar and the caption with sizes and scale; a reason against their use comes first.

    An image with a tilt or an unusable scale gets no scale bar.

    Args:
        canvas: picture with the measured objects.
        analysis: analysis of the first measurement.
        sizes: the measured sizes, in words; several are numbered.

    Returns:
        ``[h', w', 3]`` RGB.
    """
    record, picture = analysis.measurement, with_margins(canvas.picture)
    objection = _objection(record)
    if record.gsd_m_per_px is not None and analysis.nadir and not objection:
        draw_scale_bar(picture, record.gsd_m_per_px / float(canvas.place.scale[0]))
    lines: list[CaptionLine] = [[(None, f"do not use: {objection}")]] if objection else []
    lines += [[(MEASURED_RGB, size)] for size in numbered(sizes)]
    if record.gsd_m_per_px is not None:
        source = "given" if record.confidence is None else f"confidence {record.confidence:.2f}"
        lines.append([(None, f"{significant(record.gsd_m_per_px, 4)} m/px, {source}")])
    return np.concatenate([picture, caption_panel(picture.shape[1], lines)])


def numbered(labels: Sequence[str]) -> list[str]:
    """Put numbers before the labels of several measurements; keep a single label."""
    if len(labels) == 1:
        return list(labels)
    return [f"{number}: {label}".removesuffix(": ") for number, label in enumerate(labels, 1)]


def size_in_words(value: float | None, low: float | None, high: float | None, unit: str, pixels: str) -> str:
    """Format a size with its interval; without a scale, its pixels."""
    if value is None:
        return f"{pixels}; {NO_SCALE}"
    return with_interval(value, low, high, unit)


def _objection(record: Measured) -> str:
    """Explain why the scale is not usable; empty for a usable scale and without one."""
    if record.confidence is None or record.gsd_m_per_px is None or record.confidence >= USABLE_CHANCE:
        return ""
    reason = None if record.estimate is None else record.estimate.reason
    return f"the scale's confidence is below {USABLE_CHANCE}" if reason is None else ADVICE[reason].why
