"""``vehanchor evaluate vlm``, for the command line to mount."""

from __future__ import annotations

import sys
from collections import Counter
from contextlib import AbstractContextManager, ExitStack
from dataclasses import asdict
from enum import StrEnum
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vehanchor.cli.terminal import tile_progress, told_errors
from vehanchor.errors import MissingExtraError
from vehanchor_evaluation.commands.sources import tell_issues

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor_evaluation.rs_gsd import Benchmark, BenchmarkEntry
    from vehanchor_evaluation.vlm import Query, VlmRun
    from vehanchor_evaluation.vlm_api import ModelApi, ToolRunner

__all__ = ["vlm"]

_LIMITS, _TOOLS = "Ceilings and the service", "Tools of --agent"
_TOOLS_GROUP = "vehanchor.agent_tools"  # each gives (roots, detector=, segmenter=) -> context manager of a ToolRunner
_STOPPED = 3  # exit status of a run that ended early, results so far written


class _Provider(StrEnum):
    anthropic = "anthropic"
    openai = "openai"
    openai_compatible = "openai-compatible"


def vlm(
    benchmark: Annotated[Path, typer.Option(metavar="DIR", help="A benchmark that 'evaluate area' has built.")],
    provider: Annotated[_Provider, typer.Option(help="Whose API: openai-compatible is vLLM, DashScope, ...")],
    model: Annotated[str, typer.Option(metavar="NAME", help="Name of the model there.")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where results and replies go; a run goes on there.")],
    hint: Annotated[bool, typer.Option("--hint", help="Tell the model how long cars are, as in the paper.")] = False,
    agent: Annotated[
        bool, typer.Option("--agent", help="Let the model measure with estimate_gsd and measure_area.")
    ] = False,
    limit: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Ask about the first entries only; categories take turns.")
    ] = None,
    workers: Annotated[int, typer.Option(min=1, metavar="N", help="Requests at once.")] = 1,
    max_side: Annotated[
        int, typer.Option(min=64, metavar="PX", help="Longest side of the picture that is sent.")
    ] = 1568,
    max_turns: Annotated[int, typer.Option(min=1, metavar="N", help="Replies that --agent may take an entry.")] = 8,
    base_url: Annotated[
        str | None,
        typer.Option(metavar="URL", help="Address of the service. Default: the provider's.", rich_help_panel=_LIMITS),
    ] = None,
    key_variable: Annotated[
        str | None,
        typer.Option(
            "--api-key-env",
            metavar="NAME",
            help="Environment variable with the key. Default: ANTHROPIC_API_KEY or OPENAI_API_KEY.",
            rich_help_panel=_LIMITS,
        ),
    ] = None,
    max_requests: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Requests of this run.", rich_help_panel=_LIMITS)
    ] = None,
    max_tokens: Annotated[
        int | None,
        typer.Option(min=1, metavar="N", help="Input and output tokens of this run.", rich_help_panel=_LIMITS),
    ] = None,
    requests_per_minute: Annotated[
        float | None, typer.Option(min=0.001, metavar="N", help="At most so fast.", rich_help_panel=_LIMITS)
    ] = None,
    max_output_tokens: Annotated[
        int, typer.Option(min=16, metavar="N", help="Of one reply.", rich_help_panel=_LIMITS)
    ] = 4096,
    timeout: Annotated[
        float, typer.Option(min=0.1, metavar="S", help="Of one attempt, seconds.", rich_help_panel=_LIMITS)
    ] = 120.0,
    retries: Annotated[
        int, typer.Option(min=0, metavar="N", help="Attempts after the first.", rich_help_panel=_LIMITS)
    ] = 6,
    detector: Annotated[
        str | None, typer.Option(metavar="FILE", help="Default: the bundled.", rich_help_panel=_TOOLS)
    ] = None,
    segmenter: Annotated[
        tuple[str, str] | None,
        typer.Option(metavar="ENCODER DECODER", help="Default: the bundled.", rich_help_panel=_TOOLS),
    ] = None,
) -> None:
    """Error of areas that a vision-language model states: the paper's baselines, or with --agent by our tools.

    Replies are kept, and never asked for twice. Ceilings end a run cleanly (exit status 3); the same command goes on.
    Keys come from the environment and are never written.
    """
    with told_errors():
        from vehanchor_evaluation.rs_gsd import load_benchmark
        from vehanchor_evaluation.vlm import Query, run_vlm_trials
        from vehanchor_evaluation.vlm_api import Budget, ReplyCache, open_api

        built, sha256 = load_benchmark(benchmark)
        entries = built.entries[:limit]
        budget = Budget(max_requests, max_tokens, requests_per_minute)
        api = open_api(
            provider.value,
            model,
            ReplyCache(out / "replies"),
            budget,
            base_url=base_url,
            key_variable=key_variable,
            max_output_tokens=max_output_tokens,
            timeout_s=timeout,
            max_retries=retries,
        )
        query = Query(hint=hint, agent=agent, max_side_px=max_side, max_turns=max_turns)
        with ExitStack() as stack:
            tools = stack.enter_context(_tools(entries, detector, segmenter)) if agent else None
            step = stack.enter_context(tile_progress(1, lines_on_terminal=False))
            run = run_vlm_trials(
                entries, api, query, tools=tools, workers=workers, progress=step(0, f"{len(entries)} questions")
            )
        _tell(run, entries, api, query, built, sha256, out)
        if run.stopped:
            print(f"stopped: {run.stopped}; the same command goes on from here", file=sys.stderr)
            raise typer.Exit(_STOPPED)


