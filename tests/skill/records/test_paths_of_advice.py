"""Advice, followed to its end by a caller who has what it asks for, leads to a right scale.

``tests.advice_caller`` follows each remedy of each answer, up to three steps.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from docs.witnesses import with_height
from research.scenes.pages import chart
from tests.advice_caller import (
    Call,
    Photo,
    enlarged,
    follow_all,
    pixels_as_photo,
    rendered,
    tilted,
)
from tests.conftest import ROOT
from tests.yards import paint_yard
from vehanchor import Engine
from vehanchor.imagery.sources.opening import open_raster
from vehanchor_evaluation.table import survey_table

HERSHEY_FONTS = (0, 1, 2)
EXAMPLES = ROOT / "examples"


@pytest.fixture(scope="module")
def engine() -> Engine:
    return Engine()


def _car_park(gsd: float = 0.125, side_px: int = 800) -> Photo:
    return rendered(gsd, 3, "parking", side_px=side_px)


def _fields() -> Photo:
    return rendered(0.15, 1, "countryside", n_cars=0)


def _town() -> Photo:
    return rendered(0.15, 5, "urban", n_cars=0)


def _one_car() -> Photo:
    return rendered(0.15, 6, "urban", n_cars=1)


def _from_space(gsd: float, side_px: int = 640) -> Photo:
    return _with_better(rendered(gsd, 3, "urban", side_px=side_px))


def _with_better(photo: Photo) -> Photo:
    return Photo(photo.image, photo.size, photo.gsd_m_per_px, photo.cars, better=_car_park())


def _spoilt(spoil: Callable[[Photo], Any], gsd: float | None = None) -> Photo:
    original = _car_park()
    return pixels_as_photo(spoil(original), gsd, better=original)


def _blurred(photo: Photo) -> Any:
    return cv2.GaussianBlur(photo.image, (0, 0), 4)


def _beside_another_scale(photo: Photo) -> Any:
    other = rendered(0.3, 4, "urban", side_px=photo.size[1])
    return np.hstack([photo.image, other.image])


def _under_a_sky(photo: Photo) -> Any:
    """Paint a hazy sky over the upper part of a photograph."""
    rows = np.arange(photo.size[1])[:, None, None]
    below_px = rows - 0.25 * photo.size[1]
    haze = np.where(below_px < 0, 1.0, 0.8 * np.exp(-np.maximum(below_px, 0) / 120))
    noise = np.random.default_rng(1).normal(0, 2, (*photo.image.shape[:2], 1))
    sky = np.array([200.0, 215.0, 235.0]) + noise
    return np.clip(haze * sky + (1 - haze) * photo.image, 0, 255).astype(np.uint8)


def _yard(kind: Any, gsd: float) -> Photo:
    return pixels_as_photo(paint_yard(kind, gsd, 640), gsd)


def _stale_height() -> Photo:
    """Make a photograph of a street whose file states a height of 30 m; it is 84 m."""
    path = EXAMPLES / "scenes/safe.jpg"
    return Photo(with_height(path, 30.0), (800, 600), 0.12)


def _chart() -> Any:
    return chart(np.random.default_rng(1), HERSHEY_FONTS)


SITUATIONS: dict[str, Callable[[], Call]] = {
    "one car": lambda: Call(_one_car(), {}),
    "one car, unmeasured country": lambda: Call(_one_car(), {"region": "JP"}),
    "one car, false line": lambda: Call(
        _one_car(), {"known_lengths": [_one_car().line("measured", factor=2.0)]}
    ),
    "fields": lambda: Call(_fields(), {}),
    "fields, guessed line": lambda: Call(_fields(), {"known_lengths": [_fields().thing(0)]}),
    "fields, two guesses": lambda: Call(
        _fields(), {"known_lengths": [_fields().line("assumed"), _fields().thing(0)]}
    ),
    "fields, guessed height": lambda: Call(_fields(), _fields().height(basis="assumed")),
    "fields, line against false height": lambda: Call(
        _fields(),
        {**_fields().height(factor=2.0), "known_lengths": [_fields().line("measured")]},
    ),
    "fields, chosen rulers": lambda: Call(_fields(), {"rulers": "scene_scale,courts"}),
    "town": lambda: Call(_town(), {}),
    "town, false height": lambda: Call(_town(), _town().height(factor=2.0)),
    "town, false line": lambda: Call(
        _town(), {"known_lengths": [_town().line("measured", factor=2.0)]}
    ),
    "car park, false line": lambda: Call(
        _car_park(), {"known_lengths": [_car_park().line("measured", factor=1.4)]}
    ),
    "car park, chosen rulers": lambda: Call(_car_park(), {"rulers": "scene_scale,courts"}),
    "satellite": lambda: Call(_from_space(0.5), {}),
    "coarse satellite": lambda: Call(_from_space(1.5, side_px=320), {}),
    "enlarged": lambda: Call(
        pixels_as_photo(enlarged(_car_park(0.5, side_px=400), 3, 3), 0.5 / 3, better=_car_park()),
        {},
    ),
    "blurred": lambda: Call(_spoilt(_blurred, 0.125), {}),
    "stretched": lambda: Call(_spoilt(lambda photo: enlarged(photo, 1.5, 1)), {}),
    "tilted": lambda: Call(_spoilt(lambda photo: tilted(photo, 0.2)), {}),
    "much tilted": lambda: Call(_spoilt(lambda photo: tilted(photo, 0.3)), {}),
    "horizon": lambda: Call(_spoilt(_under_a_sky), {}),
    "collage": lambda: Call(_spoilt(_beside_another_scale), {}),
    "black": lambda: Call(_spoilt(lambda photo: np.zeros_like(photo.image)), {}),
    "chart": lambda: Call(pixels_as_photo(_chart(), better=_car_park()), {}),
    "equal cars": lambda: Call(_yard("equal cars", 0.2), {}),
    "boats": lambda: Call(_yard("boats", 0.1), {}),
    "roof units": lambda: Call(_yard("roof units", 0.2), {}),
    "stale height in the file": lambda: Call(_stale_height(), {}),
}


@pytest.mark.slow
@pytest.mark.parametrize("guesses", [False, True], ids=["measured", "guessed"])
@pytest.mark.parametrize("situation", SITUATIONS)
def test_each_path_of_advice_ends_at_a_right_scale(
    engine: Engine, situation: str, guesses: bool
) -> None:
    ends = list(follow_all(engine, SITUATIONS[situation](), guesses=guesses))
    others = [(end.steps, end.outcome) for end in ends if end.outcome != "right"]
    assert not others


@pytest.mark.slow
def test_no_path_of_advice_on_photographs_ends_where_it_began_or_wrong(
    engine: Engine, real_data: Path
) -> None:
    table = survey_table(real_data / "gsd/table.csv")
    photographs = [image for image in table.images if image.split == "val"][::30]
    others = []
    for photograph in photographs:
        with open_raster(photograph.path) as raster:
            size = (raster.width_px, raster.height_px)
        photo = Photo(photograph.path, size, photograph.gsd_m_per_px)
        for end in follow_all(engine, Call(photo, {}), guesses=False):
            # Where only another photograph would help, this caller has no way on.
            if end.steps and end.outcome not in ("right", "no way on"):
                others.append((photograph.path.name, end.steps, end.outcome))
    assert not others
