"""Picture of a measured line: length, vehicles and scale bar."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehanchor.pictures.marks import draw_marks
from vehanchor.pictures.measured import MEASURED_RGB, finish, open_canvas, size_in_words
from vehanchor.records.digits import significant
from vehanchor.rulers.evidence import Mark

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from vehanchor.pictures.drawable import DrawableDistance


def draw_distance(image: NDArray[np.uint8], analysis: DrawableDistance) -> NDArray[np.uint8]:
    """Draw a distance measurement with its evidence and a caption with length, scale and confidence.

    A usable length is also written beside the middle of the line.

    Args:
        image: ``[h, w, 3]`` RGB, the measured image or a reduced copy of it (see
            ``vehanchor.pictures.scale.read_reduced``).
        analysis: of that image.

    Returns:
        ``[h', w', 3]`` RGB, at most 2048 px a side before the caption is added.
    """
    record = analysis.measurement
    canvas = open_canvas(image, record, analysis.scale)
    usable = record.status == "ok" and record.distance_m is not None
    label = f"{significant(record.distance_m or 0)} m" if usable else ""
    line = Mark(tuple((point.x_px, point.y_px) for point in record.path), label)
    draw_marks(canvas.picture, [line], canvas.scale, MEASURED_RGB)
    length = size_in_words(
        record.distance_m, record.distance_ci95_low_m, record.distance_ci95_high_m, "m", f"{record.length_px:.0f} px"
    )
    return finish(canvas, analysis, length)
