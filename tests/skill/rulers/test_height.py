"""A given height as a ruler: with a focal length from the caller or from the file."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

import vehanchor
from tests.analyses import empty_view, log_sd, measured
from tests.conftest import ROOT
from tests.skill.imagery.files import EXIF_PREFIX, after_start, exif, segment
from tests.skill.rulers.test_camera import MAVIC
from vehanchor.rulers.height import GivenHeight
from vehanchor.rulers.ruler import View


def test_a_given_height_measures_with_a_given_focal_length_or_the_files() -> None:
    given = measured(
        GivenHeight(), empty_view(height_m=100, height_basis="measured", focal_35mm=26)
    )
    of_file = measured(
        GivenHeight(),
        empty_view(replace(MAVIC, height_m=60.0), height_m=100, height_basis="measured"),
    )
    assert given.gsd_m_per_px == pytest.approx(100 * 43.27 / (26 * 5000), rel=1e-3)
    # its lens is in the table of cameras
    assert of_file.gsd_m_per_px == pytest.approx(given.gsd_m_per_px, rel=0.03)
    assert log_sd(given) == pytest.approx(math.hypot(0.05, 0.04), rel=0.02)


@pytest.mark.parametrize(
    "view",
    [
        empty_view(height_m=100),
        empty_view(MAVIC, height_m=100, metadata=False),
    ],
)
def test_a_height_without_a_focal_length_asks_for_one(view: View) -> None:
    witness = measured(GivenHeight(), view)
    assert witness.gsd_m_per_px is None
    assert [notice.code for notice in witness.notices] == ["camera_unusable"]


RESIZED = {
    "Make": "SONY",
    "Model": "ILCE-6000",
    "FocalLength": 20.0,
    "FocalPlaneXResolution": 1361.7,
    "FocalPlaneResolutionUnit": 3,
    "PixelXDimension": 800,
    "PixelYDimension": 600,
}
"""Tags of a photograph of 0.162 m/px that a program resized, with the pitch of the original."""


def test_the_lens_of_a_resized_picture_needs_a_second_source() -> None:
    block = segment(EXIF_PREFIX + exif(RESIZED))
    picture = after_start((ROOT / "examples/scenes/no_cars.jpg").read_bytes(), block)
    height: dict[str, Any] = {"height_m": 110.0, "height_basis": "measured"}
    alone = vehanchor.estimate_gsd(picture, **height)
    assert alone.gsd_m_per_px == pytest.approx(0.041, rel=0.03)
    assert alone.status == "low_confidence"
    line = (100, 100, 400, 100, 48.6, "measured")
    beside = vehanchor.estimate_gsd(picture, known_lengths=[line], **height)
    assert beside.gsd_m_per_px == pytest.approx(0.162, rel=0.02)
    assert beside.status == "ok"


def test_a_given_height_does_not_measure_through_a_digital_zoom() -> None:
    zoomed = replace(MAVIC, digital_zoom=2.0, height_m=None)
    witness = measured(GivenHeight(), empty_view(zoomed, height_m=100))
    assert witness.gsd_m_per_px is None
    assert "enlarged 2 times" in witness.notices[0].message
    stated = measured(GivenHeight(), empty_view(zoomed, height_m=100, focal_35mm=52))
    assert stated.gsd_m_per_px == pytest.approx(100 * 43.27 / (52 * 5000), rel=1e-3)


CROP = replace(MAVIC, taken_width_px=5472, taken_height_px=3078, height_m=None)


@pytest.mark.parametrize("options", [{"height_m": 100}, {"height_m": 100, "focal_35mm": 26}])
def test_a_given_height_does_not_measure_a_crop(options: dict[str, Any]) -> None:
    witness = measured(GivenHeight(), empty_view(CROP, **options))
    assert witness.gsd_m_per_px is None
    assert [notice.code for notice in witness.notices] == ["camera_unusable"]


def test_without_metadata_a_crop_counts_as_a_whole_image() -> None:
    view = empty_view(CROP, height_m=100, focal_35mm=26, metadata=False)
    witness = measured(GivenHeight(), view)
    assert witness.gsd_m_per_px == pytest.approx(100 * 43.27 / (26 * 5000), rel=1e-3)


def test_a_height_that_would_give_an_impossible_scale_gives_a_notice() -> None:
    witness = measured(GivenHeight(), empty_view(height_m=20_000, focal_35mm=1))
    assert [notice.code for notice in witness.notices] == ["camera_unusable"]
