"""Readings of cars by eye: the committed tables."""

from __future__ import annotations

import csv
from collections import Counter

import pytest

from tests.conftest import ROOT

OFFSETS = ("end1_px", "end2_px", "side1_px", "side2_px")
CARS_OF_A_PHOTOGRAPH = 6
KINDS = {
    "kei", "small", "compact", "saloon", "suv", "pickup", "van",
    "lorry", "trailer", "container", "boat", "roof", "unclear",
}  # fmt: skip


def _rows(name: str) -> list[dict[str, str]]:
    with (ROOT / "research/training/readings" / name).open(newline="", encoding="utf-8") as handle:
        return list(csv.DictReader(handle))


def test_the_table_of_ends_and_sides_is_complete() -> None:
    rows = _rows("ends_and_sides.csv")
    for row in rows:
        assert row["kind"] in KINDS
        assert row["use"] in ("train", "check")
        missing = [name for name in OFFSETS if not row[name]]
        assert row["missing"].split() == [name.removesuffix("_px") for name in missing]
        for size, (first, second) in (("length_px", OFFSETS[:2]), ("width_px", OFFSETS[2:])):
            if row[size]:
                assert float(row[size]) == pytest.approx(float(row[second]) - float(row[first]), abs=0.02)
        if row["length_px"] and row["width_px"]:
            assert 0.25 < float(row["width_px"]) / float(row["length_px"]) < 0.6
    assert max(Counter(row["file"] for row in rows).values()) <= CARS_OF_A_PHOTOGRAPH


def test_the_table_of_kinds_is_complete() -> None:
    rows = _rows("kinds.csv")
    assert {row["kind"] for row in rows} <= KINDS
    assert {row["use"] for row in rows} == {"train", "check"}


@pytest.mark.parametrize("name", ["ends_and_sides.csv", "kinds.csv"])
def test_no_car_is_read_twice(name: str) -> None:
    cars = Counter((row["file"], row["x"], row["y"]) for row in _rows(name))
    assert max(cars.values()) == 1


def test_whole_photographs_are_kept_for_checking() -> None:
    uses: dict[str, set[str]] = {}
    for row in _rows("ends_and_sides.csv") + _rows("kinds.csv"):
        uses.setdefault(row["file"], set()).add(row["use"])
    assert all(len(use) == 1 for use in uses.values())
