from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from tests.models import blank_image, paint_vehicles, write_detector
from tests.sam_models import write_sam
from vehanchor import measure_area, records
from vehanchor.cli import app as cli

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray
    from typer.testing import Result

BOX = ("410.7", "273.9", "477.3", "382.1")
POOL = [420, 280, 468, 376]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Images of a pool among 20 cars, and of one without cars; models."""
    path = tmp_path_factory.mktemp("cli_measure")
    for name, n_vehicles in (("cars", 20), ("none", 0)):
        image = blank_image(800, 600)
        image[280:376, 420:468] = (40, 140, 210)
        boxes = [[50 + 70 * (i % 10), 60 + 90 * (i // 10), 29 + 0.1 * i, 12, 0.3] for i in range(n_vehicles)]
        paint_vehicles(image, np.reshape(boxes, (-1, 5)))
        cv2.imwrite(str(path / f"{name}.png"), image[:, :, ::-1])
    write_detector(path / "detector.onnx")
    write_sam(path)
    return path


@pytest.fixture
def run(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Runs ``vehanchor measure`` in the folder of images, with its models."""
    monkeypatch.chdir(folder)
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setenv("NO_COLOR", "1")
    monkeypatch.delenv("VEHANCHOR_TRACEBACK", raising=False)
    models = ["--detector", "detector.onnx", "--segmenter", "encoder.onnx", "decoder.onnx"]

    def invoke(*arguments: object) -> Result:
        return CliRunner().invoke(cli.app, ["measure", *models, *(str(argument) for argument in arguments)])

    return invoke


def _line(result: Result) -> dict[str, Any]:
    (line,) = result.stdout.splitlines()
    record: dict[str, Any] = json.loads(line)
    return record


def _read(path: Path) -> NDArray[Any]:
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    return picture


def test_json_is_the_record_and_its_source(run: Any, folder: Path) -> None:
    result = run("cars.png", "--box", *BOX, "--json")
    assert result.exit_code == 0, result.output
    assert result.stderr == ""
    line = _line(result)
    assert line.pop("source") == "cars.png"
    expected = measure_area(
        folder / "cars.png",
        box=(410.7, 273.9, 477.3, 382.1),
        detector=folder / "detector.onnx",
        segmenter=(folder / "encoder.onnx", folder / "decoder.onnx"),
    )
    assert line == expected.model_dump(mode="json")
    assert records.AreaMeasurement.model_validate_json(json.dumps(line)) == expected
    assert list(line["bounding_box"].values()) == POOL


def test_a_readable_table_tells_area_circle_and_scale(run: Any) -> None:
    result = run("cars.png", "--box", *BOX)
    assert result.exit_code == 0, result.output
    assert result.stderr == ""
    for fact in ("m2  (95 %:", "largest circle", "perimeter", "m/px  (95 %:", "20 kept of 20 found", "score 0.90"):
        assert fact in result.stdout
    given = run("none.png", "--box", *BOX, "--gsd", "0.2")
    assert "0.2 m/px, given" in given.stdout
    none = run("none.png", "--box", *BOX)
    assert none.exit_code == 0
    assert "none: there is no scale" in none.stdout
    assert "no_scale" in none.stdout


def test_points_can_be_repeated_and_denied(run: Any) -> None:
    by_point = _line(run("cars.png", "--point", 444, 330, "--gsd", 0.2, "--json"))
    more = run("cars.png", "--json", "--point", 444, 330, "--point", 440.5, 300, "--negative", 20, 560, "--gsd", 0.2)
    assert more.exit_code == 0, more.output
    assert by_point["mask_area_px"] > 2500  # its sides are not on cells
    assert _line(more)["mask_area_px"] == pytest.approx(by_point["mask_area_px"], rel=0.1)
    denied = run("cars.png", "--json", "--point", 444, 330, "--negative", 444, 330, "--gsd", 0.2)
    assert [notice["code"] for notice in _line(denied)["warnings"]] == ["mask_empty"]
    assert by_point["scale_source"] == "given"


def test_other_objects_at_a_point_are_listed_with_their_boxes(run: Any, folder: Path) -> None:
    image = blank_image(800, 800)
    image[376:424, 376:424] = image[376:424, 504:552] = (40, 140, 210)
    cv2.imwrite(str(folder / "two.png"), image[:, :, ::-1])
    given = ("two.png", "--point", 392, 392, "--gsd", 0.5)
    listed = run(*given).stdout
    assert "or the object" in listed
    assert "--box 376 376 552 424" in listed
    first = _line(run(*given, "--json"))["alternatives"][0]
    assert first["area_m2"] == first["mask_area_px"] / 4
    assert first["bounding_box"] == {"x1_px": 376, "y1_px": 376, "x2_px": 552, "y2_px": 424}
    assert _line(run("two.png", "--box", 370, 370, 430, 430, "--gsd", 0.5, "--json"))["alternatives"] == []


def test_overlay_and_mask_are_written(run: Any, tmp_path: Path) -> None:
    over, mask = tmp_path / "over.jpg", tmp_path / "mask.png"
    result = run("cars.png", "--box", *BOX, "--json", "--overlay", over, "--mask", mask)
    assert result.exit_code == 0, result.output
    shown = _read(over)
    assert max(shown.shape) <= 1000
    pool = (np.abs(shown[:, :, ::-1].astype(int) - [97, 133, 195]).max(2) < 25).nonzero()  # tinted
    # the box of 67 x 108 px with a margin of 54 px, four times enlarged
    assert np.ptp(pool[1]) == pytest.approx(4 * (POOL[2] - POOL[0]), abs=12)
    assert np.ptp(pool[0]) == pytest.approx(4 * (POOL[3] - POOL[1]), abs=12)
    written = _read(mask)
    assert written.shape[:2] == (600, 800)
    assert set(np.unique(written)) == {0, 255}
    assert int((written.reshape(600, 800, -1)[:, :, 0] > 0).sum()) == _line(result)["mask_area_px"]
    rows, columns = np.nonzero(written.reshape(600, 800, -1)[:, :, 0])
    assert [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1] == POOL


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
def test_bad_input_ends_with_status_2_and_one_line(run: Any, arguments: list[str], code: str) -> None:
    result = run("cars.png", *arguments)
    assert result.exit_code == 2
    assert result.stdout == ""
    assert result.stderr.startswith(f"error[{code}]: ")
    assert result.stderr.count("\n") == 1
    assert _line(run("cars.png", "--json", *arguments))["error"]["code"] == code


def test_warnings_follow_the_table(run: Any) -> None:
    result = run("cars.png", "--box", "440", "300", "450", "310", "--gsd", "0.2")
    assert result.exit_code == 0
    assert "warning[target_small]: " in result.stderr
    assert run("cars.png", "--box", "440", "300", "450", "310", "--gsd", "0.2", "--json").stderr == ""
