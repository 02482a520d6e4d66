"""``must_fit``: its probability over the posterior, its place, and what is refused."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from tests.models import pool_among_cars
from vehanchor import analyse_area, analyse_areas, measure_areas
from vehanchor.analysis.measurement_analysis import AreaAnalysis
from vehanchor.detection.detector import Detector
from vehanchor.errors import InvalidParameterError
from vehanchor.measure.fit import fit_probability, read_must_fit
from vehanchor.measure.scale_source import MeasurementScale
from vehanchor.options import ScaleOptions
from vehanchor.pictures.measurement import FIT_RGB
from vehanchor.records import AreaMeasurement
from vehanchor.records.measurement import Fit
from vehanchor.records.text import fit_in_words
from vehanchor.scale.density import lognormal
from vehanchor.scale.lengths import Spread
from vehanchor.segmentation.segmenter import Segmenter

IMAGE = np.full((400, 600, 3), 90, np.uint8)
# 200 x 100 px, 20 x 10 m.
ROOF = [(100, 100), (300, 100), (300, 200), (100, 200)]
GSD = 0.1


def _fit(must_fit: dict[str, float], shapes: Any = None, **options: Any) -> Fit:
    (record,) = measure_areas(
        IMAGE,
        [ROOF] if shapes is None else shapes,
        **{"gsd_m_per_px": GSD, "must_fit": must_fit, **options},
    )
    assert record.fit is not None
    return record.fit


def _scale(**fields: Any) -> MeasurementScale:
    usual: dict[str, Any] = {"gsd_m_per_px": GSD, "spread": Spread(0.1, 0.1), "confidence": 0.97}
    return MeasurementScale(**{**usual, "source": "estimated", **fields})


# --- The probability


def test_with_an_exact_scale_the_edge_alone_decides() -> None:
    # The edge is half a pixel either way in 95 % of cases.
    assert _fit({"diameter_m": 9.9}).fit_probability == pytest.approx(0.975, abs=0.02)
    assert _fit({"diameter_m": 10.0}).fit_probability == pytest.approx(0.5, abs=0.1)
    assert _fit({"diameter_m": 10.2}).fit_probability < 0.01
    assert _fit({"diameter_m": 10.0}, edge_px=20).fit_probability == pytest.approx(0.5, abs=0.02)


def test_a_larger_shape_is_never_more_probable() -> None:
    sizes = np.linspace(1, 15, 30)
    probabilities = [_fit({"diameter_m": size}).fit_probability for size in sizes]
    assert probabilities == sorted(probabilities, reverse=True)


def test_a_rectangle_may_be_given_either_way_round() -> None:
    one = _fit({"length_m": 15, "width_m": 5})
    assert one == _fit({"length_m": 5, "width_m": 15})
    assert (one.length_m, one.width_m) == (15, 5)


def test_the_whole_posterior_counts() -> None:
    # Half of the posterior is at a scale at which the shape does not fit.
    posterior = (lognormal(0.1, 0.02) + lognormal(0.02, 0.02)) / 2
    scale = _scale(posterior=posterior, confidence=0.99)
    assert fit_probability(5.0, 100.0, scale, 0.0) == pytest.approx(0.5, abs=0.01)
    assert fit_probability(1.0, 100.0, scale, 0.0) == 0.99


def test_the_probability_is_never_above_the_confidence() -> None:
    for posterior in (None, lognormal(0.1, 0.02)):
        scale = _scale(posterior=posterior, confidence=0.6)
        assert fit_probability(0.01, 100.0, scale, 0.0) <= 0.6


def test_without_a_posterior_the_interval_stands_for_it() -> None:
    exact = _scale(posterior=lognormal(0.1, 0.1), confidence=0.95)
    given_back = _scale(confidence=0.95)
    for narrowest_m in (7.0, 9.0, 10.0, 12.0):
        by_posterior = fit_probability(narrowest_m, 100.0, exact, 0.03)
        by_interval = fit_probability(narrowest_m, 100.0, given_back, 0.03)
        assert by_interval == pytest.approx(by_posterior, abs=0.03)


def test_what_the_confidence_leaves_out_counts_against_a_scale_given_back() -> None:
    sure = _scale(spread=Spread(0.02, 0.02), confidence=0.99)
    unsure = _scale(spread=Spread(0.02, 0.02), confidence=0.5)
    assert fit_probability(10.0, 100.0, unsure, 0.0) < fit_probability(10.0, 100.0, sure, 0.0)


@pytest.mark.parametrize("gsd", [0.05, 20.0], ids=["on the grid", "off the grid"])
def test_a_measured_scale_has_its_own_posterior(gsd: float) -> None:
    facts = {"gsd_m_per_px": gsd, "gsd_basis": "measured", "gsd_tolerance": 0.02 * gsd}
    options = ScaleOptions().with_keywords(facts)
    too_large = {"diameter_m": 300 * gsd}
    fit = _fit(too_large, [[100, 100, 300, 100, 300, 300, 100, 300]], options=options)
    assert fit.fit_probability < 0.1


def test_without_a_scale_nothing_fits() -> None:
    scale = MeasurementScale(gsd_m_per_px=None, spread=Spread(), confidence=0.0, source="estimated")
    assert fit_probability(1.0, 100.0, scale, 0.0) == 0
    fit = _fit({"length_m": 12, "width_m": 5}, gsd_m_per_px=None)
    assert (fit.fit_probability, fit.corners, fit.n_fits_at_least) == (0, (), 0)
    assert fit.center is not None


# --- The place


def test_a_rectangle_lies_along_the_roof() -> None:
    fit = _fit({"length_m": 15, "width_m": 5})
    assert fit.center is not None
    assert (fit.center.x_px, fit.center.y_px) == pytest.approx((200, 150), abs=2)
    assert fit.heading_deg == pytest.approx(90, abs=1)
    xs = [corner.x_px for corner in fit.corners]
    ys = [corner.y_px for corner in fit.corners]
    assert max(xs) - min(xs) == pytest.approx(150, abs=1)
    assert max(ys) - min(ys) == pytest.approx(50, abs=1)


@pytest.mark.parametrize(("length_m", "width_m", "n"), [(9.9, 4.9, 4), (6.5, 3.2, 9), (21, 5, 0)])
def test_rectangles_are_counted(length_m: float, width_m: float, n: int) -> None:
    assert _fit({"length_m": length_m, "width_m": width_m}).n_fits_at_least == n


def test_a_circle_has_a_centre_alone() -> None:
    fit = _fit({"diameter_m": 6})
    assert (fit.heading_deg, fit.corners, fit.n_fits_at_least) == (None, (), None)
    assert fit.center is not None
    assert 150 <= fit.center.x_px <= 250


def test_without_must_fit_there_is_no_fit() -> None:
    (record,) = measure_areas(IMAGE, [ROOF], gsd_m_per_px=GSD)
    assert record.fit is None


def test_a_height_moves_the_scale() -> None:
    # 10 m below a camera at 50 m, a pixel has four fifths of its metres.
    fit = _fit({"diameter_m": 8.3}, object_height_m=10, height_m=50)
    assert fit.fit_probability < 0.1
    assert _fit({"diameter_m": 8.3}, object_height_m=0, height_m=50).fit_probability > 0.9


# --- From cars


@pytest.fixture(scope="module")
def pool(detector: Detector, segmenter: Segmenter) -> AreaAnalysis:
    """A pool of 48 x 96 px at the scale of the vehicles around it."""
    return analyse_area(
        pool_among_cars(),
        box=(410.7, 273.9, 477.3, 382.1),
        detector=detector,
        segmenter=segmenter,
        rulers=("vehicles",),
        must_fit={"length_m": 5, "width_m": 2},
    )


def test_an_estimated_scale_bounds_the_probability(pool: AreaAnalysis) -> None:
    record = pool.measurement
    assert record.fit is not None
    assert record.scale_confidence is not None
    assert 0.9 < record.fit.fit_probability <= record.scale_confidence


def _again(pool: AreaAnalysis, **options: Any) -> AreaMeasurement:
    window = pool.segmentation.window
    mask = np.zeros((pool.measurement.image_height_px, pool.measurement.image_width_px), bool)
    rows = slice(window.y_px, window.y_px + window.height_px)
    columns = slice(window.x_px, window.x_px + window.width_px)
    mask[rows, columns] = pool.segmentation.mask
    (record,) = measure_areas(pool_among_cars(), mask, **options)
    return record


def test_a_scale_given_back_has_about_the_same_probability(
    pool: AreaAnalysis, detector: Detector
) -> None:
    size = {"diameter_m": (pool.measurement.inscribed_diameter_m or 0) * 0.9}
    now = _again(pool, detector=detector, rulers=("vehicles",), must_fit=size).fit
    reused = _again(pool, scale=pool.measurement.scale, must_fit=size).fit
    assert now is not None
    assert reused is not None
    assert reused.fit_probability == pytest.approx(now.fit_probability, abs=0.06)


def test_the_overlay_shows_the_shape(pool: AreaAnalysis) -> None:
    overlay = pool.overlay()
    assert (overlay == FIT_RGB).all(axis=2).sum() > 50


def test_the_overlay_shows_a_circle() -> None:
    (analysis,) = analyse_areas(IMAGE, [ROOF], gsd_m_per_px=GSD, must_fit={"diameter_m": 6})
    green = (analysis.overlay() == FIT_RGB).all(axis=2)
    ys, xs = np.nonzero(green)
    assert np.ptp(xs) == pytest.approx(np.ptp(ys), rel=0.05)


def test_a_doubtful_mask_bounds_the_probability(detector: Detector, tmp_path: Any) -> None:
    from tests.sam_models import write_sam

    (tmp_path / "low").mkdir()
    low = write_sam(tmp_path / "low", scores=(0.4,))
    record = analyse_area(
        pool_among_cars(),
        box=(410.7, 273.9, 477.3, 382.1),
        segmenter=low,
        gsd_m_per_px=0.1,
        must_fit={"diameter_m": 1},
    ).measurement
    assert record.status == "low_confidence"
    assert record.fit is not None
    assert record.fit.fit_probability <= 0.4 + 1e-6


# --- Words and errors


def test_a_probability_is_never_rounded_up() -> None:
    fit = Fit(fit_probability=0.899, length_m=12, width_m=5, n_fits_at_least=3)
    text = fit_in_words(fit)
    assert text.startswith("12 x 5 m fits with probability 0.89, at least 3 in rows")
    circle = Fit(fit_probability=0.5, diameter_m=8)
    assert fit_in_words(circle) == "a circle of 8 m fits with probability 0.50"


def test_without_a_scale_nobody_knows_whether_it_fits() -> None:
    fit = Fit(fit_probability=0.0, length_m=12, width_m=5)
    words = fit_in_words(fit, has_scale=False)
    assert words == "whether 12 x 5 m fits is unknown without a scale"


@pytest.mark.parametrize(
    ("must_fit", "message"),
    [
        (12, 'give {"diameter_m": 12}'),
        ({}, "has no size"),
        ({"diameter_m": 0}, "use 0.001 to 100000 metres"),
        ({"length_m": 1e-200, "width_m": 1e-200}, "use 0.001 to 100000 metres"),
        ({"diameter_m": math.nan}, "use 0.001 to 100000 metres"),
        ({"diameter_m": True}, "use 0.001 to 100000 metres"),
        ({"diameter_m": "12"}, "use 0.001 to 100000 metres"),
        ({"length_m": 12}, "has length_m"),
        ({"length_m": 12, "width_m": 5, "diameter_m": 3}, "has length_m, width_m, diameter_m"),
        ({"radius_m": 12}, "has radius_m"),
    ],
)
def test_bad_shapes_to_fit_are_refused(must_fit: Any, message: str) -> None:
    with pytest.raises(InvalidParameterError, match=message):
        read_must_fit(must_fit)


def test_values_of_none_are_left_out() -> None:
    shape = read_must_fit({"diameter_m": 3.0, "length_m": None, "width_m": None})
    assert shape == read_must_fit({"diameter_m": 3})
