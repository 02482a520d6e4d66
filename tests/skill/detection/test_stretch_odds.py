"""Odds of a stretched image by the look of its vehicles, and what they cost the chance."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.conftest import ROOT
from vehanchor import Engine
from vehanchor.detection.detector_errors import StretchOdds
from vehanchor.detection.proportions import stretch_log_odds
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.scale.reliability import (
    NO_DETAIL,
    STRETCHED_SHARE,
    ProportionLikelihoods,
    chance_of_stretch,
    detail_likelihoods,
)


class _Networks:
    """Networks that see a preference for a narrower image: half of it in each logit."""

    def __init__(self, preference: float) -> None:
        self._answers = iter([preference / 4, preference / 4, -preference / 4, -preference / 4])

    def logits(self, squares: NDArray[np.uint8]) -> NDArray[np.float64]:
        return np.full(len(squares), next(self._answers))

    def answers(self, squares: NDArray[np.uint8], **_: Any) -> Any:
        return SimpleNamespace(logit=self.logits(squares))


def _log_odds(
    preference: float, headings: list[float], detail: ProportionLikelihoods = NO_DETAIL
) -> float:
    boxes = np.array([[100.0, 100.0, 40.0, 17.0, heading] for heading in headings])
    networks: Any = _Networks(preference)
    with open_raster(np.full((200, 200, 3), 90, np.uint8)) as raster:
        log_odds = stretch_log_odds(
            raster,
            boxes,
            np.full(len(boxes), 4.0),
            chip_network=networks,
            network=networks,
            errors=StretchOdds(),
            detail=detail,
        )
    assert log_odds is not None
    return log_odds


@pytest.mark.parametrize("preference", [-9.0, 9.0])
def test_a_clear_preference_speaks_for_a_stretch(preference: float) -> None:
    assert _log_odds(preference, [0.8]) > 0


def test_no_preference_speaks_against_a_stretch() -> None:
    assert _log_odds(0.6, [0.8]) < 0


def test_more_vehicles_speak_more_clearly() -> None:
    assert _log_odds(0.6, [0.8] * 6) < _log_odds(0.6, [0.8]) - 0.5


def test_parallel_vehicles_along_the_rows_hardly_exclude_a_stretch() -> None:
    """Seven cars in line can be long models, or stretched."""
    along_rows = _log_odds(1.57, [0.0] * 7)
    at_an_angle = _log_odds(0.64, [0.785] * 7)
    assert along_rows > at_an_angle + 0.5


def test_the_chance_follows_the_odds() -> None:
    chances = [chance_of_stretch(log_odds) for log_odds in (-4.0, -1.0, 0.0, 2.0, 4.0)]
    assert chances == sorted(chances)
    assert chances[2] == pytest.approx(STRETCHED_SHARE)


def _few_cars(across: float) -> NDArray[np.uint8]:
    picture = cv2.imread(str(ROOT / "examples/car_park.jpg"))
    assert picture is not None
    part = picture[:260, 400:660, ::-1]
    size = (round(260 * across), 260)
    return np.asarray(cv2.resize(part, size, interpolation=cv2.INTER_CUBIC), np.uint8)


def test_a_photograph_has_lower_odds_than_its_stretched_copy() -> None:
    engine = Engine()
    as_it_is = engine.analyse_scale(_few_cars(1.0)).detections.stretch_log_odds
    stretched = engine.analyse_scale(_few_cars(1.4)).detections.stretch_log_odds
    assert as_it_is is not None
    assert stretched is not None
    assert as_it_is < 0 < stretched


def _with_detail(preference: float, difference: float) -> float:
    return _log_odds(preference, [0.8, 0.8], detail=detail_likelihoods(difference))


def test_less_detail_in_the_direction_that_the_vehicles_name_speaks_for_a_stretch() -> None:
    assert _with_detail(6.0, -1.2) > _log_odds(6.0, [0.8, 0.8]) + 1.0


def test_detail_contradicts_vehicles_that_name_the_other_direction() -> None:
    assert _with_detail(6.0, 1.2) < _log_odds(6.0, [0.8, 0.8]) - 1.0


def test_equal_detail_in_both_directions_speaks_against_a_stretch() -> None:
    assert _with_detail(6.0, 0.0) < _log_odds(6.0, [0.8, 0.8]) - 1.0
