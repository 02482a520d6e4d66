"""Score of a recorded transcript: ``python -m research.paper transcript TRANSCRIPT.jsonl KEY.csv``.

A line of the transcript is a JSON object: ``question``, a name of the key; ``calls``, a list of
objects with ``name``, ``arguments`` and ``result`` (text); ``answer``, a number, an interval
``[low, high]``, true, false, or null to abstain; and ``tokens``, if the client counts them. Without
them, four characters of the calls and results are a token.

A row of the key has ``question``, ``truth`` (a number, yes or no; empty if no careful person would
act) and perhaps ``tolerance`` (relative; 0.3 by default). The geometric middle of an interval must
lie within the tolerance.
"""

from __future__ import annotations

import csv
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer
from pydantic import BaseModel, ConfigDict, ValidationError

from research.paper.question_set import Deed
from research.paper.service import plain_command
from research.results.record import header
from vehanchor.errors import InvalidParameterError

if TYPE_CHECKING:
    from collections.abc import Iterable

DEEDS: tuple[Deed, ...] = (
    "acted rightly",
    "acted wrongly",
    "abstained rightly",
    "abstained needlessly",
)
# Relative error of a right action, our choice.
_TOLERANCE = 0.3
_CHARACTERS_A_TOKEN = 4


class Call(BaseModel):
    """Tool call with its result."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    name: str
    arguments: dict[str, Any]
    result: str


class Turn(BaseModel):
    """Calls and answer to one question."""

    model_config = ConfigDict(frozen=True, extra="ignore", strict=True)

    question: str
    calls: list[Call] = []
    answer: bool | float | tuple[float, float] | None
    tokens: int | None = None

    @property
    def cost(self) -> int:
        """Tokens of the turn."""
        if self.tokens is not None:
            return self.tokens
        return (
            sum(len(json.dumps(call.arguments)) + len(call.result) for call in self.calls)
            // _CHARACTERS_A_TOKEN
        )


class Truth(NamedTuple):
    """True answer, None if no careful person would act, and the tolerance of a number."""

    value: float | bool | None
    tolerance: float


def read_key(rows: Iterable[dict[str, str]]) -> dict[str, Truth]:
    """Read the truths by the names of their questions."""
    words: dict[str, float | bool | None] = {"": None, "yes": True, "no": False}
    key = {}
    for row in rows:
        text = row["truth"]
        truth = words[text] if text in words else float(text)
        key[row["question"]] = Truth(truth, float(row.get("tolerance") or _TOLERANCE))
    return key


def deed(answer: float | bool | tuple[float, float] | None, truth: Truth) -> Deed:
    """Judge an answer."""
    if answer is None:
        return "abstained rightly" if truth.value is None else "abstained needlessly"
    if truth.value is None or isinstance(answer, bool) != isinstance(truth.value, bool):
        return "acted wrongly"
    if isinstance(answer, bool):
        return "acted rightly" if answer == truth.value else "acted wrongly"
    value = (
        math.sqrt(max(answer[0], 0.0) * max(answer[1], 0.0))
        if isinstance(answer, tuple)
        else answer
    )
    return "acted rightly" if abs(value / truth.value - 1) <= truth.tolerance else "acted wrongly"


def score(turns: Iterable[Turn], key: dict[str, Truth]) -> dict[str, int]:
    """Count deeds, calls and tokens.

    Raises:
        InvalidParameterError: a question of the key has no turn or several, or a turn has no
            question.
    """
    every = list(turns)
    names = [turn.question for turn in every]
    all_names = {*names, *key}
    wrong = [name for name in all_names if names.count(name) != 1 or name not in key]
    if wrong:
        raise InvalidParameterError(
            f"the questions of transcript and key differ: {', '.join(sorted(wrong))}"
        )
    deeds = [deed(turn.answer, key[turn.question]) for turn in every]
    counts = {each: deeds.count(each) for each in DEEDS}
    return counts | {
        "calls": sum(len(turn.calls) for turn in every),
        "tokens": sum(turn.cost for turn in every),
    }


@dataclass(frozen=True, kw_only=True)
class TranscriptRequest:
    """Arguments of the command, one per field."""

    transcript: Annotated[
        Path, typer.Argument(metavar="TRANSCRIPT.jsonl", help="One JSON object a question.")
    ]
    key: Annotated[
        Path,
        typer.Argument(metavar="KEY.csv", help="Columns question, truth and perhaps tolerance."),
    ]


@plain_command(TranscriptRequest)
def transcript(request: TranscriptRequest) -> None:
    """Score a recorded transcript of tool calls against a key: acted or not, calls, tokens."""
    try:
        lines = request.transcript.read_text(encoding="utf-8").splitlines()
        turns = [Turn.model_validate_json(line) for line in lines if line.strip()]
        with request.key.open(encoding="utf-8", newline="") as file:
            key = read_key(csv.DictReader(file))
    except (OSError, KeyError, ValidationError, ValueError) as error:
        raise InvalidParameterError(f"cannot read transcript or key: {error}") from None
    counts = score(turns, key)
    print(header(*counts))
    print(f"| {' | '.join(map(str, counts.values()))} |")
