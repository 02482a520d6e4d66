"""COCO's run lengths of a mask: pixels column by column, the first run of zeros.

The counts are a list of numbers, or COCO's compressed text of them.
"""

from __future__ import annotations

from collections.abc import Sized
from typing import TYPE_CHECKING, Any

import numpy as np

from vehanchor.errors import PromptError

if TYPE_CHECKING:
    from collections.abc import Mapping
    from typing import TypeAlias

    from numpy.typing import NDArray

    from vehanchor.segmentation.shape import Mask

    Runs: TypeAlias = NDArray[np.int64]
    """Lengths of the runs ``[n]``: of zeros, of ones, of zeros and so on."""

# The compressed text has six bits a character: five of the number, and one if more follow.
_FIRST_CHARACTER = 48
_LAST_CHARACTER = 111
_BITS = 5
_DIGIT = 0x1F
_MORE_FOLLOW = 0x20
_SIGN = 0x10
# A run of more characters would be longer than any image.
_MAX_CHARACTERS = 8
# Largest height or width; no image that can be opened has a longer side.
_MAX_SIDE = 10_000_000
# Characters or numbers of a mask. A choice: a run has ten pixels in the largest image.
_MAX_COUNTS = 10_000_000
# From the fourth run on, the text has the difference from the run before the last.
_FIRST_DIFFERENCE = 3


def read_run_lengths(segmentation: Mapping[str, Any]) -> tuple[Runs, tuple[int, int]]:
    """Read the run lengths of a mask, and check their sum before memory is taken for the mask.

    Args:
        segmentation: ``size`` as height and width, and ``counts`` as list, text or bytes.

    Returns:
        The runs, and height and width of the mask.

    Raises:
        PromptError: size or counts are invalid, or their sum is another one.
    """
    height, width = _read_size(segmentation.get("size"))
    counts = segmentation.get("counts")
    if isinstance(counts, Sized) and len(counts) > _MAX_COUNTS:
        raise PromptError(
            f"the run lengths have {len(counts)} counts: give at most {_MAX_COUNTS}, or a polygon"
        )
    if isinstance(counts, str):
        counts = counts.encode("ascii", errors="replace")
    if isinstance(counts, bytes):
        counts = _decompress(counts)
    try:
        numbers = np.asarray(counts)
    except ValueError:
        numbers = np.zeros(0)
    # Numbers that are too large for 64 bits are objects.
    if numbers.dtype.kind not in "iu":
        raise PromptError(
            "the counts of run lengths are not whole numbers: use COCO's list or text"
        )
    runs = numbers.astype(np.int64)
    if runs.ndim != 1 or (runs < 0).any():
        raise PromptError("the counts of run lengths must be one list of numbers of at least 0")
    # In Python's integers, which do not overflow.
    n_pixels = sum(runs.tolist())
    if n_pixels != height * width:
        raise PromptError(
            f"the run lengths have {n_pixels} pixels, but their size {height} x {width} has "
            f"{height * width}: give size as height, width"
        )
    return runs, (height, width)


def mask_of_runs(runs: Runs, size: tuple[int, int]) -> Mask:
    """Make the mask ``[h, w]`` of run lengths, checked by ``read_run_lengths``."""
    height, width = size
    values = np.arange(len(runs)) % 2 == 1
    columns = np.repeat(values, runs)
    return columns.reshape(width, height).T


def _read_size(size: Any) -> tuple[int, int]:
    try:
        sides = [int(side) for side in size]
        height, width = sides
    except (OverflowError, TypeError, ValueError):
        height = 0
        width = 0
    if max(height, width) > _MAX_SIDE:
        raise PromptError("the size of run lengths is larger than any image")
    if height < 1 or width < 1:
        raise PromptError(f"the size of run lengths is {size!r}: use height, width in pixels")
    return height, width


def _decompress(text: bytes) -> list[int]:
    """Decode COCO's compressed counts."""
    runs: list[int] = []
    number = 0
    n_characters = 0
    for character in text:
        digit = character - _FIRST_CHARACTER
        is_valid = _FIRST_CHARACTER <= character <= _LAST_CHARACTER
        if not is_valid or n_characters == _MAX_CHARACTERS:
            raise PromptError("the counts are not COCO's compressed run lengths: they are damaged")
        number |= (digit & _DIGIT) << (_BITS * n_characters)
        n_characters += 1
        if digit & _MORE_FOLLOW:
            continue
        if digit & _SIGN:
            number -= 1 << (_BITS * n_characters)
        if len(runs) >= _FIRST_DIFFERENCE:
            number += runs[-2]
        runs.append(number)
        number = 0
        n_characters = 0
    if n_characters:
        raise PromptError("the counts of compressed run lengths end within a number")
    return runs
