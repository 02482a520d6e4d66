"""Crops that only their thumbnail betrays."""

from __future__ import annotations

import struct

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.skill.imagery.files import after_start, encoded, segment
from vehanchor.imagery.facts import image_facts
from vehanchor.imagery.metadata.lens import lens
from vehanchor.imagery.sources.opening import open_raster

_WIDTH_PX = 480
_HEIGHT_PX = 320


def _ground() -> NDArray[np.uint8]:
    """Make a picture with structures of several sizes."""
    rng = np.random.default_rng(3)
    layers = np.zeros((_HEIGHT_PX, _WIDTH_PX))
    for cells in (6, 15, 40):
        coarse = rng.normal(0, 40, (cells, cells))
        layers += cv2.resize(coarse, (_WIDTH_PX, _HEIGHT_PX), interpolation=cv2.INTER_CUBIC)
    grey = np.clip(layers + 120, 0, 255).astype(np.uint8)
    return np.repeat(grey[:, :, None], 3, axis=2)


GROUND = _ground()


def _exif_with(thumbnail: bytes) -> bytes:
    """Make an EXIF block with a 35 mm equivalent and a thumbnail."""
    camera_at = 8 + 2 + 12 + 4
    second_at = camera_at + 2 + 12 + 4
    thumbnail_at = second_at + 2 + 2 * 12 + 4
    block = struct.pack("<2sHI", b"II", 42, 8)
    block += struct.pack("<HHHII", 1, 0x8769, 4, 1, camera_at) + struct.pack("<I", second_at)
    block += struct.pack("<HHHIHH", 1, 0xA405, 3, 1, 24, 0) + struct.pack("<I", 0)
    block += struct.pack("<HHHII", 2, 0x0201, 4, 1, thumbnail_at)
    block += struct.pack("<HHII", 0x0202, 4, 1, len(thumbnail)) + struct.pack("<I", 0)
    return block + thumbnail


def _has_lens(picture: NDArray[np.uint8], thumbnail: NDArray[np.uint8]) -> bool:
    """Test whether the lens of a file's metadata is used."""
    exif = _exif_with(encoded(".jpg", thumbnail))
    file = after_start(encoded(".jpg", picture), segment(b"Exif\0\0" + exif))
    with open_raster(file) as raster:
        facts = image_facts(raster)
    return lens(facts, facts.camera) is not None


def _small(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    reduced = cv2.resize(picture, (160, 106), interpolation=cv2.INTER_AREA)
    return np.asarray(reduced, np.uint8)


@pytest.mark.parametrize(
    "part",
    [GROUND[80:240, 120:360], GROUND[:200, :300], GROUND[100:300, 200:330]],
    ids=["middle", "corner", "other proportions"],
)
def test_a_part_of_what_its_thumbnail_shows_has_no_lens(part: NDArray[np.uint8]) -> None:
    assert not _has_lens(part, _small(GROUND))


def test_a_whole_photograph_has_its_lens() -> None:
    assert _has_lens(GROUND, _small(GROUND))


def test_black_bars_in_a_thumbnail_belong_to_no_picture() -> None:
    barred = cv2.copyMakeBorder(_small(GROUND), 30, 30, 0, 0, cv2.BORDER_CONSTANT)
    assert _has_lens(GROUND, np.asarray(barred, np.uint8))


def test_white_bars_in_a_thumbnail_belong_to_no_picture() -> None:
    # Without fine structures, a part that is a little too large resembles its surroundings.
    ground = np.asarray(cv2.GaussianBlur(GROUND, (0, 0), 30), np.uint8)
    white = (255, 255, 255)
    barred = cv2.copyMakeBorder(_small(ground), 30, 30, 0, 0, cv2.BORDER_CONSTANT, value=white)
    assert _has_lens(ground, np.asarray(barred, np.uint8))


def test_another_thumbnail_proves_nothing() -> None:
    assert _has_lens(GROUND, _small(GROUND[::-1, ::-1]))


def test_a_photograph_turned_without_its_thumbnail_has_its_lens() -> None:
    snow = np.full_like(GROUND, 200)
    cv2.circle(snow, (265, 175), 20, (40, 40, 40), -1)  # a part of the thumbnail resembles it
    turned = np.ascontiguousarray(snow[::-1, ::-1])
    assert _has_lens(turned, _small(snow))
