"""Planner questions about photographs of known scale, answered with and without tools.

The planner is a script, so the results depend only on the tools' answers and their cost. If a scale
is not usable, the planner can ask a person, who has measured one line on the ground. Without tools
it assumes a usual pixel size.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from pydantic import BaseModel, ConfigDict, Field

from vehanchor.imagery.sources.opening import open_raster
from vehanchor_evaluation.known_scale import DATASET_READING

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from research.paper.tools import ToolCaller
    from vehanchor_evaluation.known_scale import KnownScaleImage

Kind: TypeAlias = Literal["distance", "fit"]
Verdict: TypeAlias = Literal["right", "wrong", "no answer"]

CHARACTERS_A_TOKEN = 4
# Pixel size that a planner without tools assumes, and its relative error.
USUAL_GSD_M = 0.15
USUAL_ERROR = 0.3
# Required length as a share of the available one: one fits, one does not.
_FIT_SHARES = (0.6, 1.6)
# Questions about two photographs: four distances and three fits.
_QUESTIONS_PER_TWO = 7

STRETCH = ((0.4, 0.6), (0.6, 0.6))
"""Ends of the line that a person has measured, as fractions of the sides."""


@dataclass(frozen=True)
class Question:
    """Question and its true answer.

    Attributes:
        kind: distance needs a number, fit needs yes or no.
        image: the photograph.
        words: the question in a user's words.
        places: x, y of the ends of a line, as fractions of the sides.
        truth: metres, or whether it fits (1 or 0).
        needed_m: length that must fit.
        size_px: size of the image.
        stretch_m: length of ``STRETCH`` on the ground, measured with a tape to a decimetre.
    """

    kind: Kind
    image: Path
    words: str
    places: tuple[tuple[float, float], tuple[float, float]]
    truth: float
    size_px: tuple[int, int]
    needed_m: float = 0.0
    stretch_m: float = 0.0


@dataclass
class Outcome:
    """Result of a question.

    Attributes:
        question: the question.
        verdict: "no answer" if the result is not usable, or if the interval leaves "does it fit"
            open.
        calls: number of tool calls.
        tokens: tokens sent to and read from tools.
    """

    question: Question
    verdict: Verdict
    calls: int = 0
    tokens: float = 0


class PlannerScore(BaseModel):
    """Row of the table."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    name: str
    questions: int
    right: int = Field(description="The interval contains the truth, or yes/no is correct.")
    wrong: int
    no_answer: int
    calls_per_right: float | None
    tokens_per_right: float | None


