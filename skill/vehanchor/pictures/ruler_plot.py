"""Plot of the witnesses' densities and the posterior, over metres per pixel."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vehanchor.records.text import significant
from vehanchor.rulers.registry import ruler_class
from vehanchor.scale.density import GRID

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from vehanchor.pictures.drawable import DrawableScale

_INK = "#222222"
_PAD = 1.25  # factor beyond the widest interval
_DRAWN = 0.004  # of the maximum; lower parts of a curve are not drawn


def plot_rulers(axes: Axes, analysis: DrawableScale) -> None:
    """Plot the densities of all witnesses, each normalised to its maximum, the posterior, and the scale's interval.

    The label of a witness has its scale and the chance that it is right.

    Args:
        axes: axes of a matplotlib figure.
        analysis: analysis of an image with a scale.
    """
    rulers = {ruler.kind: ruler for ruler in analysis.estimate.rulers}
    heard = [each for each in analysis.witnesses if each.kind in rulers]
    found, scales = analysis.answer, np.exp(GRID)
    ends = [end for each in heard if each.interval is not None for end in each.interval]
    for witness in heard:
        ruler, colour = rulers[witness.kind], ruler_class(witness.kind).colour
        label = f"{ruler.label} {significant(ruler.gsd_m_per_px)} (right: {ruler.p_right:.2f})"
        curve = witness.density / witness.density.max()
        shown = np.where(curve > _DRAWN, curve, 0.0)
        axes.fill_between(scales, shown, color=colour, alpha=0.18, lw=0)
        axes.plot(scales, shown, color=colour, lw=1.6, ls="-" if ruler.probably_right else "--", label=label)
    if found is not None:
        label = f"together {significant(found.gsd_m_per_px)} ({found.chance:.2f})"
        axes.plot(scales, found.density / found.density.max(), color=_INK, lw=2.2, label=label)
        axes.axvline(found.gsd_m_per_px, color=_INK, lw=1.0, ls=":")
        axes.axvspan(*found.interval, color="0.75", alpha=0.4, lw=0, zorder=0, label="95 % interval")
        ends += found.interval
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
