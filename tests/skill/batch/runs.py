"""Helpers of the tests of batch runs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from typer.testing import CliRunner, Result

from vehanchor.cli import app as cli
from vehanchor.records import GsdEstimate
from vehanchor.records.columns import COLUMNS

FILES = ["broken.jpg", "cars.png", "deep/below/cars.PNG", "empty.png"]
"""Images in the fixture ``folder``, in the order of a table."""


def read_rows(table: Path) -> list[dict[str, Any]]:
    """Read a table of JSON lines."""
    return [json.loads(line) for line in table.read_text().splitlines()]


def run_command(*arguments: object) -> Result:
    """Run ``vehanchor batch``."""
    return CliRunner().invoke(cli.app, ["batch", *map(str, arguments)])


def assert_same_fields(row: dict[str, Any], estimate: GsdEstimate) -> None:
    """Check that the common columns of a row have the values of an estimate."""
    for name in set(GsdEstimate.model_fields) & set(COLUMNS):
        assert row[name] == getattr(estimate, name), name
