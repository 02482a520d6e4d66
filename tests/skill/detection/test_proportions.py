"""Stretched images, and images unlike a clear day at nadir: refused, or right."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from research.scenes.render import render_scene
from tests.conftest import ROOT
from vehanchor import estimate_gsd
from vehanchor.detection.detector import load_detector
from vehanchor.detection.detector_errors import StretchLimits
from vehanchor.detection.proportions import stretch_of_few
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.models.zoo import resolve_model

_GSD = 0.1
_BARREL = 0.35  # share of the squared distance from the centre, in half sides
_Image = NDArray[np.uint8]


def _resized(image: _Image, across: float, down: float) -> _Image:
    size = (round(image.shape[1] * across), round(image.shape[0] * down))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def test_a_stretched_image_is_refused_with_the_reason(car_park: _Image) -> None:
    estimate = estimate_gsd(_resized(car_park, 1.0, 1.5))
    assert estimate.status != "ok"
    assert estimate.reason == "disagree"
    assert "stretched" in {notice.code for notice in estimate.warnings}


def _few_cars() -> _Image:
    picture = cv2.imread(str(ROOT / "examples/car_park.jpg"))
    assert picture is not None
    return np.ascontiguousarray(picture[:260, 400:660, ::-1], dtype=np.uint8)


def test_few_cars_are_enough_for_a_scale() -> None:
    estimate = estimate_gsd(_few_cars())
    assert (estimate.status, estimate.n_vehicles) == ("ok", 4)


def test_few_cars_show_a_stretch() -> None:
    stretched = estimate_gsd(_resized(_few_cars(), 1.0, 1.5))
    assert (stretched.status, stretched.reason) == ("low_confidence", "disagree")


@pytest.mark.slow
def test_a_scale_does_not_hide_a_stretch(car_park: _Image) -> None:
    estimate = estimate_gsd(
        _resized(car_park, 1.5, 1.0), known_lengths=[(100, 100, 400, 100, 30.0)]
    )
    assert estimate.status != "ok"


def _grey(image: _Image) -> _Image:
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB), np.uint8)


def _noisy(image: NDArray[np.float64], sd: float) -> _Image:
    noise = np.random.default_rng(0).normal(0, sd, image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8)


def _fisheye(image: _Image) -> _Image:
    """Distort like a wide lens: the centre has 0.6 of the scale, the corners are kept."""
    height, width = image.shape[:2]
    y, x = np.mgrid[:height, :width].astype(np.float32)
    along = (x - width / 2) / (width / 2)
    down = (y - height / 2) / (height / 2)
    factor = (1 + _BARREL * (along**2 + down**2)) / (1 + 2 * _BARREL)
    columns = (along * factor + 1) * width / 2
    rows = (down * factor + 1) * height / 2
    return np.asarray(cv2.remap(image, columns, rows, cv2.INTER_LINEAR), np.uint8)


def _mean_scale_of_fisheye() -> float:
    """Compute the root of the mean area of a pixel, by the determinant of the distortion."""
    along, down = np.meshgrid(*[np.linspace(-1, 1, 400)] * 2)
    squared = along**2 + down**2
    areas = (1 + _BARREL * squared) * (1 + 3 * _BARREL * squared) / (1 + 2 * _BARREL) ** 2
    return float(np.sqrt(areas.mean()))


def _thermal(image: _Image) -> _Image:
    return 255 - cv2.GaussianBlur(_grey(image), (0, 0), 1.2).astype(np.uint8)


def _night(image: _Image) -> _Image:
    return _noisy(0.12 * image.astype(np.float64), 6.0)


def _snow(image: _Image) -> _Image:
    return np.clip(170 + 0.4 * image.astype(np.float64), 0, 255).astype(np.uint8)


def _haze(image: _Image) -> _Image:
    blurred = cv2.GaussianBlur(image, (0, 0), 1.0).astype(np.float64)
    return _noisy(130 + 0.25 * blurred, 1.5)


CONDITIONS: dict[str, Callable[[_Image], _Image]] = {
    "thermal": _thermal,
    "night": _night,
    "snow": _snow,
    "haze": _haze,
    "fisheye": _fisheye,
}


@pytest.fixture(scope="module")
def photograph() -> _Image:
    return render_scene(
        _GSD, width_px=900, height_px=900, seed=9011, mean_vehicle_length_m=4.4, layout="parking"
    ).image


@pytest.mark.slow
@pytest.mark.parametrize("condition", CONDITIONS)
def test_an_unusual_image_is_refused_or_right(photograph: _Image, condition: str) -> None:
    estimate = estimate_gsd(CONDITIONS[condition](photograph))
    true = _GSD * (_mean_scale_of_fisheye() if condition == "fisheye" else 1)
    assert estimate.status != "ok" or estimate.gsd_m_per_px == pytest.approx(true, rel=0.2)


def _few_stretch(limits: StretchLimits, headings: list[float]) -> float | None:
    """Stretch by three vehicles at the places of cars, in an image that is too wide."""
    boxes = np.array([[60.0 + 60 * k, 130.0, 40.0, 16.0, at] for k, at in enumerate(headings)])
    chips = load_detector(resolve_model()).chips
    assert chips is not None
    with open_raster(_resized(_few_cars(), 1.5, 1.0)) as raster:
        return stretch_of_few(raster, boxes, chips, limits)


@pytest.mark.parametrize(
    ("limit", "headings"),
    [("few_parallel_limit", [0.1, 0.1, 0.1]), ("few_crossed_limit", [0.1, 1.6, 0.1, 1.6])],
)
def test_the_limits_of_few_cars_are_the_detectors(limit: str, headings: list[float]) -> None:
    limits = StretchLimits()
    twice = limits.model_copy(update={limit: 2 * getattr(limits, limit)})
    share = _few_stretch(limits, headings)
    assert share
    assert _few_stretch(twice, headings) == pytest.approx(share / 2)
