"""The page of ``vehanchor view`` on a port of this machine, for as long as a test lasts."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import uvicorn

from vehanchor_server.settings import Settings
from vehanchor_server.transport.viewer import Address, create_viewer


@contextlib.contextmanager
def viewing(settings: Settings, dropped: Path) -> Iterator[Address]:
    """The page's address; photographs that are dropped go to a folder of the test."""
    dropped.mkdir(exist_ok=True)
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        address = Address(listening.getsockname()[1])
        app = create_viewer(replace(settings, roots=(*settings.roots, dropped)), address, dropped)
        server = uvicorn.Server(uvicorn.Config(app, log_config=None, access_log=False, timeout_graceful_shutdown=2))
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]}, daemon=True)
        thread.start()
        deadline = time.monotonic() + 20
        while not server.started and time.monotonic() < deadline:
            time.sleep(0.01)
        try:
            yield address
        finally:
            server.should_exit = True
            thread.join(10)
