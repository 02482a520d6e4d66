"""Fleet calibration: the measurement, its file, its use and its command."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import gaussian_kde
from typer.testing import CliRunner

import vehanchor
from research.scenes import render_scene
from tests.known_scale_data import n_results
from tests.models import blank_image, paint_vehicles, write_detector
from tests.skill.imagery.files import exif, jpeg, xmp
from vehanchor.cli import app as cli
from vehanchor.detection.detector import Detector
from vehanchor.errors import (
    CalibrationFileError,
    CalibrationMismatchError,
    CalibrationRefusedError,
    InvalidParameterError,
    OutputError,
)
from vehanchor.options import ScaleOptions
from vehanchor.records import GsdEstimate
from vehanchor.scale.calibration import (
    MIN_VEHICLES,
    Calibration,
    SurveyedImage,
    calibrate,
    load_calibration,
    modal_length_m,
)
from vehanchor.storage.atomic import write_record
from vehanchor_evaluation.dota import labelled_boxes

FLEET_M = 4.2
GSD = 0.12


def _boxes(
    n: int,
    mean_m: float = FLEET_M,
    spread_m: float = 0.3,
    gsd: float = GSD,
    seed: int = 0,
    step_m: float = 12,
) -> NDArray[np.float64]:
    """Cars on a grid with lengths of one fleet."""
    rng = np.random.default_rng(seed)
    lengths = rng.normal(mean_m, spread_m, n) / gsd
    cells = np.stack([np.arange(n) % 12, np.arange(n) // 12], axis=1)
    centres = step_m / gsd * (1 + cells)
    return np.column_stack([centres, lengths, 0.4 * lengths, rng.uniform(0, 3, n)])


def _calibrated(**changes: Any) -> Calibration:
    arguments: dict[str, Any] = {"source": "labels", "region_sd_m": 0.2} | changes
    return calibrate([SurveyedImage(_boxes(300), GSD)], **arguments)


# --- The measurement


def test_the_reference_length_is_the_papers_kde_mode() -> None:
    images = [
        SurveyedImage(_boxes(150, seed=s, gsd=gsd), gsd) for s, gsd in enumerate((0.08, 0.12, 0.25))
    ]
    metres = np.concatenate([image.boxes[:, 2] * image.gsd_m_per_px for image in images])
    points = np.linspace(3.5, 5.0, 15001)
    density = gaussian_kde(metres)(points)  # Scott's rule is scipy's default
    expected = points[np.argmax(density)]
    assert modal_length_m(images).mode_m == pytest.approx(expected, abs=2e-4)


def test_about_95_of_100_intervals_hold_the_true_mode() -> None:
    held = 0
    for seed in range(60):
        length = modal_length_m([SurveyedImage(_boxes(200, seed=seed), GSD)])
        if length.low_m <= FLEET_M <= length.high_m:
            held += 1
    assert 48 <= held <= 60  # 95 % of 60 is 57


def test_cars_of_one_place_count_less_than_cars_of_many_places() -> None:
    rng = np.random.default_rng(1)
    spread: list[SurveyedImage] = []
    crowded: list[SurveyedImage] = []
    for _ in range(40):  # places, each with a fleet of its own
        boxes = _boxes(
            25, mean_m=FLEET_M + rng.normal(0, 0.3), spread_m=0.05, seed=int(rng.integers(1 << 30))
        )
        spread += [SurveyedImage(boxes[[k]], GSD) for k in range(25)]
        crowded.append(SurveyedImage(np.column_stack([np.full((25, 2), 10.0), boxes[:, 2:]]), GSD))
    assert modal_length_m(crowded).sd_m > 1.2 * modal_length_m(spread).sd_m


def _calibrated_by_detections() -> Calibration:
    """Calibration from 200 cars in one image; another image has none."""
    images = [SurveyedImage(_boxes(200), GSD), SurveyedImage(np.zeros((0, 5)), 0.3)]
    return calibrate(
        images, source="detections", region_sd_m=0.4, detector="vehicles", detector_sha256="ab" * 32
    )


def test_a_calibration_is_the_same_each_time() -> None:
    assert _calibrated_by_detections() == _calibrated_by_detections()


def test_a_calibration_states_its_vehicles_with_their_scale() -> None:
    record = _calibrated_by_detections()
    assert (record.n_vehicles, record.n_images, record.source) == (200, 1, "detections")
    assert record.median_gsd_m_per_px == GSD
    assert record.mode_length_px == pytest.approx(record.reference_length_m / GSD, rel=1e-3)


def test_the_spread_of_a_calibration_is_half_of_that_between_regions() -> None:
    record = _calibrated_by_detections()
    # with the bootstrap's
    assert 0.2 < record.reference_length_sd_m < 0.25


def test_too_few_vehicles_are_refused_with_the_number_needed() -> None:
    words = f"vehicles labelled for a reference length: 99; at least {MIN_VEHICLES}"
    with pytest.raises(CalibrationRefusedError, match=words) as refusal:
        calibrate(
            [SurveyedImage(_boxes(50), GSD), SurveyedImage(_boxes(49), GSD)],
            source="labels",
            region_sd_m=0.2,
        )
    assert refusal.value.code == "calibration_refused"


def test_images_without_vehicles_are_refused() -> None:
    with pytest.raises(CalibrationRefusedError, match="vehicles found for a reference length: 0;"):
        calibrate([], source="detections", region_sd_m=0.2)


def _calibrated_at(gsd: float, min_length_px: float) -> Calibration:
    """Calibration from images with one scale, by a detector with a shortest length."""
    images = [SurveyedImage(_boxes(300, spread_m=0.1, gsd=gsd), gsd)]
    return calibrate(images, source="detections", region_sd_m=0.2, min_length_px=min_length_px)


@pytest.mark.parametrize(("gsd", "min_length_px"), [(0.35, 0), (0.2, 25)])
def test_imagery_too_coarse_for_the_guard_is_refused(gsd: float, min_length_px: float) -> None:
    with pytest.raises(CalibrationRefusedError, match=r"too coarse.*m/px or finer"):
        _calibrated_at(gsd, min_length_px)


def test_imagery_just_fine_enough_for_the_guard_is_accepted() -> None:
    assert _calibrated_at(0.28, 0).reference_length_m == pytest.approx(FLEET_M, rel=0.02)


# --- The file


def test_a_calibration_is_read_as_it_was_saved(tmp_path: Path) -> None:
    record = _calibrated()
    path = tmp_path / "c.json"
    write_record(path, record)
    assert load_calibration(path) == record
    assert vehanchor.load_calibration(path) == record


def test_a_calibration_file_names_its_kind(tmp_path: Path) -> None:
    write_record(tmp_path / "c.json", _calibrated())
    assert json.loads((tmp_path / "c.json").read_text())["kind"] == "vehanchor.calibration.v1"


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"reference_length_m": -1}, "reference_length_m"),
        ({"kind": "vehanchor.calibration.v2"}, "kind"),
        ({"surprise": 1}, "surprise"),
        ({"reference_length_m": "4.2"}, "reference_length_m"),
        ({"reference_length_m": 20.1}, "reference_length_m"),
        ({"n_vehicles": 1e3}, "n_vehicles"),
        ({"reference_length_ci95_low_m": 19.0}, "does not hold the length"),
        ({"reference_length_sd_m": 1e308}, "reference_length_sd_m"),
        ({"reference_length_sd_m": 15.0}, "standard deviation"),
    ],
)
def test_a_file_that_is_not_a_calibration_is_refused_by_its_field(
    tmp_path: Path, change: dict[str, Any], named: str
) -> None:
    (tmp_path / "c.json").write_text(json.dumps(_calibrated().model_dump() | change))
    with pytest.raises(CalibrationFileError, match=named) as refusal:
        load_calibration(tmp_path / "c.json")
    assert refusal.value.code == "calibration_unreadable"


def test_lengths_that_no_vehicle_has_are_refused() -> None:
    with pytest.raises(CalibrationRefusedError, match="Check the images' scales"):
        calibrate([SurveyedImage(_boxes(300), 10 * GSD)], source="labels", region_sd_m=0.2)


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CalibrationFileError, match="No such file"):
        load_calibration(tmp_path / "none.json")


def test_an_unwritable_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="no_folder"):
        write_record(tmp_path / "no_folder" / "c.json", _calibrated())


# --- Its use


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An image of 132 cars of one fleet, its table and its detector, and another detector."""
    path = tmp_path_factory.mktemp("calibration")
    image = blank_image(760, 700)
    paint_vehicles(image, _boxes(132, step_m=7))
    cv2.imwrite(str(path / "cars.png"), image[:, :, ::-1])
    (path / "table.csv").write_text(f"file,gsd_m_per_px\ncars.png,{GSD}\n")
    write_detector(path / "detector.onnx")
    write_detector(path / "other.onnx", metadata={"license": "CC0-1.0"})
    return path


