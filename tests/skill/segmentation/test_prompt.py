from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from vehanchor.errors import InvalidParameterError, PromptError
from vehanchor.options import Frame
from vehanchor.segmentation.prompt import MIN_BOX_PX, Prompt, prompt_in_image, read_prompt

WHOLE = Frame()


def test_a_box_or_points_are_read_as_numbers() -> None:
    assert read_prompt((1, np.float32(2), "3", 4.5), None) == Prompt(box=(1.0, 2.0, 3.0, 4.5))  # type: ignore[arg-type]
    assert read_prompt(None, [(1, 2), (3, 4, False), (5, 6, True)]) == Prompt(
        points=((1.0, 2.0, True), (3.0, 4.0, False), (5.0, 6.0, True))
    )


@pytest.mark.parametrize(
    ("box", "points", "message"),
    [
        (None, None, "neither is given"),
        (None, [], "neither is given"),
        ((0, 0, 5, 5), [(1, 1)], "both are given"),
        (5, None, "box is 5: use x1, y1, x2, y2"),
        (None, 5, "points is 5: use one or more of x, y"),
        (None, [5], "a point is 5: use x, y"),
        ((0, 0, 5), None, "3 numbers"),
        ((0, 0, 5, 5, 5), None, "5 numbers"),
        ((5, 0, 5, 5), None, "reversed or empty"),
        ((0, 6, 5, 5), None, "reversed or empty"),
        ((0, 0, float("nan"), 5), None, "finite"),
        ((0, 0, float("inf"), 5), None, "finite"),
        ((0, 0, "wide", 5), None, "use numbers"),
        ((0, 0, None, 5), None, "use numbers"),
        (None, [(1,)], "1 parts"),
        (None, [(1, 2, True, 4)], "4 parts"),
        (None, [(1, float("nan"))], "finite"),
        (None, [(1, 2, False)], "no point is on the object"),
    ],
)
def test_what_names_nothing_in_any_image_is_refused(box: Any, points: Any, message: str) -> None:
    with pytest.raises(PromptError, match=message) as caught:
        read_prompt(box, points)
    assert caught.value.code == "invalid_prompt"
    assert isinstance(caught.value, InvalidParameterError)


def test_a_prompt_in_the_callers_frame_is_scaled_to_the_image() -> None:
    frame = Frame(width_px=100, height_px=50)
    box = prompt_in_image(Prompt(box=(10.0, 5.0, 20.0, 25.0)), frame, 400, 200)
    assert box == Prompt(box=(40.0, 20.0, 80.0, 100.0))
    points = prompt_in_image(Prompt(points=((10.0, 5.0, True), (99.5, 49.5, False))), frame, 400, 200)
    assert points == Prompt(points=((40.0, 20.0, True), (398.0, 198.0, False)))


def test_a_box_that_rounding_took_over_the_edge_is_pulled_in() -> None:
    assert prompt_in_image(Prompt(box=(-0.9, -0.5, 60.9, 40.3)), WHOLE, 60, 40) == Prompt(box=(0.0, 0.0, 60.0, 40.0))
    framed = prompt_in_image(Prompt(box=(-0.9, 0.0, 30.9, 20.0)), Frame(width_px=30, height_px=20), 60, 40)
    assert framed == Prompt(box=(0.0, 0.0, 60.0, 40.0))


@pytest.mark.parametrize(
    ("prompt", "frame", "message"),
    [
        (Prompt(box=(-1.0, 0.0, 30.0, 30.0)), WHOLE, "box -1, 0, 30, 30 is not inside the 60 x 40 px image"),
        (Prompt(box=(0.0, 0.0, 61.0, 30.0)), WHOLE, "60 x 40 px image"),
        (Prompt(box=(0.0, 0.0, 32.0, 10.0)), Frame(width_px=30, height_px=20), "30 x 20 px frame"),
        (Prompt(box=(3.0, 3.0, 4.9, 30.0)), WHOLE, f"at least {MIN_BOX_PX:g} px a side"),
        (Prompt(box=(59.0, 3.0, 60.9, 30.0)), WHOLE, f"at least {MIN_BOX_PX:g} px a side"),
        (Prompt(points=((5.0, 5.0, True), (60.0, 5.0, True))), WHOLE, "point 60, 5 is not inside"),
        (Prompt(points=((-0.1, 5.0, True),)), WHOLE, "point -0.1, 5 is not inside"),
    ],
)
def test_what_names_nothing_in_this_image_is_refused(prompt: Prompt, frame: Frame, message: str) -> None:
    with pytest.raises(PromptError, match=message):
        prompt_in_image(prompt, frame, 60, 40)
