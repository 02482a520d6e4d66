"""Lettering over and below photographs: captions, labels, on-screen displays, marks.

Each function of ``CAPTIONS`` draws one kind over a picture, which it does not change.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import cv2
import numpy as np
from numpy.random import Generator

from research.scenes.lettering import Colour, Pen, Picture, words, write
from research.scenes.pages import (
    Fonts,
    choose_font,
    draw_icon,
    draw_number,
    draw_rectangle,
    draw_size,
)

Captioned: TypeAlias = Callable[[Picture, Generator, Fonts], Picture]

_BLACK = (0, 0, 0)
_WHITE = (255, 255, 255)
_SIGNAL: tuple[Colour, ...] = (
    _WHITE, (255, 255, 0), (0, 255, 0), (255, 0, 0), (0, 255, 255), (255, 160, 0), _BLACK,
)  # fmt: skip


def _signal_pen(rng: Generator, fonts: Fonts, low: float = 10, high: float = 48) -> Pen:
    """Choose a pen that is read over a photograph, often with an outline."""
    ink = _SIGNAL[int(rng.integers(len(_SIGNAL)))]
    pen = Pen(choose_font(rng, fonts), draw_size(rng, low, high), ink)
    if rng.random() < 0.6:
        edge = _WHITE if sum(ink) < 200 else _BLACK
        pen = pen._replace(edge=edge, edge_px=draw_number(rng, 1, 4))
    return pen


def caption(photograph: Picture, rng: Generator, fonts: Fonts) -> Picture:
    """Add a line of caption on a strip below the photograph."""
    pen = Pen(choose_font(rng, fonts), draw_size(rng, 14, 40), _BLACK)
    paper = _WHITE
    if rng.random() < 0.3:
        pen = pen._replace(ink=_WHITE)
        paper = _BLACK
    strip_px = round(pen.size_px * rng.uniform(1.4, 2.5))
    strip = np.full((strip_px, photograph.shape[1], 3), paper, np.uint8)
    x = rng.uniform(0.01, 0.2) * photograph.shape[1]
    n_words = draw_number(rng, 2, 8)
    write(strip, words(rng, n_words), (x, 0.2 * pen.size_px), pen)
    return np.concatenate([photograph, strip])


def labels(photograph: Picture, rng: Generator, fonts: Fonts) -> Picture:
    """Write some labels over the photograph, at times turned or on a plate."""
    picture = photograph.copy()
    height, width = picture.shape[:2]
    pen = _signal_pen(rng, fonts)
    has_plate = rng.random() < 0.25
    for _ in range(draw_number(rng, 2, 7)):
        x, y = rng.uniform(0.05, 0.8, 2) * (width, height)
        line = words(rng, draw_number(rng, 1, 3))
        if has_plate:
            start = (round(x) - 3, round(y) - 3)
            end = (x + 0.6 * pen.size_px * len(line), y + 1.3 * pen.size_px)
            plate = _BLACK if sum(pen.ink) > 380 else _WHITE
            draw_rectangle(picture, start, end, plate)
        turn = float(rng.uniform(-90, 90)) if rng.random() < 0.3 else 0.0
        write(picture, line, (x, y), pen, turn=turn)
    return picture


def display(photograph: Picture, rng: Generator, fonts: Fonts) -> Picture:
    """Draw the on-screen display of a drone: numbers at the borders, cross, frame, battery."""
    picture = photograph.copy()
    height, width = picture.shape[:2]
    pen = _signal_pen(rng, fonts, 12, 32)
    lines = (
        f"H {rng.uniform(5, 120):.1f}m",
        f"D {rng.uniform(5, 900):.0f} m",
        f"{rng.uniform(0, 15):.1f}m/s",
        f"GPS {rng.integers(6, 24)}",
        f"{rng.uniform(10, 17):.1f}V {rng.integers(20, 100)}%",
        f"{rng.uniform(-60, 60):.6f} {rng.uniform(-180, 180):.6f}",
        f"REC 00:{rng.integers(10, 59)}:{rng.integers(10, 59)}",
        f"ISO{rng.integers(1, 32) * 100} 1/{rng.integers(1, 80) * 25} F2.8",
    )
    step = 1.5 * pen.size_px
    for k, line in enumerate(lines):
        x = 0.02 * width if k % 2 else 0.72 * width
        y = 0.03 * height + step * (k // 2)
        if k >= 4:
            y = height - 0.03 * height - step * (k // 2 - 1)
        write(picture, line, (x, y), pen)
    middle = (width // 2, height // 2)
    arm = round(rng.uniform(8, 30))
    for x, y in ((arm, 0), (0, arm)):
        first = (middle[0] - x, middle[1] - y)
        last = (middle[0] + x, middle[1] + y)
        cv2.line(picture, first, last, pen.ink, 2, cv2.LINE_AA)
    draw_icon(picture, rng, (0.5 * width, 0.03 * height), 1.5 * pen.size_px, pen.ink)
    return picture


def watermark(photograph: Picture, rng: Generator, fonts: Fonts) -> Picture:
    """Draw a half transparent mark once, or in rows over the whole photograph."""
    picture = photograph.copy()
    height, width = picture.shape[:2]
    pen = Pen(choose_font(rng, fonts), draw_size(rng, 14, 60), _WHITE)
    pen = pen._replace(opacity=float(rng.uniform(0.3, 0.9)))
    line = words(rng, draw_number(rng, 1, 3))
    if rng.random() < 0.5:
        write(picture, line, (0.6 * width, 0.9 * height), pen)
        return picture
    turn = float(rng.uniform(15, 45))
    for y in np.arange(0.15, 1, 0.35) * height:
        for x in np.arange(0.15, 1, 0.35) * width:
            write(picture, line, (x, y), pen, turn=turn)
    return picture


def markers(photograph: Picture, rng: Generator, fonts: Fonts) -> Picture:
    """Draw icons, pins and a cursor over the photograph, with a scale bar and its number."""
    picture = photograph.copy()
    height, width = picture.shape[:2]
    pen = _signal_pen(rng, fonts, 12, 32)
    for _ in range(draw_number(rng, 3, 10)):
        x, y = rng.uniform(0.03, 0.9, 2) * (width, height)
        draw_icon(picture, rng, (x, y), draw_size(rng, 10, 48))
    x = 0.05 * width
    y = 0.92 * height
    end = (x + rng.uniform(0.1, 0.3) * width, round(y) + 6)
    draw_rectangle(picture, (x, y), end, pen.ink)
    write(picture, f"{rng.integers(1, 40) * 5} m", (x, y - 1.3 * pen.size_px), pen)
    return picture


def boxes(photograph: Picture, rng: Generator, fonts: Fonts) -> Picture:
    """Draw boxes with scores, as programs show what they detect."""
    picture = photograph.copy()
    height, width = picture.shape[:2]
    pen = _signal_pen(rng, fonts, 9, 20)
    for _ in range(draw_number(rng, 3, 25)):
        x, y = rng.uniform(0, 1, 2) * (width, height)
        size = (draw_size(rng, 15, 60), draw_size(rng, 15, 60))
        turn = float(rng.uniform(0, 180)) if rng.random() < 0.5 else 0.0
        corners = cv2.boxPoints(((x, y), size, turn))
        outline = np.rint(corners).astype(np.int32)
        cv2.polylines(picture, [outline], True, pen.ink, draw_number(rng, 1, 4))
        if rng.random() < 0.6:
            above = (x, y - size[1] / 2 - pen.size_px)
            write(picture, f"car {rng.random():.2f}", above, pen)
    return picture


def program(photograph: Picture, rng: Generator, fonts: Fonts) -> Picture:
    """Show the photograph in a program, with a panel of layers on the right and a bar below."""
    height, width = photograph.shape[:2]
    is_dark = rng.random() < 0.5
    ground = int(rng.integers(30, 50) if is_dark else rng.integers(214, 256))
    ink = (225, 225, 225) if is_dark else (20, 20, 20)
    pen = Pen(choose_font(rng, fonts), draw_size(rng, 11, 20), ink)
    panel_px = draw_number(rng, 160, 320)
    bar_px = round(2.2 * pen.size_px)
    picture = np.full((height + bar_px, width + panel_px, 3), ground, np.uint8)
    picture[:height, :width] = photograph
    for y in np.arange(6, height - pen.size_px, 1.8 * pen.size_px):
        draw_icon(picture, rng, (width + 8, y), pen.size_px)
        write(picture, words(rng, 2), (width + 14 + pen.size_px, y), pen)
    coordinate = f"{rng.uniform(0, 9e5):.1f}, {rng.uniform(0, 9e5):.1f}"
    line = f"Coordinate {coordinate}   Scale 1:{rng.integers(200, 5000)}"
    write(picture, line, (8, height + 0.5 * pen.size_px), pen)
    return picture


CAPTIONS: dict[str, Captioned] = {
    "caption": caption,
    "labels": labels,
    "display": display,
    "watermark": watermark,
    "markers": markers,
    "boxes": boxes,
    "program": program,
}
