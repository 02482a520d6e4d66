"""The fuzzer: mutates the corpus of a target for some seconds, and keeps what raised, hung, or took too much memory.

    python -m tests.fuzz.drive image --seconds 60 --seed 1

With ``--coverage`` it is guided by which lines of ours an input reaches, by atheris, a tool of its
own (``pip install atheris``, Python 3.11 to 3.13, Linux); else mutations are blind. An input that
fails is written to ``--findings``, and the exit status is not 0: what is found becomes a test in
``tests/fuzz/test_targets.py``.
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

import numpy as np

HANG_S = 2.0
"""Longest that an input may take."""

MEMORY_MIB = 1024
"""Most that the process may hold, libraries included."""

GROWTH_MIB = 256
"""Most that one input may add to a process that held as much before, as that of the tests does."""

_EDGES = (0, 1, 255, 2**16 - 1, 2**31 - 1, 2**32 - 1, 2**63, 2**64 - 1)


class Slow(BaseException):
    """An input took too long; no handler of ours may catch it."""


class Checked:
    """A target that fails on what takes too long or too much, and counts.

    Args:
        target: takes bytes.
        findings: folder for inputs that fail.
    """

    def __init__(self, target: Callable[[bytes], None], findings: Path) -> None:
        self._target = target
        self._findings = findings
        self.n_inputs = self.n_failures = 0
        self.slowest_s = 0.0
        signal.signal(signal.SIGALRM, _stop)

    def __call__(self, data: bytes) -> None:
        self.n_inputs += 1
        started = time.process_time()
        held_mib = _peak_mib()
        # Python's loops only: what hangs in C is left to the caller
        signal.setitimer(signal.ITIMER_REAL, 10 * HANG_S)
        try:
            self._target(data)
            taken = time.process_time() - started
            self.slowest_s = max(self.slowest_s, taken)
            if taken > HANG_S:
                raise Slow(f"{taken:.1f} s")
            # what it held before is no fault of this input
            if _peak_mib() > max(MEMORY_MIB, held_mib + GROWTH_MIB):
                raise MemoryError(f"{_peak_mib():.0f} MiB")
        except (Exception, Slow) as error:
            self.n_failures += 1
            self._findings.mkdir(parents=True, exist_ok=True)
            path = self._findings / hashlib.sha256(data).hexdigest()[:16]
            path.write_bytes(data)
            print(f"{path}: {type(error).__name__}: {str(error)[:200]}", file=sys.stderr)
            raise
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)


def _stop(number: int, frame: FrameType | None) -> None:
    del number, frame
    raise Slow("hangs")


def _peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def mutated(data: bytes, others: list[bytes], random: np.random.Generator) -> bytes:
    """An input somewhat changed: bits, bytes, numbers, pieces cut out, doubled, or taken from another."""
    out = bytearray(data)
    for _ in range(int(random.integers(1, 6))):
        at = int(random.integers(0, len(out) + 1))
        size = int(random.integers(1, 9))
        match int(random.integers(0, 7)):
            case 0 if out:
                out[at % len(out)] ^= 1 << int(random.integers(0, 8))
            case 1:
                out[at : at + size] = random.bytes(size)
            case 2:
                number = _EDGES[int(random.integers(0, len(_EDGES)))]
                out[at : at + size] = number.to_bytes(
                    8, "little" if random.random() < 0.5 else "big"
                )[:size]
            case 3:
                del out[at : at + int(random.integers(1, 1 + max(1, len(out) // 4)))]
            case 4:
                out[at:at] = out[at : at + int(random.integers(1, 65))] * int(random.integers(1, 9))
            case 5:
                other = others[int(random.integers(0, len(others)))]
                start = int(random.integers(0, len(other) + 1))
                out[at : at + size] = other[start : start + int(random.integers(1, 65))]
            case _:
                out[at : at + size] = bytes(
                    random.choice(list(b'0123456789-+.eE"[]{},:truefalsn'), size).tolist()
                )
    return bytes(out[: 1 << 20])


def drive_blindly(
    checked: Checked, corpus: list[bytes], seconds: float, seed: int, n_inputs: int | None = None
) -> None:
    """Mutate at random until the time is over, or for a number of inputs; failures are counted."""
    random = np.random.default_rng(seed)
    ends = time.monotonic() + seconds
    while time.monotonic() < ends and checked.n_inputs != n_inputs:
        data = mutated(corpus[int(random.integers(0, len(corpus)))], corpus, random)
        try:
            checked(data)
        except (Exception, Slow):
            continue


def drive_by_coverage(name: str, findings: Path, seconds: float, seed: int) -> None:
    """Mutate by what is reached; libFuzzer ends the process, at a failure or when the time is over."""
    import atheris

    with atheris.instrument_imports(include=["vehanchor", "vehanchor_server"]):
        from tests.fuzz.targets import CORPUS, TARGETS
    corpus = findings / "corpus" / name
    corpus.mkdir(parents=True, exist_ok=True)
    for data in CORPUS[name]():
        (corpus / hashlib.sha256(data).hexdigest()[:16]).write_bytes(data)
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
    parser.add_argument(
        "targets", nargs="*", help="all, where none is named; with --coverage exactly one"
    )
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--inputs", type=int, help="end a target after so many inputs, too")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--findings", type=Path, default=Path("fuzz-findings"))
    parser.add_argument(
        "--coverage", action="store_true", help="be guided by coverage: needs atheris"
    )
    asked = parser.parse_args()
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    if asked.coverage:
        drive_by_coverage(asked.targets[0], asked.findings, seconds=asked.seconds, seed=asked.seed)
    from tests.fuzz.targets import CORPUS, TARGETS

    names = asked.targets or list(TARGETS)
    failures = 0
    for name in names:
        checked = Checked(TARGETS[name], asked.findings)
        drive_blindly(
            checked,
            CORPUS[name](),
            seconds=asked.seconds / len(names),
            seed=asked.seed,
            n_inputs=asked.inputs,
        )
        failures += checked.n_failures
        print(
            f"{name}: {checked.n_inputs} inputs, {checked.n_failures} failures, slowest "
            f"{checked.slowest_s:.2f} s, "
            f"peak {_peak_mib():.0f} MiB",
            flush=True,
        )
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
