"""Rendered vehicles and look-alikes on real ground.

``python -m research.training.chips.paste RUN --count 12000`` writes the store ``RUN/pasted``. The
ground comes from train images of known scale. A vehicle keeps its true size; its corners are exact
and exclude its shadow. Vehicles and look-alikes are drawn, blurred and coarsened alike.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import NamedTuple, TypeAlias

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from research.scenes.fleet import Fleet, VehicleModel
from research.scenes.painter import VEHICLE_SHADOW_HEIGHT_M
from research.scenes.sprites import VEHICLE_PAD, Sun, vehicle_sprite
from research.training.chips.lookalikes import LOOKALIKES, Canvas, shade
from research.training.chips.mine import GSD_M_PER_PX, chia_images, relative, type_of
from research.training.chips.store import STORED_LENGTH_PX, STORED_PX, UNKNOWN, ChipStore, Rows
from research.training.detector.data import TrainImage, load_train_images
from research.training.detector.scenery import CAR_M, load_scenery
from research.training.logistic import weight_of_sets
from vehanchor.detection.boxes import boxes_from_corners
from vehanchor.detection.chips import KINDS

Point: TypeAlias = NDArray[np.float64]
"""Point x, y ``[2]`` in pixels."""

Box: TypeAlias = NDArray[np.float64]
"""Box ``[5]``: x, y, length, width, angle."""

# Chips are drawn twice as fine as they are stored.
_CANVAS_PX = 2 * STORED_PX
_CAR_SHARE = 0.55
_LORRY_SHARE = 0.12
# Share of vehicles with others parked beside them.
_COMPANY_SHARE = 0.3
# Share of cars and of lorries whose candidate does not fit.
_WRONG_CAR_SHARE = 0.15
_WRONG_LORRY_SHARE = 0.4
_PARKED_PITCH_M = (2.3, 2.9)
# Length of the candidate around a look-alike.
_LOOKALIKE_M = 4.5
# Sharp grounds are few, and small objects need them.
_SHARP_M_PER_PX = 0.06
_SHARP_WEIGHT = 4.0
# Corners of a vehicle's outline, as shares of its length and width.
_OUTLINE = np.array(
    [
        (-0.5, -0.36),
        (-0.44, -0.5),
        (0.42, -0.5),
        (0.5, -0.3),
        (0.5, 0.3),
        (0.42, 0.5),
        (-0.44, 0.5),
        (-0.5, 0.36),
    ]
)


class Ground(NamedTuple):
    """Train image with its scale."""

    sample: TrainImage
    gsd_m_per_px: float


def free_position(rng: Generator, ground: Ground, reach_m: float) -> Point | None:
    """Draw a position without a labelled car within ``reach_m``; None after six failures.

    Most positions are near a labelled car: on a road or a car park.
    """
    sample, gsd = ground
    height, width = sample.image.shape[:2]
    for _ in range(6):
        if len(sample.boxes) and rng.random() < 0.75:
            angle = rng.uniform(0, 2 * np.pi)
            distance = rng.uniform(3, 14) / gsd
            car = sample.boxes[rng.integers(len(sample.boxes)), :2]
            position = car + distance * np.array([np.cos(angle), np.sin(angle)])
        else:
            position = rng.uniform(0, 1, 2) * (width, height)
        margin = 3 / gsd
        far_margin = np.array([width, height]) - margin
        if not ((position > margin) & (position < far_margin)).all():
            continue
        distances = np.linalg.norm(sample.boxes[:, :2] - position, axis=1)
        if (distances > reach_m / gsd).all():
            return np.asarray(position)
    return None


def ground_canvas(ground: Ground, position: Point, turn: float, px_per_m: float) -> Canvas:
    """Cut the ground around a position, turned, at the canvas's resolution."""
    # Pixels of the source to one of the canvas.
    step = 1 / (px_per_m * ground.gsd_m_per_px)
    source = ground.sample.image
    # A source that is finer than the canvas is reduced first, so that it does not alias.
    if step > 1.3:
        reach = 0.75 * _CANVAS_PX * step + 4
        x0 = max(0, int(position[0] - reach))
        y0 = max(0, int(position[1] - reach))
        part = source[y0 : int(position[1] + reach), x0 : int(position[0] + reach)]
        part_h, part_w = part.shape[:2]
        size = (max(2, round(part_w / step)), max(2, round(part_h / step)))
        source = np.asarray(cv2.resize(part, size, interpolation=cv2.INTER_AREA), np.uint8)
        position = (position - (x0, y0)) / step
        step = 1.0
    cos = step * math.cos(turn)
    sin = step * math.sin(turn)
    matrix = np.array([[cos, -sin, 0.0], [sin, cos, 0.0]])
    matrix[:, 2] = position - matrix[:, :2] @ (_CANVAS_PX / 2, _CANVAS_PX / 2)
    # Continuous coordinates have pixel centres at +0.5.
    matrix[:, 2] += matrix[:, :2] @ (0.5, 0.5) - 0.5
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    out = cv2.warpAffine(
        source, matrix, (_CANVAS_PX, _CANVAS_PX), flags=flags, borderMode=cv2.BORDER_REFLECT
    )
    return np.asarray(out, np.float32)


