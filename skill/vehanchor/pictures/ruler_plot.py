"""Plot of the rulers' densities and their product, over metres per pixel."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vehanchor.records.digits import significant
from vehanchor.rulers.decision import ruler_densities
from vehanchor.rulers.registry import ruler_class
from vehanchor.rulers.vehicles import Vehicles
from vehanchor.scale.fusion import GRID, product

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from vehanchor.pictures.drawable import DrawableScale

_INK = "#222222"
_PAD = 1.25  # factor beyond the widest interval
_DRAWN = 0.004  # of the maximum; lower parts of a curve are not drawn


def has_densities(analysis: DrawableScale) -> bool:
    """Test whether any ruler other than vehicles has a density."""
    return set(ruler_densities((analysis.vehicles, *analysis.others))) not in (set(), {Vehicles.kind})


def plot_rulers(axes: Axes, analysis: DrawableScale) -> None:
    """Plot the densities of all rulers, each normalised to its maximum, their product, and the scale's interval.

    Args:
        axes: axes of a matplotlib figure.
        analysis: analysis of an image.
    """
    evidence = (analysis.vehicles, *analysis.others)
    densities = ruler_densities(evidence)
    estimate = analysis.estimate
    low, high = estimate.gsd_ci95_low_m_per_px, estimate.gsd_ci95_high_m_per_px
    outvoted = {ruler.kind for ruler in estimate.rulers if not ruler.agrees}
    ends = [end for each in evidence if each.interval is not None for end in each.interval]
    scales = np.exp(GRID)
    for kind, density in densities.items():
        colour, name = ruler_class(kind).colour, ruler_class(kind).label
        gsd = next(each.gsd_m_per_px for each in evidence if each.kind == kind)
        label = f"{name} {significant(gsd or 0)}{' (disagrees)' if kind in outvoted else ''}"
        curve = density / density.max()
        shown = np.where(curve > _DRAWN, curve, 0.0)
        axes.fill_between(scales, shown, color=colour, alpha=0.18, lw=0)
        axes.plot(scales, shown, color=colour, lw=1.6, ls="--" if kind in outvoted else "-", label=label)
    if estimate.gsd_m_per_px is not None:
        posterior = product(*densities.values())
        label = f"together {significant(estimate.gsd_m_per_px)}"
        axes.plot(scales, posterior / posterior.max(), color=_INK, lw=2.2, label=label)
        axes.axvline(estimate.gsd_m_per_px, color=_INK, lw=1.0, ls=":")
        if low is not None and high is not None:
            axes.axvspan(low, high, color="0.75", alpha=0.4, lw=0, zorder=0, label="95 % interval")
            ends += [low, high]
    axes.set_xscale("log")
    axes.set_xlim(max(min(ends) / _PAD, scales[0]), min(max(ends) * _PAD, scales[-1]))
    axes.set_ylim(0, 1.08)
    axes.set_yticks([])
    axes.set_xlabel("metres per pixel; each curve is drawn to its own height")
    ticks = _ticks(*axes.get_xlim())
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=9, frameon=False)


def _ticks(low: float, high: float) -> list[float]:
    """Choose round scales between two ends: 1, 2 and 5 per decade on a wide axis, finer steps on a narrow one."""
    decades = 10.0 ** np.arange(-4, 2)
    for steps in ((1, 2, 5), (1, 1.5, 2, 3, 4, 5, 7), tuple(np.arange(1, 10, 0.5)), tuple(np.arange(1, 10, 0.1))):
        ticks = sorted(round(float(step * decade), 6) for decade in decades for step in steps)
        inside = [tick for tick in ticks if low <= tick <= high]
        if len(inside) >= 4:
            break
    return inside[:: max(1, len(inside) // 8)]
