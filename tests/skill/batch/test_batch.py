"""Rows and tables of a run."""

from __future__ import annotations

import csv
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.skill.batch.runs import (
    FILES,
    assert_same_fields,
    check_names_that_look_alike,
    read_rows,
)
from vehanchor import estimate_gsd
from vehanchor.batch import BatchJob, run_batch
from vehanchor.batch.worker import Task, Worker
from vehanchor.detection.detector import Detector
from vehanchor.errors import (
    InvalidParameterError,
    MissingExtraError,
    ModelContractError,
    OutputError,
)
from vehanchor.options import ScaleOptions
from vehanchor.records import GsdEstimate
from vehanchor.records.columns import ALL_COLUMNS, COLUMNS

# The scene-scale prior does not know painted pictures, and takes time.
ALONE = {"rulers": ("vehicles",)}


# --- Rows and columns


@pytest.fixture(scope="module")
def detailed_rows(
    folder: Path, detector: Path, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, dict[str, Any]]:
    """Rows with all columns, by file."""
    table = tmp_path_factory.mktemp("detailed") / "table.jsonl"
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        run_batch(["."], table, detector=detector, workers=1, details=True)
    return {row["photograph"]: row for row in read_rows(table)}


@pytest.fixture(scope="module")
def cars_estimate(folder: Path, detector: Path) -> GsdEstimate:
    return estimate_gsd(folder / "cars.png", detector=detector)


def test_a_run_has_a_row_for_each_image(detailed_rows: dict[str, dict[str, Any]]) -> None:
    assert list(detailed_rows) == FILES


def test_a_row_has_the_fields_of_the_estimate(
    detailed_rows: dict[str, dict[str, Any]], cars_estimate: GsdEstimate
) -> None:
    cars = detailed_rows["cars.png"]
    assert_same_fields(cars, cars_estimate)
    assert cars["warning_codes"] == " ".join(notice.code for notice in cars_estimate.warnings)
    assert (cars["error_code"], cars["error"]) == (None, None)


def test_a_row_with_details_has_all_columns(
    detailed_rows: dict[str, dict[str, Any]], cars_estimate: GsdEstimate
) -> None:
    cars = detailed_rows["cars.png"]
    assert list(cars) == list(ALL_COLUMNS)
    assert cars_estimate.details.confidence_terms is not None
    assert cars["confidence_terms_sample"] == cars_estimate.details.confidence_terms.sample


def test_an_image_without_cars_has_a_row_without_a_scale(
    detailed_rows: dict[str, dict[str, Any]],
) -> None:
    empty = detailed_rows["empty.png"]
    assert (empty["status"], empty["gsd_m_per_px"], empty["confidence"]) == ("no_scale", None, 0)


@pytest.mark.skipif(sys.platform != "linux", reason="other systems refuse such names")
def test_images_whose_names_look_alike_have_their_own_rows(
    folder: Path, detector: Path, tmp_path: Path
) -> None:
    check_names_that_look_alike(folder, detector, tmp_path, engine="local")


def test_a_key_is_the_name_with_the_path_and_the_state_of_the_file(folder: Path) -> None:
    """Journals of earlier versions have these keys."""
    path = folder / "cars.png"
    state = path.stat()
    key = Task.of("cars.png").key()
    assert key == ("cars.png", str(path.resolve()), state.st_size, state.st_mtime_ns)


def test_an_unreadable_image_has_a_row_with_the_error(
    detailed_rows: dict[str, dict[str, Any]],
) -> None:
    broken = detailed_rows["broken.jpg"]
    assert (broken["status"], broken["gsd_m_per_px"]) == (None, None)
    assert broken["error_code"] == "image_undecodable"
    assert "not an image in one of the formats JPEG" in broken["error"]