def draw_vehicle(
    canvas: Canvas,
    model: VehicleModel,
    box: Box,
    px_per_m: float,
    sun: Sun,
    strength: float,
) -> None:
    """Draw a vehicle and its shadow.

    Args:
        canvas: changed in place.
        model: the vehicle.
        box: ``(x, y, length, width, angle)`` in pixels of the canvas.
        px_per_m: resolution of the canvas.
        sun: the sun.
        strength: strength of the shadow.
    """
    x, y, length, width, angle = box
    cos = math.cos(angle)
    sin = math.sin(angle)
    turn = np.array([[cos, -sin], [sin, cos]])
    points = (_OUTLINE * (length, width)) @ turn.T + (x, y)
    height = VEHICLE_SHADOW_HEIGHT_M.get(model.body.partition(":")[0], 1.15)
    shade(canvas, points, height_px=height * px_per_m, sun=sun, strength=strength)
    light = sun.light(angle)
    sprite = vehicle_sprite(
        model.body, model.length_m, width=model.width_m, px_per_m=px_per_m, light=light
    )
    rows, columns = sprite.shape[:2]
    pad = 2 * VEHICLE_PAD * length
    scale = np.array([columns / (length + pad), rows / (width + pad)])
    matrix = scale[:, None] * turn.T
    offset = np.array([columns, rows]) / 2 - matrix @ (x, y)
    full = np.column_stack([matrix, offset + matrix @ (0.5, 0.5) - 0.5])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    size = canvas.shape[1::-1]
    patch = cv2.warpAffine(sprite, full, size, flags=flags, borderValue=(0, 0, 0, 0))
    cover = patch[:, :, 0, None]
    paint = patch[:, :, 1, None]
    grey = patch[:, :, 2, None]
    red = patch[:, :, 3, None]
    glass = np.array((0.95, 1.0, 1.09), np.float32)
    lamp = np.array((1.0, 0.22, 0.2), np.float32)
    colour = np.array(model.paint, np.float32)
    canvas[:] = canvas * (1 - cover) + paint * colour + grey * glass + red * lamp


def photographed(rng: Generator, canvas: Canvas, coarse: float) -> NDArray[np.uint8]:
    """Make the stored chip of a canvas, as coarse as its ground.

    Args:
        rng: random numbers.
        canvas: the canvas.
        coarse: pixels of the canvas to one of the ground's source.
    """
    stored_size = (STORED_PX, STORED_PX)
    pixels: Canvas = np.clip(canvas, 0, 255)
    if coarse > 2.0:
        side = max(16, round(_CANVAS_PX / coarse))
        small = cv2.resize(pixels, (side, side), interpolation=cv2.INTER_AREA)
        method = cv2.INTER_CUBIC if rng.random() < 0.5 else cv2.INTER_LINEAR
        chip = cv2.resize(small, stored_size, interpolation=method)
    else:
        soft = cv2.GaussianBlur(pixels, (0, 0), rng.uniform(0.5, 1.4))
        chip = cv2.resize(soft, stored_size, interpolation=cv2.INTER_AREA)
    levels = np.asarray(chip, np.float32)
    return np.asarray(np.clip(levels + 0.5, 0, 255), np.uint8)


class Pasted(NamedTuple):
    """Chip and its row."""

    chip: NDArray[np.uint8]
    car: int
    type: int
    box: NDArray[np.float32] | None
    length_m: float
    length_px: float


def pasted(rng: Generator, ground: Ground, fleet: Fleet) -> Pasted | None:
    """Draw a vehicle or a look-alike on real ground; None without a free position."""
    draw = rng.random()
    is_car = draw < _CAR_SHARE
    is_vehicle = draw < _CAR_SHARE + _LORRY_SHARE
    position = free_position(rng, ground, 5.0)
    if position is None:
        return None
    azimuth = rng.uniform(0, 2 * np.pi)
    elevation_deg = rng.uniform(25, 75)
    sun = Sun(azimuth, math.radians(elevation_deg))
    strength = 0.0 if rng.random() < 0.2 else rng.uniform(0.5, 1.05)
    if is_vehicle:
        model = fleet.small() if is_car else fleet.large()
        return _pasted_vehicle(
            rng, ground, position, model=model, fleet=fleet, sun=sun, strength=strength
        )
    return _pasted_lookalike(rng, ground, position, sun)


