"""The fuzzer: it mutates the corpus of a target for some seconds.

    python -m tests.fuzz.drive image --seconds 60 --seed 1

An input fails if it raises, hangs, or takes too much memory. It is then written to ``--findings``,
and the exit status is not 0. It becomes a test in ``tests/fuzz/test_targets.py``.

Mutations are blind. With ``--coverage``, atheris guides them by the lines of ours that an input
reaches; it is a tool of its own (``pip install atheris``, Python 3.11 to 3.13, Linux).
"""

from __future__ import annotations

import argparse
import hashlib
import os
import resource
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Literal

import numpy as np

HANG_S = 2.0
"""Longest time of the processor for an input."""

MEMORY_MIB = 1024
"""Maximum memory of the process, libraries included."""

GROWTH_MIB = 256
"""Maximum memory that one input adds to a process that is larger, such as that of the tests."""

_EDGES = (0, 1, 255, 2**16 - 1, 2**31 - 1, 2**32 - 1, 2**63, 2**64 - 1)
_JSON_CHARACTERS = list(b'0123456789-+.eE"[]{},:truefalsn')
_MAX_INPUT_BYTES = 1 << 20


class Slow(BaseException):
    """An input took too long; no handler of ours may catch it."""


class Checked:
    """A target that counts its inputs, and fails if one takes too much time or memory.

    Args:
        target: takes bytes.
        findings: folder for inputs that fail.
    """

    def __init__(self, target: Callable[[bytes], None], findings: Path) -> None:
        self._target = target
        self._findings = findings
        self.n_inputs = 0
        self.n_failures = 0
        self.slowest_s = 0.0
        signal.signal(signal.SIGPROF, _stop)

    def __call__(self, data: bytes) -> None:
        self.n_inputs += 1
        # The alarm stops only loops in Python; a hang in C is left to the caller. It counts the
        # time of the processor, because a busy machine takes much longer for the same work.
        signal.setitimer(signal.ITIMER_PROF, 10 * HANG_S)
        try:
            self._run(data)
        except (Exception, Slow) as error:
            self.n_failures += 1
            self._findings.mkdir(parents=True, exist_ok=True)
            path = self._findings / input_name(data)
            path.write_bytes(data)
            print(f"{path}: {type(error).__name__}: {str(error)[:200]}", file=sys.stderr)
            raise
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)

    def _run(self, data: bytes) -> None:
        """Give the target an input, and check its time and memory."""
        started = time.process_time()
        memory_before_mib = _peak_mib()
        self._target(data)
        seconds = time.process_time() - started
        self.slowest_s = max(self.slowest_s, seconds)
        if seconds > HANG_S:
            raise Slow(f"{seconds:.1f} s")
        # The memory that the process held before is not due to this input.
        if _peak_mib() > max(MEMORY_MIB, memory_before_mib + GROWTH_MIB):
            raise MemoryError(f"{_peak_mib():.0f} MiB")


def input_name(data: bytes) -> str:
    """Name an input."""
    return hashlib.sha256(data).hexdigest()[:16]


def _stop(number: int, frame: FrameType | None) -> None:
    del number, frame
    raise Slow("hangs")


def _peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def mutated(data: bytes, others: list[bytes], random: np.random.Generator) -> bytes:
    """Change an input somewhat.

    Bits, bytes or numbers change, and parts are cut out, doubled, or taken from another input.
    """

    def integer(low: int, high: int) -> int:
        return int(random.integers(low, high))

    changed = bytearray(data)
    for _ in range(integer(1, 6)):
        start = integer(0, len(changed) + 1)
        end = start + integer(1, 9)
        match integer(0, 7):
            case 0 if changed:
                changed[start % len(changed)] ^= 1 << integer(0, 8)
            case 1:
                changed[start:end] = random.bytes(end - start)
            case 2:
                number = _EDGES[integer(0, len(_EDGES))]
                order: Literal["little", "big"] = "little" if random.random() < 0.5 else "big"
                changed[start:end] = number.to_bytes(8, order)[: end - start]
            case 3:
                max_cut = max(1, len(changed) // 4)
                del changed[start : start + integer(1, 1 + max_cut)]
            case 4:
                part = changed[start : start + integer(1, 65)]
                changed[start:start] = part * integer(1, 9)
            case 5:
                other = others[integer(0, len(others))]
                other_start = integer(0, len(other) + 1)
                changed[start:end] = other[other_start : other_start + integer(1, 65)]
            case _:
                characters = random.choice(_JSON_CHARACTERS, end - start)
                changed[start:end] = bytes(characters.tolist())
    return bytes(changed[:_MAX_INPUT_BYTES])


def drive_blindly(
    checked: Checked, corpus: list[bytes], seconds: float, seed: int, n_inputs: int | None = None
) -> None:
    """Mutate at random until the time is over, or for a number of inputs; count the failures."""
    random = np.random.default_rng(seed)
    end = time.monotonic() + seconds
    while time.monotonic() < end and checked.n_inputs != n_inputs:
        original = corpus[int(random.integers(0, len(corpus)))]
        data = mutated(original, corpus, random)
        try:
            checked(data)
        except (Exception, Slow):
            continue


def drive_by_coverage(name: str, findings: Path, seconds: float, seed: int) -> None:
    """Mutate by the lines that an input reaches.

    libFuzzer ends the process at a failure, or when the time is over.
    """
    import atheris

    with atheris.instrument_imports(include=["vehanchor", "vehanchor_server"]):
        from tests.fuzz.targets import CORPUS, TARGETS
    corpus = findings / "corpus" / name
    corpus.mkdir(parents=True, exist_ok=True)
    for data in CORPUS[name]():
        (corpus / input_name(data)).write_bytes(data)
    checked = Checked(TARGETS[name], findings)
    options = [
        f"-max_total_time={int(seconds)}",
        f"-seed={seed}",
        "-max_len=65536",
        "-timeout=20",
        "-rss_limit_mb=2048",
    ]
    atheris.Setup(
        [sys.argv[0], *options, f"-artifact_prefix={findings}/", str(corpus)],
        checked,
        enable_python_coverage=True,
    )
    atheris.Fuzz()


def main() -> int:
    """Drive the targets that are named, each for its share of the time."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("targets", nargs="*", help="default: all; with --coverage exactly one")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--inputs", type=int, help="end a target after so many inputs, too")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--findings", type=Path, default=Path("fuzz-findings"))
    parser.add_argument("--coverage", action="store_true", help="guide mutations by atheris")
    options = parser.parse_args()
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    if options.coverage:
        drive_by_coverage(
            options.targets[0], options.findings, seconds=options.seconds, seed=options.seed
        )
    from tests.fuzz.targets import CORPUS, TARGETS

    names = options.targets or list(TARGETS)
    n_failures = 0
    for name in names:
        checked = Checked(TARGETS[name], options.findings)
        drive_blindly(
            checked,
            CORPUS[name](),
            seconds=options.seconds / len(names),
            seed=options.seed,
            n_inputs=options.inputs,
        )
        n_failures += checked.n_failures
        print(
            f"{name}: {checked.n_inputs} inputs, {checked.n_failures} failures, "
            f"slowest {checked.slowest_s:.2f} s, peak {_peak_mib():.0f} MiB",
            flush=True,
        )
    return 1 if n_failures else 0


if __name__ == "__main__":
    sys.exit(main())
