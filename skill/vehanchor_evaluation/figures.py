"""Figures of a scale benchmark: predicted and true GSD, errors, calibration, a sheet of images."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import cv2
import numpy as np

from vehanchor.imagery.raster import Window
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.pictures.placement import Placement
from vehanchor.pictures.plot import require_plots
from vehanchor.pictures.scale import caption_panel, draw_vehicles, fit_for_eyes, read_reduced
from vehanchor.records.text import count
from vehanchor.scale.calibration import weighted_lengths_m
from vehanchor.scale.lengths import GUARD_GSD_M_PER_PX, Z95, kde_density
from vehanchor_evaluation.gsd import HIGH_ERROR
from vehanchor_evaluation.known_scale import DATASET_READING

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from vehanchor.scale.calibration import Calibration, SurveyedImage
    from vehanchor_evaluation.gsd import ScaleTrial

    Shares: TypeAlias = NDArray[np.float64]
    """Levels or shares ``[k]`` in 0..1."""

    Gsds: TypeAlias = NDArray[np.float64]
    """Metres per pixel ``[n]`` of images."""

    Lengths: TypeAlias = NDArray[np.float64]
    """Lengths ``[n]`` of vehicles, metres."""

    Picture: TypeAlias = NDArray[np.uint8]
    """RGB picture ``[h, w, 3]``."""

# Colours of Okabe and Ito, which colour-blind readers can distinguish.
_BLUE = "#0072B2"
_ORANGE = "#E69F00"
_GREEN = "#009E73"
_RED = "#D55E00"
_INK = "#222222"
_GREY = "0.6"
_DPI = 150
# The paper's band around the true GSD: +-10 %.
_BAND = 0.10
# Larger median errors are drawn as this one.
_MAX_ERROR = 1.0
_CONFIDENCE_BINS = np.linspace(0.0, 1.0, 6)
# Side of a picture in the sheet, pictures of a row, and the gap between pictures.
_CELL_PX = 640
_CELLS_OF_ROW = 3
_GAP_PX = 12


def plot_predicted(trials: Sequence[ScaleTrial]) -> Figure:
    """Plot predicted against true GSD with the +-10 % band and the resolution guard.

    Args:
        trials: trials of the detector; images without an estimate are marked at the lower edge.

    Returns:
        A figure for ``vehanchor.pictures.plot.write_plot``.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    figure = _new_figure(7.0, 7.2)
    axes = _without_frame(figure.add_subplot())
    estimated = [trial for trial in trials if trial.estimated]
    missed = [trial.image.gsd_m_per_px for trial in trials if not trial.estimated]
    truth = np.array([trial.image.gsd_m_per_px for trial in estimated])
    predicted = _predicted_gsd(estimated)
    guard = _guard_gsd(estimated)

    # Both axes share their ends, so that a correct estimate lies on the diagonal.
    values = np.concatenate([truth, predicted, missed, [guard]])
    low = float(values.min()) / 1.25
    high = float(values.max()) * 1.25
    ends = np.array([low, high])
    below = ends * (1 - _BAND)
    above = ends * (1 + _BAND)
    axes.fill_between(ends, below, above, color=_GREEN, alpha=0.18, lw=0, label="\u00b110 %")
    axes.plot(ends, ends, color=_GREEN, lw=1.2)
    guard_label = f"resolution guard {guard:.2g} m/px"
    axes.axhline(guard, color=_RED, ls="--", lw=1.4, label=guard_label)

    is_usable = np.array([trial.usable for trial in estimated], dtype=bool)
    groups = ((is_usable, _BLUE, "usable"), (~is_usable, _ORANGE, "not usable"))
    for group, colour, name in groups:
        label = f"{name} ({int(group.sum())})"
        axes.scatter(
            truth[group],
            predicted[group],
            s=18,
            color=colour,
            alpha=0.7,
            lw=0,
            label=label,
        )
    if missed:
        label = f"no estimate ({len(missed)})"
        at_edge = np.full(len(missed), low)
        axes.scatter(missed, at_edge, marker="|", s=60, color=_INK, clip_on=False, label=label)
    limits = (low, high)
    axes.set(xscale="log", yscale="log", xlim=limits, ylim=limits, aspect="equal")
    _plain_log(axes)
    axes.set_xlabel("true GSD, m/px")
    axes.set_ylabel("predicted GSD, m/px")
    figure.legend(loc="outside lower center", ncols=3, fontsize=9, frameon=False)
    return figure


def _predicted_gsd(trials: Sequence[ScaleTrial]) -> Gsds:
    """List the estimates; NaN for a trial without one."""
    estimates = [trial.analysis.estimate for trial in trials]
    return np.array([estimate.gsd_m_per_px or np.nan for estimate in estimates])


