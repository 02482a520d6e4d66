"""How a chip of a sheet shows a part of an image: turned, enlarged, perhaps flipped."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray


class View(NamedTuple):
    """Similarity from an image to a chip.

    Attributes:
        x: point of the image, in pixels, that lies at ``u`` and ``v`` of the chip.
        y: see ``x``.
        angle: direction of the image, in radians, that the chip shows to the right.
        zoom: chip pixels per image pixel.
        flip: 1, or -1 for a chip that shows the image as in a mirror, left for right.
        u: see ``x``.
        v: see ``x``.
    """

    x: float
    y: float
    angle: float
    zoom: float
    flip: int
    u: float
    v: float

    def _linear(self) -> NDArray[np.float64]:
        cos, sin = math.cos(self.angle), math.sin(self.angle)
        return self.zoom * np.array([[self.flip * cos, self.flip * sin], [-sin, cos]])

    def to_chip(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Map ``[n, 2]`` points of the image to the chip."""
        return (points - [self.x, self.y]) @ self._linear().T + [self.u, self.v]

    def to_image(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Map ``[n, 2]`` points of the chip to the image."""
        return (points - [self.u, self.v]) @ np.linalg.inv(self._linear()).T + [self.x, self.y]

    def draw(self, image: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
        """Draw the chip; what lies outside of the image is grey."""
        half = math.hypot(width, height) / self.zoom
        left, top = max(0, int(self.x - half)), max(0, int(self.y - half))
        part: NDArray[Any] = image[top : int(self.y + half) + 1, left : int(self.x + half) + 1]
        if self.zoom < 1:
            part = cv2.GaussianBlur(part, (0, 0), 0.4 / self.zoom)
        matrix = np.column_stack([self._linear(), self.to_chip(np.array([[left, top]], np.float64))[0]])
        grey = (128, 128, 128)
        drawn = cv2.warpAffine(part, matrix, (width, height), flags=cv2.INTER_CUBIC, borderValue=grey)
        return np.asarray(drawn, np.uint8)


class Chip(NamedTuple):
    """One chip of a sheet: what it shows, and how."""

    sheet: str
    number: int
    file: str
    place: str
    box: tuple[float, ...]  # x, y, length, width, angle
    score: float
    view: View

    def row(self) -> list[object]:
        """Row of the sheet's table."""
        return [self.sheet, self.number, self.file, self.place, *self.box, self.score, *self.view]

    @classmethod
    def of_row(cls, row: list[str]) -> Chip:
        """Read a row of the sheet's table."""
        numbers = [float(cell) for cell in row[4:]]
        x, y, angle, zoom, flip, u, v = numbers[6:]
        view = View(x, y, angle, zoom, int(flip), u, v)
        return cls(row[0], int(row[1]), row[2], row[3], tuple(numbers[:5]), numbers[5], view)


class Layout(NamedTuple):
    """Arrangement of the chips of a sheet, in pixels."""

    columns: int
    rows: int
    width: int
    height: int
    margin: int
    rulers: bool


KINDS = Layout(6, 4, 200, 200, 4, rulers=False)
ENDS = Layout(2, 3, 500, 300, 30, rulers=True)


def draw_sheet(chips: list[Chip], layout: Layout, data: Path) -> NDArray[np.uint8]:
    """Draw numbered chips, with rulers along their borders or with a tick at their centres."""
    step_x, step_y = layout.width + 2 * layout.margin, layout.height + 2 * layout.margin
    sheet = np.full((step_y * layout.rows, step_x * layout.columns, 3), 255, np.uint8)
    images: dict[str, NDArray[np.uint8]] = {}
    for k, chip in enumerate(chips):
        if chip.file not in images:
            images[chip.file] = np.asarray(cv2.imread(str(data / chip.file), cv2.IMREAD_COLOR), np.uint8)
        drawn = chip.view.draw(images[chip.file], layout.width, layout.height)
        left, top = k % layout.columns * step_x + layout.margin, k // layout.columns * step_y + layout.margin
        sheet[top : top + layout.height, left : left + layout.width] = drawn
        if layout.rulers:
            _rulers(sheet, left, top, layout)
            cv2.putText(sheet, str(chip.number), (left - 28, top - 8), 0, 0.6, (0, 0, 255), 2, cv2.LINE_AA)
        else:
            u, v = left + round(chip.view.u), top + round(chip.view.v)
            cv2.line(sheet, (u - 2, v), (u + 2, v), (0, 255, 255))
            cv2.line(sheet, (u, v - 2), (u, v + 2), (0, 255, 255))
            cv2.putText(sheet, str(chip.number), (left + 3, top + 18), 0, 0.55, (0, 0, 0), 4, cv2.LINE_AA)
            cv2.putText(sheet, str(chip.number), (left + 3, top + 18), 0, 0.55, (0, 255, 255), 1, cv2.LINE_AA)
    return sheet


def _rulers(sheet: NDArray[np.uint8], left: int, top: int, layout: Layout) -> None:
    right, bottom, black = left + layout.width, top + layout.height, (0, 0, 0)
    for u in range(0, layout.width + 1, 10):
        long = 8 if u % 50 == 0 else 4
        cv2.line(sheet, (left + u, top - 1), (left + u, top - long), black)
        cv2.line(sheet, (left + u, bottom), (left + u, bottom + long - 1), black)
        if u % 50 == 0:
            for y in (top - 11, bottom + 19):
                cv2.putText(sheet, str(u), (left + u - 4 * len(str(u)), y), 0, 0.36, black, 1, cv2.LINE_AA)
    for v in range(0, layout.height + 1, 10):
        long = 8 if v % 50 == 0 else 4
        cv2.line(sheet, (left - 1, top + v), (left - long, top + v), black)
        cv2.line(sheet, (right, top + v), (right + long - 1, top + v), black)
        if v % 50 == 0:
            cv2.putText(sheet, str(v), (left - 29, top + v + 4), 0, 0.33, black, 1, cv2.LINE_AA)
            cv2.putText(sheet, str(v), (right + 9, top + v + 4), 0, 0.33, black, 1, cv2.LINE_AA)
