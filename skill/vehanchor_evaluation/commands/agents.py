"""Command ``vehanchor evaluate agents``: whether a planner acts and abstains rightly on forty pictures with traps."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vehanchor.errors import InvalidParameterError
from vehanchor_evaluation.commands.request import plain_command
from vehanchor_evaluation.commands.service import MODEL_PANEL, PlannerRequest, exit_if_stopped

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor_evaluation.agent_tools import ToolCaller
    from vehanchor_evaluation.agents import AgentScore
    from vehanchor_evaluation.question_set import SetQuestion


class TaskName(StrEnum):
    """Kinds of tasks."""

    DISTANCE = "distance"
    FIT = "fit"
    DIRECTION = "direction"


@dataclass(frozen=True, kw_only=True)
class AgentsRequest(PlannerRequest):
    """Options of the command, one per field."""

    pictures: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="Rendered pictures of the questions, by their names in the set.")
    ]
    data: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder of the photographs. Default: no photographs.")
    ] = None
    task: Annotated[list[TaskName] | None, typer.Option(help="Kind of tasks; may be repeated. Default: all three.")] = (
        None
    )
    limit: Annotated[int, typer.Option(min=1, metavar="N", help="Maximum number of pictures.")] = 40
    as_json: Annotated[bool, typer.Option("--json", help="Print a line of JSON per planner.")] = False
    descriptions: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="JSON of other descriptions by the tool's name: the model is asked with both versions.",
            rich_help_panel=MODEL_PANEL,
        ),
    ] = None

    def questions(self) -> list[tuple[SetQuestion, Path]]:
        """Return the questions whose pictures are there.

        Raises:
            InvalidParameterError: there is none.
        """
        from vehanchor_evaluation.question_set import question_set

        asked = []
        for each in question_set():
            folder = self.pictures if each.scene is not None else self.data
            if folder is not None and (folder / each.file).is_file():
                asked.append((each, folder / each.file))
        if not asked:
            first = next(each for each in question_set() if each.scene is not None)
            assert first.scene is not None
            size = f"--size {first.scene.width_px} {first.scene.height_px}"
            raise InvalidParameterError(
                f"{str(self.pictures)!r} has no picture of the set. Render them, the first by: vehanchor scene "
                f"{self.pictures / first.file} --gsd {first.scene.gsd_m_per_px} --layout {first.scene.layout} "
                f"--seed {first.scene.seed} {size}"
            )
        return asked[: self.limit]


@plain_command(AgentsRequest)
def agents(request: AgentsRequest) -> None:
    """Score planners on pictures with recognised things, traps among them: acted or abstained, rightly or not.

    Each picture has a task of distance, of fit and of direction. The scripted planner does them with and without the
    recognised things. With --provider and --model, a real model also does, with --descriptions in two versions. Its key
    comes from the environment.
    """
    from vehanchor.cli.terminal import print_json
    from vehanchor_evaluation.agent_tools import open_agent_tools

    request.check_model()
    asked = request.questions()
    with open_agent_tools(sorted({path.resolve().parent for _, path in asked})) as tools:
        rows, stopped = _rows(request, asked, tools)
    if request.as_json:
        for row in rows:
            print_json(row.model_dump(mode="json"))
    else:
        _print_rows(rows)
    exit_if_stopped(stopped)


def _rows(
    request: AgentsRequest, asked: Sequence[tuple[SetQuestion, Path]], tools: ToolCaller
) -> tuple[list[AgentScore], str | None]:
    """Give every planner the tasks; return their rows, and the reason for an early end."""
    from vehanchor_evaluation.agents import agent_score, ask_agent, read_descriptions
    from vehanchor_evaluation.question_set import TASKS, ask_set, task_of

    versions: list[tuple[str, ToolCaller]] = [(request.model, tools)]
    if request.descriptions is not None:
        versions.append(
            (f"{request.model}, {request.descriptions.name}", read_descriptions(request.descriptions, tools))
        )
    kinds = [kind for kind in TASKS if not request.task or kind in {each.value for each in request.task}]
    rows = []
    for name, catalogue in (("script, with what it recognises", True), ("script, without", False)):
        done = ask_set(
            [(task_of(each, kind), path) for each, path in asked for kind in kinds], tools, catalogue=catalogue
        )
        rows += [agent_score(name, kind, [each for each in done if each.task.kind == kind]) for kind in kinds]
    api = request.model_api()
    if api is None:
        return rows, None
    stopped = None
    for name, described in versions:
        for kind in kinds:
            run = ask_agent([(task_of(each, kind), path) for each, path in asked], api, described)
            rows.append(agent_score(name, kind, run.answers, run.calls, run.tokens))
            stopped = stopped or run.stopped
    return rows, stopped


def _print_rows(rows: Sequence[AgentScore]) -> None:
    from rich import box
    from rich.table import Table
    from rich.text import Text

    from vehanchor.cli.terminal import print_table

    table = Table("planner", "task", box=box.SIMPLE_HEAD)
    for heading in ("questions", "acted rightly", "wrongly", "abstained rightly", "needlessly", "calls", "tokens"):
        table.add_column(heading, justify="right")
    for row in rows:
        values = row.model_dump(exclude={"name", "task"}).values()
        table.add_row(Text(row.name), row.task, *("-" if value is None else str(value) for value in values))
    print_table(table)
