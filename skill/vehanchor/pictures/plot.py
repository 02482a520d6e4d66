"""Plot of an estimate: vehicle lengths, their mode, the guard, and the rulers' densities (extra ``plots``)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vehanchor.errors import MissingExtraError
from vehanchor.pictures.scale import write_picture
from vehanchor.records.text import NO_SCALE, count, scale_text, significant
from vehanchor.rulers.active import ruler_class
from vehanchor.scale.density import GRID
from vehanchor.scale.lengths import MIN_KDE_VEHICLES, modal_density

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from vehanchor.pictures.evidence import ScaleEvidence
    from vehanchor.scale.defaults import Aggregation

# Okabe and Ito: blues, orange
_KEPT = "#56B4E9"
_KEPT_DARK = "#0072B2"
_DROPPED = "#E69F00"
_GUARD = "#D55E00"
_INK = "#222222"
_WIDTH_IN = 9.6
_ROW_IN = 4.0
_DPI = 150
_PAD = 1.25  # factor beyond the widest interval, of the rulers' axis
_DRAWN = 0.004  # of the maximum; lower parts of a ruler's curve are not drawn
_RULES = {"kde": "KDE", "weighted_kde": "weighted KDE", "median": "median", "mean": "mean"}


def require_plots() -> type[Figure]:
    """Import matplotlib's ``Figure``, without global state.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtraError("plots need matplotlib: pip install 'vehanchor[plots]'") from error
    return Figure


def plot_scale(analysis: ScaleEvidence) -> Figure:
    """Plot the vehicle lengths behind a scale, and the densities of all rulers.

    Args:
        analysis: analysis of an image.

    Returns:
        A matplotlib figure without global state. It shows the lengths if there are any. Below them
        it shows the densities of all rulers and the posterior, but not for the preset ``paper``.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    estimate = analysis.estimate
    measured = estimate.mode_length_px is not None
    fused = analysis.answer is not None
    n_rows = max(1, measured + fused)
    figure = require_plots()(figsize=(_WIDTH_IN, _ROW_IN * n_rows), dpi=_DPI, layout="constrained")
    rows = figure.subplots(n_rows, squeeze=False)[:, 0]
    for axes in rows:
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
    if not (measured or fused):
        rows[0].set_axis_off()
        rows[0].text(0.5, 0.5, NO_SCALE, ha="center", va="center", fontsize=14, color=_INK)
        return figure
    if measured:
        _plot_lengths(figure, rows[0], analysis)
    if fused:
        plot_rulers(rows[-1], analysis)
    confidence = "" if estimate.gsd_m_per_px is None else f",  confidence {estimate.confidence:.2f}"
    rows[0].set_title(f"{scale_text(estimate)}{confidence}", loc="left", fontsize=12)
    return figure


def _plot_lengths(figure: Figure, axes: Axes, analysis: ScaleEvidence) -> None:
    """Plot the lengths, their density, the mode, the guard, and the interval of the vehicles' scale in pixels."""
    vehicles = analysis.vehicles
    assert vehicles is not None
    gsd = vehicles.gsd_m_per_px
    mode = vehicles.mode_length_px
    guard = vehicles.guard_length_px
    assert gsd is not None
    assert mode is not None
    lengths = analysis.detections.boxes[:, 2]
    # Twice the longest kept length keeps the cars wide beside a lorry.
    ends = [
        guard,
        mode,
        float(lengths.min()),
        min(float(lengths.max()), 2 * float(lengths[analysis.kept].max())),
    ]
    reference_m = vehicles.reference.length_m
    if vehicles.interval is not None:
        low, high = (reference_m / scale for scale in reversed(vehicles.interval))
        axes.axvspan(
            low,
            high,
            color="0.75",
            alpha=0.4,
            lw=0,
            zorder=0,
            label=f"95 % interval {low:.1f} to {high:.1f} px",
        )
        ends += [low, high]
    axes.set_xlim(0.95 * min(ends), 1.05 * max(ends))
    _draw_lengths(axes, analysis, right_px=1.05 * max(ends), aggregation=vehicles.aggregation)
    rule = (
        f"$P_{{mode}}$ {mode:.1f} px ({_RULES[vehicles.aggregation]}) = "
        f"{significant(reference_m)} m"
    )
    axes.axvline(mode, color=_INK, lw=1.6, label=rule)
    axes.axvline(guard, color=_GUARD, lw=1.6, ls="--", label=f"resolution guard {guard:.1f} px")
    axes.set_xlabel("vehicle length, pixels")
    axes.set_ylabel("vehicles")
    axes.locator_params(axis="y", integer=True)
    metres = axes.secondary_xaxis(
        "top", functions=(lambda px: np.multiply(px, gsd), lambda m: np.divide(m, gsd))
    )
    metres.set_xlabel("metres, at the vehicles' scale")
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=9, frameon=False)


