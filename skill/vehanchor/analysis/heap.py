"""Memory of a worker process, by glibc's allocator; nothing happens with another one.

``research/results/notes.md`` has what each measure brings.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

# From malloc.h.
_M_ARENA_MAX = -8
_M_MMAP_THRESHOLD = -3
_OWN_MAP_BYTES = 8 << 20
# Environment variable that glibc reads when a process starts.
_TUNABLES = "GLIBC_TUNABLES"
_HUGE_PAGES = "glibc.malloc.hugetlb=1"


def use_one_heap() -> None:
    """Let all threads of this process share one heap: others would keep freed memory, too."""
    _glibc("mallopt", _M_ARENA_MAX, 1)


@contextlib.contextmanager
def huge_pages_in_new_processes() -> Iterator[None]:
    """Let processes that start meanwhile hold their memory in huge pages, if Linux has them.

    The networks then look up fewer pages. A setting of the user stays as it is.
    """
    if _TUNABLES in os.environ:
        yield
        return
    os.environ[_TUNABLES] = _HUGE_PAGES
    try:
        yield
    finally:
        os.environ.pop(_TUNABLES, None)


def map_large_blocks() -> None:
    """Give blocks of 8 MiB and more maps of their own, which return to the system when freed.

    A process that waits then keeps less. One that computes all the time is slower by a tenth.
    """
    _glibc("mallopt", _M_MMAP_THRESHOLD, _OWN_MAP_BYTES)


def return_freed() -> None:
    """Return freed memory to the system; the next call maps it again, which takes some 25 ms."""
    _glibc("malloc_trim", 0)


def _glibc(function: str, *arguments: int) -> None:
    """Call a function of glibc's memory allocator, if there is one."""
    # TypeError: Windows has no CDLL of itself
    with contextlib.suppress(OSError, TypeError, AttributeError):
        getattr(ctypes.CDLL(None), function)(*arguments)
