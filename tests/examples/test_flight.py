"""The flight of the examples works: every photograph has a usable scale, those without cars by overlaps."""

from __future__ import annotations

import pytest

from tests.conftest import ROOT
from vehanchor_flight.verbs import estimate_flight

FLIGHT = ROOT / "examples/flight"
GSDS = {"1.jpg": 0.12, "2.jpg": 0.122, "3.jpg": 0.119, "4.jpg": 0.121, "5.jpg": 0.12, "6.jpg": 0.118}


@pytest.mark.slow
def test_all_photographs_of_the_flight_have_a_usable_scale() -> None:
    record = estimate_flight([FLIGHT / name for name in GSDS])
    assert record.status == "ok"
    assert len(record.components) == 1
    for photograph, gsd in zip(record.photographs, GSDS.values(), strict=True):
        assert photograph.gsd_ci95_low_m_per_px is not None
        assert photograph.gsd_ci95_high_m_per_px is not None
        assert photograph.gsd_ci95_low_m_per_px < gsd < photograph.gsd_ci95_high_m_per_px
    last = record.photographs[-1]
    assert last.own is not None
    assert last.own.status == "no_scale"
    assert last.supported_by[0].photograph != last.photograph


def test_the_photographs_are_small() -> None:
    assert sum(path.stat().st_size for path in FLIGHT.iterdir()) < 1_500_000
