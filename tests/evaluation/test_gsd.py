from __future__ import annotations

import csv
import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner, Result

from tests.analyses import make_analysis
from tests.known_scale_data import (
    REFERENCE_M,
    cars,
    dota_lines,
    paint,
    write_dota_split,
    write_geotiff,
)
from tests.models import write_detector
from vehanchor import analyse_scale
from vehanchor.cli import app as cli
from vehanchor.detection.detector import Detector
from vehanchor.options import ScaleOptions
from vehanchor_evaluation.dota import parse_labels, read_labels
from vehanchor_evaluation.figures import interval_coverage, plot_cumulative_error
from vehanchor_evaluation.gsd import ScaleTrial, run_trials, summarise
from vehanchor_evaluation.known_scale import KnownScaleImage

# The noise of painted pictures moves the length of a car by up to 0.5 %.
OF_NOISE = 5e-3


def _run(*arguments: object) -> Result:
    return CliRunner().invoke(cli.app, [str(argument) for argument in arguments])


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as handle:
        return list(csv.DictReader(handle))


def _images(out: Path) -> dict[str, dict[str, str]]:
    """Read the line of each image by its name."""
    return {Path(row["file"]).name: row for row in _rows(out / "images.csv")}


@pytest.fixture(scope="module")
def dota_run(tmp_path_factory: pytest.TempPathFactory, detector: Path) -> tuple[Result, Path]:
    """Run ``evaluate gsd`` once on ``write_dota_split``: the result and the folder of its files.

    The detector finds cars off by 0 %, -10 %, no car, and -23.1 %. The labels are off by -9.1 %,
    -10 % and 0 %; the last image has none. The fleet's own errors move these by up to 0.3 %.
    """
    folder = tmp_path_factory.mktemp("dota")
    out = folder / "out"
    data = ["--dota", write_dota_split(folder / "val"), "--out", out]
    method = ["--detector", detector, "--rulers", "vehicles"]
    result = _run("evaluate", "gsd", *data, *method)
    assert result.exit_code == 0, result.stderr
    return result, out


@pytest.fixture
def report(dota_run: tuple[Result, Path]) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((dota_run[1] / "gsd.json").read_text())
    return content


