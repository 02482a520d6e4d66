"""Lines that a worker writes, labelled, bounded and without control characters in the server's log."""

from __future__ import annotations

import logging
import threading
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

_MAX_LINE_BYTES = 2000
_MAX_LINES = 2000
_READ_BYTES = 1 << 16
_logger = logging.getLogger(__name__)


def forward_log(log: Connection, pid: int) -> threading.Thread:
    """Log what a worker writes until the worker ends, in a thread of its own.

    Args:
        log: the end of the pipe that reads; closed in the end.
        pid: of the worker, for the label.
    """
    thread = threading.Thread(target=_forward, args=(log, pid), name=f"vehanchor-log-{pid}", daemon=True)
    thread.start()
    return thread


def printable(line: bytes) -> str:
    """A line of a worker as one line of text without control characters, cut at 2,000 bytes."""
    text = line[:_MAX_LINE_BYTES].decode("utf-8", "replace").rstrip("\r\n")
    shown = "".join(char if char.isprintable() else f"\\x{ord(char):02x}" for char in text)
    return f"{shown} [cut]" if len(line) > _MAX_LINE_BYTES else shown


def _forward(log: Connection, pid: int) -> None:
    n_lines = 0
    with log, open(log.fileno(), "rb", buffering=_READ_BYTES, closefd=False) as stream:
        while line := stream.readline(_READ_BYTES):
            n_lines += 1
            if n_lines <= _MAX_LINES:
                _logger.warning("worker %d: %s", pid, printable(line))
            elif n_lines == _MAX_LINES + 1:
                _logger.warning("worker %d: more than %d lines; the rest is left out", pid, _MAX_LINES)
