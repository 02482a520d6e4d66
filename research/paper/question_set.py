"""Forty pictures with the objects a planner recognises, traps among them, and tasks.

``question_set.json`` has the pictures. Half of the images are rendered, half are val photographs.
Facts are lines along things that the planner recognises: right ones, and in traps wrong ones. Each
picture has three tasks: a distance, a length that must fit, and a direction with its distance. A
planner acts on a scale that is ``ok``, and abstains otherwise. To abstain is right where no careful
person would act.
"""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias

from pydantic import BaseModel, ConfigDict

from research.scenes import Layout, render_scene
from vehanchor.errors import InvalidParameterError
from vehanchor.imagery.sources.opening import open_raster
from vehanchor_evaluation.known_scale import DATASET_READING

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from research.paper.tools import ToolCaller

Deed: TypeAlias = Literal[
    "acted rightly", "acted wrongly", "abstained rightly", "abstained needlessly"
]
TaskKind: TypeAlias = Literal["distance", "fit", "direction"]
TASKS: tuple[TaskKind, ...] = ("distance", "fit", "direction")
Ends: TypeAlias = tuple[tuple[float, float], tuple[float, float]]

_ENDS: Ends = ((0.1, 0.5), (0.9, 0.5))
_FIT_ENDS: Ends = ((0.5, 0.2), (0.5, 0.8))
# Shares of the length between the ends: one fits, one does not, one cannot be decided.
_FIT_SHARES = (0.6, 1.6, 1.0)
# Number of directions from the middle, and distance as a share of the sides.
_DIRECTIONS = 8
_REACH = 0.35
_BEARING_TOLERANCE_DEG = 5.0


class SceneOf(BaseModel):
    """Arguments of ``research.scenes.render_scene``."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    gsd_m_per_px: float
    layout: Layout
    seed: int
    n_vehicles: int | None = None
    width_px: int = 800
    height_px: int = 640


class SetQuestion(BaseModel):
    """One image with what is recognised in it.

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


class Direction(NamedTuple):
    """Answer to a task of direction: degrees clockwise from the top, and the interval in metres."""

    bearing_deg: float
    interval: tuple[float, float]


Reply: TypeAlias = tuple[float, float] | bool | Direction | None
"""Interval in metres, whether it fits, or a direction; None for a planner that abstains."""


@dataclass(frozen=True)
class Task:
    """Task about one image.

    Attributes:
        question: the image.
        kind: distance between the ends, whether a length fits between them, or direction and
            distance to the second.
        ends: fractions of the sides.
        share: for a fit, the required length over the available one.
    """

    question: SetQuestion
    kind: TaskKind
    ends: Ends
    share: float = 0.0

    @property
    def expected(self) -> Literal["act", "abstain"]:
        """What a careful person does."""
        return "abstain" if self.undecidable else self.question.expected

    @property
    def undecidable(self) -> bool:
        """Whether the required length equals the available one, so that no measurement decides."""
        return self.share == 1.0

    def truth_m(self, width_px: int, height_px: int) -> float:
        """Compute the true distance between the ends, metres."""
        return self.question.gsd_m_per_px * math.dist(*_in_pixels(self.ends, width_px, height_px))

    def needed_m(self, width_px: int, height_px: int) -> float:
        """Compute the length that must fit, metres."""
        return self.share * self.truth_m(width_px, height_px)

    def bearing_deg(self, width_px: int, height_px: int) -> float:
        """Compute the direction from the first end to the second, clockwise from up, degrees."""
        (x1, y1), (x2, y2) = _in_pixels(self.ends, width_px, height_px)
        return math.degrees(math.atan2(x2 - x1, y1 - y2)) % 360

    def deed(self, reply: Reply, width_px: int, height_px: int) -> Deed:
        """Judge a reply, or that there is none."""
        if reply is None:
            return "abstained rightly" if self.expected == "abstain" else "abstained needlessly"
        return "acted rightly" if self._is_right(reply, width_px, height_px) else "acted wrongly"

    def _is_right(self, reply: Reply, width_px: int, height_px: int) -> bool:
        truth = self.truth_m(width_px, height_px)
        if self.kind == "fit":
            return not self.undecidable and reply is (self.share < 1)
        if isinstance(reply, Direction):
            off = (reply.bearing_deg - self.bearing_deg(width_px, height_px) + 180) % 360 - 180
            low, high = reply.interval
            return (
                self.kind == "direction"
                and abs(off) <= _BEARING_TOLERANCE_DEG
                and low <= truth <= high
            )
        return (
            self.kind == "distance" and isinstance(reply, tuple) and reply[0] <= truth <= reply[1]
        )


