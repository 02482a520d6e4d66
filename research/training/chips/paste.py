"""Rendered vehicles and look-alikes on real ground.

``python -m research.training.chips.paste RUN --count 12000`` writes the store ``RUN/pasted``. The
ground comes from train images of known scale. A vehicle keeps its true size; its corners are exact
and exclude its shadow. Vehicles and look-alikes are drawn, blurred and coarsened alike.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
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

_CANVAS_PX = 2 * STORED_PX  # drawn twice as fine
_CAR_SHARE = 0.55
_LORRY_SHARE = 0.12
_COMPANY_SHARE = 0.3  # vehicles with others parked beside them
_WRONG_SHARE = 0.15  # vehicles whose candidate does not fit
_PARKED_PITCH_M = (2.3, 2.9)
# such grounds are few, and small things need them
_SHARP_M_PER_PX = 0.06
_SHARP_WEIGHT = 4.0


class Ground(NamedTuple):
    """A train image with its scale."""

    sample: TrainImage
    gsd_m_per_px: float


def free_place(
    rng: np.random.Generator, ground: Ground, reach_m: float
) -> NDArray[np.float64] | None:
    """A place without a labelled car within ``reach_m``, by preference one near such a car: on a road or a car park."""
    sample, gsd = ground
    height, width = sample.image.shape[:2]
    for _ in range(6):
        if len(sample.boxes) and rng.random() < 0.75:
            angle = rng.uniform(0, 2 * np.pi)
            far = rng.uniform(3, 14) / gsd
            place = sample.boxes[rng.integers(len(sample.boxes)), :2] + far * np.array(
                [np.cos(angle), np.sin(angle)]
            )
        else:
            place = rng.uniform(0, 1, 2) * (width, height)
        inside = (place > 3 / gsd).all() and (place < np.array([width, height]) - 3 / gsd).all()
        if inside and (
            not len(sample.boxes)
            or np.linalg.norm(sample.boxes[:, :2] - place, axis=1).min() > reach_m / gsd
        ):
            return np.asarray(place)
    return None


def ground_canvas(
    ground: Ground, place: NDArray[np.float64], turn: float, px_per_m: float
) -> Canvas:
    """The ground around a place, turned, at the canvas's resolution."""
    step = 1 / (px_per_m * ground.gsd_m_per_px)  # source pixels to one of the canvas
    source = ground.sample.image
    if step > 1.3:
        reach = 0.75 * _CANVAS_PX * step + 4
        x0, y0 = (max(0, int(v - reach)) for v in place)
        part = source[y0 : int(place[1] + reach), x0 : int(place[0] + reach)]
        size = (max(2, round(part.shape[1] / step)), max(2, round(part.shape[0] / step)))
        source = np.asarray(cv2.resize(part, size, interpolation=cv2.INTER_AREA), np.uint8)
        place = (place - (x0, y0)) / step
        step = 1.0
    cos = step * math.cos(turn)
    sin = step * math.sin(turn)
    matrix = np.array([[cos, -sin, 0.0], [sin, cos, 0.0]])
    matrix[:, 2] = place - matrix[:, :2] @ (_CANVAS_PX / 2, _CANVAS_PX / 2)
    matrix[:, 2] += matrix[:, :2] @ (0.5, 0.5) - 0.5
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    out = cv2.warpAffine(
        source, matrix, (_CANVAS_PX, _CANVAS_PX), flags=flags, borderMode=cv2.BORDER_REFLECT
    )
    return np.asarray(out, np.float32)


