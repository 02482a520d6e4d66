"""Tables on a terminal: a line for each photograph."""

from __future__ import annotations

import pytest

from vehanchor.cli.terminal import print_rows, shortened_name

_COLUMNS = {"photograph": "file", "m/px": "number", "reason": "word"}


def test_a_name_is_shortened_in_the_middle() -> None:
    short = shortened_name("DJI_20260712_1432_0009.jpg", 16)
    assert len(short) == 16
    assert short.startswith("DJI")
    assert short.endswith("_0009.jpg")


def test_a_row_takes_one_line_and_keeps_its_reason(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    rows = [(f"a_survey_of_the_northern_fields_{n}.png", "0.1234", "too_coarse") for n in range(3)]
    print_rows(_COLUMNS, rows)
    lines = [line for line in capsys.readouterr().out.splitlines() if "too_coarse" in line]
    assert [line.split()[0][-6:] for line in lines] == [f"_{n}.png" for n in range(3)]
    assert max(map(len, lines)) <= 40
