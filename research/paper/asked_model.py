"""Answers of a real vision-language model to the questions of ``questions``, with or without tools."""

from __future__ import annotations

import base64
import re
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from research.paper.conversation import converse
from research.paper.questions import Outcome, judge_answer
from research.paper.vlm_api import ApiRefusedError, BudgetSpentError, RequestFailedError
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.pictures.scale import read_reduced
from vehanchor_evaluation.known_scale import DATASET_LIMITS

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from research.paper.questions import Question
    from research.paper.tools import ToolCaller
    from research.paper.vlm_api import ModelApi

SYSTEM = (
    "You answer questions about overhead images. If there is no answer that one could act on, say so instead of "
    "guessing."
)
_MEASURING = (
    "Measure with your tools instead of guessing; they work on the image file at full size. The file is {path}. Do not "
    "use a result whose status is not ok."
)
_LAST_LINES = {
    "distance": "ANSWER=<low> to <high>, the 95 % interval in metres",
    "fit": "ANSWER=yes or ANSWER=no",
}
_MAX_SIDE_PX, _JPEG_QUALITY = 1568, 90
_ANSWER = re.compile(r"\bANSWER[ *_`]*=[ *_`]*([^\r\n]*)", re.IGNORECASE)
_NUMBER = r"(\d+(?:\.\d+)?(?:e[+-]?\d+)?)"
_INTERVAL = re.compile(_NUMBER + r"\s*(?:m2|m\^2|m\u00b2|m)?\s*(?:to|-|\u2013|\.\.)\s*" + _NUMBER)


class ModelAnswers(NamedTuple):
    """Outcomes of the questions, and the reason for an early end (None if the run is complete)."""

    outcomes: list[Outcome]
    stopped: str | None


def ask_model(questions: Iterable[Question], api: ModelApi, tools: ToolCaller | None = None) -> ModelAnswers:
    """Ask a model each question separately, with the image.

    The run ends early if the budget is spent, the service refuses the key or the model, or a request fails after all
    attempts. Stored replies are free in the next run.

    Args:
        questions: questions in order.
        api: the model.
        tools: tools that it may call; None for none.
    """
    outcomes: list[Outcome] = []
    try:
        for question in questions:
            outcomes.append(_ask(question, api, tools))
    except (ApiRefusedError, BudgetSpentError, RequestFailedError) as error:
        return ModelAnswers(outcomes, str(error))
    return ModelAnswers(outcomes, None)


def read_answer(reply: str) -> tuple[float, float] | bool | None:
    """Parse the last ``ANSWER=`` of a reply: an interval, yes or no; None for anything else, such as "unknown"."""
    lines = _ANSWER.findall(reply)
    text = lines[-1].strip(" .*_`\"'").lower().replace(",", "") if lines else ""
    if text in ("yes", "no"):
        return text == "yes"
    found = _INTERVAL.match(text)
    return None if found is None else (float(found[1]), float(found[2]))


def _ask(question: Question, api: ModelApi, tools: ToolCaller | None) -> Outcome:
    told = converse(api, SYSTEM, _words(question, tools is not None), encoded_picture(question.image), tools)
    verdict = judge_answer(question, read_answer(told.text))
    return Outcome(question, verdict, len(told.called), told.tokens)


def _words(question: Question, measuring: bool) -> str:
    (x1, y1), (x2, y2) = question.places
    first, second = f"({x1:.4f}, {y1:.4f})", f"({x2:.4f}, {y2:.4f})"
    words = [
        question.words,
        f"That is from {first} to {second}, as fractions of the image's width and height from its upper left corner.",
    ]
    if measuring:
        words.append(_MEASURING.format(path=question.image.resolve()))
    words.append(f"End with a last line {_LAST_LINES[question.kind]}, or ANSWER=unknown.")
    return " ".join(words)


def encoded_picture(image: Path) -> str:
    """Encode an image as base64 JPEG, reduced to the size that models see."""
    with open_raster(image, limits=DATASET_LIMITS) as raster:
        seen = read_reduced(raster)
    factor = min(1.0, _MAX_SIDE_PX / max(seen.shape[:2]))
    if factor < 1:
        size = max(1, round(seen.shape[1] * factor)), max(1, round(seen.shape[0] * factor))
        seen = np.asarray(cv2.resize(seen, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    _, encoded = cv2.imencode(".jpg", np.ascontiguousarray(seen[:, :, ::-1]), quality)
    return base64.b64encode(encoded.tobytes()).decode()
