"""Drawings as people pass them on: noisy, scanned, photographed, blurred or inverted."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from research.scenes.lettering import photographed

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.random import Generator

    from research.scenes.lettering import Picture

Pixels: TypeAlias = NDArray[np.float32]
"""RGB pixels ``[h, w, 3]``, 0 to 255, before they are rounded."""

_INVERTED_SHARE = 0.25
_GREY_SHARE = 0.5
_COMPRESSED_SHARE = 0.6


def degraded(picture: Picture, rng: Generator) -> Picture:
    """Make a drawing noisy, scanned, photographed or blurred, in its own size.

    Args:
        picture: ``[h, w, 3]`` uint8 RGB.
        rng: chooses the kind and its strength.
    """
    if rng.random() < _INVERTED_SHARE:
        picture = 255 - picture
    kind = _KINDS[int(rng.choice(len(_KINDS), p=_SHARES))]
    return kind(picture, rng)


def _blurred(picture: Picture, rng: Generator) -> Picture:
    return _rounded(_blur(picture.astype(np.float32), rng.uniform(0.6, 2.2)))


def _noisy(picture: Picture, rng: Generator) -> Picture:
    """Add the noise of a sensor, and at times a blur before it."""
    pixels = picture.astype(np.float32)
    if rng.random() < 0.3:
        pixels = _blur(pixels, rng.uniform(0.4, 1.2))
    return _compressed(_with_grain(pixels, rng), rng)


def _scanned(picture: Picture, rng: Generator) -> Picture:
    """Scan a page askew, on tinted and uneven paper."""
    height, width = picture.shape[:2]
    paper = rng.uniform(170, 250, 3)
    pixels = (picture * (paper / 255)).astype(np.float32)
    fibres = rng.normal(0, 40, (height, width)).astype(np.float32)
    pixels += rng.uniform(0.1, 0.6) * _blur(fibres, rng.uniform(1, 4))[:, :, None]
    middle = (width / 2, height / 2)
    turn = cv2.getRotationMatrix2D(middle, float(rng.normal(0, 4)), rng.uniform(0.8, 1.02))
    border = rng.uniform(30, 230, 3).tolist()
    turned = cv2.warpAffine(pixels, turn, (width, height), borderValue=border)
    blurred = _blur(np.asarray(turned, np.float32), rng.uniform(0.4, 1.4))
    scan = _with_grain(_unevenly_lit(blurred, rng), rng)
    if rng.random() < _GREY_SHARE:
        scan[:] = scan.mean(axis=2, keepdims=True)
    return _compressed(scan, rng)


def _blur(pixels: Pixels, sigma: float) -> Pixels:
    return np.asarray(cv2.GaussianBlur(pixels, (0, 0), sigma), np.float32)


def _unevenly_lit(pixels: Pixels, rng: Generator) -> Pixels:
    """Darken and lighten wide parts of a picture."""
    height, width = pixels.shape[:2]
    side = int(rng.integers(2, 5))
    coarse = rng.normal(0, 1, (side, side)).astype(np.float32)
    wide = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    light = rng.uniform(0.6, 1.02) * (1 + rng.uniform(0.03, 0.22) * np.asarray(wide))
    return np.asarray(pixels * light[:, :, None], np.float32)


def _with_grain(pixels: Pixels, rng: Generator) -> Pixels:
    """Add noise, of one or three channels, of single pixels or coarser."""
    height, width = pixels.shape[:2]
    n_channels = int(rng.choice([1, 3]))
    noise = rng.normal(0, rng.uniform(2, 26), (height, width, n_channels)).astype(np.float32)
    coarseness = rng.uniform(0, 1.3)
    if coarseness > 0.4:
        noise = _blur(noise, coarseness).reshape(noise.shape) * (1 + coarseness)
    return np.asarray(pixels + noise, np.float32)


def _compressed(pixels: Pixels, rng: Generator) -> Picture:
    """Round the pixels, and compress them as JPEG most of the time."""
    picture = _rounded(pixels)
    if rng.random() >= _COMPRESSED_SHARE:
        return picture
    quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(40, 95))]
    _, file = cv2.imencode(".jpg", picture, quality)
    return np.asarray(cv2.imdecode(file, cv2.IMREAD_COLOR), np.uint8)


def _rounded(pixels: Pixels) -> Picture:
    return np.clip(np.rint(pixels), 0, 255).astype(np.uint8)


_KINDS: tuple[Callable[[Picture, Generator], Picture], ...] = (
    _noisy,
    _scanned,
    photographed,
    _blurred,
)
_SHARES = (0.33, 0.33, 0.24, 0.10)