@pytest.fixture
def rows(report: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return {row["name"]: row for row in report["rows"]}


def test_the_table_has_rows_for_detector_labels_and_both(rows: dict[str, Any]) -> None:
    assert list(rows) == ["detector", "labels", "detector, intersection", "labels, intersection"]


def test_errors_of_the_detector_cover_images_with_an_estimate(rows: dict[str, Any]) -> None:
    row = rows["detector"]
    mean = (0.1 + 1 - 20 / 26) / 3
    assert (row["images"], row["of_images"], row["coverage"]) == (3, 4, 0.75)
    assert (row["median"], row["mean"]) == pytest.approx((0.1, mean), abs=3e-3)
    assert row["within_20"] == pytest.approx(2 / 3)


def test_errors_of_the_labels_cover_images_with_an_estimate(rows: dict[str, Any]) -> None:
    row = rows["labels"]
    assert (row["images"], row["of_images"]) == (3, 4)
    assert row["median"] == pytest.approx(1 - 20 / 22, abs=3e-3)
    assert row["mean"] == pytest.approx((1 - 20 / 22 + 0.1) / 3, abs=3e-3)


def test_the_intersection_is_of_images_with_both_estimates(rows: dict[str, Any]) -> None:
    assert rows["detector, intersection"]["images"] == 2
    assert rows["labels, intersection"]["images"] == 2
    assert rows["detector, intersection"]["mean"] == pytest.approx(0.05, abs=3e-3)


def test_unusable_files_are_counted_by_reason(report: dict[str, Any]) -> None:
    assert report["skipped"] == {
        "duplicate_name": 1,
        "image_undecodable": 1,
        "no_gsd": 2,
        "no_image": 1,
        "no_label": 1,
        "unreadable_labels": 1,
    }
    assert report["noted"] == {"malformed_labels": 1}


def test_images_without_vehicles_are_counted(report: dict[str, Any]) -> None:
    assert (report["no_vehicle_found"], report["no_vehicle_labelled"]) == (1, 1)


def test_the_report_states_the_reference_length(report: dict[str, Any]) -> None:
    assert report["reference_length_m"] == [REFERENCE_M]


def test_table_and_text_repeat_the_record(
    dota_run: tuple[Result, Path], rows: dict[str, Any]
) -> None:
    result, out = dota_run
    assert [row["name"] for row in _rows(out / "gsd.csv")] == list(rows)
    assert (out / "gsd.md").read_text() in result.stdout


def test_each_image_has_a_line(dota_run: tuple[Result, Path]) -> None:
    images = _images(dota_run[1])
    assert float(images["P0001.png"]["signed_error"]) == pytest.approx(-0.1, abs=3e-3)
    assert images["P0002.png"]["gsd_m_per_px"] == ""
    assert images["P0003.png"]["labels_gsd_m_per_px"] == ""


def test_each_issue_is_written_and_printed(
    dota_run: tuple[Result, Path], report: dict[str, Any]
) -> None:
    result, out = dota_run
    n_noted = 1
    assert len(_rows(out / "issues.csv")) == sum(report["skipped"].values()) + n_noted
    assert "warning[no_label]" in result.stderr


@pytest.fixture(scope="module")
def high_error_run(
    tmp_path_factory: pytest.TempPathFactory, detector: Path
) -> tuple[Result, dict[str, Any], list[dict[str, str]]]:
    """Run on a good and a bad scale, each with long and with short cars: result, report, images.

    Short cars are below the resolution guard.
    """
    folder = tmp_path_factory.mktemp("high")
    lines = ["file,gsd_m_per_px"]
    for name, length, truth in (("a", 30, 1.0), ("b", 30, 1.5), ("c", 12, 1.0), ("d", 12, 2.0)):
        paint(folder / f"{name}.png", cars(length))
        lines.append(f"{name}.png,{truth * REFERENCE_M / length}")
    (folder / "table.csv").write_text("\n".join(lines))
    data = ["--table", folder / "table.csv", "--out", folder / "out"]
    method = ["--detector", detector, "--rulers", "vehicles"]
    result = _run("evaluate", "gsd", *data, *method)
    assert result.exit_code == 0, result.stderr
    report = json.loads((folder / "out" / "gsd.json").read_text())
    return result, report, _rows(folder / "out" / "images.csv")


HighErrorRun = tuple[Result, dict[str, Any], list[dict[str, str]]]


@pytest.mark.parametrize("errors", ["high_errors", "low_errors"])
def test_errors_are_counted_with_guard_and_status(
    high_error_run: HighErrorRun, errors: str
) -> None:
    _, report, _ = high_error_run
    assert report[errors] == 2
    assert report[f"{errors}_guarded"] == 1
    assert report[f"{errors}_low_confidence"] == 1


def test_a_wrong_scale_can_be_usable(high_error_run: HighErrorRun) -> None:
    result, report, _ = high_error_run
    row = report["rows"][0]
    # Usable are a, and b, which is off by a third.
    assert (row["usable"], row["usable_share"], row["usable_wrong"]) == (2, 0.5, 1)
    assert "50.0 %, 1 wrong" in result.stdout


def test_confidence_and_error_are_correlated(high_error_run: HighErrorRun) -> None:
    _, report, images = high_error_run
    confidence = [float(row["confidence"]) for row in images]
    error = [abs(float(row["signed_error"])) for row in images]
    expected = np.corrcoef(confidence, error)[0, 1]
    assert report["confidence_error_pearson"] == pytest.approx(expected, abs=1e-3)


def test_images_without_labels_give_the_detector_row_only(high_error_run: HighErrorRun) -> None:
    _, report, _ = high_error_run
    assert [row["name"] for row in report["rows"]] == ["detector"]


# --- The ablation


TRUTH = REFERENCE_M / 20
Table = dict[tuple[str, str, str], dict[str, str]]


@pytest.fixture(scope="module")
def ablation_data(tmp_path_factory: pytest.TempPathFactory, detector: Path) -> Path:
    """Run ``evaluate ablation`` on 12, 3 and no cars; a.png has labels."""
    folder = tmp_path_factory.mktemp("ablation")
    boxes = cars(20)
    boxes[:, 2] = [20, 20, 20, 20, 20, 21, 21, 22, 24, 26, 28, 60]
    paint(folder / "images" / "a.png", boxes)
    paint(folder / "images" / "b.png", cars(20, 3))
    paint(folder / "images" / "c.png", cars(20, 0))
    (folder / "labels").mkdir()
    (folder / "labels" / "a.txt").write_text(dota_lines(boxes))
    (folder / "t.csv").write_text(
        f"file,gsd_m_per_px\nimages/a.png,{TRUTH}\nimages/b.png,{TRUTH * 3}\nimages/c.png,{TRUTH}\n"
    )
    data = ["--table", folder / "t.csv", "--detector", detector]
    result = _run("evaluate", "ablation", *data, "--out", folder)
    assert result.exit_code == 0, result.stderr
    return folder


@pytest.fixture
def ablation(ablation_data: Path) -> Table:
    rows = _rows(ablation_data / "ablation.csv")
    return {(row["choice"], row["setting"], row["boxes"]): row for row in rows}


@pytest.mark.parametrize(
    ("choice", "setting", "options"),
    [
        ("aggregation", "kde", {"aggregation": "kde"}),
        ("aggregation", "weighted_kde", {"aggregation": "weighted_kde"}),
        ("aggregation", "median", {"aggregation": "median"}),
        ("aggregation", "mean", {"aggregation": "mean"}),
        ("alpha", "1", {"alpha": 1.0}),
        ("alpha", "1.5", {"alpha": 1.5}),
        ("alpha", "none", {"alpha": None}),
        ("reference length", "4.5 / 5.045", {"reference_length_m": 4.5}),
        ("reference length", "1", {"reference_length_m": REFERENCE_M}),
        ("reference length", "5.5 / 5.045", {"reference_length_m": 5.5}),
    ],
)
def test_the_ablation_repeats_the_estimate_with_one_option_changed(
    ablation_data: Path,
    ablation: Table,
    detector: Path,
    choice: str,
    setting: str,
    options: dict[str, Any],
) -> None:
    changed = ScaleOptions.of({"rulers": ("vehicles",), **options})
    image = ablation_data / "images" / "a.png"
    vehicles = analyse_scale(image, changed, detector=detector).vehicles
    assert vehicles is not None
    assert vehicles.gsd_m_per_px is not None
    error = abs(vehicles.gsd_m_per_px / TRUTH - 1)
    assert _median(ablation, choice, setting) == pytest.approx(error, abs=1e-3)


def test_outliers_move_the_mean_more_than_the_median(ablation: Table) -> None:
    assert _median(ablation, "aggregation", "mean") > _median(ablation, "aggregation", "median") > 0


def test_the_ablation_quotes_the_paper(ablation: Table) -> None:
    assert ablation["reference length", "4.5 / 5.045", "labels"]["paper_median"] == "0.1059"


def test_the_ablation_splits_by_number_of_vehicles(ablation: Table) -> None:
    assert ablation["vehicles", "N < 5", "detector"]["images"] == "1"
    error = _median(ablation, "vehicles", "N < 5", "detector")
    assert error == pytest.approx(2 / 3, abs=1e-3)
    assert ablation["vehicles", "5 <= N < 20", "detector"]["images"] == "1"
    assert ablation["vehicles", "N >= 20", "detector"]["median"] == ""


def test_the_ablation_splits_by_true_scale(ablation: Table) -> None:
    assert ablation["true scale", "< 0.3 m/px", "detector"]["images"] == "1"
    assert ablation["true scale", "> 0.7 m/px", "detector"]["images"] == "1"


def test_the_ablation_counts_images_without_vehicles(ablation: Table) -> None:
    assert ablation["aggregation", "kde", "detector"]["of_images"] == "3"


def _median(table: Table, choice: str, setting: str, boxes: str = "labels") -> float:
    return float(table[choice, setting, boxes]["median"])


# --- Options


@pytest.fixture
def two_sets(tmp_path: Path, detector: Path) -> list[object]:
    """Arguments of ``evaluate gsd`` on a table with an image each of the sets ``eu`` and ``us``."""
    for name in ("a", "b"):
        paint(tmp_path / f"{name}.png", cars(20))
    (tmp_path / "t.csv").write_text(f"file,gsd_m_per_px,set\na.png,{TRUTH},eu\nb.png,{TRUTH},us\n")
    data = ["--table", tmp_path / "t.csv", "--detector", detector]
    return ["evaluate", "gsd", *data, "--out", tmp_path]


def test_sets_have_their_own_rows_and_regions(tmp_path: Path, two_sets: list[object]) -> None:
    result = _run(*two_sets, "--set-region", "eu=europe")
    assert result.exit_code == 0, result.stderr
    rows = {row["name"]: row for row in _rows(tmp_path / "gsd.csv")}
    assert float(rows["detector, eu"]["bias"]) == pytest.approx(4.5 / 5.045 - 1, abs=OF_NOISE)
    assert float(rows["detector, us"]["bias"]) == pytest.approx(0, abs=OF_NOISE)


def test_one_set_is_selected(tmp_path: Path, two_sets: list[object]) -> None:
    assert _run(*two_sets, "--set", "us").exit_code == 0
    assert [row["of_images"] for row in _rows(tmp_path / "gsd.csv")] == ["1"]


@pytest.mark.parametrize(
    ("region", "message"),
    [
        ("eu", "use SET=REGION"),
        ("eu=atlantis", "this model knows europe, north_america"),
    ],
)
def test_a_wrong_region_of_a_set_is_refused(
    two_sets: list[object], region: str, message: str
) -> None:
    refused = _run(*two_sets, "--set-region", region)
    assert refused.exit_code == 2
    assert message in refused.stderr


@pytest.fixture
def with_lines(tmp_path: Path, detector: Path) -> list[object]:
    """Arguments of ``evaluate gsd`` on two images at 0.9 of the cars' scale, with lines."""
    truth = 0.9 * TRUTH
    for name in ("a", "b"):
        paint(tmp_path / f"{name}.png", cars(20))
    (tmp_path / "t.csv").write_text(f"file,gsd_m_per_px\na.png,{truth}\nb.png,{truth}\n")
    (tmp_path / "lines.csv").write_text(
        f"file,x1,y1,x2,y2,metres,basis\na.png,20,220,420,220,{400 * truth},measured\n"
    )
    data = ["--table", tmp_path / "t.csv", "--detector", detector]
    lines = ["--known-lengths", tmp_path / "lines.csv"]
    return ["evaluate", "gsd", *data, *lines, "--out", tmp_path]


def test_lines_of_known_length_apply_to_their_image(
    tmp_path: Path, with_lines: list[object]
) -> None:
    result = _run(*with_lines)
    assert result.exit_code == 0, result.stderr
    images = _images(tmp_path)
    assert float(images["a.png"]["signed_error"]) == pytest.approx(0, abs=0.01)
    assert float(images["b.png"]["signed_error"]) == pytest.approx(1 / 0.9 - 1, abs=OF_NOISE)


def test_a_line_outside_its_image_is_refused(tmp_path: Path, with_lines: list[object]) -> None:
    (tmp_path / "lines.csv").write_text("file,x1,y1,x2,y2,metres\na.png,20,220,420,2200,40\n")
    outside = _run(*with_lines)
    assert outside.exit_code == 2
    assert "a.png" in outside.stderr
    assert "leaves the picture" in outside.stderr


def test_labels_can_have_their_own_reference_length(dota: Path, detector: Path) -> None:
    out = dota.parent / "out"
    arguments = ["evaluate", "gsd", "--dota", dota, "--detector", detector, "--out", out]
    assert _run(*arguments, "--label-reference-length", 5.5495).exit_code == 0
    rows = {row["name"]: row for row in _rows(out / "gsd.csv")}
    # With a reference length 10 % larger, the labelled cars are off by 0 %, -1 % and +10 %.
    assert float(rows["labels"]["median"]) == pytest.approx(0.01, abs=4e-3)
    assert float(rows["detector"]["median"]) == pytest.approx(0.1, abs=3e-3)


def test_geotiff_accepts_several_files(tmp_path: Path, detector: Path) -> None:
    files = [
        write_geotiff(tmp_path / f"{k}.tif", "EPSG:25832", pixel=REFERENCE_M / 20, x=5e5, y=5.5e6)
        for k in range(2)
    ]
    out = tmp_path / "out"
    data = ["--geotiff", *files, "--detector", detector]
    output = ["--out", out, "--workers", 1]
    result = _run("evaluate", "gsd", *data, *output)
    assert result.exit_code == 0, result.stderr
    (row,) = _rows(tmp_path / "out" / "gsd.csv")
    assert row["images"] == "2"
    assert float(row["median"]) == pytest.approx(0, abs=OF_NOISE)


def test_data_without_a_known_scale_is_refused_with_its_reasons(
    tmp_path: Path, detector: Path
) -> None:
    paint(tmp_path / "plain.png", cars(20))
    data = ["--geotiff", tmp_path, "--detector", detector]
    result = _run("evaluate", "gsd", *data, "--out", tmp_path / "out")
    assert result.exit_code == 2
    assert "warning[no_georeference]" in result.stderr
    assert "error[invalid_parameter]: no image of known scale" in result.stderr


def test_an_unwritable_output_is_reported(tmp_path: Path, detector: Path) -> None:
    (tmp_path / "file").write_text("")
    paint(tmp_path / "a.png", cars(20))
    (tmp_path / "t.csv").write_text("file,gsd_m_per_px\na.png,0.2\n")
    common = ["--table", tmp_path / "t.csv", "--detector", detector, "--out", tmp_path / "file"]
    for command in ("gsd", "figures"):
        result = _run("evaluate", command, *common, "--cache", tmp_path / "log.sqlite")
        assert result.exit_code == 2
        assert "error[output_unwritable]" in result.stderr


def test_dota_labels_are_read_with_their_header() -> None:
    labels = parse_labels(
        "imagesource:GoogleEarth\ngsd:0.146\n"
        "1 2 11 2 11 6 1 6 small-vehicle 0\n20 20 40 20 40 28 20 28 large-vehicle 1\n\n0 0 4 0 "
        "4 2 0 2 ship\n"
    )
    assert labels.gsd_m_per_px == 0.146
    assert labels.classes == ("small-vehicle", "large-vehicle", "ship")
    assert labels.difficult.tolist() == [False, True, False]
    assert labels.of_class("small-vehicle").tolist() == [[[1, 2], [11, 2], [11, 6], [1, 6]]]
    assert labels.of_class("plane").shape == (0, 4, 2)


@pytest.mark.parametrize(
    "line", ["1 2 3", "a b c d e f g h car 0", "1 2 3 4 5 6 7 nan car 0", "gsd:wide"]
)
def test_a_malformed_line_is_named(tmp_path: Path, line: str) -> None:
    path = tmp_path / "P0001.txt"
    path.write_text(f"imagesource:x\n{line}\n")
    with pytest.raises(ValueError, match=r"P0001\.txt.*line 2"):
        read_labels(path)


def test_a_missing_estimate_counts_as_an_error_of_100_percent(tmp_path: Path) -> None:
    paint(tmp_path / "cars.png", cars(30, 18))
    paint(tmp_path / "none.png", cars(30, 0))
    truth = 5.045 / 30
    images = [
        KnownScaleImage(tmp_path / "cars.png", truth * 1.3),
        KnownScaleImage(tmp_path / "none.png", truth),
    ]
    trials = list(run_trials(images, Detector(write_detector(tmp_path / "m.onnx"))))
    assert trials[0].signed_error == pytest.approx(1 / 1.3 - 1, abs=OF_NOISE)
    assert trials[0].covered is False
    assert math.isnan(trials[1].signed_error)
    assert (trials[1].error, trials[1].covered) == (1.0, None)
    summary = summarise(trials)
    assert summary == pytest.approx(
        (2, 0.5, 1 - 0.5 / 1.3, 1 - 0.5 / 1.3, 0.0, 0.0, 1 / 1.3 - 1), abs=OF_NOISE
    )


def test_no_trials_have_no_median() -> None:
    assert summarise([]).images == 0
    assert np.isnan(summarise([]).median)


def _trial(length_px: float, truth: float, n: int = 12) -> ScaleTrial:
    boxes = np.array([[20 + 60 * k, 30, length_px, 10, 0.0] for k in range(n)]).reshape(-1, 5)
    return ScaleTrial(KnownScaleImage(Path("a.png"), truth), make_analysis(boxes, 800, 60))


def test_the_cumulative_error_never_reaches_one_with_misses() -> None:
    trials = [
        _trial(25, 5.045 / 25 * 1.1),
        _trial(25, 5.045 / 25),
        _trial(25, 0.2, n=0),
        _trial(25, 0.2, n=0),
    ]
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
    # A scale off by a factor of three lies outside every interval.
    assert observed[3] == 0.75


def test_the_command_draws_all_figures(tmp_path: Path) -> None:
    lines = ["file,gsd_m_per_px"]
    for index in range(3):
        paint(tmp_path / f"{index}.png", cars(25))
        lines.append(f"{index}.png,{0.2 + 0.02 * index}")
    (tmp_path / "t.csv").write_text("\n".join(lines))
    data = ["--table", tmp_path / "t.csv", "--detector", write_detector(tmp_path / "m.onnx")]
    result = _run("evaluate", "figures", *data, "--out", tmp_path / "out")
    assert result.exit_code == 0, result.stderr
    for name in ("predicted", "cumulative", "calibration", "sheet"):
        picture = cv2.imread(str(tmp_path / "out" / f"{name}.png"))
        assert picture is not None
        assert picture.std() > 10
        assert f"{name}.png" in result.stderr
