from __future__ import annotations

import pytest

from research.paper.stated_area import read_area


@pytest.mark.parametrize(
    ("text", "area"),
    [
        ("AREA=120", 120),
        ("so 10 x 12\nAREA = 1,234.5 m²", 1234.5),
        ("**AREA=1,234**", 1234),
        ("`AREA=450`", 450),
        ("AREA=1,234,567.89", 1234567.89),
        ("AREA=1.2e3", 1200),
        ("AREA=\\boxed{450}", 450),
        ("AREA=approximately 450 square meters.", 450),
        ("AREA=450 (from 3 cars)", 450),
        ("AREA=100 ± 20", 100),
        ("AREA=<number>\n...\nAREA=77", 77),
    ],
)
def test_an_area_is_read_with_its_unit_and_separators(text: str, area: float) -> None:
    stated = read_area(text)
    assert stated.problem is None
    assert stated.area_m2 == pytest.approx(area)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("It is about 450 m².", "no_area_line"),
        ("", "no_area_line"),
        ("AREA=N/A", "no_number"),
        ("AREA=-5", "no_number"),
        ("AREA=1,2,3", "no_number"),
        ("AREA=1.234,5", "no_number"),
        ("AREA=100-200", "unknown_unit"),
        ("AREA=100 to 200", "unknown_unit"),
        ("AREA=10 x 12 = 120", "unknown_unit"),
        ("AREA=450 pixels", "unknown_unit"),
        ("AREA=450 m", "unknown_unit"),
        ("AREA=2 km2", "unknown_unit"),
    ],
)
def test_what_is_no_area_is_refused_with_its_reason(text: str, problem: str) -> None:
    assert read_area(text) == (None, problem)
