"""Plot of an estimate: vehicle lengths with their mode, and the rulers' densities.

It needs the extra ``plots``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vehanchor.errors import MissingExtraError, how_to_install
from vehanchor.pictures.scale import write_picture
from vehanchor.records.text import NO_SCALE, count, scale_text, significant
from vehanchor.rulers.active import ruler_class
from vehanchor.scale.defaults import INTERVAL_PREMISE
from vehanchor.scale.density import GRID
from vehanchor.scale.lengths import MIN_KDE_VEHICLES, modal_density

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import ArrayLike

    from vehanchor.pictures.evidence import ScaleEvidence
    from vehanchor.records.gsd_estimate import RulerScale
    from vehanchor.scale.defaults import Aggregation
    from vehanchor.scale.posterior import Witness

# Colours of Okabe and Ito: two blues, orange and vermilion.
_KEPT = "#56B4E9"
_KEPT_DARK = "#0072B2"
_DROPPED = "#E69F00"
_GUARD = "#D55E00"
_INK = "#222222"
_WIDTH_IN = 9.6
_ROW_IN = 4.0
_DPI = 150
# Ends of the rulers' axis, as a factor beyond the widest interval.
_PAD_FACTOR = 1.25
# Lower parts of a ruler's curve are not drawn, as a share of its maximum.
_MIN_DRAWN_SHARE = 0.004
# The same for the density of lengths.
_MIN_DRAWN_LENGTH_SHARE = 1e-3
# Room above the highest bar or curve, as a factor.
_HEADROOM = 1.12
# Number of lengths at which the density is drawn.
_N_CURVE_POINTS = 800
_RULES = {"kde": "KDE", "weighted_kde": "weighted KDE", "median": "median", "mean": "mean"}
# Digits of the ticks per decade, from coarse to fine.
_TICK_DIGITS = (
    (1, 2, 5),
    (1, 1.5, 2, 3, 4, 5, 7),
    tuple(np.arange(1, 10, 0.5)),
    tuple(np.arange(1, 10, 0.1)),
)
_MIN_TICKS = 4
_MAX_TICKS = 8


def require_plots() -> type[Figure]:
    """Import matplotlib's ``Figure``, without global state.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtraError(f"plots need matplotlib: {how_to_install('plots')}") from error
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
    has_lengths = estimate.mode_length_px is not None
    has_posterior = analysis.answer is not None
    n_rows = 2 if has_lengths and has_posterior else 1
    new_figure = require_plots()
    size_in = (_WIDTH_IN, _ROW_IN * n_rows)
    figure = new_figure(figsize=size_in, dpi=_DPI, layout="constrained")
    rows = figure.subplots(n_rows, squeeze=False)[:, 0]
    for axes in rows:
        axes.spines["top"].set_visible(False)
        axes.spines["right"].set_visible(False)
    if not has_lengths and not has_posterior:
        rows[0].set_axis_off()
        rows[0].text(
            0.5,
            0.5,
            NO_SCALE,
            ha="center",
            va="center",
            fontsize=14,
            color=_INK,
        )
        return figure
    if has_lengths:
        _plot_lengths(figure, rows[0], analysis)
    if has_posterior:
        plot_rulers(rows[-1], analysis)
    title = scale_text(estimate)
    if estimate.gsd_m_per_px is not None:
        title += f",  confidence {estimate.confidence:.2f}"
    rows[0].set_title(title, loc="left", fontsize=12)
    return figure


