"""The page of renamed fields: what it calls today's name exists."""

from __future__ import annotations

import re
from typing import get_args

import pytest
from pydantic import BaseModel

from tests.conftest import ROOT
from vehanchor import records
from vehanchor.batch.row import COLUMNS
from vehanchor.records.flat import flat_columns
from vehanchor.records.notices import NoticeCode
from vehanchor.scale.defaults import Stopped
from vehanchor_flight import records as flight_records

PAGE = (ROOT / "docs" / "records-names.md").read_text(encoding="utf-8")
_NAMED = {**vars(records), **vars(flight_records)}
RECORDS = [each for each in _NAMED.values() if isinstance(each, type) and issubclass(each, BaseModel)]


def _names_now() -> list[str]:
    """Names in the columns whose heading begins with "now", of the records and the tables."""
    found: list[str] = []
    now = None
    for line in PAGE.partition("## Options")[0].splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")] if line.startswith("|") else []
        headings = [cell.startswith("now") for cell in cells]
        if any(headings):
            now = headings.index(True)
        elif cells and now is not None:
            found += [name.rpartition(".")[2] for name in re.findall(r"`([\w.\[\]]+)`", cells[now])]
    return found


@pytest.mark.parametrize("name", sorted(set(_names_now())))
def test_a_new_name_exists(name: str) -> None:
    fields = {field for record in RECORDS for field in record.model_fields}
    columns = {column for record in RECORDS for column in flat_columns(record)} | set(COLUMNS)
    classes = {record.__name__ for record in RECORDS}
    words = {*NoticeCode, *get_args(records.Status), *get_args(Stopped)}
    assert name in fields | columns | classes | words


def test_the_page_names_what_was_renamed() -> None:
    assert {"leading_ruler", "estimate", "supported_by", "not_linked", "tilt_gsd_least_m_per_px"} < set(_names_now())
