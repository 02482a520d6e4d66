from __future__ import annotations

import cv2
import numpy as np
import pytest

from tests.skill.courts.drawing import draw_court
from vehanchor.courts.match import Pose, Reach, match, ridges
from vehanchor.courts.template import TENNIS


def test_the_score_is_the_share_of_the_lines_that_are_there_less_that_of_those_that_should_not_be() -> None:
    image = cv2.cvtColor(draw_court(TENNIS, 0.25, degrees=0.0, side_px=256, missing=(0, 5)), cv2.COLOR_RGB2GRAY)
    image[150:154, 60:190] = 200  # where no line should be
    grey = image.astype(np.float32)
    reach = Reach(0.0, 1.0, 0.04, 0.02, 6, 2)
    ((score, pose),) = match(grey, [TENNIS], Pose(130.0, 124.0, 0.0, 4.0), reach)
    assert (pose.x, pose.y) == pytest.approx((127.5, 127.5), abs=1.5)
    along, across = ridges(grey)
    seen = {True: cv2.dilate(along, np.ones((3, 1))), False: cv2.dilate(across, np.ones((1, 3)))}
    laid = 0.0
    for lines, sign in ((TENNIS.lines, 1), (TENNIS.blank, -1)):
        whole = sum(line.length_m for line in lines)
        for line in lines:
            x1, y1, x2, y2 = (round(metres * pose.px_per_m) for metres in line)
            column, row = round(pose.x), round(pose.y)
            pixels = seen[line.y1 == line.y2][row + y1 : row + y2 + 1, column + x1 : column + x2 + 1]
            laid += sign * line.length_m / whole * float(pixels.mean())
    assert score == pytest.approx(laid, abs=1e-4)
    assert 0.3 < score < 0.9
