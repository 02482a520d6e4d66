"""``vehanchor evaluate questions``: how far, how large, does it fit, with the tools and without."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vehanchor_evaluation.commands.request import plain_command

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.table import Table

    from vehanchor_evaluation.questions import Outcome, PlannerScore

__all__ = ["questions"]


@dataclass(frozen=True, kw_only=True)
class QuestionsRequest:
    """The options of the command."""

    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="Scenes with their truth, as 'vehanchor scene' writes them.")
    ]
    limit: Annotated[int, typer.Option(min=1, metavar="N", help="Questions at most.")] = 40
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object a planner and line.")] = False


@plain_command(QuestionsRequest)
def questions(request: QuestionsRequest) -> None:
    """Ask how far, how large and whether it fits: a scripted planner with the tools, and one that guesses the scale."""
    from vehanchor.cli.terminal import print_json, print_table
    from vehanchor_evaluation.agent_tools import open_agent_tools
    from vehanchor_evaluation.questions import ask_blindly, ask_with_tools, read_questions, score

    asked = read_questions(request.folder, request.limit)
    with open_agent_tools([request.folder.resolve()]) as tools:
        by_tools = ask_with_tools(asked, tools)
        helped = ask_with_tools(asked, tools, with_person=True)
    rows = [
        score("with the tools", by_tools),
        score("and a person's one length", helped),
        score("a usual pixel size", ask_blindly(asked)),
    ]
    if request.as_json:
        for row in rows:
            print_json(row.model_dump(mode="json"))
        return
    print_table(_table(rows))
    _tell_wrong(by_tools)
    _tell_wrong(helped)


def _table(rows: Sequence[PlannerScore]) -> Table:
    from rich import box
    from rich.table import Table

    table = Table("planner", box=box.SIMPLE_HEAD)
    for heading in ("questions", "right", "wrong", "no answer", "on low", "calls a right one", "tokens a right one"):
        table.add_column(heading, justify="right")
    for row in rows:
        cost = [f"{value:.1f}" if value else "-" for value in (row.calls_per_right, row.tokens_per_right)]
        counts = (row.questions, row.right, row.wrong, row.no_answer, row.acted_on_low)
        table.add_row(row.name, *map(str, counts), *cost)
    return table


def _tell_wrong(outcomes: Sequence[Outcome]) -> None:
    for outcome in outcomes:
        if outcome.verdict != "right":
            question = outcome.question
            print(f"{outcome.verdict}: {question.image.name}: {question.words} (truth {question.truth:.4g})")
