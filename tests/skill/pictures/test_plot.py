from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.analyses import analyse_found, made_card, make_analysis
from vehanchor.analysis.scale import ScaleAnalysis
from vehanchor.detection.detections import Detections
from vehanchor.errors import MissingExtraError
from vehanchor.options import ScaleOptions
from vehanchor.pictures.plot import plot_scale, write_plot
from vehanchor.scale.defaults import Aggregation
from vehanchor.scale.lengths import kde_density

pytest.importorskip("matplotlib")


def _boxes(lengths: NDArray[np.float64] | list[float]) -> NDArray[np.float64]:
    return np.array([[50.0, 50.0, length, 10.0, 0.0] for length in lengths]).reshape(-1, 5)


def _labels(figure: object) -> str:
    legend = figure.legends[0]  # type: ignore[attr-defined]
    return "\n".join(text.get_text() for text in legend.get_texts())


def test_the_plot_shows_mode_guard_interval_and_both_kinds_of_vehicles() -> None:
    lengths = [*np.random.default_rng(0).normal(30, 2, 60), 80.0, 300.0]
    analysis = make_analysis(_boxes(lengths), 800, 600)
    figure = plot_scale(analysis)
    text = _labels(figure)
    mode = analysis.estimate.mode_length_px
    assert mode is not None
    assert f"{mode:.1f} px (KDE) = 5.04 m" in text or f"{mode:.1f} px (KDE) = 5.05 m" in text
    assert "resolution guard 16.8 px" in text
    assert "95 % interval" in text
    assert "60 vehicles kept" in text
    assert "2 outliers dropped (1 beyond the axis)" in text or "2 outliers dropped (2 beyond the axis)" in text
    left, right = figure.axes[0].get_xlim()
    assert left < 5.045 / 0.3 < right < 120  # the guard is visible, one lorry does not squeeze the cars


def test_the_curve_is_the_density_of_the_kept_lengths() -> None:
    lengths = np.random.default_rng(1).normal(40, 3, 80)
    figure = plot_scale(make_analysis(_boxes(lengths), 800, 600))
    axes = figure.axes[0]
    curve = next(line for line in axes.lines if np.size(line.get_xdata()) > 2)
    at, drawn = np.asarray(curve.get_xdata()), np.asarray(curve.get_ydata())
    shown = np.isfinite(drawn)
    bars = [patch for patch in axes.patches if patch.get_height() > 0 and patch.get_width() < 5]  # type: ignore[attr-defined]
    bin_px = float(np.median([bar.get_width() for bar in bars]))  # type: ignore[attr-defined]
    assert drawn[shown] == pytest.approx(kde_density(at, lengths)[shown] * len(lengths) * bin_px)
    assert sum(bar.get_height() for bar in bars) == len(lengths)  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("lengths", "aggregation", "rule"),
    [
        ([30.0], "kde", "median"),
        ([30.0, 31.0, 32.0], "weighted_kde", "median"),
        ([30.0] * 9, "kde", "KDE"),
        ([30.0, 31, 32, 33, 34, 35], "weighted_kde", "weighted KDE"),
        ([30.0, 31, 32, 33, 34, 35], "mean", "mean"),
        ([3.0, 3.01, 3.02, 3.0, 3.0, 3.1], "median", "median"),
        (list(np.linspace(900, 1000, 40)), "kde", "KDE"),
    ],
)
def test_every_aggregation_and_any_number_of_vehicles_can_be_drawn(
    tmp_path: Path, lengths: list[float], aggregation: Aggregation, rule: str
) -> None:
    figure = plot_scale(make_analysis(_boxes(lengths), 800, 600, aggregation=aggregation))
    assert f"({rule})" in _labels(figure)
    write_plot(tmp_path / "plot.png", figure)


def test_matplotlib_is_loaded_on_demand_and_without_global_state(tmp_path: Path) -> None:
    code = """
import sys
import numpy as np
from tests.analyses import analyse_found, made_card, make_analysis
from vehanchor.detection.detections import Detections
from vehanchor.pictures.plot import plot_scale, write_plot
assert "matplotlib" not in sys.modules
figure = plot_scale(make_analysis(np.array([[5.0, 5, 30, 10, 0]]), 100, 100))
write_plot(sys.argv[1], figure)
assert "matplotlib" in sys.modules and "matplotlib.pyplot" not in sys.modules
"""
    root = Path(__file__).parents[3]
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "p.png")], check=True, cwd=root)


def test_without_matplotlib_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'vehanchor\[plots\]'"):
        plot_scale(make_analysis(_boxes([30.0]), 100, 100))


def _with_line(n: int, metres: float) -> ScaleAnalysis:
    boxes = _boxes(list(np.random.default_rng(1).normal(30, 2, n)))
    return analyse_found(
        Detections(boxes, np.full(n, 0.8)),
        made_card(),
        ScaleOptions.of({"known_lengths": [(0, 0, 500, 0, metres, "measured")]}),
        image_width_px=800,
        image_height_px=600,
    )


@pytest.mark.parametrize("n", [0, 30])
def test_the_densities_of_all_rulers_and_of_all_together_share_one_axis(n: int, tmp_path: Path) -> None:
    analysis = _with_line(n, 84.0)
    figure = plot_scale(analysis)
    axes = figure.axes[-1] if n == 0 else figure.axes[1]
    legend = axes.get_legend()
    assert legend is not None
    names = [text.get_text().partition(" (")[0] for text in legend.get_texts()]
    assert names[-3:] == ["known length 0.168", "together 0.168", "95 % interval"]
    assert [name.split()[0] for name in names[:-3]] == ["vehicles"] * (n > 0)
    low, high = axes.get_xlim()
    estimate = analysis.estimate
    assert estimate.gsd_ci95_low_m_per_px is not None
    assert estimate.gsd_ci95_high_m_per_px is not None
    assert low < estimate.gsd_ci95_low_m_per_px < estimate.gsd_ci95_high_m_per_px < high
    together = next(line for line in axes.lines if str(line.get_label()).startswith("together 0.168"))
    at, curve = np.asarray(together.get_xdata()), np.asarray(together.get_ydata())
    assert at[curve.argmax()] == pytest.approx(estimate.gsd_m_per_px, rel=0.01)
    assert write_plot(tmp_path / "plot.png", figure).stat().st_size > 10_000


def test_a_ruler_that_is_probably_wrong_is_dashed_in_the_plot() -> None:
    lines = plot_scale(_with_line(30, 840.0)).axes[1].lines
    dashed = [str(line.get_label()) for line in lines if line.get_linestyle() == "--"]
    assert dashed
    assert all("(right: 0." in label for label in dashed)


def test_without_an_anchor_the_plot_says_so(tmp_path: Path) -> None:
    figure = plot_scale(make_analysis(np.zeros((0, 5)), 800, 600))
    assert "no scale" in figure.axes[0].texts[0].get_text()
    write_plot(tmp_path / "plot.jpg", figure)