def _guard_gsd(trials: Sequence[ScaleTrial]) -> float:
    """Compute the predicted GSD above which the resolution guard applies.

    This is 0.3 m/px, or less if the detector needs longer vehicles.
    """
    measurements = [trial.analysis.vehicles for trial in trials]
    limits = [
        vehicles.reference.length_m / vehicles.guard_length_px
        for vehicles in measurements
        if vehicles is not None
    ]
    if not limits:
        return GUARD_GSD_M_PER_PX
    return float(np.median(limits))


def plot_cumulative_error(curves: Mapping[str, Sequence[ScaleTrial]]) -> Figure:
    """Plot the share of images below an error for each kind of boxes.

    Images without an estimate count as errors.

    Args:
        curves: trials by name.

    Returns:
        A figure.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    figure = _new_figure(7.0, 4.6)
    axes = _without_frame(figure.add_subplot())
    colours = (_BLUE, _ORANGE, _GREEN, _RED)
    for (name, trials), colour in zip(curves.items(), colours, strict=False):
        estimated = [trial for trial in trials if trial.estimated]
        errors = np.sort([abs(trial.signed_error) for trial in estimated])
        ranks = np.arange(1, len(errors) + 1)
        shares = ranks / max(1, len(trials))
        # The curve stays level from the last error to 100 %.
        last_share = shares[-1] if len(shares) else 0
        label = f"{name} ({len(errors)} of {len(trials)})"
        percents = [0, *errors * 100, 100]
        heights = [0, *shares, last_share]
        axes.step(percents, heights, where="post", color=colour, lw=1.8, label=label)
    for error in (10, 20):
        axes.axvline(error, color=_GREY, lw=0.8, ls=":")
    axes.set(xlim=(0, 60), ylim=(0, 1))
    axes.set_xlabel("error of the scale, %")
    axes.set_ylabel("share of images")
    axes.legend(frameon=False, fontsize=9, loc="lower right")
    return figure


def interval_coverage(trials: Sequence[ScaleTrial], nominal: Shares) -> Shares:
    """Compute the observed coverage at other levels than 95 % by scaling the lognormal intervals.

    Args:
        trials: at least one trial, all with an estimate.
        nominal: ``[k]`` levels in 0..1.

    Returns:
        ``[k]`` share of trials whose true GSD lies in the interval of each level.
    """
    from scipy.stats import norm

    estimates = [trial.analysis.estimate for trial in trials]
    gsd = _predicted_gsd(trials)
    high = np.array([estimate.gsd_ci95_high_m_per_px or np.nan for estimate in estimates])
    # The 95 % interval reaches Z95 standard deviations of the log GSD; this is the error in them.
    log_reach = np.log(high / gsd)
    signed_errors = [trial.signed_error for trial in trials]
    log_error = np.abs(np.log1p(signed_errors))
    error_in_sd = log_error / log_reach * Z95
    upper_quantile = (1 + np.asarray(nominal)) / 2
    level_in_sd = norm.ppf(upper_quantile)
    is_covered = error_in_sd[None, :] <= level_in_sd[:, None]
    return np.asarray(is_covered.mean(axis=1))


def plot_calibration(trials: Sequence[ScaleTrial]) -> Figure:
    """Plot the calibration of interval and confidence.

    Left: observed against nominal coverage of the interval. Right: median error and share of errors
    above 20 %, by bins of confidence.

    Args:
        trials: trials of the detector; images without an estimate are ignored.

    Returns:
        A figure.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    figure = _new_figure(10.0, 4.6)
    left, right = figure.subplots(1, 2)
    _without_frame(left)
    _without_frame(right)
    estimated = [trial for trial in trials if trial.estimated]
    nominal = np.linspace(0.0, 0.99, 100)
    left.plot([0, 1], [0, 1], color=_GREY, lw=1, ls="--", label="ideal")
    if estimated:
        observed = interval_coverage(estimated, nominal)
        label = count(len(estimated), "image")
        left.plot(nominal, observed, color=_BLUE, lw=2, label=label)
    left.axvline(0.95, color=_GREY, lw=0.8, ls=":")
    left.set(xlim=(0, 1), ylim=(0, 1), aspect="equal")
    left.set_xlabel("nominal coverage of the interval")
    left.set_ylabel("observed coverage")
    left.legend(frameon=False, fontsize=9, loc="upper left")
    _confidence_bars(right, estimated)
    return figure


