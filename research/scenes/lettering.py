"""Lettering: words in many fonts, drawn as people draw them on pages and over photographs."""

from __future__ import annotations

import zlib
from functools import cache
from pathlib import Path
from typing import NamedTuple, TypeAlias

import cv2
import matplotlib
import numpy as np
from matplotlib.font_manager import findSystemFonts
from numpy.random import Generator
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

Picture: TypeAlias = NDArray[np.uint8]
"""RGB picture ``[h, w, 3]``."""

Colour: TypeAlias = tuple[int, int, int]
"""RGB in 0..255."""

Font: TypeAlias = ImageFont.FreeTypeFont

_WORDS = """
    Figure Table area vehicles parking lot scale metres per pixel height Results of the survey
    North East West South building roof Method Median error total count January 2026 sum mean
    altitude speed distance home battery REC ISO shutter lat lon GPS mode signal Warning Menu
    File Edit View Help Settings Layer Search Street Avenue Hospital Station River Park School
    and or with from into over under between first second third image photograph drone flight
    plan map title legend axis value rate revenue profit growth quarter model data set train
    HELLO WORLD EXIT STOP Slow Copyright Licence Draft Confidential page chapter section note
"""
# Characters of a word that is a number.
_DIGITS = "0123456789"
# Scripts whose letters a font may lack are drawn as empty boxes: only Latin letters are used.
_PROBE = "HamburgefonstivR0123456789"
_HERSHEY = (
    cv2.FONT_HERSHEY_SIMPLEX,
    cv2.FONT_HERSHEY_PLAIN,
    cv2.FONT_HERSHEY_DUPLEX,
    cv2.FONT_HERSHEY_COMPLEX,
    cv2.FONT_HERSHEY_TRIPLEX,
)
# Height of a capital letter of a Hershey font at a scale of 1, pixels.
_HERSHEY_PX = 22.0
# One of so many font families is held out of training.
_HELD_OUT = 3


class Pen(NamedTuple):
    """How a line of text is drawn.

    Attributes:
        font: file of the font, or number of an OpenCV Hershey font.
        size_px: size of the font.
        ink: colour of the letters.
        edge: colour of an outline; None without one.
        edge_px: width of the outline.
        opacity: 0..1, of letters over what is below them.
    """

    font: Path | int
    size_px: float
    ink: Colour
    edge: Colour | None = None
    edge_px: int = 0
    opacity: float = 1.0


@cache
def own_fonts() -> tuple[Path | int, ...]:
    """List the fonts that are on every machine: those of matplotlib and OpenCV."""
    folder = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
    files = sorted(path for path in folder.glob("DejaVu*.ttf") if "Display" not in path.name)
    return (*files, *_HERSHEY)


@cache
def system_fonts() -> tuple[Path | int, ...]:
    """List the fonts of this machine that have Latin letters, and those that all machines have."""
    files = sorted(Path(name) for name in findSystemFonts())
    names = {path.name for path in own_fonts() if isinstance(path, Path)}
    return (
        *own_fonts(),
        *(path for path in files if path.name not in names and _has_letters(path)),
    )


def _has_letters(path: Path) -> bool:
    """Test whether a font draws all Latin letters and figures, each in its own way."""
    try:
        font = ImageFont.truetype(path, 24)
        pictures = {bytes(font.getmask(letter)) for letter in _PROBE}
    except OSError:
        return False
    return len(pictures) > len(set(_PROBE)) - 3


def is_held_out(font: Path | int) -> bool:
    """Test whether a font's family is held out of training."""
    name = str(font) if isinstance(font, int) else font.stem.split("-")[0]
    return zlib.crc32(name.encode()) % _HELD_OUT == 0


def words(rng: Generator, count: int) -> str:
    """Draw words and numbers, some of them in capitals."""
    chosen = []
    for _ in range(count):
        word = str(rng.choice(_WORDS.split()))
        if rng.random() < 0.15:
            digits = rng.choice(list(_DIGITS), size=rng.integers(1, 6))
            word = "".join(digits)
            if rng.random() < 0.5:
                word = f"{word[:1]}.{word[1:]}" if len(word) > 1 else word
        chosen.append(word)
    line = " ".join(chosen)
    if rng.random() < 0.25:
        line = line.upper()
    return line


def text_mask(line: str, pen: Pen) -> tuple[Picture, Picture]:
    """Draw a line: opacity ``[h, w]`` of its letters, and of its letters with their outline."""
    if isinstance(pen.font, int):
        return _hershey_mask(line, pen.font, pen)
    font = _font(pen.font, max(6, round(pen.size_px)))
    left, top, right, bottom = font.getbbox(line, stroke_width=pen.edge_px)
    size = max(1, round(right - left)), max(1, round(bottom - top))
    masks = []
    for stroke in (0, pen.edge_px):
        canvas = Image.new("L", size)
        draw = ImageDraw.Draw(canvas)
        draw.text((-left, -top), line, fill=255, font=font, stroke_width=stroke)
        masks.append(np.asarray(canvas))
    return masks[0], masks[1]


