"""Reason and advice fit what a picture shows."""

from __future__ import annotations

from typing import Any, get_args

import cv2
import numpy as np
import pytest

import vehanchor
from tests.conftest import ROOT
from vehanchor.records import Notice, Reason, SceneScaleEstimate
from vehanchor.records.advice import ADVICE, advice_for

SCENES = ROOT / "examples" / "scenes"


@pytest.fixture(scope="module")
def engine() -> vehanchor.Engine:
    return vehanchor.Engine()


@pytest.fixture(scope="module")
def estimate(engine: vehanchor.Engine) -> vehanchor.GsdEstimate:
    """A usable estimate."""
    return engine.estimate(SCENES / "safe.jpg")


def test_a_scene_without_cars_is_not_sent_to_car_parks_but_asked_for_a_fact(engine: vehanchor.Engine) -> None:
    found = engine.estimate(SCENES / "no_cars.jpg")
    advice = advice_for(found)
    assert advice is not None
    assert (found.n_vehicles, advice.why) == (0, "no car was found")
    assert advice.helps.startswith("draw a line over something of known size")


def test_a_sharp_scene_that_is_too_coarse_names_the_pixels_of_its_cars(engine: vehanchor.Engine) -> None:
    found = engine.estimate(SCENES / "too_coarse.jpg")
    advice = advice_for(found)
    assert advice is not None
    assert found.mode_length_px is not None
    assert advice == (f"the vehicles are only {found.mode_length_px:.0f} px long", ADVICE["too_coarse"].helps)


def test_an_enlarged_scene_is_asked_for_its_original(engine: vehanchor.Engine) -> None:
    image = cv2.imread(str(SCENES / "too_coarse.jpg"))
    assert image is not None
    enlarged = np.asarray(cv2.resize(image[:500, :500, ::-1], None, fx=2.5, fy=2.5, interpolation=cv2.INTER_CUBIC))
    found = engine.estimate(enlarged.astype(np.uint8))
    assert "detail_missing" in [notice.code for notice in found.warnings]
    assert advice_for(found) == ("the image is enlarged or blurred", "send the original image")


def _scene(low: float, high: float) -> SceneScaleEstimate:
    return SceneScaleEstimate(gsd_m_per_px=(low * high) ** 0.5, gsd_ci95_low_m_per_px=low, gsd_ci95_high_m_per_px=high)


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"reason": "too_coarse", "n_vehicles": 0}, "no car was found, and the scene looks too coarse for cars"),
        ({"reason": "too_few", "n_vehicles": 1}, "1 vehicle alone: too little evidence"),
        ({"reason": "disagree", "scene_scale": _scene(0.3, 0.5)}, "by the scene the scale is about 0.39 m/px"),
        (
            {"reason": "disagree", "warnings": (Notice(code="stretched", message="It is stretched."),)},
            "the image is stretched in one direction",
        ),
    ],
)
def test_one_reason_has_the_advice_of_what_was_seen(
    estimate: vehanchor.GsdEstimate, changes: dict[str, Any], why: str
) -> None:
    advice = advice_for(estimate.model_copy(update=changes))
    assert advice is not None
    assert advice.why.startswith(why)
    assert "fly lower" not in advice.helps


def test_rulers_that_contradict_each_other_are_named(engine: vehanchor.Engine) -> None:
    found = engine.estimate(SCENES / "safe.jpg", known_lengths=[(255, 160, 535, 160, 300.0)])
    contradicted = found.model_copy(update={"reason": "disagree"})
    advice = advice_for(contradicted)
    assert advice is not None
    assert "known length" in advice.why
    assert "contradict each other" in advice.why


def test_every_reason_has_advice_that_names_nothing_unknown(estimate: vehanchor.GsdEstimate) -> None:
    assert advice_for(estimate) is None
    for reason in get_args(Reason):
        for number in (0, 1, 9):
            advice = advice_for(estimate.model_copy(update={"reason": reason, "n_vehicles": number}))
            assert advice is not None
            assert "{" not in "".join(advice)
            assert "overlay" not in "".join(advice), "measure_distance has none"
