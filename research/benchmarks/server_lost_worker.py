"""Play a worker that was taken over: what it can do outside itself.

``python -m research.benchmarks.server_lost_worker``, on Linux; as root it has most to lose. Aim: no effect.

It makes every system call by its number, each with four kinds of arguments, in a confined process of its own, and
compares files, processes and settings before and after. It mutates every message of the protocol and gives the bytes to
the server's reader.
"""

from __future__ import annotations

import argparse
import ctypes
import errno
import os
import resource
import signal
import tempfile
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

import numpy as np

from research.results.record import add_record_option, recording, values_table
from tests.fuzz.drive import Checked, Slow, mutated
from tests.fuzz.targets import CORPUS, TARGETS
from vehanchor_server.sandbox.confinement import confine

if TYPE_CHECKING:
    from collections.abc import Iterable

_N_CALLS = 600  # numbers; the newest call of Linux 6.18 is below 480
_ALARM_S = 1.0  # for a call that waits
_AT_FDCWD = -100
_SYSTEM_FILES = ("/proc/sysvipc/msg", "/proc/sysvipc/sem", "/proc/sysvipc/shm", "/proc/self/mountinfo", "/proc/modules")
_SEEN = [0] * (signal.NSIG + 1)


def state(folder: Path) -> dict[str, Any]:
    """Read everything that a call could change outside its process."""
    found: dict[str, Any] = {"host": os.uname()[:2], "folder": sorted(each.name for each in folder.rglob("*"))}
    for file in (folder, *folder.rglob("*")):
        facts = file.lstat()
        found[f"file {file.name}"] = (facts.st_mode, facts.st_uid, facts.st_size, facts.st_mtime_ns, facts.st_nlink)
        if file.is_file():
            found[f"content {file.name}"] = file.read_bytes()
    for name in _SYSTEM_FILES:
        with suppress(OSError):
            found[name] = Path(name).read_text()
    found["limits"] = [
        resource.getrlimit(getattr(resource, name)) for name in dir(resource) if name.startswith("RLIMIT_")
    ]
    found["priority"] = os.getpriority(os.PRIO_PROCESS, 0)
    found["scheduler"] = os.sched_getscheduler(0), sorted(os.sched_getaffinity(0))
    found["group"] = os.getpgid(0), os.getsid(0), Path.cwd(), os.getresuid()
    found["signals"] = [count for number, count in enumerate(_SEEN) if number != signal.SIGCHLD]
    found["descriptors"] = sorted(each.name for each in Path("/proc/self/fd").iterdir())
    return found


def arguments(kind: str, path: bytes) -> list[Any]:
    """Make the six arguments of a call: nothing, a path, a path below a folder, or the process that started it."""
    name = ctypes.c_char_p(path)
    kinds: dict[str, list[Any]] = {
        "zeros": [0, 0, 0, 0, 0, 0],
        "path": [name, 0o777, 0o777, 0, 0, 0],
        "path at": [_AT_FDCWD, name, 0o1101, 0o777, 0, 0],
        "process": [os.getppid(), int(signal.SIGUSR1), 0, 0, 0, 0],
    }
    return kinds[kind]


KINDS = ("zeros", "path", "path at", "process")


def call(number: int, kind: str, folder: Path) -> str:
    """Make a system call in a new confined process; return its error's name, "done", "ended" or "unconfined"."""
    ours, theirs = os.pipe()
    child = os.fork()
    if child == 0:
        with suppress(BaseException):
            for each in range(1, signal.NSIG):
                with suppress(OSError, ValueError):
                    signal.signal(each, signal.SIG_DFL)
            os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
            os.dup2(theirs, 1)
            os.dup2(theirs, 2)
            signal.setitimer(signal.ITIMER_REAL, _ALARM_S)
            given = arguments(kind, str(folder / "image.png").encode())
            held = confine([folder])
            if not (held.landlock and held.seccomp):
                os.write(theirs, b"unconfined")
                os._exit(0)
            libc = ctypes.CDLL(None, use_errno=True)
            result = libc.syscall(ctypes.c_long(number), *(_wide(each) for each in given))
            said = errno.errorcode.get(ctypes.get_errno(), "?") if result == -1 else "done"
            os.write(theirs, said.encode())
        os._exit(0)
    os.close(theirs)
    with os.fdopen(ours, "rb") as pipe:
        said = pipe.read().decode("ascii", "replace")
    os.waitpid(child, 0)
    return said if said.isidentifier() else "ended"


def _wide(value: Any) -> Any:
    return value if isinstance(value, ctypes.c_char_p) else ctypes.c_long(value)


def try_system_calls(numbers: Iterable[int]) -> dict[str, Any]:
    """Make system calls; list those after which something outside was different."""
    for each in range(1, signal.NSIG):
        with suppress(OSError, ValueError):
            signal.signal(each, _count)
    outcomes: Counter[str] = Counter()
    effects: list[str] = []
    with tempfile.TemporaryDirectory() as directory:
        folder = Path(directory).resolve()
        (folder / "image.png").write_bytes(b"pixels")
        before = state(folder)
        for number in numbers:
            for kind in KINDS:
                outcomes[call(number, kind, folder)] += 1
                after = state(folder)
                if after != before:
                    changed = [name for name in {*before, *after} if before.get(name) != after.get(name)]
                    effects.append(f"{number} with {kind}: {', '.join(changed)}")
                    before = after
    with suppress(ChildProcessError):
        left, _ = os.waitpid(-1, os.WNOHANG)
        effects.append(f"process {left} is left")
    refused = outcomes["EPERM"] + outcomes["EACCES"] + outcomes["ENOSYS"]
    return {
        "system calls made, by number and kind of arguments": sum(outcomes.values()),
        "of them refused (EPERM, EACCES, ENOSYS)": refused,
        "of them done": outcomes["done"],
        "of them failed otherwise, or ended the process": sum(outcomes.values()) - refused - outcomes["done"],
        "effects outside": "; ".join(effects) or 0,
    }


def _count(number: int, frame: FrameType | None) -> None:
    del frame
    _SEEN[number] += 1


def mutate_messages(n_mutations: int, seed: int, findings: Path) -> dict[str, Any]:
    """Give the server's reader mutations of every message."""
    corpus, random = CORPUS["messages"](), np.random.default_rng(seed)
    checked = Checked(TARGETS["messages"], findings)
    for message in corpus:
        for _ in range(n_mutations):
            with suppress(Exception, Slow):  # counted, and kept as a finding
                checked(mutated(message, corpus, random))
    return {
        "messages": len(corpus),
        "mutations": checked.n_inputs,
        "crashes, foreign exceptions, over 2 s or 1 GiB": checked.n_failures,
        "slowest, ms": 1000 * checked.slowest_s,
    }


def main() -> None:
    """Play both parts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--calls", type=int, default=_N_CALLS, help="numbers of system calls")
    parser.add_argument("--mutations", type=int, default=100_000, help="of each message")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--findings", type=Path, default=Path("fuzz-findings"))
    options = add_record_option(parser).parse_args()
    with recording("server", ["lost_worker_calls", "lost_worker_messages"], options.record):
        started = time.monotonic()
        print(*values_table(try_system_calls(range(options.calls))), sep="\n", flush=True)
        print(f"\n{time.monotonic() - started:.0f} s\n")
        print(*values_table(mutate_messages(options.mutations, options.seed, options.findings)), sep="\n", flush=True)


if __name__ == "__main__":
    main()
