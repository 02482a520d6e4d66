"""Cases of flights and models that people reported, by the bundled detector.

They lie in ``../shared/cases/second`` beside the clone, and are skipped where it is absent.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from vehanchor import estimate_gsd
from vehanchor.errors import InvalidParameterError
from vehanchor.imagery.sources.files import find_images
from vehanchor_flight.verbs import estimate_flight, rescale

CASES = Path(__file__).parents[3] / "shared" / "cases" / "second"
pytestmark = pytest.mark.skipif(not CASES.is_dir(), reason=f"no {CASES}")


@pytest.mark.parametrize("same_scale", [False, True], ids=["linked", "same scale"])
def test_g03_five_copies_are_one_photograph(tmp_path: Path, same_scale: bool) -> None:
    for name in ("", " (1)", " (2)", " (3)", " - Copy"):
        shutil.copy(CASES / "g03_two_cars.jpg", tmp_path / f"IMG_0042{name}.jpg")
    alone = estimate_gsd(CASES / "g03_two_cars.jpg")
    record = estimate_flight(find_images([str(tmp_path)]), same_scale=same_scale)
    assert record.status == alone.status == "low_confidence"
    assert record.confidence == pytest.approx(alone.confidence, abs=0.03)
    assert record.n_vehicles == 2


HEAD = CASES / "g01_wide_zoom_thermal"


def test_g01_a_camera_head_has_no_common_scale() -> None:
    with pytest.raises(InvalidParameterError, match="do not have one scale"):
        estimate_flight(find_images([str(HEAD)]), same_scale=True)


def test_g01_linked_pictures_of_a_camera_head_have_their_own_scales() -> None:
    record = estimate_flight(find_images([str(HEAD)]))
    truth = {"W": 0.1, "Z": 0.0333, "T": 0.2}
    for photograph in record.photographs:
        kind = Path(photograph.photograph).stem[-1]
        assert photograph.gsd_m_per_px == pytest.approx(truth[kind], rel=0.1)


@pytest.mark.parametrize(
    "name", ["r01_colmap_upside_down", "r01_colmap_upside_down_control", "r02_colmap_portrait"]
)
def test_r0_a_turned_photograph_gives_the_size_of_its_model(name: str) -> None:
    record = rescale(CASES / name)
    assert record.status == "ok"
    assert record.factor_ci95_low is not None
    assert record.factor_ci95_high is not None
    assert record.factor_ci95_low < 12.5 < record.factor_ci95_high
