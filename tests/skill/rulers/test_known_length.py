"""Known lengths as a ruler: lines that the caller draws."""

from __future__ import annotations

import math
from typing import Any

import pytest

import vehanchor
from tests.analyses import empty_view, log_sd, measured
from tests.models import blank_image, write_detector
from vehanchor.errors import KnownLengthError
from vehanchor.options import ScaleOptions
from vehanchor.rulers.active import active_rulers
from vehanchor.rulers.height import GivenHeight
from vehanchor.rulers.known_length import KnownLengths
from vehanchor.scale.reliability import MEASURING


def test_the_scale_of_a_line_is_its_metres_over_its_pixels() -> None:
    witness = measured(
        KnownLengths(), empty_view(known_lengths=[(100, 100, 400, 500, 25, "measured")])
    )
    assert witness.gsd_m_per_px == pytest.approx(25 / 500, rel=1e-3)
    assert log_sd(witness) == pytest.approx(math.hypot(math.sqrt(2) / 500, 0.01), rel=0.02)
    assert (witness.kind, witness.n) == ("known_length", 1)
    assert (witness.chance_wrong, witness.assumed) == (0.02, False)
    assert witness.shared == (MEASURING,)


def test_a_line_drawn_in_a_copy_is_read_in_its_pixels() -> None:
    line = [(25, 25, 100, 125, 25, "measured")]
    witness = measured(KnownLengths(), empty_view(known_lengths=line, frame=(1000, 750)))
    assert witness.gsd_m_per_px == pytest.approx(25 / 500, rel=1e-3)
    assert log_sd(witness) == pytest.approx(math.hypot(math.sqrt(2) / 125, 0.01), rel=0.02)


def test_several_lines_are_weighed_by_the_errors_of_their_ends() -> None:
    lines = [(0, 0, 1000, 0, 50.0, "measured"), (0, 0, 20, 0, 1.1, "measured")]
    both = measured(KnownLengths(), empty_view(known_lengths=lines))
    assert both.gsd_m_per_px == pytest.approx(0.05, rel=0.01)
    assert both.n == 2
    assert both.notices == ()
    assert both.statement is not None
    assert both.statement.startswith("The 2 given lines, measured, give 0.05")


CONTRADICTORY_LINES = [(0, 0, 1000, 0, 50.0), (0, 0, 0, 1000, 80.0)]


def test_lines_that_contradict_each_other_give_a_notice() -> None:
    witness = measured(KnownLengths(), empty_view(known_lengths=CONTRADICTORY_LINES))
    assert [notice.code for notice in witness.notices] == ["known_lengths_disagree"]


def test_the_interval_of_contradictory_lines_holds_both_scales() -> None:
    witness = measured(KnownLengths(), empty_view(known_lengths=CONTRADICTORY_LINES))
    assert witness.interval is not None
    assert witness.interval.low < 0.05 < 0.08 < witness.interval.high


def test_the_one_line_of_three_that_contradicts_the_others_is_named() -> None:
    lines = [*CONTRADICTORY_LINES, (0, 10, 1000, 10, 51.0)]
    witness = measured(KnownLengths(), empty_view(known_lengths=lines))
    assert "Without the line 80 m (0.08 m/px) they agree" in witness.notices[0].message


@pytest.mark.parametrize(
    "line", [(10, 10, 11, 10, 5), (10, 10, 10, 10, 5), (10, 10, 5000, 10, 5), (-3, 10, 90, 10, 5)]
)
def test_a_line_of_one_pixel_or_outside_the_image_is_refused(tmp_path: Any, line: Any) -> None:
    detector = write_detector(tmp_path / "detector.onnx")
    with pytest.raises(KnownLengthError) as refused:
        vehanchor.estimate_gsd(blank_image(200, 100), detector=str(detector), known_lengths=[line])
    assert refused.value.code == "invalid_known_length"


def test_a_line_that_would_give_an_impossible_scale_is_refused() -> None:
    with pytest.raises(KnownLengthError, match="m/px"):
        measured(KnownLengths(), empty_view(known_lengths=[(0, 0, 10, 0, 5000)]))


def test_without_facts_of_the_caller_their_rulers_are_left_out() -> None:
    kinds = {ruler.kind for ruler in active_rulers(empty_view().options.rulers)}
    assert kinds.isdisjoint({KnownLengths.kind, GivenHeight.kind})


@pytest.mark.parametrize(
    "line",
    [
        (0, 0, 50, 0, None),
        (0, 0, 50, 0, 5.0, "assumed", None, "pool_50m"),
        (0, 0, 50, 0, "pool_50m", "measured"),
    ],
)
def test_a_line_has_metres_or_a_name(line: tuple[Any, ...]) -> None:
    with pytest.raises(KnownLengthError):
        ScaleOptions.of({"known_lengths": [line]})
