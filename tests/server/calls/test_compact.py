"""Short answers have the fields that records mark as ``Short``."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
import pytest
from pydantic import Field

from tests.analyses import make_analysis
from vehanchor.records import EstimateDetails, GsdEstimate
from vehanchor.records.record import Record, Short
from vehanchor_server.calls.compact import brief, short_record


class Shadow(Record):
    """Record in a new field."""

    length_px: Annotated[float, Short()]
    azimuth_deg: float


class Lens(Record):
    """Record without marks in a new field."""

    name: str
    focal_length_px: float


class Details(EstimateDetails):
    """Details with new fields."""

    shadow_share: Annotated[float, Short()] = 0.12345
    unmarked: float = 1.0
    chance: Annotated[float, Short(round_down=True)] = 0.89996
    missing: Annotated[float | None, Short()] = None
    shown_as_null: Annotated[float | None, Short(when_null=True)] = None
    shadow: Annotated[Shadow, Short()] = Field(default=Shadow(length_px=12.3456, azimuth_deg=120.0))
    lens: Annotated[Lens, Short()] = Field(default=Lens(name="wide", focal_length_px=123.456))


@pytest.fixture
def short() -> dict[str, Any]:
    """A short answer with the new fields."""
    estimate = make_analysis(np.zeros((0, 5)), 1000, 1000).estimate
    details = Details(**dict(estimate.details))
    return short_record([estimate.model_copy(update={"details": details})])


def test_a_marked_field_of_the_details_is_beside_the_others(short: dict[str, Any]) -> None:
    assert short["shadow_share"] == 0.123


def test_an_unmarked_field_is_left_out(short: dict[str, Any]) -> None:
    assert "unmarked" not in short
    assert "details" not in short


def test_a_chance_is_rounded_down(short: dict[str, Any]) -> None:
    assert short["chance"] == 0.899


def test_a_null_is_left_out_unless_it_is_a_fact(short: dict[str, Any]) -> None:
    assert "missing" not in short
    assert short["shown_as_null"] is None


def test_a_nested_record_has_its_marked_fields(short: dict[str, Any]) -> None:
    assert short["shadow"] == {"length_px": 12.3}


def test_a_nested_record_without_marks_is_whole(short: dict[str, Any]) -> None:
    assert short["lens"] == {"name": "wide", "focal_length_px": 123.5}


class OnlyIfOk(GsdEstimate):
    """Estimate with a new field for usable results."""

    extent_m: Annotated[float, Short(only_if_ok=True)] = 12.0


@pytest.mark.parametrize(("status", "is_there"), [("ok", True), ("low_confidence", False)])
def test_a_field_for_usable_results_is_left_out_of_others(status: str, is_there: bool) -> None:
    estimate = make_analysis(np.zeros((0, 5)), 1000, 1000).estimate
    changed = OnlyIfOk(**{**dict(estimate), "status": status})
    assert ("extent_m" in short_record([changed])) is is_there


@pytest.mark.parametrize(
    ("message", "words"),
    [
        ("It is short: use it. Then more.", "It is short: use it."),
        (f"The file is not usable: {'a' * 60} is missing: give it.", f"is not usable: {'a' * 60}"),
        (f"The file is not usable: {'a' * 90}: give it.", "The file is not usable."),
    ],
)
def test_a_long_warning_loses_its_last_clauses(message: str, words: str) -> None:
    assert words in brief(message)
    assert len(brief(message)) < 101
