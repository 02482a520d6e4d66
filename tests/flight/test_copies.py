from __future__ import annotations

from dataclasses import replace

import numpy as np

from tests.analyses import made_card
from tests.flight.ground import sighting_of
from vehanchor.imagery.facts import ImageFacts
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options import ScaleOptions
from vehanchor_flight.copies import reduced_picture, without_copies
from vehanchor_flight.photograph import Photograph, StoredPhotograph
from vehanchor_flight.record import Failure

SCENE = np.kron(np.random.default_rng(3).integers(0, 255, (30, 40, 3)), np.ones((20, 20, 1))).astype(np.uint8)


def _photograph(name: str, step: int, scene: np.ndarray = SCENE) -> Photograph:
    with open_raster(np.ascontiguousarray(scene[::step, ::step])) as raster:
        facts = ImageFacts(raster.width_px, raster.height_px)
        stored = StoredPhotograph(facts, sighting_of(np.zeros(0)), 1.0, (), reduced=reduced_picture(raster))
    return Photograph.of(name, stored, made_card(5.0), ScaleOptions())


def test_two_sizes_of_a_photograph_are_one() -> None:
    small, whole, other = _photograph("s", 2), _photograph("w", 1), _photograph("o", 2, SCENE[::-1])
    kept = without_copies([small, whole, other])
    assert kept[1:] == [whole, other]
    assert isinstance(kept[0], Failure)
    assert "smaller copy of 'w'" in str(kept[0].error)


def test_photographs_of_one_size_stay_however_alike() -> None:
    alike = [_photograph(name, 1) for name in "ab"]
    assert without_copies(alike) == alike


def test_without_the_reduced_picture_nothing_is_left_out() -> None:
    old = [replace(_photograph("s", 2), reduced=None), _photograph("w", 1)]
    assert without_copies(old) == old
