"""Picture of measured lines: lengths, vehicles and scale bar."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vehanchor.pictures.marks import draw_marks
from vehanchor.pictures.measured import MEASURED_RGB, finish, numbered, open_canvas, size_in_words
from vehanchor.pictures.placement import CUT_SIDE_PX, Cut, part_around
from vehanchor.records.text import significant
from vehanchor.scale.posterior import Mark

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vehanchor.pictures.drawable import DrawableDistance
    from vehanchor.records import DistanceMeasurement


def draw_distance(image: NDArray[np.uint8], *analyses: DrawableDistance, cut: Cut | None = None) -> NDArray[np.uint8]:
    """Draw measured lines with their evidence and a caption with length, scale and confidence.

    A usable length is also written beside the middle of its line. Several lines are numbered.

    Args:
        image: ``[h, w, 3]`` RGB, the measured image, the part of ``cut``, or a reduced copy of either (see
            ``vehanchor.pictures.scale.read_reduced``).
        analyses: of lines in that image, one at least.
        cut: the part to show; None for all of the image.

    Returns:
        ``[h', w', 3]`` RGB, at most 2048 px a side before the caption is added.
    """
    canvas = open_canvas(image, analyses[0], cut)
    records = [analysis.measurement for analysis in analyses]
    labels = numbered([_label(record) for record in records])
    lines = [Mark(_ends(record), label) for record, label in zip(records, labels, strict=True)]
    draw_marks(canvas.picture, lines, canvas.place, MEASURED_RGB)
    return finish(canvas, analyses[0], [_size(record) for record in records])


def cut_to_lines(records: Sequence[DistanceMeasurement], long_side_px: int = CUT_SIDE_PX) -> Cut:
    """Cut the image to measured lines."""
    points = np.array([end for record in records for end in _ends(record)])
    return Cut(part_around(points, records[0].image_width_px, records[0].image_height_px), long_side_px)


def _ends(record: DistanceMeasurement) -> tuple[tuple[float, float], ...]:
    return tuple((point.x_px, point.y_px) for point in record.path)


def _label(record: DistanceMeasurement) -> str:
    usable = record.status == "ok" and record.distance_m is not None
    return f"{significant(record.distance_m or 0)} m" if usable else ""


def _size(record: DistanceMeasurement) -> str:
    low, high = record.distance_ci95_low_m, record.distance_ci95_high_m
    return size_in_words(record.distance_m, low, high, "m", f"{record.length_px:.0f} px")
