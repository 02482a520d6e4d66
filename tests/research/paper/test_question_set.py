"""The forty questions: what they hold, and how a planner's deeds are judged."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from research.paper.__main__ import app
from research.paper.question_set import (
    Direction,
    SetQuestion,
    Task,
    TaskKind,
    ask_set,
    checked_file,
    question_set,
    task_of,
)
from research.paper.transcript import DEEDS, deed, read_key
from research.results.record import tables_of
from vehanchor.errors import InvalidParameterError
from vehanchor.options import ScaleOptions
from vehanchor.rulers.standards import check_name

RENDERED = [question for question in question_set() if question.scene is not None]


class FixedTools:
    """Tools with one answer for every image."""

    def __init__(self, **record: Any) -> None:
        self.anthropic_tools: list[dict[str, Any]] = []
        self.openai_tools: list[dict[str, Any]] = []
        self._record = record
        self.calls: list[dict[str, Any]] = []

    def call(self, name: str, arguments: dict[str, Any]) -> tuple[str, bool]:
        assert name == "measure_distance"
        self.calls.append(arguments)
        size = {"image_width_px": 800, "image_height_px": 640}
        return f"words\n{json.dumps({**size, **self._record})}", False


def _here(question: SetQuestion, folder: Path, kind: TaskKind = "distance") -> tuple[Task, Path]:
    """The task about a small file."""
    path = folder / "a.png"
    path.write_bytes(b"a picture")
    return task_of(
        question.model_copy(update={"sha256": hashlib.sha256(b"a picture").hexdigest()}), kind
    ), path


def test_the_set_has_forty_pictures_with_traps() -> None:
    questions = question_set()
    assert (len(questions), len(RENDERED)) == (40, 20)
    assert len({question.sha256 for question in questions}) == 40
    assert sum(question.why.startswith("trap") for question in questions) >= 8
    assert min(Counter(question.expected for question in questions).values()) >= 15


def test_every_fact_is_a_line_inside_the_picture() -> None:
    for question in question_set():
        for fact in question.facts:
            assert all(0 <= fact[end] <= 1 for end in ("x1", "y1", "x2", "y2"))
            line = [*(fact[end] for end in ("x1", "y1", "x2", "y2")), fact["metres"]]
            ScaleOptions.of({"known_lengths": [line], "coordinates": "fraction"})
            if isinstance(fact["metres"], str):
                check_name(fact["metres"])


@pytest.mark.parametrize(
    ("record", "expected", "deed"),
    [
        ({"status": "low_confidence"}, "act", "abstained needlessly"),
        ({"status": "low_confidence"}, "abstain", "abstained rightly"),
        (
            {"status": "ok", "distance_ci95_low_m": 0.9, "distance_ci95_high_m": 1.1},
            "act",
            "acted rightly",
        ),
        (
            {"status": "ok", "distance_ci95_low_m": 1.05, "distance_ci95_high_m": 1.2},
            "abstain",
            "acted wrongly",
        ),
    ],
)
def test_a_deed_is_judged_by_interval_and_expectation(
    record: dict[str, Any], expected: str, deed: str, tmp_path: Path
) -> None:
    question = RENDERED[0].model_copy(update={"expected": expected})
    truth = 0.8 * 800 * question.gsd_m_per_px
    measured = {
        key: value * truth if isinstance(value, float) else value for key, value in record.items()
    }
    (answered,) = ask_set(
        [_here(question, tmp_path)], FixedTools(**measured, distance_m=truth), catalogue=True
    )
    assert answered.deed == deed


def test_the_bearing_is_measured_in_pixels() -> None:
    def bearing(end: tuple[float, float], width_px: int = 400, height_px: int = 400) -> float:
        return Task(RENDERED[0], "direction", ((0.5, 0.5), end)).bearing_deg(width_px, height_px)

    assert [
        bearing(end) for end in ((0.5, 0.2), (0.8, 0.5), (0.5, 0.8), (0.2, 0.5))
    ] == pytest.approx([0, 90, 180, 270])
    assert bearing((0.6, 0.4)) == pytest.approx(45)
    assert bearing((0.6, 0.4), 1600, 400) == pytest.approx(76, abs=0.1)


def test_a_direction_needs_five_degrees_and_a_right_interval() -> None:
    task = task_of(RENDERED[0].model_copy(update={"expected": "act"}), "direction")
    size = 800, 640
    bearing = task.bearing_deg(*size)
    truth = task.truth_m(*size)
    around = 0.9 * truth, 1.1 * truth
    assert task.deed(Direction((bearing - 4) % 360, around), *size) == "acted rightly"
    assert task.deed(Direction((bearing + 364) % 360, around), *size) == "acted rightly"
    assert task.deed(Direction((bearing + 6) % 360, around), *size) == "acted wrongly"
    assert task.deed(Direction(-bearing % 360, around), *size) == "acted wrongly"
    assert task.deed(Direction(bearing, (1.1 * truth, 1.3 * truth)), *size) == "acted wrongly"
    assert task.deed(around, *size) == "acted wrongly", "an interval alone is not a direction"
    assert task.deed(None, *size) == "abstained needlessly"


def test_a_fit_is_judged_by_the_lengths() -> None:
    question = RENDERED[0].model_copy(update={"expected": "act"})
    ends = task_of(question, "fit").ends
    small, large, equal = (Task(question, "fit", ends, share) for share in (0.6, 1.6, 1.0))
    assert [small.deed(reply, 800, 640) for reply in (True, False)] == [
        "acted rightly",
        "acted wrongly",
    ]
    assert [large.deed(reply, 800, 640) for reply in (True, False)] == [
        "acted wrongly",
        "acted rightly",
    ]
    assert [equal.deed(reply, 800, 640) for reply in (True, False)] == [
        "acted wrongly",
        "acted wrongly",
    ]
    assert equal.deed(None, 800, 640) == "abstained rightly"
    assert small.needed_m(800, 640) == pytest.approx(0.6 * small.truth_m(800, 640))


def test_without_the_catalogue_no_fact_is_given(tmp_path: Path) -> None:
    question = next(question for question in RENDERED if question.facts)
    for catalogue in (True, False):
        tools = FixedTools(status="no_scale")
        ask_set([_here(question, tmp_path)], tools, catalogue=catalogue)
        assert ("known_lengths" in tools.calls[0]) == catalogue


def test_a_missing_file_and_another_one_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    with pytest.raises(InvalidParameterError, match="is missing"):
        checked_file(RENDERED[0], path)
    path.write_bytes(b"a picture")
    with pytest.raises(InvalidParameterError, match="another file"):
        checked_file(RENDERED[0], path)


KEY = "question,truth,tolerance\nwide,50,\nfits,yes,\ntrap,,\nfine,50,0.1\n"


@pytest.mark.parametrize(
    ("question", "answer", "number"),
    [
        *[
            ("wide", 64, 0),
            ("wide", [40, 62.5], 0),
            ("wide", 30.0, 1),
            ("wide", True, 1),
            ("wide", None, 3),
        ],
        *[
            ("fits", True, 0),
            ("fits", False, 1),
            ("trap", None, 2),
            ("trap", 5.0, 1),
            ("fine", 56.0, 1),
        ],
    ],
)
def test_an_answer_is_judged_by_the_key(question: str, answer: Any, number: int) -> None:
    header, *rows = (line.split(",") for line in KEY.splitlines())
    key = read_key(dict(zip(header, row, strict=True)) for row in rows)
    assert (
        deed(tuple(answer) if isinstance(answer, list) else answer, key[question]) == DEEDS[number]
    )


def test_a_transcript_is_counted_and_must_answer_the_whole_key(tmp_path: Path) -> None:
    call = {"name": "measure_distance", "arguments": {}, "result": "x" * 398}
    turns = [
        {"question": "wide", "calls": [call, call], "answer": 50},
        {"question": "fits", "answer": True},
    ]
    turns += [
        {"question": "trap", "answer": None, "tokens": 7},
        {"question": "fine", "answer": [45, 55]},
    ]
    for n, status in ((4, 0), (3, 2)):
        (tmp_path / "t.jsonl").write_text("\n".join(map(json.dumps, turns[:n])))
        (tmp_path / "key.csv").write_text(KEY)
        done = CliRunner().invoke(
            app, ["transcript", str(tmp_path / "t.jsonl"), str(tmp_path / "key.csv")]
        )
        assert done.exit_code == status
        if status == 0:
            assert tables_of(done.stdout)[0].rows == [[3, 0, 1, 0, 2, 207]]
    assert "differ: fine" in done.stderr
