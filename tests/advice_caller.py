"""A caller who follows advice, and has what it asks for: true facts, and the true photograph."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal, NamedTuple, TypeAlias

import cv2
import numpy as np

from research.scenes import Scene, SceneVehicle, render_scene
from vehanchor import Engine
from vehanchor.analysis.scale_analysis import ScaleAnalysis
from vehanchor.imagery.facts import ImageFacts
from vehanchor.imagery.metadata.lens import lens
from vehanchor.options import Basis, ScaleOptions
from vehanchor.records import GsdEstimate, Remedy
from vehanchor.records.advice import advice_for

Options: TypeAlias = Mapping[str, Any]
"""Options of a call, by keyword."""

Outcome: TypeAlias = Literal["right", "wrong", "where it began", "no way on", "not in three steps"]

MAX_STEPS = 3
_REMEMBERED = 128
FOCAL_35MM = 24.0
# Largest ratio of a right scale to the true one.
RIGHT_WITHIN = 1.2
# Named things of exact size, which differ in kind.
_THINGS = {
    "iso_container_40ft": 12.192,
    "tennis_court_length": 23.77,
    "football_penalty_area_width": 40.32,
}
# Remedies for which the caller sends the photograph that the bad one was made from.
_BETTER_PHOTOGRAPH: frozenset[Remedy] = frozenset(
    {
        "original",
        "aspect",
        "nadir",
        "lower",
        "visible",
        "perspective",
        "apart",
        "photograph",
    }
)


@dataclass(frozen=True, eq=False)
class Photo:
    """Photograph with what its caller knows about it.

    Attributes:
        image: pixels, bytes or path.
        size: width and height, pixels.
        gsd_m_per_px: true scale; None if no single scale is true.
        cars: its cars.
        better: the photograph as it was taken; None if this is it.
    """

    image: Any
    size: tuple[int, int]
    gsd_m_per_px: float | None
    cars: tuple[SceneVehicle, ...] = ()
    better: Photo | None = None

    def line(self, basis: Basis, *, row: float = 0.5, factor: float = 1.0) -> tuple[Any, ...]:
        """Draw a line of true length across the photograph, or of a false one.

        Args:
            basis: as the caller states it.
            row: its y over the height.
            factor: stated length over the true one.
        """
        assert self.gsd_m_per_px is not None
        width, height = self.size
        metres = round(0.8 * width * self.gsd_m_per_px * factor, 3)
        y = row * height
        return (0.1 * width, y, 0.9 * width, y, metres, basis)

    def thing(self, number: int) -> tuple[Any, ...]:
        """Draw a line over a named thing."""
        assert self.gsd_m_per_px is not None
        width, height = self.size
        name, metres = list(_THINGS.items())[number]
        left = 0.1 * width
        y = (0.2 + 0.1 * number) * height
        return (left, y, left + metres / self.gsd_m_per_px, y, name)

    def height(self, *, factor: float = 1.0, basis: Basis = "measured") -> Options:
        """State the true height and lens, or a false height.

        Args:
            factor: stated height over the true one.
            basis: as the caller states it.
        """
        assert self.gsd_m_per_px is not None
        optics = lens(ImageFacts(*self.size), None, FOCAL_35MM)
        assert optics is not None
        height_m = self.gsd_m_per_px * optics.pixels * factor
        return {"height_m": height_m, "height_basis": basis, "focal_35mm": FOCAL_35MM}


class Call(NamedTuple):
    """Photograph that is sent, with its options."""

    photo: Photo
    options: Options


class End(NamedTuple):
    """End of a path of advice.

    Attributes:
        steps: the remedies that were followed.
        outcome: what became of the scale.
        estimate: the last answer.
    """

    steps: tuple[Remedy, ...]
    outcome: Outcome
    estimate: GsdEstimate


def photo_of(scene: Scene, better: Photo | None = None) -> Photo:
    """Make a photograph of a rendered scene."""
    height, width = scene.image.shape[:2]
    cars = [vehicle for vehicle in scene.vehicles if vehicle.kind == "small-vehicle"]
    return Photo(scene.image, (width, height), scene.gsd_m_per_px, tuple(cars), better)


@cache
def rendered(
    gsd_m_per_px: float, seed: int, layout: Any, *, n_cars: int | None = None, side_px: int = 640
) -> Photo:
    """Render a photograph; see ``render_scene``."""
    scene = render_scene(
        gsd_m_per_px,
        width_px=side_px,
        height_px=side_px,
        seed=seed,
        layout=layout,
        n_vehicles=n_cars,
    )
    return photo_of(scene)


def pixels_as_photo(
    pixels: Any, gsd_m_per_px: float | None = None, better: Photo | None = None
) -> Photo:
    """Make a photograph of pixels ``[h, w, 3]``."""
    height, width = pixels.shape[:2]
    return Photo(pixels, (width, height), gsd_m_per_px, better=better)


def follow_all(
    engine: Engine, call: Call, *, guesses: bool, before: tuple[End, ...] = ()
) -> Iterator[End]:
    """Follow each remedy of each answer, up to three steps, and yield the ends of all paths.

    Args:
        engine: with the models.
        call: the first call.
        guesses: whether lines are drawn over named things, as long as that may help; otherwise all
            lines are measured.
        before: answers on the way, with the steps to them.
    """
    analysis = _analysed(engine, call)
    estimate = analysis.estimate
    steps = before[-1].steps if before else ()
    if estimate.status == "ok":
        yield End(steps, "right" if _is_right(estimate, call.photo) else "wrong", estimate)
        return
    if any(_is_same(estimate, end.estimate) for end in before):
        yield End(steps, "where it began", estimate)
        return
    if len(steps) == MAX_STEPS:
        yield End(steps, "not in three steps", estimate)
        return
    advice = advice_for(estimate)
    assert advice is not None
    n_followed = 0
    for remedy in advice.remedies:
        following = follow(remedy, call, analysis, guesses=guesses)
        if following is None:
            continue
        n_followed += 1
        # The step belongs to the answer that follows.
        now = End((*steps, remedy), "not in three steps", estimate)
        yield from follow_all(engine, following, guesses=guesses, before=(*before, now))
    if not n_followed:
        yield End(steps, "no way on", estimate)


_answers: dict[Any, ScaleAnalysis] = {}


def _analysed(engine: Engine, call: Call) -> ScaleAnalysis:
    """Answer a call; equal calls, with which many paths begin, are made once."""
    image = call.photo.image
    content = image
    if isinstance(image, np.ndarray):
        content = hashlib.sha256(image.tobytes()).digest()
    key = engine, content, repr(sorted(call.options.items()))
    if key not in _answers:
        _answers[key] = engine.analyse_scale(image, ScaleOptions.of(dict(call.options)))
    if len(_answers) > _REMEMBERED:
        _answers.pop(next(iter(_answers)))
    return _answers[key]


def _is_right(estimate: GsdEstimate, photo: Photo) -> bool:
    if estimate.gsd_m_per_px is None or photo.gsd_m_per_px is None:
        return False
    log_error = math.log(estimate.gsd_m_per_px / photo.gsd_m_per_px)
    return abs(log_error) <= math.log(RIGHT_WITHIN)


def _is_same(first: GsdEstimate, second: GsdEstimate) -> bool:
    """Test whether two answers say the same about what is wrong and what would help."""
    return (first.reason, advice_for(first)) == (second.reason, advice_for(second))


def follow(remedy: Remedy, call: Call, analysis: ScaleAnalysis, *, guesses: bool) -> Call | None:
    """Do what a remedy asks; None if this caller cannot.

    Args:
        remedy: the remedy.
        call: the call before.
        analysis: its answer.
        guesses: as in ``follow_all``.
    """
    photo, options = call
    if remedy in _BETTER_PHOTOGRAPH:
        if photo.better is None:
            return None
        # Lines and heights belong to the other picture.
        return Call(photo.better, {})
    if remedy == "drop":
        return _without_false_cars(call, analysis)
    if remedy == "add":
        return _with_missed_car(call, analysis)
    if remedy == "vehicles":
        return Call(photo, _without(options, "rulers"))
    if remedy == "region":
        return Call(photo, {**options, "region": "FR"})
    if photo.gsd_m_per_px is None:
        return None
    if remedy in ("line", "things"):
        return _with_line(call, guesses=guesses)
    if remedy == "length":
        return _with_line(call, guesses=False)
    if remedy == "height":
        return _with_height(call)
    if remedy == "images":
        return None
    if remedy == "facts":
        return _with_right_facts(call)
    raise AssertionError(f"nobody knows how to follow {remedy}")


def _without_false_cars(call: Call, analysis: ScaleAnalysis) -> Call | None:
    """Drop the vehicles that are not cars."""
    numbers = []
    for number, box in enumerate(_boxes(analysis), 1):
        if not any(_is_at(box, car) for car in call.photo.cars):
            numbers.append(number)
    if not numbers or len(call.photo.cars) == 0:
        return None
    return Call(call.photo, {**call.options, "drop": numbers})


def _with_missed_car(call: Call, analysis: ScaleAnalysis) -> Call | None:
    """Add a car that has no box."""
    boxes = _boxes(analysis)
    for car in call.photo.cars:
        if car.difficult or any(_is_at(box, car) for box in boxes):
            continue
        along = np.array([math.cos(car.angle_rad), math.sin(car.angle_rad)]) * car.length_px / 2
        axis = (car.x_px - along[0], car.y_px - along[1], car.x_px + along[0], car.y_px + along[1])
        return Call(call.photo, {**call.options, "add": [*call.options.get("add", ()), axis]})
    return None


def _boxes(analysis: ScaleAnalysis) -> Any:
    if analysis.vehicles is None:
        return ()
    return analysis.vehicles.fleet.detections.boxes


def _is_at(box: Any, car: SceneVehicle) -> bool:
    return math.hypot(box[0] - car.x_px, box[1] - car.y_px) < car.length_px / 2


def _with_line(call: Call, *, guesses: bool) -> Call | None:
    lines = list(call.options.get("known_lengths", ()))
    if guesses:
        if len(lines) == len(_THINGS):
            return None
        lines.append(call.photo.thing(len(lines)))
    else:
        # A line in the same place would be a copy.
        lines.append(call.photo.line("measured", row=0.6 + 0.1 * len(lines)))
    return Call(call.photo, {**_with_ruler(call.options, "known_length"), "known_lengths": lines})


def _with_height(call: Call) -> Call:
    return Call(call.photo, {**_with_ruler(call.options, "height"), **call.photo.height()})


def _with_ruler(options: Options, ruler: str) -> Options:
    """Add a ruler to those that the caller named."""
    if "rulers" not in options:
        return options
    return {**options, "rulers": f"{options['rulers']},{ruler}"}


def _with_right_facts(call: Call) -> Call | None:
    """Correct a false height, and leave out false lines; None if all facts are right."""
    photo, options = call
    if "height_m" in options:
        right = photo.height(basis=options["height_basis"])
        if not math.isclose(options["height_m"], right["height_m"], rel_tol=0.05):
            return Call(photo, {**options, **right})
    for line in options.get("known_lengths", ()):
        x1, y1, x2, y2, metres, *_ = line
        if isinstance(metres, str):
            continue
        gsd = metres / math.hypot(x2 - x1, y2 - y1)
        if not math.isclose(gsd, photo.gsd_m_per_px or 0.0, rel_tol=0.05):
            return Call(photo, _without(options, "known_lengths"))
    return None


def _without(options: Options, name: str) -> Options:
    return {other: value for other, value in options.items() if other != name}


def enlarged(photo: Photo, across: float, down: float) -> Any:
    """Enlarge the pixels of a photograph, or stretch them."""
    return cv2.resize(photo.image, None, fx=across, fy=down, interpolation=cv2.INTER_CUBIC)


def tilted(photo: Photo, inset: float) -> Any:
    """Make a view of a photograph as if the camera had been tilted.

    Args:
        photo: taken straight down.
        inset: share of the width that the upper side shows less of, at each end.
    """
    width, height = photo.size
    seen = [[inset * width, 0], [(1 - inset) * width, 0], [width, height], [0, height]]
    corners = [[0, 0], [width, 0], [width, height], [0, height]]
    transform = cv2.getPerspectiveTransform(
        np.array(seen, np.float32), np.array(corners, np.float32)
    )
    return cv2.warpPerspective(photo.image, transform, (width, height))
