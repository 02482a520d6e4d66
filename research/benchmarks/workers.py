"""Measure the workers of a batch: ``python -m research.benchmarks.workers``.

Prints Markdown; ``--record`` keeps it. Rendered photographs of two megapixels with 200 cars: the
rate of two workers over that of one, in turns; the cores that one worker keeps busy; the same for
the bare detector in processes of one thread, which tells what the machine allows; and the memory of
a worker. Values are medians of the rounds.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from research.benchmarks.batch import run_rows
from research.benchmarks.page import write_photographs
from research.results.record import add_record_option, header, recording, spread

# One thread runs the detector on one tile; prints the seconds.
_BARE = """
import sys, time
import numpy as np, onnxruntime
from vehanchor.models.zoo import resolve_model
options = onnxruntime.SessionOptions()
options.intra_op_num_threads = 1
session = onnxruntime.InferenceSession(
    str(resolve_model()), options, providers=["CPUExecutionProvider"]
)
tile = np.random.default_rng(0).random((1, 3, 1024, 1024), np.float32)
session.run(None, {"images": tile})
started = time.perf_counter()
for _ in range(int(sys.argv[1])):
    session.run(None, {"images": tile})
print(time.perf_counter() - started)
"""
# The only worker of a process makes the rows of a folder; prints the peak in KiB.
_WORKER = """
import sys
from pathlib import Path
from vehanchor.analysis.heap import use_one_heap
from vehanchor.batch.worker import BatchJob, Task, Worker
use_one_heap()
worker = Worker.for_this_process(BatchJob("vehicles", sys.argv[2]))
for path in sorted(Path(sys.argv[1]).iterdir()):
    worker.row(Task.of(str(path)))
status = Path("/proc/self/status").read_text().splitlines()
print(next(line.split()[1] for line in status if line.startswith("VmHWM")))
"""
_N_TILES = 30
# Processes whose peak memory is measured.
_N_PEAKS = 3


def bare_seconds(processes: int) -> float:
    """Measure the seconds of the bare detector for some tiles in each of some processes."""
    command = [sys.executable, "-c", _BARE, str(_N_TILES)]
    running = [
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(processes)
    ]
    return max(float(each.communicate()[0]) for each in running)


def peak_mib(folder: Path) -> float:
    """Measure the peak memory of a worker for the photographs of a folder."""
    from vehanchor.analysis.heap import huge_pages_in_new_processes
    from vehanchor.detection.detector import Detector, networks_sha256
    from vehanchor.models.zoo import resolve_model

    sha256 = networks_sha256(Detector(resolve_model()).card)
    command = [sys.executable, "-c", _WORKER, str(folder), sha256]
    with huge_pages_in_new_processes():
        kib = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return int(kib) / 1024


def cores_of_one(folder: Path) -> tuple[float, float]:
    """Run one worker; return its rate and the mean number of cores that it keeps busy."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    started = time.perf_counter()
    rate = run_rows(folder, "local", 1).rate
    seconds = time.perf_counter() - started
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
    return rate, spent / seconds


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--photographs", type=int, default=24)
    parser.add_argument("--rounds", type=int, default=9)
    options = add_record_option(parser).parse_args()
    title = "Workers of a batch: photographs of two megapixels"
    with (
        recording("speed", ["workers"], options.record, title=title, rounds=options.rounds),
        tempfile.TemporaryDirectory() as name,
    ):
        folder = Path(name)
        write_photographs(folder, options.photographs)
        ratios = []
        cores = []
        bare_ratios = []
        for _ in range(options.rounds):
            one, busy = cores_of_one(folder)
            two = run_rows(folder, "local", 2).rate
            ratios.append(two / one)
            cores.append(busy)
            bare_ratios.append(2 * bare_seconds(1) / bare_seconds(2))
        for path in sorted(folder.iterdir())[8:]:
            path.unlink()
        print(header("quantity", "least", "value", "most", "aim"))
        bare = "the bare detector in two processes of one thread over one"
        for name, values, aim in (
            ("two workers over one", ratios, "1.9"),
            ("cores that one worker keeps busy", cores, ""),
            (bare, bare_ratios, ""),
        ):
            print(f"| {name} | {' | '.join(spread(values))} | {aim} |")
        peaks = [peak_mib(folder) for _ in range(_N_PEAKS)]
        print(f"| peak memory of a worker, MiB | {' | '.join(spread(peaks, 0))} | 220 |")


if __name__ == "__main__":
    main()
