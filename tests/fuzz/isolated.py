"""The fuzzer of images' structures, each image in a child process, so that a crash is a finding.

    python -m tests.fuzz.isolated --seconds 60 --seed 1

A mutant fails if it ends its process, raises a foreign error, hangs, or takes too much memory. It
is then written to ``--findings``, and the exit status is not 0. Linux only: time and memory of the
child are read from ``/proc``.
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
"""Longest time of the processor for an image; the child's own alarm stops loops in Python."""

_MAX_WAIT_S = 600.0
"""Longest wait for an image, on a machine that is busy with other things."""

_POLL_S = 2.0

_FAILED = b"failed"
_DONE = b"done"
_READY = b"ready"


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
            if self._answers(connection):
                return connection.recv_bytes() == _FAILED
            reason = f"no answer in {_HANG_IN_C_S:.0f} s of the processor"
        except (EOFError, OSError):
            reason = "the process ended"
        self._keep(data, reason)
        self.stop()
        return True

    def _answers(self, connection: Connection) -> bool:
        """Wait for an answer of the child, as long as it has used too little of the processor."""
        assert self._child is not None
        assert self._child.pid is not None
        process = self._child.pid
        end_s = _processor_s(process) + _HANG_IN_C_S
        end = time.monotonic() + _MAX_WAIT_S
        while not connection.poll(_POLL_S):
            if _processor_s(process) > end_s or time.monotonic() > end:
                return False
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
        assert ours.recv_bytes() == _READY
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


def _processor_s(process: int) -> float:
    """Read the time of the processor that a process has used (proc(5), stat)."""
    _, _, after_name = Path(f"/proc/{process}/stat").read_text().rpartition(")")
    fields = after_name.split()
    user_ticks = int(fields[11])
    system_ticks = int(fields[12])
    return (user_ticks + system_ticks) / os.sysconf("SC_CLK_TCK")


def serve(connection: Connection, findings: Path) -> None:
    """Open images until the connection closes."""
    checked = Checked(open_image, findings)
    connection.send_bytes(_READY)
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
