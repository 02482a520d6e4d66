"""The forty questions: what they hold, and how a planner's deeds are judged."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from vehanchor.errors import InvalidParameterError
from vehanchor.options import KnownLength
from vehanchor.rulers.standards import check_name
from vehanchor_evaluation.question_set import SetQuestion, ask_set, checked_file, question_set

RENDERED = [each for each in question_set() if each.scene is not None]


class Told:
    """Tools with one answer for every image."""

    def __init__(self, **record: Any) -> None:
        self.anthropic_tools: list[dict[str, Any]] = []
        self.openai_tools: list[dict[str, Any]] = []
        self._record = record
        self.asked: list[dict[str, Any]] = []

    def call(self, name: str, arguments: dict[str, Any]) -> tuple[str, bool]:
        assert name == "measure_distance"
        self.asked.append(arguments)
        size = {"image_width_px": 800, "image_height_px": 640}
        return f"words\n{json.dumps({**size, **self._record})}", False


def _here(question: SetQuestion, folder: Path) -> tuple[SetQuestion, Path]:
    """The question about a small file."""
    path = folder / "a.png"
    path.write_bytes(b"a picture")
    return question.model_copy(update={"sha256": hashlib.sha256(b"a picture").hexdigest()}), path


def test_there_are_forty_half_of_them_rendered_and_traps_among_them() -> None:
    questions = question_set()
    assert (len(questions), len(RENDERED)) == (40, 20)
    assert len({each.sha256 for each in questions}) == 40
    assert sum(each.why.startswith("trap") for each in questions) >= 8
    assert min(Counter(each.expected for each in questions).values()) >= 15


def test_every_fact_is_a_line_inside_the_picture() -> None:
    for each in question_set():
        for fact in each.facts:
            assert all(0 <= fact[end] <= 1 for end in ("x1", "y1", "x2", "y2"))
            KnownLength.of([*(fact[end] for end in ("x1", "y1", "x2", "y2")), fact["metres"]])
            if isinstance(fact["metres"], str):
                check_name(fact["metres"])


@pytest.mark.parametrize(
    ("record", "expected", "deed"),
    [
        ({"status": "low_confidence"}, "act", "abstained needlessly"),
        ({"status": "low_confidence"}, "abstain", "abstained rightly"),
        ({"status": "ok", "distance_ci95_low_m": 0.9, "distance_ci95_high_m": 1.1}, "act", "acted rightly"),
        ({"status": "ok", "distance_ci95_low_m": 1.05, "distance_ci95_high_m": 1.2}, "abstain", "acted wrongly"),
    ],
)
def test_a_deed_is_judged_by_the_interval_and_by_what_was_known(
    record: dict[str, Any], expected: str, deed: str, tmp_path: Path
) -> None:
    question = RENDERED[0].model_copy(update={"expected": expected})
    truth = 0.8 * 800 * question.gsd_m_per_px
    told = {key: value * truth if isinstance(value, float) else value for key, value in record.items()}
    (answered,) = ask_set([_here(question, tmp_path)], Told(**told, distance_m=truth), catalogue=True)
    assert answered.deed == deed


def test_without_the_catalogue_no_fact_is_given(tmp_path: Path) -> None:
    question = next(each for each in RENDERED if each.facts)
    for catalogue in (True, False):
        tools = Told(status="no_scale")
        ask_set([_here(question, tmp_path)], tools, catalogue=catalogue)
        assert ("known_lengths" in tools.asked[0]) == catalogue


def test_a_missing_file_and_another_one_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    with pytest.raises(InvalidParameterError, match="is missing"):
        checked_file(RENDERED[0], path)
    path.write_bytes(b"a picture")
    with pytest.raises(InvalidParameterError, match="another file"):
        checked_file(RENDERED[0], path)