def _confidence_bars(axes: Axes, trials: Sequence[ScaleTrial]) -> None:
    """Draw median error and share of errors above 20 % side by side for each bin of confidence."""
    confidence = np.array([trial.confidence for trial in trials])
    errors = np.array([trial.error for trial in trials])
    n_bins = len(_CONFIDENCE_BINS) - 1
    # A confidence of 1 belongs to the last bin.
    bins = np.digitize(confidence, _CONFIDENCE_BINS) - 1
    bins = np.clip(bins, 0, n_bins - 1)
    width = 0.4
    median_label: str | None = "median error, %"
    high_label: str | None = "share of errors > 20 %"
    for index in range(n_bins):
        in_bin = errors[bins == index]
        if not len(in_bin):
            continue
        high = 100 * float((in_bin > HIGH_ERROR).mean())
        median_error = float(np.median(in_bin))
        median = 100 * min(median_error, _MAX_ERROR)
        axes.bar(index - width / 2, median, width, color=_BLUE, label=median_label)
        axes.bar(index + width / 2, high, width, color=_ORANGE, label=high_label)
        # Only the first bars enter the legend.
        median_label = None
        high_label = None
        axes.annotate(
            f"n = {len(in_bin)}",
            (index, max(high, median)),
            xytext=(0, 3),
            textcoords="offset points",
            ha="center",
            fontsize=8,
        )
    names = [f"{low:.1f} to {high:.1f}" for low, high in pairwise(_CONFIDENCE_BINS)]
    axes.set_xticks(range(len(names)), names)
    axes.set_xlim(-0.6, len(names) - 0.4)
    axes.set_xlabel("confidence")
    axes.set_ylabel("%")
    if len(trials):
        axes.legend(frameon=False, fontsize=9, loc="upper right")


def plot_reference_length(images: Sequence[SurveyedImage], calibration: Calibration) -> Figure:
    """Plot a calibration: the lengths in metres, their density, the mode and its interval.

    Args:
        images: vehicles and true scales.
        calibration: the calibration from them.

    Returns:
        A figure.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    figure = _new_figure(8.0, 4.6)
    axes = _without_frame(figure.add_subplot())
    metres, weights, smoothing = weighted_lengths_m(images)
    mode = calibration.reference_length_m
    low, high = _length_limits(metres, mode)
    shown = metres[(metres >= low) & (metres <= high)]
    # The root of the number balances detail against noise.
    n_bins = 2 * np.sqrt(len(shown))
    n_bins = int(np.clip(n_bins, 12, 80))
    edges = np.linspace(low, high, n_bins + 1)
    axes.hist(
        shown,
        bins=list(edges),
        color="#56B4E9",
        edgecolor="white",
        linewidth=0.5,
        label=count(len(metres), "vehicle"),
    )
    # The density is scaled to vehicles per bin, so that it fits the histogram.
    lengths = np.linspace(low, high, 800)
    density = kde_density(lengths, metres, weights, smoothing=smoothing)
    bin_width = edges[1] - edges[0]
    density = density * len(metres) * bin_width
    axes.plot(lengths, density, color=_BLUE, lw=2, label="density (KDE)")
    ci95_low = calibration.reference_length_ci95_low_m
    ci95_high = calibration.reference_length_ci95_high_m
    interval = f"95 % interval {ci95_low:.3f} to {ci95_high:.3f} m"
    axes.axvspan(ci95_low, ci95_high, color="0.75", alpha=0.5, lw=0, zorder=0, label=interval)
    axes.axvline(mode, color=_INK, lw=1.6, label=f"mode {mode:.3f} m")
    axes.set_xlim(low, high)
    axes.set_xlabel("vehicle length, metres")
    axes.set_ylabel("vehicles")
    title = count(calibration.n_images, "image")
    n_beyond = len(metres) - len(shown)
    if n_beyond:
        title += f", {n_beyond} beyond the axis"
    axes.set_title(title, loc="left", fontsize=11)
    axes.legend(frameon=False, fontsize=9)
    return figure


def _length_limits(metres: Lengths, mode: float) -> tuple[float, float]:
    """Choose an axis without extreme lengths that always shows the surroundings of the mode."""
    low, high = np.percentile(metres, [0.5, 99.5])
    low = min(low, 0.6 * mode)
    high = min(high, 2.5 * mode)
    return max(0.0, low), max(high, 1.4 * mode)


def _new_figure(width_in: float, height_in: float) -> Figure:
    """Create an empty figure; its size is in inches.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    figure_class = require_plots()
    return figure_class(figsize=(width_in, height_in), dpi=_DPI, layout="constrained")


def _without_frame(axes: Axes) -> Axes:
    """Hide the upper and the right edge of the frame."""
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    return axes


