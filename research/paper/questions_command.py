"""Command ``python -m research.paper questions``: how far, how large, does it fit, with and without tools."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from research.paper.asked_model import ask_model
from research.paper.questions import (
    ask_blindly,
    ask_with_tools,
    questions_of_photographs,
    read_questions,
    render_questions,
    score,
)
from research.paper.service import PlannerRequest, exit_if_stopped, plain_command
from research.paper.tools import open_tools
from research.results.record import header, recording
from vehanchor.errors import InvalidParameterError
from vehanchor_evaluation.survey import survey_known_scale

if TYPE_CHECKING:
    from collections.abc import Sequence

    from research.paper.asked_model import ModelAnswers
    from research.paper.questions import Outcome, PlannerScore, Question
    from research.paper.tools import ToolCaller

_PHOTOGRAPHS = "Photographs instead of scenes"


@dataclass(frozen=True, kw_only=True)
class QuestionsRequest(PlannerRequest):
    """Options of the command, one per field."""

    folder: Annotated[
        Path | None,
        typer.Argument(metavar="FOLDER", help="Scenes with ground truth; twelve are rendered into an empty folder."),
    ] = None
    limit: Annotated[int, typer.Option(min=1, metavar="N", help="Maximum number of questions.")] = 40
    table: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="CSV with the columns file,gsd_m_per_px, as for 'vehanchor evaluate gsd'; no questions about areas.",
            rich_help_panel=_PHOTOGRAPHS,
        ),
    ] = None
    set_name: Annotated[
        str | None,
        typer.Option("--set", metavar="NAME", help="Only this set of the table.", rich_help_panel=_PHOTOGRAPHS),
    ] = None
    split: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Only this split of the table, e.g. val.", rich_help_panel=_PHOTOGRAPHS),
    ] = None

    def questions(self) -> list[Question]:
        """Create the questions.

        Raises:
            InvalidParameterError: there is not exactly one source, or it has no images.
        """
        if (self.folder is None) == (self.table is None):
            raise InvalidParameterError("give the images as a FOLDER of scenes or with --table FILE")
        if self.folder is not None:
            render_questions(self.folder)
            return read_questions(self.folder, self.limit)
        data = survey_known_scale(table=self.table, set_name=self.set_name, split=self.split)
        return questions_of_photographs(data.images, self.limit)

    def ask_model(self, asked: Sequence[Question], tools: ToolCaller) -> dict[str, ModelAnswers]:
        """Ask the real model, by row of the table; empty without a model."""
        api = self.model_api()
        if api is None:
            return {}
        return {
            f"{self.model} with tools": ask_model(asked, api, tools),
            f"{self.model} without tools": ask_model(asked, api),
        }


@plain_command(QuestionsRequest)
def questions(request: QuestionsRequest) -> None:
    """Compare a scripted planner with tools and one that guesses the scale: how far, how large, does it fit.

    With --provider and --model, a real model also answers, with and without tools. Its key comes from the environment.
    """
    request.check_model()
    asked = request.questions()
    with open_tools(sorted({question.image.resolve().parent for question in asked})) as tools:
        outcomes = {
            "a script with the tools": ask_with_tools(asked, tools),
            "the same, which asks a person for one measured stretch": ask_with_tools(asked, tools, with_person=True),
            "a script that takes a pixel for 0.15 m": ask_blindly(asked),
        }
        by_model = request.ask_model(asked, tools)
    outcomes |= {name: answers.outcomes for name, answers in by_model.items()}
    with recording("agents", ["photographs" if request.folder is None else "rendered"], request.record):
        print(header("planner", "questions", "right", "wrong", "no answer", "acted on a low confidence", *_COSTS))
        for name, each in outcomes.items():
            print(_line(score(name, each)))
    for name, each in outcomes.items():
        _print_wrong(name, each)
    exit_if_stopped(next((answers.stopped for answers in by_model.values() if answers.stopped), None))


_COSTS = ("calls a right answer", "tokens a right answer")


def _line(row: PlannerScore) -> str:
    cost = [f"{value:.1f}" if value else "-" for value in (row.calls_per_right, row.tokens_per_right)]
    counts = (row.questions, row.right, row.wrong, row.no_answer, row.acted_on_low)
    return f"| {' | '.join([row.name, *map(str, counts), *cost])} |"


def _print_wrong(planner: str, outcomes: Sequence[Outcome]) -> None:
    for outcome in outcomes:
        if outcome.verdict != "right":
            question = outcome.question
            about = f"{question.image.name}: {question.words} (truth {question.truth:.4g})"
            print(f"{planner}, {outcome.verdict}: {about}")
