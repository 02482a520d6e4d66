"""The deeds of a model with the tools, against a stand-in for its service."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from research.paper.__main__ import app
from research.paper.agents import AgentRun, agent_score, ask_agent, read_answer, read_reply
from research.paper.question_set import TASKS, Direction, Task, question_set, task_of
from research.paper.vlm_api import Budget, open_api, reply_journal
from research.results.record import tables_of
from tests.research.paper.model_service import (
    Answer,
    ModelRequest,
    ModelService,
    UseTool,
    model_service,
)

RENDERED = [question for question in question_set() if question.scene is not None]


@pytest.fixture(scope="module")
def tasks(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[Task, Path]]:
    """Two questions with grey pictures of the size of theirs."""
    folder = tmp_path_factory.mktemp("pictures")
    picture = cv2.imencode(".jpg", np.full((640, 800, 3), 90, np.uint8))[1].tobytes()
    digest = {"sha256": hashlib.sha256(picture).hexdigest()}
    for question in RENDERED[:2]:
        (folder / question.file).write_bytes(picture)
    return [
        (task_of(question.model_copy(update=digest), "distance"), folder / question.file)
        for question in RENDERED[:2]
    ]


class Tools:
    """Tools that measure rightly, or with a factor."""

    def __init__(self, truth_m: dict[str, float], factor: float = 1.0, status: str = "ok") -> None:
        tool = {"name": "measure_distance", "description": "Measures distances."}
        self.anthropic_tools: list[dict[str, Any]] = [{**tool, "input_schema": {"type": "object"}}]
        self.openai_tools: list[dict[str, Any]] = [
            {"type": "function", "function": {**tool, "parameters": {}}}
        ]
        self._truth_m = truth_m
        self._factor = factor
        self._status = status

    def call(self, name: str, arguments: dict[str, Any]) -> tuple[str, bool]:
        assert name == "measure_distance"
        metres = self._truth_m[Path(arguments["image"]["path"]).name] * self._factor
        return json.dumps(
            {"status": self._status, "low": 0.9 * metres, "high": 1.1 * metres}
        ), False


def _careful(request: ModelRequest) -> Answer:
    """A model that measures, and abstains unless the status is ok."""
    path = re.search(r"The file is (\S+)\. Measure", request.text)
    assert path is not None
    if not request.tool_results:
        return UseTool("measure_distance", {"image": {"kind": "path", "path": path[1]}})
    record = json.loads(request.tool_results[-1])
    return (
        f"ANSWER={record['low']:.3f} to {record['high']:.3f}"
        if record["status"] == "ok"
        else "ANSWER=unknown"
    )


def _run(
    tasks: list[tuple[Task, Path]], folder: Path | None = None, **behaviour: Any
) -> tuple[AgentRun, list[str]]:
    truth = {path.name: task.truth_m(800, 640) for task, path in tasks}
    with model_service(ModelService(answer=_careful)) as service:
        api = open_api(
            "openai-compatible", "m", reply_journal(folder), Budget(), base_url=f"{service.url}/v1"
        )
        run = ask_agent(tasks, api, Tools(truth, **behaviour))
    return run, [path for path, _, _ in service.requests]


def test_right_answers_are_counted(tasks: list[tuple[Task, Path]]) -> None:
    run, _ = _run(tasks)
    counted = agent_score("m", "distance", answers=run.answers, calls=run.calls, tokens=run.tokens)
    assert counted.acted_rightly == 2
    assert run.calls == 2
    assert run.tokens > 0


def test_wrong_answers_are_counted(tasks: list[tuple[Task, Path]]) -> None:
    run, _ = _run(tasks, factor=1.5)
    assert agent_score("m", "distance", run.answers).acted_wrongly == 2


def test_abstentions_are_counted(tasks: list[tuple[Task, Path]]) -> None:
    run, _ = _run(tasks, status="low_confidence")
    counted = agent_score("m", "distance", run.answers)
    needlessly = sum(task.expected == "act" for task, _ in tasks)
    assert (counted.abstained_needlessly, counted.abstained_rightly) == (needlessly, 2 - needlessly)


@pytest.mark.parametrize(
    ("kind", "text", "reply"),
    [
        ("distance", "So\nANSWER=3.5 to 4.5 m", (3.5, 4.5)),
        ("distance", "ANSWER=yes", None),
        ("fit", "**ANSWER=yes**", True),
        ("fit", "ANSWER=3 to 4", None),
        ("direction", "ANSWER=45 deg, 3.5 to 4.5 m", Direction(45.0, (3.5, 4.5))),
        (
            "direction",
            "ANSWER=10 deg, 1 to 2\nANSWER=312.5\u00b0, 10 to 12",
            Direction(312.5, (10.0, 12.0)),
        ),
        ("direction", "ANSWER=45 degrees", None),
        ("direction", "ANSWER=3.5 to 4.5", None),
        ("direction", "ANSWER=unknown", None),
    ],
)
def test_a_reply_is_read_for_its_task(kind: Any, text: str, reply: Any) -> None:
    assert read_reply(kind, text) == reply


@pytest.mark.parametrize(
    ("kind", "words"), [("fit", "m long fit between (0.5, 0.2) and"), ("direction", "In which dir")]
)
def test_a_model_acts_in_tasks_of_fit_and_direction(
    tasks: list[tuple[Task, Path]], kind: Any, words: str
) -> None:
    first, path = tasks[0]
    task = task_of(first.question.model_copy(update={"expected": "act"}), kind)
    task = Task(task.question, kind, task.ends, 0.6 if kind == "fit" else 0.0)
    truth = task.truth_m(800, 640)
    texts = []

    def answering(shown: ModelRequest) -> Answer:
        texts.append(shown.text)
        if kind == "fit":
            return "ANSWER=yes"
        return (
            f"ANSWER={task.bearing_deg(800, 640):.0f} deg, {0.9 * truth:.1f} to {1.1 * truth:.1f}"
        )

    with model_service(ModelService(answer=answering)) as service:
        api = open_api(
            "openai-compatible", "m", reply_journal(None), Budget(), base_url=f"{service.url}/v1"
        )
        run = ask_agent([(task, path)], api, Tools({}))
    assert words in texts[0]
    assert [answer.deed for answer in run.answers] == ["acted rightly"]


@pytest.mark.slow
def test_the_command_renders_missing_pictures_and_asks_script_and_model(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OPENAI_API_KEY", "k")
    with model_service(ModelService(answer=lambda _: "ANSWER=unknown")) as service:
        options = [
            "--provider",
            "openai-compatible",
            "--model",
            "m",
            "--base-url",
            f"{service.url}/v1",
        ]
        done = CliRunner().invoke(app, ["agents", str(tmp_path / "new"), "--limit", "1", *options])
    assert done.exit_code == 0, done.output
    assert (tmp_path / "new" / RENDERED[0].file).is_file()
    (table,) = tables_of(done.stdout)
    assert [row[0] for row in table.rows] == [
        name for name in ("with what it recognises", "without", "m") for _ in TASKS
    ]
    assert [row[1] for row in table.rows] == 3 * list(TASKS)
    assert all(row[table.columns.index("acted wrongly")] == 0 for row in table.rows)


@pytest.mark.parametrize(
    ("reply", "answer"),
    [
        ("ANSWER=12.5 to 13", (12.5, 13)),
        ("first ANSWER=1 to 2\nno: **ANSWER = 1,250 m - 1,300 m**", (1250, 1300)),
        ("ANSWER=40 m2 to 5e1 m2.", (40, 50)),
        ("`ANSWER=Yes`", True),
        ("ANSWER=no.", False),
        ("ANSWER=unknown", None),
        ("about 12 m", None),
        ("ANSWER=12", None),
    ],
)
def test_a_models_last_line_is_its_answer(reply: str, answer: Any) -> None:
    assert read_answer(reply) == answer
