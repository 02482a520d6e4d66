"""Helpers of the tests of batch runs."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from typer.testing import CliRunner, Result

from vehanchor.batch import run_batch
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


def check_names_that_look_alike(
    folder: Path, detector: Path, tmp_path: Path, *, engine: Any
) -> None:
    """Check the rows of an image with cars and one without, whose names a table shows alike."""
    images = tmp_path / "images"
    images.mkdir()
    for name, source in ((b"a\xff.png", "cars.png"), (rb"a\udcff.png", "empty.png")):
        path = images / os.fsdecode(name)
        path.write_bytes((folder / source).read_bytes())
    table = tmp_path / "table.jsonl"
    run_batch([str(images)], table, detector=detector, workers=1, engine=engine)
    rows = read_rows(table)
    assert len({row["photograph"] for row in rows}) == 1
    assert sorted(row["status"] for row in rows) == ["no_scale", "ok"]
