"""Camera metadata as a ruler: height, lens, tilt, and what is refused."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.analyses import empty_view, log_sd, made_card, measured
from vehanchor.analysis.pipeline import analyse_view
from vehanchor.detection.detections import Detections
from vehanchor.detection.scene_scale import SceneScalePrior
from vehanchor.imagery.facts import image_facts
from vehanchor.imagery.metadata.camera import CameraMetadata
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.records.advice import advice_for
from vehanchor.rulers.camera import Camera
from vehanchor.rulers.ruler import View
from vehanchor.scale.density import Density, Votes, lognormal
from vehanchor.scale.posterior import Witness

MAVIC = CameraMetadata(
    make="DJI",
    model="FC220",
    height_m=100.0,
    height_tag="DJI RelativeAltitude",
    focal_mm=4.73,
    focal_35mm=26.0,
    taken_width_px=4000,
    taken_height_px=3000,
    off_nadir_deg=0.0,
)
TRUE_GSD = 100 * 6.17 / (4.73 * 4000)  # the sensor of that camera is 6.17 mm wide


def _measured(
    camera: CameraMetadata | None, width_px: int = 4000, height_px: int = 3000
) -> Witness:
    return measured(Camera(), empty_view(camera, width_px, height_px))


def _but(**changes: object) -> CameraMetadata:
    return CameraMetadata(**{**MAVIC.__dict__, **changes})


UNLISTED = _but(make="Unknown", model="")  # a camera that the table of sensors lacks


@pytest.fixture(scope="module")
def by_equivalent() -> Witness:
    """Measured by the height and the 35 mm equivalent focal length."""
    return _measured(UNLISTED)


def test_a_height_with_an_equivalent_focal_length_gives_a_scale(by_equivalent: Witness) -> None:
    assert by_equivalent.gsd_m_per_px == pytest.approx(TRUE_GSD, rel=0.04)
    assert (by_equivalent.kind, by_equivalent.n) == ("camera", 1)
    assert by_equivalent.notices == ()


def test_the_interval_has_the_errors_of_height_with_lens(by_equivalent: Witness) -> None:
    assert by_equivalent.interval is not None
    low, high = by_equivalent.interval
    assert low < TRUE_GSD < high
    assert high / low == pytest.approx(3.18, rel=0.01)


def test_the_statement_names_its_sources(by_equivalent: Witness) -> None:
    assert by_equivalent.statement is not None
    assert "100 m (DJI RelativeAltitude) and 26 mm" in by_equivalent.statement


BY_SENSOR = replace(UNLISTED, pixel_mm=6.17 / 4000)
CALIBRATED = _but(pixel_mm=6.17 / 4000, focal_px=3100.0, centre_x_px=1995.0)


def test_the_sensor_gives_the_scale() -> None:
    assert _measured(BY_SENSOR).gsd_m_per_px == pytest.approx(TRUE_GSD, rel=1e-6)


def test_a_calibration_of_the_camera_wins_over_the_sensor() -> None:
    assert _measured(CALIBRATED).gsd_m_per_px == pytest.approx(100 / 3100)


def test_the_error_falls_from_equivalent_to_sensor_to_calibration() -> None:
    calibrated = log_sd(_measured(CALIBRATED))
    by_sensor = log_sd(_measured(BY_SENSOR))
    assert calibrated < by_sensor < log_sd(_measured(UNLISTED))


@pytest.mark.parametrize(
    "size", [(4000, 3000), (4000, 2250), (2000, 1500), (2000, 1125), (1125, 2000)]
)
def test_a_listed_sensor_gives_the_scale_of_every_whole_picture(
    size: tuple[int, int],
) -> None:
    """A picture of 16:9 has all columns of a sensor of 4:3."""
    taken = _but(taken_width_px=None, taken_height_px=None)
    witness = _measured(taken, *size)
    assert witness.gsd_m_per_px == pytest.approx(TRUE_GSD * 4000 / max(size), rel=1e-3)
    assert witness.statement is not None
    assert "6.17 mm wide sensor of the FC220" in witness.statement


def test_a_picture_of_4_3_has_all_rows_of_a_sensor_of_3_2() -> None:
    phantom = _but(
        model="FC6310", focal_mm=8.8, focal_35mm=None, taken_width_px=4864, taken_height_px=3648
    )
    assert _measured(phantom, 4864, 3648).gsd_m_per_px == pytest.approx(
        100 * 8.8 / (8.8 * 3648), rel=1e-3
    )


def test_a_listed_sensor_is_not_believed_behind_another_lens() -> None:
    """A drone's second camera may write the same model."""
    other = _measured(_but(focal_mm=13.5, focal_35mm=72.0))
    assert other.statement is not None
    assert "72 mm (35 mm equivalent)" in other.statement


