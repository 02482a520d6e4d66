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
from tests.known_scale_data import REFERENCE_M, cars, dota_lines, paint, write_geotiff
from tests.models import write_detector
from vehanchor import analyse_scale
from vehanchor.cli import app as cli
from vehanchor.detection.detector import Detector
from vehanchor.options import ScaleOptions
from vehanchor_evaluation.dota import parse_labels, read_labels
from vehanchor_evaluation.figures import interval_coverage, plot_cumulative_error
from vehanchor_evaluation.gsd import ScaleTrial, run_trials, summarise
from vehanchor_evaluation.known_scale import KnownScaleImage


def _run(*arguments: object) -> Result:
    return CliRunner().invoke(cli.app, [str(argument) for argument in arguments])


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as handle:
        return list(csv.DictReader(handle))


def test_errors_are_over_the_images_with_an_estimate_as_the_paper_counts(
    dota: Path, detector: Path
) -> None:
    out = dota.parent / "out"
    result = _run(
        "evaluate",
        "gsd",
        "--dota",
        dota,
        "--detector",
        detector,
        "--out",
        out,
        "--rulers",
        "vehicles",
    )
    assert result.exit_code == 0, result.stderr
    report = json.loads((out / "gsd.json").read_text())
    rows = {row["name"]: row for row in report["rows"]}
    # the errors of the fleet move each by up to 0.3 %
    # found: 0 %, -10 %, nothing, -23.1 %; labelled: -9.1 %, -10 %, 0 %, none
    assert list(rows) == ["detector", "labels", "detector, intersection", "labels, intersection"]
    found = rows["detector"]
    labelled = rows["labels"]
    assert (found["images"], found["of_images"], found["coverage"]) == (3, 4, 0.75)
    assert (found["median"], found["mean"]) == pytest.approx(
        (0.1, (0.1 + 1 - 20 / 26) / 3), abs=3e-3
    )
    assert found["within_20"] == pytest.approx(2 / 3)
    assert (labelled["images"], labelled["of_images"]) == (3, 4)
    assert labelled["median"] == pytest.approx(1 - 20 / 22, abs=3e-3)
    assert labelled["mean"] == pytest.approx((1 - 20 / 22 + 0.1) / 3, abs=3e-3)
    assert rows["detector, intersection"]["images"] == rows["labels, intersection"]["images"] == 2
    assert rows["detector, intersection"]["mean"] == pytest.approx(0.05, abs=3e-3)
    assert report["skipped"] == {
        "duplicate_name": 1, "image_undecodable": 1, "no_gsd": 2, "no_image": 1, "no_label": 1, "unreadable_labels": 1
    }  # fmt: skip
    assert report["noted"] == {"malformed_labels": 1}
    assert (report["no_vehicle_found"], report["no_vehicle_labelled"]) == (1, 1)
    assert report["reference_length_m"] == [REFERENCE_M]

    assert [row["name"] for row in _rows(out / "gsd.csv")] == list(rows)
    assert (out / "gsd.md").read_text() in result.stdout
    images = {Path(row["file"]).name: row for row in _rows(out / "images.csv")}
    assert float(images["P0001.png"]["signed_error"]) == pytest.approx(-0.1, abs=3e-3)
    assert images["P0002.png"]["gsd_m_per_px"] == ""
    assert images["P0003.png"]["labels_gsd_m_per_px"] == ""
    assert len(_rows(out / "issues.csv")) == sum(report["skipped"].values()) + 1
    assert "warning[no_label]" in result.stderr