@pytest.mark.parametrize(
    ("error", "code"),
    [(ZeroDivisionError("division by zero"), "internal_error"), (MemoryError(), "out_of_memory")],
)
def test_a_defect_in_one_image_does_not_end_the_run(
    error: Exception, code: str, detector: Path, table: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(Detector, "detect_tile", fail)
    summary = run_batch(["cars.png", "broken.jpg"], table, detector=detector, workers=1)
    assert [row["error_code"] for row in read_rows(table)] == [code, "image_undecodable"]
    assert summary.statuses == {"error": 2}


def test_a_worker_refuses_another_model_than_that_of_the_run(detector: Path) -> None:
    with pytest.raises(ModelContractError, match=r"on this machine .* differ"):
        Worker(BatchJob(str(detector), "0" * 64))


# --- Tables


@pytest.fixture(scope="module")
def tables(folder: Path, detector: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the table of one run in every format."""
    path = tmp_path_factory.mktemp("tables")
    options = ScaleOptions.of(ALONE)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for suffix in ("jsonl", "csv", "parquet"):
            table = path / f"table.{suffix}"
            run_batch(["."], table, detector=detector, workers=1, options=options)
    return path


def test_a_table_of_json_lines_has_all_images_in_order(tables: Path) -> None:
    rows = read_rows(tables / "table.jsonl")
    assert [row["photograph"] for row in rows] == FILES
    assert [list(row) for row in rows] == [list(COLUMNS)] * len(rows)


def test_a_table_has_at_most_24_columns() -> None:
    assert len(COLUMNS) <= 24


def test_a_parquet_table_has_the_same_rows_with_types(tables: Path) -> None:
    import pyarrow.parquet

    parquet = pyarrow.parquet.read_table(tables / "table.parquet")
    assert parquet.to_pylist() == read_rows(tables / "table.jsonl")
    types = [str(kind) for kind in parquet.schema.types[:5]]
    assert types == ["string", "string", "double", "double", "int64"]


def test_a_csv_table_has_the_same_rows_with_empty_nulls(tables: Path) -> None:
    with (tables / "table.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    expected = [
        {name: "" if value is None else str(value) for name, value in row.items()}
        for row in read_rows(tables / "table.jsonl")
    ]
    assert rows == expected


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("table.xlsx", "use one of .parquet, .csv, .jsonl"),
        ("nowhere/table.csv", "no folder"),
        ("a.csv", "a folder"),
    ],
)
def test_an_unwritable_table_is_refused_before_the_work(
    tmp_path: Path, name: str, words: str
) -> None:
    (tmp_path / "a.csv").mkdir()
    with pytest.raises(OutputError, match=words):
        run_batch(["."], tmp_path / name, detector="no model is looked for")


def test_a_complete_table_is_replaced_as_every_file(detector: Path, table: Path) -> None:
    run_batch(["cars.png"], table, detector=detector, workers=1)
    assert [row["photograph"] for row in read_rows(table)] == ["cars.png"]
    run_batch(["empty.png"], table, detector=detector, workers=1)
    assert [row["photograph"] for row in read_rows(table)] == ["empty.png"]


@pytest.mark.parametrize(
    ("module", "arguments", "words"),
    [
        ("pyarrow", {"output": "table.parquet"}, r"pip install '\.\[parquet\]'"),
        ("ray", {"output": "table.csv", "engine": "ray"}, r"pip install '\.\[ray\]'"),
    ],
)
def test_a_missing_extra_is_named(
    module: str,
    arguments: dict[str, Any],
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    arguments["output"] = tmp_path / arguments["output"]
    with pytest.raises(MissingExtraError, match=words):
        run_batch(["."], **arguments)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"engine": "spark"}, "use local or ray"),
        ({"address": "auto"}, "--engine ray"),
        ({"workers": 0}, "whole number"),
        ({"options": ScaleOptions.of({"frame": (10, 10)})}, "frame"),
    ],
)
def test_invalid_options_are_refused(table: Path, arguments: dict[str, Any], words: str) -> None:
    with pytest.raises(InvalidParameterError, match=words):
        run_batch(["."], table, **arguments)