def _tools(
    entries: Sequence[BenchmarkEntry], detector: str | None, segmenter: tuple[str, str] | None
) -> AbstractContextManager[ToolRunner]:
    """The tools that are installed beside the evaluation; they read the images of the benchmark and nothing else.

    Raises:
        MissingExtraError: none are installed.
    """
    try:
        open_tools = next(iter(entry_points(group=_TOOLS_GROUP))).load()
    except (StopIteration, ModuleNotFoundError) as error:
        raise MissingExtraError(
            f"--agent needs tools for models, and none are installed under the entry points {_TOOLS_GROUP!r}: install "
            "VehAnchor with its server (package vehanchor_server)"
        ) from error
    files = None if segmenter is None else (Path(segmenter[0]), Path(segmenter[1]))
    roots = sorted({Path(entry.image).parent for entry in entries})
    tools: AbstractContextManager[ToolRunner] = open_tools(roots, detector=detector, segmenter=files)
    return tools


def _tell(
    run: VlmRun,
    entries: Sequence[BenchmarkEntry],
    api: ModelApi,
    query: Query,
    benchmark: Benchmark,
    sha256: str,
    out: Path,
) -> None:
    """Write the results and print the table."""
    from vehanchor_evaluation.area_report import area_markdown, area_report, write_area_report
    from vehanchor_evaluation.vlm import summarise_vlm

    settings = {"hint": query.hint, "tools": query.agent}
    name = " + ".join([api.model, *(setting for setting, chosen in settings.items() if chosen)])
    stem = "_".join(["vlm", *(setting for setting, chosen in settings.items() if chosen)])
    facts = [
        f"{len(run.trials)} of {len(entries)} entries asked, {api.provider} {api.model}; no number counts as an error "
        "of 100 %",
        *_replies(run),
        f"this run: {api.budget.requests} requests, {api.budget.tokens} tokens; other replies were on disk",
    ]
    settings_of_run: dict[str, Any] = {
        "provider": api.provider,
        "base_url": api.base_url,
        "model": api.model,
        "query": asdict(query),
        "entries": len(entries),
        "stopped": run.stopped,
    }
    tell_issues(run.issues)
    report = area_report(benchmark, sha256, settings_of_run, [summarise_vlm(name, run.trials)], facts, run.issues)
    write_area_report(out, stem, report, run.trials, run.issues)
    print(area_markdown(report), end="")


def _replies(run: VlmRun) -> list[str]:
    """How the model answered."""
    if not run.trials:
        return []
    problems = Counter(trial.problem for trial in run.trials if trial.problem)
    counts = ", ".join(f"{count} {problem}" for problem, count in sorted(problems.items())) or "none"
    read, written = (
        sum(tokens) for tokens in zip(*((t.input_tokens, t.output_tokens) for t in run.trials), strict=True)
    )
    calls = Counter(call for trial in run.trials for call in trial.tool_calls.split())
    facts = [f"without an area: {counts}", f"tokens of all replies: {read} in, {written} out"]
    if calls:
        called = ", ".join(f"{count} {tool}" for tool, count in sorted(calls.items()))
        facts.append(f"tool calls: {called}; {sum(trial.turns for trial in run.trials)} turns")
    return facts