def _plain_log(axes: Axes) -> None:
    """Label logarithmic axes with ticks such as 0.1, 0.2, 0.5 instead of powers of ten."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    for axis in (axes.xaxis, axes.yaxis):
        locator = LogLocator(subs=(1.0, 2.0, 5.0))
        axis.set_major_locator(locator)
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_locator(NullLocator())


# --- The sheet of images


class SheetCell(NamedTuple):
    """Cell of a sheet.

    Attributes:
        picture: ``[h, w, 3]`` RGB.
        lines: lines of text below it, the first in bold.
    """

    picture: Picture
    lines: tuple[str, ...]


def sheet_trials(trials: Sequence[ScaleTrial]) -> dict[str, tuple[ScaleTrial, ...]]:
    """Select the best, the middle and the worst estimates without repetition."""
    estimated = [trial for trial in trials if trial.estimated]
    ordered = sorted(estimated, key=lambda trial: trial.error)
    n_row = min(_CELLS_OF_ROW, len(ordered) // 3)
    if not n_row:
        return {"best": tuple(ordered)}
    start = (len(ordered) - n_row) // 2
    return {
        "best": tuple(ordered[:n_row]),
        "median": tuple(ordered[start : start + n_row]),
        "worst": tuple(ordered[-n_row:]),
    }


def sheet_cell(trial: ScaleTrial) -> SheetCell:
    """Draw an image with its vehicles, error and confidence.

    Raises:
        ImageError: the image can no longer be read.
    """
    estimate = trial.analysis.estimate
    with open_raster(trial.image.path, DATASET_READING) as raster:
        picture = fit_for_eyes(read_reduced(raster))
    width_px = estimate.image_width_px
    height_px = estimate.image_height_px
    whole = Window(0, 0, width_px=width_px, height_px=height_px)
    placement = Placement.of(picture, whole)
    draw_vehicles(picture, trial.analysis, placement)
    vehicles = count(estimate.n_vehicles or 0, "vehicle")
    true_gsd = trial.image.gsd_m_per_px
    # OpenCV draws ASCII only.
    name_end = trial.image.path.name[-48:]
    name = name_end.encode("ascii", "replace").decode()
    lines = (
        f"error {100 * trial.signed_error:+.1f} %",
        f"{estimate.gsd_m_per_px:.3g} m/px, true {true_gsd:.3g}",
        f"{vehicles}, confidence {estimate.confidence:.2f}",
        name,
    )
    return SheetCell(picture, lines)


def draw_sheet(rows: Sequence[Sequence[SheetCell]]) -> Picture:
    """Arrange cells in rows, each picture above its text.

    Args:
        rows: rows of cells, of any lengths.

    Returns:
        ``[h, w, 3]`` RGB.
    """
    n_columns = max((len(row) for row in rows), default=0)
    width = n_columns * (_CELL_PX + _GAP_PX) + _GAP_PX
    strips = [_blank(_GAP_PX, width, level=255)]
    for row in rows:
        cells = [_draw_cell(cell) for cell in row]
        heights = [len(cell) for cell in cells]
        height = max(heights, default=0)
        strip = _blank(height + _GAP_PX, width, level=255)
        for column, cell in enumerate(cells):
            left = _GAP_PX + column * (_CELL_PX + _GAP_PX)
            strip[: len(cell), left : left + _CELL_PX] = cell
        strips.append(strip)
    return np.concatenate(strips)


def _draw_cell(cell: SheetCell) -> Picture:
    """Draw a picture fitted into a square, with its text below."""
    height, width = cell.picture.shape[:2]
    factor = _CELL_PX / max(height, width)
    new_width = max(1, round(width * factor))
    new_height = max(1, round(height * factor))
    # The mean over an area avoids moire in a reduced picture; a cubic keeps an enlarged one smooth.
    method = cv2.INTER_CUBIC
    if factor < 1:
        method = cv2.INTER_AREA
    new_size = (new_width, new_height)
    resized = cv2.resize(cell.picture, new_size, interpolation=method)
    square = _blank(_CELL_PX, _CELL_PX, level=235)
    top = (_CELL_PX - new_height) // 2
    left = (_CELL_PX - new_width) // 2
    square[top : top + new_height, left : left + new_width] = resized
    # No line has a colour of its own.
    caption = caption_panel(_CELL_PX, [[(None, line)] for line in cell.lines])
    return np.concatenate([square, caption])


def _blank(height: int, width: int, level: int) -> Picture:
    """Return a picture of one grey level, 0 to 255."""
    return np.full((height, width, 3), level, np.uint8)