def _run(*arguments: object) -> Any:
    return CliRunner().invoke(cli.app, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def calibration(folder: Path) -> Path:
    """Made with the detector, as a user would."""
    out = folder / "calibration.json"
    result = _run(
        "calibrate", "--table", folder / "table.csv", "--detector", folder / "detector.onnx",
        "--out", out, "--plot", folder / "plot.png",
    )  # fmt: skip
    assert result.exit_code == 0, result.stderr
    assert "132 found" in result.stdout
    return out


def test_a_calibration_names_its_detector(folder: Path, calibration: Path) -> None:
    record = load_calibration(calibration)
    detector = Detector(folder / "detector.onnx")
    assert (record.source, record.detector_sha256) == ("detections", detector.card.sha256)


@pytest.fixture(scope="module")
def estimate(folder: Path, calibration: Path) -> GsdEstimate:
    """The estimate with the calibration."""
    detector = Detector(folder / "detector.onnx")
    return vehanchor.estimate_gsd(folder / "cars.png", detector=detector, calibration=calibration)


def test_without_a_calibration_the_fleets_length_is_wrong(folder: Path) -> None:
    detector = Detector(folder / "detector.onnx")
    estimate = vehanchor.estimate_gsd(folder / "cars.png", detector=detector)
    assert estimate.gsd_m_per_px == pytest.approx(GSD * 5.045 / FLEET_M, rel=0.03)


def test_a_calibration_makes_the_vehicles_scale_true(estimate: GsdEstimate) -> None:
    assert estimate.rulers[0].gsd_m_per_px == pytest.approx(GSD, rel=1e-4)
    # beside a prior that is wrong for a painted picture
    assert estimate.gsd_m_per_px == pytest.approx(GSD, rel=0.03)


def test_the_record_shows_the_calibrated_length(estimate: GsdEstimate, calibration: Path) -> None:
    record = load_calibration(calibration)
    assert estimate.details.reference_length_m == record.reference_length_m


def test_a_calibration_can_be_an_object(
    folder: Path, calibration: Path, estimate: GsdEstimate
) -> None:
    options = ScaleOptions.of({"calibration": load_calibration(calibration)})
    analysis = vehanchor.analyse_scale(
        folder / "cars.png", options, detector=folder / "detector.onnx"
    )
    assert analysis.estimate == estimate


@pytest.fixture(scope="module")
def calibration_by_height(folder: Path) -> Calibration:
    """Calibration from a photograph with a measured height, without a georeference."""
    out = folder / "by_height.json"
    height_m = GSD * 24 * math.hypot(760, 700) / math.hypot(36, 24)
    result = _run(
        "calibrate", "--photographs", folder / "cars.png", "--detector", folder / "detector.onnx",
        "--out", out, "--height", height_m, "--height-basis", "measured", "--focal-35mm", 24,
    )  # fmt: skip
    assert result.exit_code == 0, result.stderr
    return load_calibration(out)


def test_photographs_with_a_height_need_no_georeference(
    calibration_by_height: Calibration, calibration: Path
) -> None:
    by_table = load_calibration(calibration)
    assert calibration_by_height.reference_length_m == pytest.approx(
        by_table.reference_length_m, rel=1e-3
    )


def test_the_error_of_the_height_is_in_the_spread(
    calibration_by_height: Calibration, calibration: Path
) -> None:
    by_table = load_calibration(calibration)
    # of a given height, and of a lens
    truth_sd_m = math.hypot(0.05, 0.04) * calibration_by_height.reference_length_m
    expected_m = math.hypot(by_table.reference_length_sd_m, truth_sd_m)
    assert calibration_by_height.reference_length_sd_m == pytest.approx(expected_m, rel=0.02)


def test_the_error_of_the_height_is_in_the_interval(
    calibration_by_height: Calibration, calibration: Path
) -> None:
    by_height = calibration_by_height
    by_table = load_calibration(calibration)
    assert by_height.reference_length_ci95_low_m < by_table.reference_length_ci95_low_m
    assert by_height.reference_length_ci95_high_m > by_table.reference_length_ci95_high_m


def test_photographs_without_another_ruler_are_left_out(folder: Path, tmp_path: Path) -> None:
    result = _run(
        "calibrate", "--photographs", folder / "cars.png",
        "--detector", folder / "detector.onnx", "--out", tmp_path / "c.json",
    )  # fmt: skip
    assert result.exit_code == 2
    assert "warning[no_other_ruler]" in result.stderr


def test_photographs_beside_a_table_are_refused(folder: Path, tmp_path: Path) -> None:
    result = _run(
        "calibrate", "--photographs", folder / "cars.png", "--table", folder / "table.csv",
        "--detector", folder / "detector.onnx", "--out", tmp_path / "c.json",
    )  # fmt: skip
    assert result.exit_code == 2
    assert "give the images with one of" in result.stderr


def test_photographs_of_a_tilted_camera_are_left_out(folder: Path, tmp_path: Path) -> None:
    aside = 'drone-dji:RelativeAltitude="60" drone-dji:GimbalPitchDegree="-65"'
    dji = {"drone-dji": "http://www.dji.com/drone-dji/1.0/"}
    photograph = tmp_path / "aside.jpg"
    photograph.write_bytes(jpeg(exif=exif({"FocalLengthIn35mmFilm": 26}), xmp=xmp(dji, aside)))
    common = ["--detector", folder / "detector.onnx", "--out", tmp_path / "c.json"]
    result = _run("calibrate", "--photographs", photograph, *common)
    assert result.exit_code == 2
    assert "warning[camera_tilted]" in result.stderr
    assert "tilted by 25 degrees" in result.stderr


def test_the_interval_of_an_estimate_follows_the_calibrations_spread(
    folder: Path, calibration: Path
) -> None:
    record = load_calibration(calibration)
    wide = record.model_copy(update={"reference_length_sd_m": 1.0})

    def width(calibration: Calibration) -> float:
        estimate = vehanchor.estimate_gsd(
            folder / "cars.png", detector=folder / "detector.onnx", calibration=calibration
        )
        assert estimate.gsd_ci95_low_m_per_px is not None
        assert estimate.gsd_ci95_high_m_per_px is not None
        return estimate.gsd_ci95_high_m_per_px / estimate.gsd_ci95_low_m_per_px

    assert width(record) < 1.5
    assert width(wide) > 2


def test_the_command_line_uses_a_calibration(folder: Path, calibration: Path) -> None:
    result = _run(
        "estimate",
        folder / "cars.png",
        "--detector",
        folder / "detector.onnx",
        "--calibration",
        calibration,
        "--json",
    )
    assert result.exit_code == 0, result.stderr
    assert json.loads(result.stdout)["rulers"][0]["gsd_m_per_px"] == pytest.approx(GSD, rel=1e-4)


def test_another_detector_is_refused_before_the_work(folder: Path, calibration: Path) -> None:
    result = _run(
        "estimate",
        folder / "cars.png",
        "--detector",
        folder / "other.onnx",
        "--calibration",
        calibration,
    )
    assert result.exit_code == 2
    assert "error[calibration_mismatch]" in result.stderr
    assert "calibrate again" in result.stderr


@pytest.mark.parametrize("name", ["detector.onnx", "other.onnx"])
def test_a_calibration_from_labels_alone_fits_any_detector(folder: Path, name: str) -> None:
    record = _calibrated()
    estimate = vehanchor.estimate_gsd(
        folder / "cars.png", detector=folder / name, calibration=record
    )
    assert estimate.details.reference_length_m == record.reference_length_m


def test_a_calibration_of_another_detector_is_refused() -> None:
    with pytest.raises(CalibrationMismatchError, match="made for detector 'mine'"):
        _calibrated(detector="mine", detector_sha256="0" * 64).check_detector("yours", "1" * 64)


@pytest.mark.parametrize("other", [{"region": "europe"}, {"reference_length_m": 4.5}])
def test_two_reference_lengths_are_refused(other: dict[str, Any]) -> None:
    with pytest.raises(
        InvalidParameterError, match=f"give {next(iter(other))} or calibration, not both"
    ):
        ScaleOptions.of({"calibration": _calibrated(), **other})


# --- The command


def test_a_calibration_from_labels_can_be_bound_to_a_detector(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    (tmp_path / "labels").mkdir()
    boxes = _boxes(120, seed=5)
    from vehanchor.detection.boxes import box_corners

    lines = [
        " ".join(f"{v:.3f}" for v in corners.ravel()) + " car 0" for corners in box_corners(boxes)
    ]
    for name in ("a", "b"):
        cv2.imwrite(str(tmp_path / "images" / f"{name}.png"), blank_image(64, 64))
    (tmp_path / "labels" / "a.txt").write_text("\n".join(lines))
    (tmp_path / "table.csv").write_text(
        f"file,gsd_m_per_px\nimages/a.png,{GSD}\nimages/b.png,{GSD}\n"
    )
    result = _run(
        "calibrate", "--table", tmp_path / "table.csv", "--from", "labels", "--label-class", "car",
        "--detector", folder / "detector.onnx", "--out", tmp_path / "c.json",
    )  # fmt: skip
    assert result.exit_code == 0, result.stderr
    assert "warning[no_label]" in result.stderr
    record = load_calibration(tmp_path / "c.json")
    assert (record.source, record.n_vehicles, record.detector) == ("labels", 120, "detector")
    measured = labelled_boxes(tmp_path / "labels" / "a.txt", ("car",))
    assert record.reference_length_m == pytest.approx(
        modal_length_m([SurveyedImage(measured, GSD)]).mode_m
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["--out", "c.json"],
            "give the images with one of --dota DIR, --table FILE and --geotiff FILES",
        ),
        (["--table", "t.csv", "--out", "missing/c.json"], "there is no folder"),
        (["--table", "t.csv", "--out", "c.json"], "cannot read table"),
        (
            ["--table", "t.csv", "--out", "c.png", "--plot", "c.png"],
            "both the plot and the calibration",
        ),
        (["--dota", ".", "--out", "c.json"], "no images/ folder"),
    ],
)
def test_bad_arguments_are_refused_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    result = _run("calibrate", *arguments)
    assert result.exit_code == 2
    assert message in result.stderr