def _plot_lengths(figure: Figure, axes: Axes, analysis: ScaleEvidence) -> None:
    """Plot the lengths, their density, the mode, the guard, and the interval in pixels."""
    vehicles = analysis.vehicles
    assert vehicles is not None
    gsd = vehicles.gsd_m_per_px
    mode = vehicles.mode_length_px
    guard = vehicles.guard_length_px
    assert gsd is not None
    assert mode is not None
    reference_m = vehicles.reference.stated_m
    lengths = analysis.detections.boxes[:, 2]
    shortest_px = float(lengths.min())
    longest_px = float(lengths.max())
    # Twice the longest kept length keeps the cars wide beside a lorry.
    longest_shown = 2 * float(lengths[analysis.kept].max())
    ends = [guard, mode, shortest_px, min(longest_px, longest_shown)]
    if vehicles.interval is not None:
        low_gsd, high_gsd = vehicles.interval
        # A coarse scale belongs to a short length.
        shortest = reference_m / high_gsd
        longest = reference_m / low_gsd
        label = f"95 % interval {shortest:.1f} to {longest:.1f} px"
        _shade_interval(axes, shortest, longest, label)
        ends += [shortest, longest]
    right_px = 1.05 * max(ends)
    axes.set_xlim(0.95 * min(ends), right_px)
    _draw_lengths(axes, analysis, right_px, aggregation=vehicles.aggregation)
    rule = _RULES[vehicles.aggregation]
    mode_label = f"$P_{{mode}}$ {mode:.1f} px ({rule}) = {significant(reference_m)} m"
    axes.axvline(mode, color=_INK, lw=1.6, label=mode_label)
    guard_label = f"resolution guard {guard:.1f} px"
    axes.axvline(guard, color=_GUARD, lw=1.6, ls="--", label=guard_label)
    axes.set_xlabel("vehicle length, pixels")
    axes.set_ylabel("vehicles")
    axes.locator_params(axis="y", integer=True)

    def to_metres(length_px: ArrayLike) -> ArrayLike:
        return np.multiply(length_px, gsd)

    def to_pixels(length_m: ArrayLike) -> ArrayLike:
        return np.divide(length_m, gsd)

    metres = axes.secondary_xaxis("top", functions=(to_metres, to_pixels))
    metres.set_xlabel("metres, at the vehicles' scale")
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(
        handles,
        labels,
        loc="outside lower center",
        ncols=3,
        fontsize=9,
        frameon=False,
    )


def _shade_interval(axes: Axes, low: float, high: float, label: str) -> None:
    axes.axvspan(low, high, color="0.75", alpha=0.4, lw=0, zorder=0, label=label)


