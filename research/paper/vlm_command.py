"""Command ``python -m research.paper vlm``: the error of areas stated by a language model."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from research.paper.service import ServiceRequest, exit_if_stopped, plain_command
from research.paper.tools import open_tools
from research.paper.vlm import Query, run_vlm_trials
from research.paper.vlm_api import Provider
from research.paper.vlm_report import report_stem, vlm_report
from vehanchor.cli.terminal import work_progress
from vehanchor_evaluation.area_report import area_markdown, write_area_report
from vehanchor_evaluation.areas import read_areas
from vehanchor_evaluation.commands.sources import print_issues

if TYPE_CHECKING:
    from collections.abc import Sequence

    from research.paper.tools import InProcessTools
    from vehanchor_evaluation.areas import AreaEntry

_TOOLS = "Tools of --agent"


@dataclass(frozen=True, kw_only=True)
class VlmRequest(ServiceRequest):
    """Options of the command, one per field."""

    segments: Annotated[
        Path, typer.Option(metavar="DIR", help="A folder as for 'vehanchor evaluate area'.")
    ]
    provider: Annotated[
        Provider, typer.Option(help="API of the model; openai-compatible: vLLM, DashScope, ...")
    ]
    model: Annotated[str, typer.Option(metavar="NAME", help="Name of the model.")]
    out: Annotated[
        Path,
        typer.Option(metavar="DIR", help="Folder of results and replies; a run resumes there."),
    ]
    hint: Annotated[
        bool, typer.Option("--hint", help="Give the model the length of cars, as in the paper.")
    ] = False
    agent: Annotated[
        bool,
        typer.Option("--agent", help="Let the model measure with estimate_gsd and measure_area."),
    ] = False
    limit: Annotated[
        int | None,
        typer.Option(
            min=1, metavar="N", help="Ask only about the first N entries; categories alternate."
        ),
    ] = None
    max_side: Annotated[
        int, typer.Option(min=64, metavar="PX", help="Longest side of the image in the prompt.")
    ] = 1568
    max_turns: Annotated[
        int,
        typer.Option(
            min=1, metavar="N", help="Maximum number of replies of --agent for one entry."
        ),
    ] = 8
    detector: Annotated[
        str | None,
        typer.Option(metavar="FILE", help="Default: the bundled one.", rich_help_panel=_TOOLS),
    ] = None
    segmenter: Annotated[
        tuple[str, str] | None,
        typer.Option(
            metavar="ENCODER DECODER", help="Default: the bundled one.", rich_help_panel=_TOOLS
        ),
    ] = None

    def tools(self, entries: Sequence[AreaEntry]) -> InProcessTools:
        """Open the tools of an agent, which read only the images of the benchmark."""
        files = (
            None if self.segmenter is None else (Path(self.segmenter[0]), Path(self.segmenter[1]))
        )
        roots = sorted({entry.image.parent for entry in entries})
        return open_tools(roots, detector=self.detector, segmenter=files)


@plain_command(VlmRequest)
def vlm(request: VlmRequest) -> None:
    """Measure the error of areas that a vision-language model states, or --agent with tools.

    Replies are stored and never requested again. Limits end a run cleanly (exit status 3); the same
    command resumes. Keys come from the environment and are never written.
    """
    data = read_areas(request.segments)
    entries = data.entries[: request.limit]
    api = request.open_api(request.provider, request.model, request.out)
    query = Query(
        hint=request.hint,
        agent=request.agent,
        max_side_px=request.max_side,
        max_turns=request.max_turns,
    )
    with ExitStack() as stack:
        tools = stack.enter_context(request.tools(entries)) if request.agent else None
        progress = stack.enter_context(work_progress("questions"))
        run = run_vlm_trials(entries, api, query, tools=tools, progress=progress)
    print_issues(run.issues)
    report = vlm_report(data, api, query=query, run=run, n_entries=len(entries))
    write_area_report(
        request.out, report_stem(query), report=report, records=run.trials, issues=run.issues
    )
    print(area_markdown(report), end="")
    exit_if_stopped(run.stopped)
