from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from research.paper.__main__ import app
from research.paper.transcript import DEEDS, deed, read_key
from research.results.record import tables_of

KEY = "question,truth,tolerance\nwide,50,\nfits,yes,\ntrap,,\nfine,50,0.1\n"


@pytest.mark.parametrize(
    ("question", "answer", "number"),
    [
        *[("wide", 64, 0), ("wide", [40, 62.5], 0), ("wide", 30.0, 1), ("wide", True, 1), ("wide", None, 3)],
        *[("fits", True, 0), ("fits", False, 1), ("trap", None, 2), ("trap", 5.0, 1), ("fine", 56.0, 1)],
    ],
)
def test_an_answer_is_judged_by_the_key(question: str, answer: Any, number: int) -> None:
    header, *rows = (line.split(",") for line in KEY.splitlines())
    key = read_key(dict(zip(header, row, strict=True)) for row in rows)
    assert deed(tuple(answer) if isinstance(answer, list) else answer, key[question]) == DEEDS[number]


def test_a_transcript_is_counted_and_must_answer_the_whole_key(tmp_path: Path) -> None:
    call = {"name": "measure_distance", "arguments": {}, "result": "x" * 398}
    turns = [{"question": "wide", "calls": [call, call], "answer": 50}, {"question": "fits", "answer": True}]
    turns += [{"question": "trap", "answer": None, "tokens": 7}, {"question": "fine", "answer": [45, 55]}]
    for n, status in ((4, 0), (3, 2)):
        (tmp_path / "t.jsonl").write_text("\n".join(map(json.dumps, turns[:n])))
        (tmp_path / "key.csv").write_text(KEY)
        done = CliRunner().invoke(app, ["transcript", str(tmp_path / "t.jsonl"), str(tmp_path / "key.csv")])
        assert done.exit_code == status
        if status == 0:
            assert tables_of(done.stdout)[0].rows == [[3, 0, 1, 0, 2, 207]]
    assert "differ: fine" in done.stderr