def questions_of_photographs(images: Sequence[KnownScaleImage], limit: int) -> list[Question]:
    """Create questions about images of known scale: two distances and one or two fits each.

    Args:
        images: images whose scale counts as exact; if there are more than needed, evenly spaced
            ones are used.
        limit: maximum number of questions.

    Raises:
        ImageError: an image cannot be read.
    """
    n_needed = min(len(images), -(-2 * limit // _QUESTIONS_PER_TWO))
    questions: list[Question] = []
    for number in range(n_needed):
        image = images[number * len(images) // n_needed]
        with open_raster(image.path, DATASET_READING) as raster:
            width = raster.width_px
            height = raster.height_px
        (start_x, _), (end_x, _) = STRETCH
        stretch_m = round((end_x - start_x) * width * image.gsd_m_per_px, 1)
        about = _distances(
            image.path, (width, height), image.gsd_m_per_px, both_fits=number % 2 == 1
        )
        questions += [replace(question, stretch_m=stretch_m) for question in about]
    return questions[:limit]


def _distances(
    image: Path, size_px: tuple[int, int], gsd: float, *, both_fits: bool
) -> list[Question]:
    ends = {
        "How wide is what the picture shows, from the left tenth to the right tenth?": (
            (0.1, 0.5),
            (0.9, 0.5),
        ),
        "How far is it from the upper left to the lower right quarter?": (
            (0.25, 0.25),
            (0.75, 0.75),
        ),
    }
    questions = []
    for words, places in ends.items():
        metres = gsd * math.hypot(
            *((b - a) * side for a, b, side in zip(*places, size_px, strict=True))
        )
        questions.append(Question("distance", image, words, places, metres, size_px))
    metres = gsd * 0.5 * size_px[0]
    for share in _FIT_SHARES[: 1 + both_fits]:
        needed = share * metres
        words = f"Does a row of {needed:.0f} m fit between the left and the right quarter?"
        places = ((0.25, 0.4), (0.75, 0.4))
        questions.append(
            Question("fit", image, words, places, float(needed <= metres), size_px, needed)
        )
    return questions


@dataclass
class _Dialogue:
    """Dialogue of the planner with the tools.

    Attributes:
        tools: the tools.
        with_person: whether the planner asks a person if a scale is not usable.
        measured: lines that the person has measured, arguments of the tools, by image.
    """

    tools: ToolCaller
    with_person: bool = False
    measured: dict[Path, dict[str, Any]] = field(default_factory=dict)

    def ask(self, question: Question) -> Outcome:
        outcome, status = self._measure(question)
        if not self.with_person or question.image in self.measured or status in ("ok", None):
            return outcome
        (x1, y1), (x2, y2) = STRETCH
        line = {
            "x1": x1,
            "y1": y1,
            "x2": x2,
            "y2": y2,
            "metres": question.stretch_m,
            "basis": "measured",
        }
        self.measured[question.image] = line
        again, _ = self._measure(question)
        return replace(
            again, calls=outcome.calls + again.calls, tokens=outcome.tokens + again.tokens
        )

    def _measure(self, question: Question) -> tuple[Outcome, str | None]:
        """Measure the line of a question; return the outcome and the status, None for an error."""
        points = [{"x": x, "y": y} for x, y in question.places]
        arguments: dict[str, Any] = {
            "image": {"kind": "path", "path": str(question.image.resolve())},
            "coordinates": "fraction",
            "lines": [{"points": points}],
        }
        if question.image in self.measured:
            arguments["known_lengths"] = [self.measured[question.image]]
        answer, is_error = self.tools.call("measure_distance", arguments)
        record: dict[str, Any] = {} if is_error else json.loads(answer.splitlines()[-1])
        verdict: Verdict = "no answer"
        if record.get("status") == "ok":
            verdict = _interval_verdict(
                question, record["distance_ci95_low_m"], record["distance_ci95_high_m"]
            )
        tokens = (len(json.dumps(arguments)) + len(answer)) / CHARACTERS_A_TOKEN
        return Outcome(question, verdict, 1, tokens), record.get("status")


def ask_with_tools(
    questions: Iterable[Question], tools: ToolCaller, *, with_person: bool = False
) -> list[Outcome]:
    """Answer questions with tools; a result that is not ok counts as no answer.

    Args:
        questions: questions in order.
        tools: the tools.
        with_person: whether a person supplies one measured length if a result is not ok.
    """
    dialogue = _Dialogue(tools, with_person)
    return [dialogue.ask(question) for question in questions]


def ask_blindly(questions: Iterable[Question]) -> list[Outcome]:
    """Answer questions by multiplying pixels by a usual pixel size."""
    outcomes = []
    for question in questions:
        (x1, y1), (x2, y2) = question.places
        width_px, height_px = question.size_px
        across = (x2 - x1) * width_px
        down = (y2 - y1) * height_px
        value = math.hypot(across, down) * USUAL_GSD_M
        spread = 1 + USUAL_ERROR
        outcomes.append(
            Outcome(question, _interval_verdict(question, value / spread, value * spread))
        )
    return outcomes


def _interval_verdict(question: Question, low: float, high: float) -> Verdict:
    if question.kind != "fit":
        return "right" if low <= question.truth <= high else "wrong"
    if low < question.needed_m < high:
        return "no answer"
    return "right" if (question.needed_m <= low) == bool(question.truth) else "wrong"


def score(name: str, outcomes: Sequence[Outcome]) -> PlannerScore:
    """Count verdicts, calls and tokens."""
    verdicts = [outcome.verdict for outcome in outcomes]
    right = verdicts.count("right")
    calls = sum(each.calls for each in outcomes)
    tokens = sum(each.tokens for each in outcomes)
    return PlannerScore(
        name=name,
        questions=len(outcomes),
        right=right,
        wrong=verdicts.count("wrong"),
        no_answer=verdicts.count("no answer"),
        calls_per_right=calls / right if right else None,
        tokens_per_right=tokens / right if right else None,
    )
