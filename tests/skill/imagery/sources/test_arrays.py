from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.skill.imagery.files import (
    RGB,
    read_all,
)
from vehanchor.errors import (
    ImageFormatError,
)
from vehanchor.imagery.sources.opening import open_raster

ARRAYS: list[tuple[str, NDArray[Any], NDArray[Any]]] = [
    ("rgb", RGB, RGB),
    ("grey", RGB[..., 0], RGB[..., [0, 0, 0]]),
    ("one band", RGB[..., :1], RGB[..., [0, 0, 0]]),
    ("grey and alpha", RGB[..., :2], RGB[..., [0, 0, 0]]),
    ("four bands", np.concatenate([RGB, RGB[..., :1]], axis=2), RGB),
    ("floats of 0..1", RGB / 255, RGB),
    ("float32", (RGB / 255).astype(np.float32), RGB),
    ("a strided view", np.repeat(RGB, 2, axis=1)[:, ::2], RGB),
    ("a mirrored view", RGB[:, ::-1], RGB[:, ::-1]),
    ("BGR turned by a view", RGB[..., ::-1], RGB[..., ::-1]),
    ("all zero", np.zeros((20, 20), np.uint16), np.zeros((20, 20, 3))),
    ("a constant", np.full((20, 20), 5000, np.uint16), np.zeros((20, 20, 3))),
    ("zero floats", np.zeros((20, 20)), np.zeros((20, 20, 3))),
]


@pytest.mark.parametrize(("array", "expected"), [case[1:] for case in ARRAYS], ids=[case[0] for case in ARRAYS])
def test_arrays_are_read_and_left_as_they_are(array: NDArray[Any], expected: NDArray[Any]) -> None:
    before = array.copy()
    np.testing.assert_array_equal(read_all(array), expected)
    np.testing.assert_array_equal(array, before)
    assert array.flags.writeable


def test_an_rgb_array_is_not_copied_and_cannot_be_written_through() -> None:
    array = RGB.copy()
    with open_raster(array) as raster:
        assert raster.source == "array"
        shown = raster.read()
    assert np.shares_memory(shown, array)
    assert not shown.flags.writeable


WITH_NAN = np.where(np.arange(400).reshape(20, 20) < 3, np.nan, 0.5)

BAD_ARRAYS: list[tuple[str, NDArray[Any], str]] = [
    ("nan", WITH_NAN, "3 of 400 pixels are NaN or infinite"),
    ("infinite", np.where(np.isnan(WITH_NAN), np.inf, 0.5), "3 of 400"),
    ("bool", np.zeros((20, 20), bool), "bool"),
    ("int16", np.zeros((20, 20), np.int16), "int16"),
    ("int64", np.zeros((20, 20), np.int64), "int64"),
    ("complex", np.zeros((20, 20), complex), "complex128"),
    ("object", np.zeros((20, 20), object), "object"),
    ("text", np.full((20, 20), "a"), "U1"),
    ("one dimension", np.zeros(400, np.uint8), r"\[400\]"),
    ("four dimensions", np.zeros((1, 20, 20, 3), np.uint8), r"\[1, 20, 20, 3\]"),
    ("no bands", np.zeros((20, 20, 0), np.uint8), r"\[20, 20, 0\]"),
    ("no pixels", np.zeros((0, 0, 3), np.uint8), "0 x 0 px"),
    ("one pixel", np.zeros((1, 1, 3), np.uint8), "1 x 1 px"),
    ("bands first", np.zeros((3, 50, 60), np.uint8), "bands come last"),
    ("floats too far apart", 1.7e308 * np.linspace(-1, 1, 400).reshape(20, 20), "rescale"),
]


@pytest.mark.parametrize(("array", "message"), [case[1:] for case in BAD_ARRAYS], ids=[case[0] for case in BAD_ARRAYS])
def test_arrays_that_cannot_be_measured(array: NDArray[Any], message: str) -> None:
    with pytest.raises(ImageFormatError, match=message) as caught:
        open_raster(array)
    assert caught.value.code == "image_unsupported"
