from __future__ import annotations

import json
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from tests.analyses import measured_fleet
from tests.flight.ground import write_flight
from tests.flight.reconstruction.flights import Pose, write_opensfm
from tests.models import write_detector
from vehanchor.cli import app as cli
from vehanchor.storage.atomic import write_record
from vehanchor_flight.reconstruction.files import read_model
from vehanchor_flight.records import LiveScale

FLEET = list(30.0 * (1 + 0.06 * np.linspace(-1, 1, 9) ** 3))
DETECTOR = ("--detector", "detector.onnx")
LINE = ("--point", "100", "100", "--point", "200", "100")


def _invoke(*arguments: object) -> Result:
    return CliRunner().invoke(cli.app, [*map(str, arguments), *DETECTOR])


@pytest.fixture
def run(tmp_path: Path, plain_terminal: None, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Run ``vehanchor`` in a folder with a flight of four photographs, one of them without cars."""
    write_flight(tmp_path, [FLEET[0::3], FLEET[1::3], [], FLEET[2::3]])
    write_detector(tmp_path / "detector.onnx")
    monkeypatch.chdir(tmp_path)
    # Report each step of the progress in a log.
    monkeypatch.setattr("vehanchor.cli.terminal._LINE_EVERY_S", 0.0)
    return _invoke


def _progress(done: Result) -> list[str]:
    return [line for line in done.stderr.splitlines() if "images" in line]


def test_photographs_of_unknown_ratio_have_a_line_each(run: Any) -> None:
    done = run("flight", "0.png", "2.png")
    assert "own vehicles" in done.stdout
    assert "no other photograph overlaps it" in " ".join(done.stdout.split())


def test_progress_names_the_step(run: Any) -> None:
    done = run("flight", "0.png", "2.png")
    assert _progress(done) == [
        "searching 0 of 2 images",
        "searching 1 of 2 images",
        "linking 2 of 2 images",
    ]


def test_tables_fit_a_terminal_of_80_columns(
    run: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    (tmp_path / "not_a_photograph.jpg").write_text("text")
    names = [f"a_survey_of_the_northern_fields_{number}.png" for number in (0, 2)]
    for name in names:
        (tmp_path / name[-5:]).rename(tmp_path / name)
    done = run("flight", *names, "not_a_photograph.jpg")
    assert done.exit_code == 0, done.output
    lines = done.stdout.splitlines()
    assert max(map(len, lines)) <= 80
    assert "\u2026" not in done.stdout
    [table_start] = [n for n, line in enumerate(lines) if "95 % if right" in line]
    assert len([line for line in lines[table_start + 2 :] if line.strip()]) == 3
    assert {"no_scale", "error", "unreadable"} <= set(done.stdout.split())


def test_overlays_show_the_photographs_of_a_flight(run: Any, tmp_path: Path) -> None:
    done = run("flight", "0.png", "2.png", "--overlays", "drawn")
    assert done.exit_code == 0, done.output
    names = sorted(path.name for path in (tmp_path / "drawn").iterdir())
    assert names == ["0.png.overlay.png", "2.png.overlay.png"]


@pytest.mark.parametrize("out", ["flight.txt", "nowhere/flight.json"])
def test_an_output_that_cannot_be_written_is_refused_before_the_work(run: Any, out: str) -> None:
    done = run("flight", ".", "--out", out)
    assert done.exit_code == 2
    assert "output_unwritable" in done.stderr


@pytest.fixture
def flight_record(run: Any) -> Any:
    """Estimate all photographs with one scale; return the record that ``flight.json`` holds."""
    done = run("flight", "*.png", "--same-scale", "--json", "--out", "flight.json")
    return json.loads(done.stdout)


def test_json_is_the_record_of_the_file(flight_record: Any, tmp_path: Path) -> None:
    assert flight_record == json.loads((tmp_path / "flight.json").read_text())
    names = [photograph["photograph"] for photograph in flight_record["photographs"]]
    assert names == ["0.png", "1.png", "2.png", "3.png"]
    assert not (tmp_path / "flight.json.journal").exists()


def test_a_photograph_without_cars_is_measured_with_the_flights_scale(
    run: Any, flight_record: Any
) -> None:
    done = run("distance", "2.png", *LINE, "--scale", "flight.json", "--json")
    assert done.exit_code == 0, done.output
    record = json.loads(done.stdout)
    assert record["distance_m"] == pytest.approx(100 * flight_record["gsd_m_per_px"])
    assert record["scale_source"] == "reused"
    assert record["distance_ci95_low_m"] < 0.97 * record["distance_m"]


@pytest.mark.usefixtures("flight_record")
def test_the_flights_scale_is_refused_for_a_stranger(run: Any, tmp_path: Path) -> None:
    (tmp_path / "2.png").rename(tmp_path / "other.png")
    refused = run("distance", "other.png", *LINE, "--scale", "flight.json")
    assert refused.exit_code == 2
    assert "not there in the flight" in refused.stderr


@pytest.fixture
def folder_of_one_scale(run: Any, tmp_path: Path) -> Result:
    """Estimate a folder with an unreadable file, with one scale, and write a table."""
    (tmp_path / "4.png").write_bytes(b"no image")
    done: Result = run("flight", ".", "--same-scale", "--table", "scales.jsonl")
    assert done.exit_code == 0, done.output
    return done


def test_one_scale_is_printed_for_all(folder_of_one_scale: Result, tmp_path: Path) -> None:
    row = json.loads((tmp_path / "scales.jsonl").read_text().splitlines()[0])
    assert "scale of all" in folder_of_one_scale.stdout
    assert f"{row['gsd_m_per_px']:.4g}" in folder_of_one_scale.stdout
    assert _progress(folder_of_one_scale)[-1] == "pooling the evidence of 5 of 5 images"


@pytest.mark.usefixtures("folder_of_one_scale")
def test_each_row_of_a_table_has_the_scale_of_all(tmp_path: Path) -> None:
    rows = [json.loads(line) for line in (tmp_path / "scales.jsonl").read_text().splitlines()]
    readable = rows[:4]
    assert len({row["gsd_m_per_px"] for row in readable}) == 1
    assert [row["status"] for row in readable] == ["ok"] * 4
    assert [row["n_vehicles"] for row in readable] == [3, 3, 0, 3]
    assert rows[4]["error_code"] == "image_undecodable"
    assert not (tmp_path / "scales.jsonl.journal").exists()


def test_a_table_of_an_unknown_format_is_refused(run: Any) -> None:
    assert run("flight", ".", "--table", "scales.pdf").exit_code == 2


@pytest.fixture
def live(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Run ``vehanchor flight live`` in a folder with one photograph of cars."""
    write_flight(tmp_path, [FLEET])
    write_detector(tmp_path / "detector.onnx")
    monkeypatch.chdir(tmp_path)
    return partial(_invoke, "flight", "live")


def test_each_frame_is_one_line_of_json(live: Any) -> None:
    done = live(".", "--idle", 1)
    assert done.exit_code == 0, done.output
    (line,) = done.stdout.splitlines()
    record = LiveScale.model_validate(json.loads(line))
    assert record.frame == "0.png"
    assert record.gsd_m_per_px == pytest.approx(0.168, rel=0.02)


@pytest.mark.parametrize(
    "arguments",
    [
        ("nowhere",),
        (".", "--hold", "0"),
        (".", "--every", "nan"),
        (".", "--idle", "-1"),
        ("100", "--idle", "0.2"),
        ("9" * 5000, "--idle", "0.2"),
    ],
)
def test_a_wrong_argument_is_refused_before_the_work(live: Any, arguments: tuple[str, ...]) -> None:
    done = live(*arguments)
    assert done.exit_code == 2
    assert done.stderr.startswith("error[")


def test_a_missing_camera_is_an_error(
    live: Any, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vehanchor_flight.live.frames._RETRY_S", 0.05)
    done = live("97", "--idle", 0.5)
    assert done.exit_code == 2
    assert not done.stdout
    assert done.stderr.count("camera 97 gives no frames") == 1
    assert "WARN" not in capfd.readouterr().err


LENGTHS = 4.8 * (1 + 0.06 * np.linspace(-1, 1, 12) ** 3)


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a model at 92 % of its size, and a detector; return their folder."""
    folder = tmp_path_factory.mktemp("rescale")
    places = [(80 + 9 * (k % 4), 80 + 9 * (k // 4)) for k in range(12)]
    cars = np.column_stack([places, LENGTHS, np.arange(12) * 0.3])
    poses = [Pose(80, 80, 70), Pose(110, 85, 70, 8, 100), Pose(100, 90, 75)]
    photographs = [pose.painted(cars) for pose in poses]
    write_opensfm(folder / "project", photographs, poses=poses, metres_per_unit=1 / 0.92)
    write_detector(folder / "detector.onnx")
    write_record(folder / "fleet.json", measured_fleet(4.8))
    return folder


@pytest.fixture
def rescale(project: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Run ``vehanchor flight rescale`` in a copy of the folder."""
    shutil.copytree(project, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("NO_COLOR", "1")

    def invoke(*arguments: object) -> Result:
        return _invoke("flight", "rescale", *arguments, "--calibration", "fleet.json")

    return invoke


@pytest.fixture
def rescaled(rescale: Any) -> Result:
    """Rescale the model, and write all files."""
    done: Result = rescale(
        "project", "--project", "metric", "--geo", "geo.txt", "--out", "scale.json"
    )
    assert done.exit_code == 0, done.output
    return done


def test_the_verdict_is_printed(rescaled: Result) -> None:
    assert "too small" in rescaled.stdout
    assert "0.png" in rescaled.stdout
    assert max(map(len, rescaled.stdout.splitlines())) <= 80


@pytest.mark.usefixtures("rescaled")
def test_the_written_files_are_in_metres(tmp_path: Path) -> None:
    assert json.loads((tmp_path / "scale.json").read_text())["status"] == "ok"
    heights = [shot.centre[2] for shot in read_model(tmp_path / "metric").shots]
    assert heights == pytest.approx([70, 70, 75], rel=0.015)
    assert len((tmp_path / "geo.txt").read_text().splitlines()) == 4


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["nothing.json"], "reconstruction_unusable"),
        (["."], "reconstruction_unusable"),
        (["project", "--images", "."], "reconstruction_unusable"),
        (["project", "--geo", "nowhere/a.txt"], "output_unwritable"),
        (["project", "--project", "project"], "output_unwritable"),
    ],
)
def test_what_cannot_be_done_is_refused(rescale: Any, arguments: list[str], code: str) -> None:
    done = rescale(*arguments)
    assert done.exit_code == 2, done.output
    assert f"error[{code}]" in done.stderr


def test_a_missing_size_is_explained_in_sentences(rescale: Any, tmp_path: Path) -> None:
    pose = Pose(80, 80, 70)
    bare_ground = pose.painted(np.zeros((0, 4)))
    write_opensfm(tmp_path / "bare", [bare_ground], poses=[pose], metres_per_unit=1.0)
    words = " ".join(rescale("bare").stdout.split())
    assert "too_few" not in words
    assert "nothing of known size was found" in words


def test_nothing_is_written_without_a_usable_size(rescale: Any, tmp_path: Path) -> None:
    pose = Pose(80, 80, 70)
    bare_ground = pose.painted(np.zeros((0, 4)))
    write_opensfm(tmp_path / "bare", [bare_ground], poses=[pose], metres_per_unit=1.0)
    done = rescale("bare", "--geo", "geo.txt")
    assert done.exit_code == 3
    assert "no file in metres was written" in done.stderr
    assert not (tmp_path / "geo.txt").exists()


def test_a_running_camera_takes_no_basis_of_a_height_that_it_cannot_be_given() -> None:
    result = CliRunner().invoke(cli.app, ["flight", "live", "--help"])
    assert "--hold" in result.stdout
    assert "--height" not in result.stdout
