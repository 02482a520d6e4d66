"""Commands ``python -m research.paper questions`` and ``agents``: planners and their tools."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from research.paper.agents import AgentScore, agent_score, ask_agent
from research.paper.question_set import TASKS, ask_set, picture_of, question_set, task_of
from research.paper.questions import ask_blindly, ask_with_tools, questions_of_photographs, score
from research.paper.service import PlannerRequest, RecordOption, exit_if_stopped, plain_command
from research.paper.tools import open_tools
from research.results.record import header, recording
from vehanchor_evaluation.survey import survey_known_scale

if TYPE_CHECKING:
    from collections.abc import Sequence

    from research.paper.question_set import SetQuestion
    from research.paper.questions import Outcome, PlannerScore
    from research.paper.tools import ToolCaller


@dataclass(frozen=True, kw_only=True)
class QuestionsRequest:
    """Options of the command, one per field."""

    table: Annotated[
        Path,
        typer.Argument(
            metavar="TABLE", help="CSV with the columns file,gsd_m_per_px, as for 'evaluate gsd'."
        ),
    ]
    limit: Annotated[int, typer.Option(min=1, metavar="N", help="Maximum number of questions.")] = (
        40
    )
    set_name: Annotated[
        str | None, typer.Option("--set", metavar="NAME", help="Only this set of the table.")
    ] = None
    split: Annotated[
        str | None, typer.Option(metavar="NAME", help="Only this split of the table, e.g. val.")
    ] = None
    record: RecordOption = None


@plain_command(QuestionsRequest)
def questions(request: QuestionsRequest) -> None:
    """Compare a scripted planner with tools with one that guesses the scale: distance, fit."""
    data = survey_known_scale(table=request.table, set_name=request.set_name, split=request.split)
    questions = questions_of_photographs(data.images, request.limit)
    with open_tools(sorted({question.image.resolve().parent for question in questions})) as tools:
        outcomes = {
            "a script with the tools": ask_with_tools(questions, tools),
            "the same, which asks a person for one measured stretch": ask_with_tools(
                questions, tools, with_person=True
            ),
            "a script that takes a pixel for 0.15 m": ask_blindly(questions),
        }
    with recording("agents", ["photographs"], request.record):
        costs = ("calls a right answer", "tokens a right answer")
        print(header("planner", "questions", "right", "wrong", "no answer", *costs))
        for name, of_planner in outcomes.items():
            print(_line(score(name, of_planner)))
    for name, of_planner in outcomes.items():
        _print_wrong(name, of_planner)


def _line(row: PlannerScore) -> str:
    cost = [
        f"{value:.1f}" if value else "-" for value in (row.calls_per_right, row.tokens_per_right)
    ]
    counts = [str(n) for n in (row.questions, row.right, row.wrong, row.no_answer)]
    return f"| {' | '.join([row.name, *counts, *cost])} |"


def _print_wrong(planner: str, outcomes: Sequence[Outcome]) -> None:
    for outcome in outcomes:
        if outcome.verdict != "right":
            question = outcome.question
            about = f"{question.image.name}: {question.words} (truth {question.truth:.4g})"
            print(f"{planner}, {outcome.verdict}: {about}")


@dataclass(frozen=True, kw_only=True)
class AgentsRequest(PlannerRequest):
    """Options of the command, one per field."""

    pictures: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="Rendered pictures; missing ones are rendered.")
    ]
    data: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder of the photographs. Default: no photographs."),
    ] = None
    limit: Annotated[int, typer.Option(min=1, metavar="N", help="Maximum number of pictures.")] = 40

    def questions(self) -> list[tuple[SetQuestion, Path]]:
        """Return the questions with their pictures; those of photographs only with their folder."""
        available = [
            question
            for question in question_set()
            if question.scene is not None or self.data is not None
        ]
        data = self.data or Path()
        return [
            (question, picture_of(question, data, self.pictures))
            for question in available[: self.limit]
        ]


@plain_command(AgentsRequest)
def agents(request: AgentsRequest) -> None:
    """Score planners on pictures with recognised objects, traps among them: acted or abstained.

    Each picture has a task of distance, of fit and of direction. The scripted planner does them
    with and without the recognised objects. With --provider and --model, a real model also does.
    Its key comes from the environment.
    """
    request.check_model()
    questions = request.questions()
    with open_tools(sorted({path.resolve().parent for _, path in questions})) as tools:
        rows, stopped = _rows(request, questions, tools)
    with recording("agents", ["question_set"], request.record):
        deeds = ("acted rightly", "acted wrongly", "abstained rightly", "abstained needlessly")
        print(header("planner", "task", "questions", *deeds, "calls", "tokens"))
        for row in rows:
            cells = ("-" if value is None else str(value) for value in row.model_dump().values())
            print(f"| {' | '.join(cells)} |")
    exit_if_stopped(stopped)


def _rows(
    request: AgentsRequest, questions: Sequence[tuple[SetQuestion, Path]], tools: ToolCaller
) -> tuple[list[AgentScore], str | None]:
    """Give every planner the tasks; return their rows, and the reason for an early end."""
    tasks = {
        kind: [(task_of(question, kind), path) for question, path in questions] for kind in TASKS
    }
    rows = []
    for name, catalogue in (("with what it recognises", True), ("without", False)):
        by_picture = [tasks[kind][k] for k in range(len(questions)) for kind in TASKS]
        answers = ask_set(by_picture, tools, catalogue=catalogue)
        for kind in TASKS:
            of_kind = [answer for answer in answers if answer.task.kind == kind]
            rows.append(agent_score(name, kind, of_kind))
    api = request.model_api()
    stopped = None
    if api is not None:
        for kind in TASKS:
            run = ask_agent(tasks[kind], api, tools)
            rows.append(
                agent_score(
                    request.model, kind, answers=run.answers, calls=run.calls, tokens=run.tokens
                )
            )
            stopped = stopped or run.stopped
    return rows, stopped