def _pasted_vehicle(
    rng: Generator,
    ground: Ground,
    position: Point,
    *,
    model: VehicleModel,
    fleet: Fleet,
    sun: Sun,
    strength: float,
) -> Pasted:
    """Draw a car or a lorry, and a candidate that fits or does not."""
    is_car = model.kind == "small-vehicle"
    wrong = rng.random() < (_WRONG_CAR_SHARE if is_car else _WRONG_LORRY_SHARE)
    candidate, truth = _candidate(rng, model, wrong=wrong)
    px_per_m = 2 * STORED_LENGTH_PX / candidate[2]
    turn = rng.uniform(0, 2 * np.pi)
    canvas = ground_canvas(ground, position, turn=turn, px_per_m=px_per_m)
    if rng.random() < _COMPANY_SHARE:
        _draw_company(
            rng, canvas, truth=truth, px_per_m=px_per_m, sun=sun, strength=strength, fleet=fleet
        )
    x, y = _CANVAS_PX / 2 + truth[:2] * px_per_m
    length_px, width_px = truth[2:4] * px_per_m
    box = np.array([x, y, length_px, width_px, truth[4]])
    draw_vehicle(canvas, model, box=box, px_per_m=px_per_m, sun=sun, strength=strength)
    coarse = px_per_m * ground.gsd_m_per_px
    fits = is_car and not wrong
    return Pasted(
        photographed(rng, canvas, coarse),
        car=int(fits),
        type=UNKNOWN if wrong else type_of(model.body, model.length_m),
        box=relative(candidate[None], truth[None])[0] if fits else None,
        length_m=model.length_m if fits else math.nan,
        length_px=_source_length_px(coarse),
    )


def _pasted_lookalike(rng: Generator, ground: Ground, position: Point, sun: Sun) -> Pasted:
    """Draw a look-alike, with a candidate about as long."""
    px_per_m = 2 * STORED_LENGTH_PX / _LOOKALIKE_M
    turn = rng.uniform(0, 2 * np.pi)
    canvas = ground_canvas(ground, position, turn=turn, px_per_m=px_per_m)
    draw_lookalike = LOOKALIKES[rng.integers(len(LOOKALIKES))]
    length, _ = draw_lookalike(rng, canvas, px_per_m, sun)
    # The picture is scaled so that the candidate is about as long as the look-alike.
    factor = _LOOKALIKE_M / length * float(np.exp(rng.normal(0, 0.12)))
    shift = (1 - factor) * _CANVAS_PX / 2
    matrix = np.array([[factor, 0.0, shift], [0.0, factor, shift]])
    scaled = cv2.warpAffine(
        canvas,
        matrix,
        canvas.shape[1::-1],
        flags=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REFLECT,
    )
    coarse = px_per_m * factor * ground.gsd_m_per_px
    return Pasted(
        photographed(rng, np.asarray(scaled, np.float32), coarse),
        car=0,
        type=KINDS.index("other"),
        box=None,
        length_m=math.nan,
        length_px=_source_length_px(coarse),
    )


def _source_length_px(coarse: float) -> float:
    """Compute the candidate's length in pixels of the ground's source, at most 36."""
    return 2 * STORED_LENGTH_PX / coarse if coarse > 2 else 36.0


