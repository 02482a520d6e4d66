from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner, Result

from tests.models import car_park, write_detector
from vehanchor import estimate_gsd
from vehanchor.batch import BatchJob, BatchRow, find_images, run_batch
from vehanchor.batch.engines.local import local_workers
from vehanchor.batch.row import ALL_COLUMNS, COLUMNS
from vehanchor.batch.run import journal_path
from vehanchor.batch.worker import Task, Worker
from vehanchor.cli import app as cli
from vehanchor.detection.detector import Detector
from vehanchor.errors import (
    ImageNotFoundError,
    InvalidParameterError,
    KnownLengthError,
    MissingExtraError,
    ModelContractError,
    OutputError,
    VehAnchorError,
    WorkerDiedError,
)
from vehanchor.models.runtime import Runtime
from vehanchor.options import Reference, ScaleOptions
from vehanchor.records import GsdEstimate
from vehanchor.rulers.known_length_table import lines_in

ALONE = {"rulers": ("vehicles",)}  # quicker: the scene-scale prior does not know painted pictures
FILES = ["broken.jpg", "cars.png", "deep/below/cars.PNG", "empty.png"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two images with cars, one without, one that is none; beside them what is no image by its name."""
    path = tmp_path_factory.mktemp("batch")
    (path / "deep" / "below").mkdir(parents=True)
    for name, n_vehicles in (("cars.png", 20), ("empty.png", 0), ("deep/below/cars.PNG", 12)):
        image = car_park(29 + 0.1 * np.arange(n_vehicles), 800, 300)
        cv2.imwrite(str(path / name), image[:, :, ::-1])
    (path / "broken.jpg").write_text("this is no image")
    (path / "notes.txt").write_text("nor is this, and its name says so")
    return path


@pytest.fixture(scope="module")
def detector(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_detector(tmp_path_factory.mktemp("model") / "painted.onnx")


@pytest.fixture
def table(tmp_path: Path) -> Path:
    return tmp_path / "table.jsonl"


@pytest.fixture(autouse=True)
def _in_the_folder(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)


def _rows(table: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in table.read_text().splitlines()]


def _batch(*arguments: object) -> Result:
    return CliRunner().invoke(cli.app, ["batch", *map(str, arguments)])


# --- Which images
#
# ----------------------------------------------------------------------------------------------------


def test_a_directory_is_searched_with_all_below_it_and_sorted(folder: Path) -> None:
    assert find_images([str(folder)]) == [str(folder / name) for name in FILES]


@pytest.mark.parametrize(
    "names", [["nowhere"], ["cars.png", "nowhere"], ["nowhere.png/"], ["a.png", "b.jpg"]]
)
def test_a_folder_that_does_not_exist_is_an_error_and_nothing_is_written(
    names: list[str], tmp_path: Path
) -> None:
    result = _batch(*names, "--output", tmp_path / "table.csv")
    assert result.exit_code == 2
    assert result.stderr.startswith("error[image_not_found]: there is no file")
    assert list(tmp_path.iterdir()) == []


def test_patterns_files_and_directories_are_taken_in_their_order_each_image_once() -> None:
    assert find_images("*") == ["broken.jpg", "cars.png", "empty.png"], "not the notes, nor a table"
    assert find_images(["empty.png", "*.png", "deep", "**/*.PNG"]) == [
        "empty.png",
        "cars.png",
        "deep/below/cars.PNG",
    ]


def test_a_file_named_with_a_patterns_characters_is_that_file(folder: Path, tmp_path: Path) -> None:
    odd = tmp_path / "photo[1].png"
    odd.write_bytes((folder / "cars.png").read_bytes())
    assert find_images([str(odd)]) == [str(odd)]


def test_folders_behind_links_are_searched_once(folder: Path, tmp_path: Path) -> None:
    data = (folder / "cars.png").read_bytes()
    top = tmp_path / "top"
    for name in ("elsewhere", "top/real"):
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "cars.png").write_bytes(data)
    (top / "link").symlink_to(tmp_path / "elsewhere")
    (top / "a second name").symlink_to(top / "real")
    (top / "real/round").symlink_to(top)
    (tmp_path / "only links").mkdir()
    (tmp_path / "only links/2026").symlink_to(tmp_path / "elsewhere")
    assert find_images([str(top)]) == [str(top / "link/cars.png"), str(top / "real/cars.png")]
    assert find_images(tmp_path / "only links") == [str(tmp_path / "only links/2026/cars.png")]


@pytest.mark.parametrize("nothing", [[], ["*.tiff"], ["empty folder"]])
def test_nothing_found_is_an_error_before_the_work(
    nothing: list[str], monkeypatch: Any, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty folder").mkdir()
    with pytest.raises(ImageNotFoundError, match="no image"):
        find_images(nothing)


# --- Rows and columns
# ------------------------------------------------------------------------------------------------


def test_a_row_holds_what_estimate_gsd_says(detector: Path, table: Path) -> None:
    run_batch(["."], table, detector=detector, workers=1, details=True)
    broken, cars, _, empty = _rows(table)
    estimate = estimate_gsd("cars.png", detector=detector)
    assert {name: cars[name] for name in ("file", "error_code", "error")} == {
        "file": "cars.png",
        "error_code": None,
        "error": None,
    }
    same = set(GsdEstimate.model_fields) & set(COLUMNS)
    assert {name: cars[name] for name in same} == {name: getattr(estimate, name) for name in same}
    assert estimate.details.confidence_terms is not None
    assert cars["confidence_terms_sample"] == estimate.details.confidence_terms.sample
    assert list(cars) == list(ALL_COLUMNS)
    assert cars["warning_codes"] == " ".join(notice.code for notice in estimate.warnings)
    assert (empty["status"], empty["gsd_m_per_px"], empty["confidence"]) == ("no_scale", None, 0)
    assert (broken["status"], broken["gsd_m_per_px"], broken["error_code"]) == (
        None,
        None,
        "image_undecodable",
    )
    assert "not an image in one of the formats JPEG" in broken["error"]


@pytest.mark.parametrize(
    ("error", "code"),
    [(ZeroDivisionError("division by zero"), "internal_error"), (MemoryError(), "out_of_memory")],
)
def test_a_defect_found_by_one_image_is_its_row(
    error: Exception, code: str, detector: Path, table: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(Detector, "detect_tile", fail)
    summary = run_batch(["cars.png", "broken.jpg"], table, detector=detector, workers=1)
    assert [row["error_code"] for row in _rows(table)] == [code, "image_undecodable"]
    assert summary.statuses == {"error": 2}


def test_a_worker_refuses_another_model_than_the_runs(detector: Path) -> None:
    with pytest.raises(ModelContractError, match=r"on this machine .* differ"):
        Worker(BatchJob(str(detector), "0" * 64))


# --- Tables
#
# ----------------------------------------------------------------------------------------------------------


def test_all_formats_hold_the_same_rows(detector: Path, tmp_path: Path) -> None:
    import pyarrow.parquet

    for suffix in ("jsonl", "csv", "parquet"):
        run_batch(
            ["."],
            tmp_path / f"table.{suffix}",
            detector=detector,
            workers=1,
            options=ScaleOptions.of(ALONE),
        )
    rows = _rows(tmp_path / "table.jsonl")
    assert [row["file"] for row in rows] == FILES
    assert [list(row) for row in rows] == [list(COLUMNS)] * len(rows)
    assert len(COLUMNS) <= 24
    parquet = pyarrow.parquet.read_table(tmp_path / "table.parquet")
    assert parquet.to_pylist() == rows
    assert [str(kind) for kind in parquet.schema.types[:5]] == [
        "string",
        "string",
        "double",
        "double",
        "int64",
    ]
    with (tmp_path / "table.csv").open(newline="") as file:
        assert list(csv.DictReader(file)) == [
            {name: "" if value is None else str(value) for name, value in row.items()}
            for row in rows
        ]


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("table.xlsx", "use one of .parquet, .csv, .jsonl"),
        ("nowhere/table.csv", "no folder"),
        ("a.csv", "a folder"),
    ],
)
def test_a_table_that_cannot_be_written_is_told_before_the_work(
    tmp_path: Path, name: str, words: str
) -> None:
    (tmp_path / "a.csv").mkdir()
    with pytest.raises(OutputError, match=words):
        run_batch(["."], tmp_path / name, detector="no model is looked for")


def test_a_complete_table_is_replaced_only_on_request(detector: Path, table: Path) -> None:
    run_batch(["cars.png"], table, detector=detector, workers=1)
    with pytest.raises(OutputError, match="--overwrite"):
        run_batch(["empty.png"], table, detector=detector, workers=1)
    assert _rows(table)[0]["file"] == "cars.png"
    run_batch(["empty.png"], table, detector=detector, workers=1, overwrite=True)
    assert [row["file"] for row in _rows(table)] == ["empty.png"]


@pytest.mark.parametrize(
    ("module", "arguments", "words"),
    [
        ("pyarrow", {"output": "table.parquet"}, r"pip install 'vehanchor\[parquet\]'"),
        ("ray", {"output": "table.csv", "engine": "ray"}, r"pip install 'vehanchor\[ray\]'"),
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
def test_options_without_meaning_are_refused(
    table: Path, arguments: dict[str, Any], words: str
) -> None:
    with pytest.raises(InvalidParameterError, match=words):
        run_batch(["."], table, **arguments)


# --- Going on after an interruption
# ----------------------------------------------------------------------------------


@pytest.fixture
def analysed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The files that rows are made of, as they are made; the third one of a run interrupts it."""
    made: list[str] = []
    original = Worker.row

    def row(self: Worker, task: Task) -> BatchRow:
        if len(made) == 2:
            made.append("interrupted")
            raise KeyboardInterrupt
        made.append(task.file)
        return original(self, task)

    monkeypatch.setattr(Worker, "row", row)
    return made


def test_an_interrupted_run_goes_on_and_ends_as_one_that_was_not(
    analysed: list[str], detector: Path, table: Path, tmp_path: Path
) -> None:
    with pytest.raises(KeyboardInterrupt):
        run_batch(["."], table, detector=detector, workers=1)
    assert not table.exists()
    progress: list[tuple[int, int]] = []
    summary = run_batch(
        ["."],
        table,
        detector=detector,
        workers=1,
        runtime=Runtime(progress=lambda done, total: progress.append((done, total))),
    )
    assert analysed == [*FILES[:2], "interrupted", *FILES[2:]]
    assert (summary.n_rows, summary.n_resumed) == (4, 2)
    assert summary.statuses == {"low_confidence": 2, "no_scale": 1, "error": 1}
    assert progress == [(2, 4), (3, 4), (4, 4)]
    run_batch(["."], tmp_path / "at once.jsonl", detector=detector, workers=1)
    assert table.read_bytes() == (tmp_path / "at once.jsonl").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["at once.jsonl", "table.jsonl"]


def test_what_is_wrong_is_told_before_a_finished_table_is_given_up(
    detector: Path, table: Path
) -> None:
    right: dict[str, Any] = {
        "inputs": ["cars.png"],
        "output": table,
        "detector": detector,
        "workers": 1,
    }
    run_batch(**right)
    before = table.read_bytes()
    for wrong in (
        {"detector": "nowhere.onnx"},
        {"runtime": Runtime(providers=["cuda"])},
        {"inputs": ["nowhere"]},
    ):
        with pytest.raises(VehAnchorError):
            run_batch(**right | {"overwrite": True} | wrong)
        assert table.read_bytes() == before


# --- Engines
#
# ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def expected(folder: Path, detector: Path, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The table of one worker."""
    table = tmp_path_factory.mktemp("expected") / "table.jsonl"
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        run_batch(["."], table, detector=detector, workers=1)
    return table.read_bytes()


@pytest.mark.slow
def test_several_processes_make_the_same_table(
    expected: bytes, detector: Path, table: Path
) -> None:
    run_batch(["."], table, detector=detector, workers=2)
    assert table.read_bytes() == expected


@pytest.mark.slow
def test_a_killed_process_ends_the_run_and_keeps_the_rows(detector: Path, table: Path) -> None:
    def kill(done: int, total: int) -> None:
        if done:
            for child in Path(f"/proc/self/task/{os.getpid()}/children").read_text().split():
                if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes():
                    os.kill(int(child), signal.SIGKILL)

    with pytest.raises(WorkerDiedError, match="fewer --workers"):
        run_batch(
            ["."] + [f"missing {n}.png" for n in range(20)],
            table,
            detector=detector,
            workers=2,
            runtime=Runtime(progress=kill),
        )
    assert run_batch(["."], table, detector=detector, workers=1).n_rows == 4


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
def test_ctrl_c_says_how_to_go_on_and_the_same_command_does(
    detector: Path, folder: Path, tmp_path: Path, workers: int
) -> None:
    for n in range(60):
        (tmp_path / f"{n:02}.png").symlink_to(folder / "cars.png")
    slow = (
        "import time; from vehanchor.batch import worker; row = "
        "worker.Worker.row\nworker.Worker.row = lambda *a: (time.sleep(0.2), row(*a))[1]\n"
    )
    arguments = [".", "--output", "t.csv", "--detector", str(detector), "--workers", str(workers)]
    script = tmp_path / "run.py"  # a file, as spawned processes read it again
    script.write_text(
        slow + "from vehanchor.cli.app import main\nif __name__ == '__main__':\n    main()\n"
    )
    command = [sys.executable, str(script), "batch", *arguments]
    process = subprocess.Popen(
        command,
        cwd=tmp_path,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # a shell's "&" has it ignored
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    journal = tmp_path / "t.csv.journal"
    deadline = time.monotonic() + 120
    while not (journal.exists() and journal.stat().st_size > 40_000):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to all of them
    _, stderr = process.communicate(timeout=60)
    assert process.returncode == 130
    assert (
        stderr.splitlines()[-1]
        == "interrupted: finished rows are kept; run the same command to resume"
    )
    assert "Traceback" not in stderr
    done = subprocess.run(
        [sys.executable, "-m", "vehanchor", "batch", *arguments],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "60 rows (60 low_confidence), " in done.stderr
    assert " of them from an earlier run; " in done.stderr
    with (tmp_path / "t.csv").open(newline="") as file:
        assert [row["file"] for row in csv.DictReader(file)] == [f"{n:02}.png" for n in range(60)]


@pytest.mark.ray
def test_ray_makes_the_same_table_and_goes_on_where_the_local_engine_stopped(
    expected: bytes, detector: Path, folder: Path, tmp_path: Path
) -> None:
    """As a user runs it: a Ray of the command's own."""
    table = tmp_path / "table.jsonl"

    def interrupt(done: int, _: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_batch(["."], table, detector=detector, workers=1, runtime=Runtime(progress=interrupt))
    assert journal_path(table).exists()
    command = [
        sys.executable,
        "-m",
        "vehanchor",
        "batch",
        ".",
        "--detector",
        str(detector),
        "--workers",
        "2",
    ]
    done = subprocess.run(
        [*command, "--output", str(table), "--engine", "ray"],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert table.read_bytes() == expected
    assert done.stdout == ""
    last = done.stderr.splitlines()[-1]
    assert (
        "4 rows (2 low_confidence, 1 no_scale, 1 error), 2 of them from an earlier run; 2 images in"
        in last
    )
    assert not journal_path(table).exists()


@pytest.mark.ray
def test_no_cluster_at_the_address_is_told_in_a_line(detector: Path, table: Path) -> None:
    result = _batch(
        "cars.png",
        "-o",
        table,
        "--detector",
        detector,
        "--engine",
        "ray",
        "--address",
        "127.0.0.1:1",
    )
    assert result.exit_code == 2
    assert "no Ray cluster at '127.0.0.1:1'" in result.stderr
    assert "Connection refused" in result.stderr


# --- The command
#
# -----------------------------------------------------------------------------------------------------


def test_the_command_tells_what_it_did(
    detector: Path, table: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vehanchor.cli.terminal._LINE_EVERY_S", 0.0)
    result = _batch(".", "no such.png", "--output", table, "--detector", detector, "--workers", 1)
    assert result.exit_code == 0, result.output
    assert result.stdout == ""
    *lines, last = result.stderr.splitlines()
    assert lines == [
        *(f"{n} of 5 images" for n in range(6)),
        "2 x disagree, as in cars.png: the scene suggests a scale of about 1.1 m/px; check what was "
        "taken for cars, or draw a line over something of known size",
        f"1 x image_undecodable, as in broken.jpg: {_rows(table)[0]['error']}",
        "1 x too_few, as in empty.png: no car was found; draw a line over something of known size, "
        "or take a picture with cars",
        f"1 x image_not_found, as in no such.png: {_rows(table)[-1]['error']}",
    ]
    assert last.startswith(f"{table}: 5 rows (2 low_confidence, 1 no_scale, 2 error); 5 images in ")
    assert _rows(table)[-1]["error_code"] == "image_not_found"
    broken = _batch(
        "broken.jpg", "--output", table, "--overwrite", "--detector", detector, "--workers", 1
    )
    assert broken.exit_code == 1
    assert (
        broken.stderr.splitlines()[-1]
        == "no image could be used: the columns error_code and error say why"
    )
    alone = _batch(
        "empty.png", "--output", table, "--overwrite", "--detector", detector, "--workers", 1
    )
    assert alone.stderr.splitlines()[-1].startswith(f"{table}: 1 row (1 no_scale); 1 image in ")


def test_batch_takes_the_options_of_estimate(detector: Path, table: Path) -> None:
    options = (
        "--alpha",
        1,
        "--region",
        "europe",
        "--tile",
        512,
        "--bands",
        3,
        2,
        1,
        "--provider",
        "cpu",
        "--class",
        0,
    )
    result = _batch("cars.png", "-o", table, "--detector", detector, "--workers", 1, *options)
    assert result.exit_code == 0, result.output
    (row,) = _rows(table)
    estimate = estimate_gsd(
        "cars.png", detector=detector, alpha=1.0, region="europe", tile_px=512, bands=(3, 2, 1)
    )
    same = set(GsdEstimate.model_fields) & set(COLUMNS)
    assert {name: row[name] for name in same} == {name: getattr(estimate, name) for name in same}


def test_lines_of_known_length_of_single_images_come_from_a_table(
    folder: Path, detector: Path, table: Path
) -> None:
    lines = table.with_name("lines.csv")
    named = os.path.relpath(folder / "empty.png", lines.parent)
    lines.write_text(
        f"file,x1,y1,x2,y2,metres,who\n{named},100,50,500,50,48,Ann\n{named},100,50,100,250,24,Ann\n"
    )
    common = ("cars.png", "empty.png", "--detector", detector, "--workers", 1, "--details")
    result = _batch(*common, "-o", table, "--known-lengths", lines)
    assert result.exit_code == 0, result.output
    cars, empty = _rows(table)
    assert (empty["leading_ruler"], empty["ruler_known_length_p_right"] > 0.5) == (
        "known_length",
        True,
    )
    assert empty["gsd_m_per_px"] == pytest.approx(0.12, rel=0.01)
    assert cars["ruler_known_length_gsd_m_per_px"] is None
    assert _batch(*common, "-o", table.with_name("without.jsonl")).exit_code == 0
    assert cars == _rows(table.with_name("without.jsonl"))[0]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("file,x1,y1,x2,metres\ncars.png,1,2,300,40\n", "no column y2"),
        ("file,x1,y1,x2,y2,metres\ncars.png,1,2,300,wide,40\n", "line 2"),
        (
            "file,x1,y1,x2,y2,metres\ncars.png,1,2,300,4,40\ncars.png,1,2,3,4,40\n",
            "line 3: the line of known length",
        ),
        ("file,x1,y1,x2,y2,metres\ncars.png,1,2,300,4,-40\n", "line 2"),
        ("file,x1,y1,x2,y2,metres\ncars.png,1,2,300,4,nan\n", "line 2"),
        ("file,x1,y1,x2,y2,metres\n,1,2,300,4,40\n", "not named"),
        (
            "file,x1,y1,x2,y2,metres,basis\ncars.png,1,2,300,4,40,guessed\n",
            "use one of assumed, measured",
        ),
        ("file,x1,y1,x2,y2,metres\n", "no known lengths"),
        ("", "no column file"),
    ],
)
def test_a_table_of_lines_that_cannot_be_used_is_told_with_what_is_wrong(
    text: str, words: str, tmp_path: Path
) -> None:
    (tmp_path / "lines.csv").write_text(text)
    with pytest.raises(KnownLengthError, match=words):
        lines_in(tmp_path / "lines.csv", ["cars.png"])


def test_the_default_is_a_worker_a_cpu_but_no_more_than_images(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1, 2}, raising=False)
    assert [local_workers(n) for n in (1, 2, 3, 100)] == [1, 2, 3, 3]


def test_an_image_that_was_replaced_meanwhile_is_looked_at_again(
    analysed: list[str], detector: Path, folder: Path, table: Path, tmp_path: Path
) -> None:
    image = tmp_path / "a.png"
    image.write_bytes((folder / "empty.png").read_bytes())
    images = [str(image), "cars.png", "empty.png"]
    with pytest.raises(KeyboardInterrupt):
        run_batch(images, table, detector=detector, workers=1)
    image.write_bytes((folder / "cars.png").read_bytes())
    assert run_batch(images, table, detector=detector, workers=1).n_resumed == 1
    assert [row["n_vehicles"] for row in _rows(table)] == [20, 20, 0]


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
    assert {row["reference_length_m"] for row in _rows(table)} == {4.3, None}
