"""Cut off every kind of file at many bytes: ``python -m tests.skill.cut_off FOLDER``.

The disk is full there, or the process is killed. The program prints one line of JSON: the number of
ends of each kind, and what was wrong. It runs in a process of its own, because it forks.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow.parquet

from vehanchor.batch.row import BatchRow
from vehanchor.batch.table import write_table
from vehanchor.pictures.scale import write_picture
from vehanchor.scale.calibration import Calibration
from vehanchor.storage.atomic import write_record
from vehanchor.storage.journal import Journal
from vehanchor_evaluation.report import write_results

# Imported here once, instead of in each of hundreds of children.
_LATE_IMPORTS = (cv2, pyarrow.parquet)

CALIBRATION = Calibration(
    reference_length_m=4.6,
    reference_length_ci95_low_m=4.5,
    reference_length_ci95_high_m=4.7,
    reference_length_sd_m=0.1,
    source="labels",
    n_vehicles=1000,
    n_images=20,
    mode_length_px=30.0,
    median_gsd_m_per_px=0.15,
    detector=None,
    detector_sha256=None,
)
"""Any calibration."""

_ROWS = [
    BatchRow(photograph=f"{n}.png", error_code="image_not_found", error="there is no such file")
    for n in range(8)
]
_FACTS = [{"file": row.photograph, "error": row.error} for row in _ROWS]
_PICTURE = np.random.default_rng(1).integers(0, 255, (48, 48, 3), np.uint8)
_WRITERS: dict[str, Callable[[Path], object]] = {
    "calibration.json": lambda path: write_record(path, CALIBRATION, indent=2),
    "picture.png": lambda path: write_picture(path, _PICTURE),
    "picture.jpg": lambda path: write_picture(path, _PICTURE),
    "table.csv": lambda path: write_table(path, [row.flat() for row in _ROWS]),
    "table.jsonl": lambda path: write_table(path, [row.flat() for row in _ROWS]),
    "table.parquet": lambda path: write_table(path, [row.flat() for row in _ROWS]),
    "report.json": lambda path: write_results(
        path.parent, "report", record=CALIBRATION, rows=_FACTS, markdown="# Words\n"
    ),
}
_RESULTS = 3


def _file_faults(name: str, folder: Path, ends: Counter[str]) -> Iterable[str]:
    """Cut off a file that replaces another; yield what is wrong, and count the ends."""
    write = _WRITERS[name]
    path = folder / name
    assert limited(lambda: write(path), None, killed=False) == WRITTEN
    new = path.read_bytes()
    for killed in (False, True):
        for n_bytes in sorted({0, 1, 2, *np.linspace(0, len(new) - 1, 5, dtype=int).tolist()}):
            path.write_bytes(b"old")
            end = limited(lambda: write(path), n_bytes, killed=killed)
            ends[_end_name(end)] += 1
            expected = KILLED if killed else REFUSED
            content = path.read_bytes()
            if end != expected or content != b"old":
                where = f"{name} at byte {n_bytes}, killed {killed}"
                yield f"{where}: {_end_name(end)}, {content[:20]!r}"
    if limited(lambda: write(path), len(new), killed=True) != WRITTEN or path.read_bytes() != new:
        yield f"{name} is not written again afterwards"


def _journal(path: Path) -> Journal[Any]:
    return Journal(path, {"model": "m"}, dump=lambda value: value, load=lambda value: value)


def _journal_faults(folder: Path, ends: Counter[str]) -> Iterable[str]:
    """Cut off a journal during an addition; yield what is wrong, and count the ends."""
    path = folder / "run.journal"
    for number in range(_RESULTS):
        _journal(path).add(("f", number), "x")
    before = path.read_bytes()

    def add() -> None:
        _journal(path).add(("new",), "y" * 50_000)

    assert limited(add, None, killed=False) == WRITTEN
    after = path.stat().st_size
    for killed in (False, True):
        for n_bytes in range(0, after, 1000):
            path.write_bytes(before)
            end = limited(add, n_bytes, killed=killed)
            ends[_end_name(end)] += 1
            with _journal(path) as journal:
                n_results = len(journal)
                added = journal.get(("new",))
                journal.add(("next",), "z")
            if end == WRITTEN or n_results != _RESULTS or added is not None:
                where = f"journal, full at byte {n_bytes}, killed {killed}"
                yield f"{where}: {_end_name(end)}, {n_results} results"


WRITTEN = 0
REFUSED = 1
KILLED = -getattr(signal, "SIGXFSZ", 0)  # Windows has no such signal.


def _end_name(end: int) -> str:
    return {WRITTEN: "written", REFUSED: "refused", KILLED: "killed"}.get(end, str(end))


def limited(work: Callable[[], object], n_bytes: int | None, *, killed: bool) -> int:
    """Run work in a copy of this process, which should have one thread, with limited files.

    Args:
        work: writes files.
        n_bytes: size to which each file may grow; None does not limit them.
        killed: kill the process at the limit, instead of refusing to write.

    Returns:
        How the work ends: ``WRITTEN``, ``REFUSED`` for any exception, or minus a signal.
    """
    import resource

    child = os.fork()
    if child == 0:
        try:
            signal.signal(signal.SIGXFSZ, signal.SIG_DFL if killed else signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            if n_bytes is not None:
                resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes, n_bytes))
            work()
            status = WRITTEN
        except Exception as error:
            sys.stderr.write(f"{type(error).__name__}: {error}\n")
            status = REFUSED
        sys.stderr.flush()
        os._exit(status)
    _, wait_status = os.waitpid(child, 0)
    return os.waitstatus_to_exitcode(wait_status)


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    ends: Counter[str] = Counter()
    wrong = [fault for name in _WRITERS for fault in _file_faults(name, folder, ends)]
    wrong += _journal_faults(folder, ends)
    print(json.dumps({"ends": ends, "wrong": wrong}))
