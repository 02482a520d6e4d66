"""Areas stated by a vision-language model: the paper's baselines, and with VehAnchor's tools.

The protocol is the paper's: a system role, a red rectangle around the target, and one question that
asks for square metres in a last line ``AREA=<number>``. The hinted setting adds one sentence. Every
model gets the same query. A refusal or a reply without a number counts as an error of 100 %, as
does a pipeline without a scale.
"""

from __future__ import annotations

import base64
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from research.paper.conversation import converse
from research.paper.stated_area import read_area
from research.paper.vlm_api import ApiRefusedError, BudgetSpentError, RequestFailedError
from vehanchor.errors import VehAnchorError
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.pictures.scale import read_reduced
from vehanchor_evaluation.area_errors import AreaErrors, area_errors
from vehanchor_evaluation.known_scale import FileIssue

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from research.paper.tools import ToolCaller
    from research.paper.vlm_api import ModelApi
    from vehanchor_evaluation.areas import AreaEntry

SYSTEM = "You are a remote sensing image analysis expert."
QUESTION = (
    "What is the area, in square metres (m^2), of the object inside the red rectangle? "
    "End your answer with a last line of the form AREA=<number>, the area in m^2."
)
HINT = "Small vehicles (cars) are approximately 5 m long; use them as a scale reference."
_AGENT = (
    "Measure with your tools instead of guessing; they work on the image file at full size, not "
    "on the picture. "
    "The file is {path}. The picture that you see is {width} x {height} px: give that size as "
    "frame. In the picture's "
    "pixels the red rectangle has the corners ({x1:.1f}, {y1:.1f}) and ({x2:.1f}, {y2:.1f})."
)
# Longest side that the Messages API does not reduce.
MAX_SIDE_PX = 1568
MAX_TURNS = 8
_RED_RGB = (255, 0, 0)
_JPEG_QUALITY = 95
# After so many failures the service is down, and further requests would fail.
_FAILURES_IN_A_ROW = 5


@dataclass(frozen=True)
class Query:
    """Form of the question.

    Attributes:
        hint: append the paper's sentence on the length of cars.
        agent: let the model use tools; the prompt gives the file, the image's size and the
            rectangle's corners, which a planner knows.
        max_side_px: longest side of the image in the prompt; larger images are reduced.
        max_turns: maximum number of replies of an agent for one entry.
    """

    hint: bool = False
    agent: bool = False
    max_side_px: int = MAX_SIDE_PX
    max_turns: int = MAX_TURNS


