"""Searches of large images that end early; a lower limit makes small images large."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tests.models import blank_image, paint_vehicles, write_detector
from vehanchor import analyse_scale, estimate_gsd
from vehanchor.detection.detector import Detector

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from vehanchor.analysis.scale_analysis import ScaleAnalysis
    from vehanchor.records import GsdEstimate

_SEARCHING = {
    "vehanchor.length_range_px": "9,64",
    "vehanchor.search_scales": "1",
    "vehanchor.reference_length_sd_m": "0.5",  # so that hundreds of vehicles do, not thousands
}
_LARGE_PIXELS = (
    "detection.scheduler.LARGE_PIXELS",
    "detection.search.LARGE_PIXELS",
    "analysis.convergence.LARGE_PIXELS",
)
_TILES: dict[str, Any] = {"tile_px": 160, "stride_px": 120}


@pytest.fixture(scope="module")
def detector(tmp_path_factory: pytest.TempPathFactory) -> Detector:
    return Detector(
        write_detector(tmp_path_factory.mktemp("model") / "m.onnx", metadata=_SEARCHING)
    )


@pytest.fixture(scope="module", autouse=True)
def _large() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patches:
        for name in ("detection.scheduler.ANYTIME_PIXELS", *_LARGE_PIXELS):
            patches.setattr(f"vehanchor.{name}", 500_000)
        yield


@pytest.fixture(scope="module")
def searched(detector: Detector, _large: None) -> dict[str, ScaleAnalysis]:
    """The town, searched in full and until the search ends by itself."""
    return {
        effort: analyse_scale(_town(), detector=detector, effort=effort, **_TILES)
        for effort in ("full", "auto", "fast")
    }


def _town(spread: float = 0.07, seed: int = 0) -> NDArray[np.uint8]:
    """A picture of 1100 x 900 px, a third of it full of cars of 30 px, the rest empty."""
    rng = np.random.default_rng(seed)
    image = blank_image(1100, 900)
    grid = np.stack(np.meshgrid(np.arange(461, 1060, 32), np.arange(30, 610, 24)), axis=-1).reshape(
        -1, 2
    )
    n = len(grid)
    lengths = 30 * np.exp(rng.normal(0, spread, n))
    paint_vehicles(image, np.column_stack([grid, lengths, np.full(n, 12.0), np.full(n, 0.4)]))
    return image


def test_a_full_search_visits_all_tiles(searched: dict[str, ScaleAnalysis]) -> None:
    details = searched["full"].estimate.details
    assert details.tiles_searched == details.tiles_total
    assert details.stopped_because == "all_searched"


def test_auto_ends_before_all_tiles_are_searched(searched: dict[str, ScaleAnalysis]) -> None:
    details = searched["auto"].estimate.details
    assert details.stopped_because == "converged"
    assert details.tiles_total == searched["full"].estimate.details.tiles_total
    assert details.tiles_searched < 0.6 * details.tiles_total


def test_auto_gives_the_scale_of_a_full_search(searched: dict[str, ScaleAnalysis]) -> None:
    full = searched["full"].estimate
    auto = searched["auto"].estimate
    assert auto.status == full.status == "ok"
    assert auto.gsd_m_per_px == pytest.approx(full.gsd_m_per_px, rel=0.02)


def test_auto_measures_fewer_vehicles_than_a_full_search(
    searched: dict[str, ScaleAnalysis],
) -> None:
    full = searched["full"].estimate
    auto = searched["auto"].estimate
    assert (full.n_vehicles or 0) > (auto.n_vehicles or 0) > 100


def test_fast_searches_fewer_tiles_than_auto(searched: dict[str, ScaleAnalysis]) -> None:
    fast = searched["fast"].estimate.details
    assert fast.tiles_searched < searched["auto"].estimate.details.tiles_searched


@pytest.fixture
def _photograph(monkeypatch: pytest.MonkeyPatch) -> None:
    """Raise the limit, so that the town counts as a photograph."""
    for name in _LARGE_PIXELS:
        monkeypatch.setattr(f"vehanchor.{name}", 100_000_000)


@pytest.mark.usefixtures("_photograph")
def test_a_photograph_ends_when_the_other_tiles_would_not_change_its_value(
    detector: Detector, searched: dict[str, ScaleAnalysis]
) -> None:
    full = searched["full"].estimate
    auto = estimate_gsd(_town(), detector=detector, **_TILES)
    assert full.details.stopped_because == "all_searched"
    assert auto.details.stopped_because == "converged"
    assert auto.details.tiles_searched < 0.6 * full.details.tiles_searched
    assert (auto.status, auto.reason) == (full.status, full.reason) == ("ok", None)
    assert auto.gsd_m_per_px == pytest.approx(full.gsd_m_per_px, rel=0.02)


@pytest.mark.usefixtures("_photograph")
def test_few_cars_do_not_end_the_search_of_a_photograph(detector: Detector) -> None:
    few = blank_image(1000, 800)
    paint_vehicles(few, [[60 + 140 * k, 400, 30, 12, 0.4] for k in range(7)])
    sparse = estimate_gsd(few, detector=detector, **_TILES)
    # all that can show cars
    assert sparse.details.tiles_searched > 0.75 * sparse.details.tiles_total


def test_auto_continues_while_a_doubt_is_open(detector: Detector) -> None:
    alike = estimate_gsd(_town(spread=0.002), detector=detector, **_TILES)
    assert "look_alikes" in {notice.code for notice in alike.warnings}
    assert alike.details.stopped_because == "all_searched"
    assert alike.details.tiles_searched == alike.details.tiles_total


def test_auto_continues_while_no_car_is_found(detector: Detector) -> None:
    nothing = estimate_gsd(blank_image(800, 700), detector=detector, **_TILES)
    assert (nothing.status, nothing.details.stopped_because) == ("no_scale", "all_searched")


def _estimate_by_line(detector: Detector) -> GsdEstimate:
    """Estimate by a line of known length alone."""
    return estimate_gsd(
        blank_image(300, 300),
        detector=detector,
        rulers=["known_length"],
        known_lengths=[(10, 10, 200, 10, 38.0)],
    )


def test_a_search_that_no_ruler_needs_counts_no_tiles(detector: Detector) -> None:
    details = _estimate_by_line(detector).details
    assert (details.tiles_searched, details.tiles_total) == (0, 0)
    assert details.stopped_because is None


def test_without_the_ruler_vehicles_the_record_has_none(detector: Detector) -> None:
    estimate = _estimate_by_line(detector)
    assert estimate.n_vehicles is None
    assert estimate.details.n_detections is None
    assert estimate.details.composite_confidence is None
