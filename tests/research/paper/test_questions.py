from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from research.paper.questions import (
    Question,
    ask_blindly,
    ask_with_tools,
    questions_of_photographs,
    score,
)
from vehanchor.options import KnownLength
from vehanchor_evaluation.survey import survey_known_scale

GSD = 0.12


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A table of one photograph."""
    where = tmp_path_factory.mktemp("photographs")
    cv2.imwrite(str(where / "scene.png"), np.full((400, 512, 3), 90, np.uint8))
    (where / "table.csv").write_text(f"file,gsd_m_per_px,split\n{where}/scene.png,{GSD},val\n")
    return where / "table.csv"


@pytest.fixture(scope="module")
def photograph_questions(table: Path) -> list[Question]:
    return questions_of_photographs(survey_known_scale(table=table, split="val").images, 40)


class Tools:
    """Tools that measure with a known scale, and remember their calls."""

    anthropic_tools: list[dict[str, Any]] = []  # noqa: RUF012
    openai_tools: list[dict[str, Any]] = []  # noqa: RUF012

    def __init__(self, gsd: float | None, status: str = "ok") -> None:
        self.gsd = gsd
        self.status = status
        self.calls: list[dict[str, Any]] = []

    def call(self, name: str, arguments: dict[str, Any]) -> tuple[str, bool]:
        assert name == "measure_distance"
        self.calls.append(arguments)
        if self.gsd is None:
            return "busy: later.", True
        gsd = self.gsd
        status = self.status
        for line in arguments.get("known_lengths", ()):
            gsd = line["metres"] / (512 * (line["x2"] - line["x1"]))
            status = "ok"
        first, second = arguments["lines"][0]["points"]
        px = (
            (512 * (second["x"] - first["x"])) ** 2 + (400 * (second["y"] - first["y"])) ** 2
        ) ** 0.5
        record = {
            "status": status,
            "distance_ci95_low_m": 0.95 * px * gsd,
            "distance_ci95_high_m": 1.05 * px * gsd,
        }
        return f"A sentence.\n{json.dumps(record)}", False


def test_a_photograph_is_asked_how_far_and_whether_it_fits(table: Path) -> None:
    images = survey_known_scale(table=table, split="val").images
    questions = questions_of_photographs(images, 40)
    assert [question.kind for question in questions] == ["distance", "distance", "fit"]
    assert questions[0].truth == pytest.approx(0.8 * 512 * GSD)
    assert len(questions_of_photographs(images, 2)) == 2


def test_the_answers_are_as_right_as_the_tools(photograph_questions: list[Question]) -> None:
    good = Tools(GSD)
    counted = score("tools", ask_with_tools(photograph_questions, good))
    assert (counted.right, counted.wrong, counted.no_answer) == (len(photograph_questions), 0, 0)
    assert counted.calls_per_right == 1
    assert counted.tokens_per_right
    bad = score("tools", ask_with_tools(photograph_questions[:2], Tools(2 * GSD)))
    assert (bad.right, bad.wrong) == (0, 2)


@pytest.mark.parametrize("tools", [Tools(GSD, "low_confidence"), Tools(None)])
def test_a_low_confidence_or_an_error_is_no_answer(
    photograph_questions: list[Question], tools: Tools
) -> None:
    counted = score("tools", ask_with_tools(photograph_questions, tools))
    assert (counted.no_answer, counted.calls_per_right) == (len(photograph_questions), None)


def test_at_low_confidence_a_person_is_asked_once_an_image(
    photograph_questions: list[Question],
) -> None:
    tools = Tools(GSD / 2, "low_confidence")
    counted = score("helped", ask_with_tools(photograph_questions[:2], tools, with_person=True))
    assert (counted.right, counted.wrong) == (2, 0)
    assert ["known_lengths" in arguments for arguments in tools.calls] == [False, True, True]
    line = tools.calls[1]["known_lengths"][0]
    assert KnownLength(**line).basis == "measured"


def test_without_tools_the_scale_is_guessed(photograph_questions: list[Question]) -> None:
    counted = score("blind", ask_blindly(photograph_questions))
    assert counted.calls_per_right in (0, None)
    assert counted.right + counted.wrong + counted.no_answer == counted.questions
