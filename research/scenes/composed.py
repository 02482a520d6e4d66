"""Photographs that are not one view any more: with an inset, stretched, or with a pasted car."""

from __future__ import annotations

import math
import random
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

if TYPE_CHECKING:
    from typing import TypeAlias

    from numpy.typing import NDArray

    Rgb: TypeAlias = NDArray[np.uint8]
    """``[h, w, 3]`` pixels."""

_QUALITIES = (0, 75, 85, 92, 95)
_FRAMES_PX = (0, 0, 0, 1, 2, 3)
_COLOURS = ((255, 255, 255), (0, 0, 0), (255, 0, 0), (255, 255, 0))
_MARGINS_PX = (0, 0, 0, 10, 20)
_INSET_SHARES = (0.22, 0.5)
_STRETCHES = (1.25, 1.6)
_INTERPOLATIONS = (cv2.INTER_LINEAR, cv2.INTER_CUBIC, cv2.INTER_AREA)
# A pasted car: copies in a row, what is cut out around it in lengths, and its changes.
_COPIES = 3
_CUT_LENGTHS = 0.75
_GAINS = (0.75, 1.25)
_OFFSET_LEVELS = 20.0
_TURN_DEG = 12.0
_GROUND_LEVELS = 6.0


class WithInset(NamedTuple):
    """Photograph with a picture over a part of it.

    Attributes:
        image: the pixels.
        frame_px: width of the inset's frame.
        reduction: pixels of the inset over those of the picture that it shows.
    """

    image: Rgb
    frame_px: int
    reduction: float


class Stretched(NamedTuple):
    """Photograph that was resized in one direction.

    Attributes:
        image: the pixels.
        across: factor of the width.
        down: factor of the height.
    """

    image: Rgb
    across: float
    down: float


def with_inset(photograph: Rgb, picture: Rgb, rng: random.Random) -> WithInset:
    """Put a picture over a corner, an edge or the middle of a photograph."""
    height, width = photograph.shape[:2]
    share = rng.uniform(*_INSET_SHARES)
    rows = max(8, round(height * share * rng.uniform(0.85, 1.15)))
    columns = max(8, round(width * share * rng.uniform(0.85, 1.15)))
    reduction = max(rows / picture.shape[0], columns / picture.shape[1])
    size = (
        max(columns, math.ceil(picture.shape[1] * reduction)),
        max(rows, math.ceil(picture.shape[0] * reduction)),
    )
    interpolation = cv2.INTER_AREA if reduction < 1 else cv2.INTER_CUBIC
    inset = np.asarray(cv2.resize(picture, size, interpolation=interpolation))[:rows, :columns]
    frame_px = rng.choice(_FRAMES_PX)
    colour = rng.choice(_COLOURS)
    framed = np.empty((rows + 2 * frame_px, columns + 2 * frame_px, 3), np.uint8)
    framed[:] = colour
    framed[frame_px : frame_px + rows, frame_px : frame_px + columns] = inset
    top = _place(height, len(framed), rng)
    left = _place(width, framed.shape[1], rng)
    image = photograph.copy()
    image[top : top + len(framed), left : left + framed.shape[1]] = framed
    return WithInset(_compressed(image, rng.choice(_QUALITIES)), frame_px, reduction)


def stretched(photograph: Rgb, rng: random.Random) -> Stretched:
    """Enlarge or reduce a photograph in one direction by 1.25 to 1.6."""
    log_factor = rng.uniform(math.log(_STRETCHES[0]), math.log(_STRETCHES[1]))
    factor = math.exp(rng.choice((-1, 1)) * log_factor)
    is_across = rng.random() < 0.5
    height, width = photograph.shape[:2]
    columns = round(width * factor) if is_across else width
    rows = height if is_across else round(height * factor)
    interpolation = rng.choice(_INTERPOLATIONS)
    resized = cv2.resize(photograph, (columns, rows), interpolation=interpolation)
    image = _compressed(np.asarray(resized, np.uint8), rng.choice(_QUALITIES))
    return Stretched(image, columns / width, rows / height)


def pasted(photograph: Rgb, box: NDArray[np.float64], rng: random.Random) -> Rgb | None:
    """Paste a car nine times on plain ground, with other brightness, contrast and direction.

    Args:
        photograph: the photograph.
        box: ``[5]`` row ``(x, y, length, width, angle)`` of the car.
        rng: chooses the changes.

    Returns:
        The image; None for a car beside the border.
    """
    half = math.ceil(_CUT_LENGTHS * box[2]) + 2
    x = round(box[0])
    y = round(box[1])
    side = 2 * half + 1
    if min(x, y) < half or x + half >= photograph.shape[1] or y + half >= photograph.shape[0]:
        return None
    car = photograph[y - half : y + half + 1, x - half : x + half + 1]
    step = side + 20
    noise = np.random.default_rng(rng.randrange(2**32))
    ground = np.median(car.reshape(-1, 3), axis=0)
    grain = noise.normal(0, _GROUND_LEVELS, (_COPIES * step + 40, _COPIES * step + 40, 3))
    image = np.asarray(np.clip(ground + grain, 0, 255), np.uint8)
    for row in range(_COPIES):
        for column in range(_COPIES):
            turn = cv2.getRotationMatrix2D((half, half), rng.uniform(-_TURN_DEG, _TURN_DEG), 1.0)
            turned = cv2.warpAffine(
                car, turn, (side, side), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
            )
            offset = rng.uniform(-_OFFSET_LEVELS, _OFFSET_LEVELS)
            changed = np.clip(turned * rng.uniform(*_GAINS) + offset, 0, 255)
            top = 20 + row * step + rng.randint(-3, 3)
            left = 20 + column * step + rng.randint(-3, 3)
            image[top : top + side, left : left + side] = changed
    return image


def _place(side: int, inset_side: int, rng: random.Random) -> int:
    """Choose the first row or column of an inset: at either border of a side, or in the middle."""
    room = max(0, side - inset_side)
    margin = rng.choice(_MARGINS_PX)
    return min(room, max(0, rng.choice((margin, room - margin, room // 2 + rng.randint(-20, 20)))))


def _compressed(image: Rgb, quality: int) -> Rgb:
    """Compress an image as JPEG; 0 leaves it as it is."""
    if not quality:
        return image
    _, data = cv2.imencode(".jpg", image[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)[:, :, ::-1].copy()
