"""Data for the page beyond the record: the image, what is drawn over it, and the histogram of lengths.

It travels in the result's ``_meta``, which hosts keep from the model (MCP Apps, 2026-01-26, "Data Passing").
"""

from __future__ import annotations

import base64
import math
from typing import TYPE_CHECKING, Any

from pydantic import Field

from vehanchor_server.frozen import FrozenModel

if TYPE_CHECKING:
    from vehanchor.analysis.scale import ScaleAnalysis

PANEL_KEY = "vehanchor/panel"

_MAX_BINS = 40
_CURVE_POINTS = 121
_MAX_VEHICLES = 2000  # drawn; a result is no archive
_LONGEST_SHOWN = 2.5  # medians; longer outliers are counted beside the axis, or one false alarm would squeeze the rest


class LengthBin(FrozenModel):
    """One bar of the histogram."""

    kept: int = Field(description="Vehicles that the scale rests on.")
    dropped: int = Field(description="Outliers.")


class LengthHistogram(FrozenModel):
    """Vehicle lengths in bins of equal width; of one size, however many vehicles there are."""

    start_px: float = Field(description="Where the first bin begins.")
    bin_px: float = Field(description="Width of a bin.")
    bins: tuple[LengthBin, ...]
    beyond: int = Field(description="Outliers longer than the last bin.")
    density: tuple[float, ...] = Field(
        description="The kernel density of the kept lengths in vehicles per bin, at points evenly spaced over all bins "
        "and both ends; empty where the scale is no mode of a density."
    )
    guard_px: float = Field(description="P_thresh: below it the resolution guard holds.")


class DrawnLine(FrozenModel):
    """A line that a ruler was laid along."""

    points: tuple[tuple[float, float], ...]
    label: str
    closed: bool


class Drawing(FrozenModel):
    """What is drawn over the image, in pixels of the full image.

    Attributes:
        vehicles: of each, x and y of the centre, length, width, angle in degrees, and 1 for one that was measured, 0
            for an outlier; best first.
        vehicles_left_out: how many more there are.
        lines: what other rulers were laid along.
    """

    vehicles: tuple[tuple[float, float, float, float, float, int], ...]
    vehicles_left_out: int
    lines: tuple[DrawnLine, ...]


class PanelData(FrozenModel):
    """Data of one result.

    Attributes:
        histogram: of the lengths behind the scale; null without vehicles.
        picture_jpeg: the image, reduced, in base64; null where the host shows no pages.
        drawing: what belongs over it; null where the host shows no pages, or the scale was given.
        record: the whole record, where the result has a short one and the host shows pages.
    """

    histogram: LengthHistogram | None = None
    picture_jpeg: str | None = None
    drawing: Drawing | None = None
    record: dict[str, Any] | None = None


def panel_meta(
    histogram: LengthHistogram | None,
    picture: bytes | None = None,
    drawing: Drawing | None = None,
    record: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """The ``_meta`` of a result; see ``PanelData``."""
    encoded = None if picture is None else base64.b64encode(picture).decode()
    data = PanelData(histogram=histogram, picture_jpeg=encoded, drawing=drawing, record=record)
    return {PANEL_KEY: data.model_dump(mode="json")}


def drawing_of(analysis: ScaleAnalysis) -> Drawing:
    """What an estimate rests on, to a tenth of a pixel."""
    import numpy as np  # not before a call needs it, as everything that computes

    boxes = analysis.detections.boxes[:_MAX_VEHICLES]
    rows = np.round(np.column_stack([boxes[:, :4], np.rad2deg(boxes[:, 4])]), 1)
    return Drawing(
        vehicles=tuple(
            (x, y, length, width, angle, int(kept))
            for (x, y, length, width, angle), kept in zip(rows.tolist(), analysis.kept, strict=False)
        ),
        vehicles_left_out=len(analysis.detections.boxes) - len(boxes),
        lines=tuple(
            DrawnLine(
                points=tuple((round(float(x), 1), round(float(y), 1)) for x, y in mark.points),
                label=mark.label,
                closed=mark.closed,
            )
            for mark in analysis.marks
        ),
    )


def length_histogram(analysis: ScaleAnalysis) -> LengthHistogram | None:
    """Bins of a round width over all lengths and the guard's, and the density whose peak is P_mode.

    Returns:
        The histogram, or None where no vehicle was found.
    """
    import numpy as np  # not before a call needs it, as everything that computes

    from vehanchor.scale.lengths import modal_density

    lengths = analysis.detections.boxes[:, 2]
    if not len(lengths):
        return None
    kept, guard = analysis.kept, analysis.guard_length_px
    measured = lengths[kept]
    longest = max(float(measured.max()), min(float(lengths.max()), _LONGEST_SHOWN * float(np.median(measured))))
    high = max(guard, longest)
    low = min(guard, float(lengths.min()))
    margin = 0.08 * (high - low) or 0.08 * high
    low, high = max(0.0, low - margin), high + margin
    width = _round_up((high - low) / _MAX_BINS)
    first, last = math.floor(low / width), math.ceil(high / width)
    edges = np.arange(first, last + 1) * width
    counts = [np.histogram(lengths[chosen], edges)[0] for chosen in (kept, ~kept)]
    density = np.empty(0)
    if analysis.estimate.aggregation in ("kde", "weighted_kde"):
        points = np.linspace(edges[0], edges[-1], _CURVE_POINTS)
        scores = analysis.detections.scores[kept]
        density = modal_density(points, measured, scores, analysis.estimate.aggregation) * len(measured) * width
    return LengthHistogram(
        start_px=float(edges[0]),
        bin_px=width,
        bins=tuple(LengthBin(kept=int(k), dropped=int(d)) for k, d in zip(*counts, strict=True)),
        beyond=int((lengths > edges[-1]).sum()),
        density=tuple(round(float(value), 3) for value in density) if density.any() else (),
        guard_px=guard,
    )


def _round_up(width: float) -> float:
    """The next of 1, 2, 5 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(width))
    return next(m * power for m in (1.0, 2.0, 5.0, 10.0) if m * power >= width * (1 - 1e-9))
