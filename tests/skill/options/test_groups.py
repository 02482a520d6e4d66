from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vehanchor
from vehanchor.errors import InvalidParameterError
from vehanchor.options import Reference, ScaleOptions

_IMAGE = np.zeros((64, 64, 3), np.uint8)


@pytest.mark.parametrize(
    "keywords",
    [
        {"min_score": np.float32(-5)},
        {"min_score": "much"},
        {"min_score": float("nan")},
        {"nms_iou": 1.5},
        {"stride_px": 300.7},
        {"tile_px": 0},
        {"tile_px": True},
        {"search_scales": 1},
        {"alpha": 0.5},
        {"aggregation": "modal"},
        {"reference_length_m": True},
        {"reference_length_m": "4.5 kg"},
        {"reference_length_m": 0.01},
        {"reference_length_m": 1.99},
        {"reference_length_m": 20.01},
        {"reference_length_m": float("inf")},
        {"reference_length_m": 4.5, "region": "europe"},
        {"frame": (320.5, 240)},
        {"frame": 320},
        {"coordinates": "percent"},
        {"bgr": 1},
        {"max_megapixels": 0},
        {"bands": (1, 2)},
        {"bands": (0, 1, 2)},
        {"scale": 3},
        {"rulers": ("vehicles", "yardstick")},
        {"rulers": ()},
        {"metadata": 1},
        {"known_lengths": [(0, 0, 1, 0, 5)]},
        {"known_lengths": [(0, 0, 30, 0, 0)]},
        {"known_lengths": [(0, 0, 30, 0, float("inf"))]},
        {"known_lengths": [(0, 0, 30, 0)]},
        {"height_m": 0},
        {"height_m": -40},
        {"height_m": 1e6},
        {"focal_35mm": 24, "metadata": False},
        {"focal_35mm": 0, "height_m": 40},
        {"region": ["europe"]},
        {"region": 5},
        {"rulers": 5},
        {"rulers": [["vehicles"]]},
        {"known_lengths": 5},
        {"limits": {}},
        {"calibration": 5},
    ],
)
def test_a_value_without_meaning_is_refused_before_any_work(keywords: dict[str, Any]) -> None:
    with pytest.raises(InvalidParameterError) as refused:
        vehanchor.estimate_gsd(_IMAGE, detector="nowhere.onnx", **keywords)
    assert next(iter(keywords)).removeprefix("frame_").rstrip("s").replace("known_length", "") in str(refused.value)


def test_numbers_of_any_library_come_out_as_pythons() -> None:
    options = ScaleOptions.of({"min_score": np.float32(0.25), "tile_px": np.int64(512), "frame": (640.0, 480)})
    assert (type(options.search.min_score), options.search.min_score) == (float, 0.25)
    assert (type(options.search.tile_px), options.search.tile_px) == (int, 512)
    assert options.frame.size == (640, 480)


def test_a_filter_that_keeps_typical_vehicles_is_taken() -> None:
    assert ScaleOptions.of({"alpha": 1}).lengths.alpha == 1.0
    assert ScaleOptions.of({"alpha": None}).lengths.alpha is None


def test_a_calibration_is_read_from_its_file_at_once(tmp_path: Path) -> None:
    with pytest.raises(vehanchor.VehAnchorError, match="cannot read calibration"):
        Reference(calibration=str(tmp_path / "none.json"))  # type: ignore[arg-type]
