"""Garbage collection during imports."""

from __future__ import annotations

import contextlib
import gc
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator


@contextlib.contextmanager
def paused_collection() -> Iterator[None]:
    """Pause garbage collection while the block imports modules.

    Imports create some 75,000 objects that stay until the end of the process. The collector would visit them again and
    again, for a tenth of the time of a short command, and find nothing. Later it leaves them out.
    """
    gc.disable()
    try:
        yield
        gc.freeze()
    finally:
        gc.enable()
