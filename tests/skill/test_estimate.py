from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

import vehanchor
from tests.models import blank_image, car_park, fleet
from vehanchor import analyse_scale, estimate_gsd
from vehanchor.detection.detector import Detector
from vehanchor.errors import FrameError
from vehanchor.options import ScaleOptions

if TYPE_CHECKING:
    from pathlib import Path


# the scene-scale prior does not know painted pictures
ALONE: dict[str, Any] = {"rulers": ("vehicles",)}


def test_the_record_follows_the_papers_equations(detector: Detector) -> None:
    analysis = analyse_scale(
        car_park([*fleet(30), 70.0]), ScaleOptions.of(ALONE), detector=detector
    )
    e = analysis.estimate
    # the 70 px one is beyond 1.5 times the median
    assert (e.details.n_detections, e.n_vehicles) == (31, 30)
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
    total = (
        0.35 * terms.sample
        + 0.35 * terms.concentration
        + 0.20 * terms.quality
        + 0.10 * terms.plausibility
    )
    assert e.details.composite_confidence == pytest.approx(total)
    assert (e.status, e.details.aggregation, e.details.resolution_guard) == ("ok", "kde", False)
    assert (e.image_width_px, e.image_height_px) == (480, 360)
    assert e.model == "painted"
    assert e.details.model_sha256 == detector.card.sha256
    assert analysis.kept.sum() == 30
    assert analysis.detections.boxes[~analysis.kept, 2] == pytest.approx([70.0])


@pytest.mark.promise("no-guess")
def test_no_vehicles_mean_no_scale_and_no_confidence(detector: Detector) -> None:
    e = estimate_gsd(blank_image(200, 100), detector=detector)
    assert (e.status, e.gsd_m_per_px, e.mode_length_px, e.confidence) == (
        "no_scale",
        None,
        None,
        0.0,
    )
    assert (e.gsd_ci95_low_m_per_px, e.gsd_ci95_high_m_per_px, e.n_vehicles) == (None, None, 0)
    assert "NaN" not in e.model_dump_json()


def test_every_constant_can_be_overridden(detector: Detector) -> None:
    image = car_park([*fleet(30), 70.0], scores=[0.9] * 30 + [0.2])
    assert estimate_gsd(image, detector=detector, **ALONE, alpha=None).n_vehicles == 31
    assert estimate_gsd(
        image, detector=detector, **ALONE, aggregation="mean", alpha=None
    ).mode_length_px == pytest.approx(np.mean([*fleet(30), 70.0]), abs=0.01)
    assert estimate_gsd(
        image, detector=detector, **ALONE, reference_length_m=4.0
    ).gsd_m_per_px == pytest.approx(4 / 30, rel=0.01)
    europe = estimate_gsd(image, detector=detector, **ALONE, region="europe")
    assert europe.details.reference_length_m == pytest.approx(4.5)
    tiled = estimate_gsd(image, detector=detector, **ALONE, tile_px=128, stride_px=64)
    assert tiled.mode_length_px == pytest.approx(
        estimate_gsd(image, detector=detector, **ALONE).mode_length_px
    )


def test_the_frame_gives_the_scale_of_the_callers_copy(detector: Detector) -> None:
    image = car_park(fleet(30))  # 480 x 360
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


def test_a_georeference_that_disagrees_is_reported_and_not_used(
    tmp_path: Path, detector: Detector
) -> None:
    rasterio = pytest.importorskip("rasterio")
    image = car_park(fleet(30))

    def write(name: str, gsd: float) -> Path:
        path = tmp_path / name
        with rasterio.open(
            path, "w", driver="GTiff", width=480, height=360, count=3, dtype="uint8", crs="EPSG:32631",
            transform=rasterio.Affine(gsd, 0, 500_000, 0, -gsd, 5_000_000),
        ) as dataset:  # fmt: skip
            dataset.write(image.transpose(2, 0, 1))
        return path

    plain = estimate_gsd(image, detector=detector, **ALONE)
    assert plain.gsd_m_per_px is not None
    agrees = estimate_gsd(write("a.tif", plain.gsd_m_per_px * 1.05), detector=detector, **ALONE)
    differs = estimate_gsd(write("b.tif", plain.gsd_m_per_px * 1.3), detector=detector, **ALONE)
    assert agrees.gsd_m_per_px == differs.gsd_m_per_px == plain.gsd_m_per_px
    assert agrees.georeference_gsd_m_per_px == pytest.approx(plain.gsd_m_per_px * 1.05)
    assert [w.code for w in agrees.warnings] == []
    assert [w.code for w in differs.warnings] == ["georeference_differs"]


def test_the_same_image_gives_the_same_bytes_whatever_the_threads(detector: Detector) -> None:
    image = car_park(fleet(40), height_px=480)
    records = {
        analyse_scale(
            image, ScaleOptions.of({"tile_px": 256}), detector=detector.path, threads=n
        ).estimate.model_dump_json()
        for n in (1, 2)
    }
    assert len(records) == 1
    assert json.loads(records.pop())["status"] == "ok"


def test_the_public_names_are_those_declared_and_all_resolve() -> None:
    for name in vehanchor.__all__:
        assert getattr(vehanchor, name) is not None
    assert dir(vehanchor) == sorted(vehanchor.__all__)
    with pytest.raises(AttributeError, match="utils"):
        vehanchor.utils  # noqa: B018