@cache
def _font(path: Path, size_px: int) -> Font:
    return ImageFont.truetype(path, size_px)


def _hershey_mask(line: str, face: int, pen: Pen) -> tuple[Picture, Picture]:
    """Draw a line by OpenCV, as programs for cameras and detectors do."""
    scale = pen.size_px * 0.72 / _HERSHEY_PX
    thickness = max(1, round(pen.size_px / 12))
    (width, height), below = cv2.getTextSize(line, face, scale, thickness)
    margin = thickness + pen.edge_px
    size = height + below + 2 * margin, width + 2 * margin
    origin = (margin, height + margin)
    masks = []
    for stroke in (thickness, thickness + 2 * pen.edge_px):
        mask = np.zeros(size, np.uint8)
        cv2.putText(mask, line, origin, face, scale, 255, stroke, cv2.LINE_AA)
        masks.append(mask)
    return masks[0], masks[1]


def write(picture: Picture, line: str, at: tuple[float, float], pen: Pen, turn: float = 0) -> int:
    """Draw a line over a picture, in place.

    Args:
        picture: the picture.
        line: the text.
        at: x and y of its upper left corner, or of its centre if it is turned.
        pen: how to draw it.
        turn: degrees.

    Returns:
        Height of the line, pixels.
    """
    letters, with_edge = text_mask(line, pen)
    height: int = letters.shape[0]
    x, y = round(at[0]), round(at[1])
    if turn:
        letters, with_edge = (_turned(mask, turn) for mask in (letters, with_edge))
        x -= letters.shape[1] // 2
        y -= letters.shape[0] // 2
    if pen.edge is not None:
        blend(picture, with_edge, (x, y), pen.edge, pen.opacity)
    blend(picture, letters, (x, y), pen.ink, pen.opacity)
    return height


def _turned(mask: Picture, degrees: float) -> Picture:
    """Turn a mask about its centre on a canvas that holds all of it."""
    turned = Image.fromarray(mask).rotate(degrees, Image.Resampling.BICUBIC, expand=True)
    return np.asarray(turned)


def blend(
    picture: Picture, mask: Picture, at: tuple[int, int], colour: Colour, opacity: float
) -> None:
    """Blend a colour over a picture by a mask ``[h, w]``, in place; what lies outside is cut."""
    rows, columns = picture.shape[:2]
    x, y = at
    left, top = max(0, x), max(0, y)
    right, bottom = min(columns, x + mask.shape[1]), min(rows, y + mask.shape[0])
    if left >= right or top >= bottom:
        return
    share = mask[top - y : bottom - y, left - x : right - x, None] * (opacity / 255)
    below = picture[top:bottom, left:right].astype(np.float64)
    mixed = below + share * (np.array(colour) - below)
    picture[top:bottom, left:right] = np.rint(mixed).astype(np.uint8)


def compressed(picture: Picture, rng: Generator) -> Picture:
    """Compress a picture as JPEG, half of the time; at times reduce it before."""
    if rng.random() < 0.2:
        factor = rng.uniform(0.5, 0.9)
        size = (round(picture.shape[1] * factor), round(picture.shape[0] * factor))
        picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
    if rng.random() < 0.5:
        return picture
    quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(50, 96))]
    _, file = cv2.imencode(".jpg", picture, quality)
    return np.asarray(cv2.imdecode(file, cv2.IMREAD_COLOR), np.uint8)


def photographed(picture: Picture, rng: Generator) -> Picture:
    """Photograph a page on a desk: from a slant, unevenly lit, with blur, noise and compression."""
    height, width = picture.shape[:2]
    desk = rng.uniform(60, 200, 3) + rng.normal(0, 8, (height, width, 1))
    corners = np.array([(0, 0), (width, 0), (width, height), (0, height)], np.float32)
    reach = rng.uniform(0.02, 0.18)
    moved = corners + rng.uniform(-reach, reach, (4, 2)) * (width, height)
    homography = cv2.getPerspectiveTransform(corners, moved.astype(np.float32))
    page = cv2.warpPerspective(picture, homography, (width, height))
    whole = np.ones((height, width, 1), np.float32)
    share = cv2.warpPerspective(whole, homography, (width, height))[:, :, None]
    mixed = page * share + desk * (1 - share)
    # The light falls off along a direction of its own.
    across = np.linspace(-0.5, 0.5, width)
    down = np.linspace(-0.5, 0.5, height)[:, None]
    slopes = rng.uniform(-0.4, 0.4, 2)
    light = rng.uniform(0.7, 1) * (1 + slopes[0] * across + slopes[1] * down)
    blurred = cv2.GaussianBlur(mixed * light[:, :, None], (0, 0), rng.uniform(0.6, 1.6))
    noisy = np.asarray(blurred) + rng.normal(0, rng.uniform(2, 6), blurred.shape)
    photograph = np.clip(noisy, 0, 255).astype(np.uint8)
    quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(60, 93))]
    _, file = cv2.imencode(".jpg", photograph, quality)
    return np.asarray(cv2.imdecode(file, cv2.IMREAD_COLOR), np.uint8)
