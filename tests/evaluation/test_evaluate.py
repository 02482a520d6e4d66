from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from tests.models import blank_image, paint_vehicles, write_detector
from vehanchor.detection.detector import Detector
from vehanchor_evaluation.dota import parse_labels, read_labels
from vehanchor_evaluation.gsd import run_trials, summarise
from vehanchor_evaluation.known_scale import KnownScaleImage


def test_dota_labels_are_read_with_their_header() -> None:
    labels = parse_labels(
        "imagesource:GoogleEarth\ngsd:0.146\n"
        "1 2 11 2 11 6 1 6 small-vehicle 0\n20 20 40 20 40 28 20 28 large-vehicle 1\n\n0 0 4 0 4 2 0 2 ship\n"
    )
    assert labels.gsd_m_per_px == 0.146
    assert labels.classes == ("small-vehicle", "large-vehicle", "ship")
    assert labels.difficult.tolist() == [False, True, False]
    assert labels.of_class("small-vehicle").tolist() == [[[1, 2], [11, 2], [11, 6], [1, 6]]]
    assert labels.of_class("plane").shape == (0, 4, 2)


@pytest.mark.parametrize("header", ["", "gsd:None\n", "gsd:\n", "gsd:nan\n", "gsd:-1\n"])
def test_a_missing_or_useless_gsd_is_none(header: str) -> None:
    assert parse_labels(header).gsd_m_per_px is None


@pytest.mark.parametrize("line", ["1 2 3", "a b c d e f g h car 0", "1 2 3 4 5 6 7 nan car 0", "gsd:wide"])
def test_a_malformed_line_is_named(tmp_path: Path, line: str) -> None:
    path = tmp_path / "P0001.txt"
    path.write_text(f"imagesource:x\n{line}\n")
    with pytest.raises(ValueError, match=r"P0001\.txt.*line 2"):
        read_labels(path)


def test_trials_count_a_missing_estimate_as_a_whole_error(tmp_path: Path) -> None:
    import cv2

    image = blank_image(480, 300)
    paint_vehicles(image, [[40 + 70 * (k % 6), 50 + 60 * (k // 6), 30, 12, 0.4] for k in range(24)])
    cv2.imwrite(str(tmp_path / "cars.png"), image[:, :, ::-1])
    cv2.imwrite(str(tmp_path / "none.png"), blank_image(200, 200))
    truth = 5.045 / 30
    images = [KnownScaleImage(tmp_path / "cars.png", truth * 1.3), KnownScaleImage(tmp_path / "none.png", truth)]
    trials = list(run_trials(images, Detector(write_detector(tmp_path / "m.onnx"))))
    assert trials[0].signed_error == pytest.approx(1 / 1.3 - 1, abs=3e-3)
    assert trials[0].covered is False
    assert math.isnan(trials[1].signed_error)
    assert (trials[1].error, trials[1].covered) == (1.0, None)
    summary = summarise(trials)
    assert summary == pytest.approx((2, 0.5, 1 - 0.5 / 1.3, 1 - 0.5 / 1.3, 0.0, 0.0, 1 / 1.3 - 1), abs=3e-3)
    assert summarise([]).images == 0
    assert np.isnan(summarise([]).median)
