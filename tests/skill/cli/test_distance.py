"""``vehanchor distance``, exit statuses, and help."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import pytest
from typer.testing import CliRunner

from tests.models import blank_image, car_park, fleet, write_detector
from vehanchor.cli.app import app

POINTS = ["--point", "100", "150", "--point", "500", "450"]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """An image with vehicles, and a detector that finds them."""
    folder = tmp_path_factory.mktemp("place")
    assert cv2.imwrite(str(folder / "place.png"), car_park(fleet(30), 800, 600)[:, :, ::-1])
    return folder / "place.png", write_detector(folder / "painted.onnx")


def run(*arguments: object) -> tuple[int, str, str]:
    """Run ``vehanchor``; return its status, stdout and stderr."""
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    return result.exit_code, result.stdout, result.stderr


def test_a_distance_is_printed_with_its_interval(place: tuple[Path, Path]) -> None:
    code, out, _ = run("distance", place[0], *POINTS, "--gsd", "0.1")
    assert code == 0
    assert "50.00 m  (95 %: " in out
    assert "2 points, 500.0 px" in out


def test_a_scale_in_centimetres_is_warned_of(place: tuple[Path, Path]) -> None:
    code, _, err = run("distance", place[0], *POINTS, "--gsd", "15")
    assert code == 0
    assert "15 metres per pixel. Were centimetres meant? Then give 0.15." in err


def test_a_coarse_scale_in_metres_is_not_warned_of(place: tuple[Path, Path]) -> None:
    _, _, err = run("distance", place[0], *POINTS, "--gsd", "1.5")
    assert "centimetres" not in err


@pytest.fixture(scope="module")
def scale_file(place: tuple[Path, Path]) -> Path:
    """The output of ``vehanchor estimate`` for the image."""
    image, detector = place
    code, out, _ = run("estimate", image, "--json", "--detector", detector, "--rulers", "vehicles")
    assert code == 0
    path = image.with_name("scale.json")
    path.write_text(out)
    return path


def test_a_scale_of_an_earlier_estimate_needs_no_detector(
    place: tuple[Path, Path], scale_file: Path
) -> None:
    reused = ("--scale", scale_file, "--detector", "nowhere.onnx")
    code, out, _ = run("distance", place[0], *POINTS, *reused, "--json")
    record = json.loads(out)
    assert (code, record["scale_source"], record["status"]) == (0, "reused", "ok")
    gsd = json.loads(scale_file.read_text())["gsd_m_per_px"]
    assert record["distance_m"] == pytest.approx(500 * gsd)


def test_points_may_be_fractions_of_the_sides(place: tuple[Path, Path], scale_file: Path) -> None:
    in_pixels = run("distance", place[0], *POINTS, "--scale", scale_file, "--json")
    points = ["--point", "0.125", "0.25", "--point", "0.625", "0.75", "--coordinates", "fraction"]
    by_fraction = run("distance", place[0], *points, "--scale", scale_file, "--json")
    distances = [json.loads(out)["distance_m"] for _, out, _ in (in_pixels, by_fraction)]
    assert distances[1] == pytest.approx(distances[0])


def test_files_that_a_console_of_windows_wrote_are_read(
    place: tuple[Path, Path], scale_file: Path, tmp_path: Path
) -> None:
    scale = tmp_path / "scale.json"
    scale.write_text(scale_file.read_text(), encoding="utf-16")
    options = tmp_path / "options.toml"
    options.write_text("", encoding="utf-8-sig")
    code, out, _ = run("distance", place[0], *POINTS, "--scale", scale, "--options", options)
    assert code == 0
    assert " m " in out


@pytest.mark.parametrize("text", ["{}", "no json", '{"scale": null}', "[]"])
def test_a_file_without_a_scale_is_refused(
    place: tuple[Path, Path], tmp_path: Path, text: str
) -> None:
    (tmp_path / "scale.json").write_text(text)
    code, _, err = run("distance", place[0], *POINTS, "--scale", tmp_path / "scale.json")
    assert code == 2
    assert "error[invalid_parameter]: --scale" in err


@pytest.mark.parametrize("command", [["estimate"], ["distance", *POINTS]])
def test_with_strict_a_result_without_a_scale_ends_with_3(
    place: tuple[Path, Path], tmp_path: Path, command: list[str]
) -> None:
    empty = tmp_path / "empty.png"
    assert cv2.imwrite(str(empty), blank_image(800, 600))
    arguments = (*command, empty, "--detector", place[1])
    assert run(*arguments)[0] == 0
    assert run(*arguments, "--strict")[0] == 3


def test_with_strict_a_usable_result_ends_with_0(place: tuple[Path, Path]) -> None:
    image, detector = place
    by_vehicles = ("--detector", detector, "--rulers", "vehicles")
    assert run("estimate", image, *by_vehicles, "--strict")[0] == 0


def test_estimate_of_a_folder_names_batch(tmp_path: Path) -> None:
    code, _, err = run("estimate", tmp_path)
    assert code == 2
    assert f"error[image_not_found]: {str(tmp_path)!r} is a folder: " in err
    assert f"is a folder: 'vehanchor batch {tmp_path} --out" in err


def test_help_shows_commands_in_panels() -> None:
    code, out, _ = run("--help")
    assert code == 0
    panels = ["Measure", "For agents", "This installation", "Calibrate and evaluate"]
    for panel, command in zip(panels, ("distance", "serve", "models", "calibrate"), strict=True):
        assert out.index(panel) < out.index(command, out.index(panel))


# Options that people need in --help; the others are for a file.
USUAL_OPTIONS = """
    --rulers --height --height-basis --focal-35mm --metadata --known-length --region
    --drop --add --calibration --preset --options --json
"""


def _shown_options(command: str) -> list[str]:
    _, out, _ = run(command, "--help")
    return re.findall(r"^│ (?:\* +)?(--[\w-]+)", out, re.MULTILINE)


@pytest.mark.parametrize("command", ["estimate", "distance", "measure"])
def test_help_shows_usual_options(command: str) -> None:
    assert set(USUAL_OPTIONS.split()) <= set(_shown_options(command))


@pytest.mark.parametrize("command", ["estimate", "distance", "measure"])
def test_help_leaves_other_options_to_a_file(command: str) -> None:
    _, out, _ = run(command, "--help")
    assert "--tile" not in out


def test_help_of_estimate_shows_outputs() -> None:
    assert {"--scale-bar", "--geotiff"} <= set(_shown_options("estimate"))


def test_help_of_estimate_shows_at_most_19_options() -> None:
    options = _shown_options("estimate")
    assert len(options) - ("--help" in options) <= 19
