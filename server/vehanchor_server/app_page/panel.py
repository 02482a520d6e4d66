"""Page data besides the record: the image, the shapes over it, and the histogram of lengths.

The data is in the result's ``_meta``, which hosts hide from the model (MCP Apps, 2026-01-26, "Data Passing").
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
_MAX_VEHICLES = 2000  # limit of drawn vehicles
_ADDED = 2
_LONGEST_SHOWN = 2.5  # medians; longer outliers are only counted, so that one false alarm does not compress the axis


class LengthBin(FrozenModel):
    """One bar of the histogram."""

    kept: int = Field(description="Vehicles used for the scale.")
    dropped: int = Field(description="Outliers.")


class LengthHistogram(FrozenModel):
    """Histogram of vehicle lengths with a bounded number of bins."""

    start_px: float = Field(description="Start of the first bin.")
    bin_px: float = Field(description="Width of a bin.")
    bins: tuple[LengthBin, ...]
    beyond: int = Field(description="Outliers longer than the last bin.")
    density: tuple[float, ...] = Field(
        description="The kernel density of the kept lengths in vehicles per bin, at points evenly spaced over all bins "
        "and both ends; empty if the scale is not the mode of a density."
    )
    guard_px: float = Field(description="P_thresh: below it the resolution guard applies.")


class DrawnLine(FrozenModel):
    """A line that a ruler measured."""

    points: tuple[tuple[float, float], ...]
    label: str
    closed: bool


class Drawing(FrozenModel):
    """Shapes over the image, in pixels of the full image.

    Attributes:
        vehicles: for each vehicle, x and y of the centre, length, width, angle in degrees, 1 for a measured one or 0
            for an outlier, its number in ``confirm`` and ``drop``, and 1 for a confirmed one, 2 for an added one or 0;
            best first.
        vehicles_left_out: number of vehicles beyond the limit.
        lines: lines of other rulers.
    """

    vehicles: tuple[tuple[float, float, float, float, float, int, int, int], ...]
    vehicles_left_out: int
    lines: tuple[DrawnLine, ...]


class PanelData(FrozenModel):
    """Page data of one result.

    Attributes:
        histogram: vehicle lengths behind the scale; null without vehicles.
        picture_jpeg: the reduced image in base64; null if the host shows no pages.
        drawing: shapes over the image; null if the host shows no pages, or for a given scale.
        record: the whole record, if the result is compact and the host shows pages.
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
    """Build the ``_meta`` of a result; see ``PanelData``."""
    encoded = None if picture is None else base64.b64encode(picture).decode()
    data = PanelData(histogram=histogram, picture_jpeg=encoded, drawing=drawing, record=record)
    return {PANEL_KEY: data.model_dump(mode="json")}


def drawing_of(analysis: ScaleAnalysis) -> Drawing:
    """Collect the shapes behind an estimate, rounded to a tenth of a pixel."""
    import numpy as np  # late, to start the server quickly

    detections = analysis.detections
    boxes = detections.boxes[:_MAX_VEHICLES]
    rows = np.round(np.column_stack([boxes[:, :4], np.rad2deg(boxes[:, 4])]), 1)
    by_hand = detections.stated.astype(int)
    if detections.corrections is not None and detections.corrections.n_added:
        by_hand[-detections.corrections.n_added :] = _ADDED
    facts = zip(rows.tolist(), analysis.kept, detections.numbers, by_hand, strict=False)
    return Drawing(
        vehicles=tuple(
            (x, y, length, width, angle, int(kept), int(number), int(stated))
            for (x, y, length, width, angle), kept, number, stated in facts
        ),
        vehicles_left_out=len(detections.boxes) - len(boxes),
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
    """Build the histogram of all lengths with the density whose peak is P_mode.

    Returns:
        The histogram, or None without vehicles.
    """
    import numpy as np  # late, to start the server quickly

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
    """Round up to 1, 2 or 5 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(width))
    return next(m * power for m in (1.0, 2.0, 5.0, 10.0) if m * power >= width * (1 - 1e-9))
