"""The numbers that a bundled detector computes with, and whether this processor is quick with those of eight bits.

ONNX Runtime computes with eight bits everywhere, but it is quicker than with float32 only where the processor has dot
products of bytes: VNNI on x86, the dot products of Armv8.2. Linux says so itself; all of Apple's own processors have
them. Elsewhere nothing tells without a package for it.
"""

from __future__ import annotations

import platform
from functools import cache
from pathlib import Path

_CPU_INFO = Path("/proc/cpuinfo")
_FEATURES = frozenset({"avx512_vnni", "avx_vnni", "amx_int8", "asimddp"})  # as Linux names them


def lists_byte_dot_products(cpu_info: str) -> bool:
    """Whether what Linux says of its processors, ``/proc/cpuinfo``, names dot products of bytes."""
    for line in cpu_info.splitlines():
        name, _, listed = line.partition(":")
        if name.strip() in ("flags", "Features"):
            return not _FEATURES.isdisjoint(listed.split())
    return False


@cache
def has_byte_dot_products() -> bool:
    """Whether this processor has dot products of bytes, as far as the system tells."""
    system = platform.system()
    if system == "Darwin":
        return platform.machine() == "arm64"
    try:
        return system == "Linux" and lists_byte_dot_products(_CPU_INFO.read_text(encoding="utf-8", errors="replace"))
    except OSError:
        return False
