"""Pictures that are no photographs: pages, charts, slides, maps, windows and drawings.

Each function of ``PAGES`` draws one kind from a random generator and a choice of fonts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from research.scenes.lettering import (
    Colour,
    Pen,
    Picture,
    compressed,
    photographed,
    words,
    write,
)

Fonts: TypeAlias = Sequence[Path | int]
"""Files of fonts, or numbers of Hershey fonts."""

PageDrawing: TypeAlias = Callable[[Generator, Fonts], Picture]

Values: TypeAlias = NDArray[np.float64]
"""``[n]`` values of a chart, 0..1 of its height."""

Area: TypeAlias = tuple[int, int, int, int]
"""Left, top, right and bottom, pixels."""

_WHITE = (255, 255, 255)


def choose_font(rng: Generator, fonts: Fonts) -> Path | int:
    """Choose a font."""
    return fonts[int(rng.integers(len(fonts)))]


def _sheet(rng: Generator, colour: Colour) -> Picture:
    """Make an empty sheet of one colour."""
    width = int(rng.integers(480, 1281))
    height = int(rng.integers(420, 1025))
    return np.full((height, width, 3), colour, np.uint8)


def _colour(rng: Generator, low: int = 0, high: int = 255) -> Colour:
    red, green, blue = rng.integers(low, high + 1, size=3).tolist()
    return red, green, blue


def _paper_and_ink(rng: Generator) -> tuple[Colour, Colour]:
    """Choose the colours of paper and ink: usually black on white, at times inverted."""
    kind = rng.random()
    if kind < 0.5:
        return _WHITE, (0, 0, 0)
    if kind < 0.75:
        return _colour(rng, 215), _colour(rng, 0, 90)
    return _colour(rng, 0, 60), _colour(rng, 180)


def _page_and_ink(rng: Generator) -> tuple[Picture, Colour]:
    """Make an empty page, and choose the colour of its ink."""
    paper, ink = _paper_and_ink(rng)
    return _sheet(rng, paper), ink


def draw_number(rng: Generator, low: int, stop: int) -> int:
    """Draw a whole number from ``low`` to below ``stop``."""
    return int(rng.integers(low, stop))


def draw_rectangle(
    page: Picture,
    start: tuple[float, float],
    end: tuple[float, float],
    colour: Colour,
    line_px: int = cv2.FILLED,
) -> None:
    """Draw a rectangle between two corners, filled unless it has a line."""
    first = (round(start[0]), round(start[1]))
    last = (round(end[0]), round(end[1]))
    cv2.rectangle(page, first, last, colour, line_px)


def draw_size(rng: Generator, low: float = 10, high: float = 60) -> float:
    """Draw a size of letters, each octave alike."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _grey(rng: Generator) -> Colour:
    level = int(rng.integers(60, 220))
    return level, level, level