def test_a_calibration_of_another_size_is_not_believed() -> None:
    """Some programs write the size of a resized copy, and leave the calibration as it was."""
    copy = _but(focal_px=3100.0, centre_x_px=2000.0, taken_width_px=1000, taken_height_px=750)
    assert _measured(copy, 1000, 750).gsd_m_per_px == pytest.approx(4 * TRUE_GSD, rel=0.04)


@pytest.mark.parametrize(
    "size", [(2000, 1500), (1500, 2000), (1333, 1000), (8000, 6000), (1000, 750)]
)
def test_a_resized_copy_has_the_scale_of_its_pixels(size: tuple[int, int]) -> None:
    for camera in (MAVIC, _but(pixel_mm=6.17 / 4000), _but(focal_px=3067.0, centre_x_px=2000.0)):
        expected = TRUE_GSD * 4000 / max(size)
        assert _measured(camera, *size).gsd_m_per_px == pytest.approx(expected, rel=0.04)


@pytest.mark.parametrize("size", [(4000, 2250), (3000, 3000), (2000, 1000), (4000, 2900)])
def test_a_crop_is_refused(size: tuple[int, int]) -> None:
    witness = _measured(MAVIC, *size)
    assert (witness.gsd_m_per_px, witness.found) == (None, False)
    assert [notice.code for notice in witness.notices] == ["camera_unusable"]
    assert "is a crop" in witness.notices[0].message


def test_a_wide_picture_is_a_full_width_with_rows_left_out() -> None:
    wide = _measured(_but(taken_height_px=2250), 4000, 2250)
    assert wide.gsd_m_per_px == pytest.approx(TRUE_GSD, rel=0.05)


def test_a_camera_that_looks_aslant_measures_the_centre() -> None:
    straight = _measured(_but(off_nadir_deg=9.9))
    aslant = _measured(_but(off_nadir_deg=40.0))
    assert straight.gsd_m_per_px is not None
    assert aslant.gsd_m_per_px == pytest.approx(
        straight.gsd_m_per_px * math.cos(math.radians(40)) ** -1.5
    )
    assert log_sd(aslant) > log_sd(straight)
    assert [notice.code for notice in aslant.notices] == ["camera_tilted"]
    assert straight.notices == ()


def test_a_camera_that_looks_at_the_horizon_is_no_ruler() -> None:
    witness = _measured(_but(off_nadir_deg=88.0))
    assert witness.gsd_m_per_px is None
    assert [notice.code for notice in witness.notices] == ["camera_tilted"]


def _chance_wrong(witness: Witness) -> float:
    """Compute the chance that a witness is wrong, its shared errors included."""
    chances = [error.chance_wrong for error in witness.shared]
    return 1.0 - math.prod(1.0 - chance for chance in (witness.chance_wrong, *chances))


def test_an_unknown_pitch_widens_the_interval() -> None:
    known = _measured(MAVIC)
    unknown = _measured(_but(off_nadir_deg=None))
    assert log_sd(unknown) > log_sd(known)
    assert _chance_wrong(unknown) > _chance_wrong(known)
    assert unknown.statement is not None
    assert "at nadir" in unknown.statement


def test_the_nearer_the_ground_the_less_a_height_says() -> None:
    low = _chance(_seeing(_but(height_m=25.0)))
    high = _chance(_seeing(_but(height_m=500.0)))
    assert low < high - 0.03


# --- Level ground, or a hill


def _seeing(
    camera: CameraMetadata, prior: Density | None = None, car_gsd: float | None = None
) -> View:
    """View with a prior of the scene, and perhaps a clear car, 4.6 m long at a scale."""
    view = empty_view(camera)
    if prior is not None:
        view = replace(view, prior=SceneScalePrior(prior, n_tiles=24))
    if car_gsd is not None:
        box = [2000.0, 1500.0, 4.6 / car_gsd, 2.1 / car_gsd, 0.0]
        view = replace(
            view,
            card=made_card(4.6).model_copy(update={"votes": Votes(-4.0, 9.5)}),
            detections=Detections(np.array([box]), np.array([0.99])),
        )
    return view