@pytest.fixture
def bad_files(folder: Path, tmp_path: Path) -> list[object]:
    """Command for three images, of which one is not an image and one has unreadable labels."""
    cars = (folder / "cars.png").read_bytes()
    for name, content in (("a", cars), ("b", cars), ("c", b"no image")):
        (tmp_path / f"{name}.png").write_bytes(content)
    (tmp_path / "b.txt").write_bytes(b"\xff\xfe")
    rows = "".join(f"{name}.png,{GSD}\n" for name in "abc")
    (tmp_path / "table.csv").write_text(f"file,gsd_m_per_px\n{rows}")
    return ["calibrate", "--table", tmp_path / "table.csv", "--out", tmp_path / "c.json"]


def test_an_unreadable_image_is_left_out(
    bad_files: list[object], folder: Path, tmp_path: Path
) -> None:
    result = _run(
        *bad_files, "--detector", folder / "detector.onnx", "--cache", tmp_path / "log.sqlite"
    )
    assert result.exit_code == 0, result.stderr
    assert "warning[image_undecodable]" in result.stderr
    assert load_calibration(tmp_path / "c.json").n_vehicles == 264
    assert n_results(tmp_path / "log.sqlite") == 2


def test_an_unreadable_file_of_labels_is_left_out(bad_files: list[object]) -> None:
    result = _run(*bad_files, "--from", "labels")
    assert result.exit_code == 2
    assert "warning[unreadable_labels]" in result.stderr
    assert "vehicles labelled for a reference length: 0;" in result.stderr


