"""Deeds of a language model with the tools: did it act, or abstain, and rightly; with which descriptions of the tools.

The questions are those of ``question_set``: forty pictures with what a careful observer recognises in them, traps among
the facts. A model acts by giving an interval, and abstains by ``ANSWER=unknown``. Stored replies are a transcript: the
same run reads them again without a request.
"""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Any, NamedTuple

from pydantic import BaseModel, ConfigDict, Field

from vehanchor.errors import InvalidParameterError
from vehanchor_evaluation.asked_model import SYSTEM, encoded_picture, read_answer
from vehanchor_evaluation.question_set import ENDS, Answered, checked_file, deed_of, image_size
from vehanchor_evaluation.vlm_api import ApiRefusedError, BudgetSpentError, RequestFailedError, ToolResult

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from vehanchor_evaluation.agent_tools import ToolCaller
    from vehanchor_evaluation.question_set import SetQuestion
    from vehanchor_evaluation.vlm_api import ModelApi

_MAX_TURNS = 10


class AgentScore(BaseModel):
    """Row of the table: the deeds of one planner with one version of the tools' descriptions."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    name: str
    questions: int
    acted_rightly: int = Field(description="The interval contains the truth.")
    acted_wrongly: int
    abstained_rightly: int = Field(description="No careful person would have acted.")
    abstained_needlessly: int
    calls: int | None = Field(description="Tool calls; null for the script, which makes one a question.")
    tokens: int | None = Field(description="Tokens as the service counts them; null for the script.")


class AgentRun(NamedTuple):
    """Answers of a model, its cost, and the reason for an early end (None if the run is complete)."""

    answers: list[Answered]
    calls: int
    tokens: int
    stopped: str | None


class Redescribed:
    """Tools with other descriptions.

    Args:
        tools: the tools.
        descriptions: by the tool's name; other tools keep theirs.
    """

    def __init__(self, tools: ToolCaller, descriptions: dict[str, str]) -> None:
        def described(tool: dict[str, Any]) -> dict[str, Any]:
            return {**tool, "description": descriptions.get(tool["name"], tool["description"])}

        self._tools = tools
        self.anthropic_tools = [described(tool) for tool in tools.anthropic_tools]
        self.openai_tools = [{**tool, "function": described(tool["function"])} for tool in tools.openai_tools]

    def call(self, name: str, arguments: dict[str, Any]) -> tuple[str, bool]:
        """Execute a tool call."""
        return self._tools.call(name, arguments)


def read_descriptions(path: Path, tools: ToolCaller) -> Redescribed:
    """Read other descriptions of tools, a JSON object by the tool's name.

    Raises:
        InvalidParameterError: the file is not such an object, or names a tool that does not exist.
    """
    known = [tool["name"] for tool in tools.anthropic_tools]
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InvalidParameterError(f"--descriptions {path} cannot be read as JSON: {error}") from None
    valid = isinstance(found, dict) and all(isinstance(text, str) and name in known for name, text in found.items())
    if not valid or not found:
        raise InvalidParameterError(
            f'--descriptions {path}: give {{"tool": "its description"}} with some of {", ".join(known)}'
        )
    return Redescribed(tools, found)


def ask_agent(asked: Iterable[tuple[SetQuestion, Path]], api: ModelApi, tools: ToolCaller) -> AgentRun:
    """Ask a model each question separately, with the picture, the recognised facts and the tools.

    The run ends early if the budget is spent, the service refuses the key or the model, or a request fails.

    Raises:
        InvalidParameterError: a picture is missing or another one.
    """
    answers: list[Answered] = []
    calls = tokens = 0
    try:
        for question, path in asked:
            image = checked_file(question, path)
            messages = api.first_messages(SYSTEM, _words(question, image), encoded_picture(image))
            for _ in range(_MAX_TURNS):
                reply = api.ask(SYSTEM, messages, tools)
                tokens += reply.input_tokens + reply.output_tokens
                if not reply.tool_calls:
                    break
                results = [ToolResult(*tools.call(call.name, call.arguments)) for call in reply.tool_calls]
                calls += len(results)
                messages = api.next_messages(messages, reply, results)
            answers.append(_answered(question, image, None if reply.tool_calls else read_answer(reply.text)))
    except (ApiRefusedError, BudgetSpentError, RequestFailedError) as error:
        return AgentRun(answers, calls, tokens, str(error))
    return AgentRun(answers, calls, tokens, None)


def agent_score(
    name: str, answers: Sequence[Answered], calls: int | None = None, tokens: int | None = None
) -> AgentScore:
    """Count the deeds."""
    deeds = [each.deed for each in answers]
    return AgentScore(
        name=name,
        questions=len(deeds),
        acted_rightly=deeds.count("acted rightly"),
        acted_wrongly=deeds.count("acted wrongly"),
        abstained_rightly=deeds.count("abstained rightly"),
        abstained_needlessly=deeds.count("abstained needlessly"),
        calls=calls,
        tokens=tokens,
    )


def _answered(question: SetQuestion, image: Path, answer: tuple[float, float] | bool | None) -> Answered:
    interval = answer if isinstance(answer, tuple) else None
    truth = question.truth_m(*image_size(image))
    ratio = None if interval is None else math.sqrt(interval[0] * interval[1]) / truth
    return Answered(question, deed_of(question, interval, truth), "answered" if interval else "unknown", ratio)


def _words(question: SetQuestion, image: Path) -> str:
    (x1, y1), (x2, y2) = ENDS
    seen = [
        f"The line from ({fact['x1']}, {fact['y1']}) to ({fact['x2']}, {fact['y2']}) seems to be "
        f"{fact['metres'] if isinstance(fact['metres'], str) else format(fact['metres'], 'g') + ' m long'}."
        for fact in question.facts
    ]
    return " ".join(
        [
            f"How far is it on the ground from ({x1}, {y1}) to ({x2}, {y2})? Places are fractions of the image's width "
            "and height from its upper left corner.",
            *seen,
            f"The file is {image.resolve()}. Measure with your tools, and do not use a result whose status is not ok. "
            "End with a last line ANSWER=<low> to <high>, the 95 % interval in metres, or ANSWER=unknown.",
        ]
    )
