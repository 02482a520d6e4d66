"""A child that crashes and hangs, in a module of its own: each start of one imports it anew."""

from __future__ import annotations

import os
from multiprocessing.connection import Connection
from pathlib import Path


def serve_crashing(connection: Connection, findings: Path) -> None:
    """End the process at one image, and never answer to another."""
    del findings
    connection.send_bytes(b"ready")
    while True:
        data = connection.recv_bytes()
        if data == b"crash":
            os.abort()
        while data == b"hang":
            pass
        connection.send_bytes(b"done")
