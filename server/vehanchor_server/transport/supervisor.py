"""A worker process's eye on the process that started it: without it, nobody would stop the worker any more."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time

_GRACE_S = 5.0


def end_with_supervisor() -> None:
    """End this process when the one that started it ends, however that happened; nothing where there is none."""
    supervisor = multiprocessing.parent_process()
    if supervisor is None:
        return

    def watch() -> None:
        supervisor.join()
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(_GRACE_S)
        os._exit(1)

    threading.Thread(target=watch, name="vehanchor-supervisor", daemon=True).start()
