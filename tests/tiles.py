"""Tiles that a test holds and counts, so that it does not depend on the duration of a call."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import anyio.to_thread
import pytest

from vehanchor.detection.detector import Detector

__all__ = ["Tiles", "watched_tiles"]

_PATIENCE_S = 60


class Tiles:
    """Tiles that detectors have begun.

    Attributes:
        n_begun: number of tiles.
        least_s: minimum time of a tile, seconds.
    """

    def __init__(self) -> None:
        self.n_begun = 0
        self.least_s = 0.0
        self._change = threading.Condition()
        self._held = False

    @contextmanager
    def held(self) -> Iterator[None]:
        """Hold every tile that begins until the block ends."""
        self._held = True
        try:
            yield
        finally:
            with self._change:
                self._held = False
                self._change.notify_all()

    async def begun(self, n: int = 1) -> None:
        """Wait until a number of tiles has begun."""
        await anyio.to_thread.run_sync(self._wait, n)

    def begin(self) -> None:
        """Count a tile, and hold it if tiles are held."""
        with self._change:
            self.n_begun += 1
            self._change.notify_all()
            released = self._change.wait_for(lambda: not self._held, _PATIENCE_S)
        assert released, "the test held a tile for too long"
        time.sleep(self.least_s)

    def _wait(self, n: int) -> None:
        with self._change:
            begun = self._change.wait_for(lambda: self.n_begun >= n, _PATIENCE_S)
        assert begun, f"{n} tiles never began"


@contextmanager
def watched_tiles() -> Iterator[Tiles]:
    """Watch and hold the tiles of every detector of this process."""
    tiles = Tiles()
    original = Detector.detect_tile

    def watched(self: Detector, *args: object, **kwargs: object) -> object:
        tiles.begin()
        return original(self, *args, **kwargs)  # type: ignore[arg-type]

    with pytest.MonkeyPatch.context() as patches:
        patches.setattr(Detector, "detect_tile", watched)
        yield tiles
