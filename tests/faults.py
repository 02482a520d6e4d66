"""A disk that is full, and a process that is killed, at a byte: brought about by the system, in a child process.

A file that would grow beyond ``RLIMIT_FSIZE`` refuses the write, or ends the process on the spot (SIGXFSZ), as it is
told: no code of ours runs after it, as after a kill -9.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable

WRITTEN, REFUSED = 0, 1


def limited(work: Callable[[], object], n_bytes: int | None, *, killed: bool) -> int:
    """How work ends in a copy of this process, which should have one thread: 0, 1 for any exception, or minus a signal.

    Args:
        work: writes files.
        n_bytes: to which each may grow; None does not limit them.
        killed: end the process there, instead of refusing to write.
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
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