def _paragraph(
    picture: Picture, rng: Generator, pen: Pen, box: tuple[float, float, float, float]
) -> None:
    """Fill a box (left, top, right, bottom) with lines of text."""
    left, top, right, bottom = box
    spacing = pen.size_px * rng.uniform(1.15, 1.6)
    word_px = 3.2 * pen.size_px
    per_line = max(1, round((right - left) / word_px))
    y = top
    while y + pen.size_px < bottom:
        count = per_line if rng.random() < 0.85 else max(1, per_line // 2)
        write(picture, words(rng, count), (left, y), pen)
        y += spacing


def text_page(rng: Generator, fonts: Fonts) -> Picture:
    """Draw a page of text with a heading, in one or two columns."""
    page, ink = _page_and_ink(rng)
    height, width = page.shape[:2]
    pen = Pen(choose_font(rng, fonts), draw_size(rng), ink)
    heading_font = choose_font(rng, fonts)
    heading = pen._replace(font=heading_font, size_px=min(70, 1.6 * pen.size_px))
    margin = rng.uniform(0.03, 0.1) * width
    write(page, words(rng, 3), (margin, margin / 2), heading)
    top = margin / 2 + 2 * heading.size_px
    n_columns = draw_number(rng, 1, 3)
    column = (width - 2 * margin) / n_columns
    for k in range(n_columns):
        left = margin + k * column
        box = (left, top, left + 0.95 * column, height - margin / 2)
        _paragraph(page, rng, pen, box)
    return compressed(page, rng)


def chart(rng: Generator, fonts: Fonts) -> Picture:
    """Draw a bar or line chart with title, axes, ticks and legend."""
    page, ink = _page_and_ink(rng)
    height, width = page.shape[:2]
    font = choose_font(rng, fonts)
    pen = Pen(font, draw_size(rng, 10, 30), ink)
    title = pen._replace(size_px=draw_size(rng, 16, 48))
    n_words = draw_number(rng, 2, 6)
    write(page, words(rng, n_words), (0.15 * width, 0.02 * height), title)
    left = int(0.12 * width)
    right = int(0.95 * width)
    top = int(0.15 * height)
    bottom = int(0.85 * height)
    draw_rectangle(page, (left, top), (right, bottom), ink, draw_number(rng, 1, 3))
    n_ticks = draw_number(rng, 4, 9)
    for share in np.linspace(0, 1, n_ticks):
        y = round(bottom + share * (top - bottom))
        cv2.line(page, (left - 6, y), (right, y), _grey(rng), 1)
        write(page, f"{100 * share:.0f}", (0.03 * width, y - pen.size_px / 2), pen)
    n_values = draw_number(rng, 3, 12)
    area = (left, top, right, bottom)
    values = rng.uniform(0.1, 0.95, size=n_values)
    if rng.random() < 0.6:
        _draw_bars(page, rng, values, area)
    else:
        for _ in range(draw_number(rng, 1, 4)):
            values = rng.uniform(0.1, 0.95, size=n_values)
            _draw_line(page, rng, values, area)
    step = (right - left) / n_values
    for k in range(n_values):
        x = left + (k + 0.2) * step
        write(page, words(rng, 1), (x, bottom + 6), pen)
    write(page, words(rng, 2), (0.015 * width, height / 2), pen, turn=90)
    write(page, words(rng, 2), (width / 2, bottom + 2.2 * pen.size_px), pen)
    return compressed(page, rng)


def _draw_bars(page: Picture, rng: Generator, values: Values, area: Area) -> None:
    """Draw values in 0..1 as bars of one colour or of many."""
    left, top, right, bottom = area
    step = (right - left) / len(values)
    one_colour = None
    if rng.random() < 0.6:
        one_colour = _colour(rng)
    for k, value in enumerate(values):
        colour = one_colour or _colour(rng)
        x = left + k * step
        y = bottom + value * (top - bottom)
        draw_rectangle(page, (x + 0.15 * step, y), (x + 0.85 * step, bottom), colour)


def _draw_line(page: Picture, rng: Generator, values: Values, area: Area) -> None:
    """Draw values in 0..1 as a line with discs at its points."""
    left, top, right, bottom = area
    n_values = len(values)
    step = (right - left) / n_values
    xs = left + (np.arange(n_values) + 0.5) * step
    ys = bottom + values * (top - bottom)
    points = np.column_stack([xs, ys])
    colour = _colour(rng)
    cv2.polylines(page, [points.astype(np.int32)], False, colour, 2, cv2.LINE_AA)
    for x, y in points:
        cv2.circle(page, (round(x), round(y)), 5, colour, -1, cv2.LINE_AA)


def slide(rng: Generator, fonts: Fonts) -> Picture:
    """Draw a slide: a coloured or shaded ground, a title, boxes and lines with bullets."""
    page = _sheet(rng, _colour(rng))
    height, width = page.shape[:2]
    if rng.random() < 0.5:
        ends = np.array([_colour(rng), _colour(rng)], np.float64)
        share = np.linspace(0, 1, height)[:, None, None]
        shaded = ends[0] + share * (ends[1] - ends[0])
        page[:] = np.rint(np.broadcast_to(shaded, page.shape)).astype(np.uint8)
    is_dark = page.mean() < 128
    ink = _colour(rng, 200) if is_dark else _colour(rng, 0, 60)
    title = Pen(choose_font(rng, fonts), draw_size(rng, 30, 70), ink)
    write(page, words(rng, 3), (0.06 * width, 0.05 * height), title)
    for _ in range(draw_number(rng, 0, 3)):
        x = rng.uniform(0.05, 0.6) * width
        y = rng.uniform(0.25, 0.6) * height
        right = x + rng.uniform(0.15, 0.35) * width
        draw_rectangle(page, (x, y), (right, y + 0.25 * height), _colour(rng))
    pen = title._replace(size_px=draw_size(rng, 16, 44))
    y = 0.25 * height
    while y < 0.9 * height:
        radius = max(2, round(pen.size_px / 6))
        dot = (round(0.08 * width), round(y + pen.size_px / 2))
        cv2.circle(page, dot, radius, ink, -1, cv2.LINE_AA)
        n_words = draw_number(rng, 2, 7)
        write(page, words(rng, n_words), (0.11 * width, y), pen)
        y += 1.8 * pen.size_px
    return compressed(page, rng)


def street_map(rng: Generator, fonts: Fonts) -> Picture:
    """Draw a street map with areas of flat colours, roads, and labels along them."""
    page = _sheet(rng, _colour(rng, 215))
    height, width = page.shape[:2]
    for _ in range(draw_number(rng, 4, 12)):
        centre = rng.uniform(0, 1, 2) * (width, height)
        n_corners = draw_number(rng, 3, 7)
        corners = centre + rng.normal(0, 0.12 * width, size=(n_corners, 2))
        hull = cv2.convexHull(corners.astype(np.int32))
        cv2.fillPoly(page, [hull], _colour(rng, 150), cv2.LINE_AA)
    pen = Pen(
        choose_font(rng, fonts),
        draw_size(rng, 10, 30),
        _colour(rng, 0, 110),
        edge=_WHITE,
        edge_px=1,
    )
    for _ in range(draw_number(rng, 5, 14)):
        ends = rng.uniform(0, 1, (2, 2)) * (width, height)
        first, last = ends.astype(int).tolist()
        road_px = draw_number(rng, 3, 24)
        cv2.line(page, first, last, _grey(rng), road_px + 2, cv2.LINE_AA)
        cv2.line(page, first, last, _colour(rng, 190), road_px, cv2.LINE_AA)
        middle = ends.mean(axis=0)
        along = ends[1] - ends[0]
        turn = -float(np.degrees(np.arctan2(along[1], along[0])))
        write(page, words(rng, 2), (middle[0], middle[1]), pen, turn=turn)
    for _ in range(draw_number(rng, 4, 15)):
        x, y = rng.uniform(0, 0.9, 2) * (width, height)
        draw_icon(page, rng, (x, y), draw_size(rng, 8, 36))
        write(page, words(rng, 1), (x + 14, y), pen)
    return compressed(page, rng)


def window(rng: Generator, fonts: Fonts) -> Picture:
    """Draw a program: title bar, menu, a bar of icons, a list, buttons and a table."""
    page, ink = _page_and_ink(rng)
    height, width = page.shape[:2]
    pen = Pen(choose_font(rng, fonts), draw_size(rng, 11, 26), ink)
    bar = round(2.0 * pen.size_px)
    draw_rectangle(page, (0, 0), (width, bar), _colour(rng))
    write(page, words(rng, 3), (bar, 0.3 * pen.size_px), pen)
    write(page, words(rng, 7), (8, 1.2 * bar), pen)
    side = draw_size(rng, 14, 44)
    for k in range(int(width / (1.6 * side))):
        draw_icon(page, rng, (6 + 1.6 * side * k, 2.2 * bar), side)
    top = 2.4 * bar + 1.3 * side
    list_width = 0.28 * width
    draw_rectangle(page, (0, top), (list_width, height), _grey(rng), 1)
    y = top + 4
    while y < height - pen.size_px:
        draw_icon(page, rng, (6, y), pen.size_px)
        write(page, words(rng, 2), (10 + 1.4 * pen.size_px, y), pen)
        y += 1.7 * pen.size_px
    n_columns = draw_number(rng, 2, 6)
    cell = (width - list_width - 20) / n_columns
    y = top + 4
    while y < height - 4 * pen.size_px:
        for k in range(n_columns):
            x = list_width + 12 + k * cell
            end = (x + cell, y + 1.7 * pen.size_px)
            draw_rectangle(page, (x, y), end, _grey(rng), 1)
            write(page, words(rng, 1), (x + 4, y + 3), pen)
        y += 1.7 * pen.size_px
    for k in range(3):
        x = width - (k + 1) * 7.5 * pen.size_px
        y = height - 2.4 * pen.size_px
        end = (x + 6.5 * pen.size_px, y + 2 * pen.size_px)
        draw_rectangle(page, (x, y), end, _colour(rng))
        write(page, words(rng, 1), (x + 5, y + 4), pen)
    return compressed(page, rng)


def plan(rng: Generator, fonts: Fonts) -> Picture:
    """Draw a plan: rooms, dimension lines, symbols and labels, in thin lines."""
    page, ink = _page_and_ink(rng)
    height, width = page.shape[:2]
    pen = Pen(choose_font(rng, fonts), draw_size(rng, 10, 32), ink)
    for _ in range(draw_number(rng, 5, 14)):
        x, y = rng.uniform(0.02, 0.7, 2) * (width, height)
        right = x + rng.uniform(0.08, 0.3) * width
        bottom = y + rng.uniform(0.08, 0.3) * height
        draw_rectangle(page, (x, y), (right, bottom), ink, draw_number(rng, 1, 5))
        write(page, words(rng, 1), (x + 6, y + 6), pen)
        write(page, f"{rng.uniform(1, 9):.2f} m", (x, round(bottom) + 3), pen)
    for _ in range(draw_number(rng, 3, 12)):
        x, y = rng.uniform(0.02, 0.9, 2) * (width, height)
        draw_icon(page, rng, (x, y), draw_size(rng, 10, 50), ink)
    return compressed(page, rng)


def icons(rng: Generator, fonts: Fonts) -> Picture:
    """Draw a sheet of icons, with or without their names."""
    page, ink = _page_and_ink(rng)
    height, width = page.shape[:2]
    side = draw_size(rng, 12, 60)
    pen = Pen(choose_font(rng, fonts), max(9.0, side / 3), ink)
    step = side * rng.uniform(1.5, 3)
    is_named = rng.random() < 0.5
    is_coloured = rng.random() < 0.6
    for y in np.arange(step / 2, height - step, step):
        for x in np.arange(step / 2, width - step, step):
            colour = _colour(rng) if is_coloured else ink
            draw_icon(page, rng, (x, y), side, colour)
            if is_named:
                write(page, words(rng, 1), (x, y + 1.05 * side), pen)
    return compressed(page, rng)


def board(rng: Generator, fonts: Fonts) -> Picture:
    """Draw a board of squares: a game, a crossword, a calendar, or a table with filled cells."""
    page, ink = _page_and_ink(rng)
    height, width = page.shape[:2]
    side = draw_size(rng, 16, 80)
    pen = Pen(choose_font(rng, fonts), max(9.0, 0.5 * side), ink)
    colours = _colour(rng), _colour(rng)
    is_chequered = rng.random() < 0.4
    filled_share = rng.uniform(0, 0.4)
    has_discs = rng.random() < 0.3
    for row in range(int((height - side) / side)):
        for column in range(int((width - side) / side)):
            x = (column + 0.5) * side
            y = (row + 0.5) * side
            start = (x, y)
            end = (x + side, y + side)
            if is_chequered:
                draw_rectangle(page, start, end, colours[(row + column) % 2])
            elif rng.random() < filled_share:
                draw_rectangle(page, start, end, colours[0])
            draw_rectangle(page, start, end, ink, 1)
            if rng.random() > 0.6:
                continue
            if has_discs:
                centre = (round(x + side / 2), round(y + side / 2))
                cv2.circle(page, centre, round(0.4 * side), _colour(rng), -1, cv2.LINE_AA)
            else:
                write(page, words(rng, 1)[:2], (x + 0.2 * side, y + 0.2 * side), pen)
    return compressed(page, rng)


def schedule(rng: Generator, fonts: Fonts) -> Picture:
    """Draw a schedule: bars of one or many colours beside the names of their rows."""
    page, ink = _page_and_ink(rng)
    height, width = page.shape[:2]
    pen = Pen(choose_font(rng, fonts), draw_size(rng, 10, 28), ink)
    step = pen.size_px * rng.uniform(1.4, 3)
    left = 0.25 * width
    colour = _colour(rng)
    is_coloured = rng.random() < 0.5
    for y in np.arange(step, height - step, step):
        write(page, words(rng, 2), (0.02 * width, y), pen)
        for _ in range(draw_number(rng, 1, 4)):
            x = rng.uniform(left, 0.9 * width)
            right = min(x + rng.uniform(0.02, 0.2) * width, width - 2)
            filling = _colour(rng) if is_coloured else colour
            draw_rectangle(page, (x, y), (right, y + 0.7 * step), filling)
    draw_rectangle(page, (left, 4), (width - 4, height - 4), ink, 1)
    return compressed(page, rng)


def keyboard(rng: Generator, fonts: Fonts) -> Picture:
    """Draw rows of keys with letters, and some lines of text below."""
    page, ink = _page_and_ink(rng)
    width = page.shape[1]
    side = min(draw_size(rng, 18, 70), width / 15)
    key = _colour(rng, 20, 240)
    legend = _WHITE if sum(key) < 380 else (0, 0, 0)
    pen = Pen(choose_font(rng, fonts), 0.45 * side, legend)
    for row in range(5):
        for column in range(12):
            x = (0.4 * row + 1.12 * column + 0.5) * side
            y = (1.12 * row + 0.5) * side
            draw_rectangle(page, (x, y), (x + side, y + side), key)
            letter = words(rng, 1)[:1].upper()
            write(page, letter, (x + 0.3 * side, y + 0.25 * side), pen)
    text = pen._replace(ink=ink)
    for number in range(4):
        write(page, words(rng, 6), (0.5 * side, (6.5 + 0.8 * number) * side), text)
    return compressed(page, rng)


def photographed_page(rng: Generator, fonts: Fonts) -> Picture:
    """Draw a page, a chart, a plan, a board or a schedule, and photograph it."""
    drawings = (text_page, chart, plan, board, schedule)
    drawing = drawings[int(rng.integers(len(drawings)))]
    return photographed(drawing(rng, fonts), rng)


def draw_icon(
    picture: Picture,
    rng: Generator,
    at: tuple[float, float],
    side_px: float,
    colour: Colour | None = None,
) -> None:
    """Draw an icon: a disc, a box with bars, an arrow, a cross, a pin, or a cursor."""
    colour = colour or _colour(rng)
    unit = _SHAPES[int(rng.integers(len(_SHAPES)))]
    thickness = max(1, round(side_px / 10))
    corner = np.array(at)
    if isinstance(unit, str):
        centre = np.rint(corner + side_px / 2).astype(int).tolist()
        filled = -1 if unit == "disc" else thickness
        cv2.circle(picture, centre, max(1, round(side_px / 2)), colour, filled, cv2.LINE_AA)
        return
    points = np.rint(corner + unit * side_px).astype(np.int32)
    if rng.random() < 0.6:
        cv2.fillPoly(picture, [points], colour, cv2.LINE_AA)
    else:
        cv2.polylines(picture, [points], True, colour, thickness, cv2.LINE_AA)
    if rng.random() < 0.4:
        for share in (0.35, 0.65):
            y = round(at[1] + share * side_px)
            left = round(at[0] + 0.2 * side_px)
            right = round(at[0] + 0.8 * side_px)
            cv2.line(picture, (left, y), (right, y), _WHITE, thickness, cv2.LINE_AA)


def _unit(*points: tuple[float, float]) -> NDArray[np.float64]:
    return np.array(points, np.float64)


_SHAPES: tuple[NDArray[np.float64] | str, ...] = (
    "disc",
    "ring",
    _unit((0, 0), (1, 0), (1, 1), (0, 1)),
    _unit((0, 0.25), (1, 0.25), (1, 0.75), (0, 0.75)),
    _unit((0, 0), (0, 0.9), (0.25, 0.7), (0.4, 1), (0.52, 0.94), (0.38, 0.65), (0.68, 0.65)),
    _unit((0.5, 0), (1, 0.5), (0.7, 0.5), (0.7, 1), (0.3, 1), (0.3, 0.5), (0, 0.5)),
    _unit((0.5, 1), (0.15, 0.45), (0.2, 0.15), (0.5, 0), (0.8, 0.15), (0.85, 0.45)),
    _unit((0.5, 0), (0.62, 0.38), (1, 0.38), (0.7, 0.6), (0.8, 1), (0.5, 0.76), (0.2, 1), (0, 0.4)),
    _unit((0, 0.2), (0.4, 0.2), (0.5, 0.35), (1, 0.35), (1, 0.9), (0, 0.9)),
    _unit((0, 0), (1, 0.5), (0, 1)),
)

PAGES: dict[str, PageDrawing] = {
    "page": text_page,
    "chart": chart,
    "slide": slide,
    "map": street_map,
    "window": window,
    "plan": plan,
    "icons": icons,
    "board": board,
    "schedule": schedule,
    "keyboard": keyboard,
    "photographed": photographed_page,
}
