"""Deeds of a language model with the tools: did it act, or abstain, and rightly.

The tasks are those of ``question_set``: forty pictures with what a careful observer recognises in
them, traps among the facts. A model acts by an interval, by yes or no, or by a direction with an
interval, and abstains by ``ANSWER=unknown``. Stored replies are a transcript: the same run reads
them again without a request.
"""

from __future__ import annotations

import base64
import re
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from research.paper.conversation import converse
from research.paper.question_set import Answered, Direction, TaskKind, checked_file, image_size
from research.paper.vlm_api import ApiRefusedError, BudgetSpentError, RequestFailedError
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.pictures.scale import read_reduced
from vehanchor_evaluation.known_scale import DATASET_READING

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from research.paper.question_set import Reply, Task
    from research.paper.tools import ToolCaller
    from research.paper.vlm_api import ModelApi

_SYSTEM = (
    "You answer questions about overhead images. If there is no answer that one could act on, "
    "say so instead of "
    "guessing."
)
_MAX_TURNS = 10
_MAX_SIDE_PX = 1568
_JPEG_QUALITY = 90
_LAST_LINES: dict[TaskKind, str] = {
    "distance": "ANSWER=<low> to <high>, the 95 % interval in metres",
    "fit": "ANSWER=yes or ANSWER=no",
    "direction": "ANSWER=<degrees> deg, <low> to <high>: degrees clockwise from the top, 95 % "
    "interval in metres",
}
_ANSWER = re.compile(r"\bANSWER[ *_`]*=[ *_`]*([^\r\n]*)", re.IGNORECASE)
_NUMBER = r"(\d+(?:\.\d+)?(?:e[+-]?\d+)?)"
_INTERVAL = re.compile(_NUMBER + r"\s*(?:m2|m\^2|m\u00b2|m)?\s*(?:to|-|\u2013|\.\.)\s*" + _NUMBER)
_BEARING = re.compile(
    r"\bANSWER[ *_`]*=[ *_`]*(\d+(?:\.\d+)?) *(?:degrees|deg|\u00b0)[ ,;:]+([^\r\n]*)",
    re.IGNORECASE,
)


