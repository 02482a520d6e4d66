"""Runs that end early, and runs that resume them."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import pytest

from tests.skill.batch.runs import FILES, read_rows
from vehanchor.batch import BatchRow, BatchSummary, run_batch
from vehanchor.batch.worker import Task, Worker
from vehanchor.errors import (
    InvalidParameterError,
    VehAnchorError,
)
from vehanchor.models.runtime import Runtime
from vehanchor.options import Reference, ScaleOptions


@pytest.fixture
def analysed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Files of the computed rows, in order; the third row of a test interrupts its run."""
    files: list[str] = []
    original = Worker.row

    def row(self: Worker, task: Task) -> BatchRow:
        if len(files) == 2:
            files.append("interrupted")
            raise KeyboardInterrupt
        files.append(task.file)
        return original(self, task)

    monkeypatch.setattr(Worker, "row", row)
    return files


class Resumed(NamedTuple):
    """Run that was interrupted after two rows and resumed."""

    summary: BatchSummary
    progress: list[tuple[int, int]]


@pytest.fixture
def resumed(analysed: list[str], detector: Path, table: Path) -> Resumed:
    with pytest.raises(KeyboardInterrupt):
        run_batch(["."], table, detector=detector, workers=1)
    assert not table.exists()
    progress: list[tuple[int, int]] = []
    runtime = Runtime(progress=lambda done, total: progress.append((done, total)))
    summary = run_batch(["."], table, detector=detector, workers=1, runtime=runtime)
    return Resumed(summary, progress)


def test_a_resumed_run_computes_only_missing_rows(analysed: list[str], resumed: Resumed) -> None:
    assert analysed == [*FILES[:2], "interrupted", *FILES[2:]]
    assert resumed.progress == [(2, 4), (3, 4), (4, 4)]


def test_a_resumed_run_counts_all_rows(resumed: Resumed) -> None:
    assert (resumed.summary.n_rows, resumed.summary.n_resumed) == (4, 2)
    assert resumed.summary.statuses == {"ok": 2, "no_scale": 1, "error": 1}


@pytest.mark.usefixtures("resumed")
def test_a_resumed_run_ends_with_the_table_of_an_uninterrupted_one(
    detector: Path, table: Path
) -> None:
    uninterrupted = table.with_name("at once.jsonl")
    run_batch(["."], uninterrupted, detector=detector, workers=1)
    assert table.read_bytes() == uninterrupted.read_bytes()
    assert sorted(path.name for path in table.parent.iterdir()) == ["at once.jsonl", "table.jsonl"]


@pytest.mark.parametrize(
    "wrong",
    [
        {"detector": "nowhere.onnx"},
        {"runtime": Runtime(providers=["cuda"])},
        {"inputs": ["nowhere"]},
    ],
    ids=["detector", "provider", "input"],
)
def test_an_error_leaves_the_finished_table(
    detector: Path, table: Path, wrong: dict[str, Any]
) -> None:
    right: dict[str, Any] = {
        "inputs": ["cars.png"],
        "output": table,
        "detector": detector,
        "workers": 1,
    }
    run_batch(**right)
    before = table.read_bytes()
    with pytest.raises(VehAnchorError):
        run_batch(**right | {"overwrite": True} | wrong)
    assert table.read_bytes() == before


def test_an_image_that_was_replaced_meanwhile_is_computed_again(
    analysed: list[str], detector: Path, folder: Path, table: Path, tmp_path: Path
) -> None:
    image = tmp_path / "a.png"
    image.write_bytes((folder / "empty.png").read_bytes())
    images = [str(image), "cars.png", "empty.png"]
    with pytest.raises(KeyboardInterrupt):
        run_batch(images, table, detector=detector, workers=1)
    image.write_bytes((folder / "cars.png").read_bytes())
    assert run_batch(images, table, detector=detector, workers=1).n_resumed == 1
    assert [row["n_vehicles"] for row in read_rows(table)] == [20, 20, 0]


def test_rows_of_other_options_are_not_mixed_in(
    analysed: list[str], detector: Path, table: Path
) -> None:
    with pytest.raises(KeyboardInterrupt):
        run_batch(["."], table, detector=detector, workers=1)
    other = ScaleOptions(reference=Reference(4.3))
    with pytest.raises(InvalidParameterError, match=r"reference_length_m None \(now 4.3\)"):
        run_batch(["."], table, detector=detector, workers=1, options=other)
    again = run_batch(
        ["."], table, detector=detector, workers=1, options=other, overwrite=True, details=True
    )
    assert again.n_resumed == 0
    assert {row["reference_length_m"] for row in read_rows(table)} == {4.3, None}


def test_rows_of_other_errors_of_the_detector_are_not_mixed_in(
    analysed: list[str], detector: Path, table: Path, tmp_path: Path
) -> None:
    own = tmp_path / "own.onnx"
    own.write_bytes(detector.read_bytes())
    with pytest.raises(KeyboardInterrupt):
        run_batch(["."], table, detector=own, workers=1)
    (tmp_path / "own.errors.toml").write_text("[boxes]\nlog_sd = 0.2\n")
    with pytest.raises(InvalidParameterError, match="networks_sha256"):
        run_batch(["."], table, detector=own, workers=1)
    assert len(analysed) == 3
