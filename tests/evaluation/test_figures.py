from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from tests.analyses import make_analysis
from tests.models import blank_image, paint_vehicles, write_detector
from vehanchor.cli import app as cli
from vehanchor_evaluation.figures import (
    interval_coverage,
    plot_cumulative_error,
    plot_predicted,
    sheet_trials,
)
from vehanchor_evaluation.gsd import ScaleTrial
from vehanchor_evaluation.known_scale import KnownScaleImage


def _trial(length_px: float, truth: float, n: int = 12) -> ScaleTrial:
    boxes = np.array([[20 + 60 * k, 30, length_px, 10, 0.0] for k in range(n)]).reshape(-1, 5)
    return ScaleTrial(KnownScaleImage(Path("a.png"), truth), make_analysis(boxes, 800, 60))


def test_the_prediction_is_plotted_with_band_guard_and_misses() -> None:
    trials = [_trial(25, 0.2), _trial(40, 0.126), _trial(14, 0.5), _trial(20, 0.3, n=0)]
    figure = plot_predicted(trials)
    (axes,) = figure.axes
    guard = next(line for line in axes.lines if str(line.get_label()).startswith("resolution guard"))
    assert np.asarray(guard.get_ydata())[0] == pytest.approx(0.3)
    points = np.concatenate([np.asarray(c.get_offsets()) for c in axes.collections if "usable" in str(c.get_label())])
    expected = [[t.image.gsd_m_per_px, t.analysis.estimate.gsd_m_per_px] for t in trials[:3]]
    assert sorted(points.tolist()) == sorted(expected)
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert "no estimate (1)" in texts


def test_the_cumulative_error_never_reaches_one_with_misses() -> None:
    trials = [_trial(25, 5.045 / 25 * 1.1), _trial(25, 5.045 / 25), _trial(25, 0.2, n=0), _trial(25, 0.2, n=0)]
    (axes,) = plot_cumulative_error({"detector": trials, "labels": trials[:2], "nothing": []}).axes
    curve = next(line for line in axes.lines if str(line.get_label()).startswith("detector"))
    errors, share = (np.asarray(values) for values in (curve.get_xdata(), curve.get_ydata()))
    assert share.max() == 0.5
    assert share[errors <= 5].max() == 0.25
    assert errors[share >= 0.5][0] == pytest.approx(100 * (1 - 1 / 1.1), abs=0.25)


def test_the_coverage_of_the_interval_is_counted_at_every_level() -> None:
    trials = [_trial(25, 0.2018 * factor) for factor in (1.0, 1.1, 1 / 1.1, 3.0)]
    levels = np.array([0.0, 0.5, 0.95, 0.999999])
    observed = interval_coverage(trials, levels)
    assert observed[2] == np.mean([bool(trial.covered) for trial in trials]) == 0.75
    assert (np.diff(observed) >= 0).all()
    assert observed[0] <= 0.25
    assert observed[3] == 0.75  # three times the scale is out of reach


def test_the_sheet_holds_each_image_once() -> None:
    trials = [_trial(25, 5.045 / 25 * (1 + k / 50)) for k in range(10)] + [_trial(25, 0.2, n=0)]
    chosen = sheet_trials(trials)
    assert [len(row) for row in chosen.values()] == [3, 3, 3]
    assert {name: [trials.index(t) for t in row] for name, row in chosen.items()} == {
        "best": [0, 1, 2], "median": [3, 4, 5], "worst": [7, 8, 9]
    }  # fmt: skip
    assert {name: len(row) for name, row in sheet_trials(trials[:2]).items()} == {"best": 2}


def test_the_command_draws_all_figures(tmp_path: Path) -> None:
    lines = ["file,gsd_m_per_px"]
    for index in range(3):
        image = blank_image(480, 240)
        paint_vehicles(image, [[40 + 70 * (k % 6), 50 + 60 * (k // 6), 25, 12, 0.3] for k in range(12)])
        cv2.imwrite(str(tmp_path / f"{index}.png"), image[:, :, ::-1])
        lines.append(f"{index}.png,{0.2 + 0.02 * index}")
    (tmp_path / "t.csv").write_text("\n".join(lines))
    arguments = ["--table", tmp_path / "t.csv", "--detector", write_detector(tmp_path / "m.onnx")]
    result = CliRunner().invoke(cli.app, ["evaluate", "figures", *map(str, arguments), "--out", str(tmp_path / "out")])
    assert result.exit_code == 0, result.stderr
    for name in ("predicted", "cumulative", "calibration", "sheet"):
        picture = cv2.imread(str(tmp_path / "out" / f"{name}.png"))
        assert picture is not None
        assert picture.std() > 10
        assert f"{name}.png" in result.stderr
