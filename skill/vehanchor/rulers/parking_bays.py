"""Parking bays as a ruler: their painted lines repeat at a width that standards fix to some per cent."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.rulers.bay_rows import find_bay_rows
from vehanchor.rulers.ruler import Ruler, point_witness
from vehanchor.rulers.standards import lengths_of
from vehanchor.scale.density import credible_interval, on_grid, quantile
from vehanchor.scale.lengths import Interval
from vehanchor.scale.posterior import Mark
from vehanchor.scale.reliability import PAINT, RELIABILITY

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vehanchor.rulers.bay_rows import BayRow
    from vehanchor.rulers.ruler import View
    from vehanchor.scale.posterior import Witness

_STANDARD = "parking_bay_width"
_RESOLVED = Interval(0.01, 0.33)  # metres per pixel: paint is 0.1 m wide
_PRIOR_SHARE = 0.9  # of the scene-scale prior, between whose scales bays are sought
_FARTHEST = 1.7  # from the prior's median, as a factor: two bays are not one
_APART = 0.08  # of the log of the width: farther from the median, these are no usual bays


class ParkingBays(Ruler):
    """Rows of at least six lines of parking bays."""

    kind = "parking_bays"
    label = "parking bays"
    plural = True
    help = "a row of parking bays with visible lines, up to 0.33 m/px"
    colour = "#882255"
    pooling_gain = 0.0  # one country: one error

    def measure(self, view: View) -> Witness | None:
        """Measure rows of bays at the scales that the scene-scale prior allows; none without pixels or prior.

        After a search that ended early, only the searched part of the image is examined.
        """
        scale = _prior_range(view)
        if view.raster is None or scale is None:
            return None
        rows = find_bay_rows(view.raster, scale, view.detections.covers)
        return witness_of(rows, view.options.reference.region)


def witness_of(rows: Sequence[BayRow], region: str | None = None) -> Witness | None:
    """Compare the width of bays with the standards of a region, or of all countries.

    Args:
        rows: of one image; rows of another width than most lines have are left out.
        region: country or region; None if it is unknown.
    """
    if not rows:
        return None
    widths = np.log([row.pitch_px for row in rows])
    lines = np.array([len(row.ends) for row in rows])
    order = np.argsort(widths, kind="stable")
    middle = widths[order][np.searchsorted(lines[order].cumsum(), lines.sum() / 2)]
    kept = np.abs(widths - middle) <= _APART
    width = float(np.average(widths[kept], weights=lines[kept]))
    spread = math.sqrt(float(np.average((widths[kept] - width) ** 2, weights=lines[kept])))
    spread = math.hypot(spread, min(row.pitch_log_sd for row in rows))
    n, width_px = int(lines[kept].sum()), math.exp(width)
    log_width, log_sd = _standard_width(region)
    gsd = math.exp(log_width) / width_px
    if not on_grid(gsd):
        return None
    reliability = RELIABILITY[ParkingBays.kind]
    return point_witness(
        ParkingBays.kind,
        gsd,
        math.sqrt(max(reliability.log_sd**2 - PAINT.log_sd**2, log_sd**2) + spread**2),
        reliability.chance_wrong,
        f"{n} lines of parking bays, {width_px:.1f} px apart, say {{}}.",
        shared=[PAINT],
        n=n,
        marks=[mark for row, good in zip(rows, kept, strict=True) if good for mark in _marks(row)],
    )


def _standard_width(region: str | None) -> tuple[float, float]:
    """Compute mean and standard deviation of the log of a bay's width over the widths of a region, or of all."""
    _, variants = lengths_of(_STANDARD, region)
    logs, weights = np.log([each.metres for each in variants]), [each.weight for each in variants]
    mean = float(np.average(logs, weights=weights))
    variances = np.array([each.log_sd**2 for each in variants]) + (logs - mean) ** 2
    return mean, math.sqrt(float(np.average(variances, weights=weights)))


def _marks(row: BayRow) -> list[Mark]:
    """Mark the lines, and one bay between them."""
    along = row.ends[0, 1] - row.ends[0, 0]
    across = np.array([-along[1], along[0]]) / np.hypot(*along) * row.pitch_px
    middles = row.ends.mean(axis=1)
    if not (np.hypot(*(middles - middles[0] - across).T) < row.length_px / 2).any():
        across = -across
    width = Mark(_points(np.stack([middles[0], middles[0] + across])), "bay")
    return [width, *(Mark(_points(ends)) for ends in row.ends)]


def _points(places: NDArray[np.float64]) -> tuple[tuple[float, float], ...]:
    return tuple((float(x), float(y)) for x, y in places)


def _prior_range(view: View) -> Interval | None:
    """Compute the range of scales to search; None in a tilted view, without a prior, or outside the resolved scales."""
    if view.prior is None or view.plane is not None:
        return None
    middle = quantile(view.prior.density, 0.5)
    low, high = credible_interval(view.prior.density, _PRIOR_SHARE)
    low, high = max(low, middle / _FARTHEST, _RESOLVED.low), min(high, middle * _FARTHEST, _RESOLVED.high)
    return Interval(low, high) if low < high else None