def test_high_errors_are_counted_with_guard_and_confidence(tmp_path: Path, detector: Path) -> None:
    lines = ["file,gsd_m_per_px"]
    for name, length, truth in (("a", 30, 1.0), ("b", 30, 1.5), ("c", 12, 1.0), ("d", 12, 2.0)):
        paint(tmp_path / f"{name}.png", cars(length))
        lines.append(f"{name}.png,{truth * REFERENCE_M / length}")
    (tmp_path / "table.csv").write_text("\n".join(lines))
    result = _run(
        *(
            "evaluate",
            "gsd",
            "--table",
            tmp_path / "table.csv",
            "--detector",
            detector,
            "--out",
            tmp_path / "out",
        ),
        *("--rulers", "vehicles"),
    )
    assert result.exit_code == 0, result.stderr
    report = json.loads((tmp_path / "out" / "gsd.json").read_text())
    assert (
        report["high_errors"],
        report["high_errors_guarded"],
        report["high_errors_low_confidence"],
    ) == (2, 1, 1)
    row = report["rows"][0]
    # a, and b that is off by a third
    assert (row["usable"], row["usable_share"], row["usable_wrong"]) == (2, 0.5, 1)
    assert "50.0 %, 1 wrong" in result.stdout
    assert (
        report["low_errors"],
        report["low_errors_guarded"],
        report["low_errors_low_confidence"],
    ) == (2, 1, 1)
    images = _rows(tmp_path / "out" / "images.csv")
    confidence = [float(row["confidence"]) for row in images]
    error = [abs(float(row["signed_error"])) for row in images]
    assert report["confidence_error_pearson"] == pytest.approx(
        np.corrcoef(confidence, error)[0, 1], abs=1e-3
    )
    assert report["rows"][0]["name"] == "detector"
    assert len(report["rows"]) == 1  # no labels, no baseline


def test_the_ablation_repeats_the_second_half_with_one_choice_changed(
    tmp_path: Path, detector: Path
) -> None:
    boxes = cars(20)
    boxes[:, 2] = [20, 20, 20, 20, 20, 21, 21, 22, 24, 26, 28, 60]
    paint(tmp_path / "images" / "a.png", boxes)
    paint(tmp_path / "images" / "b.png", cars(20, 3))
    paint(tmp_path / "images" / "c.png", cars(20, 0))
    (tmp_path / "labels").mkdir()
    (tmp_path / "labels" / "a.txt").write_text(dota_lines(boxes))
    truth = REFERENCE_M / 20
    (tmp_path / "t.csv").write_text(
        f"file,gsd_m_per_px\nimages/a.png,{truth}\nimages/b.png,{truth * 3}\nimages/c.png,{truth}\n"
    )
    result = _run(
        "evaluate",
        "ablation",
        "--table",
        tmp_path / "t.csv",
        "--detector",
        detector,
        "--out",
        tmp_path,
    )
    assert result.exit_code == 0, result.stderr
    rows = _rows(tmp_path / "ablation.csv")
    table = {(row["choice"], row["setting"], row["boxes"]): row for row in rows}

    def median(choice: str, setting: str, boxes: str = "labels") -> float:
        return float(table[choice, setting, boxes]["median"])

    def expected(**options: Any) -> float:
        chosen = ScaleOptions.of({"rulers": ("vehicles",), **options})
        vehicles = analyse_scale(tmp_path / "images" / "a.png", chosen, detector=detector).vehicles
        assert vehicles is not None
        assert vehicles.gsd_m_per_px is not None
        return abs(vehicles.gsd_m_per_px / truth - 1)

    for aggregation in ("kde", "weighted_kde", "median", "mean"):
        assert median("aggregation", aggregation) == pytest.approx(
            expected(aggregation=aggregation), abs=1e-3
        )
    assert median("aggregation", "mean") > median("aggregation", "median") > 0
    for setting, alpha in (("1", 1.0), ("1.5", 1.5), ("none", None)):
        assert median("alpha", setting) == pytest.approx(expected(alpha=alpha), abs=1e-3)
    for setting, length in (("4.5 / 5.045", 4.5), ("1", REFERENCE_M), ("5.5 / 5.045", 5.5)):
        assert median("reference length", setting) == pytest.approx(
            expected(reference_length_m=length), abs=1e-3
        )
    assert table["reference length", "4.5 / 5.045", "labels"]["paper_median"] == "0.1059"
    assert table["vehicles", "N < 5", "detector"]["images"] == "1"
    assert median("vehicles", "N < 5", "detector") == pytest.approx(2 / 3, abs=1e-3)
    assert table["vehicles", "5 <= N < 20", "detector"]["images"] == "1"
    assert table["vehicles", "N >= 20", "detector"]["median"] == ""
    assert table["true scale", "< 0.3 m/px", "detector"]["images"] == "1"
    assert table["true scale", "> 0.7 m/px", "detector"]["images"] == "1"
    assert table["aggregation", "kde", "detector"]["of_images"] == "3"


