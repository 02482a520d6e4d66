"""Unbiased rasterisation of polygons by the pixel-centre rule, and periodic noise in metres."""

from __future__ import annotations

import math
from typing import TypeAlias, cast

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

Points: TypeAlias = NDArray[np.float64]
"""Points x, y ``[n, 2]``."""

Texture: TypeAlias = NDArray[np.float32]
"""Texture ``[h, w]``."""

_SMOOTH_BELOW = 0.34


def polygon_area(points: Points) -> float:
    """Compute the area of a simple polygon [N,2] by the shoelace formula, in squared units."""
    x = points[:, 0]
    y = points[:, 1]
    next_x = np.roll(x, -1)
    next_y = np.roll(y, -1)
    doubled = np.dot(x, next_y) - np.dot(y, next_x)
    return float(abs(doubled) / 2)


def polygon_mask(points: Points, width: int, height: int) -> NDArray[np.bool_]:
    """Rasterise a polygon: pixels whose centre lies inside (even-odd rule).

    The number of pixels is an unbiased estimate of the area. ``cv2.fillPoly`` also fills every
    pixel that an edge touches, half a pixel too much on each side.

    Args:
        points: [N,2] in pixels; pixel (i, j) covers [j, j+1] x [i, i+1].
        width: width of the mask.
        height: height of the mask.

    Returns:
        [height, width] mask.
    """
    toggles = np.zeros((height, width + 1), dtype=np.uint8)
    next_points = np.roll(points, -1, axis=0)
    for (x0, y0), (x1, y1) in zip(points, next_points, strict=True):
        if y0 == y1:
            continue
        low, high = (y0, y1) if y0 < y1 else (y1, y0)
        first = max(int(np.ceil(low - 0.5)), 0)
        last = min(int(np.ceil(high - 0.5)), height)
        if first >= last:
            continue
        rows = np.arange(first, last)
        crossings = x0 + (rows + 0.5 - y0) * ((x1 - x0) / (y1 - y0))
        columns = np.clip(np.ceil(crossings - 0.5), 0, width).astype(np.intp)
        toggles[rows, columns] ^= 1
    is_inside = np.bitwise_xor.accumulate(toggles, axis=1)[:, :width]
    return cast("NDArray[np.bool_]", is_inside.astype(bool))


def clip_polygon(points: Points, x0: float, y0: float, x1: float, y1: float) -> Points:
    """Clip a polygon to a rectangle (Sutherland-Hodgman); the result may be empty [0,2]."""
    current = points
    # Axis, bound, and the direction to the inside of each edge.
    edges = ((0, x0, 1.0), (0, x1, -1.0), (1, y0, 1.0), (1, y1, -1.0))
    for axis, bound, sign in edges:
        if len(current) == 0:
            break
        inside = sign * (current[:, axis] - bound) >= 0
        clipped: list[Points] = []
        for index, point in enumerate(current):
            previous = current[index - 1]
            if inside[index] != inside[index - 1]:
                share = (bound - previous[axis]) / (point[axis] - previous[axis])
                clipped.append(previous + share * (point - previous))
            if inside[index]:
                clipped.append(point)
        current = np.array(clipped, dtype=np.float64).reshape(-1, 2)
    return current


def noise_texture(rng: Generator, size: int, exponent: float) -> Texture:
    """Create periodic noise [size, size]: spectrum f ** -exponent, zero mean, unit variance."""
    spectrum = np.fft.rfft2(rng.standard_normal((size, size)))
    rows = np.fft.fftfreq(size)[:, None]
    columns = np.fft.rfftfreq(size)[None, :]
    frequency = np.hypot(rows, columns)
    frequency[0, 0] = 1.0
    spectrum *= frequency**-exponent
    spectrum[0, 0] = 0.0
    texture = np.fft.irfft2(spectrum, s=(size, size))
    return np.ascontiguousarray(texture / texture.std(), dtype=np.float32)


def sample_noise(
    texture: Texture,
    texel: float,
    x: float,
    y: float,
    step: float,
    width: int,
    height: int,
) -> Texture:
    """Sample a periodic texture, laid over the world, at the pixels of a window.

    Args:
        texture: square and periodic.
        texel: size of one of its pixels, in metres.
        x: left edge of the window, in metres.
        y: top edge of the window, in metres.
        step: pixel size of the window, in metres.
        width: width of the window, in pixels.
        height: height of the window, in pixels.

    Returns:
        [height, width]; fades to 0 for pixels larger than the texture's period, as averaging would.
    """
    size = texture.shape[0]
    # OpenCV interpolates at 16-bit coordinates: coarser pixels sample a decimated texture.
    factor = 1
    while step / (texel * factor) > 4 and factor * 8 <= size:
        factor *= 2
    if factor > 1:
        texture = cast(
            "Texture",
            cv2.resize(texture, (size // factor,) * 2, interpolation=cv2.INTER_AREA),
        )
        texel = texel * factor
        size = size // factor
    scale = step / texel
    if scale * max(width, height) > 30_000:
        return np.zeros((height, width), dtype=np.float32)
    left = (x / texel + scale / 2 - 0.5) % size
    top = (y / texel + scale / 2 - 0.5) % size
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    border = cv2.BORDER_WRAP
    # With many pixels per texel, cubic interpolation, which OpenCV does not wrap.
    if scale < _SMOOTH_BELOW:
        columns = np.arange(-2, math.ceil(left % 1 + scale * width) + 3) + math.floor(left)
        rows = np.arange(-2, math.ceil(top % 1 + scale * height) + 3) + math.floor(top)
        texture = np.ascontiguousarray(texture[np.ix_(rows % size, columns % size)])
        left = left % 1 + 2
        top = top % 1 + 2
        flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        border = cv2.BORDER_REPLICATE
    matrix = np.array([[scale, 0, left], [0, scale, top]])
    sampled = cv2.warpAffine(texture, matrix, (width, height), flags=flags, borderMode=border)
    return cast("Texture", sampled)
