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
def asked(table: Path) -> list[Question]:
    return questions_of_photographs(survey_known_scale(table=table, split="val").images, 40)


class Tools:
    """Tools that measure by a scale they are told, and remember what they were asked."""

    anthropic_tools: list[dict[str, Any]] = []  # noqa: RUF012
    openai_tools: list[dict[str, Any]] = []  # noqa: RUF012

    def __init__(self, gsd: float | None, status: str = "ok") -> None:
        self.gsd = gsd
        self.status = status
        self.asked: list[dict[str, Any]] = []

    def call(self, name: str, arguments: dict[str, Any]) -> tuple[str, bool]:
        assert name == "measure_distance"
        self.asked.append(arguments)
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


def test_right_tools_are_right_and_wrong_ones_wrong(asked: list[Question]) -> None:
    good = Tools(GSD)
    told = score("tools", ask_with_tools(asked, good))
    assert (told.right, told.wrong, told.no_answer) == (len(asked), 0, 0)
    assert told.calls_per_right == 1
    assert told.tokens_per_right
    bad = score("tools", ask_with_tools(asked[:2], Tools(2 * GSD)))
    assert (bad.right, bad.wrong) == (0, 2)


@pytest.mark.parametrize("tools", [Tools(GSD, "low_confidence"), Tools(None)])
def test_a_low_confidence_or_an_error_is_no_answer(asked: list[Question], tools: Tools) -> None:
    told = score("tools", ask_with_tools(asked, tools))
    assert (told.no_answer, told.calls_per_right) == (len(asked), None)


def test_at_low_confidence_a_person_is_asked_once_an_image_and_what_they_measured_answers(
    asked: list[Question],
) -> None:
    tools = Tools(GSD / 2, "low_confidence")
    told = score("helped", ask_with_tools(asked[:2], tools, with_person=True))
    assert (told.right, told.wrong) == (2, 0)
    assert ["known_lengths" in arguments for arguments in tools.asked] == [False, True, True]
    line = tools.asked[1]["known_lengths"][0]
    assert KnownLength(**line).basis == "measured"


def test_without_tools_the_scale_is_guessed(asked: list[Question]) -> None:
    told = score("blind", ask_blindly(asked))
    assert told.calls_per_right in (0, None)
    assert told.right + told.wrong + told.no_answer == told.questions
