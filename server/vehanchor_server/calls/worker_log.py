"""Forward a worker's log lines to the server's log: labelled, limited, without control characters.

A compromised worker can write anything, such as forged lines or commands to a terminal.
"""

from __future__ import annotations

import logging
import threading
from typing import TYPE_CHECKING

from vehanchor.records.escaping import on_one_line

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

_MAX_LINE_BYTES = 2000
_MAX_LINES = 2000
_READ_BYTES = 1 << 16
_logger = logging.getLogger(__name__)


def forward_log(log: Connection, pid: int) -> threading.Thread:
    """Forward a worker's lines in a separate thread until the worker ends.

    Args:
        log: reading end of the pipe; the thread closes it.
        pid: process id of the worker, for the label.
    """
    thread = threading.Thread(
        target=_forward, args=(log, pid), name=f"vehanchor-log-{pid}", daemon=True
    )
    thread.start()
    return thread


def _forward(log: Connection, pid: int) -> None:
    n_lines = 0
    with log, open(log.fileno(), "rb", buffering=_READ_BYTES, closefd=False) as stream:
        while line := stream.readline(_READ_BYTES):
            n_lines += 1
            if n_lines <= _MAX_LINES:
                text = line[:_MAX_LINE_BYTES].decode("utf-8", "replace")
                shown = on_one_line(text.rstrip("\r\n"))
                if len(line) > _MAX_LINE_BYTES:
                    shown += " [cut]"
                _logger.warning("worker %d: %s", pid, shown)
            elif n_lines == _MAX_LINES + 1:
                # Later lines are read, so that the worker does not block, and dropped.
                _logger.warning(
                    "worker %d: more than %d lines; the rest is omitted", pid, _MAX_LINES
                )
