from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from vehanchor.errors import InvalidParameterError
from vehanchor_evaluation.questions import ask_blindly, ask_with_tools, read_questions, score
from vehanchor_scenes import render_scene

GSD = 0.12


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene with buildings."""
    where = tmp_path_factory.mktemp("scenes")
    render_scene(GSD, width_px=512, height_px=400, seed=3).write(where / "scene.png")
    (where / "other.json").write_text("[]")
    return where


class Tools:
    """Tools that measure by a scale they are told, and remember what they were asked."""

    anthropic_tools: list[dict[str, Any]] = []  # noqa: RUF012
    openai_tools: list[dict[str, Any]] = []  # noqa: RUF012

    def __init__(self, gsd: float | None, status: str = "ok", areas: list[float] | None = None) -> None:
        self.gsd, self.status, self.areas = gsd, status, areas or []
        self.asked: list[tuple[str, dict[str, Any]]] = []

    def call(self, name: str, arguments: dict[str, Any]) -> tuple[str, bool]:
        self.asked.append((name, arguments))
        if self.gsd is None:
            return "busy: later.", True
        record: dict[str, Any] = {"status": self.status, "confidence": 0.9, "scale": {"gsd_m_per_px": self.gsd}}
        if name == "measure_area":
            low, high = 0.9 * self.areas[0], 1.1 * self.areas[0]
            record |= {"area_ci95_low_m2": low, "area_ci95_high_m2": high}
        else:
            first, second = arguments["lines"][0]["points"]
            px = ((512 * (second["x"] - first["x"])) ** 2 + (400 * (second["y"] - first["y"])) ** 2) ** 0.5
            record |= {"distance_ci95_low_m": 0.95 * px * self.gsd, "distance_ci95_high_m": 1.05 * px * self.gsd}
        return f"A sentence.\n{json.dumps(record)}", False


def test_a_scene_is_asked_how_far_how_large_and_whether_it_fits(folder: Path) -> None:
    questions = read_questions(folder, 40)
    kinds = [question.kind for question in questions]
    assert kinds.count("distance") == 2
    assert kinds.count("fit") >= 1
    wide = questions[0]
    assert wide.truth == pytest.approx(0.8 * 512 * GSD)
    assert read_questions(folder, 40) == questions
    assert len(read_questions(folder, 2)) == 2
    truth = json.loads((folder / "scene.json").read_text())["objects"]
    assert all(q.truth in [item["area_m2"] for item in truth] for q in questions if q.kind == "area")


def test_right_tools_are_right_and_wrong_ones_wrong(folder: Path) -> None:
    questions = read_questions(folder, 40)
    areas = [question.truth for question in questions if question.kind == "area"]
    good = Tools(GSD, areas=areas)
    told = score("tools", ask_with_tools(questions, good))
    assert (told.right, told.wrong, told.no_answer, told.acted_on_low) == (len(questions), 0, 0, 0)
    assert told.calls_per_right == 1
    assert told.tokens_per_right
    assert "scale" not in good.asked[0][1]
    assert all(arguments["scale"] == {"gsd_m_per_px": GSD} for _, arguments in good.asked[1:])
    bad = score("tools", ask_with_tools([q for q in questions if q.kind == "distance"], Tools(2 * GSD)))
    assert (bad.right, bad.wrong) == (0, 2)


@pytest.mark.parametrize("tools", [Tools(GSD, "low_confidence", [1.0]), Tools(None)])
def test_a_low_confidence_or_an_error_is_no_answer(folder: Path, tools: Tools) -> None:
    questions = read_questions(folder, 40)
    told = score("tools", ask_with_tools(questions, tools))
    assert (told.no_answer, told.acted_on_low, told.calls_per_right) == (len(questions), 0, None)


class ToolsThatNeedHelp(Tools):
    """Tools of a low confidence, until they are told a length; the scale that they were given back is the one used."""

    def call(self, name: str, arguments: dict[str, Any]) -> tuple[str, bool]:
        if name == "estimate_gsd":
            self.asked.append((name, arguments))
            (line,) = arguments["known_lengths"]
            gsd = line["metres"] / (512 * (line["x2"] - line["x1"]))
            return f"A sentence.\n{json.dumps({'status': 'ok', 'scale': {'gsd_m_per_px': gsd, 'told': True}})}", False
        told = arguments.get("scale", {}).get("told", False)
        self.gsd, self.status = (arguments["scale"]["gsd_m_per_px"], "ok") if told else (GSD / 2, "low_confidence")
        answer, is_error = super().call(name, arguments)
        return answer.replace('"scale"', '"by"') if told else answer, is_error  # one that was given back is not given


def test_at_low_confidence_a_person_is_asked_once_an_image_and_what_they_measured_answers(folder: Path) -> None:
    questions = [question for question in read_questions(folder, 40) if question.kind == "distance"]
    tools = ToolsThatNeedHelp(GSD)
    told = score("helped", ask_with_tools(questions, tools, with_person=True))
    assert (told.right, told.wrong, told.acted_on_low) == (2, 0, 0)
    assert [name for name, _ in tools.asked] == ["measure_distance", "estimate_gsd", *["measure_distance"] * 2]
    alone = score("alone", ask_with_tools(questions, ToolsThatNeedHelp(GSD)))
    assert (alone.no_answer, alone.acted_on_low) == (2, 0)


def test_without_tools_the_scale_is_guessed(folder: Path) -> None:
    told = score("blind", ask_blindly(read_questions(folder, 40)))
    assert told.calls_per_right in (0, None)
    assert told.right + told.wrong + told.no_answer == told.questions


def test_a_folder_without_scenes_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidParameterError, match="vehanchor scene"):
        read_questions(tmp_path, 40)