def write_plot(path: str | Path, figure: Figure) -> Path:
    """Write a figure as PNG or JPEG.

    Raises:
        OutputError: the folder does not exist, the suffix is unknown, or the file system refuses.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    rgba = np.asarray(canvas.buffer_rgba())
    return write_picture(path, rgba[:, :, :3])


def _draw_lengths(
    axes: Axes, analysis: ScaleEvidence, right_px: float, *, aggregation: Aggregation
) -> None:
    """Draw the histogram of kept and dropped lengths, and the density of the kept ones.

    Args:
        axes: axes with the limits of the lengths.
        analysis: analysis of an image.
        right_px: longest length of the histogram.
        aggregation: rule that finds the mode.
    """
    lengths = analysis.detections.boxes[:, 2]
    kept = lengths[analysis.kept]
    dropped = lengths[~analysis.kept]
    shortest = float(lengths.min())
    longest = min(float(lengths.max()), right_px)
    edges = np.histogram_bin_edges(kept, "auto", (shortest, longest))
    bin_px = edges[1] - edges[0]
    groups = [kept]
    colours = [_KEPT]
    labels = [f"{count(len(kept), 'vehicle')} kept"]
    if len(dropped):
        label = f"{count(len(dropped), 'outlier')} dropped"
        n_beyond = int((dropped > right_px).sum())
        if n_beyond:
            label += f" ({n_beyond} beyond the axis)"
        groups.append(dropped)
        colours.append(_DROPPED)
        labels.append(label)
    axes.hist(
        groups,
        bins=list(edges),
        stacked=True,
        color=colours,
        label=labels,
        edgecolor="white",
        linewidth=0.6,
    )
    _, highest_bar = axes.get_ylim()
    axes.set_ylim(0, _HEADROOM * highest_bar)
    if len(kept) < MIN_KDE_VEHICLES:
        return
    positions = np.linspace(*axes.get_xlim(), _N_CURVE_POINTS)
    scores = analysis.detections.scores[analysis.kept]
    density = modal_density(positions, kept, scores=scores, aggregation=aggregation)
    if not density.any():
        return
    # In the unit of the histogram: vehicles a bin.
    per_bin = density * len(kept) * bin_px
    is_drawn = density > _MIN_DRAWN_LENGTH_SHARE * density.max()
    curve = np.where(is_drawn, per_bin, np.nan)
    label = "density (weighted KDE)" if aggregation == "weighted_kde" else "density (KDE)"
    axes.plot(positions, curve, color=_KEPT_DARK, lw=2, label=label)
    top_of_curve = _HEADROOM * float(np.nanmax(curve))
    _, top = axes.get_ylim()
    axes.set_ylim(0, max(top, top_of_curve))


def plot_rulers(axes: Axes, analysis: ScaleEvidence) -> None:
    """Plot the densities of all witnesses, the posterior, and the interval of the scale.

    Each curve is normalised to its maximum. The label of a witness has its scale and the chance
    that it is right.

    Args:
        axes: axes of a matplotlib figure.
        analysis: analysis of an image with a scale.
    """
    rulers = {ruler.kind: ruler for ruler in analysis.estimate.rulers}
    witnesses = [witness for witness in analysis.witnesses if witness.kind in rulers]
    scales = np.exp(GRID)
    ends: list[float] = []
    for witness in witnesses:
        if witness.interval is not None:
            ends += witness.interval
        _plot_witness(axes, witness, rulers[witness.kind])
    answer = analysis.answer
    if answer is not None:
        label = f"together {significant(answer.gsd_m_per_px)} ({answer.chance:.2f})"
        posterior = answer.density / answer.density.max()
        axes.plot(scales, posterior, color=_INK, lw=2.2, label=label)
        axes.axvline(answer.gsd_m_per_px, color=_INK, lw=1.0, ls=":")
        low, high = answer.interval
        _shade_interval(axes, low, high, f"95 % interval\n{INTERVAL_PREMISE}")
        ends += [low, high]
    axes.set_xscale("log")
    left = max(min(ends) / _PAD_FACTOR, scales[0])
    right = min(max(ends) * _PAD_FACTOR, scales[-1])
    axes.set_xlim(left, right)
    axes.set_ylim(0, 1.08)
    axes.set_yticks([])
    axes.set_xlabel("metres per pixel; each curve is drawn to its own height")
    ticks = _ticks(*axes.get_xlim())
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    axes.legend(
        loc="upper left",
        bbox_to_anchor=(1.0, 1.0),
        fontsize=9,
        frameon=False,
    )


def _plot_witness(axes: Axes, witness: Witness, ruler: RulerScale) -> None:
    scales = np.exp(GRID)
    colour = ruler_class(witness.kind).colour
    curve = witness.density / witness.density.max()
    shown = np.where(curve > _MIN_DRAWN_SHARE, curve, 0.0)
    style = "-" if ruler.probably_right else "--"
    label = f"{ruler.label} {significant(ruler.gsd_m_per_px)} (right: {ruler.p_right:.2f})"
    axes.fill_between(scales, shown, color=colour, alpha=0.18, lw=0)
    axes.plot(scales, shown, color=colour, lw=1.6, ls=style, label=label)


def _ticks(low: float, high: float) -> list[float]:
    """Choose round scales between two ends, in finer steps on a narrow axis."""
    decades = 10.0 ** np.arange(-4, 2)
    for digits in _TICK_DIGITS:
        scales = [float(digit * decade) for decade in decades for digit in digits]
        ticks = sorted(round(scale, 6) for scale in scales)
        inside = [tick for tick in ticks if low <= tick <= high]
        if len(inside) >= _MIN_TICKS:
            break
    step = max(1, len(inside) // _MAX_TICKS)
    return inside[::step]
