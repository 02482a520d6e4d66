from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

import vehanchor
from tests.models import blank_image, paint_vehicles, write_detector
from vehanchor import analyse_scale, estimate_gsd
from vehanchor.detection.detector import Detector
from vehanchor.errors import FrameError
from vehanchor.options import ScaleOptions

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray


ALONE: dict[str, Any] = {"rulers": ("vehicles",)}  # the scene-scale prior does not know painted pictures


def _car_park(lengths: list[float], scores: list[float] | None = None) -> NDArray[np.uint8]:
    image = blank_image(480, 60 * -(-len(lengths) // 6) + 60)
    boxes = [[40 + 70 * (k % 6), 50 + 60 * (k // 6), length, 12, 0.4] for k, length in enumerate(lengths)]
    paint_vehicles(image, boxes, scores=scores)
    return image


def _fleet(n: int = 30, mean: float = 30.0) -> list[float]:
    return list(mean * (1 + 0.06 * np.linspace(-1, 1, n) ** 3))


def test_the_record_follows_the_papers_equations(detector: Detector) -> None:
    analysis = analyse_scale(_car_park([*_fleet(), 70.0]), ScaleOptions.of(ALONE), detector=detector)
    e = analysis.estimate
    assert (e.details.n_detections, e.n_vehicles) == (31, 30)  # the 70 px one is beyond 1.5 times the median
    assert e.mode_length_px is not None
    assert e.gsd_m_per_px is not None
    assert e.mode_length_px == pytest.approx(30.0, abs=0.1)
    assert e.rulers[0].gsd_m_per_px == 5.045 / e.mode_length_px
    assert e.gsd_m_per_px == pytest.approx(5.045 / e.mode_length_px, rel=0.03)
    assert e.gsd_ci95_low_m_per_px is not None
    assert e.gsd_ci95_high_m_per_px is not None
    assert e.gsd_ci95_low_m_per_px < e.gsd_m_per_px < e.gsd_ci95_high_m_per_px
    terms = e.details.confidence_terms
    assert terms is not None
    total = 0.35 * terms.sample + 0.35 * terms.concentration + 0.20 * terms.quality + 0.10 * terms.plausibility
    assert e.details.composite_confidence == pytest.approx(total)
    assert (e.status, e.details.aggregation, e.details.resolution_guard) == ("ok", "kde", False)
    assert (e.image_width_px, e.image_height_px) == (480, 420)
    assert e.model == "painted"
    assert e.details.model_sha256 == detector.card.sha256
    assert analysis.kept.sum() == 30
    assert analysis.detections.boxes[~analysis.kept, 2] == pytest.approx([70.0])


@pytest.mark.promise("no-guess")
def test_no_vehicles_mean_no_scale_and_no_confidence(detector: Detector) -> None:
    e = estimate_gsd(blank_image(200, 100), detector=detector)
    assert (e.status, e.gsd_m_per_px, e.mode_length_px, e.confidence) == ("no_scale", None, None, 0.0)
    assert (e.gsd_ci95_low_m_per_px, e.gsd_ci95_high_m_per_px, e.n_vehicles) == (None, None, 0)
    assert "NaN" not in e.model_dump_json()


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_fewer_than_five_vehicles_use_the_median_and_stay_below_the_threshold(detector: Detector, n: int) -> None:
    e = estimate_gsd(_car_park([30.0] * n, [1.0] * n), detector=detector, **ALONE)
    assert (e.details.aggregation, e.status) == ("median", "low_confidence")
    assert e.details.composite_confidence is not None
    assert max(e.confidence / 0.9, e.details.composite_confidence / 0.5) < 1
    assert e.gsd_m_per_px == pytest.approx(5.045 / 30, rel=0.01)


def test_the_resolution_guard_doubts_short_vehicles(detector: Detector) -> None:
    coarse = estimate_gsd(_car_park(_fleet(mean=16.0)), detector=detector, **ALONE)
    fine = estimate_gsd(_car_park(_fleet(mean=17.5)), detector=detector, **ALONE)
    assert coarse.details.resolution_guard
    assert coarse.details.composite_confidence == 0.3
    assert not fine.details.resolution_guard
    assert fine.details.composite_confidence is not None
    assert fine.details.composite_confidence > 0.5
    assert coarse.confidence < fine.confidence
    lower = estimate_gsd(_car_park(_fleet(mean=16.0)), detector=detector, reference_length_m=4.5)
    assert not lower.details.resolution_guard  # the threshold follows the reference length


def test_every_constant_can_be_overridden(detector: Detector) -> None:
    image = _car_park([*_fleet(), 70.0], [0.9] * 30 + [0.2])
    assert estimate_gsd(image, detector=detector, **ALONE, alpha=None).n_vehicles == 31
    assert estimate_gsd(
        image, detector=detector, **ALONE, aggregation="mean", alpha=None
    ).mode_length_px == pytest.approx(np.mean([*_fleet(), 70.0]), abs=0.01)
    assert estimate_gsd(image, detector=detector, **ALONE, reference_length_m=4.0).gsd_m_per_px == pytest.approx(
        4 / 30, rel=0.01
    )
    europe = estimate_gsd(image, detector=detector, **ALONE, region="europe")
    assert europe.details.reference_length_m == pytest.approx(4.5)
    tiled = estimate_gsd(image, detector=detector, **ALONE, tile_px=128, stride_px=64)
    assert tiled.mode_length_px == pytest.approx(estimate_gsd(image, detector=detector, **ALONE).mode_length_px)


def test_a_named_region_narrows_the_interval(detector: Detector) -> None:
    image = _car_park(_fleet(100))

    def width(**options: Any) -> float:
        e = estimate_gsd(image, detector=detector, **ALONE, **options)
        assert e.gsd_ci95_low_m_per_px is not None
        assert e.gsd_ci95_high_m_per_px is not None
        return e.gsd_ci95_high_m_per_px / e.gsd_ci95_low_m_per_px

    assert width(region="europe") < width()


def test_the_frame_gives_the_scale_of_the_callers_copy(detector: Detector) -> None:
    image = _car_park(_fleet())  # 480 x 360
    e = estimate_gsd(image, detector=detector, **ALONE, frame=(240, 180))
    assert e.frame is not None
    assert e.gsd_m_per_px is not None
    assert e.frame.gsd_m_per_px == pytest.approx(2 * e.gsd_m_per_px)
    assert e.frame.gsd_ci95_low_m_per_px == pytest.approx(2 * (e.gsd_ci95_low_m_per_px or 0))
    estimate_gsd(image, detector=detector, **ALONE, frame=(333, 250))  # rounded
    with pytest.raises(FrameError, match="180"):
        estimate_gsd(image, detector=detector, **ALONE, frame=(240, 240))
    empty = estimate_gsd(blank_image(480, 360), detector=detector, **ALONE, frame=(240, 180))
    assert empty.frame is not None
    assert empty.frame.gsd_m_per_px is None


def test_a_capped_tile_is_a_warning(tmp_path: Path) -> None:
    capped = Detector(write_detector(tmp_path / "m.onnx", layout="end2end", cap=10))
    e = estimate_gsd(_car_park(_fleet()), detector=capped)
    assert [w.code for w in e.warnings] == ["detections_capped"]


def test_a_georeference_that_disagrees_is_reported_and_not_used(tmp_path: Path, detector: Detector) -> None:
    rasterio = pytest.importorskip("rasterio")
    image = _car_park(_fleet())

    def write(name: str, gsd: float) -> Path:
        path = tmp_path / name
        with rasterio.open(
            path, "w", driver="GTiff", width=480, height=360, count=3, dtype="uint8", crs="EPSG:32631",
            transform=rasterio.Affine(gsd, 0, 500_000, 0, -gsd, 5_000_000),
        ) as dataset:  # fmt: skip
            dataset.write(image[:360].transpose(2, 0, 1))
        return path

    plain = estimate_gsd(image[:360], detector=detector, **ALONE)
    assert plain.gsd_m_per_px is not None
    agrees = estimate_gsd(write("a.tif", plain.gsd_m_per_px * 1.05), detector=detector, **ALONE)
    differs = estimate_gsd(write("b.tif", plain.gsd_m_per_px * 1.3), detector=detector, **ALONE)
    assert agrees.gsd_m_per_px == differs.gsd_m_per_px == plain.gsd_m_per_px
    assert agrees.georeference_gsd_m_per_px == pytest.approx(plain.gsd_m_per_px * 1.05)
    assert [w.code for w in agrees.warnings] == []
    assert [w.code for w in differs.warnings] == ["georeference_differs"]


def test_the_same_image_gives_the_same_bytes_whatever_the_threads(detector: Detector) -> None:
    image = _car_park(_fleet(40))
    records = {
        analyse_scale(
            image, ScaleOptions.of({"tile_px": 256}), detector=detector.path, threads=n
        ).estimate.model_dump_json()
        for n in (1, 2, 1)
    }
    assert len(records) == 1
    assert json.loads(records.pop())["status"] == "ok"


def test_the_public_names_are_those_declared_and_all_resolve() -> None:
    for name in vehanchor.__all__:
        assert getattr(vehanchor, name) is not None
    assert dir(vehanchor) == sorted(vehanchor.__all__)
    with pytest.raises(AttributeError, match="utils"):
        vehanchor.utils  # noqa: B018
