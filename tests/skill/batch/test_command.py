"""``vehanchor batch``: its report, its options, its lines of known length."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
from typer.testing import Result

from tests.skill.batch.runs import assert_same_fields, read_rows, run_command
from vehanchor import estimate_gsd
from vehanchor.errors import KnownLengthError
from vehanchor.rulers.known_length_table import lines_in


def _finished(table: Path, detector: Path, *images: str) -> Result:
    return run_command(*images, "-o", table, "--overwrite", "--detector", detector, "--workers", 1)


def test_the_command_reports_progress_causes_and_numbers(
    detector: Path, table: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vehanchor.cli.terminal._LINE_EVERY_S", 0.0)
    result = run_command(
        ".", "no such.png", "--output", table, "--detector", detector, "--workers", 1
    )
    assert result.exit_code == 0, result.output
    assert result.stdout == ""
    *lines, last = result.stderr.splitlines()
    assert lines == [
        *(f"{n} of 5 images" for n in range(6)),
        f"1 x image_undecodable, as in broken.jpg: {read_rows(table)[0]['error']}",
        "1 x too_few, as in empty.png: no car was found; include the cars, or draw lines over two "
        "different things of known size, if they are in sight, or measure one length, on the "
        "ground or on a map, or give other photographs of the same flight, with cars, or give "
        "the camera's height and focal length",
        f"1 x image_not_found, as in no such.png: {read_rows(table)[-1]['error']}",
    ]
    assert last.startswith(f"wrote {table}: 5 rows (2 ok, 1 no_scale, 2 error); 5 images in ")
    assert read_rows(table)[-1]["error_code"] == "image_not_found"


def test_the_command_fails_if_no_image_can_be_used(detector: Path, table: Path) -> None:
    result = _finished(table, detector, "broken.jpg")
    assert result.exit_code == 1
    last = result.stderr.splitlines()[-1]
    assert last == "no image could be used: the columns error_code and error explain why"


def test_the_summary_of_one_image_has_singular_nouns(detector: Path, table: Path) -> None:
    result = _finished(table, detector, "empty.png")
    last = result.stderr.splitlines()[-1]
    assert last.startswith(f"wrote {table}: 1 row (1 no_scale); 1 image in ")


def test_overlays_lie_as_their_photographs(detector: Path, table: Path, tmp_path: Path) -> None:
    folder = tmp_path / "overlays"
    result = _finished(table, detector, "cars.png", "broken.jpg", "--overlays", str(folder))
    assert result.exit_code == 0, result.output
    assert [path.name for path in folder.iterdir()] == ["cars.png.overlay.png"]
    assert result.stderr.splitlines()[-1] == f"wrote {folder}"


def test_batch_takes_the_options_of_estimate(detector: Path, table: Path) -> None:
    options: list[object] = ["--alpha", 1, "--region", "europe", "--tile", 512]
    options += ["--bands", 3, 2, 1, "--provider", "cpu", "--class", 0]
    result = run_command("cars.png", "-o", table, "--detector", detector, "--workers", 1, *options)
    assert result.exit_code == 0, result.output
    (row,) = read_rows(table)
    estimate = estimate_gsd(
        "cars.png", detector=detector, alpha=1.0, region="europe", tile_px=512, bands=(3, 2, 1)
    )
    assert_same_fields(row, estimate)


# --- Lines of known length


@pytest.fixture
def with_lines(folder: Path, detector: Path, table: Path) -> list[dict[str, Any]]:
    """Rows of an image without lines, and of one with two lines at 0.12 m/px."""
    lines = table.with_name("lines.csv")
    file = os.path.relpath(folder / "empty.png", lines.parent)
    lines.write_text(
        f"file,x1,y1,x2,y2,metres,who\n{file},100,50,500,50,48,Ann\n{file},100,50,100,250,24,Ann\n"
    )
    result = run_command(*_two_images(detector), "-o", table, "--known-lengths", lines)
    assert result.exit_code == 0, result.output
    return read_rows(table)


def _two_images(detector: Path) -> tuple[object, ...]:
    return ("cars.png", "empty.png", "--detector", detector, "--workers", 1, "--details")


def test_lines_of_a_table_set_the_scale_of_their_image(with_lines: list[dict[str, Any]]) -> None:
    empty = with_lines[1]
    assert empty["leading_ruler"] == "known_length"
    assert empty["ruler_known_length_p_right"] > 0.5
    assert empty["gsd_m_per_px"] == pytest.approx(0.12, rel=0.01)


def test_lines_of_a_table_do_not_change_other_images(
    with_lines: list[dict[str, Any]], detector: Path, table: Path
) -> None:
    cars = with_lines[0]
    assert cars["ruler_known_length_gsd_m_per_px"] is None
    without = table.with_name("without.jsonl")
    assert run_command(*_two_images(detector), "-o", without).exit_code == 0
    assert cars == read_rows(without)[0]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("file,x1,y1,x2,metres\ncars.png,1,2,300,40\n", "no column y2"),
        ("file,x1,y1,x2,y2,metres\ncars.png,1,2,300,wide,40\n", "line 2"),
        (
            "file,x1,y1,x2,y2,metres\ncars.png,1,2,300,4,40\ncars.png,1,2,3,4,40\n",
            "line 3: the line of known length",
        ),
        ("file,x1,y1,x2,y2,metres\ncars.png,1,2,300,4,-40\n", "line 2"),
        ("file,x1,y1,x2,y2,metres\ncars.png,1,2,300,4,nan\n", "line 2"),
        ("file,x1,y1,x2,y2,metres\n,1,2,300,4,40\n", "not named"),
        (
            "file,x1,y1,x2,y2,metres,basis\ncars.png,1,2,300,4,40,guessed\n",
            "use one of assumed, measured",
        ),
        ("file,x1,y1,x2,y2,metres\n", "no known lengths"),
        ("", "no column photograph"),
    ],
)
def test_an_invalid_table_of_lines_is_refused_with_the_fault(
    text: str, words: str, tmp_path: Path
) -> None:
    (tmp_path / "lines.csv").write_text(text)
    with pytest.raises(KnownLengthError, match=words):
        lines_in(tmp_path / "lines.csv", ["cars.png"])
