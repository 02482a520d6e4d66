"""The fuzzer of images' structures, each image in a child process, so that a crash is a finding.

    python -m tests.fuzz.isolated --seconds 60 --seed 1

A mutant fails if it ends its process, raises a foreign error, hangs, or takes too much memory. It
is then written to ``--findings``, and the exit status is not 0.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
import time
from collections import Counter
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path

from tests.fuzz.drive import GROWTH_MIB, HANG_S, Checked, Slow, input_name
from tests.fuzz.structures import Mutator, format_name
from tests.fuzz.targets import CORPUS, TARGETS

_HANG_IN_C_S = 15 * HANG_S
"""Longest wait for a child; its own alarm stops loops in Python before."""

_FAILED = b"failed"
_DONE = b"done"


class Isolated:
    """Child process that opens images.

    Args:
        findings: folder for images that fail.
    """

    def __init__(self, findings: Path) -> None:
        self._findings = findings
        self._spawn = multiprocessing.get_context("spawn")
        self._child: BaseProcess | None = None
        self._connection: Connection | None = None

    def fails(self, data: bytes) -> bool:
        """Open an image in the child; keep it if it fails."""
        connection = self._connection or self._start()
        try:
            connection.send_bytes(data)
            if connection.poll(_HANG_IN_C_S):
                return connection.recv_bytes() == _FAILED
            reason = f"no answer in {_HANG_IN_C_S:.0f} s"
        except (EOFError, OSError):
            reason = "the process ended"
        self._keep(data, reason)
        self.stop()
        return True

    def stop(self) -> None:
        """End the child."""
        if self._child is not None:
            self._child.kill()
            self._child.join()
        if self._connection is not None:
            self._connection.close()
        self._child = None
        self._connection = None

    def _start(self) -> Connection:
        ours, theirs = self._spawn.Pipe()
        self._child = self._spawn.Process(target=serve, args=(theirs, self._findings), daemon=True)
        self._child.start()
        theirs.close()
        self._connection = ours
        return ours

    def _keep(self, data: bytes, reason: str) -> None:
        self._findings.mkdir(parents=True, exist_ok=True)
        path = self._findings / input_name(data)
        path.write_bytes(data)
        if self._child is not None:
            self._child.join(timeout=1)
            reason = f"{reason}, exit code {self._child.exitcode}"
        print(f"{path}: {reason}", file=sys.stderr, flush=True)


def serve(connection: Connection, findings: Path) -> None:
    """Open images until the connection closes."""
    checked = Checked(open_image, findings)
    while True:
        try:
            data = connection.recv_bytes()
        except EOFError:
            return
        try:
            checked(data)
        except (Exception, Slow):
            connection.send_bytes(_FAILED)
        else:
            connection.send_bytes(_DONE)


def open_image(data: bytes) -> None:
    """Read the header and the pixels of an image, and check the memory that they take.

    Raises:
        MemoryError: they take more than a real image within the fuzzer's limits.
    """
    TARGETS["header"](data)
    before_mib = _reset_peak_mib()
    TARGETS["image"](data)
    growth_mib = _memory_mib("VmHWM") - before_mib
    if growth_mib > GROWTH_MIB:
        raise MemoryError(f"{growth_mib:.0f} MiB for {len(data)} bytes")


def _reset_peak_mib() -> float:
    """Let the peak of this process's memory begin again; return its memory now."""
    Path("/proc/self/clear_refs").write_text("5")
    return _memory_mib("VmRSS")


def _memory_mib(name: str) -> float:
    """Read a number of this process's memory (proc(5), status)."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(name):
            return int(line.split()[1]) / 1024
    raise LookupError(name)


def main() -> int:
    """Open mutants of all formats, for some seconds or up to a number of them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--inputs", type=int, default=sys.maxsize)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--findings", type=Path, default=Path("fuzz-findings"))
    options = parser.parse_args()
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    counts: Counter[str] = Counter()
    n_failures = 0
    child = Isolated(options.findings)
    end = time.monotonic() + options.seconds
    for data in Mutator(CORPUS["image"](), options.seed):
        if time.monotonic() >= end or counts.total() >= options.inputs:
            break
        counts[format_name(data)] += 1
        n_failures += child.fails(data)
        if counts.total() % 10_000 == 0:
            print(f"{counts.total()} mutants, {n_failures} failures", flush=True)
    child.stop()
    by_format = ", ".join(f"{n} {name}" for name, n in counts.most_common())
    print(f"structures: {counts.total()} mutants, {n_failures} failures ({by_format})", flush=True)
    return 1 if n_failures else 0


if __name__ == "__main__":
    sys.exit(main())
