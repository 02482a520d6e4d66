"""Reliability at home: chances against outcomes, groups, and the limit of the confidence that leaves 1 % wrong."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from tests.analyses import made_card
from vehanchor.analysis.pipeline import analyse_view
from vehanchor.cli import app as cli
from vehanchor.detection.detections import Detections
from vehanchor.imagery.facts import ImageFacts
from vehanchor.options import ScaleOptions
from vehanchor.rulers.ruler import View
from vehanchor.scale.votes import Votes
from vehanchor_evaluation.gsd import ScaleTrial
from vehanchor_evaluation.known_scale import KnownScaleImage
from vehanchor_evaluation.reliability import confidence_threshold, report_reliability, upper_bound
from vehanchor_evaluation.report import reliability_markdown

VOTES = Votes(share_at_zero=-13.76, share_slope=17.4)


def _trial(true_gsd: float, cars: int) -> ScaleTrial:
    """Cars of 50 px and 5 m: 0.1 m/px."""
    boxes = np.array([[99.0 + 90 * k, 90, 50.0, 20.0, 0] for k in range(cars)]).reshape(-1, 5)
    card = made_card(5.0).model_copy(update={"votes": VOTES})
    found = Detections(boxes, np.full(cars, 0.9))
    view = View(ImageFacts(4000, 3000), found, card, ScaleOptions(), lambda *_: 1.0)
    return ScaleTrial(KnownScaleImage(Path(f"{cars}.png"), true_gsd), analyse_view(view))


@pytest.mark.parametrize(("wrong", "of", "bound"), [(0, 300, 0.00994), (0, 59, 0.0495), (1, 100, 0.0466), (5, 5, 1.0)])
def test_the_upper_bound_is_the_exact_one(wrong: int, of: int, bound: float) -> None:
    assert upper_bound(wrong, of) == pytest.approx(bound, abs=1e-4)


def test_there_is_no_bound_without_images() -> None:
    assert upper_bound(0, 0) is None


def test_the_threshold_leaves_one_per_cent_wrong() -> None:
    confidences = np.linspace(0.3, 0.99, 400)
    wrong = confidences < 0.5
    found = confidence_threshold(confidences.tolist(), wrong.tolist())
    assert found.confidence is not None
    assert found.wrong / found.images <= 0.01 < (found.wrong + 1) / (found.images + 1)
    assert 0.49 < found.confidence < 0.5


@pytest.mark.parametrize("n", [0, 99])
def test_too_few_images_have_no_threshold(n: int) -> None:
    assert confidence_threshold([0.9] * n, [False] * n).confidence is None


def test_groups_and_chances_count_what_happened() -> None:
    trials = [_trial(0.1, 30)] * 120 + [_trial(0.2, 30), _trial(0.1, 2), _trial(0.1, 0)]
    report = report_reliability("here", "made", trials)
    by_cars = {row.name: row for row in report.by_vehicles}
    assert [row.images for row in report.by_vehicles] == [1, 1, 0, 121]
    assert (by_cars["20 and more"].usable, by_cars["20 and more"].wrong) == (121, 1)
    assert by_cars["20 and more"].median == pytest.approx(0, abs=0.005)
    assert by_cars["0"].estimates == 0
    assert sum(row.images for row in report.by_resolution) == len(trials) == report.whole.images
    assert {row.name: row.images for row in report.by_resolution}["0.2 to 0.3"] == 1
    surest = next(row for row in report.chances if row.images > 100)
    assert surest.happened == pytest.approx(120 / 121)
    assert report.threshold is not None
    assert (report.threshold_images, report.threshold_wrong) == (122, 1)


def test_the_text_fits_a_terminal_and_names_the_missing_images() -> None:
    text = reliability_markdown(report_reliability("here", "made", [_trial(0.1, 30)] * 12))
    assert max(map(len, text.splitlines())) <= 80
    assert "No limit of the confidence leaves 1 % wrong and 100 estimates of 12" in text


def test_the_command_writes_the_report(dota: Path, detector: Path) -> None:
    out = dota.parent / "out"
    arguments = ["evaluate", "reliability", "--dota", dota, "--detector", detector, "--out", out]
    result = CliRunner().invoke(cli.app, [str(each) for each in arguments])
    assert result.exit_code == 0, result.stderr
    report = json.loads((out / "reliability.json").read_text())
    assert (report["whole"]["images"], report["whole"]["estimates"]) == (4, 3)
    assert (out / "reliability.md").read_text() in result.stdout
    with (out / "reliability.csv").open(newline="") as handle:
        assert {row["by"] for row in csv.DictReader(handle)} == {"vehicles", "true m/px"}
