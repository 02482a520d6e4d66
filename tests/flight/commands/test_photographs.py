from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from typer.testing import CliRunner

from tests.flight.photographs import write_flight
from tests.models import write_detector
from vehanchor.cli import app as cli

if TYPE_CHECKING:
    from pathlib import Path

    from typer.testing import Result

FLEET = list(30.0 * (1 + 0.06 * np.linspace(-1, 1, 9) ** 3))


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Runs ``vehanchor`` in a folder with a flight of four photographs, one of them without cars."""
    write_flight(tmp_path, [FLEET[0::3], FLEET[1::3], [], FLEET[2::3]])
    write_detector(tmp_path / "detector.onnx")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setenv("NO_COLOR", "1")

    def invoke(command: str, *arguments: object) -> Result:
        return CliRunner().invoke(cli.app, [command, *map(str, arguments), "--detector", "detector.onnx"])

    return invoke


def test_a_folder_of_one_scale_is_told_in_a_table(run: Any) -> None:
    done = run("flight", ".", "--same-scale")
    assert done.exit_code == 0, done.output
    assert "scale of all" in done.stdout
    assert "0.168" in done.stdout


def test_json_is_the_record_and_nothing_else(run: Any, tmp_path: Path) -> None:
    done = run("flight", "*.png", "--same-scale", "--json", "--out", "flight.json")
    record = json.loads(done.stdout)
    assert record == json.loads((tmp_path / "flight.json").read_text())
    assert [each["photograph"] for each in record["photographs"]] == ["0.png", "1.png", "2.png", "3.png"]
    assert not (tmp_path / "flight.json.journal").exists()


def test_photographs_of_unknown_ratio_each_have_a_line(run: Any) -> None:
    done = run("flight", "0.png", "2.png")
    assert "its own vehicles" in done.stdout
    assert "no other photograph overlaps it" in " ".join(done.stdout.split())


def test_tables_fit_a_terminal_of_80_columns(run: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    (tmp_path / "not_a_photograph.jpg").write_text("text")
    for number in range(4):
        (tmp_path / f"{number}.png").rename(tmp_path / f"a_survey_of_the_northern_fields_{number}.png")
    done = run("flight", ".")
    assert done.exit_code == 0, done.output
    assert max(map(len, done.stdout.splitlines())) <= 80
    assert "\u2026" not in done.stdout
    assert {"none", "error"} <= set(done.stdout.split())


@pytest.mark.parametrize("out", ["flight.txt", "nowhere/flight.json"])
def test_an_output_that_cannot_be_written_is_told_before_the_work(run: Any, out: str) -> None:
    done = run("flight", ".", "--out", out)
    assert done.exit_code == 2
    assert "output_unwritable" in done.stderr


def test_the_scale_of_a_photograph_without_cars_is_given_back(run: Any, tmp_path: Path) -> None:
    assert run("flight", ".", "--same-scale", "--out", "flight.json").exit_code == 0
    scale = json.loads((tmp_path / "flight.json").read_text())["gsd_m_per_px"]
    line = ["--point", "100", "100", "--point", "200", "100"]
    done = run("distance", "2.png", *line, "--scale", "flight.json", "--json")
    assert done.exit_code == 0, done.output
    record = json.loads(done.stdout)
    assert record["distance_m"] == pytest.approx(100 * scale)
    assert record["scale_source"] == "reused"
    assert record["distance_ci95_low_m"] < 0.97 * record["distance_m"]
    (tmp_path / "2.png").rename(tmp_path / "other.png")
    refused = run("distance", "other.png", *line, "--scale", "flight.json")
    assert refused.exit_code == 2
    assert "not there in the flight" in refused.stderr


def test_a_table_has_the_scale_of_the_flight_in_every_row(run: Any, tmp_path: Path) -> None:
    (tmp_path / "4.png").write_bytes(b"no image")
    done = run("flight", ".", "--same-scale", "--table", "scales.jsonl")
    assert done.exit_code == 0, done.output
    rows = [json.loads(line) for line in (tmp_path / "scales.jsonl").read_text().splitlines()]
    assert len({row["gsd_m_per_px"] for row in rows[:4]}) == 1
    assert [row["status"] for row in rows[:4]] == ["ok"] * 4
    assert [row["n_vehicles"] for row in rows[:4]] == [3, 3, 0, 3]
    assert rows[4]["error_code"] == "image_undecodable"
    assert not (tmp_path / "scales.jsonl.journal").exists()
    assert run("flight", ".", "--table", "scales.pdf").exit_code == 2


@pytest.mark.parametrize(("arguments", "last"), [((), "linking"), (("--same-scale",), "pooling the evidence of")])
def test_progress_names_the_present_work(
    run: Any, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], last: str
) -> None:
    monkeypatch.setattr("vehanchor.cli.terminal._LINE_EVERY_S", 0.0)
    done = run("flight", ".", *arguments)
    told = [line for line in done.stderr.splitlines() if "images" in line]
    assert told == [*(f"searching {number} of 4 images" for number in range(4)), f"{last} 4 of 4 images"]
