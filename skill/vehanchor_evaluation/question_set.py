"""Forty planner questions with what the planner recognises, traps among them: ``question_set.json``.

Half of the images are rendered, half are val photographs. Facts are lines along things that the planner recognises:
right ones, and in traps wrong ones. A planner acts on a scale that is ``ok``, and abstains otherwise. To abstain is
right where no careful person would act; to act is right if the interval contains the truth.
"""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import dataclass
from importlib.resources import files
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from pydantic import BaseModel, ConfigDict

from vehanchor.errors import InvalidParameterError
from vehanchor.imagery.sources.opening import open_raster
from vehanchor_evaluation.known_scale import DATASET_LIMITS

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from vehanchor_evaluation.agent_tools import ToolCaller

Deed: TypeAlias = Literal["acted rightly", "acted wrongly", "abstained rightly", "abstained needlessly"]
ENDS = ((0.1, 0.5), (0.9, 0.5))
"""Ends of the asked distance, as fractions of the sides."""


class SceneOf(BaseModel):
    """Arguments of ``vehanchor_scenes.render_scene``."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    gsd_m_per_px: float
    layout: Literal["urban", "parking", "countryside", "sports"]
    seed: int
    width_px: int = 800
    height_px: int = 640


class SetQuestion(BaseModel):
    """Question about one image: how wide it is between the left and the right tenth.

    Attributes:
        scene: the scene to render; None for a photograph.
        file: photograph below the folder of data, or name of the rendered picture.
        sha256: of the file's bytes.
        gsd_m_per_px: true scale.
        expected: what a careful person does with the facts.
        why: reason for that, in words.
        facts: recognised lines, ends as fractions of the sides; arguments of ``known_lengths``.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    scene: SceneOf | None = None
    file: str
    sha256: str
    gsd_m_per_px: float
    expected: Literal["act", "abstain"]
    why: str
    facts: tuple[dict[str, Any], ...] = ()

    def truth_m(self, width_px: int, height_px: int) -> float:
        """Compute the true distance, metres."""
        return self.gsd_m_per_px * math.dist(*((x * width_px, y * height_px) for x, y in ENDS))


@dataclass(frozen=True)
class Answered:
    """Result of a question: what the planner did, the tool's status, and the ratio of its distance to the truth."""

    question: SetQuestion
    deed: Deed
    status: str
    ratio: float | None


def question_set() -> tuple[SetQuestion, ...]:
    """Read the questions."""
    text = files("vehanchor_evaluation").joinpath("question_set.json").read_text(encoding="utf-8")
    return tuple(SetQuestion.model_validate(each) for each in json.loads(text))


def checked_file(question: SetQuestion, path: Path) -> Path:
    """Check that a photograph or rendered picture is that of the question; return its path.

    Raises:
        InvalidParameterError: the file is missing, or its bytes are others than those of the set.
    """
    if not path.is_file():
        raise InvalidParameterError(f"{str(path)!r} is missing: give the folder of the photographs")
    if hashlib.sha256(path.read_bytes()).hexdigest() != question.sha256:
        raise InvalidParameterError(f"{str(path)!r} is another file than that of the question set")
    return path


def ask_set(asked: Iterable[tuple[SetQuestion, Path]], tools: ToolCaller, *, catalogue: bool) -> list[Answered]:
    """Answer questions with tools.

    Args:
        asked: the questions with their pictures.
        tools: the tools; they may read the pictures.
        catalogue: whether the planner gives the tool what it recognises.

    Raises:
        InvalidParameterError: a picture is missing or another one.
    """
    return [_ask(each, tools, checked_file(each, path), catalogue=catalogue) for each, path in asked]


def _ask(question: SetQuestion, tools: ToolCaller, image: Path, *, catalogue: bool) -> Answered:
    points = [{"x": x, "y": y} for x, y in ENDS]
    arguments: dict[str, Any] = {
        "image": {"kind": "path", "path": str(image.resolve())},
        "coordinates": "fraction",
        "lines": [{"points": points}],
        "detail": "full",
    }
    if catalogue and question.facts:
        arguments["known_lengths"] = list(question.facts)
    answer, is_error = tools.call("measure_distance", arguments)
    record: dict[str, Any] = {} if is_error else json.loads(answer.splitlines()[-1])
    record = record.get("measurements", [record])[0]
    status = record.get("status") or "error"
    if status != "ok":
        return Answered(question, deed_of(question, None, math.nan), status, None)
    truth = question.truth_m(record["image_width_px"], record["image_height_px"])
    interval = record["distance_ci95_low_m"], record["distance_ci95_high_m"]
    return Answered(question, deed_of(question, interval, truth), status, record["distance_m"] / truth)


def deed_of(question: SetQuestion, interval: tuple[float, float] | None, truth_m: float) -> Deed:
    """Judge an interval, or that there is none."""
    if interval is None:
        return "abstained rightly" if question.expected == "abstain" else "abstained needlessly"
    return "acted rightly" if interval[0] <= truth_m <= interval[1] else "acted wrongly"


def image_size(path: Path) -> tuple[int, int]:
    """Return the width and height of a picture, pixels."""
    with open_raster(path, limits=DATASET_LIMITS) as raster:
        return raster.width_px, raster.height_px
