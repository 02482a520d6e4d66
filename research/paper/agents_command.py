"""Command ``python -m research.paper agents``: whether a planner acts and abstains rightly on forty pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

import typer

from research.paper.agents import AgentScore, agent_score, ask_agent, read_descriptions
from research.paper.question_set import TASKS, Task, ask_set, picture_of, question_set, task_of
from research.paper.service import MODEL_PANEL, PlannerRequest, exit_if_stopped, plain_command
from research.paper.tools import open_tools
from research.results.record import header, recording

if TYPE_CHECKING:
    from research.paper.question_set import SetQuestion
    from research.paper.tools import ToolCaller

Asked: TypeAlias = Sequence[tuple[Task, Path]]


class TaskName(StrEnum):
    """Kinds of tasks."""

    DISTANCE = "distance"
    FIT = "fit"
    DIRECTION = "direction"


@dataclass(frozen=True, kw_only=True)
class AgentsRequest(PlannerRequest):
    """Options of the command, one per field."""

    pictures: Annotated[Path, typer.Argument(metavar="FOLDER", help="Rendered pictures; missing ones are rendered.")]
    data: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder of the photographs. Default: no photographs.")
    ] = None
    task: Annotated[list[TaskName] | None, typer.Option(help="Kind of tasks; may be repeated. Default: all three.")] = (
        None
    )
    limit: Annotated[int, typer.Option(min=1, metavar="N", help="Maximum number of pictures.")] = 40
    descriptions: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="JSON of other descriptions by the tool's name: the model is asked with both versions.",
            rich_help_panel=MODEL_PANEL,
        ),
    ] = None

    def questions(self) -> list[tuple[SetQuestion, Path]]:
        """Return the questions with their pictures, rendered if necessary; photographs only with their folder."""
        chosen = [each for each in question_set() if each.scene is not None or self.data is not None][: self.limit]
        return [(each, picture_of(each, self.data or Path(), self.pictures)) for each in chosen]


@plain_command(AgentsRequest)
def agents(request: AgentsRequest) -> None:
    """Score planners on pictures with recognised things, traps among them: acted or abstained, rightly or not.

    Each picture has a task of distance, of fit and of direction. The scripted planner does them with and without the
    recognised things. With --provider and --model, a real model also does, with --descriptions in two versions. Its key
    comes from the environment.
    """
    request.check_model()
    asked = request.questions()
    with open_tools(sorted({path.resolve().parent for _, path in asked})) as tools:
        rows, stopped = _rows(request, asked, tools)
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
    kinds = [kind for kind in TASKS if not request.task or kind in {each.value for each in request.task}]
    asked: dict[str, Asked] = {kind: [(task_of(each, kind), path) for each, path in questions] for kind in kinds}
    rows = []
    for name, catalogue in (("with what it recognises", True), ("without", False)):
        every = [asked[kind][k] for k in range(len(questions)) for kind in kinds]
        done = ask_set(every, tools, catalogue=catalogue)
        rows += [agent_score(name, kind, [each for each in done if each.task.kind == kind]) for kind in kinds]
    api = request.model_api()
    if api is None:
        return rows, None
    versions = {request.model: tools}
    if request.descriptions is not None:
        name = f"{request.model}, {request.descriptions.name}"
        versions[name] = read_descriptions(request.descriptions, tools)
    stopped = None
    for name, described in versions.items():
        for kind in kinds:
            run = ask_agent(asked[kind], api, described)
            rows.append(agent_score(name, kind, run.answers, run.calls, run.tokens))
            stopped = stopped or run.stopped
    return rows, stopped