def test_sets_have_rows_and_regions_of_their_own(tmp_path: Path, detector: Path) -> None:
    for name in ("a", "b"):
        paint(tmp_path / f"{name}.png", cars(20))
    truth = REFERENCE_M / 20
    (tmp_path / "t.csv").write_text(f"file,gsd_m_per_px,set\na.png,{truth},eu\nb.png,{truth},us\n")
    arguments = [
        "evaluate",
        "gsd",
        "--table",
        tmp_path / "t.csv",
        "--detector",
        detector,
        "--out",
        tmp_path,
    ]
    result = _run(*arguments, "--set-region", "eu=europe")
    assert result.exit_code == 0, result.stderr
    rows = {row["name"]: row for row in _rows(tmp_path / "gsd.csv")}
    assert float(rows["detector, eu"]["bias"]) == pytest.approx(4.5 / 5.045 - 1, abs=1e-3)
    assert float(rows["detector, us"]["bias"]) == pytest.approx(0, abs=1e-3)
    assert _run(*arguments, "--set", "us").exit_code == 0
    assert [row["of_images"] for row in _rows(tmp_path / "gsd.csv")] == ["1"]
    for extra, message in (
        (["--set-region", "eu"], "use SET=REGION"),
        (["--set-region", "eu=atlantis"], "this model knows europe, north_america"),
    ):
        refused = _run(*arguments, *extra)
        assert refused.exit_code == 2
        assert message in refused.stderr


def test_lines_of_known_length_are_heard_where_they_lie(tmp_path: Path, detector: Path) -> None:
    for name in ("a", "b"):
        paint(tmp_path / f"{name}.png", cars(20))
    truth = 0.9 * REFERENCE_M / 20
    (tmp_path / "t.csv").write_text(f"file,gsd_m_per_px\na.png,{truth}\nb.png,{truth}\n")
    (tmp_path / "lines.csv").write_text(
        f"file,x1,y1,x2,y2,metres,basis\na.png,20,220,420,220,{400 * truth},measured\n"
    )
    arguments = [
        "evaluate",
        "gsd",
        "--table",
        tmp_path / "t.csv",
        "--detector",
        detector,
        "--out",
        tmp_path,
    ]
    result = _run(*arguments, "--known-lengths", tmp_path / "lines.csv")
    assert result.exit_code == 0, result.stderr
    images = {
        Path(row["file"]).name: float(row["signed_error"]) for row in _rows(tmp_path / "images.csv")
    }
    assert images["a.png"] == pytest.approx(0, abs=0.01)
    assert images["b.png"] == pytest.approx(1 / 0.9 - 1, abs=1e-3)
    (tmp_path / "lines.csv").write_text("file,x1,y1,x2,y2,metres\na.png,20,220,420,2200,40\n")
    outside = _run(*arguments, "--known-lengths", tmp_path / "lines.csv")
    assert outside.exit_code == 2
    assert "a.png" in outside.stderr
    assert "leaves the picture" in outside.stderr