class VlmTrial(BaseModel):
    """Answer of a model about one entry."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    entry: str
    image: str
    category: str
    true_area_m2: float
    stated_area_m2: float | None
    problem: str | None = Field(
        description="Why the area is missing: refused, too_many_turns, no_area_line, no_number, "
        "unknown_unit."
    )
    last_line: str = Field(description="Last line of the reply.")
    turns: int = Field(description="Replies; 1 without tools.")
    tool_calls: str = Field(description="Tools called, in order.")
    input_tokens: int
    output_tokens: int


class VlmRun(NamedTuple):
    """Trials in the order of the entries, issues, and the reason for an early end."""

    trials: list[VlmTrial]
    issues: list[FileIssue]
    stopped: str | None


class Question(NamedTuple):
    """Image in the prompt.

    Attributes:
        jpeg: the image with the red rectangle.
        width_px: width of the image in the prompt.
        height_px: height of the image in the prompt.
        corners: x1, y1, x2, y2 of the target's box in its pixels; the rectangle lies just outside.
    """

    jpeg: bytes
    width_px: int
    height_px: int
    corners: tuple[float, float, float, float]


def draw_question(
    image: NDArray[np.uint8], scale: float, box: Sequence[float], max_side_px: int
) -> Question:
    """Reduce an image and draw a red rectangle around a box.

    Args:
        image: ``[h, w, 3]`` RGB.
        scale: pixels of ``image`` per pixel of the box's image; 1, or less for a reduced copy.
        box: x1, y1, x2, y2.
        max_side_px: longest side of the result; images are never enlarged.
    """
    height, width = image.shape[:2]
    factor = min(1.0, max_side_px / max(width, height))
    size = max(1, round(width * factor)), max(1, round(height * factor))
    picture = (
        cv2.resize(image, size, interpolation=cv2.INTER_AREA) if factor < 1 else np.array(image)
    )
    ratios = np.array(size) / (width, height)
    corners = np.asarray(box, np.float64) * scale * np.tile(ratios, 2)
    line = max(2, round(max(size) / 500))
    outset = (line + 1) // 2  # the line stays clear of the object
    first = np.floor(corners[:2]).astype(int) - outset
    last = np.ceil(corners[2:]).astype(int) - 1 + outset
    first = np.maximum(first, 0)
    last = np.minimum(last, np.array(size) - 1)
    cv2.rectangle(picture, first.tolist(), last.tolist(), _RED_RGB, line)
    quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    bgr = np.ascontiguousarray(picture[:, :, ::-1])
    _, encoded = cv2.imencode(".jpg", bgr, quality)
    x1, y1, x2, y2 = corners.tolist()
    return Question(encoded.tobytes(), *size, (x1, y1, x2, y2))


def run_vlm_trials(
    entries: Sequence[AreaEntry],
    api: ModelApi,
    query: Query,
    *,
    tools: ToolCaller | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> VlmRun:
    """Ask about every entry.

    Failed entries become issues. The run ends early and keeps its results if the budget is spent,
    the service refuses the key or the model, or five requests in a row fail.

    Args:
        entries: entries of a benchmark.
        api: the model.
        query: form of the question.
        tools: tools for an agent.
        progress: called with (entries done, total).
    """
    trials: list[VlmTrial] = []
    issues: list[FileIssue] = []
    failures = 0
    for done, entry in enumerate(entries, start=1):
        try:
            trials.append(_ask(entry, api, query, tools))
        except (BudgetSpentError, ApiRefusedError) as error:
            return VlmRun(trials, issues, str(error))
        except RequestFailedError as error:
            issues.append(FileIssue(entry.image, "request_failed", f"{entry.name}: {error}"))
            failures += 1
            if failures >= _FAILURES_IN_A_ROW:
                return VlmRun(
                    trials, issues, f"{failures} requests in a row failed, the last: {error}"
                )
        except VehAnchorError as error:
            issues.append(FileIssue(entry.image, error.code, f"{entry.name}: {error}"))
        else:
            failures = 0
        if progress is not None:
            progress(done, len(entries))
    return VlmRun(trials, issues, None)


def _ask(entry: AreaEntry, api: ModelApi, query: Query, tools: ToolCaller | None) -> VlmTrial:
    with open_raster(entry.image) as raster:
        seen = read_reduced(raster)
        question = draw_question(
            seen, seen.shape[1] / raster.width_px, box=entry.corners, max_side_px=query.max_side_px
        )
    text = f"{QUESTION} {HINT}" if query.hint else QUESTION
    if tools is not None:
        x1, y1, x2, y2 = question.corners
        text += " " + _AGENT.format(
            path=entry.image,
            width=question.width_px,
            height=question.height_px,
            x1=x1,
            y1=y1,
            x2=x2,
            y2=y2,
        )
    picture = base64.b64encode(question.jpeg).decode()
    conversation = converse(
        api, SYSTEM, text=text, jpeg_base64=picture, tools=tools, max_turns=query.max_turns
    )
    reply = conversation.last
    stated = read_area(reply.text)
    problem: str | None = stated.problem
    if problem and reply.refused:
        problem = "refused"
    elif problem and reply.tool_calls:
        problem = "too_many_turns"
    return VlmTrial(
        entry=entry.name,
        image=str(entry.image),
        category=entry.category,
        true_area_m2=entry.area_m2,
        stated_area_m2=stated.area_m2,
        problem=problem,
        last_line=(reply.text.strip().splitlines() or [""])[-1][:200],
        turns=conversation.turns,
        tool_calls=" ".join(conversation.called),
        input_tokens=conversation.input_tokens,
        output_tokens=conversation.output_tokens,
    )


def summarise_vlm(name: str, trials: Sequence[VlmTrial]) -> AreaErrors:
    """Summarise a model's trials as a row of the table."""
    return area_errors(name, ((t.category, t.stated_area_m2, t.true_area_m2) for t in trials))