def test_photographs_with_a_line_of_known_length_need_no_georeference(
    folder: Path, tmp_path: Path
) -> None:
    lines = folder / "lines.csv"
    lines.write_text(f"file,x1,y1,x2,y2,metres\ncars.png,100,100,600,100,{500 * GSD}\n")
    common = [
        "--detector",
        folder / "detector.onnx",
        "--out",
        tmp_path / "c.json",
        "--known-lengths",
        lines,
    ]
    assert _run("calibrate", "--photographs", folder / "cars.png", *common).exit_code == 0
    assert load_calibration(tmp_path / "c.json").reference_length_m == pytest.approx(
        FLEET_M, rel=0.03
    )
    result = _run("calibrate", "--table", folder / "table.csv", *common)
    assert result.exit_code == 2
    assert "--photographs" in result.stderr


@pytest.mark.slow
@pytest.mark.parametrize("fleet_m", [3.9, 5.4])
def test_labels_give_the_length_of_a_fleet_within_a_percent(tmp_path: Path, fleet_m: float) -> None:
    (tmp_path / "images").mkdir()
    (tmp_path / "labelTxt-v1.5").mkdir()
    drawn = []
    for seed, gsd in enumerate((0.12, 0.15, 0.20)):
        scene = render_scene(
            gsd,
            width_px=1200,
            height_px=1200,
            seed=seed,
            layout="parking",
            mean_vehicle_length_m=fleet_m,
        )
        cv2.imwrite(str(tmp_path / "images" / f"P{seed:04}.png"), scene.image[:, :, ::-1])
        (tmp_path / "labelTxt-v1.5" / f"P{seed:04}.txt").write_text(
            f"imagesource:scene\n{scene.dota_text()}"
        )
        drawn += [v.length_px * gsd for v in scene.vehicles if v.kind == "small-vehicle"]
    result = CliRunner().invoke(
        cli.app, ["calibrate", "--dota", str(tmp_path), "--out", str(tmp_path / "c.json")]
    )
    assert result.exit_code == 0, result.stderr
    record = load_calibration(tmp_path / "c.json")
    assert record.n_vehicles == len(drawn) > 1000
    # the mode, by render_scene's contract
    assert record.reference_length_m == pytest.approx(1.010 * fleet_m, rel=0.01)
