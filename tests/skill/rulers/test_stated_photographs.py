"""Stated facts on real photographs of known scale: what a careful person expects of each."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from vehanchor.analysis.pipeline import analyse_view, search_raster
from vehanchor.engine import Engine
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options import ScaleOptions
from vehanchor.records import GsdEstimate

PHOTOGRAPHS = {  # all of them val; in the last one the vehicles are 13 % off
    "vehicles/images/cannes_959.jpg": 0.2,
    "vehicles/images/cannes_977.jpg": 0.2,
    "vehicles/images/ucm_mobilehomepark60.jpg": 0.3048,
}
FOCAL_35MM = 26.0


class Photograph:
    """One search, and the records of many options."""

    def __init__(self, path: Path, gsd: float) -> None:
        self.gsd = gsd
        with open_raster(path) as raster:
            self.size = raster.width_px, raster.height_px
            self._view = search_raster(raster, Engine().detector, ScaleOptions())
        self.alone = self.record()

    def record(self, **options: Any) -> GsdEstimate:
        return analyse_view(replace(self._view, options=ScaleOptions.of(options))).estimate

    def lines(self, *factors: float, basis: str = "assumed") -> list[tuple[Any, ...]]:
        """Level lines over 80 % of the picture, so many times too long."""
        width, height = self.size
        return [
            (
                0.1 * width,
                (0.2 + 0.1 * k) * height,
                0.9 * width,
                (0.2 + 0.1 * k) * height,
                0.8 * width * self.gsd * by,
                basis,
            )
            for k, by in enumerate(factors)
        ]

    def error(self, record: GsdEstimate) -> float:
        assert record.gsd_m_per_px is not None
        return abs(record.gsd_m_per_px / self.gsd - 1)


@pytest.fixture(scope="module", params=PHOTOGRAPHS)
def photograph(request: pytest.FixtureRequest, real_data: Path) -> Photograph:
    return Photograph(real_data / request.param, PHOTOGRAPHS[request.param])


def test_the_vehicles_alone_are_usable(photograph: Photograph) -> None:
    assert photograph.alone.status == "ok"


def _outvoted(photograph: Photograph, record: GsdEstimate, kind: str) -> bool:
    """Whether a wrong fact is named, and neither leads nor makes the scale surer."""
    right = {ruler.kind: ruler.p_right > 0.5 for ruler in record.rulers}
    return (
        right == {"vehicles": True, "scene_scale": True, kind: False}
        and "rulers_disagree" in [warning.code for warning in record.warnings]
        and record.confidence <= photograph.alone.confidence
        and (record.status != "ok" or photograph.error(record) < 0.2)
    )


def test_a_line_too_long_is_named_and_never_raises_the_confidence(photograph: Photograph) -> None:
    for basis in ("assumed", "measured"):
        record = photograph.record(known_lengths=photograph.lines(2.2, basis=basis))
        assert _outvoted(photograph, record, "known_length")


def test_a_height_five_times_too_large_is_named_and_never_raises_the_confidence(photograph: Photograph) -> None:
    assert photograph.alone.gsd_m_per_px is not None
    pixels = FOCAL_35MM * math.hypot(*photograph.size) / math.hypot(36, 24)
    height_m = 5.3 * photograph.alone.gsd_m_per_px * pixels
    record = photograph.record(height_m=height_m, focal_35mm=FOCAL_35MM)
    assert _outvoted(photograph, record, "height")


def test_a_measured_true_line_leads_over_vehicles_that_are_off(photograph: Photograph) -> None:
    record = photograph.record(known_lengths=photograph.lines(1.0, basis="measured"))
    assert record.status == "ok"
    assert photograph.error(record) < 0.01
    two = photograph.record(known_lengths=photograph.lines(1.0, 1.01))
    assert two.status == "ok"
    assert photograph.error(two) < max(0.03, photograph.error(photograph.alone))


def test_a_guessed_line_without_vehicles_is_not_usable_and_no_estimate_is_certain(photograph: Photograph) -> None:
    alone = photograph.record(known_lengths=photograph.lines(1.0), rulers=("known_length", "scene_scale"))
    assert (alone.status, alone.reason) == ("low_confidence", "assumed")
    for basis in ("assumed", "measured"):
        assert photograph.record(known_lengths=photograph.lines(1.0, 1.0, basis=basis)).confidence <= 0.99


def test_a_line_in_centimetres_is_told_or_refused(photograph: Photograph) -> None:
    from vehanchor.errors import KnownLengthError

    with pytest.raises(KnownLengthError, match="If the length is in centimetres, give"):
        photograph.record(known_lengths=photograph.lines(100.0))
