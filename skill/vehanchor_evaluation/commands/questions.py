"""Command ``vehanchor evaluate questions``: how far, how large, does it fit, with and without tools."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vehanchor.errors import InvalidParameterError
from vehanchor_evaluation.commands.request import plain_command
from vehanchor_evaluation.commands.service import PlannerRequest, exit_if_stopped

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.table import Table

    from vehanchor_evaluation.agent_tools import ToolCaller
    from vehanchor_evaluation.asked_model import ModelAnswers
    from vehanchor_evaluation.questions import Outcome, PlannerScore, Question

_PHOTOGRAPHS = "Photographs instead of scenes"


@dataclass(frozen=True, kw_only=True)
class QuestionsRequest(PlannerRequest):
    """Options of the command, one per field."""

    folder: Annotated[
        Path | None, typer.Argument(metavar="FOLDER", help="Scenes with ground truth from 'vehanchor scene'.")
    ] = None
    limit: Annotated[int, typer.Option(min=1, metavar="N", help="Maximum number of questions.")] = 40
    as_json: Annotated[bool, typer.Option("--json", help="Print a line of JSON per planner.")] = False
    table: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="CSV with the columns file,gsd_m_per_px, as for 'evaluate gsd'; no questions about areas.",
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
        from vehanchor_evaluation.questions import questions_of_photographs, read_questions
        from vehanchor_evaluation.survey import survey_known_scale

        if (self.folder is None) == (self.table is None):
            raise InvalidParameterError("give the images as a FOLDER of scenes or with --table FILE")
        if self.folder is not None:
            return read_questions(self.folder, self.limit)
        data = survey_known_scale(table=self.table, set_name=self.set_name, split=self.split)
        return questions_of_photographs(data.images, self.limit)

    def ask_model(self, asked: Sequence[Question], tools: ToolCaller) -> dict[str, ModelAnswers]:
        """Ask the real model, by row of the table; empty without a model."""
        from vehanchor_evaluation.asked_model import ask_model

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
    from vehanchor.cli.terminal import print_json, print_table
    from vehanchor_evaluation.agent_tools import open_agent_tools
    from vehanchor_evaluation.questions import ask_blindly, ask_with_tools, score

    request.check_model()
    asked = request.questions()
    roots = sorted({question.image.resolve().parent for question in asked})
    with open_agent_tools(roots) as tools:
        outcomes = {
            "with tools": ask_with_tools(asked, tools),
            "with tools and a measured line": ask_with_tools(asked, tools, with_person=True),
            "usual pixel size": ask_blindly(asked),
        }
        by_model = request.ask_model(asked, tools)
    outcomes |= {name: answers.outcomes for name, answers in by_model.items()}
    rows = [score(name, each) for name, each in outcomes.items()]
    if request.as_json:
        for row in rows:
            print_json(row.model_dump(mode="json"))
    else:
        print_table(_table(rows))
        for name in ("with tools", "with tools and a measured line"):
            _print_wrong(name, outcomes[name])
    exit_if_stopped(next((answers.stopped for answers in by_model.values() if answers.stopped), None))


def _table(rows: Sequence[PlannerScore]) -> Table:
    from rich import box
    from rich.table import Table
    from rich.text import Text

    table = Table("planner", box=box.SIMPLE_HEAD)
    for heading in ("questions", "right", "wrong", "no answer", "on low", "calls a right one", "tokens a right one"):
        table.add_column(heading, justify="right")
    for row in rows:
        cost = [f"{value:.1f}" if value else "-" for value in (row.calls_per_right, row.tokens_per_right)]
        counts = (row.questions, row.right, row.wrong, row.no_answer, row.acted_on_low)
        table.add_row(Text(row.name), *map(str, counts), *cost)
    return table


def _print_wrong(planner: str, outcomes: Sequence[Outcome]) -> None:
    for outcome in outcomes:
        if outcome.verdict != "right":
            question = outcome.question
            about = f"{question.image.name}: {question.words} (truth {question.truth:.4g})"
            print(f"{planner}, {outcome.verdict}: {about}")