def write_plot(path: str | Path, figure: Figure) -> Path:
    """Write a figure as PNG or JPEG.

    Raises:
        OutputError: the folder does not exist, the suffix is unknown, or the file system refuses.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    return write_picture(path, np.asarray(canvas.buffer_rgba())[:, :, :3])


def _draw_lengths(
    axes: Axes, analysis: ScaleEvidence, right_px: float, aggregation: Aggregation
) -> None:
    """Draw the histogram of kept and dropped lengths, and the density of the kept ones in the same units."""
    lengths = analysis.detections.boxes[:, 2]
    kept = lengths[analysis.kept]
    dropped = lengths[~analysis.kept]
    edges = np.histogram_bin_edges(
        kept, "auto", (float(lengths.min()), min(float(lengths.max()), right_px))
    )
    groups = [kept]
    colours = [_KEPT]
    labels = [f"{count(len(kept), 'vehicle')} kept"]
    if len(dropped):
        n_beyond = int((dropped > right_px).sum())
        beyond = f" ({n_beyond} beyond the axis)" if n_beyond else ""
        groups = [*groups, dropped]
        colours = [*colours, _DROPPED]
        labels.append(f"{count(len(dropped), 'outlier')} dropped{beyond}")
    axes.hist(
        groups,
        bins=list(edges),
        stacked=True,
        color=colours,
        label=labels,
        edgecolor="white",
        linewidth=0.6,
    )
    axes.set_ylim(0, 1.12 * axes.get_ylim()[1])
    if len(kept) < MIN_KDE_VEHICLES:
        return
    at = np.linspace(*axes.get_xlim(), 800)
    density = modal_density(
        at, kept, scores=analysis.detections.scores[analysis.kept], aggregation=aggregation
    )
    if density.any():
        curve = np.where(
            density > 1e-3 * density.max(), density * len(kept) * (edges[1] - edges[0]), np.nan
        )
        label = "density (weighted KDE)" if aggregation == "weighted_kde" else "density (KDE)"
        axes.plot(at, curve, color=_KEPT_DARK, lw=2, label=label)
        axes.set_ylim(0, max(axes.get_ylim()[1], 1.12 * float(np.nanmax(curve))))


def plot_rulers(axes: Axes, analysis: ScaleEvidence) -> None:
    """Plot the densities of all witnesses, each normalised to its maximum, the posterior, and the scale's interval.

    The label of a witness has its scale and the chance that it is right.

    Args:
        axes: axes of a matplotlib figure.
        analysis: analysis of an image with a scale.
    """
    rulers = {ruler.kind: ruler for ruler in analysis.estimate.rulers}
    heard = [each for each in analysis.witnesses if each.kind in rulers]
    found = analysis.answer
    scales = np.exp(GRID)
    ends = [end for each in heard if each.interval is not None for end in each.interval]
    for witness in heard:
        ruler = rulers[witness.kind]
        colour = ruler_class(witness.kind).colour
        label = f"{ruler.label} {significant(ruler.gsd_m_per_px)} (right: {ruler.p_right:.2f})"
        curve = witness.density / witness.density.max()
        shown = np.where(curve > _DRAWN, curve, 0.0)
        axes.fill_between(scales, shown, color=colour, alpha=0.18, lw=0)
        axes.plot(
            scales,
            shown,
            color=colour,
            lw=1.6,
            ls="-" if ruler.probably_right else "--",
            label=label,
        )
    if found is not None:
        label = f"together {significant(found.gsd_m_per_px)} ({found.chance:.2f})"
        axes.plot(scales, found.density / found.density.max(), color=_INK, lw=2.2, label=label)
        axes.axvline(found.gsd_m_per_px, color=_INK, lw=1.0, ls=":")
        axes.axvspan(
            *found.interval, color="0.75", alpha=0.4, lw=0, zorder=0, label="95 % interval"
        )
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
    for steps in (
        (1, 2, 5),
        (1, 1.5, 2, 3, 4, 5, 7),
        tuple(np.arange(1, 10, 0.5)),
        tuple(np.arange(1, 10, 0.1)),
    ):
        ticks = sorted(round(float(step * decade), 6) for decade in decades for step in steps)
        inside = [tick for tick in ticks if low <= tick <= high]
        if len(inside) >= 4:
            break
    return inside[:: max(1, len(inside) // 8)]
