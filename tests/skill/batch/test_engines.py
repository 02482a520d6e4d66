"""Processes and Ray: tables do not depend on them, and no row is lost."""

from __future__ import annotations

import csv
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.skill.batch.runs import run_command
from vehanchor.batch import run_batch
from vehanchor.batch.engines.local import local_workers
from vehanchor.batch.run import journal_path
from vehanchor.models.runtime import Runtime


@pytest.fixture(scope="module")
def expected(folder: Path, detector: Path, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The table of one worker."""
    table = tmp_path_factory.mktemp("expected") / "table.jsonl"
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        run_batch(["."], table, detector=detector, workers=1)
    return table.read_bytes()


def test_the_default_is_one_worker_per_cpu_or_image_at_most(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1, 2}, raising=False)
    assert [local_workers(n) for n in (1, 2, 3, 100)] == [1, 2, 3, 3]


@pytest.mark.slow
def test_several_processes_write_the_same_table(
    expected: bytes, detector: Path, table: Path
) -> None:
    run_batch(["."], table, detector=detector, workers=2)
    assert table.read_bytes() == expected


@pytest.mark.slow
def test_a_run_survives_a_killed_process(expected: bytes, detector: Path, table: Path) -> None:
    killed: list[int] = []

    def kill_workers(done: int, total: int) -> None:
        if not done or killed:
            return
        children = Path(f"/proc/self/task/{os.getpid()}/children").read_text()
        for child in children.split():
            if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes():
                os.kill(int(child), signal.SIGKILL)
                killed.append(int(child))

    runtime = Runtime(progress=kill_workers)
    run_batch(["."], table, detector=detector, workers=2, runtime=runtime)
    assert killed
    assert table.read_bytes() == expected


# The decoder of one image ends its process. The script is a file, because spawned processes read it
# again.
POISONED_COMMAND = """
import os, signal
from vehanchor.batch.worker import Worker
from vehanchor.cli.app import main

make_row = Worker.row

def crash(self, task):
    if "poison" in task.file:
        os.kill(os.getpid(), signal.SIGSEGV)
    return make_row(self, task)

Worker.row = crash
if __name__ == "__main__":
    main()
"""


class Poisoned(NamedTuple):
    """A run over 12 images, two of which crash their worker.

    Attributes:
        status: exit status.
        stderr: messages.
        errors: code of the error of each file.
    """

    status: int
    stderr: str
    errors: dict[str, str]


@pytest.fixture(scope="module", params=[1, 2], ids=["one worker", "two workers"])
def poisoned(
    request: pytest.FixtureRequest,
    detector: Path,
    folder: Path,
    tmp_path_factory: pytest.TempPathFactory,
) -> Poisoned:
    path = tmp_path_factory.mktemp("poisoned")
    for name in (*(f"{n:02}.png" for n in range(10)), "03_poison.png", "poison.png"):
        (path / name).symlink_to(folder / "cars.png")
    script = path / "run.py"
    script.write_text(POISONED_COMMAND)
    command = [sys.executable, str(script), "batch", ".", "--output", "t.csv"]
    command += ["--detector", str(detector), "--workers", str(request.param)]
    done = subprocess.run(command, cwd=path, capture_output=True, text=True, check=False)
    with (path / "t.csv").open(newline="") as file:
        errors = {row["photograph"]: row["error_code"] for row in csv.DictReader(file)}
    return Poisoned(done.returncode, done.stderr, errors)


@pytest.mark.slow
def test_an_image_that_ends_its_process_has_a_row(poisoned: Poisoned) -> None:
    died = [file for file, code in poisoned.errors.items() if code == "worker_died"]
    assert died == ["03_poison.png", "poison.png"]


@pytest.mark.slow
@pytest.mark.promise("crashes")
def test_a_run_goes_on_after_an_image_that_ends_its_process(poisoned: Poisoned) -> None:
    assert len(poisoned.errors) == 12
    assert list(poisoned.errors.values()).count("") == 10


@pytest.mark.slow
def test_the_exit_status_tells_of_a_dead_process(poisoned: Poisoned) -> None:
    assert poisoned.status == 1
    assert "2 x worker_died, as in 03_poison.png: this image ended the process" in poisoned.stderr


# Each row takes a fifth of a second, so that there is time to interrupt the run. The script is a
# file, because spawned processes read it again.
SLOW_COMMAND = """
import time
from vehanchor.batch.worker import Worker
from vehanchor.cli.app import main

row = Worker.row

def slow_row(*arguments):
    time.sleep(0.2)
    return row(*arguments)

Worker.row = slow_row
if __name__ == "__main__":
    main()
"""


class Interrupted(NamedTuple):
    """Command that Ctrl-C ended."""

    folder: Path
    arguments: list[str]
    status: int
    stderr: str


@pytest.fixture(scope="module", params=[1, 2], ids=["one worker", "two workers"])
def interrupted(
    request: pytest.FixtureRequest,
    detector: Path,
    folder: Path,
    tmp_path_factory: pytest.TempPathFactory,
) -> Interrupted:
    path = tmp_path_factory.mktemp("interrupted")
    for n in range(60):
        (path / f"{n:02}.png").symlink_to(folder / "cars.png")
    script = path / "run.py"
    script.write_text(SLOW_COMMAND)
    arguments = ["batch", ".", "--output", "t.csv"]
    arguments += ["--detector", str(detector), "--workers", str(request.param)]
    process = subprocess.Popen(
        [sys.executable, str(script), *arguments],
        cwd=path,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # A shell's "&" makes its children ignore the signal.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    journal = path / "t.csv.journal"
    deadline = time.monotonic() + 120
    while not (journal.exists() and journal.stat().st_size > 40_000):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    # A terminal sends the signal to all processes of the command.
    os.killpg(process.pid, signal.SIGINT)
    _, stderr = process.communicate(timeout=60)
    return Interrupted(path, arguments, status=process.returncode, stderr=stderr)


@pytest.mark.slow
def test_ctrl_c_ends_the_command_with_how_to_resume(interrupted: Interrupted) -> None:
    assert interrupted.status == 130
    last = interrupted.stderr.splitlines()[-1]
    assert last == "interrupted: finished rows are kept; run the same command to resume"
    assert "Traceback" not in interrupted.stderr


@pytest.mark.slow
def test_the_same_command_resumes_after_ctrl_c(interrupted: Interrupted) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "vehanchor", *interrupted.arguments],
        cwd=interrupted.folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "60 rows (60 ok), " in done.stderr
    assert " of them from an earlier run; " in done.stderr
    with (interrupted.folder / "t.csv").open(newline="") as file:
        files = [row["photograph"] for row in csv.DictReader(file)]
    assert files == [f"{n:02}.png" for n in range(60)]


@pytest.mark.ray
@pytest.mark.usefixtures("_hasty_ray")
def test_ray_resumes_a_run_of_the_local_engine(
    expected: bytes, detector: Path, folder: Path, table: Path
) -> None:
    """Run the command as a user does, with a Ray of its own."""

    def interrupt(done: int, _: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_batch(["."], table, detector=detector, workers=1, runtime=Runtime(progress=interrupt))
    assert journal_path(table).exists()
    command = [sys.executable, "-m", "vehanchor", "batch", "."]
    command += ["--detector", str(detector), "--workers", "2"]
    command += ["--output", str(table), "--engine", "ray"]
    done = subprocess.run(
        command,
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert table.read_bytes() == expected
    assert done.stdout == ""
    last = done.stderr.splitlines()[-1]
    assert "4 rows (2 ok, 1 no_scale, 1 error), 2 of them from an earlier run" in last
    assert "earlier run; 2 images in" in last
    assert not journal_path(table).exists()


@pytest.mark.ray
def test_a_missing_cluster_ends_the_command_with_its_address(detector: Path, table: Path) -> None:
    to_cluster = ("--engine", "ray", "--address", "127.0.0.1:1")
    result = run_command("cars.png", "-o", table, "--detector", detector, *to_cluster)
    assert result.exit_code == 2
    assert "no Ray cluster at '127.0.0.1:1'" in result.stderr
    assert "Connection refused" in result.stderr
