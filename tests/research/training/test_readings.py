"""Readings of cars by eye: the committed tables, and the way from a chip to its image."""

from __future__ import annotations

import csv
import math
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip("torch")

from research.training.readings.candidates import Candidate
from research.training.readings.sheets import choose, distinct, ground_position
from research.training.readings.table import (
    ENDS_COLUMNS,
    HERE,
    KINDS,
    KINDS_COLUMNS,
    Reading,
    ends_row,
    in_image,
    kind_of,
    parse_ends,
)
from research.training.readings.views import ENDS, Chip, View, draw_sheet

OFFSETS = ("end1_px", "end2_px", "side1_px", "side2_px")
CARS_OF_A_PHOTOGRAPH = 6


def _rows(name: str) -> list[dict[str, str]]:
    with (HERE / name).open(newline="", encoding="utf-8") as handle:
        return list(csv.DictReader(handle))


def _chip(view: View, box: tuple[float, ...] = (300.0, 200.0, 80.0, 36.0, 0.4), file: str = "a.png") -> Chip:
    return Chip("sheet", 1, file, "place", box, 0.9, view)


@pytest.mark.parametrize("flip", [1, -1])
@pytest.mark.parametrize("angle", [0.0, 0.7, -2.0])
def test_a_point_of_the_image_comes_back_from_the_chip(flip: int, angle: float) -> None:
    view = View(300.0, 200.0, angle, 4.5, flip, 250.0, 150.0)
    points = np.array([[300.0, 200.0], [310.5, 190.25], [0.0, 0.0]])
    assert np.allclose(view.to_image(view.to_chip(points)), points)
    assert np.allclose(view.to_chip(points[:1]), [[250.0, 150.0]])


def test_a_chip_shows_along_its_angle_to_the_right_and_a_flipped_one_to_the_left() -> None:
    ahead = np.array([[300.0 + math.cos(0.7), 200.0 + math.sin(0.7)]])
    assert np.allclose(View(300.0, 200.0, 0.7, 4.0, 1, 250.0, 150.0).to_chip(ahead), [[254.0, 150.0]])
    assert np.allclose(View(300.0, 200.0, 0.7, 4.0, -1, 250.0, 150.0).to_chip(ahead), [[246.0, 150.0]])


@pytest.mark.parametrize("flip", [1, -1])
def test_a_chip_is_drawn_where_its_coordinates_say(flip: int) -> None:
    image = np.zeros((400, 600, 3), np.uint8)
    image[180:190, 310:330] = 255
    view = View(300.0, 200.0, 0.5, 4.0, flip, 250.0, 150.0)
    rows, columns = np.nonzero(view.draw(image, ENDS.width, ENDS.height)[:, :, 0] > 128)
    expected = view.to_chip(np.array([[319.5, 184.5]]))[0]
    assert (columns.mean(), rows.mean()) == pytest.approx(expected, abs=0.5)


@pytest.mark.parametrize("zoom", [1.0, 5.0])
def test_edges_read_on_a_chip_become_offsets_from_the_box(zoom: float) -> None:
    box = (300.0, 200.0, 80.0, 36.0, 0.4)
    plain = View(300.0, 200.0, 0.4, zoom, 1, 250.0, 150.0)
    edges = (250 - 38 * zoom, 250 + 41 * zoom, 150 - 15 * zoom, 150 + 17 * zoom)
    assert in_image(Reading(_chip(plain, box), edges, "hatch", "none")) == pytest.approx([-38, 41, -15, 17])
    mirrored = plain._replace(flip=-1)
    assert in_image(Reading(_chip(mirrored, box), edges, "hatch", "none")) == pytest.approx([-41, 38, -15, 17])


def test_an_edge_that_is_missing_leaves_no_size() -> None:
    reading = Reading(_chip(View(300.0, 200.0, 0.4, 5.0, 1, 250.0, 150.0)), (50.0, None, 80.0, 220.0), "van", "up")
    row = dict(zip(ENDS_COLUMNS, ends_row(reading), strict=True))
    assert (row["missing"], row["length_px"], row["width_px"], row["camera_side"]) == ("end2", "", "28.00", "side1")


def test_notes_leave_out_a_car_that_another_chip_shows(tmp_path: Path) -> None:
    notes = tmp_path / "ends.txt"
    notes.write_text("sheet\n1 10 - 20 30 van up\n2 dup\n")
    chip = _chip(View(0.0, 0.0, 0.0, 1.0, 1, 0.0, 0.0))
    assert list(parse_ends(notes, [chip])) == [Reading(chip, (10.0, None, 20.0, 30.0), "van", "up")]


def test_a_chip_survives_its_table() -> None:
    chip = _chip(View(300.0, 200.0, 0.4, 5.0, -1, 250.0, 150.0))
    assert Chip.of_row([str(cell) for cell in chip.row()]) == chip


def test_a_sheet_has_room_for_every_chip_and_its_rulers(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.full((400, 600, 3), 90, np.uint8))
    sheet = draw_sheet([_chip(View(300.0, 200.0, 0.4, 5.0, 1, 250.0, 150.0))], ENDS, tmp_path)
    assert sheet.shape == (
        ENDS.rows * (ENDS.height + 2 * ENDS.margin),
        ENDS.columns * (ENDS.width + 2 * ENDS.margin),
        3,
    )


def test_images_of_one_ground_show_each_car_once() -> None:
    fine = Candidate("mashiki_z21_1810520_845998.jpg", "mashiki", 400.0, 300.0, 60.0, 27.0, 0.0, 0.9)
    coarse = Candidate("mashiki_z20_905260_422999.jpg", "mashiki", 200.0, 150.0, 30.0, 13.0, 0.0, 0.9)
    assert ground_position(fine) == pytest.approx(ground_position(coarse))
    assert distinct([fine, coarse, coarse._replace(x=240.0)]) == [fine, coarse._replace(x=240.0)]


def test_a_photograph_gives_no_more_cars_than_asked_for_with_those_drawn_before() -> None:
    cars = [Candidate("a.jpg", "place", 50.0 * k, 10.0, 40.0, 18.0, 0.0, 0.9) for k in range(9)]
    assert len(choose(cars, [], 6)) == 6
    assert len(choose(cars, cars[:4], 6)) == 2


@pytest.mark.parametrize(
    ("body", "length_m", "place", "kind"),
    [
        ("hatch", 3.41, "mashiki", "kei"), ("hatch", 3.41, "bergamo", "small"), ("hatch", 4.2, "fuji", "compact"),
        ("hatch", 4.7, "fuji", "saloon"), ("hatch", None, "jekhor", "compact"), ("van", 3.4, "fuji", "kei"),
        ("van", 4.7, "fuji", "van"), ("keitruck", 3.4, "fuji", "kei"), ("keitruck", 4.7, "mashiki", "pickup"),
        ("kei", 3.8, "mashiki", "small"), ("suv", 3.4, "chia", "suv"),
    ],
)  # fmt: skip
def test_two_box_cars_are_told_apart_by_length(body: str, length_m: float | None, place: str, kind: str) -> None:
    assert kind_of(body, length_m, place) == kind


def test_the_table_of_ends_and_sides_is_complete() -> None:
    rows = _rows("ends_and_sides.csv")
    assert tuple(rows[0]) == ENDS_COLUMNS
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
    assert tuple(rows[0]) == KINDS_COLUMNS
    assert {row["kind"] for row in rows} <= set(KINDS)
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