def _in_pixels(ends: Ends, width_px: int, height_px: int) -> list[tuple[float, float]]:
    return [(x * width_px, y * height_px) for x, y in ends]


def task_of(question: SetQuestion, kind: TaskKind) -> Task:
    """Make a task about an image; the image chooses the required length and the direction."""
    if kind == "distance":
        return Task(question, kind, _ENDS)
    number = int(question.sha256[:8], 16)
    if kind == "fit":
        return Task(question, kind, _FIT_ENDS, _FIT_SHARES[number % len(_FIT_SHARES)])
    angle = 2 * math.pi * (number % _DIRECTIONS + 0.4) / _DIRECTIONS
    end = (0.5 + _REACH * math.sin(angle), 0.5 - _REACH * math.cos(angle))
    return Task(question, kind, ((0.5, 0.5), end))


@dataclass(frozen=True)
class Answered:
    """Result of a task: what the planner did."""

    task: Task
    deed: Deed


def question_set() -> tuple[SetQuestion, ...]:
    """Read the questions."""
    text = Path(__file__).with_suffix(".json").read_text(encoding="utf-8")
    return tuple(SetQuestion.model_validate(entry) for entry in json.loads(text))


def picture_of(question: SetQuestion, data: Path, rendered: Path) -> Path:
    """Name the photograph of a question, or render its scene unless it is there.

    Args:
        question: the question.
        data: folder of the photographs.
        rendered: folder of the rendered pictures; created if it does not exist.
    """
    if question.scene is None:
        return data / question.file
    path = rendered / question.file
    if not path.is_file():
        rendered.mkdir(parents=True, exist_ok=True)
        render_scene(**question.scene.model_dump()).write(path)
    return path


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


def ask_set(
    tasks: Iterable[tuple[Task, Path]], tools: ToolCaller, *, catalogue: bool
) -> list[Answered]:
    """Do tasks with tools: one call for all tasks about a picture that follow each other.

    Args:
        tasks: the tasks with their pictures.
        tools: the tools; they may read the pictures.
        catalogue: whether the planner gives the tool what it recognises.

    Raises:
        InvalidParameterError: a picture is missing or another one.
    """
    answers: list[Answered] = []
    for (_, path), group in groupby(tasks, lambda pair: (pair[0].question, pair[1])):
        answers += _ask([task for task, _ in group], tools, path, catalogue=catalogue)
    return answers


def _ask(
    tasks: Sequence[Task], tools: ToolCaller, path: Path, *, catalogue: bool
) -> list[Answered]:
    question = tasks[0].question
    lines = []
    for task in tasks:
        points = [{"x": x, "y": y} for x, y in task.ends]
        lines.append({"points": points})
    arguments: dict[str, Any] = {
        "image": {"kind": "path", "path": str(checked_file(question, path).resolve())},
        "coordinates": "fraction",
        "lines": lines,
        "detail": "full",
    }
    if catalogue and question.facts:
        arguments["known_lengths"] = list(question.facts)
    answer, is_error = tools.call("measure_distance", arguments)
    record: dict[str, Any] = {} if is_error else json.loads(answer.splitlines()[-1])
    records = record.get("measurements", [record] * len(tasks))
    return [_answered(task, measured) for task, measured in zip(tasks, records, strict=True)]


def _answered(task: Task, record: dict[str, Any]) -> Answered:
    """Decide as the script does, and judge it."""
    if record.get("status") != "ok":
        return Answered(task, task.deed(None, 1, 1))
    size = record["image_width_px"], record["image_height_px"]
    low = record["distance_ci95_low_m"]
    high = record["distance_ci95_high_m"]
    reply: Reply = (low, high)
    if task.kind == "direction":
        reply = Direction(task.bearing_deg(*size), (low, high))
    elif task.kind == "fit":
        needed = task.needed_m(*size)
        reply = None
        if low >= needed:
            reply = True
        elif high < needed:
            reply = False
    return Answered(task, task.deed(reply, *size))


def image_size(path: Path) -> tuple[int, int]:
    """Return the width and height of a picture, pixels."""
    with open_raster(path, DATASET_READING) as raster:
        return raster.width_px, raster.height_px
