"""The page of ``vehanchor view`` on a port of this machine, for as long as a test lasts."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from tests.server.serving import listening, serving
from vehanchor_server.settings import Settings
from vehanchor_server.transport.viewer import Address, create_viewer


@contextlib.contextmanager
def viewing(settings: Settings, dropped: Path) -> Iterator[Address]:
    """The page's address; photographs that are dropped go to a folder of the test."""
    dropped.mkdir(exist_ok=True)
    with listening() as listener:
        address = Address(listener.getsockname()[1])
        with serving(create_viewer(replace(settings, roots=(*settings.roots, dropped)), address, dropped), listener):
            yield address