def test_labels_may_have_a_reference_length_of_their_own(dota: Path, detector: Path) -> None:
    out = dota.parent / "out"
    arguments = ["evaluate", "gsd", "--dota", dota, "--detector", detector, "--out", out]
    assert _run(*arguments, "--label-reference-length", 5.5495).exit_code == 0
    rows = {row["name"]: row for row in _rows(out / "gsd.csv")}
    # 22 px at 10 % more: 0 %; -1 %; +10 %
    assert float(rows["labels"]["median"]) == pytest.approx(0.01, abs=4e-3)
    assert float(rows["detector"]["median"]) == pytest.approx(0.1, abs=3e-3)


def test_geotiffs_are_named_as_a_shell_spreads_them(tmp_path: Path, detector: Path) -> None:
    files = [
        write_geotiff(tmp_path / f"{k}.tif", "EPSG:25832", pixel=REFERENCE_M / 20, x=5e5, y=5.5e6)
        for k in range(2)
    ]
    result = _run(
        "evaluate",
        "gsd",
        "--geotiff",
        *files,
        "--detector",
        detector,
        "--out",
        tmp_path / "out",
        "--workers",
        1,
    )
    assert result.exit_code == 0, result.stderr
    (row,) = _rows(tmp_path / "out" / "gsd.csv")
    assert row["images"] == "2"
    assert float(row["median"]) == pytest.approx(0, abs=1e-3)


def test_data_without_a_known_scale_is_refused_with_its_reasons(
    tmp_path: Path, detector: Path
) -> None:
    paint(tmp_path / "plain.png", cars(20))
    result = _run(
        "evaluate", "gsd", "--geotiff", tmp_path, "--detector", detector, "--out", tmp_path / "out"
    )
    assert result.exit_code == 2
    assert "warning[no_georeference]" in result.stderr
    assert "error[invalid_parameter]: no image of known scale" in result.stderr


def test_an_output_that_cannot_be_written_is_told(tmp_path: Path, detector: Path) -> None:
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


def test_trials_count_a_missing_estimate_as_a_whole_error(tmp_path: Path) -> None:
    paint(tmp_path / "cars.png", cars(30, 18))
    paint(tmp_path / "none.png", cars(30, 0))
    truth = 5.045 / 30
    images = [
        KnownScaleImage(tmp_path / "cars.png", truth * 1.3),
        KnownScaleImage(tmp_path / "none.png", truth),
    ]
    trials = list(run_trials(images, Detector(write_detector(tmp_path / "m.onnx"))))
    assert trials[0].signed_error == pytest.approx(1 / 1.3 - 1, abs=3e-3)
    assert trials[0].covered is False
    assert math.isnan(trials[1].signed_error)
    assert (trials[1].error, trials[1].covered) == (1.0, None)
    summary = summarise(trials)
    assert summary == pytest.approx(
        (2, 0.5, 1 - 0.5 / 1.3, 1 - 0.5 / 1.3, 0.0, 0.0, 1 / 1.3 - 1), abs=3e-3
    )
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
    assert observed[3] == 0.75  # three times the scale is out of reach


def test_the_command_draws_all_figures(tmp_path: Path) -> None:
    lines = ["file,gsd_m_per_px"]
    for index in range(3):
        paint(tmp_path / f"{index}.png", cars(25))
        lines.append(f"{index}.png,{0.2 + 0.02 * index}")
    (tmp_path / "t.csv").write_text("\n".join(lines))
    arguments = ["--table", tmp_path / "t.csv", "--detector", write_detector(tmp_path / "m.onnx")]
    result = CliRunner().invoke(
        cli.app, ["evaluate", "figures", *map(str, arguments), "--out", str(tmp_path / "out")]
    )
    assert result.exit_code == 0, result.stderr
    for name in ("predicted", "cumulative", "calibration", "sheet"):
        picture = cv2.imread(str(tmp_path / "out" / f"{name}.png"))
        assert picture is not None
        assert picture.std() > 10
        assert f"{name}.png" in result.stderr
