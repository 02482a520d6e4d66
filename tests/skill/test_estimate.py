"""Estimates of painted cars: the paper's equations, options, frames and georeferences."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from affine import Affine

import vehanchor
from tests.models import blank_image, car_park, fleet
from tests.skill.imagery.files import geotiff
from vehanchor import analyse_scale, estimate_gsd
from vehanchor.detection.detector import Detector
from vehanchor.errors import FrameError
from vehanchor.options import ScaleOptions

if TYPE_CHECKING:
    from pathlib import Path

    from vehanchor.analysis.scale_analysis import ScaleAnalysis
    from vehanchor.records import GsdEstimate


# The scene-scale prior does not know painted pictures.
ALONE: dict[str, Any] = {"rulers": ("vehicles",)}


@pytest.fixture(scope="module")
def analysis(detector: Detector) -> ScaleAnalysis:
    """Thirty cars, and one of 70 px, which is beyond 1.5 times the median."""
    image = car_park([*fleet(30), 70.0])
    return analyse_scale(image, ScaleOptions.of(ALONE), detector=detector)


@pytest.fixture(scope="module")
def estimate(analysis: ScaleAnalysis) -> GsdEstimate:
    """The record of the cars."""
    return analysis.estimate


def test_the_outlier_filter_drops_the_long_vehicle(analysis: ScaleAnalysis) -> None:
    estimate = analysis.estimate
    assert (estimate.details.n_detections, estimate.n_vehicles) == (31, 30)
    assert analysis.kept.sum() == 30
    assert analysis.detections.boxes[~analysis.kept, 2] == pytest.approx([70.0])


def test_the_vehicles_scale_is_the_papers(estimate: GsdEstimate) -> None:
    assert estimate.mode_length_px is not None
    assert estimate.mode_length_px == pytest.approx(30.0, abs=0.1)
    assert estimate.rulers[0].gsd_m_per_px == 5.045 / estimate.mode_length_px


def test_the_value_of_vehicles_alone_is_near_the_papers(estimate: GsdEstimate) -> None:
    assert estimate.mode_length_px is not None
    assert estimate.gsd_m_per_px == pytest.approx(5.045 / estimate.mode_length_px, rel=0.03)


def test_the_interval_holds_the_value(estimate: GsdEstimate) -> None:
    assert estimate.gsd_m_per_px is not None
    assert estimate.gsd_ci95_low_m_per_px is not None
    assert estimate.gsd_ci95_high_m_per_px is not None
    assert estimate.gsd_ci95_low_m_per_px < estimate.gsd_m_per_px
    assert estimate.gsd_m_per_px < estimate.gsd_ci95_high_m_per_px


def test_the_composite_confidence_is_the_papers_weighted_sum(estimate: GsdEstimate) -> None:
    terms = estimate.details.confidence_terms
    assert terms is not None
    total = (
        0.35 * terms.sample
        + 0.35 * terms.concentration
        + 0.20 * terms.quality
        + 0.10 * terms.plausibility
    )
    assert estimate.details.composite_confidence == pytest.approx(total)


def test_thirty_cars_are_usable(estimate: GsdEstimate) -> None:
    assert estimate.status == "ok"
    assert estimate.details.aggregation == "kde"
    assert estimate.details.resolution_guard is False


def test_the_record_names_its_image_with_its_model(
    estimate: GsdEstimate, detector: Detector
) -> None:
    assert (estimate.image_width_px, estimate.image_height_px) == (480, 360)
    assert estimate.model == "painted"
    assert estimate.details.model_sha256 == detector.card.sha256


@pytest.mark.promise("no-guess")
def test_no_vehicles_mean_no_scale(detector: Detector) -> None:
    estimate = estimate_gsd(blank_image(200, 100), detector=detector)
    assert (estimate.status, estimate.gsd_m_per_px) == ("no_scale", None)
    assert (estimate.mode_length_px, estimate.n_vehicles) == (None, 0)
    assert (estimate.gsd_ci95_low_m_per_px, estimate.gsd_ci95_high_m_per_px) == (None, None)
    assert "NaN" not in estimate.model_dump_json()


@pytest.mark.promise("no-guess")
def test_no_vehicles_mean_no_confidence(detector: Detector) -> None:
    assert estimate_gsd(blank_image(200, 100), detector=detector).confidence == 0.0


def _estimate_with(detector: Detector, **options: Any) -> GsdEstimate:
    """Estimate of thirty cars and a long vehicle of a low score."""
    image = car_park([*fleet(30), 70.0], scores=[0.9] * 30 + [0.2])
    return estimate_gsd(image, detector=detector, **ALONE, **options)


def test_without_a_factor_the_long_vehicle_is_kept(detector: Detector) -> None:
    assert _estimate_with(detector, alpha=None).n_vehicles == 31


def test_the_aggregation_can_be_the_mean(detector: Detector) -> None:
    estimate = _estimate_with(detector, aggregation="mean", alpha=None)
    assert estimate.mode_length_px == pytest.approx(np.mean([*fleet(30), 70.0]), abs=0.01)


def test_a_given_reference_length_near_the_models_moves_the_scale(detector: Detector) -> None:
    without = _estimate_with(detector)
    guess = _estimate_with(detector, reference_length_m=4.8)
    assert without.gsd_m_per_px is not None
    assert guess.gsd_m_per_px is not None
    assert 4.8 / 30 < guess.gsd_m_per_px < without.gsd_m_per_px


def test_a_given_reference_length_that_no_car_has_is_named(detector: Detector) -> None:
    without = _estimate_with(detector)
    guess = _estimate_with(detector, reference_length_m=9.0)
    assert guess.gsd_m_per_px == pytest.approx(without.gsd_m_per_px, rel=0.01)
    assert "reference_length_unlikely" in [warning.code for warning in guess.warnings]


def test_the_paper_takes_a_given_reference_length(detector: Detector) -> None:
    estimate = _estimate_with(detector, preset="paper")
    assert estimate.gsd_m_per_px == pytest.approx(5.045 / 30, rel=0.01)


def test_the_region_gives_the_reference_length(detector: Detector) -> None:
    estimate = _estimate_with(detector, region="europe")
    assert estimate.details.reference_length_m == pytest.approx(4.5)


def test_the_size_of_the_tiles_does_not_change_the_mode(detector: Detector) -> None:
    tiled = _estimate_with(detector, tile_px=128, stride_px=64)
    assert tiled.mode_length_px == pytest.approx(_estimate_with(detector).mode_length_px)


def _estimate_in_frame(detector: Detector, frame: tuple[int, int]) -> GsdEstimate:
    """Estimate of an image of 480 x 360 px, for a copy of another size."""
    return estimate_gsd(car_park(fleet(30)), detector=detector, **ALONE, frame=frame)


def test_the_frame_gives_the_scale_of_the_callers_copy(detector: Detector) -> None:
    estimate = _estimate_in_frame(detector, (240, 180))
    frame = estimate.frame
    assert frame is not None
    assert estimate.gsd_m_per_px is not None
    assert estimate.gsd_ci95_low_m_per_px is not None
    assert frame.gsd_m_per_px == pytest.approx(2 * estimate.gsd_m_per_px)
    assert frame.gsd_ci95_low_m_per_px == pytest.approx(2 * estimate.gsd_ci95_low_m_per_px)


def test_a_frame_may_be_rounded(detector: Detector) -> None:
    assert _estimate_in_frame(detector, (333, 250)).frame is not None


def test_a_frame_of_another_shape_is_refused(detector: Detector) -> None:
    with pytest.raises(FrameError, match="180"):
        _estimate_in_frame(detector, (240, 240))


def test_without_a_scale_the_frame_has_none(detector: Detector) -> None:
    empty = estimate_gsd(blank_image(480, 360), detector=detector, **ALONE, frame=(240, 180))
    assert empty.frame is not None
    assert empty.frame.gsd_m_per_px is None


@pytest.fixture(scope="module")
def plain(detector: Detector) -> GsdEstimate:
    """Estimate of thirty cars without a georeference."""
    return estimate_gsd(car_park(fleet(30)), detector=detector, **ALONE)


def _estimate_georeferenced(
    folder: Path, detector: Detector, plain: GsdEstimate, *, factor: float
) -> GsdEstimate:
    """Estimate of the same cars, with a georeference of a multiple of their scale."""
    assert plain.gsd_m_per_px is not None
    gsd = plain.gsd_m_per_px * factor
    transform = Affine(gsd, 0, 500_000, 0, -gsd, 5_000_000)
    path = geotiff(folder / "cars.tif", car_park(fleet(30)), transform=transform)
    return estimate_gsd(path, detector=detector, **ALONE)


@pytest.mark.parametrize(("factor", "codes"), [(1.05, []), (1.3, ["georeference_differs"])])
def test_a_georeference_that_disagrees_gives_a_warning(
    tmp_path: Path, detector: Detector, plain: GsdEstimate, factor: float, codes: list[str]
) -> None:
    estimate = _estimate_georeferenced(tmp_path, detector, plain, factor=factor)
    assert [warning.code for warning in estimate.warnings] == codes


@pytest.mark.parametrize("factor", [1.05, 1.3])
def test_a_georeference_does_not_change_the_scale(
    tmp_path: Path, detector: Detector, plain: GsdEstimate, factor: float
) -> None:
    estimate = _estimate_georeferenced(tmp_path, detector, plain, factor=factor)
    assert estimate.gsd_m_per_px == plain.gsd_m_per_px


def test_the_record_shows_the_georeference(
    tmp_path: Path, detector: Detector, plain: GsdEstimate
) -> None:
    estimate = _estimate_georeferenced(tmp_path, detector, plain, factor=1.05)
    assert plain.gsd_m_per_px is not None
    assert estimate.georeference_gsd_m_per_px == pytest.approx(plain.gsd_m_per_px * 1.05)


def test_the_same_image_gives_the_same_bytes_with_any_number_of_threads(
    detector: Detector,
) -> None:
    image = car_park(fleet(40), height_px=480)
    records = {
        analyse_scale(
            image, ScaleOptions.of({"tile_px": 256}), detector=detector.path, threads=n
        ).estimate.model_dump_json()
        for n in (1, 2)
    }
    assert len(records) == 1
    assert json.loads(records.pop())["status"] == "ok"


@pytest.mark.parametrize("name", vehanchor.__all__)
def test_a_public_name_exists(name: str) -> None:
    assert getattr(vehanchor, name) is not None


def test_the_package_lists_its_public_names() -> None:
    assert dir(vehanchor) == sorted(vehanchor.__all__)


def test_the_package_has_no_other_names() -> None:
    with pytest.raises(AttributeError, match="utils"):
        vehanchor.utils  # noqa: B018