def _candidate(
    rng: Generator, model: VehicleModel, *, wrong: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Draw a candidate and the true box beside it, in metres.

    The candidate lies around the origin with an angle of 0. A wrong one does not fit.
    """
    turn = rng.normal(0, 0.05)
    shift = rng.normal(0, 0.04 * model.length_m, 2)
    size = float(np.exp(rng.normal(0, 0.06)))
    if wrong:
        how = rng.integers(3)
        if how == 0 or model.kind == "large-vehicle":
            # The candidate is a part of the vehicle, or the vehicle and what stands beside it.
            is_part = rng.random() < 0.7
            log_size = rng.uniform(-1.0, -0.5) if is_part else rng.uniform(0.5, 0.9)
            size = float(np.exp(log_size))
            free = max(0.0, 1 - size) * model.length_m
            shift = np.array([rng.uniform(-0.5, 0.5) * free, rng.normal(0, 0.2)])
        elif how == 1:
            angle = rng.uniform(0, 2 * np.pi)
            distance = rng.uniform(0.45, 1.0) * model.length_m
            shift = distance * np.array([np.cos(angle), np.sin(angle)])
        else:
            turn = rng.uniform(0.6, np.pi - 0.6)
    length = model.length_m * size
    candidate = np.array([0.0, 0.0, length, 0.45 * length, 0.0])
    front = np.pi if rng.random() < 0.5 else 0.0
    return candidate, np.array([*shift, model.length_m, model.width_m, turn + front])


def _draw_company(
    rng: Generator,
    canvas: Canvas,
    truth: NDArray[np.float64],
    px_per_m: float,
    sun: Sun,
    strength: float,
    fleet: Fleet,
) -> None:
    """Draw vehicles parked beside the vehicle, or before and behind it."""
    cos = math.cos(truth[4])
    sin = math.sin(truth[4])
    beside = rng.random() < 0.7
    if beside:
        pitch = rng.uniform(*_PARKED_PITCH_M)
        direction = np.array([-sin, cos])
    else:
        pitch = truth[2] + rng.uniform(0.6, 2.0)
        direction = np.array([cos, sin])
    for k in (-3, -2, -1, 1, 2, 3):
        if rng.random() < 0.4:
            continue
        model = fleet.small()
        both = model.width_m + truth[3] if beside else model.length_m + truth[2]
        if abs(k) == 1 and pitch < both / 2 + 0.2:
            continue
        middle = truth[:2] + k * pitch * direction + rng.normal(0, 0.12, 2)
        turn = rng.normal(0, 0.03)
        angle = truth[4] + turn + (np.pi if rng.random() < 0.5 else 0)
        x, y = _CANVAS_PX / 2 + middle * px_per_m
        if max(abs(x - _CANVAS_PX / 2), abs(y - _CANVAS_PX / 2)) > _CANVAS_PX:
            continue
        box = np.array([x, y, model.length_m * px_per_m, model.width_m * px_per_m, angle])
        draw_vehicle(canvas, model, box=box, px_per_m=px_per_m, sun=sun, strength=strength)


def grounds(data: Path) -> list[Ground]:
    """Load the train images of known scale."""
    samples: list[TrainImage] = [*load_train_images(data / "vehicles"), *load_scenery(data)]
    for image in chia_images(data):
        # Its cars have no labels but ignored squares; nothing may be drawn on them.
        boxes = boxes_from_corners(image.sample.ignore)
        samples.append(image.sample._replace(boxes=boxes))
    grounds_of_known_scale = []
    for sample in samples:
        gsd = CAR_M / sample.car_px if sample.car_px else GSD_M_PER_PX.get(sample.set)
        if gsd:
            grounds_of_known_scale.append(Ground(sample, gsd))
    return grounds_of_known_scale


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--count", type=int, default=12_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument(
        "--without", default="", help="sets whose ground is left out, separated by commas"
    )
    options = parser.parse_args()
    cv2.setNumThreads(1)
    rng = np.random.default_rng(options.seed)
    excluded = options.without.split(",")
    usable = [ground for ground in grounds(options.data) if ground.sample.set not in excluded]
    names = np.array([ground.sample.set for ground in usable])
    odds = weight_of_sets(names)
    odds[[ground.gsd_m_per_px < _SHARP_M_PER_PX for ground in usable]] *= _SHARP_WEIGHT
    chips: list[Pasted] = []
    while len(chips) < options.count:
        ground = usable[int(rng.choice(len(usable), p=odds / odds.sum()))]
        chip = pasted(rng, ground, Fleet(4.58, rng, "mixed"))
        if chip is not None:
            chips.append(chip)
            if len(chips) % 1000 == 0:
                print(len(chips), flush=True)
    store = ChipStore()
    no_box = np.full(5, np.nan, np.float32)
    rows = Rows.unlabelled(np.array([chip.length_px for chip in chips]), "pasted", "pasted")
    rows = rows._replace(
        car=np.array([chip.car for chip in chips], np.int8),
        type=np.array([chip.type for chip in chips], np.int8),
        box=np.stack([no_box if chip.box is None else chip.box for chip in chips]),
        log_length_m=np.log(np.array([chip.length_m for chip in chips], np.float32)),
    )
    store.add(np.stack([chip.chip for chip in chips]), rows)
    rows = store.save(options.run / "pasted")
    print(f"{(rows.car == 1).sum()} cars, {(rows.car == 0).sum()} others")


if __name__ == "__main__":
    main()
