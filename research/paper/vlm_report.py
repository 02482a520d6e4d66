"""Report of an area benchmark with a vision-language model."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from research.paper.vlm import summarise_vlm
from vehanchor_evaluation.area_report import area_report

if TYPE_CHECKING:
    from collections.abc import Sequence

    from research.paper.vlm import Query, VlmRun, VlmTrial
    from research.paper.vlm_api import ModelApi
    from vehanchor_evaluation.area_report import AreaReport
    from vehanchor_evaluation.areas import AreaSet


def report_stem(query: Query) -> str:
    """Build the stem of a report's file names, which differs by setting."""
    return "_".join(["vlm", *_settings(query)])


def vlm_report(
    data: AreaSet, api: ModelApi, query: Query, run: VlmRun, n_entries: int
) -> AreaReport:
    """Create a report.

    Args:
        data: objects of the questions.
        api: the model.
        query: form of the question.
        run: the answers.
        n_entries: number of entries that were planned.
    """
    facts = [
        f"{len(run.trials)} of {n_entries} entries asked, {api.provider} {api.model}; a missing "
        "number counts as an "
        "error of 100 %",
        *_replies(run.trials),
        f"this run: {api.budget.requests} requests, {api.budget.tokens} tokens; other replies "
        "came from disk",
    ]
    settings: dict[str, Any] = {
        "provider": api.provider,
        "base_url": api.base_url,
        "model": api.model,
        "query": asdict(query),
        "entries": n_entries,
        "stopped": run.stopped,
    }
    row = summarise_vlm(" + ".join([api.model, *_settings(query)]), run.trials)
    return area_report(data, settings, rows=[row], facts=facts, issues=run.issues)


def _settings(query: Query) -> list[str]:
    return [name for name, is_set in (("hint", query.hint), ("tools", query.agent)) if is_set]


def _replies(trials: Sequence[VlmTrial]) -> list[str]:
    """Describe the model's replies, one sentence each."""
    problems = Counter(trial.problem for trial in trials if trial.problem)
    calls = Counter(call for trial in trials for call in trial.tool_calls.split())
    read = sum(trial.input_tokens for trial in trials)
    written = sum(trial.output_tokens for trial in trials)
    return [
        f"without an area: {_counts(problems)}",
        f"tokens of all replies: {read} in, {written} out",
        f"tool calls: {_counts(calls)}; {sum(trial.turns for trial in trials)} turns",
    ]


def _counts(counter: Counter[str]) -> str:
    return ", ".join(f"{count} {name}" for name, count in sorted(counter.items())) or "none"