def _chance(view: View) -> float:
    estimate = analyse_view(view).estimate
    assert estimate.confidence is not None
    return estimate.confidence


@pytest.mark.parametrize("height_m", [60.0, 100.0, 200.0])
def test_a_height_is_not_usable_by_itself(height_m: float) -> None:
    assert 0.8 < _chance(_seeing(_but(height_m=height_m))) < 0.85


def test_a_height_by_itself_lacks_level_ground() -> None:
    estimate = analyse_view(_seeing(MAVIC, prior=lognormal(TRUE_GSD, 0.6))).estimate
    advice = advice_for(estimate)
    assert estimate.reason == "imprecise"
    assert advice is not None
    assert "take-off" in advice.why


def test_a_height_that_a_town_agrees_with_is_usable() -> None:
    view = _seeing(MAVIC, prior=lognormal(TRUE_GSD, 0.25))
    assert analyse_view(view).estimate.status == "ok"


@pytest.mark.parametrize("factor", [0.5, 1 / 1.5, 1.0, 1.5, 2.0])
def test_a_height_over_fields_is_not_usable(factor: float) -> None:
    """A wide prior does not tell a height from its double, and confirms neither."""
    assert _chance(_seeing(MAVIC, prior=lognormal(factor * TRUE_GSD, 0.6))) < 0.88


def test_a_prior_hardly_confirms_a_height() -> None:
    """It fits the double nearly as well: half of the chance of error stays."""
    alone = _chance(_seeing(MAVIC))
    confirmed = _chance(_seeing(MAVIC, prior=lognormal(TRUE_GSD, 0.4)))
    assert alone < confirmed < alone + 0.5 * (1.0 - alone)


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_prior_that_prefers_another_height_makes_a_height_unusable(factor: float) -> None:
    view = _seeing(MAVIC, prior=lognormal(factor * TRUE_GSD, 0.3))
    assert analyse_view(view).estimate.status != "ok"


@pytest.mark.parametrize("factor", [0.5, 1 / 1.5, 1.5, 2.0])
def test_a_height_that_a_car_contradicts_is_not_usable(factor: float) -> None:
    estimate = analyse_view(_seeing(MAVIC, car_gsd=factor * TRUE_GSD)).estimate
    assert estimate.gsd_m_per_px is not None
    is_of_car = abs(math.log(estimate.gsd_m_per_px / (factor * TRUE_GSD))) < 0.2
    assert is_of_car or estimate.status != "ok"


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_car_outweighs_half_or_double_the_height(factor: float) -> None:
    estimate = analyse_view(_seeing(MAVIC, car_gsd=factor * TRUE_GSD)).estimate
    assert estimate.gsd_m_per_px == pytest.approx(factor * TRUE_GSD, rel=0.2)


def test_a_height_over_a_hill_is_probably_wrong_as_it_stands() -> None:
    analysis = analyse_view(_seeing(MAVIC, car_gsd=2 * TRUE_GSD))
    p_right = {ruler.kind: ruler.p_right for ruler in analysis.estimate.rulers}
    assert p_right["camera"] < 0.5 < p_right["vehicles"]


# --- A laser


def _by_laser(laser_m: float, **changes: object) -> CameraMetadata:
    return _but(laser_m=laser_m, laser_tag="DJI LRFTargetDistance", **changes)


def test_a_laser_replaces_the_height_above_take_off() -> None:
    """The take-off was on a hill, so that the ground is 150 m below the camera."""
    witness = _measured(_by_laser(150.0))
    assert witness.gsd_m_per_px == pytest.approx(1.5 * TRUE_GSD)
    assert witness.statement is not None
    assert "150 m (DJI LRFTargetDistance)" in witness.statement


def test_a_laser_needs_no_height_above_take_off() -> None:
    witness = _measured(_by_laser(100.0, height_m=None))
    assert witness.gsd_m_per_px == pytest.approx(TRUE_GSD)


def test_a_laser_measures_along_the_axis_of_the_camera() -> None:
    aslant = _measured(_by_laser(100.0 / math.cos(math.radians(40)), off_nadir_deg=40.0))
    above_take_off = _measured(_but(off_nadir_deg=40.0))
    assert aslant.gsd_m_per_px == pytest.approx(above_take_off.gsd_m_per_px)


