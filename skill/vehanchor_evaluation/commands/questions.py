"""``vehanchor evaluate questions``: how far, how large, does it fit, with the tools and without."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vehanchor.errors import InvalidParameterError
from vehanchor_evaluation.commands.request import plain_command
from vehanchor_evaluation.commands.service import STOPPED, ProviderName, ServiceRequest

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.table import Table

    from vehanchor_evaluation.agent_tools import ToolCaller
    from vehanchor_evaluation.asked_model import ModelAnswers
    from vehanchor_evaluation.questions import Outcome, PlannerScore, Question

_PHOTOGRAPHS, _MODEL = "Photographs instead of scenes", "A real model, too"


@dataclass(frozen=True, kw_only=True)
class QuestionsRequest(ServiceRequest):
    """The options of the command."""

    folder: Annotated[
        Path | None, typer.Argument(metavar="FOLDER", help="Scenes with their truth, as 'vehanchor scene' writes them.")
    ] = None
    limit: Annotated[int, typer.Option(min=1, metavar="N", help="Questions at most.")] = 40
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object a planner and line.")] = False
    table: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="CSV with the columns file,gsd_m_per_px, as of 'evaluate gsd', some of its images: no areas.",
            rich_help_panel=_PHOTOGRAPHS,
        ),
    ] = None
    set_name: Annotated[
        str | None,
        typer.Option("--set", metavar="NAME", help="Only this set of the table.", rich_help_panel=_PHOTOGRAPHS),
    ] = None
    split: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Only this split of it, as in 'val'.", rich_help_panel=_PHOTOGRAPHS),
    ] = None
    provider: Annotated[
        ProviderName | None,
        typer.Option(help="Whose API: openai-compatible is vLLM, DashScope, ...", rich_help_panel=_MODEL),
    ] = None
    model: Annotated[str, typer.Option(metavar="NAME", help="Its name there.", rich_help_panel=_MODEL)] = ""
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Where its replies are kept, so that none is paid for twice.", rich_help_panel=_MODEL
        ),
    ] = None

    def questions(self) -> list[Question]:
        """Make the questions.

        Raises:
            InvalidParameterError: not one source, or one without images.
        """
        from vehanchor_evaluation.questions import questions_of_photographs, read_questions
        from vehanchor_evaluation.survey import survey_known_scale

        if (self.folder is None) == (self.table is None):
            raise InvalidParameterError("name the images by FOLDER, of scenes, or by --table FILE")
        if self.folder is not None:
            return read_questions(self.folder, self.limit)
        data = survey_known_scale(table=self.table, set_name=self.set_name, split=self.split)
        return questions_of_photographs(data.images, self.limit)

    def check_model(self) -> None:
        """Make sure, before the work, that a model is named wholly or not at all.

        Raises:
            InvalidParameterError: it is named by half.
        """
        if (self.provider is None) != (not self.model):
            raise InvalidParameterError("a real model needs --provider and --model, and its key in the environment")

    def ask_model(self, asked: Sequence[Question], tools: ToolCaller) -> dict[str, ModelAnswers]:
        """Ask the real model, by row of the table; none where none is named."""
        from vehanchor_evaluation.asked_model import ask_model

        if self.provider is None:
            return {}
        api = self.open_api(self.provider, self.model, self.out)
        return {
            f"{self.model} with the tools": ask_model(asked, api, tools),
            f"{self.model} by its eye": ask_model(asked, api),
        }


@plain_command(QuestionsRequest)
def questions(request: QuestionsRequest) -> None:
    """Ask how far, how large and whether it fits: a scripted planner with the tools, and one that guesses the scale.

    With --provider and --model a real model is asked, too, with the tools and without. Its key comes from the
    environment.
    """
    from vehanchor.cli.terminal import print_json, print_table
    from vehanchor_evaluation.agent_tools import open_agent_tools
    from vehanchor_evaluation.questions import ask_blindly, ask_with_tools, score

    request.check_model()
    asked = request.questions()
    roots = sorted({question.image.resolve().parent for question in asked})
    with open_agent_tools(roots) as tools:
        outcomes = {
            "with the tools": ask_with_tools(asked, tools),
            "and a person's one length": ask_with_tools(asked, tools, with_person=True),
            "a usual pixel size": ask_blindly(asked),
        }
        by_model = request.ask_model(asked, tools)
    outcomes |= {name: answers.outcomes for name, answers in by_model.items()}
    rows = [score(name, each) for name, each in outcomes.items()]
    if request.as_json:
        for row in rows:
            print_json(row.model_dump(mode="json"))
    else:
        print_table(_table(rows))
        for name in ("with the tools", "and a person's one length"):
            _tell_wrong(name, outcomes[name])
    stopped = next((answers.stopped for answers in by_model.values() if answers.stopped), None)
    if stopped:
        print(f"stopped: {stopped}; with --out the same command goes on from here", file=sys.stderr)
        raise typer.Exit(STOPPED)


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


def _tell_wrong(planner: str, outcomes: Sequence[Outcome]) -> None:
    for outcome in outcomes:
        if outcome.verdict != "right":
            question = outcome.question
            about = f"{question.image.name}: {question.words} (truth {question.truth:.4g})"
            print(f"{planner}, {outcome.verdict}: {about}")
