"""Things of known size: the catalogue, and lines at its things."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from tests.analyses import log_sd, made_card, measured
from tests.skill.rulers.test_answers import record_of
from vehanchor.cli.app import app
from vehanchor.detection.detections import Detections
from vehanchor.errors import KnownLengthError
from vehanchor.imagery.facts import ImageFacts
from vehanchor.imagery.metadata.camera import CameraMetadata
from vehanchor.options import ScaleOptions
from vehanchor.rulers.active import check_rulers
from vehanchor.rulers.known_length import KnownLengths
from vehanchor.rulers.known_length_table import lines_in
from vehanchor.rulers.ruler import View
from vehanchor.rulers.standards import lengths_of, standards
from vehanchor.scale.countries import COUNTRY_REGIONS


def _view(camera: CameraMetadata | None = None, **options: Any) -> View:
    found = Detections(np.zeros((0, 5)), np.zeros(0))
    return View(
        ImageFacts(4000, 3000, camera=camera),
        found,
        card=made_card(5.0),
        options=ScaleOptions.of(options),
        measure_detail_share=lambda *_: 1.0,
    )


WIDEST_CUSTOM = 0.25


def _evidence(what: str, *lengths_px: float, **options: Any) -> Any:
    lines = [(100, 100 + 10 * k, 100 + px, 100 + 10 * k, what) for k, px in enumerate(lengths_px)]
    return measured(KnownLengths(), _view(known_lengths=lines, **options))


@pytest.mark.parametrize("name", standards())
def test_a_thing_has_a_source_its_ends_a_spread_and_measures(name: str) -> None:
    thing = standards()[name]
    assert name.isidentifier()
    assert name.islower()
    assert any(character.isdigit() for character in thing.source) or thing.source.startswith("as ")
    assert len(thing.between) > 10
    assert 0.05 <= thing.chance_wrong <= 0.3
    assert sum(each.weight for each in thing.lengths_in(None)) == pytest.approx(1)
    for each in thing.variants:
        assert 1 <= each.metres <= 120
        assert 0.005 <= each.log_sd <= WIDEST_CUSTOM
        assert all(
            (len(code) == 2 and code.isupper()) or code in COUNTRY_REGIONS.values()
            for code in each.countries
        )
        found = _evidence(name, 200.0, region=each.countries[0] if each.countries else None)
        chosen = thing.lengths_in(each.countries[0] if each.countries else None)
        if len(chosen) == 1:
            assert found.gsd_m_per_px == pytest.approx(each.metres / 200, rel=0.01)
        assert found.assumed


def test_the_country_or_the_region_chooses_and_without_one_the_mixture_stays() -> None:
    assert [each.metres for each in lengths_of("railway_gauge/RU")[1]] == [1.52]
    assert [each.metres for each in lengths_of("lane_dash_cycle", "north_america")[1]] == [12.19]
    assert [each.metres for each in lengths_of("lane_dash_cycle", "us")[1]] == [12.19]
    assert [each.metres for each in lengths_of("city_bus", "SE")[1]] == [12.0]
    assert [each.metres for each in lengths_of("railway_gauge/RU", "us")[1]] == [1.52]
    assert {each.metres for each in lengths_of("railway_gauge", "europe")[1]} == {
        1.435,
        1.52,
        1.6,
        1.668,
    }
    everywhere = _evidence("lane_dash_cycle", 200.0)
    american = _evidence("lane_dash_cycle", 200.0, region="north_america")
    assert american.gsd_m_per_px == pytest.approx(12.19 / 200, rel=0.01)
    width = math.log(american.interval.high / american.interval.low)
    assert math.log(everywhere.interval.high / everywhere.interval.low) > 3 * width


def test_things_of_one_kind_share_their_size() -> None:
    one = _evidence("parking_bay_width/DE", 50.0)
    many = _evidence("parking_bay_width/DE", 50.0, 50.2, 49.9, 50.1)
    assert many.n == 4
    assert many.interval.high / many.interval.low > 1.12  # the custom's spread stays
    assert many.interval.high / many.interval.low < one.interval.high / one.interval.low
    both = measured(
        KnownLengths(),
        _view(
            known_lengths=[
                (0, 0, 50, 0, "parking_bay_width/DE"),
                (0, 9, 242, 9, "iso_container_40ft"),
            ]
        ),
    )
    assert both.n == 2
    assert log_sd(both) < log_sd(many)


def test_one_thing_alone_is_usable_only_if_its_kind_allows() -> None:
    def status(what: str) -> str:
        return record_of(0, known_lengths=[(100, 100, 300, 100, what)]).status

    assert status("football_penalty_area_width") == "ok"
    assert status("railway_gauge/DE") == "ok"
    assert status("railway_gauge") == "low_confidence"
    assert status("parking_bay_length") == "low_confidence"


def test_two_things_of_one_family_are_one_witness() -> None:
    def record(*whats: str) -> Any:
        metres = {what: standards()[what].variants[0].metres for what in whats}
        lines = [
            (100, 100 + 9 * k, 100 + metres[what] / 0.05, 100 + 9 * k, what)
            for k, what in enumerate(whats)
        ]
        return record_of(0, known_lengths=lines)

    same = record("iso_container_20ft", "iso_container_width")
    assert (same.status, same.gsd_m_per_px) == ("ok", pytest.approx(0.05, rel=0.01))
    assert record("iso_container_20ft", "semi_trailer").confidence == pytest.approx(
        same.confidence, abs=0.02
    )


@pytest.mark.parametrize(
    ("what", "words"),
    [
        ("parking_width", "parking_bay_width: the centres of two neighbouring lines"),
        ("Container", "iso_container_20ft: the two ends"),
        ("railway_gauge/Spain", "use two capital letters, as in railway_gauge/DE"),
    ],
)
def test_a_wrong_name_is_refused_before_the_work_with_the_nearest(what: str, words: str) -> None:
    with pytest.raises(KnownLengthError, match=words):
        check_rulers(ScaleOptions.of({"known_lengths": [(0, 0, 50, 0, what)]}).rulers)


def test_a_table_takes_names(tmp_path: Any) -> None:
    table = tmp_path / "lines.csv"
    table.write_text(
        "file,x1,y1,x2,y2,metres,what\na.png,0,0,50,0,pool_50m,\na.png,0,9,50,9,,railway_gauge/ES\n"
    )
    (lines,) = lines_in(table, [tmp_path / "a.png"]).values()
    assert [line.what for line in lines] == ["pool_50m", "railway_gauge/ES"]
    table.write_text("file,x1,y1,x2,y2,metres\na.png,0,0,50,0,pool_51m\n")
    with pytest.raises(
        KnownLengthError, match="line 2: there is no thing of known size 'pool_51m'"
    ):
        lines_in(table, [tmp_path / "a.png"])


def test_the_command_lists_every_thing_with_its_lengths_and_source() -> None:
    shown = CliRunner().invoke(app, ["models", "--sizes"], env={"COLUMNS": "100"}).stdout
    assert all(name in shown for name in standards())
    rows = [
        json.loads(line)
        for line in CliRunner().invoke(app, ["models", "--sizes", "--json"]).stdout.splitlines()
    ]
    assert [row["name"] for row in rows] == list(standards())
    assert all(row["variants"][0]["metres"] > 0 and row["source"] for row in rows)


def test_the_cars_choose_among_the_lengths_of_a_mixture() -> None:
    spread = np.array([12.19, 18.0])
    # cars: 0.1 m/px
    record = record_of(
        30, known_lengths=[(100, 100, 100 + spread[1] / 0.1, 100, "lane_dash_cycle")]
    )
    assert record.status == "ok"
    assert record.gsd_m_per_px == pytest.approx(0.1, rel=0.03)