@pytest.mark.parametrize("height_m", [50.0, 100.0, 300.0])
def test_a_height_by_a_laser_is_usable_by_itself(height_m: float) -> None:
    assert _chance(_seeing(_by_laser(height_m))) >= 0.9


def test_a_laser_low_above_the_ground_may_have_met_a_roof() -> None:
    assert _chance(_seeing(_by_laser(25.0))) < 0.85


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"height_m": 0.0}, "0 m"),
        ({"height_m": -12.0}, "-12 m"),
        ({"height_m": 1e7}, "1e+07 m"),
        ({"height_m": 0.001}, "m/px"),
        (
            {"model": "", "focal_mm": None, "focal_35mm": None},
            "the height is 100 m, but the focal length is missing",
        ),
        ({"height_m": None}, "the height above the ground is missing"),
        ({"digital_zoom": 2.0}, "enlarged 2 times"),
        ({"height_m": None, "refused": "its XMP declares entities"}, "entities"),
    ],
)
def test_impossible_metadata_give_a_notice_instead_of_a_scale(
    changes: dict[str, object], words: str
) -> None:
    witness = _measured(_but(**changes))
    assert witness.gsd_m_per_px is None
    assert [notice.code for notice in witness.notices] == ["camera_unusable"]
    assert words in witness.notices[0].message


@pytest.mark.parametrize(
    "camera", [None, replace(UNLISTED, height_m=None, focal_mm=None, focal_35mm=None)]
)
def test_a_file_without_a_height_or_a_lens_gives_no_notice(
    camera: CameraMetadata | None,
) -> None:
    assert Camera().measure(empty_view(camera)) is None


def test_a_height_that_is_given_is_not_missing() -> None:
    for lacking in (_but(height_m=None), replace(UNLISTED, focal_mm=None, focal_35mm=None)):
        witness = Camera().measure(empty_view(lacking, height_m=100, focal_35mm=26))
        assert witness is None or witness.notices == ()


def test_a_given_focal_length_goes_with_the_height_of_the_file() -> None:
    lacking = replace(UNLISTED, focal_mm=None, focal_35mm=None)
    with_focal = measured(Camera(), empty_view(lacking, focal_35mm=26))
    assert with_focal.gsd_m_per_px == _measured(UNLISTED).gsd_m_per_px
    (notice,) = measured(Camera(), empty_view(None, focal_35mm=26)).notices
    assert "give height_m" in notice.message


def test_metadata_that_are_read_in_part_say_what_is_not_used() -> None:
    witness = _measured(
        _but(off_nadir_deg=None, refused="DJI GimbalPitchDegree is both -90 and -45")
    )
    assert witness.gsd_m_per_px == pytest.approx(TRUE_GSD, rel=0.01)
    assert [notice.code for notice in witness.notices] == ["camera_unusable"]
    assert "both -90 and -45" in witness.notices[0].message


@pytest.fixture(scope="module")
def almost_level() -> Witness:
    """Measured by a camera that looks at the horizon, with a known height and focal length."""
    return _measured(_but(off_nadir_deg=88.0))


def test_a_camera_that_is_almost_level_gives_no_scale(almost_level: Witness) -> None:
    assert not almost_level.found
    assert [notice.code for notice in almost_level.notices] == ["camera_tilted"]


def test_a_camera_that_is_almost_level_lacks_no_metadata(almost_level: Witness) -> None:
    (notice,) = almost_level.notices
    assert "too close to the horizon" in notice.message
    assert "without" not in notice.message


@pytest.mark.parametrize("options", [{"metadata": False}, {"rulers": ("vehicles", "height")}])
def test_the_camera_can_be_left_out(options: dict[str, Any]) -> None:
    analysis = analyse_view(empty_view(MAVIC, **options))
    assert "camera" not in [each.kind for each in analysis.witnesses]
    assert (analysis.estimate.gsd_m_per_px, analysis.estimate.rulers) == (None, ())


@pytest.mark.data
@pytest.mark.parametrize(("name", "height_m"), [("minsk_10", 98.9), ("minsk_12", 99.0)])
def test_nadir_photographs_of_a_known_sensor_have_the_true_scale(
    real_data: Path, name: str, height_m: float
) -> None:
    with open_raster(real_data / f"tilt/images/{name}.jpg") as raster:
        facts = image_facts(raster)
    witness = measured(Camera(), replace(empty_view(None), image=facts))
    assert witness.gsd_m_per_px == pytest.approx(height_m * 6.17 / (4.73 * 3000), rel=0.01)