def draw_vehicle(
    canvas: Canvas,
    model: VehicleModel,
    box: NDArray[np.float64],
    px_per_m: float,
    sun: Sun,
    strength: float,
) -> None:
    """Draw a vehicle and its shadow; ``box`` is ``(x, y, length, width, angle)`` in pixels of the canvas."""
    x, y, length, width, angle = box
    cos = math.cos(angle)
    sin = math.sin(angle)
    turn = np.array([[cos, -sin], [sin, cos]])
    outline = np.array(
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
    points = (outline * (length, width)) @ turn.T + (x, y)
    height = VEHICLE_SHADOW_HEIGHT_M.get(model.body.partition(":")[0], 1.15)
    shade(canvas, points, height_px=height * px_per_m, sun=sun, strength=strength)
    sprite = vehicle_sprite(
        model.body, model.length_m, width=model.width_m, px_per_m=px_per_m, light=sun.light(angle)
    )
    rows, columns = sprite.shape[:2]
    pad = 2 * VEHICLE_PAD * length
    scale = np.array([columns / (length + pad), rows / (width + pad)])
    matrix = scale[:, None] * turn.T
    offset = np.array([columns, rows]) / 2 - matrix @ (x, y)
    full = np.column_stack([matrix, offset + matrix @ (0.5, 0.5) - 0.5])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    patch = cv2.warpAffine(sprite, full, canvas.shape[1::-1], flags=flags, borderValue=(0, 0, 0, 0))
    cover, paint, grey, red = (patch[:, :, channel, None] for channel in range(4))
    glass = np.array((0.95, 1.0, 1.09), np.float32)
    lamp = np.array((1.0, 0.22, 0.2), np.float32)
    canvas[:] = (
        canvas * (1 - cover) + paint * np.array(model.paint, np.float32) + grey * glass + red * lamp
    )


def photographed(rng: np.random.Generator, canvas: Canvas, coarse: float) -> NDArray[np.uint8]:
    """The stored chip of a canvas: as coarse as its ground was (``coarse``, canvas pixels to one of the source)."""
    pixels: Canvas = np.clip(canvas, 0, 255)
    if coarse > 2.0:
        side = max(16, round(_CANVAS_PX / coarse))
        pixels = np.asarray(
            cv2.resize(pixels, (side, side), interpolation=cv2.INTER_AREA), np.float32
        )
        way = cv2.INTER_CUBIC if rng.random() < 0.5 else cv2.INTER_LINEAR
        pixels = np.asarray(
            cv2.resize(pixels, (STORED_PX, STORED_PX), interpolation=way), np.float32
        )
    else:
        soft = cv2.GaussianBlur(pixels, (0, 0), float(rng.uniform(0.5, 1.4)))
        pixels = np.asarray(
            cv2.resize(soft, (STORED_PX, STORED_PX), interpolation=cv2.INTER_AREA), np.float32
        )
    return np.asarray(np.clip(pixels + 0.5, 0, 255), np.uint8)


class Pasted(NamedTuple):
    """One chip and its row."""

    chip: NDArray[np.uint8]
    car: int
    type: int
    box: NDArray[np.float32] | None
    length_m: float
    length_px: float


def pasted(rng: np.random.Generator, ground: Ground, fleet: Fleet) -> Pasted | None:
    """A vehicle or a look-alike on real ground; None where there is no free place."""
    draw = rng.random()
    vehicle = draw < _CAR_SHARE
    lorry = _CAR_SHARE <= draw < _CAR_SHARE + _LORRY_SHARE
    place = free_place(rng, ground, 5.0)
    if place is None:
        return None
    sun = Sun(float(rng.uniform(0, 2 * np.pi)), math.radians(rng.uniform(25, 75)))
    strength = 0.0 if rng.random() < 0.2 else float(rng.uniform(0.5, 1.05))
    if vehicle or lorry:
        model = fleet.small() if vehicle else fleet.large()
        wrong = rng.random() < (_WRONG_SHARE if vehicle else 0.4)
        candidate, truth = _candidate(rng, model, wrong=wrong)
        px_per_m = 2 * STORED_LENGTH_PX / candidate[2]
        canvas = ground_canvas(
            ground, place, turn=float(rng.uniform(0, 2 * np.pi)), px_per_m=px_per_m
        )
        if rng.random() < _COMPANY_SHARE:
            _draw_company(
                rng, canvas, truth=truth, px_per_m=px_per_m, sun=sun, strength=strength, fleet=fleet
            )
        middle = np.array([_CANVAS_PX / 2, _CANVAS_PX / 2])
        box = np.array(
            [*(middle + truth[:2] * px_per_m), truth[2] * px_per_m, truth[3] * px_per_m, truth[4]]
        )
        draw_vehicle(canvas, model, box=box, px_per_m=px_per_m, sun=sun, strength=strength)
        fits = vehicle and not wrong
        kind = type_of(model.body, model.length_m) if not wrong else UNKNOWN
        answer = relative(candidate[None], truth[None])[0] if fits else None
        length_m = model.length_m if fits else math.nan
        car = int(fits)
    else:
        px_per_m = 2 * STORED_LENGTH_PX / 4.5
        canvas = ground_canvas(
            ground, place, turn=float(rng.uniform(0, 2 * np.pi)), px_per_m=px_per_m
        )
        thing = LOOKALIKES[int(rng.integers(len(LOOKALIKES)))]
        length, _ = thing(rng, canvas, px_per_m, sun)
        # the candidate is as long as the thing
        factor = 4.5 / length * float(np.exp(rng.normal(0, 0.12)))
        move = np.array([[factor, 0.0], [0.0, factor]])
        move = np.column_stack([move, (1 - factor) * np.array([_CANVAS_PX, _CANVAS_PX]) / 2])
        canvas = np.asarray(
            cv2.warpAffine(
                canvas,
                move,
                canvas.shape[1::-1],
                flags=cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_REFLECT,
            ),
            np.float32,
        )
        px_per_m *= factor
        car = 0
        kind = KINDS.index("other")
        answer = None
        length_m = math.nan
    coarse = px_per_m * ground.gsd_m_per_px
    chip = photographed(rng, canvas, coarse)
    return Pasted(
        chip,
        car,
        type=kind,
        box=answer,
        length_m=length_m,
        length_px=2 * STORED_LENGTH_PX / max(coarse, 2.0) if coarse > 2 else 36.0,
    )


def _candidate(
    rng: np.random.Generator, model: VehicleModel, *, wrong: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A candidate box in metres around the origin, its angle 0, and the true box beside it."""
    turn = rng.normal(0, 0.05)
    shift = rng.normal(0, 0.04 * model.length_m, 2)
    size = float(np.exp(rng.normal(0, 0.06)))
    if wrong:
        how = rng.integers(3)
        if how == 0 or model.kind == "large-vehicle":  # a part of it, or it and what stands beside
            size = float(
                np.exp(rng.uniform(-1.0, -0.5) if rng.random() < 0.7 else rng.uniform(0.5, 0.9))
            )
            shift = np.array(
                [rng.uniform(-0.5, 0.5) * max(0.0, 1 - size) * model.length_m, rng.normal(0, 0.2)]
            )
        elif how == 1:
            angle = rng.uniform(0, 2 * np.pi)
            shift = (
                rng.uniform(0.45, 1.0) * model.length_m * np.array([np.cos(angle), np.sin(angle)])
            )
        else:
            turn = rng.uniform(0.6, np.pi - 0.6)
    length = model.length_m * size
    candidate = np.array([0.0, 0.0, length, 0.45 * length, 0.0])
    front = np.pi if rng.random() < 0.5 else 0.0
    return candidate, np.array([*shift, model.length_m, model.width_m, turn + front])


def _draw_company(
    rng: np.random.Generator,
    canvas: Canvas,
    truth: NDArray[np.float64],
    px_per_m: float,
    sun: Sun,
    strength: float,
    fleet: Fleet,
) -> None:
    """Vehicles parked beside the one, or before and behind it."""
    beside = rng.random() < 0.7
    pitch = rng.uniform(*_PARKED_PITCH_M) if beside else truth[2] + rng.uniform(0.6, 2.0)
    way = (
        np.array([-math.sin(truth[4]), math.cos(truth[4])])
        if beside
        else np.array([math.cos(truth[4]), math.sin(truth[4])])
    )
    for k in (-3, -2, -1, 1, 2, 3):
        if rng.random() < 0.4:
            continue
        model = fleet.small()
        spare = (model.width_m + truth[3]) / 2 if beside else (model.length_m + truth[2]) / 2
        if abs(k) == 1 and pitch < spare + 0.2:
            continue
        middle = truth[:2] + k * pitch * way + rng.normal(0, 0.12, 2)
        angle = truth[4] + rng.normal(0, 0.03) + (np.pi if rng.random() < 0.5 else 0)
        at = _CANVAS_PX / 2 + middle * px_per_m
        if (np.abs(at - _CANVAS_PX / 2) > _CANVAS_PX).any():
            continue
        box = np.array([*at, model.length_m * px_per_m, model.width_m * px_per_m, angle])
        draw_vehicle(canvas, model, box=box, px_per_m=px_per_m, sun=sun, strength=strength)


def grounds(data: Path) -> list[Ground]:
    """Train images of known scale."""
    out: list[Ground] = []
    # nothing on its cars
    sharp = [s._replace(boxes=boxes_from_corners(s.ignore)) for s, *_ in chia_images(data)]
    samples: Sequence[TrainImage] = [
        *load_train_images(data / "vehicles"),
        *load_scenery(data),
        *sharp,
    ]
    for sample in samples:
        gsd = CAR_M / sample.car_px if sample.car_px else GSD_M_PER_PX.get(sample.set)
        if gsd:
            out.append(Ground(sample, gsd))
    return out


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--count", type=int, default=12_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument(
        "--without", default="", help="sets whose ground is left out, comma between"
    )
    options = parser.parse_args()
    cv2.setNumThreads(1)
    rng = np.random.default_rng(options.seed)
    places = [
        ground
        for ground in grounds(options.data)
        if ground.sample.set not in options.without.split(",")
    ]
    names = np.array([ground.sample.set for ground in places])
    odds = weight_of_sets(names)
    odds[[ground.gsd_m_per_px < _SHARP_M_PER_PX for ground in places]] *= _SHARP_WEIGHT
    made: list[Pasted] = []
    while len(made) < options.count:
        ground = places[int(rng.choice(len(places), p=odds / odds.sum()))]
        one = pasted(rng, ground, Fleet(4.58, rng, "mixed"))
        if one is not None:
            made.append(one)
            if len(made) % 1000 == 0:
                print(len(made), flush=True)
    store = ChipStore()
    nothing = np.full(5, np.nan, np.float32)
    rows = Rows.unlabelled(np.array([one.length_px for one in made]), "pasted", "pasted")._replace(
        car=np.array([one.car for one in made], np.int8),
        type=np.array([one.type for one in made], np.int8),
        box=np.stack([nothing if one.box is None else one.box for one in made]),
        log_length_m=np.log(np.array([one.length_m for one in made], np.float32)),
    )
    store.add(np.stack([one.chip for one in made]), rows)
    rows = store.save(options.run / "pasted")
    print(f"{(rows.car == 1).sum()} cars, {(rows.car == 0).sum()} others")


if __name__ == "__main__":
    main()
