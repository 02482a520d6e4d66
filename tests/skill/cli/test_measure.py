"""``vehanchor measure``: its record, its facts, its prompts, its files."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from tests.models import POOL, blank_image, pool_among_cars, write_detector
from tests.sam_models import write_sam
from vehanchor import measure_area, records
from vehanchor.cli import app as cli

if TYPE_CHECKING:
    from pathlib import Path

    from typer.testing import Result

BOX = ("410.7", "273.9", "477.3", "382.1")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Images of a pool among 20 cars, and of one without cars; models."""
    path = tmp_path_factory.mktemp("cli_measure")
    for name, n_vehicles in (("cars", 20), ("none", 0)):
        cv2.imwrite(str(path / f"{name}.png"), pool_among_cars(n_vehicles)[:, :, ::-1])
    write_detector(path / "detector.onnx")
    write_sam(path)
    return path


@pytest.fixture
def run(folder: Path, plain_terminal: None, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Run ``vehanchor measure`` in the folder of images, with its models."""
    monkeypatch.chdir(folder)
    models = ["--detector", "detector.onnx", "--segmenter", "encoder.onnx", "decoder.onnx"]

    def invoke(*arguments: object) -> Result:
        texts = [str(argument) for argument in arguments]
        return CliRunner().invoke(cli.app, ["measure", *models, *texts])

    return invoke


def _line(result: Result) -> dict[str, Any]:
    (line,) = result.stdout.splitlines()
    record: dict[str, Any] = json.loads(line)
    return record


def test_json_is_the_record_with_its_photograph(run: Any, folder: Path) -> None:
    result = run("cars.png", "--box", *BOX, "--json")
    assert result.exit_code == 0, result.output
    assert result.stderr == ""
    line = _line(result)
    assert line.pop("photograph") == "cars.png"
    expected = measure_area(
        folder / "cars.png",
        box=(410.7, 273.9, 477.3, 382.1),
        detector=folder / "detector.onnx",
        segmenter=(folder / "encoder.onnx", folder / "decoder.onnx"),
    )
    assert line == expected.model_dump(mode="json")
    assert records.AreaMeasurement.model_validate_json(json.dumps(line)) == expected
    assert list(line["bounding_box"].values()) == list(POOL)


def test_the_facts_have_sizes_with_the_scale(run: Any) -> None:
    result = run("cars.png", "--box", *BOX)
    assert result.exit_code == 0, result.output
    assert result.stderr == ""
    for fact in (
        "m2  (95 %:",
        "largest circle",
        "perimeter",
        "m/px  (95 %:",
        "20 kept of 20 found",
        "score 0.90",
    ):
        assert fact in result.stdout


def test_the_facts_show_a_scale_that_the_caller_gives(run: Any) -> None:
    result = run("none.png", "--box", *BOX, "--gsd", "0.2")
    assert "0.2 m/px, given" in result.stdout


def test_the_facts_show_that_there_is_no_scale(run: Any) -> None:
    result = run("none.png", "--box", *BOX)
    assert result.exit_code == 0
    assert "none: there is no scale" in result.stdout
    assert "no_scale" in result.stdout


ON_POOL = ("--json", "--gsd", 0.2, "--point", 444, 330)


@pytest.fixture
def by_point(run: Any) -> dict[str, Any]:
    return _line(run("cars.png", *ON_POOL))


def test_a_point_is_a_prompt(by_point: dict[str, Any]) -> None:
    assert by_point["mask_area_px"] > 2500, "a part of the pool may be missing at its sides"
    assert by_point["scale_source"] == "given"


def test_points_can_be_repeated(run: Any, by_point: dict[str, Any]) -> None:
    result = run("cars.png", *ON_POOL, "--point", 440.5, 300, "--negative", 20, 560)
    assert result.exit_code == 0, result.output
    assert _line(result)["mask_area_px"] == pytest.approx(by_point["mask_area_px"], rel=0.1)


def test_a_point_that_is_also_negative_has_no_mask(run: Any) -> None:
    result = run("cars.png", *ON_POOL, "--negative", 444, 330)
    assert [notice["code"] for notice in _line(result)["warnings"]] == ["mask_empty"]


def test_other_objects_at_a_point_are_listed_with_their_boxes(run: Any, folder: Path) -> None:
    image = blank_image(800, 800)
    image[376:424, 376:424] = (40, 140, 210)
    image[376:424, 504:552] = (40, 140, 210)
    cv2.imwrite(str(folder / "two.png"), image[:, :, ::-1])
    facts = run("two.png", "--point", 392, 392, "--gsd", 0.5).stdout
    assert "or the object" in facts
    assert "at x 376 to 552, y 376 to 424: draw a box by eye" in facts


def test_the_mask_is_written_in_the_size_of_the_image(run: Any, tmp_path: Path) -> None:
    path = tmp_path / "mask.png"
    result = run("cars.png", "--box", *BOX, "--json", "--gsd", "0.2", "--mask", path)
    assert result.exit_code == 0, result.output
    mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert mask is not None
    assert mask.shape == (600, 800)
    assert set(np.unique(mask)) == {0, 255}
    assert int((mask > 0).sum()) == _line(result)["mask_area_px"]
    rows, columns = np.nonzero(mask)
    assert [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1] == list(POOL)


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        ([], "invalid_prompt"),
        (["--point", "x", "10"], "invalid_prompt"),
        (["--point", "10", "--gsd"], "invalid_prompt"),
        (["--box", *BOX, "--frame", "400", "400"], "frame_mismatch"),
        (["--box", *BOX, "--segmenter", "encoder.onnx", "missing.onnx"], "model_not_found"),
        (["--box", *BOX, "--mask", "out.jpg"], "output_unwritable"),
    ],
)
def test_bad_input_is_one_line_with_status_2(run: Any, arguments: list[str], code: str) -> None:
    result = run("cars.png", *arguments)
    assert result.exit_code == 2
    assert result.stdout == ""
    assert result.stderr.startswith(f"error[{code}]: ")
    assert result.stderr.count("\n") == 1
    assert _line(run("cars.png", "--json", *arguments))["error"]["code"] == code


# --- Shapes of the caller's own


POLYGON = "420,280,468,280,468,376,420,376"


def test_a_polygon_is_measured_without_a_segmenter(run: Any) -> None:
    result = run(
        "cars.png", "--polygon", POLYGON, "--gsd", 0.1, "--json", "--segmenter", "no", "no"
    )
    record = _line(result)
    assert record["area_m2"] == pytest.approx(48 * 96 * 0.01)
    assert record["segmenter"] is None


def test_facts_name_the_shape(run: Any) -> None:
    result = run("cars.png", "--polygon", POLYGON, "--gsd", 0.1)
    assert "your polygon, 4608 px" in result.stdout
    assert "segmenter" not in result.stdout


@pytest.fixture
def two_shapes(run: Any, tmp_path: Path) -> tuple[Result, Path]:
    """Two shapes of a file, with their outlines and masks."""
    ids = np.zeros((600, 800), np.uint8)
    ids[10:30, 10:30] = 3
    ids[50:60, 50:60] = 8
    cv2.imwrite(str(tmp_path / "ids.png"), ids)
    outputs = ["--outline", tmp_path / "o.geojson", "--mask", tmp_path / "m.png"]
    outputs += ["--overlay", tmp_path / "overlay.png"]
    result = run("cars.png", "--shapes", tmp_path / "ids.png", "--gsd", 0.1, "--json", *outputs)
    return result, tmp_path


def test_several_shapes_are_several_measurements(two_shapes: tuple[Result, Path]) -> None:
    result, _ = two_shapes
    record = _line(result)
    areas = [measurement["area_m2"] for measurement in record["measurements"]]
    assert areas == pytest.approx([4.0, 1.0])


def test_several_shapes_are_written_to_one_file(two_shapes: tuple[Result, Path]) -> None:
    _, folder = two_shapes
    features = json.loads((folder / "o.geojson").read_text())["features"]
    assert [feature["properties"]["name"] for feature in features] == ["3", "8"]
    mask = cv2.imread(str(folder / "m.png"), cv2.IMREAD_GRAYSCALE)
    assert mask is not None
    assert cv2.countNonZero(mask) == 500
    assert (folder / "overlay.png").stat().st_size > 0


def test_several_shapes_are_listed_with_their_names(run: Any, two_shapes: Any) -> None:
    _, folder = two_shapes
    result = run("cars.png", "--shapes", folder / "o.geojson", "--gsd", 0.1)
    assert result.exit_code == 0, result.stderr
    assert "1: 3" in result.stdout
    assert "2: 8" in result.stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--polygon", "1,2,x"], "--polygon is '1,2,x': use numbers with commas"),
        (["--polygon", "1,2,3,4"], "--polygon: the polygon has fewer than 3"),
        (["--polygon", POLYGON, "--box", *BOX], "a box or points, or your own --polygon"),
        (["--box", *BOX, "--edge", "2"], "--edge and --orientation are about"),
        (["--polygon", POLYGON, "--orientation", "up"], "use oriented or stored"),
    ],
)
def test_bad_shapes_end_the_command(run: Any, arguments: list[str], message: str) -> None:
    result = run("cars.png", "--gsd", 0.1, *arguments)
    assert result.exit_code == 2
    assert message in result.stderr


# --- What must fit


@pytest.mark.parametrize(
    ("size", "words"),
    [("4", "a circle of 4 m fits with probability"), ("9x4", "9 x 4 m fits with probability")],
)
def test_a_shape_that_must_fit_is_stated(run: Any, size: str, words: str) -> None:
    result = run("cars.png", "--polygon", POLYGON, "--gsd", 0.1, "--must-fit", size)
    assert words in result.stdout
    assert "best at x 444, y 3" in " ".join(result.stdout.split())


@pytest.mark.parametrize("size", ["wide", "1x2x3", "0", "-1x2"])
def test_a_bad_shape_to_fit_ends_the_command(run: Any, size: str) -> None:
    result = run("cars.png", "--polygon", POLYGON, "--gsd", 0.1, f"--must-fit={size}")
    assert result.exit_code == 2
    assert "must" in result.stderr
