"""Exit when the parent exits."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time

_GRACE_S = 5.0


def end_with_supervisor() -> None:
    """End this process when its parent process ends; do nothing without a parent."""
    supervisor = multiprocessing.parent_process()
    if supervisor is None:
        return

    def watch() -> None:
        supervisor.join()
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(_GRACE_S)
        os._exit(1)

    threading.Thread(target=watch, name="vehanchor-supervisor", daemon=True).start()
