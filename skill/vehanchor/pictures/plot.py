"""The estimate as a plot: vehicle lengths, their density, the mode, the guard and the interval (extra ``plots``)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vehanchor.errors import MissingExtraError
from vehanchor.pictures.scale import write_picture
from vehanchor.scale.lengths import MIN_KDE_VEHICLES, modal_density

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from vehanchor.estimate import ScaleAnalysis

__all__ = ["plot_scale", "require_plots", "write_plot"]

_KEPT, _KEPT_DARK, _DROPPED = "#56B4E9", "#0072B2", "#E69F00"  # Okabe and Ito: blues, orange
_GUARD, _INK = "#D55E00", "#222222"
_SIZE_IN, _DPI = (8.0, 4.6), 150
_MAX_BINS = 60
_SHOWN_LENGTHS = 2.0  # longest kept vehicles: the axis reaches no farther for outliers
_RULES = {"kde": "KDE", "weighted_kde": "weighted KDE", "median": "median", "mean": "mean"}


def require_plots() -> type[Figure]:
    """The one place that imports matplotlib, without its global state.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtraError("plots need matplotlib: pip install 'vehanchor[plots]'") from error
    return Figure


def plot_scale(analysis: ScaleAnalysis) -> Figure:
    """Plot how vehicle lengths became a scale.

    Args:
        analysis: what to plot.

    Returns:
        A matplotlib figure that belongs to no global state.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    figure = require_plots()(figsize=_SIZE_IN, dpi=_DPI, layout="constrained")
    axes = figure.add_subplot()
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    estimate = analysis.estimate
    if estimate.gsd_m_per_px is None or estimate.mode_length_px is None:
        axes.set_axis_off()
        words = "no scale: no vehicle found" if estimate.gsd_m_per_px is None else "no vehicle found"
        axes.text(0.5, 0.5, words, ha="center", va="center", fontsize=14, color=_INK)
        return figure
    gsd, mode = estimate.gsd_m_per_px, estimate.mode_length_px
    guard = analysis.guard_length_px
    lengths = analysis.detections.boxes[:, 2]
    ends, interval = [guard, mode, float(lengths.min()), float(lengths.max())], ""
    if estimate.gsd_ci95_low_m_per_px is not None and estimate.gsd_ci95_high_m_per_px is not None:
        low, high = (
            estimate.reference_length_m / scale
            for scale in (estimate.gsd_ci95_high_m_per_px, estimate.gsd_ci95_low_m_per_px)
        )
        axes.axvspan(
            low, high, color="0.75", alpha=0.4, lw=0, zorder=0, label=f"95 % interval {low:.1f} to {high:.1f} px"
        )
        interval = f" (95 %: {estimate.gsd_ci95_low_m_per_px:.4g} to {estimate.gsd_ci95_high_m_per_px:.4g})"
        ends += [low, high]
    longest_kept = float(lengths[analysis.kept].max())
    shown = min(max(ends), max(_SHOWN_LENGTHS * longest_kept, guard, *ends[4:]))  # one lorry must not squeeze the cars
    pad = 0.04 * (shown - min(ends))
    left, right = max(0.0, min(ends) - pad), shown + pad
    axes.set_xlim(left, right)
    _draw_lengths(axes, analysis, right)
    rule = f"$P_{{mode}}$ {mode:.1f} px ({_RULES[estimate.aggregation]}) = {estimate.reference_length_m:.3g} m"
    axes.axvline(mode, color=_INK, lw=1.6, label=rule)
    axes.axvline(guard, color=_GUARD, lw=1.6, ls="--", label=f"resolution guard {guard:.1f} px")
    axes.set_xlabel("vehicle length, pixels")
    axes.set_ylabel("vehicles")
    axes.locator_params(axis="y", integer=True)
    metres = axes.secondary_xaxis("top", functions=(lambda px: np.multiply(px, gsd), lambda m: np.divide(m, gsd)))
    metres.set_xlabel("metres, at the estimated scale")
    axes.set_title(f"{gsd:.4g} m/px{interval},  confidence {estimate.confidence:.2f}", loc="left", fontsize=12)
    figure.legend(loc="outside lower center", ncols=3, fontsize=9, frameon=False)
    return figure


def write_plot(path: str | Path, figure: Figure) -> Path:
    """Write a figure as PNG or JPEG.

    Raises:
        OutputError: the folder does not exist, the suffix is unknown, or the file system refuses.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    return write_picture(path, np.asarray(canvas.buffer_rgba())[:, :, :3])


def _bin_edges(kept: NDArray[np.float64], shortest: float, longest: float) -> NDArray[np.float64]:
    """Bins of one width: Freedman and Diaconis' for the kept, whole quarter pixels, centred on multiples."""
    quartiles = np.percentile(kept, [25, 75])
    ideal = 2 * float(quartiles[1] - quartiles[0]) / np.cbrt(len(kept))
    width = max(0.25, round(4 * max(ideal, (longest - shortest) / _MAX_BINS, float(np.median(kept)) / 50)) / 4)
    first = (round(shortest / width) - 0.5) * width
    return np.asarray(first + width * np.arange(max(1, int(np.ceil((longest - first) / width))) + 1))


def _draw_lengths(axes: Axes, analysis: ScaleAnalysis, right_px: float) -> None:
    """Histogram of kept and dropped, and the density of the kept in the histogram's units."""
    lengths = analysis.detections.boxes[:, 2]
    kept, dropped = lengths[analysis.kept], lengths[~analysis.kept]
    edges = _bin_edges(kept, float(lengths.min()), min(float(lengths.max()), right_px))
    groups, colours, labels = [kept], [_KEPT], [f"{len(kept)} vehicle{'s' * (len(kept) != 1)} kept"]
    if len(dropped):
        n_beyond = int((dropped > right_px).sum())
        beyond = f" ({n_beyond} beyond the axis)" if n_beyond else ""
        groups, colours = [*groups, dropped], [*colours, _DROPPED]
        labels.append(f"{len(dropped)} outlier{'s' * (len(dropped) != 1)} dropped{beyond}")
    axes.hist(groups, bins=list(edges), stacked=True, color=colours, label=labels, edgecolor="white", linewidth=0.6)
    axes.set_ylim(0, 1.12 * axes.get_ylim()[1])
    if len(kept) < MIN_KDE_VEHICLES:
        return
    at = np.linspace(*axes.get_xlim(), 800)
    aggregation = analysis.estimate.aggregation
    density = modal_density(at, kept, analysis.detections.scores[analysis.kept], aggregation)
    if density.any():
        curve = np.where(density > 1e-3 * density.max(), density * len(kept) * (edges[1] - edges[0]), np.nan)
        label = "density (weighted KDE)" if aggregation == "weighted_kde" else "density (KDE)"
        axes.plot(at, curve, color=_KEPT_DARK, lw=2, label=label)
        axes.set_ylim(0, max(axes.get_ylim()[1], 1.12 * float(np.nanmax(curve))))
