"""Things of known size: the catalogue, and lines at its things."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest
from typer.testing import CliRunner

from tests.analyses import empty_view, log_sd, measured
from tests.skill.rulers.test_answers import record_of
from vehanchor.cli.app import app
from vehanchor.errors import KnownLengthError
from vehanchor.options import ScaleOptions
from vehanchor.records import GsdEstimate
from vehanchor.rulers.active import check_rulers
from vehanchor.rulers.known_length import KnownLengths
from vehanchor.rulers.known_length_table import lines_in
from vehanchor.rulers.standards import Variant, check_name, lengths_of, standards
from vehanchor.scale.countries import COUNTRY_REGIONS

WIDEST_CUSTOM = 0.25


def _evidence(what: str, *lengths_px: float, **options: Any) -> Any:
    lines = [(100, 100 + 10 * k, 100 + px, 100 + 10 * k, what) for k, px in enumerate(lengths_px)]
    return measured(KnownLengths(), empty_view(known_lengths=lines, **options))


VARIANTS = [(name, variant) for name, thing in standards().items() for variant in thing.variants]


@pytest.mark.parametrize("name", standards())
def test_the_name_of_a_thing_is_a_lower_case_identifier(name: str) -> None:
    assert name.isidentifier()
    assert name.islower()


@pytest.mark.parametrize("name", standards())
def test_a_thing_has_a_source(name: str) -> None:
    source = standards()[name].source
    assert any(character.isdigit() for character in source) or source.startswith("as ")


@pytest.mark.parametrize("name", standards())
def test_a_thing_describes_its_ends(name: str) -> None:
    assert len(standards()[name].between) > 10


@pytest.mark.parametrize("name", standards())
def test_a_thing_may_be_mistaken(name: str) -> None:
    assert 0.05 <= standards()[name].chance_wrong <= 0.3


@pytest.mark.parametrize("name", standards())
def test_the_weights_of_all_lengths_add_up_to_1(name: str) -> None:
    weights = [variant.weight for variant in standards()[name].lengths_in(None)]
    assert sum(weights) == pytest.approx(1)


@pytest.mark.parametrize(("name", "variant"), VARIANTS)
def test_a_length_with_its_spread_is_plausible(name: str, variant: Variant) -> None:
    assert 0.4 <= variant.metres <= 120
    assert 0.005 <= variant.log_sd <= WIDEST_CUSTOM


@pytest.mark.parametrize(("name", "variant"), VARIANTS)
def test_a_length_names_countries_or_regions(name: str, variant: Variant) -> None:
    for code in variant.countries:
        is_country = len(code) == 2 and code.isupper()
        assert is_country or code in COUNTRY_REGIONS.values()


@pytest.mark.parametrize(("name", "variant"), VARIANTS)
def test_a_thing_measures_by_the_length_of_its_country(name: str, variant: Variant) -> None:
    country = variant.countries[0] if variant.countries else None
    witness = _evidence(name, 100.0, region=country)
    if len(standards()[name].lengths_in(country)) == 1:
        assert witness.gsd_m_per_px == pytest.approx(variant.metres / 100, rel=0.01)
    assert witness.assumed


@pytest.mark.parametrize(
    ("what", "region", "metres"),
    [
        ("railway_gauge/RU", None, [1.52]),
        ("lane_dash_cycle", "north_america", [12.19, 14.63]),
        ("lane_dash_cycle", "us", [12.19, 14.63]),
        ("lane_dash_cycle", "CA", [12.19]),
        ("city_bus", "SE", [12.0]),
        ("railway_gauge/RU", "us", [1.52]),
        ("railway_gauge", "europe", [1.435, 1.52, 1.6, 1.668]),
    ],
)
def test_the_country_or_the_region_selects_the_lengths(
    what: str, region: str | None, metres: list[float]
) -> None:
    _, variants = lengths_of(what, region)
    if len(metres) == 1:
        assert [variant.metres for variant in variants] == metres
    assert {variant.metres for variant in variants} == set(metres)


def test_a_region_gives_the_scale_of_its_length() -> None:
    american = _evidence("lane_dash_cycle", 200.0, region="north_america")
    assert american.gsd_m_per_px == pytest.approx(12.19 / 200, rel=0.01)


def test_without_a_region_all_lengths_are_in_the_interval() -> None:
    everywhere = _evidence("lane_dash_cycle", 200.0).interval
    french = _evidence("lane_dash_cycle", 200.0, region="FR").interval
    french_width = math.log(french.high / french.low)
    assert math.log(everywhere.high / everywhere.low) > 3 * french_width


def test_things_of_one_kind_share_their_size() -> None:
    one = _evidence("parking_bay_width/DE", 50.0)
    many = _evidence("parking_bay_width/DE", 50.0, 50.2, 49.9, 50.1)
    assert many.n == 4
    many_width = many.interval.high / many.interval.low
    assert many_width > 1.12  # the custom's spread stays
    assert many_width < one.interval.high / one.interval.low


def test_things_of_two_kinds_narrow_the_interval() -> None:
    many = _evidence("parking_bay_width/DE", 50.0, 50.2, 49.9, 50.1)
    lines = [(0, 0, 50, 0, "parking_bay_width/DE"), (0, 9, 242, 9, "iso_container_40ft")]
    both = measured(KnownLengths(), empty_view(known_lengths=lines))
    assert both.n == 2
    assert log_sd(both) < log_sd(many)


@pytest.mark.parametrize(
    ("first", "second", "status"),
    [
        ("football_penalty_area_width", "tennis_court_length", "ok"),
        ("railway_gauge/DE", "iso_container_40ft", "ok"),
        ("football_penalty_area_width", "football_penalty_area_depth", "low_confidence"),
        ("railway_gauge/DE", "parking_bay_length", "low_confidence"),
        ("motorway_lane_width", "zebra_period", "low_confidence"),
    ],
)
def test_two_things_are_usable_only_if_they_are_exact_and_of_two_kinds(
    first: str, second: str, status: str
) -> None:
    assert _record_of_things(first, second).status == status


@pytest.mark.parametrize(
    "what", ["football_penalty_area_width", "railway_gauge/DE", "parking_bay_length"]
)
def test_one_thing_alone_is_not_usable(what: str) -> None:
    assert record_of(0, known_lengths=[(100, 100, 300, 100, what)]).status == "low_confidence"


def _record_of_things(*whats: str) -> GsdEstimate:
    """Lines at things of known size, all at 0.05 m/px."""
    lines = []
    for k, what in enumerate(whats):
        metres = lengths_of(what)[1][0].metres
        lines.append((100, 100 + 9 * k, 100 + metres / 0.05, 100 + 9 * k, what))
    return record_of(0, known_lengths=lines)


@pytest.mark.parametrize("count", ["9 x ", "9x", "9*"])
def test_a_line_over_equal_things_is_as_long_as_all_of_them(count: str) -> None:
    one = _evidence("running_track_lane", 50.0)
    nine = _evidence(f"{count}running_track_lane", 450.0)
    assert nine.gsd_m_per_px == pytest.approx(one.gsd_m_per_px, rel=0.01)


def test_a_line_over_many_things_is_more_exact_than_over_one() -> None:
    one = _evidence("railway_gauge/DE", 10.0)
    nine = _evidence("9 x railway_gauge/DE", 90.0)
    assert log_sd(nine) < 0.5 * log_sd(one)


def test_a_row_and_one_of_its_things_are_one_kind() -> None:
    one = (100, 100, 150, 100, "parking_bay_width/DE")
    row = (100, 300, 550, 300, "9 x parking_bay_width")
    alone = record_of(0, known_lengths=[row])
    both = record_of(0, known_lengths=[row, one])
    assert both.confidence == pytest.approx(alone.confidence, abs=0.01)


def test_a_row_is_given_as_text() -> None:
    options = ScaleOptions.of({"known_lengths": ["10 20 300 20 9 x parking_bay_width/DE"]})
    (line,) = options.rulers.known_lengths
    assert (line.what, line.n_things) == ("parking_bay_width/DE", 9)


def test_two_things_of_one_family_are_one_witness() -> None:
    same = _record_of_things("iso_container_20ft", "iso_container_width")
    assert same.status == "low_confidence"
    assert same.gsd_m_per_px == pytest.approx(0.05, rel=0.01)
    other = _record_of_things("iso_container_20ft", "semi_trailer")
    assert other.confidence == pytest.approx(same.confidence, abs=0.02)


@pytest.mark.parametrize(
    ("what", "words"),
    [
        ("parking_width", "parking_bay_width: the centres of two neighbouring lines"),
        ("Container", "iso_container_20ft: the two ends"),
        ("railway_gauge/Spain", "use two capital letters, as in railway_gauge/DE"),
    ],
)
def test_a_wrong_name_is_refused_before_the_work(what: str, words: str) -> None:
    with pytest.raises(KnownLengthError, match=words):
        check_rulers(ScaleOptions.of({"known_lengths": [(0, 0, 50, 0, what)]}).rulers)


def test_a_table_of_lines_takes_names(tmp_path: Any) -> None:
    table = tmp_path / "lines.csv"
    table.write_text(
        "file,x1,y1,x2,y2,metres,what\na.png,0,0,50,0,pool_50m,\na.png,0,9,50,9,,railway_gauge/ES\n"
    )
    (lines,) = lines_in(table, [tmp_path / "a.png"]).values()
    assert [line.what for line in lines] == ["pool_50m", "railway_gauge/ES"]


def test_a_wrong_name_in_a_table_is_refused_by_its_line(tmp_path: Any) -> None:
    table = tmp_path / "lines.csv"
    table.write_text("file,x1,y1,x2,y2,metres\na.png,0,0,50,0,pool_51m\n")
    with pytest.raises(
        KnownLengthError, match="line 2: there is no thing of known size 'pool_51m'"
    ):
        lines_in(table, [tmp_path / "a.png"])


def _refusal(name: str) -> str:
    """Refuse an unknown name, and return the message."""
    with pytest.raises(KnownLengthError) as caught:
        check_name(name)
    return str(caught.value)


@pytest.mark.parametrize(
    ("name", "nearest"),
    [
        ("pool_51m", "pool_50m"),
        ("Tennis-Court", "tennis_court_width"),
        ("container_20ft/DE", "iso_container_20ft"),
    ],
)
def test_an_unknown_name_is_refused_with_the_nearest_names(name: str, nearest: str) -> None:
    message = _refusal(name)
    named = [thing for thing in standards() if thing in message]
    assert nearest in named
    assert len(named) == 5


@pytest.mark.parametrize("name", ["", "zzz", "x" * 10_000])
def test_the_error_about_an_unknown_name_is_short(name: str) -> None:
    message = _refusal(name)
    assert len(message) < 550
    assert "'vehanchor models --sizes'" in message


def test_the_command_lists_every_thing() -> None:
    shown = CliRunner().invoke(app, ["models", "--sizes"], env={"COLUMNS": "100"}).stdout
    assert all(name in shown for name in standards())


def test_the_command_prints_every_thing_as_json() -> None:
    lines = CliRunner().invoke(app, ["models", "--sizes", "--json"]).stdout.splitlines()
    rows = [json.loads(line) for line in lines]
    assert [row["name"] for row in rows] == list(standards())
    assert all(row["variants"][0]["metres"] > 0 and row["source"] for row in rows)


def test_the_cars_choose_among_the_lengths_of_a_mixture() -> None:
    # The cars have 0.1 m/px: the cycle of 18 m fits, that of 12.19 m does not.
    line = (100, 100, 100 + 18.0 / 0.1, 100, "lane_dash_cycle")
    record = record_of(30, known_lengths=[line])
    assert record.status == "ok"
    assert record.gsd_m_per_px == pytest.approx(0.1, rel=0.03)