class AgentScore(BaseModel):
    """Row of the table: the deeds of one planner in tasks of one kind."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    name: str
    task: TaskKind
    questions: int
    acted_rightly: int = Field(
        description="The interval contains the truth, or yes or no is right; so is a direction."
    )
    acted_wrongly: int
    abstained_rightly: int = Field(description="No careful person would have acted.")
    abstained_needlessly: int
    calls: int | None = Field(
        description="Tool calls; null for the script, which makes one a question."
    )
    tokens: int | None = Field(
        description="Tokens as the service counts them; null for the script."
    )


class AgentRun(NamedTuple):
    """Answers of a model, its cost, and the reason for an early end (None for a complete run)."""

    answers: list[Answered]
    calls: int
    tokens: int
    stopped: str | None


def ask_agent(tasks: Iterable[tuple[Task, Path]], api: ModelApi, tools: ToolCaller) -> AgentRun:
    """Give a model each task separately, with the picture, the recognised facts and the tools.

    The run ends early if the budget is spent, the service refuses the key or the model, or a
    request fails.

    Raises:
        InvalidParameterError: a picture is missing or another one.
    """
    answers: list[Answered] = []
    calls = tokens = 0
    try:
        for task, path in tasks:
            image = checked_file(task.question, path)
            conversation = converse(
                api,
                _SYSTEM,
                text=_words(task, image),
                jpeg_base64=_encoded_picture(image),
                tools=tools,
                max_turns=_MAX_TURNS,
            )
            calls = calls + len(conversation.called)
            tokens = tokens + conversation.tokens
            answers.append(_answered(task, image, conversation.text))
    except (ApiRefusedError, BudgetSpentError, RequestFailedError) as error:
        return AgentRun(answers, calls, tokens=tokens, stopped=str(error))
    return AgentRun(answers, calls, tokens=tokens, stopped=None)


def agent_score(
    name: str,
    task: TaskKind,
    answers: Sequence[Answered],
    calls: int | None = None,
    tokens: int | None = None,
) -> AgentScore:
    """Count the deeds in tasks of one kind."""
    deeds = [answer.deed for answer in answers]
    return AgentScore(
        name=name,
        task=task,
        questions=len(deeds),
        acted_rightly=deeds.count("acted rightly"),
        acted_wrongly=deeds.count("acted wrongly"),
        abstained_rightly=deeds.count("abstained rightly"),
        abstained_needlessly=deeds.count("abstained needlessly"),
        calls=calls,
        tokens=tokens,
    )


def _answered(task: Task, image: Path, text: str) -> Answered:
    return Answered(task, task.deed(read_reply(task.kind, text), *image_size(image)))


def read_reply(kind: TaskKind, text: str) -> Reply:
    """Parse the last ``ANSWER=`` of a reply; None for "unknown" and for anything else."""
    if kind == "direction":
        bearings = _BEARING.findall(text)
        interval = read_answer(f"ANSWER={bearings[-1][1]}") if bearings else None
        return Direction(float(bearings[-1][0]), interval) if isinstance(interval, tuple) else None
    answer = read_answer(text)
    return answer if isinstance(answer, bool) == (kind == "fit") else None


def read_answer(reply: str) -> tuple[float, float] | bool | None:
    """Parse the last ``ANSWER=`` of a reply: an interval, yes or no; None for anything else."""
    lines = _ANSWER.findall(reply)
    text = lines[-1].strip(" .*_`\"'").lower().replace(",", "") if lines else ""
    if text in ("yes", "no"):
        return text == "yes"
    interval = _INTERVAL.match(text)
    return None if interval is None else (float(interval[1]), float(interval[2]))


def _words(task: Task, image: Path) -> str:
    size = image_size(image)
    (x1, y1), (x2, y2) = task.ends
    first = f"({x1:.4g}, {y1:.4g})"
    second = f"({x2:.4g}, {y2:.4g})"
    questions = {
        "distance": f"How far is it on the ground from {first} to {second}?",
        "fit": f"Does a thing {task.needed_m(*size):.1f} m long fit between {first} and {second}?",
        "direction": f"In which direction and how far is {second} from {first}?",
    }
    facts = [
        f"The line from ({fact['x1']}, {fact['y1']}) to ({fact['x2']}, {fact['y2']}) seems to be "
        f"{_length_text(fact['metres'])}."
        for fact in task.question.facts
    ]
    return " ".join(
        [
            questions[task.kind],
            "Places are fractions of the image's width and height from its upper left corner.",
            *facts,
            f"The file is {image.resolve()}. Measure with your tools, and do not use a result "
            "whose status is not ok. "
            f"End with a last line {_LAST_LINES[task.kind]}, or ANSWER=unknown.",
        ]
    )


def _length_text(metres: float | str) -> str:
    """Format a length in metres; a name of a known thing stays as it is."""
    return metres if isinstance(metres, str) else f"{metres:g} m long"


def _encoded_picture(image: Path) -> str:
    """Encode an image as base64 JPEG, reduced to the size that models see."""
    with open_raster(image, DATASET_READING) as raster:
        picture = read_reduced(raster)
    factor = min(1.0, _MAX_SIDE_PX / max(picture.shape[:2]))
    if factor < 1:
        height, width = picture.shape[:2]
        size = max(1, round(width * factor)), max(1, round(height * factor))
        reduced = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        picture = np.asarray(reduced, dtype=np.uint8)
    quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    bgr = np.ascontiguousarray(picture[:, :, ::-1])
    _, encoded = cv2.imencode(".jpg", bgr, quality)
    return base64.b64encode(encoded.tobytes()).decode()
