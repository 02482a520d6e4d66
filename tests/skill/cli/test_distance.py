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
    result = CliRunner().invoke(app, [str(each) for each in arguments])
    return result.exit_code, result.stdout, result.stderr


def test_a_distance_is_told_with_its_interval(place: tuple[Path, Path]) -> None:
    code, out, _ = run("distance", place[0], *POINTS, "--gsd", "0.1")
    assert code == 0
    assert "50.00 m  (95 %: " in out
    assert "2 points, 500.0 px" in out


def test_a_scale_that_looks_like_centimetres_is_asked_about(place: tuple[Path, Path]) -> None:
    code, _, err = run("distance", place[0], *POINTS, "--gsd", "15")
    assert code == 0
    assert "15 metres per pixel. Were centimetres meant? Then give 0.15." in err
    assert "centimetres" not in run("distance", place[0], *POINTS, "--gsd", "1.5")[2]


def test_a_scale_is_estimated_once_and_taken_from_its_record_after_that(
    place: tuple[Path, Path], tmp_path: Path
) -> None:
    code, out, _ = run(
        "estimate", place[0], "--json", "--detector", place[1], "--rulers", "vehicles"
    )
    assert code == 0
    kept = tmp_path / "scale.json"
    kept.write_text(out)
    code, out, _ = run(
        "distance", place[0], *POINTS, "--scale", kept, "--json", "--detector", "nowhere.onnx"
    )
    record = json.loads(out)
    assert (code, record["scale_source"], record["status"]) == (0, "reused", "ok")
    assert record["distance_m"] == pytest.approx(500 * json.loads(kept.read_text())["gsd_m_per_px"])
    shares = ["--point", "0.125", "0.25", "--point", "0.625", "0.75", "--coordinates", "fraction"]
    by_share = run("distance", place[0], *shares, "--scale", kept, "--json")
    assert json.loads(by_share[1])["distance_m"] == pytest.approx(record["distance_m"])


@pytest.mark.parametrize("text", ["{}", "no json", '{"scale": null}', "[]"])
def test_a_file_without_a_scale_is_refused(
    place: tuple[Path, Path], tmp_path: Path, text: str
) -> None:
    (tmp_path / "scale.json").write_text(text)
    code, _, told = run("distance", place[0], *POINTS, "--scale", tmp_path / "scale.json")
    assert code == 2
    assert "error[invalid_parameter]: --scale" in told


def test_a_result_that_is_not_ok_ends_with_3_where_that_is_asked_for(
    place: tuple[Path, Path], tmp_path: Path
) -> None:
    empty = tmp_path / "empty.png"
    assert cv2.imwrite(str(empty), blank_image(800, 600))
    for command in (["estimate", empty], ["distance", empty, *POINTS]):
        assert run(*command, "--detector", place[1])[0] == 0
        assert run(*command, "--detector", place[1], "--strict")[0] == 3
    assert (
        run("estimate", place[0], "--detector", place[1], "--rulers", "vehicles", "--strict")[0]
        == 0
    )


def test_estimate_of_a_folder_names_batch(tmp_path: Path) -> None:
    code, _, told = run("estimate", tmp_path)
    assert code == 2
    assert (
        f"error[image_not_found]: {str(tmp_path)!r} is a folder: 'vehanchor batch {tmp_path} -o"
        in told
    )


def test_help_shows_commands_in_panels() -> None:
    code, out, _ = run("--help")
    assert code == 0
    panels = ["Measure", "For agents", "This installation", "Calibrate and evaluate"]
    for panel, command in zip(panels, ("distance", "serve", "models", "calibrate"), strict=True):
        assert out.index(panel) < out.index(command, out.index(panel))


@pytest.mark.parametrize("command", ["estimate", "distance", "measure"])
def test_help_shows_what_people_need_and_a_file_for_the_rest(command: str) -> None:
    _, out, _ = run(command, "--help")
    shown = re.findall(r"^│ (?:\* +)?(--[\w-]+)", out, re.MULTILINE)
    needed = {
        "--rulers",
        "--height",
        "--height-basis",
        "--focal-35mm",
        "--metadata",
        "--drop",
        "--add",
        "--options",
    }
    needed |= {"--json", "--calibration", "--preset", "--known-length", "--region"}
    assert needed <= set(shown)
    assert "--tile" not in out
    if command == "estimate":
        assert {"--scale-bar", "--geotiff"} <= set(shown)
        assert len(shown) - ("--help" in shown) <= 18
